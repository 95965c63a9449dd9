//! D2: from a conversion to a current with its validity.
//!
//! ```text
//! code → volt (supply mode) → k·(V + a) (key state, D4) → ampere (front end) → gain → zero drift
//! ```
//!
//! Every step is a straight line, so [`ConverterCoefficients::prepare`] folds them, when the configuration, a
//! correction or the supply changes, into one multiplication and one addition per range. A sample then costs no
//! division, and its current is within 0.51 µA of the exact rational result of the chain, halves rounded upward.
//!
//! **Rate of change.** A reading is implausible when it differs from the last accepted one by more than the limit
//! times the time since then, plus two converter steps. A real step must not lock the channel out, so there are two
//! ways back: the reading after it is accepted when [`ConverterConfig::step_confirmations`] readings in succession
//! agree with one another (within the same limit), and the permitted distance grows with the time since the last
//! accepted reading, whatever comes between.
//!
//! **Stuck.** A run of identical codes is legal at rest. It is implausible when it is at least
//! [`ConverterConfig::stuck_count`] long and the energy meter's mean current has meanwhile moved by more than
//! [`ConverterConfig::stuck_movement`]. Without a meter nothing is said, nor by a mean that reaches back to another
//! supply or calibration: with these the meter's factors move, and a ratiometric sensor's codes rightly stay.

use serde::{Deserialize, Serialize};

use crate::design_parameters as design;
use crate::front_end::{Channel, FrontEnd, KeyFactors, PerRange};
use crate::range::Range;
use crate::units::{
    Duration, Instant, Microamps, Microvolts, Ppm, clamp_i32_inline, div_round, elapsed, mul_div,
    mul_i64,
};
use crate::validity::Validity;

/// Data rate of the ADS1100 (SBAS239, table 5). A faster rate has fewer bits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum DataRate {
    /// 128 samples a second, 12 bits.
    Sps128,
    /// 32 samples a second, 14 bits (D2).
    #[default]
    Sps32,
    /// 16 samples a second, 15 bits.
    Sps16,
    /// 8 samples a second, 16 bits.
    Sps8,
}

impl DataRate {
    /// Bits of the code, the sign included; the code is right-justified.
    #[must_use]
    pub const fn bits(self) -> u32 {
        match self {
            Self::Sps128 => 12,
            Self::Sps32 => 14,
            Self::Sps16 => 15,
            Self::Sps8 => 16,
        }
    }

    /// Conversions in a second, nominal: the chip's clock may be off by 20 % (*assumed*).
    #[must_use]
    pub const fn samples_per_second(self) -> u32 {
        match self {
            Self::Sps128 => 128,
            Self::Sps32 => 32,
            Self::Sps16 => 16,
            Self::Sps8 => 8,
        }
    }

    /// Nominal length of a conversion: 7.8125, 31.25, 62.5 or 125 ms, whole microseconds.
    #[must_use]
    pub const fn period(self) -> Duration {
        Duration::from_ticks(match self {
            Self::Sps128 => 7_813,
            Self::Sps32 => 31_250,
            Self::Sps16 => 62_500,
            Self::Sps8 => 125_000,
        })
    }

    const fn configuration_bits(self) -> u8 {
        match self {
            Self::Sps128 => 0b00,
            Self::Sps32 => 0b01,
            Self::Sps16 => 0b10,
            Self::Sps8 => 0b11,
        }
    }
}

/// Gain of the ADS1100's amplifier. Only [`Gain::X1`] takes the sensors' 0 … 5 V.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Gain {
    /// 1 (D2).
    #[default]
    X1,
    /// 2.
    X2,
    /// 4.
    X4,
    /// 8.
    X8,
}

impl Gain {
    /// The binary logarithm of the gain, which is also its code in the configuration byte.
    #[must_use]
    pub const fn log2(self) -> u8 {
        match self {
            Self::X1 => 0,
            Self::X2 => 1,
            Self::X4 => 2,
            Self::X8 => 3,
        }
    }
}

