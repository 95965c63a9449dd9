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

use crate::effects::{Effect, find_with};
use crate::problem::{Problem, View};

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
    /// Ids of the effects that make them so.
    pub effects: Vec<&'static str>,
}

/// The ends between which a signal was, the lower one first, in the view's unit; infinite where there is none.
type Within = [f64; 2];

/// Readings that do not come out of an effect of the model file.
#[derive(Clone)]
pub(super) struct Contradiction {
    /// The effect's id.
    pub effect: &'static str,
    /// How many there are.
    pub count: usize,
    /// The first one, in the view's unit.
    pub first: f64,
    /// Its place among those that count.
    pub at: usize,
}

impl Censored {
    /// Of a problem whose readings `y` count; `None` if the model file states no noise, or nothing that censors.
    ///
    /// # Errors
    /// Readings that do not come through that: then it is not as stated, or noise is added behind it.
    pub fn of(problem: &Problem, y: &[f64]) -> Result<Option<Self>, Contradiction> {
        if problem.view != View::Sensor || problem.noise <= 0.0 {
            return Ok(None);
        }
        let modelled = problem.modelled.iter();
        let mut ends: Vec<(&'static dyn Effect, &[f64])> = modelled
            .filter_map(|(id, values)| Some((find_with(id, values.len())?, values.as_slice())))
            .filter(|(effect, _)| effect.cuts())
            .collect();
        if ends.is_empty() {
            return Ok(None);
        }
        // From the reading back to the signal.
        ends.sort_by_key(|(effect, _)| std::cmp::Reverse(effect.card().place()));
        let grid = 0.5 * problem.observed.grid;
        let mut contradiction: Option<Contradiction> = None;
        let mut readings = Vec::with_capacity(y.len());
        for (at, &y) in y.iter().enumerate() {
            let off = grid + DIGITS * y.abs();
            let mut within = [y, y];
            for (effect, values) in &ends {
                let Some(before) = effect.came_of(values, within, off) else {
                    let first = || Contradiction {
                        effect: effect.card().id,
                        count: 0,
                        first: y,
                        at,
                    };
                    contradiction.get_or_insert_with(first).count += 1;
                    break;
                };
                within = before;
            }
            readings.push((y, (within[0] < within[1]).then_some(within)));
        }
        if let Some(contradiction) = contradiction {
            return Err(contradiction);
        }
        let any = readings.iter().any(|(_, within)| within.is_some());
        Ok(any.then_some(Self {
            noise: problem.noise,
            readings,
            effects: ends.iter().map(|(effect, _)| effect.card().id).collect(),
        }))
    }

    /// How many readings tell no more than within what the signal was.
    pub fn count(&self) -> usize {
        self.readings
            .iter()
            .filter(|(_, within)| within.is_some())
            .count()
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
    use crate::explain::predict;

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

    /// Readings of a sensor with these effects.
    fn behind(effects: &[(&'static str, Vec<f64>)], readings: Vec<f64>, noise: f64) -> Problem {
        let t_s: Vec<f64> = (0..readings.len()).map(|row| row as f64).collect();
        let mut problem = Problem::pair(t_s, readings.clone(), readings, noise);
        problem.modelled = effects.to_vec();
        problem
    }

    /// Behind all of them, at every place of the signal against their ends.
    #[test]
    fn a_true_simulation_is_off_by_nothing_in_the_mean_and_by_no_more_than_the_noise() {
        let (noise, count) = (1.0, 50_000);
        let rail = ("clipping", vec![9.0, f64::NEG_INFINITY]);
        let threshold = ("dead-band", vec![3.0]);
        let steps = ("quantisation", vec![2.0]);
        let chains = [
            vec![rail.clone(), threshold.clone()],
            vec![rail, threshold, steps.clone()],
            vec![steps],
        ];
        let mut random = ChaCha8Rng::seed_from_u64(1);
        for (effects, place) in chains
            .iter()
            .flat_map(|effects| (0..24).map(move |place| (effects, place)))
        {
            let signal = 0.5 * f64::from(place);
            let drawn = StandardNormal.sample_iter(&mut random).take(count);
            let noisy: Vec<f64> = drawn.map(|drawn: f64| signal + noise * drawn).collect();
            let ideal = behind(&[], noisy, noise);
            let readings = predict(&ideal, &named(effects));
            let problem = behind(effects, readings.clone(), noise);
            let censored = Censored::of(&problem, &readings).ok().flatten().unwrap();
            let compared = censored.as_compared(vec![signal; count]);
            let residuals = || readings.iter().zip(&compared).map(|(y, p)| y - p);
            let mean = residuals().sum::<f64>() / count as f64;
            let square = residuals().map(|r| r * r).sum::<f64>() / count as f64;
            let error = noise / (count as f64).sqrt();
            assert!(
                mean.abs() < 4.0 * error,
                "{mean} at {signal} behind {effects:?}"
            );
            let most = noise * noise * (1.0 + 4.0 * SQRT_2 / (count as f64).sqrt());
            assert!(square < most, "{square} at {signal} behind {effects:?}");
        }
    }

    fn named(effects: &[(&'static str, Vec<f64>)]) -> Vec<(String, Vec<f64>)> {
        let named = effects.iter();
        named
            .map(|(id, values)| ((*id).to_owned(), values.clone()))
            .collect()
    }

    #[test]
    fn what_a_reading_tells_is_within_the_ends_that_it_came_through() {
        let effects = [("clipping", vec![9.0, -9.0]), ("dead-band", vec![3.0])];
        let readings = vec![0.0, 5.0, 9.0, -9.0];
        let problem = behind(&effects, readings.clone(), 1.0);
        let censored = Censored::of(&problem, &readings).ok().flatten().unwrap();
        let within: Vec<_> = censored
            .readings
            .iter()
            .map(|(_, within)| *within)
            .collect();
        let infinite = f64::INFINITY;
        assert_eq!(
            within,
            [
                Some([-3.0, 3.0]),
                None,
                Some([9.0, infinite]),
                Some([-infinite, -9.0])
            ]
        );
        for (y, effect) in [(1.0, "dead-band"), (-2.6, "dead-band"), (9.1, "clipping")] {
            let found = Censored::of(&problem, &[0.0, y, y, 5.0]).err().unwrap();
            assert_eq!((found.effect, found.count), (effect, 2));
            assert_eq!((found.first, found.at), (y, 1));
        }
    }
}
