//! Small currents count as zero.

use super::scene::{Scale, Scene};
use super::{BENT, Card, Clues, Effect, Parameter, Search, Stage};

/// See [`CARD`].
#[derive(Debug)]
pub struct DeadBand;

/// A threshold is as stated if nothing but zero is below this share of it: it is told by the few readings next to it.
const AS_STATED: f64 = 0.9;

static CARD: Card = Card {
    id: "dead-band",
    statement: "Currents below a threshold are reported or counted as zero (creep or no-load threshold).",
    equation: "y = 0 for abs(i) < threshold",
    parameters: &[Parameter::new("threshold_a", "A", 0.0, Search::Stepped)],
    shows: "only for abs(i) below the threshold",
    looks_like: &["quantisation"],
    separated_by: "a slow ramp of the current through zero",
    stage: Stage::Threshold,
};

impl Effect for DeadBand {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn bounds(&self, _parameter: usize, scale: &Scale) -> (f64, f64) {
        (0.0, scale.full_scale)
    }

    fn starts(&self, _scale: &Scale, clues: &Clues<'_>) -> Vec<Vec<f64>> {
        let mut sizes: Vec<f64> = clues
            .predicted
            .iter()
            .map(|value| value.abs())
            .filter(|value| value.is_finite())
            .collect();
        if sizes.len() < 20 {
            return Vec::new();
        }
        sizes.sort_unstable_by(f64::total_cmp);
        // A band that few readings are in is told by those few.
        let few = [6, 12].map(|count| count.min(sizes.len() - 1));
        let share = [0.01, 0.02, 0.04, 0.07, 0.11, 0.16, 0.22, 0.3, 0.4, 0.5]
            .map(|share| (sizes.len() as f64 * share) as usize);
        few.into_iter()
            .chain(share)
            .map(|rank| vec![sizes[rank]])
            .filter(|start| start[0] > 0.0)
            .collect()
    }

    fn curve(&self) -> f64 {
        BENT
    }

    fn cuts(&self) -> bool {
        true
    }

    fn came_of(&self, values: &[f64], [low, high]: [f64; 2], off: f64) -> Option<[f64; 2]> {
        let threshold = values[0];
        if low <= off && high >= -off {
            return Some([low.min(-threshold), high.max(threshold)]);
        }
        (high.max(-low) + off >= AS_STATED * threshold).then_some([low, high])
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let threshold = values[0];
        scene
            .signal
            .iter_mut()
            .filter(|value| value.abs() < threshold)
            .for_each(|value| *value = 0.0);
    }
}
