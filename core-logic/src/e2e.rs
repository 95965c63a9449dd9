//! End-to-end protection of a CAN frame: AUTOSAR E2E profile 11, variant C (AUTOSAR FO PRS E2E Protocol, profile 11).
//!
//! Byte 0 carries the CRC, the low half of byte 1 the counter (0 … 14), its high half the data ID's bits 11 … 8. The
//! CRC-8 has SAE J1850's polynomial 0x1D with start value and final XOR 0, and runs over the data ID's low byte, a zero
//! byte and then bytes 1 … 7. It finds every error of one or two bits and every burst of up to seven within a frame (the
//! polynomial is primitive: Hamming distance 3 up to 247 bits; the tests below try them all). Of the bursts of eight one
//! stays hidden, because the CRC goes before the data it protects.

use crate::units::{Duration, Instant, elapsed};
use crc::{Algorithm, Crc, Table};

/// Payload of a classic CAN frame.
pub type Payload = [u8; 8];

/// Number of counter values; 15 is reserved.
pub const COUNTER_MODULO: u8 = 15;

const ALGORITHM: Algorithm<u8> = Algorithm {
    width: 8,
    poly: 0x1D,
    init: 0x00,
    refin: false,
    refout: false,
    xorout: 0x00,
    check: 0x37,
    residue: 0x00,
};
const CRC: Crc<u8, Table<1>> = Crc::<u8, Table<1>>::new(&ALGORITHM);

/// A 12-bit data ID: bits 11 … 8 are sent, bits 7 … 0 enter the CRC only.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct DataId(u16);

impl DataId {
    /// Of the low 12 bits of `id`.
    #[must_use]
    pub const fn new(id: u16) -> Self {
        Self(id & 0x0FFF)
    }

    /// The number.
    #[must_use]
    pub const fn get(self) -> u16 {
        self.0
    }

    const fn high_nibble(self) -> u8 {
        let [high, _] = self.0.to_be_bytes();
        high
    }

    const fn low_byte(self) -> u8 {
        let [_, low] = self.0.to_be_bytes();
        low
    }
}

/// The sender's counter of one message: 0 … 14, then 0 again.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Sequence(u8);

impl Sequence {
    /// The counter for the next frame.
    #[must_use]
    pub const fn advance(&mut self) -> u8 {
        let counter = self.0;
        self.0 = if counter >= COUNTER_MODULO - 1 {
            0
        } else {
            counter + 1
        };
        counter
    }
}

fn checksum(id: DataId, payload: &Payload) -> u8 {
    let [_, protected @ ..] = payload;
    let mut digest = CRC.digest();
    digest.update(&[id.low_byte(), 0x00]);
    digest.update(protected);
    digest.finalize()
}

/// Writes data ID nibble, `counter` (its low four bits) and CRC into `payload`.
pub fn protect(id: DataId, counter: u8, payload: &mut Payload) {
    let header = (id.high_nibble() << 4) | (counter & 0x0F);
    let [_, second, ..] = payload;
    *second = header;
    let crc = checksum(id, payload);
    let [first, ..] = payload;
    *first = crc;
}

/// Why a protected frame is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum E2eError {
    /// The CRC does not fit data and data ID.
    Crc,
    /// The CRC fits, the transmitted nibble of the data ID is another message's.
    DataId,
    /// The reserved counter 15.
    ReservedCounter,
    /// The counter of the frame before: the same data once more.
    Repeated,
    /// More frames are missing than the receiver tolerates (or an old one came late).
    WrongSequence {
        /// Frames missing between the last accepted counter and this one, modulo 15.
        lost: u8,
    },
}

/// The counter of a frame whose CRC and data ID are right.
///
/// # Errors
/// [`E2eError::Crc`], [`E2eError::DataId`], [`E2eError::ReservedCounter`].
pub fn verify(id: DataId, payload: &Payload) -> Result<u8, E2eError> {
    let [crc, header, ..] = *payload;
    if crc != checksum(id, payload) {
        return Err(E2eError::Crc);
    }
    if header >> 4 != id.high_nibble() {
        return Err(E2eError::DataId);
    }
    let counter = header & 0x0F;
    if counter >= COUNTER_MODULO {
        return Err(E2eError::ReservedCounter);
    }
    Ok(counter)
}

/// What a receiver tolerates.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ReceiverConfig {
    /// The message's data ID.
    pub data_id: DataId,
    /// Frames that may be missing between two accepted ones.
    pub max_lost: u8,
    /// Time without an accepted frame after which the data counts as missing.
    pub timeout: Duration,
}

/// Receiving side of one message: checks each frame and knows whether the data is still fresh.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Receiver {
    last_counter: Option<u8>,
    last_accepted: Option<Instant>,
}

