//! The socketcand server as clients meet it, over real sockets.

use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use emulator::can_frame::CanFrame;
use emulator::serve::socketcand::{MAX_CLIENTS, MAX_UNSENT, Server};
use proptest::prelude::*;

/// Longer than anything takes, also on a busy machine.
const PATIENCE: Duration = Duration::from_secs(20);

fn server() -> Server {
    Server::bind("127.0.0.1:0").unwrap()
}

/// A client with what it has read so far.
struct Client {
    stream: TcpStream,
    text: String,
}

impl Client {
    fn connect(server: &Server) -> Self {
        let stream = TcpStream::connect(server.local_addr().unwrap()).unwrap();
        stream.set_nonblocking(true).unwrap();
        Self {
            stream,
            text: String::new(),
        }
    }

    fn raw(server: &mut Server) -> Self {
        let mut client = Self::connect(server);
        client.expect(server, "< hi >");
        client.ask(server, "< open can0 >", "< ok >");
        client.ask(server, "< rawmode >", "< ok >");
        client.wait_for_frames(server);
        client
    }

    /// Frames begin a little after the answer to `rawmode`.
    fn wait_for_frames(&mut self, server: &mut Server) {
        let probe = CanFrame::standard(0x7FF, &[]);
        self.until(server, |server, client| {
            server.publish(0.0, &probe);
            !client.text.is_empty()
        });
        self.settle(server);
    }

    /// Reads all that is on its way: it comes before the answer.
    fn settle(&mut self, server: &mut Server) {
        self.say("< echo >");
        self.until(server, |_, client| client.text.ends_with("< echo >"));
        self.text.clear();
    }

    fn say(&mut self, text: &str) {
        self.stream.write_all(text.as_bytes()).unwrap();
    }

    fn ask(&mut self, server: &mut Server, text: &str, answer: &str) {
        self.say(text);
        self.expect(server, answer);
    }

    /// All that comes is `answer`.
    fn expect(&mut self, server: &mut Server, answer: &str) {
        self.until(server, |_, client| client.text.len() >= answer.len());
        assert_eq!(self.text, answer);
        self.text.clear();
    }

    fn until(&mut self, server: &mut Server, mut done: impl FnMut(&mut Server, &Self) -> bool) {
        let end = Instant::now() + PATIENCE;
        loop {
            assert!(server.poll().is_empty(), "a frame that nobody sent");
            self.read();
            if done(server, self) {
                return;
            }
            assert!(Instant::now() < end, "only {:?} came", self.text);
            std::thread::sleep(Duration::from_micros(200));
        }
    }

    /// Takes what is there; whether the connection stands.
    fn read(&mut self) -> bool {
        let mut chunk = [0; 4096];
        loop {
            match self.stream.read(&mut chunk) {
                Ok(0) => return false,
                Ok(count) => self
                    .text
                    .push_str(std::str::from_utf8(&chunk[..count]).unwrap()),
                Err(error) if error.kind() == ErrorKind::WouldBlock => return true,
                Err(error) if error.kind() == ErrorKind::ConnectionReset => return false,
                Err(error) => panic!("{error}"),
            }
        }
    }

    fn until_closed(&mut self, server: &mut Server) {
        let end = Instant::now() + PATIENCE;
        while self.read() {
            server.poll();
            assert!(Instant::now() < end, "still connected");
            std::thread::sleep(Duration::from_micros(200));
        }
    }
}

/// The next `count` frames that clients want sent.
fn taken(server: &mut Server, count: usize) -> Vec<CanFrame> {
    let end = Instant::now() + PATIENCE;
    let mut frames = Vec::new();
    while frames.len() < count {
        frames.extend(server.poll());
        assert!(Instant::now() < end, "only {} frames", frames.len());
        std::thread::sleep(Duration::from_micros(200));
    }
    frames
}

#[test]
fn the_handshake_and_the_modes() {
    let mut server = server();
    let mut client = Client::connect(&server);
    client.expect(&mut server, "< hi >");
    client.ask(&mut server, "< rawmode >", "< error no bus is open >");
    client.ask(&mut server, "< open can0 >", "< ok >");
    client.ask(
        &mut server,
        "< open can0 >",
        "< error a bus is open already >",
    );
    client.ask(&mut server, "< echo >", "< echo >");
    client.ask(
        &mut server,
        "< controlmode >",
        "< error command not supported here >",
    );
    // Without subscriptions nothing is received in BCM mode.
    server.publish(1.0, &CanFrame::standard(0x101, &[1]));
    client.ask(&mut server, "< echo >", "< echo >");
    client.ask(&mut server, "< rawmode >", "< ok >");
    client.wait_for_frames(&mut server);
    server.publish(2.5, &CanFrame::standard(0x101, &[1, 0xAB]));
    client.expect(&mut server, "< frame 101 2.500000 01AB >");
    client.ask(&mut server, "< bcmmode >", "< ok >");
    server.publish(3.0, &CanFrame::standard(0x101, &[1]));
    client.ask(&mut server, "< echo >", "< echo >");
    assert_eq!(server.clients(), 1);
}

#[test]
fn the_answer_to_rawmode_stands_alone() {
    let mut server = server();
    let mut client = Client::connect(&server);
    client.expect(&mut server, "< hi >");
    client.ask(&mut server, "< open can0 >", "< ok >");
    client.say("< rawmode >");
    client.until(&mut server, |server, client| {
        server.publish(1.0, &CanFrame::standard(0x101, &[1]));
        !client.text.is_empty()
    });
    assert_eq!(client.text, "< ok >");
}

