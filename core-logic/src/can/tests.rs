use super::layout::{Direction, MESSAGES, word};
use super::*;
use crate::key_calibration::KeyRefusal;
use proptest::prelude::*;
use std::format;
use std::string::ToString;

/// The raw number of the signal with this name.
fn raw(frame: Frame, name: &str) -> i64 {
    let message = MESSAGES
        .iter()
        .find(|message| message.header.id == frame.id)
        .unwrap();
    let signal = message.signals.iter().find(|signal| signal.name == name);
    signal
        .unwrap_or_else(|| panic!("no signal {name}"))
        .field
        .get(word(frame.data))
}

fn current(milliamps: i32, validity: Validity) -> Current {
    Current {
        current: Microamps(milliamps.saturating_mul(1_000)),
        validity,
        range: Range::Large,
        conversions: 0x1_23,
        age: Some(Duration::from_ticks(7_999)),
    }
}

fn at(milliseconds: u64) -> Instant {
    Instant::from_ticks(milliseconds * 1_000)
}

#[test]
fn current_in_full() {
    let frame = current(-123_456, Validity::IMPLAUSIBLE).encode(5);
    assert_eq!((frame.id, frame.dlc), (0x101, 8));
    assert_eq!(e2e::verify(DataId::new(0x101), &frame.data), Ok(5));
    assert_eq!(raw(frame, "Current"), -123_456);
    assert_eq!(raw(frame, "CurrentValidity"), 0x20);
    assert_eq!(raw(frame, "CurrentConversions"), 0x23);
    assert_eq!(raw(frame, "CurrentRange"), 1);
    assert_eq!(raw(frame, "CurrentAge"), 7);
    let small = Current {
        range: Range::Small,
        age: None,
        ..current(0, Validity::VALID)
    }
    .encode(0);
    assert_eq!(
        (raw(small, "CurrentRange"), raw(small, "CurrentAge")),
        (0, 1_023)
    );
    let old = Current {
        age: Some(Duration::from_ticks(u64::MAX)),
        ..current(0, Validity::VALID)
    }
    .encode(0);
    assert_eq!(raw(old, "CurrentAge"), 1_022);
}

#[test]
fn a_reading_beyond_its_signal_stays_at_the_limit_and_says_so() {
    let validity = |frame| Validity::from_bits(raw(frame, "CurrentValidity") as u8);
    for (milliamps, sent) in [
        (1_048_576, 1_048_575),
        (i32::MAX, 1_048_575),
        (-1_048_576, -1_048_575),
        (i32::MIN, -1_048_575),
    ] {
        let frame = current(milliamps, Validity::SUPPLY).encode(0);
        assert_eq!(raw(frame, "Current"), sent);
        assert_eq!(validity(frame), Validity::SUPPLY.and(Validity::SATURATED));
    }
    for milliamps in [1_048_575, -1_048_575, 0] {
        let frame = current(milliamps, Validity::VALID).encode(0);
        assert_eq!(
            (raw(frame, "Current"), validity(frame)),
            (i64::from(milliamps), Validity::VALID)
        );
    }
}

#[test]
fn a_reading_that_means_nothing_is_not_available_and_never_zero() {
    for bit in 0..8 {
        let cause = Validity::from_bits(1 << bit);
        let meaningless = [Validity::STALE, Validity::OPEN, Validity::CHIP_FAULT].contains(&cause);
        let frame = current(i32::MAX, cause.and(Validity::CALIBRATING)).encode(0);
        let expected = if meaningless { -1_048_576 } else { 1_048_575 };
        assert_eq!(raw(frame, "Current"), expected);
        // Without a number there is nothing to call saturated.
        let causes = cause
            .and(Validity::CALIBRATING)
            .and_if(!meaningless, Validity::SATURATED);
        assert_eq!(raw(frame, "CurrentValidity"), i64::from(causes.bits()));
        // A sum keeps its number unless it never was one.
        let charge = Charge {
            charge: Nanocoulombs::from_coulombs(5),
            validity: cause,
            estimated: false,
        };
        let expected = if cause == Validity::STALE {
            -274_877_906_944
        } else {
            5_000
        };
        assert_eq!(raw(charge.encode(0), "Charge"), expected);
        let soc = StateOfCharge {
            state_of_charge: Ppm(500_000),
            validity: cause,
            uncertainty: None,
            remaining: None,
        };
        let expected = if cause == Validity::STALE {
            16_383
        } else {
            5_000
        };
        assert_eq!(raw(soc.encode(0), "StateOfCharge"), expected);
    }
}

