//! The command line of the emulated board. Exit code 0: done; 1: the check asked for failed, or the image did what no
//! board does; 2: bad input.

use std::fmt;
use std::io::{self, IsTerminal as _, Write as _};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use clap::{Args, Parser, Subcommand};
use plant::front_end::Sensors;
use recording::{Mapping, output};
use serde_json::json;

use emulator::calibration::{self, Calibration};
use emulator::drive::{self, Drive, Figures, Outputs};
use emulator::faults::{self, Injection};
use emulator::profile::{self, Profile, ProfileOptions};
use emulator::rig::{self, Firmware, Setup};
use emulator::scenario::{Contactors, Key, Row, Scenario};
use emulator::sensors;
use emulator::serve;
use emulator::time::Ticks;

/// The firmware image on an emulated STM32F405 board
#[derive(Debug, Parser)]
#[command(name = "emulate", version)]
struct CommandLine {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Drive the board and write down what it does
    #[command(after_help = DRIVE_EXAMPLES)]
    Drive(Box<DriveArguments>),
    /// Measure the board's figures: latencies, periods, charge errors; exit code 1 if one is beyond its bound
    #[command(after_help = BENCH_EXAMPLES)]
    Bench {
        /// The image; without it the one that `cargo xtask build` made last
        #[arg(long, value_name = "ELF")]
        image: Option<PathBuf>,
        /// Half a minute of the drive instead of an hour
        #[arg(long)]
        quick: bool,
    },
}

const BENCH_EXAMPLES: &str = "\
Examples:
  cargo xtask bench
  cargo xtask bench --quick";

const DRIVE_EXAMPLES: &str = "\
Examples:
  cargo xtask emulate --profile recordings/panasonic-18650pf/25c-us06.csv --scale 19 --duration 600
  cargo xtask emulate --profile drive.csv --map i_ref_a=Shunt --map v_cell_v=Ucell --check
  cargo xtask emulate --profile drive.csv --sensor large.gain=1.02 --sensor both.tc_a_per_k=0.02
  cargo xtask emulate --profile drive.csv --sensor large.gain=1.02 --calibration report/calibration.toml
  cargo xtask emulate --profile drive.csv --fault F9 --fault F21@7.5 --fault F14:open,large@10
  cargo xtask emulate --serve                    a parked car for python-can and a Modbus client
  cargo xtask emulate --serve --profile drive.csv --scale 19

A profile needs t_s and i_ref_a (positive = discharge, at most ±600 A after scaling). temp_sensor_c, v_supply_v, i_aux_a,
v_cell_v, v_pack_v, temp_cell_c and key (0 off, 1 accessory, 2 on) are used where they are.
--out gets can.log (candump -L), board.csv (the board beside the truth), rs485.log, defmt.log, summary.txt, summary.json;
with `cargo xtask emulate` it is target/emulate, or nothing with --serve. docs/emulator.md tells more.

Exit code 0: done; 1: --check found something, or the image did what the emulated board lacks; 2: bad input.";

