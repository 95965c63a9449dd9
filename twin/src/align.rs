//! Two clocks: offset and rate between a sensor's time and its reference's, estimated from the two signals.
//!
//! 1. Coarse: cross-correlation of the derivatives on common grids, all offsets at which enough overlaps. Where a current repeats
//!    itself nearly, noise may lift another peak above the right one: the highest of each grid are compared by their squares,
//!    with what does not overlap left as it is.
//! 2. Rate: the best offset of each of several blocks, and a line through them.
//! 3. Fine: least squares over offset, rate and a smoothing of the reference (a first-order lag or a moving average,
//!    whichever fits better), with gain and zero solved within. Without the smoothing a lag would be taken for a shift; with one that the
//!    readings do not tell a shift would be taken for a lag, so that none is taken unless the squares are lower by more than chance.
//! 4. Wider: the coarse search once for each of many rates, as a clock that runs 1 % fast has no offset at which all of a
//!    recording fits; where another rate than a crystal's is likelier, 1 to 3 again from there, and the better fit counts.
//! 5. Chance: among thousands of offsets and a hundred rates one suits any two recordings somewhat. Where the values are little
//!    alike, each part of the sensor's blocks has to fit where the others say.
//!
//! The reference's own noise is evened out by smoothing, and between two of its rows: the squares are lower there whatever the clocks are.
//! What its standstills show of it is taken out of them again (least squares compensated for the noise of what goes in; Söderström 2018,
//! *Errors-in-Variables Methods in System Identification*, ch. 7).

use recording::error::number;

use crate::standstill;

/// Points of the coarse grids: on a fine one the noise between two points hides a slow sensor, on a coarse one a fast
/// sensor's edges are lost. The one on which the signals are most alike counts.
const GRIDS: [usize; 4] = [4096, 1024, 256, 64];
/// Peaks of each grid that are compared by their squares, …
const PEAKS: usize = 4;
/// … each with the reference smoothed over so many steps.
const PEAK_SMOOTHINGS: [f64; 3] = [0.0, 2.0, 20.0];
/// Share of the shorter signal that has to overlap.
const LEAST_OVERLAP: f64 = 0.25;
/// Correlation of the derivatives below which nothing was found, …
const LEAST_CORRELATION: f64 = 0.2;
/// … unless it stands out by this many times the rms over all offsets.
const STANDS_OUT: f64 = 6.0;
/// Correlation of the values themselves from which on no more is asked.
const SURE_CORRELATION: f64 = 0.95;
/// Parts of the sensor's blocks, each of which has to fit where the others say.
const PARTS: usize = 4;
/// Points of the grids on which they are compared.
const HELD_GRIDS: [usize; 3] = [1024, 256, 64];
/// Correlation of the derivatives of the parts that are left out, which is no chance, …
const HELD_CORRELATION: f64 = 0.55;
/// … or so many times the rms over all offsets: it is one place of each part, not the best of thousands. Recordings of two runs
/// reached 3.8 times in 69 that came this far, and 5.9 once in some hundreds: few edges make long tails. A pair of one run in noise
/// as large as its current's waves has 12.
const HELD_STANDS_OUT: f64 = 6.5;
/// Parts of a recording in which it has to move before a rate is believed that no crystal has: a rate suits any two edges.
const PARTS_TO_MOVE: f64 = 3.0;
/// Correlation of the values themselves that is no chance among thousands of offsets.
const SCAN_CORRELATION: f64 = 0.6;
/// Fastest clock error that is looked for first, in 1: crystals are within 100 ppm, cheap loggers within 500.
const FASTEST_RATE: f64 = 500e-6;
/// No clock is that wrong, in 1: it is another unit of time, or another file.
const WRONG_RATE: f64 = 0.02;
/// Rates are looked for beyond that, in 1, so that what is refused can be told.
const SCANNED_RATE: f64 = 2.5 * WRONG_RATE;
/// Cells of the shorter signal on the grid of that search: its rates are a cell apart at the far end.
const SCAN_CELLS: f64 = 1024.0;
/// Cells of the longer signal there, at most: the cost grows with both.
const SCAN_CELLS_OF_LONGER: f64 = 8192.0;
/// A search that ended within this share of the farthest drift it allows was ended by it.
const AT_LIMIT: f64 = 0.98;
/// Times that a search which ended at its limit is gone on with from there.
const GO_ON: usize = 3;
/// Readings that the fine fit uses at most.
const FIT_ROWS: usize = 20_000;
/// Beyond this share of the signal's spread a residual counts in proportion and not squared.
const HUBER_SHARE: f64 = 0.1;
/// The reference is smoothed if the squares are lower for it by more than so many standard deviations of what noise makes of them.
const SELDOM: f64 = 3.0;
/// Time constants after which nothing is left of a reading.
const FADED: f64 = 12.0;
/// Blocks that the rate is taken from.
const BLOCKS: usize = 6;

/// A series with its times, ascending.
#[derive(Clone, Debug, Default)]
pub struct Signal {
    t_s: Vec<f64>,
    value: Vec<f64>,
}

impl Signal {
    /// The rows that have a value and are to be used.
    pub fn new(t_s: &[f64], value: &[f64], uses: impl Fn(usize) -> bool) -> Self {
        let mut signal = Self::default();
        for row in (0..t_s.len()).filter(|row| value[*row].is_finite() && uses(*row)) {
            // Two rows of the same time: the later one counts.
            if signal.t_s.last() == Some(&t_s[row]) {
                signal.t_s.pop();
                signal.value.pop();
            }
            signal.t_s.push(t_s[row]);
            signal.value.push(value[row]);
        }
        signal
    }

    fn span_s(&self) -> f64 {
        match (self.t_s.first(), self.t_s.last()) {
            (Some(first), Some(last)) => last - first,
            _ => 0.0,
        }
    }

