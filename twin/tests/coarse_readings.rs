//! A battery's readings in steps: at rest they have one rounding error for hours, which counts once.

use crate::common::{noise, prepared, said};
use twin::report::data::{Report, Verdict};

/// Seconds of drive, and of rest after it.
const DRIVE_S: usize = 1600;
const REST_S: usize = 6000;
const INITIAL_SOC: f64 = 0.9;
const BY_DESIGN_AH: f64 = 60.0;

/// What is said of a cell of a capacity whose readings of a kind come in steps, after a drive and a rest.
fn read_in_steps(column: &str, step: f64, capacity_ah: f64, seed: u64) -> Report {
    let mut load_a = noise(seed, 60.0);
    let mut noise = noise(seed + 100, 0.2 * step);
    let (mut charge_c, mut current_a) = (0.0, 0.0);
    let mut text = format!("t_s,i_ref_a,{column}\n");
    for second in 0..DRIVE_S + REST_S {
        let before_a = current_a;
        if second >= DRIVE_S {
            current_a = 0.0;
        } else if second % 20 == 0 {
            current_a = 40.0 + load_a();
        }
        if second > 0 {
            charge_c += 0.5 * (before_a + current_a);
        }
        let soc = INITIAL_SOC - charge_c / 3600.0 / capacity_ah;
        let value = match column {
            "soc_pct" => 100.0 * soc,
            _ => 3.2 + 0.9 * soc,
        };
        let read = ((value + noise()) / step).round() * step;
        text.push_str(&format!("{second},{current_a},{read:.4}\n"));
    }
    // What is stated is what rounding has in the mean, as if each reading were rounded for itself.
    let stated = step / 12f64.sqrt();
    let model = format!(
        "schema = 1\n[battery]\ncapacity_ah = {BY_DESIGN_AH}\ninitial_soc = {INITIAL_SOC}\n\
         ocv = [[0, 3.2], [1, 4.1]]\nnoise_pct = {stated}\nnoise_v = {stated}\n"
    );
    let mut prepared = prepared(&text, &model);
    assert!(
        prepared
            .remarks
            .iter()
            .any(|said| said.contains("steps of")),
        "{:?}",
        prepared.remarks
    );
    said(prepared.items.remove(0).problem, seed, &[])
}

#[test]
fn a_rest_at_one_reading_is_no_capacity() {
    for (column, step) in [("soc_pct", 0.5), ("soc_pct", 1.0), ("v_cell_v", 0.005)] {
        for seed in 1..7 {
            let report = read_in_steps(column, step, BY_DESIGN_AH, seed);
            assert_eq!(
                report.verdict,
                Verdict::NoMismatch,
                "{column} {seed}: {:?}",
                report.effects
            );
        }
    }
}

#[test]
fn a_capacity_that_is_less_is_found_within_what_the_steps_tell() {
    for (column, step) in [("soc_pct", 0.5), ("v_cell_v", 0.005)] {
        let mut covered = 0;
        for seed in 1..7 {
            let report = read_in_steps(column, step, 54.0, seed);
            assert_eq!(report.effects.len(), 1, "{column} {seed}: {report:?}");
            let effect = &report.effects[0];
            let named = std::iter::once(&effect.id).chain(&effect.equivalent_to);
            assert!(named.clone().any(|id| id == "capacity"), "{effect:?}");
            let [low, high] = effect.parameters[0].ci95;
            covered += usize::from(effect.id == "capacity" && (low..=high).contains(&54.0));
        }
        assert!(covered >= 5, "{column}: {covered} of 6");
    }
}
