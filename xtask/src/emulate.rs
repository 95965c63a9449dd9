//! `cargo xtask emulate` and `bench`: the image on the emulated board.

use std::{convert::Infallible, os::unix::process::CommandExt, process::Command};

use anyhow::{Context, Result};

use crate::{image, process, toolchain, workspace::Workspace};

/// Builds image and emulator and becomes the emulator's `command` with `arguments`: output, exit code (0, 1 or 2) and Ctrl-C
/// are the emulator's own.
pub fn run(workspace: &Workspace, command: &str, arguments: &[String]) -> Result<Infallible> {
    let given = |option: &str| {
        arguments.iter().any(|argument| {
            argument
                .strip_prefix(option)
                .is_some_and(|rest| rest.is_empty() || rest.starts_with('='))
        })
    };
    let mut emulate = tool(workspace, "emulator", "emulate")?;
    emulate.arg(command);
    let only_words = ["--help", "-h", "--list-faults"].into_iter().any(given);
    if !only_words && !given("--image") {
        let toolchain = toolchain::choose(workspace)?;
        emulate
            .arg("--image")
            .arg(image::build(workspace, &toolchain)?);
    }
    if command == "drive" && !only_words && !given("--out") && !given("--serve") {
        emulate
            .arg("--out")
            .arg(workspace.target_dir.join("emulate"));
    }
    let error = emulate.args(arguments).exec();
    Err(error).context("starting the emulator")
}

/// A binary of the host's own tools, built with the profile that is made for speed.
pub fn tool(workspace: &Workspace, package: &str, binary: &str) -> Result<Command> {
    let program = workspace.target_dir.join("tool").join(binary);
    if !program.exists() {
        eprintln!("building `{binary}`, once: it takes some minutes");
    }
    let mut build = workspace.cargo();
    build.args([
        "build",
        "--quiet",
        "--profile",
        "tool",
        "--package",
        package,
        "--bin",
        binary,
    ]);
    process::run_to_stderr(&mut build)?;
    Ok(Command::new(program))
}
