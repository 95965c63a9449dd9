//! Memory of the multiplier at a change of range.

use super::scene::{Scale, Scene, range_changes};
use super::{Card, Clues, Effect, Parameter, Search, Stage, sensing, spaced};
use crate::problem::{Base, Problem};

/// ±600 A over ±60 A (D0).
const DEFAULT_RATIO: f64 = 10.0;

/// See [`CARD`].
#[derive(Debug)]
pub struct RangeHandover;

static CARD: Card = Card {
    id: "range-handover",
    statement: "After a change of range the multiplier's low-pass still holds the old range's product, which is counted at the new range's scale.",
    equation: "y = i + (S·LP(i/S) − LP(i)), S = scale of the range in use, LP: first order with τ",
    parameters: &[Parameter::new("tau_s", "s", 0.0, Search::Logarithmic)],
    shows: "at each change of the range flag",
    looks_like: &[],
    separated_by: "many changes of range at a large current",
    stage: Stage::HandOver,
};

impl Effect for RangeHandover {
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

    fn instants_s(&self, problem: &Problem) -> Option<Vec<f64>> {
        let Base::Sensor(sensor) = &problem.base else {
            return None;
        };
        let drive = &problem.drive;
        let changes = range_changes(drive, Some(sensor)).into_iter();
        let mut instants_s: Vec<f64> = changes
            .map(|change| drive.t_s[change.row] - change.since_s)
            .collect();
        instants_s.sort_unstable_by(f64::total_cmp);
        Some(instants_s)
    }

    fn columns(&self) -> &'static [&'static str] {
        &["range_high"]
    }

    fn bounds(&self, _parameter: usize, scale: &Scale) -> (f64, f64) {
        (2e-3 * scale.step_s, 0.1 * scale.span_s)
    }

    fn starts(&self, scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        spaced(5e-3 * scale.step_s, 30.0 * scale.step_s, 12)
            .into_iter()
            .map(|tau| vec![tau])
            .collect()
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let ratio = scene.sensor.map_or(0.0, |sensor| sensor.range_ratio);
        let ratio = if ratio > 0.0 { ratio } else { DEFAULT_RATIO };
        let tau_s = values[0];
        if tau_s <= 0.0 {
            return;
        }
        // What the low-pass holds is read at another scale from each change on.
        scene.decay_from_changes(tau_s, |plain, decayed, high| {
            let scale = if high { ratio } else { 1.0 / ratio };
            scale * (plain + decayed) - plain
        });
    }
}
