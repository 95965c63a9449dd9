//! The front end against the documents' numbers, and against the ideal board by exact integrals.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use plant::comparator::{FlagPattern, GateOverride};
use plant::filter::{LowPassConfig, SecondOrder};
use plant::front_end::{
    Conditions, Faults, FilterPlace, FrontEnd, FrontEndConfig, SensorFault, Sensors,
};
use plant::hall::Transfer;
use plant::stretch::{Linear, Stretch};
use proptest::prelude::*;

fn at(current_a: f64) -> Conditions {
    Conditions {
        current_a,
        ..Conditions::default()
    }
}

/// Holds `conditions` for `hold_s` and gives the last stretch.
fn held(front_end: &mut FrontEnd, conditions: &Conditions, hold_s: f64) -> Stretch {
    let mut last = None;
    let end_s = front_end.now_s() + hold_s;
    front_end.advance(end_s, conditions, |stretch| last = Some(*stretch));
    last.unwrap()
}

fn settled(config: FrontEndConfig, conditions: Conditions) -> Stretch {
    held(
        &mut FrontEnd::new(config, 0.0, conditions),
        &conditions,
        1e-3,
    )
}

fn close(a: f64, b: f64, within: f64) {
    assert!((a - b).abs() <= within, "{a} is not {b} within {within}");
}

/// Integrals over a run, in Vs and As, and the edges of the flag.
#[derive(Debug, Default)]
struct Run {
    charge_c: f64,
    meter_c: f64,
    edges: Vec<(f64, bool)>,
    end_s: Option<f64>,
    flag: Option<bool>,
}

impl Run {
    fn take(&mut self, stretch: &Stretch) {
        assert!(stretch.end_s > stretch.start_s, "{stretch:?}");
        if let Some(end_s) = self.end_s {
            assert_eq!(end_s, stretch.start_s);
        }
        let dt = stretch.end_s - stretch.start_s;
        let full_scale_a = if stretch.range_high { 600.0 } else { 60.0 };
        self.charge_c += stretch.current_a.mean() * dt;
        self.meter_c += stretch.meter_v1_v.mean() * dt * full_scale_a / 0.5;
        if self.flag.is_some_and(|flag| flag != stretch.range_high) {
            self.edges.push((stretch.start_s, stretch.range_high));
        }
        self.flag = Some(stretch.range_high);
        self.end_s = Some(stretch.end_s);
    }
}

fn run(config: FrontEndConfig, profile: &[(f64, f64)]) -> Run {
    let mut run = Run::default();
    let mut front_end = FrontEnd::new(config, profile[0].0, at(profile[0].1));
    for (end_s, current_a) in &profile[1..] {
        front_end.advance(*end_s, &at(*current_a), |stretch| run.take(stretch));
    }
    assert_eq!(run.end_s, Some(profile[profile.len() - 1].0));
    run
}

#[test]
fn d0_at_55_and_500_a() {
    // The small sensor at 55 A: 2.5 V + 55 A · 2.25 V / 60 A.
    let mut front_end = FrontEnd::new(FrontEndConfig::dual_range(), 0.0, at(55.0));
    close(front_end.small_sensor_v(), 4.5625, 1e-12);
    // That is beyond 4.5 V: the large one is selected, 2.5 V + 55 A · 2.25 V / 600 A.
    assert!(front_end.range_high());
    let stretch = held(&mut front_end, &at(55.0), 1e-3);
    close(stretch.converter_v.mean(), 2.70625, 1e-12);
    close(stretch.meter_v1_v.mean(), 55.0 / 600.0 * 0.5, 1e-12);
    close(
        settled(FrontEndConfig::dual_range(), at(-500.0))
            .converter_v
            .end,
        0.625,
        1e-12,
    );
    // Past the range the output no longer moves.
    close(
        settled(FrontEndConfig::dual_range(), at(700.0))
            .converter_v
            .end,
        4.75,
        1e-12,
    );
    close(
        settled(FrontEndConfig::dual_range(), at(-700.0))
            .converter_v
            .end,
        0.25,
        1e-12,
    );
}

