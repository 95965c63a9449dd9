//! `twin explain`.

mod calibration;

use std::{
    collections::HashMap,
    fs,
    io::Write,
    path::{Path, PathBuf},
};

use clap::Args;
use recording::{
    Error,
    output::{self, Folder, WholeFile},
};

use crate::{
    explain::{self, Holdout, Options, workbench::MOST_ROWS},
    failure::Failure,
    model::{Found, Model, Shift, registry},
    prepare::{Inputs, Item, Prepared, Purpose, prepare},
    problem::Problem,
    progress::Progress,
    report::{
        data::{self, EffectReport, ParameterReport, Report, Verdict},
        format::{quantity, with_interval},
        html, json, text,
    },
};

/// What an example of its use looks like.
const EXAMPLE: &str = "\
Example:
  twin explain --model board.toml --recording drive.csv --holdout other-day.csv --out report

Writes report/report.json, report/report.html (one file, no network) and report/model.toml, the model file with the
physics that was found; report/calibration.toml where the board can correct it (one of an earlier run is removed). docs/model-file.md describes the model
file, `twin effects` lists the physics that is looked for.";
/// What is written; the last only where the board can correct something.
const FILES: [&str; 4] = [
    "report.json",
    "report.html",
    "model.toml",
    "calibration.toml",
];
/// A hold-out of which more of the changes are found in the fitted recording is a copy of it.
const COPIED: f64 = 0.9;
/// So is one with so many of them in a row: a piece of it was fitted. Coarse readings agree by chance now and then, not all along.
const COPIED_IN_A_ROW: usize = 50;
/// So many of them are compared.
const COMPARED: usize = 10_000;
/// Times of a copy may have been written anew, with another origin and fewer digits: that much they may differ by, in s.
const REWRITTEN_S: f64 = 1e-3;
/// Pairs of equal readings that are looked at to find the origin.
const ORIGIN_PAIRS: usize = 1_000_000;
/// Width of the summary where the terminal does not tell its own.
const WIDTH: usize = 100;

/// Says where a recording and the simulation disagree, and which physics was left out.
#[derive(Args, Clone, Debug)]
#[command(after_help = EXAMPLE)]
pub struct Arguments {
    /// What the simulation knows (TOML).
    #[arg(long, value_name = "FILE")]
    model: PathBuf,
    /// The recording, as CSV or Parquet.
    #[arg(long, value_name = "FILE")]
    recording: PathBuf,
    /// The reference, if another instrument logged it on its own clock.
    #[arg(long, value_name = "FILE")]
    reference: Option<PathBuf>,
    /// Another recording, never fitted, on which the result is shown. May be given several times.
    #[arg(long, value_name = "FILE")]
    holdout: Vec<PathBuf>,
    /// Folder for the results.
    #[arg(long, value_name = "FOLDER")]
    out: PathBuf,
    /// Takes an effect out of the library. May be given several times.
    #[arg(long, value_name = "EFFECT")]
    without: Vec<String>,
    /// Seed of whatever is random.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Calls a column by another name; a minus before the column turns its sign.
    #[arg(long, value_name = "NAME=COLUMN", allow_hyphen_values = true)]
    map: Vec<String>,
}