/// How the sensor's supply enters the result. For a front end on ADC1 (D3) it does not.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum SupplyMode {
    /// Sensor and converter share one supply, which is the converter's reference: a ratiometric sensor's code does
    /// not depend on it. D4's sensor, whose relations want volts and Vc, needs the supply measured.
    #[default]
    Ratiometric,
    /// The converter has its own reference ([`ConverterConfig::reference`]); the sensor's supply Vc is measured and a
    /// ratiometric signal is referred to the rated supply, V · 5 V / Vc.
    Measured,
    /// The converter has its own reference, and the sensor's output does not follow its supply, or the supply is held
    /// at 5 V by other means.
    Fixed,
}

/// Configuration of the converter's path.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ConverterConfig {
    /// Data rate of the ADS1100.
    pub data_rate: DataRate,
    /// Gain of the ADS1100.
    pub gain: Gain,
    /// How the supply enters.
    pub supply_mode: SupplyMode,
    /// The converter's supply, which is its reference, in [`SupplyMode::Measured`] and [`SupplyMode::Fixed`].
    pub reference: Microvolts,
    /// Time that the low-pass before the converter needs after a range edge.
    pub settling_us: u32,
    /// Period at which the firmware samples ADC1 for a front end there.
    pub adc1_period_us: u32,
    /// Periods without a new sample after which the current is stale.
    pub stale_after_periods: u8,
    /// Distance from the ends of the sensor's range at which its signal counts as saturated.
    pub saturation_margin: Microvolts,
    /// Fastest change of the current that is believed, in A/s; 0 switches the check off.
    pub max_amps_per_second: u32,
    /// Readings beyond the rate limit that must be followed by one that agrees with them before the step is believed.
    pub step_confirmations: u8,
    /// Identical codes in succession before they can count as stuck.
    pub stuck_count: u16,
    /// Movement of the meter's mean current during the run that makes it stuck. Above the meter's own step: one count
    /// in 20 ms is 0.34 A of the small range and 3.4 A of the large one.
    pub stuck_movement: PerRange<Microamps>,
}

impl Default for ConverterConfig {
    fn default() -> Self {
        Self {
            data_rate: DataRate::default(),
            gain: Gain::default(),
            supply_mode: SupplyMode::default(),
            reference: design::CONVERTER_NOMINAL_SUPPLY,
            settling_us: design::CONVERTER_SETTLING_US,
            adc1_period_us: design::ADC1_PERIOD_US,
            stale_after_periods: design::STALE_AFTER_PERIODS,
            saturation_margin: design::SATURATION_MARGIN,
            max_amps_per_second: design::MAX_AMPS_PER_SECOND,
            step_confirmations: 1,
            stuck_count: design::STUCK_COUNT,
            stuck_movement: PerRange {
                small: design::STUCK_MOVEMENT_SMALL,
                large: design::STUCK_MOVEMENT_LARGE,
            },
        }
    }
}

/// Why [`ConverterConfig::validate`] refuses a configuration.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ConverterConfigError {
    /// The gain cuts off the sensors' 0 … 5 V.
    Gain,
    /// The reference is outside the ADS1100's supply, 2.7 … 5.5 V.
    Reference,
    /// Settling above one second.
    Settling,
    /// The period of ADC1 is not within 0.1 ms … 1 s.
    Adc1Period,
    /// Stale after fewer than 2 or more than 50 periods.
    StaleAfter,
    /// The saturation margin is not within 0 … 100 mV.
    SaturationMargin,
    /// More than 10 confirmations of a step.
    StepConfirmations,
    /// Stuck after fewer than 8 identical codes.
    StuckCount,
    /// A movement that is not positive.
    StuckMovement,
}

