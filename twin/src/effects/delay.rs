//! Transport delay.

use super::scene::{Scale, Scene};
use super::{
    Card, Clues, Effect, Parameter, Search, Stage, reach_of_shift, spaced, within_a_period,
};

/// See [`CARD`].
#[derive(Debug)]
pub struct Delay;

static CARD: Card = Card {
    id: "delay",
    statement: "The reading comes late by a constant time, or its time stamp does.",
    equation: "y(t) = i(t − delay)",
    parameters: &[Parameter::new("delay_s", "s", 0.0, Search::Smooth)],
    shows: "edges",
    looks_like: &["lag", "moving-average", "clock-skew"],
    separated_by: "steps of the current early and late in the recording",
    stage: Stage::Clock,
};

impl Effect for Delay {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn bounds(&self, _parameter: usize, scale: &Scale) -> (f64, f64) {
        let most = (0.05 * scale.span_s).max(20.0 * scale.step_s);
        (-most, most)
    }

    fn starts(&self, scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        let most = (0.04 * scale.span_s).max(10.0 * scale.step_s);
        spaced(0.3 * scale.step_s, most, 8)
            .into_iter()
            .flat_map(|delay| [vec![delay], vec![-delay]])
            .collect()
    }

    fn idealised(&self) -> f64 {
        0.0
    }

    fn when_held(&self, values: &[f64], held_s: f64) -> Option<&'static str> {
        within_a_period(values[0], held_s)
    }

    fn reach_s(&self, values: &[f64], _scale: &Scale) -> [f64; 2] {
        reach_of_shift(values[0])
    }

    fn left_open_by_edges(&self, _parameter: usize, _value: f64, step_s: f64) -> [f64; 2] {
        // The edge of the reading is somewhere within a row as well.
        [step_s; 2]
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        scene.delay_s += values[0];
    }
}
