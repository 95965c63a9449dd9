//! `twin explain` and `twin effects` as they are called.

use crate::command;
use std::{fs, path::Path, process::Output};

use crate::command::{EXPLAIN, twin};
use rand_chacha::{
    ChaCha8Rng,
    rand_core::{Rng, SeedableRng},
};
use twin::model::Model;

const BOARD: &str =
    "# My car.\nschema = 1\n\n[sensor]\nfront_end = \"hah1bv\"\nnoise = 0.05 # as measured\n";

/// `r.csv` under `m.toml`, into `out`.
fn explained(folder: &Path, more: &[&str]) -> Output {
    twin(folder, &[&EXPLAIN, more].concat())
}

/// A drive, and what the simulated board reads with a gain and an offset that the model lacks, and with noise.
fn recording(folder: &Path, seed: u64) {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut uniform = move || f64::from(random.next_u32()) / f64::from(u32::MAX);
    let (mut current, mut target, mut left) = (0.0, 0.0, 0);
    let mut drive = "t_s,i_ref_a\n".to_owned();
    // As frames come: each 10 ms, a new reading in each third.
    for k in 0..20_000 {
        if left == 0 {
            left = 100 + (700.0 * uniform()) as u32;
            target = if uniform() < 0.2 {
                0.0
            } else {
                250.0 * uniform() - 100.0
            };
        }
        left -= 1;
        current += 0.02 * (target - current);
        drive.push_str(&format!("{},{current}\n", f64::from(k) / 100.0));
    }
    fs::write(folder.join("drive.csv"), drive).unwrap();
    let truth = format!("{BOARD}[effects.offset]\noffset_a = 1.5\n[effects.gain]\ngain = 1.02\n");
    fs::write(folder.join("truth.toml"), truth).unwrap();
    let arguments = [
        "simulate",
        "--model",
        "truth.toml",
        "--recording",
        "drive.csv",
        "--out",
        "simulated.csv",
    ];
    assert_eq!(twin(folder, &arguments).status.code(), Some(0));
    let read = |name: &str, column: &str| -> Vec<f64> {
        let recording = recording::csv::read(&folder.join(name)).unwrap();
        recording.column(column).unwrap().to_vec()
    };
    let (reference, simulated) = (
        read("drive.csv", "i_ref_a"),
        read("simulated.csv", "i_meas_a"),
    );
    let mut text = "t_s,i_ref_a,i_meas_a\n".to_owned();
    let (mut last, mut noise) = (f64::NAN, 0.0);
    for (row, (reference, reading)) in reference.iter().zip(&simulated).enumerate() {
        // A reading that is held is so but for the last digits of what effects make of it.
        let held = (*reading - last).abs() < 1e-6;
        if !held {
            (last, noise) = (*reading, 0.17 * (uniform() - 0.5));
        }
        text.push_str(&format!(
            "{},{reference},{}\n",
            row as f64 / 100.0,
            reading + noise
        ));
    }
    fs::write(folder.join(format!("r{seed}.csv")), text).unwrap();
}

