//! Spectra of residuals, which are sampled irregularly and have gaps: put on an even grid first, gaps as zero, long ones shortened.

use std::borrow::Cow;

use rustfft::{FftPlanner, num_complex::Complex};

/// A spectral line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Line {
    /// Frequency in Hz.
    pub frequency_hz: f64,
    /// Amplitude of the sine.
    pub amplitude: f64,
    /// Phase of the sine at the first of the times.
    pub phase_rad: f64,
}

/// A step of more than this many usual ones, and as many times either neighbour, is a gap: a log that slows down in a rest has none.
const GAP_STEPS: f64 = 10.0;
/// Gaps are shortened if they are longer, together, than this many times the rest, …
const LONG: f64 = 4.0;
/// … to this many times the rest.
const SHORTENED: f64 = 2.0;
/// Longest grid.
const MOST: usize = 1 << 20;
/// Frequencies to each side that a line is compared with.
const NEIGHBOURS: usize = 60;
/// A line as strong as this is found by chance once in a thousand recordings.
const CHANCE: f64 = 1e-3;
/// Lines that are returned.
const LINES: usize = 3;

/// Times as they are put on a grid: what is spent on it is to follow the readings, and not the days between two drives. Gaps that
/// are long beside all readings are shortened, by whole steps, so that readings stay where they are within one. Over such a gap no
/// line keeps its phase; a fit finds the one it has behind it from the phase ahead of it. A clock that begins anew begins as it does.
pub fn laid_out(t_s: &[f64], step_s: f64) -> Cow<'_, [f64]> {
    let steps: Vec<f64> = t_s.windows(2).map(|pair| pair[1] - pair[0]).collect();
    let mut usual: Vec<f64> = steps.iter().copied().filter(|step| *step > 0.0).collect();
    if usual.is_empty() || step_s.is_nan() || step_s <= 0.0 {
        return t_s.into();
    }
    let middle = usual.len() / 2;
    let usual_s = *usual.select_nth_unstable_by(middle, f64::total_cmp).1;
    let is_gap = |at: usize| {
        let beside = at.checked_sub(1).into_iter().chain([at + 1]);
        let longest_s = beside
            .filter_map(|at| steps.get(at))
            .copied()
            .fold(usual_s, f64::max);
        steps[at] > GAP_STEPS * longest_s
    };
    let (mut covered_s, mut gaps_s, mut gaps) = (0.0, 0.0, 0.0);
    for (at, step) in steps.iter().enumerate().filter(|(_, step)| **step > 0.0) {
        if is_gap(at) {
            gaps_s += step;
            gaps += 1.0;
        } else {
            covered_s += step;
        }
    }
    if gaps_s <= LONG * covered_s {
        return t_s.into();
    }
    let longest_s = SHORTENED * covered_s / gaps;
    let mut left_out_s = 0.0;
    let shortened = steps.iter().enumerate().map(|(at, step)| {
        if *step < 0.0 {
            left_out_s = 0.0;
        } else if *step > longest_s && is_gap(at) {
            left_out_s += ((step - longest_s) / step_s).ceil() * step_s;
        }
        t_s[at + 1] - left_out_s
    });
    t_s.iter().copied().take(1).chain(shortened).collect()
}

fn grid(t_s: &[f64], values: &[f64], step_s: f64) -> Option<(Vec<Complex<f64>>, f64, usize)> {
    let (first, last) = (*t_s.first()?, *t_s.last()?);
    if !(step_s > 0.0 && last > first) {
        return None;
    }
    let count = ((last - first) / step_s).round() as usize + 1;
    if !(16..=8 * MOST).contains(&count) {
        return None;
    }
    let mut grid = vec![Complex::new(0.0, 0.0); count];
    let mut filled = 0;
    let finite = values.iter().filter(|value| value.is_finite());
    let mean = finite.clone().sum::<f64>() / finite.count().max(1) as f64;
    for (t, value) in t_s
        .iter()
        .zip(values)
        .filter(|(t, value)| value.is_finite() && **t >= first)
    {
        let slot = ((t - first) / step_s).round() as usize;
        if let Some(cell) = grid.get_mut(slot) {
            if cell.re == 0.0 {
                filled += 1;
            }
            cell.re = value - mean;
        }
    }
    Some((grid, first, filled))
}

