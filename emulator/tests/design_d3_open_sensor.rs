//! D3 on the running image: a sensor that comes off, told from one that reads a current.

use crate::support::{Bench, Ended, firmware};
use emulator::bus_view::validity;
use emulator::mcu::rcc::ResetCause;
use emulator::rig::{Firmware, Setup};
use emulator::scenario::{Contactors, Key, Row, Scenario};
use plant::front_end::{Faults, FrontEndConfig, SensorFault};
use plant::network::NetworkConfig;

/// The state of the key-state calibration on CAN.
const TAKEN: f64 = 2.0;

fn at_rest() -> Row {
    Row {
        cell_v: Some(3.7),
        ..Row::at_rest(0.0)
    }
}

fn set_faults(bench: &mut Bench<'_>, faults: Faults) {
    bench
        .rig
        .machine
        .board(|board| board.front_end.set_faults(faults));
}

const SMALL_OPEN: Faults = Faults {
    small: SensorFault::Open,
    ..NO_FAULT
};
const NO_FAULT: Faults = Faults {
    small: SensorFault::None,
    large: SensorFault::None,
    gate: plant::comparator::GateOverride::None,
    flag_line: None,
};

/// Time until the frame `Current` marks the sensor as open, in s.
#[track_caller]
fn until_open(bench: &mut Bench<'_>) -> f64 {
    bench.until("the open bit", 1.0, |rig| {
        rig.view.current_a().validity & validity::OPEN != 0
    })
}

/// Time until a diagnosis is active on CAN, in s.
#[track_caller]
fn until_active(bench: &mut Bench<'_>, name: &str, limit_s: f64) -> f64 {
    bench.until(name, limit_s, |rig| {
        rig.view.active_diagnoses().contains(&name)
    })
}

/// D3's own sensor on ±15 V, read through the network; key ON, high voltage on.
fn network_board(firmware: &Firmware, network: NetworkConfig) -> Bench<'_> {
    let parked = at_rest().with_key(Key::Off);
    let mut setup = Setup::nominal(Scenario::steady(parked, Contactors::Permitted));
    setup.board.front_end = FrontEndConfig {
        network,
        ..FrontEndConfig::network()
    };
    let mut bench = Bench::new(firmware, setup);
    bench.set("front end", &[2]);
    // D4's factors are not for it.
    bench.set("key calibration: enabled", &[0]);
    // What it has measured with the factory's front end is nothing to go on from.
    assert_eq!(bench.command("save", 2.0), Ended::Done);
    bench.rig.machine.reset(ResetCause::Software);
    bench.settle();
    bench.vehicle(at_rest());
    bench.until("high voltage", 1.0, |rig| {
        rig.machine.board(|board| board.scenario.closed())
    });
    bench
}

#[test]
fn open_sensor_is_found_within_two_readings_and_no_legal_level_is_taken_for_one() {
    let firmware = firmware();
    let mut bench = network_board(&firmware, NetworkConfig::default());

    // The whole span, slowly.
    let rows: Vec<Row> = [(0.0, 0.0), (0.6, 495.0), (1.8, -495.0), (2.4, 0.0)]
        .map(|(t_s, amps)| Row { t_s, ..at_rest() }.with_current(amps))
        .to_vec();
    bench.record();
    bench.drive(&rows);
    let readings = bench.conversions();
    let (low_a, high_a) = readings
        .iter()
        .fold((0.0_f64, 0.0_f64), |(low, high), frame| {
            assert_eq!(frame.validity, validity::VALID, "{frame:?}");
            let amps = frame.current_a.unwrap();
            (low.min(amps), high.max(amps))
        });
    assert!(low_a < -480.0 && high_a > 480.0, "{low_a} … {high_a} A");
    let complaints = bench.complaints(&["SocUncertain", "ChargeRestoredWithLoss"]);
    assert!(
        complaints.is_empty(),
        "no legal level is taken for a fault: {complaints:?}"
    );
    println!(
        "D3: {} readings from {low_a:.1} to {high_a:.1} A, all valid",
        readings.len()
    );

    // Between two codes of ADC1, 0.45 A each (3.3 V / 4,096 at 1.8 mV/A): the meter counts what the network does not show, for longer than both windows.
    bench.vehicle(at_rest().with_current(0.2));
    bench.run(25.0);
    let complaints = bench.complaints(&["SocUncertain", "ChargeRestoredWithLoss"]);
    assert!(complaints.is_empty(), "{complaints:?}");

    // 100 A flow, and the sensor comes off.
    bench.vehicle(at_rest().with_current(100.0));
    bench.run(1.0);
    set_faults(&mut bench, SMALL_OPEN);
    let found_s = until_open(&mut bench);
    // Two readings of 10 ms, the way into the frame of the next 10 ms, and its transmission.
    assert!(found_s <= 0.031, "found after {found_s} s");
    assert_eq!(
        bench.rig.view.current_a().value,
        None,
        "no number for a sensor that is not there"
    );
    let reported_s = found_s + until_active(&mut bench, "OpenSensor", 0.2);
    let network_v = bench.input("network voltage") as f64 * 1e-6;
    println!(
        "D3: open after {:.0} ms in Current, {:.0} ms in DiagnosisActive; the network gives {network_v:.3} V",
        found_s * 1e3,
        reported_s * 1e3
    );
    // D3: +0.15 V. ADC1 has 4,096 steps of 3.3 V.
    assert!((network_v - 0.148).abs() < 0.003, "{network_v} V");
    let charge = bench.rig.view.charge_c();
    assert_ne!(
        charge.validity & validity::OPEN,
        0,
        "the meter hangs on the same sensor: {charge:?}"
    );

    // And is put back.
    set_faults(&mut bench, NO_FAULT);
    let back_s = bench.until("a valid current", 3.0, |rig| {
        rig.view.current_a().valid().is_some()
    });
    println!(
        "D3: valid again {:.2} s after the sensor was put back",
        back_s
    );
    let amps = bench.rig.view.current_a().value.unwrap();
    assert!((amps - 100.0).abs() < 1.0, "{amps} A");
}

