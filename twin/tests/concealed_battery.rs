//! Charge transfer and relaxation concealed in the voltage of a cell on a real drive.
//!
//! The current is real (recordings/panasonic-18650pf); the voltage is made here: charge transfer from Butler–Volmer's equation as it
//! stands, solved by bisection, relaxation from branches, one by one. Evidence of kind (d): our own simulator; it guards against
//! regressions and proves nothing more.

use std::path::Path;

use crate::common::{noise, said};

use twin::problem::{Accuracy, Base, BatteryBase, Coloured, Drive, Observed, Problem, View};
use twin::report::data::{Report, Verdict};

const ROWS: usize = 3600;
const STEP_S: f64 = 0.5;
const NOISE_V: f64 = 0.001;
const CAPACITY_AH: f64 = 2.9973;
const RESISTANCE_OHM: f64 = 0.0225;
const GAS_OVER_FARADAY: f64 = 8.314_463 / 96_485.332;

fn current_a() -> Vec<f64> {
    let path =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../recordings/panasonic-18650pf/25c-us06.csv");
    let recording = recording::csv::read(&path).unwrap();
    let (t, i) = (recording.time_s(), recording.need("i_ref_a").unwrap());
    let mut at = 0;
    (0..ROWS)
        .map(|k| {
            let now = t[0] + k as f64 * STEP_S;
            while t[at + 1] <= now {
                at += 1;
            }
            i[at] + (i[at + 1] - i[at]) * (now - t[at]) / (t[at + 1] - t[at])
        })
        .collect()
}

fn open_circuit_v(soc: f64) -> f64 {
    3.2 + 0.9 * soc
}

/// The overvoltage at a current, by bisection.
fn overvoltage_v(i: f64, exchange_a: f64, kelvin: f64) -> f64 {
    let thermal_v = GAS_OVER_FARADAY * kelvin;
    let flow = |v: f64| exchange_a * ((0.5 * v / thermal_v).exp() - (-0.5 * v / thermal_v).exp());
    let (mut low, mut high) = (-1.0, 1.0);
    for _ in 0..80 {
        let middle = 0.5 * (low + high);
        if flow(middle) < i {
            low = middle;
        } else {
            high = middle;
        }
    }
    0.5 * (low + high)
}

/// A cell with an exchange current at 25 °C (infinite: none of it), whose resistances follow temperature by `b_k`.
fn explained(exchange_a: f64, b_k: f64, around_c: f64, seed: u64) -> Report {
    let current = current_a();
    let temperature: Vec<f64> = (0..ROWS)
        .map(|k| around_c + 6.0 * (k as f64 * STEP_S / 300.0).sin())
        .collect();
    let mut noise = noise(seed, NOISE_V);
    let slope_ohm = GAS_OVER_FARADAY * 298.15 / exchange_a;
    let (mut charge_ah, mut before) = (0.0, current[0]);
    let value = current
        .iter()
        .zip(&temperature)
        .map(|(&i, &celsius)| {
            charge_ah += 0.5 * (i + before) * STEP_S / 3600.0;
            before = i;
            let kelvin = celsius + 273.15;
            let factor = (b_k * (1.0 / kelvin - 1.0 / 298.15)).exp();
            let transfer_v = if exchange_a.is_finite() {
                // The slope at small currents is RT/F over the exchange current, at each temperature.
                let straight_v = slope_ohm * kelvin / 298.15 * factor * i;
                overvoltage_v(i, exchange_a / factor, kelvin) - straight_v
            } else {
                0.0
            };
            let open_v = open_circuit_v(0.9 - charge_ah / CAPACITY_AH);
            open_v - RESISTANCE_OHM * factor * i - transfer_v + noise()
        })
        .collect();
    let modelled = if b_k == 0.0 {
        Vec::new()
    } else {
        vec![("resistance-temperature", vec![b_k])]
    };
    report(current, temperature, value, modelled, seed, &[])
}

