//! Effects concealed in a real drive: the tool is given recording and as-designed model only, and has to name them.
//!
//! The drive is real (recordings/panasonic-18650pf, scaled to a vehicle's current); the effects are put in here, by loops of
//! their own on a finer grid of time than the recording's. So these tests are evidence of kind (d): our own simulator. They
//! guard against regressions and prove nothing more.

use std::path::Path;

use crate::common::{noise, said, sensor};

use twin::explain::{Holdout, Options, explain};
use twin::problem::{Base, Coloured, Problem, SensorBase};
use twin::report::data::{Report, Verdict};

const ROWS: usize = 9000;
const STEP_S: f64 = 0.1;
/// Steps of the finer grid in one of the recording.
const FINE: usize = 50;
/// Standard deviation of the noise, in A: stated in the model.
const NOISE_A: f64 = 0.5;

struct Truth {
    t_s: Vec<f64>,
    current_a: Vec<f64>,
    temperature_c: Vec<f64>,
    high: Vec<f64>,
}

fn truth() -> Truth {
    truth_of("25c-us06.csv")
}

/// The current of a recorded drive, for a car's battery.
fn truth_of(file: &str) -> Truth {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../recordings/panasonic-18650pf");
    let path = folder.join(file);
    let recording = recording::csv::read(&path).unwrap();
    let (t, i) = (recording.time_s(), recording.need("i_ref_a").unwrap());
    let t_s: Vec<f64> = (0..ROWS).map(|k| k as f64 * STEP_S).collect();
    let mut at = 0;
    let current_a: Vec<f64> = t_s
        .iter()
        .map(|now| {
            while t[at + 1] <= *now {
                at += 1;
            }
            19.0 * (i[at] + (i[at + 1] - i[at]) * (now - t[at]) / (t[at + 1] - t[at]))
        })
        .collect();
    let mut high = 0.0;
    let flags = current_a
        .iter()
        .map(|i| {
            if i.abs() > 53.33 {
                high = 1.0;
            } else if i.abs() < 51.0 {
                high = 0.0;
            }
            high
        })
        .collect();
    let temperature_c = t_s
        .iter()
        .map(|t| 25.0 + 14.0 * (t / 130.0).sin() + 4.0 * (t / 37.0).cos())
        .collect();
    Truth {
        t_s,
        current_a,
        temperature_c,
        high: flags,
    }
}

/// Explains `reading` plus white noise.
fn explained(truth: &Truth, reading: Vec<f64>, seed: u64, without: &[&str]) -> Report {
    let mut noise = noise(seed, NOISE_A);
    let value: Vec<f64> = reading.iter().map(|y| y + noise()).collect();
    explained_as_read(truth, value, Coloured::default(), seed, without)
}

/// Explains readings that have noise of `NOISE_A` in all, some of it with a memory.
fn explained_as_read(
    truth: &Truth,
    value: Vec<f64>,
    coloured: Coloured,
    seed: u64,
    without: &[&str],
) -> Report {
    said(problem_of(truth, value, coloured), seed, without)
}

/// Readings of the drive, under the model as designed.
fn problem_of(truth: &Truth, value: Vec<f64>, coloured: Coloured) -> Problem {
    let (t_s, current_a) = (truth.t_s.clone(), truth.current_a.clone());
    let mut problem = sensor(t_s, current_a, value, NOISE_A);
    problem.drive.sensor_temperature_c = Some(truth.temperature_c.clone().into());
    problem.drive.range_high = Some(truth.high.clone().into());
    problem.base = Base::Sensor(SensorBase {
        full_scale: Some(600.0),
        range_ratio: 10.0,
        ..SensorBase::default()
    });
    problem.coloured = coloured;
    problem
}

#[track_caller]
fn assert_named(report: &Report, id: &str, parameters: &[(&str, f64, f64)]) {
    assert!(
        matches!(report.verdict, Verdict::Explained | Verdict::Ambiguous),
        "{id}: {:?} {:?}",
        report.verdict,
        report.decisions
    );
    assert_eq!(report.effects.len(), 1, "{id}: {:?}", report.effects);
    let effect = &report.effects[0];
    assert!(
        effect.id == id || effect.equivalent_to.iter().any(|other| other == id),
        "{id}: {effect:?}"
    );
    for (name, value, tolerance) in parameters {
        let found = effect.parameters.iter().find(|p| p.name == *name).unwrap();
        assert!(
            (found.value - value).abs() <= *tolerance,
            "{id}: {found:?} for {value}"
        );
    }
    assert!(effect.held_out_gain > effect.placebo_p99);
}

/// On the fine grid, straight lines between the recording's samples.
fn fine(truth: &Truth) -> Vec<f64> {
    (0..(ROWS - 1) * FINE + 1)
        .map(|k| {
            let (row, part) = (k / FINE, (k % FINE) as f64 / FINE as f64);
            let here = truth.current_a[row];
            if part == 0.0 {
                here
            } else {
                here + (truth.current_a[row + 1] - here) * part
            }
        })
        .collect()
}

#[test]
fn nothing_is_found_where_nothing_is_concealed() {
    let truth = truth();
    for seed in 0..5 {
        let report = explained(&truth, truth.current_a.clone(), seed, &[]);
        assert_eq!(
            report.verdict,
            Verdict::NoMismatch,
            "seed {seed}: {:?}",
            report.effects
        );
    }
}

#[test]
fn single_readings_far_beyond_noise_are_no_agreement() {
    let truth = truth();
    let with = |strays: &[(usize, f64)]| {
        let mut reading = truth.current_a.clone();
        for (row, by_a) in strays {
            reading[*row] += by_a;
        }
        explained(&truth, reading, 7, &[])
    };
    // One may be a slip of the log.
    assert_eq!(with(&[(4000, 94.0)]).verdict, Verdict::NoMismatch);
    let report = with(&[(1700, -24.0), (4000, 94.0), (7200, 31.0)]);
    assert_eq!(report.verdict, Verdict::Unknown, "{:?}", report.effects);
    let said = report.decisions.join("\n");
    assert!(said.contains("3 readings") && said.contains(" A"), "{said}");
}

