//! Remanence of the magnetic core.

use plant::magnetic_core::{MagneticCore, MagneticCoreConfig, MagneticCoreState};

use super::scene::{Scale, Scene};
use super::{Card, Clues, Effect, IDEALISED, Parameter, STRAIGHT, Search, Stage, sensing, spaced};
use crate::problem::Problem;

/// A core with an air gap, a closed one, or one that adds its magnetisation: one id, and as many parameters as each needs.
#[derive(Debug)]
pub struct CoreHysteresis {
    card: &'static Card,
    form: Form,
}

/// What the core's memory does to the reading.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Form {
    /// The core's own magnetic potential is lacking in it.
    Gapped,
    /// The sign of what flowed is kept, the middle of the branches is calibrated.
    Closed,
    /// The same as [`Form::Gapped`] with loops that are rounded, and do not close; or the other way round.
    Dragged,
    /// The magnetisation is added, with all of its branches.
    Added,
}

/// With an air gap: follows each turn of the current.
pub static GAPPED: CoreHysteresis = CoreHysteresis {
    card: &CARDS[0],
    form: Form::Gapped,
};
/// Without: remembers the sign of what flowed.
pub static CLOSED: CoreHysteresis = CoreHysteresis {
    card: &CARDS[1],
    form: Form::Closed,
};
/// With rounded loops.
pub static DRAGGED: CoreHysteresis = CoreHysteresis {
    card: &CARDS[3],
    form: Form::Dragged,
};
/// A magnetisation beside what is measured: a magnet's remanence in a shield, a concentrator, a housing.
pub static ADDED: CoreHysteresis = CoreHysteresis {
    card: &CARDS[2],
    form: Form::Added,
};

static PARAMETERS: [Parameter; 5] = [
    Parameter::new("remanence_a", "A", 0.0, Search::Linear),
    Parameter::new("coercivity_a", "A", 1.0, Search::Logarithmic).above_nothing(),
    Parameter::new("spread", "1", 1.0, Search::Logarithmic)
        .open()
        .above_nothing(),
    Parameter::new("scatter", "1", 1.0, Search::Logarithmic).open(),
    BEFORE,
];
static DRAGGING: [Parameter; 4] = [
    Parameter::new("remanence_a", "A", 0.0, Search::Linear),
    Parameter::new("coercivity_a", "A", 1.0, Search::Logarithmic).above_nothing(),
    Parameter::new("beta", "1", 0.5, Search::Logarithmic)
        .open()
        .above_nothing(),
    BEFORE,
];
/// What it had kept when the recording began, as a share of the remanence. Only the first rows show it, so no other block foretells it:
/// it is tried, not followed by a slope.
const BEFORE: Parameter = Parameter::internal("before", "1", 0.0, Search::Stepped);

static CARDS: [Card; 4] = [
    card(GAPPED_EQUATION, PARAMETERS.as_slice().split_at(2).0),
    card(CLOSED_EQUATION, PARAMETERS.as_slice().split_at(3).0),
    card(ADDED_EQUATION, PARAMETERS.as_slice()),
    card(DRAGGED_EQUATION, DRAGGING.as_slice()),
];

const GAPPED_EQUATION: &str = "y = i − w·Σₖ stopₖ(i), stops at cₖ = (0.5, 0.75, 1, 1.25, 1.5)·coercivity (Prandtl–Ishlinskii), w so that remanence is left after a swing to full range and back";
const CLOSED_EQUATION: &str = "y = i + w·Σₖ (relayₖ(i) − ramp(i, sₖ)), sₖ = spread·cₖ, cₖ = (0.5, 0.75, 1, 1.25, 1.5)·coercivity; relayₖ = ramp(i − cₖ, sₖ) after −cₖ − sₖ, ramp(i + cₖ, sₖ) after cₖ + sₖ (from one to the other over the last eighth); ramp(x, s) = min(max(x/s, −1), 1) (Preisach: a closed core); w so that remanence is left after a swing to full range and back";
const DRAGGED_EQUATION: &str = "y = i − remanence·z, dz/di = (1 − abs(z)·(beta·sgn(z·di) + 1 − beta))/c (Bouc–Wen), c = coercivity·(2·beta − 1)/ln(2·beta)";
/// The fullest form speaks for all of them in the table.
const ADDED_EQUATION: &str = "y = i + w·Σₖ S(playₖ(i)/(spread·coercivity)), playₖ of half width coercivity·exp(scatter·zₖ), zₖ: eight quantiles of a normal distribution, S(x) = (3x − x³)/2 up to ±1 (Preisach: a magnetisation that is added); w so that remanence is left after saturation. Without scatter: y = i + w·Σₖ (relayₖ(i) − ramp(i, sₖ)), sₖ = spread·cₖ, cₖ = (0.5, 0.75, 1, 1.25, 1.5)·coercivity, relayₖ = ramp(i ∓ cₖ, sₖ) after ∓(cₖ + sₖ) (Preisach: a closed core). Without spread, a core with a gap: y = i − w·Σₖ stop(i, ±cₖ) (Prandtl–Ishlinskii); with beta, one whose loops are round and do not close: y = i − remanence·z, dz/di = (1 − abs(z)·(beta·sgn(z·di) + 1 − beta))/c, c = coercivity·(2·beta − 1)/ln(2·beta) (Bouc–Wen)";

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

