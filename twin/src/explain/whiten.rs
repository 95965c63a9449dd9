//! Noise with a memory made white: of each reading, what the noise of those before it foretells is taken out.
//!
//! The model file states white noise beside noise whose correlation falls exponentially (an Ornstein–Uhlenbeck process). A Kalman
//! filter of that process gives each reading's innovation, and least squares of innovations is generalised least squares (Durbin
//! and Koopman 2012, *Time Series Analysis by State Space Methods*, section 4.3): quick effects show through slow noise, and slow
//! noise is not taken for a slow effect. The filter is linear, so it is applied to readings and simulations alike.

use crate::problem::Coloured;

/// What the filter does at a row.
#[derive(Clone, Copy, Debug)]
struct Step {
    /// Share of the slow noise's estimate that is left since the row before.
    kept: f64,
    /// Share of an innovation that is slow noise.
    gain: f64,
    /// Makes the innovation as loud as the noise of one reading.
    scale: f64,
}

/// The filter for the rows of one recording.
#[derive(Clone, Debug)]
pub struct Whitening {
    steps: Vec<Step>,
}

impl Whitening {
    /// For readings at these times, with noise of `noise` rms of which `coloured` is the part with a memory; `None` if there is no
    /// such part.
    pub fn new(t_s: &[f64], noise: f64, coloured: Coloured) -> Option<Self> {
        if !(coloured.rms > 0.0 && coloured.tau_s > 0.0 && noise > 0.0) {
            return None;
        }
        let slow = coloured.rms.powi(2);
        // Two readings of one moment differ by something.
        let white = (noise.powi(2) - slow).max(1e-6 * noise.powi(2));
        let mut variance = slow;
        let mut before = f64::NAN;
        let steps = t_s
            .iter()
            .map(|&t| {
                // The first row, and a clock that starts anew, know nothing of what was before.
                let kept = if t >= before {
                    ((before - t) / coloured.tau_s).exp()
                } else {
                    0.0
                };
                variance = kept * kept * variance + slow * (1.0 - kept * kept);
                let innovation = variance + white;
                let gain = variance / innovation;
                variance *= 1.0 - gain;
                before = t;
                Step {
                    kept,
                    gain,
                    scale: noise / innovation.sqrt(),
                }
            })
            .collect();
        Some(Self { steps })
    }

    /// Takes out of each value what those before it foretell; white noise of the stated loudness remains of the stated noise.
    pub fn apply(&self, series: &mut [f64]) {
        let mut slow = 0.0;
        for (value, step) in series.iter_mut().zip(&self.steps) {
            slow *= step.kept;
            let new = *value - slow;
            slow += step.gain * new;
            *value = step.scale * new;
        }
    }

    /// The series that [`Whitening::apply`] made this one of.
    pub fn undo(&self, series: &mut [f64]) {
        let mut slow = 0.0;
        for (value, step) in series.iter_mut().zip(&self.steps) {
            slow *= step.kept;
            let new = *value / step.scale;
            *value = slow + new;
            slow += step.gain * new;
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::SeedableRng as _;
    use rand_distr::{Distribution as _, StandardNormal};

    const NOISE: f64 = 0.5;
    const COLOURED: Coloured = Coloured {
        rms: 0.45,
        tau_s: 2.0,
    };

    /// Uneven rows, with a gap and a clock that starts anew.
    fn times(rows: usize) -> Vec<f64> {
        (0..rows)
            .map(|row| {
                let t_s = 0.05 * row as f64 + 0.02 * (row % 3) as f64;
                match row {
                    _ if row >= rows / 2 => t_s - 0.05 * (rows / 2) as f64,
                    _ if row >= rows / 3 => t_s + 40.0,
                    _ => t_s,
                }
            })
            .collect()
    }

    fn noise(t_s: &[f64], seed: u64) -> Vec<f64> {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut normal = || -> f64 { StandardNormal.sample(&mut random) };
        let white = (NOISE.powi(2) - COLOURED.rms.powi(2)).sqrt();
        let mut slow = 0.0;
        let mut before = f64::INFINITY;
        t_s.iter()
            .map(|&t| {
                let kept = if t >= before {
                    (-(t - before) / COLOURED.tau_s).exp()
                } else {
                    0.0
                };
                slow = kept * slow + COLOURED.rms * (1.0 - kept * kept).sqrt() * normal();
                before = t;
                slow + white * normal()
            })
            .collect()
    }

    #[test]
    fn stated_noise_becomes_white_and_as_loud_as_stated() {
        let t_s = times(20_000);
        let mut series = noise(&t_s, 1);
        Whitening::new(&t_s, NOISE, COLOURED)
            .unwrap()
            .apply(&mut series);
        let count = series.len() as f64;
        let rms = (series.iter().map(|v| v * v).sum::<f64>() / count).sqrt();
        // Four standard errors of 20,000 values.
        assert!(
            (rms / NOISE - 1.0).abs() < 4.0 / (2.0 * count).sqrt(),
            "{rms}"
        );
        for lag in 1..=60 {
            let products = series.iter().zip(&series[lag..]).map(|(a, b)| a * b);
            let likeness = products.sum::<f64>() / count / rms.powi(2);
            assert!(likeness.abs() < 4.5 / count.sqrt(), "{lag}: {likeness}");
        }
    }

    #[test]
    fn it_can_be_undone() {
        let t_s = times(500);
        let whitening = Whitening::new(&t_s, NOISE, COLOURED).unwrap();
        let series: Vec<f64> = t_s.iter().map(|t| (0.7 * t).sin() + 3.0).collect();
        let mut there = series.clone();
        whitening.apply(&mut there);
        whitening.undo(&mut there);
        for (a, b) in series.iter().zip(&there) {
            assert!((a - b).abs() < 1e-9, "{a} {b}");
        }
    }

    #[test]
    fn products_are_those_with_the_inverse_of_the_covariance() {
        // Generalised least squares by its definition, on few rows.
        let t_s = times(60);
        let whitening = Whitening::new(&t_s, NOISE, COLOURED).unwrap();
        let white = NOISE.powi(2) - COLOURED.rms.powi(2);
        let segment = |row: usize| usize::from(row >= 30);
        let covariance = nalgebra::DMatrix::from_fn(60, 60, |a, b| {
            let apart = (t_s[a] - t_s[b]).abs();
            let slow = if segment(a) == segment(b) {
                COLOURED.rms.powi(2) * (-apart / COLOURED.tau_s).exp()
            } else {
                0.0
            };
            slow + if a == b { white } else { 0.0 }
        });
        let x = nalgebra::DVector::from_fn(60, |row, _| (0.3 * row as f64).cos() + 1.0);
        let expected = x.dot(&covariance.cholesky().unwrap().solve(&x));
        let mut series: Vec<f64> = x.iter().copied().collect();
        whitening.apply(&mut series);
        let found = series.iter().map(|v| v * v).sum::<f64>() / NOISE.powi(2);
        assert!((found / expected - 1.0).abs() < 1e-9, "{found} {expected}");
    }

    #[test]
    fn noise_without_a_memory_needs_none() {
        let none = Coloured::default();
        assert!(Whitening::new(&[0.0, 1.0], NOISE, none).is_none());
    }
}