#[test]
fn d0_switches_at_53_33_a_both_ways_and_back_20_mv_below() {
    for sign in [1.0, -1.0] {
        let up = run(
            FrontEndConfig::dual_range(),
            &[(0.0, 0.0), (1.0, sign * 100.0)],
        );
        assert_eq!(up.edges.len(), 1);
        close(up.edges[0].0, 160.0 / 3.0 / 100.0, 1e-9);
        assert!(up.edges[0].1);
        let down = run(
            FrontEndConfig::dual_range(),
            &[(0.0, sign * 100.0), (1.0, 0.0)],
        );
        assert_eq!(down.edges.len(), 1);
        let back_a = 160.0 / 3.0 - 0.02 * 60.0 / 2.25;
        close(down.edges[0].0, 1.0 - back_a / 100.0, 1e-9);
    }
    // From one end to the other within one step: back at +52.8 A, away at −53.3 A.
    let through = run(FrontEndConfig::dual_range(), &[(0.0, 60.0), (1e-5, -60.0)]);
    assert_eq!(through.edges.len(), 2);
    close(through.edges[0].0 * 1e5, (60.0 - 52.8) / 120.0, 1e-9);
    close(through.edges[1].0 * 1e5, (60.0 + 160.0 / 3.0) / 120.0, 1e-9);
}

#[test]
fn d2_is_250_a_per_volt() {
    for amps in [-500.0, -1.0, 0.0, 123.456, 500.0] {
        let stretch = settled(FrontEndConfig::hah1bv(), at(amps));
        close(250.0 * (stretch.converter_v.end - 2.5), amps, 1e-9);
        close(stretch.meter_v1_v.end, amps * 0.004 * 2.0 / 9.0, 1e-12);
        assert!(!stretch.range_high);
    }
}

#[test]
fn d2_moves_its_zero_by_25_mv_per_percent_of_supply_and_the_meter_does_not_see_it() {
    let stretch = settled(
        FrontEndConfig::hah1bv(),
        Conditions {
            sensor_supply_v: 5.05,
            ..Conditions::default()
        },
    );
    close(stretch.converter_v.end, 2.525, 1e-12);
    close(stretch.meter_v1_v.end, 0.0, 1e-12);
    close(stretch.sensor_supply_v.end, 5.05, 0.0);
    close(stretch.converter_supply_v.end, 5.0, 0.0);
}

#[test]
fn d3_has_its_three_voltages() {
    let config = FrontEndConfig::network();
    for (hall_v, pin_v) in [
        (-5.0, 0.525),
        (-4.0, 0.75),
        (0.0, 1.65),
        (4.0, 2.55),
        (5.0, 2.775),
    ] {
        let mut front_end = FrontEnd::new(config, 0.0, at(0.0));
        front_end.set_faults(Faults {
            small: SensorFault::Forced(hall_v),
            ..Faults::default()
        });
        close(
            held(&mut front_end, &at(0.0), 1e-3).network_v.end,
            pin_v,
            1e-12,
        );
    }
    // ±4 V at ±500 A.
    close(settled(config, at(500.0)).network_v.end, 2.55, 1e-12);
    close(settled(config, at(-250.0)).network_v.end, 1.2, 1e-12);
    // The network's output is the meter's signal: 2.25 V around 1.65 V would be 1,250 A.
    close(
        settled(config, at(500.0)).meter_v1_v.end,
        0.5 * 500.0 / 1250.0,
        1e-12,
    );

    let open = Faults {
        small: SensorFault::Open,
        ..Faults::default()
    };
    let mut front_end = FrontEnd::new(config, 0.0, at(0.0));
    front_end.set_faults(open);
    // −6.675 V · 0.225 + 1.65 V
    close(
        held(&mut front_end, &at(0.0), 1e-3).network_v.end,
        0.148_125,
        1e-9,
    );
    let mut without = config;
    without.network.pull_down_ohm = f64::INFINITY;
    let mut front_end = FrontEnd::new(without, 0.0, at(0.0));
    front_end.set_faults(open);
    // 1.65 V · 1.225
    close(
        held(&mut front_end, &at(0.0), 1e-3).network_v.end,
        2.021_25,
        1e-9,
    );
}

