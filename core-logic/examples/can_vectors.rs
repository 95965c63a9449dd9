//! Test vectors for `can/board.dbc`, one JSON object a line, for a check by another DBC implementation.
//!
//! Without an argument: frames of every message, made by the encoders from deterministic pseudo-random and extreme
//! values, with the physical values that a decoder must find:
//! `{"message":"Current","id":257,"data":"<hex>","signals":{"Current":-1.5,…}}`.
//!
//! With `--encode`: reads `{"message":"Current","signals":{"Current":-1.5,…}}` from standard input and prints the data
//! bytes, a line of hexadecimal digits for each, packed by the same bit layout; CRC and counter are signals like any
//! other, a signal not given is 0.
//!
//! ```text
//! cargo run -p core-logic --example can_vectors
//! echo '{"message":"Throughput","signals":{"ChargeCharged":7}}' | cargo run -p core-logic --example can_vectors -- --encode
//! ```

#![allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]

use core_logic::can::layout::{self, Field, Message, Scale};
use core_logic::can::{
    self, BoardState, Charge, Current, CurrentAverage, DiagnosisDetail, Environment, Frame,
    Identity, MeterCurrent, ResetCause, StateOfCharge, Throughput,
};
use core_logic::diagnosis::{Code, CodeSet, Detail};
use core_logic::e2e;
use core_logic::key_calibration::{KeyPhase, KeyRefusal, KeyState};
use core_logic::range::Range;
use core_logic::units::{
    Duration, Instant, Microamps, MilliCelsius, Millivolts, Nanocoulombs, Ppm,
};
use core_logic::validity::Validity;
use serde_json::{Map, Value, json};
use std::error::Error;
use std::io::{BufRead, Write};

/// Frames per message.
const FRAMES: u32 = 256;

type Signals = Vec<(String, f64)>;

fn main() -> Result<(), Box<dyn Error>> {
    match std::env::args().nth(1).as_deref() {
        None => print_vectors(),
        Some("--encode") => encode_lines(),
        Some(other) => {
            Err(format!("unknown argument {other}; expected --encode or nothing").into())
        }
    }
}

/// SplitMix64: deterministic, so that a failing vector can be found again.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    fn flag(&mut self) -> bool {
        self.next() & 1 == 1
    }

    /// One of the ends in a quarter of the cases, else anything between them.
    fn within(&mut self, low: i64, high: i64) -> i64 {
        match self.next() % 8 {
            0 => low,
            1 => high,
            _ => {
                let width = (high as i128 - low as i128 + 1) as u128;
                (low as i128 + (u128::from(self.next()) % width) as i128) as i64
            }
        }
    }

    fn validity(&mut self) -> Validity {
        match self.next() % 4 {
            0 => Validity::from_bits(self.next() as u8),
            1 => Validity::SUPPLY,
            _ => Validity::VALID,
        }
    }

    fn range(&mut self) -> Range {
        if self.flag() {
            Range::Large
        } else {
            Range::Small
        }
    }
}

/// `value / divisor` rounded to nearest, halves away from zero, said differently than in the encoder.
fn rounded(value: i64, divisor: i64) -> i64 {
    let (value, divisor) = (i128::from(value), i128::from(divisor));
    let magnitude = (2 * value.abs() + divisor) / (2 * divisor);
    (magnitude * value.signum()) as i64
}

/// A physical value and its validity bits, by the conventions in docs/can.md.
fn measured(
    raw: i64,
    limits: (i64, i64),
    not_available: i64,
    unit: f64,
    validity: Validity,
    sum: bool,
) -> (f64, f64) {
    let meaningless = if sum { 0x01 } else { 0x01 | 0x08 | 0x80 };
    let causes = validity.bits();
    if causes & meaningless != 0 {
        return (not_available as f64 / unit, f64::from(causes));
    }
    let kept = raw.clamp(limits.0, limits.1);
    let causes = if kept == raw { causes } else { causes | 0x02 };
    (kept as f64 / unit, f64::from(causes))
}

const AMPERE: (i64, i64) = (-1_048_575, 1_048_575);

