//! What cannot be explained because the input is not what it is said to be: each its own clear error.

use recording::error::number;

use super::{FEWEST_ROWS, Frame, Purpose, battery::PACK, seconds, series::median, stairs, stamps};
use crate::{
    effects::{self, Stage, scene::integral},
    explain,
    failure::Failure,
    model::{Model, Sensor},
    problem::{Base, BatteryBase, Drive, Observed, Problem, View},
    range::range,
    report::format::count,
};

/// A ratio of two spreads is a power of 1000 if it is within this factor of one.
const POWER_WITHIN: f64 = 2.0;
/// Below this correlation with its reference a sensor counts the other way round.
const OPPOSITE: f64 = -0.5;
/// Above this correlation, or below its opposite, a factor between the two is one of units: noise moves by any factor less.
const RELATED: f64 = 0.5;
/// Of one and the same current it is below this.
const SURELY_OPPOSITE: f64 = -0.8;
/// Below this magnitude of correlation the two have nothing in common.
const UNRELATED: f64 = 0.1;
/// A reference that moves by less than this share of the readings (a parked car's) correlates with none of them, whatever the sensor.
const HARDLY: f64 = 0.2;
/// A factor from which on a reading is more than off.
const NO_GAIN: f64 = 5.0;
/// A voltage further than this beyond the table's ends, as a factor, is not that of so many cells.
const OTHER_CELLS: f64 = 1.8;
/// A jump there and back is one if it is larger than this share of the spread of all, and than so many usual steps.
const WILD_SHARE: f64 = 0.25;
const WILD_STEPS: f64 = 20.0;
/// Readings that may follow each other out there.
const WILD_ROWS: usize = 3;
/// More such readings than this share are no longer single ones.
const WILD_MOST: f64 = 0.02;
/// Steps' mean square, over the variance, below which values have a course: 2 is noise.
const COURSE: f64 = 0.5;
/// Parts of a standstill, each in the mean, between which a reading that settles goes one way: noise may turn it by this factor.
const SETTLING_PARTS: usize = 8;
const ONE_WAY: f64 = 1.25;
/// A share of the readings at an end of their range that is worth a remark.
const CLIPPED_SHARE: f64 = 0.005;

/// A column holds numbers at all.
pub(super) fn some_values(values: &[f64], name: &str, source: &str) -> Result<(), Failure> {
    if values.iter().any(|value| value.is_finite()) {
        return Ok(());
    }
    Err(Failure(format!(
        "{source}, column {name}: found no value, expected numbers"
    )))
}

/// A column moves.
pub(super) fn not_constant(values: &[f64], name: &str, source: &str) -> Result<(), Failure> {
    let mut known = values.iter().filter(|value| value.is_finite());
    let Some(first) = known.next() else {
        return Ok(());
    };
    if known.any(|value| value != first) {
        return Ok(());
    }
    Err(Failure(format!(
        "{source}, column {name}: found {} in every row, expected a signal that moves",
        number(*first)
    )))
}

/// Time goes on.
pub(super) fn time_goes_on(frame: &Frame) -> Result<(), Failure> {
    let t_s = frame.t_s();
    let moves = t_s.windows(2).any(|pair| pair[0] != pair[1]);
    match t_s.first() {
        Some(first) if !moves && t_s.len() > 1 => Err(Failure(format!(
            "{}, column {}: found {} in every row, expected a time in s that goes on{}",
            frame.source(),
            frame.origin("t_s"),
            number(*first),
            stamps::held_by_single(*first)
                .map(|hint| format!(" ({hint})"))
                .unwrap_or_default()
        ))),
        _ => Ok(()),
    }
}

/// Temperatures and supplies that a vehicle has, in °C and V.
const TEMPERATURES_C: (f64, f64) = (-60.0, 200.0);
const SUPPLIES_V: (f64, f64) = (0.0, 100.0);

