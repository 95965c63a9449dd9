//! `twin convert` as it is called.

use std::{fs, process::Command};

use crate::command::twin;

const DATABASE: &str = r#"VERSION ""

BU_: A

BO_ 16 Shunt: 8 A
 SG_ Current : 0|16@1- (1,0) [0|0] "mA" A
 SG_ Volt : 16|16@1+ (0.001,0) [0|0] "V" A
"#;

const LOG: &str = "(1700000000.5) can0 010#E8030C0E\n\
    (1700000000.6) can0 7FF#00\n\
    (1700000000.75) can0 010#18FC\n\
    (1700000001.5) can0 010#R\n";

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).unwrap()
}

fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("v.dbc"), DATABASE).unwrap();
    fs::write(folder.path().join("drive.log"), LOG).unwrap();
    folder
}

#[test]
fn a_log_becomes_a_recording() {
    let folder = folder();
    let arguments = [
        "convert",
        "drive.log",
        "--dbc",
        "v.dbc",
        "--out",
        "drive.csv",
    ];
    let output = twin(folder.path(), &arguments);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    assert_eq!(
        text(&output.stdout),
        "drive.csv: 2 rows of 3 columns from drive.log (candump log)\n\
         2 frames decoded, 1 not in the DBC, 1 too short for a signal, 1 remote frames\n"
    );
    assert_eq!(text(&output.stderr), "");
    assert_eq!(
        fs::read_to_string(folder.path().join("drive.csv")).unwrap(),
        "t_s,Shunt.Current_a,Shunt.Volt_v\n0,1,3.596\n0.25,-1,\n"
    );
}

#[test]
fn a_log_that_is_cut_is_said_to_be() {
    let folder = folder();
    // Two bytes of four: the same frame, only shorter.
    let cut = format!("{LOG}(1700000002.5) can0 010#E803");
    fs::write(folder.path().join("cut.log"), cut).unwrap();
    let arguments = ["convert", "cut.log", "--dbc", "v.dbc", "--out", "cut.csv"];
    let output = twin(folder.path(), &arguments);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let said = text(&output.stdout);
    assert!(said.starts_with("cut.csv: 2 rows of"), "{said}");
    assert!(
        said.contains("1 left out: the log ends within its last line"),
        "{said}"
    );
}

#[test]
fn a_vector_ascii_log_that_is_cut_is_said_to_be_and_the_rest_stays() {
    let folder = folder();
    let log = "base hex timestamps absolute\n0.5 1 10 Rx d 4 E8 03 0C 0E\n1.25 1 10 Rx d 2 18 FC";
    for length in [log.len(), log.len() - 1, log.len() - 2] {
        fs::write(folder.path().join("cut.asc"), &log[..length]).unwrap();
        let arguments = ["convert", "cut.asc", "--dbc", "v.dbc", "--out", "cut.csv"];
        let output = twin(folder.path(), &arguments);
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        let said = text(&output.stdout);
        assert!(
            said.contains("1 left out: the log ends within its last line"),
            "{said}"
        );
        assert_eq!(
            fs::read_to_string(folder.path().join("cut.csv")).unwrap(),
            "t_s,Shunt.Current_a,Shunt.Volt_v\n0.5,1,3.596\n"
        );
    }
}

#[test]
fn columns_are_mapped_and_parquet_holds_the_same() {
    let folder = folder();
    let mut arguments = vec!["convert", "drive.log", "--dbc", "v.dbc"];
    arguments.extend(["--map", "i_ref_a=-Shunt.Current", "--out", "drive.parquet"]);
    assert_eq!(twin(folder.path(), &arguments).status.code(), Some(0));
    let output = twin(
        folder.path(),
        &["convert", "drive.parquet", "--out", "back.csv"],
    );
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    assert_eq!(
        fs::read_to_string(folder.path().join("back.csv")).unwrap(),
        "t_s,i_ref_a,Shunt.Volt_v\n0,-1,3.596\n0.25,1,\n"
    );
}

#[cfg(unix)]
#[test]
fn a_pipe_takes_the_recording_alone() {
    let folder = folder();
    let arguments = [
        "convert",
        "drive.log",
        "--dbc",
        "v.dbc",
        "--out",
        "/dev/stdout",
    ];
    let output = twin(folder.path(), &arguments);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    assert!(text(&output.stdout).ends_with("\n0.25,-1,\n"));
}

