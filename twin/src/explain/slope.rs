//! Which values of a model are free, and what the simulation changes by when each of them is moved.

use nalgebra::{DMatrix, DVector};

use super::normal::dot;
use super::robust::spread;
use super::starts;
use super::workbench::{Model, Workbench};
use crate::effects::chain::{Change, Nuisance};
use crate::effects::{Says, Search};
use crate::problem::Base;

/// What the model file says of the base is off by this many of its own standard uncertainties at most: beyond them it is no
/// uncertainty but physics that was left out, and has a name.
pub const BASE_OFF: f64 = 4.0;

/// A small step of a bend, as a share of its uncertainty.
const SMALL_BEND: f64 = 1e-3;
/// The same of a current that is open.
const SMALL_CURRENT: f64 = 1e-3;

/// Whether a value of the base stands at that end, by how many of its standard uncertainties it is off.
pub(super) fn at_base_end(deviations: f64) -> bool {
    deviations.abs() >= BASE_OFF * (1.0 - 1e-9)
}

/// Which values are free, as coordinates of either sign and no bounds to speak of.
#[derive(Clone, Copy, Debug)]
pub(super) enum Coordinate {
    /// Member, parameter, and whether its logarithm is the coordinate.
    Value(usize, usize, bool),
    /// Index of the start, among those of the bench.
    SocShift(usize),
    Resistance,
    CurrentZero,
    Before,
    /// Index of the line, among those of the bench that bend.
    OcvBend(usize),
    Alignment,
}

impl Coordinate {
    /// Where in the simulation it begins to tell.
    fn change(self) -> Change {
        match self {
            Self::Value(member, _, _) => Change::Member(member),
            Self::SocShift(_) => Change::SocShift,
            Self::Resistance => Change::Resistance,
            Self::CurrentZero => Change::CurrentZero,
            Self::Before => Change::Before,
            Self::OcvBend(_) => Change::OcvBend,
            Self::Alignment => Change::Alignment,
        }
    }
}

/// Derivatives of the simulation by each free coordinate, at the rows that count.
#[derive(Debug)]
pub struct Slope {
    coordinates: Vec<Coordinate>,
    /// A column for each coordinate.
    pub columns: Vec<Vec<f64>>,
    /// Penalty for each coordinate, in units of 1/sigma² of the coordinate, from what the model file says of the base.
    pub(super) prior: Vec<f64>,
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
    pub(super) fn learn(
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
                Coordinate::CurrentZero => model.nuisance.current_zero_a,
                Coordinate::Before => model.nuisance.before_a,
                Coordinate::OcvBend(bend) => bend_at(bench, *bend, &model.nuisance),
                _ => *at,
            };
        }
    }

    /// Coordinates of a model's values that stand at a limit beyond which nothing means anything (a knee at full charge) and would
    /// go there.
    pub(super) fn at_ends(&self, model: &Model, outward: &DVector<f64>) -> Vec<usize> {
        let at_end = |k: &usize| match self.coordinates[*k] {
            Coordinate::Value(m, p, _) => {
                let member = &model.members[m];
                let (low, high) = member.effect.card().parameters[p].limits;
                let value = member.values[p];
                (value <= low && outward[*k] < 0.0) || (value >= high && outward[*k] > 0.0)
            }
            _ => false,
        };
        (0..self.len()).filter(at_end).collect()
    }

    /// Coordinates of the starts, each with the index of its start (none: what flowed before the recording), that are not told: how an
    /// operation began is no physics that another one could tell.
    pub(super) fn starts(&self, untold: impl Fn(Option<usize>, usize) -> bool) -> Vec<usize> {
        let is_untold = |k: &usize| match self.coordinates[*k] {
            Coordinate::SocShift(start) => untold(Some(start), *k),
            Coordinate::Before => untold(None, *k),
            _ => false,
        };
        (0..self.len()).filter(is_untold).collect()
    }

    /// Penalty of the base's nuisances at this model, and what it adds to the normal equations.
    pub(super) fn penalty(&self, normal: &mut DMatrix<f64>, right: &mut DVector<f64>) {
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

/// Standard uncertainty of the recorded current's zero, in A, if the model leaves it open.
pub(super) fn current_zero_sigma_a(bench: &Workbench<'_>, model: &Model) -> Option<f64> {
    match &bench.problem.base {
        Base::Battery(base) => Some(base.current_zero_sigma_a)
            .filter(|sigma_a| *sigma_a > 0.0 && !model.says(Says::CurrentZero)),
        Base::Sensor(_) => None,
    }
}

/// Standard uncertainty of the current that flowed before the recording, in A, if it is open.
pub(super) fn before_sigma_a(bench: &Workbench<'_>) -> Option<f64> {
    match &bench.problem.base {
        Base::Battery(base) => Some(base.before_sigma_a).filter(|sigma_a| *sigma_a > 0.0),
        Base::Sensor(_) => None,
    }
}

/// A value that is 0 by design within what its standard uncertainty allows.
pub(super) fn within(value: f64, sigma: f64) -> f64 {
    value.clamp(-BASE_OFF * sigma, BASE_OFF * sigma)
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
        Coordinate::CurrentZero => {
            let sigma_a = current_zero_sigma_a(bench, model).unwrap_or_default();
            let zero_a = model.nuisance.current_zero_a + delta;
            model.nuisance.current_zero_a = within(zero_a, sigma_a);
        }
        Coordinate::Before => {
            let sigma_a = before_sigma_a(bench).unwrap_or_default();
            model.nuisance.before_a = within(model.nuisance.before_a + delta, sigma_a);
        }
        Coordinate::OcvBend(bend) => {
            let (line, sigma_v) = bench.bends[bend];
            let heights_v = &mut model.nuisance.ocv_bend_v;
            if heights_v.len() <= line {
                heights_v.resize(line + 1, 0.0);
            }
            let most_v = BASE_OFF * sigma_v;
            heights_v[line] = (heights_v[line] + delta).clamp(-most_v, most_v);
        }
        Coordinate::Alignment => {
            // A sensor's sample stands for the middle of two at most; a tester's scan of its channels ends with the row.
            let share = match bench.problem.base {
                Base::Sensor(_) => 0.6,
                Base::Battery(_) => 1.0,
            };
            let most = share * bench.scale.step_s.max(bench.scale.reading_step_s);
            model.nuisance.alignment_s = (model.nuisance.alignment_s + delta).clamp(-most, most);
        }
    }
}