fn amperes(current: Microamps, validity: Validity) -> (f64, f64) {
    measured(
        rounded(i64::from(current.get()), 1_000),
        AMPERE,
        -1_048_576,
        1_000.0,
        validity,
        false,
    )
}

fn list<const N: usize>(signals: [(&str, f64); N]) -> Signals {
    signals
        .into_iter()
        .map(|(name, value)| (name.to_string(), value))
        .collect()
}

fn range_number(range: Range) -> f64 {
    f64::from(u8::from(range == Range::Large))
}

fn key_number(key: Option<KeyState>) -> f64 {
    match key {
        Some(KeyState::Off) => 0.0,
        Some(KeyState::Acc) => 1.0,
        Some(KeyState::On) => 2.0,
        Some(KeyState::Start) => 3.0,
        None => 7.0,
    }
}

fn bit(flag: bool) -> f64 {
    f64::from(u8::from(flag))
}

fn optional(random: &mut Random, key: KeyState) -> Option<KeyState> {
    (!random.next().is_multiple_of(5)).then_some(key)
}

fn current(random: &mut Random, counter: u8) -> (Frame, Signals) {
    let value = Current {
        current: Microamps(random.within(-1_100_000_000, 1_100_000_000) as i32),
        validity: random.validity(),
        range: random.range(),
        conversions: random.next() as u32,
        age: random
            .flag()
            .then(|| Duration::from_ticks(random.within(0, 1_100_000) as u64)),
    };
    let (amps, causes) = amperes(value.current, value.validity);
    let age = value
        .age
        .map_or(1_023.0, |age| (age.as_ticks() / 1_000).min(1_022) as f64);
    let signals = list([
        ("Current", amps),
        ("CurrentValidity", causes),
        ("CurrentRange", range_number(value.range)),
        ("CurrentConversions", f64::from(value.conversions % 256)),
        ("CurrentAge", age),
    ]);
    (value.encode(counter), signals)
}

fn current_average(random: &mut Random, counter: u8) -> (Frame, Signals) {
    let value = CurrentAverage {
        average: Microamps(random.within(-1_100_000_000, 1_100_000_000) as i32),
        validity: random.validity(),
        samples: random.within(0, 130) as u16,
        span: Duration::from_ticks(random.within(0, 9_000_000) as u64),
    };
    let (amps, causes) = amperes(value.average, value.validity);
    let span = (value.span.as_ticks() / 2_000).min(4_095) * 2;
    let signals = list([
        ("CurrentAverage", amps),
        ("CurrentAverageValidity", causes),
        ("CurrentAverageSamples", f64::from(value.samples.min(127))),
        ("CurrentAverageSpan", span as f64),
    ]);
    (value.encode(counter), signals)
}

fn charge(random: &mut Random, counter: u8) -> (Frame, Signals) {
    let value = Charge {
        charge: Nanocoulombs(random.within(-300_000_000_000_000_000, 300_000_000_000_000_000)),
        validity: random.validity(),
        estimated: random.flag(),
    };
    let limits = (-274_877_906_943, 274_877_906_943);
    let raw = rounded(value.charge.get(), 1_000_000);
    let (coulombs, causes) = measured(raw, limits, -274_877_906_944, 1_000.0, value.validity, true);
    let signals = list([
        ("Charge", coulombs),
        ("ChargeValidity", causes),
        ("ChargeEstimated", bit(value.estimated)),
    ]);
    (value.encode(counter), signals)
}

fn meter_current(random: &mut Random, counter: u8) -> (Frame, Signals) {
    let value = MeterCurrent {
        current: Microamps(random.within(-1_100_000_000, 1_100_000_000) as i32),
        validity: random.validity(),
        below_no_load: random.flag(),
        charge_uncertainty: random
            .flag()
            .then(|| Nanocoulombs(random.within(0, 3_000_000_000_000))),
    };
    let (amps, causes) = amperes(value.current, value.validity);
    let uncertainty = value.charge_uncertainty.map_or(262_143, |bound| {
        ((bound.get() + 9_999_999) / 10_000_000).min(262_142)
    });
    let signals = list([
        ("MeterCurrent", amps),
        ("MeterCurrentValidity", causes),
        ("MeterBelowNoLoad", bit(value.below_no_load)),
        ("ChargeUncertainty", uncertainty as f64 / 100.0),
    ]);
    (value.encode(counter), signals)
}

