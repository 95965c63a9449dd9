//! Which effects would stand in the place of another: better, as well, or plainer.

use rayon::prelude::*;

use super::Named;
use super::grow::{FITTED, STARTS, added, fits};
use super::losses::{beaten, losses, share};
use super::obstacle::{apart, at_end, beside, obstacle, only_aligns, small};
use crate::effects::{Effect, find};
use crate::explain::fit::{Fit, fit, other_minimum};
use crate::explain::quieter::only_quietens;
use crate::explain::robust::loss;
use crate::explain::screen::screen;
use crate::explain::workbench::{Member, Model, Workbench};
use crate::problem::Base;
use crate::report::format::precise_percent;

/// A rival is fitted if its start takes this share of what the effect takes whose place it would have. Of 830 that took half as
/// much in the end, all but eight began so (counted once, on 149 cases of the campaign's `--seeds 0`).
const RIVALS: f64 = 0.1;
/// An effect would do as well as another if it takes at least this share of what that one takes.
const EQUAL: f64 = 0.5;

/// Share of the error by which what works between the rows may be better than another for noise of the reference alone, that it evens
/// out more of: a reference has less than a third of the reading's noise.
const QUIETER: f64 = 0.1;
/// What evens out more has at most this share of the other's bends.
const SMOOTHER: f64 = 0.9;

/// Effects that may stand in an effect's place: those that it is said to look like, those that are said to look like it, and
/// the best of a screening of what it explains.
fn rivals(
    bench: &Workbench<'_>,
    without: &Fit,
    model: &Model,
    (id, taken): (&str, f64),
) -> Vec<Member> {
    let card = find(id).map(|effect| effect.card());
    let alike = |effect: &&'static dyn Effect| {
        let other = effect.card();
        card.is_some_and(|card| card.looks_like.contains(&other.id))
            || other.looks_like.contains(&id)
    };
    let screening = screen(bench, without, 0, 0);
    let mut members: Vec<Member> = Vec::new();
    let mut count: Vec<(&'static str, usize)> = Vec::new();
    for (rank, entry) in screening.entries.iter().enumerate() {
        let other = entry.member.effect;
        // What may not join the others is not screened.
        if entry.gain <= RIVALS * taken || other.card().id == id {
            continue;
        }
        let known = count
            .iter()
            .position(|(known, _)| *known == other.card().id);
        let tried = known.map_or(0, |at| count[at].1);
        let promising = rank < 3 * FITTED && count.len() < 5;
        if tried >= STARTS || !(alike(&other) || promising || known.is_some()) {
            continue;
        }
        match known {
            Some(at) => count[at].1 += 1,
            None => count.push((other.card().id, 1)),
        }
        members.push(entry.member.clone());
    }
    // Where few rows show the effect (an edge or two), the gain of a start says little of what its fit will be worth: of what looks
    // like it, the starts that come nearest to the readings as they are, too.
    for effect in bench.library.iter().copied().filter(alike) {
        if !joins(model, effect) {
            continue;
        }
        members.extend(
            nearest(bench, without, effect, screening.starts(effect))
                .into_iter()
                .filter(|member| {
                    members.iter().all(|known| {
                        known.effect.card().id != member.effect.card().id
                            || known.values != member.values
                    })
                })
                .collect::<Vec<_>>(),
        );
    }
    members
}

/// The starts of an effect that come nearest to the readings, beside the effects of a fit; its starts may be known.
fn nearest(
    bench: &Workbench<'_>,
    beside: &Fit,
    effect: &'static dyn Effect,
    known: Option<&[Vec<f64>]>,
) -> Vec<Member> {
    let starts = known.map_or_else(
        || {
            let as_read = bench.as_read(&beside.predicted);
            effect.starts(&bench.scale, &bench.clues(&as_read))
        },
        <[_]>::to_vec,
    );
    let mut starts: Vec<(f64, Member)> = starts
        .into_par_iter()
        .map(|values| {
            let member = Member { effect, values };
            let there = bench.run(&added(&beside.model, member.clone()));
            (loss(&bench.residual(&there), beside.sigma), member)
        })
        .collect();
    starts.sort_by(|a, b| a.0.total_cmp(&b.0));
    starts
        .into_iter()
        .take(STARTS)
        .map(|(_, member)| member)
        .collect()
}

