//! Coarser steps.

use super::scene::{Scale, Scene, rounded};
use super::{Card, Clues, Effect, Mark, Parameter, Search, Stage};
use crate::problem::{Problem, View};
use crate::range::range;

/// See [`CARD`].
#[derive(Debug)]
pub struct Quantisation;

static CARD: Card = Card {
    id: "quantisation",
    statement: "The reading moves in steps that are coarser than assumed.",
    equation: "y = step·round(i/step)",
    parameters: &[Parameter::new("step_a", "A", 0.0, Search::Stepped)],
    shows: "staircase, bounded error",
    looks_like: &["dead-band"],
    separated_by: "a slow ramp of the current",
    stage: Stage::Step,
};

impl Effect for Quantisation {
    fn card(&self) -> &'static Card {
        &CARD
    }

    /// A counter's step is of charge and its remainder is kept: rounding a mean current would lose that.
    fn applies(&self, problem: &Problem) -> bool {
        problem.view == View::Sensor
    }

    fn bounds(&self, _parameter: usize, scale: &Scale) -> (f64, f64) {
        (0.0, 0.5 * scale.full_scale)
    }

    fn starts(&self, scale: &Scale, clues: &Clues<'_>) -> Vec<Vec<f64>> {
        // What the readings show by themselves is no choice.
        if let Some(mark) = self.mark(scale, clues) {
            return vec![mark.values];
        }
        // Noise behind the staircase hides the grid of the readings: the residual still goes with the stairs.
        by_correlation(clues, scale)
            .map(|step| vec![step])
            .into_iter()
            .collect()
    }

    fn mark(&self, scale: &Scale, clues: &Clues<'_>) -> Option<Mark> {
        let step = lattice(clues.observed).filter(|step| *step > 1.5 * scale.quantum)?;
        let [low, high] = range(clues.observed.iter().copied())?;
        Some(Mark {
            values: vec![step],
            // Over all of the readings the grid stays in step.
            within: vec![IN_STEP * step * step / (high - low).max(step)],
            // Evenly spread over a step.
            variance: step * step / 12.0,
            what: "lie on a grid",
        })
    }

    fn cuts(&self) -> bool {
        true
    }

    fn came_of(&self, values: &[f64], [low, high]: [f64; 2], _off: f64) -> Option<[f64; 2]> {
        let step = values[0];
        let steps = 0.5 * (low + high) / step;
        if step <= 0.0 {
            Some([low, high])
        } else if (steps - steps.round()).abs() > OFF_GRID {
            None
        } else {
            Some([low - 0.5 * step, high + 0.5 * step])
        }
    }

    fn rounds(&self) -> bool {
        true
    }

    /// Behind a staircase noise takes readings off its levels.
    fn noise_ahead(&self, values: &[f64], clues: &Clues<'_>) -> bool {
        let known = || clues.observed.iter().copied().filter(|y| y.is_finite());
        lattice(clues.observed).is_some() || concentration(known(), values[0]) > ON_GRID
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let step = values[0];
        if step > 0.0 {
            scene
                .signal
                .iter_mut()
                .for_each(|value| *value = step * rounded(*value / step));
        }
    }
}

/// Readings that are looked at.
const ENOUGH: usize = 4000;
/// Concentration from which on values are on a grid: what is off it is less than a twentieth of a step.
const ON_GRID: f64 = 0.95;
/// Readings lie on a grid if they are off it by no more than this share of a step.
const OFF_GRID: f64 = 0.1;
/// A grid is told to this share of a step over the span of the readings.
const IN_STEP: f64 = 0.1;
/// A gap is this share off the step at most.
const OFF: f64 = 0.2;
/// Sums that are kept side by side.
const LANES: usize = 8;

/// Step of a grid on which nearly all readings lie, in any order; `None` if there is none.
pub(crate) fn lattice(observed: &[f64]) -> Option<f64> {
    let mut sorted: Vec<f64> = observed
        .iter()
        .copied()
        .filter(|value| value.is_finite())
        .collect();
    sorted.sort_unstable_by(f64::total_cmp);
    sorted.dedup();
    // A grid repeats values.
    if sorted.len() < 4 || sorted.len() * 3 > observed.len() {
        return None;
    }
    grid(&sorted)
}

