//! Frames decoded by a DBC.
//!
//! A signal becomes the column `<Message>.<Signal>` and its unit's ending, in our unit; signals of this project's own
//! board get the names of [`name`](crate::name). A value that the database calls "not available" is a missing one. So is,
//! by the board's database, one against which the signal of its name and `Validity` in the same frame has any cause; a
//! frame that its end-to-end check does not let pass is left out.

use std::{
    collections::{BTreeSet, HashMap},
    fs,
    path::Path,
};

use can_dbc::{
    AttributeValue, ByteOrder, Dbc, DbcError, MessageId, MultiplexIndicator,
    SignalExtendedValueType, ValueDescription, ValueType,
};

use crate::{
    e2e,
    error::{Error, Kind, Place, Result, listed, quoted},
    log::{CLASSIC_BYTES, DATA_BYTES, Frame},
    merge::{Series, Signal},
    unit::{self, Scale, Unit},
};

/// How far a log's time may run backwards, in ns: loggers empty the buffers of their channels in turn. A step beyond it
/// is a clock that was set.
const DISORDER_NS: i64 = 1_000_000_000;

/// The board's node in its own database, `can/board.dbc`.
const BOARD: &str = "HALLMARK";

/// Signals of the board's database that are canonical columns.
const BOARD_COLUMNS: [(&str, &str, &str); 9] = [
    ("Current", "Current", "i_meas_a"),
    ("Current", "CurrentRange", "range_high"),
    ("Charge", "Charge", "q_meas_c"),
    ("Environment", "SensorSupply", "v_supply_v"),
    ("Environment", "SensorTemperature", "temp_sensor_c"),
    ("StateOfCharge", "StateOfCharge", "soc_pct"),
    ("BatteryVoltage", "CellVoltage", "v_cell_v"),
    ("BatteryVoltage", "PackVoltage", "v_pack_v"),
    ("BatteryVoltage", "CellTemperature", "temp_cell_c"),
];

/// What the board's database calls the signal with the causes against another: the other's name and this.
const VALIDITY: &str = "Validity";

/// Attributes of the board's protected messages, and the profile that is checked: AUTOSAR E2E profile 11, variant C.
const E2E_PROFILE: &str = "E2EProfile";
const E2E_DATA_ID: &str = "E2EDataId";
const PROFILE_11C: &str = "P11C";

/// What databases call the raw value of a signal that has none.
const NOT_AVAILABLE: [&str; 3] = ["not available", "signal not available", "sna"];

/// The messages of a DBC file.
#[derive(Clone, Debug)]
pub struct Database {
    messages: HashMap<MessageId, Message>,
}

#[derive(Clone, Debug)]
struct Message {
    signals: Vec<Coded>,
    /// Of a message that is protected end to end.
    data_id: Option<u16>,
}

/// How a signal is coded.
#[derive(Clone, Debug)]
struct Coded {
    column: String,
    bare: String,
    unit: Option<Unit>,
    bits: Bits,
    value_type: Type,
    factor: Scale,
    offset: f64,
    missing: Option<i64>,
    /// The signal with the causes against this one, by its place in the message.
    validity: Option<usize>,
    /// The multiplexer (by its place in the message) and the values of it for which this signal is there.
    switch: Option<(usize, Vec<(u64, u64)>)>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Type {
    Unsigned,
    Signed,
    Float32,
    Float64,
}

#[derive(Clone, Copy, Debug)]
struct Bits {
    big_endian: bool,
    start: u64,
    size: u64,
}

impl Bits {
    /// The raw bits, if the frame has them all.
    fn of(self, data: &[u8; DATA_BYTES], length: usize) -> Option<u64> {
        let first = if self.big_endian {
            // The start is the most significant bit; bytes are counted onwards, bits in them downwards.
            (self.start / 8).checked_mul(8)? + (7 - self.start % 8)
        } else {
            self.start
        };
        let end = usize::try_from(first.checked_add(self.size)?).ok()?;
        // Up to nine bytes: 64 bits that begin in the middle of one.
        let start = end - usize::try_from(self.size).ok()?;
        let bytes = data.get(..length)?.get(start / 8..end.div_ceil(8))?;
        let join = |word: u128, byte: &u8| word << 8 | u128::from(*byte);
        let word = if self.big_endian {
            bytes.iter().fold(0, join) >> (end.div_ceil(8) * 8 - end)
        } else {
            bytes.iter().rev().fold(0, join) >> (start % 8)
        };
        let mask = u64::MAX >> (64 - self.size);
        #[expect(clippy::cast_possible_truncation, reason = "the mask is not wider")]
        Some(word as u64 & mask)
    }
}

impl Database {
    /// Reads a DBC file.
    pub fn read(path: &Path) -> Result<Self> {
        let bytes = fs::read(path).map_err(|error| Error::reading(path, &error))?;
        Self::parse(&path.display().to_string(), &bytes)
    }

