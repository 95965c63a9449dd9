//! D2: the sliding average of the last valid currents.
//!
//! - The sum is kept as an integer, so it never drifts from the samples it stands for.
//! - **Only valid readings enter.** An invalid one neither enters nor pushes another out; [`Average::newest`] and
//!   [`Average::covers`] tell what the average stands for.
//! - **Gap.** When no valid reading came for longer than [`SlidingAverageConfig::max_gap_ms`], what is stored describes
//!   another time: the average is empty until a valid reading starts it anew.
//! - **Fault.** Readings that looked sound and were none are in it when a fault is found: its owner empties it when that ends.
//! - **Other sensor or correction.** What was read by the one before is not of this one: its owner empties it here too. Another supply
//!   is followed without that.
//! - **Range change.** Currents are amperes whichever sensor gave them, so the window spans a range change; the
//!   readings around the edge are invalid and stay out.

use serde::{Deserialize, Serialize};

use crate::converter::CurrentReading;
use crate::design_parameters as design;
use crate::units::{Duration, Instant, Microamps, elapsed};

/// Longest settable length.
pub const MAX_LENGTH: usize = 64;
/// Settable lengths.
pub const LENGTH_LIMITS: (u8, u8) = (1, 64);
/// Settable gaps in milliseconds; no less than two conversions (`configuration::Contradiction::AverageGap`).
pub const GAP_LIMITS_MS: (u32, u32) = (100, 60_000);

/// Configuration of the average.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct SlidingAverageConfig {
    /// Readings in the window, [`LENGTH_LIMITS`]; a value outside is taken as the nearer limit.
    pub length: u8,
    /// Time without a valid reading after which the window is emptied.
    pub max_gap_ms: u32,
}

impl Default for SlidingAverageConfig {
    fn default() -> Self {
        Self {
            length: design::AVERAGE_LENGTH,
            max_gap_ms: design::AVERAGE_MAX_GAP_MS,
        }
    }
}

impl SlidingAverageConfig {
    /// Whether both values are within their limits.
    #[must_use]
    pub fn is_valid(&self) -> bool {
        (LENGTH_LIMITS.0..=LENGTH_LIMITS.1).contains(&self.length)
            && (GAP_LIMITS_MS.0..=GAP_LIMITS_MS.1).contains(&self.max_gap_ms)
    }

    fn window(&self) -> usize {
        usize::from(self.length.clamp(LENGTH_LIMITS.0, LENGTH_LIMITS.1))
    }

    fn max_gap(&self) -> Duration {
        Duration::from_ticks(u64::from(self.max_gap_ms) * 1_000)
    }
}

/// The mean of the window and what it stands for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Average {
    /// Mean, rounded to the nearest µA, halves away from zero.
    pub current: Microamps,
    /// Readings in it.
    pub count: u8,
    /// From the oldest to the newest reading in it.
    pub covers: Duration,
    /// When the newest reading was taken.
    pub newest: Instant,
}

/// State of the average.
#[derive(Clone, Copy, Debug)]
pub struct SlidingAverage {
    samples: [(Microamps, Instant); MAX_LENGTH],
    /// Where the next sample goes.
    next: usize,
    count: usize,
    sum: i64,
}

impl Default for SlidingAverage {
    fn default() -> Self {
        Self::new()
    }
}

impl SlidingAverage {
    /// Empty.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            samples: [(Microamps::ZERO, Instant::from_ticks(0)); MAX_LENGTH],
            next: 0,
            count: 0,
            sum: 0,
        }
    }

    /// Empties the window.
    #[inline(never)]
    pub const fn clear(&mut self) {
        self.next = 0;
        self.count = 0;
        self.sum = 0;
    }

    /// Takes a reading, if it is valid. A length that was shortened drops the oldest readings, one that was lengthened
    /// keeps all.
    pub fn push(&mut self, config: &SlidingAverageConfig, reading: &CurrentReading) {
        if !reading.validity.is_valid() {
            return;
        }
        if self
            .newest()
            .is_some_and(|newest| elapsed(newest, reading.at) > config.max_gap())
        {
            self.clear();
        }
        let window = config.window();
        while self.count >= window {
            let (oldest, _) = self.sample(self.count);
            self.sum -= i64::from(oldest.get());
            self.count -= 1;
        }
        if let Some(slot) = self.samples.get_mut(self.next) {
            *slot = (reading.current, reading.at);
        }
        self.next = (self.next + 1) % MAX_LENGTH;
        self.count += 1;
        self.sum += i64::from(reading.current.get());
    }

    /// The average, `None` when the window is empty or its newest reading is older than the gap.
    #[must_use]
    pub fn average(&self, config: &SlidingAverageConfig, now: Instant) -> Option<Average> {
        let newest = self.newest()?;
        if elapsed(newest, now) > config.max_gap() {
            return None;
        }
        let (_, oldest) = self.sample(self.count);
        let count = u8::try_from(self.count).ok()?;
        Some(Average {
            current: Microamps(divide(self.sum, count)),
            count,
            covers: elapsed(oldest, newest),
            newest,
        })
    }

    /// Readings in the window.
    #[must_use]
    pub const fn len(&self) -> usize {
        self.count
    }

    /// Whether the window is empty.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.count == 0
    }

    fn newest(&self) -> Option<Instant> {
        (self.count > 0).then(|| self.sample(1).1)
    }

    /// The sample `age` pushes ago; 1 is the newest.
    fn sample(&self, age: usize) -> (Microamps, Instant) {
        let index = (self.next + MAX_LENGTH - age.min(MAX_LENGTH)) % MAX_LENGTH;
        self.samples
            .get(index)
            .copied()
            .unwrap_or((Microamps::ZERO, Instant::from_ticks(0)))
    }
}

