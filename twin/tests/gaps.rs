//! A gap in the recording is no new operation: what a cell or a core remembers goes on over it.

use crate::common;
use std::ops::Range;

use twin::effects::find_with;
use twin::explain::{
    predict,
    workbench::{Member, Model, Workbench},
};
use twin::problem::{
    Accuracy, Base, BatteryBase, Coloured, Drive, Observed, Problem, SensorBase, View,
};
use twin::report::data::Verdict;

const ROWS: usize = 1200;
const STEP_S: f64 = 0.5;
/// Rows that are not recorded: the current stays as it was in each, so that a straight line over the gap is what flowed.
const GAPS: [Range<usize>; 3] = [210..390, 610..690, 1010..1090];

/// 200 rows each of a current in A: discharge, rest and charge.
fn current_a(row: usize) -> f64 {
    [6.0, 2.0, -4.0, 0.0, 9.0, -3.0][row / 200] + if row % 200 < 5 { 1.0 } else { 0.0 }
}

/// The recording with or without its gaps, of a view.
fn problem(view: View, base: Base, with_gaps: bool) -> (Problem, Vec<usize>) {
    let rows: Vec<usize> = (0..ROWS)
        .filter(|row| !with_gaps || !GAPS.iter().any(|gap| gap.contains(row)))
        .collect();
    let t_s: Vec<f64> = rows.iter().map(|row| *row as f64 * STEP_S).collect();
    let starts: Vec<usize> = (0..rows.len())
        .filter(|at| *at == 0 || rows[*at] != rows[*at - 1] + 1)
        .collect();
    let ends = starts[1..].iter().copied().chain([rows.len()]);
    let drive = Drive {
        t_s: t_s.clone().into(),
        reference: rows
            .iter()
            .map(|row| current_a(*row))
            .collect::<Vec<_>>()
            .into(),
        segments: starts
            .iter()
            .copied()
            .zip(ends)
            .map(|(a, b)| a..b)
            .collect(),
        continues: (0..starts.len()).map(|index| index > 0).collect(),
        ..Drive::default()
    };
    let mut observed = Observed::with_drive(t_s, vec![0.0; rows.len()]);
    observed.stretches = (0..rows.len())
        .map(|row| {
            drive
                .segments
                .iter()
                .position(|rows| rows.contains(&row))
                .unwrap()
        })
        .collect();
    let problem = Problem {
        view,
        name: "x".into(),
        unit: "1".into(),
        drive,
        observed,
        base,
        modelled: Vec::new(),
        noise: 0.0,
        coloured: Coloured::default(),
        accuracy: Accuracy::default(),
    };
    (problem, rows)
}

/// Whether the rows that both have are the same with an effect, and the effect is there.
#[track_caller]
fn assert_goes_on(view: View, base: &Base, id: &str, values: &[f64]) {
    let said = |with_gaps: bool| {
        let (problem, rows) = problem(view, base.clone(), with_gaps);
        let plain = predict(&problem, &[]);
        let effects = [(id.to_owned(), values.to_vec())];
        (rows, predict(&problem, &effects), plain)
    };
    let ((_, whole, plain), (rows, cut, _)) = (said(false), said(true));
    let largest = whole
        .iter()
        .zip(&plain)
        .fold(0.0f64, |most, (with, without)| {
            most.max((with - without).abs())
        });
    assert!(largest > 1e-4, "{id}: {largest}");
    // The resistance at which a gap's loss is made is that where it begins.
    let tolerance = if id == "cell-self-heating" {
        1e-5
    } else {
        1e-9
    };
    for (row, value) in rows.into_iter().zip(cut) {
        // A clock of another rate points into the gap at first, by what it was off until then: at most three rows here.
        let after_gap = GAPS.iter().any(|gap| (gap.end..gap.end + 3).contains(&row));
        let before_gap = GAPS
            .iter()
            .any(|gap| (gap.start - 3..gap.start).contains(&row));
        if id == "clock-skew" && value.is_nan() && (after_gap || before_gap) {
            continue;
        }
        assert!(
            (value - whole[row]).abs() < tolerance,
            "{id}, row {row}: {value} and {}",
            whole[row]
        );
    }
}

