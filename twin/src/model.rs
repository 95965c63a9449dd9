//! The model file: what the simulation knows as designed.
//!
//! `docs/model-file.md` describes it for its users.

mod extended;
mod place;
pub mod registry;

use std::{
    collections::BTreeMap,
    fmt, fs,
    path::{Path, PathBuf},
};

use recording::{csv, error::number, name};
use serde::{
    Deserialize, Deserializer,
    de::{self, IntoDeserializer, Visitor},
};

pub use extended::{Found, Shift};
use place::Places;

use crate::{
    effects::{self, Parameter, scene::ZERO_CELSIUS_K},
    failure::Failure,
    problem::Holds,
};

/// Version of the format.
pub const SCHEMA: u32 = 1;
/// A cell may begin fuller than the full charge that the table's 1 stands for, or emptier than its 0: by at most this.
pub const BEYOND_SOC: f64 = 0.1;

/// What stands between the reference and the reading.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FrontEndKind {
    /// Any sensor beside a reference: it should read what the reference reads.
    #[default]
    Pair,
    /// The board with its pair of Hall sensors (D0).
    DualRange,
    /// The board with one HAH1BV (D2).
    Hah1bv,
    /// The board with a bipolar sensor behind the open-sensor network (D3).
    Network,
    /// The board with a closed-loop sensor (D4).
    ClosedLoop,
}

/// `true` for [`Holds::UntilNextRow`], `false` for none, or the word.
fn held<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<Holds>, D::Error> {
    struct Held;
    impl Visitor<'_> for Held {
        type Value = Option<Holds>;

        fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            let [since, until] = Holds::ALL.map(Holds::as_str);
            write!(f, "true, false, \"{since}\" or \"{until}\"")
        }

        fn visit_bool<E>(self, held: bool) -> Result<Self::Value, E> {
            Ok(held.then_some(Holds::UntilNextRow))
        }

        fn visit_str<E: de::Error>(self, word: &str) -> Result<Self::Value, E> {
            let holds = Holds::ALL.into_iter().find(|holds| holds.as_str() == word);
            let unknown = || E::invalid_value(de::Unexpected::Str(word), &self);
            holds.map(Some).ok_or_else(unknown)
        }
    }
    deserializer.deserialize_any(Held)
}

/// A word of a fixed list. What is no text is named as what it is; of an enumeration alone serde asks for a "string or table".
fn word<'de, D: Deserializer<'de>, T: Deserialize<'de>>(deserializer: D) -> Result<T, D::Error> {
    T::deserialize(String::deserialize(deserializer)?.into_deserializer())
}

fn some_word<'de, D, T>(deserializer: D) -> Result<Option<T>, D::Error>
where
    D: Deserializer<'de>,
    T: Deserialize<'de>,
{
    word(deserializer).map(Some)
}

/// Accuracy of an instrument: `zero + gain·abs(reading)`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AccuracySpec {
    /// Constant part, in the signal's unit.
    #[serde(default)]
    pub zero: f64,
    /// Share of the reading.
    #[serde(default)]
    pub gain: f64,
}

