//! The command line of `twin`: exit code 0 done, 1 the check asked for failed, 2 bad input.

use std::io::Write as _;
use std::process::ExitCode;

use clap::{Parser, Subcommand};
use twin::{convert, effects_command, explain_command, failure::Failure, simulate};

/// Explains why a recording and the simulation disagree.
#[derive(Debug, Parser)]
#[command(version)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Simulate(simulate::command::Arguments),
    Explain(explain_command::Arguments),
    Convert(convert::Arguments),
    Effects(effects_command::Arguments),
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    match run(&arguments.command) {
        Ok(summary) => {
            if !summary.is_empty() {
                // A reader that has seen enough (`| head`) is no failure.
                let _ = writeln!(std::io::stdout(), "{summary}");
            }
            ExitCode::SUCCESS
        }
        Err(failure) => {
            eprintln!("error: {failure}");
            failure.exit_code()
        }
    }
}

fn run(command: &Command) -> Result<String, Failure> {
    match command {
        Command::Simulate(arguments) => simulate::command::run(arguments),
        Command::Explain(arguments) => explain_command::run(arguments),
        Command::Convert(arguments) => convert::run(arguments),
        Command::Effects(arguments) => Ok(effects_command::run(arguments)),
    }
}
