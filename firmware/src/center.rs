//! What runs at priority 2: the measurement, its frames on CAN, and the copies of what its neighbours need.

use core_logic::{
    can::{self, DiagnosisDetail, Identity, Received, Receiver, Sender},
    configuration::Configuration,
    converter::ConverterSample,
    diagnosis::{Code, CodeSet},
    gap::GapBridge,
    measurement::{ConverterFault, Environment, Measurement, Vehicle},
    meter::{MeterCalibration, MeterReport},
    modbus::Readings,
    range::RangeHistory,
    retained::{RetainSlots, RetainedState},
    units::{Duration, Instant, MilliCelsius, Millivolts, clamp_i32, div_round, elapsed},
    validity::Validity,
};

use crate::{analog, can_bus::Bus, converter, inputs::Levels, meter, retain};

/// A meter that has delivered nothing for so long is stale: five polls.
const METER_STALE: Duration = Duration::from_ticks(100_000);
/// Repeated reads of the meter in one second from which on its bus counts as disturbed.
const CHECKSUM_LIMIT: u32 = 10;
/// Ticks of 10 ms in a second.
const SECOND: u32 = 100;

/// What the meter's task and the measurement tell each other.
#[derive(Clone, Copy)]
pub struct MeterLink {
    /// To the measurement: what was counted.
    pub report: MeterReport,
    /// To the measurement: state of chip and line.
    pub health: meter::Health,
    /// To the measurement: a self-test shorts the input.
    pub in_self_test: bool,
    /// To the measurement: temperature of the meter's own sensor.
    pub temperature: Option<MilliCelsius>,
    /// To the measurement: times one of the two lines was masked as a storm.
    pub storms: u32,
    /// To the measurement: longest time from an edge to its snapshot.
    pub latency_us: u32,
    /// To the meter: what bridges a gap.
    pub bridge: GapBridge,
    /// To the meter: another calibration or the same one again, until it has taken it.
    pub calibration: Option<MeterCalibration>,
}

/// What other owners report for the diagnosis.
#[derive(Clone, Copy, Default)]
pub struct Conditions {
    /// What has happened; each code latches, so one tick is enough.
    pub happened: CodeSet,
    /// Set by the RS485 task while its errors grow.
    pub rs485_errors: bool,
    /// Set by the storage task.
    pub flash_fault: bool,
    /// The same, as long as the chip does not answer.
    pub flash_missing: bool,
    /// What the last check of the configuration in RAM and of the factors made from it has found.
    pub configuration_corrupt: bool,
    /// Set by the storage task.
    pub log_full: bool,
    /// Set by the supervision.
    pub little_stack: bool,
}

/// Owner of the measurement and of the bus.
pub struct Center {
    /// The active configuration: a copy of the store's.
    pub configuration: Configuration,
    /// The composition.
    pub measurement: Measurement,
    /// CAN.
    pub bus: Bus,
    /// Reports of others.
    pub conditions: Conditions,
    /// Diagnoses have come or gone: a log record is due.
    pub log_due: bool,
    /// Who the board is.
    pub identity: Identity,
    /// Of the conversion's task.
    pub converter: converter::Counters,
    sender: Sender,
    receiver: Receiver,
    slots: RetainSlots,
    ticks: u32,
    page: u8,
    stated: u32,
    seconds: u32,
    shown: Option<Code>,
    meter_report_at: Option<Instant>,
    seen: Seen,
    last_codes: [u8; 8],
}

/// Counters at the last look, so that a condition holds while they grow.
#[derive(Clone, Copy, Default)]
struct Seen {
    checksum: u32,
    checksum_bad: bool,
    resets: u32,
    rejected: u32,
    storms: u32,
    refused_frames: u32,
    overruns: u32,
    damaged: u32,
}

/// Whether a counter has grown since the last look.
fn grown(seen: &mut u32, now: u32) -> bool {
    core::mem::replace(seen, now) != now
}

impl Center {
    /// Starts with what is known before the flash has been read.
    pub fn new(configuration: Configuration, bus: Bus, identity: Identity, now: Instant) -> Self {
        Self {
            measurement: Measurement::new(
                &configuration,
                None,
                core_logic::units::Nanocoulombs::ZERO,
                now,
            ),
            configuration,
            bus,
            conditions: Conditions::default(),
            log_due: false,
            identity,
            converter: converter::Counters::default(),
            sender: Sender::default(),
            receiver: Receiver::default(),
            slots: RetainSlots::empty(),
            ticks: 0,
            page: 0,
            stated: 0,
            seconds: 0,
            shown: None,
            meter_report_at: None,
            seen: Seen::default(),
            last_codes: [255; 8],
        }
    }

