//! Units as databases and measurement files write them, turned into those that a column's name ends in.

use std::fmt;

use crate::name;

/// How a number in a foreign unit becomes one in ours. Dividing and multiplying are kept apart: 4123 mV / 1000 is the
/// number nearest to 4.123 V, 4123 · 0.001 is not.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Scale {
    /// The number times this.
    Times(f64),
    /// The number divided by this.
    Over(f64),
}

impl Scale {
    /// A factor and a unit in one step, as a division where the factor is one over a whole number: raw 1234 with 0.001
    /// is then the number nearest to 1.234.
    pub fn of(factor: f64, unit: Option<Unit>) -> Self {
        let unit = unit.map_or(Self::Times(1.0), |unit| unit.scale);
        let inverse = (1.0 / factor).round();
        let is_inverse = factor.abs() < 1.0 && inverse.is_finite() && 1.0 / inverse == factor;
        match (is_inverse, unit) {
            (true, Self::Over(divisor)) => Self::Over(inverse * divisor),
            (true, Self::Times(1.0)) => Self::Over(inverse),
            (false, Self::Over(divisor)) if factor == 1.0 => Self::Over(divisor),
            (_, Self::Over(divisor)) => Self::Times(factor / divisor),
            (_, Self::Times(times)) => Self::Times(factor * times),
        }
    }

    /// Applied to a number.
    pub fn apply(self, number: f64) -> f64 {
        match self {
            Self::Times(factor) => number * factor,
            Self::Over(divisor) => number / divisor,
        }
    }
}

impl fmt::Display for Scale {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Times(factor) => write!(f, "· {factor}"),
            Self::Over(divisor) => write!(f, "/ {divisor}"),
        }
    }
}

/// A unit that columns are given in.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Unit {
    /// What a column's name ends in.
    pub ending: &'static str,
    /// Its symbol.
    pub symbol: &'static str,
    /// From the unit as it was written.
    pub scale: Scale,
}

/// The numbers as they are.
pub(crate) const ONE: Scale = Scale::Times(1.0);
const KILO: Scale = Scale::Times(1e3);
const MILLI: Scale = Scale::Over(1e3);
const MICRO: Scale = Scale::Over(1e6);

/// Our unit for one that is written as `text`; `None` if it is not known, or means two things ("C" is both coulomb and
/// a way to write °C).
pub fn known(text: &str) -> Option<Unit> {
    let (ending, symbol, scale) = match text.trim() {
        "A" => ("_a", "A", ONE),
        "mA" => ("_a", "A", MILLI),
        "uA" | "µA" | "μA" => ("_a", "A", MICRO),
        "kA" => ("_a", "A", KILO),
        "V" => ("_v", "V", ONE),
        "mV" => ("_v", "V", MILLI),
        "uV" | "µV" | "μV" => ("_v", "V", MICRO),
        "kV" => ("_v", "V", KILO),
        "W" => ("_w", "W", ONE),
        "mW" => ("_w", "W", MILLI),
        "kW" => ("_w", "W", KILO),
        "As" | "A s" | "A*s" | "A·s" => ("_as", "A·s", ONE),
        "mAs" => ("_as", "A·s", MILLI),
        "Ah" | "A h" | "A*h" | "A·h" => ("_ah", "Ah", ONE),
        "mAh" => ("_ah", "Ah", MILLI),
        "Wh" => ("_wh", "Wh", ONE),
        "kWh" => ("_wh", "Wh", KILO),
        "J" => ("_j", "J", ONE),
        "kJ" => ("_j", "J", KILO),
        "°C" | "degC" | "deg C" | "℃" | "Celsius" | "celsius" => ("_c", "°C", ONE),
        "K" => ("_k", "K", ONE),
        "%" | "pct" | "percent" => ("_pct", "%", ONE),
        "s" | "sec" => ("_s", "s", ONE),
        "ms" => ("_s", "s", MILLI),
        "us" | "µs" | "μs" => ("_s", "s", MICRO),
        "min" => ("_s", "s", Scale::Times(60.0)),
        "h" => ("_s", "s", Scale::Times(3600.0)),
        "Hz" => ("_hz", "Hz", ONE),
        "kHz" => ("_hz", "Hz", KILO),
        "Ohm" | "ohm" | "Ω" => ("_ohm", "Ω", ONE),
        "mOhm" | "mohm" | "mΩ" => ("_ohm", "Ω", MILLI),
        _ => return None,
    };
    Some(Unit {
        ending,
        symbol,
        scale,
    })
}

/// A unit as a line of units has it, without the brackets around it: `[mA]`, `(mA)`.
pub(crate) fn without_brackets(text: &str) -> &str {
    let text = text.trim();
    [('[', ']'), ('(', ')')]
        .into_iter()
        .find_map(|(open, close)| text.strip_prefix(open)?.strip_suffix(close))
        .unwrap_or(text)
        .trim()
}

/// The unit that a name states after it: `Current [mA]`, `Current (mA)`, `I / mA`.
pub(crate) fn stated(name: &str) -> Option<Unit> {
    let name = name.trim_end();
    let start = match name.chars().next_back()? {
        ']' => name.rfind('[')?,
        ')' => name.rfind('(')?,
        _ => name.rfind('/')?,
    };
    let text = &name[start..];
    known(
        text.strip_prefix('/')
            .unwrap_or_else(|| without_brackets(text)),
    )
}

/// A signal's column name: its own if it ends in the unit already, else with the unit's ending.
pub(crate) fn column_name(signal: &str, unit: Option<Unit>) -> String {
    match unit {
        Some(unit) if !name::unit(signal).is_some_and(|symbol| same(symbol, unit.symbol)) => {
            format!("{signal}{}", unit.ending)
        }
        _ => signal.to_owned(),
    }
}

/// The same unit, perhaps under two symbols.
pub(crate) fn same(one: &str, other: &str) -> bool {
    let plain = |symbol| if symbol == "A·s" { "C" } else { symbol };
    plain(one) == plain(other)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

    use super::*;

    #[test]
    fn scales_to_the_nearest_number() {
        assert_eq!(known("mV").unwrap().scale.apply(4123.0), 4.123);
        assert_eq!(known("kW").unwrap().scale.apply(1.5), 1500.0);
        assert_eq!(known("min").unwrap().scale.apply(1.5), 90.0);
        assert_eq!(known("C"), None);
    }

    #[test]
    fn endings_are_those_of_column_names() {
        for text in [
            "mA", "mV", "W", "As", "Ah", "Wh", "J", "degC", "K", "%", "ms", "Hz", "Ohm",
        ] {
            let unit = known(text).unwrap();
            assert_eq!(
                name::unit(&format!("x{}", unit.ending)),
                Some(unit.symbol),
                "{text}"
            );
        }
    }

    #[test]
    fn a_name_may_state_its_unit() {
        for name in [
            "I [mA]",
            "I(mA)",
            "I / mA",
            "I/mA ",
            "a [b] [ mA ]",
            "Zelle (3) (mA)",
        ] {
            assert_eq!(stated(name), known("mA"), "{name}");
        }
        for name in ["I", "I [rpm]", "mA]", "I mA", "", "I_mA", "[mA] I"] {
            assert_eq!(stated(name), None, "{name}");
        }
    }

    #[test]
    fn names_end_in_their_unit_once() {
        assert_eq!(column_name("Bms.Current", known("mA")), "Bms.Current_a");
        assert_eq!(column_name("i_meas_a", known("mA")), "i_meas_a");
        assert_eq!(column_name("q_meas_c", known("As")), "q_meas_c");
        assert_eq!(column_name("counts", None), "counts");
    }
}
