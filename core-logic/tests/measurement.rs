//! The five designs, on the whole measuring logic over an ideal board: what goes out on the bus is compared with what
//! flowed.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss
)]

#[path = "support/host_board.rs"]
mod host_board;
#[path = "support/ideal_board.rs"]
mod ideal_board;

use core_logic::configuration::Configuration;
use core_logic::converter::{DataRate, SupplyMode};
use core_logic::diagnosis::{Code, CodeSet};
use core_logic::error_budget::{ProfileSummary, charge_bound};
use core_logic::front_end::KeyFactors;
use core_logic::key_calibration::KeyPhase;
use core_logic::measurement::{ConverterFault, Measurement, Order, Refusal, Tick, Vehicle};
use core_logic::meter::MeterReport;
use core_logic::modbus::Readings;
use core_logic::open_sensor::network_output_open;
use core_logic::range::{EdgeRecorder, Range};
use core_logic::retained::RetainedState;
use core_logic::soc::SocRetained;
use core_logic::units::{Duration, Instant, Microamps, Microvolts, Nanocoulombs, Ppm};
use core_logic::validity::Validity;
use host_board::{HostBoard, Step};
use ideal_board::{Event, Row, Timing};
use proptest::prelude::*;

fn rows(points: &[(f64, f64)]) -> Vec<Row> {
    points
        .iter()
        .map(|&(t_s, current_a)| Row {
            t_s,
            current_a,
            cell_v: 3.7,
        })
        .collect()
}

fn board(rows: &[Row]) -> HostBoard<'_> {
    HostBoard::new(rows, Timing::default(), Configuration::default())
}

/// The bound of the error budget for what has run so far, without the sensors' own errors.
fn ideal_bound_c(board: &HostBoard<'_>, rows: &[Row]) -> f64 {
    let duration = board.world.elapsed_s();
    let mean_square = rows.iter().map(|row| row.current_a.powi(2)).sum::<f64>() / rows.len() as f64;
    let bound = charge_bound(&ProfileSummary {
        duration: Duration::from_ticks((duration * 1e6) as u64),
        in_large: board.in_large(),
        rms_current: Microamps((mean_square.sqrt() * 1e6) as i32),
        edges: board.world.edges as u32,
        below_no_load: Duration::from_ticks(0),
        chatter: Duration::from_ticks(0),
        chatter_squares: 0,
        chatter_runs: 0,
    });
    bound.ideal_sensor.get() as f64 * 1e-9
}

/// D0: right currents on both sides of ±53.33 A, in both directions, and never a valid one from a spoiled conversion.
#[test]
fn d0_switches_at_53_33_amps_in_both_directions_with_right_currents_on_both_sides() {
    let rows = rows(&[
        (0.0, 0.0),
        (2.0, 50.0),
        (4.0, 60.0),
        (6.0, 400.0),
        (8.0, 60.0),
        (10.0, 40.0),
        (12.0, -40.0),
        (14.0, -60.0),
        (16.0, -400.0),
        (18.0, -60.0),
        (20.0, 0.0),
        (21.0, 0.0),
    ]);
    let mut board = board(&rows);
    let mut valid = [0, 0];
    let mut spoiled = 0;
    let mut flips = Vec::new();
    while let Some(step) = board.step() {
        match step {
            Step::Event(Event::Edge { .. }) => flips.push(board.world.current_a()),
            Step::Event(Event::Conversion { started_us, .. }) => {
                let sent = board.measurement.current();
                if sent.validity.contains(Validity::RANGE_CHANGE) {
                    spoiled += 1;
                    continue;
                }
                if !sent.validity.is_valid() {
                    continue; // supply not known in the first 10 ms
                }
                // A conversion is the mean over its time; the current is linear but at the corners.
                let now = board.world.current_a();
                let length_s = (board.now_us - started_us) as f64 * 1e-6;
                let code_a = if sent.range == Range::Small {
                    0.0163
                } else {
                    0.163
                };
                let error = f64::from(sent.current.get()) * 1e-6 - now;
                assert!(
                    error.abs() < code_a + 200.0 * length_s,
                    "{error} A at {now} A"
                );
                valid[sent.range as usize] += 1;
            }
            _ => {}
        }
    }
    let expected = [53.33, 52.80, -53.33, -52.80];
    assert_eq!(flips.len(), 4, "{flips:?}");
    for (flip, expected) in flips.iter().zip(expected) {
        assert!((flip - expected).abs() < 0.01, "{flips:?}");
    }
    assert!((4..=8).contains(&spoiled), "{spoiled}");
    assert!(valid[0] > 300 && valid[1] > 250, "{valid:?}");
}

