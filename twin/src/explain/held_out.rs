//! What a fit says of rows that it was not made of.

use std::ops::Range;
use std::sync::Arc;

use nalgebra::{DMatrix, DVector};

use super::fit::Fit;
use super::normal::{Solver, normal, solve};
use super::robust::{huber, weights};
use super::slope::Slope;
use super::starts;
use super::workbench::Workbench;

/// A block that has this share of all that is known of a value is left out in parts.
const ALONE: f64 = 0.9;
/// So many.
const PARTS: usize = 4;

/// A fit seen from its blocks: what each block says about every coordinate, and how well each is predicted by the others.
#[derive(Debug)]
pub struct Blocked {
    /// The slope at the fit.
    pub slope: Arc<Slope>,
    /// Normal matrix of each block.
    pub matrices: Vec<DMatrix<f64>>,
    /// Right side of each block.
    pub rights: Vec<DVector<f64>>,
    /// Huber's weights of the rows.
    weights: Vec<f64>,
}

/// Looks at a fit block by block, with Huber's weights at `sigma`.
pub fn blocked(bench: &Workbench<'_>, fit: &Fit, sigma: f64) -> Blocked {
    let slope = fit.slope(bench);
    let weights = weights(&fit.residual, sigma);
    let (matrices, rights) = bench
        .blocks
        .iter()
        .map(|rows| normal(&slope.columns, &weights, &fit.residual, rows.clone()))
        .unzip();
    Blocked {
        slope,
        matrices,
        rights,
        weights,
    }
}

/// Loss of each row of each block under a model whose values come from the other blocks only (one Gauss–Newton step from the whole fit,
/// exact where the simulation is linear in its values), in units of sigma². A block that alone tells some of the values is left out
/// in parts: the others would say nothing of it, or anything.
pub fn held_out(bench: &Workbench<'_>, fit: &Fit, sigma: f64) -> Vec<Vec<f64>> {
    let blocked = blocked(bench, fit, sigma);
    let size = blocked.slope.len();
    let mut total = DMatrix::zeros(size, size);
    let mut right = DVector::zeros(size);
    blocked.slope.penalty(&mut total, &mut right);
    for (matrix, part) in blocked.matrices.iter().zip(&blocked.rights) {
        total += matrix;
        right += part;
    }
    let weights = &blocked.weights;
    let slope = &blocked.slope;
    // A start that only these rows tell.
    let untold = |here: &DMatrix<f64>, k: usize| {
        let all = total[(k, k)] - slope.prior[k];
        bench.starts.len() > 1 && starts::within_block(here[(k, k)], all)
    };
    // Loss of rows with the values that are left without them.
    let without = |rows: Range<usize>, here: &DMatrix<f64>, part: &DVector<f64>| -> Vec<f64> {
        let (mut matrix, mut others) = (&total - here, &right - part);
        let at_ends = Some((&fit.model, &right));
        slope.keep(at_ends, (&mut matrix, &mut others), |_, k| untold(here, k));
        let step = solve(&matrix, &others, 1e-9);
        rows.map(|row| {
            let columns = slope.columns.iter().zip(step.iter());
            let moved: f64 = columns.map(|(column, step)| column[row] * step).sum();
            huber((fit.residual[row] - moved) / sigma)
        })
        .collect()
    };
    let solver = Solver::new(&total, 1e-9);
    bench
        .blocks
        .iter()
        .zip(blocked.matrices.iter().zip(&blocked.rights))
        .map(|(rows, (matrix, part))| {
            let (mut told, mut ignored) = (matrix.clone(), part.clone());
            slope.keep(None, (&mut told, &mut ignored), |_, k| untold(matrix, k));
            if solver.most_of(&told, ALONE) < ALONE {
                return without(rows.clone(), matrix, part);
            }
            let parts = solver.parts(&slope.columns, weights, rows.clone(), PARTS);
            let losses = parts.into_iter().flat_map(|rows| {
                let (matrix, part) = normal(&slope.columns, weights, &fit.residual, rows.clone());
                without(rows, &matrix, &part)
            });
            losses.collect()
        })
        .collect()
}
