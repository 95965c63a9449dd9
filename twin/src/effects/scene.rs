//! The simulation while effects act on it: series on the drive's rows, then on the observation's.

use std::ops::Range;

use crate::problem::{Base, BatteryBase, Drive, Observed, Problem, SensorBase, View};

/// Reference temperature of every temperature coefficient, in °C.
pub const REFERENCE_C: f64 = 25.0;
/// 0 °C in K.
pub const ZERO_CELSIUS_K: f64 = 273.15;

/// Steps whose exponentials are kept.
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
    /// A consumer that the current sensor does not see, in A.
    pub load_a: f64,
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

/// First-order low-pass by straight lines between samples, exact (the drive's rows may be irregular).
///
/// y(t+h) = e^(−h/τ)·y + (1 − e^(−h/τ))·u₀ + (u₁−u₀)·(1 − τ/h·(1 − e^(−h/τ)))
pub fn low_pass(
    t_s: &[f64],
    segments: &[Range<usize>],
    input: &[f64],
    tau_s: f64,
    held: bool,
) -> Vec<f64> {
    let mut output = input.to_vec();
    if tau_s.is_nan() || tau_s <= 0.0 {
        return output;
    }
    // Steps repeat, with some jitter: an exponential for each row would be most of the time.
    let mut known = [(f64::NAN, 0.0, 0.0); KNOWN];
    for rows in segments.iter().filter(|rows| !rows.is_empty()) {
        let mut last = input[rows.start];
        output[rows.start] = last;
        for row in rows.start + 1..rows.end {
            let h = t_s[row] - t_s[row - 1];
            if h <= 0.0 {
                output[row] = last;
                continue;
            }
            // To a nanosecond: differences of times carry rounding.
            let nanos = (h * 1e9).round();
            let slot = &mut known[(nanos as u64 / 1_000_000) as usize % KNOWN];
            if slot.0 != nanos {
                let kept = (-h / tau_s).exp();
                *slot = (nanos, kept, 1.0 - tau_s / h * (1.0 - kept));
            }
            let (_, kept, ramp) = *slot;
            let from = input[row - 1];
            let rise = if held { 0.0 } else { input[row] - from };
            last = kept * last + (1.0 - kept) * from + rise * ramp;
            output[row] = last;
        }
    }
    output
}

/// A sum of first-order low-passes of one input, each with a weight, all at rest when a segment begins: one pass over the rows.
pub fn ladder<const N: usize>(
    t_s: &[f64],
    segments: &[Range<usize>],
    input: &[f64],
    taus_s: [f64; N],
    weights: [f64; N],
) -> Vec<f64> {
    let mut output = vec![0.0; input.len()];
    let mut known = [(f64::NAN, [0.0; N], [0.0; N]); KNOWN];
    for rows in segments.iter().filter(|rows| !rows.is_empty()) {
        let mut last = [0.0; N];
        for row in rows.start + 1..rows.end {
            let h = t_s[row] - t_s[row - 1];
            if h > 0.0 {
                let nanos = (h * 1e9).round();
                let slot = &mut known[(nanos as u64 / 1_000_000) as usize % KNOWN];
                if slot.0 != nanos {
                    slot.0 = nanos;
                    for (k, tau_s) in taus_s.iter().enumerate() {
                        let kept = (-h / tau_s).exp();
                        slot.1[k] = kept;
                        slot.2[k] = 1.0 - tau_s / h * (1.0 - kept);
                    }
                }
                let (from, rise) = (input[row - 1], input[row] - input[row - 1]);
                for (k, last) in last.iter_mut().enumerate() {
                    *last = slot.1[k] * (*last - from) + from + rise * slot.2[k];
                }
            }
            let mut sum = 0.0;
            for k in 0..N {
                sum += weights[k] * last[k];
            }
            output[row] = sum;
        }
    }
    output
}

/// Integral over time from the start of each segment: trapezoids, or the last value held.
pub fn integral(t_s: &[f64], segments: &[Range<usize>], input: &[f64], held: bool) -> Vec<f64> {
    let mut output = vec![0.0; input.len()];
    for rows in segments {
        for row in rows.clone().skip(1) {
            let h = t_s[row] - t_s[row - 1];
            let mean = if held {
                input[row - 1]
            } else {
                0.5 * (input[row] + input[row - 1])
            };
            output[row] = output[row - 1] + mean * h;
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

    /// Moves so that `at` is the last row not after `t`; false if `t` is outside by more than `slack_s`.
    fn seek(&mut self, t: f64) {
        while self.at > self.rows.start && self.t_s[self.at] > t {
            self.at -= 1;
        }
        while self.at + 1 < self.rows.end && self.t_s[self.at + 1] <= t {
            self.at += 1;
        }
    }

    /// Value at a time: straight lines, or the last value held; the first and last value beyond the ends.
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
        let mut back = Cursor::new(t_s, rows.clone());
        for row in rows.clone() {
            let start = back.integral(&total, input, t_s[row] - window_s, held);
            output[row] = (total[row] - start) / window_s;
        }
    }
    output
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
        low_pass(
            &self.drive.t_s,
            &self.drive.segments,
            input,
            tau_s,
            self.held(),
        )
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
        let mut current: Option<(usize, Cursor<'_>)> = None;
        let mut last: Option<(f64, f64)> = None;
        for (row, value) in sampled.iter_mut().enumerate() {
            let segment = observed.segment[row];
            let Some(rows) = drive.segments.get(segment).filter(|rows| !rows.is_empty()) else {
                continue;
            };
            if current.as_ref().is_none_or(|(known, _)| *known != segment) {
                current = Some((segment, Cursor::new(&drive.t_s, rows.clone())));
                last = None;
            }
            let Some((_, cursor)) = &mut current else {
                continue;
            };
            let start = drive.t_s[rows.start];
            // What the sensor's clock calls t was at this time.
            let t = start + (observed.t_s[row] - start) / (1.0 + self.skew) - self.delay_s;
            match &total {
                None => *value = cursor.value(&self.signal, t, held),
                Some(total) => {
                    let charge = cursor.integral(total, &self.signal, t, held);
                    if let Some((before_t, before)) = last
                        && t > before_t
                    {
                        *value = (charge - before) / (t - before_t);
                    }
                    if observed.valid[row] || last.is_none() {
                        last = Some((t, charge));
                    }
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
            load_a: 0.0,
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
            let current = current + self.load_a;
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
                let inverse = 1.0 / (t + ZERO_CELSIUS_K) - 1.0 / (REFERENCE_C + ZERO_CELSIUS_K);
                *factor *= (b_k * inverse).exp();
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
        let output = low_pass(&t_s, &[0..2000], &t_s, 0.5, false);
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
        let held = low_pass(&t_s, &[0..100], &step, 2.0, true);
        // The held 0 lasts until the second row.
        assert!((held[41] - (1.0 - (-4.0f64 / 2.0).exp())).abs() < 1e-9);
    }
}
