//! Memory of the multiplier at a change of range.

use super::scene::{Scale, Scene, low_pass};
use super::{Card, Clues, Effect, Parameter, Search, Stage, sensing, spaced};
use crate::problem::Problem;

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
    stage: Stage::Sensor,
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

    fn bounds(&self, _parameter: usize, scale: &Scale) -> (f64, f64) {
        (0.01 * scale.step_s, 0.1 * scale.span_s)
    }

    fn starts(&self, scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        spaced(0.05 * scale.step_s, 30.0 * scale.step_s, 8)
            .into_iter()
            .map(|tau| vec![tau])
            .collect()
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let ratio = scene.sensor.map_or(0.0, |sensor| sensor.range_ratio);
        let ratio = if ratio > 0.0 { ratio } else { DEFAULT_RATIO };
        let drive = scene.drive;
        if let Some(flag) = &drive.range_high {
            let scale = |row: usize| if flag[row] > 0.5 { ratio } else { 1.0 };
            let scaled: Vec<f64> = scene
                .signal
                .iter()
                .enumerate()
                .map(|(row, value)| value / scale(row))
                .collect();
            // The range changes with a step: what is held between samples is the input of the old range.
            let memory = low_pass(&drive.t_s, &drive.segments, &scaled, values[0], true);
            let plain = low_pass(&drive.t_s, &drive.segments, &scene.signal, values[0], true);
            for (row, value) in scene.signal.iter_mut().enumerate() {
                *value += scale(row) * memory[row] - plain[row];
            }
        }
    }
}
