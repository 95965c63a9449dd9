//! The state of charge at which a recording begins, and each operation of it.

use std::ops::Range;

use super::{Purpose, Work};
use crate::{
    effects::{
        ocv::bend_v,
        scene::{gap_ah, mean_flow},
    },
    explain::slope::BASE_OFF,
    model::{BEYOND_SOC, Battery},
    problem::{BatteryBase, Drive, Observed, View},
    report::format::count,
};

/// Uncertainty of a cell's voltage from which a state of charge is taken: what the cell has not relaxed from, in V.
const AT_REST_V: f64 = 0.010;
/// Uncertainty of a reading of the state of charge, 0 … 1.
const OF_READING: f64 = 0.005;
/// No reading is worth less than this uncertainty, 0 … 1: where the open-circuit voltage is flat it tells nothing.
const WORTH: f64 = 0.3;
/// What flowed between a reading and a segment's end is off by this share of itself: so much of its capacity a cell has lost that
/// is worn (80 % are commonly its end of life).
const WORN: f64 = 0.2;
/// A tester's counter is believed over a gap if it has followed the current within this share of the capacity before.
const COUNTER_SHARE: f64 = 0.02;
/// A gap that leaves less than this of the state of charge open, 0 … 1, leaves nothing open: where a voltage is as steep as 1 V from full to
/// empty it is a tenth of a millivolt.
const OPEN: f64 = 1e-4;

/// Times as long as a gap over which the charge is not known for which voltages after it are left out: of what the cell does not remember
/// rightly where the gap ends, whatever it forgets in which time, a tenth is left then at most (3³/4⁴).
const FORGOTTEN: f64 = 3.0;
/// No more than this share of the readings is left out after gaps: with more, too little of the recording would be judged.
const MOST_OUT: f64 = 0.1;

/// What was recorded of a battery.
pub(super) struct Readings<'a> {
    pub drive: &'a Drive,
    /// A tester's charge counter on the drive's rows, in Ah, if there is one.
    pub counter_ah: Option<&'a [f64]>,
    /// Clock of each segment.
    pub clocks: &'a [usize],
    pub observed: &'a Observed,
    pub view: View,
    /// Column of the readings.
    pub name: &'a str,
    /// Noise of a reading that the model file states, rms, in the view's unit.
    pub noise: f64,
}

/// A state of charge with its standard uncertainty, both 0 … 1.
type Soc = (f64, f64);

/// Finds the state of charge at the start of each segment, and how uncertain it is at the start of each operation.
pub(super) fn find(
    work: &mut Work<'_>,
    base: &mut BatteryBase,
    readings: &Readings<'_>,
    battery: &Battery,
) {
    let drive = readings.drive;
    let mut end = 1.0;
    let mut bridged = 0;
    let mut open: Vec<f64> = Vec::new();
    let mut further = Further::default();
    for (index, own) in drive.segments.iter().enumerate() {
        let mut excess_ah = 0.0;
        let mut gap_sigma = 0.0;
        let first = if drive.is_continued(index) {
            let gap_s = drive.t_s[own.start] - drive.t_s[own.start - 1];
            // The counter is beside the current as it was recorded; through the battery flows what is left of that without its zero.
            let recorded_a = [drive.reference[own.start - 1], drive.reference[own.start]];
            let ends_a = recorded_a.map(|end_a| end_a - base.current_zero_a);
            let before = &drive.segments[index - 1];
            let counted = readings
                .counter_ah
                .and_then(|ah| over_gap(ah, drive, before.clone(), own.start, battery.capacity_ah));
            let left_ah = |excess_ah| gap_ah(ends_a, gap_s, excess_ah, battery.efficiency);
            let line = end - left_ah(0.0) / battery.capacity_ah;
            match counted {
                Some(ah) => excess_ah = ah - gap_ah(recorded_a, gap_s, 0.0, 1.0),
                None => {
                    let sigma = gap_s * line_sigma_a(drive, index) / 3600.0 / battery.capacity_ah;
                    let sigma = sigma.max(contradicted(base, readings, index, line - end));
                    if sigma <= OPEN {
                        bridged += 1;
                    } else {
                        gap_sigma = sigma.min(1.0 / BASE_OFF);
                        open.push(gap_sigma);
                        if let Some(seen) = seen(base, readings, index) {
                            let flowed_ah =
                                (end - weighted((line, sigma), seen)) * battery.capacity_ah;
                            let charged = if flowed_ah < 0.0 {
                                battery.efficiency
                            } else {
                                1.0
                            };
                            excess_ah = flowed_ah / charged - gap_ah(ends_a, gap_s, 0.0, 1.0);
                        }
                    }
                }
            }
            end - left_ah(excess_ah) / battery.capacity_ah
        } else {
            let (first, sigma) = begun(work, base, readings, battery, index, &mut further);
            base.initial_soc_sigma.push(sigma);
            first
        };
        base.initial_soc.push(first);
        base.gap_excess_ah.push(excess_ah);
        base.gap_soc_sigma.push(gap_sigma);
        end = first - flowed(base, drive, own.clone());
    }
    further.tell(work, readings.name);
    if bridged > 0 {
        work.remark(format!(
            "{bridged} gaps in the current: the charge over them is taken from a straight line between its ends"
        ));
    }
    if !open.is_empty() {
        work.remark(format!(
            "{} gaps in the current over which its charge is not known: a straight line between its ends leaves up to {:.1} points of per \
             cent of the state of charge open, which {} tells",
            open.len(),
            100.0 * open.iter().fold(0.0, |most: f64, sigma| most.max(*sigma)),
            readings.name
        ));
    }
}

