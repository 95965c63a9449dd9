//! A gap in a battery's recording: what flowed there is not known, is told by the voltages on both sides, and is no physics.

use crate::cell::{
    AS_DESIGNED, Cell, DESIGN_AH, DESIGN_OHM, NOISE_V, log, model, names, open_circuit_v,
    operation, said,
};
use crate::common;

/// Gaps of some seconds, each from a time in s on.
type Gaps<'a> = &'a [(u32, u32)];

const GAPS: [Gaps<'static>; 4] = [
    &[(610, 120)],
    &[(1530, 120)],
    &[(1107, 400)],
    &[(415, 90), (1320, 200), (1888, 60)],
];

/// One operation without the rows in its gaps.
fn cut(cell: Cell, gaps: Gaps<'_>, seed: u64) -> String {
    let is_there = |line: &&str| {
        let t_s: u32 = line.split(',').next().unwrap().parse().unwrap();
        !gaps
            .iter()
            .any(|(from_s, long_s)| (*from_s..from_s + long_s).contains(&t_s))
    };
    let rows = operation(cell, 0.9, 0.0005, 0, seed);
    let left: Vec<String> = rows
        .lines()
        .filter(is_there)
        .map(|line| format!("{line}\n"))
        .collect();
    log(&left)
}

/// Cells with an effect that the design lacks, and the value of its first parameter.
fn concealed() -> [(&'static str, Cell, f64); 3] {
    [
        (
            "capacity",
            Cell {
                capacity_ah: 2.7,
                ..AS_DESIGNED
            },
            2.7,
        ),
        (
            "polarisation",
            Cell {
                slow_ohm: 0.015,
                ..AS_DESIGNED
            },
            0.015,
        ),
        (
            "parasitic-load",
            Cell {
                load_a: 0.1,
                ..AS_DESIGNED
            },
            0.1,
        ),
    ]
}

#[test]
fn a_gap_is_no_mismatch() {
    for gaps in GAPS {
        for seed in 1..4 {
            let report = said(&model(""), &cut(AS_DESIGNED, gaps, seed), None);
            let what = format!("{gaps:?} {seed}: {}", report["summary"]);
            assert_eq!(report["verdict"], "no-mismatch", "{what}");
        }
    }
}

#[test]
fn an_effect_is_found_through_gaps() {
    for (id, cell, truth) in concealed() {
        let (mut covered, mut count) = (0, 0);
        for gaps in GAPS {
            for seed in 1..4 {
                let report = said(&model(""), &cut(cell, gaps, seed), None);
                let what = format!("{id} {gaps:?} {seed}: {}", report["summary"]);
                assert_eq!(names(&report), [id], "{what}");
                let interval = &report["effects"][0]["parameters"][0]["ci95"];
                let [low, high] = [0, 1].map(|end| interval[end].as_f64().unwrap());
                covered += usize::from(low <= truth && truth <= high);
                count += 1;
            }
        }
        // Of twelve intervals of 95 %, three or more miss in two of a hundred cases.
        assert!(covered + 2 >= count, "{id}: {covered} of {count}");
    }
}

#[test]
fn a_file_with_gaps_that_was_never_fitted_is_judged_by_its_physics() {
    for (id, cell, _) in concealed() {
        // Of three gaps within minutes a cell remembers more than a tenth of the readings can be left out for.
        for (gaps, seed) in GAPS[..3].iter().copied().zip(1..) {
            let fitted = log(&[operation(cell, 0.9, 0.0005, 0, seed)]);
            let other = cut(cell, gaps, seed + 50);
            let report = said(&model(""), &fitted, Some(&other));
            let what = format!("{id} {gaps:?}: {}", report["summary"]);
            assert_eq!(names(&report), [id], "{what}");
            let there = |key: &str| report["holdouts"][0][key].as_f64().unwrap();
            assert!(there("rmse_after") < 1.2 * NOISE_V, "{what}");
            assert!(there("rmse_before") > 2.0 * NOISE_V, "{what}");
        }
    }
}

/// Charge over a gap that the tester's counter tells acts on what a cell remembers as it does where it was recorded.
#[test]
fn what_a_counter_knows_of_a_gap_a_cell_remembers() {
    for over_gap_a in [3.0, -2.0, 0.0] {
        let gap = 300..=900;
        let (mut soc, mut slow_a, mut counted_ah) = (0.7, 0.0, 0.0);
        let mut text = "t_s,i_ref_a,v_cell_v,ah_meas_ah\n".to_owned();
        let mut after = Vec::new();
        for t_s in 0..1800 {
            let current_a = |t_s: i32| match t_s {
                61..=120 => 2.0,
                t_s if gap.contains(&t_s) => over_gap_a,
                _ => 0.0,
            };
            let recorded = t_s == 300 || t_s == 900 || !gap.contains(&t_s);
            if recorded {
                // At the gap's ends it rests.
                let here_a = if gap.contains(&t_s) {
                    0.0
                } else {
                    current_a(t_s)
                };
                let volts = open_circuit_v(soc) - DESIGN_OHM * here_a - 0.01 * slow_a;
                text.push_str(&format!("{t_s},{here_a},{volts:.7},{counted_ah:.9}\n"));
                if t_s >= 900 {
                    after.push(volts);
                }
            }
            // In straight lines from row to row, but over the gap, where it is switched.
            let mean_a = if (300..900).contains(&t_s) {
                over_gap_a
            } else {
                let next_a = if t_s + 1 == 300 {
                    0.0
                } else {
                    current_a(t_s + 1)
                };
                let here_a = if t_s == 900 { 0.0 } else { current_a(t_s) };
                0.5 * (here_a + next_a)
            };
            soc -= mean_a / 3600.0 / DESIGN_AH;
            counted_ah += mean_a / 3600.0;
            slow_a += (mean_a - slow_a) * (1.0 - f64::exp(-1.0 / 300.0));
        }
        let extended = format!(
            "{}[effects.polarisation]\nr1_ohm = 0.01\ntau1_s = 300\n",
            model("initial_soc = 0.7")
        );
        let prepared = common::prepared(&text, &extended);
        let problem = &prepared.items[0].problem;
        let said = twin::explain::predict(problem, &[]);
        let said = &said[said.len() - after.len()..];
        for (row, (said, expected)) in said.iter().zip(&after).enumerate() {
            assert!(
                (said - expected).abs() < 1e-4,
                "{over_gap_a} A, {row} s after the gap: {said} and {expected}"
            );
        }
    }
}
