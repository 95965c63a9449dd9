//! Resistances at temperatures that a recording does not have: they are as large as at the nearest that it has, times what temperature does
//! to usual cells. That they stay the same would be the one thing that no cell does.

use super::fit::{Fit, fit};
use super::select::beaten;
use super::told::short;
use super::workbench::{Member, Workbench};
use crate::effects::scene::{USUAL_B_K, arrhenius};
use crate::effects::{Effect, LIBRARY, Says, find_with};
use crate::problem::{Base, Drive, View};

/// Resistances that are taken to be other than where they are known are told from here on, in %.
const TOLD_PERCENT: f64 = 2.0;

/// The lowest and the highest temperature, in °C, between which the resistances of a battery with named effects are known from a recording
/// alone. `None` where that is not asked: the model says where they are known, or how they follow temperature; no temperature was
/// recorded; or the recording itself speaks against what is usual.
pub(super) fn found_at_c(bench: &Workbench<'_>, found: &Fit) -> Option<[f64; 2]> {
    let (problem, model) = (bench.problem, &found.model);
    let is_open = matches!(&problem.base, Base::Battery(base) if base.resistances_at_c.is_none())
        && problem.view == View::Voltage
        && !model.members.is_empty();
    let stated = problem.modelled.iter();
    let stated = stated.filter_map(|(id, values)| find_with(id, values.len()));
    let mut effects = model
        .members
        .iter()
        .map(|member| member.effect)
        .chain(stated);
    if !is_open || effects.any(by_temperature) {
        return None;
    }
    let at_c = problem.drive.battery_temperatures()?;
    let law = LIBRARY.into_iter().find(|effect| by_temperature(*effect))?;
    let mut usual = model.with(Member {
        effect: law,
        values: vec![USUAL_B_K],
    });
    usual.held = Some((model.members.len(), 0));
    (!beaten(bench, &fit(bench, &usual, None), found)).then_some(at_c)
}

/// Whether an effect says how resistances follow temperature.
pub fn by_temperature(effect: &dyn Effect) -> bool {
    effect.says() == Some(Says::ResistanceByTemperature)
}

/// What is taken of a recording's resistances where it is colder or warmer than what is known of them, in °C, if that matters.
pub fn beyond_known(drive: &Drive, known_at_c: [f64; 2]) -> Option<String> {
    let there_c = drive.battery_temperatures()?;
    let [low, high] = known_at_c;
    let factors =
        there_c.map(|t| arrhenius(USUAL_B_K, t) / arrhenius(USUAL_B_K, t.clamp(low, high)));
    let most = factors
        .into_iter()
        .max_by(|a, b| a.ln().abs().total_cmp(&b.ln().abs()))?;
    ((100.0 * (most - 1.0)).abs() >= TOLD_PERCENT).then(|| {
        format!(
            "its battery is at {} … {} °C, and what is known of the resistances is of {} … {} °C: beyond, they are taken to follow \
             temperature as is usual (Arrhenius, {USUAL_B_K} K), here to {} times",
            short(there_c[0]),
            short(there_c[1]),
            short(low),
            short(high),
            short(most)
        )
    })
}
