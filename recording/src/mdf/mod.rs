//! ASAM MDF 4 (`.mf4`): measured signals with their conversions, and logged CAN frames.
//!
//! Read are the blocks HD, DG, CG, CN, CC, DT, SD, DZ, DL, HL, TX and MD, of sorted and unsorted groups. Channels that
//! hold no numbers, arrays and formulas are left out and named; data that is stored by columns (LD, DV) is refused.
//!
//! Not built on the crate `mdf4-rs`: 0.6 needs a later compiler, and 0.3 trusts the addresses in the file.

mod blocks;
mod conversion;

use std::{borrow::Cow, cell::Cell, collections::HashMap, rc::Rc};

use blocks::{Block, File, u16_at, u32_at, u64_at};
use conversion::Conversion;

use crate::{
    error::{Error, Kind, Place, Result, number, quoted},
    log::{self, CLASSIC_BYTES, Counts, DATA_BYTES, Frame, Sink},
    merge::{Series, Signal},
    unit::{self, Unit},
};

/// No time is so far from its zero: in ns it fits 64 bits, and between any two of them is a number.
const LONGEST_S: f64 = 9.2e9;
/// The block HD follows the identification.
const HD_ADDRESS: u64 = 64;

/// What a file holds.
#[derive(Debug, Default)]
pub struct Contents {
    /// Measured signals, a series for each group.
    pub series: Vec<Series>,
    /// Logged CAN data frames, in the order of their time.
    pub frames: Frames,
    /// Frames and events that carry no signals.
    pub counts: Counts,
    /// Channels that could not be read, and why.
    pub left_out: Vec<String>,
}

/// Logged frames.
#[derive(Debug, Default)]
pub struct Frames(Vec<Logged>);

#[derive(Debug)]
struct Logged {
    time_ns: i64,
    bus: u64,
    id: u32,
    extended: bool,
    length: usize,
    data: [u8; DATA_BYTES],
    /// Number of the record in its group.
    record: u64,
}

impl Frames {
    /// No frame was logged.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Hands the frames on.
    pub fn give(&self, sink: &mut Sink<'_>) -> Result<()> {
        for logged in &self.0 {
            sink(&Frame {
                time_ns: logged.time_ns,
                bus: &logged.bus.to_string(),
                id: logged.id,
                extended: logged.extended,
                length: logged.length,
                data: logged.data,
                place: Place::row(logged.record + 1),
            })?;
        }
        Ok(())
    }
}

/// Reads a file from memory; `source` is what messages call it. Times count from the start of its measurement. Of logged frames,
/// what is on the bus `wanted` is counted.
pub fn read(source: &str, wanted: Option<&str>, bytes: &[u8]) -> Result<Contents> {
    let file = File {
        source,
        bytes,
        channels: Cell::new(0),
        stored: Cell::new(0),
    };
    if bytes.starts_with(b"UnFinMF ") {
        return Err(file.unsupported(0, "a measurement that was not ended", "a finished file"));
    }
    if !bytes.starts_with(b"MDF     ") {
        return Err(file.fault(0, "another kind of file", "an MDF file"));
    }
    if bytes.get(8) != Some(&b'4') {
        let version = String::from_utf8_lossy(bytes.get(8..16).unwrap_or_default());
        let version = version.trim_end_matches(['\0', ' ']);
        return Err(file.unsupported(8, &format!("version {}", quoted(version)), "version 4"));
    }
    let header = file.block_of(HD_ADDRESS, b"HD")?;
    let mut contents = Contents::default();
    let mut names = Vec::new();
    for block in file.chain(header.link(0), b"DG")? {
        for group in groups(&file, &block)? {
            group.read(&file, wanted, &mut contents, &mut names)?;
        }
    }
    distinguish(&mut contents.series, &names);
    contents.frames.0.sort_by_key(|frame| frame.time_ns);
    contents.counts.frames = contents.frames.0.len() as u64;
    Ok(contents)
}

