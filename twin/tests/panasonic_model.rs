//! The Panasonic cell's model file, derived again from the two tests that it is from (recordings/panasonic-18650pf/README.md), and
//! what its pulse test says of its resistance.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::path::{Path, PathBuf};

use recording::Recording;

const CAPACITY_AH: f64 = 2.81;
/// The tester's own count of the C/20 discharge.
const COUNTED_AH: f64 = 2.9973;
/// Below this current the cell rests, in A.
const RESTS_A: f64 = 0.05;
/// A rest after which the voltage is taken for the open-circuit one: 20 minutes, less a row, in s.
const REST_S: f64 = 1190.0;
/// Below this state of charge straight lines join the rests.
const STRAIGHT_BELOW: f64 = 0.065;

fn file(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../recordings/panasonic-18650pf")
        .join(name)
}

fn read(name: &str) -> Recording {
    recording::csv::read(&file(name)).unwrap()
}

/// Linear interpolation over points of ascending x; the end's value beyond it.
fn between(points: &[(f64, f64)], x: f64) -> f64 {
    let at = points.partition_point(|point| point.0 <= x);
    if at == 0 || at == points.len() {
        return points[at.saturating_sub(1)].1;
    }
    let ((x0, y0), (x1, y1)) = (points[at - 1], points[at]);
    y0 + (y1 - y0) * (x - x0) / (x1 - x0)
}

/// Both branches of the slow test, charge in true Ah if the cell's capacity is as given: the tester's zero is in the current both ways.
struct SlowTest {
    discharge: Vec<(f64, f64)>,
    charge: Vec<(f64, f64)>,
    /// After the hour at rest that follows the discharge, in V.
    empty_v: f64,
}

impl SlowTest {
    fn of_capacity(test: &Recording, capacity_ah: f64) -> Self {
        let [i, v, ah] = ["i_ref_a", "v_cell_v", "ah_meas_ah"].map(|name| test.need(name).unwrap());
        let rows = |way: f64| {
            (0..i.len())
                .filter(|row| way * i[*row] > RESTS_A)
                .collect::<Vec<usize>>()
        };
        let (out, back) = (rows(1.0), rows(-1.0));
        let (full_ah, empty_ah) = (ah[out[0] - 1], ah[out[out.len() - 1]]);
        let true_share = capacity_ah / (empty_ah - full_ah);
        let mut discharge: Vec<(f64, f64)> = out
            .iter()
            .map(|&row| (1.0 - (ah[row] - full_ah) / (empty_ah - full_ah), v[row]))
            .collect();
        discharge.reverse();
        let charge = back
            .iter()
            .map(|&row| {
                (
                    (empty_ah - ah[row]) * (2.0 - true_share) / capacity_ah,
                    v[row],
                )
            })
            .collect();
        Self {
            discharge,
            charge,
            empty_v: v[back[0] - 1],
        }
    }

    /// Mean of both branches; above the end of the charge, the discharge and half of the last gap.
    fn mean_v(&self, soc: f64) -> f64 {
        let (end, end_v) = *self.charge.last().unwrap();
        let below = between(&self.discharge, soc);
        if soc <= end {
            0.5 * (below + between(&self.charge, soc))
        } else {
            below + 0.5 * (end_v - between(&self.discharge, end))
        }
    }
}

/// Charge drawn in Ah and voltage at the end of each long rest of the pulse test, and before its first pulse.
fn rests() -> Vec<(f64, f64)> {
    let test = read("25c-hppc.csv");
    let t = test.time_s();
    let [i, v, ah] = ["i_ref_a", "v_cell_v", "ah_meas_ah"].map(|name| test.need(name).unwrap());
    let mut ended = f64::NEG_INFINITY;
    let mut found = Vec::new();
    for row in 1..t.len() {
        if i[row - 1].abs() > RESTS_A {
            ended = t[row - 1];
        } else if i[row].abs() > RESTS_A && t[row - 1] - ended >= REST_S {
            found.push((ah[row - 1], v[row - 1]));
        }
    }
    found
}

