//! What tests with recordings of their own share.

use std::fs;

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng as _, SeedableRng as _};
use twin::explain::{Options, explain};
use twin::model::Model;
use twin::prepare::{Inputs, Prepared, Purpose, prepare};
use twin::problem::{Accuracy, Base, Coloured, Drive, Observed, Problem, SensorBase, View};
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

/// A load in A that is drawn anew every so many rows of 0.1 s, and their times in s.
pub fn steps(seed: u64, deviation_a: f64, rows: u32, every: u32) -> (Vec<f64>, Vec<f64>) {
    let mut load_a = noise(seed, deviation_a);
    let mut current_a = 0.0;
    (0..rows)
        .map(|row| {
            if row % every == 0 {
                current_a = load_a();
            }
            (0.1 * f64::from(row), current_a)
        })
        .unzip()
}

/// Readings of a sensor beside its current in A, at the same instants in s, under a design that states the noise alone.
pub fn sensor(t_s: Vec<f64>, current_a: Vec<f64>, reading_a: Vec<f64>, noise_a: f64) -> Problem {
    Problem {
        view: View::Sensor,
        name: "i_meas_a".into(),
        unit: "A".into(),
        drive: Drive {
            segments: std::iter::once(0..t_s.len()).collect(),
            continues: vec![false],
            t_s: t_s.clone().into(),
            reference: current_a.into(),
            ..Drive::default()
        },
        observed: Observed::with_drive(t_s, reading_a),
        base: Base::Sensor(SensorBase::default()),
        modelled: Vec::new(),
        noise: noise_a,
        coloured: Coloured::default(),
        accuracy: Accuracy::default(),
    }
}

/// A recording and its model file, both as text, prepared to be explained as `twin explain` does.
pub fn prepared(recording: &str, model: &str) -> Prepared {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("r.csv");
    fs::write(&path, recording).expect("the recording is written");
    let model = Model::parse("m.toml", model.to_owned(), folder.path()).expect("a model file");
    let inputs = Inputs {
        recording: path,
        reference: None,
        mapping: Vec::new(),
    };
    prepare(&model, &inputs, Purpose::Compare).expect("a recording that can be prepared")
}

/// What is said of a problem, with effects taken out of the library.
pub fn said(problem: Problem, seed: u64, without: &[&str]) -> Report {
    let options = Options {
        seed,
        without: without.iter().map(|id| (*id).to_owned()).collect(),
    };
    explain(&[problem], &[], &options, &mut |_, _| {})
}
