//! D4's correction by vehicle state: factors k and a from the sensor's output at 0 A with key OFF and with key ACC,
//! and the permit for the high voltage, which waits for them.
//!
//! - Key **OFF**, high voltage off: output VC1, `k = VOUT0 / VC1` with VOUT0 the rated zero output, which the front end's settings have.
//! - Key **ACC**, low-voltage loads on, high voltage still off: output VC2, `a = VC1 − VC2`.
//! - Running: `k·(V + a)`, which is exactly VOUT0, that is 0 A, at V = VC2.
//!
//! VOUT0 is what the running form takes for 0 A: for D4's own sensor `k2·Vc + m2`, which follows the supply. If the
//! supply has changed from OFF to ACC, VC1 in `a` is the one that the sensor would have had at the supply in ACC.
//!
//! The factors belong to the range in which they were taken: the small one, which passes at 0 A.
//!
//! While the key is OFF batches are averaged one after the other and the newest good one is VC1: it is the one closest
//! in time and temperature to the ACC batch. The permit is given in any key state but OFF, as soon as the factors are
//! taken or the longest delay has passed. After a failure the default is to permit with the previous factors and to
//! report it: the factors are a correction of a few tenths of an ampere to some amperes, no reason to leave a vehicle
//! stranded; [`OnFailure::Hold`] is for those who decide otherwise.
//!
//! A board that starts while the key is not OFF and the high voltage is on (a reset on the road) permits at once:
//! to withdraw the permit would open the contactors under load. Until its first step the pin floats or is low all the
//! same, up to 0.5 s (0.95 s after a loss of power): bridging that is the off-delay's business that docs/firmware.md
//! demands of what the permit drives.

use core::fmt;

use serde::{Deserialize, Serialize};

use crate::front_end::KeyFactors;
use crate::range::Range;
use crate::steadiness::{Limit, Steadiness};
use crate::units::{
    Duration, Instant, Microamps, Microvolts, Nanocoulombs, abs_i64, clamp_i32, div_round, elapsed,
    mul_div, sub_i64,
};

/// The vehicle's key.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum KeyState {
    /// Everything off.
    #[default]
    Off,
    /// Accessories: low-voltage loads on, high voltage off.
    Acc,
    /// Ignition on, high voltage on or about to be.
    On,
    /// Start.
    Start,
}

/// What happens to the permit when the factors could not be taken in time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum OnFailure {
    /// Permit with the previous factors, and report.
    #[default]
    PermitWithPrevious,
    /// No permit until the factors are taken.
    Hold,
}

/// Configuration of the key-state calibration.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct KeyCalibrationConfig {
    /// Whether factors are taken at all; if not, the permit follows the key without a delay.
    pub enabled: bool,
    /// Samples that are averaged, at least 1.
    pub samples: u16,
    /// Time after a change of key or high voltage before samples count.
    pub settle_ms: u32,
    /// Longest delay of the permit after the key has left OFF.
    pub max_delay_ms: u32,
    /// Largest spread, highest minus lowest, of the samples of one average; of samples with noise ([`KeySample::noisy`]) of the means of
    /// its quarters, and four times as much of single ones.
    pub max_spread: Microvolts,
    /// Largest magnitude of the meter's current at which the conductor counts as free of current. The meter hangs on
    /// the same sensor, so this must leave room for the offset that is to be found.
    pub max_current: Microamps,
    /// Largest |k − 1|, in ppm.
    pub max_k_deviation_ppm: i32,
    /// Largest |a|.
    pub max_a: Microvolts,
    /// What happens after [`KeyCalibrationConfig::max_delay_ms`] without factors.
    pub on_failure: OnFailure,
    /// Time for which the key line must be low until the key counts as OFF: a contact that bounces on the road must
    /// not open the contactors.
    pub key_off_debounce_ms: u32,
    /// Time that the contactors have to open after the permit was withdrawn.
    pub feedback_grace_ms: u32,
}

impl Default for KeyCalibrationConfig {
    /// Figures without a source in D4 are *assumed*.
    fn default() -> Self {
        Self {
            enabled: true,
            // At 32 conversions a second: half a second.
            samples: 16,
            settle_ms: 200,
            // Settling and two batches fit; below what a driver notices between ACC and ready.
            max_delay_ms: 1_500,
            // One code of the ADS1100 at 32 conversions a second is 0.61 mV.
            max_spread: Microvolts::from_millivolts(2),
            // D4's example moves the zero by 20 mV: 0.53 A of D0's small sensor, 3 A of D4's own (6.67 mV/A).
            max_current: Microamps::from_milliamps(3_500),
            // D4's example: 0.4 %.
            max_k_deviation_ppm: 20_000,
            // D4's example: 10 mV.
            max_a: Microvolts::from_millivolts(50),
            on_failure: OnFailure::PermitWithPrevious,
            key_off_debounce_ms: 100,
            feedback_grace_ms: 1_000,
        }
    }
}

/// The newest sensor output, as the converter delivers it before the key factors.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct KeySample {
    /// The output; `None` when the conversion is not valid.
    pub voltage: Option<Microvolts>,
    /// VOUT0: the output that is taken for 0 A, at the supply of the moment.
    pub zero: Microvolts,
    /// The range in which it was converted.
    pub range: Range,
    /// When it was converted. A sample with the time of the one before is the same sample and counts once.
    pub at: Instant,
    /// It is of ADC1 (D3), whose noise alone spreads samples further than those of one average may.
    pub noisy: bool,
}

/// What one step is fed with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct KeyInputs {
    /// The time.
    pub now: Instant,
    /// Key line of the board: high from ACC on.
    pub acc_line: bool,
    /// High-voltage feedback line: high when the contactors are closed.
    pub hv_feedback: bool,
    /// Key state received over CAN, while it is fresh.
    pub can_key: Option<KeyState>,
    /// High-voltage state received over CAN, while it is fresh.
    pub can_high_voltage: Option<bool>,
    /// The meter's mean current, when valid.
    pub meter_current: Option<Microamps>,
    /// The meter's charge and when it was read, when valid.
    pub meter_charge: Option<(Instant, Nanocoulombs)>,
    /// The newest conversion, if any.
    pub sample: Option<KeySample>,
}

