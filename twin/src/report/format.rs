//! Numbers, places and verdicts in words, the same on the page and on the terminal.

use super::data::{Known, Location, LocationKind, ParameterReport, Report, Verdict};

/// What stands for a number that there is none of.
pub const NONE: &str = "–";

/// `value` with `digits` significant digits; scientific below 10⁻⁴ and from 10⁶ on.
pub fn significant(value: f64, digits: usize) -> String {
    if !value.is_finite() {
        return NONE.to_owned();
    }
    if value == 0.0 {
        return "0".to_owned();
    }
    let digits = digits.max(1);
    let scientific = format!("{value:.*e}", digits - 1);
    let exponent = exponent_of(&scientific);
    if !(-4..6).contains(&exponent) {
        return minus(scientific);
    }
    let decimals = (digits as i32 - 1 - exponent).max(0) as usize;
    minus(format!("{value:.decimals$}"))
}

/// `value` with at most `digits` significant digits: a limit of 3 is not 3.000.
pub fn at_most(value: f64, digits: usize) -> String {
    let number = significant(value, digits);
    let (mantissa, exponent) = number
        .split_once('e')
        .map_or((number.as_str(), None), |(m, e)| (m, Some(e)));
    let mantissa = if mantissa.contains('.') {
        mantissa.trim_end_matches('0').trim_end_matches('.')
    } else {
        mantissa
    };
    exponent.map_or_else(
        || mantissa.to_owned(),
        |exponent| format!("{mantissa}e{exponent}"),
    )
}

/// A value and the ends of its interval, all to the place that half the interval resolves: with two digits if it
/// begins with 1 to 4, else with one.
pub fn with_interval(value: f64, interval: [f64; 2]) -> [String; 3] {
    let [low, high] = interval;
    let half = (high - low) / 2.0;
    if !(value.is_finite() && half.is_finite() && half > 0.0) {
        return [value, low, high].map(|number| significant(number, 4));
    }
    let size = value.abs().max(low.abs()).max(high.abs());
    let half = format!("{half:.1e}");
    let place = exponent_of(&half) - i32::from(half.starts_with(['1', '2', '3', '4']));
    let exponent = exponent_of(&format!("{size:.1e}"));
    let least = [value, low, high]
        .map(f64::abs)
        .into_iter()
        .filter(|number| *number > 0.0)
        .fold(f64::INFINITY, f64::min);
    // Over more than four decades the place of the largest is none for the smallest.
    if size > 1e4 * least {
        return [value, low, high].map(|number| significant(number, 2));
    }
    if !(-4..6).contains(&exponent) {
        let digits = (exponent - place).max(0) as usize;
        // One exponent for the three: they are read against each other.
        let scale = 10f64.powi(exponent);
        return [value, low, high]
            .map(|number| minus(format!("{:.digits$}e{exponent}", number / scale)));
    }
    let decimals = (-place).max(0) as usize;
    [value, low, high].map(|number| minus(format!("{number:.decimals$}")))
}

/// A parameter's value with its unit, and the ends of its interval: where the search stood is no value that was found, and beside
/// "or more" there is no interval.
pub fn found(parameter: &ParameterReport) -> (String, Option<[String; 2]>) {
    let [value, low, high] = with_interval(parameter.value, parameter.ci95);
    match parameter.known {
        Known::Value => (quantity(&value, &parameter.unit), Some([low, high])),
        Known::Nothing => ("not told".to_owned(), Some([low, high])),
        Known::AtLeast => {
            let least = quantity(&significant(parameter.value, 3), &parameter.unit);
            (format!("{least} or more"), None)
        }
    }
}

/// `number unit`; a number without unit stays bare.
pub fn quantity(number: &str, unit: &str) -> String {
    if unit.is_empty() || unit == "1" || number == NONE {
        number.to_owned()
    } else {
        format!("{number} {unit}")
    }
}

/// A share, 0 … 1, in per cent.
pub fn percent(share: f64) -> String {
    if !share.is_finite() {
        return NONE.to_owned();
    }
    let percent = 100.0 * share;
    let size = percent.abs();
    if size == 0.0 || size >= 9.95 {
        minus(format!("{percent:.0} %"))
    } else if size >= 0.095 {
        minus(format!("{percent:.1} %"))
    } else {
        minus(format!("{percent:.2} %"))
    }
}

/// A share in per cent to a thousandth, for reasons that are a matter of those.
pub fn precise_percent(share: f64) -> String {
    // What is next to nothing is no measure.
    if share.abs() < 1e4 {
        format!("{:.3} %", 100.0 * share).replace(".000 %", " %")
    } else {
        "more than any".into()
    }
}

