//! A recording under the names of the model file, with its signs.

use std::ops::Range;

use recording::{
    Error, Mapping, Recording, Table, convert,
    error::{Kind, number},
};

use super::{Inputs, PAIRS, SURROUNDINGS, codes, stamps};
use crate::{failure::Failure, model::Model};

/// No reading is as large, whatever its unit: 1000 A in billionths. What is larger is memory that nothing was written to.
const NO_READING: f64 = 1000.0 * 1e9;

/// A recording as the model file and `--map` want it seen.
#[derive(Clone, Debug)]
pub struct Frame {
    recording: Recording,
    /// Names and the columns that they were given to.
    named: Vec<(String, String)>,
    /// What was taken for missing, what was spread, and what is not there.
    remarks: Vec<String>,
    /// Names that the model file gives to columns that no file has.
    absent: Vec<Absent>,
}

/// A name that the model file gives to a column that no file has.
#[derive(Clone, Debug)]
struct Absent {
    name: String,
    /// Where it says so, and what is not there.
    told: String,
}

impl Frame {
    /// A recording as it is.
    pub fn new(recording: Recording) -> Self {
        Self {
            recording,
            named: Vec::new(),
            remarks: Vec::new(),
            absent: Vec::new(),
        }
    }

    /// The file's name.
    pub fn source(&self) -> &str {
        self.recording.source()
    }

    /// Names of the columns.
    pub fn names(&self) -> Vec<&str> {
        self.recording.table().names().collect()
    }

    /// What the file itself calls a column.
    pub fn origin<'a>(&'a self, name: &'a str) -> &'a str {
        let named = self.named.iter().find(|(known, _)| known == name);
        named.map_or(name, |(_, column)| {
            column.strip_prefix('-').unwrap_or(column)
        })
    }

    /// What `--map` has to say for a column to have the other sign than it has now.
    pub fn turned(&self, name: &str) -> String {
        let named = self.named.iter().find(|(known, _)| known == name);
        let column = named.map_or(name, |(_, column)| column);
        match column.strip_prefix('-') {
            Some(plain) => format!("{name}={plain}"),
            None => format!("{name}=-{column}"),
        }
    }

    /// Whether there is such a column.
    pub fn has(&self, name: &str) -> bool {
        self.recording.column(name).is_some()
    }

    /// A column, NaN where a value is missing.
    pub fn column(&self, name: &str) -> Option<&[f64]> {
        self.recording.column(name)
    }

    /// A column that must be there.
    pub fn need(&self, name: &str) -> Result<&[f64], Failure> {
        let found = self.recording.need(name);
        found.map_err(|error| hinted(error, name, &self.absent))
    }

    /// What the model file calls by names that no file has, to be said at the end of an error; empty if that is nothing.
    pub fn absent(&self) -> String {
        let absent = self.absent.iter();
        absent.map(|absent| format!("; {}", absent.told)).collect()
    }

    /// What its reader has to know: which values were taken for missing ones, and which times for coarser than the rows.
    pub fn remarks(&self) -> &[String] {
        &self.remarks
    }

    /// What was read otherwise than it stands in the file.
    pub fn notes(&self) -> &[String] {
        self.recording.table().notes()
    }

    /// Columns that are in the file and hold no numbers, each with the reason.
    pub fn left_out(&self) -> Vec<String> {
        self.recording.table().left_out()
    }

    /// A column that would be compared or used if it held numbers is not just left out.
    fn refuse_left_out(&self, model: &Model) -> Result<(), Failure> {
        let used = used(model).into_iter().chain(["cycle"]);
        Ok(self.recording.table().refuse_left_out(used)?)
    }

    /// Numbers are readings, whatever the unit; else the first row that has none.
    fn refuse_no_reading(&self, model: &Model) -> Result<(), Failure> {
        let table = self.recording.table();
        let first = used(model)
            .into_iter()
            .filter_map(|name| {
                let values = table.column(name)?;
                let row = values.iter().position(|value| value.abs() >= NO_READING)?;
                Some((row, name, values[row]))
            })
            .min_by_key(|(row, ..)| *row);
        let Some((row, name, value)) = first else {
            return Ok(());
        };
        Err(Failure::from(table.error_at(
            Kind::NotANumber,
            row,
            name,
            number(value),
            format!(
                "a reading, less than {} in any unit, or an empty field where nothing was measured",
                number(NO_READING)
            ),
        )))
    }

    /// Time of each row in s.
    pub fn t_s(&self) -> &[f64] {
        self.recording.time_s()
    }

    /// Rows of each clock.
    pub fn clocks(&self) -> &[Range<usize>] {
        self.recording.segments()
    }
}

/// Columns that a model uses if they are there; time aside.
fn used(model: &Model) -> Vec<&str> {
    let mut used = Vec::new();
    if let Some(sensor) = &model.sensor {
        let stated = [sensor.reference.as_deref(), sensor.measured.as_deref()];
        used.extend(stated.into_iter().flatten());
        if sensor.reference.is_none() || sensor.measured.is_none() {
            used.extend(PAIRS.iter().flat_map(|(one, other)| [*one, *other]));
        }
        let charge = model.charge.as_ref();
        let counter = charge.and_then(|charge| charge.column.as_deref());
        used.push(counter.unwrap_or("q_meas_c"));
        used.extend(SURROUNDINGS);
    }
    if let Some(battery) = &model.battery {
        let current = ["i_ref_a", "i_meas_a"];
        match &battery.current {
            Some(stated) => used.push(stated),
            None => used.extend(current),
        }
        used.extend(["soc_pct", "v_cell_v", "v_pack_v", "ah_meas_ah"]);
        used.extend(SURROUNDINGS);
    }
    used
}

