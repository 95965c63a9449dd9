//! The canonical CSV: UTF-8, one header line, comma, decimal point, a row per line, an empty field or NaN for a missing
//! value. A column with anything else in it is left out.
//!
//! Read are fields between semicolons or tabs as well, if the header has no comma, and there a decimal comma, if it is that
//! of all numbers of the file. A first line such as `sep=;`, which a spreadsheet writes for itself, says which it is.
//!
//! Lines are split here and not by a general CSV reader, because every message must name the line it is about.

use std::{
    borrow::Cow,
    collections::HashSet,
    fs,
    io::Write,
    path::{Path, PathBuf},
};

use crate::{
    error::{Error, Kind, Place, Result, quoted},
    mapping::Mapping,
    output::{Columns, WholeFile},
    series::Recording,
    table::{self, LeftOut, Table},
};

/// Reads a recording.
pub fn read(path: &Path) -> Result<Recording> {
    read_mapped(path, &Mapping::new())
}

/// Reads a recording whose columns have other names.
pub fn read_mapped(path: &Path, mapping: &Mapping) -> Result<Recording> {
    read_table(path)?.mapped(mapping)?.into_recording()
}

/// Reads a table that need not have time.
pub fn read_table(path: &Path) -> Result<Table> {
    let bytes = fs::read(path).map_err(|error| Error::reading(path, &error))?;
    parse(&path.display().to_string(), &bytes)
}

/// Reads a table from memory; `source` is what messages call it.
pub fn parse(source: &str, bytes: &[u8]) -> Result<Table> {
    let fault = |kind, place, found: String, expected: &str| {
        Error::new(kind, source, place, found, expected)
    };
    let text = text(source, bytes)?;
    let mut lines = Lines::new(text);
    let mut first = lines.next();
    let stated = match first {
        Some((line, text)) => stated_separator(source, line, text)?,
        None => None,
    };
    if stated.is_some() {
        first = lines.next();
    }
    let Some((header_line, header)) = first else {
        let found = match stated {
            Some(_) => "nothing but a separator",
            None => "an empty file",
        };
        return Err(fault(
            Kind::Empty,
            Place::default(),
            found.into(),
            "a header line",
        ));
    };
    let separator = stated.unwrap_or_else(|| separator(header));
    let names = names(source, header_line, header, separator)?;

    // Lines are of about the same length.
    let expected_rows = text.len() / (header.len().max(names.len() * 4) + 1);
    let mut columns = vec![Ok(Vec::with_capacity(expected_rows)); names.len()];
    let mut line_numbers = table::Lines::default();
    let mut decimal = Decimal::new(separator);
    for (row, (number, line)) in lines.enumerate() {
        let mut fields = Fields::new(line, separator);
        for (column, (name, values)) in names.iter().zip(&mut columns).enumerate() {
            let place = || Place::field(number, column, name);
            let field = fields.next().ok_or_else(|| {
                let fields = if column == 1 { "field" } else { "fields" };
                fault(
                    Kind::FieldCount,
                    Place::line(number),
                    format!("{column} {fields}"),
                    // No line end follows: the text ends where the line does.
                    if line.as_bytes().as_ptr_range().end == text.as_bytes().as_ptr_range().end {
                        "one for each column of the header (the last line has no end: it may be cut)"
                    } else {
                        "one for each column of the header"
                    },
                )
            })?;
            let field = field.ok_or_else(|| unclosed(source, place()))?;
            let Ok(numbers) = values else {
                continue;
            };
            match decimal.value(&field, number) {
                Ok(number) => numbers.push(number),
                Err((kind, mut expected)) => {
                    if let [_] = names.as_slice() {
                        expected.push_str(" (commas, semicolons or tabs part fields)");
                    }
                    *values = Err(fault(kind, place(), quoted(&field), &expected));
                }
            }
        }
        let more = fields.count();
        if more > 0 {
            let only = format!("one, as in line {header_line}, which is taken for the header");
            return Err(fault(
                Kind::FieldCount,
                Place::line(number),
                format!("{} fields", names.len() + more),
                // A line about the file ahead of its names; else every second column or more has a part too many.
                if let [_] = names.as_slice() {
                    &only
                } else if separator == b',' && 2 * more >= names.len() && !line.ends_with(',') {
                    "one for each column of the header (numbers with a decimal comma need semicolons between them)"
                } else {
                    "one for each column of the header"
                },
            ));
        }
        line_numbers.push(row, number);
    }
    let (mut numbers, mut positions, mut left_out) = (Vec::new(), Vec::new(), Vec::new());
    for (position, (name, values)) in names.into_iter().zip(columns).enumerate() {
        match values {
            Ok(values) => {
                numbers.push((name, values));
                positions.push(position);
            }
            Err(error) => left_out.push(LeftOut { name, error }),
        }
    }
    // Not one column of numbers: this is no recording.
    if let ([], Some(first)) = (numbers.as_slice(), left_out.first()) {
        return Err(first.error.clone());
    }
    let table = Table::with_lines(source, numbers, line_numbers)?;
    Ok(table.with_left_out(&positions, left_out))
}

