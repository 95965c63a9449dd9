//! `twin` as it is called.

use std::{
    path::Path,
    process::{Command, Output},
};

/// `twin explain` of `r.csv` under `m.toml`, into `out`.
pub const EXPLAIN: [&str; 7] = [
    "explain",
    "--model",
    "m.toml",
    "--recording",
    "r.csv",
    "--out",
    "out",
];

/// What simulates a recording under a model.
pub const SIMULATE: [&str; 7] = [
    "simulate",
    "--model",
    "m.toml",
    "--recording",
    "r.csv",
    "--out",
    "s.csv",
];

/// Runs `twin` in a folder.
pub fn twin(folder: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_twin"))
        .args(arguments)
        .current_dir(folder)
        .output()
        .unwrap()
}
