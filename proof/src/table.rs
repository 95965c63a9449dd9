//! A recording as columns of numbers; an empty field is not a number.

use std::{collections::BTreeMap, fs, path::Path};

use anyhow::{Context, Result, bail};

/// Columns by name, all of one length.
#[derive(Debug, Clone, Default)]
pub struct Table {
    /// In the order of the file.
    pub names: Vec<String>,
    columns: BTreeMap<String, Vec<f64>>,
}

impl Table {
    /// Reads a CSV with a header.
    pub fn read(path: &Path) -> Result<Self> {
        let mut reader =
            csv::Reader::from_path(path).with_context(|| format!("reading {}", path.display()))?;
        let names: Vec<String> = reader.headers()?.iter().map(str::to_owned).collect();
        let mut values = vec![Vec::new(); names.len()];
        for (row, record) in reader.records().enumerate() {
            let record = record.with_context(|| path.display().to_string())?;
            for (column, field) in values.iter_mut().zip(record.iter()) {
                column.push(if field.trim().is_empty() {
                    f64::NAN
                } else {
                    field.trim().parse().with_context(|| {
                        format!(
                            "{}, row {}: {field:?} is no number",
                            path.display(),
                            row + 1
                        )
                    })?
                });
            }
        }
        Ok(Self {
            columns: names.iter().cloned().zip(values).collect(),
            names,
        })
    }

    /// A column, if it is there.
    pub fn get(&self, name: &str) -> Option<&[f64]> {
        self.columns.get(name).map(Vec::as_slice)
    }

    /// A column that has to be there.
    pub fn column(&self, name: &str) -> Result<&[f64]> {
        match self.get(name) {
            Some(column) => Ok(column),
            None => bail!("no column {name} among {}", self.names.join(", ")),
        }
    }

    /// Rows.
    pub fn len(&self) -> usize {
        self.columns.values().next().map_or(0, Vec::len)
    }

    /// Puts a column behind the others.
    pub fn push(&mut self, name: &str, values: Vec<f64>) {
        self.names.push(name.to_owned());
        self.columns.insert(name.to_owned(), values);
    }

    /// Puts other values into a column that is there.
    pub fn replace(&mut self, name: &str, values: Vec<f64>) {
        self.columns.insert(name.to_owned(), values);
    }

    /// The rows for which `keep` holds.
    pub fn filtered(&self, keep: impl Fn(usize) -> bool) -> Self {
        let rows: Vec<usize> = (0..self.len()).filter(|row| keep(*row)).collect();
        Self {
            names: self.names.clone(),
            columns: self
                .columns
                .iter()
                .map(|(name, values)| (name.clone(), rows.iter().map(|row| values[*row]).collect()))
                .collect(),
        }
    }

    /// Writes a CSV; what is not a number becomes an empty field.
    pub fn write(&self, path: &Path) -> Result<()> {
        let mut text = self.names.join(",");
        text.push('\n');
        for row in 0..self.len() {
            let fields: Vec<String> = self
                .names
                .iter()
                .map(|name| {
                    let value = self.columns[name][row];
                    if value.is_finite() {
                        value.to_string()
                    } else {
                        String::new()
                    }
                })
                .collect();
            text.push_str(&fields.join(","));
            text.push('\n');
        }
        fs::write(path, text).with_context(|| format!("writing {}", path.display()))
    }
}
