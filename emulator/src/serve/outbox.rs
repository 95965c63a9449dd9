//! Bytes that wait for a client who has not read the ones before.

use std::io::{self, ErrorKind, Write};

/// A bounded queue before a socket or terminal that does not block.
#[derive(Debug)]
pub(super) struct Outbox {
    waiting: Vec<u8>,
    limit: usize,
}

/// The queue is full: the client does not read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Full;

impl Outbox {
    /// For at most `limit` bytes.
    pub(super) const fn new(limit: usize) -> Self {
        Self {
            waiting: Vec::new(),
            limit,
        }
    }

    /// Appends `bytes` whole or not at all.
    pub(super) fn push(&mut self, bytes: &[u8]) -> Result<(), Full> {
        if self.waiting.len() + bytes.len() > self.limit {
            return Err(Full);
        }
        self.waiting.extend_from_slice(bytes);
        Ok(())
    }

    /// Bytes that wait.
    pub(super) fn len(&self) -> usize {
        self.waiting.len()
    }

    /// Forgets what waits.
    pub(super) fn clear(&mut self) {
        self.waiting.clear();
    }

    /// Writes as much as `to` takes without waiting.
    pub(super) fn flush(&mut self, to: &mut impl Write) -> io::Result<()> {
        let mut written = 0;
        let result = loop {
            if written == self.waiting.len() {
                break Ok(());
            }
            match to.write(&self.waiting[written..]) {
                Ok(0) => break Err(ErrorKind::WriteZero.into()),
                Ok(count) => written += count,
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) if error.kind() == ErrorKind::WouldBlock => break Ok(()),
                Err(error) => break Err(error),
            }
        };
        self.waiting.drain(..written);
        result
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Takes at most so many bytes at each write and waits when its room is used up.
    struct Narrow {
        taken: Vec<u8>,
        each: usize,
        room: usize,
    }

    impl Write for Narrow {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            let count = bytes.len().min(self.each).min(self.room);
            if count == 0 {
                return Err(ErrorKind::WouldBlock.into());
            }
            self.room -= count;
            self.taken.extend_from_slice(&bytes[..count]);
            Ok(count)
        }
        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    proptest! {
        #[test]
        fn every_accepted_byte_is_written_once_and_in_order(
            pieces in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..20), 0..30),
            rooms in prop::collection::vec((1usize..7, 0usize..30), 30),
            limit in 1usize..60,
        ) {
            let mut outbox = Outbox::new(limit);
            let mut expected = Vec::new();
            let mut to = Narrow { taken: Vec::new(), each: 1, room: 0 };
            for (piece, (each, room)) in pieces.iter().zip(rooms) {
                let before = outbox.len();
                match outbox.push(piece) {
                    Ok(()) => expected.extend_from_slice(piece),
                    Err(Full) => prop_assert!(before + piece.len() > limit),
                }
                prop_assert!(outbox.len() <= limit);
                (to.each, to.room) = (each, room);
                outbox.flush(&mut to).unwrap();
            }
            (to.each, to.room) = (5, usize::MAX);
            outbox.flush(&mut to).unwrap();
            prop_assert_eq!(to.taken, expected);
            prop_assert_eq!(outbox.len(), 0);
        }
    }
}
