//! The composition's own work: what is known about the sensor enters the meter, orders and their outcomes, what goes out.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss
)]

use core_logic::can::BatteryVoltage;
use core_logic::channel_compare::Outcome;
use core_logic::configuration::{Configuration, FIELDS};
use core_logic::converter::{ConverterSample, DataRate, SupplyMode};
use core_logic::design_parameters as design;
use core_logic::diagnosis::{Code, CodeSet};
use core_logic::front_end::{
    ClosedLoop, DualRange, FrontEnd, Hah1bv, KeyFactors, Network, PerRange, SupplyRelations,
};
use core_logic::key_calibration::{KeyPhase, KeyState};
use core_logic::measurement::{
    ConverterFault, Environment, Found, Measurement, Order, Refusal, Tick, Vehicle,
    effective_meter_config,
};
use core_logic::meter::{MeterChannel, MeterReading, MeterReport};
use core_logic::modbus::readings::CommandState;
use core_logic::modbus::{Activity, Readings};
use core_logic::open_sensor::{network_output, network_output_open};
use core_logic::range::{Range, RangeHistory};
use core_logic::retained::RetainedState;
use core_logic::units::{
    Duration, Instant, Microamps, Microvolts, MilliCelsius, Millivolts, Nanocoulombs, Ppm,
};
use core_logic::validity::Validity;
use proptest::prelude::*;

const PERIOD_US: u64 = 31_250;

/// The measuring logic alone, fed by hand.
struct Bench {
    configuration: Configuration,
    measurement: Measurement,
    now: u64,
    next_conversion: u64,
    /// Between two conversions.
    period_us: u64,
    next_tick: u64,
    code: i16,
    range: Range,
    vehicle: Vehicle,
    environment: Environment,
    report: MeterReport,
    tick: Option<Tick>,
    /// Nobody takes what is found, as while the firmware's RS485 task waits.
    leaves_found: bool,
    /// The meter's mean and when its window began; `None` for what flows now.
    mean: Option<(Microamps, Instant)>,
}

impl Bench {
    /// The cell's voltage comes over CAN.
    fn cell_at_4_v(&mut self) {
        let voltage = BatteryVoltage {
            cell: Some(Microvolts::from_millivolts(4_000)),
            pack: None,
            cell_temperature: None,
        };
        self.measurement
            .on_battery_voltage(&voltage, Instant::from_ticks(self.now));
    }

    fn new(configuration: Configuration) -> Self {
        let start = Instant::from_ticks(0);
        Self {
            measurement: Measurement::new(&configuration, None, Nanocoulombs::ZERO, start),
            configuration,
            now: 0,
            next_conversion: PERIOD_US,
            period_us: PERIOD_US,
            next_tick: 0,
            code: 4_096,
            range: Range::Small,
            vehicle: Vehicle {
                state_fresh: true,
                voltage_fresh: true,
                ..Vehicle::default()
            },
            environment: Environment {
                supply: Some(Microvolts::from_millivolts(5_000)),
                network: Some(network_output(Microvolts::from_millivolts(2_500))),
                sensor_temperature: Some(MilliCelsius(25_000)),
                board_temperature: Some(MilliCelsius(30_000)),
                controller_supply: Some(Millivolts(3_300)),
            },
            report: MeterReport {
                mean_over: Duration::from_ticks(1_000_000),
                ..MeterReport::default()
            },
            tick: None,
            leaves_found: false,
            mean: None,
        }
    }

    /// The meter counts what its mean says.
    fn count_ms(&mut self, milliseconds: u64) {
        for _ in 0..milliseconds / 10 {
            let charge = i64::from(self.report.mean_current.get()) * 10;
            self.report.energy += i32::from(charge != 0);
            self.report.charge_total = self
                .report
                .charge_total
                .saturating_add(Nanocoulombs(charge));
            self.run_ms(10);
        }
    }

    fn history(&self) -> RangeHistory {
        RangeHistory::steady(Instant::from_ticks(self.now), self.range)
    }

    /// Ticks, conversions and meter reports for so long.
    fn run_ms(&mut self, milliseconds: u64) {
        let end = self.now + milliseconds * 1_000;
        while self.next_tick.min(self.next_conversion) <= end {
            let history = |bench: &Self| bench.history();
            if self.next_conversion < self.next_tick {
                self.now = self.next_conversion;
                self.next_conversion += self.period_us;
                let sample = ConverterSample {
                    started: Instant::from_ticks(self.now.saturating_sub(self.period_us)),
                    finished: Instant::from_ticks(self.now),
                    configuration: self.configuration.converter.expected_configuration(),
                    code: self.code,
                };
                let seen = history(self);
                self.measurement
                    .on_conversion(&self.configuration, &sample, &seen);
            } else {
                self.now = self.next_tick;
                self.next_tick += 10_000;
                let seen = history(self);
                let now = Instant::from_ticks(self.now);
                self.measurement
                    .on_environment(&self.configuration, self.environment, &seen, now);
                self.report.at = Some(now);
                self.report.mean_begun = now;
                let mut report = self.report;
                if let Some((mean, begun)) = self.mean {
                    (report.mean_current, report.mean_begun) = (mean, begun);
                }
                self.measurement
                    .on_meter(&self.configuration, &report, Validity::VALID);
                let tick = self.measurement.tick(
                    &self.configuration,
                    now,
                    &self.vehicle,
                    &seen,
                    CodeSet::EMPTY,
                );
                while let Some(found) = (!self.leaves_found)
                    .then(|| self.measurement.take_found())
                    .flatten()
                {
                    found.store(&mut self.configuration);
                    self.measurement.configuration_changed(&self.configuration);
                }
                self.tick = Some(tick);
            }
        }
        self.now = end;
    }

    fn order(&mut self, order: Order) -> Result<(), Refusal> {
        self.measurement.order(&self.configuration, order)
    }

    fn readings(&self) -> Readings {
        let mut readings = Readings::default();
        self.measurement.fill(&self.configuration, &mut readings);
        readings
    }

    fn has(&self, code: Code) -> bool {
        self.measurement.diagnosis().active().contains(code)
    }
}

fn closed_loop() -> ClosedLoop {
    ClosedLoop {
        relations: SupplyRelations {
            k2_nanovolt_per_volt: 498_000_000,
            m2_nanovolt: 11_000_000,
            ..SupplyRelations::default()
        },
        ..ClosedLoop::default()
    }
}

fn with_front_end(front_end: FrontEnd) -> Configuration {
    let mut configuration = Configuration {
        front_end,
        ..Configuration::default()
    };
    configuration.derive();
    configuration
}

/// D3's network at a Hall output of 0 V, in V.
const NETWORK_ZERO_V: f64 = 1.65;

/// Counts per second that the meter makes for a voltage at the switch's output and a level shift, both in volts.
fn counts_per_second(signal_v: f64, shift_v: f64) -> f64 {
    let full_scale = design::METER_COUNTS_PER_SECOND_Q32 as f64 / 2f64.powi(32);
    full_scale * (signal_v - shift_v) * (2.0 / 9.0) / 0.5
}

proptest! {
    /// Whatever is known about the sensor - drift, key factors, supply - the meter's charge is what flowed.
    #[test]
    fn the_meter_counts_with_everything_that_is_known_about_the_sensor(
        kind in 0..4,
        supply_v in 4.6f64..5.4,
        zero_error_v in -0.02f64..0.02,
        current_a in -50.0f64..50.0,
        drift_a in -3.0f64..3.0,
        k in 0.99f64..1.01,
        a_v in -0.03f64..0.03,
        large: bool,
    ) {
        let error = Microvolts((zero_error_v * 1e6) as i32);
        let zero_error_v = f64::from(error.get()) * 1e-6;
        let front_end = match kind {
            0 => FrontEnd::DualRange(DualRange {
                zero: design::SENSOR_ZERO.saturating_add(error),
                ..DualRange::default()
            }),
            1 => FrontEnd::Hah1bv(Hah1bv::default()),
            2 => FrontEnd::Network(Network { sensor_zero: error, ..Network::default() }),
            _ => FrontEnd::ClosedLoop(closed_loop()),
        };
        let mut configuration = with_front_end(front_end);
        let range = if large && kind == 0 { Range::Large } else { Range::Small };
        configuration.zero_drift.value.set(range, Microamps((drift_a * 1e6) as i32));
        let factors = KeyFactors {
            k_ppb: (k * 1e9) as i32,
            a: Microvolts((a_v * 1e6) as i32),
        };
        let config = effective_meter_config(
            &configuration,
            factors,
            Some(Microvolts((supply_v * 1e6) as i32)),
        );
        // The sensor as D4 describes it: k·(V + a) is the ideal output for the current and the drift.
        let sensed = current_a + drift_a;
        let (k, a_v) = if range == Range::Small { (k, a_v) } else { (1.0, 0.0) };
        let output_v = match kind {
            0 | 1 => {
                let per_amp = match (kind, range) {
                    (0, Range::Small) => 2.25 / 60.0,
                    (0, Range::Large) => 2.25 / 600.0,
                    _ => 0.004,
                };
                let zero_v = if kind == 0 { 2.5 + zero_error_v } else { 2.5 };
                ((zero_v + sensed * per_amp) / k - a_v) * supply_v / 5.0
            }
            // Its sensor runs from ±15 V, and the level shift is what the network has at a Hall output of 0 V.
            2 => {
                let per_amp = f64::from(Network::default().sensor_nanovolts_per_amp) * 1e-9;
                (NETWORK_ZERO_V + 0.225 * (zero_error_v + sensed * per_amp)) / k - a_v
            }
            _ => {
                let relations = closed_loop().relations;
                let impedance = (relations.k1_nanoohm_per_volt as f64 * supply_v
                    + relations.m1_nanoohm as f64) * 1e-9;
                let zero = (relations.k2_nanovolt_per_volt as f64 * supply_v
                    + relations.m2_nanovolt as f64) * 1e-9;
                (impedance * sensed / f64::from(closed_loop().turns) + zero) / k - a_v
            }
        };
        let level_v = if kind == 2 { NETWORK_ZERO_V } else { supply_v / 2.0 };
        let rate = counts_per_second(output_v, level_v);
        let mut channel = MeterChannel::new(config);
        for second in 0..=100u64 {
            let us = second * 1_000_000;
            let energy = (rate * second as f64).floor() as i32;
            let at = Instant::from_ticks(us);
            channel.on_reading(MeterReading { energy, at }, RangeHistory::steady(at, range));
        }
        let charge = channel.report().charge_total.get() as f64 * 1e-9;
        // One count; 3 ppm of rounded factors of what the meter sees; 1 µV of rounding at the sensor's output.
        let count_c = config.charge_per_count(range).get() as f64 * 1e-9;
        let full_a = f64::from(config.full_scale.get(range).get()) * 1e-6;
        let bound = count_c + 100.0 * (3e-6 * 2.0 * full_a + 2e-6 * full_a / 2.25);
        prop_assert!(
            (charge - 100.0 * current_a).abs() <= bound,
            "{charge} C of {} C, bound {bound} C", 100.0 * current_a
        );
    }
}

