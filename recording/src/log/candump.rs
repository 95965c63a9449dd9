//! The log format of `candump -L` (can-utils, `log2asc.c` and `lib.c` read the same):
//! `(1436509052.249713) can0 123#DEADBEEF`, a direction `R` or `T` may follow. A CAN FD frame has a second `#` and one
//! digit of flags before its data: `123##1DEADBEEF`.

use std::io::BufRead;

use super::{CLASSIC_BYTES, Counts, DATA_BYTES, Frame, Lines, Sink, fits, on, seconds_to_ns};
use crate::error::{Error, Kind, Place, Result, quoted};

/// Set in the identifier of an error frame (`CAN_ERR_FLAG` of linux/can.h).
const ERROR_FLAG: u32 = 0x2000_0000;

/// Reads a log; times are those of the logging computer's clock, since 1970. Counted is what is on `wanted`.
pub fn read(
    source: &str,
    wanted: Option<&str>,
    reader: impl BufRead,
    sink: &mut Sink<'_>,
) -> Result<Counts> {
    let mut counts = Counts::default();
    let mut lines = Lines::new(source, reader);
    while let Some((number, line, ended)) = lines.next()? {
        if line.is_empty() {
            continue;
        }
        // Data that end somewhere look like a shorter frame.
        if !ended {
            counts.cut += 1;
            continue;
        }
        let fault = |column: usize, found: &str, expected: &str| {
            let place = Place {
                line: Some(number),
                column: Some(column),
                ..Place::default()
            };
            Error::new(Kind::Format, source, place, quoted(found), expected)
        };
        let mut fields = line.split_ascii_whitespace();
        let time = fields.next().unwrap_or_default();
        let time_ns = time
            .strip_prefix('(')
            .and_then(|rest| rest.strip_suffix(')'))
            .and_then(seconds_to_ns)
            .ok_or_else(|| fault(1, time, "a time such as (1436509052.249713)"))?;
        let Some(bus) = fields.next() else {
            return Err(fault(2, "", "an interface such as can0"));
        };
        let frame = fields.next().unwrap_or_default();
        if let Some(more) = fields.next()
            && !matches!(more, "R" | "T" | "r" | "t")
        {
            return Err(fault(4, more, "R, T or the end of the line"));
        }
        let wrong = |expected| fault(3, frame, expected);
        let (id, data) = frame
            .split_once('#')
            .ok_or_else(|| wrong("a frame such as 123#DEADBEEF"))?;
        let extended = id.len() == 8;
        let id = id
            .bytes()
            .all(|byte| byte.is_ascii_hexdigit())
            .then_some(id)
            .filter(|id| extended || id.len() == 3)
            .and_then(|id| u32::from_str_radix(id, 16).ok())
            .ok_or_else(|| wrong("an identifier of 3 or 8 hexadecimal digits"))?;
        if extended && id & ERROR_FLAG != 0 {
            counts.errors += on(wanted, bus);
            continue;
        }
        if !fits(id, extended) {
            return Err(wrong("an identifier of 11 or 29 bits"));
        }
        let fd = data.strip_prefix('#');
        if let Some(length) = data.strip_prefix(['R', 'r']) {
            // The length that was asked for may follow, and a raw length code after `_`.
            if !length
                .bytes()
                .all(|byte| byte.is_ascii_hexdigit() || byte == b'_')
            {
                return Err(wrong("R and a length"));
            }
            counts.remote += on(wanted, bus);
            continue;
        }
        let (bytes, length) = match fd {
            Some(data) => data
                .strip_prefix(|flags: char| flags.is_ascii_hexdigit())
                .and_then(|data| bytes(data, DATA_BYTES))
                .ok_or_else(|| {
                    wrong("a digit of flags and up to 64 bytes of two hexadecimal digits after ##")
                })?,
            None => classic(data)
                .ok_or_else(|| wrong("up to eight bytes of two hexadecimal digits after #"))?,
        };
        counts.frames += 1;
        counts.fd += u64::from(fd.is_some()) * on(wanted, bus);
        sink(&Frame {
            time_ns,
            bus,
            id,
            extended,
            length,
            data: bytes,
            place: Place::line(number),
        })?;
    }
    Ok(counts)
}

/// Classic data: a raw length code `_9` … `_F` may follow eight bytes.
fn classic(text: &str) -> Option<([u8; DATA_BYTES], usize)> {
    let digits = match text.split_once('_') {
        Some((digits, code)) => {
            let valid = matches!(code.as_bytes(), [b'9' | b'A'..=b'F' | b'a'..=b'f']);
            valid.then_some(digits)?
        }
        None => text,
    };
    bytes(digits, CLASSIC_BYTES)
}

/// The data: `DE.AD` is the same as `DEAD`.
fn bytes(digits: &str, most: usize) -> Option<([u8; DATA_BYTES], usize)> {
    let mut data = [0; DATA_BYTES];
    let mut length = 0;
    let mut rest = digits;
    while !rest.is_empty() {
        let pair = rest.get(..2)?;
        if !pair.bytes().all(|byte| byte.is_ascii_hexdigit()) {
            return None;
        }
        *data[..most].get_mut(length)? = u8::from_str_radix(pair, 16).ok()?;
        length += 1;
        rest = &rest[2..];
        rest = match rest.strip_prefix('.') {
            Some("") => return None,
            Some(after) => after,
            None => rest,
        };
    }
    Some((data, length))
}
