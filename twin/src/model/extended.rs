//! The model file with effects added.

use std::{
    fs,
    path::{Component, Path, PathBuf},
};

use toml_edit::{Array, DocumentMut, Item, Table, TableLike, Value, value};

use super::{BEYOND_SOC, Battery};
use crate::{
    effects::{chain::Nuisance, ocv::bent, scene::USUAL_B_K},
    failure::Failure,
    problem::Holds,
};

/// An effect to be written into a model file.
#[derive(Clone, Debug, PartialEq)]
pub struct Found {
    /// Its id.
    pub id: String,
    /// Names and values of its parameters.
    pub parameters: Vec<(String, f64)>,
    /// What is said of it, line by line; becomes a comment.
    pub comment: Vec<String>,
}

/// What the base differs by, within what the model file says it does not know.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Shift {
    /// Added to the initial state of charge, 0 … 1.
    pub soc: f64,
    /// Relative change of the ohmic resistance.
    pub resistance: f64,
    /// Added to what the recorded current is above the battery's, in A.
    pub current_zero_a: f64,
    /// Lowest and highest temperature, in °C, at which the resistances were found.
    pub resistances_at_c: Option<[f64; 2]>,
    /// What the open-circuit voltage of a cell is above each line of its table, half-way between its points, in V.
    pub ocv_bend_v: Vec<f64>,
    /// Time by which a sensor's readings stand for an earlier moment than their row, in s.
    pub alignment_s: f64,
    /// The same of a battery's voltages.
    pub voltage_alignment_s: f64,
    /// The reference goes from row to row in a smooth course.
    pub smooth_reference: bool,
    /// The reference stays at one value between its rows.
    pub held_reference: Option<Holds>,
    /// A battery's current stays at one value between its rows.
    pub current_holds: Option<Holds>,
}

impl Shift {
    /// What was found for one signal; of each value the first that says something counts.
    pub fn take(&mut self, nuisance: &Nuisance, of_battery: bool) {
        let alignment_s = if of_battery {
            &mut self.voltage_alignment_s
        } else {
            &mut self.alignment_s
        };
        // What is stated is the start of the first operation.
        let soc_shift = nuisance.soc_shift.first().copied().unwrap_or_default();
        for (mine, found) in [
            (&mut self.soc, soc_shift),
            (&mut self.resistance, nuisance.resistance),
            (&mut self.current_zero_a, nuisance.current_zero_a),
            (alignment_s, nuisance.alignment_s),
        ] {
            if *mine == 0.0 {
                *mine = found;
            }
        }
        self.resistances_at_c = self.resistances_at_c.or(nuisance.resistances_at_c);
        if self.ocv_bend_v.is_empty() {
            self.ocv_bend_v.clone_from(&nuisance.ocv_bend_v);
        }
    }
}

/// What is written into a model file.
pub(super) struct Extension<'a> {
    pub source: &'a str,
    pub battery: Option<&'a Battery>,
    pub effects: &'a [Found],
    pub shift: Shift,
    pub from: &'a Path,
    pub to: &'a Path,
}