#[test]
fn a_cell_goes_on_over_a_gap() {
    let cell = Base::Battery(BatteryBase {
        capacity_ah: 3.0,
        efficiency: 0.99,
        // As designed, where the gaps begin and end is known to be so only without an effect.
        initial_soc: vec![0.9; 4],
        ocv: vec![(0.0, 3.0), (0.5, 3.6), (1.0, 4.2)],
        cells: 1.0,
        resistance_ohm: 0.02,
        ..BatteryBase::default()
    });
    for (id, values) in [
        ("capacity", vec![2.6]),
        ("coulombic-efficiency", vec![0.9]),
        ("parasitic-load", vec![0.3]),
        ("ocv-hysteresis", vec![0.02, 60.0]),
        ("polarisation", vec![0.01, 40.0]),
        ("polarisation", vec![0.01, 4.0, 0.02, 90.0]),
        ("diffusion", vec![0.03, 300.0]),
        ("cell-self-heating", vec![8.0, 120.0]),
    ] {
        assert_goes_on(View::Voltage, &cell, id, &values);
    }
    for (id, values) in [("capacity", vec![2.6]), ("coulombic-efficiency", vec![0.9])] {
        assert_goes_on(View::StateOfCharge, &cell, id, &values);
    }
}

#[test]
fn a_core_and_its_heat_go_on_over_a_gap() {
    let sensor = Base::Sensor(SensorBase {
        full_scale: Some(10.0),
        range_ratio: 10.0,
        ..SensorBase::default()
    });
    for (id, values) in [
        ("core-hysteresis", vec![0.1, 1.0]),
        ("core-hysteresis", vec![0.1, 1.0, 1.0]),
        ("core-hysteresis", vec![0.1, 1.0, 0.7, 0.2]),
        ("core-hysteresis", vec![0.1, 1.0, 1.5, 0.4, 0.3]),
        ("sensor-self-heating", vec![1e-3, 30.0]),
    ] {
        assert_goes_on(View::Sensor, &sensor, id, &values);
    }
}

#[test]
fn clocks_go_on_over_a_gap() {
    for held_reference in [false, true] {
        let sensor = Base::Sensor(SensorBase {
            held_reference,
            ..SensorBase::default()
        });
        for (id, values) in [
            ("clock-skew", vec![2000.0]),
            ("clock-skew", vec![-2000.0]),
            ("delay", vec![0.8]),
            ("sampled-window", vec![3.7, 0.4, 1.1]),
            ("sampled-window", vec![0.3, 0.5, 0.0]),
        ] {
            assert_goes_on(View::Sensor, &sensor, id, &values);
        }
    }
}

/// Where a clock points into a gap nobody knows what was there: an effect gains nothing by that.
#[test]
fn what_cannot_be_simulated_brings_nothing() {
    let sensor = Base::Sensor(SensorBase::default());
    let (mut problem, rows) = problem(View::Sensor, sensor, true);
    problem.observed.value = rows
        .iter()
        .map(|row| current_a(*row) + 0.3 * (0.71 * *row as f64).sin() + 0.1)
        .collect();
    problem.noise = 0.3;
    problem.coloured = Coloured {
        rms: 0.2,
        tau_s: 5.0,
    };
    let bench = Workbench::new(&problem, &[]);
    assert_eq!(bench.len(), rows.len());
    let before = bench.residual(&bench.plain);
    for ppm in [2000.0, -2000.0, 20_000.0] {
        let model = Model::default().with(Member {
            effect: find_with("clock-skew", 1).unwrap(),
            values: vec![ppm],
        });
        let said = bench.everywhere(&model);
        let after = bench.residual(&bench.run(&model));
        let unknown = (0..rows.len()).filter(|row| !said[*row].is_finite());
        assert!(unknown.clone().count() > 2, "{ppm}");
        for row in unknown {
            assert_eq!(after[row], before[row], "{ppm}, row {row}");
        }
        // The same where the noise is made white, which a reading tells of those after it.
        let white = bench.whitened().unwrap();
        let innovations = white.residual(&white.run(&model));
        for (row, (white, after)) in innovations.iter().zip(white.as_fitted(after)).enumerate() {
            assert!(
                (white - after).abs() < 1e-9,
                "{ppm}, row {row}: {white} and {after}"
            );
        }
    }
}

