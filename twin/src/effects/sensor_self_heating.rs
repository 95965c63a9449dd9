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

/// As warm at the first row as its current makes it in the long run, or as warm as it happens to be: one id.
#[derive(Debug)]
pub struct SensorSelfHeating {
    card: &'static Card,
}

/// In a recording that begins with a rest, or long after a change.
pub static SETTLED: SensorSelfHeating = SensorSelfHeating { card: &CARDS[0] };
/// In one that is cut out of a drive.
pub static CUT_OUT: SensorSelfHeating = SensorSelfHeating { card: &CARDS[1] };

static PARAMETERS: [Parameter; 3] = [
    Parameter::new("tc_per_a2", "1/A²", 0.0, Search::Linear),
    Parameter::new("tau_s", "s", 60.0, Search::Logarithmic).above_nothing(),
    Parameter::internal("before", "1", 0.0, Search::Linear),
];
/// The place of what the heat before the recording does to the gain at its first row, beyond that of the first row's current.
const BEFORE: usize = 2;
/// Only in a recording of so many τ is that told from a gain that drifts by chance.
const SEVERAL: f64 = 4.0;
/// As much as the heat of the recording may do.
const MOST: f64 = 0.5;

static CARDS: [Card; 2] = [
    card(PARAMETERS.as_slice().split_at(BEFORE).0),
    card(&PARAMETERS),
];

const fn card(parameters: &'static [Parameter]) -> Card {
    Card {
        id: "sensor-self-heating",
        statement: "The sensor warms with the square of the current, and its sensitivity follows.",
        equation: "y = i·(1 + tc·LP(i²)), LP: first order with τ, which begins as warm as what flowed before the recording has left it",
        parameters,
        shows: "slow, after load",
        looks_like: &["gain-temperature", "gain"],
        separated_by: "a long large current after a long rest",
        stage: Stage::Heat,
    }
}

impl SensorSelfHeating {
    fn is_cut_out(&self) -> bool {
        self.card.parameters.len() > BEFORE
    }
}

impl Effect for SensorSelfHeating {
    fn card(&self) -> &'static Card {
        self.card
    }

    /// What a file begins with is its own.
    fn turn(&self, _values: &[f64]) -> Option<f64> {
        self.is_cut_out().then_some(MOST)
    }

    fn beginning(&self) -> Option<usize> {
        self.is_cut_out().then_some(BEFORE)
    }

    fn alternative(&self) -> bool {
        self.is_cut_out()
    }

    fn bounds(&self, parameter: usize, scale: &Scale) -> (f64, f64) {
        if parameter == BEFORE {
            (-MOST, MOST)
        } else if parameter == 0 {
            let most = MOST / (scale.rms * scale.rms).max(1e-12);
            (-most, most)
        } else {
            // What is quicker is no heat, and what is slower is a gain.
            let least = (10.0 * scale.step_s).max(MIN_TAU_S);
            let spans = if self.is_cut_out() {
                SEVERAL.recip()
            } else {
                ENDLESS
            };
            let most = (spans * scale.span_s).min(MAX_TAU_S);
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
            .filter(|tau| !self.is_cut_out() || SEVERAL * tau <= scale.span_s)
            .map(|tau| {
                let mut start = vec![small, tau];
                start.extend(self.beginning().map(|_| 0.0));
                start
            })
            .collect()
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let squares: Vec<f64> = scene.signal.iter().map(|value| value * value).collect();
        let heat = scene.low_pass_over_gaps(&squares, values[1]);
        drop(squares);
        let mut gain = heat;
        gain.iter_mut().for_each(|heat| *heat *= values[0]);
        if let Some(before) = values.get(BEFORE)
            && let Some(rows) = scene.drive.operations().into_iter().next()
        {
            let times = &scene.drive.t_s[rows.clone()];
            for (gain, t) in gain[rows].iter_mut().zip(times) {
                *gain += before * ((times[0] - t) / values[1]).exp();
            }
        }
        for (value, gain) in scene.signal.iter_mut().zip(gain) {
            *value *= 1.0 + gain;
        }
    }
}