impl Effect for CoreHysteresis {
    fn card(&self) -> &'static Card {
        self.card
    }

    fn near(&self, values: &[f64], _scale: &Scale, share: f64) -> Option<Vec<Vec<f64>>> {
        self.beginning().map(|before| {
            [5.0 * share, -5.0 * share]
                .map(|step| {
                    let mut near = values.to_vec();
                    near[before] += step;
                    near
                })
                .to_vec()
        })
    }

    /// What a file begins with is its own: anything from one remanence to the other.
    fn turn(&self, _values: &[f64]) -> Option<f64> {
        self.beginning().map(|_| 2.0)
    }

    fn remembers(&self) -> bool {
        matches!(self.form, Form::Dragged | Form::Added)
    }

    fn beginning(&self) -> Option<usize> {
        self.card.parameters.iter().position(|p| p.internal)
    }

    /// Of loops without time there are a few, and signs of their blocks are no placebos for shapes as free as the last two.
    fn applies(&self, problem: &Problem) -> bool {
        sensing(problem) && !(self.remembers() && problem.quasi_static())
    }

    /// The sign that a relay keeps changes at once, where a turn of the current just reaches it.
    fn kinked(&self, parameter: usize) -> bool {
        matches!(self.form, Form::Closed | Form::Added) && (1..4).contains(&parameter)
    }

    fn alternative(&self) -> bool {
        self.form != Form::Gapped
    }

    /// A closed core's relays are of every size: one spread and one middle are a rough picture of them.
    fn idealised(&self) -> f64 {
        match self.form {
            Form::Closed => 2.0 * IDEALISED,
            _ => IDEALISED,
        }
    }

    /// Of a magnetisation the curve is as rough a picture as the memory is.
    fn curve(&self) -> f64 {
        match self.form {
            Form::Gapped | Form::Closed => STRAIGHT,
            Form::Dragged | Form::Added => 2.0 * STRAIGHT,
        }
    }

    fn consequences(&self, values: &[f64], _problem: &Problem) -> Vec<String> {
        let against = "The zero is off against what flowed before: a core that is compensated by too much, or another memory than that of a core.";
        (values[0] < 0.0)
            .then(|| against.to_owned())
            .into_iter()
            .collect()
    }

    fn bounds(&self, parameter: usize, scale: &Scale) -> (f64, f64) {
        if self.card.parameters[parameter].internal {
            return (-1.0, 1.0);
        }
        match parameter {
            // Or it is compensated, and by too much.
            0 if self.form == Form::Dragged => (-0.2 * scale.full_scale, 0.2 * scale.full_scale),
            // From what turns back as slowly as it came to an exponential, and somewhat beyond.
            2 if self.form == Form::Dragged => (0.05, 1.5),
            // A core keeps a field in the direction of what flowed.
            0 => (0.0, 0.2 * scale.full_scale),
            // A loop narrower than a hundredth of the range is no loop: it would follow the noise of the reference.
            1 => {
                let low = 1e-2 * scale.full_scale;
                let high = 0.5 * scale.full_scale;
                match self.form {
                    // A magnetisation that is hardly ever turned over is any zero that drifts.
                    Form::Added => (low, high.min(scale.both_ways).max(low)),
                    _ => (low, high),
                }
            }
            // From relays that switch at once to loops with no flat part.
            2 if self.form == Form::Closed => (0.1, 4.0),
            // From relays to a play without end.
            2 => (0.1, 10.0),
            // From relays that are all alike to ones of all sizes.
            _ => (0.05, 1.5),
        }
    }

    fn starts(&self, scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        let count = match self.form {
            Form::Gapped => 6,
            Form::Closed => 4,
            Form::Dragged => 5,
            Form::Added => 8,
        };
        let shapes: &[&[f64]] = match self.form {
            Form::Gapped => &[&[]],
            Form::Closed => &[&[1.0]],
            Form::Dragged => &[&[0.5, 0.0]],
            Form::Added => &[&[0.2, 0.1, 0.0], &[0.7, 0.35, 0.0], &[2.5, 0.5, 0.0]],
        };
        let narrow = (0.01 * scale.largest).max(1.01e-2 * scale.full_scale);
        let mut wide = (0.4 * scale.largest).max(2.0 * narrow);
        if self.form == Form::Added {
            wide = wide.min(0.9 * scale.both_ways);
            if wide <= narrow {
                return Vec::new();
            }
        }
        spaced(narrow, wide, count)
            .into_iter()
            .flat_map(|coercivity| {
                shapes.iter().map(move |shape| {
                    let mut start = vec![1e-3 * scale.full_scale, coercivity];
                    start.extend_from_slice(shape);
                    start
                })
            })
            .collect()
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        // The core comes round within full range; how far a recording goes is no property of it.
        let full_scale = scene
            .sensor
            .and_then(|sensor| sensor.full_scale)
            .unwrap_or(f64::INFINITY);
        let mut each = |add: &dyn Fn(&mut [f64])| {
            for rows in scene.drive.operations() {
                add(&mut scene.signal[rows]);
            }
        };
        match (self.form, values) {
            (Form::Gapped, &[remanence_a, coercivity_a]) => {
                let config = MagneticCoreConfig {
                    remanence_a,
                    coercivity_a,
                    ..MagneticCoreConfig::default()
                };
                let core = MagneticCore::new(&config, full_scale);
                each(&|signal| {
                    let mut state = MagneticCoreState::default();
                    for value in signal {
                        state = core.magnetise(&state, *value);
                        *value += core.zero_error_a(&state);
                    }
                });
            }
            (Form::Closed, &[remanence_a, coercivity_a, spread]) => {
                let relays = Relays::new(remanence_a, coercivity_a, spread);
                each(&|signal| relays.add(signal));
            }
            (Form::Dragged, &[remanence_a, coercivity_a, beta, before]) => {
                let drag = Drag::new(remanence_a, coercivity_a, beta);
                each(&|signal| drag.add(before.clamp(-1.0, 1.0), signal));
            }
            (Form::Added, &[remanence_a, coercivity_a, spread, scatter, before]) => {
                let plays = Plays::new(remanence_a, coercivity_a, spread, scatter);
                each(&|signal| plays.add(before.clamp(-1.0, 1.0), signal));
            }
            // Values come in the number that the card has.
            _ => {}
        }
    }
}

