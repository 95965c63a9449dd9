//! The series of a report, reduced to what a page can hold, as JSON for the page's script.
//!
//! A series that is too long is cut into buckets of equally many rows; of each bucket the smallest and the largest value
//! are drawn, in the order in which they occur, so that no peak is lost.

use std::collections::BTreeMap;

use serde::Serialize;

use super::data::{Location, LocationKind, Report, SignalPlots};
use crate::range::range;

/// Values that one page holds over all signals; at some 5 to 9 characters each they stay below 4.5 MB.
pub const VALUES_PER_PAGE: usize = 500_000;
/// Samples drawn in one picture of the residual against a variable, at most, beside the extremes.
const POINTS: usize = 2_400;
/// Columns of which the extremes are drawn in any case.
const EXTREME_COLUMNS: usize = 60;
/// Bins of which median and 5 … 95 % are drawn.
const BINS: usize = 40;
/// A variable with no more values than this is drawn value by value.
const DISCRETE: usize = 12;
/// A step that is longer than this many median steps is a gap, and no line is drawn over it.
const GAP_STEPS: f64 = 10.0;
/// With more gaps than this the recording is irregular rather than interrupted.
const MOST_GAPS: usize = 500;
/// Frequencies drawn; more are reduced by their largest amplitude.
const FREQUENCIES: usize = 2_000;

/// A series as whole multiples of `s`, each as the difference to the one before; `None` where there is no value.
#[derive(Serialize)]
struct Column {
    s: f64,
    d: Vec<Option<i64>>,
}

/// What one picture says, in words.
#[derive(Default)]
pub struct Words {
    /// Sentence for those who do not see the picture.
    pub text: String,
    /// What the drawing leaves out; empty if nothing.
    pub reduced: String,
}

/// The pictures of one signal, as data for the script and in words.
pub struct Pictures {
    /// JSON for the script.
    pub data: Data,
    /// The signal over time, if there is anything to draw.
    pub time: Option<Words>,
    /// The residual over time, if there is one.
    pub residual: Option<Words>,
    /// The residual against each variable, with the variable's name.
    pub against: Vec<(String, Words)>,
    /// The spectrum, if there is one.
    pub spectrum: Option<Words>,
    /// True if the residual "after" is of held-out blocks.
    pub held_out: bool,
    /// True if there is only one simulation: no effect was added.
    pub same: bool,
}

/// What the script is given for one signal.
#[derive(Serialize)]
pub struct Data {
    unit: String,
    t: Column,
    /// By name: `recorded`, `before`, `after`, `reference`.
    values: BTreeMap<&'static str, Column>,
    /// By name: `before`, `after`, `fitted`.
    residuals: BTreeMap<&'static str, Column>,
    against: Vec<Against>,
    spectrum: Option<Spectrum>,
    /// Places to be shaded, by kind.
    places: Vec<Place>,
}

#[derive(Serialize)]
struct Against {
    variable: String,
    x: Column,
    before: Column,
    /// None if it is the same as before.
    after: Option<Column>,
    bins: Bins,
    /// Open-ended ranges of the variable that the report names.
    places: Vec<Place>,
}

#[derive(Default, Serialize)]
struct Bins {
    /// True if each bin is one value of the variable.
    discrete: bool,
    x: Vec<Option<f64>>,
    before: Vec<[f64; 3]>,
    after: Vec<[f64; 3]>,
}

#[derive(Serialize)]
struct Spectrum {
    f: Vec<f64>,
    before: Vec<Option<f64>>,
    /// None if it is the same as before.
    after: Option<Vec<Option<f64>>>,
}

#[derive(Clone, Serialize)]
struct Place {
    kind: LocationKind,
    from: Option<f64>,
    to: Option<f64>,
}

/// The pictures of every signal that has any samples.
pub fn pictures(report: &Report) -> Vec<(usize, Pictures)> {
    let drawable: Vec<(usize, &SignalPlots)> = report
        .plots
        .iter()
        .enumerate()
        .filter(|(_, plots)| !plots.t_s.is_empty())
        .collect();
    let each = VALUES_PER_PAGE / drawable.len().max(1);
    drawable
        .into_iter()
        .map(|(index, plots)| {
            let places: Vec<&Location> = report
                .locations
                .iter()
                .filter(|location| location.signal == plots.name)
                .collect();
            (index, pictures_of(plots, &places, each))
        })
        .collect()
}

