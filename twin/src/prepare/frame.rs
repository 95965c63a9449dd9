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
    /// What was taken for missing, or spread.
    remarks: Vec<String>,
}

impl Frame {
    /// A recording as it is.
    pub fn new(recording: Recording) -> Self {
        Self {
            recording,
            named: Vec::new(),
            remarks: Vec::new(),
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
        self.recording.need(name).map_err(hinted)
    }

    /// What its reader has to know: which values were taken for missing ones, and which times for coarser than the rows.
    pub fn remarks(&self) -> &[String] {
        &self.remarks
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
    // --map is said later, so it counts.
    for (name, column) in &model.columns {
        if asked.pairs().all(|(known, _)| known != name) {
            wanted.push((name.clone(), column.clone()));
        }
    }
    let check = |frame: &Frame| {
        frame.refuse_left_out(model)?;
        frame.refuse_no_reading(model)
    };
    let recording = convert::table(&inputs.recording)?;
    let Some(reference) = &inputs.reference else {
        let frame = mapped(recording, &wanted, model)?;
        check(&frame)?;
        return Ok((frame, None));
    };
    let reference = convert::table(reference)?;
    // Each name belongs to the file that has its column; to the recording if both do.
    let (to_reference, rest): (Vec<_>, Vec<_>) = wanted.into_iter().partition(|(name, column)| {
        let has = |table: &Table| {
            let plain = column.strip_prefix('-').unwrap_or(column);
            table.column(column).is_some() || table.column(plain).is_some()
        };
        name != "t_s" && has(&reference) && !has(&recording)
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
    let (frame, other) = (
        mapped(recording, &rest, model)?,
        mapped(reference, &to_reference, model)?,
    );
    check(&frame)?;
    check(&other)?;
    Ok((frame, Some(other)))
}

/// A column that is missing may be there by another name.
fn hinted(error: Error) -> Failure {
    let hint = if error.kind() == Kind::ColumnMissing {
        "; other names: --map NAME=COLUMN, or [columns] in the model file"
    } else {
        ""
    };
    Failure(format!("{error}{hint}"))
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

fn mapped(table: Table, wanted: &[(String, String)], model: &Model) -> Result<Frame, Failure> {
    let mut mapping = Mapping::new();
    for (name, column) in wanted {
        mapping.add(name, column)?;
    }
    let mut table = table.mapped(&mapping)?;
    let used = used(model);
    let mut remarks = codes::leave_out(&mut table, &used, |name| partner(model, name));
    remarks.extend(stamps::spread(&mut table, &used));
    Ok(Frame {
        recording: table.into_recording().map_err(hinted)?,
        named: wanted.to_vec(),
        remarks,
    })
}
