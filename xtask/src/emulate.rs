//! `cargo xtask emulate` and `bench`: the image on the emulated board.

use std::process::Command;

use anyhow::Result;

use crate::{image, process, toolchain, workspace::Workspace};

/// Builds image and emulator and hands `arguments` on to the emulator's `command`; `true` if it says all is well.
///
/// The emulator's own output goes to the terminal, and its exit code (0, 1 or 2) is the command's.
pub fn run(workspace: &Workspace, command: &str, arguments: &[String]) -> Result<i32> {
    let toolchain = toolchain::choose(workspace)?;
    let elf = image::build(workspace, &toolchain)?;
    let mut emulate = tool(workspace, "emulator", "emulate")?;
    emulate.arg(command).arg("--image").arg(elf).args(arguments);
    process::exit_code(&mut emulate)
}

/// A binary of the host's own tools, built with the profile that is made for speed.
pub fn tool(workspace: &Workspace, package: &str, binary: &str) -> Result<Command> {
    let mut build = workspace.cargo();
    build.args(["build", "--quiet", "--profile", "tool", "--package", package, "--bin", binary]);
    process::run_to_stderr(&mut build)?;
    Ok(Command::new(workspace.target_dir.join("tool").join(binary)))
}
