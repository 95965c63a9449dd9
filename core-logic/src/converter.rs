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
pub(crate) mod tests {
    use super::*;
    use crate::front_end::tests::{any_front_end, any_range, any_supply, any_valid};
    use crate::front_end::{ClosedLoop, Hah1bv, Network, SupplyRelations};
    use proptest::prelude::*;
    use std::vec::Vec;

    const CONFIG: ConverterConfig = ConverterConfig {
        data_rate: DataRate::Sps32,
        gain: Gain::X1,
        supply_mode: SupplyMode::Ratiometric,
        reference: design::CONVERTER_NOMINAL_SUPPLY,
        settling_us: 5_000,
        adc1_period_us: 10_000,
        stale_after_periods: 3,
        saturation_margin: Microvolts::from_millivolts(5),
        max_amps_per_second: 1_000,
        step_confirmations: 1,
        stuck_count: 8,
        stuck_movement: PerRange {
            small: Microamps::from_amps(1),
            large: Microamps::from_amps(10),
        },
    };
    const FIVE: Microvolts = Microvolts::from_millivolts(5_000);

    fn hah1bv() -> FrontEnd {
        FrontEnd::Hah1bv(Hah1bv::default())
    }

    fn prepare(config: &ConverterConfig, front_end: FrontEnd) -> ConverterCoefficients {
        ConverterCoefficients::prepare(config, &front_end, &Corrections::default(), None)
    }

    fn at(us: u64) -> Instant {
        Instant::from_ticks(us)
    }

    pub(crate) fn any_validity() -> impl Strategy<Value = Validity> {
        prop_oneof![
            3 => Just(Validity::VALID),
            1 => any::<u8>().prop_map(Validity::from_bits)
        ]
    }

    /// A channel that is fed one sample per period.
    struct Bench {
        config: ConverterConfig,
        coefficients: ConverterCoefficients,
        converter: Converter,
        now: u64,
        context: SampleContext,
    }

    impl Bench {
        fn new(config: ConverterConfig, front_end: FrontEnd) -> Self {
            Self {
                config,
                coefficients: prepare(&config, front_end),
                converter: Converter::new(),
                now: 0,
                context: SampleContext::default(),
            }
        }

        fn sample(&mut self, configuration: u8, code: i16) -> CurrentReading {
            let period = self.config.data_rate.period().as_ticks();
            let started = self.now;
            self.now += period;
            let sample = ConverterSample {
                started: at(started),
                finished: at(self.now),
                configuration,
                code,
            };
            let context = SampleContext {
                meter_mean_begun: at(self.now - self.now.min(100_000)),
                ..self.context
            };
            self.converter
                .on_sample(&self.config, &self.coefficients, &sample, &context)
                .unwrap()
        }

        fn code(&mut self, code: i16) -> CurrentReading {
            self.sample(self.config.expected_configuration(), code)
        }

        /// The nearest code of the HAH1BV at 14 bits.
        fn amps(&mut self, amps: f64) -> CurrentReading {
            self.code(code_of(amps))
        }
    }

    fn code_of(amps: f64) -> i16 {
        ((2.5 + amps / 250.0) / 5.0 * 8_192.0).round() as i16
    }

    const RATES: [DataRate; 4] = [
        DataRate::Sps8,
        DataRate::Sps16,
        DataRate::Sps32,
        DataRate::Sps128,
    ];

    #[test]
    fn data_rate_is_resolution() {
        let config = |data_rate| ConverterConfig {
            data_rate,
            ..CONFIG
        };
        let steps = RATES.map(|rate| prepare(&config(rate), hah1bv()).step(Range::Small).get());
        assert_eq!(steps, [38_147, 76_294, 152_588, 610_352]);
        assert_eq!(RATES.map(DataRate::bits), [16, 15, 14, 12]);
        assert_eq!(RATES.map(DataRate::samples_per_second), [8, 16, 32, 128]);
        for rate in RATES {
            let exact = 1_000_000.0 / f64::from(rate.samples_per_second());
            assert!((rate.period().as_ticks() as f64 - exact).abs() <= 0.5);
        }
        assert_eq!(
            RATES.map(|rate| config(rate).expected_configuration()),
            [0x1C, 0x18, 0x14, 0x10]
        );
        let gains = [Gain::X1, Gain::X2, Gain::X4, Gain::X8];
        assert_eq!(
            gains.map(|gain| ConverterConfig { gain, ..CONFIG }.expected_configuration()),
            [0x14, 0x15, 0x16, 0x17]
        );
    }

    #[test]
    fn codes_of_the_documents() {
        // Code 16384 of 16 bits is 2.5 V.
        let config = ConverterConfig {
            data_rate: DataRate::Sps8,
            ..CONFIG
        };
        let d2 = prepare(&config, hah1bv());
        assert_eq!(d2.current(16_384, Range::Small), Microamps::ZERO);
        assert_eq!(d2.volts(16_384, Range::Small), Microvolts(2_500_000));
        // A reset chip's 0 would read −625 A: the reason for looking at the configuration byte.
        assert_eq!(d2.current(0, Range::Small), Microamps::from_amps(-625));
        let d0 = prepare(&config, FrontEnd::default());
        // 4.5625 V is code 29900.8; 4.5 V is 29491.2.
        assert_eq!(d0.current(29_901, Range::Small), Microamps(55_000_814));
        assert_eq!(d0.current(29_901, Range::Large), Microamps(550_008_138));
        assert_eq!(d0.step(Range::Small), Microamps(4_069));
        assert_eq!(d0.step(Range::Large), Microamps(40_690));
        assert_eq!(d0.channel(), Channel::Ads1100);
        assert!(!d0.supply_fault());
        // Codes beyond the data rate's are held at its end.
        assert_eq!(
            prepare(&CONFIG, hah1bv()).current(20_000, Range::Small),
            Microamps::from_amps(625)
        );
        assert_eq!(
            prepare(&CONFIG, hah1bv()).volts(-20_000, Range::Small),
            Microvolts(-5_000_000)
        );
        let x4 = ConverterConfig {
            gain: Gain::X4,
            ..CONFIG
        };
        assert_eq!(
            prepare(&x4, hah1bv()).volts(4_096, Range::Small),
            Microvolts(625_000)
        );
    }

