//! The board as designed against the firmware's own composition, and the simulation against the one that explains.

// A drive of one segment is a list of one range.
#![allow(clippy::single_range_in_vec_init)]

use std::{fs, path::Path};

use crate::command::{SIMULATE, twin};
use crate::host_board::{HostBoard, Step};
use crate::ideal_board::{Event, Row, Timing};
use core_logic::configuration::Configuration;
use twin::{
    effects::{
        Clues, LIBRARY,
        scene::{Scale, mean_flow},
    },
    explain,
    model::{FrontEndKind, Model},
    prepare::{Inputs, Prepared, Purpose, prepare},
    problem::{
        Base, BatteryBase, Coloured, Drive, Moments, Observed, Problem, SensorBase, Series,
        Stretches, View,
    },
    simulate::{
        board::{Board, Pace},
        command::{Readings, columns},
        designed,
    },
};

/// Through both ranges, both signs, with steps and rests.
fn profile() -> Vec<Row> {
    let mut rows = Vec::new();
    for k in 0..1200 {
        let t_s = f64::from(k) * 0.1;
        let current_a = match k % 400 {
            0..100 => 0.0,
            100..200 => 12.0 * (0.8 * t_s).sin(),
            200..300 => 150.0 * (0.3 * t_s).sin() + 5.0,
            _ => 45.0,
        };
        rows.push(Row {
            t_s,
            current_a,
            cell_v: 3.7,
        });
    }
    rows
}

fn drive(rows: &[Row]) -> Drive {
    Drive {
        t_s: rows.iter().map(|row| row.t_s).collect(),
        reference: rows.iter().map(|row| row.current_a).collect(),
        segments: vec![0..rows.len()],
        continues: vec![false],
        ..Drive::default()
    }
}

fn observed(t_s: impl Into<Series>) -> Observed {
    let t_s = t_s.into();
    let rows = t_s.len();
    Observed {
        held_s: 0.0,
        thinned_from_s: 0.0,
        grid: 0.0,
        t_s,
        value: vec![f64::NAN; rows],
        valid: vec![true; rows],
        stretches: Stretches::one(rows),
        moments: Moments::Own,
    }
}

