//! From problems to named effects: fit, select, say where, how sure and what is left.
//!
//! One way: [`workbench`] makes a problem ready, [`screen`] asks which effects could account for what is left, [`fit`] fits
//! them, [`select`] decides, [`intervals`] and [`locate`] say how sure and where, and this module puts the report together.
//! Nothing here knows a file or an effect by name.

pub mod fit;
pub mod flexible;
pub mod intervals;
pub mod locate;
pub mod screen;
pub mod select;
pub mod shape;
pub mod whiten;
pub mod workbench;

use std::path::{Path, PathBuf};
use std::time::Instant;

use crate::effects::chain::{Chain, Nuisance};
use crate::effects::scene::Scale;
use crate::effects::{Effect, IDEALISED, Search, find, find_with};
use crate::problem::{Base, Coloured, Problem};
use crate::report::data::{
    EffectReport, FittedModel, HoldoutReport, Location, LocationKind, ParameterReport, Report,
    SignalPlots, SignalReport, Unexplained, Verdict,
};
use crate::spectrum;
use fit::Fit;
use flexible::{Explainable, Features};
use intervals::Variation;
use select::{Selection, percent};
use workbench::{Member, Model, Workbench};

/// Structure left beside the named effects makes the explanation a partial one from this share of the residual on.
const LEFT: f64 = 0.04;
/// What a battery is found to be off by is told from here on, in %.
const TOLD_PERCENT: f64 = 0.1;
/// A mismatch that no effect explains is one from this share within reach of the inputs on.
const STRUCTURE: f64 = 0.1;
/// What remains is too loud from this multiple of the stated noise on.
const LOUD: f64 = 1.3;
/// Where no noise is stated, a mismatch is more than noise with a memory from this multiple of its jumps on.
const SLOW: f64 = 10.0;
/// Where no effect passes, loudness is judged by this share of the residual's sizes, which is so many standard deviations of a
/// normal distribution: a few readings do not make a loud recording. Those have a question of their own, [`STRAY`].
const COMMON: (f64, f64) = (0.8, 1.2816);
/// Times the stated noise that noise never is.
const STRAY: f64 = 8.0;
/// Fewer readings beyond it are not told from a slip of the log.
const STRAYS: usize = 2;
/// Those readings are the mismatch if they make this share of its energy.
const STRAYED: f64 = 0.5;
/// Where no noise is stated, a heavy tail is a noise of its own: there they have to be nearly all of it.
const NEARLY_ALL: f64 = 0.9;
/// From this correlation on, what is left sits where the named effects act: their shape is wrong.
const ALIKE: f64 = 0.35;
/// From this ratio of what is left explainable to what the named effects explain on, their names are not to be trusted: another
/// physics of the same shape would leave as much.
const DOUBTFUL: f64 = 0.12;
/// Below this ratio it is traces, wherever they sit: even a true effect's equation is a model.
const TRACES: f64 = 0.05;
/// An effect whose values would have to differ from stretch to stretch by so many times what equations may be off by (14 % of it,
/// rms, of a sensor's; 28 % of a battery's) is not what is there: true ones of other people's circuits and cells stay below.
const WAVERS: f64 = 2.8;
/// From this share on (5 % rms, as much as an idealised equation may be off) the name is doubted: another physics of much the same
/// shape could be behind it. The same where so much of what the effects take is left within reach of the inputs, or beyond the
/// stated noise.
const DOUBTED: f64 = 0.0025;
/// What is left has to have this many times the energy of the stated noise to be beyond it: noise is stated to five percent at best.
const STATED: f64 = 1.1;
/// An effect that makes the error in another file larger by this factor is not that file's physics.
const WORSE: f64 = 1.05;
/// A file that was never fitted confirms the effects if they bring its error down to this share.
const CONFIRMED: f64 = 0.6;
/// An interval whose ends differ by this factor says nothing.
const VAGUE: f64 = 100.0;
/// Starts of an effect that are fitted in another's place; of more the nearest.
const STAND_INS: usize = 12;
/// Share of what is in a band of frequency from which on an effect reaches it.
const REACHES: f64 = 0.1;
/// Places in a turn that are tried for a file that was never fitted.
const PHASES: f64 = 24.0;
/// Folds for the figures of held-out blocks, each with a fit of its own.
const FOLDS: usize = 5;

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

fn one(
    problem: &Problem,
    holdouts: &[Holdout],
    options: &Options,
    report: &mut Report,
    progress: &mut dyn FnMut(f64, &str),
) -> Part {
    let read = Workbench::new(problem, &options.without);
    // Noise with a memory is made white for all that is decided; what is shown is as it was read.
    let white = read.whitened();
    let mut bench = white.as_ref().unwrap_or(&read);
    let others: Vec<Unfitted<'_>> = holdouts
        .iter()
        .flat_map(|holdout| holdout.problems.iter().map(move |other| (holdout, other)))
        .filter(|(_, other)| other.name == problem.name)
        .map(|(holdout, other)| Unfitted {
            file: &holdout.file,
            bench: Workbench::new(other, &[]),
        })
        .collect();
    let mut decided = decide((bench, &read), &others, options.seed, progress);
    // Behind what cuts or rounds, noise is not what the model file states: there readings have to do as they are.
    if bench.is_white() && (decided.names_nothing() || decided.names_a_cut()) {
        let again = decide((&read, &read), &others, options.seed, progress);
        if again.names_a_cut() || (decided.names_a_cut() && !again.names_nothing()) {
            bench = &read;
            decided = again;
        }
    }
    let Decided {
        mut selection,
        verdict,
        left,
        held,
        beside,
    } = decided;
    let doubted = beside.is_some();
    let model = &selection.fit.model;

    if bench.is_white() {
        selection.decisions.push(format!(
            "The stated noise has a memory of {} s: decided on what each reading says beyond those before it. Gains are shares of that.",
            short(problem.coloured.tau_s)
        ));
    }
    let shown = selection.fit.as_read(bench, &read);
    let plain_residual = read.residual(&read.plain);
    let noise = if problem.noise > 0.0 {
        problem.noise
    } else {
        fit::spread(&jumps(&shown.residual)) / std::f64::consts::SQRT_2
    };
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
    attribute(&read, &shown, &mut locations);
    report.locations.extend(locations);
    report
        .effects
        .extend(effects(bench, &selection, beside.unwrap_or(0.0)));
    report
        .holdouts
        .extend(others.iter().map(|other| HoldoutReport {
            file: other.file.display().to_string(),
            signal: problem.name.clone(),
            rmse_before: other.rmse_before(),
            rmse_after: other.rmse(model),
        }));
    if doubted || matches!(verdict, Verdict::Unknown | Verdict::PartlyExplained) {
        let place = locate::locate(&read, &shown.residual, options.seed)
            .into_iter()
            .next();
        report.unexplained.push(Unexplained {
            signal: problem.name.clone(),
            rmse: rms(shown.residual.iter().copied()),
            explainable_share: left.share,
            location: place,
        });
    }
    report.models.push(fitted(problem, &selection.fit));
    report
        .remarks
        .extend(base_found(&problem.name, selection.fit.model.nuisance));
    report.plots.push(plots(&read, &shown, &held.read));
    let sentence = sentence(bench, &selection, (verdict, doubted), left, report);
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
    /// See [`doubt`].
    beside: Option<f64>,
}

