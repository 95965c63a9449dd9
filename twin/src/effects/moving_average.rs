//! Boxcar window.

use super::between::Converter;
use super::scene::{Scale, Scene};
use super::{Card, Clues, Effect, Parameter, Search, Stage, blunted, spaced, within_a_period};

/// See [`CARD`].
#[derive(Debug)]
pub struct MovingAverage;

static CARD: Card = Card {
    id: "moving-average",
    statement: "The reading is the mean over a window (a sliding average, or the integration time of a converter) that the simulation lacks.",
    equation: "y(t) = 1/window · ∫ i over the last window_s",
    parameters: &[Parameter::new("window_s", "s", 0.0, Search::Logarithmic)],
    shows: "after steps, ends sharply",
    looks_like: &["lag", "delay"],
    separated_by: "steps of the current, sampled faster than a fifth of the window",
    stage: Stage::Converter,
};

impl Effect for MovingAverage {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn bounds(&self, _parameter: usize, scale: &Scale) -> (f64, f64) {
        // A window is late by half of itself.
        (2.0 * scale.fastest_s, 0.5 * scale.span_s)
    }

    fn starts(&self, scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        spaced(0.5 * scale.step_s, 0.2 * scale.span_s, 12)
            .into_iter()
            .map(|window| vec![window])
            .collect()
    }

    fn when_held(&self, values: &[f64], held_s: f64) -> Option<&'static str> {
        within_a_period(values[0], held_s)
    }

    fn reach_s(&self, values: &[f64], _scale: &Scale) -> [f64; 2] {
        [values[0], 0.0]
    }

    fn left_open_by_edges(&self, _parameter: usize, value: f64, step_s: f64) -> [f64; 2] {
        blunted(value, step_s)
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        if values[0] > 0.0 {
            scene.convert(Converter::Mean {
                window_s: values[0],
            });
        }
    }
}
