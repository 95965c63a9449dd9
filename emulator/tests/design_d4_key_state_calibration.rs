//! D4 on the running image: factors by key state with the high-voltage permit held back until they are taken, and the
//! supply sweep over RS485.

use crate::support::{Bench, Ended, firmware};
use emulator::bus_view::Reading;
use emulator::mcu::rcc::ResetCause;
use emulator::rig::{Firmware, Setup};
use emulator::scenario::{Contactors, Key, Row, Scenario};
use plant::front_end::{FrontEndConfig, Sensors};
use plant::hall::{HallSensorConfig, NoiseConfig, Transfer};

/// Turns ratio of the sensor (*assumed*, as in the plant and in the firmware's factory values).
const TURNS: f64 = 2_000.0;
/// Half a code of the ADS1100 at 32 samples a second, in V.
const HALF_CODE_V: f64 = 5.0 / 8192.0 / 2.0;
/// Some noise, so that no code is repeated for long.
const NOISE_V: f64 = 0.003;
const NOISE_HZ: f64 = 5e3;
/// The rated sensor at 5 V: 2 V for 300 A.
const RATED_V_PER_A: f64 = 2.0 / 300.0;
/// A current that the meter tells from a zero error: the example's 20 mV are 3 A to this sensor, the wrong way round.
const FLOWS_A: f64 = 7.0;
/// `KeyCalibration` on CAN (docs/can.md).
const TAKEN: f64 = 2.0;
const FAILED: f64 = 3.0;
/// `command reason`: the meter sees a current.
const CURRENT_FLOWS: i64 = 3;

fn parked() -> Row {
    Row {
        key: Key::Off,
        cell_v: Some(3.7),
        ..Row::at_rest(0.0)
    }
}

/// The board with a closed-loop sensor, key OFF. A test wire goes through the same core, so that a current can flow with
/// the contactors open.
fn closed_loop(firmware: &Firmware, transfer: Transfer) -> Bench<'_> {
    let mut setup = Setup::nominal(Scenario::steady(parked(), Contactors::Permitted));
    setup.board.front_end = FrontEndConfig {
        sensors: Sensors::ClosedLoop(HallSensorConfig {
            transfer,
            coupling: 1.0,
            noise: NoiseConfig {
                rms_v: NOISE_V,
                bandwidth_hz: NOISE_HZ,
                seed: 4,
            },
            ..HallSensorConfig::closed_loop()
        }),
        ..FrontEndConfig::closed_loop()
    };
    let mut bench = Bench::new(firmware, setup);
    bench.set("front end", &[3]);
    // As a bench has found them. Exactly the rated ones would count as none.
    bench.set("closed loop: k1", &[2_666_666_600]);
    bench
}

/// D4's example: rated 2.5 V, VC1 = 2.49 V with key OFF. With key ACC the low-voltage loads shift it to VC2 = 2.48 V.
const EXAMPLE: Transfer = Transfer::ClosedLoop {
    turns: TURNS,
    k1_ohm_per_v: RATED_V_PER_A * TURNS / 5.0,
    m1_ohm: 0.0,
    k2: 0.5,
    m2_v: -0.01,
};
const SHIFT_V: f64 = -0.01;

fn permits(bench: &mut Bench<'_>) -> bool {
    bench.rig.machine.board(|board| board.permits())
}

fn closed(bench: &mut Bench<'_>) -> bool {
    bench.rig.machine.board(|board| board.scenario.closed())
}

/// A reading that nothing stands against, in A.
#[track_caller]
fn valid_a(bench: &Bench<'_>, reading: Reading) -> f64 {
    reading.valid().unwrap_or_else(|| {
        panic!(
            "{reading:?}, active {:?}",
            bench.rig.view.active_diagnoses()
        )
    })
}

/// A current through the core with key OFF, until the meter's mean shows it.
fn flows_while_off(bench: &mut Bench<'_>) {
    // From the factory it is over a second.
    bench.set("meter: mean window", &[200]);
    // Room for the example's own zero error.
    bench.set("key calibration: current", &[3_500_000]);
    bench.run(0.3);
    bench.vehicle(Row {
        aux_current_a: FLOWS_A,
        ..parked()
    });
    bench.run(0.7);
}

