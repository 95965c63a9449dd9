//! D2 on the running image: HAH1BV, ADS1100, zero drift set over RS485, sliding average on CAN; what is set survives a
//! reset and a power cycle.

use crate::support::{Bench, Ended, firmware};
use emulator::mcu::rcc::ResetCause;
use emulator::rig::{Firmware, Setup};
use emulator::scenario::{Contactors, Key, Row, Scenario};
use plant::front_end::{FrontEndConfig, Sensors};
use plant::hall::{HallSensorConfig, NoiseConfig};
use rmodbus::ErrorKind;

/// 4 mV per ampere (D2).
const V_PER_A: f64 = 0.004;
/// Half a code of the ADS1100 at 32 samples a second: 5 V in 2¹³ steps.
const HALF_CODE_A: f64 = 5.0 / 8192.0 / 2.0 / V_PER_A;
/// Last digit of a frame, and of a register.
const ROUNDING_A: f64 = 0.001;
/// `command state`: refused or failed.
const FAILED: i64 = 3;
/// `command reason`: the front end in use has no such calibration.
const NOT_FOR_THIS_FRONT_END: i64 = 10;
/// `command reason`: the meter sees a current.
const CURRENT_FLOWS: i64 = 3;

/// A parked car whose battery management is awake.
fn parked() -> Row {
    Row {
        key: Key::Off,
        cell_v: Some(3.7),
        ..Row::at_rest(0.0)
    }
}

/// The board with an HAH1BV in place of D0's sensors, key OFF. A neighbouring conductor goes through the same core: a
/// current that flows although the contactors are open.
fn hah1bv(firmware: &Firmware, noise_v: f64) -> Bench<'_> {
    let mut setup = Setup::nominal(Scenario::steady(parked(), Contactors::Permitted));
    setup.board.front_end = FrontEndConfig {
        sensors: Sensors::Hah1bv(HallSensorConfig {
            coupling: 1.0,
            noise: NoiseConfig {
                rms_v: noise_v,
                bandwidth_hz: 5e3,
                seed: 2,
            },
            ..HallSensorConfig::hah1bv()
        }),
        ..FrontEndConfig::hah1bv()
    };
    let mut bench = Bench::new(firmware, setup);
    bench.set("front end", &[1]);
    bench
}

/// The average on CAN, valid.
#[track_caller]
fn average_a(bench: &Bench<'_>) -> f64 {
    let reading = bench.rig.view.average_a();
    reading.valid().unwrap_or_else(|| {
        panic!(
            "{reading:?}, active {:?}",
            bench.rig.view.active_diagnoses()
        )
    })
}

/// The average once the window holds nothing older than now.
#[track_caller]
fn settled_average_a(bench: &mut Bench<'_>) -> f64 {
    bench.run(0.8);
    average_a(bench)
}

#[track_caller]
fn assert_near(what: &str, found_a: f64, expected_a: f64, bound_a: f64) {
    assert!(
        (found_a - expected_a).abs() <= bound_a,
        "{what}: {found_a} A instead of {expected_a} A ± {bound_a} A"
    );
}

#[test]
fn zero_now_takes_the_zero_error_and_survives_reset_and_power_cycle() {
    let firmware = firmware();
    let mut bench = hah1bv(&firmware, 0.0);
    // The key-state factors are D4's.
    bench.set("key calibration: enabled", &[0]);
    bench.set("zero drift: samples", &[32]);
    bench.set("average: length", &[16]);
    bench.run(1.0);
    assert_eq!(
        bench.signal("CurrentAverage", "CurrentAverageSamples"),
        16.0
    );
    let span_s = bench.signal("CurrentAverage", "CurrentAverageSpan") * 1e-3;
    assert!(
        (span_s - 0.5).abs() < 0.04,
        "16 conversions take half a second: {span_s} s"
    );

    // What a HAH1BV's zero is off, 40 mA to 2 A.
    let mut last_a = 0.0;
    for zero_a in [0.04, -0.6, 2.0] {
        bench.vehicle(Row {
            output_shift_v: zero_a * V_PER_A,
            ..parked()
        });
        let before_a = settled_average_a(&mut bench);
        // Less what was taken as zero before.
        assert_near(
            "before",
            before_a + last_a,
            zero_a,
            HALF_CODE_A + ROUNDING_A,
        );
        assert_eq!(bench.command("zero now", 5.0), Ended::Done);
        let drift_a = bench.settings("zero drift")[0] as f64 * 1e-6;
        let after_a = settled_average_a(&mut bench);
        println!(
            "D2: zero error {zero_a} A: average {before_a:+.3} A before, {after_a:+.3} A after; zero drift {drift_a:+.3} A"
        );
        assert_near("zero drift", drift_a, zero_a, HALF_CODE_A + ROUNDING_A);
        assert_near("after", after_a, 0.0, ROUNDING_A);
        last_a = drift_a;
    }
    assert_eq!(bench.input("configuration saved"), 0);
    assert_eq!(bench.command("save", 2.0), Ended::Done);
    assert_eq!(bench.input("configuration saved"), 1);

    // A zero that nobody has saved.
    bench.vehicle(Row {
        output_shift_v: 1.0 * V_PER_A,
        ..parked()
    });
    bench.run(0.8);
    assert_eq!(bench.command("zero now", 5.0), Ended::Done);
    bench.vehicle(Row {
        output_shift_v: 2.0 * V_PER_A,
        ..parked()
    });
    let unsaved_a = settled_average_a(&mut bench);
    assert_near(
        "with an unsaved zero",
        unsaved_a,
        1.0,
        2.0 * HALF_CODE_A + ROUNDING_A,
    );

    for how in ["reset", "power cycle"] {
        if how == "reset" {
            bench.rig.machine.reset(ResetCause::Software);
        } else {
            bench.rig.power_cycle();
        }
        let reset_at = bench.rig.machine.now();
        bench.run(0.8);
        assert_eq!(bench.settings("front end"), [1], "{how}");
        assert_eq!(bench.settings("average: length"), [16], "{how}");
        assert_near(
            how,
            bench.settings("zero drift")[0] as f64 * 1e-6,
            last_a,
            ROUNDING_A,
        );
        assert!(bench.rig.view.last_at("CurrentAverage").unwrap() > reset_at);
        let average_a = settled_average_a(&mut bench);
        println!("D2: average {average_a:+.3} A after a {how}");
        assert_near(how, average_a, 0.0, ROUNDING_A);
    }

    // And it is the right zero for a current.
    // From one to the other by way of rest: 350 A between two conversions is more than is believed at once.
    for amps in [100.0, 0.0, -250.0] {
        bench.vehicle(Row {
            key: Key::On,
            current_a: amps,
            output_shift_v: 2.0 * V_PER_A,
            ..parked()
        });
        bench.run(0.5);
        assert!(
            bench.row().current_a == amps
                && bench.rig.machine.board(|board| board.scenario.closed())
        );
        let average_a = settled_average_a(&mut bench);
        println!("D2: average {average_a:+.3} A at {amps} A");
        assert_near(
            "on the road",
            average_a,
            amps,
            2.0 * HALF_CODE_A + ROUNDING_A,
        );
        // Its mean is over a second.
        bench.run(1.3);
        let meter_a = bench.rig.view.meter_current_a();
        assert!(
            (meter_a.valid().unwrap() - amps).abs() < 0.2,
            "the meter counts with the same zero: {meter_a:?}"
        );
    }
    let complaints = bench.complaints(&["SocUncertain", "ChargeRestoredWithLoss"]);
    assert!(complaints.is_empty(), "{complaints:?}");
}

