//! A spectral line.

use super::scene::{Scale, Scene};
use super::{Card, Clues, Effect, Parameter, Search, Stage};
use crate::spectrum;

/// See [`CARD`].
#[derive(Debug)]
pub struct Hum;

static CARD: Card = Card {
    id: "hum",
    statement: "A ripple at the mains or inverter frequency is added, perhaps folded down by the sampling rate.",
    equation: "y = i + amplitude·sin(2π·frequency·t + φ), t from the first row on, φ is fitted beside",
    parameters: &[
        Parameter::new("frequency_hz", "Hz", 1.0, Search::Smooth).within(0.0, f64::INFINITY),
        Parameter::new("amplitude_a", "A", 0.0, Search::Linear),
        Parameter::internal("phase_rad", "rad", 0.0, Search::Smooth),
    ],
    shows: "a spectral line",
    looks_like: &[],
    separated_by: "a rest: the line stays",
    stage: Stage::Ripple,
};

impl Effect for Hum {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn bounds(&self, parameter: usize, scale: &Scale) -> (f64, f64) {
        match parameter {
            0 => (0.0, 0.5 / scale.reading_step_s.max(1e-9)),
            1 => (0.0, scale.full_scale),
            _ => (-10.0, 10.0),
        }
    }

    fn starts(&self, scale: &Scale, clues: &Clues<'_>) -> Vec<Vec<f64>> {
        let residual: Vec<f64> = clues
            .observed
            .iter()
            .zip(clues.predicted)
            .map(|(y, p)| y - p)
            .collect();
        let late_s = clues.t_s.first().map_or(0.0, |first| first - scale.begin_s);
        spectrum::lines(clues.t_s, &residual, scale.reading_step_s)
            .into_iter()
            .map(|line| {
                let turns = line.frequency_hz * std::f64::consts::TAU;
                let phase = (line.phase_rad - turns * late_s) % std::f64::consts::TAU;
                vec![line.frequency_hz, line.amplitude, phase]
            })
            .collect()
    }

    fn turn(&self, _values: &[f64]) -> Option<f64> {
        Some(std::f64::consts::TAU)
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let (turns_hz, amplitude, phase) =
            (values[0] * std::f64::consts::TAU, values[1], values[2]);
        let t_s = &scene.observed.t_s;
        // A clock may count from 1970: frequency and phase are told apart only where time counts from the recording.
        let begin_s = t_s.first().copied().unwrap_or_default();
        for (value, t) in scene.signal.iter_mut().zip(t_s) {
            *value += amplitude * (turns_hz * (t - begin_s) + phase).sin();
        }
    }
}
