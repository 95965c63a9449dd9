//! 95 % intervals of a model's values.
//!
//! Each has two estimates of its standard error, and the wider interval of the two is said:
//!
//! - *By stretches*: the recording in contiguous stretches, each left out in turn (the jackknife form of the cluster-robust
//!   covariance, "CR3"; MacKinnon, Nielsen and Webb 2023, *J. Econometrics* 232, 272), with Student's t for as many degrees of
//!   freedom as stretches tell the value (Bell and McCaffrey 2002). It holds for noise of any colour that is short against a
//!   stretch, and for a model that is a little wrong.
//! - *By the stated noise*: the fit's own weights carried through the noise that the model file states, its memory with it; where
//!   none is stated, through white noise as loud as what is left. A memory as long as the recording shows in no stretch, nor does
//!   what rounding takes from readings that stay.
//!
//! What the model file says of the reference's accuracy is added in quadrature: as far as its zero and its gain move the value.
//!
//! Where the loss has a kink in a value (an effect says so, [`crate::effects::Effect::kinked`]) or jumps with it, neither holds:
//! the value is moved, the others are fitted again, and the interval ends where the loss has risen by what bounds 95 %
//! (profile likelihood), with as many observations as the noise's memory leaves (Rao and Scott's correction). Rows on which it
//! jumps count by how far they go to and fro: noise ahead of a threshold carries them over it both ways. Of a period that evenly spaced
//! rows do not tell from its aliases the interval has them all.

use std::ops::Range;

use nalgebra::{DMatrix, DVector};

use super::fit::{Fit, fit as refit};
use super::normal::{dot, normal, solve};
use super::robust::{huber, loss, weights};
use super::slope::{Slope, change, rounds};
use super::workbench::{Member, Model, Workbench};
use crate::effects::{Parameter, Search};
use crate::problem::Base;

/// 97.5th percentile of the normal distribution.
const NORMAL: f64 = 1.96;
/// Degrees of freedom below which an estimate by stretches tells nothing: too few stretches show the value.
const LEAST_FREEDOM: f64 = 3.0;
/// Half of χ²'s 95th percentile with one degree of freedom.
const RISE: f64 = 0.5 * 3.84;
/// A row whose loss changes by more than this jumped: what the simulation says there changed by two standard deviations.
const JUMP: f64 = 2.0;
/// 95th percentile of what loss falls by chance to its least value, in units of the root of the squared jumps between there and the
/// truth: of a two-sided random walk on a parabola (Chernoff's distribution, as of a threshold that noise crosses both ways), by
/// 4,000 simulated walks.
const CHANCE: f64 = 2.5;
/// What is left is noise alone up to this multiple of the stated noise.
const NOISE_ALONE: f64 = 1.1;
/// Lags at which noise is asked how much it remembers.
const LAGS: usize = 16;
/// A change of the reference from one row to the next is an edge if those beside it are below this share of it: a course that rows follow
/// has neighbours of its own size, and a ramp that ends in the next row is as good as an edge only up to here.
const EDGE: f64 = 0.1;
/// Steps to each side when the end of a profile is looked for.
const OUTWARD: usize = 40;
/// Turns by which an alias is asked for at once.
const MOST_TURNS: f64 = 4096.0;
/// Halvings that narrow the end down.
const HALVINGS: usize = 7;

/// Student's 97.5th percentile (Cornish–Fisher's expansion, within one percent from three degrees of freedom on).
pub fn student(freedom: f64) -> f64 {
    let z = NORMAL;
    let (z3, z5, z7) = (z.powi(3), z.powi(5), z.powi(7));
    let v = freedom;
    z + (z3 + z) / (4.0 * v)
        + (5.0 * z5 + 16.0 * z3 + 3.0 * z) / (96.0 * v * v)
        + (3.0 * z7 + 19.0 * z5 + 17.0 * z3 - 15.0 * z) / (384.0 * v * v * v)
}

/// How sure a fit's coordinates are.
#[derive(Debug)]
struct Certainty {
    /// Half of the 95 % interval of each coordinate.
    half: Vec<f64>,
    /// By how many times the variance is that of white noise as loud as what is left, at least 1.
    inflation: Vec<f64>,
}

/// Contiguous stretches that hold every row: the held-out blocks with their guards.
fn stretches(bench: &Workbench<'_>) -> Vec<Range<usize>> {
    let count = bench.blocks.len();
    (0..count)
        .map(|block| {
            let start = bench.blocks[block].start;
            let end = bench
                .blocks
                .get(block + 1)
                .map_or(bench.len(), |next| next.start);
            start..end
        })
        .collect()
}

/// Normal equations of a stretch.
type Part = (DMatrix<f64>, DVector<f64>);

/// Normal equations of each stretch.
fn parts(bench: &Workbench<'_>, fit: &Fit, slope: &Slope, weights: &[f64]) -> Vec<Part> {
    stretches(bench)
        .into_iter()
        .map(|rows| normal(&slope.columns, weights, &fit.residual, rows))
        .collect()
}

/// Normal equations of the whole, with what the model file says of the base.
fn sum(slope: &Slope, parts: &[Part]) -> Part {
    let (mut whole, mut right) = slope.prior();
    for (matrix, side) in parts {
        whole += matrix;
        right += side;
    }
    (whole, right)
}

