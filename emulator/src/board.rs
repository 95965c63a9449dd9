//! The board around the MCU: which pin goes where, and the physical world behind it.

use std::collections::VecDeque;

use plant::ade7753::Ade7753;
use plant::ads1100::Ads1100;
use plant::bus::{SpiByte, SpiDevice};
use plant::front_end::{Conditions, FrontEnd, FrontEndConfig};
use plant::stretch::{Linear, Stretch};
use plant::supply::SupplyProfile;
use plant::w25q32::W25q32;

use crate::can_frame::CanFrame;
use crate::i2c_bus::I2cBus;
use crate::outside::{DrivenLevels, I2cAnswer, I2cEvent, Outputs, Outside, Pin, SpiBus};
use crate::rs485_line::{LineConfig, Rs485Line};
use crate::scenario::{Key, Row, Scenario};
use crate::time::Ticks;
use crate::vehicle::Vehicle;

/// The pins of the board: docs/firmware.md has the table.
pub mod pins {
    use crate::outside::Pin;

    /// Range flag.
    pub const RANGE_FLAG: Pin = Pin::new('A', 0);
    /// The same line at the gate of TIM4.
    pub const RANGE_GATE: Pin = Pin::new('B', 6);
    /// RS485 driver enable.
    pub const RS485_DRIVER: Pin = Pin::new('A', 1);
    /// Chip select of the ADE7753.
    pub const METER_SELECT: Pin = Pin::new('A', 4);
    /// MISO of the ADE7753.
    pub const METER_MISO: Pin = Pin::new('A', 6);
    /// I²C clock.
    pub const I2C_CLOCK: Pin = Pin::new('B', 8);
    /// I²C data.
    pub const I2C_DATA: Pin = Pin::new('B', 9);
    /// Chip select of the W25Q32.
    pub const FLASH_SELECT: Pin = Pin::new('B', 12);
    /// Interrupt of the ADE7753, active low.
    pub const METER_IRQ: Pin = Pin::new('C', 4);
    /// Key line, high from ACC on.
    pub const KEY: Pin = Pin::new('C', 6);
    /// High-voltage feedback, high = closed.
    pub const HIGH_VOLTAGE: Pin = Pin::new('C', 7);
    /// High-voltage permit.
    pub const PERMIT: Pin = Pin::new('C', 8);

    /// Driven from 5 V.
    pub const FROM_5_V: [Pin; 3] = [RANGE_FLAG, RANGE_GATE, METER_MISO];
}

/// ADC1 channel of the sensors' supply, behind a divider by two.
const SUPPLY_CHANNEL: u8 = 10;
/// ADC1 channel of the open-sensor network.
const NETWORK_CHANNEL: u8 = 11;
/// The supply divider on the board.
const SUPPLY_DIVIDER: f64 = 2.0;
/// Command byte of the ADE7753 that reads AENERGY.
const READ_AENERGY: u8 = 0x02;

/// What the board is made of.
pub struct BoardConfig {
    /// Sensors, filters, comparators, switch.
    pub front_end: FrontEndConfig,
    /// Constant voltage on channel 2 of the meter, in V (D1: 0.1 V).
    pub meter_v2_v: f64,
    /// The longest step of the analogue simulation.
    pub step: Ticks,
}

impl Default for BoardConfig {
    fn default() -> Self {
        Self {
            front_end: FrontEndConfig::default(),
            meter_v2_v: 0.1,
            step: Ticks::from_micros(20),
        }
    }
}

/// One range edge and the charge snapshot that answered it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Snapshot {
    /// The flag changed.
    pub edge: Ticks,
    /// The meter latched AENERGY (end of the command byte).
    pub latched: Ticks,
    /// The value was in the MCU (chip select high again).
    pub read: Ticks,
}

/// What really happened, in the same time as everything else.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Truth {
    /// ∫ i dt since the power came on, in C; positive = discharge.
    pub charge_c: f64,
    /// Edges of the range flag since then.
    pub edges: u64,
    /// Time with the large sensor selected, in s.
    pub large_s: f64,
}

/// A line that ignores what should drive it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LineFault {
    /// None.
    #[default]
    None,
    /// Always low.
    StuckLow,
    /// Always high.
    StuckHigh,
    /// Changes every so often, whatever drives it.
    Toggling {
        /// Half a period.
        every: Ticks,
    },
}

