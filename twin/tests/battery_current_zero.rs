//! A cell whose recorded current has a zero: the battery's current is not what the recording says, and nothing of the cell is.

use crate::cell::{AS_DESIGNED, Cell, NOISE_V, log, model, names, operation, said};
use serde_json::Value;

/// What a model file says of the start and of the current.
const UNCERTAIN: &str = "initial_soc = 0.9\ncurrent_zero_uncertainty_a = 0.02";
const EXACT: &str = "initial_soc = 0.9";

/// What is said of a cell that was recorded with a zero.
fn with_zero(zero_a: f64, cell: Cell, more: &str, seed: u64) -> Value {
    let cell = Cell {
        current_zero_a: zero_a,
        ..cell
    };
    let fitted = log(&[operation(cell, 0.9, 0.0, 0, seed)]);
    let other = log(&[operation(cell, 0.8, 0.0005, 0, seed + 50)]);
    said(&model(more), &fitted, Some(&other))
}

/// Whether the interval of the first parameter of the only effect has the truth in it.
fn covers(report: &Value, truth: f64) -> usize {
    let interval = &report["effects"][0]["parameters"][0]["ci95"];
    let [low, high] = [0, 1].map(|end| interval[end].as_f64().unwrap());
    usize::from(low <= truth && truth <= high)
}

#[test]
fn a_zero_within_its_uncertainty_is_no_effect() {
    for zero_a in [0.03, -0.03, 0.07] {
        let report = with_zero(zero_a, AS_DESIGNED, UNCERTAIN, 1);
        let summary = &report["summary"];
        assert_eq!(report["verdict"], "no-mismatch", "{summary}");
        let remarks = report["remarks"].to_string();
        assert!(
            remarks.contains("the recorded current's zero 0.0"),
            "{remarks}"
        );
        // Said to be exact, it is a load.
        let report = with_zero(zero_a, AS_DESIGNED, EXACT, 1);
        assert_eq!(names(&report), ["parasitic-load"], "{}", report["summary"]);
    }
}

#[test]
fn what_is_more_than_uncertain_is_a_load() {
    let mut covered = 0;
    for seed in 1..5 {
        let report = with_zero(-0.11, AS_DESIGNED, UNCERTAIN, seed);
        assert_eq!(names(&report), ["parasitic-load"], "{}", report["summary"]);
        covered += covers(&report, 0.11);
    }
    // Of four intervals one may miss.
    assert!(covered >= 3, "{covered} of 4");
}

#[test]
fn other_physics_is_found_beside_it_and_carries_to_other_files() {
    let slow = Cell {
        slow_ohm: 0.006,
        ..AS_DESIGNED
    };
    let small = Cell {
        capacity_ah: 2.4,
        ..AS_DESIGNED
    };
    let mut covered = 0;
    for seed in 3..6 {
        for (id, cell, truth) in [("polarisation", slow, 0.006), ("capacity", small, 2.4)] {
            let report = with_zero(-0.03, cell, UNCERTAIN, seed);
            assert_eq!(names(&report), [id], "{}", report["summary"]);
            covered += covers(&report, truth);
            let left_v = report["holdouts"][0]["rmse_after"].as_f64().unwrap();
            assert!(left_v < 1.1 * NOISE_V, "{id} {seed}: {left_v}");
        }
    }
    assert!(covered >= 5, "{covered} of 6");
}
