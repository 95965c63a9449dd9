//! Each form where it is hidden, and none where there is none.

#![allow(clippy::unwrap_used, clippy::panic)]

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng as _;
use rand_distr::{Distribution as _, StandardNormal};

use super::form;
use crate::explain::workbench::Workbench;
use crate::problem::{Problem, View};
use crate::report::data::Form;

const ROWS: usize = 6000;
const STEP_S: f64 = 0.1;
const NOISE_A: f64 = 0.1;

fn t_s(row: usize) -> f64 {
    STEP_S * row as f64
}

/// A drive in A: waves, and steps of both signs that never come again.
fn current_a() -> Vec<f64> {
    let mut step_a = 0.0;
    let mut drawn = drawn(1);
    (0..ROWS)
        .map(|row| {
            if row % 37 == 0 {
                step_a = 50.0 * drawn();
            }
            step_a + 30.0 * (t_s(row) / 7.0).sin()
        })
        .collect()
}

fn drawn(seed: u64) -> impl FnMut() -> f64 {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    move || StandardNormal.sample(&mut random)
}

/// Readings of a sensor as they are made of the rows' numbers, the current and noise ahead of what makes them.
fn problem(seed: u64, reads: impl Fn(usize, f64, f64) -> f64) -> Problem {
    let current = current_a();
    let mut noise = drawn(seed);
    let reading = current.iter().enumerate();
    let reading: Vec<f64> = reading
        .map(|(row, current)| reads(row, *current, NOISE_A * noise()))
        .collect();
    Problem::pair((0..ROWS).map(t_s).collect(), current, reading, NOISE_A)
}

/// The form of the whole mismatch.
fn of(problem: &Problem) -> Option<Form> {
    let bench = Workbench::new(problem, &[]);
    let residual = bench.residual(&bench.plain);
    form(&bench, &residual, problem.noise)
}

/// What a form with a memory makes of the current, row by row.
fn followed(mut next: impl FnMut(f64) -> f64) -> Vec<f64> {
    current_a().into_iter().map(&mut next).collect()
}

