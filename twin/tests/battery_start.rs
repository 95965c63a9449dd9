//! At which state of charge a battery begins: files that were never fitted, each operation of a log, and what is stated but not so.

use crate::common;
use std::fs;

use crate::cell::{AS_DESIGNED, Cell, NOISE_V, log, model, names, open_circuit_v, operation, said};
use crate::command::{SIMULATE, twin};
use crate::common::noise;

/// Cells with an effect that the design lacks.
fn concealed() -> [(&'static str, Cell); 2] {
    [
        (
            "capacity",
            Cell {
                capacity_ah: 2.92,
                ..AS_DESIGNED
            },
        ),
        (
            "polarisation",
            Cell {
                slow_ohm: 0.002,
                ..AS_DESIGNED
            },
        ),
    ]
}

/// What is stated, where a file that was never fitted begins, and by how much its first reading is off.
const BEGINNINGS: [(&str, f64, f64); 5] = [
    ("initial_soc = 0.9", 0.9, 0.0005),
    ("initial_soc = 0.9", 0.89, 0.0005),
    ("initial_soc = 0.9", 0.7, 0.0005),
    ("", 0.7, 0.012),
    ("", 0.7, -0.012),
];

#[test]
fn a_file_that_begins_elsewhere_bears_out_what_is_there() {
    for (id, cell) in concealed() {
        for (more, soc, first_v) in BEGINNINGS {
            for seed in 0..2 {
                let fitted = log(&[operation(cell, 0.9, 0.0005, 0, seed)]);
                let other = log(&[operation(cell, soc, first_v, 0, seed + 50)]);
                let report = said(&model(more), &fitted, Some(&other));
                let what = format!("{id} {more} {soc} {first_v}: {}", report["summary"]);
                assert_eq!(names(&report), [id], "{what}");
                let there = |key: &str| report["holdouts"][0][key].as_f64().unwrap();
                // One reading of 2400 may be off by 12 mV.
                assert!(there("rmse_after") < 1.1 * NOISE_V, "{what}");
                assert!(there("rmse_before") > 2.0 * NOISE_V, "{what}");
            }
        }
    }
}

#[test]
fn a_file_without_the_effect_takes_it_back_wherever_it_begins() {
    for (id, cell) in concealed() {
        for (more, soc, first_v) in BEGINNINGS {
            let fitted = log(&[operation(cell, 0.9, 0.0005, 0, 3)]);
            let other = log(&[operation(AS_DESIGNED, soc, first_v, 0, 53)]);
            let report = said(&model(more), &fitted, Some(&other));
            let what = format!("{id} {more} {soc} {first_v}: {}", report["summary"]);
            assert_eq!(report["verdict"], "unknown", "{what}");
            assert!(names(&report).is_empty(), "{what}");
        }
    }
}

#[test]
fn a_simulation_begins_as_stated_unless_its_recording_begins_elsewhere() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    for (begins, stated) in [(0.9, true), (0.7, false)] {
        let recorded = log(&[operation(AS_DESIGNED, begins, 0.002, 0, 5)]);
        fs::write(folder.join("r.csv"), recorded).unwrap();
        fs::write(folder.join("m.toml"), model("initial_soc = 0.9")).unwrap();
        let output = twin(folder, &SIMULATE);
        assert_eq!(output.status.code(), Some(0));
        let said = String::from_utf8(output.stdout).unwrap();
        let read = |name: &str| {
            let table = recording::csv::read(&folder.join(name)).unwrap();
            table.column("v_cell_v").unwrap()[0]
        };
        let first_v = if stated {
            open_circuit_v(0.9)
        } else {
            read("r.csv")
        };
        assert!((read("s.csv") - first_v).abs() < 2e-4, "{said}");
        let elsewhere = "does not begin at the stated initial_soc of 90.0 %: 70.";
        assert_eq!(said.contains(elsewhere), !stated, "{said}");
    }
}

/// A log of operations that each begin elsewhere, with a first reading that is off by millivolts.
fn of_operations(cell: Cell, seed: u64) -> String {
    let mut first_v = noise(seed + 77, 0.006);
    let operations: Vec<String> = (0..4)
        .map(|k| {
            let soc = 0.9 - 0.1 * k as f64;
            operation(cell, soc, first_v(), k, seed * 100 + k as u64)
        })
        .collect();
    log(&operations)
}

#[test]
fn each_operation_has_a_start_of_its_own() {
    for seed in 0..3 {
        let report = said(&model(""), &of_operations(AS_DESIGNED, seed), None);
        assert_eq!(report["verdict"], "no-mismatch", "{}", report["summary"]);
    }
    let mut covered = 0;
    for ((id, cell), truth) in concealed().into_iter().zip([2.92, 0.002]) {
        for seed in 0..4 {
            let report = said(&model(""), &of_operations(cell, seed), None);
            assert_eq!(names(&report), [id], "{}", report["summary"]);
            let interval = &report["effects"][0]["parameters"][0]["ci95"];
            let [low, high] = [0, 1].map(|end| interval[end].as_f64().unwrap());
            covered += usize::from(low <= truth && truth <= high);
        }
    }
    assert!(covered >= 6, "{covered} of 8");
}

#[test]
fn where_operations_begin_is_said_once_and_as_not_stated_only_if_it_is_not() {
    let operations: Vec<String> = (0..6)
        .map(|k| operation(AS_DESIGNED, 0.95 - 0.08 * k as f64, 0.0, k, k as u64))
        .collect();
    for (stated, more) in [(false, ""), (true, "initial_soc = 0.95")] {
        for count in [1, 2, 6] {
            let remarks = common::prepared(&log(&operations[..count]), &model(more)).remarks;
            let of = |part: &str| {
                remarks
                    .iter()
                    .filter(|remark| remark.contains(part))
                    .count()
            };
            assert_eq!(
                of("initial_soc is not stated"),
                usize::from(!stated),
                "{remarks:?}"
            );
            assert_eq!(
                of("further operation"),
                usize::from(count > 1),
                "{remarks:?}"
            );
            assert_eq!(of("stretch"), 0, "{remarks:?}");
            let expected = match count {
                2 => "1 further operation begins where its first reading of v_cell_v says, 87.",
                6 => "5 further operations begin where their first reading of v_cell_v says, 5",
                _ => continue,
            };
            assert_eq!(of(expected), 1, "{remarks:?}");
        }
    }
}

#[test]
fn a_stated_start_that_is_off_is_told_beside_what_imitates_it() {
    for (begins, more) in [
        (0.8, "initial_soc = 0.9"),
        (0.88, "initial_soc = 0.9"),
        (0.8, "initial_soc = 0.9\ninitial_soc_uncertainty = 0.01"),
    ] {
        for seed in 0..2 {
            let fitted = log(&[operation(AS_DESIGNED, begins, 0.0, 0, seed)]);
            let report = said(&model(more), &fitted, None);
            let summary = report["summary"].as_str().unwrap();
            let told = format!("at the start was {:.1} % and not 90.0 %", 100.0 * begins);
            assert!(summary.contains(&told), "{summary}");
            assert_ne!(report["verdict"], "explained", "{summary}");
        }
    }
    // What is physics is not said to be a start.
    for (id, cell) in concealed() {
        let fitted = log(&[operation(cell, 0.9, 0.0, 0, 7)]);
        let report = said(&model("initial_soc = 0.9"), &fitted, None);
        assert_eq!(names(&report), [id], "{}", report["summary"]);
        assert_eq!(report["verdict"], "explained", "{}", report["summary"]);
    }
}
