//! What a fit says of rows that it was not made of.

use std::ops::Range;

use nalgebra::{DMatrix, DVector};

use super::fit::Fit;
use super::normal::{Solver, forget, normal, solve};
use super::robust::{huber, weights};
use super::starts;
use super::workbench::Workbench;

/// A block that has this share of all that is known of a value is left out in parts.
const ALONE: f64 = 0.9;
/// So many.
const PARTS: usize = 4;

/// Loss of each row of each block under a model whose values come from the other blocks only (one Gauss–Newton step from the whole fit,
/// exact where the simulation is linear in its values), in units of sigma². A block that alone tells some of the values is left out
/// in parts: the others would say nothing of it, or anything.
pub fn held_out(bench: &Workbench<'_>, fit: &Fit, sigma: f64) -> Vec<Vec<f64>> {
    let slope = fit.slope(bench);
    let weights = weights(&fit.residual, sigma);
    // What some rows say about every value.
    let says = |rows: Range<usize>| normal(&slope.columns, &weights, &fit.residual, rows);
    let blocks: Vec<_> = bench.blocks.iter().cloned().map(says).collect();
    let size = slope.len();
    let mut total = DMatrix::zeros(size, size);
    let mut right = DVector::zeros(size);
    slope.penalty(&mut total, &mut right);
    for (matrix, part) in &blocks {
        total += matrix;
        right += part;
    }
    // Starts that only these rows tell.
    let untold = |rows: &Range<usize>, here: &DMatrix<f64>| {
        let told = |k: usize, rows: Range<usize>| -> f64 {
            let of_row = |row: usize| weights[row] * slope.columns[k][row].powi(2);
            rows.map(of_row).sum()
        };
        slope.starts(|start, k| {
            let Some(start) = start.map(|start| &bench.starts[start]) else {
                return starts::within_block(here[(k, k)], total[(k, k)] - slope.prior[k]);
            };
            if !start.is_shared() {
                let all = total[(k, k)] - slope.prior[k];
                return bench.starts.len() > 1 && starts::within_block(here[(k, k)], all);
            }
            // What follows another gap tells of both.
            let own = start.own_rows().iter();
            let (inside, all) = own.fold((0.0, 0.0), |(inside, all), own| {
                let within = own.start.max(rows.start)..own.end.min(rows.end);
                (inside + told(k, within), all + told(k, own.clone()))
            });
            starts::within_block(inside, all)
        })
    };
    // Loss of rows with the values that are left without them.
    let without = |rows: Range<usize>, here: &DMatrix<f64>, part: &DVector<f64>| -> Vec<f64> {
        let (mut matrix, others) = (&total - here, &right - part);
        let mut left = slope.at_ends(&fit.model, &right);
        left.extend(untold(&rows, here));
        forget(&left, &mut matrix);
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
        .zip(&blocks)
        .map(|(rows, (matrix, part))| {
            let mut told = matrix.clone();
            forget(&untold(rows, matrix), &mut told);
            if !solver.tells(&told, ALONE) {
                return without(rows.clone(), matrix, part);
            }
            let parts = solver.parts(&slope.columns, &weights, rows.clone(), PARTS);
            let losses = parts.into_iter().flat_map(|rows| {
                let (matrix, part) = says(rows.clone());
                without(rows, &matrix, &part)
            });
            losses.collect()
        })
        .collect()
}
