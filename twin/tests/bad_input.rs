//! Bad input: one clear sentence that says where, what and what was expected; exit code 2; nothing left behind.

use std::{fs, path::Path, process::Command};

use crate::command::{EXPLAIN, SIMULATE, twin};

const PAIR: &str = "schema = 1\n[sensor]\n";

fn rows(count: usize, mut row: impl FnMut(f64) -> String) -> String {
    (0..count).map(|k| row(k as f64 * 0.1) + "\n").collect()
}

fn current(t: f64) -> f64 {
    10.0 * (0.37 * t).sin() + 3.0 * (1.91 * t).sin() + 1.0
}

fn good() -> String {
    "t_s,i_ref_a,i_meas_a\n".to_owned()
        + &rows(300, |t| format!("{t},{},{}", current(t), current(t) + 0.5))
}

/// Runs a command in a folder with these files; its sentence. Nothing may be left beside them.
fn refused(files: &[(&str, &str)], arguments: &[&str]) -> String {
    let folder = tempfile::tempdir().unwrap();
    for (name, content) in files {
        fs::write(folder.path().join(name), content).unwrap();
    }
    let before = names(folder.path());
    let output = twin(folder.path(), arguments);
    let sentence = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{sentence}");
    assert!(output.stdout.is_empty());
    assert_eq!(names(folder.path()), before);
    assert!(sentence.starts_with("error: "), "{sentence}");
    assert_eq!(sentence.trim_end().lines().count(), 1, "{sentence}");
    sentence
}

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    names
}

fn explain_with<'a>(more: &[&'a str]) -> Vec<&'a str> {
    EXPLAIN.iter().chain(more).copied().collect()
}

fn explained(model: &str, recording: &str) -> String {
    refused(&[("m.toml", model), ("r.csv", recording)], &EXPLAIN)
}

fn says(sentence: &str, parts: &[&str]) {
    for part in parts {
        assert!(sentence.contains(part), "no {part} in: {sentence}");
    }
}

#[test]
fn two_units() {
    let recording = "t_s,i_ref_a,i_meas_a\n".to_owned()
        + &rows(300, |t| {
            format!("{t},{},{}", 1000.0 * current(t), current(t))
        });
    says(
        &explained(PAIR, &recording),
        &[
            "r.csv: ",
            "i_ref_a",
            "i_meas_a",
            "factor near 1000",
            "same unit",
        ],
    );
    let recording = "t_s,i_ref_a,i_meas_a\n".to_owned()
        + &rows(300, |t| format!("{t},{},{}", current(t), 1e6 * current(t)));
    says(&explained(PAIR, &recording), &["factor near 1000000"]);
}

#[test]
fn text_where_numbers_are_needed() {
    // A note is nobody's concern, what the model uses is.
    let noted = |name: &str| {
        format!("t_s,i_ref_a,i_meas_a,{name}\n")
            + &rows(300, |t| {
                format!("{t},{},{},on", current(t), current(t) + 0.5)
            })
    };
    says(
        &explained(PAIR, &noted("temp_sensor_c")),
        &["r.csv, line 2, column 4 (temp_sensor_c): found \"on\""],
    );
    let text = good().replacen(&format!("{}", current(0.0)), "1,0 A", 1);
    assert!(text.contains("1,0 A"));
    says(&explained(PAIR, &text), &["r.csv, line 2"]);
}

#[test]
fn a_time_that_stands_still() {
    let recording = "t_s,i_ref_a,i_meas_a\n".to_owned()
        + &rows(300, |t| format!("5,{},{}", current(t), current(t) + 0.5));
    says(
        &explained(PAIR, &recording),
        &["r.csv, column t_s", "found 5 in every row", "goes on"],
    );
}

#[test]
fn a_clock_that_no_clock_is() {
    let recorded = |kind: &str| {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../recordings/gpu-power-sensor");
        fs::read_to_string(folder.join(format!("rtx3090-5050-{kind}.csv"))).unwrap()
    };
    // The reference's time in ms.
    let reference = recorded("reference");
    let (header, lines) = reference.split_once('\n').unwrap();
    let mut in_ms = format!("{header}\n");
    for line in lines.lines() {
        let (t_s, rest) = line.split_once(',').unwrap();
        let t_ms = 1000.0 * t_s.parse::<f64>().unwrap();
        in_ms.push_str(&format!("{t_ms},{rest}\n"));
    }
    let sentence = refused(
        &[
            ("m.toml", PAIR),
            ("r.csv", &recorded("sensor")),
            ("ref.csv", &in_ms),
        ],
        &explain_with(&["--reference", "ref.csv"]),
    );
    says(
        &sentence,
        &[
            "ref.csv and r.csv",
            "clocks that differ in rate by",
            "unit of time",
        ],
    );
}

#[test]
fn a_reference_that_is_loosely_opposite() {
    // Half of the reading is something else: its sign alone is not what is wrong.
    let other = |t: f64| 9.0 * (0.83 * t + 1.0).sin();
    let recording = "t_s,i_ref_a,i_meas_a\n".to_owned()
        + &rows(300, |t| {
            format!("{t},{},{}", current(t), other(t) - current(t))
        });
    let sentence = explained(PAIR, &recording);
    says(&sentence, &["r.csv", "only loosely", "of the same run"]);
    assert!(!sentence.contains("--map"), "{sentence}");
}

/// Something that does not repeat itself.
fn slow(t: f64) -> f64 {
    let steps = [3.0, -2.0, 7.0, 0.5, -6.0, 9.0, 1.0, -4.0, 5.0, 2.5];
    steps[(t / 7.3) as usize % 10] + 4.0 * (0.0009 * t * t).sin() + (0.37 * t).sin()
}

#[test]
fn a_log_is_no_recording_yet() {
    for (name, content) in [
        ("x.mf4", "MDF     4.10    "),
        ("x.blf", "LOGG"),
        ("x.log", "(1436509052.249713) can0 123#00\n"),
        ("x.asc", "date Fri\nbase hex\n"),
    ] {
        let sentence = refused(
            &[("m.toml", PAIR), (name, content)],
            &[
                "explain",
                "--model",
                "m.toml",
                "--recording",
                name,
                "--out",
                "out",
            ],
        );
        says(&sentence, &[name, "found a log", "twin convert"]);
    }
}