/// D1: the charge of a mixed profile, within what the error budget states for sensors without error.
#[test]
fn d1_counts_the_charge_of_a_mixed_profile_within_the_error_budget() {
    let points: Vec<(f64, f64)> = (0..2_000)
        .map(|i| {
            let t = f64::from(i) * 0.5;
            (t, 120.0 * (t * 0.11).sin() + 90.0 * (t * 0.7).sin() + 25.0)
        })
        .collect();
    let rows = rows(&points);
    let mut board = board(&rows);
    board.run();
    let (error, bound) = (board.charge_error_c(), ideal_bound_c(&board, &rows));
    assert!(board.world.edges > 200, "{}", board.world.edges);
    assert!(error.abs() <= bound, "{error} C, bound {bound} C");
    assert!(
        error.abs() < 1e-3 * board.world.charge_c,
        "{error} of {}",
        board.world.charge_c
    );
    assert!(board.measurement.charge().validity.is_valid());
    // What the two channels differ by is there to read while they agree.
    let mut readings = Readings::default();
    board
        .measurement
        .fill(&Configuration::default(), &mut readings);
    let (difference, bound) = (readings.channel_difference, readings.channel_bound);
    assert!(difference != Nanocoulombs::ZERO && difference.saturating_abs() <= bound);
}

/// D2: a zero drift taken by order makes current *and* charge read zero, and survives in the configuration.
#[test]
fn d2_zero_now_cancels_the_drift_of_both_channels() {
    // The sensor's drift of 1.5 A, as the ideal board knows it: a current that "flows" with the high voltage off.
    let rows = rows(&[(0.0, 1.5), (60.0, 1.5)]);
    let mut board = board(&rows);
    board.vehicle.acc_line = false;
    board.vehicle.hv_feedback = false;
    assert!(board.run_until(|board| board.now_us > 3_000_000));
    let configuration = board.configuration;
    assert_eq!(
        board.measurement.order(&configuration, Order::ZeroNow),
        Ok(())
    );
    assert_eq!(
        board.measurement.order(&configuration, Order::ZeroNow),
        Err(Refusal::Busy)
    );
    assert!(board.run_until(|board| board.configuration.zero_drift.value.small != Microamps::ZERO));
    let drift = board.configuration.zero_drift.value.small.get();
    assert!(
        (drift - 1_500_000).abs() < 8_200,
        "{drift} µA: half a code is 8.1 mA"
    );
    assert_eq!(board.configuration.zero_drift.value.large, Microamps::ZERO);
    let (begin_c, begin_s) = (
        board.meter.report().charge_total.get() as f64 * 1e-9,
        board.world.elapsed_s(),
    );
    board.run();
    let mean = (board.meter.report().charge_total.get() as f64 * 1e-9 - begin_c)
        / (board.world.elapsed_s() - begin_s);
    assert!(mean.abs() < 8.5e-3, "{mean} A are still counted");
    assert!(board.measurement.current().current.get().abs() < 8_200);
}

#[test]
fn d2_zero_now_is_refused_while_current_flows_or_the_high_voltage_is_on() {
    let rows = rows(&[(0.0, 20.0), (10.0, 20.0)]);
    let mut board = board(&rows);
    assert!(board.run_until(|board| board.now_us > 3_000_000));
    let configuration = board.configuration;
    assert_eq!(
        board.measurement.order(&configuration, Order::ZeroNow),
        Err(Refusal::HighVoltage)
    );
    board.vehicle.acc_line = false;
    board.vehicle.hv_feedback = false;
    assert!(board.run_until(|board| board.now_us > 5_000_000));
    assert_eq!(
        board.measurement.order(&configuration, Order::ZeroNow),
        Err(Refusal::CurrentFlows)
    );
    assert_eq!(board.configuration.zero_drift.value.small, Microamps::ZERO);
}

