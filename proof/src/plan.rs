//! The list of cases: the same on every machine and in every run.

use serde_json::{Map, Value, json};

use crate::{
    case::{Case, Concealed, Group, Planned},
    real::Expected,
};

/// Effects of the sensing chain, by the library's ids.
const SENSING: [&str; 20] = [
    "offset",
    "gain",
    "offset-temperature",
    "gain-temperature",
    "supply-ratiometric",
    "core-hysteresis",
    "core-saturation",
    "clipping",
    "lag",
    "moving-average",
    "delay",
    "clock-skew",
    "hum",
    "quantisation",
    "dead-band",
    "range-handover",
    "range-mismatch",
    "sensor-self-heating",
    "stray-field",
    "sampled-window",
];

/// Effects of charge and battery.
const BATTERY: [&str; 11] = [
    "coulombic-efficiency",
    "parasitic-load",
    "capacity",
    "polarisation",
    "diffusion",
    "ocv-hysteresis",
    "resistance",
    "resistance-temperature",
    "resistance-soc",
    "cell-self-heating",
    "entropic",
];

/// Around the detection limit: 1 is just visible.
const STRENGTHS: [f64; 5] = [0.3, 1.0, 3.0, 10.0, 30.0];
/// What is added to the reading.
const NOISES: [&str; 3] = ["white", "coloured", "quantised"];
/// A car on a fast and on a slow cycle, and the switched load of a computer.
const DRIVES: [&str; 3] = ["us06", "hwfet", "gpu"];
/// Drives of the battery's makers.
const CELL_DRIVES: [&str; 2] = ["us06", "hwfet"];
/// A third one: pulses between rests.
const PULSES: &str = "hppc";
/// Rows of a case of the sensing chain: a little less than seven minutes at 10 Hz.
const ROWS: usize = 4000;
/// Rows of a circuit: five minutes.
const CIRCUIT_ROWS: usize = 3000;
/// Rows of a Doyle–Fuller–Newman cell, which takes a third of a minute for 6,000.
const DFN_ROWS: usize = 2400;
/// Rows of a case of the battery: half an hour, two rows a second.
const BATTERY_ROWS: usize = 3600;

/// Effects that show between rows of 0.1 s: for them the drive is also recorded every 10 ms.
const FAST: [&str; 5] = [
    "lag",
    "moving-average",
    "delay",
    "sampled-window",
    "range-handover",
];

/// Physics that the library lacks (proof/makers/sensing.py).
const OUTSIDE: [&str; 8] = [
    "eddy-current",
    "creep",
    "aux-squared",
    "quadratic",
    "cubic",
    "gain-step",
    "random-walk",
    "missing-codes",
];

/// The same of batteries (proof/makers/battery.py).
const BATTERY_OUTSIDE: [&str; 5] = [
    "voltage-gain",
    "contact-resistance-rise",
    "loose-contact",
    "ocv-step",
    "charge-resistance",
];

/// Circuits (proof/makers/circuits.py); the last three are not in the library.
const CIRCUITS: [&str; 23] = [
    "lag",
    "gain",
    "offset",
    "clipping",
    "diode-clamp",
    "hum",
    "offset-temperature",
    "gain-temperature",
    "sensor-self-heating",
    "supply-ratiometric",
    "core-saturation",
    "core-hysteresis",
    "core-preisach",
    "delay",
    "moving-average",
    "sampled-window",
    "range-mismatch",
    "range-handover",
    "stray-field",
    "dead-band",
    "eddy-current",
    "resonance",
    "crossover",
];

/// What stands still, and the effect that something else then looks the same as.
const INSEPARABLE: [(&str, &str); 5] = [
    ("temperature", "offset-temperature"),
    ("temperature", "gain-temperature"),
    ("supply", "supply-ratiometric"),
    ("aux", "stray-field"),
    ("range", "range-mismatch"),
];

/// Pairs and triples in which one effect hides another.
const COMBINED: [&[&str]; 10] = [
    &["offset", "core-hysteresis"],
    &["offset", "gain"],
    &["lag", "gain"],
    &["delay", "lag"],
    &["gain", "gain-temperature"],
    &["range-mismatch", "offset"],
    &["stray-field", "offset-temperature"],
    &["gain", "lag", "offset"],
    &["core-saturation", "gain", "stray-field"],
    &["supply-ratiometric", "offset-temperature", "delay"],
];