/// The board.
pub struct Board {
    /// The drive and the vehicle's state.
    pub scenario: Scenario,
    /// Battery management and vehicle control on CAN.
    pub vehicle: Vehicle,
    /// Sensors, filters, comparators, switch.
    pub front_end: FrontEnd,
    /// ADE7753.
    pub meter: Ade7753,
    /// ADS1100.
    pub converter: Ads1100,
    /// W25Q32.
    pub flash: W25q32,
    /// I²C1 between MCU and converter.
    pub i2c_bus: I2cBus,
    /// RS485.
    pub line: Rs485Line,
    /// The meter's IRQ line towards the MCU.
    pub irq_fault: LineFault,
    /// The range flag's line towards the MCU (the switch follows the comparators all the same).
    pub flag_fault: LineFault,
    /// The 5 V of sensors and converter over time, in place of the scenario's.
    pub supply: Option<SupplyProfile>,
    meter_v2_v: f64,
    step: Ticks,
    row: Row,
    /// The analogue world is known up to here.
    horizon: Ticks,
    stretches: VecDeque<Stretch>,
    /// The chips have seen everything up to here, in s.
    seen_s: f64,
    flag_changes: VecDeque<(Ticks, bool)>,
    flag: bool,
    outputs: Outputs,
    levels: DrivenLevels,
    /// When they were last worked out.
    driven_at: Ticks,
    /// The meter's IRQ line as the MCU last saw it, and how often it found it changed.
    irq_seen: Option<bool>,
    irq_edges: u64,
    truth: Truth,
    trace: Option<Trace>,
    meter_transaction: MeterTransaction,
    unanswered: VecDeque<Ticks>,
    snapshots: Vec<Snapshot>,
}

#[derive(Clone, Copy, Debug, Default)]
struct MeterTransaction {
    selected_at: Ticks,
    bytes: u32,
    latched: Option<Ticks>,
}

/// The truth, sampled.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TruthSample {
    /// Time, in s.
    pub t_s: f64,
    /// True current through the conductor, in A.
    pub current_a: f64,
    /// Charge since the start, in C.
    pub charge_c: f64,
    /// Range flag as the comparators have it.
    pub range_high: bool,
    /// The surroundings.
    pub row: Row,
}

struct Trace {
    period: Ticks,
    next: Ticks,
    samples: Vec<TruthSample>,
}

fn conditions(row: &Row, closed: bool) -> Conditions {
    Conditions {
        current_a: if closed { row.current_a } else { 0.0 },
        sensor_temperature_c: row.sensor_temperature_c,
        sensor_supply_v: row.sensor_supply_v,
        converter_supply_v: row.converter_supply_v,
        aux_current_a: row.aux_current_a,
        output_shift_v: row.output_shift_v,
    }
}

impl Board {
    /// A board before its power comes on at time 0; chips and flash as given.
    pub fn new(
        config: BoardConfig,
        mut scenario: Scenario,
        meter: Ade7753,
        converter: Ads1100,
        flash: W25q32,
    ) -> Self {
        let row = scenario.at(0.0, false);
        let closed = scenario.permit(false, row.key, 0.0);
        let front_end = FrontEnd::new(config.front_end, 0.0, conditions(&row, closed));
        let flag = front_end.range_high();
        let mut board = Self {
            scenario,
            vehicle: Vehicle::default(),
            front_end,
            meter,
            converter,
            flash,
            i2c_bus: I2cBus::new(),
            line: Rs485Line::new(LineConfig::default()),
            irq_fault: LineFault::None,
            flag_fault: LineFault::None,
            supply: None,
            meter_v2_v: config.meter_v2_v,
            step: config.step,
            row,
            horizon: Ticks(0),
            stretches: VecDeque::new(),
            seen_s: 0.0,
            flag_changes: VecDeque::new(),
            flag,
            outputs: Outputs::default(),
            levels: DrivenLevels::default(),
            driven_at: Ticks(0),
            irq_seen: None,
            irq_edges: 0,
            truth: Truth::default(),
            trace: None,
            meter_transaction: MeterTransaction::default(),
            unanswered: VecDeque::new(),
            snapshots: Vec::new(),
        };
        board.drive_levels(Ticks(0));
        board
    }

