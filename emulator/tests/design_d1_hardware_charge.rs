//! D1 on the running image: the charge of a real drive, both signs and both ranges, as the energy meter counted it; over
//! the wrap of its register, and over a reset of the microcontroller in the middle.
//!
//! The drive is 12 s of US06 on a Panasonic 18650PF (recordings/panasonic-18650pf, P. Kollmeyer, CC BY 4.0), multiplied
//! by 19: 96 A of charge to 370 A of discharge.

use std::path::Path;

use crate::support::{Account, Bench, Charge, firmware};
use emulator::mcu::rcc::ResetCause;
use emulator::profile::{self, ProfileOptions};
use emulator::rig::Setup;
use emulator::scenario::{Contactors, Row, Scenario};
use emulator::time::Ticks;
use recording::Mapping;

const LENGTH_S: f64 = 12.0;

/// The drive, at rest before and after it.
fn drive() -> Vec<Row> {
    let path =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../recordings/panasonic-18650pf/25c-us06.csv");
    let options = ProfileOptions {
        scale: 19.0,
        skip_s: 3_918.0,
        duration_s: Some(LENGTH_S),
        lead_s: 0.1,
        tail_s: 0.1,
        ..ProfileOptions::default()
    };
    profile::read(&path, &Mapping::new(), &options)
        .unwrap()
        .rows
}

/// A board before power comes on, at rest.
fn setup(rows: &[Row]) -> Setup {
    let at_rest = rows[0].with_current(0.0);
    Setup::nominal(Scenario::steady(at_rest, Contactors::AlwaysClosed))
}

fn print(name: &str, charge: &Charge) {
    println!(
        "D1, {name}: {:.1} s, {:.0} … {:.0} A, {} edges, {:.1} s in the large range; net {:.3} C, both ways {:.1} C; error \
         {:+.4} C, bound {:.4} C",
        charge.length_s,
        charge.span_a.0,
        charge.span_a.1,
        charge.edges,
        charge.large_s,
        charge.true_c,
        charge.throughput_c,
        charge.error_c,
        charge.bound_c
    );
}

#[test]
fn charge_of_a_real_drive_is_right_over_the_wrap_of_aenergy() {
    let firmware = firmware();
    let rows = drive();
    let mut bench = Bench::powered(&firmware, setup(&rows));
    // The 24 bits wrap 3,000 counts further on: 20 C of the small range, 201 C of the large one.
    let before = 0x7F_FFFF - 3_000;
    bench
        .rig
        .machine
        .board(|board| board.meter.preset_energy(before));
    bench.settle();
    let energy = |bench: &mut Bench<'_>| bench.rig.machine.board(|board| board.meter.energy());
    assert!(
        (energy(&mut bench) - before).abs() < 10,
        "the start has cleared the accumulator: {}",
        energy(&mut bench)
    );

    let account = Account::open(&mut bench);
    bench.drive(&rows);
    let charge = account.close(&mut bench);
    print("wrap", &charge);
    let after = energy(&mut bench);
    println!("D1, wrap: AENERGY from {before} to {after}");
    assert!(after < 0, "the register has wrapped: {after}");
    assert!(
        charge.span_a.0 < -60.0 && charge.span_a.1 > 300.0 && charge.edges >= 8,
        "{charge:?}"
    );
    assert!(charge.error_c.abs() <= charge.bound_c, "{charge:?}");
    assert_eq!(
        bench.inputs("meter counters"),
        [0; 5],
        "nothing was repeated or rejected"
    );
    // What enters and what leaves the battery are counted apart.
    let (charged, discharged) = (
        bench.input("charge in") as f64 * 1e-3,
        bench.input("charge out") as f64 * 1e-3,
    );
    assert!(
        (discharged.abs() + charged.abs() - charge.throughput_c).abs() <= charge.bound_c + 0.002,
        "in {charged} C, out {discharged} C"
    );
    let complaints = bench.complaints(&["SocUncertain"]);
    assert!(complaints.is_empty(), "{complaints:?}");
}

#[test]
fn reset_in_the_middle_loses_no_more_than_declared() {
    let firmware = firmware();
    let rows = drive();
    let mut bench = Bench::new(&firmware, setup(&rows));
    let account = Account::open(&mut bench);
    // Where the drive's current is largest: a loss shows most.
    let peak = rows
        .iter()
        .max_by(|a, b| a.current_a.total_cmp(&b.current_a))
        .unwrap();
    let reset_at = Ticks::from_seconds(bench.now_s() + peak.t_s);
    bench
        .rig
        .at(reset_at, |rig| rig.machine.reset(ResetCause::Software));
    bench.drive(&rows);
    let charge = account.close(&mut bench);
    print("reset", &charge);
    assert_eq!(
        bench.rig.machine.resets().len(),
        2,
        "power-on, and the one asked for"
    );

    // Between the last copy in retained memory, 0.1 s old at most, and the meter's first reading after the start nobody
    // counts. Until then there are no charge frames.
    let restart_s = bench.rig.view.period("Charge").longest_s;
    let loss_c = peak.current_a * (0.1 + restart_s);
    let declared_c = 600.0 * 0.6;
    println!(
        "D1, reset: at {:.1} A, {restart_s:.3} s without a charge frame, so at most {loss_c:.1} C are lost; the firmware \
         declares {declared_c} C",
        peak.current_a
    );
    assert!(
        charge.error_c.abs() <= charge.bound_c + loss_c,
        "{charge:?}"
    );
    assert!(
        charge.error_c.abs() <= charge.bound_c + declared_c,
        "{charge:?}"
    );
    assert!(
        bench
            .rig
            .view
            .diagnoses
            .contains_key("ChargeRestoredWithLoss"),
        "{:?}",
        bench.rig.view.diagnoses
    );
    assert_eq!(bench.signal("Charge", "ChargeEstimated"), 1.0);
    let complaints = bench.complaints(&["SocUncertain", "ChargeRestoredWithLoss"]);
    assert!(complaints.is_empty(), "{complaints:?}");
}