    #[test]
    fn network_on_adc1_counts_microvolts() {
        let d3 = prepare(&CONFIG, FrontEnd::Network(Network::default()));
        assert_eq!(d3.channel(), Channel::Adc1);
        assert_eq!(
            d3.current(2_550_000, Range::Small),
            Microamps::from_amps(500)
        );
        assert_eq!(d3.current(1_650_000, Range::Small), Microamps::ZERO);
        assert_eq!(d3.volts(1_650_001, Range::Small), Microvolts(1_650_001));
        assert_eq!(d3.step(Range::Large), Microamps(556));
        assert_eq!(d3.volts(i32::MAX, Range::Small), Microvolts(1 << 22));
        assert_eq!(d3.volts(i32::MIN, Range::Small), Microvolts(-(1 << 22)));
    }

    #[test]
    fn corrections_are_applied_in_their_order() {
        let corrections = Corrections {
            key_factors: PerRange {
                small: KeyFactors {
                    k_ppb: 1_010_000_000,
                    a: Microvolts(10_000),
                },
                large: KeyFactors::NONE,
            },
            gain: PerRange {
                small: Ppm(20_000),
                large: Ppm(-1_000),
            },
            zero_drift: PerRange {
                small: Microamps(1_500_000),
                large: Microamps(-500_000),
            },
        };
        let d2 = ConverterCoefficients::prepare(&CONFIG, &hah1bv(), &corrections, None);
        // Code 4505 of 14 bits is 2.749_633_789 V.
        let volts = 5.0 * 4_505.0 / 8_192.0;
        let small = (1.01 * (volts + 0.01) - 2.5) * 250.0 * 1.02 - 1.5;
        let large = (volts - 2.5) * 250.0 * 0.999 + 0.5;
        let got = |range| f64::from(d2.current(4_505, range).get());
        assert!((got(Range::Small) - small * 1e6).abs() <= 0.51);
        assert!((got(Range::Large) - large * 1e6).abs() <= 0.51);
        // The reading's signal is the one before the factors.
        assert_eq!(d2.volts(4_505, Range::Small), Microvolts(2_749_634));
    }

    #[test]
    fn supply_is_asked_for_where_it_is_needed() {
        let d4 = FrontEnd::ClosedLoop(ClosedLoop::default());
        let d3 = FrontEnd::Network(Network::default());
        let fault = |front_end, supply_mode, supply| {
            let config = ConverterConfig {
                supply_mode,
                ..CONFIG
            };
            ConverterCoefficients::prepare(&config, &front_end, &Corrections::default(), supply)
                .supply_fault()
        };
        for mode in [
            SupplyMode::Ratiometric,
            SupplyMode::Measured,
            SupplyMode::Fixed,
        ] {
            let needed = mode == SupplyMode::Measured;
            assert_eq!(fault(hah1bv(), mode, None), needed);
            assert_eq!(fault(FrontEnd::default(), mode, None), needed);
            assert_eq!(fault(d4, mode, None), mode != SupplyMode::Fixed);
            assert!(!fault(d3, mode, None));
            for (volts, beyond) in [
                (4_499_999, true),
                (4_500_000, false),
                (5_500_000, false),
                (5_500_001, true),
            ] {
                assert_eq!(fault(hah1bv(), mode, Some(Microvolts(volts))), beyond);
                assert_eq!(fault(d4, mode, Some(Microvolts(volts))), beyond);
                assert!(!fault(d3, mode, Some(Microvolts(volts))));
            }
        }
    }

    #[test]
    fn supply_fault_marks_every_reading_and_keeps_the_current() {
        let config = ConverterConfig {
            supply_mode: SupplyMode::Measured,
            ..CONFIG
        };
        let mut bench = Bench::new(config, hah1bv());
        let reading = bench.amps(100.0);
        assert_eq!(reading.validity, Validity::SUPPLY);
        assert!((reading.current.get() - 100_000_000).abs() < 153_000);
        // Beyond the limits the nearer one is used.
        let prepare_at = |volts| {
            ConverterCoefficients::prepare(
                &config,
                &hah1bv(),
                &Corrections::default(),
                Some(Microvolts(volts)),
            )
        };
        assert_eq!(
            prepare_at(6_000_000).current(4_700, Range::Small),
            prepare_at(5_500_000).current(4_700, Range::Small)
        );
        assert_ne!(
            prepare_at(5_400_000).current(4_700, Range::Small),
            prepare_at(5_500_000).current(4_700, Range::Small)
        );
    }

