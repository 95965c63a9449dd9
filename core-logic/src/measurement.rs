//! The composition: what the board's owners hand in, and what goes out on CAN, RS485 and into the log.
//!
//! ```text
//! on_conversion, on_converter_fault ┐
//! on_meter                          ├─→ Measurement ─→ current(), charge(), … frames of `can`
//! on_environment, on_battery_voltage┤               ├─→ fill(Readings) for `modbus`
//! tick (10 ms)                      ┘               └─→ retained(), log_record()
//! ```
//!
//! It belongs to one owner (the firmware's priority-2 task) and never blocks. The configuration is not part of it: the
//! caller hands in the active one, tells by [`Measurement::configuration_changed`] when it is another one, and has the
//! factors that follow from it checked by [`Measurement::check_factors`].
//!
//! **The meter hangs on the same sensor.** What is known about the sensor (zero drift, key-state factors, supply) holds
//! for the charge as well as for the current: [`effective_meter_config`] works it into the meter's scale and offset.

mod orders;
mod told;

pub use orders::{Found, Order, Refusal};

use crate::can;
use crate::channel_compare::{ChannelCompare, Conversion, Outcome};
use crate::configuration::Configuration;
use crate::converter::{
    Adc1Sample, Converter, ConverterCoefficients, ConverterSample, Corrections, CurrentReading,
    SampleContext, SupplyMode,
};
use crate::design_parameters as design;
use crate::diagnosis::{Changes, Code, CodeSet, Diagnosis, Effects};
use crate::front_end::{
    Channel, FrontEnd, KeyFactors, PerRange, SupplyRelations, network_output_nanovolts,
};
use crate::gap::{self, Gap};
use crate::key_calibration::{
    KeyCalibration, KeyInputs, KeyOutputs, KeyPhase, KeySample, KeyState,
};
use crate::meter::{MeterCalibration, MeterConfig, MeterReport};
use crate::modbus::readings::CommandState;
use crate::open_sensor::{Finding, OpenSensor, OpenSensorThresholds};
use crate::range::{
    ChatterDetector, ChatterReport, FlagObservation, FlagPlausibility, FlagReport, Miscounted,
    Range, RangeHistory,
};
use crate::retained::RetainedState;
use crate::sliding_average::{Average, SlidingAverage};
use crate::soc::{CellVoltage, LONGEST_UNSEEN_REST, Soc, SocCoefficients, SocInput, SocReading};
use crate::supply_calibration::SupplyCalibration;
use crate::units::{
    Duration, Instant, Microamps, Microvolts, MilliCelsius, Millivolts, Nanocoulombs, Ppm, add_i64,
    clamp_i32, div_round, elapsed, mul_div, sub_i64,
};
use crate::validity::Validity;
use crate::zero_drift::{ZeroCalibration, ZeroConditions, ZeroRefusal};

/// What ADC1 and the temperature sensors say; `None` for what could not be read.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Environment {
    /// Supply of the Hall sensors.
    pub supply: Option<Microvolts>,
    /// Voltage at the open-sensor channel's pin.
    pub network: Option<Microvolts>,
    /// Temperature by the meter's own sensor, next to the Hall sensors.
    pub sensor_temperature: Option<MilliCelsius>,
    /// Temperature of the microcontroller.
    pub board_temperature: Option<MilliCelsius>,
    /// Supply of the microcontroller.
    pub controller_supply: Option<Millivolts>,
}

/// Lines of the vehicle, and what the vehicle says on CAN while it is fresh.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Vehicle {
    /// Key line: high from ACC on.
    pub acc_line: bool,
    /// High-voltage feedback line.
    pub hv_feedback: bool,
    /// Key state received.
    pub can_key: Option<KeyState>,
    /// High-voltage state received.
    pub can_high_voltage: Option<bool>,
    /// Whether `VehicleState` is fresh.
    pub state_fresh: bool,
    /// Whether `BatteryVoltage` is fresh.
    pub voltage_fresh: bool,
}

/// How a read of the ADS1100 failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ConverterFault {
    /// It did not answer.
    NoAnswer,
    /// It lost its configuration.
    ConfigurationLost,
}

/// What a tick results in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tick {
    /// Whether the high voltage may be on: the permit output.
    pub hv_permit: bool,
    /// Diagnoses that came and went.
    pub changes: Changes,
}

/// The supply is averaged over 32 readings: one code of ADC1 is 1.6 mV of a 5 V supply, and one of its reference, averaged over 16
/// before, 3.3 mV. Of 1 code of noise (rms) that leaves less than 3.3 mV · √(1/31) and 1.6 mV · √(1/63): 0.63 mV.
const SUPPLY_READINGS: i32 = 32;
/// New factors are worked out for a mean that has moved so far: 0.06 % of the meter's scale, of the 0.1 % that
/// [`design::SUPPLY_RESIDUAL`] allows. The noise above, 4.8 times less, moves no further in minutes.
const SUPPLY_STEP: Microvolts = Microvolts::from_millivolts(3);
const _: () = assert!(SUPPLY_STEP.get() / 5 < design::SUPPLY_RESIDUAL.get());
/// Readings further than this from the mean, [`SUPPLY_CONFIRMATIONS`] in a row on one side of it and no further from each other,
/// are no noise and no ripple: the mean begins anew there. Half a per cent, which the meter's scale would be wrong by for as long
/// as the mean takes to follow; the converter's noise is a tenth of it.
const SUPPLY_JUMP: Microvolts = Microvolts::from_millivolts(25);
const SUPPLY_CONFIRMATIONS: u8 = 3;
/// A reading further than this from what the factors are of widens what the channels may differ by. Twice the 0.1 % that the
/// tolerances have in them, 5.9 times the rms noise of one reading: √(1.6² + 3.3² / 31) mV.
const SUPPLY_DOUBT: Microvolts = Microvolts::from_millivolts(10);
const _: () = assert!(
    SUPPLY_DOUBT.get() as i64 * 1_000_000
        == 2 * design::SUPPLY_RESIDUAL.get() as i64 * design::SENSOR_NOMINAL_SUPPLY.get() as i64
);
/// A reading further than this from the mean says that the network cannot be judged by it: from the end of the small sensor's range
/// to halfway to its supply are 112 mV of 4.5 V. The network of D3's own sensor does not hang on it.
const NETWORK_SUPPLY_DOUBT: Microvolts = Microvolts::from_millivolts(100);
/// 1 ppm of the lowest supply in µV, rounded down: a difference in µV by it is a share in ppm, or more.
const SUPPLY_PPM: i32 = design::SENSOR_SUPPLY_LOW.get() / 1_000_000;
/// By then the meter counts with the factors that it is handed: a tick and a poll.
const METER_FOLLOWS: Duration = Duration::from_ticks(50_000);
/// Environment readings older than this are missing.
const ENVIRONMENT_TIMEOUT: Duration = Duration::from_ticks(500_000);
/// The first conversion is there by then: the chip's first result after power-up is discarded, and a conversion at
/// 8 samples a second takes 125 ms.
const START_UP: Duration = Duration::from_ticks(500_000);
/// Above this the state of charge is reported as uncertain: a tenth of the capacity.
pub const SOC_UNCERTAINTY_LIMIT: Ppm = Ppm(100_000);