#[test]
fn a_fixed_or_unknown_supply_leaves_the_meter_as_it_is() {
    let mut configuration = Configuration::default();
    let nominal = effective_meter_config(&configuration, KeyFactors::NONE, None);
    assert_eq!(nominal, configuration.meter);
    configuration.converter.supply_mode = SupplyMode::Fixed;
    let supply = Some(Microvolts::from_millivolts(4_700));
    assert_eq!(
        effective_meter_config(&configuration, KeyFactors::NONE, supply),
        configuration.meter
    );
    configuration.converter.supply_mode = SupplyMode::Ratiometric;
    let measured = effective_meter_config(&configuration, KeyFactors::NONE, supply);
    // 5 / 4.7
    assert_eq!(measured.gain.small, Ppm(63_830));
    let network = with_front_end(FrontEnd::Network(Network::default()));
    assert_eq!(
        effective_meter_config(&network, KeyFactors::NONE, supply),
        network.meter
    );
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]
    /// D4: whatever the supply and the relations that the sweep has found, the key cycle takes its factors and the
    /// current then reads 0 A in ACC, on both channels, also when the supply falls with the low-voltage loads.
    #[test]
    fn a_key_cycle_reads_0_a_at_any_supply_and_by_any_relations(
        supply_uv in 4_750_000..=5_250_000i32,
        fall_uv in prop_oneof![Just(0), Just(60_000)],
        k2_nv_per_v in 490_000_000..=505_000_000i64,
        m2_nv in -20_000_000..=25_000_000i64,
        off_shift_v in -0.012f64..0.012,
        acc_shift_v in -0.012f64..0.012,
        drift_ua in prop_oneof![Just(0), Just(-800_000)],
    ) {
        let relations = SupplyRelations {
            k2_nanovolt_per_volt: k2_nv_per_v,
            m2_nanovolt: m2_nv,
            ..SupplyRelations::default()
        };
        let mut configuration = with_front_end(FrontEnd::ClosedLoop(ClosedLoop {
            relations,
            ..ClosedLoop::default()
        }));
        configuration.zero_drift.value = core_logic::front_end::PerRange::both(Microamps(drift_ua));
        let mut bench = Bench::new(configuration);
        // A code is a share of the supply, which is the converter's reference.
        let code = |shift_v: f64, supply_uv: i32| {
            let supply_v = f64::from(supply_uv) * 1e-6;
            let zero_v = (k2_nv_per_v as f64 * supply_v + m2_nv as f64) * 1e-9;
            ((zero_v + shift_v) / supply_v * 8_192.0).round() as i16
        };
        bench.environment.supply = Some(Microvolts(supply_uv));
        bench.code = code(off_shift_v, supply_uv);
        bench.run_ms(1_500);
        bench.vehicle.acc_line = true;
        bench.environment.supply = Some(Microvolts(supply_uv - fall_uv));
        bench.code = code(acc_shift_v, supply_uv - fall_uv);
        bench.run_ms(1_400);
        let state = bench.measurement.board_state(0, 0);
        prop_assert_eq!(state.key_calibration, Some(KeyPhase::Taken));
        bench.run_ms(100);
        let reading = bench.measurement.current();
        // A microvolt is 0.16 mA; k is 2 % from one at most, and the drift is taken off in front of it.
        let bound = 400 + drift_ua.abs() / 50;
        // The meter of this bench counts nothing, whatever the sensor put out with key OFF.
        let validity = reading.validity.without(Validity::IMPLAUSIBLE);
        prop_assert!(
            validity.is_valid() && reading.current.get().abs() <= bound,
            "{reading:?}"
        );
        // The meter sees the same output above half the supply.
        let seen_v = f64::from(bench.code) / 8_192.0 * f64::from(supply_uv - fall_uv) * 1e-6;
        let config = bench.measurement.meter_config(&bench.configuration);
        let rate = counts_per_second(seen_v, f64::from(supply_uv - fall_uv) * 0.5e-6);
        let per_count = config.charge_per_count(Range::Small).get() as f64;
        let meter_a = rate * per_count * 1e-9 - f64::from(config.offset.small.get()) * 1e-6;
        prop_assert!(meter_a.abs() <= 0.002 + f64::from(bound) * 1e-6, "{meter_a} A");
    }
}

/// D2's single sensor and D3's network as the front end in use.
#[test]
fn every_front_end_measures() {
    let mut bench = Bench::new(with_front_end(FrontEnd::Hah1bv(Hah1bv::default())));
    // 2.9 V are 100 A: 2.9 / 5 · 8192 = 4751.4.
    bench.code = 4_751;
    bench.range = Range::Large; // a flag without a meaning here
    bench.run_ms(500);
    let sent = bench.measurement.current();
    assert!(sent.validity.is_valid(), "{:?}", sent.validity);
    assert!(
        (sent.current.get() - 100_000_000).abs() < 153_000,
        "{:?}",
        sent.current
    );
    assert_eq!(sent.range, Range::Small);

    let mut bench = Bench::new(with_front_end(FrontEnd::Network(Network::default())));
    // ±4 V at ±500 A: 100 A are 0.8 V, behind the network 1.83 V.
    bench.environment.network = Some(network_output(Microvolts::from_millivolts(800)));
    bench.run_ms(500);
    let sent = bench.measurement.current();
    assert!(sent.validity.is_valid(), "{:?}", sent.validity);
    assert!(
        (sent.current.get() - 100_000_000).abs() < 1_000,
        "{:?}",
        sent.current
    );
    // The other converter's troubles are none of its.
    let now = Instant::from_ticks(bench.now);
    bench
        .measurement
        .on_converter_fault(ConverterFault::NoAnswer, now);
    bench.run_ms(500);
    assert!(bench.measurement.current().validity.is_valid());
    assert!(!bench.has(Code::ConverterNoAnswer));
    bench.environment.network = Some(network_output_open());
    bench.run_ms(100);
    assert!(bench.has(Code::OpenSensor));
    assert!(
        bench
            .measurement
            .current()
            .validity
            .contains(Validity::OPEN)
    );
}

#[test]
fn a_closed_loop_sensor_without_relations_says_so() {
    let mut bench = Bench::new(with_front_end(FrontEnd::ClosedLoop(ClosedLoop::default())));
    bench.run_ms(500);
    assert!(bench.has(Code::SupplyCalibrationInvalid));
    let mut bench = Bench::new(with_front_end(FrontEnd::ClosedLoop(closed_loop())));
    bench.run_ms(500);
    assert!(!bench.has(Code::SupplyCalibrationInvalid));
}

/// What flows while nobody knows what the output stands for is within the meter's full scale, here 2.25 V of 6.67 mV/A, and no less is known:
/// the bound grows until the relations are there, and no further.
#[test]
fn without_relations_whatever_may_have_flowed_is_declared() {
    let mut bench = Bench::new(with_front_end(FrontEnd::ClosedLoop(ClosedLoop::default())));
    bench.run_ms(1_000);
    let declared = |bench: &Bench| bench.readings().charge_uncertainty;
    let before = declared(&bench);
    bench.run_ms(10_000);
    let grown = declared(&bench).saturating_sub(before);
    let off = grown.saturating_sub(Nanocoulombs::from_coulombs(3_375));
    // A conversion more or less.
    assert!(
        off.saturating_abs() < Nanocoulombs::from_coulombs(12),
        "{grown:?}"
    );
    assert!(!bench.readings().charge_validity.is_valid());
    Found::SupplyRelations(closed_loop().relations).store(&mut bench.configuration);
    bench
        .measurement
        .configuration_changed(&bench.configuration);
    bench.run_ms(100);
    let before = declared(&bench);
    bench.run_ms(10_000);
    assert_eq!(declared(&bench), before);
    assert!(!bench.has(Code::SupplyCalibrationInvalid));
}

/// D4 by order of a host: points over the supply at 0 A and at the test current, then the relations.
/// Seven supplies at 0 A and at 200 A, each taken as a point; `reference_v` is the converter's at a supply.
fn sweep_supply(bench: &mut Bench, truth: &FrontEnd, reference_v: impl Fn(Microvolts) -> f64) {
    for (amps, order) in [
        (0, Order::SupplyPointAtZero),
        (200, Order::SupplyPointAtCurrent),
    ] {
        for millivolts in [4_550, 4_700, 4_850, 5_000, 5_150, 5_300, 5_450] {
            let supply = Microvolts::from_millivolts(millivolts);
            bench.environment.supply = Some(supply);
            let output = truth.voltage(Microamps::from_amps(amps), Range::Small, supply);
            let output_v = f64::from(output.get()) * 1e-6;
            bench.code = (output_v / reference_v(supply) * 32_768.0).round() as i16;
            bench.run_ms(1_500);
            assert_eq!(bench.order(order), Ok(()), "{millivolts} mV");
        }
    }
}

#[test]
fn a_supply_sweep_by_orders_gives_the_relations() {
    let truth = closed_loop();
    let mut configuration = with_front_end(FrontEnd::ClosedLoop(ClosedLoop::default()));
    configuration.supply_test_current = Microamps::from_amps(200);
    configuration.converter.supply_mode = SupplyMode::Measured;
    configuration.converter.data_rate = DataRate::Sps8;
    configuration.key_calibration.enabled = false;
    let mut bench = Bench::new(configuration);
    assert_eq!(
        bench.order(Order::FinishSupplyCalibration),
        Err(Refusal::SupplyCalibration)
    );
    assert_eq!(
        bench.order(Order::SupplyPointAtZero),
        Err(Refusal::SupplyUnknown)
    );
    sweep_supply(&mut bench, &FrontEnd::ClosedLoop(truth), |_| 5.0);
    assert_eq!(bench.readings().supply_points, [7, 7]);
    assert_eq!(bench.readings().activity, Activity::SupplyCalibration);
    assert!(
        bench
            .measurement
            .current()
            .validity
            .contains(Validity::CALIBRATING)
    );
    assert_eq!(bench.order(Order::ZeroNow), Err(Refusal::Busy));
    assert_eq!(bench.order(Order::FinishSupplyCalibration), Ok(()));
    bench.run_ms(20);
    let FrontEnd::ClosedLoop(found) = bench.configuration.front_end else {
        panic!("the front end is another one");
    };
    // Seven points over 0.9 V, each within half a code of 153 µV: 0.2 mV/V at most.
    let close = |a: i64, b: i64, within: i64| assert!((a - b).abs() < within, "{a} {b}");
    close(
        found.relations.k2_nanovolt_per_volt,
        truth.relations.k2_nanovolt_per_volt,
        200_000,
    );
    close(
        found.relations.m2_nanovolt,
        truth.relations.m2_nanovolt,
        1_000_000,
    );
    let referred =
        |relations: SupplyRelations| relations.impedance_nanoohm(design::SENSOR_NOMINAL_SUPPLY);
    let (got, expected) = (referred(found.relations), referred(truth.relations));
    close(got, expected, expected / 500);
    assert_eq!(bench.readings().command_state, CommandState::Done);
    assert_eq!(bench.readings().activity, Activity::None);

    // One that was begun and left ends with the drive.
    assert_eq!(bench.order(Order::SupplyPointAtZero), Ok(()));
    bench.vehicle.hv_feedback = true;
    bench.run_ms(20);
    assert_eq!(bench.readings().activity, Activity::None);
    let validity = bench.measurement.current().validity;
    assert!(!validity.contains(Validity::CALIBRATING));
    bench.vehicle.hv_feedback = false;
    bench.run_ms(20);

    // A point of an invalid reading, and an aborted sweep.
    assert_eq!(bench.order(Order::SupplyPointAtZero), Ok(()));
    assert_eq!(bench.order(Order::Abort), Ok(()));
    assert_eq!(bench.readings().command_state, CommandState::Failed);
    assert_eq!(bench.order(Order::Abort), Ok(()));
    assert_eq!(bench.readings().command_state, CommandState::Done);
    bench
        .measurement
        .on_converter_fault(ConverterFault::NoAnswer, Instant::from_ticks(bench.now));
    assert_eq!(
        bench.order(Order::SupplyPointAtZero),
        Err(Refusal::InvalidReading)
    );
}

