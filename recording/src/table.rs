//! Columns of numbers by name.

use std::collections::HashSet;

use crate::{
    error::{Error, Kind, Place, Result, listed, quoted},
    mapping::Mapping,
    name,
    output::Columns,
    series::Recording,
    unit::{self, ONE, Scale, Unit},
};

/// Columns of equal length, NaN where a value is missing. A table need not have time: an OCV curve has none.
#[derive(Clone, Debug)]
pub struct Table {
    source: String,
    columns: Vec<Column>,
    /// Empty if row `n` is simply row `n + 1` of its file.
    lines: Lines,
    /// Columns of the file that hold no numbers.
    left_out: Vec<LeftOut>,
    /// What was read otherwise than it stands in the file.
    notes: Vec<String>,
}

/// A column that is in the file and cannot be read as numbers: no fault, unless somebody needs it.
#[derive(Clone, Debug)]
pub(crate) struct LeftOut {
    pub name: String,
    /// What to say then.
    pub error: Error,
}

/// The line of each row, from 1. Rows mostly stand line by line: each run of such rows is held by its first row and that row's
/// line.
#[derive(Clone, Debug, Default)]
pub(crate) struct Lines {
    runs: Vec<(usize, u64)>,
}

impl Lines {
    /// Says where the next row (from 0) stands.
    pub(crate) fn push(&mut self, row: usize, line: u64) {
        let follows = self
            .runs
            .last()
            .is_some_and(|(first, of_first)| of_first + (row - first) as u64 == line);
        if !follows {
            self.runs.push((row, line));
        }
    }

    fn line(&self, row: usize) -> Option<u64> {
        let run = self.runs.partition_point(|(first, _)| *first <= row);
        let (first, line) = self.runs.get(run.checked_sub(1)?)?;
        Some(line + (row - first) as u64)
    }
}

#[derive(Clone, Debug)]
struct Column {
    name: String,
    /// Its name in the file, where its unit's ending was added to it.
    bare: Option<String>,
    /// What its numbers are in, where that is known from more than its name.
    unit: Option<&'static str>,
    /// Position in its file, from 0.
    position: usize,
    values: Vec<f64>,
}

impl Table {
    /// A table that was not read from a file with lines; `source` is what messages call it.
    pub fn new(source: impl Into<String>, columns: Vec<(String, Vec<f64>)>) -> Result<Self> {
        Self::with_lines(source, columns, Lines::default())
    }

    /// A table with the line of each row.
    pub(crate) fn with_lines(
        source: impl Into<String>,
        columns: Vec<(String, Vec<f64>)>,
        lines: Lines,
    ) -> Result<Self> {
        let source = source.into();
        let header = |kind, found: String, expected: &str| {
            Err(Error::new(
                kind,
                source.as_str(),
                Place::default(),
                found,
                expected,
            ))
        };
        let mut seen = HashSet::new();
        let rows = columns.first().map_or(0, |(_, values)| values.len());
        for (name, values) in &columns {
            if name.is_empty() {
                return header(
                    Kind::ColumnName,
                    "a column without a name".into(),
                    "a name for each column",
                );
            }
            if !seen.insert(name.as_str()) {
                return header(
                    Kind::ColumnName,
                    format!("column {} twice", quoted(name)),
                    "each name once",
                );
            }
            if values.len() != rows {
                return header(
                    Kind::FieldCount,
                    format!("{} values in column {}", values.len(), quoted(name)),
                    &format!("{rows} as in the first column"),
                );
            }
        }
        if rows == 0 {
            return header(Kind::Empty, "no rows".into(), "at least one row of numbers");
        }
        let columns = columns
            .into_iter()
            .enumerate()
            .map(|(position, (name, values))| Column {
                name,
                bare: None,
                unit: None,
                position,
                values,
            })
            .collect();
        Ok(Self {
            source,
            columns,
            lines,
            left_out: Vec::new(),
            notes: Vec::new(),
        })
    }

    /// With what else the file has. `positions` are those of the columns in it, from 0.
    pub(crate) fn with_left_out(mut self, positions: &[usize], left_out: Vec<LeftOut>) -> Self {
        for (column, position) in self.columns.iter_mut().zip(positions) {
            column.position = *position;
        }
        self.left_out = left_out;
        self
    }

