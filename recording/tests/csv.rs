//! The canonical CSV, read and written.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::{fs, path::Path};

use proptest::prelude::*;
use recording::{
    Error, Mapping, Recording, Table,
    csv::{self, Writer},
    error::Kind,
};

fn recording(text: &str) -> Result<Recording, Error> {
    csv::parse("r.csv", text.as_bytes())?.into_recording()
}

#[test]
fn reads_what_the_contract_says() {
    let read = recording("t_s,i_ref_a,step\n0,1.5,3\n0,,4\n0.25,-2e-3,4\n").unwrap();
    assert_eq!(read.time_s(), [0.0, 0.0, 0.25]);
    let current = read.need("i_ref_a").unwrap();
    assert_eq!(current[0], 1.5);
    assert!(current[1].is_nan());
    assert_eq!(current[2], -0.002);
    assert_eq!(read.len(), 3);
    assert_eq!(read.span_s(), 0.25);
    assert!(read.column("v_cell_v").is_none());
    assert_eq!(
        read.table().names().collect::<Vec<_>>(),
        ["t_s", "i_ref_a", "step"]
    );
}

#[test]
fn takes_what_spreadsheets_write() {
    let bytes = "\u{feff}\"t_s\", \"say \"\"v\"\", V\"\r\n0,1\r\n\r\n1,\"2\"";
    // The blank before the quotation mark makes it a part of the name: RFC 4180 has no blanks there.
    assert_eq!(
        recording(bytes).unwrap_err().kind(),
        Kind::FieldCount,
        "three names, two fields"
    );
    let read = recording(&bytes.replace(", \"s", ",\"s")).unwrap();
    assert_eq!(read.need("say \"v\", V").unwrap(), [1.0, 2.0]);
    assert_eq!(read.table().line(1), 4);
}

#[test]
fn a_separator_that_a_spreadsheet_states_is_no_header() {
    let rows = [["t_s", "i_ref_a"], ["0", "1,5"], ["1", "-2,25"]];
    let written = |separator: &str| rows.map(|row| row.join(separator)).join("\r\n");
    for (first, separator) in [
        ("sep=;", ";"),
        ("\u{feff}SEP=;", ";"),
        ("\"sep=;\"", ";"),
        ("sep=\t", "\t"),
    ] {
        let read = recording(&format!("{first}\r\n{}\r\n", written(separator))).unwrap();
        assert_eq!(read.need("i_ref_a").unwrap(), [1.5, -2.25], "{first}");
        assert_eq!(read.table().line(1), 4, "{first}");
    }
    // A comma that is stated separates where the header alone would be read otherwise.
    let read = recording("sep=,\nt_s,x\n0,1\n1,2\n").unwrap();
    assert_eq!(read.need("x").unwrap(), [1.0, 2.0]);
    for (text, found) in [
        (
            "sep=|\nt_s|x\n0|1\n",
            "r.csv, line 1: found \"sep=|\", expected sep= with a comma, a semicolon or a tab",
        ),
        (
            "sep=;\r\n",
            "r.csv: found nothing but a separator, expected a header line",
        ),
    ] {
        assert_eq!(recording(text).unwrap_err().to_string(), found);
    }
}