    /// Reads a DBC from memory; `source` is what messages call it.
    pub fn parse(source: &str, bytes: &[u8]) -> Result<Self> {
        let text = match std::str::from_utf8(bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes)) {
            Ok(text) => text.to_owned(),
            // The editors of DBC files write Windows-1252, which differs from Latin-1 in no letter that a unit has.
            Err(_) => bytes.iter().map(|&byte| char::from(byte)).collect(),
        };
        let dbc = Dbc::try_from(text.as_str()).map_err(|error| refused(source, &error))?;
        Self::from_dbc(source, &dbc)
    }

    fn from_dbc(source: &str, dbc: &Dbc) -> Result<Self> {
        let board = dbc.nodes.iter().any(|node| node.0 == BOARD);
        let mut messages = HashMap::new();
        for message in &dbc.messages {
            // What belongs to no message is kept in a message of this name.
            if message.name == "VECTOR__INDEPENDENT_SIG_MSG" {
                continue;
            }
            let fault = |bare: &str, found: String, expected: &str| {
                let place = Place {
                    name: Some(bare.to_owned()),
                    ..Place::default()
                };
                Error::new(Kind::Format, source, place, found, expected)
            };
            let mut signals = Vec::new();
            for signal in &message.signals {
                let bare = format!("{}.{}", message.name, signal.name);
                if !(1..=64).contains(&signal.size) {
                    return Err(fault(
                        &bare,
                        format!("a signal of {} bits", signal.size),
                        "1 to 64",
                    ));
                }
                let value_type = match dbc.extended_value_type_for_signal(message.id, &signal.name)
                {
                    Some(SignalExtendedValueType::IEEEfloat32Bit) => Type::Float32,
                    Some(SignalExtendedValueType::IEEEdouble64bit) => Type::Float64,
                    _ if signal.value_type == ValueType::Signed => Type::Signed,
                    _ => Type::Unsigned,
                };
                let wanted = match value_type {
                    Type::Float32 => 32,
                    Type::Float64 => 64,
                    _ => signal.size,
                };
                if signal.size != wanted {
                    return Err(fault(
                        &bare,
                        format!("a floating-point signal of {} bits", signal.size),
                        &format!("{wanted}"),
                    ));
                }
                let switch = switch(dbc, message, signal).map_err(|multiplexer| {
                    fault(
                        &bare,
                        format!("the multiplexer {}", quoted(&multiplexer)),
                        "a multiplexer in the same message",
                    )
                })?;
                let validity = format!("{}{VALIDITY}", signal.name);
                let validity = message
                    .signals
                    .iter()
                    .position(|other| board && other.name == validity);
                let unit = unit::known(&signal.unit);
                let canonical = BOARD_COLUMNS
                    .iter()
                    .find(|known| board && known.0 == message.name && known.1 == signal.name);
                let column = match canonical {
                    Some(&(_, _, column)) => column.to_owned(),
                    None => unit::column_name(&bare, unit),
                };
                signals.push(Coded {
                    column,
                    bare,
                    unit,
                    bits: Bits {
                        big_endian: signal.byte_order == ByteOrder::BigEndian,
                        start: signal.start_bit,
                        size: signal.size,
                    },
                    value_type,
                    factor: Scale::of(signal.factor, unit),
                    offset: unit.map_or(signal.offset, |unit| unit.scale.apply(signal.offset)),
                    missing: missing(dbc, message.id, &signal.name),
                    validity,
                    switch,
                });
            }
            if let Some(signal) = signals.iter().find(|signal| circular(&signals, signal)) {
                return Err(fault(
                    &signal.bare,
                    "a multiplexer that depends on itself".into(),
                    "a chain of multiplexers with an end",
                ));
            }
            let data_id = data_id(dbc, message.id).filter(|_| board);
            messages.insert(message.id, Message { signals, data_id });
        }
        Ok(Self { messages })
    }
}