/// A sensor that is right, in messages that wait for their turn on a bus: no effect of the library, and nothing with a course.
#[test]
fn moments_that_scatter_are_told() {
    /// Five minutes of the drive.
    const FEW: usize = 3000;
    let truth = truth();
    let remark = |reading: Vec<f64>, seed: u64, noise_a: f64, without: &[&str]| {
        let mut noise = noise(seed, noise_a);
        let [t_s, current_a] = [&truth.t_s, &truth.current_a].map(|series| series[..FEW].to_vec());
        let reading_a = reading[..FEW].iter().map(|y| y + noise()).collect();
        let report = said(sensor(t_s, current_a, reading_a, NOISE_A), seed, without);
        let mut remarks = report.remarks.into_iter();
        let found = remarks.find(|said| said.contains("a moment of its own"));
        (found, report.summary)
    };
    let waits_to_s = 0.06;
    let mut random = noise(160, 1.0);
    // As far about half of it as waits are that may be any up to the longest.
    let mut waits_s = || waits_to_s * (0.5 + random() / 12.0_f64.sqrt()).max(0.0);
    let late = (0..ROWS).map(|row| {
        let (before, here) = (truth.current_a[row.saturating_sub(1)], truth.current_a[row]);
        here - (here - before) * waits_s() / STEP_S
    });
    let (told, summary) = remark(late.collect(), 60, NOISE_A, &[]);
    let told = told.unwrap_or_else(|| panic!("{summary}"));
    let seconds = |then: &str| -> f64 {
        let (before, _) = told.split_once(then).unwrap();
        before.rsplit(' ').next().unwrap().parse().unwrap()
    };
    let uniform_s = waits_to_s / 12.0_f64.sqrt();
    assert!(
        (seconds(" s (rms)") / uniform_s - 1.0).abs() < 0.1,
        "{told}"
    );
    let mean_s = 0.5 * waits_to_s;
    assert!(
        (seconds(" s earlier") / mean_s - 1.0).abs() < 0.05,
        "{told}"
    );
    // Louder noise is no such thing, nor what another effect leaves.
    let louder = remark(truth.current_a.clone(), 62, 3.0 * NOISE_A, &[]);
    assert_eq!(louder.0, None, "{}", louder.1);
    let lag = remark(lagged(&truth, 0.3), 63, NOISE_A, &["lag"]);
    assert_eq!(lag.0, None, "{}", lag.1);
}

#[test]
fn a_zero_error_and_a_sensitivity_error() {
    let truth = truth();
    let reading = truth.current_a.iter().map(|i| i + 0.4).collect();
    assert_named(
        &explained(&truth, reading, 1, &[]),
        "offset",
        &[("offset_a", 0.4, 0.03)],
    );
    let reading = truth.current_a.iter().map(|i| 0.985 * i).collect();
    assert_named(
        &explained(&truth, reading, 2, &[]),
        "gain",
        &[("gain", 0.985, 0.001)],
    );
}

/// Five hours that begin under a usual load: no sensor warms so slowly that its heat would be the same all the time.
#[test]
fn a_sensitivity_error_over_hours_is_no_heat() {
    let mut truth = truth();
    truth.t_s.iter_mut().for_each(|t| *t *= 20.0);
    let mut next = noise(7, 60.0);
    for steps in truth.current_a.chunks_mut(30) {
        steps.fill(next());
    }
    truth.current_a[..30].fill(60.0);
    truth.high.fill(0.0);
    let reading = truth.current_a.iter().map(|i| 1.02 * i).collect();
    let report = explained(&truth, reading, 41, &[]);
    assert_named(&report, "gain", &[("gain", 1.02, 0.0005)]);
    assert_eq!(report.verdict, Verdict::Explained, "{:?}", report.effects);
}

/// A log that begins in the middle of a drive begins with the heat of what it does not show: of the first row's current it says nothing.
#[test]
fn the_heat_of_a_drive_that_was_under_way() {
    let (tc_per_a2, tau_s, h) = (2e-6, 60.0, STEP_S / FINE as f64);
    let mut truth = truth();
    let kept = (-h / tau_s).exp();
    for (seed, before_a) in [(61, 0.0), (62, 150.0)] {
        truth.current_a[0] = 40.0;
        let fine = fine(&truth);
        let mut heat = before_a * before_a;
        let mut reading = vec![fine[0] * (1.0 + tc_per_a2 * heat)];
        for k in 1..fine.len() {
            heat = kept * heat + (1.0 - kept) * 0.5 * (fine[k].powi(2) + fine[k - 1].powi(2));
            if k % FINE == 0 {
                reading.push(fine[k] * (1.0 + tc_per_a2 * heat));
            }
        }
        let report = explained(&truth, reading, seed, &[]);
        assert_named(
            &report,
            "sensor-self-heating",
            &[("tc_per_a2", tc_per_a2, 1e-7), ("tau_s", tau_s, 6.0)],
        );
        assert_eq!(report.verdict, Verdict::Explained, "{:?}", report.decisions);
    }
}

/// A rail cuts off a little of a few large readings of a coarse converter. The smallest reading is as good as a rail to nobody.
#[test]
fn a_rail_that_hardly_shows_is_at_its_end() {
    let truth = truth();
    let step_a = 1.2;
    let mut sorted = truth.current_a.clone();
    sorted.sort_unstable_by(f64::total_cmp);
    let mut told = 0;
    for (seed, beyond) in (70..).zip([15, 20, 25, 30, 40, 60]) {
        let rail_a = sorted[ROWS - beyond];
        let mut noise = noise(seed, 0.36);
        let value = truth.current_a.iter().map(|i| {
            let read = (i.min(rail_a) + noise()) / step_a;
            step_a * read.round()
        });
        let mut problem = problem_of(&truth, value.collect(), Coloured::default());
        problem.base = Base::Sensor(SensorBase {
            full_scale: Some(600.0),
            step: step_a,
            ..SensorBase::default()
        });
        let report = said(problem, seed, &[]);
        for effect in report
            .effects
            .iter()
            .filter(|effect| effect.id == "clipping")
        {
            let names: Vec<&str> = effect.parameters.iter().map(|p| p.name.as_str()).collect();
            assert_eq!(names, ["high_a"], "{beyond}: {effect:?}");
            let [low, high] = effect.parameters[0].ci95;
            assert!(
                (low..=high).contains(&rail_a),
                "{beyond}: {rail_a} {effect:?}"
            );
            told += 1;
        }
    }
    assert!(told >= 2, "{told}");
}