#[test]
fn d4_gives_its_example() {
    // 2.49 V with the key OFF: an offset of −10 mV; 2.48 V in ACC: another −10 mV of ground shift.
    let mut config = FrontEndConfig::closed_loop();
    if let Sensors::ClosedLoop(sensor) = &mut config.sensors {
        sensor.offset_a = -0.01 / (2.0 / 300.0);
    }
    close(
        settled(FrontEndConfig::closed_loop(), at(0.0))
            .converter_v
            .end,
        2.5,
        1e-12,
    );
    close(settled(config, at(0.0)).converter_v.end, 2.49, 1e-12);
    let acc = Conditions {
        output_shift_v: -0.01,
        ..Conditions::default()
    };
    let stretch = settled(config, acc);
    close(stretch.converter_v.end, 2.48, 1e-12);
    close(stretch.meter_v1_v.end, -0.02 * 2.0 / 9.0, 1e-12);
}

#[test]
fn d4_follows_its_two_relations() {
    let (turns, k1, m1, k2, m2) = (1_000.0, 1.1, 0.9, 0.48, 0.07);
    let mut config = FrontEndConfig::closed_loop();
    if let Sensors::ClosedLoop(sensor) = &mut config.sensors {
        sensor.transfer = Transfer::ClosedLoop {
            turns,
            k1_ohm_per_v: k1,
            m1_ohm: m1,
            k2,
            m2_v: m2,
        };
    }
    for supply_v in [4.5, 5.0, 5.5] {
        for amps in [-200.0, 0.0, 150.0] {
            let stretch = settled(
                config,
                Conditions {
                    current_a: amps,
                    sensor_supply_v: supply_v,
                    ..Conditions::default()
                },
            );
            let expected = (k1 * supply_v + m1) * amps / turns + k2 * supply_v + m2;
            close(stretch.converter_v.end, expected, 1e-12);
        }
    }
}

#[test]
fn an_open_small_sensor_selects_the_large_one() {
    let mut front_end = FrontEnd::new(FrontEndConfig::dual_range(), 0.0, at(10.0));
    let before = held(&mut front_end, &at(10.0), 1e-3);
    close(before.network_v.end, 0.225 * 2.875 + 1.65, 1e-12);
    assert!(!before.range_high);
    front_end.set_faults(Faults {
        small: SensorFault::Open,
        ..Faults::default()
    });
    let after = held(&mut front_end, &at(10.0), 1e-3);
    assert!(after.range_high);
    close(after.start_s, 1e-3, 0.0);
    close(after.converter_v.end, 2.5 + 10.0 * 2.25 / 600.0, 1e-12);
    close(after.network_v.end, 0.148_125, 1e-9);
    // The follower stands at its rail: nothing below ground reaches the switch.
    assert_eq!(front_end.small_follower_v(), 0.0);
    // Connected again, and the small one is back.
    front_end.set_faults(Faults::default());
    let again = held(&mut front_end, &at(10.0), 1e-3);
    assert!(!again.range_high);
    close(again.converter_v.end, 2.875, 1e-12);
}

#[test]
fn outputs_that_are_forced_or_divided() {
    let with = |fault| {
        let mut front_end = FrontEnd::new(FrontEndConfig::hah1bv(), 0.0, at(100.0));
        front_end.set_faults(Faults {
            small: fault,
            ..Faults::default()
        });
        held(&mut front_end, &at(100.0), 1e-3)
    };
    close(with(SensorFault::Forced(5.0)).converter_v.end, 5.0, 0.0);
    close(with(SensorFault::Forced(0.0)).converter_v.end, 0.0, 0.0);
    let divider = |ohms| {
        with(SensorFault::Divider { volts: 2.5, ohms })
            .converter_v
            .end
    };
    close(divider(0.0), 2.5, 1e-12);
    // 2.5 V behind 10 kΩ against −6.675 V behind 73.5 kΩ.
    close(divider(10e3), 2.5 - 9.175 * 10.0 / 83.5, 1e-9);
    let mut front_end = FrontEnd::new(FrontEndConfig::dual_range(), 0.0, at(100.0));
    front_end.set_faults(Faults {
        large: SensorFault::Open,
        ..Faults::default()
    });
    close(
        held(&mut front_end, &at(100.0), 1e-3).converter_v.end,
        0.0,
        0.0,
    );
}

