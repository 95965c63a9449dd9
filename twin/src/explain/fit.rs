//! Robust least squares for the values of a model: Levenberg–Marquardt on Huber's loss, bounds kept, steps searched.

use std::cmp::Ordering;
use std::collections::HashSet;
use std::ops::Range;
use std::sync::{Arc, OnceLock};

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};

use super::starts;
use super::workbench::{Model, Workbench};
use crate::effects::Search;
use crate::effects::chain::{Begun, Change};
use crate::problem::Base;

/// Residuals beyond this many standard deviations count by their size, not by its square (Huber).
pub const TUNING: f64 = 3.0;
/// Sums that are kept side by side.
const LANES: usize = 8;
/// Steps of Levenberg–Marquardt in one go.
const STEPS: usize = 14;
/// A step that lowers the loss by a smaller share calls for a new slope.
const SLOW: f64 = 5e-3;
/// A step with a new slope that lowers the loss by a smaller share is the last.
const ENOUGH: f64 = 1e-4;
/// Squares may be larger by this factor where a staircase is right in the mean.
const WORSE_BY: f64 = 1.05;
/// Shares of a time at which another minimum is looked for in the end.
const ELSEWHERE: [f64; 4] = [0.8, 0.9, 1.1, 1.25];
/// How far away values without a slope are tried.
const SHARES: [f64; 8] = [0.1, 0.03, 0.01, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5];
/// So often from where the last of them led.
const TIMES: usize = 4;
/// Steps that are tried, in times of it, while a step changes nothing.
const FARTHER: [f64; 3] = [1.0, 2.0, 4.0];
/// The same for values that are moved together.
const TOGETHER: [f64; 6] = [0.1, 0.03, 0.01, 3e-3, 1e-3, 3e-4];
/// The same for them.
const TIMES_TOGETHER: usize = 10;
/// The first of these steps tell whether there is anything to be found.
const COARSE: usize = 2;
/// A smaller drop of the loss is not worth another round of the same steps: one of 0.5 is a standard deviation.
const WORTH: f64 = 0.1;

/// What the model file says of the base is off by this many of its own standard uncertainties at most: beyond them it is no
/// uncertainty but physics that was left out, and has a name.
pub const BASE_OFF: f64 = 4.0;

/// Whether a value of the base stands at that end, by how many of its standard uncertainties it is off.
pub(super) fn at_base_end(deviations: f64) -> bool {
    deviations.abs() >= BASE_OFF * (1.0 - 1e-9)
}

/// A block that has this share of all that is known of a value is left out in parts.
const ALONE: f64 = 0.9;
/// So many.
const PARTS: usize = 4;

/// A fit of more rows than this does not keep its slope: memory stays linear in the recording, with a small factor.
const KEPT_ROWS: usize = 40_000;

/// A fitted model.
#[derive(Clone, Debug)]
pub struct Fit {
    /// The model.
    pub model: Model,
    /// Its simulation at the rows that count.
    pub predicted: Vec<f64>,
    /// Reading less simulation.
    pub residual: Vec<f64>,
    /// Spread of the residual, for Huber's loss.
    pub sigma: f64,
    /// Huber's loss over the rows fitted, in units of sigma².
    pub cost: f64,
    slope: Arc<OnceLock<Arc<Slope>>>,
}

impl Fit {
    /// A model as it is, with the simulation of it.
    pub fn of(bench: &Workbench<'_>, model: Model, cost: f64) -> Self {
        let predicted = bench.run(&model);
        let residual = bench.residual(&predicted);
        Self {
            sigma: spread(&residual),
            model,
            predicted,
            residual,
            cost,
            slope: Arc::default(),
        }
    }

    /// The same on the bench of readings as they were read, if it was made on one of white noise.
    pub fn as_read(&self, bench: &Workbench<'_>, read: &Workbench<'_>) -> Self {
        if bench.is_white() {
            Self::of(read, self.model.clone(), self.cost)
        } else {
            self.clone()
        }
    }

    /// The slope at its model: found once.
    pub fn slope(&self, bench: &Workbench<'_>) -> Arc<Slope> {
        let new = || Arc::new(slope(bench, &self.model, &self.predicted));
        if bench.len() > KEPT_ROWS {
            return new();
        }
        Arc::clone(self.slope.get_or_init(new))
    }
}

/// Which values are free, as coordinates of either sign and no bounds to speak of.
#[derive(Clone, Copy, Debug)]
enum Coordinate {
    /// Member, parameter, and whether its logarithm is the coordinate.
    Value(usize, usize, bool),
    /// Index of the start, among those of the bench.
    SocShift(usize),
    Resistance,
    Alignment,
}

impl Coordinate {
    /// Where in the simulation it begins to tell.
    fn change(self) -> Change {
        match self {
            Self::Value(member, _, _) => Change::Member(member),
            Self::SocShift(_) => Change::SocShift,
            Self::Resistance => Change::Resistance,
            Self::Alignment => Change::Alignment,
        }
    }
}

/// Spread by the median of absolute values, kept from vanishing where most residuals are nothing.
pub fn spread(residual: &[f64]) -> f64 {
    let mut sizes: Vec<f64> = residual.iter().map(|r| r.abs()).collect();
    if sizes.is_empty() {
        return 1e-12;
    }
    let rms = (residual.iter().map(|r| r * r).sum::<f64>() / residual.len() as f64).sqrt();
    let middle = sizes.len() / 2;
    let median = *sizes.select_nth_unstable_by(middle, f64::total_cmp).1;
    (1.4826 * median).max(0.3 * rms).max(1e-12)
}

