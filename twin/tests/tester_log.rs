//! A cell on a tester, logged as testers do: rows only when something is due, a charge counter beside the current, a channel scanned
//! after the other, and a table of open-circuit voltages of a few points. The cell is made here, second by second. Evidence of kind (d).

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

#[path = "common/command.rs"]
mod command;
mod common;

use std::{fs, path::Path};

use command::{EXPLAIN, twin};
use common::noise;
use serde_json::Value;

const CAPACITY_AH: f64 = 30.0;
const OHM: f64 = 0.002;
const NOISE_V: f64 = 0.0005;
/// The branch that the model leaves out.
const SLOW_OHM: f64 = 0.003;
const SLOW_S: f64 = 60.0;

/// Steep when nearly empty, as of any lithium-ion cell.
fn open_circuit_v(soc: f64) -> f64 {
    3.55 + 0.6 * soc - 0.35 * (-soc / 0.06).exp()
}

/// One second of the cell: current, voltage and what flowed so far.
struct Second {
    current_a: f64,
    volts: f64,
    flowed_ah: f64,
}

/// Steps of so many seconds at a current in A, from a state of charge on.
fn cell(soc: f64, steps: &[(usize, f64)]) -> Vec<Second> {
    let (mut flowed_ah, mut slow_a) = (0.0, 0.0);
    let mut seconds = Vec::new();
    for &(length_s, current_a) in steps {
        for _ in 0..length_s {
            slow_a += (current_a - slow_a) * (1.0 - (-1.0 / SLOW_S).exp());
            flowed_ah += current_a / 3600.0;
            let open_v = open_circuit_v(soc - flowed_ah / CAPACITY_AH);
            let volts = open_v - OHM * current_a - SLOW_OHM * slow_a;
            seconds.push(Second {
                current_a,
                volts,
                flowed_ah,
            });
        }
    }
    seconds
}

/// Nine times a pulse each way, a tenth of the charge and a rest.
fn pulses() -> Vec<(usize, f64)> {
    let tenth = [(30, 30.0), (40, 0.0), (10, -22.5), (1080, 9.6), (3000, 0.0)];
    [&[(600, 0.0)][..], &tenth.repeat(9)].concat()
}

/// The log: a row each `under_load` seconds, in a rest each `at_rest`, the first of them that much after its step began; with a counter
/// in steps of 0.01 Ah or none.
fn log(cell: &[Second], [under_load, at_rest]: [usize; 2], counter: bool, seed: u64) -> String {
    let mut noise_v = noise(seed, NOISE_V);
    let mut text = String::from("t_s,i_ref_a,v_cell_v");
    text.push_str(if counter { ",ah_meas_ah\n" } else { "\n" });
    let mut since: usize = 0;
    for (at, second) in cell.iter().enumerate() {
        since = if at > 0 && cell[at - 1].current_a != second.current_a {
            1
        } else {
            since + 1
        };
        let each = if second.current_a == 0.0 {
            at_rest
        } else {
            under_load
        };
        if !since.is_multiple_of(each) {
            continue;
        }
        let volts = second.volts + noise_v();
        text.push_str(&format!("{},{},{volts:.4}", at + 1, second.current_a));
        if counter {
            text.push_str(&format!(",{:.2}", second.flowed_ah));
        }
        text.push('\n');
    }
    text
}

/// The cell as its data sheet has it: eleven points and the resistance.
fn model() -> String {
    let table: Vec<String> = (0..=10)
        .map(|k| f64::from(k) / 10.0)
        .map(|soc| format!("[{soc}, {:.4}]", open_circuit_v(soc)))
        .collect();
    format!(
        "schema = 1\n[battery]\ncapacity_ah = {CAPACITY_AH}\nohmic_resistance_ohm = {OHM}\nresistance_uncertainty = 0.05\ninitial_soc = 1.0\n\
         noise_v = {NOISE_V}\nocv = [{}]\n",
        table.join(", ")
    )
}

