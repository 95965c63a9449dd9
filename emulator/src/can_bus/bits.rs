//! A frame as bits on the wire (ISO 11898-1): CRC, stuffing, and the way back in a receiver.

use crate::can_frame::CanFrame;

/// The level of a bit on the wire.
pub type Level = bool;
/// The level that wins: 0.
pub const DOMINANT: Level = false;
/// The level of a wire that nobody pulls: 1.
pub const RECESSIVE: Level = true;

/// x¹⁵ + x¹⁴ + x¹⁰ + x⁸ + x⁷ + x⁴ + x³ + 1 (ISO 11898-1, CRC sequence), without its highest term.
const CRC_POLYNOMIAL: u16 = 0x4599;
/// Equal bits after which a complementary one is stuffed.
const STUFF_AFTER: u8 = 5;
/// Bits after the CRC sequence, none of them stuffed: delimiter, ACK slot, ACK delimiter, seven of end of frame.
const TAIL: u16 = 10;

/// The CRC register after one more bit. It starts at 0; after the CRC sequence itself it is 0 again.
pub const fn crc15(crc: u16, bit: Level) -> u16 {
    let shifted = (crc << 1) & 0x7FFF;
    if (crc >> 14 & 1 != 0) != bit {
        shifted ^ CRC_POLYNOMIAL
    } else {
        shifted
    }
}

/// The order in which frames win arbitration: the arbitration field as a number, SRR and IDE in their places. The lower
/// wins; two frames with the same number never lose against each other.
pub const fn arbitration_rank(frame: &CanFrame) -> u32 {
    if frame.extended {
        let id = frame.id & 0x1FFF_FFFF;
        (id >> 18) << 21 | 0b11 << 19 | (id & 0x3_FFFF) << 1 | frame.remote as u32
    } else {
        (frame.id & 0x7FF) << 21 | (frame.remote as u32) << 20
    }
}

/// A frame as its sender puts it onto the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Bits {
    frame: CanFrame,
    levels: [u64; 3],
    stuffed: [u64; 3],
    arbitration: u16,
    length: u16,
}

impl Bits {
    /// Encodes `frame`: of its identifier the 11 or 29 bits, its length code as it is, of its data what that says.
    pub fn new(mut frame: CanFrame) -> Self {
        frame.id &= if frame.extended { 0x1FFF_FFFF } else { 0x7FF };
        frame.length = frame.length.min(15);
        let used = if frame.remote { 0 } else { frame.bytes().len() };
        frame.data[used..].fill(0);
        let mut bits = Self {
            frame,
            levels: [0; 3],
            stuffed: [0; 3],
            arbitration: 0,
            length: 0,
        };
        let mut stuffer = Stuffer::default();
        let mut crc = 0;
        let mut put = |bits: &mut Self, value: u32, count: u32, crc: &mut u16| {
            for position in (0..count).rev() {
                let bit = value >> position & 1 != 0;
                *crc = crc15(*crc, bit);
                bits.push(bit, false);
                if stuffer.accept(bit) {
                    bits.push(!bit, true);
                    stuffer.accept(!bit);
                }
            }
        };
        put(&mut bits, 0, 1, &mut crc);
        if frame.extended {
            put(&mut bits, frame.id >> 18, 11, &mut crc);
            put(&mut bits, 0b11, 2, &mut crc);
            put(&mut bits, frame.id & 0x3_FFFF, 18, &mut crc);
            put(&mut bits, frame.remote.into(), 1, &mut crc);
            bits.end_arbitration();
            put(&mut bits, 0, 2, &mut crc);
        } else {
            put(&mut bits, frame.id, 11, &mut crc);
            put(&mut bits, frame.remote.into(), 1, &mut crc);
            bits.end_arbitration();
            put(&mut bits, 0, 2, &mut crc);
        }
        put(&mut bits, frame.length.into(), 4, &mut crc);
        if !frame.remote {
            for byte in frame.bytes() {
                put(&mut bits, u32::from(*byte), 8, &mut crc);
            }
        }
        let sequence = u32::from(crc);
        put(&mut bits, sequence, 15, &mut crc);
        for _ in 0..TAIL {
            bits.push(RECESSIVE, false);
        }
        bits
    }

    /// RTR was the last bit; a stuff bit after it is beyond arbitration.
    fn end_arbitration(&mut self) {
        self.arbitration = self.length - u16::from(self.is_stuffed(self.length - 1));
    }

    fn push(&mut self, level: Level, stuffed: bool) {
        let (word, bit) = (usize::from(self.length / 64), self.length % 64);
        self.levels[word] |= u64::from(level) << bit;
        self.stuffed[word] |= u64::from(stuffed) << bit;
        self.length += 1;
    }