/// Names that stand in several groups get the group's name before them, and its number if the groups share one.
fn distinguish(series: &mut [Series], groups: &[String]) {
    let mut count: HashMap<String, u32> = HashMap::new();
    for signal in series.iter().flat_map(|series| &series.signals) {
        *count.entry(signal.name.clone()).or_default() += 1;
    }
    for (index, (series, name)) in series.iter_mut().zip(groups).enumerate() {
        let shared = groups.iter().filter(|other| *other == name).count() > 1;
        let group = if shared {
            format!("{name} {}", index + 1)
        } else {
            name.clone()
        };
        for signal in &mut series.signals {
            if count.get(&signal.name).is_some_and(|&count| count > 1) {
                signal.name = format!("{group}.{}", signal.name);
                signal.bare = format!("{group}.{}", signal.bare);
            }
        }
    }
}

/// A channel group with its records.
struct Group<'a> {
    block: Block<'a>,
    data: Rc<Cow<'a, [u8]>>,
    /// Where each record begins, after its identifier.
    records: Vec<usize>,
    data_bytes: usize,
    inval_bytes: usize,
    /// Contents of groups that hold values of variable length, by the address of their block.
    variable: Rc<HashMap<u64, Vec<u8>>>,
}

/// What a group block says of its records.
struct Layout {
    record_id: u64,
    cycles: u64,
    data_bytes: usize,
    inval_bytes: usize,
    /// Its records are values of variable length, that channels of other groups point to.
    variable: bool,
}

impl Layout {
    fn of(block: &Block<'_>) -> Self {
        Self {
            record_id: u64_at(block.data, 0),
            cycles: u64_at(block.data, 8),
            variable: u16_at(block.data, 16) & 1 != 0,
            data_bytes: u32_at(block.data, 24) as usize,
            inval_bytes: u32_at(block.data, 28) as usize,
        }
    }
}

/// The groups of a data group. Several of them have their records mixed, each with the identifier of its group.
fn groups<'a>(file: &File<'a>, data_group: &Block<'a>) -> Result<Vec<Group<'a>>> {
    let blocks = file.chain(data_group.link(1), b"CG")?;
    let id_bytes = usize::from(data_group.data.first().copied().unwrap_or_default());
    let data = Rc::new(file.data(data_group.link(2))?);
    if !matches!(id_bytes, 0 | 1 | 2 | 4 | 8) {
        return Err(file.fault(
            data_group.address,
            &format!("record identifiers of {id_bytes} bytes"),
            "0, 1, 2, 4 or 8",
        ));
    }
    let layouts: Vec<_> = blocks.iter().map(Layout::of).collect();
    let mut records = vec![Vec::new(); blocks.len()];
    let mut variable: HashMap<u64, Vec<u8>> = HashMap::new();
    let cut = |found: String, expected: &str| Err(file.fault(data_group.address, &found, expected));
    if id_bytes == 0 {
        match layouts.as_slice() {
            [] => {}
            [layout] => {
                let size = layout.data_bytes.saturating_add(layout.inval_bytes);
                let held = data.len().checked_div(size).unwrap_or(0) as u64;
                if layout.cycles > held && size > 0 {
                    return cut(
                        format!("data of {held} records"),
                        &format!("{} as its group says", layout.cycles),
                    );
                }
                let count = usize::try_from(layout.cycles.min(held)).unwrap_or(0);
                records[0] = (0..count).map(|record| record * size).collect();
            }
            _ => {
                return cut(
                    "several groups without record identifiers".into(),
                    "one group",
                );
            }
        }
    } else {
        let by_id: HashMap<u64, usize> = layouts
            .iter()
            .enumerate()
            .map(|(index, layout)| (layout.record_id, index))
            .collect();
        let mut rest = 0;
        while rest < data.len() {
            let mut id = [0; 8];
            let Some(bytes) = data.get(rest..rest + id_bytes) else {
                return cut("a record identifier that is cut".into(), "whole records");
            };
            id[..id_bytes].copy_from_slice(bytes);
            rest += id_bytes;
            let Some(&index) = by_id.get(&u64::from_le_bytes(id)) else {
                return cut(
                    format!("a record of group {}", u64::from_le_bytes(id)),
                    "one of its groups",
                );
            };
            let layout = &layouts[index];
            let size = if layout.variable {
                4 + u32_at(&data, rest) as usize
            } else {
                layout.data_bytes + layout.inval_bytes
            };
            let Some(record) = data.get(rest..rest + size) else {
                return cut("a record that is cut".into(), "whole records");
            };
            if layout.variable {
                let values = variable.entry(blocks[index].address).or_default();
                values.extend_from_slice(record);
            } else {
                records[index].push(rest);
            }
            rest += size;
        }
    }
    let variable = Rc::new(variable);
    Ok(blocks
        .into_iter()
        .zip(layouts)
        .zip(records)
        .filter(|((_, layout), _)| !layout.variable)
        .map(|((block, layout), records)| Group {
            block,
            data: Rc::clone(&data),
            records,
            data_bytes: layout.data_bytes,
            inval_bytes: layout.inval_bytes,
            variable: Rc::clone(&variable),
        })
        .collect())
}