#[test]
fn average_and_meter_current_in_full() {
    let average = CurrentAverage {
        average: Microamps(600_000_499),
        validity: Validity::VALID,
        samples: 64,
        span: Duration::from_ticks(8_001_000),
    };
    let frame = average.encode(14);
    assert_eq!(e2e::verify(DataId::new(0x102), &frame.data), Ok(14));
    assert_eq!(raw(frame, "CurrentAverage"), 600_000);
    assert_eq!(raw(frame, "CurrentAverageValidity"), 0);
    assert_eq!(
        (
            raw(frame, "CurrentAverageSamples"),
            raw(frame, "CurrentAverageSpan")
        ),
        (64, 4_000)
    );
    let long = CurrentAverage {
        samples: 200,
        span: Duration::from_ticks(u64::MAX),
        ..average
    }
    .encode(0);
    assert_eq!(
        (
            raw(long, "CurrentAverageSamples"),
            raw(long, "CurrentAverageSpan")
        ),
        (127, 4_095)
    );

    let meter = MeterCurrent {
        current: Microamps(-2_600),
        validity: Validity::RANGE_CHANGE,
        below_no_load: true,
        charge_uncertainty: Some(Nanocoulombs(10_000_001)),
    };
    let frame = meter.encode(1);
    assert_eq!(e2e::verify(DataId::new(0x111), &frame.data), Ok(1));
    assert_eq!(
        (
            raw(frame, "MeterCurrent"),
            raw(frame, "MeterCurrentValidity")
        ),
        (-3, 0x10)
    );
    assert_eq!(
        (
            raw(frame, "MeterBelowNoLoad"),
            raw(frame, "ChargeUncertainty")
        ),
        (1, 2)
    );
    let bound = |nanocoulombs: Option<i64>| {
        let charge_uncertainty = nanocoulombs.map(Nanocoulombs);
        raw(
            MeterCurrent {
                charge_uncertainty,
                below_no_load: false,
                ..meter
            }
            .encode(0),
            "ChargeUncertainty",
        )
    };
    assert_eq!(
        (
            bound(None),
            bound(Some(0)),
            bound(Some(1)),
            bound(Some(10_000_000))
        ),
        (262_143, 0, 1, 1)
    );
    assert_eq!((bound(Some(i64::MAX)), bound(Some(i64::MIN))), (262_142, 0));
}

#[test]
fn charge_throughput_and_state_of_charge_in_full() {
    let charge = Charge {
        charge: Nanocoulombs(-1_234_567_890_123),
        validity: Validity::CHIP_FAULT,
        estimated: true,
    };
    let frame = charge.encode(3);
    assert_eq!(e2e::verify(DataId::new(0x110), &frame.data), Ok(3));
    assert_eq!(
        (raw(frame, "Charge"), raw(frame, "ChargeEstimated")),
        (-1_234_568, 1)
    );
    assert_eq!(raw(frame, "ChargeValidity"), 0x80);
    let full = Charge {
        charge: Nanocoulombs(i64::MAX),
        validity: Validity::VALID,
        estimated: false,
    }
    .encode(3);
    assert_eq!(
        (raw(full, "Charge"), raw(full, "ChargeValidity")),
        (274_877_906_943, 2)
    );
    assert_eq!(raw(full, "ChargeEstimated"), 0);

    let throughput = Throughput {
        discharged: Nanocoulombs::from_coulombs(4_294_967_295),
        charged: Nanocoulombs(1_500_000_000),
    };
    assert_eq!(
        (
            raw(throughput.encode(), "ChargeDischarged"),
            raw(throughput.encode(), "ChargeCharged")
        ),
        (4_294_967_295, 2)
    );
    let beyond = Throughput {
        discharged: Nanocoulombs(i64::MAX),
        charged: Nanocoulombs(-2_000_000_000),
    }
    .encode();
    assert_eq!(
        (
            raw(beyond, "ChargeDischarged"),
            raw(beyond, "ChargeCharged")
        ),
        (4_294_967_295, 0)
    );

    let soc = StateOfCharge {
        state_of_charge: Ppm(654_350),
        validity: Validity::VALID,
        uncertainty: Some(Ppm(12_500)),
        remaining: Some(Nanocoulombs::from_milliamp_hours(157_050)),
    };
    let frame = soc.encode(7);
    assert_eq!(e2e::verify(DataId::new(0x112), &frame.data), Ok(7));
    assert_eq!(
        (
            raw(frame, "StateOfCharge"),
            raw(frame, "StateOfChargeUncertainty")
        ),
        (6_544, 13)
    );
    // A half-width is rounded up: 0.04 % is not 0.
    for (ppm, tenths) in [
        (0, 0),
        (1, 1),
        (400, 1),
        (1_000, 1),
        (1_001, 2),
        (1_000_000, 1_000),
    ] {
        let frame = StateOfCharge {
            uncertainty: Some(Ppm(ppm)),
            ..soc
        }
        .encode(0);
        assert_eq!(raw(frame, "StateOfChargeUncertainty"), tenths, "{ppm} ppm");
    }
    assert_eq!(
        (
            raw(frame, "RemainingCharge"),
            raw(frame, "StateOfChargeValidity")
        ),
        (1_571, 0)
    );
    let none = StateOfCharge {
        uncertainty: None,
        remaining: None,
        state_of_charge: Ppm(1_000_100),
        ..soc
    }
    .encode(0);
    assert_eq!(
        (
            raw(none, "StateOfChargeUncertainty"),
            raw(none, "RemainingCharge")
        ),
        (1_023, 65_535)
    );
    assert_eq!(
        (
            raw(none, "StateOfCharge"),
            raw(none, "StateOfChargeValidity")
        ),
        (10_000, 2)
    );
}

