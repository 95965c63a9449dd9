//! The RS485 line between the board and its clients: half duplex, 8E1, two parties that can speak at once.
//!
//! Clients queue characters with their gaps and faults; what the board sends counts while its driver is on. Where both
//! drive the line, the bits in which they differ are taken as 0 and the board's receiver sees noise: what a real pair of
//! drivers makes of it is undefined, so every such character is counted.

use std::collections::VecDeque;

use crc::{CRC_16_MODBUS, Crc};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

use crate::outside::Character;
use crate::time::Ticks;

/// Silence that ends a Modbus RTU frame above 19,200 baud (MODBUS over Serial Line V1.02, 2.5.1.1).
pub const FRAME_SILENCE: Ticks = Ticks::from_micros(1_750);
/// More than can overlap with one character of a client.
const OWN_KEPT: usize = 4;
const CRC: Crc<u16> = Crc::<u16>::new(&CRC_16_MODBUS);

/// The line as it is built.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LineConfig {
    /// Of the clients.
    pub baud: u32,
    /// The board's receiver is always enabled, so it hears what the board sends.
    pub echo: bool,
    /// Characters kept in the log.
    pub log_length: usize,
}

impl Default for LineConfig {
    fn default() -> Self {
        Self {
            baud: 115_200,
            echo: true,
            log_length: 4_096,
        }
    }
}

/// What is wrong with a client's character (F18).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CharacterFault {
    /// Wrong parity bit.
    Parity,
    /// Low stop bit.
    Framing,
    /// Samples of a bit that differ.
    Noise,
    /// The sender lets go of the line after its start bit and so many data bits (0 … 7); the rest reads 1.
    Truncated(u8),
}

/// A character that a client is to send.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Outgoing {
    /// Its data bits.
    pub byte: u8,
    /// Idle line before its start bit.
    pub gap: Ticks,
    /// What is wrong with it.
    pub fault: Option<CharacterFault>,
}

impl Outgoing {
    /// Without fault, straight after the one before.
    pub const fn plain(byte: u8) -> Self {
        Self {
            byte,
            gap: Ticks(0),
            fault: None,
        }
    }

    fn on_line(self) -> Character {
        let mut character = Character::good(self.byte);
        match self.fault {
            None => {}
            Some(CharacterFault::Parity) => character.parity_error = true,
            Some(CharacterFault::Framing) => character.framing_error = true,
            Some(CharacterFault::Noise) => character.noise = true,
            Some(CharacterFault::Truncated(bits)) => {
                character.byte |= 0xFF_u8.checked_shl(u32::from(bits)).unwrap_or(0);
                // The parity bit reads 1: right for an odd number of ones.
                character.parity_error = character.byte.count_ones().is_multiple_of(2);
            }
        }
        character
    }
}

/// Who a character of the log came from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    /// A client.
    ToBoard,
    /// The board.
    FromBoard,
}

/// A character of the log.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LogEntry {
    /// End of its stop bit.
    pub at: Ticks,
    /// Who sent it.
    pub direction: Direction,
    /// As it was on the line.
    pub character: Character,
}

/// What happened on the line.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LineCounters {
    /// Characters of clients that reached the board's receiver.
    pub to_board: u64,
    /// Characters of the board that reached the line, garbled ones included.
    pub from_board: u64,
    /// Characters, of either side, during which both drove the line.
    pub collisions: u64,
    /// Characters of the board for which its driver was never on.
    pub driver_off: u64,
    /// Characters of the board for which its driver was on only in part: lost.
    pub cut_off: u64,
    /// Log entries dropped for want of room.
    pub log_dropped: u64,
}

/// Frames to other servers, one after the other (F17).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Flood {
    /// First start bit.
    pub from: Ticks,
    /// No frame begins after this.
    pub until: Ticks,
    /// Idle line between two frames; 0 makes one endless frame of them for everybody who goes by the silence.
    pub gap: Ticks,
    /// The address that is never used, nor is 0, the broadcast.
    pub spare_address: u8,
    /// For addresses, lengths and contents.
    pub seed: u64,
}

#[derive(Debug)]
struct Flooding {
    flood: Flood,
    random: ChaCha8Rng,
}

impl Flooding {
    fn frame(&mut self) -> Vec<u8> {
        let mut address = self.flood.spare_address;
        while address == self.flood.spare_address {
            // 1 … 247 are servers.
            address = (self.random.next_u32() % 247) as u8 + 1;
        }
        let length = 2 + (self.random.next_u32() % 62) as usize;
        let mut frame = vec![address];
        frame.extend((0..length).map(|_| self.random.next_u32().to_le_bytes()[0]));
        frame.extend(CRC.checksum(&frame).to_le_bytes());
        frame
    }
}

