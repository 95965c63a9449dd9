//! The effect, or the two that hide each other, with which a model grows.

use std::sync::Arc;

use rayon::prelude::*;

use super::MOST_EFFECTS;
use super::losses::{losses, share};
use super::obstacle::{FLOOR, obstacle, only_aligns};
use crate::explain::fit::{Fit, fit};
use crate::explain::screen::{DRAWS, Entry, Screening, replaced, screen};
use crate::explain::workbench::{Member, Model, Workbench};
use crate::report::format::precise_percent;

/// Candidates that are fitted after screening.
pub(super) const FITTED: usize = 8;
/// The best of them that are asked whether they pass.
const TRIED: usize = 4;
/// First effects of pairs, and second ones of each.
const FIRSTS: usize = 5;
/// Pairs that are looked at, best first.
const PAIRS: usize = 6;
/// Pairs that hide each other that are looked at besides.
const HIDDEN_PAIRS: usize = 4;
/// Starts of each that are fitted.
pub(super) const STARTS: usize = 2;
/// Candidates that are fitted besides, because they take most of the error with its outliers.
const RARE: usize = 2;
/// A pair is fitted if its start takes this share of what a pair has to take. Of 203 that took enough in the end, all but three
/// began so (counted once, on 149 cases of the campaign's `--seeds 0`).
const STARTED: f64 = 0.5;
/// Share of the held-out error from which on a single effect is clear by itself.
const CLEAR: f64 = 0.97;
/// Share of what the best single effect leaves that a pair has to take to be preferred.
const MUCH: f64 = 0.3;
/// Share of what the usual starts leave that another one has to take to be preferred.
const HALF: f64 = 0.5;

/// The effect, or the two, with which a model grows, and the limit that the placebos set. Forms that are as free as to imitate a few
/// others at once are asked where plainer ones do not do.
pub(super) fn addition(
    bench: &Workbench<'_>,
    now: &Fit,
    screening: &Screening,
    decisions: &mut Vec<String>,
    refused: &mut Vec<String>,
) -> Option<(Fit, f64)> {
    let (free, plain): (Vec<&Entry>, Vec<&Entry>) = screening
        .entries
        .iter()
        .map(Arc::as_ref)
        .partition(|entry| entry.member.effect.remembers());
    let all: Vec<&Entry> = screening.entries.iter().map(Arc::as_ref).collect();
    let mut grown =
        |entries: &[&Entry]| added_of(bench, now, (entries, screening), decisions, refused);
    grown(&plain).or_else(|| (!free.is_empty()).then(|| grown(&all)).flatten())
}

/// The same of some candidates, with the limit.
fn added_of(
    bench: &Workbench<'_>,
    now: &Fit,
    (entries, screening): (&[&Entry], &Screening),
    decisions: &mut Vec<String>,
    refused: &mut Vec<String>,
) -> Option<(Fit, f64)> {
    let p99 = screening.placebo_p99;
    let (mut said, mut said_besides) = (Vec::new(), Vec::new());
    let usual = promising(bench, now, entries, FITTED, STARTS);
    let single = step(bench, now, usual, p99, &mut said, refused);
    // Where two effects hide each other, the best single one can be the wrong one: pairs are tried at the beginning, and
    // whenever nothing passes alone.
    let double = if now.model.members.is_empty() || single.is_none() {
        let single = single.as_ref().map(|(fit, _)| fit);
        pair(bench, now, (entries, screening), single, &mut said, refused)
    } else {
        None
    };
    let found = double.or(single);
    let others = besides(bench, now, entries);
    let other = step(bench, now, others, p99, &mut said_besides, refused);
    let is_better = match (&found, &other) {
        (Some((found, _)), Some((other, _))) => {
            // One that does as well as two is better, and so is the same effect that does better from another start or in
            // another form.
            let fewer = other.model.members.len() < found.model.members.len();
            let last = |fit: &Fit| fit.model.members.last().map(Member::id);
            let same = last(found) == last(other);
            share(bench, found, other) > if fewer || same { 0.0 } else { HALF }
        }
        _ => found.is_none(),
    };
    if is_better {
        decisions.append(&mut said_besides);
        other
    } else {
        decisions.append(&mut said);
        found
    }
}

