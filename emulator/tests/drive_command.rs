//! The command `emulate drive` as a user calls it: what it refuses and how, and what it writes.
//!
//! The image as `rig::default_image` finds it; `cargo xtask test` builds it.

use std::collections::HashMap;
use std::fs;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::thread;
use std::time::Duration;

use emulator::image::FLASH_START;
use emulator::rig::default_image;
use recording::{
    convert::{self, Options},
    csv,
    dbc::Database,
};
use serde_json::Value;

fn emulate(folder: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_emulate"))
        .current_dir(folder)
        .arg("drive")
        .args(arguments)
        .output()
        .unwrap()
}

fn text(bytes: &[u8]) -> &str {
    std::str::from_utf8(bytes).unwrap()
}

/// Ends with 2 and one sentence that has all of `parts`, and leaves nothing behind.
#[track_caller]
fn assert_refused(folder: &Path, arguments: &[&str], parts: &[&str]) {
    let out = folder.join("out");
    let arguments = [arguments, &["--out", "out"]].concat();
    let output = emulate(folder, &arguments);
    let message = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{arguments:?}: {message}");
    assert!(message.starts_with("error: "), "{message}");
    assert_eq!(message.lines().count(), 1, "{message}");
    for part in parts {
        assert!(message.contains(part), "{message:?} should name {part:?}");
    }
    assert!(output.stdout.is_empty(), "{}", text(&output.stdout));
    assert!(!out.exists(), "{arguments:?} left {}", out.display());
}

#[test]
fn a_profile_that_cannot_be_driven_is_refused_with_file_line_and_column() {
    let folder = tempfile::tempdir().unwrap();
    let image = default_image();
    let image = image.to_str().unwrap();
    for (name, content, parts) in [
        ("column.csv", "t_s,u_v\n0,1\n", &["t_s, u_v", "i_ref_a"][..]),
        (
            "back.csv",
            "t_s,i_ref_a\n0,1\n2,1\n1,1\n",
            &["line 4", "t_s", "1 s", "2 s"],
        ),
        (
            "nan.csv",
            "t_s,i_ref_a\n0,1\n1,NaN\n",
            &["line 3", "i_ref_a"],
        ),
        (
            "text.csv",
            "t_s,i_ref_a,key,note\n0,1,2,a\n1,1,on,b\n",
            &["line 3", "column 3 (key)", "\"on\""],
        ),
        ("gap.csv", "t_s,i_ref_a\n0,1\n1,\n", &["line 3", "i_ref_a"]),
        (
            "beyond.csv",
            "t_s,i_ref_a\n0,1\n1,40\n",
            &["line 3", "i_ref_a", "760 A", "±600 A"],
        ),
        ("rows.csv", "t_s,i_ref_a\n", &["no rows"]),
        ("empty.csv", "", &["empty"]),
        (
            "fields.csv",
            "t_s,i_ref_a\n0,1,2\n",
            &["line 2", "3 fields"],
        ),
    ] {
        fs::write(folder.path().join(name), content).unwrap();
        let parts = [parts, &[name]].concat();
        assert_refused(
            folder.path(),
            &["--image", image, "--profile", name, "--scale", "19"],
            &parts,
        );
    }
    let arguments = |more: &[&'static str]| [&["--image", image][..], more].concat();
    fs::write(folder.path().join("good.csv"), "t_s,i_ref_a\n0,1\n2,1\n").unwrap();
    assert_refused(
        folder.path(),
        &arguments(&["--profile", "none.csv"]),
        &["none.csv", "no such file"],
    );
    assert_refused(
        folder.path(),
        &arguments(&["--profile", "good.csv", "--map", "i_ref_a=Shunt"]),
        &["good.csv", "Shunt"],
    );
    assert_refused(
        folder.path(),
        &arguments(&["--profile", "good.csv", "--skip", "3"]),
        &["good.csv", "2 s", "3 s"],
    );
    assert_refused(
        folder.path(),
        &arguments(&["--profile", "good.csv", "--fault", "F99"]),
        &["F99"],
    );
}

#[test]
fn an_image_that_is_not_for_this_board_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("good.csv"), "t_s,i_ref_a\n0,1\n2,1\n").unwrap();
    let image = fs::read(default_image()).unwrap();
    let mut without_vectors = image.clone();
    let start = vector_table(&image);
    without_vectors[start..start + 8].fill(0xFF);
    let mut elsewhere = image.clone();
    // e_machine of a 64-bit ARM.
    elsewhere[18] = 183;
    for (name, content, part) in [
        ("text.elf", &b"no program"[..], "no ELF file"),
        ("cut.elf", &image[..image.len() / 2], "STM32F405RG"),
        ("vectors.elf", &without_vectors, "no vector table"),
        ("machine.elf", &elsewhere, "not for ARM"),
        (
            "host.elf",
            &fs::read(env!("CARGO_BIN_EXE_emulate")).unwrap(),
            "another width",
        ),
    ] {
        fs::write(folder.path().join(name), content).unwrap();
        assert_refused(
            folder.path(),
            &["--image", name, "--profile", "good.csv"],
            &[name, part],
        );
    }
    assert_refused(
        folder.path(),
        &["--image", "none.elf", "--profile", "good.csv"],
        &["none.elf", "cargo xtask build"],
    );
}

