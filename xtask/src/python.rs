//! A Python environment of its own under `target/`, with pinned packages.

use std::{
    fs,
    hash::{DefaultHasher, Hash, Hasher},
    path::{Path, PathBuf},
    process::Command,
};

use anyhow::{Context, Result, bail};

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

/// Minor numbers of the Python, 3.x, for which every pinned package is there (looked up on PyPI).
const MINORS: std::ops::RangeInclusive<u32> = 11..=13;

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
    let interpreter = interpreter()?;
    eprintln!("making a Python environment in {}", folder.display());
    if folder.exists() {
        fs::remove_dir_all(&folder).with_context(|| format!("removing {}", folder.display()))?;
    }
    process::run_to_stderr(Command::new(&interpreter).args(["-m", "venv"]).arg(&folder))?;
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

/// A Python that can make the environments: `python3`, else the newest of those beside it; Debian's is installed where there is none.
fn interpreter() -> Result<String> {
    let named = MINORS.rev().map(|minor| format!("python3.{minor}"));
    let mut candidates = std::iter::once("python3".to_owned()).chain(named);
    if let Some(suitable) =
        candidates.find(|name| minor_of(name).is_some_and(|minor| MINORS.contains(&minor)))
    {
        return Ok(suitable);
    }
    if minor_of("python3").is_none() {
        eprintln!("Python with venv and pip is missing here");
        apt::install(&["python3", "python3-venv", "python3-pip"])?;
    }
    let found = minor_of("python3");
    check_minor(found)?;
    Ok("python3".to_owned())
}

fn check_minor(found: Option<u32>) -> Result<()> {
    let (first, last) = (MINORS.start(), MINORS.end());
    match found {
        Some(minor) if MINORS.contains(&minor) => Ok(()),
        Some(minor) => bail!(
            "python3 is Python 3.{minor}: for 3.{first} to 3.{last} the packages that the tests use are there. \
             Put one of these on PATH, as python3.{last} or the like"
        ),
        None => bail!("python3 is installed and yet has no venv and ensurepip"),
    }
}

/// Minor number of a Python 3 with venv and pip. Debian takes `ensurepip` out of its `python3`: without it, `venv` makes no pip.
fn minor_of(name: &str) -> Option<u32> {
    const SAY: &str = "import sys, venv, ensurepip; print(sys.version_info.minor)";
    if !process::on_path(name) {
        return None;
    }
    let minor = process::output(Command::new(name).args(["-c", SAY])).ok()?;
    minor.trim().parse().ok()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use std::collections::BTreeMap;

    use super::*;

    #[test]
    fn a_python_without_the_packages_is_refused_by_name() {
        assert!(
            MINORS
                .map(Some)
                .map(check_minor)
                .all(|result| result.is_ok())
        );
        let newer = check_minor(Some(MINORS.end() + 1)).unwrap_err().to_string();
        assert!(
            newer.contains("Python 3.14") && newer.contains("3.11 to 3.13"),
            "{newer}"
        );
        let bare = check_minor(None).unwrap_err().to_string();
        assert!(bare.contains("ensurepip"), "{bare}");
    }

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
