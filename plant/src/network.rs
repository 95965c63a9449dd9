//! D3's open-sensor network between the Hall output and the MCU's pin.
//!
//! ```text
//! Hall ─┬─ R4 ─┬─ + input, gain 1 + R1/R2 ─ R5 ─ clamp ─ ADC
//!       │      └─ R3 (∥ C) ─ Vref
//!       └─ R6 + R7 ─ −15 V
//! ```

use serde::{Deserialize, Serialize};

use crate::filter::FirstOrder;
use crate::stretch::Linear;

/// The parts of the network, as D3 gives them.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NetworkConfig {
    /// Feedback of the amplifier, in Ω.
    pub r1_ohm: f64,
    /// From its − input to ground, in Ω.
    pub r2_ohm: f64,
    /// From the reference to its + input, in Ω.
    pub r3_ohm: f64,
    /// From the Hall output to its + input, in Ω.
    pub r4_ohm: f64,
    /// R6 + R7, from the Hall output to the negative supply, in Ω. ∞: D3's circuit without its invention.
    pub pull_down_ohm: f64,
    /// Negative supply, in V.
    pub negative_supply_v: f64,
    /// Reference, in V (worked out from the outputs that D3 gives).
    pub reference_v: f64,
    /// Capacitance across R3, in F: 1 nF in D3, a time constant of 22 µs. Nominal 0.
    pub c3_f: f64,
    /// The diodes hold the pin above this, in V.
    pub clamp_low_v: f64,
    /// The diodes hold the pin below this, in V.
    pub clamp_high_v: f64,
}

impl Default for NetworkConfig {
    fn default() -> Self {
        Self {
            r1_ohm: 2_700.0,
            r2_ohm: 12_000.0,
            r3_ohm: 27_000.0,
            r4_ohm: 120_000.0,
            pull_down_ohm: 120_000.0 + 27_000.0,
            negative_supply_v: -15.0,
            reference_v: 1.65,
            c3_f: 0.0,
            clamp_low_v: 0.0,
            clamp_high_v: 3.3,
        }
    }
}

/// What drives the Hall node: a voltage behind a resistance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Source {
    /// In V.
    pub volts: f64,
    /// In Ω; ∞ is an open wire.
    pub ohms: f64,
}

/// A [`NetworkConfig`] made ready, and its state.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Network {
    gain: f64,
    offset_v: f64,
    /// What the network alone makes of the Hall node.
    idle: Source,
    clamp: (f64, f64),
    lag: FirstOrder,
    amplified_v: f64,
}

impl Network {
    /// The network, settled with `node_v` at the Hall node.
    pub fn new(config: &NetworkConfig, node_v: f64) -> Self {
        let c = config;
        let amplifier = 1.0 + c.r1_ohm / c.r2_ohm;
        let reference_s = 1.0 / (c.r3_ohm + c.r4_ohm);
        let pull_down_s = 1.0 / c.pull_down_ohm;
        let mut new = Self {
            gain: c.r3_ohm / (c.r3_ohm + c.r4_ohm) * amplifier,
            offset_v: c.reference_v * c.r4_ohm / (c.r3_ohm + c.r4_ohm) * amplifier,
            idle: Source {
                volts: (c.reference_v * reference_s + c.negative_supply_v * pull_down_s)
                    / (reference_s + pull_down_s),
                ohms: 1.0 / (reference_s + pull_down_s),
            },
            clamp: (c.clamp_low_v, c.clamp_high_v),
            lag: FirstOrder::new(c.c3_f * c.r3_ohm * c.r4_ohm / (c.r3_ohm + c.r4_ohm)),
            amplified_v: 0.0,
        };
        new.amplified_v = new.gain * node_v + new.offset_v;
        new
    }

    /// The Hall node under load of the network, as (factor, offset in V) on the source's voltage.
    pub fn load(&self, source_ohm: f64) -> (f64, f64) {
        if source_ohm == f64::INFINITY {
            return (0.0, self.idle.volts);
        }
        let share = source_ohm / (source_ohm + self.idle.ohms);
        (1.0 - share, self.idle.volts * share)
    }

    /// Voltage at the pin when the Hall node has been at `node_v` for long.
    pub fn settled_v(&self, node_v: f64) -> f64 {
        self.clamped_v(self.gain * node_v + self.offset_v)
    }

    /// Voltage at the pin with 0 V at the Hall node: the level around which the output moves.
    pub const fn zero_v(&self) -> f64 {
        self.offset_v
    }

    /// Voltage at the pin now.
    pub fn output_v(&self) -> f64 {
        self.clamped_v(self.amplified_v)
    }

    /// The pin while the Hall node moves for `dt_s`.
    pub fn step(&mut self, dt_s: f64, node_v: Linear) -> Linear {
        let amplified = Linear {
            start: self.gain * node_v.start + self.offset_v,
            end: self.gain * node_v.end + self.offset_v,
        };
        let (end_v, line) = self.lag.step(dt_s, self.amplified_v, amplified);
        self.amplified_v = end_v;
        Linear {
            start: self.clamped_v(line.start),
            end: self.clamped_v(line.end),
        }
    }

    fn clamped_v(&self, volts: f64) -> f64 {
        volts.max(self.clamp.0).min(self.clamp.1)
    }
}