#[test]
fn environment_in_full() {
    let environment = Environment {
        supply: Millivolts(5_012),
        supply_validity: Validity::VALID,
        sensor_temperature: MilliCelsius(-40_060),
        sensor_temperature_validity: Validity::IMPLAUSIBLE,
        board_temperature: MilliCelsius(85_000),
        board_temperature_validity: Validity::STALE,
    };
    let frame = environment.encode();
    assert_eq!(
        (
            frame.id,
            raw(frame, "SensorSupply"),
            raw(frame, "SensorSupplyValidity")
        ),
        (0x130, 5_012, 0)
    );
    assert_eq!(
        (
            raw(frame, "SensorTemperature"),
            raw(frame, "SensorTemperatureValidity")
        ),
        (-401, 0x20)
    );
    assert_eq!(
        (
            raw(frame, "BoardTemperature"),
            raw(frame, "BoardTemperatureValidity")
        ),
        (-2_048, 1)
    );
    let warm = Environment {
        board_temperature_validity: Validity::VALID,
        ..environment
    }
    .encode();
    assert_eq!(
        (
            raw(warm, "BoardTemperature"),
            raw(warm, "BoardTemperatureValidity")
        ),
        (850, 0)
    );
}

#[test]
fn board_state_in_full() {
    let state = BoardState {
        key: Some(KeyState::On),
        high_voltage: Some(true),
        permit: true,
        key_calibration: Some(KeyPhase::Failed(KeyRefusal::NoSamples)),
        range: Range::Large,
        cell_voltage_fresh: true,
        vehicle_state_fresh: false,
        edges: 0x1_0002,
        coalesced: 300,
        estimated_intervals: 4,
        bus_offs: 5,
        refused: 0x106,
    };
    let frame = state.encode();
    let expected = [
        ("KeyState", 2),
        ("HighVoltage", 1),
        ("HighVoltagePermit", 1),
        ("KeyCalibration", 3),
        ("Range", 1),
        ("CellVoltageFresh", 1),
        ("VehicleStateFresh", 0),
        ("RangeEdges", 2),
        ("CoalescedEdges", 255),
        ("EstimatedIntervals", 4),
        ("BusOffs", 5),
        ("RefusedFrames", 6),
    ];
    for (name, value) in expected {
        assert_eq!(raw(frame, name), value, "{name}");
    }
    let other = BoardState {
        key: None,
        high_voltage: None,
        permit: false,
        key_calibration: None,
        range: Range::Small,
        cell_voltage_fresh: false,
        vehicle_state_fresh: true,
        estimated_intervals: 1_000,
        bus_offs: 256,
        ..state
    }
    .encode();
    let expected = [
        ("KeyState", 7),
        ("HighVoltage", 3),
        ("HighVoltagePermit", 0),
        ("KeyCalibration", 7),
        ("Range", 0),
        ("CellVoltageFresh", 0),
        ("VehicleStateFresh", 1),
        ("EstimatedIntervals", 255),
        ("BusOffs", 255),
    ];
    for (name, value) in expected {
        assert_eq!(raw(other, name), value, "{name}");
    }
    let keys = [KeyState::Off, KeyState::Acc, KeyState::On, KeyState::Start];
    for (number, key) in keys.into_iter().enumerate() {
        let frame = BoardState {
            key: Some(key),
            high_voltage: Some(false),
            ..state
        }
        .encode();
        assert_eq!(
            (raw(frame, "KeyState"), raw(frame, "HighVoltage")),
            (number as i64, 0)
        );
    }
    let phases = [
        KeyPhase::Off,
        KeyPhase::Taking,
        KeyPhase::Taken,
        KeyPhase::Failed(KeyRefusal::HighVoltageOn),
        KeyPhase::Resumed,
        KeyPhase::Disabled,
    ];
    for (number, phase) in phases.into_iter().enumerate() {
        let frame = BoardState {
            key_calibration: Some(phase),
            ..state
        }
        .encode();
        assert_eq!(raw(frame, "KeyCalibration"), number as i64);
    }
}

