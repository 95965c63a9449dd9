//! A Python environment of its own under `target/`, with pinned packages.

use std::{
    fs,
    hash::{DefaultHasher, Hash, Hasher},
    path::{Path, PathBuf},
    process::Command,
};

use anyhow::{Context, Result};

use crate::{apt, process, workspace::Workspace};

/// What is in the environment, one list for each user of it. A package that stands in two has the same version in both.
const LISTS: [&str; 3] = [
    "can/check/requirements.txt",
    "emulator/clients/requirements.txt",
    "recording/python/requirements.txt",
];

/// What the proof campaign uses: simulators and methods of others. An environment of its own, for their numpy is not the
/// logs'.
const PROOF: [&str; 1] = ["proof/requirements.txt"];

/// The interpreter of the tests' environment; makes the environment if one of [`LISTS`] changed or it is not there.
pub fn environment(workspace: &Workspace) -> Result<PathBuf> {
    environment_of(workspace, &LISTS)
}

/// The same for the proof campaign.
pub fn proof_environment(workspace: &Workspace) -> Result<PathBuf> {
    environment_of(workspace, &PROOF)
}

fn environment_of(workspace: &Workspace, lists: &[&str]) -> Result<PathBuf> {
    let lists: Vec<PathBuf> = lists.iter().map(|list| workspace.root.join(list)).collect();
    let mut hasher = DefaultHasher::new();
    for list in &lists {
        fs::read_to_string(list)
            .with_context(|| format!("reading {}", list.display()))?
            .hash(&mut hasher);
    }
    let folder = workspace
        .target_dir
        .join("python")
        .join(format!("{:016x}", hasher.finish()));
    let _alone = workspace.set_up_alone()?;
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
    process::run_to_stderr(&mut pip(&python, &lists))?;
    fs::write(&complete, "")?;
    Ok(python)
}

fn pip(python: &Path, lists: &[PathBuf]) -> Command {
    let mut command = Command::new(python);
    command.args([
        "-m",
        "pip",
        "install",
        "--quiet",
        "--disable-pip-version-check",
        "--no-deps",
    ]);
    for list in lists {
        command.arg("--requirement").arg(list);
    }
    command
}

/// Debian takes `ensurepip` out of its `python3`: without it, `venv` makes no pip.
fn has_venv() -> bool {
    process::on_path("python3")
        && process::output(Command::new("python3").args(["-c", "import venv, ensurepip"])).is_ok()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use std::collections::BTreeMap;

    use super::*;

    #[test]
    fn a_package_has_one_version_in_all_lists() {
        let mut versions = BTreeMap::new();
        for list in LISTS {
            let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(list);
            let text = fs::read_to_string(path).unwrap();
            for line in text.lines().filter(|line| !line.starts_with('#')) {
                let (name, version) = line.split_once("==").unwrap();
                let known = versions
                    .entry(name.to_lowercase())
                    .or_insert_with(|| version.to_owned());
                assert_eq!(known, version, "{name} in {list}");
            }
        }
        assert!(versions.len() > 9);
    }
}