/// Surroundings are in the units of their names: a column of which no value can be, is not. Where some cannot be, remarks.
pub(super) fn surroundings(frame: &Frame) -> Result<Vec<String>, Failure> {
    let mut remarks = Vec::new();
    for (name, unit, (lowest, highest), instead) in [
        ("temp_sensor_c", "°C", TEMPERATURES_C, "kelvin"),
        ("temp_cell_c", "°C", TEMPERATURES_C, "kelvin"),
        ("temp_ambient_c", "°C", TEMPERATURES_C, "kelvin"),
        ("v_supply_v", "V", SUPPLIES_V, "mV"),
    ] {
        let values = frame.column(name).unwrap_or_default();
        let Some([low, high]) = range(values.iter().copied()) else {
            continue;
        };
        let known = values.iter().filter(|value| value.is_finite()).count();
        let possible = values
            .iter()
            .filter(|value| (lowest..=highest).contains(*value))
            .count();
        if possible == 0 {
            return Err(Failure(format!(
                "{}, column {}: found {} … {}, expected {unit}, {lowest} … {highest} (it may be in {instead})",
                frame.source(),
                frame.origin(name),
                number(low),
                number(high)
            )));
        }
        if possible < known {
            remarks.push(format!(
                "{name} is outside {lowest} … {highest} {unit} in {} of {known} rows of {}, with {} … {}: it may be in {instead}, \
                 or a code for \"not available\"",
                known - possible,
                frame.source(),
                number(low),
                number(high)
            ));
        }
    }
    Ok(remarks)
}

/// From here on a time is none in s, whatever it counts from: the year 5138.
const NO_TIME_S: f64 = 1e11;
/// Rows in whole numbers that are so far apart, or further, may be ms.
const MAY_BE_MS: f64 = 10.0;

/// Whether time is in s. Where it may be in ms, a remark.
pub(super) fn milliseconds(frame: &Frame) -> Result<Option<String>, Failure> {
    let t_s = frame.t_s();
    let (source, column) = (frame.source(), frame.origin("t_s"));
    if let Some(late) = t_s.iter().find(|t| t.abs() > NO_TIME_S) {
        return Err(Failure(format!(
            "{source}, column {column}: found a time of {}, expected s (since 1970 it may be in ms, µs or ns)",
            number(*late)
        )));
    }
    let mut steps: Vec<f64> = t_s.windows(2).map(|pair| pair[1] - pair[0]).collect();
    let step = median(&mut steps).unwrap_or_default();
    // What a logger is set to: 10 ms, 20 ms, 50 ms, …; a minute is no such number.
    let first_digit = step / 10_f64.powf(step.log10().floor());
    let is_set = [1.0, 2.0, 5.0]
        .iter()
        .any(|digit| (first_digit - digit).abs() < 1e-9);
    let whole = t_s.iter().all(|t| t.fract() == 0.0);
    Ok((step >= MAY_BE_MS && is_set && whole).then(|| {
        format!(
            "rows of {source} are {step} s apart by its column {column}: if that is in ms, every time that is said is a thousand \
             times too long"
        )
    }))
}

/// No clock is off by more than the recording is long.
pub(super) fn moments(model: &Model, problem: &Problem) -> Result<(), Failure> {
    let t_s = &problem.drive.t_s;
    let spans = problem.drive.segments.iter();
    let span_s: f64 = spans.map(|rows| t_s[rows.end - 1] - t_s[rows.start]).sum();
    let within = |key: &str, value: f64| {
        if value.abs() <= span_s {
            return Ok(());
        }
        Err(Failure(format!(
            "{}, key {key}: found {}, expected less than the recording's {}",
            model.source,
            number(value),
            seconds(span_s)
        )))
    };
    match &problem.base {
        Base::Sensor(base) => within("sensor.alignment_s", base.alignment_s)?,
        Base::Battery(base) => within("battery.alignment_s", base.alignment_s)?,
    }
    for (id, values) in &problem.modelled {
        let Some(card) = effects::find_with(id, values.len()).map(|effect| effect.card()) else {
            continue;
        };
        for (parameter, value) in card.parameters.iter().zip(values) {
            if card.stage == Stage::Clock && parameter.unit == "s" {
                within(&format!("effects.{id}.{}", parameter.name), *value)?;
            }
        }
    }
    Ok(())
}

/// Values of the model file under which the simulation is no number are refused: nothing could be compared with it, or written.
pub(super) fn can_be_simulated(
    model: &Model,
    problem: &Problem,
    purpose: Purpose,
    source: &str,
) -> Result<(), Failure> {
    if problem.modelled.is_empty() {
        return Ok(());
    }
    let observed = &problem.observed;
    let numbers = |problem: &Problem| {
        let said = explain::predict(problem, &[]).into_iter();
        said.zip(&observed.valid)
            .filter(|(value, valid)| **valid && value.is_finite())
            .count()
    };
    let rows = observed.valid_rows();
    let least = if purpose.compares() {
        FEWEST_ROWS
    } else {
        // A drive of a few rows can be simulated, and an effect may reach out of it.
        FEWEST_ROWS.min(rows.div_ceil(2))
    };
    let found = numbers(problem);
    if found >= least {
        return Ok(());
    }
    let alone = |index: &usize| {
        let mut alone = problem.clone();
        alone.modelled = vec![problem.modelled[*index].clone()];
        if let Base::Sensor(base) = &mut alone.base {
            // It holds what all of them do.
            base.reading.clear();
        }
        numbers(&alone) < least
    };
    let every = 0..problem.modelled.len();
    let at_fault = match every.clone().find(alone) {
        Some(index) => index..index + 1,
        None => every,
    };
    let keys: Vec<String> = problem.modelled[at_fault]
        .iter()
        .map(|(id, _)| format!("effects.{id}"))
        .collect();
    Err(Failure(format!(
        "{}, key {}: found values with which {found} of {rows} simulated readings of {} for {source} are numbers, expected at least {least}",
        model.source,
        keys.join(" and "),
        problem.name
    )))
}