    /// What was encoded, without what does not count.
    pub const fn frame(&self) -> &CanFrame {
        &self.frame
    }

    /// Bits from start of frame to the end of end of frame, stuff bits included; intermission is not.
    pub const fn length(&self) -> u16 {
        self.length
    }

    /// Bits from start of frame to RTR, stuff bits between them included: where a recessive bit may be lost.
    pub const fn arbitration(&self) -> u16 {
        self.arbitration
    }

    /// Bit `index`; recessive beyond the end.
    pub fn level(&self, index: u16) -> Level {
        index >= self.length || self.levels[usize::from(index / 64)] >> (index % 64) & 1 != 0
    }

    /// Whether bit `index` is a stuff bit.
    pub fn is_stuffed(&self, index: u16) -> bool {
        index < self.length && self.stuffed[usize::from(index / 64)] >> (index % 64) & 1 != 0
    }

    /// Stuff bits in the frame.
    pub fn stuff_bits(&self) -> u32 {
        self.stuffed.iter().map(|word| word.count_ones()).sum()
    }
}

/// Counts equal bits.
#[derive(Clone, Copy, Debug, Default)]
struct Stuffer {
    last: Level,
    run: u8,
}

impl Stuffer {
    /// Takes a bit; whether a stuff bit follows it.
    fn accept(&mut self, bit: Level) -> bool {
        self.run = if self.run > 0 && bit == self.last {
            self.run + 1
        } else {
            1
        };
        self.last = bit;
        self.run == STUFF_AFTER
    }
}

/// Where in a frame a receiver is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// From start of frame to the CRC sequence, with its last stuff bit.
    Stuffed,
    /// Recessive bit after the CRC sequence.
    CrcDelimiter,
    /// Where receivers acknowledge.
    AckSlot,
    /// Recessive bit after it.
    AckDelimiter,
    /// End of frame, bit 0 … 6.
    EndOfFrame(u8),
}

/// What a bit meant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Meaning {
    /// One of many.
    Part,
    /// The last but one bit of end of frame was right: for a receiver the frame is valid.
    Valid,
    /// The last bit of end of frame was right.
    End,
    /// It was dominant: a receiver answers with an overload frame.
    Overload,
    /// A sixth equal bit.
    StuffError,
    /// A dominant bit where there is none.
    FormError,
    /// The CRC sequence was wrong.
    CrcError,
}

/// A receiver on its way through a frame.
#[derive(Clone, Copy, Debug)]
pub struct Reception {
    stuffer: Stuffer,
    /// Bits without stuff bits.
    position: u16,
    crc: u16,
    id: u32,
    extended: bool,
    remote: bool,
    length: u8,
    data: u64,
    /// Where the CRC sequence begins, once it is known.
    body: Option<u16>,
    tail: u16,
}

/// Bits from start of frame to the length code.
const HEAD: u16 = 19;
/// The same with an extended identifier.
const EXTENDED_HEAD: u16 = 39;
/// Length of the CRC sequence.
const CRC_BITS: u16 = 15;

impl Reception {
    /// Before start of frame.
    pub const fn new() -> Self {
        Self {
            stuffer: Stuffer {
                last: RECESSIVE,
                run: 0,
            },
            position: 0,
            crc: 0,
            id: 0,
            extended: false,
            remote: false,
            length: 0,
            data: 0,
            body: None,
            tail: 0,
        }
    }

    /// Where the next bit belongs.
    pub fn place(&self) -> Place {
        match self.tail {
            0 if !self.is_in_tail() => Place::Stuffed,
            0 => Place::CrcDelimiter,
            1 => Place::AckSlot,
            2 => Place::AckDelimiter,
            bit => Place::EndOfFrame((bit - 3) as u8),
        }
    }

    fn is_in_tail(&self) -> bool {
        self.body
            .is_some_and(|body| self.position == body + CRC_BITS)
            && self.stuffer.run < STUFF_AFTER
    }

    /// Whether the CRC sequence, received whole, was right.
    pub const fn crc_is_right(&self) -> bool {
        self.crc == 0
    }

    /// The fewest bits until the frame is valid, the bit that makes it so included.
    pub fn bits_left(&self) -> u64 {
        let end = self.body.unwrap_or(HEAD) + CRC_BITS;
        // Delimiter, slot, delimiter and six of end of frame.
        u64::from(end.saturating_sub(self.position)) + 9 - u64::from(self.tail.min(8))
    }

    /// The frame, once it is valid.
    pub fn frame(&self) -> CanFrame {
        let count = usize::from(self.length.min(8));
        let mut data = [0; 8];
        if !self.remote {
            for (index, byte) in data[..count].iter_mut().enumerate() {
                *byte = (self.data >> (8 * (count - 1 - index))) as u8;
            }
        }
        CanFrame {
            id: self.id,
            extended: self.extended,
            remote: self.remote,
            length: self.length,
            data,
        }
    }