/// Each fault with the sentence it is told in.
#[test]
fn every_fault_has_its_place() {
    let cases: [(&str, Kind, &str); 33] = [
        (
            "",
            Kind::Empty,
            "r.csv: found an empty file, expected a header line",
        ),
        (
            "\n\r\n",
            Kind::Empty,
            "r.csv: found an empty file, expected a header line",
        ),
        (
            "t_s,i_ref_a\n",
            Kind::Empty,
            "r.csv: found no rows, expected at least one row of numbers",
        ),
        (
            "0,1\n1,2\n",
            Kind::HeaderMissing,
            "r.csv, line 1, column 1: found \"0\", expected a header line with a name for each column",
        ),
        (
            "t_s,i_ref_a,t_s\n0,1,2\n",
            Kind::ColumnName,
            "r.csv, line 1, column 3: found \"t_s\" again, expected each name once",
        ),
        (
            "\nt_s,,i_ref_a\n0,1,2\n",
            Kind::ColumnName,
            "r.csv, line 2, column 2: found an empty field, expected a name for each column",
        ),
        (
            "t_s;i_ref_a\n0;1\n1,5;2.5\n",
            Kind::NotANumber,
            "r.csv, line 3, column 2 (i_ref_a): found \"2.5\", expected a decimal comma, as in line 3",
        ),
        (
            "t_s\ti_ref_a\n0\t0.5\n1\t1,234\n",
            Kind::NotANumber,
            "r.csv, line 3, column 2 (i_ref_a): found \"1,234\", expected a decimal point, as in line 2",
        ),
        (
            "t_s;i_ref_a\n0,5;1.234,5\n",
            Kind::NotANumber,
            "r.csv, line 2, column 2 (i_ref_a): found \"1.234,5\", expected a number or an empty field",
        ),
        (
            "t_s;i_ref_a\n0;1;2\n",
            Kind::FieldCount,
            "r.csv, line 2: found 3 fields, expected one for each column of the header",
        ),
        (
            "time,i_ref_a\n0,1\n",
            Kind::ColumnMissing,
            "r.csv: found the columns time, i_ref_a, expected a column \"t_s\"",
        ),
        (
            "t_s,i_ref_a\n0,1\n\n1,abc\n",
            Kind::NotANumber,
            "r.csv, line 4, column 2 (i_ref_a): found \"abc\", expected a number or an empty field",
        ),
        // Times that have two meanings, or none; thousands set apart by points are none.
        (
            "t_s,i_ref_a\n03/29/2026 00:50:00,1\n",
            Kind::NotANumber,
            "r.csv, line 2, column 1 (t_s): found \"03/29/2026 00:50:00\", expected a number or an empty field; times are numbers, in s, or \
             like 08:00:00.5, 2026-03-29 08:00:00.5 or 29.03.2026 08:00:00.5",
        ),
        (
            "t_s,i_ref_a\n08:00:00,1\n08:00,2\n",
            Kind::NotANumber,
            "r.csv, line 3, column 1 (t_s): found \"08:00\", expected a time like the column's first, 08:00:00.5, or an empty field",
        ),
        (
            "t_s,i_ref_a\n2026-03-29 08:00:00,1\n1,2\n",
            Kind::NotANumber,
            "r.csv, line 3, column 1 (t_s): found \"1\", expected a time like the column's first, 2026-03-29 08:00:00.5, or an empty field",
        ),
        (
            "t_s,i_ref_a\n29.03.2026,1\n",
            Kind::NotANumber,
            "r.csv, line 2, column 1 (t_s): found \"29.03.2026\", expected a number or an empty field; times are numbers, in s, or like \
             08:00:00.5, 2026-03-29 08:00:00.5 or 29.03.2026 08:00:00.5",
        ),
        (
            "t_s;i_ref_a\n1.234.567;1\n",
            Kind::NotANumber,
            "r.csv, line 2, column 1 (t_s): found \"1.234.567\", expected a number or an empty field",
        ),
        (
            "t_s,i_ref_a\n0,1,5\n",
            Kind::FieldCount,
            "r.csv, line 2: found 3 fields, expected one for each column of the header (numbers with a decimal comma need \
             semicolons between them)",
        ),
        (
            "t_s,i_ref_a,i_meas_a,v_cell_v\n0,1,2,3,4\n",
            Kind::FieldCount,
            "r.csv, line 2: found 5 fields, expected one for each column of the header",
        ),
        (
            "t_s,i_ref_a\r\n0,1\r\n1\r\n",
            Kind::FieldCount,
            "r.csv, line 3: found 1 field, expected one for each column of the header",
        ),
        (
            "t_s,i_ref_a,i_meas_a\n0,1,1\n1,2",
            Kind::FieldCount,
            "r.csv, line 3: found 2 fields, expected one for each column of the header (the last line has no end: it may be cut)",
        ),
        // A line about the file, and no names that fit what follows.
        (
            "# logger 3\n# 2024-03-31\nt_s,i_ref_a\n0,1,2\n",
            Kind::FieldCount,
            "r.csv, line 3: found 2 fields, expected one, as in line 1, which is taken for the header",
        ),
        (
            "t_s|i_ref_a\n0|1\n",
            Kind::NotANumber,
            "r.csv, line 2, column 1 (t_s|i_ref_a): found \"0|1\", expected a number or an empty field (commas, semicolons or tabs part \
             fields)",
        ),
        (
            "t_s,i_ref_a\n0,-inf\n",
            Kind::Infinite,
            "r.csv, line 2, column 2 (i_ref_a): found \"-inf\", expected a number or an empty field",
        ),
        (
            "t_s,i_ref_a\n0,1e999\n",
            Kind::Infinite,
            "r.csv, line 2, column 2 (i_ref_a): found \"1e999\", expected a number or an empty field",
        ),
        (
            "t_s,i_ref_a\n0,\"1\n2\"\n",
            Kind::Format,
            "r.csv, line 2, column 2 (i_ref_a): found a quotation mark without its partner, expected both on one line",
        ),
        (
            "t_s,i_ref_a\n0,1\n,2\n",
            Kind::TimeMissing,
            "r.csv, line 3, column 1 (t_s): found no time, expected a time in s",
        ),
        (
            "i_ref_a,t_s\n0,1\n2,0.5\n",
            Kind::TimeBackwards,
            "r.csv, line 3, column 2 (t_s): found 0.5 s, expected a time not before the last row's 1 s",
        ),
        (
            "t_s,cycle\n0,1\n2,1\n1,1\n",
            Kind::TimeBackwards,
            "r.csv, line 4, column 1 (t_s): found 1 s, expected a time not before the last row's 2 s",
        ),
        (
            "t_s,a\u{1b}b\n0,1,\n",
            Kind::FieldCount,
            "r.csv, line 2: found 3 fields, expected one for each column of the header",
        ),
        (
            "t_s,x\n0,a\u{1b}[2Jb\n",
            Kind::NotANumber,
            "r.csv, line 2, column 2 (x): found \"a\\u{1b}[2Jb\", expected a number or an empty field",
        ),
        (
            "t_s,x\n0,0123456789012345678901234567890123456789x\n",
            Kind::NotANumber,
            "r.csv, line 2, column 2 (x): found \"0123456789012345678901234567890123456789…\", expected a number or an empty field",
        ),
        (
            "t_s,x\n0,1 2\n",
            Kind::NotANumber,
            "r.csv, line 2, column 2 (x): found \"1 2\", expected a number or an empty field",
        ),
    ];
    for (text, kind, sentence) in cases {
        // A column without numbers is a fault as soon as it is needed.
        let needed = |read: Recording| {
            let name = if text.contains("i_ref_a") {
                "i_ref_a"
            } else {
                "x"
            };
            read.need(name).map(drop)
        };
        let error = recording(text).and_then(needed).unwrap_err();
        assert_eq!(error.kind(), kind, "{text:?}: {error}");
        assert_eq!(error.to_string(), sentence, "{text:?}");
    }
}

