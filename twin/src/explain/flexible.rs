//! How much of a residual any smooth function of the recorded inputs could explain: a regression on many features of them, no
//! physics, scored on held-out blocks against placebos like everything else.

use nalgebra::{DMatrix, DVector};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng as _, SeedableRng as _};
use rayon::prelude::*;

use super::normal::{dot, normal, solve};
use super::robust::{TUNING, spread};
use super::screen::{Folds, ITSELF, Turn, turned_products};
use super::workbench::Workbench;
use crate::effects::scene::{Cursor, Steps};

/// Placebo draws.
const DRAWS: usize = 60;
/// Rows looked at.
const MOST_ROWS: usize = 20_000;
/// Weight of the ridge, as a share of each feature's own energy.
const RIDGE: f64 = 1e-3;

/// What a function of the inputs could explain.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Explainable {
    /// Share of the squared residual on held-out blocks, 0 … 1.
    pub share: f64,
    /// The largest of the placebos' shares.
    pub placebo_most: f64,
    /// Their mean.
    pub placebo_mean: f64,
}

impl Explainable {
    /// More than chance.
    pub fn is_real(&self) -> bool {
        self.share > self.placebo_most && self.share > 0.0
    }

    /// The share that is there. So many weights, each found in noise, cost something on data that they were not found on: what
    /// placebos lose, in which there is nothing to be found.
    pub fn there(&self) -> f64 {
        self.share - self.placebo_mean.min(0.0)
    }
}

/// Features of the inputs at the rows that count, made once for a bench.
#[derive(Debug)]
pub struct Features {
    rows: Vec<usize>,
    blocks: Vec<std::ops::Range<usize>>,
    columns: Vec<Vec<f64>>,
    gram: DMatrix<f64>,
    folds: Folds,
    timeless: bool,
    /// See [`Workbench::least_spread`].
    least_spread: f64,
}

impl Features {
    /// Of a bench.
    pub fn new(bench: &Workbench<'_>) -> Self {
        Self::with(bench, |rows| {
            if !bench.is_white() {
                return columns(bench, rows);
            }
            let all: Vec<usize> = (0..bench.len()).collect();
            columns(bench, &all)
                .into_iter()
                .map(|column| {
                    let column = bench.as_fitted(column);
                    rows.iter().map(|&row| column[row]).collect()
                })
                .collect()
        })
    }

    /// Of columns of one's own, each a value for every row of the bench.
    pub fn of(bench: &Workbench<'_>, columns: &[Vec<f64>]) -> Self {
        Self::with(bench, |rows| {
            columns
                .iter()
                .map(|column| rows.iter().map(|&row| column[row]).collect())
                .collect()
        })
    }

    fn with(bench: &Workbench<'_>, columns: impl FnOnce(&[usize]) -> Vec<Vec<f64>>) -> Self {
        let stride = bench.len().div_ceil(MOST_ROWS).max(1);
        let mut rows = Vec::new();
        let mut blocks = Vec::new();
        for block in &bench.blocks {
            let start = rows.len();
            rows.extend(block.clone().step_by(stride));
            blocks.push(start..rows.len());
        }
        let mut columns = columns(&rows);
        for column in &mut columns {
            let size = (dot(column, column) / column.len().max(1) as f64).sqrt();
            if size > 0.0 {
                column.iter_mut().for_each(|value| *value /= size);
            }
        }
        columns.retain(|column| {
            column.iter().all(|value| value.is_finite()) && column.iter().any(|value| *value != 0.0)
        });
        let nothing = vec![0.0; rows.len()];
        let weights = vec![1.0; rows.len()];
        let grams: Vec<DMatrix<f64>> = blocks
            .par_iter()
            .map(|range| {
                let (mut gram, _) = normal(&columns, &weights, &nothing, range.clone());
                for k in 0..gram.nrows() {
                    gram[(k, k)] += RIDGE * range.len() as f64;
                }
                gram
            })
            .collect();
        let mut gram = DMatrix::zeros(columns.len(), columns.len());
        for part in &grams {
            gram += part;
        }
        Self {
            rows,
            blocks,
            columns,
            gram,
            folds: Folds::new(grams),
            timeless: bench.problem.quasi_static(),
            least_spread: bench.least_spread(),
        }
    }