    /// The same values, if so much more passes between two of them, in 1.
    fn at_rate(&self, rate: f64) -> Self {
        let start_s = self.t_s.first().copied().unwrap_or(0.0);
        let mut signal = self.clone();
        if rate != 0.0 {
            for t_s in &mut signal.t_s {
                *t_s = start_s + (*t_s - start_s) * (1.0 + rate);
            }
        }
        signal
    }

    fn step_s(&self) -> f64 {
        let mut steps: Vec<f64> = self.t_s.windows(2).map(|pair| pair[1] - pair[0]).collect();
        if steps.is_empty() {
            return 0.0;
        }
        let middle = steps.len() / 2;
        *steps.select_nth_unstable_by(middle, f64::total_cmp).1
    }
}

/// Clocks that are so far apart, in s, count from different moments (one since 1970, say): a day.
const OTHER_ORIGIN_S: f64 = 86_400.0;

/// How the reference is smoothed before it is compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Shape {
    Lag,
    Average,
}

/// How the sensor's clock stands to the reference's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Alignment {
    /// What has to be added to the sensor's time at its first reading, in s.
    pub offset_s: f64,
    /// By how much the sensor's clock runs fast, in ppm.
    pub fast_ppm: f64,
    /// First time of the sensor, in s on its own clock.
    pub start_s: f64,
    /// Correlation of the two signals after all.
    pub correlation: f64,
}

impl Alignment {
    /// A time of the sensor on the reference's clock.
    pub fn on_reference(&self, t_s: f64) -> f64 {
        let since = t_s - self.start_s;
        self.start_s + self.offset_s + since / (1.0 + self.fast_ppm * 1e-6)
    }

    /// What is said of it in the report.
    pub fn remark(&self) -> String {
        let stands = if self.offset_s.abs() < OTHER_ORIGIN_S {
            format!(
                "the sensor's time is {:+.6} s from the reference's at its first reading and",
                -self.offset_s
            )
        } else {
            // The difference of two origins is no number that anybody looks for.
            format!(
                "the sensor's first reading, at {} s of its own clock, was at {:.3} s of the reference's, which counts from another moment; the sensor's clock",
                number((self.start_s * 1e3).round() / 1e3),
                self.start_s + self.offset_s
            )
        };
        format!(
            "the clocks of sensor and reference were compared: {stands} \
             runs {} by {:.1} ppm; both are taken out (correlation {:.4} after that)",
            if self.fast_ppm < 0.0 { "slow" } else { "fast" },
            self.fast_ppm.abs(),
            self.correlation
        )
    }
}

/// Finds how the clocks stand to each other; the error says that the two have nothing in common.
pub fn estimate(driven: &Signal, sensed: &Signal) -> Result<Alignment, String> {
    if driven.t_s.len() < 20 || sensed.t_s.len() < 20 {
        return Err(format!(
            "found {} values of the reference and {} of the sensor, expected at least 20 of each to compare their clocks",
            driven.t_s.len(),
            sensed.t_s.len()
        ));
    }
    let near = search(driven, sensed, 0.0);
    // With rows so far apart that the first search comes that far, they are another unit of time, whatever is alike.
    if let Some(near) = near.filter(|near| near.is_alike() && near.rate.abs() > WRONG_RATE) {
        return Err(wrong_rate(near.rate));
    }
    let found = match (near, wider(driven, sensed, near.as_ref())) {
        (Some(near), Some(wide)) if wide.is_clearly_better(&near) => wide,
        (None, Some(wide)) => wide,
        (Some(near), _) => near,
        (None, None) => return Err(nothing_in_common(driven, sensed, None)),
    };
    let is_sure = found.correlation.abs() >= SURE_CORRELATION;
    if !found.is_alike() || !is_sure && !holds(driven, &sensed.at_rate(found.rate)) {
        return Err(nothing_in_common(driven, sensed, Some(found.correlation)));
    }
    if found.rate.abs() > WRONG_RATE {
        return Err(wrong_rate(found.rate));
    }
    Ok(Alignment {
        offset_s: found.offset_s,
        fast_ppm: (1.0 / (1.0 + found.rate) - 1.0) * 1e6,
        start_s: sensed.t_s.first().copied().unwrap_or(0.0),
        correlation: found.correlation,
    })
}

/// What a search found.
#[derive(Clone, Copy, Debug)]
struct Found {
    offset_s: f64,
    /// By how much more passes on the reference's clock than on the sensor's, in 1.
    rate: f64,
    cost: f64,
    correlation: f64,
    /// It ended at the farthest drift that it allows.
    at_limit: bool,
    /// Share by which the mean square of so many readings is seldom off.
    seldom: f64,
}

impl Found {
    fn is_alike(&self) -> bool {
        self.correlation.abs() >= LEAST_CORRELATION
    }

    /// Rates beyond a crystal's are seldom: a fit that is better by chance does not speak for one, unless the other fit was not free
    /// to be better.
    fn is_clearly_better(&self, near: &Self) -> bool {
        let least = if near.at_limit {
            near.cost
        } else {
            near.cost - near.seldom * near.cost.abs()
        };
        self.cost < least && self.correlation.abs() >= near.correlation.abs()
    }
}

/// The best fit from the likeliest rate that the search near 0 does not reach; `None` if that search found what it should.
fn wider(driven: &Signal, sensed: &Signal, near: Option<&Found>) -> Option<Found> {
    let grid_s = scan_grid_s(driven, sensed);
    if parts_that_move(&derivative(sensed, grid_s)) < PARTS_TO_MOVE {
        return None;
    }
    let (at_none, scores) = scores_of_rates(driven, sensed, grid_s)?;
    let (score, rate) = scores
        .into_iter()
        .max_by(|one, other| one.0.total_cmp(&other.0))?;
    if score <= at_none && near.is_some_and(|near| !near.at_limit) {
        return None;
    }
    let mut found = search(driven, sensed, rate)?;
    for _ in 0..GO_ON {
        if !found.at_limit || found.rate.abs() > SCANNED_RATE {
            break;
        }
        match search(driven, sensed, found.rate) {
            Some(further) if further.cost < found.cost => found = further,
            _ => break,
        }
    }
    Some(found)
}