#[test]
fn the_board_reports_what_the_firmwares_composition_does() {
    let rows = profile();
    let mut host = HostBoard::new(&rows, Timing::default(), Configuration::default());
    // Reading and charge after each conversion.
    let (mut t_s, mut current, mut charge, mut edge) =
        (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let mut edges = 0;
    while let Some(step) = host.step() {
        if let Step::Event(Event::Conversion { at_us, .. }) = step {
            t_s.push(at_us as f64 * 1e-6);
            current.push(f64::from(host.measurement.current().current.get()) * 1e-6);
            charge.push(host.meter.report().charge_total.get() as f64 * 1e-9);
            edge.push(host.world.edges != edges);
            edges = host.world.edges;
        }
    }
    assert!(edges >= 8, "{edges} range changes");
    let board = Board::new(FrontEndKind::DualRange, 1).unwrap();
    let reported = board.run(&drive(&rows), false, &observed(t_s), Pace::Seen, true);
    let mut compared = 0;
    for row in 5..current.len() {
        // The composition masks conversions with an edge and the settling after it.
        if edge[row] || edge[row - 1] || reported.current_a[row].is_nan() {
            continue;
        }
        let step = board.step_a()
            * if reported.range_high[row] > 0.5 {
                10.0
            } else {
                1.0
            };
        let apart = (reported.current_a[row] - current[row]).abs();
        // The same conversion through the same code: a code at most, where rounding falls the other way.
        assert!(
            apart <= 1.01 * step,
            "row {row}: {} and {}",
            reported.current_a[row],
            current[row]
        );
        compared += 1;
    }
    assert!(compared > 3000, "{compared}");
    // The composition reads its meter every 20 ms, late by up to that at 150 A (3 C); and 30 mC a range change.
    let last = charge.len() - 1;
    let bound = 150.0 * 0.02 + 0.0302 * edges as f64 + 0.067;
    assert!(
        (reported.charge_c[last] - charge[last]).abs() < bound,
        "{} and {}",
        reported.charge_c[last],
        charge[last]
    );
}

#[test]
fn the_counter_counts_the_charge() {
    let rows = profile();
    let drive = drive(&rows);
    let mut flowed = vec![0.0];
    for pair in rows.windows(2) {
        let last = flowed[flowed.len() - 1];
        flowed.push(last + 0.5 * (pair[0].current_a + pair[1].current_a) * 0.1);
    }
    for kind in [
        FrontEndKind::DualRange,
        FrontEndKind::Hah1bv,
        FrontEndKind::Network,
        FrontEndKind::ClosedLoop,
    ] {
        let board = Board::new(kind, 1).unwrap();
        let reported = board.run(
            &drive,
            false,
            &observed(drive.t_s.clone()),
            Pace::Free,
            true,
        );
        let changes = reported
            .range_high
            .windows(2)
            .filter(|pair| pair[0] != pair[1])
            .count();
        let step = board.charge_step_c() * if changes > 0 { 10.0 } else { 1.0 };
        for (row, (counted, flowed)) in reported.charge_c.iter().zip(&flowed).enumerate() {
            // A count, and the hidden fraction of one at each range change.
            let bound = 1.1 * step + 0.0302 * changes as f64;
            assert!(
                (counted - flowed).abs() < bound,
                "{kind:?} row {row}: {counted} and {flowed}"
            );
        }
    }
}

#[test]
fn a_reading_is_the_current_within_half_a_step() {
    for (kind, level) in [
        (FrontEndKind::DualRange, 33.0),
        (FrontEndKind::Hah1bv, -412.0),
        (FrontEndKind::Network, 250.0),
        (FrontEndKind::ClosedLoop, 299.0),
    ] {
        let board = Board::new(kind, 8).unwrap();
        let t_s: Vec<f64> = (0..200).map(|k| f64::from(k) * 0.05).collect();
        let drive = Drive {
            reference: vec![level; 200].into(),
            segments: vec![0..200],
            continues: vec![false],
            t_s: t_s.clone().into(),
            ..Drive::default()
        };
        let reported = board.run(&drive, false, &observed(t_s), Pace::Free, false);
        for current in reported.current_a {
            assert!(
                (current - level).abs() <= 0.51 * board.step_a(),
                "{kind:?}: {current}"
            );
        }
    }
    // Steps by hand: 120 A · 5 V / 4.5 V / 2¹³ codes; 5 V / 2¹³ / 4 mV/A.
    let step = |kind| Board::new(kind, 1).unwrap().step_a();
    assert!((step(FrontEndKind::DualRange) - 60.0 / 2.25 * 5.0 / 8192.0).abs() < 1e-9);
    assert!((step(FrontEndKind::Hah1bv) - 5.0 / 8192.0 / 0.004).abs() < 1e-9);
}

#[test]
fn the_range_changes_with_hysteresis() {
    let board = Board::new(FrontEndKind::DualRange, 1).unwrap();
    let t_s: Vec<f64> = (0..2001).map(|k| f64::from(k) * 0.1).collect();
    // Up to 60 A and back in 200 s.
    let reference: Vec<f64> = t_s.iter().map(|t| 60.0 - 0.6 * (t - 100.0).abs()).collect();
    let drive = Drive {
        reference: reference.clone().into(),
        segments: vec![0..2001],
        continues: vec![false],
        t_s: t_s.clone().into(),
        ..Drive::default()
    };
    let reported = board.run(&drive, false, &observed(t_s), Pace::Free, false);
    let changes: Vec<f64> = (1..2001)
        .filter(|row| reported.range_high[*row] != reported.range_high[row - 1])
        .map(|row| reference[row])
        .collect();
    assert_eq!(changes.len(), 2);
    // 4.5 V and 20 mV back, at 37.5 mV/A; a row is 0.06 A, a conversion 0.02 A.
    assert!((changes[0] - 53.333).abs() < 0.13, "{}", changes[0]);
    assert!((changes[1] - 52.8).abs() < 0.13, "{}", changes[1]);
}

fn problem(view: View, base: Base, drive: Drive, observed: Observed) -> Problem {
    Problem {
        view,
        name: "x".into(),
        unit: "A".into(),
        drive,
        observed,
        base,
        modelled: Vec::new(),
        noise: 0.0,
        coloured: Coloured::default(),
        accuracy: Default::default(),
    }
}

/// A battery as designed, by a code of its own: open-circuit voltage at the counted state of charge, less the ohmic drop, or the state of
/// charge in %; between the drive's rows in straight lines.
fn battery_by_hand(base: &BatteryBase, drive: &Drive, t_s: &[f64], view: View) -> Vec<f64> {
    let line = |points: &[(f64, f64)], at: f64| {
        let after = points.partition_point(|(x, _)| *x <= at);
        let from = after.clamp(1, points.len() - 1) - 1;
        let ((x0, y0), (x1, y1)) = (points[from], points[from + 1]);
        y0 + (y1 - y0) * (at - x0) / (x1 - x0)
    };
    let mut soc = base.initial_soc[0];
    let simulated: Vec<(f64, f64)> = (0..drive.len())
        .map(|row| {
            let now = drive.reference[row];
            if row > 0 {
                let h_s = drive.t_s[row] - drive.t_s[row - 1];
                soc -= mean_flow(drive.reference[row - 1], now, base.efficiency) * h_s
                    / (3600.0 * base.capacity_ah);
            }
            let value = match view {
                View::StateOfCharge => 100.0 * soc,
                _ => line(&base.ocv, soc) - base.resistance_ohm * now,
            };
            (drive.t_s[row], value)
        })
        .collect();
    let last_s = simulated[simulated.len() - 1].0;
    t_s.iter()
        .map(|t| line(&simulated, t.min(last_s)))
        .collect()
}

/// The simulation of a sensor and the one that explains are two codes, and so is a battery's and the one here: without effects they have
/// to agree.
#[test]
fn explaining_begins_where_simulating_ends() {
    let rows = profile();
    let drive = drive(&rows);
    let own: Vec<f64> = (0..900).map(|k| 3.0 + f64::from(k) * 0.123).collect();
    let shared = Observed {
        moments: Moments::EveryRow,
        ..observed(drive.t_s.clone())
    };
    let battery = BatteryBase {
        capacity_ah: 2.0,
        efficiency: 0.99,
        initial_soc: vec![0.8],
        ocv: vec![(0.0, 3.0), (0.3, 3.5), (1.0, 4.1)],
        cells: 1.0,
        resistance_ohm: 0.001,
        ..BatteryBase::default()
    };
    let sensor = |window_s, held_reference| {
        Base::Sensor(SensorBase {
            window_s,
            held_reference,
            ..SensorBase::default()
        })
    };
    let cases = [
        (View::Sensor, sensor(0.0, false), shared.clone()),
        (View::Sensor, sensor(0.0, false), observed(own.clone())),
        (View::Sensor, sensor(0.0, true), observed(own.clone())),
        (View::Sensor, sensor(0.7, false), shared.clone()),
        (View::Charge, sensor(0.0, false), observed(own.clone())),
        (View::Charge, sensor(0.0, true), observed(own.clone())),
        (
            View::StateOfCharge,
            Base::Battery(battery.clone()),
            shared.clone(),
        ),
        (View::Voltage, Base::Battery(battery.clone()), shared),
        (View::Voltage, Base::Battery(battery), observed(own)),
    ];
    for (index, (view, base, observed)) in cases.into_iter().enumerate() {
        let problem = problem(view, base, drive.clone(), observed);
        let here = match &problem.base {
            Base::Battery(base) => {
                battery_by_hand(base, &problem.drive, &problem.observed.t_s, view)
            }
            Base::Sensor(_) => designed(&problem),
        };
        let there = explain::predict(&problem, &[]);
        assert_eq!(here.len(), there.len());
        if matches!(problem.base, Base::Sensor(_)) {
            // What of the readings counts is no matter of what they are.
            let mut some = problem.clone();
            some.observed.valid = (0..here.len()).map(|row| row % 7 > 2).collect();
            let again = explain::predict(&some, &[]);
            assert!(
                there
                    .iter()
                    .zip(&again)
                    .all(|(a, b)| a.to_bits() == b.to_bits())
            );
        }
        let mut compared = 0;
        for (row, (here, there)) in here.iter().zip(&there).enumerate() {
            if here.is_nan() && there.is_nan() {
                continue;
            }
            assert!(
                (here - there).abs() < 1e-9,
                "case {index}, row {row}: {here} and {there}"
            );
            compared += 1;
        }
        assert!(compared >= 899, "case {index}: {compared}");
    }
}

/// A thinned recording is simulated as the whole one is: the rows that are left have the same values.
#[test]
fn thinned_readings_are_those_of_the_whole_recording() {
    let rows = profile();
    let drive = drive(&rows);
    let shared = Observed {
        moments: Moments::EveryRow,
        value: drive.reference.to_vec(),
        valid: (0..rows.len()).map(|row| row % 10 != 3).collect(),
        ..observed(drive.t_s.clone())
    };
    let own_s: Vec<f64> = (0..900).map(|k| 3.0 + f64::from(k) * 0.123).collect();
    let own = Observed {
        value: vec![1.0; own_s.len()],
        ..observed(own_s)
    };
    let effects = [
        ("gain", vec![1.02]),
        ("lag", vec![0.3]),
        ("moving-average", vec![0.5]),
        ("sampled-window", vec![1.1, 0.6, 0.2]),
        ("delay", vec![0.07]),
        ("clock-skew", vec![300.0]),
        ("hum", vec![1.7, 0.5, 0.3]),
        ("dead-band", vec![3.0]),
        ("quantisation", vec![0.5]),
    ];
    let sensor = SensorBase::default();
    for (name, observed) in [("shared rows", shared), ("own rows", own)] {
        let base = Base::Sensor(sensor.clone());
        let whole = problem(View::Sensor, base, drive.clone(), observed);
        let thinned = whole.clone().thinned(200);
        let left = thinned.observed.t_s.len();
        assert!((101..=200).contains(&left), "{name}: {left}");
        let row_of = |t_s: &f64| whole.observed.t_s.iter().position(|there_s| there_s == t_s);
        let kept: Vec<usize> = thinned
            .observed
            .t_s
            .iter()
            .map(|t| row_of(t).unwrap())
            .collect();
        assert!(kept.iter().all(|&row| whole.observed.valid[row]), "{name}");
        for of in std::iter::once(&[][..]).chain(effects.chunks(1)) {
            let of: Vec<(String, Vec<f64>)> = of
                .iter()
                .map(|(id, values)| ((*id).to_owned(), values.clone()))
                .collect();
            let (all, some) = (
                explain::predict(&whole, &of),
                explain::predict(&thinned, &of),
            );
            for (&row, some) in kept.iter().zip(some) {
                let apart = (all[row] - some).abs();
                assert!(
                    apart < 1e-9,
                    "{name}, {of:?}, row {row}: {} and {some}",
                    all[row]
                );
            }
        }
    }
    let charge = problem(
        View::Charge,
        Base::Sensor(sensor),
        drive.clone(),
        observed(drive.t_s.clone()),
    );
    assert_eq!(charge.thinned(200).observed.t_s.len(), rows.len());
}

fn prepared(folder: &Path, model: &str, recording: &str, purpose: Purpose) -> (Model, Prepared) {
    let path = folder.join("r.csv");
    fs::write(&path, recording).unwrap();
    let model = Model::parse("m.toml", model.to_owned(), folder).unwrap();
    let inputs = Inputs {
        recording: path,
        ..Inputs::default()
    };
    let prepared = prepare(&model, &inputs, purpose).unwrap();
    (model, prepared)
}

fn recording() -> String {
    let mut text = "t_s,i_ref_a,i_meas_a\n".to_owned();
    for row in profile() {
        text.push_str(&format!(
            "{},{},{}\n",
            row.t_s,
            row.current_a,
            1.01 * row.current_a + 0.3
        ));
    }
    text
}

/// "After" in the report is what the extended model simulates.
#[test]
fn an_extended_model_reproduces_the_explanation() {
    let folder = tempfile::tempdir().unwrap();
    let effects = [
        ("offset".to_owned(), vec![0.3]),
        ("lag".to_owned(), vec![0.4]),
        ("gain".to_owned(), vec![1.01]),
    ];
    for front_end in ["pair", "dual-range"] {
        let plain = format!("schema = 1\n[sensor]\nfront_end = \"{front_end}\"\n");
        let extended = format!(
            "{plain}[effects.offset]\noffset_a = 0.3\n[effects.lag]\ntau_s = 0.4\n[effects.gain]\ngain = 1.01\n"
        );
        let (_, plain) = prepared(folder.path(), &plain, &recording(), Purpose::Compare);
        let after = explain::predict(&plain.items[0].problem, &effects);
        let (model, extended) = prepared(folder.path(), &extended, &recording(), Purpose::Compare);
        assert_eq!(extended.items[0].problem.modelled.len(), 3);
        let written = columns(&model, &extended, Readings::Stepped);
        let again = &written
            .iter()
            .find(|(name, _)| name == "i_meas_a")
            .unwrap()
            .1;
        let mut compared = 0;
        for (row, (after, again)) in after.iter().zip(again).enumerate() {
            if after.is_finite() {
                assert!(
                    (after - again).abs() < 1e-9,
                    "{front_end}, row {row}: {after} and {again}"
                );
                compared += 1;
            }
        }
        assert!(compared > 1000, "{compared}");
    }
}

/// Where readings stand for an earlier moment and come in steps by design, they do with effects and without.
#[test]
fn steps_and_moments_by_design_hold_with_effects_too() {
    let folder = tempfile::tempdir().unwrap();
    let simulated = |keys: &str, effects: &str| {
        let text = format!("schema = 1\n[sensor]\nfront_end = \"pair\"\n{keys}{effects}");
        let (model, prepared) = prepared(folder.path(), &text, &recording(), Purpose::Simulate);
        let written = columns(&model, &prepared, Readings::Stepped);
        let found = written.iter().find(|(name, _)| name == "i_meas_a");
        found.unwrap().1.clone()
    };
    let offset = "[effects.offset]\noffset_a = 10\n";
    for keys in [
        "step = 0.5\n",
        "alignment_s = 0.04\n",
        "step = 0.5\nalignment_s = 0.04\n",
    ] {
        let [without, with] = ["", offset].map(|effects| simulated(keys, effects));
        let plain = simulated("", "");
        let mut moved = 0;
        for ((without, with), plain) in without.iter().zip(&with).zip(&plain) {
            assert!(
                (without + 10.0 - with).abs() < 1e-9,
                "{keys}: {without} {with}"
            );
            if keys.starts_with("step") {
                assert_eq!((with / 0.5).fract(), 0.0, "{with}");
            }
            moved += usize::from((without - plain).abs() > 1e-3);
        }
        assert!(moved > 300, "{keys}: {moved}");
    }
}

/// The least that a model file may hold of a value, where that is nothing, is a number in the simulation as well.
#[test]
fn nothing_of_a_value_is_a_number_or_is_refused() {
    let rows = profile();
    let mut drive = drive(&rows);
    let count = rows.len();
    drive.sensor_temperature_c = Some(vec![40.0; count].into());
    drive.ambient_c = Some(vec![10.0; count].into());
    drive.supply_v = Some(vec![4.9; count].into());
    drive.aux_a = Some(vec![30.0; count].into());
    drive.range_high = Some(
        rows.iter()
            .map(|row| f64::from(u8::from(row.current_a.abs() > 50.0)))
            .collect(),
    );
    let sensor = Base::Sensor(SensorBase {
        full_scale: Some(600.0),
        ..SensorBase::default()
    });
    let battery = Base::Battery(BatteryBase {
        capacity_ah: 100.0,
        efficiency: 1.0,
        initial_soc: vec![0.5],
        ocv: vec![(0.0, 3.0), (0.5, 3.6), (1.0, 4.1)],
        cells: 1.0,
        resistance_ohm: 0.001,
        ..BatteryBase::default()
    });
    let scale = Scale {
        largest: 150.0,
        full_scale: 600.0,
        rms: 60.0,
        both_ways: 20.0,
        step_s: 0.1,
        reading_step_s: 0.1,
        spectral_step_s: 0.1,
        even_s: 0.1,
        fastest_s: 0.002,
        span_s: 120.0,
        operation_s: 120.0,
        capacity_ah: 100.0,
        resistance_ohm: 0.001,
        soc: (0.1, 0.9),
        ..Scale::default()
    };
    let clues = Clues {
        t_s: &[],
        observed: &[],
        predicted: &[],
    };
    let problems = [
        (View::Sensor, &sensor),
        (View::StateOfCharge, &battery),
        (View::Voltage, &battery),
    ]
    .map(|(view, base)| {
        problem(
            view,
            base.clone(),
            drive.clone(),
            observed(drive.t_s.clone()),
        )
    });
    let (mut tried, mut lacking) = (0, Vec::new());
    for effect in LIBRARY {
        let card = effect.card();
        for problem in problems.iter().filter(|problem| effect.applies(problem)) {
            let Some(start) = effect.starts(&scale, &clues).pop() else {
                continue;
            };
            for (p, parameter) in card.parameters.iter().enumerate() {
                if parameter.limits.0 != 0.0 {
                    continue;
                }
                let mut values = start.clone();
                values[p] = 0.0;
                let said = explain::predict(problem, &[(card.id.to_owned(), values.clone())]);
                let numbers = said.iter().filter(|value| value.is_finite()).count();
                if numbers != count {
                    lacking.push(format!(
                        "{} {}: {numbers} with {values:?}",
                        card.id, parameter.name
                    ));
                }
                tried += 1;
            }
        }
    }
    assert!(tried > 15, "{tried}");
    assert!(lacking.is_empty(), "of {count} rows: {lacking:?}");
}

/// Unrounded, readings with a step are those without one.
#[test]
fn a_step_can_be_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let simulated = |keys: &str, readings: Readings| {
        let text = format!("schema = 1\n[sensor]\nfront_end = \"pair\"\n{keys}");
        let (model, prepared) = prepared(folder.path(), &text, &recording(), Purpose::Simulate);
        let written = columns(&model, &prepared, readings);
        let found = written.iter().find(|(name, _)| name == "i_meas_a");
        found.unwrap().1.clone()
    };
    for effects in ["", "[effects.offset]\noffset_a = 10.1\n"] {
        let plain = simulated(effects, Readings::Stepped);
        let stepped = format!("step = 0.5\n{effects}");
        assert_eq!(simulated(&stepped, Readings::Unrounded), plain);
        assert_ne!(simulated(&stepped, Readings::Stepped), plain);
    }
}