#[test]
fn bad_input_ends_with_2_and_leaves_nothing() {
    let folder = folder();
    let write = |name: &str, content: &str| fs::write(folder.path().join(name), content).unwrap();
    write("bad.log", &format!("{LOG}(1700000002.5) can0 10#00\n"));
    write("bad.dbc", "nonsense");
    write("out.csv", "before");
    let before = fs::read_dir(folder.path()).unwrap().count();
    let cases: [(&[&str], &str); 8] = [
        (&["no.log", "--dbc", "v.dbc"], "no.log: found no such file"),
        (
            &["drive.log"],
            "drive.log: found CAN frames (candump log), expected a DBC",
        ),
        (
            &["drive.log", "--dbc", "no.dbc"],
            "no.dbc: found no such file",
        ),
        (
            &["drive.log", "--dbc", "bad.dbc"],
            "bad.dbc, line 1, column 1: found",
        ),
        (
            &["bad.log", "--dbc", "v.dbc"],
            "bad.log, line 5, column 3: found \"10#00\"",
        ),
        (
            &["drive.log", "--dbc", "v.dbc", "--map", "x"],
            "found \"x\", expected NAME=COLUMN",
        ),
        (
            &["drive.log", "--dbc", "v.dbc", "--map", "x=Shunt.No"],
            "drive.log: found the signals Shunt.Current_a, Shunt.Volt_v, expected a signal \"Shunt.No\"",
        ),
        (
            &["drive.log", "--dbc", "v.dbc", "--bus", "can7"],
            "drive.log: found frames on the buses can0, expected some on \"can7\"",
        ),
    ];
    for (arguments, sentence) in cases {
        let arguments = [&["convert", "--out", "out.csv"], arguments].concat();
        let output = twin(folder.path(), &arguments);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}");
        let told = text(&output.stderr);
        assert!(
            told.starts_with("error: ") && told.contains(sentence),
            "{told}"
        );
        assert_eq!(told.lines().count(), 1, "{told}");
        assert_eq!(text(&output.stdout), "");
    }
    for out in ["out.xls", "out", "no/such/folder.csv"] {
        let output = twin(
            folder.path(),
            &["convert", "drive.log", "--dbc", "v.dbc", "--out", out],
        );
        assert_eq!(output.status.code(), Some(2), "{out}");
        assert!(
            text(&output.stderr).contains(out),
            "{}",
            text(&output.stderr)
        );
    }
    assert_eq!(
        fs::read_to_string(folder.path().join("out.csv")).unwrap(),
        "before"
    );
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), before);
}

#[test]
fn what_a_mapping_replaces_is_said() {
    let folder = folder();
    fs::write(
        folder.path().join("both.csv"),
        "t_s,i_ref_a,i_meas_a,note\n0,1,0,x\n1,2,4,y\n",
    )
    .unwrap();
    let output = twin(
        folder.path(),
        &[
            "convert",
            "both.csv",
            "--out",
            "out.csv",
            "--map",
            "i_ref_a=-i_meas_a",
        ],
    );
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let said = text(&output.stdout);
    assert!(
        said.contains("left out: note (\"x\" in line 2), i_ref_a (i_meas_a has its name now)"),
        "{said}"
    );
    let out = fs::read_to_string(folder.path().join("out.csv")).unwrap();
    assert_eq!(out, "t_s,i_ref_a\n0,0\n1,-4\n");
}

#[test]
fn an_empty_file_is_no_log() {
    let folder = folder();
    fs::write(folder.path().join("empty.log"), "").unwrap();
    let output = twin(
        folder.path(),
        &["convert", "empty.log", "--dbc", "v.dbc", "--out", "out.csv"],
    );
    assert_eq!(output.status.code(), Some(2));
    let said = text(&output.stderr);
    assert!(
        said.contains("empty.log: found an empty file, expected a log or a recording"),
        "{said}"
    );
}

#[cfg(unix)]
#[test]
fn an_interrupted_conversion_leaves_nothing() {
    let folder = folder();
    let mut long = "t_s,i_ref_a\n".to_owned();
    for row in 0..1_500_000 {
        long.push_str(&format!("{row},{}.25\n", row % 97));
    }
    fs::write(folder.path().join("long.csv"), long).unwrap();
    // Nobody may be there any more to read what is said of it.
    for (signal, code, is_read) in [
        ("-INT", 130, true),
        ("-TERM", 143, true),
        ("-TERM", 143, false),
    ] {
        let before = fs::read_dir(folder.path()).unwrap().count();
        let mut twin = Command::new(env!("CARGO_BIN_EXE_twin"))
            .args(["convert", "long.csv", "--out", "out.csv"])
            .current_dir(folder.path())
            .stderr(if is_read {
                std::process::Stdio::null()
            } else {
                std::process::Stdio::piped()
            })
            .spawn()
            .unwrap();
        drop(twin.stderr.take());
        let started = || {
            fs::read_dir(folder.path()).unwrap().any(|entry| {
                // Once there is something in it: that it can be made is tried at the start.
                let entry = entry.unwrap();
                let name = entry.file_name().into_string().unwrap();
                name.ends_with(".part") && entry.metadata().is_ok_and(|there| there.len() > 0)
            })
        };
        while !started() {
            assert!(twin.try_wait().unwrap().is_none(), "it ended by itself");
            std::thread::sleep(std::time::Duration::from_millis(1));
        }
        let id = twin.id().to_string();
        Command::new("kill").args([signal, &id]).status().unwrap();
        // One that does not end is no reason for this to wait for ever.
        let ended = (0..30_000).find_map(|_| {
            std::thread::sleep(std::time::Duration::from_millis(1));
            twin.try_wait().unwrap()
        });
        let _ = twin.kill();
        assert_eq!(ended.map(|status| status.code()), Some(Some(code)));
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), before);
    }
}

#[test]
fn help_has_an_example_and_wrong_arguments_end_with_2() {
    let folder = folder();
    let help = twin(folder.path(), &["convert", "--help"]);
    assert_eq!(help.status.code(), Some(0));
    assert!(text(&help.stdout).contains("Example:\n  twin convert "));
    for arguments in [
        &["convert"][..],
        &["convert", "drive.log"],
        &["no-such-command"],
        &[],
    ] {
        assert_eq!(
            twin(folder.path(), arguments).status.code(),
            Some(2),
            "{arguments:?}"
        );
    }
}
