//! `cargo xtask prove`: the campaign of proof/, with everything that it needs.

use std::{convert::Infallible, os::unix::process::CommandExt, path::Path, process::Command};

use anyhow::{Context, Result};

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
    build.args(["build", "--quiet", "--all-features"]);
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

fn arguments(
    prove: &mut Command,
    workspace: &Workspace,
    small: bool,
    [twin, emulate, image, python]: [&Path; 4],
) {
    let plan = if small { "quick" } else { "full" };
    prove
        .args(["run", "--plan", plan, "--root"])
        .arg(&workspace.root)
        .arg("--out")
        .arg(workspace.target_dir.join("prove").join(plan))
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