fn pictures_of(plots: &SignalPlots, locations: &[&Location], budget: usize) -> Pictures {
    let rows = plots.t_s.len();
    let held_out = plots.held_out_residual.len() == rows
        && plots.held_out_residual.iter().any(|v| v.is_finite());
    let before: Vec<f64> = difference(&plots.recorded, &plots.before, rows);
    let fitted: Vec<f64> = difference(&plots.recorded, &plots.after, rows);
    let after: &[f64] = if held_out {
        &plots.held_out_residual
    } else {
        &fitted
    };

    // Without an effect there is no second simulation to draw over the first.
    let same = !held_out
        && before
            .iter()
            .zip(&fitted)
            .all(|(before, fitted)| before == fitted || !before.is_finite());
    let mut values: Vec<(&'static str, &[f64])> = vec![
        ("recorded", &plots.recorded),
        ("before", &plots.before),
        ("after", &plots.after),
        ("reference", &plots.reference),
    ];
    values.retain(|(name, series)| {
        !(same && *name == "after") && series.len() == rows && series.iter().any(|v| v.is_finite())
    });
    let mut residuals: Vec<(&'static str, &[f64])> = vec![("before", &before), ("after", after)];
    if held_out {
        residuals.push(("fitted", &fitted));
    }
    residuals.retain(|(name, series)| {
        !(same && *name == "after") && series.iter().any(|v| v.is_finite())
    });

    let timeline = Timeline::of(&plots.t_s);
    let columns = 1 + values.len() + residuals.len();
    let scatter_share = (plots.variables.len() * 3 * POINTS).min(budget / 2);
    let allowed = ((budget - scatter_share) / columns).max(16);
    let layout = Layout::of(&timeline, rows, allowed);
    let reduced = layout.words(rows, timeline.anew);
    let column = |series: &[f64]| Column::of(&layout.apply(series), Resolution::Value);

    let points = (scatter_share / (3 * plots.variables.len().max(1))).clamp(100, POINTS);
    let against: Vec<(Against, Words)> = plots
        .variables
        .iter()
        .filter(|(_, series)| series.len() == rows)
        .filter_map(|(name, series)| against(name, series, &before, after, same, points, locations))
        .collect();
    let (against, against_words): (Vec<_>, Vec<_>) = against
        .into_iter()
        .map(|(data, words)| ((data.variable.clone(), data), words))
        .map(|((n, d), w)| (d, (n, w)))
        .unzip();
    let spectrum = spectrum(&plots.spectrum, same);

    Pictures {
        time: (!values.is_empty()).then(|| Words {
            text: values
                .iter()
                .map(|(name, series)| range_in_words(name, series, &plots.unit))
                .collect::<Vec<_>>()
                .join("; ")
                + ".",
            reduced: reduced.clone(),
        }),
        residual: (!residuals.is_empty()).then(|| Words {
            text: residuals
                .iter()
                .map(|(name, series)| {
                    format!(
                        "{}, root mean square {}",
                        range_in_words(name, series, &plots.unit),
                        super::format::quantity(
                            &super::format::significant(rms(series), 3),
                            &plots.unit
                        )
                    )
                })
                .collect::<Vec<_>>()
                .join("; ")
                + ".",
            reduced,
        }),
        against: against_words,
        spectrum: spectrum.as_ref().map(|(_, words)| Words {
            text: words.text.clone(),
            reduced: words.reduced.clone(),
        }),
        held_out,
        same,
        data: Data {
            unit: plots.unit.clone(),
            t: Column::of(
                &layout.time(&timeline.t_s),
                Resolution::Time(timeline.median_step_s),
            ),
            values: values
                .iter()
                .map(|(name, series)| (*name, column(series)))
                .collect(),
            residuals: residuals
                .iter()
                .map(|(name, series)| (*name, column(series)))
                .collect(),
            against,
            spectrum: spectrum.map(|(data, _)| data),
            places: locations
                .iter()
                // Laid end to end, a recorded time is no longer one place.
                .filter(|location| match location.kind {
                    LocationKind::Time => timeline.anew == 0,
                    LocationKind::Region => false,
                    LocationKind::Frequency => true,
                })
                .map(|location| Place::of(location))
                .collect(),
        },
    }
}

fn difference(left: &[f64], right: &[f64], rows: usize) -> Vec<f64> {
    if left.len() != rows || right.len() != rows {
        return vec![f64::NAN; rows];
    }
    left.iter()
        .zip(right)
        .map(|(left, right)| left - right)
        .collect()
}

fn rms(series: &[f64]) -> f64 {
    let (sum, count) = series
        .iter()
        .filter(|v| v.is_finite())
        .fold((0.0, 0usize), |(sum, count), v| (sum + v * v, count + 1));
    (sum / count as f64).sqrt()
}

fn range_in_words(name: &str, series: &[f64], unit: &str) -> String {
    let [low, high] = range(series.iter().copied()).unwrap_or([f64::NAN; 2]);
    format!(
        "{name}: {} … {}",
        super::format::significant(low, 3),
        super::format::quantity(&super::format::significant(high, 3), unit)
    )
}

/// Time without steps backwards, and where lines are to be broken.
struct Timeline {
    t_s: Vec<f64>,
    /// First rows of the stretches without a gap, ascending, beginning with 0.
    starts: Vec<usize>,
    /// How often the recorded time jumps backwards.
    anew: usize,
    median_step_s: f64,
}

impl Timeline {
    fn of(recorded_t_s: &[f64]) -> Self {
        let mut steps: Vec<f64> = recorded_t_s
            .windows(2)
            .map(|pair| pair[1] - pair[0])
            .filter(|step| step.is_finite() && *step > 0.0)
            .collect();
        let middle = steps.len() / 2;
        let median_step_s = if steps.is_empty() {
            1.0
        } else {
            *steps.select_nth_unstable_by(middle, f64::total_cmp).1
        };
        let mut t_s = Vec::with_capacity(recorded_t_s.len());
        let (mut shift, mut anew) = (0.0, 0);
        let mut starts = vec![0];
        let mut last: Option<f64> = None;
        for (row, &recorded) in recorded_t_s.iter().enumerate() {
            // A row without a time has no place of its own; it is drawn with the one before.
            let mut t = if recorded.is_finite() {
                recorded + shift
            } else {
                last.unwrap_or(0.0)
            };
            if let Some(last) = last {
                if t < last {
                    // Operations whose time starts anew are laid end to end.
                    shift += last + median_step_s - t;
                    t = last + median_step_s;
                    anew += 1;
                    starts.push(row);
                } else if t - last > GAP_STEPS * median_step_s {
                    starts.push(row);
                }
            }
            last = Some(t);
            t_s.push(t);
        }
        if starts.len() > MOST_GAPS {
            starts.truncate(1);
        }
        Self {
            t_s,
            starts,
            anew,
            median_step_s,
        }
    }
}

/// Which rows are drawn.
struct Layout {
    /// Rows of each bucket; of one row at full resolution.
    buckets: Vec<std::ops::Range<usize>>,
    /// Index of the first bucket of each stretch but the first: a break is drawn before it.
    breaks: Vec<usize>,
    reduced: bool,
}

impl Layout {
    fn of(timeline: &Timeline, rows: usize, allowed: usize) -> Self {
        let reduced = rows + timeline.starts.len() > allowed;
        let size = if reduced {
            (2 * rows)
                .div_ceil(allowed.saturating_sub(3 * timeline.starts.len()).max(8))
                .max(2)
        } else {
            1
        };
        let mut buckets = Vec::new();
        let mut breaks = Vec::new();
        for (stretch, &start) in timeline.starts.iter().enumerate() {
            let end = timeline.starts.get(stretch + 1).copied().unwrap_or(rows);
            if stretch > 0 {
                breaks.push(buckets.len());
            }
            buckets.extend(
                (start..end)
                    .step_by(size)
                    .map(|first| first..(first + size).min(end)),
            );
        }
        Self {
            buckets,
            breaks,
            reduced,
        }
    }

    fn words(&self, rows: usize, anew: usize) -> String {
        let mut words = String::new();
        if self.reduced {
            words = format!(
                "{} rows are drawn as {} buckets, each by its smallest and largest value.",
                super::format::grouped(rows),
                super::format::grouped(self.buckets.len()),
            );
        }
        if anew > 0 {
            let times = match anew {
                1 => "once".to_owned(),
                _ => format!("{anew} times"),
            };
            let end_to_end = format!(
                "The recorded time starts anew {times}; the parts are laid end to end, and places in time are not shaded."
            );
            if !words.is_empty() {
                words.push(' ');
            }
            words.push_str(&end_to_end);
        }
        words
    }

    /// A series as drawn, NaN at breaks.
    fn apply(&self, series: &[f64]) -> Vec<f64> {
        let mut drawn = Vec::with_capacity(2 * self.buckets.len() + self.breaks.len());
        let mut breaks = self.breaks.iter().peekable();
        for (index, bucket) in self.buckets.iter().enumerate() {
            if breaks.next_if_eq(&&index).is_some() {
                drawn.push(f64::NAN);
            }
            let rows = &series[bucket.clone()];
            if !self.reduced {
                drawn.extend_from_slice(rows);
                continue;
            }
            let finite = || rows.iter().enumerate().filter(|(_, v)| v.is_finite());
            let low = finite().min_by(|a, b| a.1.total_cmp(b.1));
            let high = finite().max_by(|a, b| a.1.total_cmp(b.1));
            match (low, high) {
                (Some((at_low, low)), Some((at_high, high))) if at_low <= at_high => {
                    drawn.extend([*low, *high])
                }
                (Some((_, low)), Some((_, high))) => drawn.extend([*high, *low]),
                _ => drawn.extend([f64::NAN; 2]),
            }
        }
        drawn
    }

    /// The time of what [`Layout::apply`] gives.
    fn time(&self, t_s: &[f64]) -> Vec<f64> {
        let mut drawn: Vec<f64> = Vec::with_capacity(2 * self.buckets.len() + self.breaks.len());
        let mut breaks = self.breaks.iter().peekable();
        for (index, bucket) in self.buckets.iter().enumerate() {
            let first = t_s[bucket.start];
            if breaks.next_if_eq(&&index).is_some() {
                drawn.push(
                    drawn
                        .last()
                        .map_or(first, |last| last + (first - last) / 2.0),
                );
            }
            drawn.push(first);
            if self.reduced {
                let last = t_s[bucket.end - 1];
                drawn.push(first + (last - first) / 2.0);
            }
        }
        drawn
    }
}

/// How fine a column is written.
enum Resolution {
    /// A millionth of the range or finer.
    Value,
    /// A thousandth of the median step or finer.
    Time(f64),
}

impl Column {
    fn of(series: &[f64], resolution: Resolution) -> Self {
        let [low, high] = range(series.iter().copied()).unwrap_or_default();
        let span = match resolution {
            Resolution::Value if high > low => (high - low) / 1e6,
            Resolution::Value => low.abs().max(1.0) / 1e6,
            Resolution::Time(step) => step / 1e3,
        };
        // Below this, f64 itself is no finer.
        let finest = low.abs().max(high.abs()) * 1e-15;
        let s = 10f64.powi(span.max(finest).max(1e-290).log10().floor() as i32);
        let mut last = 0i64;
        let d = series
            .iter()
            .map(|value| {
                value.is_finite().then(|| {
                    let now = (value / s).round() as i64;
                    let step = now - last;
                    last = now;
                    step
                })
            })
            .collect();
        Self { s, d }
    }
}

impl Place {
    fn of(location: &Location) -> Self {
        Self {
            kind: location.kind,
            from: location.from.filter(|v| v.is_finite()),
            to: location.to.filter(|v| v.is_finite()),
        }
    }
}

/// The residual against one variable; `None` without a row that has all of them.
fn against(
    name: &str,
    variable: &[f64],
    before: &[f64],
    after: &[f64],
    same: bool,
    points: usize,
    locations: &[&Location],
) -> Option<(Against, Words)> {
    let usable = |row: usize| variable[row].is_finite() && before[row].is_finite();
    let total = (0..variable.len()).filter(|row| usable(*row)).count();
    let [low, high] = range(
        variable
            .iter()
            .zip(before)
            .filter(|(_, y)| y.is_finite())
            .map(|(x, _)| *x),
    )?;
    let width = if high > low { high - low } else { 1.0 };

    // Every so many-th row, and of each column the extremes.
    let stride = total.div_ceil(points).max(1);
    let mut drawn = Vec::with_capacity(points + 4 * EXTREME_COLUMNS);
    let mut extremes: Vec<Option<[usize; 4]>> = vec![None; EXTREME_COLUMNS];
    let usable_rows = (0..variable.len()).filter(|row| usable(*row));
    for (counted, row) in usable_rows.enumerate() {
        if counted % stride == 0 {
            drawn.push(row);
        }
        let column = (((variable[row] - low) / width * EXTREME_COLUMNS as f64) as usize)
            .min(EXTREME_COLUMNS - 1);
        let extreme = extremes[column].get_or_insert([row; 4]);
        for (slot, series, sign) in [
            (0, before, 1.0),
            (1, before, -1.0),
            (2, after, 1.0),
            (3, after, -1.0),
        ] {
            if !series[extreme[slot]].is_finite()
                || sign * series[row] > sign * series[extreme[slot]]
            {
                extreme[slot] = row;
            }
        }
    }
    if stride > 1 {
        drawn.extend(extremes.iter().flatten().flatten());
    }
    drawn.sort_unstable_by(|a, b| variable[*a].total_cmp(&variable[*b]).then(a.cmp(b)));
    drawn.dedup();

    let bins = bins(variable, before, after, low, width);
    let pick = |series: &[f64]| drawn.iter().map(|row| series[*row]).collect::<Vec<_>>();
    let largest = |quantiles: &[[f64; 3]]| {
        quantiles
            .iter()
            .zip(&bins.x)
            .filter(|(q, _)| q[1].is_finite())
            .max_by(|a, b| a.0[1].abs().total_cmp(&b.0[1].abs()))
            .map(|(q, x)| (q[1], x.unwrap_or(f64::NAN)))
    };
    let mut text = format!(
        "{name} runs from {} to {}.",
        super::format::significant(low, 3),
        super::format::significant(high, 3)
    );
    for (which, quantiles) in [("before", &bins.before), ("after", &bins.after)] {
        if same && which == "after" {
            continue;
        }
        if let Some((median, x)) = largest(quantiles) {
            text.push_str(&format!(
                " Largest median {which}: {} at {}.",
                super::format::significant(median, 3),
                super::format::significant(x, 3)
            ));
        }
    }
    let reduced = if stride > 1 {
        format!(
            "{} of {} points are drawn, the extremes among them; median and band are of all.",
            super::format::grouped(drawn.len()),
            super::format::grouped(total)
        )
    } else {
        String::new()
    };
    let data = Against {
        variable: name.to_owned(),
        x: Column::of(&pick(variable), Resolution::Value),
        before: Column::of(&pick(before), Resolution::Value),
        after: (!same).then(|| Column::of(&pick(after), Resolution::Value)),
        places: locations
            .iter()
            .filter(|location| {
                location.kind == LocationKind::Region && same_variable(name, &location.variable)
            })
            .map(|location| Place::of(location))
            .collect(),
        bins,
    };
    Some((data, Words { text, reduced }))
}

/// Whether a plot's variable, named with its unit, is a location's: `abs(i) / A` is `abs(i)`.
fn same_variable(with_unit: &str, variable: &str) -> bool {
    !variable.is_empty()
        && with_unit
            .strip_prefix(variable)
            .is_some_and(|rest| !rest.starts_with(|c: char| c.is_alphanumeric()))
}

/// Median and 5 … 95 % of the residual in bins of the variable, of all rows.
fn bins(variable: &[f64], before: &[f64], after: &[f64], low: f64, width: f64) -> Bins {
    let mut values: Vec<f64> = Vec::with_capacity(DISCRETE + 1);
    for (x, _) in variable
        .iter()
        .zip(before)
        .filter(|(x, y)| x.is_finite() && y.is_finite())
    {
        if values.len() > DISCRETE {
            break;
        }
        if let Err(place) = values.binary_search_by(|value| value.total_cmp(x)) {
            values.insert(place, *x);
        }
    }
    let discrete = values.len() <= DISCRETE;
    let number = if discrete { values.len() } else { BINS };
    let mut filled: Vec<[Vec<f64>; 3]> = vec![Default::default(); number];
    for row in 0..variable.len() {
        let (x, y) = (variable[row], before[row]);
        if !(x.is_finite() && y.is_finite()) {
            continue;
        }
        let bin = if discrete {
            values
                .binary_search_by(|value| value.total_cmp(&x))
                .unwrap_or(0)
        } else {
            (((x - low) / width * BINS as f64) as usize).min(BINS - 1)
        };
        let [xs, befores, afters] = &mut filled[bin];
        xs.push(x);
        befores.push(y);
        if after[row].is_finite() {
            afters.push(after[row]);
        }
    }
    // A quantile of a handful says nothing: thin bins join their neighbour.
    if !discrete {
        let least = (variable.len() / 4_000).max(15);
        let mut joined: Vec<[Vec<f64>; 3]> = Vec::new();
        for bin in filled {
            match joined.last_mut() {
                Some(last) if last[0].len() < least => {
                    for (into, from) in last.iter_mut().zip(bin) {
                        into.extend(from);
                    }
                }
                _ => joined.push(bin),
            }
        }
        filled = joined;
    }
    let mut bins = Bins {
        discrete,
        ..Bins::default()
    };
    for [xs, mut befores, mut afters] in filled {
        if xs.is_empty() {
            continue;
        }
        let mean = xs.iter().sum::<f64>() / xs.len() as f64;
        bins.x.push(Some(mean));
        bins.before.push(quantiles(&mut befores));
        bins.after.push(quantiles(&mut afters));
    }
    bins
}

/// 5 %, median, 95 %; NaN of nothing.
fn quantiles(values: &mut [f64]) -> [f64; 3] {
    if values.is_empty() {
        return [f64::NAN; 3];
    }
    let last = (values.len() - 1) as f64;
    [0.05, 0.5, 0.95].map(|share| {
        let place = (share * last).round() as usize;
        let value = *values.select_nth_unstable_by(place, f64::total_cmp).1;
        // As exact as a picture needs, and short.
        format!("{value:.5e}").parse().unwrap_or(value)
    })
}

fn spectrum(spectrum: &[(f64, f64, f64)], same: bool) -> Option<(Spectrum, Words)> {
    let lines: Vec<_> = spectrum
        .iter()
        .filter(|(f, ..)| f.is_finite() && *f > 0.0)
        .collect();
    if lines.is_empty() {
        return None;
    }
    let size = lines.len().div_ceil(FREQUENCIES);
    let (mut f, mut before, mut after) = (Vec::new(), Vec::new(), Vec::new());
    let short = |value: f64| {
        (value.is_finite() && value > 0.0).then(|| format!("{value:.4e}").parse().unwrap_or(value))
    };
    for bucket in lines.chunks(size) {
        f.push(
            format!("{:.6e}", bucket[0].0)
                .parse()
                .unwrap_or(bucket[0].0),
        );
        before.push(short(
            bucket.iter().map(|line| line.1).fold(f64::NAN, f64::max),
        ));
        after.push(short(
            bucket.iter().map(|line| line.2).fold(f64::NAN, f64::max),
        ));
    }
    let peak = |pick: fn(&(f64, f64, f64)) -> f64| {
        lines
            .iter()
            .filter(|line| pick(line).is_finite())
            .max_by(|a, b| pick(a).total_cmp(&pick(b)))
            .map(|line| {
                format!(
                    "{} at {} Hz",
                    super::format::significant(pick(line), 3),
                    super::format::significant(line.0, 3)
                )
            })
            .unwrap_or_else(|| super::format::NONE.to_owned())
    };
    let words = Words {
        text: if same {
            format!("Largest line: {}.", peak(|line| line.1))
        } else {
            format!(
                "Largest line before: {}; after: {}.",
                peak(|line| line.1),
                peak(|line| line.2)
            )
        },
        reduced: if size > 1 {
            format!(
                "{} frequencies are drawn as {}, each the largest of {size}.",
                super::format::grouped(lines.len()),
                super::format::grouped(f.len())
            )
        } else {
            String::new()
        },
    };
    Some((
        Spectrum {
            f,
            before,
            after: (!same).then_some(after),
        },
        words,
    ))
}

/// JSON that may stand inside a script element: nothing in it can end the element.
pub fn embed(data: &impl Serialize) -> String {
    let json = serde_json::to_string(data).unwrap_or_default();
    let mut safe = String::with_capacity(json.len());
    for character in json.chars() {
        match character {
            '<' | '>' | '&' | '\u{2028}' | '\u{2029}' => {
                safe.push_str(&format!("\\u{:04x}", u32::from(character)))
            }
            _ => safe.push(character),
        }
    }
    safe
}
