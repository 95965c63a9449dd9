//! Modbus RTU framing as a state machine over (character, time, line errors), after *MODBUS over Serial Line V1.02*.
//!
//! At 115,200 baud the standard fixes the silence that ends a frame at 1.75 ms (above 19,200 baud it no longer follows
//! the character time). Time stamps are those of a character's end.
//!
//! - A gap of more than 1.5 characters (0.75 ms) inside a frame is **tolerated and counted**: USB adapters and
//!   multitasking hosts make such gaps, and the CRC-16 still refuses a frame that two halves do not make up.
//! - A parity, framing, noise or overrun error, or a 257th character, spoils the whole frame: everything up to the next
//!   silence is discarded.
//! - A frame that was cut short, has a wrong CRC or another server's address gets no answer and changes nothing. Address
//!   0 is a broadcast: carried out, never answered.
//! - After start-up nothing is a frame until the line has been silent once.

use crc::{CRC_16_MODBUS, Crc, NoTable};
use heapless::Vec;
use serde::{Deserialize, Serialize};

use crate::configuration::ConfigurationStore;
use crate::design_parameters::{
    MODBUS_CHARACTER_GAP_US, MODBUS_CHARACTER_US, MODBUS_FRAME_SILENCE_US,
};
use crate::modbus::{self, Event, Exception, Readings};
use crate::units::{Duration, Instant, elapsed};

/// Longest frame on the line: address, 253 bytes of request, CRC.
pub const MAX_FRAME: usize = 256;
/// The address that every server obeys and none answers.
pub const BROADCAST: u8 = 0;

const SILENCE: Duration = Duration::from_ticks(MODBUS_FRAME_SILENCE_US);
/// From the end of one character to the end of the next when the line was silent for `SILENCE` between them.
const SILENCE_AND_CHARACTER: Duration =
    Duration::from_ticks(MODBUS_FRAME_SILENCE_US + MODBUS_CHARACTER_US);
const GAP_AND_CHARACTER: Duration =
    Duration::from_ticks(MODBUS_CHARACTER_GAP_US + MODBUS_CHARACTER_US);
/// Without a table: 512 bytes of flash for a tenth of a millisecond per frame are not worth it.
const CRC: Crc<u16, NoTable> = Crc::<u16, NoTable>::new(&CRC_16_MODBUS);

/// The board on the RS485 line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RtuConfig {
    /// Server address, 1 to 247.
    pub address: u8,
    /// Silence before an answer, in microseconds, for a client that is slow to release the line; never less than the
    /// 1.75 ms that end the request.
    pub turnaround_us: u16,
}

impl Default for RtuConfig {
    fn default() -> Self {
        Self {
            address: 1,
            turnaround_us: 2_000,
        }
    }
}

/// What the UART saw wrong with a character.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LineErrors {
    /// The even parity did not fit.
    pub parity: bool,
    /// No stop bit.
    pub framing: bool,
    /// The samples of a bit disagreed.
    pub noise: bool,
    /// A character before this one was lost.
    pub overrun: bool,
}

impl LineErrors {
    /// A good character.
    pub const NONE: Self = Self {
        parity: false,
        framing: false,
        noise: false,
        overrun: false,
    };

    /// Whether anything was wrong.
    #[must_use]
    pub const fn any(self) -> bool {
        self.parity || self.framing || self.noise || self.overrun
    }
}

/// What happened on the line since the start; each stops at its end. The first six are those of function 08 of the
/// *MODBUS Application Protocol V1.1b3*.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Frames with a right CRC, whatever their address.
    pub messages: u32,
    /// Frames discarded: CRC, character errors, too short, too long.
    pub communication_errors: u32,
    /// Exceptions answered.
    pub exceptions: u32,
    /// Frames for this server, broadcasts included.
    pub server_messages: u32,
    /// Frames for this server that got no answer: broadcasts.
    pub no_responses: u32,
    /// Frames lost because characters came faster than they were fetched.
    pub character_overruns: u32,
    /// Exceptions 06 among the exceptions.
    pub busy: u32,
    /// Whole frames that the next one overran before they were looked at.
    pub missed: u32,
    /// Gaps of more than 1.5 characters inside a frame, tolerated.
    pub character_gaps: u32,
}

