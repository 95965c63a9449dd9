//! Which effects could account for a residual: each candidate's signature against it, held out block by block, beside
//! placebos that cannot be physics.
//!
//! A signature is the change that a candidate makes to the simulation; what the model's own values could do is taken out of it.
//! Its held-out gain is the squared error that it removes from each block with factors from the other blocks. A placebo is the
//! same signature against the residual moved in time (and half of them reversed): whatever it gains is chance and colour of the
//! noise. Each draw keeps the best of all candidates, so that trying many effects is paid for.

use std::sync::Arc;

use nalgebra::{DMatrix, DMatrixView, DVector, Dyn};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng as _, SeedableRng as _};
use rayon::prelude::*;
use rustfft::{Fft, FftPlanner, num_complex::Complex};

use super::fit::Fit;
use super::normal::{Solver, dot, normal};
use super::robust::{TUNING, huber};
use super::workbench::{Member, Model, Workbench};
use crate::effects::scene::Scale;
use crate::effects::{Effect, Search};

/// Placebo draws.
pub const DRAWS: usize = 200;
/// Rows that signatures are compared over; longer recordings are thinned out.
const MOST_ROWS: usize = 30_000;
/// Starts of an effect that are compared with placebos, by each of two measures.
const MOST_STARTS: usize = 8;
/// Two effects hide each other if either alone takes less than this share of what both do.
const HIDDEN: f64 = 0.5;
/// A residual moved to where a candidate looks like itself again is no placebo for it: signs are drawn then.
pub const ITSELF: f64 = 0.6;

/// A candidate with the values from which its signature was taken.
#[derive(Clone, Debug)]
pub struct Entry {
    /// The candidate.
    pub member: Member,
    /// Squared error that it removes from held-out blocks, as a share of all of it.
    pub gain: f64,
    /// Share that it removes from all of the error with its outliers, nothing held out: what acts in few readings, all in one block,
    /// shows there and nowhere else.
    pub raw_gain: f64,
    /// Loss of the simulation with these very values.
    pub loss: f64,
    columns: Vec<Vec<f64>>,
    folds: Folds,
    /// Products of the columns with the residual, block by block.
    rights: Vec<f64>,
}

impl Entry {
    /// Whether all of its values are searched in steps.
    pub fn fixed(&self) -> bool {
        stepped(self.member.effect)
    }

    /// The same start with the sizes that the signature has, where there is more to search than sizes: a size that is far off is
    /// made up for by the rest, which runs away from its start.
    pub fn sized(&self, scale: &Scale) -> Option<Member> {
        let effect = self.member.effect;
        let parameters = effect.card().parameters;
        let sizes = linear(effect);
        if sizes.len() != self.columns.len() || sizes.len() == parameters.len() {
            return None;
        }
        let mut member = self.member.clone();
        for (&p, factor) in sizes.iter().zip(&self.folds.factors(&self.rights)) {
            let (low, high) = effect.bounds(p, scale);
            let off = parameters[p].off;
            let size = (off + factor * (member.values[p] - off)).clamp(low, high);
            if size == off || !size.is_finite() {
                return None;
            }
            member.values[p] = size;
        }
        Some(member)
    }
}

fn stepped(effect: &dyn Effect) -> bool {
    effect
        .card()
        .parameters
        .iter()
        .all(|parameter| parameter.search == Search::Stepped)
}

/// What screening a residual gives.
#[derive(Debug)]
pub struct Screening {
    /// Candidates, best first; several entries of one effect may follow each other.
    pub entries: Vec<Arc<Entry>>,
    /// 99th percentile of the placebos' best gains.
    pub placebo_p99: f64,
    screened: Arc<Screened>,
}

/// What screening a residual gives whatever the placebos are: the same fits are screened again and again.
pub(super) struct Screened {
    entries: Vec<Arc<Entry>>,
    /// Starts of every candidate.
    starts: Vec<(&'static dyn Effect, Vec<Vec<f64>>)>,
    /// What they are compared with, over the rows of a thinned bench, and its blocks in them.
    residual: Vec<f64>,
    blocks: Vec<std::ops::Range<usize>>,
    /// Squared error of it.
    energy: f64,
}

impl std::fmt::Debug for Screened {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Screened")
            .field("entries", &self.entries)
            .finish_non_exhaustive()
    }
}

