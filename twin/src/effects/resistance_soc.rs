//! Resistance follows state of charge.

use super::scene::{Scale, Scene};
use super::{Card, Clues, Effect, IDEALISED, Parameter, Search, Stage};
use crate::problem::{Problem, View};

/// See [`CARD`].
#[derive(Debug)]
pub struct ResistanceSoc;

static CARD: Card = Card {
    id: "resistance-soc",
    statement: "The resistance rises when the battery is nearly empty.",
    equation: "R(SoC) = R·(1 + rise·(1 − SoC/knee)) below the knee",
    parameters: &[
        Parameter::new("rise", "1", 0.0, Search::Linear),
        Parameter::new("knee_soc", "1", 0.3, Search::Smooth)
            .within(0.0, 1.0)
            .open(),
    ],
    shows: "low state of charge",
    looks_like: &["resistance-temperature"],
    separated_by: "pulses at several states of charge and one temperature",
    stage: Stage::BatteryResistance,
};

impl Effect for ResistanceSoc {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn applies(&self, problem: &Problem) -> bool {
        problem.view == View::Voltage
    }

    fn bounds(&self, parameter: usize, _scale: &Scale) -> (f64, f64) {
        if parameter == 0 {
            (0.0, 30.0)
        } else {
            (0.05, 1.0)
        }
    }

    fn starts(&self, _scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        [0.15, 0.3, 0.5, 0.8].map(|knee| vec![0.1, knee]).to_vec()
    }

    /// Two straight lines for a curve.
    fn idealised(&self) -> f64 {
        2.0 * IDEALISED
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let (rise, knee) = (values[0], values[1]);
        if let Some(battery) = &mut scene.battery {
            for (factor, soc) in battery.factor.iter_mut().zip(&battery.soc) {
                if *soc < knee {
                    *factor *= 1.0 + rise * (1.0 - soc / knee);
                }
            }
        }
    }
}
