//! State of charge on the running image: counted over a drive, anchored on the open-circuit voltage after a rest (D2
//! names both methods), kept over a reset. The battery is the plant's: 40 strings of the Panasonic 18650PF with
//! polarisation and hysteresis, whose voltage has not quite come to rest after the shortest rest that can be set.

use crate::support::{Bench, Ended, firmware};
use core_logic::retained::{RetainedState, SLOT_WORDS, from_words, to_words};
use core_logic::units::Nanocoulombs;
use emulator::bus_view::validity;
use emulator::image::{SRAM_LENGTH, SRAM_START};
use emulator::mcu::rcc::ResetCause;
use emulator::scenario::{Contactors, Row};
use plant::ade7753::Flip;
use plant::battery::{Battery, BatteryConfig};

const STRINGS: f64 = 40.0;
/// The ADE7753's register CHKSUM.
const CHECKSUM: u8 = 0x3E;
/// What the battery really holds at the beginning.
const TRUE_SOC: f64 = 0.72;
/// What the board believes, and how certain it is of it.
const BELIEVED_SOC: f64 = 0.76;
const BELIEVED_WITHIN: f64 = 0.06;
/// The shortest that can be set.
const REST_S: f64 = 60.0;
/// For so long the voltage has to stand still: a new one begins with every millivolt.
const STABLE_S: f64 = 2.0;
/// What the cell's voltage may still be off after it: relaxation and hysteresis, table.
const OCV_WITHIN_V: f64 = 0.008;
/// Rows of the battery's voltage.
const STEP_S: f64 = 0.1;

/// Time and current of the drive.
const DRIVE: [(f64, f64); 7] = [
    (0.0, 0.0),
    (0.5, 120.0),
    (8.0, 120.0),
    (8.5, -40.0),
    (9.5, -40.0),
    (9.8, 0.0),
    (10.0, 0.0),
];

fn current_at(t_s: f64) -> f64 {
    let after = DRIVE.partition_point(|point| point.0 < t_s).max(1);
    let (Some(to), from) = (DRIVE.get(after), DRIVE[after - 1]) else {
        return 0.0;
    };
    from.1 + (to.1 - from.1) * (t_s - from.0) / (to.0 - from.0)
}

/// The board believes something else of the battery, as after a long time without a rest: both copies of the state in
/// retained memory, found by their CRC, are written anew.
fn believe(bench: &mut Bench<'_>, capacity_c: f64) {
    let machine = &mut bench.rig.machine;
    let mut found = 0;
    for address in (SRAM_START..SRAM_START + SRAM_LENGTH - 4 * SLOT_WORDS as u32).step_by(4) {
        let words: [u32; SLOT_WORDS] =
            std::array::from_fn(|index| machine.ram_word(address + 4 * index as u32).unwrap());
        let Ok(mut state) = RetainedState::from_slot(&from_words(&words)) else {
            continue;
        };
        found += 1;
        let charge = |share: f64| Nanocoulombs((share * capacity_c * 1e9) as i64);
        state.soc.remaining = charge(BELIEVED_SOC);
        state.soc.uncertainty = charge(BELIEVED_WITHIN);
        state.soc.presented_offset = Nanocoulombs(0);
        state.soc.known = true;
        for (index, word) in to_words(&state.to_slot()).iter().enumerate() {
            machine.set_ram_word(address + 4 * index as u32, *word);
        }
    }
    assert!(found >= 2, "two copies, not {found}");
}

