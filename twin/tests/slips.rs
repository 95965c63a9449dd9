//! Slips of a log: a few readings that are something else speak against no name, and are told.

use crate::cell;
use std::fmt::Write as _;
use std::fs;

use crate::cell::{AS_DESIGNED, Cell, log, model, operation};
use crate::command::{EXPLAIN, twin};
use crate::common::noise;
use serde_json::Value;

/// What is said of readings that are one percent and 0.4 A too large, in a noise of 0.1 A, of which some slipped.
fn said(rows: usize, slips: &[(usize, f64)], noise_stated: bool, seed: u64) -> Value {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let mut noise = noise(seed, 0.1);
    let mut csv = "t_s,i_ref_a,i_meas_a\n".to_owned();
    for row in 0..rows {
        let t = 0.1 * row as f64;
        let i = 40.0 * (t / 5.0).sin()
            + 25.0 * (1.7 * t).sin()
            + if t % 30.0 < 12.0 { 60.0 } else { 0.0 };
        let by: f64 = slips
            .iter()
            .filter(|(at, _)| *at == row)
            .map(|(_, by)| by)
            .sum();
        writeln!(csv, "{t:.1},{i:.4},{:.4}", 1.01 * i + 0.4 + noise() + by).unwrap();
    }
    fs::write(folder.join("r.csv"), csv).unwrap();
    let stated = if noise_stated { "noise = 0.1" } else { "" };
    let model =
        format!("schema = 1\nname = \"a pair\"\n[sensor]\nfront_end = \"pair\"\n{stated}\n");
    fs::write(folder.join("m.toml"), model).unwrap();
    let output = twin(folder, &EXPLAIN);
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    serde_json::from_str(&fs::read_to_string(folder.join("out/report.json")).unwrap()).unwrap()
}

fn names(report: &Value) -> Vec<&str> {
    let effects = report["effects"].as_array().unwrap();
    let mut names: Vec<&str> = effects
        .iter()
        .map(|effect| effect["id"].as_str().unwrap())
        .collect();
    names.sort_unstable();
    names
}

#[test]
fn a_few_slips_speak_against_no_name_and_are_told() {
    let spread = |count: usize, rows: usize, by_a: f64| -> Vec<(usize, f64)> {
        (0..count)
            .map(|k| {
                (
                    rows * (2 * k + 1) / (2 * count) + 7 * k % 11,
                    if k % 3 == 0 { -by_a } else { by_a },
                )
            })
            .collect()
    };
    for (rows, count, by_a, stated) in [
        (400, 1, 50.0, true),
        (1500, 1, 1000.0, true),
        (3000, 6, 100.0, true),
        (3000, 25, 300.0, true),
        (3000, 3, 80.0, false),
    ] {
        let slips = spread(count, rows, by_a);
        let report = said(rows, &slips, stated, 3);
        let what = format!("{count} of {rows} by {by_a} A: {}", report["summary"]);
        assert_eq!(names(&report), ["gain", "offset"], "{what}");
        assert_ne!(report["verdict"], "unknown", "{what}");
        let told = report["remarks"].to_string();
        assert!(
            told.contains("slips of the log, left out"),
            "{what}: {told}"
        );
        assert!(
            count == 1 || told.contains(&format!("{count} readings")),
            "{what}: {told}"
        );
    }
}

/// A sensor that was not up yet as the log began, a last line that was cut.
#[test]
fn the_first_and_the_last_reading_slip_as_others_do() {
    for slip in [(0, -250.0), (1499, 180.0)] {
        let report = said(1500, &[slip], true, 3);
        let what = format!("{slip:?}: {}", report["summary"]);
        assert_eq!(names(&report), ["gain", "offset"], "{what}");
        assert_ne!(report["verdict"], "unknown", "{what}");
        let told = report["remarks"].to_string();
        assert!(told.contains("one reading is off"), "{what}: {told}");
    }
}

#[test]
fn voltages_that_were_not_read_hide_no_branch() {
    let cell = Cell {
        slow_ohm: 0.015,
        ..AS_DESIGNED
    };
    let text = log(&[operation(cell, 0.9, 0.0, 1, 5)]);
    // Every 120th row reads 0 V, one in a hundred and twenty.
    let slipped: Vec<String> = text
        .lines()
        .enumerate()
        .map(|(row, line)| match line.rsplit_once(',') {
            Some((rest, _)) if row % 120 == 60 => format!("{rest},0"),
            _ => line.to_owned(),
        })
        .collect();
    let report = cell::said(&model("initial_soc = 0.9\n"), &slipped.join("\n"), None);
    assert_eq!(names(&report), ["polarisation"], "{}", report["summary"]);
    let told = report["remarks"].to_string();
    assert!(
        told.contains("20 readings are off") && told.contains("left out"),
        "{told}"
    );
}