/// What the factors follow from besides the configuration.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Basis {
    factors: KeyFactors,
    supply: Option<Microvolts>,
    /// Tells it from those before.
    number: u32,
}

/// The configuration worked into factors.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Prepared {
    converter: ConverterCoefficients,
    open_sensor: OpenSensorThresholds,
    soc: SocCoefficients,
    /// The supply that went into it.
    supply: Option<Microvolts>,
}

/// The composition's state.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct Measurement {
    converter: Converter,
    converter_fault: Option<ConverterFault>,
    /// The converter's configuration before the present one, of which a conversion may be under way.
    retired: Option<u8>,
    conversions: u32,
    invalid_conversions: u32,
    refused_steps: u32,
    /// The newest conversion was refused for its rate of change.
    rate_refused: bool,
    reading: CurrentReading,
    /// When the meter's newest report found it valid.
    current_known_at: Instant,
    open_sensor: OpenSensor,
    flag: FlagReport,
    flag_plausibility: FlagPlausibility,
    chatter_detector: ChatterDetector,
    chatter: ChatterReport,
    meter: MeterReport,
    gap: Gap,
    /// What faults have miscounted that were found: a meter that stood still or disagreed, a flag against the level, a sensor
    /// that showed nothing.
    miscounted: Nanocoulombs,
    /// As much of the charge's doubt as the state of charge has in its own.
    doubted: Nanocoulombs,
    meter_causes: Validity,
    /// Of the [`Basis`] and the configuration that the factors are worked out of: counts their changes, from 1.
    basis_number: u32,
    /// [`Measurement::meter_config`] is to be handed to the meter's owner.
    meter_calibration_due: bool,
    zero: ZeroCalibration,
    zero_beyond_limit: bool,
    key: KeyCalibration,
    /// The configuration's, as they were last seen: only others replace those in use.
    key_factors_set: KeyFactors,
    key_outputs: KeyOutputs,
    soc: Soc,
    soc_reading: SocReading,
    environment: Environment,
    environment_at: Option<Instant>,
    /// The mean; the factors in use are of one up to [`SUPPLY_STEP`] beside it.
    supply: Option<Microvolts>,
    /// Readings in a row that say that the supply has jumped.
    supply_jump: u8,
    /// The reading that the next one is compared with.
    newest_supply: Microvolts,
    cell_voltage: Option<CellVoltage>,
    pack_voltage: Option<Millivolts>,
    vehicle: Vehicle,
    history: RangeHistory,
    diagnosis: Diagnosis,
    effects: Effects,
    /// Of an order, until it is taken.
    found: Option<Found>,
    /// The key factors in use are others than those that were taken last. Apart from the above: a key cycle ends when it does.
    factors_found: bool,
    order_outcome: (CommandState, u16),
    /// The newest order is a key-state calibration, and it has not ended.
    key_ordered: bool,
    /// Charge that the reset may have cost.
    loss: Nanocoulombs,
    started: Instant,
    now: Instant,
    // The largest parts come last, hence `repr(C)`: the nearer a member is, the shorter is the instruction that reaches it.
    /// Of [`Measurement::miscounted`] what the sensor has not shown.
    unseen: Miscounted,
    compare: ChannelCompare,
    sweep: Option<SupplyCalibration>,
    average: SlidingAverage,
    prepared: Prepared,
    /// Against a mean of the meter that began before the last fault in its charge ended …
    mean_causes: Validity,
    /// … which was then.
    faulty_until: Instant,
}