#[inline(never)]
fn count(counter: &mut u32) {
    *counter = counter.saturating_add(1);
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// The frame is spoiled: wait for silence.
    Discarding,
    /// The next character begins a frame.
    Idle,
    Receiving,
}

/// A request that passed the frame's checks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Request<'a> {
    /// To be carried out without an answer.
    pub broadcast: bool,
    /// Function code and data.
    pub pdu: &'a [u8],
}

/// Puts characters together into frames.
#[derive(Clone, Debug)]
pub struct Receiver {
    buffer: Vec<u8, MAX_FRAME>,
    state: State,
    last: Instant,
    counters: Counters,
}

impl Receiver {
    /// Started at `now`, in the middle of whatever is on the line.
    #[must_use]
    pub const fn new(now: Instant) -> Self {
        Self {
            buffer: Vec::new(),
            state: State::Discarding,
            last: now,
            counters: Counters {
                messages: 0,
                communication_errors: 0,
                exceptions: 0,
                server_messages: 0,
                no_responses: 0,
                character_overruns: 0,
                busy: 0,
                missed: 0,
                character_gaps: 0,
            },
        }
    }

    /// What happened so far.
    #[must_use]
    pub const fn counters(&self) -> &Counters {
        &self.counters
    }

    /// A character whose end was at `now`.
    pub fn on_character(&mut self, byte: u8, errors: LineErrors, now: Instant) {
        let since = elapsed(self.last, now);
        self.last = now;
        if since >= SILENCE_AND_CHARACTER {
            if self.state == State::Receiving {
                count(&mut self.counters.missed);
            }
            self.state = State::Idle;
        }
        match self.state {
            State::Discarding => return,
            State::Idle => {
                self.buffer.clear();
                self.state = State::Receiving;
            }
            State::Receiving => {
                if since > GAP_AND_CHARACTER {
                    count(&mut self.counters.character_gaps);
                }
            }
        }
        if errors.overrun {
            count(&mut self.counters.character_overruns);
        }
        if errors.any() || self.buffer.push(byte).is_err() {
            count(&mut self.counters.communication_errors);
            self.state = State::Discarding;
        }
    }

    /// When the frame under way will have ended, unless another character comes: the time to call
    /// [`Receiver::take`] again. `None` while nothing is under way.
    #[must_use]
    pub fn ends_at(&self) -> Option<Instant> {
        match self.state {
            State::Idle => None,
            State::Receiving | State::Discarding => self.last.checked_add_duration(SILENCE),
        }
    }

    /// The frame that has ended by `now`, if it is whole and for `address` or for everyone.
    pub fn take(&mut self, address: u8, now: Instant) -> Option<Request<'_>> {
        if elapsed(self.last, now) < SILENCE {
            return None;
        }
        let ended = self.state == State::Receiving;
        self.state = State::Idle;
        if !ended {
            return None;
        }
        let Some((frame, pdu)) = checked(&self.buffer) else {
            count(&mut self.counters.communication_errors);
            return None;
        };
        count(&mut self.counters.messages);
        let broadcast = frame == BROADCAST;
        if !broadcast && frame != address {
            return None;
        }
        count(&mut self.counters.server_messages);
        Some(Request { broadcast, pdu })
    }
}

/// Address and request of a frame whose CRC is right.
fn checked(frame: &[u8]) -> Option<(u8, &[u8])> {
    let [address, pdu @ .., _, _] = frame else {
        return None;
    };
    // The CRC of a frame that ends with its own is 0.
    (!pdu.is_empty() && CRC.checksum(frame) == 0).then_some((*address, pdu))
}

/// What came of a request.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Served<'a> {
    /// The frame to send, and the earliest time for its first bit; `None` after a broadcast.
    pub reply: Option<(&'a [u8], Instant)>,
    /// What the firmware has to do.
    pub event: Option<Event>,
}

