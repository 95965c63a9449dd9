//! Values that loggers and buses write where there is no reading: codes for "not available".

use recording::{Table, error::number};

use super::FEWEST_ROWS;
use crate::range::range;

/// Ends of whole numbers of 16 and 32 bits, with and without a sign, as magnitudes. A bus scales them by a power of ten.
const ENDS: [f64; 6] = [
    32_767.0,
    32_768.0,
    65_535.0,
    2_147_483_647.0,
    2_147_483_648.0,
    4_294_967_295.0,
];
/// Bits of shorter numbers that a bus packs a reading into, as many as it needs: their ends are values like any other, and codes only
/// where more speaks for it.
const SHORT_BITS: std::ops::RangeInclusive<i32> = 10..=15;
/// A byte with its usual offset, in °C, as a bus has temperatures: both of its ends.
const BYTE_C: [f64; 2] = [-40.0, 215.0];
/// Decimals that a bus gives a number, at most: 0.1 mV.
const DECIMALS: i32 = 4;
/// What people write; unscaled, for 9.99 is a reading like any other.
const NINES: [f64; 4] = [999.0, 9999.0, 99_999.0, 999_999.0];
/// A code may have come through a number of 32 bits, which has 7 digits.
const DIGITS: f64 = 1e-6;
/// A code is further from all readings than this share of their range; a rail is next to them.
const FAR: f64 = 0.5;
/// So often a value comes that is no slip.
const OFTEN: usize = 3;
/// A temperature is a code, if it may be one, where it is further from all others than this share of their range, …
const FAR_ALONE: f64 = 1.0;
/// … comes in no more than this share of the rows, …
const SELDOM: f64 = 0.1;
/// … and is gone in a row to where it came from, to within this share of the jump: no temperature does that.
const THERE_AND_BACK: f64 = 0.2;

/// What may be a code beside the ends of numbers of whole bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Others {
    None,
    /// Ends of shorter numbers.
    Short,
    /// Those and ends of a byte, of a temperature.
    Temperature,
}

/// One code in one column.
#[derive(Debug)]
struct Code {
    value: f64,
    rows: Vec<usize>,
}

/// Takes the codes out of these columns, as if their fields were empty; what was done, in words. `partner` is the column that
/// reads the same thing as another one.
pub(super) fn leave_out<'a>(
    table: &mut Table,
    names: &[&'a str],
    partner: impl Fn(&str) -> Option<&'a str>,
) -> Vec<String> {
    let mut remarks = Vec::new();
    let mut found = Vec::new();
    for name in names {
        let Some(values) = table.column(name) else {
            continue;
        };
        let beside = partner(name).and_then(|other| table.column(other));
        let others = if name.starts_with("temp_") {
            Others::Temperature
        } else if beside.is_some() {
            Others::Short
        } else {
            Others::None
        };
        let Some((codes, [low, high])) = codes(values, beside, others) else {
            continue;
        };
        for code in codes {
            let times_s = table.column(recording::name::T_S).unwrap_or_default();
            let first_s = code.rows.first().and_then(|row| times_s.get(*row));
            remarks.push(format!(
                "{name} is {} in {} of {} rows of {}, the first at {} s, and {} … {} in all others: it looks like a code for \"not \
                 available\" and is taken as missing there; such fields are better left empty",
                number(code.value),
                code.rows.len(),
                values.len(),
                table.source(),
                number(first_s.copied().unwrap_or_default()),
                number(low),
                number(high)
            ));
            found.push((*name, code.rows));
        }
    }
    for (name, rows) in found {
        table.leave_out(name, &rows);
    }
    remarks
}

/// Whether a number is one that codes of this kind may be.
fn may_be_code(value: f64, others: Others) -> bool {
    is_code(value)
        || others != Others::None && is_short(value)
        || others == Others::Temperature && BYTE_C.contains(&value)
}