fn state_of_charge(random: &mut Random, counter: u8) -> (Frame, Signals) {
    let value = StateOfCharge {
        state_of_charge: Ppm(random.within(-1_000, 1_001_000) as i32),
        validity: random.validity(),
        uncertainty: random
            .flag()
            .then(|| Ppm(random.within(0, 1_100_000) as i32)),
        remaining: random
            .flag()
            .then(|| Nanocoulombs(random.within(-1_000_000_000_000, 24_000_000_000_000_000))),
    };
    let raw = rounded(i64::from(value.state_of_charge.get()), 100);
    let (percent, causes) = measured(raw, (0, 10_000), 16_383, 100.0, value.validity, true);
    // A bound is rounded up.
    let uncertainty = value.uncertainty.map_or(1_023, |ppm| {
        ((i64::from(ppm.get()) + 999) / 1_000).clamp(0, 1_000)
    });
    let remaining = value.remaining.map_or(65_535, |charge| {
        rounded(charge.get(), 360_000_000_000).clamp(0, 65_534)
    });
    let signals = list([
        ("StateOfCharge", percent),
        ("StateOfChargeValidity", causes),
        ("StateOfChargeUncertainty", uncertainty as f64 / 10.0),
        ("RemainingCharge", remaining as f64 / 10.0),
    ]);
    (value.encode(counter), signals)
}

fn throughput(random: &mut Random) -> (Frame, Signals) {
    let value = Throughput {
        discharged: Nanocoulombs(random.within(0, 5_000_000_000_000_000_000)),
        charged: Nanocoulombs(random.within(0, 5_000_000_000_000_000_000)),
    };
    let coulombs =
        |charge: Nanocoulombs| rounded(charge.get(), 1_000_000_000).min(4_294_967_295) as f64;
    let signals = list([
        ("ChargeDischarged", coulombs(value.discharged)),
        ("ChargeCharged", coulombs(value.charged)),
    ]);
    (value.encode(), signals)
}

fn environment(random: &mut Random) -> (Frame, Signals) {
    let value = Environment {
        supply: Millivolts(random.within(-100, 17_000) as i32),
        supply_validity: random.validity(),
        sensor_temperature: MilliCelsius(random.within(-300_000, 300_000) as i32),
        sensor_temperature_validity: random.validity(),
        board_temperature: MilliCelsius(random.within(-300_000, 300_000) as i32),
        board_temperature_validity: random.validity(),
    };
    let degrees = |temperature: MilliCelsius, validity| {
        measured(
            rounded(i64::from(temperature.get()), 100),
            (-2_047, 2_047),
            -2_048,
            10.0,
            validity,
            false,
        )
    };
    let (supply, supply_causes) = measured(
        i64::from(value.supply.get()),
        (0, 16_382),
        16_383,
        1.0,
        value.supply_validity,
        false,
    );
    let (sensor, sensor_causes) =
        degrees(value.sensor_temperature, value.sensor_temperature_validity);
    let (board, board_causes) = degrees(value.board_temperature, value.board_temperature_validity);
    let signals = list([
        ("SensorSupply", supply),
        ("SensorSupplyValidity", supply_causes),
        ("SensorTemperature", sensor),
        ("SensorTemperatureValidity", sensor_causes),
        ("BoardTemperature", board),
        ("BoardTemperatureValidity", board_causes),
    ]);
    (value.encode(), signals)
}