/// Models with two effects in the place of one that may stand for them; `without` has none of the three. Over currents that hardly
/// move any curve may stand for a straight line, a factor with a constant.
fn of_two(bench: &Workbench<'_>, without: &Fit, one: &'static dyn Effect) -> Vec<Model> {
    // What a battery's voltage does has a memory: no line stands for it.
    let bends = matches!(bench.problem.base, Base::Sensor(_))
        && one.idealised() > 0.0
        && !one.card().stage.is_between_rows();
    let plainest = bench
        .library
        .iter()
        .filter(|effect| bends && effect.is_plainest());
    let plainest: Vec<&str> = plainest.map(|effect| effect.card().id).collect();
    let lines = plainest
        .iter()
        .enumerate()
        .flat_map(|(place, first)| plainest[place + 1..].iter().map(|second| [*first, *second]));
    let begun = |beside: &Fit, id: &str| -> Option<Model> {
        let mut library = bench.library.iter().copied();
        let effect = library.find(|effect| effect.card().id == id && !beside.model.has(id))?;
        let start = nearest(bench, beside, effect, None).into_iter().next()?;
        Some(beside.model.with(start))
    };
    let pairs = one.stands_for().iter().copied().chain(lines);
    pairs
        .filter_map(|[first, second]| {
            let first = fit(bench, &begun(without, first)?, None);
            begun(&first, second)
        })
        .collect()
}

/// Whether an effect can stand beside those of a model: it is not there, or it has more branches than what is there and takes that
/// one's place as well.
pub fn joins(model: &Model, effect: &'static dyn Effect) -> bool {
    let card = effect.card();
    let same = model.members.iter().find(|member| member.id() == card.id);
    same.is_none_or(|member| card.parameters.len() > member.values.len())
}

/// Fits every rival in the place of every effect, and what it may stand for.
pub(super) fn swapped(bench: &Workbench<'_>, now: &Fit) -> Vec<(usize, Fit)> {
    let (places, models): (Vec<usize>, Vec<Model>) = (0..now.model.members.len())
        .flat_map(|index| {
            let id = now.model.members[index].id();
            let without = fit(bench, &now.model.without(index), None);
            let taken = share(bench, &without, now);
            rivals(bench, &without, &now.model, (id, taken))
                .into_iter()
                .map(|rival| added(&without.model, rival))
                .chain(of_two(bench, &without, now.model.members[index].effect))
                // An alignment that is free can take over what a rival explains, and leave it nothing to be named for.
                .flat_map(|model| {
                    let unaligned = bench.aligns(&model).then(|| Model {
                        unaligned: true,
                        ..model.clone()
                    });
                    [Some(model), unaligned]
                })
                .flatten()
                .map(|model| (index, model))
                .collect::<Vec<_>>()
        })
        .unzip();
    places.into_iter().zip(fits(bench, models)).collect()
}

pub(super) fn swap(
    bench: &Workbench<'_>,
    now: &Fit,
    others: &[(usize, Fit)],
    decisions: &mut Vec<String>,
) -> Option<(usize, Fit)> {
    let sigma = others
        .iter()
        .map(|(_, fit)| fit.sigma)
        .fold(now.sigma, f64::min);
    let (_, here) = losses(bench, now, sigma);
    let (index, best, loss) = others
        .iter()
        // What could not be named is in nobody's way.
        .filter(|(_, fit)| {
            let last = fit.model.members.last();
            last.is_some_and(|member| at_end(bench, member).is_none())
        })
        .map(|(index, fit)| (*index, fit, losses(bench, fit, sigma).1))
        .min_by(|a, b| a.2.total_cmp(&b.2))?;
    let last = best.model.members.len() - 1;
    if loss >= here * (1.0 - 1e-3) {
        return None;
    }
    let without = fit(bench, &best.model.without(last), None);
    if only_aligns(bench, &without, best, last) || obstacle(bench, now, best, last, 1.0).is_some() {
        return None;
    }
    decisions.push(format!(
        "{} replaced by {}: the held-out error is lower by {}.",
        now.model.members[index].id(),
        best.model.ids()[new(now, best)..].join(" and "),
        precise_percent((here - loss) / here)
    ));
    Some((index, best.clone()))
}

/// The first of the effects that a model has in the place of one of another.
pub(super) fn new(before: &Fit, after: &Fit) -> usize {
    let kept = before.model.members.len() - 1;
    kept.min(after.model.members.len() - 1)
}

