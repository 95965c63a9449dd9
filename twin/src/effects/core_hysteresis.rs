//! Remanence of the magnetic core.

use plant::magnetic_core::{MagneticCore, MagneticCoreConfig, MagneticCoreState};

use super::scene::{Scale, Scene};
use super::{Card, Clues, Effect, Parameter, Search, Stage, spaced};

/// See [`CARD`].
#[derive(Debug)]
pub struct CoreHysteresis;

static CARD: Card = Card {
    id: "core-hysteresis",
    statement: "The magnetic core of the sensor keeps a field after a current: its zero depends on the sign and size of what flowed before.",
    equation: "y = i − w·Σₖ stopₖ(i), stops at (0.5, 0.75, 1, 1.25, 1.5)·coercivity (Prandtl–Ishlinskii), w so that remanence is left after a swing to full range and back",
    parameters: &[
        Parameter::new("remanence_a", "A", 0.0, Search::Linear),
        Parameter::new("coercivity_a", "A", 1.0, Search::Logarithmic),
    ],
    shows: "opposite sign on rising and falling branches, persists at 0 A",
    looks_like: &["lag", "offset"],
    separated_by: "a rest after a large discharge and a rest after a large charge",
    stage: Stage::Core,
};

impl Effect for CoreHysteresis {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn bounds(&self, parameter: usize, scale: &Scale) -> (f64, f64) {
        if parameter == 0 {
            // A core keeps a field in the direction of what flowed.
            (0.0, 0.2 * scale.full_scale)
        } else {
            (1e-3 * scale.full_scale, 0.5 * scale.full_scale)
        }
    }

    fn starts(&self, scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        spaced(0.01 * scale.largest, 0.4 * scale.largest, 6)
            .into_iter()
            .map(|coercivity| vec![1e-3 * scale.full_scale, coercivity])
            .collect()
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let largest = scene
            .drive
            .reference
            .iter()
            .fold(0.0f64, |most, value| most.max(value.abs()));
        let full_scale = scene
            .sensor
            .and_then(|sensor| sensor.full_scale)
            .unwrap_or(largest);
        let core = MagneticCore::new(
            &MagneticCoreConfig {
                remanence_a: values[0],
                coercivity_a: values[1],
                ..MagneticCoreConfig::default()
            },
            full_scale,
        );
        for rows in &scene.drive.segments {
            let mut state = MagneticCoreState::default();
            for value in &mut scene.signal[rows.clone()] {
                state = core.magnetise(&state, *value);
                *value += core.zero_error_a(&state);
            }
        }
    }
}
