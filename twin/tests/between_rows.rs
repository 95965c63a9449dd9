//! What a reference does between its rows: loads that bend between them, made on a grid ten times finer than the rows by loops
//! of this file. Straight lines between the rows make windows too short and a delay look like a window.

use crate::common::{noise, said, sensor};
use twin::report::data::{ParameterReport, Report, Verdict};

const ROWS: usize = 3000;
const STEP_S: f64 = 0.1;
const FINE: usize = 10;
const FINE_S: f64 = STEP_S / FINE as f64;
const NOISE_A: f64 = 0.2;

/// Waves of several lengths, in A, on the finer grid.
fn load() -> Vec<f64> {
    load_from(0.0)
}

/// The same from a time in s on.
fn load_from(begin_s: f64) -> Vec<f64> {
    (0..ROWS * FINE)
        .map(|k| begin_s + k as f64 * FINE_S)
        .map(|t| {
            50.0 * (t / 3.0).sin()
                + 40.0 * (1.3 * t).sin()
                + 20.0 * (2.9 * t + 0.02 * t * (0.05 * t).sin()).sin()
        })
        .collect()
}

/// First-order low-pass of what goes in straight lines on the finer grid.
fn low_pass(input: &[f64], tau_s: f64) -> Vec<f64> {
    let kept = (-FINE_S / tau_s).exp();
    let mut state = input[0];
    input
        .iter()
        .scan(input[0], |last, &now| {
            state = kept * state + (1.0 - kept) * 0.5 * (*last + now);
            *last = now;
            Some(state)
        })
        .collect()
}

/// Mean over the time before, by trapezia.
fn window(input: &[f64], length: usize) -> Vec<f64> {
    (0..input.len())
        .map(|k| {
            let inner: f64 = (1..length).map(|back| input[k.saturating_sub(back)]).sum();
            (inner + 0.5 * (input[k] + input[k.saturating_sub(length)])) / length as f64
        })
        .collect()
}

fn explained(reading: &[f64], seed: u64) -> Report {
    of(&load(), reading, NOISE_A, seed)
}

/// What is said of a current and a reading of it, both on the finer grid.
fn of(current: &[f64], reading: &[f64], noise_a: f64, seed: u64) -> Report {
    let rows = || (0..ROWS).map(|row| row * FINE);
    let mut noise = noise(seed, noise_a);
    let t_s: Vec<f64> = (0..ROWS).map(|row| row as f64 * STEP_S).collect();
    let value = rows().map(|at| reading[at] + noise()).collect();
    let reference = rows().map(|at| current[at]).collect();
    said(sensor(t_s, reference, value, noise_a), seed, &[])
}

/// The value of the one effect that is named, with the ids that it may be.
fn only(report: &Report) -> (Vec<&str>, &ParameterReport) {
    let [effect] = report.effects.as_slice() else {
        panic!("{:?}", report.summary);
    };
    let others = effect.equivalent_to.iter().map(String::as_str);
    let ids = std::iter::once(effect.id.as_str()).chain(others).collect();
    (ids, &effect.parameters[0])
}

/// That the truth is within the interval, or beside it by no more than a tenth of what straight lines would make it.
#[track_caller]
fn assert_near(parameter: &ParameterReport, truth: f64, bias: f64) {
    let [low, high] = parameter.ci95;
    assert!(
        low - 0.1 * bias <= truth && truth <= high + 0.1 * bias,
        "{truth}: {parameter:?}"
    );
}

#[test]
fn a_delay_of_half_a_step_is_a_delay() {
    let load = load();
    let late: Vec<f64> = (0..load.len())
        .map(|k| load[k.saturating_sub(FINE / 2)])
        .collect();
    for seed in 0..3 {
        let report = explained(&late, seed);
        let (ids, delay) = only(&report);
        assert!(ids.contains(&"delay"), "{}", report.summary);
        if ids[0] == "delay" {
            assert!((delay.value - 0.05).abs() < 1e-3, "{delay:?}");
        }
        let course = "the reference is taken to go smoothly";
        assert!(
            report.remarks.iter().any(|remark| remark.contains(course)),
            "{:?}",
            report.remarks
        );
    }
}

#[test]
fn a_window_and_a_lag_are_as_long_as_they_are() {
    let load = load();
    for seed in 0..3 {
        let report = explained(&window(&load, 60), seed);
        let (ids, found) = only(&report);
        assert_eq!(ids[0], "moving-average", "{}", report.summary);
        // By Δt²/6 of the variance w²/12 that straight lines add: Δt²/w.
        assert_near(found, 0.6, STEP_S * STEP_S / 0.6);
        let report = explained(&low_pass(&load, 0.3), seed);
        let (ids, found) = only(&report);
        assert_eq!(ids[0], "lag", "{}", report.summary);
        assert_near(found, 0.3, STEP_S * STEP_S / (12.0 * 0.3));
    }
}

/// A log begins and ends in the middle of a drive: what the reference did outside shows in readings, and no model knows of it.
#[test]
fn what_the_reference_did_outside_the_log_speaks_against_no_delay() {
    for (delay_s, end, seed) in [(0.33, "first", 0), (-0.33, "last", 1)] {
        let report = of(&load(), &load_from(-delay_s), NOISE_A, seed);
        let (_, delay) = only(&report);
        assert_eq!(report.effects[0].id, "delay", "{}", report.summary);
        assert_ne!(
            report.verdict,
            Verdict::PartlyExplained,
            "{}",
            report.summary
        );
        let [low, high] = delay.ci95;
        assert!(
            low <= delay_s && delay_s <= high && high - low < 1e-3,
            "{delay:?}"
        );
        let said = report.remarks.join("\n");
        assert!(said.contains(&format!("the {end} 0.33")), "{said}");
    }
    // Nothing is left out where the log begins at rest.
    let mut rested = load();
    rested[..20 * FINE].fill(0.0);
    let late: Vec<f64> = (0..rested.len())
        .map(|k| rested[k.saturating_sub(33)])
        .collect();
    let report = of(&rested, &late, NOISE_A, 2);
    let said = report.remarks.join("\n");
    assert!(!said.contains("not looked at"), "{said}");
}