#[test]
fn both_at_once() {
    let truth = truth();
    let reading = truth.current_a.iter().map(|i| 1.02 * i - 1.5).collect();
    let report = explained(&truth, reading, 3, &[]);
    let mut ids: Vec<&str> = report
        .effects
        .iter()
        .map(|effect| effect.id.as_str())
        .collect();
    ids.sort_unstable();
    assert_eq!(ids, ["gain", "offset"], "{:?}", report.decisions);
}

/// Slips of the log are told, and take no name back that has nothing to do with them.
#[test]
fn a_gain_beside_slips_of_the_log() {
    let truth = truth();
    let mut reading: Vec<f64> = truth.current_a.iter().map(|i| 1.02 * i).collect();
    for (row, by_a) in [(1700, -44.0), (4000, 94.0), (7200, 61.0)] {
        reading[row] += by_a;
    }
    let report = explained(&truth, reading, 44, &[]);
    let ids: Vec<&str> = report.effects.iter().map(|e| e.id.as_str()).collect();
    assert_eq!(ids, ["gain"], "{:?}", report.decisions);
    assert!((report.effects[0].parameters[0].value - 1.02).abs() < 1e-3);
    // What they are is left, and said.
    assert_eq!(report.verdict, Verdict::PartlyExplained);
    let slips = |remark: &String| remark.contains("3 readings are off by more than 8 times");
    assert!(report.remarks.iter().any(slips), "{:?}", report.remarks);
}

/// What is told is `gain·i + offset`, whichever of the two is the larger and so found first.
#[test]
fn an_offset_beside_a_gain_is_what_is_added_to_the_reading() {
    let truth = truth();
    for (gain, offset) in [(1.02, -0.8), (1.01, 8.0)] {
        let reading = truth.current_a.iter().map(|i| gain * i + offset).collect();
        let report = explained(&truth, reading, 43, &[]);
        let told = |id: &str| {
            let effect = report.effects.iter().find(|effect| effect.id == id);
            effect.unwrap().parameters[0].value
        };
        assert!((told("gain") - gain).abs() < 0.0005, "{:?}", report.effects);
        assert!(
            (told("offset") - offset).abs() < 0.025,
            "{:?}",
            report.effects
        );
    }
}

#[test]
fn a_drift_with_temperature() {
    let truth = truth();
    let pairs = truth.current_a.iter().zip(&truth.temperature_c);
    let reading = pairs.map(|(i, t)| i + 0.05 * (t - 25.0)).collect();
    let report = explained(&truth, reading, 4, &[]);
    assert_named(
        &report,
        "offset-temperature",
        &[("tc_a_per_k", 0.05, 0.004)],
    );
}

/// The current behind a low-pass.
fn lagged(truth: &Truth, tau_s: f64) -> Vec<f64> {
    let mut y = truth.current_a[0];
    let kept = (-STEP_S / FINE as f64 / tau_s).exp();
    let fine = fine(truth);
    let mut reading = vec![y];
    for k in 1..fine.len() {
        y = kept * y + (1.0 - kept) * 0.5 * (fine[k] + fine[k - 1]);
        if k % FINE == 0 {
            reading.push(y);
        }
    }
    reading
}

#[test]
fn a_lag_and_what_is_said_without_it() {
    let (truth, tau_s) = (truth(), 0.35);
    let reading = lagged(&truth, tau_s);
    assert_named(
        &explained(&truth, reading.clone(), 5, &[]),
        "lag",
        &[("tau_s", tau_s, 0.005)],
    );
    let report = explained(&truth, reading, 5, &["lag"]);
    assert_ne!(report.verdict, Verdict::Explained, "{:?}", report.effects);
}

#[test]
fn a_window() {
    let truth = truth();
    let window_s = 0.8;
    let rows = (window_s / STEP_S) as usize * FINE;
    let fine = fine(&truth);
    let mean = |end: usize| {
        let value = |k: i64| fine[k.max(0) as usize];
        let (end, rows) = (end as i64, rows as i64);
        let inner: f64 = (end - rows + 1..end).map(value).sum();
        (inner + 0.5 * (value(end) + value(end - rows))) / rows as f64
    };
    let reading = (0..ROWS).map(|row| mean(row * FINE)).collect();
    let report = explained(&truth, reading, 6, &[]);
    assert_named(&report, "moving-average", &[("window_s", window_s, 0.01)]);
}

#[test]
fn a_second_sensor_that_disagrees() {
    let truth = truth();
    let pairs = truth.current_a.iter().zip(&truth.high);
    let reading = pairs
        .map(|(i, high)| if *high > 0.5 { 1.02 * i + 1.0 } else { *i })
        .collect();
    let report = explained(&truth, reading, 7, &[]);
    assert_named(
        &report,
        "range-mismatch",
        &[("gain_ratio", 1.02, 0.002), ("offset_a", 1.0, 0.2)],
    );
    let pairs = truth.current_a.iter().zip(&truth.high);
    let reading = pairs
        .map(|(i, high)| if *high > 0.5 { 1.02 * i + 1.0 } else { *i })
        .collect();
    let report = explained(&truth, reading, 7, &["range-mismatch"]);
    assert_ne!(report.verdict, Verdict::Explained, "{:?}", report.effects);
}

#[test]
fn a_rail_a_dead_band_and_a_hum() {
    let truth = truth();
    let reading = truth.current_a.iter().map(|i| i.min(180.0)).collect();
    assert_named(
        &explained(&truth, reading, 8, &[]),
        "clipping",
        &[("high_a", 180.0, 0.3)],
    );
    let reading = truth
        .current_a
        .iter()
        .map(|i| if i.abs() < 4.0 { 0.0 } else { *i })
        .collect();
    assert_named(
        &explained(&truth, reading, 9, &[]),
        "dead-band",
        &[("threshold_a", 4.0, 0.15)],
    );
    let pairs = truth.current_a.iter().zip(&truth.t_s);
    let reading: Vec<f64> = pairs
        .map(|(i, t)| i + 0.4 * (std::f64::consts::TAU * 1.7 * t + 1.0).sin())
        .collect();
    // Whatever the clock says at the start: one may count from 1970.
    for begin_s in [0.0, 1.7e9] {
        let mut later = self::truth();
        later.t_s.iter_mut().for_each(|t| *t += begin_s);
        assert_named(
            &explained(&later, reading.clone(), 10, &[]),
            "hum",
            &[("frequency_hz", 1.7, 1e-3), ("amplitude_a", 0.4, 0.05)],
        );
    }
}