#[test]
fn zero_now_is_refused_while_current_flows_and_while_high_voltage_is_on() {
    let firmware = firmware();
    let mut bench = hah1bv(&firmware, 0.0);
    let before = bench.settings("zero drift");
    bench.vehicle(Row {
        aux_current_a: 10.0,
        ..parked()
    });
    bench.run(1.5);
    // Known at once, so the answer says it; the reason is in the registers.
    for (command, reason) in [
        ("zero now", CURRENT_FLOWS),
        ("supply point at 0 A", NOT_FOR_THIS_FRONT_END),
    ] {
        assert_eq!(
            bench.try_command(command),
            Err(ErrorKind::SlaveDeviceFailure)
        );
        let ended = (bench.input("command state"), bench.input("command reason"));
        assert_eq!(ended, (FAILED, reason), "{command}");
    }
    assert_eq!(bench.settings("zero drift"), before);

    bench.vehicle(Row {
        key: Key::On,
        ..parked()
    });
    bench.until("high voltage", 3.0, |rig| {
        rig.machine.board(|board| board.scenario.closed())
    });
    bench.run(0.2);
    // 04, server device failure: docs/modbus.md, Exceptions.
    assert_eq!(
        bench.try_command("zero now"),
        Err(ErrorKind::SlaveDeviceFailure)
    );
    assert_eq!(
        bench.try_set("zero drift", &[100_000, 0]),
        Err(ErrorKind::SlaveDeviceFailure)
    );
    assert_eq!(bench.settings("zero drift"), before);
    println!(
        "D2: refused with 10 A through the core (reason {CURRENT_FLOWS}) and with high voltage on (exception 04)"
    );

    // A zero drift beyond its limit is no setting either.
    bench.vehicle(parked());
    bench.run(0.5);
    assert_eq!(
        bench.try_set("zero drift", &[6_000_001, 0]),
        Err(ErrorKind::IllegalDataValue)
    );
    bench.set("zero drift", &[250_000, 0]);
    let average_a = settled_average_a(&mut bench);
    assert_near("set by hand", average_a, -0.25, HALF_CODE_A + ROUNDING_A);
}

/// Both correct the zero: the one must not do it again after the other.
#[test]
fn zero_drift_and_key_factors_together_correct_the_zero_once() {
    let firmware = firmware();
    // Some noise, so that no code is repeated for long.
    let mut bench = hah1bv(&firmware, 0.005);
    assert_eq!(
        bench.settings("key calibration: enabled"),
        [1],
        "as from the factory"
    );
    let row = Row {
        output_shift_v: 2.0 * V_PER_A,
        ..parked()
    };
    bench.vehicle(row);
    bench.run(1.5);
    assert_eq!(bench.command("zero now", 5.0), Ended::Done);
    bench.run(1.0);
    bench.vehicle(row.with_key(Key::On));
    bench.until("high voltage", 3.0, |rig| {
        rig.machine.board(|board| board.scenario.closed())
    });
    let average_a = settled_average_a(&mut bench);
    println!(
        "D2: {average_a:+.3} A at 0 A with a zero drift of 2 A and key factors k = {} ppb, a = {} µV",
        bench.settings("key factor k")[0],
        bench.settings("key factor a")[0]
    );
    assert_near("at 0 A", average_a, 0.0, 2.0 * HALF_CODE_A + ROUNDING_A);
}
