//! A board in a few lines for the servers' and the clients' tests: the frames and the Modbus server of `core_logic`
//! without a machine under them, and faults that a client has to find.

#![allow(dead_code)]

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;

use core_logic::can::layout::MESSAGES;
use core_logic::can::{self, Frame};
use core_logic::configuration::ConfigurationStore;
use core_logic::diagnosis::CodeSet;
use core_logic::e2e::{self, DataId};
use core_logic::key_calibration::{KeyPhase, KeyState};
use core_logic::modbus::{Activity, Command, CommandState, Event, Readings};
use core_logic::modbus_rtu::{LineErrors, Server};
use core_logic::range::Range;
use core_logic::units::{
    Duration, Instant, Microamps, MilliCelsius, Millivolts, Nanocoulombs, Ppm,
};
use core_logic::validity::Validity;
use emulator::can_frame::CanFrame;
use emulator::serve::{Board, Options, Session, Summary};

/// What is wrong with the board.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Fault {
    /// Nothing.
    #[default]
    None,
    /// Every hundredth `Current` is left out.
    LosesFrames,
    /// Every hundredth `Current` has a flipped bit.
    FlipsBits,
    /// A frame that the DBC does not know.
    UnknownFrame,
    /// No `Throughput`.
    NoThroughput,
    /// The 10 ms frames come every 15 ms.
    Slow,
    /// None: battery management and vehicle are on the bus.
    OthersSend,
    /// Nothing that is sent to it on CAN arrives.
    Deaf,
    /// The converter stands still.
    NoConversions,
    /// High voltage counts as on: another state than the client is told.
    HighVoltage,
    /// A setting beyond its limit is taken for the limit instead of refused.
    TakesTooMuch,
    /// Zero drift is read with its words the other way round.
    WordOrder,
}

/// The board.
pub struct FakeBoard {
    fault: Fault,
    now_us: u64,
    sender: can::Sender,
    receiver: can::Receiver,
    page: u8,
    others: e2e::Sequence,
    wanted: VecDeque<CanFrame>,
    seen: Vec<(f64, CanFrame)>,
    free_us: u64,
    server: Server,
    store: ConfigurationStore,
    readings: Readings,
    saved: Option<u32>,
    calibration_ends_us: Option<u64>,
    flash_ends_us: Option<u64>,
    arriving: VecDeque<(u64, u8)>,
    leaving: VecDeque<(u64, u8)>,
}

/// µs of a character at 115,200 baud 8E1.
const CHARACTER_US: u64 = 96;

impl FakeBoard {
    /// Just powered on.
    pub fn new(fault: Fault) -> Self {
        Self {
            fault,
            now_us: 0,
            sender: can::Sender::default(),
            receiver: can::Receiver::default(),
            page: 0,
            others: e2e::Sequence::default(),
            wanted: VecDeque::new(),
            seen: Vec::new(),
            free_us: 0,
            server: Server::new(Instant::from_ticks(0)),
            store: ConfigurationStore::default(),
            readings: Readings::default(),
            saved: Some(0),
            calibration_ends_us: None,
            flash_ends_us: None,
            arriving: VecDeque::new(),
            leaving: VecDeque::new(),
        }
    }

    fn now(&self) -> Instant {
        Instant::from_ticks(self.now_us)
    }

    fn on_bus(&mut self, frame: CanFrame) {
        self.free_us = self.free_us.max(self.now_us) + 250;
        self.seen.push((self.free_us as f64 / 1e6, frame));
    }

    fn tick(&mut self) {
        let now_ms = self.now_us / 1_000;
        let tick_ms = if self.fault == Fault::Slow { 15 } else { 10 };
        if !now_ms.is_multiple_of(tick_ms) {
            return;
        }
        for message in &MESSAGES {
            if message.header.is_due(now_ms, tick_ms)
                && let Some(frame) = self.frame(message.name)
            {
                let spoilt = message.name == "Current" && now_ms % 1_000 == 500;
                if spoilt && self.fault == Fault::LosesFrames {
                    continue;
                }
                let mut frame = CanFrame::standard(frame.id, &frame.data);
                if spoilt && self.fault == Fault::FlipsBits {
                    frame.data[4] ^= 0x10;
                }
                self.on_bus(frame);
            }
        }
        if self.fault == Fault::OthersSend && now_ms.is_multiple_of(100) {
            let counter = self.others.advance();
            for (id, mut payload) in [
                (0x201, [0, 0, 0x10, 0x8E, 0, 0, 65, 0]),
                (0x202, [0, 0, 0, 0, 0, 0, 0, 0]),
            ] {
                e2e::protect(DataId::new(id), counter, &mut payload);
                self.wanted.push_back(CanFrame::standard(id, &payload));
            }
        }
        if self.fault == Fault::UnknownFrame && now_ms % 1_000 == 500 {
            self.on_bus(CanFrame::standard(0x7EF, &[1, 2, 3]));
        }
    }

