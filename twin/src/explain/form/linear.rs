//! Forms that are a weighted sum of a few columns: curves, drifts, slopes of their own, what follows another quantity, a memory.

use super::{LEAST_ROWS, Made, Says, Shape, at_place, current, place_of, signed};
use crate::effects::scene::Steps;
use crate::explain::flexible::at_rows;
use crate::explain::locate::{Kind, variables};
use crate::explain::normal::{normal, solve};
use crate::explain::shape::hats_between;
use crate::explain::workbench::Workbench;
use crate::problem::View;
use crate::report::format::significant;

/// A slope is that of a lost sign within this.
const SIGN_LOST: f64 = 0.02;
/// Times that a memory is made of, each three times the one before, from a step of the recording on to a quarter of its length.
const TIMES: usize = 8;

/// Stretches of the current over each of which a curve of any shape is a straight line.
const STRETCHES: usize = 12;
/// Places at which such a curve is told.
const PLACES: usize = 7;

/// Damping of the normal equations, as a share of each column's own energy: times of a memory are much alike.
const DAMPING: f64 = 1e-12;

/// What a linear form's values say.
type Told<'a> = Box<dyn Fn(&[f64]) -> String + Sync + Send + 'a>;

/// A weighted sum of columns.
struct Linear<'a> {
    id: &'static str,
    columns: Vec<Vec<f64>>,
    told: Told<'a>,
}

impl Shape for Linear<'_> {
    fn id(&self) -> &'static str {
        self.id
    }

    fn size(&self) -> usize {
        self.columns.len()
    }

    fn made(&self, residual: &[f64], trained: &[bool]) -> Option<Made> {
        let weights: Vec<f64> = trained.iter().map(|t| f64::from(u8::from(*t))).collect();
        let (matrix, right) = normal(&self.columns, &weights, residual, 0..residual.len());
        let values: Vec<f64> = solve(&matrix, &right, DAMPING).iter().copied().collect();
        let mut series = vec![0.0; residual.len()];
        for (column, value) in self.columns.iter().zip(&values) {
            let pairs = series.iter_mut().zip(column);
            pairs.for_each(|(made, column)| *made += value * column);
        }
        series
            .iter()
            .all(|made| made.is_finite())
            .then_some(Made { series, values })
    }

    fn told(&self, values: &[f64]) -> String {
        (self.told)(values)
    }
}

impl<'a> Linear<'a> {
    fn new(
        id: &'static str,
        columns: Vec<Vec<f64>>,
        told: impl Fn(&[f64]) -> String + Sync + Send + 'a,
    ) -> Self {
        Self {
            id,
            columns,
            told: Box::new(told),
        }
    }
}

/// All of them.
pub(super) fn all<'a>(bench: &'a Workbench<'_>, says: Says<'a>) -> Vec<Box<dyn Shape + 'a>> {
    let mut all = vec![line(bench)];
    all.extend(drifts(bench, says));
    all.extend(around(bench, says));
    if says.has_slopes() {
        all.extend([direction(bench, says), sign(bench, says)]);
        all.extend(curves(bench, says));
        all.extend(curve(bench, says));
    }
    // A counter's differences are means over more than a row.
    if matches!(says.view, View::Sensor | View::Voltage) {
        all.extend(memory(bench, says));
    }
    if says.is_voltage() {
        let columns = vec![vec![1.0; bench.len()], bench.plain.clone()];
        all.push(Linear::new("itself", columns, |values| {
            format!("{} % of the voltage itself", signed(100.0 * values[1]))
        }));
    }
    all.into_iter()
        .map(|linear| Box::new(linear) as Box<dyn Shape + 'a>)
        .collect()
}

fn times(a: &[f64], b: &[f64]) -> Vec<f64> {
    a.iter().zip(b).map(|(a, b)| a * b).collect()
}

/// What an offset and a gain make (of a state of charge its start and the capacity), which the library has: a form that is no better is
/// none.
pub(super) const LINE: &str = "line";

fn line<'a>(bench: &Workbench<'_>) -> Linear<'a> {
    let over = match bench.problem.view {
        View::StateOfCharge => &bench.plain,
        _ => current(bench),
    };
    let columns = vec![vec![1.0; bench.len()], over.to_vec()];
    Linear::new(LINE, columns, |_| "a straight line".into())
}