#[test]
fn resistance_of_the_sensor_is_loaded_by_the_network() {
    let mut config = FrontEndConfig::hah1bv();
    if let Sensors::Hah1bv(sensor) = &mut config.sensors {
        sensor.output_ohm = 1e3;
    }
    // 17.5 V across 147 kΩ to −15 V and 0.85 V across 147 kΩ to the reference: 0.125 mA through 1 kΩ.
    let node_v = settled(config, at(0.0)).converter_v.end;
    let current_a = (node_v + 15.0) / 147e3 + (node_v - 1.65) / 147e3;
    close(node_v, 2.5 - 1e3 * current_a, 1e-9);
    assert!(node_v < 2.4);
}

#[test]
fn chatter_has_the_edges_of_its_pattern() {
    let mut front_end = FrontEnd::new(FrontEndConfig::dual_range(), 0.0, at(53.0));
    let pattern = FlagPattern {
        start_s: 0.001,
        frequency_hz: 30e3,
        duty: 0.3,
    };
    front_end.set_faults(Faults {
        gate: GateOverride::Pattern(pattern),
        ..Faults::default()
    });
    let mut run = Run::default();
    for step in 1..=100 {
        front_end.advance(f64::from(step) * 50e-6, &at(53.0), |stretch| {
            let selected = if stretch.range_high { 600.0 } else { 60.0 };
            close(stretch.converter_v.end, 2.5 + 53.0 * 2.25 / selected, 1e-12);
            run.take(stretch);
        });
    }
    // 4 ms of 30 kHz; the edge at the very end has not been seen as a stretch.
    assert_eq!(run.edges.len(), 240);
    for (index, (time_s, high)) in run.edges.iter().enumerate() {
        close(*time_s, pattern.edge_s(index as u64), 1e-15);
        assert_eq!(*high, index % 2 == 0);
    }
    close(run.meter_c, run.charge_c, 1e-12);
    // A pattern that is there already is joined, not begun.
    front_end.set_faults(Faults {
        gate: GateOverride::Pattern(FlagPattern {
            start_s: -1.0,
            frequency_hz: 1.0,
            duty: 0.5,
        }),
        ..Faults::default()
    });
    assert!(front_end.range_high());
    front_end.set_faults(Faults {
        gate: GateOverride::Constant(false),
        ..Faults::default()
    });
    assert!(!front_end.range_high() && !front_end.switch_high());
    let high = held(&mut front_end, &at(58.0), 1e-3);
    assert!(!high.range_high);
    close(high.converter_v.end, 2.5 + 58.0 * 0.0375, 1e-12);
    // The fault goes, and the comparators decide again, at once.
    front_end.set_faults(Faults::default());
    assert!(front_end.range_high());
}

#[test]
fn a_stuck_flag_line_contradicts_the_switch() {
    let mut front_end = FrontEnd::new(FrontEndConfig::dual_range(), 0.0, at(100.0));
    front_end.set_faults(Faults {
        flag_line: Some(false),
        ..Faults::default()
    });
    let stretch = held(&mut front_end, &at(100.0), 1e-3);
    assert!(!stretch.range_high && front_end.switch_high());
    close(stretch.converter_v.end, 2.875, 1e-12);
}

#[test]
fn comparator_delay_moves_the_edge_and_swallows_short_visits() {
    let mut config = FrontEndConfig::dual_range();
    config.comparators.delay_s = 1e-3;
    // 1,000 A/s: 53.33 A at 53.33 ms.
    let late = run(config, &[(0.0, 0.0), (0.1, 100.0)]);
    assert_eq!(late.edges.len(), 1);
    close(late.edges[0].0, 160.0 / 3.0 * 1e-3 + 1e-3, 1e-12);
    let short = run(
        config,
        &[(0.0, 53.0), (0.0005, 53.5), (0.001, 52.0), (0.1, 52.0)],
    );
    assert_eq!(short.edges, []);
}

