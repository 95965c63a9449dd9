//! Where the mismatch sits: the stretch of time, the operating region and the band of frequency that hold more of its energy
//! than of the samples, each with a p-value: of time from permuted blocks, of a region from the recording moved against it, of
//! frequency from the noise that the model file states, or from rows in any order where it states no memory.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng as _, SeedableRng as _};

use super::workbench::Workbench;
use crate::effects::scene::Cursor;
use crate::report::data::{Location, LocationKind};
use crate::spectrum;

/// Permutations.
const DRAWS: usize = 200;
/// Drawings of noise that a band of frequency is compared with, and of how many for recordings of more rows than [`LONG`].
const BANDS_DRAWS: u32 = 99;
const FEW_DRAWS: u32 = 20;
const LONG: usize = 20_000;
/// Quantiles at which a range may begin or end.
const EDGES: [f64; 11] = [0.0, 0.02, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.98, 1.0];
/// Stretches of time that are tried: this many of equal length, and runs of them.
const STRETCHES: usize = 24;
/// A place is worth a line if its share of energy is above its share of samples by this factor.
const WORTH: f64 = 1.5;
/// And if chance makes it no more often than this.
const CHANCE: f64 = 0.05;
/// Places that are named of each kind.
const MOST: usize = 3;

/// What an operating variable is of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// The reference itself.
    Itself,
    /// Its size.
    Size,
    /// How fast it changes.
    Rate,
    /// What was recorded beside it.
    Beside,
    /// The charge drawn.
    Charge,
    /// Time.
    Time,
}

/// An operating variable at the rows that count.
#[derive(Clone, Debug)]
pub struct Variable {
    /// What it is of.
    pub kind: Kind,
    /// Its name.
    pub name: &'static str,
    /// Its unit.
    pub unit: String,
    /// Its values.
    pub values: Vec<f64>,
}

/// Operating variables that the recording has.
pub fn variables(bench: &Workbench<'_>) -> Vec<Variable> {
    let drive = &bench.problem.drive;
    let unit = if bench.problem.view == crate::problem::View::Sensor {
        bench.problem.unit.clone()
    } else {
        "A".to_owned()
    };
    let x = &bench.reference;
    // What is no current is not called one.
    let [size, itself, rate_of] = if unit == "A" {
        ["abs(i)", "i", "abs(di/dt)"]
    } else {
        ["abs(x)", "x", "abs(dx/dt)"]
    };
    let mut variables = vec![
        Variable {
            kind: Kind::Size,
            name: size,
            unit: unit.clone(),
            values: x.iter().map(|x| x.abs()).collect(),
        },
        Variable {
            kind: Kind::Itself,
            name: itself,
            unit: unit.clone(),
            values: x.clone(),
        },
    ];
    let mut rate = vec![0.0; x.len()];
    for row in 1..x.len() {
        let h = bench.t_s[row] - bench.t_s[row - 1];
        if h > 0.0 {
            rate[row] = ((x[row] - x[row - 1]) / h).abs();
        }
    }
    variables.push(Variable {
        kind: Kind::Rate,
        name: rate_of,
        unit: format!("{unit}/s"),
        values: rate,
    });
    for (name, unit, series) in drive.surroundings() {
        variables.push(Variable {
            kind: Kind::Beside,
            name,
            unit: unit.to_owned(),
            values: at_rows(bench, series),
        });
    }
    if bench.scale.capacity_ah > 0.0 {
        let values = at_rows(bench, &drive.charge())
            .iter()
            .map(|q| q / 3600.0)
            .collect();
        variables.push(Variable {
            kind: Kind::Charge,
            name: "charge drawn",
            unit: "Ah".to_owned(),
            values,
        });
    }
    variables.retain(|variable| {
        let first = variable.values.first().copied().unwrap_or_default();
        variable.values.iter().any(|value| *value != first)
    });
    variables
}

