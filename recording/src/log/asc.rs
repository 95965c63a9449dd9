//! Vector's ASCII log, `.asc`: a header, then an event per line, of which data frames are read:
//! `0.002367 1  390x  Rx  d 8 17 00 14 00 C0 00 08 00`.

use std::io::BufRead;

use super::{CLASSIC_BYTES, Counts, DATA_BYTES, Frame, Lines, Sink, fits, on, seconds_to_ns};
use crate::error::{Error, Kind, Place, Result, quoted};

/// Reads a log; times count from the start of its measurement. Counted is what is on `wanted`.
pub fn read(
    source: &str,
    wanted: Option<&str>,
    reader: impl BufRead,
    sink: &mut Sink<'_>,
) -> Result<Counts> {
    let mut counts = Counts::default();
    let mut header = Header::default();
    let mut last_ns = 0_i64;
    let mut lines = Lines::new(source, reader);
    while let Some((number, line, ended)) = lines.next()? {
        // Events begin with their time, everything else with a word or a comment mark.
        if !line.starts_with(|first: char| first.is_ascii_digit()) {
            header.line(line);
            continue;
        }
        // Half a byte looks like a smaller one.
        if !ended {
            counts.cut += 1;
            continue;
        }
        let Some(radix) = header.radix else {
            return Err(Error::new(
                Kind::Format,
                source,
                Place::line(number),
                quoted(line),
                "a header with \"base hex\" or \"base dec\" before the first event",
            ));
        };
        let mut event = Event {
            source,
            number,
            fields: line.split_ascii_whitespace(),
            field: 0,
        };
        let time = event.next();
        let time_ns = seconds_to_ns(time)
            .and_then(|ns| {
                if header.relative {
                    last_ns.checked_add(ns)
                } else {
                    Some(ns)
                }
            })
            .ok_or_else(|| event.fault(time, "a time in seconds"))?;
        last_ns = time_ns;
        match event.frame(radix)? {
            Read::Data {
                bus,
                id,
                extended,
                length,
                data,
                fd,
            } => {
                counts.frames += 1;
                counts.fd += u64::from(fd) * on(wanted, bus);
                sink(&Frame {
                    time_ns,
                    bus,
                    id,
                    extended,
                    length,
                    data,
                    place: Place::line(number),
                })?;
            }
            Read::Remote(bus) => counts.remote += on(wanted, bus),
            Read::Error(bus) => counts.errors += on(wanted, bus),
            Read::Other(None) => counts.others += 1,
            Read::Other(Some(bus)) => counts.others += on(wanted, bus),
        }
    }
    if header.radix.is_none() {
        return Err(Error::new(
            Kind::Format,
            source,
            Place::default(),
            "no header",
            "\"base hex\" or \"base dec\" in one of the first lines",
        ));
    }
    Ok(counts)
}

/// What the header says of the events.
#[derive(Default)]
struct Header {
    radix: Option<u32>,
    /// Each time counts from the event before.
    relative: bool,
}

impl Header {
    fn line(&mut self, line: &str) {
        let mut words = line.split_ascii_whitespace().map(str::to_ascii_lowercase);
        if words.next().as_deref() != Some("base") {
            return;
        }
        self.radix = match words.next().as_deref() {
            Some("hex") => Some(16),
            Some("dec") => Some(10),
            _ => self.radix,
        };
        if words.next().as_deref() == Some("timestamps") {
            self.relative = words.next().as_deref() == Some("relative");
        }
    }
}

/// The fields of a line that begins with a time.
struct Event<'a> {
    source: &'a str,
    number: u64,
    fields: std::str::SplitAsciiWhitespace<'a>,
    field: usize,
}