/// A curve that the library lacks is none of those that it has, even where one of them takes most of it.
#[test]
fn a_curve_of_another_shape_is_unknown() {
    type Curve = fn(&f64) -> f64;
    let truth = truth();
    // The junction's drop grows with the logarithm of the current.
    let curves: [(&str, Curve); 3] = [
        ("square", |i| i + 2e-4 * i * i),
        ("cube", |i| i + 1.2e-6 * i.powi(3)),
        ("junction", |i| i - 1.5 * (i / 8.0).asinh()),
    ];
    for (seed, (name, curve)) in (20..).zip(curves) {
        let reading = truth.current_a.iter().map(curve).collect();
        let report = explained(&truth, reading, seed, &[]);
        assert_eq!(
            report.verdict,
            Verdict::Unknown,
            "{name}: {:?} {:?}",
            report.effects,
            report.decisions
        );
    }
}

/// A drive of a fifth of the size.
fn gentle() -> Truth {
    let mut truth = truth();
    truth.current_a.iter_mut().for_each(|i| *i *= 0.2);
    truth
}

/// What a core with an air gap gives.
fn gapped(truth: &Truth, remanence_a: f64, coercivity_a: f64) -> Vec<f64> {
    let limits = [0.5, 0.75, 1.0, 1.25, 1.5].map(|share| share * coercivity_a);
    let (mut stops, mut before) = ([0.0f64; 5], 0.0);
    let reading = truth.current_a.iter().map(|i| {
        for (stop, limit) in stops.iter_mut().zip(limits) {
            *stop = (*stop + i - before).clamp(-limit, limit);
        }
        before = *i;
        i - remanence_a * stops.iter().sum::<f64>() / limits.iter().sum::<f64>()
    });
    reading.collect()
}

/// Loops of half the largest current, twenty times as high as where the search for a core begins.
#[test]
fn a_core_with_wide_and_high_loops() {
    let truth = gentle();
    let (remanence_a, coercivity_a) = (11.4, 37.0);
    let reading = gapped(&truth, remanence_a, coercivity_a);
    assert_named(
        &explained(&truth, reading, 31, &[]),
        "core-hysteresis",
        &[("remanence_a", 11.4, 0.1), ("coercivity_a", 37.0, 0.3)],
    );
}

/// Noise ahead of a threshold makes readings jump: what a second effect makes of some of them is chance.
#[test]
fn nothing_stands_beside_a_dead_band_that_noise_comes_through() {
    let truth = gentle();
    for seed in 40..44 {
        let mut noise = noise(seed, NOISE_A);
        let seen = truth.current_a.iter().map(|i| i + noise());
        let reading = seen.map(|x| if x.abs() < 15.0 { 0.0 } else { x }).collect();
        let report = explained_as_read(&truth, reading, Coloured::default(), seed, &[]);
        assert_named(&report, "dead-band", &[("threshold_a", 15.0, 0.5)]);
    }
}

/// A twentieth of what the lag changes is more than all that the dead band does; but with it noise is left and nothing else.
#[test]
fn a_dead_band_behind_a_lag_and_a_gain() {
    const QUIET_A: f64 = 0.1;
    let (truth, tau_s, gain, threshold_a) = (truth(), 0.2, 1.02, 2.0);
    for seed in 44..47 {
        let mut noise = noise(seed, QUIET_A);
        let seen = lagged(&truth, tau_s).into_iter();
        let seen = seen.map(|i| gain * i + noise());
        let reading = seen.map(|x| if x.abs() < threshold_a { 0.0 } else { x });
        let (t_s, current_a) = (truth.t_s.clone(), truth.current_a.clone());
        let report = said(
            sensor(t_s, current_a, reading.collect(), QUIET_A),
            seed,
            &[],
        );
        let values = [
            ("lag", tau_s, 0.002),
            ("gain", gain, 0.001),
            // By the few readings next to it.
            ("dead-band", threshold_a, QUIET_A),
        ];
        assert_eq!(report.effects.len(), values.len(), "{}", report.summary);
        for (id, value, by) in values {
            let effect = report.effects.iter().find(|effect| effect.id == id);
            let found = effect.unwrap().parameters[0].value;
            assert!((found - value).abs() < by, "{id}: {found}");
        }
        assert_eq!(report.verdict, Verdict::Explained, "{}", report.summary);
    }
}

/// A load that is switched, and a converter of few steps with the noise ahead of it: a soft curve on the mean, and steps all the
/// same, as the readings show.
#[test]
fn steps_that_noise_softens() {
    let mut truth = truth();
    let levels_a = [12.0, 118.0, 36.0, 171.0, 55.0, 148.0, 70.0, 7.0, 133.0];
    for (row, current_a) in truth.current_a.iter_mut().enumerate() {
        *current_a = levels_a[(row / 7 + row / 61) % levels_a.len()];
    }
    let step_a = 15.8;
    let mut noise = noise(50, NOISE_A);
    let seen = truth.current_a.iter().map(|i| i + noise());
    let reading = seen.map(|x| step_a * (x / step_a).round()).collect();
    let report = explained_as_read(&truth, reading, Coloured::default(), 50, &[]);
    assert_named(&report, "quantisation", &[("step_a", step_a, 0.1)]);
}

/// The same loop of a core without a gap, by relays of this test's own: what is kept is the sign of what was large enough.
/// Noise ahead of a grid of three times its size takes every other reading over an edge: rounding the simulation makes the error no
/// smaller, and the readings lie on the grid all the same.
#[test]
fn steps_that_noise_goes_over_are_told_by_the_readings() {
    const STEP_A: f64 = 1.5;
    let truth = truth();
    let mut noise = noise(61, NOISE_A);
    let read = truth.current_a.iter().map(|i| i + noise());
    let read: Vec<f64> = read.map(|y| STEP_A * (y / STEP_A).round()).collect();
    let report = explained_as_read(&truth, read, Coloured::default(), 61, &[]);
    let [effect] = report.effects.as_slice() else {
        panic!("{:?} {:?}", report.effects, report.decisions);
    };
    assert_eq!(effect.id, "quantisation", "{:?}", report.decisions);
    let found = effect.parameters[0].value;
    assert!((found - STEP_A).abs() < 0.001 * STEP_A, "{found}");
}

