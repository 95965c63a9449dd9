//! Whether readings that should be of one value are: both calibrations of a zero ask it.

use crate::units::{clamp_i32, div_round};

/// Parts of a run of noisy readings whose means are compared. If no current flowed in one of the four, the zero is off by three quarters of the
/// spread at most, as it is by the whole spread if none flowed in one reading of those that have no noise. More parts would be too short to be
/// free of noise: at D3's 0.25 A (rms; 0.11 A of it are the reference's, alike in neighbours) the means of 64 readings' quarters lie further apart
/// than 0.5 A in 0.4 % of all runs, those of its eighths in 5 %. The key-state factors' 16 readings have quarters of four, with 0.16 A of noise
/// (√(0.235² / 4 + 0.11²)) beside a limit of 2 mV, 1.1 A at 1.8 mV/A.
const NOISY_PARTS: u16 = 4;
/// The mean of a quarter of 64 readings has a quarter of a reading's noise. Of D3's, 64 lie further apart than 2 A once in thousands of runs.
const NOISY_SPREADS: i32 = 4;

/// What readings are compared with.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Limit {
    /// Largest distance between the lowest and the highest of them; with noise between the means of the run's quarters, and
    /// `NOISY_SPREADS` times as much between single ones.
    pub(crate) spread: i32,
    /// Readings of a run.
    pub(crate) samples: u16,
    /// They are of ADC1 (D3), whose noise alone spreads them further than a zero may.
    pub(crate) noisy: bool,
}

/// A run of readings, in their unit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Steadiness {
    taken: u16,
    sum: i64,
    readings: Extent,
    means: Extent,
    /// Of the parts that are complete.
    parts_sum: i64,
}

impl Steadiness {
    /// Without a reading.
    pub(crate) const EMPTY: Self = Self {
        taken: 0,
        sum: 0,
        readings: Extent::EMPTY,
        means: Extent::EMPTY,
        parts_sum: 0,
    };

    /// Takes a reading in; `true` when the run is complete: a part that is begun is, too.
    ///
    /// # Errors
    /// How far readings, or the means of parts, lie apart if that is too far.
    pub(crate) fn take(&mut self, limit: Limit, value: i32) -> Result<bool, i32> {
        self.taken = self.taken.saturating_add(1);
        self.sum += i64::from(value);
        let (part, spreads) = if limit.noisy {
            ((limit.samples / NOISY_PARTS).max(1), NOISY_SPREADS)
        } else {
            (1, 1)
        };
        let spread = self.readings.widened(value);
        if spread > limit.spread.saturating_mul(spreads) {
            return Err(spread);
        }
        if !self.taken.is_multiple_of(part) {
            return Ok(false);
        }
        let of_part = self.sum - core::mem::replace(&mut self.parts_sum, self.sum);
        let of_means = self
            .means
            .widened(clamp_i32(div_round(of_part, i64::from(part))));
        if of_means > limit.spread {
            return Err(of_means);
        }
        Ok(self.taken >= limit.samples)
    }

    /// Readings taken.
    pub(crate) const fn taken(&self) -> u16 {
        self.taken
    }

    /// Their mean; of at least one.
    pub(crate) fn mean(&self) -> i32 {
        clamp_i32(div_round(self.sum, i64::from(self.taken.max(1))))
    }

    /// From the lowest to the highest.
    pub(crate) fn spread(&self) -> i32 {
        self.readings.width()
    }
}

/// From the lowest to the highest.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Extent {
    low: i32,
    high: i32,
}

impl Extent {
    const EMPTY: Self = Self {
        low: i32::MAX,
        high: i32::MIN,
    };

    /// Takes `value` in, and says how far apart the ends are then. Once in the image: it is asked twice a reading, and flash is short.
    #[inline(never)]
    fn widened(&mut self, value: i32) -> i32 {
        self.low = self.low.min(value);
        self.high = self.high.max(value);
        self.width()
    }

    fn width(&self) -> i32 {
        self.high.saturating_sub(self.low)
    }
}
