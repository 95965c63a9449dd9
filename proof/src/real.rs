//! Real recordings: the files as they are given to the tool, and the truth that expected.toml holds.

use std::{
    fs,
    path::{Path, PathBuf},
};

use anyhow::{Context, Result, bail};
use serde::Deserialize;

use crate::{
    case::{Published, Truth},
    table::Table,
};

/// What is fitted.
const RECORDING: &str = "recording.csv";
/// What is not.
const HOLDOUT: &str = "holdout.csv";

/// One entry of expected.toml.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Expected {
    /// Unique.
    pub id: String,
    /// What was recorded.
    pub object: String,
    /// published, beside or none.
    pub truth: String,
    /// Model file as designed; the loops have none of their own.
    #[serde(default)]
    pub model: Option<PathBuf>,
    /// What is fitted.
    #[serde(default)]
    pub fit: Option<PathBuf>,
    /// Its reference, if that has a clock of its own.
    #[serde(default)]
    pub fit_reference: Option<PathBuf>,
    /// What is held out; with `fit_until_s` the rest of the same file.
    #[serde(default)]
    pub holdout: Option<PathBuf>,
    /// Its reference.
    #[serde(default)]
    pub holdout_reference: Option<PathBuf>,
    /// Column of a reading that is polled more often than it is measured: a value that comes again is no new reading, and
    /// counts once.
    #[serde(default)]
    pub polled: Option<String>,
    /// Cuts the file in two.
    #[serde(default)]
    pub fit_until_s: Option<f64>,
    /// Measured B(H) loops.
    #[serde(default)]
    pub loops: Option<PathBuf>,
    /// Loops that are fitted.
    #[serde(default)]
    pub loops_fit: Vec<u32>,
    /// Loops that are held out.
    #[serde(default)]
    pub loops_holdout: Vec<u32>,
    /// What has to be named.
    #[serde(default)]
    pub required: Vec<Vec<String>>,
    /// What may be named.
    #[serde(default)]
    pub allowed: Vec<String>,
    /// Who says so.
    pub source: String,
    /// What the publisher measured.
    #[serde(default)]
    pub parameter: Vec<Published>,
    /// The model is of a battery.
    #[serde(skip)]
    pub battery: bool,
}

#[derive(Deserialize)]
struct Entries {
    case: Vec<Expected>,
}

/// Reads expected.toml.
pub fn expected(path: &Path) -> Result<Vec<Expected>> {
    let text = fs::read_to_string(path).with_context(|| format!("reading {}", path.display()))?;
    let mut entries: Entries =
        toml::from_str(&text).with_context(|| format!("reading {}", path.display()))?;
    // proof/expected.toml: models are told from the checkout's top folder.
    let root = path
        .parent()
        .and_then(Path::parent)
        .unwrap_or(Path::new("."));
    for one in &mut entries.case {
        if let Some(model) = &one.model {
            let model = root.join(model);
            let stated = fs::read_to_string(&model)
                .with_context(|| format!("reading {}", model.display()))?;
            one.battery = stated.lines().any(|line| line.trim() == "[battery]");
        }
        if !["published", "beside", "none"].contains(&one.truth.as_str()) {
            bail!(
                "{}: {}: truth: found {:?}, expected published, beside or none",
                path.display(),
                one.id,
                one.truth
            );
        }
    }
    Ok(entries.case)
}

impl Expected {
    /// Whether the reference has a clock of its own.
    pub fn two_clocks(&self) -> bool {
        self.fit_reference.is_some()
    }

    /// The truth, to be sealed.
    pub fn truth(&self) -> Truth {
        Truth {
            kind: "a".to_owned(),
            maker: self.object.clone(),
            required: self.required.clone(),
            allowed: self.allowed.clone(),
            why: Some(self.source.clone()),
            standing: Some(self.truth.clone()),
            published: self.parameter.clone(),
            ..Truth::default()
        }
    }

