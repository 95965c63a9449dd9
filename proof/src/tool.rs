//! `twin explain` as a process of its own, and what its report says.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    process::Command,
    time::Duration,
};

use anyhow::{Context, Result, bail};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::{
    program::{self, Taken},
    stats,
    table::Table,
};

/// The program under test.
pub struct Tool {
    /// `twin`.
    pub program: PathBuf,
    /// Processors that one explanation may use.
    pub threads: usize,
}

/// A parameter as reported.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Parameter {
    /// By the library's name.
    pub name: String,
    /// Nothing if it is not finite.
    pub value: Option<f64>,
    /// 95 % interval.
    pub low: Option<f64>,
    /// Its upper end.
    pub high: Option<f64>,
}

/// An effect as reported.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Named {
    /// Of the library.
    pub id: String,
    /// Signal in which it was found.
    pub signal: String,
    /// What it could be just as well.
    pub equals: Vec<String>,
    /// With their intervals.
    pub parameters: Vec<Parameter>,
}

/// A place as reported.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Location {
    /// `abs(i)`, `temp_sensor_c`, …
    pub variable: String,
    /// Lower end.
    pub from: Option<f64>,
    /// Upper end.
    pub to: Option<f64>,
    /// Share of the mismatch's energy.
    pub energy_share: Option<f64>,
}

/// Error on what was not fitted, before and after.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct HeldOut {
    /// Of the model as designed, rms in the signal's unit.
    pub before: f64,
    /// Of the extended model.
    pub after: f64,
    /// Rows that both gave a value for.
    pub rows: usize,
}

/// What one run said.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Said {
    /// Of the report.
    pub verdict: String,
    /// In its order; one entry for each signal in which an effect was found.
    pub named: Vec<Named>,
    /// Regions only.
    pub locations: Vec<Location>,
    /// Simple forms of what is left: the first with those that it is not told apart from, by id.
    #[serde(default)]
    pub forms: Vec<String>,
    /// By column.
    pub held_out: BTreeMap<String, HeldOut>,
    /// What it took.
    pub taken: Taken,
}

/// Columns in which errors are compared, in the order in which one stands for all.
const MEASURED: [&str; 7] = [
    "i_meas_a",
    "p_meas_w",
    "v_cell_v",
    "v_pack_v",
    "q_meas_c",
    "soc_pct",
    "h_meas_a_per_m",
];

impl Said {
    /// The figure that stands for the recording.
    pub fn main_held_out(&self) -> Option<(&str, HeldOut)> {
        MEASURED.iter().find_map(|column| {
            self.held_out
                .get_key_value(*column)
                .map(|(name, figure)| (name.as_str(), *figure))
        })
    }
}

/// What is given to the tool, beside `recording.csv` and `model.toml`.
#[derive(Debug, Clone, Default)]
pub struct Given {
    /// `reference.csv` is there: the reference has a clock of its own.
    pub two_clocks: bool,
    /// Taken out of the library.
    pub without: Vec<String>,
}

/// What is held out.
const HOLDOUT: &str = "holdout.csv";
/// Of a battery: what it was driven with.
const DRIVE: &str = "drive.csv";
/// What a battery's recording reads of it.
const VOLTAGES: [&str; 2] = ["v_cell_v", "v_pack_v"];
/// And what tells of its charge beside the current.
const CHARGES: [&str; 2] = ["soc_pct", "ah_meas_ah"];