    /// Takes the next bit.
    pub fn accept(&mut self, level: Level) -> Meaning {
        match self.place() {
            Place::Stuffed => self.accept_stuffed(level),
            place => {
                self.tail += 1;
                match (place, level) {
                    (Place::EndOfFrame(6), DOMINANT) => Meaning::Overload,
                    (Place::AckSlot, _) => Meaning::Part,
                    (_, DOMINANT) => Meaning::FormError,
                    // The error flag of a wrong CRC starts after the ACK delimiter.
                    (Place::AckDelimiter, _) if !self.crc_is_right() => Meaning::CrcError,
                    (Place::EndOfFrame(5), _) => Meaning::Valid,
                    (Place::EndOfFrame(6), _) => Meaning::End,
                    _ => Meaning::Part,
                }
            }
        }
    }

    fn accept_stuffed(&mut self, level: Level) -> Meaning {
        if self.stuffer.run == STUFF_AFTER {
            if level == self.stuffer.last {
                return Meaning::StuffError;
            }
            self.stuffer.accept(level);
            return Meaning::Part;
        }
        self.stuffer.accept(level);
        self.crc = crc15(self.crc, level);
        let bit = u32::from(level);
        let position = self.position;
        self.position += 1;
        match (position, self.extended) {
            (0, _) => {}
            (1..=11, _) => self.id = self.id << 1 | bit,
            // RTR, or SRR, which a receiver takes at either level.
            (12, _) => self.remote = level,
            (13, _) => self.extended = level,
            (14, false) | (33 | 34, true) => {}
            (15..HEAD, false) | (35..EXTENDED_HEAD, true) => {
                self.length = self.length << 1 | bit as u8;
                if self.position == self.head() {
                    let bytes = if self.remote { 0 } else { self.length.min(8) };
                    self.body = Some(self.position + 8 * u16::from(bytes));
                }
            }
            (14..=31, true) => self.id = self.id << 1 | bit,
            (32, true) => self.remote = level,
            _ if self.body.is_some_and(|body| position < body) => {
                self.data = self.data << 1 | u64::from(bit);
            }
            _ => {}
        }
        Meaning::Part
    }

    const fn head(&self) -> u16 {
        if self.extended { EXTENDED_HEAD } else { HEAD }
    }
}

impl Default for Reception {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

    use proptest::prelude::*;

    use super::*;

    /// The check value of CRC-15/CAN in the catalogue of parametrised CRC algorithms: 0x059E for "123456789".
    #[test]
    fn the_crc_has_its_check_value() {
        let crc = b"123456789".iter().fold(0, |crc, byte| {
            (0..8)
                .rev()
                .fold(crc, |crc, bit| crc15(crc, byte >> bit & 1 != 0))
        });
        assert_eq!(crc, 0x059E);
    }

    /// The unstuffed lengths of ISO 11898-1: 44 + 8 n and 64 + 8 n bits, without intermission.
    #[test]
    fn lengths_without_stuff_bits() {
        // ISO 11898-1: a length code of 9 … 15 stands for eight bytes.
        for length in 0..=15_u8 {
            for (extended, remote) in [(false, false), (true, false), (false, true), (true, true)] {
                let bits = Bits::new(CanFrame {
                    id: 0x555,
                    extended,
                    remote,
                    length,
                    data: [0x55; 8],
                });
                let data = if remote {
                    0
                } else {
                    8 * u32::from(length.min(8))
                };
                let head = if extended { 64 } else { 44 };
                assert_eq!(
                    u32::from(bits.length()) - bits.stuff_bits(),
                    head + data,
                    "{length} {extended} {remote}"
                );
            }
        }
    }

    #[test]
    fn arbitration_ends_with_rtr() {
        // Five zeros up to and with RTR: the stuff bit is not arbitrated.
        let bits = Bits::new(CanFrame::standard(0x550, &[]));
        assert!(bits.is_stuffed(13));
        assert_eq!(bits.arbitration(), 13);
        // 0 1 00000 [1] 1111 [0] 1 and RTR: two stuff bits within.
        assert_eq!(Bits::new(CanFrame::standard(0x41F, &[])).arbitration(), 15);
        let extended = CanFrame {
            id: 0x1555_5555,
            extended: true,
            ..CanFrame::default()
        };
        assert_eq!(Bits::new(extended).arbitration(), 33);
    }

