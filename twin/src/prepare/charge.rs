//! The charge counter: differences of its readings over time, as mean currents.

use std::sync::Arc;

use core_logic::design_parameters::METER_POLL_MS;

use super::{FEWEST_ROWS, Item, Purpose, Work, checks, phase, series};
use crate::{
    effects::{
        quantisation::grid,
        scene::{Cursor, integral},
    },
    failure::Failure,
    model::Sensor,
    problem::{Accuracy, Base, Coloured, Drive, Observed, Problem, SensorBase, View},
    report::format::at_most,
    simulate::board::{Board, Pace},
};

/// Time over which two readings of the counter are compared if nothing is stated: a count of the board's small range is
/// then 6.7 mA.
const INTERVAL_S: f64 = 1.0;
/// A reading can be older or younger than stated by a tick of the board, two of which make a period of the meter's polling:
/// its start decides which tick tells first of a reading.
const TICK_S: f64 = METER_POLL_MS as f64 * 0.5e-3;
/// A mean current this many times beyond the largest reference is no charge but a counter that was set anew.
const RESET: f64 = 3.0;

/// Differences of readings are the same within this share of the largest reading.
const SAME: f64 = 1e-9;
/// Readings of a counter with steps move by each of their amounts so often, in the mean.
const REPEATED: usize = 3;
/// A counter with steps strays from the charge by at least this share of a step in the middle of its readings (evenly spread
/// remainders at both ends: 0.29).
const KEPT: f64 = 0.05;
/// A step below this share of what the counter moves by is fine enough to be none.
const FINE: f64 = 1e-3;

/// The problem of the counter; `None` where nothing is to be compared.
pub(super) fn item(
    work: &mut Work<'_>,
    sensor: &Sensor,
    board: Option<&Board>,
    drive: &Drive,
    clocks: &[usize],
    column: &str,
) -> Result<Option<Item>, Failure> {
    let value = work.frame.need(column)?;
    let known = value.iter().filter(|value| value.is_finite()).count();
    if known < FEWEST_ROWS && work.purpose == Purpose::Simulate {
        return Ok(None);
    }
    checks::some_values(value, column, work.frame.source())?;
    let spec = work.model.charge.clone().unwrap_or_default();
    let every = vec![true; value.len()];
    let (mut readings, rows) = match &work.clock {
        Some(clock) => series::own_rows(drive, clocks, work.frame.clocks(), clock, value, &every),
        None => series::own_rows(
            drive,
            clocks,
            work.frame.clocks(),
            work.frame.t_s(),
            value,
            &every,
        ),
    };
    // What the counter said then.
    readings.t_s.iter_mut().for_each(|t| *t -= spec.age_s);
    let interval_s = spec.interval_s.unwrap_or(INTERVAL_S);
    let mut step_c = board.map_or(spec.step_c, Board::charge_step_c);
    if step_c <= 0.0
        && work.purpose.compares()
        && let Some(found_c) = shown_step_c(drive, &readings, sensor.is_held())
    {
        step_c = found_c;
        work.remark(format!(
            "{column} counts in steps of {} C, which the model file does not state: taken as its step_c in [charge]",
            at_most(step_c, 4)
        ));
    }
    let largest = drive
        .reference
        .iter()
        .fold(0.0_f64, |most, i| most.max(i.abs()));
    if work.purpose.compares() {
        checks::counter(drive, &readings, interval_s, work.frame, column)?;
    }
    let (drive, mut observed, rows, resets) =
        differences(drive, &readings, &rows, interval_s, step_c, largest);
    if resets > 0 {
        work.remark(format!(
            "{column} was set anew {}",
            if resets == 1 {
                "once, where a new stretch begins".to_owned()
            } else {
                format!("{resets} times; each begins a new stretch")
            }
        ));
    }
    let spacing_s = series::spacing_s(&observed).max(f64::MIN_POSITIVE);
    let squares: f64 = drive.reference.iter().map(|i| i * i).sum();
    let typical_a = (squares / drive.len().max(1) as f64).sqrt();
    // Steps and uncertain moments are spread evenly: the variance of a width is its square by twelve.
    let noise_c = (spec.noise_c.powi(2)
        + (step_c.powi(2) + (typical_a * spec.jitter_s).powi(2)) / 12.0)
        .sqrt();
    let mut base = SensorBase {
        // A counter has no window of its own.
        step: step_c / spacing_s,
        full_scale: sensor.full_scale,
        range_limit: sensor.range_limit,
        held_reference: sensor.is_held(),
        alignment_s: sensor.alignment_s,
        quasi_static: sensor.quasi_static,
        ..SensorBase::default()
    };
    let mut drive = drive;
    if let Some(board) = board {
        base.full_scale = Some(board.full_scale_a());
        base.range_limit = board.range_limit_a();
        base.range_ratio = board.range_ratio();
        let run = |later_s: f64| {
            let mut earlier = observed.clone();
            earlier.t_s.iter_mut().for_each(|t| *t -= later_s);
            let mut reported = board.run(&drive, sensor.is_held(), &earlier, Pace::Seen, true);
            reported.current_a = means(&earlier, &reported.charge_c);
            reported
        };
        let slack_s = if spec.age_s > 0.0 { TICK_S } else { 0.0 };
        let (tick_s, reported) = phase::closest(0.0, (slack_s, 1), &observed, run);
        // The jitter is a moment that nothing tells, and much the same all over a recording.
        let rate = rates(&drive, &observed, tick_s, sensor.is_held());
        let most_s = 0.5 * spec.jitter_s;
        let later_s = tick_s + phase::later_s(&observed, &reported, &rate).clamp(-most_s, most_s);
        let reported = run(later_s);
        observed.t_s.iter_mut().for_each(|t| *t -= later_s);
        base.reading = reported.current_a;
        if drive.range_high.is_none() && board.has_two_ranges() {
            let every = series::every_row(&drive);
            let flag = board.run(&drive, sensor.is_held(), &every, Pace::Free, false);
            drive.range_high = Some(flag.range_high.into());
        }
    }
    let problem = Problem {
        view: View::Charge,
        name: column.to_owned(),
        unit: "A".to_owned(),
        drive,
        observed,
        base: Base::Sensor(base),
        modelled: Vec::new(),
        // A difference has the noise of both of its readings.
        noise: std::f64::consts::SQRT_2 * noise_c / spacing_s,
        coloured: Coloured::default(),
        accuracy: Accuracy {
            zero: sensor.accuracy.zero,
            gain: sensor.accuracy.gain,
            // What an uncertain moment moves a difference by is no physics either: two moments, each even over its width,
            // √2·width/√12.
            scatter: spec.jitter_s / 6f64.sqrt() / spacing_s,
            moment_s: 0.0,
        },
    };
    Ok(Some(Item {
        problem,
        rows: Arc::new(rows),
        pace: Pace::Seen,
        fresh: Vec::new(),
    }))
}

