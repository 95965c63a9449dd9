//! Rows of drive and observation.

use std::{ops::Range, sync::Arc};

use super::Frame;
use crate::problem::{Drive, Moments, Observed, Stretches};

/// A step is a gap if it is longer than this many median steps, …
const GAP_STEPS: f64 = 10.0;
/// … than this, in s, …
const SHORTEST_GAP_S: f64 = 5.0;
/// … and than this many times either neighbouring step: a logger that slows down in a rest leaves no gap.
const GAP_OF_NEIGHBOURS: f64 = 10.0;

/// Rows of a reference are as coarse as readings from this share of the time between those on.
const AS_COARSE: f64 = 0.5;
/// A series steps where it moves by less than this share of the step before and after.
const LEVEL: f64 = 0.05;

/// A drive and where its rows are from.
#[derive(Clone, Debug)]
pub(super) struct DriveParts {
    /// Time, reference and segments; no environment yet.
    pub drive: Drive,
    /// Row of the frame that each row is from.
    pub rows: Arc<Vec<usize>>,
    /// Clock of each segment, as an index into [`Frame::clocks`].
    pub clocks: Vec<usize>,
}

/// The rows that have a reference, in segments.
pub(super) fn drive(frame: &Frame, reference: &[f64]) -> DriveParts {
    let time_s = frame.t_s();
    let mut drive = Drive::default();
    let mut clocks = Vec::new();
    let mut known: Vec<usize> = Vec::with_capacity(reference.len());
    let mut t_s: Vec<f64> = Vec::with_capacity(reference.len());
    for (clock, rows) in frame.clocks().iter().enumerate() {
        let first = known.len();
        known.extend(rows.clone().filter(|row| reference[*row].is_finite()));
        t_s.extend(known[first..].iter().map(|row| time_s[*row]));
        let mut start = first;
        let mut continues = false;
        for cut in gaps(&t_s[first..]).into_iter().chain([t_s.len() - first]) {
            let end = first + cut;
            if end > start {
                drive.segments.push(start..end);
                drive.continues.push(continues);
                clocks.push(clock);
                continues = true;
            }
            start = end;
        }
    }
    drive.reference = known.iter().map(|row| reference[*row]).collect();
    drive.t_s = t_s.into();
    DriveParts {
        drive,
        rows: Arc::new(known),
        clocks,
    }
}

/// Rows before which there is a gap.
fn gaps(t_s: &[f64]) -> Vec<usize> {
    let step = |index: usize| t_s[index + 1] - t_s[index];
    let steps = t_s.len().saturating_sub(1);
    let mut positive: Vec<f64> = (0..steps).map(step).filter(|step| *step > 0.0).collect();
    let Some(median) = median(&mut positive) else {
        return Vec::new();
    };
    let least = (GAP_STEPS * median).max(SHORTEST_GAP_S);
    let is_gap = |index: usize| {
        let now = step(index);
        let before = index.checked_sub(1).map_or(0.0, step);
        let after = if index + 1 < steps {
            step(index + 1)
        } else {
            0.0
        };
        now > least && now > GAP_OF_NEIGHBOURS * before.max(after)
    };
    (0..steps)
        .filter(|index| is_gap(*index))
        .map(|index| index + 1)
        .collect()
}

/// Share of the readings with a reference on their own row from which on the two were read together: a reference that is missing
/// there is masked with its reading, never filled in. Two series of their own, joined by time, share few rows, and one that is read
/// twice as often as the other half of them.
const TOGETHER: f64 = 0.6;

/// Whether reading and reference share their rows.
pub(super) fn share_rows(rows: &[usize], value: &[f64]) -> bool {
    let in_drive = rows.iter().filter(|row| value[**row].is_finite()).count();
    let all = value.iter().filter(|value| value.is_finite()).count();
    in_drive as f64 >= TOGETHER * all as f64
}

/// A series at every row of its file: in straight lines between those that have it, NaN ahead of the first and after the last of a clock.
pub(super) fn between_rows(frame: &Frame, values: &[f64]) -> Vec<f64> {
    let t_s = frame.t_s();
    let mut every = values.to_vec();
    for clock in frame.clocks() {
        let mut last: Option<usize> = None;
        for row in clock.clone().filter(|row| values[*row].is_finite()) {
            if let Some(from) = last.replace(row) {
                let step_s = t_s[row] - t_s[from];
                for between in from + 1..row {
                    let share = (t_s[between] - t_s[from]) / step_s.max(f64::MIN_POSITIVE);
                    every[between] = values[from] + share * (values[row] - values[from]);
                }
            }
        }
    }
    every
}

/// An observation on the drive's own rows.
pub(super) fn drive_rows(
    drive: &Drive,
    rows: &Arc<Vec<usize>>,
    value: &[f64],
    fresh: &[bool],
) -> (Observed, Arc<Vec<usize>>) {
    let taken: Vec<f64> = rows.iter().map(|row| value[*row]).collect();
    let observed = Observed {
        t_s: drive.t_s.clone(),
        valid: rows
            .iter()
            .zip(&taken)
            .map(|(row, value)| value.is_finite() && fresh[*row])
            .collect(),
        value: taken,
        stretches: stretches(drive),
        moments: Moments::EveryRow,
        held_s: 0.0,
        thinned_from_s: 0.0,
        grid: 0.0,
    };
    (observed, Arc::clone(rows))
}

/// The rows of the drive, with nothing observed.
pub(super) fn every_row(drive: &Drive) -> Observed {
    Observed {
        t_s: drive.t_s.clone(),
        value: vec![f64::NAN; drive.len()],
        valid: vec![true; drive.len()],
        stretches: stretches(drive),
        moments: Moments::EveryRow,
        held_s: 0.0,
        thinned_from_s: 0.0,
        grid: 0.0,
    }
}

