//! The open-circuit voltage follows temperature.

use super::scene::{REFERENCE_C, Scale, Scene};
use super::{Card, Clues, Effect, Parameter, Search, Stage};
use crate::problem::{Problem, View};

/// Largest of a cell, in V/K: lithium-ion cells lie within ±0.8 mV/K at any state of charge (Viswanathan 2010), others within ±2.
const MOST_V_PER_K: f64 = 0.002;

/// See [`CARD`].
#[derive(Debug)]
pub struct Entropic;

static CARD: Card = Card {
    id: "entropic",
    statement: "The open-circuit voltage moves with temperature (entropy of the reaction).",
    equation: "v = dOCV/dT·(T − 25 °C)",
    parameters: &[Parameter::new("v_per_k", "V/K", 0.0, Search::Linear)],
    shows: "follows temperature at rest",
    looks_like: &["ocv-hysteresis"],
    separated_by: "a rest while the temperature changes",
    stage: Stage::BatteryVoltage,
};

impl Effect for Entropic {
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
        (-MOST_V_PER_K, MOST_V_PER_K)
    }

    fn starts(&self, _scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        vec![vec![1e-4]]
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        if let Some(battery) = &mut scene.battery {
            for (added, t) in battery.added_v.iter_mut().zip(&battery.temperature_c) {
                *added += values[0] * (t - REFERENCE_C);
            }
        }
    }
}
