//! A battery's state of charge and voltage.

use std::sync::Arc;

use super::{Item, Purpose, Work, checks, held::Freshness, series};
use crate::{
    effects::{
        quantisation::lattice,
        scene::{gap_ah, mean_flow},
    },
    failure::Failure,
    model::Battery,
    problem::{Accuracy, Base, BatteryBase, Coloured, Drive, Observed, Problem, View},
    report::format::at_most,
    simulate::board::Pace,
};

/// Columns of a voltage.
const CELL: &str = "v_cell_v";
pub(super) const PACK: &str = "v_pack_v";
const SOC: &str = "soc_pct";
/// Columns of the current, in the order in which they are looked for.
const CURRENTS: [&str; 2] = ["i_ref_a", "i_meas_a"];
/// Uncertainty of a voltage from which a state of charge is taken: what the cell has not relaxed from, in V.
const AT_REST_V: f64 = 0.010;
/// A tester's counter is believed over a gap if it has followed the current within this share of the capacity before.
const COUNTER_SHARE: f64 = 0.02;

/// One problem for each column that is there.
pub(super) fn items(work: &mut Work<'_>, battery: &Battery) -> Result<Vec<Item>, Failure> {
    let mut views = Vec::new();
    if work.frame.has(SOC) {
        views.push((View::StateOfCharge, SOC));
    }
    if !battery.ocv.is_empty() {
        for name in [CELL, PACK] {
            if work.frame.has(name) {
                views.push((View::Voltage, name));
            }
        }
    }
    if work.purpose == Purpose::Simulate && views.is_empty() {
        views.push((View::StateOfCharge, SOC));
        if !battery.ocv.is_empty() {
            views.push((View::Voltage, if battery.cells > 1 { PACK } else { CELL }));
        }
    }
    if views.is_empty() {
        return Ok(Vec::new());
    }
    let current = match &battery.current {
        Some(stated) => stated.clone(),
        None => CURRENTS
            .iter()
            .find(|name| work.drive_frame().has(name))
            .unwrap_or(&CURRENTS[0])
            .to_string(),
    };
    let found = work.drive_frame().need(&current)?;
    checks::some_values(found, &current, work.drive_frame().source())?;
    let every = Freshness::all(work.frame.t_s().len());
    if work.reference.is_some() && work.clock.is_none() {
        let sensed = CURRENTS.iter().find_map(|name| work.frame.column(name));
        work.find_clock(found, sensed, &every, "i_meas_a")?;
    }
    let parts = series::drive(work.drive_frame(), found);
    let mut drive = parts.drive;
    work.surroundings(&mut drive, &parts.rows);
    let mut items = Vec::new();
    for (view, name) in views {
        let value = work.frame.column(name);
        let (mut observed, rows) = match &value {
            Some(value) => {
                checks::some_values(value, name, work.frame.source())?;
                if work.purpose == Purpose::Compare {
                    checks::not_constant(value, name, work.frame.source())?;
                }
                work.observe(&drive, &parts.rows, &parts.clocks, value, &every)
            }
            None => (series::every_row(&drive), Arc::clone(&parts.rows)),
        };
        observed.grid = grid(work, name, &observed);
        let cells = if name == PACK {
            f64::from(battery.cells)
        } else {
            1.0
        };
        let ocv: Vec<(f64, f64)> = battery
            .ocv
            .iter()
            .map(|(soc, v)| (*soc, v * cells))
            .collect();
        let mut base = BatteryBase {
            capacity_ah: battery.capacity_ah,
            efficiency: battery.efficiency,
            initial_soc: Vec::new(),
            gap_excess_ah: Vec::new(),
            initial_soc_sigma: battery.initial_soc_uncertainty,
            ocv,
            cells,
            resistance_ohm: battery.resistance_ohm * cells,
            resistance_sigma: battery.resistance_uncertainty,
        };
        if work.purpose == Purpose::Compare {
            let source = work.frame.source();
            checks::battery(view, &drive, &observed, &base, [source, name, &current])?;
        }
        start(
            work,
            &mut base,
            &drive,
            &parts.rows,
            &parts.clocks,
            &observed,
            view,
            battery,
            name,
        );
        let (noise, coloured, accuracy) = match view {
            View::StateOfCharge => (battery.noise_pct, Coloured::default(), battery.accuracy_pct),
            _ => {
                let coloured = Coloured {
                    rms: battery.noise_coloured_v,
                    tau_s: battery.noise_coloured_tau_s,
                };
                let noise = battery.noise_v.hypot(coloured.rms);
                (noise, coloured, battery.accuracy_v)
            }
        };
        items.push(Item {
            problem: Problem {
                view,
                name: name.to_owned(),
                unit: recording::name::unit(name).unwrap_or("1").to_owned(),
                drive: drive.clone(),
                observed,
                base: Base::Battery(base),
                modelled: Vec::new(),
                noise,
                coloured,
                accuracy: Accuracy {
                    zero: accuracy.zero,
                    gain: accuracy.gain,
                    ..Accuracy::default()
                },
            },
            rows,
            pace: Pace::Free,
            fresh: Vec::new(),
        });
    }
    Ok(items)
}

