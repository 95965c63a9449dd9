//! How a command ends when it does not do what was asked.

use std::{fmt, process::ExitCode};

/// Why a command failed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Failure {
    /// The check that was asked for failed: exit code 1.
    Check(String),
    /// The input is not what it should be: exit code 2.
    Input(String),
}

impl Failure {
    /// The exit code: 1 for a failed check, 2 for bad input.
    pub fn exit_code(&self) -> ExitCode {
        match self {
            Self::Check(_) => ExitCode::from(1),
            Self::Input(_) => ExitCode::from(2),
        }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (Self::Check(sentence) | Self::Input(sentence)) = self;
        f.write_str(sentence)
    }
}

impl From<recording::Error> for Failure {
    fn from(error: recording::Error) -> Self {
        Self::Input(error.to_string())
    }
}