/// Relays of a closed core.
const RELAYS: usize = 5;
/// Relays that are worked out side by side.
const LANES: usize = RELAYS.next_multiple_of(2);
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
    let x = if x > 1.0 { 1.0 } else { x };
    if x < -1.0 { -1.0 } else { x }
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
        // Side by side and in pairs, beside an idle one, without a branch: short of the last part of its ramp a relay would be turned to
        // less than one end.
        let lanes = |of: &[f64; RELAYS]| -> [f64; LANES] {
            std::array::from_fn(|k| of.get(k).copied().unwrap_or(1.0))
        };
        let (thresholds_a, per_ramp) = (lanes(&self.thresholds_a), lanes(&self.per_ramp));
        let mut turned = [0.0; LANES];
        for value in signal {
            let here = *value;
            let mut kept = [0.0; LANES];
            for k in 0..LANES {
                let rising = ramp((here - thresholds_a[k]) * per_ramp[k]);
                let falling = ramp((here + thresholds_a[k]) * per_ramp[k]);
                let stays = |reached: f64| 2.0 * ramp((reached - STAYS) / (1.0 - STAYS)) - 1.0;
                let (up, down) = (stays(rising), -stays(-falling));
                let turn = if up > turned[k] { up } else { turned[k] };
                turned[k] = if down < turn { down } else { turn };
                kept[k] = 0.5 * ((rising + falling) + turned[k] * (falling - rising))
                    - ramp(here * per_ramp[k]);
            }
            let [a, b, c, d, e, _] = kept;
            let sum = 0.0 + a + b + c + d + e;
            *value += self.weight * sum;
        }
    }
}