    #[test]
    fn another_configuration_byte_is_a_chip_fault_and_not_a_current() {
        let mut bench = Bench::new(CONFIG, hah1bv());
        let good = bench.amps(50.0);
        assert!(good.validity.is_valid());
        assert_eq!(good.at, at(31_250));
        for configuration in [0x8C, 0x94, 0x15, 0x34] {
            let fault = bench.sample(configuration, 0);
            assert_eq!(fault.validity, Validity::CHIP_FAULT);
            assert_eq!(fault.current, good.current);
            assert_eq!(fault.volts, good.volts);
            assert_eq!(fault.at, at(bench.now));
        }
        assert_eq!(bench.sample(0x14, 8_192).validity, Validity::CHIP_FAULT);
        assert_eq!(bench.sample(0x14, -8_193).validity, Validity::CHIP_FAULT);
        assert_eq!(bench.converter.counters().chip_faults, 6);
        assert_eq!(bench.converter.counters().samples, 1);
        // Meanwhile the current has become old as well.
        let now = at(bench.now);
        let expected = Validity::CHIP_FAULT.and(Validity::STALE);
        assert_eq!(
            bench.converter.reading(&bench.coefficients, now).validity,
            expected
        );
        assert!(bench.amps(50.0).validity.is_valid());
    }

    #[test]
    fn a_fault_before_the_first_sample_is_stale_too() {
        let mut converter = Converter::default();
        let reading = converter.on_fault(at(7));
        assert_eq!(reading.validity, Validity::CHIP_FAULT.and(Validity::STALE));
        assert_eq!(reading.at, at(7));
        let mut bench = Bench::new(CONFIG, hah1bv());
        bench.amps(1.0);
        assert_eq!(
            bench.converter.on_fault(at(40_000)).validity,
            Validity::CHIP_FAULT
        );
        assert_eq!(bench.converter.counters().chip_faults, 1);
    }

    #[test]
    fn duplicates_are_dropped_and_counted() {
        let mut bench = Bench::new(CONFIG, hah1bv());
        bench.amps(10.0);
        bench.amps(20.0);
        let before = bench.converter.reading(&bench.coefficients, at(bench.now));
        for started in [31_250, 31_249, 0] {
            let sample = ConverterSample {
                started: at(started),
                finished: at(70_000),
                configuration: 0x14,
                code: 0,
            };
            let result =
                bench
                    .converter
                    .on_sample(&CONFIG, &bench.coefficients, &sample, &bench.context);
            assert_eq!(result, None);
        }
        assert_eq!(bench.converter.counters().duplicates, 3);
        assert_eq!(bench.converter.counters().samples, 2);
        assert_eq!(
            bench.converter.reading(&bench.coefficients, at(bench.now)),
            before
        );
    }

    #[test]
    fn each_front_end_listens_to_its_own_converter() {
        let sample = ConverterSample {
            started: at(1),
            finished: at(2),
            configuration: 0x14,
            code: 4_096,
        };
        let adc1 = Adc1Sample {
            started: at(1),
            finished: at(2),
            volts: Microvolts(1_650_000),
        };
        let context = SampleContext::default();
        let (d2, d3) = (
            prepare(&CONFIG, hah1bv()),
            prepare(&CONFIG, FrontEnd::Network(Network::default())),
        );
        let mut converter = Converter::new();
        assert_eq!(converter.on_sample(&CONFIG, &d3, &sample, &context), None);
        assert_eq!(
            converter.on_adc1_sample(&CONFIG, &d2, &adc1, &context),
            None
        );
        assert_eq!(converter.counters().duplicates, 0);
        let reading = converter
            .on_adc1_sample(&CONFIG, &d3, &adc1, &context)
            .unwrap();
        assert_eq!(
            (reading.current, reading.validity),
            (Microamps::ZERO, Validity::VALID)
        );
        assert_eq!(reading.volts, Microvolts(1_650_000));
        assert_eq!(
            converter.on_adc1_sample(&CONFIG, &d3, &adc1, &context),
            None
        );
        assert_eq!(converter.counters().duplicates, 1);
    }

    #[test]
    fn adc1_is_saturated_at_its_clamps_and_at_the_ends_of_the_range() {
        let d3 = prepare(&CONFIG, FrontEnd::Network(Network::default()));
        let saturated = |volts| {
            let sample = Adc1Sample {
                started: at(1),
                finished: at(2),
                volts: Microvolts(volts),
            };
            Converter::new()
                .on_adc1_sample(&CONFIG, &d3, &sample, &SampleContext::default())
                .unwrap()
                .validity
                .contains(Validity::SATURATED)
        };
        assert!(!saturated(755_001) && saturated(755_000));
        assert!(!saturated(2_544_999) && saturated(2_545_000));
        // The clamps alone, for a range that reaches beyond them.
        let wide = FrontEnd::Network(Network {
            full_scale: Microamps::from_amps(2_000),
            ..Network::default()
        });
        let wide = prepare(&CONFIG, wide);
        for (volts, expected) in [(0, true), (1, false), (3_299_999, false), (3_300_000, true)] {
            let sample = Adc1Sample {
                started: at(1),
                finished: at(2),
                volts: Microvolts(volts),
            };
            let reading =
                Converter::new().on_adc1_sample(&CONFIG, &wide, &sample, &SampleContext::default());
            assert_eq!(
                reading.unwrap().validity.contains(Validity::SATURATED),
                expected,
                "{volts}"
            );
        }
    }