/// The same of batteries.
const COMBINED_BATTERY: [&[&str]; 5] = [
    &["polarisation", "ocv-hysteresis"],
    &["diffusion", "resistance-temperature"],
    &["capacity", "resistance-soc"],
    &["entropic", "resistance-temperature"],
    &["polarisation", "resistance-soc", "entropic"],
];

/// Effects that look, or bend, between rows: the maker's finer grid is too coarse for what a change of range leaves behind if one of
/// the others looks at it there.
const BETWEEN_ROWS: [&str; 5] = [
    "lag",
    "moving-average",
    "delay",
    "clock-skew",
    "sampled-window",
];

/// What people use today, by the names of proof/methods/run.py.
const METHODS: [&str; 7] = [
    "straight-line",
    "bic",
    "bic-ar1",
    "pysindy",
    "gaussian-process",
    "all-at-once",
    "pybop",
];

/// How much of the campaign.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Extent {
    /// A fixed small part of it, for the tests.
    Quick,
    /// All.
    Full,
}

/// A case of the sensing chain or of another maker.
struct New<'a> {
    group: Group,
    maker: &'a str,
    effects: &'a [&'a str],
    strength: f64,
    noise: &'a str,
    drive: &'a str,
    seed: u64,
    rows: usize,
    options: Map<String, Value>,
}

impl<'a> New<'a> {
    /// With what most cases of the sensing chain have.
    fn sensing(group: Group, effects: &'a [&'a str]) -> Self {
        Self {
            group,
            maker: "sensing",
            effects,
            strength: 10.0,
            noise: "white",
            drive: "us06",
            seed: 1,
            rows: ROWS,
            options: Map::new(),
        }
    }

    /// The same of a cell.
    fn battery(group: Group, effects: &'a [&'a str]) -> Self {
        Self {
            maker: "battery",
            rows: BATTERY_ROWS,
            ..Self::sensing(group, effects)
        }
    }

    fn planned(self) -> Planned {
        let effects: Vec<Concealed> = self
            .effects
            .iter()
            .map(|id| Concealed {
                id: (*id).to_owned(),
                strength: self.strength,
            })
            .collect();
        let mut words = vec![self.maker.to_owned()];
        match effects.as_slice() {
            [] => words.push("clean".to_owned()),
            effects => {
                words.extend(effects.iter().map(|effect| effect.id.clone()));
                words.push(self.strength.to_string());
            }
        }
        words.extend([
            self.noise.to_owned(),
            self.drive.to_owned(),
            self.seed.to_string(),
        ]);
        for value in self.options.values() {
            words.push(match value {
                Value::String(word) => word.clone(),
                Value::Array(list) => list
                    .iter()
                    .filter_map(Value::as_str)
                    .collect::<Vec<_>>()
                    .join("-"),
                other => other.to_string(),
            });
        }
        Planned {
            group: self.group,
            case: Case {
                id: words.join("_"),
                maker: self.maker.to_owned(),
                effects,
                noise: self.noise.to_owned(),
                drive: self.drive.to_owned(),
                seed: self.seed,
                rows: self.rows,
                options: self.options,
            },
            without: false,
            twice: false,
            methods: Vec::new(),
        }
    }
}

fn options(value: Value) -> Map<String, Value> {
    match value {
        Value::Object(map) => map,
        _ => Map::new(),
    }
}

/// PyBOP knows nothing but cells.
fn all_methods(battery: bool) -> Vec<String> {
    METHODS
        .iter()
        .filter(|name| battery || **name != "pybop")
        .map(|name| (*name).to_owned())
        .collect()
}

/// Every case of the full campaign, in the order in which it runs: the long ones first.
fn full(real: &[Expected]) -> Vec<Planned> {
    let mut plan = Vec::new();
    for one in real {
        plan.push(Planned {
            group: Group::Real,
            case: Case {
                id: format!("real_{}", one.id),
                maker: String::new(),
                effects: Vec::new(),
                noise: "none".to_owned(),
                drive: one.id.clone(),
                seed: 0,
                rows: 0,
                options: Map::new(),
            },
            without: false,
            twice: false,
            // They read one file, with one clock.
            methods: if one.two_clocks() {
                Vec::new()
            } else {
                all_methods(one.battery)
            },
        });
    }
    plan.extend(crate::board::plan());
    plan.extend(others());
    plan.extend(combined());
    plan.extend(each_two());
    plan.extend(clean());
    plan.extend(outside());
    plan.extend(inseparable());
    plan.extend(single_battery());
    plan.extend(single_sensing());
    plan
}