impl ConverterConfig {
    /// Refuses what cannot work.
    ///
    /// # Errors
    /// The first of the reasons in [`ConverterConfigError`].
    pub fn validate(&self) -> Result<(), ConverterConfigError> {
        use ConverterConfigError as Error;
        let checks = [
            (self.gain == Gain::X1, Error::Gain),
            (
                (2_700_000..=5_500_000).contains(&self.reference.get()),
                Error::Reference,
            ),
            (self.settling_us <= 1_000_000, Error::Settling),
            (
                (100..=1_000_000).contains(&self.adc1_period_us),
                Error::Adc1Period,
            ),
            (
                (2..=50).contains(&self.stale_after_periods),
                Error::StaleAfter,
            ),
            (
                (0..=100_000).contains(&self.saturation_margin.get()),
                Error::SaturationMargin,
            ),
            (self.step_confirmations <= 10, Error::StepConfirmations),
            (self.stuck_count >= 8, Error::StuckCount),
            (
                self.stuck_movement.small.get() > 0 && self.stuck_movement.large.get() > 0,
                Error::StuckMovement,
            ),
        ];
        checks
            .into_iter()
            .find(|(holds, _)| !holds)
            .map_or(Ok(()), |(_, error)| Err(error))
    }

    /// The configuration byte that a finished single conversion returns: not busy, single mode, rate and gain
    /// (SBAS239, configuration register). 0x8C in its place is a chip that has lost its supply meanwhile.
    #[must_use]
    pub const fn expected_configuration(&self) -> u8 {
        0x10 + (self.data_rate.configuration_bits() << 2) + self.gain.log2()
    }

    /// Time that the low-pass before the converter needs after a range edge.
    #[must_use]
    pub const fn settling(&self) -> Duration {
        Duration::from_ticks(self.settling_us as u64)
    }

    /// Nominal period of the samples of `channel`.
    #[must_use]
    pub const fn period(&self, channel: Channel) -> Duration {
        match channel {
            Channel::Ads1100 => self.data_rate.period(),
            Channel::Adc1 => Duration::from_ticks(self.adc1_period_us as u64),
        }
    }
}

/// What is corrected in the signal and in the current, per sensor.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Corrections {
    /// D4's key-state factors, in the volt domain.
    pub key_factors: PerRange<KeyFactors>,
    /// The current is multiplied by one plus this.
    pub gain: PerRange<Ppm>,
    /// D2's zero drift, subtracted from the current last.
    pub zero_drift: PerRange<Microamps>,
}

/// Bits behind the binary point of the folded coefficients: the slope's rounding costs 6·10⁻⁵ µA over all codes of
/// the ADS1100 and 0.01 µA over ADC1's 4.2 V, and ±8,589 A still fit.
pub const FRACTION_BITS: u32 = 28;
/// Bits behind the binary point while folding: 5 V in nV then fit 63 bits, so that no division needs 128.
const FOLDING_BITS: u32 = 30;
/// Largest |slope · input| and |offset|, so that their sum cannot overflow: 2^(61 − 28) µA.
const TERM_LIMIT: i64 = 1 << 61;
/// Inputs from ADC1 are clamped to ±2²² µV, that is 4.19 V, beyond its clamp.
const ADC1_INPUT_BITS: u32 = 22;

/// The folded chain for one range.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct RangeCoefficients {
    /// µV per unit of input.
    volts_slope: i64,
    /// µA per unit of input.
    slope: i64,
    /// µA at input 0.
    offset: i64,
    /// The signal is saturated at or below this …
    saturated_low: Microvolts,
    /// … and at or above this.
    saturated_high: Microvolts,
    /// Two steps of the input, which no rate limit forbids.
    two_steps: Microamps,
}

/// The configuration worked into factors; to be renewed when anything that went into it changes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ConverterCoefficients {
    ranges: PerRange<RangeCoefficients>,
    channel: Channel,
    supply: Microvolts,
    supply_fault: bool,
    stale_after: Duration,
    code_limit: i32,
    configuration: u8,
}

