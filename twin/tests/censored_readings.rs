//! Readings behind a threshold, steps or rails that the model file states, as `twin explain` writes them there once they are found: noise
//! takes readings over an edge to either side, and each jumps by all of the threshold or the step. What is said of the next log of
//! such a sensor.

use crate::common::{noise, said, sensor};
use twin::report::data::{Report, Verdict};

const ROWS: usize = 3000;
const NOISE_A: f64 = 0.5;

/// What ends the chain, in A: each 0, or infinite, where there is none.
#[derive(Clone, Copy)]
struct Ends {
    threshold: f64,
    step: f64,
    rail: f64,
}

const NONE: Ends = Ends {
    threshold: 0.0,
    step: 0.0,
    rail: f64::INFINITY,
};
const THRESHOLD: Ends = Ends {
    threshold: 3.0,
    ..NONE
};
const STEPS: Ends = Ends { step: 4.0, ..NONE };
const RAILS: Ends = Ends { rail: 12.0, ..NONE };
const ALL: [Ends; 3] = [THRESHOLD, STEPS, RAILS];

impl Ends {
    fn of(self, value: f64) -> f64 {
        let value = value.clamp(-self.rail, self.rail);
        let value = if value.abs() < self.threshold {
            0.0
        } else {
            value
        };
        if self.step > 0.0 {
            self.step * (value / self.step).round()
        } else {
            value
        }
    }

    fn stated(self) -> Vec<(&'static str, Vec<f64>)> {
        let mut effects = Vec::new();
        if self.rail.is_finite() {
            effects.push(("clipping", vec![self.rail, -self.rail]));
        }
        if self.threshold > 0.0 {
            effects.push(("dead-band", vec![self.threshold]));
        }
        if self.step > 0.0 {
            effects.push(("quantisation", vec![self.step]));
        }
        effects
    }
}

/// Current in A at a time in s: it is near zero for much of the time.
fn current_a(t_s: f64) -> f64 {
    let slow = 4.0 * (0.011 * t_s).sin() + 30.0 * (0.0071 * t_s).sin().powi(5);
    slow + 2.0 * (0.29 * t_s).sin()
}

/// What is said of a sensor that makes this of a current, ahead of ends that may be others than the model file's.
fn of(reading: impl Fn(f64) -> f64, [there, stated]: [Ends; 2], seed: u64) -> Report {
    let mut noise = noise(seed, NOISE_A);
    let t_s: Vec<f64> = (0..ROWS).map(|row| row as f64).collect();
    let current: Vec<f64> = t_s.iter().map(|t| current_a(*t)).collect();
    let value = current.iter().map(|i| there.of(reading(*i) + noise()));
    let value = value.collect();
    let mut problem = sensor(t_s, current, value, NOISE_A);
    problem.modelled = stated.stated();
    said(problem, seed, &[])
}

/// The one effect that is named has to be this one, its interval about the truth, and no wider than this.
#[track_caller]
fn assert_only(report: &Report, id: &str, truth: f64, within: f64) {
    let [effect] = report.effects.as_slice() else {
        panic!("{} {:#?}", report.summary, report.decisions);
    };
    assert_eq!(effect.id, id, "{}", report.summary);
    let [low, high] = effect.parameters[0].ci95;
    let width = high - low;
    assert!(
        low - 0.5 * width <= truth && truth <= high + 0.5 * width && width < within,
        "{truth}: {:?}",
        effect.parameters[0]
    );
}

#[test]
fn a_sensor_as_stated_has_no_mismatch() {
    for (seed, ends) in (0..6).zip(ALL.into_iter().cycle()) {
        let report = of(|i| i, [ends, ends], seed);
        let said = (&report.summary, &report.decisions);
        assert_eq!(report.verdict, Verdict::NoMismatch, "{said:#?}");
        let remark = |remark: &&String| remark.contains("tell no more than within");
        assert_eq!(report.remarks.iter().filter(remark).count(), 1, "{said:#?}");
        let left = &report.signals[0];
        // Noise of 0.5 A leaves so much, and not more.
        let times = left.rmse_before / left.noise_floor;
        assert!(
            left.noise_floor < NOISE_A && (times - 1.0).abs() < 0.15,
            "{left:?}"
        );
    }
}

#[test]
fn a_zero_error_is_told_through_it() {
    for (seed, ends) in (0..).zip(ALL) {
        assert_only(&of(|i| i + 0.4, [ends, ends], seed), "offset", 0.4, 0.15);
    }
}

#[test]
fn a_sensitivity_error_is_told_through_it() {
    for (seed, ends) in (0..).zip(ALL) {
        assert_only(&of(|i| 1.05 * i, [ends, ends], seed), "gain", 1.05, 0.04);
    }
}

/// What is not as stated is a mismatch, whichever way it differs; and where readings tell by themselves, a remark says which and why.
#[test]
fn other_ends_than_stated_are_no_agreement() {
    let threshold = |threshold| Ends { threshold, ..NONE };
    for (there, stated, told) in [
        (threshold(1.0), THRESHOLD, Some("[effects.dead-band]")),
        (threshold(6.0), THRESHOLD, None),
        (
            Ends { step: 6.0, ..NONE },
            STEPS,
            Some("[effects.quantisation]"),
        ),
        (Ends { rail: 9.0, ..NONE }, RAILS, None),
        (
            Ends { rail: 15.0, ..NONE },
            RAILS,
            Some("[effects.clipping]"),
        ),
    ] {
        let report = of(|i| i, [there, stated], 1);
        assert_ne!(report.verdict, Verdict::NoMismatch, "{}", report.summary);
        let remark = report
            .remarks
            .iter()
            .find(|remark| remark.contains("lets through"));
        match (told, remark) {
            (None, None) => {}
            (Some(told), Some(remark)) => assert!(remark.contains(told), "{remark}"),
            (told, remark) => panic!("{told:?} and {remark:?}"),
        }
    }
}