    /// What they could explain of a residual over the bench's rows.
    pub fn explain(&self, residual: &[f64], seed: u64) -> Explainable {
        if self.columns.is_empty() || self.rows.len() < 40 {
            return Explainable::default();
        }
        let limit = TUNING * spread(residual).max(self.least_spread);
        let residual: Vec<f64> = self
            .rows
            .iter()
            .map(|&row| residual[row].clamp(-limit, limit))
            .collect();
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let count = residual.len();
        let least = count / 20;
        let span = (count - 2 * least).max(1) as u32;
        // The residual as it is comes first.
        let turns: Vec<Turn> = std::iter::once((0, false))
            .chain((0..DRAWS).map(|_| {
                (
                    least + (random.next_u32() % span) as usize,
                    random.next_u32().is_multiple_of(2),
                )
            }))
            .collect();
        // Where the drive or the residual is like itself when it is moved (a loop that repeats), blocks get random signs instead.
        let drive = self.columns.get(1).map_or(&residual[..], Vec::as_slice);
        let repeats: Vec<bool> = turns
            .iter()
            .map(|turn| self.timeless || repeats(&residual, *turn) || repeats(drive, *turn))
            .collect();
        let signs: Vec<Vec<f64>> = turns
            .iter()
            .map(|_| {
                let sign = |even: bool| if even { 1.0 } else { -1.0 };
                (0..self.blocks.len())
                    .map(|_| sign(random.next_u32().is_multiple_of(2)))
                    .collect()
            })
            .collect();
        let columns: Vec<&[f64]> = self.columns.iter().map(Vec::as_slice).collect();
        let products = turned_products(&columns, &residual, &turns, &self.blocks);
        let all = dot(&residual, &residual).max(1e-300);
        let shares: Vec<f64> = (0..turns.len())
            .into_par_iter()
            .map(|draw| {
                let flipped = draw > 0 && repeats[draw];
                let rights: Vec<f64> = products
                    .iter()
                    .zip(&signs[draw])
                    .flat_map(|(products, sign)| {
                        let (row, sign) = if flipped { (0, *sign) } else { (draw, 1.0) };
                        products
                            .row(row)
                            .iter()
                            .map(|product| sign * product)
                            .collect::<Vec<f64>>()
                    })
                    .collect();
                self.folds.gain(&rights) / all
            })
            .collect();
        Explainable {
            share: shares[0].max(0.0),
            placebo_most: shares[1..]
                .iter()
                .fold(0.0, |most, share| f64::max(most, *share)),
            placebo_mean: shares[1..].iter().sum::<f64>() / DRAWS as f64,
        }
    }

    /// What they make of a residual, and another series, both at the features' own rows.
    pub fn shape(&self, residual: &[f64], other: &[f64]) -> (Vec<f64>, Vec<f64>) {
        let limit = TUNING * spread(residual).max(self.least_spread);
        let here: Vec<f64> = self
            .rows
            .iter()
            .map(|&row| residual[row].clamp(-limit, limit))
            .collect();
        let right = DVector::from_fn(self.columns.len(), |k, _| dot(&self.columns[k], &here));
        let factors = solve(&self.gram, &right, 1e-9);
        let mut shape = vec![0.0; self.rows.len()];
        for (column, factor) in self.columns.iter().zip(factors.iter()) {
            shape
                .iter_mut()
                .zip(column)
                .for_each(|(s, c)| *s += factor * c);
        }
        (shape, self.rows.iter().map(|&row| other[row]).collect())
    }
}

