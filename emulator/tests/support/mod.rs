//! What the tests on the running image share: a bench with the board, a vehicle that can be told what to do, a Modbus
//! client (`rmodbus`, which shares no code with the firmware) that knows the registers by their names in
//! docs/modbus.md, and what the board put on CAN, frame by frame.

#![allow(dead_code, missing_docs)]

use std::collections::BTreeMap;

use anyhow::{Context as _, Result, ensure};
use core_logic::error_budget::{ProfileSummary, charge_bound, no_load};
use core_logic::units::{Duration, Microamps};
use emulator::bus_view::BusView;
use emulator::rig::{Firmware, Rig, Setup, default_image};
use emulator::scenario::{Contactors, Row, Scenario};
use emulator::time::Ticks;
use rmodbus::client::ModbusRequest;
use rmodbus::{ErrorKind, ModbusProto, guess_response_frame_len};

/// The image under test.
pub fn firmware() -> Firmware {
    Firmware::load_default().unwrap_or_else(|error| {
        panic!(
            "no image at {}: {error:#}; `cargo xtask build` makes it",
            default_image().display()
        )
    })
}

/// A register as docs/modbus.md has it.
#[derive(Clone, Copy, Debug)]
struct Register {
    address: u16,
    /// Registers of one value.
    words: u16,
    signed: bool,
    /// Values in a row.
    count: u16,
}

/// The tables of docs/modbus.md, by name.
#[derive(Debug, Default)]
struct Map {
    commands: BTreeMap<String, u16>,
    holding: BTreeMap<String, Register>,
    input: BTreeMap<String, Register>,
}

impl Map {
    fn documented() -> Self {
        let text = include_str!("../../../docs/modbus.md");
        let mut map = Self::default();
        let mut heading = "";
        for line in text.lines() {
            if let Some(title) = line.strip_prefix("## ") {
                heading = title;
                continue;
            }
            let cells: Vec<&str> = line.trim_matches('|').split('|').map(str::trim).collect();
            let [address, kind, name, ..] = cells[..] else {
                continue;
            };
            let Some(address) = address
                .split(' ')
                .next()
                .and_then(|first| first.strip_prefix("0x"))
                .and_then(|digits| u16::from_str_radix(digits, 16).ok())
            else {
                continue;
            };
            let table = match heading {
                "Commands" => {
                    map.commands.insert(kind.to_owned(), address);
                    continue;
                }
                "Holding registers" => &mut map.holding,
                "Input registers" => &mut map.input,
                _ => continue,
            };
            let (kind, count) = kind.split_once(" × ").unwrap_or((kind, "1"));
            let (sign, bits) = kind.split_at(1);
            table.insert(
                name.to_owned(),
                Register {
                    address,
                    words: bits.parse::<u16>().unwrap() / 16,
                    signed: sign == "i",
                    count: count.parse().unwrap(),
                },
            );
        }
        assert!(
            map.commands.len() > 10 && map.holding.len() > 100 && map.input.len() > 50,
            "docs/modbus.md has other tables than this reads"
        );
        map
    }
}

/// The values that registers hold, most significant word first.
fn values(register: Register, words: &[u16]) -> Vec<i64> {
    words
        .chunks(usize::from(register.words))
        .map(|words| {
            let bits = words
                .iter()
                .fold(0_u64, |bits, word| bits << 16 | u64::from(*word));
            let unused = 64 - 16 * u32::from(register.words);
            if register.signed {
                ((bits << unused) as i64) >> unused
            } else {
                bits as i64
            }
        })
        .collect()
}

/// How a command ended: `command state` and `command reason` of docs/modbus.md.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ended {
    Done,
    Failed(i64),
}

/// One `Current` frame.
#[derive(Clone, Copy, Debug)]
pub struct CurrentFrame {
    /// End of the frame on the bus, in s.
    pub at_s: f64,
    /// Number of the conversion, 0 … 255.
    pub conversion: u8,
    pub current_a: Option<f64>,
    pub validity: u8,
    pub large: bool,
    /// From the end of the conversion to the making of the frame, in s, to the millisecond.
    pub age_s: f64,
}

/// The board on a bench.
pub struct Bench<'firmware> {
    pub rig: Rig<'firmware>,
    map: Map,
    decoder: BusView,
}

impl<'firmware> Bench<'firmware> {
    /// Power comes on. Boot, self-test and first conversions are over when this returns; what the start has reported is
    /// forgotten, and the scenario's time is the rig's.
    pub fn new(firmware: &'firmware Firmware, setup: Setup) -> Self {
        let mut bench = Self::powered(firmware, setup);
        bench.settle();
        bench
    }