impl ConverterCoefficients {
    /// Works out the factors. `supply` is the sensor's supply as measured, `None` when it is not known (any more).
    ///
    /// A supply that is needed but unknown or outside 4.5 … 5.5 V makes every reading invalid
    /// ([`Validity::SUPPLY`]); the current is then worked out with 5 V, or with the nearer limit.
    /// Some thirty 64-bit divisions: call it on a change, not per sample.
    #[must_use]
    pub fn prepare(
        config: &ConverterConfig,
        front_end: &FrontEnd,
        corrections: &Corrections,
        supply: Option<Microvolts>,
    ) -> Self {
        let channel = front_end.channel();
        let needs_supply = match (front_end, config.supply_mode) {
            (FrontEnd::Network(_), _) | (_, SupplyMode::Fixed) => false,
            (FrontEnd::ClosedLoop(_), _) | (_, SupplyMode::Measured) => true,
            (_, SupplyMode::Ratiometric) => false,
        };
        let limits = design::SENSOR_SUPPLY_LOW..=design::SENSOR_SUPPLY_HIGH;
        let supply_fault = match supply {
            // D3's sensor runs from ±15 V, not from this supply.
            Some(supply) => channel == Channel::Ads1100 && !limits.contains(&supply),
            None => needs_supply,
        };
        let supply = match supply {
            Some(supply) if needs_supply => supply.clamp(*limits.start(), *limits.end()),
            _ => design::SENSOR_NOMINAL_SUPPLY,
        };
        let fold = |range| fold(config, front_end, corrections, supply, range);
        Self {
            ranges: PerRange {
                small: fold(Range::Small),
                large: fold(Range::Large),
            },
            channel,
            supply,
            supply_fault,
            stale_after: Duration::from_ticks(
                config.period(channel).as_ticks() * u64::from(config.stale_after_periods),
            ),
            code_limit: 1 << (config.data_rate.bits() - 1),
            configuration: config.expected_configuration(),
        }
    }

    /// The current that one step of the input stands for: one code of the ADS1100, one microvolt of ADC1.
    /// 38, 76, 153, 610 mA per code at 8, 16, 32, 128 SPS for the HAH1BV.
    #[must_use]
    pub const fn step(&self, range: Range) -> Microamps {
        Microamps(evaluate(self.ranges.of(range).slope, 0, 1))
    }

    /// The converter whose samples these coefficients are for.
    #[must_use]
    pub const fn channel(&self) -> Channel {
        self.channel
    }

    /// The configuration byte that a sample has to come with.
    #[must_use]
    pub const fn configuration(&self) -> u8 {
        self.configuration
    }

    /// Whether a sample reads the same by `other`, but for the channel that it comes from.
    pub(crate) fn reads_like(&self, other: &Self) -> bool {
        self.ranges == other.ranges
    }

    /// The sensor's supply that the current is worked out with, [`FrontEnd::line`]'s.
    #[must_use]
    pub const fn supply(&self) -> Microvolts {
        self.supply
    }

    /// Whether the supply makes every reading invalid.
    #[must_use]
    pub const fn supply_fault(&self) -> bool {
        self.supply_fault
    }

    /// The current for a code (or, on ADC1, for microvolts), without any judgement of validity.
    #[must_use]
    pub fn current(&self, input: i32, range: Range) -> Microamps {
        let coefficients = self.ranges.of(range);
        let input = self.clamp_input(input);
        Microamps(evaluate(coefficients.slope, coefficients.offset, input))
    }

    /// The signal for a code (or, on ADC1, for microvolts): before the key-state factors, referred to the rated
    /// supply where the front end is ratiometric.
    #[must_use]
    pub fn volts(&self, input: i32, range: Range) -> Microvolts {
        let coefficients = self.ranges.of(range);
        Microvolts(evaluate(
            coefficients.volts_slope,
            0,
            self.clamp_input(input),
        ))
    }

    fn clamp_input(&self, input: i32) -> i32 {
        let limit = match self.channel {
            Channel::Ads1100 => self.code_limit,
            Channel::Adc1 => 1 << ADC1_INPUT_BITS,
        };
        input.min(limit).max(-limit)
    }
}

/// `slope · input + offset`, rounded to nearest with halves upward. No overflow by [`TERM_LIMIT`].
const fn evaluate(slope: i64, offset: i64, input: i32) -> i32 {
    clamp_i32_inline((slope * input as i64 + offset + (1 << (FRACTION_BITS - 1))) >> FRACTION_BITS)
}

