//! The battery against analytic solutions, energy and a recording.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use plant::battery::{Battery, BatteryConfig, RcBranch};
use proptest::prelude::*;

fn close(a: f64, b: f64, within: f64) {
    assert!((a - b).abs() <= within, "{a} is not {b} within {within}");
}

/// Flat open-circuit voltage: what moves is the effect.
fn flat() -> BatteryConfig {
    BatteryConfig {
        ocv: vec![(0.0, 3.7), (1.0, 3.7)],
        ..BatteryConfig::default()
    }
}

#[test]
fn default_is_open_circuit_voltage_and_resistance() {
    let mut battery = Battery::new(BatteryConfig::default(), 0.5, 10.0);
    close(battery.output().terminal_v, 3.6853, 1e-12);
    let output = battery.step(0.0, 2.0, 10.0);
    close(output.cell_v, 3.6853 - 2.0 * 18.6e-3, 1e-12);
    assert_eq!(output.temperature_c, 10.0);
    // 2 A for an hour: 2 Ah of 2.9973 Ah.
    let output = battery.step(3_600.0, 2.0, 10.0);
    close(output.soc, 0.5 - 2.0 / 2.9973, 1e-12);
    // Beyond its ends the table goes on.
    let below_v = BatteryConfig::default().open_circuit_v(-0.005);
    close(below_v, 2.7131 - (2.9245 - 2.7131), 1e-9);
}

#[test]
fn rc_branches_follow_their_exponentials() {
    let mut battery = Battery::new(
        BatteryConfig {
            r_ohm: 1e-3,
            polarisation: [
                RcBranch {
                    r_ohm: 2e-3,
                    tau_s: 5.0,
                },
                RcBranch {
                    r_ohm: 3e-3,
                    tau_s: 60.0,
                },
                RcBranch::default(),
            ],
            ..flat()
        },
        0.9,
        25.0,
    );
    battery.step(0.0, 10.0, 25.0);
    for step in 1..=200 {
        let t = 0.5 * f64::from(step);
        let output = battery.step(0.5, 10.0, 25.0);
        let expected_v = 3.7
            - 10.0 * (1e-3 + 2e-3 * (1.0 - (-t / 5.0).exp()) + 3e-3 * (1.0 - (-t / 60.0).exp()));
        close(output.cell_v, expected_v, 1e-12);
    }
    let loaded_v = battery.output().cell_v;
    // The ohmic part goes at once.
    close(
        battery.step(0.0, 0.0, 25.0).cell_v,
        loaded_v + 10.0 * 1e-3,
        1e-12,
    );
}

#[test]
fn diffusion_has_its_dc_resistance_and_its_square_root_of_time() {
    let (r_ohm, tau_s) = (20e-3, 1_000.0);
    let new = || {
        let mut battery = Battery::new(
            BatteryConfig {
                r_ohm: 0.0,
                diffusion: RcBranch { r_ohm, tau_s },
                capacity_ah: 1e6,
                ..flat()
            },
            0.5,
            25.0,
        );
        battery.step(0.0, 1.0, 25.0);
        battery
    };
    close(
        3.7 - new().step(20.0 * tau_s, 1.0, 25.0).cell_v,
        r_ohm,
        1e-9,
    );
    // Far from the end, v = R·2·√(t/(π·τ)); what eight terms leave out acts at once.
    let left_ohm = 3.7 - new().output().cell_v;
    assert!(left_ohm > 0.0 && left_ohm < 0.03 * r_ohm);
    for share in [0.02, 0.05, 0.1] {
        let lost_v = 3.7 - new().step(share * tau_s, 1.0, 25.0).cell_v;
        let expected_v = r_ohm * 2.0 * (share / std::f64::consts::PI).sqrt();
        close(lost_v / expected_v, 1.0, 0.01);
    }
}