fn at_rows(bench: &Workbench<'_>, series: &[f64]) -> Vec<f64> {
    let drive = &bench.problem.drive;
    let observed = &bench.problem.observed;
    let mut current: Option<(usize, Cursor<'_>)> = None;
    bench
        .rows
        .iter()
        .map(|&row| {
            if let Some(row) = observed.drive_row(row) {
                return series[row];
            }
            let segment = observed.segment_of(row);
            let Some(range) = drive
                .segments
                .get(segment)
                .filter(|range| !range.is_empty())
            else {
                return f64::NAN;
            };
            if current.as_ref().is_none_or(|(known, _)| *known != segment) {
                current = Some((segment, Cursor::new(&drive.t_s, range.clone())));
            }
            current.as_mut().map_or(f64::NAN, |(_, cursor)| {
                cursor.value(series, observed.t_s[row], true)
            })
        })
        .collect()
}

/// The places of a residual's energy, most telling first; at most three of each kind.
pub fn locate(bench: &Workbench<'_>, residual: &[f64], seed: u64) -> Vec<Location> {
    let energy: Vec<f64> = residual.iter().map(|r| r * r).collect();
    let total: f64 = energy.iter().sum();
    if total.is_nan() || total <= 0.0 || residual.len() < 40 {
        return Vec::new();
    }
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut locations = Vec::new();
    let mut regions: Vec<(f64, Location)> = variables(bench)
        .iter()
        .filter_map(|variable| region(bench, variable, &energy, total, &mut random))
        .collect();
    regions.sort_by(|a, b| b.0.total_cmp(&a.0));
    locations.extend(regions.into_iter().take(MOST).map(|(_, location)| location));
    locations.extend(stretch(bench, &energy, total, &mut random));
    locations.extend(band(bench, residual, &mut random));
    locations
}

/// How much a place tells: energy that is there beyond its share.
fn telling(energy_share: f64, sample_share: f64) -> f64 {
    if sample_share <= 0.0 || sample_share >= 1.0 {
        return 0.0;
    }
    // Information of the two-way split, in nats.
    let part = |e: f64, s: f64| if e > 0.0 { e * (e / s).ln() } else { 0.0 };
    part(energy_share, sample_share) + part(1.0 - energy_share, 1.0 - sample_share)
}

fn region(
    bench: &Workbench<'_>,
    variable: &Variable,
    energy: &[f64],
    total: f64,
    random: &mut ChaCha8Rng,
) -> Option<(f64, Location)> {
    let mut order: Vec<usize> = (0..energy.len())
        .filter(|&row| variable.values[row].is_finite())
        .collect();
    if order.len() < 40 {
        return None;
    }
    order.sort_unstable_by(|&a, &b| variable.values[a].total_cmp(&variable.values[b]));
    let count = order.len();
    // A range may only end where the value changes.
    let mut cuts: Vec<usize> = EDGES
        .iter()
        .map(|share| {
            let mut cut = ((count as f64) * share) as usize;
            while cut > 0
                && cut < count
                && variable.values[order[cut]] == variable.values[order[cut - 1]]
            {
                cut += 1;
            }
            cut
        })
        .collect();
    cuts.dedup();
    // Rows of one range mostly follow each other: runs of them, and what the energy adds up to until each row.
    let mut range_of = vec![usize::MAX; energy.len()];
    for (k, pair) in cuts.windows(2).enumerate() {
        for &row in &order[pair[0]..pair[1]] {
            range_of[row] = k;
        }
    }
    let mut runs: Vec<Vec<(usize, usize)>> = vec![Vec::new(); cuts.len()];
    let mut from = 0;
    for run in range_of.chunk_by(|a, b| a == b) {
        if let Some(runs) = runs.get_mut(run[0]) {
            runs.push((from, from + run.len()));
        }
        from += run.len();
    }
    let mut until = Vec::with_capacity(2 * energy.len() + 1);
    let mut sum = 0.0;
    until.push(sum);
    for value in energy.iter().chain(energy) {
        sum += value;
        until.push(sum);
    }
    let sums = |shift: usize| -> Vec<f64> {
        let shift = shift % energy.len();
        let mut sums = vec![0.0; cuts.len()];
        for k in 1..cuts.len() {
            let part: f64 = runs[k - 1]
                .iter()
                .map(|(from, to)| until[to + shift] - until[from + shift])
                .sum();
            sums[k] = sums[k - 1] + part;
        }
        sums
    };
    let best = |sums: &[f64]| -> (f64, usize, usize) {
        let mut best = (0.0, 0, 0);
        for from in 0..cuts.len() {
            for to in from + 1..cuts.len() {
                let samples = (cuts[to] - cuts[from]) as f64 / count as f64;
                let share = (sums[to] - sums[from]) / total;
                let tells = telling(share, samples);
                if share > samples && tells > best.0 {
                    best = (tells, from, to);
                }
            }
        }
        best
    };
    let here = sums(0);
    let (tells, from, to) = best(&here);
    if tells == 0.0 {
        return None;
    }
    let above = (0..DRAWS)
        .filter(|_| {
            let shift =
                energy.len() / 20 + (random.next_u32() as usize) % (energy.len() * 9 / 10).max(1);
            best(&sums(shift)).0 >= tells
        })
        .count();
    let p_value = (above + 1) as f64 / (DRAWS + 1) as f64;
    let (energy_share, sample_share) = (
        (here[to] - here[from]) / total,
        (cuts[to] - cuts[from]) as f64 / count as f64,
    );
    (p_value <= CHANCE && energy_share > WORTH.min(1.0 + 0.5 * (1.0 - sample_share)) * sample_share)
        .then(|| {
            (
                tells,
                Location {
                    signal: bench.problem.name.clone(),
                    kind: LocationKind::Region,
                    variable: variable.name.to_owned(),
                    unit: variable.unit.clone(),
                    from: (from > 0).then(|| variable.values[order[cuts[from]]]),
                    to: (cuts[to] < count).then(|| variable.values[order[cuts[to] - 1]]),
                    energy_share,
                    sample_share,
                    p_value,
                    effect: None,
                },
            )
        })
}

fn stretch(
    bench: &Workbench<'_>,
    energy: &[f64],
    total: f64,
    random: &mut ChaCha8Rng,
) -> Option<Location> {
    let count = energy.len();
    let cut = |k: usize| count * k / STRETCHES;
    let parts: Vec<f64> = (0..STRETCHES)
        .map(|k| energy[cut(k)..cut(k + 1)].iter().sum::<f64>() / total)
        .collect();
    let best = |parts: &[f64]| {
        let mut best = (0.0, 0, 0, 0.0);
        for from in 0..STRETCHES {
            let mut share = 0.0;
            for to in from + 1..=STRETCHES {
                share += parts[to - 1];
                let samples = (cut(to) - cut(from)) as f64 / count as f64;
                let tells = telling(share, samples);
                if share > samples && tells > best.0 {
                    best = (tells, from, to, share);
                }
            }
        }
        best
    };
    let (tells, from, to, energy_share) = best(&parts);
    let above = (0..DRAWS)
        .filter(|_| {
            let mut mixed = parts.clone();
            for k in (1..STRETCHES).rev() {
                mixed.swap(k, (random.next_u32() as usize) % (k + 1));
            }
            best(&mixed).0 >= tells
        })
        .count();
    let p_value = (above + 1) as f64 / (DRAWS + 1) as f64;
    let sample_share = (cut(to) - cut(from)) as f64 / count as f64;
    // Where a clock begins anew no time is before another.
    let goes_on = bench.t_s[cut(from)..cut(to)].is_sorted();
    (goes_on
        && p_value <= CHANCE
        && energy_share > WORTH.min(1.0 + 0.5 * (1.0 - sample_share)) * sample_share)
        .then(|| Location {
            signal: bench.problem.name.clone(),
            kind: LocationKind::Time,
            variable: "t_s".into(),
            unit: "s".into(),
            from: Some(bench.t_s[cut(from)]),
            to: Some(bench.t_s[cut(to) - 1]),
            energy_share,
            sample_share,
            p_value,
            effect: None,
        })
}

fn band(bench: &Workbench<'_>, residual: &[f64], random: &mut ChaCha8Rng) -> Option<Location> {
    let here = bands(bench, residual);
    let total: f64 = here.iter().map(|(_, _, energy)| energy).sum();
    let width = here.last().map(|(_, to, _)| *to)? - here.first().map(|(from, _, _)| *from)?;
    if !(total > 0.0 && width > 0.0) {
        return None;
    }
    let best = |bands: &[(f64, f64, f64)]| {
        let total: f64 = bands.iter().map(|(_, _, energy)| energy).sum();
        let mut best = (0.0, 0, 0, 0.0);
        for from in 0..bands.len() {
            let mut share = 0.0;
            for to in from..bands.len() {
                share += bands[to].2 / total;
                let of_width = (bands[to].1 - bands[from].0) / width;
                let tells = telling(share, of_width.min(1.0));
                if share > of_width && tells > best.0 {
                    best = (tells, from, to, share);
                }
            }
        }
        best
    };
    let (tells, from, to, energy_share) = best(&here);
    let mut drawn = residual.to_vec();
    let draws = if bench.len() > LONG {
        FEW_DRAWS
    } else {
        BANDS_DRAWS
    };
    let above = (0..draws)
        .filter(|_| {
            if !bench.draw_noise(&mut drawn, random) {
                // Without order, residuals are white.
                for k in (1..drawn.len()).rev() {
                    drawn.swap(k, (random.next_u64() % (k as u64 + 1)) as usize);
                }
            }
            best(&bands(bench, &drawn)).0 >= tells
        })
        .count();
    let p_value = (above + 1) as f64 / f64::from(draws + 1);
    let sample_share = ((here[to].1 - here[from].0) / width).min(1.0);
    (p_value <= CHANCE && energy_share > WORTH * sample_share).then(|| Location {
        signal: bench.problem.name.clone(),
        kind: LocationKind::Frequency,
        variable: "frequency_hz".into(),
        unit: "Hz".into(),
        from: Some(here[from].0),
        to: Some(here[to].1),
        energy_share,
        sample_share,
        p_value,
        effect: None,
    })
}

/// Energy of a series in bands of frequency: from and to, in Hz, and the energy in the view's unit squared.
fn bands(bench: &Workbench<'_>, series: &[f64]) -> Vec<(f64, f64, f64)> {
    spectrum::density(&bench.t_s, series, bench.scale.spectral_step_s, 16)
        .into_iter()
        .map(|(from, to, density)| (from, to, density * density * (to - from)))
        .collect()
}

/// Energy of a series within a place that is a band of frequency.
pub fn energy_in_band(bench: &Workbench<'_>, location: &Location, series: &[f64]) -> f64 {
    let (from, to) = (
        location.from.unwrap_or(0.0),
        location.to.unwrap_or(f64::INFINITY),
    );
    // Of a band that the place only reaches into, its part: the density is taken as even within a band.
    bands(bench, series)
        .into_iter()
        .map(|(low, high, energy)| {
            let shared = high.min(to) - low.max(from);
            energy * (shared / (high - low)).clamp(0.0, 1.0)
        })
        .sum()
}

/// Whether a row (an index among those that count) lies in a place; `None` for a band of frequency.
pub fn within(
    bench: &Workbench<'_>,
    location: &Location,
    variables: &[Variable],
    row: usize,
) -> Option<bool> {
    let value = match location.kind {
        LocationKind::Time => bench.t_s[row],
        LocationKind::Region => {
            variables
                .iter()
                .find(|v| v.name == location.variable)?
                .values[row]
        }
        LocationKind::Frequency => return None,
    };
    Some(location.from.is_none_or(|from| value >= from) && location.to.is_none_or(|to| value <= to))
}