/// A clock that is fast is found through gaps all the same: the rows beside them, of which it says nothing, are no mismatch of it.
#[test]
fn a_fast_clock_is_found_through_gaps() {
    for (seed, ppm) in [(1, 600.0), (2, -600.0)] {
        let mut load_a = common::noise(seed, 8.0);
        let levels: Vec<f64> = (0..400).map(|_| load_a()).collect();
        let current_a = |t_s: f64| {
            let at = (t_s / 1.7).max(0.0);
            let (level, share) = (at as usize, at.fract());
            levels[level] + share * (levels[level + 1] - levels[level])
        };
        let mut noise_a = common::noise(seed + 50, 0.05);
        let mut text = "t_s,i_ref_a,i_meas_a\n".to_owned();
        for row in 0..5000 {
            let t_s = 0.1 * f64::from(row);
            if (900..1100).contains(&row) || (3000..3200).contains(&row) {
                continue;
            }
            let reading_a = current_a(t_s / (1.0 + 1e-6 * ppm)) + noise_a();
            text.push_str(&format!("{t_s},{},{reading_a}\n", current_a(t_s)));
        }
        let prepared = common::prepared(&text, "schema = 1\n[sensor]\nnoise = 0.05\n");
        let report = common::said(prepared.items[0].problem.clone(), 0, &[]);
        let named: Vec<&str> = report
            .effects
            .iter()
            .map(|effect| effect.id.as_str())
            .collect();
        assert_eq!(named, ["clock-skew"], "{}", report.summary);
        assert!(
            (report.effects[0].parameters[0].value - ppm).abs() < 30.0,
            "{}",
            report.summary
        );
        assert_eq!(report.verdict, Verdict::Explained, "{}", report.summary);
        assert!(report.signals[0].rmse_after < 0.06, "{}", report.summary);
    }
}

/// The time that a clock lost before a gap is not lost anew; with another operation it starts from nothing.
#[test]
fn a_clock_starts_anew_with_another_operation() {
    let sensor = Base::Sensor(SensorBase::default());
    let (mut problem, rows) = problem(View::Sensor, sensor, true);
    problem.drive.continues.fill(false);
    let said = predict(&problem, &[("clock-skew".into(), vec![2000.0])]);
    let begins = GAPS[0].end;
    for (row, said) in rows.into_iter().zip(said) {
        if (begins..GAPS[1].start).contains(&row) {
            let at = begins as f64 + (row - begins) as f64 / 1.002;
            let (before, share) = (at.floor() as usize, at.fract());
            let expected = current_a(before) + share * (current_a(before + 1) - current_a(before));
            assert!((said - expected).abs() < 1e-9, "row {row}");
        }
    }
}

/// A cell's heat acts through its resistance's law, wherever in the model file that stands.
#[test]
fn the_order_of_a_model_file_is_no_physics() {
    let cell = Base::Battery(BatteryBase {
        capacity_ah: 3.0,
        efficiency: 1.0,
        initial_soc: vec![0.9],
        ocv: vec![(0.0, 3.0), (1.0, 4.2)],
        cells: 1.0,
        resistance_ohm: 0.02,
        ..BatteryBase::default()
    });
    let (problem, _) = problem(View::Voltage, cell, false);
    let mut effects = vec![
        ("cell-self-heating".to_owned(), vec![8.0, 120.0]),
        ("resistance-temperature".to_owned(), vec![4000.0]),
    ];
    let one = predict(&problem, &effects);
    effects.reverse();
    assert_eq!(one, predict(&problem, &effects));
}
