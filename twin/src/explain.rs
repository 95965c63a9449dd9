//! From problems to named effects: fit, select, say where, how sure and what is left.
//!
//! One way: `course` asks how the reference goes from row to row, [`workbench`] makes a problem ready (`apart`: whether a tester read
//! voltages at another moment than currents; `beyond`: what is taken of resistances where a file is colder or warmer; `censored`: what readings tell behind a threshold, steps or rails of the model file), [`screen`] asks which effects could account for what is left, [`fit`] fits
//! them, with [`slope`]s, [`normal`] equations and a [`robust`] loss, and with what the model file leaves open (`starts`);
//! [`held_out`] says what a fit is worth on rows that it was not made of, and [`select`] decides. [`intervals`] and [`locate`] say how
//! sure and where; `trust`, [`shape`] and `unfitted` take back names that the recording or other files do not bear out, `strays`
//! looks at readings that no noise makes, `dropout` at stretches that no physics makes, `verdict` says what that makes (`quieter`: whether what works between the rows only evens
//! out noise of the reference), `elsewhere` whether another start would do the same, `form` which simple form what is left has, `scattered` whether it is that of moments that scatter, and `told` puts the report together.
//! Nothing here knows a file or an effect by name.

mod apart;
mod beyond;
mod censored;
mod course;
mod dropout;
mod elsewhere;
pub mod fit;
pub mod flexible;
mod form;
pub mod held_out;
pub mod intervals;
mod lead_in;
pub mod locate;
pub mod normal;
mod quieter;
pub mod robust;
mod scattered;
pub mod screen;
pub mod select;
pub mod shape;
pub mod slope;
mod starts;
mod steady;
mod strays;
mod told;
mod trust;
mod unfitted;
mod verdict;
pub mod whiten;
pub mod workbench;

use std::path::PathBuf;
use std::time::Instant;

use crate::effects::chain::{Chain, Nuisance};
use crate::effects::{Effect, find_with};
use crate::problem::Problem;
use crate::report::data::{Report, SignalReport, Unexplained, Verdict};
use beyond::found_at_c;
pub use beyond::{beyond_known, by_temperature};
use course::{Answer, Course};
use fit::Fit;
use flexible::{Explainable, Features};
use select::{Named, Selection};
pub use strays::{RARE, STRAY};
use strays::{name_by_place, slips};
use told::{
    attribute, base_found, behind_ends, current_off, effects, fitted, not_told, overstated, plots,
    sentence, short, times_found,
};
use trust::{vague, vague_beside, wavering};
use unfitted::{Unfitted, confirmed, not_there, veto};
use verdict::{Doubt, doubt, judge, unavoidable};
use workbench::Workbench;

/// Folds for the figures of held-out blocks, each with a fit of its own.
const FOLDS: usize = 5;
/// Times that the ends of a recording are left out, and all is decided again: what is named then may reach further.
const LEAD_INS: usize = 2;

/// How to explain.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// Effects taken out of the library, by id.
    pub without: Vec<String>,
    /// Seed of whatever is random.
    pub seed: u64,
}

/// A file that is never fitted, with the problems that it makes under the same model file.
#[derive(Clone, Debug)]
pub struct Holdout {
    /// The file.
    pub file: PathBuf,
    /// Its problems; matched to the fitted ones by name.
    pub problems: Vec<Problem>,
}

/// What one signal's explanation adds to the report.
struct Part {
    verdict: Verdict,
    sentence: String,
    selection: Selection,
}

/// Everything about the mismatch. `progress` is told a share, 0 … 1, and what is being done.
pub fn explain(
    problems: &[Problem],
    holdouts: &[Holdout],
    options: &Options,
    progress: &mut dyn FnMut(f64, &str),
) -> Report {
    let started = Instant::now();
    let mut report = Report {
        schema: 1,
        seed: options.seed,
        version: env!("CARGO_PKG_VERSION").to_owned(),
        ..Report::default()
    };
    let mut parts = Vec::new();
    for (index, problem) in problems.iter().enumerate() {
        let share = 1.0 / problems.len() as f64;
        let mut told = |part: f64, what: &str| {
            progress(
                (index as f64 + part) * share,
                &format!("{}: {what}", problem.name),
            );
        };
        let part = one(problem, holdouts, options, &mut report, &mut told);
        parts.push(part);
    }
    report.verdict = overall(&parts);
    report.summary = parts
        .iter()
        .map(|part| part.sentence.as_str())
        .collect::<Vec<_>>()
        .join(" ");
    for (part, problem) in parts.iter().zip(problems) {
        let prefix = |text: &String| format!("{}: {text}", problem.name);
        report
            .decisions
            .extend(part.selection.decisions.iter().map(prefix));
        report.decisions.extend(
            part.selection
                .refused
                .iter()
                .map(|text| format!("{}: not named: {text}.", problem.name)),
        );
    }
    report.seconds = started.elapsed().as_secs_f64();
    progress(1.0, "done");
    report
}