/// Readings of so many seconds, in A.
fn readings_a(bench: &mut Bench<'_>, seconds: f64) -> Vec<f64> {
    bench.record();
    bench.run(seconds);
    let frames = bench.conversions();
    frames
        .iter()
        .map(|frame| frame.current_a.unwrap())
        .collect()
}

/// ADC1 with a code of noise, rms: 0.45 A of each conversion of the network and 0.61 A of each of the reference.
#[test]
fn a_noisy_converter_is_averaged_and_still_calibrated() {
    let firmware = firmware();
    let mut bench = network_board(&firmware, NetworkConfig::default());
    bench.rig.machine.adc(|adc| adc.set_noise_codes(1.0));
    // Key OFF, as for a calibration; the battery settles within seconds.
    bench.vehicle(at_rest().with_key(Key::Off));
    bench.run(2.0);
    bench.set("capacity", &[1_000]);
    bench.set("stability window", &[10]);
    bench.set("rest time", &[60]);

    let readings = readings_a(&mut bench, 10.0);
    let count = readings.len() as f64;
    let mean = readings.iter().sum::<f64>() / count;
    let deviation_a =
        (readings.iter().map(|a| (a - mean).powi(2)).sum::<f64>() / (count - 1.0)).sqrt();
    println!("D3: {deviation_a:.3} A rms of {count} readings, mean {mean:+.3} A");
    assert!(count > 900.0, "{count}");
    assert!(deviation_a <= 0.3, "{deviation_a} A");

    assert_eq!(bench.command("zero now", 3.0), Ended::Done);
    // A reading of more than the 1 A of `rest current` would have ended the rest: at 100 readings a second there are 6,000.
    bench.run(65.0);
    assert_eq!(bench.input("anchorings"), 1);
}

/// D4's factors of D3's sensor: with key OFF and with key ACC 16 readings are averaged, which ADC1's noise spreads.
#[test]
fn key_factors_are_taken_through_the_noise() {
    const CYCLES: usize = 10;
    const NOISE_CODES: f64 = 1.5;
    let firmware = firmware();
    let mut bench = network_board(&firmware, NetworkConfig::default());
    bench.vehicle(at_rest().with_key(Key::Off));
    bench.run(2.0);
    bench.set("key calibration: enabled", &[1]);
    bench
        .rig
        .machine
        .adc(|adc| adc.set_noise_codes(NOISE_CODES));
    let mut taken = 0;
    let mut zeros_a = Vec::new();
    for _ in 0..CYCLES {
        bench.vehicle(at_rest().with_key(Key::Off));
        bench.run(1.0);
        bench.vehicle(at_rest().with_key(Key::Accessory));
        // Beyond the longest delay of the permit.
        bench.run(1.6);
        taken += usize::from(bench.signal("BoardState", "KeyCalibration") == TAKEN);
        let readings = readings_a(&mut bench, 1.0);
        zeros_a.push(readings.iter().sum::<f64>() / readings.len() as f64);
    }
    let largest_a = zeros_a.iter().fold(0.0f64, |most, a| most.max(a.abs()));
    println!(
        "D3: {NOISE_CODES} codes of noise: {taken} of {CYCLES} taken, 0 A is off by up to {largest_a:.2} A"
    );
    assert_eq!(taken, CYCLES);
    // Of a reading's 0.26 A with a code of noise 0.11 A are the reference's, alike in neighbours; four standard deviations.
    let of_16_a = NOISE_CODES * (0.235f64.powi(2) / 16.0 + 0.11f64.powi(2)).sqrt();
    assert!(largest_a <= 4.0 * of_16_a, "{zeros_a:?}");
}

