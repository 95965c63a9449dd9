//! Readings at the ends of a stretch that depend on what the reference did outside it: a log begins in the middle of a drive, and
//! what comes late has its cause before the log. No model foretells them, so they are not looked at.

use super::fit::Fit;
use super::select::CERTAIN;
use super::told::short;
use super::workbench::{Model, Workbench};
use crate::problem::{Problem, View};

/// No more than this share of the readings is left out: with more, too little of the recording would be judged.
const MOST: f64 = 0.1;

/// How far from its row, before and after, in s, a reading depends on the reference.
fn reach_s(bench: &Workbench<'_>, model: &Model) -> [f64; 2] {
    model
        .members
        .iter()
        .map(|member| member.effect.reach_s(&member.values, &bench.scale))
        .fold([0.0; 2], |all, one| [all[0] + one[0], all[1] + one[1]])
}

/// Rows whose reading reaches out of the stretch of the drive that it belongs to.
fn reaching_out(problem: &Problem, [before_s, after_s]: [f64; 2]) -> Vec<usize> {
    let (drive, observed) = (&problem.drive, &problem.observed);
    let mut reaching = Vec::new();
    for (segment, rows) in observed.stretches.iter() {
        let segment = &drive.segments[segment];
        let Some(last) = segment.end.checked_sub(1) else {
            continue;
        };
        let inside = drive.t_s[segment.start] + before_s..=drive.t_s[last] - after_s;
        // What a counter says is a mean since its reading before.
        let begin = |row: usize| {
            let means = problem.view == View::Charge && row > rows.start;
            observed.t_s[row - usize::from(means)]
        };
        let is_inside =
            |row: usize| inside.contains(&begin(row)) && inside.contains(&observed.t_s[row]);
        reaching.extend(rows.clone().filter(|&row| !is_inside(row)));
    }
    reaching
}

/// How far a model reaches out of the stretches, if readings there are off by more than chance and reference allow.
pub(super) fn missed(bench: &Workbench<'_>, shown: &Fit) -> Option<[f64; 2]> {
    let reach = reach_s(bench, &shown.model);
    if reach == [0.0; 2] {
        return None;
    }
    let problem = bench.problem;
    let noise = shown.sigma.max(problem.noise);
    // Of those that count: not what is repeated or empty.
    let reaching: Vec<usize> = reaching_out(problem, reach)
        .iter()
        .filter_map(|row| bench.rows.binary_search(row).ok())
        .collect();
    let off = reaching
        .iter()
        .any(|&at| shown.residual[at].abs() > CERTAIN * noise + bench.inaccuracy(at));
    (off && reaching.len() as f64 <= MOST * bench.len() as f64).then_some(reach)
}

/// A problem whose readings that reach so far out of their stretch do not count.
pub(super) fn without(problem: &Problem, reach_s: [f64; 2]) -> Problem {
    problem.without_readings(reaching_out(problem, reach_s))
}

/// What is said of it; whether anything is named in the end.
pub(super) fn told(name: &str, [before_s, after_s]: [f64; 2], is_named: bool) -> String {
    let by = if is_named {
        "what is named"
    } else {
        "an effect that fitted best, and is not named"
    };
    let side =
        |time_s: f64, what: &str| (time_s > 0.0).then(|| format!("the {what} {} s", short(time_s)));
    let sides: Vec<String> = [side(before_s, "first"), side(after_s, "last")]
        .into_iter()
        .flatten()
        .collect();
    format!(
        "{name}: {} of the recording, and of each stretch after a gap, are not looked at: readings there depend on what the reference \
         did outside, by {by}",
        sides.join(" and ")
    )
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::explain::workbench::Member;

    /// A sensor that is late by 5 s in a log of 400 s, measured in one row of ten and repeated in the others.
    #[test]
    fn repeats_are_no_readings_that_would_be_left_out() {
        let late_s = 5.0;
        let current = |t: f64| 10.0 * (0.37 * t).sin() + 3.0 * (1.91 * t).sin();
        let t_s: Vec<f64> = (0..4000).map(|row| f64::from(row) * 0.1).collect();
        let reference: Vec<f64> = t_s.iter().map(|t| current(*t)).collect();
        // Before the log another current flowed.
        let reading = t_s.iter().map(|t| {
            let earlier = if *t < late_s { 100.0 } else { 0.0 };
            current(t - late_s) + earlier
        });
        let mut problem = Problem::pair(t_s.clone(), reference, reading.collect(), 0.1);
        problem.observed.valid = (0..4000).map(|row| row % 10 == 0).collect();
        let bench = Workbench::new(&problem, &[]);
        let effect = crate::effects::find_with("delay", 1).unwrap();
        let values = vec![late_s];
        let model = Model::default().with(Member { effect, values });
        let shown = Fit::of(&bench, model, 0.0);
        // Five readings, in fifty rows, of four hundred.
        let reach = missed(&bench, &shown).unwrap();
        assert_eq!(reach, [late_s, 0.0]);
    }

    #[test]
    fn what_is_not_named_is_not_said_to_be() {
        let said = told("i_meas_a", [0.0, 0.5], true);
        assert!(said.starts_with("i_meas_a: the last 0.500 s of"), "{said}");
        assert!(said.ends_with("by what is named"), "{said}");
        let said = told("i_meas_a", [0.5, 0.0], false);
        assert!(said.starts_with("i_meas_a: the first 0.500 s of"), "{said}");
        assert!(said.ends_with("and is not named"), "{said}");
    }
}
