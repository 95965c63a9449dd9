//! A cell whose ohmic resistance is not the stated one: aged, or behind a contact.

use crate::cell::{AS_DESIGNED, Cell, DESIGN_OHM, log, model, names, operation, said};
use serde_json::Value;

/// What is said of a cell of so many times the stated resistance, which is uncertain by 5 %.
fn of_times(times: f64, cell: Cell, seed: u64) -> Value {
    let cell = Cell {
        resistance_ohm: times * DESIGN_OHM,
        ..cell
    };
    let fitted = log(&[operation(cell, 0.9, 0.0, 0, seed)]);
    said(
        &model("initial_soc = 0.9\nresistance_uncertainty = 0.05"),
        &fitted,
        None,
    )
}

/// Whether the interval of the first parameter of an effect has the truth in it.
fn covers(report: &Value, id: &str, truth: f64) -> usize {
    let mut effects = report["effects"].as_array().unwrap().iter();
    let effect = effects.find(|effect| effect["id"] == id).unwrap();
    let interval = &effect["parameters"][0]["ci95"];
    let [low, high] = [0, 1].map(|end| interval[end].as_f64().unwrap());
    usize::from(low <= truth && truth <= high)
}

#[test]
fn what_is_more_than_uncertain_is_named() {
    let mut covered = 0;
    for times in [1.8, 1.3, 0.6] {
        for seed in 1..5 {
            let report = of_times(times, AS_DESIGNED, seed);
            assert_eq!(names(&report), ["resistance"], "{}", report["summary"]);
            assert_eq!(report["verdict"], "explained", "{}", report["summary"]);
            covered += covers(&report, "resistance", times);
        }
    }
    // The same noise four times: of four intervals one may miss.
    assert!(covered >= 9, "{covered} of 12");
}

#[test]
fn what_is_within_the_uncertainty_is_none() {
    for times in [0.85, 1.1, 1.19] {
        let report = of_times(times, AS_DESIGNED, 2);
        assert_eq!(report["verdict"], "no-mismatch", "{}", report["summary"]);
    }
}

#[test]
fn other_physics_is_found_beside_it() {
    let slow = Cell {
        slow_ohm: 0.006,
        ..AS_DESIGNED
    };
    let small = Cell {
        capacity_ah: 2.7,
        ..AS_DESIGNED
    };
    for seed in 3..6 {
        for (id, cell, truth) in [("polarisation", slow, 0.006), ("capacity", small, 2.7)] {
            let report = of_times(1.8, cell, seed);
            let mut named = names(&report);
            named.sort_unstable();
            let mut expected = ["resistance", id];
            expected.sort_unstable();
            assert_eq!(named, expected, "{}", report["summary"]);
            let scale = &report["effects"][0]["parameters"][0]["value"];
            assert!((scale.as_f64().unwrap() - 1.8).abs() < 1e-3, "{report}");
            let of_id = report["effects"].as_array().unwrap();
            let of_id = of_id.iter().find(|effect| effect["id"] == id).unwrap();
            let value = of_id["parameters"][0]["value"].as_f64().unwrap();
            assert!((value / truth - 1.0).abs() < 0.01, "{of_id}");
        }
    }
}
