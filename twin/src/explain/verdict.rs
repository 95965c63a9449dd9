//! The verdict on one signal: what a true model would leave, what is left, and what that says of the names.

use super::fit::{self, Fit};
use super::flexible::{Explainable, Features};
use super::normal::dot;
use super::quieter::only_quietens;
use super::robust::{common, spread};
use super::select::{self, Selection};
use super::slope::change;
use super::strays::{STRAY, noise_is_stated, slipped, strays};
use super::told::short;
use super::workbench::{Member, Model, Workbench};
use super::{Held, intervals, jumps, rms};
use crate::problem::{Accuracy, Coloured, View};
use crate::report::data::Verdict;
use crate::report::format::precise_percent;

/// Structure left beside the named effects makes the explanation a partial one from this share of the residual on.
const LEFT: f64 = 0.04;
/// A mismatch that no effect explains is one from this share within reach of the inputs on.
const STRUCTURE: f64 = 0.1;
/// What remains is too loud from this multiple of the stated noise on.
const LOUD: f64 = 1.3;
/// Where no noise is stated, a mismatch is more than noise with a memory from this multiple of its jumps on.
const SLOW: f64 = 10.0;
/// From this correlation on, what is left sits where the named effects act: their shape is wrong.
const ALIKE: f64 = 0.35;
/// From this ratio of what is left explainable to what the named effects explain on, their names are not to be trusted: another
/// physics of the same shape would leave as much.
const DOUBTFUL: f64 = 0.12;
/// Below this ratio it is traces, wherever they sit: even a true effect's equation is a model.
const TRACES: f64 = 0.05;
/// From this share on (5 % rms, as much as an idealised equation may be off) the name is doubted: another physics of much the same
/// shape could be behind it. The same where so much of what the effects take is left within reach of the inputs, or beyond the
/// stated noise.
const DOUBTED: f64 = 0.0025;
/// What is left has to have this many times the energy of the stated noise to be beyond it: noise is stated to five percent at best.
pub(super) const STATED: f64 = 1.1;
/// A sensor that moves with less than this share of the simulation's energy follows it no more than by chance.
const DEAD: f64 = 0.01;
/// Of fewer means than this their spread tells nothing.
const LEAST_MEANS: usize = 8;

