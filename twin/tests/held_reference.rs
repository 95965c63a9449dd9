//! A reference that goes in steps, logged by rows: each row's value stands until the next row, or has stood since the one before. The
//! readings tell which. Evidence of kind (d): our own simulator.

use std::fmt::Write as _;
use std::fs;

use crate::command::{EXPLAIN, SIMULATE, twin};
use crate::common::{noise, steps};
use serde_json::Value;

const NOISE_A: f64 = 0.3;
const TAU_S: f64 = 0.4;
const GAIN: f64 = 1.01;
const ROW_S: f64 = 0.1;

/// A log of a low-pass with a gain behind a current that is at a row's value until a share of the step to the next one has gone.
fn log(until: impl Fn(usize) -> f64) -> String {
    let (t_s, current_a) = steps(5, 80.0, 3000, 20);
    let mut noise_a = noise(6, NOISE_A);
    let mut text = "t_s,i_ref_a,i_meas_a\n".to_owned();
    let mut low_passed_a = current_a[0];
    for (row, (now_a, t_s)) in current_a.iter().zip(&t_s).enumerate() {
        let share = until(row);
        let from_a = current_a[row.saturating_sub(1)];
        for (of_a, part) in [(from_a, share), (*now_a, 1.0 - share)] {
            low_passed_a += (of_a - low_passed_a) * (1.0 - (-ROW_S * part / TAU_S).exp());
        }
        let reading_a = GAIN * low_passed_a + noise_a();
        writeln!(text, "{t_s:.3},{now_a:.4},{reading_a:.4}").unwrap();
    }
    text
}

/// What is said of a log, the model file that is written, and what that leaves of the readings, rms, in A.
fn explained(log: &str) -> (Value, String, f64) {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("r.csv"), log).unwrap();
    let model = format!("schema = 1\n[sensor]\nnoise = {NOISE_A}\n");
    fs::write(folder.join("m.toml"), model).unwrap();
    assert_eq!(twin(folder, &EXPLAIN).status.code(), Some(0));
    let report = fs::read_to_string(folder.join("out/report.json")).unwrap();
    let model = fs::read_to_string(folder.join("out/model.toml")).unwrap();
    // The file that is written makes the readings.
    fs::write(folder.join("m.toml"), &model).unwrap();
    assert_eq!(twin(folder, &SIMULATE).status.code(), Some(0));
    let column = |text: &str, index: usize| -> Vec<f64> {
        let rows = text.lines().skip(1);
        rows.map(|row| row.split(',').nth(index).unwrap().parse().unwrap())
            .collect()
    };
    let simulated = column(&fs::read_to_string(folder.join("s.csv")).unwrap(), 1);
    let read = column(log, 2);
    assert_eq!(simulated.len(), read.len());
    let squares = read.iter().zip(&simulated).map(|(a, b)| (a - b).powi(2));
    let left_a = (squares.sum::<f64>() / read.len() as f64).sqrt();
    (serde_json::from_str(&report).unwrap(), model, left_a)
}

#[test]
fn edges_at_the_rows_are_found_and_leave_lag_and_gain_what_they_are() {
    for (share, holds) in [(1.0, "until-next-row"), (0.0, "since-last-row")] {
        let (report, model, left_a) = explained(&log(|_| share));
        let effects = report["effects"].as_array().unwrap();
        let ids: Vec<&str> = (effects.iter())
            .map(|effect| effect["id"].as_str().unwrap())
            .collect();
        assert_eq!(ids, ["lag", "gain"], "{holds}: {}", report["summary"]);
        for (effect, truth) in effects.iter().zip([TAU_S, GAIN]) {
            let [low, high] =
                [0, 1].map(|end| effect["parameters"][0]["ci95"][end].as_f64().unwrap());
            // Two and a half times the interval, for what noise does by chance.
            let more = 0.75 * (high - low);
            assert!(
                low - more <= truth && truth <= high + more,
                "{holds}: {effect}"
            );
        }
        assert!(
            model.contains(&format!("held_reference = \"{holds}\"")),
            "{model}"
        );
        assert!(left_a < 1.05 * NOISE_A, "{holds}: {left_a} A");
    }
}

/// Where edges are anywhere between the rows, neither is taken for it.
#[test]
fn edges_between_the_rows_are_not_put_at_them() {
    let (_, model, _) = explained(&log(|row| ((row * 7919) % 1000) as f64 * 1e-3));
    assert!(!model.contains("held_reference"), "{model}");
}
