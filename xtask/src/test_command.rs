//! `cargo xtask test`: everything that has to hold, from a fresh clone on.

use anyhow::{Result, bail};

use crate::{
    dbc, doc, image, instruction_count, lint, report,
    steps::Steps,
    tests_on_host, toolchain,
    workspace::{self, Workspace},
};

/// Runs every check, then every test; `true` if all is well. A check that fails does not keep the next from running.
pub fn run(workspace: &Workspace) -> Result<bool> {
    let mut steps = Steps::default();
    steps.step(
        "set-up: clippy and rustfmt",
        workspace::check_host_components,
    );
    let toolchain = steps.step("set-up: compiler for the board", || {
        let toolchain = toolchain::choose(workspace)?;
        println!("   {}", toolchain.describe());
        Ok(toolchain)
    });
    steps.step("format", || lint::format(workspace));
    steps.step("clippy, host", || lint::host(workspace));
    match &toolchain {
        Some(toolchain) => {
            steps.step("clippy, board", || lint::target(toolchain));
            match steps.step("release image", || image::build(workspace, toolchain)) {
                Some(elf) => {
                    println!("   {}", elf.display());
                    steps.step("size", || report::memory(&elf, false));
                }
                None => steps.skip("size", "there is no image"),
            }
        }
        None => steps.skip(
            "clippy for the board, release image, size",
            "there is no compiler for the board",
        ),
    }
    steps.step("CAN frames against cantools", || dbc::check(workspace));
    match &toolchain {
        Some(toolchain) => {
            steps.step("instruction counts", || instruction_count::run(toolchain));
        }
        None => steps.skip("instruction counts", "there is no compiler for the board"),
    }
    steps.step("documentation", || doc::build(workspace));
    let mut summary = None;
    steps.step("tests", || {
        let (read, success) = tests_on_host::run(workspace)?;
        summary = Some(read);
        if !success {
            bail!("`cargo test` failed");
        }
        Ok(())
    });

    steps.print_times();
    let failed = steps.print_failures();
    if let Some(summary) = &summary {
        println!("\n== Tests");
        summary.print_lines();
        println!("\n{summary}");
    }
    Ok(!failed)
}