impl Screened {
    /// Values that it takes memory for, nearly.
    pub(super) fn size(&self) -> usize {
        let columns = self.entries.iter().map(|entry| entry.columns.len());
        (columns.sum::<usize>() + 1) * self.residual.len()
    }
}

impl Screening {
    /// Where a candidate was begun from.
    pub fn starts(&self, effect: &dyn Effect) -> Option<&[Vec<f64>]> {
        let same = |other: &&'static dyn Effect| std::ptr::eq(other.card(), effect.card());
        let mut starts = self.screened.starts.iter();
        starts
            .find(|(other, _)| same(other))
            .map(|(_, starts)| starts.as_slice())
    }

    /// Of some entries those pairs that hide each other, at most so many, the best first: together they take at least a share of all of
    /// the error, and each alone less than half of what both do.
    pub fn hidden<'e>(
        &self,
        entries: &[&'e Entry],
        least: f64,
        most: usize,
    ) -> Vec<[&'e Entry; 2]> {
        let folds = entries.iter().map(|entry| {
            let (gram, sums) = (entry.folds.gram(), entry.folds.all(&entry.rights));
            (gram, sums, entry.folds.taken(&entry.rights))
        });
        let own: Vec<(DMatrix<f64>, DVector<f64>, f64)> = folds.collect();
        let other = |a: usize, b: usize| {
            let [a, b] = [a, b].map(|k| entries[k].member.id());
            a != b
        };
        let mut pairs: Vec<(f64, [usize; 2])> = (0..entries.len())
            .into_par_iter()
            .flat_map_iter(|b| (0..b).filter(move |a| other(*a, b)).map(move |a| [a, b]))
            .filter_map(|[a, b]| {
                let columns = [a, b].map(|k| &entries[k].columns[..]);
                let [(gram_a, sums_a, alone_a), (gram_b, sums_b, alone_b)] = [&own[a], &own[b]];
                let both = taken_together(columns, [gram_a, gram_b], [sums_a, sums_b]);
                let hides = alone_a.max(*alone_b) < HIDDEN * both;
                (hides && both >= least * self.screened.energy).then_some((both, [a, b]))
            })
            .collect();
        pairs.sort_by(|one, other| other.0.total_cmp(&one.0));
        let mut forms = Vec::new();
        let mut found = Vec::new();
        for (_, pair) in pairs {
            let pair = pair.map(|k| entries[k]);
            let these = pair.map(|entry| entry.member.form());
            if !forms.contains(&these) && found.len() < most {
                forms.push(these);
                found.push(pair);
            }
        }
        found
    }
}

/// What the columns of two entries take together, nothing held out; with the products of each one's columns with each other, and with
/// the residual.
fn taken_together(
    [one, other]: [&[Vec<f64>]; 2],
    [gram_one, gram_other]: [&DMatrix<f64>; 2],
    [sums_one, sums_other]: [&DVector<f64>; 2],
) -> f64 {
    let (first, size) = (one.len(), one.len() + other.len());
    let gram = DMatrix::from_fn(size, size, |a, b| match (a < first, b < first) {
        (true, true) => gram_one[(a, b)],
        (false, false) => gram_other[(a - first, b - first)],
        // The half above is not read.
        (true, false) => 0.0,
        (false, true) => dot(&other[a - first], &one[b]),
    });
    let sums = DVector::from_iterator(size, sums_one.iter().chain(sums_other).copied());
    let mut factors = sums.clone();
    Solver::new(&gram, 1e-9).solve(&mut factors);
    factors.dot(&sums)
}

/// Rows of a thinned bench, and its blocks in them.
struct Thin {
    rows: Vec<usize>,
    blocks: Vec<std::ops::Range<usize>>,
}

fn thin(bench: &Workbench<'_>) -> Thin {
    let stride = bench.len().div_ceil(MOST_ROWS).max(1);
    let mut rows = Vec::with_capacity(bench.len() / stride + bench.blocks.len());
    let mut blocks = Vec::with_capacity(bench.blocks.len());
    for block in &bench.blocks {
        let start = rows.len();
        rows.extend(block.clone().step_by(stride));
        blocks.push(start..rows.len());
    }
    Thin { rows, blocks }
}

