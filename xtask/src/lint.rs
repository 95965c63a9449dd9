//! Formatting and Clippy.

use std::process::Command;

use anyhow::Result;

use crate::{
    process,
    toolchain::{self, Toolchain},
    workspace::Workspace,
};

/// Every crate of the workspace, the board's too.
pub fn format(workspace: &Workspace) -> Result<()> {
    process::run(workspace.cargo().args(["fmt", "--all", "--check"]))
}

/// Everything that is built for the host.
pub fn host(workspace: &Workspace) -> Result<()> {
    let mut cargo = workspace.cargo();
    cargo.args(["clippy", "--all-targets", "--all-features"]);
    run(cargo, toolchain::host_is_checked(workspace)?)
}

/// What is built for the board.
pub fn target(toolchain: &Toolchain) -> Result<()> {
    let mut cargo = toolchain.cargo("clippy");
    cargo.args([
        "--package",
        "firmware",
        "--package",
        "instruction-count",
        "--package",
        "cpu-programs",
    ]);
    run(cargo, toolchain.is_checked)
}

fn run(mut clippy: Command, is_checked: bool) -> Result<()> {
    if is_checked {
        clippy.args(["--", "--deny", "warnings"]);
    } else {
        toolchain::remark_unchecked("warnings are shown, and fail nothing");
    }
    process::run(&mut clippy)
}
