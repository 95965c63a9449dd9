//! `twin convert`: any log or recording in the canonical form.

use std::path::PathBuf;

use clap::Args;
use recording::{
    Mapping,
    convert::{self, Converted, Format, Options},
    dbc::Database,
    output,
};

use crate::{failure::Failure, progress::Progress};

/// What an example of its use looks like.
const EXAMPLE: &str = "\
Example:
  twin convert drive.blf --dbc vehicle.dbc --out drive.csv --map i_ref_a=Shunt.Current

A signal of the DBC becomes the column <Message>.<Signal> and its unit, such as Shunt.Current_a; a time at which it was
not received leaves its field empty. Signals of this project's own board get their canonical names.
--map i_ref_a=-Shunt.Current turns the sign, for those that count charging as positive.";

/// Turns a log of CAN frames or a recording into the canonical form.
#[derive(Args, Clone, Debug)]
#[command(after_help = EXAMPLE)]
pub struct Arguments {
    /// A candump log (-L), Vector ASC or BLF, ASAM MDF 4, or a recording as CSV or Parquet.
    #[arg(value_name = "IN")]
    input: PathBuf,
    /// What the frames of a log mean.
    #[arg(long, value_name = "FILE")]
    dbc: Option<PathBuf>,
    /// The recording to write; its ending says the format: .csv or .parquet.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Calls a column, or a signal Message.Signal, by another name; a minus before it turns its sign.
    #[arg(long, value_name = "NAME=COLUMN", allow_hyphen_values = true)]
    map: Vec<String>,
    /// The bus to take where a log has several: an interface such as can0, or a channel such as 1.
    #[arg(long, value_name = "NAME")]
    bus: Option<String>,
}

/// Converts, and says in a few lines what became of it.
pub fn run(arguments: &Arguments) -> Result<String, Failure> {
    let database = arguments.dbc.as_deref().map(|path| ("--dbc", path));
    let read = [("IN", arguments.input.as_path())];
    output::refuse_overwrite(&arguments.out, read.into_iter().chain(database))?;
    let options = Options {
        database: arguments.dbc.as_deref().map(Database::read).transpose()?,
        bus: arguments.bus.clone(),
        mapping: Mapping::parse(arguments.map.iter().map(String::as_str))?,
    };
    convert::is_parquet(&arguments.out)?;
    output::check(&arguments.out)?;
    let mut reading = Progress::new(format!("reading {}", arguments.input.display()));
    let converted = convert::read(&arguments.input, &options, &mut |share| reading.at(share))?;
    drop(reading);
    let mut writing = Progress::new(format!("writing {}", arguments.out.display()));
    convert::write(&arguments.out, converted.columns(), &mut |share| {
        writing.at(share);
    })?;
    drop(writing);
    // What went down a pipe stays clean.
    if !arguments.out.is_file() {
        return Ok(String::new());
    }
    Ok(summary(arguments, &converted))
}

fn summary(arguments: &Arguments, converted: &Converted) -> String {
    let columns = converted.columns();
    let mut text = format!(
        "{}: {} rows of {} columns from {} ({})",
        arguments.out.display(),
        columns.rows(),
        columns.names().len(),
        arguments.input.display(),
        converted.format.name(),
    );
    if let Some((counts, decoded)) = &converted.counts {
        text.push_str(&format!("\n{} frames decoded", decoded.frames));
        let cut = match converted.format {
            Format::Blf => "left out: the log ends within its last object",
            _ => "left out: the log ends within its last line",
        };
        let rest = [
            (decoded.unknown, "not in the DBC"),
            (
                decoded.broken,
                "frames left out: wrong by their end-to-end check",
            ),
            (decoded.invalid, "values left out: marked as not valid"),
            (decoded.short, "too short for a signal"),
            (decoded.disordered, "put in order of time"),
            (counts.fd, "CAN FD frames in the log"),
            (counts.remote, "remote frames"),
            (counts.errors, "error frames"),
            (counts.others, "other events"),
            (counts.cut, cut),
        ];
        for (count, what) in rest {
            if count > 0 {
                text.push_str(&format!(", {count} {what}"));
            }
        }
    }
    for note in &converted.notes {
        text.push_str(&format!("\n{note}"));
    }
    if !converted.left_out.is_empty() {
        text.push_str(&format!("\nleft out: {}", converted.left_out.join(", ")));
    }
    text
}
