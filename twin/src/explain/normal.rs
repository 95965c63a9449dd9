//! Normal equations: sums over rows, and their solution.

use std::ops::Range;

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};

/// Sums that are kept side by side.
const LANES: usize = 8;

/// Sum of what a function makes of two series, in lanes.
pub(super) fn sum_of(a: &[f64], b: &[f64], part: impl Fn(f64, f64) -> f64) -> f64 {
    let (a_chunks, a_rest) = a.as_chunks::<LANES>();
    let (b_chunks, b_rest) = b.as_chunks::<LANES>();
    let mut lanes = [0.0; LANES];
    for (x, y) in a_chunks.iter().zip(b_chunks) {
        for lane in 0..LANES {
            lanes[lane] += part(x[lane], y[lane]);
        }
    }
    let rest: f64 = a_rest.iter().zip(b_rest).map(|(x, y)| part(*x, *y)).sum();
    lanes.iter().sum::<f64>() + rest
}

/// Sum of products, in lanes.
pub fn dot(a: &[f64], b: &[f64]) -> f64 {
    sum_of(a, b, |x, y| x * y)
}

/// The rows from the first to the last that is not nothing, in whole lanes: sums over them are the same to the last digit.
fn reach(column: &[f64], start: usize) -> std::ops::Range<usize> {
    let is_some = |value: &f64| *value != 0.0;
    let first = column.iter().position(is_some).unwrap_or(column.len());
    let last = column
        .iter()
        .rposition(is_some)
        .map_or(first, |last| last + 1);
    let last = last.next_multiple_of(LANES).min(column.len());
    start + first - first % LANES..start + last
}

/// Normal equations over some rows: JᵀWJ and JᵀWr.
pub fn normal(
    columns: &[Vec<f64>],
    weights: &[f64],
    residual: &[f64],
    rows: Range<usize>,
) -> (DMatrix<f64>, DVector<f64>) {
    let size = columns.len();
    let mut matrix = DMatrix::zeros(size, size);
    let mut right = DVector::zeros(size);
    let mut weighted = vec![0.0; rows.len()];
    // Where an operation begins tells in its own rows alone.
    let reaches: Vec<std::ops::Range<usize>> = columns
        .iter()
        .map(|column| reach(&column[rows.clone()], rows.start))
        .collect();
    for a in 0..size {
        let own = reaches[a].clone();
        let weighted = &mut weighted[..own.len()];
        let pairs = columns[a][own.clone()].iter().zip(&weights[own.clone()]);
        for (out, (value, weight)) in weighted.iter_mut().zip(pairs) {
            *out = value * weight;
        }
        right[a] = dot(weighted, &residual[own.clone()]);
        for b in 0..=a {
            let (from, to) = (own.start.max(reaches[b].start), own.end.min(reaches[b].end));
            if from < to {
                let here = &weighted[from - own.start..to - own.start];
                let sum = dot(here, &columns[b][from..to]);
                matrix[(a, b)] = sum;
                matrix[(b, a)] = sum;
            }
        }
    }
    (matrix, right)
}

/// Forgets what is known of some values: a solution leaves them where they are.
pub(super) fn forget(which: &[usize], matrix: &mut DMatrix<f64>) {
    for &k in which {
        matrix.row_mut(k).fill(0.0);
        matrix.column_mut(k).fill(0.0);
    }
}

/// A normal matrix made ready to be solved, with a little damping, scaled by the diagonal.
#[derive(Clone, Debug)]
pub struct Solver {
    /// Without end where nothing is known.
    scale: Vec<f64>,
    factor: Option<Cholesky<f64, Dyn>>,
}

impl Solver {
    /// Of a matrix.
    pub fn new(matrix: &DMatrix<f64>, damping: f64) -> Self {
        let size = matrix.nrows();
        let scale: Vec<f64> = (0..size)
            .map(|k| {
                let d = matrix[(k, k)];
                if d > 0.0 { d.sqrt() } else { f64::INFINITY }
            })
            .collect();
        let mut scaled = DMatrix::zeros(size, size);
        for a in 0..size {
            for b in 0..size {
                scaled[(a, b)] = matrix[(a, b)] / (scale[a] * scale[b]);
            }
            scaled[(a, a)] += damping + 1e-12;
            if matrix[(a, a)] <= 0.0 {
                scaled[(a, a)] = 1.0;
            }
        }
        Self {
            scale,
            factor: scaled.cholesky(),
        }
    }

    /// Puts the solution in place of the right side; zero where nothing is known.
    pub fn solve(&self, right: &mut DVector<f64>) {
        let Some(factor) = &self.factor else {
            right.fill(0.0);
            return;
        };
        for (value, scale) in right.iter_mut().zip(&self.scale) {
            *value /= scale;
        }
        factor.solve_mut(right);
        for (value, scale) in right.iter_mut().zip(&self.scale) {
            *value /= scale;
        }
    }

    /// Whether a part of the matrix has this share, 0 … 1, of all that is known of some combination of the values.
    pub(super) fn tells(&self, part: &DMatrix<f64>, share: f64) -> bool {
        let Some(factor) = &self.factor else {
            return false;
        };
        let scaled = DMatrix::from_fn(part.nrows(), part.ncols(), |a, b| {
            part[(a, b)] / (self.scale[a] * self.scale[b])
        });
        let half = factor.l_dirty().solve_lower_triangular(&scaled);
        let whole =
            half.and_then(|half| factor.l_dirty().solve_lower_triangular(&half.transpose()));
        // None of the eigenvalues is negative: the largest is no more than their sum.
        whole
            .filter(|whole| whole.trace() >= share)
            .is_some_and(|whole| whole.symmetric_eigenvalues().max() >= share)
    }

    /// Rows in parts of which each tells as much of the values as any other.
    pub(super) fn parts(
        &self,
        columns: &[Vec<f64>],
        weights: &[f64],
        rows: Range<usize>,
        count: usize,
    ) -> Vec<Range<usize>> {
        let mut sum = 0.0;
        let sums: Vec<f64> = rows
            .clone()
            .map(|row| {
                let here = DVector::from_iterator(columns.len(), columns.iter().map(|c| c[row]));
                let mut solved = here.clone();
                self.solve(&mut solved);
                sum += weights[row] * here.dot(&solved);
                sum
            })
            .collect();
        let mut from = rows.start;
        (1..=count)
            .map(|part| {
                let share = sum * part as f64 / count as f64;
                let to = if part == count {
                    rows.end
                } else {
                    rows.start + sums.partition_point(|sum| *sum < share)
                };
                let part = from..to.max(from);
                from = part.end;
                part
            })
            .collect()
    }
}

/// Solves with a little damping, scaled by the diagonal; zero where nothing is known.
pub fn solve(matrix: &DMatrix<f64>, right: &DVector<f64>, damping: f64) -> DVector<f64> {
    let mut solved = right.clone();
    if !solved.is_empty() {
        Solver::new(matrix, damping).solve(&mut solved);
    }
    solved
}