#[test]
fn a_place_that_cannot_be_written_is_known_before_the_work() {
    // What is read first has a fault too: the place is looked at before.
    for (command, out, part) in [
        ("simulate", "no/such/x.csv", "no folder \"no/such\""),
        ("explain", "m.toml/out", "m.toml/out"),
    ] {
        let sentence = refused(
            &[("m.toml", PAIR), ("r.csv", "bad")],
            &[
                command,
                "--model",
                "m.toml",
                "--recording",
                "r.csv",
                "--out",
                out,
            ],
        );
        says(&sentence, &[part]);
        assert!(!sentence.contains(".part"), "{sentence}");
    }
}

#[test]
fn a_hold_out_needs_its_own_reference() {
    let sensor = "t_s,i_meas_a\n".to_owned() + &rows(3000, |t| format!("{t},{}", slow(t) + 0.5));
    let reference = "t_s,i_ref_a\n".to_owned() + &rows(3000, |t| format!("{t},{}", slow(t)));
    let sentence = refused(
        &[
            ("m.toml", PAIR),
            ("r.csv", &sensor),
            ("ref.csv", &reference),
            ("other.csv", &sensor),
        ],
        &explain_with(&["--reference", "ref.csv", "--holdout", "other.csv"]),
    );
    says(
        &sentence,
        &[
            "other.csv",
            "i_ref_a",
            "--reference belongs to --recording alone",
        ],
    );
}

#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_behind_the_standard_output() {
    let full = || fs::File::options().write(true).open("/dev/full").unwrap();
    let output = Command::new(env!("CARGO_BIN_EXE_twin"))
        .arg("effects")
        .stdout(full())
        .output()
        .unwrap();
    let sentence = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{sentence}");
    says(&sentence, &["error: standard output: found"]);
}

#[test]
fn opposite_signs() {
    let recording = "t_s,i_ref_a,i_meas_a\n".to_owned()
        + &rows(300, |t| format!("{t},{},{}", current(t), -current(t)));
    let sentence = explained(PAIR, &recording);
    says(
        &sentence,
        &[
            "r.csv: i_meas_a falls where i_ref_a rises",
            "--map i_meas_a=-i_meas_a",
        ],
    );
}

#[test]
fn the_proposed_mapping_is_taken() {
    let folder = tempfile::tempdir().unwrap();
    let recording = "t_s,i_ref_a,i_meas_a\n".to_owned()
        + &rows(300, |t| format!("{t},{},{}", current(t), -current(t)));
    fs::write(folder.path().join("m.toml"), PAIR).unwrap();
    fs::write(folder.path().join("r.csv"), recording).unwrap();
    let map = ["--map", "i_meas_a=-i_meas_a"];
    let output = twin(folder.path(), &[&SIMULATE[..], &map].concat());
    assert_eq!(output.status.code(), Some(0), "{output:?}");
}

#[test]
fn a_sign_is_turned_of_the_column_that_the_file_has() {
    for (map, cure) in [
        ("i_meas_a=Sensor.I", "--map i_meas_a=-Sensor.I"),
        ("i_meas_a=-Sensor.I", "--map i_meas_a=Sensor.I"),
    ] {
        let sign = if map.contains('-') { 1.0 } else { -1.0 };
        let sensor = "t_s,i_ref_a,Sensor.I\n".to_owned()
            + &rows(300, |t| format!("{t},{},{}", current(t), sign * current(t)));
        let sentence = refused(
            &[("m.toml", PAIR), ("r.csv", &sensor)],
            &explain_with(&["--map", map]),
        );
        assert!(sentence.trim_end().ends_with(cure), "{sentence}");
    }
    let counter = counted(-1.0).replace("q_meas_c", "Board.Charge");
    let sentence = refused(
        &[("m.toml", COUNTED), ("r.csv", &counter)],
        &explain_with(&["--map", "q_meas_c=Board.Charge"]),
    );
    says(&sentence, &["--map q_meas_c=-Board.Charge"]);
    // The current of a battery, named in the model file.
    let battery = "schema = 1\n[columns]\ni_ref_a = \"Shunt\"\n[battery]\ncapacity_ah = 2\nocv = [[0, 3.0], [1, 4.0]]\n\
                   ohmic_resistance_ohm = 0.1\n";
    let recording = "t_s,Shunt,v_cell_v\n".to_owned()
        + &rows(300, |t| {
            format!("{t},{},{}", current(t), 3.7 + 0.1 * current(t))
        });
    says(&explained(battery, &recording), &["--map i_ref_a=-Shunt"]);
}

/// A file that was never fitted shows what was fitted, or nothing.
#[test]
fn a_hold_out_without_what_is_fitted() {
    let battery = "schema = 1\n[sensor]\n[battery]\ncapacity_ah = 2\ncells = 4\nocv = [[0, 3.0], [1, 4.0]]\nohmic_resistance_ohm = 0.01\n";
    let recording = |name: &str, cells: f64, seed: f64| {
        format!("t_s,i_ref_a,{name}\n")
            + &rows(300, |t| {
                let noise = 0.001 * (seed + 7919.0 * t * t).sin();
                format!(
                    "{t},{},{}",
                    current(t),
                    cells * (3.7 - 0.01 * current(t) + noise)
                )
            })
    };
    let files = [
        ("m.toml", battery),
        ("r.csv", &recording("v_cell_v", 1.0, 0.0)),
        ("other.csv", &recording("v_pack_v", 4.0, 1.0)),
    ];
    says(
        &refused(&files, &explain_with(&["--holdout", "other.csv"])),
        &[
            "other.csv: found v_pack_v to compare",
            "expected the column v_cell_v",
            "fitted in r.csv",
        ],
    );
    // Something of it is there: that is shown, and what is not is said.
    let both = |seed: f64, more: bool| {
        let header = if more {
            "t_s,i_ref_a,i_meas_a,v_cell_v\n"
        } else {
            "t_s,i_ref_a,i_meas_a,v_pack_v\n"
        };
        let cells = if more { 1.0 } else { 4.0 };
        header.to_owned()
            + &rows(300, |t| {
                let noise = 0.001 * (seed + 7919.0 * t * t).sin();
                let volts = cells * (3.7 - 0.01 * current(t) + noise);
                format!("{t},{},{},{volts}", current(t), current(t) + 0.5 + noise)
            })
    };
    let files = [
        ("m.toml", battery),
        ("r.csv", &both(0.0, true)),
        ("other.csv", &both(1.0, false)),
    ];
    let said = report(&files, &["--holdout", "other.csv"]);
    says(
        &said["remarks"].to_string(),
        &["other.csv: v_cell_v is not compared there"],
    );
    assert_eq!(said["holdouts"][0]["signal"], "i_meas_a");
}

