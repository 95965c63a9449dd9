//! The running board for real clients: its CAN bus and its RS485 line over TCP and a pseudo-terminal, with its virtual time
//! held to the wall clock, so that the clients' time-outs mean what they say.
//!
//! This is the only part of the emulator that looks at a wall clock. What the board does depends on when a client's bytes
//! come; it is not the same on each run.

mod outbox;
mod rig;
pub mod rs485_port;
pub mod socketcand;

use std::fmt;
use std::io::{self, Write};
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context;
use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::flag;

use crate::can_frame::CanFrame;
use rs485_port::{BytePort, PseudoTerminal, TcpPort};

/// Virtual time between two looks at the clients.
const STEP_US: u64 = 1_000;
/// A request whose pieces come within this time, by the wall clock, goes to the line as one: neither TCP nor a terminal
/// keeps the gaps of a line, and 1.75 ms of silence would end the frame there.
const GATHER: Duration = Duration::from_millis(2);
/// The longest request that is waited for.
const MAX_GATHERED: usize = 4 * 256;
/// By so much the board may lag behind the wall clock, and catch up. What is beyond is given up.
const MAX_LAG: Duration = Duration::from_millis(250);
/// Longest sleep, so that clients and Ctrl-C are not kept waiting.
const MAX_SLEEP: Duration = Duration::from_millis(10);

/// The board as the session sees it.
pub trait Board {
    /// Runs it for `us` microseconds of its own time, or a few instructions more.
    ///
    /// # Errors
    /// What the emulation cannot go on from.
    fn run_for(&mut self, us: u64) -> anyhow::Result<()>;
    /// Its time since power came on, in seconds.
    fn now_s(&self) -> f64;
    /// Another node on the bus wants to send `frame`.
    fn inject_can(&mut self, frame: CanFrame);
    /// Every frame that was on the bus since the last call, whoever sent it (the injected ones too), with the time of its
    /// end in seconds.
    fn take_can(&mut self) -> Vec<(f64, CanFrame)>;
    /// A client sends `bytes` on the RS485 line, without gaps between them.
    fn inject_rs485(&mut self, bytes: &[u8]);
    /// What the board has sent on the RS485 line since the last call.
    fn take_rs485(&mut self) -> Vec<u8>;
}

/// What is offered, how fast and for how long.
#[derive(Clone, Debug, PartialEq, clap::Args)]
pub struct Options {
    /// Address of the CAN bus in the socketcand protocol (channel can0); port 0 is any free one
    #[arg(long, value_name = "ADDRESS", default_value = socketcand::DEFAULT_ADDRESS)]
    pub can: SocketAddr,
    /// Address of the RS485 line as Modbus RTU over TCP; port 0 is any free one
    #[arg(long, value_name = "ADDRESS", default_value = rs485_port::DEFAULT_ADDRESS)]
    pub rs485: SocketAddr,
    /// No pseudo-terminal for the RS485 line
    #[arg(long)]
    pub no_terminal: bool,
    /// Seconds of the board's time in one second of the wall clock
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, value_parser = speed)]
    pub speed: f64,
    /// Stop after so many seconds of the board's time instead of at Ctrl-C
    #[arg(long = "for", value_name = "SECONDS", value_parser = duration_s)]
    pub for_s: Option<f64>,
}

fn speed(text: &str) -> Result<f64, String> {
    text.parse()
        .ok()
        .filter(|speed| (0.01..=1000.0).contains(speed))
        .ok_or_else(|| "expected a number from 0.01 to 1000".to_owned())
}

fn duration_s(text: &str) -> Result<f64, String> {
    text.parse()
        .ok()
        .filter(|seconds: &f64| seconds.is_finite() && *seconds > 0.0)
        .ok_or_else(|| "expected a number of seconds above 0".to_owned())
}

