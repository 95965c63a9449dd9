//! `twin simulate`.

use std::path::PathBuf;

use clap::Args;
use recording::{Table, convert, output};

use super::board::Board;
use crate::{
    explain,
    failure::Failure,
    model::{FrontEndKind, Model},
    prepare::{Inputs, Item, Prepared, Purpose, modelled_change, prepare},
    problem::{Base, Problem, View},
    progress::Progress,
};

/// What an example of its use looks like.
const EXAMPLE: &str = "\
Example:
  twin simulate --model board.toml --recording drive.csv --out simulated.csv

Writes t_s and, under the names of the recording, what the sensor, its charge counter and the battery of the model would
have reported: as designed, and with the effects that the model file holds. A column that --map calls by another name or
turns is written under its new name and with its new sign: --map i_meas_a=-I writes i_meas_a, discharge positive.
docs/model-file.md describes the model file.";

/// Writes what the board as designed would have reported.
#[derive(Args, Clone, Debug)]
#[command(after_help = EXAMPLE)]
pub struct Arguments {
    /// What the simulation knows (TOML).
    #[arg(long, value_name = "FILE")]
    model: PathBuf,
    /// The recording that drives it, as CSV or Parquet.
    #[arg(long, value_name = "FILE")]
    recording: PathBuf,
    /// The reference, if another instrument logged it on its own clock.
    #[arg(long, value_name = "FILE")]
    reference: Option<PathBuf>,
    /// The file to write; its ending says the format: .csv or .parquet.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Calls a column by another name; a minus before the column turns its sign.
    #[arg(long, value_name = "NAME=COLUMN", allow_hyphen_values = true)]
    map: Vec<String>,
    /// Leaves readings as they are before they are rounded to the model's step: compared with a recording, they are off by
    /// one rounding and not by two.
    #[arg(long)]
    no_step: bool,
}

/// How readings are written whose sensor has a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Readings {
    /// In steps, as they are reported.
    Stepped,
    /// As they are before that.
    Unrounded,
}

/// Simulates, and says in a few lines what was written.
pub fn run(arguments: &Arguments) -> Result<String, Failure> {
    convert::is_parquet(&arguments.out)?;
    let reference = arguments.reference.as_deref();
    let read = [
        ("--model", arguments.model.as_path()),
        ("--recording", arguments.recording.as_path()),
    ];
    let reference = reference.map(|path| ("--reference", path));
    output::refuse_overwrite(&arguments.out, read.into_iter().chain(reference))?;
    let model = Model::read(&arguments.model)?;
    output::refuse_overwrite(&arguments.out, model.ocv_file())?;
    output::check(&arguments.out)?;
    let inputs = Inputs {
        recording: arguments.recording.clone(),
        reference: arguments.reference.clone(),
        mapping: arguments.map.clone(),
    };
    let progress = Progress::new(format!("simulating {}", arguments.recording.display()));
    let prepared = prepare(&model, &inputs, Purpose::Simulate)?;
    let readings = if arguments.no_step {
        Readings::Unrounded
    } else {
        Readings::Stepped
    };
    let columns = columns(&model, &prepared, readings);
    drop(progress);
    let table = Table::new(arguments.out.display().to_string(), columns)?;
    let mut writing = Progress::new(format!("writing {}", arguments.out.display()));
    convert::write(&arguments.out, &table, &mut |share| writing.at(share))?;
    drop(writing);
    if !arguments.out.is_file() {
        return Ok(String::new());
    }
    let names: Vec<&str> = table.names().skip(1).collect();
    let mut text = format!(
        "{}: {} rows of {} from {}",
        arguments.out.display(),
        table.len(),
        names.join(", "),
        arguments.recording.display()
    );
    let codes = codes_stay(&model).filter(|_| arguments.no_step);
    for remark in prepared.remarks.iter().chain(&codes) {
        text.push_str(&format!("\n{remark}"));
    }
    Ok(text)
}

/// A board's readings are whole codes however they are written.
fn codes_stay(model: &Model) -> Option<String> {
    let is_board = model.sensor.as_ref()?.front_end != FrontEndKind::Pair;
    is_board.then(|| {
        "--no-step: a board's readings are its converter's codes, and its charge its meter's counts: they stay as they are"
            .to_owned()
    })
}