/// What is said of a recording, and the error in volts, rms, that the extended model leaves of another one.
fn said(folder: &Path, model: &str, fitted: &str, other: &str) -> (Value, f64) {
    let write = |name: &str, text: &str| fs::write(folder.join(name), text).unwrap();
    write("m.toml", model);
    write("r.csv", fitted);
    write("other.csv", other);
    let run = |arguments: &[&str]| {
        let output = twin(folder, arguments);
        let complaint = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(0), "{complaint}");
    };
    run(&EXPLAIN);
    run(&[
        "simulate",
        "--model",
        "out/model.toml",
        "--recording",
        "other.csv",
        "--out",
        "s.csv",
    ]);
    let volts = |name: &str| {
        let recording = recording::csv::read(&folder.join(name)).unwrap();
        recording.need("v_cell_v").unwrap().to_vec()
    };
    let (seen, simulated) = (volts("other.csv"), volts("s.csv"));
    let energy: f64 = seen
        .iter()
        .zip(&simulated)
        .map(|(seen, simulated)| (seen - simulated).powi(2))
        .sum();
    let report = fs::read_to_string(folder.join("out/report.json")).unwrap();
    (
        serde_json::from_str(&report).unwrap(),
        (energy / seen.len() as f64).sqrt(),
    )
}

fn names(report: &Value) -> Vec<&str> {
    let effects = report["effects"].as_array().unwrap().iter();
    effects
        .map(|effect| effect["id"].as_str().unwrap())
        .collect()
}

fn remarks(report: &Value) -> String {
    report["remarks"].to_string()
}

#[test]
fn a_pulse_test_is_explained_by_what_its_counter_says() {
    let fitted = cell(1.0, &pulses());
    let other = cell(1.0, &[(60, 0.0), (3300, 30.0), (1800, 0.0)]);
    let every = [2, 60];
    let explained = |counter: bool| {
        let folder = tempfile::tempdir().unwrap();
        let fitted = log(&fitted, every, counter, 1);
        said(
            folder.path(),
            &model(),
            &fitted,
            &log(&other, every, true, 2),
        )
    };
    let (report, left_v) = explained(true);
    let (blind, left_blind_v) = explained(false);
    assert!(!names(&report).is_empty(), "{}", report["summary"]);
    assert!(
        remarks(&report).contains("ah_meas_ah tells how the current goes"),
        "{}",
        report["remarks"]
    );
    let relaxes = |id: &&str| ["polarisation", "diffusion"].contains(id);
    assert!(names(&report).iter().all(relaxes), "{}", report["summary"]);
    // Nine rests begin a minute before their first row: straight lines count half of it at 10 A. The charge of the gaps beside them is free,
    // and takes it; certain it is not.
    assert_ne!(blind["verdict"], "explained", "{}", blind["summary"]);
    assert!(
        left_v < 0.3 * left_blind_v,
        "{left_v} V with it, {left_blind_v} V without"
    );
}

#[test]
fn voltages_that_are_read_late_are_the_testers_and_no_effect() {
    // A load that changes each 25 s; each voltage is read in the second after its row's current.
    let mut load_a = noise(5, 15.0);
    let steps: Vec<(usize, f64)> = (0..160).map(|_| (25, load_a())).collect();
    let late = |seed: u64| {
        let mut seconds = cell(0.7, &steps);
        let read: Vec<f64> = seconds
            .windows(2)
            .map(|pair| 0.5 * (pair[0].volts + pair[1].volts))
            .collect();
        seconds
            .iter_mut()
            .zip(read)
            .for_each(|(second, volts)| second.volts = volts);
        log(&seconds, [1, 1], false, seed)
    };
    let folder = tempfile::tempdir().unwrap();
    let text = model().replace("initial_soc = 1.0", "initial_soc = 0.7");
    let (report, left_v) = said(folder.path(), &text, &late(1), &late(2));
    assert!(
        names(&report)
            .iter()
            .all(|id| ["polarisation", "diffusion"].contains(id)),
        "{}",
        report["summary"]
    );
    assert!(!names(&report).is_empty(), "{}", report["summary"]);
    let remarks = remarks(&report);
    assert!(
        remarks.contains("s after the currents of their rows"),
        "{remarks}"
    );
    let extended = fs::read_to_string(folder.path().join("out/model.toml")).unwrap();
    let at = extended
        .lines()
        .find_map(|line| line.strip_prefix("alignment_s = "))
        .expect("written");
    let at: f64 = at.parse().unwrap();
    assert!((-0.6..-0.4).contains(&at), "{at} s");
    assert!(left_v < 3.0 * NOISE_V, "{left_v} V");
}