/// Unrounded, a counter with a step is one without, of readings without one.
#[test]
fn a_counters_step_can_be_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let counted = |step: &str, step_c: &str, readings: Readings| {
        let text = format!("schema = 1\n[sensor]\n{step}[charge]\n{step_c}");
        let (model, prepared) = prepared(folder.path(), &text, &recording(), Purpose::Simulate);
        let written = columns(&model, &prepared, readings);
        let found = written.iter().find(|(name, _)| name == "q_meas_c");
        found.unwrap().1.clone()
    };
    let plain = counted("", "", Readings::Stepped);
    for (step, step_c) in [
        ("step = 5\n", ""),
        ("", "step_c = 20\n"),
        ("step = 5\n", "step_c = 20\n"),
    ] {
        // Not assert_eq: it would show thousands of numbers.
        assert!(
            counted(step, step_c, Readings::Unrounded) == plain,
            "{step}{step_c}"
        );
        assert!(
            counted(step, step_c, Readings::Stepped) != plain,
            "{step}{step_c}"
        );
    }
}

/// Where the reference holds its values, as a cycler's with rare rows in its rests, a counter without effects is that of the recording;
/// so it is where the columns' names do not tell the unit.
#[test]
fn a_counter_of_a_held_reference_counts_what_was_held() {
    let folder = tempfile::tempdir().unwrap();
    let (mut t_s, mut charge_c) = (0.0, 0.0);
    let mut rows = Vec::new();
    for _ in 0..40 {
        // A rest of one row, and a load of 89 s.
        for (current_a, length_s, count) in [(0.0, 60.0, 1), (100.0, 1.0, 89)] {
            for _ in 0..count {
                rows.push((t_s, current_a, charge_c));
                t_s += length_s;
                charge_c += current_a * length_s;
            }
        }
    }
    for (reference, measured) in [("i_ref_a", "i_meas_a"), ("shunt", "hall")] {
        let mut recording = format!("t_s,{reference},{measured},q_meas_c\n");
        for (t_s, current_a, charge_c) in &rows {
            recording.push_str(&format!("{t_s},{current_a},{current_a},{charge_c}\n"));
        }
        let model = format!(
            "schema = 1\n[sensor]\nreference = \"{reference}\"\nmeasured = \"{measured}\"\nheld_reference = true\n[charge]\n"
        );
        let (model, prepared) = prepared(folder.path(), &model, &recording, Purpose::Simulate);
        let written = columns(&model, &prepared, Readings::Stepped);
        let counted = written.iter().find(|(name, _)| name == "q_meas_c");
        let counted = &counted.unwrap().1;
        assert_eq!(counted.len(), rows.len());
        for (counted, (t_s, _, charge_c)) in counted.iter().zip(&rows) {
            assert!((counted - charge_c).abs() < 1e-6, "{t_s} s: {counted} C");
        }
    }
}

