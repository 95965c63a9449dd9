//! Charge transfer at the electrodes.

use super::scene::{REFERENCE_C, Scale, Scene, ZERO_CELSIUS_K};
use super::{Card, Clues, Effect, Parameter, Search, Stage, spaced};
use crate::problem::{Problem, View};

/// Gas constant over Faraday constant in V/K: 8.314 463 J/(mol·K) over 96 485.332 C/mol.
const R_OVER_F: f64 = 8.314_463 / 96_485.332;
/// The slope at small currents is part of the resistance by design, and can be no more than all of it and what that is off by.
const MOST: f64 = 1.5;
/// Exchange current over the largest current, from which on the overvoltage is a straight line to a thousandth:
/// asinh(x)/x = 1 − x²/6 with x = i/(2·i₀).
const STRAIGHT: f64 = 6.0;

/// See [`CARD`].
#[derive(Debug)]
pub struct ChargeTransfer;

static CARD: Card = Card {
    id: "charge-transfer",
    statement: "The overvoltage of the electrode reactions grows with the logarithm of a large current, not in proportion to it (Butler–Volmer).",
    equation: "v = −(2RT/F)·(asinh x − x), x = i/(2·i0·k); k: R25/R as of temperature and state of charge (resistance-temperature, cell-self-heating, resistance-soc), 1 without them (Newman & Thomas-Alyea 2004)",
    parameters: &[Parameter::new("i0_a", "A", f64::INFINITY, Search::Logarithmic).above_nothing()],
    shows: "large currents drop less voltage than small ones promise, the more so in the cold",
    looks_like: &["resistance-temperature", "polarisation"],
    separated_by: "pulses of several sizes at one state of charge and one temperature",
    stage: Stage::BatteryVoltage,
};

/// Voltage in V that the slope at small currents promises too much, of a current in A, at an exchange current in A and a
/// temperature in °C.
fn promised_v(current_a: f64, exchange_a: f64, temperature_c: f64) -> f64 {
    let x = (current_a / (2.0 * exchange_a)).abs();
    // asinh without its care for small x, where nothing is left of either.
    let excess = x - (x + (x * x + 1.0).sqrt()).ln();
    (2.0 * R_OVER_F * (temperature_c + ZERO_CELSIUS_K) * excess).copysign(current_a)
}

impl Effect for ChargeTransfer {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn applies(&self, problem: &Problem) -> bool {
        problem.view == View::Voltage
    }

    fn bounds(&self, _parameter: usize, scale: &Scale) -> (f64, f64) {
        let most = STRAIGHT * scale.largest;
        let thermal_v = R_OVER_F * (REFERENCE_C + ZERO_CELSIUS_K);
        let least = thermal_v / (MOST * scale.resistance_ohm);
        (least.min(most), most)
    }

    fn starts(&self, scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        let (least, most) = self.bounds(0, scale);
        spaced(least, most, 6)
            .into_iter()
            .take(4)
            .map(|i0_a| vec![i0_a])
            .collect()
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let Some(battery) = &mut scene.battery else {
            return;
        };
        for (((added, i), factor), t) in battery
            .added_v
            .iter_mut()
            .zip(&scene.signal)
            .zip(&battery.factor)
            .zip(&battery.temperature_c)
        {
            *added += promised_v(*i, values[0] / factor, *t);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_butler_and_volmers_equation() {
        // The overvoltage η = 2·(RT/F)·x − promised solves i = i0·(e^(Fη/2RT) − e^(−Fη/2RT)).
        for t_c in [-10.0, 25.0, 45.0] {
            let thermal_v = R_OVER_F * (t_c + ZERO_CELSIUS_K);
            for i in [-40.0, -3.0, -0.01, 0.2, 5.0, 60.0] {
                let over_v = thermal_v * i / 1.5 - promised_v(i, 1.5, t_c);
                let there = 1.5 * 2.0 * (over_v / (2.0 * thermal_v)).sinh();
                assert!((there / i - 1.0).abs() < 1e-9, "{i} {t_c}: {there}");
            }
        }
    }
}