/// The meter's configuration with everything that is known about the sensor in front of it: zero drift, key-state
/// factors and supply.
///
/// With `I = (k·(V + a) − V0)·G − zero` the meter, which sees `(V − V0)·G`, reads the true current divided by k, and
/// at 0 A it reads what a sensor output of `(V0 + zero/G)/k − a` gives.
///
/// The level shift in front of channel 1 is half the sensor's supply, or the network's own zero (D3). A ratiometric sensor's output
/// follows the supply with it: the correction is 5 V / Vc, and what its zero is away from 2.5 V stays as an offset.
#[must_use]
pub fn effective_meter_config(
    configuration: &Configuration,
    factors: KeyFactors,
    supply: Option<Microvolts>,
) -> MeterConfig {
    let mut meter = configuration.meter;
    let nominal = design::SENSOR_NOMINAL_SUPPLY;
    let supply = supply
        .filter(|_| configuration.converter.supply_mode != SupplyMode::Fixed)
        .unwrap_or(nominal)
        .clamp(design::SENSOR_SUPPLY_LOW, design::SENSOR_SUPPLY_HIGH);
    let one = i64::from(Ppm::ONE.get());
    for range in [Range::Small, Range::Large] {
        let line = configuration.front_end.line(range, supply);
        // Share by which the reading has to be multiplied, and the level shift as the front end's signal has it, in nV.
        let (supply_factor, level) = match configuration.front_end {
            FrontEnd::DualRange(_) | FrontEnd::Hah1bv(_) => (
                mul_div(one, i64::from(nominal.get()), i64::from(supply.get())),
                i64::from(nominal.get()) * 500,
            ),
            FrontEnd::ClosedLoop(_) => {
                let rated = configuration.front_end.line(range, nominal);
                let factor = mul_div(
                    mul_div(one, line.numerator, line.denominator),
                    rated.denominator,
                    rated.numerator,
                );
                (factor, i64::from(supply.get()) * 500)
            }
            // Its sensor runs from ±15 V.
            FrontEnd::Network(_) => (one, const { network_output_nanovolts(0) }),
        };
        let factors = if range == KeyCalibration::RANGE || !configuration.front_end.has_two_ranges()
        {
            factors
        } else {
            KeyFactors::NONE
        };
        let k_ppm = div_round(i64::from(factors.k_ppb), 1_000);
        let zero_at_input = i64::from(
            line.voltage(configuration.zero_drift.value.get(range))
                .get(),
        );
        let scaled = mul_div(
            zero_at_input,
            i64::from(KeyFactors::K_ONE_PPB),
            i64::from(factors.k_ppb),
        );
        let input_at_zero = sub_i64(scaled, i64::from(factors.a.get()));
        let sensor_zero_at_zero = line.current(Microvolts(clamp_i32(input_at_zero))).get();
        let shift = mul_div(
            line.zero_nanovolts - level,
            line.numerator,
            line.denominator,
        );
        let offset = add_i64(i64::from(sensor_zero_at_zero), shift);
        let gain = mul_div(
            mul_div(
                one + i64::from(meter.gain.get(range).get()),
                supply_factor,
                one,
            ),
            k_ppm,
            one,
        ) - one;
        meter.gain.set(range, Ppm(clamp_i32(gain)));
        // The offset is subtracted after the gain.
        let offset = mul_div(offset, k_ppm, one);
        let own = meter.offset.get(range);
        meter
            .offset
            .set(range, own.saturating_add(Microamps(clamp_i32(offset))));
    }
    meter
}

/// Works the factors out: 25,000 instructions, to be done where nobody waits.
#[must_use]
#[inline(never)]
pub fn prepare(configuration: &Configuration, basis: &Basis) -> Prepared {
    let &Basis {
        factors, supply, ..
    } = basis;
    let two_ranges = configuration.front_end.has_two_ranges();
    let corrections = Corrections {
        key_factors: PerRange {
            small: factors,
            large: if two_ranges {
                KeyFactors::NONE
            } else {
                factors
            },
        },
        gain: configuration.current_gain,
        zero_drift: configuration.zero_drift.value,
    };
    // A larger sensor's meter leaves more uncounted than the setting's 3 mA of D0.
    let mut soc = configuration.soc;
    soc.no_load_threshold = soc
        .no_load_threshold
        .max(configuration.meter.no_load_current(Range::Small));
    Prepared {
        converter: ConverterCoefficients::prepare(
            &configuration.converter,
            &configuration.front_end,
            &corrections,
            supply,
        ),
        open_sensor: OpenSensorThresholds::prepare(
            &configuration.open_sensor,
            &configuration.front_end,
            supply,
        ),
        soc: SocCoefficients::new(&soc),
        supply,
    }
}

/// Whether they differ by `limit` or more. Out of line for the image's size.
#[inline(never)]
fn is_beyond(a: Microvolts, b: Microvolts, limit: Microvolts) -> bool {
    a.get().abs_diff(b.get()) >= limit.get().unsigned_abs()
}

/// A share of the sensor's output at 0 A, as a current: 2.5 V, where the meter's full scale is 2.25 V. Rounded up to 67 of 60, as D0's
/// sensors have 67 and 670 A.
#[inline(never)]
fn share_of_zero_output(meter_full_scale: Microamps, share: Ppm) -> Microamps {
    let rounded_up = 67 * i64::from(meter_full_scale.get());
    Microamps(clamp_i32(mul_div(
        rounded_up,
        share.get().into(),
        60_000_000,
    )))
}

/// When the meter counts by factors that change at `now`.
fn meter_follows(now: Instant) -> Instant {
    now.checked_add_duration(METER_FOLLOWS).unwrap_or(now)
}