#[test]
fn comparators_follow_the_supply_unless_they_have_a_reference() {
    let low = Conditions {
        sensor_supply_v: 4.5,
        ..Conditions::default()
    };
    let edge_a = |ratio: f64| {
        let mut config = FrontEndConfig::dual_range();
        config.comparators.ratio = ratio;
        let mut front_end = FrontEnd::new(config, 0.0, low);
        let mut edge_a = None;
        front_end.advance(
            1.0,
            &Conditions {
                current_a: 100.0,
                ..low
            },
            |stretch| {
                if stretch.range_high && edge_a.is_none() {
                    edge_a = Some(stretch.current_a.start);
                }
            },
        );
        edge_a
    };
    close(edge_a(1.0).unwrap(), 160.0 / 3.0, 1e-9);
    // The small sensor ends at 4.275 V.
    assert_eq!(edge_a(0.0), None);
}

#[test]
fn a_crossing_on_a_lagged_curve_is_found_to_a_nanosecond() {
    let mut config = FrontEndConfig::dual_range();
    let tau_s = 2e-3;
    if let Sensors::DualRange { small, large } = &mut config.sensors {
        small.tau_s = tau_s;
        large.tau_s = tau_s;
    }
    // From 0 A to 59 A in no time: 4.5 V is reached at −τ·ln(1 − 53.33/59). One step of 20 ms has it all inside.
    let mut front_end = FrontEnd::new(config, 0.0, at(0.0));
    front_end.advance(0.0, &at(59.0), |_| ());
    let mut edge_s = None;
    front_end.advance(20e-3, &at(59.0), |stretch| {
        if stretch.range_high && edge_s.is_none() {
            edge_s = Some(stretch.start_s);
        }
    });
    let expected_s = -tau_s * (1.0 - 160.0 / 3.0 / 59.0_f64).ln();
    close(edge_s.unwrap(), expected_s, 1e-9);
}

#[test]
fn the_open_switch_holds_and_the_closing_one_injects() {
    let mut config = FrontEndConfig::dual_range();
    config.switch.break_before_make_s = 7e-9;
    config.switch.injected_charge_c = 50e-12;
    config.switch.node_capacitance_f = 1e-9;
    config.switch.path_ohm = 100.0;
    let mut front_end = FrontEnd::new(config, 0.0, at(30.0));
    held(&mut front_end, &at(30.0), 1e-3);
    front_end.set_faults(Faults {
        gate: GateOverride::Constant(true),
        ..Faults::default()
    });
    let mut stretches = Vec::new();
    let end_s = front_end.now_s() + 10e-6;
    front_end.advance(end_s, &at(30.0), |stretch| stretches.push(*stretch));
    assert_eq!(stretches.len(), 2);
    let (small_v, large_v) = (2.5 + 30.0 * 0.0375, 2.5 + 30.0 * 0.00375);
    close(stretches[0].end_s - stretches[0].start_s, 7e-9, 1e-15);
    assert_eq!(stretches[0].converter_v, Linear::constant(small_v));
    // Q/C = 50 mV and what the node still holds decay with R·C = 100 ns: their integral is (Q/C + V)·R·C.
    let dt_s = stretches[1].end_s - stretches[1].start_s;
    let over_vs = (stretches[1].converter_v.mean() - large_v) * dt_s;
    close(over_vs, (0.05 + small_v - large_v) * 100e-9, 1e-15);
    close(stretches[1].converter_v.end, large_v, 1e-9);
}