/// Why factors are not taken, or not yet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum KeyRefusal {
    /// No batch was finished yet.
    NoSamples,
    /// The samples of a batch spread this far.
    Unstable(Microvolts),
    /// The meter sees this current.
    CurrentFlows(Microamps),
    /// The high voltage is on, by feedback or by CAN.
    HighVoltageOn,
    /// The conversion was not valid.
    InvalidSample,
    /// The conversion was not made in the small range.
    WrongRange,
    /// Key line and CAN contradict each other.
    KeyContradiction,
    /// VC1 was not taken: the board was not on, or not at 0 A, while the key was OFF.
    NoOffValue,
    /// k would be this far from one, in ppm.
    KOutOfLimits(i32),
    /// a would be this voltage.
    AOutOfLimits(Microvolts),
    /// Ended by command.
    Cancelled,
}

impl fmt::Display for KeyRefusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoSamples => write!(f, "no samples yet"),
            Self::Unstable(spread) => {
                write!(f, "unstable: samples spread over {} µV", spread.get())
            }
            Self::CurrentFlows(current) => write!(f, "current flows: {} µA", current.get()),
            Self::HighVoltageOn => write!(f, "the high voltage is on"),
            Self::InvalidSample => write!(f, "the conversion is not valid"),
            Self::WrongRange => write!(f, "not in the small range"),
            Self::KeyContradiction => write!(f, "key line and CAN contradict each other"),
            Self::NoOffValue => write!(f, "no output was taken with key OFF"),
            Self::KOutOfLimits(ppm) => write!(f, "k is {ppm} ppm from one"),
            Self::AOutOfLimits(a) => write!(f, "a is {} µV", a.get()),
            Self::Cancelled => write!(f, "ended by command"),
        }
    }
}

impl core::error::Error for KeyRefusal {}

/// How far the calibration of this key cycle has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum KeyPhase {
    /// Key OFF: VC1 is being taken, again and again.
    Off,
    /// Key not OFF: VC2 is being taken, the permit waits.
    Taking,
    /// The factors were taken in this key cycle.
    Taken,
    /// They could not be taken in time, for this last reason; the previous ones are in use.
    Failed(KeyRefusal),
    /// The board started with the high voltage on; the previous factors are in use.
    Resumed,
    /// Not configured.
    Disabled,
}

impl KeyPhase {
    /// Its number on CAN and Modbus.
    #[must_use]
    pub const fn number(self) -> u8 {
        match self {
            Self::Off => 0,
            Self::Taking => 1,
            Self::Taken => 2,
            Self::Failed(_) => 3,
            Self::Resumed => 4,
            Self::Disabled => 5,
        }
    }
}

/// What a step results in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct KeyOutputs {
    /// Whether the high voltage may be on.
    pub hv_permit: bool,
    /// The key as line and CAN together say.
    pub key: KeyState,
    /// How far the calibration has come.
    pub phase: KeyPhase,
    /// New factors, once, in the step in which they were taken; to be saved.
    pub new_factors: Option<KeyFactors>,
    /// Diagnosis: high voltage on without a permit, longer than the contactors need.
    pub hv_without_permit: bool,
    /// Diagnosis: key line and CAN contradict each other.
    pub key_contradiction: bool,
    /// Why the newest batch was not taken, if it was not.
    pub refusal: Option<KeyRefusal>,
}

/// The state.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct KeyCalibration {
    factors: KeyFactors,
    phase: KeyPhase,
    started: bool,
    /// VC1 of this key cycle.
    off_output: Option<Microvolts>,
    /// VOUT0 at that time.
    off_zero: Microvolts,
    batch: Batch,
    last_sample: Option<Instant>,
    refusal: Option<KeyRefusal>,
    line_high_at: Option<Instant>,
    /// When key or high voltage last changed, and to what.
    changed_at: Instant,
    conditions: Option<(bool, bool)>,
    left_off_at: Instant,
    permit: bool,
    withheld_since: Instant,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Batch {
    /// Of the outputs, in µV.
    outputs: Steadiness,
    /// The meter's charge when it began.
    charge: Option<(Instant, Nanocoulombs)>,
}

impl Batch {
    const EMPTY: Self = Self {
        outputs: Steadiness::EMPTY,
        charge: None,
    };

    /// The mean current since it began: the meter's own mean may reach back to before.
    fn current(&self, now: Option<(Instant, Nanocoulombs)>) -> Option<Microamps> {
        let ((from, before), (to, after)) = (self.charge?, now?);
        let time_us = i64::try_from(elapsed(from, to).as_ticks()).ok()?;
        // nC per ms are µA.
        (time_us > 0).then(|| {
            Microamps(clamp_i32(mul_div(
                after.saturating_sub(before).get(),
                1_000,
                time_us,
            )))
        })
    }
}

impl KeyCalibration {
    /// The range in which the factors are taken and to which alone they apply.
    pub const RANGE: Range = Range::Small;

    /// Starts with the factors that were saved (or [`KeyFactors::NONE`]).
    #[must_use]
    pub const fn new(factors: KeyFactors, now: Instant) -> Self {
        Self {
            factors,
            phase: KeyPhase::Off,
            started: false,
            off_output: None,
            off_zero: Microvolts::ZERO,
            batch: Batch::EMPTY,
            last_sample: None,
            refusal: None,
            line_high_at: None,
            changed_at: now,
            conditions: None,
            left_off_at: now,
            permit: false,
            withheld_since: now,
        }
    }

    /// The factors in use, for [`KeyCalibration::RANGE`].
    #[must_use]
    pub const fn factors(&self) -> KeyFactors {
        self.factors
    }

    /// Others that a client has set; they hold until some are taken.
    pub const fn set_factors(&mut self, factors: KeyFactors) {
        self.factors = factors;
    }

    /// Ends the taking of VC2 of this key cycle; whether it was under way. What follows is what follows on any failure.
    /// With key OFF nothing is under way: VC1 is but kept up to date.
    pub fn cancel(&mut self) -> bool {
        let under_way = self.phase == KeyPhase::Taking;
        if under_way {
            self.phase = KeyPhase::Failed(KeyRefusal::Cancelled);
            self.refusal = Some(KeyRefusal::Cancelled);
            self.batch = Batch::EMPTY;
        }
        under_way
    }

