//! Supplies over time, and the divider through which the MCU sees one.

use serde::{Deserialize, Serialize};

/// A voltage over time: straight lines between points, held before the first and after the last (fault F15).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SupplyProfile {
    points: Vec<(f64, f64)>,
}

impl Default for SupplyProfile {
    /// 5 V.
    fn default() -> Self {
        Self::constant(5.0)
    }
}

impl SupplyProfile {
    /// Always `volts`.
    pub fn constant(volts: f64) -> Self {
        Self {
            points: vec![(0.0, volts)],
        }
    }

    /// From `from_v` to `to_v` within `start_s` … `end_s`.
    pub fn ramp(from_v: f64, to_v: f64, start_s: f64, end_s: f64) -> Self {
        Self {
            points: vec![(start_s, from_v), (end_s, to_v)],
        }
    }

    /// `volts`, but `low_v` from `start_s` to `end_s`, with edges of `edge_s` inside.
    pub fn dropout(volts: f64, low_v: f64, start_s: f64, end_s: f64, edge_s: f64) -> Self {
        Self {
            points: vec![
                (start_s, volts),
                (start_s + edge_s, low_v),
                (end_s - edge_s, low_v),
                (end_s, volts),
            ],
        }
    }

    /// Any points (time in s, volts); they are put in order of time. `None` for no point at all.
    pub fn from_points(mut points: Vec<(f64, f64)>) -> Option<Self> {
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        (!points.is_empty()).then_some(Self { points })
    }

    /// The voltage at `at_s`, in V.
    pub fn at(&self, at_s: f64) -> f64 {
        let after = self.points.partition_point(|point| point.0 <= at_s);
        let before = self.points[..after].last();
        match (before, self.points.get(after)) {
            (Some(from), Some(to)) => from.1 + (to.1 - from.1) * (at_s - from.0) / (to.0 - from.0),
            (Some(only), None) | (None, Some(only)) => only.1,
            (None, None) => 0.0,
        }
    }
}

/// The divider from the sensors' supply to the MCU's pin.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Divider {
    /// From the supply to the pin, in Ω (*assumed*: the board's description gives the half alone).
    pub upper_ohm: f64,
    /// From the pin to ground, in Ω.
    pub lower_ohm: f64,
}

impl Default for Divider {
    fn default() -> Self {
        Self {
            upper_ohm: 10_000.0,
            lower_ohm: 10_000.0,
        }
    }
}

impl Divider {
    /// Voltage at the pin, in V.
    pub fn output_v(&self, supply_v: f64) -> f64 {
        supply_v * (self.lower_ohm / (self.upper_ohm + self.lower_ohm))
    }
}
