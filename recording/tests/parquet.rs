//! Parquet, written and read.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::fs;

use proptest::prelude::*;
use recording::{Mapping, Table, convert, error::Kind, output::Columns, parquet};

fn any_number() -> impl Strategy<Value = f64> {
    any::<u64>().prop_map(|bits| {
        let number = f64::from_bits(bits);
        // One NaN stands for all: a missing value.
        if number.is_finite() { number } else { f64::NAN }
    })
}

fn bits(values: &[f64]) -> Vec<u64> {
    values.iter().map(|value| value.to_bits()).collect()
}

fn table(rows: &[(f64, f64)]) -> Table {
    let (first, second) = rows.iter().copied().unzip();
    Table::new(
        "x",
        vec![("first".into(), first), ("i_ref_a".into(), second)],
    )
    .unwrap()
}

/// More rows than are written at once.
#[test]
fn several_groups_of_rows() {
    let rows: Vec<_> = (0..300_000)
        .map(|row| {
            (
                f64::from(row) * 1e-3,
                if row % 3 == 0 {
                    f64::NAN
                } else {
                    f64::from(row)
                },
            )
        })
        .collect();
    let table = table(&rows)
        .mapped(&Mapping::parse(["t_s=first"]).unwrap())
        .unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("out.parquet");
    let mut shares = Vec::new();
    convert::write(&path, &table, &mut |share| shares.push(share)).unwrap();
    assert!(
        shares.is_sorted() && shares.iter().all(|share| (0.0..=1.0).contains(share)),
        "{shares:?}"
    );
    let read = convert::recording(&path, &Mapping::new()).unwrap();
    for name in ["t_s", "i_ref_a"] {
        assert_eq!(
            bits(read.need(name).unwrap()),
            bits(table.need(name).unwrap()),
            "{name}"
        );
    }
}

#[test]
fn what_is_no_number_is_placed() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("out.parquet");
    let error = parquet::write(
        &path,
        &table(&[(0.0, 1.0), (1.0, f64::INFINITY)]),
        &mut |_| {},
    )
    .unwrap_err();
    assert_eq!(error.kind(), Kind::Infinite);
    assert!(
        error
            .to_string()
            .contains("row 2, column 2 (i_ref_a): found an infinite value"),
        "{error}"
    );
    assert_eq!(
        fs::read_dir(folder.path()).unwrap().count(),
        0,
        "nothing is left"
    );

    let error = parquet::parse("r.parquet", b"PAR1 and no more".to_vec()).unwrap_err();
    assert_eq!(error.kind(), Kind::Format);
    assert!(
        error.to_string().starts_with("r.parquet: found "),
        "{error}"
    );
}

/// The header of the first page begins with a field that nobody knows: a list of 2^31 - 1 doubles, of which the file has none.
#[test]
fn a_list_without_an_end_in_a_page_is_damage() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("out.parquet");
    convert::write(&path, &table(&[(0.0, 1.0)]), &mut |_| {}).unwrap();
    let mut bytes = fs::read(&path).unwrap();
    bytes[4..11].copy_from_slice(&[0xF9, 0xF7, 0xFF, 0xFF, 0xFF, 0xFF, 0x07]);
    let error = parquet::parse("r.parquet", bytes).unwrap_err();
    assert_eq!(error.kind(), Kind::Format, "{error}");
}

/// A column without a name.
struct Nameless;

impl Columns for Nameless {
    fn names(&self) -> Vec<&str> {
        vec!["t_s", ""]
    }

    fn rows(&self) -> usize {
        1
    }

    fn fill(&self, _column: usize, _first: usize, values: &mut [f64]) {
        values.fill(0.0);
    }
}

#[test]
fn writer_refuses_what_could_not_be_read() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["out.parquet", "out.csv"] {
        let path = folder.path().join(name);
        let error = convert::write(&path, &Nameless, &mut |_| {}).unwrap_err();
        assert_eq!(error.kind(), Kind::ColumnName, "{error}");
    }
    assert_eq!(
        fs::read_dir(folder.path()).unwrap().count(),
        0,
        "nothing is left"
    );
}

