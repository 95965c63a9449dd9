//! Solid diffusion.

use super::scene::{Scale, Scene};
use super::{Card, Clues, Effect, Parameter, Search, Stage, spaced};
use crate::problem::{Problem, View};

/// Terms of the series that are calculated.
const TERMS: usize = 8;

/// See [`CARD`].
#[derive(Debug)]
pub struct Diffusion;

static CARD: Card = Card {
    id: "diffusion",
    statement: "Diffusion in the electrodes relaxes the voltage slowly, with the square root of time.",
    equation: "v = −i∗z, Z(s) = R·tanh(√(sτ))/√(sτ)",
    parameters: &[
        Parameter::new("r_ohm", "Ω", 0.0, Search::Linear),
        Parameter::new("tau_s", "s", 100.0, Search::Logarithmic),
    ],
    shows: "very slow relaxation",
    looks_like: &["polarisation"],
    separated_by: "an hour of rest after a long discharge, sampled every few seconds",
    stage: Stage::BatteryVoltage,
};

impl Effect for Diffusion {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn applies(&self, problem: &Problem) -> bool {
        problem.view == View::Voltage
    }

    fn bounds(&self, parameter: usize, scale: &Scale) -> (f64, f64) {
        if parameter == 0 {
            (0.0, 50.0 * scale.resistance_ohm)
        } else {
            (5.0 * scale.step_s, 3.0 * scale.span_s)
        }
    }

    fn starts(&self, scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        spaced(20.0 * scale.step_s, scale.span_s, 7)
            .into_iter()
            .map(|tau| vec![0.1 * scale.resistance_ohm, tau])
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
        // Poles at ((k − ½)·π)².
        let poles: [f64; TERMS] =
            std::array::from_fn(|k| ((k as f64 + 0.5) * std::f64::consts::PI).powi(2));
        let weights = poles.map(|pole| ohms * 2.0 / pole);
        let left = ohms - weights.iter().sum::<f64>();
        let slow = steps.ladder(
            &drive.segments,
            &driven,
            poles.map(|pole| tau / pole),
            weights,
        );
        battery
            .added_v
            .iter_mut()
            .zip(slow)
            .for_each(|(added, v)| *added -= v);
        // What the terms leave out acts at once.
        battery
            .added_v
            .iter_mut()
            .zip(&driven)
            .for_each(|(added, i)| *added -= left * i);
    }
}
