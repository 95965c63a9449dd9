//! Saturation of the magnetic core.

use plant::magnetic_core::{MagneticCore, MagneticCoreConfig};

use super::scene::{Scale, Scene};
use super::{BENT, Card, Clues, Effect, Parameter, Search, Stage};

/// See [`CARD`].
#[derive(Debug)]
pub struct CoreSaturation;

static CARD: Card = Card {
    id: "core-saturation",
    statement: "The magnetic core of the sensor saturates: beyond a knee the reading falls short, smoothly.",
    equation: "y = i for abs(i) < knee; beyond: sgn(i)·(knee + e/(1 + e/(softness·knee))), e = abs(i) − knee (Fröhlich–Kennelly)",
    parameters: &[
        Parameter::new("knee_a", "A", f64::INFINITY, Search::Logarithmic).bends_at_once(),
        Parameter::new("softness", "1", 1.0, Search::Logarithmic).ends_far_away(),
    ],
    shows: "beyond the knee only",
    looks_like: &["gain", "clipping"],
    separated_by: "currents well beyond the knee, of both signs",
    stage: Stage::Saturation,
};

impl Effect for CoreSaturation {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn bounds(&self, parameter: usize, scale: &Scale) -> (f64, f64) {
        if parameter == 0 {
            (0.02 * scale.largest, 1.05 * scale.largest)
        } else {
            // Softer than a corner: a hard limit is no core.
            (0.2, 20.0)
        }
    }

    fn starts(&self, scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        [0.4, 0.6, 0.75, 0.85, 0.93]
            .into_iter()
            .flat_map(|share| [0.2, 1.0, 4.0].map(|softness| vec![share * scale.largest, softness]))
            .collect()
    }

    fn kinked(&self, parameter: usize) -> bool {
        parameter == 0
    }

    fn curve(&self) -> f64 {
        BENT
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let core = MagneticCore::new(
            &MagneticCoreConfig {
                knee_a: values[0],
                softness: values[1],
                ..MagneticCoreConfig::default()
            },
            values[0],
        );
        scene
            .signal
            .iter_mut()
            .for_each(|value| *value = core.saturated_a(*value));
    }
}
