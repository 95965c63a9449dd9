//! The board's RS485 line as a byte stream: over TCP and as a pseudo-terminal.
//!
//! Both carry the characters of Modbus RTU as they are, address to CRC. Neither has a baud rate; the line of the board has
//! its own, and its characters come as they end there.

use std::fs::File;
use std::io::{self, ErrorKind, Read};
use std::net::{SocketAddr, TcpListener, TcpStream, ToSocketAddrs};

use rustix::fs::{OFlags, fcntl_getfl, fcntl_setfl};
use rustix::pty::OpenptFlags;
use rustix::termios::OptionalActions;

use super::outbox::Outbox;

/// Where Modbus RTU over TCP listens by default.
pub const DEFAULT_ADDRESS: &str = "127.0.0.1:5020";
/// Bytes that may wait for a client: 16 of the longest frames.
pub const MAX_WAITING: usize = 16 * 256;
/// Read at a time.
const CHUNK: usize = 1024;

/// One end of a serial line, at which a Modbus client sits.
pub trait BytePort {
    /// How a client reaches it.
    fn place(&self) -> String;
    /// Bytes from the client; nothing is waited for.
    fn poll(&mut self) -> Vec<u8>;
    /// Bytes to the client; without one they are lost, as on a line to which nobody listens.
    fn send(&mut self, bytes: &[u8]);
    /// What an operator should know, since the last call.
    fn take_notices(&mut self) -> Vec<String>;
}

/// The line over TCP, for one client at a time: a line has one Modbus client, and two would answer for each other.
#[derive(Debug)]
pub struct TcpPort {
    listener: TcpListener,
    address: SocketAddr,
    client: Option<(TcpStream, SocketAddr)>,
    outbox: Outbox,
    notices: Vec<String>,
}

impl TcpPort {
    /// Listens at `address`; port 0 is any free one.
    ///
    /// # Errors
    /// As the operating system says.
    pub fn bind(address: impl ToSocketAddrs) -> io::Result<Self> {
        let listener = TcpListener::bind(address)?;
        listener.set_nonblocking(true)?;
        Ok(Self {
            address: listener.local_addr()?,
            listener,
            client: None,
            outbox: Outbox::new(MAX_WAITING),
            notices: Vec::new(),
        })
    }

    /// Where it listens.
    pub const fn local_addr(&self) -> SocketAddr {
        self.address
    }

    fn accept(&mut self) {
        loop {
            match self.listener.accept() {
                Ok((stream, peer)) if self.client.is_none() => {
                    match stream
                        .set_nonblocking(true)
                        .and_then(|()| stream.set_nodelay(true))
                    {
                        Ok(()) => {
                            self.notices.push(format!("Modbus client {peer} connected"));
                            self.outbox.clear();
                            self.client = Some((stream, peer));
                        }
                        Err(error) => self
                            .notices
                            .push(format!("Modbus client {peer} not accepted: {error}")),
                    }
                }
                Ok((_, peer)) => self.notices.push(format!(
                    "Modbus client {peer} refused: another one is on the line"
                )),
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) if error.kind() == ErrorKind::WouldBlock => return,
                Err(error) => {
                    self.notices
                        .push(format!("Modbus client not accepted: {error}"));
                    return;
                }
            }
        }
    }

    fn end(&mut self, why: &str) {
        if let Some((_, peer)) = self.client.take() {
            self.notices.push(format!("Modbus client {peer} {why}"));
        }
    }

    fn flush(&mut self) {
        if let Some((stream, _)) = &mut self.client
            && let Err(error) = self.outbox.flush(stream)
        {
            self.end(&format!("lost: {error}"));
        }
    }
}

impl BytePort for TcpPort {
    fn place(&self) -> String {
        format!("Modbus RTU over TCP on {}", self.address)
    }

    fn poll(&mut self) -> Vec<u8> {
        let mut received = Vec::new();
        // The client there is read before another is looked at: a place that has become free is taken at once.
        if let Some((stream, _)) = &mut self.client {
            let mut chunk = [0; CHUNK];
            match stream.read(&mut chunk) {
                Ok(0) => self.end("left"),
                Ok(count) => received.extend_from_slice(&chunk[..count]),
                Err(error)
                    if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => {}
                Err(error) => self.end(&format!("lost: {error}")),
            }
        }
        self.accept();
        self.flush();
        received
    }

    fn send(&mut self, bytes: &[u8]) {
        if self.client.is_none() {
            return;
        }
        if self.outbox.push(bytes).is_err() {
            self.end("dropped: it does not read");
        }
        self.flush();
    }

    fn take_notices(&mut self) -> Vec<String> {
        std::mem::take(&mut self.notices)
    }
}

/// The line as a terminal of this machine, for clients that open a serial port. It is raw whatever opens it, and it stays
/// when a client closes it.
///
/// Linux gives a pseudo-terminal no parity bit, and refuses a client that insists on one: such a client is told "no parity".
#[derive(Debug)]
pub struct PseudoTerminal {
    controller: File,
    path: String,
    /// Held open, so that reading does not fail while no client has it open.
    _user: File,
    outbox: Outbox,
    notices: Vec<String>,
}

impl PseudoTerminal {
    /// A new one.
    ///
    /// # Errors
    /// As the operating system says: none is free, or this machine has none.
    pub fn open() -> io::Result<Self> {
        let controller =
            rustix::pty::openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
        rustix::pty::grantpt(&controller)?;
        rustix::pty::unlockpt(&controller)?;
        let name = rustix::pty::ptsname(&controller, Vec::new())?;
        let path = name
            .into_string()
            .map_err(|error| io::Error::new(ErrorKind::InvalidData, error))?;
        let user = rustix::fs::open(
            path.as_str(),
            OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC,
            rustix::fs::Mode::empty(),
        )?;
        let mut settings = rustix::termios::tcgetattr(&user)?;
        settings.make_raw();
        rustix::termios::tcsetattr(&user, OptionalActions::Now, &settings)?;
        fcntl_setfl(&controller, fcntl_getfl(&controller)? | OFlags::NONBLOCK)?;
        Ok(Self {
            controller: File::from(controller),
            path,
            _user: File::from(user),
            outbox: Outbox::new(MAX_WAITING),
            notices: Vec::new(),
        })
    }