/// A file with columns of types that others write.
fn of_other_types(path: &std::path::Path) {
    use ::parquet::{
        data_type::{ByteArray, ByteArrayType, Int32Type, Int64Type},
        file::writer::SerializedFileWriter,
        schema::parser::parse_message_type,
    };
    let schema = "message m {
        required int64 when (TIMESTAMP(MICROS,true));
        required binary i_meas_a (STRING);
        required int32 volts (DECIMAL(9,2));
    }";
    let schema = std::sync::Arc::new(parse_message_type(schema).unwrap());
    let file = fs::File::create(path).unwrap();
    let mut writer = SerializedFileWriter::new(file, schema, Default::default()).unwrap();
    let mut group = writer.next_row_group().unwrap();
    let times = [1_700_000_000_000_001_i64, 1_700_000_000_250_001];
    let mut column = group.next_column().unwrap().unwrap();
    let typed = column.typed::<Int64Type>();
    typed.write_batch(&times, None, None).unwrap();
    column.close().unwrap();
    let mut column = group.next_column().unwrap().unwrap();
    let typed = column.typed::<ByteArrayType>();
    let texts = ["1", "2"].map(ByteArray::from);
    typed.write_batch(&texts, None, None).unwrap();
    column.close().unwrap();
    let mut column = group.next_column().unwrap().unwrap();
    let typed = column.typed::<Int32Type>();
    typed.write_batch(&[1, 2], None, None).unwrap();
    column.close().unwrap();
    group.close().unwrap();
    writer.close().unwrap();
}

#[test]
fn columns_of_other_types_are_there_but_of_no_use() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("r.parquet");
    of_other_types(&path);
    let table = parquet::read(&path).unwrap();
    assert_eq!(table.left_out(), ["i_meas_a (text)", "volts (decimals)"]);
    for (name, found) in [
        (
            "i_meas_a",
            "column 2 (i_meas_a): found text, expected numbers",
        ),
        (
            "volts",
            "column 3 (volts): found decimals, expected numbers",
        ),
    ] {
        let error = table.need(name).unwrap_err().to_string();
        assert!(error.contains(found), "{error}");
    }
    // Moments count from the first one, to the last digit.
    let mapping = Mapping::parse(["t_s=when"]).unwrap();
    let read = convert::recording(&path, &mapping).unwrap();
    assert_eq!(read.time_s(), [0.0, 0.25]);
}

proptest! {
    #[test]
    fn what_is_written_is_read_bit_by_bit(rows in prop::collection::vec((any_number(), any_number()), 1..50)) {
        let table = table(&rows);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out.parquet");
        parquet::write(&path, &table, &mut |_| {}).unwrap();
        let read = parquet::read(&path).unwrap();
        prop_assert!(read.left_out().is_empty());
        prop_assert!(table.names().eq(read.names()));
        for ((_, ours), (_, theirs)) in table.columns().zip(read.columns()) {
            prop_assert_eq!(bits(ours), bits(theirs));
        }
    }

    #[test]
    fn damage_makes_no_panic(
        damage in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..6),
        cut in prop::option::of(any::<prop::sample::Index>()),
    ) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out.parquet");
        parquet::write(&path, &table(&[(0.0, 1.5), (1.0, f64::NAN), (2.0, -3.0)]), &mut |_| {}).unwrap();
        let mut bytes = fs::read(&path).unwrap();
        for (place, byte) in damage {
            let place = place.index(bytes.len());
            bytes[place] = byte;
        }
        if let Some(cut) = cut {
            bytes.truncate(cut.index(bytes.len()));
        }
        match parquet::parse("r.parquet", bytes) {
            Ok(read) => prop_assert!(read.columns().all(|(_, values)| values.len() == read.len())),
            Err(error) => prop_assert!(error.to_string().starts_with("r.parquet")),
        }
    }
}
