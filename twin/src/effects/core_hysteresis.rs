//! Remanence of the magnetic core.

use plant::magnetic_core::{MagneticCore, MagneticCoreConfig, MagneticCoreState};

use super::scene::{Scale, Scene};
use super::{Card, Clues, Effect, IDEALISED, Parameter, Search, Stage, spaced};

/// A core with an air gap, or a closed one: one id, and `spread` for the closed one.
#[derive(Debug)]
pub struct CoreHysteresis {
    card: &'static Card,
}

/// With an air gap: follows each turn of the current.
pub static GAPPED: CoreHysteresis = CoreHysteresis { card: &CARDS[0] };
/// Without: remembers the sign of what flowed.
pub static CLOSED: CoreHysteresis = CoreHysteresis { card: &CARDS[1] };

static PARAMETERS: [Parameter; 3] = [
    Parameter::new("remanence_a", "A", 0.0, Search::Linear),
    Parameter::new("coercivity_a", "A", 1.0, Search::Logarithmic),
    Parameter::new("spread", "1", 1.0, Search::Logarithmic).open(),
];

static CARDS: [Card; 2] = [
    card(
        "y = i − w·Σₖ stopₖ(i), stops at cₖ = (0.5, 0.75, 1, 1.25, 1.5)·coercivity (Prandtl–Ishlinskii), w so that remanence is left after a swing to full range and back",
        PARAMETERS.as_slice().split_at(2).0,
    ),
    card(
        "y = i + w·Σₖ (relayₖ(i) − ramp(i, sₖ)), sₖ = spread·cₖ, cₖ = (0.5, 0.75, 1, 1.25, 1.5)·coercivity; relayₖ = ramp(i − cₖ, sₖ) after −cₖ − sₖ, ramp(i + cₖ, sₖ) after cₖ + sₖ (from one to the other over the last eighth); ramp(x, s) = min(max(x/s, −1), 1) (Preisach: a closed core); without spread, a core with a gap: y = i − w·Σₖ stop(i, ±cₖ) (Prandtl–Ishlinskii); w so that remanence is left after a swing to full range and back",
        PARAMETERS.as_slice(),
    ),
];

const fn card(equation: &'static str, parameters: &'static [Parameter]) -> Card {
    Card {
        id: "core-hysteresis",
        statement: "The magnetic core of the sensor keeps a field after a current: its zero depends on the sign and size of what flowed before.",
        equation,
        parameters,
        shows: "opposite sign on rising and falling branches, persists at 0 A",
        looks_like: &["lag", "offset"],
        separated_by: "a rest after a large discharge and a rest after a large charge",
        stage: Stage::Core,
    }
}

impl CoreHysteresis {
    fn closed(&self) -> bool {
        self.card.parameters.len() > 2
    }
}

impl Effect for CoreHysteresis {
    fn card(&self) -> &'static Card {
        self.card
    }

    /// The sign that a relay keeps changes at once, where a turn of the current just reaches it.
    fn kinked(&self, parameter: usize) -> bool {
        self.closed() && parameter > 0
    }

    fn alternative(&self) -> bool {
        self.closed()
    }

    /// A closed core's relays are of every size: one spread and one middle are a rough picture of them.
    fn idealised(&self) -> f64 {
        if self.closed() {
            2.0 * IDEALISED
        } else {
            IDEALISED
        }
    }

    fn bounds(&self, parameter: usize, scale: &Scale) -> (f64, f64) {
        match parameter {
            // A core keeps a field in the direction of what flowed.
            0 => (0.0, 0.2 * scale.full_scale),
            // A loop narrower than a hundredth of the range is no loop: it would follow the noise of the reference.
            1 => (1e-2 * scale.full_scale, 0.5 * scale.full_scale),
            // From relays that switch at once to loops with no flat part.
            _ => (0.1, 4.0),
        }
    }

    fn starts(&self, scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        let count = if self.closed() { 4 } else { 6 };
        let narrow = (0.01 * scale.largest).max(1.01e-2 * scale.full_scale);
        spaced(narrow, (0.4 * scale.largest).max(2.0 * narrow), count)
            .into_iter()
            .map(|coercivity| {
                let mut start = vec![1e-3 * scale.full_scale, coercivity];
                if self.closed() {
                    start.push(1.0);
                }
                start
            })
            .collect()
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        if let &[remanence_a, coercivity_a, spread] = values {
            let relays = Relays::new(remanence_a, coercivity_a, spread);
            for rows in scene.drive.operations() {
                relays.add(&mut scene.signal[rows]);
            }
            return;
        }
        // The core comes round within full range; how far a recording goes is no property of it.
        let full_scale = scene
            .sensor
            .and_then(|sensor| sensor.full_scale)
            .unwrap_or(f64::INFINITY);
        let core = MagneticCore::new(
            &MagneticCoreConfig {
                remanence_a: values[0],
                coercivity_a: values[1],
                ..MagneticCoreConfig::default()
            },
            full_scale,
        );
        for rows in scene.drive.operations() {
            let mut state = MagneticCoreState::default();
            for value in &mut scene.signal[rows] {
                state = core.magnetise(&state, *value);
                *value += core.zero_error_a(&state);
            }
        }
    }
}