impl Measurement {
    /// Starts, going on from `retained` where there is such a state. `loss` is the charge that the reset may have cost;
    /// zero after a clean restart.
    #[must_use]
    pub fn new(
        configuration: &Configuration,
        retained: Option<&RetainedState>,
        loss: Nanocoulombs,
        now: Instant,
    ) -> Self {
        let factors = retained.map_or(configuration.key_factors, |state| state.key_factors);
        let prepared = prepare(
            configuration,
            &Basis {
                factors,
                supply: None,
                number: 1,
            },
        );
        let mut soc = retained.map_or_else(
            || Soc::new(&prepared.soc),
            |state| Soc::restore(&prepared.soc, &state.soc, state.charge_total),
        );
        if loss != Nanocoulombs::ZERO {
            soc.declare_loss(&prepared.soc, loss);
        }
        let mut measurement = Self {
            prepared,
            converter: Converter::new(),
            converter_fault: None,
            retired: None,
            conversions: 0,
            invalid_conversions: 0,
            refused_steps: 0,
            rate_refused: false,
            reading: Converter::new().reading(&prepared.converter, now),
            current_known_at: now,
            average: SlidingAverage::new(),
            open_sensor: OpenSensor::new(),
            flag: FlagReport::default(),
            flag_plausibility: FlagPlausibility::new(),
            chatter_detector: ChatterDetector::new(),
            chatter: ChatterReport::default(),
            compare: ChannelCompare::new(),
            meter: MeterReport::default(),
            gap: Gap::new(now),
            miscounted: Nanocoulombs::ZERO,
            unseen: Miscounted::NONE,
            doubted: Nanocoulombs::ZERO,
            meter_causes: Validity::STALE,
            mean_causes: Validity::VALID,
            faulty_until: now,
            basis_number: 1,
            meter_calibration_due: true,
            zero: ZeroCalibration::new(),
            zero_beyond_limit: false,
            sweep: None,
            key: KeyCalibration::new(factors, now),
            key_factors_set: configuration.key_factors,
            key_outputs: KeyOutputs {
                hv_permit: false,
                key: KeyState::Off,
                phase: KeyPhase::Off,
                new_factors: None,
                hv_without_permit: false,
                key_contradiction: false,
                refusal: None,
            },
            soc_reading: soc.reading(&prepared.soc),
            soc,
            environment: Environment::default(),
            environment_at: None,
            supply: None,
            supply_jump: 0,
            newest_supply: Microvolts(0),
            cell_voltage: None,
            pack_voltage: None,
            vehicle: Vehicle::default(),
            history: RangeHistory::steady(now, Range::Small),
            diagnosis: Diagnosis::default(),
            effects: Effects::default(),
            found: None,
            factors_found: false,
            order_outcome: (CommandState::None, 0),
            key_ordered: false,
            loss,
            started: now,
            now,
        };
        if let Some(state) = retained {
            measurement.meter.charge_total = state.charge_total;
        }
        measurement
    }

    /// The active configuration is another one: factors are worked out anew, nothing measured is lost but an average of
    /// what would read otherwise now. The meter's owner has to be handed [`Measurement::meter_config`] as well.
    pub fn configuration_changed(&mut self, configuration: &Configuration) {
        let converter = self.prepared.converter;
        if self.key_factors_set != configuration.key_factors {
            self.key_factors_set = configuration.key_factors;
            self.key.set_factors(configuration.key_factors);
        }
        let (factors, supply) = (self.key.factors(), self.prepared.supply);
        self.prepare_again(configuration, factors, supply, true, self.now);
        if converter.configuration() != self.prepared.converter.configuration() {
            // Of two changes in a row: what is under way is of before the first.
            self.retired = self.retired.or(Some(converter.configuration()));
        }
        self.converter
            .reconfigured(&converter, &self.prepared.converter, self.now);
        if converter.channel() != self.prepared.converter.channel() {
            // What was found with the other front end would stand: nothing judges it with this one.
            self.converter_fault = None;
            self.open_sensor = OpenSensor::new();
            self.flag = self.flag_plausibility.rest();
        }
        self.soc.change_capacity(&self.prepared.soc);
        self.soc_reading = self.soc.reading(&self.prepared.soc);
    }

    /// What the meter's owner has to count with, if that has changed or is to be checked since the last call.
    pub fn due_meter_calibration(
        &mut self,
        configuration: &Configuration,
    ) -> Option<MeterCalibration> {
        core::mem::take(&mut self.meter_calibration_due)
            .then(|| MeterCalibration::new(self.meter_config(configuration), self.basis_number))
    }

    /// What the factors follow from besides the configuration, for [`prepare`].
    #[must_use]
    pub const fn basis(&self) -> Basis {
        Basis {
            factors: self.key.factors(),
            supply: self.prepared.supply,
            number: self.basis_number,
        }
    }

    /// Compares the factors in use with those that were worked out anew, of `basis` and a configuration that was just found
    /// sound; whether they are others, as only damage makes them. They are replaced then. The meter's owner is handed its own
    /// again, and finds their damage itself.
    pub fn check_factors(&mut self, basis: &Basis, prepared: &Prepared) -> bool {
        self.meter_calibration_due = true;
        // With another basis they have been worked out anew meanwhile.
        if basis.number != self.basis_number || self.prepared == *prepared {
            return false;
        }
        if self.prepared.soc != prepared.soc {
            // What it has cut off or lost by them nobody knows.
            self.soc.declare_loss(&prepared.soc, Nanocoulombs(i64::MAX));
        }
        self.prepared = *prepared;
        self.average.clear();
        self.compare.restart_at(self.now);
        true
    }

    /// Other factors, in the converter at once and in the meter a little later. `anew`: what was compared by those before says nothing;
    /// not so where they differ by the supply alone.
    fn prepare_again(
        &mut self,
        configuration: &Configuration,
        factors: KeyFactors,
        supply: Option<Microvolts>,
        anew: bool,
        now: Instant,
    ) {
        self.basis_number = self.basis_number.wrapping_add(1);
        let converter = self.prepared.converter;
        self.prepared = prepare(
            configuration,
            &Basis {
                factors,
                supply,
                number: self.basis_number,
            },
        );
        self.meter_calibration_due = true;
        if anew {
            // What it holds was read by another sensor's scale, or with another correction.
            if !converter.reads_like(&self.prepared.converter) {
                self.average.clear();
            }
            let at = meter_follows(now);
            self.converter.forget_meter_until(at);
            self.compare.restart_at(at);
        }
    }

    /// What the meter's owner has to count with.
    #[must_use]
    pub fn meter_config(&self, configuration: &Configuration) -> MeterConfig {
        effective_meter_config(configuration, self.key.factors(), self.prepared.supply)
    }

