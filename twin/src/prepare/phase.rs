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

/// What the board reports if its readings are later than stated by the time at which they fit best, within `slack_s` to either side
/// of `later_s`, and that time in s. A shift this small moves a fit's error along a parabola, whose lowest point three trials tell.
pub(super) fn settled(
    later_s: f64,
    slack_s: f64,
    observed: &Observed,
    run: impl Fn(f64) -> Reported,
) -> (f64, Reported) {
    let here = run(later_s);
    if slack_s <= 0.0 {
        return (later_s, here);
    }
    let middle = misfit(observed, &here);
    let [before, after] = [-slack_s, slack_s].map(|by_s| misfit(observed, &run(later_s + by_s)));
    let bend = before + after - 2.0 * middle;
    if bend.is_nan() || bend <= 0.0 {
        return (later_s, here);
    }
    let lowest_s = later_s + slack_s * (0.5 * (before - after) / bend).clamp(-1.0, 1.0);
    (lowest_s, run(lowest_s))
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
        let count = pairs.len() as f64;
        if pairs.len() < 3 {
            continue;
        }
        let mean = |of: fn(&(f64, f64)) -> f64| pairs.iter().map(of).sum::<f64>() / count;
        let (x, y) = (mean(|pair| pair.0), mean(|pair| pair.1));
        let spread: f64 = pairs.iter().map(|pair| (pair.0 - x).powi(2)).sum();
        let together: f64 = pairs.iter().map(|pair| (pair.0 - x) * (pair.1 - y)).sum();
        let slope = if spread > 0.0 { together / spread } else { 1.0 };
        squares.extend(
            pairs
                .iter()
                .map(|pair| (pair.1 - y - slope * (pair.0 - x)).powi(2)),
        );
    }
    squares.sort_by(f64::total_cmp);
    let counted = (squares.len() as f64 * COUNTED).ceil() as usize;
    squares[..counted].iter().sum::<f64>() / counted.max(1) as f64
}