/// `[sensor]`: the sensor under test. Numbers without a unit in their name are in the unit of the measured column.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Sensor {
    /// What stands between reference and reading.
    #[serde(deserialize_with = "word")]
    pub front_end: FrontEndKind,
    /// Column of the reference; `i_ref_a` or `p_ref_w` if not stated.
    pub reference: Option<String>,
    /// Column of the sensor; `i_meas_a` or `p_meas_w` if not stated.
    pub measured: Option<String>,
    /// Step between two codes; 0: continuous. A board's follows from its converter.
    pub step: f64,
    /// Time between two new readings, in s; 0: each row is one. A board's follows from its converter.
    pub interval_s: f64,
    /// Time over which a reading averages, in s; 0: none. A board's is its conversion.
    pub window_s: f64,
    /// Readings in the board's sliding average; 1: none.
    pub average: Option<u8>,
    /// White noise of one reading, rms.
    pub noise: f64,
    /// Coloured noise of one reading, rms.
    pub noise_coloured: f64,
    /// Its time constant, in s.
    pub noise_coloured_tau_s: f64,
    /// Full scale. A board's follows from its front end.
    pub full_scale: Option<f64>,
    /// Where the small range ends. A board's follows from its front end.
    pub range_limit: Option<f64>,
    /// Accuracy of the reference instrument.
    pub accuracy: AccuracySpec,
    /// The reference stays at one value between its rows, and which.
    #[serde(deserialize_with = "held")]
    pub held_reference: Option<Holds>,
    /// The reference goes from row to row in a smooth course.
    pub smooth_reference: bool,
    /// Time means nothing: the order of the rows counts, not when they were measured.
    pub quasi_static: bool,
    /// Of a board: time from the end of a conversion to the earliest row that can tell of it, in s.
    pub age_s: f64,
    /// Of a board: width of the time within which that moment is uncertain, in s.
    pub jitter_s: f64,
    /// Time by which readings stand for an earlier moment than their row, in s; `twin explain` finds it with an effect.
    pub alignment_s: f64,
}

impl Sensor {
    /// Whether the reference stays at its value until its next row.
    pub fn is_held(&self) -> bool {
        self.held_reference == Some(Holds::UntilNextRow)
    }
}

/// `[charge]`: the sensor's charge counter.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Charge {
    /// Its column; `q_meas_c` if not stated.
    pub column: Option<String>,
    /// Charge of one count, in C. A board's follows from its meter.
    pub step_c: f64,
    /// Time over which two readings of the counter are compared, in s.
    pub interval_s: Option<f64>,
    /// Noise of one reading of the counter, rms, in C.
    pub noise_c: f64,
    /// Time from the counter's reading to the row that tells of it, in s.
    pub age_s: f64,
    /// Width of the time within which that moment is uncertain, in s.
    pub jitter_s: f64,
}

/// `[battery]`, resolved: the table is read.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Battery {
    /// Capacity in Ah.
    pub capacity_ah: f64,
    /// Share of what is charged that can be discharged again.
    pub efficiency: f64,
    /// Ohmic resistance of one cell at 25 °C, in Ω.
    pub resistance_ohm: f64,
    /// Its relative standard uncertainty.
    pub resistance_uncertainty: f64,
    /// Lowest and highest temperature, in °C, at which the resistances are known; `twin explain` writes it.
    pub resistances_at_c: Option<[f64; 2]>,
    /// Time by which voltages were read before the current of their row, in s; `twin explain` finds it.
    pub alignment_s: f64,
    /// Open-circuit voltage of one cell: state of charge (ascending) and V; empty if not stated.
    pub ocv: Vec<(f64, f64)>,
    /// The file that it is from, if it is from one.
    pub ocv_file: Option<PathBuf>,
    /// State of charge at the start, 0 … 1 or at most [`BEYOND_SOC`] beyond, if known.
    pub initial_soc: Option<f64>,
    /// Its standard uncertainty.
    pub initial_soc_uncertainty: f64,
    /// Cells in series behind `v_pack_v`.
    pub cells: u32,
    /// Column of the current; `i_ref_a`, else `i_meas_a` if not stated.
    pub current: Option<String>,
    /// How it goes from row to row, if not in straight lines; `twin explain` finds it.
    pub current_holds: Option<Holds>,
    /// What that column reads without a current, in A.
    pub current_zero_a: f64,
    /// Its standard uncertainty.
    pub current_zero_uncertainty_a: f64,
    /// White noise of a voltage reading, rms, in V, of one cell or the pack as recorded.
    pub noise_v: f64,
    /// Coloured noise of a voltage reading, rms, in V.
    pub noise_coloured_v: f64,
    /// Its time constant, in s.
    pub noise_coloured_tau_s: f64,
    /// Accuracy of the voltmeter.
    pub accuracy_v: AccuracySpec,
    /// Noise of a reading of the state of charge, rms, in %.
    pub noise_pct: f64,
    /// Accuracy of the state of charge, in %.
    pub accuracy_pct: AccuracySpec,
}