/// Leaves voltages out that follow a gap over which the charge is not known: what a cell remembers of its last minutes nobody knows, and
/// what it remembers for longer goes by the charge. Too many of them are left out for a part of that time each.
pub(super) fn leave_out(
    work: &mut Work<'_>,
    observed: &mut Observed,
    (drive, base): (&Drive, &BatteryBase),
    name: &str,
) {
    let since = |row: usize| {
        let segment = observed.segment_of(row);
        let is_open = base
            .gap_soc_sigma
            .get(segment)
            .is_some_and(|sigma| *sigma > 0.0);
        let start = drive.segments[segment].start;
        is_open.then(|| {
            let gap_s = drive.t_s[start] - drive.t_s[start - 1];
            (observed.t_s[row] - drive.t_s[start]) / gap_s
        })
    };
    let mut after: Vec<(f64, usize)> = (0..observed.t_s.len())
        .filter(|row| observed.valid[*row])
        .filter_map(|row| Some((since(row).filter(|gaps| *gaps < FORGOTTEN)?, row)))
        .collect();
    after.sort_by(|a, b| a.0.total_cmp(&b.0));
    after.truncate((MOST_OUT * observed.valid_rows() as f64) as usize);
    if !after.is_empty() {
        work.remark(format!(
            "{} readings of {name} after such gaps are left out: what the battery remembers of the current there is not known",
            after.len()
        ));
    }
    for (_, row) in after {
        observed.valid[row] = false;
    }
}

/// The operations after the first, each of which begins somewhere of its own, whatever is stated of the first.
#[derive(Debug, Default)]
struct Further {
    /// States of charge that a first reading tells, 0 … 1.
    told: Vec<f64>,
    /// How many there are that no reading tells of.
    untold: usize,
}

impl Further {
    /// A log may have hundreds of them: what is said is said of all.
    fn tell(&self, work: &mut Work<'_>, name: &str) {
        let ends = self.told.iter().fold(None, |ends, &soc| {
            let [low, high] = ends.unwrap_or([soc, soc]);
            Some([f64::min(low, soc), f64::max(high, soc)])
        });
        match (ends.map(|ends| ends.map(|soc| 100.0 * soc)), self.told.len()) {
            (Some([soc, _]), 1) => work.remark(format!(
                "1 further operation begins where its first reading of {name} says, {soc:.1} %"
            )),
            (Some([low, high]), told) => work.remark(format!(
                "{told} further operations begin where their first reading of {name} says, {low:.1} … {high:.1} %"
            )),
            (None, _) => {}
        }
        if self.untold > 0 {
            work.remark(format!(
                "{} whose beginning {name} does not tell: a full battery is assumed there",
                count(self.untold, "further operation")
            ));
        }
    }
}