/// The verdict on one signal. Where the names are not to be trusted, the effects are taken back.
pub(super) fn judge(
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
    if selection.named.is_empty() {
        return without_names(bench, selection, before);
    }
    if follows_nothing(bench, selection) {
        return take_back(
            selection,
            "what they leave of the simulation moves less than what remains beside it: the readings follow nothing, and many things make a sensor dead",
        );
    }
    let slips = slipped(bench, &selection.plain, &selection.fit);
    let energy = |residual: &[f64]| without_rows(residual, &slips);
    let rest = energy(&selection.fit.residual);
    let quiet = noise * noise * count;
    let explained = energy(&selection.plain.residual) - rest + (unavoidable - quiet);
    let smooth = if left.is_real() && left.share > LEFT {
        left.share * rest
    } else {
        0.0
    };
    // What is beyond the noise that the design states is structure too, whatever the inputs say of it; where it states none, beyond
    // what noise can be by the jumps of what is left, and more than traces.
    let jumping = spread(&jumps(&selection.fit.residual)).powi(2) / 2.0 * count;
    let louder = |rest: f64, unavoidable: f64, coloured: Coloured| {
        let allowed = allowed(bench, unavoidable);
        let (allowed, limit) = if noise > 0.0 {
            let swing = swing(bench, coloured) * count;
            (allowed, LOUD * LOUD * allowed + swing)
        } else {
            let slow = (SLOW * jumping.sqrt() + allowed.sqrt()).powi(2);
            (allowed.max(jumping), slow.max(LEFT * explained))
        };
        if rest > limit { rest - allowed } else { 0.0 }
    };
    let beyond = louder(rest, unavoidable, bench.coloured());
    // Slips of the log speak against no name, and are left all the same.
    let all = dot(&selection.fit.residual, &selection.fit.residual);
    let loud = louder(all, unavoidable, bench.coloured()) > 0.0;
    // A drift that is slower than the stated noise hides in it once that was made white: not as it was read.
    let seen = |fit: &Fit| energy(&bench.as_read(&fit.residual));
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
            precise_percent(left.share),
            precise_percent(left.placebo_most),
            precise_percent(smooth / explained.max(1e-300))
        ));
    }
    if beyond > 0.0 || drift > 0.0 || loud {
        let loud = if loud { all } else { rest_read };
        let (floor, of) = if noise > 0.0 {
            (unavoidable, "the noise that the model file states")
        } else {
            (
                unavoidable.max(jumping),
                "what it changes from reading to reading",
            )
        };
        selection.decisions.push(format!(
            "What remains is {} times {of}.",
            short((loud / floor).sqrt())
        ));
    }
    if smooth > 0.0 || beyond > 0.0 || drift > 0.0 || loud {
        // What the model file's own equations may be off by is no sign of another physics.
        let ratio = (smooth.max(beyond) - bench.modelled).max(0.0) / explained.max(1e-300);
        let ratio = ratio.max(drift);
        let change = change(&selection.fit.predicted, &selection.plain.predicted);
        let (shape, change) = features.shape(&selection.fit.residual, &change);
        let alike = if smooth > 0.0 {
            correlation(&shape, &change)
        } else {
            0.0
        };
        if !confirmed && (ratio > DOUBTFUL || (alike > ALIKE && ratio > TRACES)) {
            return take_back(
                selection,
                "the best of the library, but so much structure is left, and where these effects act, that the true physics is likely another",
            );
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

/// Takes all names back, for what speaks against them.
fn take_back(selection: &mut Selection, why: &str) -> Verdict {
    let ids = selection.fit.model.ids().join(", ");
    selection.refused.push(format!("{ids}: {why}"));
    selection.fit = selection.plain.clone();
    selection.named.clear();
    Verdict::Unknown
}

/// Whether the named effects make a sensor read all but the same all the time: less than a hundredth of the energy with which the
/// simulation moves, and less than what remains.
fn follows_nothing(bench: &Workbench<'_>, selection: &Selection) -> bool {
    if !matches!(bench.problem.view, View::Sensor | View::Charge) {
        return false;
    }
    let count = bench.len().max(1) as f64;
    let moves = |series: &[f64]| {
        let mean = series.iter().sum::<f64>() / count;
        series.iter().map(|value| (value - mean).powi(2)).sum()
    };
    let moved: f64 = moves(&selection.fit.predicted);
    moved < DEAD * moves(&selection.plain.predicted)
        && moved < dot(&selection.fit.residual, &selection.fit.residual)
}

/// Energy of a series but for some of its rows.
fn without_rows(series: &[f64], rows: &[usize]) -> f64 {
    let taken: f64 = rows.iter().map(|&row| series[row].powi(2)).sum();
    (dot(series, series) - taken).max(0.0)
}

/// The verdict where nothing is named: whether something is left all the same, and what tells it.
fn without_names(bench: &Workbench<'_>, selection: &mut Selection, before: Explainable) -> Verdict {
    let noise = bench.problem.noise;
    let known = noise.max(bench.problem.accuracy.zero);
    // What the reference is not accurate to, or rounding takes, is no mismatch.
    let inaccurate: Vec<f64> = (0..bench.len()).map(|row| bench.inaccuracy(row)).collect();
    let beyond = |residual: &[f64]| -> Vec<f64> {
        let pairs = residual.iter().zip(&inaccurate);
        pairs.map(|(r, by)| (r.abs() - by).max(0.0)).collect()
    };
    let residual = &selection.plain.residual;
    let as_read = bench.as_read(residual);
    // A few readings do not make a loud recording. Those have a question of their own (`strays`).
    let common = |residual: &[f64]| common(residual).min(rms(residual.iter().copied()));
    // What the readings jump by from one to the next is the most that noise without a memory can be.
    let (floor, times, of) = if noise > 0.0 {
        (known, LOUD, "the noise that the model file states")
    } else {
        let jumps = spread(&jumps(residual)) / std::f64::consts::SQRT_2;
        (
            known.max(jumps),
            SLOW,
            "what it changes from reading to reading",
        )
    };
    let loudest = [
        (common(&beyond(residual)), swing(bench, bench.coloured())),
        (
            common(&beyond(&as_read)),
            swing(bench, bench.problem.coloured),
        ),
    ]
    .into_iter()
    .filter(|(common, swing)| *common > (times * floor).hypot(swing.sqrt()))
    .map(|(common, _)| common)
    .fold(0.0, f64::max);
    if floor > 0.0 && loudest > 0.0 {
        selection.decisions.push(format!(
            "No effect passes, yet all over the recording the mismatch is {} times {of}: unknown.",
            short(loudest / floor)
        ));
        Verdict::Unknown
    } else if before.is_real()
        && before.share > STRUCTURE
        && before.share * dot(residual, residual) > dot(&inaccurate, &inaccurate)
    {
        selection.decisions.push(format!(
            "No effect passes, yet a smooth function of the recorded inputs takes {} of the held-out error (placebos up to {}): unknown.",
            precise_percent(before.share),
            precise_percent(before.placebo_most)
        ));
        Verdict::Unknown
    } else if let Some(strays) = strays(bench, residual).filter(|strays| strays.decide) {
        let (count, are) = strays.counted();
        selection.decisions.push(format!(
            "No effect passes, yet {count} {are} off by more than {STRAY} times {of}, and not the others, the worst by {} {} at {} s: unknown.",
            short(strays.largest),
            bench.problem.unit,
            short(strays.at_s),
        ));
        Verdict::Unknown
    } else {
        selection.decisions.push(
            "No effect passes, and no smooth function of the recorded inputs explains more than chance.".into(),
        );
        Verdict::NoMismatch
    }
}

/// Energy that a true model would leave: the stated noise, as it comes through the end of the chain.
pub(super) fn unavoidable(bench: &Workbench<'_>, fit: &Fit, seed: u64) -> f64 {
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
            .filter(|member| member.effect.rounds())
            .filter_map(|member| bench.mark(member.effect))
            .map(|mark| mark.variance)
            .sum();
        2.0 * grid * count
    }
}

/// The least energy that the design lets be left: what is unavoidable, or what the reference's own zero, the readings' steps and
/// moments that may all be off together make of readings. (What a gain that is off makes, the fit takes.)
pub(super) fn allowed(bench: &Workbench<'_>, unavoidable: f64) -> f64 {
    let stated = Accuracy {
        gain: 0.0,
        scatter: 0.0,
        ..bench.problem.accuracy
    };
    let grid = 0.5 * bench.problem.observed.grid;
    let together: f64 = (0..bench.len())
        .map(|row| (stated.at(0.0, bench.slope_per_s(row)) + grid).powi(2))
        .sum();
    unavoidable.max(together)
}

/// By how much the mean square of the stated noise that has a memory, in the view's unit squared, can be above the stated one by
/// chance: over T it has no more than T/τ independent values (its squares' covariance falls as the square of its own).
fn swing(bench: &Workbench<'_>, coloured: Coloured) -> f64 {
    // A clock may begin anew.
    let steps = bench.t_s.windows(2);
    let span_s: f64 = steps.map(|pair| (pair[1] - pair[0]).max(0.0)).sum();
    if span_s <= 0.0 {
        return 0.0;
    }
    select::CERTAIN * coloured.rms.powi(2) * (2.0 * coloured.tau_s / span_s).sqrt()
}

/// What [`doubt`] makes of a verdict.
#[derive(Default)]
pub(super) struct Doubt {
    pub verdict: Verdict,
    /// Whether the names are doubted.
    pub names: bool,
    /// Energy that may be another physics' ([`intervals::intervals`]).
    pub beside: f64,
}

/// The verdict once more: names whose values waver, or that leave what follows the inputs, are the best of the library and no
/// more; and where all names were taken back for that, the mismatch is still there.
pub(super) fn doubt(
    bench: &Workbench<'_>,
    selection: &mut Selection,
    verdict: Verdict,
    (left, held): (Explainable, &Held),
    (confirmed, taken_back): (bool, bool),
    (not_there, placed): (Option<(f64, String)>, Option<&str>),
    unavoidable: f64,
) -> Doubt {
    let sure = |verdict| Doubt {
        verdict,
        ..Doubt::default()
    };
    if taken_back && verdict == Verdict::NoMismatch {
        selection.decisions.push(
            "There is a mismatch, yet the only effects that take it are not named: unknown.".into(),
        );
        return sure(Verdict::Unknown);
    }
    // What contradicts the effects' size confirms nothing.
    if (confirmed && not_there.is_none()) || selection.named.is_empty() {
        return sure(verdict);
    }
    let slips = slipped(bench, &selection.plain, &selection.fit);
    let energy = |fit: &Fit| without_rows(&fit.residual, &slips);
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
            left.there() * rest / explained,
            left.is_real(),
            "what is left within reach of the inputs is",
        ),
        (
            remembered(bench, &selection.fit, &slips) / explained,
            true,
            "what is left from reading to reading, and the stated noise would not leave, is",
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
            doubts.push(format!(
                "{what} {} of its change",
                precise_percent(share.sqrt())
            ));
        }
    }
    let elsewhere = not_there.as_ref().map_or(0.0, |(share, _)| *share);
    doubts.extend(not_there.map(|(_, text)| text));
    doubts.extend(placed.map(str::to_owned));
    doubts.extend(quietening(bench, &selection.fit));
    // A memory longer than any that is looked for: the sizes that belong to it are not told either.
    doubts.extend(members.iter().flat_map(|member| {
        let times = member.effect.card().parameters.iter().enumerate();
        times
            .filter(|(p, time)| time.unit == "s" && select::stands_at_top(bench, member, *p))
            .map(|(p, time)| {
                format!(
                    "{} of {} stands at the end of what is searched, {} s",
                    time.name,
                    member.id(),
                    short(member.values[p])
                )
            })
    }));
    if doubts.is_empty() {
        // What is left moves the values, however sure the names are: if it is more than noise is stated to.
        let most = signs
            .iter()
            .filter(|(share, real, _)| *real && share * explained > (STATED - 1.0) * rest)
            .map(|(share, ..)| *share)
            .fold(0.0, f64::max);
        return Doubt {
            beside: most * explained,
            ..sure(verdict)
        };
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
    Doubt {
        verdict: Verdict::Ambiguous,
        names: true,
        beside: most * explained,
    }
}