#[derive(Clone, Copy, Debug)]
struct OnLine {
    start: Ticks,
    end: Ticks,
    character: Character,
}

/// The line.
#[derive(Debug)]
pub struct Rs485Line {
    config: LineConfig,
    queue: VecDeque<OnLine>,
    /// Clients' characters that the board may still collide with, already handed over.
    recent: VecDeque<OnLine>,
    /// The board's last characters, for the same reason.
    recent_own: VecDeque<(Ticks, u8)>,
    /// What the board hears of itself.
    echoes: VecDeque<(Ticks, Character)>,
    queue_end: Ticks,
    /// The latest time that the line has been asked about: nothing begins before it any more.
    seen: Ticks,
    /// Times with the driver on, oldest first; the last may be open.
    driven: VecDeque<(Ticks, Option<Ticks>)>,
    sent: Vec<(Ticks, u8)>,
    log: VecDeque<LogEntry>,
    counters: LineCounters,
    flooding: Option<Flooding>,
}

impl Rs485Line {
    /// A silent line.
    pub fn new(config: LineConfig) -> Self {
        Self {
            config,
            queue: VecDeque::new(),
            recent: VecDeque::new(),
            recent_own: VecDeque::new(),
            echoes: VecDeque::new(),
            queue_end: Ticks(0),
            seen: Ticks(0),
            driven: VecDeque::new(),
            sent: Vec::new(),
            log: VecDeque::new(),
            counters: LineCounters::default(),
            flooding: None,
        }
    }

    /// Eleven bits.
    pub fn character(&self) -> Ticks {
        let baud = u64::from(self.config.baud.max(1));
        Ticks((11 * Ticks::PER_SECOND + baud / 2) / baud)
    }

    /// Queues characters of a client behind those already queued, the first start bit not before a time, nor in the past. The
    /// end of the last stop bit.
    pub fn send(&mut self, characters: &[Outgoing], not_before: Ticks) -> Ticks {
        let length = self.character();
        let mut free = self.queue_end.max(not_before).max(self.seen);
        for outgoing in characters {
            let start = free + outgoing.gap;
            free = start + length;
            self.queue.push_back(OnLine {
                start,
                end: free,
                character: outgoing.on_line(),
            });
        }
        if !characters.is_empty() {
            self.queue_end = free;
        }
        free
    }

    /// Queues a frame without gaps and faults.
    pub fn send_bytes(&mut self, bytes: &[u8], not_before: Ticks) -> Ticks {
        let characters: Vec<_> = bytes.iter().copied().map(Outgoing::plain).collect();
        self.send(&characters, not_before)
    }

    /// Starts a flood, in place of one under way. What a client sends meanwhile is queued behind the frames of the flood
    /// that are queued already, 18 ms of them at 115,200 baud.
    pub fn flood(&mut self, flood: Flood) {
        self.flooding = Some(Flooding {
            flood,
            random: ChaCha8Rng::seed_from_u64(flood.seed),
        });
        self.refill();
    }

    /// Keeps a whole frame of the flood queued ahead.
    fn refill(&mut self) {
        let Some(mut flooding) = self.flooding.take() else {
            return;
        };
        while self.queue.len() < 128 {
            let flood = flooding.flood;
            let start = flood.from.max(if self.queue_end == Ticks(0) {
                Ticks(0)
            } else {
                self.queue_end + flood.gap
            });
            if start > flood.until {
                return;
            }
            let frame = flooding.frame();
            self.send_bytes(&frame, start);
        }
        self.flooding = Some(flooding);
    }

    /// When the board next hears a character end.
    pub fn next_event(&self) -> Option<Ticks> {
        let client = self.queue.front().map(|next| next.end);
        let echo = self.echoes.front().map(|next| next.0);
        [client, echo].into_iter().flatten().min()
    }

    /// The next queued start bit of a client at or after `at`, for the receiver's detection of an idle line.
    pub fn next_start(&self, at: Ticks) -> Option<Ticks> {
        self.queue
            .iter()
            .map(|next| next.start)
            .find(|start| *start >= at)
    }

