//! Times as clocks and calendars show them.

use jiff::{Timestamp, civil, tz::TimeZone};

use crate::error::Kind;

/// What is said of a time that is written in another way.
pub(super) const HINT: &str =
    "; times are numbers, in s, or like 08:00:00.5, 2026-03-29 08:00:00.5 or 29.03.2026 08:00:00.5";

const DAY_S: f64 = 86_400.0;

/// What a column of times counts from.
#[derive(Clone, Copy, Debug)]
pub(super) enum Moments {
    /// A clock's midnight, or the start of a test.
    Clock {
        /// The last time, in s.
        last_s: f64,
        /// Midnights since the first.
        days: f64,
    },
    /// The column's first.
    Date(Timestamp),
}

/// The column's first time in s, if that is what the field is.
pub(super) fn begin(field: &str) -> Option<(Moments, f64)> {
    let field = field.trim_ascii();
    if let Some(seconds) = clock_s(field) {
        let (last_s, days) = (seconds, 0.0);
        return Some((Moments::Clock { last_s, days }, seconds));
    }
    Some((Moments::Date(date(field)?), 0.0))
}

impl Moments {
    /// The next field's time in s, NaN for an empty one; what is wrong with it, and what was expected.
    pub(super) fn value(&mut self, field: &str) -> Result<f64, (Kind, String)> {
        let field = field.trim_ascii();
        if field.is_empty() {
            return Ok(f64::NAN);
        }
        let read = match self {
            Self::Clock { last_s, days } => clock_s(field).map(|seconds| {
                // Back by most of a day: it is the next one.
                if *last_s < DAY_S && seconds < *last_s - DAY_S / 2.0 {
                    *days += 1.0;
                }
                *last_s = seconds;
                *days * DAY_S + seconds
            }),
            Self::Date(first) => date(field).map(|date| date.duration_since(*first).as_secs_f64()),
        };
        let like = match self {
            Self::Clock { .. } => "08:00:00.5",
            Self::Date(_) => "2026-03-29 08:00:00.5",
        };
        read.ok_or_else(|| {
            let expected = format!("a time like the column's first, {like}, or an empty field");
            (Kind::NotANumber, expected)
        })
    }
}

/// Hours, minutes and seconds, `8:00:00.5`; hours of a test go on after 24.
fn clock_s(field: &str) -> Option<f64> {
    let (hours, rest) = field.split_once(':')?;
    let (minutes, seconds) = rest.split_once(':')?;
    let is_whole = |text: &str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    let (whole, fraction) = match seconds.split_once(['.', ',']) {
        Some((whole, fraction)) => (whole, fraction),
        None => (seconds, "0"),
    };
    let below_60 = |text: &str| is_whole(text) && text.len() == 2 && text < "60";
    if !is_whole(hours)
        || hours.len() > 6
        || !below_60(minutes)
        || !below_60(whole)
        || !is_whole(fraction)
    {
        return None;
    }
    let whole_s = 3600.0 * hours.parse::<f64>().ok()? + 60.0 * minutes.parse::<f64>().ok()?;
    Some(whole_s + format!("{whole}.{fraction}").parse::<f64>().ok()?)
}

/// Year, month and day, or with points day, month and year, and a time of that day. Without an offset from UTC it is taken as UTC:
/// only differences count. What has slashes has two meanings and is none.
fn date(field: &str) -> Option<Timestamp> {
    if !field.starts_with(|first: char| first.is_ascii_digit()) || !field.contains(':') {
        return None;
    }
    if let Ok(moment) = field.parse::<Timestamp>() {
        return Some(moment);
    }
    let plain = field.replace(',', ".");
    let civil = plain
        .parse::<civil::DateTime>()
        .or_else(|_| civil::DateTime::strptime("%d.%m.%Y %H:%M:%S%.f", &plain));
    TimeZone::UTC.to_timestamp(civil.ok()?).ok()
}

/// Whether a field is meant as a time: `08:00`, `03/29/2026 08:00`, `29.03.2026`.
pub(super) fn are_meant(field: &str) -> bool {
    let field = field.trim_ascii();
    if !field.starts_with(|first: char| first.is_ascii_digit()) {
        return false;
    }
    // An hour or a minute, and the two digits of what follows it.
    let is_clock = field
        .as_bytes()
        .windows(4)
        .any(|part| matches!(part, [b'0'..=b'9', b':', b'0'..=b'5', b'0'..=b'9']));
    // Three groups of digits, one of them a year: those of a number in thousands have three digits.
    let is_date = ['-', '/', '.'].iter().any(|mark| {
        let groups: Vec<&str> = field.split(*mark).collect();
        let is_digits = |group: &&str| group.bytes().all(|byte| byte.is_ascii_digit());
        let years = groups.iter().filter(|group| group.len() == 4).count();
        let others = groups.iter().filter(|group| (1..=2).contains(&group.len()));
        groups.len() == 3 && groups.iter().all(is_digits) && years == 1 && others.count() == 2
    });
    is_clock || is_date
}