    /// Looks at lines, CAN and samples. To be called at least as often as samples arrive.
    pub fn step(&mut self, config: &KeyCalibrationConfig, inputs: &KeyInputs) -> KeyOutputs {
        let (key, contradiction) = self.key_state(config, inputs);
        let high_voltage = inputs.hv_feedback || inputs.can_high_voltage == Some(true);
        self.follow_key(config, inputs, key);

        let conditions = Some((key == KeyState::Off, high_voltage));
        if self.conditions != conditions {
            self.conditions = conditions;
            self.changed_at = inputs.now;
            self.batch = Batch::EMPTY;
        }
        let new_factors = if self.wants_samples(config) {
            match self.take(config, inputs, high_voltage, contradiction) {
                Ok(factors) => factors,
                Err(refusal) => {
                    self.refusal = Some(refusal);
                    self.batch = Batch::EMPTY;
                    None
                }
            }
        } else {
            None
        };
        if self.phase == KeyPhase::Taking
            && elapsed(self.left_off_at, inputs.now) >= milliseconds(config.max_delay_ms)
        {
            self.phase = KeyPhase::Failed(self.refusal.unwrap_or(KeyRefusal::NoSamples));
        }
        let permit = match self.phase {
            KeyPhase::Off | KeyPhase::Taking => false,
            KeyPhase::Taken | KeyPhase::Resumed | KeyPhase::Disabled => true,
            KeyPhase::Failed(_) => config.on_failure == OnFailure::PermitWithPrevious,
        };
        if self.permit && !permit {
            self.withheld_since = inputs.now;
        }
        self.permit = permit;

        KeyOutputs {
            hv_permit: permit,
            key,
            phase: self.phase,
            new_factors,
            hv_without_permit: inputs.hv_feedback
                && !permit
                && elapsed(self.withheld_since, inputs.now)
                    > milliseconds(config.feedback_grace_ms),
            key_contradiction: contradiction,
            refusal: self.refusal,
        }
    }

    /// The key as line and CAN say, and whether they contradict each other. The line decides: it is the wire that
    /// carries the driver's wish, CAN only tells ACC from ON.
    fn key_state(&mut self, config: &KeyCalibrationConfig, inputs: &KeyInputs) -> (KeyState, bool) {
        if inputs.acc_line {
            self.line_high_at = Some(inputs.now);
        }
        let bouncing = self
            .line_high_at
            .is_some_and(|at| elapsed(at, inputs.now) < milliseconds(config.key_off_debounce_ms));
        if inputs.acc_line || bouncing {
            match inputs.can_key {
                None => (KeyState::Acc, false),
                Some(KeyState::Off) => (KeyState::Acc, true),
                Some(key) => (key, false),
            }
        } else {
            (
                KeyState::Off,
                inputs.can_key.is_some_and(|key| key != KeyState::Off),
            )
        }
    }

    fn follow_key(&mut self, config: &KeyCalibrationConfig, inputs: &KeyInputs, key: KeyState) {
        let resumes = !self.started && inputs.hv_feedback;
        // One look at two lines may err. Contactors that are closed so soon were closed before the start, since when there
        // was no permit.
        self.started |=
            elapsed(self.withheld_since, inputs.now) >= milliseconds(config.key_off_debounce_ms);
        if key == KeyState::Off {
            if self.phase != KeyPhase::Off {
                self.phase = KeyPhase::Off;
                // VC1 of the cycle before says nothing about this one.
                self.off_output = None;
                self.refusal = None;
            }
        } else if !config.enabled {
            self.phase = KeyPhase::Disabled;
        } else if self.phase == KeyPhase::Off || (resumes && self.phase == KeyPhase::Taking) {
            self.phase = if resumes {
                KeyPhase::Resumed
            } else {
                KeyPhase::Taking
            };
            self.left_off_at = inputs.now;
            self.refusal = None;
        }
    }

    fn wants_samples(&self, config: &KeyCalibrationConfig) -> bool {
        config.enabled
            && match self.phase {
                KeyPhase::Off | KeyPhase::Taking => true,
                // With the permit given the high voltage may come on at any moment.
                KeyPhase::Failed(_) => config.on_failure == OnFailure::Hold,
                KeyPhase::Taken | KeyPhase::Resumed | KeyPhase::Disabled => false,
            }
    }

    /// Adds the sample to the batch, and finishes the batch when it is full.
    fn take(
        &mut self,
        config: &KeyCalibrationConfig,
        inputs: &KeyInputs,
        high_voltage: bool,
        contradiction: bool,
    ) -> Result<Option<KeyFactors>, KeyRefusal> {
        if contradiction {
            return Err(KeyRefusal::KeyContradiction);
        }
        if high_voltage {
            return Err(KeyRefusal::HighVoltageOn);
        }
        if let Some(current) = inputs.meter_current
            && current.saturating_abs() > config.max_current
        {
            return Err(KeyRefusal::CurrentFlows(current));
        }
        let Some(sample) = inputs.sample else {
            return Ok(None);
        };
        let settled = sample.at >= self.changed_at
            && elapsed(self.changed_at, sample.at) >= milliseconds(config.settle_ms);
        if !settled || self.last_sample == Some(sample.at) {
            return Ok(None);
        }
        self.last_sample = Some(sample.at);
        let voltage = sample.voltage.ok_or(KeyRefusal::InvalidSample)?;
        if sample.range != Self::RANGE {
            return Err(KeyRefusal::WrongRange);
        }
        if self.batch.outputs.taken() == 0 {
            self.batch.charge = inputs.meter_charge;
        }
        let limit = Limit {
            spread: config.max_spread.get(),
            samples: config.samples,
            noisy: sample.noisy,
        };
        let taken = self.batch.outputs.take(limit, voltage.get());
        if !taken.map_err(|spread| KeyRefusal::Unstable(Microvolts(spread)))? {
            return Ok(None);
        }
        let batch = core::mem::replace(&mut self.batch, Batch::EMPTY);
        let output = Microvolts(batch.outputs.mean());
        if let Some(current) = batch.current(inputs.meter_charge)
            && current.saturating_abs() > config.max_current
        {
            return Err(KeyRefusal::CurrentFlows(current));
        }
        if self.phase == KeyPhase::Off {
            first_factor(config, sample.zero, output)?;
            self.off_output = Some(output);
            self.off_zero = sample.zero;
            self.refusal = None;
            return Ok(None);
        }
        let off_output = self.off_output.ok_or(KeyRefusal::NoOffValue)?;
        let k_ppb = first_factor(config, self.off_zero, off_output)?;
        let zero_output = Microvolts(clamp_i32(mul_div(
            i64::from(sample.zero.get()),
            i64::from(KeyFactors::K_ONE_PPB),
            i64::from(k_ppb),
        )));
        let a = zero_output.saturating_sub(output);
        if a.saturating_abs() > config.max_a {
            return Err(KeyRefusal::AOutOfLimits(a));
        }
        self.factors = KeyFactors { k_ppb, a };
        self.phase = KeyPhase::Taken;
        self.refusal = None;
        Ok(Some(self.factors))
    }
}