/// D3: an open sensor is found within two readings, reported on the bus, and its current is not turned into 0 A.
#[test]
fn d3_finds_the_open_small_sensor_and_marks_the_current() {
    let rows = rows(&[(0.0, 20.0), (20.0, 20.0)]);
    let mut board = board(&rows);
    assert!(board.run_until(|board| board.now_us > 2_000_000));
    assert!(board.measurement.current().validity.is_valid());
    board.network = Some(network_output_open());
    let opened_at = board.now_us;
    assert!(board.run_until(|board| {
        board
            .measurement
            .diagnosis()
            .active()
            .contains(Code::OpenSensor)
    }));
    assert!(
        board.now_us - opened_at <= 40_000,
        "{} µs",
        board.now_us - opened_at
    );
    let sent = board.measurement.current();
    assert!(sent.validity.contains(Validity::OPEN));
    assert!(board.measurement.charge().validity.contains(Validity::OPEN));
    // The bus carries "not available", which is no current at all.
    let frame = sent.encode(0);
    let raw =
        core_logic::can::layout::current::VALUE.get(core_logic::can::layout::word(frame.data));
    assert_eq!(
        Some(raw),
        core_logic::can::layout::current::VALUE.not_available()
    );
}

/// D4: the permit waits until both factors are taken, and the current then reads 0 A in ACC.
#[test]
fn d4_holds_the_permit_until_the_factors_are_taken_and_then_reads_zero() {
    // 2.49 V with key OFF and 2.48 V in ACC (D4's example), as currents of the small sensor.
    let amps = |volts: f64| (volts - 2.5) * 60.0 / 2.25;
    let rows = rows(&[
        (0.0, amps(2.49)),
        (3.0, amps(2.49)),
        (3.0, amps(2.48)),
        (20.0, amps(2.48)),
    ]);
    let mut board = board(&rows);
    board.vehicle.acc_line = false;
    board.vehicle.hv_feedback = false;
    assert!(board.run_until(|board| board.now_us >= 3_000_000));
    board.vehicle.acc_line = true;
    let mut permitted_before_taken = false;
    let mut taken_at = None;
    let mut permitted_at = None;
    while let Some(step) = board.step() {
        if let Step::Tick(tick) = step {
            let taken =
                board.measurement.board_state(0, 0).key_calibration == Some(KeyPhase::Taken);
            permitted_before_taken |= tick.hv_permit && !taken;
            if taken && taken_at.is_none() {
                taken_at = Some(board.now_us);
            }
            if tick.hv_permit && permitted_at.is_none() {
                permitted_at = Some(board.now_us);
            }
        }
    }
    assert!(!permitted_before_taken);
    assert_eq!(taken_at, permitted_at);
    let delay_ms = (permitted_at.unwrap() - 3_000_000) / 1_000;
    assert!((500..1_500).contains(&delay_ms), "{delay_ms} ms");
    let factors = board.configuration.key_factors;
    assert!(
        (factors.a.get() - 10_000).abs() <= 610,
        "a = {:?}",
        factors.a
    );
    assert!(
        (factors.k_ppb - 1_004_016_064).abs() < 250_000,
        "k = {}",
        factors.k_ppb
    );
    let current = board.measurement.current().current.get();
    assert!(
        current.abs() < 16_300,
        "{current} µA in ACC, one code is 16.3 mA"
    );
}

/// D2 and D4: the state of charge follows the meter and is anchored after a rest.
#[test]
fn soc_follows_the_charge_and_is_anchored_after_a_rest() {
    let mut configuration = Configuration::default();
    configuration.soc.capacity_mah = 1_000;
    let rest_s = f64::from(configuration.soc.rest_time_s);
    let rows = rows(&[
        (0.0, 0.0),
        (rest_s + 20.0, 0.0),
        (rest_s + 20.0, 36.0),
        (rest_s + 30.0, 36.0),
        (rest_s + 30.0, 0.0),
        (rest_s + 32.0, 0.0),
    ]);
    let mut board = HostBoard::new(&rows, Timing::default(), configuration);
    assert!(board.run_until(|board| board.measurement.state_of_charge().validity.is_valid()));
    assert!(board.world.elapsed_s() >= rest_s);
    let anchored = board.measurement.state_of_charge().state_of_charge.get();
    board.run();
    let left = board.measurement.state_of_charge().state_of_charge.get();
    // 36 A for 10 s out of 3,600 C are 10 %.
    assert!(
        (anchored - left - 100_000).abs() < 300,
        "{anchored} → {left}"
    );
}

