//! Comparators, the OR gate behind them, and patterns that stand in for a gate that chatters.

use serde::{Deserialize, Serialize};

/// Nothing closer to a threshold than this is beyond it, in V: times are rounded.
const RESOLUTION_V: f64 = 1e-9;

/// The two comparators on the small sensor (D0) and the gate behind them.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ComparatorConfig {
    /// Above this the positive one trips, in V at rated supply (D0: 4.5 V, +53.33 A).
    pub high_v: f64,
    /// Below this the negative one trips (D0: 0.5 V, −53.33 A).
    pub low_v: f64,
    /// Way back until it lets go, in V (20 mV, 0.53 A, *assumed*).
    pub hysteresis_v: f64,
    /// Time from the threshold to the gate's output, in s. A change that is taken back within it does not come out.
    pub delay_s: f64,
    /// How far thresholds and hysteresis follow the sensors' supply. 1: divided from it, as the ratiometric sensors
    /// want it; 0: from a reference. With 0 and a supply of 4.5 V the small sensor ends below 4.5 V and never trips.
    pub ratio: f64,
}

impl Default for ComparatorConfig {
    fn default() -> Self {
        Self {
            high_v: 4.5,
            low_v: 0.5,
            hysteresis_v: 0.02,
            delay_s: 0.0,
            ratio: 1.0,
        }
    }
}

/// One of the two.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// Positive current.
    High,
    /// Negative current.
    Low,
}

/// Two comparators, OR gate, delay.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Comparators {
    config: ComparatorConfig,
    high_tripped: bool,
    low_tripped: bool,
    output: bool,
    pending_s: Option<f64>,
}

impl Comparators {
    /// Settled at `input_v`.
    pub fn new(config: ComparatorConfig, input_v: f64, supply_v: f64) -> Self {
        let mut new = Self {
            config,
            high_tripped: false,
            low_tripped: false,
            output: false,
            pending_s: None,
        };
        new.high_tripped = new.excess_v(Side::High, input_v, supply_v) > 0.0;
        new.low_tripped = new.excess_v(Side::Low, input_v, supply_v) > 0.0;
        new.output = new.decision();
        new
    }

    /// Output of the gate, after its delay.
    pub const fn output(&self) -> bool {
        self.output
    }

    /// When the output changes, if nothing happens before.
    pub const fn pending_s(&self) -> Option<f64> {
        self.pending_s
    }

    /// How far the input is beyond the level at which `side` changes, in V.
    pub fn excess_v(&self, side: Side, input_v: f64, supply_v: f64) -> f64 {
        let c = &self.config;
        let follow = 1.0 + (supply_v / crate::hall::RATED_SUPPLY_V - 1.0) * c.ratio;
        let level = |threshold_v: f64, back_v: f64, tripped: bool| {
            follow
                * if tripped {
                    threshold_v + back_v
                } else {
                    threshold_v
                }
        };
        match side {
            Side::High => {
                let over = input_v - level(c.high_v, -c.hysteresis_v, self.high_tripped);
                if self.high_tripped { -over } else { over }
            }
            Side::Low => {
                let under = level(c.low_v, c.hysteresis_v, self.low_tripped) - input_v;
                if self.low_tripped { -under } else { under }
            }
        }
    }

    /// The first change within a step in which input and supply go from `start` to `end` in straight lines: the side,
    /// and the share of the step. 0 when it is due already.
    pub fn first_change(&self, start: (f64, f64), end: (f64, f64)) -> Option<(Side, f64)> {
        let at = |side| {
            let before_v = self.excess_v(side, start.0, start.1);
            let after_v = self.excess_v(side, end.0, end.1);
            if before_v > RESOLUTION_V {
                Some((side, 0.0))
            } else if after_v > 0.0 {
                let before_v = before_v.min(0.0);
                Some((side, -before_v / (after_v - before_v)))
            } else {
                None
            }
        };
        match (at(Side::High), at(Side::Low)) {
            (Some(high), Some(low)) => Some(if low.1 < high.1 { low } else { high }),
            (high, low) => high.or(low),
        }
    }

    /// `side` changes at `at_s`.
    pub fn change(&mut self, side: Side, at_s: f64) {
        match side {
            Side::High => self.high_tripped = !self.high_tripped,
            Side::Low => self.low_tripped = !self.low_tripped,
        }
        if self.decision() == self.output {
            self.pending_s = None;
        } else if self.pending_s.is_none() {
            if self.config.delay_s > 0.0 {
                self.pending_s = Some(at_s + self.config.delay_s);
            } else {
                self.output = self.decision();
            }
        }
    }

    /// The delay is over if it is at `now_s`.
    pub fn advance(&mut self, now_s: f64) {
        if self.pending_s.is_some_and(|at_s| at_s <= now_s) {
            self.pending_s = None;
            self.output = self.decision();
        }
    }

    const fn decision(&self) -> bool {
        self.high_tripped || self.low_tripped
    }
}

/// A square wave in place of the gate's output (fault F9: chatter). High for `duty` of each period, from `start_s` on;
/// low before.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FlagPattern {
    /// First rising edge, in s.
    pub start_s: f64,
    /// Periods per second; 0 or less never rises.
    pub frequency_hz: f64,
    /// Share of the period that is high, 0 … 1.
    pub duty: f64,
}

impl FlagPattern {
    /// Rising edges are 0, 2, 4 …, falling ones 1, 3, 5 …: the time of one, in s.
    pub fn edge_s(&self, index: u64) -> f64 {
        if self.frequency_hz <= 0.0 || self.frequency_hz.is_nan() {
            return f64::INFINITY;
        }
        let share = if index.is_multiple_of(2) {
            0.0
        } else {
            self.duty.clamp(0.0, 1.0)
        };
        self.start_s + ((index / 2) as f64 + share) / self.frequency_hz
    }

    /// Number of edges up to and including `at_s`: the index of the next one.
    pub fn edges_until(&self, at_s: f64) -> u64 {
        if at_s < self.start_s {
            return 0;
        }
        // Rounding may put the estimate on the wrong side of an edge.
        let mut index = 2 * ((at_s - self.start_s) * self.frequency_hz).floor() as u64;
        index = index.saturating_sub(2);
        while self.edge_s(index) <= at_s {
            index += 1;
        }
        index
    }
}

/// What stands in for the gate's output.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub enum GateOverride {
    /// Nothing: the comparators decide.
    #[default]
    None,
    /// A level.
    Constant(bool),
    /// Chatter.
    Pattern(FlagPattern),
}
