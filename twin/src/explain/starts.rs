//! What is each recording's own: at which state of charge each operation begins, and the zero of the current. It is fitted beside every
//! model, and in every file.

use std::ops::Range;

use super::normal::dot;
use super::robust::{huber, spread, weights};
use super::slope::{BASE_OFF, current_zero_sigma_a, current_zero_within_a};
use super::workbench::{Model, Workbench};
use crate::effects::chain::Nuisance;
use crate::problem::{Base, Problem};

/// Starts that are free at most: each is a column as long as the recording. Of more operations those with fewer readings share the
/// last one.
const MOST: usize = 24;
/// An operation of which a smaller share of its readings is at hand is not asked where it began.
const HALF: f64 = 0.5;
/// Steps in which the starts of a file are found that is not fitted otherwise: the open-circuit voltage bends.
const STEPS: usize = 4;
/// The same of the zero of its current.
const ZERO_STEPS: usize = 3;
/// A step is the last one if the loss falls by less than this share.
const GAINED: f64 = 1e-4;
/// A small step of a state of charge.
pub(super) const SMALL: f64 = 1e-5;

/// A state of charge at the start that is free.
#[derive(Clone, Debug)]
pub struct Start {
    /// The operations that begin so.
    operations: Vec<usize>,
    /// Standard uncertainty, 0 … 1.
    pub sigma: f64,
    /// Their readings among the rows that count.
    rows: Vec<Range<usize>>,
}

impl Start {
    /// Those of a problem, of which some rows count.
    pub(super) fn all(problem: &Problem, counted: &[usize]) -> Vec<Self> {
        let Base::Battery(base) = &problem.base else {
            return Vec::new();
        };
        let numbers = problem.drive.operation_numbers();
        let of_row = |row: &usize| numbers.get(problem.observed.segment_of(*row)).copied();
        let mut starts: Vec<Self> = Vec::new();
        let mut from = 0;
        for rows in counted.chunk_by(|a, b| of_row(a) == of_row(b)) {
            let here = from..from + rows.len();
            from = here.end;
            let Some(operation) = of_row(&rows[0]) else {
                continue;
            };
            let known = starts
                .iter_mut()
                .find(|start| start.operations == [operation]);
            match (known, base.initial_soc_sigma.get(operation)) {
                (Some(known), _) => known.rows.push(here),
                (None, Some(sigma)) if *sigma > 0.0 => starts.push(Self {
                    operations: vec![operation],
                    sigma: *sigma,
                    rows: vec![here],
                }),
                _ => (),
            }
        }
        if starts.len() > MOST {
            starts.sort_by_key(|start| std::cmp::Reverse(start.count()));
            let others = starts.split_off(MOST - 1);
            starts.push(Self {
                sigma: others.iter().fold(0.0, |most, start| start.sigma.max(most)),
                operations: others
                    .iter()
                    .flat_map(|start| start.operations.clone())
                    .collect(),
                rows: others.into_iter().flat_map(|start| start.rows).collect(),
            });
        }
        starts
    }

    fn count(&self) -> usize {
        self.rows.iter().map(Range::len).sum()
    }

    /// The shift that a model has.
    pub fn at(&self, nuisance: &Nuisance) -> f64 {
        let shift = self
            .operations
            .first()
            .and_then(|&one| nuisance.soc_shift.get(one));
        shift.copied().unwrap_or_default()
    }

    /// Moves it, by no more than its uncertainty allows.
    pub(super) fn shift(&self, nuisance: &mut Nuisance, delta: f64) {
        let most = (BASE_OFF * self.sigma).min(1.0);
        let shifted = (self.at(nuisance) + delta).clamp(-most, most);
        for &operation in &self.operations {
            if nuisance.soc_shift.len() <= operation {
                nuisance.soc_shift.resize(operation + 1, 0.0);
            }
            nuisance.soc_shift[operation] = shifted;
        }
    }

    /// Of a simulation in which all starts were moved, what this one's being moved changes of another simulation.
    pub(super) fn own(&self, moved: &[f64], still: &[f64]) -> Vec<f64> {
        let mut own = still.to_vec();
        for rows in &self.rows {
            own[rows.clone()].copy_from_slice(&moved[rows.clone()]);
        }
        own
    }

    /// Whether what is in use of the readings tells of it.
    pub(super) fn told_by(&self, used: &[f64]) -> bool {
        let used: f64 = self
            .rows
            .iter()
            .map(|rows| used[rows.clone()].iter().sum::<f64>())
            .sum();
        used >= HALF * self.count() as f64
    }

    fn sum(&self, of: impl Fn(Range<usize>) -> f64) -> f64 {
        self.rows.iter().cloned().map(of).sum()
    }
}