impl Receiver {
    /// Checks a frame; `Ok` carries the number of frames lost before it.
    ///
    /// The first frame is accepted with any counter, the first after a time-out with any but the last one's: a sender that
    /// repeats one frame stays silent for us. After a wrong sequence the received counter is the new reference, so the
    /// next frame in order is accepted again.
    ///
    /// # Errors
    /// As [`E2eError`]; the payload must then not be used.
    pub fn check(
        &mut self,
        config: &ReceiverConfig,
        now: Instant,
        payload: &Payload,
    ) -> Result<u8, E2eError> {
        let counter = verify(config.data_id, payload)?;
        let lost = match self.last_counter.replace(counter) {
            Some(last) if last == counter => return Err(E2eError::Repeated),
            // Both are below 15: 15 + counter − last − 1 is 0 … 28.
            Some(last) if !self.timed_out(config, now) => {
                (COUNTER_MODULO + counter - last - 1) % COUNTER_MODULO
            }
            _ => 0,
        };
        if lost > config.max_lost {
            return Err(E2eError::WrongSequence { lost });
        }
        self.last_accepted = Some(now);
        Ok(lost)
    }

    /// Whether no frame was accepted within the time-out, or none at all yet.
    #[must_use]
    pub fn timed_out(&self, config: &ReceiverConfig, now: Instant) -> bool {
        self.last_accepted
            .is_none_or(|accepted| elapsed(accepted, now) > config.timeout)
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
    use autosar_e2e::profile11::{Profile11, Profile11Config, Profile11IdMode};
    use autosar_e2e::{E2EProfile, E2EStatus};
    use proptest::prelude::*;
    use std::vec::Vec;

    const CONFIG: ReceiverConfig = ReceiverConfig {
        data_id: DataId::new(0x123),
        max_lost: 2,
        timeout: Duration::from_ticks(500_000),
    };

    fn oracle(id: u16, max_delta_counter: u8) -> Profile11 {
        Profile11::new(Profile11Config {
            mode: Profile11IdMode::Nibble,
            data_id: id,
            max_delta_counter,
            ..Default::default()
        })
        .unwrap()
    }

    fn frame(id: DataId, counter: u8, user: [u8; 6]) -> Payload {
        let mut payload = [0; 8];
        payload[2..].copy_from_slice(&user);
        protect(id, counter, &mut payload);
        payload
    }

    fn at(milliseconds: u64) -> Instant {
        Instant::from_ticks(milliseconds * 1_000)
    }

    #[test]
    fn the_specifications_examples() {
        // AUTOSAR FO PRS E2E Protocol, examples of profile 11: data ID 0x123, nibble, all data zero.
        let id = DataId::new(0x123);
        assert_eq!(frame(id, 0, [0; 6]), [0x2A, 0x10, 0, 0, 0, 0, 0, 0]);
        assert_eq!(frame(id, 1, [0; 6]), [0x77, 0x11, 0, 0, 0, 0, 0, 0]);
        assert_eq!(CRC.checksum(b"123456789"), ALGORITHM.check);
        assert_eq!(DataId::new(0xF123), id);
        assert_eq!(id.get(), 0x123);
    }

    #[test]
    fn the_counter_runs_from_0_to_14() {
        let mut sequence = Sequence::default();
        let seen: Vec<u8> = (0..32).map(|_| sequence.advance()).collect();
        let expected: Vec<u8> = (0..32).map(|n| n % 15).collect();
        assert_eq!(seen, expected);
    }

    #[test]
    fn each_error_by_its_name() {
        let id = CONFIG.data_id;
        let mut broken = frame(id, 3, [1, 2, 3, 4, 5, 6]);
        broken[7] ^= 0x80;
        assert_eq!(verify(id, &broken), Err(E2eError::Crc));
        // The same low byte, so the same CRC rule, but another message's nibble.
        let other = frame(DataId::new(0x223), 3, [1, 2, 3, 4, 5, 6]);
        assert_eq!(verify(id, &other), Err(E2eError::DataId));
        assert_eq!(
            verify(id, &frame(id, 15, [0; 6])),
            Err(E2eError::ReservedCounter)
        );
        assert_eq!(verify(id, &frame(id, 14, [0; 6])), Ok(14));
    }

    #[test]
    fn a_receiver_sees_loss_repetition_order_and_silence() {
        let mut receiver = Receiver::default();
        let id = CONFIG.data_id;
        let mut take = |counter, ms| receiver.check(&CONFIG, at(ms), &frame(id, counter, [7; 6]));
        assert_eq!(take(13, 0), Ok(0));
        assert_eq!(take(14, 100), Ok(0));
        assert_eq!(take(0, 200), Ok(0));
        assert_eq!(take(0, 210), Err(E2eError::Repeated));
        assert_eq!(take(3, 300), Ok(2));
        assert_eq!(take(7, 400), Err(E2eError::WrongSequence { lost: 3 }));
        assert_eq!(take(8, 500), Ok(0));
        // One step back looks like 13 lost.
        assert_eq!(take(7, 600), Err(E2eError::WrongSequence { lost: 13 }));
        assert_eq!(take(8, 700), Ok(0));
        // After silence any counter starts anew, but the one before.
        assert_eq!(take(8, 1_200), Err(E2eError::Repeated));
        assert_eq!(take(8, 1_201), Err(E2eError::Repeated));
        assert_eq!(take(3, 1_202), Ok(0));
    }

    #[test]
    fn a_sender_that_repeats_one_frame_for_ever_is_accepted_once() {
        let mut receiver = Receiver::default();
        let frozen = frame(CONFIG.data_id, 7, [1, 2, 3, 4, 5, 6]);
        for ms in (0..60_000).step_by(100) {
            let expected = match ms {
                0 => Ok(0),
                _ => Err(E2eError::Repeated),
            };
            assert_eq!(
                receiver.check(&CONFIG, at(ms), &frozen),
                expected,
                "{ms} ms"
            );
        }
        assert!(receiver.timed_out(&CONFIG, at(60_000)));
        let next = frame(CONFIG.data_id, 8, [1, 2, 3, 4, 5, 6]);
        assert_eq!(receiver.check(&CONFIG, at(60_000), &next), Ok(0));
    }

    #[test]
    fn fresh_until_the_time_out_and_only_by_accepted_frames() {
        let mut receiver = Receiver::default();
        assert!(receiver.timed_out(&CONFIG, at(0)));
        let good = frame(CONFIG.data_id, 0, [0; 6]);
        receiver.check(&CONFIG, at(1_000), &good).unwrap();
        assert!(!receiver.timed_out(&CONFIG, at(1_500)));
        assert_eq!(
            receiver.check(&CONFIG, at(1_500), &good),
            Err(E2eError::Repeated)
        );
        assert!(receiver.timed_out(&CONFIG, at(1_501)));
        // A clock that seems to run backwards does not make data old.
        assert!(!receiver.timed_out(&CONFIG, at(0)));
    }

    #[test]
    fn every_change_of_one_or_two_bits_is_refused() {
        let id = CONFIG.data_id;
        let good = u64::from_le_bytes(frame(id, 9, [0x5A, 0, 0xFF, 0x13, 0x80, 0x01]));
        for a in 0..64 {
            for b in a..64 {
                let flips = (1u64 << a) | (1 << b);
                assert!(
                    verify(id, &(good ^ flips).to_le_bytes()).is_err(),
                    "{flips:#x}"
                );
            }
        }
    }

    #[test]
    fn every_burst_of_seven_bits_is_refused() {
        let id = CONFIG.data_id;
        let good = u64::from_be_bytes(frame(id, 2, [9, 8, 7, 6, 5, 4]));
        for burst in 1..=127u64 {
            for shift in 0..=57 {
                assert!(verify(id, &(good ^ (burst << shift)).to_be_bytes()).is_err());
            }
        }
    }

    proptest! {
        #[test]
        fn agrees_with_the_independent_implementation(id in 0u16..0x1000, user: [u8; 6], frames in 1usize..40) {
            let mut theirs = oracle(id, 1);
            let mut receiving = oracle(id, 1);
            let mut sequence = Sequence::default();
            for _ in 0..frames {
                let ours = frame(DataId::new(id), sequence.advance(), user);
                let mut expected = Vec::from([0u8, 0]);
                expected.extend_from_slice(&user);
                theirs.protect(&mut expected).unwrap();
                prop_assert_eq!(&ours[..], &expected[..]);
                prop_assert_eq!(receiving.check(&ours).unwrap(), E2EStatus::Ok);
            }
        }

        #[test]
        fn receivers_judge_alike(counters in prop::collection::vec(0u8..15, 1..40)) {
            let id = CONFIG.data_id;
            let mut ours = Receiver::default();
            let mut theirs = oracle(id.get(), CONFIG.max_lost + 1);
            // The other implementation starts from counter 0, ours from whatever comes first.
            let counters = core::iter::once(0).chain(counters);
            for counter in counters {
                let payload = frame(id, counter, [3; 6]);
                let mine = ours.check(&CONFIG, at(0), &payload);
                let expected = theirs.check(&payload).unwrap();
                match expected {
                    E2EStatus::Ok => prop_assert_eq!(mine, Ok(0)),
                    E2EStatus::OkSomeLost => prop_assert!(matches!(mine, Ok(1..=2)), "{:?}", mine),
                    E2EStatus::Repeated => prop_assert_eq!(mine, Err(E2eError::Repeated)),
                    _ => prop_assert!(
                        matches!(mine, Err(E2eError::WrongSequence { lost: 3.. })),
                        "{:?}", mine
                    ),
                }
            }
        }

        #[test]
        fn any_bytes_are_judged_without_a_panic(payload: [u8; 8], id: u16, now: u64) {
            let config = ReceiverConfig { data_id: DataId::new(id), ..CONFIG };
            let mut receiver = Receiver::default();
            let accepted = receiver.check(&config, Instant::from_ticks(now), &payload).is_ok();
            prop_assert_eq!(accepted, verify(config.data_id, &payload).is_ok());
        }

        #[test]
        fn a_frame_of_another_message_is_refused(a in 0u16..0x1000, b in 0u16..0x1000, user: [u8; 6]) {
            prop_assume!(a != b);
            let payload = frame(DataId::new(a), 5, user);
            prop_assert!(verify(DataId::new(b), &payload).is_err());
        }
    }
}
