//! Only a part of each period is measured.

use super::scene::{Cursor, Scale, Scene, floored, integral};
use crate::spectrum;

use super::{Card, Clues, Effect, Parameter, Search, Stage};

/// See [`CARD`].
#[derive(Debug)]
pub struct SampledWindow;

static CARD: Card = Card {
    id: "sampled-window",
    statement: "The sensor measures only the first part of each period and holds that mean until the next one.",
    equation: "y = mean of i over the first duty·period of each period, held until the next (periods count from the recording's start)",
    parameters: &[
        Parameter::new("period_s", "s", 0.0, Search::Stepped),
        Parameter::new("duty", "1", 1.0, Search::Stepped).open(),
        Parameter::internal("phase_s", "s", 0.0, Search::Stepped),
    ],
    shows: "beats with periodic loads",
    looks_like: &["moving-average", "gain"],
    separated_by: "a load that switches with a period near that of the window",
    stage: Stage::Converter,
};

impl Effect for SampledWindow {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn bounds(&self, parameter: usize, scale: &Scale) -> (f64, f64) {
        match parameter {
            0 => (2.5 * scale.step_s, 0.1 * scale.span_s),
            1 => (0.01, 1.0),
            _ => (-scale.span_s, scale.span_s),
        }
    }

    fn starts(&self, scale: &Scale, clues: &Clues<'_>) -> Vec<Vec<f64>> {
        // A held reading moves at one phase of each period only: its squared steps have lines at the rate of the updates.
        let moves: Vec<f64> = std::iter::once(0.0)
            .chain(
                clues
                    .observed
                    .windows(2)
                    .map(|pair| (pair[1] - pair[0]).abs()),
            )
            .collect();
        let (lowest, highest) = self.bounds(0, scale);
        let mut starts = Vec::new();
        for line in spectrum::lines(clues.t_s, &moves, scale.reading_step_s) {
            for multiple in [1.0, 2.0] {
                let period = multiple / line.frequency_hz;
                if !(lowest..=highest).contains(&period) {
                    continue;
                }
                // The sine of the line is largest when the reading moves, which is when a window ends.
                let turn = std::f64::consts::FRAC_PI_2 - line.phase_rad;
                let moved_s =
                    turn / (std::f64::consts::TAU * line.frequency_hz) - 0.5 * scale.reading_step_s;
                for duty in [0.1, 0.25, 0.4, 0.55, 0.75, 1.0] {
                    starts.push(vec![period, duty, 0.0]);
                    let phase = (moved_s - duty * period - clues.t_s[0]).rem_euclid(period);
                    starts.push(vec![period, duty, phase]);
                }
            }
        }
        starts
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let (period, duty, phase) = (values[0], values[1], values[2]);
        let drive = scene.drive;
        let held = scene.held();
        let total = integral(&drive.t_s, &drive.segments, &scene.signal, held);
        let mut output = scene.signal.clone();
        for rows in drive.segments.iter().filter(|rows| !rows.is_empty()) {
            let start = drive.t_s[rows.start] + phase;
            // Windows go forward: one cursor for where they begin, one for where they end.
            let mut begin = Cursor::new(&drive.t_s, rows.clone());
            let mut end = begin.clone();
            let (mut value, mut until) = (scene.signal[rows.start], f64::NEG_INFINITY);
            let mut known = f64::NAN;
            for (out, t) in output[rows.clone()]
                .iter_mut()
                .zip(&drive.t_s[rows.clone()])
            {
                let elapsed = t - start;
                // Well before the next window ends there is nothing to ask.
                if elapsed.is_nan() || elapsed >= until {
                    // The newest window that has ended.
                    let ended = floored((elapsed - duty * period) / period);
                    until = (ended + 1.0 - 1e-6) * period + duty * period;
                    if ended >= 0.0 && ended != known {
                        known = ended;
                        let from = start + ended * period;
                        let before = begin.integral(&total, &scene.signal, from, held);
                        let to = from + duty * period;
                        let after = end.integral(&total, &scene.signal, to, held);
                        value = (after - before) / (duty * period);
                    }
                }
                *out = value;
            }
        }
        scene.signal = output;
    }
}