/// The file in `kept` that simulations of the held-out recording get. Of a battery it has no readings, since today's methods take none of
/// that file either; only where the model file does not state how full it begins, the first voltage, from which they take that too.
fn drive_only(kept: &Path, designed: &Path) -> Result<&'static str> {
    let text =
        fs::read_to_string(designed).with_context(|| format!("reading {}", designed.display()))?;
    let model: toml::Table = text.parse().context("model.toml")?;
    let Some(battery) = model.get("battery").and_then(toml::Value::as_table) else {
        return Ok(HOLDOUT);
    };
    let states_start = battery.contains_key("initial_soc");
    let mut reader = csv::Reader::from_path(kept.join(HOLDOUT))?;
    let names = reader.headers()?.clone();
    let is_voltage = |name: &str| VOLTAGES.contains(&name);
    let keeps = |name: &str| !(CHARGES.contains(&name) || states_start && is_voltage(name));
    let mut writer = csv::Writer::from_path(kept.join(DRIVE))?;
    writer.write_record(names.iter().filter(|name| keeps(name)))?;
    let mut seen = vec![false; names.len()];
    for record in reader.records() {
        let record = record?;
        let mut fields = Vec::new();
        for ((name, field), seen) in names.iter().zip(record.iter()).zip(&mut seen) {
            if keeps(name) {
                fields.push(if is_voltage(name) && *seen { "" } else { field });
                *seen |= !field.trim().is_empty();
            }
        }
        writer.write_record(fields)?;
    }
    writer.flush()?;
    Ok(DRIVE)
}

impl Tool {
    fn command(&self, folder: &Path) -> Command {
        let mut command = Command::new(&self.program);
        command
            .current_dir(folder)
            .env("RAYON_NUM_THREADS", self.threads.to_string());
        command
    }

    /// Explains `recording.csv` by `model.toml` in `folder`, into `folder/out`. The tool knows of no other file.
    pub fn explain(
        &self,
        folder: &Path,
        out: &str,
        given: &Given,
        limit: Duration,
    ) -> Result<Said> {
        let mut command = self.command(folder);
        command.args([
            "explain",
            "--model",
            "model.toml",
            "--recording",
            "recording.csv",
        ]);
        if given.two_clocks {
            command.args(["--reference", "reference.csv"]);
        }
        for effect in &given.without {
            command.args(["--without", effect]);
        }
        command.args(["--out", out]);
        let taken = program::run(&mut command, limit).context("twin explain")?;
        let report = folder.join(out).join("report.json");
        let text =
            fs::read_to_string(&report).with_context(|| format!("reading {}", report.display()))?;
        let mut said = read(&serde_json::from_str(&text).context("report.json")?)?;
        said.taken = taken;
        Ok(said)
    }

    /// Errors on `holdout.csv` in `kept`, of the model as designed and of the one that was found.
    pub fn held_out(
        &self,
        kept: &Path,
        designed: &Path,
        found: &Path,
        two_clocks: bool,
        limit: Duration,
    ) -> Result<BTreeMap<String, HeldOut>> {
        let recorded = Table::read(&kept.join(HOLDOUT))?;
        let drive = drive_only(kept, designed)?;
        let mut simulated = Vec::new();
        for (model, out) in [(designed, "designed.csv"), (found, "found.csv")] {
            let mut command = self.command(kept);
            // The squares of what is held out are those of one rounding, as today's methods have it.
            command.args(["simulate", "--no-step"]);
            command
                .arg("--model")
                .arg(model)
                .args(["--recording", drive, "--out", out]);
            if two_clocks {
                command.args(["--reference", "holdout-reference.csv"]);
            }
            program::run(&mut command, limit).context("twin simulate")?;
            simulated.push(Table::read(&kept.join(out))?);
            fs::remove_file(kept.join(out))?;
        }
        let mut errors = BTreeMap::new();
        for name in MEASURED {
            let (Some(truth), Some(before), Some(after)) = (
                recorded.get(name),
                simulated[0].get(name),
                simulated[1].get(name),
            ) else {
                continue;
            };
            if before.len() != truth.len() || after.len() != truth.len() {
                bail!(
                    "{name}: {} rows recorded, {} and {} simulated",
                    truth.len(),
                    before.len(),
                    after.len()
                );
            }
            let rows: Vec<usize> = (0..truth.len())
                .filter(|row| {
                    truth[*row].is_finite() && before[*row].is_finite() && after[*row].is_finite()
                })
                .collect();
            let error =
                |values: &[f64]| stats::rms(rows.iter().map(|row| values[*row] - truth[*row]));
            if let (Some(before), Some(after)) = (error(before), error(after)) {
                errors.insert(
                    name.to_owned(),
                    HeldOut {
                        before,
                        after,
                        rows: rows.len(),
                    },
                );
            }
        }
        Ok(errors)
    }
}