    #[test]
    fn the_end_of_the_range_is_saturated() {
        // 16 bits, so that a code is 152.6 µV.
        let config = ConverterConfig {
            data_rate: DataRate::Sps8,
            ..CONFIG
        };
        let code = |volts: f64| (volts / 5.0 * 32_768.0).floor() as i16;
        let saturated = |front_end, code| {
            Bench::new(config, front_end)
                .code(code)
                .validity
                .contains(Validity::SATURATED)
        };
        // 4.745 V and 0.255 V with the margin of 5 mV.
        let d0 = FrontEnd::default();
        assert!(saturated(d0, code(4.745) + 1) && !saturated(d0, code(4.745)));
        assert!(saturated(d0, code(0.255)) && !saturated(d0, code(0.255) + 1));
        assert!(saturated(hah1bv(), code(4.495) + 1) && !saturated(hah1bv(), code(4.495)));
        // The current is still told.
        let reading = Bench::new(config, d0).code(code(4.9));
        assert_eq!(reading.validity, Validity::SATURATED);
        assert!(reading.current > Microamps::from_amps(63));
        // The converter's own ends, for a sensor whose range reaches beyond them.
        let wide = FrontEnd::Hah1bv(Hah1bv {
            full_scale: Microamps::from_amps(2_000),
            ..Hah1bv::default()
        });
        assert!(saturated(wide, i16::MAX) && !saturated(wide, i16::MAX - 1));
        assert!(saturated(wide, i16::MIN) && !saturated(wide, i16::MIN + 1));
    }

    #[test]
    fn stale_after_three_periods() {
        let mut bench = Bench::new(CONFIG, hah1bv());
        let stale = |bench: &Bench, now| {
            bench
                .converter
                .reading(&bench.coefficients, at(now))
                .validity
                .contains(Validity::STALE)
        };
        assert!(stale(&bench, 0));
        let reading = bench.amps(5.0);
        assert!(!stale(&bench, 31_250 + 93_750));
        assert!(stale(&bench, 31_250 + 93_751));
        let old = bench.converter.reading(&bench.coefficients, at(10_000_000));
        assert_eq!((old.current, old.at), (reading.current, reading.at));
        bench.amps(5.0);
        assert!(!stale(&bench, 62_500));
        let d3 = prepare(&CONFIG, FrontEnd::Network(Network::default()));
        assert_eq!(d3.stale_after.as_ticks(), 30_000);
        assert_eq!(CONFIG.settling().as_ticks(), 5_000);
    }

    #[test]
    fn a_conversion_over_an_edge_is_marked_and_is_no_witness() {
        let mut bench = Bench::new(CONFIG, hah1bv());
        bench.amps(0.0);
        bench.context.spoiled_by_edge = true;
        let spoiled = bench.amps(400.0);
        assert_eq!(spoiled.validity, Validity::RANGE_CHANGE);
        assert!((spoiled.current.get() - 400_000_000).abs() < 153_000);
        bench.context.spoiled_by_edge = false;
        assert!(bench.amps(0.0).validity.is_valid());
        assert_eq!(bench.converter.counters().steps_refused, 0);
    }

    #[test]
    fn range_of_the_sample_is_the_range_of_the_reading() {
        let mut bench = Bench::new(CONFIG, FrontEnd::default());
        assert_eq!(bench.code(4_200).range, Range::Small);
        bench.context.range = Range::Large;
        let large = bench.code(4_200);
        assert_eq!(large.range, Range::Large);
        assert_eq!(
            large.current,
            bench.coefficients.current(4_200, Range::Large)
        );
    }

    #[test]
    fn a_glitch_costs_one_sample_and_a_step_one_more() {
        // 1,000 A/s over 31.25 ms is 31.25 A.
        let mut bench = Bench::new(CONFIG, hah1bv());
        assert!(bench.amps(0.0).validity.is_valid());
        assert!(bench.amps(31.0).validity.is_valid());
        let glitch = bench.amps(-200.0);
        assert_eq!(glitch.validity, Validity::IMPLAUSIBLE);
        assert!((glitch.current.get() + 200_000_000).abs() < 153_000);
        assert!(bench.amps(31.0).validity.is_valid());
        assert_eq!(bench.amps(300.0).validity, Validity::IMPLAUSIBLE);
        assert!(bench.amps(300.0).validity.is_valid());
        assert!(bench.amps(290.0).validity.is_valid());
        assert_eq!(bench.converter.counters().steps_refused, 2);
    }

    #[test]
    fn a_step_is_confirmed_by_readings_that_agree() {
        let config = ConverterConfig {
            step_confirmations: 2,
            ..CONFIG
        };
        let mut bench = Bench::new(config, hah1bv());
        let valid: Vec<bool> = [0.0, 300.0, -300.0, 200.0, 210.0, 220.0, 225.0]
            .into_iter()
            .map(|amps| bench.amps(amps).validity.is_valid())
            .collect();
        // 5 periods after 0 A, 156 A are permitted: 200 A is not, until it is confirmed twice.
        assert_eq!(valid, [true, false, false, false, false, true, true]);
        // A refused reading is forgotten once another was accepted.
        assert!(!bench.amps(-200.0).validity.is_valid());
        assert!(bench.amps(225.0).validity.is_valid());
        assert!(!bench.amps(-200.0).validity.is_valid());
        let none = ConverterConfig {
            step_confirmations: 0,
            ..CONFIG
        };
        let mut bench = Bench::new(none, hah1bv());
        assert!(bench.amps(0.0).validity.is_valid() && bench.amps(400.0).validity.is_valid());
    }

