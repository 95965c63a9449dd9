//! Two clocks of different rate.

use super::scene::{Scale, Scene};
use super::{Card, Clues, Effect, Parameter, Search, Stage, reach_of_shift, spaced};

/// See [`CARD`].
#[derive(Debug)]
pub struct ClockSkew;

static CARD: Card = Card {
    id: "clock-skew",
    statement: "The clocks of sensor and reference run at different rates: edges drift apart.",
    equation: "t_sensor = t·(1 + skew), y at the sensor's t; positive: the sensor's clock runs fast",
    parameters: &[Parameter::new("skew_ppm", "ppm", 0.0, Search::Smooth)],
    shows: "error at edges grows with time",
    looks_like: &["delay"],
    separated_by: "steps of the current over a longer time",
    stage: Stage::Clock,
};

impl Effect for ClockSkew {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn bounds(&self, _parameter: usize, _scale: &Scale) -> (f64, f64) {
        (-20_000.0, 20_000.0)
    }

    fn starts(&self, scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        // The last edge moved by a fraction of a step up to many.
        let moving = |over_s: f64| (0.3 * scale.step_s / over_s * 1e6).max(1.0);
        // A gap makes what is seen less, and what a clock has lost by then no less.
        let (least, most) = (moving(scale.operation_s), 300.0 * moving(scale.span_s));
        spaced(least, most.min(20_000.0).max(2.0 * least), 7)
            .into_iter()
            .flat_map(|skew| [vec![skew], vec![-skew]])
            .collect()
    }

    fn idealised(&self) -> f64 {
        0.0
    }

    fn reach_s(&self, values: &[f64], scale: &Scale) -> [f64; 2] {
        reach_of_shift(values[0] * 1e-6 * scale.operation_s)
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        scene.skew += values[0] * 1e-6;
    }
}