/// Simulators that others wrote.
fn others() -> Vec<Planned> {
    let mut plan = cells();
    let circuit = |group, effects: &[&str], strength, noise, drive, seed| {
        New {
            group,
            maker: "circuits",
            effects,
            strength,
            noise,
            drive,
            seed,
            rows: CIRCUIT_ROWS,
            options: Map::new(),
        }
        .planned()
    };
    for effect in CIRCUITS {
        for (strength, noise, drive) in [
            (3.0, "white", "us06"),
            (10.0, "white", "us06"),
            (10.0, "coloured", "us06"),
            (10.0, "quantised", "us06"),
            (10.0, "white", "hwfet"),
            (30.0, "white", "us06"),
        ] {
            let mut planned = circuit(Group::Circuits, &[effect], strength, noise, drive, 1);
            // Strong, and near the limit: there a tool and a method differ.
            if strength <= 10.0 && (noise, drive) == ("white", "us06") {
                planned.methods = all_methods(false);
            }
            plan.push(planned);
        }
    }
    for noise in NOISES {
        for drive in CELL_DRIVES {
            for seed in 1..=8 {
                let mut planned = circuit(Group::Clean, &[], f64::INFINITY, noise, drive, seed);
                if seed == 1 {
                    planned.methods = all_methods(false);
                }
                plan.push(planned);
            }
        }
    }
    plan
}

/// Cells by PyBaMM.
fn cells() -> Vec<Planned> {
    let noisy = |effects: &[&str], strength, noise, drive, more: Value| {
        New {
            group: Group::Cells,
            maker: "cells",
            effects,
            strength,
            noise,
            drive,
            seed: 1,
            rows: if more.get("model") == Some(&json!("dfn")) {
                DFN_ROWS
            } else {
                BATTERY_ROWS
            },
            options: options(more),
        }
        .planned()
    };
    let cell = |effects: &[&str], strength, drive, more: Value| {
        noisy(effects, strength, "white", drive, more)
    };
    let mut plan = Vec::new();
    // What such a cell has by nature, beside open-circuit voltage and one resistance.
    for model in ["spme", "dfn"] {
        for drive in CELL_DRIVES {
            let mut warm = cell(&["diffusion"], 10.0, drive, json!({ "model": model }));
            warm.methods = all_methods(true);
            plan.push(warm);
            for temperature_c in [0, 10, 40] {
                plan.push(cell(
                    &["diffusion", "resistance-temperature"],
                    10.0,
                    drive,
                    json!({ "model": model, "temperature_c": temperature_c }),
                ));
            }
        }
    }
    for drive in CELL_DRIVES {
        plan.push(cell(
            &["diffusion"],
            10.0,
            drive,
            json!({ "model": "spme", "thermal": "lumped" }),
        ));
    }
    // One effect more, beside a circuit that was fitted to another stretch of driving.
    for effect in [
        "resistance-temperature",
        "entropic",
        "ocv-hysteresis",
        "capacity",
        "parasitic-load",
        "offset",
    ] {
        for (strength, drive) in [(10.0, "hwfet"), (30.0, "hwfet"), (30.0, "us06")] {
            plan.push(cell(&[effect], strength, drive, Value::Null));
        }
        for noise in ["coloured", "quantised"] {
            plan.push(noisy(&[effect], 30.0, noise, "us06", Value::Null));
        }
    }
    for (noise, drive) in [
        ("coloured", "us06"),
        ("quantised", "us06"),
        ("white", PULSES),
        ("coloured", PULSES),
    ] {
        let spme = || json!({ "model": "spme" });
        plan.push(noisy(&["diffusion"], 10.0, noise, drive, spme()));
        // The circuit was fitted to driving: pulses show more than it leaves there.
        if drive != PULSES {
            plan.push(noisy(&[], f64::INFINITY, noise, drive, spme()));
        }
    }
    // Only what such a circuit leaves.
    for drive in CELL_DRIVES {
        for model in ["spme", "dfn"] {
            plan.push(cell(&[], f64::INFINITY, drive, json!({ "model": model })));
        }
    }
    plan
}

