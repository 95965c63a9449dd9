//! Readings that tell no more of the signal than within what it was: behind a threshold, steps or rails of the model file, with noise ahead
//! of them.
//!
//! Noise takes a reading near a threshold, or an edge between two steps, to either side of it, and the reading then jumps by all of the
//! threshold or the step: a simulation without noise that goes through the same is off by far more than the noise there, though
//! nothing is wrong. So the simulation is looked at ahead of them. What comes through as it is, is compared with that. Of another
//! reading all that is known is within what the signal was, and the simulation is off by what noise has to have done for that, in the
//! mean: the generalised residual of a censored normal regression (Tobin 1958, *Econometrica* 26, 24; Gourieroux, Monfort, Renault and
//! Trognon 1987, *J. Econometrics* 34, 5). Its mean over all readings is zero where the model is right, it is never louder than the
//! noise, and it says nothing where the simulation is well within.

use std::f64::consts::{PI, SQRT_2};

use crate::problem::{Problem, View};

/// The effects of the model file that make such readings.
pub(super) const EFFECTS: [&str; 3] = [THRESHOLD, STEPS, RAILS];
const THRESHOLD: &str = "dead-band";
const STEPS: &str = "quantisation";
const RAILS: &str = "clipping";
/// Readings lie on a grid if they are off it by no more than this share of a step.
const OFF_GRID: f64 = 0.1;
/// A threshold is as stated if no reading but zero is below this share of it: it is told by the few readings next to it.
const AS_STATED: f64 = 0.9;
/// Digits that a reading is written with, as a share of it.
const DIGITS: f64 = 1e-9;
/// From so many standard deviations beyond an end on a normal distribution's tail is taken as an exponential one: what that is off
/// by falls with the third power, and is 7e-5 standard deviations here.
const FAR: f64 = 30.0;

/// See the module.
#[derive(Clone)]
pub(super) struct Censored {
    /// Standard deviation of the noise, in the view's unit.
    noise: f64,
    /// Each reading that counts, in the view's unit, and within what the signal was, if that is all that it tells.
    readings: Vec<(f64, Option<Within>)>,
}

/// The ends between which a signal was, the lower one first, in the view's unit; infinite where there is none.
type Within = [f64; 2];

/// What the model file has at the end of the chain, in the view's unit.
struct Ends {
    threshold: f64,
    step: f64,
    /// High and low.
    rails: [f64; 2],
    /// How far a reading may be off what comes out of them.
    off: f64,
}

impl Ends {
    /// Of a problem; `None` if it has none.
    fn of(problem: &Problem) -> Option<Self> {
        let modelled = &problem.modelled;
        modelled.iter().find(|(id, _)| EFFECTS.contains(id))?;
        let value = |effect: &str, parameter: usize, otherwise: f64| {
            let found = modelled.iter().find(|(id, _)| *id == effect);
            let value = found.and_then(|(_, values)| values.get(parameter).copied());
            value.filter(|value| value.is_finite()).unwrap_or(otherwise)
        };
        let step = value(STEPS, 0, 0.0);
        Some(Self {
            threshold: value(THRESHOLD, 0, 0.0),
            step,
            rails: [
                value(RAILS, 0, f64::INFINITY),
                value(RAILS, 1, f64::NEG_INFINITY),
            ],
            off: 0.5 * step.max(problem.observed.grid),
        })
    }

    /// Within what the signal was that a reading is of: `Ok(None)` if that came through as it is, and an error if no signal makes
    /// such a reading.
    fn within(&self, y: f64) -> Result<Option<Within>, ()> {
        let off = self.off + DIGITS * y.abs();
        let [high, low] = self.rails;
        if y > high + off || y < low - off {
            return Err(());
        }
        let mut ends = [y, y];
        if self.step > 0.0 {
            let steps = y / self.step;
            if (steps - steps.round()).abs() > OFF_GRID {
                return Err(());
            }
            ends = [y - 0.5 * self.step, y + 0.5 * self.step];
        }
        if y.abs() <= off {
            ends = [ends[0].min(-self.threshold), ends[1].max(self.threshold)];
        } else if y.abs() < AS_STATED * self.threshold - off {
            return Err(());
        }
        if y > high - off {
            ends[1] = f64::INFINITY;
        }
        if y < low + off {
            ends[0] = f64::NEG_INFINITY;
        }
        Ok((ends[0] < ends[1]).then_some(ends))
    }
}

impl Censored {
    /// Of a problem whose readings `y` count. `None` if the model file states no noise, or nothing that censors; and if the readings are
    /// not what comes through that: then it is not as stated, or the noise is behind it.
    pub fn of(problem: &Problem, y: &[f64]) -> Option<Self> {
        if problem.view != View::Sensor || problem.noise <= 0.0 {
            return None;
        }
        let ends = Ends::of(problem)?;
        let readings: Result<Vec<_>, ()> = y.iter().map(|y| Ok((*y, ends.within(*y)?))).collect();
        let readings = readings.ok()?;
        let any = readings.iter().any(|(_, within)| within.is_some());
        any.then_some(Self {
            noise: problem.noise,
            readings,
        })
    }

    /// What readings are compared with, row by row, of a simulation ahead of what censors.
    pub fn as_compared(&self, mut simulation: Vec<f64>) -> Vec<f64> {
        for (value, (y, within)) in simulation.iter_mut().zip(&self.readings) {
            if let Some(within) = within {
                *value = y + kept_back(*value, *within, self.noise);
            }
        }
        simulation
    }
}