/// Step of the grid on which the readings lie, 0 if there is none.
fn grid(work: &mut Work<'_>, name: &str, observed: &Observed) -> f64 {
    let read = observed.value.iter().zip(&observed.valid);
    let read: Vec<f64> = read.filter(|(_, valid)| **valid).map(|(y, _)| *y).collect();
    let Some(step) = lattice(&read) else {
        return 0.0;
    };
    let unit = recording::name::unit(name).unwrap_or("1");
    work.remark(format!(
        "{name} is read in steps of {} {unit}: what rounding takes from a reading stays as long as the reading does, and counts once",
        at_most(step, 4)
    ));
    step
}

/// What of the battery is there and yet not compared.
pub(super) fn not_compared(work: &mut Work<'_>, battery: &Battery, items: &[Item]) {
    let has = |view| items.iter().any(|item| item.problem.view == view);
    let voltages = [CELL, PACK].map(|name| work.frame.has(name).then_some(name));
    let voltage = voltages.into_iter().flatten().next();
    if let Some(name) = voltage.filter(|_| battery.ocv.is_empty()) {
        work.remark(format!(
            "{name} is not compared: [battery] states neither ocv nor ocv_file"
        ));
    } else if !has(View::StateOfCharge) && !has(View::Voltage) {
        let wanted = if battery.ocv.is_empty() {
            SOC.to_owned()
        } else {
            format!("{SOC}, {CELL} or {PACK}")
        };
        work.remark(format!(
            "[battery] is not compared: no column {wanted} in {}",
            work.frame.source()
        ));
    }
}

