//! A battery's state of charge and voltage.

use std::sync::Arc;

use recording::error::number;

use super::{
    Item, Purpose, Work, checks, counter,
    held::{Freshness, freshness, is_held},
    series, start,
};
use crate::{
    effects::{find_with, quantisation::lattice},
    explain::{self, by_temperature},
    failure::Failure,
    model::{Battery, Model},
    problem::{Accuracy, Base, BatteryBase, Coloured, Drive, Observed, Problem, View},
    report::format::at_most,
    simulate::board::Pace,
};

/// Columns of a voltage.
const CELL: &str = "v_cell_v";
pub(super) const PACK: &str = "v_pack_v";
const SOC: &str = "soc_pct";
/// Column of a tester's charge counter, in Ah.
const COUNTER: &str = "ah_meas_ah";
/// Columns of the current, in the order in which they are looked for.
const CURRENTS: [&str; 2] = ["i_ref_a", "i_meas_a"];

/// So much may a state of charge be beyond empty and full, in %: a capacity and a first reading are hardly known better.
const BEYOND_PCT: f64 = 2.0;

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
    let is_voltage = |(view, _): &(View, &str)| *view == View::Voltage;
    if work.purpose == Purpose::Compare
        && battery.resistance_ohm == 0.0
        && views.iter().any(is_voltage)
    {
        work.remark(
            "[battery] has no ohmic_resistance_ohm: resistance, charge-transfer, polarisation and diffusion, whose sizes go by it, are not \
             looked for"
                .to_owned(),
        );
    }
    if let Some(holds) = battery.current_holds {
        drive.hold(holds);
    }
    let counter_ah = work.drive_frame().column(COUNTER);
    let read = |ah: &[f64]| ah.iter().filter(|value| value.is_finite()).count();
    let all_read = counter_ah.map_or(0, read);
    let counter_ah: Option<Vec<f64>> =
        counter_ah.map(|ah| parts.rows.iter().map(|row| ah[*row]).collect());
    let beside_current = counter_ah.as_deref().map_or(0, read);
    if 2 * beside_current < all_read {
        work.remark(format!(
            "{COUNTER}: {beside_current} of its {all_read} readings are in rows with {current}: the others do not tell the charge between \
             rows and over gaps"
        ));
    }
    let told = counter_ah.as_deref();
    if let Some(told) = told.and_then(|ah| counter::between_rows(&drive, ah)) {
        work.remark(told.remark);
        drive.mean_share = Some(told.mean_share);
        drive.holds = None;
    }
    let mut items = Vec::new();
    for (view, name) in views {
        let value = work.frame.column(name);
        let cells = cells_of(battery, name);
        let (mut observed, rows) = match &value {
            Some(value) => {
                checks::some_values(value, name, work.frame.source())?;
                if work.purpose.compares() {
                    checks::not_constant(value, name, work.frame.source())?;
                }
                let fresh = held(work, view, found, value, battery.resistance_ohm * cells);
                if let Some(interval_s) = fresh.interval_s {
                    work.remark(is_held(name, interval_s));
                }
                work.observe(&drive, &parts.rows, &parts.clocks, value, &fresh)
            }
            None => unread(work, &drive, &parts.rows, &parts.clocks),
        };
        observed.grid = grid(work, name, &observed);
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
            gap_soc_sigma: Vec::new(),
            initial_soc_sigma: Vec::new(),
            ocv,
            cells,
            resistance_ohm: battery.resistance_ohm * cells,
            resistance_sigma: battery.resistance_uncertainty,
            resistances_at_c: battery.resistances_at_c,
            current_zero_a: battery.current_zero_a,
            current_zero_sigma_a: battery.current_zero_uncertainty_a,
            before_sigma_a: 0.0,
            alignment_s: match view {
                View::Voltage => battery.alignment_s,
                _ => 0.0,
            },
        };
        if work.purpose.compares() {
            let frames = [work.frame, work.drive_frame()];
            checks::battery(view, &drive, &observed, &base, frames, [name, &current])?;
        }
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
        start::find(
            work,
            &mut base,
            &start::Readings {
                drive: &drive,
                counter_ah: counter_ah.as_deref(),
                clocks: &parts.clocks,
                observed: &observed,
                view,
                name,
                noise,
            },
            battery,
        );
        if view == View::Voltage && work.purpose.compares() {
            start::leave_out(work, &mut observed, (&drive, &base), name);
        }
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

/// Where a column that was not recorded is simulated: at the recording's rows, which are not the drive's where that is in a file of its
/// own.
fn unread(
    work: &Work<'_>,
    drive: &Drive,
    rows: &Arc<Vec<usize>>,
    clocks: &[usize],
) -> (Observed, Arc<Vec<usize>>) {
    if work.clock.is_none() {
        return (series::every_row(drive), Arc::clone(rows));
    }
    let every = work.frame.t_s().len();
    let (mut observed, rows) = work.observe(
        drive,
        rows,
        clocks,
        &vec![0.0; every],
        &Freshness::all(every),
    );
    observed.value.fill(f64::NAN);
    (observed, rows)
}

/// Cells in series behind a voltage.
fn cells_of(battery: &Battery, name: &str) -> f64 {
    if name == PACK {
        f64::from(battery.cells)
    } else {
        1.0
    }
}