    /// The columns at these positions (from 0) are in s, whatever the file says.
    pub(crate) fn in_seconds(mut self, positions: &[usize]) -> Self {
        for column in &mut self.columns {
            if positions.contains(&column.position) {
                column.unit = Some("s");
            }
        }
        self
    }

    /// With the units that a line of the file has for its columns: their numbers become those of ours, and their names end in it.
    pub(crate) fn in_units(mut self, line: u64, units: &[Option<Unit>]) -> Self {
        let mut told = Vec::new();
        let mut taken: HashSet<String> = self.names().map(str::to_owned).collect();
        for column in &mut self.columns {
            let (None, Some(Some(unit))) = (column.unit, units.get(column.position)) else {
                continue;
            };
            column.unit = Some(unit.symbol);
            if unit.scale != ONE {
                column.scale(unit.scale);
                told.push(format!("{} {}", column.name, unit.scale));
            }
            let name = unit::column_name(&column.name, Some(*unit));
            if taken.insert(name.clone()) {
                column.bare = Some(std::mem::replace(&mut column.name, name));
            }
        }
        if !told.is_empty() {
            self.note(format!("in the units of line {line}: {}", told.join(", ")));
        }
        self
    }

    /// Adds what was read otherwise than it stands in the file.
    pub(crate) fn note(&mut self, note: String) {
        self.notes.push(note);
    }

    /// What was read otherwise than it stands in the file: lines above the names, units, encodings. Nothing of a canonical file.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// Columns that are in the file but hold no numbers, each with the reason.
    pub fn left_out(&self) -> Vec<String> {
        let all = self.left_out.iter();
        all.map(|left| {
            let place = left.error.place();
            let at = match (place.line, place.row) {
                (Some(line), _) => format!(" in line {line}"),
                (None, Some(row)) => format!(" in row {row}"),
                _ => String::new(),
            };
            format!("{} ({}{at})", left.name, left.error.found())
        })
        .collect()
    }