    /// A finished conversion of the ADS1100, with the range history of the moment at which it was read.
    pub fn on_conversion(
        &mut self,
        configuration: &Configuration,
        sample: &ConverterSample,
        history: &RangeHistory,
    ) {
        let expected = configuration.converter.expected_configuration();
        // Begun before the configuration changed: its scale is the old one, but nothing was lost.
        if self.retired.take() == Some(sample.configuration) && sample.configuration != expected {
            return;
        }
        let context = self.context(configuration, history, sample.started);
        let reading = self.converter.on_sample(
            &configuration.converter,
            &self.prepared.converter,
            sample,
            &context,
        );
        let lost = sample.configuration != expected;
        self.converter_fault = lost.then_some(ConverterFault::ConfigurationLost);
        if let Some(reading) = reading {
            self.on_reading(configuration, reading, sample.started, history);
        }
        self.judge_flag(configuration, i32::from(sample.code), history);
    }

    /// The ADS1100 delivered nothing.
    pub fn on_converter_fault(&mut self, fault: ConverterFault, at: Instant) {
        if self.prepared.converter.channel() == Channel::Ads1100 {
            self.converter_fault = Some(fault);
            self.reading = self.converter.on_fault(at);
        }
    }

    /// What ADC1 and the temperature sensors say. For a front end on ADC1 (D3) the network's voltage is the conversion.
    pub fn on_environment(
        &mut self,
        configuration: &Configuration,
        environment: Environment,
        history: &RangeHistory,
        now: Instant,
    ) {
        self.environment = environment;
        self.environment_at = Some(now);
        self.average_supply(configuration, environment.supply, now);
        let Some(network) = environment.network else {
            return;
        };
        let is_adc1 = self.prepared.converter.channel() == Channel::Adc1;
        // A sensor at the end of its range follows a supply that has just jumped, the thresholds those of the mean.
        let mean = self.supply.unwrap_or(self.newest_supply);
        if is_adc1 || !is_beyond(self.newest_supply, mean, NETWORK_SUPPLY_DOUBT) {
            self.open_sensor.on_network(
                &configuration.open_sensor,
                &self.prepared.open_sensor,
                network,
                now,
            );
        }
        if is_adc1 {
            let sample = Adc1Sample {
                started: now,
                finished: now,
                volts: network,
            };
            let context = self.context(configuration, history, now);
            if let Some(reading) = self.converter.on_adc1_sample(
                &configuration.converter,
                &self.prepared.converter,
                &sample,
                &context,
            ) {
                self.on_reading(configuration, reading, now, history);
            }
        }
    }

    /// What the meter has counted, and the causes against it that its owner knows (chip fault, self-test).
    pub fn on_meter(
        &mut self,
        configuration: &Configuration,
        report: &MeterReport,
        causes: Validity,
    ) {
        let mut report = *report;
        if report.at.is_none() {
            // Nothing was read since the start, and perhaps the counter not even handed over: what is known stands.
            report.charge_total = self.meter.charge_total;
        }
        if report.damaged != self.meter.damaged {
            // Its charge was taken back: no current has flowed, and what an end of the battery's range has cut off is not had
            // back.
            let taken_back = report.charge_total.saturating_sub(self.meter.charge_total);
            self.soc.declare_loss(&self.prepared.soc, taken_back);
            self.compare.restart_at(self.now);
        }
        self.meter = report;
        self.gap.begin_at(report.at.unwrap_or(self.started));
        self.meter_causes = causes
            .and_if(report.at.is_none(), Validity::STALE)
            .and_if(report.lost, Validity::CHIP_FAULT);
        let was_frozen = self.compare.report().frozen;
        let compared = self.compare.on_meter(&configuration.compare, &report);
        if was_frozen {
            // Its mean falls and rises again, whatever flows: nothing to hold against the converter.
            self.converter
                .forget_meter_until(report.at.unwrap_or(self.now));
        }
        let by_sensor = self.flag.miscounted.saturating_add(self.unseen.charge);
        self.miscounted = compared.miscounted.saturating_add(by_sensor);
        let declared = report.uncertainty.saturating_add(self.miscounted);
        let doubt = declared.saturating_sub(self.doubted);
        if doubt > Nanocoulombs::ZERO {
            self.doubted = declared;
            self.soc.declare_loss(&self.prepared.soc, doubt);
        }
        let now = report.at.unwrap_or(self.now);
        // No rest by a current that is doubted, nor against the other channel. (A calibration doubts none at rest.) For a while the
        // meter alone will do: a conversion is lost now and then.
        let mean = self.meter_mean();
        let current = if self.reading.validity.and(self.effects.current).is_valid() {
            self.current_known_at = now;
            // A single reading of ADC1 (D3) is too noisy for it.
            Some(self.averaged(configuration).0)
        } else {
            mean.filter(|_| elapsed(self.current_known_at, now) <= LONGEST_UNSEEN_REST)
        };
        let rest_current = configuration.soc.rest_current;
        let is_against = mean.is_some_and(|mean| mean.saturating_abs() > rest_current);
        self.soc.update(
            &self.prepared.soc,
            &configuration.ocv,
            &SocInput {
                now,
                charge_total: report.charge_total,
                current: current.filter(|_| !is_against),
                cell_voltage: self.cell_voltage,
            },
        );
        self.soc_reading = self.soc.reading(&self.prepared.soc);
    }

    /// A battery voltage received over CAN.
    pub fn on_battery_voltage(&mut self, voltage: &can::BatteryVoltage, at: Instant) {
        self.cell_voltage = voltage.cell.map(|voltage| CellVoltage { voltage, at });
        self.pack_voltage = voltage.pack;
    }

    /// Sets the state of charge by order of a host.
    pub fn set_state_of_charge(&mut self, soc: Ppm, uncertainty: Ppm) {
        self.soc.set(&self.prepared.soc, soc, uncertainty);
        self.soc_reading = self.soc.reading(&self.prepared.soc);
    }