#[test]
fn a_reference_of_another_time() {
    // In one file: the reference ends before the sensor begins.
    let recording = "t_s,i_ref_a,i_meas_a\n".to_owned()
        + &rows(300, |t| format!("{t},{},", current(t)))
        + &rows(300, |t| format!("{},,{}", t + 100.0, current(t)));
    says(
        &explained(PAIR, &recording),
        &["i_meas_a", "100 … 129.9 s", "0 … 29.9 s", "same time"],
    );
    // In two files: nothing in common. The second is no shifted or scaled copy of the first.
    let reference =
        "t_s,i_ref_a\n".to_owned() + &rows(600, |t| format!("{t},{}", (0.05 * t * t).sin()));
    let mut state = 1_u32;
    let mut noise = move || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        f64::from(state >> 8) / f64::from(1 << 24)
    };
    let sensor =
        "t_s,i_meas_a\n".to_owned() + &rows(600, |t| format!("{},{}", t + 5000.0, noise()));
    let sentence = refused(
        &[
            ("m.toml", PAIR),
            ("r.csv", &sensor),
            ("ref.csv", &reference),
        ],
        &explain_with(&["--reference", "ref.csv"]),
    );
    says(&sentence, &["ref.csv", "r.csv", "overlap in time"]);
}

#[test]
fn a_column_that_never_moves() {
    let recording =
        "t_s,i_ref_a,i_meas_a\n".to_owned() + &rows(300, |t| format!("{t},{},3.5", current(t)));
    says(
        &explained(PAIR, &recording),
        &["r.csv", "i_meas_a", "3.5 in every row", "moves"],
    );
    let recording =
        "t_s,i_ref_a,i_meas_a\n".to_owned() + &rows(300, |t| format!("{t},2,{}", current(t)));
    says(
        &explained(PAIR, &recording),
        &["r.csv", "i_ref_a", "2 in every row"],
    );
    let recording =
        "t_s,i_ref_a,i_meas_a\n".to_owned() + &rows(300, |t| format!("{t},{},", current(t)));
    says(
        &explained(PAIR, &recording),
        &["r.csv", "i_meas_a", "no value"],
    );
}

#[test]
fn too_few_rows() {
    let recording = "t_s,i_ref_a,i_meas_a\n".to_owned()
        + &rows(20, |t| format!("{t},{},{}", current(t), current(t) + 0.5));
    says(
        &explained(PAIR, &recording),
        &["r.csv", "i_meas_a", "20 readings", "at least 50"],
    );
}

#[test]
fn an_unknown_key() {
    let sentence = explained("schema = 1\n[sensor]\nfullscale = 600\n", &good());
    says(&sentence, &["m.toml, line 3", "fullscale", "`full_scale`"]);
}

#[test]
fn what_is_no_word_where_one_of_a_list_is_needed() {
    for (model, key, words) in [
        (
            "[sensor]\nfront_end = 1",
            "front_end",
            ["pair", "dual-range"],
        ),
        (
            "[battery]\ncurrent_holds = 1",
            "current_holds",
            ["since-last-row", "until-next-row"],
        ),
    ] {
        let model = |value: &str| format!("schema = 1\n{}", model.replace('1', value));
        for (value, found) in [("1", "integer `1`"), ("true", "boolean `true`")] {
            says(
                &explained(&model(value), &good()),
                &["m.toml", "line 3", key, found, "text in quotes"],
            );
        }
        let unknown = explained(&model("\"hold\""), &good());
        says(&unknown, &["m.toml", "line 3", key, "`hold`"]);
        says(&unknown, &words);
    }
}

#[test]
fn a_missing_column() {
    let recording = good().replacen("i_meas_a", "board", 1);
    says(
        &explained(PAIR, &recording),
        &["r.csv", "t_s, i_ref_a, board", "i_meas_a"],
    );
    let recording = good().replacen("i_ref_a", "shunt", 1);
    says(&explained(PAIR, &recording), &["r.csv", "shunt", "i_ref_a"]);
    let battery = "schema = 1\n[battery]\ncapacity_ah = 2\nocv = [[0, 3.0], [1, 4.0]]\n";
    says(
        &explained(battery, &good()),
        &["r.csv", "soc_pct, v_cell_v or v_pack_v", "--map"],
    );
}

#[test]
fn a_battery_in_other_units_or_signs() {
    let battery = "schema = 1\n[battery]\ncapacity_ah = 2\nocv = [[0, 3.0], [1, 4.0]]\nohmic_resistance_ohm = 0.1\n";
    let recording = |volts: &dyn Fn(f64) -> f64| {
        "t_s,i_ref_a,v_cell_v\n".to_owned()
            + &rows(300, |t| format!("{t},{},{}", current(t), volts(current(t))))
    };
    says(
        &explained(battery, &recording(&|i| 3700.0 - 100.0 * i)),
        &["r.csv, column v_cell_v", "10^3", "expected V"],
    );
    let sentence = explained(battery, &recording(&|i| 3.7 + 0.1 * i));
    says(
        &sentence,
        &[
            "r.csv: v_cell_v rises where i_ref_a rises",
            "--map i_ref_a=-i_ref_a",
        ],
    );
    let recording = "t_s,i_ref_a,soc_pct\n".to_owned()
        + &rows(300, |t| format!("{t},{},{}", current(t), 0.9 - 1e-3 * t));
    says(
        &explained(battery, &recording),
        &["r.csv, column soc_pct", "per cent"],
    );
}