/// Huber's loss of a residual in units of sigma.
pub fn huber(z: f64) -> f64 {
    let size = z.abs();
    // The part of it that counts by its square.
    let inner = size.min(TUNING);
    inner * (size - 0.5 * inner)
}

fn weight(z: f64) -> f64 {
    TUNING / z.abs().max(TUNING)
}

/// Sum of what a function makes of two series, in lanes.
fn sum_of(a: &[f64], b: &[f64], part: impl Fn(f64, f64) -> f64) -> f64 {
    let (a_chunks, a_rest) = a.as_chunks::<LANES>();
    let (b_chunks, b_rest) = b.as_chunks::<LANES>();
    let mut lanes = [0.0; LANES];
    for (x, y) in a_chunks.iter().zip(b_chunks) {
        for lane in 0..LANES {
            lanes[lane] += part(x[lane], y[lane]);
        }
    }
    let rest: f64 = a_rest.iter().zip(b_rest).map(|(x, y)| part(*x, *y)).sum();
    lanes.iter().sum::<f64>() + rest
}

/// Huber's loss of residuals.
pub fn loss(residual: &[f64], sigma: f64) -> f64 {
    let per_sigma = 1.0 / sigma;
    sum_of(residual, residual, |r, _| huber(r * per_sigma))
}

/// Derivatives of the simulation by each free coordinate, at the rows that count.
#[derive(Debug)]
pub struct Slope {
    coordinates: Vec<Coordinate>,
    /// A column for each coordinate.
    pub columns: Vec<Vec<f64>>,
    /// Penalty for each coordinate, in units of 1/sigma² of the coordinate, from what the model file says of the base.
    prior: Vec<f64>,
    at: Vec<f64>,
}

impl Slope {
    /// Number of coordinates.
    pub fn len(&self) -> usize {
        self.columns.len()
    }

    /// True if nothing is free.
    pub fn is_empty(&self) -> bool {
        self.columns.is_empty()
    }

    /// The model with coordinates moved; values stay within bounds.
    pub fn moved(&self, bench: &Workbench<'_>, model: &Model, by: &[f64]) -> Model {
        let mut model = model.clone();
        for (coordinate, delta) in self.coordinates.iter().zip(by) {
            shift(bench, &mut model, *coordinate, *delta);
        }
        model
    }

    /// Where a member's parameter is among the coordinates; `None` if it is not free. The coordinate of a
    /// [`Search::Logarithmic`] one is its logarithm.
    pub fn index(&self, member: usize, parameter: usize) -> Option<usize> {
        self.coordinates.iter().position(
            |coordinate| matches!(coordinate, Coordinate::Value(m, p, _) if (*m, *p) == (member, parameter)),
        )
    }

    /// What the model file says of the base, as normal equations.
    pub fn prior(&self) -> (DMatrix<f64>, DVector<f64>) {
        let mut normal = DMatrix::zeros(self.len(), self.len());
        let mut right = DVector::zeros(self.len());
        self.penalty(&mut normal, &mut right);
        (normal, right)
    }

    /// Carries the slope along a step (Broyden's update): cheaper than a new one, and nearly as good for small steps.
    fn learn(
        &mut self,
        bench: &Workbench<'_>,
        step: &[f64],
        [before, after]: [&[f64]; 2],
        model: &Model,
    ) {
        let scaled: Vec<f64> = self
            .columns
            .iter()
            .map(|column| dot(column, column).sqrt().max(1e-300))
            .collect();
        let length: f64 = step
            .iter()
            .zip(&scaled)
            .map(|(s, scale)| (s * scale).powi(2))
            .sum();
        if length.is_nan() || length <= 0.0 {
            return;
        }
        let mut missing = change(after, before);
        for (column, s) in self.columns.iter().zip(step) {
            missing
                .iter_mut()
                .zip(column)
                .for_each(|(m, c)| *m -= c * s);
        }
        for ((column, s), scale) in self.columns.iter_mut().zip(step).zip(&scaled) {
            let share = s * scale * scale / length;
            column
                .iter_mut()
                .zip(&missing)
                .for_each(|(c, m)| *c += share * m);
        }
        for (coordinate, at) in self.coordinates.iter().zip(&mut self.at) {
            *at = match coordinate {
                Coordinate::SocShift(start) => bench.starts[*start].at(&model.nuisance),
                Coordinate::Resistance => model.nuisance.resistance,
                _ => *at,
            };
        }
    }

    /// Leaves coordinates where they are: values beyond which nothing means anything (a knee at full charge) that would go there
    /// (`at_ends` has the model, and which way each would go), and of the starts, by index and coordinate, those of which the readings in use do not tell: how an
    /// operation began is no physics that another one could tell.
    fn keep(
        &self,
        at_ends: Option<(&Model, &DVector<f64>)>,
        (normal, right): (&mut DMatrix<f64>, &mut DVector<f64>),
        untold: impl Fn(usize, usize) -> bool,
    ) {
        for (k, coordinate) in self.coordinates.iter().enumerate() {
            let stays = match *coordinate {
                Coordinate::Value(m, p, _) => at_ends.is_some_and(|(model, outward)| {
                    let member = &model.members[m];
                    let (low, high) = member.effect.card().parameters[p].limits;
                    let value = member.values[p];
                    (value <= low && outward[k] < 0.0) || (value >= high && outward[k] > 0.0)
                }),
                Coordinate::SocShift(start) => untold(start, k),
                _ => false,
            };
            if stays {
                normal.row_mut(k).fill(0.0);
                normal.column_mut(k).fill(0.0);
                right[k] = 0.0;
            }
        }
    }

