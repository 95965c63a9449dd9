//! Means of a signal over stretches of time: windows that slide, and windows that a converter opens now and then.

use std::ops::Range;

use super::scene::{Cursor, Steps};
use crate::problem::Drive;

/// Rows of even steps up to which sums from the first row on are kept: they save time, and take memory in every run (8 MB of so
/// many rows).
const SUMMED: usize = 1_000_000;

impl Steps {
    /// Boxcar mean over the `window_s` before each row; before the start of a segment the signal stood at its first value.
    pub fn boxcar(&self, drive: &Drive, input: &[f64], window_s: f64, held: bool) -> Vec<f64> {
        let mut output = input.to_vec();
        if window_s.is_nan() || window_s <= 0.0 {
            return output;
        }
        for (rows, even_s) in drive.segments.iter().zip(&self.even_s) {
            let (input, output) = (&input[rows.clone()], &mut output[rows.clone()]);
            match even_s.filter(|_| rows.len() <= SUMMED) {
                Some(step_s) => even_boxcar(input, window_s / step_s, held, output),
                None => boxcar(&drive.t_s[rows.clone()], input, window_s, held, output),
            }
        }
        output
    }

    /// Means of a signal over stretches of a segment, which is not to be empty.
    pub fn means<'a>(
        &self,
        drive: &'a Drive,
        segment: usize,
        input: &'a [f64],
        held: bool,
    ) -> Means<'a> {
        let rows = drive.segments[segment].clone();
        let even_s = self.even_s[segment].filter(|_| rows.len() <= SUMMED);
        Means(match even_s {
            Some(step_s) => MeansOver::Even {
                means: EvenMeans::new(&input[rows.clone()], held),
                first_s: drive.t_s[rows.start],
                per_s: 1.0 / step_s,
            },
            None => MeansOver::Any(AnyMeans::new(
                &drive.t_s,
                rows.clone(),
                rows.start,
                input,
                held,
            )),
        })
    }
}

/// Boxcar mean over the `window_s` before each row; before the start of a segment the signal stood at its first value.
fn boxcar(t_s: &[f64], input: &[f64], window_s: f64, held: bool, output: &mut [f64]) {
    let mut means = AnyMeans::new(t_s, 0..t_s.len(), 0, input, held);
    for (t, out) in t_s.iter().zip(output) {
        *out = means.mean(t - window_s, *t);
    }
}

/// Means over any stretches of time; of those that go forward every row is passed twice.
struct AnyMeans<'a> {
    /// Where a mean begins, and where it ends.
    ends: [Running<'a>; 2],
}

impl<'a> AnyMeans<'a> {
    /// Over some rows; a cursor stands at one of them at first.
    fn new(t_s: &'a [f64], rows: Range<usize>, at: usize, input: &'a [f64], held: bool) -> Self {
        let running = || Running::new(t_s, rows.clone(), at, input, held);
        Self {
            ends: [running(), running()],
        }
    }

    #[inline]
    fn mean(&mut self, from: f64, to: f64) -> f64 {
        let [begin, end] = &mut self.ends;
        let before = begin.until(from);
        if begin.is_within_step(from, to) {
            // Of a straight line it is the value in the middle.
            return (begin.cursor).value(begin.input, 0.5 * (from + to), begin.held);
        }
        begin.first + (end.until(to) - before) / (to - from)
    }
}

/// The integral of a signal from a row to a time, of what is more than its value there (so that sums stay small).
struct Running<'a> {
    cursor: Cursor<'a>,
    input: &'a [f64],
    first: f64,
    held: bool,
    /// Up to the row where the cursor stands.
    sum: f64,
}

impl<'a> Running<'a> {
    fn new(t_s: &'a [f64], rows: Range<usize>, at: usize, input: &'a [f64], held: bool) -> Self {
        Self {
            first: input[at],
            cursor: Cursor::within(t_s, rows, at),
            input,
            held,
            sum: 0.0,
        }
    }

    /// Beyond the ends the signal holds its end values.
    #[inline]
    fn until(&mut self, t: f64) -> f64 {
        self.seek(t);
        self.sum + self.cursor.beyond(self.input, t, self.held)
            - self.first * self.cursor.since_s(t)
    }

    /// Moves to the last row not after a time.
    #[inline]
    fn seek(&mut self, t: f64) {
        while let Some(step_s) = self.cursor.step_s()
            && self.cursor.since_s(t) >= step_s
        {
            self.sum += self.area(self.cursor.row(), step_s);
            self.cursor.forward();
        }
        while self.cursor.since_s(t) < 0.0 && self.cursor.back() {
            let step_s = self.cursor.step_s().unwrap_or_default();
            self.sum -= self.area(self.cursor.row(), step_s);
        }
    }

