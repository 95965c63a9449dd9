//! What tests with recordings of their own share.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng as _, SeedableRng as _};
use twin::explain::{Options, explain};
use twin::problem::Problem;
use twin::report::data::Report;

/// White noise of a standard deviation, in its unit.
pub fn noise(seed: u64, deviation: f64) -> impl FnMut() -> f64 {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    // Twelve evenly spread numbers have variance one.
    move || {
        let sum: f64 = (0..12)
            .map(|_| f64::from(random.next_u32()) / f64::from(u32::MAX))
            .sum();
        deviation * (sum - 6.0)
    }
}

/// What is said of a problem, with effects taken out of the library.
#[allow(dead_code, reason = "not every test explains problems")]
pub fn said(problem: Problem, seed: u64, without: &[&str]) -> Report {
    let options = Options {
        seed,
        without: without.iter().map(|id| (*id).to_owned()).collect(),
    };
    explain(&[problem], &[], &options, &mut |_, _| {})
}
