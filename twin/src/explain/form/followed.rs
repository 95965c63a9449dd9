//! Forms with a memory of their own: readings that follow the signal no faster than a limit, or through a filter that rings.

use nalgebra::Complex;

use super::{Made, Says, Shape, current};
use crate::explain::workbench::Workbench;
use crate::report::format::significant;

/// Limits of speed that are tried, evenly in their logarithm, and how often the best is looked at closer.
const SPEEDS: usize = 24;
const CLOSER: usize = 3;
/// Angular frequencies that a filter of second order is tried at first, times the median step of the readings, and its dampings.
const TURNS: [f64; 2] = [0.01, 3.0];
const FREQUENCIES: usize = 20;
const DAMPINGS: [f64; 6] = [0.03, 0.1, 0.2, 0.4, 0.7, 0.95];
/// Least of 1 − ζ², with which both poles are still told apart.
const LEAST_APART: f64 = 1e-6;
/// How often the steps by which both are then found become smaller, and by what.
const SMALLER: usize = 12;
const BY: f64 = 0.6;
/// Median steps of time that are a gap.
const GAP: f64 = 10.0;

/// Both.
pub(super) fn all<'a>(
    bench: &'a Workbench<'_>,
    residual: &[f64],
    says: Says<'a>,
) -> [Box<dyn Shape + 'a>; 2] {
    let timing = Timing {
        t_s: &bench.t_s,
        x: current(bench),
        gap_s: GAP * bench.scale.step_s,
    };
    let limit = SpeedLimit {
        timing,
        range: speeds(bench),
        says,
    };
    let filter = SecondOrder::new(timing, bench.scale.step_s, residual);
    [Box::new(limit), Box::new(filter)]
}

/// The signal that a form with a memory of its own follows.
#[derive(Clone, Copy)]
struct Timing<'a> {
    t_s: &'a [f64],
    x: &'a [f64],
    /// From here on a step of time is a gap, after which the reading has caught up.
    gap_s: f64,
}

impl Timing<'_> {
    /// What a form makes of each row, less the signal: from the last row's state, what time has passed and the signal at both, `None` after a gap.
    fn followed<S: Copy>(
        &self,
        settled: impl Fn(f64) -> S,
        mut next: impl FnMut(S, f64, [f64; 2]) -> S,
        reads: impl Fn(S) -> f64,
    ) -> Vec<f64> {
        let mut last: Option<(f64, f64, S)> = None;
        let rows = self.t_s.iter().zip(self.x);
        rows.map(|(&t_s, &x)| {
            let state = match last {
                Some((last_s, from, state)) if (0.0..self.gap_s).contains(&(t_s - last_s)) => {
                    next(state, t_s - last_s, [from, x])
                }
                _ => settled(x),
            };
            last = Some((t_s, x, state));
            reads(state) - x
        })
        .collect()
    }
}

/// Squared sum of what a form leaves of a residual at the rows that are trained on.
fn left(residual: &[f64], made: &[f64], trained: &[bool]) -> f64 {
    let rows = (0..residual.len()).filter(|&row| trained[row]);
    rows.map(|row| (residual[row] - made[row]).powi(2)).sum()
}

/// A reading that follows no faster than so much a second.
struct SpeedLimit<'a> {
    timing: Timing<'a>,
    /// Limits that are looked at, in the view's unit a second.
    range: [f64; 2],
    says: Says<'a>,
}

/// Between which speeds a limit shows: a hundredth of the steepest rise of the reference, and that rise.
fn speeds(bench: &Workbench<'_>) -> [f64; 2] {
    let rates = bench.t_s.windows(2).zip(current(bench).windows(2));
    let most = rates
        .map(|(t, x)| (x[1] - x[0]).abs() / (t[1] - t[0]))
        .filter(|rate| rate.is_finite() && *rate > 0.0)
        .fold(0.0, f64::max);
    [0.01 * most, most]
}

impl SpeedLimit<'_> {
    fn follows(&self, limit: f64) -> Vec<f64> {
        self.timing.followed(
            |x| x,
            |reads, step_s, [_, x]| reads + (x - reads).clamp(-limit * step_s, limit * step_s),
            |reads| reads,
        )
    }
}

