//! First-order low-pass.

use super::scene::{Scale, Scene};
use super::{
    Card, Clues, Effect, Parameter, Search, Stage, TRACE, blunted, spaced, within_a_period,
};

/// See [`CARD`].
#[derive(Debug)]
pub struct Lag;

static CARD: Card = Card {
    id: "lag",
    statement: "The sensing chain has a low-pass that the simulation lacks: the reading follows late and smoothly.",
    equation: "τ·dy/dt + y = i",
    parameters: &[Parameter::new("tau_s", "s", 0.0, Search::Logarithmic)],
    shows: "after steps, in proportion to di/dt",
    looks_like: &["moving-average", "delay"],
    separated_by: "steps of the current, sampled faster than tau/5",
    stage: Stage::Filter,
};

impl Effect for Lag {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn bounds(&self, _parameter: usize, scale: &Scale) -> (f64, f64) {
        (scale.fastest_s, 0.5 * scale.span_s)
    }

    fn starts(&self, scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        spaced(0.2 * scale.step_s, 0.1 * scale.span_s, 9)
            .into_iter()
            .map(|tau| vec![tau])
            .collect()
    }

    fn when_held(&self, values: &[f64], held_s: f64) -> Option<&'static str> {
        within_a_period(values[0], held_s)
    }

    fn reach_s(&self, values: &[f64], _scale: &Scale) -> [f64; 2] {
        [-values[0] * TRACE.ln(), 0.0]
    }

    fn left_open_by_edges(&self, _parameter: usize, value: f64, step_s: f64) -> [f64; 2] {
        // A row is half of itself wide to each side of its middle, a lag a time constant.
        blunted(value, 0.5 * step_s)
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        scene.low_pass(values[0]);
    }
}
