//! The board's CAN bus over TCP, in the protocol of socketcand: what python-can's `socketcand` interface, Kayak and
//! others speak.
//!
//! Time stamps are the board's own time in seconds since its power came on, not the time of day. No UDP beacon: clients
//! are told host, port and channel.

mod protocol;

use std::collections::VecDeque;
use std::io::{self, ErrorKind, Read};
use std::net::{SocketAddr, TcpListener, TcpStream, ToSocketAddrs};
use std::time::{Duration, Instant};

use super::outbox::Outbox;
use crate::can_frame::CanFrame;
use protocol::{Command, Elements, MAX_ELEMENT};

/// Where socketcand listens by default.
pub const DEFAULT_ADDRESS: &str = "127.0.0.1:29536";
/// The one bus that is served.
pub const BUS_NAME: &str = "can0";
/// Clients at a time.
pub const MAX_CLIENTS: usize = 16;
/// Bytes that may wait for a client: 15 s of all the board's frames.
pub const MAX_WAITING: usize = 256 * 1024;
/// Frames of one client that may wait for the bus; beyond that it is not read from, as a controller's full queue
/// refuses more.
pub const MAX_UNSENT: usize = 64;
/// In the board's time: a frame that has not been seen on the bus for so long no longer counts as waiting.
const FORGET_UNSENT_AFTER_S: f64 = 1.0;
/// python-can compares all that it has received with `< ok >`; a frame right behind it in the same segment would make it
/// give up. So the first frame is kept back for longer than a client needs to read the answer.
const QUIET_AFTER_MODE: Duration = Duration::from_millis(100);
/// Read from a client at a time.
const CHUNK: usize = 4096;

/// What a client has chosen.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Mode {
    NoBus,
    Bcm,
    Raw,
}

#[derive(Debug)]
struct Client {
    stream: TcpStream,
    peer: SocketAddr,
    mode: Mode,
    elements: Elements,
    outbox: Outbox,
    quiet_until: Option<Instant>,
    /// Own frames on their way to the bus, each with the board's time at which it was taken.
    unsent: VecDeque<(f64, CanFrame)>,
    /// Why the connection is to end.
    ending: Option<String>,
}

/// The server. It never waits: [`Server::poll`] and [`Server::publish`] do what can be done at once.
#[derive(Debug)]
pub struct Server {
    listener: TcpListener,
    clients: Vec<Client>,
    notices: Vec<String>,
    now_s: f64,
}

impl Server {
    /// Listens at `address`; port 0 is any free one.
    ///
    /// # Errors
    /// As the operating system says, with the address.
    pub fn bind(address: impl ToSocketAddrs) -> io::Result<Self> {
        let listener = TcpListener::bind(address)?;
        listener.set_nonblocking(true)?;
        Ok(Self {
            listener,
            clients: Vec::new(),
            notices: Vec::new(),
            now_s: 0.0,
        })
    }

    /// Where it listens.
    ///
    /// # Errors
    /// As the operating system says.
    pub fn local_addr(&self) -> io::Result<SocketAddr> {
        self.listener.local_addr()
    }

    /// Clients connected.
    pub fn clients(&self) -> usize {
        self.clients.len()
    }

    /// What an operator should know, since the last call: connections, clients dropped.
    pub fn take_notices(&mut self) -> Vec<String> {
        std::mem::take(&mut self.notices)
    }

    /// Accepts clients, answers their commands and returns the frames that they want sent, in the order of each client.
    pub fn poll(&mut self) -> Vec<CanFrame> {
        self.accept();
        let mut frames = Vec::new();
        for client in &mut self.clients {
            client.read(self.now_s, &mut frames);
            client.flush();
        }
        self.drop_ended();
        frames
    }

    /// A frame was on the bus and ended `at_s` after the board's power came on. Every client in RAW mode gets it but the
    /// one that had sent it, as with a socket of SocketCAN.
    pub fn publish(&mut self, at_s: f64, frame: &CanFrame) {
        self.now_s = at_s;
        let text = protocol::received(at_s, frame);
        for client in &mut self.clients {
            client
                .unsent
                .retain(|(taken_s, _)| at_s - taken_s <= FORGET_UNSENT_AFTER_S);
            let own = client.unsent.iter().position(|(_, sent)| sent == frame);
            if let Some(own) = own {
                client.unsent.remove(own);
            } else if client.listens() {
                client.say(&text);
                client.flush();
            }
        }
        self.drop_ended();
    }