/// When the state of charge is valid, at rest from the start and with the converter silent for so long 10, 20 and 30 s after it.
fn anchored_s(silent_us: Option<u64>) -> f64 {
    let mut configuration = Configuration::default();
    configuration.soc.capacity_mah = 1_000;
    configuration.soc.rest_time_s = 60;
    configuration.soc.stability_window_s = 20;
    let rows = rows(&[(0.0, 0.0), (200.0, 0.0)]);
    let mut board = HostBoard::new(&rows, Timing::default(), configuration);
    for begin_us in [10_000_000, 20_000_000, 30_000_000] {
        let Some(silent_us) = silent_us else { break };
        assert!(board.run_until(|board| board.now_us >= begin_us));
        while board.now_us <= begin_us + silent_us {
            let at = Instant::from_ticks(board.now_us);
            board
                .measurement
                .on_converter_fault(ConverterFault::NoAnswer, at);
            assert!(!board.measurement.current().validity.is_valid());
            board.step();
        }
    }
    assert!(board.run_until(|board| board.measurement.state_of_charge().validity.is_valid()));
    board.world.elapsed_s()
}

/// A conversion that is lost now and then leaves a rest be; a converter that is silent for longer than a second ends it, for the
/// meter alone does not show one.
#[test]
fn a_lost_conversion_ends_no_rest_and_a_silent_converter_does() {
    let undisturbed = anchored_s(None);
    assert!(undisturbed >= 60.0, "{undisturbed} s");
    for (silent_us, later_s) in [(0, 0.0), (300_000, 0.0), (1_200_000, 31.2)] {
        let later = anchored_s(Some(silent_us)) - undisturbed;
        // A rest is looked at once a second.
        assert!(
            (later - later_s).abs() <= 1.0,
            "silent for {silent_us} µs: {later} s later"
        );
    }
}

/// A supply outside its limits invalidates everything that hangs on it, and says so.
#[test]
fn a_bad_supply_is_reported_and_never_measured_with() {
    let rows = rows(&[(0.0, 10.0), (10.0, 10.0)]);
    let mut board = board(&rows);
    assert!(board.run_until(|board| board.now_us > 1_000_000));
    assert!(board.measurement.current().validity.is_valid());
    for supply in [Some(Microvolts::from_millivolts(4_300)), None] {
        board.supply = supply;
        let until = board.now_us + 500_000;
        assert!(board.run_until(|board| board.now_us > until));
        assert!(
            board
                .measurement
                .diagnosis()
                .active()
                .contains(Code::SupplyOutOfRange)
        );
        assert!(
            board
                .measurement
                .current()
                .validity
                .contains(Validity::SUPPLY)
        );
        board.supply = Some(Microvolts::from_millivolts(5_000));
        let until = board.now_us + 1_500_000;
        assert!(board.run_until(|board| board.now_us > until));
        assert!(board.measurement.current().validity.is_valid());
    }
}

/// A real drive's current for so long, times 19: 400 A at its peaks.
fn us06(seconds: f64) -> Vec<Row> {
    let path = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../recordings/panasonic-18650pf/25c-us06.csv"
    );
    let mut reader = csv::Reader::from_path(path).unwrap();
    reader
        .records()
        .map(|record| {
            let record = record.unwrap();
            let number = |index: usize| record[index].parse::<f64>().unwrap();
            Row {
                t_s: number(0),
                current_a: 19.0 * number(1),
                cell_v: number(2),
            }
        })
        .take_while(|row| row.t_s < seconds)
        .collect()
}

/// A real drive with 400 A peaks and ideal sensors: whatever is reported is a false alarm.
#[test]
fn a_real_drive_raises_no_diagnosis() {
    let rows = us06(2_000.0);
    assert!(rows.len() > 19_000, "{}", rows.len());
    let mut board = board(&rows);
    let mut raised = Vec::new();
    while let Some(step) = board.step() {
        if let Step::Tick(tick) = step {
            raised.extend(tick.changes.set.iter().filter(|code| {
                // True: nothing has anchored it, and the bus says so.
                *code != Code::SocUncertain
            }));
        }
    }
    assert!(board.world.edges > 400, "{}", board.world.edges);
    assert!(raised.is_empty(), "{raised:?}");
    assert!(board.charge_error_c().abs() <= ideal_bound_c(&board, &rows));
}