#[test]
fn takes_semicolons_and_tabs_with_either_decimal_mark() {
    let plain = recording("t_s,i_ref_a,\"a;b\"\n0,-1.5,3\n0.5,,4\n1,2e-3,5\n").unwrap();
    for separator in [";", "\t"] {
        for mark in [".", ","] {
            let text = "t_s;i_ref_a;\"a;b\"\n0;-1.5;3\n0.5;;4\n1;2.e-3;\"5.0\"\n";
            let (header, rows) = text.split_once('\n').unwrap();
            let rows = rows.replace('.', mark).replace(';', separator);
            let header = header.replace("a;\"", &format!("a{separator}\""));
            let header = header.replace("t_s;", &format!("t_s{separator}"));
            let read = recording(&format!("{header}\n{rows}")).unwrap();
            let names: Vec<&str> = read.table().names().collect();
            assert_eq!(names, ["t_s", "i_ref_a", "a;b"], "{separator:?}");
            for ((name, values), (_, expected)) in
                read.table().columns().zip(plain.table().columns())
            {
                let bits = |values: &[f64]| values.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
                assert_eq!(
                    bits(values),
                    bits(expected),
                    "{name}, {separator:?}, {mark:?}"
                );
            }
        }
    }
    // Text that has such a mark says nothing of the numbers' one.
    let read = recording("t_s;date;i_ref_a\n0;25.11.2026;1,5\n1;25.11.2026;2,5\n").unwrap();
    assert_eq!(read.need("i_ref_a").unwrap(), [1.5, 2.5]);
    // A comma in the header is what separates.
    let read = recording("t_s,i_ref_a,a;b\n0,1,2\n").unwrap();
    assert_eq!(read.need("a;b").unwrap(), [2.0]);
}

