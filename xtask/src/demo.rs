//! `cargo xtask demo`: a recorded drive through the board's measuring logic.

use anyhow::Result;

use crate::{process, workspace::Workspace};

/// US06 of a 2.9 Ah cell; P. Kollmeyer, see recordings/panasonic-18650pf/README.md.
const RECORDING: &str = "recordings/panasonic-18650pf/25c-us06.csv";
/// Takes the cell's −7.6 … 20.8 A to the −144 … 396 A of a vehicle.
const SCALE: &str = "19";

/// Builds and runs the example `drive` of `core-logic`.
pub fn run(workspace: &Workspace) -> Result<()> {
    let out = workspace.target_dir.join("demo");
    let mut cargo = workspace.cargo();
    cargo
        .args(["run", "--quiet", "--release", "--package", "core-logic"])
        .args(["--example", "drive", "--", RECORDING, SCALE])
        .arg(&out);
    process::run(&mut cargo)
}