#[test]
fn the_table_is_the_pulse_tests_rests_in_the_slow_tests_shape() {
    let slow = SlowTest::of_capacity(&read("25c-c20-ocv-test.csv"), CAPACITY_AH);
    let mut rests: Vec<(f64, f64)> = rests()
        .into_iter()
        .map(|(ah, v)| (1.0 - ah / CAPACITY_AH, v))
        .collect();
    rests.push((0.0, slow.empty_v));
    rests.sort_by(|a, b| a.0.total_cmp(&b.0));
    assert_eq!(rests.len(), 68);
    let straight_to = rests
        .iter()
        .map(|rest| rest.0)
        .filter(|soc| *soc < STRAIGHT_BELOW)
        .fold(0.0, f64::max);
    let off: Vec<(f64, f64)> = rests
        .iter()
        .map(|(soc, v)| (*soc, v - slow.mean_v(*soc)))
        .collect();
    let table = recording::csv::read_table(&file("ocv_25c.csv")).unwrap();
    let [soc, ocv_v] = ["soc", "ocv_v"].map(|name| table.column(name).unwrap());
    assert_eq!(soc.len(), 201);
    for (soc, said) in soc.iter().zip(ocv_v) {
        let derived = if *soc < straight_to {
            between(&rests, *soc)
        } else {
            slow.mean_v(*soc) + between(&off, *soc)
        };
        assert!((said - derived).abs() < 0.0001, "{soc}: {said}, {derived}");
    }
    assert!(ocv_v.windows(2).all(|pair| pair[0] < pair[1]));
    let model = std::fs::read_to_string(file("../../models/panasonic-18650pf.toml")).unwrap();
    assert!(model.contains(&format!("\ncapacity_ah = {CAPACITY_AH}\n")));
}

#[test]
fn the_rests_lie_evenly_between_both_branches_with_this_capacity_alone() {
    let (test, rests) = (read("25c-c20-ocv-test.csv"), rests());
    // Spread of the rests about the mean of the branches, in V, where both are there.
    let spread_v = |capacity_ah: f64| {
        let slow = SlowTest::of_capacity(&test, capacity_ah);
        let off: Vec<f64> = rests
            .iter()
            .filter(|(ah, _)| (0.1..2.5).contains(ah))
            .map(|(ah, v)| v - slow.mean_v(1.0 - ah / capacity_ah))
            .collect();
        let mean = off.iter().sum::<f64>() / off.len() as f64;
        let energy: f64 = off.iter().map(|off| (off - mean).powi(2)).sum();
        (energy / off.len() as f64).sqrt()
    };
    let best_ah = (0..=80)
        .map(|step| 2.65 + 0.005 * f64::from(step))
        .min_by(|a, b| spread_v(*a).total_cmp(&spread_v(*b)))
        .unwrap();
    assert!((best_ah - CAPACITY_AH).abs() < 0.03, "{best_ah} Ah");
    let (here, counted) = (spread_v(CAPACITY_AH), spread_v(COUNTED_AH));
    assert!(here < 0.006, "{here} V");
    assert!(counted > 2.5 * here, "{here}, {counted} V");
}

/// A tenth of a second into the pulses of C/2: what twin finds in US06, near full as near empty, is in another test of the cell.
#[test]
fn the_pulses_show_a_resistance_that_rises_at_both_ends() {
    let test = read("25c-hppc.csv");
    let t = test.time_s();
    let [i, v, ah] = ["i_ref_a", "v_cell_v", "ah_meas_ah"].map(|name| test.need(name).unwrap());
    let pulses: Vec<(f64, f64)> = (1..t.len() - 5)
        .filter(|&row| i[row - 1].abs() < RESTS_A && i[row].abs() > RESTS_A)
        .filter(|&row| (1.3..1.6).contains(&i[row + 2]))
        .map(|row| {
            let volts: Vec<(f64, f64)> = (row..row + 4).map(|k| (t[k], v[k])).collect();
            let drop_v = v[row - 1] - between(&volts, t[row] + 0.1);
            (1.0 - ah[row - 1] / CAPACITY_AH, drop_v / i[row + 2])
        })
        .collect();
    assert!(pulses.len() >= 14, "{}", pulses.len());
    let mean_of = |from: f64, to: f64| {
        let of: Vec<f64> = pulses
            .iter()
            .filter(|(soc, _)| (from..to).contains(soc))
            .map(|(_, ohm)| *ohm)
            .collect();
        assert!(!of.is_empty());
        of.iter().sum::<f64>() / of.len() as f64
    };
    let middle = mean_of(0.4, 0.8);
    let (full, empty) = (mean_of(0.98, 1.01), mean_of(0.05, 0.15));
    assert!((1.15..1.5).contains(&(full / middle)), "{full}, {middle} Ω");
    assert!(empty / middle > 1.25, "{empty}, {middle} Ω");
}
