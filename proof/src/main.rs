//! `prove`: the campaign that shows where `twin explain` is right, wrong or silent, and on whose data.

mod alone;
mod board;
mod bounds;
mod case;
mod forms;
mod make;
mod methods;
mod pages;
mod plan;
mod program;
mod real;
mod results;
mod run;
mod score;
mod seal;
mod stats;
mod summary;
mod table;
mod tool;

use std::{
    fs, io::ErrorKind, io::Write as _, path::Path, path::PathBuf, process, process::ExitCode,
    thread, time::Duration,
};

use anyhow::{Context, Result};
use clap::{Args, Parser, Subcommand};

use crate::{
    board::Board, make::Makers, methods::Methods, plan::Extent, run::Campaign, tool::Tool,
};

/// A bound of the quick campaign does not hold.
const FAILED: u8 = 1;
/// Something could not be done at all.
const MISSING: u8 = 2;

#[derive(Parser)]
#[command(
    name = "prove",
    version,
    about = "Shows where `twin explain` is right, wrong or silent, and on whose data"
)]
struct CommandLine {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Run what is not there yet, and write tables and pages
    #[command(
        after_help = "Example:\n  cargo xtask prove --quick     builds what is needed and calls this"
    )]
    Run(Box<Run>),
    /// List the cases
    List {
        /// How much of the campaign
        #[arg(long, value_enum, default_value = "full")]
        plan: Extent,
        /// The checkout's top folder
        #[arg(long, default_value = ".")]
        root: PathBuf,
        /// Added to the seed of every case
        #[arg(long, default_value_t = plan::SEEDS)]
        seeds: u64,
    },
}

#[derive(Args)]
struct Run {
    /// How much of the campaign
    #[arg(long, value_enum, default_value = "full")]
    plan: Extent,
    /// The checkout's top folder
    #[arg(long, default_value = ".")]
    root: PathBuf,
    /// Where data, results and tables go; a broken run goes on from there
    #[arg(long)]
    out: PathBuf,
    /// Where the pages go; without it beside the tables
    #[arg(long)]
    docs: Option<PathBuf>,
    /// The program under test
    #[arg(long)]
    twin: PathBuf,
    /// The emulator; without it the emulated board is left out
    #[arg(long, requires = "image")]
    emulate: Option<PathBuf>,
    /// The firmware image
    #[arg(long, requires = "emulate")]
    image: Option<PathBuf>,
    /// The interpreter with the packages of proof/requirements.txt
    #[arg(long, default_value = "python3")]
    python: PathBuf,
    /// The makers, if not those of the checkout
    #[arg(long)]
    makers: Option<PathBuf>,
    /// Today's methods, if not those of the checkout
    #[arg(long)]
    methods: Option<PathBuf>,
    /// Cases that run at once; without it one for each processor
    #[arg(long)]
    workers: Option<usize>,
    /// Only cases whose id has this in it
    #[arg(long)]
    only: Option<String>,
    /// Added to the seed of every case: other data of the same kinds
    #[arg(long, default_value_t = plan::SEEDS)]
    seeds: u64,
    /// Begin no case after so many minutes; the next run goes on there
    #[arg(long)]
    minutes: Option<u64>,
    /// Keep the data of every case, not only of those that went wrong
    #[arg(long)]
    keep: bool,
}

fn main() -> ExitCode {
    match CommandLine::parse().command {
        Command::Run(arguments) => match run(&arguments) {
            Ok(true) => ExitCode::SUCCESS,
            Ok(false) => ExitCode::from(FAILED),
            Err(error) => {
                eprintln!("error: {error:#}");
                ExitCode::from(MISSING)
            }
        },
        Command::List { plan, root, seeds } => match list(plan, &root, seeds) {
            Ok(()) => ExitCode::SUCCESS,
            Err(error) => {
                eprintln!("error: {error:#}");
                ExitCode::from(MISSING)
            }
        },
    }
}

