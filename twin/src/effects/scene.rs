//! The simulation while effects act on it: series on the drive's rows, then on the observation's.

use std::collections::HashMap;
use std::ops::Range;
use std::sync::Arc;

use super::between::Between;
use super::ocv::{self, open_circuit_v};
use crate::problem::{
    Base, BatteryBase, Drive, Moments, Observed, Problem, SensorBase, Series, View, ends,
};

/// Reference temperature of every temperature coefficient, in °C.
pub const REFERENCE_C: f64 = 25.0;
/// 0 °C in K.
pub const ZERO_CELSIUS_K: f64 = 273.15;

/// Arrhenius temperature of the resistances where nothing says what it is, in K: that of usual lithium-ion cells is 1500 … 4000 K (17 kJ/mol
/// of an electrolyte's conductivity are 2000 K).
pub const USUAL_B_K: f64 = 2000.0;

/// Kinds of step that are remembered while steps are told apart.
const KNOWN: usize = 16;

/// What turns over fewer times than this in a recording is not told from a zero that drifts or jumps.
pub const ROUNDS: usize = 4;

/// What sizes are natural in a problem: bounds and starts follow from it.
#[derive(Clone, Copy, Debug, Default)]
pub struct Scale {
    /// Largest abs(reference).
    pub largest: f64,
    /// The largest size that the reference passes on one side and on the other in turn, at least [`ROUNDS`] times; 0 without.
    pub both_ways: f64,
    /// Root mean square of the reference.
    pub rms: f64,
    /// Full scale of the sensor: as stated, else the largest reading.
    pub full_scale: f64,
    /// Root mean square of what is to be explained.
    pub mismatch: f64,
    /// Fastest time constant that the readings can tell, in s.
    pub fastest_s: f64,
    /// Median step of the drive in s.
    pub step_s: f64,
    /// Median step of the readings that count, in s.
    pub reading_step_s: f64,
    /// Step of the grid that spectra of readings are laid out on, in s: that of all readings, before they were thinned out, where that is not too
    /// long.
    pub spectral_step_s: f64,
    /// Of [`Scale::reading_step_s`]: the same as a whole part of the time covered, in s: where steps are even, it keeps in step over the recording.
    pub even_s: f64,
    /// Time of the first observed row in s.
    pub begin_s: f64,
    /// Time covered in s; of the longest segment.
    pub span_s: f64,
    /// Time from the begin to the end of the longest operation, gaps included, in s: what clocks run on for.
    pub operation_s: f64,
    /// Capacity of the battery in Ah, 0 without one.
    pub capacity_ah: f64,
    /// Lowest and highest state of charge of the drive by design, 0 … 1; both 0 without a battery.
    pub soc: (f64, f64),
    /// Ohmic resistance of one cell by design in Ω.
    pub resistance_ohm: f64,
    /// Averaging window by design in s.
    pub window_s: f64,
    /// The converter's step by design.
    pub quantum: f64,
}

/// The simulation in the making.
#[derive(Clone, Debug)]
pub struct Scene<'a> {
    /// What drives it.
    pub drive: &'a Drive,
    /// When readings were taken.
    pub observed: &'a Observed,
    /// Steps of the drive's rows.
    pub steps: Arc<Steps>,
    /// Of each stretch of readings, whether they were taken at the recorded rows of their segment.
    on_rows: Arc<Vec<bool>>,
    /// Of each segment of the drive, the operation that it is a part of.
    pub(super) operations: Arc<Vec<Range<usize>>>,
    /// Changes of the range, in order.
    pub changes: Arc<Vec<RangeChange>>,
    /// The signal: on drive rows before [`super::Stage::Ripple`], then on the observation's rows.
    pub signal: Series,
    /// What it does between drive rows.
    pub(super) between: Between,
    /// Transport delay in s.
    pub delay_s: f64,
    /// The sensor's clock runs fast by this, in 1.
    pub skew: f64,
    /// The sensor as designed, for sensor views.
    pub sensor: Option<&'a SensorBase>,
    /// The battery in the making.
    pub battery: Option<Battery<'a>>,
}

/// State of the battery simulation on drive rows; the scene's `signal` is the current in A.
#[derive(Clone, Debug)]
pub struct Battery<'a> {
    /// As designed.
    pub base: &'a BatteryBase,
    /// Capacity in Ah.
    pub capacity_ah: f64,
    /// Share of the charge put in that comes back.
    pub efficiency: f64,
    /// Added to the state of charge at the start of each operation, 0 … 1; nothing where there is no value.
    pub soc_shift: Vec<f64>,
    /// Added to it over the gap before each segment.
    pub gap_soc_shift: Vec<f64>,
    /// Current in A that flowed for long before the first operation.
    pub before_a: f64,
    /// Where a gap ends over which the charge is not known, and the mean current that its charge makes there, in A: of the rows at its ends
    /// neither says what flowed in it. Filled where the charge is counted.
    pub gap_mean_a: Vec<(usize, f64)>,
    /// Factor of the ohmic resistance by design, at 25 °C.
    pub resistance: f64,
    /// State of charge, 0 … 1; filled between the stages of charge and temperature.
    pub soc: Series,
    /// Open-circuit voltage in V, from the state of charge.
    open_circuit_v: Series,
    /// Temperature of the cell in °C.
    pub temperature_c: Series,
    /// Arrhenius temperature of the resistance in K, once known.
    pub arrhenius_k: Option<f64>,
    /// Factor on every resistance.
    pub factor: Series,
    /// Voltage of one cell added to its open circuit and ohmic drop, in V.
    pub added_v: Series,
}

