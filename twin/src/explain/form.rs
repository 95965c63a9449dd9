//! The form of what is left where no effect accounts for it: a step in time, a slope of its own for each direction, a curve, a
//! limit of speed. No physics and no name of the library, but what to look for: which of a few simple functions of the recorded
//! inputs takes what is left, tried on blocks that it was not fitted on.

mod cut;
mod followed;
mod linear;
mod toward_zero;

use rayon::prelude::*;

use super::normal::dot;
use super::workbench::Workbench;
use crate::problem::View;
use crate::report::data::{Form, OtherForm};
use crate::report::format::significant;

/// Parts that are tried in turn on what was fitted without them.
const FOLDS: usize = 5;
/// Fewer blocks tell nothing of a function that was found in the others.
const LEAST_BLOCKS: usize = 2 * FOLDS;
/// A form is told from this share of what is left beyond the noise on, in energy on parts that it was not fitted on: a step or a line
/// takes nine tenths of many a random walk.
const TOLD: f64 = 0.95;
/// What is left is beyond the noise from this share of the noise's energy on.
pub(super) const BEYOND: f64 = 0.2;
/// Two forms are told apart by the sum of what one is better by, block by block, from so many of its standard deviations on.
const APART: f64 = 2.0;
/// Rows that a stretch of a variable has at least, of which a form has a value of its own.
const LEAST_ROWS: usize = 20;
/// Forms that the readings do not tell apart and that are named beside each other.
const MOST: usize = 3;

/// What a form makes of the rows, and with which values.
struct Made {
    series: Vec<f64>,
    values: Vec<f64>,
}

/// One form.
trait Shape: Sync + Send {
    /// Its id in the report.
    fn id(&self) -> &'static str;

    /// How many values it has.
    fn size(&self) -> usize;

    /// Fitted to a residual at the rows that are trained on.
    fn made(&self, residual: &[f64], trained: &[bool]) -> Option<Made>;

    /// In words.
    fn told(&self, values: &[f64]) -> String;

    /// What it leaves of a row with noise of this rms ahead of it, squared.
    fn leaves(&self, _row: usize, noise: f64) -> f64 {
        noise * noise
    }
}

/// The form of a residual over a bench's rows; `noise`: what a true model would leave, rms, 0 if that is not known. `None` where
/// no form takes nearly all that is beyond the noise.
pub(super) fn form(bench: &Workbench<'_>, residual: &[f64], noise: f64) -> Option<Form> {
    if bench.blocks.len() < LEAST_BLOCKS {
        return None;
    }
    let fold_of = folds(bench);
    let energies = |made: &dyn Fn(usize) -> f64| -> Vec<f64> {
        let blocks = bench.blocks.iter().cloned();
        blocks
            .map(|rows| rows.map(|row| (residual[row] - made(row)).powi(2)).sum())
            .collect()
    };
    let before: f64 = energies(&|_| 0.0).iter().sum();
    let rows: usize = bench.blocks.iter().map(ExactSizeIterator::len).sum();
    let quiet = noise * noise * rows as f64;
    if before.is_nan() || before - quiet <= BEYOND * quiet {
        return None;
    }
    let trained: Vec<Vec<bool>> = (0..FOLDS)
        .map(|fold| {
            let of = fold_of.iter();
            of.map(|of| of.is_some_and(|of| of != fold)).collect()
        })
        .collect();
    let mut tried: Vec<(Box<dyn Shape + '_>, Vec<f64>)> = shapes(bench, residual, noise)
        .into_par_iter()
        .filter_map(|shape| {
            let mut made = vec![0.0; residual.len()];
            for (fold, trained) in trained.iter().enumerate() {
                let series = shape.made(residual, trained)?.series;
                let held = (0..series.len()).filter(|&row| fold_of[row] == Some(fold));
                held.for_each(|row| made[row] = series[row]);
            }
            let left = energies(&|row| made[row]);
            let taken = before - left.iter().sum::<f64>();
            let held = (0..residual.len()).filter(|&row| fold_of[row].is_some());
            let quiet: f64 = held.map(|row| shape.leaves(row, noise)).sum();
            let beyond = before - quiet;
            (beyond > BEYOND * quiet && taken >= TOLD * beyond).then_some((shape, left))
        })
        .collect();
    let total = |left: &[f64]| left.iter().sum::<f64>();
    tried.sort_by(|a, b| total(&a.1).total_cmp(&total(&b.1)));
    let best = tried.first()?.1.clone();
    tried.retain(|(_, left)| !is_worse(left, &best));
    // Of those that the readings do not tell apart the plainest.
    let plainest = tried.iter().map(|(shape, _)| shape.size()).min()?;
    tried.retain(|(shape, _)| shape.size() == plainest);
    if tried.iter().any(|(shape, _)| shape.id() == linear::LINE) {
        return None;
    }
    tried.truncate(MOST);
    let all: Vec<bool> = fold_of.iter().map(Option::is_some).collect();
    let rmse = (total(&tried.first()?.1) / rows.max(1) as f64).sqrt();
    let mut told = tried.iter().filter_map(|(shape, _)| {
        let made = shape.made(residual, &all)?;
        Some(OtherForm {
            id: shape.id().to_owned(),
            description: shape.told(&made.values),
        })
    });
    let OtherForm { id, description } = told.next()?;
    Some(Form {
        id,
        description,
        equivalent_to: told.collect(),
        rmse,
    })
}

/// The part that each row is held out with; none between blocks.
fn folds(bench: &Workbench<'_>) -> Vec<Option<usize>> {
    let mut fold_of = vec![None; bench.len()];
    for (block, rows) in bench.blocks.iter().enumerate() {
        fold_of[rows.clone()].fill(Some(block % FOLDS));
    }
    fold_of
}

/// Whether more is left of each block than of a better form, by more than chance.
fn is_worse(left: &[f64], best: &[f64]) -> bool {
    let more: Vec<f64> = left.iter().zip(best).map(|(l, b)| l - b).collect();
    more.iter().sum::<f64>() > APART * dot(&more, &more).sqrt()
}

/// All forms that the recording has the inputs of.
fn shapes<'a>(bench: &'a Workbench<'_>, residual: &[f64], noise: f64) -> Vec<Box<dyn Shape + 'a>> {
    let says = Says::of(bench);
    let mut shapes = linear::all(bench, says);
    shapes.extend(cut::all(bench, residual, says));
    if bench.problem.view == View::Sensor {
        shapes.extend(followed::all(bench, residual, says));
        shapes.extend(toward_zero::of(bench, residual, noise, says));
    }
    shapes
}

/// What readings are looked at over: what a sensor or a counter was to read, and the current of a battery.
fn current<'a>(bench: &'a Workbench<'_>) -> &'a [f64] {
    match bench.problem.view {
        View::Sensor | View::Charge => &bench.plain,
        View::Voltage | View::StateOfCharge => &bench.reference,
    }
}

/// How values are said.
#[derive(Clone, Copy)]
struct Says<'a> {
    unit: &'a str,
    symbol: &'static str,
    /// The unit of what is read over: amperes, but for a sensor of something else.
    of: &'a str,
    view: View,
}