enum Read<'a> {
    Data {
        bus: &'a str,
        id: u32,
        extended: bool,
        length: usize,
        data: [u8; DATA_BYTES],
        fd: bool,
    },
    Remote(&'a str),
    Error(&'a str),
    /// Some name no bus.
    Other(Option<&'a str>),
}

impl<'a> Event<'a> {
    fn next(&mut self) -> &'a str {
        self.field += 1;
        self.fields.next().unwrap_or_default()
    }

    fn frame(&mut self, radix: u32) -> Result<Read<'a>> {
        let bus = self.next();
        if bus == "CANFD" {
            return self.fd_frame(radix);
        }
        if !bus.bytes().all(|byte| byte.is_ascii_digit()) {
            return Ok(Read::Other(None));
        }
        let identifier = self.next();
        if identifier.eq_ignore_ascii_case("errorframe") {
            return Ok(Read::Error(bus));
        }
        let id_field = self.field;
        let direction = self.next();
        if !direction.eq_ignore_ascii_case("rx") && !direction.eq_ignore_ascii_case("tx") {
            // Statistics, transmit requests, transport protocols.
            return Ok(Read::Other(Some(bus)));
        }
        let (id, extended) = self.identifier(identifier, id_field, radix)?;
        let kind = self.next();
        if kind.eq_ignore_ascii_case("r") {
            return Ok(Read::Remote(bus));
        }
        if !kind.eq_ignore_ascii_case("d") {
            return Err(self.fault(kind, "d for data or r for a remote frame"));
        }
        let code = self.next();
        // Codes 9 to 15 stand for eight bytes as well (ISO 11898-1).
        let length = number(code, radix)
            .filter(|&code| code <= 15)
            .map(|code| (code as usize).min(CLASSIC_BYTES))
            .ok_or_else(|| self.fault(code, "a length code of 0 to 15"))?;
        let data = self.data(length, radix)?;
        Ok(Read::Data {
            bus,
            id,
            extended,
            length,
            data,
            fd: false,
        })
    }

    /// `0.1 CANFD 1 Rx 123 Name 1 0 9 12 …`: the name may be left out; then two flags, length code and length, data,
    /// duration, length in bits and flags.
    fn fd_frame(&mut self, radix: u32) -> Result<Read<'a>> {
        const REMOTE: u32 = 0x10;
        const FD: u32 = 0x1000;
        let (bus, _direction, identifier) = (self.next(), self.next(), self.next());
        if identifier.eq_ignore_ascii_case("errorframe") {
            return Ok(Read::Error(bus));
        }
        let (id, extended) = self.identifier(identifier, self.field, radix)?;
        if !matches!(self.next(), "0" | "1") {
            let switched = self.next();
            if !matches!(switched, "0" | "1") {
                return Err(self.fault(switched, "0 or 1 for the bit rate switch"));
            }
        }
        let (_indicator, _code) = (self.next(), self.next());
        let text = self.next();
        let length = number(text, 10)
            .and_then(|length| usize::try_from(length).ok())
            .filter(|&length| length <= DATA_BYTES)
            .ok_or_else(|| self.fault(text, "a length of 0 to 64"))?;
        let data = self.data(length, radix)?;
        let (_duration, _bits) = (self.next(), self.next());
        let flags = number(self.next(), 16);
        if flags.is_some_and(|flags| flags & REMOTE != 0) {
            return Ok(Read::Remote(bus));
        }
        Ok(Read::Data {
            bus,
            id,
            extended,
            length,
            data,
            fd: flags.is_none_or(|flags| flags & FD != 0) || length > CLASSIC_BYTES,
        })
    }

    fn identifier(&mut self, text: &str, field: usize, radix: u32) -> Result<(u32, bool)> {
        let (digits, extended) = match text.strip_suffix(['x', 'X']) {
            Some(digits) => (digits, true),
            None => (text, false),
        };
        let id = number(digits, radix).filter(|&id| fits(id, extended));
        let id = id.ok_or_else(|| {
            self.field = field;
            self.fault(text, "an identifier of 11 bits, or of 29 and an x")
        })?;
        Ok((id, extended))
    }

    fn data(&mut self, length: usize, radix: u32) -> Result<[u8; DATA_BYTES]> {
        let mut data = [0; DATA_BYTES];
        for byte in &mut data[..length] {
            let text = self.next();
            *byte = number(text, radix)
                .and_then(|value| u8::try_from(value).ok())
                .ok_or_else(|| self.fault(text, "a byte"))?;
        }
        Ok(data)
    }

    fn fault(&self, found: &str, expected: &str) -> Error {
        let place = Place {
            line: Some(self.number),
            column: Some(self.field),
            ..Place::default()
        };
        Error::new(Kind::Format, self.source, place, quoted(found), expected)
    }
}

/// Digits without a sign.
fn number(text: &str, radix: u32) -> Option<u32> {
    if text.starts_with('+') {
        return None;
    }
    u32::from_str_radix(text, radix).ok()
}