/// A change of the range in use.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RangeChange {
    /// The first row after it.
    pub row: usize,
    /// Time in s from the change to that row.
    pub since_s: f64,
    /// Whether it is to the large range.
    pub high: bool,
}

/// Changes of the range with their instants: where the reference crosses the limit between two rows.
///
/// The limits, one on the way up and one on the way down (a hysteresis), are those that the fewest rows contradict. A current
/// that reverses between two rows of the large range passes through the small one.
pub fn range_changes(drive: &Drive, sensor: Option<&SensorBase>) -> Vec<RangeChange> {
    let (Some(flag), Some(sensor)) = (&drive.range_high, sensor) else {
        return Vec::new();
    };
    let size = |row: usize| drive.reference[row].abs();
    let high = |row: usize| flag[row] > 0.5;
    // From one recorded row to the next.
    let stride = drive.stride();
    let steps = || {
        let segments = drive.segments.iter().filter(|rows| !rows.is_empty());
        segments.flat_map(|rows| (rows.start + stride..rows.end).step_by(stride))
    };
    // Of each way: sizes that the limit is above, and sizes that it is below.
    let (mut up, mut down) = ((Vec::new(), Vec::new()), (Vec::new(), Vec::new()));
    for row in steps() {
        match (high(row - stride), high(row)) {
            (false, false) => up.0.push(size(row)),
            (false, true) => up.1.push(size(row)),
            (true, true) => down.1.push(size(row)),
            (true, false) => down.0.push(size(row)),
        }
    }
    // Of a range that changes one way only, what a change leaves behind is not told from what differs between the ranges.
    if up.1.is_empty() || down.0.is_empty() {
        return Vec::new();
    }
    let up = limit(up.0, up.1, sensor.range_limit);
    let down = limit(down.0, down.1, None);
    let mut changes = Vec::new();
    for row in steps() {
        let h = (drive.t_s[row] - drive.t_s[row - stride]).max(0.0);
        let (from, to) = (drive.reference[row - stride], drive.reference[row]);
        // A held reference jumps: when within the step, nobody knows.
        let since_s = |limit: f64| {
            if sensor.held_reference || from == to {
                0.5 * h
            } else {
                h * ((to - limit) / (to - from)).clamp(0.0, 1.0)
            }
        };
        let rises = RangeChange {
            row,
            since_s: since_s(up.copysign(to)),
            high: true,
        };
        let falls = RangeChange {
            row,
            since_s: since_s(down.copysign(from)),
            high: false,
        };
        match (high(row - stride), high(row)) {
            (false, true) => changes.push(rises),
            (true, false) => changes.push(falls),
            (true, true) if from * to < 0.0 && !sensor.held_reference => {
                changes.extend([falls, rises]);
            }
            _ => (),
        }
    }
    // To the first of the rows between that comes after it.
    for change in changes.iter_mut().filter(|_| stride > 1) {
        let at_s = drive.t_s[change.row] - change.since_s;
        let recorded = change.row;
        while change.row > recorded + 1 - stride && drive.t_s[change.row - 1] > at_s {
            change.row -= 1;
        }
        change.since_s = drive.t_s[change.row] - at_s;
    }
    changes
}

/// The value that the fewest of some values lie on the wrong side of (those of `below` are said to be below it); of equals the
/// one by design.
fn limit(mut below: Vec<f64>, mut above: Vec<f64>, design: Option<f64>) -> f64 {
    below.sort_unstable_by(f64::total_cmp);
    above.sort_unstable_by(f64::total_cmp);
    let mut edges: Vec<f64> = below.iter().chain(&above).copied().collect();
    edges.sort_unstable_by(f64::total_cmp);
    edges.dedup();
    let (mut b, mut a) = (0, 0);
    let mut best = (usize::MAX, 0.0);
    for pair in edges.windows(2) {
        while below.get(b).is_some_and(|value| *value <= pair[0]) {
            b += 1;
        }
        while above.get(a).is_some_and(|value| *value <= pair[0]) {
            a += 1;
        }
        let wrong = below.len() - b + a;
        if wrong < best.0 {
            best = (wrong, 0.5 * (pair[0] + pair[1]));
        }
    }
    let wrong = |limit: f64| {
        let below = below.len() - below.partition_point(|value| *value <= limit);
        below + above.partition_point(|value| *value <= limit)
    };
    design
        .filter(|design| wrong(*design) <= best.0)
        .unwrap_or(best.1)
}

/// Steps between the drive's rows, told apart to a nanosecond (differences of times carry rounding). Steps repeat, with some
/// jitter: a filter needs the exponential of each kind once, not of each row.
#[derive(Clone, Debug, Default)]
pub struct Steps {
    /// Kind of the step that ends at each row; 0: no step.
    kind: Vec<u32>,
    /// Length of each kind in s.
    length_s: Vec<f64>,
    /// Length of every step of a segment, where they are all of one kind.
    pub(super) even_s: Vec<Option<f64>>,
    /// [`Drive::mean_share`].
    mean_share: Option<Series>,
}

