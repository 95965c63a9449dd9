//! Whether the curves of the named effects are the recording's own: a lack-of-fit test.
//!
//! Effects such as a gain or a saturation say that the reading is a certain curve of the present current. Here that curve is
//! compared with a free one, straight lines between knots, on held-out blocks and against placebos (the residual moved in time
//! keeps its colour). What the free curve still finds is set against what *that effect* takes, not against the whole: a wrong
//! shape can take most of a mismatch and leave little.

use super::fit::{self, Fit, ahead_of_grid};
use super::flexible::Features;
use super::normal::{dot, normal, solve};
use super::select::{self, Selection};
use super::slope::change;
use super::workbench::Workbench;
use crate::problem::{Base, View};
use crate::report::format::percent;

/// Knots of the free curve, at even shares of the rows.
const KNOTS: usize = 16;
/// With fewer, there is no curve to be compared.
const LEAST_KNOTS: usize = 5;
/// An effect is a curve of the present current if such a curve holds at least this share of what it changes.
const CURVE: f64 = 0.5;
/// What the free curve finds counts from so many times the best placebo on: it takes names away.
const CERTAIN: f64 = 2.0;

/// The free curve's columns at all rows: hats between knots of the reading as designed.
fn hats(bench: &Workbench<'_>) -> Vec<Vec<f64>> {
    let x = &bench.reference;
    let mut sorted = x.clone();
    sorted.sort_unstable_by(f64::total_cmp);
    let mut knots: Vec<f64> = (0..KNOTS)
        .map(|k| sorted[(sorted.len() - 1) * k / (KNOTS - 1)])
        .collect();
    let least = 1e-3 * bench.scale.largest;
    knots.dedup_by(|a, b| *a - *b < least);
    hats_between(x, &knots)
}

/// Columns of straight lines between knots at rows of a current: each 1 at its knot and 0 at the next ones, the first and last held beyond
/// the ends.
pub(super) fn hats_between(x: &[f64], knots: &[f64]) -> Vec<Vec<f64>> {
    (0..knots.len())
        .map(|k| {
            x.iter()
                .map(|x| {
                    let rise = if k > 0 {
                        (x - knots[k - 1]) / (knots[k] - knots[k - 1])
                    } else {
                        1.0
                    };
                    let fall = if k + 1 < knots.len() {
                        (knots[k + 1] - x) / (knots[k + 1] - knots[k])
                    } else {
                        1.0
                    };
                    rise.min(fall).clamp(0.0, 1.0)
                })
                .collect()
        })
        .collect()
}

/// Takes out of columns what others span.
fn clean(columns: &mut [Vec<f64>], others: &[Vec<f64>]) {
    let Some(rows) = others.first().map(Vec::len) else {
        return;
    };
    let ones = vec![1.0; rows];
    for column in columns {
        let (matrix, right) = normal(others, &ones, column, 0..rows);
        let factors = solve(&matrix, &right, 1e-9);
        for (other, factor) in others.iter().zip(factors.iter()) {
            column
                .iter_mut()
                .zip(other)
                .for_each(|(value, other)| *value -= factor * other);
        }
    }
}

/// A residual without and with what an effect remembers: its change beside a curve of the present current. Both beside such a curve
/// of the recording's own.
pub fn without_memory(
    bench: &Workbench<'_>,
    residual: &[f64],
    change: &[f64],
) -> (Vec<f64>, Vec<f64>) {
    let mut both = [change.to_vec(), residual.to_vec()];
    let hats = hats(bench);
    if !hats.is_empty() {
        clean(&mut both, &hats);
    }
    let [memory, with] = both;
    let without = with.iter().zip(&memory).map(|(r, m)| r + m).collect();
    (without, with)
}

/// What columns hold of a series.
fn curve(columns: &[Vec<f64>], series: &[f64]) -> Vec<f64> {
    let mut rest = [series.to_vec()];
    clean(&mut rest, columns);
    let [rest] = rest;
    change(series, &rest)
}

/// Energy of a series that columns hold.
fn held(columns: &[Vec<f64>], series: &[f64]) -> f64 {
    let ones = vec![1.0; series.len()];
    let (matrix, right) = normal(columns, &ones, series, 0..series.len());
    solve(&matrix, &right, 1e-9).dot(&right)
}