    /// The characters that the board's receiver has heard up to `now`, with the ends of their stop bits.
    pub fn take_due(&mut self, now: Ticks) -> Vec<(Ticks, Character)> {
        self.seen = self.seen.max(now);
        let mut due = Vec::new();
        while let Some(next) = self.queue.front().copied().filter(|next| next.end <= now) {
            self.queue.pop_front();
            let mut character = next.character;
            if self.driver_overlaps(next.start, next.end) {
                self.counters.collisions += 1;
                character.noise = true;
                if let Some(own) = self.own_during(next.start, next.end) {
                    character.byte &= own;
                }
            }
            self.counters.to_board += 1;
            self.note(next.end, Direction::ToBoard, character);
            due.push((next.end, character));
            self.recent.push_back(next);
        }
        self.refill();
        while let Some(echo) = self.echoes.front().copied().filter(|(at, _)| *at <= now) {
            self.echoes.pop_front();
            due.push(echo);
        }
        due.sort_by_key(|(at, _)| *at);
        // The last character of the board began at most two of the clients' before now.
        let keep = now.since(Ticks(self.character().0 * 4));
        while self.recent.front().is_some_and(|old| old.end < keep) {
            self.recent.pop_front();
        }
        while self
            .driven
            .front()
            .is_some_and(|(_, off)| off.is_some_and(|off| off < keep))
        {
            self.driven.pop_front();
        }
        due
    }

    /// The board's driver enable.
    pub fn driver(&mut self, on: bool, at: Ticks) {
        let open = self
            .driven
            .back_mut()
            .map(|(_, off)| off)
            .filter(|off| off.is_none());
        match open {
            Some(off) if !on => *off = Some(at),
            None if on => self.driven.push_back((at, None)),
            _ => {}
        }
    }

    fn driver_overlaps(&self, start: Ticks, end: Ticks) -> bool {
        self.driven
            .iter()
            .any(|(on, off)| *on < end && off.is_none_or(|off| off > start))
    }

    /// What the board was sending during a client's character, as far as it is known by its end.
    fn own_during(&self, start: Ticks, end: Ticks) -> Option<u8> {
        let length = self.character();
        self.recent_own
            .iter()
            .find(|(at, _)| *at > start && at.since(length) < end)
            .map(|(_, byte)| *byte)
    }

    /// The board's USART sent a character whose stop bit ended at `at`.
    pub fn board_sent(&mut self, byte: u8, at: Ticks) {
        let start = at.since(self.character());
        let whole = self
            .driven
            .iter()
            .any(|(on, off)| *on <= start && off.is_none_or(|off| off >= at));
        if !whole {
            if self.driver_overlaps(start, at) {
                self.counters.cut_off += 1;
            } else {
                self.counters.driver_off += 1;
            }
            return;
        }
        let mut character = Character::good(byte);
        let others = self
            .recent
            .iter()
            .chain(&self.queue)
            .filter(|other| other.start < at && other.end > start);
        let mut collides = false;
        for other in others {
            collides = true;
            character.byte &= other.character.byte;
        }
        if collides {
            self.counters.collisions += 1;
            character.noise = true;
        }
        if self.recent_own.len() == OWN_KEPT {
            self.recent_own.pop_front();
        }
        self.recent_own.push_back((at, byte));
        self.counters.from_board += 1;
        self.note(at, Direction::FromBoard, character);
        self.sent.push((at, character.byte));
        // A collision is handed to the receiver once, as the client's character.
        if self.config.echo && !collides {
            self.echoes.push_back((at, character));
        }
    }

    /// What the clients have heard since the last call, with the ends of the stop bits.
    pub fn take_sent(&mut self) -> Vec<(Ticks, u8)> {
        std::mem::take(&mut self.sent)
    }

    fn note(&mut self, at: Ticks, direction: Direction, character: Character) {
        if self.log.len() >= self.config.log_length {
            self.log.pop_front();
            self.counters.log_dropped += 1;
        }
        self.log.push_back(LogEntry {
            at,
            direction,
            character,
        });
    }

    /// The log, oldest first.
    pub fn log(&self) -> impl ExactSizeIterator<Item = &LogEntry> {
        self.log.iter()
    }

    /// Takes the log away.
    pub fn take_log(&mut self) -> Vec<LogEntry> {
        self.log.drain(..).collect()
    }

    /// What happened so far.
    pub const fn counters(&self) -> LineCounters {
        self.counters
    }
}

/// A frame cut out of a stream of characters.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Frame {
    /// First start bit.
    pub start: Ticks,
    /// Last stop bit.
    pub end: Ticks,
    /// Its bytes, CRC included.
    pub bytes: Vec<u8>,
}