impl<'a> Says<'a> {
    fn of(bench: &'a Workbench<'_>) -> Self {
        let unit = bench.problem.unit.as_str();
        let view = bench.problem.view;
        let of = if view == View::Sensor { unit } else { "A" };
        Self {
            unit,
            symbol: if of == "A" { "i" } else { "x" },
            of,
            view,
        }
    }

    /// Whether something may be off in proportion to the current: a state of charge is no answer to it.
    fn has_slopes(&self) -> bool {
        self.view != View::StateOfCharge
    }

    fn is_voltage(&self) -> bool {
        self.view == View::Voltage
    }

    fn levels(&self, values: [f64; 2]) -> [String; 2] {
        alike(values).map(|value| format!("{value} {}", self.unit))
    }

    /// Of what is proportional to the current, with its unit. Discharge is positive: more resistance is less voltage.
    fn factor(&self) -> (f64, String) {
        if self.is_voltage() {
            (-1.0, " Ω".into())
        } else {
            (100.0, format!(" % of {}", self.symbol))
        }
    }

    fn slope(&self, value: f64) -> String {
        let (factor, unit) = self.factor();
        format!("{}{unit}", signed(factor * value))
    }

    fn slopes(&self, values: [f64; 2]) -> [String; 2] {
        let (factor, unit) = self.factor();
        alike(values.map(|value| factor * value)).map(|value| format!("{value}{unit}"))
    }

    /// What of a step is read, that is off by so much of it.
    fn of_step(&self, off: f64) -> String {
        if self.is_voltage() {
            format!("{} Ω", signed(-off))
        } else {
            format!("{} %", significant(100.0 * (1.0 + off), 5))
        }
    }
}

/// With its sign.
fn signed(value: f64) -> String {
    let sign = if value < 0.0 { "−" } else { "+" };
    format!("{sign}{}", significant(value.abs(), 3))
}

/// Two values with their signs, to the same place.
fn alike(values: [f64; 2]) -> [String; 2] {
    let place = place_of(&values);
    values.map(|value| at_place(value, place))
}

/// The place to which the largest of some values has three digits.
fn place_of(values: &[f64]) -> f64 {
    let most = values
        .iter()
        .fold(0.0, |most: f64, value| most.max(value.abs()));
    10f64.powf(most.log10().floor() - 2.0)
}

/// A value with its sign, to a place: what is next to nothing is nothing.
fn at_place(value: f64, place: f64) -> String {
    if value.abs() < 0.5 * place || place == 0.0 {
        "0".into()
    } else {
        signed((value / place).round() * place)
    }
}

#[cfg(test)]
mod tests;