/// Of several signals' verdicts.
fn overall(parts: &[Part]) -> Verdict {
    let any = |verdict: Verdict| parts.iter().any(|part| part.verdict == verdict);
    let explained =
        any(Verdict::Explained) || any(Verdict::PartlyExplained) || any(Verdict::Ambiguous);
    if any(Verdict::Ambiguous) {
        Verdict::Ambiguous
    } else if any(Verdict::PartlyExplained) || (any(Verdict::Unknown) && explained) {
        Verdict::PartlyExplained
    } else if any(Verdict::Unknown) {
        Verdict::Unknown
    } else if any(Verdict::Explained) {
        Verdict::Explained
    } else {
        Verdict::NoMismatch
    }
}

fn rms(values: impl Iterator<Item = f64>) -> f64 {
    let (mut sum, mut count) = (0.0, 0usize);
    for value in values.filter(|value| value.is_finite()) {
        sum += value * value;
        count += 1;
    }
    if count > 0 {
        (sum / count as f64).sqrt()
    } else {
        0.0
    }
}

/// By how much the loss is smaller with the second of two fits, both in the smaller spread.
fn gained(one: &Fit, other: &Fit) -> f64 {
    let sigma = one.sigma.min(other.sigma);
    robust::loss(&one.residual, sigma) - robust::loss(&other.residual, sigma)
}

/// What was decided about a signal, on which part of it.
struct Settled<'a> {
    course: Course<'a>,
    answer: Answer,
    /// How far, in s, the ends are left out, if they are.
    ends_s: Option<[f64; 2]>,
}

impl<'a> Settled<'a> {
    /// Where the ends turn out to depend on what the reference did outside the recording, it is decided again without them.
    fn of(mut course: Course<'a>, options: &Options, progress: &mut dyn FnMut(f64, &str)) -> Self {
        let mut ends_s = None;
        let mut answer = course.answered(options, progress);
        for _ in 0..LEAD_INS {
            let Some(reach_s) = answer.reach_s(&course, options) else {
                break;
            };
            course = course.without_ends(reach_s);
            answer = course.answered(options, progress);
            ends_s = Some(reach_s);
        }
        Self {
            course,
            answer,
            ends_s,
        }
    }
}

/// One signal. Where stretches of the log are in the way of an answer, it is decided again without them.
fn one(
    problem: &Problem,
    holdouts: &[Holdout],
    options: &Options,
    report: &mut Report,
    progress: &mut dyn FnMut(f64, &str),
) -> Part {
    let mut settled = Settled::of(Course::new(problem, holdouts), options, progress);
    let mut dropouts = settled.answer.dropouts(&settled.course, options);
    if !dropouts.is_empty() {
        let course = Course::new(problem, holdouts).without_dropouts(&dropouts);
        let again = Settled::of(course, options, progress);
        if again.answer.decided.says_more_than(&settled.answer.decided) {
            settled = again;
        } else {
            dropouts.clear();
        }
    }
    let Settled {
        course,
        answer,
        ends_s,
    } = settled;
    let Answer {
        other,
        decided,
        shown,
        between,
    } = answer;
    let model = decided.selection.fit.model.clone();
    let places = report.locations.len();
    let mut part = tell(
        other.as_ref().unwrap_or(&course),
        (decided, &shown),
        between,
        options,
        report,
    );
    if !dropouts.is_empty() {
        let whole = Workbench::new(problem, &options.without);
        let of_rest = (part.verdict != Verdict::NoMismatch).then_some(part.sentence.as_str());
        let told = dropout::told(&whole, &model, &dropouts, of_rest);
        report.locations.splice(places..places, told.locations);
        report.unexplained.push(told.unexplained);
        part.verdict = dropout::verdict(part.verdict);
        part.sentence = told.sentence;
        part.selection.decisions.push(format!(
            "Decided again without {} readings that no effect makes, of {} in all: more is accounted for.",
            dropout::count(&dropouts),
            whole.len(),
        ));
    }
    // What made them so may have been taken back since.
    let is_named = report
        .effects
        .iter()
        .any(|effect| effect.signal == problem.name);
    let said = ends_s.map(|reach_s| lead_in::told(&problem.name, reach_s, is_named));
    report.remarks.extend(said);
    part
}

