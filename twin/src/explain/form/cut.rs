//! A form that steps where a variable passes a value: a level in time, a slope beyond a size of the current.

use super::{LEAST_ROWS, Made, Says, Shape, current};
use crate::explain::locate::{Kind, Variable, variables};
use crate::explain::workbench::Workbench;
use crate::report::format::significant;

/// Each side of a step has this share of the energy of what steps, and [`LEAST_ROWS`].
const LEAST_SIDE: f64 = 0.01;

/// All of them.
pub(super) fn all<'a>(
    bench: &Workbench<'_>,
    residual: &[f64],
    says: Says<'a>,
) -> Vec<Box<dyn Shape + 'a>> {
    let time = Variable {
        kind: Kind::Time,
        name: "t_s",
        unit: "s".into(),
        values: bench.t_s.clone(),
    };
    let others = variables(bench).into_iter();
    // How fast the current changes makes no step of it.
    let others = others.filter(|variable| variable.kind != Kind::Rate);
    let one = vec![1.0; bench.len()];
    let mut all: Vec<Box<dyn Shape + 'a>> = Vec::new();
    for variable in std::iter::once(time).chain(others) {
        // Beyond a size of the current a slope of its own, as a second range has it; a slope for each sign is no step.
        if variable.kind != Kind::Size {
            all.push(Box::new(Cut::new(
                &variable,
                one.clone(),
                false,
                says,
                residual,
            )));
        }
        if variable.kind != Kind::Itself && says.has_slopes() {
            let x = current(bench).to_vec();
            all.push(Box::new(Cut::new(&variable, x, true, says, residual)));
        }
    }
    all
}

/// A level, or a slope over the current, that steps where a variable passes a value.
struct Cut<'a> {
    kind: Kind,
    name: &'static str,
    unit: String,
    variable: Vec<f64>,
    carrier: Vec<f64>,
    is_slope: bool,
    says: Says<'a>,
    /// The value, found in all rows: only those beside it tell it.
    at: Option<f64>,
}

impl<'a> Cut<'a> {
    fn new(
        variable: &Variable,
        carrier: Vec<f64>,
        is_slope: bool,
        says: Says<'a>,
        residual: &[f64],
    ) -> Self {
        let at = cut(&variable.values, &carrier, residual);
        Self {
            kind: variable.kind,
            name: variable.name,
            unit: variable.unit.clone(),
            variable: variable.values.clone(),
            carrier,
            is_slope,
            says,
            at,
        }
    }
}

/// Products of some rows' carrier with the residual, and with itself, summed.
fn sums(rows: impl Iterator<Item = usize>, carrier: &[f64], residual: &[f64]) -> (f64, f64) {
    rows.fold((0.0, 0.0), |(cr, cc), row| {
        let c = carrier[row];
        (cr + c * residual[row], cc + c * c)
    })
}

/// Where a residual over a carrier steps most: the least value of the variable beyond.
fn cut(variable: &[f64], carrier: &[f64], residual: &[f64]) -> Option<f64> {
    let mut order: Vec<usize> = (0..variable.len())
        .filter(|&row| variable[row].is_finite())
        .collect();
    order.sort_by(|&a, &b| variable[a].total_cmp(&variable[b]));
    let all = sums(order.iter().copied(), carrier, residual);
    let least = LEAST_SIDE * all.1;
    let mut below = (0.0, 0.0);
    let mut last = f64::NAN;
    let mut best: Option<(f64, f64)> = None;
    for (count, &row) in order.iter().enumerate() {
        let value = variable[row];
        let above = (all.0 - below.0, all.1 - below.1);
        let are_rows = count >= LEAST_ROWS && order.len() - count >= LEAST_ROWS;
        if value > last && are_rows && below.1 > least && above.1 > least {
            let takes = below.0 * below.0 / below.1 + above.0 * above.0 / above.1;
            if best.is_none_or(|(most, _)| takes > most) {
                best = Some((takes, value));
            }
        }
        below.0 += carrier[row] * residual[row];
        below.1 += carrier[row] * carrier[row];
        last = value;
    }
    best.map(|(_, at)| at)
}

impl Shape for Cut<'_> {
    fn id(&self) -> &'static str {
        match (self.kind, self.is_slope) {
            (Kind::Time, false) => "step",
            (Kind::Time, true) => "slope-step",
            (_, false) => "step-over",
            (_, true) => "slope-step-over",
        }
    }

    fn size(&self) -> usize {
        3
    }

    fn made(&self, residual: &[f64], trained: &[bool]) -> Option<Made> {
        let at = self.at?;
        let side = |is_above: bool| {
            let rows = (0..residual.len()).filter(|&row| {
                let value = self.variable[row];
                trained[row] && value.is_finite() && (value >= at) == is_above
            });
            let (cr, cc) = sums(rows, &self.carrier, residual);
            if cc > 0.0 { cr / cc } else { 0.0 }
        };
        let [low, high] = [side(false), side(true)];
        let pairs = self.variable.iter().zip(&self.carrier);
        let series = pairs
            .map(|(value, carrier)| match value.partial_cmp(&at) {
                Some(std::cmp::Ordering::Less) => low * carrier,
                Some(_) => high * carrier,
                None => 0.0,
            })
            .collect();
        Some(Made {
            series,
            values: vec![at, low, high],
        })
    }

    fn told(&self, values: &[f64]) -> String {
        let at = values[0];
        let [low, high] = if self.is_slope {
            self.says.slopes([values[1], values[2]])
        } else {
            self.says.levels([values[1], values[2]])
        };
        if self.kind == Kind::Time {
            format!("{low} until {at:.1} s, {high} from then on")
        } else {
            let (name, unit) = (self.name, &self.unit);
            let at = significant(at, 4);
            format!("{low} where {name} is below {at} {unit}, {high} from there on")
        }
    }
}
