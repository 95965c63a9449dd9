//! A battery of equal cells: open-circuit voltage, ohmic and polarisation resistances, heat.
//!
//! Equivalent circuit with RC branches and a one-state hysteresis (Plett, *Battery Management Systems*, vol. 1, ch. 2;
//! Journal of Power Sources 134 (2004) 262), Arrhenius resistances, a thermal mass with the heat of Bernardi (Journal of
//! the Electrochemical Society 132 (1985) 5). Currents are straight lines within a step; charge and branches are exact
//! for them, temperature and resistances are those of the step's ends.

use serde::{Deserialize, Serialize};

use crate::filter::FirstOrder;
use crate::stretch::Linear;

/// 25 °C in K, where resistances are rated.
const RATED_K: f64 = 298.15;
const ZERO_CELSIUS_K: f64 = 273.15;
/// Terms of the diffusion impedance that are calculated; the rest acts at once.
const DIFFUSION_TERMS: usize = 8;
/// RC branches.
const BRANCHES: usize = 3;

/// A resistance in parallel to a capacitance.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RcBranch {
    /// In Ω at 25 °C; 0: not there.
    pub r_ohm: f64,
    /// In s.
    pub tau_s: f64,
}

/// A battery. Default: one Panasonic 18650PF cell with its ohmic resistance alone, every other effect off.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BatteryConfig {
    /// Cells in series.
    pub series: f64,
    /// Strings in parallel.
    pub parallel: f64,
    /// Capacity of a cell, in Ah.
    pub capacity_ah: f64,
    /// Share of the charge put in that comes back out.
    pub coulombic_efficiency: f64,
    /// Open-circuit voltage of a cell at 25 °C: state of charge (0 … 1, rising) and V. Straight lines between the
    /// points, and beyond them.
    pub ocv: Vec<(f64, f64)>,
    /// Ohmic resistance of a cell at 25 °C, in Ω.
    pub r_ohm: f64,
    /// Polarisation of a cell.
    pub polarisation: [RcBranch; BRANCHES],
    /// Finite diffusion, R·tanh(√(jωτ))/√(jωτ).
    pub diffusion: RcBranch,
    /// Temperature of the Arrhenius relation R = R₂₅·exp(b·(1/T − 1/298.15 K)), in K; for every resistance.
    pub b_k: f64,
    /// Every resistance rises by this factor from `knee_soc` down to an empty cell.
    pub rise: f64,
    /// State of charge below which it rises.
    pub knee_soc: f64,
    /// Half the distance between the open-circuit voltages after charge and after discharge, in V.
    pub m_v: f64,
    /// How fast one goes over to the other: per capacity of throughput.
    pub gamma: f64,
    /// dOCV/dT of a cell, in V/K from 25 °C.
    pub v_per_k: f64,
    /// A cell to ambient, in K/W. 0: the cell is at ambient temperature.
    pub rth_k_per_w: f64,
    /// Thermal time constant, in s.
    pub thermal_tau_s: f64,
}

/// Open-circuit voltage of the Panasonic 18650PF at 25 °C: mean of C/20 discharge and charge, thinned; within 7.6 mV of
/// the 201 points that it is taken from, 1.3 mV rms.
///
/// From P. Kollmeyer, "Panasonic 18650PF Li-ion Battery Data", Mendeley Data, V1, 2018, DOI 10.17632/wykht8y7tg.1,
/// CC BY 4.0; changed: averaged over both directions, thinned.
const PANASONIC_OCV: [(f64, f64); 28] = [
    (0.0, 2.7131),
    (0.005, 2.9245),
    (0.01, 3.0224),
    (0.02, 3.1425),
    (0.03, 3.2220),
    (0.04, 3.2777),
    (0.05, 3.3103),
    (0.1, 3.3641),
    (0.15, 3.4269),
    (0.2, 3.4855),
    (0.25, 3.5325),
    (0.3, 3.5657),
    (0.35, 3.5935),
    (0.4, 3.6207),
    (0.45, 3.6502),
    (0.5, 3.6853),
    (0.55, 3.7331),
    (0.6, 3.7883),
    (0.65, 3.8344),
    (0.7, 3.8760),
    (0.75, 3.9160),
    (0.8, 3.9617),
    (0.85, 4.0161),
    (0.9, 4.0695),
    (0.95, 4.1117),
    (0.975, 4.1391),
    (0.99, 4.1630),
    (1.0, 4.1852),
];

impl Default for BatteryConfig {
    fn default() -> Self {
        Self {
            series: 1.0,
            parallel: 1.0,
            // Counted by the tester in the C/20 discharge, with the zero of its current in it: 2.81 Ah, and another table, are told by
            // models/panasonic-18650pf.toml. What is below was fitted with these. Rated 2.9 Ah.
            capacity_ah: 2.9973,
            coulombic_efficiency: 1.0,
            ocv: PANASONIC_OCV.to_vec(),
            r_ohm: 18.6e-3,
            polarisation: [RcBranch::default(); BRANCHES],
            diffusion: RcBranch::default(),
            b_k: 0.0,
            rise: 0.0,
            knee_soc: 0.3,
            m_v: 0.0,
            gamma: 50.0,
            v_per_k: 0.0,
            rth_k_per_w: 0.0,
            thermal_tau_s: 0.0,
        }
    }
}

