//! The ADG849: break-before-make and charge injection at the node behind it.

use serde::{Deserialize, Serialize};

use crate::filter::line_with_mean;
use crate::stretch::Linear;

/// The switch and its node; nominal: it changes over at once and without a trace.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AnalogSwitchConfig {
    /// Both contacts are open for this long at each change, in s; the node holds its voltage. t_ON − t_OFF, about 7 ns
    /// (ADG849, commonly quoted).
    pub break_before_make_s: f64,
    /// Charge that a closing contact puts into the node, in C; 50 pC (ADG849, commonly quoted).
    pub injected_charge_c: f64,
    /// Capacitance of the node, in F. 0: the node follows at once.
    pub node_capacitance_f: f64,
    /// Resistance through which the node is charged, in Ω: contact and source. 0.5 Ω (ADG849 data sheet).
    pub path_ohm: f64,
}

impl Default for AnalogSwitchConfig {
    fn default() -> Self {
        Self {
            break_before_make_s: 0.0,
            injected_charge_c: 0.0,
            node_capacitance_f: 0.0,
            path_ohm: 0.5,
        }
    }
}

/// The running switch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AnalogSwitch {
    config: AnalogSwitchConfig,
    tau_s: f64,
    high: bool,
    open_until_s: Option<f64>,
    closing: bool,
    node_v: f64,
    glitch_v: f64,
}

impl AnalogSwitch {
    /// Settled with the node at `node_v`.
    pub fn new(config: AnalogSwitchConfig, high: bool, node_v: f64) -> Self {
        Self {
            config,
            tau_s: config.path_ohm * config.node_capacitance_f,
            high,
            open_until_s: None,
            closing: false,
            node_v,
            glitch_v: 0.0,
        }
    }

    /// Which contact is selected: high is the large sensor.
    pub const fn is_high(&self) -> bool {
        self.high
    }

    /// Voltage of the node, in V.
    pub const fn node_v(&self) -> f64 {
        self.node_v
    }

    /// When the open contacts close.
    pub const fn pending_s(&self) -> Option<f64> {
        self.open_until_s
    }

    /// The control input is at `high` from `at_s` on.
    pub fn set(&mut self, high: bool, at_s: f64) {
        if high == self.high {
            return;
        }
        self.high = high;
        self.glitch_v = 0.0;
        if self.config.break_before_make_s > 0.0 {
            self.open_until_s = Some(at_s + self.config.break_before_make_s);
            self.closing = false;
        } else {
            self.closing = true;
        }
    }

    /// The break is over if it is at `now_s`.
    pub fn advance(&mut self, now_s: f64) {
        if self.open_until_s.is_some_and(|at_s| at_s <= now_s) {
            self.open_until_s = None;
            self.closing = true;
        }
    }

    /// The node while `selected_v` is at the selected contact for `dt_s`: true mean and end.
    pub fn step(&mut self, dt_s: f64, selected_v: Linear) -> Linear {
        if self.open_until_s.is_some() {
            return Linear::constant(self.node_v);
        }
        if self.closing {
            self.closing = false;
            if self.tau_s > 0.0 {
                self.glitch_v = self.node_v - selected_v.start
                    + self.config.injected_charge_c / self.config.node_capacitance_f;
            }
        }
        if self.glitch_v == 0.0 {
            self.node_v = selected_v.end;
            return selected_v;
        }
        let x = dt_s / self.tau_s;
        let decayed = -(-x).exp_m1();
        let mean_v = if x > 0.0 {
            self.glitch_v * decayed / x
        } else {
            self.glitch_v
        };
        let end_v = self.glitch_v * (1.0 - decayed);
        // Below a nanovolt it is over.
        self.glitch_v = if end_v.abs() < 1e-9 { 0.0 } else { end_v };
        let glitch = line_with_mean(mean_v, end_v);
        self.node_v = selected_v.end + end_v;
        Linear {
            start: selected_v.start + glitch.start,
            end: self.node_v,
        }
    }
}