/// What went through, and how well the wall clock was kept.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Summary {
    /// The board's time that was run, in seconds.
    pub board_s: f64,
    /// By the wall clock, in seconds.
    pub wall_s: f64,
    /// The board's time that could not be run in time and was given up, in seconds.
    pub behind_s: f64,
    /// Frames seen on the bus.
    pub frames: u64,
    /// Of those given in by clients.
    pub frames_from_clients: u64,
    /// Requests put on the RS485 line.
    pub requests: u64,
    /// Bytes that the board answered there.
    pub answered_bytes: u64,
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{:.1} s of the board's time in {:.1} s; CAN: {} frames, {} from clients; RS485: {} requests, {} bytes answered",
            self.board_s,
            self.wall_s,
            self.frames,
            self.frames_from_clients,
            self.requests,
            self.answered_bytes
        )?;
        if self.behind_s > 0.0 {
            write!(
                f,
                "; this machine is too slow for the speed asked for by {:.1} s",
                self.behind_s
            )?;
        }
        Ok(())
    }
}

/// A port of the RS485 line with the request that is coming in.
struct Line {
    port: Box<dyn BytePort + Send>,
    request: Vec<u8>,
    last_byte: Instant,
}

impl Line {
    /// The request that has come by `now`, when it is whole.
    fn gather(&mut self, now: Instant) -> Option<Vec<u8>> {
        let bytes = self.port.poll();
        if !bytes.is_empty() {
            self.request.extend(bytes);
            self.last_byte = now;
        }
        let whole = now.saturating_duration_since(self.last_byte) >= GATHER
            || self.request.len() >= MAX_GATHERED;
        (whole && !self.request.is_empty()).then(|| std::mem::take(&mut self.request))
    }
}

/// The board's time in step with the wall clock.
struct Pace {
    speed: f64,
    began: Instant,
    began_s: f64,
    behind_s: f64,
}

impl Pace {
    fn new(speed: f64, now: Instant, now_s: f64) -> Self {
        Self {
            speed,
            began: now,
            began_s: now_s,
            behind_s: 0.0,
        }
    }

    /// How long the board, at `now_s`, has to wait for the wall clock at `now`. Time that is not to be caught up any more
    /// is given up.
    fn wait(&mut self, now: Instant, now_s: f64) -> Duration {
        let wall_s = now.saturating_duration_since(self.began).as_secs_f64();
        let ahead_s = now_s - (self.began_s + wall_s * self.speed);
        if ahead_s / self.speed < -MAX_LAG.as_secs_f64() {
            self.behind_s -= ahead_s;
            (self.began, self.began_s) = (now, now_s);
        }
        Duration::try_from_secs_f64(ahead_s / self.speed).unwrap_or_default()
    }
}

/// The servers, tied to a board's time.
pub struct Session {
    can: socketcand::Server,
    can_address: SocketAddr,
    rs485_address: SocketAddr,
    terminal: Option<String>,
    lines: Vec<Line>,
    /// The line whose client has asked last: it gets what the board answers.
    asked: usize,
    speed: f64,
    for_s: Option<f64>,
    notices: Vec<String>,
}

impl Session {
    /// Opens what `options` offer. A machine without pseudo-terminals is told so and goes without.
    ///
    /// # Errors
    /// An address that cannot be listened at.
    pub fn open(options: &Options) -> anyhow::Result<Self> {
        let can = socketcand::Server::bind(options.can)
            .with_context(|| format!("offering the CAN bus at {}", options.can))?;
        let tcp = TcpPort::bind(options.rs485)
            .with_context(|| format!("offering the RS485 line at {}", options.rs485))?;
        let can_address = can.local_addr().context("asking for the CAN bus's port")?;
        let rs485_address = tcp.local_addr();
        let mut ports: Vec<Box<dyn BytePort + Send>> = vec![Box::new(tcp)];
        let mut notices = Vec::new();
        let mut terminal = None;
        if !options.no_terminal {
            match PseudoTerminal::open() {
                Ok(port) => {
                    terminal = Some(port.path().to_owned());
                    ports.push(Box::new(port));
                }
                Err(error) => notices.push(format!("no pseudo-terminal: {error}")),
            }
        }
        let now = Instant::now();
        Ok(Self {
            can,
            can_address,
            rs485_address,
            terminal,
            lines: ports
                .into_iter()
                .map(|port| Line {
                    port,
                    request: Vec::new(),
                    last_byte: now,
                })
                .collect(),
            asked: 0,
            speed: options.speed,
            for_s: options.for_s,
            notices,
        })
    }

    /// Where the CAN bus is offered.
    pub const fn can_address(&self) -> SocketAddr {
        self.can_address
    }

