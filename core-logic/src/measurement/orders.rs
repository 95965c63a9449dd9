//! Orders of a client to the calibrations, and what they find.

use super::Measurement;
use crate::configuration::Configuration;
use crate::front_end::{FrontEnd, KeyFactors, SupplyRelations};
use crate::key_calibration::{KeyCalibration, KeyPhase, KeyRefusal, KeyState};
use crate::modbus::readings::CommandState;
use crate::range::Range;
use crate::supply_calibration::{Run, SupplyPoint};
use crate::units::Microamps;
use crate::validity::Validity;
use crate::zero_drift::ZeroRefusal;

/// A setting that a calibration has found; the owner of the configuration stores it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Found {
    /// Zero drift of a sensor (D2).
    ZeroDrift(Range, Microamps),
    /// Factors by key state (D4).
    KeyFactors(KeyFactors),
    /// Supply relations (D4).
    SupplyRelations(SupplyRelations),
}

impl Found {
    /// Writes it into `configuration`.
    pub fn store(self, configuration: &mut Configuration) {
        match self {
            Self::ZeroDrift(range, value) => configuration.zero_drift.value.set(range, value),
            Self::KeyFactors(factors) => configuration.key_factors = factors,
            Self::SupplyRelations(relations) => {
                if let FrontEnd::ClosedLoop(sensor) = &mut configuration.front_end {
                    sensor.relations = relations;
                    // They hold all of its zero.
                    configuration.forget_zero();
                }
            }
        }
    }
}

/// An order to the calibrations, its state already checked by `modbus`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Order {
    /// Take the present reading of the selected sensor as its zero.
    ZeroNow,
    /// Begin the key-state calibration anew.
    KeyCalibration,
    /// Add a point at 0 A to the supply sweep.
    SupplyPointAtZero,
    /// Add a point at the test current.
    SupplyPointAtCurrent,
    /// Work out the supply relations.
    FinishSupplyCalibration,
    /// End what is under way.
    Abort,
    /// Clear latched diagnoses whose cause has gone.
    ClearDiagnoses,
}

/// Why an order was not carried out; its number is the `command reason` on Modbus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[repr(u16)]
pub enum Refusal {
    /// A calibration is under way already.
    Busy = 1,
    /// High voltage is on or may come on.
    HighVoltage = 2,
    /// The meter sees a current.
    CurrentFlows = 3,
    /// The meter has no valid mean.
    MeterUnknown = 4,
    /// A reading is not valid.
    InvalidReading = 5,
    /// The readings spread too far.
    Unstable = 6,
    /// The result is beyond its limit.
    BeyondLimit = 7,
    /// Too few readings in time.
    Timeout = 8,
    /// Ended by command.
    Cancelled = 9,
    /// The front end in use has no such calibration.
    NotForThisFrontEnd = 10,
    /// The configuration switches it off.
    Disabled = 11,
    /// The sensor's supply is not known or outside its limits.
    SupplyUnknown = 12,
    /// The supply calibration refused the point or the result.
    SupplyCalibration = 13,
    /// The key is not OFF.
    KeyNotOff = 14,
    /// Key line and CAN contradict each other.
    KeyContradiction = 15,
}

impl From<KeyRefusal> for Refusal {
    fn from(refusal: KeyRefusal) -> Self {
        match refusal {
            KeyRefusal::NoSamples | KeyRefusal::NoOffValue => Self::Timeout,
            KeyRefusal::Unstable(_) => Self::Unstable,
            KeyRefusal::CurrentFlows(_) => Self::CurrentFlows,
            KeyRefusal::HighVoltageOn => Self::HighVoltage,
            KeyRefusal::InvalidSample | KeyRefusal::WrongRange => Self::InvalidReading,
            KeyRefusal::KeyContradiction => Self::KeyContradiction,
            KeyRefusal::KOutOfLimits(_) | KeyRefusal::AOutOfLimits(_) => Self::BeyondLimit,
            KeyRefusal::Cancelled => Self::Cancelled,
        }
    }
}

impl From<ZeroRefusal> for Refusal {
    fn from(refusal: ZeroRefusal) -> Self {
        match refusal {
            ZeroRefusal::Busy => Self::Busy,
            ZeroRefusal::HighVoltage => Self::HighVoltage,
            ZeroRefusal::CurrentFlows { .. } => Self::CurrentFlows,
            ZeroRefusal::MeterUnknown => Self::MeterUnknown,
            ZeroRefusal::InvalidReading => Self::InvalidReading,
            ZeroRefusal::Unstable { .. } => Self::Unstable,
            ZeroRefusal::BeyondLimit { .. } => Self::BeyondLimit,
            ZeroRefusal::Timeout => Self::Timeout,
            ZeroRefusal::Cancelled => Self::Cancelled,
        }
    }
}

impl Measurement {
    /// A setting to be stored, each one once: zero drift or supply relations before the key factors.
    pub fn take_found(&mut self) -> Option<Found> {
        let has_factors = self.found.is_none() && core::mem::take(&mut self.factors_found);
        if has_factors {
            return Some(Found::KeyFactors(self.key.factors()));
        }
        self.found.take()
    }