    fn frame(&mut self, name: &str) -> Option<Frame> {
        let current = Microamps(12_345_678);
        let conversions = match self.fault {
            Fault::NoConversions => 7,
            _ => (self.now_us / 31_250) as u32,
        };
        Some(match name {
            "Current" => self.sender.current(&can::Current {
                current,
                validity: Validity::VALID,
                range: Range::Small,
                conversions,
                age: Some(Duration::from_ticks(self.now_us % 31_250)),
            }),
            "CurrentAverage" => self.sender.current_average(&can::CurrentAverage {
                average: current,
                validity: Validity::VALID,
                samples: 8,
                span: Duration::from_ticks(250_000),
            }),
            "Charge" => self.sender.charge(&can::Charge {
                charge: Nanocoulombs::from_coulombs(1),
                validity: Validity::VALID,
                estimated: false,
            }),
            "MeterCurrent" => self.sender.meter_current(&can::MeterCurrent {
                current,
                validity: Validity::VALID,
                below_no_load: false,
                charge_uncertainty: None,
            }),
            "StateOfCharge" => self.sender.state_of_charge(&can::StateOfCharge {
                state_of_charge: Ppm(500_000),
                validity: Validity::VALID,
                uncertainty: None,
                remaining: None,
            }),
            "Throughput" if self.fault == Fault::NoThroughput => return None,
            "Throughput" => can::Throughput {
                discharged: Nanocoulombs::from_coulombs(5),
                charged: Nanocoulombs::from_coulombs(0),
            }
            .encode(),
            "Environment" => can::Environment {
                supply: Millivolts(5_000),
                supply_validity: Validity::VALID,
                sensor_temperature: MilliCelsius(25_000),
                sensor_temperature_validity: Validity::VALID,
                board_temperature: MilliCelsius(30_000),
                board_temperature_validity: Validity::VALID,
            }
            .encode(),
            "BoardState" => self.board_state(),
            "DiagnosisActive" => can::diagnosis_active(CodeSet::default()),
            "DiagnosisLatched" => can::diagnosis_latched(CodeSet::default()),
            "DiagnosisDetail" => can::DiagnosisDetail {
                code: None,
                reported: 0,
            }
            .encode(),
            "Identity" => {
                self.page = (self.page + 1) % can::Identity::PAGES;
                identity().encode(self.page)
            }
            _ => return None,
        })
    }

    fn board_state(&self) -> Frame {
        can::BoardState {
            key: Some(KeyState::Off),
            high_voltage: Some(false),
            permit: false,
            key_calibration: Some(KeyPhase::Off),
            range: Range::Small,
            cell_voltage_fresh: self.receiver.battery_voltage(self.now()).is_some(),
            vehicle_state_fresh: self.receiver.vehicle_state(self.now()).is_some(),
            edges: 0,
            coalesced: 0,
            estimated_intervals: 0,
            bus_offs: 0,
            refused: self.receiver.refused(),
        }
        .encode()
    }

    fn receive_can(&mut self) {
        while let Some(frame) = self.wanted.pop_front() {
            self.on_bus(frame);
            if self.fault != Fault::Deaf && !frame.extended && !frame.remote {
                let received = Frame {
                    id: frame.id as u16,
                    dlc: frame.length,
                    data: frame.data,
                };
                // What is refused is counted by the receiver.
                let _ = self.receiver.on_frame(self.now(), &received);
            }
        }
    }