#[test]
fn files_that_are_not_there_and_effects_that_do_not_exist() {
    let files: [(&str, &str); 2] = [("m.toml", PAIR), ("r.csv", &good())];
    let base = [
        "explain",
        "--model",
        "m.toml",
        "--recording",
        "r.csv",
        "--out",
    ];
    let with =
        |more: &[&'static str]| -> Vec<&'static str> { base.iter().chain(more).copied().collect() };
    says(
        &refused(&files, &with(&["out", "--without", "ofset"])),
        &["ofset", "offset, gain"],
    );
    says(&refused(&files, &with(&["m.toml"])), &["m.toml", "folder"]);
    says(
        &refused(&files, &with(&["out", "--holdout", "no.csv"])),
        &["no.csv", "no such file"],
    );
    says(
        &refused(&files, &with(&["out", "--map", "i_ref_a=shunt"])),
        &["shunt"],
    );
    let with = |from: &str, to: &'static str| {
        SIMULATE.map(|argument| if argument == from { to } else { argument })
    };
    let simulate = with("m.toml", "no.toml");
    says(&refused(&files, &simulate), &["no.toml", "no such file"]);
    let simulate = with("s.csv", "s.txt");
    says(&refused(&files, &simulate), &["s.txt", ".csv or .parquet"]);
}

#[test]
fn an_implausible_reference_is_said_to_be_one() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(
        folder.path().join("m.toml"),
        "schema = 1\n[sensor]\nfull_scale = 15\n",
    )
    .unwrap();
    let recording = "t_s,i_ref_a,i_meas_a\n".to_owned()
        + &rows(400, |t| {
            // Stuck for 6 s, with one spike.
            let reference = match t {
                t if (10.0..16.0).contains(&t) => 2.0,
                t if (t - 25.0).abs() < 0.01 => 90.0,
                t => current(t),
            };
            format!("{t},{reference},{}", current(t))
        });
    fs::write(folder.path().join("r.csv"), recording).unwrap();
    let output = twin(folder.path(), &EXPLAIN);
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let report = fs::read_to_string(folder.path().join("out/report.json")).unwrap();
    says(
        &report,
        &["stands at 2", "jumps there and back", "full scale of 15"],
    );
    let mut written = names(&folder.path().join("out"));
    written.sort();
    assert_eq!(written, ["model.toml", "report.html", "report.json"]);
}

/// The report of a run that goes well.
fn report(files: &[(&str, &str)], arguments: &[&str]) -> serde_json::Value {
    let folder = tempfile::tempdir().unwrap();
    for (name, content) in files {
        fs::write(folder.path().join(name), content).unwrap();
    }
    let output = twin(folder.path(), &explain_with(arguments));
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let report = fs::read_to_string(folder.path().join("out/report.json")).unwrap();
    serde_json::from_str(&report).unwrap()
}

#[test]
fn a_file_that_is_read_is_not_written() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    fs::create_dir(path("out")).unwrap();
    let files = [
        ("out/model.toml", PAIR.to_owned()),
        ("out/report.json", good()),
        ("r.csv", good()),
        (
            "b.toml",
            "schema = 1\n[battery]\ncapacity_ah = 2\nocv_file = \"ocv.csv\"\n".to_owned(),
        ),
        ("ocv.csv", "soc,ocv_v\n0,3\n1,4\n".to_owned()),
    ];
    for (name, content) in &files {
        fs::write(path(name), content).unwrap();
    }
    #[cfg(unix)]
    std::os::unix::fs::symlink("r.csv", path("link.csv")).unwrap();
    #[cfg(not(unix))]
    fs::write(path("link.csv"), good()).unwrap();
    let simulate = ["simulate", "--model", "out/model.toml", "--recording"];
    let explain = ["explain", "--out", "out", "--recording", "r.csv", "--model"];
    let cases: [(&[&str], &[&str], &str); 6] = [
        (
            &simulate,
            &["r.csv", "--out", "./out/../r.csv"],
            "--recording",
        ),
        (&simulate, &["link.csv", "--out", "r.csv"], "--recording"),
        (
            &["simulate", "--model", "b.toml"],
            &["--recording", "r.csv", "--out", "ocv.csv"],
            "ocv_file",
        ),
        (&["convert", "r.csv"], &["--out", "r.csv"], "IN"),
        (&explain, &["out/model.toml"], "--model"),
        (
            &explain,
            &["b.toml", "--holdout", "out/report.json"],
            "--holdout",
        ),
    ];
    for (first, rest, argument) in cases {
        let output = twin(folder.path(), &[first, rest].concat());
        let sentence = String::from_utf8(output.stderr).unwrap();
        if cfg!(unix) || !first.contains(&"link.csv") {
            assert_eq!(output.status.code(), Some(2), "{rest:?} {sentence}");
            says(&sentence, &["found the file that is read as", argument]);
        }
        for (name, content) in &files {
            assert_eq!(fs::read_to_string(path(name)).unwrap(), *content, "{name}");
        }
    }
}

#[test]
fn a_hold_out_that_was_fitted() {
    let files = [("m.toml", PAIR), ("r.csv", &good()), ("copy.csv", &good())];
    let arguments = explain_with(&["--holdout", "copy.csv"]);
    says(
        &refused(&files, &arguments),
        &[
            "copy.csv, column i_meas_a",
            "readings of r.csv",
            "never fitted",
        ],
    );
    // Its clock counts from elsewhere, and it was written with fewer digits.
    let origin = 1.7e9;
    let shifted = "t_s,i_ref_a,i_meas_a\n".to_owned()
        + &rows(300, |t| {
            format!("{:.3},{},{}", t + origin, current(t), current(t) + 0.5)
        });
    let files = [("m.toml", PAIR), ("r.csv", &good()), ("copy.csv", &shifted)];
    says(
        &refused(&files, &arguments),
        &["copy.csv, column i_meas_a", "readings of r.csv"],
    );
    // Of the same drive, read anew.
    let other = "t_s,i_ref_a,i_meas_a\n".to_owned()
        + &rows(300, |t| format!("{t},{},{}", current(t), current(t) + 0.51));
    let files = [("m.toml", PAIR), ("r.csv", &good()), ("copy.csv", &other)];
    report(&files, &["--holdout", "copy.csv"]);
}

