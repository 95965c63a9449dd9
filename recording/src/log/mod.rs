//! Logs of CAN frames as vehicle tools write them.

use std::io::{self, BufRead};

use crate::error::{Error, Kind, Place, Result, quoted};

pub mod asc;
pub mod blf;
pub mod candump;

/// Bytes of a classic CAN frame at most.
pub const CLASSIC_BYTES: usize = 8;
/// Bytes of a CAN FD frame at most.
pub const DATA_BYTES: usize = 64;

/// A data frame of a log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Frame<'a> {
    /// When, in ns, by the log's clock.
    pub time_ns: i64,
    /// The bus as the log calls it, such as `can0` or `1`.
    pub bus: &'a str,
    /// Identifier, 11 or 29 bits.
    pub id: u32,
    /// 29 bits.
    pub extended: bool,
    /// Number of data bytes.
    pub length: usize,
    /// The data; zero beyond `length`.
    pub data: [u8; DATA_BYTES],
    /// Where in the log it stands.
    pub place: Place,
}

/// What a log held besides its data frames: counted, since it carries no signals. Where one bus is asked for, what others carry
/// is in none but `frames`; an event that names no bus is of any.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Data frames.
    pub frames: u64,
    /// Of those, CAN FD frames.
    pub fd: u64,
    /// Error frames.
    pub errors: u64,
    /// Remote frames.
    pub remote: u64,
    /// Other events.
    pub others: u64,
    /// A last line without an end, or a last object or container that the file ends within: it is left out.
    pub cut: u64,
}

/// 1 for something on a bus that is asked for, to be counted; no bus asked for is any.
pub(crate) fn on(wanted: Option<&str>, bus: &str) -> u64 {
    u64::from(wanted.is_none_or(|wanted| wanted == bus))
}

/// Takes the frames of a log one by one, of every bus.
pub type Sink<'a> = dyn FnMut(&Frame<'_>) -> Result<()> + 'a;

/// Lines of a text log; bytes that are not UTF-8 (comments, month names) are replaced.
struct Lines<'a, R> {
    source: &'a str,
    reader: R,
    number: u64,
    buffer: Vec<u8>,
    text: String,
}

/// A line longer than this is not one of a log.
const LONGEST_LINE: u64 = 1 << 16;

impl<'a, R: BufRead> Lines<'a, R> {
    fn new(source: &'a str, reader: R) -> Self {
        Self {
            source,
            reader,
            number: 0,
            buffer: Vec::new(),
            text: String::new(),
        }
    }

    /// The next line with its number, without blanks around it, and whether it has an end.
    fn next(&mut self) -> Result<Option<(u64, &str, bool)>> {
        self.buffer.clear();
        self.number += 1;
        let mut limited = io::Read::take(&mut self.reader, LONGEST_LINE);
        let length = limited
            .read_until(b'\n', &mut self.buffer)
            .map_err(|error| reading(self.source, &error))?;
        if length == 0 {
            return Ok(None);
        }
        if length as u64 == LONGEST_LINE {
            return Err(Error::new(
                Kind::Format,
                self.source,
                Place::line(self.number),
                "a line of more than 65535 bytes",
                "a line of a text log",
            ));
        }
        self.text = String::from_utf8_lossy(&self.buffer).into_owned();
        let ended = self.buffer.ends_with(b"\n");
        Ok(Some((self.number, self.text.trim(), ended)))
    }
}

fn reading(source: &str, error: &io::Error) -> Error {
    Error::new(
        Kind::Io,
        source,
        Place::default(),
        quoted(&error.to_string()),
        "a file that can be read",
    )
}

/// A decimal number of seconds in ns, exactly; at most nine decimals count.
fn seconds_to_ns(text: &str) -> Option<i64> {
    let (negative, digits) = match text.strip_prefix('-') {
        Some(rest) => (true, rest),
        None => (false, text),
    };
    let (whole, fraction) = digits.split_once('.').unwrap_or((digits, ""));
    let all_digits = |text: &str| text.bytes().all(|byte| byte.is_ascii_digit());
    if whole.is_empty() || !all_digits(whole) || !all_digits(fraction) {
        return None;
    }
    let mut ns = whole.parse::<i64>().ok()?.checked_mul(1_000_000_000)?;
    let mut weight = 100_000_000;
    for digit in fraction.bytes().take(9) {
        ns = ns.checked_add(i64::from(digit - b'0') * weight)?;
        weight /= 10;
    }
    Some(if negative { -ns } else { ns })
}

/// The number of data bytes that a length code stands for (ISO 11898-1).
pub(crate) fn length_of_code(code: usize, fd: bool) -> usize {
    match code {
        ..=8 => code,
        9 if fd => 12,
        10 if fd => 16,
        11 if fd => 20,
        12 if fd => 24,
        13 if fd => 32,
        14 if fd => 48,
        _ if fd => DATA_BYTES,
        _ => CLASSIC_BYTES,
    }
}

/// Whether an identifier fits its format.
pub(crate) fn fits(id: u32, extended: bool) -> bool {
    id < if extended { 1 << 29 } else { 1 << 11 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seconds_keep_every_digit() {
        assert_eq!(
            seconds_to_ns("1436509052.249713"),
            Some(1_436_509_052_249_713_000)
        );
        assert_eq!(seconds_to_ns("0.0000000019"), Some(1));
        assert_eq!(seconds_to_ns("-1.5"), Some(-1_500_000_000));
        assert_eq!(seconds_to_ns("7"), Some(7_000_000_000));
        for wrong in ["", ".5", "1,5", "1e3", "+1", "99999999999999999999", "--1"] {
            assert_eq!(seconds_to_ns(wrong), None, "{wrong}");
        }
    }
}