    /// Goes on from a retained state, or from nothing, with the stored configuration.
    pub fn resume(
        &mut self,
        configuration: Configuration,
        state: Option<&RetainedState>,
        slots: RetainSlots,
        loss: core_logic::units::Nanocoulombs,
        now: Instant,
    ) -> Option<MeterCalibration> {
        self.measurement = Measurement::new(&configuration, state, loss, now);
        self.configuration = configuration;
        self.slots = slots;
        self.measurement.due_meter_calibration(&self.configuration)
    }

    /// Another configuration is active.
    pub fn set_configuration(&mut self, configuration: &Configuration) {
        self.configuration = *configuration;
        self.measurement.configuration_changed(&self.configuration);
    }

    /// A finished conversion.
    pub fn on_conversion(&mut self, sample: &ConverterSample, history: &RangeHistory) {
        self.measurement
            .on_conversion(&self.configuration, sample, history);
    }

    /// A conversion that came to nothing.
    pub fn on_converter_fault(&mut self, fault: ConverterFault, now: Instant) {
        self.measurement.on_converter_fault(fault, now);
    }

    /// The receive interrupt.
    pub fn on_received(&mut self, now: Instant) {
        while let Some(frame) = self.bus.receive() {
            if let Ok(Received::BatteryVoltage(voltage)) = self.receiver.on_frame(now, &frame) {
                self.measurement.on_battery_voltage(&voltage, now);
            }
        }
    }

    /// Every 10 ms. Whether high voltage is permitted.
    #[inline(never)]
    pub fn tick(
        &mut self,
        now: Instant,
        history: &RangeHistory,
        levels: Levels,
        readings: &analog::Readings,
        link: &mut MeterLink,
    ) -> bool {
        self.bus.step(now);
        self.on_environment(now, history, readings, link);
        self.on_meter(now, link);
        let state = self.receiver.vehicle_state(now);
        let vehicle = Vehicle {
            acc_line: levels.key_acc,
            hv_feedback: levels.hv_feedback,
            can_key: state.and_then(|state| state.key),
            can_high_voltage: state.and_then(|state| state.high_voltage),
            state_fresh: state.is_some(),
            voltage_fresh: self.receiver.battery_voltage(now).is_some(),
        };
        let external = self.external(now, link);
        let tick = self
            .measurement
            .tick(&self.configuration, now, &vehicle, history, external);
        for code in tick.changes.set.iter() {
            // Not `rotate_right`: it alone would need `memmove`, 1.6 kB.
            let mut newer = code.number();
            for place in &mut self.last_codes {
                core::mem::swap(place, &mut newer);
            }
            self.log_due = true;
        }
        self.log_due |= !tick.changes.cleared.is_empty();
        self.send(now);
        link.calibration = self.measurement.due_meter_calibration(&self.configuration);
        if self.ticks.is_multiple_of(10) {
            let (slot, bytes) = self.slots.write(&self.measurement.retained(0));
            retain::set_slot(slot, &bytes);
        }
        link.bridge = self.measurement.bridge();
        self.ticks = self.ticks.wrapping_add(1);
        tick.hv_permit
    }

    fn on_environment(
        &mut self,
        now: Instant,
        history: &RangeHistory,
        readings: &analog::Readings,
        link: &MeterLink,
    ) {
        let environment = Environment {
            supply: readings.supply,
            network: readings.network,
            sensor_temperature: link.temperature.filter(|_| link.health.counting),
            board_temperature: readings.temperature,
            controller_supply: readings
                .vdda
                .map(|vdda| Millivolts(clamp_i32(div_round(i64::from(vdda.get()), 1_000)))),
        };
        self.measurement
            .on_environment(&self.configuration, environment, history, now);
    }

    fn on_meter(&mut self, now: Instant, link: &MeterLink) {
        let report = &link.report;
        let causes = Validity::VALID
            .and_if(link.in_self_test, Validity::CALIBRATING)
            .and_if(!link.health.counting, Validity::CHIP_FAULT)
            .and_if(is_stale(report, now), Validity::STALE);
        if report.at != self.meter_report_at || !causes.is_valid() {
            self.meter_report_at = report.at;
            self.measurement
                .on_meter(&self.configuration, report, causes);
        }
    }

