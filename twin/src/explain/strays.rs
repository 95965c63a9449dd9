//! Readings that no noise makes: slips of the log, the mismatch itself, or what acts only at some instants.

use super::fit::{self, Fit};
use super::jumps;
use super::robust::{common, loss};
use super::select::{self, Selection, joins};
use super::told::short;
use super::workbench::{Member, Workbench};
use crate::effects::Effect;
use crate::report::data::Verdict;
use crate::report::format::precise_percent;

/// Times the stated noise that noise never is.
pub const STRAY: f64 = 8.0;
/// Up to this share of the readings they are rare.
pub const RARE: f64 = 0.01;
/// What would be so by chance less often than this is not chance, …
const BY_CHANCE: f64 = 0.05;
/// … and than this, it is worth a name.
const NAMED: f64 = 0.01;
/// Steps to either side of an instant within which a reading is next to it.
const NEXT_TO: f64 = 1.5;
/// Fewer readings beyond it are not told from a slip of the log.
const STRAYS: usize = 2;
/// Those readings are the mismatch if they make this share of its energy.
const STRAYED: f64 = 0.5;
/// So many in a row, all to one side, are the mismatch however little they make of it: something was there for a while.
pub(super) const IN_A_ROW: usize = 3;
/// Where no noise is stated, a heavy tail is a noise of its own: there they have to be nearly all of it.
const NEARLY_ALL: f64 = 0.9;

/// Readings that no stated noise makes.
pub(super) struct Strays {
    pub(super) rows: Vec<usize>,
    /// The largest of them, in the view's unit, and its time in s.
    pub(super) largest: f64,
    pub(super) at_s: f64,
    /// So many follow one another, all to one side.
    in_a_row: usize,
    /// Whether they are the mismatch: most of it, or so many in a row that it is no slip of the log.
    pub(super) decide: bool,
}

impl Strays {
    /// How many there are, in words, and the verb that goes with it.
    pub(super) fn counted(&self) -> (String, &'static str) {
        match self.rows.len() {
            1 => ("one reading".to_owned(), "is"),
            count => (format!("{count} readings"), "are"),
        }
    }

    /// Whether they are few enough to be slips of a log.
    fn are_rare(&self, bench: &Workbench<'_>) -> bool {
        self.rows.len() as f64 <= RARE * bench.len() as f64
    }

    /// Probability that all of them are next to instants at which an effect acts, if they were anywhere; 1 if they are not, or it
    /// acts all along.
    fn chance_at(&self, bench: &Workbench<'_>, effect: &dyn Effect) -> f64 {
        let Some(instants_s) = effect.instants_s(bench.problem) else {
            return 1.0;
        };
        let next_to_s = NEXT_TO * bench.scale.step_s;
        let is_next = |row: &usize| {
            let from_s = bench.t_s[*row] - next_to_s;
            let at = instants_s.partition_point(|instant_s| *instant_s < from_s);
            instants_s
                .get(at)
                .is_some_and(|instant_s| *instant_s < from_s + 2.0 * next_to_s)
        };
        if !self.rows.iter().all(is_next) {
            return 1.0;
        }
        let share = instants_s.len() as f64 * 2.0 * next_to_s / bench.scale.span_s;
        share.powi(self.rows.len() as i32)
    }
}

/// Readings far beyond the stated noise, and what reference and time stamps are accurate to, if there are some.
pub(super) fn strays(bench: &Workbench<'_>, residual: &[f64]) -> Option<Strays> {
    let stated = bench.problem.noise > 0.0;
    let (noise, least, share) = if stated {
        (bench.problem.noise, STRAYS, STRAYED)
    } else {
        // Of the changes from reading to reading the common ones: the strays are not to hide behind themselves.
        let noise = common(&jumps(residual)) / std::f64::consts::SQRT_2;
        (noise.max(bench.scale.quantum), 1, NEARLY_ALL)
    };
    if noise <= 0.0 {
        return None;
    }
    let rows: Vec<usize> = (0..bench.len())
        .filter(|&row| residual[row].abs() > STRAY * noise + bench.inaccuracy(row))
        .collect();
    let largest = *rows
        .iter()
        .max_by(|a, b| residual[**a].abs().total_cmp(&residual[**b].abs()))?;
    let energy: f64 = rows.iter().map(|&row| residual[row].powi(2)).sum();
    let all: f64 = residual.iter().map(|r| r * r).sum();
    let in_a_row = rows
        .chunk_by(|a, b| b - a == 1 && residual[*a] * residual[*b] > 0.0)
        .map(<[usize]>::len)
        .fold(0, usize::max);
    Some(Strays {
        largest: residual[largest].abs(),
        at_s: bench.t_s[largest],
        in_a_row,
        decide: (rows.len() >= least && energy > share * all) || (stated && in_a_row >= IN_A_ROW),
        rows,
    })
}