#[test]
fn arrhenius_and_low_charge_raise_every_resistance() {
    let ohmic_v = |soc: f64, temperature_c: f64| {
        let mut battery = Battery::new(
            BatteryConfig {
                r_ohm: 0.1,
                b_k: 3_000.0,
                rise: 2.0,
                knee_soc: 0.4,
                ..flat()
            },
            soc,
            temperature_c,
        );
        3.7 - battery.step(0.0, 1.0, temperature_c).cell_v
    };
    close(ohmic_v(0.5, 25.0), 0.1, 1e-12);
    close(
        ohmic_v(0.5, 0.0),
        0.1 * (3_000.0 * (1.0 / 273.15 - 1.0 / 298.15_f64)).exp(),
        1e-12,
    );
    close(ohmic_v(0.1, 25.0), 0.1 * 2.5, 1e-12);
    close(ohmic_v(-0.1, 25.0), 0.1 * 3.0, 1e-12);
}

#[test]
fn heat_warms_to_rth_times_loss() {
    let mut battery = Battery::new(
        BatteryConfig {
            r_ohm: 50e-3,
            rth_k_per_w: 4.0,
            thermal_tau_s: 300.0,
            capacity_ah: 1e6,
            ..flat()
        },
        0.5,
        20.0,
    );
    battery.step(0.0, 4.0, 20.0);
    for step in 1..=100 {
        let output = battery.step(10.0, 4.0, 20.0);
        let expected_c = 20.0 + 4.0 * 0.8 * (1.0 - (-f64::from(step) * 10.0 / 300.0).exp());
        close(output.temperature_c, expected_c, 1e-9);
        close(output.heat_w, 0.8, 1e-12);
    }
}

#[test]
fn entropic_heat_has_bernardi_s_sign() {
    // dU/dT > 0: the cell cools itself in discharge and warms in charge, i·T·dU/dT.
    let heat_w = |amps: f64| {
        let mut battery = Battery::new(
            BatteryConfig {
                r_ohm: 0.0,
                v_per_k: 1e-4,
                ..flat()
            },
            0.5,
            35.0,
        );
        close(battery.output().cell_v, 3.701, 1e-12);
        battery.step(0.0, amps, 35.0).heat_w
    };
    close(heat_w(2.0), -2.0 * 308.15 * 1e-4, 1e-12);
    close(heat_w(-2.0), 2.0 * 308.15 * 1e-4, 1e-12);
}

#[test]
fn hysteresis_stays_at_rest_and_turns_with_throughput() {
    let mut battery = Battery::new(
        BatteryConfig {
            r_ohm: 0.0,
            m_v: 10e-3,
            gamma: 40.0,
            capacity_ah: 1.0,
            ..flat()
        },
        0.5,
        25.0,
    );
    battery.step(0.0, 1.0, 25.0);
    // 0.1 of the capacity: 1 − e⁻⁴ of the way to −10 mV.
    let output = battery.step(360.0, 1.0, 25.0);
    close(output.cell_v, 3.7 - 10e-3 * (1.0 - (-4.0_f64).exp()), 1e-12);
    battery.step(0.0, 0.0, 25.0);
    assert_eq!(battery.step(1e6, 0.0, 25.0).cell_v, output.cell_v);
    battery.step(0.0, -1.0, 25.0);
    close(battery.step(1_800.0, -1.0, 25.0).cell_v, 3.71, 1e-9);
}

#[test]
fn series_and_parallel() {
    let config = BatteryConfig {
        series: 96.0,
        parallel: 80.0,
        ..BatteryConfig::panasonic_18650pf()
    };
    let mut pack = Battery::new(config, 0.8, 25.0);
    let mut cell = Battery::new(BatteryConfig::panasonic_18650pf(), 0.8, 25.0);
    for _ in 0..100 {
        let (of_pack, of_cell) = (pack.step(1.0, 160.0, 25.0), cell.step(1.0, 2.0, 25.0));
        close(of_pack.terminal_v, 96.0 * of_cell.terminal_v, 1e-9);
        assert_eq!(of_pack.soc, of_cell.soc);
    }
}

