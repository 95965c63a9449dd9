//! Where conversions lie between the rows that see them.

use crate::{problem::Observed, simulate::board::Reported};

/// Share of the rows that counts: those that fit worst are left to whatever explains them.
const COUNTED: f64 = 0.95;

/// What the board reports if its readings are as old as makes them fit best, within `slack_s` of `age_s`, tried at so many
/// ages to either side, and how old that is: so far the rows cannot tell it. A gain and an offset of each range are not held against a fit.
pub(super) fn closest(
    age_s: f64,
    (slack_s, trials): (f64, i32),
    observed: &Observed,
    run: impl Fn(f64) -> Reported,
) -> (f64, Reported) {
    let mut best = (age_s, run(age_s));
    let mut least = misfit(observed, &best.1);
    if slack_s > 0.0 {
        for trial in (-trials..=trials).filter(|trial| *trial != 0) {
            let trial_s = age_s + slack_s * f64::from(trial) / f64::from(trials);
            let reported = run(trial_s);
            let now = misfit(observed, &reported);
            if now < least {
                (best, least) = ((trial_s, reported), now);
            }
        }
    }
    best
}

/// By how much later than simulated readings were taken, in s, from how fast they change with it (`rate`, in the view's unit per s, at
/// each row): least squares beside a straight line in each range. Rows over a change of the range are of both, and left out.
pub(super) fn later_s(observed: &Observed, reported: &Reported, rate: &[f64]) -> f64 {
    let (mut along, mut size) = (0.0, 0.0);
    let high_at = |row: usize| reported.range_high[row] > 0.5;
    for high in [false, true] {
        let rows: Vec<usize> = (1..observed.value.len())
            .filter(|&row| observed.valid[row] && high_at(row) == high && high_at(row - 1) == high)
            .filter(|&row| {
                let known = [reported.current_a[row], observed.value[row], rate[row]];
                known.iter().all(|value| value.is_finite())
            })
            .collect();
        if rows.len() < 4 {
            continue;
        }
        // What a line through the readings takes of either is no sign of a time.
        let left = |of: &dyn Fn(usize) -> f64| {
            let pairs: Vec<(f64, f64)> = rows
                .iter()
                .map(|&row| (reported.current_a[row], of(row)))
                .collect();
            beside_line(&pairs)
        };
        let by_time = left(&|row| rate[row]);
        let off = left(&|row| observed.value[row] - reported.current_a[row]);
        along += by_time.iter().zip(&off).map(|(a, b)| a * b).sum::<f64>();
        size += by_time.iter().map(|a| a * a).sum::<f64>();
    }
    if size > 0.0 { along / size } else { 0.0 }
}

/// Mean square of what a straight line in each range leaves.
fn misfit(observed: &Observed, reported: &Reported) -> f64 {
    let mut squares = Vec::new();
    for high in [false, true] {
        let pairs: Vec<(f64, f64)> = (0..observed.value.len())
            .filter(|row| observed.valid[*row] && (reported.range_high[*row] > 0.5) == high)
            .map(|row| (reported.current_a[row], observed.value[row]))
            .filter(|(x, y)| x.is_finite() && y.is_finite())
            .collect();
        if pairs.len() < 3 {
            continue;
        }
        squares.extend(beside_line(&pairs).iter().map(|left| left * left));
    }
    squares.sort_by(f64::total_cmp);
    let counted = (squares.len() as f64 * COUNTED).ceil() as usize;
    squares[..counted].iter().sum::<f64>() / counted.max(1) as f64
}

/// What a straight line through points leaves of each, by least squares.
fn beside_line(points: &[(f64, f64)]) -> Vec<f64> {
    let count = points.len() as f64;
    let mean = |of: fn(&(f64, f64)) -> f64| points.iter().map(of).sum::<f64>() / count;
    let (x, y) = (mean(|point| point.0), mean(|point| point.1));
    let spread: f64 = points.iter().map(|point| (point.0 - x).powi(2)).sum();
    let together: f64 = points
        .iter()
        .map(|point| (point.0 - x) * (point.1 - y))
        .sum();
    let slope = together / spread.max(f64::MIN_POSITIVE);
    points
        .iter()
        .map(|point| point.1 - y - slope * (point.0 - x))
        .collect()
}
