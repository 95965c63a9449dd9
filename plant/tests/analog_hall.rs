//! Core and sensor against their definitions and against what a hysteresis operator has to do.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use plant::hall::{HallSensor, HallSensorConfig, HallState, SensorInput, Transfer};
use plant::magnetic_core::{MagneticCore, MagneticCoreConfig, MagneticCoreState};
use plant::network::{Network, NetworkConfig};
use plant::supply::{Divider, SupplyProfile};
use proptest::prelude::*;

const FULL_A: f64 = 500.0;

fn close(a: f64, b: f64, within: f64) {
    assert!((a - b).abs() <= within, "{a} is not {b} within {within}");
}

fn core(remanence_a: f64, coercivity_a: f64) -> MagneticCore {
    let config = MagneticCoreConfig {
        remanence_a,
        coercivity_a,
        ..MagneticCoreConfig::default()
    };
    MagneticCore::new(&config, FULL_A)
}

fn led(core: &MagneticCore, mut state: MagneticCoreState, path: &[f64]) -> MagneticCoreState {
    for current_a in path {
        state = core.magnetise(&state, *current_a);
    }
    state
}

fn input(current_a: f64) -> SensorInput {
    SensorInput {
        current_a,
        aux_current_a: 0.0,
        temperature_c: 25.0,
        supply_v: 5.0,
    }
}

/// The output after `conditions` have been there for long.
fn output_v(config: HallSensorConfig, conditions: SensorInput) -> f64 {
    HallSensor::new(config).settled(&conditions).output_v()
}

#[test]
fn full_swing_and_back_leaves_the_remanence() {
    // HAH1BV family: ±7.5 mV of magnetic offset at 4 mV/A.
    for (remanence_a, coercivity_a) in [(1.875, 60.0), (0.5, 160.0), (1.0, 300.0)] {
        let core = core(remanence_a, coercivity_a);
        for sign in [1.0, -1.0] {
            let state = led(&core, MagneticCoreState::default(), &[sign * FULL_A, 0.0]);
            close(core.reading_a(&state), sign * remanence_a, 1e-12);
        }
    }
    // Where full range turns the core right round, its history before does not matter.
    let core = core(1.875, 60.0);
    let before = led(&core, MagneticCoreState::default(), &[-FULL_A, 33.0, -70.0]);
    close(
        core.reading_a(&led(&core, before, &[FULL_A, 0.0])),
        1.875,
        1e-12,
    );
}

#[test]
fn the_coercive_current_to_the_other_side_takes_it_away() {
    let core = core(1.5, 50.0);
    let remanent = led(&core, MagneticCoreState::default(), &[FULL_A, 0.0]);
    close(
        core.reading_a(&led(&core, remanent, &[-50.0, 0.0])),
        0.0,
        1e-12,
    );
    // Less leaves some of it, more turns it round.
    assert!(core.reading_a(&led(&core, remanent, &[-40.0, 0.0])) > 0.1);
    assert!(core.reading_a(&led(&core, remanent, &[-60.0, 0.0])) < -0.1);
}

#[test]
fn branches_have_opposite_sign_and_do_not_fade() {
    let core = core(1.0, 40.0);
    let up = led(&core, MagneticCoreState::default(), &[-FULL_A, 100.0]);
    let down = led(&core, MagneticCoreState::default(), &[FULL_A, 100.0]);
    close(core.zero_error_a(&up), -1.0, 1e-12);
    close(core.zero_error_a(&down), 1.0, 1e-12);
    // Time is no input: the same current again and again changes nothing.
    assert_eq!(led(&core, down, &[100.0; 50]), down);
}

#[test]
fn saturation_leaves_the_line_without_a_bend() {
    let core = MagneticCore::new(
        &MagneticCoreConfig {
            knee_a: 400.0,
            softness: 0.5,
            ..MagneticCoreConfig::default()
        },
        FULL_A,
    );
    assert_eq!(core.saturated_a(399.9), 399.9);
    assert_eq!(core.saturated_a(-400.0), -400.0);
    // 200 A beyond the knee with a span of 200 A: a half of it.
    close(core.saturated_a(600.0), 500.0, 1e-12);
    close(core.saturated_a(-600.0), -500.0, 1e-12);
    close((core.saturated_a(400.001) - 400.0) / 0.001, 1.0, 1e-4);
    close(core.saturated_a(1e9), 600.0, 1e-3);
    let hard = MagneticCore::new(
        &MagneticCoreConfig {
            knee_a: 400.0,
            softness: 0.0,
            ..MagneticCoreConfig::default()
        },
        FULL_A,
    );
    assert_eq!(hard.saturated_a(1e3), 400.0);
    assert_eq!(core_without_knee().saturated_a(1e6), 1e6);
}

fn core_without_knee() -> MagneticCore {
    MagneticCore::new(&MagneticCoreConfig::default(), FULL_A)
}