/// Where in the file the flash begins, by the program headers (ELF specification, 32 bits).
fn vector_table(elf: &[u8]) -> usize {
    let word = |at: usize| u32::from_le_bytes(elf[at..at + 4].try_into().unwrap());
    let headers = word(28) as usize;
    (0..usize::from(u16::from_le_bytes([elf[44], elf[45]])))
        .map(|number| headers + 32 * number)
        .find(|header| word(*header) == 1 && word(header + 12) == FLASH_START)
        .map(|header| word(header + 4) as usize)
        .unwrap()
}

#[test]
fn a_place_that_cannot_be_written_is_refused_before_the_drive() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(
        folder.path().join("good.csv"),
        "t_s,i_ref_a\n0,1\n1000000,1\n",
    )
    .unwrap();
    let image = default_image();
    let output = emulate(
        folder.path(),
        &[
            "--image",
            image.to_str().unwrap(),
            "--profile",
            "good.csv",
            "--out",
            "good.csv/out",
        ],
    );
    assert_eq!(output.status.code(), Some(2));
    assert!(
        text(&output.stderr).contains("good.csv/out"),
        "{}",
        text(&output.stderr)
    );
}

#[test]
fn what_is_read_is_never_replaced() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path().join("p");
    fs::create_dir(&place).unwrap();
    fs::write(place.join("board.csv"), PROFILE).unwrap();
    fs::write(place.join("summary.txt"), "").unwrap();
    fs::write(folder.path().join("drive.csv"), PROFILE).unwrap();
    let image = default_image();
    for (arguments, parts) in [
        (
            &["--profile", "p/board.csv"][..],
            ["p/board.csv", "--profile"],
        ),
        (
            &[
                "--profile",
                "drive.csv",
                "--calibration",
                "p/../p/summary.txt",
            ],
            ["p/summary.txt", "--calibration"],
        ),
    ] {
        let image = ["--out", "p", "--image", image.to_str().unwrap()];
        let output = emulate(folder.path(), &[arguments, &image].concat());
        let message = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{message}");
        assert_eq!(message.lines().count(), 1, "{message}");
        assert!(parts.iter().all(|part| message.contains(part)), "{message}");
    }
    assert_eq!(
        fs::read_to_string(place.join("board.csv")).unwrap(),
        PROFILE
    );
    assert_eq!(fs::read_dir(&place).unwrap().count(), 2);
}

#[test]
fn a_disk_that_is_full_leaves_no_file() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("drive.csv"), PROFILE).unwrap();
    // A limit on the size of a file stands for the disk. The smaller board.csv would fit, can.log does not.
    for blocks in [16, 40] {
        let output = Command::new("sh")
            .current_dir(folder.path())
            .args(["-c", "trap '' XFSZ; ulimit -f $0; exec \"$@\""])
            .arg(blocks.to_string())
            .args([env!("CARGO_BIN_EXE_emulate"), "drive", "--profile"])
            .args(["drive.csv", "--out", "new/out", "--image"])
            .arg(default_image())
            .output()
            .unwrap();
        let message = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{message}");
        assert_eq!(message.lines().count(), 1, "{message}");
        assert!(!folder.path().join("new").exists());
    }
}

#[test]
fn a_fault_that_would_never_strike_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("drive.csv"), PROFILE).unwrap();
    let image = default_image();
    let with = |fault| {
        [
            "--image",
            image.to_str().unwrap(),
            "--profile",
            "drive.csv",
            "--fault",
            fault,
        ]
    };
    assert_refused(
        folder.path(),
        &with("F9@1e9"),
        &["F9@1e9", "1000000000 s", "4 s"],
    );
    assert_refused(folder.path(), &with("F9@4"), &["F9@4", "4 s"]);
    let fits = emulate(folder.path(), &with("F9@3.9"));
    assert_eq!(fits.status.code(), Some(0), "{}", text(&fits.stderr));
    let duration = [&with("F9@3")[..], &["--duration", "-1"]].concat();
    let output = emulate(folder.path(), &duration);
    assert_eq!(output.status.code(), Some(2));
    let message = text(&output.stderr);
    assert!(
        message.contains("expected a number of seconds, 0 or more"),
        "{message}"
    );
}

