//! The sensor warms itself.

use super::scene::{Scale, Scene};
use super::{Card, Clues, Effect, Parameter, Search, Stage, spaced};

/// Heat needs a second at least to reach a Hall element through its package.
const MIN_TAU_S: f64 = 1.0;
/// Nor does anything of the size of a sensor take longer to warm than some tens of minutes.
const MAX_TAU_S: f64 = 3600.0;
/// In a recording so many times shorter than τ the heat is hardly told from a gain,
const LONG: f64 = 2.0;
/// and so many times shorter it is one.
const ENDLESS: f64 = 10.0;

/// See [`CARD`].
#[derive(Debug)]
pub struct SensorSelfHeating;

static CARD: Card = Card {
    id: "sensor-self-heating",
    statement: "The sensor warms with the square of the current, and its sensitivity follows.",
    equation: "y = i·(1 + tc·LP(i²)), LP: first order with τ",
    parameters: &[
        Parameter::new("tc_per_a2", "1/A²", 0.0, Search::Linear),
        Parameter::new("tau_s", "s", 60.0, Search::Logarithmic),
    ],
    shows: "slow, after load",
    looks_like: &["gain-temperature", "gain"],
    separated_by: "a long large current after a long rest",
    stage: Stage::Heat,
};

impl Effect for SensorSelfHeating {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn bounds(&self, parameter: usize, scale: &Scale) -> (f64, f64) {
        if parameter == 0 {
            let most = 0.5 / (scale.rms * scale.rms).max(1e-12);
            (-most, most)
        } else {
            // What is quicker is no heat, and what is slower is a gain.
            let least = (10.0 * scale.step_s).max(MIN_TAU_S);
            let most = (ENDLESS * scale.span_s).min(MAX_TAU_S);
            (least, most.max(least))
        }
    }

    fn endless(&self, parameter: usize, scale: &Scale) -> f64 {
        if parameter == 1 {
            LONG * scale.span_s
        } else {
            f64::INFINITY
        }
    }

    fn starts(&self, scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        let small = 0.01 / (scale.rms * scale.rms).max(1e-12);
        let quickest = (20.0 * scale.step_s).max(2.0 * MIN_TAU_S);
        let slow = (0.5 * scale.span_s).min(0.5 * MAX_TAU_S);
        let slowest = (0.5 * ENDLESS * scale.span_s).min(MAX_TAU_S);
        spaced(quickest, slow.max(2.0 * quickest), 6)
            .into_iter()
            .chain([slowest])
            .map(|tau| vec![small, tau])
            .collect()
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let squares: Vec<f64> = scene.signal.iter().map(|value| value * value).collect();
        let heat = scene.low_pass_over_gaps(&squares, values[1]);
        drop(squares);
        for (value, heat) in scene.signal.iter_mut().zip(heat) {
            *value *= 1.0 + values[0] * heat;
        }
    }
}
