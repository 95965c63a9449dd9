//! The simulation while effects act on it: series on the drive's rows, then on the observation's.

use std::collections::HashMap;
use std::ops::Range;

use crate::problem::{Base, BatteryBase, Drive, Observed, Problem, SensorBase, View};

/// Reference temperature of every temperature coefficient, in °C.
pub const REFERENCE_C: f64 = 25.0;
/// 0 °C in K.
pub const ZERO_CELSIUS_K: f64 = 273.15;

/// Kinds of step that are remembered while steps are told apart.
const KNOWN: usize = 16;

/// What sizes are natural in a problem: bounds and starts follow from it.
#[derive(Clone, Copy, Debug, Default)]
pub struct Scale {
    /// Largest abs(reference).
    pub largest: f64,
    /// Root mean square of the reference.
    pub rms: f64,
    /// Full scale of the sensor: as stated, else the largest reading.
    pub full_scale: f64,
    /// Root mean square of what is to be explained.
    pub mismatch: f64,
    /// Median step of the drive in s.
    pub step_s: f64,
    /// Median step of the readings that count, in s.
    pub reading_step_s: f64,
    /// Time covered in s; of the longest segment.
    pub span_s: f64,
    /// Capacity of the battery in Ah, 0 without one.
    pub capacity_ah: f64,
    /// Ohmic resistance by design in Ω.
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
    pub steps: &'a Steps,
    /// The signal: on drive rows before [`super::Stage::Output`], then on the observation's rows.
    pub signal: Vec<f64>,
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
    /// Added to the initial state of charge, 0 … 1.
    pub soc_shift: f64,
    /// Factor of the ohmic resistance by design.
    pub resistance: f64,
    /// State of charge, 0 … 1; filled between the stages of charge and temperature.
    pub soc: Vec<f64>,
    /// Temperature of the cell in °C.
    pub temperature_c: Vec<f64>,
    /// Arrhenius temperature of the resistance in K, once known.
    pub arrhenius_k: Option<f64>,
    /// Factor on every resistance.
    pub factor: Vec<f64>,
    /// Voltage added to open circuit and ohmic drop, in V.
    pub added_v: Vec<f64>,
}

/// Steps between the drive's rows, told apart to a nanosecond (differences of times carry rounding). Steps repeat, with some
/// jitter: a filter needs the exponential of each kind once, not of each row.
#[derive(Clone, Debug, Default)]
pub struct Steps {
    /// Kind of the step that ends at each row; 0: no step.
    kind: Vec<u32>,
    /// Length of each kind in s.
    length_s: Vec<f64>,
}

impl Steps {
    /// Of a drive's rows.
    pub fn new(t_s: &[f64], segments: &[Range<usize>]) -> Self {
        let mut kind = vec![0; t_s.len()];
        let mut length_s = vec![0.0];
        let mut numbers: HashMap<u64, u32> = HashMap::new();
        let mut known = [(u64::MAX, 0u32); KNOWN];
        for rows in segments.iter().filter(|rows| !rows.is_empty()) {
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
        Self { kind, length_s }
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
        for rows in segments.iter().filter(|rows| !rows.is_empty()) {
            let mut last = input[rows.start];
            let after = rows.start + 1..rows.end;
            let pairs = input[rows.clone()].windows(2);
            for ((pair, out), kind) in pairs.zip(&mut output[after.clone()]).zip(&self.kind[after])
            {
                let [kept, from, to] = weights[*kind as usize];
                last = kept * last + (from * pair[0] + to * pair[1]);
                *out = last;
            }
        }
        output
    }

    /// A sum of first-order low-passes of one input, each with a weight, all at rest when a segment begins: one pass over the
    /// rows.
    pub fn ladder<const N: usize>(
        &self,
        segments: &[Range<usize>],
        input: &[f64],
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
            let after = rows.start + 1..rows.end;
            let pairs = input[rows.clone()].windows(2);
            for ((pair, out), kind) in pairs.zip(&mut output[after.clone()]).zip(&self.kind[after])
            {
                let [kept, from, to] = &of_kind[*kind as usize];
                let mut sum = 0.0;
                for k in 0..N {
                    last[k] = kept[k] * last[k] + (from[k] * pair[0] + to[k] * pair[1]);
                    sum += last[k];
                }
                *out = sum;
            }
        }
        output
    }
}