/// Explains, writes the results and returns what fits a screen.
pub fn run(arguments: &Arguments) -> Result<String, Failure> {
    for id in &arguments.without {
        if registry::find(id).is_none() {
            return Err(Failure(format!(
                "--without {id}: found no such effect, expected one of {}",
                registry::ids().join(", ")
            )));
        }
    }
    let out = &arguments.out;
    if out.exists() && !out.is_dir() {
        return Err(Failure(format!(
            "{}: found a file, expected a folder or a new name",
            out.display()
        )));
    }
    let mut read = vec![
        ("--model", arguments.model.as_path()),
        ("--recording", arguments.recording.as_path()),
    ];
    let reference = arguments.reference.iter();
    read.extend(reference.map(|path| ("--reference", path.as_path())));
    let holdout = arguments.holdout.iter();
    read.extend(holdout.map(|path| ("--holdout", path.as_path())));
    let refuse = |read: &[(&str, &Path)]| -> recording::Result<()> {
        FILES
            .iter()
            .try_for_each(|name| output::refuse_overwrite(&out.join(name), read.iter().copied()))
    };
    refuse(&read)?;
    let model = Model::read(&arguments.model)?;
    refuse(model.ocv_file().as_slice())?;
    // Whether it can be written is not found out after the work.
    let folder = Folder::make(out)?;
    for name in FILES {
        output::check(&out.join(name))?;
    }
    let reading = Progress::new(format!("reading {}", arguments.recording.display()));
    let inputs = Inputs {
        recording: arguments.recording.clone(),
        reference: arguments.reference.clone(),
        mapping: arguments.map.clone(),
    };
    let prepared = prepare(&model, &inputs, Purpose::Compare)?;
    let mut remarks = prepared.remarks.clone();
    let mut holdouts = Vec::new();
    for file in &arguments.holdout {
        let inputs = Inputs {
            recording: file.clone(),
            reference: None,
            mapping: arguments.map.clone(),
        };
        let other = prepare(&model, &inputs, Purpose::HoldOut)
            .map_err(|failure| without_reference(failure, arguments.reference.is_some()))?;
        if let Some((signal, [from_s, to_s])) = copied(&prepared, &other) {
            return Err(Failure(format!(
                "{}, column {signal}, from {from_s} to {to_s} s: found the readings of {}, expected another recording or the part of this one \
                 that is not fitted: a hold-out is never fitted",
                file.display(),
                arguments.recording.display()
            )));
        }
        let lacking = lacking(&prepared, &other, file, &arguments.recording)?;
        remarks.extend(
            other
                .remarks
                .iter()
                .chain(&lacking)
                .map(|remark| format!("{}: {remark}", file.display())),
        );
        holdouts.push(Holdout {
            file: file.clone(),
            problems: thinned(other),
        });
    }
    drop(reading);
    let problems = thinned(prepared);
    let mut explaining = Progress::new(format!("explaining {}", arguments.recording.display()));
    let options = Options {
        without: arguments.without.clone(),
        seed: arguments.seed,
    };
    let mut report = explain::explain(&problems, &holdouts, &options, &mut |share, _| {
        explaining.at(share);
    });
    drop(explaining);
    remarks.append(&mut report.remarks);
    remarks.extend(stated(&problems, report.verdict));
    report.remarks = remarks;
    report.inputs = data::Inputs {
        model: arguments.model.display().to_string(),
        recording: arguments.recording.display().to_string(),
        reference: arguments
            .reference
            .as_ref()
            .map(|path| path.display().to_string()),
        without: arguments.without.clone(),
        out: Some(out.display().to_string()),
        calibration: false,
    };
    if arguments.reference.is_some() {
        report.remarks.extend(late_beside_a_clock(&report));
    }
    let calibration = calibration::calibrate(&model, &report);
    report.inputs.calibration = calibration.text.is_some();
    report.remarks.extend(calibration.remarks);
    let elsewhere = acts_elsewhere(&report);
    report.remarks.extend(elsewhere);
    let extended = extended(&model, &report, &arguments.model, out)?;
    let [json, page, model, registers] = FILES;
    let mut files = vec![
        (json, json::render(&report)),
        (page, html::render(&report)),
        (model, extended),
    ];
    if let Some(text) = calibration.text {
        files.push((registers, text));
    }
    let removed = write(&folder, &files)?;
    let width = std::env::var("COLUMNS")
        .ok()
        .and_then(|width| width.parse().ok());
    let mut said = text::render(&report, width.unwrap_or(WIDTH))
        .trim_end()
        .to_owned();
    if let Some(path) = removed {
        said.push_str(&format!(
            "\n\nRemoved {}, of an earlier run: this one has nothing that the board could correct.",
            path.display()
        ));
    }
    Ok(said)
}

