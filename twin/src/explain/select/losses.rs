//! What a model is worth on rows held out, and which of two is better by more than chance.

use crate::explain::fit::Fit;
use crate::explain::held_out::held_out;
use crate::explain::slope::change;
use crate::explain::workbench::Workbench;

/// Stretches over which two models' losses are compared.
const STRETCHES: usize = 200;
/// A model is beaten if another's held-out loss is lower by this many standard errors of their paired difference, …
const BEATEN: f64 = 2.0;
/// … and by this at least: the logarithm of the odds at so many standard deviations. A difference that is the same in every stretch
/// has next to no standard error.
const ODDS: f64 = 0.5 * BEATEN * BEATEN;
/// The best of many choices counts from where noise would reach once in so many recordings.
const CHANCE: f64 = 1e-3;

/// Held-out loss of a fit by row, and in all.
pub(super) fn losses(bench: &Workbench<'_>, fit: &Fit, sigma: f64) -> (Vec<f64>, f64) {
    let mut rows = held_out(bench, fit, sigma).concat();
    // The best of many independent choices fits noise by the logarithm of their number, and no block held out shows it.
    let chance: f64 = fit
        .model
        .members
        .iter()
        .map(|member| member.effect.choices(&bench.scale))
        .filter(|choices| *choices > 1.0)
        .map(|choices| (choices / CHANCE).ln())
        .sum();
    let each = chance / rows.len().max(1) as f64;
    // Least squares compensated for the noise of what goes in (Söderström 2018, *Errors-in-Variables Methods in System Identification*,
    // ch. 7): what averages that has a lower error for it.
    let evened = 0.5 * fit.evened(bench) / (sigma * sigma * bench.len() as f64);
    rows.iter_mut().for_each(|loss| *loss += each + evened);
    let all = rows.iter().sum();
    (rows, all)
}

/// Share of the held-out loss that goes from one fit to a better one, in the spread of the first.
pub(super) fn share(bench: &Workbench<'_>, before: &Fit, after: &Fit) -> f64 {
    let (_, from) = losses(bench, before, before.sigma);
    let (_, to) = losses(bench, after, before.sigma);
    (from - to) / from.max(1e-300)
}

/// Whether a model's held-out loss is higher than the chosen one's by more than chance, stretch against stretch.
pub fn beaten(bench: &Workbench<'_>, other: &Fit, chosen: &Fit) -> bool {
    let sigma = chosen.sigma.min(other.sigma);
    let (theirs, _) = losses(bench, other, sigma);
    let (ours, _) = losses(bench, chosen, sigma);
    // Noise with a memory tells two models apart by no more than what it does along their difference, however many the rows.
    let apart = change(&other.predicted, &chosen.predicted);
    let stated = bench.stated(0, &apart) + bench.rounded(0, &apart);
    worse(&theirs, &ours, stated.sqrt() / (sigma * sigma))
}

/// Whether losses, row by row, are higher than others by more than chance, stretch against stretch; `stated` is the standard
/// deviation of their sums' difference that is known besides.
pub fn worse(theirs: &[f64], ours: &[f64], stated: f64) -> bool {
    let rows = (ours.len() / STRETCHES).max(1);
    let differences: Vec<f64> = theirs
        .chunks(rows)
        .zip(ours.chunks(rows))
        .map(|(a, b)| a.iter().sum::<f64>() - b.iter().sum::<f64>())
        .collect();
    let count = differences.len() as f64;
    let mean = differences.iter().sum::<f64>() / count;
    let variance =
        differences.iter().map(|d| (d - mean).powi(2)).sum::<f64>() / (count - 1.0).max(1.0);
    mean > (BEATEN * (variance / count).sqrt().max(stated / count)).max(ODDS / count)
}