/// Lines that stand out of the spectrum around them by more than chance makes of noise.
pub fn lines(t_s: &[f64], values: &[f64], step_s: f64) -> Vec<Line> {
    let t_s = &*laid_out(t_s, step_s);
    let Some((mut grid, _, filled)) = grid(t_s, values, step_s) else {
        return Vec::new();
    };
    let count = grid.len();
    // Hann's window: what a strong line leaks is no line.
    for (k, cell) in grid.iter_mut().enumerate() {
        cell.re *= 0.5 - 0.5 * (std::f64::consts::TAU * k as f64 / count as f64).cos();
    }
    // A finer grid of frequencies than 1/T, so that a line between two of them is not lost.
    let length = 2 * count;
    grid.resize(length, Complex::new(0.0, 0.0));
    FftPlanner::new()
        .plan_fft_forward(length)
        .process(&mut grid);
    let half = length / 2;
    let power: Vec<f64> = grid[..half].iter().map(Complex::norm_sqr).collect();
    let threshold = (count as f64 / CHANCE).ln();
    let mut found: Vec<(usize, f64)> = Vec::new();
    for at in 6..half.saturating_sub(1) {
        let here = power[at];
        if here < power[at - 1] || here < power[at + 1] {
            continue;
        }
        let left = at.saturating_sub(2 * NEIGHBOURS).max(1)..at.saturating_sub(10);
        let right = (at + 11).min(half)..(at + 2 * NEIGHBOURS).min(half);
        let others = [
            power.get(left).unwrap_or_default(),
            power.get(right).unwrap_or_default(),
        ];
        // The median of an exponential distribution is ln 2 times its mean. It is below a limit if more than half of the values
        // are: no need to sort them. Either side is asked for itself: coloured noise falls from one to the other.
        let limit = here * std::f64::consts::LN_2 / threshold;
        let stands_out = |values: &[f64]| {
            let below = |limit: f64| values.iter().filter(|value| **value < limit).count();
            below(limit) > values.len() / 2 && below(f64::MIN_POSITIVE) <= values.len() / 2
        };
        let sides = others.iter().filter(|values| values.len() >= 10);
        if sides.clone().count() > 0 && sides.into_iter().all(|values| stands_out(values)) {
            found.push((at, here));
        }
    }
    found.sort_unstable_by(|a, b| b.1.total_cmp(&a.1));
    let mut apart: Vec<(usize, f64)> = Vec::new();
    for (at, power) in found {
        if apart.iter().all(|(other, _)| other.abs_diff(at) > 12) {
            apart.push((at, power));
        }
    }
    apart
        .into_iter()
        .take(LINES)
        .map(|(at, _)| {
            // Parabola through the peak.
            let (left, here, right) =
                (power[at - 1].sqrt(), power[at].sqrt(), power[at + 1].sqrt());
            let bend = left - 2.0 * here + right;
            let shift = if bend < 0.0 {
                (0.5 * (left - right) / bend).clamp(-0.5, 0.5)
            } else {
                0.0
            };
            let frequency_hz = (at as f64 + shift) / (length as f64 * step_s);
            let turn = frequency_hz * std::f64::consts::TAU;
            let (mut sine, mut cosine) = (0.0, 0.0);
            let begin_s = t_s.first().copied().unwrap_or_default();
            for (t, value) in t_s
                .iter()
                .zip(values)
                .filter(|(_, value)| value.is_finite())
            {
                sine += value * (turn * (t - begin_s)).sin();
                cosine += value * (turn * (t - begin_s)).cos();
            }
            let share = 2.0 / filled.max(1) as f64;
            Line {
                frequency_hz,
                amplitude: f64::hypot(sine, cosine) * share,
                phase_rad: cosine.atan2(sine),
            }
        })
        .collect()
}

/// Frequencies in Hz of the strongest peaks, strongest first, whether they stand out or not; times are put on a grid as they are.
pub fn strongest(t_s: &[f64], values: &[f64], step_s: f64, count: usize) -> Vec<f64> {
    let Some((mut grid, _, _)) = grid(t_s, values, step_s) else {
        return Vec::new();
    };
    let length = 2 * grid.len();
    grid.resize(length, Complex::new(0.0, 0.0));
    FftPlanner::new()
        .plan_fft_forward(length)
        .process(&mut grid);
    let power: Vec<f64> = grid[..length / 2].iter().map(Complex::norm_sqr).collect();
    let mut peaks: Vec<usize> = (1..power.len().saturating_sub(1))
        .filter(|&at| power[at] > power[at - 1] && power[at] >= power[at + 1])
        .collect();
    peaks.sort_unstable_by(|a, b| power[*b].total_cmp(&power[*a]));
    let mut apart: Vec<usize> = Vec::new();
    for at in peaks {
        if apart.iter().all(|other| other.abs_diff(at) > 8) {
            apart.push(at);
        }
        if apart.len() == count {
            break;
        }
    }
    apart
        .into_iter()
        .map(|at| at as f64 / (length as f64 * step_s))
        .collect()
}

