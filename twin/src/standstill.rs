//! Noise that a signal shows while it stands still.
//!
//! A drive has stretches in which the current does not move: all that readings differ by there is noise, or what the current does from
//! one row to the next.

use std::ops::Range;

use crate::problem::{Drive, Series};

/// Recorded rows that are looked at together.
const WINDOW: usize = 8;
/// Noise has half its squared steps as variance (von Neumann 1941, *Ann. Math. Statist.* 12, 367), and in eight rows hardly ever less
/// than this share of it.
const WHITE: f64 = 0.3;
/// Share of the windows whose largest variance is the first guess of the noise: a standstill is among the quietest.
const QUIETEST: f64 = 0.05;
/// Eight readings of noise have more than so many times its variance once in a thousand (chi-squared of 7: 24.3/7).
const CHANCE: f64 = 3.5;
/// Median of the variance of eight readings of noise, over its mean (chi-squared of 7: 6.346/7).
const MEDIAN: f64 = 0.9066;
/// The guess follows from the median of all windows that it allows, so often.
const GUESSES: usize = 3;
/// A current stands still where it moves by less than this share of what it moves by in all.
const STILL: f64 = 0.05;
/// Readings belong to a standstill up to so many standard deviations from its mean.
const WITHIN: f64 = 3.0;
/// Variance of noise over that of what is left of it within three standard deviations: 1/(1 − 6·φ(3)/(2·Φ(3) − 1)) of a normal
/// distribution.
const MISSED: f64 = 1.0274;

/// What a reference does in a window.
struct Window {
    sum: f64,
    variance: f64,
    /// Half the mean of the squared steps from one recorded row to the next.
    of_steps: f64,
}

impl Window {
    fn of(values: &[f64]) -> Self {
        let count = values.len() as f64;
        let sum: f64 = values.iter().sum();
        let mean = sum / count;
        let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
        let steps = values.windows(2).map(|pair| (pair[1] - pair[0]).powi(2));
        Self {
            sum,
            variance: squares / (count - 1.0),
            of_steps: 0.5 * steps.sum::<f64>() / (count - 1.0),
        }
    }

    /// Whether it moves as noise does, from row to row and by no more.
    fn is_white(&self) -> bool {
        self.variance > 0.0 && self.of_steps > WHITE * self.variance
    }
}

/// Standard deviation of readings at a standstill, of stretches of readings that follow one another; `None` if they move too little
/// apart from it for that to be noise.
pub fn noise(stretches: &[Vec<f64>]) -> Option<f64> {
    let windows = stretches
        .iter()
        .flat_map(|stretch| stretch.as_chunks::<WINDOW>().0);
    let white = windows
        .map(|window| Window::of(window))
        .filter(Window::is_white);
    let variance = quietest(white.map(|window| window.variance).collect())?;
    let all = || stretches.iter().flatten();
    let count = all().count() as f64;
    let mean = all().sum::<f64>() / count;
    let moved = all().map(|value| (value - mean).powi(2)).sum::<f64>() / count;
    (variance < STILL.powi(2) * moved).then(|| variance.sqrt())
}

/// A reference with the mean in place of each of its readings at a standstill.
pub struct Evened {
    /// The reference.
    pub reference: Series,
    /// Rows of the drive in each standstill.
    pub standstills: Vec<Range<usize>>,
    /// Variance of the recorded readings there about the means.
    pub variance: f64,
}

/// A drive's reference without the noise that its standstills show; `None` if they show none.
pub fn evened(drive: &Drive) -> Option<Evened> {
    let stride = drive.stride();
    let recorded = |rows: &Range<usize>| -> Vec<f64> {
        drive.reference[rows.clone()]
            .iter()
            .step_by(stride)
            .copied()
            .collect()
    };
    let stretches: Vec<Vec<f64>> = drive.segments.iter().map(recorded).collect();
    let noise = noise(&stretches)?;
    let within = WITHIN * noise;
    let together = within / (WINDOW as f64).sqrt();
    let mut values = drive.reference.to_vec();
    let (mut standstills, mut readings, mut squares) = (Vec::new(), 0, 0.0);
    for (segment, stretch) in drive.segments.iter().zip(&stretches) {
        let mut from = 0;
        while let Some(first_ones) = stretch.get(from..from + WINDOW) {
            let window = Window::of(first_ones);
            if !window.is_white() || window.variance > CHANCE * noise.powi(2) {
                from += 1;
                continue;
            }
            // It lasts for as long as neither a reading nor the last few together leave it by more than noise.
            let (mut to, mut sum, mut last) = (from + WINDOW, window.sum, window.sum);
            while let (Some(value), Some(first)) = (stretch.get(to), stretch.get(to - WINDOW)) {
                let mean = sum / (to - from) as f64;
                last += value - first;
                let of_last = last / WINDOW as f64;
                if (value - mean).abs() > within || (of_last - mean).abs() > together {
                    break;
                }
                sum += value;
                to += 1;
            }
            let mean = sum / (to - from) as f64;
            squares += stretch[from..to]
                .iter()
                .map(|value| (value - mean).powi(2))
                .sum::<f64>();
            let rows = segment.start + from * stride..segment.start + (to - 1) * stride + 1;
            values[rows.clone()].fill(mean);
            standstills.push(rows);
            readings += to - from;
            from = to;
        }
    }
    // Each mean has taken one of its readings' freedom, and the standstills end where noise would be louder.
    let free = (readings - standstills.len()) as f64;
    (free > 0.0).then(|| Evened {
        reference: values.into(),
        standstills,
        variance: MISSED * squares / free,
    })
}

/// Variance at a standstill, of that of windows.
fn quietest(mut sizes: Vec<f64>) -> Option<f64> {
    sizes.sort_unstable_by(f64::total_cmp);
    let mut guess = *sizes.get((QUIETEST * sizes.len() as f64) as usize)?;
    for _ in 0..GUESSES {
        let allowed = sizes.partition_point(|size| *size <= CHANCE * guess);
        guess = sizes[allowed / 2] / MEDIAN;
    }
    Some(guess)
}
