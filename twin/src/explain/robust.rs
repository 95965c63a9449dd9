//! Huber's loss (Huber 1964, *Ann. Math. Statist.* 35, 73): a few wild readings count by their size, not by its square.

use super::normal::sum_of;

/// Residuals beyond this many standard deviations count by their size, not by its square (Huber).
pub const TUNING: f64 = 3.0;

/// A share of sizes, and the standard deviations of a normal distribution that it stays below.
const COMMON: (f64, f64) = (0.8, 1.2816);

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

/// Spread by the size that four of five stay below: what the others do has no part in it.
pub fn common(residual: &[f64]) -> f64 {
    let mut sizes: Vec<f64> = residual.iter().map(|r| r.abs()).collect();
    sizes.sort_unstable_by(f64::total_cmp);
    let (share, deviations) = COMMON;
    let at = (sizes.len() as f64 * share) as usize;
    sizes.get(at).copied().unwrap_or_default() / deviations
}

/// Huber's loss of a residual in units of sigma.
pub fn huber(z: f64) -> f64 {
    let size = z.abs();
    // The part of it that counts by its square.
    let inner = size.min(TUNING);
    inner * (size - 0.5 * inner)
}

pub(super) fn weight(z: f64) -> f64 {
    TUNING / z.abs().max(TUNING)
}

/// Huber's weights of residuals, in units of 1/sigma².
pub fn weights(residual: &[f64], sigma: f64) -> Vec<f64> {
    residual
        .iter()
        .map(|r| weight(r / sigma) / (sigma * sigma))
        .collect()
}

/// Huber's loss of residuals.
pub fn loss(residual: &[f64], sigma: f64) -> f64 {
    let per_sigma = 1.0 / sigma;
    sum_of(residual, residual, |r, _| huber(r * per_sigma))
}