/// `[battery]` as written.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct BatteryText {
    capacity_ah: f64,
    #[serde(default = "one")]
    efficiency: f64,
    #[serde(default)]
    ohmic_resistance_ohm: f64,
    #[serde(default)]
    resistance_uncertainty: f64,
    resistances_at_c: Option<[f64; 2]>,
    #[serde(default)]
    alignment_s: f64,
    #[serde(default)]
    ocv: Vec<(f64, f64)>,
    ocv_file: Option<PathBuf>,
    initial_soc: Option<f64>,
    #[serde(default)]
    initial_soc_uncertainty: f64,
    #[serde(default = "one_cell")]
    cells: u32,
    current: Option<String>,
    #[serde(default, deserialize_with = "some_word")]
    current_holds: Option<Holds>,
    #[serde(default)]
    current_zero_a: f64,
    #[serde(default)]
    current_zero_uncertainty_a: f64,
    #[serde(default)]
    noise_v: f64,
    #[serde(default)]
    noise_coloured_v: f64,
    #[serde(default)]
    noise_coloured_tau_s: f64,
    #[serde(default)]
    accuracy_v: AccuracySpec,
    #[serde(default)]
    noise_pct: f64,
    #[serde(default)]
    accuracy_pct: AccuracySpec,
}

fn one() -> f64 {
    1.0
}

