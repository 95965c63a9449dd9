//! Makers: Python programs of their own that write recording, held-out recording, model as designed and truth.

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
    time::Duration,
};

use anyhow::{Context, Result, bail};

use crate::{
    case::{Case, Planned},
    program,
    seal::{Safe, hash, hash_file},
};

/// Processor time for one case; a batch has as much for each of its cases.
const LIMIT: Duration = Duration::from_secs(120);

/// Where a case's files are.
#[derive(Debug, Clone)]
pub struct Folders {
    /// All of it.
    pub case: PathBuf,
    /// What the tool gets, and its working folder.
    pub given: PathBuf,
    /// What is held out.
    pub kept: PathBuf,
}

impl Folders {
    /// Of a case in the campaign's folder.
    pub fn new(out: &Path, id: &str) -> Self {
        let case = out.join("cases").join(id);
        Self {
            given: case.join("given"),
            kept: case.join("kept"),
            case,
        }
    }

    /// Makes them anew.
    pub fn clear(&self) -> Result<()> {
        if self.case.exists() {
            fs::remove_dir_all(&self.case)
                .with_context(|| format!("removing {}", self.case.display()))?;
        }
        for folder in [&self.given, &self.kept] {
            fs::create_dir_all(folder).with_context(|| format!("making {}", folder.display()))?;
        }
        Ok(())
    }

    /// What the tool is given, for the seal.
    pub fn inputs(&self) -> Result<Vec<PathBuf>> {
        let mut inputs: Vec<PathBuf> = fs::read_dir(&self.given)?
            .collect::<std::io::Result<Vec<_>>>()?
            .into_iter()
            .map(|entry| entry.path())
            .filter(|path| path.is_file())
            .collect();
        inputs.sort();
        Ok(inputs)
    }
}

/// Python and its programs.
pub struct Makers {
    /// The interpreter.
    pub python: PathBuf,
    /// `proof/makers`.
    pub folder: PathBuf,
}

impl Makers {
    /// Over everything that decides what is made.
    pub fn hash(&self) -> Result<String> {
        hash_of_sources(&self.folder)
    }

    /// Makes a batch. What could not be made is told by case; the others' files are in place, their truths taken away.
    pub fn make(&self, batch: &[Planned], out: &Path, safe: &Safe) -> Result<Vec<Option<String>>> {
        let mut list = Vec::new();
        for planned in batch {
            let folders = Folders::new(out, &planned.case.id);
            folders.clear()?;
            let description = folders.case.join("CASE.json");
            fs::write(&description, serde_json::to_string(&planned.case)?)?;
            list.push([description, folders.case.join("made")]);
        }
        let together = self.run(&list, out, &batch[0].case);
        let mut results = Vec::new();
        for (planned, pair) in batch.iter().zip(&list) {
            let mut failure = None;
            if !pair[1].join("truth.json").exists() {
                failure = match (&together, batch.len()) {
                    (Err(error), 1) => Some(format!("{error:#}")),
                    // Alone, so that what it says is of this case.
                    _ => self
                        .run(std::slice::from_ref(pair), out, &planned.case)
                        .err()
                        .map(|error| format!("{error:#}")),
                };
            }
            if failure.is_none() {
                failure = take(planned, pair, out, safe)
                    .err()
                    .map(|error| format!("{error:#}"));
            }
            results.push(failure);
        }
        Ok(results)
    }

    fn run(&self, list: &[[PathBuf; 2]], out: &Path, first: &Case) -> Result<()> {
        let file = out.join(format!("list-{}.json", first.id));
        fs::write(&file, serde_json::to_string(list)?)?;
        let mut command = Command::new(&self.python);
        command
            .arg("-B")
            .arg(self.folder.join("make.py"))
            .arg("--list")
            .arg(&file);
        one_thread(&mut command);
        let ran = program::run(&mut command, LIMIT * u32::try_from(list.len().max(1))?);
        fs::remove_file(&file)?;
        ran.map(|_| ())
    }
}

/// Splits what was made: to the tool, held out, and sealed away.
fn take(planned: &Planned, pair: &[PathBuf; 2], out: &Path, safe: &Safe) -> Result<()> {
    let folders = Folders::new(out, &planned.case.id);
    let made = &pair[1];
    safe.take(&planned.case.id, made)?;
    for entry in fs::read_dir(made)? {
        let entry = entry?;
        let name = entry.file_name();
        let folder = if name.to_string_lossy().starts_with("holdout") {
            &folders.kept
        } else {
            &folders.given
        };
        fs::rename(entry.path(), folder.join(&name))?;
    }
    fs::remove_dir(made)?;
    for name in ["recording.csv", "model.toml"] {
        if !folders.given.join(name).exists() {
            bail!("the maker wrote no {name}");
        }
    }
    Ok(())
}

/// Libraries that would use every processor for one process.
pub fn one_thread(command: &mut Command) {
    for variable in ["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"] {
        command.env(variable, "1");
    }
    command.env("PYBAMM_DISABLE_TELEMETRY", "true");
}

/// Over the Python files of a folder, by name.
pub fn hash_of_sources(folder: &Path) -> Result<String> {
    let mut files: Vec<PathBuf> = fs::read_dir(folder)
        .with_context(|| format!("reading {}", folder.display()))?
        .collect::<std::io::Result<Vec<_>>>()?
        .into_iter()
        .map(|entry| entry.path())
        .filter(|path| {
            path.extension()
                .is_some_and(|ending| ending == "py" || ending == "cir")
        })
        .collect();
    files.sort();
    let mut all = String::new();
    for file in files {
        all.push_str(&hash_file(&file)?);
    }
    Ok(hash(all.as_bytes()))
}