impl Frame {
    /// Whether its CRC-16 is right.
    pub fn is_intact(&self) -> bool {
        self.bytes
            .split_last_chunk::<2>()
            .is_some_and(|(body, sum)| !body.is_empty() && CRC.checksum(body).to_le_bytes() == *sum)
    }
}

/// Splits characters into Modbus RTU frames by the silence between them.
#[derive(Clone, Debug)]
pub struct FrameSplitter {
    character: Ticks,
    silence: Ticks,
    open: Option<Frame>,
}

impl FrameSplitter {
    /// For characters of 11 bits at `baud`. Up to 19,200 baud 3.5 characters of silence end a frame, above it
    /// [`FRAME_SILENCE`] does.
    pub fn new(baud: u32) -> Self {
        let character = Ticks(11 * Ticks::PER_SECOND / u64::from(baud.max(1)));
        let silence = if baud > 19_200 {
            FRAME_SILENCE
        } else {
            Ticks(character.0 * 7 / 2)
        };
        Self::with_silence(character, silence)
    }

    /// For another silence, as 3.5 characters at any rate.
    pub const fn with_silence(character: Ticks, silence: Ticks) -> Self {
        Self {
            character,
            silence,
            open: None,
        }
    }

    /// Takes a character whose stop bit ended at `at`; the frame before it, if that ended.
    pub fn push(&mut self, at: Ticks, byte: u8) -> Option<Frame> {
        let start = at.since(self.character);
        let ended = self.take_ended(start);
        let frame = self.open.get_or_insert_with(|| Frame {
            start,
            end: at,
            bytes: Vec::new(),
        });
        frame.end = at;
        frame.bytes.push(byte);
        ended
    }