#[test]
fn permit_waits_for_both_factors_and_acc_then_reads_0_a() {
    let firmware = firmware();
    let mut bench = closed_loop(&firmware, EXAMPLE);
    bench.run(1.5);
    assert!(!permits(&mut bench), "no permit with key OFF");
    let uncorrected_a = bench.rig.view.current_a().value.unwrap();

    let acc = Row {
        key: Key::Accessory,
        output_shift_v: SHIFT_V,
        ..parked()
    };
    bench.vehicle(acc);
    let delay_s = bench.until("the permit", 2.0, |rig| {
        rig.machine.board(|board| board.permits())
    });
    // 0.2 s of settling and 16 conversions; 1.5 s at the longest.
    assert!((0.2 + 15.0 / 32.0..1.5).contains(&delay_s), "{delay_s} s");
    bench.run(0.1);
    assert_eq!(bench.signal("BoardState", "KeyCalibration"), TAKEN);
    let k = bench.settings("key factor k")[0] as f64 * 1e-9;
    let a_v = bench.settings("key factor a")[0] as f64 * 1e-6;
    println!(
        "D4: permit {delay_s:.3} s after ACC; k = {k:.6} (2.5/2.49 = {:.6}), a = {:.2} mV",
        2.5 / 2.49,
        a_v * 1e3
    );
    assert!((k - 2.5 / 2.49).abs() <= HALF_CODE_V / 2.49 * 1.01, "{k}");
    assert!((a_v - 0.01).abs() <= 2.0 * HALF_CODE_V, "{a_v}");

    bench.run(1.5);
    let reading = bench.rig.view.average_a();
    let acc_a = valid_a(&bench, reading);
    let meter = bench.rig.view.meter_current_a();
    println!(
        "D4: {uncorrected_a:+.3} A before, {acc_a:+.3} A in ACC, {:?} A by the meter",
        meter.value
    );
    assert!(
        acc_a.abs() <= 2.0 * HALF_CODE_V / RATED_V_PER_A,
        "{reading:?}"
    );
    // Its own count in a second is 300 A / 8,949.
    assert!(
        meter.valid().unwrap().abs() <= 2.0 * HALF_CODE_V / RATED_V_PER_A + 0.034,
        "{meter:?}"
    );
    assert!(!closed(&mut bench), "high voltage waits for key ON");

    for amps in [100.0, -200.0] {
        bench.vehicle(Row {
            key: Key::On,
            current_a: amps,
            ..acc
        });
        bench.until("high voltage", 1.0, |rig| {
            rig.machine.board(|board| board.scenario.closed())
        });
        bench.run(1.0);
        let reading = bench.rig.view.average_a();
        let found_a = valid_a(&bench, reading);
        // D4 with these factors and the rated relations: k·(V + a) = V0 + I·s, and V = VC2 + I·s.
        let method_a = 2.5 / 2.49 * amps;
        println!(
            "D4: {found_a:+.3} A at {amps} A; the method itself gives {method_a:+.3} A, its k takes the zero for the gain"
        );
        // Codes of VC1, VC2 and V.
        assert!(
            (found_a - method_a).abs() <= 3.2 * HALF_CODE_V / RATED_V_PER_A,
            "{reading:?}"
        );
    }
    let complaints = bench.complaints(&["SocUncertain"]);
    assert!(complaints.is_empty(), "{complaints:?}");
}

/// The zero output of a sensor whose relations a sweep has found, at a supply that is not 5 V: 2.5 V it is nowhere.
#[test]
fn at_another_supply_and_with_swept_relations_acc_reads_0_a() {
    let (k1, k2, m2) = (2.666_666_6, 0.495, 0.02);
    let firmware = firmware();
    for supply_v in [4.8, 5.2] {
        let mut bench = closed_loop(
            &firmware,
            Transfer::ClosedLoop {
                turns: TURNS,
                k1_ohm_per_v: k1,
                m1_ohm: 0.0,
                k2,
                m2_v: m2,
            },
        );
        bench.set("closed loop: k2", &[495_000_000]);
        bench.set("closed loop: m2", &[20_000_000]);
        let off = Row {
            sensor_supply_v: supply_v,
            converter_supply_v: supply_v,
            ..parked()
        };
        bench.vehicle(off);
        bench.run(1.5);
        bench.vehicle(Row {
            key: Key::Accessory,
            output_shift_v: SHIFT_V,
            ..off
        });
        bench.run(3.0);
        assert_eq!(bench.signal("BoardState", "KeyCalibration"), TAKEN);
        let k = bench.settings("key factor k")[0] as f64 * 1e-9;
        let reading = bench.rig.view.average_a();
        let acc_a = valid_a(&bench, reading);
        let meter = bench.rig.view.meter_current_a();
        println!("D4: {supply_v} V: k = {k:.6}, {acc_a:+.3} A in ACC, {meter:?} by the meter");
        assert!((k - 1.0).abs() <= HALF_CODE_V / 2.4, "{k}");
        let bound_a = 2.0 * HALF_CODE_V / RATED_V_PER_A * 5.0 / supply_v;
        assert!(acc_a.abs() <= bound_a, "{reading:?}");
        assert!(meter.valid().unwrap().abs() <= bound_a + 0.034, "{meter:?}");
    }
}