#[derive(Args, Debug)]
struct DriveArguments {
    /// The image; without it the one that `cargo xtask build` made last
    #[arg(long, value_name = "ELF")]
    image: Option<PathBuf>,
    /// The recorded drive
    #[arg(long, value_name = "CSV", required_unless_present_any = ["serve", "list_faults"])]
    profile: Option<PathBuf>,
    /// Calls a column of the profile by another name
    #[arg(long, value_name = "NAME=COLUMN", requires = "profile")]
    map: Vec<String>,
    /// Multiplies the profile's current
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, allow_negative_numbers = true, value_parser = factor)]
    scale: f64,
    /// Leaves out so much of the profile's beginning
    #[arg(long, value_name = "SECONDS", allow_negative_numbers = true, default_value_t = 0.0, value_parser = seconds)]
    skip: f64,
    /// Takes so much of the profile; without it all
    #[arg(long, value_name = "SECONDS", allow_negative_numbers = true, value_parser = seconds)]
    duration: Option<f64>,
    /// Rest before the profile, from power-on
    #[arg(long, value_name = "SECONDS", allow_negative_numbers = true, default_value_t = 1.0, value_parser = seconds)]
    lead: f64,
    /// Longest step of the analogue simulation, 1 … 1000
    #[arg(long, value_name = "µs", allow_negative_numbers = true, default_value_t = 20, value_parser = clap::value_parser!(u64).range(1..=1000))]
    step: u64,
    /// Seed of whatever is random: noise, bit errors, what a loss of power leaves
    #[arg(long, value_name = "NUMBER", default_value_t = 0)]
    seed: u64,
    /// Puts a fault into the board, such as F9, F9:10kHz,30% or F9@2.5 (in s after power-on, else 2); may be given repeatedly
    #[arg(long, value_name = "FAULT")]
    fault: Vec<String>,
    /// Changes a sensor, and the firmware does not know: large.gain=1.01, both.offset_a=-0.5, small.core.remanence_a=0.4; may be
    /// given repeatedly
    #[arg(long, value_name = "SENSOR.PARAMETER=VALUE")]
    sensor: Vec<String>,
    /// Registers to write before the drive, as `twin explain` leaves them: over RS485, on the parked vehicle, saved
    #[arg(long, value_name = "TOML")]
    calibration: Option<PathBuf>,
    /// Lists the faults with their parameters, and ends
    #[arg(long)]
    list_faults: bool,
    /// Folder for what is written down; without it nothing is
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
    /// Ends with exit code 1 if the charge error is beyond its bound, a diagnosis is raised or the board resets
    #[arg(long)]
    check: bool,
    /// Offers the running board to clients on CAN and RS485
    #[arg(long)]
    serve: bool,
    #[command(flatten, next_help_heading = "With --serve")]
    serving: serve::Options,
}

fn factor(text: &str) -> Result<f64, String> {
    text.parse()
        .ok()
        .filter(|factor: &f64| factor.is_finite())
        .ok_or_else(|| "expected a number".to_owned())
}

fn seconds(text: &str) -> Result<f64, String> {
    text.parse()
        .ok()
        .filter(|seconds: &f64| seconds.is_finite() && *seconds >= 0.0)
        .ok_or_else(|| "expected a number of seconds, 0 or more".to_owned())
}

/// How a command ends when it does not do what was asked.
#[derive(Debug)]
enum Failure {
    /// The check that was asked for failed.
    Check(String),
    /// The image did what the model lacks, or locked up while no watchdog ran.
    Image(String),
    /// The input is not what it should be.
    Input(String),
    /// Ctrl-C.
    Interrupted,
}

impl Failure {
    fn exit_code(&self) -> ExitCode {
        match self {
            Self::Check(_) | Self::Image(_) => ExitCode::from(1),
            Self::Input(_) => ExitCode::from(2),
            // What a shell makes of SIGINT.
            Self::Interrupted => ExitCode::from(130),
        }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Check(text) | Self::Image(text) | Self::Input(text) => f.write_str(text),
            Self::Interrupted => f.write_str("interrupted: nothing was written"),
        }
    }
}

impl From<recording::Error> for Failure {
    fn from(error: recording::Error) -> Self {
        Self::Input(error.to_string())
    }
}

/// A file or an address that cannot be used is the input's fault; the rest is the image's.
impl From<anyhow::Error> for Failure {
    fn from(error: anyhow::Error) -> Self {
        let outside = error
            .chain()
            .any(|cause| cause.is::<recording::Error>() || cause.is::<io::Error>());
        let text = format!("{error:#}");
        if outside {
            Self::Input(text)
        } else {
            Self::Image(text)
        }
    }
}

fn main() -> ExitCode {
    let CommandLine { command } = CommandLine::parse();
    let result = match command {
        Command::Drive(arguments) => drive(&arguments),
        Command::Bench { image, quick } => bench(image, quick),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            eprintln!("error: {failure}");
            failure.exit_code()
        }
    }
}

/// On standard output, where a reader that has seen enough is no failure.
fn say(text: &str) -> Result<(), Failure> {
    let mut out = io::stdout();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => Err(Failure::Input(format!(
            "standard output: found \"{error}\" from the system, expected a place that can be written"
        ))),
        _ => Ok(()),
    }
}

fn bench(image: Option<PathBuf>, quick: bool) -> Result<(), Failure> {
    let path = image.unwrap_or_else(rig::default_image);
    let firmware = Firmware::load(&path).map_err(|error| Failure::Input(format!("{error:#}")))?;
    let figures = emulator::bench::run(&firmware, quick)?;
    say(&emulator::bench::Table(&figures).to_string())?;
    let missed = figures.iter().filter(|figure| !figure.holds()).count();
    if missed > 0 {
        return Err(Failure::Check(format!(
            "{missed} figures are beyond their bounds"
        )));
    }
    Ok(())
}