#[test]
fn a_filter_behind_the_switch_costs_what_its_delay_says() {
    let filter = LowPassConfig {
        second_order: Some(SecondOrder { f0_hz: 1e3, q: 0.7 }),
        rc_tau_s: 0.2e-3,
    };
    let delay_s = 1.0 / (0.7 * std::f64::consts::TAU * 1e3) + 0.2e-3;
    // A slow ramp: the lag at the edge is 17 mA.
    let profile = [(0.0, 40.0), (0.1, 40.0), (1.1, 80.0), (1.3, 80.0)];
    let of = |filter_place| {
        let run = run(
            FrontEndConfig {
                filter,
                filter_place,
                ..FrontEndConfig::dual_range()
            },
            &profile,
        );
        run.meter_c - run.charge_c
    };
    // Behind: 9 · 53.33 A · τ too much; both: the large sensor's last 40 A come late.
    close(
        of(FilterPlace::BehindSwitch) - of(FilterPlace::BeforeSwitch),
        9.0 * 160.0 / 3.0 * delay_s,
        1e-4,
    );
    close(of(FilterPlace::BeforeSwitch), -40.0 * delay_s, 1e-9);
}

#[test]
fn nominal_values_are_the_ideal_sensor_bit_for_bit() {
    let nominal = FrontEndConfig::dual_range();
    let mut explicit = nominal;
    if let Sensors::DualRange { small, large } = &mut explicit.sensors {
        for sensor in [small, large] {
            sensor.core.coercivity_a = 20.0;
            sensor.core.softness = 0.1;
            sensor.self_heating.tau_s = 100.0;
            sensor.noise.seed = 7;
        }
    }
    explicit.switch.injected_charge_c = 50e-12;
    explicit.filter_place = FilterPlace::BehindSwitch;
    let mut front_ends = [nominal, explicit].map(|config| FrontEnd::new(config, 0.0, at(0.0)));
    for step in 1..2_000_i32 {
        let end = Conditions {
            current_a: 80.0 * (0.01 * f64::from(step)).sin(),
            sensor_temperature_c: 25.0 + 0.01 * f64::from(step),
            aux_current_a: f64::from(step),
            ..Conditions::default()
        };
        let [mut a, mut b] = [Vec::new(), Vec::new()];
        front_ends[0].advance(f64::from(step) * 20e-6, &end, |stretch| a.push(*stretch));
        front_ends[1].advance(f64::from(step) * 20e-6, &end, |stretch| b.push(*stretch));
        assert_eq!(a, b);
        let last = a.last().unwrap();
        let full_a = if front_ends[0].range_high() {
            600.0
        } else {
            60.0
        };
        if last.range_high == front_ends[0].range_high() {
            assert_eq!(last.converter_v.end, 2.5 + 2.25 / full_a * end.current_a);
        }
    }
}

#[test]
fn noise_has_its_power_in_any_step_and_is_repeatable() {
    let rms_v = 2e-3;
    let (bandwidth_hz, tau_s) = (5e3, 1.0 / (std::f64::consts::TAU * 5e3));
    let config = |seed| {
        let mut config = FrontEndConfig::hah1bv();
        if let Sensors::Hah1bv(sensor) = &mut config.sensors {
            sensor.noise.rms_v = rms_v;
            sensor.noise.bandwidth_hz = bandwidth_hz;
            sensor.noise.seed = seed;
        }
        config
    };
    let means = |seed, step_s: f64, window: usize, windows: usize| {
        let mut front_end = FrontEnd::new(config(seed), 0.0, at(0.0));
        let mut step = 0_u32;
        (0..windows)
            .map(|_| {
                let mut sum_v = 0.0;
                for _ in 0..window {
                    step += 1;
                    front_end.advance(f64::from(step) * step_s, &at(0.0), |stretch| {
                        sum_v += stretch.converter_v.mean() - 2.5;
                    });
                }
                sum_v / window as f64
            })
            .collect::<Vec<f64>>()
    };
    let rms =
        |values: &[f64]| (values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64).sqrt();
    // A step far below the time constant shows all of it; the mean over T ≫ τ has σ·√(2τ/T).
    close(rms(&means(1, 1e-6, 1, 400_000)) / rms_v, 1.0, 0.02);
    let window_s = 10e-3;
    let expected_v = rms_v * (2.0 * tau_s / window_s * (1.0 - tau_s / window_s)).sqrt();
    close(rms(&means(2, window_s, 1, 4_000)) / expected_v, 1.0, 0.05);
    close(
        rms(&means(3, window_s / 100.0, 100, 4_000)) / expected_v,
        1.0,
        0.05,
    );
    assert_eq!(means(4, 1e-5, 1, 10), means(4, 1e-5, 1, 10));
    assert_ne!(means(4, 1e-5, 1, 10), means(5, 1e-5, 1, 10));
}