fn scan_grid_s(driven: &Signal, sensed: &Signal) -> f64 {
    let (one_s, other_s) = (driven.span_s(), sensed.span_s());
    (one_s.min(other_s) / SCAN_CELLS)
        .max(one_s.max(other_s) / SCAN_CELLS_OF_LONGER)
        .max(driven.step_s().min(sensed.step_s()))
        .max(1e-9)
}

/// The highest correlation of the derivatives among all offsets: at rate 0, and at each rate of a grid with the rate.
fn scores_of_rates(
    driven: &Signal,
    sensed: &Signal,
    grid_s: f64,
) -> Option<(f64, Vec<(f64, f64)>)> {
    let apart = grid_s / driven.span_s().min(sensed.span_s()).max(grid_s);
    let x = derivative(driven, grid_s);
    let score = |rate: f64| {
        let y = derivative(&sensed.at_rate(rate), grid_s);
        highest(&scores(&x, &y)).map(|(score, _)| score.abs())
    };
    let at_none = score(0.0)?;
    let tries = (SCANNED_RATE / apart).ceil() as i32;
    let rates = (-tries..=tries).filter(|index| *index != 0);
    let rates = rates.map(|index| f64::from(index) * apart);
    Some((
        at_none,
        rates
            .filter_map(|rate| Some((score(rate)?, rate)))
            .collect(),
    ))
}

/// The best fit of rates near one that is given; `None` if there is no offset at which the two are alike.
fn search(driven: &Signal, sensed: &Signal, rate: f64) -> Option<Found> {
    let sensed = &sensed.at_rate(rate);
    let thin = thinned(sensed);
    let spread = spread(&thin.value).max(f64::MIN_POSITIVE);
    let seldom = SELDOM * (2.0 / thin.t_s.len() as f64).sqrt();
    let noise = standstill::noise(std::slice::from_ref(&driven.value)).unwrap_or(0.0);
    let fit = Fit {
        driven,
        sensed: &thin,
        start_s: sensed.t_s.first().copied().unwrap_or(0.0),
        span_s: sensed.span_s().max(1e-9),
        huber: HUBER_SHARE * spread,
        noise,
        seldom,
    };
    let step_s = thin.step_s().max(driven.step_s()).max(1e-9);
    let (coarse_s, grid_s) = match coarse(driven, sensed) {
        peaks if peaks.is_empty() => fit.scan(step_s)?,
        peaks => fit.likeliest(&peaks, step_s)?,
    };
    // Smoothing and offset by trial; the rate is still unknown, so only its middle matters.
    let mut best = Trial::worst();
    for shape in [Shape::Lag, Shape::Average] {
        for smoothing_s in
            [0.0, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0].map(|steps| steps * step_s)
        {
            if smoothing_s > fit.span_s / 10.0 || (smoothing_s == 0.0 && shape == Shape::Average) {
                continue;
            }
            let smooth = fit.smooth(shape, smoothing_s);
            let reach_s = 3.0 * grid_s + smoothing_s;
            let tries = 40;
            for index in 0..=tries {
                let offset_s =
                    coarse_s + reach_s * (2.0 * f64::from(index) / f64::from(tries) - 1.0);
                let cost = fit.cost(&smooth, offset_s, 0.0);
                best.take(Trial {
                    shape,
                    smoothing_s,
                    offset_s,
                    drift_s: 0.0,
                    cost,
                });
            }
        }
    }
    let smooth = fit.smooth(best.shape, best.smoothing_s);
    if let Some((offset_s, drift_s)) = fit.blocks(&smooth.value, best.offset_s, grid_s, step_s) {
        let cost = fit.cost(&smooth, offset_s, drift_s);
        best.take(Trial {
            offset_s,
            drift_s,
            cost,
            ..best
        });
    }
    let mut fine = best;
    for shape in [Shape::Lag, Shape::Average] {
        let start = Trial { shape, ..best };
        fine.take(fit.descend(start, step_s));
    }
    // Edges that fall between two rows make many small valleys: look into the neighbouring ones.
    for smoothing_s in [fine.smoothing_s, 0.0] {
        fine.take(fit.nearby(fine, smoothing_s, step_s));
    }
    fine.take(fit.descend(fine, 0.05 * step_s));
    // A short lag looks like a shift by as much: what does without is as good, unless the squares are lower by more than chance.
    let plain = fit.without_smoothing(fine, step_s);
    if plain.cost <= fine.cost + seldom * fine.cost.abs() {
        fine = plain;
    }
    let smooth = fit.smooth(fine.shape, fine.smoothing_s);
    // Not (1 + rate)·(1 + own) − 1, which leaves fewer digits of a small one.
    let own = fine.drift_s / fit.span_s;
    Some(Found {
        offset_s: fine.offset_s,
        rate: own + rate * (1.0 + own),
        cost: fine.cost,
        correlation: fit.correlation(&smooth.value, fine.offset_s, fine.drift_s),
        at_limit: fine.drift_s.abs() > AT_LIMIT * fit.farthest_s(step_s),
        seldom,
    })
}

fn wrong_rate(rate: f64) -> String {
    format!(
        "found clocks that differ in rate by {:.1} %, expected less than {:.0} %: the unit of time of one file is likely \
         wrong (t_s is in s), or they are not of the same run",
        100.0 * rate.abs(),
        100.0 * WRONG_RATE
    )
}