/// Which voltages are new: those that stay while the current's drop over the resistance moves are held. A state of charge moves too little
/// from row to row to tell, and a current of another file is beside other rows.
fn held(
    work: &Work<'_>,
    view: View,
    current_a: &[f64],
    value: &[f64],
    resistance_ohm: f64,
) -> Freshness {
    if view != View::Voltage || resistance_ohm == 0.0 || work.reference.is_some() {
        return Freshness::all(value.len());
    }
    let drop_v: Vec<f64> = current_a.iter().map(|a| resistance_ohm * a).collect();
    freshness(work.frame, &drop_v, value, true, 0.0)
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

/// Says so where the simulation, with the model file's effects, empties or fills a cell by more than all it has.
pub(super) fn out_of_charge(problem: &Problem) -> Option<String> {
    let Base::Battery(base) = &problem.base else {
        return None;
    };
    let counted = Problem {
        view: View::StateOfCharge,
        ..problem.clone()
    };
    let soc_pct = explain::predict(&counted, &[]);
    let t_s = &problem.observed.t_s;
    // Full counts as beyond empty does: what is above 100 %, or below 0 %.
    let beyond = |pct: f64| (pct - 100.0).max(-pct);
    let mut at = t_s.iter().zip(&soc_pct).filter(|(_, pct)| pct.is_finite());
    let (first_s, _) = at.clone().find(|(_, pct)| beyond(**pct) > BEYOND_PCT)?;
    let first = at.next()?;
    let (most_s, most) = at.fold(first, |most, now| {
        if beyond(*now.1) > beyond(*most.1) {
            now
        } else {
            most
        }
    });
    let end = if *most > 100.0 { "full" } else { "empty" };
    let straight = if base.ocv.is_empty() || problem.view == View::StateOfCharge {
        ""
    } else {
        "; the open-circuit voltage is continued in a straight line there"
    };
    Some(format!(
        "the simulated state of charge behind {} runs to {most:.1} % at {} s, and is beyond {end} from {} s on: capacity_ah or \
         initial_soc may be off, or the current's unit or sign{straight}",
        problem.name,
        number(*most_s),
        number(*first_s)
    ))
}

/// A current that empties a cell in an hour takes this many times its open-circuit voltage, or more, over its resistance: that of no
/// vehicle's cell does (the 18650 of the recordings, 2.81 Ah and 22.5 mΩ, takes 1.5 % of it), and one that is stated in thousandths makes fifteen times.
const NO_CELL: f64 = 2.0;

/// What is to be said of a capacity and a resistance that no cell has together.
pub(super) fn in_thousandths(model: &Model) -> Option<String> {
    let battery = model.battery.as_ref()?;
    let full_v = battery
        .ocv
        .iter()
        .fold(0.0, |most, (_, v)| f64::max(most, *v));
    let (capacity_ah, ohm) = (battery.capacity_ah, battery.resistance_ohm);
    let drop_v = capacity_ah * ohm;
    (full_v > 0.0 && drop_v > NO_CELL * full_v).then(|| {
        format!(
            "{}: with capacity_ah = {} and ohmic_resistance_ohm = {}, a current that empties the cell in an hour would take {} V over its \
             resistance, where its open-circuit voltage is {} V at most: no cell is like that; expected Ah and Ω (one of the two may be in \
             thousandths)",
            model.source,
            number(capacity_ah),
            number(ohm),
            at_most(drop_v, 3),
            at_most(full_v, 3)
        )
    })
}

/// A voltage is that of one cell more, or less, if it is off by one cell's to this share of it.
const ONE_CELL: f64 = 0.25;
/// Standard uncertainties of the state of charge at the start within which that may be why.
const MAY_BE_START: f64 = 2.0;
/// A cell's voltage shows in one reading from this many times its noise on.
const SHOWS: f64 = 5.0;

/// What is to be said of a pack that begins at the voltage of one cell more, or less, than the model file states.
pub(super) fn other_cells(problem: &Problem) -> Option<String> {
    let Base::Battery(base) = &problem.base else {
        return None;
    };
    if problem.name != PACK || base.cells < 2.0 {
        return None;
    }
    let observed = &problem.observed;
    let begun = |problem: &Problem| -> Option<(usize, f64)> {
        let said = explain::predict(problem, &[]).into_iter().enumerate();
        let mut told = said.filter(|(row, v)| observed.valid[*row] && v.is_finite());
        told.next()
    };
    let (row, designed_v) = begun(problem)?;
    let off_v = observed.value[row] - designed_v;
    let cell_v = designed_v / base.cells;
    if (off_v.abs() / cell_v - 1.0).abs() > ONE_CELL || cell_v < SHOWS * problem.noise {
        return None;
    }
    let mut moved = problem.clone();
    if let Base::Battery(base) = &mut moved.base {
        let open = MAY_BE_START * base.initial_soc_sigma.first().copied().unwrap_or_default();
        let towards = open.copysign(off_v);
        base.initial_soc.iter_mut().for_each(|soc| *soc += towards);
    }
    let may_be_start = begun(&moved).is_some_and(|(_, v)| (v - designed_v).abs() >= off_v.abs());
    (!may_be_start).then(|| {
        let there = base.cells + off_v.signum();
        format!(
            "{PACK} begins at {} V, where {} cells in series at the stated state of charge make {} V: as {} cells would (cells in [battery]), or \
             initial_soc or the voltage's gain is off",
            at_most(observed.value[row], 5),
            number(base.cells),
            at_most(designed_v, 5),
            number(there)
        )
    })
}

/// What is taken of resistances at temperatures at which the model file does not say what they are.
pub(super) fn beyond_known(problem: &Problem) -> Option<String> {
    let Base::Battery(base) = &problem.base else {
        return None;
    };
    let says = |(id, values): &(&'static str, Vec<f64>)| {
        find_with(id, values.len()).is_some_and(by_temperature)
    };
    let is_open = problem.view == View::Voltage && !problem.modelled.iter().any(says);
    let at_c = base.resistances_at_c.filter(|_| is_open)?;
    explain::beyond_known(&problem.drive, at_c).map(|beyond| format!("{}: {beyond}", problem.name))
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
