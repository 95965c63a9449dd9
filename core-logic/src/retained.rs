//! What must outlive a reset, and the records of the flash log.
//!
//! [`RetainedState`] is kept twice: in RAM that a reset does not clear, in two slots written in turn (so that a reset in
//! the middle of a write leaves the other one valid), and in flash, as often as [`SavePolicy`] says. Every record is
//! `kind and version (1 byte) · postcard · CRC-32`; a slot is filled with zeros before its CRC.

use core::fmt;

use crc::{CRC_32_ISO_HDLC, Crc, NoTable};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::design_parameters as design;
use crate::front_end::KeyFactors;
use crate::soc::SocRetained;
use crate::units::{
    Duration, Instant, Microamps, MilliCelsius, Millivolts, Nanocoulombs, Ppm, add_i64, elapsed,
    mul_div,
};
use crate::validity::Validity;

/// Bytes of one slot of the retained RAM; 24 words.
pub const SLOT_BYTES: usize = 96;
/// Words of one slot.
pub const SLOT_WORDS: usize = SLOT_BYTES / 4;
/// Longest flash record of a [`RetainedState`].
pub const MAX_STATE_BYTES: usize = 91;
/// Longest flash record of a [`LogRecord`].
pub const MAX_LOG_BYTES: usize = 64;

/// First byte of a retained state: kind 0xA, version 2.
const STATE: u8 = 0xA2;
/// First byte of a log record: kind 0x5, version 2.
const LOG: u8 = 0x52;

const CHECKSUM_BYTES: usize = 4;
// Without a table: 1 KiB of flash is worth more than 20 µs at the lowest priority.
const CHECKSUM: Crc<u32, NoTable> = Crc::<u32, NoTable>::new(&CRC_32_ISO_HDLC);

/// Why bytes are no record.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum RetainedError {
    /// Fewer bytes than any record has.
    TooShort,
    /// The CRC-32 is wrong.
    Checksum,
    /// The CRC is right, but the record is of this other kind or version.
    Kind(u8),
    /// The CRC is right, but the content is not one of this version.
    Content,
    /// The buffer does not hold the record.
    NoSpace,
}

impl fmt::Display for RetainedError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::TooShort => write!(f, "too short for a record"),
            Self::Checksum => write!(f, "wrong CRC"),
            Self::Kind(kind) => write!(f, "record of another kind or version: {kind:#04x}"),
            Self::Content => write!(f, "content does not fit the version"),
            Self::NoSpace => write!(f, "the buffer is too small"),
        }
    }
}

impl core::error::Error for RetainedError {}

/// What the board goes on with after a reset.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct RetainedState {
    /// Counts the writes; wraps.
    pub sequence: u32,
    /// The meter's cumulative counter, + is discharge.
    pub charge_total: Nanocoulombs,
    /// The state of charge at that counter.
    pub soc: SocRetained,
    /// Factors of the last key-state calibration.
    pub key_factors: KeyFactors,
}

impl RetainedState {
    /// As a slot of the retained RAM.
    #[must_use]
    pub fn to_slot(&self) -> [u8; SLOT_BYTES] {
        let mut slot = [0; SLOT_BYTES];
        if let Some((body, checksum)) = slot.split_last_chunk_mut::<CHECKSUM_BYTES>() {
            // The longest state is shorter than the slot; a failure would leave a slot that `from_slot` refuses.
            if write_body(STATE, self, body).is_ok() {
                *checksum = CHECKSUM.checksum(body).to_le_bytes();
            }
        }
        slot
    }

    /// From a slot of the retained RAM.
    ///
    /// # Errors
    /// Why the slot holds no state: what a cold start leaves, a reset in the middle of a write, a flipped bit.
    pub fn from_slot(slot: &[u8; SLOT_BYTES]) -> Result<Self, RetainedError> {
        let (state, padding) = read(STATE, slot)?;
        if padding.iter().any(|byte| *byte != 0) {
            return Err(RetainedError::Content);
        }
        Ok(state)
    }