/// The bytes as text, without a byte order mark.
fn text<'a>(source: &str, bytes: &'a [u8]) -> Result<&'a str> {
    if let [0xFF, 0xFE, ..] | [0xFE, 0xFF, ..] = bytes {
        return Err(Error::new(
            Kind::NotUtf8,
            source,
            Place::line(1),
            "the byte order mark of UTF-16",
            "UTF-8 text",
        ));
    }
    let bytes = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes);
    std::str::from_utf8(bytes).map_err(|error| {
        let good = &bytes[..error.valid_up_to()];
        let line = memchr::memchr_iter(b'\n', good).count() as u64 + 1;
        let start = memchr::memrchr(b'\n', good).map_or(0, |end| end + 1);
        Error::new(
            Kind::NotUtf8,
            source,
            Place::line(line),
            format!(
                "the byte {:#04x} after {} characters",
                bytes[error.valid_up_to()],
                String::from_utf8_lossy(&good[start..]).chars().count()
            ),
            "UTF-8 text",
        )
    })
}

/// What a first line such as `sep=;` says to stand between fields, if it is one.
fn stated_separator(source: &str, line: u64, text: &str) -> Result<Option<u8>> {
    let text = text.trim_end_matches('\r');
    let bare = text
        .strip_prefix('"')
        .and_then(|text| text.strip_suffix('"'));
    let text = bare.unwrap_or(text);
    let Some((key, separator)) = text.split_once('=') else {
        return Ok(None);
    };
    match (key.eq_ignore_ascii_case("sep"), separator.as_bytes()) {
        (true, &[separator @ (b',' | b';' | b'\t')]) => Ok(Some(separator)),
        // A header of one column could be called so; nobody's is.
        (true, _) => Err(Error::new(
            Kind::Unsupported,
            source,
            Place::line(line),
            quoted(text),
            "sep= with a comma, a semicolon or a tab",
        )),
        (false, _) => Ok(None),
    }
}

/// What stands between fields: a comma, or where the header has none outside of quotation marks, a semicolon or a tab.
fn separator(header: &str) -> u8 {
    let mut is_quoted = false;
    let outside = |byte: &u8| {
        is_quoted ^= *byte == b'"';
        !is_quoted
    };
    let outside: Vec<u8> = header.bytes().filter(outside).collect();
    let separators = (*b",;\t").into_iter();
    let mut found = separators.filter(|separator| outside.contains(separator));
    found.next().unwrap_or(b',')
}

fn names(source: &str, line: u64, header: &str, separator: u8) -> Result<Vec<String>> {
    let mut names: Vec<String> = Vec::new();
    let mut known = HashSet::new();
    for (column, field) in Fields::new(header, separator).enumerate() {
        let place = Place {
            line: Some(line),
            column: Some(column + 1),
            ..Place::default()
        };
        let Some(field) = field else {
            return Err(unclosed(source, place));
        };
        let name = field.trim();
        let fault = |kind, found: String, expected| {
            Err(Error::new(kind, source, place.clone(), found, expected))
        };
        if name.parse::<f64>().is_ok() {
            return fault(
                Kind::HeaderMissing,
                quoted(name),
                "a header line with a name for each column",
            );
        }
        if name.is_empty() {
            return fault(
                Kind::ColumnName,
                "an empty field".into(),
                "a name for each column",
            );
        }
        if !known.insert(name.to_owned()) {
            return fault(
                Kind::ColumnName,
                format!("{} again", quoted(name)),
                "each name once",
            );
        }
        names.push(name.to_owned());
    }
    Ok(names)
}

fn unclosed(source: &str, place: Place) -> Error {
    Error::new(
        Kind::Format,
        source,
        place,
        "a quotation mark without its partner",
        "both on one line",
    )
}

/// The decimal mark of a file.
struct Decimal {
    /// Where commas separate fields the mark is a point.
    may_be_comma: bool,
    /// Whether it is a comma, and the line that tells; a file of whole numbers has no mark.
    told: Option<(bool, u64)>,
}

impl Decimal {
    fn new(separator: u8) -> Self {
        Self {
            may_be_comma: separator != b',',
            told: None,
        }
    }