    /// When the world next changes something that the MCU can see, or has to be simulated further.
    pub fn next_event(&self) -> Ticks {
        let mut next = self.horizon;
        if let Some((at, _)) = self.flag_changes.front() {
            next = next.min(*at);
        }
        if let Some(at) = self.line.next_event() {
            next = next.min(at);
        }
        for fault in [self.irq_fault, self.flag_fault] {
            if let LineFault::Toggling { every } = fault {
                // The first edge after what the lines show already.
                let every = every.0.max(1);
                next = next.min(Ticks((self.driven_at.0 / every + 1) * every));
            }
        }
        next.min(self.vehicle.next_event())
    }

    /// Lets the world go on to `now`.
    pub fn advance(&mut self, now: Ticks) {
        while self.horizon <= now {
            self.simulate();
        }
        while let Some((at, high)) = self
            .flag_changes
            .front()
            .copied()
            .filter(|(at, _)| *at <= now)
        {
            self.flag_changes.pop_front();
            self.flag = high;
            self.unanswered.push_back(at);
        }
        self.drive_levels(now);
    }

    /// One step of the analogue world.
    fn simulate(&mut self) {
        let start_s = self.horizon.seconds();
        self.see(start_s);
        let mut end = self.horizon + self.step;
        if let Some(row_s) = self.scenario.next_row_after(start_s) {
            let row_at = Ticks::from_seconds(row_s);
            if row_at > self.horizon && row_at < end {
                end = row_at;
            }
        }
        let end_s = end.seconds();
        self.row = self.scenario.at(end_s, false);
        if let Some(supply) = &self.supply {
            let volts = supply.at(end_s);
            self.row.sensor_supply_v = volts;
            self.row.converter_supply_v = volts;
        }
        let permitted = self.outputs.driven(pins::PERMIT) == Some(true);
        let closed = self.scenario.permit(permitted, self.row.key, start_s);
        let conditions = conditions(&self.row, closed);
        let Self {
            front_end,
            stretches,
            flag_changes,
            truth,
            ..
        } = self;
        let mut high = flag_changes.back().map_or(self.flag, |(_, high)| *high);
        front_end.advance(end_s, &conditions, |stretch| {
            let length_s = stretch.end_s - stretch.start_s;
            truth.charge_c += stretch.current_a.mean() * length_s;
            if stretch.range_high {
                truth.large_s += length_s;
            }
            if stretch.range_high != high {
                high = stretch.range_high;
                truth.edges += 1;
                flag_changes.push_back((Ticks::from_seconds(stretch.start_s), high));
            }
            stretches.push_back(*stretch);
        });
        // An edge at the very end belongs to the next stretch, which begins there.
        self.horizon = end;
        if let Some(trace) = &mut self.trace {
            while trace.next < end {
                trace.samples.push(TruthSample {
                    t_s: end_s,
                    current_a: conditions.current_a,
                    charge_c: truth.charge_c,
                    range_high: high,
                    row: self.row,
                });
                trace.next += trace.period;
            }
        }
    }

    /// Shows the chips everything up to `until_s`.
    fn see(&mut self, until_s: f64) {
        while let Some(stretch) = self.stretches.front().copied() {
            if stretch.start_s >= until_s {
                return;
            }
            let length_s = stretch.end_s - stretch.start_s;
            let whole = stretch.end_s <= until_s;
            let end_s = if whole { stretch.end_s } else { until_s };
            if end_s > self.seen_s {
                let fraction = |at_s: f64| {
                    if length_s > 0.0 {
                        (at_s - stretch.start_s) / length_s
                    } else {
                        1.0
                    }
                };
                let (from, to) = (fraction(self.seen_s.max(stretch.start_s)), fraction(end_s));
                self.meter
                    .advance(end_s, stretch.meter_v1_v.part(from, to), self.meter_v2_v);
                self.converter.advance(
                    end_s,
                    stretch.converter_v.part(from, to),
                    stretch.converter_supply_v.part(from, to),
                );
                self.seen_s = end_s;
            }
            if !whole {
                return;
            }
            self.stretches.pop_front();
        }
    }

    /// A quantity of the analogue world at `at`.
    fn now_v(&self, at: Ticks, quantity: impl Fn(&Stretch) -> Linear) -> f64 {
        let at_s = at.seconds();
        let stretch = self
            .stretches
            .iter()
            .find(|stretch| at_s <= stretch.end_s)
            .or(self.stretches.back());
        stretch.map_or(0.0, |stretch| {
            let length_s = stretch.end_s - stretch.start_s;
            let fraction = if length_s > 0.0 {
                (at_s - stretch.start_s) / length_s
            } else {
                1.0
            };
            quantity(stretch).at(fraction.clamp(0.0, 1.0))
        })
    }