#[inline(never)]
fn fold(
    config: &ConverterConfig,
    front_end: &FrontEnd,
    corrections: &Corrections,
    supply: Microvolts,
    range: Range,
) -> RangeCoefficients {
    let micro = |volts: Microvolts| i64::from(volts.get());
    // nV per unit of input, in 2^-FOLDING_BITS, and the number of bits of the input.
    let (step, input_bits) = match front_end.channel() {
        Channel::Adc1 => (1_000 << FOLDING_BITS, ADC1_INPUT_BITS),
        Channel::Ads1100 => {
            let is_closed_loop = matches!(front_end, FrontEnd::ClosedLoop(_));
            let reference = match config.supply_mode {
                SupplyMode::Ratiometric if is_closed_loop => supply,
                SupplyMode::Ratiometric => design::SENSOR_NOMINAL_SUPPLY,
                SupplyMode::Measured | SupplyMode::Fixed => config.reference,
            };
            let magnitude_bits = config.data_rate.bits() - 1;
            let shift = FOLDING_BITS - magnitude_bits - u32::from(config.gain.log2());
            let actual = (micro(reference) * 1_000) << shift;
            let referred = if config.supply_mode == SupplyMode::Measured && !is_closed_loop {
                mul_div(actual, micro(design::SENSOR_NOMINAL_SUPPLY), micro(supply))
            } else {
                actual
            };
            (referred, magnitude_bits)
        }
    };
    let line = front_end.line(range, supply);
    let key = corrections.key_factors.of(range);
    let with_k = |nanovolts| {
        mul_div(
            nanovolts,
            i64::from(key.k_ppb),
            i64::from(KeyFactors::K_ONE_PPB),
        )
    };
    let one = i64::from(Ppm::ONE.get());
    let gain = one + i64::from(corrections.gain.of(range).get());
    let to_microamps = |nanovolts| {
        mul_div(
            mul_div(nanovolts, line.numerator, line.denominator),
            gain,
            one,
        )
    };
    let folded = |value: i64, input_bits: u32| {
        let limit = TERM_LIMIT >> input_bits;
        div_round(value, 1 << (FOLDING_BITS - FRACTION_BITS))
            .min(limit)
            .max(-limit)
    };

    let unit = 1_i64 << FOLDING_BITS;
    let above_zero = with_k(mul_i64(micro(key.a) * 1_000, unit))
        .saturating_sub(mul_i64(line.zero_nanovolts, unit));
    let zero_drift = mul_i64(i64::from(corrections.zero_drift.of(range).get()), unit);
    let slope = folded(to_microamps(with_k(step)), input_bits);
    let limits = front_end.output_limits_at(range, supply);
    RangeCoefficients {
        volts_slope: folded(mul_div(step, 1, 1_000), input_bits),
        slope,
        offset: folded(to_microamps(above_zero).saturating_sub(zero_drift), 0),
        saturated_low: limits.low.saturating_add(config.saturation_margin),
        saturated_high: limits.high.saturating_sub(config.saturation_margin),
        two_steps: Microamps(evaluate(slope.saturating_abs(), 0, 2)),
    }
}

/// A finished conversion of the ADS1100.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ConverterSample {
    /// When the conversion was started.
    pub started: Instant,
    /// When its result was read.
    pub finished: Instant,
    /// Configuration byte that came with it.
    pub configuration: u8,
    /// The code, right-justified and sign-extended.
    pub code: i16,
}

/// When the end of a conversion is asked for. Its oscillator keeps its time but for drift, and a question takes 0.1 ms of the bus: so
/// first shortly before the time that the last one took. From part to part it is 104 … 184 of the nominal 128 SPS, and the other rates
/// alike (SBAS239, electrical characteristics; quoted from memory): no conversion ends before two thirds of its nominal time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PollPace {
    /// Data rate and first question of the last conversion, and when it was found at its end, in ms.
    last: Option<(DataRate, u32, u32)>,
    asked: Option<(DataRate, u32)>,
}