    /// A field's number; what is wrong with it, and what was expected. One mark in one file: elsewhere the other one may part
    /// thousands.
    fn value(&mut self, field: &str, line: u64) -> std::result::Result<f64, (Kind, String)> {
        let plain = |kind| {
            let hint = if is_date_or_time(field) {
                "; times are numbers, in s, whatever they count from"
            } else {
                ""
            };
            (kind, format!("a number or an empty field{hint}"))
        };
        if !self.may_be_comma {
            return value(field).map_err(plain);
        }
        let is_comma = field.contains(',');
        if !is_comma && !field.contains('.') {
            return value(field).map_err(plain);
        }
        let number = if !is_comma {
            value(field)
        } else if field.contains('.') {
            Err(Kind::NotANumber)
        } else {
            value(&field.replace(',', "."))
        };
        let number = number.map_err(plain)?;
        let (told, at) = *self.told.get_or_insert((is_comma, line));
        if told != is_comma {
            let mark = if told { "comma" } else { "point" };
            let expected = format!("a decimal {mark}, as in line {at}");
            return Err((Kind::NotANumber, expected));
        }
        Ok(number)
    }
}

/// A field's number, NaN for an empty one and for NaN, as other tools write what is missing.
fn value(field: &str) -> std::result::Result<f64, Kind> {
    let field = field.trim_ascii();
    if field.is_empty() {
        return Ok(f64::NAN);
    }
    let number = field.parse::<f64>().map_err(|_| Kind::NotANumber)?;
    if number.is_infinite() {
        return Err(Kind::Infinite);
    }
    Ok(number)
}

/// Whether a field is what a clock or a calendar shows: `08:00:00.5`, `2026-03-29T00:50`, `29.03.2026`.
fn is_date_or_time(field: &str) -> bool {
    let field = field.trim_ascii();
    if !field.starts_with(|first: char| first.is_ascii_digit()) {
        return false;
    }
    // An hour or a minute, and the two digits of what follows it.
    let is_clock = field
        .as_bytes()
        .windows(4)
        .any(|part| matches!(part, [b'0'..=b'9', b':', b'0'..=b'5', b'0'..=b'9']));
    // Three groups of digits, one of them a year: those of a number in thousands have three digits.
    let is_date = ['-', '/', '.'].iter().any(|mark| {
        let groups: Vec<&str> = field.split(*mark).collect();
        let is_digits = |group: &&str| group.bytes().all(|byte| byte.is_ascii_digit());
        let years = groups.iter().filter(|group| group.len() == 4).count();
        let others = groups.iter().filter(|group| (1..=2).contains(&group.len()));
        groups.len() == 3 && groups.iter().all(is_digits) && years == 1 && others.count() == 2
    });
    is_clock || is_date
}

/// Lines with their numbers, without their ends; blank ones are left out.
struct Lines<'a> {
    rest: Option<&'a str>,
    number: u64,
}

impl<'a> Lines<'a> {
    fn new(text: &'a str) -> Self {
        Self {
            rest: Some(text),
            number: 0,
        }
    }
}

impl<'a> Iterator for Lines<'a> {
    type Item = (u64, &'a str);

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            let rest = self.rest?;
            let line = match memchr::memchr(b'\n', rest.as_bytes()) {
                Some(end) => {
                    self.rest = Some(&rest[end + 1..]);
                    &rest[..end]
                }
                None => {
                    self.rest = None;
                    rest
                }
            };
            self.number += 1;
            let line = line.strip_suffix('\r').unwrap_or(line);
            if !line.trim_ascii().is_empty() {
                return Some((self.number, line));
            }
        }
    }
}

/// The fields of a line; `None` for one whose quotation mark is not closed.
struct Fields<'a> {
    rest: Option<&'a str>,
    separator: u8,
}

impl<'a> Fields<'a> {
    fn new(line: &'a str, separator: u8) -> Self {
        Self {
            rest: Some(line),
            separator,
        }
    }

    /// A field in quotation marks, a doubled one inside stands for itself.
    fn quoted(&mut self, after_mark: &'a str) -> Option<Cow<'a, str>> {
        let mut field = String::new();
        let mut rest = after_mark;
        loop {
            let Some(mark) = memchr::memchr(b'"', rest.as_bytes()) else {
                self.rest = None;
                return None;
            };
            field.push_str(&rest[..mark]);
            rest = &rest[mark + 1..];
            if let Some(inside) = rest.strip_prefix('"') {
                field.push('"');
                rest = inside;
            } else if let Some(next) = rest.strip_prefix(char::from(self.separator)) {
                self.rest = Some(next);
                return Some(field.into());
            } else {
                self.rest = None;
                return rest.is_empty().then(|| field.into());
            }
        }
    }
}

impl<'a> Iterator for Fields<'a> {
    type Item = Option<Cow<'a, str>>;

