//! Programs of other people on the served board: python-can, cantools and pymodbus, through `emulator/clients`.
//!
//! `HALLMARK_PYTHON` names a Python that has `emulator/clients/requirements.txt`; `cargo xtask test` makes one and sets it.
//! Each client is also run against boards with a fault: what it does not find there it would not find on the real one.

use std::fmt::Write as _;
use std::process::{Command, Output};

use crate::serve_support::{FakeBoard, Fault, Running, project};
use emulator::serve::Board;

fn client(program: &str) -> Command {
    let python = std::env::var_os("HALLMARK_PYTHON").expect(
        "HALLMARK_PYTHON has to name a Python with the packages of emulator/clients/requirements.txt; `cargo xtask test` sets it",
    );
    let mut command = Command::new(python);
    command
        .arg("-B")
        .arg(project("emulator/clients").join(program));
    command
}

fn can_client(running: &Running) -> Command {
    let mut command = client("can_client.py");
    command
        .args(["--port", &running.can_port.to_string(), "--dbc"])
        .arg(project("can/board.dbc"));
    command
}

fn modbus_client(arguments: &[&str]) -> Command {
    let mut command = client("modbus_client.py");
    command
        .args(arguments)
        .arg("--map")
        .arg(project("docs/modbus.md"))
        .arg("--configuration")
        .arg(project("docs/configuration.md"));
    command
}

fn text(output: &Output) -> String {
    format!(
        "exit code {:?}\n{}{}",
        output.status.code(),
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    )
}

#[track_caller]
fn assert_good(mut command: Command) -> String {
    let output = command.output().unwrap();
    let text = text(&output);
    assert!(output.status.success(), "{text}");
    assert!(text.contains("\"ok\": true"), "{text}");
    assert!(!text.contains("\"ok\": false"), "{text}");
    text
}

/// The client ends with 1, and of its checks exactly `names` are not good.
#[track_caller]
fn assert_finds(mut command: Command, names: &[&str]) {
    let output = command.output().unwrap();
    let text = text(&output);
    assert_eq!(output.status.code(), Some(1), "{text}");
    // "name" stands a line before "ok" in each check.
    let lines: Vec<&str> = text.lines().map(str::trim).collect();
    let wrong: Vec<&str> = lines
        .windows(2)
        .filter(|pair| pair[0].starts_with("\"name\"") && pair[1] == "\"ok\": false,")
        .map(|pair| {
            pair[0]
                .trim_start_matches("\"name\": \"")
                .trim_end_matches("\",")
        })
        .collect();
    assert_eq!(wrong, names, "{text}");
}

#[test]
fn python_can_and_cantools_follow_the_board() {
    let running = Running::start(|| FakeBoard::new(Fault::None), 1.0);
    let mut command = can_client(&running);
    command.args(["--current", "12.346", "--tolerance", "0.001"]);
    assert_good(command);
    assert!(running.stop().frames_from_clients >= 60);
}

#[test]
fn python_can_listens_where_others_send() {
    let running = Running::start(|| FakeBoard::new(Fault::OthersSend), 1.0);
    let output = can_client(&running).output().unwrap();
    assert_eq!(output.status.code(), Some(2), "{}", text(&output));
    assert!(text(&output).contains("use --listen-only"));
    let mut command = can_client(&running);
    command.arg("--listen-only");
    let result = assert_good(command);
    assert!(result.contains("\"BatteryVoltage\""), "{result}");
    assert_eq!(running.stop().frames_from_clients, 0);
    // Where nobody sends, that is found.
    let running = Running::start(|| FakeBoard::new(Fault::None), 1.0);
    let mut command = can_client(&running);
    command.arg("--listen-only");
    assert_finds(command, &["both received: fresh"]);
}

#[test]
fn python_can_finds_lost_frames() {
    let running = Running::start(|| FakeBoard::new(Fault::LosesFrames), 1.0);
    assert_finds(
        can_client(&running),
        &[
            "CRC, data ID and counter of the board's frames",
            "periods of the board's frames",
        ],
    );
}

#[test]
fn python_can_finds_a_period_that_is_too_long() {
    let running = Running::start(|| FakeBoard::new(Fault::Slow), 1.0);
    let output = can_client(&running).output().unwrap();
    let text = text(&output);
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(
        text.contains("Current after 15.00 ms instead of 10 ms"),
        "{text}"
    );
}

#[test]
fn python_can_finds_flipped_bits() {
    let running = Running::start(|| FakeBoard::new(Fault::FlipsBits), 1.0);
    assert_finds(
        can_client(&running),
        &["CRC, data ID and counter of the board's frames"],
    );
}

#[test]
fn python_can_finds_a_frame_that_the_dbc_lacks_and_one_that_does_not_come() {
    let running = Running::start(|| FakeBoard::new(Fault::UnknownFrame), 1.0);
    assert_finds(
        can_client(&running),
        &["every frame is in the DBC and decoded"],
    );
    let running = Running::start(|| FakeBoard::new(Fault::NoThroughput), 1.0);
    assert_finds(can_client(&running), &["every message of the board came"]);
}