/// A board's readings are codes, with and without `--no-step`; that is said, and of no other sensor.
#[test]
fn that_a_boards_codes_stay_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("r.csv"), recording()).unwrap();
    for (front_end, is_board) in [("pair", false), ("dual-range", true), ("network", true)] {
        let model = format!("schema = 1\n[sensor]\nfront_end = \"{front_end}\"\n");
        fs::write(folder.join("m.toml"), model).unwrap();
        for no_step in [false, true] {
            let more = if no_step { &["--no-step"][..] } else { &[] };
            let arguments: Vec<&str> = SIMULATE.iter().chain(more).copied().collect();
            let output = twin(folder, &arguments);
            assert_eq!(output.status.code(), Some(0), "{output:?}");
            let said = String::from_utf8(output.stdout).unwrap();
            assert_eq!(said.contains("--no-step"), is_board && no_step, "{said}");
        }
    }
}

/// Where the reference has a clock of its own, a battery is simulated at the recording's rows, whichever of the two has more of them.
#[test]
fn a_battery_beside_another_clock_is_simulated_at_the_recordings_rows() {
    let load = |t_s: f64| {
        let k = (t_s / 7.3) as usize;
        [2.0, 9.0, -3.0, 14.0, 5.0][(31 * k * k + 17 * k) % 101 % 5] + 0.3 * (0.9 * t_s).sin()
    };
    let battery = "[battery]\ncapacity_ah = 60\ninitial_soc = 0.9\nocv = [[0, 3], [1, 4]]\n";
    for (reference_s, recording_s) in [(0.1, 1.0), (1.0, 0.1), (0.5, 0.5)] {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path();
        let mut shunt = "t_s,i_ref_a\n".to_owned();
        for k in 0..=(300.0 / reference_s) as usize {
            let t_s = k as f64 * reference_s;
            shunt.push_str(&format!("{t_s},{}\n", load(t_s)));
        }
        // The recording lies within it, 100 s later by a clock of its own.
        let begin_s = 20.0;
        let mut sensor = "t_s,i_meas_a\n".to_owned();
        let rows = (260.0 / recording_s) as usize;
        for k in 0..rows {
            let since_s = k as f64 * recording_s;
            sensor.push_str(&format!(
                "{},{}\n",
                since_s + 120.0,
                load(begin_s + since_s) + 0.2
            ));
        }
        let alone = format!("schema = 1\n{battery}");
        let (model, whole) = prepared(folder, &alone, &shunt, Purpose::Simulate);
        let whole = columns(&model, &whole, Readings::Stepped);
        fs::write(folder.join("shunt.csv"), &shunt).unwrap();
        fs::write(folder.join("sensor.csv"), &sensor).unwrap();
        let text = format!("schema = 1\n[sensor]\n{battery}");
        let model = Model::parse("m.toml", text, folder).unwrap();
        let inputs = Inputs {
            recording: folder.join("sensor.csv"),
            reference: Some(folder.join("shunt.csv")),
            ..Inputs::default()
        };
        let beside = prepare(&model, &inputs, Purpose::Simulate).unwrap();
        let written = columns(&model, &beside, Readings::Stepped);
        for (name, tolerance) in [("soc_pct", 0.01), ("v_cell_v", 1e-4)] {
            let of = |written: &[(String, Vec<f64>)]| {
                written
                    .iter()
                    .find(|(known, _)| known == name)
                    .unwrap()
                    .1
                    .clone()
            };
            let (there, whole) = (of(&written), of(&whole));
            assert_eq!(there.len(), rows);
            for (row, value) in there.iter().enumerate() {
                let at = (begin_s + row as f64 * recording_s) / reference_s;
                let before = at as usize;
                let expected =
                    whole[before] + (at - before as f64) * (whole[before + 1] - whole[before]);
                assert!(
                    (value - expected).abs() < tolerance,
                    "{reference_s} {recording_s} {name}, row {row}: {value} and {expected}"
                );
            }
        }
    }
}