/// The change from `before` to `after`, in per cent of `before`; empty where there is no such thing.
pub fn change(before: f64, after: f64) -> String {
    if !(before.is_finite() && after.is_finite() && before > 0.0) {
        return String::new();
    }
    let change = after / before - 1.0;
    let sign = if change > 0.0 { "+" } else { "" };
    // 99.96 % less is not "100 % less".
    if change < -0.995 && after > 0.0 {
        return minus(format!("{:.1} %", (100.0 * change).max(-99.9)));
    }
    format!(
        "{sign}{}",
        percent(if change.abs() < 0.0005 { 0.0 } else { change })
    )
}

/// A p-value: `< 0.001`, `0.012`.
pub fn p_value(p: f64) -> String {
    if p < 0.001 {
        "< 0.001".to_owned()
    } else {
        significant(p, 2)
    }
}

/// The ends of a stretch, with four digits; to a hundredth of it where four are coarser: of times since 1970 they are all the same.
pub(crate) fn ends(from: f64, to: f64) -> [String; 2] {
    let power_of_ten = |value: f64| value.log10().floor() as i32;
    let (stretch, size) = (to - from, from.abs().max(to.abs()));
    if !(stretch > 0.0 && 10f64.powi(power_of_ten(size) - 3) > 0.01 * stretch) {
        return [from, to].map(|end| at_most(end, 4));
    }
    let decimals = (2 - power_of_ten(stretch)).max(0) as usize;
    [from, to].map(|end| minus(format!("{end:.decimals$}")))
}

/// Where a location is: `abs(i) > 48 A`.
pub fn place(location: &Location) -> String {
    let variable = match (location.kind, location.variable.as_str()) {
        (LocationKind::Time, "t_s" | "") => "time",
        (LocationKind::Frequency, "frequency_hz" | "") => "frequency",
        (_, variable) => variable,
    };
    let end = |value: f64| quantity(&at_most(value, 4), &location.unit);
    let from = location.from.filter(|value| value.is_finite());
    let to = location.to.filter(|value| value.is_finite());
    // Of a flag an open end leaves one value.
    let flag = variable == "range_high" && location.unit == "1";
    match (from, to) {
        (Some(1.0), None) if flag => format!("{variable} = 1"),
        (None, Some(0.0)) if flag => format!("{variable} = 0"),
        (Some(from), Some(to)) if from == to => format!("{variable} = {}", end(from)),
        (Some(from), Some(to)) => {
            let [from, to] = ends(from, to);
            format!("{variable} {from} … {}", quantity(&to, &location.unit))
        }
        (Some(from), None) => format!("{variable} > {}", end(from)),
        // A size is never below 0.
        (None, Some(to)) if to <= 0.0 && variable.starts_with("abs(") => {
            format!("{variable} = {}", end(0.0))
        }
        (None, Some(to)) => format!("{variable} < {}", end(to)),
        (None, None) => format!("{variable}: everywhere"),
    }
}

/// The verdict in a few words.
pub fn verdict(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::NoMismatch => "No mismatch",
        Verdict::Explained => "Explained",
        Verdict::PartlyExplained => "Partly explained",
        Verdict::Ambiguous => "Ambiguous",
        Verdict::Unknown => "Unknown",
    }
}

/// What the verdict means.
pub fn meaning(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::NoMismatch => "Recording and simulation agree within noise and accuracy.",
        Verdict::Explained => "The effects named below account for the mismatch.",
        Verdict::PartlyExplained => {
            "The effects named below account for a part of the mismatch; structure is left."
        }
        Verdict::Ambiguous => {
            "Several models account for the mismatch equally well on this recording."
        }
        Verdict::Unknown => "There is a mismatch, and no model of the library accounts for it.",
    }
}

/// Unit of a signal of the report; empty if the report does not know the signal.
pub fn unit_of<'a>(report: &'a Report, signal: &str) -> &'a str {
    report
        .signals
        .iter()
        .find(|known| known.name == signal)
        .map_or("", |known| &known.unit)
}

/// `1 sample`, `36,000 samples`.
pub fn count(number: usize, what: &str) -> String {
    let plural = if number == 1 { "" } else { "s" };
    format!("{} {what}{plural}", grouped(number))
}