/// These show in few rows or none until they are large (proof/makers/README.md).
const LATE: [&str; 2] = ["sampled-window", "range-handover"];
/// For them.
const LATE_STRENGTHS: [f64; 2] = [100.0, 300.0];

/// Each effect × strength × noise × drive of the sensing chain.
fn single_sensing() -> Vec<Planned> {
    let mut plan = Vec::new();
    for effect in SENSING {
        for strength in STRENGTHS {
            for noise in NOISES {
                for (place, drive) in DRIVES.into_iter().enumerate() {
                    plan.push(single(
                        "sensing", effect, strength, noise, drive, place, ROWS,
                    ));
                }
            }
            if FAST.contains(&effect) {
                plan.push(single(
                    "sensing",
                    effect,
                    strength,
                    "white",
                    "us06-fast",
                    3,
                    ROWS,
                ));
            }
        }
    }
    for effect in LATE {
        for strength in LATE_STRENGTHS {
            for (place, drive) in CELL_DRIVES.into_iter().enumerate() {
                plan.push(single(
                    "sensing", effect, strength, "white", drive, place, ROWS,
                ));
            }
        }
    }
    plan
}

/// The same of the battery, for which there are two drives.
fn single_battery() -> Vec<Planned> {
    let mut plan = Vec::new();
    for effect in BATTERY {
        for strength in STRENGTHS {
            for noise in NOISES {
                for (place, drive) in CELL_DRIVES.into_iter().chain([PULSES]).enumerate() {
                    if place == 0 || noise == "white" {
                        plan.push(single(
                            "battery",
                            effect,
                            strength,
                            noise,
                            drive,
                            place,
                            BATTERY_ROWS,
                        ));
                    }
                }
            }
        }
    }
    plan
}

fn single(
    maker: &str,
    effect: &str,
    strength: f64,
    noise: &str,
    drive: &str,
    place: usize,
    rows: usize,
) -> Planned {
    let mut planned = New {
        group: Group::Single,
        maker,
        effects: &[effect],
        strength,
        noise,
        drive,
        seed: place as u64 + 1,
        rows,
        options: Map::new(),
    }
    .planned();
    let usual = strength == 10.0 && noise == "white";
    planned.without = usual && place < 2;
    if usual && place == 0 {
        planned.methods = all_methods(maker == "battery");
    }
    planned.twice = usual && place == 0 && effect == "lag";
    planned
}

/// Strong enough that what hides the other can be told.
fn combined() -> Vec<Planned> {
    let mut plan = Vec::new();
    for effects in COMBINED {
        for (noise, drive, strength) in [
            ("white", "us06", 10.0),
            ("coloured", "us06", 10.0),
            ("white", "hwfet", 10.0),
            ("white", "us06", 3.0),
        ] {
            plan.push(
                New {
                    strength,
                    noise,
                    drive,
                    options: options(json!({ "masked": true })),
                    ..New::sensing(Group::Combined, effects)
                }
                .planned(),
            );
        }
    }
    for effects in COMBINED_BATTERY {
        for drive in CELL_DRIVES {
            plan.push(
                New {
                    drive,
                    options: options(json!({ "masked": true })),
                    ..New::battery(Group::Combined, effects)
                }
                .planned(),
            );
        }
    }
    plan
}

/// Every two effects of the sensing chain, and every two of a battery, in turns in each noise and on each drive.
fn each_two() -> Vec<Planned> {
    let of = |all: &'static [&'static str], drives: &'static [&'static str], battery: bool| {
        let made = |pair: &[&str; 2]| {
            let has = |id: &str| pair.contains(&id);
            !(has("range-handover") && BETWEEN_ROWS.into_iter().any(has))
        };
        let pairs = (0..all.len()).flat_map(|b| (0..b).map(move |a| [all[a], all[b]]));
        let in_turns = pairs.filter(made).enumerate().map(move |(place, pair)| {
            let new = if battery {
                New::battery(Group::Combined, &pair)
            } else {
                New::sensing(Group::Combined, &pair)
            };
            New {
                noise: NOISES[place % NOISES.len()],
                drive: drives[place / NOISES.len() % drives.len()],
                ..new
            }
            .planned()
        });
        in_turns.collect::<Vec<_>>()
    };
    [
        of(&SENSING, &DRIVES, false),
        of(&BATTERY, &CELL_DRIVES, true),
    ]
    .concat()
}