/// What the effects of a model file add to the current, the board's meter counts.
#[test]
fn the_meter_counts_what_effects_add() {
    let folder = tempfile::tempdir().unwrap();
    let charge = |effects: &str| {
        let text = format!("schema = 1\n[sensor]\nfront_end = \"dual-range\"\n{effects}");
        let (model, prepared) = prepared(folder.path(), &text, &recording(), Purpose::Simulate);
        let written = columns(&model, &prepared, Readings::Stepped);
        let counted = written.iter().find(|(name, _)| name == "q_meas_c").unwrap();
        (
            *counted.1.last().unwrap(),
            *prepared.t_s.last().unwrap() - prepared.t_s[0],
        )
    };
    let (plain, span_s) = charge("");
    let (extended, _) = charge("[effects.offset]\noffset_a = 5\n");
    let added = extended - plain;
    assert!(
        (added - 5.0 * span_s).abs() < 1e-3 * added,
        "{added} C in {span_s} s"
    );
}

#[test]
fn simulating_needs_nothing_but_the_drive() {
    let folder = tempfile::tempdir().unwrap();
    let mut text = "t_s,i_ref_a\n".to_owned();
    for row in profile() {
        text.push_str(&format!("{},{}\n", row.t_s, row.current_a));
    }
    let model = "schema = 1\n[sensor]\nfront_end = \"dual-range\"\n[battery]\ncapacity_ah = 100\ninitial_soc = 0.5\n\
                 ocv = [[0, 3.0], [1, 4.0]]\nohmic_resistance_ohm = 0.001\n";
    let (model, prepared) = prepared(folder.path(), model, &text, Purpose::Simulate);
    let written = columns(&model, &prepared, Readings::Stepped);
    let names: Vec<&str> = written.iter().map(|(name, _)| name.as_str()).collect();
    assert_eq!(
        names,
        ["t_s", "i_meas_a", "soc_pct", "v_cell_v", "q_meas_c"]
    );
    let column = |name: &str| &written.iter().find(|(known, _)| known == name).unwrap().1;
    // 45 A at the end: open circuit less the ohmic drop.
    let (soc, volts) = (column("soc_pct")[1199], column("v_cell_v")[1199]);
    assert!((volts - (3.0 + soc / 100.0 - 0.045)).abs() < 1e-9);
    // A straight line counts what the state of charge has lost, within counts and range changes.
    let charge = column("q_meas_c")[1199];
    assert!(
        (charge - (50.0 - soc) / 100.0 * 100.0 * 3600.0).abs() < 1.0,
        "{charge} {soc}"
    );
}