/// Readings `interval_s` apart as mean currents since the one before; the first of each segment has none. A counter that
/// was set anew begins a segment.
fn differences(
    drive: &Drive,
    readings: &Observed,
    rows: &[usize],
    interval_s: f64,
    step_c: f64,
    largest: f64,
) -> (Drive, Observed, Vec<usize>, usize) {
    let mut drive = drive.clone();
    let mut observed = Observed::default();
    let (mut kept, mut times_s) = (Vec::new(), Vec::new());
    let mut resets = 0;
    // Segments are renumbered where one is cut.
    let mut shift = 0;
    let mut last: Option<(usize, f64, f64)> = None;
    for (index, row) in rows
        .iter()
        .enumerate()
        .filter(|(index, _)| readings.valid[*index])
    {
        let (segment, now_s, charge) = (
            readings.segment_of(index),
            readings.t_s[index],
            readings.value[index],
        );
        let mut mean = f64::NAN;
        if let Some((before, before_s, before_c)) = last
            && before == segment
        {
            let length_s = now_s - before_s;
            let moved = charge - before_c;
            let is_reset = moved.abs() > RESET * (largest * length_s + step_c) + 2.0 * step_c;
            if is_reset {
                let own = drive.segments[segment + shift].clone();
                let cut = own.start + drive.t_s[own.clone()].partition_point(|t| *t < now_s);
                if cut > own.start && cut < own.end {
                    resets += 1;
                    drive.segments[segment + shift] = own.start..cut;
                    drive.segments.insert(segment + shift + 1, cut..own.end);
                    drive.continues.insert(segment + shift + 1, true);
                    shift += 1;
                }
            } else if length_s < interval_s * 0.999 || length_s <= 0.0 {
                continue;
            } else {
                mean = moved / length_s;
            }
        }
        last = Some((segment, now_s, charge));
        times_s.push(now_s);
        observed.value.push(mean);
        observed.valid.push(mean.is_finite());
        observed.stretches.push(segment + shift);
        kept.push(*row);
    }
    observed.t_s = times_s.into();
    (drive, observed, kept, resets)
}

