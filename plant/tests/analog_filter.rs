//! The filters against analytic solutions and a fine-step reference.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::f64::consts::{SQRT_2, TAU};

use plant::filter::{FirstOrder, LowPass, LowPassConfig, LowPassState, SecondOrder};
use plant::stretch::Linear;
use proptest::prelude::*;

fn close(a: f64, b: f64, within: f64) {
    assert!((a - b).abs() <= within, "{a} is not {b} within {within}");
}

/// Fourth-order Runge–Kutta on the circuit's own equations: y₁'' = ω²(u − y₁) − ω/Q·y₁', τ·y₂' = y₁ − y₂. Output and
/// its integral at the end.
fn reference(config: &LowPassConfig, state: LowPassState, dt_s: f64, u: Linear) -> (f64, f64) {
    let SecondOrder { f0_hz, q } = config.second_order.unwrap();
    let (omega, tau_s) = (TAU * f0_hz, config.rc_tau_s);
    let slope = |t: f64, x: [f64; 4]| {
        let input = u.at(t / dt_s);
        let out = if tau_s > 0.0 { x[2] } else { x[0] };
        [
            x[1],
            omega * omega * (input - x[0]) - omega / q * x[1],
            if tau_s > 0.0 {
                (x[0] - x[2]) / tau_s
            } else {
                0.0
            },
            out,
        ]
    };
    let mut x = [state[0], state[1] * omega, state[2], 0.0];
    let fastest = (omega * (1.0 + 1.0 / q)).max(if tau_s > 0.0 { 1.0 / tau_s } else { 0.0 });
    let n = ((dt_s * fastest * 100.0).ceil() as u32).max(50);
    let h = dt_s / f64::from(n);
    for k in 0..n {
        let t = h * f64::from(k);
        let add = |x: [f64; 4], k: [f64; 4], h: f64| std::array::from_fn(|i| x[i] + h * k[i]);
        let k1 = slope(t, x);
        let k2 = slope(t + 0.5 * h, add(x, k1, 0.5 * h));
        let k3 = slope(t + 0.5 * h, add(x, k2, 0.5 * h));
        let k4 = slope(t + h, add(x, k3, h));
        x = std::array::from_fn(|i| x[i] + h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]));
    }
    (if tau_s > 0.0 { x[2] } else { x[0] }, x[3])
}

#[test]
fn sallen_key_by_its_parts() {
    // Equal resistors and C1 = 2·C2 are Butterworth at 1 / (2π·R·√2·C2).
    let filter = SecondOrder::sallen_key(10e3, 10e3, 20e-9, 10e-9);
    close(filter.q, 1.0 / SQRT_2, 1e-12);
    close(filter.f0_hz, 1.0 / (TAU * 10e3 * SQRT_2 * 10e-9), 1e-6);
}

#[test]
fn first_order_follows_a_step_and_a_ramp() {
    let tau_s = 0.5e-3;
    for steps in [1, 7, 100] {
        let (mut rc, mut y) = (FirstOrder::new(tau_s), 1.0);
        let mut integral = 0.0;
        let dt_s = 2e-3 / f64::from(steps);
        for _ in 0..steps {
            let (end, line) = rc.step(dt_s, y, Linear::constant(4.0));
            (y, integral) = (end, integral + line.mean() * dt_s);
        }
        close(y, 4.0 - 3.0 * (-4.0_f64).exp(), 1e-12);
        // ∫ = 4·T − 3·τ·(1 − e^(−T/τ))
        close(
            integral,
            8e-3 - 3.0 * tau_s * (1.0 - (-4.0_f64).exp()),
            1e-15,
        );
    }
    // A ramp of 100 V/s comes out τ late.
    let (mut rc, mut y) = (FirstOrder::new(tau_s), 0.0);
    for k in 0..100 {
        let u = Linear {
            start: f64::from(k),
            end: f64::from(k + 1),
        };
        y = rc.step(0.01, y, u).0;
    }
    close(y, 100.0 - 100.0 * tau_s, 1e-9);
    assert_eq!(
        FirstOrder::new(0.0)
            .step(
                1.0,
                5.0,
                Linear {
                    start: 1.0,
                    end: 2.0
                }
            )
            .0,
        2.0
    );
}

#[test]
fn butterworth_is_3_db_down_at_its_corner() {
    let config = LowPassConfig {
        second_order: Some(SecondOrder {
            f0_hz: 1e3,
            q: 1.0 / SQRT_2,
        }),
        rc_tau_s: 0.0,
    };
    let mut filter = LowPass::new(&config);
    let mut state = LowPass::settled(0.0);
    // A sine in straight lines of 1 µs; the last of twenty periods.
    let mut peak = 0.0_f64;
    let u = |k: i32| (TAU * 1e-3 * f64::from(k)).sin();
    for k in 0..20_000 {
        state = filter
            .step(
                1e-6,
                &state,
                Linear {
                    start: u(k),
                    end: u(k + 1),
                },
            )
            .0;
        if k >= 19_000 {
            peak = peak.max(filter.output(&state).abs());
        }
    }
    close(peak, 1.0 / SQRT_2, 1e-4);
}