    /// Penalty of the base's nuisances at this model, and what it adds to the normal equations.
    fn penalty(&self, normal: &mut DMatrix<f64>, right: &mut DVector<f64>) {
        for (k, prior) in self.prior.iter().enumerate() {
            normal[(k, k)] += prior;
            right[k] -= prior * self.at[k];
        }
    }
}

/// Standard uncertainty of the resistance, as a share of it.
fn resistance_sigma(bench: &Workbench<'_>) -> Option<f64> {
    match &bench.problem.base {
        Base::Battery(base) => Some(base.resistance_sigma),
        Base::Sensor(_) => None,
    }
}

/// Whether a value of the base stands where its uncertainty ends, and the residual would have it beyond: it is free no more, and
/// hides nothing that an effect explains.
fn ended(column: &[f64], prior: f64, at: f64, residual: &[f64]) -> bool {
    if prior <= 0.0 || !at_base_end(at * prior.sqrt()) {
        return false;
    }
    let sigma = spread(residual);
    (dot(column, residual) / (sigma * sigma) - prior * at) * at > 0.0
}

fn shift(bench: &Workbench<'_>, model: &mut Model, coordinate: Coordinate, delta: f64) {
    match coordinate {
        Coordinate::Value(member, parameter, logarithmic) => {
            let effect = model.members[member].effect;
            let (low, high) = effect.bounds(parameter, &bench.scale);
            let value = &mut model.members[member].values[parameter];
            *value = if logarithmic {
                *value * delta.clamp(-3.0, 3.0).exp()
            } else {
                *value + delta
            };
            *value = value.clamp(low.min(high), high.max(low));
        }
        Coordinate::SocShift(start) => bench.starts[start].shift(&mut model.nuisance, delta),
        Coordinate::Resistance => {
            let most = resistance_sigma(bench).map_or(5.0, |sigma| BASE_OFF * sigma);
            let resistance = model.nuisance.resistance + delta;
            model.nuisance.resistance = resistance.clamp((-most).max(-0.9), most);
        }
        Coordinate::Alignment => {
            let most = 0.6 * bench.scale.step_s.max(bench.scale.reading_step_s);
            model.nuisance.alignment_s = (model.nuisance.alignment_s + delta).clamp(-most, most);
        }
    }
}

/// Free coordinates of a model with the size of a small step, the penalty and where it is.
fn coordinates(bench: &Workbench<'_>, model: &Model) -> Vec<(Coordinate, f64, f64, f64)> {
    let mut all = Vec::new();
    for (m, member) in model.members.iter().enumerate() {
        if bench.shown(member).is_some() {
            continue;
        }
        for (p, parameter) in member.effect.card().parameters.iter().enumerate() {
            let value = member.values[p];
            if !value.is_finite() {
                continue;
            }
            let (low, high) = member.effect.bounds(p, &bench.scale);
            let (logarithmic, step) = match parameter.search {
                Search::Stepped => continue,
                _ if model.held == Some((m, p)) => continue,
                Search::Logarithmic => (true, 1e-3),
                Search::Linear => {
                    let off = if parameter.off.is_finite() {
                        parameter.off
                    } else {
                        0.0
                    };
                    (
                        false,
                        (1e-3 * (value - off).abs()).max(1e-7 * (high - low).abs()),
                    )
                }
                Search::Smooth => (false, step_of(bench, parameter.unit, value, low, high)),
            };
            all.push((Coordinate::Value(m, p, logarithmic), step, 0.0, 0.0));
        }
    }
    if let Base::Battery(base) = &bench.problem.base {
        let inverse = |sigma: f64| 1.0 / (sigma * sigma);
        for (index, start) in bench.starts.iter().enumerate() {
            all.push((
                Coordinate::SocShift(index),
                starts::SMALL,
                inverse(start.sigma),
                start.at(&model.nuisance),
            ));
        }
        let is_voltage = bench.problem.view == crate::problem::View::Voltage;
        if base.resistance_sigma > 0.0 && is_voltage && !model.says_resistance() {
            all.push((
                Coordinate::Resistance,
                1e-4,
                inverse(base.resistance_sigma),
                model.nuisance.resistance,
            ));
        }
    }
    if bench.aligns(model) {
        all.push((
            Coordinate::Alignment,
            0.01 * bench.scale.step_s,
            0.0,
            model.nuisance.alignment_s,
        ));
    }
    all
}

/// A small step of a smooth parameter, by its unit: times move readings by a fraction of the sampling.
fn step_of(bench: &Workbench<'_>, unit: &str, value: f64, low: f64, high: f64) -> f64 {
    let scale = &bench.scale;
    match unit {
        "s" => 0.02 * scale.step_s,
        "ppm" => (0.02 * scale.step_s / scale.span_s.max(1e-9)) * 1e6,
        "Hz" => 0.01 / scale.span_s.max(1e-9),
        "rad" => 1e-3,
        _ => (1e-3 * value.abs()).max(1e-6 * (high - low).abs()),
    }
}

/// Whether a model rounds readings to a grid.
pub fn rounds(model: &Model) -> bool {
    model.members.iter().any(|member| member.effect.rounds())
}