    fn serve_modbus(&mut self) {
        while let Some((at_us, byte)) = self.arriving.front().copied()
            && at_us <= self.now_us
        {
            self.arriving.pop_front();
            self.server
                .on_character(byte, LineErrors::NONE, Instant::from_ticks(at_us));
        }
        let now = self.now();
        self.proceed();
        self.fill();
        let served = self.server.serve(now, &self.readings, &mut self.store);
        let Some(served) = served else { return };
        let earliest = served.reply.map(|(_, earliest)| earliest);
        if let Some(Event::Command(command)) = served.event
            && !self.order(command)
            && earliest.is_some()
        {
            self.server.refuse();
        }
        if let Some(earliest) = earliest {
            let mut reply = self.server.reply().to_vec();
            if self.fault == Fault::WordOrder && reply[..3] == [1, 3, 8] {
                swap_words(&mut reply);
            }
            let begin_us = earliest.as_ticks().max(self.now_us);
            self.leaving.extend(
                (1..)
                    .zip(reply)
                    .map(|(number, byte)| (begin_us + number * CHARACTER_US, byte)),
            );
        }
    }

    /// Carries an order out; whether it is not refused at once.
    fn order(&mut self, command: Command) -> bool {
        self.readings.last_command = command.register();
        let running = self.calibration_ends_us.is_some();
        self.readings.command_state = match command {
            Command::ZeroNow => {
                self.calibration_ends_us = Some(self.now_us + 2_000_000);
                CommandState::Running
            }
            Command::Abort => {
                self.calibration_ends_us = None;
                if running {
                    CommandState::Failed
                } else {
                    CommandState::Done
                }
            }
            Command::Save => {
                self.flash_ends_us = Some(self.now_us + 50_000);
                CommandState::Running
            }
            Command::SupplyPointAtZero => CommandState::Failed,
            _ => CommandState::Done,
        };
        let is_refused = command == Command::SupplyPointAtZero;
        self.readings.command_reason = u16::from(is_refused);
        !is_refused
    }

    fn proceed(&mut self) {
        if self
            .calibration_ends_us
            .is_some_and(|end| end <= self.now_us)
        {
            self.calibration_ends_us = None;
            self.readings.command_state = CommandState::Done;
        }
        if self.flash_ends_us.is_some_and(|end| end <= self.now_us) {
            self.flash_ends_us = None;
            self.saved = Some(self.store.generation());
            self.readings.command_state = CommandState::Done;
        }
    }

    fn fill(&mut self) {
        let counters = self.server.counters();
        let battery = self.receiver.battery_voltage(self.now());
        let readings = &mut self.readings;
        readings.uptime_s = (self.now_us / 1_000_000) as u32;
        readings.activity = match self.calibration_ends_us {
            Some(_) => Activity::ZeroDrift,
            None => Activity::None,
        };
        readings.configuration_generation = self.store.generation();
        readings.configuration_crc = self.store.crc();
        readings.configuration_saved = self.saved == Some(self.store.generation());
        readings.storage_busy = self.flash_ends_us.is_some();
        readings.high_voltage_on = self.fault == Fault::HighVoltage;
        readings.rs485_counters = [
            counters.messages,
            counters.communication_errors,
            counters.exceptions,
            counters.server_messages,
            counters.no_responses,
            counters.character_overruns,
            counters.busy,
            counters.missed,
            counters.character_gaps,
        ];
        readings.cell_validity = Validity::STALE;
        if let Some((_, voltages)) = battery
            && let Some(cell) = voltages.cell
        {
            readings.cell_voltage = Millivolts(cell.0 / 1_000);
            readings.cell_validity = Validity::VALID;
        }
    }
}

/// The values of an answer the other way round, with a new CRC.
fn swap_words(reply: &mut [u8]) {
    for at in [3, 7] {
        let (high, low) = reply[at..at + 4].split_at_mut(2);
        high.swap_with_slice(low);
    }
    let body = reply.len() - 2;
    let mut crc = 0xFFFF_u16;
    for byte in &reply[..body] {
        crc ^= u16::from(*byte);
        for _ in 0..8 {
            crc = if crc & 1 == 1 {
                crc >> 1 ^ 0xA001
            } else {
                crc >> 1
            };
        }
    }
    reply[body..].copy_from_slice(&crc.to_le_bytes());
}

fn identity() -> can::Identity {
    can::Identity {
        version: [0, 1, 0],
        reset_cause: can::ResetCause::PowerOn,
        boots: 1,
        commit: 0,
        modified: false,
        configuration_crc: 0,
        panic_hash: 0,
        panic_line: 0,
        late_tasks: 0,
        unique_id: [1, 2, 3],
        uptime: Duration::from_ticks(0),
        stack_free: 10_000,
        log_fill: None,
    }
}