/// Everything about the input is checked before a file is begun.
fn drive(arguments: &DriveArguments) -> Result<(), Failure> {
    if arguments.list_faults {
        for fault in faults::CATALOGUE {
            say(&format!(
                "{:<5}{}: {}\n",
                fault.id, fault.title, fault.parameters
            ))?;
        }
        return Ok(());
    }
    let injections = arguments
        .fault
        .iter()
        .map(|text| faults::parse(text).map_err(|error| Failure::Input(error.to_string())))
        .collect::<Result<Vec<_>, _>>()?;
    let path = arguments.image.clone().unwrap_or_else(rig::default_image);
    refuse_overwrite(arguments, &path)?;
    let firmware = Firmware::load(&path).map_err(|error| Failure::Input(format!("{error:#}")))?;
    let profile = arguments
        .profile
        .is_some()
        .then(|| profile_of(arguments))
        .transpose()?;
    let end_s = profile
        .as_ref()
        .and_then(|profile| profile.rows.last())
        .map_or(0.0, |row| row.t_s);
    if arguments.profile.is_some() && !arguments.serve {
        refuse_late(arguments, &injections, end_s)?;
    }
    let calibration = arguments
        .calibration
        .as_deref()
        .map(|path| Calibration::read(path).map_err(|error| Failure::Input(format!("{error:#}"))))
        .transpose()?;
    let mut setup = setup(arguments, profile)?;
    let stop = serve::stop_flag()
        .map_err(|error| Failure::Input(format!("listening for Ctrl-C: {error}")))?;

    let calibration = calibration
        .map(|calibration| {
            // The same board, before the drive.
            let parked = self::setup(arguments, None)?;
            let (flash, account) = calibration::commission(&firmware, parked, &calibration)?;
            setup.flash = Some(flash);
            Ok::<_, Failure>(account)
        })
        .transpose()?;
    let mut drive = Drive::new(&firmware, setup, arguments.out.as_deref())?;
    for injection in &injections {
        faults::apply(injection, &mut drive.rig);
    }
    if arguments.serve {
        if arguments.profile.is_none() {
            // The clients are the other nodes.
            drive.rig.machine.board(|board| board.vehicle.silent = true);
        }
        drive.keep_for_clients();
        serve::serve(&arguments.serving, &mut drive)?;
    } else {
        run(&mut drive, end_s, &stop)?;
    }

    let figures = Figures {
        calibration,
        ..drive.figures()
    };
    let text = drive::summary(&figures);
    let json = report(arguments, &figures).map_err(|error| Failure::Image(error.to_string()))?;
    drive.finish(&text, &json)?;
    say(&text)?;
    if let Some(out) = &arguments.out {
        say(&format!("{:<16}{}\n", "written to", out.display()))?;
    }
    let complaints = drive::complaints(&figures);
    if arguments.check && !complaints.is_empty() {
        return Err(Failure::Check(complaints.join("; ")));
    }
    Ok(())
}

/// No file that is read is replaced by what is written down.
fn refuse_overwrite(arguments: &DriveArguments, image: &Path) -> Result<(), Failure> {
    let Some(folder) = &arguments.out else {
        return Ok(());
    };
    let mut read = vec![("--image", image)];
    read.extend(
        arguments
            .profile
            .iter()
            .map(|path| ("--profile", path.as_path())),
    );
    let calibration = arguments.calibration.iter();
    read.extend(calibration.map(|path| ("--calibration", path.as_path())));
    for path in Outputs::in_folder(folder).all() {
        output::refuse_overwrite(path, read.iter().copied())?;
    }
    Ok(())
}

/// A fault that would never strike is no test.
fn refuse_late(
    arguments: &DriveArguments,
    injections: &[Injection],
    end_s: f64,
) -> Result<(), Failure> {
    let end = Ticks::from_seconds(end_s);
    let mut all = arguments.fault.iter().zip(injections);
    match all.find(|(_, injection)| injection.strikes_after(end)) {
        Some((text, injection)) => Err(Failure::Input(format!(
            "--fault {text}: found the time {} s, expected one before the drive ends, {end_s} s after power-on",
            injection.at.seconds()
        ))),
        None => Ok(()),
    }
}

