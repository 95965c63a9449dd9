//! Resistance follows state of charge.

use super::scene::{Scale, Scene};
use super::{Card, Clues, Effect, IDEALISED, Parameter, Search, Stage};
use crate::problem::{Problem, View};

/// Towards empty, or towards either end: one id, and as many parameters as that needs.
#[derive(Debug)]
pub struct ResistanceSoc {
    card: &'static Card,
}

/// Towards empty.
pub static AT_EMPTY: ResistanceSoc = ResistanceSoc { card: &CARDS[0] };
/// Towards empty and towards full: the exchange current of an electrode goes with √(x·(1 − x)), x the share of its sites that are
/// taken (Doyle, Fuller, Newman 1993), and falls at both ends.
pub static AT_BOTH_ENDS: ResistanceSoc = ResistanceSoc { card: &CARDS[1] };

/// States of charge at which the rises usually begin: what a recording has to pass to tell one end from the other.
const USUAL_KNEE: f64 = 0.3;
const USUAL_KNEE_FULL: f64 = 0.8;
/// Least part of the charge over which a rise is one, and no single point of the table: of the low end, and of the high one.
const SHORTEST: f64 = 0.05;
const SHORTEST_FULL: f64 = 0.02;

static PARAMETERS: [Parameter; 4] = [
    Parameter::new("rise", "1", 0.0, Search::Linear),
    Parameter::new("knee_soc", "1", USUAL_KNEE, Search::Smooth)
        .within(0.0, 1.0)
        .open(),
    Parameter::new("rise_full", "1", 0.0, Search::Linear),
    Parameter::new("knee_full_soc", "1", USUAL_KNEE_FULL, Search::Smooth)
        .within(0.0, 1.0)
        .open(),
];

static CARDS: [Card; 2] = [
    card(PARAMETERS.as_slice().split_at(2).0),
    card(PARAMETERS.as_slice()),
];

const fn card(parameters: &'static [Parameter]) -> Card {
    Card {
        id: "resistance-soc",
        statement: "The resistance rises when the battery is nearly empty, or nearly full.",
        equation: "R(SoC) = R·(1 + rise·(1 − SoC/knee)) below the knee, R·(1 + rise_full·(SoC − knee_full)/(1 − knee_full)) above knee_full; rise_full: 0 without it",
        parameters,
        shows: "low state of charge, and the highest",
        looks_like: &["resistance-temperature"],
        separated_by: "pulses at several states of charge and one temperature",
        stage: Stage::BatteryResistance,
    }
}

impl Effect for ResistanceSoc {
    fn card(&self) -> &'static Card {
        self.card
    }

    fn applies(&self, problem: &Problem) -> bool {
        problem.view == View::Voltage
    }

    fn bounds(&self, parameter: usize, _scale: &Scale) -> (f64, f64) {
        match parameter {
            0 | 2 => (0.0, 30.0),
            1 => (SHORTEST, 1.0),
            _ => (0.0, 1.0 - SHORTEST_FULL),
        }
    }

    fn starts(&self, scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        let towards_empty = [0.15, 0.3, 0.5, 0.8].map(|knee| vec![0.1, knee]);
        if self.card.parameters.len() == 2 {
            return towards_empty.to_vec();
        }
        // Over a part of the charge a rise towards one end is a course like any other: of the temperature, or of a relaxation.
        let (low, high) = scale.soc;
        if low > USUAL_KNEE || high < USUAL_KNEE_FULL {
            return Vec::new();
        }
        towards_empty
            .iter()
            .flat_map(|empty| [0.7, 0.9].map(|knee| [empty.as_slice(), &[0.1, knee]].concat()))
            .collect()
    }

    /// Two straight lines for a curve.
    fn idealised(&self) -> f64 {
        2.0 * IDEALISED
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let (rise, knee) = (values[0], values[1]);
        let full = values.get(2).zip(values.get(3));
        if let Some(battery) = &mut scene.battery {
            for (factor, soc) in battery.factor.iter_mut().zip(&battery.soc) {
                // A cell may be little beyond empty or full: at a knee there nothing rises.
                if *soc < knee && knee > 0.0 {
                    *factor *= 1.0 + rise * (1.0 - soc / knee);
                }
                if let Some((rise, knee)) = full
                    && soc > knee
                    && *knee < 1.0
                {
                    *factor *= 1.0 + rise * (soc - knee) / (1.0 - knee);
                }
            }
        }
    }
}
