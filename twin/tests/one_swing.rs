//! An end of the range that one swing of the current reaches and no other: the rest of the drive says nothing of it.

use crate::common::{noise, said, sensor};
use twin::problem::Problem;
use twin::report::data::{Report, Verdict};

const ROWS: usize = 4000;
const STEP_S: f64 = 0.1;
const NOISE_A: f64 = 0.5;
/// The swing's middle, half its width and its height.
const SWING: (f64, f64, f64) = (262.0, 2.5, 240.0);

/// Load steps of a quarter of the range that are low-passed, and one swing beyond them.
fn current(seed: u64) -> Vec<f64> {
    let mut step = noise(seed, 40.0);
    let (mut target, mut now) = (0.0, 0.0);
    (0..ROWS)
        .map(|row| {
            if row % 37 == 0 {
                target = step();
            }
            now += 0.2 * (target - now);
            let (middle_s, half_s, height) = SWING;
            let x = (row as f64 * STEP_S - middle_s) / half_s;
            now + (height - now) * (1.0 - x * x).max(0.0)
        })
        .collect()
}

/// What is said of a sensor that makes `reading` of the current with its noise, which comes before or after that.
fn explained(seed: u64, noise_before: bool, reading: impl Fn(f64) -> f64) -> Report {
    said(problem(seed, noise_before, reading), seed, &[])
}

/// The same with the noise behind it, effects being taken out of the library.
fn explained_without(seed: u64, without: &[&str], reading: impl Fn(f64) -> f64) -> Report {
    said(problem(seed, false, reading), seed, without)
}

/// The sensor's readings, under an ideal one as designed.
fn problem(seed: u64, noise_before: bool, reading: impl Fn(f64) -> f64) -> Problem {
    let current = current(seed);
    let mut noise = noise(seed + 100, NOISE_A);
    let t_s: Vec<f64> = (0..ROWS).map(|row| row as f64 * STEP_S).collect();
    let value = current
        .iter()
        .map(|i| match noise_before {
            true => reading(i + noise()),
            false => reading(*i) + noise(),
        })
        .collect();
    sensor(t_s, current, value, NOISE_A)
}

#[test]
fn a_core_that_saturates_once_is_not_certainly_a_rail() {
    let (knee_a, softness) = (150.0, 1.2);
    let mut covered = 0;
    for seed in 0..6 {
        let report = explained(seed, false, |i| {
            let beyond = (i.abs() - knee_a).max(0.0);
            i.signum() * (i.abs().min(knee_a) + beyond / (1.0 + beyond / (softness * knee_a)))
        });
        let [effect] = report.effects.as_slice() else {
            panic!("{seed}: {:?}", report.summary);
        };
        assert_eq!(effect.id, "core-saturation", "{seed}: {}", report.summary);
        let [low, high] = effect.parameters[0].ci95;
        covered += usize::from((low..=high).contains(&knee_a));
    }
    assert!(covered >= 5, "{covered} of 6");
}

/// Of the other rail's side only the lowest reading of all is near it: noise, and no rail.
#[test]
fn the_lowest_reading_is_no_rail() {
    for seed in 0..12 {
        let report = explained(seed, false, |i| i.min(180.0));
        let clipping = report.effects.iter().find(|effect| effect.id == "clipping");
        let Some(clipping) = clipping else {
            panic!("{seed}: {:?}", report.summary);
        };
        let names = clipping.parameters.iter().map(|one| one.name.as_str());
        assert!(names.eq(["high_a"]), "{seed}: {:?}", clipping.parameters);
    }
}

#[test]
fn a_rail_that_readings_stay_at_is_seen_without_any_other_swing() {
    const HIGH_A: f64 = 180.0;
    for seed in 0..6 {
        let report = explained(seed, true, |i| i.min(HIGH_A));
        let [effect] = report.effects.as_slice() else {
            panic!("{seed}: {:?}", report.summary);
        };
        assert_eq!(effect.id, "clipping", "{seed}: {}", report.summary);
        assert_eq!(
            report.verdict,
            Verdict::Explained,
            "{seed}: {:?} {:?}",
            report.summary,
            report.decisions
        );
        // The other rail no reading reaches: it is not told.
        let [high_a] = effect.parameters.as_slice() else {
            panic!("{seed}: {:?}", effect.parameters);
        };
        let [low, high] = high_a.ci95;
        assert!((low..=high).contains(&HIGH_A), "{seed}: {high_a:?}");
    }
}

#[test]
fn a_rail_ahead_of_the_noise_is_no_certain_core() {
    for seed in 0..6 {
        let report = explained(seed, false, |i| i.min(180.0));
        let named: Vec<&str> = report
            .effects
            .iter()
            .flat_map(|effect| std::iter::once(&effect.id).chain(&effect.equivalent_to))
            .map(String::as_str)
            .collect();
        assert!(
            named.contains(&"clipping"),
            "{seed}: {named:?} {}",
            report.summary
        );
    }
}

#[test]
fn a_sensitivity_error_read_in_steps_is_no_rail() {
    // The highest step stays below what was expected, as all of them do.
    for seed in 0..6 {
        let report = explained(seed, true, |i| (0.985 * i / 1.2).round() * 1.2);
        let ids: Vec<&str> = report
            .effects
            .iter()
            .map(|effect| effect.id.as_str())
            .collect();
        assert!(!ids.contains(&"clipping"), "{seed}: {}", report.summary);
        assert!(ids.contains(&"gain"), "{seed}: {}", report.summary);
    }
}

#[test]
fn a_current_that_stays_at_its_highest_value_is_no_rail() {
    // Charging at a constant current, told in steps: both hold the value, and agree.
    for seed in 0..6 {
        let report = explained(seed, true, |i| (i / 0.25).round() * 0.25);
        assert!(
            report.effects.iter().all(|effect| effect.id != "clipping"),
            "{seed}: {}",
            report.summary
        );
    }
}

#[test]
fn what_only_the_last_readings_show_is_held_out_too() {
    // As many as between two blocks are held out in neither.
    const LAST: usize = 8;
    for seed in 0..4 {
        let mut current = current(seed);
        let mut noise = noise(seed + 100, NOISE_A);
        let high = |row: usize| row >= ROWS - LAST;
        // The swing is beyond what these sensors are asked about.
        for (row, i) in current.iter_mut().enumerate() {
            *i = if high(row) {
                80.0 + 7.0 * (row % 4) as f64
            } else {
                0.5 * i.clamp(-100.0, 100.0)
            };
        }
        let read = |(row, i): (usize, &f64)| if high(row) { i + 20.0 } else { *i } + noise();
        let value = current.iter().enumerate().map(read).collect();
        let t_s = (0..ROWS).map(|row| row as f64 * STEP_S).collect();
        let mut problem = sensor(t_s, current, value, NOISE_A);
        let flags: Vec<f64> = (0..ROWS)
            .map(|row| f64::from(u8::from(high(row))))
            .collect();
        problem.drive.range_high = Some(flags.into());
        let report = said(problem, seed, &[]);
        assert!(
            report
                .effects
                .iter()
                .any(|effect| effect.id == "range-mismatch"),
            "{seed}: {} {:#?}",
            report.summary,
            report.decisions
        );
    }
}

/// Taken out of the library, a rail leaves a core whose knee is as sharp as physics allows: that is none.
#[test]
fn a_rail_is_not_certainly_a_core_with_the_sharpest_knee() {
    for seed in 0..6 {
        let report = explained_without(seed, &["clipping"], |i| i.min(180.0));
        assert_ne!(
            report.verdict,
            Verdict::Explained,
            "{seed}: {:?}",
            report.effects
        );
    }
}