/// State of charge at the start of each segment.
#[expect(clippy::too_many_arguments, reason = "the parts of one problem")]
fn start(
    work: &mut Work<'_>,
    base: &mut BatteryBase,
    drive: &Drive,
    rows: &[usize],
    clocks: &[usize],
    observed: &Observed,
    view: View,
    battery: &Battery,
    name: &str,
) {
    let counter = work.drive_frame().column("ah_meas_ah");
    let counter: Option<Vec<f64>> = counter.map(|ah| rows.iter().map(|row| ah[*row]).collect());
    let mut sigma = battery.initial_soc_uncertainty;
    let mut end = 1.0;
    let mut bridged = 0;
    for (index, own) in drive.segments.iter().enumerate() {
        let mut excess_ah = 0.0;
        let first = if drive.is_continued(index) {
            let gap_s = drive.t_s[own.start] - drive.t_s[own.start - 1];
            let ends_a = [drive.reference[own.start - 1], drive.reference[own.start]];
            let before = &drive.segments[index - 1];
            let counted = counter
                .as_ref()
                .and_then(|ah| over_gap(ah, drive, before.clone(), own.start, battery.capacity_ah));
            match counted {
                Some(ah) => excess_ah = ah - gap_ah(ends_a, gap_s, 0.0, 1.0),
                None => bridged += 1,
            }
            end - gap_ah(ends_a, gap_s, excess_ah, battery.efficiency) / battery.capacity_ah
        } else if let Some(stated) = battery.initial_soc.filter(|_| clocks[index] == 0) {
            stated
        } else if let Some((soc, uncertainty)) = seen(base, drive, own.start, observed, index, view)
        {
            sigma = sigma.max(uncertainty);
            work.remark(format!(
                "initial_soc is not stated: {:.1} % ± {:.1} % taken from the first reading of {name}{}",
                100.0 * soc,
                100.0 * uncertainty,
                if index == 0 { String::new() } else { format!(" of stretch {}", index + 1) }
            ));
            soc
        } else {
            work.remark(format!(
                "initial_soc is not stated and {name} does not tell it: a full battery is assumed"
            ));
            sigma = 1.0;
            1.0
        };
        base.initial_soc.push(first);
        base.gap_excess_ah.push(excess_ah);
        end = first - charge_ah(drive, own.clone(), battery.efficiency) / battery.capacity_ah;
    }
    base.initial_soc_sigma = sigma;
    if bridged > 0 {
        work.remark(format!(
            "{bridged} gaps in the current: the charge over them is taken from a straight line between its ends"
        ));
    }
}

/// Ah over a segment: straight lines, charging times the efficiency.
fn charge_ah(drive: &Drive, rows: std::ops::Range<usize>, efficiency: f64) -> f64 {
    let mut charge = 0.0;
    for row in rows.start + 1..rows.end {
        let mean_a = mean_flow(drive.reference[row - 1], drive.reference[row], efficiency);
        charge += mean_a * (drive.t_s[row] - drive.t_s[row - 1]);
    }
    charge / 3600.0
}

/// What a tester's counter says of a gap, if it followed the current before.
fn over_gap(
    ah: &[f64],
    drive: &Drive,
    before: std::ops::Range<usize>,
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

/// State of charge and its uncertainty from the first reading of a segment.
fn seen(
    base: &BatteryBase,
    drive: &Drive,
    first: usize,
    observed: &Observed,
    segment: usize,
    view: View,
) -> Option<(f64, f64)> {
    let row = (0..observed.t_s.len())
        .find(|row| observed.valid[*row] && observed.segment_of(*row) == segment)?;
    let value = observed.value[row];
    if view == View::StateOfCharge {
        return Some((value / 100.0, 0.005));
    }
    let rest_v = value + base.resistance_ohm * drive.reference[first];
    let (soc, slope) = inverse(&base.ocv, rest_v)?;
    // A voltage under load says little.
    let loaded_v = 0.5 * base.resistance_ohm * drive.reference[first].abs();
    Some((soc, ((AT_REST_V + loaded_v) / slope).min(0.3)))
}

/// State of charge at an open-circuit voltage, and the slope there in V.
fn inverse(ocv: &[(f64, f64)], volts: f64) -> Option<(f64, f64)> {
    let (first, last) = (ocv.first()?, ocv.last()?);
    let pair = ocv
        .windows(2)
        .find(|pair| pair[0].1 <= volts && volts <= pair[1].1 && pair[1].1 > pair[0].1);
    let end = |pair: &[(f64, f64)]| ((pair[1].1 - pair[0].1) / (pair[1].0 - pair[0].0)).max(1e-3);
    match pair {
        Some(pair) => {
            let share = (volts - pair[0].1) / (pair[1].1 - pair[0].1);
            Some((pair[0].0 + share * (pair[1].0 - pair[0].0), end(pair)))
        }
        None if volts < first.1 => Some((first.0, end(&ocv[..2]))),
        None => Some((last.0, end(&ocv[ocv.len() - 2..]))),
    }
}