/// A channel of a group.
struct Channel<'a> {
    block: Block<'a>,
    name: String,
    kind: u8,
    sync: u8,
    data_type: u8,
    bit_offset: u32,
    byte_offset: usize,
    bits: u32,
    flags: u32,
    inval_bit: u32,
    /// Members, if it is a structure.
    members: Vec<Channel<'a>>,
    array: bool,
}

/// Channel types.
const VARIABLE_LENGTH: u8 = 1;
const MASTER: u8 = 2;
const VIRTUAL_MASTER: u8 = 3;
const VIRTUAL_DATA: u8 = 6;
/// Synchronisation by time.
const TIME: u8 = 1;

impl<'a> Channel<'a> {
    fn all(file: &File<'a>, first: Option<u64>, depth: u32) -> Result<Vec<Self>> {
        file.chain(first, b"CN")?
            .into_iter()
            .map(|block| {
                file.count_channel(block.address)?;
                Self::read(file, block, depth)
            })
            .collect()
    }

    fn read(file: &File<'a>, block: Block<'a>, depth: u32) -> Result<Self> {
        let (mut members, mut array) = (Vec::new(), false);
        if let Some(address) = block.link(1) {
            match &file.block(address)?.id {
                b"CN" if depth > 0 => members = Self::all(file, Some(address), depth - 1)?,
                _ => array = true,
            }
        }
        let data = block.data;
        Ok(Self {
            name: file.text(block.link(2))?,
            kind: data.first().copied().unwrap_or_default(),
            sync: data.get(1).copied().unwrap_or_default(),
            data_type: data.get(2).copied().unwrap_or_default(),
            bit_offset: u32::from(data.get(3).copied().unwrap_or_default() & 7),
            byte_offset: u32_at(data, 4) as usize,
            bits: u32_at(data, 8),
            flags: u32_at(data, 12),
            inval_bit: u32_at(data, 16),
            members,
            array,
            block,
        })
    }

    /// Why its values are no numbers.
    fn no_number(&self) -> Option<&'static str> {
        if self.array {
            return Some("an array");
        }
        match (self.data_type, self.bits) {
            (6..=9, _) => Some("text"),
            _ if self.kind == VARIABLE_LENGTH => Some("values of variable length"),
            _ if self.kind == VIRTUAL_MASTER || self.kind == VIRTUAL_DATA => None,
            (0..=3, 1..=64) | (4 | 5, 32 | 64) => None,
            (0..=5, _) => Some("numbers of that size"),
            _ => Some("no numbers"),
        }
    }

    fn whole(&self) -> bool {
        self.data_type <= 3
    }

    /// Refuses a part of a logged frame that is longer than a number can be.
    fn need_number(&self, file: &File<'_>) -> Result<()> {
        if (1..=64).contains(&self.bits) {
            return Ok(());
        }
        Err(file.fault(
            self.block.address,
            &format!("{} of {} bits", quoted(&self.name), self.bits),
            "1 to 64",
        ))
    }

    /// The raw bits in a record; the identifier of the record is not part of it.
    fn raw_bits(&self, record: &[u8]) -> Option<u64> {
        let bytes = (self.bit_offset + self.bits).div_ceil(8) as usize;
        let bytes = record.get(self.byte_offset..)?.get(..bytes)?;
        let big_endian = matches!(self.data_type, 1 | 3 | 5);
        // Up to nine bytes: 64 bits that begin in the middle of one.
        let join = |word: u128, byte: &u8| word << 8 | u128::from(*byte);
        let word = if big_endian {
            bytes.iter().fold(0, join)
        } else {
            bytes.iter().rev().fold(0, join)
        };
        let mask = u64::MAX >> (64 - self.bits.clamp(1, 64));
        #[expect(clippy::cast_possible_truncation, reason = "the mask is not wider")]
        Some((word >> self.bit_offset) as u64 & mask)
    }

    /// The raw number in record number `index`.
    fn raw(&self, record: &[u8], index: usize) -> Option<f64> {
        if self.kind == VIRTUAL_MASTER || self.kind == VIRTUAL_DATA {
            return Some(index as f64);
        }
        let bits = self.raw_bits(record)?;
        let unused = 64 - self.bits.clamp(1, 64);
        Some(match (self.data_type, self.bits) {
            (2 | 3, _) => ((bits << unused).cast_signed() >> unused) as f64,
            (4 | 5, 32) => f64::from(f32::from_bits(u32::try_from(bits).unwrap_or_default())),
            (4 | 5, _) => f64::from_bits(bits),
            _ => bits as f64,
        })
    }

    /// The file marks the value in a record as not valid.
    fn invalid(&self, inval: &[u8]) -> bool {
        let bit = self.inval_bit;
        let marked = || {
            inval
                .get((bit / 8) as usize)
                .is_some_and(|byte| byte >> (bit % 8) & 1 != 0)
        };
        self.flags & 1 != 0 || self.flags & 2 != 0 && marked()
    }

    fn unit(&self, file: &File<'_>) -> Result<Option<Unit>> {
        let mut text = file.text(self.block.link(6))?;
        if text.is_empty()
            && let Some(address) = self.block.link(4)
        {
            // The conversion can say it as well.
            text = file.text(file.block_of(address, b"CC")?.link(1))?;
        }
        Ok(unit::known(&text))
    }
}