/// Whether a series, less its mean, is like itself when it is turned.
fn repeats(series: &[f64], (by, reversed): Turn) -> bool {
    let count = series.len();
    let mean = series.iter().sum::<f64>() / count.max(1) as f64;
    let at = |row: usize| {
        let row = (row + by) % count;
        series[if reversed { count - 1 - row } else { row }] - mean
    };
    let (mut together, mut alone) = (0.0, 0.0);
    for (row, value) in series.iter().enumerate() {
        together += (value - mean) * at(row);
        alone += (value - mean).powi(2);
    }
    together.abs() > ITSELF * alone
}

/// A series on the drive's rows, at the rows of the observation.
pub(super) fn at_rows(
    bench: &Workbench<'_>,
    rows: &[usize],
    series: &[f64],
    earlier_s: f64,
) -> Vec<f64> {
    let drive = &bench.problem.drive;
    let observed = &bench.problem.observed;
    let mut current: Option<(usize, Cursor<'_>)> = None;
    rows.iter()
        .map(|&index| {
            let row = bench.rows[index];
            let segment = observed.segment_of(row);
            let Some(range) = drive
                .segments
                .get(segment)
                .filter(|range| !range.is_empty())
            else {
                return 0.0;
            };
            if current.as_ref().is_none_or(|(known, _)| *known != segment) {
                current = Some((segment, Cursor::new(&drive.t_s, range.clone())));
            }
            current.as_mut().map_or(0.0, |(_, cursor)| {
                cursor.value(series, observed.t_s[row] - earlier_s, false)
            })
        })
        .collect()
}

fn columns(bench: &Workbench<'_>, rows: &[usize]) -> Vec<Vec<f64>> {
    let drive = &bench.problem.drive;
    let scale = &bench.scale;
    let x = &bench.steady;
    let here = at_rows(bench, rows, x, 0.0);
    let top = scale.largest.max(1e-12);
    let mut columns: Vec<Vec<f64>> = vec![vec![1.0; rows.len()], here.clone()];
    let mut push = |column: Vec<f64>| columns.push(column);
    push(here.iter().map(|v| v.abs()).collect());
    push(here.iter().map(|v| v * v / top).collect());
    push(here.iter().map(|v| v * v.abs() / top).collect());
    let mut sorted: Vec<f64> = here.clone();
    sorted.sort_unstable_by(f64::total_cmp);
    for share in [0.02, 0.1, 0.25, 0.5, 0.75, 0.9, 0.98] {
        let knot = sorted[((sorted.len() - 1) as f64 * share) as usize];
        push(here.iter().map(|v| (v - knot).max(0.0)).collect());
    }
    // What came before, on two ladders of times.
    let steps = Steps::new(drive);
    let mut tau = 0.5 * scale.step_s;
    while tau < 0.3 * scale.span_s && tau < 4000.0 * scale.step_s {
        let slow = steps.low_pass(&drive.segments, x, tau, false);
        let slow = at_rows(bench, rows, &slow, 0.0);
        push(here.iter().zip(&slow).map(|(v, s)| v - s).collect());
        let squares: Vec<f64> = x.iter().map(|v| v * v / top).collect();
        let warm = steps.low_pass(&drive.segments, &squares, tau, false);
        let warm = at_rows(bench, rows, &warm, 0.0);
        push(warm.iter().zip(&here).map(|(w, v)| w * v / top).collect());
        push(warm);
        tau *= 3.0;
    }
    for steps in [-2.0, -1.0, 1.0, 2.0, 4.0] {
        let moved = at_rows(bench, rows, x, steps * scale.step_s);
        push(moved.iter().zip(&here).map(|(m, v)| m - v).collect());
    }
    // What changes in the course of the recording.
    let (first, last) = (bench.t_s[0], bench.t_s[bench.t_s.len() - 1]);
    let course: Vec<f64> = rows
        .iter()
        .map(|&row| (bench.t_s[row] - first) / (last - first).max(1e-9) - 0.5)
        .collect();
    let moved = at_rows(bench, rows, x, scale.step_s);
    push(course.iter().zip(&here).map(|(t, x)| t * x).collect());
    push(
        course
            .iter()
            .zip(moved.iter().zip(&here))
            .map(|(t, (m, x))| t * (m - x))
            .collect(),
    );
    push(course);
    let environment = [
        &drive.sensor_temperature_c,
        &drive.supply_v,
        &drive.aux_a,
        &drive.range_high,
        &drive.cell_temperature_c,
        &drive.ambient_c,
    ];
    for series in environment.into_iter().flatten() {
        let there = at_rows(bench, rows, series, 0.0);
        let mean = there.iter().sum::<f64>() / there.len().max(1) as f64;
        let centred: Vec<f64> = there.iter().map(|v| v - mean).collect();
        let spread = (dot(&centred, &centred) / centred.len().max(1) as f64).sqrt();
        if spread.is_nan() || spread <= 1e-9 * mean.abs().max(1.0) {
            continue;
        }
        push(centred.iter().map(|v| v * v / spread).collect());
        push(centred.iter().zip(&here).map(|(v, x)| v * x).collect());
        push(
            centred
                .iter()
                .zip(&here)
                .map(|(v, x)| v * x.abs())
                .collect(),
        );
        push(centred);
    }
    if scale.capacity_ah > 0.0 {
        let charge = crate::effects::scene::integral(&drive.t_s, &drive.segments, x, false);
        let charge = at_rows(bench, rows, &charge, 0.0);
        let least = charge.iter().copied().fold(f64::INFINITY, f64::min);
        let most = charge.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        if most > least {
            for power in [1, 2, 3, 4] {
                let column: Vec<f64> = charge
                    .iter()
                    .map(|q| ((q - least) / (most - least)).powi(power))
                    .collect();
                push(column.iter().zip(&here).map(|(q, x)| q * x).collect());
                push(column);
            }
        }
    }
    columns
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::problem::Problem;
    use rand_distr::{Distribution as _, StandardNormal};

    const ROWS: usize = 3600;
    const SEEDS: u64 = 12;

    #[test]
    fn what_is_there_is_not_less_for_the_weights_that_are_tried() {
        let t_s: Vec<f64> = (0..ROWS).map(|row| 0.5 * row as f64).collect();
        let drawn = |seed: u64| StandardNormal.sample_iter(ChaCha8Rng::seed_from_u64(seed));
        let steps: Vec<f64> = drawn(0).take(ROWS).collect();
        // It wanders for some ten rows, and never in the same way again.
        let current: Vec<f64> = steps
            .iter()
            .scan(0.0, |current, step: &f64| {
                *current = 0.9 * *current + 20.0 * step;
                Some(*current)
            })
            .collect();
        let problem = Problem::pair(t_s, current.clone(), current.clone(), 1.0);
        let features = Features::new(&Workbench::new(&problem, &[]));
        let size = (dot(&current, &current) / ROWS as f64).sqrt();
        for share in [0.04_f64, 0.08] {
            let follows = (share / (1.0 - share)).sqrt() / size;
            let found = (1..=SEEDS).map(|seed| {
                let noise = drawn(seed).take(ROWS);
                let both = current.iter().zip(noise);
                let residual: Vec<f64> = both
                    .map(|(i, noise): (_, f64)| follows * i + noise)
                    .collect();
                let left = features.explain(&residual, seed);
                assert!(left.is_real(), "{left:?}");
                [left.there(), left.share]
            });
            let sums = found.fold([0.0, 0.0], |[there, alone], [a, b]| [there + a, alone + b]);
            let [there, alone] = sums.map(|sum| sum / SEEDS as f64);
            // A share of so many rows has a standard error of 2·√(share/rows).
            let error = 2.0 * (share / (SEEDS * ROWS as u64) as f64).sqrt();
            assert!((there - share).abs() < 4.0 * error, "{share}: {there}");
            assert!(alone < share - 4.0 * error, "{share}: {alone}");
        }
    }
}
