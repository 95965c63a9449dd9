//! `cargo xtask test`: everything that has to hold, from a fresh clone on.

use anyhow::{Result, bail};

use crate::{
    apt, dbc, doc, foreign_logs, image, instruction_count, lint, prove, python, qemu, report,
    steps::Steps,
    tests_on_host, toolchain,
    workspace::{self, Workspace},
};

/// The circuit simulator, and Debian's package of it.
pub const NGSPICE: &str = "ngspice";

/// The browser that opens the report's page, and Debian's package of it.
pub const CHROMIUM: &str = "chromium";

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
    steps.step("set-up: QEMU and ngspice", || {
        println!("   {}", qemu::find()?.display());
        println!("   {}", apt::program(NGSPICE)?.display());
        Ok(())
    });
    let chromium = steps.step("set-up: Chromium", || {
        let program = apt::program(CHROMIUM)?;
        println!("   {}", program.display());
        Ok(program)
    });
    let python = steps.step("set-up: Python", || python::environment(workspace));
    let proof_python = steps.step("set-up: Python of the proof campaign", || {
        python::proof_environment(workspace)
    });
    let logs = match &python {
        Some(python) => steps.step("set-up: logs by other tools", || {
            foreign_logs::make(workspace, python)
        }),
        None => {
            steps.skip("set-up: logs by other tools", "there is no Python");
            None
        }
    };
    steps.step("format", || lint::format(workspace));
    steps.step("clippy, host", || lint::host(workspace));
    let (mut elf, mut programs) = (None, None);
    match &toolchain {
        Some(toolchain) => {
            steps.step("clippy, board", || lint::target(toolchain));
            elf = steps.step("release image", || image::build(workspace, toolchain));
            match &elf {
                Some(elf) => {
                    println!("   {}", elf.display());
                    steps.step("size", || report::memory(elf, toolchain, false));
                }
                None => steps.skip("size", "there is no image"),
            }
            programs = steps.step("programs for the emulated CPU", || {
                image::build_package(toolchain, "cpu-programs")
            });
        }
        None => steps.skip(
            "clippy for the board, release image, size, programs for the emulated CPU",
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
    let image = elf.clone();
    let provided = vec![
        ("HALLMARK_IMAGE", elf),
        ("HALLMARK_CPU_PROGRAMS", programs),
        ("HALLMARK_PYTHON", python),
        ("HALLMARK_FOREIGN_LOGS", logs),
        ("HALLMARK_CHROMIUM", chromium),
    ];
    let mut summary = None;
    steps.step("tests", || {
        let (read, success) = tests_on_host::run(workspace, &provided)?;
        summary = Some(read);
        if !success {
            bail!("`cargo test` failed");
        }
        Ok(())
    });

    match (&image, &proof_python) {
        (Some(image), Some(python)) => {
            steps.step("proof, quick", || prove::quick(workspace, image, python));
        }
        _ => steps.skip("proof, quick", "there is no image or no Python for it"),
    }

    steps.print_times();
    let failed = steps.print_failures();
    if let Some(summary) = &summary {
        println!("\n== Tests");
        summary.print_lines();
        println!("\n{summary}");
    }
    Ok(!failed)
}