    /// The part that runs by the clock, every 10 ms: key state and permit, calibrations, time-outs, diagnosis.
    /// `external` are the conditions that only the owners of the hardware know.
    pub fn tick(
        &mut self,
        configuration: &Configuration,
        now: Instant,
        vehicle: &Vehicle,
        history: &RangeHistory,
        external: CodeSet,
    ) -> Tick {
        self.now = now;
        self.vehicle = *vehicle;
        self.history = *history;
        self.reading = self.converter.reading(&self.prepared.converter, now);
        self.chatter = self.chatter_detector.step(&configuration.chatter, history);
        let measured = self
            .reading
            .validity
            .without(Validity::SATURATED)
            .is_valid();
        // The key factors are taken of what the zero drift in force leaves, or the two would correct the same zero twice.
        let output = |current: Microamps| {
            configuration.front_end.voltage(
                current,
                KeyCalibration::RANGE,
                self.prepared.converter.supply(),
            )
        };
        let zero = output(Microamps::ZERO);
        let drift =
            output(configuration.zero_drift.value.get(KeyCalibration::RANGE)).saturating_sub(zero);
        self.key_outputs = self.key.step(
            &configuration.key_calibration,
            &KeyInputs {
                now,
                acc_line: vehicle.acc_line,
                hv_feedback: vehicle.hv_feedback,
                can_key: vehicle.can_key,
                can_high_voltage: vehicle.can_high_voltage,
                meter_current: self.meter_mean(),
                meter_charge: self
                    .meter
                    .at
                    .filter(|_| self.meter_causes.is_valid())
                    .map(|at| (at, self.meter.charge_total)),
                sample: (self.conversions > 0).then_some(KeySample {
                    voltage: measured.then(|| self.reading.volts.saturating_sub(drift)),
                    zero,
                    range: self.reading.range,
                    at: self.reading.at,
                    noisy: self.readings_are_noisy(),
                }),
            },
        );
        if let Some(factors) = self.key_outputs.new_factors {
            self.prepare_again(configuration, factors, self.prepared.supply, true, now);
            self.factors_found = true;
        }
        if self.key_ordered {
            self.follow_key_order();
        }
        if let Some(refusal) = self.zero.tick(&configuration.zero_drift, now) {
            self.fail(refusal.into());
        }
        if !self.is_at_rest() {
            // A sweep that was begun and left would keep the current invalid for all of the drive.
            self.sweep = None;
        }
        let conditions = self.conditions(configuration).union(external);
        let changes = self.diagnosis.step(now, conditions);
        self.effects = self.diagnosis.effects();
        // A mean over longer than the diagnosis stands has readings of the fault in it: the average begins anew, the meter's is
        // waited for.
        let ended = changes.cleared;
        if !ended
            .intersection(CodeSet::AGAINST_SOUND_READINGS)
            .is_empty()
        {
            self.average.clear();
        }
        let faults = self.diagnosis.active().intersection(conditions);
        if !faults.intersection(CodeSet::AGAINST_CHARGE).is_empty() {
            (self.mean_causes, self.faulty_until) = (self.effects.charge, now);
        }
        Tick {
            hv_permit: self.key_outputs.hv_permit,
            changes,
        }
    }

    fn context(
        &self,
        configuration: &Configuration,
        history: &RangeHistory,
        started: Instant,
    ) -> SampleContext {
        let two_ranges = configuration.front_end.has_two_ranges();
        SampleContext {
            range: if two_ranges {
                history.range
            } else {
                Range::Small
            },
            spoiled_by_edge: two_ranges
                && history.conversion_spoiled(started, configuration.converter.settling()),
            meter_mean: self.meter_mean(),
            meter_mean_begun: self.meter.mean_begun,
        }
    }

    fn on_reading(
        &mut self,
        configuration: &Configuration,
        reading: CurrentReading,
        started: Instant,
        history: &RangeHistory,
    ) {
        self.history = *history;
        self.reading = reading;
        self.conversions = self.conversions.wrapping_add(1);
        // Kept with the reading: it stands for several ticks.
        let refused = self.converter.counters().steps_refused;
        self.rate_refused = core::mem::replace(&mut self.refused_steps, refused) != refused;
        if !reading.validity.is_valid() {
            self.invalid_conversions = self.invalid_conversions.saturating_add(1);
        }
        self.open_sensor.on_converter(
            &configuration.open_sensor,
            &self.prepared.open_sensor,
            &reading,
        );
        self.average.push(&configuration.average, &reading);
        // At the sensor's end, at a rail or without a supply neither channel sees what flows: anything within full scale.
        let validity = self.current_validity(reading.validity);
        let full_scale = configuration.front_end.full_scale(Range::Large);
        let is_blind =
            validity.contains(Validity::SATURATED) || validity.contains(Validity::SUPPLY);
        let off = if is_blind {
            let shown = reading.current.saturating_abs();
            // What the meter can count, or the sensor show.
            let full_scale = configuration.meter.full_scale.large.max(full_scale);
            full_scale.saturating_add(shown)
        } else {
            Microamps::ZERO
        };
        self.unseen.note(reading.at, off);
        self.gap.on_conversion(
            &configuration.meter,
            &gap::Conversion {
                started,
                finished: reading.at,
                current: reading.current,
                range: reading.range,
                edges: history.edges,
                is_valid: validity.is_valid(),
            },
        );
        self.compare.on_conversion(
            &configuration.compare,
            &Conversion {
                started,
                finished: reading.at,
                current: reading.current,
                // One sensor alone is as coarse as the large one of two: the tolerance is that of its range.
                range: if configuration.front_end.has_two_ranges() {
                    reading.range
                } else {
                    Range::Large
                },
                usable: reading.validity.is_valid(),
            },
            full_scale,
        );
        let conditions = self.zero_conditions();
        match self
            .zero
            .on_reading(&configuration.zero_drift, &reading, &conditions)
        {
            Some(Ok(result)) => {
                self.found = Some(Found::ZeroDrift(result.range, result.value));
                self.order_outcome = (CommandState::Done, 0);
            }
            Some(Err(refusal)) => {
                self.zero_beyond_limit = matches!(refusal, ZeroRefusal::BeyondLimit { .. });
                self.fail(refusal.into());
            }
            None => {}
        }
    }