impl Extension<'_> {
    /// `text` with it; everything else stays as it is.
    pub(super) fn write(&self, text: &str) -> Result<String, Failure> {
        let mut document: DocumentMut = text.parse().map_err(|_| self.wrong("not TOML"))?;
        if let Some(battery) = document
            .get_mut("battery")
            .and_then(Item::as_table_like_mut)
        {
            self.battery(battery);
        }
        if let Some(sensor) = document.get_mut("sensor").and_then(Item::as_table_like_mut) {
            self.sensor(sensor);
        }
        if !self.effects.is_empty() {
            self.effects(&mut document)?;
        }
        let mut written = document.to_string();
        if !written.ends_with('\n') {
            written.push('\n');
        }
        Ok(written)
    }

    fn wrong(&self, what: &str) -> Failure {
        Failure(format!(
            "{}: {what}, expected tables [effects.<id>]",
            self.source
        ))
    }

    fn effects(&self, document: &mut DocumentMut) -> Result<(), Failure> {
        let place = document.as_table_mut().entry("effects").or_insert_with(|| {
            let mut table = Table::new();
            // Only [effects.<id>] is written, not an empty [effects].
            table.set_implicit(true);
            Item::Table(table)
        });
        for effect in self.effects {
            let place = place
                .as_table_like_mut()
                .ok_or_else(|| self.wrong("effects is no table"))?;
            let mut table = Table::new();
            for (name, number) in &effect.parameters {
                // Written in full: reading it back gives the same number.
                table.insert(name, value(*number));
            }
            let comment: String = effect
                .comment
                .iter()
                .map(|line| format!("# {line}\n"))
                .collect();
            table.decor_mut().set_prefix(format!("\n{comment}"));
            place.insert(&effect.id, Item::Table(table));
        }
        Ok(())
    }

    fn sensor(&self, table: &mut dyn TableLike) {
        if self.shift.alignment_s != 0.0 {
            add(table, "alignment_s", self.shift.alignment_s);
        }
        if self.shift.smooth_reference {
            set(table, "smooth_reference", value(true));
        }
        if let Some(holds) = self.shift.held_reference {
            set(table, "held_reference", value(holds.as_str()));
        }
    }

    fn battery(&self, table: &mut dyn TableLike) {
        let file = table
            .get("ocv_file")
            .and_then(Item::as_str)
            .map(PathBuf::from);
        if let Some(file) = file.filter(|file| file.is_relative())
            && let Some(from_there) = relative(&self.from.join(file), self.to)
        {
            set(table, "ocv_file", value(from_there));
        }
        let Some(battery) = self.battery else {
            return;
        };
        if self.shift.voltage_alignment_s != 0.0 {
            add(table, "alignment_s", self.shift.voltage_alignment_s);
        }
        if let Some(holds) = self.shift.current_holds {
            set(table, "current_holds", value(holds.as_str()));
        }
        // Where none is stated, each recording's first reading tells its own: one of this recording would be wrong for any other.
        if let Some(soc) = battery.initial_soc.filter(|_| self.shift.soc != 0.0) {
            let found = (soc + self.shift.soc).clamp(-BEYOND_SOC, 1.0 + BEYOND_SOC);
            set(table, "initial_soc", value(found));
            was(table, "initial_soc", soc);
        }
        if self.shift.resistance != 0.0 {
            let resistance = battery.resistance_ohm * (1.0 + self.shift.resistance);
            set(table, "ohmic_resistance_ohm", value(resistance));
            was(table, "ohmic_resistance_ohm", battery.resistance_ohm);
        }
        // Another recording has a zero of its own: one of this recording would be wrong there.
        if self.shift.current_zero_a != 0.0 {
            let found_a = battery.current_zero_a + self.shift.current_zero_a;
            said(
                table,
                "current_zero_uncertainty_a",
                &format!("In its own recording twin explain found a current_zero_a of {found_a}."),
            );
        }
        if let Some(at_c) = self.shift.resistances_at_c {
            set(table, "resistances_at_c", value(Array::from_iter(at_c)));
            said(
                table,
                "resistances_at_c",
                &format!(
                    "Where twin explain found them. Beyond, they follow temperature as is usual (Arrhenius, {USUAL_B_K} K)."
                ),
            );
        }
        if !self.shift.ocv_bend_v.is_empty() {
            let mut points: Array = bent(&battery.ocv, &self.shift.ocv_bend_v)
                .into_iter()
                .map(|(soc, volts)| Value::from_iter([soc, volts]))
                .collect();
            for point in points.iter_mut() {
                point.decor_mut().set_prefix("\n    ");
            }
            points.set_trailing("\n");
            points.set_trailing_comma(true);
            table.remove("ocv_file");
            set(table, "ocv", value(points));
            said(
                table,
                "ocv",
                "With what twin explain found between the points that were stated.",
            );
        }
    }
}

/// Replaces a value; its comment stays.
fn set(table: &mut dyn TableLike, key: &str, mut new: Item) {
    let Some(place) = table.get_mut(key) else {
        table.insert(key, new);
        return;
    };
    if let (Some(old), Some(new)) = (place.as_value(), new.as_value_mut()) {
        *new.decor_mut() = old.decor().clone();
    }
    *place = new;
}

/// Adds to a number, 0 if there is none.
fn add(table: &mut dyn TableLike, key: &str, more: f64) {
    let number = |item: &Item| item.as_float().or(item.as_integer().map(|n| n as f64));
    let stated = table.get(key).and_then(number).unwrap_or_default();
    set(table, key, value(stated + more));
}

/// Says ahead of a value what was stated.
fn was(table: &mut dyn TableLike, key: &str, stated: f64) {
    said(
        table,
        key,
        &format!("Found by twin explain within its uncertainty; stated as {stated}."),
    );
}

/// Says something ahead of a value.
fn said(table: &mut dyn TableLike, key: &str, what: &str) {
    if let Some(mut key) = table.key_mut(key) {
        let decor = key.leaf_decor_mut();
        let before = decor.prefix().and_then(|prefix| prefix.as_str());
        let before = before.unwrap_or_default();
        decor.set_prefix(format!("{before}# {what}\n"));
    }
}

/// A file as named from another folder, which need not be there yet. `None` where neither can be found.
fn relative(file: &Path, folder: &Path) -> Option<String> {
    let file = fs::canonicalize(file).ok()?;
    // The part of the folder that is there already, and what will be made below it.
    let mut there = std::path::absolute(folder).ok()?;
    let mut below = Vec::new();
    let base = loop {
        if let Ok(found) = fs::canonicalize(&there) {
            break found;
        }
        below.push(there.file_name()?.to_owned());
        there = there.parent()?.to_owned();
    };
    let folder: PathBuf = base.join(below.iter().rev().collect::<PathBuf>());
    let (file_parts, folder_parts): (Vec<Component<'_>>, Vec<Component<'_>>) =
        (file.components().collect(), folder.components().collect());
    let common = file_parts
        .iter()
        .zip(&folder_parts)
        .take_while(|(one, other)| one == other)
        .count();
    let mut path = PathBuf::new();
    path.extend(folder_parts[common..].iter().map(|_| Component::ParentDir));
    path.extend(&file_parts[common..]);
    Some(path.to_str()?.replace('\\', "/"))
}