/// The relations hold all of the sensor's zero: what a zero drift and key factors took off before is in them.
#[test]
fn a_swept_sensor_reads_0_a_whatever_its_zero_was_corrected_by_before() {
    let truth = FrontEnd::ClosedLoop(closed_loop());
    let mut configuration = with_front_end(FrontEnd::ClosedLoop(ClosedLoop::default()));
    configuration.supply_test_current = Microamps::from_amps(200);
    configuration.converter.data_rate = DataRate::Sps8;
    configuration.key_calibration.enabled = false;
    configuration
        .zero_drift
        .value
        .set(Range::Small, Microamps::from_amps(-2));
    configuration.key_factors = KeyFactors {
        k_ppb: 1_004_016_064,
        a: Microvolts(10_000),
    };
    let mut bench = Bench::new(configuration);
    let ratiometric = |supply: Microvolts| f64::from(supply.get()) * 1e-6;
    sweep_supply(&mut bench, &truth, ratiometric);
    assert_eq!(bench.order(Order::FinishSupplyCalibration), Ok(()));
    let supply = design::SENSOR_NOMINAL_SUPPLY;
    bench.environment.supply = Some(supply);
    let output = truth.voltage(Microamps::ZERO, Range::Small, supply);
    bench.code = (f64::from(output.get()) / f64::from(supply.get()) * 32_768.0) as i16;
    // The bench's meter has not seen the test current: the disagreement has to clear.
    bench.run_ms(15_000);
    let current = bench.measurement.current();
    // A code is 23 mA.
    assert!(
        current.current.saturating_abs() < Microamps::from_milliamps(50),
        "{current:?}"
    );
    assert_eq!(current.validity, Validity::VALID);
    // The meter hangs on the same sensor.
    let meter = bench.measurement.meter_config(&bench.configuration);
    let expected = effective_meter_config(
        &with_front_end(bench.configuration.front_end),
        KeyFactors::NONE,
        Some(supply),
    );
    assert_eq!(meter.offset.small, expected.offset.small);
}

#[test]
fn orders_are_refused_with_their_reason_where_they_make_no_sense() {
    let mut bench = Bench::new(Configuration::default());
    bench.run_ms(1_500);
    for order in [
        Order::SupplyPointAtZero,
        Order::SupplyPointAtCurrent,
        Order::FinishSupplyCalibration,
    ] {
        assert_eq!(bench.order(order), Err(Refusal::NotForThisFrontEnd));
        let readings = bench.readings();
        assert_eq!(
            (readings.command_state, readings.command_reason),
            (CommandState::Failed, Refusal::NotForThisFrontEnd as u16)
        );
    }
    bench.measurement.note_command(CommandState::Done, 3);
    assert_eq!(bench.readings().command_reason, 3);

    bench.vehicle.hv_feedback = true;
    bench.run_ms(10);
    assert_eq!(
        bench.order(Order::KeyCalibration),
        Err(Refusal::HighVoltage)
    );
    assert_eq!(bench.order(Order::ZeroNow), Err(Refusal::HighVoltage));
    bench.vehicle.hv_feedback = false;
    bench.run_ms(10);
    assert_eq!(bench.order(Order::KeyCalibration), Ok(()));
    bench.configuration.key_calibration.enabled = false;
    assert_eq!(bench.order(Order::KeyCalibration), Err(Refusal::Disabled));
    bench.configuration.key_calibration.enabled = true;
    bench.vehicle.acc_line = true;
    bench.run_ms(200);
    assert_eq!(bench.readings().activity, Activity::KeyCalibration);
    assert_eq!(bench.readings().key_calibration_state, 1);
    assert!(
        bench
            .measurement
            .current()
            .validity
            .contains(Validity::CALIBRATING)
    );
    assert_eq!(bench.order(Order::KeyCalibration), Err(Refusal::KeyNotOff));
}

/// Found and yet not in force: the client must not read that it is done.
#[test]
fn a_result_that_the_configuration_refuses_is_no_success() {
    let mut bench = Bench::new(Configuration::default());
    bench.run_ms(1_500);
    assert_eq!(bench.order(Order::ZeroNow), Ok(()));
    bench.measurement.found_was_refused();
    assert_eq!(bench.readings().command_state, CommandState::Running);
    bench.run_ms(3_000);
    assert_eq!(bench.readings().command_state, CommandState::Done);
    bench.measurement.found_was_refused();
    let readings = bench.readings();
    let expected = (CommandState::Failed, Refusal::BeyondLimit as u16);
    assert_eq!((readings.command_state, readings.command_reason), expected);
}

#[test]
fn a_zero_calibration_reports_progress_ends_and_can_be_aborted() {
    let mut bench = Bench::new(Configuration::default());
    bench.run_ms(1_500);
    bench.code = 4_100; // 65 mA
    bench.run_ms(500);
    assert_eq!(bench.order(Order::ZeroNow), Ok(()));
    bench.run_ms(1_000);
    let readings = bench.readings();
    assert_eq!(readings.activity, Activity::ZeroDrift);
    assert!(
        (40..=55).contains(&readings.activity_progress),
        "{}",
        readings.activity_progress
    );
    assert_eq!(readings.command_state, CommandState::Running);
    assert_eq!(bench.order(Order::Abort), Ok(()));
    assert_eq!(bench.readings().activity, Activity::None);
    assert_eq!(bench.order(Order::ZeroNow), Ok(()));
    bench.run_ms(3_000);
    assert_eq!(bench.readings().command_state, CommandState::Done);
    assert_eq!(
        bench.configuration.zero_drift.value.small,
        Microamps(65_104)
    );
    assert_eq!(bench.measurement.current().current, Microamps(0));

    // Beyond the limit: refused, reported, the previous value stays.
    bench.code = 4_600; // 8.2 A
    bench.run_ms(500);
    assert_eq!(bench.order(Order::ZeroNow), Ok(()));
    bench.run_ms(4_000);
    assert_eq!(bench.readings().command_reason, Refusal::BeyondLimit as u16);
    assert!(bench.has(Code::ZeroDriftBeyondLimit));
    assert_eq!(
        bench.configuration.zero_drift.value.small,
        Microamps(65_104)
    );
    // Mended by hand, which the board cannot see.
    assert_eq!(bench.order(Order::ClearDiagnoses), Ok(()));
    bench.run_ms(1_100);
    assert!(!bench.has(Code::ZeroDriftBeyondLimit));

    // Nothing arrives: it ends by itself.
    bench.code = 4_100;
    bench.run_ms(500);
    assert_eq!(bench.order(Order::ZeroNow), Ok(()));
    bench.next_conversion = u64::MAX;
    bench.run_ms(u64::from(bench.configuration.zero_drift.timeout_ms) + 100);
    assert_eq!(bench.readings().command_reason, Refusal::Timeout as u16);
}

/// D3 at rest, as `firmware/src/analog.rs` reads it with `codes` of noise, rms, in each conversion: four of the network to a reading, and a
/// mean over 16 of the reference, of which every second tick has one.
struct NoisyNetwork {
    codes: f64,
    state: u64,
    reference: f64,
    odd: bool,
}

impl NoisyNetwork {
    const REFERENCE: f64 = 1.21 / 3.3 * 4_096.0;

    fn new(codes: f64, seed: u64) -> Self {
        Self {
            codes,
            state: seed,
            reference: Self::REFERENCE,
            odd: false,
        }
    }

    /// Twelve uniform ones are a normal one.
    fn noise(&mut self) -> f64 {
        let sum = (0..12).fold(-6.0, |sum, _| {
            self.state ^= self.state << 13;
            self.state ^= self.state >> 7;
            self.state ^= self.state << 17;
            sum + (self.state >> 11) as f64 / (1_u64 << 53) as f64
        });
        self.codes * sum
    }

    /// The network's output at `amps` of 8 mV each at the Hall output.
    fn output(&mut self, amps: f64) -> Microvolts {
        self.odd = !self.odd;
        if self.odd {
            let newest = (Self::REFERENCE + self.noise()).round();
            self.reference += (newest - self.reference) / 16.0;
        }
        let code = (NETWORK_ZERO_V + 0.225 * 8e-3 * amps) / 3.3 * 4_096.0;
        let sum: f64 = (0..4).map(|_| (code + self.noise()).round()).sum();
        Microvolts((sum / 4.0 / 4_096.0 * 3.3e6 * Self::REFERENCE / self.reference) as i32)
    }
}

/// "zero now" while `amps` flow, after the number of the reading from the order on.
fn zero_of_network(
    network: &mut NoisyNetwork,
    amps: impl Fn(usize) -> f64,
) -> Result<Microamps, u16> {
    let mut configuration = with_front_end(FrontEnd::Network(Network::default()));
    configuration.key_calibration.enabled = false;
    let mut bench = Bench::new(configuration);
    bench.next_conversion = u64::MAX;
    for _ in 0..50 {
        bench.environment.network = Some(network.output(0.0));
        bench.run_ms(10);
    }
    assert_eq!(bench.order(Order::ZeroNow), Ok(()));
    for number in 0.. {
        bench.environment.network = Some(network.output(amps(number)));
        bench.run_ms(10);
        let readings = bench.readings();
        match readings.command_state {
            CommandState::Running => {}
            CommandState::Done => {
                // What it takes with the shortest quarters, and one reading until it is in force.
                assert!((63..=65).contains(&number), "{number}");
                return Ok(bench.configuration.zero_drift.value.small);
            }
            _ => return Err(readings.command_reason),
        }
    }
    unreachable!()
}

