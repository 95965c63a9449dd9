//! The image itself on the emulated board: what a healthy board must not do, and what an order must end in.
//!
//! The image as `rig::default_image` finds it.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use emulator::rig::{Firmware, Rig, Setup};
use emulator::scenario::{Contactors, Row, Scenario};

fn firmware() -> Firmware {
    Firmware::load_default().expect("`cargo xtask build` makes the image")
}

/// A driving car with a battery management that sends what it knows.
fn driving(current_a: f64) -> Setup {
    let row = Row {
        cell_v: Some(3.7),
        pack_v: Some(355.0),
        cell_temperature_c: Some(25.0),
        ..Row::at_rest(0.0).with_current(current_a)
    };
    Setup::nominal(Scenario::steady(row, Contactors::AlwaysClosed))
}

/// The meter's self-test keeps it from counting for 100 ms: no sign of a chip that does not answer.
#[test]
fn a_healthy_board_raises_no_diagnosis_while_it_starts() {
    let firmware = firmware();
    let mut rig = Rig::new(&firmware, driving(10.0)).unwrap();
    rig.run_s(0.9).unwrap();
    assert!(rig.view.diagnoses.is_empty(), "{:?}", rig.view.diagnoses);
    assert!(rig.view.charge_c().valid().is_some());
}