#[test]
fn numbers_are_the_measuring_logic_s() {
    use core_logic::design_parameters as design;
    use core_logic::front_end as logic;
    use core_logic::range::Range;
    use core_logic::units::{Microamps, Microvolts};

    let volts = |v: Microvolts| f64::from(v.get()) * 1e-6;
    let pairs = [
        (FrontEndConfig::dual_range(), logic::FrontEnd::default()),
        (
            FrontEndConfig::hah1bv(),
            logic::FrontEnd::Hah1bv(logic::Hah1bv::default()),
        ),
        (
            FrontEndConfig::network(),
            logic::FrontEnd::Network(logic::Network::default()),
        ),
        (
            FrontEndConfig::closed_loop(),
            logic::FrontEnd::ClosedLoop(logic::ClosedLoop::default()),
        ),
    ];
    for (config, front_end) in pairs {
        for amps in [-450, -200, -30, 0, 7, 53, 120, 280] {
            let stretch = settled(config, at(f64::from(amps)));
            let range = if stretch.range_high {
                Range::Large
            } else {
                Range::Small
            };
            if i64::from(amps).abs() * 1_000_000 > i64::from(front_end.full_scale(range).get()) {
                continue;
            }
            let signal = match front_end.channel() {
                logic::Channel::Ads1100 => stretch.converter_v.end,
                logic::Channel::Adc1 => stretch.network_v.end,
            };
            let expected = front_end.voltage(
                Microamps::from_amps(amps),
                range,
                design::SENSOR_NOMINAL_SUPPLY,
            );
            close(signal, volts(expected), 0.51e-6);
            let share = f64::from(amps) * 1e6 / f64::from(front_end.meter_full_scale(range).get());
            close(stretch.meter_v1_v.end, 0.5 * share, 1e-6);
        }
    }
    let comparators = FrontEndConfig::default().comparators;
    assert_eq!(comparators.high_v, volts(design::COMPARATOR_HIGH));
    assert_eq!(comparators.low_v, volts(design::COMPARATOR_LOW));
}

/// Current at the corners of a profile, and the time between them.
fn any_profile() -> impl Strategy<Value = Vec<(f64, f64)>> {
    prop::collection::vec((1e-5..0.2_f64, -590.0..590.0_f64), 2..30).prop_map(|rows| {
        let mut time_s = 0.0;
        rows.into_iter()
            .map(|(dt_s, amps)| {
                time_s += dt_s;
                (time_s, amps)
            })
            .collect()
    })
}

/// The same profile in pieces.
fn in_pieces(profile: &[(f64, f64)], pieces: u32) -> Vec<(f64, f64)> {
    let mut fine = vec![profile[0]];
    for pair in profile.windows(2) {
        let ((t0, i0), (t1, i1)) = (pair[0], pair[1]);
        for piece in 1..pieces {
            let share = f64::from(piece) / f64::from(pieces);
            fine.push((t0 + (t1 - t0) * share, i0 + (i1 - i0) * share));
        }
        fine.push(pair[1]);
    }
    fine
}