#[test]
fn a_closed_core_is_hysteresis() {
    let truth = truth();
    let mut reading = truth.current_a.clone();
    for part in 0..40 {
        let threshold_a = 10.0 + 0.5 * f64::from(part);
        let mut kept = 0.0;
        for (y, i) in reading.iter_mut().zip(&truth.current_a) {
            if i.abs() > threshold_a {
                kept = i.signum();
            }
            // The middle of the two branches is known.
            let middle = (i / threshold_a).clamp(-1.0, 1.0);
            *y += 0.08 * (kept - middle);
        }
    }
    let report = explained(&truth, reading, 30, &[]);
    let ids: Vec<&str> = report.effects.iter().map(|e| e.id.as_str()).collect();
    assert_eq!(ids, ["core-hysteresis"], "{:?}", report.decisions);
}

/// Asserts that hysteresis alone is named, with these values.
#[track_caller]
fn assert_hysteresis(truth: &Truth, reading: Vec<f64>, seed: u64, values: &[(&str, f64, f64)]) {
    let report = explained(truth, reading, seed, &[]);
    let ids: Vec<&str> = report.effects.iter().map(|e| e.id.as_str()).collect();
    assert_eq!(ids, ["core-hysteresis"], "{:?}", report.decisions);
    assert!(
        report.effects[0].equivalent_to.is_empty(),
        "{:?}",
        report.effects
    );
    assert_named(&report, "core-hysteresis", values);
}

/// One relay: what is added has the sign of the last current that was large enough, from before the recording on.
#[test]
fn a_single_relay_is_hysteresis() {
    let truth = truth();
    for (seed, begins) in [(31, 0.0), (32, -1.0)] {
        let mut kept = begins;
        let reading = truth.current_a.iter().map(|i| {
            if i.abs() > 30.0 {
                kept = i.signum();
            }
            i + 1.5 * kept
        });
        assert_hysteresis(
            &truth,
            reading.collect(),
            seed,
            &[("remanence_a", 1.5, 0.1), ("coercivity_a", 30.0, 3.0)],
        );
    }
}

/// A plane of relays with a Lorentzian density of coercivities and of the fields of neighbours, each relay by itself.
#[test]
fn a_preisach_plane_is_hysteresis() {
    let truth = truth();
    let (coercivity_a, remanence_a) = (30.0, 2.0);
    let bell = |x: f64| 1.0 / (1.0 + x * x);
    let mut relays = Vec::new();
    for c in 1..=40 {
        for b in -40..=40 {
            let (c, b) = (0.1 * f64::from(c), 0.1 * f64::from(b));
            let density = bell((c - 1.0) / 0.4) * bell(b / 0.5);
            relays.push(((b + c) * coercivity_a, (b - c) * coercivity_a, density));
        }
    }
    // From saturation on one side: the rest of it, what is above and what is below, is the remanence's unit.
    let left: f64 = relays
        .iter()
        .map(|(_, down, w)| if *down < 0.0 { *w } else { -w })
        .sum();
    let mut states: Vec<f64> = relays
        .iter()
        .map(|(up, down, _)| -(up + down).signum())
        .collect();
    let reading = truth.current_a.iter().map(|i| {
        let mut sum = 0.0;
        for ((up, down, density), state) in relays.iter().zip(&mut states) {
            if i >= up {
                *state = 1.0;
            } else if i <= down {
                *state = -1.0;
            }
            sum += density * *state;
        }
        i + remanence_a * sum / left
    });
    assert_hysteresis(
        &truth,
        reading.collect(),
        33,
        &[("remanence_a", 2.0, 0.2), ("coercivity_a", 30.0, 3.0)],
    );
}

/// Bouc and Wen's equation with an exponent of two, by small steps; on either side of the current.
#[test]
fn rounded_loops_that_do_not_close_are_hysteresis() {
    let truth = truth();
    for (seed, remanence_a) in [(34, 2.0), (35, -2.0)] {
        let (mut z, mut at) = (0.0f64, 0.0);
        let reading = truth.current_a.iter().map(|i| {
            let steps = ((i - at).abs() / 0.05).ceil();
            for _ in 0..steps as usize {
                let dz = (i - at) / steps / 25.0;
                z += dz - 0.5 * (dz.abs() * z.abs() * z + dz * z * z);
            }
            at = *i;
            i - remanence_a * z
        });
        assert_hysteresis(
            &truth,
            reading.collect(),
            seed,
            &[
                ("remanence_a", remanence_a, 0.2),
                ("coercivity_a", 25.0, 5.0),
            ],
        );
    }
}

/// What is turned over once, or goes with the sign of the present current, is no memory of a core.
#[test]
fn a_drift_or_a_side_is_no_hysteresis() {
    let truth = truth();
    let drift = |row: usize| 6.0 * row as f64 / ROWS as f64 - 3.0;
    let drifting = truth.current_a.iter().enumerate();
    let drifting = drifting.map(|(row, i)| i + drift(row)).collect();
    let sides = truth.current_a.iter();
    let sides = sides
        .map(|i| if *i > 0.0 { 1.02 * i } else { *i })
        .collect();
    for (seed, reading) in [(36, drifting), (37, sides)] {
        let report = explained(&truth, reading, seed, &[]);
        let named = |id: &str| report.effects.iter().any(|effect| effect.id == id);
        assert!(!named("core-hysteresis"), "{:?}", report.effects);
    }
}

/// What wanders beside a sensitivity error, by a fifth of what single readings vary by, and follows nothing that was recorded: the noise
/// that the model file states has no memory, so something else is there, too.
#[test]
fn what_stated_noise_would_not_leave_is_doubted() {
    let truth = truth_of("25c-hwfet.csv");
    let times = truth.t_s.iter();
    let wander: Vec<f64> = times
        .map(|t| 0.11 * ((t / 5.3).sin() + (t / 3.1 + 0.4 * (t / 11.0).sin()).sin()))
        .collect();
    let reading: Vec<f64> = truth.current_a.iter().map(|i| 1.02 * i).collect();
    for (seed, wanders) in [(43, true), (44, true), (43, false), (44, false)] {
        let reading = if wanders {
            plus(&reading, &wander)
        } else {
            reading.clone()
        };
        let report = explained(&truth, reading, seed, &[]);
        assert_named(&report, "gain", &[("gain", 1.02, 0.002)]);
        let expected = if wanders {
            Verdict::Ambiguous
        } else {
            Verdict::Explained
        };
        assert_eq!(report.verdict, expected, "{:?}", report.decisions);
    }
}