/// Puts what was decided about a signal into the report; `between`: as `course` in [`times_found`].
fn tell(
    course: &Course<'_>,
    (decided, shown): (Decided, &Fit),
    between: Option<[f64; 2]>,
    options: &Options,
    report: &mut Report,
) -> Part {
    let problem = &*course.problem;
    let read = Workbench::new(problem, &options.without);
    let white = read.whitened();
    let bench = decided.bench(&read, white.as_ref());
    let others = Unfitted::all(&course.holdouts, &problem.name);
    let leaves_something = decided.leaves_something();
    let Decided {
        mut selection,
        verdict,
        left,
        held,
        doubted,
        beside,
        elsewhere,
        but,
        vetoed,
        ..
    } = decided;
    let model = &selection.fit.model;

    if bench.is_white() {
        selection.decisions.push(format!(
            "The stated noise has a memory of {} s: decided on what each reading says beyond those before it. Gains are shares of that.",
            short(problem.coloured.tau_s)
        ));
    }
    let plain_residual = read.residual(&read.plain);
    let stated = (problem.noise > 0.0).then(|| read.noise_left(model, options.seed));
    let noise = stated
        .unwrap_or_else(|| robust::spread(&jumps(&shown.residual)) / std::f64::consts::SQRT_2);
    report.signals.push(SignalReport {
        name: problem.name.clone(),
        unit: problem.unit.clone(),
        noise_floor: noise,
        rmse_before: rms(plain_residual.iter().copied()),
        rmse_after: rms(shown.residual.iter().copied()),
        held_out_blocks_before: held.before,
        held_out_blocks_after: held.after,
        samples: bench.len(),
    });
    let mut locations = if verdict == Verdict::NoMismatch {
        Vec::new()
    } else {
        locate::locate(&read, &plain_residual, options.seed)
    };
    attribute(&read, shown, &mut locations);
    report.locations.extend(locations);
    let reported = intervals::reported(bench, &selection.fit, beside);
    report.effects.extend(effects(bench, &selection, &reported));
    report
        .holdouts
        .extend(others.iter().map(|other| other.report(model)));
    let mut form = None;
    if leaves_something {
        form = form::form(&read, &shown.residual, stated.unwrap_or(0.0));
        if form.is_none() {
            let scattered = scattered::scattered(&read, &shown.residual);
            report.remarks.extend(scattered);
        }
        let place = locate::locate(&read, &shown.residual, options.seed)
            .into_iter()
            .next();
        report.unexplained.push(Unexplained {
            signal: problem.name.clone(),
            rmse: rms(shown.residual.iter().copied()),
            explainable_share: if left.is_real() { left.share } else { 0.0 },
            location: place,
            form: form.clone(),
        });
    }
    report.models.push(fitted(problem, &selection.fit));
    report
        .remarks
        .extend(base_found(problem, &selection.fit.model.nuisance));
    report
        .remarks
        .extend(times_found(&read, &selection.fit, between));
    report
        .remarks
        .extend(not_told(bench, &selection, &reported));
    report.remarks.extend(behind_ends(&read));
    report.remarks.extend(overstated(bench, &selection.plain));
    let dropouts = others.iter().filter_map(|other| other.dropouts(model));
    report.remarks.extend(dropouts);
    report
        .remarks
        .extend(others.iter().filter_map(|other| other.beyond(model)));
    report
        .remarks
        .extend(others.iter().flat_map(|other| other.idle(model)));
    let off = current_off(bench, &selection).into_iter();
    report
        .remarks
        .extend(off.map(|(off, _)| format!("{}: {off}", problem.name)));
    if verdict != Verdict::Unknown {
        report.remarks.extend(slips(&read, shown, verdict));
    }
    report.plots.push(plots(&read, shown, &held.read));
    let mut sentence = sentence(
        bench,
        &selection,
        (verdict, doubted, [elsewhere.as_deref(), but.as_deref()]),
        left,
        (&vetoed, report),
    );
    if let Some(form) = form {
        sentence.push_str(&format!(
            " What is left has a simple form, though it is no effect of the library: {}.",
            form.said()
        ));
    }
    if verdict != Verdict::Unknown {
        let left = others
            .iter()
            .filter_map(|other| other.left(&selection.fit.model));
        left.for_each(|left| sentence.extend([" ", &left]));
    }
    Part {
        verdict,
        sentence,
        selection,
    }
}