impl PollPace {
    /// Milliseconds from the start of a conversion to the first question.
    pub fn first_ms(&mut self, rate: DataRate) -> u32 {
        let earliest = Self::period_ms(rate) * 2 / 3;
        let first = match self.last {
            // Found at the first question: it may have ended earlier.
            Some((of, first, end)) if of == rate && end <= first => (end - 1).max(earliest),
            Some((of, _, end)) if of == rate => end.max(earliest),
            _ => earliest,
        };
        self.asked = Some((rate, first));
        first
    }

    /// The last question: a conversion that has not ended by then never will.
    #[must_use]
    pub fn limit_ms(rate: DataRate) -> u32 {
        Self::period_ms(rate) * 3 / 2 + 2
    }

    /// It was found at its end so long after its start.
    pub fn ended(&mut self, at_ms: u32) {
        self.last = self.asked.map(|(rate, first)| (rate, first, at_ms));
    }

    /// It did not end, or nobody knows.
    pub fn unknown(&mut self) {
        self.last = None;
    }

    fn period_ms(rate: DataRate) -> u32 {
        u32::try_from(rate.period().as_millis()).unwrap_or(125)
    }
}

/// A finished conversion of ADC1, for a front end there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Adc1Sample {
    /// When the conversion was started.
    pub started: Instant,
    /// When it was finished.
    pub finished: Instant,
    /// The voltage at the pin.
    pub volts: Microvolts,
}

/// What was going on around a sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct SampleContext {
    /// The sensor that was selected. [`Range::Small`] for a front end with one sensor.
    pub range: Range,
    /// Whether a range edge, or the settling after one ([`ConverterConfig::settling`]), fell into the conversion.
    pub spoiled_by_edge: bool,
    /// The energy meter's latest mean current, when it has one.
    pub meter_mean: Option<Microamps>,
    /// When the time began over which that is the mean.
    pub meter_mean_begun: Instant,
}

impl Default for SampleContext {
    /// The small sensor, no edge, no meter.
    fn default() -> Self {
        Self {
            range: Range::Small,
            spoiled_by_edge: false,
            meter_mean: None,
            meter_mean_begun: Instant::from_ticks(0),
        }
    }
}

/// A current with its validity.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct CurrentReading {
    /// The current. When it is not valid: what the sample says all the same, or the last computed value when the
    /// sample says nothing (chip fault, no data). Never 0 A in place of a failed measurement.
    pub current: Microamps,
    /// The causes that stand against it.
    pub validity: Validity,
    /// The sensor that it was measured with.
    pub range: Range,
    /// When the conversion was finished; when the fault was seen, for a reading without a conversion.
    pub at: Instant,
    /// The signal behind it: before the key-state factors, referred to the rated supply for a ratiometric sensor.
    pub volts: Microvolts,
}

/// Counts of what the converter's path refused, saturating.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ConverterCounters {
    /// Samples that were evaluated.
    pub samples: u32,
    /// Samples that were not newer than the last one, and were dropped.
    pub duplicates: u32,
    /// Samples with another configuration byte, or a code outside the data rate's range, and bus errors.
    pub chip_faults: u32,
    /// Readings beyond the rate limit.
    pub steps_refused: u32,
}

/// A current at a time.
#[derive(Clone, Copy, Debug)]
struct Level {
    current: Microamps,
    at: Instant,
}

/// A run of identical codes.
#[derive(Clone, Copy, Debug)]
struct Run {
    input: i32,
    range: Range,
    since: Instant,
    length: u16,
    meter: Option<(Microamps, Microamps)>,
}

/// State of the converter's path.
#[derive(Clone, Copy, Debug)]
pub struct Converter {
    last_started: Option<Instant>,
    last_measured: Option<Instant>,
    reading: CurrentReading,
    accepted: Option<Level>,
    refused: Option<(Level, u8)>,
    run: Option<Run>,
    /// After a change of the configuration: not stale before this.
    stale_from: Option<Instant>,
    counters: ConverterCounters,
}

impl Default for Converter {
    fn default() -> Self {
        Self::new()
    }
}