    /// As a flash record, into `buffer` ([`MAX_STATE_BYTES`] always suffice).
    ///
    /// # Errors
    /// [`RetainedError::NoSpace`].
    pub fn encode<'buffer>(
        &self,
        buffer: &'buffer mut [u8],
    ) -> Result<&'buffer [u8], RetainedError> {
        encode(STATE, self, buffer)
    }

    /// From a flash record, which must be exactly as long as [`RetainedState::encode`] made it.
    ///
    /// # Errors
    /// Why the bytes are no such record.
    pub fn decode(bytes: &[u8]) -> Result<Self, RetainedError> {
        decode(STATE, bytes)
    }
}

/// One line of the flash log.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct LogRecord {
    /// Resets since the retained memory was last lost, that is since power-on: it names a start only together with the
    /// records around it.
    pub boot: u32,
    /// Time since that start, in milliseconds.
    pub uptime_ms: u64,
    /// Averaged current.
    pub current: Microamps,
    /// Cumulative charge, + is discharge.
    pub charge: Nanocoulombs,
    /// State of charge as presented.
    pub soc: Ppm,
    /// Causes against the current.
    pub current_validity: Validity,
    /// Causes against the charge.
    pub charge_validity: Validity,
    /// Causes against the state of charge.
    pub soc_validity: Validity,
    /// Diagnoses that are active or latched, one bit each in the order of the diagnosis table.
    pub diagnoses: u64,
    /// Supply of the sensor.
    pub supply: Millivolts,
    /// Temperature next to the sensors, where there is one.
    pub temperature: Option<MilliCelsius>,
}

impl LogRecord {
    /// As a flash record, into `buffer` ([`MAX_LOG_BYTES`] always suffice).
    ///
    /// # Errors
    /// [`RetainedError::NoSpace`].
    pub fn encode<'buffer>(
        &self,
        buffer: &'buffer mut [u8],
    ) -> Result<&'buffer [u8], RetainedError> {
        encode(LOG, self, buffer)
    }

    /// From a flash record.
    ///
    /// # Errors
    /// Why the bytes are no such record.
    pub fn decode(bytes: &[u8]) -> Result<Self, RetainedError> {
        decode(LOG, bytes)
    }
}

/// One of the two slots of the retained RAM.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Slot {
    /// The first.
    A,
    /// The second.
    B,
}

impl Slot {
    /// The other one.
    #[must_use]
    pub const fn other(self) -> Self {
        match self {
            Self::A => Self::B,
            Self::B => Self::A,
        }
    }
}

/// Writes the two slots in turn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RetainSlots {
    next: Slot,
    sequence: u32,
}

impl RetainSlots {
    /// After a start without a valid slot.
    #[must_use]
    pub const fn empty() -> Self {
        Self {
            next: Slot::A,
            sequence: 0,
        }
    }

    /// Finds the newest valid state in the two slots, and continues after it: the next write goes to the other slot.
    ///
    /// # Errors
    /// Why neither slot holds a state: slot A's reason and slot B's.
    pub fn recover(
        a: &[u8; SLOT_BYTES],
        b: &[u8; SLOT_BYTES],
    ) -> Result<(RetainedState, Self), [RetainedError; 2]> {
        let (state, slot) = match (RetainedState::from_slot(a), RetainedState::from_slot(b)) {
            (Ok(a), Ok(b)) if newer(b.sequence, a.sequence) => (b, Slot::B),
            (Ok(a), _) => (a, Slot::A),
            (Err(_), Ok(b)) => (b, Slot::B),
            (Err(a), Err(b)) => return Err([a, b]),
        };
        Ok((
            state,
            Self {
                next: slot.other(),
                sequence: state.sequence.wrapping_add(1),
            },
        ))
    }

    /// The slot to be written now and its bytes; the state's own sequence number is replaced.
    pub fn write(&mut self, state: &RetainedState) -> (Slot, [u8; SLOT_BYTES]) {
        let slot = self.next;
        let bytes = RetainedState {
            sequence: self.sequence,
            ..*state
        }
        .to_slot();
        self.next = slot.other();
        self.sequence = self.sequence.wrapping_add(1);
        (slot, bytes)
    }
}