#[test]
fn another_bus_is_refused_and_the_connection_ends() {
    let mut server = server();
    let mut client = Client::connect(&server);
    client.expect(&mut server, "< hi >");
    client.say("< open vcan7 >");
    client.until_closed(&mut server);
    assert_eq!(client.text, "< error could not open bus >");
    assert_eq!(server.clients(), 0);
}

#[test]
fn frames_reach_the_bus_in_order_and_come_back_to_the_others_only() {
    let mut server = server();
    let mut sender = Client::raw(&mut server);
    let mut other = Client::raw(&mut server);
    sender.settle(&mut server);
    sender.say("< send 201 2 1 ff >< send 1ABCDEF0 0 >< sendrtr 123 4 >");
    let frames = taken(&mut server, 3);
    let extended = CanFrame {
        id: 0x1ABC_DEF0,
        extended: true,
        ..CanFrame::default()
    };
    let remote = CanFrame {
        id: 0x123,
        remote: true,
        length: 4,
        ..CanFrame::default()
    };
    assert_eq!(
        frames,
        [CanFrame::standard(0x201, &[1, 0xFF]), extended, remote]
    );
    // The bus has its own order, and the board sends between.
    server.publish(0.1, &frames[2]);
    server.publish(0.2, &CanFrame::standard(0x101, &[7]));
    server.publish(0.3, &frames[0]);
    server.publish(0.4, &frames[1]);
    // The same content once more is another node's.
    server.publish(0.5, &frames[0]);
    sender.expect(
        &mut server,
        "< frame 101 0.200000 07 >< frame 201 0.500000 01FF >",
    );
    other.expect(
        &mut server,
        "< rtr 123 0.100000 4 >< frame 101 0.200000 07 >< frame 201 0.300000 01FF >\
         < frame 1ABCDEF0 0.400000  >< frame 201 0.500000 01FF >",
    );
}

#[test]
fn a_client_waits_while_the_bus_has_enough_of_its_frames() {
    let mut server = server();
    let mut client = Client::raw(&mut server);
    let count = MAX_UNSENT + 10;
    for number in 0..count {
        client.say(&format!("< send {number:03X} 0 >"));
    }
    let first = taken(&mut server, MAX_UNSENT);
    for _ in 0..50 {
        assert_eq!(server.poll(), [], "beyond what may wait");
    }
    for frame in &first[..10] {
        server.publish(1.0, frame);
    }
    let rest = taken(&mut server, 10);
    let ids: Vec<u32> = first.iter().chain(&rest).map(|frame| frame.id).collect();
    assert_eq!(ids, (0..count as u32).collect::<Vec<_>>());
    // Frames that never appear on the bus do not stop it for ever.
    client.say("< send 7FE 0 >");
    server.publish(2.5, &CanFrame::standard(0x101, &[]));
    assert_eq!(taken(&mut server, 1)[0].id, 0x7FE);
}

#[test]
fn there_is_a_last_client() {
    let mut server = server();
    let mut clients: Vec<Client> = (0..MAX_CLIENTS)
        .map(|_| {
            let mut client = Client::connect(&server);
            client.expect(&mut server, "< hi >");
            client
        })
        .collect();
    let mut late = Client::connect(&server);
    late.until_closed(&mut server);
    assert_eq!(late.text, "< error too many clients >");
    assert_eq!(server.clients(), MAX_CLIENTS);
    // A place is free again when one leaves.
    clients.pop();
    let end = Instant::now() + PATIENCE;
    while server.clients() == MAX_CLIENTS {
        server.poll();
        assert!(Instant::now() < end, "the client that left is still there");
    }
    Client::connect(&server).expect(&mut server, "< hi >");
}

#[test]
fn a_client_that_does_not_read_is_dropped_and_the_others_are_not() {
    let mut server = server();
    let slow = Client::raw(&mut server);
    let mut good = Client::raw(&mut server);
    let frame = CanFrame::standard(0x101, &[0xFF; 8]);
    let end = Instant::now() + PATIENCE;
    let mut published = 0;
    while server.clients() == 2 {
        for _ in 0..100 {
            server.publish(1.0, &frame);
            published += 1;
        }
        good.read();
        assert!(Instant::now() < end, "still there");
    }
    let line = "< frame 101 1.000000 FFFFFFFFFFFFFFFF >";
    good.until(&mut server, |_, client| {
        client.text.len() >= published * line.len()
    });
    assert_eq!(good.text, line.repeat(published));
    let notices = server.take_notices().join("\n");
    assert!(notices.contains("does not read"), "{notices}");
    drop(slow);
}

/// What a broken or hostile client may send.
fn nonsense() -> impl Strategy<Value = Vec<u8>> {
    let piece = prop_oneof![
        prop::collection::vec(any::<u8>(), 0..200),
        "[<> a-z0-9]{0,300}".prop_map(String::into_bytes),
        "< (send|sendrtr|open|rawmode|add|echo) [0-9A-F ]{0,30}>".prop_map(String::into_bytes),
        Just(b"< open can0 >< rawmode >".to_vec()),
    ];
    prop::collection::vec(piece, 1..10).prop_map(|pieces| pieces.concat())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(60))]

    #[test]
    fn nonsense_harms_nobody(first in nonsense(), second in nonsense()) {
        let mut server = server();
        let address = server.local_addr().unwrap();
        for bytes in [&first, &second] {
            let mut client = TcpStream::connect(address).unwrap();
            client.write_all(bytes).unwrap();
            for frame in (0..20).flat_map(|_| server.poll()).collect::<Vec<_>>() {
                prop_assert!(frame.length <= 8 && frame.id < 1 << 29);
                server.publish(1.0, &frame);
            }
        }
        let mut good = Client::connect(&server);
        let end = Instant::now() + PATIENCE;
        while good.text != "< hi >" {
            server.poll();
            good.read();
            prop_assert!(Instant::now() < end);
        }
    }
}