/// By the factory's limit of 0.5 A, of which such noise alone makes twice as much between single readings.
#[test]
fn a_noisy_network_s_zero_is_taken_and_a_current_that_moves_is_refused() {
    let mut network = NoisyNetwork::new(1.0, 0x9E37_79B9_7F4A_7C15);
    let mut refused = 0;
    for _ in 0..300 {
        match zero_of_network(&mut network, |_| 0.0) {
            // Noise of 0.25 A in 64 readings, and of the reference what is alike in all.
            Ok(zero) => assert!(zero.saturating_abs() < Microamps(400_000), "{zero:?}"),
            Err(reason) => {
                assert_eq!(reason, Refusal::Unstable as u16);
                refused += 1;
            }
        }
    }
    assert!(refused <= 6, "{refused} of 300");
    type Current = (&'static str, fn(usize) -> f64);
    let currents: [Current; 5] = [
        ("from the half on", |n| if n < 32 { 0.0 } else { 1.2 }),
        ("in the last quarter", |n| if n < 48 { 0.0 } else { -1.2 }),
        ("a ramp", |n| n as f64 / 64.0 * 2.0),
        (
            "20 A at rest, a relay",
            |n| {
                if n % 16 < 2 { 20.0 } else { 0.0 }
            },
        ),
        ("one reading", |n| if n == 63 { 4.0 } else { 0.0 }),
    ];
    for (name, amps) in currents {
        let taken = (0..100).filter(|_| zero_of_network(&mut network, amps).is_ok());
        assert_eq!(taken.count(), 0, "{name}");
    }
    // Without noise, what the limit says.
    let mut quiet = NoisyNetwork::new(0.0, 1);
    for (amps, is_refused) in [(0.4, false), (0.7, true)] {
        let zero = zero_of_network(&mut quiet, |n| if n < 32 { 0.0 } else { amps });
        assert_eq!(zero.is_err(), is_refused, "{amps} A: {zero:?}");
    }
}

/// The command of a key-state calibration ends with the key cycle that it waits for.
#[test]
fn an_ordered_key_calibration_ends_as_done_or_failed() {
    let mut bench = Bench::new(Configuration::default());
    bench.run_ms(1_500);
    assert_eq!(bench.order(Order::KeyCalibration), Ok(()));
    bench.run_ms(2_000);
    let state = |bench: &Bench| {
        let readings = bench.readings();
        (readings.command_state, readings.command_reason)
    };
    assert_eq!(state(&bench), (CommandState::Running, 0));
    bench.vehicle.acc_line = true;
    bench.run_ms(300);
    assert_eq!(state(&bench), (CommandState::Running, 0));
    bench.run_ms(1_500);
    assert_eq!(bench.readings().key_calibration_state, 2);
    assert_eq!(state(&bench), (CommandState::Done, 0));

    // A current flows until the delay has passed.
    bench.vehicle.acc_line = false;
    bench.run_ms(1_500);
    assert_eq!(bench.order(Order::KeyCalibration), Ok(()));
    bench.run_ms(1_500);
    bench.report.mean_current = Microamps::from_amps(10);
    bench.vehicle.acc_line = true;
    bench.run_ms(2_000);
    assert_eq!(bench.readings().key_calibration_state, 3);
    assert_eq!(
        state(&bench),
        (CommandState::Failed, Refusal::CurrentFlows as u16)
    );

    // The state is that of the newest order: what an older one comes to does not change it.
    bench.report.mean_current = Microamps::ZERO;
    bench.vehicle.acc_line = false;
    bench.run_ms(1_500);
    assert_eq!(bench.order(Order::KeyCalibration), Ok(()));
    bench.measurement.note_command(CommandState::Failed, 3);
    bench.vehicle.acc_line = true;
    bench.run_ms(2_000);
    assert_eq!(state(&bench), (CommandState::Failed, 3));
}

/// A zero drift of 1 A is found, and nobody has taken it.
fn with_zero_drift_found() -> Bench {
    let mut bench = Bench::new(Configuration::default());
    bench.leaves_found = true;
    bench.code = 4_096 + 61; // 1 A at rest
    bench.run_ms(1_500);
    assert_eq!(bench.order(Order::ZeroNow), Ok(()));
    bench.run_ms(3_000);
    bench
}

/// A run that began before the result of the one before is in force would take it off once more, or undo it.
#[test]
fn a_zero_calibration_waits_until_the_result_before_is_in_force() {
    let mut bench = with_zero_drift_found();
    assert_eq!(bench.order(Order::ZeroNow), Err(Refusal::Busy));
    bench.leaves_found = false;
    bench.run_ms(500);
    assert_eq!(bench.order(Order::ZeroNow), Ok(()));
    bench.run_ms(3_000);
    let drift = bench.configuration.zero_drift.value.small;
    assert!(drift > Microamps(900_000), "{drift:?}");
}

/// "Done" was said of the zero drift: a key cycle that ends before it is taken must not take its place, nor lose its own result.
#[test]
fn a_zero_drift_and_key_factors_found_together_are_both_stored() {
    let mut bench = with_zero_drift_found();
    // Not in force yet.
    assert_eq!(bench.readings().command_state, CommandState::Running);
    bench.vehicle.acc_line = true;
    bench.run_ms(2_000);
    assert_eq!(bench.readings().key_calibration_state, 2);
    let first = bench.measurement.take_found();
    assert!(
        matches!(first, Some(Found::ZeroDrift(Range::Small, drift)) if drift > Microamps(900_000)),
        "{first:?}"
    );
    assert_eq!(bench.readings().command_state, CommandState::Done);
    let factors = bench.measurement.retained(0).key_factors;
    assert_ne!(factors, KeyFactors::NONE);
    let second = bench.measurement.take_found();
    assert_eq!(second, Some(Found::KeyFactors(factors)));
    assert_eq!(bench.measurement.take_found(), None);
}

/// Zero drift (D2) and key factors (D4) share the work: what the one has taken off, the other does not take off again.
#[test]
fn zero_drift_and_key_factors_together_read_0_a() {
    let mut bench = Bench::new(Configuration::default());
    bench.code = 4_096 + 61; // 1 A at rest
    bench.run_ms(1_500);
    assert_eq!(bench.order(Order::ZeroNow), Ok(()));
    bench.run_ms(3_000);
    assert_eq!(bench.readings().command_state, CommandState::Done);
    bench.vehicle.acc_line = true;
    bench.code = 4_096 + 61 + 30; // 0.5 A more with the accessories on
    bench.run_ms(2_000);
    assert_eq!(bench.readings().key_calibration_state, 2);
    let current = bench.measurement.current();
    assert!(
        current.current.saturating_abs() < Microamps(20_000),
        "{current:?}"
    );
    // The next key cycle takes the same.
    bench.vehicle.acc_line = false;
    bench.code = 4_096 + 61;
    bench.run_ms(2_000);
    bench.vehicle.acc_line = true;
    bench.run_ms(2_000);
    assert!(bench.measurement.current().current.saturating_abs() < Microamps(20_000));
}

#[test]
fn abort_ends_a_key_calibration_too() {
    let cancelled = (CommandState::Failed, Refusal::Cancelled as u16);
    let mut bench = Bench::new(Configuration::default());
    let state = |bench: &Bench| {
        let readings = bench.readings();
        (readings.command_state, readings.command_reason)
    };
    bench.run_ms(1_500);
    // Ordered, and still waiting for the key.
    assert_eq!(bench.order(Order::KeyCalibration), Ok(()));
    assert_eq!(bench.order(Order::Abort), Ok(()));
    assert_eq!(state(&bench), cancelled);
    // While it takes ACC's output: the previous factors stay, and the permit does not wait any longer.
    let before = bench.configuration.key_factors;
    bench.code = 4_100;
    bench.run_ms(1_500);
    bench.code = 4_096;
    bench.vehicle.acc_line = true;
    bench.run_ms(300);
    assert_eq!(bench.readings().activity, Activity::KeyCalibration);
    assert!(!bench.tick.unwrap().hv_permit);
    assert_eq!(bench.order(Order::Abort), Ok(()));
    assert_eq!(state(&bench), cancelled);
    bench.run_ms(2_000);
    assert_eq!(bench.readings().activity, Activity::None);
    assert_eq!(bench.configuration.key_factors, before);
    assert!(bench.tick.unwrap().hv_permit);
    assert!(bench.has(Code::KeyCalibrationFailed));
    assert!(bench.measurement.current().validity.is_valid());
    // Nothing is left to abort.
    assert_eq!(bench.order(Order::Abort), Ok(()));
    assert_eq!(state(&bench), (CommandState::Done, 0));
}

#[test]
fn every_reason_against_a_calibration_has_its_number() {
    use core_logic::zero_drift::ZeroRefusal as Zero;
    let microamps = Microamps(1);
    for (zero, number) in [
        (Zero::Busy, 1),
        (Zero::HighVoltage, 2),
        (Zero::CurrentFlows { mean: microamps }, 3),
        (Zero::MeterUnknown, 4),
        (Zero::InvalidReading, 5),
        (Zero::Unstable { spread: microamps }, 6),
        (
            Zero::BeyondLimit {
                value: microamps,
                limit: microamps,
            },
            7,
        ),
        (Zero::Timeout, 8),
        (Zero::Cancelled, 9),
    ] {
        assert_eq!(Refusal::from(zero) as u16, number);
    }
    use core_logic::key_calibration::KeyRefusal as Key;
    let microvolts = Microvolts(1);
    for (key, number) in [
        (Key::HighVoltageOn, 2),
        (Key::CurrentFlows(microamps), 3),
        (Key::InvalidSample, 5),
        (Key::WrongRange, 5),
        (Key::Unstable(microvolts), 6),
        (Key::KOutOfLimits(1), 7),
        (Key::AOutOfLimits(microvolts), 7),
        (Key::NoSamples, 8),
        (Key::NoOffValue, 8),
        (Key::Cancelled, 9),
        (Key::KeyContradiction, 15),
    ] {
        assert_eq!(Refusal::from(key) as u16, number);
    }
}

#[test]
fn faults_of_the_converter_are_named_and_pass_with_the_next_sample() {
    let mut bench = Bench::new(Configuration::default());
    bench.run_ms(1_000);
    let good = bench.measurement.current();
    assert!(good.validity.is_valid());
    bench.next_conversion = u64::MAX;
    let now = Instant::from_ticks(bench.now);
    bench
        .measurement
        .on_converter_fault(ConverterFault::NoAnswer, now);
    assert!(
        bench
            .measurement
            .current()
            .validity
            .contains(Validity::CHIP_FAULT)
    );
    bench.run_ms(200);
    assert!(bench.has(Code::ConverterNoAnswer) && bench.has(Code::ConverterStale));
    assert!(
        bench
            .measurement
            .current()
            .validity
            .contains(Validity::STALE)
    );
    assert_eq!(bench.measurement.current().current, good.current);
    // It is held for a conversion and two ticks: 200 ms are not covered.
    let bridge = bench.measurement.bridge();
    assert_eq!(
        (bridge.current, bridge.until.as_ticks()),
        (Some(good.current), 1_000_000)
    );
    assert_eq!(bridge.holds.as_ticks(), PERIOD_US + 24_000);
    bench
        .measurement
        .on_converter_fault(ConverterFault::ConfigurationLost, now);
    bench.run_ms(20);
    assert!(bench.has(Code::ConverterConfigurationLost));
    bench.next_conversion = bench.now;
    bench.run_ms(2_000);
    assert!(!bench.has(Code::ConverterNoAnswer) && !bench.has(Code::ConverterConfigurationLost));
    assert!(bench.measurement.current().validity.is_valid());
    assert_eq!(bench.measurement.bridge().current, Some(good.current));
    // A sample with the power-up configuration byte.
    let invalid = bench.measurement.invalid_conversions();
    let sample = ConverterSample {
        started: Instant::from_ticks(bench.now + 1),
        finished: Instant::from_ticks(bench.now + 2),
        configuration: 0x8C,
        code: 0,
    };
    let history = bench.history();
    bench
        .measurement
        .on_conversion(&bench.configuration, &sample, &history);
    assert_eq!(bench.measurement.invalid_conversions(), invalid + 1);
    assert!(
        bench
            .measurement
            .current()
            .validity
            .contains(Validity::CHIP_FAULT)
    );
    assert_eq!(
        bench.measurement.current().current,
        good.current,
        "never 0 A, never −60 A"
    );
}

/// What the meter may be wrong by, the state of charge may be wrong by as well: gaps, estimates and hand-overs while it runs.
#[test]
fn the_meters_doubts_are_the_state_of_charges_too() {
    let mut bench = Bench::new(Configuration::default());
    bench.run_ms(1_000);
    bench
        .measurement
        .set_state_of_charge(Ppm(500_000), Ppm(10_000));
    let doubt = |bench: &Bench| bench.measurement.retained(0).soc.uncertainty.get();
    let before = doubt(&bench);
    bench.report.uncertainty = Nanocoulombs::from_coulombs(300);
    bench.run_ms(100);
    let grown = doubt(&bench) - before;
    // And what a tenth of a second costs anyway.
    let (least, most) = (300_000_000_000, 301_000_000_000);
    assert!((least..most).contains(&grown), "{grown} nC");
    // Once, and only what is added; the share of the reading's hidden bits may go again.
    bench.report.uncertainty = Nanocoulombs::from_coulombs(299);
    bench.run_ms(100);
    bench.report.uncertainty = Nanocoulombs::from_coulombs(310);
    bench.run_ms(100);
    let grown = doubt(&bench) - before;
    assert!(
        (least + 10_000_000_000..most + 10_000_000_000).contains(&grown),
        "{grown} nC"
    );
}

/// Another data rate while a conversion of the old one is under way: nothing is lost, and nothing is late.
#[test]
fn another_data_rate_raises_no_diagnosis() {
    use core_logic::converter::DataRate;
    for (old, new) in [
        (DataRate::Sps32, DataRate::Sps8),
        (DataRate::Sps8, DataRate::Sps32),
        (DataRate::Sps8, DataRate::Sps128),
    ] {
        let mut configuration = Configuration::default();
        configuration.converter.data_rate = old;
        let mut bench = Bench::new(configuration);
        bench.next_conversion = u64::MAX;
        let sample = |bench: &mut Bench, rate: DataRate, length: u64| {
            let started = Instant::from_ticks(bench.now);
            bench.run_ms(length / 1_000);
            let mut of = bench.configuration.converter;
            of.data_rate = rate;
            let sample = ConverterSample {
                started,
                finished: Instant::from_ticks(bench.now),
                configuration: of.expected_configuration(),
                code: 1 << (rate.bits() - 2),
            };
            let history = bench.history();
            bench
                .measurement
                .on_conversion(&bench.configuration, &sample, &history);
        };
        let nothing_raised = |bench: &Bench| {
            let current = bench.measurement.current();
            assert!(current.validity.is_valid(), "{old:?} {new:?}: {current:?}");
            assert!(!bench.has(Code::ConverterConfigurationLost));
            assert!(!bench.has(Code::ConverterStale));
        };
        let (slow, fast) = (old.period().as_ticks(), new.period().as_ticks());
        for _ in 0..10 {
            sample(&mut bench, old, slow);
        }
        nothing_raised(&bench);
        // Half a conversion before the change, all of it after it.
        bench.configuration.converter.data_rate = new;
        bench
            .measurement
            .configuration_changed(&bench.configuration);
        let current = bench.measurement.current().current;
        sample(&mut bench, old, slow);
        bench.run_ms(10);
        nothing_raised(&bench);
        assert_eq!(bench.measurement.current().current, current);
        // The chip's first result of a new rate is discarded.
        bench.run_ms(fast / 1_000);
        nothing_raised(&bench);
        for _ in 0..3 {
            sample(&mut bench, new, fast);
            bench.run_ms(10);
            nothing_raised(&bench);
        }
        // A converter that is silent from the change on is found all the same.
        bench.configuration.converter.data_rate = old;
        bench
            .measurement
            .configuration_changed(&bench.configuration);
        bench.run_ms((3 * slow + 3 * fast) / 1_000 + 20);
        assert!(bench.has(Code::ConverterStale));
    }
}

/// A bad joint: the converter is silent for 200 ms, again and again. The readings say so each time, and are valid in between at
/// once; what is logged is one diagnosis, not one for each silence.
#[test]
fn a_converter_that_is_silent_again_and_again_is_one_diagnosis() {
    const SILENCES: u16 = 20;
    let mut bench = Bench::new(Configuration::default());
    bench.run_ms(2_000);
    for _ in 0..SILENCES {
        bench.next_conversion = u64::MAX;
        bench.run_ms(200);
        let average = bench.measurement.current_average(&bench.configuration);
        for validity in [bench.measurement.current().validity, average.validity] {
            assert!(validity.contains(Validity::STALE), "{validity:?}");
        }
        assert!(bench.has(Code::ConverterStale));
        bench.next_conversion = bench.now;
        bench.run_ms(40);
        let average = bench.measurement.current_average(&bench.configuration);
        for validity in [bench.measurement.current().validity, average.validity] {
            assert!(validity.is_valid(), "{validity:?}");
        }
    }
    let detail = bench.measurement.diagnosis().detail(Code::ConverterStale);
    assert_eq!(detail.occurrences, 1);
    bench.run_ms(1_000);
    assert!(!bench.has(Code::ConverterStale));
}

#[test]
fn the_meters_state_is_the_charges_validity() {
    let mut bench = Bench::new(Configuration::default());
    assert!(
        bench
            .measurement
            .charge()
            .validity
            .contains(Validity::STALE)
    );
    bench.run_ms(100);
    assert!(bench.measurement.charge().validity.is_valid());
    assert!(!bench.measurement.charge().estimated);
    for (report, validity, estimated) in [
        (
            MeterReport {
                lost: true,
                ..bench.report
            },
            Validity::CHIP_FAULT,
            false,
        ),
        (
            MeterReport {
                gaps: 1,
                ..bench.report
            },
            Validity::VALID,
            true,
        ),
        (
            MeterReport {
                estimated_intervals: 1,
                ..bench.report
            },
            Validity::VALID,
            true,
        ),
    ] {
        bench
            .measurement
            .on_meter(&bench.configuration, &report, Validity::VALID);
        assert_eq!(bench.measurement.charge().validity, validity);
        assert_eq!(bench.measurement.charge().estimated, estimated);
    }
    bench.measurement.on_meter(
        &bench.configuration,
        &MeterReport {
            mean_over: Duration::from_ticks(0),
            below_no_load: true,
            ..bench.report
        },
        Validity::CALIBRATING,
    );
    let sent = bench.measurement.meter_current();
    assert_eq!(sent.validity, Validity::CALIBRATING.and(Validity::STALE));
    assert!(sent.below_no_load);
}

#[test]
fn what_is_kept_over_a_reset_goes_on() {
    let configuration = Configuration::default();
    let mut bench = Bench::new(configuration);
    bench
        .measurement
        .set_state_of_charge(Ppm(700_000), Ppm(20_000));
    bench.report.charge_total = Nanocoulombs::from_coulombs(1_234);
    bench.run_ms(100);
    let kept = bench.measurement.retained(7);
    assert_eq!(kept.sequence, 7);
    assert_eq!(kept.charge_total, Nanocoulombs::from_coulombs(1_234));
    let start = Instant::from_ticks(0);
    let clean = Measurement::new(&configuration, Some(&kept), Nanocoulombs::ZERO, start);
    assert_eq!(clean.charge().charge, Nanocoulombs::from_coulombs(1_234));
    assert!(!clean.charge().estimated);
    let before = bench.measurement.state_of_charge();
    assert_eq!(
        clean.state_of_charge().state_of_charge,
        before.state_of_charge
    );
    // A tenth of the capacity may be lost: said, and added to the uncertainty.
    let lost = Nanocoulombs::from_milliamp_hours(i64::from(configuration.soc.capacity_mah) / 10);
    let mut lossy = Measurement::new(&configuration, Some(&kept), lost, start);
    assert!(lossy.charge().estimated);
    assert_eq!(lossy.meter_current().charge_uncertainty, Some(lost));
    assert_eq!(
        clean.meter_current().charge_uncertainty,
        Some(Nanocoulombs::ZERO)
    );
    let grown =
        lossy.state_of_charge().uncertainty.unwrap().get() - before.uncertainty.unwrap().get();
    assert!((grown - 100_000).abs() < 10, "{grown}");
    let history = RangeHistory::steady(start, Range::Small);
    let tick = lossy.tick(
        &configuration,
        start,
        &Vehicle::default(),
        &history,
        CodeSet::EMPTY,
    );
    assert!(tick.changes.set.contains(Code::ChargeRestoredWithLoss));
    // Nothing kept: the state of charge is not known, and not sent as a number.
    let fresh = Measurement::new(&configuration, None, Nanocoulombs::ZERO, start);
    assert!(fresh.state_of_charge().validity.contains(Validity::STALE));
    assert_eq!(fresh.state_of_charge().uncertainty, None);
    assert_eq!(fresh.state_of_charge().remaining, None);
}

#[test]
fn another_capacity_keeps_the_state_of_charge() {
    let mut bench = Bench::new(Configuration::default());
    bench
        .measurement
        .set_state_of_charge(Ppm(400_000), Ppm(20_000));
    bench.configuration.soc.capacity_mah /= 2;
    bench
        .measurement
        .configuration_changed(&bench.configuration);
    bench.run_ms(20);
    let soc = bench.measurement.state_of_charge();
    assert!((soc.state_of_charge.get() - 400_000).abs() <= 1);
    let half = Nanocoulombs::from_milliamp_hours(i64::from(bench.configuration.soc.capacity_mah));
    assert!((soc.remaining.unwrap().get() - half.get() * 2 / 5).abs() < 1_000_000);
}

#[test]
fn surroundings_are_sent_with_their_validity() {
    let mut bench = Bench::new(Configuration::default());
    assert!(
        bench
            .measurement
            .environment()
            .supply_validity
            .contains(Validity::STALE)
    );
    bench.run_ms(500);
    let sent = bench.measurement.environment();
    assert_eq!(sent.supply, Millivolts(5_000));
    assert_eq!(sent.sensor_temperature, MilliCelsius(25_000));
    assert_eq!(sent.board_temperature, MilliCelsius(30_000));
    assert!(sent.supply_validity.is_valid() && sent.sensor_temperature_validity.is_valid());
    bench.environment.sensor_temperature = None;
    bench.environment.board_temperature = Some(MilliCelsius(105_001));
    bench.run_ms(1_500);
    let sent = bench.measurement.environment();
    assert!(sent.sensor_temperature_validity.contains(Validity::STALE));
    // 0 °C would be a temperature.
    let record = bench.measurement.log_record(&bench.configuration, 1);
    assert_eq!(record.temperature, None);
    assert!(sent.board_temperature_validity.is_valid());
    assert!(bench.has(Code::TemperatureOutOfRange));
    bench.environment.board_temperature = Some(MilliCelsius(-40_000));
    bench.environment.sensor_temperature = Some(MilliCelsius(-40_000));
    bench.run_ms(6_000);
    assert!(!bench.has(Code::TemperatureOutOfRange));
    bench.environment.sensor_temperature = Some(MilliCelsius(-40_001));
    bench.run_ms(1_500);
    assert!(bench.has(Code::TemperatureOutOfRange));
    // A supply that jumps is believed at the third reading, one that wanders is averaged.
    bench.environment.supply = Some(Microvolts::from_millivolts(5_020));
    bench.run_ms(10);
    assert!(bench.measurement.environment().supply < Millivolts(5_005));
    bench.run_ms(1_000);
    // Factors are worked out anew by steps of 3 mV; what is reported is the mean itself.
    let supply = bench.measurement.environment().supply;
    assert!(
        (Millivolts(5_019)..=Millivolts(5_020)).contains(&supply),
        "{supply:?}"
    );
    bench.environment.supply = Some(Microvolts::from_millivolts(4_600));
    bench.run_ms(20);
    assert!(bench.measurement.environment().supply > Millivolts(4_990));
    bench.run_ms(10);
    assert_eq!(bench.measurement.environment().supply, Millivolts(4_600));
    // One by itself counts for a 32nd.
    bench.environment.supply = Some(Microvolts::from_millivolts(4_500));
    bench.run_ms(10);
    bench.environment.supply = Some(Microvolts::from_millivolts(4_600));
    bench.run_ms(100);
    let supply = bench.measurement.environment().supply;
    assert!((Millivolts(4_597)..Millivolts(4_600)).contains(&supply));
}

#[test]
fn temperature_limits_are_those_of_the_configuration() {
    let mut bench = Bench::new(Configuration::default());
    bench.run_ms(1_500);
    assert!(!bench.has(Code::TemperatureOutOfRange));
    // The sensors' 25 °C and the board's 30 °C.
    for limits in [[-40_000, 29_999], [25_001, 105_000]] {
        bench.configuration.temperature_limits = limits.map(MilliCelsius);
        bench.run_ms(1_500);
        assert!(bench.has(Code::TemperatureOutOfRange), "{limits:?}");
        bench.configuration.temperature_limits = [25_000, 30_000].map(MilliCelsius);
        bench.run_ms(6_000);
        assert!(!bench.has(Code::TemperatureOutOfRange), "{limits:?}");
    }
}

/// What a client sets, restores or takes from the factory replaces what was retained or taken; nothing else does.
#[test]
fn key_factors_of_the_configuration_are_used_when_they_change() {
    let mut bench = Bench::new(Configuration::default());
    let factors = |k_ppb, a| KeyFactors {
        k_ppb,
        a: Microvolts(a),
    };
    let retained = RetainedState {
        key_factors: factors(1_001_000_000, 1_000),
        ..bench.measurement.retained(0)
    };
    let start = Instant::from_ticks(0);
    bench.measurement = Measurement::new(
        &bench.configuration,
        Some(&retained),
        Nanocoulombs::ZERO,
        start,
    );
    let used = |bench: &Bench| bench.measurement.retained(0).key_factors;
    assert_eq!(used(&bench), retained.key_factors);
    // Another setting leaves them.
    bench.configuration.soc.capacity_mah += 1;
    bench
        .measurement
        .configuration_changed(&bench.configuration);
    assert_eq!(used(&bench), retained.key_factors);
    bench.run_ms(500);
    let current = |bench: &Bench| bench.measurement.current().current.get();
    // 2.5 V · 0.1 % and 1 mV, at 37.5 mV/A; one code is 16.3 mA.
    assert!(
        (current(&bench) - 93_360).abs() < 16_300,
        "{}",
        current(&bench)
    );
    bench.configuration.key_factors = factors(1_000_000_000, -10_000);
    bench
        .measurement
        .configuration_changed(&bench.configuration);
    assert_eq!(used(&bench), bench.configuration.key_factors);
    bench.run_ms(500);
    assert!(
        (current(&bench) + 266_667).abs() < 16_300,
        "{}",
        current(&bench)
    );
    let set = effective_meter_config(
        &bench.configuration,
        bench.configuration.key_factors,
        bench.environment.supply,
    );
    assert_eq!(bench.measurement.meter_config(&bench.configuration), set);
}

/// The meter's factors follow configuration and supply, and its mean with them; the codes rightly stay.
#[test]
fn a_mean_that_moves_by_other_factors_makes_no_converter_stuck() {
    let mut bench = Bench::new(Configuration::default());
    bench.run_ms(2_000);
    bench
        .configuration
        .zero_drift
        .value
        .set(Range::Small, Microamps::from_amps(2));
    bench
        .measurement
        .configuration_changed(&bench.configuration);
    assert!(
        bench
            .measurement
            .due_meter_calibration(&bench.configuration)
            .is_some()
    );
    assert_eq!(
        bench
            .measurement
            .due_meter_calibration(&bench.configuration),
        None
    );
    // The meter has its new factors a poll later.
    bench.count_ms(30);
    bench.report.mean_current = Microamps::from_amps(-2);
    bench.count_ms(1_500);
    assert!(!bench.has(Code::ConverterStuck));
    // Over the supply's range, which moves the meter's mean by 10 %.
    for millivolts in (4_550..5_000).rev() {
        bench.environment.supply = Some(Microvolts::from_millivolts(millivolts));
        bench.report.mean_current = Microamps(-2_000_000 - (5_000 - millivolts) * 4_000);
        bench.count_ms(10);
        assert!(!bench.has(Code::ConverterStuck), "{millivolts} mV");
    }
    bench.count_ms(1_500);
    assert!(!bench.has(Code::ConverterStuck));
    // By nothing but itself it is the converter's fault.
    bench.report.mean_current = Microamps::from_amps(2);
    bench.count_ms(100);
    assert!(bench.has(Code::ConverterStuck));
}

/// After an anchor the presented value is still far from the estimate: what is sent with it covers the estimate's interval.
#[test]
fn what_is_presented_is_within_its_uncertainty_of_the_estimate() {
    let mut bench = Bench::new(Configuration::default());
    bench
        .measurement
        .set_state_of_charge(Ppm(500_000), Ppm(400_000));
    let capacity = bench.configuration.soc.capacity_mah;
    let share = |charge: Nanocoulombs| charge.get() as f64 / (f64::from(capacity) * 3.6e9) * 1e6;
    let mut farthest = 0.0_f64;
    for _ in 0..2_500 {
        bench.cell_at_4_v();
        bench.run_ms(1_000);
        let sent = bench.measurement.state_of_charge();
        let kept = bench.measurement.retained(0).soc;
        let distance = (share(kept.remaining) - f64::from(sent.state_of_charge.get())).abs();
        farthest = farthest.max(distance);
        let half_width = f64::from(sent.uncertainty.unwrap().get());
        assert!(
            half_width + 3.0 >= distance + share(kept.uncertainty),
            "{half_width} ppm at {distance} ppm"
        );
        let readings = bench.readings();
        assert_eq!(Some(readings.soc_uncertainty), sent.uncertainty);
    }
    assert!(farthest > 100_000.0, "{farthest}");
}

/// One refused step: a rate, not a converter that is stuck, for as long as its reading is the newest.
#[test]
fn a_refused_step_is_not_called_stuck() {
    let mut bench = Bench::new(with_front_end(FrontEnd::Hah1bv(Hah1bv::default())));
    bench.run_ms(1_500);
    assert!(bench.measurement.current().validity.is_valid());
    // 400 A within one conversion.
    bench.code += 2_622;
    let mut named = false;
    for _ in 0..50 {
        bench.run_ms(10);
        named |= bench.has(Code::RateImplausible);
        assert!(!bench.has(Code::ConverterStuck), "{} us", bench.now);
    }
    assert!(named);
    // Two conversions, and the 100 ms that the row keeps it.
    assert!(bench.measurement.current().validity.is_valid());
}

/// The current is known to be wrong, or the meter sees one: no rest, whatever the converter reads.
#[test]
fn no_anchor_while_the_current_is_known_to_be_wrong() {
    for (amps, anchors) in [(0, 1), (20, 0)] {
        let mut bench = Bench::new(Configuration::default());
        bench
            .measurement
            .set_state_of_charge(Ppm(500_000), Ppm(150_000));
        bench.report.mean_current = Microamps::from_amps(amps);
        for _ in 0..2_000 {
            bench.cell_at_4_v();
            // The meter counts on, the converter stands at 0 A: its last bit moves.
            bench.code ^= 1;
            let counted = Nanocoulombs::from_coulombs(i64::from(amps));
            bench.report.charge_total = bench.report.charge_total.saturating_add(counted);
            bench.run_ms(1_000);
        }
        assert_eq!(bench.readings().soc_anchors, anchors, "{amps} A");
    }
}

/// What the charge is doubted for by the meter's owner, the state of charge that follows it is as well.
#[test]
fn a_stale_meter_makes_the_state_of_charge_stale() {
    let mut bench = Bench::new(Configuration::default());
    bench
        .measurement
        .set_state_of_charge(Ppm(500_000), Ppm(20_000));
    let validity = |bench: &Bench| bench.measurement.state_of_charge().validity;
    // Not before the meter was read: what was restored stands.
    let report = MeterReport {
        at: None,
        ..bench.report
    };
    let causes = Validity::STALE.and(Validity::CALIBRATING);
    bench
        .measurement
        .on_meter(&bench.configuration, &report, causes);
    assert!(validity(&bench).is_valid());
    bench.run_ms(1_000);
    assert!(validity(&bench).is_valid());
    for cause in [Validity::STALE, Validity::CHIP_FAULT] {
        bench
            .measurement
            .on_meter(&bench.configuration, &bench.report, cause);
        assert_eq!(validity(&bench), cause);
    }
    bench.run_ms(20);
    assert!(validity(&bench).is_valid());
}

/// With the small sensor open the large one is right at any current: no contradiction to the flag.
#[test]
fn the_large_sensor_in_the_small_ones_place_is_no_implausible_flag() {
    let mut bench = Bench::new(Configuration::default());
    bench.run_ms(500);
    bench.range = Range::Large;
    bench.code = 4_096 + 123; // 20 A by the large sensor
    bench.environment.network = Some(network_output_open());
    bench.report.mean_current = Microamps::from_amps(20);
    bench.run_ms(500);
    assert!(bench.has(Code::SmallSensorOpen) && !bench.has(Code::FlagImplausible));
    let sent = bench.measurement.current();
    assert!(sent.validity.is_valid(), "{:?}", sent.validity);
    assert!((sent.current.get() - 20_000_000).abs() < 200_000);
    // The sensor is back, and the flag is not: now it contradicts.
    bench.environment.network = Some(network_output(Microvolts(2_500_000 + 750_000)));
    bench.run_ms(2_000);
    assert!(bench.has(Code::FlagImplausible) && !bench.has(Code::SmallSensorOpen));
}

#[test]
fn the_large_sensor_goes_on_when_the_small_one_is_open() {
    let mut bench = Bench::new(Configuration::default());
    bench.run_ms(500);
    bench.range = Range::Large;
    bench.code = 4_096 + 1_475; // 240 A by the large sensor
    bench.environment.network = Some(network_output_open());
    bench.run_ms(500);
    assert!(bench.has(Code::SmallSensorOpen) && !bench.has(Code::OpenSensor));
    let sent = bench.measurement.current();
    assert!(sent.validity.is_valid(), "{:?}", sent.validity);
    assert!((sent.current.get() - 240_000_000).abs() < 200_000);
    // The large sensor at its rail: nothing is left to measure with.
    bench.code = 100;
    bench.run_ms(200);
    assert!(bench.has(Code::SensorRail));
    assert!(
        bench
            .measurement
            .current()
            .validity
            .contains(Validity::OPEN)
    );
}

#[test]
fn a_flag_that_contradicts_the_level_is_reported_and_chatter_too() {
    let mut bench = Bench::new(Configuration::default());
    bench.run_ms(500);
    // Flag high, the large sensor at 10 A, and the small one agrees with it.
    bench.range = Range::Large;
    bench.code = 4_096 + 61;
    bench.environment.network = Some(network_output(Microvolts(2_500_000 + 375_000)));
    bench.run_ms(300);
    assert!(bench.has(Code::FlagImplausible));
    assert!(
        bench
            .measurement
            .current()
            .validity
            .contains(Validity::IMPLAUSIBLE)
    );
}

/// What one front end was found to have is not the next one's: nothing would judge it again.
#[test]
fn another_front_end_begins_without_the_faults_of_the_one_before() {
    // A flag that contradicts the level, an open small sensor, and an ADS1100 that does not answer.
    let found: [fn(&mut Bench); 3] = [
        |bench| {
            bench.range = Range::Large;
            bench.code = 4_096 + 61;
            bench.environment.network = Some(network_output(Microvolts(2_500_000 + 375_000)));
        },
        |bench| {
            bench.code = 0;
            bench.environment.network = Some(network_output_open());
        },
        |bench| {
            bench.next_conversion = u64::MAX;
            bench
                .measurement
                .on_converter_fault(ConverterFault::NoAnswer, Instant::from_ticks(bench.now));
        },
    ];
    for (case, find) in found.into_iter().enumerate() {
        let mut bench = Bench::new(Configuration::default());
        bench.run_ms(500);
        find(&mut bench);
        bench.run_ms(500);
        assert!(!bench.measurement.current().validity.is_valid(), "{case}");
        let converter = bench.configuration.converter;
        bench.configuration = with_front_end(FrontEnd::Network(Network::default()));
        bench.configuration.converter = converter;
        bench
            .measurement
            .configuration_changed(&bench.configuration);
        bench.environment.network = Some(network_output(Microvolts::ZERO));
        bench.range = Range::Small;
        bench.next_conversion = u64::MAX;
        bench.run_ms(2_500);
        let active = bench.measurement.diagnosis().active();
        assert!(
            bench.measurement.current().validity.is_valid(),
            "{case}: {active:?} {:?}",
            bench.measurement.current()
        );
    }
}

#[test]
fn readings_and_log_carry_what_is_on_the_bus() {
    let mut bench = Bench::new(Configuration::default());
    bench.code = 4_200;
    // In the end, after 990 ms of 1.692 A.
    bench.report.charge_total = Nanocoulombs(55_000_000_000 - 990 * 1_692_000);
    bench.report.charge_in = Nanocoulombs::from_coulombs(5);
    bench.report.charge_out = Nanocoulombs::from_coulombs(60);
    bench.report.mean_current = Microamps(1_692_000);
    bench.report.uncertainty = Nanocoulombs(77);
    bench.report.estimated_intervals = 3;
    bench
        .measurement
        .set_state_of_charge(Ppm(500_000), Ppm(10_000));
    bench.vehicle.can_key = Some(KeyState::Off);
    bench.measurement.on_battery_voltage(
        &BatteryVoltage {
            cell: Some(Microvolts(3_712_345)),
            pack: Some(Millivolts(371_000)),
            cell_temperature: None,
        },
        Instant::from_ticks(0),
    );
    bench.count_ms(990);
    bench.run_ms(5);
    let readings = bench.readings();
    let current = bench.measurement.current();
    let average = bench.measurement.current_average(&bench.configuration);
    assert_eq!(readings.current, current.current);
    assert_eq!(current.current, Microamps(1_692_708));
    assert_eq!(readings.current_average, average.average);
    assert_eq!(
        (average.samples, average.span),
        (8, Duration::from_ticks(7 * PERIOD_US))
    );
    assert_eq!(readings.conversions, current.conversions);
    assert_eq!(current.conversions, 31);
    assert_eq!(current.age, Some(Duration::from_ticks(990_000 - 968_750)));
    assert_eq!(readings.charge, Nanocoulombs::from_coulombs(55));
    assert_eq!(readings.charge_in, Nanocoulombs::from_coulombs(5));
    assert_eq!(readings.charge_out, Nanocoulombs::from_coulombs(60));
    assert_eq!(readings.charge_uncertainty, Nanocoulombs(77));
    assert_eq!(readings.meter_current, Microamps(1_692_000));
    assert_eq!(readings.estimated_intervals, 3);
    assert_eq!(readings.sensor_voltage, Microvolts(2_563_477));
    assert_eq!(readings.cell_voltage, Millivolts(3_712));
    assert_eq!(readings.pack_voltage, Millivolts(371_000));
    assert_eq!(readings.supply, Microvolts::from_millivolts(5_000));
    assert_eq!(readings.mcu_supply, Millivolts(3_300));
    assert_eq!(readings.sensor_temperature, MilliCelsius(25_000));
    assert_eq!(readings.board_temperature, MilliCelsius(30_000));
    assert_eq!(
        readings.network_voltage,
        network_output(Microvolts(2_500_000))
    );
    assert_eq!(readings.key_state, KeyState::Off as u16);
    assert!(!readings.high_voltage_on && !readings.high_voltage_permit);
    assert_eq!(
        readings.diagnoses_active,
        bench.measurement.diagnosis().active().bits()
    );
    assert_eq!(
        readings.diagnoses_latched,
        bench.measurement.diagnosis().latched().bits()
    );
    let soc = bench.measurement.state_of_charge();
    assert_eq!(readings.soc, soc.state_of_charge);
    assert_eq!(Some(readings.soc_uncertainty), soc.uncertainty);
    assert_eq!(Some(readings.remaining_charge), soc.remaining);
    assert!(readings.cell_validity.is_valid());
    bench.vehicle.voltage_fresh = false;
    bench.run_ms(20);
    assert_eq!(bench.readings().cell_validity, Validity::STALE);

    let record = bench.measurement.log_record(&bench.configuration, 9);
    assert_eq!(record.boot, 9);
    assert_eq!(record.uptime_ms, 1_010);
    assert_eq!(record.current, average.average);
    assert_eq!(record.charge, readings.charge);
    assert_eq!(record.soc, readings.soc);
    assert_eq!(record.supply, Millivolts(5_000));
    assert_eq!(record.temperature, Some(MilliCelsius(25_000)));
    assert_eq!(
        record.diagnoses,
        bench.measurement.diagnosis().reported().bits()
    );

    let state = bench.measurement.board_state(4, 5);
    assert_eq!((state.bus_offs, state.refused), (4, 5));
    assert_eq!(state.key, Some(KeyState::Off));
    assert_eq!(state.key_calibration, Some(KeyPhase::Off));
    assert_eq!(state.high_voltage, Some(false));
    let before = bench.measurement.throughput().discharged;
    bench.report.charge_total = Nanocoulombs::from_coulombs(65);
    bench.run_ms(20);
    let through = bench.measurement.throughput();
    assert_eq!(
        through.discharged.saturating_sub(before),
        Nanocoulombs::from_coulombs(10)
    );
    assert_eq!(through.charged, Nanocoulombs::ZERO);
}

#[test]
fn what_a_calibration_finds_goes_where_it_belongs() {
    let mut configuration = Configuration::default();
    Found::ZeroDrift(Range::Large, Microamps(5)).store(&mut configuration);
    assert_eq!(configuration.zero_drift.value.large, Microamps(5));
    assert_eq!(configuration.zero_drift.value.small, Microamps(0));
    let factors = KeyFactors {
        k_ppb: 1,
        a: Microvolts(2),
    };
    Found::KeyFactors(factors).store(&mut configuration);
    assert_eq!(configuration.key_factors, factors);
    let before = configuration;
    let relations = closed_loop().relations;
    Found::SupplyRelations(relations).store(&mut configuration);
    assert_eq!(
        configuration, before,
        "the dual-range sensor has no such relations"
    );
    configuration.front_end = FrontEnd::ClosedLoop(ClosedLoop::default());
    Found::SupplyRelations(relations).store(&mut configuration);
    assert_eq!(configuration.front_end, FrontEnd::ClosedLoop(closed_loop()));
}

/// The level of 30 A on the small sensor, read by the large one's scale.
#[test]
fn means_are_no_longer_than_what_is_known_to_be_right() {
    let mut configuration = Configuration::default();
    configuration.average.length = 64;
    let mut bench = Bench::new(configuration);
    let hall = Microvolts::from_millivolts(3_625);
    bench.code = 5_939;
    bench.environment.network = Some(network_output(hall));
    bench.report.mean_current = Microamps::from_amps(30);
    bench.count_ms(3_000);
    bench.range = Range::Large;
    bench.report.mean_current = Microamps::from_amps(300);
    bench.count_ms(1_000);
    assert!(bench.has(Code::FlagImplausible));
    bench.range = Range::Small;
    bench.report.mean_current = Microamps::from_amps(30);
    for _ in 0..500 {
        bench.count_ms(10);
        let average = bench.measurement.current_average(&bench.configuration);
        let off = average.average.saturating_sub(Microamps::from_amps(30));
        assert!(
            !average.validity.is_valid() || off.saturating_abs() < Microamps::from_amps(1),
            "{average:?}"
        );
    }
    let average = bench.measurement.current_average(&bench.configuration);
    assert_eq!((average.validity, average.samples), (Validity::VALID, 64));
}

/// An open sensor, whose level is a legal one all the same: 0 A in place of 30 A. The average's window is of two seconds, the
/// meter's of five.
#[test]
fn no_mean_that_has_something_of_a_fault_in_it_is_valid() {
    let mut configuration = Configuration::default();
    configuration.average.length = 64;
    let mut bench = Bench::new(configuration);
    let level = |bench: &mut Bench, network, code, amps| {
        bench.environment.network = Some(network);
        bench.code = code;
        bench.report.mean_current = Microamps::from_amps(amps);
    };
    let sound = network_output(Microvolts::from_millivolts(3_625));
    level(&mut bench, sound, 5_939, 30);
    bench.count_ms(3_000);
    let begun = Instant::from_ticks(bench.now);
    level(&mut bench, network_output_open(), 4_096, 0);
    bench.count_ms(1_000);
    assert!(bench.has(Code::OpenSensor));
    level(&mut bench, sound, 5_939, 30);
    let ended = bench.now;
    for since_ms in (0..10_000).step_by(10) {
        // Of the five seconds it was open for one.
        bench.mean = match since_ms {
            0..4_000 => None,
            4_000..9_000 => Some((24, begun)),
            _ => Some((30, Instant::from_ticks(ended + 4_000_000))),
        }
        .map(|(amps, begun)| (Microamps::from_amps(amps), begun));
        bench.count_ms(10);
        let average = bench.measurement.current_average(&bench.configuration);
        let meter = bench.measurement.meter_current();
        let on_modbus = bench.readings();
        for (mean, validity) in [
            (average.average, average.validity),
            (meter.current, meter.validity),
            (on_modbus.meter_current, on_modbus.meter_validity),
        ] {
            let off = mean.saturating_sub(Microamps::from_amps(30));
            assert!(
                !validity.is_valid() || off.saturating_abs() < Microamps::from_amps(1),
                "{since_ms} ms: {mean:?}, {validity:?}"
            );
        }
    }
    let average = bench.measurement.current_average(&bench.configuration);
    assert_eq!((average.validity, average.samples), (Validity::VALID, 64));
    let meter = bench.measurement.meter_current();
    assert_eq!(meter.validity, Validity::VALID);
}

/// A sensor that was beyond its range is right again 100 ms later; the meter's mean has something of that in it for the second of its
/// window. The mean's register waits, the charge's does not.
#[test]
fn the_charge_on_modbus_is_valid_as_soon_as_on_can() {
    let mut bench = Bench::new(with_front_end(FrontEnd::Hah1bv(Hah1bv::default())));
    bench.run_ms(1_000);
    bench.code = 7_500;
    bench.report.mean_current = Microamps::from_amps(500);
    bench.count_ms(2_000);
    assert!(bench.has(Code::SensorSaturated));
    bench.code = 4_096;
    bench.report.mean_current = Microamps::ZERO;
    let mut valid_after_ms = [None; 2];
    for since_ms in (0..3_000_u64).step_by(10) {
        let begun = bench.now.saturating_sub(1_000_000);
        bench.mean = Some((Microamps::ZERO, Instant::from_ticks(begun)));
        bench.count_ms(10);
        let readings = bench.readings();
        let on_can = bench.measurement.charge().validity;
        assert_eq!(readings.charge_validity, on_can, "{since_ms} ms");
        let validities = [readings.charge_validity, readings.meter_validity];
        for (after_ms, validity) in valid_after_ms.iter_mut().zip(validities) {
            if validity.is_valid() {
                after_ms.get_or_insert(since_ms);
            }
        }
    }
    let [charge, meter] = valid_after_ms.map(Option::unwrap);
    assert!(charge <= 200, "{charge} ms");
    assert!((1_000..1_200).contains(&meter), "{meter} ms");
}

/// A large sensor of 1,800 A, whose output at 0 A is as much as 2,000 A.
#[test]
fn bounds_follow_the_full_scale_of_the_sensors() {
    let front_end = FrontEnd::DualRange(DualRange {
        full_scale: PerRange {
            small: design::SMALL_FULL_SCALE,
            large: Microamps::from_amps(1_800),
        },
        ..DualRange::default()
    });
    let bound = |bench: &Bench| bench.readings().charge_uncertainty.get() / 1_000_000_000;
    let mut configuration = with_front_end(front_end);
    configuration.validate().unwrap();
    // A level that is neither sensor's, and the small one at its end: anything may flow.
    let mut bench = Bench::new(configuration);
    bench.range = Range::Large;
    bench.run_ms(3_000);
    bench.environment.network = Some(network_output(Microvolts::from_millivolts(4_800)));
    bench.run_ms(500);
    assert!(bench.has(Code::FlagImplausible));
    let before = bound(&bench);
    bench.run_ms(1_000);
    let declared = bound(&bench) - before;
    assert!((1_750..1_900).contains(&declared), "{declared} C");

    // The meter stands still, and for most of a second no converter sees what flows.
    let mut bench = Bench::new(configuration);
    bench.range = Range::Large;
    bench.environment.network = Some(network_output(Microvolts::from_millivolts(4_800)));
    bench.code = 4_096 + 205;
    bench.report.mean_current = Microamps::from_amps(100);
    bench.count_ms(3_000);
    bench.run_ms(1_500);
    assert!(bench.has(Code::MeterFrozen));
    let before = bound(&bench);
    bench.next_conversion = u64::MAX;
    bench.run_ms(800);
    bench
        .measurement
        .configuration_changed(&bench.configuration);
    bench.next_conversion = bench.now + PERIOD_US;
    bench.run_ms(100);
    let declared = bound(&bench) - before;
    assert!((1_400..1_650).contains(&declared), "{declared} C");

    // Each other reading of the supply is 40 mV higher: 20 mV of its mean, 0.4 %, are 8 A at 0 A.
    configuration.converter.supply_mode = SupplyMode::Measured;
    let mut bench = Bench::new(configuration);
    bench.range = Range::Large;
    bench.code = 4_112;
    for reading in 0..1_000 {
        let millivolts = 5_000 + reading % 2 * 40;
        bench.environment.supply = Some(Microvolts::from_millivolts(millivolts));
        bench.run_ms(10);
    }
    let (Outcome::Agree { bound, .. } | Outcome::Disagree { bound, .. }) =
        bench.measurement.compare_report().fast
    else {
        panic!("{:?}", bench.measurement.compare_report());
    };
    assert!(bound >= Nanocoulombs::from_coulombs(8), "{bound:?}");
}

/// What a reading carries itself does not enter: one that is saturated costs the average no more than its place.
#[test]
fn a_bad_reading_does_not_empty_the_average() {
    let mut bench = Bench::new(Configuration::default());
    bench.run_ms(3_000);
    bench.code = 8_191;
    bench.run_ms(32);
    bench.code = 4_096;
    bench.run_ms(20);
    assert!(bench.has(Code::SensorSaturated));
    bench.run_ms(200);
    let average = bench.measurement.current_average(&bench.configuration);
    assert_eq!((average.validity, average.samples), (Validity::VALID, 8));
}

/// A sensor beyond its range, and one at a rail: both channels see the same, and neither what flows.
#[test]
fn what_a_sensor_does_not_show_is_declared() {
    for code in [8_000, 0] {
        let mut bench = Bench::new(with_front_end(FrontEnd::Hah1bv(Hah1bv::default())));
        bench.measurement.set_state_of_charge(Ppm(500_000), Ppm(0));
        bench.run_ms(1_000);
        let before = bench.readings();
        assert!(before.charge_uncertainty < Nanocoulombs::from_coulombs(1));
        let since = bench.now;
        bench.code = code;
        bench.report.mean_current = Microamps::from_amps(if code == 0 { -562 } else { 500 });
        bench.count_ms(2_000);
        bench.code = 4_096;
        bench.report.mean_current = Microamps::ZERO;
        bench.count_ms(1_500);
        let readings = bench.readings();
        assert_eq!(readings.charge_validity, Validity::VALID);
        assert!(bench.measurement.charge().estimated);
        // Whatever within full scale has flowed; not for longer than it stood so, a conversion before and after, and the 100 ms
        // after which SensorSaturated clears.
        let time_us = (bench.now - since - 1_400_000) as i64 + 2 * PERIOD_US as i64;
        let counted = readings.charge.get().abs() / 1_000_000_000;
        let declared = readings.charge_uncertainty.get() / 1_000_000_000;
        assert!(declared >= counted + 1_000, "{declared} C");
        assert!(declared < 1_200 * time_us / 1_000_000, "{declared} C");
        // 240 Ah.
        let uncertainty = i64::from(readings.soc_uncertainty.get()) * 864 / 1_000;
        assert!(
            uncertainty >= declared - 1,
            "{uncertainty} C of {declared} C"
        );
    }
}

/// Line and CAN may follow the key at different times, but not a second apart.
#[test]
fn a_key_line_that_contradicts_can_is_reported() {
    for (acc_line, can_key) in [(false, KeyState::On), (true, KeyState::Off)] {
        let mut bench = Bench::new(Configuration::default());
        (bench.vehicle.acc_line, bench.vehicle.can_key) = (acc_line, Some(can_key));
        bench.run_ms(900);
        assert!(!bench.has(Code::KeyContradiction));
        bench.run_ms(300);
        assert!(bench.has(Code::KeyContradiction));
        bench.vehicle.acc_line = can_key != KeyState::Off;
        bench.run_ms(1_300);
        assert!(!bench.has(Code::KeyContradiction));
    }
}

/// A battery voltage that comes in time and says "not available" is none.
#[test]
fn a_cell_voltage_that_is_not_available_is_missing() {
    let mut bench = Bench::new(Configuration::default());
    bench.cell_at_4_v();
    bench.run_ms(6_000);
    assert!(bench.readings().cell_validity.is_valid() && !bench.has(Code::CellVoltageMissing));
    let unknown = BatteryVoltage {
        cell: None,
        pack: None,
        cell_temperature: None,
    };
    bench
        .measurement
        .on_battery_voltage(&unknown, Instant::from_ticks(bench.now));
    assert_eq!(bench.readings().cell_validity, Validity::STALE);
    bench.run_ms(6_000);
    assert!(bench.has(Code::CellVoltageMissing));
}

#[test]
fn missing_messages_and_the_key_without_samples_are_reported() {
    let mut bench = Bench::new(Configuration::default());
    bench.vehicle.state_fresh = false;
    bench.vehicle.voltage_fresh = false;
    bench.run_ms(6_000);
    assert!(bench.has(Code::VehicleStateMissing) && bench.has(Code::CellVoltageMissing));
    // The key turned at once: no output was taken with key OFF.
    let mut bench = Bench::new(Configuration::default());
    bench.vehicle.acc_line = true;
    bench.run_ms(3_000);
    assert_eq!(bench.readings().key_calibration_state, 3);
    assert!(
        bench.tick.unwrap().hv_permit,
        "permitted with the previous factors"
    );
    assert!(
        bench
            .measurement
            .diagnosis()
            .latched()
            .contains(Code::KeyCalibrationFailed)
    );
    assert!(bench.readings().high_voltage_permit);
    assert_eq!(bench.order(Order::ClearDiagnoses), Ok(()));
    // High voltage with the key OFF is without a permit.
    bench.vehicle.acc_line = false;
    bench.vehicle.hv_feedback = true;
    bench.run_ms(2_500);
    assert!(bench.has(Code::HvWithoutPermit));
    assert!(bench.readings().high_voltage_on);
}

/// What the comparators never reach while the small sensor still follows would leave it at its end for good.
#[test]
fn a_switching_current_beyond_the_small_sensor_is_refused() {
    let put = |amps: i64, front_end: i64| {
        let mut configuration = Configuration::default();
        for (address, value) in [(0x0100, front_end), (0x050E, amps * 1_000_000)] {
            let field = FIELDS.iter().find(|field| field.layout.address == address);
            field.unwrap().put(&mut configuration, 0, value).unwrap();
        }
        configuration.validate()
    };
    assert_eq!(put(59, 0), Ok(()));
    for amps in [60, 61, 500] {
        assert!(put(amps, 0).is_err(), "{amps} A");
        // With one sensor it says nothing.
        assert_eq!(put(amps, 1), Ok(()));
    }
}

/// By the meter's full scale of 562.5 A 28 mA may flow at rest without a count, of which 0x0712 of the factory says 3.
#[test]
fn what_a_single_sensor_may_leave_uncounted_is_doubted() {
    let uncertainty = |front_end| {
        let mut configuration = with_front_end(front_end);
        configuration.soc.capacity_mah = 1_000;
        let mut bench = Bench::new(configuration);
        bench.measurement.set_state_of_charge(Ppm(500_000), Ppm(0));
        bench.run_ms(600_000);
        bench.readings().soc_uncertainty.get()
    };
    // Beside the offset's 20 mA, of 3,600 C: 23 and 48.1 mA over 600 s.
    let d0 = uncertainty(FrontEnd::default());
    assert!((3_800..3_860).contains(&d0), "{d0} ppm");
    let d2 = uncertainty(FrontEnd::Hah1bv(Hah1bv::default()));
    assert!((7_980..8_050).contains(&d2), "{d2} ppm");
}

/// They are of the sensor that was there, or of its full scale.
#[test]
fn another_front_end_comes_without_what_was_found_of_the_one_before() {
    let mut configuration = Configuration::default();
    let value = PerRange {
        small: Microamps(800_000),
        large: Microamps(-3_000_000),
    };
    let gain = PerRange {
        small: Ppm(12_000),
        large: Ppm(-30_000),
    };
    configuration.zero_drift.value = value;
    configuration.key_factors.a = Microvolts(10_000);
    configuration.current_gain = gain;
    configuration.meter.gain = gain;
    configuration.meter.offset = value;
    // The board's own.
    configuration.meter.reference_error = Ppm(500);
    configuration.meter.divider_error = Ppm(-700);
    let before = configuration;
    let front_end = FIELDS.iter().find(|field| field.layout.address == 0x0100);
    front_end.unwrap().put(&mut configuration, 0, 0).unwrap();
    assert_eq!(configuration, before);
    front_end.unwrap().put(&mut configuration, 0, 1).unwrap();
    let found = (configuration.zero_drift.value, configuration.key_factors);
    assert_eq!(found, (PerRange::both(Microamps::ZERO), KeyFactors::NONE));
    let meter = &configuration.meter;
    let gains = (configuration.current_gain, meter.gain, meter.offset);
    let none = PerRange::both(Ppm::ZERO);
    assert_eq!(gains, (none, none, PerRange::both(Microamps::ZERO)));
    let board = (meter.reference_error, meter.divider_error);
    assert_eq!(board, (Ppm(500), Ppm(-700)));
}

/// 100 A of the HAH1BV, whose 2.9 V were 10.67 A of the small sensor; a zero drift of 5 A; and factors of a key cycle. Nothing valid has
/// something of before in it; a setting that has no part in the current leaves the average alone.
#[test]
fn the_average_holds_nothing_that_was_read_by_another_sensor_or_correction() {
    let mut configuration = Configuration::default();
    configuration.average.length = 64;
    let mut bench = Bench::new(configuration);
    // 2.9 V of 5 V.
    bench.code = 4_751;
    bench.report.mean_current = Microamps(10_666_667);
    bench.count_ms(3_000);
    let average = |bench: &Bench| bench.measurement.current_average(&bench.configuration);
    assert_eq!(average(&bench).validity, Validity::VALID);
    let follows = |bench: &mut Bench, amps: i32| {
        bench
            .measurement
            .configuration_changed(&bench.configuration);
        bench.report.mean_current = Microamps::from_amps(amps);
        let mut waited_ms = 0;
        for since_ms in (0..3_000).step_by(10) {
            let average = average(bench);
            let off = average.average.saturating_sub(Microamps::from_amps(amps));
            assert!(
                !average.validity.is_valid() || off.saturating_abs() < Microamps(200_000),
                "{amps} A, {since_ms} ms: {average:?}"
            );
            waited_ms += if average.validity.is_valid() { 0 } else { 10 };
            bench.count_ms(10);
        }
        // Until the next conversion.
        assert!(waited_ms <= 40, "{waited_ms} ms");
    };
    bench.configuration = with_front_end(FrontEnd::Hah1bv(Hah1bv::default()));
    bench.configuration.average.length = 64;
    follows(&mut bench, 100);
    bench.configuration.zero_drift.value = PerRange::both(Microamps::from_amps(5));
    follows(&mut bench, 95);
    bench.configuration.key_factors.a = Microvolts::from_millivolts(40);
    follows(&mut bench, 105);
    bench.configuration.soc.capacity_mah += 1;
    bench.configuration.converter.stale_after_periods += 1;
    bench
        .measurement
        .configuration_changed(&bench.configuration);
    let average = average(&bench);
    assert_eq!((average.validity, average.samples), (Validity::VALID, 64));
}

/// A gap shorter than what lies between two conversions would leave the average without a reading in each of them.
#[test]
fn the_averages_gap_is_longer_than_two_conversions() {
    let judge = |data_rate, max_gap_ms| {
        let mut configuration = Configuration::default();
        configuration.key_calibration.enabled = false;
        configuration.converter.data_rate = data_rate;
        configuration.average.max_gap_ms = max_gap_ms;
        configuration.validate()
    };
    assert!(judge(DataRate::Sps8, 100).is_err());
    assert!(judge(DataRate::Sps8, 249).is_err());
    assert!(judge(DataRate::Sps16, 124).is_err());
    assert_eq!(judge(DataRate::Sps8, 250), Ok(()));
    assert_eq!(judge(DataRate::Sps16, 125), Ok(()));
    assert_eq!(judge(DataRate::Sps32, 100), Ok(()));
    assert_eq!(judge(DataRate::Sps128, 100), Ok(()));
}

/// The shortest gap that is accepted, at the slowest rate: valid all the time.
#[test]
fn an_average_of_slow_conversions_is_not_stale_between_them() {
    for max_gap_ms in [100, 249, 250] {
        let mut configuration = Configuration::default();
        configuration.key_calibration.enabled = false;
        configuration.converter.data_rate = DataRate::Sps8;
        configuration.average.max_gap_ms = max_gap_ms;
        if configuration.validate().is_err() {
            continue;
        }
        let mut bench = Bench::new(configuration);
        bench.period_us = 125_000;
        bench.code = 16_384;
        bench.run_ms(2_000);
        let valid = (0..1_000).filter(|_| {
            bench.run_ms(10);
            let average = bench.measurement.current_average(&bench.configuration);
            average.validity.is_valid()
        });
        assert_eq!(valid.count(), 1_000, "{max_gap_ms} ms");
    }
}
