//! Whether what works between the rows is a time of the sensor's, or only evens out noise of the reference.
//!
//! A reference has noise of its own. A mean over some of its rows, or a value between two of them, has less, so that any effect that works
//! between the rows lowers the error of readings that are right: without any physics. A sensor's time shows where the current moves,
//! the other wherever there is noise. The two are told apart by an instrument (errors in variables; Reiersøl 1941, *Econometrica*
//! 9, 1): what the effect does to a reference that is a mean over rows to both sides, which has next to nothing of the noise of
//! the row itself. On that the mismatch of a true effect is all of its change, that of the other one nothing.

use super::fit::Fit;
use super::robust::weights;
use super::slope::change;
use super::workbench::{Model, Workbench};
use crate::problem::Problem;

/// Rows to each side.
const BESIDE: f64 = 5.0;
/// The instrument shows an effect from so many standard deviations on.
const SHOWN: f64 = 2.0;
/// What it shows is the effect if it is this share of it,
const LEAST: f64 = 0.5;
/// but for so many standard deviations.
const CHANCE: f64 = 1.0;
/// Parts of the recording over which the spread is told.
const PARTS: usize = 200;

/// Whether the change from one fit to another is none that the instrument bears out.
pub(super) fn only_quietens(bench: &Workbench<'_>, before: &Fit, after: &Fit) -> bool {
    let quiet = quiet(bench);
    let chain = bench.chain_of(&quiet);
    let run = |model: &Model| bench.run_on(&chain, model);
    let instrument = change(&run(&after.model), &run(&before.model));
    let change = change(&after.predicted, &before.predicted);
    let weights = weights(&after.residual, after.sigma);
    !borne_out(&before.residual, &change, &instrument, &weights)
}

/// Whether the instrument shows a change at all, and as no less than half of it, each but for what chance does: by the instrument's
/// estimate of the share of the change that is there, and its standard error over parts of the recording.
fn borne_out(residual: &[f64], change: &[f64], instrument: &[f64], weights: &[f64]) -> bool {
    let score = |row: usize, value: f64| {
        let score = weights[row] * value * instrument[row];
        if score.is_finite() { score } else { 0.0 }
    };
    let rows = 0..change.len();
    let (shown, all) = rows.clone().fold((0.0, 0.0), |(shown, all), row| {
        (
            shown + score(row, residual[row]),
            all + score(row, change[row]),
        )
    });
    let there = shown / all;
    let each = change.len().div_ceil(PARTS).max(1);
    let variance: f64 = rows
        .clone()
        .step_by(each)
        .map(|from| {
            let part = from..rows.end.min(from + each);
            let left = part.map(|row| score(row, residual[row] - there * change[row]));
            left.sum::<f64>().powi(2)
        })
        .sum();
    let error = variance.sqrt() / all.abs();
    there > SHOWN * error && there > LEAST - CHANCE * error
}

/// The problem with a mean of the reference over so much to each side, less near an end of a stretch.
fn quiet(bench: &Workbench<'_>) -> Problem {
    let problem = bench.problem;
    let reach_s = BESIDE * bench.scale.step_s;
    let drive = &problem.drive;
    let mut reference: Vec<f64> = drive.reference.to_vec();
    for rows in &drive.segments {
        let (t_s, value) = (&drive.t_s[rows.clone()], &drive.reference[rows.clone()]);
        let (mut from, mut to, mut sum) = (0, 0, 0.0);
        for row in 0..t_s.len() {
            let reach_s = reach_s
                .min(t_s[row] - t_s[0])
                .min(t_s[t_s.len() - 1] - t_s[row]);
            // Half a thousandth of the reach, so that rounding of the times takes no row away.
            let reach_s = reach_s * 1.0005;
            while to < t_s.len() && t_s[to] <= t_s[row] + reach_s {
                sum += value[to];
                to += 1;
            }
            while t_s[from] < t_s[row] - reach_s {
                sum -= value[from];
                from += 1;
            }
            // Towards the end the reach gets shorter again.
            while to > row + 1 && t_s[to - 1] > t_s[row] + reach_s {
                to -= 1;
                sum -= value[to];
            }
            reference[rows.start + row] = sum / (to - from) as f64;
        }
    }
    problem.driven_by(reference.into())
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)]
mod tests {
    use super::*;
    use crate::effects::find;
    use crate::explain::fit::fit;
    use crate::explain::workbench::Member;

    const STEP_S: f64 = 0.1;
    const WINDOW_S: f64 = 0.5;

    /// A sensor whose reading is the mean over a window, and a reference with noise of its own.
    fn noisy(window_s: f64) -> Problem {
        let t_s: Vec<f64> = (0..3000).map(|row| STEP_S * f64::from(row)).collect();
        // In closed form, so that the mean over a window is exact.
        let mean_of_sine = |rad_per_s: f64, t: f64| {
            let half = 0.5 * rad_per_s * window_s;
            let size = if half > 0.0 { half.sin() / half } else { 1.0 };
            size * (rad_per_s * t - half).sin()
        };
        let current = |t: f64, window: bool| {
            let wave = |rad_per_s: f64| {
                if window {
                    mean_of_sine(rad_per_s, t)
                } else {
                    (rad_per_s * t).sin()
                }
            };
            10.0 * wave(0.11) + 1.0 * wave(0.83)
        };
        let noise = |t: f64, by: f64| 0.4 * (by * t * t).sin();
        let reference = |t: &f64| current(*t, false) + noise(*t, 9973.0);
        let reading = |t: &f64| current(*t, true) + noise(*t, 7919.0);
        let (reference, reading) = (
            t_s.iter().map(reference).collect(),
            t_s.iter().map(reading).collect(),
        );
        Problem::pair(t_s, reference, reading, 0.4)
    }

    #[test]
    fn a_window_of_the_sensor_is_told_from_noise_of_the_reference() {
        for (window_s, quietens) in [(0.0, true), (WINDOW_S, false)] {
            let problem = noisy(window_s);
            let bench = Workbench::new(&problem, &[]);
            let plain = fit(&bench, &Model::default(), None);
            let window = Member {
                effect: find("moving-average").unwrap(),
                values: vec![0.3],
            };
            let with = fit(&bench, &Model::default().with(window), None);
            let energy = |fit: &Fit| fit.residual.iter().map(|r| r * r).sum::<f64>();
            // Either way a window makes the error smaller.
            assert!(energy(&with) < 0.9 * energy(&plain), "{window_s} s");
            assert_eq!(
                only_quietens(&bench, &plain, &with),
                quietens,
                "{window_s} s"
            );
        }
    }
}