/// What was decided about one signal.
struct Decided {
    selection: Selection,
    verdict: Verdict,
    left: Explainable,
    held: Held,
    /// See [`verdict::Doubt`].
    doubted: bool,
    beside: f64,
    /// Whether it was decided on what each reading says beyond those before it.
    on_white: bool,
    /// See [`elsewhere::elsewhere`].
    elsewhere: Option<String>,
    /// What is held against a name: [`name_by_place`], [`current_off`].
    but: Option<String>,
    /// What was taken back for a file that was never fitted.
    vetoed: Vec<&'static str>,
}

impl Decided {
    fn names_nothing(&self) -> bool {
        self.selection.named.is_empty()
    }

    /// Ids of what is named, sorted.
    fn names(&self) -> Vec<&'static str> {
        let members = &self.selection.fit.model.members;
        let named = self.selection.named.iter();
        let mut ids: Vec<_> = named.map(|named| members[named.index].id()).collect();
        ids.sort_unstable();
        ids
    }

    /// Whether something is left that it does not account for, or not for sure.
    fn leaves_something(&self) -> bool {
        self.doubted || matches!(self.verdict, Verdict::Unknown | Verdict::PartlyExplained)
    }

    /// Whether it accounts for more of what it was asked of than another answer does.
    fn says_more_than(&self, other: &Self) -> bool {
        let rank = |decided: &Self| {
            u8::from(decided.verdict != Verdict::Unknown) + u8::from(!decided.leaves_something())
        };
        // That nothing is missing is no answer where something was named.
        let takes_back = self.names_nothing() && !other.names_nothing();
        rank(self) > rank(other) && !takes_back
    }

    /// The bench that it was decided on.
    fn bench<'b, 'p>(
        &self,
        read: &'b Workbench<'p>,
        white: Option<&'b Workbench<'p>>,
    ) -> &'b Workbench<'p> {
        white.filter(|_| self.on_white).unwrap_or(read)
    }

    /// Whether it turns on what the reference does between its rows.
    fn asks_between(&self) -> bool {
        let members = &self.selection.fit.model.members;
        members
            .iter()
            .any(|member| member.effect.card().stage.is_between_rows())
            || self.verdict == Verdict::Unknown
    }

    /// Whether an effect is named that noise does not come through as it is.
    fn names_a_cut(&self) -> bool {
        let members = &self.selection.fit.model.members;
        self.selection
            .named
            .iter()
            .any(|named| members[named.index].effect.cuts())
    }
}

