//! Slips of a log: single readings that are something else than their neighbours are of.
//!
//! A dropped byte, a refused frame, a converter that was read in the middle of a write. Left in, one of fifty amperes in a noise of a tenth
//! weighs as much as hundreds of readings together, by Huber's loss too, and names that have nothing to do with it are not told from
//! placebos. It is known by standing alone: the readings before and after agree, it is far from both, and the current does not move
//! as much around it, so that no time, memory or filter of a sensor could have made it of the current. The first and the last reading of a
//! stretch (a sensor that was not up yet, a line that was cut) have both others to one side.

use recording::error::number;

use super::{checks::shown, series::quantile};
use crate::{
    effects::{
        chain::{Chain, Nuisance},
        find_with,
    },
    explain::{RARE, STRAY, robust::common},
    problem::{Problem, View},
    report::format::at_most,
};

/// Readings to either side within which the current is looked at.
const AROUND: usize = 3;
/// A slip is farther off than this many times what the simulation moves by there, …
const BEYOND_SIGNAL: f64 = 2.0;
/// … and than this many times what all but a few readings jump by against the simulation: where jumps are common they are the mismatch.
const BEYOND_JUMPS: f64 = 3.0;
/// Jumps that are not looked at for that, in times of the share of slips: each makes two.
const THEIRS: f64 = 3.0;
/// The two readings beside it differ by less than this share of it.
const AGREE: f64 = 0.5;
/// Steps to either side of an instant at which an effect acts, within which a reading may be that effect's.
const NEXT_TO: f64 = 1.5;

/// Has them count no more; in words, if there are some.
pub(super) fn leave_out(problem: &mut Problem) -> Option<String> {
    let slips = slips(problem);
    let (row, worst) = slips.iter().copied().max_by(|a, b| a.1.total_cmp(&b.1))?;
    let (count, are) = match slips.len() {
        1 => ("one reading".to_owned(), "is"),
        count => (format!("{count} readings"), "are"),
    };
    let at_s = problem.observed.t_s[row];
    for (row, _) in &slips {
        problem.observed.valid[*row] = false;
    }
    Some(format!(
        "{}: {count} {are} off by more than {STRAY} times the noise from the two beside, which agree, the worst by {} {} at {} s: \
         slips of the log, left out",
        problem.name,
        at_most(worst, 3),
        problem.unit,
        number(shown(at_s)),
    ))
}

/// Rows of slips, and by how much each is off, in the view's unit.
fn slips(problem: &Problem) -> Vec<(usize, f64)> {
    // A counter's slip is two of its differences; and behind what cuts or rounds a jump may be noise.
    let cuts = |(id, values): &(&'static str, Vec<f64>)| {
        find_with(id, values.len()).is_some_and(|effect| effect.cuts())
    };
    if !matches!(problem.view, View::Sensor | View::Voltage) || problem.modelled.iter().any(cuts) {
        return Vec::new();
    }
    let observed = &problem.observed;
    let plain = Chain::new(problem).run(&[], &Nuisance::default());
    let rows: Vec<usize> = (0..observed.value.len())
        .filter(|&row| {
            observed.valid[row] && observed.value[row].is_finite() && plain[row].is_finite()
        })
        .collect();
    let off = |row: usize| observed.value[row] - plain[row];
    let together = |rows: &[usize]| {
        let segment = |row: &usize| observed.segment_of(*row);
        rows.windows(2)
            .all(|pair| segment(&pair[0]) == segment(&pair[1]))
    };
    let jumps: Vec<f64> = rows
        .windows(2)
        .filter(|pair| together(pair))
        .map(|pair| (off(pair[1]) - off(pair[0])).abs())
        .collect();
    let Some(usual) = quantile(&mut jumps.clone(), 1.0 - THEIRS * RARE) else {
        return Vec::new();
    };
    let noise = problem
        .noise
        .max(common(&jumps) / std::f64::consts::SQRT_2)
        .max(observed.grid);
    let far = (STRAY * noise).max(BEYOND_JUMPS * usual);
    let instants_s = instants_s(problem);
    let next_to_s = NEXT_TO * problem.drive.median_step_s();
    let found: Vec<(usize, f64)> = (0..rows.len())
        .filter_map(|at| {
            let row = rows[at];
            // Its neighbours; at an end of a stretch both are to one side.
            let trio = [at.checked_sub(1), Some(at), at.checked_sub(2)]
                .into_iter()
                .flatten()
                .find_map(|from| rows.get(from..from + 3).filter(|trio| together(trio)))?;
            let mut beside = trio.iter().filter(|other| **other != row);
            let (one, other) = (*beside.next()?, *beside.next()?);
            let [from, to] = [off(row) - off(one), off(row) - off(other)];
            let alone = from.abs().min(to.abs());
            let around = at.saturating_sub(AROUND)..rows.len().min(at + AROUND + 1);
            let moves = || {
                let moves = rows[around.clone()]
                    .iter()
                    .map(|&other| (plain[other] - plain[row]).abs());
                moves.fold(0.0, f64::max)
            };
            let is_slip = from * to > 0.0
                && alone > far
                && (off(one) - off(other)).abs() < AGREE * alone
                && alone > BEYOND_SIGNAL * moves()
                && !is_near(&instants_s, observed.t_s[row], next_to_s);
            is_slip.then_some((row, alone))
        })
        .collect();
    if found.len() as f64 <= RARE * rows.len() as f64 {
        found
    } else {
        Vec::new()
    }
}