#[test]
fn nan_is_a_missing_value() {
    let read = recording("t_s,i_ref_a\n0,NaN\n1,nan\n2,\n3,5\n").unwrap();
    let current = read.need("i_ref_a").unwrap();
    assert!(current[..3].iter().all(|value| value.is_nan()));
    assert_eq!(current[3], 5.0);
}

#[test]
fn a_column_of_text_is_left_out_until_it_is_needed() {
    let read = recording("note,t_s,x,bad\nbegin,0,1,0\n,1,2,inf\n").unwrap();
    assert_eq!(read.need("x").unwrap(), [1.0, 2.0]);
    assert_eq!(
        read.table().left_out(),
        ["note (\"begin\" in line 2)", "bad (\"inf\" in line 3)"]
    );
    let said =
        "r.csv, line 2, column 1 (note): found \"begin\", expected a number or an empty field";
    assert_eq!(read.need("note").unwrap_err().to_string(), said);
    for mapping in ["x=note", "x=-note"] {
        let mapping = Mapping::parse([mapping]).unwrap();
        let error = read.table().clone().mapped(&mapping).unwrap_err();
        assert_eq!(error.to_string(), said);
    }
    // Columns are counted as they are in the file.
    let error = recording("note,t_s\nbegin,1\n,0\n").unwrap_err();
    assert!(
        error.to_string().contains("line 3, column 2 (t_s)"),
        "{error}"
    );
    assert!(recording("t_s\nbegin\n").is_err());
}

#[test]
fn a_turned_zero_is_zero() {
    let mapping = Mapping::parse(["x=-i"]).unwrap();
    let table = csv::parse("r.csv", b"i\n0\n-2\n").unwrap();
    let turned = table.mapped(&mapping).unwrap();
    let bits: Vec<u64> = turned
        .need("x")
        .unwrap()
        .iter()
        .map(|x| x.to_bits())
        .collect();
    assert_eq!(bits, [0.0_f64.to_bits(), 2.0_f64.to_bits()]);
}

#[test]
fn bytes_that_are_not_utf8_are_placed() {
    for (bytes, said) in [
        // Damaged UTF-8 is no other encoding, and what has control characters is no text.
        (
            "t_s,T [\u{b0}C]\n0,1\n1,?\n".as_bytes(),
            "r.csv, line 3: found the byte 0xff after 2 characters, expected UTF-8 text",
        ),
        (
            b"t_s,x\n0,1\n\0,?\n",
            "r.csv, line 3: found the byte 0xff after 2 characters, expected UTF-8 text",
        ),
        (
            b"?\xfet\0_\0s\0\n",
            "r.csv: found the byte order mark of UTF-16, and after it what is none, expected whole characters (the file may be cut)",
        ),
    ] {
        let bytes: Vec<u8> = bytes
            .iter()
            .map(|byte| if *byte == b'?' { 0xFF } else { *byte })
            .collect();
        let error = csv::parse("r.csv", &bytes).unwrap_err();
        assert_eq!(error.kind(), Kind::NotUtf8);
        assert_eq!(error.to_string(), said);
    }
}

