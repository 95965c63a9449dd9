//! What the board can correct of what was found, as values for its registers; and of the rest, why it cannot.
//!
//! The board works out `I = (1 + gain)·reading − zero drift`, for each of its sensors, and its meter takes a gain and an
//! offset the same way. A sensor that reads `y = s·i + z` is corrected by `gain = 1/s − 1` and `zero drift = z/s`.

use std::collections::{BTreeMap, BTreeSet};

use core_logic::configuration::{Configuration, FIELD_TEXTS, FIELDS, Field};
use core_logic::modbus::readings::Text;

use crate::{
    effects::find_with,
    model::{FrontEndKind, Model},
    report::data::Report,
};

/// Signals and the registers that correct them: gain and zero.
const CORRECTIONS: [(&str, &str, &str); 2] = [
    ("i_meas_a", "current gain", ZERO_DRIFT),
    ("q_meas_c", "meter: gain", "meter: offset"),
];
/// Found once for a sensor, and so subtracted from current and charge (docs/configuration.md).
const ZERO_DRIFT: &str = "zero drift";
/// `converter: supply mode` in which a reading is referred to the measured supply.
const SUPPLY_MEASURED: f64 = 1.0;

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

/// What a register is to hold: the setting's name, and one value or those of the small and the large sensor.
type Wanted = (&'static str, Vec<f64>);

/// What the board can do about an effect.
enum Remedy {
    /// It belongs to the straight line of the small and that of the large sensor.
    Lines([(f64, f64); 2]),
    /// A register of its own.
    Register(Wanted),
    /// Nothing: why.
    None(&'static str),
}

/// The registers, and a sentence on each effect that none of them corrects.
#[derive(Debug, Default)]
pub(super) struct Calibration {
    /// The file; `None` where there is nothing for the board to correct.
    pub text: Option<String>,
    /// For the report.
    pub remarks: Vec<String>,
}

/// What the board is to be told. Nothing for a sensor that is not the board's.
pub(super) fn calibrate(model: &Model, report: &Report) -> Calibration {
    let Some(mut configuration) = factory(model) else {
        return Calibration::default();
    };
    let (mut text, mut remarks) = (String::new(), Vec::new());
    let mut written = BTreeSet::new();
    let mut zero_drift_ua = vec![0.0; 2];
    for fitted in &report.models {
        let signal = fitted.signal.as_str();
        let mut lines = [Line::IDEAL; 2];
        let mut wanted: Vec<Wanted> = Vec::new();
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
                .any(|effect| effect.id == *id && effect.signal == signal)
        });
        let had = had.map(|effect| (effect, false));
        let named = named.cloned().map(|effect| (effect, true));
        // In the order in which they act, whenever they were found.
        let mut all: Vec<_> = had.chain(named).collect();
        all.sort_by_key(|((id, parameters), _)| {
            find_with(id, parameters.len()).map(|effect| effect.card().place())
        });
        for ((id, parameters), is_new) in all {
            let remedy = remedy(model, signal, &id, &parameters.into_iter().collect());
            let said = report
                .effects
                .iter()
                .find(|effect| is_new && effect.id == id && effect.signal == signal);
            if let Some(class) = said.map(|effect| &effect.equivalent_to)
                && !class.is_empty()
                && !matches!(remedy, Remedy::None(_))
            {
                remarks.push(format!(
                    "{id} in {signal} could as well be {}: the registers correct it only if it is {id}.",
                    class.join(" or ")
                ));
            }
            match remedy {
                Remedy::Lines(both) => {
                    for (line, (slope, zero_a)) in lines.iter_mut().zip(both) {
                        *line = line.then(slope, zero_a);
                    }
                }
                Remedy::Register(register) => wanted.push(register),
                Remedy::None(why) if is_new => {
                    remarks.push(format!("The board cannot correct {id} in {signal}: {why}."));
                }
                Remedy::None(_) => {}
            }
        }
        let line = CORRECTIONS.iter().find(|(of, _, _)| *of == signal);
        if let Some((_, gain, zero)) = line {
            let each = |of: fn(&Line) -> f64| lines.iter().map(of).collect();
            let is_off = lines != [Line::IDEAL; 2];
            if is_off {
                wanted.push((*gain, each(|line| (1.0 / line.slope - 1.0) * 1e6)));
            }
            let mut zeros: Vec<f64> = each(|line| line.zero_a / line.slope * 1e6);
            // The zero drift is taken from the charge as well: what is left of the zero is the meter's own, and where the charge has none,
            // its offset has to give back what the drift takes.
            let drifts = signal == "q_meas_c" && zero_drift_ua.iter().any(|drift| *drift != 0.0);
            if drifts {
                zeros
                    .iter_mut()
                    .zip(&zero_drift_ua)
                    .for_each(|(zero, drift)| *zero -= drift);
            }
            if is_off || drifts {
                wanted.push((*zero, zeros));
            }
        }
        let mut heading = format!("\n# Corrects {signal}.");
        for (name, values) in wanted {
            // Found a second time, in another signal.
            if !written.insert(name) {
                continue;
            }
            match register(&mut configuration, name, &values) {
                Ok(lines) => {
                    text.push_str(&(std::mem::take(&mut heading) + "\n" + &lines));
                    if name == ZERO_DRIFT {
                        zero_drift_ua = values;
                    }
                }
                Err(why) => {
                    remarks.push(format!("The board cannot correct all of {signal}: {why}."))
                }
            }
        }
    }
    remarks.sort();
    remarks.dedup();
    let notes: String = remarks.iter().map(|note| format!("# {note}\n")).collect();
    Calibration {
        text: (!text.is_empty()).then(|| {
            format!(
                "# Registers that correct what was found in {}, for a board on which they are at their factory's\n\
                 # values (docs/modbus.md). Written at standstill; `cargo xtask emulate --calibration` does it.\n{notes}{text}",
                report.inputs.recording
            )
        }),
        remarks,
    }
}