#[test]
fn while_current_flows_the_permit_is_held_until_the_factors_are_taken() {
    let firmware = firmware();
    let mut bench = closed_loop(&firmware, EXAMPLE);
    // Hold the permit, however long it takes.
    bench.set("key calibration: on failure", &[1]);
    bench.run(1.5);
    let on = Row {
        key: Key::On,
        output_shift_v: SHIFT_V,
        ..parked()
    };
    flows_while_off(&mut bench);
    bench.vehicle(Row {
        aux_current_a: FLOWS_A,
        ..on
    });
    bench.run(2.5);
    assert!(!permits(&mut bench) && !closed(&mut bench));
    assert_eq!(bench.signal("BoardState", "KeyCalibration"), FAILED);
    assert_eq!(bench.signal("BoardState", "HighVoltagePermit"), 0.0);
    assert!(
        bench
            .rig
            .view
            .active_diagnoses()
            .contains(&"KeyCalibrationFailed"),
        "{:?}",
        bench.rig.view.active_diagnoses()
    );
    bench.vehicle(on);
    let taken_s = bench.until("the permit", 4.0, |rig| {
        rig.machine.board(|board| board.permits())
    });
    println!(
        "D4: held for 2.5 s with {FLOWS_A} A flowing; permitted {taken_s:.3} s after they have gone"
    );
    assert!(taken_s >= 15.0 / 32.0, "{taken_s} s");
    bench.run(0.3);
    assert_eq!(bench.signal("BoardState", "KeyCalibration"), TAKEN);
    assert!(closed(&mut bench));
}

#[test]
fn calibration_by_command_fails_with_its_reason_when_current_flows() {
    let firmware = firmware();
    let mut bench = closed_loop(&firmware, EXAMPLE);
    bench.run(1.5);
    flows_while_off(&mut bench);
    bench.try_command("start key calibration").unwrap();
    bench.run(0.2);
    bench.vehicle(Row {
        key: Key::Accessory,
        aux_current_a: FLOWS_A,
        ..parked()
    });
    bench.run(2.0);
    assert_eq!(bench.signal("BoardState", "KeyCalibration"), FAILED);
    // As from the factory it permits with the previous factors, so that nobody is stranded.
    assert!(permits(&mut bench));
    assert_eq!(bench.settings("key factor a"), [0]);
    let ended = (bench.input("command state"), bench.input("command reason"));
    println!("D4: command state and reason with {FLOWS_A} A flowing: {ended:?}");
    assert_eq!(ended, (3, CURRENT_FLOWS));
}

/// The factors would take it for the zero, and the board would be wrong by as much until the next key cycle.
#[test]
fn current_that_begins_with_the_key_is_not_taken_for_the_zero() {
    let firmware = firmware();
    let mut bench = closed_loop(&firmware, EXAMPLE);
    bench.run(1.5);
    bench.vehicle(Row {
        key: Key::Accessory,
        aux_current_a: FLOWS_A,
        output_shift_v: SHIFT_V,
        ..parked()
    });
    bench.run(2.5);
    let (state, a_uv) = (
        bench.signal("BoardState", "KeyCalibration"),
        bench.settings("key factor a")[0],
    );
    println!(
        "D4: with {FLOWS_A} A from ACC on: state {state}, a = {a_uv} µV, {:?}",
        bench.rig.view.average_a()
    );
    assert_eq!((state, a_uv), (FAILED, 0));
}

