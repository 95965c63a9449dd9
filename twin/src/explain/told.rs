//! What the report says of one signal: its effects, its places, its plots and its sentence.

use super::fit::Fit;
use super::flexible::Explainable;
use super::intervals::Reported;
use super::select::{Selection, stands_at_top};
use super::slope::{BASE_OFF, at_base_end};
use super::workbench::{Member, Workbench};
use super::{Nuisance, locate, rms};
use crate::effects::ocv::bend_v;
use crate::effects::{CurrentError, find};
use crate::problem::{Base, Holds, Problem, View};
use crate::report::data::{
    EffectReport, FittedModel, Known, Location, LocationKind, ParameterReport, Report, SignalPlots,
    Verdict,
};
use crate::report::format::{at_most, percent, quantity};
use crate::spectrum;

/// What a battery is found to be off by is told from here on, in %.
const TOLD_PERCENT: f64 = 0.1;
/// Least bend of the open-circuit voltage that is told, in V.
const TOLD_V: f64 = 0.001;
/// A zero of the recorded current is told from this share of its uncertainty on.
const TOLD_ZERO: f64 = 0.1;
/// An alignment of readings is told from this share of a step on.
const TOLD_STEP: f64 = 0.05;
/// What the model file leaves open is in the verdict's sentence if it makes the error smaller by this factor.
const NOT_AS_STATED: f64 = 1.5;
/// A held-out error that is this share of what it was, or more, has not fallen.
const UNCHANGED: f64 = 0.99;
/// A change of the resistance that moves the voltage by less than this share of the stated noise (rms) shows in no drive: a thousand
/// readings tell it to no more than its own size.
const HIDDEN: f64 = 0.02;
/// Share of what is in a band of frequency from which on an effect reaches it.
const REACHES: f64 = 0.1;

/// Which effect accounts for each place: the one that changes the reading most there.
pub(super) fn attribute(bench: &Workbench<'_>, fit: &Fit, locations: &mut [Location]) {
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
            .filter(|(_, energy)| *energy > 0.0)
            .max_by(|a, b| a.1.total_cmp(&b.1))
            .map(|(id, _)| id.to_owned());
    }
}

/// The unit of a parameter in this problem: `A` in the effects table stands for the view's unit.
fn unit(problem: &Problem, unit: &str) -> String {
    match problem.view {
        View::Sensor if problem.unit != "A" => unit.replace('A', &problem.unit),
        _ => unit.to_owned(),
    }
}

/// The named effects with their values, intervals and evidence.
pub(super) fn effects(
    bench: &Workbench<'_>,
    selection: &Selection,
    reported: &Reported,
) -> Vec<EffectReport> {
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
                .filter(|(p, parameter)| !parameter.internal && member.values[*p].is_finite())
                .map(|(p, parameter)| {
                    let value = member.values[p];
                    let [from, to] = reported.ci95[named.index][p];
                    // What has no sign has none in its interval; other bounds are those of the search.
                    let unsigned = member.effect.bounds(p, &bench.scale).0 == 0.0 && value >= 0.0;
                    ParameterReport {
                        name: parameter.name.to_owned(),
                        value,
                        ci95: [if unsigned { from.max(0.0) } else { from }, to],
                        off: Some(parameter.off).filter(|off| off.is_finite()),
                        unit: unit(bench.problem, parameter.unit),
                        known: if reported.unmoved.contains(&(named.index, p)) {
                            Known::Nothing
                        } else if stands_at_top(bench, member, p) {
                            Known::AtLeast
                        } else {
                            Known::Value
                        },
                    }
                })
                .collect();
            let separated: Vec<&str> = named
                .equivalent
                .iter()
                .filter_map(|id| find(id))
                .map(|effect| effect.card().separated_by)
                .chain(
                    (!named.equivalent.is_empty() || named.by_place.is_some())
                        .then_some(card.separated_by),
                )
                .collect();
            EffectReport {
                id: card.id.to_owned(),
                signal: bench.problem.name.clone(),
                statement: statement(card.statement, &bench.problem.unit),
                equation: card.equation.to_owned(),
                parameters,
                held_out_gain: named.held_out_gain,
                placebo_p99: named.placebo_p99,
                by_place: named.by_place.clone(),
                equivalent_to: named.equivalent.iter().map(|id| (*id).to_owned()).collect(),
                separated_by: separated.join("; or "),
                consequences: member.effect.consequences(&member.values, bench.problem),
            }
        })
        .collect()
}

