//! The command line of `twin`: exit code 0 done, 2 bad input.

use std::io::{self, IsTerminal as _, Write as _};
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
    #[cfg(unix)]
    if let Err(error) = leave_nothing() {
        eprintln!("error: listening for Ctrl-C: {error}");
        return ExitCode::from(2);
    }
    match run(&arguments.command).and_then(|summary| say(&summary)) {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            eprintln!("error: {failure}");
            failure.exit_code()
        }
    }
}

/// Ctrl-C and a request to end leave no unfinished file behind.
#[cfg(unix)]
fn leave_nothing() -> io::Result<()> {
    use signal_hook::{
        consts::{SIGINT, SIGTERM},
        iterator::Signals,
    };
    let mut signals = Signals::new([SIGINT, SIGTERM])?;
    std::thread::spawn(move || {
        if let Some(signal) = signals.forever().next() {
            recording::output::abandon();
            // The line of the progress goes.
            let clear = if io::stderr().is_terminal() {
                "\r\x1b[K"
            } else {
                ""
            };
            // Who reads this may have been ended first.
            let _ = writeln!(
                io::stderr(),
                "{clear}error: interrupted: nothing was written"
            );
            // What a shell makes of a signal.
            std::process::exit(128 + signal);
        }
    });
    Ok(())
}

fn say(summary: &str) -> Result<(), Failure> {
    if summary.is_empty() {
        return Ok(());
    }
    let mut out = io::stdout();
    match writeln!(out, "{summary}").and_then(|()| out.flush()) {
        // A reader that has seen enough (`| head`) is no failure.
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => Err(Failure(format!(
            "standard output: found \"{error}\" from the system, expected a place that can be written"
        ))),
        _ => Ok(()),
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