/// `sum / count` rounded to nearest, halves away from zero, for sums of at most [`MAX_LENGTH`] currents. Two 32-bit
/// divisions, which the Cortex-M4 has in hardware, in place of one of 64 bits, which it has not.
fn divide(sum: i64, count: u8) -> i32 {
    let count = u32::from(count.max(1));
    let magnitude = sum.unsigned_abs();
    // |sum| ≤ 64 · 2^31, so the high part has 22 bits, and so has a remainder below 64 with 16 bits behind it.
    let high = u32::try_from(magnitude >> 16).unwrap_or(u32::MAX);
    let low = u32::try_from(magnitude & 0xFFFF).unwrap_or(0);
    let rest = ((high % count) << 16) + low;
    let quotient = (i64::from(high / count) << 16) + i64::from(rest / count);
    let rounded = quotient + i64::from(2 * (rest % count) >= count);
    crate::units::clamp_i32_inline(if sum < 0 { -rounded } else { rounded })
}

#[cfg(test)]
#[allow(
    clippy::unwrap_used,
    clippy::cast_possible_truncation,
    clippy::indexing_slicing
)]
mod tests {
    use super::*;
    use crate::converter::tests::any_validity;
    use crate::range::Range;
    use crate::units::{Microvolts, div_round};
    use crate::validity::Validity;
    use proptest::prelude::*;
    use std::collections::VecDeque;
    use std::vec::Vec;

    const CONFIG: SlidingAverageConfig = SlidingAverageConfig {
        length: 4,
        max_gap_ms: 1_000,
    };

    fn at(us: u64) -> Instant {
        Instant::from_ticks(us)
    }

    fn reading(current: i32, us: u64, validity: Validity) -> CurrentReading {
        CurrentReading {
            current: Microamps(current),
            validity,
            range: Range::Small,
            at: at(us),
            volts: Microvolts::ZERO,
        }
    }

    fn filled(config: &SlidingAverageConfig, currents: &[i32]) -> SlidingAverage {
        let mut average = SlidingAverage::default();
        for (index, current) in currents.iter().enumerate() {
            average.push(
                config,
                &reading(*current, index as u64 * 10, Validity::VALID),
            );
        }
        average
    }

    #[test]
    fn mean_of_the_newest() {
        let average = filled(&CONFIG, &[1_000, 10, 20, 30, 41]);
        let got = average.average(&CONFIG, at(40)).unwrap();
        // (10 + 20 + 30 + 41) / 4 = 25.25
        assert_eq!(got.current, Microamps(25));
        assert_eq!(
            (got.count, got.covers.as_ticks(), got.newest),
            (4, 30, at(40))
        );
        assert_eq!(
            filled(&CONFIG, &[1, 2])
                .average(&CONFIG, at(10))
                .unwrap()
                .current,
            Microamps(2)
        );
        assert_eq!(
            filled(&CONFIG, &[-1, -2])
                .average(&CONFIG, at(10))
                .unwrap()
                .current,
            Microamps(-2)
        );
        let one = filled(&CONFIG, &[7]).average(&CONFIG, at(0)).unwrap();
        assert_eq!(
            (one.current, one.count, one.covers.as_ticks()),
            (Microamps(7), 1, 0)
        );
    }

    #[test]
    fn empty_is_none_and_not_0_a() {
        let mut average = SlidingAverage::new();
        assert!(average.is_empty());
        assert_eq!(average.average(&CONFIG, at(0)), None);
        average.push(&CONFIG, &reading(5, 0, Validity::STALE));
        assert_eq!(average.average(&CONFIG, at(0)), None);
        average.push(&CONFIG, &reading(5, 0, Validity::VALID));
        assert!(!average.is_empty());
        average.clear();
        assert_eq!((average.len(), average.average(&CONFIG, at(0))), (0, None));
        average.push(&CONFIG, &reading(9, 0, Validity::VALID));
        assert_eq!(
            average.average(&CONFIG, at(0)).unwrap().current,
            Microamps(9)
        );
    }