/// Noise that wanders for half a minute, a little white noise beside it.
const SLOW: Coloured = Coloured {
    rms: 0.48,
    tau_s: 30.0,
};

/// Slow noise at each row, in A.
fn slow_noise(seed: u64) -> Vec<f64> {
    coloured_noise(SLOW, seed)
}

/// Noise of which some has a memory, at each row, in A.
fn coloured_noise(coloured: Coloured, seed: u64) -> Vec<f64> {
    let mut step = noise(seed, 1.0);
    let kept = (-STEP_S / coloured.tau_s).exp();
    let white = (NOISE_A.powi(2) - coloured.rms.powi(2)).sqrt();
    let mut slow = coloured.rms * step();
    (0..ROWS)
        .map(|_| {
            slow = kept * slow + coloured.rms * (1.0 - kept * kept).sqrt() * step();
            slow + white * step()
        })
        .collect()
}

fn plus(a: &[f64], b: &[f64]) -> Vec<f64> {
    a.iter().zip(b).map(|(a, b)| a + b).collect()
}

#[test]
fn slow_noise_hides_no_quick_effect_and_is_none() {
    let truth = truth();
    for seed in 0..4 {
        let noise = slow_noise(seed);
        let report = explained_as_read(&truth, plus(&truth.current_a, &noise), SLOW, seed, &[]);
        assert_eq!(
            report.verdict,
            Verdict::NoMismatch,
            "seed {seed}: {:?}",
            report.effects
        );
        // 0.2 A rms beneath 0.5 A of noise.
        let reading: Vec<f64> = truth.current_a.iter().map(|i| 1.004 * i).collect();
        let report = explained_as_read(&truth, plus(&reading, &noise), SLOW, seed, &[]);
        assert_named(&report, "gain", &[("gain", 1.004, 0.0003)]);
        let signal = &report.signals[0];
        // What is shown is as it was read: the noise is still there.
        assert!(
            (0.6..1.4).contains(&(signal.rmse_after / NOISE_A)),
            "{signal:?}"
        );
    }
}

#[test]
fn a_core_is_one_in_noise_with_a_memory() {
    // On a motorway, where the current seldom turns, what noise with a memory leaves of a core is next to a closed one.
    let truth = truth_of("25c-hwfet.csv");
    let coloured = Coloured {
        rms: 0.48,
        tau_s: 2.0,
    };
    for (seed, remanence_a) in [(0, 4.0), (1, 12.0), (2, 4.0), (3, 12.0)] {
        let reading = plus(
            &gapped(&truth, remanence_a, 50.0),
            &coloured_noise(coloured, seed),
        );
        let report = explained_as_read(&truth, reading, coloured, seed, &[]);
        let expected = [
            ("remanence_a", remanence_a, 0.3),
            ("coercivity_a", 50.0, 4.0),
        ];
        assert_named(&report, "core-hysteresis", &expected);
    }
}

#[test]
fn a_drift_that_is_slower_than_the_stated_noise_is_no_noise() {
    let truth = truth();
    let drift = |t: &f64| 6.0 * (t / 290.0).sin();
    let noise = plus(
        &slow_noise(5),
        &truth.t_s.iter().map(drift).collect::<Vec<_>>(),
    );
    let report = explained_as_read(&truth, plus(&truth.current_a, &noise), SLOW, 5, &[]);
    assert_ne!(
        report.verdict,
        Verdict::NoMismatch,
        "{:?}",
        report.decisions
    );
    let reading: Vec<f64> = truth.current_a.iter().map(|i| 1.01 * i).collect();
    let report = explained_as_read(&truth, plus(&reading, &noise), SLOW, 5, &[]);
    assert!(
        !matches!(report.verdict, Verdict::NoMismatch | Verdict::Explained),
        "{:?}",
        report.decisions
    );
}

#[test]
fn slow_noise_ahead_of_a_rail_stays_below_it() {
    let truth = truth();
    let value = plus(&truth.current_a, &slow_noise(3));
    let value = value.iter().map(|y| y.min(140.0)).collect();
    let report = explained_as_read(&truth, value, SLOW, 3, &[]);
    assert_named(&report, "clipping", &[("high_a", 140.0, 0.5)]);
}

/// Readings show the rail to the digit; gain and offset are what the others say beside it, with one rail or the other.
#[test]
fn a_gain_and_an_offset_beside_a_rail() {
    let rails = [
        ("high_a", 100.0, f64::NEG_INFINITY, 100.0),
        ("low_a", -60.0, -60.0, f64::INFINITY),
    ];
    for (seed, (end, rail_a, low_a, high_a)) in (4..).zip(rails) {
        let truth = truth();
        let mut noise = noise(seed, NOISE_A);
        let current = truth.current_a.iter();
        let value = current
            .map(|i| (0.982 * i + 0.7 + noise()).clamp(low_a, high_a))
            .collect();
        let report = explained_as_read(&truth, value, Coloured::default(), seed, &[]);
        let value_of = |id: &str, name: &str| {
            let effect = report.effects.iter().find(|effect| effect.id == id);
            let effect = effect.unwrap_or_else(|| panic!("{id}: {}", report.summary));
            let found = effect.parameters.iter().find(|p| p.name == name);
            found.unwrap_or_else(|| panic!("{effect:?}")).value
        };
        assert_eq!(value_of("clipping", end), rail_a, "{}", report.summary);
        assert!(
            (value_of("gain", "gain") - 0.982).abs() < 1e-3,
            "{}",
            report.summary
        );
        assert!(
            (value_of("offset", "offset_a") - 0.7).abs() < 0.05,
            "{}",
            report.summary
        );
    }
}

#[test]
fn the_same_seed_gives_the_same_report() {
    let truth = truth();
    let reading: Vec<f64> = truth.current_a.iter().map(|i| 1.01 * i).collect();
    let json = |report: &Report| {
        let mut report = report.clone();
        report.seconds = 0.0;
        serde_json::to_string(&report).unwrap()
    };
    let one = json(&explained(&truth, reading.clone(), 11, &[]));
    assert_eq!(one, json(&explained(&truth, reading, 11, &[])));
}