/// Integral over time from the start of each segment: trapezoids, or the last value held.
pub fn integral(t_s: &[f64], segments: &[Range<usize>], input: &[f64], held: bool) -> Vec<f64> {
    let mut output = vec![0.0; input.len()];
    for rows in segments.iter().filter(|rows| !rows.is_empty()) {
        let mut sum = 0.0;
        let steps = t_s[rows.clone()].windows(2);
        let pairs = input[rows.clone()].windows(2);
        for ((out, times), pair) in output[rows.start + 1..rows.end]
            .iter_mut()
            .zip(steps)
            .zip(pairs)
        {
            let mean = if held {
                pair[0]
            } else {
                0.5 * (pair[1] + pair[0])
            };
            sum += mean * (times[1] - times[0]);
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

    /// Moves so that `at` is the last row not after `t`.
    #[inline]
    fn seek(&mut self, t: f64) {
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
        let at = self.at;
        let h = t - self.t_s[at];
        if h <= 0.0 {
            // Before the first row.
            return integral[at] + series[at] * h;
        }
        if at + 1 >= self.rows.end || held {
            return integral[at] + series[at] * h;
        }
        let step = self.t_s[at + 1] - self.t_s[at];
        let end = series[at] + (series[at + 1] - series[at]) * (h / step);
        integral[at] + 0.5 * (series[at] + end) * h
    }
}

/// Boxcar mean over the `window_s` before each row; before the start of a segment the signal stood at its first value.
pub fn boxcar(
    t_s: &[f64],
    segments: &[Range<usize>],
    input: &[f64],
    window_s: f64,
    held: bool,
) -> Vec<f64> {
    let mut output = input.to_vec();
    if window_s.is_nan() || window_s <= 0.0 {
        return output;
    }
    let total = integral(t_s, segments, input, held);
    for rows in segments {
        let (t, x, total) = (
            &t_s[rows.clone()],
            &input[rows.clone()],
            &total[rows.clone()],
        );
        // The row that the window begins after: times go forward within a segment.
        let mut at = 0;
        for ((out, now), until) in output[rows.clone()].iter_mut().zip(t).zip(total) {
            let begin = now - window_s;
            while at + 1 < t.len() && t[at + 1] <= begin {
                at += 1;
            }
            let h = begin - t[at];
            let start = if h <= 0.0 || held || at + 1 >= t.len() {
                total[at] + x[at] * h
            } else {
                let end = x[at] + (x[at + 1] - x[at]) * (h / (t[at + 1] - t[at]));
                total[at] + 0.5 * (x[at] + end) * h
            };
            *out = (until - start) / window_s;
        }
    }
    output
}

impl<'a> Scene<'a> {
    /// The simulation before any effect.
    pub fn new(problem: &'a Problem, steps: &'a Steps) -> Self {
        let drive = &problem.drive;
        let (sensor, battery) = match &problem.base {
            Base::Sensor(base) => (Some(base), None),
            Base::Battery(base) => (None, Some(Battery::new(base, drive))),
        };
        Self {
            drive,
            observed: &problem.observed,
            steps,
            signal: drive.reference.clone(),
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

    /// First-order low-pass of the scene's own signal.
    pub fn low_pass(&self, input: &[f64], tau_s: f64) -> Vec<f64> {
        self.steps
            .low_pass(&self.drive.segments, input, tau_s, self.held())
    }

    /// From drive rows to the observation's rows.
    pub fn sample(&mut self, view: View) {
        let drive = self.drive;
        let observed = self.observed;
        let shifted = self.delay_s != 0.0 || self.skew != 0.0;
        if observed.on_drive_rows && !shifted && view != View::Charge {
            return;
        }
        let held = self.held();
        let total = (view == View::Charge)
            .then(|| integral(&drive.t_s, &drive.segments, &self.signal, held));
        let mut sampled = vec![f64::NAN; observed.t_s.len()];
        let (skew, delay_s) = (1.0 + self.skew, self.delay_s);
        let mut from = 0;
        let mut known: (usize, Option<(f64, f64)>) = (usize::MAX, None);
        // One stretch of readings after the other, each within one segment.
        for readings in observed.segment.chunk_by(|a, b| a == b) {
            let these = from..from + readings.len();
            from = these.end;
            let rows = drive.segments.get(readings[0]).cloned();
            let Some(rows) = rows.filter(|rows| !rows.is_empty()) else {
                continue;
            };
            let start = drive.t_s[rows.start];
            let mut cursor = Cursor::new(&drive.t_s, rows);
            let times = &observed.t_s[these.clone()];
            let values = &mut sampled[these.clone()];
            // What the sensor's clock calls t was at this time.
            let reference_s = |t: f64| start + (t - start) / skew - delay_s;
            let Some(total) = &total else {
                for (value, t) in values.iter_mut().zip(times) {
                    *value = cursor.value(&self.signal, reference_s(*t), held);
                }
                continue;
            };
            if known.0 != readings[0] {
                known = (readings[0], None);
            }
            let last = &mut known.1;
            for ((value, t), valid) in values.iter_mut().zip(times).zip(&observed.valid[these]) {
                let t = reference_s(*t);
                let charge = cursor.integral(total, &self.signal, t, held);
                if let Some((before_t, before)) = *last
                    && t > before_t
                {
                    *value = (charge - before) / (t - before_t);
                }
                if *valid || last.is_none() {
                    *last = Some((t, charge));
                }
            }
        }
        self.signal = sampled;
    }
}

impl<'a> Battery<'a> {
    fn new(base: &'a BatteryBase, drive: &Drive) -> Self {
        let rows = drive.len();
        let temperature_c = drive
            .cell_temperature_c
            .clone()
            .or_else(|| drive.ambient_c.clone())
            .unwrap_or_else(|| vec![REFERENCE_C; rows]);
        Self {
            base,
            capacity_ah: base.capacity_ah,
            efficiency: if base.efficiency > 0.0 {
                base.efficiency
            } else {
                1.0
            },
            soc_shift: 0.0,
            resistance: 1.0,
            soc: Vec::new(),
            temperature_c,
            arrhenius_k: None,
            factor: vec![1.0; rows],
            added_v: vec![0.0; rows],
        }
    }

    /// Counts the charge: after the stage of charge.
    pub fn count(&mut self, drive: &Drive, current_a: &[f64]) {
        let mut soc = vec![0.0; drive.len()];
        let per_as = 1.0 / (3600.0 * self.capacity_ah);
        let flow = |current: f64| {
            if current < 0.0 {
                current * self.efficiency
            } else {
                current
            }
        };
        for (index, rows) in drive
            .segments
            .iter()
            .enumerate()
            .filter(|(_, rows)| !rows.is_empty())
        {
            let first = self.base.initial_soc.get(index).copied().unwrap_or(1.0) + self.soc_shift;
            soc[rows.start] = first;
            for row in rows.clone().skip(1) {
                let h = drive.t_s[row] - drive.t_s[row - 1];
                let mean = 0.5 * (flow(current_a[row]) + flow(current_a[row - 1]));
                soc[row] = soc[row - 1] - mean * h * per_as;
            }
        }
        self.soc = soc;
    }

    /// What temperature does to the resistance: after the stage of temperature.
    pub fn warm(&mut self) {
        if let Some(b_k) = self.arrhenius_k {
            for (factor, t) in self.factor.iter_mut().zip(&self.temperature_c) {
                *factor *= arrhenius(b_k, *t);
            }
        }
    }

    /// The voltage from everything: open circuit, ohmic drop and what was added.
    pub fn voltage(&self, current_a: &[f64]) -> Vec<f64> {
        let ohms = self.base.resistance_ohm * self.resistance;
        let table = &self.base.ocv;
        let mut at = 0;
        self.soc
            .iter()
            .enumerate()
            .map(|(row, soc)| {
                open_circuit_v(table, *soc, &mut at) - ohms * self.factor[row] * current_a[row]
                    + self.added_v[row]
            })
            .collect()
    }
}

/// Factor of a resistance of Arrhenius temperature `b_k`, in K, from 25 °C to a temperature.
pub fn arrhenius(b_k: f64, temperature_c: f64) -> f64 {
    let inverse =
        1.0 / (temperature_c + ZERO_CELSIUS_K) - 1.0 / (REFERENCE_C + ZERO_CELSIUS_K);
    (b_k * inverse).exp()
}

/// Straight lines between the points of the table and beyond its ends; `at` is where the last look-up ended.
fn open_circuit_v(table: &[(f64, f64)], soc: f64, at: &mut usize) -> f64 {
    match table {
        [] => 0.0,
        [only] => only.1,
        _ => {
            let last = table.len() - 2;
            *at = (*at).min(last);
            while *at > 0 && table[*at].0 > soc {
                *at -= 1;
            }
            while *at < last && table[*at + 1].0 <= soc {
                *at += 1;
            }
            let (from, to) = (table[*at], table[*at + 1]);
            from.1 + (to.1 - from.1) * (soc - from.0) / (to.0 - from.0)
        }
    }
}

#[cfg(test)]
#[allow(clippy::single_range_in_vec_init, reason = "one segment")]
mod tests {
    use super::*;

    #[test]
    fn a_low_pass_follows_a_ramp_late_by_tau() {
        let t_s: Vec<f64> = (0..2000).map(|k| f64::from(k) * 0.01).collect();
        let output = Steps::new(&t_s, &[0..2000]).low_pass(&[0..2000], &t_s, 0.5, false);
        assert!((output[1999] - (t_s[1999] - 0.5)).abs() < 1e-9);
    }

    #[test]
    fn a_boxcar_follows_a_ramp_late_by_half_its_window() {
        let t_s: Vec<f64> = (0..2000).map(|k| f64::from(k) * 0.01).collect();
        let output = boxcar(&t_s, &[0..2000], &t_s, 0.333, false);
        assert!((output[1999] - (t_s[1999] - 0.1665)).abs() < 1e-9);
    }

    #[test]
    fn a_low_pass_of_a_step_is_the_exponential() {
        let t_s: Vec<f64> = (0..100).map(|k| f64::from(k) * 0.1).collect();
        let mut step = vec![1.0; 100];
        step[0] = 0.0;
        let held = Steps::new(&t_s, &[0..100]).low_pass(&[0..100], &step, 2.0, true);
        // The held 0 lasts until the second row.
        assert!((held[41] - (1.0 - (-4.0f64 / 2.0).exp())).abs() < 1e-9);
    }
}
