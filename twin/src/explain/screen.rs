//! Which effects could account for a residual: each candidate's signature against it, held out block by block, beside
//! placebos that cannot be physics.
//!
//! A signature is the change that a candidate makes to the simulation; what the model's own values could do is taken out of it.
//! Its held-out gain is the squared error that it removes from each block with factors from the other blocks. A placebo is the
//! same signature against the residual moved in time (and half of them reversed): whatever it gains is chance and colour of the
//! noise. Each draw keeps the best of all candidates, so that trying many effects is paid for.

use nalgebra::{DMatrix, DVector};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng as _, SeedableRng as _};
use rayon::prelude::*;

use super::fit::{Fit, TUNING, dot, normal, slope, solve, spread};
use super::workbench::{Member, Model, Workbench};
use crate::effects::{Effect, Search};

/// Placebo draws.
pub const DRAWS: usize = 200;
/// Rows that signatures are compared over; longer recordings are thinned out.
const MOST_ROWS: usize = 30_000;
/// A residual moved to where a candidate looks like itself again is no placebo for it: signs are drawn then.
const ITSELF: f64 = 0.6;

/// A candidate with the values from which its signature was taken.
#[derive(Clone, Debug)]
pub struct Entry {
    /// The candidate.
    pub member: Member,
    /// Squared error that it removes from held-out blocks, as a share of all of it.
    pub gain: f64,
    columns: Vec<Vec<f64>>,
    grams: Vec<DMatrix<f64>>,
}

/// What screening a residual gives.
#[derive(Debug)]
pub struct Screening {
    /// Candidates, best first; several entries of one effect may follow each other.
    pub entries: Vec<Entry>,
    /// 99th percentile of the placebos' best gains.
    pub placebo_p99: f64,
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
    let thin = thin(bench);
    let sigma = spread(&fit.residual);
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
    let own: Vec<Vec<f64>> = slope(bench, &fit.model, &fit.predicted)
        .columns
        .iter()
        .map(|column| take(column))
        .collect();
    let weights = vec![1.0; residual.len()];
    let (own_normal, _) = normal(&own, &weights, &residual, 0..residual.len());
    let clean = |mut column: Vec<f64>| -> Vec<f64> {
        if !own.is_empty() {
            let along = DVector::from_fn(own.len(), |k, _| dot(&own[k], &column));
            let factors = solve(&own_normal, &along, 1e-9);
            for (own, factor) in own.iter().zip(factors.iter()) {
                column
                    .iter_mut()
                    .zip(own)
                    .for_each(|(value, own)| *value -= factor * own);
            }
        }
        column
    };
    let candidates: Vec<(&'static dyn Effect, Vec<f64>)> = bench
        .library
        .iter()
        .copied()
        .filter(|effect| may_join(&fit.model, *effect))
        .flat_map(|effect| {
            let clues = bench.clues(&fit.predicted);
            effect
                .starts(&bench.scale, &clues)
                .into_iter()
                .map(move |values| (effect, values))
        })
        .collect();
    let mut entries: Vec<Entry> = candidates
        .into_par_iter()
        .filter_map(|(effect, values)| {
            let base = replaced(&fit.model, effect);
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
                    let before = dot(&raw, &raw);
                    let column = clean(raw);
                    // What the model can do by itself is no signature.
                    (dot(&column, &column) > 1e-8 * before && before > 0.0).then_some(column)
                })
                .collect();
            if columns.is_empty() {
                return None;
            }
            let grams = thin
                .blocks
                .iter()
                .map(|rows| normal(&columns, &weights, &residual, rows.clone()).0)
                .collect();
            let mut entry = Entry {
                member: Member { effect, values },
                gain: 0.0,
                columns,
                grams,
            };
            entry.gain = gain(&entry, &residual, &thin.blocks);
            Some(entry)
        })
        .collect();
    entries.sort_by(|a, b| b.gain.total_cmp(&a.gain));
    let placebo_p99 = placebos(&entries, &residual, &thin.blocks, seed, draws);
    Screening {
        entries,
        placebo_p99,
    }
}

