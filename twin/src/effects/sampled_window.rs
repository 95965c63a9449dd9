//! Only a part of each period is measured.

use std::borrow::Cow;

use super::between::Converter;
use super::scene::{Scale, Scene};
use crate::spectrum;

use super::{Card, Clues, Effect, Parameter, Search, Stage};

/// Rows that the course of the delay is fitted to.
const ENOUGH: usize = 4000;
/// Lines in the course of the delay that are followed: a load with a rhythm of its own has many beside the right one.
const LINES: usize = 16;
/// Rates of updates that are followed.
const UPDATES: usize = 6;
/// The best of the lines.
const BEST: usize = 6;
/// Added and taken away again, it leaves a number rounded: in lanes, as no conversion to an integer is.
const WHOLE: f64 = 1.5 * (1u64 << 52) as f64;
/// Cells of a grid that are followed over gaps of any length: windows keep their turn over some hours, and lines of their beat with them.
const CELLS: f64 = (1 << 18) as f64;
/// Cycles that the age of a reading goes through in a recording at least: with fewer it is a delay.
const CYCLES: f64 = 6.0;

/// See [`CARD`].
#[derive(Debug)]
pub struct SampledWindow;

static CARD: Card = Card {
    id: "sampled-window",
    statement: "The sensor measures only the first part of each period and holds that mean until the next one.",
    equation: "y = mean of i over the first duty·period of each period, held until the next (periods count from the operation's start plus a fitted phase, on over gaps)",
    parameters: &[
        Parameter::new("period_s", "s", 0.0, Search::Stepped),
        Parameter::new("duty", "1", 1.0, Search::Stepped)
            .within(0.0, 1.0)
            .open(),
        Parameter::internal("phase_s", "s", 0.0, Search::Stepped),
    ],
    shows: "beats with periodic loads",
    looks_like: &["moving-average", "delay", "lag", "gain", "clock-skew"],
    separated_by: "a load that switches with a period near that of the window",
    stage: Stage::Converter,
};

impl Effect for SampledWindow {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn bounds(&self, parameter: usize, scale: &Scale) -> (f64, f64) {
        match parameter {
            0 => (2e-3 * scale.step_s, 0.1 * scale.span_s),
            1 => (0.01, 1.0),
            _ => (-scale.span_s, scale.span_s),
        }
    }

    fn stands_for(&self) -> &'static [[&'static str; 2]] {
        // A reading that grows older from one to the next, beside what is late all the time, is a window's that is read ever later.
        &[["clock-skew", "delay"], ["clock-skew", "lag"]]
    }

    fn starts(&self, scale: &Scale, clues: &Clues<'_>) -> Vec<Vec<f64>> {
        let lowest = 2.5 * scale.step_s;
        let (_, highest) = self.bounds(0, scale);
        let mut starts = by_age(clues, scale);
        for (frequency_hz, moved_s) in updates(clues, scale) {
            for multiple in [1.0, 2.0] {
                let period = multiple / frequency_hz;
                if !(lowest..=highest).contains(&period) {
                    continue;
                }
                for duty in [0.1, 0.3, 0.6, 1.0] {
                    starts.push(vec![period, duty, 0.0]);
                    let phase = (moved_s - duty * period).rem_euclid(period);
                    starts.push(vec![period, duty, phase]);
                }
            }
        }
        starts
    }

    fn choices(&self, scale: &Scale) -> f64 {
        // Two a cycle of the beat that is resolved, up to one in two rows.
        (scale.operation_s / scale.even_s.max(1e-12)).max(1.0)
    }

    fn near(&self, values: &[f64], scale: &Scale, share: f64) -> Option<Vec<Vec<f64>>> {
        let (period, duty, phase) = (values[0], values[1], values[2]);
        let span = scale.operation_s.max(period);
        let along = |by: [f64; 3]| {
            [share, -share].map(|share| {
                let moved = values.iter().zip(by);
                moved.map(|(value, by)| value + share * by).collect()
            })
        };
        let mut near: Vec<Vec<f64>> = [
            // The period, with the windows in the middle of the recording where they are.
            [4.0 * period * period / span, 0.0, -2.0 * period],
            // All windows.
            [0.0, 0.0, 2.0 * period],
            // Where windows begin, and where they end.
            [0.0, 1.0, -period],
            [0.0, 1.0, 0.0],
        ]
        .into_iter()
        .flat_map(along)
        .collect();
        // Every second window, or one more between two.
        let length = duty * period;
        for (period, later) in [(2.0, 0.0), (2.0, 1.0), (0.5, 0.0)]
            .map(|(times, later)| (times * period, later * period))
        {
            let duty = (length / period).min(1.0);
            near.push(vec![period, duty, phase + length + later - duty * period]);
        }
        near.extend(
            [1.0, -1.0]
                .map(|turns| self.alias(values, scale, turns))
                .into_iter()
                .flatten(),
        );
        Some(near)
    }

    /// Readings are as old at their rows, and as late in the mean.
    fn alias(&self, values: &[f64], scale: &Scale, turns: f64) -> Option<Vec<f64>> {
        let (period, duty, phase) = (values[0], values[1], values[2]);
        let age = (-(phase / period + duty)).rem_euclid(1.0);
        let rate = 1.0 / period + turns / scale.even_s;
        (rate > 0.0).then(|| seen(1.0 / rate, 0.5 * period * (1.0 + duty), age))
    }

    fn turn(&self, values: &[f64]) -> Option<f64> {
        Some(values[0])
    }

    /// A mean is held for a period, and began a window before that.
    fn reach_s(&self, values: &[f64], _scale: &Scale) -> [f64; 2] {
        [values[0] * (1.0 + values[1]), 0.0]
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let (period, duty, phase) = (values[0], values[1], values[2]);
        if period <= 0.0 {
            return;
        }
        scene.convert(Converter::Windows {
            period_s: period,
            duty,
            phase_s: phase,
        });
    }
}

