//! Stretches of a log in which the readings, or the reference, are of something else: a drop-out, a value that froze, a loose contact, a
//! burst. Seconds of that in hours of a drive are most of the mismatch, so that nothing else can be told, and no effect makes them.
//!
//! They are asked for after physics had its turn. A stretch is known by readings that follow one another and are all far off, where the
//! current does nothing that it does not do elsewhere too, in size and in rate, with readings that are right there; and by a jump where it
//! begins or ends, which no memory of a sensor makes.

use std::ops::Range;

use super::fit::{self, Fit};
use super::robust::common;
use super::strays::{IN_A_ROW, RARE, STRAY};
use super::told::short;
use super::workbench::{Model, Workbench};
use crate::problem::{Problem, View};
use crate::report::data::{Location, LocationKind, Unexplained, Verdict};
use crate::report::format::ends;

/// No more stretches than this are left out, …
const MOST_STRETCHES: usize = 8;
/// … and no more than this share of the readings: with more, too little of the recording would be judged.
const MOST: f64 = 0.1;
/// A stretch ends where readings are off by less than this many times the noise.
const SHOULDER: f64 = 3.0;
/// Rows ahead of a stretch whose current may be why.
const AHEAD: usize = 3;
/// Steps of the current as large as the largest within a stretch that there have to be elsewhere.
const STEPS_ELSEWHERE: usize = 3;
/// Of the currents of a stretch the lowest and the highest of this share are not looked for elsewhere.
const TAIL: f64 = 0.1;
/// Stretches that are told one by one.
const PLACES: usize = 3;
/// A series that moves by less than this share of what the other moves by stays where it is.
const STAYS: f64 = 0.05;

/// A stretch that is left out, as it is told.
pub(super) struct Dropout {
    /// Rows of the observation, the last one included.
    rows: [usize; 2],
    /// Times of its first and last reading, in s.
    from_s: f64,
    to_s: f64,
    /// How many readings.
    count: usize,
    /// What stays where it is meanwhile.
    stays: Option<Stays>,
}

/// What stays at one value, in the view's unit, while the other moves.
enum Stays {
    Reading { at: f64 },
    Simulation { at: f64 },
}

/// Readings that are far off, in what a fit leaves.
struct Far<'b, 'p> {
    bench: &'b Workbench<'p>,
    residual: &'b [f64],
    /// What readings are off by as a rule, rms, in the view's unit.
    noise: f64,
}

impl<'b, 'p> Far<'b, 'p> {
    fn of(bench: &'b Workbench<'p>, residual: &'b [f64]) -> Self {
        let noise = common(residual)
            .max(bench.problem.noise)
            .max(bench.scale.quantum);
        Self {
            bench,
            residual,
            noise,
        }
    }

    fn beyond(&self, row: usize, times: f64) -> bool {
        self.residual[row].abs() > times * self.noise + self.bench.inaccuracy(row)
    }

    fn segment(&self, row: usize) -> usize {
        let bench = self.bench;
        bench.problem.observed.segment_of(bench.rows[row])
    }

    /// Rows that follow one another, the first and the last of which is far off.
    fn runs(&self) -> Vec<Range<usize>> {
        let rows = 0..self.bench.len();
        let far: Vec<usize> = rows.filter(|&row| self.beyond(row, STRAY)).collect();
        let mut runs: Vec<Range<usize>> = far
            .chunk_by(|a, b| b - a == 1 && self.segment(*a) == self.segment(*b))
            .map(|run| run[0]..run[run.len() - 1] + 1)
            .collect();
        // A reading that froze is right whenever the current comes by.
        loop {
            let count = runs.len();
            runs = joined(runs, |left, right| {
                right.start - left.end <= left.len() + right.len()
                    && self.segment(left.start) == self.segment(right.start)
            });
            if runs.len() == count {
                return runs;
            }
        }
    }
}