/// The Modbus RTU server: receiver, register map and answer.
#[derive(Clone, Debug)]
pub struct Server {
    receiver: Receiver,
    reply: Vec<u8, MAX_FRAME>,
}

impl Server {
    /// Started at `now`.
    #[must_use]
    pub const fn new(now: Instant) -> Self {
        Self {
            receiver: Receiver::new(now),
            reply: Vec::new(),
        }
    }

    /// What happened on the line so far.
    #[must_use]
    pub const fn counters(&self) -> &Counters {
        self.receiver.counters()
    }

    /// See [`Receiver::on_character`].
    pub fn on_character(&mut self, byte: u8, errors: LineErrors, now: Instant) {
        self.receiver.on_character(byte, errors, now);
    }

    /// See [`Receiver::ends_at`].
    #[must_use]
    pub fn ends_at(&self) -> Option<Instant> {
        self.receiver.ends_at()
    }

    /// Carries out the request that has ended by `now`, if there is one for this board.
    pub fn serve(
        &mut self,
        now: Instant,
        readings: &Readings,
        store: &mut ConfigurationStore,
    ) -> Option<Served<'_>> {
        let config = store.active().rtu;
        let request = self.receiver.take(config.address, now)?;
        let broadcast = request.broadcast;
        self.reply.clear();
        // Each push fits: the answer's data is at most 253 bytes by the limits of the map.
        let _ = self.reply.push(config.address);
        let outcome = modbus::handle(request.pdu, readings, store, &mut self.reply);
        let counters = &mut self.receiver.counters;
        if broadcast {
            count(&mut counters.no_responses);
            return Some(Served {
                reply: None,
                event: outcome.event,
            });
        }
        if let Some(exception) = outcome.exception {
            count(&mut counters.exceptions);
            if exception == Exception::ServerDeviceBusy {
                count(&mut counters.busy);
            }
        }
        self.finish();
        let silence = SILENCE.max(Duration::from_ticks(u64::from(config.turnaround_us)));
        Some(Served {
            reply: Some((
                &self.reply,
                self.receiver
                    .last
                    .checked_add_duration(silence)
                    .unwrap_or(now),
            )),
            event: outcome.event,
        })
    }

    /// The frame to send, as [`Server::serve`] and [`Server::refuse`] have left it.
    #[must_use]
    pub fn reply(&self) -> &[u8] {
        &self.reply
    }

    /// Turns the answer to the command that was just served into exception 04: its order was refused at once.
    pub fn refuse(&mut self) {
        // Address and function code stay.
        self.reply.truncate(2);
        if let Some(function) = self.reply.last_mut() {
            *function |= 0x80;
        }
        let _ = self.reply.push(Exception::ServerDeviceFailure as u8);
        self.finish();
        count(&mut self.receiver.counters.exceptions);
    }

    #[inline(never)]
    fn finish(&mut self) {
        let crc = CRC.checksum(&self.reply).to_le_bytes();
        let _ = self.reply.extend_from_slice(&crc);
    }
}

#[cfg(test)]
#[allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss
)]
mod tests {
    use super::*;
    use crate::configuration::Configuration;
    use crate::modbus::{Activity, Command};
    use proptest::prelude::*;
    use std::vec::Vec as Bytes;

    /// The answer with the earliest time for it, and the event.
    type Answer = (Option<(Bytes<u8>, u64)>, Option<Event>);

    /// A line with a clock that stands at the end of the last character.
    struct Line {
        server: Server,
        store: ConfigurationStore,
        readings: Readings,
        now: u64,
    }

    impl Line {
        fn new() -> Self {
            let mut line = Self {
                server: Server::new(Instant::from_ticks(0)),
                store: ConfigurationStore::default(),
                readings: Readings::default(),
                now: 0,
            };
            line.silence(1_750);
            line
        }

        fn at(&self) -> Instant {
            Instant::from_ticks(self.now)
        }

        /// A character after `gap` µs of silence.
        fn character(&mut self, byte: u8, errors: LineErrors, gap: u64) {
            self.now += gap + MODBUS_CHARACTER_US;
            let now = self.at();
            self.server.on_character(byte, errors, now);
        }