impl Steps {
    /// Of a drive's rows; the step to the first row of a segment that continues another is the gap between them.
    pub fn new(drive: &Drive) -> Self {
        let (t_s, segments) = (&drive.t_s, &drive.segments);
        let mut kind = vec![0; t_s.len()];
        let mut length_s = vec![0.0];
        let mut numbers: HashMap<u64, u32> = HashMap::new();
        let mut known = [(u64::MAX, 0u32); KNOWN];
        for rows in drive.operations() {
            for row in rows.start + 1..rows.end {
                let h = t_s[row] - t_s[row - 1];
                if h.is_nan() || h <= 0.0 {
                    continue;
                }
                let nanos = (h * 1e9).round() as u64;
                let slot = &mut known[(nanos / 1_000_000) as usize % KNOWN];
                if slot.0 != nanos {
                    let number = *numbers.entry(nanos).or_insert_with(|| {
                        length_s.push(h);
                        length_s.len() as u32 - 1
                    });
                    *slot = (nanos, number);
                }
                kind[row] = slot.1;
            }
        }
        let even_s = segments
            .iter()
            .map(|rows| {
                let kinds = kind.get(rows.start + 1..rows.end)?;
                let first = *kinds.first().filter(|kind| **kind != 0)?;
                let span_s = t_s[rows.end - 1] - t_s[rows.start];
                kinds
                    .iter()
                    .all(|kind| *kind == first)
                    .then_some(span_s / kinds.len() as f64)
            })
            .collect();
        Self {
            kind,
            length_s,
            even_s,
            mean_share: drive.mean_share.clone(),
        }
    }

    /// Weights of a first-order low-pass over each kind of step: of the last output, of the input where the step begins and of
    /// that where it ends.
    fn weights(&self, tau_s: f64, held: bool) -> impl Iterator<Item = [f64; 3]> + '_ {
        self.length_s.iter().map(move |h| {
            if *h <= 0.0 {
                return [1.0, 0.0, 0.0];
            }
            let kept = (-h / tau_s).exp();
            let ramp = if held {
                0.0
            } else {
                1.0 - tau_s / h * (1.0 - kept)
            };
            [kept, 1.0 - kept - ramp, ramp]
        })
    }

    /// First-order low-pass by straight lines between samples, exact (the drive's rows may be irregular).
    ///
    /// y(t+h) = e^(−h/τ)·y + (1 − e^(−h/τ))·u₀ + (u₁−u₀)·(1 − τ/h·(1 − e^(−h/τ)))
    pub fn low_pass(
        &self,
        segments: &[Range<usize>],
        input: &[f64],
        tau_s: f64,
        held: bool,
    ) -> Vec<f64> {
        let mut output = input.to_vec();
        if tau_s.is_nan() || tau_s <= 0.0 {
            return output;
        }
        let weights: Vec<[f64; 3]> = self.weights(tau_s, held).collect();
        // Parts of segments, or segments with the gaps between them, are not known to be even.
        let even = segments.len() == self.even_s.len();
        for (index, rows) in segments.iter().enumerate() {
            let Some(mut last) = input[rows.clone()].first().copied() else {
                continue;
            };
            let after = rows.start + 1..rows.end;
            let input = &input[rows.clone()];
            let output = &mut output[after.clone()];
            let kinds = &self.kind[after];
            // Each row waits for the one before it: of even steps four are made from one.
            let fours = if even && self.even_s[index].is_some() {
                output.len() / 4
            } else {
                0
            };
            let (even, output) = output.split_at_mut(4 * fours);
            if let Some(kind) = kinds.first().filter(|_| fours > 0) {
                let [kept, from, to] = weights[*kind as usize];
                let powers = [kept, kept.powi(2), kept.powi(3), kept.powi(4)];
                let inputs = input.windows(5).step_by(4);
                for (out, x) in even.as_chunks_mut::<4>().0.iter_mut().zip(inputs) {
                    let mut parts = [0.0; 4];
                    let mut part = 0.0;
                    for k in 0..4 {
                        part = kept * part + (from * x[k] + to * x[k + 1]);
                        parts[k] = part;
                    }
                    for k in 0..4 {
                        out[k] = parts[k] + powers[k] * last;
                    }
                    last = out[3];
                }
            }
            let left = input[4 * fours..].windows(2);
            for ((pair, out), kind) in left.zip(output).zip(&kinds[4 * fours..]) {
                let [kept, from, to] = weights[*kind as usize];
                last = kept * last + (from * pair[0] + to * pair[1]);
                *out = last;
            }
        }
        output
    }

    /// A sum of first-order low-passes of a current, each with a weight: one pass over the rows. When the first segment begins all are where
    /// `before` leads in the long run, when another one begins at rest.
    /// Between the rows it goes as [`Drive::mean_share`] says, and over the step to one of `gaps` it is what is said there.
    pub fn ladder<const N: usize>(
        &self,
        segments: &[Range<usize>],
        input: &[f64],
        (gaps, before): (&[(usize, f64)], f64),
        taus_s: [f64; N],
        weights: [f64; N],
    ) -> Vec<f64> {
        let mut output = vec![0.0; input.len()];
        let mut of_kind = vec![[[0.0; N]; 3]; self.length_s.len()];
        for k in 0..N {
            for (all, [kept, from, to]) in of_kind.iter_mut().zip(self.weights(taus_s[k], false)) {
                all[0][k] = kept;
                all[1][k] = weights[k] * from;
                all[2][k] = weights[k] * to;
            }
        }
        for rows in segments.iter().filter(|rows| !rows.is_empty()) {
            let mut last = [0.0; N];
            if before != 0.0 && segments.first() == Some(rows) {
                last = weights.map(|weight| weight * before);
                output[rows.start] = last.iter().sum();
            }
            let mut step = |kind: u32, pair: [f64; 2]| {
                let [kept, from, to] = &of_kind[kind as usize];
                let mut sum = 0.0;
                for k in 0..N {
                    last[k] = kept[k] * last[k] + (from[k] * pair[0] + to[k] * pair[1]);
                    sum += last[k];
                }
                sum
            };
            let inside = gaps.iter().filter(|(row, _)| rows.contains(row));
            let mut start = rows.start;
            for (end, gap) in inside
                .map(|(row, mean)| (*row, Some(*mean)))
                .chain([(rows.end, None)])
            {
                let after = start + 1..end;
                let shares = self.mean_share.as_ref();
                let shares = shares.map_or(&[][..], |shares| &shares[after.clone()]);
                let mut shares = shares.iter();
                let pairs = input[start..end].windows(2);
                for ((pair, out), kind) in
                    pairs.zip(&mut output[after.clone()]).zip(&self.kind[after])
                {
                    let pair = [pair[0], pair[1]];
                    let pair = shares.next().map_or(pair, |share| ends(*share, pair));
                    *out = step(*kind, pair);
                }
                if let Some(mean) = gap {
                    output[end] = step(self.kind[end], [mean; 2]);
                }
                start = end;
            }
        }
        output
    }
}