/// Inverse of a normal matrix, column by column.
fn inverse(matrix: &DMatrix<f64>) -> DMatrix<f64> {
    let size = matrix.nrows();
    let mut inverse = DMatrix::zeros(size, size);
    for k in 0..size {
        let mut unit = DVector::zeros(size);
        unit[k] = 1.0;
        inverse.set_column(k, &solve(matrix, &unit, 1e-12));
    }
    inverse
}

/// How sure each coordinate of a slope is; `beside` as in [`intervals`].
fn certainty(bench: &Workbench<'_>, fit: &Fit, slope: &Slope, beside: f64) -> Certainty {
    let size = slope.len();
    // A reading that noise takes over the edge of a grid is off by a whole step, and no outlier.
    let weights = if rounds(&fit.model) {
        vec![1.0 / (fit.sigma * fit.sigma); fit.residual.len()]
    } else {
        weights(&fit.residual, fit.sigma)
    };
    let parts = parts(bench, fit, slope, &weights);
    let (whole, right) = sum(slope, &parts);
    let stated = slope.prior().0;
    // What the whole would still step is no spread.
    let rest = solve(&whole, &right, 1e-9);
    let count = parts.len() as f64;
    let mut by_stretches = vec![0.0; size];
    let mut told = vec![(0.0, 0.0); size];
    if parts.len() > 1 {
        let mut steps: Vec<DVector<f64>> = Vec::with_capacity(parts.len());
        for (matrix, side) in &parts {
            let others = inverse(&(&whole - matrix));
            steps.push(&others * (side - matrix * &rest));
            let spread = &others * matrix * &others;
            for (k, (sum, squares)) in told.iter_mut().enumerate() {
                *sum += spread[(k, k)];
                *squares += spread[(k, k)].powi(2);
            }
        }
        let mean = steps.iter().sum::<DVector<f64>>() / count;
        for (k, variance) in by_stretches.iter_mut().enumerate() {
            *variance =
                (count - 1.0) / count * steps.iter().map(|s| (s[k] - mean[k]).powi(2)).sum::<f64>();
        }
    }
    // What the fit makes of each row's noise.
    let inverted = inverse(&whole);
    let rows = fit.residual.len().max(size + 1) as f64;
    let limited: f64 = fit
        .residual
        .iter()
        .zip(&weights)
        .map(|(r, w)| (r * w * fit.sigma * fit.sigma).powi(2))
        .sum();
    let variance = limited / (rows - size as f64).max(1.0);
    let accuracy = bench.problem.accuracy;
    let ones = bench.as_fitted(vec![1.0; bench.len()]);
    let as_designed = bench.as_fitted(bench.plain.clone());
    let (mut half, mut inflation) = (Vec::with_capacity(size), Vec::with_capacity(size));
    for k in 0..size {
        let influence: Vec<f64> = (0..fit.residual.len())
            .map(|row| {
                let sum: f64 = slope
                    .columns
                    .iter()
                    .enumerate()
                    .map(|(j, column)| inverted[(k, j)] * column[row])
                    .sum();
                sum * weights[row]
            })
            .collect();
        let white = variance * influence.iter().map(|a| a * a).sum::<f64>();
        let by_noise = bench.carried(0, &influence).unwrap_or(white) + bench.rounded(0, &influence);
        // What the model file says of the base is as uncertain as it says.
        let by_base: f64 = (0..size)
            .map(|j| inverted[(k, j)].powi(2) * stated[(j, j)])
            .sum();
        let (sum, squares) = told[k];
        let freedom = (sum * sum / squares.max(1e-300)).min(count - 1.0);
        let mut most = NORMAL * (by_noise + by_base).sqrt();
        let mut times = by_noise / white.max(1e-300);
        if freedom >= LEAST_FREEDOM {
            most = most.max(student(freedom) * (by_stretches[k] + by_base).sqrt());
            times = times.max(by_stretches[k] / white.max(1e-300));
        }
        let along = beside / (fit.sigma * fit.sigma) * inverted[(k, k)];
        // The reference's own zero and gain are the same all the time, and no noise shows them.
        let by_zero = accuracy.zero * dot(&influence, &ones);
        let by_gain = accuracy.gain * dot(&influence, &as_designed);
        half.push(most.hypot(along.sqrt()).hypot(by_zero).hypot(by_gain));
        inflation.push(times.max(1.0));
    }
    Certainty { half, inflation }
}

/// How much a member's values differ from stretch to stretch.
#[derive(Clone, Copy, Debug, Default)]
pub struct Variation {
    /// What values of their own for each stretch take of the loss, beyond what noise gives them, in standard deviations.
    pub deviations: f64,
    /// The same as energy, in the view's unit squared, summed over rows, as a share of the energy of the member's change.
    pub share: f64,
}

