//! What a battery remembers when its recording begins.
//!
//! A log that was cut out of a drive begins under load, or not long after: branches and diffusion are not at rest then, and nobody recorded
//! what flowed before. One current that had flowed for long stands for it: exact for one branch, near for several.

use super::{AT_REST, Base, Problem, View};

/// A first row is under load from this share of the largest current on.
const LOADED: f64 = 0.02;
/// Readings of a first rest that tell whether the voltage still moves there, at least.
const FEWEST: usize = 10;
/// It moves if the means of the two halves differ by so many standard uncertainties.
const MOVES: f64 = 5.0;

impl Problem {
    /// Whether a battery's recording begins under load, or in a rest in which its voltage still moves.
    pub fn begins_loaded(&self) -> bool {
        if self.view != View::Voltage || !matches!(self.base, Base::Battery(_)) {
            return false;
        }
        let reference = &self.drive.reference;
        let largest = reference.iter().fold(0.0_f64, |most, i| most.max(i.abs()));
        let rests = reference
            .iter()
            .take_while(|i| i.abs() <= AT_REST * largest);
        match rests.count() {
            0 => reference
                .first()
                .is_some_and(|i| i.abs() >= LOADED * largest),
            rows => self.moves_until(self.drive.t_s[rows - 1]),
        }
    }

    /// Whether the readings up to a time move by more than noise.
    fn moves_until(&self, end_s: f64) -> bool {
        let observed = &self.observed;
        let rows = (0..observed.t_s.len()).take_while(|row| observed.t_s[*row] <= end_s);
        let read: Vec<f64> = rows
            .filter(|row| observed.valid[*row])
            .map(|row| observed.value[row])
            .collect();
        let half = read.len() / 2;
        if read.len() < FEWEST {
            return false;
        }
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        let moved = (mean(&read[half..]) - mean(&read[..half])).abs();
        // Of noise that has a memory a mean knows no less.
        let mean_noise = if self.coloured.rms > 0.0 {
            self.noise
        } else {
            let squares: f64 = read
                .windows(2)
                .map(|pair| (pair[1] - pair[0]).powi(2))
                .sum();
            let seen = (squares / (2.0 * (read.len() - 1) as f64)).sqrt();
            self.noise.max(seen) / (half as f64).sqrt()
        };
        moved > MOVES * std::f64::consts::SQRT_2 * mean_noise
    }

    /// The same, what flowed before being open, if it begins so: as uncertain as a current of the recording is, beside none.
    pub fn with_open_begin(&self) -> Self {
        let mut open = self.clone();
        if self.begins_loaded()
            && let Base::Battery(base) = &mut open.base
        {
            let squares: f64 = self.drive.reference.iter().map(|i| i * i).sum();
            base.before_sigma_a = (squares / self.drive.len() as f64).sqrt();
        }
        open
    }
}