impl Shape for SpeedLimit<'_> {
    fn id(&self) -> &'static str {
        "speed-limit"
    }

    fn size(&self) -> usize {
        1
    }

    fn made(&self, residual: &[f64], trained: &[bool]) -> Option<Made> {
        let [mut from, mut to] = self.range.map(f64::ln);
        if !(from.is_finite() && to > from) {
            return None;
        }
        let mut best = (f64::INFINITY, from);
        for _ in 0..CLOSER {
            let step = (to - from) / SPEEDS as f64;
            for k in 0..=SPEEDS {
                let limit = from + step * k as f64;
                let left = left(residual, &self.follows(limit.exp()), trained);
                if left < best.0 {
                    best = (left, limit);
                }
            }
            (from, to) = (best.1 - step, best.1 + step);
        }
        let limit = best.1.exp();
        Some(Made {
            series: self.follows(limit),
            values: vec![limit],
        })
    }

    fn told(&self, values: &[f64]) -> String {
        let limit = significant(values[0], 3);
        format!(
            "readings that follow by no more than {limit} {} a second",
            self.says.unit
        )
    }
}

/// A filter of second order that rings.
struct SecondOrder<'a> {
    timing: Timing<'a>,
    /// Logarithms of the angular frequency in 1/s and of the damping from where they are found.
    start: [f64; 2],
    /// First steps of both.
    steps: [f64; 2],
}

impl<'a> SecondOrder<'a> {
    fn new(timing: Timing<'a>, step_s: f64, residual: &[f64]) -> Self {
        let [from, to] = TURNS.map(|turn| (turn / step_s).ln());
        let step = (to - from) / (FREQUENCIES - 1) as f64;
        let mut filter = Self {
            timing,
            start: [from, 0.0],
            steps: [step, 0.5],
        };
        let all = vec![true; residual.len()];
        let starts = (0..FREQUENCIES)
            .flat_map(|k| DAMPINGS.map(|damping: f64| [from + step * k as f64, damping.ln()]));
        filter.start = starts
            .map(|at| (left(residual, &filter.follows(at), &all), at))
            .min_by(|a, b| a.0.total_cmp(&b.0))
            .map_or(filter.start, |(_, at)| at);
        filter
    }

    /// Exact for straight lines between the rows: y = 2·Re(c·z), z′ = p·z + x, with the pole p = ω·(−ζ + j·√(1 − ζ²)) and c = ω²/(p − p*).
    fn follows(&self, at: [f64; 2]) -> Vec<f64> {
        let [turns, damping] = at.map(f64::exp);
        let pole =
            Complex::new(-damping, (1.0 - damping * damping).max(LEAST_APART).sqrt()) * turns;
        let factor = Complex::new(turns * turns, 0.0) / (pole - pole.conj());
        let mut known = (f64::NAN, [Complex::default(); 3]);
        self.timing.followed(
            |x| -Complex::new(x, 0.0) / pole,
            |state, step_s, [from, to]| {
                if known.0 != step_s {
                    let kept = (pole * step_s).exp();
                    let whole = (kept - 1.0) / pole;
                    let ramp = if step_s > 0.0 {
                        (whole / step_s - 1.0) / pole
                    } else {
                        Complex::default()
                    };
                    known = (step_s, [kept, whole, ramp]);
                }
                let [kept, whole, ramp] = known.1;
                kept * state + whole * from + ramp * (to - from)
            },
            |state| 2.0 * (factor * state).re,
        )
    }
}

impl Shape for SecondOrder<'_> {
    fn id(&self) -> &'static str {
        "second-order"
    }

    fn size(&self) -> usize {
        2
    }

    fn made(&self, residual: &[f64], trained: &[bool]) -> Option<Made> {
        let cost = |at: [f64; 2]| left(residual, &self.follows(at), trained);
        let mut best = (cost(self.start), self.start);
        let mut steps = self.steps;
        for _ in 0..SMALLER {
            for k in [0, 1] {
                for sign in [1.0, -1.0] {
                    let mut at = best.1;
                    at[k] += sign * steps[k];
                    at[1] = at[1].min(0.0);
                    let cost = cost(at);
                    if cost < best.0 {
                        best = (cost, at);
                    }
                }
            }
            steps = steps.map(|step| BY * step);
        }
        Some(Made {
            series: self.follows(best.1),
            values: best.1.map(f64::exp).to_vec(),
        })
    }

    fn told(&self, values: &[f64]) -> String {
        format!(
            "a filter of second order, {} Hz with a damping of {}",
            significant(values[0] / std::f64::consts::TAU, 3),
            significant(values[1], 2),
        )
    }
}
