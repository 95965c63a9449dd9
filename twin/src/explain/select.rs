//! Which effects are named: forward with refit, swap, backward, masked pairs; and which others would have done as well.

use rayon::prelude::*;

use super::fit::{Fit, fit, polish};
use super::held_out::held_out;
use super::normal::dot;
use super::robust::{huber, loss};
use super::screen::{DRAWS, Entry, Screening, replaced, screen};
use super::shape::without_memory;
use super::slope::change;
use super::told::short;
use super::workbench::{Member, Model, Workbench};
use crate::effects::{Effect, Search, find};

/// Effects in one model at most.
const MOST_EFFECTS: usize = 6;
/// Candidates that are fitted after screening.
const FITTED: usize = 8;
/// The best of them that are asked whether they pass.
const TRIED: usize = 4;
/// First effects of pairs, and second ones of each.
const FIRSTS: usize = 5;
/// Pairs that are looked at, best first.
const PAIRS: usize = 6;
/// Starts of each that are fitted.
const STARTS: usize = 2;
/// Candidates that are fitted besides, because they take most of the error with its outliers.
const RARE: usize = 2;
/// A pair is fitted if its start takes this share of what a pair has to take. Of 203 that took enough in the end, all but three
/// began so (counted once, on 149 cases of the campaign's `--seeds 0`).
const STARTED: f64 = 0.5;
/// A rival is fitted if its start takes this share of what the effect takes whose place it would have. Of 830 that took half as
/// much in the end, all but eight began so (the same cases).
const RIVALS: f64 = 0.1;
/// A named effect takes away at least this share of the held-out squared error (2 % of the held-out rms), overall or where it
/// acts.
const FLOOR: f64 = 0.04;
/// A smaller one takes away at least this share where it acts.
const PLACE: f64 = 0.12;
/// Standard deviations that a gain beside a threshold has to be away from chance, reading by reading.
const PAIRED: f64 = 3.0;
/// Standard deviations of the stated noise that an effect has to be away from nothing: one in a thousand recordings has an effect
/// of some thirty by chance that is 4.2 away.
pub const CERTAIN: f64 = 4.2;
/// Rows where an effect changes the reading by at least this share of its largest change are where it acts.
const ACTS: f64 = 0.2;
/// Share of the held-out error from which on a single effect is clear by itself.
const CLEAR: f64 = 0.97;
/// Share of what the best single effect leaves that a pair has to take to be preferred.
const MUCH: f64 = 0.3;
/// Share of what the usual starts leave that another one has to take to be preferred.
const HALF: f64 = 0.5;
/// So many others that would do as well make an effect nameless if it is small.
const VAGUE: usize = 3;
/// Share of the held-out error below which an effect is small.
const SMALL: f64 = 0.2;
/// Stretches over which two models' losses are compared.
const STRETCHES: usize = 200;
/// A model is beaten if another's held-out loss is lower by this many standard errors of their paired difference, …
const BEATEN: f64 = 2.0;
/// … and by this at least: the logarithm of the odds at so many standard deviations. A difference that is the same in every stretch
/// has next to no standard error.
const ODDS: f64 = 0.5 * BEATEN * BEATEN;
/// The best of many choices counts from where noise would reach once in so many recordings.
const CHANCE: f64 = 1e-3;
/// An effect would do as well as another if it takes at least this share of what that one takes.
const EQUAL: f64 = 0.5;
/// A simulation that is rounded may be off by this many times the variance of rounding more than one that is not: by once where
/// noise is as loud as a step, and chance.
const DITHERED: f64 = 1.1;
/// An error that is larger by less than this factor is not.
const NO_LARGER: f64 = 1.01;
/// Rounds of adding, doing without and exchanging.
const ROUNDS: usize = 3;

/// A named effect and what speaks for it.
#[derive(Clone, Debug)]
pub struct Named {
    /// Its index in the model.
    pub index: usize,
    /// Share of the held-out loss that goes when it is added last.
    pub held_out_gain: f64,
    /// 99th percentile of placebos for the same step.
    pub placebo_p99: f64,
    /// What tells it if its place does (`strays`).
    pub by_place: Option<String>,
    /// Effects that would have done as well in its place.
    pub equivalent: Vec<&'static str>,
}

/// What selection ends with.
#[derive(Clone, Debug)]
pub struct Selection {
    /// The model as designed, with only the base's own uncertainty fitted.
    pub plain: Fit,
    /// The chosen model.
    pub fit: Fit,
    /// Its effects.
    pub named: Vec<Named>,
    /// Ids of `named`.
    ids: Vec<&'static str>,
    /// How it was decided.
    pub decisions: Vec<String>,
    /// Candidates that could not be accepted though they were the best at their step, and why not.
    pub refused: Vec<String>,
}