fn one_cell() -> u32 {
    1
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Text {
    schema: Option<u32>,
    #[serde(default)]
    name: String,
    #[serde(default)]
    columns: BTreeMap<String, String>,
    sensor: Option<Sensor>,
    charge: Option<Charge>,
    battery: Option<BatteryText>,
    #[serde(default)]
    effects: BTreeMap<String, BTreeMap<String, f64>>,
}

/// A model file that was read and checked.
#[derive(Clone, Debug)]
pub struct Model {
    /// What messages call it.
    pub source: String,
    /// As written.
    text: String,
    /// What it is a model of.
    pub name: String,
    /// Canonical name and the column in the recording that stands for it.
    pub columns: Vec<(String, String)>,
    /// The sensor under test, if there is one.
    pub sensor: Option<Sensor>,
    /// Its charge counter, if it has one.
    pub charge: Option<Charge>,
    /// The battery, if there is one.
    pub battery: Option<Battery>,
    /// Effects that are in the model: id and values in the order of the effect's parameters.
    pub effects: Vec<(&'static str, Vec<f64>)>,
}

impl Model {
    /// Reads a model file.
    pub fn read(path: &Path) -> Result<Self, Failure> {
        let source = path.display().to_string();
        let bytes = fs::read(path).map_err(|error| recording::Error::reading(path, &error))?;
        let text = String::from_utf8(bytes).map_err(|_| {
            Failure(format!(
                "{source}: found bytes that are not UTF-8, expected TOML"
            ))
        })?;
        Self::parse(&source, text, path.parent().unwrap_or(Path::new(".")))
    }

    /// From the text of a model file; an `ocv_file` is looked for in `folder`.
    pub fn parse(source: &str, text: String, folder: &Path) -> Result<Self, Failure> {
        let places = Places::new(source, &text);
        let parsed: Text = toml::from_str(&text).map_err(|error| places.syntax(&error))?;
        let version = "the version of the format that is read here";
        let Some(schema) = parsed.schema else {
            return Err(places.fault(
                &["schema"],
                "none",
                &format!("schema = {SCHEMA}, {version}"),
            ));
        };
        if schema != SCHEMA {
            return Err(places.fault(
                &["schema"],
                &schema.to_string(),
                &format!("{SCHEMA}, {version}"),
            ));
        }
        if let Some(sensor) = &parsed.sensor {
            check_sensor(sensor, &places)?;
        }
        if let Some(charge) = &parsed.charge {
            check_charge(charge, &places)?;
        }
        let battery = match parsed.battery {
            Some(battery) => Some(resolve(battery, &places, folder)?),
            None => None,
        };
        if parsed.sensor.is_none() && battery.is_none() {
            return Err(places.fault(
                &[],
                "neither [sensor] nor [battery]",
                "at least one of them",
            ));
        }
        let stated = [
            parsed.sensor.as_ref().and_then(|it| it.reference.as_ref()),
            parsed.sensor.as_ref().and_then(|it| it.measured.as_ref()),
            parsed.charge.as_ref().and_then(|it| it.column.as_ref()),
            battery.as_ref().and_then(|it| it.current.as_ref()),
        ];
        for (name, column) in &parsed.columns {
            let plain = column.trim();
            if plain.strip_prefix('-').unwrap_or(plain).trim().is_empty() {
                return Err(places.fault(
                    &["columns", name],
                    &format!("{column:?}"),
                    "the name of a column, or a minus and its name",
                ));
            }
            if name::meaning(name).is_none() && !stated.contains(&Some(name)) {
                let known = name::CANONICAL.map(|known| known.name).join(", ");
                return Err(places.fault(
                    &["columns", name],
                    "a name that nothing here goes by",
                    &format!("one of {known}, or a column that this file states"),
                ));
            }
        }
        let mut effects = Vec::new();
        // In the order of the file, which no physics follows from: effects act in the order of their stages.
        for id in places.order("effects") {
            if let Some(values) = parsed.effects.get(&id) {
                let (id, values) = modelled(&id, values, &places)?;
                let (beside, is_there) = if registry::of_battery(id) {
                    ("[battery]", battery.is_some())
                } else {
                    ("[sensor]", parsed.sensor.is_some())
                };
                if !is_there {
                    return Err(places.fault(
                        &["effects", id],
                        &format!("an effect of what no {beside} describes"),
                        &format!("{beside} beside it"),
                    ));
                }
                effects.push((id, values));
            }
        }
        Ok(Self {
            source: source.to_owned(),
            name: parsed.name,
            columns: parsed.columns.into_iter().collect(),
            sensor: parsed.sensor,
            charge: parsed.charge,
            battery,
            effects,
            text,
        })
    }

    /// The file of voltages that it was read with, and the key that names it.
    pub fn ocv_file(&self) -> Option<(&str, &Path)> {
        let file = self.battery.as_ref()?.ocv_file.as_deref()?;
        Some(("ocv_file", file))
    }

    /// As written.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// The model file with effects added, and otherwise as its user wrote it. An effect that it already has gets the
    /// new values.
    ///
    /// `from` is the folder of this model file and `to` the one of the new file: an `ocv_file` is named anew.
    pub fn extended(
        &self,
        effects: &[Found],
        shift: Shift,
        from: &Path,
        to: &Path,
    ) -> Result<String, Failure> {
        extended::Extension {
            source: &self.source,
            battery: self.battery.as_ref(),
            effects,
            shift,
            from,
            to,
        }
        .write(&self.text)
    }
}

/// A number in its place: zero or more, and finite.
fn positive(places: &Places<'_>, table: &str, values: &[(&str, f64)]) -> Result<(), Failure> {
    for (key, value) in values {
        if !(value.is_finite() && *value >= 0.0) {
            return Err(places.fault(&[table, key], &number(*value), "a number, zero or more"));
        }
    }
    Ok(())
}

/// Coloured noise is so by its time constant.
fn check_coloured(
    places: &Places<'_>,
    [table, key]: [&str; 2],
    noise: f64,
    tau_s: f64,
) -> Result<(), Failure> {
    if noise > 0.0 && tau_s <= 0.0 {
        let expected =
            "noise_coloured_tau_s beside it, a time above 0 s; without a memory it is white noise";
        return Err(places.fault(&[table, key], &number(noise), expected));
    }
    Ok(())
}

/// What an instrument may be off by is no less than nothing.
fn check_accuracy(
    places: &Places<'_>,
    [table, key]: [&str; 2],
    accuracy: &AccuracySpec,
) -> Result<(), Failure> {
    for (part, value) in [("zero", accuracy.zero), ("gain", accuracy.gain)] {
        if !(value.is_finite() && value >= 0.0) {
            let expected = "a number, zero or more";
            return Err(places.fault(&[table, key, part], &number(value), expected));
        }
    }
    Ok(())
}

fn check_sensor(sensor: &Sensor, places: &Places<'_>) -> Result<(), Failure> {
    positive(
        places,
        "sensor",
        &[
            ("step", sensor.step),
            ("interval_s", sensor.interval_s),
            ("window_s", sensor.window_s),
            ("noise", sensor.noise),
            ("noise_coloured", sensor.noise_coloured),
            ("noise_coloured_tau_s", sensor.noise_coloured_tau_s),
            ("age_s", sensor.age_s),
            ("jitter_s", sensor.jitter_s),
            ("full_scale", sensor.full_scale.unwrap_or(1.0)),
            ("range_limit", sensor.range_limit.unwrap_or(1.0)),
        ],
    )?;
    check_coloured(
        places,
        ["sensor", "noise_coloured"],
        sensor.noise_coloured,
        sensor.noise_coloured_tau_s,
    )?;
    check_accuracy(places, ["sensor", "accuracy"], &sensor.accuracy)?;
    if sensor.smooth_reference && sensor.held_reference.is_some() {
        let expected = "one of smooth_reference and held_reference";
        return Err(places.fault(&["sensor", "smooth_reference"], "both", expected));
    }
    let limits = core_logic::sliding_average::LENGTH_LIMITS;
    if let Some(average) = sensor.average
        && !(limits.0..=limits.1).contains(&average)
    {
        let expected = format!("{} to {} readings", limits.0, limits.1);
        return Err(places.fault(&["sensor", "average"], &average.to_string(), &expected));
    }
    if sensor.front_end == FrontEndKind::Pair {
        if sensor.average.is_some() {
            return Err(places.fault(
                &["sensor", "average"],
                "a number of readings",
                "window_s: front_end = \"pair\" has no sliding average of readings",
            ));
        }
        for (key, value) in [("age_s", sensor.age_s), ("jitter_s", sensor.jitter_s)] {
            if value > 0.0 {
                return Err(places.fault(
                    &["sensor", key],
                    "a time",
                    "none: front_end = \"pair\" has no conversions",
                ));
            }
        }
        return Ok(());
    }
    // What a board's design fixes is not for the model file to say again.
    for (key, stated, instead) in [
        ("step", sensor.step > 0.0, "its converter"),
        ("window_s", sensor.window_s > 0.0, "its conversion"),
        ("interval_s", sensor.interval_s > 0.0, "its conversion"),
        ("full_scale", sensor.full_scale.is_some(), "its front end"),
        ("range_limit", sensor.range_limit.is_some(), "its front end"),
        (
            "smooth_reference",
            sensor.smooth_reference,
            "conversions of straight lines",
        ),
        (
            "held_reference",
            sensor.held_reference == Some(Holds::SinceLastRow),
            "what is held until the next row (true)",
        ),
    ] {
        if stated {
            return Err(places.fault(
                &["sensor", key],
                "a value",
                &format!("none: a board's follows from {instead}"),
            ));
        }
    }
    Ok(())
}

fn check_charge(charge: &Charge, places: &Places<'_>) -> Result<(), Failure> {
    positive(
        places,
        "charge",
        &[
            ("step_c", charge.step_c),
            ("noise_c", charge.noise_c),
            ("age_s", charge.age_s),
            ("jitter_s", charge.jitter_s),
            ("interval_s", charge.interval_s.unwrap_or(0.0)),
        ],
    )
}

fn resolve(text: BatteryText, places: &Places<'_>, folder: &Path) -> Result<Battery, Failure> {
    positive(
        places,
        "battery",
        &[
            ("ohmic_resistance_ohm", text.ohmic_resistance_ohm),
            ("resistance_uncertainty", text.resistance_uncertainty),
            ("initial_soc_uncertainty", text.initial_soc_uncertainty),
            (
                "current_zero_uncertainty_a",
                text.current_zero_uncertainty_a,
            ),
            ("noise_v", text.noise_v),
            ("noise_coloured_v", text.noise_coloured_v),
            ("noise_coloured_tau_s", text.noise_coloured_tau_s),
            ("noise_pct", text.noise_pct),
        ],
    )?;
    check_coloured(
        places,
        ["battery", "noise_coloured_v"],
        text.noise_coloured_v,
        text.noise_coloured_tau_s,
    )?;
    let range = |key: &str, value: f64, good: bool, expected: &str| {
        if good {
            Ok(())
        } else {
            Err(places.fault(&["battery", key], &number(value), expected))
        }
    };
    let capacity = text.capacity_ah;
    range(
        "capacity_ah",
        capacity,
        capacity > 0.0 && capacity.is_finite(),
        "a capacity above 0 Ah",
    )?;
    let efficiency = text.efficiency;
    range(
        "efficiency",
        efficiency,
        efficiency > 0.5 && efficiency <= 1.0,
        "a share above 0.5, at most 1",
    )?;
    range(
        "alignment_s",
        text.alignment_s,
        text.alignment_s.is_finite(),
        "a time in s, below 0 if voltages were read after the current",
    )?;
    if let Some(at_c) = text.resistances_at_c {
        let [low, high] = at_c;
        if !(-ZERO_CELSIUS_K < low && low <= high && high.is_finite()) {
            return Err(places.fault(
                &["battery", "resistances_at_c"],
                &format!("[{}, {}]", number(low), number(high)),
                "the lowest and the highest temperature in °C at which the resistances are known",
            ));
        }
    }
    range(
        "current_zero_a",
        text.current_zero_a,
        text.current_zero_a.is_finite(),
        "what the current's column reads without a current, in A",
    )?;
    if let Some(soc) = text.initial_soc {
        range(
            "initial_soc",
            soc,
            (-BEYOND_SOC..=1.0 + BEYOND_SOC).contains(&soc),
            "a state of charge from 0 to 1, or up to 0.1 beyond; left out: taken from the recording",
        )?;
    }
    range(
        "cells",
        f64::from(text.cells),
        text.cells >= 1,
        "one or more cells in series",
    )?;
    let ocv_file = text.ocv_file.as_ref().map(|file| folder.join(file));
    let ocv = match (text.ocv.is_empty(), &ocv_file) {
        (false, Some(_)) => {
            return Err(places.fault(
                &["battery", "ocv_file"],
                "ocv_file beside ocv",
                "one of the two",
            ));
        }
        (_, None) => {
            check_ocv(&text.ocv, |what, expected| {
                places.fault(&["battery", "ocv"], what, expected)
            })?;
            text.ocv
        }
        (true, Some(file)) => read_ocv(file)?,
    };
    check_accuracy(places, ["battery", "accuracy_v"], &text.accuracy_v)?;
    check_accuracy(places, ["battery", "accuracy_pct"], &text.accuracy_pct)?;
    Ok(Battery {
        capacity_ah: capacity,
        efficiency,
        resistance_ohm: text.ohmic_resistance_ohm,
        resistance_uncertainty: text.resistance_uncertainty,
        resistances_at_c: text.resistances_at_c,
        alignment_s: text.alignment_s,
        ocv,
        ocv_file,
        initial_soc: text.initial_soc,
        initial_soc_uncertainty: text.initial_soc_uncertainty,
        cells: text.cells,
        current: text.current,
        current_holds: text.current_holds,
        current_zero_a: text.current_zero_a,
        current_zero_uncertainty_a: text.current_zero_uncertainty_a,
        noise_v: text.noise_v,
        noise_coloured_v: text.noise_coloured_v,
        noise_coloured_tau_s: text.noise_coloured_tau_s,
        accuracy_v: text.accuracy_v,
        noise_pct: text.noise_pct,
        accuracy_pct: text.accuracy_pct,
    })
}

/// A CSV with the columns `soc` (0 … 1) and `ocv_v`.
fn read_ocv(path: &Path) -> Result<Vec<(f64, f64)>, Failure> {
    let table = csv::read_table(path)?;
    let (soc, volts) = (table.need("soc")?, table.need("ocv_v")?);
    let points: Vec<(f64, f64)> = soc.iter().copied().zip(volts.iter().copied()).collect();
    check_ocv(&points, |what, expected| {
        Failure(format!(
            "{}: found {what}, expected {expected}",
            path.display()
        ))
    })?;
    Ok(points)
}

fn check_ocv(points: &[(f64, f64)], fault: impl Fn(&str, &str) -> Failure) -> Result<(), Failure> {
    let expected = "pairs of state of charge (0 … 1, ascending) and V (positive)";
    if points.len() == 1 {
        return Err(fault("a single point", expected));
    }
    for (index, (soc, volts)) in points.iter().enumerate() {
        let ascends = index == 0 || points[index - 1].0 < *soc;
        if !((-0.01..=1.01).contains(soc) && *volts > 0.0 && volts.is_finite() && ascends) {
            return Err(fault(
                &format!("({soc}, {volts}) as point {}", index + 1),
                expected,
            ));
        }
    }
    Ok(())
}

fn modelled(
    id: &str,
    values: &BTreeMap<String, f64>,
    places: &Places<'_>,
) -> Result<(&'static str, Vec<f64>), Failure> {
    let Some((id, variants)) = registry::find(id) else {
        let known = registry::ids().join(", ");
        return Err(places.fault(
            &["effects", id],
            "an unknown effect",
            &format!("one of {known}"),
        ));
    };
    // An internal parameter (a phase) may be left out.
    let fits = |parameters: &&&[Parameter]| {
        let known = |key: &String| parameters.iter().any(|parameter| parameter.name == key);
        let complete = parameters
            .iter()
            .all(|parameter| parameter.internal || values.contains_key(parameter.name));
        complete && values.keys().all(known)
    };
    let Some(parameters) = variants.iter().find(fits) else {
        let names = |parameters: &&[Parameter]| {
            let names: Vec<&str> = parameters.iter().map(|parameter| parameter.name).collect();
            names.join(", ")
        };
        let known: Vec<String> = variants.iter().map(names).collect();
        let all = variants.last().copied().unwrap_or_default();
        let wrong = values
            .keys()
            .find(|key| all.iter().all(|parameter| parameter.name != key.as_str()));
        let (found, path) = match wrong {
            Some(key) => ("an unknown parameter", vec!["effects", id, key.as_str()]),
            None => ("not all parameters", vec!["effects", id]),
        };
        return Err(places.fault(&path, found, &known.join("; or ")));
    };
    let mut ordered = Vec::new();
    for parameter in parameters.iter() {
        let value = values.get(parameter.name).copied().unwrap_or(parameter.off);
        // Without end is what switches some effects off (a knee, a rail), and no value of another.
        if !value.is_finite() && value != parameter.off {
            return Err(places.fault(
                &["effects", id, parameter.name],
                &number(value),
                "a finite number",
            ));
        }
        let (lowest, highest) = parameter.limits;
        if value < lowest || value > highest {
            let expected = match parameter.limits {
                (0.0, f64::INFINITY) => "a number, zero or more".to_owned(),
                (_, f64::INFINITY) => "a number above 0".to_owned(),
                _ => format!("a number from {lowest} to {highest}"),
            };
            return Err(places.fault(&["effects", id, parameter.name], &number(value), &expected));
        }
        ordered.push(value);
    }
    let effect = effects::find_with(id, ordered.len());
    if let Some(expected) = effect.and_then(|effect| effect.at_odds(&ordered)) {
        let values: Vec<String> = ordered.iter().map(|value| number(*value)).collect();
        return Err(places.fault(&["effects", id], &values.join(" and "), expected));
    }
    Ok((id, ordered))
}