/// Whether an effect can be added: it is not there yet, or it has more branches than what is there.
fn may_join(model: &Model, effect: &'static dyn Effect) -> bool {
    let card = effect.card();
    let same = model.members.iter().find(|member| member.id() == card.id);
    let branches = card.parameters.len();
    match same {
        None => crate::effects::LIBRARY
            .iter()
            .filter(|other| other.card().id == card.id)
            .all(|other| other.card().parameters.len() >= branches),
        // One branch more at a time.
        Some(member) => {
            let now = member.values.len();
            branches > now
                && !crate::effects::LIBRARY.iter().any(|other| {
                    let size = other.card().parameters.len();
                    other.card().id == card.id && size > now && size < branches
                })
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

/// Values whose simulations span what the candidate can do: one for each linear parameter, the others off; or the values as
/// they are.
fn probes(effect: &'static dyn Effect, values: &[f64]) -> Vec<Vec<f64>> {
    let parameters = effect.card().parameters;
    let linear: Vec<usize> = parameters
        .iter()
        .enumerate()
        .filter(|(_, parameter)| parameter.search == Search::Linear)
        .map(|(index, _)| index)
        .collect();
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

/// Share of the squared error that the columns remove from blocks with factors from the other blocks.
fn gain(entry: &Entry, residual: &[f64], blocks: &[std::ops::Range<usize>]) -> f64 {
    let size = entry.columns.len();
    let rights: Vec<DVector<f64>> = blocks
        .iter()
        .map(|rows| {
            DVector::from_fn(size, |k, _| {
                dot(&entry.columns[k][rows.clone()], &residual[rows.clone()])
            })
        })
        .collect();
    let all: f64 = blocks
        .iter()
        .map(|rows| dot(&residual[rows.clone()], &residual[rows.clone()]))
        .sum();
    held_out_gain(&entry.grams, &rights) / all.max(1e-300)
}

/// Σ over blocks of 2·βᵀs − βᵀGβ with β from the other blocks.
pub fn held_out_gain(grams: &[DMatrix<f64>], rights: &[DVector<f64>]) -> f64 {
    let size = rights.first().map_or(0, DVector::len);
    let mut gram = DMatrix::zeros(size, size);
    let mut right = DVector::zeros(size);
    for (g, r) in grams.iter().zip(rights) {
        gram += g;
        right += r;
    }
    grams
        .iter()
        .zip(rights)
        .map(|(g, r)| {
            let beta = solve(&(&gram - g), &(&right - r), 1e-9);
            2.0 * beta.dot(r) - beta.dot(&(g * &beta))
        })
        .sum()
}

fn placebos(
    entries: &[Entry],
    residual: &[f64],
    blocks: &[std::ops::Range<usize>],
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
    let tries: Vec<Try> = (0..draws)
        .map(|_| Try {
            by: least + (random.next_u32() % span) as usize,
            reversed: random.next_u32().is_multiple_of(2),
            signs: blocks
                .iter()
                .map(|_| {
                    if random.next_u32().is_multiple_of(2) {
                        1.0
                    } else {
                        -1.0
                    }
                })
                .collect(),
        })
        .collect();
    let mut best: Vec<f64> = tries
        .into_par_iter()
        .map(|this| {
            let moved = turned(residual, this.by, this.reversed);
            // A residual that is much the same when it is moved (one pulse, a constant) is a placebo for nothing.
            let same = dot(residual, &moved).abs() > ITSELF * dot(residual, residual);
            entries
                .iter()
                .map(|entry| {
                    let itself = same
                        || entry.columns.iter().any(|column| {
                            let size = dot(column, column);
                            (dot(column, &turned(column, this.by, this.reversed)) / size).abs()
                                > ITSELF
                        });
                    if itself {
                        flipped(entry, residual, blocks, &this.signs)
                    } else {
                        gain(entry, &moved, blocks)
                    }
                })
                .fold(0.0, f64::max)
        })
        .collect();
    best.sort_unstable_by(f64::total_cmp);
    best[(best.len() * 99).div_ceil(100).min(best.len()) - 1]
}

/// The gain of an entry when each block has a sign of its own: for signatures that stay like themselves when they are moved
/// (a constant, a slow drift, a periodic load), where only being the same in every block tells them from chance.
fn flipped(
    entry: &Entry,
    residual: &[f64],
    blocks: &[std::ops::Range<usize>],
    signs: &[f64],
) -> f64 {
    let size = entry.columns.len();
    let rights: Vec<DVector<f64>> = blocks
        .iter()
        .zip(signs)
        .map(|(rows, sign)| {
            DVector::from_fn(size, |k, _| {
                sign * dot(&entry.columns[k][rows.clone()], &residual[rows.clone()])
            })
        })
        .collect();
    let all: f64 = blocks
        .iter()
        .map(|rows| dot(&residual[rows.clone()], &residual[rows.clone()]))
        .sum();
    held_out_gain(&entry.grams, &rights) / all.max(1e-300)
}

/// One placebo draw.
struct Try {
    by: usize,
    reversed: bool,
    signs: Vec<f64>,
}

/// Moved around by some rows, reversed first if asked for.
pub fn turned(series: &[f64], by: usize, reversed: bool) -> Vec<f64> {
    let mut turned = series.to_vec();
    if reversed {
        turned.reverse();
    }
    turned.rotate_left(by % series.len().max(1));
    turned
}