/// There is enough to say something.
pub(super) fn enough(problem: &Problem, source: &str) -> Result<(), Failure> {
    let rows = problem.observed.valid_rows();
    if rows >= FEWEST_ROWS {
        return Ok(());
    }
    let drive = &problem.drive;
    let outside = problem
        .observed
        .t_s
        .iter()
        .zip(&problem.observed.value)
        .filter(|(_, value)| value.is_finite())
        .count();
    if rows == 0 && outside > 0 && !drive.is_empty() {
        let span = |t_s: &[f64]| {
            let [low, high] = range(t_s.iter().copied()).unwrap_or_default();
            format!("{} … {} s", number(shown(low)), number(shown(high)))
        };
        return Err(Failure(format!(
            "{source}, column {}: found readings at {} and a reference at {}, expected both at the same time",
            problem.name,
            span(&problem.observed.t_s),
            span(&drive.t_s)
        )));
    }
    Err(Failure(format!(
        "{source}, column {}: found {rows} readings to compare, expected at least {FEWEST_ROWS}",
        problem.name
    )))
}

/// A time without the digits that a sum of steps leaves behind.
pub(super) fn shown(t_s: f64) -> f64 {
    (t_s * 1e6).round() / 1e6
}

/// The reference at each reading that counts, and the reading; `but` are rows, in order, that are left out.
fn beside<'a>(
    drive: &'a Drive,
    observed: &'a Observed,
    but: &'a [usize],
) -> impl Iterator<Item = (f64, f64)> + Clone + 'a {
    (0..observed.t_s.len())
        .filter(|row| observed.valid[*row] && but.binary_search(row).is_err())
        .map(|row| (reference_at(drive, observed, row), observed.value[row]))
}

/// The reference at a reading.
fn reference_at(drive: &Drive, observed: &Observed, row: usize) -> f64 {
    if observed.on_drive_rows() {
        drive.reference[row]
    } else {
        at(drive, observed.segment_of(row), observed.t_s[row])
    }
}

fn at(drive: &Drive, segment: usize, t_s: f64) -> f64 {
    let Some(rows) = drive.segments.get(segment) else {
        return f64::NAN;
    };
    let next = rows.start + drive.t_s[rows.clone()].partition_point(|t| *t <= t_s);
    let before = next.saturating_sub(1).max(rows.start);
    if next >= rows.end {
        return drive.reference[before];
    }
    let h = drive.t_s[next] - drive.t_s[before];
    if h <= 0.0 {
        return drive.reference[before];
    }
    let share = ((t_s - drive.t_s[before]) / h).clamp(0.0, 1.0);
    drive.reference[before] + share * (drive.reference[next] - drive.reference[before])
}

/// Distance between the 2nd and the 98th percentile.
fn spread(values: impl Iterator<Item = f64>) -> f64 {
    let mut known: Vec<f64> = values.filter(|value| value.is_finite()).collect();
    if known.len() < 2 {
        return 0.0;
    }
    let last = known.len() - 1;
    let mut at = |share: f64| {
        let place = (last as f64 * share).round() as usize;
        *known.select_nth_unstable_by(place, f64::total_cmp).1
    };
    let wide = at(0.98) - at(0.02);
    if wide > 0.0 { wide } else { at(1.0) - at(0.0) }
}

/// Pearson's correlation; 0 where one does not move.
fn correlation(pairs: impl Iterator<Item = (f64, f64)> + Clone) -> f64 {
    let (mut count, mut sum_one, mut sum_other) = (0.0, 0.0, 0.0);
    for (x, y) in pairs.clone() {
        count += 1.0;
        sum_one += x;
        sum_other += y;
    }
    if count < 2.0 {
        return 0.0;
    }
    let (mean_one, mean_other) = (sum_one / count, sum_other / count);
    let (mut cross, mut square_one, mut square_other) = (0.0, 0.0, 0.0);
    for (x, y) in pairs {
        let (x, y) = (x - mean_one, y - mean_other);
        cross += x * y;
        square_one += x * x;
        square_other += y * y;
    }
    if square_one > 0.0 && square_other > 0.0 {
        cross / (square_one * square_other).sqrt()
    } else {
        0.0
    }
}

