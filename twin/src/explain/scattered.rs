//! Whether what is left is that of readings whose moments scatter: a message that waits for its turn, a stamp that is set on arrival.
//!
//! A reading whose moment is off by δt is off by δt times what the current moves by per second. If δt is drawn anew for each row, what is
//! left has no course that an effect could have, but it is loud where the current moves and as loud as the stated noise where it does not.
//! A mean d of all δt and their spread j are fitted by maximum likelihood to residuals r with variance n² + j²·s² about d·s, with n the stated
//! noise and s the slope of the simulation as designed.

use super::form::BEYOND;
use super::normal::dot;
use super::rms;
use super::told::short;
use super::workbench::Workbench;
use crate::problem::View;

/// Fewer rows tell no variance.
const LEAST_ROWS: usize = 200;
/// Scatter and mean are what is left if they make at least this share of its energy beyond the stated noise.
const MOST: f64 = 0.8;
/// Parts of the rows by how fast the current moves, in each of which the variance has to be as it is said, …
const PARTS: usize = 6;
/// … to this factor.
const AS_SAID: f64 = 1.5;
/// Correlation of one row's error with the next one's: what has more is no chance of each row.
const ALONE: f64 = 0.2;
/// The mean moment is told from so many standard errors on.
const TOLD: f64 = 4.0;
/// Turns in which mean and spread are fitted to each other.
const TURNS: usize = 8;
/// The squared spread is looked for below this many times what all that is left would come to if it were nothing but scatter, …
const AT_MOST: f64 = 4.0;
/// … whose range is halved so often.
const HALVINGS: usize = 60;

/// What is to be said of a residual as it was read.
pub(super) fn scattered(bench: &Workbench<'_>, residual: &[f64]) -> Option<String> {
    let problem = bench.problem;
    if problem.view != View::Sensor || problem.noise <= 0.0 || problem.coloured.rms > 0.0 {
        return None;
    }
    let up_to: Vec<f64> = (0..residual.len())
        .map(|row| bench.slope_per_s(row))
        .collect();
    // Beyond the last row there is none, as up to the first.
    let mut from = up_to.clone();
    from.rotate_left(1);
    let about = up_to
        .iter()
        .zip(&from)
        .map(|(a, b)| 0.5 * (a + b))
        .collect();
    // Moments ahead of the rows', behind them, or to both sides.
    let found = [up_to, from, about].into_iter();
    let Moments {
        mean_s,
        uncertain_s,
        spread_s,
        ..
    } = found
        .filter_map(|slopes| moments(residual, &slopes, problem.noise))
        .max_by(|one, other| one.log_likelihood.total_cmp(&other.log_likelihood))?;
    let name = &problem.name;
    let mean = if mean_s.abs() > TOLD * uncertain_s {
        format!(
            ", and {} s {} on average",
            short(mean_s.abs()),
            if mean_s < 0.0 { "earlier" } else { "later" }
        )
    } else {
        String::new()
    };
    Some(format!(
        "{name}: what is left, {} {}, grows with how fast the current moves and differs from row to row, as if each reading stood for a \
         moment of its own, {} s (rms) from its row's{mean}: a message that waits, or a stamp that is set on arrival; with stamps of the \
         measurement itself it would go",
        short(rms(residual.iter().copied())),
        problem.unit,
        short(spread_s),
    ))
}

/// Moments that readings stand for, from their rows' on: their mean with its standard error, and their spread about it, rms.
#[derive(Debug)]
struct Moments {
    mean_s: f64,
    uncertain_s: f64,
    spread_s: f64,
    log_likelihood: f64,
}

/// Fitted to residuals with their slopes, in units per second, and white noise; `None` if that is not what is left.
fn moments(residual: &[f64], slopes: &[f64], noise: f64) -> Option<Moments> {
    let quiet = noise * noise;
    let pairs = || residual.iter().zip(slopes);
    let (energy, moves) = (dot(residual, residual), dot(slopes, slopes));
    let stated = quiet * residual.len() as f64;
    let beyond = energy - stated;
    if residual.len() < LEAST_ROWS || beyond <= BEYOND * stated || moves <= 0.0 {
        return None;
    }
    let (mut mean_s, mut squared, mut information) = (0.0, beyond / moves, 0.0);
    for _ in 0..TURNS {
        let weight = |s: f64| 1.0 / (quiet + squared * s * s);
        information = slopes.iter().map(|s| weight(*s) * s * s).sum();
        mean_s = pairs().map(|(r, s)| weight(*s) * r * s).sum::<f64>() / information;
        // The likelihood's slope along the spread, which has one zero.
        let rises = |squared: f64| {
            pairs()
                .map(|(r, s)| {
                    let variance = quiet + squared * s * s;
                    s * s * ((r - mean_s * s).powi(2) - variance) / (variance * variance)
                })
                .sum::<f64>()
                > 0.0
        };
        let (mut low, mut high) = (0.0, AT_MOST * energy / moves);
        for _ in 0..HALVINGS {
            let middle = 0.5 * (low + high);
            if rises(middle) {
                low = middle;
            } else {
                high = middle;
            }
        }
        squared = 0.5 * (low + high);
    }
    if (squared + mean_s * mean_s) * moves < MOST * beyond {
        return None;
    }
    let mut errors: Vec<(f64, f64)> = pairs()
        .map(|(r, s)| (s * s, (r - mean_s * s) / (quiet + squared * s * s).sqrt()))
        .collect();
    let all: f64 = errors.iter().map(|(_, error)| error * error).sum();
    let variances = slopes.iter().map(|s| (quiet + squared * s * s).ln());
    let log_likelihood = -0.5 * (all + variances.sum::<f64>());
    let together: f64 = errors.windows(2).map(|pair| pair[0].1 * pair[1].1).sum();
    if together.abs() > ALONE * all {
        return None;
    }
    errors.sort_by(|a, b| a.0.total_cmp(&b.0));
    let as_said = errors.chunks(errors.len().div_ceil(PARTS)).all(|part| {
        let mean = part.iter().map(|(_, error)| error * error).sum::<f64>() / part.len() as f64;
        (1.0 / AS_SAID..AS_SAID).contains(&mean)
    });
    as_said.then(|| Moments {
        mean_s,
        uncertain_s: information.sqrt().recip(),
        spread_s: squared.sqrt(),
        log_likelihood,
    })
}