fn run(drive: &mut Drive<'_>, end_s: f64, stop: &AtomicBool) -> Result<(), Failure> {
    let mut progress = Progress::new();
    let result = drive.run_to(end_s, |now_s| {
        progress.at(now_s, end_s);
        !stop.load(Ordering::Relaxed)
    });
    drop(progress);
    match result {
        Ok(true) => Ok(()),
        Ok(false) => Err(Failure::Interrupted),
        Err(error) => {
            for line in drive.last_words() {
                eprintln!("image: {line}");
            }
            Err(error.into())
        }
    }
}

fn profile_of(arguments: &DriveArguments) -> Result<Profile, Failure> {
    let mapping = Mapping::parse(arguments.map.iter().map(String::as_str))?;
    let options = ProfileOptions {
        scale: arguments.scale,
        skip_s: arguments.skip,
        duration_s: arguments.duration,
        lead_s: arguments.lead,
        ..ProfileOptions::default()
    };
    let path = arguments.profile.clone().unwrap_or_default();
    Ok(profile::read(&path, &mapping, &options)?)
}

/// Without a profile: a parked car, key off.
fn setup(arguments: &DriveArguments, profile: Option<Profile>) -> Result<Setup, Failure> {
    let scenario = match profile {
        Some(profile) => Scenario::new(profile.rows, profile.contactors)
            .map_err(|error| Failure::Input(error.to_string()))?,
        None => Scenario::steady(Row::at_rest(0.0).with_key(Key::Off), Contactors::Permitted),
    };
    let mut setup = Setup::nominal(scenario);
    setup.board.step = Ticks::from_micros(arguments.step);
    for text in &arguments.sensor {
        sensors::change(&mut setup.board.front_end.sensors, text)
            .map_err(|error| Failure::Input(error.to_string()))?;
    }
    // Different numbers, so that no two sources of noise are the same.
    let seed = |number: u64| arguments.seed.wrapping_mul(16).wrapping_add(number);
    setup.converter.seed = seed(0);
    setup.nor.seed = seed(1);
    if let Sensors::DualRange { small, large } = &mut setup.board.front_end.sensors {
        small.noise.seed = seed(2);
        large.noise.seed = seed(3);
    }
    Ok(setup)
}

/// The summary for programs.
fn report(arguments: &DriveArguments, figures: &Figures) -> serde_json::Result<String> {
    let report = json!({
        "schema": 1,
        "version": env!("CARGO_PKG_VERSION"),
        "run": {
            "profile": arguments.profile,
            "scale": arguments.scale,
            "skip_s": arguments.skip,
            "duration_s": arguments.duration,
            "lead_s": arguments.lead,
            "step_us": arguments.step,
            "seed": arguments.seed,
            "faults": arguments.fault,
            "sensor": arguments.sensor,
            "calibration": arguments.calibration,
            "served": arguments.serve,
        },
        "figures": figures,
        "complaints": drive::complaints(figures),
    });
    Ok(serde_json::to_string_pretty(&report)? + "\n")
}

/// A line on a terminal's standard error that says how far it is; elsewhere nothing is written.
struct Progress {
    terminal: bool,
    start: Instant,
    shown: Option<Instant>,
}

impl Progress {
    /// Nothing is shown before this.
    const PATIENCE: Duration = Duration::from_secs(1);
    /// Time between two changes of the line.
    const PACE: Duration = Duration::from_millis(200);

    fn new() -> Self {
        Self {
            terminal: io::stderr().is_terminal(),
            start: Instant::now(),
            shown: None,
        }
    }

    fn at(&mut self, now_s: f64, end_s: f64) {
        let taken = self.start.elapsed();
        let early = self.shown.is_some_and(|shown| shown.elapsed() < Self::PACE);
        if !self.terminal || early || taken < Self::PATIENCE {
            return;
        }
        self.shown = Some(Instant::now());
        let speed = now_s / taken.as_secs_f64();
        let mut out = io::stderr();
        // A terminal that cannot be written to is no reason to stop.
        let _ = write!(
            out,
            "\r\x1b[K{now_s:.0} of {end_s:.0} s, {speed:.1} times real time, {:.0} s to go",
            (end_s - now_s) / speed
        );
        let _ = out.flush();
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        if self.shown.is_some() {
            let _ = write!(io::stderr(), "\r\x1b[K");
        }
    }
}
