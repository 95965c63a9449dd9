//! Time stamps that are coarser than the rows: several rows in a row say the same time, or they were numbers of single precision.

use recording::{Table, error::number, name::T_S};

use super::series::median;
use crate::report::format::{at_most, count, grouped};

/// Fewer whole runs than this tell of no rate.
const FEWEST_RUNS: usize = 10;
/// Runs that have as many rows as is usual, or one more or less, are this share of all at least: a logger with a rate of its own.
const REGULAR: f64 = 0.8;
/// A used column has a value in this share of the rows at least: columns that were joined by time share few rows, and there a time that comes twice is
/// that of two messages.
const COMPLETE: f64 = 0.6;
/// Runs within which a used column moves are this share of all at least: else rows were written twice.
const MOVING: f64 = 0.5;
/// A time until the next run that is this many times the usual one tells nothing of the rows before it.
const USUAL: f64 = 1.5;

/// Steps of a number of 24 bits that are this share of the mean time from row to row, or more, move rows against what they were.
const COARSE: f64 = 0.1;
/// Digits that were cut when a number of 24 bits was written, as a share of its step.
const WRITTEN: f64 = 0.01;
/// Times whose steps differ by less than this share of the number's own step are even: nothing was lost.
const EVEN: f64 = 0.5;

/// What is to be said of times that were numbers of 24 bits (single precision) once: of the time since 1970 those have steps of 128 s.
pub(super) fn single_precision(table: &Table) -> Option<String> {
    let times_s = table.column(T_S)?;
    let ([first_s, ..], [.., last_s]) = (times_s, times_s) else {
        return None;
    };
    let step_s = single_step(*last_s);
    let mean_s = (last_s - first_s) / (times_s.len() - 1).max(1) as f64;
    if times_s.len() < FEWEST_RUNS || mean_s <= 0.0 || step_s < COARSE * mean_s {
        return None;
    }
    let is_single = |time_s: &f64| {
        let off_s = (time_s - f64::from(*time_s as f32)).abs();
        off_s <= WRITTEN * single_step(*time_s)
    };
    let mut steps = times_s.windows(2).map(|pair| pair[1] - pair[0]);
    let usual_s = steps.next()?;
    // Whole seconds, or a rate that such numbers hold exactly.
    let is_even = steps.all(|step| (step - usual_s).abs() < EVEN * step_s);
    if is_even || !times_s.iter().all(is_single) {
        return None;
    }
    let repeats = times_s.windows(2).filter(|pair| pair[0] == pair[1]).count();
    Some(format!(
        "the times of {} look like numbers of single precision (24 bits), which around {} s are {} s apart: {} of {} rows have the time of \
         the row before, and nothing that is shorter than that (a lag, a delay) can be told by them; expected double precision, or times \
         that count from the start",
        table.source(),
        number(*last_s),
        at_most(step_s, 4),
        grouped(repeats),
        grouped(times_s.len())
    ))
}

/// What may have made a large time the same in every row.
pub(super) fn held_by_single(time_s: f64) -> Option<String> {
    let step_s = single_step(time_s);
    (step_s >= 1.0 && time_s == f64::from(time_s as f32)).then(|| {
        format!(
            "numbers of single precision, 24 bits, are {} s apart there",
            at_most(step_s, 4)
        )
    })
}

/// By how much the next number of single precision is larger.
fn single_step(value: f64) -> f64 {
    let single = value.abs() as f32;
    f64::from(single.next_up()) - f64::from(single)
}

/// Spreads rows of one time stamp evenly until the next one, where stamps come in runs of much the same length; what was done, in words.
///
/// The first run ends where the next one begins: a recording begins anywhere between two stamps.
pub(super) fn spread(table: &mut Table, names: &[&str]) -> Option<String> {
    let times_s = table.column(T_S)?;
    let runs: Vec<&[f64]> = times_s.chunk_by(|one, next| one == next).collect();
    // The first and the last may be cut.
    let inner = runs.get(1..runs.len().checked_sub(1)?)?;
    // A time that is missing or goes back is an error, and its own.
    if inner.len() < FEWEST_RUNS || !times_s.is_sorted() {
        return None;
    }
    let mut lengths: Vec<f64> = inner.iter().map(|run| run.len() as f64).collect();
    let usual = median(&mut lengths)?;
    let regular = lengths
        .iter()
        .filter(|length| (**length - usual).abs() <= 1.0);
    if usual < 2.0 || (regular.count() as f64) < REGULAR * inner.len() as f64 {
        return None;
    }
    let mut apart: Vec<f64> = runs
        .windows(2)
        .map(|pair| pair[1][0] - pair[0][0])
        .collect();
    let usual_s = median(&mut apart)?;
    let used = names.iter().filter_map(|name| table.column(name));
    let used: Vec<&[f64]> = used.filter(|values| is_complete(values)).collect();
    let mut row = 0;
    let mut moving = 0;
    let mut spread = Vec::with_capacity(times_s.len());
    for (index, run) in runs.iter().enumerate() {
        let rows = row..row + run.len();
        row = rows.end;
        moving += usize::from(used.iter().any(|values| moves(&values[rows.clone()])));
        let until_s = runs
            .get(index + 1)
            .map(|next| next[0] - run[0])
            .filter(|step| *step <= USUAL * usual_s)
            .unwrap_or(usual_s);
        let is_first = index == 0;
        // The rows that the recording began after, or ended before.
        let cut_off = if is_first || index + 1 == runs.len() {
            (usual - run.len() as f64).max(0.0)
        } else {
            0.0
        };
        let all = run.len() as f64 + cut_off;
        let ahead = if is_first { cut_off } else { 0.0 };
        let begin_s = run[0];
        spread.extend((0..run.len()).map(|place| begin_s + (ahead + place as f64) / all * until_s));
    }
    if (moving as f64) < MOVING * runs.len() as f64 {
        return None;
    }
    let remark = format!(
        "the times of {} are coarser than its rows: mostly {} say the same one, {} s apart; the rows are spread evenly between them, so \
         that a time below {} s is not known for certain; expected a time for each row",
        table.source(),
        count(usual as usize, "row"),
        at_most(usual_s, 4),
        at_most(usual_s, 4)
    );
    table.replace(T_S, spread);
    Some(remark)
}

/// Whether a column has values in most rows.
fn is_complete(values: &[f64]) -> bool {
    let known = values.iter().filter(|value| value.is_finite()).count();
    known as f64 >= COMPLETE * values.len() as f64
}

/// Whether values differ.
fn moves(values: &[f64]) -> bool {
    let mut known = values.iter().filter(|value| value.is_finite());
    known
        .next()
        .is_some_and(|first| known.any(|value| value != first))
}
