//! Virtual time.

use std::ops::{Add, AddAssign, Sub};

/// A point in virtual time or a length of it, in units of 1/336 µs: every clock of the MCU (168, 84, 42, 21, 16 and
/// 8 MHz, LSI's 32 kHz) has a whole number of them per period.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Ticks(pub u64);

impl Ticks {
    /// Units per second.
    pub const PER_SECOND: u64 = 336_000_000;
    /// Units per microsecond.
    pub const PER_MICROSECOND: u64 = 336;

    /// Whole microseconds.
    pub const fn from_micros(us: u64) -> Self {
        Self(us * Self::PER_MICROSECOND)
    }

    /// Whole milliseconds.
    pub const fn from_millis(ms: u64) -> Self {
        Self(ms * 1_000 * Self::PER_MICROSECOND)
    }

    /// The nearest unit; negative times are 0.
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "saturates"
    )]
    pub fn from_seconds(s: f64) -> Self {
        Self((s * Self::PER_SECOND as f64).round() as u64)
    }

    /// In seconds.
    pub fn seconds(self) -> f64 {
        self.0 as f64 / Self::PER_SECOND as f64
    }

    /// In microseconds.
    pub fn micros(self) -> f64 {
        self.0 as f64 / Self::PER_MICROSECOND as f64
    }

    /// The time from `earlier` to here; 0 if it is not earlier.
    pub const fn since(self, earlier: Self) -> Self {
        Self(self.0.saturating_sub(earlier.0))
    }
}

impl Add for Ticks {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self(self.0 + other.0)
    }
}

impl AddAssign for Ticks {
    fn add_assign(&mut self, other: Self) {
        self.0 += other.0;
    }
}

impl Sub for Ticks {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        Self(self.0.saturating_sub(other.0))
    }
}