#[test]
fn each_form_is_told_with_its_values_and_leaves_the_noise() {
    let mut reads_a = current_a()[0];
    let slow = followed(|i| {
        reads_a += (i - reads_a).clamp(-40.0 * STEP_S, 40.0 * STEP_S);
        reads_a
    });
    // ω = 3 1/s, ζ = 0.3, in a hundred parts of each row, by straight lines between the rows.
    let (mut state, mut last) = ((current_a()[0], 0.0), current_a()[0]);
    let rings = followed(|i| {
        let parts = 100;
        let h = STEP_S / f64::from(parts);
        for part in 0..parts {
            let x = last + (i - last) * (f64::from(part) + 0.5) / f64::from(parts);
            let speed = state.1 + h * (9.0 * (x - state.0) - 2.0 * 0.3 * 3.0 * state.1);
            state = (state.0 + h * speed, speed);
        }
        last = i;
        state.0
    });
    type Reads<'a> = Box<dyn Fn(usize, f64, f64) -> f64 + 'a>;
    let cases: Vec<(&str, &str, Reads<'_>)> = vec![
        (
            "step",
            "0 A until 250.0 s, +0.800 A from then on",
            Box::new(|row, i, e| i + e + if row < 2500 { 0.0 } else { 0.8 }),
        ),
        (
            "slope-step",
            "0 % of i until 250.0 s, −2.00 % of i from then on",
            Box::new(|row, i, e| i * if row < 2500 { 1.0 } else { 0.98 } + e),
        ),
        (
            "direction",
            "where i > 0, +3.00 % of i where i < 0",
            Box::new(|_, i, e| i * if i > 0.0 { 1.0 } else { 1.03 } + e),
        ),
        (
            "direction",
            "−200 % of i where i < 0: the sign is lost",
            Box::new(|_, i, e| (i + e).abs()),
        ),
        (
            "sign",
            "−0.60",
            Box::new(|_, i, e| 0.99 * i - 0.6 * i.signum() + e),
        ),
        (
            "square",
            "+0.000500 A/A² times i²",
            Box::new(|_, i, e| i + 5e-4 * i * i + e),
        ),
        ("cube", "−5.0", Box::new(|_, i, e| i - 5e-6 * i * i * i + e)),
        (
            "drift",
            "a drift of +30.0 A an hour",
            Box::new(|row, i, e| i + 30.0 * t_s(row) / 3600.0 + e),
        ),
        (
            "slope-drift",
            "a drift of +20.0 % of i an hour",
            Box::new(|row, i, e| i * (1.0 + 0.2 * t_s(row) / 3600.0) + e),
        ),
        (
            "step-over",
            "0 A where i is below 60.",
            Box::new(|_, i, e| i + e - if i < 60.0 { 0.0 } else { 120.0 }),
        ),
        (
            "slope-step-over",
            "0 % of i where abs(i) is below 40.",
            Box::new(|_, i, e| i * if i.abs() < 40.0 { 1.0 } else { 1.02 } + e),
        ),
        (
            "toward-zero",
            "whole 1 A toward zero",
            Box::new(|_, i, e| (i + e).trunc()),
        ),
        (
            "speed-limit",
            "no more than 40.0 A a second",
            Box::new(|row, _, e| slow[row] + e),
        ),
        (
            "second-order",
            // 3/(2π).
            "a filter of second order, 0.47",
            Box::new(|row, _, e| rings[row] + e),
        ),
    ];
    for (id, words, reads) in cases {
        let form = of(&problem(7, reads)).unwrap_or_else(|| panic!("{id}: none"));
        assert_eq!(form.id, id, "{form:?}");
        assert!(form.said().contains(words), "{words}: {form:?}");
        // What is cut to whole steps leaves that it is.
        let most = if id == "toward-zero" { 0.3 } else { 0.105 };
        let least = 0.95 * NOISE_A;
        // Readings beside 60 A are on the other side by their noise.
        let is_near = form.rmse < most || id == "step-over" && form.rmse < 12.0;
        assert!(form.rmse > least && is_near, "{form:?}");
    }
}

/// A part of the field creeps after the current with the square root of time, which no two times do.
#[test]
fn a_memory_is_told_by_its_answer_to_a_step() {
    const PARTS: [f64; 4] = [0.3, 1.2, 5.0, 20.0];
    let mut slow = [current_a()[0]; PARTS.len()];
    let reading = followed(|i| {
        let slow = slow.iter_mut().zip(PARTS).map(|(slow, tau_s)| {
            *slow += (i - *slow) * (1.0 - (-STEP_S / tau_s).exp());
            *slow
        });
        0.9 * i + 0.1 * slow.sum::<f64>() / PARTS.len() as f64
    });
    let form = of(&problem(7, |row, _, e| reading[row] + e)).unwrap();
    assert_eq!(form.id, "memory", "{form:?}");
    let figures: Vec<f64> = form
        .description
        .split(" % ")
        .filter_map(|part| part.rsplit(' ').next()?.parse().ok())
        .collect();
    let answer = |t_s: f64| {
        let slow = PARTS.map(|tau_s| 1.0 - (-t_s / tau_s).exp());
        100.0 * (0.9 + 0.1 * slow.iter().sum::<f64>() / PARTS.len() as f64)
    };
    assert_eq!(figures.len(), 3, "{form:?}");
    for (told, at_s) in figures.iter().zip([0.0, 1.0, 10.0]) {
        // The rows' values hold, and are taken to go in straight lines.
        let is_s = at_s + 0.5 * STEP_S;
        assert!((told - answer(is_s)).abs() < 0.2, "{at_s} s: {form:?}");
    }
}

