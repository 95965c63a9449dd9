//! `cargo xtask demo`: an effect that the firmware does not know is found in the emulated board's own log and corrected on
//! the board, and one is found in a real recording.

use std::{
    path::Path,
    process::Command,
    time::{Duration, Instant},
};

use anyhow::Result;

use crate::{emulate::tool, image, process, toolchain, workspace::Workspace};

/// US06 of a 2.9 Ah cell; P. Kollmeyer, see recordings/panasonic-18650pf/README.md.
const DRIVE: &str = "recordings/panasonic-18650pf/25c-us06.csv";
/// Takes the cell's −7.6 … 20.8 A to the −144 … 396 A of a vehicle.
const SCALE: &str = "19";
/// A minute and a half of it with −85 … 287 A: both ranges, both signs.
const PIECE: [&str; 4] = ["--skip", "280", "--duration", "90"];
/// What is wrong with the board's sensors. Neither the image nor `twin` is told.
const CONCEALED: &str = "large.gain=1.02";
/// A graphics card's power sensor beside a power meter; see recordings/gpu-power-sensor/README.md.
const CARD: &str = "recordings/gpu-power-sensor/rtx3090-5050";

/// Builds, drives, explains; then says what each part took.
pub fn run(workspace: &Workspace) -> Result<()> {
    // Short in what is printed: the tools run in the top folder.
    let target = &workspace.target_dir;
    let out = target
        .strip_prefix(&workspace.root)
        .unwrap_or(target)
        .join("demo");
    let mut times = Vec::new();
    let mut timed = |what: &str, work: &mut dyn FnMut() -> Result<()>| {
        println!("\n== {what}");
        let start = Instant::now();
        let result = work();
        times.push((what.to_owned(), start.elapsed()));
        result
    };

    let (mut elf, mut tools) = (None, None);
    timed("Building the image, the emulator and twin", &mut || {
        let toolchain = toolchain::choose(workspace)?;
        elf = Some(image::build(workspace, &toolchain)?);
        let in_root = |mut program: Command| {
            program.current_dir(&workspace.root);
            program
        };
        tools = Some((
            in_root(tool(workspace, "emulator", "emulate")?),
            in_root(tool(workspace, "twin", "twin")?),
        ));
        Ok(())
    })?;
    let (Some(elf), Some((emulate, twin))) = (elf, tools) else {
        anyhow::bail!("nothing was built");
    };

    timed(
        "A recorded drive on the emulated board, which executes the image",
        &mut || {
            println!(
                "90 s of {DRIVE} × {SCALE}. Concealed from the firmware and from twin: {CONCEALED},\n\
                 that is, the large Hall sensor is 2 % too sensitive."
            );
            process::run(drive_of(&emulate, &elf).arg("--out").arg(&out))
        },
    )?;

    let board = out.join("board");
    timed("What twin makes of the board's log", &mut || {
        process::run(&mut explain_of(&twin, &out, &board))
    })?;

    let corrected = out.join("corrected");
    timed(
        "The same drive, the board corrected by what twin found",
        &mut || {
            println!(
                "Written over RS485 on the parked vehicle: {}",
                board.join("calibration.toml").display()
            );
            process::run(
                drive_of(&emulate, &elf)
                    .arg("--calibration")
                    .arg(board.join("calibration.toml"))
                    .arg("--out")
                    .arg(&corrected),
            )?;
            process::run(&mut explain_of(&twin, &corrected, &corrected.join("board")))
        },
    )?;

    let card = out.join("gpu");
    timed("What twin makes of a real recording", &mut || {
        println!(
            "{CARD}: the power sensor of a graphics card, and a power meter with a clock of its own.\n\
             Known from a publication: the sensor shows the mean of the last second."
        );
        let mut explain = again(&twin);
        explain
            .args(["explain", "--model", "models/gpu-power-sensor.toml"])
            .args(["--recording", &format!("{CARD}-sensor.csv")])
            .args(["--reference", &format!("{CARD}-reference.csv")])
            .arg("--out")
            .arg(&card);
        process::run(&mut explain)
    })?;

    println!("\n== Reports, to open in a browser");
    for folder in [&board, &corrected.join("board"), &card] {
        println!("{}", folder.join("report.html").display());
    }
    println!("\n== Time");
    let in_all: Duration = times.iter().map(|(_, taken)| *taken).sum();
    for (what, taken) in &times {
        println!("{:8.1} s  {what}", taken.as_secs_f64());
    }
    println!("{:8.1} s  in all", in_all.as_secs_f64());
    Ok(())
}

/// The drive on the board with its concealed error.
fn drive_of(emulate: &Command, elf: &Path) -> Command {
    let mut drive = again(emulate);
    drive
        .args(["drive", "--profile", DRIVE, "--scale", SCALE])
        .args(PIECE)
        .args(["--sensor", CONCEALED, "--image"])
        .arg(elf);
    drive
}

/// What `twin` makes of the log in a folder.
fn explain_of(twin: &Command, log: &Path, out: &Path) -> Command {
    let mut explain = again(twin);
    explain
        .args(["explain", "--model", "models/board-dual-range.toml"])
        .arg("--recording")
        .arg(log.join("board.csv"))
        .arg("--out")
        .arg(out);
    explain
}

/// The same program anew, from the workspace's own folder.
fn again(program: &Command) -> Command {
    let mut command = Command::new(program.get_program());
    if let Some(folder) = program.get_current_dir() {
        command.current_dir(folder);
    }
    command
}
