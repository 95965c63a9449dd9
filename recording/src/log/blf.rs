//! Vector's binary log, `.blf`: objects of which most are in zlib-compressed containers. An object may begin in one
//! container and end in the next. The layout is not published by its maker; this follows what the free readers agree on
//! (python-can's `can/io/blf.py`, Tobias Lorenz's `vector_blf`).
//!
//! Not built on the crate `ablf` 0.2: it ends in silence at what it cannot read, and steps over it by recursion.

use std::io::{self, BufRead, Read};

use flate2::bufread::ZlibDecoder;

use super::{CLASSIC_BYTES, Counts, DATA_BYTES, Frame, Sink, fits, on, reading};
use crate::error::{Error, Kind, Place, Result, quoted};

const FILE_MARK: &[u8; 4] = b"LOGG";
const OBJECT_MARK: &[u8; 4] = b"LOBJ";
/// Mark, header size, header version, object size, object type.
const BASE_HEADER: usize = 16;
/// With flags and time.
const FULL_HEADER: usize = 32;
const CONTAINER_HEADER: usize = 16;
/// Larger ones are damage: containers are of 128 KiB as a rule.
const LARGEST: usize = 1 << 26;

/// Object types (`ObjectType` of vector_blf).
mod object {
    pub const CAN_MESSAGE: u32 = 1;
    pub const CAN_ERROR: u32 = 2;
    pub const CONTAINER: u32 = 10;
    pub const CAN_ERROR_EXT: u32 = 73;
    pub const CAN_MESSAGE2: u32 = 86;
    pub const CAN_FD_MESSAGE: u32 = 100;
    pub const CAN_FD_MESSAGE_64: u32 = 101;
    pub const CAN_FD_ERROR_64: u32 = 104;
}

/// Reads a log; times count from the start of its measurement. Counted is what is on `wanted`.
pub fn read(
    source: &str,
    wanted: Option<&str>,
    reader: impl BufRead,
    sink: &mut Sink<'_>,
) -> Result<Counts> {
    let mut file = File {
        source,
        reader,
        offset: 0,
    };
    file.header()?;
    let mut objects = Objects {
        source,
        wanted,
        counts: Counts::default(),
        pending: Vec::new(),
        bus: String::new(),
    };
    loop {
        let offset = file.offset;
        let base = file.bytes(BASE_HEADER)?;
        if base.is_empty() {
            break;
        }
        if base.len() < BASE_HEADER && OBJECT_MARK.starts_with(&base[..base.len().min(4)]) {
            objects.counts.cut += 1;
            return Ok(objects.counts);
        }
        if !base.starts_with(OBJECT_MARK) {
            return Err(file.fault(offset, "no object", "an object that begins with LOBJ"));
        }
        let size = le32(&base, 8) as usize;
        if !(BASE_HEADER..=LARGEST).contains(&size) {
            return Err(file.fault(
                offset,
                &format!("an object of {size} bytes"),
                "16 bytes to 64 MiB",
            ));
        }
        let body = file.bytes(size - BASE_HEADER)?;
        // Of a container that is cut, the objects that are whole.
        if body.len() < size - BASE_HEADER {
            if le32(&base, 12) == object::CONTAINER {
                objects.pending.extend_from_slice(&start_of(&body));
                objects.run(offset, sink)?;
            }
            objects.counts.cut += 1;
            return Ok(objects.counts);
        }
        // So many bytes follow each object, whatever its alignment.
        file.bytes(size % 4)?;
        if le32(&base, 12) == object::CONTAINER {
            let inside = file.container(offset, &body)?;
            objects.pending.extend_from_slice(&inside);
        } else {
            objects.pending.extend_from_slice(&base);
            objects.pending.extend_from_slice(&body);
        }
        objects.run(offset, sink)?;
    }
    // Less than a header is padding.
    if objects.pending.len() >= BASE_HEADER {
        objects.counts.cut += 1;
    }
    Ok(objects.counts)
}

struct File<'a, R> {
    source: &'a str,
    reader: R,
    offset: u64,
}