/// Integral over the step that begins at a row: a trapezoid, or the value held.
#[inline]
fn area(t_s: &[f64], input: &[f64], row: usize, held: bool) -> f64 {
    let mean = if held {
        input[row]
    } else {
        0.5 * (input[row + 1] + input[row])
    };
    mean * (t_s[row + 1] - t_s[row])
}

/// Integral over time from the start of each segment: trapezoids, or the last value held.
pub fn integral(t_s: &[f64], segments: &[Range<usize>], input: &[f64], held: bool) -> Vec<f64> {
    let mut output = vec![0.0; input.len()];
    for rows in segments.iter().filter(|rows| !rows.is_empty()) {
        let mut sum = 0.0;
        let (t_s, input) = (&t_s[rows.clone()], &input[rows.clone()]);
        for (row, out) in output[rows.start + 1..rows.end].iter_mut().enumerate() {
            sum += area(t_s, input, row, held);
            *out = sum;
        }
    }
    output
}

/// A place to look values up between rows, for times that mostly go forward.
#[derive(Clone, Debug)]
pub struct Cursor<'a> {
    t_s: &'a [f64],
    rows: Range<usize>,
    at: usize,
}

impl<'a> Cursor<'a> {
    /// Over one segment.
    pub fn new(t_s: &'a [f64], rows: Range<usize>) -> Self {
        Self {
            t_s,
            at: rows.start,
            rows,
        }
    }

    /// Over some rows, from one of them on.
    pub(super) fn within(t_s: &'a [f64], rows: Range<usize>, at: usize) -> Self {
        Self { t_s, rows, at }
    }

    /// The row where it stands.
    pub(super) fn row(&self) -> usize {
        self.at
    }

    /// Goes on by a row.
    pub(super) fn forward(&mut self) {
        self.at += 1;
    }

    /// Goes back by a row; whether there was one.
    pub(super) fn back(&mut self) -> bool {
        let is_there = self.at > self.rows.start;
        self.at -= usize::from(is_there);
        is_there
    }

    /// Time from there to another, in s.
    pub(super) fn since_s(&self, t: f64) -> f64 {
        t - self.t_s[self.at]
    }

    /// From there to the next row, in s; nothing at the end.
    pub(super) fn step_s(&self) -> Option<f64> {
        (self.at + 1 < self.rows.end).then(|| self.t_s[self.at + 1] - self.t_s[self.at])
    }

    /// Moves so that `at` is the last row not after `t`.
    #[inline]
    pub(super) fn seek(&mut self, t: f64) {
        while self.at > self.rows.start && self.t_s[self.at] > t {
            self.at -= 1;
        }
        while self.at + 1 < self.rows.end && self.t_s[self.at + 1] <= t {
            self.at += 1;
        }
    }

    /// Value at a time: straight lines, or the last value held; the first and last value beyond the ends.
    #[inline]
    pub fn value(&mut self, series: &[f64], t: f64, held: bool) -> f64 {
        self.seek(t);
        let at = self.at;
        let here = series[at];
        if t <= self.t_s[at] || at + 1 >= self.rows.end || held {
            return here;
        }
        let h = self.t_s[at + 1] - self.t_s[at];
        here + (series[at + 1] - here) * ((t - self.t_s[at]) / h)
    }

    /// Integral (as [`integral`] gives it at rows) at a time; beyond the ends the signal holds its end values.
    #[inline]
    pub fn integral(&mut self, integral: &[f64], series: &[f64], t: f64, held: bool) -> f64 {
        self.seek(t);
        integral[self.at] + self.beyond(series, t, held)
    }