/// The recorded US06 at 25 °C. The parameters were fitted to it, so this guards model and parameters as a pair.
#[test]
fn panasonic_cell_follows_its_recording() {
    let path = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../recordings/panasonic-18650pf/25c-us06.csv"
    );
    let text = std::fs::read_to_string(path).unwrap();
    let mut lines = text.lines();
    assert_eq!(
        lines.next(),
        Some("t_s,i_ref_a,v_cell_v,temp_cell_c,temp_ambient_c,ah_meas_ah")
    );
    let mut battery = Battery::new(BatteryConfig::panasonic_18650pf(), 1.0, 25.5);
    let (mut last_s, mut rows) = (0.0, 0.0);
    let (mut squares_v2, mut squares_k2) = (0.0, 0.0);
    for line in lines {
        let row: Vec<f64> = line
            .split(',')
            .map(|field| field.parse().unwrap())
            .collect();
        let output = battery.step(row[0] - last_s, row[1], 25.5);
        last_s = row[0];
        squares_v2 += (output.cell_v - row[2]).powi(2);
        squares_k2 += (output.temperature_c - row[3]).powi(2);
        rows += 1.0;
        close(output.soc, 1.0 - row[5] / 2.9973, 0.003);
    }
    assert!(rows > 48_000.0);
    let (rms_v, rms_k) = (f64::sqrt(squares_v2 / rows), f64::sqrt(squares_k2 / rows));
    println!("{:.1} mV rms, {rms_k:.2} K rms", 1e3 * rms_v);
    assert!(rms_v < 0.02, "{rms_v}");
    assert!(rms_k < 0.6, "{rms_k}");
}

proptest! {
    #[test]
    fn charge_is_counted_exactly(rows in prop::collection::vec((1e-3..100.0_f64, -20.0..20.0_f64), 1..50)) {
        let config = BatteryConfig { coulombic_efficiency: 0.98, ..BatteryConfig::panasonic_18650pf() };
        let capacity_c = 3_600.0 * config.capacity_ah;
        let mut battery = Battery::new(config, 0.6, 25.0);
        let (mut before_a, mut exact_c) = (0.0_f64, 0.0);
        for (dt_s, amps) in rows {
            battery.step(dt_s, amps, 25.0);
            // ∫ of the two signs by a fine sum over the line.
            let n = 2_000;
            for k in 0..n {
                let i = before_a + (amps - before_a) * (f64::from(k) + 0.5) / f64::from(n);
                exact_c += i * if i < 0.0 { 0.98 } else { 1.0 } * dt_s / f64::from(n);
            }
            before_a = amps;
        }
        prop_assert!((battery.output().soc - (0.6 - exact_c / capacity_c)).abs() < 1e-6);
    }

    #[test]
    fn branches_do_not_depend_on_the_step(amps in -20.0..20.0_f64, dt_s in 0.01..500.0_f64, pieces in 2..50_u32) {
        let config = BatteryConfig {
            polarisation: BatteryConfig::panasonic_18650pf().polarisation,
            diffusion: RcBranch { r_ohm: 0.02, tau_s: 800.0 },
            m_v: 5e-3,
            ..BatteryConfig::default()
        };
        let mut coarse = Battery::new(config.clone(), 0.6, 25.0);
        let mut fine = Battery::new(config, 0.6, 25.0);
        coarse.step(dt_s, amps, 25.0);
        for piece in 1..=pieces {
            fine.step(dt_s / f64::from(pieces), amps * f64::from(piece) / f64::from(pieces), 25.0);
        }
        prop_assert!((coarse.output().cell_v - fine.output().cell_v).abs() < 1e-9);
        prop_assert!((coarse.output().soc - fine.output().soc).abs() < 1e-12);
        prop_assert!((coarse.hysteresis() - fine.hysteresis()).abs() < 1e-12);
    }

    #[test]
    fn loss_is_never_negative_over_a_closed_run(amps in prop::collection::vec(-5.0..5.0_f64, 1..40)) {
        // Passive: the energy that leaves the circuit's resistances over a run that ends at rest is heat.
        let mut battery = Battery::new(
            BatteryConfig { b_k: 0.0, m_v: 0.0, ..BatteryConfig::panasonic_18650pf() }, 0.5, 25.0
        );
        let mut heat_j = 0.0;
        let mut before_w = 0.0;
        for current_a in amps.into_iter().chain([0.0]) {
            battery.step(0.0, current_a, 25.0);
            before_w = battery.output().heat_w;
            for _ in 0..100 {
                let heat_w = battery.step(0.1, current_a, 25.0).heat_w;
                heat_j += 0.05 * (before_w + heat_w);
                before_w = heat_w;
            }
        }
        prop_assert!(heat_j >= -1e-9, "{} {}", heat_j, before_w);
    }
}