/// Withdraws effects that are curves of the present current, where the recording's own curve is another.
///
/// A curve is judged as it was read: by how much equations may be off is told of that.
pub fn withdraw(
    (bench, read): (&Workbench<'_>, &Workbench<'_>),
    selection: &mut Selection,
    seed: u64,
) {
    if !matches!(bench.problem.base, Base::Sensor(_)) || bench.problem.view != View::Sensor {
        return;
    }
    let hats = hats(read);
    // A drive of few sizes has no curve to show.
    if hats.len() < LEAST_KNOTS {
        return;
    }
    while !selection.named.is_empty() {
        let seen = selection.fit.as_read(bench, read);
        let Some((index, why)) = misfit(read, &seen, &hats, seed) else {
            return;
        };
        let id = selection.fit.model.members[index].id();
        selection.refused.push(format!("{id}: {why}"));
        let without = fit::fit(bench, &selection.fit.model.without(index), None);
        selection.fit = select::settled(bench, &without);
        selection.rename(bench);
    }
}

/// Energy that so many columns take of the stated noise with a memory, on average: over T it has some T/2τ independent values. Moved in
/// time, as a placebo is, few of them look as little like the columns as chance has it.
fn of_noise(bench: &Workbench<'_>, columns: usize) -> f64 {
    let noise = bench.problem.coloured;
    let independent = bench.scale.span_s / (2.0 * noise.tau_s).max(1e-9);
    let share = (columns as f64 / independent.max(1.0)).min(1.0);
    noise.rms.powi(2) * bench.len() as f64 * share
}

/// The smallest effect whose curve is not the recording's, and why.
fn misfit(
    bench: &Workbench<'_>,
    fit: &Fit,
    hats: &[Vec<f64>],
    seed: u64,
) -> Option<(usize, String)> {
    // Of what the effects' own values do, the curve of the current: with all of it, hats less that would be what a reading of the
    // reference differs by from its standstill, which is noise.
    let own: Vec<Vec<f64>> = fit
        .slope(bench)
        .columns
        .iter()
        .map(|column| curve(hats, column))
        .collect();
    let mut free = hats.to_vec();
    clean(&mut free, &own);
    let residual = ahead_of_grid(bench, fit);
    let missed = Features::of(bench, &free).explain(&residual, seed);
    if missed.share <= CERTAIN * missed.placebo_most {
        return None;
    }
    let left = missed.share * dot(&residual, &residual)
        - of_noise(bench, free.len())
        - bench.standstills_left;
    let known = bench.problem.accuracy;
    let accuracy: f64 = bench
        .plain
        .iter()
        // A curve of the present current knows no moments.
        .map(|x| known.at(*x, 0.0).powi(2))
        .sum();
    // What each takes of a free curve of the current, and all that it changes.
    let taken: Vec<(f64, f64)> = (0..fit.model.members.len())
        .map(|index| {
            let without = fit::fit(bench, &fit.model.without(index), None);
            let change = change(&fit.predicted, &without.predicted);
            (held(hats, &change), dot(&change, &change))
        })
        .collect();
    let effect = |index: usize| fit.model.members[index].effect;
    // The others' equations are idealisations, too.
    let allowed = |index: usize| {
        let beside: f64 = (0..taken.len())
            .filter(|other| *other != index)
            .map(|other| effect(other).idealised().powi(2) * taken[other].0)
            .sum();
        effect(index).curve().powi(2) * taken[index].0 + beside
    };
    let (index, size) = (0..taken.len())
        .map(|index| (index, taken[index].0))
        .filter(|(index, size)| *size >= CURVE * taken[*index].1)
        // Steps and ends that the readings show by themselves; noise makes a softer curve of them.
        .filter(|(index, _)| bench.mark(effect(*index)).is_none())
        .filter(|(index, _)| left > allowed(*index).max(accuracy))
        .min_by(|a, b| a.1.total_cmp(&b.1))?;
    Some((
        index,
        format!(
            "a curve of the current, but another one: a free curve departs from it by {} of its size (rms)",
            percent((left.max(0.0) / size).sqrt())
        ),
    ))
}