/// What is said of a cell's voltage.
fn report(
    current: Vec<f64>,
    temperature: Vec<f64>,
    value: Vec<f64>,
    modelled: Vec<(&'static str, Vec<f64>)>,
    seed: u64,
    without: &[&str],
) -> Report {
    let t_s: Vec<f64> = (0..ROWS).map(|k| k as f64 * STEP_S).collect();
    let problem = Problem {
        view: View::Voltage,
        name: "v_cell_v".into(),
        unit: "V".into(),
        drive: Drive {
            t_s: t_s.clone().into(),
            reference: current.into(),
            cell_temperature_c: Some(temperature.into()),
            segments: std::iter::once(0..ROWS).collect(),
            continues: vec![false],
            ..Drive::default()
        },
        observed: Observed::with_drive(t_s, value),
        base: Base::Battery(BatteryBase {
            capacity_ah: CAPACITY_AH,
            efficiency: 1.0,
            initial_soc: vec![0.9],
            ocv: vec![(0.0, open_circuit_v(0.0)), (1.0, open_circuit_v(1.0))],
            cells: 1.0,
            resistance_ohm: RESISTANCE_OHM,
            resistance_sigma: 0.05,
            ..BatteryBase::default()
        }),
        modelled,
        noise: NOISE_V,
        coloured: Coloured::default(),
        accuracy: Accuracy::default(),
    };
    said(problem, seed, without)
}

#[track_caller]
fn assert_found(report: &Report, exchange_a: f64) {
    assert_eq!(report.effects.len(), 1, "{:?}", report.decisions);
    let effect = &report.effects[0];
    assert_eq!(effect.id, "charge-transfer", "{:?}", report.decisions);
    let found = &effect.parameters[0];
    assert!(
        (found.value / exchange_a - 1.0).abs() < 0.1,
        "{found:?} for {exchange_a}"
    );
}

#[test]
fn charge_transfer_is_named_with_its_exchange_current() {
    for (seed, exchange_a) in [(1, 1.5), (2, 3.0)] {
        assert_found(&explained(exchange_a, 0.0, 25.0, seed), exchange_a);
    }
}

#[test]
fn in_the_cold_it_is_larger_by_the_law_of_the_resistance() {
    assert_found(&explained(2.5, 3500.0, 0.0, 3), 2.5);
}

#[test]
fn a_straight_resistance_has_none() {
    for seed in 4..8 {
        let report = explained(f64::INFINITY, 0.0, 25.0, seed);
        assert_eq!(
            report.verdict,
            Verdict::NoMismatch,
            "{:?}",
            report.decisions
        );
    }
}

#[test]
fn an_exchange_current_far_above_the_current_is_a_straight_resistance() {
    let report = explained(200.0, 0.0, 25.0, 8);
    assert_eq!(
        report.verdict,
        Verdict::NoMismatch,
        "{:?}",
        report.decisions
    );
}

/// A cell that relaxes through branches of so many ohms and seconds.
fn relaxed(branches: &[(f64, f64)], seed: u64, without: &[&str]) -> Report {
    let current = current_a();
    let mut noise = noise(seed, NOISE_V);
    let mut through = vec![0.0; branches.len()];
    let (mut charge_ah, mut before) = (0.0, current[0]);
    let value = current
        .iter()
        .map(|&i| {
            charge_ah += 0.5 * (i + before) * STEP_S / 3600.0;
            let mut slow_v = 0.0;
            for ((r_ohm, tau_s), flow) in branches.iter().zip(&mut through) {
                // Exact on the straight line between two rows.
                let kept = (-STEP_S / tau_s).exp();
                let ramp = 1.0 - tau_s / STEP_S * (1.0 - kept);
                *flow = kept * *flow + (1.0 - kept) * before + ramp * (i - before);
                slow_v += r_ohm * *flow;
            }
            before = i;
            open_circuit_v(0.9 - charge_ah / CAPACITY_AH) - RESISTANCE_OHM * i - slow_v + noise()
        })
        .collect();
    report(current, vec![25.0; ROWS], value, Vec::new(), seed, without)
}

#[test]
fn one_branch_is_named() {
    let report = relaxed(&[(0.004, 40.0)], 9, &[]);
    assert_eq!(report.verdict, Verdict::Explained, "{:?}", report.decisions);
    assert_eq!(report.effects.len(), 1, "{:?}", report.decisions);
    let effect = &report.effects[0];
    assert_eq!(effect.id, "polarisation");
    let [low, high] = effect.parameters[1].ci95;
    assert!((low..=high).contains(&40.0), "{effect:?}");
}

#[test]
fn branches_that_could_stand_for_any_relaxation_are_doubted() {
    // Resistances and times as a diffusion would have them: it is taken out, and a ladder fits as well.
    let branches = [
        (0.0012, 160.0),
        (0.0003, 40.0),
        (0.00013, 18.0),
        (0.00008, 10.0),
    ];
    let report = relaxed(&branches, 10, &["diffusion"]);
    assert_eq!(report.effects.len(), 1, "{:?}", report.decisions);
    assert_eq!(report.effects[0].id, "polarisation");
    assert!(report.effects[0].parameters.len() > 2, "{report:?}");
    assert_eq!(report.verdict, Verdict::Ambiguous, "{:?}", report.decisions);
    let said = report.decisions.join("\n");
    assert!(said.contains("follows any process of its kind"), "{said}");
}

/// A cell whose true current is so much larger than the recorded one.
fn unseen(load_a: f64, seed: u64) -> Report {
    let recorded = current_a();
    let mut noise = noise(seed, NOISE_V);
    let (mut charge_ah, mut before) = (0.0, recorded[0] + load_a);
    let value = recorded
        .iter()
        .map(|recorded| {
            let i = recorded + load_a;
            charge_ah += 0.5 * (i + before) * STEP_S / 3600.0;
            before = i;
            open_circuit_v(0.9 - charge_ah / CAPACITY_AH) - RESISTANCE_OHM * i + noise()
        })
        .collect();
    report(recorded, vec![25.0; ROWS], value, Vec::new(), seed, &[])
}

#[test]
fn a_consumer_may_be_a_recorded_current_that_is_off() {
    let report = unseen(0.08, 11);
    assert_eq!(report.verdict, Verdict::Explained, "{:?}", report.decisions);
    assert_eq!(report.effects[0].id, "parasitic-load");
    let said = report.remarks.join("\n");
    assert!(said.contains("A too low all along"), "{said}");
    assert!(said.contains("is stated by current_zero_a"), "{said}");
    // None that supplies.
    let report = unseen(-0.08, 12);
    assert_eq!(report.verdict, Verdict::Ambiguous, "{:?}", report.decisions);
    assert_eq!(report.effects[0].id, "parasitic-load");
    let said = &report.summary;
    assert!(said.contains("A too high all along"), "{said}");
}
