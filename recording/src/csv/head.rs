//! What stands above the rows: a separator, lines about the file, the names, units.

use std::collections::HashSet;

use super::{
    lines::{Fields, Lines},
    values,
};
use crate::{
    error::{Error, Kind, Place, Result, quoted},
    unit::{self, Unit},
};

/// Lines in which the names are looked for.
const LOOKED_AT: usize = 200;

/// Rows that tell names from lines about the file, which may look like a name and a number.
const ROWS: usize = 8;

/// The names and what was found with them.
pub(super) struct Head {
    /// The names' line.
    pub line: u64,
    /// What stands between fields.
    pub separator: u8,
    /// A name for each column, empty for one without.
    pub names: Vec<String>,
    /// A line of units below them, and each column's where it is known.
    pub units: Option<(u64, Vec<Option<Unit>>)>,
    /// Lines about the file stand above them.
    pub is_below_others: bool,
}

/// Finds the names, and the lines of rows after them.
///
/// The first line has them, unless what follows does not fit it: then the first line of names that rows of as many fields follow.
pub(super) fn find<'a>(source: &str, text: &'a str) -> Result<(Head, Lines<'a>)> {
    let mut lines = Lines::new(text);
    let mut first = lines.next();
    let stated = match first {
        Some((line, text)) => stated_separator(source, line, text)?,
        None => None,
    };
    if stated.is_some() {
        first = lines.next();
    }
    let Some((first_line, first)) = first else {
        let found = match stated {
            Some(_) => "nothing but a separator",
            None => "an empty file",
        };
        return Err(Error::new(
            Kind::Empty,
            source,
            Place::default(),
            found,
            "a header line",
        ));
    };
    let mut chosen = Candidate::of(stated, first_line, first, &lines);
    let has_numbers_below = chosen.has_rows() && chosen.fit == Fit::All;
    if !(has_numbers_below || chosen.is_above_numbers(&lines)) {
        let mut rest = lines.clone();
        for _ in 0..LOOKED_AT {
            let Some((line, text)) = rest.next() else {
                break;
            };
            let candidate = Candidate::of(stated, line, text, &rest);
            let is_better = candidate.fit > chosen.fit || !chosen.has_rows();
            if candidate.names > 1
                && candidate.fit >= Fit::Some
                && candidate.has_rows()
                && is_better
            {
                chosen = candidate;
                lines = rest;
                break;
            }
        }
    }
    if chosen.units.is_some() {
        lines.next();
    }
    let head = Head {
        line: chosen.line,
        separator: chosen.separator,
        names: names(source, chosen.line, chosen.text, chosen.separator)?,
        units: chosen.units,
        is_below_others: chosen.line != first_line,
    };
    Ok((head, lines))
}

/// What a first line such as `sep=;` says to stand between fields, if it is one.
fn stated_separator(source: &str, line: u64, text: &str) -> Result<Option<u8>> {
    let text = text.trim_end_matches('\r');
    let bare = text
        .strip_prefix('"')
        .and_then(|text| text.strip_suffix('"'));
    let text = bare.unwrap_or(text);
    let Some((key, separator)) = text.split_once('=') else {
        return Ok(None);
    };
    match (key.eq_ignore_ascii_case("sep"), separator.as_bytes()) {
        (true, &[separator @ (b',' | b';' | b'\t')]) => Ok(Some(separator)),
        // A header of one column could be called so; nobody's is.
        (true, _) => Err(Error::new(
            Kind::Unsupported,
            source,
            Place::line(line),
            quoted(text),
            "sep= with a comma, a semicolon or a tab",
        )),
        (false, _) => Ok(None),
    }
}

/// How well the line after it is a row under a line of names.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Fit {
    /// It is none.
    None,
    /// It is not there, or there is nothing in it.
    Open,
    /// It has numbers, and text.
    Some,
    /// It has nothing but numbers.
    All,
}

/// A line that may have the names.
struct Candidate<'a> {
    line: u64,
    text: &'a str,
    separator: u8,
    /// How many there are.
    names: usize,
    fit: Fit,
    /// The lines after that row have as many fields as well.
    goes_on: bool,
    units: Option<(u64, Vec<Option<Unit>>)>,
}

impl<'a> Candidate<'a> {
    /// With the separator that fits best; of several the one that stands first: a comma, a semicolon, a tab. Those within quotation
    /// marks are none.
    fn of(stated: Option<u8>, line: u64, text: &'a str, after: &Lines<'_>) -> Self {
        let separators = match stated {
            Some(stated) => vec![stated],
            None => {
                let outside = outside_of_quotation_marks(text);
                let is_there = |separator: &u8| outside.contains(separator);
                b",;\t".iter().copied().filter(is_there).collect()
            }
        };
        let with = |separator| Self::with(separator, line, text, after);
        let better = |best: Self, other: Self| {
            let rank = |candidate: &Self| (candidate.has_rows(), candidate.fit);
            if rank(&other) > rank(&best) {
                other
            } else {
                best
            }
        };
        let best = separators.into_iter().map(with).reduce(better);
        best.unwrap_or_else(|| with(b','))
    }