/// Whether `a` was written after `b`, across the wrap.
const fn newer(a: u32, b: u32) -> bool {
    let ahead = a.wrapping_sub(b);
    ahead != 0 && ahead < 1 << 31
}

/// A slot as the words in which RAM is written.
#[must_use]
pub fn to_words(slot: &[u8; SLOT_BYTES]) -> [u32; SLOT_WORDS] {
    let mut words = [0; SLOT_WORDS];
    let (chunks, _) = slot.as_chunks::<4>();
    for (word, chunk) in words.iter_mut().zip(chunks) {
        *word = u32::from_le_bytes(*chunk);
    }
    words
}

/// The reverse of [`to_words`].
#[must_use]
pub fn from_words(words: &[u32; SLOT_WORDS]) -> [u8; SLOT_BYTES] {
    let mut slot = [0; SLOT_BYTES];
    let (chunks, _) = slot.as_chunks_mut::<4>();
    for (chunk, word) in chunks.iter_mut().zip(words) {
        *chunk = word.to_le_bytes();
    }
    slot
}

/// Smallest settable charge interval. The ring takes 16 sectors · 41 of the longest records · 100,000 erasures = 65.6 million records. In a
/// vehicle's life 30 C make 46.9 million and the smallest time interval 17.7 million, together 98 % of that. By 1 C there would be a
/// record in each of the 100 ms between two questions, and the ring worn out after 1,800 h.
pub const MIN_CHARGE_INTERVAL: Nanocoulombs = Nanocoulombs::from_coulombs(30);
/// Smallest settable time interval, in seconds.
pub const MIN_TIME_INTERVAL_S: u32 = 10;
const _: () = {
    let record = MAX_STATE_BYTES as i64 + design::FLASH_RECORD_HEADER_BYTES;
    let in_a_sector = (design::FLASH_SECTOR_BYTES - design::FLASH_SECTOR_MARK_BYTES) / record;
    let sectors = design::STATE_FLASH_BYTES / design::FLASH_SECTOR_BYTES;
    let by_charge = design::VEHICLE_LIFE_COULOMBS / (MIN_CHARGE_INTERVAL.get() / 1_000_000_000) + 1;
    let by_time = design::VEHICLE_LIFE_S / MIN_TIME_INTERVAL_S as i64 + 1;
    assert!(by_charge + by_time <= in_a_sector * sectors * design::FLASH_ENDURANCE);
};

/// When the state is written to flash.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct SavePolicyConfig {
    /// Change of the charge counter after which it is saved.
    pub charge_interval: Nanocoulombs,
    /// Time after which the state is saved whatever has changed, in seconds.
    pub time_interval_s: u32,
}

impl Default for SavePolicyConfig {
    /// 360 As is 0.1 Ah, 0.04 % of D4's 240 Ah: 2,400 records for a full discharge.
    fn default() -> Self {
        Self {
            charge_interval: Nanocoulombs::from_coulombs(360),
            time_interval_s: 60,
        }
    }
}

impl SavePolicyConfig {
    /// The most charge that a loss of power and of the retained RAM together can cost: one save interval, and what
    /// flows until the record is written (`latency`: time between two questions whether to save, plus the write).
    #[must_use]
    pub fn loss_bound(&self, largest_current: Microamps, latency: Duration) -> Nanocoulombs {
        let current = i64::from(largest_current.saturating_abs().get());
        // µA · µs / 1000 = nC
        let in_time = |us: i64| mul_div(current, us, 1_000);
        let interval = self
            .charge_interval
            .saturating_abs()
            .get()
            .min(in_time(i64::from(self.time_interval_s) * 1_000_000));
        let meanwhile = in_time(i64::try_from(latency.as_ticks()).unwrap_or(i64::MAX));
        Nanocoulombs(add_i64(interval, meanwhile))
    }
}

/// Decides when the state is written to flash.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SavePolicy {
    saved_total: Nanocoulombs,
    saved_at: Instant,
}

impl SavePolicy {
    /// Starts from a state that is in flash as it is.
    #[must_use]
    pub const fn new(now: Instant, charge_total: Nanocoulombs) -> Self {
        Self {
            saved_total: charge_total,
            saved_at: now,
        }
    }

