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
        let Some((codes, [low, high])) = codes(values, beside) else {
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

/// Whether a number is one that codes are made of.
fn is_code(value: f64) -> bool {
    let size = value.abs();
    NINES.contains(&size)
        || (0..=DECIMALS).any(|decimals| {
            let whole = size * 10_f64.powi(decimals);
            ENDS.iter().any(|end| (whole - end).abs() <= DIGITS * end)
        })
}

/// The codes in a column, and between what its readings are.
fn codes(values: &[f64], beside: Option<&[f64]>) -> Option<(Vec<Code>, [f64; 2])> {
    let [low, high] = range(values.iter().copied())?;
    if !is_code(low) && !is_code(high) {
        return None;
    }
    let readings = || values.iter().copied().filter(|value| !is_code(*value));
    let ends = range(readings())?;
    let [low, high] = ends;
    let known = readings().filter(|value| value.is_finite()).count();
    if known < FEWEST_ROWS || low == high {
        return None;
    }
    let mut found: Vec<Code> = Vec::new();
    for (row, value) in values.iter().enumerate() {
        let off = (value - high).max(low - value);
        if off > FAR * (high - low) && is_code(*value) {
            match found.iter_mut().find(|code| code.value == *value) {
                Some(code) => code.rows.push(row),
                None => found.push(Code {
                    value: *value,
                    rows: vec![row],
                }),
            }
        }
    }
    found.retain(|code| code.rows.len() >= OFTEN);
    if let Some(beside) = beside {
        let there = |row: &usize| {
            beside
                .get(*row)
                .copied()
                .filter(|value| value.is_finite() && !is_code(*value))
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