    #[test]
    fn the_permitted_step_grows_with_time_and_can_be_switched_off() {
        let mut bench = Bench::new(CONFIG, hah1bv());
        bench.amps(0.0);
        bench.now += 9 * 31_250;
        // 312.5 A in ten periods, and two codes of 153 mA.
        assert!(bench.amps(312.0).validity.is_valid());
        let off = ConverterConfig {
            max_amps_per_second: 0,
            ..CONFIG
        };
        let mut bench = Bench::new(off, hah1bv());
        assert!(bench.amps(-490.0).validity.is_valid() && bench.amps(490.0).validity.is_valid());
    }

    #[test]
    fn the_rate_limit_is_exact() {
        let from = Level {
            current: Microamps(100),
            at: at(1_000),
        };
        let to = |current, us| Level {
            current: Microamps(current),
            at: at(us),
        };
        let within = |to| is_within_rate(1_000, Microamps(7), from, to);
        // 1,000 A/s · 5 µs = 5 mA = 5,000 µA.
        assert!(within(to(100 + 5_007, 1_005)) && !within(to(100 + 5_008, 1_005)));
        assert!(within(to(100 - 5_007, 1_005)) && !within(to(100 - 5_008, 1_005)));
        assert!(within(to(107, 0)) && !within(to(108, 0)));
        assert!(within(to(i32::MIN, u64::MAX)));
        // Two steps of the input are always within the limit.
        let slow = ConverterConfig {
            max_amps_per_second: 1,
            ..CONFIG
        };
        let mut bench = Bench::new(slow, hah1bv());
        bench.code(4_096);
        assert!(bench.code(4_098).validity.is_valid());
        assert!(!bench.code(4_101).validity.is_valid());
    }

    #[test]
    fn a_conversion_is_asked_for_three_times_at_most_once_its_time_is_known() {
        // 0.70 to 1.23 of the nominal time (184 and 104 of 128 SPS), drifting by 1 ms over 50 conversions.
        for (rate, nominal_ms) in [
            (DataRate::Sps32, 31.25),
            (DataRate::Sps128, 7.8125),
            (DataRate::Sps8, 125.0),
        ] {
            for share in [0.7, 0.9, 1.0, 1.1, 1.23] {
                let mut pace = PollPace::default();
                for turn in 0..50 {
                    let length = nominal_ms * share + f64::from(turn) / 50.0;
                    let first = pace.first_ms(rate);
                    let mut at = first;
                    while f64::from(at) < length {
                        at += 1;
                    }
                    assert!(at <= PollPace::limit_ms(rate), "{rate:?} {share}");
                    let questions = at - first + 1;
                    assert!(
                        turn == 0 || questions <= 3,
                        "{rate:?} {share} {turn}: {questions}"
                    );
                    // Never found later than a millisecond after its end, but where it ends before anybody would ask.
                    assert!(
                        f64::from(at) < length + 1.0 || turn == 0 || questions == 1,
                        "{rate:?} {share} {turn}: {at} {length}"
                    );
                    pace.ended(at);
                }
            }
        }
        let mut pace = PollPace::default();
        pace.first_ms(DataRate::Sps32);
        pace.ended(40);
        assert_eq!(pace.first_ms(DataRate::Sps32), 40);
        // Another rate, and a conversion that never ended, begin anew.
        assert_eq!(pace.first_ms(DataRate::Sps128), 4);
        pace.unknown();
        assert_eq!(pace.first_ms(DataRate::Sps32), 20);
    }

    #[test]
    fn no_conversion_of_the_chip_ends_before_it_is_asked_for() {
        for (rate, slowest_hz, fastest_hz) in [
            (DataRate::Sps128, 104.0, 184.0),
            (DataRate::Sps32, 26.0, 46.0),
            (DataRate::Sps16, 13.0, 23.0),
            (DataRate::Sps8, 6.5, 11.5),
        ] {
            let first_ms = PollPace::default().first_ms(rate);
            assert!(
                f64::from(first_ms) <= 1e3 / fastest_hz,
                "{rate:?}: {first_ms} ms"
            );
            let limit_ms = PollPace::limit_ms(rate);
            assert!(
                f64::from(limit_ms) >= 1e3 / slowest_hz + 1.0,
                "{rate:?}: {limit_ms} ms"
            );
        }
    }

    #[test]
    fn stuck_needs_a_run_and_a_meter_that_moves() {
        let run = |meter: &dyn Fn(u32) -> Option<Microamps>| {
            let mut bench = Bench::new(CONFIG, hah1bv());
            (0..40).position(|index| {
                bench.context.meter_mean = meter(index);
                bench.amps(20.0).validity == Validity::IMPLAUSIBLE
            })
        };
        // At rest, without a meter, or with a meter that moves by no more than the limit, repeats are legal.
        assert_eq!(run(&|_| Some(Microamps::from_amps(20))), None);
        assert_eq!(run(&|_| None), None);
        assert_eq!(
            run(&|index| Some(Microamps(1_000_000 * (index as i32 & 1)))),
            None
        );
        // The eighth identical code with a meter that moves by more, up or down.
        assert_eq!(
            run(&|index| Some(Microamps(1_000_001 * (index as i32 & 1)))),
            Some(7)
        );
        assert_eq!(
            run(&|index| Some(Microamps(-500_000 * index as i32))),
            Some(7)
        );
        // A mean over the last 100 ms reaches back before the run at samples 0 to 3.
        assert_eq!(
            run(&|index| Some(Microamps::from_amps(if index < 4 { 50 } else { 20 }))),
            None
        );
        assert_eq!(
            run(&|index| Some(Microamps::from_amps(if index < 5 { 50 } else { 20 }))),
            Some(7)
        );
        // A movement late in the run counts as well.
        assert_eq!(
            run(&|index| Some(Microamps::from_amps(if index < 30 { 50 } else { 20 }))),
            Some(30)
        );
    }