        fn bytes(&mut self, bytes: &[u8]) {
            for byte in bytes {
                self.character(*byte, LineErrors::NONE, 0);
            }
        }

        fn silence(&mut self, us: u64) -> Option<Answer> {
            self.now += us;
            let now = self.at();
            self.server
                .serve(now, &self.readings, &mut self.store)
                .map(|served| {
                    (
                        served
                            .reply
                            .map(|(reply, not_before)| (reply.to_vec(), not_before.as_ticks())),
                        served.event,
                    )
                })
        }

        /// The answer to a frame, or nothing.
        fn send(&mut self, frame: &[u8]) -> Option<Bytes<u8>> {
            self.bytes(frame);
            self.silence(1_750)?.0.map(|(reply, _)| reply)
        }

        fn untouched(&self) -> bool {
            *self.store.active() == Configuration::default() && self.store.generation() == 0
        }
    }

    fn framed(body: &[u8]) -> Bytes<u8> {
        let mut frame = body.to_vec();
        frame.extend(CRC.checksum(body).to_le_bytes());
        frame
    }

    /// Sets the Modbus address to 5.
    fn write() -> Bytes<u8> {
        framed(&[1, 6, 9, 0, 0, 5])
    }

    #[test]
    fn the_timing_is_the_standard_s() {
        assert_eq!(CRC.checksum(b"123456789"), 0x4B37);
        assert_eq!((MODBUS_CHARACTER_US, SILENCE.as_ticks()), (96, 1_750));
        assert_eq!(GAP_AND_CHARACTER.as_ticks(), 846);
        assert_eq!(SILENCE_AND_CHARACTER.as_ticks(), 1_846);
    }

    /// Function 0x06 or 0x10: the order was carried out to no effect, and the client is told.
    #[test]
    fn an_order_that_is_refused_at_once_is_answered_by_an_exception() {
        let [high, low] = Command::ZeroNow.register().to_be_bytes();
        let single = framed(&[1, 6, 0, 0, high, low]);
        let multiple = framed(&[1, 0x10, 0, 0, 0, 1, 2, high, low]);
        for (request, function) in [(single, 0x86), (multiple, 0x90)] {
            let mut line = Line::new();
            line.bytes(&request);
            let (reply, event) = line.silence(1_750).unwrap();
            assert_eq!(event, Some(Event::Command(Command::ZeroNow)));
            assert_eq!(line.server.reply(), reply.unwrap().0);
            assert_eq!(line.server.counters().exceptions, 0);
            line.server.refuse();
            assert_eq!(line.server.reply(), framed(&[1, function, 4]));
            let counters = line.server.counters();
            assert_eq!((counters.exceptions, counters.busy), (1, 0));
        }
    }

    #[test]
    fn a_request_is_answered_after_silence() {
        let mut line = Line::new();
        line.readings.uptime_s = 0x0102_0304;
        line.bytes(&framed(&[1, 4, 0, 0x0E, 0, 2]));
        let end = line.now;
        assert_eq!(
            line.server.ends_at(),
            Some(Instant::from_ticks(end + 1_750))
        );
        assert_eq!(line.silence(1_749), None);
        let (reply, event) = line.silence(1).unwrap();
        // The turnaround of 2 ms is counted from the request's end.
        assert_eq!(reply, Some((framed(&[1, 4, 4, 1, 2, 3, 4]), end + 2_000)));
        assert_eq!(event, None);
        assert_eq!(line.server.ends_at(), None);
        assert_eq!(line.silence(5_000), None);
        let counters = *line.server.counters();
        assert_eq!(
            counters,
            Counters {
                messages: 1,
                server_messages: 1,
                ..Counters::default()
            }
        );
    }

    #[test]
    fn an_answer_never_comes_before_the_silence() {
        let mut line = Line::new();
        let mut staged = *line.store.active();
        staged.rtu.turnaround_us = 0;
        line.store.commit(staged).unwrap();
        line.bytes(&framed(&[1, 3, 0, 0, 0, 1]));
        let end = line.now;
        let (reply, _) = line.silence(9_000).unwrap();
        assert_eq!(reply, Some((framed(&[1, 3, 2, 0, 0]), end + 1_750)));
    }