/// Entries of every candidate that the model does not have, and placebos.
pub fn screen(bench: &Workbench<'_>, fit: &Fit, seed: u64, draws: usize) -> Screening {
    let screened = bench.screened(&fit.model, || screened(bench, fit));
    let timeless = bench.problem.quasi_static();
    let Screened {
        entries,
        residual,
        blocks,
        ..
    } = &*screened;
    Screening {
        placebo_p99: placebos(entries, residual, blocks, timeless, seed, draws),
        entries: entries.clone(),
        screened,
    }
}

fn screened(bench: &Workbench<'_>, fit: &Fit) -> Screened {
    let thin = thin(bench);
    let sigma = bench.spread(&fit.residual);
    let take = |series: &[f64]| {
        thin.rows
            .iter()
            .map(|&row| series[row])
            .collect::<Vec<f64>>()
    };
    let limit = TUNING * sigma;
    let residual: Vec<f64> = take(&fit.residual)
        .into_iter()
        .map(|r| r.clamp(-limit, limit))
        .collect();
    let whole = take(&fit.residual);
    let own: Vec<Vec<f64>> = fit
        .slope(bench)
        .columns
        .iter()
        .map(|column| take(column))
        .collect();
    let weights = vec![1.0; residual.len()];
    let (own_normal, _) = normal(&own, &weights, &residual, 0..residual.len());
    let own_solver = Solver::new(&own_normal, 1e-9);
    let all = dot(&residual, &residual).max(1e-300);
    let clean = |mut column: Vec<f64>| -> Vec<f64> {
        if !own.is_empty() {
            let mut factors = DVector::from_fn(own.len(), |k, _| dot(&own[k], &column));
            own_solver.solve(&mut factors);
            for (own, factor) in own.iter().zip(factors.iter()) {
                column
                    .iter_mut()
                    .zip(own)
                    .for_each(|(value, own)| *value -= factor * own);
            }
        }
        column
    };
    let as_read = bench.as_read(&fit.predicted);
    let starts: Vec<(&'static dyn Effect, Vec<Vec<f64>>)> = bench
        .library
        .par_iter()
        .copied()
        .filter(|effect| may_join(&fit.model, *effect))
        .map(|effect| (effect, effect.starts(&bench.scale, &bench.clues(&as_read))))
        .collect();
    let candidates: Vec<(&'static dyn Effect, Vec<f64>)> = starts
        .iter()
        .flat_map(|(effect, starts)| starts.iter().map(|values| (*effect, values.clone())))
        .collect();
    let mut signatures: Vec<Signature> = candidates
        .into_par_iter()
        .filter_map(|(effect, values)| {
            let base = replaced(&fit.model, effect);
            let mut loss = 0.0;
            let columns: Vec<Vec<f64>> = probes(effect, &values)
                .into_iter()
                .filter_map(|probe| {
                    let there = bench.run(&base.with(Member {
                        effect,
                        values: probe,
                    }));
                    let raw: Vec<f64> = thin
                        .rows
                        .iter()
                        .map(|&row| {
                            let change = there[row] - fit.predicted[row];
                            if change.is_finite() { change } else { 0.0 }
                        })
                        .collect();
                    loss = whole
                        .iter()
                        .zip(&raw)
                        .map(|(residual, change)| huber((residual - change) / sigma))
                        .sum();
                    let before = dot(&raw, &raw);
                    let column = clean(raw);
                    // What the model can do by itself is no signature.
                    (dot(&column, &column) > 1e-8 * before && before > 0.0).then_some(column)
                })
                .collect();
            if columns.is_empty() {
                return None;
            }
            Some(Signature {
                effect,
                values,
                columns,
                loss,
            })
        })
        .collect();
    fewer(&mut signatures, &residual);
    let mut entries: Vec<Arc<Entry>> = signatures
        .into_par_iter()
        .map(|signature| {
            let columns = signature.columns;
            let folds = Folds::new(
                thin.blocks
                    .iter()
                    .map(|rows| normal(&columns, &weights, &residual, rows.clone()).0)
                    .collect(),
            );
            let products = |residual: &[f64]| -> Vec<f64> {
                let blocks = thin.blocks.iter().flat_map(|rows| {
                    let residual = &residual[rows.clone()];
                    columns
                        .iter()
                        .map(|column| dot(&column[rows.clone()], residual))
                });
                blocks.collect()
            };
            let rights = products(&residual);
            let raw_gain = folds.taken(&products(&whole)) / dot(&whole, &whole).max(1e-300);
            Arc::new(Entry {
                member: Member {
                    effect: signature.effect,
                    values: signature.values,
                },
                gain: folds.gain(&rights) / all,
                raw_gain,
                loss: signature.loss,
                columns,
                folds,
                rights,
            })
        })
        .collect();
    entries.sort_by(|a, b| b.gain.total_cmp(&a.gain));
    Screened {
        entries,
        starts,
        residual,
        blocks: thin.blocks,
        energy: all,
    }
}

/// A start with the columns of its change.
struct Signature {
    effect: &'static dyn Effect,
    values: Vec<f64>,
    columns: Vec<Vec<f64>>,
    loss: f64,
}

/// Of effects whose values are all searched in steps, and which have many starts therefore: the nearest as they are, and the
/// nearest by shape.
fn fewer(signatures: &mut Vec<Signature>, residual: &[f64]) {
    let mut kept = Vec::with_capacity(signatures.len());
    let mut left: Vec<Signature> = Vec::new();
    for signature in signatures.drain(..) {
        if stepped(signature.effect) {
            left.push(signature);
        } else {
            kept.push(signature);
        }
    }
    while let Some(id) = left.first().map(|signature| signature.effect.card().id) {
        let (mut these, others): (Vec<Signature>, Vec<Signature>) = left
            .into_iter()
            .partition(|signature| signature.effect.card().id == id);
        left = others;
        let shape = |signature: &Signature| {
            let column = &signature.columns[0];
            dot(column, residual).powi(2) / dot(column, column).max(1e-300)
        };
        these.sort_by(|a, b| a.loss.total_cmp(&b.loss));
        let mut others = these.split_off(MOST_STARTS.min(these.len()));
        others.sort_by_cached_key(|signature| std::cmp::Reverse(shape(signature).to_bits()));
        others.truncate(MOST_STARTS);
        kept.extend(these);
        kept.extend(others);
    }
    *signatures = kept;
}

/// Whether an effect can be added: it is not there yet, or it has more branches than what is there.
fn may_join(model: &Model, effect: &'static dyn Effect) -> bool {
    let card = effect.card();
    let same = model.members.iter().find(|member| member.id() == card.id);
    let branches = card.parameters.len();
    match same {
        None if effect.alternative() => true,
        None => crate::effects::LIBRARY
            .iter()
            .filter(|other| other.card().id == card.id)
            .all(|other| other.card().parameters.len() >= branches),
        // One branch more at a time; another form at once.
        Some(member) => {
            let now = member.values.len();
            branches > now
                && (effect.alternative()
                    || !crate::effects::LIBRARY.iter().any(|other| {
                        let size = other.card().parameters.len();
                        other.card().id == card.id && size > now && size < branches
                    }))
        }
    }
}

/// The model without an effect of the same id.
pub fn replaced(model: &Model, effect: &'static dyn Effect) -> Model {
    let mut model = model.clone();
    model
        .members
        .retain(|member| member.id() != effect.card().id);
    model
}

/// The parameters that are solved for.
fn linear(effect: &dyn Effect) -> Vec<usize> {
    let parameters = effect.card().parameters.iter().enumerate();
    parameters
        .filter(|(_, parameter)| parameter.search == Search::Linear)
        .map(|(index, _)| index)
        .collect()
}

/// Values whose simulations span what the candidate can do: one for each linear parameter, the others off; or the values as
/// they are.
fn probes(effect: &'static dyn Effect, values: &[f64]) -> Vec<Vec<f64>> {
    let parameters = effect.card().parameters;
    let linear = linear(effect);
    if linear.is_empty() {
        return vec![values.to_vec()];
    }
    linear
        .iter()
        .map(|&one| {
            let mut probe = values.to_vec();
            for &other in linear.iter().filter(|&&other| other != one) {
                probe[other] = parameters[other].off;
            }
            probe
        })
        .collect()
}

/// What is needed again and again to score columns on blocks with factors from the other blocks.
#[derive(Clone, Debug)]
pub struct Folds {
    grams: Vec<DMatrix<f64>>,
    /// For each block, the others made ready.
    others: Vec<Solver>,
}

impl Folds {
    /// Of the columns' normal matrix in each block.
    pub fn new(grams: Vec<DMatrix<f64>>) -> Self {
        let size = grams.first().map_or(0, DMatrix::nrows);
        let mut all = DMatrix::zeros(size, size);
        for gram in &grams {
            all += gram;
        }
        let others = grams
            .iter()
            .map(|gram| Solver::new(&(&all - gram), 1e-9))
            .collect();
        Self { grams, others }
    }

    /// Sum of all blocks' products.
    fn all(&self, rights: &[f64]) -> DVector<f64> {
        let size = self.grams.first().map_or(0, DMatrix::nrows);
        let mut all = DVector::zeros(size);
        for right in rights.chunks_exact(size.max(1)) {
            for (all, right) in all.iter_mut().zip(right) {
                *all += right;
            }
        }
        all
    }

    /// Sum of all blocks' normal matrices.
    fn gram(&self) -> DMatrix<f64> {
        let size = self.grams.first().map_or(0, DMatrix::nrows);
        let none = DMatrix::zeros(size, size);
        self.grams.iter().fold(none, |sum, gram| sum + gram)
    }

    /// Factors of the columns from all blocks; `rights` as in [`Folds::gain`].
    fn factors(&self, rights: &[f64]) -> DVector<f64> {
        let mut factors = self.all(rights);
        Solver::new(&self.gram(), 1e-9).solve(&mut factors);
        factors
    }

    /// What the columns take with factors from all blocks; `rights` as in [`Folds::gain`].
    fn taken(&self, rights: &[f64]) -> f64 {
        self.factors(rights).dot(&self.all(rights))
    }

    /// Σ over blocks of 2·βᵀs − βᵀGβ with β from the other blocks; `rights` are the products s, block by block.
    pub fn gain(&self, rights: &[f64]) -> f64 {
        let all = self.all(rights);
        let size = all.len();
        let mut beta = DVector::<f64>::zeros(size);
        let mut gain = 0.0;
        for ((gram, others), right) in self
            .grams
            .iter()
            .zip(&self.others)
            .zip(rights.chunks_exact(size.max(1)))
        {
            for ((beta, all), right) in beta.iter_mut().zip(&all).zip(right) {
                *beta = all - right;
            }
            others.solve(&mut beta);
            for (a, right) in right.iter().enumerate() {
                let taken: f64 = (0..size).map(|b| gram[(b, a)] * beta[b]).sum();
                gain += beta[a] * (2.0 * right - taken);
            }
        }
        gain
    }
}

/// How a placebo moves a residual: around by some rows, reversed first or not.
pub type Turn = (usize, bool);

/// Sizes up to which nalgebra multiplies by itself (its own threshold is 5).
const SMALL: usize = 8;

/// Products of columns with a residual moved in many ways: for each block, a row for each way and a column for each column.
pub fn turned_products(
    columns: &[&[f64]],
    residual: &[f64],
    turns: &[Turn],
    blocks: &[std::ops::Range<usize>],
) -> Vec<DMatrix<f64>> {
    let count = residual.len();
    let forward = [residual, residual].concat();
    let backward: Vec<f64> = forward.iter().rev().copied().collect();
    blocks
        .into_par_iter()
        .map(|rows| {
            let length = rows.len();
            let mut moved = Vec::with_capacity(length * turns.len());
            for (by, reversed) in turns {
                let from = by % count.max(1) + rows.start;
                let whole = if *reversed { &backward } else { &forward };
                moved.extend_from_slice(&whole[from..from + length]);
            }
            let here: Vec<f64> = columns
                .iter()
                .flat_map(|column| &column[rows.clone()])
                .copied()
                .collect();
            // nalgebra 0.35 reads past a view by rows where it does not hand the product on to matrixmultiply.
            if [turns.len(), columns.len(), length]
                .into_iter()
                .any(|size| size <= SMALL)
            {
                return DMatrix::from_fn(turns.len(), columns.len(), |way, column| {
                    let moved = &moved[way * length..][..length];
                    let here = &here[column * length..][..length];
                    moved.iter().zip(here).map(|(a, b)| a * b).sum()
                });
            }
            // One way after the other, each a row of the left matrix.
            let moved = DMatrixView::from_slice_with_strides_generic(
                &moved,
                Dyn(turns.len()),
                Dyn(length),
                Dyn(length),
                nalgebra::U1,
            );
            let here = DMatrixView::from_slice(&here, length, columns.len());
            let mut products = DMatrix::zeros(turns.len(), columns.len());
            products.gemm(1.0, &moved, &here, 0.0);
            products
        })
        .collect()
}

/// How much a series is like itself when it is moved: its correlation with itself at every way.
struct Likeness {
    forward: std::sync::Arc<dyn Fft<f64>>,
    inverse: std::sync::Arc<dyn Fft<f64>>,
    length: usize,
}

impl Likeness {
    /// For series of some rows.
    fn new(count: usize) -> Self {
        let least = (2 * count).max(2);
        // Lengths of small factors are fast.
        let length = [1, 3, 5]
            .iter()
            .map(|factor| factor * least.div_ceil(*factor).next_power_of_two())
            .fold(usize::MAX, usize::min);
        let mut planner = FftPlanner::new();
        Self {
            forward: planner.plan_fft_forward(length),
            inverse: planner.plan_fft_inverse(length),
            length,
        }
    }

    /// Correlations of a series with itself moved.
    fn of(&self, series: &[f64], turns: &[Turn]) -> Vec<f64> {
        let count = series.len();
        let mut cells = vec![Complex::new(0.0, 0.0); self.length];
        for (cell, value) in cells.iter_mut().zip(series) {
            cell.re = *value;
        }
        self.forward.process(&mut cells);
        // Both at once: with itself in the real part, with itself reversed in the imaginary one.
        for cell in &mut cells {
            let square = *cell * *cell;
            *cell = Complex::new(cell.norm_sqr() - square.im, square.re);
        }
        self.inverse.process(&mut cells);
        let size = dot(series, series) * self.length as f64;
        turns
            .iter()
            .map(|(by, reversed)| {
                let by = by % count.max(1);
                let product = match (reversed, by) {
                    (false, 0) => cells[0].re,
                    (false, _) => cells[by].re + cells[count - by].re,
                    (true, 0) => cells[count - 1].im,
                    (true, _) => cells[count - 1 - by].im + cells[2 * count - 1 - by].im,
                };
                product / size
            })
            .collect()
    }
}

fn placebos(
    entries: &[Arc<Entry>],
    residual: &[f64],
    blocks: &[std::ops::Range<usize>],
    timeless: bool,
    seed: u64,
    draws: usize,
) -> f64 {
    let count = residual.len();
    if entries.is_empty() || count < 32 || draws == 0 {
        return 0.0;
    }
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let least = count / 20;
    let span = (count - 2 * least).max(1) as u32;
    let mut turns: Vec<Turn> = Vec::with_capacity(draws);
    let mut signs: Vec<Vec<f64>> = Vec::with_capacity(draws);
    for _ in 0..draws {
        turns.push((
            least + (random.next_u32() % span) as usize,
            random.next_u32().is_multiple_of(2),
        ));
        let sign = |_| {
            if random.next_u32().is_multiple_of(2) {
                1.0
            } else {
                -1.0
            }
        };
        signs.push(blocks.iter().map(sign).collect());
    }
    let all = dot(residual, residual).max(1e-300);
    let likeness = Likeness::new(count);
    // A residual that is much the same when it is moved (one pulse, a constant) is a placebo for nothing; nor is there anything
    // to move it by where time means nothing.
    let same: Vec<bool> = likeness
        .of(residual, &turns)
        .into_iter()
        .map(|alike| timeless || alike.abs() > ITSELF)
        .collect();
    let columns: Vec<&[f64]> = entries
        .iter()
        .flat_map(|entry| entry.columns.iter().map(Vec::as_slice))
        .collect();
    let products = turned_products(&columns, residual, &turns, blocks);
    let firsts: Vec<usize> = entries
        .iter()
        .scan(0, |next, entry| {
            let first = *next;
            *next += entry.columns.len();
            Some(first)
        })
        .collect();
    // Gains of each entry, draw by draw.
    let gains: Vec<Vec<f64>> = entries
        .par_iter()
        .zip(firsts)
        .map(|(entry, first)| {
            let mut itself = same.clone();
            for column in &entry.columns {
                for (itself, alike) in itself.iter_mut().zip(likeness.of(column, &turns)) {
                    *itself |= alike.abs() > ITSELF;
                }
            }
            let size = entry.columns.len();
            (0..turns.len())
                .map(|draw| {
                    let rights: Vec<f64> = if itself[draw] {
                        // Signatures that stay like themselves when they are moved (a constant, a slow drift, a periodic load)
                        // differ from chance only by being the same in every block.
                        entry
                            .rights
                            .chunks_exact(size)
                            .zip(&signs[draw])
                            .flat_map(|(right, sign)| right.iter().map(move |r| sign * r))
                            .collect()
                    } else {
                        products
                            .iter()
                            .flat_map(|products| {
                                (0..size).map(move |k| products[(draw, first + k)])
                            })
                            .collect()
                    };
                    entry.folds.gain(&rights) / all
                })
                .collect()
        })
        .collect();
    let mut best: Vec<f64> = (0..turns.len())
        .map(|draw| {
            gains
                .iter()
                .fold(0.0, |most, gains| f64::max(most, gains[draw]))
        })
        .collect();
    best.sort_unstable_by(f64::total_cmp);
    best[(best.len() * 99).div_ceil(100).min(best.len()) - 1]
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::explain::fit::fit;
    use crate::problem::Problem;

    /// A gain and its drift that cancel in the mean.
    #[test]
    fn two_that_hide_each_other_are_found_together() {
        let t_s: Vec<f64> = (0..2000).map(|k| 0.1 * f64::from(k)).collect();
        let current: Vec<f64> = t_s.iter().map(|t| 100.0 * (1.7 * t).sin()).collect();
        let warmer: Vec<f64> = t_s.iter().map(|t| 0.05 * (t - 100.0)).collect();
        let drifting = |gain: f64| -> Vec<f64> {
            let factors = warmer.iter().map(|k| gain + 0.004 * k);
            factors.zip(&current).map(|(gain, i)| gain * i).collect()
        };
        let found = |reading: Vec<f64>| {
            let mut problem = Problem::pair(t_s.clone(), current.clone(), reading, 0.5);
            let temperature_c = warmer.iter().map(|k| 35.0 + k);
            problem.drive.sensor_temperature_c = Some(temperature_c.collect());
            let bench = Workbench::new(&problem, &[]);
            let screening = screen(&bench, &fit(&bench, &Model::default(), None), 0, 0);
            let entries: Vec<&Entry> = screening.entries.iter().map(Arc::as_ref).collect();
            let pairs = screening.hidden(&entries, 0.5, 4);
            let mut ids = pairs.iter().map(|pair| pair.map(|entry| entry.member.id()));
            ids.any(|pair| {
                pair == ["gain", "gain-temperature"] || pair == ["gain-temperature", "gain"]
            })
        };
        assert!(found(drifting(1.0)));
        // Of this one of them takes most by itself.
        assert!(!found(drifting(1.1)));
    }

    #[test]
    fn products_are_those_of_moved_residuals() {
        let residual: Vec<f64> = (0..40).map(|row| f64::from(row * row % 23)).collect();
        let all: Vec<Vec<f64>> = (1..=12)
            .map(|k| (0..40).map(|row| f64::from((k * row) % 11)).collect())
            .collect();
        let turns: Vec<Turn> = (0..30).map(|by| (by, by % 2 == 1)).collect();
        let blocks = [0..15, 20..40];
        // Few columns and many take different ways.
        for count in [1, 2, 5, 6, 8, 9, 12] {
            let columns: Vec<&[f64]> = all[..count].iter().map(Vec::as_slice).collect();
            let products = turned_products(&columns, &residual, &turns, &blocks);
            for (rows, products) in blocks.iter().zip(&products) {
                for (way, (by, reversed)) in turns.iter().enumerate() {
                    for (k, column) in columns.iter().enumerate() {
                        let sum: f64 = rows
                            .clone()
                            .map(|row| {
                                let at = (row + by) % 40;
                                let at = if *reversed { 39 - at } else { at };
                                column[row] * residual[at]
                            })
                            .sum();
                        let found = products[(way, k)];
                        assert!(
                            (found - sum).abs() < 1e-9 * sum.abs().max(1.0),
                            "{count} {way}"
                        );
                    }
                }
            }
        }
    }
}