/// A fit again, without what stands out: a few hundred readings far off move a time or a factor by Huber's loss too.
pub(super) fn without_far(bench: &Workbench<'_>, fit: &Fit) -> Fit {
    let mut used = vec![1.0; bench.len()];
    let runs = Far::of(bench, &fit.residual).runs().into_iter();
    runs.filter(|run| run.len() >= IN_A_ROW)
        .for_each(|run| used[run].fill(0.0));
    fit::fit(bench, &fit.model, Some(&used))
}

/// Stretches that no physics makes, in order, if there are some, from what a fit leaves.
pub(super) fn found(bench: &Workbench<'_>, residual: &[f64]) -> Vec<Dropout> {
    let far = Far::of(bench, residual);
    let noise = far.noise;
    if !matches!(bench.problem.view, View::Sensor | View::Voltage) || noise <= 0.0 {
        return Vec::new();
    }
    let (segment, beyond) = (
        |row: usize| far.segment(row),
        |row: usize| far.beyond(row, SHOULDER),
    );
    let runs = far.runs();
    let (mut runs, rest): (Vec<_>, Vec<_>) =
        runs.into_iter().partition(|run| run.len() >= IN_A_ROW);
    let alone: usize = rest.iter().map(Range::len).sum();
    if runs.is_empty() || runs.len() > MOST_STRETCHES || alone as f64 > RARE * bench.len() as f64 {
        return Vec::new();
    }
    let cores = runs.clone();
    for run in &mut runs {
        let of = segment(run.start);
        while run.start > 0 && segment(run.start - 1) == of && beyond(run.start - 1) {
            run.start -= 1;
        }
        while run.end < bench.len() && segment(run.end) == of && beyond(run.end) {
            run.end += 1;
        }
    }
    let all: usize = runs.iter().map(Range::len).sum();
    if all as f64 > MOST * bench.len() as f64 {
        return Vec::new();
    }
    let elsewhere = Elsewhere::new(bench, &runs);
    // The current's own steps are no jumps of the log.
    let jumps = |inside: usize, outside: Option<usize>| {
        let beside = outside.filter(|&row| {
            row < bench.len() && segment(row) == segment(inside) && inside.abs_diff(row) <= AHEAD
        });
        beside.is_some_and(|row| {
            let by = |series: &[f64]| (series[inside] - series[row]).abs();
            by(residual) > (STRAY * noise).max(by(&bench.plain))
        })
    };
    let is_cut_off = |(run, core): (&Range<usize>, &Range<usize>)| {
        jumps(core.start, run.start.checked_sub(1)) || jumps(core.end - 1, Some(run.end))
    };
    let mut pairs = runs.iter().zip(&cores);
    if !pairs.all(|pair| is_cut_off(pair) && elsewhere.has(bench, pair.1)) {
        return Vec::new();
    }
    runs.iter().map(|run| told_of(bench, run)).collect()
}

/// Neighbours that belong together made one.
fn joined(
    runs: Vec<Range<usize>>,
    together: impl Fn(&Range<usize>, &Range<usize>) -> bool,
) -> Vec<Range<usize>> {
    let mut all: Vec<Range<usize>> = Vec::new();
    for run in runs {
        match all.last_mut() {
            Some(last) if together(last, &run) => last.end = run.end,
            _ => all.push(run),
        }
    }
    all
}

/// What the simulation does outside some stretches, in order of size.
struct Elsewhere {
    values: Vec<f64>,
    steps: Vec<f64>,
}

impl Elsewhere {
    fn new(bench: &Workbench<'_>, runs: &[Range<usize>]) -> Self {
        let is_outside = |row: &usize| !runs.iter().any(|run| run.contains(row));
        let outside: Vec<usize> = (0..bench.len()).filter(is_outside).collect();
        let sorted = |mut values: Vec<f64>| {
            values.sort_unstable_by(f64::total_cmp);
            values
        };
        Self {
            values: sorted(outside.iter().map(|&row| bench.plain[row]).collect()),
            steps: sorted(outside.iter().map(|&row| step(bench, row)).collect()),
        }
    }