impl<R: BufRead> File<'_, R> {
    /// The next bytes; fewer at the end of the file.
    fn bytes(&mut self, count: usize) -> Result<Vec<u8>> {
        let mut bytes = Vec::new();
        Read::take(&mut self.reader, count as u64)
            .read_to_end(&mut bytes)
            .map_err(|error| reading(self.source, &error))?;
        self.offset += bytes.len() as u64;
        Ok(bytes)
    }

    fn header(&mut self) -> Result<()> {
        let start = self.bytes(8)?;
        if start.len() < 8 || !start.starts_with(FILE_MARK) {
            return Err(self.fault(0, "another kind of file", "a BLF file, beginning with LOGG"));
        }
        let size = le32(&start, 4) as usize;
        let rest = size.saturating_sub(8);
        if rest > LARGEST || self.bytes(rest)?.len() < rest {
            return Err(self.fault(
                4,
                &format!("a header of {size} bytes"),
                "one that fits the file",
            ));
        }
        Ok(())
    }

    /// The contents of a container.
    fn container(&self, offset: u64, body: &[u8]) -> Result<Vec<u8>> {
        let Some((header, packed)) = body.split_at_checked(CONTAINER_HEADER) else {
            return Err(self.fault(offset, "a container without its header", "16 bytes more"));
        };
        let size = le32(header, 8) as usize;
        match le16(header, 0) {
            0 => Ok(packed.to_vec()),
            2 if size > LARGEST => Err(self.fault(
                offset,
                &format!("a container of {size} bytes"),
                "at most 64 MiB",
            )),
            2 => inflate(packed, size).map_err(|error| {
                self.fault(
                    offset,
                    &quoted(&error.to_string()),
                    "a container packed by zlib",
                )
            }),
            method => Err(Error::new(
                Kind::Unsupported,
                self.source,
                Place::offset(offset),
                format!("a container packed by method {method}"),
                "method 0 or 2",
            )),
        }
    }

    fn fault(&self, offset: u64, found: &str, expected: &str) -> Error {
        Error::new(
            Kind::Format,
            self.source,
            Place::offset(offset),
            found,
            expected,
        )
    }
}

/// As much of a container's contents as the part of it that is there gives.
fn start_of(body: &[u8]) -> Vec<u8> {
    let Some((header, packed)) = body.split_at_checked(CONTAINER_HEADER) else {
        return Vec::new();
    };
    if le16(header, 0) == 0 {
        return packed.to_vec();
    }
    let mut bytes = Vec::new();
    // What was unpacked before the end stays, and an error is sure to come.
    let _cut = ZlibDecoder::new(packed)
        .take(LARGEST as u64)
        .read_to_end(&mut bytes);
    bytes
}

fn inflate(packed: &[u8], size: usize) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    ZlibDecoder::new(packed)
        .take(size as u64 + 1)
        .read_to_end(&mut bytes)?;
    if bytes.len() == size {
        Ok(bytes)
    } else {
        Err(io::Error::other(format!(
            "{} bytes instead of {size}",
            bytes.len()
        )))
    }
}

/// Objects as they come out of the containers.
struct Objects<'a> {
    source: &'a str,
    wanted: Option<&'a str>,
    counts: Counts,
    /// Not taken yet: the last object may go on in the next container.
    pending: Vec<u8>,
    bus: String,
}

