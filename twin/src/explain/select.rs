//! Which effects are named: a model grows by the effect, or the two, that take most (`grow`), does without what is no longer
//! missed, exchanges what another does better, and ends with what else would have done as well (`rivals`). `losses` compare
//! models, `obstacle` says why one that fits is not named, `marks` adds what no simulation is needed for.

mod grow;
mod losses;
mod marks;
mod obstacle;
mod rivals;

use std::sync::Arc;

use rayon::prelude::*;

pub use grow::added;
pub use losses::{beaten, worse};
pub use obstacle::{CERTAIN, at_end, stands_at_top};
pub use rivals::{does_as_well, joins};

use super::fit::{Fit, fit, in_the_mean, other_minimum, polish};
use super::screen::{DRAWS, Entry, screen};
use super::workbench::{Member, Model, Workbench};
use crate::effects::find;
use crate::report::format::precise_percent;
use grow::addition;
use losses::share;
use obstacle::{FLOOR, obstacle};
use rivals::{name, new, plainer, swap, swapped};

/// Effects in one model at most.
const MOST_EFFECTS: usize = 6;
/// So many others that would do as well make an effect nameless if it is small.
const VAGUE: usize = 3;
/// Share of the held-out error below which an effect is small.
const SMALL: f64 = 0.2;
/// Rounds of adding, doing without and exchanging.
const ROUNDS: usize = 3;

/// A named effect and what speaks for it.
#[derive(Clone, Debug)]
pub struct Named {
    /// Its index in the model.
    pub index: usize,
    /// Share of the held-out loss that goes when it is added last.
    pub held_out_gain: f64,
    /// 99th percentile of placebos for the same step, or with the other effects there if it is kept by that.
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
        let placed: Vec<(&'static str, Option<String>)> = self
            .named
            .iter()
            .zip(&self.ids)
            .map(|(named, id)| (*id, named.by_place.clone()))
            .collect();
        let others = swapped(bench, &self.fit);
        self.named = name(bench, &self.fit, &others, &p99);
        self.ids = self.fit.model.ids();
        for (named, id) in self.named.iter_mut().zip(&self.ids) {
            let before = placed.iter().find(|(known, _)| known == id);
            named.by_place = before.and_then(|(_, by_place)| by_place.clone());
        }
    }
}

/// Selects. `progress` is told a share, 0 … 1, and what is being done.
pub fn select(bench: &Workbench<'_>, seed: u64, progress: &mut dyn FnMut(f64, &str)) -> Selection {
    let mut search = Search {
        bench,
        seed,
        placebo_p99: Vec::new(),
        barred: Vec::new(),
        decisions: Vec::new(),
        refused: Vec::new(),
    };
    let plain = fit(bench, &Model::default(), None);
    let mut now = plain.clone();
    let mut rounds = 0;
    let (now, named) = loop {
        now = search.grown(now, progress);
        rounds += 1;
        let full = now.clone();
        progress(
            0.85,
            "trying to do without each effect, and with others in its place",
        );
        if let Some(leaner) = search.leaner(&now, 1) {
            now = leaner;
        }
        let others = swapped(bench, &now);
        let better = (rounds < ROUNDS).then(|| swap(bench, &now, &others, &mut search.decisions));
        if let Some((index, better)) = better.flatten() {
            // A better model may have room for another effect.
            search.inherit(&now, index, &better);
            now = better;
            continue;
        }
        progress(0.92, "asking which other effects would do as well");
        let (settled, named) = search.settled(now, others);
        now = settled;
        // What was taken out though much is missed without it stood in for something else.
        if rounds < ROUNDS && share(bench, &now, &full) > FLOOR {
            let members = full.model.members.iter();
            let out = members.filter(|member| !now.model.has(member.id()));
            search.barred.extend(out.map(Member::form));
            continue;
        }
        break search.told(now, named);
    };
    let (mut now, named) = marks::marked(bench, now, named, &mut search.decisions);
    marks::idle_off(bench, &mut now);
    Selection {
        plain,
        ids: now.model.ids(),
        fit: now,
        named,
        decisions: search.decisions,
        refused: search.refused,
    }
}

/// A fit of a model from which something was taken out, or into which something was put, once it was settled: until nothing moves any
/// more, without what does nothing, and right in the mean.
pub(super) fn settled(bench: &Workbench<'_>, from: &Fit) -> Fit {
    let mut settled = polish(bench, from);
    marks::idle_off(bench, &mut settled);
    in_the_mean(bench, settled)
}