/// A file that was never fitted has to have what was found, once: half of it is no confirmation.
#[test]
fn what_another_file_has_half_of_is_doubted() {
    let truth = truth();
    let file = |gain: f64, seed| {
        let mut noise = noise(seed, NOISE_A);
        let value = truth.current_a.iter().map(|i| gain * i + noise()).collect();
        problem_of(&truth, value, Coloured::default())
    };
    let verdict_with = |gain_there: f64| {
        let holdout = Holdout {
            file: "other.csv".into(),
            problems: vec![file(gain_there, 42)],
        };
        let report = explain(
            &[file(1.02, 41)],
            &[holdout],
            &Options::default(),
            &mut |_, _| {},
        );
        assert_eq!(report.effects.len(), 1, "{:?}", report.effects);
        assert_eq!(report.effects[0].id, "gain");
        let told = report
            .decisions
            .iter()
            .any(|text| text.contains("other.csv, which was never fitted, has 0.5"));
        (report.verdict, told)
    };
    assert_eq!(verdict_with(1.02), (Verdict::Explained, false));
    assert_eq!(verdict_with(1.0104), (Verdict::Ambiguous, true));
}

/// Rests, with pulses of a current that jumps within a row.
fn pulses() -> Truth {
    let mut truth = truth();
    for (row, current) in truth.current_a.iter_mut().enumerate() {
        *current = match row {
            2000..2100 => 60.0,
            6000..6040 => -40.0,
            _ => 0.0,
        };
    }
    truth
}

/// The signal at an earlier time: straight lines.
fn earlier(signal: &[f64], late_s: f64) -> Vec<f64> {
    (0..signal.len())
        .map(|row| {
            let at = (row as f64 - late_s / STEP_S).max(0.0);
            let before = signal[at as usize];
            let after = signal[(at as usize + 1).min(signal.len() - 1)];
            before + (after - before) * at.fract()
        })
        .collect()
}

/// On four edges a delay, a lag and a window do the same: none is named alone.
#[test]
fn few_edges_name_no_one_alone() {
    let truth = pulses();
    for seed in [51, 52, 53] {
        let report = explained(&truth, earlier(&truth.current_a, 0.1045), seed, &[]);
        assert_named(&report, "delay", &[]);
        assert!(
            !report.effects[0].equivalent_to.is_empty(),
            "{:?}",
            report.effects
        );
    }
}

/// What is late all the time, and ever later, is no window that is read at another place of its period each time.
#[test]
fn a_delay_beside_a_clock_of_another_rate_is_no_window() {
    // Few enough rows that a window among thousands comes near.
    const SHORT: usize = 4000;
    let mut truth = truth();
    truth.t_s.truncate(SHORT);
    for series in [
        &mut truth.current_a,
        &mut truth.temperature_c,
        &mut truth.high,
    ] {
        series.truncate(SHORT);
    }
    for (seed, skew) in [(71, 45e-6), (72, 45e-6), (73, 30e-6), (74, -45e-6)] {
        let reading = (0..SHORT).map(|row| {
            let late_rows = (0.012 + skew * truth.t_s[row]) / STEP_S;
            let at = (row as f64 - late_rows).clamp(0.0, (SHORT - 1) as f64);
            let [before, after] = [0, 1].map(|k| truth.current_a[(at as usize + k).min(SHORT - 1)]);
            before + (after - before) * at.fract()
        });
        let report = explained(&truth, reading.collect(), seed, &[]);
        let named: Vec<&str> = report.effects.iter().map(|it| it.id.as_str()).collect();
        assert_eq!(named.len(), 2, "{seed}: {named:?}");
        assert!(named.contains(&"clock-skew"), "{seed}: {named:?}");
    }
}

/// Readings that stay, though the design says that each is new, are measured and held: no mean alone.
#[test]
fn a_window_that_is_held_is_named_as_such() {
    let truth = truth();
    let period = 12;
    let mut noise = noise(61, NOISE_A);
    let (mut value, mut fresh) = (Vec::new(), Vec::new());
    for row in 0..ROWS {
        fresh.push(row % period == 0);
        value.push(if row % period == 0 {
            let from = row.saturating_sub(period);
            let sum: f64 = (from..row)
                .map(|k| 0.5 * (truth.current_a[k] + truth.current_a[k + 1]))
                .sum();
            sum / (row - from).max(1) as f64 + noise()
        } else {
            value[row - 1]
        });
    }
    let mut problem = problem_of(&truth, value, Coloured::default());
    problem.observed.valid = fresh;
    problem.observed.held_s = period as f64 * STEP_S;
    assert_named(&said(problem, 61, &[]), "sampled-window", &[]);
}

/// A zero that jumps is no staircase, however well one of its steps fits.
#[test]
fn a_jump_of_the_zero_is_no_staircase() {
    let truth = truth();
    for (seed, jump_a) in [(71, 3.0), (72, -6.0)] {
        let value = truth.current_a.iter().enumerate();
        let value = value
            .map(|(row, i)| i + if row > ROWS * 55 / 100 { jump_a } else { 0.0 })
            .collect();
        let report = explained(&truth, value, seed, &[]);
        assert_ne!(report.verdict, Verdict::Explained, "{:?}", report.effects);
    }
}

/// Where in its turn a ripple stands when a file begins is that file's own.
#[test]
fn a_ripple_of_another_phase_is_the_same_ripple() {
    let truth = truth();
    let file = |phase: f64, seed| {
        let mut noise = noise(seed, NOISE_A);
        let ripple = |t: f64| 0.8 * (std::f64::consts::TAU * 1.237 * t + phase).sin();
        let rows = truth.current_a.iter().zip(&truth.t_s);
        let value = rows.map(|(i, t)| i + ripple(*t) + noise()).collect();
        problem_of(&truth, value, Coloured::default())
    };
    let holdout = Holdout {
        file: "other.csv".into(),
        problems: vec![file(2.5, 82)],
    };
    let report = explain(
        &[file(0.0, 81)],
        &[holdout],
        &Options::default(),
        &mut |_, _| {},
    );
    assert_named(
        &report,
        "hum",
        &[("frequency_hz", 1.237, 1e-3), ("amplitude_a", 0.8, 0.05)],
    );
    let there = &report.holdouts[0];
    assert!(there.rmse_after < 1.05 * NOISE_A, "{there:?}");
}