#[test]
fn writes_report_page_model_and_calibration() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("m.toml"), BOARD).unwrap();
    recording(folder, 1);
    recording(folder, 2);
    let arguments = |out: &'static str| {
        [
            "explain",
            "--model",
            "m.toml",
            "--recording",
            "r1.csv",
            "--holdout",
            "r2.csv",
            "--out",
            out,
        ]
    };
    let output = twin(folder, &arguments("out"));
    let summary = String::from_utf8(output.stdout).unwrap();
    assert_eq!(output.status.code(), Some(0), "{summary}");
    assert!(summary.lines().count() <= 24, "{summary}");
    let read = |name: &str| fs::read_to_string(folder.join("out").join(name)).unwrap();
    let report: serde_json::Value = serde_json::from_str(&read("report.json")).unwrap();
    assert_eq!(report["schema"], 1);
    assert_eq!(report["inputs"]["recording"], "r1.csv");
    assert_eq!(report["holdouts"][0]["file"], "r2.csv");
    assert!(read("report.html").starts_with("<!DOCTYPE html>"));
    // The model is its user's file, with what was found.
    let text = read("model.toml");
    assert!(text.starts_with(BOARD), "{text}");
    let model = Model::read(&folder.join("out/model.toml")).unwrap();
    let found = |id: &str| {
        model
            .effects
            .iter()
            .find(|(known, _)| *known == id)
            .unwrap_or_else(|| panic!("no {id}: {summary}"))
            .1[0]
    };
    assert!((found("gain") - 1.02).abs() < 0.002, "{text}");
    assert!((found("offset") - 1.5).abs() < 0.1, "{text}");
    // The board is told what takes it out again: (1 + gain)·1.02·(i + 1.5) − drift = i.
    assert!(
        summary.contains("report.json, model.toml, calibration.toml"),
        "{summary}"
    );
    let calibration: toml::Table = read("calibration.toml").parse().unwrap();
    let registers = calibration["register"].as_array().unwrap();
    let value = |name: &str| {
        let register = registers
            .iter()
            .find(|register| register["name"].as_str() == Some(name))
            .unwrap();
        register["small"].as_integer().unwrap() as f64
    };
    assert!((value("current gain") - (1.0 / 1.02 - 1.0) * 1e6).abs() < 2000.0);
    assert!((value("zero drift") - 1.5e6).abs() < 5e4);
    // The extended model needs no more than its own file: what it leaves is the noise that it states, as the report
    // showed, but for the alignment within a step of the rows, which is no part of the model.
    let arguments = [
        "explain",
        "--model",
        "out/model.toml",
        "--recording",
        "r1.csv",
        "--out",
        "again",
    ];
    assert_eq!(twin(folder, &arguments).status.code(), Some(0));
    let again = fs::read_to_string(folder.join("again/report.json")).unwrap();
    let again: serde_json::Value = serde_json::from_str(&again).unwrap();
    let figure =
        |report: &serde_json::Value, name: &str| report["signals"][0][name].as_f64().unwrap();
    let kept = figure(&again, "rmse_before");
    assert!(figure(&report, "rmse_after") < 0.067, "{summary}");
    assert!(
        kept < 0.067 && kept < 0.05 * figure(&report, "rmse_before"),
        "{kept}\n{summary}"
    );
}

#[test]
fn lists_the_library() {
    let folder = tempfile::tempdir().unwrap();
    let output = twin(folder.path(), &["effects", "--json"]);
    let rows: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let ids: Vec<&str> = rows
        .as_array()
        .unwrap()
        .iter()
        .map(|row| row["id"].as_str().unwrap())
        .collect();
    assert_eq!(ids, twin::model::registry::ids());
    let table = String::from_utf8(twin(folder.path(), &["effects"]).stdout).unwrap();
    for id in ids {
        assert!(table.lines().any(|line| line == id), "{id}");
    }
    assert!(!table.contains("NaN"), "{table}");
}

#[test]
fn every_command_has_an_example() {
    let folder = tempfile::tempdir().unwrap();
    for command in ["simulate", "explain", "convert", "effects"] {
        let output = twin(folder.path(), &[command, "--help"]);
        let help = String::from_utf8(output.stdout).unwrap();
        assert!(help.contains(&format!("  twin {command}")), "{help}");
    }
}

/// The library is written for currents; of watts nothing is to be said in amperes. What was taken out is in the report.
#[test]
fn a_power_sensor_in_its_own_words() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let mut text = "t_s,p_ref_w,p_meas_w\n".to_owned();
    for k in 0..1500 {
        let t_s = f64::from(k) * 0.1;
        let power = 200.0 + 100.0 * (0.37 * t_s).sin() + 60.0 * (1.91 * t_s).sin();
        let jitter = 0.3 * (f64::from(k * k % 1009) / 1009.0 - 0.5);
        text.push_str(&format!("{t_s},{power},{}\n", 1.015 * power + jitter));
    }
    fs::write(folder.join("r.csv"), text).unwrap();
    fs::write(
        folder.join("m.toml"),
        "schema = 1\n[sensor]\nnoise = 0.09\n",
    )
    .unwrap();
    let output = explained(folder, &["--without", "hum"]);
    let summary = String::from_utf8(output.stdout).unwrap();
    assert_eq!(output.status.code(), Some(0), "{summary}");
    assert!(
        summary.contains("Taken out of the library: hum"),
        "{summary}"
    );
    let read = |name: &str| fs::read_to_string(folder.join("out").join(name)).unwrap();
    let (report, page, model) = (read("report.json"), read("report.html"), read("model.toml"));
    assert!(page.contains("<dt>Taken out of the library</dt><dd>hum</dd>"));
    let said: serde_json::Value = serde_json::from_str(&report).unwrap();
    assert_eq!(said["inputs"]["without"][0], "hum");
    assert_eq!(said["effects"][0]["id"], "gain", "{summary}");
    assert!(
        report.contains("abs(x)") && !report.contains("abs(i)"),
        "{report}"
    );
    assert!(model.contains("reads every value too large"), "{model}");
    let interval = model
        .lines()
        .find(|line| line.contains("gain: 95 %"))
        .unwrap();
    let end = interval.rsplit(' ').next().unwrap();
    assert!(end.starts_with("1.01"), "{interval}");
}