/// The model with an effect, at the index that comes with it, replaced by one of its equals whose equation is exact (a constant, a
/// factor, a time), if the effect's own is not.
pub(super) fn plainer(
    bench: &Workbench<'_>,
    now: &Fit,
    others: &[(usize, Fit)],
    named: &[Named],
) -> Option<(usize, Fit)> {
    let exact = |member: &Member| member.effect.idealised() == 0.0;
    named
        .iter()
        .filter(|one| !exact(&now.model.members[one.index]))
        .find_map(|one| {
            others
                .iter()
                .filter(|(index, _)| *index == one.index)
                .map(|(_, fit)| fit)
                .filter(|fit| {
                    fit.model.members.last().is_some_and(|member| {
                        exact(member)
                            && one.equivalent.contains(&member.id())
                            && at_end(bench, member).is_none()
                    })
                })
                // As was done with what it is compared with.
                .map(|fit| other_minimum(bench, fit.clone()))
                .filter(|fit| !beaten(bench, fit, now))
                // In one spread for all: in its own, a bad fit's residual is a small one.
                .min_by(|a, b| {
                    let sigma = a.sigma.min(b.sigma);
                    loss(&a.residual, sigma).total_cmp(&loss(&b.residual, sigma))
                })
                .map(|fit| (one.index, fit))
        })
}

/// What speaks for each effect, and what would have done as well.
pub(super) fn name(
    bench: &Workbench<'_>,
    now: &Fit,
    others: &[(usize, Fit)],
    placebo_p99: &[(&'static str, f64)],
) -> Vec<Named> {
    (0..now.model.members.len())
        .map(|index| {
            let id = now.model.members[index].id();
            let without = fit(bench, &now.model.without(index), None);
            let taken = share(bench, &without, now);
            // Where few rows decide, the difference of two models is never certain: who takes much less is no equal.
            let least = (EQUAL * taken).max(super::p99_of(placebo_p99, id));
            let mut equivalent: Vec<&'static str> = others
                .iter()
                .filter(|(at, _)| *at == index)
                .filter(|(_, other)| !begins_as_it_likes(other))
                // Two for one are no equal of it.
                .filter(|(_, other)| other.model.members.len() <= now.model.members.len())
                .filter(|(_, other)| {
                    let last = other.model.members.len() - 1;
                    share(bench, &without, other) >= least
                        && does_as_well(bench, other, now, index)
                        // At the end of what is physics it cannot be named, and speaks against another's being certain.
                        && small(bench, &without, other, last, 1.0).is_none()
                })
                .filter_map(|(_, other)| other.model.members.last().map(Member::id))
                .collect();
            let member = &now.model.members[index];
            let held_s = bench.problem.observed.held_s;
            equivalent.extend(
                member
                    .effect
                    .when_held(&member.values, held_s)
                    .filter(|_| held_s > 0.0),
            );
            equivalent.sort_unstable();
            equivalent.dedup();
            Named {
                index,
                held_out_gain: taken,
                placebo_p99: super::p99_of(placebo_p99, id),
                by_place: None,
                equivalent,
            }
        })
        .collect()
}

/// Whether what the recording began with makes the last effect what is needed: heat that is there from the first row is a gain, to which
/// it is no equal. (A memory is looked for because of what it began with.)
fn begins_as_it_likes(fit: &Fit) -> bool {
    let last = fit.model.members.last();
    last.is_some_and(|member| member.effect.beginning().is_some() && !member.effect.remembers())
}

/// Whether a model, whose last effect has the place of one of the chosen model, does as well as that one: what the other effects'
/// equations, and uneven stamps, may be off by does not decide between two, nor does what only evens out noise of the reference.
pub fn does_as_well(bench: &Workbench<'_>, other: &Fit, chosen: &Fit, index: usize) -> bool {
    let between = |member: &Member| member.effect.card().stage.is_between_rows();
    let last = other.model.members.last();
    let stamped = between(&chosen.model.members[index]) && last.is_some_and(between);
    let may_be_off = beside(bench, chosen, index) + if stamped { bench.stamped() } else { 0.0 };
    apart(bench, &chosen.predicted, &other.predicted) < may_be_off
        || !beaten(bench, other, chosen)
        || (stamped
            && roughness(&chosen.predicted) < SMOOTHER * roughness(&other.predicted)
            && share(bench, other, chosen) < QUIETER
            && only_quietens(bench, other, chosen))
}

/// Energy of the second differences: what evens out noise has less.
fn roughness(series: &[f64]) -> f64 {
    let bends = series.windows(3).map(|s| s[0] - 2.0 * s[1] + s[2]);
    bends.map(|bend| bend * bend).sum()
}