    #[test]
    fn a_write_reports_its_event_and_answers_from_the_old_address() {
        let mut line = Line::new();
        line.bytes(&write());
        let (reply, event) = line.silence(1_750).unwrap();
        assert_eq!(reply.unwrap().0, write());
        assert_eq!(event, Some(Event::ConfigurationChanged));
        assert_eq!(line.store.active().rtu.address, 5);
        // From now on it is server 5.
        assert_eq!(line.send(&framed(&[1, 3, 9, 0, 0, 1])), None);
        assert_eq!(
            line.send(&framed(&[5, 3, 9, 0, 0, 1])),
            Some(framed(&[5, 3, 2, 0, 5]))
        );
        let counters = line.server.counters();
        assert_eq!((counters.messages, counters.server_messages), (3, 2));
    }

    #[test]
    fn a_broadcast_is_carried_out_without_an_answer() {
        let mut line = Line::new();
        line.bytes(&framed(&[0, 6, 9, 0, 0, 5]));
        assert_eq!(
            line.silence(1_750),
            Some((None, Some(Event::ConfigurationChanged)))
        );
        assert_eq!(line.store.active().rtu.address, 5);
        // Neither is an exception.
        line.bytes(&framed(&[0, 6, 9, 0, 0, 0]));
        assert_eq!(line.silence(1_750), Some((None, None)));
        let counters = line.server.counters();
        assert_eq!((counters.no_responses, counters.server_messages), (2, 2));
        assert_eq!(counters.exceptions, 0);
    }

    #[test]
    fn exceptions_are_answered_and_counted() {
        let mut line = Line::new();
        assert_eq!(line.send(&framed(&[1, 7])), Some(framed(&[1, 0x87, 1])));
        line.readings.activity = Activity::ZeroDrift;
        let [key, code] = Command::ZeroNow.register().to_be_bytes();
        assert_eq!(
            line.send(&framed(&[1, 6, 0, 0, key, code])),
            Some(framed(&[1, 0x86, 6]))
        );
        let counters = line.server.counters();
        assert_eq!((counters.exceptions, counters.busy), (2, 1));
    }