/// By how much noise has to have taken a signal back, in the mean, if that came out within these ends: −E(N) of a normal N of a standard
/// deviation with low < signal + N < high. All in one unit.
fn kept_back(signal: f64, [low, high]: Within, noise: f64) -> f64 {
    // Seen from the end that is nearer: how far beyond it the signal is, and how far beyond the other one, in standard deviations.
    let (beyond_low, beyond_high) = ((low - signal) / noise, (signal - high) / noise);
    let (near, sign) = if beyond_high > beyond_low {
        (beyond_high, 1.0)
    } else {
        (beyond_low, -1.0)
    };
    let wide = (high - low) / noise;
    let far = near + wide;
    let back = if near > FAR {
        let ends = near * wide;
        // Ever less of a tail reaches the far end.
        let beyond = if ends < FAR * FAR {
            wide / ends.exp_m1()
        } else {
            0.0
        };
        near + 1.0 / near - beyond
    } else {
        let density = |x: f64| (-0.5 * x * x).exp() / (2.0 * PI).sqrt();
        let tail = |x: f64| 0.5 * libm::erfc(x / SQRT_2);
        (density(near) - density(far)) / (tail(near) - tail(far))
    };
    sign * back * noise
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use proptest::prelude::*;
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::SeedableRng as _;
    use rand_distr::{Distribution as _, StandardNormal};

    use super::*;

    proptest! {
        #[test]
        fn what_noise_took_back_is_between_the_least_and_the_most(
            low in -100.0f64..100.0,
            wide in prop_oneof![0.01f64..100.0, Just(f64::INFINITY)],
            noise in 0.01f64..100.0,
            signal in -1000.0f64..1000.0,
        ) {
            let within = [low, low + wide];
            let back = kept_back(signal, within, noise);
            let rounding = 1e-9 * (signal.abs() + low.abs() + noise);
            prop_assert!(back >= signal - within[1] - rounding, "{back}");
            prop_assert!(back <= signal - within[0] + rounding, "{back}");
            let other_side = kept_back(-signal, [-within[1], -within[0]], noise);
            prop_assert!((other_side + back).abs() <= rounding, "{back} and {other_side}");
            let more = kept_back(signal + 0.01 * noise, within, noise);
            prop_assert!(more >= back - rounding, "{back}, then {more}");
        }

        #[test]
        fn the_tail_goes_on_where_it_is_taken_as_exponential(
            wide in prop_oneof![0.01f64..100.0, Just(f64::INFINITY)],
            noise in 0.01f64..100.0,
        ) {
            let at = |near: f64| kept_back(near * noise, [-wide, 0.0], noise);
            let (before, after) = (at(FAR * (1.0 - 1e-9)), at(FAR * (1.0 + 1e-9)));
            prop_assert!((after - before).abs() < 1e-4 * noise, "{before} and {after}");
        }
    }

    /// Behind all three, at every place of the signal against their ends.
    #[test]
    fn a_true_simulation_is_off_by_nothing_in_the_mean_and_by_no_more_than_the_noise() {
        let ends = Ends {
            threshold: 3.0,
            step: 0.0,
            rails: [9.0, f64::NEG_INFINITY],
            off: 0.0,
        };
        let stepped = Ends {
            step: 2.0,
            rails: [10.0, f64::NEG_INFINITY],
            off: 1.0,
            ..ends
        };
        let (noise, count) = (1.0, 100_000);
        let mut random = ChaCha8Rng::seed_from_u64(1);
        for (ends, place) in [&ends, &stepped]
            .into_iter()
            .flat_map(|ends| (0..24).map(move |place| (ends, place)))
        {
            let signal = 0.5 * f64::from(place);
            let drawn = StandardNormal.sample_iter(&mut random).take(count);
            let (mut sum, mut squares) = (0.0, 0.0);
            for drawn in drawn {
                let drawn: f64 = drawn;
                let value = (signal + noise * drawn).min(ends.rails[0]);
                let value = if value.abs() < ends.threshold {
                    0.0
                } else {
                    value
                };
                let y = if ends.step > 0.0 {
                    ends.step * (value / ends.step).round()
                } else {
                    value
                };
                let residual = match ends.within(y).unwrap() {
                    Some(within) => -kept_back(signal, within, noise),
                    None => y - signal,
                };
                sum += residual;
                squares += residual * residual;
            }
            let (mean, square) = (sum / count as f64, squares / count as f64);
            let error = noise / (count as f64).sqrt();
            assert!(
                mean.abs() < 4.0 * error,
                "{mean} at {signal}, step {}",
                ends.step
            );
            let most = noise * noise * (1.0 + 4.0 * SQRT_2 / (count as f64).sqrt());
            assert!(square < most, "{square} at {signal}");
        }
    }

    #[test]
    fn a_reading_that_no_signal_makes_is_found() {
        let ends = Ends {
            threshold: 3.0,
            step: 0.0,
            rails: [9.0, -9.0],
            off: 0.0,
        };
        assert_eq!(ends.within(0.0), Ok(Some([-3.0, 3.0])));
        assert_eq!(ends.within(5.0), Ok(None));
        assert_eq!(ends.within(9.0), Ok(Some([9.0, f64::INFINITY])));
        assert_eq!(ends.within(-9.0), Ok(Some([f64::NEG_INFINITY, -9.0])));
        for y in [1.0, -2.6, 9.1] {
            assert_eq!(ends.within(y), Err(()), "{y}");
        }
    }
}