/// Play operators of a magnetisation.
const PLAYS: usize = 8;
/// Middles of so many parts of a normal distribution that are equally likely: its quantiles at (k + ½)/8.
const QUANTILES: [f64; PLAYS] = [
    -1.534_12, -0.887_15, -0.488_78, -0.157_31, 0.157_31, 0.488_78, 0.887_15, 1.534_12,
];

/// A magnetisation that is added to the reading, after Preisach (see above): of relays that go up at b + c and down at b − c, with
/// coercivities c and the field b of their neighbours that are independent of each other (a density that is a product: Mayergoyz,
/// *Mathematical Models of Hysteresis*, 1991, ch. 1; Bertotti, *Hysteresis in Magnetism*, 1998, ch. 13). All relays of one c are a play
/// operator of half width c behind a curve that is the distribution of b (Brokate & Sprekels, *Hysteresis and Phase Transitions*,
/// 1996, ch. 2). Here ln c is normal, and b a parabola over ± spread·coercivity, so that the curve is a cubic. With little of both
/// it is one relay.
struct Plays {
    weight: f64,
    half_widths_a: [f64; PLAYS],
    per_a: f64,
}

/// From −1 to 1 over a width of one to each side, without an edge.
fn bend(x: f64) -> f64 {
    let x = if x > 1.0 { 1.0 } else { x };
    let x = if x < -1.0 { -1.0 } else { x };
    x * (1.5 - 0.5 * x * x)
}

impl Plays {
    fn new(remanence_a: f64, coercivity_a: f64, spread: f64, scatter: f64) -> Self {
        let half_widths_a = QUANTILES.map(|z| coercivity_a * (scatter * z).exp());
        let per_a = 1.0 / (spread * coercivity_a);
        // Back at 0 A, a play that has come from far above stands at its half width.
        let left: f64 = half_widths_a.iter().map(|c| bend(c * per_a)).sum();
        Self {
            weight: remanence_a / left,
            half_widths_a,
            per_a,
        }
    }

    /// Adds what the core keeps; `before` the first row it had kept a share of the remanence.
    fn add(&self, before: f64, signal: &mut [f64]) {
        // In units of the curve's width, side by side.
        let half_widths = self.half_widths_a.map(|c| c * self.per_a);
        let mut plays = half_widths.map(|c| before * c);
        for value in signal {
            let here = *value * self.per_a;
            let mut kept = [0.0; PLAYS];
            for k in 0..PLAYS {
                let (low, high) = (here - half_widths[k], here + half_widths[k]);
                let play = if plays[k] < low { low } else { plays[k] };
                plays[k] = if play > high { high } else { play };
                kept[k] = bend(plays[k]);
            }
            let [a, b, c, d, e, f, g, h] = kept;
            *value += self.weight * (((a + b) + (c + d)) + ((e + f) + (g + h)));
        }
    }
}

/// What drags behind the current (Bouc, 1967; Wen, *Journal of the Engineering Mechanics Division* 102 (1976) 249, exponent one): z
/// comes to ±1 over a path, without an end, and goes back by another slope; with beta = 1 it is Duhem's exponential (Coleman &
/// Hodgdon, *Journal of Applied Physics* 63 (1986), without a curve of its own), with beta = 0.5 it goes back in straight lines. It knows
/// of no turns before the last one, so loops do not close.
struct Drag {
    remanence_a: f64,
    per_a: f64,
    /// 1 − 2·beta.
    bent: f64,
}

/// (eˣᵘ − 1)/x, u where x is nothing.
fn grown(x: f64, u: f64) -> f64 {
    if x.abs() < 1e-9 {
        u
    } else {
        (x * u).exp_m1() / x
    }
}

