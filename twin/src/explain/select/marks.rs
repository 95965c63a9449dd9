//! What the readings themselves show without any simulation: a grid of values, a rail.

use super::Named;
use super::losses::share;
use super::obstacle::{CERTAIN, FLOOR, obstacle};
use crate::explain::fit::{Fit, fit};
use crate::explain::normal::dot;
use crate::explain::robust::loss;
use crate::explain::workbench::{Member, Workbench};
use crate::report::format::precise_percent;

/// A simulation that is rounded may be off by this many times the variance of rounding more than one that is not: by once where
/// noise is as loud as a step, and chance.
const DITHERED: f64 = 1.1;
/// An error that is larger by less than this factor is not.
const NO_LARGER: f64 = 1.01;

/// Adds what the readings themselves show, without any simulation (a grid of values), and takes away what only imitated it.
pub(super) fn marked(
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
        let member = Member {
            effect,
            values: mark.values.clone(),
        };
        let smooth = fit(bench, &base, None);
        let (smooth, stepped) = if effect.rounds() {
            // The other values are those of the smooth simulation: steps have no slope to fit by.
            let smooth = missed(bench, smooth);
            let stepped = Fit::of(bench, smooth.model.with(member), smooth.cost);
            (smooth, stepped)
        } else {
            (smooth, fit(bench, &base.with(member), None))
        };
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
            precise_percent(gain)
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

/// Switches off what does nothing: a rail that no reading reaches, or so few that chance does as much. What is missed least goes first:
/// of two rails of which one has to stay, the one that explains something does.
pub(super) fn idle_off(bench: &Workbench<'_>, now: &mut Fit) {
    while let Some(without) = least_missed(bench, now) {
        *now = without;
    }
}

/// The fit without the rail that readings miss least, if that is not beyond chance and something of its effect is left.
fn least_missed(bench: &Workbench<'_>, now: &Fit) -> Option<Fit> {
    let mut least: Option<(f64, Fit)> = None;
    for (m, member) in now.model.members.iter().enumerate() {
        let parameters = member.effect.card().parameters.iter();
        for (p, parameter) in parameters.enumerate() {
            if !parameter.off.is_infinite() || member.values[p] == parameter.off {
                continue;
            }
            let mut model = now.model.clone();
            model.members[m].values[p] = parameter.off;
            if !is_set(&model.members[m]) {
                continue;
            }
            let predicted = bench.run(&model);
            let (without, missed) = if predicted == now.predicted {
                // The same to the last digit: all that was found for the model stands.
                let mut same = now.clone();
                same.model = model;
                (same, 0.0)
            } else {
                let missed = missed_by(bench, now, &predicted);
                (Fit::of(bench, model, now.cost), missed)
            };
            let chance = 0.5 * CERTAIN * CERTAIN;
            if missed <= chance && least.as_ref().is_none_or(|(least, _)| missed < *least) {
                least = Some((missed, without));
            }
        }
    }
    least.map(|(_, without)| without)
}

/// Whether something is left of an effect.
fn is_set(member: &Member) -> bool {
    let parameters = member.effect.card().parameters.iter();
    let mut values = parameters.zip(&member.values);
    values.any(|(parameter, value)| parameter.off.is_infinite() && value.is_finite())
}

/// By how much the loss is higher with a simulation without a part of a fit.
fn missed_by(bench: &Workbench<'_>, with: &Fit, without: &[f64]) -> f64 {
    loss(&bench.residual(without), with.sigma) - loss(&with.residual, with.sigma)
}
