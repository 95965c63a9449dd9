//! Resistance follows temperature.

use super::scene::{Scale, Scene};
use super::{Card, Clues, Effect, Parameter, Says, Search, Stage};
use crate::problem::{Problem, View};

/// See [`CARD`].
#[derive(Debug)]
pub struct ResistanceTemperature;

static CARD: Card = Card {
    id: "resistance-temperature",
    statement: "The resistance rises in the cold (Arrhenius).",
    equation: "R(T) = R25·exp(B·(1/T − 1/298.15 K))",
    parameters: &[Parameter::new("b_k", "K", 0.0, Search::Smooth)],
    shows: "cold",
    looks_like: &["resistance-soc"],
    separated_by: "the same drive at two temperatures",
    stage: Stage::BatteryTemperature,
};

impl Effect for ResistanceTemperature {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn applies(&self, problem: &Problem) -> bool {
        problem.view == View::Voltage
            && (problem.drive.cell_temperature_c.is_some() || problem.drive.ambient_c.is_some())
    }

    fn columns(&self) -> &'static [&'static str] {
        &["temp_cell_c", "temp_ambient_c"]
    }

    fn bounds(&self, _parameter: usize, _scale: &Scale) -> (f64, f64) {
        // A conductor that is a part of it rises with temperature by 0.4 %/K, that is −350 K.
        // The most: 80 kJ/mol; charge transfer of lithium-ion cells has 50 … 70.
        (-500.0, 10_000.0)
    }

    fn starts(&self, _scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        vec![vec![300.0], vec![2000.0], vec![5000.0]]
    }

    fn says(&self) -> Option<Says> {
        Some(Says::ResistanceByTemperature)
    }

    /// Over the tens of kelvin of a recording the law holds within a percent.
    fn idealised(&self) -> f64 {
        0.01
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        if let Some(battery) = &mut scene.battery {
            battery.arrhenius_k = Some(values[0]);
        }
    }
}
