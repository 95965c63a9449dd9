//! What the board can correct of what was found, as values for its registers.
//!
//! The board works out `I = (1 + gain)·reading − zero drift`, for each of its sensors, and its meter takes a gain and an
//! offset the same way. A sensor that reads `y = s·i + z` is corrected by `gain = 1/s − 1` and `zero drift = z/s`.

use core_logic::configuration::{FIELD_TEXTS, FIELDS};

use crate::{
    effects::find_with,
    model::{FrontEndKind, Model},
    report::data::Report,
};

/// Signals and the registers that correct them: gain and zero.
const CORRECTIONS: [(&str, &str, &str); 2] = [
    ("i_meas_a", "current gain", "zero drift"),
    ("q_meas_c", "meter: gain", "meter: offset"),
];

/// A straight line `y = slope·i + zero`.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Line {
    slope: f64,
    zero_a: f64,
}

impl Line {
    const IDEAL: Self = Self {
        slope: 1.0,
        zero_a: 0.0,
    };

    fn then(self, slope: f64, zero_a: f64) -> Self {
        Self {
            slope: self.slope * slope,
            zero_a: self.zero_a * slope + zero_a,
        }
    }
}

/// The file's text; `None` where there is nothing for the board to correct.
pub(super) fn render(model: &Model, report: &Report) -> Option<String> {
    let sensor = model.sensor.as_ref()?;
    if sensor.front_end == FrontEndKind::Pair {
        return None;
    }
    let mut text = String::new();
    let mut left = Vec::new();
    for fitted in &report.models {
        let Some((_, gain, zero)) = CORRECTIONS
            .iter()
            .find(|(signal, _, _)| *signal == fitted.signal)
        else {
            continue;
        };
        let (mut small, mut large) = (Line::IDEAL, Line::IDEAL);
        // What the model file had already is in the board's reading as well.
        let had = model.effects.iter().filter_map(|(id, values)| {
            let card = find_with(id, values.len())?.card();
            let names = card
                .parameters
                .iter()
                .map(|parameter| parameter.name.to_owned());
            Some((
                (*id).to_owned(),
                names.zip(values.iter().copied()).collect::<Vec<_>>(),
            ))
        });
        let named = fitted.effects.iter().filter(|(id, _)| {
            report
                .effects
                .iter()
                .any(|effect| effect.id == *id && effect.signal == fitted.signal)
        });
        for (id, parameters) in had.chain(named.cloned()) {
            let value = |name: &str| {
                parameters
                    .iter()
                    .find(|(known, _)| known == name)
                    .map_or(f64::NAN, |(_, value)| *value)
            };
            match id.as_str() {
                "offset" => {
                    small = small.then(1.0, value("offset_a"));
                    large = large.then(1.0, value("offset_a"));
                }
                "gain" => {
                    small = small.then(value("gain"), 0.0);
                    large = large.then(value("gain"), 0.0);
                }
                "range-mismatch" => large = large.then(value("gain_ratio"), value("offset_a")),
                _ => left.push(id),
            }
        }
        if (small, large) == (Line::IDEAL, Line::IDEAL) {
            continue;
        }
        let ppm = |line: Line| (1.0 / line.slope - 1.0) * 1e6;
        let drift = |line: Line| line.zero_a / line.slope * 1e6;
        text.push_str(&format!("\n# Corrects {}.\n", fitted.signal));
        text.push_str(&register(gain, [ppm(small), ppm(large)])?);
        text.push_str(&register(zero, [drift(small), drift(large)])?);
    }
    if text.is_empty() {
        return None;
    }
    left.sort();
    left.dedup();
    let mut head = format!(
        "# Registers that correct what was found in {} (docs/modbus.md), for a board on which they are at their\n\
         # factory's values. Written at standstill.\n",
        report.inputs.recording
    );
    if !left.is_empty() {
        head.push_str(&format!(
            "# Not to be corrected by them: {}.\n",
            left.join(", ")
        ));
    }
    Some(head + &text)
}

/// One register with the values for the small and the large sensor.
fn register(name: &str, values: [f64; 2]) -> Option<String> {
    let (field, said) = FIELDS
        .iter()
        .zip(FIELD_TEXTS)
        .find(|(_, text)| text.name == name)?;
    let values = values.map(|value| value.round() as i64);
    let mut text = format!(
        "[[register]]\nname = \"{name}\"\naddress = 0x{:04X}\nunit = \"{}\"\nsmall = {}\nlarge = {}\n",
        field.layout.address, said.unit, values[0], values[1]
    );
    if values
        .iter()
        .any(|value| !(field.min..=field.max).contains(value))
    {
        text.push_str(&format!(
            "# Beyond the board's limits, {} … {}.\n",
            field.min, field.max
        ));
    }
    Some(text + "\n")
}
