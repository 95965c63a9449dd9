//! What a battery remembers when its recording begins: a log that was cut out of a drive begins under load, and nobody recorded what
//! flowed before.

use crate::cell::{AS_DESIGNED, Cell, NOISE_V, log, model, names, operation, said};
use serde_json::Value;

const SLOW: Cell = Cell {
    slow_ohm: 0.02,
    ..AS_DESIGNED
};

/// A log without its first rows: it begins under load.
fn cut(cell: Cell, rows: usize, seed: u64) -> String {
    let whole = operation(cell, 0.9, 0.0005, 0, seed);
    let lines: Vec<&str> = whole.lines().skip(rows).collect();
    let current: f64 = lines[0].split(',').nth(2).unwrap().parse().unwrap();
    assert!(current.abs() > 0.5, "{current} A");
    log(&[lines.join("\n") + "\n"])
}

fn remarks(report: &Value) -> String {
    report["remarks"].to_string()
}

/// Rows that are cut off, with the seed of the load: each ends under load.
const CUTS: [(usize, u64); 4] = [(300, 1), (510, 2), (410, 5), (713, 8)];

#[test]
fn a_log_that_begins_under_load_is_explained() {
    for (rows, seed) in CUTS {
        let report = said(&model(""), &cut(SLOW, rows, seed), None);
        let what = format!(
            "{rows}, {seed}: {}; {}",
            report["summary"],
            remarks(&report)
        );
        println!("{what}");
        assert_eq!(report["verdict"], "explained", "{what}");
        assert_eq!(names(&report), ["polarisation"], "{what}");
        assert!(remarks(&report).contains("begins under load"), "{what}");
        for (parameter, truth) in [(0, 0.02), (1, 60.0)] {
            let parameter = &report["effects"][0]["parameters"][parameter];
            let [low, high] = [0, 1].map(|end| parameter["ci95"][end].as_f64().unwrap());
            // The 95 % interval, and half of one beside it: four logs are none too many to ask for all.
            let half = 0.25 * (high - low);
            assert!(
                (low - half..=high + half).contains(&truth),
                "{parameter}; {what}"
            );
            assert!(high - low < 0.2 * truth, "{parameter}; {what}");
        }
    }
}

/// Whether what is left at the start would be taken for a mismatch (20 mΩ) or for slips of the log (4 mΩ).
#[test]
fn with_its_branch_known_nothing_is_missing() {
    for slow_ohm in [0.02, 0.004] {
        let cell = Cell {
            slow_ohm,
            ..AS_DESIGNED
        };
        let branch = format!("[effects.polarisation]\nr1_ohm = {slow_ohm}\ntau1_s = 60\n");
        for (rows, seed) in CUTS {
            let text = format!("{}{branch}", model(""));
            let report = said(&text, &cut(cell, rows, seed), None);
            let what = format!(
                "{rows}, {seed}: {}; {}",
                report["summary"],
                remarks(&report)
            );
            assert_eq!(report["verdict"], "no-mismatch", "{what}");
            assert!(!remarks(&report).contains("slip"), "{what}");
        }
    }
}

/// In the first rest the voltage still goes back; in that of a cell that had rested it does not.
#[test]
fn a_log_that_begins_in_a_rest_after_a_load_is_explained() {
    // A first reading tells a state of charge to 10 mV; here it is off by 120.
    let stated = "initial_soc = 0.9\ninitial_soc_uncertainty = 0.005";
    let slow = |text: &str| said(&model(stated), text, None);
    let whole = operation(SLOW, 0.9, 0.0005, 0, 2);
    let (load_a, branch_s) = (6.0, 60.0);
    // A rest of 50 s after a long load, and then the operation, of which the branch goes on from where it is.
    let mut lines = Vec::new();
    for (row, line) in whole.lines().enumerate() {
        let fields: Vec<f64> = line
            .split(',')
            .map(|field| field.parse().unwrap())
            .collect();
        let left_v = 0.02 * load_a * (-(row as f64) / branch_s).exp();
        lines.push(format!(
            "{},0,{},{:.5}",
            fields[0],
            fields[2],
            fields[3] - left_v
        ));
    }
    let report = slow(&log(&[lines.join("\n") + "\n"]));
    let what = format!("{}; {}", report["summary"], remarks(&report));
    assert_eq!(names(&report), ["polarisation"], "{what}");
    assert_eq!(report["verdict"], "explained", "{what}");
    assert!(remarks(&report).contains("not long after"), "{what}");
    let rested = slow(&log(&[whole]));
    assert!(
        !remarks(&rested).contains("not long after"),
        "{}",
        remarks(&rested)
    );
}

/// What was found in a recording from a rest on holds in one that was cut out of a drive, and the other way round.
#[test]
fn a_file_that_was_never_fitted_begins_as_it_does() {
    let whole = |seed: u64| log(&[operation(SLOW, 0.9, 0.0005, 0, seed)]);
    let (rows, seed) = CUTS[0];
    let cases = [
        (whole(21), cut(SLOW, rows, seed)),
        (cut(SLOW, rows, seed), whole(21)),
        (cut(SLOW, 510, 2), cut(SLOW, rows, seed)),
    ];
    for (fitted, other) in cases {
        let report = said(&model(""), &fitted, Some(&other));
        let what = format!("{}; {}", report["summary"], remarks(&report));
        assert_eq!(names(&report), ["polarisation"], "{what}");
        let after = report["holdouts"][0]["rmse_after"].as_f64().unwrap();
        assert!(after < 1.1 * NOISE_V, "{after} V; {what}");
    }
}

/// A log that begins under load of a cell that had rested says nothing of before.
#[test]
fn a_cell_without_a_memory_has_none() {
    let (rows, seed) = CUTS[0];
    let report = said(&model(""), &cut(AS_DESIGNED, rows, seed), None);
    assert_eq!(report["verdict"], "no-mismatch", "{}", report["summary"]);
    let stiff = Cell {
        capacity_ah: 2.7,
        ..AS_DESIGNED
    };
    let report = said(&model(""), &cut(stiff, rows, seed), None);
    let what = format!("{}; {}", report["summary"], remarks(&report));
    assert_eq!(names(&report), ["capacity"], "{what}");
    assert!(!remarks(&report).contains("begins under load"), "{what}");
}