#[test]
fn a_file_that_is_not_there_is_named() {
    let error = csv::read(Path::new("no/such.csv")).unwrap_err();
    assert_eq!(error.kind(), Kind::NotFound);
    assert_eq!(
        error.to_string(),
        "no/such.csv: found no such file, expected a file that can be read"
    );
}

#[test]
fn each_cycle_may_have_its_own_clock() {
    let read = recording("t_s,cycle\n0,1\n10,1\n0,2\n0,2\n5,3\n1,4\n").unwrap();
    assert_eq!(read.segments(), [0..2, 2..5, 5..6]);
    assert_eq!(read.span_s(), 15.0);
}

#[test]
fn columns_get_the_names_that_are_asked_for() {
    let table = || csv::parse("r.csv", b"Time,I,U,i_ref_a\n0,1,2,3\n").unwrap();
    let names = |table: &Table| table.names().map(str::to_owned).collect::<Vec<_>>();

    let mapping = Mapping::parse(["t_s=Time", "i_ref_a=I"]).unwrap();
    let mapped = table().mapped(&mapping).unwrap();
    assert_eq!(names(&mapped), ["t_s", "i_ref_a", "U"]);
    assert_eq!(mapped.need("i_ref_a").unwrap(), [1.0]);

    let swapped = Mapping::parse(["I=U", "U=I"]).unwrap();
    let mapped = table().mapped(&swapped).unwrap();
    assert_eq!(mapped.need("I").unwrap(), [2.0]);
    assert_eq!(mapped.need("U").unwrap(), [1.0]);
    // A message about a mapped column still points at where it stands in the file.
    let error = mapped.error_at(Kind::Format, 0, "I", "x", "y");
    assert_eq!(
        error.to_string(),
        "r.csv, line 2, column 3 (I): found x, expected y"
    );

    let twice = Mapping::parse(["i_ref_a=I", "i_meas_a=I"]).unwrap();
    let mapped = table().mapped(&twice).unwrap();
    assert_eq!(
        mapped.need("i_ref_a").unwrap(),
        mapped.need("i_meas_a").unwrap()
    );

    let error = table()
        .mapped(&Mapping::parse(["x=Voltage"]).unwrap())
        .unwrap_err();
    assert_eq!(
        error.to_string(),
        "r.csv: found the columns Time, I, U, i_ref_a, expected a column \"Voltage\""
    );
}

/// Each name compared with all before it was five billion comparisons, for the reader and for the writer.
#[test]
fn a_hundred_thousand_columns_take_no_minute() {
    let names: Vec<String> = (0..100_000).map(|column| format!("x{column}")).collect();
    let row = "1,".repeat(names.len());
    let text = format!("t_s,{}\n{row}1\n", names.join(","));
    let read = csv::parse("wide.csv", text.as_bytes()).unwrap();
    assert_eq!(read.names().len(), names.len() + 1);
    let folder = tempfile::tempdir().unwrap();
    Writer::create(&folder.path().join("wide.csv"), &names).unwrap();
}