#[test]
fn diagnosis_frames_in_full() {
    let mut codes = CodeSet::EMPTY;
    codes.set(Code::OpenSensor, true);
    codes.set(Code::SmallSensorOpen, true);
    assert_eq!(
        diagnosis_active(codes),
        Frame {
            id: 0x140,
            dlc: 8,
            data: [1, 0, 0, 0, 0, 1, 0, 0]
        }
    );
    assert_eq!(
        diagnosis_latched(codes),
        Frame {
            id: 0x141,
            dlc: 8,
            data: [1, 0, 0, 0, 0, 1, 0, 0]
        }
    );
    let detail = Detail {
        active: true,
        latched: false,
        occurrences: 700,
        first_seen: Some(at(10_000_000_999)),
    };
    let frame = DiagnosisDetail {
        code: Some((Code::HvWithoutPermit, detail)),
        reported: 300,
    }
    .encode();
    let expected = [
        ("DiagnosisCode", 21),
        ("DiagnosisSeverity", 3),
        ("DiagnosisIsActive", 1),
        ("DiagnosisIsLatched", 0),
        ("DiagnosisReported", 255),
        ("DiagnosisOccurrences", 700),
        ("DiagnosisFirstSeen", 10_000_000),
    ];
    for (name, value) in expected {
        assert_eq!(raw(frame, name), value, "{name}");
    }
    let latched = Detail {
        active: false,
        latched: true,
        first_seen: Some(Instant::from_ticks(u64::MAX)),
        ..detail
    };
    let frame = DiagnosisDetail {
        code: Some((Code::LogFull, latched)),
        reported: 1,
    }
    .encode();
    assert_eq!(
        (
            raw(frame, "DiagnosisIsActive"),
            raw(frame, "DiagnosisIsLatched")
        ),
        (0, 1)
    );
    assert_eq!(
        (
            raw(frame, "DiagnosisSeverity"),
            raw(frame, "DiagnosisFirstSeen")
        ),
        (0, 16_777_214)
    );
    let none = DiagnosisDetail {
        code: None,
        reported: 0,
    }
    .encode();
    assert_eq!(
        (raw(none, "DiagnosisCode"), raw(none, "DiagnosisFirstSeen")),
        (255, 16_777_215)
    );
    assert_eq!(
        (
            raw(none, "DiagnosisOccurrences"),
            raw(none, "DiagnosisIsActive"),
            raw(none, "DiagnosisSeverity")
        ),
        (0, 0, 0)
    );
}

fn identity() -> Identity {
    Identity {
        version: [1, 2, 3],
        reset_cause: ResetCause::IndependentWatchdog,
        boots: 0x1_0007,
        commit: 0xDEAD_BEEF,
        modified: true,
        configuration_crc: 0x1234_5678,
        panic_hash: 0xFFFF_FFFF,
        panic_line: 70_000,
        late_tasks: 0x81,
        unique_id: [0x1111_2222, 0x3333_4444, 0x5555_6666],
        uptime: Duration::from_ticks(3_600_999_999),
        stack_free: 100_000,
        log_fill: Some(Ppm(502_500)),
    }
}