/// What is to be said of intervals: values that the recording does not tell at all, and times that it tells to a row.
pub(super) fn not_told(
    bench: &Workbench<'_>,
    selection: &Selection,
    reported: &Reported,
) -> Vec<String> {
    let name = &bench.problem.name;
    let members = &selection.fit.model.members;
    let unmoved = reported.unmoved.iter().map(|&(m, p)| {
        let (member, [low, high]) = (&members[m], reported.ci95[m][p]);
        let parameter = &member.effect.card().parameters[p];
        format!(
            "{name}: {} of {} is not told: with anything from {} to {} the simulation is the same to within noise, and {} is only where the search stood",
            parameter.name,
            member.id(),
            short(low),
            quantity(&short(high), &unit(bench.problem, parameter.unit)),
            short(member.values[p])
        )
    });
    let late: Vec<&str> = reported.by_edges.iter().map(|m| members[*m].id()).collect();
    let by_edges = (!late.is_empty()).then(|| {
        format!(
            "{name}: what tells the time of {} are steps of the reference within one row, and where between two rows, {} s apart, each of \
             them was is not known: the interval has what that leaves open",
            late.join(" and "),
            short(bench.scale.step_s)
        )
    });
    let at_top = members.iter().flat_map(|member| {
        let parameters = member.effect.card().parameters.iter().enumerate();
        parameters
            .filter(|(p, _)| stands_at_top(bench, member, *p))
            .map(|(p, parameter)| {
                format!(
                    "{name}: {} of {} stands at the end of what is searched, {}: it is that or more, and the intervals of this effect hold for that value alone",
                    parameter.name,
                    member.id(),
                    quantity(&short(member.values[p]), &unit(bench.problem, parameter.unit)),
                )
            })
    });
    unmoved.chain(by_edges).chain(at_top).collect()
}

/// A stated noise must be within what the readings are off by in all, whatever else is behind that. Below this share of it, it is not.
const OVERSTATED: f64 = 0.5;

/// What is to be said of a stated noise that the readings cannot have. The part of it with a memory may have stood still.
pub(super) fn overstated(bench: &Workbench<'_>, plain: &Fit) -> Option<String> {
    const FEWEST: usize = 50;
    let problem = bench.problem;
    let white = problem.noise.powi(2) - problem.coloured.rms.powi(2);
    let all = rms(plain.residual.iter().copied());
    (bench.len() >= FEWEST && bench.censored.is_none() && all * all < OVERSTATED.powi(2) * white).then(|| {
        format!(
            "{}: the model file states a noise of {} {unit}, and recording and simulation differ by {} {unit} in all: a noise that is stated too \
             large (in another unit?) hides what is missing",
            problem.name,
            short(problem.noise),
            short(all),
            unit = problem.unit
        )
    })
}

/// What an effect does, in words of the signal's unit: the library is written for currents.
fn statement(of_currents: &str, unit: &str) -> String {
    if unit == "A" {
        of_currents.to_owned()
    } else {
        of_currents.replace("every current", "every value")
    }
}