/// The power of 1000 that a ratio is near to, if it is not the 0th.
fn thousands(ratio: f64) -> Option<i32> {
    if !(ratio > 0.0 && ratio.is_finite()) {
        return None;
    }
    let power = (ratio.log10() / 3.0).round();
    let near = (ratio / 1000_f64.powf(power)).ln().abs() <= POWER_WITHIN.ln();
    (power != 0.0 && near).then_some(power as i32)
}

/// Single readings, or up to [`WILD_ROWS`] in a row, that jump there and back though the reference does not.
#[derive(Debug, Default)]
pub(super) struct Wild {
    /// Their rows.
    rows: Vec<usize>,
    /// How often that happens.
    places: usize,
    /// What the first would be between its neighbours.
    between: f64,
}

/// What is wild. Nothing where the reference has such jumps too, which may only show later, and where there are many.
pub(super) fn wild(drive: &Drive, observed: &Observed) -> Wild {
    let count = observed.t_s.len();
    let rows = || (0..count).filter(|row| observed.valid[*row]);
    let steps = rows().zip(rows().skip(1));
    let steps = steps.map(|(from, to)| (observed.value[to] - observed.value[from]).abs());
    let Some(typical) = median(&mut steps.collect::<Vec<_>>()) else {
        return Wild::default();
    };
    let wide = spread(rows().map(|row| observed.value[row]));
    let least = (WILD_SHARE * wide).max(WILD_STEPS * typical);
    let reading = |row: usize| observed.value[row];
    let reference = |row: usize| reference_at(drive, observed, row);
    // How far all of the rows between the first and the last one are off both, to one side.
    let jump = |value: &dyn Fn(usize) -> f64, window: &[usize]| -> f64 {
        let [first, inside @ .., last] = window else {
            return 0.0;
        };
        let (low, high) = (
            value(*first).min(value(*last)),
            value(*first).max(value(*last)),
        );
        let over = inside.iter().map(|row| value(*row) - high);
        let under = inside.iter().map(|row| low - value(*row));
        over.fold(f64::INFINITY, f64::min)
            .max(under.fold(f64::INFINITY, f64::min))
    };
    let next = |row: usize| (row + 1..count).find(|row| observed.valid[*row]);
    let mut found = Wild::default();
    let mut at = rows().next();
    while let Some(first) = at {
        at = next(first);
        // Two rows around those out there.
        let mut around = [first; WILD_ROWS + 2];
        for length in 2..=around.len() {
            let Some(row) = next(around[length - 2]) else {
                break;
            };
            if observed.segment_of(row) != observed.segment_of(first) {
                break;
            }
            around[length - 1] = row;
            if length < 3 {
                continue;
            }
            let window = &around[..length];
            if jump(&reference, window) > least {
                return Wild::default();
            }
            let size = jump(&reading, window);
            let (low, high) = window
                .iter()
                .map(|row| reference(*row))
                .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| {
                    (low.min(x), high.max(x))
                });
            if size > least && high - low < 0.1 * size {
                if found.places == 0 {
                    found.between = 0.5 * (reading(first) + reading(row));
                }
                found.places += 1;
                found.rows.extend(&window[1..length - 1]);
                at = Some(row);
                break;
            }
            // Only what already stands out may take longer to come back.
            if (reading(window[1]) - reading(first)).abs() <= least {
                break;
            }
        }
    }
    if found.rows.len() as f64 > WILD_MOST * rows().count() as f64 {
        return Wild::default();
    }
    found
}