/// A plain sensor's recording and model file, with an offset in A.
fn write_pair(folder: &Path, offset_a: f64) {
    let mut text = "t_s,i_ref_a,i_meas_a\n".to_owned();
    for k in 0..300 {
        let t_s = f64::from(k) * 0.1;
        let current = 10.0 * (0.37 * t_s).sin();
        text.push_str(&format!("{t_s},{current},{}\n", current + offset_a));
    }
    fs::write(folder.join("r.csv"), text).unwrap();
    fs::write(folder.join("m.toml"), "schema = 1\n[sensor]\n").unwrap();
}

#[test]
fn a_calibration_of_an_earlier_run_does_not_stay_and_is_said_to_be_removed() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    // No board, nothing to correct.
    write_pair(folder, 0.5);
    let said = |output: Output| {
        assert_eq!(output.status.code(), Some(0), "{output:?}");
        String::from_utf8(output.stdout).unwrap()
    };
    assert!(!said(explained(folder, &[])).contains("Removed"));
    let old = folder.join("out/calibration.toml");
    fs::write(&old, "# older\n").unwrap();
    let summary = said(explained(folder, &[]));
    assert!(!old.exists());
    let expected = format!(
        "Removed {}, of an earlier run",
        Path::new("out/calibration.toml").display()
    );
    assert!(summary.contains(&expected), "{summary}");
    // A run that is refused touches nothing.
    fs::write(&old, "# older\n").unwrap();
    fs::write(folder.join("r.csv"), "t_s,i_ref_a,i_meas_a\n0,1,1\n").unwrap();
    assert_eq!(explained(folder, &[]).status.code(), Some(2));
    assert!(old.exists());
}

#[test]
fn a_current_is_on_no_axis_of_volts() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let mut text = "t_s,i_ref_a,v_cell_v\n".to_owned();
    for k in 0..600 {
        let t_s = f64::from(k) * 0.1;
        let current = 70.0 * (0.37 * t_s).sin() + 20.0;
        text.push_str(&format!("{t_s},{current},{}\n", 3.5 - 0.0015 * current));
    }
    fs::write(folder.join("r.csv"), text).unwrap();
    let model = "schema = 1\n[battery]\ncapacity_ah = 50\ninitial_soc = 0.5\nohmic_resistance_ohm = 0.001\nocv = [[0, 3.0], [1, 4.0]]\n";
    fs::write(folder.join("m.toml"), model).unwrap();
    let output = explained(folder, &[]);
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let page = fs::read_to_string(folder.join("out/report.html")).unwrap();
    assert!(page.contains("<p>recorded: "));
    assert!(!page.contains("; reference: "));
}

/// A pipe can be read once.
#[cfg(unix)]
#[test]
fn a_recording_comes_through_a_pipe_as_from_a_file() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    write_pair(folder, 0.0);
    assert_eq!(twin(folder, &command::SIMULATE).status.code(), Some(0));
    let simulated = fs::read(folder.join("s.csv")).unwrap();
    for recording in ["r.csv", "r.parquet"] {
        let out = ["convert", "r.csv", "--out", "r.parquet"];
        assert_eq!(twin(folder, &out).status.code(), Some(0));
        let command = format!(
            "cat {recording} | {} simulate --model m.toml --recording /dev/stdin --out piped.csv",
            env!("CARGO_BIN_EXE_twin")
        );
        let mut shell = std::process::Command::new("sh");
        let output = shell
            .current_dir(folder)
            .args(["-c", &command])
            .output()
            .unwrap();
        assert_eq!(output.status.code(), Some(0), "{output:?}");
        assert_eq!(fs::read(folder.join("piped.csv")).unwrap(), simulated);
    }
}

/// Rows of a sensor whose reading and counter have zeros of their own.
fn zeros_of_their_own(reading_a: f64, counter_a: f64) -> String {
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let mut uniform = move || f64::from(random.next_u32()) / f64::from(u32::MAX);
    let mut text = "t_s,i_ref_a,i_meas_a,q_meas_c\n".to_owned();
    let (mut current, mut counted) = (0.0, 0.0);
    for k in 0..6000 {
        let noise = 0.2 * ((0..12).map(|_| uniform()).sum::<f64>() - 6.0);
        if k % 50 == 0 {
            current = 200.0 * uniform() - 60.0;
        }
        text.push_str(&format!(
            "{:.1},{current},{},{:.2}\n",
            f64::from(k) * 0.1,
            current + reading_a + noise,
            counted
        ));
        counted += (current + counter_a) * 0.1;
    }
    text
}