/// The series that the page draws; `held_residual` is what held-out blocks leave, NaN elsewhere.
pub(super) fn plots(bench: &Workbench<'_>, fit: &Fit, held_residual: &[f64]) -> SignalPlots {
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
        // A battery's is a current, which has no place on an axis of volts or per cent.
        reference: match bench.problem.base {
            Base::Sensor(_) => bench.plain.clone(),
            Base::Battery(_) => Vec::new(),
        },
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

/// The verdict in one sentence; `elsewhere` is what another start would do, `but` what is to be said against an effect that is named,
/// and `vetoed` what was taken back for a file that was never fitted.
pub(super) fn sentence(
    bench: &Workbench<'_>,
    selection: &Selection,
    (verdict, doubted, [elsewhere, but]): (Verdict, bool, [Option<&str>; 2]),
    left: Explainable,
    (vetoed, report): (&[&str], &Report),
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
    let steps = only_steps(bench, selection, report);
    match verdict {
        Verdict::Explained if let Some(steps) = &steps => {
            format!("{name}: {steps}, and by nothing else.")
        }
        Verdict::PartlyExplained
            if let Some(steps) = &steps
                && left.is_real() =>
        {
            format!(
                "{name}: {steps}; structure is left in that, {} of it within reach of the recorded inputs.",
                percent(left.share)
            )
        }
        Verdict::Ambiguous
            if let Some(steps) = &steps
                && doubted =>
        {
            format!("{name}: {steps}; what is smaller than the steps this recording does not tell.")
        }
        Verdict::NoMismatch
            if let Some(found) = base_differs(bench.problem, &selection.fit.model.nuisance)
                && report.signals.last().is_some_and(|signal| {
                    signal.rmse_before > NOT_AS_STATED * signal.rmse_after
                }) =>
        {
            format!(
                "{name}: no physics is left out, but {found} than stated, {} what the model file leaves open ({figures}).",
                if at_limit(&selection.fit.model.nuisance, &bench.problem.base) {
                    "at the end of"
                } else {
                    "within"
                }
            )
        }
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
        Verdict::Ambiguous if let Some(elsewhere) = elsewhere => format!(
            "{name}: explained by {} ({figures}), but without any physics as well {elsewhere}: initial_soc may be off.",
            ids.join(" and ")
        ),
        Verdict::Ambiguous if let Some(but) = but => {
            format!(
                "{name}: explained by {} ({figures}), but {but}.",
                ids.join(" and ")
            )
        }
        Verdict::Ambiguous if doubted => format!(
            "{name}: explained best by {} ({figures}), but not certainly: another physics of much the same shape may be behind it.",
            ids.join(" and ")
        ),
        Verdict::Ambiguous => format!(
            "{name}: explained by {} ({figures}); this recording cannot tell them apart.",
            ids.join(" and ")
        ),
        Verdict::Unknown if !vetoed.is_empty() => format!(
            "{name}: there is a mismatch; here {} would account for it, but a file that was never fitted gets worse with it ({figures}).",
            vetoed.join(" and ")
        ),
        Verdict::Unknown if let Some(elsewhere) = elsewhere => format!(
            "{name}: there is a mismatch, and no effect of the library accounts for it ({figures}); {elsewhere}: initial_soc may be off."
        ),
        Verdict::Unknown => format!(
            "{name}: there is a mismatch, and no effect of the library accounts for it ({figures})."
        ),
    }
}

/// What is to be said where the only thing named is the step of the readings, and the simulation moves by it already (the reference is read
/// in the same one): an error that does not fall is not explained by anything, and is no larger than rounding makes it.
fn only_steps(bench: &Workbench<'_>, selection: &Selection, report: &Report) -> Option<String> {
    let [named] = selection.named.as_slice() else {
        return None;
    };
    let member = &selection.fit.model.members[named.index];
    let step = member.values.first().filter(|_| member.effect.rounds())?;
    let signal = report.signals.last()?;
    let (before, after) = (signal.held_out_blocks_before, signal.held_out_blocks_after);
    // Rounding errors are spread evenly over a step; those of readings and reference are two.
    let both = step * (2.0 / 12.0_f64).sqrt();
    (after >= UNCHANGED * before && after <= both).then(|| {
        let unit = &bench.problem.unit;
        format!(
            "recording and simulation differ by {}, no more than rounding both to the readings' step of {} makes ({} rms)",
            quantity(&short(after), unit),
            quantity(&at_most(*step, 4), unit),
            quantity(&short(both), unit)
        )
    })
}

/// What was found of a battery within what the model file leaves open: it is no physics that was left out, and part of every error
/// after it.
pub(super) fn base_found(problem: &Problem, nuisance: &Nuisance) -> Option<String> {
    let name = &problem.name;
    base_differs(problem, nuisance).map(|found| {
        if at_limit(nuisance, &problem.base) {
            format!(
                "{name}: {found} than stated is as far as the model file allows ({BASE_OFF} standard uncertainties), and more would fit \
                 better: what is stated is off by more, or something else makes it look so; the errors after are with that"
            )
        } else {
            format!("{name}: within what the model file leaves open, {found} than stated fits; the errors after are with that")
        }
    })
}

/// Whether what a battery is found to be off by stands at the end of what the model file allows.
fn at_limit(nuisance: &Nuisance, base: &Base) -> bool {
    let Base::Battery(base) = base else {
        return false;
    };
    let ends = |found: f64, sigma: f64| sigma > 0.0 && at_base_end(found / sigma);
    let mut starts = nuisance.soc_shift.iter().zip(&base.initial_soc_sigma);
    let mut bends = nuisance.ocv_bend_v.iter().enumerate();
    starts.any(|(shift, sigma)| ends(*shift, *sigma))
        || ends(nuisance.resistance, base.resistance_sigma)
        || ends(nuisance.current_zero_a, base.current_zero_sigma_a)
        || bends.any(|(line, found_v)| ends(base.cells * found_v, bend_v(&base.ocv, line)))
}

/// When an operation started, of several.
pub(super) fn start_of(operation: usize) -> String {
    format!("at the start of operation {}", operation + 1)
}

/// By what the battery as designed differs, if by as much as is told.
fn base_differs(problem: &Problem, nuisance: &Nuisance) -> Option<String> {
    let Base::Battery(base) = &problem.base else {
        return None;
    };
    let by = |share: f64, what: &str, unit: &str| {
        let percent = 100.0 * share;
        let way = if percent > 0.0 { "higher" } else { "lower" };
        (percent.abs() >= TOLD_PERCENT)
            .then(|| format!("{what} {} {unit} {way}", short(percent.abs())))
    };
    let (operation, shift) = nuisance.largest_soc_shift().unwrap_or_default();
    let start = match nuisance.soc_shift.len() {
        0 | 1 => "the state of charge at the start".to_owned(),
        count => format!(
            "the state of charge {}, the most of {count},",
            start_of(operation)
        ),
    };
    let bends = nuisance.ocv_bend_v.iter().copied().enumerate();
    let bend = bends
        .filter(|(_, bend_v)| bend_v.abs() >= TOLD_V)
        .max_by(|a, b| a.1.abs().total_cmp(&b.1.abs()))
        .map(|(line, bend_v)| {
            let ends_pct = [line, line + 1]
                .map(|point| 100.0 * base.ocv.get(point).map_or(f64::NAN, |point| point.0));
            format!(
                "the open-circuit voltage from {} to {} % up to {} V {}",
                short(ends_pct[0]),
                short(ends_pct[1]),
                short(bend_v.abs()),
                if bend_v > 0.0 { "higher" } else { "lower" }
            )
        });
    let zero_a = nuisance.current_zero_a;
    let zero =
        (zero_a.abs() >= TOLD_ZERO * base.current_zero_sigma_a && zero_a != 0.0).then(|| {
            let way = if zero_a > 0.0 { "higher" } else { "lower" };
            format!(
                "the recorded current's zero {} A {way}",
                short(zero_a.abs())
            )
        });
    let found: Vec<String> = [
        by(
            resistance_told(problem, nuisance),
            "the ohmic resistance",
            "%",
        ),
        by(shift, &start, "points of per cent"),
        zero,
        bend,
    ]
    .into_iter()
    .flatten()
    .collect();
    (!found.is_empty()).then(|| found.join(" and "))
}

/// The change of the ohmic resistance, as a share of it, if the recorded current is large enough for it to show, and none otherwise. In a
/// parked car's log the resistance is found by what else is open, and is none to drive with.
fn resistance_told(problem: &Problem, nuisance: &Nuisance) -> f64 {
    let change = nuisance.resistance;
    let Base::Battery(base) = &problem.base else {
        return change;
    };
    let current_a = rms(problem.drive.reference.iter().copied());
    let shows = (change * base.resistance_ohm * current_a).abs() >= HIDDEN * problem.noise;
    if shows { change } else { 0.0 }
}

/// What is to be said of readings behind what the model file says is at the end of the chain, or that do not come through it.
pub(super) fn behind_ends(bench: &Workbench<'_>) -> Option<String> {
    let (name, unit) = (&bench.problem.name, &bench.problem.unit);
    if let Some(censored) = &bench.censored {
        let effects = censored.effects.iter().rev();
        let effects: Vec<String> = effects.map(|id| format!("[effects.{id}]")).collect();
        return Some(format!(
            "{name}: behind {} {} of {} readings tell no more than within what the signal was: their errors, and the noise beside them, are \
             what noise has to have done for that on average",
            effects.join(" and "),
            censored.count(),
            bench.len(),
        ));
    }
    let found = bench.contradiction.as_ref()?;
    let of_them = match found.count {
        1 => "one reading is".to_owned(),
        count => format!("{count} readings are"),
    };
    Some(format!(
        "{name}: {of_them} not what [effects.{}] lets through, the first {} {unit} at {} s: it is not as stated, or noise is added behind it",
        found.effect,
        short(found.first),
        short(bench.t_s[found.at]),
    ))
}

/// What the times of the readings, and the reference between its rows, were found to be beside the effects. `course`: the error with
/// straight lines and with the course that was taken, if it is another.
pub(super) fn times_found(
    bench: &Workbench<'_>,
    fit: &Fit,
    course: Option<[f64; 2]>,
) -> Vec<String> {
    let (name, unit) = (&bench.problem.name, &bench.problem.unit);
    let later_s = fit.model.nuisance.alignment_s;
    let size_s = short(later_s.abs());
    let aligned = (later_s.abs() > TOLD_STEP * bench.scale.reading_step_s).then(|| match bench.problem.base {
        Base::Sensor(_) => format!(
            "{name}: readings stand for a moment {size_s} s {} than their rows, less than a row apart and so no effect by itself; \
             a delay of that size beside what is named would look the same",
            if later_s > 0.0 { "earlier" } else { "later" },
        ),
        Base::Battery(_) => format!(
            "{name}: voltages were read {size_s} s {} the currents of their rows, which is the tester's and no effect; the errors after \
             are with that",
            if later_s > 0.0 { "before" } else { "after" },
        ),
    });
    let course = course.and_then(|[straight, other]| {
        let (goes, instead) = goes(bench.problem, &fit.model.nuisance)?;
        Some(format!(
            "{name}: {goes} (error {} {unit}, {instead} {} {unit})",
            short(other),
            short(straight)
        ))
    });
    aligned.into_iter().chain(course).collect()
}

/// How the reference of a problem goes where its rows do not say, and what it would do otherwise.
fn goes(problem: &Problem, nuisance: &Nuisance) -> Option<(String, &'static str)> {
    const STRAIGHT: &str = "with straight lines";
    let holds = problem.drive.holds;
    if matches!(problem.base, Base::Sensor(_)) {
        let goes = match holds {
            None => "between its rows the reference is taken to go smoothly",
            Some(Holds::SinceLastRow) => {
                "each row's reference is taken to have stood there since the row before"
            }
            Some(Holds::UntilNextRow) => {
                "each row's reference is taken to stay there until the next row"
            }
        };
        return Some((goes.to_owned(), STRAIGHT));
    }
    let instead = if holds.is_some() {
        STRAIGHT
    } else {
        "after a rest"
    };
    let holds = holds.map(|holds| format!("each row's current {}", holds.in_words()));
    let before = (nuisance.before_a != 0.0).then(|| {
        format!(
            "the recording begins under load, or not long after, and what the battery remembers then is as after {} A for long",
            short(nuisance.before_a)
        )
    });
    let both: Vec<String> = holds.into_iter().chain(before).collect();
    (!both.is_empty()).then(|| (both.join("; "), instead))
}

/// What error of a battery's recorded current would look the same as a named effect, and whether that is likelier than the effect.
pub(super) fn current_off(bench: &Workbench<'_>, selection: &Selection) -> Vec<(String, bool)> {
    let members = &selection.fit.model.members;
    let named = || {
        let named = selection.named.iter();
        named.map(|named| &members[named.index])
    };
    let off = named().filter_map(|Member { effect, values }| {
        let id = effect.card().id;
        let error = effect
            .in_the_current(values, &bench.scale)
            .map(|error| match error {
                CurrentError::Offset(by_a) => format!(
                    "{} A too {} all along",
                    short(by_a.abs()),
                    if by_a > 0.0 { "high" } else { "low" }
                ),
                CurrentError::Gain(factor) => format!("{factor:.4} times the true one"),
            });
        match (effect.unlikely(values), error) {
            (Some(why), error) => {
                // Of an effect that goes by the sign of the current no single error does the same.
                let error = error.unwrap_or_else(|| "off by a zero or a gain".to_owned());
                Some((
                    format!("{why}: likelier than {id} is a recorded current that is {error}"),
                    true,
                ))
            }
            (None, Some(error)) => Some((
                format!(
                    "the recorded current is taken to be right: one that is {error} would hardly look different from {id}"
                ),
                false,
            )),
            (None, None) => None,
        }
    });
    let is_zero = |Member { effect, values }: &Member| {
        matches!(
            effect.in_the_current(values, &bench.scale),
            Some(CurrentError::Offset(_))
        )
    };
    let hint = named().any(is_zero).then(|| zero_hint(bench.problem));
    off.chain(hint.flatten().map(|hint| (hint, false)))
        .collect()
}

/// What a recorded current says of its own zero, and how to state it, where the model file takes it to be exact.
fn zero_hint(problem: &Problem) -> Option<String> {
    let Base::Battery(base) = &problem.base else {
        return None;
    };
    let rests = problem.drive.at_rest().map(|(reads_a, time_s)| {
        format!(
            "the recorded current, where it rests ({} h in all), reads {} A in the mean; ",
            short(time_s / 3600.0),
            short(reads_a)
        )
    });
    (base.current_zero_sigma_a == 0.0).then(|| {
        rests.unwrap_or_default()
            + "a zero that it may have is stated by current_zero_a and current_zero_uncertainty_a"
    })
}

/// What is written into the extended model file.
pub(super) fn fitted(problem: &Problem, fit: &Fit) -> FittedModel {
    let nuisance = Nuisance {
        resistance: resistance_told(problem, &fit.model.nuisance),
        ..fit.model.nuisance.clone()
    };
    let values = |member: &Member| {
        let names = member
            .effect
            .card()
            .parameters
            .iter()
            .map(|parameter| parameter.name.to_owned());
        names.zip(member.values.iter().copied()).collect()
    };
    let of_battery = matches!(problem.base, Base::Battery(_));
    FittedModel {
        signal: problem.name.clone(),
        effects: fit
            .model
            .members
            .iter()
            .map(|member| (member.id().to_owned(), values(member)))
            .collect(),
        nuisance,
        of_battery,
        smooth_reference: matches!(&problem.base, Base::Sensor(base) if base.smooth_reference),
        held_reference: problem.drive.holds.filter(|_| !of_battery),
        current_holds: problem.drive.holds.filter(|_| of_battery),
    }
}

/// Three digits; with a power of ten where there would be many zeros. A time since 1970 stays what it is.
pub(super) fn short(value: f64) -> String {
    if value == 0.0 || !value.is_finite() {
        return format!("{value}");
    }
    let exponent = value.abs().log10().floor() as i32;
    if !(-7..12).contains(&exponent) {
        return format!("{value:.2e}");
    }
    let digits = 2 - exponent;
    format!("{value:.*}", digits.clamp(0, 12) as usize)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::problem::BatteryBase;

    /// A cell of 20 mΩ with readings to 1 mV, and a current.
    fn battery(current_a: f64) -> Problem {
        let t_s: Vec<f64> = (0..100).map(f64::from).collect();
        let rows = t_s.len();
        let mut problem = Problem::pair(t_s, vec![current_a; rows], vec![3.7; rows], 0.001);
        problem.view = View::Voltage;
        problem.name = "v_cell_v".into();
        problem.base = Base::Battery(BatteryBase {
            resistance_ohm: 0.02,
            initial_soc_sigma: vec![0.01],
            resistance_sigma: 0.1,
            ..BatteryBase::default()
        });
        problem
    }

    #[test]
    fn a_resistance_is_not_told_by_a_current_that_does_not_show_it() {
        let nuisance = Nuisance {
            resistance: -0.0955,
            soc_shift: vec![0.0],
            ..Nuisance::default()
        };
        let driven = base_found(&battery(2.0), &nuisance).unwrap();
        assert!(driven.contains("resistance 9.55 % lower"), "{driven}");
        // 2 mA make 4 µV of it.
        assert_eq!(base_found(&battery(0.002), &nuisance), None);
    }

    #[test]
    fn numbers_are_as_long_as_they_tell() {
        for (value, said) in [
            (0.0502, "0.0502"),
            (12.345, "12.3"),
            (1_700_000_904.3, "1700000904"),
            (3.45e-7, "0.000000345"),
            (1.2e-13, "1.20e-13"),
            (2.027e21, "2.03e21"),
        ] {
            assert_eq!(short(value), said);
        }
    }

    #[test]
    fn what_a_battery_was_off_by_is_told_if_it_matters() {
        let found = |resistance, soc_shift| {
            let nuisance = Nuisance {
                resistance,
                soc_shift: vec![soc_shift],
                ..Nuisance::default()
            };
            base_found(&battery(2.0), &nuisance)
        };
        assert_eq!(found(4e-4, -4e-4), None);
        let said = found(0.273, -0.0071).unwrap();
        assert!(said.contains("resistance 27.3 % higher and"), "{said}");
        assert!(
            said.contains("start 0.710 points of per cent lower"),
            "{said}"
        );
        assert!(
            said.contains("within what the model file leaves open"),
            "{said}"
        );
        // Four times what is stated is the end.
        for said in [found(0.273, -0.04), found(0.4, 0.0)] {
            let said = said.unwrap();
            assert!(said.contains("as far as the model file allows"), "{said}");
            assert!(!said.contains("than stated fits"), "{said}");
        }
    }
}