    /// Whether the state must be written now.
    #[must_use]
    pub fn due(&self, config: &SavePolicyConfig, now: Instant, charge_total: Nanocoulombs) -> bool {
        let change = charge_total
            .saturating_sub(self.saved_total)
            .saturating_abs();
        let interval = Duration::from_ticks(u64::from(config.time_interval_s) * 1_000_000);
        // The state of charge can change with no charge at all: anchored at rest, or by another capacity.
        (change >= config.charge_interval && change != Nanocoulombs::ZERO)
            || elapsed(self.saved_at, now) >= interval
    }

    /// The state with this counter is in flash.
    pub fn saved(&mut self, now: Instant, charge_total: Nanocoulombs) {
        *self = Self::new(now, charge_total);
    }
}

/// Kind and content into the front of `body`; the length used.
fn write_body<T: Serialize>(kind: u8, value: &T, body: &mut [u8]) -> Result<usize, RetainedError> {
    let (first, content) = body.split_first_mut().ok_or(RetainedError::NoSpace)?;
    *first = kind;
    let used = postcard::to_slice(value, content).map_err(|_| RetainedError::NoSpace)?;
    Ok(1 + used.len())
}

fn encode<'buffer, T: Serialize>(
    kind: u8,
    value: &T,
    buffer: &'buffer mut [u8],
) -> Result<&'buffer [u8], RetainedError> {
    let length = write_body(kind, value, buffer)?;
    let (body, rest) = buffer
        .split_at_mut_checked(length)
        .ok_or(RetainedError::NoSpace)?;
    let checksum = rest
        .first_chunk_mut::<CHECKSUM_BYTES>()
        .ok_or(RetainedError::NoSpace)?;
    *checksum = CHECKSUM.checksum(body).to_le_bytes();
    buffer
        .get(..length + CHECKSUM_BYTES)
        .ok_or(RetainedError::NoSpace)
}

fn decode<T: DeserializeOwned>(kind: u8, bytes: &[u8]) -> Result<T, RetainedError> {
    match read(kind, bytes)? {
        (value, []) => Ok(value),
        _ => Err(RetainedError::Content),
    }
}

/// The value, and what lies between it and the CRC.
fn read<T: DeserializeOwned>(kind: u8, bytes: &[u8]) -> Result<(T, &[u8]), RetainedError> {
    // `split_last_chunk` would bring a panic into the image.
    let [body @ .., c0, c1, c2, c3] = bytes else {
        return Err(RetainedError::TooShort);
    };
    let (first, content) = body.split_first().ok_or(RetainedError::TooShort)?;
    if CHECKSUM.checksum(body) != u32::from_le_bytes([*c0, *c1, *c2, *c3]) {
        return Err(RetainedError::Checksum);
    }
    if *first != kind {
        return Err(RetainedError::Kind(*first));
    }
    postcard::take_from_bytes(content).map_err(|_| RetainedError::Content)
}

#[cfg(test)]
#[allow(
    clippy::unwrap_used,
    clippy::indexing_slicing,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss
)]
mod tests {
    use super::*;
    use crate::units::Microvolts;
    use proptest::prelude::*;
    use std::string::ToString;

    fn largest_state() -> RetainedState {
        RetainedState {
            sequence: u32::MAX,
            charge_total: Nanocoulombs(i64::MIN),
            soc: SocRetained {
                capacity_mah: u32::MAX,
                remaining: Nanocoulombs(i64::MIN),
                presented_offset: Nanocoulombs(i64::MIN),
                uncertainty: Nanocoulombs(i64::MIN),
                known: true,
                charged: Nanocoulombs(i64::MIN),
                discharged: Nanocoulombs(i64::MIN),
                loss_carry: u32::MAX,
            },
            key_factors: KeyFactors {
                k_ppb: i32::MIN,
                a: Microvolts(i32::MIN),
            },
        }
    }