/// Models with the most promising entries added.
fn promising(
    bench: &Workbench<'_>,
    now: &Fit,
    entries: &[&Entry],
    most: usize,
    starts: usize,
) -> Vec<Model> {
    let mut effects: Vec<Vec<&Entry>> = Vec::new();
    for entry in entries
        .iter()
        .copied()
        .filter(|entry| !endless(bench, &entry.member))
    {
        let form = entry.member.form();
        let known = effects.iter().position(|of| of[0].member.form() == form);
        match known {
            Some(at) => effects[at].push(entry),
            None if effects.len() < most => effects.push(vec![entry]),
            None => (),
        }
    }
    let mut chosen: Vec<&Entry> = Vec::new();
    for mut of in effects {
        // Where the size is not free, the start itself says how good it is: one more by that.
        let nearest = of.iter().min_by(|a, b| a.loss.total_cmp(&b.loss)).copied();
        let nearest = nearest.filter(|_| of[0].fixed());
        of.truncate(starts);
        of.extend(nearest.filter(|nearest| !of.iter().any(|entry| std::ptr::eq(*entry, *nearest))));
        chosen.extend(of);
    }
    chosen
        .into_iter()
        .map(|entry| added(&now.model, entry.member.clone()))
        .collect()
}

/// Whether a value is so far beyond what the recording tells that the effect does what a simpler one does.
fn endless(bench: &Workbench<'_>, member: &Member) -> bool {
    let mut values = member.values.iter().enumerate();
    values.any(|(p, value)| *value >= member.effect.endless(p, &bench.scale))
}

/// The model with an effect, in the place of one of the same id.
pub fn added(model: &Model, member: Member) -> Model {
    replaced(model, member.effect).with(member)
}

/// Starts besides: the best of each effect with the sizes that its signature has, and what takes most of the error with its
/// outliers, for what acts in few readings.
fn besides(bench: &Workbench<'_>, now: &Fit, entries: &[&Entry]) -> Vec<Model> {
    let mut forms: Vec<(&str, usize)> = Vec::new();
    let mut members: Vec<Member> = Vec::new();
    let told = entries
        .iter()
        .copied()
        .filter(|entry| !endless(bench, &entry.member));
    for entry in told.clone() {
        let form = entry.member.form();
        if !forms.contains(&form) && forms.len() < FITTED {
            forms.push(form);
            members.extend(entry.sized(&bench.scale));
        }
    }
    let mut rare: Vec<&Entry> = told.filter(|entry| entry.raw_gain > 0.0).collect();
    rare.sort_by(|a, b| b.raw_gain.total_cmp(&a.raw_gain));
    members.extend(rare.iter().take(RARE).map(|entry| entry.member.clone()));
    members
        .into_iter()
        .map(|member| added(&now.model, member))
        .collect()
}

/// Fits models side by side.
pub(super) fn fits(bench: &Workbench<'_>, models: Vec<Model>) -> Vec<Fit> {
    models
        .into_par_iter()
        .map(|model| fit(bench, &model, None))
        .collect()
}

/// Fits with their held-out losses, the lowest first, and the spread that they are in: the least of all.
fn ranked(bench: &Workbench<'_>, now: &Fit, models: Vec<Model>) -> (Vec<(Fit, f64)>, f64) {
    let fits = fits(bench, models);
    let sigma = fits.iter().map(|fit| fit.sigma).fold(now.sigma, f64::min);
    let mut ranked: Vec<(Fit, f64)> = fits
        .into_iter()
        .map(|fit| {
            let loss = losses(bench, &fit, sigma).1;
            (fit, loss)
        })
        .collect();
    ranked.sort_by(|a, b| a.1.total_cmp(&b.1));
    (ranked, sigma)
}

/// The best single addition of some, if it is accepted.
fn step(
    bench: &Workbench<'_>,
    now: &Fit,
    models: Vec<Model>,
    placebo_p99: f64,
    decisions: &mut Vec<String>,
    refused: &mut Vec<String>,
) -> Option<(Fit, f64)> {
    let (ranked, sigma) = ranked(bench, now, models);
    let (_, before) = losses(bench, now, sigma);
    let candidates = ranked
        .into_iter()
        .take_while(|(_, loss)| *loss < before)
        .map(|(fit, _)| fit)
        .filter(|fit| !only_aligns(bench, now, fit, fit.model.members.len() - 1));
    let mut tried: Vec<&str> = Vec::new();
    for better in candidates {
        let index = better.model.members.len() - 1;
        let id = better.model.members[index].id();
        if !tried.contains(&id) {
            tried.push(id);
            if tried.len() > TRIED {
                break;
            }
        }
        let gain = share(bench, now, &better);
        if gain <= 0.0 {
            continue;
        }
        if gain <= placebo_p99 {
            note(
                refused,
                format!(
                    "{id}: takes {} of the held-out error, placebos up to {}",
                    precise_percent(gain),
                    precise_percent(placebo_p99)
                ),
            );
            continue;
        }
        match obstacle(bench, now, &better, index, gain) {
            Some(why) => note(refused, format!("{id}: {why}")),
            None => {
                decisions.push(format!(
                    "{id} added: takes {} of the held-out error; the best of {} placebos of the whole library takes {} (99th percentile).",
                    precise_percent(gain),
                    DRAWS,
                    precise_percent(placebo_p99)
                ));
                return Some((better, placebo_p99));
            }
        }
    }
    None
}