    #[test]
    fn a_mean_counts_that_began_no_earlier_than_the_first_of_the_codes() {
        for (second, third, expected) in [(99_999, 200_000, false), (100_000, 200_000, true)] {
            let config = ConverterConfig {
                stuck_count: 3,
                ..CONFIG
            };
            let mut converter = Converter::new();
            let mut step = |us: u64, amps| {
                let context = SampleContext {
                    meter_mean: Some(Microamps::from_amps(amps)),
                    meter_mean_begun: at(us - us.min(100_000)),
                    ..SampleContext::default()
                };
                converter.is_stuck(&config, 4_096, at(us), &context)
            };
            assert!(!step(1_000_000, 90));
            assert!(!step(1_000_000 + second, 50));
            assert_eq!(step(1_000_000 + third, 20), expected);
        }
    }

    #[test]
    fn stuck_ends_with_another_code_or_another_range() {
        let mut bench = Bench::new(CONFIG, FrontEnd::default());
        let moving = |bench: &mut Bench, code, count: i32| {
            (0..count)
                .filter(|index| {
                    bench.context.meter_mean = Some(Microamps::from_amps(*index * 20));
                    bench.code(code).validity.contains(Validity::IMPLAUSIBLE)
                })
                .count()
        };
        assert_eq!(moving(&mut bench, 4_200, 10), 3);
        assert!(bench.code(4_201).validity.is_valid());
        assert_eq!(moving(&mut bench, 4_201, 6), 0);
        bench.context.range = Range::Large;
        assert_eq!(moving(&mut bench, 4_201, 7), 0);
        assert_eq!(moving(&mut bench, 4_201, 1), 1);
        // In the large range a movement of ten amperes is not enough.
        let mut bench = Bench::new(CONFIG, FrontEnd::default());
        bench.context.range = Range::Large;
        let mut invalid = 0;
        for index in 0..20 {
            bench.context.meter_mean = Some(Microamps::from_amps(10 * (index & 1)));
            invalid += i32::from(!bench.code(4_300).validity.is_valid());
        }
        assert_eq!(invalid, 0);
    }