/// A triangle of ±40 A with a period of 8 s: enough for every comparison of the two channels.
fn triangle() -> Vec<Row> {
    let points: Vec<(f64, f64)> = (0..16)
        .map(|i| (f64::from(i) * 4.0, if i % 2 == 0 { -40.0 } else { 40.0 }))
        .collect();
    rows(&points)
}

fn raised_within_s(mut board: HostBoard<'_>, code: Code) -> Option<f64> {
    let begin = board.now_us;
    board
        .run_until(|board| board.measurement.diagnosis().active().contains(code))
        .then(|| (board.now_us - begin) as f64 * 1e-6)
}

#[test]
fn a_meter_that_stops_counting_is_found_within_a_second() {
    let rows = triangle();
    let mut board = board(&rows);
    assert!(board.run_until(|board| board.now_us > 13_000_000));
    // The current passes 0 A at 14 s, the worst moment.
    board.frozen = true;
    let after = raised_within_s(board, Code::MeterFrozen).unwrap();
    assert!(after <= 1.0, "{after} s");
}

/// What the meter books for its offset goes on while AENERGY stands still.
#[test]
fn a_meter_with_an_offset_that_stops_counting_is_found_all_the_same() {
    let rows = rows(&[(0.0, 40.0), (30.0, 40.0)]);
    for offset_ua in [1, -530_000, 2_000_000] {
        let mut configuration = Configuration::default();
        configuration.meter.offset.small = Microamps(offset_ua);
        let mut board = HostBoard::new(&rows, Timing::default(), configuration);
        assert!(board.run_until(|board| board.now_us > 13_000_000));
        board.frozen = true;
        let after = raised_within_s(board, Code::MeterFrozen).unwrap();
        assert!(after <= 1.0, "{after} s with {offset_ua} µA");
    }
}

/// The current that the offset takes off is 0 A at the meter, which counts nothing then and is not at fault.
#[test]
fn a_meter_whose_offset_hides_the_current_is_not_called_frozen() {
    let rows = rows(&[(0.0, -5.0), (30.0, -5.0)]);
    let mut configuration = Configuration::default();
    configuration.meter.offset.small = Microamps(5_000_000);
    let mut board = HostBoard::new(&rows, Timing::default(), configuration);
    board.frozen = true;
    assert_eq!(raised_within_s(board, Code::MeterFrozen), None);
}

#[test]
fn a_converter_that_repeats_itself_is_found_by_the_meter_beside_it() {
    let rows = triangle();
    let mut board = board(&rows);
    assert!(board.run_until(|board| board.now_us > 13_000_000));
    board.stuck_code = Some(4_100);
    let after = raised_within_s(board, Code::ConverterStuck).unwrap();
    assert!(after <= 4.0, "{after} s");
}

/// A supply in V by the number of its reading.
type Supply = Box<dyn Fn(u64) -> f64>;