fn clean() -> Vec<Planned> {
    let mut plan = Vec::new();
    for noise in NOISES {
        for drive in DRIVES {
            for seed in 1..=12 {
                let mut planned = New {
                    strength: f64::INFINITY,
                    noise,
                    drive,
                    seed,
                    ..New::sensing(Group::Clean, &[])
                }
                .planned();
                if seed == 1 {
                    planned.methods = all_methods(false);
                }
                plan.push(planned);
            }
        }
        // 78 in all: of fewer than 73 even none would leave 5 % within the interval.
        for drive in CELL_DRIVES {
            for seed in 1..=13 {
                let mut planned = New {
                    strength: f64::INFINITY,
                    noise,
                    drive,
                    seed,
                    ..New::battery(Group::Clean, &[])
                }
                .planned();
                if seed == 1 {
                    planned.methods = all_methods(false);
                }
                plan.push(planned);
            }
        }
    }
    plan
}

fn outside() -> Vec<Planned> {
    let mut plan = Vec::new();
    for effect in BATTERY_OUTSIDE {
        for drive in CELL_DRIVES {
            plan.push(
                New {
                    drive,
                    ..New::battery(Group::Outside, &[effect])
                }
                .planned(),
            );
        }
    }
    for effect in OUTSIDE {
        for (noise, drive, strength) in [
            ("white", "us06", 3.0),
            ("white", "us06", 10.0),
            ("coloured", "us06", 10.0),
            ("white", "hwfet", 10.0),
            ("white", "gpu", 10.0),
        ] {
            plan.push(
                New {
                    strength,
                    noise,
                    drive,
                    ..New::sensing(Group::Outside, &[effect])
                }
                .planned(),
            );
        }
    }
    plan
}

fn inseparable() -> Vec<Planned> {
    let mut plan = Vec::new();
    for (still, effect) in INSEPARABLE {
        for drive in ["us06", "hwfet"] {
            plan.push(
                New {
                    drive,
                    options: options(json!({ "constant": [still] })),
                    ..New::sensing(Group::Inseparable, &[effect])
                }
                .planned(),
            );
        }
    }
    for drive in CELL_DRIVES {
        plan.push(
            New {
                drive,
                ..New::battery(Group::Inseparable, &["offset"])
            }
            .planned(),
        );
    }
    for effect in ["gain", "core-saturation"] {
        plan.push(
            New {
                drive: "square",
                ..New::sensing(Group::Inseparable, &[effect])
            }
            .planned(),
        );
    }
    plan
}

/// Whether a case belongs to the small part.
fn is_quick(planned: &Planned) -> bool {
    let case = &planned.case;
    let usual = case.noise == "white" && case.drive == "us06" && case.seed == 1;
    let has = |ids: &[&str]| {
        case.effects
            .iter()
            .any(|effect| ids.contains(&effect.id.as_str()))
    };
    match planned.group {
        Group::Real => [
            "gpu-rtx3090-two-clocks",
            "gpu-rtx3090",
            "gpu-a100",
            "gpu-k40m",
            "nasa-b0053",
            "bh-ferrite",
        ]
        .contains(&case.drive.as_str()),
        Group::Single if case.maker == "sensing" => usual && case.strength() == 10.0,
        Group::Single => {
            usual
                && case.strength() == 10.0
                && has(&["capacity", "polarisation", "diffusion", "entropic"])
        }
        Group::Clean if case.maker == "battery" => usual,
        Group::Clean if case.maker == "circuits" => case.seed == 1 && case.drive == "us06",
        Group::Clean => case.seed == 1,
        Group::Outside => {
            usual
                && case.strength() == 10.0
                && has(&["creep", "quadratic", "gain-step", "ocv-step"])
        }
        Group::Combined => {
            usual && case.strength() == 10.0 && case.effects.len() == 2 && has(&["lag"])
        }
        Group::Inseparable => usual && has(&["offset-temperature"]),
        Group::Cells => {
            usual
                && case.effects.len() == 1
                && has(&["diffusion"])
                && case.options.len() == 1
                && case.options.get("model") == Some(&json!("spme"))
        }
        Group::Circuits => {
            usual
                && case.strength() == 10.0
                && has(&["gain", "lag", "core-saturation", "resonance"])
        }
        Group::Board => case.drive == "large-gain",
    }
}