    fn next(&mut self) -> Option<Self::Item> {
        let rest = self.rest?;
        if let Some(after_mark) = rest.strip_prefix('"') {
            return Some(self.quoted(after_mark));
        }
        let field = match memchr::memchr(self.separator, rest.as_bytes()) {
            Some(end) => {
                self.rest = Some(&rest[end + 1..]);
                &rest[..end]
            }
            None => {
                self.rest = None;
                rest
            }
        };
        Some(Some(field.into()))
    }
}

/// Writes a recording row by row. The file gets its name at `finish`; dropped before, it leaves nothing behind.
#[derive(Debug)]
pub struct Writer {
    file: WholeFile,
    names: Vec<String>,
    line: String,
    rows: u64,
}

impl Writer {
    /// Begins a file at `path` with these columns; what is there now stays until `finish`.
    pub fn create<N: AsRef<str>>(path: &Path, names: &[N]) -> Result<Self> {
        let mut writer = Self {
            file: WholeFile::create(path)?,
            names: names.iter().map(|name| name.as_ref().to_owned()).collect(),
            line: String::new(),
            rows: 0,
        };
        let mut known = HashSet::new();
        for (column, name) in writer.names.iter().enumerate() {
            let readable = !name.is_empty()
                && name.trim() == name
                && !name.contains(['\n', '\r', '\u{feff}'])
                && name.parse::<f64>().is_err()
                && known.insert(name.as_str());
            if !readable {
                return Err(Error::new(
                    Kind::ColumnName,
                    path.display().to_string(),
                    Place::default(),
                    quoted(name),
                    "names that differ, on one line, not numbers",
                ));
            }
            if column > 0 {
                writer.line.push(',');
            }
            if name.contains([',', '"', ';', '\t']) {
                writer.line.push('"');
                writer.line.push_str(&name.replace('"', "\"\""));
                writer.line.push('"');
            } else {
                writer.line.push_str(name);
            }
        }
        writer.end_line()?;
        Ok(writer)
    }

    /// One row, a value for each column; NaN is a missing one. Shortest digits that read back as the same number.
    pub fn row(&mut self, values: &[f64]) -> Result<()> {
        if values.len() != self.names.len() {
            return Err(self.fault(
                Kind::FieldCount,
                None,
                format!("{} values", values.len()),
                format!("{} as in the header", self.names.len()),
            ));
        }
        let mut digits = zmij::Buffer::new();
        for (column, &value) in values.iter().enumerate() {
            if column > 0 {
                self.line.push(',');
            }
            if value.is_nan() {
                continue;
            }
            if value.is_infinite() {
                self.line.clear();
                return Err(self.fault(
                    Kind::Infinite,
                    Some(column),
                    "an infinite value".into(),
                    "a number, or NaN for a missing one".into(),
                ));
            }
            let text = digits.format_finite(value);
            self.line.push_str(text.strip_suffix(".0").unwrap_or(text));
        }
        // One column and no value: a blank line would not be a row.
        if values.len() == 1 && self.line.is_empty() {
            self.line.push_str("\"\"");
        }
        self.rows += 1;
        self.end_line()
    }

    /// Rows written so far.
    pub fn rows(&self) -> u64 {
        self.rows
    }

    /// Where the file will be.
    pub fn path(&self) -> PathBuf {
        self.file.path().to_owned()
    }

    /// All rows are written: the file appears under its name.
    pub fn finish(self) -> Result<()> {
        self.file.finish()
    }

    /// All rows are written: the file, to get its name together with others.
    pub fn into_file(self) -> WholeFile {
        self.file
    }

    fn end_line(&mut self) -> Result<()> {
        self.line.push('\n');
        let done = self.file.write_all(self.line.as_bytes());
        self.line.clear();
        done.map_err(|error| self.file.fault(&error))
    }

    fn fault(&self, kind: Kind, column: Option<usize>, found: String, expected: String) -> Error {
        let place = Place {
            line: Some(self.rows + 2),
            row: None,
            offset: None,
            column: column.map(|column| column + 1),
            name: column.map(|column| self.names[column].clone()),
        };
        Error::new(
            kind,
            self.file.path().display().to_string(),
            place,
            found,
            expected,
        )
    }
}

/// Writes whole columns; `progress` is told the share done, 0 … 1.
pub fn write(path: &Path, columns: &dyn Columns, progress: &mut dyn FnMut(f64)) -> Result<()> {
    const BLOCK: usize = 4096;
    let names = columns.names();
    let mut writer = Writer::create(path, &names)?;
    let mut block = vec![f64::NAN; BLOCK * names.len()];
    let mut row = vec![f64::NAN; names.len()];
    let rows = columns.rows();
    for first in (0..rows).step_by(BLOCK) {
        progress(first as f64 / rows as f64);
        let length = BLOCK.min(rows - first);
        for (column, values) in block.as_chunks_mut::<BLOCK>().0.iter_mut().enumerate() {
            columns.fill(column, first, &mut values[..length]);
        }
        for index in 0..length {
            for (value, values) in row.iter_mut().zip(block.as_chunks::<BLOCK>().0) {
                *value = values[index];
            }
            writer.row(&row)?;
        }
    }
    writer.finish()
}