/// Values by which the simulation is right in the mean, where it rounds and noise ahead of the grid takes readings a step up or down:
/// least squares of the staircase itself lean to the side on which fewer do.
pub fn in_the_mean(bench: &Workbench<'_>, from: Fit) -> Fit {
    let mut best = from;
    if !rounds(&best.model) {
        return best;
    }
    let most = WORSE_BY * dot(&best.residual, &best.residual);
    let even = vec![1.0; best.residual.len()];
    for _ in 0..STEPS {
        let slope = best.slope(bench);
        let (normal, right) = normal(&slope.columns, &even, &best.residual, 0..even.len());
        let by = solve(&normal, &right, 1e-9);
        let model = slope.moved(bench, &best.model, by.as_slice());
        let there = Fit::of(bench, model, best.cost);
        if dot(&there.residual, &there.residual) > most {
            break;
        }
        let moved = change(&there.predicted, &best.predicted);
        best = there;
        if moved.iter().all(|by| *by == 0.0) {
            break;
        }
    }
    best
}

/// What a residual says of what is ahead of a grid: the least that it has to move by for each reading to be the one that was read.
/// Next to an edge a hair is a step.
pub fn ahead_of_grid(bench: &Workbench<'_>, fit: &Fit) -> Vec<f64> {
    let grids = fit.model.members.iter();
    let half = grids
        .filter(|member| member.effect.rounds())
        .map(|member| 0.5 * member.values[0])
        .fold(0.0, f64::max);
    match unrounded(bench, &fit.model) {
        Some((_, predicted)) => bench
            .residual(&predicted)
            .iter()
            .map(|r| r - r.clamp(-half, half))
            .collect(),
        None => fit.residual.clone(),
    }
}

/// The model with nothing rounded, and what it says, if it rounds: a small step of a value ahead of a grid moves hardly any
/// reading, and those by a whole step of the grid.
fn unrounded(bench: &Workbench<'_>, model: &Model) -> Option<(Model, Vec<f64>)> {
    rounds(model).then(|| {
        let mut even = model.clone();
        let grids = even.members.iter_mut();
        for member in grids.filter(|member| member.effect.rounds()) {
            let off = member.effect.card().parameters.iter();
            member.values = off.map(|parameter| parameter.off).collect();
        }
        let predicted = bench.run(&even);
        (even, predicted)
    })
}

/// Coordinates that are moved in one run: each by itself but for the starts, of which no operation knows another's.
fn runs<'k>(
    coordinates: &[(Coordinate, f64, f64, f64)],
    some: &'k [usize],
) -> impl Iterator<Item = &'k [usize]> {
    let is_start = |k: &usize| matches!(coordinates[*k].0, Coordinate::SocShift(_));
    some.chunk_by(move |a, b| is_start(a) && is_start(b))
}

/// Of a run in which some coordinates were moved, what each of them does.
fn apart(
    bench: &Workbench<'_>,
    coordinates: &[(Coordinate, f64, f64, f64)],
    together: &[usize],
    varied: Vec<f64>,
    predicted: &[f64],
) -> Vec<(usize, Vec<f64>)> {
    let own = |k: &usize| match coordinates[*k].0 {
        Coordinate::SocShift(start) => (*k, bench.starts[start].own(&varied, predicted)),
        _ => (*k, varied.clone()),
    };
    match together {
        [only] => vec![(*only, varied)],
        several => several.iter().map(own).collect(),
    }
}

/// The slope at a model.
fn slope(bench: &Workbench<'_>, model: &Model, predicted: &[f64]) -> Slope {
    let residual = bench.residual(predicted);
    let unrounded = unrounded(bench, model);
    let (model, predicted) = unrounded
        .as_ref()
        .map_or((model, predicted), |(model, predicted)| {
            (model, predicted.as_slice())
        });
    let mut slope = Slope {
        coordinates: Vec::new(),
        columns: Vec::new(),
        prior: Vec::new(),
        at: Vec::new(),
    };
    let coordinates = coordinates(bench, model);
    let mut columns: Vec<Option<Vec<f64>>> = vec![None; coordinates.len()];
    // At a bound the step goes the other way.
    for sign in [1.0, -1.0] {
        let missing: Vec<usize> = (0..columns.len())
            .filter(|k| columns[*k].is_none())
            .collect();
        if missing.is_empty() {
            break;
        }
        let moved: Vec<(Change, Model)> = runs(&coordinates, &missing)
            .map(|together| {
                let mut moved = model.clone();
                for k in together {
                    shift(
                        bench,
                        &mut moved,
                        coordinates[*k].0,
                        sign * coordinates[*k].1,
                    );
                }
                (coordinates[together[0]].0.change(), moved)
            })
            .collect();
        let varied = bench.vary(model, &moved);
        let parts = runs(&coordinates, &missing)
            .zip(varied)
            .flat_map(|(together, varied)| apart(bench, &coordinates, together, varied, predicted));
        for (k, mut column) in parts {
            let per_step = sign / coordinates[k].1;
            let mut any = false;
            for (there, here) in column.iter_mut().zip(predicted) {
                let slope = (*there - here) * per_step;
                any |= slope != 0.0;
                *there = if slope.is_finite() { slope } else { 0.0 };
            }
            columns[k] = any.then_some(column);
        }
    }
    for ((coordinate, _, prior, at), column) in coordinates.into_iter().zip(columns) {
        if let Some(column) = column
            && !ended(&column, prior, at, &residual)
        {
            slope.coordinates.push(coordinate);
            slope.columns.push(column);
            slope.prior.push(prior);
            slope.at.push(at);
        }
    }
    slope
}

