//! What people use today, in processes of their own on the same files.

use std::{
    fs,
    path::{Path, PathBuf},
    time::Duration,
};

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};

use crate::{make::Folders, program::Served};

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

/// The methods' program.
pub struct Methods {
    /// `proof/methods`.
    pub folder: PathBuf,
    served: Served,
}

impl Methods {
    /// With the interpreter, of `proof/methods`.
    pub fn new(python: &Path, folder: PathBuf) -> Self {
        Self {
            served: Served::new(python.to_path_buf(), folder.join("run.py")),
            folder,
        }
    }

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
        let arguments = [
            method.to_owned(),
            folder.display().to_string(),
            out.display().to_string(),
        ];
        self.served.run(&arguments, LIMIT)?;
        let text =
            fs::read_to_string(&out).with_context(|| format!("reading {}", out.display()))?;
        serde_json::from_str(&text).with_context(|| format!("reading {}", out.display()))
    }

    /// Whether they are there at all.
    pub fn there(&self) -> bool {
        self.served.program().exists()
    }
}