#[test]
fn d0_and_d2_numbers() {
    let small = HallSensorConfig::dual_range_small();
    close(output_v(small, input(0.0)), 2.5, 0.0);
    close(output_v(small, input(55.0)), 4.5625, 1e-12);
    close(output_v(small, input(160.0 / 3.0)), 4.5, 1e-12);
    close(output_v(small, input(-160.0 / 3.0)), 0.5, 1e-12);
    close(output_v(small, input(61.0)), 4.75, 1e-12);
    close(output_v(small, input(-1e4)), 0.25, 1e-12);
    let hah1bv = HallSensorConfig::hah1bv();
    close(
        output_v(hah1bv, input(1.0)) - output_v(hah1bv, input(0.0)),
        0.004,
        1e-12,
    );
    close(output_v(hah1bv, input(-500.0)), 0.5, 1e-12);
}

#[test]
fn ratiometric_output_by_lem_s_definition() {
    // V = Vc/5 · (G·I + 2.5)
    for supply_v in [4.5, 5.05, 5.5] {
        let volts = output_v(
            HallSensorConfig::hah1bv(),
            SensorInput {
                supply_v,
                ..input(300.0)
            },
        );
        close(volts, supply_v / 5.0 * (0.004 * 300.0 + 2.5), 1e-12);
    }
    let mut fixed = HallSensorConfig::hah1bv();
    if let Transfer::Line { ratio, .. } = &mut fixed.transfer {
        *ratio = 0.0;
    }
    close(
        output_v(
            fixed,
            SensorInput {
                supply_v: 4.5,
                ..input(300.0)
            },
        ),
        3.7,
        1e-12,
    );
    // Without a supply there is no output.
    assert_eq!(
        output_v(
            fixed,
            SensorInput {
                supply_v: 0.0,
                ..input(300.0)
            }
        ),
        0.0
    );
}

#[test]
fn zero_and_sensitivity_drift_from_25_c() {
    let mut sensor = HallSensorConfig::hah1bv();
    // HAH1BV family: 0.08 mV/K of zero, that is 20 mA/K, and 0.03 %/K of sensitivity.
    sensor.tc_a_per_k = 0.02;
    sensor.tc_per_k = 3e-4;
    let at = |temperature_c, amps| {
        output_v(
            sensor,
            SensorInput {
                temperature_c,
                ..input(amps)
            },
        )
    };
    close(at(25.0, 200.0), 3.3, 1e-12);
    close(at(85.0, 0.0), 2.5 + 60.0 * 0.08e-3, 1e-12);
    close(at(85.0, 200.0), 2.5 + 0.004 * (200.0 * 1.018 + 1.2), 1e-12);
    sensor.offset_a = -3.0;
    sensor.gain = 1.01;
    close(
        output_v(sensor, input(100.0)),
        2.5 + 0.004 * (101.0 - 3.0),
        1e-12,
    );
}

#[test]
fn the_neighbour_couples_in() {
    let mut sensor = HallSensorConfig::dual_range_small();
    sensor.coupling = 0.02;
    let volts = output_v(
        sensor,
        SensorInput {
            aux_current_a: -100.0,
            ..input(10.0)
        },
    );
    close(volts, 2.5 + 8.0 * 0.0375, 1e-12);
}

#[test]
fn self_heating_follows_the_low_passed_square() {
    let mut config = HallSensorConfig::hah1bv();
    config.self_heating.tc_per_a2 = 1e-7;
    config.self_heating.tau_s = 100.0;
    let mut sensor = HallSensor::new(config);
    let mut state = sensor.settled(&input(0.0));
    state = sensor.step(0.0, &state, &input(200.0)).0;
    for _ in 0..500 {
        state = sensor.step(0.1, &state, &input(200.0)).0;
    }
    let heat_a2 = 200.0_f64.powi(2) * (1.0 - (-0.5_f64).exp());
    close(state.output_v(), 2.5 + 0.8 * (1.0 + 1e-7 * heat_a2), 1e-9);
}

#[test]
fn the_lag_is_of_first_order() {
    let mut config = HallSensorConfig::hah1bv();
    // 90 % after 5 ms.
    config.tau_s = 5e-3 / 10.0_f64.ln();
    let mut sensor = HallSensor::new(config);
    let mut state: HallState = sensor.settled(&input(0.0));
    state = sensor.step(0.0, &state, &input(100.0)).0;
    close(state.output_v(), 2.5, 0.0);
    for _ in 0..100 {
        state = sensor.step(50e-6, &state, &input(100.0)).0;
    }
    close(state.output_v(), 2.5 + 0.9 * 0.4, 1e-12);
}

#[test]
fn network_from_its_resistors() {
    let config = NetworkConfig::default();
    let network = Network::new(&config, 0.0);
    close(
        network.settled_v(1.0) - network.settled_v(0.0),
        0.225,
        1e-12,
    );
    close(network.zero_v(), 1.65, 1e-12);
    // ±15 V at the input is held by the diodes.
    assert_eq!(network.settled_v(15.0), 3.3);
    assert_eq!(network.settled_v(-15.0), 0.0);
    let (factor, offset_v) = network.load(f64::INFINITY);
    assert_eq!(factor, 0.0);
    close(offset_v, -6.675, 1e-12);
    assert_eq!(network.load(0.0), (1.0, 0.0));
}