/// `k = VOUT0 / VC1` in 10⁻⁹.
fn first_factor(
    config: &KeyCalibrationConfig,
    zero: Microvolts,
    off_output: Microvolts,
) -> Result<i32, KeyRefusal> {
    let one = i64::from(KeyFactors::K_ONE_PPB);
    let k = mul_div(i64::from(zero.get()), one, i64::from(off_output.get()));
    let deviation = sub_i64(k, one);
    let allowed = i64::from(config.max_k_deviation_ppm) * 1_000;
    if off_output <= Microvolts::ZERO || abs_i64(deviation) > allowed {
        return Err(KeyRefusal::KOutOfLimits(clamp_i32(div_round(
            deviation, 1_000,
        ))));
    }
    Ok(clamp_i32(k))
}

fn milliseconds(milliseconds: u32) -> Duration {
    Duration::from_ticks(u64::from(milliseconds) * 1_000)
}

#[cfg(test)]
#[allow(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss
)]
mod tests {
    use super::*;
    use crate::design_parameters::SENSOR_ZERO;
    use crate::design_parameters::{D4_EXAMPLE_ACC, D4_EXAMPLE_OFF};
    use crate::front_end::FrontEnd;
    use proptest::prelude::*;
    use std::string::ToString;

    const PREVIOUS: KeyFactors = KeyFactors {
        k_ppb: 1_001_000_000,
        a: Microvolts(1_234),
    };
    const MS: u64 = 1_000;
    /// A conversion at 32 a second.
    const CONVERSION: u64 = 31_250;

    /// 4 samples, 100 ms of settling, 1 s of delay.
    fn config() -> KeyCalibrationConfig {
        KeyCalibrationConfig {
            samples: 4,
            settle_ms: 100,
            max_delay_ms: 1_000,
            ..KeyCalibrationConfig::default()
        }
    }

    struct Car {
        config: KeyCalibrationConfig,
        calibration: KeyCalibration,
        inputs: KeyInputs,
        voltage: Option<Microvolts>,
        zero: Microvolts,
        range: Range,
        /// Added to every other sample.
        ripple: i32,
        noisy: bool,
        samples: u64,
        /// By the meter's charge; its mean is what `inputs` says.
        milliamps: i64,
    }

    impl Car {
        fn new(config: KeyCalibrationConfig) -> Self {
            let now = Instant::from_ticks(1_000_000);
            Self {
                config,
                calibration: KeyCalibration::new(PREVIOUS, now),
                inputs: KeyInputs {
                    now,
                    acc_line: false,
                    hv_feedback: false,
                    can_key: None,
                    can_high_voltage: None,
                    meter_current: Some(Microamps::ZERO),
                    meter_charge: None,
                    sample: None,
                },
                voltage: Some(D4_EXAMPLE_OFF),
                zero: SENSOR_ZERO,
                range: Range::Small,
                ripple: 0,
                noisy: false,
                samples: 0,
                milliamps: 0,
            }
        }

        fn step(&mut self) -> KeyOutputs {
            self.calibration.step(&self.config, &self.inputs)
        }

        /// Runs with conversions; the last outputs, and the factors if any were taken meanwhile.
        fn run_ms(&mut self, milliseconds: u64) -> (KeyOutputs, Option<KeyFactors>) {
            let end = self.inputs.now.as_ticks() + milliseconds * MS;
            let mut factors = None;
            let mut outputs = self.step();
            while self.inputs.now.as_ticks() + CONVERSION <= end {
                self.inputs.now = Instant::from_ticks(self.inputs.now.as_ticks() + CONVERSION);
                self.samples += 1;
                let charge = self
                    .inputs
                    .meter_charge
                    .map_or(0, |(_, charge)| charge.get());
                // mA · µs are nC.
                let charge = charge + self.milliamps * CONVERSION.cast_signed();
                self.inputs.meter_charge = Some((self.inputs.now, Nanocoulombs(charge)));
                let ripple = if self.samples.is_multiple_of(2) {
                    self.ripple
                } else {
                    0
                };
                self.inputs.sample = Some(KeySample {
                    voltage: self.voltage.map(|v| Microvolts(v.get() + ripple)),
                    zero: self.zero,
                    range: self.range,
                    at: self.inputs.now,
                    noisy: self.noisy,
                });
                outputs = self.step();
                factors = factors.or(outputs.new_factors);
            }
            self.inputs.now = Instant::from_ticks(end);
            (outputs, factors)
        }

        fn wait_ms(&mut self, milliseconds: u64) -> KeyOutputs {
            self.inputs.now = Instant::from_ticks(self.inputs.now.as_ticks() + milliseconds * MS);
            self.step()
        }
    }

    /// OFF with 2.49 V, ready for ACC with 2.48 V.
    fn after_off(config: KeyCalibrationConfig) -> Car {
        let mut car = Car::new(config);
        let (outputs, factors) = car.run_ms(500);
        assert_eq!(
            (outputs.phase, outputs.refusal, factors),
            (KeyPhase::Off, None, None)
        );
        assert!(!outputs.hv_permit);
        car.voltage = Some(D4_EXAMPLE_ACC);
        car.inputs.acc_line = true;
        car
    }

    #[test]
    fn the_example_of_the_document_returns_0_a_in_acc() {
        let mut car = after_off(config());
        let outputs = car.step();
        assert_eq!(
            (outputs.hv_permit, outputs.phase, outputs.key),
            (false, KeyPhase::Taking, KeyState::Acc)
        );
        let (outputs, factors) = car.run_ms(500);
        let factors = factors.unwrap();
        assert!(outputs.hv_permit);
        assert_eq!(
            (outputs.phase, outputs.refusal, outputs.new_factors),
            (KeyPhase::Taken, None, None)
        );
        // a = 0.01 V, k = 2.5 / 2.49 = 1.004 016 064
        assert_eq!(
            factors,
            KeyFactors {
                k_ppb: 1_004_016_064,
                a: Microvolts(10_000)
            }
        );
        assert_eq!(car.calibration.factors(), factors);
        assert_eq!(factors.apply(D4_EXAMPLE_ACC), SENSOR_ZERO);
        // Once per key cycle, also while the high voltage still waits.
        car.voltage = Some(Microvolts(2_470_000));
        assert_eq!(car.run_ms(1_000).1, None);
        assert_eq!(car.calibration.factors(), factors);
        let supply = crate::design_parameters::SENSOR_NOMINAL_SUPPLY;
        let current = FrontEnd::default().current(
            factors.apply(D4_EXAMPLE_ACC),
            KeyCalibration::RANGE,
            supply,
        );
        assert_eq!(current, Microamps::ZERO);
    }