/// −ln(1 + x·m)/x, −m where x is nothing: from m, below zero, so far to zero.
fn path_to_zero(x: f64, m: f64) -> f64 {
    if x.abs() < 1e-9 {
        -m
    } else {
        -(x * m).ln_1p() / x
    }
}

impl Drag {
    fn new(remanence_a: f64, coercivity_a: f64, beta: f64) -> Self {
        let bent = 1.0 - 2.0 * beta;
        Self {
            remanence_a,
            // An excursion of the coercive current to the other side and back takes the remanence away.
            per_a: path_to_zero(bent, -1.0) / coercivity_a,
            bent,
        }
    }

    /// Adds what the core keeps; `before` the first row it had kept a share of the remanence.
    fn add(&self, before: f64, signal: &mut [f64]) {
        let (mut last_a, mut z) = (0.0, -before);
        for value in signal {
            let moved = (*value - last_a) * self.per_a;
            last_a = *value;
            if moved != 0.0 {
                // Along the way that the current goes; each of the two parts of it is a linear equation.
                let (mut m, mut left) = (z * moved.signum(), moved.abs());
                if m < 0.0 {
                    let to_zero = path_to_zero(self.bent, m);
                    let here = left.min(to_zero);
                    m = if left < to_zero {
                        m + (1.0 + self.bent * m) * grown(self.bent, left)
                    } else {
                        0.0
                    };
                    left -= here;
                }
                if left > 0.0 {
                    m -= (1.0 - m) * (-left).exp_m1();
                }
                z = m * moved.signum();
            }
            *value -= self.remanence_a * z;
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
    fn a_magnetisation_remembers_what_was_large_and_forgets_what_was_small() {
        let plays = Plays::new(2.0, 20.0, 1.5, 0.4);
        let kept = |path: &[f64]| {
            let mut signal = path.to_vec();
            plays.add(0.0, &mut signal);
            signal[path.len() - 1] - path[path.len() - 1]
        };
        let near = |one: f64, other: f64| (one - other).abs() < 1e-9;
        // Remanence, whichever way it was magnetised; the coercive current takes about all of it away.
        assert!(near(kept(&[600.0, 0.0]), 2.0) && near(kept(&[-600.0, 0.0]), -2.0));
        assert!(kept(&[600.0, -20.0]).abs() < 0.3);
        // Return point memory: a loop within a loop leaves no trace; a larger swing wipes out the smaller ones.
        assert!(near(kept(&[600.0, -9.0, 14.0, -9.0]), kept(&[600.0, -9.0])));
        assert!(near(kept(&[30.0, -25.0, 600.0, 5.0]), kept(&[600.0, 5.0])));
    }

    #[test]
    fn a_drag_follows_its_equation() {
        for beta in [0.3, 0.5, 0.8, 1.0] {
            let (remanence_a, coercivity_a) = (2.0, 20.0);
            let path = [0.0, 35.0, 30.0, -12.0, 4.0, -300.0, -275.0, -620.0, -600.0];
            let mut signal = path.to_vec();
            Drag::new(remanence_a, coercivity_a, beta).add(0.0, &mut signal);
            let c = if beta == 0.5 {
                coercivity_a
            } else {
                coercivity_a * (2.0 * beta - 1.0) / f64::ln(2.0 * beta)
            };
            let (mut z, mut at) = (0.0f64, 0.0);
            for (value, to) in signal.iter().zip(path) {
                let di = (to - at) / 1e5;
                for _ in 0..100_000 {
                    z += di / c * (1.0 - z.abs() * (beta * (z * di).signum() + 1.0 - beta));
                }
                at = to;
                assert!((value - (to - remanence_a * z)).abs() < 1e-3, "{beta} {to}");
            }
            // The coercive current after the turn nothing of it is left.
            assert!((signal[8] + 600.0).abs() < 1e-3, "{}", signal[8]);
        }
    }

    #[test]
    fn a_closed_core_leaves_the_remanence_that_it_says() {
        // A swing to full range and back through the relays' ramps, and to the other side by the coercive current.
        let relays = Relays::new(3.0, 20.0, 1.2);
        let mut signal: Vec<f64> = (0..=200).map(f64::from).collect();
        signal.extend((0..=220).map(|k| 200.0 - f64::from(k)));
        relays.add(&mut signal);
        assert!((signal[401] - 3.0).abs() < 1e-9, "{}", signal[401]);
    }
}