fn board_state(random: &mut Random) -> (Frame, Signals) {
    let keys = [KeyState::Off, KeyState::Acc, KeyState::On, KeyState::Start];
    let phases = [
        (KeyPhase::Off, 0.0),
        (KeyPhase::Taking, 1.0),
        (KeyPhase::Taken, 2.0),
        (KeyPhase::Failed(KeyRefusal::HighVoltageOn), 3.0),
        (KeyPhase::Resumed, 4.0),
        (KeyPhase::Disabled, 5.0),
    ];
    let key = keys
        .get(random.next() as usize % keys.len())
        .copied()
        .unwrap_or_default();
    let phase = phases.get(random.next() as usize % 7).copied();
    let value = BoardState {
        key: optional(random, key),
        high_voltage: random.flag().then(|| random.flag()),
        permit: random.flag(),
        key_calibration: phase.map(|(phase, _)| phase),
        range: random.range(),
        cell_voltage_fresh: random.flag(),
        vehicle_state_fresh: random.flag(),
        edges: random.next() as u32,
        coalesced: random.within(0, 300) as u16,
        estimated_intervals: random.within(0, 300) as u32,
        bus_offs: random.within(0, 300) as u16,
        refused: random.next() as u32,
    };
    let signals = list([
        ("KeyState", key_number(value.key)),
        ("HighVoltage", value.high_voltage.map_or(3.0, bit)),
        ("HighVoltagePermit", bit(value.permit)),
        ("KeyCalibration", phase.map_or(7.0, |(_, number)| number)),
        ("Range", range_number(value.range)),
        ("CellVoltageFresh", bit(value.cell_voltage_fresh)),
        ("VehicleStateFresh", bit(value.vehicle_state_fresh)),
        ("RangeEdges", f64::from(value.edges % 65_536)),
        ("CoalescedEdges", f64::from(value.coalesced.min(255))),
        (
            "EstimatedIntervals",
            f64::from(value.estimated_intervals.min(255)),
        ),
        ("BusOffs", f64::from(value.bus_offs.min(255))),
        ("RefusedFrames", f64::from(value.refused % 256)),
    ]);
    (value.encode(), signals)
}

fn diagnosis_set(
    random: &mut Random,
    prefix: &str,
    encode: fn(CodeSet) -> Frame,
) -> (Frame, Signals) {
    let mut set = CodeSet::EMPTY;
    let everything = random.next() % 16;
    let mut signals = Signals::new();
    for code in Code::ALL {
        let present = everything == 0 || (everything != 1 && random.flag());
        set.set(code, present);
        signals.push((format!("{prefix}{code:?}"), bit(present)));
    }
    (encode(set), signals)
}

fn diagnosis_detail(random: &mut Random) -> (Frame, Signals) {
    let detail = Detail {
        active: random.flag(),
        latched: random.flag(),
        occurrences: random.within(0, 65_535) as u16,
        first_seen: random
            .flag()
            .then(|| Instant::from_ticks(random.within(0, 18_000_000_000_000) as u64)),
    };
    let code = Code::ALL
        .get(random.next() as usize % (Code::COUNT + 1))
        .copied();
    let reported = random.within(0, 300) as u32;
    let value = DiagnosisDetail {
        code: code.map(|code| (code, detail)),
        reported,
    };
    let first_seen = detail.first_seen.filter(|_| code.is_some());
    let signals = list([
        (
            "DiagnosisCode",
            code.map_or(255.0, |code| f64::from(code.number())),
        ),
        (
            "DiagnosisSeverity",
            code.map_or(0.0, |code| f64::from(code.rule().severity as u8)),
        ),
        ("DiagnosisIsActive", bit(code.is_some() && detail.active)),
        ("DiagnosisIsLatched", bit(code.is_some() && detail.latched)),
        ("DiagnosisReported", f64::from(reported.min(255))),
        (
            "DiagnosisOccurrences",
            code.map_or(0.0, |_| f64::from(detail.occurrences)),
        ),
        (
            "DiagnosisFirstSeen",
            first_seen.map_or(16_777_215.0, |at| {
                (at.as_ticks() / 1_000_000).min(16_777_214) as f64
            }),
        ),
    ]);
    (value.encode(), signals)
}

