//! End of the output.

use super::scene::{Scale, Scene};
use super::{BENT, Card, Clues, Effect, Parameter, Search, Stage};

/// See [`CARD`].
#[derive(Debug)]
pub struct Clipping;

static CARD: Card = Card {
    id: "clipping",
    statement: "The output stops at a rail: larger readings do not exist.",
    equation: "y = min(max(i, low), high)",
    parameters: &[
        Parameter::new("high_a", "A", f64::INFINITY, Search::Smooth).open(),
        Parameter::new("low_a", "A", f64::NEG_INFINITY, Search::Smooth).open(),
    ],
    shows: "flat tops",
    looks_like: &["core-saturation"],
    separated_by: "currents beyond the rail: the reading stays flat",
    stage: Stage::Output,
};

impl Effect for Clipping {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn bounds(&self, parameter: usize, scale: &Scale) -> (f64, f64) {
        if parameter == 0 {
            (-scale.full_scale, 4.0 * scale.full_scale)
        } else {
            (-4.0 * scale.full_scale, scale.full_scale)
        }
    }

    fn starts(&self, scale: &Scale, clues: &Clues<'_>) -> Vec<Vec<f64>> {
        // A rail shows as readings that pile up at the end: the extremes, a little within for noise.
        let mut sorted: Vec<f64> = clues.observed.to_vec();
        if sorted.len() < 20 {
            return Vec::new();
        }
        sorted.sort_unstable_by(f64::total_cmp);
        let at = |share: f64| sorted[((sorted.len() - 1) as f64 * share) as usize];
        let far = 4.0 * scale.full_scale;
        let mut starts = Vec::new();
        for share in [0.0, 0.002, 0.01, 0.03] {
            let (low, high) = (at(share), at(1.0 - share));
            starts.push(vec![high, -far]);
            starts.push(vec![far, low]);
            starts.push(vec![high, low]);
        }
        starts
    }

    fn kinked(&self, _parameter: usize) -> bool {
        true
    }

    fn level(&self, _parameter: usize) -> bool {
        true
    }

    fn curve(&self) -> f64 {
        BENT
    }

    fn cuts(&self) -> bool {
        true
    }

    fn at_odds(&self, values: &[f64]) -> Option<&'static str> {
        (values[0] < values[1]).then_some("high_a, not below low_a")
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let (high, low) = (values[0], values[1]);
        scene
            .signal
            .iter_mut()
            .for_each(|value| *value = value.min(high).max(low));
    }
}
