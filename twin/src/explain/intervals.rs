//! 95 % intervals of a model's values by block bootstrap: blocks of rows are drawn with replacement, so that the colour of the
//! noise counts; each draw is one Gauss–Newton step from the whole fit.

use nalgebra::{DMatrix, DVector};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng as _, SeedableRng as _};
use rand_distr::{Distribution as _, StandardNormal};

use super::fit::{Fit, blocked, loss, solve};
use super::workbench::Workbench;
use crate::effects::Search;

/// Bootstrap draws.
const DRAWS: usize = 1000;

/// An interval for each parameter of each member; for values that are searched in steps, their resolution.
pub fn intervals(bench: &Workbench<'_>, fit: &Fit, seed: u64) -> Vec<Vec<[f64; 2]>> {
    let blocked = blocked(bench, fit, fit.sigma);
    let blocks = blocked.matrices.len();
    let size = blocked.slope.len();
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut draws: Vec<DVector<f64>> = Vec::with_capacity(DRAWS);
    // Blocks drawn are fewer than blocks seen by the values fitted in them.
    let widen = (blocks as f64 / (blocks as f64 - 1.0).max(1.0)).sqrt() * 1.06;
    // Where the whole would step to, were it not at its optimum to the last digit, is no spread.
    let mut matrix = DMatrix::zeros(size, size);
    let mut right = DVector::zeros(size);
    for (part, side) in blocked.matrices.iter().zip(&blocked.rights) {
        matrix += part;
        right += side;
    }
    blocked.slope.belief(&mut matrix, &mut right, || 0.0);
    let whole = solve(&matrix, &right, 1e-9);
    for _ in 0..DRAWS {
        let mut matrix = DMatrix::zeros(size, size);
        let mut right = DVector::zeros(size);
        for _ in 0..blocks {
            let block = (random.next_u32() as usize) % blocks.max(1);
            matrix += &blocked.matrices[block];
            right += &blocked.rights[block];
        }
        // What the model file says of the base is as uncertain as it says.
        blocked.slope.belief(&mut matrix, &mut right, || {
            StandardNormal.sample(&mut random)
        });
        draws.push((solve(&matrix, &right, 1e-9) - &whole) * widen);
    }
    fit.model
        .members
        .iter()
        .enumerate()
        .map(|(m, member)| {
            member
                .effect
                .card()
                .parameters
                .iter()
                .enumerate()
                .map(|(p, parameter)| {
                    let value = member.values[p];
                    if parameter.search == Search::Stepped {
                        return [
                            profile(bench, fit, m, p, -1.0),
                            profile(bench, fit, m, p, 1.0),
                        ];
                    }
                    let mut values: Vec<f64> = draws
                        .iter()
                        .filter_map(|draw| {
                            blocked.slope.value_at(m, p, &fit.model, draw.as_slice())
                        })
                        .collect();
                    if values.is_empty() {
                        return [value, value];
                    }
                    values.sort_unstable_by(f64::total_cmp);
                    let at =
                        |share: f64| values[((values.len() - 1) as f64 * share).round() as usize];
                    [at(0.025), at(0.975)]
                })
                .collect()
        })
        .collect()
}

/// How far a value can go to one side before the loss has risen by what bounds a 95 % interval (profile likelihood, χ² with one
/// degree of freedom), the others staying.
fn profile(bench: &Workbench<'_>, fit: &Fit, member: usize, parameter: usize, sign: f64) -> f64 {
    const RISE: f64 = 0.5 * 3.84;
    let value = fit.model.members[member].values[parameter];
    let loss = |residual: &[f64]| loss(residual, fit.sigma);
    let here = loss(&fit.residual);
    let mut share = 1e-6;
    let mut last = value;
    while share < 0.5 {
        let there = value * (1.0 + sign * share);
        let mut model = fit.model.clone();
        model.members[member].values[parameter] = there;
        if loss(&bench.residual(&bench.run(&model))) > here + RISE {
            return there;
        }
        last = there;
        share *= 1.6;
    }
    last
}