/// An amount for each direction, however large the current.
fn sign<'a>(bench: &Workbench<'_>, says: Says<'a>) -> Linear<'a> {
    let x = current(bench);
    let sign = x
        .iter()
        .map(|x| f64::from(i8::from(*x > 0.0) - i8::from(*x < 0.0)));
    let columns = vec![x.to_vec(), sign.collect()];
    Linear::new("sign", columns, move |values| {
        let [above, below] = says.levels([values[1], -values[1]]);
        let (symbol, slope) = (says.symbol, says.slope(values[0]));
        format!("{above} where {symbol} > 0, {below} where {symbol} < 0, and {slope}")
    })
}

/// A slope for each direction of the current.
fn direction<'a>(bench: &Workbench<'_>, says: Says<'a>) -> Linear<'a> {
    let x = current(bench);
    let columns = vec![
        x.iter().map(|x| x.max(0.0)).collect(),
        x.iter().map(|x| x.min(0.0)).collect(),
    ];
    Linear::new("direction", columns, move |values| {
        let is_lost = |here: f64, there: f64| {
            !says.is_voltage() && (here + 2.0).abs() < SIGN_LOST && there.abs() < SIGN_LOST
        };
        let [above, below] = [values[0], values[1]];
        let lost = if is_lost(above, below) || is_lost(below, above) {
            ": the sign is lost"
        } else {
            ""
        };
        let [above, below] = says.slopes([above, below]);
        let symbol = says.symbol;
        format!("{above} where {symbol} > 0, {below} where {symbol} < 0{lost}")
    })
}

/// Its square, and its cube.
fn curves<'a>(bench: &Workbench<'_>, says: Says<'a>) -> [Linear<'a>; 2] {
    let x = current(bench);
    let square = times(x, x);
    let cube = times(&square, x);
    let Says {
        unit, of, symbol, ..
    } = says;
    [
        ("square", square, "²", format!("{unit}/{of}²")),
        ("cube", cube, "³", format!("{unit}/{of}³")),
    ]
    .map(|(id, column, power, factor)| {
        let columns = vec![vec![1.0; bench.len()], x.to_vec(), column];
        Linear::new(id, columns, move |values| {
            let (level, slope) = (signed(values[0]), says.slope(values[1]));
            let size = signed(values[2]);
            format!("{level} {unit}, {slope} and {size} {factor} times {symbol}{power}")
        })
    })
}

/// Currents between which a curve is straight: as far apart in rows, and in amperes, half of each. Nothing where there are too few rows.
fn knots(x: &[f64]) -> Option<Vec<f64>> {
    let mut sorted: Vec<f64> = x.iter().copied().filter(|x| x.is_finite()).collect();
    sorted.sort_unstable_by(f64::total_cmp);
    let [first, .., last] = sorted.as_slice() else {
        return None;
    };
    let (first, last) = (*first, *last);
    let place = |at: usize| {
        let of_rows = at as f64 / sorted.len() as f64;
        STRETCHES as f64 * 0.5 * (of_rows + (sorted[at] - first) / (last - first))
    };
    let (mut knots, mut since) = (vec![first], 0);
    let mut next = 1.0;
    for (at, x) in sorted.iter().enumerate() {
        let are_rows = at - since >= LEAST_ROWS && sorted.len() - at >= LEAST_ROWS;
        if are_rows && place(at) >= next && *x < last {
            knots.push(*x);
            since = at;
            next = place(at).floor() + 1.0;
        }
    }
    knots.push(last);
    (knots.len() > 2).then_some(knots)
}

/// Any curve of the current: straight between some places of it.
fn curve<'a>(bench: &Workbench<'_>, says: Says<'a>) -> Option<Linear<'a>> {
    let x = current(bench);
    let knots = knots(x)?;
    let columns = hats_between(x, &knots);
    Some(Linear::new("curve", columns, move |values| {
        let (of_values, of_knots) = (place_of(values), place_of(&knots));
        let last = knots.len() - 1;
        let places = PLACES.min(knots.len());
        let told = (0..places).map(|place| {
            let at = place * last / (places - 1);
            let value = at_place(values[at], of_values);
            let knot = at_place(knots[at], of_knots);
            format!("{value} {} at {knot} {}", says.unit, says.of)
        });
        let told: Vec<String> = told.collect();
        format!("a curve of {} alone: {}", says.symbol, told.join(", "))
    }))
}