impl Converter {
    /// Nothing measured yet: stale.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            last_started: None,
            last_measured: None,
            reading: CurrentReading {
                current: Microamps::ZERO,
                validity: Validity::STALE,
                range: Range::Small,
                at: Instant::from_ticks(0),
                volts: Microvolts::ZERO,
            },
            accepted: None,
            refused: None,
            run: None,
            stale_from: None,
            counters: ConverterCounters {
                samples: 0,
                duplicates: 0,
                chip_faults: 0,
                steps_refused: 0,
            },
        }
    }

    /// Takes a conversion of the ADS1100. `None`, and no effect, when it is not newer than the last one (a duplicate)
    /// or the front end is on the other converter.
    pub fn on_sample(
        &mut self,
        config: &ConverterConfig,
        coefficients: &ConverterCoefficients,
        sample: &ConverterSample,
        context: &SampleContext,
    ) -> Option<CurrentReading> {
        if coefficients.channel != Channel::Ads1100 || !self.is_new(sample.started) {
            return None;
        }
        let code = i32::from(sample.code);
        let limit = coefficients.code_limit;
        if sample.configuration != coefficients.configuration || code < -limit || code >= limit {
            // The scale of this code is not known, so it says nothing about the current.
            return Some(self.on_fault(sample.finished));
        }
        let at_end = code == -limit || code == limit - 1;
        Some(self.evaluate(config, coefficients, code, at_end, sample.finished, context))
    }

    /// Takes a conversion of ADC1, as [`Converter::on_sample`]. A voltage at or beyond the pin's clamps is saturated.
    pub fn on_adc1_sample(
        &mut self,
        config: &ConverterConfig,
        coefficients: &ConverterCoefficients,
        sample: &Adc1Sample,
        context: &SampleContext,
    ) -> Option<CurrentReading> {
        if coefficients.channel != Channel::Adc1 || !self.is_new(sample.started) {
            return None;
        }
        let at_end = sample.volts <= Microvolts::ZERO || sample.volts >= design::NETWORK_CLAMP;
        Some(self.evaluate(
            config,
            coefficients,
            sample.volts.get(),
            at_end,
            sample.finished,
            context,
        ))
    }

    /// Another configuration of the chip from `at` on: a conversion that is under way is of the old one, and the first of
    /// the new one has its own time before the current is stale.
    pub fn reconfigured(
        &mut self,
        old: &ConverterCoefficients,
        new: &ConverterCoefficients,
        at: Instant,
    ) {
        if old.configuration != new.configuration {
            self.stale_from =
                at.checked_add_duration(old.stale_after.saturating_add(new.stale_after));
        }
    }

    /// Notes that the converter did not deliver (bus error, lost configuration): the last value stays, invalid, until
    /// the next good sample.
    pub fn on_fault(&mut self, at: Instant) -> CurrentReading {
        self.counters.chip_faults = self.counters.chip_faults.saturating_add(1);
        self.reading.validity =
            Validity::CHIP_FAULT.and_if(self.last_measured.is_none(), Validity::STALE);
        self.reading.at = at;
        self.reading
    }

    /// The latest reading as it stands at `now`: stale once [`ConverterConfig::stale_after_periods`] have passed since
    /// the last sample that could be evaluated.
    #[must_use]
    pub fn reading(&self, coefficients: &ConverterCoefficients, now: Instant) -> CurrentReading {
        let is_stale = self
            .last_measured
            .is_none_or(|at| elapsed(at, now) > coefficients.stale_after)
            && (self.last_measured.is_none() || self.stale_from.is_none_or(|from| now > from));
        let mut reading = self.reading;
        reading.validity = reading.validity.and_if(is_stale, Validity::STALE);
        reading
    }

    /// What was counted.
    #[must_use]
    pub const fn counters(&self) -> ConverterCounters {
        self.counters
    }

    fn is_new(&mut self, started: Instant) -> bool {
        let is_new = self.last_started.is_none_or(|last| started > last);
        if is_new {
            self.last_started = Some(started);
        } else {
            self.counters.duplicates = self.counters.duplicates.saturating_add(1);
        }
        is_new
    }

    fn evaluate(
        &mut self,
        config: &ConverterConfig,
        coefficients: &ConverterCoefficients,
        input: i32,
        at_end: bool,
        at: Instant,
        context: &SampleContext,
    ) -> CurrentReading {
        let range = context.range;
        let of_range = coefficients.ranges.of(range);
        let input = coefficients.clamp_input(input);
        let volts = Microvolts(evaluate(of_range.volts_slope, 0, input));
        let current = Microamps(evaluate(of_range.slope, of_range.offset, input));
        let is_saturated =
            at_end || volts <= of_range.saturated_low || volts >= of_range.saturated_high;
        let mut validity = Validity::VALID
            .and_if(is_saturated, Validity::SATURATED)
            .and_if(context.spoiled_by_edge, Validity::RANGE_CHANGE)
            .and_if(coefficients.supply_fault, Validity::SUPPLY);
        // A reading that is invalid for another cause is no witness for the rate of change.
        if validity.is_valid() {
            let level = Level { current, at };
            let follows = self.follows(config, of_range.two_steps, level);
            validity = validity.and_if(!follows, Validity::IMPLAUSIBLE);
        }
        let is_stuck = self.is_stuck(config, input, at, context);
        self.counters.samples = self.counters.samples.saturating_add(1);
        self.last_measured = Some(at);
        self.reading = CurrentReading {
            current,
            validity: validity.and_if(is_stuck, Validity::IMPLAUSIBLE),
            range,
            at,
            volts,
        };
        self.reading
    }

    /// The rate-of-change rule of the module's description.
    fn follows(&mut self, config: &ConverterConfig, allowance: Microamps, level: Level) -> bool {
        let within = |from: Level| {
            config.max_amps_per_second == 0
                || is_within_rate(config.max_amps_per_second, allowance, from, level)
        };
        if self.accepted.is_none_or(within) {
            self.accepted = Some(level);
            self.refused = None;
            return true;
        }
        let count = match self.refused {
            Some((from, count)) if within(from) => count.saturating_add(1),
            _ => 1,
        };
        if count > config.step_confirmations {
            self.accepted = Some(level);
            self.refused = None;
            return true;
        }
        self.refused = Some((level, count));
        self.counters.steps_refused = self.counters.steps_refused.saturating_add(1);
        false
    }

    /// The meter counts by other factors from about `at` on: how its mean moves until then says nothing of the current.
    #[inline(never)]
    pub fn forget_meter_until(&mut self, at: Instant) {
        if let Some(run) = &mut self.run {
            run.since = run.since.max(at);
            run.meter = None;
        }
    }

    /// The stuck rule of the module's description.
    fn is_stuck(
        &mut self,
        config: &ConverterConfig,
        input: i32,
        at: Instant,
        context: &SampleContext,
    ) -> bool {
        let run = match &mut self.run {
            Some(run) if run.input == input && run.range == context.range => {
                run.length = run.length.saturating_add(1);
                run
            }
            run => run.insert(Run {
                input,
                range: context.range,
                since: at,
                length: 1,
                meter: None,
            }),
        };
        // A mean that reaches back before the run holds the step that the run began with: no movement in it.
        let counts = context.meter_mean_begun >= run.since;
        if let (true, Some(mean)) = (counts, context.meter_mean) {
            let (low, high) = run.meter.unwrap_or((mean, mean));
            run.meter = Some((low.min(mean), high.max(mean)));
        }
        run.length >= config.stuck_count
            && run.meter.is_some_and(|(low, high)| {
                high.saturating_sub(low) > config.stuck_movement.get(context.range)
            })
    }
}

/// `|to − from| ≤ limit · time + allowance`; A/s · µs is µA.
fn is_within_rate(amps_per_second: u32, allowance: Microamps, from: Level, to: Level) -> bool {
    let time_us = u32::try_from(elapsed(from.at, to.at).as_ticks()).unwrap_or(u32::MAX);
    let permitted =
        u64::from(amps_per_second) * u64::from(time_us) + u64::from(allowance.get().unsigned_abs());
    u64::from(to.current.get().abs_diff(from.current.get())) <= permitted
}

#[cfg(test)]
#[allow(
    clippy::unwrap_used,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss
)]
pub(crate) mod tests;
