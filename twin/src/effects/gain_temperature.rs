//! Sensitivity drift with temperature.

use super::scene::{REFERENCE_C, Scale, Scene};
use super::{Card, Clues, Effect, Parameter, Search, Stage, sensing};
use crate::problem::Problem;

/// See [`CARD`].
#[derive(Debug)]
pub struct GainTemperature;

static CARD: Card = Card {
    id: "gain-temperature",
    statement: "The sensitivity of the sensor drifts with its temperature.",
    equation: "y = i·(1 + tc·(T − 25 °C))",
    parameters: &[Parameter::new("tc_per_k", "1/K", 0.0, Search::Linear)],
    shows: "abs(i) times temperature",
    looks_like: &["gain"],
    separated_by: "the same large current at two temperatures",
    stage: Stage::Sensitivity,
};

impl Effect for GainTemperature {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn applies(&self, problem: &Problem) -> bool {
        sensing(problem) && problem.drive.sensor_temperature_c.is_some()
    }

    fn columns(&self) -> &'static [&'static str] {
        &["temp_sensor_c"]
    }

    fn bounds(&self, _parameter: usize, _scale: &Scale) -> (f64, f64) {
        (-0.1, 0.1)
    }

    fn starts(&self, _scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        vec![vec![1e-4]]
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let tc = values[0];
        let drive = scene.drive;
        if let Some(temperature) = &drive.sensor_temperature_c {
            for (value, t) in scene.signal.iter_mut().zip(temperature) {
                *value *= 1.0 + tc * (t - REFERENCE_C);
            }
        }
    }
}
