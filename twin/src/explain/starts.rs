//! What is each recording's own: at which state of charge each operation begins, what flowed over its gaps and before it, and the zero of the current.
//! It is fitted beside every model, and in every file.

use std::ops::Range;

use nalgebra::{DMatrix, DVector};

use super::normal::{dot, solve};
use super::robust::{huber, spread, weights};
use super::slope::{BASE_OFF, before_sigma_a, current_zero_sigma_a, within};
use super::workbench::{Model, Workbench};
use crate::effects::chain::Nuisance;
use crate::problem::{Base, BatteryBase, Problem};

/// Starts that are free at most: each is a column as long as the recording. Of more operations those with fewer readings share the
/// last one.
const MOST: usize = 24;
/// Gaps over which the charge is free at most, of more of them those of which least is known: each is a column too.
const MOST_GAPS: usize = 24;
/// An operation of which a smaller share of its readings is at hand is not asked where it began.
const HALF: f64 = 0.5;
/// Steps in which the starts of a file are found that is not fitted otherwise: the open-circuit voltage bends.
const STEPS: usize = 4;
/// The same of what flowed before, and of the zero of its current.
const OWN_STEPS: usize = 3;
/// A step is the last one if the loss falls by less than this share.
const GAINED: f64 = 1e-4;
/// A small step of a state of charge.
pub(super) const SMALL: f64 = 1e-5;

/// What begins at a state of charge that is free.
#[derive(Clone, Debug, PartialEq)]
enum Begins {
    /// Operations.
    Operations(Vec<usize>),
    /// What follows a gap: the operation, and the segment after it.
    AfterGap(usize, usize),
}

/// A state of charge that is free from where something begins on.
#[derive(Clone, Debug)]
pub struct Start {
    begins: Begins,
    /// Standard uncertainty, 0 … 1.
    pub sigma: f64,
    /// The readings that it shifts, among the rows that count: to the end of the operation.
    rows: Vec<Range<usize>>,
    /// Those of them ahead of the next gap, which tell it from that.
    own: Vec<Range<usize>>,
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
        let mut gaps: Vec<Self> = Vec::new();
        let mut from = 0;
        for rows in counted.chunk_by(|a, b| of_row(a) == of_row(b)) {
            let here = from..from + rows.len();
            from = here.end;
            let Some(operation) = of_row(&rows[0]) else {
                continue;
            };
            gaps.extend(Self::after_gaps(problem, base, operation, rows, here.start));
            let begins = Begins::Operations(vec![operation]);
            let known = starts.iter_mut().find(|start| start.begins == begins);
            match (known, base.initial_soc_sigma.get(operation)) {
                (Some(known), _) => known.rows.push(here),
                (None, Some(sigma)) if *sigma > 0.0 => starts.push(Self {
                    begins,
                    sigma: *sigma,
                    rows: vec![here],
                    own: Vec::new(),
                }),
                _ => (),
            }
        }
        if starts.len() > MOST {
            starts.sort_by_key(|start| std::cmp::Reverse(start.count()));
            let others = starts.split_off(MOST - 1);
            starts.push(Self {
                sigma: others.iter().fold(0.0, |most, start| start.sigma.max(most)),
                begins: Begins::Operations(
                    others.iter().flat_map(Self::operations).copied().collect(),
                ),
                rows: others.into_iter().flat_map(|start| start.rows).collect(),
                own: Vec::new(),
            });
        }
        gaps.sort_by(|a, b| b.sigma.total_cmp(&a.sigma));
        gaps.truncate(MOST_GAPS);
        gaps.sort_by_key(Self::first);
        starts.extend(gaps);
        let begun: Vec<usize> = starts.iter().filter_map(Self::gap_row).collect();
        for start in &mut starts {
            let ahead = |rows: &Range<usize>| {
                let next = begun.iter().find(|row| rows.start < **row);
                rows.start..next.map_or(rows.end, |next| rows.end.min(*next))
            };
            start.own = start.rows.iter().map(ahead).collect();
        }
        starts
    }

    /// Those after the gaps of an operation of which not all is known, from its rows, the first of which is at a place among those that
    /// count.
    fn after_gaps(
        problem: &Problem,
        base: &BatteryBase,
        operation: usize,
        rows: &[usize],
        place: usize,
    ) -> Vec<Self> {
        let segment = |row: usize| problem.observed.segment_of(row);
        let (Some(first), Some(last)) = (rows.first(), rows.last()) else {
            return Vec::new();
        };
        // Where nothing is read between two gaps, what they leave open is one.
        let mut open: f64 = 0.0;
        (segment(*first) + 1..=segment(*last))
            .filter_map(|after| {
                open = open.hypot(*base.gap_soc_sigma.get(after)?);
                let from = rows.partition_point(|row| segment(*row) < after);
                let is_read = segment(rows[from]) == after;
                let sigma = if is_read {
                    std::mem::take(&mut open)
                } else {
                    0.0
                };
                (sigma > 0.0).then(|| Self {
                    begins: Begins::AfterGap(operation, after),
                    sigma,
                    rows: std::iter::once(place + from..place + rows.len()).collect(),
                    own: Vec::new(),
                })
            })
            .collect()
    }

    /// The operations that it is of.
    fn operations(&self) -> &[usize] {
        match &self.begins {
            Begins::Operations(operations) => operations,
            Begins::AfterGap(operation, _) => std::slice::from_ref(operation),
        }
    }

    /// Whether it follows a gap.
    pub(super) fn is_after_gap(&self) -> bool {
        matches!(self.begins, Begins::AfterGap(..))
    }

    fn first(&self) -> usize {
        self.rows.first().map_or(0, |rows| rows.start)
    }

    /// Where it begins, if it follows a gap.
    fn gap_row(&self) -> Option<usize> {
        self.is_after_gap().then(|| self.first())
    }

    /// Those of its readings that another gap does not shift too.
    pub(super) fn own_rows(&self) -> &[Range<usize>] {
        &self.own
    }

    /// Whether another gap shifts some of its readings too.
    pub(super) fn is_shared(&self) -> bool {
        self.own != self.rows
    }

    fn count(&self) -> usize {
        self.rows.iter().map(Range::len).sum()
    }

    /// The shift that a model has.
    pub fn at(&self, nuisance: &Nuisance) -> f64 {
        let shift = match &self.begins {
            Begins::Operations(operations) => operations
                .first()
                .and_then(|&one| nuisance.soc_shift.get(one)),
            Begins::AfterGap(_, segment) => nuisance.gap_soc_shift.get(*segment),
        };
        shift.copied().unwrap_or_default()
    }

    /// Moves it, by no more than its uncertainty allows.
    pub(super) fn shift(&self, nuisance: &mut Nuisance, delta: f64) {
        let most = (BASE_OFF * self.sigma).min(1.0);
        let shifted = (self.at(nuisance) + delta).clamp(-most, most);
        match &self.begins {
            Begins::Operations(operations) => {
                for &operation in operations {
                    put(&mut nuisance.soc_shift, operation, shifted);
                }
            }
            Begins::AfterGap(_, segment) => put(&mut nuisance.gap_soc_shift, *segment, shifted),
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
        let count: usize = self.own.iter().map(Range::len).sum();
        let used: f64 = self
            .own
            .iter()
            .map(|rows| used[rows.clone()].iter().sum::<f64>())
            .sum();
        used >= HALF * count as f64
    }

    fn sum(&self, of: impl Fn(Range<usize>) -> f64) -> f64 {
        self.rows.iter().cloned().map(of).sum()
    }
}