    #[test]
    fn defaults_are_valid_and_each_limit_is_named() {
        use ConverterConfigError as Error;
        let default = ConverterConfig::default();
        assert_eq!(default.validate(), Ok(()));
        assert_eq!(default.data_rate, DataRate::Sps32);
        assert_eq!(default.stale_after_periods, 3);
        type Change<'a> = &'a dyn Fn(&mut ConverterConfig);
        let cases: [(Change<'_>, Result<(), Error>); 24] = [
            (&|c| c.gain = Gain::X2, Err(Error::Gain)),
            (
                &|c| c.reference = Microvolts(2_699_999),
                Err(Error::Reference),
            ),
            (&|c| c.reference = Microvolts(2_700_000), Ok(())),
            (
                &|c| c.reference = Microvolts(5_500_001),
                Err(Error::Reference),
            ),
            (&|c| c.settling_us = 1_000_000, Ok(())),
            (&|c| c.settling_us = 1_000_001, Err(Error::Settling)),
            (&|c| c.adc1_period_us = 99, Err(Error::Adc1Period)),
            (&|c| c.adc1_period_us = 100, Ok(())),
            (&|c| c.adc1_period_us = 1_000_001, Err(Error::Adc1Period)),
            (&|c| c.stale_after_periods = 1, Err(Error::StaleAfter)),
            (&|c| c.stale_after_periods = 2, Ok(())),
            (&|c| c.stale_after_periods = 51, Err(Error::StaleAfter)),
            (
                &|c| c.saturation_margin = Microvolts(-1),
                Err(Error::SaturationMargin),
            ),
            (&|c| c.saturation_margin = Microvolts(0), Ok(())),
            (
                &|c| c.saturation_margin = Microvolts(100_001),
                Err(Error::SaturationMargin),
            ),
            (&|c| c.step_confirmations = 10, Ok(())),
            (
                &|c| c.step_confirmations = 11,
                Err(Error::StepConfirmations),
            ),
            (&|c| c.stuck_count = 7, Err(Error::StuckCount)),
            (&|c| c.stuck_count = 8, Ok(())),
            (
                &|c| c.stuck_movement.small = Microamps(0),
                Err(Error::StuckMovement),
            ),
            (
                &|c| c.stuck_movement.large = Microamps(0),
                Err(Error::StuckMovement),
            ),
            (&|c| c.stuck_movement.large = Microamps(1), Ok(())),
            (&|c| c.stuck_movement.small = Microamps(1), Ok(())),
            (&|c| c.max_amps_per_second = 0, Ok(())),
        ];
        for (index, (change, expected)) in cases.into_iter().enumerate() {
            let mut config = default;
            change(&mut config);
            assert_eq!(config.validate(), expected, "case {index}");
        }
    }

    fn any_rate() -> impl Strategy<Value = DataRate> {
        (0..4_usize).prop_map(|index| *RATES.get(index).unwrap())
    }

    fn any_mode() -> impl Strategy<Value = SupplyMode> {
        prop_oneof![
            Just(SupplyMode::Ratiometric),
            Just(SupplyMode::Measured),
            Just(SupplyMode::Fixed)
        ]
    }

    fn any_corrections() -> impl Strategy<Value = Corrections> {
        let key =
            (900_000_000..1_100_000_000, -100_000..100_000).prop_map(|(k_ppb, a)| KeyFactors {
                k_ppb,
                a: Microvolts(a),
            });
        (key, -50_000..50_000, -20_000_000..20_000_000).prop_map(|(key, gain, zero)| Corrections {
            key_factors: PerRange::both(key),
            gain: PerRange::both(Ppm(gain)),
            zero_drift: PerRange::both(Microamps(zero)),
        })
    }

    /// The chain of the module's description, step by step.
    fn chain(
        config: &ConverterConfig,
        front_end: &FrontEnd,
        corrections: &Corrections,
        supply: Microvolts,
        range: Range,
        input: i32,
    ) -> f64 {
        let vc = f64::from(supply.get()) * 1e-6;
        let closed_loop = matches!(front_end, FrontEnd::ClosedLoop(_));
        let volts = if front_end.channel() == Channel::Adc1 {
            f64::from(input) * 1e-6
        } else {
            let own = f64::from(config.reference.get()) * 1e-6;
            let share = f64::from(input) / 2f64.powi(config.data_rate.bits() as i32 - 1);
            match config.supply_mode {
                SupplyMode::Ratiometric => share * if closed_loop { vc } else { 5.0 },
                SupplyMode::Measured => share * own * if closed_loop { 1.0 } else { 5.0 / vc },
                SupplyMode::Fixed => share * own,
            }
        };
        let key = corrections.key_factors.get(range);
        let signal = f64::from(key.k_ppb) * 1e-9 * (volts + f64::from(key.a.get()) * 1e-6);
        let line_supply = if config.supply_mode == SupplyMode::Fixed {
            FIVE
        } else {
            supply
        };
        let line = front_end.line(range, line_supply);
        let current = (signal * 1e9 - line.zero_nanovolts as f64) * line.numerator as f64
            / line.denominator as f64;
        current * (1.0 + f64::from(corrections.gain.get(range).get()) * 1e-6)
            - f64::from(corrections.zero_drift.get(range).get())
    }

    proptest! {
        #[test]
        fn folded_coefficients_agree_with_the_chain(
            front_end in any_valid(), rate in any_rate(), supply_mode in any_mode(), corrections in any_corrections(),
            range in any_range(), supply in any_supply(), reference in 4_500_000..5_500_000, share in 0.0..1.0_f64
        ) {
            let config = ConverterConfig {
                data_rate: rate, supply_mode, reference: Microvolts(reference), ..CONFIG
            };
            let coefficients = ConverterCoefficients::prepare(&config, &front_end, &corrections, Some(supply));
            let input = match front_end.channel() {
                Channel::Adc1 => (share * 3_300_000.0) as i32,
                Channel::Ads1100 => (share * f64::from(coefficients.code_limit)) as i32,
            };
            let exact = chain(&config, &front_end, &corrections, supply, range, input)
                .clamp(f64::from(i32::MIN), f64::from(i32::MAX));
            let got = f64::from(coefficients.current(input, range).get());
            prop_assert!((got - exact).abs() <= 0.51, "{} {}", got, exact);
        }

        #[test]
        fn more_code_is_more_current(
            front_end in any_valid(), rate in any_rate(), range in any_range(), corrections in any_corrections(),
            code: i16, more in 1..1_000
        ) {
            let config = ConverterConfig { data_rate: rate, ..CONFIG };
            let coefficients = ConverterCoefficients::prepare(&config, &front_end, &corrections, None);
            let code = i32::from(code);
            prop_assert!(coefficients.current(code, range) <= coefficients.current(code + more, range));
            prop_assert!(coefficients.volts(code, range) <= coefficients.volts(code + more, range));
        }

        #[test]
        fn both_signs_are_treated_alike(rate in any_rate(), range in any_range(), distance in 0..16_384_i32) {
            for front_end in [FrontEnd::default(), hah1bv()] {
                let config = ConverterConfig { data_rate: rate, ..CONFIG };
                let coefficients = prepare(&config, front_end);
                let zero = coefficients.code_limit / 2;
                let distance = distance.min(zero);
                let up = coefficients.current(zero + distance, range).get();
                let down = coefficients.current(zero - distance, range).get();
                // Halves are rounded upward; all else is symmetric.
                prop_assert!((up + down).abs() <= 1);
            }
        }

        /// A ratiometric sensor, supplied with 4.5 … 5.5 V: the error stays below one code and 0.1 % (F15).
        #[test]
        fn supply_cancels_or_is_compensated(supply in any_supply(), amps in -450.0..450.0_f64) {
            let vc = f64::from(supply.get()) * 1e-6;
            let signal = vc / 5.0 * (2.5 + amps / 250.0);
            for (supply_mode, reference) in [(SupplyMode::Ratiometric, vc), (SupplyMode::Measured, 5.0)] {
                let config = ConverterConfig { supply_mode, data_rate: DataRate::Sps8, ..CONFIG };
                let coefficients = ConverterCoefficients::prepare(
                    &config, &hah1bv(), &Corrections::default(), Some(supply));
                let code = (signal / reference * 32_768.0).floor().min(32_767.0);
                let got = f64::from(coefficients.current(code as i32, Range::Small).get()) * 1e-6;
                if code < 32_767.0 {
                    prop_assert!(got <= amps + 1e-5 && got > amps - 0.044, "{} {}", got, amps);
                }
            }
            // A supply that is not compensated is what makes the mode matter.
            let fixed = ConverterConfig { supply_mode: SupplyMode::Fixed, ..CONFIG };
            let coefficients = ConverterCoefficients::prepare(&fixed, &hah1bv(), &Corrections::default(), Some(supply));
            prop_assert_eq!(coefficients, prepare(&fixed, hah1bv()));
        }

        #[test]
        fn closed_loop_with_shared_or_own_reference(supply in any_supply(), amps in -280.0..280.0_f64) {
            let d4 = FrontEnd::ClosedLoop(ClosedLoop {
                relations: SupplyRelations {
                    k1_nanoohm_per_volt: 2_000_000_000,
                    m1_nanoohm: 3_300_000_000,
                    k2_nanovolt_per_volt: 480_000_000,
                    m2_nanovolt: 100_000_000,
                },
                ..ClosedLoop::default()
            });
            let vc = f64::from(supply.get()) * 1e-6;
            let signal = (2.0 * vc + 3.3) * amps / 2_000.0 + 0.48 * vc + 0.1;
            for (supply_mode, reference) in [(SupplyMode::Ratiometric, vc), (SupplyMode::Measured, 5.0)] {
                let config = ConverterConfig { supply_mode, data_rate: DataRate::Sps8, ..CONFIG };
                let coefficients = ConverterCoefficients::prepare(&config, &d4, &Corrections::default(), Some(supply));
                let code = (signal / reference * 32_768.0).round();
                let got = f64::from(coefficients.current(code as i32, Range::Small).get()) * 1e-6;
                prop_assert!((got - amps).abs() < 0.015, "{} {}", got, amps);
            }
        }

        #[test]
        fn a_constant_current_is_believed_whatever_came_before(
            before in prop::collection::vec(500..7_500_i16, 0..30), then in 1_000..7_000_i16, confirmations in 0..5_u8
        ) {
            let config = ConverterConfig { step_confirmations: confirmations, ..CONFIG };
            let mut bench = Bench::new(config, hah1bv());
            for code in before {
                bench.code(code);
            }
            for _ in 0..confirmations {
                bench.code(then);
            }
            prop_assert!(bench.code(then).validity.is_valid());
        }

        #[test]
        fn within_the_rate_limit_nothing_is_refused(start in 2_000..6_000_i16, steps in prop::collection::vec(-200..=200_i16, 1..40)) {
            // 200 codes of 153 mA are 30.5 A, below 31.25 A.
            let mut bench = Bench::new(CONFIG, hah1bv());
            let mut code = start;
            for step in steps {
                code = (code + step).clamp(1_000, 7_000);
                prop_assert!(bench.code(code).validity.is_valid());
            }
        }

        #[test]
        fn an_invalid_sample_never_becomes_0_a(code in 4_200..8_192_i16, bad in 0..4_u8) {
            let mut bench = Bench::new(CONFIG, hah1bv());
            bench.amps(100.0);
            let reading = match bad {
                0 => bench.sample(0x8C, 0),
                1 => { bench.context.spoiled_by_edge = true; bench.code(code) }
                2 => bench.converter.on_fault(at(50_000)),
                _ => { bench.coefficients.supply_fault = true; bench.code(code) }
            };
            prop_assert!(!reading.validity.is_valid());
            prop_assert!(reading.current > Microamps::from_amps(5));
        }

        #[test]
        fn nothing_panics(
            front_end in any_front_end(), corrections in any::<([i32; 8], u8)>(), supply: Option<i32>, numbers: [i32; 4],
            rate in any_rate(), supply_mode in any_mode(),
            samples in prop::collection::vec(any::<(u64, u64, u8, i16, bool, Option<i32>, bool)>(), 1..20)
        ) {
            let ([k1, a1, k2, a2, g1, g2, z1, z2], small) = corrections;
            let corrections = Corrections {
                key_factors: PerRange {
                    small: KeyFactors { k_ppb: k1, a: Microvolts(a1) },
                    large: KeyFactors { k_ppb: k2, a: Microvolts(a2) },
                },
                gain: PerRange { small: Ppm(g1), large: Ppm(g2) },
                zero_drift: PerRange { small: Microamps(z1), large: Microamps(z2) },
            };
            let config = ConverterConfig {
                data_rate: rate,
                gain: Gain::X8,
                supply_mode,
                reference: Microvolts(numbers[0]),
                adc1_period_us: u32::MAX,
                settling_us: u32::MAX,
                stale_after_periods: u8::MAX,
                saturation_margin: Microvolts(numbers[1]),
                max_amps_per_second: numbers[2] as u32,
                step_confirmations: small,
                stuck_count: u16::from(small),
                stuck_movement: PerRange::both(Microamps(numbers[3])),
            };
            let _ = config.validate();
            let coefficients = ConverterCoefficients::prepare(&config, &front_end, &corrections, supply.map(Microvolts));
            let mut converter = Converter::new();
            for (started, finished, byte, code, expected, mean, large) in samples {
                let context = SampleContext {
                    range: if large { Range::Large } else { Range::Small },
                    spoiled_by_edge: byte & 1 == 1,
                    meter_mean: mean.map(Microamps),
                    meter_mean_begun: at(finished / 2),
                };
                let configuration = if expected { config.expected_configuration() } else { byte };
                let (started, finished) = (at(started), at(finished));
                let volts = Microvolts(mean.unwrap_or(0));
                converter.on_sample(&config, &coefficients, &ConverterSample { started, finished, configuration, code }, &context);
                converter.on_adc1_sample(&config, &coefficients, &Adc1Sample { started, finished, volts }, &context);
                let _ = converter.reading(&coefficients, finished);
            }
            let _ = (coefficients.step(Range::Small), coefficients.current(i32::MIN, Range::Large));
        }
    }
}
