//! Sensitivity error.

use super::scene::{Scale, Scene};
use super::{Card, Clues, Effect, Parameter, Search, Stage};

/// See [`CARD`].
#[derive(Debug)]
pub struct Gain;

static CARD: Card = Card {
    id: "gain",
    statement: "The sensor reads every current too large or too small by the same factor.",
    equation: "y = gain·i",
    parameters: &[Parameter::new("gain", "1", 1.0, Search::Linear)],
    shows: "grows with abs(i)",
    looks_like: &["capacity"],
    separated_by: "currents of several sizes against a reference current",
    stage: Stage::Sensitivity,
};

impl Effect for Gain {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn bounds(&self, _parameter: usize, _scale: &Scale) -> (f64, f64) {
        (0.05, 20.0)
    }

    fn starts(&self, _scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        vec![vec![1.01]]
    }

    fn idealised(&self) -> f64 {
        0.0
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let gain = values[0];
        scene.signal.iter_mut().for_each(|value| *value *= gain);
    }
}