/// The step of a grid on which nearly all of some values lie, which ascend: two on it differ by its step or a multiple.
pub(crate) fn grid(sorted: &[f64]) -> Option<f64> {
    if sorted.len() < 2 {
        return None;
    }
    let mut gaps: Vec<f64> = sorted.windows(2).map(|pair| pair[1] - pair[0]).collect();
    gaps.sort_unstable_by(f64::total_cmp);
    let least = gaps[gaps.len() / 20];
    let span = sorted[sorted.len() - 1] - sorted[0];
    let concentration = |step: f64| concentration(sorted.iter().copied(), step);
    // The gap is known to rounding only: over the span the grid has to stay in step.
    let fine = IN_STEP * least / span.max(least);
    let best = (-200..=200)
        .map(|k| f64::from(k) * fine)
        // Half of a step is a grid of the same readings: a coarse one must not be led there.
        .filter(|share| share.abs() < OFF)
        .map(|share| least * (1.0 + share))
        .max_by(|a, b| concentration(*a).total_cmp(&concentration(*b)));
    best.filter(|step| concentration(*step) > ON_GRID)
}

/// How well values keep to a grid of a step, 0 … 1: the mean of unit vectors at their place within a step.
fn concentration(values: impl Iterator<Item = f64>, step: f64) -> f64 {
    let (mut cosine, mut sine, mut count) = (0.0, 0.0, 0.0);
    for value in values {
        let turns = value / step * std::f64::consts::TAU;
        cosine += turns.cos();
        sine += turns.sin();
        count += 1.0;
    }
    f64::hypot(cosine, sine) / f64::max(count, 1.0)
}

/// The step whose staircase goes best with the residual.
fn by_correlation(clues: &Clues<'_>, scale: &Scale) -> Option<f64> {
    let stride = clues.observed.len().div_ceil(ENOUGH).max(1);
    let (residuals, simulated): (Vec<f64>, Vec<f64>) = clues
        .observed
        .iter()
        .zip(clues.predicted)
        .step_by(stride)
        .map(|(y, p)| (y - p, *p))
        .filter(|(residual, p)| residual.is_finite() && p.is_finite())
        .unzip();
    let energy: f64 = residuals.iter().map(|residual| residual * residual).sum();
    let rms = (energy / residuals.len().max(1) as f64).sqrt();
    // A staircase of step s has an error of s/√12 rms: the step is no larger than this.
    let largest = 1.3 * rms * 12f64.sqrt();
    let smallest = (0.15 * largest).max(1.5 * scale.quantum);
    if !(smallest > 0.0 && largest > smallest && scale.largest > 0.0) {
        return None;
    }
    let mut best = (0.0, None);
    let mut step = smallest;
    while step < largest {
        let (along, size) = staircase(&residuals, &simulated, step);
        if size > 0.0 && along / size.sqrt() > best.0 {
            best = (along / size.sqrt(), Some(step));
        }
        // A quarter of a step at the far end.
        step *= 1.0 + (0.25 * step / scale.largest).clamp(2e-4, 0.02);
    }
    best.1
}

/// Product of the residual with what a staircase changes of the simulation, and the square of that; in lanes.
fn staircase(residuals: &[f64], simulated: &[f64], step: f64) -> (f64, f64) {
    /// Added and taken away again, it leaves a number rounded (to even at a tie).
    const ROUND: f64 = 1.5 * (1u64 << 52) as f64;
    let (mut along, mut size) = ([0.0; LANES], [0.0; LANES]);
    let per_step = 1.0 / step;
    let mut add = |residuals: &[f64], simulated: &[f64]| {
        for (lane, (residual, p)) in residuals.iter().zip(simulated).enumerate() {
            let stair = step * ((p * per_step + ROUND) - ROUND) - p;
            along[lane] += residual * stair;
            size[lane] += stair * stair;
        }
    };
    let (residuals, left) = residuals.as_chunks::<LANES>();
    let (simulated, right) = simulated.as_chunks::<LANES>();
    for (residuals, simulated) in residuals.iter().zip(simulated) {
        add(residuals, simulated);
    }
    add(left, right);
    (along.iter().sum(), size.iter().sum())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_grid_of_few_levels_is_not_taken_for_one_of_half_steps() {
        for (step, levels) in [(5.396_040_7, 13), (15.7, 5), (0.05, 900)] {
            // As a recording has it: seven digits.
            let readings: Vec<f64> = (0..20 * levels)
                .map(|row| step * f64::from(row % (2 * levels) - levels))
                .map(|value| (value * 1e5).round() * 1e-5)
                .collect();
            let found = lattice(&readings);
            assert!(
                found.is_some_and(|found| (found / step - 1.0).abs() < 1e-4),
                "{found:?} for {step}"
            );
        }
    }
}
