//! The cell warms itself.

use super::scene::{Scale, Scene, arrhenius};
use super::{Card, Clues, Effect, Parameter, Search, Stage, spaced};
use crate::problem::{Problem, View};

/// Arrhenius temperature of the resistance where nothing says what it is: that of usual lithium-ion cells, 1500 … 4000 K.
const USUAL_B_K: f64 = 2000.0;

/// See [`CARD`].
#[derive(Debug)]
pub struct CellSelfHeating;

static CARD: Card = Card {
    id: "cell-self-heating",
    statement: "Losses warm the cell, which lowers its resistance.",
    equation: "T = T₀ + rth·LP(R(T₀)·i²), LP: first order with τ; R(T) with B of resistance-temperature, 2000 K without it",
    parameters: &[
        Parameter::new("rth_k_per_w", "K/W", 0.0, Search::Smooth),
        Parameter::new("tau_s", "s", 300.0, Search::Logarithmic),
    ],
    shows: "slow under load, where no cell temperature is recorded",
    looks_like: &["resistance-temperature"],
    separated_by: "the temperature of the cell",
    stage: Stage::BatteryTemperature,
};

impl Effect for CellSelfHeating {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn applies(&self, problem: &Problem) -> bool {
        problem.view == View::Voltage && problem.drive.cell_temperature_c.is_none()
    }

    fn bounds(&self, parameter: usize, scale: &Scale) -> (f64, f64) {
        if parameter == 0 {
            (0.0, 1000.0)
        } else {
            (10.0 * scale.step_s, 3.0 * scale.span_s)
        }
    }

    fn starts(&self, scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        spaced(30.0 * scale.step_s, scale.span_s, 5)
            .into_iter()
            .map(|tau| vec![1.0, tau])
            .collect()
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let (drive, steps) = (scene.drive, scene.steps.clone());
        let Some(battery) = &mut scene.battery else {
            return;
        };
        let ohms = battery.base.resistance_ohm;
        let b_k = *battery.arrhenius_k.get_or_insert(USUAL_B_K);
        // At the temperature that the cell would have without the warming: that lowers R by a few percent only.
        let losses: Vec<f64> = scene
            .signal
            .iter()
            .zip(&battery.temperature_c)
            .map(|(i, t)| ohms * arrhenius(b_k, *t) * i * i)
            .collect();
        let heat = steps.ladder(&drive.segments, &losses, [values[1]], [1.0]);
        battery
            .temperature_c
            .iter_mut()
            .zip(heat)
            .for_each(|(t, watts)| *t += values[0] * watts);
    }
}