/// The step in which a counter counts, if its readings show one.
///
/// A current of a few even levels moves a counter without steps by few even amounts too. Only one with steps keeps a remainder,
/// and strays by it from the charge of the reference.
fn shown_step_c(drive: &Drive, readings: &Observed, held: bool) -> Option<f64> {
    let passed = integral(&drive.t_s, &drive.segments, &drive.reference, held);
    // Counted and passed from one reading to the next; from its own zero in each stretch.
    let mut moves: Vec<f64> = Vec::new();
    let mut courses: Vec<Vec<(f64, f64)>> = Vec::new();
    let mut largest = 0.0_f64;
    for (segment, rows) in readings.stretches.iter() {
        let own = drive.segments.get(segment).cloned();
        let Some(own) = own.filter(|own| !own.is_empty()) else {
            continue;
        };
        let mut cursor = Cursor::new(&drive.t_s, own);
        let course: Vec<(f64, f64)> = rows
            .filter(|row| readings.valid[*row])
            .map(|row| {
                let there = cursor.integral(&passed, &drive.reference, readings.t_s[row], held);
                (readings.value[row], there)
            })
            .collect();
        moves.extend(course.windows(2).map(|pair| (pair[1].0 - pair[0].0).abs()));
        largest = course
            .iter()
            .fold(largest, |most, one| most.max(one.0.abs()));
        courses.push(course);
    }
    let count = moves.len();
    moves.sort_unstable_by(f64::total_cmp);
    // Digits that a difference of large numbers loses make no other level.
    moves.dedup_by(|next, kept| *next - *kept < SAME * largest);
    if moves.len() * REPEATED > count {
        return None;
    }
    let step_c = grid(&moves)?;
    // Over a step or more of charge: what was counted, and what passed.
    let mut pairs: Vec<(f64, f64)> = Vec::new();
    for course in courses {
        let mut rows = course.into_iter();
        let Some(mut last) = rows.next() else {
            continue;
        };
        for now in rows {
            if (now.1 - last.1).abs() >= step_c {
                pairs.push((now.0 - last.0, now.1 - last.1));
                last = now;
            }
        }
    }
    if pairs.len() < FEWEST_ROWS {
        return None;
    }
    let moved: f64 = pairs.iter().map(|(_, passed)| passed.abs()).sum();
    let (cross, square) = pairs
        .iter()
        .fold((0.0, 0.0), |(cross, square), (counted, passed)| {
            (cross + counted * passed, square + passed * passed)
        });
    let mut strayed: Vec<f64> = pairs
        .iter()
        .map(|(counted, passed)| (counted - cross / square * passed).abs())
        .collect();
    let middle = strayed.len() / 2;
    let strayed = *strayed.select_nth_unstable_by(middle, f64::total_cmp).1;
    // The last digit of a file is no step that matters.
    (strayed > KEPT * step_c && step_c > FINE * moved / pairs.len() as f64).then_some(step_c)
}

/// How fast the mean current of each reading changes if both of its ends are taken earlier, from `later_s` on: in A/s.
fn rates(drive: &Drive, observed: &Observed, later_s: f64, held: bool) -> Vec<f64> {
    let mut rates = vec![f64::NAN; observed.t_s.len()];
    for (segment, rows) in observed.stretches.iter() {
        let own = drive.segments.get(segment).cloned();
        let Some(own) = own.filter(|own| !own.is_empty()) else {
            continue;
        };
        let mut cursor = Cursor::new(&drive.t_s, own);
        let mut last: Option<(f64, f64)> = None;
        for row in rows {
            let now_s = observed.t_s[row] - later_s;
            let now_a = cursor.value(&drive.reference, now_s, held);
            if let Some((before_s, before_a)) = last
                && now_s > before_s
            {
                rates[row] = (before_a - now_a) / (now_s - before_s);
            }
            last = Some((now_s, now_a));
        }
    }
    rates
}

/// The same of a simulated counter.
fn means(observed: &Observed, charge_c: &[f64]) -> Vec<f64> {
    let mut last: Option<(usize, f64, f64)> = None;
    (0..charge_c.len())
        .map(|row| {
            let now = (observed.segment_of(row), observed.t_s[row], charge_c[row]);
            let mean = match last {
                Some((segment, before_s, before_c)) if segment == now.0 && now.1 > before_s => {
                    (now.2 - before_c) / (now.1 - before_s)
                }
                _ => f64::NAN,
            };
            last = Some(now);
            mean
        })
        .collect()
}
