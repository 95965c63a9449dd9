//! The firmware's three owners on the host, in its order and at its times, over an [`IdealBoard`]: what the RTIC tasks
//! do, without tasks.

// Each user of this file needs another part of it.
#![allow(dead_code)]

use std::collections::VecDeque;

use core_logic::can::{self, Frame};
use core_logic::configuration::Configuration;
use core_logic::converter::ConverterSample;
use core_logic::diagnosis::CodeSet;
use core_logic::gap::GapBridge;
use core_logic::measurement::{Environment, Measurement, Tick, Vehicle};
use core_logic::meter::{MeterChannel, MeterConfig, MeterReading, ReadingOutcome, Rejection};
use core_logic::open_sensor::network_output;
use core_logic::range::EdgeRecorder;
use core_logic::units::{Duration, Instant, Microvolts, MilliCelsius, Millivolts, Nanocoulombs};
use core_logic::validity::Validity;

use crate::ideal_board::{Event, IdealBoard, Row, Timing};

/// The board with its measuring logic.
pub struct HostBoard<'a> {
    pub world: IdealBoard<'a>,
    pub configuration: Configuration,
    pub edges: EdgeRecorder,
    pub meter: MeterChannel,
    pub measurement: Measurement,
    pub vehicle: Vehicle,
    /// What the sensors' supply reads as; what they run from is [`IdealBoard::supply_v`].
    pub supply: Option<Microvolts>,
    /// What the open-sensor channel shows instead of the small sensor's output.
    pub network: Option<Microvolts>,
    pub external: CodeSet,
    /// The converter delivers this code whatever its input.
    pub stuck_code: Option<i16>,
    /// AENERGY stands still.
    pub frozen: bool,
    /// So many ticks after the converter the meter counts by other factors; at most as long as the logic waits for it.
    pub meter_lag: usize,
    configs: VecDeque<MeterConfig>,
    /// The meter does not answer in this time, in µs.
    pub dead: core::ops::Range<u64>,
    /// As of the newest tick: what the meter's owner has when it needs it.
    bridge: GapBridge,
    energy: i32,
    /// The true charge at the first and at the newest reading of the meter, in C: between them it has counted.
    pub first_reading_c: Option<f64>,
    pub last_reading_c: f64,
    sender: can::Sender,
    pub now_us: u64,
}

/// What a step was.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Step {
    Event(Event),
    Tick(Tick),
}

impl<'a> HostBoard<'a> {
    pub fn new(rows: &'a [Row], timing: Timing, configuration: Configuration) -> Self {
        let world = IdealBoard::new(rows, timing);
        let start = Instant::from_ticks(0);
        let measurement = Measurement::new(&configuration, None, Nanocoulombs::ZERO, start);
        Self {
            edges: EdgeRecorder::new(start, world.flag_high()),
            meter: MeterChannel::new(measurement.meter_config(&configuration)),
            measurement,
            configuration,
            world,
            vehicle: Vehicle {
                acc_line: true,
                hv_feedback: true,
                can_key: None,
                can_high_voltage: None,
                state_fresh: true,
                voltage_fresh: true,
            },
            supply: Some(Microvolts::from_millivolts(5_000)),
            network: None,
            external: CodeSet::EMPTY,
            stuck_code: None,
            frozen: false,
            meter_lag: 0,
            configs: VecDeque::new(),
            dead: 0..0,
            bridge: GapBridge::UNKNOWN,
            energy: 0,
            first_reading_c: None,
            last_reading_c: 0.0,
            sender: can::Sender::default(),
            now_us: 0,
        }
    }