    #[test]
    fn a_damaged_frame_gets_no_answer_and_changes_nothing() {
        let frame = write();
        let mut line = Line::new();
        let mut errors = 0;
        for bit in 0..frame.len() * 8 {
            let mut damaged = frame.clone();
            damaged[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(line.send(&damaged), None);
            errors += 1;
        }
        for length in 1..frame.len() {
            assert_eq!(line.send(&frame[..length]), None);
            errors += 1;
        }
        // An address and a CRC without a function.
        assert_eq!(line.send(&framed(&[1])), None);
        assert_eq!(line.send(&framed(&[])), None);
        errors += 2;
        assert!(line.untouched());
        assert_eq!(
            *line.server.counters(),
            Counters {
                communication_errors: errors,
                ..Counters::default()
            }
        );
        // And the next good one is answered.
        assert_eq!(line.send(&frame), Some(frame));
    }

    #[test]
    fn another_server_s_frames_are_none_of_ours() {
        let mut line = Line::new();
        assert_eq!(line.send(&framed(&[2, 6, 9, 0, 0, 5])), None);
        assert!(line.untouched());
        assert_eq!(
            *line.server.counters(),
            Counters {
                messages: 1,
                ..Counters::default()
            }
        );
    }

    #[test]
    fn a_character_error_spoils_the_frame() {
        let kinds = [
            LineErrors {
                parity: true,
                ..LineErrors::NONE
            },
            LineErrors {
                framing: true,
                ..LineErrors::NONE
            },
            LineErrors {
                noise: true,
                ..LineErrors::NONE
            },
            LineErrors {
                overrun: true,
                ..LineErrors::NONE
            },
        ];
        assert!(!LineErrors::NONE.any());
        for errors in kinds {
            assert!(errors.any());
            for at in 0..8 {
                let mut line = Line::new();
                for (index, byte) in write().iter().enumerate() {
                    let errors = if index == at {
                        errors
                    } else {
                        LineErrors::NONE
                    };
                    line.character(*byte, errors, 0);
                }
                assert!(line.server.ends_at().is_some());
                assert_eq!(line.silence(1_750), None);
                assert!(line.untouched());
                let counters = line.server.counters();
                assert_eq!((counters.communication_errors, counters.messages), (1, 0));
                assert_eq!(counters.character_overruns, u32::from(errors.overrun));
                assert_eq!(line.send(&write()), Some(write()));
            }
        }
    }

    #[test]
    fn a_spoiled_frame_ends_only_with_silence() {
        let mut line = Line::new();
        line.character(
            1,
            LineErrors {
                parity: true,
                ..LineErrors::NONE
            },
            0,
        );
        // A whole good frame right behind it belongs to the spoiled one.
        line.bytes(&write());
        assert_eq!(line.silence(1_750), None);
        assert!(line.untouched());
        // Silence before the next character ends it as well, without a poll between.
        line.character(
            1,
            LineErrors {
                parity: true,
                ..LineErrors::NONE
            },
            0,
        );
        let frame = write();
        line.character(frame[0], LineErrors::NONE, 1_750);
        line.bytes(&frame[1..]);
        assert!(line.silence(1_750).is_some());
        assert_eq!(line.server.counters().missed, 0);
    }

    #[test]
    fn after_start_up_the_line_must_have_been_silent() {
        let mut line = Line {
            server: Server::new(Instant::from_ticks(0)),
            ..Line::new()
        };
        line.now = 0;
        assert_eq!(line.server.ends_at(), Some(Instant::from_ticks(1_750)));
        line.bytes(&write());
        assert_eq!(line.silence(1_750), None);
        assert_eq!(*line.server.counters(), Counters::default());
        assert_eq!(line.send(&write()), Some(write()));
    }

    #[test]
    fn a_frame_may_have_256_characters_and_no_more() {
        let body = [9; 254];
        let mut line = Line::new();
        assert_eq!(line.send(&framed(&body)), None);
        assert_eq!(line.server.counters().messages, 1);
        assert_eq!(line.send(&framed(&[9; 255])), None);
        let counters = line.server.counters();
        assert_eq!((counters.messages, counters.communication_errors), (1, 1));
        assert_eq!(line.send(&write()), Some(write()));
    }

    #[test]
    fn gaps_inside_a_frame_are_tolerated_up_to_the_silence_that_ends_it() {
        let frame = write();
        // (gap, answered, counted as a gap, counted as missed)
        for (gap, whole, gaps, missed) in [
            (0, true, 0, 0),
            (750, true, 0, 0),
            (751, true, 1, 0),
            (1_749, true, 1, 0),
            (1_750, false, 0, 1),
            (60_000_000, false, 0, 1),
        ] {
            let mut line = Line::new();
            line.bytes(&frame[..4]);
            line.character(frame[4], LineErrors::NONE, gap);
            line.bytes(&frame[5..]);
            assert_eq!(line.silence(1_750).is_some(), whole, "{gap}");
            let counters = line.server.counters();
            assert_eq!(
                (counters.character_gaps, counters.missed),
                (gaps, missed),
                "{gap}"
            );
            assert_eq!(counters.communication_errors, u32::from(!whole));
            assert_eq!(line.untouched(), !whole);
        }
    }

    #[test]
    fn a_frame_that_was_never_fetched_is_counted_and_the_next_one_served() {
        let mut line = Line::new();
        line.bytes(&write());
        line.now += 5_000;
        let read = framed(&[1, 3, 9, 0, 0, 1]);
        assert_eq!(line.send(&read), Some(framed(&[1, 3, 2, 0, 1])));
        assert_eq!(line.server.counters().missed, 1);
        assert!(line.untouched());
    }

    #[test]
    fn a_clock_that_steps_back_is_no_silence() {
        let mut line = Line::new();
        line.bytes(&write());
        line.now = 0;
        assert_eq!(line.silence(0), None);
        assert_eq!(
            line.silence(1_000_000).map(|served| served.1),
            Some(Some(Event::ConfigurationChanged))
        );
    }

    #[test]
    fn counters_stop_at_their_end() {
        let mut counter = u32::MAX - 1;
        count(&mut counter);
        count(&mut counter);
        assert_eq!(counter, u32::MAX);
    }

    /// What may happen on the line (F18).
    #[derive(Clone, Debug)]
    enum Event18 {
        Noise(Bytes<u8>),
        Damaged(usize, u8),
        Cut(usize),
        Gap(usize, u64),
        Other(u8),
        Spoiled(usize),
        Silence(u64),
    }

    fn trouble() -> impl Strategy<Value = Event18> {
        prop_oneof![
            prop::collection::vec(any::<u8>(), 0..300).prop_map(Event18::Noise),
            (0..8usize, 1..=255u8).prop_map(|(at, xor)| Event18::Damaged(at, xor)),
            (0..8usize).prop_map(Event18::Cut),
            (1..8usize, 1_750..100_000u64).prop_map(|(at, gap)| Event18::Gap(at, gap)),
            (2..=255u8).prop_map(Event18::Other),
            (0..8usize).prop_map(Event18::Spoiled),
            (0..10_000u64).prop_map(Event18::Silence),
        ]
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(300))]