    /// Integral from the row where the cursor stands to a time before the next one, or beyond the ends.
    #[inline]
    pub(super) fn beyond(&self, series: &[f64], t: f64, held: bool) -> f64 {
        let at = self.at;
        let h = t - self.t_s[at];
        if h <= 0.0 || at + 1 >= self.rows.end || held {
            return series[at] * h;
        }
        let step = self.t_s[at + 1] - self.t_s[at];
        let end = series[at] + (series[at + 1] - series[at]) * (h / step);
        0.5 * (series[at] + end) * h
    }
}

/// Of each stretch of readings, whether they were taken at the recorded rows of their segment.
fn on_rows(drive: &Drive, observed: &Observed) -> Vec<bool> {
    let stretches = observed.stretches.iter();
    stretches
        .map(|(segment, these)| {
            let rows = drive.segments.get(segment).cloned().unwrap_or_default();
            let recorded = drive.t_s[rows].iter().step_by(drive.stride());
            recorded.eq(&observed.t_s[these])
        })
        .collect()
}

/// Every `stride`-th row of a series of even steps, later by some steps; straight lines between rows, the first and last value
/// beyond the ends.
fn moved(series: &[f64], stride: usize, steps: f64, out: &mut [f64]) {
    let (Some(first), Some(last)) = (series.first(), series.last()) else {
        return;
    };
    let count = series.len() as isize;
    // Each value lies so many rows behind its own, and by this share of a step ahead of that.
    let back = steps.ceil().clamp(-count as f64, count as f64);
    let share = (back - steps).clamp(0.0, 1.0);
    let (back, stride) = (back as isize, stride as isize);
    let rows = out.len() as isize;
    // The first that has a row ahead of it, and the first that has none behind it.
    let begin = ((back + stride - 1).div_euclid(stride)).clamp(0, rows);
    let end = ((count - 1 + back + stride - 1).div_euclid(stride)).clamp(begin, rows);
    let (head, rest) = out.split_at_mut(begin as usize);
    let (middle, tail) = rest.split_at_mut((end - begin) as usize);
    head.fill(*first);
    tail.fill(*last);
    if middle.is_empty() {
        return;
    }
    let pairs = series[(begin * stride - back) as usize..].windows(2);
    for (out, pair) in middle.iter_mut().zip(pairs.step_by(stride as usize)) {
        *out = pair[0] + (pair[1] - pair[0]) * share;
    }
}

/// Every `stride`-th row of a series of even steps at another rate, and later by some steps.
fn stretched(series: &[f64], stride: usize, rate: f64, steps: f64, out: &mut [f64]) {
    let (Some(first), Some(last)) = (series.first(), series.last()) else {
        return;
    };
    for (row, out) in out.iter_mut().enumerate() {
        let at = (row * stride) as f64 * rate - steps;
        let whole = at as usize;
        *out = match (series.get(whole), series.get(whole + 1)) {
            (Some(here), Some(next)) if at > 0.0 => here + (next - here) * (at - whole as f64),
            (Some(_), _) if at <= 0.0 => *first,
            _ => *last,
        };
    }
}

/// [`f64::round`] of what is less than 2⁵² in size, without a call.
pub fn rounded(value: f64) -> f64 {
    /// The largest number below a half.
    const HALF: f64 = 0.499_999_999_999_999_94;
    (value + HALF.copysign(value)) as i64 as f64
}

/// [`f64::floor`] of what is less than 2⁵² in size, without a call.
pub fn floored(value: f64) -> f64 {
    let whole = value as i64 as f64;
    if whole > value { whole - 1.0 } else { whole }
}

impl<'a> Scene<'a> {
    /// The simulation before any effect.
    pub fn new(problem: &'a Problem) -> Self {
        let drive = &problem.drive;
        let (sensor, battery) = match &problem.base {
            Base::Sensor(base) => (Some(base), None),
            Base::Battery(base) => (None, Some(Battery::new(base, drive))),
        };
        Self {
            drive,
            observed: &problem.observed,
            steps: Arc::new(Steps::new(drive)),
            on_rows: Arc::new(on_rows(drive, &problem.observed)),
            operations: Arc::new(drive.operation_of_each()),
            changes: Arc::new(range_changes(drive, sensor)),
            signal: drive.reference.clone(),
            between: Between::default(),
            delay_s: 0.0,
            skew: 0.0,
            sensor,
            battery,
        }
    }

    /// Whether the reference stays at its value until its next row.
    pub fn held(&self) -> bool {
        self.sensor.is_some_and(|sensor| sensor.held_reference)
    }

    /// First-order low-pass that goes on over gaps: of what has a memory whether it is looked at or not.
    pub fn low_pass_over_gaps(&self, input: &[f64], tau_s: f64) -> Vec<f64> {
        let operations = self.drive.operations();
        self.steps.low_pass(&operations, input, tau_s, self.held())
    }

