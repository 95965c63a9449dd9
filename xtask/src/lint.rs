//! Formatting and Clippy.

use anyhow::Result;

use crate::{process, toolchain::Toolchain, workspace::Workspace};

/// Every crate of the workspace, the board's too.
pub fn format(workspace: &Workspace) -> Result<()> {
    process::run(workspace.cargo().args(["fmt", "--all", "--check"]))
}

/// Everything that is built for the host.
pub fn host(workspace: &Workspace) -> Result<()> {
    process::run(workspace.cargo().args([
        "clippy",
        "--all-targets",
        "--all-features",
        "--",
        "--deny",
        "warnings",
    ]))
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
        "--",
        "--deny",
        "warnings",
    ]);
    process::run(&mut cargo)
}