/// The rows from the first to the last that is not nothing, in whole lanes: sums over them are the same to the last digit.
fn reach(column: &[f64], start: usize) -> std::ops::Range<usize> {
    let is_some = |value: &f64| *value != 0.0;
    let first = column.iter().position(is_some).unwrap_or(column.len());
    let last = column
        .iter()
        .rposition(is_some)
        .map_or(first, |last| last + 1);
    let last = last.next_multiple_of(LANES).min(column.len());
    start + first - first % LANES..start + last
}

/// Normal equations over some rows: JᵀWJ and JᵀWr.
pub fn normal(
    columns: &[Vec<f64>],
    weights: &[f64],
    residual: &[f64],
    rows: Range<usize>,
) -> (DMatrix<f64>, DVector<f64>) {
    let size = columns.len();
    let mut matrix = DMatrix::zeros(size, size);
    let mut right = DVector::zeros(size);
    let mut weighted = vec![0.0; rows.len()];
    // Where an operation begins tells in its own rows alone.
    let reaches: Vec<std::ops::Range<usize>> = columns
        .iter()
        .map(|column| reach(&column[rows.clone()], rows.start))
        .collect();
    for a in 0..size {
        let own = reaches[a].clone();
        let weighted = &mut weighted[..own.len()];
        let pairs = columns[a][own.clone()].iter().zip(&weights[own.clone()]);
        for (out, (value, weight)) in weighted.iter_mut().zip(pairs) {
            *out = value * weight;
        }
        right[a] = dot(weighted, &residual[own.clone()]);
        for b in 0..=a {
            let (from, to) = (own.start.max(reaches[b].start), own.end.min(reaches[b].end));
            if from < to {
                let here = &weighted[from - own.start..to - own.start];
                let sum = dot(here, &columns[b][from..to]);
                matrix[(a, b)] = sum;
                matrix[(b, a)] = sum;
            }
        }
    }
    (matrix, right)
}

/// Sum of products, in lanes.
pub fn dot(a: &[f64], b: &[f64]) -> f64 {
    sum_of(a, b, |x, y| x * y)
}

/// A normal matrix made ready to be solved, with a little damping, scaled by the diagonal.
#[derive(Clone, Debug)]
pub struct Solver {
    scale: Vec<f64>,
    factor: Option<Cholesky<f64, Dyn>>,
}

impl Solver {
    /// Of a matrix.
    pub fn new(matrix: &DMatrix<f64>, damping: f64) -> Self {
        let size = matrix.nrows();
        let scale: Vec<f64> = (0..size)
            .map(|k| {
                let d = matrix[(k, k)];
                if d > 0.0 { d.sqrt() } else { 1.0 }
            })
            .collect();
        let mut scaled = DMatrix::zeros(size, size);
        for a in 0..size {
            for b in 0..size {
                scaled[(a, b)] = matrix[(a, b)] / (scale[a] * scale[b]);
            }
            scaled[(a, a)] += damping + 1e-12;
            if matrix[(a, a)] <= 0.0 {
                scaled[(a, a)] = 1.0;
            }
        }
        Self {
            scale,
            factor: scaled.cholesky(),
        }
    }

    /// Puts the solution in place of the right side; zero where nothing is known.
    pub fn solve(&self, right: &mut DVector<f64>) {
        let Some(factor) = &self.factor else {
            right.fill(0.0);
            return;
        };
        for (value, scale) in right.iter_mut().zip(&self.scale) {
            *value /= scale;
        }
        factor.solve_mut(right);
        for (value, scale) in right.iter_mut().zip(&self.scale) {
            *value /= scale;
        }
    }

    /// The most that a part of the matrix has of all that is known of some combination of values, 0 … 1.
    fn most_of(&self, part: &DMatrix<f64>) -> f64 {
        let Some(factor) = &self.factor else {
            return 0.0;
        };
        let scaled = DMatrix::from_fn(part.nrows(), part.ncols(), |a, b| {
            part[(a, b)] / (self.scale[a] * self.scale[b])
        });
        let half = factor.l_dirty().solve_lower_triangular(&scaled);
        let whole =
            half.and_then(|half| factor.l_dirty().solve_lower_triangular(&half.transpose()));
        let Some(whole) = whole else {
            return 0.0;
        };
        // None of them is negative: their sum is no less than the largest.
        if whole.trace() < ALONE {
            return whole.trace();
        }
        whole
            .symmetric_eigenvalues()
            .iter()
            .copied()
            .fold(0.0, f64::max)
    }

    /// Rows in parts of which each tells as much of the values as any other.
    fn parts(
        &self,
        columns: &[Vec<f64>],
        weights: &[f64],
        rows: Range<usize>,
    ) -> Vec<Range<usize>> {
        let mut sum = 0.0;
        let sums: Vec<f64> = rows
            .clone()
            .map(|row| {
                let here = DVector::from_iterator(columns.len(), columns.iter().map(|c| c[row]));
                let mut solved = here.clone();
                self.solve(&mut solved);
                sum += weights[row] * here.dot(&solved);
                sum
            })
            .collect();
        let mut from = rows.start;
        (1..=PARTS)
            .map(|part| {
                let share = sum * part as f64 / PARTS as f64;
                let to = match part {
                    PARTS => rows.end,
                    _ => rows.start + sums.partition_point(|sum| *sum < share),
                };
                let part = from..to.max(from);
                from = part.end;
                part
            })
            .collect()
    }
}

