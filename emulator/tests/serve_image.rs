//! Programs of other people on the image itself: python-can, cantools and pymodbus on the served emulated board.
//!
//! `HALLMARK_PYTHON` as in `serve_python.rs`; the image as `rig::default_image` finds it.

use std::process::Command;

use crate::serve_support::{Running, project};
use emulator::rig::{Firmware, Rig, Setup};
use emulator::scenario::{Contactors, Key, Row, Scenario};

/// Longer than docs/firmware.md gives the start: 450 ms for the storage, 100 ms for the test of the meter.
const START_S: f64 = 1.0;

/// A car that stands: key off, nobody else on the bus. At half the speed, so that a busy machine keeps up.
fn standing() -> Running {
    Running::start_with(0.5, |session, stop| {
        let firmware = Firmware::load_default()?;
        let rows = vec![Row::at_rest(0.0).with_key(Key::Off)];
        let mut rig = Rig::new(
            &firmware,
            Setup::nominal(Scenario::new(rows, Contactors::Permitted)?),
        )?;
        rig.machine.board(|board| board.vehicle.silent = true);
        // What is asked while the board starts is not answered, here as on a real one.
        rig.run_s(START_S)?;
        rig.keep_frames = true;
        session.run(&mut rig, stop, &mut |notice| eprintln!("{notice}"))
    })
}

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

#[track_caller]
fn assert_good(mut command: Command) {
    let output = command.output().unwrap();
    assert!(
        output.status.success(),
        "{}{}",
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    );
}

fn modbus(arguments: &[&str]) -> Command {
    let mut command = client("modbus_client.py");
    command
        .args(arguments)
        .args(["--repeats", "0"])
        .arg("--map")
        .arg(project("docs/modbus.md"))
        .arg("--configuration")
        .arg(project("docs/configuration.md"));
    command
}

fn can(running: &Running) -> Command {
    let mut command = client("can_client.py");
    command
        .args(["--port", &running.can_port.to_string(), "--dbc"])
        .arg(project("can/board.dbc"));
    command
}

#[test]
fn python_can_and_cantools_follow_the_image() {
    let running = standing();
    let mut command = can(&running);
    command.args(["--current", "0", "--tolerance", "1"]);
    assert_good(command);
}

#[test]
fn pymodbus_reads_writes_calibrates_and_is_refused_over_tcp() {
    let running = standing();
    assert_good(modbus(&[
        "--tcp",
        &format!("127.0.0.1:{}", running.rs485_port),
    ]));
}

#[test]
fn pymodbus_reads_and_is_refused_over_the_terminal_while_can_shows_its_cell_voltage() {
    let running = standing();
    let mut sender = can(&running);
    sender.args(["--cell-voltage", "3.4561", "--seconds", "600"]);
    let mut sender = sender.stdout(std::process::Stdio::null()).spawn().unwrap();
    let terminal = running.terminal.clone().expect("a pseudo-terminal");
    let output = modbus(&[
        "--serial",
        &terminal,
        "--parity",
        "N",
        "--quick",
        "--cell-voltage-mv",
        "3456",
    ])
    .output()
    .unwrap();
    sender.kill().unwrap();
    sender.wait().unwrap();
    assert!(
        output.status.success(),
        "{}{}",
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    );
}