#[test]
fn rest_after_a_drive_re_anchors_the_state_of_charge_which_survives_a_reset() {
    let config = BatteryConfig {
        parallel: STRINGS,
        series: 96.0,
        ..BatteryConfig::panasonic_18650pf()
    };
    let capacity_ah = config.capacity_ah * STRINGS;
    let mut battery = Battery::new(config, TRUE_SOC, 25.0);
    let row = |t_s: f64, battery: &Battery| Row {
        cell_v: Some(battery.output().cell_v),
        pack_v: Some(battery.output().terminal_v),
        cell_temperature_c: Some(battery.output().temperature_c),
        ..Row::at_rest(t_s).with_current(current_at(t_s))
    };
    let at_rest = row(0.0, &battery);
    let drive_s = DRIVE[DRIVE.len() - 1].0;
    let steps = ((drive_s + REST_S + 20.0) / STEP_S) as u32;
    let mut soc_after_drive = TRUE_SOC;
    let rows: Vec<Row> = (0..=steps)
        .map(|step| {
            let t_s = f64::from(step) * STEP_S;
            if step > 0 {
                battery.step(STEP_S, current_at(t_s), 25.0);
            }
            if t_s <= drive_s {
                soc_after_drive = battery.output().soc;
            }
            row(t_s, &battery)
        })
        .collect();

    let firmware = firmware();
    let mut bench = Bench::nominal(&firmware, at_rest, Contactors::AlwaysClosed);
    assert!(
        bench.rig.view.soc_pct().valid().is_none(),
        "nothing is known yet"
    );
    bench.set("capacity", &[(capacity_ah * 1e3).round() as i64]);
    bench.set("rest time", &[REST_S as i64]);
    bench.set("stability window", &[STABLE_S as i64]);
    bench.set("open-circuit uncertainty", &[(OCV_WITHIN_V * 1e6) as i64]);
    bench.set("presented slew", &[10_000]);
    assert_eq!(bench.command("save", 2.0), Ended::Done);
    bench.run(0.3);
    believe(&mut bench, capacity_ah * 3600.0);
    bench.rig.machine.reset(ResetCause::Software);
    bench.settle();
    // In %: value and half-width.
    let soc = |bench: &Bench<'_>| {
        (
            bench.signal("StateOfCharge", "StateOfCharge"),
            bench.signal("StateOfCharge", "StateOfChargeUncertainty"),
        )
    };
    let (before, within) = soc(&bench);
    println!(
        "SoC: {before:.2} % ± {within:.1} % before the drive, in truth {:.2} %",
        TRUE_SOC * 100.0
    );
    assert!(
        (before - BELIEVED_SOC * 100.0).abs() < 0.02,
        "kept over the reset: {before}"
    );

    // The drive: counted.
    let true_0 = bench.rig.truth().charge_c;
    let shifted: Vec<Row> = {
        let start_s = bench.now_s();
        rows.iter()
            .map(|row| Row {
                t_s: row.t_s + start_s,
                ..*row
            })
            .collect()
    };
    let start_s = bench.now_s();
    bench
        .rig
        .machine
        .board(|board| board.scenario.replace(shifted));
    bench.run(drive_s + 0.3);
    let (driven, within) = soc(&bench);
    let counted_pct = before - driven;
    let true_pct = (bench.rig.truth().charge_c - true_0) / (capacity_ah * 36.0);
    println!(
        "SoC: {driven:.2} % ± {within:.1} % after it: {counted_pct:.2} % counted, {true_pct:.3} % flowed; in truth {:.2} %",
        soc_after_drive * 100.0
    );
    // Both ends rounded to 0.01 %.
    assert!((counted_pct - true_pct).abs() <= 0.011);
    assert!((driven - soc_after_drive * 100.0).abs() <= within);
    assert_eq!(bench.input("anchorings"), 0);

    // The rest: not before its time, then at once.
    bench.run(REST_S - 5.0);
    assert_eq!(bench.input("anchorings"), 0, "too early");
    // The receiver of a single request is busy for longer than a millisecond: look at CAN. The remaining charge is the
    // estimate's, which moves at once.
    let counted_ah = bench.signal("StateOfCharge", "RemainingCharge");
    bench.until("the anchoring", 10.0, |rig| {
        rig.view
            .signal("StateOfCharge", "RemainingCharge")
            .is_some_and(|now| (now - counted_ah).abs() > 0.005 * capacity_ah)
    });
    let rested_s = bench.now_s() - start_s - drive_s;
    let (followed, way) = soc(&bench);
    assert!(
        (followed - soc_after_drive * 100.0).abs() <= way,
        "{followed} ± {way} % on the way to the estimate"
    );
    // The presented value follows by 1 % a second.
    bench.run(5.0);
    assert_eq!(bench.input("anchorings"), 1);
    let (anchored, within) = soc(&bench);
    let true_soc = soc_after_drive * 100.0;
    println!(
        "SoC: {anchored:.2} % ± {within:.1} % after {rested_s:.1} s of rest, in truth {true_soc:.2} %: off by {:+.2} %",
        anchored - true_soc
    );
    assert!(
        (REST_S..REST_S + STABLE_S + 1.5).contains(&rested_s),
        "{rested_s} s"
    );
    assert!(
        (anchored - true_soc).abs() <= within,
        "within what it states"
    );
    assert!(
        within < 1.5,
        "the table says more than the count did: ± {within} %"
    );
    assert!(
        (anchored - true_soc).abs() < 0.5 * (driven - true_soc).abs(),
        "and it is nearer than before"
    );
    let reading = bench.rig.view.soc_pct();
    assert!(reading.valid().is_some(), "{reading:?}");

    bench.rig.machine.reset(ResetCause::Software);
    let reset_at = bench.rig.machine.now();
    bench.settle();
    assert!(bench.rig.view.last_at("StateOfCharge").unwrap() > reset_at);
    let (kept, kept_within) = soc(&bench);
    println!("SoC: {kept:.2} % ± {kept_within:.1} % after a reset");
    assert!((kept - anchored).abs() <= 0.011, "{kept} after {anchored}");
    // The reset may have cost charge, 600 A for 0.6 s, and says so.
    let declared_pct = 600.0 * 0.6 / (capacity_ah * 36.0);
    assert!(
        (kept_within - within - declared_pct).abs() <= 0.11,
        "{kept_within} after {within}"
    );
}

/// It goes on from the meter's charge: without that it stands still while the current flows.
#[test]
fn state_of_charge_is_not_valid_while_the_meter_does_not_answer() {
    let firmware = firmware();
    let row = Row::at_rest(0.0).with_current(50.0);
    let mut bench = Bench::nominal(&firmware, row, Contactors::AlwaysClosed);
    let capacity_c = bench.settings("capacity")[0] as f64 * 3.6;
    believe(&mut bench, capacity_c);
    bench.rig.machine.reset(ResetCause::Software);
    bench.settle();
    let before = bench.rig.view.soc_pct();
    assert!(before.valid().is_some(), "{before:?}");
    // Each read fails its checksum for a second: to the firmware a chip that counts, which nobody can read.
    let now_s = bench.now_s();
    bench.rig.machine.board(|board| {
        for _ in 0..250 {
            board.meter.flip_bits(now_s, CHECKSUM, Flip::Mask(1));
        }
    });
    bench.until("MeterNoAnswer", 0.4, |rig| {
        rig.view.active_diagnoses().contains(&"MeterNoAnswer")
    });
    // The frame.
    bench.run(0.1);
    let meanwhile = bench.rig.view.soc_pct();
    bench.run(2.5);
    let after = bench.rig.view.soc_pct();
    println!("SoC: {before:?}, then {meanwhile:?}, then {after:?}");
    assert!(
        meanwhile.validity & validity::CHIP_FAULT != 0,
        "{meanwhile:?}"
    );
    assert!(after.valid().is_some(), "{after:?}");
}