#[test]
fn a_column_compared_with_itself() {
    let model = "schema = 1\n[sensor]\nreference = \"i_ref_a\"\nmeasured = \"i_ref_a\"\n";
    says(
        &explained(model, &good()),
        &["r.csv", "i_ref_a", "expected two columns"],
    );
    let model =
        "schema = 1\n[columns]\ni_ref_a = \"i_meas_a\"\ni_meas_a = \"-i_meas_a\"\n[sensor]\n";
    says(
        &explained(model, &good()),
        &["r.csv", "i_meas_a", "expected two columns"],
    );
}

#[test]
fn a_column_without_a_name_and_a_file_without_a_version_have_their_place() {
    for name in ["\"\"", "\" \"", "\"-\""] {
        let model = format!("schema = 1\n[sensor]\n\n[columns]\ni_meas_a = {name}\n");
        assert_eq!(
            explained(&model, &good()).trim_end(),
            format!(
                "error: m.toml, line 5, key columns.i_meas_a: found {name}, expected the name of a column, \
                 or a minus and its name"
            )
        );
    }
    assert_eq!(
        explained("[sensor]\n", &good()).trim_end(),
        "error: m.toml, key schema: found none, expected schema = 1, the version of the format that is read here"
    );
}

#[test]
fn what_is_not_compared_is_said() {
    let model =
        "schema = 1\n[sensor]\n[charge]\n[battery]\ncapacity_ah = 2\nocv = [[0, 3.0], [1, 4.0]]\n";
    let said = report(&[("m.toml", model), ("r.csv", &good())], &[]);
    says(
        &said["remarks"].to_string(),
        &[
            "[charge] is not compared: no column q_meas_c in r.csv",
            "[battery] is not compared: no column soc_pct, v_cell_v or v_pack_v in r.csv",
        ],
    );
    let said = report(&[("m.toml", PAIR), ("r.csv", &good())], &[]);
    assert_eq!(said["remarks"].to_string(), "[]");
}

#[test]
fn a_pack_beside_one_cell() {
    let recording = |name: &str| {
        format!("t_s,i_ref_a,{name}\n")
            + &rows(300, |t| {
                format!("{t},{},{}", current(t), 96.0 * (3.7 - 0.01 * current(t)))
            })
    };
    let battery = "schema = 1\n[battery]\ncapacity_ah = 2\nocv = [[0, 3.0], [1, 4.0]]\n";
    says(
        &explained(battery, &recording("v_cell_v")),
        &[
            "r.csv, column v_cell_v",
            "3.0000 … 4.0000 V",
            "v_pack_v, with cells",
        ],
    );
    says(
        &explained(battery, &recording("v_pack_v")),
        &["r.csv, column v_pack_v", "cells = 1 in [battery]"],
    );
    // Beyond the table, but one cell.
    let battery = format!("{battery}cells = 96\nohmic_resistance_ohm = 0.01\n");
    report(
        &[("m.toml", &battery), ("r.csv", &recording("v_pack_v"))],
        &[],
    );
}

#[test]
fn single_readings_that_are_wild_are_said() {
    let recording = "t_s,i_ref_a,i_meas_a\n".to_owned()
        + &rows(400, |t| {
            let reading = match (t * 10.0).round() as i32 {
                77 => 1e6,
                200..=202 => -3e5,
                _ => current(t),
            };
            format!("{t},{},{reading}", current(t))
        });
    let said = report(&[("m.toml", PAIR), ("r.csv", &recording)], &[]);
    let remarks = said["remarks"].to_string();
    says(
        &remarks,
        &[
            "i_meas_a jumps there and back within 3 rows in 2 places",
            "the first at 7.7 s: 1000000",
        ],
    );
    assert!(!remarks.contains("another conductor"), "{remarks}");
}

#[test]
fn a_number_that_is_no_reading() {
    // Whatever the column: what is simulated depends on it.
    let recording = |place: usize, value: &str| {
        "t_s,i_ref_a,i_meas_a,temp_sensor_c\n".to_owned()
            + &rows(300, |t| {
                let mut fields = [t, current(t), current(t) + 0.5, 20.0].map(|x| x.to_string());
                if (t * 10.0).round() == 100.0 {
                    value.clone_into(&mut fields[place]);
                }
                fields.join(",")
            })
    };
    for (place, name) in [(1, "i_ref_a"), (2, "i_meas_a"), (3, "temp_sensor_c")] {
        for (value, shown) in [("1e300", "1e300"), ("-3.4e38", "-3.4e38")] {
            let sentence = explained(PAIR, &recording(place, value));
            let at = format!("r.csv, line 102, column {} ({name})", place + 1);
            says(
                &sentence,
                &[
                    &format!("{at}: found {shown}, expected a reading, less than 1000000000000"),
                    "an empty field where nothing was measured",
                ],
            );
        }
    }
    // No message has hundreds of digits.
    for (model, recording, part) in [
        (PAIR, recording(0, "1e300"), "the last row's 1e300 s"),
        (
            "schema = 1\n[battery]\ncapacity_ah = -1e300\n",
            good(),
            "found -1e300, expected a capacity",
        ),
        (
            PAIR,
            "t_s,i_ref_a,i_meas_a\n".to_owned()
                + &rows(300, |t| format!("{t},{},1e-300", current(t))),
            "found 1e-300 in every row",
        ),
    ] {
        let sentence = explained(model, &recording);
        says(&sentence, &[part]);
        assert!(sentence.len() < 250, "{sentence}");
    }
    // A column that nothing is said about may hold what it likes.
    let noted = "t_s,i_ref_a,i_meas_a,serial\n".to_owned()
        + &rows(300, |t| {
            format!("{t},{},{},1e18", current(t), current(t) + 0.5)
        });
    report(&[("m.toml", PAIR), ("r.csv", &noted)], &[]);
}