    /// The frame that has ended by `now`.
    pub fn take_ended(&mut self, now: Ticks) -> Option<Frame> {
        self.open
            .take_if(|frame| now.since(frame.end) >= self.silence)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

    use proptest::prelude::*;

    use super::*;

    /// 11 bits at 115,200 baud in units of 1/336 µs: 32083.3.
    const CHARACTER: Ticks = Ticks(32_083);

    fn line() -> Rs485Line {
        Rs485Line::new(LineConfig::default())
    }

    fn drain(line: &mut Rs485Line) -> Vec<(Ticks, Character)> {
        let mut all = Vec::new();
        while let Some(at) = line.next_event() {
            all.extend(line.take_due(at));
        }
        all
    }

    #[test]
    fn characters_follow_each_other_at_the_line_s_rate() {
        let mut line = line();
        assert_eq!(line.character(), CHARACTER);
        let begin = Ticks::from_millis(1);
        let end = line.send_bytes(&[1, 2], begin);
        assert_eq!(end, Ticks(begin.0 + 2 * CHARACTER.0));
        let late = Outgoing {
            gap: Ticks(100),
            ..Outgoing::plain(3)
        };
        // Behind what is queued, whatever time is asked for.
        line.send(&[late], Ticks(0));
        assert_eq!(line.next_start(begin), Some(begin));
        assert_eq!(line.next_start(begin + Ticks(1)), Some(begin + CHARACTER));
        assert!(line.take_due(begin).is_empty());
        let ends: Vec<_> = drain(&mut line)
            .into_iter()
            .map(|(at, character)| (at.since(begin).0, character))
            .collect();
        assert_eq!(
            ends,
            [
                (CHARACTER.0, Character::good(1)),
                (CHARACTER.0 * 2, Character::good(2)),
                (CHARACTER.0 * 3 + 100, Character::good(3))
            ]
        );
    }

    #[test]
    fn nothing_is_sent_in_the_past() {
        let mut line = line();
        let now = Ticks::from_millis(3);
        assert!(line.take_due(now).is_empty());
        assert_eq!(line.send_bytes(&[1], Ticks(0)), now + CHARACTER);
        assert_eq!(line.take_due(now + CHARACTER).len(), 1);
    }

    #[test]
    fn faults_show_on_the_line() {
        let with = |byte, fault| {
            Outgoing {
                byte,
                gap: Ticks(0),
                fault: Some(fault),
            }
            .on_line()
        };
        assert!(with(1, CharacterFault::Parity).parity_error);
        assert!(with(1, CharacterFault::Framing).framing_error);
        assert!(with(1, CharacterFault::Noise).noise);
        // Two bits of 0x00, then ones: 0xFC with six ones, whose even parity bit is 0 and reads 1.
        let cut = with(0x00, CharacterFault::Truncated(2));
        assert_eq!((cut.byte, cut.parity_error), (0xFC, true));
        // 0xFE has seven ones: the parity bit is 1, nobody notices.
        let cut = with(0x00, CharacterFault::Truncated(1));
        assert_eq!((cut.byte, cut.parity_error), (0xFE, false));
        assert_eq!(with(0x55, CharacterFault::Truncated(8)).byte, 0x55);
    }

    #[test]
    fn what_the_board_sends_counts_while_its_driver_is_on() {
        let mut line = line();
        let at = |count: u64| Ticks(count * CHARACTER.0);
        line.board_sent(1, at(10));
        line.driver(true, at(10));
        // Driver on from its start to its end.
        line.board_sent(2, at(11));
        line.board_sent(3, at(12));
        line.driver(false, Ticks(at(13).0 - 1));
        line.board_sent(4, at(13));
        line.board_sent(5, at(20));
        assert_eq!(line.take_sent(), [(at(11), 2), (at(12), 3)]);
        assert!(line.take_sent().is_empty());
        let counters = line.counters();
        assert_eq!(
            (counters.from_board, counters.driver_off, counters.cut_off),
            (2, 2, 1)
        );
        // Its own receiver hears it.
        let heard = drain(&mut line);
        assert_eq!(
            heard,
            [(at(11), Character::good(2)), (at(12), Character::good(3))]
        );
        let mut quiet = Rs485Line::new(LineConfig {
            echo: false,
            ..LineConfig::default()
        });
        quiet.driver(true, Ticks(0));
        quiet.board_sent(1, at(5));
        assert_eq!(quiet.next_event(), None);
    }

    #[test]
    fn two_speakers_garble_each_other() {
        let at = |count: u64| Ticks(count * CHARACTER.0);
        // Offset of the board's character against the client's, in tenths of a character; whether they overlap.
        for (offset, overlap) in [(0, false), (1, true), (10, true), (19, true), (20, false)] {
            let mut line = line();
            line.send_bytes(&[0xF0], at(10));
            let start = Ticks(at(9).0 + offset * CHARACTER.0 / 10);
            let end = start + CHARACTER;
            line.driver(true, start);
            let mut heard = line.take_due(end);
            line.board_sent(0x33, end);
            line.driver(false, end);
            heard.extend(line.take_due(at(12)));
            let client = heard.iter().find(|(when, _)| *when == at(11)).unwrap().1;
            assert_eq!(client.noise, overlap, "offset {offset}");
            let sent = line.take_sent();
            assert_eq!(sent, [(end, if overlap { 0x30 } else { 0x33 })]);
            assert_eq!(line.counters().collisions, if overlap { 2 } else { 0 });
            // The board knows its own character when the client's ends after it.
            if overlap && end < at(11) {
                assert_eq!(client.byte, 0x30);
            }
        }
    }

    #[test]
    fn a_driver_left_on_disturbs_every_client() {
        let mut line = line();
        line.driver(true, Ticks(0));
        line.driver(true, Ticks(5));
        line.send_bytes(&[1, 2, 3], Ticks::from_millis(10));
        assert!(drain(&mut line).iter().all(|(_, heard)| heard.noise));
        line.driver(false, Ticks::from_millis(20));
        line.driver(false, Ticks::from_millis(21));
        line.send_bytes(&[1, 2, 3], Ticks::from_millis(30));
        assert!(drain(&mut line).iter().all(|(_, heard)| !heard.noise));
    }

    #[test]
    fn the_log_has_both_directions_and_a_bound() {
        let mut line = Rs485Line::new(LineConfig {
            log_length: 3,
            ..LineConfig::default()
        });
        line.send_bytes(&[1, 2], Ticks(0));
        drain(&mut line);
        line.driver(true, Ticks::from_millis(5));
        line.board_sent(3, Ticks::from_millis(6));
        line.board_sent(4, Ticks::from_millis(7));
        let log: Vec<_> = line
            .log()
            .map(|entry| (entry.direction, entry.character.byte))
            .collect();
        assert_eq!(
            log,
            [
                (Direction::ToBoard, 2),
                (Direction::FromBoard, 3),
                (Direction::FromBoard, 4)
            ]
        );
        assert_eq!(line.counters().log_dropped, 1);
        assert_eq!(line.take_log().len(), 3);
        assert_eq!(line.log().len(), 0);
    }

    /// The frame of the Modbus specification's own example of a request, with its known CRC.
    #[test]
    fn frames_are_split_by_silence_and_checked() {
        let frame = [0x11, 0x03, 0x00, 0x6B, 0x00, 0x03, 0x76, 0x87];
        let mut line = line();
        let mut splitter = FrameSplitter::new(115_200);
        let end = line.send_bytes(&frame, Ticks::from_millis(1));
        let almost = Ticks(FRAME_SILENCE.0 - 2);
        let gap = |gap, byte| Outgoing {
            gap,
            ..Outgoing::plain(byte)
        };
        let last = line.send(&[gap(FRAME_SILENCE, 7), gap(almost, 8)], Ticks(0));
        let mut frames = Vec::new();
        for (at, character) in drain(&mut line) {
            frames.extend(splitter.push(at, character.byte));
        }
        assert_eq!(frames.len(), 1);
        assert_eq!(frames[0].bytes, frame);
        assert_eq!(frames[0].start, Ticks::from_millis(1));
        assert_eq!(frames[0].end, end);
        assert!(frames[0].is_intact());
        assert_eq!(splitter.take_ended(last), None);
        let rest = splitter.take_ended(last + FRAME_SILENCE).unwrap();
        assert_eq!(rest.bytes, [7, 8]);
        assert!(!rest.is_intact());
        assert_eq!(splitter.take_ended(last + FRAME_SILENCE), None);
        // Below 19,200 baud it is 3.5 characters: at 9,600 baud 4.01 ms.
        let slow = FrameSplitter::new(9_600);
        assert!((slow.silence.micros() - 3.5 * 11e6 / 9_600.0).abs() < 0.1);
    }

    #[test]
    fn a_flood_fills_the_line_with_good_frames_for_others() {
        for gap in [Ticks(0), FRAME_SILENCE] {
            let mut line = line();
            let until = Ticks::from_millis(500);
            line.flood(Flood {
                from: Ticks::from_millis(1),
                until,
                gap,
                spare_address: 1,
                seed: 7,
            });
            let heard = drain(&mut line);
            let last = heard.last().unwrap().0;
            assert!(last > until && last < Ticks::from_millis(507));
            if gap == Ticks(0) {
                // All of the line's time.
                for pair in heard.windows(2) {
                    assert_eq!(pair[1].0.since(pair[0].0), CHARACTER);
                }
                continue;
            }
            let mut splitter = FrameSplitter::new(115_200);
            let mut frames: Vec<_> = heard
                .iter()
                .filter_map(|(at, character)| splitter.push(*at, character.byte))
                .collect();
            frames.extend(splitter.take_ended(Ticks::from_millis(600)));
            assert!(frames.len() > 80);
            for frame in frames {
                assert!(frame.is_intact());
                assert!((2..=247).contains(&frame.bytes[0]));
            }
        }
    }

    proptest! {
        /// Whatever the clients queue and whenever the board looks, it hears every character once, in order and without
        /// overlap.
        #[test]
        fn characters_arrive_in_order_and_once(
            frames in prop::collection::vec(
                (prop::collection::vec((any::<u8>(), 0_u64..50_000), 1..20), 0_u64..3_000_000),
                1..10,
            ),
            looks in prop::collection::vec(1_u64..200_000, 1..20),
        ) {
            let mut line = line();
            let mut wanted = Vec::new();
            for (characters, not_before) in &frames {
                let outgoing: Vec<_> = characters
                    .iter()
                    .map(|(byte, gap)| Outgoing { gap: Ticks(*gap), ..Outgoing::plain(*byte) })
                    .collect();
                wanted.extend(characters.iter().map(|(byte, _)| *byte));
                line.send(&outgoing, Ticks(*not_before));
            }
            let mut looks = looks.iter().cycle();
            let mut now = Ticks(0);
            let mut heard = Vec::new();
            while line.next_event().is_some() {
                now += Ticks(*looks.next().unwrap());
                for (at, character) in line.take_due(now) {
                    prop_assert!(at <= now);
                    heard.push((at, character.byte));
                }
            }
            for pair in heard.windows(2) {
                prop_assert!(pair[1].0.since(pair[0].0) >= CHARACTER);
            }
            let bytes: Vec<_> = heard.iter().map(|(_, byte)| *byte).collect();
            prop_assert_eq!(bytes, wanted);
            prop_assert_eq!(line.counters().collisions, 0);
        }
    }
}