    /// Carries out an order of a client. What takes time ends in `command state` and `command reason`.
    ///
    /// # Errors
    /// Why it was not even begun.
    pub fn order(&mut self, configuration: &Configuration, order: Order) -> Result<(), Refusal> {
        let result = self.begin(configuration, order);
        // The state is that of the newest order.
        self.key_ordered = order == Order::KeyCalibration && result.is_ok();
        match result {
            Ok(CommandState::Failed) => self.fail(Refusal::Cancelled),
            Ok(state) => self.order_outcome = (state, 0),
            Err(refusal) => self.fail(refusal),
        }
        result.map(|_| ())
    }

    /// What an order has found is not in the configuration: it was refused there.
    pub fn found_was_refused(&mut self) {
        if self.order_outcome.0 == CommandState::Done {
            self.fail(Refusal::BeyondLimit);
        }
    }

    /// Notes the outcome of a command that others carry out (save, restore, clear log).
    pub fn note_command(&mut self, state: CommandState, reason: u16) {
        self.key_ordered = false;
        self.order_outcome = (state, reason);
    }

    /// An ordered key-state calibration ends with the key cycle that it waits for.
    pub(super) fn follow_key_order(&mut self) {
        match self.key_outputs.phase {
            KeyPhase::Off | KeyPhase::Taking => return,
            KeyPhase::Taken => self.order_outcome = (CommandState::Done, 0),
            KeyPhase::Failed(refusal) => self.fail(refusal.into()),
            KeyPhase::Resumed => self.fail(Refusal::HighVoltage),
            KeyPhase::Disabled => self.fail(Refusal::Disabled),
        }
        self.key_ordered = false;
    }

    fn begin(
        &mut self,
        configuration: &Configuration,
        order: Order,
    ) -> Result<CommandState, Refusal> {
        match order {
            Order::ZeroNow => {
                // What is found and not yet in force would be taken off once more, or undone.
                if self.sweep.is_some() || self.found.is_some() {
                    return Err(Refusal::Busy);
                }
                let conditions = self.zero_conditions();
                self.zero.start(
                    &configuration.zero_drift,
                    self.history.range,
                    &conditions,
                    self.now,
                )?;
                self.zero_beyond_limit = false;
                Ok(CommandState::Running)
            }
            Order::KeyCalibration => {
                if !configuration.key_calibration.enabled {
                    return Err(Refusal::Disabled);
                }
                if !self.is_at_rest() {
                    return Err(Refusal::HighVoltage);
                }
                // VC1 is taken with key OFF only: begun in ACC it could but fail.
                if self.key_outputs.key != KeyState::Off {
                    return Err(Refusal::KeyNotOff);
                }
                self.key = KeyCalibration::new(self.key.factors(), self.now);
                Ok(CommandState::Running)
            }
            Order::SupplyPointAtZero => self.supply_point(configuration, Run::Zero),
            Order::SupplyPointAtCurrent => self.supply_point(
                configuration,
                Run::Loaded(configuration.supply_test_current),
            ),
            Order::FinishSupplyCalibration => {
                let FrontEnd::ClosedLoop(sensor) = configuration.front_end else {
                    return Err(Refusal::NotForThisFrontEnd);
                };
                let sweep = self.sweep.ok_or(Refusal::SupplyCalibration)?;
                let calibrated = sweep
                    .finish(&configuration.supply_calibration, sensor.turns)
                    .map_err(|_| Refusal::SupplyCalibration)?;
                self.sweep = None;
                self.found = Some(Found::SupplyRelations(calibrated.relations));
                Ok(CommandState::Done)
            }
            Order::Abort => {
                let ended = self.zero.cancel().is_some()
                    | self.sweep.take().is_some()
                    | self.key.cancel()
                    | self.key_ordered;
                Ok(if ended {
                    CommandState::Failed
                } else {
                    CommandState::Done
                })
            }
            Order::ClearDiagnoses => {
                self.diagnosis.clear();
                // It may have been mended by hand, and no zero can be taken while high voltage is on.
                self.zero_beyond_limit = false;
                Ok(CommandState::Done)
            }
        }
    }

    fn supply_point(
        &mut self,
        configuration: &Configuration,
        run: Run,
    ) -> Result<CommandState, Refusal> {
        if !matches!(configuration.front_end, FrontEnd::ClosedLoop(_)) {
            return Err(Refusal::NotForThisFrontEnd);
        }
        if self.zero.is_running() {
            return Err(Refusal::Busy);
        }
        let supply = self.supply.ok_or(Refusal::SupplyUnknown)?;
        let usable = self
            .reading
            .validity
            .without(Validity::CALIBRATING)
            .is_valid();
        if !usable {
            return Err(Refusal::InvalidReading);
        }
        let mut sweep = self.sweep.unwrap_or_default();
        sweep
            .add(
                &configuration.supply_calibration,
                run,
                SupplyPoint {
                    supply,
                    output: self.reading.volts,
                },
            )
            .map_err(|_| Refusal::SupplyCalibration)?;
        self.sweep = Some(sweep);
        Ok(CommandState::Done)
    }

    pub(super) fn fail(&mut self, refusal: Refusal) {
        self.order_outcome = (CommandState::Failed, refusal as u16);
    }
}
