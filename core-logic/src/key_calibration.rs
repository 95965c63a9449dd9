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
mod tests;