fn nothing_in_common(driven: &Signal, sensed: &Signal, correlation: Option<f64>) -> String {
    let span = |signal: &Signal| match (signal.t_s.first(), signal.t_s.last()) {
        (Some(first), Some(last)) => format!("{} … {} s", number(*first), number(*last)),
        _ => "no time".to_owned(),
    };
    let best = correlation.map_or(String::new(), |correlation| {
        format!(" beyond chance (correlation {correlation:.2} at best)")
    });
    format!(
        "found no offset and rate at which the sensor ({}) follows the reference ({}){best}, expected recordings of the same run \
         that overlap in time",
        span(sensed),
        span(driven)
    )
}

/// Offsets of the highest correlations of the derivatives and the step of the grid of each; of grids on which one stands out.
fn coarse(driven: &Signal, sensed: &Signal) -> Vec<(f64, f64)> {
    let longest_s = driven.span_s().max(sensed.span_s());
    let finest_s = driven.step_s().min(sensed.step_s());
    let origin = |signal: &Signal| signal.t_s.first().copied().unwrap_or(0.0);
    let apart_s = origin(driven) - origin(sensed);
    let mut found = Vec::new();
    for grid in GRIDS {
        let grid_s = (longest_s / grid as f64).max(finest_s).max(1e-9);
        let peaks = peaks(&derivative(driven, grid_s), &derivative(sensed, grid_s));
        found.extend(
            peaks
                .into_iter()
                .map(|lag| (apart_s + lag as f64 * grid_s, grid_s)),
        );
    }
    found
}

/// Lags of the highest correlations of one series with another, which have no higher one beside them; none if the highest does not
/// stand out.
fn peaks(x: &[f64], y: &[f64]) -> Vec<isize> {
    let scores = scores(x, y);
    let Some((best, _)) = highest(&scores) else {
        return Vec::new();
    };
    // Chance alone reaches about 1/√n, and the largest of many tries some times that.
    let chance = STANDS_OUT / (x.len().min(y.len()) as f64).sqrt();
    if best.abs() < LEAST_CORRELATION.max(chance.min(0.7)) && best.abs() < STANDS_OUT * rms(&scores)
    {
        return Vec::new();
    }
    let size = |index: usize| scores.get(index).map_or(0.0, |(score, _)| score.abs());
    let mut peaks: Vec<usize> = (0..scores.len())
        .filter(|index| {
            size(*index) >= size(index.wrapping_sub(1)) && size(*index) >= size(index + 1)
        })
        .collect();
    peaks.sort_by(|one, other| size(*other).total_cmp(&size(*one)));
    peaks.truncate(PEAKS);
    peaks.into_iter().map(|index| scores[index].1).collect()
}

fn highest(scores: &[(f64, isize)]) -> Option<(f64, isize)> {
    scores
        .iter()
        .copied()
        .max_by(|one, other| one.0.abs().total_cmp(&other.0.abs()))
}

fn rms(scores: &[(f64, isize)]) -> f64 {
    let total: f64 = scores.iter().map(|(score, _)| score * score).sum();
    (total / scores.len() as f64).sqrt()
}

/// The correlation of one series with another, `y[k]` beside `x[k + lag]`, at every lag at which enough overlaps.
fn scores(x: &[f64], y: &[f64]) -> Vec<(f64, isize)> {
    let shorter = x.len().min(y.len());
    let least = ((shorter as f64 * LEAST_OVERLAP) as usize).max(8);
    let squares = |values: &[f64]| -> Vec<f64> {
        let mut sum = 0.0;
        let mut all = vec![0.0];
        all.extend(values.iter().map(|value| {
            sum += value * value;
            sum
        }));
        all
    };
    let (squares_x, squares_y) = (squares(x), squares(y));
    let mut scores = Vec::new();
    let (first, last) = (-(y.len() as isize), x.len() as isize);
    for lag in first..=last {
        let from = (-lag).max(0) as usize;
        let to = y.len().min((x.len() as isize - lag).max(0) as usize);
        if to < from + least {
            continue;
        }
        let shifted = (from as isize + lag) as usize;
        let length = to - from;
        let product: f64 = y[from..to]
            .iter()
            .zip(&x[shifted..shifted + length])
            .map(|(y, x)| y * x)
            .sum();
        let energy =
            (squares_x[shifted + length] - squares_x[shifted]) * (squares_y[to] - squares_y[from]);
        if energy <= 0.0 {
            continue;
        }
        // Among equals (a periodic load) the one that most of both takes part in.
        let share = (length as f64 / shorter as f64).min(1.0).sqrt();
        scores.push((product / energy.sqrt() * share, lag));
    }
    scores
}

/// Whether each part of the sensor's blocks fits the reference where all the others have their best fit: one place to look at
/// instead of thousands, at which chance is rarely alike.
fn holds(driven: &Signal, sensed: &Signal) -> bool {
    let longest_s = driven.span_s().max(sensed.span_s());
    let finest_s = driven.step_s().min(sensed.step_s());
    HELD_GRIDS.iter().any(|grid| {
        let grid_s = (longest_s / *grid as f64).max(finest_s).max(1e-9);
        held_out(&derivative(driven, grid_s), &derivative(sensed, grid_s))
            .is_some_and(|(held, rms)| held > HELD_CORRELATION || held > HELD_STANDS_OUT * rms)
    })
}