#[test]
fn a_curve_of_the_current_is_told_by_what_it_is_at_some() {
    let off_a = |i: f64| 0.4 + 0.7 * (i / 30.0).sin();
    let form = of(&problem(7, |_, i, e| i + off_a(i) + e)).unwrap();
    assert_eq!(form.id, "curve", "{form:?}");
    assert!(form.rmse < 1.2 * NOISE_A, "{form:?}");
    let told = form
        .description
        .strip_prefix("a curve of i alone: ")
        .unwrap();
    let mut places = 0;
    for pair in told.split(", ") {
        let figures = pair
            .split(' ')
            .filter_map(|word| word.replace('−', "-").parse().ok());
        let figures: Vec<f64> = figures.collect();
        let [value, at] = figures[..] else {
            panic!("{pair}");
        };
        // At the ends there are a few rows.
        let most = if at.abs() > 100.0 { 0.4 } else { 0.1 };
        assert!((value - off_a(at)).abs() < most, "{pair}: {}", off_a(at));
        places += 1;
    }
    assert_eq!(places, 7, "{form:?}");
}

#[test]
fn what_follows_another_quantity_is_told_by_its_column() {
    let supply_v: Vec<f64> = (0..ROWS)
        .map(|row| 5.0 + 0.2 * (t_s(row) / 90.0).sin())
        .collect();
    let mut beside = problem(7, |row, i, e| i + 4.0 * (supply_v[row] - 5.0) + e);
    beside.drive.supply_v = Some(supply_v.into());
    let form = of(&beside).unwrap();
    assert_eq!(form.id, "follows", "{form:?}");
    assert!(form.description.starts_with("+4.0"), "{form:?}");
    assert!(
        form.description.ends_with(" A per V of v_supply_v"),
        "{form:?}"
    );
}

#[test]
fn a_resistance_for_charging_is_told_in_ohms() {
    let mut battery = problem(7, |_, i, e| {
        3.7 + 0.01 * e - 0.002 * i - if i < 0.0 { 0.0005 * i } else { 0.0 }
    });
    battery.view = View::Voltage;
    battery.noise = 0.01 * NOISE_A;
    let bench = Workbench::new(&battery, &[]);
    let residual: Vec<f64> = (0..bench.len())
        .map(|row| bench.y[row] - 3.7 + 0.002 * bench.reference[row])
        .collect();
    let form = form(&bench, &residual, battery.noise).unwrap();
    assert_eq!(form.id, "direction", "{form:?}");
    assert!(
        form.description.ends_with("+0.000500 Ω where i < 0"),
        "{form:?}"
    );
}

#[test]
fn what_has_no_simple_form_has_none() {
    for seed in 2..12 {
        let walk = std::cell::RefCell::new((drawn(100 + seed), 0.0));
        let walks = problem(seed, |_, i, e| {
            let (drawn, at) = &mut *walk.borrow_mut();
            *at += 0.05 * drawn();
            i + *at + e
        });
        // A walk that happens to be a step or a line nearly all of the time is told as one.
        if let Some(form) = of(&walks) {
            let left = form.rmse.powi(2) - NOISE_A.powi(2);
            let bench = Workbench::new(&walks, &[]);
            let residual = bench.residual(&bench.plain);
            let all = residual.iter().map(|r| r * r).sum::<f64>() / ROWS as f64 - NOISE_A.powi(2);
            assert!(left < 0.06 * all, "{seed}: {form:?}");
        }
        assert_eq!(of(&problem(seed, |_, i, e| i + e)), None, "noise alone");
        let line = problem(seed, |_, i, e| 1.02 * i + 0.5 + e);
        assert_eq!(of(&line), None, "the library has it");
        let both = problem(seed, |row, i, e| {
            i + 5e-4 * i * i + if row < 2500 { 0.0 } else { 3.0 } + e
        });
        assert_eq!(of(&both), None, "two forms at once");
        let sparks = problem(seed, |row, i, e| {
            i + e
                + if row % 100 < 3 {
                    20.0 * (row as f64).sin()
                } else {
                    0.0
                }
        });
        assert_eq!(of(&sparks), None, "sparks");
    }
}