    /// Where the RS485 line is offered over TCP.
    pub const fn rs485_address(&self) -> SocketAddr {
        self.rs485_address
    }

    /// The RS485 line's pseudo-terminal.
    pub fn terminal(&self) -> Option<&str> {
        self.terminal.as_deref()
    }

    /// Where it listens, a line for each.
    pub fn places(&self) -> Vec<String> {
        let can = format!(
            "CAN: socketcand on {}, channel {}",
            self.can_address,
            socketcand::BUS_NAME
        );
        let lines = self
            .lines
            .iter()
            .map(|line| format!("RS485: {}", line.port.place()));
        std::iter::once(can).chain(lines).collect()
    }

    /// Runs `board` for its clients until `stop` is set or its time is over; `say` is given what an operator should know.
    ///
    /// # Errors
    /// What the emulation cannot go on from.
    pub fn run(
        &mut self,
        board: &mut dyn Board,
        stop: &AtomicBool,
        say: &mut dyn FnMut(&str),
    ) -> anyhow::Result<Summary> {
        let began = Instant::now();
        let began_s = board.now_s();
        let mut pace = Pace::new(self.speed, began, began_s);
        let mut summary = Summary::default();
        let mut told_slow = false;
        while !stop.load(Ordering::Relaxed)
            && self
                .for_s
                .is_none_or(|for_s| board.now_s() - began_s < for_s)
        {
            self.hear(board, &mut summary);
            let wait = pace.wait(Instant::now(), board.now_s());
            if wait.is_zero() {
                board.run_for(STEP_US)?;
                self.tell(board, &mut summary);
            } else {
                std::thread::sleep(wait.min(MAX_SLEEP));
            }
            if pace.behind_s > 0.0 && !told_slow {
                told_slow = true;
                say(
                    "this machine is too slow for the speed asked for: the board's time falls behind the wall clock",
                );
            }
            self.take_notices().iter().for_each(|notice| say(notice));
        }
        summary.board_s = board.now_s() - began_s;
        summary.wall_s = began.elapsed().as_secs_f64();
        summary.behind_s = pace.behind_s;
        Ok(summary)
    }

    /// From the clients to the board.
    fn hear(&mut self, board: &mut dyn Board, summary: &mut Summary) {
        for frame in self.can.poll() {
            summary.frames_from_clients += 1;
            board.inject_can(frame);
        }
        for (number, line) in self.lines.iter_mut().enumerate() {
            if let Some(request) = line.gather(Instant::now()) {
                summary.requests += 1;
                self.asked = number;
                board.inject_rs485(&request);
            }
        }
    }

    /// From the board to the clients.
    fn tell(&mut self, board: &mut dyn Board, summary: &mut Summary) {
        for (at_s, frame) in board.take_can() {
            summary.frames += 1;
            self.can.publish(at_s, &frame);
        }
        let answer = board.take_rs485();
        summary.answered_bytes += answer.len() as u64;
        if !answer.is_empty()
            && let Some(line) = self.lines.get_mut(self.asked)
        {
            line.port.send(&answer);
        }
    }

    fn take_notices(&mut self) -> Vec<String> {
        let mut notices = std::mem::take(&mut self.notices);
        notices.extend(self.can.take_notices());
        for line in &mut self.lines {
            notices.extend(line.port.take_notices());
        }
        notices
    }
}

/// Set by Ctrl-C or a request to terminate; the second one ends the process at once.
///
/// # Errors
/// As the operating system says.
pub fn stop_flag() -> io::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM] {
        // The order counts: the first signal finds the flag unset and sets it.
        flag::register_conditional_shutdown(signal, 128 + signal, Arc::clone(&stop))?;
        flag::register(signal, Arc::clone(&stop))?;
    }
    Ok(stop)
}

/// Offers `board` as `options` say, tells where on standard output, and runs until Ctrl-C or the end of its time.
///
/// # Errors
/// An address that cannot be listened at, and what the emulation cannot go on from.
pub fn serve(options: &Options, board: &mut dyn Board) -> anyhow::Result<Summary> {
    let mut session = Session::open(options)?;
    let stop = stop_flag().context("listening for Ctrl-C")?;
    let mut out = io::stdout();
    for place in session.places() {
        writeln!(out, "{place}")?;
    }
    match options.for_s {
        Some(for_s) => writeln!(out, "running for {for_s} s of the board's time")?,
        None => writeln!(out, "running until Ctrl-C")?,
    }
    // A client may wait for these lines.
    out.flush()?;
    let summary = session.run(board, &stop, &mut |notice| eprintln!("{notice}"))?;
    writeln!(out, "{summary}")?;
    Ok(summary)
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]
mod tests {
    use clap::{Args, Command, FromArgMatches};