    fn drive_levels(&mut self, now: Ticks) {
        // A byte's end, worked out in seconds, may be a tick off: a line must not toggle back for it.
        self.driven_at = self.driven_at.max(now);
        let flag = faulty(self.flag_fault, self.flag, self.driven_at);
        self.levels.set(pins::RANGE_FLAG, Some(flag));
        self.levels.set(pins::RANGE_GATE, Some(flag));
        // Open drain: high is nobody's doing but the pull-up's.
        let irq_high = faulty(self.irq_fault, !self.meter.irq_low(), self.driven_at);
        self.levels
            .set(pins::METER_IRQ, (!irq_high).then_some(false));
        // Pull-ups on the bus: a line that nobody pulls is high.
        let (clock, data) = self.i2c_bus.levels(now);
        self.levels.set(pins::I2C_CLOCK, Some(clock));
        self.levels.set(pins::I2C_DATA, Some(data));
        self.levels.set(pins::KEY, Some(self.row.key != Key::Off));
        self.levels
            .set(pins::HIGH_VOLTAGE, Some(self.scenario.closed()));
    }

    /// The frames that the vehicle's other nodes send now.
    pub fn take_vehicle_frames(&mut self, now: Ticks) -> Vec<CanFrame> {
        if now < self.vehicle.next_event() {
            return Vec::new();
        }
        self.vehicle.frames(&self.row, self.scenario.closed(), now)
    }

    /// What really happened so far.
    pub const fn truth(&self) -> Truth {
        self.truth
    }

    /// Keeps a sample of the truth every `period` from now on.
    pub fn trace(&mut self, period: Ticks) {
        self.trace = Some(Trace {
            period,
            next: self.horizon,
            samples: Vec::new(),
        });
    }

    /// Takes the samples since the last call.
    pub fn take_trace(&mut self) -> Vec<TruthSample> {
        self.trace
            .as_mut()
            .map_or_else(Vec::new, |trace| std::mem::take(&mut trace.samples))
    }

    /// Takes the edges that were answered by a snapshot since the last call.
    pub fn take_snapshots(&mut self) -> Vec<Snapshot> {
        std::mem::take(&mut self.snapshots)
    }

    /// Edges that no snapshot has answered yet.
    pub fn unanswered_edges(&self) -> usize {
        self.unanswered.len()
    }

    /// Edges of the meter's IRQ line that have reached the MCU's pin, masked there or not.
    pub const fn irq_edges(&self) -> u64 {
        self.irq_edges
    }

    /// The surroundings now.
    pub const fn row(&self) -> &Row {
        &self.row
    }

    /// Whether the board permits high voltage.
    pub const fn permits(&self) -> bool {
        matches!(self.outputs.driven(pins::PERMIT), Some(true))
    }

    fn selected(&self, pin: Pin) -> bool {
        self.outputs.driven(pin) == Some(false)
    }
}

fn faulty(fault: LineFault, level: bool, now: Ticks) -> bool {
    match fault {
        LineFault::None => level,
        LineFault::StuckLow => false,
        LineFault::StuckHigh => true,
        LineFault::Toggling { every } => (now.0 / every.0.max(1)) % 2 == 1,
    }
}

impl Outside for Board {
    fn spi(&mut self, bus: SpiBus, byte: SpiByte) -> u8 {
        match bus {
            SpiBus::Meter => {
                if !self.selected(pins::METER_SELECT) {
                    return 0xFF;
                }
                self.see(byte.end_s);
                let end = Ticks::from_seconds(byte.end_s);
                if self.meter_transaction.bytes == 0 && byte.mosi == READ_AENERGY {
                    self.meter_transaction.latched = Some(end);
                }
                self.meter_transaction.bytes += 1;
                let answer = self.meter.exchange(byte);
                self.drive_levels(end);
                answer
            }
            SpiBus::Flash => {
                if self.selected(pins::FLASH_SELECT) {
                    self.flash.exchange(byte)
                } else {
                    0xFF
                }
            }
        }
    }

    fn i2c(&mut self, event: I2cEvent, at: Ticks) -> I2cAnswer {
        self.see(at.seconds());
        self.i2c_bus.event(event, at, &mut self.converter)
    }