    /// The conditions that only the owners of the hardware know.
    fn external(&mut self, now: Instant, link: &MeterLink) -> CodeSet {
        let health = &link.health;
        let seen = &mut self.seen;
        if self.ticks.is_multiple_of(SECOND) {
            let repeated = health.repeated.saturating_sub(seen.checksum);
            seen.checksum_bad = repeated > CHECKSUM_LIMIT;
            seen.checksum = health.repeated;
        }
        let bus = self.bus.counters();
        let rows = [
            // During the self-test the chip answers; it just counts nothing that anybody may use.
            (
                Code::MeterNoAnswer,
                (!health.counting || is_stale(&link.report, now)) && !link.in_self_test,
            ),
            (Code::MeterDeadBus, health.dead_bus),
            (Code::MeterChecksum, seen.checksum_bad),
            (Code::MeterReset, grown(&mut seen.resets, health.resets)),
            (
                Code::MeterDeltaRejected,
                grown(&mut seen.rejected, link.report.rejected),
            ),
            (Code::EdgeStorm, grown(&mut seen.storms, link.storms)),
            (Code::CanBusOff, self.bus.is_off()),
            (
                Code::CanRxE2e,
                grown(&mut seen.refused_frames, self.receiver.refused()),
            ),
            (Code::CanRxOverrun, grown(&mut seen.overruns, bus.overruns)),
            (
                Code::Rs485Errors,
                core::mem::take(&mut self.conditions.rs485_errors),
            ),
            (
                Code::FlashFault,
                core::mem::take(&mut self.conditions.flash_fault) | self.conditions.flash_missing,
            ),
            (
                Code::ConfigurationCorruptRam,
                self.conditions.configuration_corrupt
                    | grown(&mut seen.damaged, link.report.damaged),
            ),
            (
                Code::LogFull,
                core::mem::take(&mut self.conditions.log_full),
            ),
            (Code::StackHighWater, self.conditions.little_stack),
        ];
        let mut set = core::mem::replace(&mut self.conditions.happened, CodeSet::EMPTY);
        for (code, present) in rows {
            if present {
                set.set(code, true);
            }
        }
        set
    }

    /// The frames of this tick; those of 100 ms are spread so that no tick has more than four. When each comes first
    /// is in can/board.dbc.
    fn send(&mut self, now: Instant) {
        let current = self.sender.current(&self.measurement.current());
        self.bus.send(current, now);
        let average = self.measurement.current_average(&self.configuration);
        let average = self.sender.current_average(&average);
        self.bus.send(average, now);
        let diagnosis = self.measurement.diagnosis();
        let frame = match self.ticks % 10 {
            0 => Some(self.sender.charge(&self.measurement.charge())),
            1 => Some(self.sender.meter_current(&self.measurement.meter_current())),
            2 => Some(
                self.sender
                    .state_of_charge(&self.measurement.state_of_charge()),
            ),
            3 => Some(self.measurement.environment().encode()),
            4 => {
                let refused = self.receiver.refused();
                Some(
                    self.measurement
                        .board_state(self.bus.policy().bus_offs(), refused)
                        .encode(),
                )
            }
            5 => Some(can::diagnosis_active(diagnosis.active())),
            6 => Some(can::diagnosis_latched(diagnosis.latched())),
            7 => {
                let reported = diagnosis.reported();
                self.shown = reported.next_after(self.shown);
                let code = self.shown.map(|code| (code, diagnosis.detail(code)));
                Some(
                    DiagnosisDetail {
                        code,
                        reported: reported.len(),
                    }
                    .encode(),
                )
            }
            _ => None,
        };
        if let Some(frame) = frame {
            self.bus.send(frame, now);
        }
        if self.ticks % 20 == 8 {
            self.identity.uptime = elapsed(Instant::from_ticks(0), now);
            let frame = self.identity.encode(self.page);
            self.page = self.page.wrapping_add(1) % Identity::PAGES;
            self.bus.send(frame, now);
        }
        if self.ticks % SECOND == 9 {
            let frame = self.measurement.throughput().encode();
            self.bus.send(frame, now);
        }
    }

    /// Whether a second has passed since the last time this was true.
    pub fn second_passed(&mut self) -> bool {
        let due = self.ticks.wrapping_sub(self.stated) >= SECOND;
        if due {
            self.stated = self.ticks;
            self.seconds = self.seconds.wrapping_add(1);
        }
        due
    }

    /// How often [`Center::second_passed`] was true.
    pub const fn seconds(&self) -> u32 {
        self.seconds
    }

    /// Fills in what is known here.
    pub fn fill(&self, readings: &mut Readings) {
        self.measurement.fill(&self.configuration, readings);
        readings.last_codes = self.last_codes;
        let converter = self.converter;
        readings.converter_counters = [
            converter.bus_errors,
            converter.recoveries,
            converter.resets,
            converter.timeouts,
            self.measurement.invalid_conversions(),
        ];
        let bus = self.bus.counters();
        readings.can_counters = [
            bus.sent,
            bus.received,
            bus.overruns,
            self.receiver.refused(),
            u32::from(self.bus.policy().bus_offs()),
            self.bus.error_counters(),
        ];
    }
}

/// Whether nothing was read of the meter for [`METER_STALE`].
fn is_stale(report: &MeterReport, now: Instant) -> bool {
    report.at.is_none_or(|at| elapsed(at, now) > METER_STALE)
}