/// The correlation of the parts of `y`, each at the lag (or one beside it) that is best for all the others, and the rms of all lags.
fn held_out(x: &[f64], y: &[f64]) -> Option<(f64, f64)> {
    let parts: Vec<Vec<(f64, isize)>> = (0..PARTS)
        .map(|part| {
            let own = |cell: usize| 2 * BLOCKS * cell / y.len() % PARTS == part;
            let kept = y.iter().enumerate();
            let kept = kept.map(|(cell, value)| if own(cell) { *value } else { 0.0 });
            scores(x, &kept.collect::<Vec<f64>>())
        })
        .collect();
    // Every part has its score at a lag that counts.
    let lags = parts[0].iter().filter_map(|(_, lag)| {
        let at = |part: &Vec<(f64, isize)>| {
            let index = part.binary_search_by_key(lag, |(_, lag)| *lag).ok()?;
            Some(part[index].0)
        };
        parts.iter().map(at).collect::<Option<Vec<f64>>>()
    });
    let lags: Vec<Vec<f64>> = lags.collect();
    // A part has its share of the energy of y beside all that of x.
    let whole = (PARTS as f64).sqrt() / PARTS as f64;
    let sum = |at_lag: &Vec<f64>| at_lag.iter().sum::<f64>() * whole;
    let squares: f64 = lags.iter().map(|at_lag| sum(at_lag).powi(2)).sum();
    let mut held = 0.0;
    for part in 0..PARTS {
        let of_others = lags.iter().map(|at_lag| sum(at_lag) - at_lag[part] * whole);
        let (at, best) = of_others
            .enumerate()
            .max_by(|one, other| one.1.abs().total_cmp(&other.1.abs()))?;
        let beside = &lags[at.saturating_sub(1)..(at + 2).min(lags.len())];
        let own = beside.iter().map(|at_lag| at_lag[part] * best.signum());
        held += own.fold(f64::NEG_INFINITY, f64::max) * whole;
    }
    Some((held, (squares / lags.len() as f64).sqrt()))
}

/// In how many parts of equal length a series moves as much: 1 if all of it moves in one of them.
fn parts_that_move(derivative: &[f64]) -> f64 {
    let length = derivative.len().div_ceil(2 * BLOCKS).max(1);
    let energy = derivative
        .chunks(length)
        .map(|part| part.iter().map(|value| value * value).sum::<f64>());
    let (sum, squares) = energy.fold((0.0, 0.0), |(sum, squares), energy| {
        (sum + energy, squares + energy * energy)
    });
    if squares > 0.0 {
        sum * sum / squares
    } else {
        0.0
    }
}

/// Differences of the means over the cells of a grid that begins at the first row.
fn derivative(signal: &Signal, grid_s: f64) -> Vec<f64> {
    let Some(start) = signal.t_s.first() else {
        return Vec::new();
    };
    let cells = (signal.span_s() / grid_s) as usize + 1;
    let mut sum = vec![0.0; cells];
    let mut count = vec![0_u32; cells];
    for (t, value) in signal.t_s.iter().zip(&signal.value) {
        let cell = (((t - start) / grid_s) as usize).min(cells - 1);
        sum[cell] += value;
        count[cell] += 1;
    }
    let mut known: Option<usize> = None;
    let mut means = vec![0.0; cells];
    for cell in 0..cells {
        if count[cell] == 0 {
            continue;
        }
        means[cell] = sum[cell] / f64::from(count[cell]);
        if let Some(before) = known {
            let (from, to) = (means[before], means[cell]);
            let cells = (cell - before) as f64;
            for (index, mean) in means[before + 1..cell].iter_mut().enumerate() {
                *mean = from + (to - from) * (index + 1) as f64 / cells;
            }
        }
        known = Some(cell);
    }
    means.windows(2).map(|pair| pair[1] - pair[0]).collect()
}

fn thinned(signal: &Signal) -> Signal {
    let every = signal.t_s.len().div_ceil(FIT_ROWS).max(1);
    Signal {
        t_s: signal.t_s.iter().copied().step_by(every).collect(),
        value: signal.value.iter().copied().step_by(every).collect(),
    }
}

fn spread(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    match (
        sorted.get(sorted.len() / 50),
        sorted.get(sorted.len() - 1 - sorted.len() / 50),
    ) {
        (Some(low), Some(high)) if high > low => high - low,
        _ => sorted.last().unwrap_or(&0.0) - sorted.first().unwrap_or(&0.0),
    }
}

/// A series, smoothed, at its own rows.
fn smooth(t_s: &[f64], value: &[f64], shape: Shape, smoothing_s: f64) -> Vec<f64> {
    let mut output = value.to_vec();
    if smoothing_s <= 0.0 {
        return output;
    }
    match shape {
        Shape::Lag => {
            // Exact for straight lines between rows.
            for row in 1..value.len() {
                let h = t_s[row] - t_s[row - 1];
                let kept = (-h / smoothing_s).exp();
                let (from, rise) = (value[row - 1], value[row] - value[row - 1]);
                let ramp = 1.0 - smoothing_s / h * (1.0 - kept);
                output[row] = kept * output[row - 1] + (1.0 - kept) * from + rise * ramp;
            }
        }
        Shape::Average => {
            let mut area = vec![0.0; value.len()];
            for row in 1..value.len() {
                let h = t_s[row] - t_s[row - 1];
                area[row] = area[row - 1] + 0.5 * (value[row] + value[row - 1]) * h;
            }
            let mut at = 0;
            for row in 0..value.len() {
                let from_s = t_s[row] - smoothing_s;
                while at + 1 < row && t_s[at + 1] <= from_s {
                    at += 1;
                }
                let since = from_s - t_s[at];
                let before = if since <= 0.0 {
                    area[at] + value[at] * since
                } else {
                    let h = t_s[at + 1] - t_s[at];
                    let end = value[at] + (value[at + 1] - value[at]) * since / h;
                    area[at] + 0.5 * (value[at] + end) * since
                };
                output[row] = (area[row] - before) / smoothing_s;
            }
        }
    }
    output
}

