//! Signals that were received at times of their own, laid out as rows of one table.

use std::collections::HashSet;

use crate::{
    error::{Error, Kind, Place, Result, listed, quoted},
    mapping::Mapping,
    name,
    output::Columns,
    series::Recording,
    table::Table,
    unit,
};

/// A first row that is so long after the start of its measurement, or before it, counts from elsewhere.
const DAY_S: f64 = 86_400.0;

/// Signals with the same time stamps: those of one message, or of one group of channels.
#[derive(Clone, Debug, Default)]
pub struct Series {
    /// When, in s; non-decreasing.
    pub time_s: Vec<f64>,
    /// What.
    pub signals: Vec<Signal>,
}

/// One signal's values.
#[derive(Clone, Debug)]
pub struct Signal {
    /// Its column's name.
    pub name: String,
    /// The name before the unit's ending was added.
    pub bare: String,
    /// Its unit, where it is known.
    pub unit: Option<&'static str>,
    /// As long as the series' times; NaN where it was not received.
    pub values: Vec<f64>,
}

/// The rows: every time stamp of any series. A signal is missing in the rows at which it was not received; nothing is
/// held or interpolated. What was received more than once at the same time has as many rows of that time.
#[derive(Clone, Debug)]
pub struct Merged {
    source: String,
    time_s: Vec<f64>,
    /// For each series, the row of each of its samples; increasing.
    rows: Vec<Vec<u32>>,
    columns: Vec<Column>,
    /// What else the file has, and why it is not here.
    left_out: Vec<String>,
}

#[derive(Clone, Debug)]
struct Column {
    name: String,
    bare: String,
    unit: Option<&'static str>,
    series: usize,
    values: Vec<f64>,
    negative: bool,
}

impl Merged {
    /// Merges series; `source` is what messages call their file.
    pub fn new(source: &str, series: Vec<Series>) -> Result<Self> {
        let fault = |kind, found: String, expected: &str| {
            Error::new(kind, source, Place::default(), found, expected)
        };
        // A row is a time and how often that time has come before in its series.
        let mut keys: Vec<(f64, u32)> = series
            .iter()
            .flat_map(|series| repeats(&series.time_s))
            .collect();
        if keys.is_empty() {
            return Err(fault(
                Kind::Empty,
                "no values".into(),
                "at least one signal that the database describes",
            ));
        }
        let order = |a: &(f64, u32), b: &(f64, u32)| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1));
        keys.sort_unstable_by(order);
        keys.dedup();
        if u32::try_from(keys.len()).is_err() {
            return Err(fault(
                Kind::Unsupported,
                format!("{} time stamps", keys.len()),
                "fewer than 2^32",
            ));
        }
        let mut rows = Vec::new();
        let mut columns: Vec<Column> = Vec::new();
        let mut names = HashSet::new();
        for (index, series) in series.into_iter().enumerate() {
            let mut row = 0;
            let mut of_samples = Vec::with_capacity(series.time_s.len());
            for key in repeats(&series.time_s) {
                while keys.get(row).is_some_and(|at| order(at, &key).is_lt()) {
                    row += 1;
                }
                of_samples.push(u32::try_from(row).unwrap_or(u32::MAX));
            }
            rows.push(of_samples);
            for signal in series.signals {
                if signal.name == name::T_S || !names.insert(signal.name.clone()) {
                    return Err(fault(
                        Kind::ColumnName,
                        format!("two signals for the column {}", quoted(&signal.name)),
                        "each name once",
                    ));
                }
                columns.push(Column {
                    name: signal.name,
                    bare: signal.bare,
                    unit: signal.unit,
                    series: index,
                    values: signal.values,
                    negative: false,
                });
            }
        }
        Ok(Self {
            source: source.to_owned(),
            time_s: keys.into_iter().map(|(time_s, _)| time_s).collect(),
            rows,
            columns,
            left_out: Vec::new(),
        })
    }

    /// With times from the start of the measurement: where they do not count from there, from the first row.
    #[must_use]
    pub(crate) fn counted_from_its_start(mut self) -> Self {
        let first_s = self.time_s.first().copied().unwrap_or_default();
        if !(0.0..DAY_S).contains(&first_s) {
            self.time_s.iter_mut().for_each(|time_s| *time_s -= first_s);
        }
        self
    }

    /// With what else the file has, each as `name (reason)`: said if it is asked for.
    #[must_use]
    pub fn leaving_out(self, left_out: Vec<String>) -> Self {
        Self { left_out, ..self }
    }

    /// With the names that `mapping` gives to columns, by their whole name or by the one before the unit's ending; a
    /// minus before it turns the sign, for those that count charging as positive. The unit must be the one that the new
    /// name ends in.
    pub fn mapped(mut self, mapping: &Mapping) -> Result<Self> {
        let mut taken = HashSet::new();
        let mut columns = Vec::new();
        for (to, from) in mapping.pairs() {
            let (index, negative) = self.find(from)?;
            let column = &self.columns[index];
            let wanted = name::unit(to);
            if let (Some(wanted), Some(unit)) = (wanted, column.unit)
                && !unit::same(wanted, unit)
            {
                return Err(Error::new(
                    Kind::Mapping,
                    self.source.as_str(),
                    Place::default(),
                    format!("{} in {unit}", quoted(from)),
                    format!("{wanted}, as {} ends", quoted(to)),
                ));
            }
            taken.insert(index);
            columns.push(Column {
                name: to.to_owned(),
                negative,
                ..column.clone()
            });
        }
        let named: HashSet<&str> = mapping.pairs().map(|(name, _)| name).collect();
        columns.extend(
            std::mem::take(&mut self.columns)
                .into_iter()
                .enumerate()
                .filter(|(index, column)| {
                    !taken.contains(index) && !named.contains(column.name.as_str())
                })
                .map(|(_, column)| column),
        );
        self.columns = columns;
        Ok(self)
    }

    /// All of it in memory, with its time checked.
    pub fn recording(&self) -> Result<Recording> {
        let columns = Columns::names(self)
            .into_iter()
            .enumerate()
            .map(|(index, name)| {
                let mut values = vec![f64::NAN; self.rows()];
                self.fill(index, 0, &mut values);
                (name.to_owned(), values)
            })
            .collect();
        Table::new(self.source.as_str(), columns)?.into_recording()
    }

    fn find(&self, wanted: &str) -> Result<(usize, bool)> {
        let position = |wanted: &str| {
            let whole = self.columns.iter().position(|column| column.name == wanted);
            whole.or_else(|| self.columns.iter().position(|column| column.bare == wanted))
        };
        let negated = || wanted.strip_prefix('-').and_then(position);
        position(wanted)
            .map(|index| (index, false))
            .or_else(|| negated().map(|index| (index, true)))
            .ok_or_else(|| {
                let plain = wanted.strip_prefix('-').unwrap_or(wanted);
                let there = self.left_out.iter().find(|left| {
                    let rest = left.strip_prefix(plain);
                    rest.is_some_and(|rest| rest.starts_with(" ("))
                });
                if let Some(left) = there {
                    return Error::new(
                        Kind::ColumnMissing,
                        self.source.as_str(),
                        Place::default(),
                        left,
                        format!("numbers in {}", quoted(plain)),
                    );
                }
                let names: Vec<_> = self.columns.iter().map(|column| &*column.name).collect();
                Error::new(
                    Kind::ColumnMissing,
                    self.source.as_str(),
                    Place::default(),
                    format!("the signals {}", listed(names.into_iter())),
                    format!("a signal {}", quoted(wanted)),
                )
            })
    }
}