    /// The next event of the hardware or the next tick; `None` at the profile's end.
    pub fn step(&mut self) -> Option<Step> {
        let event = self.world.next_event()?;
        match event {
            Event::Tick { at_us } => {
                self.now_us = at_us;
                return Some(Step::Tick(self.tick(at_us)));
            }
            Event::Edge { at_us, flag_high } => {
                self.now_us = at_us;
                self.edges.on_edge(Instant::from_ticks(at_us), flag_high);
            }
            Event::Energy { at_us, counts } => {
                self.now_us = at_us;
                if self.dead.contains(&at_us) {
                    // One that never counted is not lost: it has not begun.
                    if self.meter.report().at.is_some() {
                        self.meter.on_meter_lost();
                    }
                    self.measurement.on_meter(
                        &self.configuration,
                        &self.meter.report(),
                        Validity::CHIP_FAULT,
                    );
                    return Some(Step::Event(event));
                }
                self.last_reading_c = self.world.charge_c;
                self.first_reading_c.get_or_insert(self.world.charge_c);
                let at = Instant::from_ticks(at_us);
                if !self.frozen {
                    self.energy = counts;
                }
                let reading = MeterReading {
                    energy: self.energy,
                    at,
                };
                let history = self.edges.history(at);
                if let ReadingOutcome::Rejected(Rejection::Lost | Rejection::TooLate) =
                    self.meter.on_reading(reading, history)
                {
                    self.meter
                        .on_meter_restarted(reading, history, &self.bridge);
                }
                self.measurement.on_meter(
                    &self.configuration,
                    &self.meter.report(),
                    Validity::VALID,
                );
            }
            Event::Conversion {
                started_us,
                at_us,
                code,
            } => {
                self.now_us = at_us;
                let at = Instant::from_ticks(at_us);
                self.measurement.on_conversion(
                    &self.configuration,
                    &ConverterSample {
                        started: Instant::from_ticks(started_us),
                        finished: at,
                        configuration: self.configuration.converter.expected_configuration(),
                        code: self.stuck_code.unwrap_or(code),
                    },
                    &self.edges.history(at),
                );
            }
        }
        Some(Step::Event(event))
    }

    fn tick(&mut self, at_us: u64) -> Tick {
        let now = Instant::from_ticks(at_us);
        let history = self.edges.history(now);
        let small_volts = (2.5 + 2.25 * (self.world.current_a() / 60.0).clamp(-1.0, 1.0))
            * self.world.supply_v
            / 5.0;
        let network = self
            .network
            .unwrap_or_else(|| network_output(Microvolts((small_volts * 1e6) as i32)));
        self.measurement.on_environment(
            &self.configuration,
            Environment {
                supply: self.supply,
                network: Some(network),
                sensor_temperature: Some(MilliCelsius(25_000)),
                board_temperature: Some(MilliCelsius(30_000)),
                controller_supply: Some(Millivolts(3_300)),
            },
            &history,
            now,
        );
        if at_us.is_multiple_of(100_000) && self.vehicle.voltage_fresh {
            self.measurement.on_battery_voltage(
                &can::BatteryVoltage {
                    cell: Some(Microvolts((self.world.row().cell_v * 1e6) as i32)),
                    pack: None,
                    cell_temperature: None,
                },
                now,
            );
        }
        let tick = self.measurement.tick(
            &self.configuration,
            now,
            &self.vehicle,
            &history,
            self.external,
        );
        while let Some(found) = self.measurement.take_found() {
            found.store(&mut self.configuration);
            self.measurement.configuration_changed(&self.configuration);
        }
        self.configs
            .push_back(self.measurement.meter_config(&self.configuration));
        while self.configs.len() > self.meter_lag {
            if let Some(config) = self.configs.pop_front() {
                self.meter.set_config(config);
            }
        }
        self.bridge = self.measurement.bridge();
        tick
    }

    /// The frames of this tick, as the firmware sends them.
    pub fn frames(&mut self, tick_us: u64, mut send: impl FnMut(Frame)) {
        send(self.sender.current(&self.measurement.current()));
        send(
            self.sender
                .current_average(&self.measurement.current_average(&self.configuration)),
        );
        if tick_us.is_multiple_of(100_000) {
            send(self.sender.charge(&self.measurement.charge()));
            send(self.sender.meter_current(&self.measurement.meter_current()));
            send(
                self.sender
                    .state_of_charge(&self.measurement.state_of_charge()),
            );
            send(self.measurement.environment().encode());
            send(self.measurement.board_state(0, 0).encode());
        }
        if tick_us.is_multiple_of(1_000_000) {
            send(self.measurement.throughput().encode());
            send(can::diagnosis_active(self.measurement.diagnosis().active()));
        }
    }

    /// Runs to the profile's end.
    pub fn run(&mut self) {
        while self.step().is_some() {}
    }

    /// Runs until `condition`, at most to the profile's end; whether it came true.
    pub fn run_until(&mut self, mut condition: impl FnMut(&Self) -> bool) -> bool {
        while self.step().is_some() {
            if condition(self) {
                return true;
            }
        }
        false
    }

    /// The meter's charge less what flowed between its first and its newest reading, in C.
    pub fn charge_error_c(&self) -> f64 {
        let flowed = self.last_reading_c - self.first_reading_c.unwrap_or(self.last_reading_c);
        self.meter.report().charge_total.get() as f64 * 1e-9 - flowed
    }

    /// Time with the large sensor selected.
    pub fn in_large(&self) -> Duration {
        self.edges.history(Instant::from_ticks(self.now_us)).large
    }

    /// Time since the start.
    pub fn elapsed(&self) -> Duration {
        Duration::from_ticks(self.now_us)
    }
}
