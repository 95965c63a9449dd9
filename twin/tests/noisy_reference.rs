//! References with noise of their own: what is said of sensors that do not have it. The drive stands still for half of its time, as a
//! drive in a town does, and there a reference shows nothing but its noise.

use crate::common::{noise, said, sensor};
use twin::align::{Signal, estimate};
use twin::report::data::{Report, Verdict};

const ROWS: usize = 4000;
const STEP_S: f64 = 0.1;
/// A standstill, and a drive after it.
const STANDSTILL_S: f64 = 15.0;
const NOISE_A: f64 = 0.1;

/// Current in A at a time in s: standstills between waves that no two of them have alike.
fn current_a(t_s: f64) -> f64 {
    let moves = (t_s / STANDSTILL_S) as usize % 2 == 1;
    let wave = 60.0 * (0.7 * t_s).sin() + 45.0 * (1.9 * t_s + (0.03 * t_s).sin()).sin() + 20.0;
    if moves { wave } else { 0.0 }
}

fn drive() -> Vec<f64> {
    (0..ROWS)
        .map(|row| current_a(row as f64 * STEP_S))
        .collect()
}

/// What is said of readings of that drive beside a reference with noise of an rms, which the model states as a part of all noise.
fn of(reading: impl Fn(f64) -> f64, reference_noise_a: f64, seed: u64) -> Report {
    let mut own = noise(seed, NOISE_A);
    let mut others = noise(seed + 100, reference_noise_a);
    let drive = drive();
    let t_s = (0..ROWS).map(|row| row as f64 * STEP_S).collect();
    let reference = drive.iter().map(|i| i + others()).collect();
    let value = drive.iter().map(|i| reading(*i) + own()).collect();
    let all = NOISE_A.hypot(reference_noise_a);
    said(sensor(t_s, reference, value, all), seed, &[])
}

/// The value of the one effect that is named, which has to be this one, or it among others that would do as well.
#[track_caller]
fn assert_only(report: &Report, id: &str, truth: f64) {
    let [effect] = report.effects.as_slice() else {
        panic!("{} {:#?}", report.summary, report.decisions);
    };
    assert_eq!(effect.id, id, "{}", report.summary);
    let [low, high] = effect.parameters[0].ci95;
    let beyond = 0.5 * (high - low);
    assert!(
        low - beyond <= truth && truth <= high + beyond,
        "{truth}: {:?}",
        effect.parameters[0]
    );
}

#[test]
fn a_sensor_that_is_right_is_right() {
    for seed in 0..3 {
        let report = of(|i| i, 1.0, seed);
        let said = (&report.summary, &report.decisions);
        assert_eq!(report.verdict, Verdict::NoMismatch, "{said:#?}");
    }
}

#[test]
fn a_zero_error_is_named() {
    for (seed, reference_noise_a) in [(1, 0.3), (2, 0.3), (3, 1.0)] {
        let report = of(|i| i + 0.4, reference_noise_a, seed);
        assert_only(&report, "offset", 0.4);
    }
}

#[test]
fn a_sensitivity_error_is_named() {
    for (seed, reference_noise_a) in [(1, 0.3), (2, 1.0)] {
        let report = of(|i| 1.015 * i, reference_noise_a, seed);
        assert_only(&report, "gain", 1.015);
    }
}

/// Small currents that the sensor does not show are no noise of the reference: it shows them where they are larger.
#[test]
fn a_dead_band_is_still_one() {
    let report = of(|i| if i.abs() < 8.0 { 0.0 } else { i }, 0.3, 1);
    assert_only(&report, "dead-band", 8.0);
}

/// To smooth the reference takes its noise away, and to move it then by half of what it was smoothed over makes up for that: the clocks
/// are not that wrong.
#[test]
fn clocks_are_compared_by_the_current_and_not_by_noise() {
    const FINE_S: f64 = 0.01;
    const OFFSET_S: f64 = -3.217;
    for seed in 0..3 {
        let mut others = noise(seed, 0.5);
        let mut own = noise(seed + 100, 0.2);
        let t_s: Vec<f64> = (0..30_000).map(|row| f64::from(row) * FINE_S).collect();
        let reference: Vec<f64> = t_s.iter().map(|t| current_a(*t) + others()).collect();
        let times_s: Vec<f64> = (100..2800)
            .map(|row| f64::from(row) * STEP_S + 0.037)
            .collect();
        let reading: Vec<f64> = times_s.iter().map(|t| current_a(*t) + own()).collect();
        let of_sensor: Vec<f64> = times_s.iter().map(|t| t - OFFSET_S).collect();
        let driven = Signal::new(&t_s, &reference, |_| true);
        let sensed = Signal::new(&of_sensor, &reading, |_| true);
        let off_s = estimate(&driven, &sensed).unwrap().offset_s - OFFSET_S;
        assert!(off_s.abs() < 0.5 * FINE_S, "{seed}: {off_s}");
    }
}