    /// From drive rows to the observation's rows.
    pub fn sample(&mut self, view: View) {
        let drive = self.drive;
        let observed = self.observed;
        let shifted = self.delay_s != 0.0 || self.skew != 0.0;
        let on_rows = !shifted && !matches!(observed.moments, Moments::Own);
        // The signal is asked for where it is known already, or from row to row.
        if on_rows || view == View::Charge {
            self.onto_rows();
        }
        if !shifted && view != View::Charge {
            match &observed.moments {
                Moments::EveryRow => return,
                Moments::Rows(rows) => {
                    self.signal = rows.iter().map(|&row| self.signal[row]).collect();
                    return;
                }
                Moments::Own => (),
            }
        }
        let held = self.held();
        let total = (view == View::Charge)
            .then(|| integral(&drive.t_s, &drive.segments, &self.signal, held));
        let mut sampled = vec![f64::NAN; observed.t_s.len()];
        let (skew, delay_s) = (1.0 + self.skew, self.delay_s);
        let mut known: (usize, Option<(f64, f64)>) = (usize::MAX, None);
        let straight = self.is_straight();
        let mut at_rows: Option<Series> = None;
        // One stretch of readings after the other, each within one segment.
        for ((segment, these), on_rows) in observed.stretches.iter().zip(self.on_rows.iter()) {
            let rows = drive.segments.get(segment).cloned();
            let Some(rows) = rows.filter(|rows| !rows.is_empty()) else {
                continue;
            };
            // A clock runs on while nothing is recorded. What one of another rate points to in a gap nobody knows; what is late by
            // a constant time lies there on a straight line between the gap's ends.
            let operation = self.operations[segment].clone();
            let start = drive.t_s[operation.start];
            // What the sensor's clock calls t was at this time. Most clocks are right, and a division by 1 takes as long as any other.
            let reference_s = |t: f64| {
                let since_s = t - start;
                let since_s = if skew == 1.0 { since_s } else { since_s / skew };
                start + since_s - delay_s
            };
            let around = if total.is_some() {
                rows.clone()
            } else {
                operation.clone()
            };
            let mut cursor = Cursor::within(&drive.t_s, around, rows.start);
            let ends_s = [drive.t_s[rows.start], drive.t_s[rows.end - 1]];
            let is_ahead = |t: f64| operation.start < rows.start && t < ends_s[0];
            let is_behind = |t: f64| rows.end < operation.end && t > ends_s[1];
            let mut at = |signal: &[f64], t: f64| {
                if skew != 1.0 && (is_ahead(t) || is_behind(t)) {
                    f64::NAN
                } else {
                    cursor.value(signal, t, held)
                }
            };
            let times = &observed.t_s[these.clone()];
            let values = &mut sampled[these.clone()];
            if !straight {
                self.at(segment, times, reference_s, values);
                if operation == rows {
                    // No gap to point into.
                    continue;
                }
                let shifted = times.iter().map(|t| reference_s(*t));
                for (value, t) in values.iter_mut().zip(shifted) {
                    if is_ahead(t) || is_behind(t) {
                        let at_rows = at_rows.get_or_insert_with(|| self.at_rows());
                        *value = at(at_rows, t);
                    }
                }
                continue;
            }
            // Rows of even steps: all of them move by the same part of a step.
            if let Some(Some(step_s)) = self.steps.even_s.get(segment)
                && (*on_rows && !held && total.is_none())
            {
                let (series, stride) = (&self.signal[rows.clone()], drive.stride());
                let steps = delay_s / step_s;
                if skew == 1.0 {
                    moved(series, stride, steps, values);
                } else {
                    // By how much the clock was off when the segment began.
                    let before = (drive.t_s[rows.start] - start) / step_s * (1.0 - 1.0 / skew);
                    stretched(series, stride, 1.0 / skew, steps + before, values);
                }
                let ahead = (times.iter().zip(values.iter_mut()))
                    .map(|(t, value)| (reference_s(*t), value))
                    .take_while(|(t, _)| is_ahead(*t));
                ahead.for_each(|(t, value)| *value = at(&self.signal, t));
                let behind = (times.iter().zip(values.iter_mut()).rev())
                    .map(|(t, value)| (reference_s(*t), value))
                    .take_while(|(t, _)| is_behind(*t));
                behind.for_each(|(t, value)| *value = at(&self.signal, t));
                continue;
            }
            let Some(total) = &total else {
                for (value, t) in values.iter_mut().zip(times) {
                    *value = at(&self.signal, reference_s(*t));
                }
                continue;
            };
            if known.0 != segment {
                known = (segment, None);
            }
            let last = &mut known.1;
            for (value, t) in values.iter_mut().zip(times) {
                let t = reference_s(*t);
                let charge = cursor.integral(total, &self.signal, t, held);
                if let Some((before_t, before)) = *last
                    && t > before_t
                {
                    *value = (charge - before) / (t - before_t);
                }
                // Each reading is a mean since the one before, whether that one counts or not.
                *last = Some((t, charge));
            }
        }
        self.signal = sampled.into();
        self.between = Between::default();
    }

    /// What the signal is at the drive's rows, once everything has looked at it.
    fn at_rows(&self) -> Series {
        let mut scene = self.clone();
        scene.onto_rows();
        scene.signal
    }
}

/// The lowest and the highest state of charge that a drive passes, by design; none without a row.
pub fn charge_range(base: &BatteryBase, drive: &Drive) -> Option<(f64, f64)> {
    let mut battery = Battery::new(base, drive);
    battery.count(drive, &drive.reference);
    let passed = battery.soc.iter().filter(|soc| soc.is_finite());
    passed.fold(None, |range, &soc| {
        let (low, high) = range.unwrap_or((soc, soc));
        Some((f64::min(low, soc), f64::max(high, soc)))
    })
}