#[test]
fn a_counter_with_too_few_readings_is_put_aside() {
    let model = "schema = 1\n[sensor]\nnoise = 0.1\n[charge]\n";
    let recording = |measured: bool, every: usize, most: usize| {
        let mut k = 0;
        "t_s,i_ref_a,i_meas_a,q_meas_c\n".to_owned()
            + &rows(1200, |t| {
                k += 1;
                let charge = 10.0 / 0.37 * (1.0 - (0.37 * t).cos());
                let told = k % every == 0 && k / every <= most;
                format!(
                    "{t},{},{},{}",
                    current(t),
                    if measured {
                        (current(t) + 0.5).to_string()
                    } else {
                        String::new()
                    },
                    if told {
                        charge.to_string()
                    } else {
                        String::new()
                    }
                )
            })
    };
    for (every, most) in [(28, 42), (1, 0), (5, 1), (5, 2)] {
        let files = [("m.toml", model), ("r.csv", &recording(true, every, most))];
        let said = report(&files, &[]);
        says(
            &said["remarks"].to_string(),
            &[
                "[charge] is not compared: q_meas_c has ",
                "in r.csv, expected at least 50",
            ],
        );
        assert_eq!(said["effects"][0]["id"], "offset");
        let signals = said["signals"].as_array().unwrap();
        assert_eq!(signals.len(), 1, "{signals:?}");
    }
    // With nothing beside it, it is refused.
    let alone = recording(true, 28, 42).replace("i_meas_a", "other");
    says(
        &explained(model, &alone),
        &["r.csv, column q_meas_c: found ", "expected at least 50"],
    );
}

const COUNTED: &str = "schema = 1\n[sensor]\nnoise = 0.1\n[charge]\n";

/// A sensor with a counter that shows `factor` times the charge, set anew in the middle.
fn counted(factor: f64) -> String {
    // What current() comes to since 0 s.
    let charge = |t: f64| {
        let swings = |t: f64| -10.0 / 0.37 * (0.37 * t).cos() - 3.0 / 1.91 * (1.91 * t).cos() + t;
        swings(t) - swings(if t < 60.0 { 0.0 } else { 60.0 })
    };
    "t_s,i_ref_a,i_meas_a,q_meas_c\n".to_owned()
        + &rows(1200, |t| {
            let noise = 0.1 * (77.7 * t).sin();
            format!(
                "{t},{},{},{}",
                current(t),
                current(t) + noise,
                factor * charge(t)
            )
        })
}

#[test]
fn a_charge_in_another_unit_or_sign() {
    for (factor, unit) in [(1.0 / 3600.0, "in Ah"), (1e3, "in thousandths of C")] {
        says(
            &explained(COUNTED, &counted(factor)),
            &["r.csv, column q_meas_c: found", "expected C", unit],
        );
    }
    says(
        &explained(COUNTED, &counted(-1.0)),
        &[
            "q_meas_c falls where",
            "opposite signs",
            "--map q_meas_c=-q_meas_c",
        ],
    );
    // A counter that is wrong is one all the same.
    for factor in [1.0, 2.0] {
        let said = report(&[("m.toml", COUNTED), ("r.csv", &counted(factor))], &[]);
        assert!(
            said["remarks"]
                .to_string()
                .contains("set anew once, where a new stretch begins")
        );
    }
}

#[test]
fn surroundings_in_another_unit() {
    for (name, value, expected) in [
        (
            "temp_sensor_c",
            297.0,
            "°C, -60 … 200 (it may be in kelvin)",
        ),
        ("temp_cell_c", 297.0, "kelvin"),
        ("v_supply_v", 5000.0, "V, 0 … 100 (it may be in mV)"),
    ] {
        let recording = format!("t_s,i_ref_a,i_meas_a,{name}\n")
            + &rows(300, |t| {
                format!("{t},{},{},{}", current(t), current(t) + 0.5, value + t)
            });
        says(
            &explained(PAIR, &recording),
            &[&format!("r.csv, column {name}: found {value} … "), expected],
        );
        // A row that can be makes the others faults of single rows.
        let once = recording.replacen(&format!(",{value}\n"), ",20\n", 1);
        let said = report(&[("m.toml", PAIR), ("r.csv", &once)], &[]);
        says(
            &said["remarks"].to_string(),
            &[
                &format!("{name} is outside "),
                " in 299 of 300 rows of r.csv, with 20 … ",
                "it may be in ",
            ],
        );
    }
}

#[test]
fn a_time_in_ms() {
    let with = |from: f64, step: f64| {
        "t_s,i_ref_a,i_meas_a\n".to_owned()
            + &rows(300, |t| {
                let at = from + (10.0 * t * step).round();
                format!("{at},{},{}", current(t), current(t) + 0.5)
            })
    };
    says(
        &explained(PAIR, &with(1.7e12, 100.0)),
        &["r.csv, column t_s: found a time of 1700000000000, expected s"],
    );
    let remarks = |from, step| {
        let said = report(&[("m.toml", PAIR), ("r.csv", &with(from, step))], &[]);
        said["remarks"].to_string()
    };
    says(&remarks(0.0, 100.0), &["100 s apart", "if that is in ms"]);
    // A row a second since 1970, and a row a minute.
    for (from, step) in [(1.7e9, 1.0), (0.0, 60.0)] {
        assert_eq!(remarks(from, step), "[]");
    }
}

#[test]
fn a_current_that_no_cell_survives() {
    let battery = |ohm: f64| {
        format!(
            "schema = 1\n[battery]\ncapacity_ah = 50\ninitial_soc = 0.5\nohmic_resistance_ohm = {ohm}\nocv = [[0, 3.0], [1, 4.0]]\n"
        )
    };
    let recording = |factor: f64| {
        "t_s,i_ref_a,v_cell_v\n".to_owned()
            + &rows(300, |t| {
                format!("{t},{},{}", factor * current(t), 3.5 - 0.0015 * current(t))
            })
    };
    for (ohm, factor) in [(0.0015, 1000.0), (1.5, 1.0)] {
        says(
            &explained(&battery(ohm), &recording(factor)),
            &[
                "column i_ref_a: found currents up to",
                "ohmic_resistance_ohm",
                "more than the open-circuit voltage",
            ],
        );
    }
    report(
        &[("m.toml", &battery(0.0015)), ("r.csv", &recording(1.0))],
        &[],
    );
}