#[test]
fn writer_refuses_what_could_not_be_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("out.csv");
    for names in [
        vec!["t_s", "t_s"],
        vec![""],
        vec!["t_s", "1.5"],
        vec!["a\nb"],
    ] {
        let error = Writer::create(&path, &names).unwrap_err();
        assert_eq!(error.kind(), Kind::ColumnName, "{error}");
    }
    let mut writer = Writer::create(&path, &["t_s", "i_ref_a"]).unwrap();
    writer.row(&[0.0, 1.0]).unwrap();
    assert_eq!(writer.row(&[1.0]).unwrap_err().kind(), Kind::FieldCount);
    let error = writer.row(&[1.0, f64::NEG_INFINITY]).unwrap_err();
    assert_eq!(error.kind(), Kind::Infinite);
    assert!(
        error.to_string().contains("line 3, column 2 (i_ref_a)"),
        "{error}"
    );
    // A refused row leaves nothing in the file.
    writer.row(&[1.0, f64::NAN]).unwrap();
    writer.finish().unwrap();
    assert_eq!(fs::read_to_string(&path).unwrap(), "t_s,i_ref_a\n0,1\n1,\n");
}

#[test]
fn a_single_missing_value_is_still_a_row() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("out.csv");
    let table = Table::new(
        "x",
        vec![("v_cell_v".into(), vec![f64::NAN, 1.0, f64::NAN])],
    )
    .unwrap();
    csv::write(&path, &table, &mut |_| {}).unwrap();
    assert_eq!(csv::read_table(&path).unwrap().len(), 3);
}

/// The recordings that come with the project.
#[test]
fn reads_the_real_recordings() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../recordings/panasonic-18650pf");
    let read = csv::read(&folder.join("25c-us06.csv")).unwrap();
    // Numbers of the folder's README.
    assert_eq!(read.len(), 48_061);
    assert!((read.span_s() - 4_818.9).abs() < 0.1);
    let voltage_v = read.need("v_cell_v").unwrap();
    let least_v = voltage_v.iter().copied().fold(f64::INFINITY, f64::min);
    assert_eq!((least_v * 1e3).round(), 2494.0);
}

fn any_number() -> impl Strategy<Value = f64> {
    any::<u64>().prop_map(|bits| {
        let number = f64::from_bits(bits);
        // One NaN stands for all: a missing value.
        if number.is_finite() { number } else { f64::NAN }
    })
}

proptest! {
    #[test]
    fn what_is_written_is_read_bit_by_bit(
        rows in prop::collection::vec((any_number(), any_number()), 1..50),
        name in "[a-zA-Z,;\"' ]{0,6}[a-zA-Z;,\"]",
    ) {
        prop_assume!(name.trim() == name && name != "first" && name.parse::<f64>().is_err());
        let (first, second): (Vec<_>, Vec<_>) = rows.into_iter().unzip();
        let table = Table::new("x", vec![("first".into(), first), (name, second)]).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out.csv");
        csv::write(&path, &table, &mut |_| {}).unwrap();
        let read = csv::read_table(&path).unwrap();
        prop_assert!(table.names().eq(read.names()));
        for ((_, ours), (_, theirs)) in table.columns().zip(read.columns()) {
            let bits = |values: &[f64]| values.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
            prop_assert_eq!(bits(ours), bits(theirs));
        }
    }

    #[test]
    fn no_bytes_make_it_panic(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        if let Err(error) = csv::parse("r.csv", &bytes) {
            prop_assert!(error.to_string().starts_with("r.csv"));
        }
    }

    /// Text close to a recording, so that the rare paths are met.
    #[test]
    fn near_recordings_are_read_or_placed(text in "(t_s|x|1|\"|,|\n|\r\n|;|-1e5|nan|\u{feff}){0,40}") {
        let lines = text.split('\n').count() as u64;
        match csv::parse("r.csv", text.as_bytes()) {
            Ok(table) => {
                for row in 0..table.len() {
                    prop_assert!(table.line(row) <= lines && table.line(row) > 1);
                }
            }
            Err(error) => {
                let placed = error.place().line.is_some_and(|line| line >= 1 && line <= lines);
                prop_assert!(placed || error.kind() == Kind::Empty, "{}", error);
            }
        }
    }
}