    /// Whether there is all of what it does within a stretch.
    fn has(&self, bench: &Workbench<'_>, run: &Range<usize>) -> bool {
        let mut values = bench.plain[run.clone()].to_vec();
        values.sort_unstable_by(f64::total_cmp);
        let tail = (values.len() as f64 * TAIL) as usize;
        let (low, high) = (values[tail], values[values.len() - 1 - tail]);
        let below = self.values.partition_point(|value| *value <= low);
        let above = self.values.len() - self.values.partition_point(|value| *value < high);
        // A reference that stays where it is has stepped there itself.
        let from = match stays(bench, run) {
            Some(Stays::Simulation { .. }) => run.start + 1,
            _ => run.start.saturating_sub(AHEAD),
        };
        let largest = (from..run.end)
            .map(|row| step(bench, row))
            .fold(0.0, f64::max);
        let steps = self.steps.len() - self.steps.partition_point(|step| *step < largest);
        below.min(above) > tail && steps >= STEPS_ELSEWHERE
    }
}

/// By how much the simulation moves up to a row.
fn step(bench: &Workbench<'_>, row: usize) -> f64 {
    match row.checked_sub(1) {
        Some(before) if bench.t_s[row] > bench.t_s[before] => {
            (bench.plain[row] - bench.plain[before]).abs()
        }
        _ => 0.0,
    }
}

/// What stays where it is within a stretch, if either does.
fn stays(bench: &Workbench<'_>, run: &Range<usize>) -> Option<Stays> {
    let of = |series: &[f64]| {
        let series = &series[run.clone()];
        let mean = series.iter().sum::<f64>() / series.len() as f64;
        (mean, super::rms(series.iter().map(|value| value - mean)))
    };
    let ((read, reading), (simulated, simulation)) = (of(&bench.y), of(&bench.plain));
    if reading < STAYS * simulation {
        Some(Stays::Reading { at: read })
    } else if simulation < STAYS * reading {
        Some(Stays::Simulation { at: simulated })
    } else {
        None
    }
}

fn told_of(bench: &Workbench<'_>, run: &Range<usize>) -> Dropout {
    let [first, last] = [run.start, run.end - 1];
    Dropout {
        rows: [bench.rows[first], bench.rows[last]],
        from_s: bench.t_s[first],
        to_s: bench.t_s[last],
        count: run.len(),
        stays: stays(bench, run),
    }
}

/// A problem without the readings of some stretches.
pub(super) fn without(problem: &Problem, dropouts: &[Dropout]) -> Problem {
    problem.without_readings(dropouts.iter().flat_map(|dropout| {
        let [first, last] = dropout.rows;
        first..=last
    }))
}

/// How many readings that are.
pub(super) fn count(dropouts: &[Dropout]) -> usize {
    dropouts.iter().map(|dropout| dropout.count).sum()
}

/// The verdict on a signal of which the rest has one: what was left out is not accounted for.
pub(super) fn verdict(of_rest: Verdict) -> Verdict {
    match of_rest {
        Verdict::NoMismatch => Verdict::Unknown,
        Verdict::Explained => Verdict::PartlyExplained,
        other => other,
    }
}

/// What is left out, beside what was decided without it: in words, its places, and what remains with it.
pub(super) struct Told {
    pub(super) sentence: String,
    pub(super) locations: Vec<Location>,
    pub(super) unexplained: Unexplained,
}