/// 40 A, 200 A across the range's edge, and back: 2.5 s of it, after a second at rest.
const PROFILE: &str = "\
t_s,i_ref_a,v_cell_v,temp_cell_c
0,40,3.6,25
1,40,3.6,25
1.01,200,3.5,25
1.99,200,3.5,25
2,-30,3.65,25
2.5,-30,3.65,25
";
/// From power-on, with half a second of rest at the end.
const LENGTH_S: f64 = 4.0;

#[test]
fn a_drive_is_written_down_as_it_was() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("drive.csv"), PROFILE).unwrap();
    let image = default_image();
    let run = |out: &str, more: &[&str]| {
        let arguments = ["--image", image.to_str().unwrap(), "--profile", "drive.csv"];
        emulate(
            folder.path(),
            &[&arguments, &["--out", out][..], more].concat(),
        )
    };
    let output = run("out", &[]);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let out = folder.path().join("out");
    let mut names: Vec<String> = fs::read_dir(&out)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    assert_eq!(
        names,
        [
            "board.csv",
            "can.log",
            "defmt.log",
            "rs485.log",
            "summary.json",
            "summary.txt"
        ]
    );
    let summary = fs::read_to_string(out.join("summary.txt")).unwrap();
    assert!(text(&output.stdout).starts_with(&summary));

    // The profile's charge by hand: trapezoids, and 1 ms from and to rest.
    let true_c = 0.02 + 40.0 + 1.2 + 196.0 + 0.85 - 15.0 - 0.015;
    let report: Value =
        serde_json::from_str(&fs::read_to_string(out.join("summary.json")).unwrap()).unwrap();
    let figure = |name: &str| report["figures"][name].as_f64().unwrap();
    assert!((figure("true_charge_c") - true_c).abs() < 0.01, "{report}");
    assert!((figure("length_s") - LENGTH_S).abs() < 0.02, "{report}");
    assert_eq!(figure("edges"), 2.0);
    assert_eq!(figure("unanswered"), 0.0);
    assert_eq!(figure("wrong_frames"), 0.0);
    assert!(
        figure("charge_error_c").abs() <= figure("charge_bound_c"),
        "{report}"
    );

    let board = csv::read(&out.join("board.csv")).unwrap();
    let column = |name: &str| board.need(name).unwrap();
    let last = |name: &str| {
        *column(name)
            .iter()
            .rfind(|value| value.is_finite())
            .unwrap()
    };
    assert!((last("q_ref_c") - true_c).abs() < 0.01);
    assert!((last("q_meas_c") - last("q_ref_c")).abs() <= 0.1);
    assert_eq!(last("v_supply_v"), 5.0);
    // A conversion is 31 ms long and known 10 ms later at the latest: within a steady part it is the true current.
    for (t_s, current_a) in [(1.8, 40.0), (2.8, 200.0), (3.3, -30.0)] {
        let row = board
            .time_s()
            .iter()
            .zip(column("i_meas_a"))
            .position(|(at_s, value)| *at_s >= t_s && value.is_finite())
            .unwrap();
        let measured_a = column("i_meas_a")[row];
        assert!((column("i_ref_a")[row] - current_a).abs() < 1e-9);
        // A step of the large range's converter is 0.3 A, and the sensors are exact.
        assert!(
            (measured_a - current_a).abs() < 0.5,
            "{measured_a} A at {t_s} s"
        );
    }

    // A row for each current frame and each charge frame, with the time that the frame has in the log; the others are bends.
    let log = fs::read_to_string(out.join("can.log")).unwrap();
    let sent: Vec<f64> = log
        .lines()
        .filter(|line| line.contains(" can0 101#") || line.contains(" can0 110#"))
        .map(|line| line[1..line.find(')').unwrap()].parse().unwrap())
        .collect();
    for at_s in &sent {
        assert!(board.time_s().contains(at_s), "{at_s}");
    }
    for (row, at_s) in board.time_s().iter().enumerate() {
        let read = column("i_meas_a")[row].is_finite() || column("q_meas_c")[row].is_finite();
        assert!(!read || sent.contains(at_s), "{at_s}");
    }

    compare_with_the_bus(&out, &board);

    // --check says by its exit code what the summary says in words.
    let checked = run("checked", &["--check"]);
    let complaints = report["complaints"].as_array().unwrap();
    let code = i32::from(!complaints.is_empty());
    assert_eq!(checked.status.code(), Some(code), "{complaints:?}");
    // The same image, drive and seed make the same run.
    for name in ["can.log", "board.csv", "defmt.log", "rs485.log"] {
        assert_eq!(
            fs::read(folder.path().join("checked").join(name)).unwrap(),
            fs::read(out.join(name)).unwrap(),
            "{name}"
        );
    }
}