/// Where an operation begins, at a segment: as stated, if that is of this operation, else as its first reading tells.
fn begun(
    work: &mut Work<'_>,
    base: &BatteryBase,
    readings: &Readings<'_>,
    battery: &Battery,
    index: usize,
    further: &mut Further,
) -> Soc {
    let sigma = battery.initial_soc_uncertainty;
    let stated = battery.initial_soc.map(|soc| (soc, sigma));
    let is_first = readings.clocks[index] == 0;
    let stated = stated.filter(|_| is_first);
    let name = readings.name;
    let seen = if stated.is_some() && work.purpose == Purpose::Compare {
        None
    } else {
        seen(base, readings, index)
    };
    let told = |(soc, sigma): Soc| format!("{:.1} % ± {:.1} %", 100.0 * soc, 100.0 * sigma);
    match (stated, seen) {
        (Some(stated), None) => stated,
        // What is stated is said of the fitted recording: another one may begin there too, but need not.
        (Some(stated), Some(seen)) => {
            let apart = (stated.0 - seen.0).abs();
            if apart <= BASE_OFF * stated.1.hypot(seen.1) {
                return (weighted(stated, seen), stated.1.max(seen.1));
            }
            work.remark(format!(
                "{name} does not begin at the stated initial_soc of {:.1} %: {} taken from its first reading",
                100.0 * stated.0,
                told(seen)
            ));
            seen
        }
        (None, Some(seen)) => {
            if is_first {
                work.remark(format!(
                    "initial_soc is not stated: {} taken from the first reading of {name}",
                    told(seen)
                ));
            } else {
                further.told.push(seen.0);
            }
            (seen.0, sigma.max(seen.1))
        }
        (None, None) => {
            if is_first {
                work.remark(format!(
                    "initial_soc is not stated and {name} does not tell it: a full battery is assumed"
                ));
            } else {
                further.untold += 1;
            }
            (1.0, 1.0)
        }
    }
}

/// Mean of two values by the inverse squares of their uncertainties; the first one, if it is exact.
fn weighted(one: Soc, other: Soc) -> f64 {
    let (own, others) = (one.1 * one.1, other.1 * other.1);
    let all = own + others;
    if all > 0.0 {
        (one.0 * others + other.0 * own) / all
    } else {
        one.0
    }
}

/// Ah over rows of a segment of a current that reads `zero_a` without one, charging times the efficiency.
fn charge_ah(drive: &Drive, rows: Range<usize>, zero_a: f64, efficiency: f64) -> f64 {
    let mut charge = 0.0;
    for row in rows.start + 1..rows.end {
        let ends = drive.ends(row, [drive.reference[row - 1], drive.reference[row]]);
        let [from, to] = ends.map(|end_a| end_a - zero_a);
        let mean_a = mean_flow(from, to, efficiency);
        charge += mean_a * (drive.t_s[row] - drive.t_s[row - 1]);
    }
    charge / 3600.0
}

/// What a tester's counter says of a gap, if it followed the current before.
fn over_gap(
    ah: &[f64],
    drive: &Drive,
    before: Range<usize>,
    after: usize,
    capacity_ah: f64,
) -> Option<f64> {
    let last = before.end - 1;
    let counted = ah[last] - ah[before.start];
    let flowed = charge_ah(drive, before, 0.0, 1.0);
    let over = ah[after] - ah[last];
    let follows = (counted - flowed).abs() <= COUNTER_SHARE * capacity_ah;
    (follows && over.is_finite() && over.abs() <= capacity_ah).then_some(over)
}

