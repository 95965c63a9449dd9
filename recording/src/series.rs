//! A table with time.

use std::ops::Range;

use crate::{
    error::{Kind, Result, number},
    name,
    table::Table,
};

/// A table whose column `t_s` is there in each row and never runs backwards, except where `cycle` changes: each
/// operation may have a clock of its own.
#[derive(Clone, Debug)]
pub struct Recording {
    table: Table,
    segments: Vec<Range<usize>>,
}

impl Recording {
    /// A recording that was not read from a file; `source` is what messages call it.
    pub fn new(source: impl Into<String>, columns: Vec<(String, Vec<f64>)>) -> Result<Self> {
        Self::from_table(Table::new(source, columns)?)
    }

    pub(crate) fn from_table(table: Table) -> Result<Self> {
        let segments = segments(&table)?;
        Ok(Self { table, segments })
    }

    /// Time of each row, in s: finite, and non-decreasing within each of the `segments`.
    pub fn time_s(&self) -> &[f64] {
        self.table.column(name::T_S).unwrap_or_default()
    }

    /// A column by its name; NaN where a value is missing.
    pub fn column(&self, name: &str) -> Option<&[f64]> {
        self.table.column(name)
    }

    /// A column that must be there; the error names those that are.
    pub fn need(&self, name: &str) -> Result<&[f64]> {
        self.table.need(name)
    }

    /// Number of rows, at least one.
    #[expect(clippy::len_without_is_empty, reason = "it is never empty")]
    pub fn len(&self) -> usize {
        self.table.len()
    }

    /// Rows over which time does not run backwards: one range, or one for each clock where `cycle` starts a new one.
    pub fn segments(&self) -> &[Range<usize>] {
        &self.segments
    }

    /// Time that the recording covers, in s; the sum where it has several segments.
    pub fn span_s(&self) -> f64 {
        let time_s = self.time_s();
        self.segments
            .iter()
            .map(|rows| time_s[rows.end - 1] - time_s[rows.start])
            .sum()
    }

    /// The file it came from, as messages name it.
    pub fn source(&self) -> &str {
        self.table.source()
    }

    /// The columns and their lines in the file.
    pub fn table(&self) -> &Table {
        &self.table
    }

    /// Without the check of its time.
    pub fn into_table(self) -> Table {
        self.table
    }
}

fn segments(table: &Table) -> Result<Vec<Range<usize>>> {
    let time_s = table.need(name::T_S)?;
    let cycle = table.column(name::CYCLE);
    let mut segments = Vec::new();
    let mut start = 0;
    for (row, &now_s) in time_s.iter().enumerate() {
        if !now_s.is_finite() {
            let found = if now_s.is_nan() {
                "no time"
            } else {
                "an infinite time"
            };
            return Err(table.error_at(Kind::TimeMissing, row, name::T_S, found, "a time in s"));
        }
        if row == 0 || now_s >= time_s[row - 1] {
            continue;
        }
        let new_cycle = cycle.is_some_and(|cycle| differ(cycle[row - 1], cycle[row]));
        if !new_cycle {
            return Err(table.error_at(
                Kind::TimeBackwards,
                row,
                name::T_S,
                format!("{} s", number(now_s)),
                format!(
                    "a time not before the last row's {} s",
                    number(time_s[row - 1])
                ),
            ));
        }
        segments.push(start..row);
        start = row;
    }
    segments.push(start..time_s.len());
    Ok(segments)
}

/// Both are known and not the same.
fn differ(before: f64, after: f64) -> bool {
    before != after && !before.is_nan() && !after.is_nan()
}