    fn i2c_spurious_bus_error(&mut self) -> bool {
        self.i2c_bus.take_spurious_bus_error()
    }

    fn i2c_abandoned(&mut self, clocked: u8, at: Ticks) {
        self.see(at.seconds());
        self.i2c_bus.abandon(clocked, at, &mut self.converter);
    }

    fn i2c_lines(&mut self, at: Ticks) -> (bool, bool) {
        self.i2c_bus.lines(at)
    }

    fn adc_v(&mut self, channel: u8, at: Ticks) -> f64 {
        match channel {
            SUPPLY_CHANNEL => self.now_v(at, |stretch| stretch.sensor_supply_v) / SUPPLY_DIVIDER,
            NETWORK_CHANNEL => self.now_v(at, |stretch| stretch.network_v),
            // Nothing is connected there.
            _ => 0.0,
        }
    }

    fn outputs_changed(&mut self, outputs: &Outputs, at: Ticks) {
        let before = std::mem::replace(&mut self.outputs, *outputs);
        let at_s = at.seconds();
        let edge = |pin: Pin| {
            let (was, is) = (
                before.driven(pin) == Some(false),
                outputs.driven(pin) == Some(false),
            );
            (was != is).then_some(is)
        };
        match edge(pins::METER_SELECT) {
            Some(true) => {
                self.see(at_s);
                self.meter.select(at_s);
                self.meter_transaction = MeterTransaction {
                    selected_at: at,
                    ..MeterTransaction::default()
                };
            }
            Some(false) => {
                self.see(at_s);
                self.meter.deselect(at_s);
                if let Some(latched) = self.meter_transaction.latched.take() {
                    let selected_at = self.meter_transaction.selected_at;
                    while let Some(edge) = self
                        .unanswered
                        .front()
                        .copied()
                        .filter(|edge| *edge <= selected_at)
                    {
                        self.unanswered.pop_front();
                        self.snapshots.push(Snapshot {
                            edge,
                            latched,
                            read: at,
                        });
                    }
                }
                self.drive_levels(at);
            }
            None => {}
        }
        match edge(pins::FLASH_SELECT) {
            Some(true) => self.flash.select(at_s),
            Some(false) => self.flash.deselect(at_s),
            None => {}
        }
        self.line
            .driver(outputs.driven(pins::RS485_DRIVER) == Some(true), at);
        self.i2c_bus.pins(
            outputs.driven(pins::I2C_CLOCK),
            outputs.driven(pins::I2C_DATA),
            at,
        );
        self.drive_levels(at);
    }

    fn uart_sent(&mut self, byte: u8, at: Ticks) {
        self.line.board_sent(byte, at);
    }

    fn levels(&mut self, _at: Ticks) -> DrivenLevels {
        let irq = self.levels.driven(pins::METER_IRQ);
        self.irq_edges += u64::from(irq != self.irq_seen);
        self.irq_seen = irq;
        self.levels
    }
}

#[cfg(test)]
mod tests {
    use plant::ade7753::Ade7753Config;
    use plant::ads1100::Ads1100Config;
    use plant::w25q32::W25q32Config;

    use super::*;
    use crate::scenario::Contactors;

    /// Each edge of a storm is an event of its own, whatever else happens or does not.
    #[test]
    fn a_storm_has_all_its_edges() {
        for frequency_hz in [1e3, 25e3, 100e3, 1e6] {
            let mut board = Board::new(
                BoardConfig::default(),
                Scenario::steady(Row::at_rest(0.0), Contactors::AlwaysClosed),
                Ade7753::new(Ade7753Config::default(), 0.0),
                Ads1100::new(Ads1100Config::default(), 0.0),
                W25q32::with_content(W25q32Config::default(), 0.0, Vec::new()),
            );
            board.irq_fault = LineFault::Toggling {
                every: Ticks::from_seconds(0.5 / frequency_hz),
            };
            loop {
                let at = board.next_event();
                if at > Ticks::from_millis(100) {
                    break;
                }
                board.advance(at);
                board.take_vehicle_frames(at);
                board.levels(at);
                assert!(board.next_event() > at, "time stands still at {at:?}");
            }
            let expected = 0.1 * 2.0 * frequency_hz;
            let edges = board.irq_edges() as f64;
            assert!(
                (edges - expected).abs() <= 2.0,
                "{frequency_hz} Hz: {edges} of {expected}"
            );
        }
    }
}
