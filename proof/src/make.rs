//! Makers: Python programs of their own that write recording, held-out recording, model as designed and truth.

use std::{
    fs,
    path::{Path, PathBuf},
    time::Duration,
};

use anyhow::{Context, Result, bail};
use serde::{Deserialize, Serialize};

use crate::{
    case::{Case, Planned},
    program::Served,
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

    /// Takes away what an earlier run of the tool and of the methods wrote.
    pub fn data_only(&self) -> Result<()> {
        for folder in [
            self.given.join("out"),
            self.given.join("again"),
            self.given.join("without"),
            self.case.join("methods"),
        ] {
            if folder.exists() {
                fs::remove_dir_all(&folder)
                    .with_context(|| format!("removing {}", folder.display()))?;
            }
        }
        Ok(())
    }

    /// Over the data, with what is held out.
    pub fn hash(&self) -> Result<String> {
        let mut all = String::new();
        for folder in [&self.given, &self.kept] {
            for file in files(folder)? {
                all.push_str(&hash_file(&file)?);
            }
        }
        Ok(hash(all.as_bytes()))
    }

    /// What the tool is given, for the seal.
    pub fn inputs(&self) -> Result<Vec<PathBuf>> {
        files(&self.given)
    }
}

/// Files of a folder, by name.
fn files(folder: &Path) -> Result<Vec<PathBuf>> {
    let mut files: Vec<PathBuf> = fs::read_dir(folder)
        .with_context(|| format!("reading {}", folder.display()))?
        .collect::<std::io::Result<Vec<_>>>()?
        .into_iter()
        .map(|entry| entry.path())
        .filter(|path| path.is_file())
        .collect();
    files.sort();
    Ok(files)
}

/// The makers' program.
pub struct Makers {
    /// `proof/makers`.
    folder: PathBuf,
    served: Served,
}

impl Makers {
    /// With the interpreter, of `proof/makers`.
    pub fn new(python: &Path, folder: PathBuf) -> Self {
        Self {
            served: Served::new(python.to_path_buf(), folder.join("make.py")),
            folder,
        }
    }

    /// Over everything that decides what a maker makes: its source, and those that it imports.
    pub fn hash(&self, maker: &str) -> Result<String> {
        let mut all = String::new();
        let mut open = vec!["make".to_owned(), maker.to_owned()];
        let mut known = Vec::new();
        while let Some(module) = open.pop() {
            let path = self.folder.join(format!("{module}.py"));
            if known.contains(&module) || !path.exists() {
                continue;
            }
            let text =
                fs::read_to_string(&path).with_context(|| format!("reading {}", path.display()))?;
            all.push_str(&hash(text.as_bytes()));
            open.extend(imports(&text));
            known.push(module);
        }
        Ok(hash(all.as_bytes()))
    }

    /// Makes what of a batch is not there from an earlier run. What could not be made is told by case; the others' files are in
    /// place, their truths taken away.
    pub fn make(&self, batch: &[Planned], out: &Path, safe: &Safe) -> Result<Vec<Option<String>>> {
        // A batch is of one maker.
        let sources = self.hash(&batch[0].case.maker)?;
        let mut keys = Vec::new();
        for planned in batch {
            let text = serde_json::to_string(&planned.case)? + &sources;
            keys.push(hash(text.as_bytes()));
        }
        let there = |planned: &Planned, key: &str| {
            Made::read(&Folders::new(out, &planned.case.id)).filter(|made| made.key == key)
        };
        let open: Vec<Planned> = batch
            .iter()
            .zip(&keys)
            .filter(|(planned, key)| there(planned, key).is_none())
            .map(|(planned, _)| planned.clone())
            .collect();
        let mut new = Vec::new();
        if !open.is_empty() {
            new = self.anew(&open, out, safe)?;
        }
        let mut new = new.into_iter();
        let mut results = Vec::new();
        for (planned, key) in batch.iter().zip(keys) {
            let folders = Folders::new(out, &planned.case.id);
            let not_made = match there(planned, &key) {
                Some(made) => made.not_made,
                None => {
                    let not_made = new.next().flatten();
                    let made = Made { key, not_made };
                    made.write(&folders)?;
                    made.not_made
                }
            };
            results.push(not_made);
        }
        Ok(results)
    }

    fn anew(&self, batch: &[Planned], out: &Path, safe: &Safe) -> Result<Vec<Option<String>>> {
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
        let arguments = ["--list".to_owned(), file.display().to_string()];
        let limit = LIMIT * u32::try_from(list.len().max(1))?;
        let ran = self.served.run(&arguments, limit);
        fs::remove_file(&file)?;
        ran
    }
}

/// Modules that a Python source imports by name, ours and others'.
fn imports(text: &str) -> Vec<String> {
    text.lines()
        .filter_map(|line| {
            let mut words = line.split_whitespace();
            match words.next() {
                Some("import" | "from") => words.next(),
                _ => None,
            }
        })
        .map(|module| module.trim_end_matches(',').to_owned())
        .collect()
}

/// What a case's folder was made from, for the next run.
#[derive(Serialize, Deserialize)]
struct Made {
    /// Over the case and the maker's sources.
    key: String,
    /// Why there is no data.
    not_made: Option<String>,
}

impl Made {
    fn path(folders: &Folders) -> PathBuf {
        folders.case.join("made.json")
    }

    fn read(folders: &Folders) -> Option<Self> {
        serde_json::from_str(&fs::read_to_string(Self::path(folders)).ok()?).ok()
    }

    fn write(&self, folders: &Folders) -> Result<()> {
        let path = Self::path(folders);
        fs::write(&path, serde_json::to_string(self)?)
            .with_context(|| format!("writing {}", path.display()))
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

/// Over the Python files of a folder, by name.
pub fn hash_of_sources(folder: &Path) -> Result<String> {
    let mut files = files(folder)?;
    files.retain(|path| path.extension().is_some_and(|ending| ending == "py"));
    let mut all = String::new();
    for file in files {
        all.push_str(&hash_file(&file)?);
    }
    Ok(hash(all.as_bytes()))
}
