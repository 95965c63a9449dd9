//! Whether a recording that began at another state of charge than the simulation would look like what is named.

use super::fit::fit;
use super::held_out::held_out;
use super::robust::loss;
use super::select::{self, Selection};
use super::slope::BASE_OFF;
use super::told::start_of;
use super::workbench::{Model, Workbench};
use crate::model::BEYOND_SOC;
use crate::problem::{Base, Problem};
use crate::report::format::percent;

/// Standard uncertainty with which a start may be anywhere from empty to full.
const ANYWHERE: f64 = 1.0 / BASE_OFF;
/// Share of a mismatch, nothing being named, from which on it is told that a start would take it.
const TOLD: f64 = 0.5;

/// In words, as "if …", if starts that are off by more than their uncertainty account for as much as the named effects, or, where
/// nothing is named, for most of the mismatch.
pub(super) fn elsewhere(bench: &Workbench<'_>, selection: &Selection) -> Option<String> {
    let Base::Battery(base) = &bench.problem.base else {
        return None;
    };
    let mut free = bench.problem.clone();
    if let Base::Battery(base) = &mut free.base {
        base.initial_soc_sigma = vec![ANYWHERE; free.drive.operations().len()];
    }
    let read = Workbench::new(&free, &[]);
    let white = if bench.is_white() {
        read.whitened()
    } else {
        None
    };
    let moved = white.as_ref().unwrap_or(&read);
    let found = fit(moved, &Model::default(), None);
    let (operation, shift) = found.model.nuisance.largest_soc_shift()?;
    let sigma = base
        .initial_soc_sigma
        .get(operation)
        .copied()
        .unwrap_or_default();
    let stated = begin_of(bench.problem, operation)?;
    let there = stated + shift;
    if shift.abs() <= BASE_OFF * sigma || !(-BEYOND_SOC..=1.0 + BEYOND_SOC).contains(&there) {
        return None;
    }
    let condition = format!(
        "if the state of charge {} was {:.1} % and not {:.1} %",
        if operation == 0 {
            "at the start".to_owned()
        } else {
            start_of(operation)
        },
        100.0 * there,
        100.0 * stated
    );
    let plain = &selection.plain;
    if selection.named.is_empty() {
        let sigma = plain.sigma.min(found.sigma);
        let taken = 1.0 - loss(&found.residual, sigma) / loss(&plain.residual, sigma).max(1e-300);
        return (taken >= TOLD).then(|| format!("{condition}, {} of it is gone", percent(taken)));
    }
    let sigma = found.sigma.min(selection.fit.sigma);
    let theirs = held_out(moved, &found, sigma).concat();
    let ours = held_out(bench, &selection.fit, sigma).concat();
    (!select::worse(&theirs, &ours, 0.0)).then_some(condition)
}

/// State of charge at the start of an operation as the simulation has it, 0 … 1.
fn begin_of(problem: &Problem, operation: usize) -> Option<f64> {
    let Base::Battery(base) = &problem.base else {
        return None;
    };
    let numbers = problem.drive.operation_numbers();
    let segment = numbers.iter().position(|number| *number == operation)?;
    base.initial_soc.get(segment).copied()
}