/// Added to the seeds below: with those themselves the tool was made, with 10 to 300 more it was judged and mended. What has been
/// changed since these were first looked at is told in docs/proof/method.md.
pub const SEEDS: u64 = 310;

/// The cases of a campaign. Other `seeds` make other data of the same kinds; real recordings and the board have none.
pub fn plan(extent: Extent, real: &[Expected], seeds: u64) -> Vec<Planned> {
    let mut plan = cases(extent, real);
    for planned in &mut plan {
        let case = &mut planned.case;
        if !case.maker.is_empty() {
            let [old, new] =
                [case.seed, case.seed + seeds].map(|seed| format!("_{}_{seed}", case.drive));
            case.id = case.id.replacen(&old, &new, 1);
            case.seed += seeds;
        }
    }
    plan
}

fn cases(extent: Extent, real: &[Expected]) -> Vec<Planned> {
    let mut plan = full(real);
    if extent == Extent::Quick {
        plan.retain(is_quick);
        for planned in &mut plan {
            // Each method on a few; it is the tool that is tested here.
            let few = planned.group == Group::Real
                || planned.case.effects.iter().any(|effect| effect.id == "lag");
            if !few {
                planned.methods.clear();
            }
            planned
                .methods
                .retain(|name| ["straight-line", "bic"].contains(&name.as_str()));
            planned.without &= planned
                .case
                .effects
                .iter()
                .any(|effect| ["lag", "gain"].contains(&effect.id.as_str()));
        }
    }
    plan
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use std::{collections::HashSet, path::Path};

    use super::*;

    fn real() -> Vec<Expected> {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("expected.toml");
        crate::real::expected(&file).unwrap()
    }

    #[test]
    fn ids_are_unique_and_names_of_folders() {
        let plan = plan(Extent::Full, &real(), SEEDS);
        let ids: HashSet<&str> = plan.iter().map(|one| one.case.id.as_str()).collect();
        assert_eq!(ids.len(), plan.len());
        for id in ids {
            assert!(
                id.chars()
                    .all(|c| c.is_ascii_alphanumeric() || "-_.".contains(c)),
                "{id}"
            );
        }
    }

    #[test]
    fn other_seeds_are_other_cases_of_the_same_kinds() {
        let [some, others] = [0, SEEDS].map(|seeds| plan(Extent::Full, &real(), seeds));
        assert_eq!(some.len(), others.len());
        for (one, other) in some.iter().zip(&others) {
            assert_eq!(one.case.effects, other.case.effects);
            let made = !one.case.maker.is_empty();
            assert_eq!(made, one.case.id != other.case.id, "{}", one.case.id);
            assert_eq!(made, one.case.seed != other.case.seed, "{}", one.case.id);
        }
    }

    #[test]
    fn every_effect_meets_every_strength_noise_and_drive() {
        let plan = plan(Extent::Full, &real(), SEEDS);
        let there = |effect: &str, strength: f64, noise: &str, drive: &str| {
            plan.iter().any(|one| {
                let case = &one.case;
                one.group == Group::Single
                    && case.effects[0].id == effect
                    && case.strength() == strength
                    && (case.noise.as_str(), case.drive.as_str()) == (noise, drive)
            })
        };
        for strength in STRENGTHS {
            for noise in NOISES {
                for (effect, drive) in SENSING
                    .into_iter()
                    .flat_map(|effect| DRIVES.map(|drive| (effect, drive)))
                {
                    assert!(there(effect, strength, noise, drive), "{effect} {drive}");
                }
                for effect in BATTERY {
                    assert!(there(effect, strength, noise, "us06"), "{effect}");
                }
            }
        }
    }

    #[test]
    fn the_quick_campaign_is_a_small_part_of_the_full_one() {
        let full: HashSet<String> = plan(Extent::Full, &real(), SEEDS)
            .into_iter()
            .map(|one| one.case.id)
            .collect();
        let quick = plan(Extent::Quick, &real(), SEEDS);
        assert!((30..=80).contains(&quick.len()), "{}", quick.len());
        assert!(quick.iter().all(|one| full.contains(&one.case.id)));
        for group in [Group::Real, Group::Single, Group::Clean, Group::Outside] {
            assert!(quick.iter().any(|one| one.group == group), "{group:?}");
        }
    }
}