impl BatteryConfig {
    /// The Panasonic 18650PF with what its recordings show (same source as its open-circuit voltage): one fit to the
    /// pulse test at 0.5 … 2C, US06 at 25 °C and the first 1,200 s of US06 at 0 °C; heat from the case in US06 at 25 °C.
    /// With the recorded temperature it follows them within 16 mV (US06 at 25 °C) and 37 mV rms (0 °C), and HWFET, which it
    /// was not fitted to, within 9.5 mV. The longest time constant is held at 1,500 s, and `gamma` is *assumed*.
    pub fn panasonic_18650pf() -> Self {
        let branch = |r_ohm, tau_s| RcBranch { r_ohm, tau_s };
        Self {
            polarisation: [
                branch(14.1e-3, 0.356),
                branch(22.9e-3, 32.2),
                branch(31.0e-3, 1_500.0),
            ],
            b_k: 2_595.0,
            rise: 1.58,
            knee_soc: 0.304,
            m_v: 12.7e-3,
            rth_k_per_w: 6.5,
            thermal_tau_s: 410.0,
            ..Self::default()
        }
    }

    /// Open-circuit voltage of a cell at 25 °C, in V; 0 without a table.
    pub fn open_circuit_v(&self, soc: f64) -> f64 {
        let n = self.ocv.len();
        if n < 2 {
            return self.ocv.first().map_or(0.0, |point| point.1);
        }
        let upper = self
            .ocv
            .partition_point(|point| point.0 <= soc)
            .clamp(1, n - 1);
        let (from, to) = (self.ocv[upper - 1], self.ocv[upper]);
        from.1 + (to.1 - from.1) * (soc - from.0) / (to.0 - from.0)
    }
}

/// What a battery shows at the end of a step.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BatteryOutput {
    /// Terminals of the battery, in V.
    pub terminal_v: f64,
    /// Of one cell, in V.
    pub cell_v: f64,
    /// State of charge; 0 … 1 in use, but nothing stops it there.
    pub soc: f64,
    /// Of a cell, in °C.
    pub temperature_c: f64,
    /// Open-circuit voltage of a cell with temperature and without hysteresis, in V.
    pub open_circuit_v: f64,
    /// Heat of a cell, in W.
    pub heat_w: f64,
}

/// The running battery.
#[derive(Clone, Debug)]
pub struct Battery {
    config: BatteryConfig,
    branches: [(f64, FirstOrder); BRANCHES],
    diffusion: [(f64, FirstOrder); DIFFUSION_TERMS],
    /// Ohmic resistance with what the diffusion terms leave out.
    r_ohm: f64,
    thermal: FirstOrder,
    branch_v: [f64; BRANCHES],
    diffusion_v: [f64; DIFFUSION_TERMS],
    hysteresis: f64,
    /// Resistances over rated ones.
    factor: f64,
    /// Current of a cell, in A.
    cell_a: f64,
    ambient_c: f64,
    output: BatteryOutput,
}

impl Battery {
    /// At rest for long at `soc` (0 … 1) and `ambient_c`, in the middle of its hysteresis.
    pub fn new(config: BatteryConfig, soc: f64, ambient_c: f64) -> Self {
        // tanh(√x)/√x = Σ 2/(x + ((2k − 1)·π/2)²), k = 1, 2, …
        let terms: [RcBranch; DIFFUSION_TERMS] = std::array::from_fn(|k| {
            let pole = ((2 * k + 1) as f64 * std::f64::consts::FRAC_PI_2).powi(2);
            RcBranch {
                r_ohm: config.diffusion.r_ohm * 2.0 / pole,
                tau_s: config.diffusion.tau_s / pole,
            }
        });
        let left_ohm = config.diffusion.r_ohm - terms.iter().map(|term| term.r_ohm).sum::<f64>();
        let ready = |branch: RcBranch| (branch.r_ohm, FirstOrder::new(branch.tau_s));
        let mut new = Self {
            branches: config.polarisation.map(ready),
            diffusion: terms.map(ready),
            r_ohm: config.r_ohm
                + if config.diffusion.r_ohm == 0.0 {
                    0.0
                } else {
                    left_ohm
                },
            thermal: FirstOrder::new(config.thermal_tau_s),
            branch_v: [0.0; BRANCHES],
            diffusion_v: [0.0; DIFFUSION_TERMS],
            hysteresis: 0.0,
            factor: 1.0,
            cell_a: 0.0,
            ambient_c,
            output: BatteryOutput::default(),
            config,
        };
        new.factor = new.resistance_factor(soc, ambient_c);
        let open_circuit_v = new.open_circuit_v(soc, ambient_c);
        new.output = BatteryOutput {
            terminal_v: open_circuit_v * new.config.series,
            cell_v: open_circuit_v,
            soc,
            temperature_c: ambient_c,
            open_circuit_v,
            heat_w: 0.0,
        };
        new
    }