    /// Refuses a table that has one of these columns, but without numbers. A column that is not there is no fault.
    pub fn refuse_left_out<'a>(&self, names: impl IntoIterator<Item = &'a str>) -> Result<()> {
        names
            .into_iter()
            .find_map(|name| self.left_out.iter().find(|left| left.name == name))
            .map_or(Ok(()), |left| Err(left.error.clone()))
    }

    /// The file it came from, as messages name it.
    pub fn source(&self) -> &str {
        &self.source
    }

    /// Names of the columns, in their order.
    pub fn names(&self) -> impl ExactSizeIterator<Item = &str> {
        self.columns.iter().map(|column| column.name.as_str())
    }

    /// The columns, in their order.
    pub fn columns(&self) -> impl ExactSizeIterator<Item = (&str, &[f64])> {
        self.columns
            .iter()
            .map(|column| (column.name.as_str(), column.values.as_slice()))
    }

    /// A column by its name.
    pub fn column(&self, name: &str) -> Option<&[f64]> {
        self.find(name).map(|column| column.values.as_slice())
    }

    /// A column that must be there.
    pub fn need(&self, name: &str) -> Result<&[f64]> {
        self.column(name).ok_or_else(|| self.lacks(name))
    }

    /// Number of rows, at least one.
    #[expect(clippy::len_without_is_empty, reason = "it is never empty")]
    pub fn len(&self) -> usize {
        self.columns.first().map_or(0, |column| column.values.len())
    }

    /// The line of the file that row `row` (from 0) came from, from 1; the number of the row where a file has no lines.
    pub fn line(&self, row: usize) -> u64 {
        self.lines.line(row).unwrap_or(row as u64 + 1)
    }

    /// An error that points at a value: `found` and `expected` end the sentence "found …, expected …".
    pub fn error_at(
        &self,
        kind: Kind,
        row: usize,
        name: &str,
        found: impl Into<String>,
        expected: impl Into<String>,
    ) -> Error {
        let number = Some(self.line(row));
        let has_lines = !self.lines.runs.is_empty();
        let place = Place {
            line: number.filter(|_| has_lines),
            row: number.filter(|_| !has_lines),
            offset: None,
            column: self.find(name).map(|column| column.position + 1),
            name: Some(name.to_owned()),
        };
        Error::new(kind, self.source.as_str(), place, found, expected)
    }

    /// The columns under the names that `mapping` gives them, a minus before one turning its sign; those it does not speak of keep
    /// theirs. A unit that the file states must be of the kind that the new name ends in, and is turned into it.
    pub fn mapped(mut self, mapping: &Mapping) -> Result<Self> {
        let mut columns = Vec::new();
        let mut notes = Vec::new();
        let mut taken = HashSet::new();
        for (name, from) in mapping.pairs() {
            // A column's own name may begin with a minus.
            let as_it_is = self.find(from);
            let turned = || self.find(from.strip_prefix('-')?);
            let column = as_it_is.or_else(turned).ok_or_else(|| self.lacks(from))?;
            let mut mapped = Column {
                name: name.to_owned(),
                ..column.clone()
            };
            if as_it_is.is_none() {
                // Nothing is nothing in either direction.
                mapped
                    .values
                    .iter_mut()
                    .for_each(|value| *value = 0.0 - *value);
            }
            if let Some(wanted) = name::unit(name) {
                // What is known has been turned already.
                let stated = column
                    .unit
                    .is_none()
                    .then(|| unit::stated(&column.name))
                    .flatten();
                let symbol = column.unit.or(stated.map(|stated| stated.symbol));
                if let Some(symbol) = symbol.filter(|symbol| !unit::same(wanted, symbol)) {
                    return Err(Error::new(
                        Kind::Mapping,
                        self.source.as_str(),
                        Place::default(),
                        format!("{} in {symbol}", quoted(from)),
                        format!("{wanted}, as {} ends", quoted(name)),
                    ));
                }
                if let Some(scale) = stated
                    .map(|stated| stated.scale)
                    .filter(|scale| *scale != ONE)
                {
                    mapped.scale(scale);
                    notes.push(format!("{name} is {} {scale}", quoted(from)));
                }
            }
            taken.insert(column.name.clone());
            columns.push(mapped);
        }
        let named: HashSet<&str> = mapping.pairs().map(|(name, _)| name).collect();
        columns.extend(
            std::mem::take(&mut self.columns)
                .into_iter()
                .filter(|column| {
                    !taken.contains(column.name.as_str()) && !named.contains(column.name.as_str())
                }),
        );
        columns.sort_by_key(|column| column.position);
        self.left_out
            .retain(|left| !named.contains(left.name.as_str()));
        self.columns = columns;
        self.notes.append(&mut notes);
        Ok(self)
    }

    /// Takes the values of a column in these rows (from 0) for missing ones. A column or a row that is not there is no fault.
    pub fn leave_out(&mut self, name: &str, rows: &[usize]) {
        let column = self.columns.iter_mut().find(|column| column.name == name);
        let Some(column) = column else {
            return;
        };
        for row in rows {
            if let Some(value) = column.values.get_mut(*row) {
                *value = f64::NAN;
            }
        }
    }

    /// Puts other values in the place of a column's, one for each row. Another number of them, or a column that is not there, changes
    /// nothing.
    pub fn replace(&mut self, name: &str, values: Vec<f64>) {
        let column = self.columns.iter_mut().find(|column| column.name == name);
        if let Some(column) = column.filter(|column| column.values.len() == values.len()) {
            column.values = values;
        }
    }

    /// With its time checked.
    pub fn into_recording(self) -> Result<Recording> {
        Recording::from_table(self)
    }

    fn find(&self, name: &str) -> Option<&Column> {
        let whole = self.columns.iter().find(|column| column.name == name);
        whole.or_else(|| {
            self.columns
                .iter()
                .find(|column| column.bare.as_deref() == Some(name))
        })
    }

    fn lacks(&self, name: &str) -> Error {
        let plain = name.strip_prefix('-').unwrap_or(name);
        for name in [name, plain] {
            if let Some(left) = self.left_out.iter().find(|left| left.name == name) {
                return left.error.clone();
            }
        }
        Error::new(
            Kind::ColumnMissing,
            self.source.as_str(),
            Place::default(),
            format!("the columns {}", listed(self.names())),
            format!("a column {}", quoted(name)),
        )
    }
}

impl Column {
    fn scale(&mut self, scale: Scale) {
        self.values
            .iter_mut()
            .for_each(|value| *value = scale.apply(*value));
    }
}

impl Columns for Table {
    fn names(&self) -> Vec<&str> {
        Table::names(self).collect()
    }

    fn rows(&self) -> usize {
        self.len()
    }

    fn fill(&self, column: usize, first: usize, values: &mut [f64]) {
        if let Some(column) = self.columns.get(column) {
            values.copy_from_slice(&column.values[first..first + values.len()]);
        }
    }
}