/// `board.csv` has what `twin convert` makes of `can.log`, and nothing where that has nothing.
fn compare_with_the_bus(out: &Path, board: &recording::Recording) {
    let database = Path::new(env!("CARGO_MANIFEST_DIR")).join("../can/board.dbc");
    let options = Options {
        database: Some(Database::read(&database).unwrap()),
        ..Options::default()
    };
    let log = out.join("can.log");
    let converted = convert::read(&log, &options, &mut |_| {}).unwrap();
    let (_, decoded) = converted.counts.unwrap();
    assert_eq!(decoded.broken, 0);
    // Conversions that a range change fell into.
    assert!(decoded.invalid > 0);
    let path = out.join("bus.csv");
    convert::write(&path, converted.columns(), &mut |_| {}).unwrap();
    let bus = csv::read(&path).unwrap();
    // The log's times count from its first frame, in µs.
    let first = fs::read_to_string(&log).unwrap();
    let from_s: f64 = first[1..first.find(')').unwrap()].parse().unwrap();
    let micros = |t_s: f64| (t_s * 1e6).round() as i64;
    let told: HashMap<i64, usize> = (0..board.len())
        .map(|row| (micros(board.time_s()[row] - from_s), row))
        .collect();
    let column = |name: &str| bus.need(name).unwrap();
    let same = |name: &str, row: usize, at: usize| {
        let (ours, bus) = (board.need(name).unwrap()[at], column(name)[row]);
        let same = ours == bus || ours.is_nan() && bus.is_nan();
        assert!(same, "{name} in row {row} of the bus: {ours}, {bus}");
    };
    let (mut conversion, mut values, mut blanks) = (f64::NAN, 0, 0);
    for row in 0..bus.len() {
        let at = told.get(&micros(bus.time_s()[row])).copied();
        let number = column("Current.CurrentConversions")[row];
        // The first row of each conversion.
        if number.is_finite() && std::mem::replace(&mut conversion, number) != number {
            same("i_meas_a", row, at.unwrap());
            if column("i_meas_a")[row].is_finite() {
                values += 1;
            } else {
                blanks += 1;
            }
        }
        if column("Charge.ChargeValidity")[row].is_finite() {
            same("q_meas_c", row, at.unwrap());
        }
    }
    assert!(values > 50 && blanks > 2, "{values}, {blanks}");
}

#[test]
fn a_fault_shows_in_the_summary_and_in_the_exit_code() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("drive.csv"), "t_s,i_ref_a\n0,20\n2,20\n").unwrap();
    let image = default_image();
    let output = emulate(
        folder.path(),
        &[
            "--image",
            image.to_str().unwrap(),
            "--profile",
            "drive.csv",
            "--fault",
            "F21@1.5",
            "--check",
        ],
    );
    assert_eq!(output.status.code(), Some(1), "{}", text(&output.stderr));
    assert!(
        text(&output.stdout).contains("reset by PowerOn at 1.5"),
        "{}",
        text(&output.stdout)
    );
}

#[test]
fn a_drive_that_does_not_end_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(
        folder.path().join("long.csv"),
        "t_s,i_ref_a\n0,20\n100000,20\n",
    )
    .unwrap();
    let image = default_image();
    let mut drive = Command::new(env!("CARGO_BIN_EXE_emulate"))
        .current_dir(folder.path())
        .args(["drive", "--profile", "long.csv", "--out", "out", "--image"])
        .arg(&image)
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let out = folder.path().join("out");
    while !out.exists() {
        assert!(drive.try_wait().unwrap().is_none(), "it ended by itself");
        thread::sleep(Duration::from_millis(10));
    }
    let interrupt = Command::new("kill")
        .args(["-INT", &drive.id().to_string()])
        .status()
        .unwrap();
    assert!(interrupt.success());
    // What a shell makes of Ctrl-C.
    assert_eq!(drive.wait().unwrap().code(), Some(130));
    assert!(!out.exists());
}
