//! CSV: the canonical one, and what spreadsheets, loggers and test benches write.
//!
//! Canonical is UTF-8, one header line, comma, decimal point, a row per line, an empty field or NaN for a missing value. A
//! column with anything else in it is left out.
//!
//! Read are as well: fields between semicolons or tabs, and there a decimal comma, if it is that of all numbers of the file; a
//! first line such as `sep=;`, which a spreadsheet writes for itself; lines about the file above its names; a line of units below
//! them; UTF-16 and Windows-1252; times as clocks and calendars show them.
//!
//! Lines are split here and not by a general CSV reader, because every message must name the line it is about.

mod head;
mod lines;
mod moments;
mod text;
mod values;
mod writer;

use std::{fs, path::Path};

use head::Head;
use lines::Fields;
use values::{At, Decimal, Values};
pub use writer::{Writer, write};

use crate::{
    error::{Error, Kind, Place, Result},
    mapping::Mapping,
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
    let (text, encoding) = text::decoded(source, bytes)?;
    let (head, lines) = head::find(source, &text)?;
    let Head {
        names, separator, ..
    } = &head;

    // Lines are of about the same length.
    let expected_rows =
        lines.remaining() / (names.len() * 4).max(names.concat().len() + names.len());
    let mut columns: Vec<_> = names.iter().map(|_| Values::new(expected_rows)).collect();
    let mut line_numbers = table::Lines::default();
    let mut decimal = Decimal::new(*separator);
    for (row, (line, content)) in lines.enumerate() {
        let mut fields = Fields::new(content, *separator);
        for (column, (name, values)) in names.iter().zip(&mut columns).enumerate() {
            let Some(field) = fields.next() else {
                // No line end follows: the text ends where the line does.
                let is_cut =
                    content.as_bytes().as_ptr_range().end == text.as_bytes().as_ptr_range().end;
                return Err(too_few(source, line, column, is_cut));
            };
            let Some(field) = field else {
                return Err(unclosed(source, Place::field(line, column, name)));
            };
            let at = At {
                source,
                line,
                column,
                name,
                is_alone: names.len() == 1,
            };
            values.push(&field, &mut decimal, &at);
        }
        let more = fields.count();
        if more > 0 {
            return Err(too_many(source, line, content, more, &head));
        }
        line_numbers.push(row, line);
    }

    let (mut numbers, mut positions, mut left_out) = (Vec::new(), Vec::new(), Vec::new());
    let mut times = Vec::new();
    for (position, (name, values)) in names.iter().zip(columns).enumerate() {
        if values.are_times() {
            times.push(position);
        }
        let read = values.into_numbers();
        if name.is_empty() {
            // Separators after the last column make one without a name, and nothing in it.
            if read.is_ok_and(|numbers| numbers.iter().all(|number| number.is_nan())) {
                continue;
            }
            return Err(Error::new(
                Kind::ColumnName,
                source,
                head::place_of_name(head.line, position),
                "an empty field",
                "a name for each column",
            ));
        }
        match read {
            Ok(values) => {
                numbers.push((name.clone(), values));
                positions.push(position);
            }
            Err(error) => left_out.push(LeftOut {
                name: name.clone(),
                error,
            }),
        }
    }
    // Not one column of numbers: this is no recording.
    if let ([], Some(first)) = (numbers.as_slice(), left_out.first()) {
        return Err(first.error.clone());
    }
    let mut table = Table::with_lines(source, numbers, line_numbers)?
        .with_left_out(&positions, left_out)
        .in_seconds(&times);
    if let Some(encoding) = encoding {
        table.note(format!("read as {encoding}, for it is not UTF-8"));
    }
    if head.is_below_others {
        table.note(format!(
            "the columns' names are in line {}, what stands above them is not read",
            head.line
        ));
    }
    Ok(match &head.units {
        Some((line, units)) => table.in_units(*line, units),
        None => table,
    })
}

fn too_few(source: &str, line: u64, fields: usize, is_cut: bool) -> Error {
    let plural = if fields == 1 { "" } else { "s" };
    let expected = if is_cut {
        "one for each column of the header (the last line has no end: it may be cut)"
    } else {
        "one for each column of the header"
    };
    Error::new(
        Kind::FieldCount,
        source,
        Place::line(line),
        format!("{fields} field{plural}"),
        expected,
    )
}

fn too_many(source: &str, line: u64, content: &str, more: usize, head: &Head) -> Error {
    let names = head.names.len();
    let only = format!(
        "one, as in line {}, which is taken for the header",
        head.line
    );
    // A line about the file ahead of its names; else every second column or more has a part too many.
    let expected = if names == 1 {
        &only
    } else if head.separator == b',' && 2 * more >= names && !content.ends_with(',') {
        "one for each column of the header (numbers with a decimal comma need semicolons between them)"
    } else {
        "one for each column of the header"
    };
    Error::new(
        Kind::FieldCount,
        source,
        Place::line(line),
        format!("{} fields", names + more),
        expected,
    )
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