/// What is to be said of effects between the rows that noise of the reference would look the same as. All of them are asked together: of
/// two that even it out, one does what the other is taken out for.
fn quietening(bench: &Workbench<'_>, fit: &Fit) -> Option<String> {
    let members = fit.model.members.iter();
    let (between, others): (Vec<&Member>, Vec<&Member>) =
        members.partition(|member| member.effect.card().stage.is_between_rows());
    if between.is_empty() {
        return None;
    }
    let without = Model {
        members: others.into_iter().cloned().collect(),
        ..fit.model.clone()
    };
    let without = fit::fit(bench, &without, None);
    only_quietens(bench, &without, fit).then(|| {
        let ids: Vec<&str> = between.iter().map(|member| member.id()).collect();
        format!(
            "{} evens out what the reference does from row to row and does not show where it moves, as if that were noise of the reference",
            ids.join(" with ")
        )
    })
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

/// Energy of what is left with a memory that the stated noise has not: of means of so many readings in a row, beyond what the noise
/// makes of them. Slow and small, it hides in the noise of single readings, and no input that was recorded need follow it. A slip of the
/// log is no memory, though it is in a mean.
fn remembered(bench: &Workbench<'_>, fit: &Fit, slips: &[usize]) -> f64 {
    let noise = bench.problem.noise;
    // Behind what cuts or rounds, noise is not what the model file states; and a memory that it states hides another.
    if bench.coloured().rms > 0.0 || !noise_is_stated(bench, fit) {
        return 0.0;
    }
    let accuracy = Accuracy {
        gain: 0.0,
        scatter: 0.0,
        ..bench.problem.accuracy
    };
    let mut residual = fit.residual.clone();
    slips.iter().for_each(|&row| residual[row] = 0.0);
    let rows: Vec<usize> = (0..bench.len()).collect();
    let widths = std::iter::successors(Some(2), |width| Some(2 * width));
    widths
        .take_while(|width| bench.len() >= LEAST_MEANS * width)
        .map(|width| {
            let ones = vec![1.0; width];
            let (mut energy, mut expected, mut variance) = (0.0, 0.0, 0.0);
            for rows in rows.chunks_exact(width) {
                let (from, count) = (rows[0], width as f64);
                let sum: f64 = residual[from..from + width].iter().sum();
                let by_noise = noise * noise * count + bench.rounded(from, &ones);
                let together: f64 = rows
                    .iter()
                    .map(|&row| accuracy.at(0.0, bench.slope_per_s(row)))
                    .sum();
                energy += sum * sum / count;
                expected += by_noise.max(together * together) / count;
                variance += 2.0 * (by_noise / count).powi(2);
            }
            let beyond = energy - expected;
            let certain = energy > STATED * expected && beyond > select::CERTAIN * variance.sqrt();
            if certain {
                beyond - bench.modelled
            } else {
                0.0
            }
        })
        .fold(0.0, f64::max)
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