/// Supplies that pass 25 mV from their mean, and whether they move the factors by more than that: three readings in a row beyond it,
/// which no outlier and no fast ripple has.
fn supplies() -> Vec<(&'static str, bool, Supply)> {
    let sine = |hertz: f64, amplitude_v: f64| -> Supply {
        Box::new(move |reading| {
            let turns = hertz * reading as f64 * 0.01;
            5.0 + amplitude_v * (core::f64::consts::TAU * turns).sin()
        })
    };
    let every = |nth: u64, other_v: f64| -> Supply {
        Box::new(move |reading| if reading % nth == 0 { other_v } else { 5.0 })
    };
    let any = |reading: u64| {
        let mixed = (reading + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 40;
        5.0 + 0.06 * (mixed as f64 / f64::from(1 << 23) - 1.0)
    };
    let steps = |low_v: f64, high_v: f64| -> Supply {
        Box::new(
            move |reading| {
                if reading / 97 % 2 == 0 { low_v } else { high_v }
            },
        )
    };
    vec![
        ("steps", true, steps(4.9, 5.1)),
        ("every other reading", false, every(2, 5.06)),
        ("every fifth reading", false, every(5, 4.9)),
        ("any", false, Box::new(any)),
        ("41 Hz", false, sine(41.0, 0.06)),
        ("11 Hz", true, sine(11.0, 0.06)),
        ("3 Hz", true, sine(3.0, 0.1)),
        ("1 Hz", true, sine(1.0, 0.1)),
        ("0.3 Hz", true, sine(0.3, 0.1)),
    ]
}

/// Runs with the meter's factors as late as they may be, and with a supply that moves between two readings.
fn run_on_supply(
    board: &mut HostBoard<'_>,
    supply: &Supply,
    mut each: impl FnMut(&mut HostBoard<'_>, Tick) -> bool,
) {
    board.meter_lag = 3;
    while let Some(step) = board.step() {
        let Step::Tick(tick) = step else { continue };
        if each(board, tick) {
            return;
        }
        board.world.supply_v = supply(board.now_us / 10_000);
        board.supply = Some(Microvolts((board.world.supply_v * 1e6) as i32));
    }
}

#[test]
fn under_a_supply_that_moves_a_fault_is_found_all_the_same() {
    let rows = triangle();
    let fault_at_us = 13_000_000;
    for (name, moves_factors, supply) in supplies() {
        let found_s = |code: Code, inject: fn(&mut HostBoard<'_>)| {
            let mut found_us = None;
            let mut board = board(&rows);
            run_on_supply(&mut board, &supply, |board, tick| {
                if board.now_us >= fault_at_us {
                    inject(board);
                    found_us = tick.changes.set.contains(code).then_some(board.now_us);
                }
                found_us.is_some()
            });
            found_us.map(|us| (us - fault_at_us) as f64 * 1e-6)
        };
        let frozen = found_s(Code::MeterFrozen, |board| board.frozen = true);
        assert!(frozen.is_some_and(|s| s <= 1.0), "{name}: {frozen:?}");
        let stuck = found_s(Code::ConverterStuck, |board| board.stuck_code = Some(4_100));
        // README, limits: a meter whose factors move says nothing of how its mean does.
        assert!(
            stuck.map_or(moves_factors, |s| s <= 4.0),
            "{name}: {stuck:?}"
        );
        let missing = found_s(Code::ChannelsDisagree, |board| {
            board.stuck_code = Some(4_096);
        });
        assert!(missing.is_some_and(|s| s <= 4.0), "{name}: {missing:?}");
    }
}

#[test]
fn a_supply_that_moves_is_no_fault_of_the_channels() {
    assert_agreement(&us06(300.0), Timing::default(), Configuration::default());
}

/// 8 SPS by the slowest clock that is waited for, half as long again; a current that hides nothing of the supply.
#[test]
fn a_supply_that_moves_is_no_fault_of_the_channels_with_a_slow_converter() {
    let mut configuration = Configuration::default();
    configuration.converter.data_rate = DataRate::Sps8;
    let timing = Timing {
        conversion_s: 0.1875,
        codes: 32_768.0,
        ..Timing::default()
    };
    let rows = rows(&[(0.0, 50.0), (60.0, 50.0)]);
    assert_agreement(&rows, timing, configuration);
}

#[track_caller]
fn assert_agreement(rows: &[Row], timing: Timing, configuration: Configuration) {
    for (name, _, supply) in supplies() {
        for own_reference in [false, true] {
            let mut configuration = configuration;
            if own_reference {
                configuration.converter.supply_mode = SupplyMode::Measured;
            }
            let mut board = HostBoard::new(rows, timing, configuration);
            board.world.own_reference = own_reference;
            run_on_supply(&mut board, &supply, |board, tick| {
                let raised: Vec<_> = tick.changes.set.iter().collect();
                // Nothing has anchored it, and the bus says so.
                assert!(
                    raised.is_empty() || raised == [Code::SocUncertain],
                    "{name}, own reference {own_reference}, {} s: {raised:?} {:?}",
                    board.world.elapsed_s(),
                    board.measurement.compare_report()
                );
                false
            });
        }
    }
}

/// What floats at 2.5 V behind the switch reads like 0 A: the other channel contradicts it.
#[test]
fn a_converter_input_that_reads_like_0_amps_is_found_by_the_charge() {
    let rows = rows(&[(0.0, 20.0), (30.0, 20.0)]);
    let mut board = board(&rows);
    assert!(board.run_until(|board| board.now_us > 13_000_000));
    board.stuck_code = Some(4_096);
    let after = raised_within_s(board, Code::ChannelsDisagree).unwrap();
    assert!(after <= 3.0, "{after} s");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    /// A start: until the meter has delivered, its empty reports change neither counter nor state of charge, and then
    /// only what it has counted since is added.
    #[test]
    fn what_was_retained_stands_until_the_meter_delivers(
        total_c in -1_000_000_i64..1_000_000, remaining_c in 10_000_i64..800_000,
        charged_c in 0_i64..1_000_000, discharged_c in 0_i64..1_000_000,
        empty in 0_usize..50, counted_c in -1_000_i64..1_000,
    ) {
        let mut configuration = Configuration::default();
        configuration.soc.coulombic_efficiency = Ppm::ONE;
        let retained = RetainedState {
            charge_total: Nanocoulombs::from_coulombs(total_c),
            soc: SocRetained {
                capacity_mah: configuration.soc.capacity_mah,
                remaining: Nanocoulombs::from_coulombs(remaining_c),
                charged: Nanocoulombs::from_coulombs(charged_c),
                discharged: Nanocoulombs::from_coulombs(discharged_c),
                known: true,
                ..SocRetained::default()
            },
            key_factors: KeyFactors::NONE,
            ..RetainedState::default()
        };
        let (start, zero) = (Instant::from_ticks(0), Nanocoulombs::ZERO);
        let mut measurement = Measurement::new(&configuration, Some(&retained), zero, start);
        let history = EdgeRecorder::new(start, false).history(start);
        for tick in 0..empty {
            measurement.on_meter(&configuration, &MeterReport::default(), Validity::STALE);
            let now = Instant::from_ticks(tick as u64 * 10_000);
            measurement.tick(&configuration, now, &Vehicle::default(), &history, CodeSet::EMPTY);
            let mut now = measurement.retained(0);
            prop_assert!(now.soc.uncertainty >= zero);
            now.soc.uncertainty = zero;
            prop_assert_eq!(now, retained);
            prop_assert!(!measurement.charge().validity.is_valid());
        }
        let report = MeterReport {
            at: Some(Instant::from_ticks(1_000_000)),
            charge_total: Nanocoulombs::from_coulombs(total_c + counted_c),
            ..MeterReport::default()
        };
        measurement.on_meter(&configuration, &report, Validity::VALID);
        let now = measurement.retained(0);
        prop_assert_eq!(now.charge_total, report.charge_total);
        prop_assert_eq!(now.soc.remaining, Nanocoulombs::from_coulombs(remaining_c - counted_c));
        let throughput = now.soc.charged.saturating_add(now.soc.discharged);
        prop_assert_eq!(throughput, Nanocoulombs::from_coulombs(charged_c + discharged_c + counted_c.abs()));
    }

    /// Any profile, polling and snapshot latency: the charge on the bus is what flowed, within the budget.
    #[test]
    fn charge_is_conserved_for_any_profile(
        points in proptest::collection::vec((0.05f64..3.0, -550.0f64..550.0), 10..120),
        poll_ms in 5.0f64..200.0,
        latency_us in 20.0f64..100.0,
    ) {
        let mut t = 0.0;
        let mut profile = vec![Row { t_s: 0.0, current_a: 0.0, cell_v: 3.7 }];
        for (dt, current_a) in points {
            t += dt;
            profile.push(Row { t_s: t, current_a, cell_v: 3.7 });
        }
        let timing = Timing {
            meter_poll_s: poll_ms * 1e-3,
            snapshot_latency_s: latency_us * 1e-6,
            ..Timing::default()
        };
        let mut board = HostBoard::new(&profile, timing, Configuration::default());
        board.run();
        let (error, bound) = (board.charge_error_c(), ideal_bound_c(&board, &profile));
        prop_assert!(error.abs() <= bound, "{} C, bound {} C", error, bound);
    }

    /// F3: whatever flows in a gap, what bridges it is wrong by no more than is declared. The current changes at up to
    /// 9 kA/s, below the slew limit, and holds for longer than a conversion and a poll.
    #[test]
    fn a_gap_is_wrong_by_no_more_than_is_declared(
        points in proptest::collection::vec((0.1f64..2.0, -550.0f64..550.0, any::<bool>(), any::<bool>()), 60),
        from_ms in 0u64..4_000,
        length_ms in 0u64..10_000,
    ) {
        let (profile, dead) = (stepped(&points), from_ms * 1_000..(from_ms + length_ms) * 1_000);
        let mut board = HostBoard::new(&profile, Timing::default(), Configuration::default());
        board.meter.start(Instant::from_ticks(0));
        board.dead = dead.clone();
        let (error, declared, flowed) = over_a_gap(&mut board);
        prop_assert!(error.abs() <= declared, "{} C of {} C, {} C declared, {:?}", error, flowed, declared, dead);
    }
}

/// Currents that hold or change in proportion to the time up to the next one, in C.
fn stepped(points: &[(f64, f64, bool, bool)]) -> Vec<Row> {
    let (mut t, mut last) = (0.0, 0.0);
    let mut points_at = vec![(0.0, 0.0)];
    for &(dt, current_a, is_step, is_small) in points {
        let current_a = if is_small {
            current_a / 10.0
        } else {
            current_a
        };
        if is_step {
            t += f64::abs(current_a - last) / 9_000.0 + 1e-6;
            points_at.push((t, current_a));
            t += dt;
        } else {
            t += dt + f64::abs(current_a - last) / 9_000.0;
        }
        points_at.push((t, current_a));
        last = current_a;
    }
    rows(&points_at)
}

/// Runs for 16 s: error of the charge, what is declared of it, and what flowed, in C.
fn over_a_gap(board: &mut HostBoard<'_>) -> (f64, f64, f64) {
    board.run_until(|board| board.now_us > 16_000_000);
    // A meter that was late counts what flowed since the start.
    let report = board.meter.report();
    let was_late = report.gaps > 0 && board.dead.contains(&20_000);
    let first = board.first_reading_c.filter(|_| !was_late);
    let flowed = board.last_reading_c - first.unwrap_or(0.0);
    let counted = report.charge_total.get() as f64 * 1e-9;
    (
        counted - flowed,
        report.uncertainty.get() as f64 * 1e-9,
        flowed,
    )
}

/// F3 at 300 A until 6.5 s and 5 A from there on, the meter dead from 3 s to 7 s: the mean of the conversions at its end
/// would be 1,041 C short, with 5 C declared.
#[test]
fn a_step_inside_a_gap_is_bridged_by_what_flowed() {
    let rows = rows(&[(0.0, 300.0), (6.5, 300.0), (6.54, 5.0), (20.0, 5.0)]);
    let mut board = board(&rows);
    board.dead = 3_000_000..7_000_000;
    let (error, declared, _) = over_a_gap(&mut board);
    // The conversions that the step and the edge spoil are doubted at full scale.
    assert!(error.abs() < 12.0, "{error} C");
    assert!(error.abs() < declared && declared < 100.0, "{declared} C");
}

/// At a constant current a gap is declared as the converter's error and no more: 1 % and 1 A.
#[test]
fn a_gap_of_a_constant_current_is_declared_by_the_converters_error() {
    for (current_a, length_ms) in [
        (300.0, 4_000),
        (-300.0, 40),
        (20.0, 10_000),
        (0.0, 500),
        (50.0, 500),
    ] {
        let rows = rows(&[(0.0, current_a), (20.0, current_a)]);
        let mut board = board(&rows);
        board.dead = 3_000_000..3_000_000 + length_ms * 1_000;
        let (error, declared, _) = over_a_gap(&mut board);
        // From the last reading to the next one.
        let length_s = (length_ms + 20) as f64 * 1e-3;
        let expected = (f64::abs(current_a) * 0.01 + 1.0) * length_s;
        assert!(error.abs() <= declared, "{error} C of {declared} C");
        // The hidden bits at two changes of scale, and a count of the reading behind the gap.
        assert!(
            (expected..expected + 0.3).contains(&declared),
            "{current_a} A: {declared} C, not {expected} C"
        );
    }
}

/// A meter that is dead from the start: what flows until it counts is a gap like any other.
#[test]
fn a_meter_dead_from_the_start_has_its_gap_bridged_and_declared() {
    let rows = rows(&[(0.0, 300.0), (20.0, 300.0)]);
    let mut board = board(&rows);
    board.meter.start(Instant::from_ticks(0));
    board.dead = 0..4_000_000;
    assert!(board.run_until(|board| board.now_us > 3_900_000));
    assert!(!board.measurement.charge().validity.is_valid());
    let (error, declared, flowed) = over_a_gap(&mut board);
    assert!((flowed - 4_800.0).abs() < 10.0, "{flowed} C");
    assert!(error.abs() < 15.0, "{error} C");
    // Nothing is known of the time until the first conversion: 31 ms.
    assert!(error.abs() < declared && declared < 60.0, "{declared} C");
    assert!(board.measurement.charge().estimated);
    assert_eq!(board.meter.report().gaps, 1);
}