    /// Flag against level, with the small sensor's own voltage beside it where the network taps it.
    fn judge_flag(&mut self, configuration: &Configuration, code: i32, history: &RangeHistory) {
        let unusable = Validity::RANGE_CHANGE
            .and(Validity::CHIP_FAULT)
            .and(Validity::STALE);
        if self.reading.validity.bits() & unusable.bits() != 0 {
            return;
        }
        // A flag without a meaning, or the large sensor in use whatever the current, and rightly so.
        if !configuration.front_end.has_two_ranges()
            || self.open_sensor.finding(Range::Small).is_fault()
        {
            self.flag = self.flag_plausibility.rest();
            return;
        }
        let own = self.environment.network.map(|volts| {
            let hall = hall_voltage(volts);
            let supply = self
                .prepared
                .supply
                .unwrap_or(design::SENSOR_NOMINAL_SUPPLY);
            let rated = mul_div(
                i64::from(hall.get()),
                i64::from(design::SENSOR_NOMINAL_SUPPLY.get()),
                i64::from(supply.get()),
            );
            configuration.front_end.current(
                Microvolts(clamp_i32(rated)),
                Range::Small,
                design::SENSOR_NOMINAL_SUPPLY,
            )
        });
        self.flag = self.flag_plausibility.step(
            &configuration.flag,
            &FlagObservation {
                at: self.reading.at,
                flag: history.range,
                passed_as_small: self.prepared.converter.current(code, Range::Small),
                passed_as_large: self.prepared.converter.current(code, Range::Large),
                small_sensor: own,
                full_scale: configuration.front_end.full_scale(Range::Large),
            },
        );
    }

    /// A mean over some conversions of ADC1, which a jump beyond [`SUPPLY_JUMP`] begins anew.
    fn average_supply(
        &mut self,
        configuration: &Configuration,
        supply: Option<Microvolts>,
        now: Instant,
    ) {
        let mean = supply.map(|newest| self.supply_mean_with(newest));
        self.supply = mean;
        let used = self.prepared.supply;
        let anew = if let (Some(newest), Some(mean), Some(used)) = (supply, mean, used) {
            // The one divides volts by the supply, the other's relations have volts in them.
            let at_zero = configuration.converter.supply_mode == SupplyMode::Measured
                || matches!(configuration.front_end, FrontEnd::ClosedLoop(_));
            let off = newest.saturating_sub(used).saturating_abs();
            let off = if off < SUPPLY_DOUBT { 0 } else { off.get() };
            let share = Ppm(off / SUPPLY_PPM);
            let share_at_zero = if at_zero { share } else { Ppm::ZERO };
            let full_scale = &configuration.meter.full_scale;
            let off_at_zero = PerRange {
                small: share_of_zero_output(full_scale.small, share_at_zero),
                large: share_of_zero_output(full_scale.large, share_at_zero),
            };
            self.compare.on_supply(share, off_at_zero);
            if !is_beyond(mean, used, SUPPLY_STEP) {
                return;
            }
            if is_beyond(mean, used, SUPPLY_JUMP) {
                self.converter.forget_meter_until(meter_follows(now));
            }
            false
        } else {
            if mean == used {
                return;
            }
            true
        };
        let factors = self.key.factors();
        self.prepare_again(configuration, factors, mean, anew, now);
    }

    fn supply_mean_with(&mut self, newest: Microvolts) -> Microvolts {
        let before = core::mem::replace(&mut self.newest_supply, newest);
        let Some(mean) = self.supply else {
            return newest;
        };
        if !is_beyond(newest, mean, SUPPLY_JUMP) {
            self.supply_jump = 0;
        } else if is_beyond(newest, before, SUPPLY_JUMP) {
            self.supply_jump = 1;
        } else {
            self.supply_jump = self.supply_jump.wrapping_add(1);
            if self.supply_jump == SUPPLY_CONFIRMATIONS {
                return newest;
            }
        }
        // Up to 31 µV beside what does not move.
        let off = newest.saturating_sub(mean).get() / SUPPLY_READINGS;
        mean.saturating_add(Microvolts(off))
    }

    /// The meter's mean current while nothing speaks against it.
    fn meter_mean(&self) -> Option<Microamps> {
        (self.meter_causes.is_valid() && !self.meter.mean_over.is_zero())
            .then_some(self.meter.mean_current)
    }

    fn high_voltage_is_off(&self) -> bool {
        !self.vehicle.hv_feedback && self.vehicle.can_high_voltage != Some(true)
    }

    /// High voltage is off and must not be switched on.
    #[inline(never)]
    fn is_at_rest(&self) -> bool {
        self.high_voltage_is_off() && !self.key_outputs.hv_permit
    }

    fn zero_conditions(&self) -> ZeroConditions {
        ZeroConditions {
            high_voltage_is_off: self.is_at_rest(),
            meter_mean: self.meter_mean(),
            noisy: self.readings_are_noisy(),
        }
    }

    /// Whether ADC1 converts the current (D3).
    fn readings_are_noisy(&self) -> bool {
        self.prepared.converter.channel() == Channel::Adc1
    }

    /// Not received in time, or received as not available.
    const fn cell_voltage_is_missing(&self) -> bool {
        !self.vehicle.voltage_fresh || self.cell_voltage.is_none()
    }

    fn environment_is_missing(&self) -> bool {
        self.environment_at
            .is_none_or(|at| elapsed(at, self.now) > ENVIRONMENT_TIMEOUT)
    }

    /// Before the first conversion, and no longer than it may take: nothing is there yet, and nothing has failed.
    fn is_starting(&self) -> bool {
        self.conversions == 0 && elapsed(self.started, self.now) < START_UP
    }