impl Board for FakeBoard {
    fn run_for(&mut self, us: u64) -> anyhow::Result<()> {
        let end_us = self.now_us + us;
        while self.now_us < end_us {
            if self.now_us.is_multiple_of(1_000) {
                self.tick();
                self.receive_can();
            }
            self.now_us += 250;
            self.serve_modbus();
        }
        Ok(())
    }

    fn now_s(&self) -> f64 {
        self.now_us as f64 / 1e6
    }

    fn inject_can(&mut self, frame: CanFrame) {
        self.wanted.push_back(frame);
    }

    fn take_can(&mut self) -> Vec<(f64, CanFrame)> {
        std::mem::take(&mut self.seen)
    }

    fn inject_rs485(&mut self, bytes: &[u8]) {
        let begin_us = self
            .arriving
            .back()
            .map_or(self.now_us, |(at_us, _)| *at_us);
        let mut bytes = bytes.to_vec();
        if self.fault == Fault::TakesTooMuch {
            take_too_much(&mut bytes);
        }
        self.arriving.extend(
            (1..)
                .zip(bytes)
                .map(|(number, byte)| (begin_us + number * CHARACTER_US, byte)),
        );
    }

    fn take_rs485(&mut self) -> Vec<u8> {
        let due = self
            .leaving
            .iter()
            .take_while(|(at_us, _)| *at_us <= self.now_us)
            .count();
        self.leaving.drain(..due).map(|(_, byte)| byte).collect()
    }
}

/// A turnaround of 50,001 µs becomes one of 50,000.
fn take_too_much(request: &mut [u8]) {
    if let [1, 0x10, 0x09, 0x01, 0, 1, 2, high, low, crc @ ..] = request
        && [*high, *low] == 50_001_u16.to_be_bytes()
    {
        [*high, *low] = 50_000_u16.to_be_bytes();
        // By an independent CRC-16 of the frame 01 10 09 01 00 01 02 C3 50.
        let mut value = 0xFFFF_u16;
        for byte in [1, 0x10, 0x09, 0x01, 0, 1, 2, 0xC3, 0x50] {
            value ^= byte;
            for _ in 0..8 {
                value = if value & 1 == 1 {
                    value >> 1 ^ 0xA001
                } else {
                    value >> 1
                };
            }
        }
        crc.copy_from_slice(&value.to_le_bytes());
    }
}

/// A session with a board, running in a thread of its own until it is dropped.
pub struct Running {
    /// Port of the CAN bus.
    pub can_port: u16,
    /// Port of the RS485 line.
    pub rs485_port: u16,
    /// Pseudo-terminal of the RS485 line.
    pub terminal: Option<String>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<anyhow::Result<Summary>>>,
}

impl Running {
    /// Starts it at any free ports, with the board that `make` makes: it need not be able to change its thread.
    pub fn start<B: Board>(make: impl FnOnce() -> B + Send + 'static, speed: f64) -> Self {
        Self::start_with(speed, move |session, stop| {
            session.run(&mut make(), stop, &mut |notice| eprintln!("{notice}"))
        })
    }

    /// The same for a board that borrows from its surroundings.
    pub fn start_with(
        speed: f64,
        run: impl FnOnce(&mut Session, &AtomicBool) -> anyhow::Result<Summary> + Send + 'static,
    ) -> Self {
        let mut session = Session::open(&options(speed, None)).expect("opening the session");
        let stop = Arc::new(AtomicBool::new(false));
        let can_port = session.can_address().port();
        let rs485_port = session.rs485_address().port();
        let terminal = session.terminal().map(str::to_owned);
        let stop_it = Arc::clone(&stop);
        Self {
            can_port,
            rs485_port,
            terminal,
            stop,
            thread: Some(std::thread::spawn(move || run(&mut session, &stop_it))),
        }
    }

    /// Ends it.
    pub fn stop(mut self) -> Summary {
        self.stop.store(true, Ordering::Relaxed);
        let thread = self.thread.take().expect("it is running");
        thread
            .join()
            .expect("the session's thread")
            .expect("the session")
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
    }
}

/// Options at any free ports.
pub fn options(speed: f64, for_s: Option<f64>) -> Options {
    Options {
        can: ([127, 0, 0, 1], 0).into(),
        rs485: ([127, 0, 0, 1], 0).into(),
        no_terminal: false,
        speed,
        for_s,
    }
}

/// A file of the project.
pub fn project(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
}
