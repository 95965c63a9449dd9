//! Memory of the multiplier at a change of range.

use super::scene::{Scale, Scene};
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
    parameters: &[
        Parameter::new("tau_s", "s", 0.0, Search::Logarithmic),
        Parameter::internal("since_s", "s", 0.0, Search::Smooth),
    ],
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

    fn bounds(&self, parameter: usize, scale: &Scale) -> (f64, f64) {
        if parameter == 0 {
            (0.01 * scale.step_s, 0.1 * scale.span_s)
        } else {
            (0.0, scale.step_s)
        }
    }

    fn starts(&self, scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        spaced(0.05 * scale.step_s, 30.0 * scale.step_s, 8)
            .into_iter()
            .map(|tau| vec![tau, 0.3 * scale.step_s])
            .collect()
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let ratio = scene.sensor.map_or(0.0, |sensor| sensor.range_ratio);
        let ratio = if ratio > 0.0 { ratio } else { DEFAULT_RATIO };
        let drive = scene.drive;
        if let Some(flag) = &drive.range_high {
            let scale = |row: usize| if flag[row] > 0.5 { ratio } else { 1.0 };
            let input = &scene.signal;
            let mut output = input.clone();
            for rows in &drive.segments {
                // Error of the product in the low-pass, in the scale of the range in use.
                let mut error = 0.0;
                let mut plain = rows.clone().next().map_or(0.0, |row| input[row]);
                for row in rows.clone().skip(1) {
                    let h = drive.t_s[row] - drive.t_s[row - 1];
                    let kept = if h > 0.0 { (-h / values[0]).exp() } else { 1.0 };
                    let ramp = if h > 0.0 {
                        1.0 - values[0] / h * (1.0 - kept)
                    } else {
                        0.0
                    };
                    plain = kept * plain
                        + (1.0 - kept) * input[row - 1]
                        + (input[row] - input[row - 1]) * ramp;
                    error *= kept;
                    let change = scale(row) / scale(row - 1);
                    if change != 1.0 {
                        // What the low-pass holds is read at another scale from here on.
                        // It began some time before this row.
                        error = (change * (plain + error) - plain) * (-values[1] / values[0]).exp();
                    }
                    output[row] += error;
                }
            }
            scene.signal = output;
        }
    }
}