/// What a hold-out lacks of what is fitted; an error if that is all of it.
fn lacking(
    fitted: &Prepared,
    other: &Prepared,
    file: &Path,
    recording: &Path,
) -> Result<Option<String>, Failure> {
    let names = |prepared: &Prepared| -> Vec<String> {
        let items = prepared.items.iter();
        items.map(|item| item.problem.name.clone()).collect()
    };
    let (fits, has) = (names(fitted), names(other));
    let lacks: Vec<&str> = fits
        .iter()
        .filter(|name| !has.contains(name))
        .map(String::as_str)
        .collect();
    if lacks.len() == fits.len() {
        return Err(Failure(format!(
            "{}: found {} to compare, expected the column {}, which is fitted in {}: a hold-out shows what is fitted",
            file.display(),
            has.join(" and "),
            fits.join(" or "),
            recording.display()
        )));
    }
    Ok((!lacks.is_empty()).then(|| {
        format!(
            "{} is not compared there: what is found in it is not asked of this file",
            lacks.join(" and ")
        )
    }))
}

/// The problems with as many readings as fits look at: the memory of the others is free.
fn thinned(prepared: Prepared) -> Vec<Problem> {
    let problems = prepared.into_problems().into_iter();
    problems.map(|problem| problem.thinned(MOST_ROWS)).collect()
}

/// A hold-out that lacks the column of the reference, while the recording has its own in a file beside it.
fn without_reference(failure: Failure, beside: bool) -> Failure {
    match failure {
        Failure(text) if beside && text.contains("expected a column") => Failure(format!(
            "{text}: --reference belongs to --recording alone, a hold-out has its reference in a column of its own"
        )),
        other => other,
    }
}

/// The first signal of a hold-out whose readings, or those of a piece of it, are those of the fitted recording at the same times, from whatever
/// origin, and from when to when. Only those that differ from the one before are looked at: at rest two recordings may read the same.
fn copied(fitted: &Prepared, other: &Prepared) -> Option<(String, [f64; 2])> {
    other.items.iter().find_map(|item| {
        let name = &item.problem.name;
        let same = fitted.items.iter().find(|one| one.problem.name == *name)?;
        let every = changes(other, item).count().div_ceil(COMPARED).max(1);
        let some: Vec<(f64, u64)> = changes(other, item).step_by(every).collect();
        let mut known: HashMap<u64, Vec<f64>> = HashMap::new();
        for (t_s, value) in changes(fitted, same) {
            known.entry(value).or_default().push(t_s);
        }
        for times in known.values_mut() {
            times.sort_by(f64::total_cmp);
        }
        let is_there = |t_s: f64, value: u64| {
            known.get(&value).is_some_and(|times| {
                let at = times.partition_point(|known_s| *known_s < t_s - REWRITTEN_S);
                times
                    .get(at)
                    .is_some_and(|known_s| *known_s <= t_s + REWRITTEN_S)
            })
        };
        let piece = |origin_s: f64| {
            let shared: Vec<bool> = some
                .iter()
                .map(|(t_s, value)| is_there(t_s + origin_s, *value))
                .collect();
            let count = shared.iter().filter(|shared| **shared).count();
            let mut runs = shared.chunk_by(|one, next| one == next).scan(0, |at, run| {
                let from = *at;
                *at += run.len();
                Some((run[0], from..*at))
            });
            let rows = if count as f64 > COPIED * some.len() as f64 {
                Some(0..some.len())
            } else {
                runs.find_map(|(shared, run)| {
                    (shared && run.len() >= COPIED_IN_A_ROW).then_some(run)
                })
            };
            rows.map(|rows| [some[rows.start].0, some[rows.end - 1].0])
        };
        origins(&some, &known)
            .into_iter()
            .find_map(piece)
            .map(|times_s| (name.clone(), times_s))
    })
}

/// What has to be added to the times of these readings so that most of them are those that are known: nothing, or one of the
/// most frequent differences of time between equal readings.
fn origins(some: &[(f64, u64)], known: &HashMap<u64, Vec<f64>>) -> Vec<f64> {
    const TRIED: usize = 3;
    // Values that are rare tell it best, and cost least.
    let mut alike: Vec<(f64, &Vec<f64>)> = some
        .iter()
        .filter_map(|(t_s, value)| known.get(value).map(|times| (*t_s, times)))
        .collect();
    alike.sort_by_key(|(_, times)| times.len());
    let mut pairs = 0;
    let mut votes: HashMap<i64, (usize, f64)> = HashMap::new();
    for (t_s, times) in alike {
        if pairs >= ORIGIN_PAIRS {
            break;
        }
        pairs += times.len();
        for known_s in times {
            let origin_s = known_s - t_s;
            #[expect(clippy::cast_possible_truncation, reason = "saturates")]
            let cell = (origin_s / REWRITTEN_S).round() as i64;
            votes.entry(cell).or_insert((0, origin_s)).0 += 1;
        }
    }
    let mut most: Vec<(usize, f64)> = votes.into_values().collect();
    // The same order each time.
    most.sort_by(|one, other| other.0.cmp(&one.0).then(one.1.total_cmp(&other.1)));
    let most = most.into_iter().take(TRIED).map(|(_, origin_s)| origin_s);
    std::iter::once(0.0).chain(most).collect()
}

