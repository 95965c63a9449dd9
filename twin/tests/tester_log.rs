//! A cell on a tester, logged as testers do: rows only when something is due, a charge counter beside the current, a channel scanned
//! after the other, and a table of open-circuit voltages of a few points. The cell is made here, second by second. Evidence of kind (d).

use std::{fs, path::Path};

use crate::command::{EXPLAIN, twin};
use crate::common::noise;
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
    // Nine rests begin a minute before their first row: straight lines would count half of it at 10 A. The voltages tell that each row's
    // current has flowed since the row before.
    assert!(names(&blind).iter().all(relaxes), "{}", blind["summary"]);
    assert!(remarks(&blind).contains(SINCE), "{}", blind["remarks"]);
    assert!(
        left_blind_v < 1.5 * left_v,
        "{left_v} V with it, {left_blind_v} V without"
    );
}

const SINCE: &str = "each row's current has flowed since the row before";
const UNTIL: &str = "each row's current flows until the next row";

/// The same log, but of a source that says what it is set to from each row on: the voltage is that under the new current.
fn log_of_a_source(cell: &[Second], [under_load, at_rest]: [usize; 2], seed: u64) -> String {
    let mut noise_v = noise(seed, NOISE_V);
    let mut text = String::from("t_s,i_ref_a,v_cell_v\n");
    let mut since: usize = 0;
    for (at, pair) in cell.windows(2).enumerate() {
        let [before, now] = pair else { continue };
        let each: usize = if now.current_a == 0.0 {
            at_rest
        } else {
            under_load
        };
        since = if now.current_a == before.current_a {
            since + 1
        } else {
            0
        };
        if since.is_multiple_of(each) {
            let volts = before.volts + OHM * (before.current_a - now.current_a) + noise_v();
            text.push_str(&format!("{},{},{volts:.4}\n", at + 1, now.current_a));
        }
    }
    text
}

/// Loads and charges between rests that are logged more rarely, in both directions; no branch but that of the model.
fn cycles() -> Vec<(usize, f64)> {
    let cycle = [(600, 12.0), (300, 0.0), (120, -15.0), (300, 0.0)];
    [&[(600, 0.0)][..], &cycle.repeat(14)].concat()
}

/// The model file with the branch, from 95 % on, with a capacity stated.
fn with_its_branch(stated_ah: f64) -> String {
    let text = model()
        .replace("initial_soc = 1.0", "initial_soc = 0.95")
        .replace("capacity_ah = 30", &format!("capacity_ah = {stated_ah}"));
    format!("{text}[effects.polarisation]\nr1_ohm = {SLOW_OHM}\ntau1_s = {SLOW_S}\n")
}

/// A rest that is logged more rarely than a load is the logger's: nothing is named for it, and what else is there is found with its size.
#[test]
fn what_a_log_of_uneven_rows_leaves_open_is_no_effect() {
    let cell = cell(0.95, &cycles());
    for (logs, remark) in [(true, SINCE), (false, UNTIL)] {
        let log = |seed: u64| {
            if logs {
                log(&cell, [5, 60], false, seed)
            } else {
                log_of_a_source(&cell, [5, 60], seed)
            }
        };
        for stated_ah in [CAPACITY_AH, 1.1 * CAPACITY_AH] {
            let folder = tempfile::tempdir().unwrap();
            let (report, left_v) =
                said(folder.path(), &with_its_branch(stated_ah), &log(1), &log(2));
            let case = format!("{remark}, {stated_ah} Ah: {}", report["summary"]);
            println!("{case}: {left_v} V");
            assert!(remarks(&report).contains(remark), "{case}");
            assert!(left_v < 1.2 * NOISE_V, "{left_v} V; {case}");
            if stated_ah == CAPACITY_AH {
                assert_eq!(report["verdict"], "no-mismatch", "{case}");
                continue;
            }
            assert_eq!(names(&report), ["capacity"], "{case}");
            let [low, high] = [0, 1].map(|end| {
                report["effects"][0]["parameters"][0]["ci95"][end]
                    .as_f64()
                    .unwrap()
            });
            assert!(
                (low..=high).contains(&CAPACITY_AH),
                "{low} … {high}; {case}"
            );
        }
    }
}

/// Beside a straight current, as a meter on a ramp reads it, nothing stays: an uneven log is no reason by itself.
#[test]
fn an_uneven_log_of_ramps_stays_in_straight_lines() {
    // A ramp of 60 s up and down by turns, of which ten rows are logged and in the rest between one each minute.
    let ramp = |at: usize| {
        let into = (at % 600) as f64;
        20.0 * (into.min(120.0 - into) / 60.0).max(0.0)
    };
    let steps: Vec<(usize, f64)> = (0..14_400)
        .map(|at| (1, ramp(at) + 0.5 * (ramp(at + 1) - ramp(at))))
        .collect();
    let cell = cell(0.95, &steps);
    let log = |seed: u64| {
        let mut noise_v = noise(seed, NOISE_V);
        let mut text = String::from("t_s,i_ref_a,v_cell_v\n");
        for (at, second) in cell.iter().enumerate() {
            let after = at + 1;
            let each = if (1..=120).contains(&(after % 600)) {
                6
            } else {
                60
            };
            if !after.is_multiple_of(each) {
                continue;
            }
            // The voltage under the current of that moment.
            let volts = second.volts + OHM * (second.current_a - ramp(after)) + noise_v();
            text.push_str(&format!("{after},{},{volts:.4}\n", ramp(after)));
        }
        text
    };
    for stated_ah in [CAPACITY_AH, 1.1 * CAPACITY_AH] {
        let folder = tempfile::tempdir().unwrap();
        let (report, left_v) = said(folder.path(), &with_its_branch(stated_ah), &log(1), &log(2));
        let case = format!("{stated_ah} Ah: {}", report["summary"]);
        println!("{case}: {left_v} V");
        assert!(!remarks(&report).contains("each row's current"), "{case}");
        let expected: &[&str] = if stated_ah == CAPACITY_AH {
            &[]
        } else {
            &["capacity"]
        };
        assert_eq!(names(&report), expected, "{case}");
        assert!(left_v < 1.2 * NOISE_V, "{left_v} V; {case}");
    }
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