#[test]
fn identity_in_full() {
    let pages: [&[(&str, i64)]; 6] = [
        &[
            ("ProtocolVersion", 1),
            ("FirmwareMajor", 1),
            ("FirmwareMinor", 2),
            ("FirmwarePatch", 3),
            ("ResetCause", 5),
            ("BootCount", 7),
        ],
        &[
            ("BuildCommit", 0xDEAD_BEEF),
            ("BuildModified", 1),
            ("ConfigurationCrc", 0x5678),
        ],
        &[
            ("PanicHash", 0xFFFF_FFFF),
            ("PanicLine", 65_535),
            ("LateTasks", 0x81),
        ],
        &[("UniqueIdLow", 0x4444_1111_2222)],
        &[("UniqueIdHigh", 0x5555_6666_3333)],
        &[("Uptime", 3_600), ("StackFree", 65_535), ("LogFill", 101)],
    ];
    for (page, signals) in (0u8..).zip(pages) {
        for shown in [page, page + Identity::PAGES] {
            let frame = identity().encode(shown);
            assert_eq!(raw(frame, "IdentityPage"), i64::from(page));
            for (name, value) in signals {
                assert_eq!(raw(frame, name), *value, "{name}");
            }
        }
    }
    let empty = Identity {
        log_fill: None,
        uptime: Duration::from_ticks(u64::MAX),
        modified: false,
        ..identity()
    };
    assert_eq!(
        (
            raw(empty.encode(5), "LogFill"),
            raw(empty.encode(5), "Uptime")
        ),
        (255, 4_294_967_295)
    );
    assert_eq!(raw(empty.encode(1), "BuildModified"), 0);
    // F24: reset cause and panic are out within two seconds.
    let cycle = u64::from(layout::identity::HEADER.cycle_ms);
    assert!(
        cycle * u64::from(Identity::PAGES) + u64::from(layout::identity::HEADER.phase_ms) < 2_000
    );
}

#[test]
fn each_protected_message_has_its_own_counter() {
    let mut sender = Sender::default();
    let average = CurrentAverage {
        average: Microamps(0),
        validity: Validity::VALID,
        samples: 1,
        span: Duration::from_ticks(0),
    };
    let charge = Charge {
        charge: Nanocoulombs(0),
        validity: Validity::VALID,
        estimated: false,
    };
    let meter = MeterCurrent {
        current: Microamps(0),
        validity: Validity::VALID,
        below_no_load: false,
        charge_uncertainty: None,
    };
    let soc = StateOfCharge {
        state_of_charge: Ppm(0),
        validity: Validity::VALID,
        uncertainty: None,
        remaining: None,
    };
    for n in 0..40u8 {
        let counter = |frame: Frame| e2e::verify(DataId::new(frame.id), &frame.data).unwrap();
        assert_eq!(
            counter(sender.current(&current(1, Validity::VALID))),
            n % 15
        );
        assert_eq!(counter(sender.current_average(&average)), n % 15);
        assert_eq!(counter(sender.charge(&charge)), n % 15);
        assert_eq!(counter(sender.meter_current(&meter)), n % 15);
        assert_eq!(counter(sender.state_of_charge(&soc)), n % 15);
    }
}

fn battery(counter: u8, cell: i64, pack: i64, temperature: i64) -> Frame {
    use layout::battery_voltage as at;
    Word::default()
        .with(at::CELL, cell)
        .with(at::PACK, pack)
        .with(at::CELL_TEMPERATURE, temperature)
        .protected(at::HEADER, counter)
}

fn vehicle(counter: u8, key: i64, high_voltage: i64) -> Frame {
    use layout::vehicle_state as at;
    Word::default()
        .with(at::KEY, key)
        .with(at::HIGH_VOLTAGE, high_voltage)
        .protected(at::HEADER, counter)
}