fn put(shifts: &mut Vec<f64>, at: usize, shift: f64) {
    if shifts.len() <= at {
        shifts.resize(at + 1, 0.0);
    }
    shifts[at] = shift;
}

/// Starts that tell of one another: those of an operation and of what follows its gaps, the one that shifts all of its rows first.
fn groups(starts: &[Start]) -> Vec<Vec<&Start>> {
    let mut groups: Vec<Vec<&Start>> = Vec::new();
    for start in starts {
        let of_same = |group: &&mut Vec<&Start>| {
            let mut operations = start.operations().iter();
            operations.any(|one| group[0].operations().contains(one))
        };
        match groups.iter_mut().find(of_same) {
            Some(group) => group.push(start),
            None => groups.push(vec![start]),
        }
    }
    groups
}

/// Rows that two series of them share.
fn shared(these: &[Range<usize>], those: &[Range<usize>]) -> Vec<Range<usize>> {
    let pairs = these.iter().flat_map(|a| those.iter().map(move |b| (a, b)));
    pairs
        .map(|(a, b)| a.start.max(b.start)..a.end.min(b.end))
        .filter(|rows| !rows.is_empty())
        .collect()
}

/// Whether a block has so much of what a recording tells of a start that the rest says nothing of it.
pub(super) fn within_block(block: f64, all: f64) -> bool {
    block > (1.0 - HALF) * all
}

/// Whether what is in use of the readings holds most of what all of them tell of a value, by what it changes in each.
pub(super) fn told(column: &[f64], used: &[f64]) -> bool {
    let squares = || column.iter().map(|change| change * change);
    let in_use: f64 = squares()
        .zip(used)
        .map(|(square, used)| square * used)
        .sum();
    in_use >= HALF * squares().sum::<f64>()
}

/// A current that is a recording's own, 0 as far as the model file knows.
#[derive(Clone, Copy)]
enum Own {
    /// [`Nuisance::before_a`].
    Before,
    /// [`Nuisance::current_zero_a`].
    Zero,
}

impl Own {
    /// Its standard uncertainty in A, if it is open.
    fn sigma_a(self, bench: &Workbench<'_>, model: &Model) -> Option<f64> {
        match self {
            Self::Before => before_sigma_a(bench),
            Self::Zero => current_zero_sigma_a(bench, model),
        }
    }

    fn of(self, nuisance: &mut Nuisance) -> &mut f64 {
        match self {
            Self::Before => &mut nuisance.before_a,
            Self::Zero => &mut nuisance.current_zero_a,
        }
    }
}

