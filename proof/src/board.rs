//! The emulated board: a sensor error that neither the unmodified image nor `twin` is told of.

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
    time::Duration,
};

use anyhow::{Context, Result, bail};
use serde::{Deserialize, Serialize};
use serde_json::{Map, json};

use crate::{
    case::{Case, Group, Planned, TrueEffect, Truth},
    make::Folders,
    program,
    table::Table,
    tool::Tool,
};

/// Processor time for the longer of the two drives.
const LIMIT: Duration = Duration::from_secs(120);
/// US06 of a 2.9 Ah cell; P. Kollmeyer, see recordings/panasonic-18650pf/README.md.
const DRIVE: &str = "recordings/panasonic-18650pf/25c-us06.csv";
/// To the −144 … 396 A of a vehicle.
const SCALE: &str = "19";
/// Fitted, held out (and driven once more with the calibration): seconds left out, and taken.
const PIECES: [(&str, &str); 2] = [("280", "90"), ("1000", "45")];

/// A calibration that changes nothing; the board is started as for one that does.
const FACTORY: &str = "[[register]]\nname = \"current gain\"\nsmall = 0\nlarge = 0\n";

/// A concealed sensor error.
struct Error {
    name: &'static str,
    sensor: &'static [&'static str],
    required: &'static [&'static [&'static str]],
    allowed: &'static [&'static str],
    effect: &'static str,
    parameters: &'static [(&'static str, f64)],
}

/// What is wrong with the sensors. `range-mismatch` is the large sensor against the small one.
const ERRORS: [Error; 3] = [
    Error {
        name: "large-gain",
        sensor: &["large.gain=1.02"],
        required: &[&["range-mismatch"]],
        allowed: &[],
        effect: "range-mismatch",
        parameters: &[("gain_ratio", 1.02), ("offset_a", 0.0)],
    },
    Error {
        name: "both-gain",
        sensor: &["both.gain=0.985"],
        required: &[&["gain"]],
        allowed: &[],
        effect: "gain",
        parameters: &[("gain", 0.985)],
    },
    Error {
        name: "both-offset",
        sensor: &["both.offset_a=1.5"],
        required: &[&["offset"]],
        allowed: &[],
        effect: "offset",
        parameters: &[("offset_a", 1.5)],
    },
];

/// A drive's error against the truth, before and after the calibration was written to the board.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Calibrated {
    /// rms of the current's error against the simulation as designed, uncalibrated, A.
    pub before_a: f64,
    /// The same drive with the calibration, A.
    pub after_a: f64,
    /// The same drive of a board without any error, calibrated to what it has from the factory: what comparison and conversion
    /// leave, A.
    pub ideal_a: f64,
    /// Error of the charge at the drive's end, uncalibrated, C.
    pub charge_before_c: f64,
    /// With the calibration, C.
    pub charge_after_c: f64,
}

/// Emulator and image.
pub struct Board {
    /// `emulate`.
    pub emulate: PathBuf,
    /// The release image.
    pub image: PathBuf,
}

/// Its cases.
pub fn plan() -> Vec<Planned> {
    ERRORS
        .iter()
        .map(|error| {
            let mut options = Map::new();
            options.insert("sensor".to_owned(), json!(error.sensor));
            Planned {
                group: Group::Board,
                case: Case {
                    id: format!("board_{}", error.name),
                    maker: String::new(),
                    effects: Vec::new(),
                    noise: "none".to_owned(),
                    drive: error.name.to_owned(),
                    seed: 0,
                    rows: 0,
                    options,
                },
                without: false,
                twice: false,
                methods: Vec::new(),
            }
        })
        .collect()
}

impl Board {
    fn drive(
        &self,
        root: &Path,
        sensor: &[&str],
        piece: (&str, &str),
        calibration: Option<&Path>,
        out: &Path,
    ) -> Result<()> {
        let mut command = Command::new(&self.emulate);
        command
            .current_dir(root)
            .args(["drive", "--profile", DRIVE, "--scale", SCALE])
            .args(["--skip", piece.0, "--duration", piece.1])
            .arg("--image")
            .arg(&self.image)
            .arg("--out")
            .arg(out);
        for change in sensor {
            command.args(["--sensor", change]);
        }
        if let Some(file) = calibration {
            command.arg("--calibration").arg(file);
        }
        program::run(&mut command, LIMIT).context("emulate drive")?;
        Ok(())
    }

