//! From problems to named effects.

use std::path::PathBuf;

use crate::{problem::Problem, report::data::Report};

/// How to explain.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// Effects taken out of the library, by id.
    pub without: Vec<String>,
    /// Seed of whatever is random.
    pub seed: u64,
}

/// A file that is never fitted, with the problems that it makes under the same model file.
#[derive(Clone, Debug)]
pub struct Holdout {
    /// The file.
    pub file: PathBuf,
    /// Its problems; matched to the fitted ones by name.
    pub problems: Vec<Problem>,
}

/// Everything about the mismatch. `progress` is told a share, 0 … 1, and what is being done.
pub fn explain(
    _problems: &[Problem],
    _holdouts: &[Holdout],
    _options: &Options,
    _progress: &mut dyn FnMut(f64, &str),
) -> Report {
    unimplemented!("the lead writes this")
}

/// What the simulation with `effects` (id and values in the order of the effect's parameters) says at each observed row;
/// NaN where the drive does not reach. Effects that the problem has already modelled stay in.
pub fn predict(_problem: &Problem, _effects: &[(String, Vec<f64>)]) -> Vec<f64> {
    unimplemented!("the lead writes this")
}