/// The board's configuration as it leaves the factory, for its front end.
fn factory(model: &Model) -> Option<Configuration> {
    let front_end = match model.sensor.as_ref()?.front_end {
        FrontEndKind::Pair => return None,
        FrontEndKind::DualRange => 0,
        FrontEndKind::Hah1bv => 1,
        FrontEndKind::Network => 2,
        FrontEndKind::ClosedLoop => 3,
    };
    let mut configuration = Configuration::default();
    let (field, _) = setting("front end")?;
    field.put(&mut configuration, 0, front_end).ok()?;
    Some(configuration)
}

fn setting(name: &str) -> Option<(&'static Field, &'static Text)> {
    FIELDS
        .iter()
        .zip(FIELD_TEXTS)
        .find(|(_, text)| text.name == name)
}

fn remedy(model: &Model, signal: &str, id: &str, parameters: &BTreeMap<String, f64>) -> Remedy {
    let value = |name: &str| parameters.get(name).copied().unwrap_or(f64::NAN);
    let (converter, meter) = (signal == "i_meas_a", signal == "q_meas_c");
    let battery = model.battery.as_ref();
    match id {
        "offset" if converter || meter => Remedy::Lines([(1.0, value("offset_a")); 2]),
        "gain" if converter || meter => Remedy::Lines([(value("gain"), 0.0); 2]),
        "range-mismatch" if converter || meter => {
            Remedy::Lines([(1.0, 0.0), (value("gain_ratio"), value("offset_a"))])
        }
        // What is left, ratio − 1, is less than what there was.
        "supply-ratiometric" if converter && (0.5..1.5).contains(&value("ratio")) => {
            Remedy::Register(("converter: supply mode", vec![SUPPLY_MEASURED]))
        }
        "supply-ratiometric" => Remedy::None(
            "the converter's reading can be referred to the supply, for a sensor that follows it; nothing else can",
        ),
        // The charge that a change of range costs is current times delay, whatever the filter.
        "range-handover" if meter => {
            Remedy::Register(("meter: front-end delay", vec![value("tau_s") * 1e6]))
        }
        "range-handover" => Remedy::None(
            "a conversion around a change of range is marked, not mended; converter: settling (0x0206) says for how long",
        ),
        // A voltage shows what the battery is; the board's own state of charge shows what the board takes it for.
        "capacity" => match (signal, battery) {
            ("v_cell_v" | "v_pack_v", _) => {
                Remedy::Register(("capacity", vec![value("capacity_ah") * 1e3]))
            }
            ("soc_pct", Some(battery)) => {
                Remedy::Register(("capacity", vec![battery.capacity_ah * 1e3]))
            }
            _ => Remedy::None("it is a matter of the battery"),
        },
        "coulombic-efficiency" => match (signal, battery) {
            ("v_cell_v" | "v_pack_v", _) => {
                Remedy::Register(("coulombic efficiency", vec![value("efficiency") * 1e6]))
            }
            ("soc_pct", Some(battery)) => {
                Remedy::Register(("coulombic efficiency", vec![battery.efficiency * 1e6]))
            }
            _ => Remedy::None("it is a matter of the battery"),
        },
        "offset-temperature" | "gain-temperature" => Remedy::None(
            "it has a register for each zero and gain, and none for what temperature does to them",
        ),
        "core-hysteresis" | "sensor-self-heating" => {
            Remedy::None("it depends on what has flowed before, and a register is a constant")
        }
        "core-saturation" => Remedy::None("it corrects a straight line, not a curve"),
        "clipping" => Remedy::None("what was cut away is not in the reading"),
        "dead-band" if converter => Remedy::None("what was cut away is not in the reading"),
        "dead-band" => Remedy::None(
            "it is the meter chip's own threshold; meter: no-load threshold (0x050C) only says how large, for the uncertainty",
        ),
        "quantisation" => Remedy::None(
            "the step is the converter's; converter: data rate (0x0200) has finer ones that come less often",
        ),
        "lag" | "moving-average" | "delay" | "sampled-window" => Remedy::None(
            "it shows each conversion as it comes and takes no filter or delay out again",
        ),
        "clock-skew" => Remedy::None("its clock is a crystal without a register"),
        "hum" => Remedy::None(
            "average: length (0x0320) quietens the averaged current only, and this is each conversion",
        ),
        "stray-field" => Remedy::None("it does not know the neighbouring conductor's current"),
        "parasitic-load" => Remedy::None("it cannot measure what flows ahead of its sensor"),
        "ocv-hysteresis" | "entropic" => {
            Remedy::None("its open-circuit table (0x0781) is one curve at one temperature")
        }
        _ => Remedy::None("it calculates no voltage under load"),
    }
}

