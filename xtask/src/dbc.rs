//! The frames of `core-logic` against an independent reader of `can/board.dbc`.

use std::{path::PathBuf, process::Command};

use anyhow::{Context, Result, bail};

use crate::{image, process, python, workspace::Workspace};

/// Every frame our encoder makes is decoded by `cantools`, and what `cantools` encodes comes out of our encoder alike.
pub fn check(workspace: &Workspace) -> Result<()> {
    let database = workspace.root.join("can/board.dbc");
    if !database.exists() {
        bail!("{} is missing", database.display());
    }
    let python = python::environment(workspace)?;
    let folder = workspace.target_dir.join("xtask");
    std::fs::create_dir_all(&folder)?;

    let encoder = encoder(workspace)?;
    let ours = folder.join("frames-ours.jsonl");
    std::fs::write(&ours, process::output(&mut Command::new(&encoder))?)?;

    let script = workspace.root.join("can/check/check.py");
    let checker = |mode: &str| {
        let mut command = Command::new(&python);
        command.arg(&script).arg(mode).arg(&database);
        command
    };
    process::run(checker("decode").arg(&ours))?;

    let theirs = process::output(&mut checker("make")).context("encoding with cantools")?;
    let expected = folder.join("frames-cantools.jsonl");
    std::fs::write(&expected, &theirs)?;
    let encoded = folder.join("frames-cantools-by-us.jsonl");
    let by_us = process::filter(Command::new(&encoder).arg("--encode"), theirs)?;
    std::fs::write(&encoded, by_us)?;
    process::run(checker("compare").arg(&expected).arg(&encoded))
}

/// The example of `core-logic` that prints and encodes frames, built as the tests are so that they share what they depend
/// on.
fn encoder(workspace: &Workspace) -> Result<PathBuf> {
    let build = || {
        let mut command = workspace.cargo();
        command.args(["build", "--all-features", "--example", "can_vectors"]);
        command
    };
    process::run_to_stderr(&mut build())?;
    let messages = process::output(build().args(["--quiet", "--message-format=json"]))?;
    image::executable(&messages).context("the example can_vectors has no executable")
}