#[test]
fn received_numbers_and_not_available() {
    let mut receiver = Receiver::default();
    let full = BatteryVoltage {
        cell: Some(Microvolts(3_712_300)),
        pack: Some(Millivolts(384_020)),
        cell_temperature: Some(MilliCelsius(-15_000)),
    };
    assert_eq!(
        receiver.on_frame(at(0), &battery(3, 37_123, 19_201, 25)),
        Ok(Received::BatteryVoltage(full))
    );
    assert_eq!(receiver.battery_voltage(at(500)), Some((at(0), full)));
    assert_eq!(receiver.battery_voltage(Instant::from_ticks(500_001)), None);
    let none = BatteryVoltage {
        cell: None,
        pack: None,
        cell_temperature: None,
    };
    let frame = battery(4, 65_535, 65_535, 255);
    assert_eq!(
        receiver.on_frame(at(100), &frame),
        Ok(Received::BatteryVoltage(none))
    );
    let ends = BatteryVoltage {
        cell: Some(Microvolts(6_500_000)),
        pack: Some(Millivolts(1_300_000)),
        cell_temperature: Some(MilliCelsius(210_000)),
    };
    let frame = battery(5, 65_000, 65_000, 250);
    assert_eq!(
        receiver.on_frame(at(200), &frame),
        Ok(Received::BatteryVoltage(ends))
    );

    assert_eq!(receiver.vehicle_state(at(0)), None);
    let states = [
        (0, 0, Some(KeyState::Off), Some(false)),
        (1, 1, Some(KeyState::Acc), Some(true)),
        (2, 3, Some(KeyState::On), None),
        (3, 0, Some(KeyState::Start), Some(false)),
        (7, 1, None, Some(true)),
    ];
    for (counter, (raw_key, raw_hv, key, high_voltage)) in (0u8..).zip(states) {
        let state = VehicleState { key, high_voltage };
        let result = receiver.on_frame(at(1_000), &vehicle(counter, raw_key, raw_hv));
        assert_eq!(result, Ok(Received::VehicleState(state)));
        assert_eq!(receiver.vehicle_state(at(1_500)), Some(state));
        assert_eq!(receiver.vehicle_state(at(1_501)), None);
    }
    assert_eq!(
        (receiver.accepted(), receiver.refused(), receiver.lost()),
        (8, 0, 0)
    );
}

#[test]
fn refused_frames_by_their_reason() {
    let mut receiver = Receiver::default();
    receiver.on_frame(at(0), &vehicle(0, 1, 0)).unwrap();
    let kept = receiver.vehicle_state(at(0));
    let refuse =
        |receiver: &mut Receiver, frame: Frame| receiver.on_frame(at(100), &frame).unwrap_err();

    let foreign = Frame {
        id: 0x203,
        ..vehicle(1, 1, 0)
    };
    assert_eq!(
        refuse(&mut receiver, foreign),
        ReceiveError::UnknownId(0x203)
    );
    assert_eq!(receiver.refused(), 0);
    let short = Frame {
        dlc: 7,
        ..vehicle(1, 1, 0)
    };
    let error = refuse(&mut receiver, short);
    assert_eq!(error, ReceiveError::Length { id: 0x202, dlc: 7 });
    assert_eq!(
        error.to_string(),
        "message 0x202 has the length code 7 instead of 8"
    );
    let mut broken = vehicle(1, 1, 0);
    broken.data[2] ^= 1;
    let error = refuse(&mut receiver, broken);
    assert_eq!(
        error,
        ReceiveError::EndToEnd {
            id: 0x202,
            error: E2eError::Crc
        }
    );
    assert_eq!(
        error.to_string(),
        "message 0x202 fails its end-to-end check: Crc"
    );
    assert_eq!(
        refuse(&mut receiver, vehicle(0, 1, 0)),
        ReceiveError::EndToEnd {
            id: 0x202,
            error: E2eError::Repeated
        }
    );
    let error = refuse(&mut receiver, vehicle(1, 4, 0));
    assert_eq!(
        error,
        ReceiveError::Reserved {
            id: 0x202,
            start_bit: 16,
            raw: 4
        }
    );
    assert_eq!(
        error.to_string(),
        "message 0x202 holds the reserved value 4 at bit 16"
    );
    assert_eq!(
        refuse(&mut receiver, vehicle(2, 1, 2)),
        ReceiveError::Reserved {
            id: 0x202,
            start_bit: 19,
            raw: 2
        }
    );
    for (counter, cell, pack, temperature, start_bit) in [
        (0, 65_001, 0, 0, 16),
        (1, 0, 65_534, 0, 32),
        (2, 0, 0, 251, 48),
    ] {
        let error = refuse(&mut receiver, battery(counter, cell, pack, temperature));
        assert!(
            matches!(error, ReceiveError::Reserved { id: 0x201, start_bit: at, .. } if at == start_bit)
        );
    }
    assert_eq!(receiver.refused(), 8);
    assert_eq!(receiver.accepted(), 1);
    // What was accepted before stays, until it is too old.
    assert_eq!(receiver.vehicle_state(at(500)), kept);
    assert_eq!(receiver.vehicle_state(at(501)), None);
    assert_eq!(receiver.battery_voltage(at(100)), None);
    assert_eq!(
        ReceiveError::UnknownId(1).to_string(),
        "message 0x001 is not received here"
    );
}

