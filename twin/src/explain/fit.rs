//! Robust least squares for the values of a model: Levenberg–Marquardt on Huber's loss, bounds kept, steps searched.

use std::cmp::Ordering;
use std::collections::HashSet;
use std::sync::{Arc, OnceLock};

use super::normal::{dot, forget, normal, solve, sum_of};
use super::robust::{huber, loss, weight};
use super::slope::{Slope, change, coordinates, rounds, slope, unrounded};
use super::starts;
use super::workbench::{Model, Workbench};
use crate::effects::chain::Begun;
use crate::effects::{Says, Search};
use crate::problem::Base;

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
/// Another minimum is taken if its loss is below this share.
const LOWER: f64 = 0.999;
/// Where between two readings another minimum is looked for, as shares of the time between them.
const BETWEEN: [f64; 3] = [-0.5, 0.0, 0.5];
/// The same if a row of the reference is this share of that time at most.
const FEW: f64 = 0.5;
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
    evened: Arc<OnceLock<f64>>,
}

impl Fit {
    /// A model as it is, with the simulation of it.
    pub fn of(bench: &Workbench<'_>, model: Model, cost: f64) -> Self {
        let predicted = bench.run(&model);
        let residual = bench.residual(&predicted);
        Self {
            sigma: bench.spread(&residual),
            model,
            predicted,
            residual,
            cost,
            slope: Arc::default(),
            evened: Arc::default(),
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

    /// [`Workbench::evened_out`] by its model: found once.
    pub fn evened(&self, bench: &Workbench<'_>) -> f64 {
        let find = || bench.evened_out(&self.model, &self.predicted);
        *self.evened.get_or_init(find)
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

/// Fits every free value from where the model stands. `used` weighs rows (0: left out); sigma is found on the way.
pub fn fit(bench: &Workbench<'_>, model: &Model, used: Option<&[f64]>) -> Fit {
    // The same question is asked again and again, and fits have one answer.
    if used.is_none()
        && let Some((mut found, sigma, cost)) = bench.known(model)
    {
        // It says nothing of the recording that it was found in, and is not known by it.
        found.nuisance.resistances_at_c = model.nuisance.resistances_at_c;
        return Fit {
            sigma,
            ..Fit::of(bench, found, cost)
        };
    }
    let from = model;
    let mut model = model.clone();
    if !bench.aligns(&model) {
        model.nuisance.alignment_s = 0.0;
    }
    if model.says(Says::Resistance) {
        model.nuisance.resistance = 0.0;
    }
    if model.says(Says::CurrentZero) {
        model.nuisance.current_zero_a = 0.0;
    }
    let predicted = bench.run(&model);
    let mut here = Point::of(bench, model, predicted);
    let mut sigma = bench.spread(&here.residual);
    let mut known = None;
    // The spread falls while the model becomes better: the loss follows in rounds.
    for round in 0..3 {
        let before = sigma;
        let aim = Aim { bench, sigma, used };
        known = descend(aim, &mut here, known);
        if search_steps(aim, &mut here, round > 0) {
            known = descend(aim, &mut here, None);
        }
        sigma = bench.spread(&here.residual);
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
        evened: Arc::default(),
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
    other_moment(bench, other_minimum(bench, best))
}

/// The same, or a better one at other values of its times: a load with a rhythm of its own makes a minimum at each window of so many
/// of its periods.
pub fn other_minimum(bench: &Workbench<'_>, from: Fit) -> Fit {
    let mut best = from;
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
                best = lower(best, fit(bench, &moved, None));
            }
        }
    }
    best
}

/// The same, or a better one where readings stand for other moments: where the reference has rows between two readings it may turn
/// there, and each turn may make a minimum.
fn other_moment(bench: &Workbench<'_>, from: Fit) -> Fit {
    let (row_s, reading_s) = (bench.scale.step_s, bench.scale.reading_step_s);
    let of_sensor = matches!(bench.problem.base, Base::Sensor(_));
    if !of_sensor || !bench.aligns(&from.model) || row_s > FEW * reading_s {
        return from;
    }
    let mut best = from;
    for share in BETWEEN {
        let alignment_s = share * reading_s;
        if (alignment_s - best.model.nuisance.alignment_s).abs() > row_s {
            let mut moved = best.model.clone();
            moved.nuisance.alignment_s = alignment_s;
            let there = other_minimum(bench, fit(bench, &moved, None));
            best = lower(best, there);
        }
    }
    best
}

/// The second of two fits, if its loss is lower.
fn lower(best: Fit, there: Fit) -> Fit {
    let sigma = there.sigma.min(best.sigma);
    if loss(&there.residual, sigma) < LOWER * loss(&best.residual, sigma) {
        there
    } else {
        best
    }
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
            let untold = slope.starts(|start, k| match start {
                Some(start) => !bench.starts[start].told_by(used),
                None => !starts::told(&slope.columns[k], used),
            });
            forget(&untold, &mut matrix);
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

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::effects::find;
    use crate::explain::workbench::Member;
    use crate::problem::Problem;
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::SeedableRng as _;
    use rand_distr::{Distribution as _, StandardNormal};

    const ROW_S: f64 = 0.005;
    /// Rows from one reading to the next.
    const READ: usize = 20;
    const ROWS: usize = 2400;
    const NOISE_W: f64 = 0.3;

    /// A load that is on for half of each tenth of a second, in groups with a rest between them.
    fn power_w(row: usize) -> f64 {
        let turn = (row / 400) as f64;
        let since_s = (row % 400) as f64 * ROW_S;
        let group_s = 0.1 * (9.0 + 4.0 * (2.3 * turn).sin());
        let in_group = (0.35..0.35 + group_s).contains(&since_s);
        let more_w = if in_group && row % READ < READ / 2 {
            200.0 + 60.0 * (1.7 * turn).cos()
        } else {
            0.0
        };
        100.0 + more_w
    }

    /// What a sensor reads of it ten times a second that shows the mean over a window.
    fn problem(window_s: f64) -> Problem {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let t_s: Vec<f64> = (0..ROWS).map(|row| row as f64 * ROW_S).collect();
        let power = (0..ROWS).map(power_w).collect();
        let mut problem = Problem::pair(t_s, power, vec![0.0; ROWS], 0.0);
        let shown = crate::explain::predict(&problem, &[("moving-average".into(), vec![window_s])]);
        problem.observed.value = shown
            .iter()
            .map(|w| {
                let noise: f64 = StandardNormal.sample(&mut random);
                w + NOISE_W * noise
            })
            .collect();
        problem.observed.valid = (0..ROWS).map(|row| row % READ == READ / 4).collect();
        problem
    }

    #[test]
    fn a_rhythm_in_the_load_hides_a_window_behind_no_other_moment() {
        const WINDOW_S: f64 = 0.8;
        let problem = problem(WINDOW_S);
        let bench = Workbench::new(&problem, &[]);
        let window = |fit: &Fit| fit.model.members[0].values[0];
        let mut elsewhere = 0;
        for (share, alignment_s) in [(1.1, 0.05), (1.1, -0.05), (0.9, 0.05), (0.9, -0.05)] {
            let mut model = Model::default().with(Member {
                effect: find("moving-average").unwrap(),
                values: vec![share * WINDOW_S],
            });
            model.nuisance.alignment_s = alignment_s;
            let near = other_minimum(&bench, fit(&bench, &model, None));
            elsewhere += usize::from((window(&near) - WINDOW_S).abs() > 0.02);
            let found = polish(&bench, &near);
            assert!(
                (window(&found) - WINDOW_S).abs() < 0.005,
                "{share} {alignment_s}: {} {}, before {} {}",
                window(&found),
                found.model.nuisance.alignment_s,
                window(&near),
                near.model.nuisance.alignment_s
            );
        }
        // Or the drive tests nothing.
        assert!(elsewhere >= 2, "{elsewhere}");
    }
}