/// Relays of a closed core.
const RELAYS: usize = 5;
/// Their thresholds in units of the coercive current: those of the stops of a core with a gap, so that the name means the same.
const THRESHOLDS: [f64; RELAYS] = [0.5, 0.75, 1.0, 1.25, 1.5];

/// Up to here on its ramp a part of the core comes back with the current; from here to the end, ever less of it does. (At once, at
/// the end of the ramp, the reading would jump with the values of the model.)
const STAYS: f64 = 0.75;

/// A core without a gap as relays (Preisach, *Zeitschrift für Physik* 94 (1935) 277): each part of it turns over when the current
/// passes its threshold, over a ramp, and stays so until it has passed the threshold of the other side. No part knows where the
/// current turned in between: what the core keeps is the sign of what was large enough. The middle of the two branches is what the
/// sensor was calibrated to, and is taken off.
struct Relays {
    weight: f64,
    thresholds_a: [f64; RELAYS],
    per_ramp: [f64; RELAYS],
}

/// From −1 to 1, over a width of one to each side.
fn ramp(x: f64) -> f64 {
    x.clamp(-1.0, 1.0)
}

impl Relays {
    fn new(remanence_a: f64, coercivity_a: f64, spread: f64) -> Self {
        Self {
            // At 0 A each relay stands at ramp(1/spread).
            weight: remanence_a / (RELAYS as f64 * ramp(1.0 / spread)),
            thresholds_a: THRESHOLDS.map(|share| share * coercivity_a),
            per_ramp: THRESHOLDS.map(|share| 1.0 / (spread * share * coercivity_a)),
        }
    }

    /// Adds what the core keeps, from a demagnetised one on: half of its parts each way.
    fn add(&self, signal: &mut [f64]) {
        let mut turned = [0.0f64; RELAYS];
        for value in signal {
            let mut sum = 0.0;
            let relays = self.thresholds_a.iter().zip(&self.per_ramp);
            for (turned, (c, per)) in turned.iter_mut().zip(relays) {
                let rising = ramp((*value - c) * per);
                let falling = ramp((*value + c) * per);
                let stays = |reached: f64| 2.0 * ramp((reached - STAYS) / (1.0 - STAYS)) - 1.0;
                if rising > STAYS {
                    *turned = turned.max(stays(rising));
                }
                if falling < -STAYS {
                    *turned = turned.min(-stays(-falling));
                }
                sum +=
                    0.5 * ((rising + falling) + *turned * (falling - rising)) - ramp(*value * per);
            }
            *value += self.weight * sum;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_closed_core_keeps_its_remanence_until_the_other_sign_is_large_enough() {
        let relays = Relays::new(2.0, 20.0, 0.5);
        let mut signal = [0.0, 100.0, 0.0, 60.0, 0.0, -9.0, 0.0, -100.0, 0.0];
        relays.add(&mut signal);
        // Demagnetised, at full range, after it, after a smaller one, and after one that no relay feels.
        let expected = [0.0, 100.0, 2.0, 60.0, 2.0];
        for (value, expected) in signal.iter().zip(expected) {
            assert!((value - expected).abs() < 1e-12, "{signal:?}");
        }
        assert!((signal[6] - 2.0).abs() < 1e-12, "{signal:?}");
        assert!((signal[8] + 2.0).abs() < 1e-12, "{signal:?}");
    }

    #[test]
    fn both_forms_leave_the_remanence_that_they_say() {
        // A swing to full range and back through the relays' ramps, and to the other side by the coercive current.
        let relays = Relays::new(3.0, 20.0, 1.2);
        let mut signal: Vec<f64> = (0..=200).map(f64::from).collect();
        signal.extend((0..=220).map(|k| 200.0 - f64::from(k)));
        relays.add(&mut signal);
        assert!((signal[401] - 3.0).abs() < 1e-9, "{}", signal[401]);
    }
}
