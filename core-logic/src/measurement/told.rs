//! What goes out: frames for CAN, registers for RS485, and what is retained and logged.

use super::Measurement;
use crate::can;
use crate::channel_compare::{CompareReport, Outcome};
use crate::configuration::Configuration;
use crate::diagnosis::{Code, Diagnosis};
use crate::gap::GapBridge;
use crate::key_calibration::KeyPhase;
use crate::modbus::readings::CommandState;
use crate::modbus::{Activity, Readings};
use crate::retained::{LogRecord, RetainedState};
use crate::units::{Duration, Millivolts, Nanocoulombs, clamp_i32, div_round, elapsed};
use crate::validity::Validity;

impl Measurement {
    /// The frame `Current`.
    #[must_use]
    pub fn current(&self) -> can::Current {
        can::Current {
            current: self.reading.current,
            validity: self.current_validity(self.reading.validity),
            range: self.reading.range,
            conversions: self.conversions,
            age: (self.conversions > 0).then(|| elapsed(self.reading.at, self.now)),
        }
    }

    /// The frame `CurrentAverage`.
    #[must_use]
    pub fn current_average(&self, configuration: &Configuration) -> can::CurrentAverage {
        let (average, validity, window) = self.averaged(configuration);
        can::CurrentAverage {
            average,
            validity,
            samples: window.map_or(0, |window| u16::from(window.count)),
            span: window.map_or(Duration::from_ticks(0), |window| window.covers),
        }
    }

    /// The frame `Charge`.
    #[must_use]
    pub fn charge(&self) -> can::Charge {
        can::Charge {
            charge: self.meter.charge_total,
            validity: self.charge_validity(),
            estimated: self.loss != Nanocoulombs::ZERO
                || self.miscounted != Nanocoulombs::ZERO
                || self.meter.estimated_intervals > 0
                || self.meter.gaps > 0,
        }
    }

    /// The frame `MeterCurrent`.
    #[must_use]
    pub fn meter_current(&self) -> can::MeterCurrent {
        can::MeterCurrent {
            current: self.meter.mean_current,
            validity: self
                .mean_validity()
                .and_if(self.meter.mean_over.is_zero(), Validity::STALE),
            below_no_load: self.meter.below_no_load,
            charge_uncertainty: Some(self.charge_uncertainty()),
        }
    }

    /// The frame `StateOfCharge`.
    #[must_use]
    pub fn state_of_charge(&self) -> can::StateOfCharge {
        let known = self.soc_reading.known;
        can::StateOfCharge {
            state_of_charge: self.soc_reading.presented,
            validity: self.soc_validity(),
            uncertainty: known.then(|| self.soc_reading.presented_uncertainty()),
            remaining: known.then_some(self.soc_reading.remaining),
        }
    }

    /// The frame `Throughput`.
    #[must_use]
    pub fn throughput(&self) -> can::Throughput {
        let (charged, discharged) = self.soc.throughput();
        can::Throughput {
            discharged,
            charged,
        }
    }

    /// The frame `Environment`.
    #[must_use]
    pub fn environment(&self) -> can::Environment {
        let missing = self.environment_is_missing();
        let supply = self.supply.unwrap_or_default();
        let validity =
            |is_there: bool| Validity::VALID.and_if(missing || !is_there, Validity::STALE);
        can::Environment {
            supply: Millivolts(clamp_i32(div_round(i64::from(supply.get()), 1_000))),
            supply_validity: self.supply_validity(),
            sensor_temperature: self.environment.sensor_temperature.unwrap_or_default(),
            sensor_temperature_validity: validity(self.environment.sensor_temperature.is_some()),
            board_temperature: self.environment.board_temperature.unwrap_or_default(),
            board_temperature_validity: validity(self.environment.board_temperature.is_some()),
        }
    }

    fn supply_validity(&self) -> Validity {
        Validity::VALID
            .and_if(
                self.environment_is_missing() || self.prepared.supply.is_none(),
                Validity::STALE,
            )
            .and_if(
                self.diagnosis.active().contains(Code::SupplyOutOfRange),
                Validity::SUPPLY,
            )
    }

    /// The frame `BoardState`. Counters of the CAN controller are its owner's.
    #[must_use]
    pub fn board_state(&self, bus_offs: u16, refused: u32) -> can::BoardState {
        can::BoardState {
            key: Some(self.key_outputs.key),
            high_voltage: Some(self.vehicle.hv_feedback),
            permit: self.key_outputs.hv_permit,
            key_calibration: Some(self.key_outputs.phase),
            range: self.history.range,
            cell_voltage_fresh: self.vehicle.voltage_fresh,
            vehicle_state_fresh: self.vehicle.state_fresh,
            edges: self.history.edges,
            coalesced: self.history.coalesced,
            estimated_intervals: self.meter.estimated_intervals,
            bus_offs,
            refused,
        }
    }

    /// All diagnoses.
    #[must_use]
    pub const fn diagnosis(&self) -> &Diagnosis {
        &self.diagnosis
    }

    /// What bridges a gap of the meter.
    #[must_use]
    pub fn bridge(&self) -> GapBridge {
        self.gap.bridge()
    }