    /// The moment at which power comes on.
    pub fn powered(firmware: &'firmware Firmware, setup: Setup) -> Self {
        Self {
            rig: Rig::new(firmware, setup).unwrap(),
            map: Map::documented(),
            decoder: BusView::default(),
        }
    }

    /// A nominal board with `row` for ever.
    pub fn nominal(firmware: &'firmware Firmware, row: Row, contactors: Contactors) -> Self {
        Self::new(firmware, Setup::nominal(Scenario::steady(row, contactors)))
    }

    /// Boot takes 0.2 s, the first average 0.3 s more.
    pub fn settle(&mut self) {
        self.run(0.8);
        self.rig.view.diagnoses.clear();
    }

    pub fn now_s(&self) -> f64 {
        self.rig.now_s()
    }

    #[track_caller]
    pub fn run(&mut self, seconds: f64) {
        let result = self.rig.run_s(seconds);
        if let Err(error) = result {
            panic!("{error:#}; the log's end: {:#?}", self.log_end());
        }
    }

    fn log_end(&self) -> &[String] {
        &self.rig.log[self.rig.log.len().saturating_sub(10)..]
    }

    /// Runs until the condition holds; how long it took, in s.
    #[track_caller]
    pub fn until(
        &mut self,
        what: &str,
        limit_s: f64,
        condition: impl FnMut(&mut Rig<'firmware>) -> bool,
    ) -> f64 {
        match self
            .rig
            .run_until(what, Ticks::from_seconds(limit_s), condition)
        {
            Ok(took) => took.seconds(),
            Err(error) => panic!(
                "{error:#}; current {:?}, active {:?}, the log's end: {:#?}",
                self.rig.view.current_a(),
                self.rig.view.active_diagnoses(),
                self.log_end()
            ),
        }
    }

    /// From now on it is `row`, for ever.
    pub fn vehicle(&mut self, row: Row) {
        let t_s = self.now_s();
        self.rig
            .machine
            .board(|board| board.scenario.replace(vec![Row { t_s, ..row }]));
    }

    /// The state of the vehicle now.
    pub fn row(&mut self) -> Row {
        self.rig.machine.board(|board| *board.row())
    }

    /// From now on these rows, whose times count from now; returns when the last one is reached.
    #[track_caller]
    pub fn drive(&mut self, rows: &[Row]) {
        let start_s = self.now_s();
        let shifted = rows
            .iter()
            .map(|row| Row {
                t_s: row.t_s + start_s,
                ..*row
            })
            .collect();
        self.rig
            .machine
            .board(|board| board.scenario.replace(shifted));
        self.run(rows.last().map_or(0.0, |row| row.t_s));
    }

    /// One request and its answer.
    fn ask(
        &mut self,
        generate: impl FnOnce(&mut ModbusRequest, &mut Vec<u8>) -> Result<(), ErrorKind>,
    ) -> Result<Vec<u16>, ErrorKind> {
        let mut request = ModbusRequest::new(1, ModbusProto::Rtu);
        let mut frame = Vec::new();
        generate(&mut request, &mut frame)?;
        let answer = self.exchange(&frame).unwrap();
        request.parse_ok(&answer)?;
        let mut words = Vec::new();
        if matches!(frame[1], 3 | 4) {
            request.parse_u16(&answer, &mut words)?;
        }
        Ok(words)
    }

    fn exchange(&mut self, frame: &[u8]) -> Result<Vec<u8>> {
        // Silence that ends a frame, whatever was on the line before.
        self.run(0.003);
        let _ = self.rig.take_rs485();
        self.rig.send_rs485(frame);
        let mut answer = Vec::new();
        for _ in 0..200 {
            self.rig.run_s(0.001)?;
            answer.extend(self.rig.take_rs485());
            if answer.len() >= 5 {
                let length = guess_response_frame_len(&answer, ModbusProto::Rtu)
                    .ok()
                    .context("an answer of no known length")?;
                if answer.len() >= usize::from(length) {
                    ensure!(
                        answer.len() == usize::from(length),
                        "more than an answer: {answer:02X?}"
                    );
                    return Ok(answer);
                }
            }
        }
        anyhow::bail!("no answer to {frame:02X?} within 0.2 s, but {answer:02X?}")
    }

    #[track_caller]
    fn register(&self, holding: bool, name: &str) -> Register {
        let table = if holding {
            &self.map.holding
        } else {
            &self.map.input
        };
        *table
            .get(name)
            .unwrap_or_else(|| panic!("docs/modbus.md has no register {name:?}"))
    }

    /// All values of a quantity.
    #[track_caller]
    pub fn inputs(&mut self, name: &str) -> Vec<i64> {
        let register = self.register(false, name);
        let length = register.words * register.count;
        let words = self
            .ask(|request, frame| request.generate_get_inputs(register.address, length, frame))
            .unwrap();
        values(register, &words)
    }

    /// A quantity.
    #[track_caller]
    pub fn input(&mut self, name: &str) -> i64 {
        self.inputs(name)[0]
    }

    /// All values of a setting.
    #[track_caller]
    pub fn settings(&mut self, name: &str) -> Vec<i64> {
        let register = self.register(true, name);
        let length = register.words * register.count;
        let words = self
            .ask(|request, frame| request.generate_get_holdings(register.address, length, frame))
            .unwrap();
        values(register, &words)
    }

    /// Writes the first values of a setting.
    #[track_caller]
    pub fn try_set(&mut self, name: &str, values: &[i64]) -> Result<(), ErrorKind> {
        let register = self.register(true, name);
        assert!(values.len() <= usize::from(register.count), "{name}");
        let words: Vec<u16> = values
            .iter()
            .flat_map(|value| {
                (0..register.words)
                    .rev()
                    .map(move |word| (value >> (16 * word)) as u16)
            })
            .collect();
        self.ask(|request, frame| {
            request.generate_set_holdings_bulk(register.address, &words, frame)
        })
        .map(|_| ())
    }

    /// Writes a setting that has to be taken, and reads it back.
    #[track_caller]
    pub fn set(&mut self, name: &str, values: &[i64]) {
        if let Err(error) = self.try_set(name, values) {
            panic!("{name} = {values:?} refused: {error:?}");
        }
        let back = self.settings(name);
        assert_eq!(back[..values.len()], *values, "{name} reads back");
    }

    /// Gives a command; whether the server takes it.
    #[track_caller]
    pub fn try_command(&mut self, name: &str) -> Result<(), ErrorKind> {
        let code = *self
            .map
            .commands
            .get(name)
            .unwrap_or_else(|| panic!("docs/modbus.md has no command {name:?}"));
        let register = self.register(true, "command");
        self.ask(|request, frame| request.generate_set_holding(register.address, code, frame))
            .map(|_| ())
    }

    /// Gives a command and waits for its end.
    #[track_caller]
    pub fn command(&mut self, name: &str, limit_s: f64) -> Ended {
        if let Err(error) = self.try_command(name) {
            panic!("command {name:?} refused: {error:?}");
        }
        let end_s = self.now_s() + limit_s;
        loop {
            match self.input("command state") {
                2 => return Ended::Done,
                3 => return Ended::Failed(self.input("command reason")),
                state => assert!(
                    self.now_s() < end_s,
                    "{name:?} has not ended within {limit_s} s: state {state}"
                ),
            }
            self.run(0.02);
        }
    }

    /// The flash's content, for the next board.
    pub fn flash(&mut self) -> Vec<u8> {
        self.rig
            .machine
            .board(|board| board.flash.content().to_vec())
    }

    /// Begins to keep the frames.
    pub fn record(&mut self) {
        self.rig.frames.clear();
        self.rig.keep_frames = true;
    }

    /// The first `Current` frame of every conversion recorded; a conversion that no frame has shown is missing.
    pub fn conversions(&mut self) -> Vec<CurrentFrame> {
        let mut all: Vec<CurrentFrame> = Vec::new();
        for logged in std::mem::take(&mut self.rig.frames) {
            if !logged.from_board || logged.frame.id != 0x101 {
                continue;
            }
            self.decoder.take(logged.at, &logged.frame);
            let signal = |name| self.decoder.signal("Current", name);
            let frame = CurrentFrame {
                at_s: logged.at.seconds(),
                conversion: signal("CurrentConversions").unwrap() as u8,
                current_a: signal("Current"),
                validity: signal("CurrentValidity").unwrap() as u8,
                large: signal("CurrentRange") == Some(1.0),
                age_s: signal("CurrentAge").unwrap_or(f64::NAN) * 1e-3,
            };
            if all
                .last()
                .is_none_or(|last| last.conversion != frame.conversion)
            {
                all.push(frame);
            }
        }
        all
    }

    /// Charge as CAN has it now, when nothing flows: the newest frame is up to 0.1 s old.
    #[track_caller]
    pub fn charge_c(&mut self) -> f64 {
        let charge = self.rig.view.charge_c();
        charge
            .value
            .unwrap_or_else(|| panic!("no charge on CAN: {charge:?}"))
    }

    /// A signal that has to be there.
    #[track_caller]
    pub fn signal(&self, message: &str, signal: &str) -> f64 {
        self.rig
            .view
            .signal(message, signal)
            .unwrap_or_else(|| panic!("{message}.{signal} is not there"))
    }

    /// Diagnoses that came since the start or the last `clear`, without those that are expected.
    pub fn complaints(&self, expected: &[&str]) -> Vec<String> {
        self.rig
            .view
            .diagnoses
            .iter()
            .filter(|(name, _)| !expected.contains(name))
            .map(|(name, at)| format!("{name} at {:.3} s", at.seconds()))
            .collect()
    }
}

/// Compares the board's charge with what has really flowed. To be begun and ended when nothing flows: the frame is up
/// to 0.1 s old.
pub struct Account {
    board_c: f64,
    true_c: f64,
    large_s: f64,
    edges: u64,
    start_s: f64,
}

/// What an [`Account`] ends with.
#[derive(Clone, Copy, Debug)]
pub struct Charge {
    /// What has flowed, in C.
    pub true_c: f64,
    /// What the board counted more, in C.
    pub error_c: f64,
    /// ∫ abs(i) dt, in C.
    pub throughput_c: f64,
    /// Bound that the error budget gives behind ideal sensors, in C.
    pub bound_c: f64,
    /// Range edges.
    pub edges: u64,
    /// In the large range, in s.
    pub large_s: f64,
    /// Length, in s.
    pub length_s: f64,
    /// Largest current, both signs, in A.
    pub span_a: (f64, f64),
}

impl Account {
    #[track_caller]
    pub fn open(bench: &mut Bench<'_>) -> Self {
        assert_eq!(bench.row().current_a, 0.0, "nothing flows at the beginning");
        let truth = bench.rig.truth();
        bench
            .rig
            .machine
            .board(|board| board.trace(Ticks::from_millis(1)));
        Self {
            board_c: bench.charge_c(),
            true_c: truth.charge_c,
            large_s: truth.large_s,
            edges: truth.edges,
            start_s: bench.now_s(),
        }
    }

