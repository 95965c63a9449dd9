//! Logs and recordings written by other people's tools, for the tests of `recording`.

use std::{
    fs,
    hash::{DefaultHasher, Hash, Hasher},
    path::{Path, PathBuf},
    process::Command,
};

use anyhow::{Context, Result};

use crate::{process, workspace::Workspace};

/// What the files are made by and from.
const SOURCES: [&str; 4] = [
    "recording/python/make_logs.py",
    "recording/python/requirements.txt",
    "recording/python/vehicle.dbc",
    "can/board.dbc",
];

/// Their folder; makes them if one of [`SOURCES`] changed or they are not there.
pub fn make(workspace: &Workspace, python: &Path) -> Result<PathBuf> {
    let mut hasher = DefaultHasher::new();
    for source in SOURCES {
        fs::read(workspace.root.join(source))
            .with_context(|| format!("reading {source}"))?
            .hash(&mut hasher);
    }
    let stamp = format!("{:016x}", hasher.finish());
    let folder = workspace.target_dir.join("foreign-logs");
    let _alone = workspace.set_up_alone()?;
    // The script writes `complete` last; the stamp says from what.
    let made_from = folder.join("made-from");
    if folder.join("complete").exists()
        && fs::read_to_string(&made_from).is_ok_and(|text| text == stamp)
    {
        return Ok(folder);
    }
    if folder.exists() {
        fs::remove_dir_all(&folder).with_context(|| format!("removing {}", folder.display()))?;
    }
    let [script, .., database] = SOURCES;
    process::run_to_stderr(
        Command::new(python)
            .current_dir(&workspace.root)
            .args(["-B", script, database])
            .arg(&folder),
    )?;
    fs::write(&made_from, stamp).with_context(|| format!("writing {}", made_from.display()))?;
    Ok(folder)
}