    /// What must survive a reset.
    #[must_use]
    pub fn retained(&self, sequence: u32) -> RetainedState {
        RetainedState {
            sequence,
            charge_total: self.meter.charge_total,
            soc: self.soc.retained(),
            key_factors: self.key.factors(),
        }
    }

    /// One line of the flash log.
    #[must_use]
    pub fn log_record(&self, configuration: &Configuration, boot: u32) -> LogRecord {
        let (current, current_validity, _) = self.averaged(configuration);
        let environment = self.environment();
        LogRecord {
            boot,
            uptime_ms: self.now.as_ticks() / 1_000,
            current,
            charge: self.meter.charge_total,
            soc: self.soc_reading.presented,
            current_validity,
            charge_validity: self.charge_validity(),
            soc_validity: self.soc_validity(),
            diagnoses: self.diagnosis.reported().bits(),
            supply: environment.supply,
            temperature: self.environment.sensor_temperature,
        }
    }

    /// Fills in everything that is known here; what only the owners of the hardware know stays as it is.
    pub fn fill(&self, configuration: &Configuration, readings: &mut Readings) {
        let (average, average_validity, _) = self.averaged(configuration);
        let environment = self.environment();
        let compared = self.compare.report();
        let (taken, of) = self
            .zero
            .progress(&configuration.zero_drift)
            .map_or((0, 1), |progress| (progress.taken, progress.of));
        let points = self.sweep.map_or((0, 0), |sweep| sweep.points());
        readings.activity = if self.zero.is_running() {
            Activity::ZeroDrift
        } else if self.sweep.is_some() {
            Activity::SupplyCalibration
        } else if self.key_outputs.phase == KeyPhase::Taking {
            Activity::KeyCalibration
        } else {
            Activity::None
        };
        readings.activity_progress = percent(taken, of);
        // What was found is a setting only once it was taken.
        (readings.command_state, readings.command_reason) = match self.found {
            Some(_) => (CommandState::Running, 0),
            None => self.order_outcome,
        };
        readings.supply_points = [points.0, points.1];
        readings.key_calibration_state = u16::from(self.key_outputs.phase.number());
        readings.current = self.reading.current;
        readings.current_average = average;
        readings.meter_current = self.meter.mean_current;
        readings.current_validity = self.current_validity(self.reading.validity);
        readings.average_validity = average_validity;
        readings.meter_validity = self.mean_validity();
        readings.charge_validity = self.charge_validity();
        readings.conversions = self.conversions;
        readings.sensor_voltage = self.reading.volts;
        readings.range = self.history.range;
        readings.range_edges = self.history.edges;
        readings.coalesced_edges = u32::from(self.history.coalesced);
        readings.chatter = self.chatter.episodes;
        readings.charge = self.meter.charge_total;
        readings.charge_in = self.meter.charge_in;
        readings.charge_out = self.meter.charge_out;
        readings.charge_uncertainty = self.charge_uncertainty();
        readings.estimated_intervals = self.meter.estimated_intervals;
        if let Outcome::Agree { difference, bound } | Outcome::Disagree { difference, bound } =
            compared.slow
        {
            (readings.channel_difference, readings.channel_bound) = (difference, bound);
        }
        readings.soc = self.soc_reading.presented;
        readings.soc_uncertainty = self.soc_reading.presented_uncertainty();
        readings.soc_validity = self.soc_validity();
        readings.remaining_charge = self.soc_reading.remaining;
        readings.soc_anchors = self.soc_reading.anchors;
        let cell = self
            .cell_voltage
            .map(|cell| cell.voltage)
            .unwrap_or_default();
        readings.cell_voltage = Millivolts(clamp_i32(div_round(i64::from(cell.get()), 1_000)));
        readings.pack_voltage = self.pack_voltage.unwrap_or_default();
        readings.cell_validity =
            Validity::VALID.and_if(self.cell_voltage_is_missing(), Validity::STALE);
        readings.supply = self.supply.unwrap_or_default();
        readings.supply_validity = environment.supply_validity;
        readings.network_voltage = self.environment.network.unwrap_or_default();
        readings.mcu_supply = self.environment.controller_supply.unwrap_or_default();
        readings.sensor_temperature = environment.sensor_temperature;
        readings.temperature_validity = environment.sensor_temperature_validity;
        readings.board_temperature = environment.board_temperature;
        readings.key_state = self.key_outputs.key as u16;
        readings.high_voltage_on = !self.high_voltage_is_off();
        readings.high_voltage_permit = self.key_outputs.hv_permit;
        readings.diagnoses_active = self.diagnosis.active().bits();
        readings.diagnoses_latched = self.diagnosis.latched().bits();
    }

    /// The comparison of the two channels.
    #[must_use]
    pub const fn compare_report(&self) -> CompareReport {
        self.compare.report()
    }

    /// Conversions that were not valid, since the start.
    #[must_use]
    pub const fn invalid_conversions(&self) -> u32 {
        self.invalid_conversions
    }
}

fn percent(taken: u16, of: u16) -> u16 {
    let share = u32::from(taken) * 100 / u32::from(of.max(1));
    u16::try_from(share.min(100)).unwrap_or(100)
}