    #[test]
    fn the_defaults_leave_time_for_two_batches() {
        let config = KeyCalibrationConfig::default();
        let batch_ms = u32::from(config.samples) * 1_000 / 32;
        assert!(config.settle_ms + 2 * batch_ms <= config.max_delay_ms);
        assert_eq!(config.on_failure, OnFailure::PermitWithPrevious);
        let mut car = after_off(config);
        car.calibration.off_output = Some(D4_EXAMPLE_OFF);
        car.calibration.off_zero = SENSOR_ZERO;
        assert!(car.run_ms(1_000).0.hv_permit);
    }

    #[test]
    fn the_permit_comes_with_the_factors_stays_while_driving_and_goes_with_the_key() {
        let mut car = after_off(config());
        // Settled after 100 ms, and four samples: the 4th conversion is at 125 ms, the 7th at 218.75 ms.
        assert!(!car.run_ms(6 * 31 + 10).0.hv_permit);
        assert!(car.run_ms(32).0.hv_permit);
        car.inputs.can_key = Some(KeyState::On);
        car.inputs.hv_feedback = true;
        car.inputs.can_high_voltage = Some(true);
        car.voltage = Some(Microvolts(3_000_000));
        let (outputs, factors) = car.run_ms(10_000);
        assert!(outputs.hv_permit && !outputs.hv_without_permit && !outputs.key_contradiction);
        assert_eq!(
            (outputs.phase, outputs.key, factors),
            (KeyPhase::Taken, KeyState::On, None)
        );
        // A contact that bounces for less than 100 ms does no harm.
        car.inputs.acc_line = false;
        car.inputs.can_key = None;
        assert!(car.wait_ms(99).hv_permit);
        car.inputs.acc_line = true;
        assert!(car.wait_ms(1).hv_permit);
        car.inputs.acc_line = false;
        assert!(car.wait_ms(99).hv_permit);
        let outputs = car.wait_ms(1);
        assert_eq!(
            (outputs.hv_permit, outputs.key, outputs.phase),
            (false, KeyState::Off, KeyPhase::Off)
        );
        // The contactors have a second to open.
        assert!(!car.wait_ms(1_000).hv_without_permit);
        assert!(car.wait_ms(1).hv_without_permit);
        car.inputs.hv_feedback = false;
        assert!(!car.step().hv_without_permit);
    }

    #[test]
    fn each_cycle_takes_its_own_off_value() {
        let mut car = after_off(config());
        assert!(car.run_ms(500).1.is_some());
        car.inputs.acc_line = false;
        car.wait_ms(100);
        // Too short an OFF for a new VC1: the old one is not used again.
        car.inputs.acc_line = true;
        let (outputs, factors) = car.run_ms(1_100);
        assert_eq!(outputs.phase, KeyPhase::Failed(KeyRefusal::NoOffValue));
        assert_eq!(factors, None);
        assert!(outputs.hv_permit);
        // The newest good batch of OFF is VC1.
        car.inputs.acc_line = false;
        car.wait_ms(100);
        car.voltage = Some(Microvolts(2_470_000));
        car.run_ms(300);
        car.voltage = Some(Microvolts(2_510_000));
        car.run_ms(400);
        car.inputs.acc_line = true;
        car.voltage = Some(Microvolts(2_515_000));
        let factors = car.run_ms(500).1.unwrap();
        assert_eq!(
            factors,
            KeyFactors {
                k_ppb: 996_015_936,
                a: Microvolts(-5_000)
            }
        );
        assert_eq!(factors.apply(Microvolts(2_515_000)), SENSOR_ZERO);
    }

    #[test]
    fn a_failure_permits_with_the_previous_factors_or_holds() {
        let mut car = after_off(config());
        car.ripple = 2_001;
        let (outputs, _) = car.run_ms(990);
        assert_eq!(
            (outputs.phase, outputs.hv_permit),
            (KeyPhase::Taking, false)
        );
        assert_eq!(
            outputs.refusal,
            Some(KeyRefusal::Unstable(Microvolts(2_001)))
        );
        car.inputs.now =
            Instant::from_ticks(car.calibration.left_off_at.as_ticks() + 1_000 * MS - 1);
        assert!(!car.step().hv_permit);
        car.inputs.now = Instant::from_ticks(car.inputs.now.as_ticks() + 1);
        let outputs = car.step();
        assert_eq!(
            outputs.phase,
            KeyPhase::Failed(KeyRefusal::Unstable(Microvolts(2_001)))
        );
        assert!(outputs.hv_permit);
        // With the permit out nothing is taken any more.
        car.ripple = 0;
        let (outputs, factors) = car.run_ms(2_000);
        assert_eq!(
            (outputs.hv_permit, factors, car.calibration.factors()),
            (true, None, PREVIOUS)
        );

        let mut car = after_off(KeyCalibrationConfig {
            on_failure: OnFailure::Hold,
            ..config()
        });
        car.ripple = 2_001;
        let (outputs, _) = car.run_ms(2_000);
        assert_eq!(
            outputs.phase,
            KeyPhase::Failed(KeyRefusal::Unstable(Microvolts(2_001)))
        );
        assert!(!outputs.hv_permit);
        car.ripple = 2_000;
        let (outputs, factors) = car.run_ms(500);
        assert!(outputs.hv_permit && factors.is_some());
        assert_eq!(outputs.phase, KeyPhase::Taken);
    }