fn identity(random: &mut Random, page: u8) -> (Frame, Signals) {
    let causes = [
        ResetCause::Unknown,
        ResetCause::PowerOn,
        ResetCause::BrownOut,
        ResetCause::Pin,
        ResetCause::Software,
        ResetCause::IndependentWatchdog,
        ResetCause::WindowWatchdog,
        ResetCause::LowPower,
    ];
    let cause = random.next() as usize % causes.len();
    let value = Identity {
        version: [
            random.next() as u8,
            random.next() as u8,
            random.next() as u8,
        ],
        reset_cause: causes.get(cause).copied().unwrap_or_default(),
        boots: random.next() as u32,
        commit: random.next() as u32,
        modified: random.flag(),
        configuration_crc: random.next() as u32,
        panic_hash: random.next() as u32,
        panic_line: random.within(0, 70_000) as u32,
        late_tasks: random.next() as u8,
        unique_id: [
            random.next() as u32,
            random.next() as u32,
            random.next() as u32,
        ],
        uptime: Duration::from_ticks(random.within(0, 5_000_000_000_000_000) as u64),
        stack_free: random.within(0, 131_072) as u32,
        log_fill: random
            .flag()
            .then(|| Ppm(random.within(0, 1_000_000) as i32)),
    };
    let page = page % Identity::PAGES;
    let mut signals = list([("IdentityPage", f64::from(page))]);
    let [major, minor, patch] = value.version.map(f64::from);
    let [low, middle, high] = value.unique_id.map(u64::from);
    signals.extend(match page {
        0 => list([
            ("ProtocolVersion", f64::from(can::PROTOCOL_VERSION)),
            ("FirmwareMajor", major),
            ("FirmwareMinor", minor),
            ("FirmwarePatch", patch),
            ("ResetCause", cause as f64),
            ("BootCount", f64::from(value.boots % 65_536)),
        ]),
        1 => list([
            ("BuildCommit", f64::from(value.commit)),
            ("BuildModified", bit(value.modified)),
            (
                "ConfigurationCrc",
                f64::from(value.configuration_crc % 65_536),
            ),
        ]),
        2 => list([
            ("PanicHash", f64::from(value.panic_hash)),
            ("PanicLine", f64::from(value.panic_line.min(65_535))),
            ("LateTasks", f64::from(value.late_tasks)),
        ]),
        3 => list([("UniqueIdLow", (low + (middle % 65_536) * (1 << 32)) as f64)]),
        4 => list([("UniqueIdHigh", (middle / 65_536 + high * 65_536) as f64)]),
        _ => list([
            (
                "Uptime",
                (value.uptime.as_ticks() / 1_000_000).min(4_294_967_295) as f64,
            ),
            ("StackFree", f64::from(value.stack_free.min(65_535))),
            (
                "LogFill",
                value
                    .log_fill
                    .map_or(255, |share| rounded(i64::from(share.get()), 5_000))
                    as f64
                    / 2.0,
            ),
        ]),
    });
    (value.encode(page), signals)
}

/// A received message: the board has a decoder only, so the frame is packed here from its layout.
fn received(random: &mut Random, message: &Message, counter: u8) -> (Frame, Signals) {
    let mut word = 0;
    let mut signals = Signals::new();
    for signal in message
        .signals
        .iter()
        .filter(|signal| signal.field.start >= 16)
    {
        let raw = match signal.field.not_available() {
            Some(not_available) if random.next().is_multiple_of(6) => not_available,
            _ => random.within(signal.field.minimum(), signal.field.maximum),
        };
        word = signal.field.put(word, raw);
        signals.push((signal.name.to_string(), physical(raw, signal.scale)));
    }
    let mut frame = Frame {
        id: message.header.id,
        dlc: 8,
        data: word.to_le_bytes(),
    };
    if let Some(id) = message.header.data_id {
        e2e::protect(id, counter, &mut frame.data);
    }
    (frame, signals)
}

fn physical(raw: i64, scale: Scale) -> f64 {
    (raw * scale.numerator) as f64 / scale.denominator as f64 + scale.offset as f64
}