    /// Integral of [`Running::until`] from one time to a later one. It is a parabola between two rows: each of these pieces by itself, as
    /// differences of sums over the whole recording would have lost their digits.
    fn integral_until(&mut self, from: f64, to: f64) -> f64 {
        self.seek(from);
        let (mut cursor, mut sum) = (self.cursor.clone(), self.sum);
        // Before the first row there is nothing more than its value.
        let mut begin_s = cursor.since_s(from).max(0.0);
        let mut integral = 0.0;
        loop {
            let row = cursor.row();
            let step_s = cursor.step_s();
            let passed_s = step_s.filter(|step_s| cursor.since_s(to) >= *step_s);
            let end_s = passed_s.unwrap_or_else(|| cursor.since_s(to).max(begin_s));
            let slope = match step_s {
                Some(step_s) if !self.held && step_s > 0.0 => {
                    (self.input[row + 1] - self.input[row]) / step_s
                }
                _ => 0.0,
            };
            let (length_s, middle_s) = (end_s - begin_s, 0.5 * (begin_s + end_s));
            let mean_square = middle_s * middle_s + length_s * length_s / 12.0;
            let more = self.input[row] - self.first;
            integral += length_s * (sum + more * middle_s + 0.5 * slope * mean_square);
            let Some(step_s) = passed_s else {
                return integral;
            };
            sum += self.area(row, step_s);
            cursor.forward();
            begin_s = 0.0;
        }
    }

    fn is_within_step(&self, from: f64, to: f64) -> bool {
        let step_s = self.cursor.step_s();
        self.cursor.since_s(from) >= 0.0
            && step_s.is_some_and(|step_s| self.cursor.since_s(to) <= step_s)
    }

    /// Over the step that begins at a row.
    #[inline]
    fn area(&self, row: usize, step_s: f64) -> f64 {
        let here = self.input[row];
        let mean = if self.held {
            here
        } else {
            0.5 * (here + self.input[row + 1])
        };
        (mean - self.first) * step_s
    }
}

/// Integral at rows of even steps from the first one on, of what is more than its value there (so that sums stay small), in steps.
fn even_total(input: &[f64], held: bool) -> Vec<f64> {
    let Some(first) = input.first().copied() else {
        return Vec::new();
    };
    let mut total = vec![0.0; input.len()];
    // Of a step, twice.
    let area = |here: f64, next: f64| (here - first) + (if held { here } else { next } - first);
    // Each sum waits for the one before it: four are made from one.
    let (fours, rest) = total[1..].as_chunks_mut::<4>();
    let done = 4 * fours.len();
    let mut last = 0.0;
    for (sums, x) in fours.iter_mut().zip(input.windows(5).step_by(4)) {
        let [a, b, c, d] = [0, 1, 2, 3].map(|k| 0.5 * area(x[k], x[k + 1]));
        let (ab, cd) = (a + b, c + d);
        *sums = [last + a, last + ab, last + (ab + c), last + (ab + cd)];
        last = sums[3];
    }
    for (sum, x) in rest.iter_mut().zip(input[done..].windows(2)) {
        last += 0.5 * area(x[0], x[1]);
        *sum = last;
    }
    total
}

/// [`boxcar`] over rows of even steps; the window's length is in steps. Every window begins at the same part of a step.
fn even_boxcar(input: &[f64], window: f64, held: bool, output: &mut [f64]) {
    let Some(first) = input.first().copied() else {
        return;
    };
    let total = even_total(input, held);
    let whole = window.floor();
    let part = 1.0 - (window - whole);
    // From a row to where the window begins after it.
    let [from, to] = if held {
        [part, 0.0]
    } else {
        [part - 0.5 * part * part, 0.5 * part * part]
    };
    let back = (whole as usize).saturating_add(1).min(input.len());
    let (beginning, rest) = output.split_at_mut(back);
    for (out, total) in beginning.iter_mut().zip(&total) {
        *out = first + total / window;
    }
    let starts = total.iter().zip(input.windows(2));
    for ((out, until), (total, pair)) in rest.iter_mut().zip(&total[back..]).zip(starts) {
        let start = total + from * (pair[0] - first) + to * (pair[1] - first);
        *out = first + (until - start) / window;
    }
}

/// Means over any stretches of time of a signal whose rows are even.
struct EvenMeans<'a> {
    input: &'a [f64],
    total: Vec<f64>,
    held: bool,
}