#[test]
fn a_reading_that_is_scaled_is_said() {
    let remarks = |factor: f64| {
        let recording = "t_s,i_ref_a,i_meas_a\n".to_owned()
            + &rows(300, |t| {
                format!("{t},{},{}", current(t), factor * current(t) + 0.5)
            });
        report(&[("m.toml", PAIR), ("r.csv", &recording)], &[])["remarks"].to_string()
    };
    says(
        &remarks(100.0),
        &["a factor of 100", "may be scaled, or in another unit"],
    );
    assert_eq!(remarks(2.0), "[]");
}

#[test]
fn ranges_without_a_flag_are_said() {
    let model = "schema = 1\n[sensor]\nrange_limit = 5\n";
    let said = report(&[("m.toml", model), ("r.csv", &good())], &[]);
    says(
        &said["remarks"].to_string(),
        &[
            "r.csv has no column range_high",
            "range-mismatch and range-handover",
        ],
    );
}

type Course<'a> = &'a dyn Fn(f64) -> f64;

#[test]
fn a_reference_that_stands_is_not_at_fault() {
    // The car stands for half a minute; a dead sensor reads its noise; the sensor comes to rest slowly, or settles behind a step.
    let noise = |t: f64| ((12.9898 * t).sin() * 43_758.547).fract();
    let stands = |at: f64| {
        move |t: f64| {
            if (10.0..40.0).contains(&t) {
                at
            } else {
                current(t)
            }
        }
    };
    let slowly = |t: f64| current(t.min(10.0)) * (1.0 - 0.03 * (t - 10.0).max(0.0)).max(0.0);
    let behind_a_lag = |t: f64| {
        let settling = 2.1 + 14.0 * (-(t - 10.0) / 8.0).exp();
        0.3 * noise(t) + if t < 10.0 { current(t) } else { settling }
    };
    let cases: [(Course<'_>, Course<'_>); 4] = [
        (&stands(2.0), &behind_a_lag),
        (&stands(0.0), &noise),
        (&stands(2.0), &noise),
        (&stands(0.0), &slowly),
    ];
    for (reference, reading) in cases {
        let recording = "t_s,i_ref_a,i_meas_a\n".to_owned()
            + &rows(600, |t| format!("{t},{},{}", reference(t), reading(t)));
        let said = report(&[("m.toml", PAIR), ("r.csv", &recording)], &[]);
        let remarks = said["remarks"].to_string();
        assert!(!remarks.contains("reference may be at fault"), "{remarks}");
    }
}

#[test]
fn a_log_of_a_parked_car() {
    let noise = |t: f64, k: f64| ((k * 12.9898 * t).sin() * 43_758.547).fract();
    let parked = |reference: &dyn Fn(f64) -> f64| {
        "t_s,i_ref_a,i_meas_a\n".to_owned()
            + &rows(600, |t| {
                let i = reference(t);
                format!("{t},{i},{}", i + 0.5 + 0.5 * noise(t, 1.0))
            })
    };
    // Noise that hides what the reference does says nothing of the sensor's being dead.
    let model = "schema = 1\n[sensor]\nnoise = 0.3\n";
    let recording = parked(&|t| 0.01 * noise(t, 1.7));
    let said = report(&[("m.toml", model), ("r.csv", &recording)], &[]);
    let remarks = said["remarks"].to_string();
    says(&remarks, &["i_ref_a moves by", "may tell a zero"]);
    assert!(!remarks.contains("dead"), "{remarks}");
    assert_eq!(said["effects"][0]["id"], "offset", "{said}");

    // Zeros alone explain nothing, and are a file to ask whether a zero holds.
    let zeros = parked(&|_| 0.0);
    says(
        &explained(model, &zeros),
        &["column i_ref_a: found 0 in every row, expected a signal that moves"],
    );
    let recording = "t_s,i_ref_a,i_meas_a\n".to_owned()
        + &rows(600, |t| {
            format!(
                "{t},{},{}",
                current(t),
                current(t) + 0.5 + 0.5 * noise(t, 1.0)
            )
        });
    let files = [
        ("m.toml", model),
        ("r.csv", &recording),
        ("zero.csv", &zeros),
    ];
    let said = report(&files, &["--holdout", "zero.csv"]);
    let there = &said["holdouts"][0];
    assert_eq!(there["file"], "zero.csv");
    let rmse = |key: &str| there[key].as_f64().unwrap();
    assert!(rmse("rmse_after") < 0.7 * rmse("rmse_before"), "{there}");
}

#[test]
fn a_delay_beyond_the_recording() {
    let model = "schema = 1\n[sensor]\n[effects.delay]\ndelay_s = 1e9\n";
    says(
        &explained(model, &good()),
        &[
            "m.toml, key effects.delay.delay_s: found 1000000000",
            "less than the recording's 29.900 s",
        ],
    );
}

#[test]
fn effects_under_which_nothing_can_be_simulated() {
    let recording = "t_s,i_ref_a,i_meas_a\n".to_owned()
        + &rows(300, |t| {
            format!("{t},{},{}", 20.0 + current(t), 20.5 + current(t))
        });
    for front_end in ["pair", "dual-range"] {
        let model = format!(
            "schema = 1\n[sensor]\nfront_end = \"{front_end}\"\n[effects.gain]\ngain = 1e308\n[effects.offset]\noffset_a = 1\n"
        );
        let files = [("m.toml", model.as_str()), ("r.csv", recording.as_str())];
        for arguments in [&EXPLAIN, &SIMULATE] {
            says(
                &refused(&files, arguments),
                &["m.toml", "effects.gain", "r.csv", "i_meas_a", "0 of 300"],
            );
        }
    }
}

#[test]
fn voltages_that_were_read_beyond_the_recording() {
    let recording = "t_s,i_ref_a,v_cell_v\n".to_owned()
        + &rows(300, |t| {
            format!("{t},{},{}", current(t), 3.7 - 0.1 * current(t))
        });
    for (value, expected) in [
        (
            "1e6",
            "found 1000000, expected less than the recording's 29.900 s",
        ),
        (
            "inf",
            "a time in s, below 0 if voltages were read after the current",
        ),
    ] {
        let model = format!(
            "schema = 1\n[battery]\ncapacity_ah = 2\nalignment_s = {value}\nocv = [[0, 3.0], [1, 4.0]]\nohmic_resistance_ohm = 0.1\n"
        );
        says(
            &explained(&model, &recording),
            &["m.toml", "battery.alignment_s", expected],
        );
    }
    let model = "schema = 1\n[sensor]\nalignment_s = -1e6\n";
    says(
        &explained(model, &good()),
        &["m.toml, key sensor.alignment_s: found -1000000", "29.900 s"],
    );
}