impl Columns for Merged {
    fn names(&self) -> Vec<&str> {
        let signals = self.columns.iter().map(|column| column.name.as_str());
        std::iter::once(name::T_S).chain(signals).collect()
    }

    fn rows(&self) -> usize {
        self.time_s.len()
    }

    fn fill(&self, column: usize, first: usize, values: &mut [f64]) {
        let Some(index) = column.checked_sub(1) else {
            values.copy_from_slice(&self.time_s[first..first + values.len()]);
            return;
        };
        values.fill(f64::NAN);
        let Some(column) = self.columns.get(index) else {
            return;
        };
        let rows = &self.rows[column.series];
        let start = rows.partition_point(|&row| (row as usize) < first);
        for (&row, &value) in rows[start..].iter().zip(&column.values[start..]) {
            let Some(place) = values.get_mut(row as usize - first) else {
                break;
            };
            // Nothing is nothing in either direction.
            *place = if column.negative { 0.0 - value } else { value };
        }
    }
}

/// Each time with the number of equal ones right before it.
fn repeats(time_s: &[f64]) -> impl Iterator<Item = (f64, u32)> {
    let mut last = f64::NAN;
    let mut count = 0;
    time_s.iter().map(move |&time_s| {
        count = if time_s == last { count + 1 } else { 0 };
        last = time_s;
        // Not two zeros.
        (time_s + 0.0, count)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_that_do_not_count_from_the_measurement_count_from_the_first_row() {
        for (recorded, expected) in [
            ([0.25, 1.25], [0.25, 1.25]),
            ([-95_385_945.5, -95_385_944.5], [0.0, 1.0]),
            ([1.7e9, 1.7e9 + 1.0], [0.0, 1.0]),
        ] {
            let signal = Signal {
                name: "x".to_owned(),
                bare: "x".to_owned(),
                unit: None,
                values: vec![1.0, 2.0],
            };
            let series = Series {
                time_s: recorded.to_vec(),
                signals: vec![signal],
            };
            let merged = Merged::new("m.mf4", vec![series]).map(Merged::counted_from_its_start);
            assert_eq!(merged.map(|merged| merged.time_s), Ok(expected.to_vec()));
        }
    }
}