/// A current that swings by 200 A at 2 rad/s (283 A/s rms), at rows of 10 ms.
fn swinging(rows: usize) -> Drive {
    let t_s: Vec<f64> = (0..rows).map(|k| k as f64 * 0.01).collect();
    Drive {
        reference: t_s.iter().map(|t| 200.0 * (2.0 * t).sin()).collect(),
        segments: std::iter::once(0..rows).collect(),
        continues: vec![false],
        t_s: t_s.into(),
        ..Drive::default()
    }
}

/// How far from the board's readings they are that are told from the rows that saw them, in A, where each conversion ends at
/// `ends` of its number times the period.
fn apart_where_conversions_wander(ends: impl Fn(f64) -> f64) -> f64 {
    let board = Board::new(FrontEndKind::Hah1bv, 1).unwrap();
    // 32.5 ms, as the firmware's single conversions follow one another.
    let period_s = 1.04 * board.conversion_s();
    let drive = swinging(9000);
    let t_s = drive.t_s.clone();
    let ended: Vec<f64> = (1..)
        .map(|number| ends(f64::from(number)) * period_s)
        .take_while(|end_s| *end_s < 89.9)
        .collect();
    // What a board reports whose rows are the conversions themselves.
    let exact = observed(ended.clone());
    let read = board
        .run(&drive, false, &exact, Pace::Seen, false)
        .current_a;
    let mut seen = observed(t_s.clone());
    seen.valid.fill(false);
    let mut true_a = vec![f64::NAN; t_s.len()];
    for (end_s, current_a) in ended.iter().zip(read) {
        let row = t_s.partition_point(|t| t < end_s);
        seen.valid[row] = true;
        seen.value[row] = current_a;
        true_a[row] = current_a;
    }
    let again = board.run(&drive, false, &seen, Pace::Seen, false).current_a;
    let squares: Vec<f64> = (500..8500)
        .filter(|row| seen.valid[*row])
        .map(|row| (true_a[row] - again[row]).powi(2))
        .collect();
    (squares.iter().sum::<f64>() / squares.len() as f64).sqrt()
}

