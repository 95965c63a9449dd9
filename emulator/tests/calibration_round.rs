//! A sensor's error, from the board's log through `twin explain` and Modbus back into the board: the next drive is better.
//!
//! The image as `rig::default_image` finds it; `cargo xtask test` builds it.

use std::f64::consts::TAU;
use std::fmt::Write as _;
use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use clap::Parser;
use emulator::rig::default_image;
use serde_json::Value;
use twin::explain_command;

/// What the sensor does that nobody is told.
const CONCEALED: &str = "large.gain=1.02";
/// The second drive's error is smaller by this factor, by the converter and by the meter. What is left is the time within a
/// millisecond that a conversion took, and the meter's counts.
const BETTER: [(&str, f64); 2] = [("i_meas_a", 15.0), ("q_meas_c", 15.0)];

#[derive(Parser)]
struct Twin {
    #[command(flatten)]
    explain: explain_command::Arguments,
}

/// Both ranges, both signs, and slopes that a conversion's time matters little in.
fn profile() -> String {
    let mut text = "t_s,i_ref_a,v_cell_v\n".to_owned();
    for row in 0..=450 {
        let t_s = f64::from(row) * 0.1;
        let i_a = 110.0 * (TAU * t_s / 20.0).sin() + 60.0 * (TAU * t_s / 7.3).sin();
        writeln!(text, "{t_s},{i_a:.3},3.7").unwrap();
    }
    text
}

fn emulate(folder: &Path, more: &[&str]) -> Output {
    let image = default_image();
    Command::new(env!("CARGO_BIN_EXE_emulate"))
        .current_dir(folder)
        .args(["drive", "--profile", "profile.csv", "--image"])
        .arg(image)
        .args(["--sensor", CONCEALED])
        .args(more)
        .output()
        .unwrap()
}

/// Drives, explains the log, and returns the report.
fn round(folder: &Path, name: &str, more: &[&str]) -> Value {
    let output = emulate(folder, &[more, &["--out", name]].concat());
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(0), "{said}");
    println!("{}", String::from_utf8_lossy(&output.stdout));
    let model = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../models/board-dual-range.toml"
    );
    let (log, out) = (
        folder.join(name).join("board.csv"),
        folder.join(name).join("report"),
    );
    let explain = Twin::parse_from([
        "twin".as_ref(),
        "--model".as_ref(),
        model.as_ref(),
        "--recording".as_ref(),
        log.as_os_str(),
        "--out".as_ref(),
        out.as_os_str(),
    ])
    .explain;
    println!("{}", explain_command::run(&explain).unwrap());
    let report = fs::read_to_string(out.join("report.json")).unwrap();
    serde_json::from_str(&report).unwrap()
}

fn rmse_before(report: &Value, signal: &str) -> f64 {
    let signals = report["signals"].as_array().unwrap();
    let of = signals.iter().find(|one| one["name"] == signal).unwrap();
    of["rmse_before"].as_f64().unwrap()
}

#[test]
fn what_was_found_is_written_back_and_the_next_drive_is_better() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("profile.csv"), profile()).unwrap();
    let first = round(folder, "first", &[]);
    let second = round(
        folder,
        "second",
        &["--calibration", "first/report/calibration.toml", "--check"],
    );
    for (signal, factor) in BETTER {
        let (before, after) = (rmse_before(&first, signal), rmse_before(&second, signal));
        println!(
            "{signal}: {before:.4} → {after:.4} A, {:.1}",
            before / after
        );
        assert!(
            before > factor * after,
            "{signal}: {before} A before, {after} A after"
        );
    }
    let charge_error_c = |drive: &str| {
        let text = fs::read_to_string(folder.join(drive).join("summary.json")).unwrap();
        let summary: Value = serde_json::from_str(&text).unwrap();
        summary["figures"]["charge_error_c"].as_f64().unwrap().abs()
    };
    assert!(charge_error_c("first") > 10.0 * charge_error_c("second"));
}

#[test]
fn a_calibration_that_the_board_would_not_take_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("profile.csv"), profile()).unwrap();
    let register = "[[register]]\nname = \"current gain\"\n";
    for (name, content, parts) in [
        ("empty.toml", String::new(), &["[[register]]"][..]),
        (
            "key.toml",
            format!("{register}gain = 1\n"),
            &["line 3", "gain", "large"],
        ),
        (
            "limit.toml",
            format!("\n{register}small = 0\nlarge = -200000\n"),
            &["line 2", "current gain", "large", "-200000", "-100000"],
        ),
    ] {
        fs::write(folder.join(name), content).unwrap();
        let output = emulate(folder, &["--calibration", name, "--out", "out"]);
        let message = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{message}");
        assert_eq!(message.lines().count(), 1, "{message}");
        for part in [&[name], parts].concat() {
            assert!(message.contains(part), "{message:?} should name {part:?}");
        }
        assert!(!folder.join("out").exists());
    }
    let output = emulate(folder, &["--calibration", "none.toml"]);
    let message = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{message}");
    assert!(message.contains("none.toml"), "{message}");
}