impl Decided {
    fn names_nothing(&self) -> bool {
        self.selection.named.is_empty()
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
    progress(0.95, "looking at what is left");
    let features = Features::new(bench);
    let before = features.explain(&selection.plain.residual, seed);
    let passed = !selection.named.is_empty();
    veto(bench, &mut selection, others);
    vague(bench, &mut selection);
    if wavering(bench, &mut selection, others) {
        vague(bench, &mut selection);
    }
    shape::withdraw((bench, read), &mut selection, seed);
    let taken_back = passed && selection.named.is_empty();
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
    let held = folds(bench, &selection.fit);
    let not_there = not_there(bench, &selection, others);
    let (verdict, beside) = doubt(
        bench,
        &mut selection,
        verdict,
        (left, &held),
        (confirmed, taken_back),
        not_there,
        unavoidable,
    );
    Decided {
        selection,
        verdict,
        left,
        held,
        beside,
    }
}

fn jumps(residual: &[f64]) -> Vec<f64> {
    residual.windows(2).map(|pair| pair[1] - pair[0]).collect()
}

/// A file that was never fitted, ready to be predicted.
struct Unfitted<'a> {
    file: &'a Path,
    bench: Workbench<'a>,
}

impl Unfitted<'_> {
    /// Error with a model.
    fn rmse(&self, model: &Model) -> f64 {
        let predicted = self.bench.run(&self.there(model));
        rms(self.bench.residual(&predicted).into_iter())
    }

    /// The model as it is taken to this file: how a file starts, and where in a turn, is its own; the physics is not.
    fn there(&self, model: &Model) -> Model {
        let mut model = elsewhere(model);
        let error = |model: &Model| rms(self.bench.residual(&self.bench.run(model)).into_iter());
        for m in 0..model.members.len() {
            let member = &model.members[m];
            let internal = member.effect.card().parameters.iter();
            let Some(p) = internal.clone().position(|parameter| parameter.internal) else {
                continue;
            };
            let Some(turn) = member.effect.turn(&member.values) else {
                continue;
            };
            let mut best = (error(&model), member.values[p]);
            for step in [1.0, 0.25, 0.0625].map(|share| share * turn / PHASES) {
                let around = best.1;
                for k in 0..PHASES as i32 {
                    let mut tried = model.clone();
                    tried.members[m].values[p] = around + (f64::from(k) - 0.5 * PHASES) * step;
                    let there = error(&tried);
                    if there < best.0 {
                        best = (there, tried.members[m].values[p]);
                    }
                }
            }
            model.members[m].values[p] = best.1;
        }
        model
    }

    /// Error as designed.
    fn rmse_before(&self) -> f64 {
        rms(self.bench.residual(&self.bench.plain).into_iter())
    }

    /// How many times the change that a model makes here is in this file's mismatch, and the standard error of that: regression of
    /// the one on the other, blocks as clusters (Liang and Zeger 1986). 1 is what a true effect has; `None` without a change.
    fn times_there(&self, model: &Model) -> Option<(f64, f64)> {
        let mismatch = self.bench.residual(&self.bench.plain);
        let left = self.bench.residual(&self.bench.run(&self.there(model)));
        let change: Vec<f64> = mismatch.iter().zip(&left).map(|(a, b)| a - b).collect();
        let blocks: Vec<_> = self.bench.blocks.clone();
        let energy: f64 = blocks
            .iter()
            .map(|rows| fit::dot(&change[rows.clone()], &change[rows.clone()]))
            .sum();
        if blocks.len() < 2 || energy <= 0.0 {
            return None;
        }
        let along: f64 = blocks
            .iter()
            .map(|rows| fit::dot(&change[rows.clone()], &mismatch[rows.clone()]))
            .sum();
        let times = along / energy;
        let scatter: f64 = blocks
            .iter()
            .map(|rows| {
                let of_block = rows
                    .clone()
                    .map(|row| change[row] * (mismatch[row] - times * change[row]));
                of_block.sum::<f64>().powi(2)
            })
            .sum();
        let count = blocks.len() as f64;
        Some((times, (scatter * count / (count - 1.0)).sqrt() / energy))
    }
}