    #[test]
    fn length_changes_keep_what_is_sensible() {
        let mut average = filled(&CONFIG, &[1, 2, 3, 4]);
        let longer = SlidingAverageConfig {
            length: 6,
            ..CONFIG
        };
        average.push(&longer, &reading(5, 40, Validity::VALID));
        let got = average.average(&longer, at(40)).unwrap();
        assert_eq!((got.count, got.current), (5, Microamps(3)));
        let shorter = SlidingAverageConfig {
            length: 2,
            ..CONFIG
        };
        average.push(&shorter, &reading(7, 50, Validity::VALID));
        let got = average.average(&shorter, at(50)).unwrap();
        assert_eq!(
            (got.count, got.current, got.covers.as_ticks()),
            (2, Microamps(6), 10)
        );
    }

    #[test]
    fn a_gap_empties_the_window() {
        let mut average = filled(&CONFIG, &[1, 2, 3]);
        assert!(average.average(&CONFIG, at(1_000_020)).is_some());
        assert_eq!(average.average(&CONFIG, at(1_000_021)), None);
        let mut in_time = average;
        in_time.push(&CONFIG, &reading(6, 1_000_020, Validity::VALID));
        assert_eq!(
            in_time.average(&CONFIG, at(1_000_020)).unwrap().current,
            Microamps(3)
        );
        average.push(&CONFIG, &reading(6, 1_000_021, Validity::VALID));
        let got = average.average(&CONFIG, at(1_000_021)).unwrap();
        assert_eq!((got.count, got.current), (1, Microamps(6)));
    }

    #[test]
    fn limits_of_the_configuration() {
        assert!(SlidingAverageConfig::default().is_valid());
        let valid = |length, max_gap_ms| SlidingAverageConfig { length, max_gap_ms }.is_valid();
        assert!(valid(1, 100) && valid(64, 60_000));
        assert!(!valid(0, 1_000) && !valid(65, 1_000));
        assert!(!valid(8, 99) && !valid(8, 60_001));
        assert_eq!(usize::from(LENGTH_LIMITS.1), MAX_LENGTH);
        // Outside, the nearer limit counts.
        let filled_64 = filled(
            &SlidingAverageConfig {
                length: 200,
                ..CONFIG
            },
            &[3; 100],
        );
        assert_eq!(filled_64.len(), 64);
        assert_eq!(
            filled(
                &SlidingAverageConfig {
                    length: 0,
                    ..CONFIG
                },
                &[3; 100]
            )
            .len(),
            1
        );
        assert_eq!(filled_64.average(&CONFIG, at(990)).unwrap().count, 64);
    }

    proptest! {
        #[test]
        fn equals_a_recomputed_mean(
            pushes in prop::collection::vec((any::<i32>(), any_validity(), 1..=70_u8, 0..600_000_u64), 1..200)
        ) {
            let mut average = SlidingAverage::new();
            let mut model: VecDeque<(i32, u64)> = VecDeque::new();
            let mut now = 0;
            for (current, validity, length, step) in pushes {
                now += step;
                let config = SlidingAverageConfig { length, ..CONFIG };
                average.push(&config, &reading(current, now, validity));
                if validity.is_valid() {
                    if model.back().is_some_and(|(_, newest)| now - newest > 1_000_000) {
                        model.clear();
                    }
                    model.push_back((current, now));
                    while model.len() > usize::from(length.min(64)) {
                        model.pop_front();
                    }
                }
                let sum: i64 = model.iter().map(|(current, _)| i64::from(*current)).sum();
                prop_assert_eq!(average.sum, sum);
                prop_assert_eq!(average.len(), model.len());
                let expected = model.back().filter(|(_, newest)| now - newest <= 1_000_000).map(|(_, newest)| Average {
                    current: Microamps(div_round(sum, model.len() as i64) as i32),
                    count: model.len() as u8,
                    covers: elapsed(at(model[0].1), at(*newest)),
                    newest: at(*newest),
                });
                prop_assert_eq!(average.average(&config, at(now)), expected);
            }
        }

        #[test]
        fn short_division_is_exact(currents in prop::collection::vec(any::<i32>(), 1..=64)) {
            let sum: i64 = currents.iter().map(|current| i64::from(*current)).sum();
            let count = currents.len() as u8;
            prop_assert_eq!(i64::from(divide(sum, count)), div_round(sum, i64::from(count)));
            prop_assert_eq!(divide(-sum, count), -divide(sum, count));
        }

        #[test]
        fn nothing_panics(pushes in prop::collection::vec(any::<(i32, u64, u8, u8, u32)>(), 1..100), now: u64) {
            let mut average = SlidingAverage::new();
            for (current, us, validity, length, max_gap_ms) in pushes {
                let config = SlidingAverageConfig { length, max_gap_ms };
                average.push(&config, &reading(current, us, Validity::from_bits(validity & 1)));
                let _ = average.average(&config, at(now));
            }
        }
    }

    #[test]
    fn ends_of_the_sum() {
        for value in [i32::MAX, i32::MIN] {
            let readings: Vec<i32> = std::iter::repeat_n(value, 64).collect();
            let config = SlidingAverageConfig {
                length: 64,
                ..CONFIG
            };
            let got = filled(&config, &readings)
                .average(&config, at(640))
                .unwrap();
            assert_eq!(got.current, Microamps(value));
        }
        assert_eq!(divide(5, 0), 5);
    }
}