#[test]
fn supplies_and_divider() {
    let dropout = SupplyProfile::dropout(5.0, 0.0, 1.0, 1.1, 0.01);
    for (at_s, volts) in [
        (0.0, 5.0),
        (1.0, 5.0),
        (1.005, 2.5),
        (1.05, 0.0),
        (1.095, 2.5),
        (2.0, 5.0),
    ] {
        close(dropout.at(at_s), volts, 1e-9);
    }
    let ramp = SupplyProfile::ramp(4.5, 5.5, 0.0, 10.0);
    close(ramp.at(-1.0), 4.5, 0.0);
    close(ramp.at(2.5), 4.75, 1e-12);
    close(ramp.at(11.0), 5.5, 0.0);
    close(SupplyProfile::default().at(3.0), 5.0, 0.0);
    assert!(SupplyProfile::from_points(Vec::new()).is_none());
    close(Divider::default().output_v(5.0), 2.5, 0.0);
}

fn any_current() -> impl Strategy<Value = f64> {
    -FULL_A..FULL_A
}

proptest! {
    /// Return-point memory: whatever happens between two visits of an extreme, without going beyond it or the one
    /// before, is forgotten.
    #[test]
    fn a_minor_loop_leaves_no_trace(
        before in prop::collection::vec(any_current(), 0..10), low in -400.0..0.0_f64, high in 1.0..400.0_f64,
        inside in prop::collection::vec(0.0..1.0_f64, 1..20)
    ) {
        let core = core(1.2, 70.0);
        let start = led(&core, MagneticCoreState::default(), &before);
        // Out to `high`, in to `low`, and then within the two.
        let outer = led(&core, start, &[high, low]);
        let minor: Vec<f64> = inside.iter().map(|share| low + (high - low) * share).collect();
        let again = led(&core, led(&core, outer, &minor), &[low]);
        prop_assert!((core.zero_error_a(&again) - core.zero_error_a(&outer)).abs() < 1e-9);
        let direct = led(&core, outer, &[high]);
        let detour = led(&core, led(&core, outer, &minor), &[high]);
        prop_assert!((core.zero_error_a(&direct) - core.zero_error_a(&detour)).abs() < 1e-9);
    }

    #[test]
    fn loops_close(
        before in prop::collection::vec(any_current(), 0..10), low in any_current(), high in any_current()
    ) {
        let core = core(0.8, 90.0);
        let once = led(&core, MagneticCoreState::default(), &before);
        let once = led(&core, once, &[low, high]);
        let twice = led(&core, once, &[low, high]);
        prop_assert!((core.reading_a(&once) - core.reading_a(&twice)).abs() < 1e-9);
    }

    #[test]
    fn only_the_turning_points_matter(path in prop::collection::vec(any_current(), 1..10), pieces in 2..20_u32) {
        let core = core(0.8, 90.0);
        let fine: Vec<f64> = std::iter::once(0.0)
            .chain(path.iter().copied())
            .collect::<Vec<f64>>()
            .windows(2)
            .flat_map(|pair| {
                let (a, b) = (pair[0], pair[1]);
                (1..=pieces).map(move |k| a + (b - a) * f64::from(k) / f64::from(pieces))
            })
            .collect();
        let coarse = led(&core, MagneticCoreState::default(), &path);
        let fine = led(&core, MagneticCoreState::default(), &fine);
        prop_assert!((core.reading_a(&coarse) - core.reading_a(&fine)).abs() < 1e-9);
    }

    #[test]
    fn the_error_is_bounded_and_the_reading_rises(path in prop::collection::vec(any_current(), 1..20), more in 0.0..100.0_f64) {
        let core = core(1.2, 70.0);
        let state = led(&core, MagneticCoreState::default(), &path);
        prop_assert!(core.zero_error_a(&state).abs() <= 1.2 + 1e-9);
        let last = path[path.len() - 1];
        let risen = core.magnetise(&state, last + more);
        prop_assert!(core.reading_a(&risen) >= core.reading_a(&state) - 1e-12);
    }

    #[test]
    fn saturation_is_odd_and_rising(knee_a in 1.0..500.0_f64, softness in 0.0..3.0_f64, a in -2e3..2e3_f64, more in 0.0..100.0_f64) {
        let core = MagneticCore::new(
            &MagneticCoreConfig { knee_a, softness, ..MagneticCoreConfig::default() }, FULL_A
        );
        prop_assert_eq!(core.saturated_a(a), -core.saturated_a(-a));
        prop_assert!(core.saturated_a(a + more) >= core.saturated_a(a) - 1e-12);
        prop_assert!(core.saturated_a(a).abs() <= a.abs());
    }
}