    use super::*;

    fn options(arguments: &[&str]) -> Result<Options, clap::Error> {
        let command = Options::augment_args(Command::new("test").no_binary_name(true));
        Options::from_arg_matches(&command.try_get_matches_from(arguments)?)
    }

    #[test]
    fn options_have_their_defaults_and_their_limits() {
        let default = options(&[]).unwrap();
        assert_eq!(default.can.to_string(), "127.0.0.1:29536");
        assert_eq!(default.rs485.to_string(), "127.0.0.1:5020");
        assert_eq!((default.speed, default.for_s), (1.0, None));
        let given = options(&["--for", "2.5", "--speed", "0.5", "--can", "[::1]:0"]).unwrap();
        assert_eq!((given.speed, given.for_s), (0.5, Some(2.5)));
        for wrong in [
            ["--speed", "0"],
            ["--speed", "NaN"],
            ["--speed", "1001"],
            ["--for", "0"],
            ["--for", "inf"],
            ["--for", "-1"],
            ["--can", "localhost"],
        ] {
            assert!(options(&wrong).is_err(), "{wrong:?}");
        }
    }

    /// Gives a byte at each poll, as long as there are some.
    struct Trickle(u32);

    impl BytePort for Trickle {
        fn place(&self) -> String {
            String::new()
        }
        fn poll(&mut self) -> Vec<u8> {
            let some = self.0 > 0;
            self.0 = self.0.saturating_sub(1);
            if some { vec![7] } else { Vec::new() }
        }
        fn send(&mut self, _: &[u8]) {}
        fn take_notices(&mut self) -> Vec<String> {
            Vec::new()
        }
    }

    #[test]
    fn the_pieces_of_a_request_are_put_on_the_line_as_one() {
        let began = Instant::now();
        let at = |us: u64| began + Duration::from_micros(us);
        let line = |bytes| Line {
            port: Box::new(Trickle(bytes)),
            request: Vec::new(),
            last_byte: began,
        };
        let mut eight = line(8);
        // The last one comes at 13.3 ms.
        for piece in 0..8 {
            assert_eq!(eight.gather(at(1_900 * piece)), None);
        }
        assert_eq!(eight.gather(at(15_200)), None);
        assert_eq!(eight.gather(at(15_300)), Some(vec![7; 8]));
        assert_eq!(eight.gather(at(99_000)), None);
        // One that never ends does not grow for ever.
        let mut endless = line(u32::MAX);
        let taken = (0..).find_map(|us| endless.gather(at(us)));
        assert_eq!(taken.map(|request| request.len()), Some(MAX_GATHERED));
    }

    #[test]
    fn the_pace_is_the_wall_clock_s_times_the_speed() {
        let began = Instant::now();
        let at = |s: f64| began + Duration::from_secs_f64(s);
        let mut pace = Pace::new(2.0, began, 10.0);
        // Two seconds of the board's time take one.
        assert_eq!(pace.wait(at(0.0), 12.0), Duration::from_secs(1));
        assert_eq!(pace.wait(at(0.75), 12.0), Duration::from_millis(250));
        assert_eq!(pace.wait(at(1.0), 12.0), Duration::ZERO);
        // 0.2 s late is caught up: at 1.2 s the board should be at 12.4 s.
        assert_eq!(pace.wait(at(1.2), 12.0), Duration::ZERO);
        assert_eq!((pace.behind_s, pace.began), (0.0, began));
        assert!(pace.wait(at(1.2), 12.5) > Duration::from_millis(49));
        // 1 s late is not: 2 s of the board's time are given up, and the pace begins anew from there.
        assert_eq!(pace.wait(at(2.2), 12.4), Duration::ZERO);
        assert!((pace.behind_s - 2.0).abs() < 1e-6);
        assert_eq!(pace.wait(at(2.2), 12.5), Duration::from_millis(50));
    }
}