fn list(extent: Extent, root: &Path, seeds: u64) -> Result<()> {
    let real = real::expected(&root.join("proof/expected.toml"))?;
    let mut out = std::io::stdout().lock();
    for planned in plan::plan(extent, &real, seeds) {
        match writeln!(out, "{}", planned.case.id) {
            Ok(()) => {}
            // A reader that has seen enough (`| head`) is no failure.
            Err(error) if error.kind() == ErrorKind::BrokenPipe => break,
            Err(error) => return Err(error).context("standard output"),
        }
    }
    Ok(())
}

fn run(arguments: &Run) -> Result<bool> {
    let absolute =
        |path: &PathBuf| std::path::absolute(path).with_context(|| path.display().to_string());
    let root = absolute(&arguments.root)?;
    let out = absolute(&arguments.out)?;
    let pages = match &arguments.docs {
        Some(docs) => absolute(docs)?,
        None => out.join("pages"),
    };
    let _alone = [alone::alone_in(&out)?, alone::alone_in(&pages)?];
    let real = real::expected(&root.join("proof/expected.toml"))?;
    let mut plan = plan::plan(arguments.plan, &real, arguments.seeds);
    if let Some(part) = &arguments.only {
        plan.retain(|planned| planned.case.id.contains(part.as_str()));
    }
    let board = match (&arguments.emulate, &arguments.image) {
        (Some(emulate), Some(image)) => Some(Board {
            emulate: absolute(emulate)?,
            image: absolute(image)?,
        }),
        _ => None,
    };
    // The interpreter of an environment is a link; its path is what makes it that environment's.
    let python = if arguments.python.components().count() > 1 {
        absolute(&arguments.python)?
    } else {
        arguments.python.clone()
    };
    let workers = match arguments.workers {
        Some(workers) => workers.max(1),
        None => thread::available_parallelism().map_or(1, usize::from),
    };
    let campaign = Campaign {
        out,
        tool: Tool {
            program: absolute(&arguments.twin)?,
            threads: 1,
        },
        makers: Makers::new(
            &python,
            match &arguments.makers {
                Some(folder) => absolute(folder)?,
                None => root.join("proof/makers"),
            },
        ),
        methods: Methods::new(
            &python,
            match &arguments.methods {
                Some(folder) => absolute(folder)?,
                None => root.join("proof/methods"),
            },
        ),
        board,
        real,
        workers,
        keep: arguments.keep,
        limit: arguments
            .minutes
            .map(|minutes| Duration::from_secs(60 * minutes)),
        root,
    };
    let records = campaign.run(&plan)?;
    let extent = match arguments.plan {
        Extent::Quick => "quick",
        Extent::Full => "full",
    };
    let processors = thread::available_parallelism().map_or(1, usize::from);
    let mut summary = summary::summary(
        &records,
        plan.len(),
        extent,
        seal::hash_file(&campaign.tool.program)?,
        processors,
    );
    // Pages are for others: no path of this machine.
    let here = [&campaign.out, &campaign.root].map(|folder| format!("{}/", folder.display()));
    for (_, why) in summary.not_made.iter_mut().chain(&mut summary.errors) {
        for here in &here {
            *why = why.replace(here.as_str(), "");
        }
    }
    let results = pages.join("results.json");
    fs::write(&results, results::text(&summary)?)
        .with_context(|| format!("writing {}", results.display()))?;
    let mut pictures = process::Command::new(&python);
    pictures
        .arg("-B")
        .arg(campaign.root.join("proof/pictures.py"))
        .arg(&results)
        .arg(&pages);
    program::run(&mut pictures, Duration::from_secs(120)).context("proof/pictures.py")?;
    pages::write(&summary, &pages)?;
    for target in &summary.targets {
        let met = match target.met {
            Some(true) => "met",
            Some(false) => "MISSED",
            None => "",
        };
        println!(
            "{:<6} {}: {} (wanted {})",
            met, target.what, target.found, target.wanted
        );
    }
    println!("{}", pages.join("index.md").display());
    if arguments.plan == Extent::Full || arguments.only.is_some() {
        return Ok(true);
    }
    let broken = bounds::broken(&summary, &records);
    for one in &broken {
        eprintln!("does not hold: {one}");
    }
    Ok(broken.is_empty())
}