    /// Of D3's samples the means of quarters have to lie within the limit, single ones within four times it.
    #[test]
    fn noisy_samples_are_judged_by_the_means_of_quarters() {
        let config = KeyCalibrationConfig {
            samples: 8,
            ..config()
        };
        let with = |noisy, ripple| {
            let mut car = after_off(config);
            (car.noisy, car.ripple) = (noisy, ripple);
            let (outputs, factors) = car.run_ms(800);
            factors.map(|factors| factors.a).ok_or(outputs.refusal)
        };
        let unstable = |spread| Err(Some(KeyRefusal::Unstable(Microvolts(spread))));
        assert_eq!(with(false, 2_001), unstable(2_001));
        // Half of the ripple is in the mean.
        assert_eq!(with(true, 8_000), Ok(Microvolts(10_000 - 4_000)));
        assert_eq!(with(true, 8_001), unstable(8_001));
    }

    #[test]
    fn each_condition_against_it_is_the_reason() {
        type Change = fn(&mut Car);
        let cases: [(Change, KeyRefusal); 12] = [
            (|car| car.inputs.sample = None, KeyRefusal::NoSamples),
            (
                |car| car.ripple = -2_001,
                KeyRefusal::Unstable(Microvolts(2_001)),
            ),
            (
                |car| car.inputs.meter_current = Some(Microamps(3_500_001)),
                KeyRefusal::CurrentFlows(Microamps(3_500_001)),
            ),
            (
                |car| car.inputs.meter_current = Some(Microamps(-3_500_001)),
                KeyRefusal::CurrentFlows(Microamps(-3_500_001)),
            ),
            (
                |car| car.inputs.hv_feedback = true,
                KeyRefusal::HighVoltageOn,
            ),
            (
                |car| car.inputs.can_high_voltage = Some(true),
                KeyRefusal::HighVoltageOn,
            ),
            (|car| car.voltage = None, KeyRefusal::InvalidSample),
            (|car| car.range = Range::Large, KeyRefusal::WrongRange),
            (
                |car| car.inputs.can_key = Some(KeyState::Off),
                KeyRefusal::KeyContradiction,
            ),
            (
                |car| car.calibration.off_output = None,
                KeyRefusal::NoOffValue,
            ),
            (
                |car| car.voltage = Some(Microvolts(2_439_999)),
                KeyRefusal::AOutOfLimits(Microvolts(50_001)),
            ),
            (
                |car| car.voltage = Some(Microvolts(2_540_001)),
                KeyRefusal::AOutOfLimits(Microvolts(-50_001)),
            ),
        ];
        for (index, (change, reason)) in cases.into_iter().enumerate() {
            let mut car = after_off(config());
            change(&mut car);
            let outputs = if index == 0 {
                car.step();
                car.wait_ms(1_000)
            } else {
                car.run_ms(1_100).0
            };
            assert_eq!(outputs.phase, KeyPhase::Failed(reason));
            assert_eq!(car.calibration.factors(), PREVIOUS, "{reason:?}");
            assert_eq!(
                outputs.key_contradiction,
                reason == KeyRefusal::KeyContradiction
            );
        }
        // At the limits themselves, and without what is optional, they are taken.
        let good: [Change; 7] = [
            |car| car.ripple = 2_000,
            |car| car.inputs.meter_current = Some(Microamps(-3_500_000)),
            |car| car.inputs.meter_current = None,
            |car| car.inputs.can_high_voltage = Some(false),
            |car| car.inputs.can_key = Some(KeyState::Start),
            |car| car.voltage = Some(Microvolts(2_440_000)),
            |car| car.voltage = Some(Microvolts(2_540_000)),
        ];
        for change in good {
            let mut car = after_off(config());
            change(&mut car);
            assert!(car.run_ms(500).1.is_some());
        }
    }

    /// The meter's mean is that of a whole second, and the current began with the key.
    #[test]
    fn a_current_that_the_mean_does_not_show_yet_is_seen_by_the_charge() {
        for milliamps in [-5_000, 5_000] {
            let mut car = after_off(config());
            car.inputs.acc_line = true;
            car.milliamps = milliamps;
            let (outputs, factors) = car.run_ms(2_000);
            assert_eq!(factors, None);
            let KeyPhase::Failed(KeyRefusal::CurrentFlows(current)) = outputs.phase else {
                panic!("{:?}", outputs.phase);
            };
            assert_eq!(i64::from(current.get()), milliamps * 1_000);
        }
        // What the offset to be found makes of 0 A is none.
        let mut car = after_off(config());
        car.inputs.acc_line = true;
        car.milliamps = -3_000;
        assert!(car.run_ms(2_000).1.is_some());
    }

    #[test]
    fn one_bad_sample_starts_the_batch_anew() {
        let mut car = after_off(config());
        // Samples 4, 5, 6 count.
        car.run_ms(6 * 31 + 4);
        assert_eq!(car.calibration.batch.outputs.taken(), 3);
        car.voltage = None;
        let outputs = car.run_ms(31 + 1).0;
        assert_eq!(
            (outputs.refusal, car.calibration.batch.outputs.taken()),
            (Some(KeyRefusal::InvalidSample), 0)
        );
    }

    #[test]
    fn key_off_refuses_what_is_not_a_zero_output() {
        let off = |change: fn(&mut Car)| {
            let mut car = Car::new(config());
            change(&mut car);
            let refusal = car.run_ms(500).0.refusal;
            assert_eq!(car.calibration.off_output.is_some(), refusal.is_none());
            refusal
        };
        assert_eq!(off(|_| ()), None);
        assert_eq!(off(|car| car.inputs.can_key = Some(KeyState::Off)), None);
        assert_eq!(
            off(|car| car.inputs.can_key = Some(KeyState::Acc)),
            Some(KeyRefusal::KeyContradiction)
        );
        // 2.5 / 2.45 is 2.04 %, 2.5 / 2.46 is 1.63 %.
        assert_eq!(
            off(|car| car.voltage = Some(Microvolts(2_450_000))),
            Some(KeyRefusal::KOutOfLimits(20_408))
        );
        assert_eq!(off(|car| car.voltage = Some(Microvolts(2_460_000))), None);
        assert_eq!(
            off(|car| car.voltage = Some(Microvolts(2_560_000))),
            Some(KeyRefusal::KOutOfLimits(-23_438))
        );
        assert_eq!(
            off(|car| car.voltage = Some(Microvolts(0))),
            Some(KeyRefusal::KOutOfLimits(-1_000_000))
        );
        assert_eq!(
            off(|car| car.voltage = Some(Microvolts(-2_490_000))),
            Some(KeyRefusal::KOutOfLimits(-2_004_016))
        );
        // An output of 0 V has no factor, however wide the limit.
        assert_eq!(
            off(|car| {
                car.config.max_k_deviation_ppm = 1_000_000;
                car.voltage = Some(Microvolts(0));
            }),
            Some(KeyRefusal::KOutOfLimits(-1_000_000))
        );
        // Exactly 2 %: 2.5 V / 2.5 V · 1.02.
        assert_eq!(
            off(|car| {
                car.zero = Microvolts(2_550_000);
                car.voltage = Some(Microvolts(2_500_000));
            }),
            None
        );
    }

