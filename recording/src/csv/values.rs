//! What a field says.

use super::moments::{self, Moments};
use crate::error::{Error, Kind, Place, Result, quoted};

/// A column's numbers, or why it has none.
pub(super) struct Values {
    read: Result<Vec<f64>>,
    /// What its times are counted from, where they stand as clocks and calendars show them.
    moments: Option<Moments>,
}

impl Values {
    pub(super) fn new(expected_rows: usize) -> Self {
        Self {
            read: Ok(Vec::with_capacity(expected_rows)),
            moments: None,
        }
    }

    /// Takes in the next row's field. The first that is no number decides: from then on the column is left out.
    pub(super) fn push(&mut self, field: &str, decimal: &mut Decimal, at: &At<'_>) {
        let Ok(numbers) = &mut self.read else {
            return;
        };
        let read = match &mut self.moments {
            Some(moments) => moments.value(field),
            None => decimal.value(field, at.line).or_else(|fault| {
                // The first value of a column says what the column has.
                let is_first = numbers.iter().all(|number| number.is_nan());
                let begun = if is_first {
                    moments::begin(field)
                } else {
                    None
                };
                begun.map_or(Err(fault), |(moments, value)| {
                    self.moments = Some(moments);
                    Ok(value)
                })
            }),
        };
        match read {
            Ok(number) => numbers.push(number),
            Err((kind, mut expected)) => {
                if at.is_alone {
                    expected.push_str(" (commas, semicolons or tabs part fields)");
                }
                let place = Place::field(at.line, at.column, at.name);
                let error = Error::new(kind, at.source, place, quoted(field), expected);
                self.read = Err(error);
            }
        }
    }

    /// They were times as clocks and calendars show them.
    pub(super) fn are_times(&self) -> bool {
        self.moments.is_some()
    }

    /// The numbers, or the first field that is none.
    pub(super) fn into_numbers(self) -> Result<Vec<f64>> {
        self.read
    }
}

/// Where a field stands, for messages.
pub(super) struct At<'a> {
    pub source: &'a str,
    pub line: u64,
    /// From 0.
    pub column: usize,
    pub name: &'a str,
    /// There is no other column.
    pub is_alone: bool,
}

/// Whether a field is a number, with either decimal mark where commas do not separate, or what a clock or a calendar shows.
pub(super) fn is_number(field: &str, separator: u8) -> bool {
    let field = field.trim();
    field.parse::<f64>().is_ok()
        || (separator != b',' && field.replace(',', ".").parse::<f64>().is_ok())
        || moments::begin(field).is_some()
}

/// The decimal mark of a file.
pub(super) struct Decimal {
    /// Where commas separate fields the mark is a point.
    may_be_comma: bool,
    /// Whether it is a comma, and the line that tells; a file of whole numbers has no mark.
    told: Option<(bool, u64)>,
}

impl Decimal {
    pub(super) fn new(separator: u8) -> Self {
        Self {
            may_be_comma: separator != b',',
            told: None,
        }
    }

    /// A field's number; what is wrong with it, and what was expected. One mark in one file: elsewhere the other one may part
    /// thousands.
    fn value(&mut self, field: &str, line: u64) -> std::result::Result<f64, (Kind, String)> {
        let plain = |kind| {
            let hint = if moments::are_meant(field) {
                moments::HINT
            } else {
                ""
            };
            (kind, format!("a number or an empty field{hint}"))
        };
        if !self.may_be_comma {
            return value(field).map_err(plain);
        }
        let is_comma = field.contains(',');
        if !is_comma && !field.contains('.') {
            return value(field).map_err(plain);
        }
        let number = if !is_comma {
            value(field)
        } else if field.contains('.') {
            Err(Kind::NotANumber)
        } else {
            value(&field.replace(',', "."))
        };
        let number = number.map_err(plain)?;
        let (told, at) = *self.told.get_or_insert((is_comma, line));
        if told != is_comma {
            let mark = if told { "comma" } else { "point" };
            let expected = format!("a decimal {mark}, as in line {at}");
            return Err((Kind::NotANumber, expected));
        }
        Ok(number)
    }
}

/// A field's number, NaN for an empty one and for NaN, as other tools write what is missing.
fn value(field: &str) -> std::result::Result<f64, Kind> {
    let field = field.trim_ascii();
    if field.is_empty() {
        return Ok(f64::NAN);
    }
    let number = field.parse::<f64>().map_err(|_| Kind::NotANumber)?;
    if number.is_infinite() {
        return Err(Kind::Infinite);
    }
    Ok(number)
}