#[test]
fn supply_sweep_over_rs485_finds_the_relations() {
    let (k1, m1, k2, m2) = (2.60, 0.30, 0.495, 0.02);
    let firmware = firmware();
    let mut bench = closed_loop(
        &firmware,
        Transfer::ClosedLoop {
            turns: TURNS,
            k1_ohm_per_v: k1,
            m1_ohm: m1,
            k2,
            m2_v: m2,
        },
    );
    const TEST_A: f64 = 200.0;
    bench.set("supply calibration: test current", &[200_000_000]);
    // What the zero was corrected by before the sweep: the relations hold all of it.
    bench.set("zero drift", &[-2_000_000, 0]);
    bench.set("key factor k", &[1_004_000_000]);
    bench.set("key factor a", &[10_000]);
    let at = |supply_v: f64, amps: f64| Row {
        sensor_supply_v: supply_v,
        converter_supply_v: supply_v,
        aux_current_a: amps,
        ..parked()
    };
    // The supply is averaged with a time constant of 0.16 s.
    const SETTLED_S: f64 = 1.2;
    let supplies_v = [4.55, 4.75, 5.0, 5.25, 5.45];
    for (command, amps) in [
        ("supply point at 0 A", 0.0),
        ("supply point at the test current", TEST_A),
    ] {
        for supply_v in supplies_v {
            bench.vehicle(at(supply_v, amps));
            bench.run(SETTLED_S);
            assert_eq!(bench.command(command, 1.0), Ended::Done, "{supply_v} V");
        }
    }
    assert_eq!(bench.inputs("supply points"), [5, 5]);
    assert_eq!(bench.input("calibration under way"), 3);
    assert_eq!(bench.command("finish supply calibration", 1.0), Ended::Done);
    bench.run(0.1);
    let found = ["k1", "m1", "k2", "m2"]
        .map(|name| bench.settings(&format!("closed loop: {name}"))[0] as f64 * 1e-9);
    println!(
        "D4: k1, m1, k2, m2 = {found:.4?}, in the sensor {:?}",
        [k1, m1, k2, m2]
    );

    // One point is good to half a code, which grows with the supply as the reference does.
    let point_v = HALF_CODE_V * 5.5 / 5.0;
    let mean_v = supplies_v.iter().sum::<f64>() / supplies_v.len() as f64;
    let (spread, squares) = supplies_v
        .iter()
        .fold((0.0, 0.0), |(sum, squares), supply_v| {
            let off: f64 = supply_v - mean_v;
            (sum + off.abs(), squares + off * off)
        });
    // The worst that errors of ±point_v at every point do to a least-squares slope.
    let slope = point_v * spread / squares;
    assert!((found[2] - k2).abs() <= slope, "k2 {} ± {slope}", found[2]);
    assert!(
        (found[3] - m2).abs() <= slope * mean_v + point_v,
        "m2 {}",
        found[3]
    );
    assert!(
        (found[0] - k1).abs() <= 2.0 * slope * TURNS / TEST_A,
        "k1 {}",
        found[0]
    );
    assert!(
        (found[1] - m1).abs() <= 2.0 * (slope * mean_v + point_v) * TURNS / TEST_A,
        "m1 {}",
        found[1]
    );

    // And with them it measures at other supplies, after a reset too.
    assert_eq!(bench.command("save", 2.0), Ended::Done);
    bench.vehicle(at(4.7, 0.0));
    bench.rig.machine.reset(ResetCause::Software);
    bench.settle();
    let mut worst_a = 0.0_f64;
    for (supply_v, amps) in [(4.7, 150.0), (5.3, -80.0), (5.1, 0.0)] {
        // While the supply moves the meter's correction is behind it: no current then.
        bench.vehicle(at(supply_v, 0.0));
        bench.run(SETTLED_S);
        bench.vehicle(at(supply_v, amps));
        bench.run(0.6);
        let reading = bench.rig.view.average_a();
        let found_a = valid_a(&bench, reading);
        // Within the sweep a line is off by less than 1.5 points; twice that for the difference of the two lines.
        let sensitivity = (k1 * supply_v + m1) / TURNS;
        let bound_a = point_v * (2.5 + 3.0 * f64::abs(amps) / TEST_A) / sensitivity;
        println!("D4: {found_a:+.3} A at {amps} A and {supply_v} V, bound {bound_a:.3} A");
        worst_a = worst_a.max((found_a - amps).abs());
        assert!((found_a - amps).abs() <= bound_a, "{reading:?}");
    }
    println!("D4: {worst_a:.3} A off at most after the sweep");
}
