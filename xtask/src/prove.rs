//! `cargo xtask prove`: the campaign of proof/, with everything that it needs.

use std::{
    convert::Infallible,
    fs::{File, TryLockError},
    os::unix::process::CommandExt,
    path::{Path, PathBuf},
    process::Command,
};

use anyhow::{Context, Result, bail};

use crate::{
    apt, emulate::tool, image, process, python, test_command::NGSPICE, toolchain,
    workspace::Workspace,
};

/// The whole campaign into docs/proof, or its small part into target/prove/quick. Both go on where a broken run was. Becomes
/// `prove`: what it says and its exit code are its own.
pub fn run(
    workspace: &Workspace,
    small: bool,
    minutes: Option<u64>,
    seeds: Option<u64>,
) -> Result<Infallible> {
    refuse_if_busy(&out(workspace, small))?;
    let python = python::proof_environment(workspace)?;
    apt::program(NGSPICE)?;
    let toolchain = toolchain::choose(workspace)?;
    let image = image::build(workspace, &toolchain)?;
    let twin = tool(workspace, "twin", "twin")?;
    let emulate = tool(workspace, "emulator", "emulate")?;
    let mut prove = tool(workspace, "proof", "prove")?;
    let program = |command: &Command| Path::new(command.get_program()).to_path_buf();
    arguments(
        &mut prove,
        workspace,
        small,
        [&program(&twin), &program(&emulate), &image, &python],
    );
    if let Some(minutes) = minutes {
        prove.arg("--minutes").arg(minutes.to_string());
    }
    if let Some(seeds) = seeds {
        prove.arg("--seeds").arg(seeds.to_string());
    }
    let error = prove.exec();
    Err(error).context("starting the campaign")
}

/// The small part, as a step of the tests: with the host programs of the tests' own profile, which are there already.
pub fn quick(workspace: &Workspace, image: &Path, python: &Path) -> Result<()> {
    apt::program(NGSPICE)?;
    let mut build = workspace.cargo();
    // With the tests beside them they have the features that the tests were built with: else they would all be built anew.
    build.args(["build", "--quiet", "--all-features", "--bins", "--tests"]);
    process::run(&mut build).context("building the host programs")?;
    let folder = workspace.target_dir.join("debug");
    let mut prove = Command::new(folder.join("prove"));
    arguments(
        &mut prove,
        workspace,
        true,
        [&folder.join("twin"), &folder.join("emulate"), image, python],
    );
    process::run(&mut prove)
}

/// Where data and results go.
fn out(workspace: &Workspace, small: bool) -> PathBuf {
    workspace.target_dir.join("prove").join(plan(small))
}

const fn plan(small: bool) -> &'static str {
    if small { "quick" } else { "full" }
}

/// `prove` refuses to run where another run has locked the folder. Here it is asked before anything is built, for the other run
/// goes on with what is built now.
fn refuse_if_busy(folder: &Path) -> Result<()> {
    if let Ok(file) = File::open(folder)
        && let Err(TryLockError::WouldBlock) = file.try_lock()
    {
        bail!(
            "another run is at work in {}: start this one again when that has ended",
            folder.display()
        );
    }
    Ok(())
}

fn arguments(
    prove: &mut Command,
    workspace: &Workspace,
    small: bool,
    [twin, emulate, image, python]: [&Path; 4],
) {
    prove
        .args(["run", "--plan", plan(small), "--root"])
        .arg(&workspace.root)
        .arg("--out")
        .arg(out(workspace, small))
        .arg("--twin")
        .arg(twin)
        .arg("--emulate")
        .arg(emulate)
        .arg("--image")
        .arg(image)
        .arg("--python")
        .arg(python);
    if !small {
        prove.arg("--docs").arg(workspace.root.join("docs/proof"));
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use std::{env, fs};

    use super::*;

    #[test]
    fn a_folder_with_a_run_in_it_is_busy_until_that_ends() {
        let folder = env::temp_dir().join(format!("hallmark-prove-{}", std::process::id()));
        assert!(refuse_if_busy(&folder).is_ok());
        fs::create_dir_all(&folder).unwrap();
        let run = File::open(&folder).unwrap();
        run.lock().unwrap();
        let refused = refuse_if_busy(&folder).unwrap_err().to_string();
        assert!(refused.contains(folder.to_str().unwrap()), "{refused}");
        run.unlock().unwrap();
        assert!(refuse_if_busy(&folder).is_ok());
        fs::remove_dir_all(&folder).unwrap();
    }
}