impl<'a> EvenMeans<'a> {
    fn new(input: &'a [f64], held: bool) -> Self {
        Self {
            total: even_total(input, held),
            input,
            held,
        }
    }

    /// Mean from one place to a later one, in steps from the first row; beyond the ends the signal holds its end values.
    #[inline]
    fn mean(&self, from: f64, to: f64) -> f64 {
        let row = from as i64;
        if from >= 0.0
            && to <= row.saturating_add(1) as f64
            && let [here, next] = self.step(row)
        {
            // Of a straight line it is the value in the middle.
            let part = if self.held {
                0.0
            } else {
                0.5 * (from + to) - row as f64
            };
            return here + (next - here) * part;
        }
        self.input[0] + (self.until(to) - self.until(from)) / (to - from)
    }

    /// The values at a row and at the next one; nothing beyond the ends.
    #[inline]
    fn step(&self, row: i64) -> &[f64] {
        let row = usize::try_from(row).unwrap_or(usize::MAX);
        self.input
            .get(row..row.saturating_add(2))
            .unwrap_or_default()
    }

    /// Integral up to a place, of what is more than the first value.
    #[inline]
    fn until(&self, place: f64) -> f64 {
        let first = self.input[0];
        if place <= 0.0 {
            return 0.0;
        }
        let row = place as i64;
        let [here, next] = self.step(row) else {
            let last = self.input.len() - 1;
            return self.total[last] + (self.input[last] - first) * (place - last as f64);
        };
        let part = place - row as f64;
        let bent = if self.held {
            0.0
        } else {
            0.5 * part * part * (next - here)
        };
        self.total[row as usize] + part * (here - first) + bent
    }
}

/// Means of a signal over stretches of time that mostly go forward.
pub struct Means<'a>(MeansOver<'a>);

enum MeansOver<'a> {
    Even {
        means: EvenMeans<'a>,
        first_s: f64,
        per_s: f64,
    },
    Any(AnyMeans<'a>),
}

impl<'a> Means<'a> {
    /// Over rows that follow each other, beginning to look at one of them; what is between two of them is a straight line, or held.
    pub fn around(
        drive: &'a Drive,
        rows: Range<usize>,
        at: usize,
        input: &'a [f64],
        held: bool,
    ) -> Self {
        Self(MeansOver::Any(AnyMeans::new(
            &drive.t_s, rows, at, input, held,
        )))
    }

    /// Mean from one time to a later one, in s; beyond the ends the signal holds its end values.
    #[inline]
    pub fn mean(&mut self, from_s: f64, to_s: f64) -> f64 {
        match &mut self.0 {
            MeansOver::Even {
                means,
                first_s,
                per_s,
            } => means.mean((from_s - *first_s) * *per_s, (to_s - *first_s) * *per_s),
            MeansOver::Any(means) => means.mean(from_s, to_s),
        }
    }
}

/// Means of a sliding mean over stretches of time that mostly go forward.
pub struct MeansOfMean<'a> {
    first: f64,
    window_s: f64,
    /// The integral up to a time, and up to a window before it.
    ends: [Running<'a>; 2],
}

impl<'a> MeansOfMean<'a> {
    /// Over a segment, which is not to be empty, of a mean over the `window_s` before each time.
    pub fn new(
        drive: &'a Drive,
        segment: usize,
        input: &'a [f64],
        held: bool,
        window_s: f64,
    ) -> Self {
        let rows = drive.segments[segment].clone();
        let running = || Running::new(&drive.t_s, rows.clone(), rows.start, input, held);
        Self {
            first: input[rows.start],
            window_s,
            ends: [running(), running()],
        }
    }