/// For each member, how much its values differ from stretch to stretch (Chow's test, over all stretches at once): those of a true
/// effect stay, those of a stand-in follow what it stands for.
pub fn variations(bench: &Workbench<'_>, fit: &Fit) -> Vec<Variation> {
    let slope = fit.slope(bench);
    let weights = weights(&fit.residual, fit.sigma);
    let stretches = stretches(bench);
    let parts = parts(bench, fit, &slope, &weights);
    let (whole, right) = sum(&slope, &parts);
    let rest = solve(&whole, &right, 1e-9);
    let freedom = fit.residual.len().saturating_sub(slope.len()).max(1) as f64;
    let loudness = 2.0 * loss(&fit.residual, fit.sigma) / freedom;
    // Where the model file states a memory, or what is left is more than the noise that it states, that is no noise of its own.
    let noise = bench.problem.noise;
    let left = dot(&fit.residual, &fit.residual) / freedom;
    let forgets =
        bench.coloured().rms > 0.0 || (noise > 0.0 && left > (NOISE_ALONE * noise).powi(2));
    let members = fit.model.members.iter().enumerate();
    members
        .map(|(m, member)| {
            let own: Vec<usize> = (0..member.values.len())
                .filter_map(|p| slope.index(m, p))
                .collect();
            let (mut taken, mut expected, mut variance) = (0.0, 0.0, 0.0);
            let remembered = if forgets {
                vec![1.0; own.len()]
            } else {
                memories(fit, &slope, &weights, &own, (&parts, &stretches))
            };
            for ((matrix, side), rows) in parts.iter().zip(&stretches) {
                let score = side - matrix * &rest;
                let score = DVector::from_fn(own.len(), |a, _| score[own[a]]);
                let here = DMatrix::from_fn(own.len(), own.len(), |a, b| matrix[(own[a], own[b])]);
                taken += score.dot(&solve(&here, &score, 1e-12));
                let by_noise: f64 = own
                    .iter()
                    .zip(&remembered)
                    .filter(|(k, _)| matrix[(**k, **k)] > 0.0)
                    .map(|(&k, remembered)| {
                        let column = &slope.columns[k][rows.clone()];
                        let weighted = column.iter().zip(&weights[rows.clone()]);
                        let weighted: Vec<f64> = weighted.map(|(c, w)| c * w).collect();
                        let stated = bench.stated(rows.start, &weighted)
                            + bench.rounded(rows.start, &weighted);
                        (remembered * loudness).max(stated / matrix[(k, k)])
                    })
                    .sum();
                expected += by_noise;
                variance += 2.0 * by_noise * by_noise / own.len() as f64;
            }
            let without = bench.run(&fit.model.without(m));
            let change = change(&fit.predicted, &without);
            let energy = dot(&change, &change).max(1e-300);
            Variation {
                deviations: (taken - expected) / variance.sqrt().max(1e-300),
                share: (taken - expected).max(0.0) * fit.sigma * fit.sigma / energy,
            }
        })
        .collect()
}

/// By how many times the variance of each coordinate's score over a stretch is that of as many independent rows, at least 1: from the
/// autocovariance γ of the scores within stretches, all stretches together. With what each stretch would have of its own taken off,
/// γ is lower than noise's by the variance v of a stretch's mean at every lag; noise that forgets within half a stretch leaves −v at
/// the lags behind that, and n·v is what a stretch's sum has.
fn memories(
    fit: &Fit,
    slope: &Slope,
    weights: &[f64],
    own: &[usize],
    (parts, stretches): (&[Part], &[Range<usize>]),
) -> Vec<f64> {
    let length = fit.residual.len() / stretches.len().max(1);
    let lags: Vec<usize> = (length / 2..3 * length / 4)
        .step_by((length / (4 * LAGS)).max(1))
        .collect();
    if lags.is_empty() {
        return vec![1.0; own.len()];
    }
    let (mut squares, mut apart) = (vec![0.0; own.len()], vec![0.0; own.len()]);
    let (mut rows_of_squares, mut rows_apart) = (0.0, 0.0);
    for ((matrix, side), rows) in parts.iter().zip(stretches) {
        let score = DVector::from_fn(own.len(), |a, _| side[own[a]]);
        let here = DMatrix::from_fn(own.len(), own.len(), |a, b| matrix[(own[a], own[b])]);
        let step = solve(&here, &score, 1e-12);
        let left: Vec<f64> = rows
            .clone()
            .map(|row| {
                let moved: f64 = own
                    .iter()
                    .zip(step.iter())
                    .map(|(k, step)| slope.columns[*k][row] * step)
                    .sum();
                weights[row] * (fit.residual[row] - moved)
            })
            .collect();
        rows_of_squares += left.len() as f64;
        rows_apart += lags
            .iter()
            .map(|lag| left.len().saturating_sub(*lag) as f64)
            .sum::<f64>();
        for (a, k) in own.iter().enumerate() {
            let column = &slope.columns[*k][rows.clone()];
            let scores: Vec<f64> = column.iter().zip(&left).map(|(c, r)| c * r).collect();
            squares[a] += dot(&scores, &scores);
            for lag in &lags {
                let later = scores.get(*lag..).unwrap_or_default();
                apart[a] += scores
                    .iter()
                    .zip(later)
                    .map(|(one, other)| one * other)
                    .sum::<f64>();
            }
        }
    }
    squares
        .iter()
        .zip(&apart)
        .map(|(squares, apart)| {
            let of_mean = (-apart / rows_apart.max(1.0)).max(0.0);
            let all = squares / rows_of_squares.max(1.0) + of_mean;
            (length as f64 * of_mean / all.max(1e-300)).max(1.0)
        })
        .collect()
}