#[test]
fn python_can_finds_a_deaf_board_and_a_converter_that_stands_still() {
    let running = Running::start(|| FakeBoard::new(Fault::Deaf), 1.0);
    assert_finds(
        can_client(&running),
        &[
            "both received: fresh",
            "a wrong CRC is refused and counted once",
        ],
    );
    let running = Running::start(|| FakeBoard::new(Fault::NoConversions), 1.0);
    assert_finds(can_client(&running), &["the converter converts"]);
}

#[test]
fn without_a_board_the_clients_say_so() {
    let port = std::net::TcpListener::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap()
        .port();
    let output = modbus_client(&["--tcp", &format!("127.0.0.1:{port}")])
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(2), "{}", text(&output));
}

#[test]
fn pymodbus_reads_writes_and_is_refused_over_tcp() {
    let running = Running::start(|| FakeBoard::new(Fault::None), 5.0);
    assert_good(modbus_client(&[
        "--tcp",
        &format!("127.0.0.1:{}", running.rs485_port),
    ]));
}

#[test]
fn pymodbus_reads_writes_and_is_refused_over_the_terminal() {
    let running = Running::start(|| FakeBoard::new(Fault::None), 5.0);
    let terminal = running.terminal.clone().unwrap();
    assert_good(modbus_client(&["--serial", &terminal, "--parity", "N"]));
}

#[test]
fn pymodbus_knows_the_state_of_the_car() {
    let running = Running::start(|| FakeBoard::new(Fault::HighVoltage), 5.0);
    let place = format!("127.0.0.1:{}", running.rs485_port);
    assert_good(modbus_client(&["--tcp", &place, "--state", "driving"]));
    let output = modbus_client(&["--tcp", &place, "--quick"])
        .output()
        .unwrap();
    let text = text(&output);
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(text.contains("the car is in standstill"), "{text}");
}

#[test]
fn pymodbus_finds_a_limit_that_is_not_kept_and_words_in_the_wrong_order() {
    let running = Running::start(|| FakeBoard::new(Fault::TakesTooMuch), 5.0);
    let place = format!("127.0.0.1:{}", running.rs485_port);
    assert_finds(
        modbus_client(&["--tcp", &place, "--quick"]),
        &[
            "values beyond their limits",
            "nothing refused has changed anything",
        ],
    );
    let running = Running::start(|| FakeBoard::new(Fault::WordOrder), 5.0);
    let place = format!("127.0.0.1:{}", running.rs485_port);
    let output = modbus_client(&["--tcp", &place, "--quick"])
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(1), "{}", text(&output));
}

#[test]
fn what_one_client_sends_on_can_another_reads_over_modbus() {
    let running = Running::start(|| FakeBoard::new(Fault::None), 1.0);
    let mut sender = can_client(&running);
    sender.args(["--cell-voltage", "3.4561", "--seconds", "60"]);
    let mut sender = sender.stdout(std::process::Stdio::null()).spawn().unwrap();
    let output = modbus_client(&[
        "--tcp",
        &format!("127.0.0.1:{}", running.rs485_port),
        "--cell-voltage-mv",
        "3456",
        "--quick",
    ])
    .output()
    .unwrap();
    sender.kill().unwrap();
    sender.wait().unwrap();
    assert!(output.status.success(), "{}", text(&output));
    assert!(text(&output).contains("the cell voltage sent on CAN is shown"));
}

/// A log of three seconds as `candump -L` writes it.
fn log(fault: Fault) -> String {
    let mut board = FakeBoard::new(fault);
    board.run_for(3_000_000).unwrap();
    let mut log = String::new();
    for (at_s, frame) in board.take_can() {
        writeln!(log, "({at_s:.6}) can0 {frame}").unwrap();
    }
    log
}

fn check(name: &str, log: &str) -> Command {
    let path = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    std::fs::write(&path, log).unwrap();
    let mut command = client("candump_check.py");
    command.arg(path).arg(project("can/board.dbc"));
    command
}

#[test]
fn python_can_reads_a_candump_log() {
    let good = log(Fault::None);
    let result = assert_good(check("good.log", &good));
    assert!(result.contains("\"Current\": 300"), "{result}");
    assert_finds(
        check("bits.log", &log(Fault::FlipsBits)),
        &["CRC, data ID and counter of the board's frames"],
    );
    assert_finds(
        check("empty.log", ""),
        &[
            "every frame is in the DBC and decoded",
            "CRC, data ID and counter of the board's frames",
            "periods of the board's frames",
            "every message of the board came",
            "time does not run backwards",
        ],
    );
    let output = check("broken.log", "what is this\n").output().unwrap();
    assert_eq!(output.status.code(), Some(2), "{}", text(&output));
    // A frame that is cut short is none of the DBC's.
    let short = good.replacen("101#", "101#00\n(0.000400) can0 101#", 1);
    let output = check("short.log", &short).output().unwrap();
    assert_eq!(output.status.code(), Some(1), "{}", text(&output));
}