    fn largest_log() -> LogRecord {
        LogRecord {
            boot: u32::MAX,
            uptime_ms: u64::MAX,
            current: Microamps(i32::MIN),
            charge: Nanocoulombs(i64::MIN),
            soc: Ppm(i32::MIN),
            current_validity: Validity::from_bits(0xFF),
            charge_validity: Validity::from_bits(0xFF),
            soc_validity: Validity::from_bits(0xFF),
            diagnoses: u64::MAX,
            supply: Millivolts(i32::MIN),
            temperature: Some(MilliCelsius(i32::MIN)),
        }
    }

    prop_compose! {
        fn any_state()(
            sequence: u32, capacity_mah: u32, charges in proptest::array::uniform6(any::<i64>()), known: bool, loss_carry: u32,
            k_ppb: i32, a: i32,
        ) -> RetainedState {
            RetainedState {
                sequence,
                charge_total: Nanocoulombs(charges[0]),
                soc: SocRetained {
                    capacity_mah,
                    remaining: Nanocoulombs(charges[1]),
                    presented_offset: Nanocoulombs(charges[2]),
                    uncertainty: Nanocoulombs(charges[3]),
                    known,
                    charged: Nanocoulombs(charges[4]),
                    discharged: Nanocoulombs(charges[5]),
                    loss_carry,
                },
                key_factors: KeyFactors { k_ppb, a: Microvolts(a) },
            }
        }
    }

    prop_compose! {
        fn any_log()(
            boot: u32, uptime_ms: u64, currents in proptest::array::uniform4(any::<i32>()), charge: i64,
            bits in proptest::array::uniform3(any::<u8>()), diagnoses: u64,
        ) -> LogRecord {
            LogRecord {
                boot,
                uptime_ms,
                current: Microamps(currents[0]),
                charge: Nanocoulombs(charge),
                soc: Ppm(currents[1]),
                current_validity: Validity::from_bits(bits[0]),
                charge_validity: Validity::from_bits(bits[1]),
                soc_validity: Validity::from_bits(bits[2]),
                diagnoses,
                supply: Millivolts(currents[2]),
                temperature: (bits[0] & 1 == 0).then_some(MilliCelsius(currents[3])),
            }
        }
    }

    #[test]
    fn the_longest_records_are_as_long_as_stated_and_fit() {
        let mut buffer = [0; 200];
        assert_eq!(
            largest_state().encode(&mut buffer).unwrap().len(),
            MAX_STATE_BYTES
        );
        assert_eq!(
            largest_log().encode(&mut buffer).unwrap().len(),
            MAX_LOG_BYTES
        );
        assert_eq!(
            RetainedState::from_slot(&largest_state().to_slot()),
            Ok(largest_state())
        );
        const { assert!(MAX_STATE_BYTES <= SLOT_BYTES) };
        assert_eq!(to_words(&largest_state().to_slot()).len() * 4, SLOT_BYTES);
        // A line of the log as it usually is.
        let usual = LogRecord {
            boot: 12,
            uptime_ms: 3_600_000,
            current: Microamps::from_amps(-35),
            charge: Nanocoulombs::from_coulombs(50_000),
            soc: Ppm(512_345),
            supply: Millivolts(5_003),
            temperature: Some(MilliCelsius(31_250)),
            ..LogRecord::default()
        };
        assert_eq!(usual.encode(&mut buffer).unwrap().len(), 34);
    }

    #[test]
    fn a_buffer_too_small_is_an_error_at_every_length() {
        let mut buffer = [0; MAX_STATE_BYTES];
        for length in 0..MAX_STATE_BYTES {
            let small = &mut buffer[..length];
            assert_eq!(largest_state().encode(small), Err(RetainedError::NoSpace));
        }
        assert!(largest_state().encode(&mut buffer).is_ok());
    }

    #[test]
    fn truncated_or_extended_is_rejected() {
        let mut buffer = [0; 200];
        let length = largest_state().encode(&mut buffer).unwrap().len();
        for cut in 0..length {
            let error = RetainedState::decode(&buffer[..cut]).unwrap_err();
            let short = cut <= CHECKSUM_BYTES;
            assert_eq!(error == RetainedError::TooShort, short, "{cut} {error:?}");
        }
        assert_eq!(
            RetainedState::decode(&buffer[..=length]),
            Err(RetainedError::Checksum)
        );
        assert_eq!(
            RetainedState::decode(&buffer[..length]),
            Ok(largest_state())
        );
    }

