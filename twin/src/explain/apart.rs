//! Whether a tester read its voltages at another moment than the currents of their rows.
//!
//! A tester scans its channels one after the other. The ohmic drop knows no delay (all else that a step of the current does comes after
//! it), so a voltage that answers a step in its row by less than the least ohmic resistance was read before it, and one that answers
//! the step of the next row was read after that.

use nalgebra::{DMatrix, DVector};

use super::slope::BASE_OFF;
use crate::effects::scene::{REFERENCE_C, arrhenius};
use crate::problem::{Base, Moments, Problem, View};

/// Standard errors that the answers have to be off by.
const SURE: f64 = 5.0;
/// Share of the ohmic resistance by which a voltage has to answer the next row's step.
const AHEAD: f64 = 0.1;
/// The largest Arrhenius temperature of a resistance, in K: so much less is it in a warm cell (usual lithium-ion cells 1500 … 4000 K).
const LARGEST_B_K: f64 = 4000.0;
/// Rows that are asked at least.
const FEWEST: usize = 50;
/// Steps of time that are longer than this many median ones are left out.
const LONG: f64 = 2.0;

/// Whether the voltages of a problem, if it is one of voltages, say so.
pub(super) fn reads_apart(problem: &Problem) -> bool {
    let Base::Battery(base) = &problem.base else {
        return false;
    };
    let on_rows = matches!(problem.observed.moments, Moments::EveryRow);
    if problem.view != View::Voltage || !on_rows || base.resistance_ohm <= 0.0 {
        return false;
    }
    let Some([at_once, ahead]) = answers(problem) else {
        return false;
    };
    let warmest_c = problem
        .drive
        .cell_temperature_c
        .iter()
        .flatten()
        .fold(REFERENCE_C, |most, t| most.max(*t));
    let least = (1.0 - BASE_OFF * base.resistance_sigma) * arrhenius(LARGEST_B_K, warmest_c);
    at_once.0 + SURE * at_once.1 < least * base.resistance_ohm
        || ahead.0 - SURE * ahead.1 > AHEAD * base.resistance_ohm
}

/// By how much voltages fall with a step of the current in their own row, and with one in the next, in Ω, each with its standard error:
/// linear regression of the changes of voltage on those of the current a row before, in the row and a row after.
fn answers(problem: &Problem) -> Option<[(f64, f64); 2]> {
    let (drive, observed) = (&problem.drive, &problem.observed);
    let longest_s = LONG * drive.median_step_s();
    let is_there = |row: usize| observed.valid[row] && observed.value[row].is_finite();
    let near = |row: usize| drive.t_s[row] - drive.t_s[row - 1] <= longest_s;
    let rows = || {
        let segments = drive.segments.iter().filter(|rows| rows.len() > 3);
        let inside = segments.flat_map(|rows| rows.start + 2..rows.end - 1);
        inside.filter(|&row| is_there(row) && is_there(row - 1) && (row - 1..=row + 1).all(near))
    };
    let step = |row: usize| drive.reference[row] - drive.reference[row - 1];
    let (mut normal, mut right, mut energy) = (DMatrix::zeros(3, 3), DVector::zeros(3), 0.0);
    let mut count = 0;
    for row in rows() {
        let steps = [step(row - 1), step(row), step(row + 1)];
        let fall = observed.value[row - 1] - observed.value[row];
        for (j, one) in steps.iter().enumerate() {
            for (k, other) in steps.iter().enumerate() {
                normal[(j, k)] += one * other;
            }
            right[j] += one * fall;
        }
        energy += fall * fall;
        count += 1;
    }
    let inverse = normal.try_inverse().filter(|_| count >= FEWEST)?;
    let answer: DVector<f64> = &inverse * &right;
    let left = (energy - answer.dot(&right)).max(0.0) / (count - 3) as f64;
    let told = |k: usize| (answer[k], (left * inverse[(k, k)]).max(0.0).sqrt());
    Some([told(1), told(2)])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::effects::scene::mean_flow;
    use crate::problem::{BatteryBase, Drive, Observed};

    const ROWS: usize = 2000;

    /// A cell of 10 mΩ that polarises, with steps of the current, its voltages read by a share of a row before (below 0: after) the
    /// currents.
    fn read(ahead: f64, polarises_ohm: f64) -> Problem {
        let t_s: Vec<f64> = (0..ROWS).map(|row| row as f64).collect();
        // Any sequence without a rhythm does.
        let current: Vec<f64> = (0..ROWS)
            .map(|row| (row as f64 * row as f64 * 0.37).sin() * 20.0)
            .collect();
        let mut slow = 0.0;
        let volts: Vec<f64> = (0..ROWS)
            .map(|row| {
                let before = current[row.saturating_sub(1)];
                let after = current[(row + 1).min(ROWS - 1)];
                slow += 0.3 * (mean_flow(before, current[row], 1.0) - slow);
                let there = if ahead > 0.0 { before } else { after };
                let then = current[row] + ahead.abs() * (there - current[row]);
                3.7 - 0.01 * then - polarises_ohm * slow + 1e-4 * (row as f64 * 7.1).sin()
            })
            .collect();
        let mut problem = Problem::pair(t_s.clone(), current.clone(), volts.clone(), 1e-4);
        problem.view = View::Voltage;
        problem.observed = Observed::with_drive(t_s.clone(), volts);
        problem.base = Base::Battery(BatteryBase {
            resistance_ohm: 0.01,
            resistance_sigma: 0.05,
            cells: 1.0,
            ..BatteryBase::default()
        });
        problem
    }

    #[test]
    fn voltages_that_were_read_at_another_moment_are_told_from_a_cell_that_polarises() {
        for polarises_ohm in [0.0, 0.01, 0.05] {
            assert!(!reads_apart(&read(0.0, polarises_ohm)), "{polarises_ohm}");
            // A fast polarisation answers in the row of the step as well, and hides a voltage that was read early.
            assert!(reads_apart(&read(-0.5, polarises_ohm)), "{polarises_ohm}");
        }
        assert!(reads_apart(&read(0.5, 0.0)));
    }

    #[test]
    fn a_warm_cell_has_less_resistance_and_is_not_read_early() {
        let mut problem = read(0.0, 0.0);
        problem.drive = Drive {
            cell_temperature_c: Some(vec![45.0; ROWS].into()),
            ..problem.drive.clone()
        };
        for volts in &mut problem.observed.value {
            *volts = 3.7 + 0.6 * (*volts - 3.7);
        }
        assert!(!reads_apart(&problem));
    }
}