fn refused(source: &str, error: &DbcError) -> Error {
    // The parser draws the line it stopped at, headed by " --> line:column".
    let text = error.to_string();
    let place = text.split_once("--> ").map(|(_, rest)| {
        let end = rest
            .find(|letter: char| !letter.is_ascii_digit() && letter != ':')
            .unwrap_or(rest.len());
        let mut numbers = rest[..end].split(':');
        Place {
            line: numbers.next().and_then(|line| line.parse().ok()),
            column: numbers.next().and_then(|column| column.parse().ok()),
            ..Place::default()
        }
    });
    let found = match &place {
        Some(_) => "what is no part of a DBC there".to_owned(),
        None => quoted(&text),
    };
    Error::new(
        Kind::Format,
        source,
        place.unwrap_or_default(),
        found,
        "a DBC file",
    )
}

fn missing(dbc: &Dbc, id: MessageId, signal: &str) -> Option<i64> {
    dbc.value_descriptions
        .iter()
        .filter_map(|described| match described {
            ValueDescription::Signal {
                message_id,
                name,
                value_descriptions,
            } if *message_id == id && name == signal => Some(value_descriptions),
            _ => None,
        })
        .flatten()
        .find(|value| {
            let text = value.description.trim();
            NOT_AVAILABLE
                .iter()
                .any(|known| text.eq_ignore_ascii_case(known))
        })
        .map(|value| value.id)
}

/// The data ID of a message that is protected by the profile that is checked here.
fn data_id(dbc: &Dbc, id: MessageId) -> Option<u16> {
    let profile = dbc.message_attribute(id, E2E_PROFILE)?;
    if !matches!(profile, AttributeValue::String(name) if name == PROFILE_11C) {
        return None;
    }
    match *dbc.message_attribute(id, E2E_DATA_ID)? {
        AttributeValue::Uint(number) => u16::try_from(number).ok(),
        AttributeValue::Int(number) => u16::try_from(number).ok(),
        _ => None,
    }
}

type Switch = Option<(usize, Vec<(u64, u64)>)>;

/// The multiplexer of a signal. The error is the name of one that cannot be followed.
fn switch(
    dbc: &Dbc,
    message: &can_dbc::Message,
    signal: &can_dbc::Signal,
) -> std::result::Result<Switch, String> {
    let place = |name: &str| {
        message
            .signals
            .iter()
            .position(|signal| signal.name == name)
    };
    let extended = |name: &str| {
        dbc.extended_multiplex
            .iter()
            .find(|entry| entry.message_id == message.id && entry.signal_name == name)
    };
    if let Some(entry) = extended(&signal.name) {
        let name = &entry.multiplexor_signal_name;
        let index = place(name).ok_or_else(|| name.clone())?;
        let ranges = entry
            .mappings
            .iter()
            .map(|mapping| (mapping.min_value, mapping.max_value))
            .collect();
        return Ok(Some((index, ranges)));
    }
    match signal.multiplexer_indicator {
        MultiplexIndicator::MultiplexedSignal(value)
        | MultiplexIndicator::MultiplexorAndMultiplexedSignal(value) => {
            let index = message
                .signals
                .iter()
                .position(|signal| signal.multiplexer_indicator == MultiplexIndicator::Multiplexor)
                .ok_or_else(|| "M".to_owned())?;
            Ok(Some((index, vec![(value, value)])))
        }
        MultiplexIndicator::Plain | MultiplexIndicator::Multiplexor => Ok(None),
    }
}

/// Whether a signal's chain of multiplexers has no end.
fn circular(signals: &[Coded], signal: &Coded) -> bool {
    let mut above = Some(signal);
    for _ in 0..=signals.len() {
        above = above
            .and_then(|signal| signal.switch.as_ref())
            .and_then(|&(index, _)| signals.get(index));
    }
    above.is_some()
}

impl Message {
    /// A signal is in a frame if its multiplexer is, and has one of its values.
    fn present(&self, signal: &Coded, data: &[u8; DATA_BYTES], length: usize) -> bool {
        let Some((index, ranges)) = &signal.switch else {
            return true;
        };
        let Some(multiplexer) = self.signals.get(*index) else {
            return false;
        };
        multiplexer.bits.of(data, length).is_some_and(|raw| {
            ranges
                .iter()
                .any(|&(low, high)| (low..=high).contains(&raw))
        }) && self.present(multiplexer, data, length)
    }

    /// Whether a frame is whole, as far as the message is protected.
    fn is_whole(&self, data: &[u8; DATA_BYTES], length: usize) -> bool {
        self.data_id.is_none_or(|data_id| {
            let payload = data.first_chunk().filter(|_| length == CLASSIC_BYTES);
            payload.is_some_and(|payload| e2e::holds(data_id, payload))
        })
    }