    #[test]
    fn the_right_checksum_is_not_enough() {
        let mut buffer = [0; 200];
        let bytes = largest_log().encode(&mut buffer).unwrap();
        assert_eq!(RetainedState::decode(bytes), Err(RetainedError::Kind(LOG)));
        let sealed = |body: &[u8]| {
            let mut bytes = body.to_vec();
            bytes.extend(CHECKSUM.checksum(body).to_le_bytes());
            bytes
        };
        let next_version = sealed(&[STATE + 1, 0, 0, 0]);
        assert_eq!(
            RetainedState::decode(&next_version),
            Err(RetainedError::Kind(STATE + 1))
        );
        assert_eq!(
            RetainedState::decode(&sealed(&[STATE, 1])),
            Err(RetainedError::Content)
        );
        let mut longer = [0; 200];
        let used = write_body(STATE, &largest_state(), &mut longer).unwrap();
        assert!(RetainedState::decode(&sealed(&longer[..used])).is_ok());
        assert_eq!(
            RetainedState::decode(&sealed(&longer[..=used])),
            Err(RetainedError::Content)
        );
        // CRC-32 of "123456789", as every catalogue gives it.
        assert_eq!(CHECKSUM.checksum(b"123456789"), 0xCBF4_3926);
        // A slot with something behind its state.
        let mut slot = RetainedState::default().to_slot();
        slot[SLOT_BYTES - 5] = 1;
        let checksum = CHECKSUM.checksum(&slot[..SLOT_BYTES - 4]);
        slot[SLOT_BYTES - 4..].copy_from_slice(&checksum.to_le_bytes());
        assert_eq!(RetainedState::from_slot(&slot), Err(RetainedError::Content));
    }

    #[test]
    fn slots_alternate_and_the_newest_counts_across_the_wrap() {
        let mut slots = RetainSlots::empty();
        let mut ram = [[0; SLOT_BYTES]; 2];
        assert_eq!(
            RetainSlots::recover(&ram[0], &ram[1]),
            Err([RetainedError::Checksum; 2])
        );
        slots.sequence = u32::MAX - 2;
        for n in 0..6u32 {
            let state = RetainedState {
                charge_total: Nanocoulombs(i64::from(n)),
                ..RetainedState::default()
            };
            let (slot, bytes) = slots.write(&state);
            assert_eq!(slot, if n % 2 == 0 { Slot::A } else { Slot::B });
            ram[(n % 2) as usize] = bytes;
            let (found, next) = RetainSlots::recover(&ram[0], &ram[1]).unwrap();
            assert_eq!(found.charge_total, state.charge_total);
            assert_eq!(found.sequence, (u32::MAX - 2).wrapping_add(n));
            assert_eq!(next, slots);
        }
        assert!(!newer(5, 5) && newer(6, 5) && !newer(5, 6));
        assert!(newer(0, u32::MAX) && !newer(u32::MAX, 0));
        assert!(newer(1 << 31, 1) && !newer((1 << 31) + 1, 1));
        // Twice the same sequence number: the first slot.
        let twin = |total| {
            RetainedState {
                charge_total: Nanocoulombs(total),
                ..RetainedState::default()
            }
            .to_slot()
        };
        let (found, next) = RetainSlots::recover(&twin(1), &twin(2)).unwrap();
        assert_eq!((found.charge_total.get(), next.next), (1, Slot::B));
    }