    fn accept(&mut self) {
        loop {
            match self.listener.accept() {
                Ok((stream, peer)) => self.greet(stream, peer),
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) if error.kind() == ErrorKind::WouldBlock => return,
                // A client that was gone before it was accepted, or no more file descriptors: the next poll tries again.
                Err(error) => {
                    self.notices
                        .push(format!("CAN client not accepted: {error}"));
                    return;
                }
            }
        }
    }

    fn greet(&mut self, stream: TcpStream, peer: SocketAddr) {
        if let Err(error) = stream
            .set_nonblocking(true)
            .and_then(|()| stream.set_nodelay(true))
        {
            self.notices
                .push(format!("CAN client {peer} not accepted: {error}"));
            return;
        }
        let mut client = Client {
            stream,
            peer,
            mode: Mode::NoBus,
            elements: Elements::default(),
            outbox: Outbox::new(MAX_WAITING),
            quiet_until: None,
            unsent: VecDeque::new(),
            ending: None,
        };
        if self.clients.len() == MAX_CLIENTS {
            client.say("< error too many clients >");
            client.flush();
            self.notices.push(format!(
                "CAN client {peer} refused: {MAX_CLIENTS} are connected"
            ));
            return;
        }
        client.say("< hi >");
        client.flush();
        self.notices.push(format!("CAN client {peer} connected"));
        self.clients.push(client);
    }

    fn drop_ended(&mut self) {
        let notices = &mut self.notices;
        self.clients.retain(|client| match &client.ending {
            None => true,
            Some(why) => {
                notices.push(format!("CAN client {} {why}", client.peer));
                false
            }
        });
    }
}

impl Client {
    fn listens(&mut self) -> bool {
        if self
            .quiet_until
            .is_some_and(|until| Instant::now() >= until)
        {
            self.quiet_until = None;
        }
        self.mode == Mode::Raw && self.quiet_until.is_none()
    }

    fn say(&mut self, text: &str) {
        if self.ending.is_none() && self.outbox.push(text.as_bytes()).is_err() {
            self.ending = Some(format!(
                "dropped: it does not read, {} bytes wait",
                self.outbox.len()
            ));
        }
    }

    fn flush(&mut self) {
        if let Err(error) = self.outbox.flush(&mut self.stream) {
            self.end(format!("lost: {error}"));
        }
    }

    fn end(&mut self, why: String) {
        self.ending.get_or_insert(why);
    }

    fn read(&mut self, now_s: f64, frames: &mut Vec<CanFrame>) {
        self.obey(now_s, frames);
        // What is here and not obeyed waits for the bus: the client has to wait as well.
        if self.ending.is_some() || self.elements.len() >= MAX_ELEMENT {
            return;
        }
        let mut chunk = [0; CHUNK];
        match self.stream.read(&mut chunk) {
            Ok(0) => self.end("left".to_owned()),
            Ok(count) => {
                self.elements.push(&chunk[..count]);
                self.obey(now_s, frames);
            }
            Err(error)
                if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => {}
            Err(error) => self.end(format!("lost: {error}")),
        }
    }

    /// Carries out the commands that have come, until the bus has enough of them.
    fn obey(&mut self, now_s: f64, frames: &mut Vec<CanFrame>) {
        while self.ending.is_none() && self.unsent.len() < MAX_UNSENT {
            let Some(command) = self.elements.next() else {
                return;
            };
            match command.and_then(|command| self.carry_out(command)) {
                Ok(Some(frame)) => {
                    self.unsent.push_back((now_s, frame));
                    frames.push(frame);
                }
                Ok(None) => {}
                Err(reason) => self.say(&format!("< error {reason} >")),
            }
        }
    }

    /// Answers, or gives back the frame to be sent.
    fn carry_out(&mut self, command: Command) -> Result<Option<CanFrame>, &'static str> {
        match (self.mode, command) {
            (Mode::NoBus, Command::Open(name)) if name == BUS_NAME => {
                self.mode = Mode::Bcm;
                self.say("< ok >");
            }
            (Mode::NoBus, Command::Open(_)) => {
                // The protocol ends the connection here.
                self.say("< error could not open bus >");
                self.flush();
                self.end(format!("refused: it asked for another bus than {BUS_NAME}"));
            }
            (Mode::NoBus, _) => return Err("no bus is open"),
            (_, Command::Open(_)) => return Err("a bus is open already"),
            (_, Command::RawMode) => {
                self.mode = Mode::Raw;
                self.quiet_until = Instant::now().checked_add(QUIET_AFTER_MODE);
                self.say("< ok >");
            }
            (_, Command::BcmMode) => {
                self.mode = Mode::Bcm;
                self.say("< ok >");
            }
            (_, Command::Echo) => self.say("< echo >"),
            (_, Command::Send(frame)) => return Ok(Some(frame)),
        }
        Ok(None)
    }
}