#[test]
fn lost_frames_are_counted_and_many_are_a_wrong_sequence() {
    let mut receiver = Receiver::default();
    receiver.on_frame(at(0), &vehicle(0, 1, 0)).unwrap();
    receiver.on_frame(at(300), &vehicle(3, 2, 0)).unwrap();
    assert_eq!(receiver.lost(), 2);
    assert_eq!(
        receiver.on_frame(at(400), &vehicle(7, 3, 0)),
        Err(ReceiveError::EndToEnd {
            id: 0x202,
            error: E2eError::WrongSequence { lost: 3 }
        })
    );
    assert_eq!(
        receiver.vehicle_state(at(400)).unwrap().key,
        Some(KeyState::On)
    );
    receiver.on_frame(at(500), &vehicle(8, 3, 0)).unwrap();
    assert_eq!(
        receiver.vehicle_state(at(500)).unwrap().key,
        Some(KeyState::Start)
    );
    assert_eq!(
        (receiver.lost(), receiver.accepted(), receiver.refused()),
        (2, 3, 1)
    );
}

#[test]
fn messages_are_told_apart_and_identifiers_fit_eleven_bits() {
    for (n, message) in MESSAGES.iter().enumerate() {
        assert!(message.header.id < 0x800);
        assert!(
            MESSAGES
                .iter()
                .skip(n + 1)
                .all(|other| other.header.id > message.header.id)
        );
        assert!(
            message
                .header
                .data_id
                .is_none_or(|id| id.get() == message.header.id)
        );
    }
    let received = MESSAGES
        .iter()
        .filter(|message| message.header.direction == Direction::Received);
    assert!(received.map(|message| message.header.id).eq(Receiver::IDS));
    assert_eq!(format!("{:?}", ResetCause::default()), "Unknown");
}

/// Every message is due once per period, and the 100 ms messages never in the same tick.
#[test]
fn sending_is_spread_over_the_ticks() {
    for message in MESSAGES
        .iter()
        .filter(|message| message.header.direction == Direction::Transmitted)
    {
        let header = message.header;
        let due: std::vec::Vec<u64> = (0..300)
            .map(|tick| tick * 10)
            .filter(|ms| header.is_due(*ms, 10))
            .collect();
        assert_eq!(due[0], u64::from(header.phase_ms));
        assert!(
            due.windows(2)
                .all(|pair| pair[1] - pair[0] == u64::from(header.cycle_ms))
        );
    }
    for tick in 0..200 {
        let slow = MESSAGES.iter().filter(|message| {
            message.header.cycle_ms > 10
                && message.header.direction == Direction::Transmitted
                && message.header.is_due(tick * 10, 10)
        });
        assert!(slow.count() <= 2, "tick {tick}");
    }
    let never = Header {
        cycle_ms: 0,
        ..layout::current::HEADER
    };
    assert!(!never.is_due(0, 10));
    // A tick that comes late by a few milliseconds still sends once.
    assert!(layout::meter_current::HEADER.is_due(117, 10));
    assert!(!layout::meter_current::HEADER.is_due(120, 10));
}