    #[track_caller]
    pub fn close(self, bench: &mut Bench<'_>) -> Charge {
        assert_eq!(bench.row().current_a, 0.0, "nothing flows at the end");
        bench.run(0.25);
        let truth = bench.rig.truth();
        let samples = bench.rig.machine.board(|board| board.take_trace());
        let mut charge = Charge {
            true_c: truth.charge_c - self.true_c,
            error_c: 0.0,
            throughput_c: 0.0,
            bound_c: 0.0,
            edges: truth.edges - self.edges,
            large_s: truth.large_s - self.large_s,
            length_s: bench.now_s() - self.start_s,
            span_a: (0.0, 0.0),
        };
        charge.error_c = bench.charge_c() - self.board_c - charge.true_c;
        let (mut squares, mut below_no_load_s) = (0.0, 0.0);
        let mut last_s = self.start_s;
        for sample in samples {
            let (length_s, amps) = (sample.t_s - last_s, sample.current_a);
            last_s = sample.t_s;
            charge.throughput_c += amps.abs() * length_s;
            squares += amps * amps * length_s;
            if amps.abs() * 1e6 < no_load() as f64 {
                below_no_load_s += length_s;
            }
            charge.span_a = (charge.span_a.0.min(amps), charge.span_a.1.max(amps));
        }
        let micros = |seconds: f64| Duration::from_ticks((seconds * 1e6) as u64);
        let rms_a = (squares / charge.length_s).sqrt();
        let bound = charge_bound(&ProfileSummary {
            duration: micros(charge.length_s),
            in_large: micros(charge.large_s),
            rms_current: Microamps((rms_a * 1e6) as i32),
            edges: charge.edges as u32,
            below_no_load: micros(below_no_load_s),
            chatter: Duration::from_ticks(0),
            chatter_squares: 0,
            chatter_runs: 0,
        });
        // A frame rounds to 1 mAs, at both ends.
        charge.bound_c = bound.ideal_sensor.get() as f64 * 1e-9 + 0.001;
        charge
    }
}