fn product(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// When a series of times in s and values is largest at a frequency, in turns from time 0, −½ … ½.
fn turns(frequency_hz: f64, series: impl Iterator<Item = (f64, f64)>) -> f64 {
    let (mut sine, mut cosine) = (0.0, 0.0);
    for (t, value) in series {
        let turn = std::f64::consts::TAU * frequency_hz * t;
        sine += value * turn.sin();
        cosine += value * turn.cos();
    }
    f64::atan2(sine, cosine) / std::f64::consts::TAU
}

/// Times as beats and rates of updates are looked for in.
fn laid_out(t_s: &[f64], step_s: f64) -> Cow<'_, [f64]> {
    match t_s {
        [first, .., last] if last - first > CELLS * step_s => spectrum::laid_out(t_s, step_s),
        _ => t_s.into(),
    }
}

/// Rates in Hz at which readings move, and when they first do, in s from the first reading: a held one moves at one phase of each
/// period only, however the current moves.
fn updates(clues: &Clues<'_>, scale: &Scale) -> Vec<(f64, f64)> {
    let moves = |series: &[f64]| -> Vec<f64> {
        std::iter::once(0.0)
            .chain(series.windows(2).map(|pair| (pair[1] - pair[0]).abs()))
            .map(|by| if by.is_finite() { by } else { 0.0 })
            .collect()
    };
    let (seen, simulated) = (moves(clues.observed), moves(clues.predicted));
    let share = product(&seen, &simulated) / product(&simulated, &simulated).max(1e-300);
    let beyond: Vec<f64> = seen
        .iter()
        .zip(&simulated)
        .map(|(seen, simulated)| seen - share * simulated)
        .collect();
    let t_s = laid_out(clues.t_s, scale.spectral_step_s);
    spectrum::strongest(&t_s, &beyond, scale.spectral_step_s, UPDATES)
        .into_iter()
        .filter(|frequency_hz| *frequency_hz > 0.0)
        .map(|frequency_hz| {
            let times = t_s.iter().map(|t| t - t_s[0]);
            // It is between two readings.
            let turns = turns(frequency_hz, times.zip(beyond.iter().copied()));
            (
                frequency_hz,
                turns / frequency_hz - 0.5 * scale.reading_step_s,
            )
        })
        .collect()
}

/// Values for windows of a period, from the mean time by which readings are late, and the age of the first reading in periods.
fn seen(period: f64, late_s: f64, age: f64) -> Vec<f64> {
    let duty = (2.0 * late_s / period - 1.0).clamp(0.05, 1.0);
    vec![period, duty, -(duty + age) * period]
}

/// Courses of the age that are summed side by side.
const WAYS: usize = 6;

/// Of courses of the age, each by its beat in Hz and its phase in turns: Σ rate·(rate·age), Σ (rate·age)² and Σ off·(rate·age) over rows
/// of time in s, rate and what they are off.
fn of_ages(ages: [[f64; 2]; WAYS], rows: impl Iterator<Item = [f64; 3]>) -> [[f64; 3]; WAYS] {
    let (mut ra, mut aa, mut oa) = ([0.0; WAYS], [0.0; WAYS], [0.0; WAYS]);
    for [t_s, rate, off] in rows {
        for (k, [beat_hz, phase]) in ages.iter().enumerate() {
            let turns = beat_hz * t_s + phase;
            let nearest = (turns + WHOLE) - WHOLE;
            let below = if nearest > turns { 1.0 } else { 0.0 };
            let age = rate * (turns - (nearest - below));
            ra[k] += rate * age;
            aa[k] += age * age;
            oa[k] += off * age;
        }
    }
    std::array::from_fn(|k| [ra[k], aa[k], oa[k]])
}

