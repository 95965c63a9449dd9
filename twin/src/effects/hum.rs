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
            // Less than one turn without an interruption is no line: any slow course has a part of one.
            0 => (
                1.0 / scale.span_s.max(1e-9),
                0.5 / scale.spectral_step_s.max(1e-9),
            ),
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
        let (lowest_hz, _) = self.bounds(0, scale);
        let late_s = clues.t_s.first().map_or(0.0, |first| first - scale.begin_s);
        spectrum::lines(clues.t_s, &residual, scale.spectral_step_s)
            .into_iter()
            .filter(|line| line.frequency_hz >= lowest_hz)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_part_of_a_turn_is_no_line() {
        let t_s: Vec<f64> = (0..3000).map(|row| 0.1 * f64::from(row)).collect();
        let scale = Scale {
            full_scale: 600.0,
            reading_step_s: 0.1,
            spectral_step_s: 0.1,
            span_s: 300.0,
            ..Scale::default()
        };
        let starts = |turns: f64| {
            let turn = std::f64::consts::TAU * turns / 300.0;
            let observed: Vec<f64> = t_s.iter().map(|t| 2.0 * (turn * t).sin()).collect();
            let clues = Clues {
                t_s: &t_s,
                observed: &observed,
                predicted: &vec![0.0; t_s.len()],
            };
            Hum.starts(&scale, &clues)
        };
        let (lowest_hz, _) = Hum.bounds(0, &scale);
        assert!((lowest_hz * 300.0 - 1.0).abs() < 1e-9, "{lowest_hz}");
        for turns in [0.3, 0.7] {
            let below = starts(turns)
                .into_iter()
                .filter(|values| values[0] < lowest_hz);
            assert_eq!(below.count(), 0, "{turns}");
        }
        let found = starts(4.0);
        let near = |values: &Vec<f64>| (values[0] * 300.0 - 4.0).abs() < 0.3;
        assert!(found.iter().any(near), "{found:?}");
    }
}
