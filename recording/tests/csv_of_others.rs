//! CSV as spreadsheets, loggers and test benches write it.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use proptest::prelude::*;
use recording::{Error, Mapping, Table, csv, error::Kind};

fn table(text: &str) -> Result<Table, Error> {
    csv::parse("r.csv", text.as_bytes())
}

fn names(table: &Table) -> Vec<&str> {
    table.names().collect()
}

fn mapped(text: &str, arguments: &[&str]) -> Result<Table, Error> {
    table(text)?.mapped(&Mapping::parse(arguments.iter().copied())?)
}

#[test]
fn lines_about_the_file_stand_above_its_names() {
    for above in [
        "# logger 3\n",
        "# logger 3\n# 2024-03-31\n",
        "Serial,1234\n",
        "Test,US06\nOperator,Meier\n\n",
        "Start;29.03.2026 08:00:00\nRate;100\n",
        "Logger 3,\nSerial,1234\n,\n",
        "Logger;bench 7\nSerial;1234\n\n",
        "Note: a, b, c and d\n",
        "1\n2\n",
    ] {
        for rows in [
            "t_s,i_ref_a\n0,1\n1,2\n",
            "t_s,i_ref_a\n0,\n1,2\n",
            "t_s;i_ref_a\n0,0;1\n1,0;2\n",
        ] {
            let read = table(&format!("{above}{rows}")).unwrap();
            assert_eq!(names(&read), ["t_s", "i_ref_a"], "{above:?}");
            assert_eq!(read.need("i_ref_a").unwrap()[1], 2.0, "{above:?}");
            let lines = above.lines().count() as u64;
            assert_eq!(read.line(0), lines + 2, "{above:?}");
            assert_eq!(
                read.notes(),
                [format!(
                    "the columns' names are in line {}, what stands above them is not read",
                    lines + 1
                )]
            );
        }
    }
}

/// A row that is broken is not taken for a line about the file, whatever follows.
#[test]
fn rows_are_never_passed_over() {
    for text in [
        "t_s,i_ref_a\n0,1,5\nt_s,i_ref_a\n0,1\n",
        "t_s,i_ref_a,i_meas_a\n0,1\nt_s,i_ref_a\n0,1\n",
    ] {
        let error = table(text).unwrap_err();
        assert_eq!(error.kind(), Kind::FieldCount, "{error}");
        assert_eq!(error.place().line, Some(2), "{error}");
    }
    // What is wrong with the names is said of the line that has them.
    let error = table("# logger 3\nt_s,x,x\n0,1,2\n").unwrap_err();
    assert_eq!(
        error.to_string(),
        "r.csv, line 2, column 3: found \"x\" again, expected each name once"
    );
}

#[test]
fn the_separator_is_the_one_that_the_rows_have() {
    let read = table("Time;Current, filtered\n0;1,5\n0,5;2,5\n").unwrap();
    assert_eq!(names(&read), ["Time", "Current, filtered"]);
    assert_eq!(read.need("Time").unwrap(), [0.0, 0.5]);
    // Where both would do, the comma.
    let read = table("t_s,a;b\n0,2\n").unwrap();
    assert_eq!(names(&read), ["t_s", "a;b"]);
}

#[test]
fn separators_after_the_last_column_make_no_column() {
    let read = table("t_s;i_ref_a;\n0;1,5;\n1;2;\n").unwrap();
    assert_eq!(names(&read), ["t_s", "i_ref_a"]);
    let error = table("t_s,i_ref_a,\n0,1,\n1,2,3\n").unwrap_err();
    assert_eq!(
        error.to_string(),
        "r.csv, line 1, column 3: found an empty field, expected a name for each column"
    );
}