proptest! {
    #[test]
    fn a_field_gives_back_what_was_put_and_touches_no_other_bit(before: u64, value: i64, index in 0usize..200) {
        let fields: std::vec::Vec<Field> =
            MESSAGES.iter().flat_map(|message| message.signals).map(|signal| signal.field).collect();
        let field = fields[index % fields.len()];
        let value = field.clamp(value);
        prop_assert!(field.holds(value));
        let after = field.put(before, value);
        prop_assert_eq!(field.get(after), value);
        let mask = ((1u128 << field.length) - 1) as u64;
        prop_assert_eq!(after & !(mask << field.start), before & !(mask << field.start));
        if let Some(not_available) = field.not_available() {
            prop_assert!(!field.holds(not_available));
            prop_assert_eq!(field.get(field.put(before, not_available)), not_available);
        }
    }

    /// No values make an encoder panic, every frame verifies, and no number leaves its signal's limits.
    #[test]
    fn any_values_make_a_legal_frame(
        a: i32, b: i64, c: u64, d: u32, bits: u8, counter in 0u8..15, flag: bool, code in 0u8..41
    ) {
        let validity = Validity::from_bits(bits);
        let duration = Duration::from_ticks(c);
        let range = if flag { Range::Large } else { Range::Small };
        let detail = Detail { active: flag, latched: !flag, occurrences: d as u16, first_seen: Some(Instant::from_ticks(c)) };
        let frames = [
            Current { current: Microamps(a), validity, range, conversions: d, age: Some(duration) }.encode(counter),
            CurrentAverage { average: Microamps(a), validity, samples: d as u16, span: duration }.encode(counter),
            Charge { charge: Nanocoulombs(b), validity, estimated: flag }.encode(counter),
            MeterCurrent {
                current: Microamps(a), validity, below_no_load: flag, charge_uncertainty: Some(Nanocoulombs(b))
            }.encode(counter),
            StateOfCharge {
                state_of_charge: Ppm(a), validity, uncertainty: Some(Ppm(a)), remaining: Some(Nanocoulombs(b))
            }.encode(counter),
            Throughput { discharged: Nanocoulombs(b), charged: Nanocoulombs(b) }.encode(),
            Environment {
                supply: Millivolts(a), supply_validity: validity, sensor_temperature: MilliCelsius(a),
                sensor_temperature_validity: validity, board_temperature: MilliCelsius(a),
                board_temperature_validity: validity,
            }.encode(),
            BoardState {
                key: None, high_voltage: Some(flag), permit: flag, key_calibration: Some(KeyPhase::Taken), range,
                cell_voltage_fresh: flag, vehicle_state_fresh: flag, edges: d, coalesced: d as u16,
                estimated_intervals: d, bus_offs: d as u16, refused: d,
            }.encode(),
            DiagnosisDetail { code: Code::from_number(code).map(|code| (code, detail)), reported: d }.encode(),
            Identity { uptime: duration, stack_free: d, log_fill: Some(Ppm(a)), panic_line: d, ..identity() }
                .encode(bits),
        ];
        for frame in frames {
            let message = MESSAGES.iter().find(|message| message.header.id == frame.id).unwrap();
            prop_assert_eq!(frame.dlc, 8);
            if let Some(id) = message.header.data_id {
                prop_assert_eq!(e2e::verify(id, &frame.data), Ok(counter));
            }
            let page = (frame.id == 0x150).then_some(frame.data[0]);
            for signal in message.signals.iter().filter(|signal| signal.page.is_none() || signal.page == page) {
                let raw = signal.field.get(word(frame.data));
                prop_assert!(
                    signal.field.holds(raw) || signal.field.not_available() == Some(raw),
                    "{} {}", signal.name, raw
                );
            }
        }
    }

    /// One or two bits changed in a frame never get through, whatever the frame.
    #[test]
    fn a_changed_frame_is_refused(
        cell in 0i64..=65_000, pack in 0i64..=65_000, counter in 0u8..15, first in 0u32..64, second in 0u32..64
    ) {
        let mut frame = battery(counter, cell, pack, 60);
        let flips = (1u64 << first) | (1 << second);
        frame.data = (word(frame.data) ^ flips).to_le_bytes();
        let refused = Receiver::default().on_frame(at(0), &frame);
        prop_assert!(matches!(refused, Err(ReceiveError::EndToEnd { .. })), "{:?}", refused);
    }

    #[test]
    fn any_frame_is_judged_without_a_panic(id in 0x200u16..0x204, dlc in 0u8..=15, data: [u8; 8], now: u64) {
        let mut receiver = Receiver::default();
        let now = Instant::from_ticks(now);
        let accepted = receiver.on_frame(now, &Frame { id, dlc, data }).is_ok();
        let fresh = receiver.battery_voltage(now).is_some() || receiver.vehicle_state(now).is_some();
        prop_assert_eq!(accepted, fresh);
    }
}