#[test]
fn without_the_pull_down_an_open_sensor_reads_like_a_current() {
    let firmware = firmware();
    let mut bench = network_board(
        &firmware,
        NetworkConfig {
            pull_down_ohm: f64::INFINITY,
            ..NetworkConfig::default()
        },
    );
    set_faults(&mut bench, SMALL_OPEN);
    bench.run(0.5);
    let network_v = bench.input("network voltage") as f64 * 1e-6;
    let reading = bench.rig.view.current_a();
    println!("D3: without R6 and R7 the open sensor gives {network_v:.3} V and reads {reading:?}");
    assert!(
        (network_v - 2.02).abs() < 0.005,
        "D3: 2 V, not {network_v} V"
    );
    assert!(
        reading.validity & validity::OPEN == 0,
        "this is what R6 and R7 are for: {reading:?}"
    );
}

#[test]
fn with_the_small_sensor_open_the_large_one_measures() {
    let firmware = firmware();
    let row = at_rest().with_current(30.0);
    let mut bench = Bench::nominal(&firmware, row, Contactors::AlwaysClosed);
    set_faults(&mut bench, SMALL_OPEN);
    // Its follower is at 0 V: the negative comparator trips and the switch passes the large sensor.
    let found_s = until_active(&mut bench, "SmallSensorOpen", 0.5);
    bench.run(1.0);
    assert_eq!(bench.signal("BoardState", "Range"), 1.0);
    let reading = bench.rig.view.current_a();
    println!(
        "D3: small sensor open: reported after {:.0} ms, then {reading:?} at 30 A",
        found_s * 1e3
    );
    // Half a code of the large sensor, and the last digit of a frame.
    let amps = reading
        .valid()
        .unwrap_or_else(|| panic!("{reading:?}, {:?}", bench.complaints(&[])));
    assert!((amps - 30.0).abs() <= 0.082, "{amps} A");
    assert!(
        found_s <= 0.15,
        "two readings and a frame every 100 ms: {found_s} s"
    );
    let charge_0 = (bench.charge_c(), bench.rig.truth().charge_c);
    bench.run(2.0);
    let charge_1 = (bench.charge_c(), bench.rig.truth().charge_c);
    let error_c = (charge_1.0 - charge_0.0) - (charge_1.1 - charge_0.1);
    println!("D3: {error_c:+.3} C off after 2 s at 30 A on the large sensor");
    // Frames are up to 0.1 s old at 30 A, at both ends.
    assert!(error_c.abs() <= 3.2, "{error_c} C");
    let complaints = bench.complaints(&["SocUncertain", "SmallSensorOpen"]);
    assert!(complaints.is_empty(), "{complaints:?}");
}

/// What D3 cannot see: an output near half the supply. The other sensor can, where it measures.
#[test]
fn output_near_half_the_supply_is_found_by_the_other_sensor() {
    let firmware = firmware();
    let row = at_rest().with_current(150.0);
    let mut bench = Bench::nominal(&firmware, row, Contactors::AlwaysClosed);
    assert_eq!(bench.signal("BoardState", "Range"), 1.0);
    set_faults(
        &mut bench,
        Faults {
            large: SensorFault::Forced(2.5),
            ..NO_FAULT
        },
    );
    let found_s = until_active(&mut bench, "FlagImplausible", 1.0);
    println!(
        "D3: large sensor at 2.5 V with 150 A: the small one contradicts it, on CAN after {:.0} ms",
        found_s * 1e3
    );
    // Debounce 150 ms and one conversion, below 200 ms (docs/diagnosis.md); a frame every 100 ms.
    assert!(found_s <= 0.3, "{found_s} s");
    let reading = bench.rig.view.current_a();
    assert_ne!(reading.validity & validity::IMPLAUSIBLE, 0, "{reading:?}");
}

/// Below the threshold the small sensor measures alone, and its comparators never pass the other one: nothing contradicts
/// 0 A. This is the limit of the design (`core_logic::open_sensor`), not a wish.
#[test]
fn small_sensor_at_half_the_supply_is_beyond_what_can_be_found() {
    let firmware = firmware();
    let row = at_rest().with_current(30.0);
    let mut bench = Bench::nominal(&firmware, row, Contactors::AlwaysClosed);
    set_faults(
        &mut bench,
        Faults {
            small: SensorFault::Forced(2.5),
            ..NO_FAULT
        },
    );
    bench.run(1.5);
    let reading = bench.rig.view.current_a();
    println!(
        "D3: small sensor at 2.5 V with 30 A: {reading:?}, active {:?}",
        bench.rig.view.active_diagnoses()
    );
    let amps = reading.value.unwrap();
    assert!(amps.abs() < 0.01, "{reading:?}");
}