/// How far the mean current over the gap before a segment may be from that of a straight line between its ends, in A, as a standard
/// uncertainty: as far as the current itself is from it over as long before the gap and after it. A current that stays as it is there
/// is taken to do so in the gap.
fn line_sigma_a(drive: &Drive, segment: usize) -> f64 {
    let after = drive.segments[segment].start;
    let (from_s, to_s) = (drive.t_s[after - 1], drive.t_s[after]);
    let mean_a = 0.5 * (drive.reference[after - 1] + drive.reference[after]);
    let near_s = 2.0 * from_s - to_s..=2.0 * to_s - from_s;
    let (mut squares, mut time_s) = (0.0, 0.0);
    // Of the same operation, in which time goes on from segment to segment.
    let (before, behind) = drive.segments.split_at(segment);
    let reaching = before.iter().enumerate().rev().take_while(|(index, rows)| {
        drive.is_continued(index + 1) && drive.t_s[rows.end - 1] >= *near_s.start()
    });
    let reached = behind.iter().enumerate().take_while(|(index, rows)| {
        (*index == 0 || drive.is_continued(segment + index))
            && drive.t_s[rows.start] <= *near_s.end()
    });
    let around = segment - reaching.count()..segment + reached.count();
    for rows in drive.segments[around].iter().cloned() {
        let times = &drive.t_s[rows.clone()];
        let near = times.partition_point(|t| t < near_s.start())
            ..times.partition_point(|t| t <= near_s.end());
        for row in rows.start + near.start + 1..rows.start + near.end {
            let ends = drive.ends(row, [drive.reference[row - 1], drive.reference[row]]);
            let [from, to] = ends.map(|end_a| end_a - mean_a);
            let step_s = drive.t_s[row] - drive.t_s[row - 1];
            squares += (from * from + from * to + to * to) / 3.0 * step_s;
            time_s += step_s;
        }
    }
    if time_s > 0.0 {
        return (squares / time_s).sqrt();
    }
    // Lone rows: what the whole drive does is all that is known.
    let off = drive.reference.iter().map(|a| (a - mean_a).powi(2));
    (off.sum::<f64>() / drive.len() as f64).sqrt()
}

/// By how much the readings on both sides of a gap contradict what a line says of the state of charge, 0 … 1; 0 if they do not: nothing was
/// recorded of a trip that began and ended within a rest.
fn contradicted(base: &BatteryBase, readings: &Readings<'_>, segment: usize, line: f64) -> f64 {
    let before = last_seen(base, readings, segment - 1);
    let (Some(before), Some(after)) = (before, seen(base, readings, segment)) else {
        return 0.0;
    };
    let off = (after.0 - before.0 - line).abs();
    if off > BASE_OFF * before.1.hypot(after.1) {
        off
    } else {
        0.0
    }
}

/// State of charge at the start of a segment from its first reading, and what flowed until then.
fn seen(base: &BatteryBase, readings: &Readings<'_>, segment: usize) -> Option<Soc> {
    let first = read_rows(readings.observed, segment).next()?;
    let ((soc, sigma), at) = seen_at(base, readings, first)?;
    let until = readings.drive.segments[segment].start..at + 1;
    let lost = flowed(base, readings.drive, until);
    Some((soc + lost, sigma.hypot(WORN * lost)))
}

/// The same at its end from its last one.
fn last_seen(base: &BatteryBase, readings: &Readings<'_>, segment: usize) -> Option<Soc> {
    let last = read_rows(readings.observed, segment).last()?;
    let ((soc, sigma), at) = seen_at(base, readings, last)?;
    let since = at..readings.drive.segments[segment].end;
    let lost = flowed(base, readings.drive, since);
    Some((soc - lost, sigma.hypot(WORN * lost)))
}

/// State of charge, 0 … 1, that a battery loses over some rows of a segment.
fn flowed(base: &BatteryBase, drive: &Drive, rows: Range<usize>) -> f64 {
    charge_ah(drive, rows, base.current_zero_a, base.efficiency) / base.capacity_ah
}

/// Rows of a segment that were read.
fn read_rows(observed: &Observed, segment: usize) -> impl Iterator<Item = usize> + '_ {
    let rows = observed.stretches.of(segment);
    rows.filter(|row| observed.valid[*row] && observed.value[*row].is_finite())
}