/// What files that were never fitted say against the effects: the share, in energy, of their change that is too much or too
/// little there, and in which file, where that is more than an equation's being idealised and chance make it.
fn not_there(
    bench: &Workbench<'_>,
    selection: &Selection,
    others: &[Unfitted<'_>],
) -> Option<(f64, String)> {
    let members = &selection.fit.model.members;
    let rough = members
        .iter()
        .map(|member| roughness(bench, member))
        .fold(0.0, f64::max);
    others
        .iter()
        .filter_map(|other| {
            let (times, error) = other.times_there(&selection.fit.model)?;
            let off = (1.0 - times).abs();
            (off - select::CERTAIN * error > WAVERS * rough).then(|| {
                let text = format!(
                    "{}, which was never fitted, has {} times the change that is expected there",
                    other.file.display(),
                    short(times)
                );
                (off.powi(2), text)
            })
        })
        .max_by(|a, b| a.0.total_cmp(&b.0))
}

/// Whether every file that was never fitted is predicted much better with the effects than without.
fn confirmed(selection: &Selection, others: &[Unfitted<'_>]) -> bool {
    let better =
        |other: &Unfitted<'_>| other.rmse(&selection.fit.model) <= CONFIRMED * other.rmse_before();
    !others.is_empty() && others.iter().all(better)
}

/// Takes effects out again that make the prediction of files that were never fitted worse.
fn veto(bench: &Workbench<'_>, selection: &mut Selection, others: &[Unfitted<'_>]) {
    if others.is_empty() {
        return;
    }
    let worst = |with: &Model, without: &Model| -> f64 {
        others
            .iter()
            .map(|other| other.rmse(with) / other.rmse(without).max(1e-300))
            .fold(0.0, f64::max)
    };
    while !selection.named.is_empty() {
        let found = (0..selection.fit.model.members.len())
            .map(|index| {
                let without = fit::fit(bench, &selection.fit.model.without(index), None);
                let ratio = worst(&selection.fit.model, &without.model);
                (index, without, ratio)
            })
            .max_by(|a, b| a.2.total_cmp(&b.2));
        let Some((index, without, ratio)) = found.filter(|(_, _, ratio)| *ratio > WORSE) else {
            return;
        };
        selection.refused.push(format!(
            "{}: fits here, but makes the error in a file that was not fitted {:.2} times as large",
            selection.fit.model.members[index].id(),
            ratio
        ));
        selection.fit = fit::polish(bench, &without);
        selection.rename(bench);
    }
}

/// Whether values would have to differ from stretch to stretch by more than noise makes them, and by much.
fn waver(bench: &Workbench<'_>, member: &Member, variation: &Variation) -> bool {
    variation.deviations > select::CERTAIN
        && variation.share > (WAVERS * roughness(bench, member)).powi(2)
}

/// What an effect's equation may be off by, as a share of its change, rms.
fn roughness(bench: &Workbench<'_>, member: &Member) -> f64 {
    // Without relaxation and charge transfer the battery as designed is rougher than a sensor.
    let base = match bench.problem.base {
        Base::Sensor(_) => IDEALISED,
        Base::Battery(_) => 2.0 * IDEALISED,
    };
    member.effect.idealised().max(base)
}

/// Takes effects out again whose values would have to differ from stretch to stretch by more than noise makes them; true if there
/// were any.
fn wavering(bench: &Workbench<'_>, selection: &mut Selection, others: &[Unfitted<'_>]) -> bool {
    let mut refused: Vec<&'static str> = Vec::new();
    while !selection.named.is_empty() && !confirmed(selection, others) {
        let members = &selection.fit.model.members;
        let found = intervals::variations(bench, &selection.fit)
            .into_iter()
            .enumerate()
            .filter(|(index, variation)| waver(bench, &members[*index], variation))
            .max_by(|a, b| a.1.share.total_cmp(&b.1.share));
        let Some((index, variation)) = found else {
            break;
        };
        let id = members[index].id();
        // What was refused once does not come back in another's place: else two could take turns for ever.
        refused.push(id);
        selection.refused.push(format!(
            "{id}: fits, but its values would have to differ by {} from stretch to stretch, {:.0} standard deviations more than noise: what is there is not constant",
            percent(variation.share.sqrt()),
            variation.deviations
        ));
        let steady = |fit: &Fit| {
            let last = intervals::variations(bench, fit);
            let last = last.last().zip(fit.model.members.last());
            last.is_some_and(|(variation, member)| !waver(bench, member, variation))
        };
        replace(
            bench,
            selection,
            index,
            ("its values stay", &refused),
            &steady,
        );
    }
    !refused.is_empty()
}

/// Takes effects out again whose values the recording does not tell; where others would do as well, the best of those whose
/// values it does tell takes the place.
fn vague(bench: &Workbench<'_>, selection: &mut Selection) {
    let mut refused: Vec<&'static str> = Vec::new();
    while !selection.named.is_empty() {
        let intervals = intervals::intervals(bench, &selection.fit, 0.0);
        let members = &selection.fit.model.members;
        let found =
            members
                .iter()
                .zip(&intervals)
                .enumerate()
                .find_map(|(index, (member, intervals))| {
                    Some((index, untold(&bench.scale, member, intervals)?))
                });
        let Some((index, why)) = found else {
            return;
        };
        let id = members[index].id();
        refused.push(id);
        selection.refused.push(format!(
            "{id}: fits, but this recording does not tell its values: {why}"
        ));
        replace(
            bench,
            selection,
            index,
            ("the recording tells its values", &refused),
            &|_| true,
        );
    }
}

