//! Hysteresis of the open-circuit voltage.

use super::scene::{Scale, Scene};
use super::{Card, Clues, Effect, Parameter, Search, Stage, spaced};
use crate::problem::{Problem, View};

/// Half of the widest gap between the branches of a common cell, in V: nickel–metal hydride; of lithium ion it is a tenth of that.
const LARGEST_V: f64 = 0.2;
/// Largest γ: the state follows the current within a five-thousandth of the capacity.
const FASTEST: f64 = 5000.0;
/// Times that the charge moved in a recording has to be the charge in which the state follows: then it comes to its end. A
/// state that does not is a drift with the charge, and nothing in the recording says that it is hysteresis.
const ENDS: f64 = 3.0;

/// Smallest γ with which the state comes to its end within the recording.
fn slowest(scale: &Scale) -> f64 {
    // No less than what was moved: the mean magnitude of a current is below its root mean square.
    let moved_ah = scale.rms * scale.span_s / 3600.0;
    ENDS * scale.capacity_ah / moved_ah.max(f64::MIN_POSITIVE)
}

/// See [`CARD`].
#[derive(Debug)]
pub struct OcvHysteresis;

static CARD: Card = Card {
    id: "ocv-hysteresis",
    statement: "The open-circuit voltage depends on the direction of the last charge throughput.",
    equation: "v = m·h, dh/dt = −γ·abs(i)/(3600·Q)·(h + sgn i) (Plett 2004)",
    parameters: &[
        Parameter::new("m_v", "V", 0.0, Search::Linear),
        Parameter::new("gamma", "1", 20.0, Search::Logarithmic),
    ],
    shows: "between charge and discharge branches, persists at rest",
    looks_like: &["polarisation", "diffusion"],
    separated_by: "rests after a discharge and after a charge to the same state of charge",
    stage: Stage::BatteryVoltage,
};

impl Effect for OcvHysteresis {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn applies(&self, problem: &Problem) -> bool {
        problem.view == View::Voltage
    }

    fn bounds(&self, parameter: usize, scale: &Scale) -> (f64, f64) {
        if parameter == 0 {
            (0.0, LARGEST_V)
        } else {
            (slowest(scale).min(FASTEST), FASTEST)
        }
    }

    fn starts(&self, scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        let slowest = slowest(scale);
        if slowest >= FASTEST {
            return Vec::new();
        }
        spaced(slowest.max(3.0), (2.0 * slowest).max(1000.0), 6)
            .into_iter()
            .map(|gamma| vec![0.005, gamma])
            .collect()
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let (m, gamma) = (values[0], values[1]);
        let drive = scene.drive;
        let Some(battery) = &mut scene.battery else {
            return;
        };
        let (signal, added_v) = (&scene.signal[..], &mut battery.added_v[..]);
        let per_as = gamma / (3600.0 * battery.capacity_ah);
        for rows in drive.operations() {
            let mut h = 0.0;
            for row in rows.skip(1) {
                let [from, to] = drive.ends(row, [signal[row - 1], signal[row]]);
                let i = 0.5 * (from + to);
                if i != 0.0 {
                    let target = -i.signum();
                    h = target
                        + (h - target)
                            * (-per_as * i.abs() * (drive.t_s[row] - drive.t_s[row - 1])).exp();
                }
                added_v[row] += m * h;
            }
        }
    }
}