impl Selection {
    /// Has another effect, the last of `fit`, in the place of the one at `index`: it was as good at the same step.
    pub fn take(&mut self, index: usize, fit: Fit) {
        let place = self.named.iter().position(|named| named.index == index);
        if let (Some(place), Some(last)) = (place, fit.model.members.last()) {
            self.ids[place] = last.id();
        }
        self.fit = fit;
    }

    /// Has another effect besides, the last of `fit`, that its place tells: no placebo was asked for.
    pub fn add_by_place(&mut self, bench: &Workbench<'_>, fit: Fit, place: String) {
        self.named.push(Named {
            index: fit.model.members.len() - 1,
            held_out_gain: share(bench, &self.fit, &fit),
            placebo_p99: 0.0,
            by_place: Some(place),
            equivalent: Vec::new(),
        });
        self.ids = fit.model.ids();
        self.fit = fit;
    }

    /// Asks anew what speaks for each effect, after the model was changed.
    pub fn rename(&mut self, bench: &Workbench<'_>) {
        let p99: Vec<(&'static str, f64)> = self
            .named
            .iter()
            .zip(&self.ids)
            .map(|(named, id)| (*id, named.placebo_p99))
            .collect();
        let others = swapped(bench, &self.fit);
        self.named = name(bench, &self.fit, &others, &p99);
        self.ids = self.fit.model.ids();
    }
}

/// Held-out loss of a fit by row, and in all.
fn losses(bench: &Workbench<'_>, fit: &Fit, sigma: f64) -> (Vec<f64>, f64) {
    let mut rows = held_out(bench, fit, sigma).concat();
    // The best of many independent choices fits noise by the logarithm of their number, and no block held out shows it.
    let chance: f64 = fit
        .model
        .members
        .iter()
        .map(|member| member.effect.choices(&bench.scale))
        .filter(|choices| *choices > 1.0)
        .map(|choices| (choices / CHANCE).ln())
        .sum();
    let each = chance / rows.len().max(1) as f64;
    rows.iter_mut().for_each(|loss| *loss += each);
    let all = rows.iter().sum();
    (rows, all)
}

/// Share of the held-out loss that goes from one fit to a better one, in the spread of the first.
fn share(bench: &Workbench<'_>, before: &Fit, after: &Fit) -> f64 {
    let (_, from) = losses(bench, before, before.sigma);
    let (_, to) = losses(bench, after, before.sigma);
    (from - to) / from.max(1e-300)
}

/// Selects. `progress` is told a share, 0 … 1, and what is being done.
pub fn select(bench: &Workbench<'_>, seed: u64, progress: &mut dyn FnMut(f64, &str)) -> Selection {
    let plain = fit(bench, &Model::default(), None);
    let mut now = plain.clone();
    let mut decisions = Vec::new();
    let mut refused = Vec::new();
    let mut step_p99: Vec<(&'static str, f64)> = Vec::new();
    let mut rounds = 0;
    let mut barred: Vec<(&'static str, usize)> = Vec::new();
    let (now, named) = loop {
        while now.model.members.len() < MOST_EFFECTS {
            let done = now.model.members.len() as f64;
            progress(
                0.8 * done / (done + 2.0),
                "trying every effect of the library",
            );
            let mut screening = screen(bench, &now, seed.wrapping_add(done as u64), DRAWS);
            let told = |entry: &Entry| !barred.contains(&entry.member.form());
            screening.entries.retain(told);
            let Some((better, p99)) =
                addition(bench, &now, &screening, &mut decisions, &mut refused)
            else {
                break;
            };
            for id in better.model.ids() {
                if !step_p99.iter().any(|(known, _)| *known == id) {
                    step_p99.push((id, p99));
                }
            }
            now = better;
        }
        rounds += 1;
        let full = now.clone();
        progress(
            0.85,
            "trying to do without each effect, and with others in its place",
        );
        if let Some(leaner) = backward(bench, &now, &step_p99, 1, &mut decisions) {
            now = leaner;
        }
        let others = swapped(bench, &now);
        let better = (rounds < ROUNDS).then(|| swap(bench, &now, &others, &mut decisions));
        match better.flatten() {
            // A better model may have room for another effect.
            Some((index, better)) => {
                inherit(&mut step_p99, &now, index, &better);
                now = better;
            }
            None => {
                progress(0.92, "asking which other effects would do as well");
                let mut now = polish(bench, &now);
                let mut others = others;
                // The last exchange may have made another one needless.
                if let Some(leaner) = backward(bench, &now, &step_p99, 1, &mut decisions) {
                    now = polish(bench, &leaner);
                    others = swapped(bench, &now);
                }
                let mut named = name(bench, &now, &others, &step_p99);
                // Of equals the plainest is named.
                for _ in 0..now.model.members.len() {
                    let Some((index, plainer)) = plainer(bench, &now, &others, &named) else {
                        break;
                    };
                    inherit(&mut step_p99, &now, index, &plainer);
                    decisions.push(format!(
                        "{} named of its equals: its equation is exact.",
                        plainer.model.members.last().map_or("", Member::id)
                    ));
                    now = polish(bench, &plainer);
                    // What only made up for the other equation goes with it.
                    if let Some(leaner) = backward(bench, &now, &step_p99, 1, &mut decisions) {
                        now = polish(bench, &leaner);
                    }
                    others = swapped(bench, &now);
                    named = name(bench, &now, &others, &step_p99);
                }
                // Only now that nothing is exchanged any more does each have to be missed, not the least alone.
                if let Some(leaner) = backward(bench, &now, &step_p99, MOST_EFFECTS, &mut decisions)
                {
                    now = polish(bench, &leaner);
                    others = swapped(bench, &now);
                    named = name(bench, &now, &others, &step_p99);
                }
                // What was taken out though much is missed without it stood in for something else.
                if rounds < ROUNDS && share(bench, &now, &full) > FLOOR {
                    let members = full.model.members.iter();
                    barred.extend(
                        members
                            .filter(|member| !now.model.has(member.id()))
                            .map(Member::form),
                    );
                    continue;
                }
                // Small, and as well explained by many others: that is structure, and no name.
                let Some(vague) = named.iter().find(|one| {
                    // One with thousands of periods to choose from is an equal of any small delay.
                    let told = one.equivalent.iter().filter(|id| {
                        find(id).is_some_and(|effect| effect.choices(&bench.scale) <= 1.0)
                    });
                    told.count() >= VAGUE && one.held_out_gain < SMALL
                }) else {
                    break (now, named);
                };
                refused.push(format!(
                    "{}: takes {} of the held-out error, and so would any of {}",
                    now.model.members[vague.index].id(),
                    percent(vague.held_out_gain),
                    vague.equivalent.join(", ")
                ));
                let now = fit(bench, &now.model.without(vague.index), None);
                let others = swapped(bench, &now);
                let named = name(bench, &now, &others, &step_p99);
                break (now, named);
            }
        }
    };
    let (mut now, named) = marked(bench, now, named, &mut decisions);
    idle_off(bench, &mut now);
    Selection {
        plain,
        ids: now.model.ids(),
        fit: now,
        named,
        decisions,
        refused,
    }
}

/// Switches off what does nothing (a rail that no reading reaches).
fn idle_off(bench: &Workbench<'_>, now: &mut Fit) {
    for m in 0..now.model.members.len() {
        let parameters = now.model.members[m].effect.card().parameters;
        for (p, parameter) in parameters.iter().enumerate() {
            if !parameter.off.is_infinite() {
                continue;
            }
            let mut model = now.model.clone();
            model.members[m].values[p] = parameter.off;
            // The same to the last digit: all that was found for the model stands.
            if bench.run(&model) == now.predicted {
                now.model = model;
            }
        }
    }
}

/// Adds what the readings themselves show, without any simulation (a grid of values), and takes away what only imitated it.
fn marked(
    bench: &Workbench<'_>,
    now: Fit,
    mut named: Vec<Named>,
    decisions: &mut Vec<String>,
) -> (Fit, Vec<Named>) {
    let mut now = now;
    for effect in bench.library.iter().copied() {
        let card = effect.card();
        let mut members = now.model.members.iter();
        if members.any(|member| member.id() == card.id && bench.shown(member).is_some()) {
            continue;
        }
        let Some(mark) = bench.mark(effect) else {
            continue;
        };
        let mut base = now.model.clone();
        base.members
            .retain(|member| member.id() != card.id && !card.looks_like.contains(&member.id()));
        let left = |fit: &Fit| {
            let residual = bench.as_read(&fit.residual);
            dot(&residual, &residual) / residual.len().max(1) as f64
        };
        let energy = left(&now).max(1e-300);
        if mark.variance < FLOOR * energy {
            continue;
        }
        let smooth = missed(bench, fit(bench, &base, None));
        let model = smooth.model.with(Member {
            effect,
            values: mark.values.clone(),
        });
        // The other values are those of the smooth simulation: steps have no slope to fit by.
        let stepped = Fit::of(bench, model, smooth.cost);
        let members = &stepped.model.members;
        // Where noise goes to and fro over the edges, rounding the simulation adds at most a second rounding error.
        let there = left(&stepped);
        let rounding = if effect.rounds() { mark.variance } else { 0.0 };
        if there > NO_LARGER * energy + DITHERED * rounding {
            decisions.push(format!(
                "{} not added, though the readings {}: it makes the error larger than noise ahead of it would.",
                card.id, mark.what
            ));
            continue;
        }
        // What a rail seems to cut off may be what another effect, or the fit, has taken away already.
        let gain = if effect.rounds() {
            (mark.variance / energy).min(1.0)
        } else {
            1.0 - there / left(&smooth).max(1e-300)
        };
        if gain < FLOOR {
            continue;
        }
        decisions.push(format!(
            "{} added: the readings {}; that makes {} of the residual's energy.",
            card.id,
            mark.what,
            percent(gain)
        ));
        let found = named
            .iter()
            .find(|one| now.model.members[one.index].id() == card.id);
        // Found without its mark, it has what speaks for it.
        let (held_out_gain, placebo_p99) =
            found.map_or((gain, 0.0), |one| (one.held_out_gain, one.placebo_p99));
        let kept: Vec<Named> = named
            .iter()
            .filter_map(|one| {
                let id = now.model.members[one.index].id();
                let index = members.iter().position(|member| member.id() == id)?;
                (id != card.id).then(|| Named {
                    index,
                    ..one.clone()
                })
            })
            .collect();
        named = kept;
        named.push(Named {
            index: members.len() - 1,
            held_out_gain,
            placebo_p99,
            by_place: None,
            equivalent: Vec::new(),
        });
        now = stepped;
    }
    (now, named)
}

/// Leaves out what is too small beside the others: steps make single readings jump by what hardly moves them.
fn missed(bench: &Workbench<'_>, mut now: Fit) -> Fit {
    let mut index = 0;
    while index < now.model.members.len() {
        let without = fit(bench, &now.model.without(index), None);
        let gain = share(bench, &without, &now);
        if obstacle(bench, &without, &now, index, gain).is_some() {
            now = without;
        } else {
            index += 1;
        }
    }
    now
}

/// Whether a value is so far beyond what the recording tells that the effect does what a simpler one does.
fn endless(bench: &Workbench<'_>, member: &Member) -> bool {
    let mut values = member.values.iter().enumerate();
    values.any(|(p, value)| *value >= member.effect.endless(p, &bench.scale))
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
fn fits(bench: &Workbench<'_>, models: Vec<Model>) -> Vec<Fit> {
    models
        .into_par_iter()
        .map(|model| fit(bench, &model, None))
        .collect()
}

/// The effect, or the two, with which a model grows, and the limit that the placebos set. Forms that are as free as to imitate a few
/// others at once are asked where plainer ones do not do.
fn addition(
    bench: &Workbench<'_>,
    now: &Fit,
    screening: &Screening,
    decisions: &mut Vec<String>,
    refused: &mut Vec<String>,
) -> Option<(Fit, f64)> {
    let (free, plain): (Vec<&Entry>, Vec<&Entry>) = screening
        .entries
        .iter()
        .partition(|entry| entry.member.effect.remembers());
    let all: Vec<&Entry> = screening.entries.iter().collect();
    let p99 = screening.placebo_p99;
    let mut grown = |entries: &[&Entry]| added_of(bench, now, (entries, p99), decisions, refused);
    grown(&plain).or_else(|| (!free.is_empty()).then(|| grown(&all)).flatten())
}

/// The same of some candidates, with the limit.
fn added_of(
    bench: &Workbench<'_>,
    now: &Fit,
    (entries, p99): (&[&Entry], f64),
    decisions: &mut Vec<String>,
    refused: &mut Vec<String>,
) -> Option<(Fit, f64)> {
    let (mut said, mut said_besides) = (Vec::new(), Vec::new());
    let usual = promising(bench, now, entries, FITTED, STARTS);
    let single = step(bench, now, usual, p99, &mut said, refused);
    // Where two effects hide each other, the best single one can be the wrong one: pairs are tried at the beginning, and
    // whenever nothing passes alone.
    let double = if now.model.members.is_empty() || single.is_none() {
        let single = single.as_ref().map(|(fit, _)| fit);
        pair(bench, now, (entries, p99), single, &mut said, refused)
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

/// The best single addition of some, if it is accepted.
fn step(
    bench: &Workbench<'_>,
    now: &Fit,
    models: Vec<Model>,
    placebo_p99: f64,
    decisions: &mut Vec<String>,
    refused: &mut Vec<String>,
) -> Option<(Fit, f64)> {
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
                    percent(gain),
                    percent(placebo_p99)
                ),
            );
            continue;
        }
        match obstacle(bench, now, &better, index, gain) {
            Some(why) => note(refused, format!("{id}: {why}")),
            None => {
                decisions.push(format!(
                    "{id} added: takes {} of the held-out error; the best of {} placebos of the whole library takes {} (99th percentile).",
                    percent(gain),
                    DRAWS,
                    percent(placebo_p99)
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

/// Why an effect at an index cannot be named though it fits: too small to matter, within the reference's accuracy, or at the end
/// of what is physics.
fn obstacle(
    bench: &Workbench<'_>,
    before: &Fit,
    after: &Fit,
    index: usize,
    gain: f64,
) -> Option<String> {
    small(bench, before, after, index, gain).or_else(|| at_end(bench, &after.model.members[index]))
}

/// The first two of these.
fn small(
    bench: &Workbench<'_>,
    before: &Fit,
    after: &Fit,
    index: usize,
    gain: f64,
) -> Option<String> {
    let member = &after.model.members[index];
    let card = member.effect.card();
    let without = bench.run(&after.model.without(index));
    let change = change(&after.predicted, &without);
    let as_read = bench.as_read(&change);
    let largest = as_read.iter().fold(0.0f64, |most, c| most.max(c.abs()));
    let (mut from, mut to, mut changed, mut size) = (0.0, 0.0, 0.0, 0.0);
    let (mut accuracy, mut rows) = (0.0, 0.0);
    for (row, change) in change.iter().enumerate() {
        if as_read[row].abs() >= ACTS * largest && largest > 0.0 {
            from += before.residual[row].powi(2);
            to += after.residual[row].powi(2);
            changed += change.powi(2);
            size += as_read[row].powi(2);
            accuracy += bench.accuracy(row).powi(2);
            rows += 1.0;
        }
    }
    if rows == 0.0 {
        return Some("changes nothing".into());
    }
    let there = 1.0 - to / f64::max(from, 1e-300);
    if cut(&after.model, index) && chance(&before.residual, &after.residual) {
        return Some("shown only by readings that noise takes over the other's threshold".into());
    }
    if member.effect.remembers() {
        let error = bench.as_read(&after.residual);
        let (without, with) = without_memory(bench, &error, &as_read);
        if chance(&without, &with) {
            return Some("what it remembers shows no more than by chance beside a curve".into());
        }
    }
    let (gain, there) = if bench.is_white() || cut(&after.model, index) {
        size_beside(bench, &before.residual, &after.model, index)
    } else {
        (gain, there)
    };
    if gain < FLOOR && there < PLACE {
        return Some(format!(
            "real, but takes only {} of the held-out error ({} where it acts), below the practical floor of {}",
            percent(gain),
            percent(there),
            percent(FLOOR)
        ));
    }
    let beside = beside(bench, after, index);
    let mut all = dot(&as_read, &as_read);
    if before.model.members.len() < after.model.members.len() {
        // What the others would do in its place is theirs.
        all = all.min(apart(bench, &before.predicted, &after.predicted));
    }
    if all < beside {
        let [all, beside] = [all, beside].map(|energy| (energy / bench.len() as f64).sqrt());
        return Some(within_others(all, beside, &bench.problem.unit));
    }
    let deviations = bench.deviations(&change);
    if deviations < CERTAIN {
        return Some(format!(
            "{deviations:.1} standard deviations of what the stated noise and the readings' steps do by themselves"
        ));
    }
    let noise = to / rows;
    if card.stage.is_output()
        && card
            .parameters
            .iter()
            .all(|parameter| parameter.search != Search::Linear)
        && changed / rows < noise
    {
        return Some("smaller than the noise where it acts".into());
    }
    if size < accuracy {
        return Some(format!(
            "its size, {} {unit} rms, is within what reference and time stamps are accurate to, {} {unit}",
            short(f64::sqrt(size / rows)),
            short(f64::sqrt(accuracy / rows)),
            unit = bench.problem.unit
        ));
    }
    None
}

/// Why a size is none beside others whose equations may be off by more.
fn within_others(rms: f64, others: f64, unit: &str) -> String {
    format!(
        "{} {unit} rms, which the equations of the others may be off by ({} {unit})",
        short(rms),
        short(others)
    )
}

/// Whether another effect cuts or rounds what one gives.
fn cut(model: &Model, index: usize) -> bool {
    let mut others = model.members.iter().enumerate();
    others.any(|(other, member)| other != index && member.effect.cuts())
}

/// Whether single readings make up a gain: the sum of what their squared errors fall by is less than so many times the root of the sum
/// of its squares, which is what it would vary by if each fell or rose by chance. Noise that takes a reading over a threshold changes it by all of the step, for better or for worse.
fn chance(before: &[f64], after: &[f64]) -> bool {
    let (sum, squares) = before
        .iter()
        .zip(after)
        .map(|(before, after)| before * before - after * after)
        .fold((0.0, 0.0), |(sum, squares), less| {
            (sum + less, squares + less * less)
        });
    sum < PAIRED * f64::sqrt(squares)
}

/// How large an effect is beside the error as it is read, in energy: overall, and where it acts. What matters in practice is that,
/// however well quick noise shows it, and however far a threshold behind it makes readings jump.
fn size_beside(bench: &Workbench<'_>, residual: &[f64], model: &Model, index: usize) -> (f64, f64) {
    let mut ahead = model.clone();
    let member = ahead.members.remove(index);
    ahead.members.retain(|member| !member.effect.cuts());
    let without = bench.run(&ahead);
    let change = change(&bench.run(&ahead.with(member)), &without);
    let (change, error) = (bench.as_read(&change), bench.as_read(residual));
    let largest = change.iter().fold(0.0f64, |most, c| most.max(c.abs()));
    let acts = change.iter().zip(error.iter());
    let (size, seen) = acts
        .filter(|(change, _)| change.abs() >= ACTS * largest)
        .fold((0.0, 0.0), |(size, seen), (change, error)| {
            (size + change * change, seen + error * error)
        });
    let share = |size: f64, of: f64| size / of.max(1e-300);
    let all = share(dot(&change, &change), dot(&error, &error));
    (all, share(size, seen))
}

/// What of an effect's values would be at the end of what is physics.
pub fn at_end(bench: &Workbench<'_>, member: &Member) -> Option<String> {
    let card = member.effect.card();
    for (p, parameter) in card
        .parameters
        .iter()
        .enumerate()
        .filter(|(_, p)| !p.internal)
    {
        let (low, high) = member.effect.bounds(p, &bench.scale);
        let value = member.values[p];
        if value >= member.effect.endless(p, &bench.scale) {
            return Some(format!(
                "{} would be {value:.4}, more than the recording tells",
                parameter.name
            ));
        }
        let margin = match parameter.search {
            Search::Logarithmic => value * 0.01,
            Search::Stepped if low > 0.0 => value * 0.01,
            _ => 1e-4 * (high - low),
        };
        let end = if value <= low + margin {
            Some(low)
        } else if value >= high - margin {
            Some(high)
        } else {
            None
        };
        if let Some(end) = end
            && end != 0.0
            && !parameter.open
            && !(parameter.from_bottom && end == low)
            && !(parameter.to_top && end == high)
        {
            return Some(format!(
                "{} would be at the end of what is physics, {end:.4}",
                parameter.name
            ));
        }
    }
    None
}

/// Energy by which two simulations are apart.
fn apart(bench: &Workbench<'_>, one: &[f64], other: &[f64]) -> f64 {
    let change = change(one, other);
    let change = bench.as_read(&change);
    dot(&change, &change)
}

/// Energy by which the other effects' equations may be off, those of the model file among them.
fn beside(bench: &Workbench<'_>, fit: &Fit, index: usize) -> f64 {
    let members = &fit.model.members;
    let others: f64 = (0..members.len())
        .filter(|other| *other != index)
        .map(|other| {
            let share = members[other].effect.idealised();
            if share == 0.0 {
                return 0.0;
            }
            let without = bench.run(&fit.model.without(other));
            share * share * apart(bench, &fit.predicted, &without)
        })
        .sum();
    bench.modelled + others
}

/// Two effects that hide each other: neither passes alone, both together do.
fn pair(
    bench: &Workbench<'_>,
    now: &Fit,
    (entries, placebo_p99): (&[&Entry], f64),
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
    let least = pairs_gain(placebo_p99);
    // Free forms are among the second ones where they are among the first.
    let free = entries.iter().any(|entry| entry.member.effect.remembers());
    let may_follow = |entry: &Entry| free || !entry.member.effect.remembers();
    // A masked effect shows once the other is fitted: from each of the best single ones one goes a step further.
    let firsts = promising(bench, now, entries, FIRSTS, 1);
    let models: Vec<Model> = fits(bench, firsts)
        .par_iter()
        .flat_map_iter(|first| {
            let taken = share(bench, now, first).max(0.0);
            let seconds = screen(bench, first, 0, 0).entries;
            let begun = |entry: &&Entry| {
                taken + entry.gain * (1.0 - taken) > STARTED * least && may_follow(entry)
            };
            let seconds: Vec<&Entry> = seconds.iter().filter(begun).collect();
            promising(bench, first, &seconds, FIRSTS, 1)
        })
        // One more branch of the first is no second effect.
        .filter(|model| model.members.len() == now.model.members.len() + 2)
        .collect();
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
        percent(share(bench, now, &best))
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
            percent(gain),
            percent(least)
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
                percent(missed),
                percent(p99)
            ))
        } else if only_aligns(bench, &alone, best, index) {
            Some("only aligns the samples".into())
        } else {
            obstacle(bench, &alone, best, index, missed)
        };
        why.map(|why| format!("{} {why}", best.model.members[index].id()))
    })
}

fn p99_of(step_p99: &[(&'static str, f64)], id: &str) -> f64 {
    step_p99
        .iter()
        .find(|(known, _)| *known == id)
        .map_or(0.0, |(_, p99)| *p99)
}

/// What takes the place of the effect at an index has to beat the same placebos.
fn inherit(step_p99: &mut Vec<(&'static str, f64)>, before: &Fit, index: usize, after: &Fit) {
    let p99 = p99_of(step_p99, before.model.members[index].id());
    if let Some(last) = after.model.members.last() {
        step_p99.retain(|(known, _)| *known != last.id());
        step_p99.push((last.id(), p99));
    }
}

/// Leaves out what is no longer missed with the others there, of the `looked_at` effects that are missed least.
fn backward(
    bench: &Workbench<'_>,
    now: &Fit,
    step_p99: &[(&'static str, f64)],
    looked_at: usize,
    decisions: &mut Vec<String>,
) -> Option<Fit> {
    let mut leaner: Option<Fit> = None;
    loop {
        let here = leaner.as_ref().unwrap_or(now);
        if here.model.members.len() < 2 {
            return leaner;
        }
        let mut tried: Vec<(usize, Fit, f64)> = (0..here.model.members.len())
            .into_par_iter()
            .map(|index| {
                let without = fit(bench, &here.model.without(index), None);
                let missed = share(bench, &without, here);
                (index, without, missed)
            })
            .collect();
        tried.sort_by(|a, b| a.2.total_cmp(&b.2));
        tried.truncate(looked_at);
        let needless = tried.into_iter().find_map(|(index, without, missed)| {
            let placebos = p99_of(step_p99, here.model.members[index].id());
            let why = if missed <= placebos {
                format!(
                    "takes only {} of the held-out error, placebos up to {}",
                    percent(missed),
                    percent(placebos)
                )
            } else {
                obstacle(bench, &without, here, index, missed)?
            };
            Some((index, without, why))
        });
        let Some((index, without, why)) = needless else {
            return leaner;
        };
        let id = here.model.members[index].id();
        decisions.push(format!(
            "{id} taken out again, with the others there: {why}."
        ));
        leaner = Some(without);
    }
}

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
    let as_read = bench.as_read(&without.predicted);
    let clues = bench.clues(&as_read);
    for effect in bench.library.iter().copied().filter(alike) {
        if !joins(model, effect) {
            continue;
        }
        let mut starts: Vec<(f64, Member)> = effect
            .starts(&bench.scale, &clues)
            .into_par_iter()
            .map(|values| {
                let member = Member { effect, values };
                let there = bench.run(&added(&without.model, member.clone()));
                (loss(&bench.residual(&there), without.sigma), member)
            })
            .collect();
        starts.sort_by(|a, b| a.0.total_cmp(&b.0));
        let nearest = starts.into_iter().take(STARTS).map(|(_, member)| member);
        members.extend(
            nearest
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

/// Whether an effect can stand beside those of a model: it is not there, or it has more branches than what is there and takes that
/// one's place as well.
pub fn joins(model: &Model, effect: &'static dyn Effect) -> bool {
    let card = effect.card();
    let same = model.members.iter().find(|member| member.id() == card.id);
    same.is_none_or(|member| card.parameters.len() > member.values.len())
}

/// Fits every rival in the place of every effect.
fn swapped(bench: &Workbench<'_>, now: &Fit) -> Vec<(usize, Fit)> {
    let (places, models): (Vec<usize>, Vec<Model>) = (0..now.model.members.len())
        .flat_map(|index| {
            let id = now.model.members[index].id();
            let without = fit(bench, &now.model.without(index), None);
            let taken = share(bench, &without, now);
            rivals(bench, &without, &now.model, (id, taken))
                .into_iter()
                .map(|rival| added(&without.model, rival))
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

fn swap(
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
        best.model.members[last].id(),
        percent((here - loss) / here)
    ));
    Some((index, best.clone()))
}

/// The model with an effect, at the index that comes with it, replaced by one of its equals whose equation is exact (a constant, a
/// factor, a time), if the effect's own is not.
fn plainer(
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
                    }) && !beaten(bench, fit, now)
                })
                // In one spread for all: in its own, a bad fit's residual is a small one.
                .min_by(|a, b| {
                    let sigma = a.sigma.min(b.sigma);
                    loss(&a.residual, sigma).total_cmp(&loss(&b.residual, sigma))
                })
                .map(|fit| (one.index, fit.clone()))
        })
}

/// What speaks for each effect, and what would have done as well.
fn name(
    bench: &Workbench<'_>,
    now: &Fit,
    others: &[(usize, Fit)],
    step_p99: &[(&'static str, f64)],
) -> Vec<Named> {
    (0..now.model.members.len())
        .map(|index| {
            let id = now.model.members[index].id();
            let without = fit(bench, &now.model.without(index), None);
            let taken = share(bench, &without, now);
            // Where few rows decide, the difference of two models is never certain: who takes much less is no equal.
            let least = (EQUAL * taken).max(p99_of(step_p99, id));
            let mut equivalent: Vec<&'static str> = others
                .iter()
                .filter(|(at, _)| *at == index)
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
                placebo_p99: p99_of(step_p99, id),
                by_place: None,
                equivalent,
            }
        })
        .collect()
}

/// Whether a model, whose last effect has the place of one of the chosen model, does as well as that one: what the other effects'
/// equations, and uneven stamps, may be off by does not decide between two.
pub fn does_as_well(bench: &Workbench<'_>, other: &Fit, chosen: &Fit, index: usize) -> bool {
    let between = |member: &Member| member.effect.card().stage.is_between_rows();
    let last = other.model.members.last();
    let stamped = between(&chosen.model.members[index]) && last.is_some_and(between);
    let may_be_off = beside(bench, chosen, index) + if stamped { bench.stamped() } else { 0.0 };
    apart(bench, &chosen.predicted, &other.predicted) < may_be_off || !beaten(bench, other, chosen)
}

/// Whether a model's held-out loss is higher than the chosen one's by more than chance, stretch against stretch.
pub fn beaten(bench: &Workbench<'_>, other: &Fit, chosen: &Fit) -> bool {
    let sigma = chosen.sigma.min(other.sigma);
    let (theirs, _) = losses(bench, other, sigma);
    let (ours, _) = losses(bench, chosen, sigma);
    // Noise with a memory tells two models apart by no more than what it does along their difference, however many the rows.
    let apart = change(&other.predicted, &chosen.predicted);
    let stated = bench.carried(0, &apart).unwrap_or(0.0) + bench.rounded(0, &apart);
    worse(&theirs, &ours, stated.sqrt() / (sigma * sigma))
}

/// Whether losses, row by row, are higher than others by more than chance, stretch against stretch; `stated` is the standard
/// deviation of their sums' difference that is known besides.
pub fn worse(theirs: &[f64], ours: &[f64], stated: f64) -> bool {
    let rows = (ours.len() / STRETCHES).max(1);
    let differences: Vec<f64> = theirs
        .chunks(rows)
        .zip(ours.chunks(rows))
        .map(|(a, b)| a.iter().sum::<f64>() - b.iter().sum::<f64>())
        .collect();
    let count = differences.len() as f64;
    let mean = differences.iter().sum::<f64>() / count;
    let variance =
        differences.iter().map(|d| (d - mean).powi(2)).sum::<f64>() / (count - 1.0).max(1.0);
    mean > (BEATEN * (variance / count).sqrt().max(stated / count)).max(ODDS / count)
}

/// Whether a model owes what it gains to the alignment of samples that its effect sets free, and not to the effect.
fn only_aligns(bench: &Workbench<'_>, before: &Fit, after: &Fit, index: usize) -> bool {
    if after.model.nuisance.alignment_s == before.model.nuisance.alignment_s {
        return false;
    }
    let aligned = bench.residual(&bench.run(&after.model.without(index)));
    let loss = |residual: &[f64]| {
        residual
            .iter()
            .map(|r| huber(r / before.sigma))
            .sum::<f64>()
    };
    let (from, to) = (loss(&before.residual), loss(&after.residual));
    from - loss(&aligned) > 0.5 * (from - to)
}

/// A share in percent, short.
pub fn percent(share: f64) -> String {
    // What is next to nothing is no measure.
    if share.abs() < 1e4 {
        format!("{:.3} %", 100.0 * share).replace(".000 %", " %")
    } else {
        "more than any".into()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_size_in_volts_is_told_in_volts() {
        let said = within_others(0.00123, 0.004567, "V");
        assert!(said.starts_with("0.00123 V rms"), "{said}");
        assert!(said.ends_with("(0.00457 V)"), "{said}");
    }
}