#[test]
fn coinciding_poles_are_no_special_case() {
    // Q = ½ is a double pole at ω₀, the RC a third one: step response 1 − e^(−x)·(1 + x + x²/2).
    let f0_hz = 500.0;
    let config = LowPassConfig {
        second_order: Some(SecondOrder { f0_hz, q: 0.5 }),
        rc_tau_s: 1.0 / (TAU * f0_hz),
    };
    for x in [1e-3_f64, 0.1, 1.0, 5.0, 30.0] {
        let mut filter = LowPass::new(&config);
        let dt_s = x / (TAU * f0_hz);
        let (state, _) = filter.step(dt_s, &LowPass::settled(0.0), Linear::constant(1.0));
        let expected = 1.0 - (-x).exp() * (1.0 + x + 0.5 * x * x);
        close(filter.output(&state), expected, 1e-13);
    }
}

#[test]
fn nominal_is_a_wire() {
    let mut filter = LowPass::new(&LowPassConfig::default());
    let u = Linear {
        start: 1.0,
        end: 3.0,
    };
    assert!(!filter.is_on());
    let (state, line) = filter.step(1e-3, &LowPass::settled(0.0), u);
    assert_eq!((filter.output(&state), line), (3.0, u));
    assert_eq!(filter.delay_s(), 0.0);
}

#[test]
fn a_jump_within_a_picosecond_does_not_shake_the_filter() {
    let config = LowPassConfig {
        second_order: Some(SecondOrder {
            f0_hz: 100.0,
            q: 0.7,
        }),
        rc_tau_s: 1e-3,
    };
    let mut filter = LowPass::new(&config);
    let u = Linear {
        start: 0.0,
        end: 5.0,
    };
    let (state, line) = filter.step(1e-12, &LowPass::settled(0.0), u);
    assert!(filter.output(&state).abs() < 1e-9 && line.mean().abs() < 1e-9);
    let (state, _) = filter.step(1.0, &state, Linear::constant(5.0));
    close(filter.output(&state), 5.0, 1e-12);
}

fn any_filter() -> impl Strategy<Value = LowPassConfig> {
    (
        10.0..10e3_f64,
        0.3..3.0_f64,
        prop_oneof![Just(0.0), 1e-5..5e-3_f64],
    )
        .prop_map(|(f0_hz, q, rc_tau_s)| LowPassConfig {
            second_order: Some(SecondOrder { f0_hz, q }),
            rc_tau_s,
        })
}

proptest! {
    #[test]
    fn agrees_with_a_fine_step_reference(
        config in any_filter(), state in prop::array::uniform3(-5.0..5.0_f64),
        start in -5.0..5.0_f64, end in -5.0..5.0_f64, x in 0.001..20.0_f64
    ) {
        let u = Linear { start, end };
        let dt_s = x / (TAU * config.second_order.unwrap().f0_hz);
        let mut filter = LowPass::new(&config);
        let (new, line) = filter.step(dt_s, &state, u);
        let (output, integral) = reference(&config, state, dt_s, u);
        prop_assert!((filter.output(&new) - output).abs() < 1e-7, "{} {}", filter.output(&new), output);
        prop_assert!((line.end - output).abs() < 1e-7);
        prop_assert!((line.mean() - integral / dt_s).abs() < 1e-6, "{} {}", line.mean(), integral / dt_s);
    }

    #[test]
    fn a_step_in_pieces_is_the_step(
        config in any_filter(), state in prop::array::uniform3(-5.0..5.0_f64),
        start in -5.0..5.0_f64, end in -5.0..5.0_f64, dt_s in 1e-6..0.2_f64,
        cuts in prop::collection::vec(0.0..1.0_f64, 1..10)
    ) {
        let u = Linear { start, end };
        let mut filter = LowPass::new(&config);
        let (whole, line) = filter.step(dt_s, &state, u);
        let mut at: Vec<f64> = cuts.into_iter().chain([0.0, 1.0]).collect();
        at.sort_by(f64::total_cmp);
        let (mut pieces, mut integral) = (state, 0.0);
        for pair in at.windows(2) {
            let piece_s = (pair[1] - pair[0]) * dt_s;
            let (new, line) = filter.step(piece_s, &pieces, u.part(pair[0], pair[1]));
            pieces = new;
            integral += line.mean() * piece_s;
        }
        for (a, b) in whole.iter().zip(pieces) {
            prop_assert!((a - b).abs() < 1e-6, "{:?} {:?}", whole, pieces);
        }
        prop_assert!((integral / dt_s - line.mean()).abs() < 1e-6);
    }
}