impl Objects<'_> {
    fn run(&mut self, offset: u64, sink: &mut Sink<'_>) -> Result<()> {
        let mut pending = std::mem::take(&mut self.pending);
        let mut position = 0;
        loop {
            let rest = &pending[position..];
            // Up to three bytes of padding, some writers leave more.
            let Some(padding) = (0..8).find(|&skip| mark_at(rest, skip)) else {
                if rest.len() >= 8 + OBJECT_MARK.len() {
                    return Err(self.fault(offset, "no object", "an object that begins with LOBJ"));
                }
                break;
            };
            let rest = &rest[padding..];
            if rest.len() < BASE_HEADER {
                break;
            }
            let size = le32(rest, 8) as usize;
            if !(BASE_HEADER..=LARGEST).contains(&size) {
                return Err(self.fault(
                    offset,
                    &format!("an object of {size} bytes"),
                    "16 bytes to 64 MiB",
                ));
            }
            let Some(object) = rest.get(..size) else {
                break;
            };
            self.object(offset, object, sink)?;
            position += padding + size;
        }
        // Nothing moves while a long object is not whole yet, whatever small pieces it comes in.
        pending.drain(..position);
        self.pending = pending;
        Ok(())
    }

    fn object(&mut self, offset: u64, object: &[u8], sink: &mut Sink<'_>) -> Result<()> {
        let kind = le32(object, 12);
        match kind {
            object::CAN_ERROR | object::CAN_ERROR_EXT | object::CAN_FD_ERROR_64 => {
                let start = usize::from(le16(object, 4));
                let channel = match kind {
                    object::CAN_FD_ERROR_64 => {
                        u16::from(object.get(start).copied().unwrap_or_default())
                    }
                    _ => le16(object, start),
                };
                self.counts.errors += on(self.wanted, &channel.to_string());
                return Ok(());
            }
            object::CAN_MESSAGE
            | object::CAN_MESSAGE2
            | object::CAN_FD_MESSAGE
            | object::CAN_FD_MESSAGE_64 => {}
            _ => {
                self.counts.others += 1;
                return Ok(());
            }
        }
        let header_size = usize::from(le16(object, 4));
        let short = || self.fault(offset, "a frame that is cut short", "its header and data");
        let body = object
            .get(header_size..)
            .filter(|_| header_size >= FULL_HEADER)
            .ok_or_else(short)?;
        let ticks = i64::try_from(le64(object, 24)).ok();
        let unit_ns = if le32(object, 16) == 1 { 10_000 } else { 1 };
        let time_ns = ticks
            .and_then(|ticks| ticks.checked_mul(unit_ns))
            .ok_or_else(|| self.fault(offset, "a time beyond 292 years", "a time in a log"))?;

        let message = message(kind, body).ok_or_else(short)?;
        let extended = message.id >> 31 != 0;
        let id = message.id & 0x7FFF_FFFF;
        if !fits(id, extended) {
            return Err(self.fault(
                offset,
                &format!("the identifier {id:#x}"),
                "one of 11 or 29 bits",
            ));
        }
        if message.remote {
            self.counts.remote += on(self.wanted, &message.channel.to_string());
            return Ok(());
        }
        let mut data = [0; DATA_BYTES];
        let most = if message.fd {
            DATA_BYTES
        } else {
            CLASSIC_BYTES
        };
        let length = message.length.min(most);
        let bytes = body
            .get(message.data..message.data + length)
            .ok_or_else(short)?;
        data[..length].copy_from_slice(bytes);
        self.counts.frames += 1;
        self.bus = message.channel.to_string();
        self.counts.fd += u64::from(message.fd) * on(self.wanted, &self.bus);
        sink(&Frame {
            time_ns,
            bus: &self.bus,
            id,
            extended,
            length,
            data,
            place: Place::offset(offset),
        })
    }

    fn fault(&self, offset: u64, found: &str, expected: &str) -> Error {
        Error::new(
            Kind::Format,
            self.source,
            Place::offset(offset),
            found,
            expected,
        )
    }
}

/// What the bodies of the message objects have in common.
struct Message {
    channel: u16,
    id: u32,
    remote: bool,
    fd: bool,
    length: usize,
    /// Where its data begins in the body.
    data: usize,
}

fn message(kind: u32, body: &[u8]) -> Option<Message> {
    const REMOTE: u8 = 0x80;
    Some(match kind {
        object::CAN_FD_MESSAGE_64 if body.len() >= 40 => Message {
            channel: u16::from(body[0]),
            id: le32(body, 4),
            remote: le32(body, 12) & 0x10 != 0,
            fd: le32(body, 12) & 0x1000 != 0,
            length: usize::from(body[2]),
            data: 40,
        },
        object::CAN_FD_MESSAGE if body.len() >= 20 => Message {
            channel: le16(body, 0),
            id: le32(body, 4),
            remote: body[2] & REMOTE != 0,
            fd: body[13] & 1 != 0,
            length: usize::from(body[14]),
            data: 20,
        },
        object::CAN_MESSAGE | object::CAN_MESSAGE2 if body.len() >= 8 => Message {
            channel: le16(body, 0),
            id: le32(body, 4),
            remote: body[2] & REMOTE != 0,
            fd: false,
            length: usize::from(body[3]),
            data: 8,
        },
        _ => return None,
    })
}

fn mark_at(bytes: &[u8], at: usize) -> bool {
    bytes
        .get(at..)
        .is_some_and(|rest| rest.starts_with(OBJECT_MARK))
}

fn field<const N: usize>(bytes: &[u8], at: usize) -> [u8; N] {
    bytes
        .get(at..)
        .and_then(|rest| rest.first_chunk())
        .copied()
        .unwrap_or([0; N])
}

fn le16(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes(field(bytes, at))
}

fn le32(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(field(bytes, at))
}

fn le64(bytes: &[u8], at: usize) -> u64 {
    u64::from_le_bytes(field(bytes, at))
}