    /// What it was made of.
    pub const fn config(&self) -> &BatteryConfig {
        &self.config
    }

    /// What it showed last.
    pub const fn output(&self) -> &BatteryOutput {
        &self.output
    }

    /// State of the hysteresis: 1 after much charge, −1 after much discharge.
    pub const fn hysteresis(&self) -> f64 {
        self.hysteresis
    }

    /// `dt_s` pass, in which the battery's current goes from where it was to `current_a` (positive = discharge) and the
    /// ambient temperature to `ambient_c`, both in straight lines. With `dt_s` = 0 both jump.
    pub fn step(&mut self, dt_s: f64, current_a: f64, ambient_c: f64) -> BatteryOutput {
        let cell = Linear {
            start: self.cell_a,
            end: current_a / self.config.parallel,
        };
        let soc = self.count(dt_s, cell);
        let temperature_before_c = self.output.temperature_c;
        let factor = self.resistance_factor(soc, temperature_before_c);
        let driven = Linear {
            start: cell.start * self.factor,
            end: cell.end * factor,
        };
        for ((r_ohm, branch), volts) in self.branches.iter_mut().zip(&mut self.branch_v) {
            step_branch(*r_ohm, branch, volts, dt_s, driven);
        }
        if self.config.diffusion.r_ohm != 0.0 {
            for ((r_ohm, branch), volts) in self.diffusion.iter_mut().zip(&mut self.diffusion_v) {
                step_branch(*r_ohm, branch, volts, dt_s, driven);
            }
        }
        let lost_v = self.r_ohm * driven.end
            + self.branch_v.iter().sum::<f64>()
            + self.diffusion_v.iter().sum::<f64>();
        let open_circuit_v = self.open_circuit_v(soc, temperature_before_c);
        let cell_v = open_circuit_v + self.config.m_v * self.hysteresis - lost_v;
        let heat_w = cell.end
            * (open_circuit_v
                - cell_v
                - (temperature_before_c + ZERO_CELSIUS_K) * self.config.v_per_k);
        let above = |ambient_c: f64, heat_w: f64| ambient_c + self.config.rth_k_per_w * heat_w;
        let (temperature_c, _) = self.thermal.step(
            dt_s,
            temperature_before_c,
            Linear {
                start: above(self.ambient_c, self.output.heat_w),
                end: above(ambient_c, heat_w),
            },
        );
        self.cell_a = cell.end;
        self.factor = factor;
        self.ambient_c = ambient_c;
        self.output = BatteryOutput {
            terminal_v: cell_v * self.config.series,
            cell_v,
            soc,
            temperature_c,
            open_circuit_v,
            heat_w,
        };
        self.output
    }

    /// State of charge at the end of a step; the hysteresis moves on.
    fn count(&mut self, dt_s: f64, cell: Linear) -> f64 {
        let capacity_c = 3_600.0 * self.config.capacity_ah;
        // Current of one sign before and after the zero of the line.
        let parts = if cell.start * cell.end < 0.0 {
            let zero = cell.start / (cell.start - cell.end);
            [
                0.5 * cell.start * zero * dt_s,
                0.5 * cell.end * (1.0 - zero) * dt_s,
            ]
        } else {
            [cell.mean() * dt_s, 0.0]
        };
        let mut soc = self.output.soc;
        for charge_c in parts {
            let moved_c = if charge_c < 0.0 {
                charge_c * self.config.coulombic_efficiency
            } else {
                charge_c
            };
            soc -= moved_c / capacity_c;
            if self.config.m_v != 0.0 && moved_c != 0.0 {
                let kept = (-self.config.gamma * moved_c.abs() / capacity_c).exp();
                let target = if moved_c < 0.0 { 1.0 } else { -1.0 };
                self.hysteresis = target + (self.hysteresis - target) * kept;
            }
        }
        soc
    }

    fn open_circuit_v(&self, soc: f64, temperature_c: f64) -> f64 {
        self.config.open_circuit_v(soc)
            + self.config.v_per_k * (temperature_c + ZERO_CELSIUS_K - RATED_K)
    }

    fn resistance_factor(&self, soc: f64, temperature_c: f64) -> f64 {
        let c = &self.config;
        let arrhenius = if c.b_k == 0.0 {
            1.0
        } else {
            (c.b_k * (1.0 / (temperature_c + ZERO_CELSIUS_K) - 1.0 / RATED_K)).exp()
        };
        let low = if c.rise == 0.0 || c.knee_soc <= 0.0 {
            0.0
        } else {
            c.rise * ((c.knee_soc - soc) / c.knee_soc).clamp(0.0, 1.0)
        };
        arrhenius * (1.0 + low)
    }
}

fn step_branch(r_ohm: f64, branch: &mut FirstOrder, volts: &mut f64, dt_s: f64, driven: Linear) {
    if r_ohm != 0.0 {
        let input = Linear {
            start: r_ohm * driven.start,
            end: r_ohm * driven.end,
        };
        *volts = branch.step(dt_s, *volts, input).0;
    }
}