/// Single readings that are off by what no noise makes and no named effect can: more than all of them change there. They are rare, and no
/// few in a row, so that they are slips of the log, or come of what has nothing to do with the names.
pub(super) fn slipped(bench: &Workbench<'_>, plain: &Fit, fit: &Fit) -> Vec<usize> {
    if !noise_is_stated(bench, fit) {
        return Vec::new();
    }
    let Some(strays) = strays(bench, &fit.residual) else {
        return Vec::new();
    };
    if strays.in_a_row >= IN_A_ROW || !strays.are_rare(bench) {
        return Vec::new();
    }
    let by_effects = |row: usize| (fit.predicted[row] - plain.predicted[row]).abs();
    let mut rows = strays.rows;
    rows.retain(|&row| fit.residual[row].abs() > by_effects(row));
    rows
}

/// Whether the noise of readings is what the model file states: behind what cuts or rounds it is not.
pub(super) fn noise_is_stated(bench: &Workbench<'_>, fit: &Fit) -> bool {
    let cuts = |member: &Member| member.effect.cuts();
    bench.problem.noise > 0.0 && !fit.model.members.iter().any(cuts)
}

/// An effect that acts only at some instants, and readings next to them that it alone accounts for.
struct Placed {
    effect: &'static dyn Effect,
    strays: Strays,
    /// Probability of such places by chance.
    chance: f64,
    /// The fit with it.
    fit: Fit,
}

/// The effect for which all readings that no noise makes are where it acts, hardly by chance, and of which one value takes them all.
fn placed(bench: &Workbench<'_>, fit: &Fit) -> Option<Placed> {
    if !noise_is_stated(bench, fit) {
        return None;
    }
    let strays = strays(bench, &bench.as_read(&fit.residual))?;
    if !strays.are_rare(bench) {
        return None;
    }
    let (effect, chance, fit) = bench.library.iter().copied().find_map(|effect| {
        let chance = strays.chance_at(bench, effect);
        if chance >= NAMED || !joins(&fit.model, effect) {
            return None;
        }
        Some((effect, chance, taken(bench, fit, effect, &strays.rows)?))
    })?;
    Some(Placed {
        effect,
        strays,
        chance,
        fit,
    })
}

/// Adds the effect that the place of readings tells, if there is one: too few of them to show in held-out blocks. What is to be said
/// against it.
pub(super) fn name_by_place(bench: &Workbench<'_>, selection: &mut Selection) -> Option<String> {
    let placed = placed(bench, &selection.fit)?;
    let card = placed.effect.card();
    let (count, are) = placed.strays.counted();
    let place = format!(
        "{count} {are} off by more than {STRAY} times the stated noise, next to where alone it acts (by chance {}), and it takes all of that",
        precise_percent(placed.chance)
    );
    selection
        .decisions
        .push(format!("{} added for its place: {place}.", card.id));
    selection.add_by_place(bench, placed.fit, place);
    Some(format!(
        "{} is told by {count} alone, and a slip of the log there would look the same ({} would tell)",
        card.id, card.separated_by
    ))
}

/// A fit with an effect that leaves nothing of some readings but noise, if there is one.
fn taken(
    bench: &Workbench<'_>,
    fit: &Fit,
    effect: &'static dyn Effect,
    rows: &[usize],
) -> Option<Fit> {
    let energy = |fit: &Fit| {
        let residual = bench.as_read(&fit.residual);
        rows.iter().map(|&row| residual[row].powi(2)).sum::<f64>()
    };
    let as_read = bench.as_read(&fit.predicted);
    let starts = effect.starts(&bench.scale, &bench.clues(&as_read));
    let start = starts
        .into_iter()
        .map(|values| Fit::of(bench, fit.model.with(Member { effect, values }), fit.cost))
        .min_by(|a, b| energy(a).total_cmp(&energy(b)))?;
    let taken = fit::fit(bench, &start.model, None);
    let residual = bench.as_read(&taken.residual);
    let noise = bench.problem.noise;
    let is_noise =
        |row: &usize| residual[*row].abs() <= select::CERTAIN * noise + bench.inaccuracy(*row);
    let sigma = taken.sigma.min(fit.sigma);
    let better = loss(&taken.residual, sigma) < loss(&fit.residual, sigma);
    let is_physics = taken
        .model
        .members
        .last()
        .is_some_and(|member| select::at_end(bench, member).is_none());
    (better && is_physics && rows.iter().all(is_noise)).then_some(taken)
}

/// What is to be said of readings that no noise makes and that nothing accounts for, where they decide nothing.
pub(super) fn slips(read: &Workbench<'_>, shown: &Fit, verdict: Verdict) -> Option<String> {
    if !noise_is_stated(read, shown) {
        return None;
    }
    let strays = strays(read, &shown.residual)?;
    let of_place = |effect: &&dyn Effect| strays.chance_at(read, *effect) < BY_CHANCE;
    let why = match read.library.iter().copied().find(of_place) {
        Some(effect) => format!(
            "only where {} acts ({}), but none of its values takes them all",
            effect.card().id,
            effect.card().shows
        ),
        None => why_astray(strays.rows.len() as f64 / read.len() as f64, verdict)?.to_owned(),
    };
    let (count, are) = strays.counted();
    let of_what = if shown.model.members.is_empty() {
        ""
    } else {
        " after all that is named"
    };
    Some(format!(
        "{}: {count} {are} off by more than {STRAY} times the stated noise{of_what}, the worst by {} {} at {} s: {why}",
        read.problem.name,
        short(strays.largest),
        read.problem.unit,
        short(strays.at_s),
    ))
}