/// An interval for each parameter of each member.
///
/// `beside` is the energy, in the view's unit squared, of what is left beyond noise: another physics, which moves the values by
/// what of it lies along the effects. That part cannot be seen; it is taken to be as large as the part beside them, which can.
pub fn intervals(bench: &Workbench<'_>, fit: &Fit, beside: f64) -> Vec<Vec<[f64; 2]>> {
    let slope = fit.slope(bench);
    let certainty = certainty(bench, fit, &slope, beside);
    let other_physics = 0.5 * beside / (fit.sigma * fit.sigma);
    fit.model
        .members
        .iter()
        .enumerate()
        .map(|(m, member)| {
            let parameters = member.effect.card().parameters;
            let aliases = aliases(bench, fit, m, RISE + other_physics);
            parameters
                .iter()
                .enumerate()
                .map(|(p, parameter)| {
                    let value = member.values[p];
                    if let Some(within) = bench.shown(member) {
                        return [value - within[p], value + within[p]];
                    }
                    let at = slope.index(m, p);
                    if parameter.search == Search::Stepped || member.effect.kinked(p) {
                        if parameter.internal || !value.is_finite() {
                            return [value, value];
                        }
                        let times = at.map_or(1.0, |k| certainty.inflation[k]);
                        let half = at.map(|k| certainty.half[k]);
                        let rise = RISE * times + other_physics;
                        // Readings that stay at a level all fall on one step of the converter.
                        let by_step = if member.effect.level(p) {
                            0.5 * bench.scale.quantum
                        } else {
                            0.0
                        };
                        return [-1.0, 1.0].map(|sign| {
                            let end = profile(bench, fit, (m, p), parameter, sign, rise, half);
                            let end = value + sign * (end - value).hypot(by_step);
                            let others = aliases.iter().map(|values| values[p]);
                            others.fold(end, |end, other| sign * (sign * end).max(sign * other))
                        });
                    }
                    let Some(k) = at else {
                        return [value, value];
                    };
                    [-1.0, 1.0].map(|sign| {
                        let by = sign * certainty.half[k];
                        if parameter.search == Search::Logarithmic {
                            value * by.exp()
                        } else {
                            value + by
                        }
                    })
                })
                .collect()
        })
        .collect()
}

/// The intervals as they are reported.
#[derive(Debug, Default)]
pub struct Reported {
    /// As [`intervals`] gives them, and wider where that is all that can be known.
    pub ci95: Vec<Vec<[f64; 2]>>,
    /// Values that move nothing where they stand: member and parameter.
    pub unmoved: Vec<(usize, usize)>,
    /// Members with a time that is told by edges whose place between two rows is not known.
    pub by_edges: Vec<usize>,
}

/// The intervals as they are reported. Names do not turn on what is added here: an effect is named for the values that it is told by,
/// and an edge that comes late is late, by however much.
pub fn reported(bench: &Workbench<'_>, fit: &Fit, beside: f64) -> Reported {
    let mut reported = Reported {
        ci95: intervals(bench, fit, beside),
        ..Reported::default()
    };
    let slope = fit.slope(bench);
    let course = told_by_course(bench);
    for (m, member) in fit.model.members.iter().enumerate() {
        if bench.shown(member).is_some() {
            continue;
        }
        for (p, parameter) in member.effect.card().parameters.iter().enumerate() {
            let value = member.values[p];
            if parameter.internal || !value.is_finite() {
                continue;
            }
            let ends = &mut reported.ci95[m][p];
            if parameter.search != Search::Stepped && slope.index(m, p).is_none() {
                let other_physics = 0.5 * beside / (fit.sigma * fit.sigma);
                let rise = RISE + other_physics;
                *ends = [-1.0, 1.0]
                    .map(|sign| profile(bench, fit, (m, p), parameter, sign, rise, None));
                reported.unmoved.push((m, p));
                continue;
            }
            let open_s = member
                .effect
                .left_open_by_edges(p, value, bench.scale.step_s);
            if open_s == [0.0; 2] {
                continue;
            }
            let wider = [0, 1].map(|side| {
                let (end, sign) = (ends[side], [-1.0, 1.0][side]);
                let half = sign * (end - value);
                let told = (half / course.sqrt()).min(half.hypot(open_s[side]));
                let wider = value + sign * told.max(half);
                // That there is any of it is told, if it was.
                match (end > parameter.off, end < parameter.off) {
                    (true, _) if value > parameter.off => wider.max(parameter.off),
                    (_, true) if value < parameter.off => wider.min(parameter.off),
                    _ => wider,
                }
            });
            // A remark is for where most of what is left open is the edges'.
            if wider[1] - wider[0] > 2.0 * (ends[1] - ends[0]) {
                reported.by_edges.push(m);
            }
            *ends = wider;
        }
    }
    reported
}

