//! Zero drift with temperature.

use super::scene::{REFERENCE_C, Scale, Scene};
use super::{Card, Clues, Effect, Parameter, Search, Stage, sensing};
use crate::problem::Problem;

/// See [`CARD`].
#[derive(Debug)]
pub struct OffsetTemperature;

static CARD: Card = Card {
    id: "offset-temperature",
    statement: "The zero of the sensor drifts with its temperature.",
    equation: "y = i + tc·(T − 25 °C)",
    parameters: &[Parameter::new("tc_a_per_k", "A/K", 0.0, Search::Linear)],
    shows: "follows the temperature of the sensor",
    looks_like: &["offset"],
    separated_by: "the same current at two temperatures, warming and cooling",
    stage: Stage::Zero,
};

impl Effect for OffsetTemperature {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn applies(&self, problem: &Problem) -> bool {
        sensing(problem) && problem.drive.sensor_temperature_c.is_some()
    }

    fn columns(&self) -> &'static [&'static str] {
        &["temp_sensor_c"]
    }

    fn bounds(&self, _parameter: usize, scale: &Scale) -> (f64, f64) {
        (-0.2 * scale.full_scale, 0.2 * scale.full_scale)
    }

    fn starts(&self, scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        vec![vec![1e-4 * scale.full_scale]]
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let tc = values[0];
        let drive = scene.drive;
        if let Some(temperature) = &drive.sensor_temperature_c {
            for (value, t) in scene.signal.iter_mut().zip(temperature) {
                *value += tc * (t - REFERENCE_C);
            }
        }
    }
}