    #[test]
    fn a_sample_counts_once_and_only_after_settling() {
        let mut car = Car::new(config());
        car.config.samples = 1;
        let sample = |us: u64| {
            Some(KeySample {
                voltage: Some(D4_EXAMPLE_OFF),
                zero: SENSOR_ZERO,
                range: Range::Small,
                at: Instant::from_ticks(1_000_000 + us),
                noisy: false,
            })
        };
        car.step();
        car.inputs.now = Instant::from_ticks(1_200_000);
        // Converted before it had settled, though looked at afterwards.
        car.inputs.sample = sample(99_999);
        car.step();
        assert_eq!(car.calibration.off_output, None);
        car.inputs.sample = sample(100_000);
        car.step();
        assert_eq!(car.calibration.off_output, Some(D4_EXAMPLE_OFF));
        car.config.samples = 3;
        car.step();
        car.step();
        assert_eq!(car.calibration.batch.outputs.taken(), 0);
        car.inputs.sample = sample(131_250);
        car.step();
        car.step();
        assert_eq!(car.calibration.batch.outputs.taken(), 1);
        // A change of the high voltage begins anew, also without a settling time.
        car.config.settle_ms = 0;
        car.inputs.can_high_voltage = Some(true);
        car.step();
        assert_eq!(car.calibration.batch.outputs.taken(), 0);
        car.inputs.can_high_voltage = Some(false);
        car.inputs.sample = sample(199_999);
        car.step();
        assert_eq!(car.calibration.batch.outputs.taken(), 0);
        car.inputs.sample = sample(200_000);
        car.step();
        assert_eq!(car.calibration.batch.outputs.taken(), 1);
    }

    #[test]
    fn after_a_reset_on_the_road_the_permit_is_there_at_once() {
        let mut car = Car::new(config());
        car.inputs.acc_line = true;
        car.inputs.hv_feedback = true;
        let outputs = car.step();
        assert_eq!(
            (outputs.hv_permit, outputs.phase),
            (true, KeyPhase::Resumed)
        );
        assert_eq!(car.calibration.factors(), PREVIOUS);
        // It lasts until the key is turned off; afterwards everything is as always.
        car.inputs.hv_feedback = false;
        assert!(car.run_ms(3_000).0.hv_permit);
        car.inputs.acc_line = false;
        car.wait_ms(100);
        car.inputs.acc_line = true;
        car.inputs.hv_feedback = true;
        let outputs = car.step();
        assert_eq!(
            (outputs.hv_permit, outputs.phase),
            (false, KeyPhase::Taking)
        );
        // Started in ACC without high voltage there is no VC1, but a permit after the delay.
        let mut car = Car::new(config());
        car.inputs.acc_line = true;
        assert_eq!(car.step().phase, KeyPhase::Taking);
        assert_eq!(
            car.run_ms(1_100).0.phase,
            KeyPhase::Failed(KeyRefusal::NoOffValue)
        );
        // One wrong look at either line is made good by the next one, and no later than the key's debounce.
        for (key, feedback) in [(false, true), (true, false)] {
            for (looks_ms, permits) in [(10, true), (90, true), (100, false)] {
                let mut car = Car::new(config());
                (car.inputs.acc_line, car.inputs.hv_feedback) = (key, feedback);
                assert!(!car.step().hv_permit);
                car.wait_ms(looks_ms);
                (car.inputs.acc_line, car.inputs.hv_feedback) = (true, true);
                assert_eq!(car.step().hv_permit, permits, "{key} {looks_ms} ms");
            }
        }
        // Started with the key OFF and high voltage on: welded contactors.
        let mut car = Car::new(config());
        car.inputs.hv_feedback = true;
        assert!(!car.step().hv_without_permit);
        assert!(!car.wait_ms(1_000).hv_without_permit);
        assert!(car.wait_ms(1).hv_without_permit);
        // The time counts from the start, not from the first look.
        let mut car = Car::new(config());
        car.inputs.hv_feedback = true;
        assert!(car.wait_ms(1_001).hv_without_permit);
    }

    #[test]
    fn switched_off_the_permit_follows_the_key() {
        let mut car = Car::new(KeyCalibrationConfig {
            enabled: false,
            ..config()
        });
        let (outputs, _) = car.run_ms(500);
        assert_eq!((outputs.hv_permit, outputs.phase), (false, KeyPhase::Off));
        assert_eq!(car.calibration.off_output, None);
        car.inputs.acc_line = true;
        let outputs = car.step();
        assert_eq!(
            (outputs.hv_permit, outputs.phase),
            (true, KeyPhase::Disabled)
        );
        assert_eq!(car.run_ms(2_000).1, None);
        // Switched on in between, it begins with the next key cycle.
        car.config.enabled = true;
        assert_eq!(car.run_ms(1_000).0.phase, KeyPhase::Disabled);
    }

    #[test]
    fn line_and_can_make_the_key() {
        let key = |acc_line, can_key| {
            let mut car = Car::new(config());
            car.inputs.acc_line = acc_line;
            car.inputs.can_key = can_key;
            let outputs = car.step();
            (outputs.key, outputs.key_contradiction)
        };
        assert_eq!(key(false, None), (KeyState::Off, false));
        assert_eq!(key(false, Some(KeyState::Off)), (KeyState::Off, false));
        assert_eq!(key(false, Some(KeyState::On)), (KeyState::Off, true));
        assert_eq!(key(true, None), (KeyState::Acc, false));
        assert_eq!(key(true, Some(KeyState::Off)), (KeyState::Acc, true));
        assert_eq!(key(true, Some(KeyState::Acc)), (KeyState::Acc, false));
        assert_eq!(key(true, Some(KeyState::On)), (KeyState::On, false));
        assert_eq!(key(true, Some(KeyState::Start)), (KeyState::Start, false));
    }