    /// Davis, Burns, Bril and Lukkien, "Controller Area Network (CAN) schedulability analysis", 2007: with three bits
    /// between frames at most 55 + 10 n bits (11-bit identifier) and 80 + 10 n (29-bit). The first stuffing region of
    /// 34 + 8 n or 54 + 8 n bits takes one stuff bit for each four bits after the first.
    fn worst_case(frame: &CanFrame) -> u32 {
        let data = if frame.remote {
            0
        } else {
            u32::from(frame.length.min(8))
        };
        if frame.extended {
            80 + 10 * data
        } else {
            55 + 10 * data
        }
    }

    /// A pattern that comes to the bound: one more equal bit first, then groups of four.
    #[test]
    fn the_worst_case_of_stuffing_is_nearly_reached() {
        let frame = CanFrame::standard(0x078, &[0x3C; 8]);
        let bits = Bits::new(frame);
        let length = u32::from(bits.length()) + 3;
        assert!(length <= worst_case(&frame), "{length}");
        assert!(length >= worst_case(&frame) - 4, "{length}");
    }

    fn frames() -> impl Strategy<Value = CanFrame> {
        (
            any::<u32>(),
            any::<bool>(),
            any::<bool>(),
            0..=15_u8,
            prop_oneof![
                any::<[u8; 8]>(),
                prop::array::uniform8(prop_oneof![Just(0_u8), Just(0xFF), Just(0x3C), Just(0xC3)])
            ],
        )
            .prop_map(|(id, extended, remote, length, mut data)| {
                let used = if remote {
                    0
                } else {
                    usize::from(length.min(8))
                };
                data[used..].fill(0);
                CanFrame {
                    id: id & if extended { 0x1FFF_FFFF } else { 0x7FF },
                    extended,
                    remote,
                    length,
                    data,
                }
            })
    }

    proptest! {
            /// Whatever is sent arrives, is never longer than the worst case, and has no six equal bits before its tail.
            #[test]
            fn what_is_sent_arrives(frame in frames()) {
                let bits = Bits::new(frame);
                prop_assert!(u32::from(bits.length()) + 3 <= worst_case(&frame));
                let body = bits.length() - TAIL;
                for start in 0..body.saturating_sub(5) {
                    let first = bits.level(start);
                    prop_assert!((start..start + 6).any(|index| bits.level(index) != first));
                }
                let mut reception = Reception::new();
                for index in 0..bits.length() {
    let to_valid = u64::from(bits.length() - index) - 1;
                    prop_assert!(to_valid == 0 || reception.bits_left() <= to_valid);
                    let meaning = reception.accept(bits.level(index));
                    let expected = match bits.length() - index {
                        1 => Meaning::End,
                        2 => Meaning::Valid,
                        _ => Meaning::Part,
                    };
                    prop_assert_eq!(meaning, expected);
                }
                prop_assert_eq!(reception.frame(), frame);
            }

            /// Up to five wrong bits in the CRC's reach are always found, the Hamming distance of CAN without the effect
            /// of stuffing being six. Without stuffing: the polynomial alone.
            #[test]
            fn the_crc_finds_five_wrong_bits(data in prop::collection::vec(any::<bool>(), 19..83), wrong in prop::collection::btree_set(0_usize..98, 1..=5)) {
                let crc = data.iter().fold(0, |crc, bit| crc15(crc, *bit));
                let mut sent = data;
                sent.extend((0..15).rev().map(|bit| crc >> bit & 1 != 0));
                prop_assert_eq!(sent.iter().fold(0, |crc, bit| crc15(crc, *bit)), 0);
                let mut changed = 0;
                for index in wrong {
                    if let Some(bit) = sent.get_mut(index) {
                        *bit = !*bit;
                        changed += 1;
                    }
                }
                prop_assume!(changed > 0);
                prop_assert_ne!(sent.iter().fold(0, |crc, bit| crc15(crc, *bit)), 0);
            }

            /// The rank orders frames as their bits do: the first differing bit of the arbitration field decides.
            #[test]
            fn rank_is_the_order_of_the_bits(a in frames(), b in frames()) {
                let (x, y) = (Bits::new(a), Bits::new(b));
                let first = (0..x.length().max(y.length())).find(|index| x.level(*index) != y.level(*index));
                match arbitration_rank(&a).cmp(&arbitration_rank(&b)) {
                    std::cmp::Ordering::Equal => {
                        prop_assert_eq!((a.id, a.extended, a.remote), (b.id, b.extended, b.remote));
                    }
                    order => {
                        let first = first.unwrap();
                        prop_assert_eq!(order.is_lt(), x.level(first) == DOMINANT);
                        // The loser is still in its arbitration field.
                        let loser = if order.is_lt() { y } else { x };
                        prop_assert!(first < loser.arbitration());
                    }
                }
            }
        }
}