/// A model as it is taken to a recording that it was not fitted to: where each operation starts, what flowed before, and the zero of the
/// recorded current, are that recording's own, those that fit it best, each within its uncertainty; everything else is as it is. And what
/// it leaves.
pub(super) fn begun(bench: &Workbench<'_>, mut model: Model) -> (Model, Vec<f64>) {
    let own = [Own::Before, Own::Zero];
    for one in own {
        *one.of(&mut model.nuisance) = 0.0;
    }
    let open = own.map(|one| one.sigma_a(bench, &model).map(|sigma_a| (one, sigma_a)));
    let open: Vec<(Own, f64)> = open.into_iter().flatten().collect();
    let mut here = with_starts(bench, model);
    for one in &open {
        here = with_own(bench, here, *one, &open);
    }
    here
}

/// The same with one current that fits best, and the starts with it.
fn with_own(
    bench: &Workbench<'_>,
    mut here: (Model, Vec<f64>),
    (one, sigma_a): (Own, f64),
    open: &[(Own, f64)],
) -> (Model, Vec<f64>) {
    let with = |model: &Model, current_a: f64| {
        let mut model = model.clone();
        *one.of(&mut model.nuisance) = current_a;
        with_starts(bench, model)
    };
    for _ in 0..OWN_STEPS {
        let now_a = *one.of(&mut here.0.nuisance);
        // The starts follow: what the current changes beside them.
        let by = if now_a > 0.0 { -sigma_a } else { sigma_a };
        let moved = with(&here.0, now_a + by);
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
            (dot(&weighted, &here.1) - prior * now_a) / (dot(&weighted, &change) / by + prior);
        let mut tried = with(&here.0, within(now_a + step, sigma_a));
        let cost = |(model, residual): &mut (Model, Vec<f64>)| {
            let starts = bench.starts.iter();
            let off = starts.map(|start| start.at(&model.nuisance) / start.sigma);
            let mut off: Vec<f64> = off.collect();
            for (one, sigma_a) in open {
                off.push(*one.of(&mut model.nuisance) / sigma_a);
            }
            residual.iter().map(|r| huber(r / sigma)).sum::<f64>()
                + 0.5 * off.iter().map(|off| off * off).sum::<f64>()
        };
        let (from, to) = (cost(&mut here), cost(&mut tried));
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
    let groups = groups(&bench.starts);
    let mut here = Model {
        nuisance: Nuisance {
            soc_shift: Vec::new(),
            gap_soc_shift: Vec::new(),
            ..model.nuisance
        },
        ..model
    };
    let mut predicted = bench.run(&here);
    let mut residual = bench.residual(&predicted);
    for _ in 0..STEPS {
        if groups.is_empty() {
            break;
        }
        let sigma = spread(&residual);
        let weight = weights(&residual, sigma);
        let cost = |group: &[&Start], residual: &[f64], nuisance: &Nuisance| {
            let loss = |rows: Range<usize>| residual[rows].iter().map(|r| huber(r / sigma)).sum();
            let off = group
                .iter()
                .map(|start| 0.5 * (start.at(nuisance) / start.sigma).powi(2));
            group[0].sum(loss) + off.sum::<f64>()
        };
        let mut moved = here.clone();
        for group in &groups {
            let start = group[0];
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
        for group in &groups {
            let by = group[0].at(&moved.nuisance) - group[0].at(&here.nuisance);
            // Moved was the whole of the group's rows: each of its starts does that to its own.
            let weighted = |rows: Range<usize>| -> Vec<f64> {
                let pairs = change[rows.clone()].iter().zip(&weight[rows]);
                pairs.map(|(change, weight)| change / by * weight).collect()
            };
            let size = group.len();
            let (mut right, mut matrix) = (DVector::zeros(size), DMatrix::zeros(size, size));
            for (k, start) in group.iter().enumerate() {
                for rows in start.rows.iter().cloned() {
                    right[k] += dot(&weighted(rows.clone()), &residual[rows]);
                }
                for (l, other) in group.iter().enumerate() {
                    for rows in shared(&start.rows, &other.rows) {
                        matrix[(k, l)] += dot(&weighted(rows.clone()), &change[rows]) / by;
                    }
                }
                let prior = start.sigma.powi(-2);
                right[k] -= prior * start.at(&here.nuisance);
                matrix[(k, k)] += prior;
            }
            let step = if size == 1 {
                right / matrix[(0, 0)]
            } else {
                solve(&matrix, &right, 1e-9)
            };
            for (start, step) in group.iter().zip(step.iter()) {
                start.shift(&mut there.nuisance, *step);
            }
        }
        let tried = bench.residual(&bench.run(&there));
        let mut gained = false;
        for group in &groups {
            let (from, to) = (
                cost(group, &residual, &here.nuisance),
                cost(group, &tried, &there.nuisance),
            );
            if to < from {
                gained |= from - to > GAINED * from;
                for start in group {
                    let by = start.at(&there.nuisance) - start.at(&here.nuisance);
                    start.shift(&mut here.nuisance, by);
                }
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
