//! The image onto the board, by probe-rs.

use std::{path::Path, process::Command};

use anyhow::Result;

use crate::{image, process, toolchain, workspace::Workspace};

const CHIP: &str = "STM32F405RGTx";

/// A reset or a fault is the firmware's to deal with: caught by the probe, the board would neither restart nor let go of its permit, and
/// the catches outlive the session (probe-rs catches both unless it is told not to). The runner in `.cargo/config.toml` has the same.
const LET_RUN: [&str; 2] = ["--no-catch-reset", "--no-catch-hardfault"];

/// How it went.
pub enum FlashOutcome {
    /// The board ran until the user or the firmware ended it.
    Ran,
    /// What has to be there first.
    Missing(String),
}

/// Builds the image, flashes it and streams its log until Ctrl-C.
pub fn run(workspace: &Workspace) -> Result<FlashOutcome> {
    let toolchain = toolchain::choose(workspace)?;
    let elf = image::build(workspace, &toolchain)?;
    if !process::on_path("probe-rs") {
        return Ok(FlashOutcome::Missing(format!(
            "probe-rs is missing: `cargo install probe-rs-tools --locked`, then run this again. The image is {}",
            elf.display()
        )));
    }
    let probes = process::output(Command::new("probe-rs").arg("list"))?;
    if !lists_a_probe(&probes) {
        return Ok(FlashOutcome::Missing(format!(
            "no debug probe is attached (`probe-rs list` finds none): connect an ST-Link, J-Link or CMSIS-DAP probe to \
             the board's SWD header. The image is {}",
            elf.display()
        )));
    }
    process::run(&mut stream(&elf))?;
    Ok(FlashOutcome::Ran)
}

fn stream(elf: &Path) -> Command {
    let mut command = Command::new("probe-rs");
    command.args(["run", "--chip", CHIP]).args(LET_RUN).arg(elf);
    command
}

/// `probe-rs list` numbers what it finds: `[0]: STLink V3 -- 0483:374e:…`.
fn lists_a_probe(text: &str) -> bool {
    text.lines().any(|line| line.starts_with('['))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn probes_are_numbered() {
        assert!(lists_a_probe(
            "The following debug probes were found:\n[0]: STLink V3 -- 0483:374e:00 (ST-LINK)\n"
        ));
        assert!(!lists_a_probe("No debug probes were found.\n"));
    }
}
