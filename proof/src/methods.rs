//! What people use today, as processes of their own on the same files.

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
    time::Duration,
};

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};

use crate::{
    make::{Folders, one_thread},
    program,
};

/// Processor time for one recording: many times what the slowest explanation takes.
const LIMIT: Duration = Duration::from_secs(120);

/// What a method found (proof/methods/run.py).
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Found {
    /// Effects, by the library's ids.
    #[serde(default)]
    pub named: Vec<String>,
    /// Effects that one of its terms stands for alike.
    #[serde(default)]
    pub classes: Vec<Vec<String>>,
    /// Of the model as designed.
    #[serde(default)]
    pub held_out_before_rms: Option<f64>,
    /// Of the method; nothing if it does not apply.
    #[serde(default)]
    pub held_out_rms: Option<f64>,
    /// Of processor time, without the start of Python.
    #[serde(default)]
    pub seconds: Option<f64>,
    /// Why it does not apply, and the like.
    #[serde(default)]
    pub note: String,
    /// It failed or took too long.
    #[serde(default)]
    pub error: Option<String>,
}

/// Python and its programs.
pub struct Methods {
    /// The interpreter.
    pub python: PathBuf,
    /// `proof/methods`.
    pub folder: PathBuf,
}

impl Methods {
    /// One method on one case.
    pub fn run(&self, method: &str, folders: &Folders) -> Found {
        match self.ran(method, folders) {
            Ok(result) => result,
            Err(error) => Found {
                error: Some(format!("{error:#}")),
                ..Found::default()
            },
        }
    }

    fn ran(&self, method: &str, folders: &Folders) -> Result<Found> {
        let folder = folders.case.join("methods");
        fs::create_dir_all(&folder)?;
        for (from, name) in [
            // Polled readings that count once, if there are any.
            (&folders.kept, "recording.csv"),
            (&folders.given, "recording.csv"),
            (&folders.given, "model.toml"),
            (&folders.given, "ocv.csv"),
            (&folders.kept, "holdout.csv"),
        ] {
            let (from, to) = (from.join(name), folder.join(name));
            if from.exists() && !to.exists() {
                fs::hard_link(&from, &to)
                    .or_else(|_| fs::copy(&from, &to).map(|_| ()))
                    .with_context(|| format!("giving {}", from.display()))?;
            }
        }
        let out = folder.join(format!("{method}.json"));
        let mut command = Command::new(&self.python);
        command
            .arg("-B")
            .arg(self.program())
            .arg(method)
            .arg(&folder)
            .arg(&out);
        one_thread(&mut command);
        program::run(&mut command, LIMIT)?;
        let text =
            fs::read_to_string(&out).with_context(|| format!("reading {}", out.display()))?;
        serde_json::from_str(&text).with_context(|| format!("reading {}", out.display()))
    }

    fn program(&self) -> PathBuf {
        self.folder.join("run.py")
    }

    /// Whether they are there at all.
    pub fn there(&self) -> bool {
        Path::new(&self.program()).exists()
    }
}