    fn with(separator: u8, line: u64, text: &'a str, after: &Lines<'_>) -> Self {
        let fields: Vec<_> = Fields::new(text, separator).collect();
        let names: Vec<&str> = fields.iter().flatten().map(|name| name.trim()).collect();
        let are_names = names.len() == fields.len()
            && names.iter().any(|name| !name.is_empty())
            && !names.iter().any(|name| values::is_number(name, separator));
        let mut candidate = Self {
            line,
            text,
            separator,
            names: names.iter().filter(|name| !name.is_empty()).count(),
            fit: Fit::None,
            goes_on: false,
            units: None,
        };
        if are_names {
            let mut after = after.clone();
            let next = after.next();
            candidate.fit = fit(&names, next, separator);
            if let (Fit::None | Fit::Some, Some((line, text))) = (candidate.fit, next)
                && let Some(units) = units(text, after.clone().next(), &names, separator)
            {
                candidate.fit = Fit::All;
                candidate.units = Some((line, units));
                after.next();
            }
            let mut more = after.take(ROWS - 1);
            candidate.goes_on =
                more.all(|(_, text)| Fields::new(text, separator).count() == names.len());
        }
        candidate
    }

    fn has_rows(&self) -> bool {
        self.fit != Fit::None && self.goes_on
    }

    /// Names of some columns with numbers below, if not as many: that is a broken row, and no line about the file.
    fn is_above_numbers(&self, after: &Lines<'_>) -> bool {
        let next = after.clone().next();
        self.names > 1
            && next.is_some_and(|(_, text)| {
                let fields = Fields::new(text, self.separator).flatten();
                let numbers = fields.filter(|field| values::is_number(field, self.separator));
                numbers.count() > 1
            })
    }
}

/// How well a line is a row under these names.
fn fit(names: &[&str], row: Option<(u64, &str)>, separator: u8) -> Fit {
    let Some((_, row)) = row else {
        return Fit::Open;
    };
    let Some(fields) = Fields::new(row, separator).collect::<Option<Vec<_>>>() else {
        return Fit::None;
    };
    let told = fields
        .iter()
        .zip(names)
        .filter(|(field, _)| !field.trim().is_empty());
    if fields.len() != names.len() || told.clone().any(|(_, name)| name.is_empty()) {
        return Fit::None;
    }
    let mut numbers = told
        .clone()
        .map(|(field, _)| values::is_number(field, separator));
    if numbers.clone().next().is_none() {
        Fit::Open
    } else if numbers.clone().all(|is_number| is_number) {
        Fit::All
    } else if numbers.any(|is_number| is_number) {
        Fit::Some
    } else {
        Fit::None
    }
}

/// The units that a line holds, if that is what it holds: at least one that is known, not fewer than what else is written there,
/// no numbers but the 1 of a ratio, and below those that are known nothing but numbers.
fn units(
    text: &str,
    below: Option<(u64, &str)>,
    names: &[&str],
    separator: u8,
) -> Option<Vec<Option<Unit>>> {
    let fields = Fields::new(text, separator).collect::<Option<Vec<_>>>()?;
    if fields.len() != names.len() || fit(names, below, separator) == Fit::None {
        return None;
    }
    let mut below = Fields::new(below.map_or("", |(_, text)| text), separator).flatten();
    let mut units = Vec::new();
    let (mut known, mut others) = (0, 0);
    for field in &fields {
        let below = below.next().unwrap_or_default();
        let text = unit::without_brackets(field);
        let unit = unit::known(text);
        match (unit, text) {
            (Some(_), _) if !below.trim().is_empty() && !values::is_number(&below, separator) => {
                return None;
            }
            (Some(_), _) => known += 1,
            (None, "" | "-" | "1") => {}
            (None, text) if values::is_number(text, separator) => return None,
            (None, _) => others += 1,
        }
        units.push(unit);
    }
    (known > 0 && known >= others).then_some(units)
}

fn outside_of_quotation_marks(line: &str) -> Vec<u8> {
    let mut is_quoted = false;
    let outside = |byte: &u8| {
        is_quoted ^= *byte == b'"';
        !is_quoted
    };
    line.bytes().filter(outside).collect()
}

fn names(source: &str, line: u64, header: &str, separator: u8) -> Result<Vec<String>> {
    let mut names: Vec<String> = Vec::new();
    let mut known = HashSet::new();
    for (column, field) in Fields::new(header, separator).enumerate() {
        let place = place_of_name(line, column);
        let Some(field) = field else {
            return Err(super::unclosed(source, place));
        };
        let name = field.trim();
        if name.parse::<f64>().is_ok() {
            return Err(Error::new(
                Kind::HeaderMissing,
                source,
                place,
                quoted(name),
                "a header line with a name for each column",
            ));
        }
        if !name.is_empty() && !known.insert(name.to_owned()) {
            return Err(Error::new(
                Kind::ColumnName,
                source,
                place,
                format!("{} again", quoted(name)),
                "each name once",
            ));
        }
        names.push(name.to_owned());
    }
    Ok(names)
}

/// Where a column's name (from 0) stands.
pub(super) fn place_of_name(line: u64, column: usize) -> Place {
    Place {
        line: Some(line),
        column: Some(column + 1),
        ..Place::default()
    }
}