/// What a line of the table is bent by in a model, in V.
fn bend_at(bench: &Workbench<'_>, bend: usize, nuisance: &Nuisance) -> f64 {
    let (line, _) = bench.bends[bend];
    nuisance.ocv_bend_v.get(line).copied().unwrap_or_default()
}

/// Free coordinates of a model with the size of a small step, the penalty and where it is.
pub(super) fn coordinates(
    bench: &Workbench<'_>,
    model: &Model,
) -> Vec<(Coordinate, f64, f64, f64)> {
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
        if base.resistance_sigma > 0.0 && is_voltage && !model.says(Says::Resistance) {
            all.push((
                Coordinate::Resistance,
                1e-4,
                inverse(base.resistance_sigma),
                model.nuisance.resistance,
            ));
        }
        if let Some(sigma_a) = current_zero_sigma_a(bench, model) {
            all.push((
                Coordinate::CurrentZero,
                SMALL_CURRENT * sigma_a,
                inverse(sigma_a),
                model.nuisance.current_zero_a,
            ));
        }
        if let Some(sigma_a) = before_sigma_a(bench) {
            all.push((
                Coordinate::Before,
                SMALL_CURRENT * sigma_a,
                inverse(sigma_a),
                model.nuisance.before_a,
            ));
        }
        for (index, (_, sigma_v)) in bench.bends.iter().enumerate() {
            all.push((
                Coordinate::OcvBend(index),
                SMALL_BEND * sigma_v,
                inverse(*sigma_v),
                bend_at(bench, index, &model.nuisance),
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

/// The model with nothing rounded, and what it says, if it rounds: a small step of a value ahead of a grid moves hardly any
/// reading, and those by a whole step of the grid.
pub(super) fn unrounded(bench: &Workbench<'_>, model: &Model) -> Option<(Model, Vec<f64>)> {
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

/// Coordinates that are moved in one run: each by itself but for the starts, of which no operation knows another's. What flowed over a gap
/// is known to all that follows.
fn runs<'k>(
    bench: &Workbench<'_>,
    coordinates: &[(Coordinate, f64, f64, f64)],
    some: &'k [usize],
) -> impl Iterator<Item = &'k [usize]> {
    let is_start = |k: &usize| match coordinates[*k].0 {
        Coordinate::SocShift(start) => !bench.starts[start].is_after_gap(),
        _ => false,
    };
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
pub(super) fn slope(bench: &Workbench<'_>, model: &Model, predicted: &[f64]) -> Slope {
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
        let moved: Vec<(Change, Model)> = runs(bench, &coordinates, &missing)
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
        let parts = runs(bench, &coordinates, &missing)
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
