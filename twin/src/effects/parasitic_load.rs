//! A consumer ahead of the sensor.

use super::scene::{Scale, Scene};
use super::{Card, Clues, CurrentError, Effect, Parameter, Says, Search, Stage, counting};
use crate::problem::Problem;

/// Hours in which the largest one empties the battery: a consumer that does so within a day is not overlooked.
const HOURS: f64 = 24.0;

/// See [`CARD`].
#[derive(Debug)]
pub struct ParasiticLoad;

static CARD: Card = Card {
    id: "parasitic-load",
    statement: "A consumer draws current ahead of the sensor, which does not see it.",
    equation: "i + load in place of i: dSoC/dt = −(i + load)/Q",
    parameters: &[Parameter::new("load_a", "A", 0.0, Search::Linear)],
    shows: "state of charge falls at rest",
    looks_like: &["offset", "coulombic-efficiency"],
    separated_by: "a long rest",
    stage: Stage::BatteryCharge,
};

impl Effect for ParasiticLoad {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn applies(&self, problem: &Problem) -> bool {
        counting(problem)
    }

    fn bounds(&self, _parameter: usize, scale: &Scale) -> (f64, f64) {
        let most = scale.capacity_ah / HOURS;
        (-most, most)
    }

    fn starts(&self, scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        vec![vec![1e-3 * scale.capacity_ah.max(0.1)]]
    }

    fn in_the_current(&self, values: &[f64], _scale: &Scale) -> Option<CurrentError> {
        Some(CurrentError::Offset(-values[0]))
    }

    fn unlikely(&self, values: &[f64]) -> Option<&'static str> {
        (values[0] < 0.0).then_some("a consumer supplies no current")
    }

    fn says(&self) -> Option<Says> {
        Some(Says::CurrentZero)
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        // The cell's whole current: its voltage falls and its charge goes by it.
        scene.signal.iter_mut().for_each(|i| *i += values[0]);
    }
}