/// A point of the search.
#[derive(Clone, Copy, Debug)]
struct Trial {
    shape: Shape,
    smoothing_s: f64,
    offset_s: f64,
    /// What the offset has changed by at the last reading, in s.
    drift_s: f64,
    cost: f64,
}

impl Trial {
    fn worst() -> Self {
        Self {
            shape: Shape::Lag,
            smoothing_s: 0.0,
            offset_s: 0.0,
            drift_s: 0.0,
            cost: f64::INFINITY,
        }
    }

    fn take(&mut self, other: Self) {
        if other.cost < self.cost {
            *self = other;
        }
    }
}

struct Fit<'a> {
    driven: &'a Signal,
    sensed: &'a Signal,
    start_s: f64,
    span_s: f64,
    huber: f64,
    /// Noise of the reference, rms.
    noise: f64,
    /// Share by which the mean square of so many readings of noise is seldom off.
    seldom: f64,
}

/// The smoothed reference at its own rows.
struct Smoothed {
    value: Vec<f64>,
    /// Variance of its noise, and covariance of that in two rows that follow one another.
    noise: [f64; 2],
}

impl Smoothed {
    /// Variance of the noise a share of the way from one row to the next.
    fn noise(&self, share: f64) -> f64 {
        between(self.noise, share)
    }
}

/// Variance a share of the way between two rows of a variance and a covariance.
fn between([at_row, of_neighbours]: [f64; 2], share: f64) -> f64 {
    let rest = 1.0 - share;
    (share * share + rest * rest) * at_row + 2.0 * share * rest * of_neighbours
}

