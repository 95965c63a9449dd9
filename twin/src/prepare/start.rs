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
};

/// Uncertainty of a cell's voltage from which a state of charge is taken: what the cell has not relaxed from, in V.
const AT_REST_V: f64 = 0.010;
/// Uncertainty of a reading of the state of charge, 0 … 1.
const OF_READING: f64 = 0.005;
/// No reading is worth less than this uncertainty, 0 … 1: where the open-circuit voltage is flat it tells nothing.
const WORTH: f64 = 0.3;
/// A tester's counter is believed over a gap if it has followed the current within this share of the capacity before.
const COUNTER_SHARE: f64 = 0.02;

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
    for (index, own) in drive.segments.iter().enumerate() {
        let mut excess_ah = 0.0;
        let first = if drive.is_continued(index) {
            let gap_s = drive.t_s[own.start] - drive.t_s[own.start - 1];
            let ends_a = [drive.reference[own.start - 1], drive.reference[own.start]];
            let before = &drive.segments[index - 1];
            let counted = readings
                .counter_ah
                .and_then(|ah| over_gap(ah, drive, before.clone(), own.start, battery.capacity_ah));
            match counted {
                Some(ah) => excess_ah = ah - gap_ah(ends_a, gap_s, 0.0, 1.0),
                None => bridged += 1,
            }
            end - gap_ah(ends_a, gap_s, excess_ah, battery.efficiency) / battery.capacity_ah
        } else {
            let (first, sigma) = begun(work, base, readings, battery, index);
            base.initial_soc_sigma.push(sigma);
            first
        };
        base.initial_soc.push(first);
        base.gap_excess_ah.push(excess_ah);
        end = first - charge_ah(drive, own.clone(), battery.efficiency) / battery.capacity_ah;
    }
    if bridged > 0 {
        work.remark(format!(
            "{bridged} gaps in the current: the charge over them is taken from a straight line between its ends"
        ));
    }
}

/// Where an operation begins, at a segment: as stated, if that is of this operation, else as its first reading tells.
fn begun(
    work: &mut Work<'_>,
    base: &BatteryBase,
    readings: &Readings<'_>,
    battery: &Battery,
    index: usize,
) -> Soc {
    let sigma = battery.initial_soc_uncertainty;
    let stated = battery.initial_soc.map(|soc| (soc, sigma));
    let stated = stated.filter(|_| readings.clocks[index] == 0);
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
            work.remark(format!(
                "initial_soc is not stated: {} taken from the first reading of {name}{}",
                told(seen),
                if index == 0 {
                    String::new()
                } else {
                    format!(" of stretch {}", index + 1)
                }
            ));
            (seen.0, sigma.max(seen.1))
        }
        (None, None) => {
            work.remark(format!(
                "initial_soc is not stated and {name} does not tell it: a full battery is assumed"
            ));
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

/// Ah over a segment, charging times the efficiency.
fn charge_ah(drive: &Drive, rows: Range<usize>, efficiency: f64) -> f64 {
    let mut charge = 0.0;
    for row in rows.start + 1..rows.end {
        let [from, to] = drive.ends(row, [drive.reference[row - 1], drive.reference[row]]);
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
    let flowed = charge_ah(drive, before, 1.0);
    let over = ah[after] - ah[last];
    let follows = (counted - flowed).abs() <= COUNTER_SHARE * capacity_ah;
    (follows && over.is_finite() && over.abs() <= capacity_ah).then_some(over)
}

/// State of charge at the start of a segment from its first reading.
fn seen(base: &BatteryBase, readings: &Readings<'_>, segment: usize) -> Option<Soc> {
    let (drive, observed) = (readings.drive, readings.observed);
    let mut rows = (0..observed.t_s.len()).filter(|row| observed.segment_of(*row) == segment);
    let row = rows.find(|row| observed.valid[*row] && observed.value[*row].is_finite())?;
    let value = observed.value[row];
    // Noise of that one reading, and what rounding takes of it.
    let noise = readings.noise.hypot(observed.grid / 12f64.sqrt());
    if readings.view == View::StateOfCharge {
        return Some((value / 100.0, OF_READING.hypot(noise / 100.0)));
    }
    let current_a = drive.reference[drive.segments[segment].start];
    let rest_v = base.cells * AT_REST_V;
    let there = inverse(&base.ocv, value + base.resistance_ohm * current_a, rest_v)?;
    // A voltage under load says little.
    let loaded_v = 0.5 * base.resistance_ohm * current_a.abs();
    let within_v = (rest_v + loaded_v).hypot(noise);
    let within_v = within_v.hypot(there.bend_v);
    Some((there.soc, (within_v / there.slope_v).min(WORTH)))
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