        /// F18: bad CRC, truncation, noise, wrong address, gaps.
        #[test]
        fn trouble_on_the_line_changes_nothing_and_is_never_answered(events in prop::collection::vec(trouble(), 1..20)) {
            let mut line = Line::new();
            let frame = write();
            for event in events {
                match event {
                    // Random bytes are a valid frame in 1 of 65,536: make sure that they are not.
                    Event18::Noise(mut bytes) => {
                        if checked(&bytes).is_some() {
                            bytes[0] ^= 0x55;
                        }
                        line.bytes(&bytes);
                    }
                    Event18::Damaged(at, xor) => {
                        let mut damaged = frame.clone();
                        damaged[at] ^= xor;
                        line.bytes(&damaged);
                    }
                    Event18::Cut(length) => line.bytes(&frame[..length]),
                    Event18::Gap(at, gap) => {
                        line.bytes(&frame[..at]);
                        line.character(frame[at], LineErrors::NONE, gap);
                        line.bytes(&frame[at + 1..]);
                    }
                    Event18::Other(address) => {
                        let mut body = frame[..6].to_vec();
                        body[0] = address;
                        line.bytes(&framed(&body));
                    }
                    Event18::Spoiled(at) => {
                        for (index, byte) in frame.iter().enumerate() {
                            let parity = index == at;
                            line.character(*byte, LineErrors { parity, ..LineErrors::NONE }, 0);
                        }
                    }
                    Event18::Silence(us) => {
                        prop_assert_eq!(line.silence(us), None);
                        continue;
                    }
                }
                prop_assert_eq!(line.silence(1_750), None);
                prop_assert!(line.untouched());
            }
            prop_assert_eq!(line.send(&frame), Some(frame));
        }

        #[test]
        fn nothing_that_arrives_panics(
            characters in prop::collection::vec((any::<u8>(), any::<u8>(), any::<u64>()), 0..400),
        ) {
            let mut line = Line::new();
            for (byte, flags, at) in characters {
                let errors = LineErrors {
                    parity: flags & 0x81 == 0x81,
                    framing: flags & 0x82 == 0x82,
                    noise: flags & 0x84 == 0x84,
                    overrun: flags & 0x88 == 0x88,
                };
                // Mostly near one another, sometimes anywhere.
                line.now = if flags & 0x70 == 0x70 { at } else { line.now.saturating_add(at % 2_500) };
                let now = line.at();
                line.server.on_character(byte, errors, now);
                let _ = line.server.ends_at();
                if flags & 1 == 0 {
                    let _ = line.server.serve(now, &line.readings, &mut line.store);
                }
            }
        }
    }
}