/// Starts from how late readings are: by half a window, and by their age, which rises from nothing to a period and falls back. At
/// the rows it does so at a beat of the period with them, also where the period is much shorter than a row.
fn by_age(clues: &Clues<'_>, scale: &Scale) -> Vec<Vec<f64>> {
    let step = scale.even_s;
    let [.., t_last] = clues.t_s else {
        return Vec::new();
    };
    let (t_first, span) = (clues.t_s[0], t_last - clues.t_s[0]);
    if !(step > 0.0 && span > 20.0 * step) {
        return Vec::new();
    }
    // A reading that is late by d is off by −d·di/dt.
    let (mut t_s, mut off, mut rate) = (Vec::new(), Vec::new(), Vec::new());
    for row in 1..clues.t_s.len() {
        let h = clues.t_s[row] - clues.t_s[row - 1];
        let slope = (clues.predicted[row - 1] - clues.predicted[row]) / h;
        let error = clues.observed[row] - clues.predicted[row];
        if h > 0.0 && h < 1.5 * step && slope.is_finite() && error.is_finite() {
            t_s.push(clues.t_s[row] - t_first);
            off.push(error);
            rate.push(slope);
        }
    }
    let all = product(&rate, &rate);
    if all.is_nan() || all <= 0.0 {
        return Vec::new();
    }
    let late_s = product(&off, &rate) / all;
    // Beats are followed without the days between two drives, as lines are.
    let shortened = laid_out(&t_s, step);
    let left_out_s = match (t_s.last(), shortened.last()) {
        (Some(t), Some(shortened)) => t - shortened,
        _ => 0.0,
    };
    let (t_s, span) = (shortened, span - left_out_s);
    let course: Vec<f64> = off
        .iter()
        .zip(&rate)
        .map(|(off, rate)| (off - late_s * rate) * rate)
        .collect();
    let stride = t_s.len().div_ceil(ENOUGH).max(1);
    let rows = || (0..t_s.len()).step_by(stride);
    let (rr, or) = rows().fold((0.0, 0.0), |(rr, or), row| {
        (rr + rate[row] * rate[row], or + off[row] * rate[row])
    });
    let row = |row: usize| [t_s[row], rate[row], off[row]];
    let mut found: Vec<(f64, [f64; 4])> = Vec::new();
    for line in spectrum::strongest(&t_s, &course, step, LINES) {
        if line * span < CYCLES {
            continue;
        }
        let mut best: Option<(f64, [f64; 4])> = None;
        for beat in [-0.5, -0.25, 0.0, 0.25, 0.5].map(|by| line + by / span) {
            let turns = -turns(beat, rows().map(|row| (t_s[row], course[row])));
            // Ages rise at the beat, or fall: where the period is a little shorter, or longer, than what fits into a row.
            let ages: [(f64, f64); WAYS] = {
                let [rises, falls] = [turns - 0.25, -turns - 0.25];
                [
                    (1.0, rises - 0.04),
                    (1.0, rises),
                    (1.0, rises + 0.04),
                    (-1.0, falls - 0.04),
                    (-1.0, falls),
                    (-1.0, falls + 0.04),
                ]
            };
            let sums = of_ages(
                ages.map(|(way, phase)| [way * beat, phase]),
                rows().map(row),
            );
            for ((way, phase), [ra, aa, oa]) in ages.into_iter().zip(sums) {
                let whole = rr * aa - ra * ra;
                if whole <= 0.0 {
                    continue;
                }
                let period = (oa * rr - or * ra) / whole;
                let least = (or * aa - oa * ra) / whole;
                let gain = period * oa + least * or;
                if period > 0.0 && best.is_none_or(|(most, _)| gain > most) {
                    best = Some((gain, [way * beat, phase, period, least]));
                }
            }
        }
        found.extend(best);
    }
    found.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut starts = Vec::new();
    for (_, [beat, phase, period, least]) in found.into_iter().take(BEST) {
        let late_s = least + 0.5 * period;
        let age = phase.rem_euclid(1.0);
        // The beat is the period's rate less a whole number of times that of the rows.
        let nearest = ((1.0 / period - beat) * step).round();
        // Of windows of some rows the course tells the beat only.
        for turns in [nearest - 1.0, nearest, nearest + 1.0, 0.0, 1.0, 2.0] {
            let rate = beat + turns / step;
            if rate > 0.0 && 1.0 / rate < 0.1 * span && late_s > 0.0 {
                starts.push(seen(1.0 / rate, late_s, age));
            }
        }
    }
    starts
}
