//! A recording as a file.

use std::{
    collections::HashSet,
    io::Write,
    path::{Path, PathBuf},
};

use crate::{
    error::{Error, Kind, Place, Result, quoted},
    output::{Columns, WholeFile},
};

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