/// Units and signs of a sensor and its reference.
pub(super) fn pair(
    drive: &Drive,
    observed: &Observed,
    wild: &Wild,
    frame: &Frame,
    [reference, measured]: [&str; 2],
) -> Result<(), Failure> {
    let source = frame.source();
    let pairs = beside(drive, observed, &wild.rows);
    if pairs.clone().count() < FEWEST_ROWS {
        return Ok(());
    }
    let spread_x = spread(pairs.clone().map(|(reference, _)| reference));
    let spread_y = spread(pairs.clone().map(|(_, reading)| reading));
    let together = correlation(pairs);
    if together.abs() > RELATED
        && let Some(power) = thousands(spread_x / spread_y)
    {
        let (large, small) = if power > 0 {
            (reference, measured)
        } else {
            (measured, reference)
        };
        let factor = 1000_f64.powi(power.abs());
        return Err(Failure(format!(
            "{source}: {large} moves by {:.4} and {small} by {:.4}, a factor near {factor}: found two units, expected the same \
             unit in both (one of them may be in thousandths)",
            spread_x.max(spread_y),
            spread_x.min(spread_y)
        )));
    }
    if (SURELY_OPPOSITE..OPPOSITE).contains(&together) {
        return Err(Failure(format!(
            "{source}: {measured} falls where {reference} rises, but only loosely (correlation {together:.2}): found two signals \
             that are hardly of the same run, expected a sensor and its reference"
        )));
    }
    if together < OPPOSITE {
        return Err(Failure(format!(
            "{source}: {measured} falls where {reference} rises (correlation {together:.2}): found opposite signs, expected \
             discharge positive in both; to turn one: --map {}",
            frame.turned(measured)
        )));
    }
    Ok(())
}

/// Seconds of an hour.
const HOUR_S: f64 = 3600.0;
/// A ratio is that of C and Ah if it is within this factor of one.
const HOUR_WITHIN: f64 = 1.25;

/// By how much the reference's charge in C, and the readings, move from one time to the next: over times of at least an interval, some
/// two for each of the [`FEWEST_ROWS`].
fn moved(drive: &Drive, readings: &Observed, interval_s: f64) -> Vec<(f64, f64)> {
    let charge_c = integral(&drive.t_s, &drive.segments, &drive.reference, false);
    let charge = Drive {
        reference: charge_c.into(),
        ..drive.clone()
    };
    // Over longer times noise and steps matter less.
    let span_s = match (drive.t_s.first(), drive.t_s.last()) {
        (Some(first), Some(last)) => last - first,
        _ => 0.0,
    };
    let apart_s = (span_s / (2 * FEWEST_ROWS) as f64).max(interval_s);
    let mut last: Option<usize> = None;
    let mut moved = Vec::new();
    for row in (0..readings.t_s.len()).filter(|row| readings.valid[*row]) {
        let Some(before) =
            last.filter(|before| readings.segment_of(*before) == readings.segment_of(row))
        else {
            last = Some(row);
            continue;
        };
        if readings.t_s[row] - readings.t_s[before] >= 0.999 * apart_s {
            moved.push((
                reference_at(&charge, readings, row) - reference_at(&charge, readings, before),
                readings.value[row] - readings.value[before],
            ));
            last = Some(row);
        }
    }
    moved
}

/// Unit and sign of a charge counter, against the charge of the reference.
pub(super) fn counter(
    drive: &Drive,
    readings: &Observed,
    interval_s: f64,
    frame: &Frame,
    column: &str,
) -> Result<(), Failure> {
    let source = frame.source();
    let moved = moved(drive, readings, interval_s);
    if moved.len() < FEWEST_ROWS / 2 {
        return Ok(());
    }
    let of_reference = spread(moved.iter().map(|(reference, _)| *reference));
    let of_counter = spread(moved.iter().map(|(_, counted)| *counted));
    // A counter that is set anew, or begins again at its end, jumps: once or twice, and further than all else.
    let mut counted: Vec<f64> = moved.iter().map(|(_, counted)| *counted).collect();
    let middle = median(&mut counted).unwrap_or_default();
    let kept = moved
        .iter()
        .filter(|(_, counted)| (counted - middle).abs() <= of_counter);
    let together = correlation(kept.copied());
    if together.abs() < -SURELY_OPPOSITE {
        return Ok(());
    }
    let ratio = of_reference / of_counter;
    let unit = if (ratio / HOUR_S).ln().abs() <= HOUR_WITHIN.ln() {
        Some("Ah")
    } else {
        thousands(ratio).map(|power| {
            if power > 0 {
                "thousands of C"
            } else {
                "thousandths of C"
            }
        })
    };
    if let Some(unit) = unit {
        return Err(Failure(format!(
            "{source}, column {column}: found a charge that moves by {of_counter:.4} where the reference's moves by \
             {of_reference:.4} C, expected C in both (it may be in {unit}, or the time not in s)"
        )));
    }
    if together < 0.0 {
        return Err(Failure(format!(
            "{source}: {column} falls where the reference's charge rises (correlation {together:.2}): found opposite signs, \
             expected discharge positive in both; to turn one: --map {}",
            frame.turned(column)
        )));
    }
    Ok(())
}