/// Solves with a little damping, scaled by the diagonal; zero where nothing is known.
pub fn solve(matrix: &DMatrix<f64>, right: &DVector<f64>, damping: f64) -> DVector<f64> {
    let mut solved = right.clone();
    if !solved.is_empty() {
        Solver::new(matrix, damping).solve(&mut solved);
    }
    solved
}

/// What a fit makes small: Huber's loss in a spread, of the rows in use.
#[derive(Clone, Copy)]
struct Aim<'a, 'b> {
    bench: &'a Workbench<'b>,
    sigma: f64,
    /// Weighs rows (0: left out).
    used: Option<&'a [f64]>,
}

impl Aim<'_, '_> {
    /// The loss, and the penalty of the base's nuisances.
    fn cost(&self, model: &Model, residual: &[f64]) -> f64 {
        let per_sigma = 1.0 / self.sigma;
        let loss = match self.used {
            None => loss(residual, self.sigma),
            Some(used) => sum_of(residual, used, |r, used| used * huber(r * per_sigma)),
        };
        let penalty: f64 = coordinates(self.bench, model)
            .iter()
            .map(|(_, _, prior, at)| 0.5 * prior * at * at)
            .sum();
        loss + penalty
    }
}

/// A model with its simulation at the rows that count.
struct Point {
    model: Model,
    predicted: Vec<f64>,
    residual: Vec<f64>,
}

impl Point {
    fn of(bench: &Workbench<'_>, model: Model, predicted: Vec<f64>) -> Self {
        Self {
            residual: bench.residual(&predicted),
            model,
            predicted,
        }
    }
}

/// What a simulation says more than another; 0 beyond the drive's ends, where nothing is known.
pub fn change(after: &[f64], before: &[f64]) -> Vec<f64> {
    after
        .iter()
        .zip(before)
        .map(|(after, before)| {
            let change = after - before;
            if change.is_finite() { change } else { 0.0 }
        })
        .collect()
}

/// Fits every free value from where the model stands. `used` weighs rows (0: left out); sigma is found on the way.
pub fn fit(bench: &Workbench<'_>, model: &Model, used: Option<&[f64]>) -> Fit {
    // The same question is asked again and again, and fits have one answer.
    if used.is_none()
        && let Some((model, sigma, cost)) = bench.known(model)
    {
        return Fit {
            sigma,
            ..Fit::of(bench, model, cost)
        };
    }
    let from = model;
    let mut model = model.clone();
    if !bench.aligns(&model) {
        model.nuisance.alignment_s = 0.0;
    }
    if model.says_resistance() {
        model.nuisance.resistance = 0.0;
    }
    let predicted = bench.run(&model);
    let mut here = Point::of(bench, model, predicted);
    let mut sigma = spread(&here.residual);
    let mut known = None;
    // The spread falls while the model becomes better: the loss follows in rounds.
    for round in 0..3 {
        let before = sigma;
        let aim = Aim { bench, sigma, used };
        known = descend(aim, &mut here, known);
        if search_steps(aim, &mut here, round > 0) {
            known = descend(aim, &mut here, None);
        }
        sigma = spread(&here.residual);
        if sigma > 0.9 * before {
            break;
        }
    }
    if here.model.held.is_none() {
        for member in &mut here.model.members {
            let found = member.values.clone();
            member.effect.ordered(&mut member.values);
            if member.values != found {
                known = None;
            }
        }
    }
    let cost = Aim { bench, sigma, used }.cost(&here.model, &here.residual);
    if used.is_none() {
        bench.remember(from, &here.model, sigma, cost);
    }
    let slope = OnceLock::new();
    if let Some(known) = known
        && bench.len() <= KEPT_ROWS
    {
        let _ = slope.set(Arc::new(known));
    }
    Fit {
        model: here.model,
        predicted: here.predicted,
        residual: here.residual,
        sigma,
        cost,
        slope: Arc::new(slope),
    }
}

/// Fits until nothing moves any more: for the model that is reported.
pub fn polish(bench: &Workbench<'_>, from: &Fit) -> Fit {
    let mut best = from.clone();
    for _ in 0..6 {
        let next = fit(bench, &best.model, None);
        let settled = (next.sigma - best.sigma).abs() < 1e-4 * best.sigma
            && next.cost > best.cost * (1.0 - 1e-4);
        best = next;
        if settled {
            break;
        }
    }
    // A load with a rhythm of its own makes a minimum at each window of so many of its periods.
    if !matches!(bench.problem.base, Base::Sensor(_)) {
        return best;
    }
    for m in 0..best.model.members.len() {
        let parameters = best.model.members[m].effect.card().parameters;
        let timed =
            |p: &usize| parameters[*p].unit == "s" && parameters[*p].search == Search::Logarithmic;
        for p in (0..parameters.len()).filter(timed) {
            for share in ELSEWHERE {
                let mut moved = best.model.clone();
                moved.members[m].values[p] *= share;
                let there = fit(bench, &moved, None);
                let sigma = there.sigma.min(best.sigma);
                if loss(&there.residual, sigma) < 0.999 * loss(&best.residual, sigma) {
                    best = there;
                }
            }
        }
    }
    best
}

