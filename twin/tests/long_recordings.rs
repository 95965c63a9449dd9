//! Recordings of more readings than fits look at.

use std::f64::consts::TAU;

use crate::common::{noise, said, sensor, steps};
use twin::report::data::Verdict;

/// With every third reading the line would lie at 0.033 Hz.
#[test]
fn a_line_keeps_its_frequency_when_readings_are_thinned_out() {
    const LINE_HZ: f64 = 3.3;
    for seed in 1..4 {
        let mut reads_a = noise(seed + 100, 0.35);
        let (t_s, currents) = steps(seed, 60.0, 12_000, 50);
        let readings = t_s
            .iter()
            .zip(&currents)
            .map(|(t, current)| current + (TAU * LINE_HZ * t + 0.4).sin() + reads_a())
            .collect();
        let problem = sensor(t_s, currents, readings, 0.35).thinned(4_000);
        assert_eq!(problem.observed.value.len(), 4_000);
        let report = said(problem, seed, &[]);
        assert_eq!(report.verdict, Verdict::Explained, "{seed}: {report:?}");
        let ids: Vec<&str> = report.effects.iter().map(|one| one.id.as_str()).collect();
        assert_eq!(ids, ["hum"], "{seed}");
        let frequency = &report.effects[0].parameters[0];
        let [low, high] = frequency.ci95;
        assert!(
            (frequency.value - LINE_HZ).abs() < 1e-3 && high - low < 1e-3,
            "{seed}: {frequency:?}"
        );
    }
}
