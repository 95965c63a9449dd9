//! RC branches after the ohmic step.

use super::scene::{Scale, Scene};
use super::{Card, Clues, Effect, IDEALISED, Parameter, Search, Stage, spaced};
use crate::problem::{Problem, View};

/// One to three branches: one id, and as many parameters as branches need.
#[derive(Debug)]
pub struct Polarisation {
    card: &'static Card,
}

/// Up to `r1_ohm`, `tau1_s`.
pub static ONE_BRANCH: Polarisation = Polarisation { card: &CARDS[0] };
/// Up to `r2_ohm`, `tau2_s`.
pub static TWO_BRANCHES: Polarisation = Polarisation { card: &CARDS[1] };
/// Up to `r3_ohm`, `tau3_s`.
pub static THREE_BRANCHES: Polarisation = Polarisation { card: &CARDS[2] };

static PARAMETERS: [Parameter; 6] = [
    Parameter::new("r1_ohm", "Ω", 0.0, Search::Linear),
    Parameter::new("tau1_s", "s", 1.0, Search::Logarithmic).open(),
    Parameter::new("r2_ohm", "Ω", 0.0, Search::Linear),
    Parameter::new("tau2_s", "s", 10.0, Search::Logarithmic).open(),
    Parameter::new("r3_ohm", "Ω", 0.0, Search::Linear),
    Parameter::new("tau3_s", "s", 100.0, Search::Logarithmic).open(),
];

static CARDS: [Card; 3] = [
    card(PARAMETERS.as_slice().split_at(2).0),
    card(PARAMETERS.as_slice().split_at(4).0),
    card(PARAMETERS.as_slice()),
];

const fn card(parameters: &'static [Parameter]) -> Card {
    Card {
        id: "polarisation",
        statement: "The voltage goes on falling after the ohmic step and recovers after it: RC branches that the simulation lacks.",
        equation: "v = −Σₖ rₖ·iₖ, τₖ·diₖ/dt + iₖ = k·i; k: R/R25 as of temperature and state of charge (resistance-temperature, cell-self-heating, resistance-soc), 1 without them",
        parameters,
        shows: "relaxation after steps",
        looks_like: &["diffusion", "ocv-hysteresis"],
        separated_by: "pulses with rests of several lengths, sampled faster than the shortest time constant",
        stage: Stage::BatteryVoltage,
    }
}

impl Effect for Polarisation {
    fn card(&self) -> &'static Card {
        self.card
    }

    fn applies(&self, problem: &Problem) -> bool {
        problem.view == View::Voltage
    }

    fn bounds(&self, parameter: usize, scale: &Scale) -> (f64, f64) {
        if parameter.is_multiple_of(2) {
            (0.0, 50.0 * scale.resistance_ohm)
        } else {
            (scale.step_s, 3.0 * scale.span_s)
        }
    }

    fn starts(&self, scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        let r = 0.1 * scale.resistance_ohm;
        let taus = spaced(3.0 * scale.step_s, 0.5 * scale.span_s, 7);
        match self.card.parameters.len() {
            2 => taus.into_iter().map(|tau| vec![r, tau]).collect(),
            4 => [(1, 3), (1, 4), (2, 4), (2, 5), (3, 5)]
                .map(|(a, b)| vec![r, taus[a], r, taus[b]])
                .to_vec(),
            _ => [(0, 2, 4), (1, 3, 5), (1, 3, 6)]
                .map(|(a, b, c)| vec![r, taus[a], r, taus[b], r, taus[c]])
                .to_vec(),
        }
    }

    /// Branches stand for a distributed process, whose resistance changes over a drive by some ten percent either way.
    fn idealised(&self) -> f64 {
        2.0 * IDEALISED
    }

    /// Of several branches every slow voltage without overshoot can be made.
    fn general(&self) -> bool {
        self.card.parameters.len() > 2
    }

    fn ordered(&self, values: &mut [f64]) {
        let branches = values.as_chunks_mut::<2>().0;
        branches.sort_by(|[_, one_s], [_, other_s]| one_s.total_cmp(other_s));
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let (drive, steps) = (scene.drive, scene.steps.clone());
        let Some(battery) = &mut scene.battery else {
            return;
        };
        let driven: Vec<f64> = scene
            .signal
            .iter()
            .zip(&battery.factor)
            .map(|(i, factor)| i * factor)
            .collect();
        let segments = &drive.operations();
        let outside = (&battery.driven_over_gaps()[..], battery.driven_before());
        let v = match *values {
            [r1, tau1] => steps.ladder(segments, &driven, outside, [tau1], [r1]),
            [r1, tau1, r2, tau2] => {
                steps.ladder(segments, &driven, outside, [tau1, tau2], [r1, r2])
            }
            [r1, tau1, r2, tau2, r3, tau3] => {
                steps.ladder(segments, &driven, outside, [tau1, tau2, tau3], [r1, r2, r3])
            }
            _ => return,
        };
        battery
            .added_v
            .iter_mut()
            .zip(v)
            .for_each(|(added, v)| *added -= v);
    }
}