fn found(folder: &Path) -> (Vec<(String, String)>, String) {
    let report = fs::read_to_string(folder.join("out/report.json")).unwrap();
    let report: serde_json::Value = serde_json::from_str(&report).unwrap();
    let text = |value: &serde_json::Value| value.as_str().unwrap().to_owned();
    let effects = report["effects"].as_array().unwrap();
    let effects = effects
        .iter()
        .map(|effect| (text(&effect["id"]), text(&effect["signal"])))
        .collect();
    (effects, report["remarks"].to_string())
}

const ZERO_MODEL: &str = "schema = 1\n[sensor]\nfront_end = \"pair\"\nheld_reference = true\nnoise = 0.2\n[charge]\nstep_c = 0.01\n";

/// A counter with a zero of its own: the model file has one offset for the sensor and its counter, and that is said.
#[test]
fn an_effect_of_the_counter_alone_is_said_to_act_in_the_sensor_too() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("m.toml"), ZERO_MODEL).unwrap();
    fs::write(folder.join("r.csv"), zeros_of_their_own(0.0, 0.5)).unwrap();
    assert_eq!(explained(folder, &[]).status.code(), Some(0));
    let (effects, remarks) = found(folder);
    assert_eq!(effects, [("offset".into(), "q_meas_c".into())]);
    assert!(
        remarks.contains("offset was found in q_meas_c and not in i_meas_a"),
        "{remarks}"
    );
    assert!(!remarks.contains("stated in the model file"), "{remarks}");
}

/// Two zeros that contradict each other: the model file has one of them, which is said; and with that file, that it is not looked for.
#[test]
fn two_zeros_of_one_sensor_are_said_to_contradict_each_other() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("m.toml"), ZERO_MODEL).unwrap();
    fs::write(folder.join("r.csv"), zeros_of_their_own(-0.3, 0.5)).unwrap();
    assert_eq!(explained(folder, &[]).status.code(), Some(0));
    let (effects, remarks) = found(folder);
    assert_eq!(effects.len(), 2, "{effects:?}");
    assert!(
        remarks.contains("model.toml has the values of i_meas_a for both"),
        "{remarks}"
    );
    fs::copy(folder.join("out/model.toml"), folder.join("m.toml")).unwrap();
    assert_eq!(explained(folder, &[]).status.code(), Some(0));
    let (effects, remarks) = found(folder);
    assert!(effects.iter().all(|(id, _)| id != "offset"), "{effects:?}");
    assert!(
        remarks.contains("not looked for again: [effects.offset]"),
        "{remarks}"
    );
}

/// A sensor without a fault and its reference, both logged in steps of 1 A: an error that does not fall is explained by nothing else.
#[test]
fn a_step_that_both_columns_have_explains_no_error_away() {
    let folder = tempfile::tempdir().unwrap();
    let model = "schema = 1\n[sensor]\nfront_end = \"pair\"\n";
    fs::write(folder.path().join("m.toml"), model).unwrap();
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let mut uniform = move || f64::from(random.next_u32()) / f64::from(u32::MAX);
    let (mut current_a, mut target_a, mut left) = (0.0, 0.0, 0);
    let mut rows = "t_s,i_ref_a,i_meas_a\n".to_owned();
    for row in 0..3000 {
        if left == 0 {
            (left, target_a) = (5 + (75.0 * uniform()) as u32, 210.0 * uniform() - 60.0);
        }
        left -= 1;
        current_a += 0.05 * (target_a - current_a);
        let noise_a = 0.35 * (uniform() + uniform() - 1.0);
        rows.push_str(&format!(
            "{:.1},{current_a:.0},{:.0}\n",
            0.1 * f64::from(row),
            current_a + noise_a
        ));
    }
    fs::write(folder.path().join("r.csv"), rows).unwrap();
    assert_eq!(explained(folder.path(), &[]).status.code(), Some(0));
    let report = fs::read(folder.path().join("out/report.json")).unwrap();
    let report: serde_json::Value = serde_json::from_slice(&report).unwrap();
    let summary = report["summary"].as_str().unwrap();
    assert!(
        summary.contains(
            "no more than rounding both to the readings' step of 1 A makes (0.408 A rms)"
        ) && !summary.contains('→'),
        "{summary}"
    );
}