/// `whole` is of the problem with the stretches, `model` and the sentence `of_rest` what was decided without them; no sentence: the rest
/// agrees.
pub(super) fn told(
    whole: &Workbench<'_>,
    model: &Model,
    dropouts: &[Dropout],
    of_rest: Option<&str>,
) -> Told {
    let (name, unit) = (&whole.problem.name, &whole.problem.unit);
    let left = whole.residual(&whole.run(model));
    let plain = whole.residual(&whole.plain);
    let energy = |rows: Range<usize>| plain[rows].iter().map(|r| r * r).sum::<f64>();
    let all = energy(0..whole.len());
    let span = |dropout: &Dropout| {
        let at = |row: usize| whole.rows.partition_point(|known| *known < row);
        at(dropout.rows[0])..at(dropout.rows[1] + 1)
    };
    let locations: Vec<Location> = dropouts
        .iter()
        .map(|dropout| {
            let rows = span(dropout);
            let sample_share = rows.len() as f64 / whole.len() as f64;
            Location {
                signal: name.clone(),
                kind: LocationKind::Time,
                variable: "t_s".into(),
                unit: "s".into(),
                from: Some(dropout.from_s),
                to: Some(dropout.to_s),
                energy_share: energy(rows) / all,
                sample_share,
                p_value: by_chance(dropout.count, sample_share, whole.len()),
                effect: None,
            }
        })
        .collect();
    let largest = dropouts
        .iter()
        .flat_map(&span)
        .map(|row| left[row].abs())
        .fold(0.0, f64::max);
    let readings = readings(dropouts);
    let why =
        "no effect of the library makes that, and readings are right elsewhere at the same values";
    let off = format!("off by up to {} {unit}", short(largest));
    let sentence = match of_rest {
        None => {
            format!("{name}: all but {readings} agree with the simulation; those are {off}: {why}.")
        }
        Some(sentence) => format!("{sentence} Left out are {readings}, {off}: {why}."),
    };
    let most = locations
        .iter()
        .max_by(|a, b| a.energy_share.total_cmp(&b.energy_share))
        .cloned();
    let unexplained = Unexplained {
        signal: name.clone(),
        rmse: super::rms(left.iter().copied()),
        explainable_share: 0.0,
        location: most,
        form: None,
    };
    Told {
        sentence,
        locations,
        unexplained,
    }
}

/// How many readings, and where.
fn readings(dropouts: &[Dropout]) -> String {
    let (named, others) = dropouts.split_at(dropouts.len().min(PLACES));
    let mut places = named
        .iter()
        .map(Dropout::place)
        .collect::<Vec<_>>()
        .join(", ");
    match others.len() {
        0 => {}
        1 => places.push_str(" and in one more stretch"),
        more => places.push_str(&format!(" and in {more} more stretches")),
    }
    format!("{} readings {places}", count(dropouts))
}

/// What is to be said of such stretches in a file that was never fitted, of which a model leaves so much: they are not left out there.
pub(super) fn of_unfitted(bench: &Workbench<'_>, left: &[f64]) -> Option<String> {
    let dropouts = found(bench, left);
    if dropouts.is_empty() {
        return None;
    }
    let is_inside = |row: usize| {
        dropouts
            .iter()
            .any(|dropout| (dropout.rows[0]..=dropout.rows[1]).contains(&bench.rows[row]))
    };
    let others = (0..bench.len()).filter(|&row| !is_inside(row));
    Some(format!(
        "{} are of something else (no effect of the library makes that): without them {} of {} {} are left",
        readings(&dropouts),
        short(super::rms(others.map(|row| left[row]))),
        short(super::rms(left.iter().copied())),
        bench.problem.unit,
    ))
}

/// How often so many readings would follow one another, at the most, if those of that share were anywhere.
fn by_chance(in_a_row: usize, share: f64, count: usize) -> f64 {
    (count as f64 * share.powi(in_a_row.min(1000) as i32)).min(1.0)
}

impl Dropout {
    fn place(&self) -> String {
        let stays = match self.stays {
            Some(Stays::Reading { at }) => {
                format!(" (at {} while the simulation moves)", short(at))
            }
            Some(Stays::Simulation { at }) => {
                format!(" (the simulation at {} while they move)", short(at))
            }
            None => String::new(),
        };
        let [from, to] = ends(self.from_s, self.to_s);
        format!("from {from} to {to} s{stays}")
    }
}