#[test]
fn a_line_of_units_says_what_the_numbers_are_in() {
    for text in [
        "t,i_meas_a,U,n,step\nms,mA,[V],rpm,-\n500,1500,3.7,9,1\n1000,,3.8,8,1\n",
        "t;i_meas_a;U;n;step\n(ms);(mA);V;rpm;1\n500;1500;3,7;9;1\n1000;;3,8;8;1\n",
    ] {
        let read = table(text).unwrap();
        assert_eq!(names(&read), ["t_s", "i_meas_a", "U_v", "n", "step"]);
        assert_eq!(read.need("t_s").unwrap(), [0.5, 1.0]);
        let current_a = read.need("i_meas_a").unwrap();
        assert_eq!(current_a[0], 1.5);
        assert!(current_a[1].is_nan());
        assert_eq!(read.need("U").unwrap(), [3.7, 3.8]);
        assert_eq!(read.line(0), 3);
        assert_eq!(
            read.notes(),
            ["in the units of line 2: t / 1000, i_meas_a / 1000"]
        );
        // What they say is done once.
        let read = mapped(text, &["v_cell_v=U", "i_ref_a=-i_meas_a"]).unwrap();
        assert_eq!(read.need("v_cell_v").unwrap(), [3.7, 3.8]);
        assert_eq!(read.need("i_ref_a").unwrap()[0], -1.5);
        assert_eq!(
            mapped(text, &["i_ref_a=U"]).unwrap_err().to_string(),
            "r.csv: found \"U\" in V, expected A, as \"i_ref_a\" ends"
        );
    }
    // Names stay apart.
    let read = table("I,I_a\nmA,A\n1000,2\n").unwrap();
    assert_eq!(names(&read), ["I", "I_a"]);
    assert_eq!(read.need("I").unwrap(), [1.0]);
    // Letters of phases are no units, nor is what is no unit.
    let read = table("phase,t_s\nA,1\nB,2\n").unwrap();
    assert_eq!(read.need("t_s").unwrap(), [1.0, 2.0]);
    let read = table("note,who\nbegin,me\n,\n");
    assert_eq!(read.unwrap_err().place().line, Some(2));
}

#[test]
fn a_name_may_state_its_unit() {
    let text = "Time [min],I (mA),U / V,SOC [%]\n0.5,1500,3.7,50\n";
    let read = mapped(
        text,
        &[
            "t_s=Time [min]",
            "i_ref_a=-I (mA)",
            "v_cell_v=U / V",
            "soc_pct=SOC [%]",
        ],
    )
    .unwrap();
    let first: Vec<f64> = read.columns().map(|(_, values)| values[0]).collect();
    assert_eq!(first, [30.0, -1.5, 3.7, 50.0]);
    assert_eq!(
        read.notes(),
        [
            "t_s is \"Time [min]\" · 60",
            "i_ref_a is \"-I (mA)\" / 1000"
        ]
    );
    let error = mapped(text, &["i_ref_a=U / V"]).unwrap_err();
    assert_eq!(error.kind(), Kind::Mapping);
    assert_eq!(
        error.to_string(),
        "r.csv: found \"U / V\" in V, expected A, as \"i_ref_a\" ends"
    );
    // A name without a unit takes the numbers as they are.
    let plain = mapped(text, &["x=I (mA)"]).unwrap();
    assert_eq!(plain.need("x").unwrap(), [1500.0]);
}

#[test]
fn other_encodings_are_read() {
    let text = "t_s;Temperatur [\u{b0}C];Pr\u{fc}fstrom\r\n0;25,5;1\r\n1;26;2\r\n";
    let utf_16 = |little: bool| -> Vec<u8> {
        let marked = format!("\u{feff}{text}");
        let bytes = |unit: u16| {
            if little {
                unit.to_le_bytes()
            } else {
                unit.to_be_bytes()
            }
        };
        marked.encode_utf16().flat_map(bytes).collect()
    };
    // All of its letters are Latin-1's, which has the numbers of Unicode.
    let windows: Vec<u8> = text
        .chars()
        .map(|letter| u8::try_from(letter).unwrap())
        .collect();
    for (bytes, encoding) in [
        (utf_16(true), Some("UTF-16")),
        (utf_16(false), Some("UTF-16")),
        (windows, Some("Windows-1252")),
        (text.as_bytes().to_vec(), None),
    ] {
        let read = csv::parse("r.csv", &bytes).unwrap();
        assert_eq!(
            names(&read),
            ["t_s", "Temperatur [\u{b0}C]", "Pr\u{fc}fstrom"]
        );
        assert_eq!(read.need("Temperatur [\u{b0}C]").unwrap(), [25.5, 26.0]);
        let said = encoding.map(|encoding| format!("read as {encoding}, for it is not UTF-8"));
        assert_eq!(read.notes(), Vec::from_iter(said));
    }
}