impl<'a> Battery<'a> {
    fn new(base: &'a BatteryBase, drive: &Drive) -> Self {
        let rows = drive.len();
        let temperature_c = drive
            .battery_temperature()
            .cloned()
            .unwrap_or_else(|| vec![REFERENCE_C; rows].into());
        Self {
            base,
            capacity_ah: base.capacity_ah,
            efficiency: if base.efficiency > 0.0 {
                base.efficiency
            } else {
                1.0
            },
            soc_shift: Vec::new(),
            gap_soc_shift: Vec::new(),
            before_a: 0.0,
            gap_mean_a: Vec::new(),
            resistance: 1.0,
            soc: Series::default(),
            open_circuit_v: Series::default(),
            temperature_c,
            arrhenius_k: None,
            factor: vec![1.0; rows].into(),
            added_v: vec![0.0; rows].into(),
        }
    }

    /// Counts the charge: after the stage of charge.
    pub fn count(&mut self, drive: &Drive, current_a: &[f64]) {
        let mut soc = vec![0.0; drive.len()];
        let per_as = 1.0 / (3600.0 * self.capacity_ah);
        let of_segment = |values: &[f64], index: usize| values.get(index).copied();
        let operations = drive.operation_numbers();
        let mut end = 1.0;
        self.gap_mean_a.clear();
        for (index, rows) in drive
            .segments
            .iter()
            .enumerate()
            .filter(|(_, rows)| !rows.is_empty())
        {
            let first = if drive.is_continued(index) {
                let excess_ah = of_segment(&self.base.gap_excess_ah, index).unwrap_or_default();
                let gap_s = drive.t_s[rows.start] - drive.t_s[rows.start - 1];
                let ends = [current_a[rows.start - 1], current_a[rows.start]];
                let first = end
                    - gap_ah(ends, gap_s, excess_ah, self.efficiency) / self.capacity_ah
                    + of_segment(&self.gap_soc_shift, index).unwrap_or_default();
                let is_open =
                    of_segment(&self.base.gap_soc_sigma, index).is_some_and(|sigma| sigma > 0.0);
                // Where more flowed than by the line, that is no picture of the current.
                if is_open || excess_ah != 0.0 {
                    let mean_a = (end - first) / (per_as * gap_s);
                    self.gap_mean_a.push((rows.start, mean_a));
                }
                first
            } else {
                of_segment(&self.base.initial_soc, index).unwrap_or(1.0)
                    + of_segment(&self.soc_shift, operations[index]).unwrap_or_default()
            };
            soc[rows.start] = first;
            let mut last = first;
            for row in rows.start + 1..rows.end {
                let [from, to] = drive.ends(row, [current_a[row - 1], current_a[row]]);
                let mean = mean_flow(from, to, self.efficiency);
                last -= mean * (drive.t_s[row] - drive.t_s[row - 1]) * per_as;
                soc[row] = last;
            }
            end = last;
        }
        self.soc = soc.into();
    }

    /// The mean current over gaps over which it was no straight line, or may not have been, in A, times the factor on every resistance: where each ends.
    pub fn driven_over_gaps(&self) -> Vec<(usize, f64)> {
        let gaps = self.gap_mean_a.iter();
        gaps.map(|(row, mean_a)| {
            let factor = 0.5 * (self.factor[row - 1] + self.factor[*row]);
            (*row, mean_a * factor)
        })
        .collect()
    }

    /// What drives the branches in the long run before the first operation, in A: with the factor of resistance that it begins with.
    pub fn driven_before(&self) -> f64 {
        self.before_a * self.factor.first().copied().unwrap_or(1.0)
    }

    /// Looks up the open-circuit voltage: after the charge is counted.
    pub fn open_circuit(&mut self) {
        self.open_circuit_v = open_circuit_v(&self.base.ocv, &self.soc).into();
    }

    /// Adds what the curve bends between the points of its table, in V of one cell half-way between them: after it was looked up.
    pub fn bend(&mut self, bend_v: &[f64]) {
        if bend_v.iter().any(|v| *v != 0.0) {
            let of_string: Vec<f64> = bend_v.iter().map(|v| v * self.base.cells).collect();
            let table = &self.base.ocv;
            ocv::bend(table, &of_string, &self.soc, &mut self.open_circuit_v);
        }
    }

    /// The factor on every resistance that follows from temperature. Where no effect says how, resistances stay as they are between the
    /// temperatures at which they are known, in °C, and follow it as is usual beyond.
    pub fn warm(&mut self, known_at_c: Option<[f64; 2]>, drive: &Drive) {
        if let Some(b_k) = self.arrhenius_k {
            for (factor, t) in self.factor.iter_mut().zip(&self.temperature_c) {
                *factor *= arrhenius(b_k, *t);
            }
        } else if let (Some([low, high]), Some(recorded)) =
            (known_at_c, drive.battery_temperature())
        {
            for (factor, t) in self.factor.iter_mut().zip(recorded) {
                let nearest = t.clamp(low, high);
                if nearest != *t {
                    *factor *= arrhenius(USUAL_B_K, *t) / arrhenius(USUAL_B_K, nearest);
                }
            }
        }
    }

    /// The voltage from everything, in place of the current: open circuit, ohmic drop and what was added.
    pub fn voltage(&self, signal: &mut [f64]) {
        let ohms = self.base.resistance_ohm * self.resistance;
        let cells = self.base.cells;
        for (((value, open_v), factor), added_v) in signal
            .iter_mut()
            .zip(&self.open_circuit_v)
            .zip(&self.factor)
            .zip(&self.added_v)
        {
            *value = open_v - ohms * factor * *value + cells * added_v;
        }
    }
}