/// Whether the reference is one: remarks on what it does that no current does.
pub(super) fn plausible(
    drive: &Drive,
    observed: &Observed,
    wild: &Wild,
    sensor: &Sensor,
    [reference, measured]: [&str; 2],
) -> Vec<String> {
    let mut remarks = Vec::new();
    let pairs = beside(drive, observed, &[]);
    if pairs.clone().count() < FEWEST_ROWS {
        return remarks;
    }
    let together = correlation(beside(drive, observed, &wild.rows));
    let spread_x = spread(beside(drive, observed, &wild.rows).map(|(reference, _)| reference));
    let spread_y = spread(beside(drive, observed, &wild.rows).map(|(_, reading)| reading));
    if together.abs() < UNRELATED && spread_x < HARDLY * spread_y {
        remarks.push(format!(
            "{reference} moves by {spread_x:.4} in all and {measured} by {spread_y:.4}: with so little of it this recording may tell a zero, \
             and nothing of gain or time"
        ));
    } else if together.abs() < UNRELATED {
        remarks.push(format!(
            "{measured} does not follow {reference} (correlation {together:.2}): the sensor may be dead, or the reference be that of another conductor"
        ));
    }
    let factor = f64::max(spread_x / spread_y, spread_y / spread_x);
    if factor > NO_GAIN && together > -SURELY_OPPOSITE {
        remarks.push(format!(
            "{measured} moves by {spread_y:.4} where {reference} moves by {spread_x:.4}, a factor of {factor:.4}: more than any gain \
             is off by; one of the two may be scaled, or in another unit"
        ));
    }
    if let Some(full_scale) = sensor.full_scale {
        let beyond = drive
            .reference
            .iter()
            .filter(|i| i.abs() > full_scale)
            .count();
        let most = drive
            .reference
            .iter()
            .fold(0.0_f64, |most, i| most.max(i.abs()));
        if beyond > 0 {
            remarks.push(format!(
                "{reference} is beyond the sensor's full scale of {full_scale} in {beyond} of {} rows, at most {}",
                drive.len(),
                number(most)
            ));
        }
    }
    remarks.extend(clipped(pairs, measured));
    if let Some(row) = wild.rows.first() {
        remarks.push(format!(
            "{measured} jumps there and back within {WILD_ROWS} rows in {} that {reference} does not show, the first at {} s: \
             {} between readings around {:.4}; such readings may keep anything from fitting",
            count(wild.places, "place"),
            shown(observed.t_s[*row]),
            number(observed.value[*row]),
            wild.between
        ));
    }
    remarks.extend(spikes(drive, observed, reference));
    remarks.extend(stuck(drive, observed, reference, measured));
    remarks.extend(stairs::remark(drive, observed, [reference, measured]));
    remarks
}

/// Readings that stand at their highest or lowest value while the reference moves.
fn clipped(pairs: impl Iterator<Item = (f64, f64)> + Clone, measured: &str) -> Vec<String> {
    let readings = pairs.clone().count();
    let (low, high) = pairs.clone().fold(
        (f64::INFINITY, f64::NEG_INFINITY),
        |(low, high), (_, reading)| (low.min(reading), high.max(reading)),
    );
    let mut remarks = Vec::new();
    for (end, what) in [(high, "highest"), (low, "lowest")] {
        let references = pairs.clone().map(|(reference, _)| reference);
        let inside = pairs
            .clone()
            .filter(|(_, reading)| *reading == end)
            .map(|(reference, _)| reference);
        let count = inside.clone().count();
        let enough = count >= 5 && count as f64 >= CLIPPED_SHARE * readings as f64;
        // At rest every reading may be the lowest one: then the reference does not move there either.
        if enough && spread(inside) > 0.02 * spread(references) {
            remarks.push(format!(
                "{measured} stands at its {what} value {} in {count} of {readings} readings: it may be clipped",
                number(end)
            ));
        }
    }
    remarks
}

/// Single rows of the reference that jump there and back, which the sensor does not show.
fn spikes(drive: &Drive, observed: &Observed, reference: &str) -> Option<String> {
    if !observed.on_drive_rows() {
        return None;
    }
    let mut steps: Vec<f64> = drive
        .segments
        .iter()
        .flat_map(|rows| {
            drive.reference[rows.clone()]
                .windows(2)
                .map(|pair| (pair[1] - pair[0]).abs())
        })
        .collect();
    let typical = median(&mut steps)?;
    drop(steps);
    let wide = spread(drive.reference.iter().copied());
    let mut found = Vec::new();
    for rows in &drive.segments {
        for row in rows.start + 1..rows.end.saturating_sub(1) {
            let (before, now, after) = (
                drive.reference[row - 1],
                drive.reference[row],
                drive.reference[row + 1],
            );
            let jump = (now - before).abs().min((now - after).abs());
            let back = (now - before) * (now - after) > 0.0;
            let sensor = [row - 1, row, row + 1].map(|row| observed.value[row]);
            let shown = (sensor[1] - 0.5 * (sensor[0] + sensor[2])).abs();
            if back && jump > wide.max(20.0 * typical) && shown < 0.1 * jump {
                found.push(drive.t_s[row]);
            }
        }
    }
    let first = found.first()?;
    Some(format!(
        "{reference} jumps there and back within one row in {} places that the sensor does not show, the first at {} s: \
         the reference may be at fault",
        found.len(),
        shown(*first)
    ))
}

