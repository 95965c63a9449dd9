//! The bytes of a file as text.

use std::borrow::Cow;

use encoding_rs::{UTF_16BE, UTF_16LE, WINDOWS_1252};

use crate::error::{Error, Kind, Place, Result};

/// The text without a byte order mark, and what it was written in if that is not UTF-8.
///
/// UTF-16 is told by its mark. What is neither is what Western spreadsheets and test benches write degrees and umlauts in; not so
/// if UTF-8's own stand before it, or control characters are there: that is damaged, or no text.
pub(super) fn decoded<'a>(
    source: &str,
    bytes: &'a [u8],
) -> Result<(Cow<'a, str>, Option<&'static str>)> {
    let utf_16 = match bytes {
        [0xFF, 0xFE, ..] => Some(UTF_16LE),
        [0xFE, 0xFF, ..] => Some(UTF_16BE),
        _ => None,
    };
    if let Some(encoding) = utf_16 {
        let (text, broken) = encoding.decode_with_bom_removal(bytes);
        if broken {
            return Err(Error::new(
                Kind::NotUtf8,
                source,
                Place::default(),
                "the byte order mark of UTF-16, and after it what is none",
                "whole characters (the file may be cut)",
            ));
        }
        return Ok((text, Some("UTF-16")));
    }
    let bytes = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes);
    let error = match std::str::from_utf8(bytes) {
        Ok(text) => return Ok((text.into(), None)),
        Err(error) => error,
    };
    let is_control = |byte: &u8| byte.is_ascii_control() && !matches!(byte, b'\t' | b'\n' | b'\r');
    let good = &bytes[..error.valid_up_to()];
    if good.is_ascii() && !bytes.iter().any(is_control) {
        let (text, _) = WINDOWS_1252.decode_without_bom_handling(bytes);
        return Ok((text, Some("Windows-1252")));
    }
    let line = memchr::memchr_iter(b'\n', good).count() as u64 + 1;
    let start = memchr::memrchr(b'\n', good).map_or(0, |end| end + 1);
    Err(Error::new(
        Kind::NotUtf8,
        source,
        Place::line(line),
        format!(
            "the byte {:#04x} after {} characters",
            bytes[error.valid_up_to()],
            String::from_utf8_lossy(&good[start..]).chars().count()
        ),
        "UTF-8 text",
    ))
}