/// Whether a block has so much of what a recording tells of a start that the rest says nothing of it.
pub(super) fn within_block(block: f64, all: f64) -> bool {
    block > (1.0 - HALF) * all
}

/// A model as it is taken to a recording that it was not fitted to: where each operation starts, and the zero of the recorded current, are
/// that recording's own, those that fit it best, each within its uncertainty; everything else is as it is. And what it leaves.
pub(super) fn begun(bench: &Workbench<'_>, model: Model) -> (Model, Vec<f64>) {
    let with_zero = |model: &Model, zero_a: f64| {
        let mut model = model.clone();
        model.nuisance.current_zero_a = zero_a;
        with_starts(bench, model)
    };
    let mut here = with_zero(&model, 0.0);
    let Some(sigma_a) = current_zero_sigma_a(bench, &model) else {
        return here;
    };
    for _ in 0..ZERO_STEPS {
        let zero_a = here.0.nuisance.current_zero_a;
        // The starts follow: what the zero changes beside them.
        let by = if zero_a > 0.0 { -sigma_a } else { sigma_a };
        let moved = with_zero(&here.0, zero_a + by);
        let sigma = spread(&here.1);
        let weight = weights(&here.1, sigma);
        let change = super::slope::change(&here.1, &moved.1);
        let weighted: Vec<f64> = change
            .iter()
            .zip(&weight)
            .map(|(c, w)| c / by * w)
            .collect();
        let prior = sigma_a.powi(-2);
        let step =
            (dot(&weighted, &here.1) - prior * zero_a) / (dot(&weighted, &change) / by + prior);
        let tried = with_zero(&here.0, current_zero_within_a(zero_a + step, sigma_a));
        let cost = |(model, residual): &(Model, Vec<f64>)| {
            let starts = bench.starts.iter();
            let off = starts.map(|start| start.at(&model.nuisance) / start.sigma);
            let off = off.chain([model.nuisance.current_zero_a / sigma_a]);
            residual.iter().map(|r| huber(r / sigma)).sum::<f64>()
                + 0.5 * off.map(|off| off * off).sum::<f64>()
        };
        let (from, to) = (cost(&here), cost(&tried));
        if to < from {
            here = tried;
        }
        if from - to <= GAINED * from {
            break;
        }
    }
    here
}

/// A model with the starts that fit a bench best, everything else as it is; and what it leaves.
fn with_starts(bench: &Workbench<'_>, model: Model) -> (Model, Vec<f64>) {
    let starts = &bench.starts;
    let mut here = Model {
        nuisance: Nuisance {
            soc_shift: Vec::new(),
            ..model.nuisance
        },
        ..model
    };
    let mut predicted = bench.run(&here);
    let mut residual = bench.residual(&predicted);
    for _ in 0..STEPS {
        if starts.is_empty() {
            break;
        }
        let sigma = spread(&residual);
        let weight = weights(&residual, sigma);
        let cost = |start: &Start, residual: &[f64], nuisance: &Nuisance| {
            start.sum(|rows| residual[rows].iter().map(|r| huber(r / sigma)).sum())
                + 0.5 * (start.at(nuisance) / start.sigma).powi(2)
        };
        let mut moved = here.clone();
        for start in starts {
            // At the end of what is allowed it goes the other way.
            let by = if start.at(&here.nuisance) > 0.0 {
                -SMALL
            } else {
                SMALL
            };
            start.shift(&mut moved.nuisance, by);
        }
        let change = super::slope::change(&bench.run(&moved), &predicted);
        let mut there = here.clone();
        for start in starts {
            let by = start.at(&moved.nuisance) - start.at(&here.nuisance);
            let (mut right, mut matrix) = (0.0, 0.0);
            for rows in start.rows.clone() {
                let weighted: Vec<f64> = change[rows.clone()]
                    .iter()
                    .zip(&weight[rows.clone()])
                    .map(|(change, weight)| change / by * weight)
                    .collect();
                right += dot(&weighted, &residual[rows.clone()]);
                matrix += dot(&weighted, &change[rows]) / by;
            }
            let prior = start.sigma.powi(-2);
            let step = (right - prior * start.at(&here.nuisance)) / (matrix + prior);
            start.shift(&mut there.nuisance, step);
        }
        let tried = bench.residual(&bench.run(&there));
        let mut gained = false;
        for start in starts {
            let (from, to) = (
                cost(start, &residual, &here.nuisance),
                cost(start, &tried, &there.nuisance),
            );
            if to < from {
                gained |= from - to > GAINED * from;
                let by = start.at(&there.nuisance) - start.at(&here.nuisance);
                start.shift(&mut here.nuisance, by);
            }
        }
        predicted = bench.run(&here);
        residual = bench.residual(&predicted);
        if !gained {
            break;
        }
    }
    (here, residual)
}
