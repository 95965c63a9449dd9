//! Which readings are new, and which are held ones that were read again.

use std::borrow::Cow;

use super::series::{between_rows, median, share_rows};
use super::{Frame, seconds};
use crate::range::range;

/// Share of repeats, while the reference moves, from which a sensor is read more often than it measures.
const HELD_SHARE: f64 = 0.2;
/// A value is measured again after this many intervals at the latest: half an interval is what the time of either may be off by. A
/// little less, for where rows are a whole part of the interval, rounding of the time stamps is not to decide.
const AGAIN: f64 = 1.5 - 1e-4;
/// Of readings that come again up to this share come a third time by chance.
const BY_CHANCE: f64 = 0.1;
/// Readings that differ by no more than this share of the largest one are the same: some thousand roundings of a double (2.2e-16).
const DIGITS: f64 = 1e-12;
/// The reference moves if it changes by this many of the sensor's own steps.
const MOVING_STEPS: f64 = 2.0;

/// Which rows hold something new.
#[derive(Clone, Debug)]
pub struct Freshness {
    /// True where the value counts as new.
    pub rows: Vec<bool>,
    /// Time between two new values, in s, if values are held; else `None`.
    pub interval_s: Option<f64>,
}

impl Freshness {
    /// Every row.
    pub fn all(rows: usize) -> Self {
        Self {
            rows: vec![true; rows],
            interval_s: None,
        }
    }
}

/// What is said of held readings.
pub fn is_held(name: &str, interval_s: f64) -> String {
    format!(
        "{name} is read more often than it is measured: a new value about every {}; repeats are left out",
        seconds(interval_s)
    )
}

/// Decides it for one column. `beside` says that the reference is in the same file, on the same rows or on others; without one, changes
/// of the value have to tell.
///
/// `stated_s` is the time between two new readings by design, 0 if nothing is stated.
///
/// A sensor that repeats itself at its highest or lowest value, or at one value above all (zero), does not hold: that is
/// clipping or a dead band.
pub fn freshness(
    frame: &Frame,
    reference: &[f64],
    value: &[f64],
    beside: bool,
    stated_s: f64,
) -> Freshness {
    let t_s = frame.t_s();
    let rows = value.len();
    let pairs = || pairs(frame, value);
    let [low, high] = range(value.iter().copied()).unwrap_or_default();
    let digits = DIGITS * low.abs().max(high.abs());
    let same = |before: usize, after: usize| (value[after] - value[before]).abs() <= digits;
    let Some(step) = smallest_step(pairs(), value, digits) else {
        return Freshness::all(rows);
    };
    let favourite = most_repeated(
        pairs().filter(|(before, after)| same(*before, *after)),
        value,
    );
    let beside = beside.then(|| at_readings(frame, reference, value));
    let moves = |before: usize, after: usize| {
        beside.as_ref().is_none_or(|reference| {
            (reference[after] - reference[before]).abs() > MOVING_STEPS * step
        })
    };
    let (mut moved, mut repeated, mut at_once) = (0_usize, 0_usize, 0_usize);
    let mut last_repeat = None;
    for (before, after) in pairs() {
        let now = value[before];
        let special = now == low || now == high || Some(now) == favourite;
        if special || !moves(before, after) {
            continue;
        }
        moved += 1;
        if same(before, after) {
            repeated += 1;
            at_once += usize::from(last_repeat == Some(before));
            last_repeat = Some(after);
        }
    }
    let mut apart: Vec<f64> = pairs()
        .map(|(before, after)| t_s[after] - t_s[before])
        .collect();
    let step_s = median(&mut apart).unwrap_or_default();
    drop(apart);
    let is_stated = step_s > 0.0 && step_s < 0.75 * stated_s;
    let is_seen = moved >= 10 && repeated as f64 >= HELD_SHARE * moved as f64;
    if !is_stated && !is_seen {
        return Freshness::all(rows);
    }
    // Time between changes where the reference moved, so that a rest does not look like a slow sensor.
    let mut last_change: Option<f64> = None;
    let mut spans = Vec::new();
    let mut fresh = vec![false; rows];
    let mut before_row = usize::MAX;
    for (before, after) in pairs() {
        if before != before_row {
            // The first reading of a clock.
            fresh[before] = true;
            last_change = None;
        }
        before_row = after;
        if !same(before, after) {
            if let Some(since) = last_change {
                spans.push(t_s[after] - since);
            }
            last_change = Some(t_s[after]);
        }
    }
    let interval_s = if is_stated {
        stated_s
    } else {
        let interval_s = median(&mut spans).unwrap_or(0.0);
        // Most change from row to row, and others stay for several rows: no sensor has such an interval.
        if interval_s < AGAIN * step_s && at_once as f64 > BY_CHANCE * repeated as f64 {
            return Freshness::all(rows);
        }
        interval_s
    };
    // A value that stays longer was measured again and came out the same: once for each interval.
    let mut last_fresh = f64::NEG_INFINITY;
    before_row = usize::MAX;
    for (before, after) in pairs() {
        if before != before_row {
            last_fresh = t_s[before];
        }
        before_row = after;
        let since = t_s[after] - last_fresh;
        if !same(before, after) || since >= AGAIN * interval_s {
            fresh[after] = true;
            last_fresh = t_s[after];
        }
    }
    Freshness {
        rows: fresh,
        interval_s: Some(interval_s),
    }
}

/// The reference where the readings are: as it was recorded where the two share their rows, else in straight lines between its rows, as
/// everywhere (its last value would jump where a slow one comes, and readings would seem to stay).
fn at_readings<'a>(frame: &Frame, reference: &'a [f64], value: &[f64]) -> Cow<'a, [f64]> {
    let known: Vec<usize> = (0..reference.len())
        .filter(|row| reference[*row].is_finite())
        .collect();
    if share_rows(&known, value) {
        Cow::Borrowed(reference)
    } else {
        Cow::Owned(between_rows(frame, reference))
    }
}

/// Rows of successive readings of one clock.
fn pairs<'a>(frame: &'a Frame, value: &'a [f64]) -> impl Iterator<Item = (usize, usize)> + 'a {
    frame.clocks().iter().flat_map(move |clock| {
        let mut last = None;
        clock
            .clone()
            .filter(move |row| value[*row].is_finite())
            .filter_map(move |row| last.replace(row).map(|before| (before, row)))
    })
}

/// The smallest step there is; not the very smallest, which may be rounding.
fn smallest_step(
    pairs: impl Iterator<Item = (usize, usize)>,
    value: &[f64],
    digits: f64,
) -> Option<f64> {
    let mut steps: Vec<f64> = pairs
        .map(|(before, after)| (value[after] - value[before]).abs())
        .filter(|step| *step > digits)
        .collect();
    if steps.is_empty() {
        return None;
    }
    let few = steps.len() / 100;
    Some(*steps.select_nth_unstable_by(few, f64::total_cmp).1)
}

/// Of repeats the value that there are most of.
fn most_repeated(pairs: impl Iterator<Item = (usize, usize)>, value: &[f64]) -> Option<f64> {
    let mut repeats: Vec<f64> = pairs.map(|(before, _)| value[before]).collect();
    repeats.sort_unstable_by(f64::total_cmp);
    repeats
        .chunk_by(|one, other| one == other)
        .max_by_key(|run| run.len())
        .and_then(|run| run.first().copied())
}