#[test]
fn columns_by_other_names_are_hinted_at() {
    let renamed = good().replacen("t_s,i_ref_a,i_meas_a", "time,current_ref,current", 1);
    says(
        &explained(PAIR, &renamed),
        &[
            "time, current_ref, current",
            "expected a column \"t_s\"",
            "--map NAME=COLUMN",
        ],
    );
}

/// A column that is needed and that the model file calls by a name that the file does not have.
#[test]
fn the_model_files_name_of_a_column_that_is_needed() {
    let sensor = |line: &str| format!("schema = 1\n[columns]\n{line}\n[sensor]\n");
    for (name, line, lacking) in [
        ("i_ref_a", "i_ref_a = \"Shunt\"", "columns.i_ref_a"),
        ("i_meas_a", "i_meas_a = \"-Board\"", "columns.i_meas_a"),
        ("t_s", "t_s = \"Time\"", "columns.t_s"),
    ] {
        let recording = good().replacen(name, "other", 1);
        says(
            &explained(&sensor(line), &recording),
            &["r.csv", &format!("\"{name}\""), "m.toml", lacking],
        );
    }
    let battery = "schema = 1\n[columns]\nv_cell_v = \"U\"\n[battery]\ncapacity_ah = 2\nocv = [[0, 3.0], [1, 4.0]]\n";
    says(
        &explained(battery, &good()),
        &["r.csv", "soc_pct, v_cell_v or v_pack_v", "columns.v_cell_v"],
    );
    // A column that is there and holds text is still refused, and so is what the command line asks for.
    let text = "t_s,i_ref_a,i_meas_a,T7\n".to_owned()
        + &rows(300, |t| {
            format!("{t},{},{},warm", current(t), current(t) + 0.5)
        });
    says(
        &explained(&sensor("temp_sensor_c = \"T7\""), &text),
        &["r.csv", "T7"],
    );
    says(
        &refused(
            &[("m.toml", PAIR), ("r.csv", &good())],
            &explain_with(&["--map", "temp_sensor_c=T7"]),
        ),
        &["r.csv", "T7"],
    );
}

#[test]
fn a_hold_out_without_the_column_of_what_was_found() {
    let recording = |header: &str, seed: f64, column: bool| {
        format!("{header}\n")
            + &rows(1200, |t| {
                let noise = 0.01 * (seed + 7919.0 * t * t).sin();
                let warm = 25.0 + 20.0 * (0.05 * t + seed).sin();
                let reading = current(t) + 0.05 * (warm - 25.0) + noise;
                if column {
                    format!("{t},{},{reading},{warm}", current(t))
                } else {
                    format!("{t},{},{reading}", current(t))
                }
            })
    };
    let model = "schema = 1\n[sensor]\nnoise = 0.01\n";
    let with = recording("t_s,i_ref_a,i_meas_a,temp_sensor_c", 1.0, true);
    for (other, lacks) in [
        (recording("t_s,i_ref_a,i_meas_a", 2.0, false), true),
        (
            recording("t_s,i_ref_a,i_meas_a,temp_sensor_c", 2.0, true),
            false,
        ),
    ] {
        let files = [("m.toml", model), ("r.csv", &with), ("h.csv", &other)];
        let said = report(&files, &["--holdout", "h.csv"]);
        assert_eq!(
            said["effects"][0]["id"], "offset-temperature",
            "{}",
            said["summary"]
        );
        let remark = "h.csv: offset-temperature, found in i_meas_a, does nothing there: no column temp_sensor_c";
        assert_eq!(
            said["remarks"].to_string().contains(remark),
            lacks,
            "{}",
            said["remarks"]
        );
    }
}

#[test]
fn a_hold_out_of_which_a_piece_was_fitted() {
    let whole = "t_s,i_ref_a,i_meas_a\n".to_owned()
        + &rows(900, |t| format!("{t},{},{}", current(t), current(t) + 0.5));
    let files = [("m.toml", PAIR), ("r.csv", &good()), ("whole.csv", &whole)];
    says(
        &refused(&files, &explain_with(&["--holdout", "whole.csv"])),
        &[
            "whole.csv, column i_meas_a, from 0 to 29.9",
            "readings of r.csv",
            "the part of this one that is not fitted",
        ],
    );
    let rest = "t_s,i_ref_a,i_meas_a\n".to_owned()
        + &rows(600, |t| {
            let t = t + 30.0;
            format!("{t},{},{}", current(t), current(t) + 0.5)
        });
    let files = [("m.toml", PAIR), ("r.csv", &good()), ("rest.csv", &rest)];
    report(&files, &["--holdout", "rest.csv"]);
}

#[test]
fn a_state_of_charge_tells_the_currents_sign_and_the_unit_of_time() {
    let model = "schema = 1\n[battery]\ncapacity_ah = 1\ninitial_soc = 0.9\nnoise_pct = 0.3\n";
    let charge_c =
        |t: f64| 10.0 / 0.37 * (1.0 - (0.37 * t).cos()) + 3.0 / 1.91 * (1.0 - (1.91 * t).cos()) + t;
    let recording = |sign: f64, second: f64| {
        "t_s,i_ref_a,soc_pct\n".to_owned()
            + &rows(3000, |t| {
                format!(
                    "{},{},{:.1}",
                    t / second,
                    sign * current(t),
                    90.0 - charge_c(t) / 36.0
                )
            })
    };
    says(
        &explained(model, &recording(-1.0, 1.0)),
        &[
            "soc_pct rises where i_ref_a discharges",
            "charging positive",
            "--map i_ref_a=-i_ref_a",
        ],
    );
    for (second, unit) in [(60.0, "in min"), (3600.0, "in h")] {
        says(
            &explained(model, &recording(1.0, second)),
            &["r.csv, column soc_pct", "charge of i_ref_a", unit],
        );
    }
    let files = [("m.toml", model), ("r.csv", &recording(1.0, 1.0))];
    report(&files, &[]);
}