/// The share of what tells a time that is not in edges: changes of the reference within one row, in squares of its slope. Straight lines
/// put an edge into the middle between two rows; where it was, no row says. A model file that states a held reference does.
fn told_by_course(bench: &Workbench<'_>) -> f64 {
    let problem = bench.problem;
    if matches!(&problem.base, Base::Sensor(base) if base.held_reference || base.quasi_static) {
        return 1.0;
    }
    let drive = &problem.drive;
    // What noise makes of a row is no course that tells a time.
    let noise = problem
        .noise
        .hypot(std::f64::consts::SQRT_2 * bench.reference_noise);
    let (mut by_course, mut by_edges) = (0.0, 0.0);
    for rows in &drive.segments {
        let at: Vec<usize> = rows.clone().step_by(drive.stride()).collect();
        let rise = |pair: &[usize]| bench.steady[pair[1]] - bench.steady[pair[0]];
        let rises: Vec<f64> = at.windows(2).map(rise).collect();
        for (k, rise) in rises.iter().enumerate() {
            let h_s = drive.t_s[at[k + 1]] - drive.t_s[at[k]];
            if rise.abs() <= noise || h_s <= 0.0 {
                continue;
            }
            let beside = |k: Option<usize>| k.and_then(|k| rises.get(k)).map_or(0.0, |by| by.abs());
            let most = beside(k.checked_sub(1)).max(beside(Some(k + 1)));
            let energy = (rise / h_s).powi(2);
            if most < EDGE * rise.abs() {
                by_edges += energy;
            } else {
                by_course += energy;
            }
        }
    }
    if by_edges > 0.0 {
        by_course / (by_course + by_edges)
    } else {
        1.0
    }
}

/// Whether the loss of a residual has risen by more than what bounds a 95 % interval.
fn excluded(fit: &Fit, rise: f64) -> impl Fn(&[f64]) -> bool {
    // What is left may be louder or quieter than the spread that the loss is told in.
    let here = loss(&fit.residual, fit.sigma);
    let loudness = 2.0 * here / fit.residual.len().max(1) as f64;
    let limit = here + rise * loudness.max(0.1);
    move |residual| {
        let there = loss(residual, fit.sigma);
        let jumped = || -> f64 {
            let rows = fit.residual.iter().zip(residual);
            rows.map(|(best, moved)| huber(moved / fit.sigma) - huber(best / fit.sigma))
                .filter(|jump| jump.abs() > JUMP)
                .map(|jump| jump * jump)
                .sum()
        };
        there > limit && there > here + CHANCE * jumped().sqrt()
    }
}

/// Values of a member that rows so far apart do not tell from its own, everything else fitted again: to each side as far as they go.
fn aliases(bench: &Workbench<'_>, fit: &Fit, member: usize, rise: f64) -> Vec<Vec<f64>> {
    let Member { effect, values } = &fit.model.members[member];
    let excluded = excluded(fit, rise);
    // The values, so many turns away, if they are not told apart.
    let untold = |turns: f64| {
        let mut model = fit.model.clone();
        model.members[member].values = effect.alias(values, &bench.scale, turns)?;
        model.held = Some((member, 0));
        let there = refit(bench, &model, None);
        (!excluded(&there.residual)).then(|| there.model.members[member].values.clone())
    };
    let mut found = Vec::new();
    for sign in [-1.0, 1.0] {
        // Twice as far each time, and back by halves.
        let (mut inside, mut step, mut onward) = (0.0, 1.0, true);
        while (1.0..=MOST_TURNS).contains(&step) {
            match untold(sign * (inside + step)) {
                Some(values) => {
                    found.push(values);
                    inside += step;
                }
                None => onward = false,
            }
            step *= if onward { 2.0 } else { 0.5 };
        }
    }
    found
}