#[test]
fn conversions_may_wander() {
    let even = apart_where_conversions_wander(|number| number);
    // By 3 ms to either side and back in half a minute.
    let wander = apart_where_conversions_wander(|number| number + 0.1 * (0.007 * number).sin());
    // The two periods beat: of each four conversions rows leave a quarter of a step open, 1.25 ms to either side, at 283 A/s rms.
    // An even grid would leave the other by 3 ms / √2, 0.6 A.
    let open_a = 0.35;
    assert!(even < open_a && wander < open_a, "{even} {wander}");
}

/// Rows of 10 ms see a conversion up to 10 ms late; the conversions themselves come evenly.
#[test]
fn conversions_are_even_though_rows_see_them_late() {
    let board = Board::new(FrontEndKind::Hah1bv, 1).unwrap();
    let period_s = board.conversion_s();
    let drive = swinging(6000);
    let t_s = drive.t_s.clone();
    let rows = observed(t_s.clone());
    let free = board.run(&drive, false, &rows, Pace::Free, false).current_a;
    let mut seen = rows.clone();
    for row in 1..6000 {
        let done = |row: usize| (t_s[row] / period_s + 1e-9).floor();
        seen.valid[row] = done(row) != done(row - 1);
    }
    // What was read; a stretch in which nothing changes tells nothing of the grid, and is counted by the row.
    seen.value.clone_from(&free);
    for row in 3000..3500 {
        seen.value[row] = 7.0;
        seen.valid[row] = row % 5 == 0;
    }
    let again = board.run(&drive, false, &seen, Pace::Seen, false).current_a;
    // 400 A/s: 10 ms late would be 4 A. The grid is found within half a millisecond, and codes are 0.15 A.
    for row in (100..3000).chain(3510..6000) {
        let apart = (free[row] - again[row]).abs();
        assert!(
            apart < 0.2 + board.step_a(),
            "row {row}: {} and {}",
            free[row],
            again[row]
        );
    }
}
