//! Constant zero error.

use super::scene::{Scale, Scene};
use super::{Card, Clues, Effect, Parameter, Search, Stage};

/// See [`CARD`].
#[derive(Debug)]
pub struct Offset;

static CARD: Card = Card {
    id: "offset",
    statement: "The sensor reads a constant amount too much: its zero is off.",
    equation: "y = i + offset",
    parameters: &[Parameter::new("offset_a", "A", 0.0, Search::Linear)],
    shows: "everywhere, strongest at rest; charge ramps",
    looks_like: &["coulombic-efficiency", "parasitic-load"],
    separated_by: "a rest of a minute with a reference current of zero",
    stage: Stage::Zero,
};

impl Effect for Offset {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn bounds(&self, _parameter: usize, scale: &Scale) -> (f64, f64) {
        (-scale.full_scale, scale.full_scale)
    }

    fn starts(&self, scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        vec![vec![0.01 * scale.full_scale]]
    }

    fn idealised(&self) -> f64 {
        0.0
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let offset = values[0];
        scene.signal.iter_mut().for_each(|value| *value += offset);
    }
}