    /// Whether nothing stands against a signal. A frame too short to say so says nothing for it.
    fn is_valid(&self, signal: &Coded, data: &[u8; DATA_BYTES], length: usize) -> bool {
        signal.validity.is_none_or(|index| {
            let causes = self.signals.get(index);
            causes.and_then(|causes| causes.bits.of(data, length)) == Some(0)
        })
    }

    /// A signal's value, NaN where the frame has none.
    fn value(&self, signal: &Coded, data: &[u8; DATA_BYTES], length: usize) -> f64 {
        if !self.present(signal, data, length) {
            return f64::NAN;
        }
        let Some(raw) = signal.bits.of(data, length) else {
            return f64::NAN;
        };
        let unused = 64 - signal.bits.size;
        let signed = (raw << unused).cast_signed() >> unused;
        let number = match signal.value_type {
            Type::Unsigned => raw as f64,
            Type::Signed => signed as f64,
            Type::Float32 => f64::from(f32::from_bits(u32::try_from(raw).unwrap_or_default())),
            Type::Float64 => f64::from_bits(raw),
        };
        let is_missing = |missing| match signal.value_type {
            Type::Signed => signed == missing,
            Type::Unsigned => i64::try_from(raw) == Ok(missing),
            Type::Float32 | Type::Float64 => false,
        };
        if signal.missing.is_some_and(is_missing) {
            return f64::NAN;
        }
        let value = signal.factor.apply(number) + signal.offset;
        // Floating-point signals can carry what a recording cannot.
        if value.is_finite() { value } else { f64::NAN }
    }
}

/// What a log came to.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Decoded {
    /// Frames that the database describes.
    pub frames: u64,
    /// Frames that it does not.
    pub unknown: u64,
    /// Of the described ones, those that are too short for a signal.
    pub short: u64,
    /// Frames left out: described, and not as they were sent by their end-to-end check.
    pub broken: u64,
    /// Values left out: the frame says that they are not valid.
    pub invalid: u64,
    /// Frames that stood after a later one, put in their place.
    pub disordered: u64,
}

/// Takes the frames of one log.
#[derive(Debug)]
pub struct Decoder<'a> {
    database: &'a Database,
    source: String,
    /// Frames of other buses are left out.
    bus: Option<String>,
    /// Whether it had any frame, and the buses of those left out.
    met: bool,
    others: BTreeSet<String>,
    zero_ns: Option<i64>,
    latest_ns: i64,
    counts: Decoded,
    collected: HashMap<MessageId, Collected>,
    order: Vec<MessageId>,
}

#[derive(Debug)]
struct Collected {
    bus: String,
    sorted: bool,
    time_ns: Vec<i64>,
    values: Vec<Vec<f64>>,
}

impl<'a> Decoder<'a> {
    /// For the log `source`; of the bus called `bus`, or of any if it is `None`. With `from_first_frame`, time counts
    /// from the log's first frame and not from its clock's zero.
    pub fn new(
        database: &'a Database,
        source: &str,
        bus: Option<&str>,
        from_first_frame: bool,
    ) -> Self {
        Self {
            database,
            source: source.to_owned(),
            bus: bus.map(str::to_owned),
            met: false,
            others: BTreeSet::new(),
            zero_ns: (!from_first_frame).then_some(0),
            latest_ns: i64::MIN,
            counts: Decoded::default(),
            collected: HashMap::new(),
            order: Vec::new(),
        }
    }

