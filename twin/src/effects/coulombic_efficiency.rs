//! Charge that does not come back.

use super::scene::{Scale, Scene};
use super::{Card, Clues, Effect, Parameter, Search, Stage, counting};
use crate::problem::Problem;

/// What comes back at least: of lithium-ion cells 0.99 and more once they are formed, of lead–acid and nickel–metal hydride, charged
/// to what they can be charged to on a drive, 0.9 and more (Linden's Handbook of Batteries). Less is a drift by another name.
const LEAST: f64 = 0.9;
/// No more comes back than was put in, but for what the instrument's two directions differ by.
const MOST: f64 = 1.005;

/// See [`CARD`].
#[derive(Debug)]
pub struct CoulombicEfficiency;

static CARD: Card = Card {
    id: "coulombic-efficiency",
    statement: "A part of the charge put in does not come back.",
    equation: "dSoC/dt = −i·η/Q for charge (i < 0), −i/Q for discharge",
    parameters: &[Parameter::new("efficiency", "1", 1.0, Search::Linear)],
    shows: "charging only",
    looks_like: &["offset", "parasitic-load"],
    separated_by: "several charges and discharges against a rest voltage",
    stage: Stage::BatteryCharge,
};

impl Effect for CoulombicEfficiency {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn applies(&self, problem: &Problem) -> bool {
        counting(problem) && problem.drive.reference.iter().any(|i| *i < 0.0)
    }

    fn bounds(&self, _parameter: usize, _scale: &Scale) -> (f64, f64) {
        (LEAST, MOST)
    }

    fn starts(&self, _scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        vec![vec![0.99]]
    }

    fn unlikely(&self, values: &[f64]) -> Option<&'static str> {
        (values[0] > 1.0).then_some("no more charge comes back than was put in")
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        if let Some(battery) = &mut scene.battery {
            battery.efficiency = values[0];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_than_was_put_in_does_not_come_back() {
        assert_eq!(CoulombicEfficiency.unlikely(&[0.99]), None);
        assert_eq!(CoulombicEfficiency.unlikely(&[1.0]), None);
        let why = CoulombicEfficiency.unlikely(&[1.002]);
        assert_eq!(why, Some("no more charge comes back than was put in"));
    }
}