/// The segments of the drive's own rows.
fn stretches(drive: &Drive) -> Stretches {
    let segments = drive.segments.iter().enumerate();
    segments
        .flat_map(|(index, rows)| rows.clone().map(move |_| index))
        .collect()
}

/// An observation on rows of its own: those that have a reading. `sensor_clocks` are the sensor's clocks, each the same
/// as the drive's of the same index.
pub(super) fn own_rows(
    drive: &Drive,
    clocks: &[usize],
    sensor_clocks: &[Range<usize>],
    t_s: &[f64],
    value: &[f64],
    fresh: &[bool],
) -> (Observed, Arc<Vec<usize>>) {
    let mut observed = Observed::default();
    let (mut rows, mut times_s) = (Vec::new(), Vec::new());
    for (clock, own) in sensor_clocks.iter().enumerate() {
        let segments: Vec<usize> = (0..clocks.len())
            .filter(|index| clocks[*index] == clock)
            .collect();
        if segments.is_empty() {
            continue;
        }
        let mut at = 0;
        for row in own.clone().filter(|row| value[*row].is_finite()) {
            let now_s = t_s[row];
            let begins = |index: usize| drive.t_s[drive.segments[segments[index]].start];
            while at + 1 < segments.len() && begins(at + 1) <= now_s {
                at += 1;
            }
            let inside = &drive.segments[segments[at]];
            let covered = drive.t_s[inside.start] <= now_s && now_s <= drive.t_s[inside.end - 1];
            times_s.push(now_s);
            observed.value.push(value[row]);
            observed.valid.push(covered && fresh[row]);
            observed.stretches.push(segments[at]);
            rows.push(row);
        }
    }
    observed.t_s = times_s.into();
    (observed, Arc::new(rows))
}

/// Leaves out the readings between two rows of a reference between which it steps, if those are as far apart as the readings: an
/// edge lies anywhere between two rows of either clock, so nothing tells on which side of it such a reading is. Only those that
/// show either side: what shows the way from one to the other is no edge. How many they are.
pub(super) fn leave_out_beside_steps(drive: &Drive, observed: &mut Observed) -> usize {
    let spacing_s = spacing_s(observed);
    let (t_s, reference) = (&drive.t_s, &drive.reference);
    let steps_at = |row: usize, inside: &Range<usize>| {
        // Level before and after it: a slope goes on.
        if row == inside.start || row + 2 >= inside.end {
            return false;
        }
        let moved = |row: usize| (reference[row + 1] - reference[row]).abs();
        t_s[row + 1] - t_s[row] >= AS_COARSE * spacing_s
            && moved(row - 1).max(moved(row + 1)) < LEVEL * moved(row)
    };
    let shows_a_side = |observed: &Observed, reading: usize| {
        let value = &observed.value;
        if reading == 0 || reading + 1 >= value.len() {
            return false;
        }
        let before = (value[reading] - value[reading - 1]).abs();
        let after = (value[reading + 1] - value[reading]).abs();
        before.min(after) < LEVEL * before.max(after)
    };
    let mut left_out = 0;
    for reading in 0..observed.t_s.len() {
        let Some(inside) = drive.segments.get(observed.segment_of(reading)) else {
            continue;
        };
        let now_s = observed.t_s[reading];
        let after = inside.start + t_s[inside.clone()].partition_point(|t| *t <= now_s);
        // At a row the reference is known.
        if observed.valid[reading]
            && after > inside.start
            && t_s[after - 1] < now_s
            && steps_at(after - 1, inside)
            && shows_a_side(observed, reading)
        {
            observed.valid[reading] = false;
            left_out += 1;
        }
    }
    left_out
}

/// Median time between readings that count, in s; 0 with fewer than two.
pub(super) fn spacing_s(observed: &Observed) -> f64 {
    let mut last: Option<(usize, f64)> = None;
    let mut steps = Vec::new();
    for row in (0..observed.t_s.len()).filter(|row| observed.valid[*row]) {
        let (segment, now_s) = (observed.segment_of(row), observed.t_s[row]);
        if let Some((before, before_s)) = last
            && before == segment
            && now_s > before_s
        {
            steps.push(now_s - before_s);
        }
        last = Some((segment, now_s));
    }
    median(&mut steps).unwrap_or(0.0)
}

/// The value below which a share of some lies; `None` of none.
pub fn quantile(values: &mut [f64], share: f64) -> Option<f64> {
    let last = values.len().checked_sub(1)?;
    let at = (share * last as f64) as usize;
    Some(*values.select_nth_unstable_by(at, f64::total_cmp).1)
}

/// The middle one.
pub(super) fn median(values: &mut [f64]) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let middle = values.len() / 2;
    Some(*values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Surroundings change slowly: a missing value is the last one, at the start the first one. `None` if there is none.
pub(super) fn held_over_gaps(values: impl Iterator<Item = f64>) -> Option<Vec<f64>> {
    let mut values: Vec<f64> = values.collect();
    let mut last = values.iter().copied().find(|value| value.is_finite())?;
    for value in &mut values {
        if value.is_finite() {
            last = *value;
        } else {
            *value = last;
        }
    }
    Some(values)
}

/// The same from rows with another time: the last value at or before each of `wanted`.
pub(super) fn held_at(t_s: &[f64], values: &[f64], wanted: &[f64]) -> Option<Vec<f64>> {
    let mut last = values.iter().copied().find(|value| value.is_finite())?;
    let mut at = 0;
    let held = wanted.iter().map(|now_s| {
        while at < t_s.len() && t_s[at] <= *now_s {
            if values[at].is_finite() {
                last = values[at];
            }
            at += 1;
        }
        last
    });
    Some(held.collect())
}
