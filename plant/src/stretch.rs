//! Time in pieces within which every signal is a straight line.

/// A quantity that moves linearly from `start` to `end`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Linear {
    /// At the beginning.
    pub start: f64,
    /// At the end.
    pub end: f64,
}

impl Linear {
    /// A quantity that stays as it is.
    pub const fn constant(value: f64) -> Self {
        Self {
            start: value,
            end: value,
        }
    }

    /// Its value at `fraction` (0 … 1) of the stretch.
    pub fn at(self, fraction: f64) -> f64 {
        self.start + (self.end - self.start) * fraction
    }

    /// Its mean.
    pub fn mean(self) -> f64 {
        0.5 * (self.start + self.end)
    }

    /// The part of it between two fractions.
    pub fn part(self, from: f64, to: f64) -> Self {
        Self {
            start: self.at(from),
            end: self.at(to),
        }
    }
}

/// What the analogue front end hands on: a stretch of time without an edge of the range flag inside.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stretch {
    /// Beginning, in s.
    pub start_s: f64,
    /// End, in s.
    pub end_s: f64,
    /// Current through the conductor, in A; positive = discharge.
    pub current_a: Linear,
    /// Input of the ADS1100 (output of the switch), in V.
    pub converter_v: Linear,
    /// Differential channel 1 of the ADE7753, in V.
    pub meter_v1_v: Linear,
    /// Output of the open-sensor network at the MCU's pin, in V.
    pub network_v: Linear,
    /// Supply of the Hall sensors, in V.
    pub sensor_supply_v: Linear,
    /// Supply and so reference of the ADS1100, in V.
    pub converter_supply_v: Linear,
    /// The range flag throughout: high = large sensor.
    pub range_high: bool,
}