/// How far a value can go to one side before the loss, everything else fitted again, has risen by what bounds a 95 % interval.
fn profile(
    bench: &Workbench<'_>,
    fit: &Fit,
    (member, parameter): (usize, usize),
    card: &Parameter,
    sign: f64,
    rise: f64,
    half: Option<f64>,
) -> f64 {
    let value = fit.model.members[member].values[parameter];
    let (low, high) = fit.model.members[member]
        .effect
        .bounds(parameter, &bench.scale);
    let excluded = excluded(fit, rise);
    let risen = |there: f64| {
        let mut model = fit.model.clone();
        model.members[member].values[parameter] = there;
        let others_free = model.members.iter().any(|m| m.values.len() > 1)
            || model.members.len() > 1
            || bench.aligns(&model);
        let fixed = excluded(&bench.residual(&bench.run(&model)));
        if !fixed || !others_free {
            return fixed;
        }
        let model = Model {
            held: Some((member, parameter)),
            ..model
        };
        excluded(&refit(bench, &model, None).residual)
    };
    let size = match card.search {
        Search::Linear | Search::Smooth => (high - low).abs().min(1e6 * value.abs().max(1e-6)),
        _ => value.abs(),
    };
    let mut step = half
        .filter(|half| half.is_finite() && *half > 0.0)
        .map_or(1e-6 * size, |half| {
            if card.search == Search::Logarithmic {
                0.1 * half * value
            } else {
                0.1 * half
            }
        })
        .max(1e-7 * size);
    let (mut inside, mut outside) = (value, None);
    for _ in 0..OUTWARD {
        let there = (inside + sign * step).clamp(low.min(high), high.max(low));
        if there == inside {
            return inside;
        }
        if risen(there) {
            outside = Some(there);
            break;
        }
        inside = there;
        step *= 2.0;
    }
    let Some(mut outside) = outside else {
        return inside;
    };
    for _ in 0..HALVINGS {
        let middle = 0.5 * (inside + outside);
        if risen(middle) {
            outside = middle;
        } else {
            inside = middle;
        }
    }
    outside
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::effects::find;
    use crate::problem::{Coloured, Drive, Observed, Problem, SensorBase, View};
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::SeedableRng as _;
    use rand_distr::{Distribution as _, StandardNormal};

    const ROWS: usize = 1500;
    const STEP_S: f64 = 0.1;
    const NOISE_A: f64 = 0.5;
    const TRUTH: [(&str, f64); 3] = [("offset", 0.7), ("gain", 1.01), ("delay", 0.02)];

    /// Levels that change each second, with straight lines between them.
    fn current_a(t_s: f64) -> f64 {
        let level = |k: f64| 120.0 * (12.9898 * k).sin() + 60.0 * (0.31 * k).cos();
        level(t_s.floor()) + (level(t_s.floor() + 1.0) - level(t_s.floor())) * t_s.fract()
    }

    /// A reading with zero error, factor and delay, and noise: a share of it with a memory, rounded to steps.
    fn problem(seed: u64, coloured: Coloured, stated: bool, step_a: f64) -> Problem {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut normal = || -> f64 { StandardNormal.sample(&mut random) };
        let t_s: Vec<f64> = (0..ROWS).map(|k| k as f64 * STEP_S).collect();
        let kept = (-STEP_S / coloured.tau_s.max(1e-9)).exp();
        let white = (NOISE_A.powi(2) - coloured.rms.powi(2)).sqrt();
        let mut memory = coloured.rms * normal();
        let read = |t: &f64| {
            memory = kept * memory + coloured.rms * (1.0 - kept * kept).sqrt() * normal();
            let true_a = current_a((t - TRUTH[2].1).max(0.0));
            let y = TRUTH[1].1 * true_a + TRUTH[0].1 + memory + white * normal();
            if step_a > 0.0 {
                (y / step_a).round() * step_a
            } else {
                y
            }
        };
        let value = t_s.iter().map(read).collect();
        Problem {
            view: View::Sensor,
            name: "i_meas_a".into(),
            unit: "A".into(),
            drive: Drive {
                t_s: t_s.clone().into(),
                reference: t_s.iter().map(|t| current_a(*t)).collect(),
                segments: std::iter::once(0..ROWS).collect(),
                continues: vec![false],
                ..Drive::default()
            },
            observed: Observed::with_drive(t_s, value),
            base: Base::Sensor(SensorBase {
                full_scale: Some(600.0),
                step: step_a,
                ..SensorBase::default()
            }),
            modelled: Vec::new(),
            noise: NOISE_A,
            coloured: if stated {
                coloured
            } else {
                Coloured::default()
            },
            accuracy: crate::problem::Accuracy::default(),
        }
    }

    /// Share of the intervals with the truth in them, over recordings that differ by their noise.
    fn coverage(recordings: u64, coloured: Coloured, stated: bool, step_a: f64) -> [f64; 3] {
        let mut covered = [0.0; 3];
        for seed in 0..recordings {
            let problem = problem(seed, coloured, stated, step_a);
            let bench = Workbench::new(&problem, &[]);
            let members = TRUTH.iter().map(|(id, value)| Member {
                effect: find(id).unwrap(),
                values: vec![value * 1.001],
            });
            let model = Model {
                members: members.collect(),
                ..Model::default()
            };
            let fit = refit(&bench, &model, None);
            for (m, interval) in intervals(&bench, &fit, 0.0).iter().enumerate() {
                let [low, high] = interval[0];
                covered[m] += f64::from(u8::from((low..=high).contains(&TRUTH[m].1)));
            }
        }
        covered.map(|count| count / recordings as f64)
    }

    const WHITE: Coloured = Coloured {
        rms: 0.0,
        tau_s: 0.0,
    };
    /// Longer than a stretch: no stretch shows it.
    const SLOW: Coloured = Coloured {
        rms: 0.4,
        tau_s: 10.0,
    };
    const QUICK: Coloured = Coloured {
        rms: 0.4,
        tau_s: 0.5,
    };

    #[test]
    fn intervals_hold_the_truth_as_often_as_they_say() {
        let kinds = [
            (WHITE, true, 0.0),
            (WHITE, true, 0.8),
            (QUICK, true, 0.0),
            (QUICK, false, 0.0),
            (SLOW, true, 0.0),
        ];
        let found = kinds.map(|(coloured, stated, step)| coverage(60, coloured, stated, step));
        let mean = found.as_flattened().iter().sum::<f64>() / 15.0;
        // 900 intervals: two standard errors are 1.5 percent.
        assert!((0.925..0.99).contains(&mean), "{mean} {found:?}");
        assert!(
            found.as_flattened().iter().all(|one| *one > 0.86),
            "{found:?}"
        );
    }

    /// Share of the intervals of an effect's first value with the truth in them, where noise goes through the effect, and then
    /// through a converter's steps.
    fn coverage_at_the_end(effect: &str, truth: &[f64], step_a: f64) -> f64 {
        const RECORDINGS: u64 = 60;
        let effect = find(effect).unwrap();
        let mut covered = 0;
        for seed in 0..RECORDINGS {
            let mut problem = problem(seed, WHITE, true, step_a);
            let mut random = ChaCha8Rng::seed_from_u64(RECORDINGS + seed);
            for (value, reference) in problem
                .observed
                .value
                .iter_mut()
                .zip(&problem.drive.reference)
            {
                let noise: f64 = StandardNormal.sample(&mut random);
                let read = reference + NOISE_A * noise;
                *value = match effect.card().id {
                    "dead-band" if read.abs() < truth[0] => 0.0,
                    "clipping" => read.min(truth[0]).max(truth[1]),
                    _ => read,
                };
                if step_a > 0.0 {
                    *value = (*value / step_a).round() * step_a;
                }
            }
            let bench = Workbench::new(&problem, &[]);
            let model = Model {
                members: vec![Member {
                    effect,
                    values: truth.iter().map(|value| value * 1.001).collect(),
                }],
                ..Model::default()
            };
            let fit = refit(&bench, &model, None);
            let [low, high] = intervals(&bench, &fit, 0.0)[0][0];
            covered += u64::from((low..=high).contains(&truth[0]));
        }
        covered as f64 / RECORDINGS as f64
    }

    #[test]
    fn noise_that_crosses_a_threshold_both_ways_is_in_the_interval() {
        let found = coverage_at_the_end("dead-band", &[31.7], 0.0);
        assert!(found > 0.86, "{found}");
    }

    #[test]
    fn a_rail_is_known_to_half_a_step_of_the_converter() {
        let found = coverage_at_the_end("clipping", &[97.3, -2400.0], 1.2);
        assert!(found > 0.86, "{found}");
    }

    /// A period of which many fit in between two rows: rows tell its beat with them, and hardly how many.
    #[test]
    fn a_period_between_two_rows_is_known_to_its_aliases() {
        const RECORDINGS: u64 = 20;
        let [period_s, duty] = [0.004_1, 0.6];
        let window_a = |t_s: f64| {
            let from_s = ((t_s - duty * period_s) / period_s).floor() * period_s;
            let parts = (0..8).map(|k| from_s + duty * period_s * (f64::from(k) + 0.5) / 8.0);
            parts.map(|t_s| current_a(t_s.max(0.0))).sum::<f64>() / 8.0
        };
        let (mut covered, mut more) = ([0, 0], 0);
        for seed in 0..RECORDINGS {
            let mut problem = problem(seed, WHITE, true, 0.0);
            let mut random = ChaCha8Rng::seed_from_u64(RECORDINGS + seed);
            let readings = problem.observed.value.iter_mut().zip(&problem.observed.t_s);
            for (value, t_s) in readings {
                let noise: f64 = StandardNormal.sample(&mut random);
                *value = window_a(*t_s) + NOISE_A * noise;
            }
            let bench = Workbench::new(&problem, &[]);
            let model = Model {
                members: vec![Member {
                    effect: find("sampled-window").unwrap(),
                    values: vec![period_s, duty, 0.0],
                }],
                ..Model::default()
            };
            let fit = refit(&bench, &model, None);
            let found = &intervals(&bench, &fit, 0.0)[0];
            for (covered, (truth, [low, high])) in
                covered.iter_mut().zip([period_s, duty].iter().zip(found))
            {
                *covered += u32::from((low..=high).contains(&truth));
            }
            more += u32::from(found[0][1] - found[0][0] > 0.02 * period_s);
        }
        assert!(covered.iter().all(|covered| *covered >= 17), "{covered:?}");
        assert!(more >= 10, "{more}");
    }

    /// Pulses to one side and to the other, that begin and end at once, on a row each.
    fn pulses(t_s: f64, row_s: f64) -> f64 {
        let row = (t_s / row_s + 1e-6).floor();
        let turn = (row / 60.0).floor();
        let k = 2.0 * turn + f64::from(u8::from(row - 60.0 * turn >= 20.0));
        400.0 * (std::f64::consts::PI * k).cos() + 80.0 * (78.233 * k).sin()
    }

    /// Pulses on rows of a second, read at those rows by what `read` makes of the current at any time.
    fn of_pulses(read: impl Fn(&dyn Fn(f64) -> f64, f64) -> f64, seed: u64) -> Problem {
        let mut problem = problem(seed, WHITE, true, 0.0);
        let t_s: Vec<f64> = (0..ROWS).map(|k| k as f64).collect();
        let current_a = |t_s: f64| pulses(t_s.max(0.0), 1.0);
        let mut random = ChaCha8Rng::seed_from_u64(100 + seed);
        let reading = t_s.iter().map(|t| {
            let noise: f64 = StandardNormal.sample(&mut random);
            read(&current_a, *t) + NOISE_A * noise
        });
        problem.observed = Observed::with_drive(t_s.clone(), reading.collect());
        problem.drive.reference = t_s.iter().map(|t| current_a(*t)).collect();
        problem.drive.t_s = t_s.into();
        problem
    }

    fn reported_of(problem: &Problem, id: &str, values: &[f64]) -> (Reported, Vec<Vec<[f64; 2]>>) {
        let bench = Workbench::new(problem, &[]);
        let member = Member {
            effect: crate::effects::find_with(id, values.len()).unwrap(),
            values: values.to_vec(),
        };
        let fit = refit(&bench, &Model::default().with(member), None);
        (reported(&bench, &fit, 0.0), intervals(&bench, &fit, 0.0))
    }

    #[test]
    fn times_that_edges_tell_are_told_to_a_row() {
        for truth_s in [0.3, 0.6, 1.5] {
            let problem = of_pulses(|current_a, t_s| current_a(t_s - truth_s), 1);
            let (told, narrow) = reported_of(&problem, "delay", &[1.0]);
            let [low, high] = told.ci95[0][0];
            let [from, to] = narrow[0][0];
            assert!(to - from < 0.01, "{narrow:?}");
            assert!(low <= truth_s && truth_s <= high, "{truth_s}: {told:?}");
            // Late it is.
            assert!(low >= 0.0 && high - low < 2.1, "{told:?}");
            assert_eq!(told.by_edges, [0]);
        }
        // A model file that says that the reference is held says where its edges are.
        let mut held = of_pulses(|current_a, t_s| current_a(t_s - 1.0), 1);
        held.base = Base::Sensor(SensorBase {
            held_reference: true,
            ..SensorBase::default()
        });
        let (told, narrow) = reported_of(&held, "delay", &[1.0]);
        assert_eq!(told.ci95, narrow);
        assert!(told.by_edges.is_empty());
    }

    #[test]
    fn a_filter_is_longer_by_what_straight_lines_blunt() {
        let window_s = 2.0;
        let mean = |current_a: &dyn Fn(f64) -> f64, t_s: f64| {
            let parts = (0..100).map(|k| (f64::from(k) + 0.5) * 0.01 * window_s);
            parts.map(|late_s| current_a(t_s - late_s)).sum::<f64>() / 100.0
        };
        let (told, narrow) = reported_of(&of_pulses(mean, 2), "moving-average", &[1.8]);
        let ([_, high], [_, to]) = (told.ci95[0][0], narrow[0][0]);
        assert!(to < high && window_s <= high, "{told:?} {narrow:?}");
        assert!(high < 1.5 * window_s, "{told:?}");
    }

    #[test]
    fn a_course_that_rows_follow_tells_a_time_as_before() {
        let problem = problem(3, WHITE, true, 0.0);
        let (told, narrow) = reported_of(&problem, "delay", &[TRUTH[2].1]);
        assert_eq!(told.ci95, narrow);
        assert!(told.by_edges.is_empty() && told.unmoved.is_empty());
    }

    #[test]
    fn a_value_that_moves_nothing_is_told_as_far_as_it_moves_nothing() {
        // Each pulse turns the whole core over, whatever its coercive current is.
        let kept_a = |current_a: f64| 3.0 * current_a.signum();
        let problem = of_pulses(|current_a, t_s| current_a(t_s) - kept_a(current_a(t_s)), 4);
        let (told, narrow) = reported_of(&problem, "core-hysteresis", &[3.0, 12.0]);
        let [remanence, coercivity] = [told.ci95[0][0], told.ci95[0][1]];
        assert_eq!(told.unmoved, [(0, 1)], "{told:?}");
        assert_eq!(narrow[0][1], [12.0; 2]);
        // From a hundredth of the range to swings that turn all of it over: 1.5 times it to each side.
        assert!(coercivity[0] <= 6.0 && coercivity[1] > 60.0, "{told:?}");
        assert!(remanence[1] - remanence[0] < 0.5, "{told:?}");
    }

    #[test]
    fn what_is_left_beside_an_effect_widens_its_interval() {
        let problem = problem(1, WHITE, true, 0.0);
        let bench = Workbench::new(&problem, &[]);
        let model = Model {
            members: vec![Member {
                effect: find("offset").unwrap(),
                values: vec![TRUTH[0].1],
            }],
            ..Model::default()
        };
        let fit = refit(&bench, &model, None);
        let half = |beside: f64| {
            let [low, high] = intervals(&bench, &fit, beside)[0][0];
            0.5 * (high - low)
        };
        // A zero error of 10 A in each row has this energy: some of it may be the zero's own.
        let wider = half(ROWS as f64 * 100.0);
        assert!((wider / half(0.0).hypot(10.0) - 1.0).abs() < 0.2, "{wider}");
        assert!(half(0.0) < 5.0, "{}", half(0.0));
    }

    #[test]
    fn students_percentiles_are_those_of_the_tables() {
        for (freedom, table) in [(3.0, 3.182), (5.0, 2.571), (10.0, 2.228), (23.0, 2.069)] {
            let found = student(freedom);
            assert!((found / table - 1.0).abs() < 0.01, "{freedom}: {found}");
        }
    }
}
