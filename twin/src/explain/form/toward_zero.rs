//! Readings that are cut to whole steps toward zero, and not rounded to the nearest.

use super::{Made, Says, Shape};
use crate::effects::quantisation::lattice;
use crate::explain::workbench::Workbench;
use crate::report::format::at_most;

/// A normal distribution in so many points each way, and where the last one is, in standard deviations.
const POINTS: i32 = 14;
const LAST: f64 = 3.5;

/// If the readings are whole steps.
pub(super) fn of<'a>(
    bench: &Workbench<'_>,
    residual: &[f64],
    noise: f64,
    says: Says<'a>,
) -> Option<Box<dyn Shape + 'a>> {
    let step = lattice(&bench.y)?;
    let pairs = bench.y.iter().zip(residual);
    let signal: Vec<f64> = pairs
        .map(|(reading, residual)| reading - residual)
        .collect();
    Some(Box::new(TowardZero::new(&signal, step, noise, says)))
}

/// See the module.
struct TowardZero<'a> {
    step: f64,
    /// What the cut makes of each row in the mean over the noise ahead of it, less the signal, and its variance.
    made: Vec<[f64; 2]>,
    says: Says<'a>,
}

impl<'a> TowardZero<'a> {
    fn new(signal: &[f64], step: f64, noise: f64, says: Says<'a>) -> Self {
        let points: Vec<(f64, f64)> = (-POINTS..=POINTS)
            .map(|k| LAST * f64::from(k) / f64::from(POINTS))
            .map(|z| (noise * z, (-0.5 * z * z).exp()))
            .collect();
        let all: f64 = points.iter().map(|(_, weight)| weight).sum();
        let made = signal.iter().map(|signal| {
            let (mut mean, mut square) = (0.0, 0.0);
            for (noise, weight) in &points {
                let read = ((signal + noise) / step).trunc() * step - signal;
                mean += weight / all * read;
                square += weight / all * read * read;
            }
            [mean, (square - mean * mean).max(0.0)]
        });
        Self {
            step,
            made: made.collect(),
            says,
        }
    }
}

impl Shape for TowardZero<'_> {
    fn id(&self) -> &'static str {
        "toward-zero"
    }

    fn size(&self) -> usize {
        0
    }

    fn made(&self, _: &[f64], _: &[bool]) -> Option<Made> {
        Some(Made {
            series: self.made.iter().map(|[mean, _]| *mean).collect(),
            values: Vec::new(),
        })
    }

    fn told(&self, _: &[f64]) -> String {
        let step = at_most(self.step, 3);
        format!(
            "readings cut to whole {step} {} toward zero, and not rounded",
            self.says.unit
        )
    }

    fn leaves(&self, row: usize, _: f64) -> f64 {
        self.made[row][1]
    }
}