fn note(list: &mut Vec<String>, text: String) {
    if !list.contains(&text) {
        list.push(text);
    }
}

/// Two effects that hide each other: neither passes alone, both together do.
fn pair(
    bench: &Workbench<'_>,
    now: &Fit,
    (entries, screening): (&[&Entry], &Screening),
    single: Option<&Fit>,
    decisions: &mut Vec<String>,
    refused: &mut Vec<String>,
) -> Option<(Fit, f64)> {
    // What one effect explains so well needs no second one to be found.
    if single.is_some_and(|single| share(bench, now, single) > CLEAR) {
        return None;
    }
    if now.model.members.len() + 2 > MOST_EFFECTS {
        return None;
    }
    let placebo_p99 = screening.placebo_p99;
    let least = pairs_gain(placebo_p99);
    // Free forms are among the second ones where they are among the first.
    let free = entries.iter().any(|entry| entry.member.effect.remembers());
    let may_follow = |entry: &Entry| free || !entry.member.effect.remembers();
    // A masked effect shows once the other is fitted: from each of the best single ones one goes a step further.
    let firsts = promising(bench, now, entries, FIRSTS, 1);
    let mut models: Vec<Model> = fits(bench, firsts)
        .par_iter()
        .flat_map_iter(|first| {
            let taken = share(bench, now, first).max(0.0);
            let seconds = screen(bench, first, 0, 0).entries;
            let begun = |entry: &&Entry| {
                taken + entry.gain * (1.0 - taken) > STARTED * least && may_follow(entry)
            };
            let seconds: Vec<&Entry> = seconds.iter().map(Arc::as_ref).filter(begun).collect();
            promising(bench, first, &seconds, FIRSTS, 1)
        })
        // One more branch of the first is no second effect.
        .filter(|model| model.members.len() == now.model.members.len() + 2)
        .collect();
    // Of two that hide each other well, neither is among the best single ones.
    let told: Vec<&Entry> = (entries.iter().copied())
        .filter(|entry| !endless(bench, &entry.member))
        .collect();
    let hidden = screening.hidden(&told, least, HIDDEN_PAIRS);
    models.extend(hidden.into_iter().filter_map(|pair| {
        let [first, second] = pair.map(|entry| entry.member.clone());
        let model = added(&added(&now.model, first), second);
        (model.members.len() == now.model.members.len() + 2).then_some(model)
    }));
    let (ranked, _) = ranked(bench, now, models);
    let best = ranked
        .into_iter()
        .take(PAIRS)
        .map(|(fit, _)| fit)
        .find(|best| match unfit(bench, now, best, placebo_p99, single) {
            Some(why) => {
                let ids = best.model.ids();
                let count = ids.len();
                note(
                    refused,
                    format!("{} with {}: {why}", ids[count - 2], ids[count - 1]),
                );
                false
            }
            None => true,
        })?;
    let ids = best.model.ids();
    let count = ids.len();
    decisions.push(format!(
        "{} and {} added together: both take {} of the held-out error, more than any one alone and than placebos.",
        ids[count - 2],
        ids[count - 1],
        precise_percent(share(bench, now, &best))
    ));
    Some((best, placebo_p99))
}

/// Share of the held-out error that two effects have to take together: each may gain what a placebo gains.
fn pairs_gain(p99: f64) -> f64 {
    (1.0 - (1.0 - p99.min(1.0)).powi(2)).max(FLOOR)
}

/// Why a pair, the last two effects of a fit, is not accepted.
fn unfit(
    bench: &Workbench<'_>,
    now: &Fit,
    best: &Fit,
    p99: f64,
    single: Option<&Fit>,
) -> Option<String> {
    let count = best.model.members.len();
    let gain = share(bench, now, best);
    let least = pairs_gain(p99);
    if gain <= least {
        return Some(format!(
            "takes {} of the held-out error; two placebos, or the practical floor: {}",
            precise_percent(gain),
            precise_percent(least)
        ));
    }
    if single.is_some_and(|single| share(bench, single, best) < MUCH) {
        return Some("not much better than one effect alone".into());
    }
    // Each of the two has to be missed.
    (count - 2..count).find_map(|index| {
        let alone = fit(bench, &best.model.without(index), None);
        let missed = share(bench, &alone, best);
        let why = if missed <= p99 {
            Some(format!(
                "takes {}, placebos up to {}",
                precise_percent(missed),
                precise_percent(p99)
            ))
        } else if only_aligns(bench, &alone, best, index) {
            Some("only aligns the samples".into())
        } else {
            obstacle(bench, &alone, best, index, missed)
        };
        why.map(|why| format!("{} {why}", best.model.members[index].id()))
    })
}
