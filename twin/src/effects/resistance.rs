//! Ohmic resistance is not the stated one.

use super::scene::{Scale, Scene};
use super::{Card, Clues, Effect, Parameter, Says, Search, Stage};
use crate::problem::{Base, Problem, View};

/// See [`CARD`].
#[derive(Debug)]
pub struct Resistance;

static CARD: Card = Card {
    id: "resistance",
    statement: "The ohmic resistance is not the stated one (an aged cell, a contact).",
    equation: "v = −scale·R·i",
    parameters: &[Parameter::new("scale", "1", 1.0, Search::Linear).within(0.0, f64::INFINITY)],
    shows: "a step with each step of the current, at once",
    looks_like: &["resistance-temperature", "resistance-soc", "polarisation"],
    separated_by: "pulses that are sampled faster than the cell relaxes, at several states of charge and temperatures",
    stage: Stage::BatteryTemperature,
};

impl Effect for Resistance {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn applies(&self, problem: &Problem) -> bool {
        problem.view == View::Voltage
            && matches!(&problem.base, Base::Battery(base) if base.resistance_ohm > 0.0)
    }

    fn bounds(&self, _parameter: usize, _scale: &Scale) -> (f64, f64) {
        // An aged cell has two to three times its resistance, a loose contact many times a cell's.
        (0.05, 50.0)
    }

    fn starts(&self, _scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        vec![vec![1.1]]
    }

    fn says(&self) -> Option<Says> {
        Some(Says::Resistance)
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        if let Some(battery) = &mut scene.battery {
            battery.resistance *= values[0];
        }
    }
}
