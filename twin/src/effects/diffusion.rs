//! Solid diffusion.

use super::ocv::open_circuit_v;
use super::scene::{Scale, Scene};
use super::{Card, Clues, Effect, IDEALISED, Parameter, Search, Stage, spaced};
use crate::problem::{Problem, View};

/// Terms of the series that are calculated.
const TERMS: usize = 8;
/// State of charge between which the mean slope of the open-circuit voltage is taken: the ends of the curve are steep.
const MIDDLE: (f64, f64) = (0.2, 0.8);
/// Share by which the straight law may be off: the slope of the open-circuit voltage, which makes concentration into voltage, changes
/// over a drive by some ten percent either way.
const STRAIGHT: f64 = 2.0 * IDEALISED;

/// In proportion to the current, or through the open-circuit voltage: one id, and as many parameters as that needs.
#[derive(Debug)]
pub struct Diffusion {
    card: &'static Card,
}

/// In proportion to the current.
pub static STRAIGHT_LINE: Diffusion = Diffusion { card: &CARDS[0] };
/// A share of it through the open-circuit voltage.
pub static THROUGH_OCV: Diffusion = Diffusion { card: &CARDS[1] };

static PARAMETERS: [Parameter; 3] = [
    Parameter::new("r_ohm", "Ω", 0.0, Search::Linear),
    Parameter::new("tau_s", "s", 100.0, Search::Logarithmic).open(),
    Parameter::new("ocv_share", "1", 0.0, Search::Smooth).open(),
];

static CARDS: [Card; 2] = [
    card(PARAMETERS.as_slice().split_at(2).0),
    card(PARAMETERS.as_slice()),
];

const fn card(parameters: &'static [Parameter]) -> Card {
    Card {
        id: "diffusion",
        statement: "Diffusion in the electrodes relaxes the voltage slowly, with the square root of time.",
        equation: "v = −(1 − w)·(k·i)∗z − w·(OCV(SoC) − OCV(SoC − (k·i)∗z/m)), Z(s) = R·tanh(√(sτ))/√(sτ); w: ocv_share, 0 without it; m: mean slope of OCV from 20 to 80 %; k: R/R25 as of temperature and state of charge (resistance-temperature, cell-self-heating, resistance-soc), 1 without them",
        parameters,
        shows: "very slow relaxation",
        looks_like: &["polarisation"],
        separated_by: "an hour of rest after a long discharge, sampled every few seconds",
        stage: Stage::BatteryVoltage,
    }
}

impl Effect for Diffusion {
    fn card(&self) -> &'static Card {
        self.card
    }

    fn applies(&self, problem: &Problem) -> bool {
        problem.view == View::Voltage
    }

    fn bounds(&self, parameter: usize, scale: &Scale) -> (f64, f64) {
        match parameter {
            0 => (0.0, 50.0 * scale.resistance_ohm),
            1 => (5.0 * scale.step_s, 3.0 * scale.span_s),
            _ => (0.0, 1.0),
        }
    }

    fn starts(&self, scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        let r = 0.1 * scale.resistance_ohm;
        spaced(20.0 * scale.step_s, scale.span_s, 7)
            .into_iter()
            .map(|tau| match self.card.parameters.len() {
                2 => vec![r, tau],
                _ => vec![r, tau, 1.0],
            })
            .collect()
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let (ohms, tau) = (values[0], values[1]);
        let (drive, steps) = (scene.drive, scene.steps.clone());
        let Some(battery) = &mut scene.battery else {
            return;
        };
        let driven: Vec<f64> = scene
            .signal
            .iter()
            .zip(&battery.factor)
            .map(|(i, factor)| i * factor)
            .collect();
        let (weights, taus) = series();
        let mut drop = steps.ladder(
            &drive.operations(),
            &driven,
            (&battery.driven_over_gaps(), battery.driven_before()),
            taus.map(|share| share * tau),
            weights.map(|share| share * ohms),
        );
        let share = values.get(2).copied().unwrap_or_default();
        let cells = battery.base.cells;
        let of_string = battery.base.ocv.iter();
        let cell_ocv: Vec<(f64, f64)> = of_string.map(|(soc, v)| (*soc, v / cells)).collect();
        if share != 0.0
            && let Some(slope_v) = middle_slope_v(&cell_ocv)
        {
            // The state of charge at the surface, where the reaction is.
            let surface: Vec<f64> = battery
                .soc
                .iter()
                .zip(&drop)
                .map(|(soc, drop)| soc - drop / slope_v)
                .collect();
            let inside_v = open_circuit_v(&cell_ocv, &battery.soc);
            let surface_v = open_circuit_v(&cell_ocv, &surface);
            for ((drop, inside), surface) in drop.iter_mut().zip(inside_v).zip(surface_v) {
                *drop += share * (inside - surface - *drop);
            }
        }
        battery
            .added_v
            .iter_mut()
            .zip(drop)
            .for_each(|(added, drop)| *added -= drop);
    }

    fn idealised(&self) -> f64 {
        if self.card.parameters.len() == 2 {
            STRAIGHT
        } else {
            IDEALISED
        }
    }
}

/// Weights and time constants, as shares of R and τ: poles at ((k − ½)·π)², and one more for what those leave out, with its weight
/// and its mean time constant (all weights make 1, and with their time constants ⅓: tanh(x)/x = 1 − x²/3).
fn series() -> ([f64; TERMS], [f64; TERMS]) {
    let poles: [f64; TERMS] =
        std::array::from_fn(|k| ((k as f64 + 0.5) * std::f64::consts::PI).powi(2));
    let (mut weights, mut taus) = (poles.map(|pole| 2.0 / pole), poles.map(f64::recip));
    let last = TERMS - 1;
    let known = weights[..last].iter().sum::<f64>();
    let moment: f64 = weights[..last]
        .iter()
        .zip(&taus)
        .map(|(w, tau)| w * tau)
        .sum();
    weights[last] = 1.0 - known;
    taus[last] = (1.0 / 3.0 - moment) / weights[last];
    (weights, taus)
}

/// Mean slope of the open-circuit voltage over the middle of the states of charge, in V; none where it does not rise.
fn middle_slope_v(table: &[(f64, f64)]) -> Option<f64> {
    let ends = open_circuit_v(table, &[MIDDLE.0, MIDDLE.1]);
    let slope_v = (ends[1] - ends[0]) / (MIDDLE.1 - MIDDLE.0);
    (slope_v > 0.0).then_some(slope_v)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_series_keeps_resistance_and_mean_delay() {
        let (weights, taus) = series();
        let moment: f64 = weights.iter().zip(&taus).map(|(w, tau)| w * tau).sum();
        assert!((weights.iter().sum::<f64>() - 1.0).abs() < 1e-12);
        assert!((moment - 1.0 / 3.0).abs() < 1e-12);
        assert!(
            taus.windows(2)
                .all(|pair| 0.0 < pair[1] && pair[1] < pair[0])
        );
    }

    #[test]
    fn the_series_rises_with_the_root_of_time() {
        // A step of current into tanh(√(sτ))/√(sτ): 2·√(t/(π·τ)) while the far side does not tell.
        let (weights, taus) = series();
        for share in [0.02, 0.05, 0.1] {
            let risen: f64 = weights
                .iter()
                .zip(&taus)
                .map(|(w, tau)| w * (1.0 - f64::exp(-share / tau)))
                .sum();
            let root = 2.0 * (share / std::f64::consts::PI).sqrt();
            assert!((risen / root - 1.0).abs() < 0.01, "{share}: {risen} {root}");
        }
    }
}
