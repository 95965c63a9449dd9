//! Why an effect that fits is not named: too small, within what is accurate, or at the end of what is physics.

use crate::effects::{Effect, Search, Stage};
use crate::explain::fit::Fit;
use crate::explain::normal::dot;
use crate::explain::robust::huber;
use crate::explain::shape::without_memory;
use crate::explain::slope::change;
use crate::explain::told::short;
use crate::explain::verdict::{STATED, allowed, unavoidable};
use crate::explain::workbench::{Member, Model, Workbench};
use crate::report::format::precise_percent;

/// A named effect takes away at least this share of the held-out squared error (2 % of the held-out rms), overall or where it
/// acts.
pub(super) const FLOOR: f64 = 0.04;
/// A smaller one takes away at least this share where it acts.
const PLACE: f64 = 0.12;
/// Standard deviations that a gain beside a threshold has to be away from chance, reading by reading.
const PAIRED: f64 = 3.0;
/// Standard deviations of the stated noise that an effect has to be away from nothing: one in a thousand recordings has an effect
/// of some thirty by chance that is 4.2 away.
pub const CERTAIN: f64 = 4.2;
/// An equation is off along one effect by at most this many times the energy of what is left of the readings beyond noise.
const ALONG: f64 = 4.0;
/// Seed of the noise that is sent through what cuts or rounds, once for all models that are compared.
const DRAWN: u64 = 0;
/// Rows where an effect changes the reading by at least this share of its largest change are where it acts.
const ACTS: f64 = 0.2;

/// Why an effect at an index cannot be named though it fits: too small to matter, within the reference's accuracy, or at the end
/// of what is physics.
pub(super) fn obstacle(
    bench: &Workbench<'_>,
    before: &Fit,
    after: &Fit,
    index: usize,
    gain: f64,
) -> Option<String> {
    small(bench, before, after, index, gain).or_else(|| at_end(bench, &after.model.members[index]))
}

/// The first two of these.
pub(super) fn small(
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
    if ahead_of_an_edge(&after.model, index) && chance(&before.residual, &after.residual) {
        return Some("shown only by readings that noise takes over the other's threshold".into());
    }
    if member.effect.remembers() {
        let error = bench.as_read(&after.residual);
        let (without, with) = without_memory(bench, &error, &as_read);
        if chance(&without, &with) {
            return Some("what it remembers shows no more than by chance beside a curve".into());
        }
    }
    let (gain, there) = if bench.is_white() || ahead_of_an_edge(&after.model, index) {
        size_beside(bench, &before.residual, &after.model, index)
    } else {
        (gain, there)
    };
    if gain < FLOOR && there < PLACE {
        return Some(format!(
            "real, but takes only {} of the held-out error ({} where it acts), below the practical floor of {}",
            precise_percent(gain),
            precise_percent(there),
            precise_percent(FLOOR)
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

/// Whether noise that takes what one effect gives over an edge of another one makes readings jump: at a rail nothing jumps.
fn ahead_of_an_edge(model: &Model, index: usize) -> bool {
    let mut others = model.members.iter().enumerate();
    let at_an_edge = |effect: &dyn Effect| effect.cuts() && effect.card().stage != Stage::Rail;
    others.any(|(other, member)| other != index && at_an_edge(member.effect))
}

/// Whether single readings make up a gain: the sum of what their squared errors fall by is less than so many times the root of
/// the sum of its squares, which is what it would vary by if each fell or rose by chance. Noise that takes a reading over a
/// threshold changes it by all of the step, for better or for worse.
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

/// Whether a value that may stand at the upper end of its search does. What lies beyond is not looked at: the recording tells only that it is
/// that or more.
pub fn stands_at_top(bench: &Workbench<'_>, member: &Member, p: usize) -> bool {
    let parameter = &member.effect.card().parameters[p];
    let (_, high) = member.effect.bounds(p, &bench.scale);
    parameter.search == Search::Logarithmic
        && (parameter.open || parameter.to_top)
        && !parameter.internal
        && member.values[p] >= 0.99 * high
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
        // A rail that is not there is at no end.
        if value >= member.effect.endless(p, &bench.scale) && value != parameter.off {
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
pub(super) fn apart(bench: &Workbench<'_>, one: &[f64], other: &[f64]) -> f64 {
    let change = change(one, other);
    let change = bench.as_read(&change);
    dot(&change, &change)
}

/// Energy by which the other effects' equations may be off, those of the model file among them: as idealisations, and as far as what
/// is left of the readings allows.
pub(super) fn beside(bench: &Workbench<'_>, fit: &Fit, index: usize) -> f64 {
    let members = &fit.model.members;
    let others: f64 = (0..members.len())
        .filter(|other| *other != index)
        .map(|other| {
            let share = members[other].effect.idealised();
            // What readings show by themselves is as they show it.
            if share == 0.0 || bench.mark(members[other].effect).is_some() {
                return 0.0;
            }
            let without = bench.run(&fit.model.without(other));
            share * share * apart(bench, &fit.predicted, &without)
        })
        .sum();
    let idealised = bench.modelled + others;
    if idealised == 0.0 {
        return 0.0;
    }
    idealised.min(left_along(bench, fit))
}

/// The most energy by which equations may be off along one effect, for what is left shows none of it: a wrong equation is not off along
/// that effect alone. Without a bound where no noise is stated, or one with a memory is.
fn left_along(bench: &Workbench<'_>, fit: &Fit) -> f64 {
    if bench.problem.coloured.rms > 0.0 || bench.problem.noise <= 0.0 {
        return f64::INFINITY;
    }
    let allowed = allowed(bench, unavoidable(bench, fit, DRAWN));
    let left = dot(&fit.residual, &fit.residual) - allowed;
    ALONG * left.max((STATED - 1.0) * allowed)
}

/// Whether a model owes what it gains to the alignment of samples that its effect sets free, and not to the effect.
pub(super) fn only_aligns(bench: &Workbench<'_>, before: &Fit, after: &Fit, index: usize) -> bool {
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