fn print_vectors() -> Result<(), Box<dyn Error>> {
    let mut out = std::io::stdout().lock();
    for message in &layout::MESSAGES {
        let mut random = Random(u64::from(message.header.id));
        for n in 0..FRAMES {
            let counter = (n % 15) as u8;
            let (frame, mut signals) = match message.name {
                "Current" => current(&mut random, counter),
                "CurrentAverage" => current_average(&mut random, counter),
                "Charge" => charge(&mut random, counter),
                "MeterCurrent" => meter_current(&mut random, counter),
                "StateOfCharge" => state_of_charge(&mut random, counter),
                "Throughput" => throughput(&mut random),
                "Environment" => environment(&mut random),
                "BoardState" => board_state(&mut random),
                "DiagnosisActive" => diagnosis_set(&mut random, "Active", can::diagnosis_active),
                "DiagnosisLatched" => diagnosis_set(&mut random, "Latched", can::diagnosis_latched),
                "DiagnosisDetail" => diagnosis_detail(&mut random),
                "Identity" => identity(&mut random, n as u8),
                _ => received(&mut random, message, counter),
            };
            if let Some(id) = message.header.data_id {
                let [crc, ..] = frame.data;
                let nibble = f64::from(id.get() / 256);
                signals.push((format!("{}Crc", message.name), f64::from(crc)));
                signals.push((format!("{}Counter", message.name), f64::from(counter)));
                signals.push((format!("{}IdNibble", message.name), nibble));
            }
            let signals: Map<String, Value> = signals
                .into_iter()
                .map(|(name, value)| (name, json_number(value)))
                .collect();
            let line = json!({
                "message": message.name,
                "id": frame.id,
                "data": hex(frame.data),
                "signals": signals,
            });
            writeln!(out, "{line}")?;
        }
    }
    Ok(())
}

/// Whole numbers without a decimal point.
fn json_number(value: f64) -> Value {
    if value.fract() == 0.0 {
        json!(value as i64)
    } else {
        json!(value)
    }
}

fn hex(data: [u8; 8]) -> String {
    data.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// The bits and the scale of a signal by its name.
fn find(message: &Message, name: &str) -> Option<(Field, Scale)> {
    if let Some(prefix) = message.prefix_of_codes {
        let code = Code::ALL
            .into_iter()
            .find(|code| Some(code.description().name) == name.strip_prefix(prefix))?;
        let field = Field {
            start: code.number(),
            length: 1,
            signed: false,
            maximum: 1,
            has_not_available: false,
        };
        return Some((
            field,
            Scale {
                numerator: 1,
                denominator: 1,
                offset: 0,
            },
        ));
    }
    let signal = message.signals.iter().find(|signal| signal.name == name)?;
    Some((signal.field, signal.scale))
}

fn encode_lines() -> Result<(), Box<dyn Error>> {
    let mut out = std::io::stdout().lock();
    for (number, line) in std::io::stdin().lock().lines().enumerate() {
        let line = line?;
        if line.trim().is_empty() {
            continue;
        }
        let data = encode_line(&line).map_err(|error| format!("line {}: {error}", number + 1))?;
        writeln!(out, "{}", hex(data))?;
    }
    Ok(())
}

fn encode_line(line: &str) -> Result<[u8; 8], Box<dyn Error>> {
    let object: Value = serde_json::from_str(line)?;
    let name = object
        .get("message")
        .and_then(Value::as_str)
        .ok_or("no \"message\"")?;
    let message = layout::MESSAGES
        .iter()
        .find(|message| message.name == name)
        .ok_or_else(|| format!("no message {name} in the layout"))?;
    let signals = object
        .get("signals")
        .and_then(Value::as_object)
        .ok_or("no \"signals\"")?;
    let mut word = 0;
    for (signal, value) in signals {
        let (field, scale) =
            find(message, signal).ok_or_else(|| format!("no signal {signal} in {name}"))?;
        let value = value
            .as_f64()
            .ok_or_else(|| format!("{signal} is not a number"))?;
        let raw = (value - scale.offset as f64) * scale.denominator as f64 / scale.numerator as f64;
        word = field.put(word, raw.round() as i64);
    }
    Ok(word.to_le_bytes())
}
