//! Capacity is not the rated one.

use super::scene::{Scale, Scene};
use super::{Card, Clues, CurrentError, Effect, Parameter, Search, Stage, counting};
use crate::problem::Problem;

/// See [`CARD`].
#[derive(Debug)]
pub struct Capacity;

static CARD: Card = Card {
    id: "capacity",
    statement: "The capacity of the battery is not the rated one.",
    equation: "dSoC/dt = −i/(3600·capacity)",
    parameters: &[Parameter::new("capacity_ah", "Ah", f64::NAN, Search::Smooth).above_nothing()],
    shows: "state of charge and open-circuit voltage scale",
    looks_like: &["gain"],
    separated_by: "a discharge over a known span of state of charge with a rest at both ends",
    stage: Stage::BatteryCharge,
};

impl Effect for Capacity {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn applies(&self, problem: &Problem) -> bool {
        counting(problem)
    }

    fn bounds(&self, _parameter: usize, scale: &Scale) -> (f64, f64) {
        (0.3 * scale.capacity_ah, 3.0 * scale.capacity_ah)
    }

    fn starts(&self, scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        [0.99, 1.01, 0.9, 1.1]
            .map(|share| vec![share * scale.capacity_ah])
            .to_vec()
    }

    fn in_the_current(&self, values: &[f64], scale: &Scale) -> Option<CurrentError> {
        Some(CurrentError::Gain(values[0] / scale.capacity_ah))
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        if let Some(battery) = &mut scene.battery {
            battery.capacity_ah = values[0];
        }
    }
}
