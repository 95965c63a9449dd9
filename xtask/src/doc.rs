//! The documentation of the crates that run on the host.

use std::path::PathBuf;

use anyhow::Result;

use crate::{process, workspace::Workspace};

/// Builds it, with every warning an error; the path of the first page.
pub fn build(workspace: &Workspace) -> Result<PathBuf> {
    let mut cargo = workspace.cargo();
    cargo
        .env("RUSTDOCFLAGS", "--deny warnings")
        .args(["doc", "--no-deps", "--all-features"]);
    process::run_to_stderr(&mut cargo)?;
    Ok(workspace.target_dir.join("doc/core_logic/index.html"))
}
