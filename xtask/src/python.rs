//! A Python environment of its own under `target/`, with pinned packages.

use std::{
    fs,
    hash::{DefaultHasher, Hash, Hasher},
    path::{Path, PathBuf},
    process::Command,
};

use anyhow::{Context, Result};

use crate::{apt, process, workspace::Workspace};

/// The environment's interpreter; makes the environment if `can/check/requirements.txt` changed or it is not there.
pub fn environment(workspace: &Workspace) -> Result<PathBuf> {
    let list = workspace.root.join("can/check/requirements.txt");
    let requirements =
        fs::read_to_string(&list).with_context(|| format!("reading {}", list.display()))?;
    let mut hasher = DefaultHasher::new();
    requirements.hash(&mut hasher);
    let folder = workspace
        .target_dir
        .join("python")
        .join(format!("{:016x}", hasher.finish()));
    let python = folder.join("bin/python");
    let complete = folder.join("complete");
    // The link to the system's interpreter may have gone since.
    if complete.exists() && process::output(Command::new(&python).arg("--version")).is_ok() {
        return Ok(python);
    }
    if !has_venv() {
        eprintln!("Python with venv and pip is missing here");
        apt::install(&["python3", "python3-venv", "python3-pip"])?;
    }
    eprintln!("making a Python environment in {}", folder.display());
    if folder.exists() {
        fs::remove_dir_all(&folder).with_context(|| format!("removing {}", folder.display()))?;
    }
    process::run_to_stderr(Command::new("python3").args(["-m", "venv"]).arg(&folder))?;
    process::run_to_stderr(&mut pip(&python, &list))?;
    fs::write(&complete, "")?;
    Ok(python)
}

fn pip(python: &Path, list: &Path) -> Command {
    let mut command = Command::new(python);
    command
        .args([
            "-m",
            "pip",
            "install",
            "--quiet",
            "--disable-pip-version-check",
            "--no-deps",
            "--requirement",
        ])
        .arg(list);
    command
}

/// Debian takes `ensurepip` out of its `python3`: without it, `venv` makes no pip.
fn has_venv() -> bool {
    process::on_path("python3")
        && process::output(Command::new("python3").args(["-c", "import venv, ensurepip"])).is_ok()
}