/// What is kept from one step to the next.
struct Search<'b, 'a> {
    bench: &'b Workbench<'a>,
    seed: u64,
    /// 99th percentile of placebos at the step at which an effect was added, or with the others there, by its id.
    placebo_p99: Vec<(&'static str, f64)>,
    /// Forms that are not tried again.
    barred: Vec<(&'static str, usize)>,
    /// [`Selection::decisions`] and [`Selection::refused`].
    decisions: Vec<String>,
    refused: Vec<String>,
}

impl Search<'_, '_> {
    /// Adds effects as long as one passes.
    fn grown(&mut self, mut now: Fit, progress: &mut dyn FnMut(f64, &str)) -> Fit {
        while now.model.members.len() < MOST_EFFECTS {
            let done = now.model.members.len() as f64;
            progress(
                0.8 * done / (done + 2.0),
                "trying every effect of the library",
            );
            let seed = self.seed.wrapping_add(done as u64);
            let mut screening = screen(self.bench, &now, seed, DRAWS);
            let tried = |entry: &Arc<Entry>| !self.barred.contains(&entry.member.form());
            screening.entries.retain(tried);
            let (decisions, refused) = (&mut self.decisions, &mut self.refused);
            let Some((better, p99)) = addition(self.bench, &now, &screening, decisions, refused)
            else {
                break;
            };
            for id in better.model.ids() {
                if !self.placebo_p99.iter().any(|(known, _)| *known == id) {
                    self.placebo_p99.push((id, p99));
                }
            }
            now = other_minimum(self.bench, better);
        }
        now
    }

    /// Ends with a model that no exchange makes better: `others` are its rivals (`swapped`).
    fn settled(&mut self, now: Fit, mut others: Vec<(usize, Fit)>) -> (Fit, Vec<Named>) {
        let mut now = polish(self.bench, &now);
        // The last exchange may have made another one needless.
        if let Some(leaner) = self.leaner(&now, 1) {
            now = polish(self.bench, &leaner);
            others = swapped(self.bench, &now);
        }
        let mut named = name(self.bench, &now, &others, &self.placebo_p99);
        // Of equals the plainest is named.
        for _ in 0..now.model.members.len() {
            let Some((index, plainer)) = plainer(self.bench, &now, &others, &named) else {
                break;
            };
            self.inherit(&now, index, &plainer);
            self.decisions.push(format!(
                "{} named of its equals: its equation is exact.",
                plainer.model.members.last().map_or("", Member::id)
            ));
            now = polish(self.bench, &plainer);
            // What only made up for the other equation goes with it.
            if let Some(leaner) = self.leaner(&now, 1) {
                now = polish(self.bench, &leaner);
            }
            others = swapped(self.bench, &now);
            named = name(self.bench, &now, &others, &self.placebo_p99);
        }
        // Only now that nothing is exchanged any more does each have to be missed, not the least alone.
        if let Some(leaner) = self.leaner(&now, MOST_EFFECTS) {
            now = polish(self.bench, &leaner);
            others = swapped(self.bench, &now);
            named = name(self.bench, &now, &others, &self.placebo_p99);
        }
        (now, named)
    }

    /// Takes one out that is small, and as well explained by many others: that is structure, and no name.
    fn told(&mut self, now: Fit, named: Vec<Named>) -> (Fit, Vec<Named>) {
        let vague = named.iter().find(|one| {
            // One with thousands of periods to choose from is an equal of any small delay.
            let told = one.equivalent.iter().filter(|id| {
                find(id).is_some_and(|effect| effect.choices(&self.bench.scale) <= 1.0)
            });
            told.count() >= VAGUE && one.held_out_gain < SMALL
        });
        let Some(vague) = vague else {
            return (now, named);
        };
        self.refused.push(format!(
            "{}: takes {} of the held-out error, and so would any of {}",
            now.model.members[vague.index].id(),
            precise_percent(vague.held_out_gain),
            vague.equivalent.join(", ")
        ));
        let now = fit(self.bench, &now.model.without(vague.index), None);
        let others = swapped(self.bench, &now);
        let named = name(self.bench, &now, &others, &self.placebo_p99);
        (now, named)
    }

    /// What takes the place of the effect at an index has to beat the same placebos.
    fn inherit(&mut self, before: &Fit, index: usize, after: &Fit) {
        let p99 = p99_of(&self.placebo_p99, before.model.members[index].id());
        for id in &after.model.ids()[new(before, after)..] {
            self.limit(id, p99);
        }
    }

    /// Has another limit for an effect.
    fn limit(&mut self, id: &'static str, p99: f64) {
        self.placebo_p99.retain(|(known, _)| *known != id);
        self.placebo_p99.push((id, p99));
    }

    /// Leaves out what is no longer missed with the others there, of the `looked_at` effects that are missed least.
    fn leaner(&mut self, now: &Fit, looked_at: usize) -> Option<Fit> {
        let bench = self.bench;
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
            // Limits that were asked anew, and passed.
            let mut anew: Vec<(&'static str, f64)> = Vec::new();
            let needless = tried.into_iter().find_map(|(index, without, missed)| {
                let id = here.model.members[index].id();
                let mut placebos = p99_of(&self.placebo_p99, id);
                if missed <= placebos && missed > FLOOR {
                    // That limit is of the step at which it was added, when the others were not there: what placebos took then was
                    // mostly what the others take now.
                    let with_them = screen(bench, &without, self.seed, DRAWS).placebo_p99;
                    placebos = placebos.min(with_them);
                    if missed > placebos {
                        anew.push((id, placebos));
                    }
                }
                let why = if missed <= placebos {
                    format!(
                        "takes only {} of the held-out error, placebos up to {}",
                        precise_percent(missed),
                        precise_percent(placebos)
                    )
                } else {
                    obstacle(bench, &without, here, index, missed)?
                };
                Some((index, without, why))
            });
            for (id, p99) in anew {
                self.decisions.push(format!(
                    "{id} kept, with the others there: placebos take {} beside them.",
                    precise_percent(p99)
                ));
                self.limit(id, p99);
            }
            let Some((index, without, why)) = needless else {
                return leaner;
            };
            let id = here.model.members[index].id();
            self.decisions.push(format!(
                "{id} taken out again, with the others there: {why}."
            ));
            leaner = Some(without);
        }
    }
}

/// The limit that placebos set to an effect; 0 for what no step added.
fn p99_of(placebo_p99: &[(&'static str, f64)], id: &str) -> f64 {
    placebo_p99
        .iter()
        .find(|(known, _)| *known == id)
        .map_or(0.0, |(_, p99)| *p99)
}