    /// Writes recording.csv and model.toml (and reference.csv) to `given`, holdout.csv to `kept`.
    ///
    /// The tool gets every poll, as a user would give it. Repeats are empty in what is held out, and in the recording that
    /// today's methods are given, which `kept` then has as well.
    pub fn prepare(&self, root: &Path, given: &Path, kept: &Path) -> Result<()> {
        self.split(root, given, kept)?;
        let Some(column) = &self.polled else {
            return Ok(());
        };
        for (from, to) in [
            (given.join(RECORDING), kept.join(RECORDING)),
            (kept.join(HOLDOUT), kept.join(HOLDOUT)),
        ] {
            let mut table = Table::read(&from)?;
            let values = table.column(column)?;
            let once = (0..values.len())
                .map(|row| match row.checked_sub(1) {
                    Some(before) if values[before] == values[row] => f64::NAN,
                    _ => values[row],
                })
                .collect();
            table.replace(column, once);
            table.write(&to)?;
        }
        Ok(())
    }

    fn split(&self, root: &Path, given: &Path, kept: &Path) -> Result<()> {
        if let Some(loops) = &self.loops {
            return self.prepare_loops(&root.join(loops), given, kept);
        }
        let (Some(model), Some(fit)) = (&self.model, &self.fit) else {
            bail!("{}: model and fit, or loops, are needed", self.id);
        };
        copy_model(&root.join(model), given)?;
        let fit = root.join(fit);
        let copy = |from: &Path, to: PathBuf| -> Result<()> {
            fs::copy(from, &to).with_context(|| format!("copying {}", from.display()))?;
            Ok(())
        };
        if let Some(cut_s) = self.fit_until_s {
            let whole = Table::read(&fit)?;
            let t_s = whole.column("t_s")?.to_vec();
            whole
                .filtered(|row| t_s[row] < cut_s)
                .write(&given.join(RECORDING))?;
            whole
                .filtered(|row| t_s[row] >= cut_s)
                .write(&kept.join(HOLDOUT))?;
            return Ok(());
        }
        let Some(holdout) = &self.holdout else {
            bail!("{}: holdout or fit_until_s is needed", self.id);
        };
        copy(&fit, given.join(RECORDING))?;
        copy(&root.join(holdout), kept.join(HOLDOUT))?;
        if let Some(reference) = &self.fit_reference {
            copy(&root.join(reference), given.join("reference.csv"))?;
        }
        if let Some(reference) = &self.holdout_reference {
            copy(&root.join(reference), kept.join("holdout-reference.csv"))?;
        }
        Ok(())
    }

    /// A core as a sensor of the field: its flux density over the slope of its largest loop from tip to tip.
    fn prepare_loops(&self, file: &Path, given: &Path, kept: &Path) -> Result<()> {
        let measured = Table::read(file)?;
        let (number, field, flux) = (
            measured.column("loop")?,
            measured.column("h_a_per_m")?,
            measured.column("b_t")?,
        );
        let largest = number.iter().copied().fold(0.0, f64::max);
        let tip = |values: &[f64]| {
            let of_it = || (0..values.len()).filter(|row| number[*row] == largest);
            let low = of_it().map(|row| values[row]).fold(f64::INFINITY, f64::min);
            let high = of_it()
                .map(|row| values[row])
                .fold(f64::NEG_INFINITY, f64::max);
            high - low
        };
        let slope = tip(flux) / tip(field);
        if !slope.is_finite() || slope <= 0.0 {
            bail!("{}: no loop to take a slope from", file.display());
        }
        let part = |wanted: &[u32]| {
            let rows: Vec<usize> = wanted
                .iter()
                .flat_map(|wanted| {
                    (0..number.len()).filter(|row| number[*row] == f64::from(*wanted))
                })
                .collect();
            // A clock that starts anew with each loop: nothing flows over from one to the next.
            let mut t_s = Vec::new();
            for (place, row) in rows.iter().enumerate() {
                let same = place > 0 && number[rows[place - 1]] == number[*row];
                t_s.push(if same { t_s[place - 1] + 1.0 } else { 0.0 });
            }
            let mut table = Table::default();
            table.push("t_s", t_s);
            table.push("cycle", rows.iter().map(|row| number[*row]).collect());
            table.push(
                "h_ref_a_per_m",
                rows.iter().map(|row| field[*row]).collect(),
            );
            table.push(
                "h_meas_a_per_m",
                rows.iter().map(|row| flux[*row] / slope).collect(),
            );
            table
        };
        part(&self.loops_fit).write(&given.join(RECORDING))?;
        part(&self.loops_holdout).write(&kept.join(HOLDOUT))?;
        fs::write(
            given.join("model.toml"),
            "schema = 1\nname = \"a core without hysteresis\"\n\n[sensor]\nfront_end = \"pair\"\n\
             reference = \"h_ref_a_per_m\"\nmeasured = \"h_meas_a_per_m\"\nquasi_static = true\n",
        )?;
        Ok(())
    }
}

