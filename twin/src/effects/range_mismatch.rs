//! Two sensors that do not agree.

use super::scene::{Scale, Scene};
use super::{Card, Clues, Effect, Parameter, Search, Stage, sensing};
use crate::problem::Problem;

/// See [`CARD`].
#[derive(Debug)]
pub struct RangeMismatch;

static CARD: Card = Card {
    id: "range-mismatch",
    statement: "The large and the small sensor of a dual-range pair differ in sensitivity and zero.",
    equation: "y = i in the small range; y = gain_ratio·i + offset in the large one",
    parameters: &[
        Parameter::new("gain_ratio", "1", 1.0, Search::Linear),
        Parameter::new("offset_a", "A", 0.0, Search::Linear),
    ],
    shows: "differs by range flag",
    looks_like: &["gain", "offset"],
    separated_by: "currents in both ranges, of both signs",
    stage: Stage::Range,
};

impl Effect for RangeMismatch {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn applies(&self, problem: &Problem) -> bool {
        sensing(problem)
            && problem
                .drive
                .range_high
                .as_ref()
                .is_some_and(|flag| flag.iter().any(|f| *f > 0.5) && flag.iter().any(|f| *f < 0.5))
    }

    fn columns(&self) -> &'static [&'static str] {
        &["range_high"]
    }

    fn bounds(&self, parameter: usize, scale: &Scale) -> (f64, f64) {
        if parameter == 0 {
            (0.2, 5.0)
        } else {
            (-scale.full_scale, scale.full_scale)
        }
    }

    fn starts(&self, scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        vec![vec![1.01, 0.01 * scale.full_scale]]
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let (ratio, offset) = (values[0], values[1]);
        let drive = scene.drive;
        if let Some(flag) = &drive.range_high {
            for (value, high) in scene.signal.iter_mut().zip(flag) {
                if *high > 0.5 {
                    *value = *value * ratio + offset;
                }
            }
        }
    }
}