/// Where the model file states no noise, a few wild readings do not set the measure by which they are none.
#[test]
fn wild_readings_are_no_agreement() {
    let truth = truth();
    let mut noise = noise(91, 0.02);
    let mut value: Vec<f64> = truth.current_a.iter().map(|i| i + noise()).collect();
    for (count, row) in [1234, 4321, 7000].into_iter().enumerate() {
        value[row] = 6553.5;
        let mut problem = problem_of(&truth, value.clone(), Coloured::default());
        problem.noise = 0.0;
        let report = said(problem, 91, &[]);
        assert_eq!(report.verdict, Verdict::Unknown, "{}", count + 1);
    }
}

/// Noise with a memory that nobody states makes a constant no less constant.
#[test]
fn a_constant_in_slow_noise_is_constant() {
    let truth = truth();
    let kept = f64::exp(-STEP_S / 5.0);
    for (seed, stated) in [(101, 0.0), (102, 0.0), (103, NOISE_A), (104, NOISE_A)] {
        let mut noise = noise(seed, NOISE_A);
        let mut memory = 0.0;
        let value = truth
            .current_a
            .iter()
            .map(|i| {
                memory = kept * memory + (1.0 - kept * kept).sqrt() * noise();
                i + 2.0 + memory
            })
            .collect();
        let mut problem = problem_of(&truth, value, Coloured::default());
        problem.noise = stated;
        assert_named(
            &said(problem, seed, &[]),
            "offset",
            &[("offset_a", 2.0, 0.3)],
        );
    }
}

/// Readings that are rounded down: by the nearest step, with an offset of half of one. At rest the current is right on an edge.
#[test]
fn steps_that_are_cut_off_keep_their_size() {
    for (seed, step_a) in [(60, 8.0), (61, 8.0), (62, 8.0)] {
        let mut truth = truth();
        for (row, current_a) in truth.current_a.iter_mut().enumerate() {
            // A rest in each third.
            if row % 900 < 300 {
                *current_a = 0.0;
            }
        }
        let mut noise = noise(seed, 0.05 * step_a);
        let seen = truth.current_a.iter().map(|i| i + noise());
        let reading = seen.map(|x| step_a * (x / step_a).floor()).collect();
        let problem = Problem {
            noise: 0.0,
            ..problem_of(&truth, reading, Coloured::default())
        };
        let report = said(problem, seed, &[]);
        for effect in &report.effects {
            for parameter in effect.parameters.iter().filter(|p| p.name == "step_a") {
                assert!((parameter.value - step_a).abs() < 1e-3, "{effect:?}");
                let [low, high] = parameter.ci95;
                assert!(
                    low > 0.99 * step_a && low <= step_a && high >= step_a && high < 1.01 * step_a,
                    "{effect:?}"
                );
            }
            for parameter in effect.parameters.iter().filter(|p| p.name == "offset_a") {
                assert!(
                    (parameter.value + 0.5 * step_a).abs() < 0.1 * step_a,
                    "{effect:?}"
                );
            }
        }
        let signal = &report.signals[0];
        assert!(
            signal.rmse_after <= signal.rmse_before,
            "{:?} {:?}",
            report.verdict,
            report.decisions
        );
    }
}

/// Either alone is next to nothing: in the mean over the drive they cancel.
#[test]
fn a_gain_that_its_own_drift_hides() {
    let tc_per_k = 0.0055;
    let mut truth = truth();
    let warming = truth.t_s.iter().map(|t| 31.0 + 11.0 * t / 900.0);
    truth.temperature_c = warming.collect();
    let pairs = || truth.current_a.iter().zip(&truth.temperature_c);
    let (squares, drifts) = pairs().fold((0.0, 0.0), |(squares, drifts), (i, t)| {
        (squares + i * i, drifts + i * i * tc_per_k * (t - 25.0))
    });
    let gain = 1.0 / (1.0 + drifts / squares);
    let reading = pairs().map(|(i, t)| gain * i * (1.0 + tc_per_k * (t - 25.0)));
    let report = explained(&truth, reading.collect(), 30, &[]);
    assert_eq!(report.verdict, Verdict::Explained, "{}", report.summary);
    assert_eq!(report.effects.len(), 2, "{}", report.summary);
    for (id, value) in [("gain", gain), ("gain-temperature", tc_per_k)] {
        let effect = report.effects.iter().find(|effect| effect.id == id);
        let found = &effect.unwrap().parameters[0];
        assert!(
            found.ci95[0] <= value && value <= found.ci95[1],
            "{value}: {found:?}"
        );
    }
}

/// What a change of range leaves behind lasts less than a row, and a late reading looks at it there.
#[test]
fn a_change_of_range_that_is_read_late() {
    /// Steps of the finest grid in one of the recording.
    const FINEST: usize = 1000;
    let (tau_s, delay_s, ratio) = (0.02, 0.03, 10.0);
    let mut truth = truth();
    let step_s = STEP_S / FINEST as f64;
    let kept = (-step_s / tau_s).exp();
    let late = (delay_s / step_s).round() as usize;
    let mut reading = vec![truth.current_a[0]; ROWS];
    let (mut held, mut error, mut high) = (truth.current_a[0], 0.0, false);
    for k in 1..(ROWS - 1) * FINEST {
        let (row, part) = (k / FINEST, (k % FINEST) as f64 / FINEST as f64);
        let i = truth.current_a[row] + (truth.current_a[row + 1] - truth.current_a[row]) * part;
        held = kept * held + (1.0 - kept) * i;
        error *= kept;
        let now = if high {
            i.abs() >= 51.0
        } else {
            i.abs() > 53.33
        };
        if now != high {
            let scale = if now { ratio } else { 1.0 / ratio };
            error = scale * (held + error) - held;
            high = now;
        }
        if k % FINEST == 0 {
            truth.high[row] = f64::from(high);
        }
        if (k + late).is_multiple_of(FINEST) {
            reading[(k + late) / FINEST] = i + error;
        }
    }
    truth.high[0] = 0.0;
    truth.high[ROWS - 1] = f64::from(high);
    let report = explained(&truth, reading, 31, &[]);
    let found = |id: &str| {
        let effects = report.effects.iter();
        let named = effects.clone().find(|effect| effect.id == id);
        named
            .unwrap_or_else(|| panic!("{id}: {}", report.summary))
            .parameters[0]
            .value
    };
    assert!(
        (found("range-handover") - tau_s).abs() < 0.05 * tau_s,
        "{}",
        report.summary
    );
    assert!(
        (found("delay") - delay_s).abs() < 0.05 * delay_s,
        "{}",
        report.summary
    );
}