    /// Takes the next frame.
    pub fn frame(&mut self, frame: &Frame<'_>) -> Result<()> {
        let fault = |kind, found: String, expected: &str| {
            let place = frame.place.clone();
            Error::new(kind, self.source.as_str(), place, found, expected)
        };
        let zero_ns = *self.zero_ns.get_or_insert(frame.time_ns);
        // What another bus carries is nobody's concern.
        if self.bus.as_ref().is_some_and(|bus| bus != frame.bus) {
            if !self.others.contains(frame.bus) {
                self.others.insert(frame.bus.to_owned());
            }
            return Ok(());
        }
        self.met = true;
        let time_ns = frame.time_ns.saturating_sub(zero_ns);
        if time_ns < self.latest_ns.saturating_sub(DISORDER_NS) {
            return Err(fault(
                Kind::TimeBackwards,
                format!("{} s", seconds(time_ns)),
                &format!(
                    "a time not more than 1 s before the last one, {} s",
                    seconds(self.latest_ns)
                ),
            ));
        }
        if time_ns < self.latest_ns {
            self.counts.disordered += 1;
        }
        self.latest_ns = self.latest_ns.max(time_ns);
        let id = if frame.extended {
            MessageId::Extended(frame.id)
        } else {
            match u16::try_from(frame.id) {
                Ok(id) => MessageId::Standard(id),
                Err(_) => return Ok(()),
            }
        };
        let Some(message) = self.database.messages.get(&id) else {
            self.counts.unknown += 1;
            return Ok(());
        };
        if !message.is_whole(&frame.data, frame.length) {
            self.counts.broken += 1;
            return Ok(());
        }
        let collected = self.collected.entry(id).or_insert_with(|| {
            self.order.push(id);
            Collected {
                bus: frame.bus.to_owned(),
                sorted: true,
                time_ns: Vec::new(),
                values: vec![Vec::new(); message.signals.len()],
            }
        });
        if collected.bus != frame.bus {
            return Err(fault(
                Kind::Format,
                format!(
                    "the identifier {:#x} on {} after {}",
                    frame.id,
                    quoted(frame.bus),
                    quoted(&collected.bus)
                ),
                "it on one bus, or the bus to be chosen",
            ));
        }
        self.counts.frames += 1;
        if collected.time_ns.last().is_some_and(|&last| last > time_ns) {
            collected.sorted = false;
        }
        collected.time_ns.push(time_ns);
        let mut short = false;
        for (signal, values) in message.signals.iter().zip(&mut collected.values) {
            let mut value = message.value(signal, &frame.data, frame.length);
            if !value.is_nan() && !message.is_valid(signal, &frame.data, frame.length) {
                self.counts.invalid += 1;
                value = f64::NAN;
            }
            values.push(value);
            short |= message.present(signal, &frame.data, frame.length)
                && signal.bits.of(&frame.data, frame.length).is_none();
        }
        self.counts.short += u64::from(short);
        Ok(())
    }

    /// The bus that was chosen had frames, if any had.
    fn check_bus(&self) -> Result<()> {
        let Some(bus) = self.bus.as_ref().filter(|_| !self.met) else {
            return Ok(());
        };
        if self.others.is_empty() {
            return Ok(());
        }
        let others: Vec<&str> = self.others.iter().map(String::as_str).collect();
        Err(Error::new(
            Kind::Empty,
            self.source.as_str(),
            Place::default(),
            format!("frames on the buses {}", listed(others.into_iter())),
            format!("some on {}", quoted(bus)),
        ))
    }

    /// The signals, a series for each message that was received, and what else there was; an error if the bus that was chosen
    /// had no frame, and others had, or if no frame was whole.
    pub fn finish(self) -> Result<(Vec<Series>, Decoded)> {
        self.check_bus()?;
        if self.order.is_empty() && self.counts.broken > 0 {
            return Err(Error::new(
                Kind::Empty,
                self.source.as_str(),
                Place::default(),
                format!(
                    "{} frames that their end-to-end check does not let pass, and no others of the database",
                    self.counts.broken
                ),
                "frames as they were sent",
            ));
        }
        let mut collected = self.collected;
        let mut series = Vec::new();
        for id in self.order {
            let (Some(mut collected), Some(message)) =
                (collected.remove(&id), self.database.messages.get(&id))
            else {
                continue;
            };
            if !collected.sorted {
                collected.sort();
            }
            let signals = message
                .signals
                .iter()
                .zip(collected.values)
                .map(|(signal, values)| Signal {
                    name: signal.column.clone(),
                    bare: signal.bare.clone(),
                    unit: signal.unit.map(|unit| unit.symbol),
                    values,
                })
                .collect();
            series.push(Series {
                time_s: collected.time_ns.into_iter().map(seconds).collect(),
                signals,
            });
        }
        Ok((series, self.counts))
    }
}

impl Collected {
    /// By time; equal times stay in the order of the log.
    fn sort(&mut self) {
        let mut order: Vec<usize> = (0..self.time_ns.len()).collect();
        order.sort_by_key(|&index| self.time_ns[index]);
        self.time_ns = order.iter().map(|&index| self.time_ns[index]).collect();
        for values in &mut self.values {
            *values = order.iter().map(|&index| values[index]).collect();
        }
    }
}

/// Dividing gives the number nearest to the decimal one.
fn seconds(ns: i64) -> f64 {
    ns as f64 / 1e9
}