/// Time and the simulated signals, one row for each of the recording.
pub fn columns(model: &Model, prepared: &Prepared, readings: Readings) -> Vec<(String, Vec<f64>)> {
    let rows = prepared.t_s.len();
    let mut columns = vec![("t_s".to_owned(), prepared.t_s.clone())];
    let mut add = |name: &str, from: &[usize], values: &[f64]| {
        if columns.iter().any(|(known, _)| known == name) {
            return;
        }
        let mut column = vec![f64::NAN; rows];
        for (row, value) in from.iter().zip(values) {
            column[*row] = *value;
        }
        columns.push((name.to_owned(), column));
    };
    for item in &prepared.items {
        match item.problem.view {
            View::Charge => {}
            _ => add(&item.problem.name, &item.rows, &predicted(item, readings)),
        }
    }
    let sensor = prepared
        .items
        .iter()
        .find(|item| item.problem.view == View::Sensor);
    if let (Some(item), Some(charge)) = (sensor, counter(model, prepared, readings)) {
        let name = model
            .charge
            .as_ref()
            .and_then(|charge| charge.column.clone());
        add(name.as_deref().unwrap_or("q_meas_c"), &item.rows, &charge);
    }
    columns
}

/// What the simulation says at each observed row, with the effects of the model file: the one place where they are
/// applied.
pub fn predicted(item: &Item, readings: Readings) -> Vec<f64> {
    let problem = &item.problem;
    match &problem.base {
        Base::Sensor(base) if base.reading.is_empty() => {
            let mut said = if problem.modelled.is_empty() && base.alignment_s == 0.0 {
                super::unrounded(problem, base)
            } else {
                explain::predict(problem, &[])
            };
            if problem.view == View::Sensor && readings == Readings::Stepped {
                said.iter_mut()
                    .for_each(|value| *value = base.stepped(*value));
            }
            said
        }
        _ if problem.modelled.is_empty() => super::designed(problem),
        _ => explain::predict(problem, &[]),
    }
}

/// The charge counter, in C: the board's meter as designed, or the sum of the sensor's readings for a pair that says it
/// has a counter.
fn counter(model: &Model, prepared: &Prepared, readings: Readings) -> Option<Vec<f64>> {
    let item = prepared
        .items
        .iter()
        .find(|item| item.problem.view == View::Sensor)?;
    let sensor = model.sensor.as_ref()?;
    let problem = &item.problem;
    // A pair of columns whose names do not tell the unit is of a current where it has a counter of charge.
    if !matches!(problem.unit.as_str(), "A" | "1") {
        return None;
    }
    if let Some(board) = Board::new(sensor.front_end, sensor.average.unwrap_or(1)) {
        let mut charge_c = board
            .run(
                &problem.drive,
                is_held(problem),
                &problem.observed,
                item.pace,
                true,
            )
            .charge_c;
        if !problem.modelled.is_empty() {
            // What the effects add to the current, the meter counts too.
            let added = modelled_change(problem);
            charge_c
                .iter_mut()
                .zip(integral_c(problem, &added))
                .for_each(|(charge, more)| *charge += more);
        }
        return Some(charge_c);
    }
    let charge = model.charge.as_ref()?;
    let mut counted = integral_c(problem, &predicted(item, readings));
    if charge.step_c > 0.0 && readings == Readings::Stepped {
        for sum in &mut counted {
            *sum = (*sum / charge.step_c).floor() * charge.step_c;
        }
    }
    Some(counted)
}

/// Whether the reference stays at its value until its next row.
fn is_held(problem: &Problem) -> bool {
    matches!(&problem.base, Base::Sensor(base) if base.held_reference)
}

/// Charge of a current, in A, at the observed rows: straight lines between them, or held where the reference is; nothing over gaps.
fn integral_c(problem: &Problem, current_a: &[f64]) -> Vec<f64> {
    let observed = &problem.observed;
    let held = is_held(problem);
    let mut sum = 0.0;
    (0..current_a.len())
        .map(|row| {
            if row > 0 && observed.segment_of(row) == observed.segment_of(row - 1) {
                let h = observed.t_s[row] - observed.t_s[row - 1];
                let mean = if held {
                    current_a[row - 1]
                } else {
                    0.5 * (current_a[row] + current_a[row - 1])
                };
                if mean.is_finite() {
                    sum += mean * h;
                }
            }
            sum
        })
        .collect()
}
