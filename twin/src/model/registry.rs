//! The effects that a model file may hold, and the names of their parameters.

use crate::effects::{Effect, LIBRARY, Parameter, Stage};

fn all(id: &str) -> impl Iterator<Item = &'static dyn Effect> {
    LIBRARY
        .iter()
        .copied()
        .filter(move |effect| effect.card().id == id)
}

/// An effect's id, and the sets of parameters that it comes with (polarisation has one, two or three branches).
pub fn find(id: &str) -> Option<(&'static str, Vec<&'static [Parameter]>)> {
    let known = all(id).next()?.card().id;
    Some((
        known,
        all(id).map(|effect| effect.card().parameters).collect(),
    ))
}

/// Ids in the order of the documentation.
pub fn ids() -> Vec<&'static str> {
    crate::effects::ids()
}

/// Whether it changes a battery's voltage alone, and not its charge.
pub fn of_voltage(id: &str) -> bool {
    all(id).any(|effect| effect.card().stage > Stage::BatteryCharge)
}

/// Whether it acts on the battery and not on the sensing chain.
pub fn of_battery(id: &str) -> bool {
    all(id).any(|effect| effect.card().stage >= Stage::BatteryCharge)
}