/// Mean of a current that goes in a straight line, what of it charges (below 0) times the efficiency.
pub fn mean_flow(from: f64, to: f64, efficiency: f64) -> f64 {
    let charging = match (from < 0.0, to < 0.0) {
        (true, true) => 0.5 * (from + to),
        (true, false) => 0.5 * from * from / (from - to),
        (false, true) => 0.5 * to * to / (to - from),
        (false, false) => 0.0,
    };
    0.5 * (from + to) - (1.0 - efficiency) * charging
}

/// Ah that leave a battery over a gap in its current: by a straight line through the current at its ends, or with what a counter says
/// to have flowed beyond that. Where only the sum is known, it charges if it is below 0.
pub fn gap_ah(ends_a: [f64; 2], gap_s: f64, excess_ah: f64, efficiency: f64) -> f64 {
    let [from, to] = ends_a;
    if excess_ah == 0.0 {
        return mean_flow(from, to, efficiency) * gap_s / 3600.0;
    }
    let flowed_ah = 0.5 * (from + to) * gap_s / 3600.0 + excess_ah;
    if flowed_ah < 0.0 {
        efficiency * flowed_ah
    } else {
        flowed_ah
    }
}

/// Factor of a resistance of Arrhenius temperature `b_k`, in K, from 25 °C to a temperature.
pub fn arrhenius(b_k: f64, temperature_c: f64) -> f64 {
    let inverse = 1.0 / (temperature_c + ZERO_CELSIUS_K) - 1.0 / (REFERENCE_C + ZERO_CELSIUS_K);
    (b_k * inverse).exp()
}

#[cfg(test)]
#[allow(clippy::single_range_in_vec_init, reason = "one segment")]
pub(super) mod tests {
    use super::*;

    /// One segment.
    pub(in crate::effects) fn drive(t_s: &[f64]) -> Drive {
        Drive {
            t_s: t_s.to_vec().into(),
            reference: vec![0.0; t_s.len()].into(),
            segments: vec![0..t_s.len()],
            continues: vec![false],
            ..Drive::default()
        }
    }

    #[test]
    fn a_low_pass_follows_a_ramp_late_by_tau() {
        let t_s: Vec<f64> = (0..2000).map(|k| f64::from(k) * 0.01).collect();
        let output = Steps::new(&drive(&t_s)).low_pass(&[0..2000], &t_s, 0.5, false);
        assert!((output[1999] - (t_s[1999] - 0.5)).abs() < 1e-9);
    }

    #[test]
    fn a_series_of_even_steps_moves_as_any_other() {
        let t_s: Vec<f64> = (0..50).map(|k| f64::from(k) * 0.1).collect();
        let series: Vec<f64> = t_s.iter().map(|t| (7.0 * t).sin()).collect();
        for steps in [
            -60.0, -50.0, -49.5, -7.0, -1.3, -0.2, 0.0, 0.4, 1.0, 2.6, 48.9, 49.0, 50.0, 70.2,
        ] {
            for (rate, stride) in [(1.0, 1), (0.8, 1), (1.1, 1), (1.0, 2), (1.0, 3), (1.1, 3)] {
                let mut out = vec![f64::NAN; 49 / stride + 1];
                if rate == 1.0 {
                    moved(&series, stride, steps, &mut out);
                } else {
                    stretched(&series, stride, rate, steps, &mut out);
                }
                let mut cursor = Cursor::new(&t_s, 0..50);
                for (out, t) in out.iter().zip(t_s.iter().step_by(stride)) {
                    let there = cursor.value(&series, rate * t - 0.1 * steps, false);
                    assert!((out - there).abs() < 1e-9, "{steps} {rate} {stride} {t}");
                }
            }
        }
    }

    #[test]
    fn rounding_without_a_call_is_the_same() {
        for value in [
            0.0,
            0.5,
            1.5,
            2.5,
            0.499_999_999_999_999_94,
            1e9 + 0.5,
            3.0,
            3.2,
            3.7,
            1e15 + 0.5,
        ] {
            for value in [value, -value] {
                assert_eq!(rounded(value), value.round());
                assert_eq!(floored(value), value.floor());
            }
        }
    }

    #[test]
    fn only_what_charges_is_lost() {
        // 3 A to −1 A: three quarters of the time it discharges, 1.5 A on the mean.
        assert!((mean_flow(3.0, -1.0, 0.0) - 0.75 * 1.5).abs() < 1e-12);
        assert!((mean_flow(-1.0, 3.0, 0.0) - 0.75 * 1.5).abs() < 1e-12);
        assert!((mean_flow(3.0, -1.0, 1.0) - 1.0).abs() < 1e-12);
        assert!((mean_flow(-2.0, -4.0, 0.9) + 2.7).abs() < 1e-12);
        assert!((mean_flow(2.0, 4.0, 0.9) - 3.0).abs() < 1e-12);
    }

    #[test]
    fn a_low_pass_of_a_step_is_the_exponential() {
        let t_s: Vec<f64> = (0..100).map(|k| f64::from(k) * 0.1).collect();
        let mut step = vec![1.0; 100];
        step[0] = 0.0;
        let held = Steps::new(&drive(&t_s)).low_pass(&[0..100], &step, 2.0, true);
        // The held 0 lasts until the second row.
        assert!((held[41] - (1.0 - (-4.0f64 / 2.0).exp())).abs() < 1e-9);
    }
}
