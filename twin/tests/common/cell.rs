//! A cell that is made here, by loops on a grid ten times finer than the rows, and what is said of it. Evidence of kind (d): our own
//! simulator; it guards against regressions and proves nothing more.

use std::fs;

use serde_json::Value;

use crate::{
    command::{EXPLAIN, twin},
    common::noise,
};

pub const ROWS: usize = 2400;
pub const FINE: usize = 10;
pub const NOISE_V: f64 = 0.001;
pub const DESIGN_AH: f64 = 3.0;
pub const DESIGN_OHM: f64 = 0.03;

pub fn open_circuit_v(soc: f64) -> f64 {
    3.0 + 1.1 * soc + 0.05 * (5.0 * soc).sin()
}

/// A cell and how it is recorded.
#[derive(Clone, Copy)]
pub struct Cell {
    pub capacity_ah: f64,
    pub resistance_ohm: f64,
    /// A branch of 60 s, in Ω.
    pub slow_ohm: f64,
    /// What the recorded current is above the cell's, in A.
    pub current_zero_a: f64,
    /// What it is discharged by beside the recorded current, in A.
    pub load_a: f64,
}

pub const AS_DESIGNED: Cell = Cell {
    capacity_ah: DESIGN_AH,
    resistance_ohm: DESIGN_OHM,
    slow_ohm: 0.0,
    current_zero_a: 0.0,
    load_a: 0.0,
};

/// Rows of one operation from a state of charge on, the first reading off by so much.
pub fn operation(cell: Cell, soc: f64, first_v: f64, cycle: usize, seed: u64) -> String {
    let mut load_a = noise(seed, 4.0);
    let mut noise_v = noise(seed + 1000, NOISE_V);
    let (mut soc, mut slow_a, mut target_a, mut current_a) = (soc, 0.0, 0.0, 0.0);
    let mut text = String::new();
    for k in 0..ROWS * FINE {
        if k % (25 * FINE) == 0 {
            target_a = if k == 0 { 0.0 } else { 2.0 + load_a() };
        }
        if k % FINE == 0 {
            let error_v = if k == 0 { first_v } else { noise_v() };
            let ohmic_v = cell.resistance_ohm * (current_a + cell.load_a);
            let volts = open_circuit_v(soc) - ohmic_v - cell.slow_ohm * slow_a;
            text.push_str(&format!(
                "{},{cycle},{:.5},{:.5}\n",
                k / FINE,
                current_a + cell.current_zero_a,
                volts + error_v
            ));
        }
        let before_a = current_a;
        // From row to row in straight lines, as a recording is read: the load changes within a second.
        let step_a = (target_a - current_a) / (FINE - k % FINE) as f64;
        current_a += step_a;
        let dt = 1.0 / FINE as f64;
        let mean_a = 0.5 * (before_a + current_a);
        soc -= (mean_a + cell.load_a) * dt / 3600.0 / cell.capacity_ah;
        slow_a += (mean_a - slow_a) * (1.0 - (-dt / 60.0).exp());
    }
    text
}

pub fn log(operations: &[String]) -> String {
    format!("t_s,cycle,i_ref_a,v_cell_v\n{}", operations.concat())
}

pub fn model(more: &str) -> String {
    let table: Vec<String> = (0..=400)
        .map(|k| f64::from(k) / 400.0)
        .map(|soc| format!("[{soc}, {:.6}]", open_circuit_v(soc)))
        .collect();
    format!(
        "schema = 1\n[battery]\ncapacity_ah = {DESIGN_AH}\nohmic_resistance_ohm = {DESIGN_OHM}\nnoise_v = {NOISE_V}\n{more}\nocv = [{}]\n",
        table.join(", ")
    )
}

/// What is said of a recording under a model, beside a file that is never fitted.
pub fn said(model: &str, fitted: &str, other: Option<&str>) -> Value {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let write = |name: &str, text: &str| fs::write(folder.join(name), text).unwrap();
    write("m.toml", model);
    write("r.csv", fitted);
    let mut arguments = EXPLAIN.to_vec();
    if let Some(other) = other {
        write("h.csv", other);
        arguments.extend(["--holdout", "h.csv"]);
    }
    let output = twin(folder, &arguments);
    assert_eq!(
        output.status.code(),
        Some(0),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    serde_json::from_str(&fs::read_to_string(folder.join("out/report.json")).unwrap()).unwrap()
}

pub fn names(report: &Value) -> Vec<&str> {
    let effects = report["effects"].as_array().unwrap().iter();
    effects
        .map(|effect| effect["id"].as_str().unwrap())
        .collect()
}