impl Group<'_> {
    fn read(
        &self,
        file: &File<'_>,
        wanted: Option<&str>,
        contents: &mut Contents,
        names: &mut Vec<String>,
    ) -> Result<()> {
        const DEPTH: u32 = 8;
        if self.records.is_empty() {
            return Ok(());
        }
        let channels = Channel::all(file, self.block.link(1), DEPTH)?;
        let name = match file.text(self.block.link(2))? {
            name if name.is_empty() => "group".to_owned(),
            name => name,
        };
        let bus = |kind: &str| {
            channels.iter().any(|channel| {
                channel.name == kind || channel.name.starts_with(&format!("{kind}."))
            })
        };
        if bus("CAN_ErrorFrame") {
            contents.counts.errors += self.events(file, &channels, "CAN_ErrorFrame", wanted)?;
            return Ok(());
        }
        if bus("CAN_RemoteFrame") {
            contents.counts.remote += self.events(file, &channels, "CAN_RemoteFrame", wanted)?;
            return Ok(());
        }
        let time = channels.iter().find(|channel| {
            matches!(channel.kind, MASTER | VIRTUAL_MASTER) && channel.sync == TIME
        });
        let Some(time) = time else {
            contents.left_out.push(format!("{name} (no time)"));
            return Ok(());
        };
        let time_s = self.times(file, time, &name)?;
        if bus("CAN_DataFrame") {
            return self.frames(file, &channels, &time_s, wanted, contents);
        }
        let mut signals = Vec::new();
        let flat = channels.iter().flat_map(|channel| {
            let members = channel.members.iter();
            let alone = channel.members.is_empty().then_some(channel);
            members.chain(alone)
        });
        for channel in flat {
            if std::ptr::eq(channel, time) {
                continue;
            }
            if channel.name.is_empty() {
                contents
                    .left_out
                    .push(format!("a channel of {name} (no name)"));
                continue;
            }
            let unit = channel.unit(file)?;
            if let Some(why) = channel.no_number() {
                contents.left_out.push(format!("{} ({why})", channel.name));
                continue;
            }
            let rule = Conversion::read(file, channel.block.link(4), channel.whole(), unit)?;
            let Some(rule) = rule else {
                let why = format!("{} (its conversion)", channel.name);
                contents.left_out.push(why);
                continue;
            };
            let values = self.values(file, channel, &rule)?;
            if let Some(record) = values.iter().position(|value| value.is_infinite()) {
                let why = format!(
                    "{} (an infinite value in record {})",
                    channel.name,
                    record + 1
                );
                contents.left_out.push(why);
                continue;
            }
            signals.push(Signal {
                name: unit::column_name(&channel.name, unit),
                bare: channel.name.clone(),
                unit: unit.map(|unit| unit.symbol),
                values,
            });
        }
        if !signals.is_empty() {
            contents.series.push(Series { time_s, signals });
            names.push(name);
        }
        Ok(())
    }

    /// Record and invalidation bytes of each record.
    fn records(&self) -> impl Iterator<Item = (&[u8], &[u8])> {
        self.records.iter().map(|&start| {
            let record = self.data.get(start..).unwrap_or_default();
            let (data, rest) = record
                .split_at_checked(self.data_bytes)
                .unwrap_or((record, &[]));
            (data, rest.get(..self.inval_bytes).unwrap_or_default())
        })
    }

    fn values(
        &self,
        file: &File<'_>,
        channel: &Channel<'_>,
        rule: &Conversion,
    ) -> Result<Vec<f64>> {
        self.records()
            .enumerate()
            .map(|(index, (record, inval))| {
                let raw = channel
                    .raw(record, index)
                    .ok_or_else(|| outside(file, channel))?;
                let valid = !channel.invalid(inval);
                Ok(if valid { rule.apply(raw) } else { f64::NAN })
            })
            .collect()
    }

    /// The time of each record, in s.
    fn times(&self, file: &File<'_>, channel: &Channel<'_>, group: &str) -> Result<Vec<f64>> {
        if let Some(why) = channel.no_number() {
            return Err(file.unsupported(
                channel.block.address,
                &format!("the time of {} as {why}", quoted(group)),
                "numbers",
            ));
        }
        let Some(rule) = Conversion::read(file, channel.block.link(4), channel.whole(), None)?
        else {
            return Err(file.unsupported(
                channel.block.address,
                &format!("the time of {} by a formula", quoted(group)),
                "another conversion",
            ));
        };
        let time_s = self.values(file, channel, &rule)?;
        let mut last_s = f64::NEG_INFINITY;
        for (record, &now_s) in time_s.iter().enumerate() {
            let place = || Place {
                row: Some(record as u64 + 1),
                name: Some(format!("{group}: {}", channel.name)),
                ..Place::default()
            };
            let fault = |kind, found: String, expected: String| {
                Err(Error::new(kind, file.source, place(), found, expected))
            };
            if !now_s.is_finite() {
                return fault(Kind::TimeMissing, "no time".into(), "a time in s".into());
            }
            if now_s.abs() > LONGEST_S {
                return fault(
                    Kind::Format,
                    format!("{} s", number(now_s)),
                    "a time of less than 292 years".into(),
                );
            }
            if now_s < last_s {
                return fault(
                    Kind::TimeBackwards,
                    format!("{now_s} s"),
                    format!("a time not before the last record's {last_s} s"),
                );
            }
            last_s = now_s;
        }
        Ok(time_s)
    }

    /// How many frames a group of logged ones without data holds of the bus `wanted`.
    fn events(
        &self,
        file: &File<'_>,
        channels: &[Channel<'_>],
        kind: &str,
        wanted: Option<&str>,
    ) -> Result<u64> {
        let bus = member(channels, &format!("{kind}."), "BusChannel");
        let (Some(bus), Some(_)) = (bus, wanted) else {
            // As of frames without this channel.
            return Ok(self.records.len() as u64 * log::on(wanted, "0"));
        };
        bus.need_number(file)?;
        self.records().try_fold(0, |count, (record, _)| {
            let number = bus.raw_bits(record).ok_or_else(|| outside(file, bus))?;
            Ok(count + log::on(wanted, &number.to_string()))
        })
    }

    /// The frames of a group of logged CAN data frames (ASAM MDF 4.1, bus logging).
    fn frames(
        &self,
        file: &File<'_>,
        channels: &[Channel<'_>],
        time_s: &[f64],
        wanted: Option<&str>,
        contents: &mut Contents,
    ) -> Result<()> {
        let member = |name: &str| member(channels, "CAN_DataFrame.", name);
        let need = |wanted: &str| {
            member(wanted).ok_or_else(|| {
                file.fault(
                    self.block.address,
                    "a group of CAN frames",
                    &format!("one with CAN_DataFrame.{wanted}"),
                )
            })
        };
        let (id, bytes) = (need("ID")?, need("DataBytes")?);
        let counted = member("DataLength");
        let length = counted.map_or_else(|| need("DLC"), Ok)?;
        let (ide, edl, bus) = (member("IDE"), member("EDL"), member("BusChannel"));
        let numbers = [Some(id), Some(length), ide, edl, bus];
        for channel in numbers.into_iter().flatten() {
            channel.need_number(file)?;
        }
        let payload = Payload::of(file, bytes, &self.variable)?;
        let number = |channel: &Channel<'_>, record: &[u8]| {
            let bits = channel.raw_bits(record);
            bits.ok_or_else(|| outside(file, channel))
        };
        let optional = |channel: Option<&Channel<'_>>, record: &[u8]| {
            channel.map_or(Ok(0), |channel| number(channel, record))
        };
        for (index, ((record, _), &time_s)) in self.records().zip(time_s).enumerate() {
            let place = || Place::row(index as u64 + 1);
            let fd = optional(edl, record)? != 0;
            let said = usize::try_from(number(length, record)?).unwrap_or(usize::MAX);
            let length = if counted.is_some() {
                said
            } else {
                log::length_of_code(said, fd)
            };
            if length > DATA_BYTES {
                return Err(Error::new(
                    Kind::Format,
                    file.source,
                    place(),
                    format!("a frame of {length} bytes"),
                    "at most 64",
                ));
            }
            let channel = optional(bus, record)?;
            contents.counts.fd +=
                u64::from(fd || length > CLASSIC_BYTES) * log::on(wanted, &channel.to_string());
            let raw = number(id, record)?;
            // Some loggers mark 29 bits in the identifier itself.
            let extended = optional(ide, record)? != 0 || raw >> 31 & 1 != 0;
            let id = u32::try_from(raw & 0x7FFF_FFFF).unwrap_or(u32::MAX);
            if !log::fits(id, extended) {
                return Err(Error::new(
                    Kind::Format,
                    file.source,
                    place(),
                    format!("the identifier {id:#x}"),
                    "one of 11 or 29 bits",
                ));
            }
            let mut data = [0; DATA_BYTES];
            let bytes = payload
                .bytes(record)
                .and_then(|bytes| bytes.get(..length))
                .ok_or_else(|| outside(file, bytes))?;
            data[..length].copy_from_slice(bytes);
            #[expect(clippy::cast_possible_truncation, reason = "no time is longer")]
            let time_ns = (time_s * 1e9).round() as i64;
            contents.frames.0.push(Logged {
                time_ns,
                bus: channel,
                id,
                extended,
                length,
                data,
                record: index as u64,
            });
        }
        Ok(())
    }
}