/// Time, and value to the last digit, of each reading that differs from the one before.
fn changes<'a>(prepared: &'a Prepared, item: &'a Item) -> impl Iterator<Item = (f64, u64)> + 'a {
    let observed = &item.problem.observed;
    let mut last = f64::NAN;
    (0..observed.value.len())
        .filter(|row| observed.valid[*row])
        .filter(move |row| {
            std::mem::replace(&mut last, observed.value[*row]) != observed.value[*row]
        })
        .filter_map(|row| {
            let t_s = prepared.t_s.get(*item.rows.get(row)?)?;
            Some((*t_s, observed.value[row].to_bits()))
        })
}

/// All files, or none. What an earlier run has left and this one has not written is removed, and returned.
fn write(folder: &Folder, files: &[(&str, String)]) -> Result<Option<PathBuf>, Failure> {
    let mut finished = Vec::new();
    for (name, content) in files {
        let path = folder.path().join(name);
        let mut file = WholeFile::create(&path)?;
        file.write_all(content.as_bytes())
            .map_err(|error| Error::writing(&path, &error))?;
        finished.push(file);
    }
    output::finish_all(finished)?;
    // One that an earlier run has left would not belong to this report.
    let calibration = folder.path().join("calibration.toml");
    if files.iter().all(|(name, _)| *name != "calibration.toml") && calibration.exists() {
        fs::remove_file(&calibration).map_err(|error| Error::writing(&calibration, &error))?;
        return Ok(Some(calibration));
    }
    Ok(None)
}

/// Two clocks are compared by the readings themselves: what makes these late all the same has gone into the clocks.
fn late_beside_a_clock(report: &Report) -> Vec<String> {
    let effects = report.effects.iter();
    let late = effects.filter(|effect| matches!(effect.id.as_str(), "delay" | "clock-skew"));
    late.map(|effect| {
        format!(
            "{} of {}: how late a sensor is and how its clock stands look the same; this is what is left beside what the clocks' comparison has \
             taken out, and the interval knows nothing of that",
            effect.id, effect.signal
        )
    })
    .collect()
}

/// What the model file cannot say: it has one table for an effect in all that a sensor, or a battery, reports.
fn acts_elsewhere(report: &Report) -> Vec<String> {
    let effects = report.effects.iter();
    let told = effects.filter_map(|effect| {
        let (id, signal) = (&effect.id, &effect.signal);
        let own = report.models.iter().find(|own| own.signal == *signal)?;
        let has_it = |other: &str| {
            let mut effects = report.effects.iter();
            effects.any(|effect| effect.id == *id && effect.signal == other)
        };
        let others: Vec<&str> = report
            .models
            .iter()
            .filter(|other| other.of_battery == own.of_battery)
            .map(|other| other.signal.as_str())
            .filter(|other| other != signal && !has_it(other) && !(*other == "soc_pct" && registry::of_voltage(id)))
            .collect();
        (!others.is_empty()).then(|| {
            let others = others.join(" and ");
            format!(
                "{id} was found in {signal} and not in {others}; [effects.{id}] in model.toml acts there too: for {others} leave it out"
            )
        })
    });
    told.chain(contradictions(report)).collect()
}