/// What such a share of the readings can be. Nothing, where the verdict says that much is left: they are it.
fn why_astray(share: f64, verdict: Verdict) -> Option<&'static str> {
    if share <= RARE {
        Some("a slip of the log, or something too rare here to name")
    } else if verdict == Verdict::PartlyExplained {
        None
    } else {
        Some(
            "too many to be slips of the log; their noise is not the stated one, or what makes it is not in the library",
        )
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::explain::predict;
    use crate::explain::workbench::Model;
    use crate::problem::{Base, Problem, SensorBase};

    const STEP_S: f64 = 0.1;
    const LIMIT_A: f64 = 60.0;
    const NOISE_A: f64 = 0.5;
    const ROWS: u16 = 3000;
    /// The first row in the large range, and the first one that is not any more.
    const CHANGE: usize = 1009;
    const BACK: usize = 2009;

    /// A current that passes into the large range once and comes back, each half way between two rows, in noise.
    fn once_over_the_limit() -> Problem {
        let t_s: Vec<f64> = (0..ROWS).map(|row| STEP_S * f64::from(row)).collect();
        let at_s = |row: usize| (row as f64 - 0.5) * STEP_S;
        let rise = |t: f64| (0.2 * t).tanh();
        let pulse = |t: f64| rise(t - at_s(CHANGE)) - rise(t - at_s(BACK)) - 1.0;
        let reference: Vec<f64> = t_s.iter().map(|t| LIMIT_A + 30.0 * pulse(*t)).collect();
        let noise = |t: f64| 1.4 * NOISE_A * (7919.0 * t * t).sin();
        let reading = t_s.iter().zip(&reference).map(|(t, i)| i + noise(*t));
        let reading = reading.collect();
        let mut problem = Problem::pair(t_s, reference, reading, NOISE_A);
        let high = |i: &f64| f64::from(u8::from(*i > LIMIT_A));
        problem.drive.range_high = Some(problem.drive.reference.iter().map(high).collect());
        problem.base = Base::Sensor(SensorBase {
            range_ratio: 10.0,
            range_limit: Some(LIMIT_A),
            ..SensorBase::default()
        });
        problem
    }

    /// What the place of stray readings tells: the effect and its value.
    fn told(problem: &Problem) -> Option<(&'static str, f64)> {
        let bench = Workbench::new(problem, &[]);
        let plain = Fit::of(&bench, Model::default(), 0.0);
        let placed = placed(&bench, &plain)?;
        let member = placed.fit.model.members.last()?;
        Some((member.id(), member.values[0]))
    }

    #[test]
    fn a_hand_over_in_one_reading_is_told_by_its_place() {
        for tau_s in [0.012, 0.015, 0.02, 0.03] {
            let mut problem = once_over_the_limit();
            let there = predict(&problem, &[("range-handover".into(), vec![tau_s])]);
            let plain = problem.drive.reference.clone();
            let changes = there.iter().zip(&plain).map(|(there, plain)| there - plain);
            let readings = problem.observed.value.iter_mut().zip(changes);
            readings.for_each(|(reading, change)| *reading += change);
            let (id, found_s) = told(&problem).unwrap();
            assert_eq!(id, "range-handover");
            assert!((found_s / tau_s - 1.0).abs() < 0.1, "{found_s} for {tau_s}");
        }
        assert_eq!(told(&once_over_the_limit()), None);
    }

    #[test]
    fn a_slip_is_told_by_its_place_where_no_other_could_be() {
        let by_a = 60.0 * NOISE_A;
        let rows = (0..usize::from(ROWS))
            .step_by(41)
            .chain(CHANGE - 5..CHANGE + 5);
        for row in rows {
            for by_a in [by_a, -by_a] {
                let mut problem = once_over_the_limit();
                problem.observed.value[row] += by_a;
                // What the multiplier holds is read too large after a change to the large range.
                let could_be = row == CHANGE && by_a > 0.0;
                assert_eq!(told(&problem).is_some(), could_be, "{by_a} A in row {row}");
            }
        }
    }

    #[test]
    fn what_is_not_rare_is_not_called_rare() {
        let rare = |share, verdict| why_astray(share, verdict).map(|why| why.contains("too rare"));
        assert_eq!(rare(2.0 / 3600.0, Verdict::Explained), Some(true));
        assert_eq!(rare(2.0 / 3600.0, Verdict::PartlyExplained), Some(true));
        assert_eq!(rare(2448.0 / 3600.0, Verdict::Explained), Some(false));
        assert_eq!(rare(2448.0 / 3600.0, Verdict::PartlyExplained), None);
    }
}