/// Selects, and asks what the names are worth.
fn decide(
    (bench, read): (&Workbench<'_>, &Workbench<'_>),
    others: &[Unfitted<'_>],
    seed: u64,
    progress: &mut dyn FnMut(f64, &str),
) -> Decided {
    let mut selection = select::select(bench, seed, progress);
    selection.fit.model.nuisance.resistances_at_c = found_at_c(bench, &selection.fit);
    progress(0.95, "looking at what is left");
    let features = Features::new(bench);
    let before = features.explain(&selection.plain.residual, seed);
    let passed = !selection.named.is_empty();
    let vetoed = veto(bench, &mut selection, others);
    selection.fit = fit::in_the_mean(bench, selection.fit);
    vague(bench, &mut selection);
    if wavering(bench, &mut selection, others) {
        vague(bench, &mut selection);
    }
    shape::withdraw((bench, read), &mut selection, seed);
    let mut taken_back = passed && selection.named.is_empty();
    let mut placed = name_by_place(bench, &mut selection);
    let (found, left, held, confirmed) = loop {
        let left = features.explain(&selection.fit.residual, seed);
        let confirmed = confirmed(&selection, others);
        let unavoidable = unavoidable(bench, &selection.fit, seed);
        let verdict = judge(
            bench,
            &mut selection,
            &features,
            confirmed,
            before,
            left,
            unavoidable,
        );
        // With the names taken back, all that they took is left again.
        let left = if selection.named.is_empty() {
            before
        } else {
            left
        };
        let held = folds(bench, &selection.fit);
        let not_there = not_there(bench, &selection, others);
        let found = doubt(
            bench,
            &mut selection,
            verdict,
            (left, &held),
            (confirmed, taken_back),
            (not_there, placed.as_deref()),
            unavoidable,
        );
        // With what may be another physics, values that were told may be told no more.
        if !(found.names && vague_beside(bench, &mut selection, found.beside)) {
            break (found, left, held, confirmed);
        }
        taken_back |= selection.named.is_empty();
        let by_place = |named: &Named| named.by_place.is_some();
        placed = placed.filter(|_| selection.named.iter().any(by_place));
    };
    let Doubt {
        verdict,
        names: doubted,
        beside,
    } = found;
    // A file that was never fitted, with a start of its own, tells a start from physics.
    let asked = verdict != Verdict::NoMismatch && (!confirmed || selection.named.is_empty());
    let elsewhere = asked
        .then(|| elsewhere::elsewhere(bench, &selection))
        .flatten();
    let unlikely = current_off(bench, &selection)
        .into_iter()
        .find_map(|(off, likelier)| likelier.then_some(off));
    let named_elsewhere = elsewhere.is_some() && !selection.named.is_empty();
    let verdict = if named_elsewhere || unlikely.is_some() {
        Verdict::Ambiguous
    } else {
        verdict
    };
    Decided {
        selection,
        verdict,
        left,
        held,
        doubted,
        beside,
        elsewhere,
        but: placed.or(unlikely),
        on_white: bench.is_white(),
        vetoed,
    }
}

fn jumps(residual: &[f64]) -> Vec<f64> {
    residual.windows(2).map(|pair| pair[1] - pair[0]).collect()
}

/// Held-out blocks, each fold predicted by a model fitted on the others.
struct Held {
    /// Error as designed, rms.
    before: f64,
    /// Error of the predictions, rms.
    after: f64,
    /// The same at each row, as read; NaN where no block was held out.
    read: Vec<f64>,
    /// The same as it was fitted.
    residual: Vec<f64>,
}

/// Fits a model anew for each fold; as it is fitted, and as it was read.
fn folds(bench: &Workbench<'_>, fit: &Fit) -> Held {
    let mut residual = vec![f64::NAN; bench.len()];
    let mut seen = residual.clone();
    let folds = FOLDS.min(bench.blocks.len());
    // How the recording began is no physics that another part of it could tell.
    let mut begun = fit.model.clone();
    let mut members = begun.members.iter().enumerate();
    begun.held = members.find_map(|(m, member)| Some((m, member.effect.beginning()?)));
    for fold in 0..folds {
        let mut used = vec![0.0; bench.len()];
        for (block, rows) in bench.blocks.iter().enumerate() {
            if block % folds != fold {
                used[rows.clone()].fill(1.0);
            }
        }
        let other = fit::fit(bench, &begun, Some(&used));
        let as_read = bench.as_read(&other.residual);
        for (block, rows) in bench.blocks.iter().enumerate() {
            if block % folds == fold {
                residual[rows.clone()].copy_from_slice(&other.residual[rows.clone()]);
                seen[rows.clone()].copy_from_slice(&as_read[rows.clone()]);
            }
        }
    }
    let before = rms((0..bench.len())
        .filter(|&row| seen[row].is_finite())
        .map(|row| bench.y[row] - bench.plain[row]));
    Held {
        before,
        after: rms(seen.iter().copied()),
        read: seen,
        residual,
    }
}

/// What the simulation with `effects` (id and values in the order of the effect's parameters) says at each observed row;
/// NaN where the drive does not reach. Effects that the problem has already modelled stay in.
pub fn predict(problem: &Problem, effects: &[(String, Vec<f64>)]) -> Vec<f64> {
    let members: Vec<(&'static dyn Effect, &[f64])> = effects
        .iter()
        .filter_map(|(id, values)| Some((find_with(id, values.len())?, values.as_slice())))
        .collect();
    Chain::new(problem).run(&members, &Nuisance::default())
}
