//! The documentation of the crates that run on the host.

use std::path::PathBuf;

use anyhow::Result;

use crate::{process, toolchain, workspace::Workspace};

/// Builds it, with every warning an error where the compiler is a checked one; the path of the first page.
pub fn build(workspace: &Workspace) -> Result<PathBuf> {
    let mut cargo = workspace.cargo();
    if toolchain::host_is_checked(workspace)? {
        cargo.env("RUSTDOCFLAGS", "--deny warnings");
    }
    cargo.args(["doc", "--no-deps", "--all-features"]);
    process::run_to_stderr(&mut cargo)?;
    Ok(workspace.target_dir.join("doc/core_logic/index.html"))
}
