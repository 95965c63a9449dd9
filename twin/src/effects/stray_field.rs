//! Field of a neighbouring conductor.

use super::scene::{Scale, Scene};
use super::{Card, Clues, Effect, Parameter, Search, Stage, sensing};
use crate::problem::Problem;

/// See [`CARD`].
#[derive(Debug)]
pub struct StrayField;

static CARD: Card = Card {
    id: "stray-field",
    statement: "The field of a neighbouring conductor reaches the sensor.",
    equation: "y = i + coupling·i_aux",
    parameters: &[Parameter::new("coupling", "1", 0.0, Search::Linear)],
    shows: "follows the neighbouring current",
    looks_like: &["offset"],
    separated_by: "a current in the neighbouring conductor alone",
    stage: Stage::Conductor,
};

impl Effect for StrayField {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn applies(&self, problem: &Problem) -> bool {
        sensing(problem) && problem.drive.aux_a.is_some()
    }

    fn columns(&self) -> &'static [&'static str] {
        &["i_aux_a"]
    }

    fn bounds(&self, _parameter: usize, _scale: &Scale) -> (f64, f64) {
        (-1.0, 1.0)
    }

    fn starts(&self, _scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        vec![vec![0.01]]
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let coupling = values[0];
        let drive = scene.drive;
        if let Some(aux) = &drive.aux_a {
            for (value, aux) in scene.signal.iter_mut().zip(aux) {
                *value += coupling * aux;
            }
        }
    }
}