/// Effects that two signals of one sensor, or of one battery, have with values that contradict each other: the model file has those of
/// the first alone.
fn contradictions(report: &Report) -> impl Iterator<Item = String> {
    let of_battery = |signal: &str| {
        let model = report.models.iter().find(|model| model.signal == signal);
        model.map(|model| model.of_battery)
    };
    report.effects.iter().enumerate().filter_map(move |(at, other)| {
        let side = of_battery(&other.signal)?;
        let first = report.effects[..at]
            .iter()
            .find(|first| first.id == other.id && of_battery(&first.signal) == Some(side))?;
        let (one, two) = first
            .parameters
            .iter()
            .zip(&other.parameters)
            .find(|(one, two)| one.ci95[1] < two.ci95[0] || two.ci95[1] < one.ci95[0])?;
        let shown = |effect: &EffectReport, parameter: &ParameterReport| {
            let [value, _, _] = with_interval(parameter.value, parameter.ci95);
            format!("{} in {}", quantity(&value, &parameter.unit), effect.signal)
        };
        Some(format!(
            "{}: {} is {} and {}; model.toml has the values of {} for both: simulate the other with a model file of its own",
            other.id,
            one.name,
            shown(first, one),
            shown(other, two),
            first.signal
        ))
    })
}

/// Effects that the model file states are part of the simulation: said where something is left, for their size may have changed.
fn stated(problems: &[Problem], verdict: Verdict) -> Option<String> {
    let mut ids: Vec<&str> = Vec::new();
    for (id, _) in problems.iter().flat_map(|problem| &problem.modelled) {
        if !ids.contains(id) {
            ids.push(id);
        }
    }
    let tables: Vec<String> = ids.iter().map(|id| format!("[effects.{id}]")).collect();
    (verdict != Verdict::NoMismatch && !tables.is_empty()).then(|| {
        format!(
            "stated in the model file and kept as it is there, not looked for again: {}; where its size may have changed, take it out of the \
             model file",
            tables.join(", ")
        )
    })
}

/// The model file with what was found.
fn extended(model: &Model, report: &Report, file: &Path, out: &Path) -> Result<String, Failure> {
    let mut found: Vec<Found> = Vec::new();
    let mut shift = Shift::default();
    for fitted in &report.models {
        for (id, parameters) in &fitted.effects {
            let said = report
                .effects
                .iter()
                .find(|effect| effect.id == *id && effect.signal == fitted.signal);
            // What was fitted and then not named does not belong to the model.
            let Some(said) = said else {
                continue;
            };
            if let Some(known) = found.iter_mut().find(|known| known.id == *id) {
                let values: Vec<String> = parameters
                    .iter()
                    .map(|(name, value)| format!("{name} = {value}"))
                    .collect();
                known
                    .comment
                    .push(format!("From {}: {}.", fitted.signal, values.join(", ")));
                continue;
            }
            let mut comment = vec![
                format!(
                    "Found by twin explain in {}: {}",
                    report.inputs.recording, said.statement
                ),
                said.equation.clone(),
            ];
            for parameter in &said.parameters {
                comment.push(format!(
                    "{}: 95 % interval {} to {}",
                    parameter.name,
                    parameter.ci95[0],
                    quantity(&parameter.ci95[1].to_string(), &parameter.unit)
                ));
            }
            found.push(Found {
                id: id.clone(),
                parameters: parameters.clone(),
                comment: comment
                    .iter()
                    .map(|line| line.replace(['\n', '\r'], " "))
                    .collect(),
            });
        }
        shift.take(&fitted.nuisance, fitted.of_battery);
        shift.smooth_reference |= fitted.smooth_reference;
        shift.held_reference = shift.held_reference.or(fitted.held_reference);
        shift.current_holds = shift.current_holds.or(fitted.current_holds);
    }
    model.extended(&found, shift, file.parent().unwrap_or(Path::new("")), out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_delay_on_two_clocks_is_doubted() {
        let effect = |id: &str| EffectReport {
            id: id.to_owned(),
            signal: "i_meas_a".to_owned(),
            statement: String::new(),
            equation: String::new(),
            parameters: Vec::new(),
            held_out_gain: 0.9,
            placebo_p99: 0.1,
            by_place: None,
            equivalent_to: Vec::new(),
            separated_by: String::new(),
            consequences: Vec::new(),
        };
        let report = Report {
            effects: vec![effect("gain"), effect("delay")],
            ..Report::default()
        };
        let said = late_beside_a_clock(&report);
        assert_eq!(said.len(), 1, "{said:?}");
        assert!(said[0].starts_with("delay of i_meas_a: "), "{said:?}");
    }
}
