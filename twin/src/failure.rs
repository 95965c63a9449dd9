//! How a command ends when it does not do what was asked.

use std::{fmt, process::ExitCode};

/// Why a command failed: the sentence that says where its input is not what it should be. Exit code 2.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Failure(pub String);

impl Failure {
    /// The exit code of bad input.
    pub fn exit_code(&self) -> ExitCode {
        ExitCode::from(2)
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl From<recording::Error> for Failure {
    fn from(error: recording::Error) -> Self {
        Self(error.to_string())
    }
}
