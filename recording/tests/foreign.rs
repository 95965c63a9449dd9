//! Files written by python-can, asammdf, pyarrow and pandas, against what cantools, asammdf, pyarrow and pandas say is in them.
//!
//! `recording/python/make_logs.py` makes them. They are looked for in `HALLMARK_FOREIGN_LOGS`, or in `foreign-logs`
//! of the target directory.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::{
    collections::BTreeMap,
    env, fs,
    path::{Path, PathBuf},
    process::Command,
};

use recording::{
    Mapping, Table,
    convert::{self, Converted, Format, Options},
    csv,
    dbc::Database,
    error::Kind,
};

/// The files' clocks keep a microsecond, and python-can's times since 1970 a quarter of one.
const TIME_TOLERANCE_S: f64 = 1e-6;
/// One rounding more or less: a factor of 0.001 is not a thousandth.
const VALUE_TOLERANCE: f64 = 1e-14;

fn folder() -> PathBuf {
    let folder = env::var_os("HALLMARK_FOREIGN_LOGS").map_or_else(
        || {
            let target = env::var_os("CARGO_TARGET_DIR").map_or_else(
                || Path::new(env!("CARGO_MANIFEST_DIR")).join("../target"),
                PathBuf::from,
            );
            target.join("foreign-logs")
        },
        PathBuf::from,
    );
    assert!(
        folder.join("complete").exists(),
        "{} has no logs: make them with recording/python/make_logs.py can/board.dbc {0}",
        folder.display()
    );
    folder
}

/// Time and value of each column, in the order of the file.
type Samples = BTreeMap<String, Vec<(f64, f64)>>;

fn expected(path: &Path) -> Samples {
    let text = fs::read_to_string(path).unwrap();
    let mut samples = Samples::new();
    for line in text.lines().skip(1) {
        let fields: Vec<_> = line.split(',').collect();
        let [_, time_s, column, value] = fields[..] else {
            panic!("{line}");
        };
        let sample = (time_s.parse().unwrap(), value.parse().unwrap());
        samples.entry(column.to_owned()).or_default().push(sample);
    }
    samples
}

fn samples(table: &Table, from_s: f64) -> Samples {
    let time_s = table.need("t_s").unwrap();
    table
        .columns()
        .filter(|&(name, _)| name != "t_s")
        .map(|(name, values)| {
            let present = time_s
                .iter()
                .zip(values)
                .filter(|(_, value)| !value.is_nan());
            let samples = present
                .map(|(&time_s, &value)| (time_s - from_s, value))
                .collect();
            (name.to_owned(), samples)
        })
        .collect()
}

/// Through a file, so that writing is tried as well.
fn table(converted: &Converted) -> Table {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("out.csv");
    convert::write(&path, converted.columns(), &mut |_| {}).unwrap();
    csv::read(&path).unwrap().into_table()
}

fn compare(name: &str, ours: &Samples, theirs: &Samples) {
    let filled: Vec<_> = ours
        .iter()
        .filter(|(_, samples)| !samples.is_empty())
        .collect();
    assert!(
        filled.iter().map(|(name, _)| *name).eq(theirs.keys()),
        "{name}: {:?} instead of {:?}",
        filled.iter().map(|(name, _)| name).collect::<Vec<_>>(),
        theirs.keys().collect::<Vec<_>>()
    );
    for (column, theirs) in theirs {
        let ours = &ours[column];
        assert_eq!(ours.len(), theirs.len(), "{name}, {column}");
        for (row, (ours, theirs)) in ours.iter().zip(theirs).enumerate() {
            let same_time = (ours.0 - theirs.0).abs() <= TIME_TOLERANCE_S;
            let error = (ours.1 - theirs.1).abs();
            let rounded = error <= VALUE_TOLERANCE * theirs.1.abs().max(100.0);
            let same_value = error == 0.0 || rounded && theirs.1.abs() > 1e-9;
            assert!(
                same_time && same_value,
                "{name}, {column}, value {row}: {ours:?} instead of {theirs:?}"
            );
        }
    }
}

fn frames(set: &str, file: &str, format: Format) {
    let folder = folder();
    let options = Options {
        database: Some(Database::read(&folder.join(format!("{set}.dbc"))).unwrap()),
        ..Options::default()
    };
    let theirs = expected(&folder.join(format!("{set}.expected.csv")));
    let converted = convert::read(&folder.join(file), &options, &mut |_| {}).unwrap();
    assert_eq!(converted.format, format);
    let table = table(&converted);
    // Only data frames of the database have a row, and the first frame is one of them.
    let from_s = table.need("t_s").unwrap()[0];
    compare(file, &samples(&table, from_s), &theirs);
    // 2 % and 1 % of the 4000 frames.
    let (counts, decoded) = converted.counts.unwrap();
    assert!((40..130).contains(&counts.remote), "{file}: {counts:?}");
    assert!((15..80).contains(&counts.errors), "{file}: {counts:?}");
    assert!((40..130).contains(&decoded.unknown), "{file}: {decoded:?}");
    assert_eq!(counts.frames + counts.remote + counts.errors, 4_000);
    assert_eq!((decoded.short, decoded.disordered), (0, 0));
    // Of the board's messages a half is protected, and one frame in ten of them is not whole.
    let is_board = set == "board";
    assert_eq!(decoded.invalid > 500, is_board, "{file}: {decoded:?}");
    assert_eq!(decoded.broken > 100, is_board, "{file}: {decoded:?}");
}

#[test]
fn candump_of_any_vehicle() {
    frames("vehicle", "vehicle.log", Format::Candump);
}

#[test]
fn candump_of_the_board() {
    frames("board", "board.log", Format::Candump);
}