/// Whether a number is an end of one of fewer than 16 bits: the top of one without a sign, or either end of one with a sign.
fn is_short(value: f64) -> bool {
    (0..=DECIMALS).any(|decimals| {
        let whole = value * 10_f64.powi(decimals);
        SHORT_BITS.into_iter().any(|bits| {
            let values = 2_f64.powi(bits);
            [values - 1.0, -0.5 * values]
                .iter()
                .any(|end| (whole - end).abs() <= DIGITS * values)
        })
    })
}

/// Whether a number is one that codes are made of, in whatever column.
fn is_code(value: f64) -> bool {
    let size = value.abs();
    NINES.contains(&size)
        || (0..=DECIMALS).any(|decimals| {
            let whole = size * 10_f64.powi(decimals);
            ENDS.iter().any(|end| (whole - end).abs() <= DIGITS * end)
        })
}

/// The codes in a column, and between what its readings are.
fn codes(values: &[f64], beside: Option<&[f64]>, others: Others) -> Option<(Vec<Code>, [f64; 2])> {
    let [low, high] = range(values.iter().copied())?;
    let may_be_code = |value: f64| may_be_code(value, others);
    if !may_be_code(low) && !may_be_code(high) {
        return None;
    }
    let readings = || values.iter().copied().filter(|value| !may_be_code(*value));
    let ends = range(readings())?;
    let [low, high] = ends;
    let known = readings().filter(|value| value.is_finite()).count();
    if known < FEWEST_ROWS || low == high {
        return None;
    }
    let mut found: Vec<Code> = Vec::new();
    for (row, value) in values.iter().enumerate() {
        let off = (value - high).max(low - value);
        if off > FAR * (high - low) && may_be_code(*value) {
            match found.iter_mut().find(|code| code.value == *value) {
                Some(code) => code.rows.push(row),
                None => found.push(Code {
                    value: *value,
                    rows: vec![row],
                }),
            }
        }
    }
    found.retain(|code| {
        code.rows.len() >= OFTEN
            && (is_code(code.value)
                || others == Others::Short
                || is_of_a_temperature(code, values, ends))
    });
    if let Some(beside) = beside {
        let there = |row: &usize| {
            beside
                .get(*row)
                .copied()
                .filter(|value| value.is_finite() && !may_be_code(*value))
        };
        let elsewhere = (0..values.len()).filter(|row| (low..=high).contains(&values[*row]));
        if let Some([low, high]) = range(elsewhere.filter_map(|row| there(&row))) {
            // Beyond what it reads elsewhere the other one reads what this one cannot: its end is a rail, and a fault of its own.
            found.retain(|code| {
                let known = code.rows.iter().filter_map(there);
                let (beyond, all) = known.fold((0, 0), |(beyond, all), value| {
                    (beyond + usize::from(value < low || value > high), all + 1)
                });
                2 * beyond <= all
            });
        }
    }
    (!found.is_empty()).then_some((found, ends))
}

/// Whether a value that may be a code is none that a temperature went to: far off, seldom, and there and back within a row.
fn is_of_a_temperature(code: &Code, values: &[f64], [low, high]: [f64; 2]) -> bool {
    let off = (code.value - high).max(low - code.value);
    let is_reading = |value: &&f64| (low..=high).contains(*value);
    let mut runs = code.rows.chunk_by(|row, next| row + 1 == *next);
    let returns = |run: &[usize]| {
        let (first, last) = (run[0], run[run.len() - 1]);
        let before = values[..first].iter().rfind(is_reading);
        let after = values[last + 1..].iter().find(is_reading);
        // At an end of the recording only one of them is known.
        let apart = before
            .zip(after)
            .map(|(before, after)| (after - before).abs());
        apart.is_none_or(|apart| apart <= THERE_AND_BACK * off)
    };
    off > FAR_ALONE * (high - low)
        && code.rows.len() as f64 <= SELDOM * values.len() as f64
        && runs.all(returns)
}