/// Amplitude spectral density in `bands` bands of equal width on a logarithmic axis: lower and upper end in Hz, and unit/√Hz.
pub fn density(t_s: &[f64], values: &[f64], step_s: f64, bands: usize) -> Vec<(f64, f64, f64)> {
    let t_s = &*laid_out(t_s, step_s);
    let Some((mut grid, _, filled)) = grid(t_s, values, step_s) else {
        return Vec::new();
    };
    let count = grid.len();
    FftPlanner::new().plan_fft_forward(count).process(&mut grid);
    let half = count / 2;
    if half < 4 {
        return Vec::new();
    }
    let ratio = (half as f64).ln() / bands as f64;
    let mut edges: Vec<usize> = (0..=bands)
        .map(|k| (ratio * k as f64).exp().round() as usize)
        .collect();
    edges.dedup();
    let span_s = count as f64 * step_s;
    edges
        .windows(2)
        .filter(|pair| pair[1] > pair[0])
        .map(|pair| {
            let cells = &grid[pair[0]..pair[1].min(half).max(pair[0] + 1)];
            let mean = cells.iter().map(Complex::norm_sqr).sum::<f64>() / cells.len() as f64;
            // One-sided; gaps hold no energy.
            let density = (2.0 * mean * step_s / filled.max(1) as f64).sqrt();
            (pair[0] as f64 / span_s, pair[1] as f64 / span_s, density)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_found_with_its_phase_and_noise_has_none() {
        use rand_chacha::rand_core::{Rng as _, SeedableRng as _};
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(1);
        let mut noise = || {
            (0..12)
                .map(|_| f64::from(random.next_u32()) / f64::from(u32::MAX))
                .sum::<f64>()
                - 6.0
        };
        let t_s: Vec<f64> = (0..4000).map(|k| f64::from(k) * 0.1).collect();
        let plain: Vec<f64> = t_s.iter().map(|_| noise()).collect();
        assert!(lines(&t_s, &plain, 0.1).is_empty());
        let hum: Vec<f64> = t_s
            .iter()
            .zip(&plain)
            .map(|(t, n)| n + 0.5 * (std::f64::consts::TAU * 1.237 * t + 0.7).sin())
            .collect();
        let found = lines(&t_s, &hum, 0.1);
        assert_eq!(found.len(), 1);
        assert!((found[0].frequency_hz - 1.237).abs() < 1e-3);
        assert!((found[0].amplitude - 0.5).abs() < 0.1);
        assert!((found[0].phase_rad - 0.7).abs() < 1.0);
    }

    #[test]
    fn a_log_that_slows_down_is_laid_out_as_it_is() {
        let slow = (0..300).map(|k| 300.0 + 60.0 * f64::from(k));
        let t_s: Vec<f64> = (0..3000).map(|k| f64::from(k) * 0.1).chain(slow).collect();
        assert_eq!(laid_out(&t_s, 0.1), t_s);
    }

    #[test]
    fn days_between_two_drives_are_not_laid_out() {
        let drive = (0..3000).map(|k| f64::from(k) * 0.1);
        // Less than four times their length apart, both are where they were.
        for (gap_s, as_read) in [
            (900.0, true),
            (3.0 * 86_400.0, false),
            (90.0 * 86_400.0, false),
        ] {
            let again = drive.clone().map(|t| t + 300.0 + gap_s);
            let t_s: Vec<f64> = drive.clone().chain(again).collect();
            let hum: Vec<f64> = t_s
                .iter()
                .map(|t| 0.5 * (std::f64::consts::TAU * 1.237 * t + 0.7).sin())
                .collect();
            let bands = density(&t_s, &hum, 0.1, 16);
            let (lowest_hz, ..) = bands[0];
            // The grid is as long as one over its lowest frequency.
            assert!(lowest_hz > 1.0 / 3000.0, "{gap_s} s: {lowest_hz} Hz");
            assert_eq!(laid_out(&t_s, 0.1) == t_s, as_read, "{gap_s} s");
            let found = lines(&t_s, &hum, 0.1);
            assert!(
                (found[0].frequency_hz - 1.237).abs() < 1e-3,
                "{gap_s} s: {found:?}"
            );
            assert!(
                (found[0].amplitude - 0.5).abs() < 0.1,
                "{gap_s} s: {found:?}"
            );
        }
    }
}
