//! Recordings in which the current hardly moves: a charging session, a staircase of a calibration. There one curve can stand for
//! two effects so nearly that it alone is found, and no pair is looked for; what it leaves tells.

use crate::common::{noise, sensor};
use twin::explain::{Options, explain};
use twin::report::data::{Report, Verdict};

const NOISE_A: f64 = 0.1;
/// Of the reference.
const QUIET_A: f64 = 0.02;

/// A charge at −80 A for 50 minutes, then at a constant voltage: a row per second.
fn charging_a() -> Vec<f64> {
    let current_a = |t_s: f64| -80.0 * (-(t_s - 3000.0).max(0.0) / 300.0).exp();
    (0..3600).map(|row| current_a(f64::from(row))).collect()
}

/// The levels of a calibration, 300 rows each.
fn staircase_a() -> Vec<f64> {
    let levels_a = [25.0, 50.0, 100.0, 150.0, 200.0, 250.0];
    (levels_a.into_iter())
        .flat_map(|level_a| [level_a; 300])
        .collect()
}

/// `reads` is told the current and the noise.
fn explained(current_a: Vec<f64>, reads: impl Fn(f64, f64) -> f64, seed: u64) -> Report {
    let (mut loud, mut quiet) = (noise(seed, NOISE_A), noise(100 + seed, QUIET_A));
    let reading_a = current_a.iter().map(|i| reads(*i, loud())).collect();
    let reference_a: Vec<f64> = current_a.iter().map(|i| i + quiet()).collect();
    let t_s = (0..current_a.len()).map(|row| row as f64).collect();
    let problem = sensor(t_s, reference_a, reading_a, NOISE_A);
    explain(&[problem], &[], &Options::default(), &mut |_, _| ())
}

fn ids(report: &Report) -> Vec<&str> {
    let mut ids: Vec<&str> = report.effects.iter().map(|e| e.id.as_str()).collect();
    ids.sort_unstable();
    ids
}

/// Gain and offset are named, with their values, and nothing is left.
fn are_named(report: &Report, gain: f64, offset_a: f64) {
    assert_eq!(ids(report), ["gain", "offset"], "{}", report.summary);
    let value = |id: &str| {
        let mut effects = report.effects.iter();
        effects.find(|e| e.id == id).unwrap().parameters[0].value
    };
    assert!((value("gain") - gain).abs() < 0.001, "{}", value("gain"));
    assert!(
        (value("offset") - offset_a).abs() < 0.1,
        "{}",
        value("offset")
    );
    assert!(report.unexplained.is_empty(), "{}", report.summary);
}

#[test]
fn a_staircase_read_by_another_gain_and_offset_is_no_quantisation() {
    for seed in 0..3 {
        let report = explained(staircase_a(), |i, noise| 1.01 * i + 0.5 + noise, seed);
        are_named(&report, 1.01, 0.5);
        assert_eq!(report.verdict, Verdict::Explained, "{}", report.summary);
    }
}

#[test]
fn a_charge_read_by_another_gain_and_offset_is_no_self_heating() {
    for seed in 0..3 {
        let report = explained(charging_a(), |i, noise| 1.02 * i + 0.4 + noise, seed);
        are_named(&report, 1.02, 0.4);
    }
}

/// What is there is not exchanged for what leaves less by chance.
#[test]
fn a_staircase_in_steps_keeps_them() {
    for seed in 0..3 {
        let step_a = 3.7;
        let read = |i: f64, noise: f64| ((i + noise) / step_a).round() * step_a;
        let report = explained(staircase_a(), read, seed);
        assert_eq!(ids(&report), ["quantisation"], "{}", report.summary);
    }
}