    /// From one time to a later one, in s.
    pub fn mean(&mut self, from_s: f64, to_s: f64) -> f64 {
        let [late, early] = &mut self.ends;
        let before = early.integral_until(from_s - self.window_s, to_s - self.window_s);
        let integral = late.integral_until(from_s, to_s) - before;
        self.first + integral / (self.window_s * (to_s - from_s))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::effects::scene::{integral, tests::drive};

    #[test]
    fn a_boxcar_follows_a_ramp_late_by_half_its_window() {
        let t_s: Vec<f64> = (0..2000).map(|k| f64::from(k) * 0.01).collect();
        let output = Steps::new(&drive(&t_s)).boxcar(&drive(&t_s), &t_s, 0.333, false);
        assert!((output[1999] - (t_s[1999] - 0.1665)).abs() < 1e-9);
    }

    #[test]
    fn a_mean_is_the_integral_over_its_time() {
        // Uneven rows, two at one time.
        let t_s: Vec<f64> = (0..60)
            .map(|k| 0.1 * f64::from(k - k % 7 / 6) + 0.03 * f64::from(k % 3 % 2))
            .collect();
        let series: Vec<f64> = t_s.iter().map(|t| (3.0 * t).sin() + t).collect();
        for held in [false, true] {
            let total = integral(&t_s, std::slice::from_ref(&(0..60)), &series, held);
            for (period, length) in [(0.07, 0.001), (0.05, 0.05), (0.31, 0.2), (2.0, 2.0)] {
                let mut means = AnyMeans::new(&t_s, 0..60, 0, &series, held);
                let mut from = -0.4;
                while from < 6.4 {
                    let until = |t| Cursor::new(&t_s, 0..60).integral(&total, &series, t, held);
                    let expected = (until(from + length) - until(from)) / length;
                    let found = means.mean(from, from + length);
                    assert!(
                        (found - expected).abs() < 1e-9,
                        "{held} {length} {from}: {found} {expected}"
                    );
                    from += period;
                }
            }
        }
    }

    #[test]
    fn a_mean_of_a_mean_is_that_of_many() {
        const MANY: usize = 20_000;
        // Uneven rows, two at one time.
        let t_s: Vec<f64> = (0..60)
            .map(|k| 0.1 * f64::from(k - k % 7 / 6) + 0.03 * f64::from(k % 7 % 3 % 2))
            .collect();
        let series: Vec<f64> = t_s.iter().map(|t| 300.0 + (3.0 * t).sin() + t).collect();
        let drive = drive(&t_s);
        for held in [false, true] {
            let windows = [(0.03, 0.001), (0.03, 0.2), (0.7, 0.05), (2.0, 0.3)];
            for (window_s, length_s) in windows {
                let mut means = MeansOfMean::new(&drive, 0, &series, held, window_s);
                let mut sliding = AnyMeans::new(&t_s, 0..60, 0, &series, held);
                for begin in 0..20 {
                    let from_s = -0.5 + 0.37 * f64::from(begin);
                    let many = (0..MANY).map(|k| {
                        let t = from_s + length_s * (k as f64 + 0.5) / MANY as f64;
                        sliding.mean(t - window_s, t)
                    });
                    let expected = many.sum::<f64>() / MANY as f64;
                    let found = means.mean(from_s, from_s + length_s);
                    assert!(
                        (found - expected).abs() < 1e-6,
                        "{held} {window_s} {length_s} {from_s}: {found} {expected}"
                    );
                }
            }
        }
    }

    #[test]
    fn a_mean_over_even_steps_is_one_over_any() {
        let t_s: Vec<f64> = (0..60).map(|k| 5.0 + f64::from(k) * 0.01).collect();
        let input: Vec<f64> = (0..60).map(|k| 300.0 + f64::from(k * 7 % 23)).collect();
        for held in [false, true] {
            let even = EvenMeans::new(&input, held);
            let mut any = AnyMeans::new(&t_s, 0..60, 0, &input, held);
            for (period, length) in [(0.007, 1e-4), (0.005, 0.005), (0.031, 0.02), (0.2, 0.2)] {
                let mut from = -0.04;
                while from < 0.64 {
                    let expected = any.mean(5.0 + from, 5.0 + from + length);
                    let found = even.mean(from / 0.01, (from + length) / 0.01);
                    assert!(
                        (found - expected).abs() < 1e-7,
                        "{held} {length} {from}: {found} {expected}"
                    );
                    from += period;
                }
            }
        }
    }

    #[test]
    fn a_boxcar_over_even_steps_is_one_over_any() {
        let t_s: Vec<f64> = (0..200).map(|k| 5.0 + f64::from(k) * 0.01).collect();
        let input: Vec<f64> = (0..200)
            .map(|k| 300.0 + 40.0 * f64::from(k * 7 % 23))
            .collect();
        let (mut even, mut any) = (vec![0.0; 200], vec![0.0; 200]);
        for held in [false, true] {
            for window_s in [1e-4, 0.003, 0.01, 0.02, 0.0271, 0.5, 1.99, 2.0, 2.3, 1e6] {
                even_boxcar(&input, window_s / 0.01, held, &mut even);
                boxcar(&t_s, &input, window_s, held, &mut any);
                let apart = even.iter().zip(&any).map(|(even, any)| (even - any).abs());
                let most = apart.fold(0.0, f64::max);
                assert!(most < 1e-7, "{held} {window_s}: {most}");
            }
        }
    }
}