/// Levenberg–Marquardt from a model whose slope may be known; gives the slope where it ends if that is known.
fn descend(aim: Aim<'_, '_>, here: &mut Point, known: Option<Slope>) -> Option<Slope> {
    let Aim { bench, sigma, used } = aim;
    let mut damping = 1e-4;
    let mut cost = aim.cost(&here.model, &here.residual);
    let mut slope = known.unwrap_or_else(|| slope(bench, &here.model, &here.predicted));
    let mut fresh = true;
    let mut steps = 0;
    while steps < STEPS && !slope.is_empty() {
        steps += 1;
        let (per_sigma, per_square) = (1.0 / sigma, 1.0 / (sigma * sigma));
        let mut weights: Vec<f64> = here
            .residual
            .iter()
            .map(|r| weight(r * per_sigma) * per_square)
            .collect();
        if let Some(used) = used {
            weights
                .iter_mut()
                .zip(used)
                .for_each(|(weight, used)| *weight *= used);
        }
        let (mut matrix, mut right) =
            normal(&slope.columns, &weights, &here.residual, 0..bench.len());
        slope.penalty(&mut matrix, &mut right);
        if let Some(used) = used {
            let untold = |start: usize, _| !bench.starts[start].told_by(used);
            slope.keep(None, (&mut matrix, &mut right), untold);
        }
        let mut gain = 0.0;
        for _ in 0..6 {
            let step = solve(&matrix, &right, damping);
            let moved = slope.moved(bench, &here.model, step.as_slice());
            let predicted = bench.run(&moved);
            let there = Point::of(bench, moved, predicted);
            let less = aim.cost(&there.model, &there.residual);
            if less < cost {
                gain = (cost - less) / cost.max(1e-300);
                let predicted = [here.predicted.as_slice(), &there.predicted];
                slope.learn(bench, step.as_slice(), predicted, &there.model);
                (*here, cost) = (there, less);
                damping = (damping * 0.2).max(1e-9);
                break;
            }
            if !fresh {
                break;
            }
            damping = (damping * 8.0).min(1e6);
        }
        // A slope that was only carried along may be why the step was small.
        if gain < SLOW {
            if fresh && gain < ENOUGH {
                return (gain == 0.0).then_some(slope);
            }
            slope = self::slope(bench, &here.model, &here.predicted);
            fresh = true;
        } else {
            fresh = false;
        }
    }
    fresh.then_some(slope)
}

/// Values at which the simulation jumps: tried around where they are, ever closer; `again` if that was done for another spread.
/// True if others were found.
fn search_steps(aim: Aim<'_, '_>, here: &mut Point, again: bool) -> bool {
    let mut found = false;
    for m in 0..here.model.members.len() {
        let member = &here.model.members[m];
        let effect = member.effect;
        let parameters = effect.card().parameters;
        let stepped: Vec<usize> = (0..parameters.len())
            .filter(|p| parameters[*p].search == Search::Stepped)
            .filter(|p| here.model.held != Some((m, *p)))
            .collect();
        if stepped.is_empty() || aim.bench.shown(member).is_some() {
            continue;
        }
        let together = effect.near(&member.values, &aim.bench.scale, 0.0).is_some();
        let mut search = Stepping {
            aim,
            begun: aim.bench.begin(&here.model, m),
            member: m,
            cost: aim.cost(&here.model, &here.residual),
            here,
        };
        found |= if together {
            search.together(again)
        } else {
            search.alone(&stepped)
        };
    }
    found
}

/// A search for values of one member at which the simulation jumps.
struct Stepping<'a, 'b, 'p> {
    aim: Aim<'a, 'b>,
    /// The simulation up to the member.
    begun: Begun<'b>,
    member: usize,
    here: &'p mut Point,
    cost: f64,
}

impl Stepping<'_, '_, '_> {
    fn values(&self) -> &[f64] {
        &self.here.model.members[self.member].values
    }

    /// Goes to other values if they cost less; what they cost against the present ones.
    fn goes_to(&mut self, values: Vec<f64>) -> Ordering {
        let bench = self.aim.bench;
        let mut moved = self.here.model.clone();
        moved.members[self.member].values = values;
        let predicted = bench.go_on(&self.begun, &moved);
        let there = Point::of(bench, moved, predicted);
        let cost = self.aim.cost(&there.model, &there.residual);
        let order = cost.partial_cmp(&self.cost).unwrap_or(Ordering::Greater);
        if order.is_lt() {
            (*self.here, self.cost) = (there, cost);
        }
        order
    }

    /// Where values depend on one another they are moved together.
    fn together(&mut self, again: bool) -> bool {
        let bench = self.aim.bench;
        let effect = self.here.model.members[self.member].effect;
        let held = self
            .here
            .model
            .held
            .filter(|(member, _)| *member == self.member);
        let without = bench.run(&self.here.model.without(self.member));
        let idle = self.aim.cost(&self.here.model, &bench.residual(&without));
        // The best of so many choices takes this much of noise.
        let chance = effect.choices(&bench.scale).max(1.0).ln();
        let from = if again { COARSE } else { 0 };
        let mut found = false;
        // Some of what lies near is the same at every share; the cost only falls, so that what lost once loses again.
        let mut tried_before: HashSet<Vec<u64>> = HashSet::new();
        for (tried, share) in TOGETHER.into_iter().enumerate().skip(from) {
            // What is no better than chance after the coarse steps is not near a minimum that is.
            if tried >= COARSE && self.cost > idle - chance {
                break;
            }
            for _ in 0..TIMES_TOGETHER {
                let before = self.cost;
                let near = effect.near(self.values(), &bench.scale, share);
                for mut values in near.unwrap_or_default() {
                    for (p, value) in values.iter_mut().enumerate() {
                        let (low, high) = effect.bounds(p, &bench.scale);
                        *value = value.clamp(low, high);
                    }
                    if let Some((_, p)) = held {
                        values[p] = self.values()[p];
                    }
                    let key = values.iter().map(|value| value.to_bits()).collect();
                    found |= tried_before.insert(key) && self.goes_to(values).is_lt();
                }
                if before - self.cost < WORTH {
                    break;
                }
            }
        }
        found
    }

    /// One parameter after the other.
    fn alone(&mut self, stepped: &[usize]) -> bool {
        let bench = self.aim.bench;
        let effect = self.here.model.members[self.member].effect;
        let mut found = false;
        for &p in stepped {
            let (low, high) = effect.bounds(p, &bench.scale);
            for share in SHARES {
                for _ in 0..TIMES {
                    let better = [1.0, -1.0].into_iter().any(|sign| {
                        // Where no reading lies between two values nothing changes: it may farther on.
                        let mut reached = FARTHER.into_iter().map(|times| {
                            let mut values = self.values().to_vec();
                            // A phase may be zero: it moves by shares of its period.
                            let size = if values[p] == 0.0 {
                                values[0]
                            } else {
                                values[p]
                            };
                            values[p] = (values[p] + sign * times * share * size).clamp(low, high);
                            self.goes_to(values)
                        });
                        reached
                            .find(|order| order.is_ne())
                            .is_some_and(Ordering::is_lt)
                    });
                    if !better {
                        break;
                    }
                    found = true;
                }
            }
        }
        found
    }
}