    fn conditions(&self, configuration: &Configuration) -> CodeSet {
        let two_ranges = configuration.front_end.has_two_ranges();
        let selected = if two_ranges {
            self.history.range
        } else {
            Range::Small
        };
        let finding = self.open_sensor.finding(selected);
        let small = self.open_sensor.finding(Range::Small);
        let supply_is_bad = self.environment_is_missing()
            || self.environment.supply.is_none_or(|supply| {
                !(design::SENSOR_SUPPLY_LOW..=design::SENSOR_SUPPLY_HIGH).contains(&supply)
            });
        let [lowest, highest] = configuration.temperature_limits;
        let too_hot_or_cold = |temperature: Option<MilliCelsius>| {
            temperature.is_some_and(|temperature| !(lowest..=highest).contains(&temperature))
        };
        let implausible = self.reading.validity.contains(Validity::IMPLAUSIBLE);
        let by_rate = implausible && self.rate_refused;
        let has_no_relations = matches!(
            configuration.front_end,
            FrontEnd::ClosedLoop(sensor) if sensor.relations == SupplyRelations::default()
        );
        let compared = self.compare.report();
        let disagree = |outcome| matches!(outcome, Outcome::Disagree { .. });
        let rows = [
            (Code::OpenSensor, finding == Finding::Open),
            (
                Code::SensorRail,
                finding.is_fault() && finding != Finding::Open,
            ),
            (
                Code::SmallSensorOpen,
                two_ranges && selected == Range::Large && small.is_fault(),
            ),
            (
                Code::SensorSaturated,
                self.reading.validity.contains(Validity::SATURATED),
            ),
            (
                Code::ConverterNoAnswer,
                self.converter_fault == Some(ConverterFault::NoAnswer),
            ),
            (
                Code::ConverterConfigurationLost,
                self.converter_fault == Some(ConverterFault::ConfigurationLost),
            ),
            (
                Code::ConverterStale,
                self.reading.validity.contains(Validity::STALE) && !self.is_starting(),
            ),
            (Code::RateImplausible, by_rate),
            (Code::ConverterStuck, implausible && !by_rate),
            (Code::MeterFrozen, compared.frozen),
            (
                Code::ChannelsDisagree,
                disagree(compared.fast) || disagree(compared.slow),
            ),
            (Code::FlagImplausible, self.flag.implausible),
            (Code::RangeChatter, self.chatter.active),
            (Code::SupplyOutOfRange, supply_is_bad),
            (
                Code::TemperatureOutOfRange,
                too_hot_or_cold(self.environment.sensor_temperature)
                    || too_hot_or_cold(self.environment.board_temperature),
            ),
            (
                Code::KeyCalibrationFailed,
                matches!(self.key_outputs.phase, KeyPhase::Failed(_)),
            ),
            (Code::HvWithoutPermit, self.key_outputs.hv_without_permit),
            (Code::KeyContradiction, self.key_outputs.key_contradiction),
            (Code::SupplyCalibrationInvalid, has_no_relations),
            (Code::ZeroDriftBeyondLimit, self.zero_beyond_limit),
            (
                Code::SocUncertain,
                self.soc_reading.presented_uncertainty() > SOC_UNCERTAINTY_LIMIT,
            ),
            (Code::CellVoltageMissing, self.cell_voltage_is_missing()),
            (Code::VehicleStateMissing, !self.vehicle.state_fresh),
            (
                Code::ChargeRestoredWithLoss,
                self.loss != Nanocoulombs::ZERO,
            ),
        ];
        let mut set = CodeSet::EMPTY;
        for (code, present) in rows {
            set.set(code, present);
        }
        set
    }

    /// Causes against the current that the reading itself does not carry.
    fn current_validity(&self, own: Validity) -> Validity {
        own.and(self.effects.current).and_if(
            self.zero.is_running()
                || self.sweep.is_some()
                || self.key_outputs.phase == KeyPhase::Taking,
            Validity::CALIBRATING,
        )
    }

    /// The meter's own, what faults have miscounted, and what the reset may have cost.
    const fn charge_uncertainty(&self) -> Nanocoulombs {
        self.meter
            .uncertainty
            .saturating_add(self.miscounted)
            .saturating_add(self.loss)
    }

    fn charge_validity(&self) -> Validity {
        self.meter_causes.and(self.effects.charge)
    }

    /// Of the meter's mean: of its charge, and of what the mean's window still has of a fault.
    fn mean_validity(&self) -> Validity {
        self.charge_validity()
            .and_if(self.meter.mean_begun <= self.faulty_until, self.mean_causes)
    }

    /// It follows the meter: what is missing there is missing here. Before the meter's first reading what was restored
    /// stands.
    fn soc_validity(&self) -> Validity {
        let of_meter = match self.meter.at {
            Some(_) => self.meter_causes.without(Validity::CALIBRATING),
            None => Validity::VALID,
        };
        self.effects
            .soc
            .and(of_meter)
            .and_if(!self.soc_reading.known, Validity::STALE)
    }

    fn averaged(&self, configuration: &Configuration) -> (Microamps, Validity, Option<Average>) {
        match self.average.average(&configuration.average, self.now) {
            Some(average) => (
                average.current,
                // A single bad conversion does not enter the average and so does not spoil it; one that is missing does.
                self.current_validity(Validity::VALID.and_if(
                    self.reading.validity.contains(Validity::STALE),
                    Validity::STALE,
                )),
                Some(average),
            ),
            None => (
                self.reading.current,
                self.current_validity(self.reading.validity.and(Validity::STALE)),
                None,
            ),
        }
    }
}

/// The Hall output behind a network voltage: (V − 1.65 V) / 0.225.
fn hall_voltage(network: Microvolts) -> Microvolts {
    let (gain, per) = design::NETWORK_GAIN;
    let above = network.saturating_sub(crate::open_sensor::AT_GROUND);
    Microvolts(clamp_i32(mul_div(i64::from(above.get()), per, gain)))
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::cast_possible_truncation)]
mod tests;