    #[test]
    fn every_refusal_says_what_it_is() {
        for (refusal, part) in [
            (KeyRefusal::NoSamples, "no samples"),
            (KeyRefusal::Unstable(Microvolts(3)), "over 3 µV"),
            (KeyRefusal::CurrentFlows(Microamps(-4)), "-4 µA"),
            (KeyRefusal::HighVoltageOn, "high voltage"),
            (KeyRefusal::InvalidSample, "not valid"),
            (KeyRefusal::WrongRange, "range"),
            (KeyRefusal::KeyContradiction, "contradict"),
            (KeyRefusal::NoOffValue, "key OFF"),
            (KeyRefusal::KOutOfLimits(7), "7 ppm"),
            (KeyRefusal::AOutOfLimits(Microvolts(8)), "8 µV"),
        ] {
            assert!(refusal.to_string().contains(part), "{refusal}");
        }
    }

    proptest! {
        /// The zero output follows the supply, and the low-voltage loads may pull that.
        #[test]
        fn acc_reads_0_a_when_the_supply_has_changed_since_off(
            zero in 2_375_000..2_625_000i32, fall in -50_000..50_000i32, shifts in proptest::array::uniform2(-20_000..20_000i32),
        ) {
            let mut car = Car::new(config());
            car.zero = Microvolts(zero);
            car.voltage = Some(Microvolts(zero + shifts[0]));
            car.run_ms(500);
            car.inputs.acc_line = true;
            car.zero = Microvolts(zero + fall);
            let acc = Microvolts(zero + fall + shifts[1]);
            car.voltage = Some(acc);
            let factors = car.run_ms(500).1.unwrap();
            // a is a whole number of microvolts, and k may stretch its half.
            prop_assert!((factors.apply(acc).get() - car.zero.get()).abs() <= 1);
        }

        #[test]
        fn acc_reads_0_a_whatever_the_outputs_are(off in 2_451_000..2_551_000i32, shift in -50_000..=50_000i32) {
            let mut car = Car::new(config());
            car.voltage = Some(Microvolts(off));
            car.run_ms(500);
            car.inputs.acc_line = true;
            car.voltage = Some(Microvolts(off + shift));
            let factors = car.run_ms(500).1.unwrap();
            prop_assert_eq!(factors.apply(Microvolts(off + shift)), SENSOR_ZERO);
        }

        /// No permit with the key off; without a permit before, only after factors, failure or a resumed drive; and
        /// never later than the longest delay when a failure permits.
        #[test]
        fn the_permit_keeps_its_rules(
            hold: bool,
            steps in proptest::collection::vec(
                (0..200_000u64, any::<bool>(), any::<bool>(), 2_400_000..2_600_000i32, 0..5u8), 1..200),
        ) {
            let mut car = Car::new(config());
            if hold {
                car.config.on_failure = OnFailure::Hold;
            }
            let mut left_off: Option<Instant> = None;
            for (us, line, feedback, voltage, can) in steps {
                car.inputs.now = Instant::from_ticks(car.inputs.now.as_ticks() + us);
                car.inputs.acc_line = line;
                car.inputs.hv_feedback = feedback;
                car.inputs.can_key =
                    [None, Some(KeyState::Off), Some(KeyState::Acc), Some(KeyState::On), Some(KeyState::Start)][usize::from(can)];
                car.inputs.sample = Some(KeySample {
                    voltage: Some(Microvolts(voltage)), zero: SENSOR_ZERO, range: Range::Small, at: car.inputs.now,
                    noisy: false,
                });
                let outputs = car.step();
                if outputs.key == KeyState::Off {
                    left_off = None;
                    prop_assert!(!outputs.hv_permit);
                } else {
                    let since = *left_off.get_or_insert(car.inputs.now);
                    let late = elapsed(since, car.inputs.now) >= milliseconds(1_000);
                    match outputs.phase {
                        KeyPhase::Taken | KeyPhase::Resumed => prop_assert!(outputs.hv_permit),
                        KeyPhase::Failed(_) => prop_assert_eq!(outputs.hv_permit, !hold),
                        KeyPhase::Taking => prop_assert!(!outputs.hv_permit && !late),
                        KeyPhase::Off | KeyPhase::Disabled => prop_assert!(false, "key is not OFF"),
                    }
                }
                if outputs.new_factors.is_some() {
                    prop_assert!(outputs.hv_permit && !feedback);
                }
            }
        }

        #[test]
        fn no_input_panics(
            wild in (any::<bool>(), any::<i32>(), 0..4u16, any::<u32>(), any::<u32>()),
            limits in proptest::array::uniform4(any::<i32>()), times in proptest::array::uniform2(any::<u32>()),
            steps in proptest::collection::vec(
                (any::<u64>(), any::<[bool; 4]>(), any::<Option<i32>>(), any::<Option<(Option<i32>, u64)>>()), 1..60),
        ) {
            let config = KeyCalibrationConfig {
                enabled: wild.0,
                samples: wild.2,
                settle_ms: wild.3 % 3,
                max_delay_ms: wild.4,
                max_spread: Microvolts(limits[0]),
                max_current: Microamps(limits[1]),
                max_k_deviation_ppm: limits[2],
                max_a: Microvolts(limits[3]),
                on_failure: OnFailure::Hold,
                key_off_debounce_ms: times[0] % 2,
                feedback_grace_ms: times[1],
            };
            let mut calibration = KeyCalibration::new(KeyFactors::NONE, Instant::from_ticks(0));
            for (now, flags, current, sample) in steps {
                let outputs = calibration.step(&config, &KeyInputs {
                    now: Instant::from_ticks(now),
                    acc_line: flags[0],
                    hv_feedback: flags[1],
                    can_key: flags[2].then_some(KeyState::Acc),
                    can_high_voltage: None,
                    meter_current: current.map(Microamps),
                    meter_charge: current
                        .map(|charge| (Instant::from_ticks(now / 2), Nanocoulombs(i64::from(charge) << 31))),
                    sample: sample.map(|(voltage, at)| KeySample {
                        voltage: voltage.map(Microvolts),
                        zero: Microvolts(wild.1.wrapping_add(wild.3.cast_signed())),
                        range: if flags[3] { Range::Small } else { Range::Large },
                        at: Instant::from_ticks(at),
                        noisy: flags[0],
                    }),
                });
                if outputs.key == KeyState::Off {
                    prop_assert!(!outputs.hv_permit);
                }
            }
        }
    }
}
