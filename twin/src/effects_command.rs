//! `twin effects`: the library.

use clap::Args;
use serde::Serialize;

use crate::effects::LIBRARY;

/// What an example of its use looks like.
const EXAMPLE: &str = "\
Examples:
  twin effects
  twin effects --json";

/// Lists the physics that a mismatch can be explained by.
#[derive(Args, Clone, Debug)]
#[command(after_help = EXAMPLE)]
pub struct Arguments {
    /// As JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Row {
    id: &'static str,
    statement: &'static str,
    equation: &'static str,
    parameters: Vec<Parameter>,
    shows: &'static str,
    looks_like: &'static [&'static str],
    separated_by: &'static str,
}

#[derive(Serialize)]
struct Parameter {
    name: &'static str,
    unit: &'static str,
    /// `null` stands for infinity, and for the value that the model file states.
    off: f64,
}

fn rows() -> Vec<Row> {
    let mut rows: Vec<Row> = Vec::new();
    for effect in LIBRARY {
        let card = effect.card();
        let row = Row {
            id: card.id,
            statement: card.statement,
            equation: card.equation,
            parameters: card
                .parameters
                .iter()
                .filter(|parameter| !parameter.internal)
                .map(|parameter| Parameter {
                    name: parameter.name,
                    unit: parameter.unit,
                    off: parameter.off,
                })
                .collect(),
            shows: card.shows,
            looks_like: card.looks_like,
            separated_by: card.separated_by,
        };
        // Of several forms of one effect the fullest.
        match rows.iter_mut().find(|known| known.id == row.id) {
            Some(known) if known.parameters.len() < row.parameters.len() => *known = row,
            Some(_) => {}
            None => rows.push(row),
        }
    }
    rows
}

/// The table.
pub fn run(arguments: &Arguments) -> String {
    let rows = rows();
    if arguments.json {
        // Plain strings and numbers: turning them into JSON cannot fail.
        return serde_json::to_string_pretty(&rows).unwrap_or_default();
    }
    let mut text = String::new();
    for row in &rows {
        let parameters: Vec<String> = row
            .parameters
            .iter()
            .map(|parameter| {
                let unit = if parameter.unit == "1" {
                    String::new()
                } else {
                    format!(" {}", parameter.unit)
                };
                let off = match parameter.off {
                    off if off == f64::INFINITY => "∞".to_owned(),
                    off if off == f64::NEG_INFINITY => "−∞".to_owned(),
                    off if off.is_nan() => "as the model file states".to_owned(),
                    off => off.to_string(),
                };
                format!("{}{unit} (off: {off})", parameter.name)
            })
            .collect();
        text.push_str(&format!(
            "{}\n  {}\n  {}\n  parameters: {}\n  shows: {}\n",
            row.id,
            row.statement,
            row.equation,
            parameters.join(", "),
            row.shows
        ));
        if !row.looks_like.is_empty() {
            text.push_str(&format!(
                "  looks like: {}; told apart by {}\n",
                row.looks_like.join(", "),
                row.separated_by
            ));
        }
    }
    text.trim_end().to_owned()
}