/// A whole number with its thousands set apart.
pub fn grouped(number: usize) -> String {
    let digits = number.to_string();
    let mut text = String::with_capacity(digits.len() + digits.len() / 3);
    for (place, digit) in digits.chars().enumerate() {
        if place > 0 && (digits.len() - place).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

/// The exponent of a number in Rust's `e` notation.
fn exponent_of(scientific: &str) -> i32 {
    scientific
        .split_once('e')
        .and_then(|(_, exponent)| exponent.parse().ok())
        .unwrap_or(0)
}

/// A hyphen in front of a number is a minus; `-0` is 0.
fn minus(number: String) -> String {
    match number.strip_prefix('-') {
        Some(rest) if rest.chars().all(|c| !('1'..='9').contains(&c)) => rest.to_owned(),
        Some(rest) => format!("−{rest}"),
        None => number,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_keep_their_significant_digits() {
        for (value, text) in [
            (0.0, "0"),
            (0.512_34, "0.512"),
            (9.996, "10.0"),
            (123_456.0, "123456"),
            (-0.000_123_4, "−0.000123"),
            (1.5e-7, "1.50e-7"),
            (2.5e9, "2.50e9"),
            (f64::NAN, NONE),
            (f64::INFINITY, NONE),
        ] {
            assert_eq!(significant(value, 3), text);
        }
    }

    #[test]
    fn an_interval_decides_the_digits() {
        assert_eq!(
            with_interval(0.501_9, [0.497_1, 0.507_2]),
            ["0.502", "0.497", "0.507"]
        );
        assert_eq!(
            with_interval(0.484_8, [0.472_8, 0.498]),
            ["0.485", "0.473", "0.498"]
        );
        assert_eq!(
            with_interval(1_203.7, [1_100.2, 1_310.9]),
            ["1204", "1100", "1311"]
        );
        assert_eq!(
            with_interval(-0.004, [-0.013, 0.005]),
            ["−0.004", "−0.013", "0.005"]
        );
        assert_eq!(
            with_interval(3.21e-7, [3.0e-7, 3.4e-7]),
            ["3.21e-7", "3.00e-7", "3.40e-7"]
        );
        assert_eq!(
            with_interval(2.0, [f64::NEG_INFINITY, 5.0]),
            ["2.000", NONE, "5.000"]
        );
    }

    #[test]
    fn a_stretch_of_times_since_1970_can_be_found() {
        let at = |from: f64, to: f64| {
            place(&Location {
                signal: "i_meas_a".to_owned(),
                kind: LocationKind::Time,
                variable: "t_s".to_owned(),
                unit: "s".to_owned(),
                from: Some(from),
                to: Some(to),
                energy_share: 1.0,
                sample_share: 0.5,
                p_value: 0.01,
                effect: None,
            })
        };
        assert_eq!(
            at(1_717_430_477.7, 1_717_430_512.3),
            "time 1717430477.7 … 1717430512.3 s"
        );
        assert_eq!(at(1_200.0, 1_300.0), "time 1200 … 1300 s");
        assert_eq!(at(12.345_67, 80.0), "time 12.35 … 80 s");
    }

    #[test]
    fn a_flag_is_one_of_its_values() {
        let mut location = Location {
            signal: "i_meas_a".to_owned(),
            kind: LocationKind::Region,
            variable: "range_high".to_owned(),
            unit: "1".to_owned(),
            from: Some(1.0),
            to: None,
            energy_share: 1.0,
            sample_share: 0.5,
            p_value: 0.01,
            effect: None,
        };
        assert_eq!(place(&location), "range_high = 1");
        (location.from, location.to) = (None, Some(0.0));
        assert_eq!(place(&location), "range_high = 0");
        location.variable = "x".to_owned();
        assert_eq!(place(&location), "x < 0");
    }

    #[test]
    fn shares_changes_and_p_values() {
        assert_eq!(percent(0.81), "81 %");
        assert_eq!(percent(0.064), "6.4 %");
        assert_eq!(percent(0.0), "0 %");
        assert_eq!(change(0.5, 0.1), "−80 %");
        assert_eq!(change(0.5, 0.55), "+10 %");
        assert_eq!(change(1.0, 0.000_1), "−99.9 %");
        assert_eq!(change(0.0, 0.1), "");
        assert_eq!(p_value(0.000_2), "< 0.001");
        assert_eq!(p_value(0.012), "0.012");
        assert_eq!(grouped(36_000), "36,000");
        assert_eq!(grouped(999), "999");
        assert_eq!(at_most(3.0, 4), "3");
        assert_eq!(at_most(53.33, 4), "53.33");
        assert_eq!(at_most(1_200.0, 2), "1200");
        assert_eq!(at_most(2e-7, 3), "2e-7");
    }
}