#[test]
fn times_may_be_those_of_clocks_and_calendars() {
    for (texts, expected) in [
        (
            ["08:00:00", "8:00:00.25", "32:00:01"],
            [28_800.0, 28_800.25, 115_201.0],
        ),
        (
            ["23:59:59.5", "00:00:00", "00:00:00.5"],
            [86_399.5, 86_400.0, 86_400.5],
        ),
        (
            [
                "2026-03-29 00:50:00",
                "2026-03-29T00:50:00.125",
                "2026-03-30 00:50",
            ],
            [0.0, 0.125, 86_400.0],
        ),
        (
            ["2026-03-29T00:50:00Z", "2026-03-29T02:50:01+02:00", ""],
            [0.0, 1.0, f64::NAN],
        ),
        (
            [
                "29.03.2026 23:59:59,5",
                "30.03.2026 00:00:00",
                "30.03.2026 00:00:00.5",
            ],
            [0.0, 0.5, 1.0],
        ),
        (
            [
                "2024-02-28 12:00:00",
                "2024-03-01 12:00:00",
                "2024-03-01 12:00:01",
            ],
            [0.0, 172_800.0, 172_801.0],
        ),
    ] {
        let text = format!("t_s;x\n{};1\n{};2\n{};3\n", texts[0], texts[1], texts[2]);
        let read = table(&text).unwrap();
        let times = read.need("t_s").unwrap();
        let same = |(one, other): (&f64, &f64)| one == other || (one.is_nan() && other.is_nan());
        assert!(times.iter().zip(&expected).all(same), "{text}: {times:?}");
    }
    // They are in s whatever the file says of them.
    let read = mapped("Time (h),I\n0:00:30,1\n0:01:00,2\n", &["t_s=Time (h)"]).unwrap();
    assert_eq!(read.need("t_s").unwrap(), [30.0, 60.0]);
    let read = table("t_s,I\nmin,A\n0:00:30,1\n0:01:00,2\n").unwrap();
    assert_eq!(read.need("t_s").unwrap(), [30.0, 60.0]);
    // The first that is there says what they are.
    let read = table("x,t_s\n1,\n2,08:00:00\n").unwrap();
    assert_eq!(read.need("t_s").unwrap()[1], 28_800.0);
    for none in [
        "24:60:00",
        "8:00:60",
        "1:2:3",
        ":00:00",
        "2026-02-30 00:00:00",
        "03/29/2026 08:00:00",
    ] {
        let text = format!("t_s,x\n{none},1\n");
        assert!(table(&text).unwrap().column("t_s").is_none(), "{none}");
    }
}

proptest! {
    /// A head changes what is told, and nothing of the numbers.
    #[test]
    fn numbers_are_those_of_the_plain_file(
        rows in prop::collection::vec((-1e6..1e6_f64, -1e6..1e6_f64), 1..20),
        above in 0..4_usize,
        separator in prop::sample::select(vec![",", ";", "\t"]),
        with_units in any::<bool>(),
        is_utf_16 in any::<bool>(),
    ) {
        let line = |fields: [&str; 2]| format!("{}\r\n", fields.join(separator));
        let body: String = rows
            .iter()
            .map(|(first, second)| line([&first.to_string(), &second.to_string()]))
            .collect();
        let plain = table(&format!("{}{body}", line(["t_s", "i_ref_a"]))).unwrap();
        let units = if with_units { line(["s", "A"]) } else { String::new() };
        let head = "made by a logger\r\n".repeat(above) + &line(["t_s", "i_ref_a"]) + &units;
        let text = format!("{head}{body}");
        let bytes = if is_utf_16 {
            format!("\u{feff}{text}").encode_utf16().flat_map(u16::to_le_bytes).collect()
        } else {
            text.into_bytes()
        };
        let read = csv::parse("r.csv", &bytes).unwrap();
        prop_assert_eq!(names(&read), names(&plain));
        for ((_, ours), (_, theirs)) in read.columns().zip(plain.columns()) {
            prop_assert_eq!(ours, theirs);
        }
    }
}