    /// The device that a client opens.
    pub fn path(&self) -> &str {
        &self.path
    }

    fn flush(&mut self) {
        if let Err(error) = self.outbox.flush(&mut self.controller) {
            self.outbox.clear();
            self.notices.push(format!("{}: {error}", self.path));
        }
    }
}

impl BytePort for PseudoTerminal {
    fn place(&self) -> String {
        format!("Modbus RTU on {} (no parity to be set)", self.path)
    }

    fn poll(&mut self) -> Vec<u8> {
        self.flush();
        let mut chunk = [0; CHUNK];
        match self.controller.read(&mut chunk) {
            Ok(count) => chunk[..count].to_vec(),
            Err(error)
                if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) =>
            {
                Vec::new()
            }
            Err(error) => {
                self.notices.push(format!("{}: {error}", self.path));
                Vec::new()
            }
        }
    }

    fn send(&mut self, bytes: &[u8]) {
        if self.outbox.push(bytes).is_err() {
            // Nobody has read for many answers: what waits answers nobody's question any more.
            self.outbox.clear();
            self.notices
                .push(format!("{}: nobody reads, answers lost", self.path));
        }
        self.flush();
    }

    fn take_notices(&mut self) -> Vec<String> {
        std::mem::take(&mut self.notices)
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]
mod tests {
    use std::io::Write;
    use std::time::{Duration, Instant};

    use super::*;

    fn until<T>(mut attempt: impl FnMut() -> Option<T>) -> T {
        let end = Instant::now() + Duration::from_secs(10);
        loop {
            if let Some(result) = attempt() {
                return result;
            }
            assert!(Instant::now() < end, "nothing came");
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    fn received(port: &mut dyn BytePort, count: usize) -> Vec<u8> {
        let mut all = Vec::new();
        until(|| {
            all.extend(port.poll());
            (all.len() >= count).then_some(())
        });
        all
    }

    /// Every byte value: nothing is translated, neither line ends nor flow control nor signals.
    fn every_byte() -> Vec<u8> {
        (0..=u8::MAX).collect()
    }

    #[test]
    fn tcp_carries_every_byte_both_ways() {
        let mut port = TcpPort::bind("127.0.0.1:0").unwrap();
        port.send(b"to nobody");
        let mut client = TcpStream::connect(port.local_addr()).unwrap();
        client.write_all(&every_byte()).unwrap();
        assert_eq!(received(&mut port, 256), every_byte());
        port.send(&every_byte());
        let mut back = [0; 256];
        client.read_exact(&mut back).unwrap();
        assert_eq!(back.to_vec(), every_byte());
    }

    #[test]
    fn tcp_has_one_client_and_takes_the_next_when_it_left() {
        let mut port = TcpPort::bind("127.0.0.1:0").unwrap();
        let first = TcpStream::connect(port.local_addr()).unwrap();
        until(|| {
            port.poll();
            port.client.is_some().then_some(())
        });
        let mut second = TcpStream::connect(port.local_addr()).unwrap();
        until(|| {
            port.poll();
            port.take_notices()
                .iter()
                .any(|notice| notice.contains("refused"))
                .then_some(())
        });
        assert_eq!(second.read(&mut [0; 1]).unwrap(), 0, "closed");
        drop(first);
        until(|| {
            port.poll();
            port.client.is_none().then_some(())
        });
        let mut third = TcpStream::connect(port.local_addr()).unwrap();
        third.write_all(b"abc").unwrap();
        assert_eq!(received(&mut port, 3), b"abc");
    }

    #[test]
    fn a_client_that_does_not_read_is_dropped() {
        let mut port = TcpPort::bind("127.0.0.1:0").unwrap();
        let _client = TcpStream::connect(port.local_addr()).unwrap();
        until(|| {
            port.poll();
            port.client.is_some().then_some(())
        });
        until(|| {
            for _ in 0..1000 {
                port.send(&[0; 256]);
            }
            port.client.is_none().then_some(())
        });
        assert!(
            port.take_notices()
                .iter()
                .any(|notice| notice.contains("does not read"))
        );
    }

    #[test]
    fn a_terminal_carries_every_byte_both_ways_and_outlives_its_clients() {
        let mut port = PseudoTerminal::open().unwrap();
        for _ in 0..2 {
            let mut client = File::options()
                .read(true)
                .write(true)
                .open(port.path())
                .unwrap();
            client.write_all(&every_byte()).unwrap();
            assert_eq!(received(&mut port, 256), every_byte());
            port.send(&every_byte());
            let mut back = [0; 256];
            client.read_exact(&mut back).unwrap();
            assert_eq!(back.to_vec(), every_byte());
            drop(client);
            assert!(port.poll().is_empty());
        }
        assert_eq!(port.take_notices(), Vec::<String>::new());
    }

    #[test]
    fn a_terminal_that_nobody_reads_does_not_stop_the_board() {
        let mut port = PseudoTerminal::open().unwrap();
        for _ in 0..1000 {
            port.send(&[0x55; 256]);
        }
        assert!(port.outbox.len() <= MAX_WAITING);
        assert!(
            port.take_notices()
                .iter()
                .any(|notice| notice.contains("nobody reads"))
        );
    }
}