proptest! {
    #[test]
    fn nominal_world_conserves_charge(profile in any_profile()) {
        let exact_c: f64 = profile
            .windows(2)
            .map(|pair| 0.5 * (pair[0].1 + pair[1].1) * (pair[1].0 - pair[0].0))
            .sum();
        let run = run(FrontEndConfig::dual_range(), &profile);
        prop_assert!((run.charge_c - exact_c).abs() < 1e-9);
        prop_assert!((run.meter_c - exact_c).abs() < 1e-9, "{} {}", run.meter_c, exact_c);
    }

    #[test]
    fn nominal_edges_do_not_depend_on_the_steps(profile in any_profile(), pieces in 2..20_u32) {
        let coarse = run(FrontEndConfig::dual_range(), &profile);
        let fine = run(FrontEndConfig::dual_range(), &in_pieces(&profile, pieces));
        prop_assert_eq!(coarse.edges.len(), fine.edges.len());
        for (a, b) in coarse.edges.iter().zip(&fine.edges) {
            prop_assert!((a.0 - b.0).abs() < 1e-11 && a.1 == b.1, "{:?} {:?}", a, b);
        }
    }

    #[test]
    fn filtered_charge_does_not_depend_on_the_steps(
        profile in any_profile(), pieces in 2..20_u32, f0_hz in 50.0..5e3_f64, q in 0.4..2.0_f64, rc_tau_s in 0.0..2e-3_f64
    ) {
        let config = FrontEndConfig {
            filter: LowPassConfig { second_order: Some(SecondOrder { f0_hz, q }), rc_tau_s },
            ..FrontEndConfig::dual_range()
        };
        let coarse = run(config, &profile);
        let fine = run(config, &in_pieces(&profile, pieces));
        prop_assert!((coarse.meter_c - fine.meter_c).abs() < 1e-6, "{} {}", coarse.meter_c, fine.meter_c);
    }

    #[test]
    fn a_sensor_beyond_its_range_is_cut_exactly(from in -2_000.0..2_000.0_f64, to in -2_000.0..2_000.0_f64) {
        // ∫ clamp(i) over a line, against a fine sum.
        let run = run(FrontEndConfig::dual_range(), &[(0.0, from), (1.0, to)]);
        let n = 20_000;
        let fine: f64 = (0..n)
            .map(|k| (from + (to - from) * (f64::from(k) + 0.5) / f64::from(n)).clamp(-600.0, 600.0))
            .sum::<f64>() / f64::from(n);
        prop_assert!((run.meter_c - fine).abs() < 1e-3, "{} {}", run.meter_c, fine);
    }

    #[test]
    fn anything_at_all_ends_in_time(
        amps in prop::collection::vec(-1e4..1e4_f64, 2..20), supply in 0.0..6.0_f64, delay_s in 0.0..1e-4_f64,
        hysteresis_v in 0.0..0.1_f64, noise in 0.0..0.1_f64, tau_s in 0.0..1e-3_f64, frequency_hz in 0.0..2e5_f64
    ) {
        let mut config = FrontEndConfig::dual_range();
        config.comparators.delay_s = delay_s;
        config.comparators.hysteresis_v = hysteresis_v;
        config.switch.break_before_make_s = 1e-8;
        if let Sensors::DualRange { small, .. } = &mut config.sensors {
            small.noise.rms_v = noise;
            small.tau_s = tau_s;
        }
        let mut front_end = FrontEnd::new(config, 5.0, at(0.0));
        for (k, current_a) in amps.iter().enumerate() {
            if k == 10 {
                let pattern = FlagPattern { start_s: 5.0, frequency_hz, duty: 0.9 };
                front_end.set_faults(Faults { gate: GateOverride::Pattern(pattern), ..Faults::default() });
            }
            let end_s = 5.0 + 1e-3 * (k as f64 + 1.0);
            let mut last_s = front_end.now_s();
            let conditions = Conditions { current_a: *current_a, sensor_supply_v: supply, ..Conditions::default() };
            front_end.advance(end_s, &conditions, |stretch| {
                assert_eq!(stretch.start_s, last_s);
                assert!(stretch.end_s > stretch.start_s);
                for line in [stretch.converter_v, stretch.meter_v1_v, stretch.network_v] {
                    assert!(line.start.is_finite() && line.end.is_finite());
                }
                last_s = stretch.end_s;
            });
            prop_assert_eq!(last_s, end_s);
            prop_assert_eq!(front_end.now_s(), end_s);
        }
    }
}