impl Fit<'_> {
    /// The reference, smoothed.
    fn smooth(&self, shape: Shape, smoothing_s: f64) -> Smoothed {
        Smoothed {
            value: smooth(&self.driven.t_s, &self.driven.value, shape, smoothing_s),
            noise: self
                .smoothed_noise(shape, smoothing_s)
                .map(|share| share * self.noise.powi(2)),
        }
    }

    /// What smoothing leaves of white noise of variance 1: its variance, and covariance in two rows that follow one another.
    fn smoothed_noise(&self, shape: Shape, smoothing_s: f64) -> [f64; 2] {
        if self.noise <= 0.0 {
            return [0.0; 2];
        }
        let step_s = self.driven.step_s();
        let reach_s = match shape {
            Shape::Lag => FADED * smoothing_s,
            Shape::Average => smoothing_s,
        };
        // The answer to a single reading of 1.
        let rows = (reach_s / step_s) as usize + 4;
        let t_s: Vec<f64> = (0..rows.min(FIT_ROWS))
            .map(|row| row as f64 * step_s)
            .collect();
        let mut one = vec![0.0; t_s.len()];
        one[1] = 1.0;
        let answer = smooth(&t_s, &one, shape, smoothing_s);
        let products = answer.windows(2).map(|pair| pair[0] * pair[1]);
        [
            answer.iter().map(|value| value * value).sum(),
            products.sum(),
        ]
    }

    /// The smoothed reference beside each reading of `rows` that it covers, and what share of the way from one row to the next that is.
    fn beside(
        &self,
        smooth: &[f64],
        offset_s: f64,
        drift_s: f64,
        rows: std::ops::Range<usize>,
        mut take: impl FnMut(f64, f64, f64),
    ) {
        let t_ref = &self.driven.t_s;
        let mut at = 0;
        for row in rows {
            let t = self.sensed.t_s[row];
            let wanted = t + offset_s + drift_s * (t - self.start_s) / self.span_s;
            if at == 0 {
                at = t_ref.partition_point(|t| *t <= wanted).saturating_sub(1);
            }
            while at + 1 < t_ref.len() && t_ref[at + 1] <= wanted {
                at += 1;
            }
            if wanted < t_ref[at] || at + 1 >= t_ref.len() {
                continue;
            }
            let share = (wanted - t_ref[at]) / (t_ref[at + 1] - t_ref[at]);
            take(
                smooth[at] + (smooth[at + 1] - smooth[at]) * share,
                self.sensed.value[row],
                share,
            );
        }
    }

    fn sums(
        &self,
        smooth: &[f64],
        offset_s: f64,
        drift_s: f64,
        rows: std::ops::Range<usize>,
    ) -> Sums {
        let mut sums = Sums::default();
        self.beside(smooth, offset_s, drift_s, rows, |x, y, _| sums.add(x, y));
        sums
    }

    fn all(&self) -> std::ops::Range<usize> {
        0..self.sensed.t_s.len()
    }

    fn correlation(&self, smooth: &[f64], offset_s: f64, drift_s: f64) -> f64 {
        self.sums(smooth, offset_s, drift_s, self.all())
            .correlation()
    }

    /// Mean cost of the residual after gain and zero, without the part of the reference's noise.
    fn cost(&self, smooth: &Smoothed, offset_s: f64, drift_s: f64) -> f64 {
        let sums = self.sums(&smooth.value, offset_s, drift_s, self.all());
        let least = (LEAST_OVERLAP * 0.5 * self.sensed.t_s.len() as f64).max(10.0);
        if sums.count < least.min(0.5 * self.sensed.t_s.len() as f64) {
            return f64::INFINITY;
        }
        let Some((gain, zero)) = sums.line() else {
            return f64::INFINITY;
        };
        let mut cost = 0.0;
        self.beside(
            &smooth.value,
            offset_s,
            drift_s,
            self.all(),
            |x, y, share| {
                let noise = smooth.noise(share);
                let evened = between([self.noise.powi(2), 0.0], share) - noise;
                cost -= 0.5 * gain * gain * (noise - self.seldom * evened);
                cost += self.huber_of(y - zero - gain * x);
            },
        );
        cost / sums.count
    }

    /// What one residual costs.
    fn huber_of(&self, residual: f64) -> f64 {
        let size = residual.abs();
        if size <= self.huber {
            0.5 * size * size
        } else {
            self.huber * (size - 0.5 * self.huber)
        }
    }

    /// The offset near which the squares are lowest, of some with the step of the grid on which each was found.
    fn likeliest(&self, peaks: &[(f64, f64)], step_s: f64) -> Option<(f64, f64)> {
        let tries = 40;
        let mut best = (f64::INFINITY, None);
        let rows = self.sensed.t_s.len().max(1) as f64;
        let mean = self.sensed.value.iter().sum::<f64>() / rows;
        let apart = self.sensed.value.iter().map(|y| self.huber_of(y - mean));
        let idle = apart.sum::<f64>() / rows;
        for smoothing in PEAK_SMOOTHINGS {
            let smooth = self.smooth(Shape::Lag, smoothing * step_s);
            for (near_s, grid_s) in peaks {
                // A cell to either side; a lag moves an edge further.
                let reach_s = grid_s + smoothing * step_s;
                for index in 0..=tries {
                    let offset_s =
                        near_s + reach_s * (2.0 * f64::from(index) / f64::from(tries) - 1.0);
                    let cost = self.cost(&smooth, offset_s, 0.0);
                    // What does not overlap is not accounted for: over a single edge all edges are alike.
                    let there = self.sums(&smooth.value, offset_s, 0.0, self.all()).count / rows;
                    let cost = there * cost + (1.0 - there) * idle;
                    if cost < best.0 {
                        best = (cost, Some((*near_s, *grid_s)));
                    }
                }
            }
        }
        // With none at which enough overlaps, the first: what follows says so.
        best.1.or(peaks.first().copied())
    }

    /// Every offset, tried on the values themselves: for a sensor so slow beside its load that it has no edges in common
    /// with it. The offset and how far apart the tries were; `None` if none stands out.
    fn scan(&self, step_s: f64) -> Option<(f64, f64)> {
        let driven_s = self.driven.t_s.first().copied()?;
        let span_s = self.driven.span_s();
        let apart_s = (step_s / 20.0)
            .max(self.driven.step_s())
            .max((span_s + self.span_s) / 20_000.0);
        let rows = self.sensed.t_s.len();
        if rows > 2000 {
            // That many readings have edges.
            return None;
        }
        let (mut best, mut best_s) = (0.0_f64, 0.0);
        for window_s in [0.1, 0.25, 0.5, 1.0].map(|share| share * step_s) {
            let smooth = self.smooth(Shape::Average, window_s);
            let first_s = driven_s - self.start_s - (1.0 - LEAST_OVERLAP) * self.span_s;
            let tries = ((span_s + (1.0 - 2.0 * LEAST_OVERLAP) * self.span_s) / apart_s)
                .ceil()
                .max(0.0) as usize;
            for index in 0..=tries {
                let offset_s = first_s + index as f64 * apart_s;
                let sums = self.sums(&smooth.value, offset_s, 0.0, self.all());
                if sums.count < LEAST_OVERLAP * rows as f64 {
                    continue;
                }
                // Among equals (a periodic load) the one that most readings take part in.
                let score = sums.correlation() * (sums.count / rows as f64).sqrt();
                if score.abs() > best.abs() {
                    (best, best_s) = (score, offset_s);
                }
            }
        }
        (best.abs() > SCAN_CORRELATION).then_some((best_s, apart_s))
    }

    /// Offset at the start and drift from the best offsets of several blocks.
    fn blocks(
        &self,
        smooth: &[f64],
        offset_s: f64,
        grid_s: f64,
        step_s: f64,
    ) -> Option<(f64, f64)> {
        let rows = self.sensed.t_s.len();
        let reach_s = 3.0 * grid_s + FASTEST_RATE * self.span_s + step_s;
        let tries = ((4.0 * reach_s / step_s).ceil() as usize).clamp(50, 600);
        let mut found: Vec<(f64, f64)> = Vec::new();
        for block in 0..BLOCKS {
            let own = rows * block / BLOCKS..rows * (block + 1) / BLOCKS;
            if own.len() < 20 {
                return None;
            }
            let middle_s =
                0.5 * (self.sensed.t_s[own.start] + self.sensed.t_s[own.end - 1]) - self.start_s;
            let mut best = (0.0_f64, 0.0_f64);
            for index in 0..=tries {
                let shift_s = reach_s * (2.0 * index as f64 / tries as f64 - 1.0);
                let sums = self.sums(smooth, offset_s + shift_s, 0.0, own.clone());
                if sums.count * 2.0 < own.len() as f64 {
                    continue;
                }
                let together = sums.correlation().abs();
                if together > best.0 {
                    best = (together, shift_s);
                }
            }
            if best.0 > 0.7 {
                found.push((middle_s, best.1));
            }
        }
        if found.len() < 2 {
            return None;
        }
        // Median of the slopes of all pairs: one block that went astray does not matter.
        let mut slopes = Vec::new();
        for (index, one) in found.iter().enumerate() {
            slopes.extend(
                found[index + 1..]
                    .iter()
                    .map(|other| (other.1 - one.1) / (other.0 - one.0)),
            );
        }
        slopes.sort_by(f64::total_cmp);
        let slope = slopes[slopes.len() / 2].clamp(-FASTEST_RATE, FASTEST_RATE);
        let mut starts: Vec<f64> = found
            .iter()
            .map(|(at_s, shift_s)| shift_s - slope * at_s)
            .collect();
        starts.sort_by(f64::total_cmp);
        Some((offset_s + starts[starts.len() / 2], slope * self.span_s))
    }

    /// The farthest drift that is allowed.
    fn farthest_s(&self, step_s: f64) -> f64 {
        2.0 * FASTEST_RATE * self.span_s + step_s
    }

    /// The best with this smoothing of the offsets up to two rows to either side, a fortieth of a row apart.
    fn nearby(&self, from: Trial, smoothing_s: f64, step_s: f64) -> Trial {
        let smooth = self.smooth(from.shape, smoothing_s);
        let mut best = Trial::worst();
        for index in -80_i32..=80 {
            let offset_s = from.offset_s + f64::from(index) / 40.0 * step_s;
            best.take(Trial {
                smoothing_s,
                offset_s,
                cost: self.cost(&smooth, offset_s, from.drift_s),
                ..from
            });
        }
        best
    }

    /// The best fit near `from` on the reference as it was recorded.
    fn without_smoothing(&self, from: Trial, step_s: f64) -> Trial {
        if from.smoothing_s == 0.0 {
            return from;
        }
        let mut best = self.nearby(from, 0.0, step_s);
        let found = self.descend_from(best, 0.05 * step_s, |_| 0.0);
        best.take(found);
        best
    }

    /// Nelder and Mead's simplex over offset, drift and smoothing.
    fn descend(&self, start: Trial, step_s: f64) -> Trial {
        self.descend_from(start, step_s, f64::abs)
    }

    /// The same with a smoothing that follows from the third coordinate.
    fn descend_from(&self, start: Trial, step_s: f64, smoothing: impl Fn(f64) -> f64) -> Trial {
        let farthest_s = self.farthest_s(step_s);
        let at = |point: [f64; 3]| {
            let smoothing_s = smoothing(point[2]);
            if smoothing_s > 0.3 * self.span_s || point[1].abs() > farthest_s {
                return f64::INFINITY;
            }
            let smooth = self.smooth(start.shape, smoothing_s);
            // Offset is that of the middle, so that it does not depend on the drift.
            self.cost(&smooth, point[0] - 0.5 * point[1], point[1])
        };
        let origin = [
            start.offset_s + 0.5 * start.drift_s,
            start.drift_s,
            start.smoothing_s,
        ];
        let mut best = (origin, at(origin));
        for scale in [1.0, 0.2] {
            let size = [
                step_s * scale,
                step_s * scale,
                (0.5 * start.smoothing_s + step_s) * scale,
            ];
            best = simplex(&at, best.0, size, 150);
        }
        Trial {
            shape: start.shape,
            smoothing_s: smoothing(best.0[2]),
            offset_s: best.0[0] - 0.5 * best.0[1],
            drift_s: best.0[1],
            cost: best.1,
        }
    }
}