/// A fit seen from its blocks: what each block says about every coordinate, and how well each is predicted by the others.
#[derive(Debug)]
pub struct Blocked {
    /// The slope at the fit.
    pub slope: Arc<Slope>,
    /// Normal matrix of each block.
    pub matrices: Vec<DMatrix<f64>>,
    /// Right side of each block.
    pub rights: Vec<DVector<f64>>,
    /// Huber's weights of the rows.
    weights: Vec<f64>,
}

/// Huber's weights of residuals, in units of 1/sigma².
pub fn weights(residual: &[f64], sigma: f64) -> Vec<f64> {
    residual
        .iter()
        .map(|r| weight(r / sigma) / (sigma * sigma))
        .collect()
}

/// Looks at a fit block by block, with Huber's weights at `sigma`.
pub fn blocked(bench: &Workbench<'_>, fit: &Fit, sigma: f64) -> Blocked {
    let slope = fit.slope(bench);
    let weights = weights(&fit.residual, sigma);
    let (matrices, rights) = bench
        .blocks
        .iter()
        .map(|rows| normal(&slope.columns, &weights, &fit.residual, rows.clone()))
        .unzip();
    Blocked {
        slope,
        matrices,
        rights,
        weights,
    }
}

/// Loss of each row of each block under a model whose values come from the other blocks only (one Gauss–Newton step from the whole fit,
/// exact where the simulation is linear in its values), in units of sigma². A block that alone tells some of the values is left out
/// in parts: the others would say nothing of it, or anything.
pub fn held_out(bench: &Workbench<'_>, fit: &Fit, sigma: f64) -> Vec<Vec<f64>> {
    let blocked = blocked(bench, fit, sigma);
    let size = blocked.slope.len();
    let mut total = DMatrix::zeros(size, size);
    let mut right = DVector::zeros(size);
    blocked.slope.penalty(&mut total, &mut right);
    for (matrix, part) in blocked.matrices.iter().zip(&blocked.rights) {
        total += matrix;
        right += part;
    }
    let weights = &blocked.weights;
    let slope = &blocked.slope;
    // A start that only these rows tell.
    let untold = |here: &DMatrix<f64>, k: usize| {
        let all = total[(k, k)] - slope.prior[k];
        bench.starts.len() > 1 && starts::within_block(here[(k, k)], all)
    };
    // Loss of rows with the values that are left without them.
    let without = |rows: Range<usize>, here: &DMatrix<f64>, part: &DVector<f64>| -> Vec<f64> {
        let (mut matrix, mut others) = (&total - here, &right - part);
        let at_ends = Some((&fit.model, &right));
        slope.keep(at_ends, (&mut matrix, &mut others), |_, k| untold(here, k));
        let step = solve(&matrix, &others, 1e-9);
        rows.map(|row| {
            let columns = slope.columns.iter().zip(step.iter());
            let moved: f64 = columns.map(|(column, step)| column[row] * step).sum();
            huber((fit.residual[row] - moved) / sigma)
        })
        .collect()
    };
    let solver = Solver::new(&total, 1e-9);
    bench
        .blocks
        .iter()
        .zip(blocked.matrices.iter().zip(&blocked.rights))
        .map(|(rows, (matrix, part))| {
            let (mut told, mut ignored) = (matrix.clone(), part.clone());
            slope.keep(None, (&mut told, &mut ignored), |_, k| untold(matrix, k));
            if solver.most_of(&told) < ALONE {
                return without(rows.clone(), matrix, part);
            }
            let parts = solver.parts(&slope.columns, weights, rows.clone());
            let losses = parts.into_iter().flat_map(|rows| {
                let (matrix, part) = normal(&slope.columns, weights, &fit.residual, rows.clone());
                without(rows, &matrix, &part)
            });
            losses.collect()
        })
        .collect()
}
