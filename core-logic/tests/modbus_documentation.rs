//! `docs/modbus.md` and `docs/configuration.md` carry the tables of the code. `UPDATE_DOCS=1` rewrites them.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing
)]

use std::fmt::Write as _;
use std::path::PathBuf;

use core_logic::configuration::{self, Configuration, FIELD_TEXTS, FIELDS, Field, When};
use core_logic::modbus::readings::{INPUT_TEXTS, INPUTS, MAP_VERSION};
use core_logic::modbus::register::Layout;
use core_logic::modbus::{COMMAND_ADDRESS, Command};

fn addresses(layout: &Layout) -> String {
    match layout.end() - layout.address {
        1 => format!("0x{:04X}", layout.address),
        _ => format!("0x{:04X} … 0x{:04X}", layout.address, layout.end() - 1),
    }
}

fn kind(layout: &Layout) -> String {
    match layout.count {
        1 => layout.kind.name().into(),
        count => format!("{} × {count}", layout.kind.name()),
    }
}

fn grouped(number: i64) -> String {
    let digits = number.unsigned_abs().to_string();
    let mut out = String::from(if number < 0 { "−" } else { "" });
    for (index, digit) in digits.chars().enumerate() {
        if index > 0 && (digits.len() - index).is_multiple_of(3) {
            out.push(',');
        }
        out.push(digit);
    }
    out
}

/// The factory's values, those of a front end's parameters with that front end.
fn defaults(field: &Field) -> String {
    for front_end in 0..4 {
        let mut configuration = Configuration::default();
        FIELDS[0].put(&mut configuration, 0, front_end).unwrap();
        let values: Vec<i64> = (0..usize::from(field.layout.count))
            .map_while(|element| field.get(&configuration, element))
            .collect();
        if values.is_empty() {
            continue;
        }
        let unlike = values.iter().any(|value| *value != values[0]);
        let shown: Vec<String> = values.iter().map(|value| grouped(*value)).collect();
        return match (unlike, shown.len()) {
            (false, _) => shown[0].clone(),
            (true, 2) => shown.join("; "),
            (true, _) => "table below".into(),
        };
    }
    unreachable!("every field belongs to some front end");
}

fn input_table() -> String {
    let mut out =
        String::from("| address | type | name | unit | meaning |\n|---|---|---|---|---|\n");
    for (row, text) in INPUTS.iter().zip(INPUT_TEXTS) {
        let layout = &row.layout;
        writeln!(
            out,
            "| {} | {} | {} | {} | {} |",
            addresses(layout),
            kind(layout),
            text.name,
            text.unit,
            text.meaning
        )
        .unwrap();
    }
    out
}

fn holding_table() -> String {
    let mut out = String::from(
        "| address | type | name | unit | writable | meaning |\n|---|---|---|---|---|---|\n",
    );
    writeln!(
        out,
        "| 0x{COMMAND_ADDRESS:04X} | u16 | command |  | see below | reads the last command |"
    )
    .unwrap();
    for (row, text) in FIELDS.iter().zip(FIELD_TEXTS) {
        let layout = &row.layout;
        writeln!(
            out,
            "| {} | {} | {} | {} | {} | {} |",
            addresses(layout),
            kind(layout),
            text.name,
            text.unit,
            row.when.text(),
            text.meaning
        )
        .unwrap();
    }
    out
}

fn command_table() -> String {
    let mut out = String::from("| value | command | what it does | allowed |\n|---|---|---|---|\n");
    for (command, name, meaning) in Command::ALL {
        writeln!(
            out,
            "| 0x{:04X} | {name} | {meaning} | {} |",
            command.register(),
            command.when().text()
        )
        .unwrap();
    }
    out
}

fn settings_table() -> String {
    let mut out = String::from(
        "| setting | unit | smallest | largest | factory | Modbus |\n|---|---|---|---|---|---|\n",
    );
    for (row, text) in FIELDS.iter().zip(FIELD_TEXTS) {
        writeln!(
            out,
            "| {} | {} | {} | {} | {} | 0x{:04X} |",
            text.name,
            text.unit,
            grouped(row.limits().0),
            grouped(row.limits().1),
            defaults(row),
            row.layout.address
        )
        .unwrap();
    }
    let table = Configuration::default().ocv;
    out.push_str("\nThe factory's open-circuit table:\n\n| state of charge in ppm | voltage in µV |\n|---|---|\n");
    for point in table.points() {
        writeln!(out, "| {} | {} |", point.soc.get(), point.voltage.get()).unwrap();
    }
    out
}

fn check(file: &str, blocks: &[(&str, String)]) {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR"))
        .join("../docs")
        .join(file);
    let written = std::fs::read_to_string(&path).unwrap();
    let mut wanted = written.clone();
    for (name, text) in blocks {
        let begin = format!("<!-- {name}: from the code -->\n");
        let end = format!("<!-- {name}: end -->");
        let from = wanted.find(&begin).expect(name) + begin.len();
        let to = wanted.find(&end).expect(name);
        wanted.replace_range(from..to, &format!("\n{text}\n"));
    }
    if std::env::var_os("UPDATE_DOCS").is_some() {
        std::fs::write(&path, wanted).unwrap();
        return;
    }
    assert!(
        written == wanted,
        "docs/{file} does not say what the code does: UPDATE_DOCS=1 cargo test -p core-logic rewrites it"
    );
}

#[test]
fn the_register_map_is_documented() {
    check(
        "modbus.md",
        &[
            (
                "version",
                format!("Map version {}.{}.\n", MAP_VERSION >> 8, MAP_VERSION & 0xFF),
            ),
            ("commands", command_table()),
            ("holding registers", holding_table()),
            ("input registers", input_table()),
        ],
    );
}

#[test]
fn the_configuration_is_documented() {
    let record = format!(
        "| offset | bytes | content |\n|---|---|---|\n| 0 | 2 | version, {} |\n| 2 | 2 | length n of the payload |\n\
         | {} | n | payload: every value of the table below that is in use, in its order, as a signed postcard number; at most {} |\n| {} + n | {} | CRC-32/ISO-HDLC of all before |\n",
        configuration::VERSION,
        configuration::HEADER,
        configuration::MAX_PAYLOAD,
        configuration::HEADER,
        configuration::TRAILER,
    );
    check(
        "configuration.md",
        &[("record", record), ("settings", settings_table())],
    );
}

#[test]
fn every_text_fits_a_table() {
    for text in INPUT_TEXTS.iter().chain(FIELD_TEXTS) {
        for part in [text.name, text.unit, text.meaning] {
            assert!(!part.contains(['|', '\n']), "{}", text.name);
        }
    }
    assert_ne!(When::Always.text(), When::Standstill.text());
}
