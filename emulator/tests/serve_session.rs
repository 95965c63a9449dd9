//! The session between clients and a board, over real sockets and a real terminal.

use std::fs::File;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use crate::serve_support::{FakeBoard, Fault, Running, options};
use emulator::can_frame::CanFrame;
use emulator::serve::{Board, Session};

/// Reads the map version: the example of a request in *MODBUS over Serial Line*, with this map's address. Its CRC and that
/// of the answer by an independent calculation.
const REQUEST: [u8; 8] = [0x01, 0x04, 0x00, 0x00, 0x00, 0x01, 0x31, 0xCA];
const ANSWER: [u8; 7] = [0x01, 0x04, 0x02, 0x02, 0x01, 0x79, 0x90];

fn tcp(running: &Running) -> TcpStream {
    let stream = TcpStream::connect(("127.0.0.1", running.rs485_port)).unwrap();
    stream
        .set_read_timeout(Some(Duration::from_secs(20)))
        .unwrap();
    stream
}

#[test]
fn a_request_is_answered_over_tcp_and_over_the_terminal() {
    let running = Running::start(|| FakeBoard::new(Fault::None), 5.0);
    let mut stream = tcp(&running);
    let mut terminal = File::options()
        .read(true)
        .write(true)
        .open(running.terminal.as_ref().unwrap())
        .unwrap();
    for _ in 0..3 {
        let mut answer = [0; ANSWER.len()];
        stream.write_all(&REQUEST).unwrap();
        stream.read_exact(&mut answer).unwrap();
        assert_eq!(answer, ANSWER);
        answer = [0; ANSWER.len()];
        terminal.write_all(&REQUEST).unwrap();
        terminal.read_exact(&mut answer).unwrap();
        assert_eq!(answer, ANSWER);
    }
    let summary = running.stop();
    assert_eq!(
        (summary.requests, summary.answered_bytes),
        (6, 6 * ANSWER.len() as u64)
    );
}

#[test]
fn nobody_s_answer_waits_for_the_next_client() {
    let running = Running::start(|| FakeBoard::new(Fault::None), 5.0);
    let mut first = tcp(&running);
    first.write_all(&REQUEST).unwrap();
    drop(first);
    // The request is carried out all the same; its answer has nobody to go to.
    std::thread::sleep(Duration::from_millis(300));
    let mut second = tcp(&running);
    let mut answer = [0; ANSWER.len()];
    second.write_all(&REQUEST).unwrap();
    second.read_exact(&mut answer).unwrap();
    assert_eq!(answer, ANSWER);
    second
        .set_read_timeout(Some(Duration::from_millis(50)))
        .unwrap();
    assert!(
        second.read(&mut answer).is_err(),
        "one answer to one request"
    );
}

/// A board that only notes what it is given.
#[derive(Default)]
struct Notes {
    now_us: u64,
    fails_at_us: Option<u64>,
    steps: Vec<u64>,
}

impl Board for Notes {
    fn run_for(&mut self, us: u64) -> anyhow::Result<()> {
        self.now_us += us;
        self.steps.push(us);
        match self.fails_at_us {
            Some(at_us) if at_us <= self.now_us => anyhow::bail!("the image has left the flash"),
            _ => Ok(()),
        }
    }
    fn now_s(&self) -> f64 {
        self.now_us as f64 / 1e6
    }
    fn inject_can(&mut self, _: CanFrame) {}
    fn take_can(&mut self) -> Vec<(f64, CanFrame)> {
        Vec::new()
    }
    fn inject_rs485(&mut self, _: &[u8]) {}
    fn take_rs485(&mut self) -> Vec<u8> {
        Vec::new()
    }
}

#[test]
fn it_ends_after_the_board_s_time_and_when_told() {
    let mut board = Notes::default();
    let mut session = Session::open(&options(100.0, Some(0.25))).unwrap();
    let never = AtomicBool::new(false);
    let summary = session.run(&mut board, &never, &mut |_| {}).unwrap();
    assert!((summary.board_s - 0.25).abs() < 1e-9, "{summary}");
    assert_eq!(board.now_us, 250_000);
    // Steps are short against the time-outs of any client.
    assert!(board.steps.iter().all(|us| *us <= 1_000));
    let told = AtomicBool::new(true);
    let summary = session.run(&mut board, &told, &mut |_| {}).unwrap();
    assert_eq!((summary.board_s, board.now_us), (0.0, 250_000));
}

#[test]
fn a_board_that_fails_ends_the_session_with_its_reason() {
    let mut board = Notes {
        fails_at_us: Some(5_000),
        ..Notes::default()
    };
    let mut session = Session::open(&options(100.0, Some(1.0))).unwrap();
    let error = session
        .run(&mut board, &AtomicBool::new(false), &mut |_| {})
        .unwrap_err();
    assert_eq!(error.to_string(), "the image has left the flash");
}

#[test]
fn an_address_in_use_is_named() {
    let session = Session::open(&options(1.0, None)).unwrap();
    let mut second = options(1.0, None);
    second.can = session.can_address();
    let error = Session::open(&second).err().unwrap();
    assert!(
        error
            .to_string()
            .contains(&session.can_address().to_string()),
        "{error}"
    );
    let places = session.places();
    assert_eq!(places.len(), 3);
    assert!(places[0].contains(&session.can_address().to_string()));
    assert!(places[1].contains(&session.rs485_address().to_string()));
    assert!(places[2].contains(session.terminal().unwrap()));
}