/// State of charge from a reading, by the current then, and the drive's row of that.
fn seen_at(base: &BatteryBase, readings: &Readings<'_>, row: usize) -> Option<(Soc, usize)> {
    let (drive, observed) = (readings.drive, readings.observed);
    let drive_row = observed.drive_row_before(drive, row)?;
    let value = observed.value[row];
    // Noise of that one reading, and what rounding takes of it.
    let noise = readings.noise.hypot(observed.grid / 12f64.sqrt());
    if readings.view == View::StateOfCharge {
        let soc = (value / 100.0, OF_READING.hypot(noise / 100.0));
        return Some((soc, drive_row));
    }
    let current_a = drive.reference[drive_row] - base.current_zero_a;
    let rest_v = base.cells * AT_REST_V;
    let there = inverse(&base.ocv, value + base.resistance_ohm * current_a, rest_v)?;
    // A voltage under load says little.
    let loaded_v = 0.5 * base.resistance_ohm * current_a.abs();
    let within_v = (rest_v + loaded_v).hypot(noise);
    let within_v = within_v.hypot(there.bend_v);
    Some((
        (there.soc, (within_v / there.slope_v).min(WORTH)),
        drive_row,
    ))
}

/// Where an open-circuit voltage is on the table.
struct Place {
    /// State of charge, 0 … 1 or little beyond.
    soc: f64,
    /// Slope of the line that it is on, in V.
    slope_v: f64,
    /// What the curve may be off that line by half-way between its points, in V.
    bend_v: f64,
}

/// The state of charge at an open-circuit voltage. Beyond the table its last line goes on, over `beyond_v` at most: a cell that was
/// charged further than the table's is there, but so is one that has not relaxed.
fn inverse(ocv: &[(f64, f64)], volts: f64, beyond_v: f64) -> Option<Place> {
    let (first, last) = (ocv.first()?, ocv.last()?);
    let lines = ocv.len().checked_sub(1).filter(|lines| *lines > 0)?;
    let slope_v = |line: usize| (ocv[line + 1].1 - ocv[line].1) / (ocv[line + 1].0 - ocv[line].0);
    let is_there = |line: &usize| {
        let (from, to) = (ocv[*line].1, ocv[line + 1].1);
        from <= volts && volts <= to && to > from
    };
    let line = (0..lines).find(is_there);
    let (line, volts) = match line {
        Some(line) => (line, volts),
        None if volts < first.1 => (0, volts.max(first.1 - beyond_v)),
        None => (lines - 1, volts.min(last.1 + beyond_v)),
    };
    let slope_v = slope_v(line).max(1e-3);
    let beyond = |soc: f64| soc.clamp(first.0 - BEYOND_SOC, last.0 + BEYOND_SOC);
    Some(Place {
        soc: beyond(ocv[line].0 + (volts - ocv[line].1) / slope_v),
        slope_v,
        bend_v: bend_v(ocv, line),
    })
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    const TABLE: [(f64, f64); 3] = [(0.0, 3.0), (0.5, 3.6), (1.0, 4.1)];

    #[test]
    fn a_voltage_beyond_the_table_is_little_beyond_it() {
        let soc = |volts| inverse(&TABLE, volts, 0.01).unwrap().soc;
        let close = |soc: f64, expected: f64| assert!((soc - expected).abs() < 1e-12, "{soc}");
        close(soc(3.3), 0.25);
        close(soc(4.105), 1.005);
        // A charger's last volts are no charge.
        close(soc(4.5), 1.01);
        close(soc(2.0), -0.01 / 1.2);
    }

    #[test]
    fn a_start_is_the_mean_of_what_is_stated_and_what_is_read_by_what_they_are_worth() {
        let close = |soc: f64, expected: f64| assert!((soc - expected).abs() < 1e-12, "{soc}");
        close(weighted((0.9, 0.01), (0.91, 0.01)), 0.905);
        close(weighted((0.9, 0.01), (0.92, 0.03)), 0.902);
        close(weighted((0.9, 0.0), (0.92, 0.03)), 0.9);
        close(weighted((0.9, 0.0), (0.92, 0.0)), 0.9);
    }
}