/// A stretch in which the reference stands still to the last digit while the sensor moves.
fn stuck(drive: &Drive, observed: &Observed, reference: &str, measured: &str) -> Option<String> {
    if !observed.on_drive_rows() {
        return None;
    }
    let wide = spread(observed.value.iter().copied());
    for rows in &drive.segments {
        let mut start = rows.start;
        while start < rows.end {
            let mut end = start + 1;
            while end < rows.end && drive.reference[end] == drive.reference[start] {
                end += 1;
            }
            let inside = (start..end)
                .filter(|row| observed.valid[*row])
                .map(|row| observed.value[row]);
            // At 0 the car may stand.
            let stands = drive.reference[start] == 0.0 || inside.clone().count() < 20;
            let stands_at = drive.reference[start];
            if !stands
                && spread(inside.clone()) > 0.3 * wide
                && moves(inside.clone())
                && !settles(inside, stands_at)
            {
                return Some(format!(
                    "{reference} stands at {} for {} from {} s on while {measured} moves: the reference may be at fault",
                    number(stands_at),
                    seconds(drive.t_s[end - 1] - drive.t_s[start]),
                    shown(drive.t_s[start])
                ));
            }
            start = end;
        }
    }
    None
}

/// Whether values go one way towards a value, as a slow sensor does after a step.
fn settles(values: impl Iterator<Item = f64>, towards: f64) -> bool {
    let off: Vec<f64> = values.map(|value| value - towards).collect();
    let part = off.len().div_ceil(SETTLING_PARTS).max(1);
    let means: Vec<f64> = off
        .chunks(part)
        .map(|part| part.iter().sum::<f64>() / part.len() as f64)
        .collect();
    let way: f64 = means.windows(2).map(|pair| (pair[1] - pair[0]).abs()).sum();
    let [Some(first), Some(last)] = [means.first(), means.last()] else {
        return false;
    };
    last.abs() < first.abs() && way <= ONE_WAY * (first - last).abs()
}

/// Whether values move by more than noise does: of what has no course, the steps' mean square is twice the variance.
fn moves(values: impl Iterator<Item = f64> + Clone) -> bool {
    let count = values.clone().count() as f64;
    let mean = values.clone().sum::<f64>() / count;
    let variance = values.clone().map(|x| (x - mean).powi(2)).sum::<f64>() / count;
    let steps = values.clone().zip(values.skip(1));
    let steps = steps.map(|(from, to)| (to - from).powi(2)).sum::<f64>() / (count - 1.0);
    steps < COURSE * variance
}

/// What is to be said of a current that is turned, and of what shows it.
fn charging_positive(shown: String, (frame, current): (&Frame, &str)) -> Failure {
    Failure(format!(
        "{shown}: found charging positive, expected discharge positive; to turn it: --map {}",
        frame.turned(current)
    ))
}

/// Stretches over which a state of charge is compared with the charge that flowed.
const SOC_STRETCHES: usize = 20;