/// Takes an effect out of the model, or puts the best of its equals of which something holds in its place.
fn replace(
    bench: &Workbench<'_>,
    selection: &mut Selection,
    index: usize,
    (why, refused): (&str, &[&'static str]),
    holds: &dyn Fn(&Fit) -> bool,
) {
    let id = selection.fit.model.members[index].id();
    let holds = |fit: &Fit| {
        let last = fit.model.members.last();
        last.is_none_or(|member| !refused.contains(&member.id())) && holds(fit)
    };
    let without = fit::fit(bench, &selection.fit.model.without(index), None);
    match stand_in(bench, selection, &without.model, index, &holds) {
        Some(better) => {
            selection.decisions.push(format!(
                "{} instead of {id}: as good, and {why}.",
                better.model.members.last().map_or("", Member::id)
            ));
            selection.take(index, better);
        }
        None => selection.fit = fit::polish(bench, &without),
    }
    selection.rename(bench);
}

/// The best of what would have done as well in the place of an effect that was taken out, if the recording tells its values.
fn stand_in(
    bench: &Workbench<'_>,
    selection: &Selection,
    without: &Model,
    index: usize,
    holds: &dyn Fn(&Fit) -> bool,
) -> Option<Fit> {
    let named = selection.named.iter().find(|one| one.index == index)?;
    let as_read = bench.as_read(&selection.fit.predicted);
    let clues = bench.clues(&as_read);
    let mut fits: Vec<Fit> = named
        .equivalent
        .iter()
        .filter(|id| !without.has(id))
        .filter_map(|id| find(id))
        .flat_map(|effect| {
            let starts = effect.starts(&bench.scale, &clues).into_iter();
            let models = starts.map(|values| without.with(Member { effect, values }));
            nearest(bench, models.collect())
        })
        .map(|model| fit::fit(bench, &model, None))
        .collect();
    // In one spread for all: in its own, a bad fit's residual is a small one.
    let sigma = fits
        .iter()
        .fold(selection.fit.sigma, |least, fit| least.min(fit.sigma));
    let loss = |fit: &Fit| fit::loss(&fit.residual, sigma);
    fits.sort_by(|a, b| loss(a).total_cmp(&loss(b)));
    let found = fits.into_iter().find(|fit| {
        let last = fit.model.members.len() - 1;
        let member = &fit.model.members[last];
        select::at_end(bench, member).is_none()
            && untold(
                &bench.scale,
                member,
                &intervals::intervals(bench, fit, 0.0)[last],
            )
            .is_none()
            && holds(fit)
            && !select::beaten(bench, fit, &selection.fit)
    });
    found.map(|fit| fit::polish(bench, &fit))
}

/// Of many models the nearest to the readings as they are.
fn nearest(bench: &Workbench<'_>, models: Vec<Model>) -> Vec<Model> {
    if models.len() <= STAND_INS {
        return models;
    }
    let mut ranked: Vec<(f64, Model)> = models
        .into_iter()
        .map(|model| {
            let residual = bench.residual(&bench.run(&model));
            (residual.iter().map(|r| r.abs()).sum(), model)
        })
        .collect();
    ranked.sort_by(|a, b| a.0.total_cmp(&b.0));
    let nearest = ranked.into_iter().take(STAND_INS);
    nearest.map(|(_, model)| model).collect()
}

/// Why the recording does not tell an effect's values: an interval over orders of magnitude or over all that is physics, or
/// every size that the effect has could as well be none.
fn untold(scale: &Scale, member: &Member, intervals: &[[f64; 2]]) -> Option<String> {
    let parameters = member.effect.card().parameters;
    let known = || {
        parameters
            .iter()
            .zip(intervals)
            .enumerate()
            .filter(|(_, (parameter, _))| !parameter.internal)
    };
    // Where one size is told (a knee), another (how soft it is) need not be.
    let mut sizes = known()
        .filter(|(_, (parameter, _))| parameter.search == Search::Logarithmic)
        .map(|(_, (_, [low, high]))| *high > VAGUE * low)
        .peekable();
    let vague = sizes.peek().is_some() && sizes.all(|vague| vague);
    for (index, (parameter, [low, high])) in known() {
        let (lowest, highest) = member.effect.bounds(index, scale);
        let magnitudes = vague && parameter.search == Search::Logarithmic;
        let whole = !parameter.open && !parameter.to_top && low <= &lowest && high >= &highest;
        if magnitudes || whole {
            return Some(format!(
                "{} could be {} … {}",
                parameter.name,
                short(*low),
                short(*high)
            ));
        }
    }
    let sizes: Vec<_> = known()
        .filter(|(_, (parameter, _))| {
            parameter.search == Search::Linear && parameter.off.is_finite()
        })
        .collect();
    let none = |(parameter, [low, high]): (&crate::effects::Parameter, &[f64; 2])| {
        (*low..=*high).contains(&parameter.off)
    };
    (!sizes.is_empty() && sizes.iter().all(|(_, pair)| none(*pair))).then(|| {
        format!(
            "{} could as well be {}",
            sizes[0].1.0.name,
            short(sizes[0].1.0.off)
        )
    })
}

/// The model as it is taken to another file: how a file starts is its own, the physics is not.
fn elsewhere(model: &Model) -> Model {
    Model {
        nuisance: Nuisance {
            soc_shift: 0.0,
            ..model.nuisance
        },
        ..model.clone()
    }
}

/// The size that a share of a series stays below.
fn quantile(series: &[f64], share: f64) -> f64 {
    let mut sizes: Vec<f64> = series.iter().map(|value| value.abs()).collect();
    sizes.sort_unstable_by(f64::total_cmp);
    let at = (sizes.len() as f64 * share) as usize;
    sizes.get(at).copied().unwrap_or_default()
}

/// Energy that a true model would leave: the stated noise, as it comes through the end of the chain.
fn unavoidable(bench: &Workbench<'_>, fit: &Fit, seed: u64) -> f64 {
    let count = bench.len() as f64;
    let noise = bench.problem.noise;
    let as_read = bench.as_read(&fit.predicted);
    let clues = bench.clues(&as_read);
    let cuts =
        fit.model.members.iter().any(|member| {
            member.effect.cuts() && member.effect.noise_ahead(&member.values, &clues)
        });
    if noise > 0.0 && cuts {
        let energy = bench.noise_energy(&fit.model, &fit.predicted, noise, seed);
        energy.max(noise * noise * count)
    } else if noise > 0.0 {
        noise * noise * count
    } else {
        // A grid is told by the readings; reading and simulation are both on it.
        let grid: f64 = fit
            .model
            .members
            .iter()
            .filter_map(|member| member.effect.mark(&bench.scale, &clues))
            .map(|mark| mark.variance)
            .sum();
        2.0 * grid * count
    }
}

/// The verdict on one signal. Where the names are not to be trusted, the effects are taken back.
fn judge(
    bench: &Workbench<'_>,
    selection: &mut Selection,
    features: &Features,
    confirmed: bool,
    before: Explainable,
    left: Explainable,
    unavoidable: f64,
) -> Verdict {
    let count = bench.len().max(1) as f64;
    let noise = bench.problem.noise;
    let known = noise.max(bench.problem.accuracy.zero);
    if selection.named.is_empty() {
        let residual = &selection.plain.residual;
        let as_read = bench.as_read(residual);
        let common = |residual: &[f64]| {
            let common = quantile(residual, COMMON.0) / COMMON.1;
            common.min(rms(residual.iter().copied()))
        };
        // What the readings jump by from one to the next is the most that noise without a memory can be.
        let (floor, times, of) = if noise > 0.0 {
            (known, LOUD, "the noise that the model file states")
        } else {
            let jumps = fit::spread(&jumps(residual)) / std::f64::consts::SQRT_2;
            (
                known.max(jumps),
                SLOW,
                "what it changes from reading to reading",
            )
        };
        let loudest = [
            (common(residual), swing(bench, bench.coloured())),
            (common(&as_read), swing(bench, bench.problem.coloured)),
        ]
        .into_iter()
        .filter(|(common, swing)| *common > (times * floor).hypot(swing.sqrt()))
        .map(|(common, _)| common)
        .fold(0.0, f64::max);
        return if floor > 0.0 && loudest > 0.0 {
            selection.decisions.push(format!(
                "No effect passes, yet all over the recording the mismatch is {} times {of}: unknown.",
                short(loudest / floor)
            ));
            Verdict::Unknown
        } else if before.is_real() && before.share > STRUCTURE {
            selection.decisions.push(format!(
                "No effect passes, yet a smooth function of the recorded inputs takes {} of the held-out error (placebos up to {}): unknown.",
                percent(before.share),
                percent(before.placebo_most)
            ));
            Verdict::Unknown
        } else if let Some(strays) = strays(bench, residual) {
            selection.decisions.push(format!(
                "No effect passes, yet {}, and not the others, are off by more than {STRAY} times {of}, by up to {} {}: unknown.",
                match strays.count {
                    1 => "one reading".to_owned(),
                    count => format!("{count} readings"),
                },
                short(strays.largest),
                bench.problem.unit
            ));
            Verdict::Unknown
        } else {
            selection.decisions.push(
                "No effect passes, and no smooth function of the recorded inputs explains more than chance.".into(),
            );
            Verdict::NoMismatch
        };
    }
    let energy = |fit: &Fit| fit.residual.iter().map(|r| r * r).sum::<f64>();
    let rest = energy(&selection.fit);
    let quiet = noise * noise * count;
    let explained = energy(&selection.plain) - rest + (unavoidable - quiet);
    let smooth = if left.is_real() && left.share > LEFT {
        left.share * rest
    } else {
        0.0
    };
    // What is beyond the noise that the design states is structure too, whatever the inputs say of it.
    let louder = |rest: f64, unavoidable: f64, coloured: Coloured| {
        let allowed = allowed(bench, unavoidable);
        let limit = LOUD * LOUD * allowed + swing(bench, coloured) * count;
        if noise > 0.0 && rest > limit {
            rest - allowed
        } else {
            0.0
        }
    };
    let beyond = louder(rest, unavoidable, bench.coloured());
    // A drift that is slower than the stated noise hides in it once that was made white: not as it was read.
    let seen = |fit: &Fit| {
        let as_read = bench.as_read(&fit.residual);
        fit::dot(&as_read, &as_read)
    };
    let rest_read = seen(&selection.fit);
    // As a share of what the named effects take.
    let drift = if bench.is_white() {
        let taken = (seen(&selection.plain) - rest_read).max(1e-300);
        louder(rest_read, unavoidable, bench.problem.coloured) / taken
    } else {
        0.0
    };
    if smooth > 0.0 {
        selection.decisions.push(format!(
            "Structure is left: a smooth function of the recorded inputs would take {} of what remains (placebos up to {}), {} of what the named effects take.",
            percent(left.share),
            percent(left.placebo_most),
            percent(smooth / explained.max(1e-300))
        ));
    }
    if beyond > 0.0 || drift > 0.0 {
        let loud = if beyond > 0.0 { rest } else { rest_read };
        selection.decisions.push(format!(
            "What remains is {} times the noise that the model file states.",
            short((loud / unavoidable).sqrt())
        ));
    }
    if smooth > 0.0 || beyond > 0.0 || drift > 0.0 {
        // What the model file's own equations may be off by is no sign of another physics.
        let ratio = (smooth.max(beyond) - bench.modelled).max(0.0) / explained.max(1e-300);
        let ratio = ratio.max(drift);
        let change = fit::change(&selection.fit.predicted, &selection.plain.predicted);
        let (shape, change) = features.shape(&selection.fit.residual, &change);
        let alike = if smooth > 0.0 {
            correlation(&shape, &change)
        } else {
            0.0
        };
        if !confirmed && (ratio > DOUBTFUL || (alike > ALIKE && ratio > TRACES)) {
            let ids = selection.fit.model.ids().join(", ");
            selection.refused.push(format!(
                "{ids}: the best of the library, but so much structure is left, and where these effects act, that the true physics is likely another"
            ));
            selection.fit = selection.plain.clone();
            selection.named.clear();
            return Verdict::Unknown;
        }
        return Verdict::PartlyExplained;
    }
    if selection
        .named
        .iter()
        .any(|named| !named.equivalent.is_empty())
    {
        Verdict::Ambiguous
    } else {
        Verdict::Explained
    }
}

/// Single readings that no stated noise makes.
struct Strays {
    count: usize,
    largest: f64,
}

/// Readings far beyond the stated noise, and what reference and time stamps are accurate to, if there are some and they make most of
/// what is left.
fn strays(bench: &Workbench<'_>, residual: &[f64]) -> Option<Strays> {
    let (noise, least, share) = if bench.problem.noise > 0.0 {
        (bench.problem.noise, STRAYS, STRAYED)
    } else {
        // Of the changes from reading to reading the common ones: the strays are not to hide behind themselves.
        let jumps: Vec<f64> = jumps(residual);
        let common = quantile(&jumps, COMMON.0) / COMMON.1 / std::f64::consts::SQRT_2;
        (common.max(bench.scale.quantum), 1, NEARLY_ALL)
    };
    if noise <= 0.0 {
        return None;
    }
    let sizes: Vec<f64> = (0..bench.len())
        .filter(|&row| residual[row].abs() > STRAY * noise + bench.accuracy(row))
        .map(|row| residual[row].abs())
        .collect();
    let energy: f64 = sizes.iter().map(|size| size * size).sum();
    let all: f64 = residual.iter().map(|r| r * r).sum();
    (sizes.len() >= least && energy > share * all).then(|| Strays {
        count: sizes.len(),
        largest: sizes.iter().fold(0.0, |most, size| most.max(*size)),
    })
}

/// The least energy that the design lets be left: what is unavoidable, or the reference's own zero.
fn allowed(bench: &Workbench<'_>, unavoidable: f64) -> f64 {
    let zero = bench.problem.accuracy.zero;
    unavoidable.max(zero * zero * bench.len() as f64)
}

/// By how much the mean square of the stated noise that has a memory, in the view's unit squared, can be above the stated one by
/// chance: over T it has no more than T/τ independent values (its squares' covariance falls as the square of its own).
fn swing(bench: &Workbench<'_>, coloured: Coloured) -> f64 {
    let span_s = match bench.t_s.as_slice() {
        [first, .., last] if last > first => last - first,
        _ => return 0.0,
    };
    select::CERTAIN * coloured.rms.powi(2) * (2.0 * coloured.tau_s / span_s).sqrt()
}

/// The verdict once more: names whose values waver, or that leave what follows the inputs, are the best of the library and no
/// more; and where all names were taken back for that, the mismatch is still there. If names are doubted, with the energy that may
/// be another physics' ([`intervals::intervals`]).
fn doubt(
    bench: &Workbench<'_>,
    selection: &mut Selection,
    verdict: Verdict,
    (left, held): (Explainable, &Held),
    (confirmed, taken_back): (bool, bool),
    not_there: Option<(f64, String)>,
    unavoidable: f64,
) -> (Verdict, Option<f64>) {
    if taken_back && verdict == Verdict::NoMismatch {
        selection.decisions.push(
            "There is a mismatch, yet the only effects that take it are not named: unknown.".into(),
        );
        return (Verdict::Unknown, None);
    }
    if confirmed || selection.named.is_empty() {
        return (verdict, None);
    }
    let energy = |fit: &Fit| fit.residual.iter().map(|r| r * r).sum::<f64>();
    let rest = energy(&selection.fit);
    let explained = (energy(&selection.plain) - rest).max(1e-300);
    let wavers = intervals::variations(bench, &selection.fit)
        .into_iter()
        .filter(|variation| variation.deviations > select::CERTAIN)
        .fold(0.0f64, |most, variation| most.max(variation.share));
    let (missed, carried) = carried(&selection.fit, held);
    // Each as a share of what the named effects change, in energy; and whether it is more than chance.
    let signs = [
        (
            missed / explained,
            carried,
            "its values from one part of the recording miss the other by",
        ),
        (
            wavers,
            true,
            "its values would have to differ from stretch to stretch by",
        ),
        (
            left.share * rest / explained,
            left.is_real(),
            "what is left within reach of the inputs is",
        ),
        (
            beyond(bench, rest, unavoidable) / explained,
            true,
            "what is left beyond the stated noise is",
        ),
    ];
    let members = &selection.fit.model.members;
    let general = members.iter().find(|member| member.effect.general());
    let mut doubts: Vec<String> = general
        .map(|member| format!("{} follows any process of its kind", member.id()))
        .into_iter()
        .collect();
    for (share, real, what) in signs {
        if real && share > DOUBTED {
            doubts.push(format!("{what} {} of its change", percent(share.sqrt())));
        }
    }
    let elsewhere = not_there.as_ref().map_or(0.0, |(share, _)| *share);
    doubts.extend(not_there.map(|(_, text)| text));
    if doubts.is_empty() {
        return (verdict, None);
    }
    selection.decisions.push(format!(
        "{}: the best of the library, yet {}: another physics of much the same shape may be behind it.",
        selection.fit.model.ids().join(", "),
        doubts.join(", and ")
    ));
    let most = signs
        .iter()
        .map(|(share, ..)| *share)
        .fold(elsewhere, f64::max);
    (Verdict::Ambiguous, Some(most * explained))
}

/// Energy by which values that were found in a part of the recording miss the other part, beyond what the fit leaves; and whether
/// that is much beside it.
fn carried(fit: &Fit, held: &Held) -> (f64, bool) {
    let told = held.residual.iter().zip(&fit.residual);
    let (there, here) = told
        .filter(|(there, _)| there.is_finite())
        .fold((0.0, 0.0), |(a, b), (there, here)| {
            (a + there * there, b + here * here)
        });
    ((there - here).max(0.0), there > STATED * here)
}

/// Energy of what is left beyond the stated noise, if that is stated well enough to tell.
fn beyond(bench: &Workbench<'_>, rest: f64, unavoidable: f64) -> f64 {
    let allowed = allowed(bench, unavoidable);
    let count = bench.len().max(1) as f64;
    let chance = select::CERTAIN * allowed * (2.0 / count).sqrt();
    let certain = rest > STATED * allowed
        && rest - allowed > chance.max(swing(bench, bench.coloured()) * count);
    if bench.problem.noise > 0.0 && certain {
        rest - allowed
    } else {
        0.0
    }
}

/// Correlation of the sizes of two series.
fn correlation(a: &[f64], b: &[f64]) -> f64 {
    let count = a.len().max(1) as f64;
    let mean = |series: &[f64]| series.iter().map(|v| v.abs()).sum::<f64>() / count;
    let (ma, mb) = (mean(a), mean(b));
    let (mut ab, mut aa, mut bb) = (0.0, 0.0, 0.0);
    for (x, y) in a.iter().zip(b) {
        let (x, y) = (x.abs() - ma, y.abs() - mb);
        ab += x * y;
        aa += x * x;
        bb += y * y;
    }
    ab / (aa * bb).sqrt().max(1e-300)
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

/// Which effect accounts for each place: the one that changes the reading most there.
fn attribute(bench: &Workbench<'_>, fit: &Fit, locations: &mut [Location]) {
    if fit.model.members.is_empty() || locations.is_empty() {
        return;
    }
    let changes: Vec<(&'static str, Vec<f64>)> = (0..fit.model.members.len())
        .map(|index| {
            let without = bench.run(&fit.model.without(index));
            let change = fit
                .predicted
                .iter()
                .zip(without)
                .map(|(with, without)| with - without)
                .collect();
            (fit.model.members[index].id(), change)
        })
        .collect();
    let variables = locate::variables(bench);
    for location in locations {
        if location.kind == LocationKind::Frequency {
            let energy = |change: &[f64]| locate::energy_in_band(bench, location, change);
            let there = energy(&fit.residual) + changes.iter().map(|(_, c)| energy(c)).sum::<f64>();
            // An effect that hardly reaches a band is not why it stands out.
            location.effect = changes
                .iter()
                .map(|(id, change)| (*id, energy(change)))
                .filter(|(_, energy)| *energy > REACHES * there)
                .max_by(|a, b| a.1.total_cmp(&b.1))
                .map(|(id, _)| id.to_owned());
            continue;
        }
        let here: Vec<usize> = (0..bench.len())
            .filter(|&row| locate::within(bench, location, &variables, row).unwrap_or(true))
            .collect();
        location.effect = changes
            .iter()
            .map(|(id, change)| {
                (
                    *id,
                    here.iter()
                        .map(|&row| change[row].powi(2))
                        .filter(|c| c.is_finite())
                        .sum::<f64>(),
                )
            })
            .max_by(|a, b| a.1.total_cmp(&b.1))
            .map(|(id, _)| id.to_owned());
    }
}

/// The unit of a parameter in this problem: `A` in the effects table stands for the view's unit.
fn unit(problem: &Problem, unit: &str) -> String {
    match problem.view {
        crate::problem::View::Sensor if problem.unit != "A" => unit.replace('A', &problem.unit),
        _ => unit.to_owned(),
    }
}

fn effects(bench: &Workbench<'_>, selection: &Selection, beside: f64) -> Vec<EffectReport> {
    let intervals = intervals::intervals(bench, &selection.fit, beside);
    selection
        .named
        .iter()
        .map(|named| {
            let member = &selection.fit.model.members[named.index];
            let card = member.effect.card();
            let parameters = card
                .parameters
                .iter()
                .enumerate()
                .filter(|(_, parameter)| !parameter.internal)
                .map(|(p, parameter)| {
                    let value = member.values[p];
                    let [from, to] = intervals[named.index][p];
                    // What has no sign has none in its interval; other bounds are those of the search.
                    let unsigned = member.effect.bounds(p, &bench.scale).0 == 0.0 && value >= 0.0;
                    ParameterReport {
                        name: parameter.name.to_owned(),
                        value,
                        ci95: [if unsigned { from.max(0.0) } else { from }, to],
                        off: Some(parameter.off).filter(|off| off.is_finite()),
                        unit: unit(bench.problem, parameter.unit),
                    }
                })
                .collect();
            let separated: Vec<&str> = named
                .equivalent
                .iter()
                .filter_map(|id| find(id))
                .map(|effect| effect.card().separated_by)
                .chain((!named.equivalent.is_empty()).then_some(card.separated_by))
                .collect();
            EffectReport {
                id: card.id.to_owned(),
                signal: bench.problem.name.clone(),
                statement: statement(card.statement, &bench.problem.unit),
                equation: card.equation.to_owned(),
                parameters,
                held_out_gain: named.held_out_gain,
                placebo_p99: named.placebo_p99,
                equivalent_to: named.equivalent.iter().map(|id| (*id).to_owned()).collect(),
                separated_by: separated.join("; or "),
                consequences: member.effect.consequences(&member.values, bench.problem),
            }
        })
        .collect()
}

/// What an effect does, in words of the signal's unit: the library is written for currents.
fn statement(of_currents: &str, unit: &str) -> String {
    if unit == "A" {
        of_currents.to_owned()
    } else {
        of_currents.replace("every current", "every value")
    }
}

fn plots(bench: &Workbench<'_>, fit: &Fit, held_residual: &[f64]) -> SignalPlots {
    let step = bench.scale.reading_step_s;
    let plain = bench.residual(&bench.plain);
    let before = spectrum::density(&bench.t_s, &plain, step, 60);
    let after = spectrum::density(&bench.t_s, &fit.residual, step, 60);
    SignalPlots {
        name: bench.problem.name.clone(),
        unit: bench.problem.unit.clone(),
        t_s: bench.t_s.clone(),
        recorded: bench.y.clone(),
        before: bench.plain.clone(),
        after: fit.predicted.clone(),
        reference: bench.reference.clone(),
        held_out_residual: held_residual.to_vec(),
        variables: locate::variables(bench)
            .into_iter()
            .map(|variable| {
                (
                    format!("{} / {}", variable.name, variable.unit),
                    variable.values,
                )
            })
            .collect(),
        spectrum: before
            .iter()
            .zip(&after)
            .map(|(before, after)| (0.5 * (before.0 + before.1), before.2, after.2))
            .collect(),
    }
}

fn sentence(
    bench: &Workbench<'_>,
    selection: &Selection,
    (verdict, doubted): (Verdict, bool),
    left: Explainable,
    report: &Report,
) -> String {
    let name = &bench.problem.name;
    let ids: Vec<String> = selection
        .named
        .iter()
        .map(|named| {
            let id = selection.fit.model.members[named.index].id();
            if named.equivalent.is_empty() {
                id.to_owned()
            } else {
                format!("{id} (or {})", named.equivalent.join(", "))
            }
        })
        .collect();
    let figures = report.signals.last().map_or(String::new(), |signal| {
        format!(
            "held-out error {} → {} {}",
            short(signal.held_out_blocks_before),
            short(signal.held_out_blocks_after),
            signal.unit
        )
    });
    match verdict {
        Verdict::NoMismatch => format!(
            "{name}: recording and simulation agree; nothing is left that any effect explains better than chance."
        ),
        Verdict::Explained => format!("{name}: explained by {} ({figures}).", ids.join(" and ")),
        Verdict::PartlyExplained => format!(
            "{name}: partly explained by {} ({figures}); {}.",
            ids.join(" and "),
            if left.is_real() {
                format!(
                    "structure is left, {} of it within reach of the recorded inputs",
                    percent(left.share)
                )
            } else {
                "what remains is louder than the stated noise".to_owned()
            }
        ),
        Verdict::Ambiguous if doubted => format!(
            "{name}: explained best by {} ({figures}), but not certainly: another physics of much the same shape may be behind it.",
            ids.join(" and ")
        ),
        Verdict::Ambiguous => format!(
            "{name}: explained by {} ({figures}); this recording cannot tell them apart.",
            ids.join(" and ")
        ),
        Verdict::Unknown => format!(
            "{name}: there is a mismatch, and no effect of the library accounts for it ({figures})."
        ),
    }
}

/// Three digits.
fn short(value: f64) -> String {
    if value == 0.0 || !value.is_finite() {
        return format!("{value}");
    }
    let digits = 2 - value.abs().log10().floor() as i32;
    format!("{value:.*}", digits.clamp(0, 12) as usize)
}

/// What the simulation with `effects` (id and values in the order of the effect's parameters) says at each observed row;
/// NaN where the drive does not reach. Effects that the problem has already modelled stay in.
pub fn predict(problem: &Problem, effects: &[(String, Vec<f64>)]) -> Vec<f64> {
    let members: Vec<(&'static dyn Effect, &[f64])> = effects
        .iter()
        .filter_map(|(id, values)| Some((find_with(id, values.len())?, values.as_slice())))
        .collect();
    Chain::new(problem).run(&members, Nuisance::default())
}

/// What was found of a battery within what the model file leaves open: it is no physics that was left out, and part of every error
/// after it.
fn base_found(name: &str, nuisance: Nuisance) -> Option<String> {
    let by = |share: f64, what: &str, unit: &str| {
        let percent = 100.0 * share;
        let way = if percent > 0.0 { "higher" } else { "lower" };
        (percent.abs() >= TOLD_PERCENT)
            .then(|| format!("{what} {} {unit} {way}", short(percent.abs())))
    };
    let start = "the state of charge at the start";
    let found: Vec<String> = [
        by(nuisance.resistance, "the ohmic resistance", "%"),
        by(nuisance.soc_shift, start, "points of per cent"),
    ]
    .into_iter()
    .flatten()
    .collect();
    (!found.is_empty()).then(|| {
        format!(
            "{name}: within what the model file leaves open, {} than stated fits; the errors after are with that",
            found.join(" and ")
        )
    })
}

fn fitted(problem: &Problem, fit: &Fit) -> FittedModel {
    let values = |member: &Member| {
        let names = member
            .effect
            .card()
            .parameters
            .iter()
            .map(|parameter| parameter.name.to_owned());
        names.zip(member.values.iter().copied()).collect()
    };
    FittedModel {
        signal: problem.name.clone(),
        effects: fit
            .model
            .members
            .iter()
            .map(|member| (member.id().to_owned(), values(member)))
            .collect(),
        nuisance: fit.model.nuisance,
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn what_a_battery_was_off_by_is_told_if_it_matters() {
        let found = |resistance, soc_shift| {
            let nuisance = Nuisance {
                resistance,
                soc_shift,
                ..Nuisance::default()
            };
            base_found("v_cell_v", nuisance)
        };
        assert_eq!(found(4e-4, -4e-4), None);
        let said = found(0.273, -0.0071).unwrap();
        assert!(said.contains("resistance 27.3 % higher and"), "{said}");
        assert!(
            said.contains("start 0.710 points of per cent lower"),
            "{said}"
        );
    }

    #[test]
    fn what_a_recording_does_not_tell_is_told_from_what_it_does() {
        let scale = Scale {
            full_scale: 600.0,
            largest: 400.0,
            rms: 100.0,
            step_s: 0.1,
            reading_step_s: 0.1,
            span_s: 1000.0,
            capacity_ah: 50.0,
            ..Scale::default()
        };
        let says = |id: &str, intervals: &[[f64; 2]]| {
            let effect = find(id).unwrap();
            let values = intervals.iter().map(|[low, high]| 0.5 * (low + high));
            let member = Member {
                effect,
                values: values.collect(),
            };
            untold(&scale, &member, intervals)
        };
        assert_eq!(says("offset", &[[0.1, 0.3]]), None);
        assert!(
            says("offset", &[[-0.1, 0.3]])
                .unwrap()
                .contains("offset_a could as well be 0")
        );
        // One size is enough.
        assert_eq!(says("range-mismatch", &[[1.01, 1.02], [-0.1, 0.1]]), None);
        assert!(says("range-mismatch", &[[0.99, 1.02], [-0.1, 0.1]]).is_some());
        assert!(says("coulombic-efficiency", &[[-1.0, 12.0]]).is_some());
        assert_eq!(says("coulombic-efficiency", &[[0.97, 0.99]]), None);
        assert_eq!(says("lag", &[[0.1, 0.4]]), None);
        assert!(says("lag", &[[0.01, 2.0]]).unwrap().contains("tau_s"));
        assert!(says("ocv-hysteresis", &[[-3.0, 1.8], [1e-6, 1e-5]]).is_some());
        assert_eq!(says("ocv-hysteresis", &[[0.01, 0.02], [60.0, 300.0]]), None);
    }
}