/// A lag's equation is an idealisation, but where no more than noise is left it is not off by a gain's size: refused, the gain
/// would make the lag 0.015 s shorter.
#[test]
fn a_gain_beside_a_lag_or_a_window_is_named_and_leaves_it_its_time() {
    const LENGTH_S: f64 = 0.5;
    let load = load();
    let lagged = low_pass(&load, LENGTH_S);
    let averaged = window(&load, (LENGTH_S / FINE_S) as usize);
    for (slow, id, bias) in [
        (lagged, "lag", STEP_S * STEP_S / (12.0 * LENGTH_S)),
        (averaged, "moving-average", STEP_S * STEP_S / LENGTH_S),
    ] {
        let reading: Vec<f64> = slow.iter().map(|current| 1.01 * current).collect();
        for seed in 0..3 {
            let report = of(&load, &reading, 0.5 * NOISE_A, seed);
            let value_of = |id: &str| {
                let found = report.effects.iter().find(|effect| effect.id == id);
                let found = found.unwrap_or_else(|| panic!("{id} {seed}: {}", report.summary));
                &found.parameters[0]
            };
            let gain = value_of("gain");
            assert!((gain.value - 1.01).abs() < 1e-3, "{seed}: {gain:?}");
            assert_near(value_of(id), LENGTH_S, bias);
        }
    }
}

/// Steps of half a second to six seconds, in A, through a low-pass of the first order: a kink at each step.
fn blunted_steps(seed: u64, tau_s: f64) -> Vec<f64> {
    let mut random = noise(seed ^ 0x5eed, 1.0);
    let (mut steps, mut size, mut left) = (Vec::new(), 0.0, 0usize);
    for _ in 0..ROWS * FINE {
        if left == 0 {
            left = 50 + (120.0 * random().abs()) as usize;
            size = 25.0 + 60.0 * random();
        }
        left -= 1;
        steps.push(size);
    }
    low_pass(&steps, tau_s)
}

/// What is said of a current that is read half a row late, a hundredth too large and 0.8 A off.
fn late_and_off(current: &[f64], noise_a: f64, seed: u64) -> Report {
    let late: Vec<f64> = (0..current.len())
        .map(|k| 1.01 * current[k.saturating_sub(FINE / 2)] + 0.8)
        .collect();
    of(current, &late, noise_a, seed)
}

#[test]
fn a_kink_does_not_bend_what_is_beside_it() {
    for seed in 0..4 {
        let report = late_and_off(&blunted_steps(seed, 0.8), 0.2, seed);
        let course = "the reference is taken to go smoothly";
        assert!(
            report.remarks.iter().any(|remark| remark.contains(course)),
            "{:?}",
            report.remarks
        );
        let [signal] = report.signals.as_slice() else {
            panic!("{:?}", report.signals);
        };
        // A kink within a step leaves something whatever the course: of such a drive the true effects leave about 0.30 A on Akima's, 0.33 A
        // and more on the parabola's slopes, and 0.39 A and more on straight lines.
        assert!(signal.rmse_after < 0.3, "{seed}: {}", report.summary);
        let gain = report.effects.iter().find(|effect| effect.id == "gain");
        let gain = gain.unwrap_or_else(|| panic!("{seed}: {}", report.summary));
        let value = gain.parameters[0].value;
        assert!((value - 1.01).abs() < 1e-3, "{seed}: {value}");
    }
}

#[test]
fn a_delay_hides_neither_a_gain_nor_an_offset() {
    for seed in 0..6 {
        let report = late_and_off(&blunted_steps(seed, 2.0), 0.5, seed);
        let mut ids: Vec<&str> = report.effects.iter().map(|e| e.id.as_str()).collect();
        ids.sort_unstable();
        let [time, gain, offset] = ids[..] else {
            panic!("{seed}: {}", report.summary);
        };
        assert_eq!((gain, offset), ("gain", "offset"), "{}", report.summary);
        assert!(["delay", "lag"].contains(&time), "{}", report.summary);
    }
}

/// A reference has noise of its own, and a window evens it out, which no delay does: that is no reason to call a delay a window.
#[test]
fn a_delay_behind_a_noisy_reference_is_no_window_for_certain() {
    const DELAY_ROWS: usize = 3;
    // So slow that a window of some rows leaves it as it is.
    let current: Vec<f64> = (0..ROWS * FINE)
        .map(|k| k as f64 * FINE_S)
        .map(|t| 60.0 * (t / 5.0).sin() + 20.0 * (0.5 * t + 0.3 * (0.13 * t).sin()).sin())
        .collect();
    let reading: Vec<f64> = (0..current.len())
        .map(|k| current[k.saturating_sub(DELAY_ROWS * FINE)])
        .collect();
    for seed in 0..4 {
        let mut own = noise(seed + 50, 0.25 * NOISE_A);
        let noisy: Vec<f64> = current.iter().map(|i| i + own()).collect();
        let report = of(&noisy, &reading, NOISE_A, seed);
        let named = report.effects.iter().any(|effect| {
            effect.id == "delay" || effect.equivalent_to.iter().any(|id| id == "delay")
        });
        assert!(named, "{seed}: {} {:?}", report.summary, report.decisions);
    }
}
