//! Every test of the host crates, by cargo's own runner, and its summary.

use std::{fmt, path::PathBuf};

use anyhow::{Context, Result, bail};

use crate::{process, workspace::Workspace};

/// The runner's summary lines and their sum.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Summary {
    lines: Vec<String>,
    passed: u64,
    failed: u64,
    ignored: u64,
}

/// What tests use and cannot make themselves: the variable that names it to them, and where it is.
pub type Provided = Vec<(&'static str, Option<PathBuf>)>;

/// Unit, integration and documentation tests with every feature. The summary says what failed; the second value is
/// whether the run as a whole succeeded, which a test that does not compile spoils without a summary line.
pub fn run(workspace: &Workspace, provided: &Provided) -> Result<(Summary, bool)> {
    let mut cargo = workspace.cargo();
    cargo.args(["test", "--no-fail-fast", "--all-features"]);
    for (variable, path) in provided {
        match path {
            Some(path) => cargo.env(variable, path),
            // An older one would hide that this one is not there.
            None => cargo.env(variable, "not-there-because-its-set-up-failed"),
        };
    }
    let finished = process::tee(&mut cargo)?;
    Ok((Summary::read(&finished.stdout)?, finished.success))
}

impl Summary {
    fn read(output: &str) -> Result<Self> {
        let mut summary = Self::default();
        for line in output
            .lines()
            .filter(|line| line.starts_with("test result:"))
        {
            summary.passed += count(line, "passed")?;
            summary.failed += count(line, "failed")?;
            summary.ignored += count(line, "ignored")?;
            summary.lines.push(line.to_owned());
        }
        if summary.lines.is_empty() {
            bail!("cargo ran no tests");
        }
        Ok(summary)
    }

    /// The runner's own lines.
    pub fn print_lines(&self) {
        for line in &self.lines {
            println!("{line}");
        }
    }
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} passed, {} failed", self.passed, self.failed)?;
        if self.ignored > 0 {
            write!(f, ", {} ignored", self.ignored)?;
        }
        Ok(())
    }
}

/// The number before `what;`.
fn count(line: &str, what: &str) -> Result<u64> {
    line.split(['.', ';'])
        .find_map(|part| part.trim().strip_suffix(what)?.trim().parse().ok())
        .with_context(|| format!("no count of {what} in {line:?}"))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    const OUTPUT: &str = "running 3 tests\n\
        test a ... ok\n\
        test result: ok. 3 passed; 0 failed; 0 ignored; 0 measured; 0 filtered out; finished in 0.00s\n\
        \n\
        test result: FAILED. 10 passed; 2 failed; 0 ignored; 0 measured; 4 filtered out; finished in 1.50s\n";

    #[test]
    fn results_are_summed() {
        let summary = Summary::read(OUTPUT).unwrap();
        assert_eq!(
            (summary.passed, summary.failed, summary.ignored),
            (13, 2, 0)
        );
        assert_eq!(summary.lines.len(), 2);
        assert_eq!(summary.to_string(), "13 passed, 2 failed");
    }

    #[test]
    fn ignored_tests_are_named_when_there_are_some() {
        let line = "test result: ok. 1 passed; 0 failed; 5 ignored; 0 measured; 0 filtered out; finished in 0.00s";
        assert_eq!(
            Summary::read(line).unwrap().to_string(),
            "1 passed, 0 failed, 5 ignored"
        );
    }

    #[test]
    fn no_tests_at_all_is_an_error() {
        assert!(Summary::read("running\n").is_err());
        assert!(Summary::read("test result: what\n").is_err());
    }
}
