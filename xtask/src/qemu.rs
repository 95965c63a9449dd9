//! QEMU's Cortex-M4, for instruction counts.

use std::{
    path::{Path, PathBuf},
    process::Command,
    time::Duration,
};

use anyhow::{Result, bail};

use crate::{apt, process};

const PROGRAM: &str = "qemu-system-arm";
/// The measurements take a second; an image that hangs must not hold up a test run.
const LIMIT: Duration = Duration::from_secs(120);

/// QEMU's path; installs it if it is missing.
pub fn find() -> Result<PathBuf> {
    apt::program(PROGRAM)
}

/// Runs an ELF file on the AN386 board (a Cortex-M4 with flash at 0) and returns what it printed by semihosting. Every
/// instruction takes 2^10 ns of the board's time, so a count is the same on each run.
pub fn run(elf: &Path) -> Result<String> {
    let mut command = Command::new(find()?);
    command.args([
        "-M",
        "mps2-an386",
        "-nographic",
        "-monitor",
        "none",
        "-serial",
        "null",
        "-icount",
        "shift=10",
    ]);
    command
        .args(["-semihosting-config", "enable=on,target=native", "-kernel"])
        .arg(elf);
    let finished = process::run_for(&mut command, LIMIT)?;
    if !finished.success {
        bail!(
            "the measuring image failed; it printed:\n{}{}",
            finished.stdout,
            finished.stderr
        );
    }
    Ok(finished.stdout)
}