/// One register with its values, if the board takes them beside those before it.
fn register(
    configuration: &mut Configuration,
    name: &str,
    values: &[f64],
) -> Result<String, String> {
    let (field, said) = setting(name).ok_or_else(|| format!("there is no setting {name}"))?;
    let unit = said.unit;
    let values: Vec<i64> = values.iter().map(|value| value.round() as i64).collect();
    let mut staged = *configuration;
    for (element, value) in values.iter().enumerate() {
        field
            .put(&mut staged, element, *value)
            .map_err(|why| why.to_string())?;
    }
    staged
        .validate()
        .map_err(|why| format!("{name} {values:?} {unit}: {why}"))?;
    *configuration = staged;
    let values = match values[..] {
        [small, large] => format!("small = {small}\nlarge = {large}\n"),
        [value] => format!("value = {value}\n"),
        _ => return Err(format!("{name} is a table")),
    };
    Ok(format!(
        "[[register]]\nname = \"{name}\"\naddress = 0x{:04X}\nunit = \"{unit}\"\n{values}",
        field.layout.address
    ))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::report::data::{EffectReport, FittedModel};

    const BOARD: &str = "schema = 1\n[sensor]\nfront_end = \"dual-range\"\n[charge]\n";

    /// Signal, effect and its values.
    type Found<'a> = (&'a str, &'a str, &'a [(&'a str, f64)]);

    /// The file's values by name, and the remarks, after these effects were found.
    fn found(effects: &[Found<'_>]) -> (toml::Table, Vec<String>) {
        written(&reported(effects))
    }

    /// What is reported of these effects, signal by signal.
    fn reported(effects: &[Found<'_>]) -> Report {
        let mut report = Report::default();
        for (signal, id, values) in effects {
            report.effects.push(EffectReport {
                id: (*id).to_owned(),
                signal: (*signal).to_owned(),
                statement: String::new(),
                equation: String::new(),
                parameters: Vec::new(),
                held_out_gain: 0.5,
                placebo_p99: 0.0,
                by_place: None,
                equivalent_to: Vec::new(),
                separated_by: String::new(),
                consequences: Vec::new(),
            });
            let values = values
                .iter()
                .map(|(name, value)| ((*name).to_owned(), *value));
            let effect = ((*id).to_owned(), values.collect());
            match report.models.last_mut() {
                Some(model) if model.signal == *signal => model.effects.push(effect),
                _ => report.models.push(FittedModel {
                    signal: (*signal).to_owned(),
                    effects: vec![effect],
                    ..FittedModel::default()
                }),
            }
        }
        report
    }

    /// The file's values by name, and the remarks, of what was reported.
    fn written(report: &Report) -> (toml::Table, Vec<String>) {
        let model = Model::parse("m.toml", BOARD.to_owned(), Path::new("")).unwrap();
        let calibration = calibrate(&model, report);
        let table: toml::Table = calibration.text.unwrap_or_default().parse().unwrap();
        let mut values = toml::Table::new();
        for register in table
            .get("register")
            .into_iter()
            .flat_map(|all| all.as_array().unwrap())
        {
            values.insert(
                register["name"].as_str().unwrap().to_owned(),
                register.clone(),
            );
        }
        (values, calibration.remarks)
    }

    #[test]
    fn a_correction_undoes_the_sensor() {
        let (values, remarks) = found(&[
            (
                "i_meas_a",
                "range-mismatch",
                &[("gain_ratio", 1.02), ("offset_a", 0.51)],
            ),
            ("q_meas_c", "offset", &[("offset_a", -0.2)]),
        ]);
        let of = |name: &str, key: &str| values[name][key].as_integer().unwrap() as f64 * 1e-6;
        // The board's own formula, at 100 A.
        let reading = 1.02 * 100.0 + 0.51;
        let corrected = (1.0 + of("current gain", "large")) * reading - of("zero drift", "large");
        assert!((corrected - 100.0).abs() < 1e-3, "{corrected}");
        assert_eq!(of("current gain", "small"), 0.0);
        assert_eq!(of("zero drift", "small"), 0.0);
        assert_eq!(
            values["meter: offset"]["small"].as_integer(),
            Some(-200_000)
        );
        // The zero drift of 0.5 A acts on the charge as well.
        assert_eq!(
            values["meter: offset"]["large"].as_integer(),
            Some(-700_000)
        );
        assert!(remarks.is_empty(), "{remarks:?}");
    }

    /// The board takes its zero drift from the charge, too: of a counter that was right, the meter's offset gives it back.
    #[test]
    fn a_counter_that_is_right_stays_so() {
        let mut report = reported(&[("i_meas_a", "offset", &[("offset_a", 0.5)])]);
        report.models.push(FittedModel {
            signal: "q_meas_c".to_owned(),
            ..FittedModel::default()
        });
        let (values, remarks) = written(&report);
        for side in ["small", "large"] {
            assert_eq!(values["zero drift"][side].as_integer(), Some(500_000));
            assert_eq!(values["meter: offset"][side].as_integer(), Some(-500_000));
        }
        assert!(!values.contains_key("meter: gain"), "{values:?}");
        assert!(remarks.is_empty(), "{remarks:?}");
        // A gain has no part in it.
        report = reported(&[("i_meas_a", "gain", &[("gain", 1.25)])]);
        report.models.push(FittedModel {
            signal: "q_meas_c".to_owned(),
            ..FittedModel::default()
        });
        let (values, _) = written(&report);
        assert!(!values.contains_key("meter: offset"), "{values:?}");
    }

    /// A gain and an offset are `gain·i + offset`, whichever was found first.
    #[test]
    fn a_zero_is_corrected_as_it_is_read() {
        let (gain, offset) = ([("gain", 1.25)], [("offset_a", 0.5)]);
        for effects in [
            [("i_meas_a", "gain", &gain), ("i_meas_a", "offset", &offset)],
            [("i_meas_a", "offset", &offset), ("i_meas_a", "gain", &gain)],
        ] {
            let (values, _) = found(&effects.map(|(signal, id, values)| (signal, id, &values[..])));
            // z/s of y = s·i + z.
            assert_eq!(values["zero drift"]["small"].as_integer(), Some(400_000));
        }
    }

    #[test]
    fn supply_and_hand_over_have_registers_of_their_own() {
        let (values, _) = found(&[
            ("i_meas_a", "supply-ratiometric", &[("ratio", 0.97)]),
            (
                "q_meas_c",
                "range-handover",
                &[("tau_s", 60e-6), ("since_s", 0.0)],
            ),
        ]);
        assert_eq!(
            values["converter: supply mode"]["value"].as_integer(),
            Some(1)
        );
        assert_eq!(
            values["meter: front-end delay"]["value"].as_integer(),
            Some(60)
        );
    }

    #[test]
    fn what_the_board_cannot_do_is_said_and_not_written() {
        let (values, remarks) = found(&[
            ("i_meas_a", "lag", &[("tau_s", 0.1)]),
            // The multiplier's low-pass: longer than the register holds.
            (
                "q_meas_c",
                "range-handover",
                &[("tau_s", 0.0179), ("since_s", 0.0)],
            ),
        ]);
        assert!(values.is_empty(), "{values:?}");
        assert_eq!(remarks.len(), 2, "{remarks:?}");
        assert!(
            remarks[0].contains("17900") && remarks[0].contains("10000"),
            "{remarks:?}"
        );
        assert!(remarks[1].contains("cannot correct lag"), "{remarks:?}");
        // Beyond the limit that the zero drift has by itself; the gain stays.
        let (values, remarks) = found(&[(
            "i_meas_a",
            "range-mismatch",
            &[("gain_ratio", 1.01), ("offset_a", 9.0)],
        )]);
        assert_eq!(values.len(), 1, "{values:?}");
        assert!(remarks[0].contains("zero drift"), "{remarks:?}");
    }

    #[test]
    fn every_effect_of_the_library_has_a_register_or_a_reason() {
        let model = Model::parse("m.toml", BOARD.to_owned(), Path::new("")).unwrap();
        for id in crate::effects::ids() {
            for signal in ["i_meas_a", "q_meas_c", "v_cell_v"] {
                match remedy(&model, signal, id, &BTreeMap::new()) {
                    Remedy::Register((name, _)) => assert!(setting(name).is_some(), "{name}"),
                    Remedy::None(why) => assert!(why.len() > 10, "{id}"),
                    Remedy::Lines(_) => {}
                }
            }
        }
    }
}