/// Sign and time of a battery with a state of charge, against the charge of the current.
fn state_of_charge(
    drive: &Drive,
    observed: &Observed,
    base: &BatteryBase,
    [frame, of_current]: [&Frame; 2],
    [name, current]: [&str; 2],
) -> Result<(), Failure> {
    let source = frame.source();
    // A per cent less is so much that was discharged.
    let per_cent_c = base.capacity_ah * HOUR_S / 100.0;
    // It has steps and noise of its own: few stretches, over which it moves by more than those.
    let span_s = match (observed.t_s.first(), observed.t_s.last()) {
        (Some(first), Some(last)) => last - first,
        _ => 0.0,
    };
    let moved: Vec<(f64, f64)> = moved(drive, observed, span_s / SOC_STRETCHES as f64)
        .into_iter()
        .map(|(charge_c, per_cent)| (charge_c, -per_cent * per_cent_c))
        .collect();
    let together = correlation(moved.iter().copied());
    if moved.len() < SOC_STRETCHES / 2 || together.abs() < -SURELY_OPPOSITE {
        return Ok(());
    }
    let of_current_c = spread(moved.iter().map(|(charge_c, _)| *charge_c));
    let of_soc_c = spread(moved.iter().map(|(_, charge_c)| *charge_c));
    let ratio = of_soc_c / of_current_c;
    let near = |factor: f64| (ratio / factor).ln().abs() <= HOUR_WITHIN.ln();
    let unit = match thousands(ratio) {
        _ if near(60.0) => Some("the time may be in min"),
        _ if near(HOUR_S) => Some("the time may be in h"),
        Some(power) if power > 0 => Some("the current may be in kA"),
        Some(_) => Some("the current may be in mA, or the time in ms"),
        None => None,
    };
    if let Some(unit) = unit {
        return Err(Failure(format!(
            "{source}, column {name}: found a state of charge that moves by {of_soc_c:.4} C of capacity_ah where the charge of {current} moves \
             by {of_current_c:.4} C, expected about as much ({unit})"
        )));
    }
    if together < 0.0 {
        return Err(charging_positive(
            format!(
                "{source}: {name} rises where {current} discharges (correlation {together:.2})"
            ),
            (of_current, current),
        ));
    }
    Ok(())
}

/// Units and signs of a battery.
pub(super) fn battery(
    view: View,
    drive: &Drive,
    observed: &Observed,
    base: &BatteryBase,
    [frame, of_current]: [&Frame; 2],
    [name, current]: [&str; 2],
) -> Result<(), Failure> {
    let source = frame.source();
    let pairs = beside(drive, observed, &[]);
    if pairs.clone().count() < FEWEST_ROWS {
        return Ok(());
    }
    if view == View::StateOfCharge {
        let most = pairs.fold(0.0_f64, |most, (_, soc)| most.max(soc.abs()));
        if most <= 1.01 {
            return Err(Failure(format!(
                "{source}, column {name}: found values up to {}, expected per cent, 0 to 100",
                number(most)
            )));
        }
        return state_of_charge(drive, observed, base, [frame, of_current], [name, current]);
    }
    let mut volts: Vec<f64> = pairs.clone().map(|(_, volts)| volts).collect();
    let mut table: Vec<f64> = base.ocv.iter().map(|(_, volts)| *volts).collect();
    let (Some(middle), Some(designed)) = (median(&mut volts), median(&mut table)) else {
        return Ok(());
    };
    if let Some(power) = thousands(middle / designed) {
        return Err(Failure(format!(
            "{source}, column {name}: found voltages around {middle:.4}, 10^{} times the open-circuit voltage {designed:.4} V, expected V",
            3 * power
        )));
    }
    let volts = base.ocv.iter().map(|(_, volts)| *volts);
    let (low, high) = volts.fold((f64::INFINITY, 0.0_f64), |(low, high), volts| {
        (low.min(volts), high.max(volts))
    });
    if middle > OTHER_CELLS * high || middle < low / OTHER_CELLS {
        let hint = if name == PACK {
            format!(
                "; cells = {} in [battery] says how many are in series",
                base.cells
            )
        } else {
            format!("; a pack's voltage is {PACK}, with cells in [battery]")
        };
        return Err(Failure(format!(
            "{source}, column {name}: found voltages around {middle:.4} V, expected some within reach of the open-circuit \
             voltage, {low:.4} … {high:.4} V{hint}"
        )));
    }
    let mut amperes: Vec<f64> = pairs.clone().map(|(current, _)| current.abs()).collect();
    let last = amperes.len() - 1;
    let (_, most, _) =
        amperes.select_nth_unstable_by((0.98 * last as f64) as usize, f64::total_cmp);
    let drop = *most * base.resistance_ohm;
    if drop > high {
        return Err(Failure(format!(
            "{source}, column {current}: found currents up to {most:.4}, which over ohmic_resistance_ohm are {drop:.4} V, more than \
             the open-circuit voltage, {high:.4} V; expected A, and Ω (one of the two may be in thousandths)"
        )));
    }
    // From one reading to the next the slow open-circuit voltage hardly matters.
    let next = pairs.clone().skip(1);
    let steps = pairs
        .zip(next)
        .map(|(from, to)| (to.0 - from.0, to.1 - from.1));
    let together = correlation(steps);
    if together > -OPPOSITE {
        return Err(charging_positive(
            format!("{source}: {name} rises where {current} rises (correlation {together:.2})"),
            (of_current, current),
        ));
    }
    Ok(())
}