/// Copies a model file, and the table of voltages that it names beside it.
fn copy_model(model: &Path, given: &Path) -> Result<()> {
    let mut text =
        fs::read_to_string(model).with_context(|| format!("reading {}", model.display()))?;
    let stated: toml::Table =
        toml::from_str(&text).with_context(|| format!("reading {}", model.display()))?;
    let table = stated
        .get("battery")
        .and_then(|battery| battery.get("ocv_file"))
        .and_then(toml::Value::as_str);
    if let Some(table) = table {
        let from = model.parent().unwrap_or(Path::new(".")).join(table);
        fs::copy(&from, given.join("ocv.csv"))
            .with_context(|| format!("copying {}", from.display()))?;
        text = text.replace(&format!("\"{table}\""), "\"ocv.csv\"");
    }
    fs::write(given.join("model.toml"), text).context("writing model.toml")
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::panic)]

    use super::*;

    fn root() -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
    }

    #[test]
    fn every_real_recording_can_be_prepared() {
        let cases = expected(&root().join("proof/expected.toml")).unwrap();
        assert!(cases.len() >= 14);
        for case in &cases {
            let folder = tempfile::tempdir().unwrap();
            let (given, kept) = (folder.path().join("given"), folder.path().join("kept"));
            fs::create_dir(&given).unwrap();
            fs::create_dir(&kept).unwrap();
            case.prepare(&root(), &given, &kept)
                .unwrap_or_else(|error| panic!("{}: {error:#}", case.id));
            let fitted = Table::read(&given.join(RECORDING)).unwrap();
            let held = Table::read(&kept.join(HOLDOUT)).unwrap();
            assert!(fitted.len() > 200 && held.len() > 100, "{}", case.id);
            if let Some(column) = &case.polled {
                let all = fitted.column(column).unwrap();
                let once = Table::read(&kept.join(RECORDING)).unwrap();
                let once = once.column(column).unwrap();
                let new = 1 + all.windows(2).filter(|pair| pair[0] != pair[1]).count();
                let left: Vec<f64> = once.iter().copied().filter(|v| v.is_finite()).collect();
                assert_eq!(left.len(), new, "{}", case.id);
                assert!(left.windows(2).all(|pair| pair[0] != pair[1]));
                assert!(all.iter().all(|value| value.is_finite()));
            }
            assert_eq!(
                case.truth != "none",
                !case.required.is_empty(),
                "{}",
                case.id
            );
        }
    }

    #[test]
    fn a_loop_is_a_sensor_whose_tips_are_right() {
        let cases = expected(&root().join("proof/expected.toml")).unwrap();
        let ferrite = cases.iter().find(|case| case.id == "bh-ferrite").unwrap();
        let folder = tempfile::tempdir().unwrap();
        ferrite
            .prepare(&root(), folder.path(), folder.path())
            .unwrap();
        let fitted = Table::read(&folder.path().join("recording.csv")).unwrap();
        let spread = |name: &str| {
            let values = fitted.column(name).unwrap();
            values.iter().copied().fold(f64::NEG_INFINITY, f64::max)
                - values.iter().copied().fold(f64::INFINITY, f64::min)
        };
        let (field, reading) = (spread("h_ref_a_per_m"), spread("h_meas_a_per_m"));
        assert!((field - reading).abs() < 1e-9 * field, "{field} {reading}");
    }
}
