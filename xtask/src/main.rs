//! The project's commands: `cargo xtask demo`, `test`, `prove`, `emulate`, `bench`, `build`, `size`, `flash`, `doc`, `setup`.
//!
//! Everything a command needs beyond a Rust compiler for the host (a compiler for the board, QEMU, ngspice, Python
//! with its packages) is found or installed by the command itself; docs/toolchain.md says how.

mod apt;
mod dbc;
mod demo;
mod doc;
mod emulate;
mod flash;
mod foreign_logs;
mod image;
mod instruction_count;
mod lint;
mod process;
mod prove;
mod python;
mod qemu;
mod report;
mod size;
mod stack;
mod steps;
mod sysroot;
mod test_command;
mod tests_on_host;
mod thumb;
mod toolchain;
mod workspace;

use std::process::ExitCode;

use anyhow::Result;
use clap::{Parser, Subcommand};

use crate::{flash::FlashOutcome, steps::Steps, workspace::Workspace};

/// The check asked for failed.
const FAILED: u8 = 1;
/// Something the command needs is not there (a probe, a tool).
const MISSING: u8 = 2;

#[derive(Parser)]
#[command(
    name = "cargo xtask",
    bin_name = "cargo xtask",
    version,
    about = "The commands of the Hallmark board"
)]
#[command(
    after_help = "Examples:\n  cargo xtask demo      find an effect that is concealed in the emulated board, and one in a real recording\n  cargo xtask test      set up what is missing, then run every check and test\n  cargo xtask emulate --profile recordings/panasonic-18650pf/25c-us06.csv --scale 19 --duration 600\n                        the same drive on the emulated board, which runs the firmware image"
)]
struct CommandLine {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Find the effect that is concealed in an emulated drive, and the one in a real recording
    #[command(after_help = "Example:\n  cargo xtask demo")]
    Demo,
    /// Set up what is missing, then run every check and every test
    #[command(after_help = "Example:\n  cargo xtask test")]
    Test,
    /// Run the proof campaign: concealed effects, other people's simulators, real recordings, today's methods
    #[command(
        after_help = "Examples:\n  cargo xtask prove            all of it, into docs/proof; goes on where a broken run was\n  cargo xtask prove --quick    the small part that `cargo xtask test` runs, into target/prove/quick"
    )]
    Prove {
        /// Only the small part
        #[arg(long)]
        quick: bool,
        /// Begin no case after so many minutes; the next run goes on there
        #[arg(long, value_name = "N")]
        minutes: Option<u64>,
        /// Other data of the same kinds: a number that is added to every seed
        #[arg(long, value_name = "N")]
        seeds: Option<u64>,
    },
    /// Run the release image on the emulated board (`--help` tells the arguments)
    #[command(disable_help_flag = true)]
    Emulate {
        /// As for `emulate drive`
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<String>,
    },
    /// Measure the firmware's and the emulator's figures of merit on the emulated board
    #[command(disable_help_flag = true)]
    Bench {
        /// As for `emulate bench`
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<String>,
    },
    /// Build the release image and print where its ELF file is
    #[command(after_help = "Example:\n  arm-none-eabi-objdump -d \"$(cargo xtask build)\"")]
    Build,
    /// Print flash, static RAM, the stack bound and instruction counts against their limits
    #[command(after_help = "Example:\n  cargo xtask size\n  cargo xtask size --calls")]
    Size {
        /// Also list the deepest calls and the functions behind each remark
        #[arg(long)]
        calls: bool,
    },
    /// Build the image, flash it with probe-rs and stream its defmt log
    #[command(after_help = "Example:\n  cargo xtask flash")]
    Flash,
    /// Build the documentation of the host crates and print where it is
    #[command(after_help = "Example:\n  cargo xtask doc")]
    Doc,
    /// Only install what the other commands need
    #[command(after_help = "Example:\n  cargo xtask setup")]
    Setup,
}

fn main() -> ExitCode {
    let command = CommandLine::parse().command;
    match run(&command) {
        Ok(code) => code,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::from(FAILED)
        }
    }
}

fn run(command: &Command) -> Result<ExitCode> {
    let workspace = Workspace::find()?;
    match command {
        Command::Demo => {
            demo::run(&workspace)?;
            Ok(ExitCode::SUCCESS)
        }
        Command::Test => Ok(if test_command::run(&workspace)? {
            ExitCode::SUCCESS
        } else {
            ExitCode::from(FAILED)
        }),
        Command::Prove {
            quick,
            minutes,
            seeds,
        } => match prove::run(&workspace, *quick, *minutes, *seeds)? {},
        Command::Emulate { arguments } => match emulate::run(&workspace, "drive", arguments)? {},
        Command::Bench { arguments } => match emulate::run(&workspace, "bench", arguments)? {},
        Command::Build => {
            let toolchain = toolchain::choose(&workspace)?;
            println!("{}", image::build(&workspace, &toolchain)?.display());
            Ok(ExitCode::SUCCESS)
        }
        Command::Size { calls } => {
            let toolchain = toolchain::choose(&workspace)?;
            let mut steps = Steps::default();
            report::size_of_image(&mut steps, &workspace, &toolchain, *calls);
            Ok(if steps.print_failures() {
                ExitCode::from(FAILED)
            } else {
                ExitCode::SUCCESS
            })
        }
        Command::Flash => match flash::run(&workspace)? {
            FlashOutcome::Ran => Ok(ExitCode::SUCCESS),
            FlashOutcome::Missing(what) => {
                eprintln!("error: {what}");
                Ok(ExitCode::from(MISSING))
            }
        },
        Command::Doc => {
            println!("{}", doc::build(&workspace)?.display());
            Ok(ExitCode::SUCCESS)
        }
        Command::Setup => {
            workspace::check_host_components()?;
            let toolchain = toolchain::choose_again(&workspace)?;
            eprintln!("firmware compiler: {}", toolchain.describe());
            eprintln!("qemu: {}", qemu::find()?.display());
            eprintln!(
                "ngspice: {}",
                apt::program(test_command::NGSPICE)?.display()
            );
            eprintln!(
                "chromium: {}",
                apt::program(test_command::CHROMIUM)?.display()
            );
            let python = python::environment(&workspace)?;
            eprintln!("python: {}", python.display());
            let proof = python::proof_environment(&workspace)?;
            eprintln!("python of the proof campaign: {}", proof.display());
            let logs = foreign_logs::make(&workspace, &python)?;
            eprintln!("logs by other tools: {}", logs.display());
            Ok(ExitCode::SUCCESS)
        }
    }
}