/// Lowest point of a function near `origin`.
fn simplex(
    cost: &dyn Fn([f64; 3]) -> f64,
    origin: [f64; 3],
    size: [f64; 3],
    evaluations: usize,
) -> ([f64; 3], f64) {
    let mut points = vec![(origin, cost(origin))];
    for axis in 0..3 {
        let mut point = origin;
        point[axis] += size[axis];
        points.push((point, cost(point)));
    }
    let along = |from: [f64; 3], to: [f64; 3], share: f64| {
        [0, 1, 2].map(|axis| from[axis] + (to[axis] - from[axis]) * share)
    };
    let mut spent = 4;
    while spent < evaluations {
        points.sort_by(|one, other| one.1.total_cmp(&other.1));
        let worst = points[3];
        let centre = [0, 1, 2].map(|axis| {
            points[..3]
                .iter()
                .map(|(point, _)| point[axis])
                .sum::<f64>()
                / 3.0
        });
        let mut tried = along(worst.0, centre, 2.0);
        let mut value = cost(tried);
        spent += 1;
        if value < points[0].1 {
            let further = along(worst.0, centre, 3.0);
            let at_further = cost(further);
            spent += 1;
            if at_further < value {
                (tried, value) = (further, at_further);
            }
        } else if value >= points[2].1 {
            let nearer = along(worst.0, centre, if value < worst.1 { 1.5 } else { 0.5 });
            let at_nearer = cost(nearer);
            spent += 1;
            (tried, value) = (nearer, at_nearer);
        }
        if value < worst.1 {
            points[3] = (tried, value);
        } else {
            let best = points[0].0;
            for point in &mut points[1..] {
                point.0 = along(best, point.0, 0.5);
                point.1 = cost(point.0);
                spent += 1;
            }
        }
    }
    points.sort_by(|one, other| one.1.total_cmp(&other.1));
    points[0]
}

/// Sums of a straight line.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    count: f64,
    x: f64,
    y: f64,
    xx: f64,
    xy: f64,
    yy: f64,
    /// First pair: numbers near it do not cancel.
    origin: Option<(f64, f64)>,
}

impl Sums {
    fn add(&mut self, x: f64, y: f64) {
        let (x0, y0) = *self.origin.get_or_insert((x, y));
        let (x, y) = (x - x0, y - y0);
        self.count += 1.0;
        self.x += x;
        self.y += y;
        self.xx += x * x;
        self.xy += x * y;
        self.yy += y * y;
    }

    fn moments(&self) -> (f64, f64, f64) {
        let count = self.count.max(1.0);
        (
            self.xx - self.x * self.x / count,
            self.xy - self.x * self.y / count,
            self.yy - self.y * self.y / count,
        )
    }

    fn correlation(&self) -> f64 {
        let (xx, xy, yy) = self.moments();
        if xx > 0.0 && yy > 0.0 {
            xy / (xx * yy).sqrt()
        } else {
            0.0
        }
    }

    /// Gain and zero.
    fn line(&self) -> Option<(f64, f64)> {
        let (xx, xy, _) = self.moments();
        let (x0, y0) = self.origin?;
        if xx <= 0.0 {
            return None;
        }
        let gain = xy / xx;
        let zero = (self.y - gain * self.x) / self.count + y0 - gain * x0;
        Some((gain, zero))
    }
}