/// A report's effects and places.
fn read(report: &Value) -> Result<Said> {
    let verdict = report["verdict"]
        .as_str()
        .context("report.json has no verdict")?
        .to_owned();
    let number = |value: &Value| value.as_f64();
    let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
    let list = |value: &Value| value.as_array().cloned().unwrap_or_default();
    let named = list(&report["effects"])
        .iter()
        .map(|effect| Named {
            id: text(&effect["id"]),
            signal: text(&effect["signal"]),
            equals: list(&effect["equivalent_to"]).iter().map(text).collect(),
            parameters: list(&effect["parameters"])
                .iter()
                .map(|one| Parameter {
                    name: text(&one["name"]),
                    value: number(&one["value"]),
                    low: number(&one["ci95"][0]),
                    high: number(&one["ci95"][1]),
                })
                .collect(),
        })
        .collect();
    let locations = list(&report["locations"])
        .iter()
        .filter(|place| place["kind"] == "region")
        .map(|place| Location {
            variable: text(&place["variable"]),
            from: number(&place["from"]),
            to: number(&place["to"]),
            energy_share: number(&place["energy_share"]),
        })
        .collect();
    let forms = list(&report["unexplained"])
        .iter()
        .map(|left| &left["form"])
        .filter(|form| !form.is_null())
        .flat_map(|form| {
            let others = list(&form["equivalent_to"]);
            std::iter::once(text(&form["id"]))
                .chain(others.iter().map(|other| text(&other["id"])))
                .collect::<Vec<_>>()
        })
        .collect();
    Ok(Said {
        verdict,
        named,
        locations,
        forms,
        ..Said::default()
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    #[test]
    fn a_held_out_battery_is_simulated_from_what_drives_it() {
        let folder = tempfile::tempdir().unwrap();
        let (kept, model) = (folder.path(), folder.path().join("model.toml"));
        let table = "t_s,i_ref_a,v_cell_v,temp_cell_c,ah_meas_ah\n0,1,,25,0\n1,2,3.9,25,0.1\n2,3,3.8,26,0.2\n";
        fs::write(kept.join(HOLDOUT), table).unwrap();
        let told = |text: &str| {
            fs::write(&model, text).unwrap();
            let file = drive_only(kept, &model).unwrap();
            fs::read_to_string(kept.join(file)).unwrap()
        };
        assert_eq!(told("schema = 1\n[sensor]\nfront_end = \"pair\"\n"), table);
        assert_eq!(
            told("[battery]\ninitial_soc = 1.0\n"),
            "t_s,i_ref_a,temp_cell_c\n0,1,25\n1,2,25\n2,3,26\n"
        );
        assert_eq!(
            told("[battery]\ncapacity_ah = 3\n"),
            "t_s,i_ref_a,v_cell_v,temp_cell_c\n0,1,,25\n1,2,3.9,25\n2,3,,26\n"
        );
    }

    #[test]
    fn a_report_is_read() {
        let report = serde_json::json!({
            "verdict": "ambiguous",
            "effects": [{"id": "lag", "signal": "i_meas_a", "equivalent_to": ["delay"],
                "parameters": [{"name": "tau_s", "value": 0.1, "ci95": [0.05, null]}]}],
            "locations": [{"kind": "region", "variable": "abs(i)", "from": 48.0, "to": null, "energy_share": 0.8},
                {"kind": "time", "variable": "t_s", "from": 0.0, "to": 1.0}],
        });
        let said = read(&report).unwrap();
        assert_eq!(said.named[0].equals, ["delay"]);
        assert_eq!(said.named[0].parameters[0].low, Some(0.05));
        assert_eq!(said.named[0].parameters[0].high, None);
        assert_eq!(said.locations.len(), 1);
        assert!(read(&serde_json::json!({})).is_err());
    }
}