#[test]
fn vector_ascii_of_any_vehicle() {
    frames("vehicle", "vehicle.asc", Format::Asc);
}

#[test]
fn vector_ascii_of_the_board() {
    frames("board", "board.asc", Format::Asc);
}

#[test]
fn vector_binary_of_any_vehicle() {
    frames("vehicle", "vehicle.blf", Format::Blf);
    frames("vehicle", "vehicle-plain.blf", Format::Blf);
}

#[test]
fn vector_binary_of_the_board() {
    frames("board", "board.blf", Format::Blf);
    frames("board", "board-plain.blf", Format::Blf);
}

#[test]
fn measurement_file_with_frames_of_any_vehicle() {
    for level in 0..3 {
        frames("vehicle", &format!("vehicle-{level}.mf4"), Format::Mdf);
    }
}

#[test]
fn measurement_file_with_frames_of_the_board() {
    for level in 0..3 {
        frames("board", &format!("board-{level}.mf4"), Format::Mdf);
    }
}

#[test]
fn measured_signals_however_they_are_stored() {
    let folder = folder();
    let theirs = expected(&folder.join("measured.expected.csv"));
    for way in ["", "-deflate", "-transposed", "-lists", "-420"] {
        let file = format!("measured{way}.mf4");
        let converted =
            convert::read(&folder.join(&file), &Options::default(), &mut |_| {}).unwrap();
        assert_eq!(converted.format, Format::Mdf);
        assert_eq!(converted.left_out, ["Remark (text)"], "{file}");
        compare(&file, &samples(&table(&converted), 0.0), &theirs);
    }
}

#[test]
fn tables_of_any_type_of_number() {
    let folder = folder();
    let theirs = expected(&folder.join("table.expected.csv"));
    for packing in ["none", "snappy", "gzip"] {
        let file = format!("table-{packing}.parquet");
        let converted =
            convert::read(&folder.join(&file), &Options::default(), &mut |_| {}).unwrap();
        assert_eq!(converted.format, Format::Parquet);
        assert_eq!(converted.left_out, ["remark (text)"]);
        let mut ours = samples(&table(&converted), 0.0);
        // Moments count from the first one, theirs are dates.
        assert_eq!(ours.remove("date").unwrap()[0].1, 0.0);
        compare(&file, &ours, &theirs);
    }
}

#[test]
fn texts_that_pandas_writes_for_spreadsheets() {
    let folder = folder();
    let theirs = expected(&folder.join("text.expected.csv"));
    let columns = [
        "t_s=Zeit",
        "i_ref_a=Strom [mA]",
        "temp_cell_c=Temperatur (°C)",
    ];
    for (name, from_s, encoding) in [
        ("text-comma", 0.0, None),
        ("text-german", 0.0, Some("Windows-1252")),
        ("text-tabs", 0.0, Some("UTF-16")),
        // Over midnight.
        ("text-clock", 86_370.0, None),
    ] {
        let options = Options {
            mapping: Mapping::parse(columns).unwrap(),
            ..Options::default()
        };
        let path = folder.join(format!("{name}.csv"));
        let converted = convert::read(&path, &options, &mut |_| {}).unwrap();
        assert_eq!(converted.format, Format::Csv);
        let [left_out] = converted.left_out.as_slice() else {
            panic!("{:?}", converted.left_out);
        };
        assert!(
            left_out.starts_with("Anmerkung; frei (\"läuft, "),
            "{left_out}"
        );
        let encoding = encoding.map(|encoding| format!("read as {encoding}, for it is not UTF-8"));
        let rest = [
            "the columns' names are in line 4, what stands above them is not read",
            "i_ref_a is \"Strom [mA]\" / 1000",
        ];
        let told: Vec<_> = encoding
            .into_iter()
            .chain(rest.map(str::to_owned))
            .collect();
        assert_eq!(converted.notes, told, "{name}");
        compare(name, &samples(&table(&converted), from_s), &theirs);
    }
}

#[test]
fn a_table_packed_by_zstd_is_refused_by_its_name() {
    let path = folder().join("table-zstd.parquet");
    let error = convert::read(&path, &Options::default(), &mut |_| {}).unwrap_err();
    assert_eq!(error.kind(), Kind::Unsupported);
    let sentence = error.to_string();
    assert!(
        sentence.starts_with(&path.display().to_string()),
        "{sentence}"
    );
    assert!(
        sentence.contains("column t_s: found values packed by ZSTD"),
        "{sentence}"
    );
}

/// `HALLMARK_PYTHON` names a Python with `recording/python/requirements.txt`; `cargo xtask test` makes one and sets it.
#[test]
fn pyarrow_reads_our_parquet_as_python_reads_our_csv() {
    let options = Options {
        database: Some(Database::read(&folder().join("board.dbc")).unwrap()),
        ..Options::default()
    };
    let converted = convert::read(&folder().join("board.log"), &options, &mut |_| {}).unwrap();
    let out = tempfile::tempdir().unwrap();
    let [parquet, csv] = ["out.parquet", "out.csv"].map(|name| out.path().join(name));
    for path in [&parquet, &csv] {
        convert::write(path, converted.columns(), &mut |_| {}).unwrap();
    }
    let python = env::var_os("HALLMARK_PYTHON").expect(
        "HALLMARK_PYTHON has to name a Python with the packages of recording/python/requirements.txt; `cargo xtask test` sets it",
    );
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("python/compare_parquet.py");
    let output = Command::new(python)
        .arg("-B")
        .args([&script, &parquet, &csv])
        .output()
        .unwrap();
    assert!(
        output.status.success(),
        "{}{}",
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    );
}
