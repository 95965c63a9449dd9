//! A cell whose resistances were found at one temperature, and what is predicted of it at another.

use std::fs;

use crate::cell::{AS_DESIGNED, Cell, DESIGN_OHM, NOISE_V, log, model, names, operation, said};
use crate::command::{EXPLAIN, SIMULATE, twin};
use serde_json::Value;

/// Arrhenius' law of a resistance from 25 °C on.
fn factor(b_k: f64, celsius: f64) -> f64 {
    (b_k * (1.0 / (celsius + 273.15) - 1.0 / 298.15)).exp()
}

/// A log at a temperature, of a cell that has a slow branch and whose resistances follow temperature.
fn recorded(celsius: f64, b_k: f64, seed: u64) -> String {
    let times = factor(b_k, celsius);
    let cell = Cell {
        resistance_ohm: times * DESIGN_OHM,
        slow_ohm: times * 0.008,
        ..AS_DESIGNED
    };
    log(&[operation(cell, 0.9, 0.0, 0, seed)])
        .lines()
        .enumerate()
        .map(|(at, line)| match at {
            0 => format!("{line},temp_cell_c\n"),
            _ => format!("{line},{celsius}\n"),
        })
        .collect()
}

/// What is left in the file that was not fitted, in V rms.
fn left_v(report: &Value) -> f64 {
    report["holdouts"][0]["rmse_after"].as_f64().unwrap()
}

#[test]
fn beyond_where_resistances_were_found_they_follow_temperature_as_is_usual() {
    // Of usual cells; a fourth more than what is taken for usual.
    for (celsius, b_k) in [(5.0, 2000.0), (5.0, 2500.0), (45.0, 2500.0)] {
        let (fitted, other) = (recorded(25.0, b_k, 1), recorded(celsius, b_k, 2));
        let report = said(&model("initial_soc = 0.9"), &fitted, Some(&other));
        assert_eq!(names(&report), ["polarisation"], "{}", report["summary"]);
        let remarks = report["remarks"].to_string();
        assert!(remarks.contains("h.csv: its battery is at"), "{remarks}");
        // Who says that they are known everywhere says that they are the same everywhere.
        let same = model("initial_soc = 0.9\nresistances_at_c = [-40, 80]");
        let everywhere = said(&same, &fitted, Some(&other));
        assert!(!everywhere["remarks"].to_string().contains("its battery"));
        let (law, same) = (left_v(&report), left_v(&everywhere));
        assert!(
            law < 0.5 * same,
            "{celsius} °C, {b_k} K: {law} and {same} V"
        );
        if b_k == 2000.0 {
            // What was found of the branch is uncertain by a percent or two of a hundred millivolts.
            assert!(law < 1.3 * NOISE_V, "{law}");
        }
    }
}

/// What the extended model of a recording states of its temperatures, if anything.
fn stated(model: &str, fitted: &str) -> Option<[f64; 2]> {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("m.toml"), model).unwrap();
    fs::write(folder.join("r.csv"), fitted).unwrap();
    assert_eq!(twin(folder, &EXPLAIN).status.code(), Some(0));
    let extended = twin::model::Model::read(&folder.join("out/model.toml")).unwrap();
    extended.battery.unwrap().resistances_at_c
}

#[test]
fn the_extended_model_says_where_resistances_were_found() {
    let fitted = recorded(25.0, 0.0, 3);
    let open = model("initial_soc = 0.9");
    assert_eq!(stated(&open, &fitted), Some([25.0, 25.0]));
    // A recording that is cold and warm, and whose resistances stay the same, speaks against what is usual.
    let swings = |(at, line): (usize, &str)| match at {
        0 => format!("{line}\n"),
        _ => {
            let celsius = 25.0 + 5.0 * (at as f64 / 200.0).sin();
            line.replace(",25", &format!(",{celsius:.2}")) + "\n"
        }
    };
    let swinging: String = fitted.lines().enumerate().map(swings).collect();
    assert!(swinging.contains(",29.9"));
    assert_eq!(stated(&open, &swinging), None);
    // Where it is stated, or said how they follow temperature, nothing is added.
    let there = model("initial_soc = 0.9\nresistances_at_c = [20, 30]");
    assert_eq!(stated(&there, &fitted), Some([20.0, 30.0]));
    let law = model("initial_soc = 0.9") + "[effects.resistance-temperature]\nb_k = 1\n";
    assert_eq!(stated(&law, &fitted), None);
}

#[test]
fn resistances_are_the_stated_ones_within_and_follow_the_law_beyond() {
    let simulated = |more: &str, celsius: f64| {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path();
        let rows: String = (0..60).map(|k| format!("{k},3,3.9,{celsius}\n")).collect();
        let recording = format!("t_s,i_ref_a,v_cell_v,temp_cell_c\n{rows}");
        fs::write(folder.join("r.csv"), recording).unwrap();
        fs::write(
            folder.join("m.toml"),
            model(&format!("initial_soc = 0.9\n{more}")),
        )
        .unwrap();
        let output = twin(folder, &SIMULATE);
        assert_eq!(output.status.code(), Some(0));
        let simulated = recording::csv::read(&folder.join("s.csv")).unwrap();
        simulated.need("v_cell_v").unwrap()[0]
    };
    let plain = simulated("", 10.0);
    let with = |celsius| simulated("resistances_at_c = [15, 30]", celsius);
    for inside in [15.0, 22.0, 30.0] {
        assert_eq!(with(inside), plain);
    }
    for (beyond, edge) in [(0.0, 15.0), (-20.0, 15.0), (50.0, 30.0)] {
        let times = factor(2000.0, beyond) / factor(2000.0, edge);
        let fallen_v = plain - with(beyond);
        let expected_v = (times - 1.0) * DESIGN_OHM * 3.0;
        assert!((fallen_v - expected_v).abs() < 1e-9, "{beyond}: {fallen_v}");
    }
}