/// The channel of this name, or the member of one, with `prefix` before it or without.
fn member<'a>(channels: &'a [Channel<'a>], prefix: &str, name: &str) -> Option<&'a Channel<'a>> {
    let mut all = channels
        .iter()
        .flat_map(|channel| channel.members.iter().chain([channel]));
    all.find(|channel| channel.name.strip_prefix(prefix).unwrap_or(&channel.name) == name)
}

fn outside(file: &File<'_>, channel: &Channel<'_>) -> Error {
    file.fault(
        channel.block.address,
        &format!("values of {} outside of the data", quoted(&channel.name)),
        "all of them inside",
    )
}

/// Where the bytes of a frame are.
enum Payload<'a> {
    /// In the record.
    Inside { start: usize, length: usize },
    /// Elsewhere: the record says where.
    Elsewhere {
        channel: &'a Channel<'a>,
        values: Cow<'a, [u8]>,
    },
}

impl<'a> Payload<'a> {
    fn of(
        file: &File<'a>,
        channel: &'a Channel<'a>,
        variable: &'a HashMap<u64, Vec<u8>>,
    ) -> Result<Self> {
        if channel.kind != VARIABLE_LENGTH {
            return Ok(Self::Inside {
                start: channel.byte_offset,
                length: (channel.bits / 8) as usize,
            });
        }
        channel.need_number(file)?;
        let address = channel.block.link(5);
        let values = match address.and_then(|address| variable.get(&address)) {
            Some(values) => Cow::Borrowed(values.as_slice()),
            None => file.data(address)?,
        };
        Ok(Self::Elsewhere { channel, values })
    }

    fn bytes<'b>(&'b self, record: &'b [u8]) -> Option<&'b [u8]> {
        match self {
            Self::Inside { start, length } => record.get(*start..)?.get(..*length),
            Self::Elsewhere { channel, values } => {
                let start = usize::try_from(channel.raw_bits(record)?).ok()?;
                let value = values.get(start..)?;
                let length = u32_at(value, 0) as usize;
                value.get(4..)?.get(..length)
            }
        }
    }
}
