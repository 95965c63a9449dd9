//! Sensor output and converter reference do not follow the supply alike.

use super::scene::{Scale, Scene};
use super::{Card, Clues, Effect, Parameter, Search, Stage, sensing};
use crate::problem::{Base, Problem};

/// Supply for which the sensor is rated, in V.
const NOMINAL_V: f64 = 5.0;
/// 2.5 V over the 2 V by which the output moves from zero to full scale (D0, D2: 0.5 … 4.5 V).
const HALF_SUPPLY_OVER_SPAN: f64 = 1.25;

/// See [`CARD`].
#[derive(Debug)]
pub struct SupplyRatiometric;

static CARD: Card = Card {
    id: "supply-ratiometric",
    statement: "The output of the sensor follows its supply and the reference of the converter does not, or the reverse: zero and sensitivity move with the supply.",
    equation: "y = i·(1 + (Vc/5 − 1)·ratio) + Z·(Vc/5 − 1)·ratio, Z = 1.25·full scale, the current that 2.5 V stand for; only where the full scale is known",
    parameters: &[Parameter::new("ratio", "1", 0.0, Search::Linear)],
    shows: "follows the supply of the sensor",
    looks_like: &["offset"],
    separated_by: "a sweep of the supply at a constant current",
    stage: Stage::Supply,
};

impl Effect for SupplyRatiometric {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn applies(&self, problem: &Problem) -> bool {
        // Without the full scale nobody knows what current the zero stands for, and that moves more than the sensitivity does.
        let ranged = matches!(&problem.base, Base::Sensor(sensor) if sensor.full_scale.is_some());
        sensing(problem) && problem.drive.supply_v.is_some() && ranged
    }

    fn columns(&self) -> &'static [&'static str] {
        &["v_supply_v"]
    }

    fn bounds(&self, _parameter: usize, _scale: &Scale) -> (f64, f64) {
        (-3.0, 3.0)
    }

    fn starts(&self, _scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        vec![vec![0.05]]
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let ratio = values[0];
        let drive = scene.drive;
        let zero = scene
            .sensor
            .and_then(|sensor| sensor.full_scale)
            .unwrap_or_default()
            * HALF_SUPPLY_OVER_SPAN;
        if let Some(supply) = &drive.supply_v {
            for (value, v) in scene.signal.iter_mut().zip(supply) {
                let moved = (v / NOMINAL_V - 1.0) * ratio;
                *value += (*value + zero) * moved;
            }
        }
    }
}