/// Reads the recording and, if there is one, the reference.
pub(super) fn read(model: &Model, inputs: &Inputs) -> Result<(Frame, Option<Frame>), Failure> {
    let asked = Mapping::parse(inputs.mapping.iter().map(String::as_str))?;
    let mut wanted: Vec<(String, String)> = asked
        .pairs()
        .map(|(name, column)| (name.to_owned(), column.to_owned()))
        .collect();
    let recording = convert::table(&inputs.recording)?;
    let reference = match &inputs.reference {
        Some(path) => Some(convert::table(path)?),
        None => None,
    };
    let files: Vec<&Table> = std::iter::once(&recording).chain(&reference).collect();
    let mut absent = Vec::new();
    for (name, column) in &model.columns {
        // --map is said later, so it counts.
        if asked.pairs().any(|(known, _)| known == name) {
            continue;
        }
        // One model serves files that do not all have every column; what --map asks for is meant for these.
        if files.iter().any(|table| has(table, column)) {
            wanted.push((name.clone(), column.clone()));
        } else {
            absent.push(absence(model, &files, name, column));
        }
    }
    let check = |frame: &Frame| {
        frame.refuse_left_out(model)?;
        frame.refuse_no_reading(model)
    };
    let Some(reference) = reference else {
        let frame = mapped(recording, &wanted, absent, model)?;
        check(&frame)?;
        return Ok((frame, None));
    };
    // Each name belongs to the file that has its column; if both do, the reference's to the reference and others to the recording.
    let (to_reference, rest): (Vec<_>, Vec<_>) = wanted.into_iter().partition(|(name, column)| {
        let is_reference = PAIRS.iter().any(|(reference, _)| name == reference);
        name != "t_s" && has(&reference, column) && (is_reference || !has(&recording, column))
    });
    let time: Vec<_> = rest
        .iter()
        .filter(|(name, _)| name == "t_s")
        .cloned()
        .collect();
    let time = time
        .into_iter()
        .filter(|(_, column)| reference.column(column).is_some());
    let to_reference: Vec<_> = to_reference.into_iter().chain(time).collect();
    // The model file's time may be the reference's alone.
    let is_asked = |wanted: &str| asked.pairs().any(|(name, _)| name == wanted);
    let of_recording = |(name, column): &(String, String)| {
        name != "t_s" || is_asked(name) || has(&recording, column)
    };
    let rest: Vec<_> = rest.into_iter().filter(of_recording).collect();
    let (frame, other) = (
        mapped(recording, &rest, absent.clone(), model)?,
        mapped(reference, &to_reference, absent, model)?,
    );
    check(&frame)?;
    check(&other)?;
    Ok((frame, Some(other)))
}

/// Whether a file has a column, or the one of which it is the minus, if only as one without numbers.
fn has(table: &Table, column: &str) -> bool {
    let column = column.trim();
    let names = [column, column.strip_prefix('-').unwrap_or(column)];
    // A column without numbers is refused with its own reason.
    names.iter().any(|name| table.column(name).is_some()) || table.refuse_left_out(names).is_err()
}

/// What is said of a column of the model file that no file has.
fn absence(model: &Model, files: &[&Table], name: &str, column: &str) -> Absent {
    let sources: Vec<&str> = files.iter().map(|table| table.source()).collect();
    let own = files.iter().any(|table| table.column(name).is_some());
    let instead = if own {
        format!(", whose own {name} is taken")
    } else {
        String::new()
    };
    Absent {
        name: name.to_owned(),
        told: format!(
            "{}, key columns.{name}: no column \"{column}\" in {}{instead}",
            model.source,
            sources.join(" or ")
        ),
    }
}

/// A column that is missing may be there by another name.
fn hinted(error: Error, name: &str, absent: &[Absent]) -> Failure {
    if error.kind() != Kind::ColumnMissing {
        return Failure::from(error);
    }
    let by_model = absent.iter().find(|absent| absent.name == name);
    let told = by_model
        .map(|absent| format!("; {}", absent.told))
        .unwrap_or_default();
    Failure(format!(
        "{error}; other names: --map NAME=COLUMN, or [columns] in the model file{told}"
    ))
}

/// The column that reads the same current or power as this one.
fn partner<'a>(model: &'a Model, name: &str) -> Option<&'a str> {
    let sensor = model.sensor.as_ref()?;
    let stated = (sensor.reference.as_deref(), sensor.measured.as_deref());
    let stated = match stated {
        (Some(reference), Some(measured)) => Some((reference, measured)),
        _ => None,
    };
    let mut pairs = stated.into_iter().chain(PAIRS);
    pairs.find_map(|(reference, measured)| match name {
        name if name == reference => Some(measured),
        name if name == measured => Some(reference),
        _ => None,
    })
}

fn mapped(
    table: Table,
    wanted: &[(String, String)],
    absent: Vec<Absent>,
    model: &Model,
) -> Result<Frame, Failure> {
    let mut mapping = Mapping::new();
    for (name, column) in wanted {
        mapping.add(name, column)?;
    }
    let mut table = table.mapped(&mapping)?;
    let used = used(model);
    let mut remarks = codes::leave_out(&mut table, &used, |name| partner(model, name));
    remarks.extend(stamps::single_precision(&table));
    remarks.extend(stamps::spread(&mut table, &used));
    remarks.extend(absent.iter().map(|absent| absent.told.clone()));
    let recording = table.into_recording();
    Ok(Frame {
        recording: recording.map_err(|error| hinted(error, "t_s", &absent))?,
        named: wanted.to_vec(),
        remarks,
        absent,
    })
}