    /// Drives the board twice with the concealed error: one log is given to the tool, the other is held out.
    pub fn prepare(&self, root: &Path, planned: &Planned, folders: &Folders) -> Result<Truth> {
        let Some(error) = ERRORS.iter().find(|error| error.name == planned.case.drive) else {
            bail!("no such error: {}", planned.case.drive);
        };
        for (piece, to) in PIECES.into_iter().zip([
            folders.given.join("recording.csv"),
            folders.kept.join("holdout.csv"),
        ]) {
            let out = folders.case.join("drive");
            self.drive(root, error.sensor, piece, None, &out)?;
            fs::rename(out.join("board.csv"), &to)?;
            fs::remove_dir_all(&out)?;
        }
        fs::copy(
            root.join("models/board-dual-range.toml"),
            folders.given.join("model.toml"),
        )
        .context("copying the board's model")?;
        let words = |ids: &[&str]| ids.iter().map(|id| (*id).to_owned()).collect::<Vec<_>>();
        Ok(Truth {
            kind: "d".to_owned(),
            maker: "own emulator, unmodified image".to_owned(),
            effects: vec![TrueEffect {
                id: error.effect.to_owned(),
                parameters: Some(
                    error
                        .parameters
                        .iter()
                        .map(|(name, value)| ((*name).to_owned(), Some(*value)))
                        .collect(),
                ),
            }],
            required: error.required.iter().map(|ids| words(ids)).collect(),
            allowed: words(error.allowed),
            ..Truth::default()
        })
    }

    /// Writes the tool's calibration to the board and drives the held-out piece again. `before_a` is the uncalibrated board's
    /// error there, against the simulation as designed: the reading is the mean of a conversion, so the current of its row is no
    /// measure.
    pub fn calibrated(
        &self,
        root: &Path,
        tool: &Tool,
        planned: &Planned,
        folders: &Folders,
        before_a: f64,
    ) -> Result<Option<Calibrated>> {
        let calibration = folders.given.join("out/calibration.toml");
        if !calibration.exists() {
            return Ok(None);
        }
        let Some(error) = ERRORS.iter().find(|error| error.name == planned.case.drive) else {
            bail!("no such error: {}", planned.case.drive);
        };
        let factory = folders.case.join("factory.toml");
        fs::write(&factory, FACTORY)?;
        let out = folders.case.join("drive");
        let again = folders.case.join("again");
        let designed = folders.given.join("model.toml");
        fs::create_dir_all(&again)?;
        let drive = |sensor: &[&str], calibration: &Path| -> Result<f64> {
            self.drive(root, sensor, PIECES[1], Some(calibration), &out)?;
            fs::rename(out.join("board.csv"), again.join("holdout.csv"))?;
            fs::remove_dir_all(&out)?;
            let errors = tool.held_out(&again, &designed, &designed, false, LIMIT)?;
            let current = errors
                .get("i_meas_a")
                .context("the second drive's log has no current")?;
            Ok(current.before)
        };
        let ideal_a = drive(&[], &factory)?;
        // Last: its log is what the charge is read from.
        let after_a = drive(error.sensor, &calibration)?;
        Ok(Some(Calibrated {
            before_a,
            after_a,
            ideal_a,
            charge_before_c: charge_error(&Table::read(&folders.kept.join("holdout.csv"))?)?,
            charge_after_c: charge_error(&Table::read(&again.join("holdout.csv"))?)?,
        }))
    }
}

/// Error of the charge over the log, in C.
fn charge_error(log: &Table) -> Result<f64> {
    let (truth, said) = (log.column("q_ref_c")?, log.column("q_meas_c")?);
    let difference: Vec<f64> = truth
        .iter()
        .zip(said)
        .map(|(truth, said)| said - truth)
        .filter(|error| error.is_finite())
        .collect();
    match difference.as_slice() {
        [first, .., last] => Ok(last - first),
        _ => bail!("the log has no charge"),
    }
}