/// A zero, and a slope if it has one, that drift with time.
fn drifts<'a>(bench: &Workbench<'_>, says: Says<'a>) -> Vec<Linear<'a>> {
    let first_s = bench.t_s.first().copied().unwrap_or_default();
    let since = bench.t_s.iter().map(|t_s| (t_s - first_s) / 3600.0);
    let hours: Vec<f64> = since.collect();
    let x = current(bench);
    let one = vec![1.0; bench.len()];
    let slopes = vec![one.clone(), x.to_vec(), times(x, &hours)];
    let mut drifts = vec![Linear::new("drift", vec![one, hours], move |values| {
        format!("a drift of {} {} an hour", signed(values[1]), says.unit)
    })];
    if says.has_slopes() {
        drifts.push(Linear::new("slope-drift", slopes, move |values| {
            format!("a drift of {} an hour", says.slope(values[2]))
        }));
    }
    drifts
}

/// What follows a quantity that was recorded beside: it, its square, and the current times it. Beside a state of charge the current itself
/// is one.
fn around<'a>(bench: &'a Workbench<'_>, says: Says<'a>) -> Vec<Linear<'a>> {
    let all = variables(bench).into_iter().filter(|variable| {
        let is_beside = match variable.kind {
            Kind::Beside => true,
            Kind::Itself => !says.has_slopes(),
            _ => false,
        };
        is_beside && variable.values.iter().all(|z| z.is_finite())
    });
    all.flat_map(|variable| {
        let (name, z) = (variable.name, variable.values);
        let mean = z.iter().sum::<f64>() / z.len().max(1) as f64;
        let square = times(&z, &z);
        let z: Vec<f64> = z.iter().map(|z| z - mean).collect();
        let one = vec![1.0; bench.len()];
        let x = current(bench).to_vec();
        let slopes = vec![one.clone(), x.clone(), z.clone(), times(&x, &z)];
        let units = [(); 3].map(|()| variable.unit.clone());
        let [of_it, of_square, of_slope] = units;
        let unit = says.unit;
        let mut around = vec![
            Linear::new("follows", vec![one.clone(), z.clone()], move |values| {
                format!("{} {unit} per {of_it} of {name}", signed(values[1]))
            }),
            Linear::new("follows-square", vec![one, z, square], move |values| {
                let size = signed(values[2]);
                format!("{size} {unit}/{of_square}² times {name}², beside a straight line")
            }),
        ];
        if says.has_slopes() {
            around.push(Linear::new("slope-follows", slopes, move |values| {
                format!("{} per {of_slope} of {name}", says.slope(values[3]))
            }));
        }
        around
    })
    .collect()
}

/// What came before: the current above its means over several times, which make the answer to a step.
fn memory<'a>(bench: &Workbench<'_>, says: Says<'a>) -> Option<Linear<'a>> {
    let drive = &bench.problem.drive;
    let step_s = bench.scale.step_s;
    let taus: Vec<f64> = std::iter::successors(Some(step_s), |tau| Some(3.0 * tau))
        .take_while(|tau| *tau > 0.0 && *tau < 0.25 * bench.scale.span_s)
        .take(TIMES)
        .collect();
    let longest_s = *taus.last()?;
    let steps = Steps::new(drive);
    let rows: Vec<usize> = (0..bench.len()).collect();
    let here = at_rows(bench, &rows, &drive.reference, 0.0);
    let mut columns = vec![here.clone()];
    columns.extend(taus.iter().map(|tau| {
        let slow = steps.low_pass(&drive.segments, &drive.reference, *tau, false);
        let slow = at_rows(bench, &rows, &slow, 0.0);
        here.iter().zip(&slow).map(|(x, slow)| x - slow).collect()
    }));
    Some(Linear::new("memory", columns, move |values| {
        let off = |t_s: f64| {
            let slow = taus.iter().zip(&values[1..]);
            values[0]
                + slow
                    .map(|(tau, value)| value * (-t_s / tau).exp())
                    .sum::<f64>()
        };
        let later = std::iter::successors(Some(10.0 * step_s), |t_s| Some(10.0 * t_s))
            .take_while(|t_s| *t_s <= longest_s)
            .map(|t_s| format!("{} after {} s", says.of_step(off(t_s)), significant(t_s, 2)));
        let at_once = format!("{} at once", says.of_step(off(0.0)));
        let all: Vec<String> = std::iter::once(at_once).chain(later).collect();
        let symbol = says.symbol;
        format!(
            "a memory; of a step of {symbol} it reads {}",
            all.join(", ")
        )
    }))
}