    #[test]
    fn a_reset_after_any_word_of_a_write_leaves_a_valid_state() {
        let state = |total| RetainedState {
            charge_total: Nanocoulombs(total),
            ..largest_state()
        };
        let mut slots = RetainSlots::empty();
        let first = slots.write(&state(1)).1;
        let second = slots.write(&state(2)).1;
        let (slot, third) = slots.write(&state(3));
        assert_eq!(slot, Slot::A);
        let (old, new) = (to_words(&first), to_words(&third));
        for written in 0..=SLOT_WORDS {
            let mut words = old;
            words[..written].copy_from_slice(&new[..written]);
            let (found, next) = RetainSlots::recover(&from_words(&words), &second).unwrap();
            let complete = words == new;
            assert_eq!(
                found.charge_total.get(),
                if complete { 3 } else { 2 },
                "{written}"
            );
            assert_eq!(next.next, if complete { Slot::B } else { Slot::A });
        }
        let garbage = [0xA5; SLOT_BYTES];
        let (found, next) = RetainSlots::recover(&garbage, &second).unwrap();
        assert_eq!((found.charge_total.get(), next.next), (2, Slot::A));
        let (found, next) = RetainSlots::recover(&third, &garbage).unwrap();
        assert_eq!((found.charge_total.get(), next.next), (3, Slot::B));
        assert_eq!(
            RetainSlots::recover(&garbage, &garbage),
            Err([RetainedError::Checksum, RetainedError::Checksum])
        );
    }

    #[test]
    fn saving_follows_charge_and_time() {
        let config = SavePolicyConfig::default();
        assert_eq!(config.charge_interval, Nanocoulombs(360_000_000_000));
        let at = |seconds: u64| Instant::from_ticks(seconds * 1_000_000);
        let total = |nc: i64| Nanocoulombs(1_000 + nc);
        let mut policy = SavePolicy::new(at(10), total(0));
        let due =
            |policy: &SavePolicy, seconds, nc: i64| policy.due(&config, at(seconds), total(nc));
        assert!(!due(&policy, 11, 359_999_999_999));
        assert!(due(&policy, 11, 360_000_000_000));
        assert!(due(&policy, 11, -360_000_000_000));
        assert!(!due(&policy, 69, 1));
        assert!(due(&policy, 70, 1));
        assert!(due(&policy, 70, -1));
        // An anchor of the state of charge leaves the counter as it is.
        assert!(!due(&policy, 69, 0));
        assert!(due(&policy, 70, 0));
        policy.saved(at(70), total(1));
        assert!(!due(&policy, 129, 0));
        assert!(due(&policy, 130, 0));
        assert!(due(&policy, 130, 1));
        // No interval configured: every change, and by the time alone without one.
        let always = SavePolicyConfig {
            charge_interval: Nanocoulombs::ZERO,
            ..config
        };
        assert!(!policy.due(&always, at(70), total(1)) && policy.due(&always, at(70), total(2)));
    }

    #[test]
    fn the_loss_is_at_most_one_interval_and_the_latency() {
        let config = SavePolicyConfig::default();
        let bound = |current, latency_ms: u64| {
            config
                .loss_bound(
                    Microamps::from_amps(current),
                    Duration::from_ticks(latency_ms * 1_000),
                )
                .get()
        };
        // 600 A: 360 C come before 60 s, and 600 C in the second until it is written.
        assert_eq!(bound(600, 1_000), 960_000_000_000);
        assert_eq!(bound(-600, 1_000), 960_000_000_000);
        // 5 A: 300 C in 60 s.
        assert_eq!(bound(5, 0), 300_000_000_000);
        assert_eq!(bound(600, 0), 360_000_000_000);
        let endless = config.loss_bound(Microamps(i32::MIN), Duration::from_ticks(u64::MAX));
        assert_eq!(endless, Nanocoulombs(i64::MAX));
    }

    #[test]
    fn every_error_says_what_it_is() {
        for (error, part) in [
            (RetainedError::TooShort, "too short"),
            (RetainedError::Checksum, "CRC"),
            (RetainedError::Kind(0xA2), "0xa2"),
            (RetainedError::Content, "content"),
            (RetainedError::NoSpace, "buffer"),
        ] {
            assert!(error.to_string().contains(part));
        }
    }

