//! What is wrong with a file, as one sentence that says where.

use std::{error, fmt, io, path::Path};

/// A result whose error names file and place.
pub type Result<T> = std::result::Result<T, Error>;

/// Longest piece of a file that a message repeats, in characters.
const SHOWN: usize = 40;

/// What kind of fault it is; the sentence itself is the error's `Display`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Kind {
    /// There is no such file.
    NotFound,
    /// The system refused to open, read or write it.
    Io,
    /// The bytes are not UTF-8.
    NotUtf8,
    /// There is nothing in it.
    Empty,
    /// The first line holds numbers instead of names.
    HeaderMissing,
    /// A column has no name, or a name stands twice.
    ColumnName,
    /// A column that is needed is not there.
    ColumnMissing,
    /// A field is not a number.
    NotANumber,
    /// A field is infinite, or too large for a 64-bit number.
    Infinite,
    /// A row has no time.
    TimeMissing,
    /// Time runs backwards.
    TimeBackwards,
    /// A row has too few or too many fields, or columns differ in length.
    FieldCount,
    /// The file breaks the rules of its format.
    Format,
    /// The file is right, but uses what is not read here.
    Unsupported,
    /// A name mapping that cannot be followed.
    Mapping,
    /// The file to be written is one that is read.
    Overwrites,
}

/// Where in a file.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash)]
pub struct Place {
    /// Line, from 1.
    pub line: Option<u64>,
    /// Row or record, from 1, where the format has no lines.
    pub row: Option<u64>,
    /// Byte, from 0, where the format has no lines.
    pub offset: Option<u64>,
    /// Column, from 1.
    pub column: Option<usize>,
    /// The column's name.
    pub name: Option<String>,
}

impl Place {
    /// A whole line.
    pub fn line(line: u64) -> Self {
        Self {
            line: Some(line),
            ..Self::default()
        }
    }

    /// A whole row or record.
    pub fn row(row: u64) -> Self {
        Self {
            row: Some(row),
            ..Self::default()
        }
    }

    /// A byte of a binary file.
    pub fn offset(offset: u64) -> Self {
        Self {
            offset: Some(offset),
            ..Self::default()
        }
    }

    /// A column (from 0) of a line.
    pub fn field(line: u64, column: usize, name: &str) -> Self {
        Self {
            line: Some(line),
            row: None,
            offset: None,
            column: Some(column + 1),
            name: Some(name.to_owned()),
        }
    }
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(line) = self.line {
            write!(f, ", line {line}")?;
        }
        if let Some(row) = self.row {
            write!(f, ", row {row}")?;
        }
        if let Some(offset) = self.offset {
            write!(f, ", byte {offset}")?;
        }
        match (self.column, &self.name) {
            (Some(column), Some(name)) => write!(f, ", column {column} ({})", shown(name)),
            (Some(column), None) => write!(f, ", column {column}"),
            (None, Some(name)) => write!(f, ", column {}", shown(name)),
            (None, None) => Ok(()),
        }
    }
}

/// A fault in a recording: file, place, what was found there and what was expected.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Error(Box<Parts>);

#[derive(Clone, Debug, PartialEq, Eq)]
struct Parts {
    kind: Kind,
    file: String,
    place: Place,
    found: String,
    expected: String,
}

impl Error {
    /// A fault at `place` of `file`: `found` and `expected` end the sentence "found …, expected …".
    pub fn new(
        kind: Kind,
        file: impl Into<String>,
        place: Place,
        found: impl Into<String>,
        expected: impl Into<String>,
    ) -> Self {
        Self(Box::new(Parts {
            kind,
            file: file.into(),
            place,
            found: found.into(),
            expected: expected.into(),
        }))
    }

    /// What the system said of a file that was to be read.
    pub fn reading(path: &Path, error: &io::Error) -> Self {
        let (kind, found) = if error.kind() == io::ErrorKind::NotFound {
            (Kind::NotFound, "no such file".to_owned())
        } else {
            (Kind::Io, format!("\"{error}\" from the system"))
        };
        Self::new(
            kind,
            path.display().to_string(),
            Place::default(),
            found,
            "a file that can be read",
        )
    }

    /// What the system said of a file that was to be written.
    pub fn writing(path: &Path, error: &io::Error) -> Self {
        Self::new(
            Kind::Io,
            path.display().to_string(),
            Place::default(),
            format!("\"{error}\" from the system"),
            "a place that can be written",
        )
    }

    /// Which kind of fault.
    pub fn kind(&self) -> Kind {
        self.0.kind
    }

    /// The file that it is in.
    pub fn file(&self) -> &str {
        &self.0.file
    }

    /// What was found there.
    pub fn found(&self) -> &str {
        &self.0.found
    }

    /// Where in the file.
    pub fn place(&self) -> &Place {
        &self.0.place
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Parts {
            file,
            place,
            found,
            expected,
            ..
        } = &*self.0;
        write!(f, "{file}{place}: found {found}, expected {expected}")
    }
}

impl error::Error for Error {}

/// A piece of a file, quoted, without control characters and not too long.
pub(crate) fn quoted(text: &str) -> String {
    format!("\"{}\"", shown(text))
}

fn shown(text: &str) -> String {
    let mut out = String::new();
    for (index, character) in text.chars().enumerate() {
        if index == SHOWN {
            out.push('…');
            break;
        }
        if character.is_control() {
            out.extend(character.escape_default());
        } else {
            out.push(character);
        }
    }
    out
}

/// A number for a message: all of its digits, and an exponent where there would be more than 15 of them or zeros for most.
pub fn number(value: f64) -> String {
    // A double has 15 digits that are surely its own.
    if value == 0.0 || !value.is_finite() || (1e-6..1e15).contains(&value.abs()) {
        value.to_string()
    } else {
        format!("{value:e}")
    }
}

/// Names in a row, for a message; many are cut off.
pub(crate) fn listed<'a>(names: impl ExactSizeIterator<Item = &'a str>) -> String {
    const NAMED: usize = 20;
    let count = names.len();
    let mut out = names.take(NAMED).map(shown).collect::<Vec<_>>().join(", ");
    if count > NAMED {
        out.push_str(&format!(" and {} more", count - NAMED));
    }
    out
}