/// Times in s, ascending, at which alone an effect of the library acts.
fn instants_s(problem: &Problem) -> Vec<f64> {
    let mut all: Vec<f64> = crate::effects::LIBRARY
        .into_iter()
        .filter_map(|effect| effect.instants_s(problem))
        .flatten()
        .collect();
    all.sort_unstable_by(f64::total_cmp);
    all
}

fn is_near(instants_s: &[f64], t_s: f64, within_s: f64) -> bool {
    let at = instants_s.partition_point(|instant_s| *instant_s < t_s - within_s);
    instants_s
        .get(at)
        .is_some_and(|instant_s| *instant_s <= t_s + within_s)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    const NOISE_A: f64 = 0.1;

    /// What a sensor makes of a current in a row.
    type Reads = dyn Fn(usize, &[f64]) -> f64;

    /// Steps and waves, and a reading of them that is one percent too large, by noise of even spread, and with something in it.
    fn problem(rows: u32, of_row: impl Fn(usize, &[f64]) -> f64) -> Problem {
        let t_s: Vec<f64> = (0..rows).map(|row| 0.1 * f64::from(row)).collect();
        let current = |t: &f64| 20.0 * (t / 3.0).sin() + if t % 20.0 < 10.0 { 0.0 } else { 60.0 };
        let reference: Vec<f64> = t_s.iter().map(current).collect();
        let mut state = 1u32;
        let mut noise = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            NOISE_A * 12f64.sqrt() * (f64::from(state) / 2f64.powi(32) - 0.5)
        };
        let reading = (0..reference.len()).map(|row| 1.01 * of_row(row, &reference) + noise());
        let reading = reading.collect();
        Problem::pair(t_s, reference, reading, NOISE_A)
    }

    fn found(problem: &Problem) -> Vec<usize> {
        slips(problem).into_iter().map(|(row, _)| row).collect()
    }

    #[test]
    fn single_readings_far_off_are_found_wherever_the_current_does_not_move_as_much() {
        for by_a in [-200.0, -5.0, 5.0, 200.0] {
            for row in (1..3999).step_by(97) {
                let slipped = problem(4000, |at, i| i[at] + if at == row { by_a } else { 0.0 });
                // Around a step of 60 A less than that is no slip.
                let at_step = row > 50 && (row + 3) % 100 < 7;
                let expected = if at_step && by_a.abs() < 120.0 {
                    vec![]
                } else {
                    vec![row]
                };
                assert_eq!(found(&slipped), expected, "{by_a} A in row {row}");
            }
        }
        // The first and the last one, too.
        for row in [0, 1, 3998, 3999] {
            let slipped = problem(4000, |at, i| i[at] + if at == row { -200.0 } else { 0.0 });
            assert_eq!(found(&slipped), [row]);
        }
        // Without a stated noise it is what the others differ by.
        let mut slipped = problem(4000, |at, i| i[at] + if at == 33 { 20.0 } else { 0.0 });
        slipped.noise = 0.0;
        assert_eq!(found(&slipped), [33]);
    }

    #[test]
    fn what_is_physics_of_the_sensor_is_no_slip() {
        // Nothing; late by a row; the mean of two; a reading that is held; now and then something for two rows; a step in 1 of 50.
        let cases: [&Reads; 6] = [
            &|at, i| i[at],
            &|at, i| i[at.saturating_sub(1)],
            &|at, i| 0.5 * (i[at] + i[at.saturating_sub(1)]),
            &|at, i| i[at - at % 5],
            &|at, i| i[at] + if at % 500 < 2 { 30.0 } else { 0.0 },
            &|at, i| i[at] + if at % 50 == 7 { 30.0 } else { 0.0 },
        ];
        for (case, of_row) in cases.into_iter().enumerate() {
            assert_eq!(found(&problem(4000, of_row)), Vec::<usize>::new(), "{case}");
        }
    }

    #[test]
    fn they_count_no_more_and_are_told() {
        let mut slipped = problem(4000, |at, i| {
            i[at] + if at % 1000 == 512 { 50.0 } else { 0.0 }
        });
        let remark = leave_out(&mut slipped).unwrap();
        assert!(
            remark.starts_with("i_meas_a: 4 readings are off"),
            "{remark}"
        );
        assert!(remark.contains("slips of the log, left out"), "{remark}");
        let left = slipped.observed.valid.iter().filter(|valid| !**valid);
        assert_eq!(left.count(), 4);
        assert_eq!(leave_out(&mut slipped), None);
    }
}