    proptest! {
        #[test]
        fn records_come_back_as_they_were(state in any_state(), log in any_log()) {
            let mut buffer = [0xFF; 200];
            let bytes = state.encode(&mut buffer).unwrap();
            prop_assert!(bytes.len() <= MAX_STATE_BYTES);
            prop_assert_eq!(RetainedState::decode(bytes), Ok(state));
            prop_assert_eq!(RetainedState::from_slot(&state.to_slot()), Ok(state));
            prop_assert_eq!(from_words(&to_words(&state.to_slot())), state.to_slot());
            let bytes = log.encode(&mut buffer).unwrap();
            prop_assert!(bytes.len() <= MAX_LOG_BYTES);
            prop_assert_eq!(LogRecord::decode(bytes), Ok(log));
        }

        #[test]
        fn one_bit_changed_is_rejected(state in any_state(), log in any_log()) {
            let mut buffer = [0; 200];
            let length = state.encode(&mut buffer).unwrap().len();
            for bit in 0..length * 8 {
                buffer[bit / 8] ^= 1 << (bit % 8);
                prop_assert_eq!(RetainedState::decode(&buffer[..length]), Err(RetainedError::Checksum));
                buffer[bit / 8] ^= 1 << (bit % 8);
            }
            let length = log.encode(&mut buffer).unwrap().len();
            for bit in 0..length * 8 {
                buffer[bit / 8] ^= 1 << (bit % 8);
                prop_assert_eq!(LogRecord::decode(&buffer[..length]), Err(RetainedError::Checksum));
                buffer[bit / 8] ^= 1 << (bit % 8);
            }
            let mut slot = state.to_slot();
            for bit in 0..SLOT_BYTES * 8 {
                slot[bit / 8] ^= 1 << (bit % 8);
                prop_assert_eq!(RetainedState::from_slot(&slot), Err(RetainedError::Checksum));
                slot[bit / 8] ^= 1 << (bit % 8);
            }
        }

        #[test]
        fn no_bytes_panic(mut bytes in proptest::collection::vec(any::<u8>(), 0..200), seal: bool, kind: bool) {
            // Half of them with a right checksum, so that the content is reached.
            if seal && bytes.len() > 5 {
                bytes[0] = if kind { STATE } else { LOG };
                let body = bytes.len() - 4;
                let checksum = CHECKSUM.checksum(&bytes[..body]).to_le_bytes();
                bytes[body..].copy_from_slice(&checksum);
            }
            let _ = RetainedState::decode(&bytes);
            let _ = LogRecord::decode(&bytes);
            let mut slots = [[0; SLOT_BYTES]; 2];
            for (index, byte) in bytes.iter().enumerate() {
                slots[index / SLOT_BYTES % 2][index % SLOT_BYTES] = *byte;
            }
            let _ = RetainSlots::recover(&slots[0], &slots[1]);
        }

        /// Power fails at any moment: what is in flash differs from the counter by no more than the bound.
        #[test]
        fn the_stated_bound_on_the_loss_holds(
            steps in proptest::collection::vec((1..=100_000i64, -600_000_000..=600_000_000i64), 1..400),
            charge_interval_c in 0..50i64, time_interval_s in 1..20u32,
        ) {
            let config = SavePolicyConfig {
                charge_interval: Nanocoulombs::from_coulombs(charge_interval_c), time_interval_s,
            };
            let bound = config.loss_bound(Microamps::from_amps(600), Duration::from_ticks(100_000));
            let (mut now, mut total, mut in_flash) = (0u64, 0i64, 0i64);
            let mut policy = SavePolicy::new(Instant::from_ticks(0), Nanocoulombs(0));
            for (us, microamps) in steps {
                now += us as u64;
                total += microamps * us / 1_000;
                prop_assert!((total - in_flash).abs() <= bound.get(), "{total} {in_flash} {bound:?}");
                if policy.due(&config, Instant::from_ticks(now), Nanocoulombs(total)) {
                    policy.saved(Instant::from_ticks(now), Nanocoulombs(total));
                    in_flash = total;
                }
            }
        }

        #[test]
        fn the_policy_never_panics(a: u64, b: u64, x: i64, y: i64, interval: i64, seconds: u32, i: i32) {
            let config = SavePolicyConfig { charge_interval: Nanocoulombs(interval), time_interval_s: seconds };
            let policy = SavePolicy::new(Instant::from_ticks(a), Nanocoulombs(x));
            let _ = policy.due(&config, Instant::from_ticks(b), Nanocoulombs(y));
            let _ = config.loss_bound(Microamps(i), Duration::from_ticks(a));
        }
    }
}
