//! A board on the bench, with what the tests ask it.

use std::sync::LazyLock;

use core_logic::design_parameters::{LARGE_FULL_SCALE, SMALL_FULL_SCALE};
use core_logic::error_budget::charge_per_count;
use core_logic::range::Range;
use emulator::board::Board;
use emulator::faults::Fault;
use emulator::rig::{Firmware, Rig, Setup};
use emulator::scenario::{Contactors, Row, Scenario};
use emulator::time::Ticks;

static FIRMWARE: LazyLock<Firmware> = LazyLock::new(|| Firmware::load_default().unwrap());

/// When the boards of these tests have started and the meter's self-test is over.
pub const SETTLED_S: f64 = 0.5;

pub fn firmware() -> &'static Firmware {
    &FIRMWARE
}

pub fn rig_of(setup: Setup) -> Rig<'static> {
    Rig::new(firmware(), setup).unwrap()
}

/// At rest, with a battery management that sends.
pub fn row(t_s: f64) -> Row {
    Row {
        cell_v: Some(3.7),
        pack_v: Some(355.0),
        cell_temperature_c: Some(25.0),
        ..Row::at_rest(t_s)
    }
}

/// `current_a` for ever; settled.
pub fn steady(current_a: f64) -> Rig<'static> {
    let row = row(0.0).with_current(current_a);
    let mut rig = rig_of(Setup::nominal(Scenario::steady(
        row,
        Contactors::AlwaysClosed,
    )));
    rig.run_s(SETTLED_S).unwrap();
    rig
}

/// Rest, `current_a` from [`SETTLED_S`] + 0.2 s for `length_s`, rest: what is counted can be compared without a frame's
/// age. Settled, before the current.
pub fn pulse(current_a: f64, length_s: f64) -> Rig<'static> {
    pulse_with(current_a, length_s, None)
}

/// The same with a fault from power-on.
pub fn pulse_with(
    current_a: f64,
    length_s: f64,
    fault: impl Into<Option<&'static str>>,
) -> Rig<'static> {
    pulse_after(current_a, length_s, |rig| {
        if let Some(fault) = fault.into() {
            Fault::parse(fault).unwrap().apply(rig, Ticks(0));
        }
    })
}

/// The same with something done to the board before power-on.
pub fn pulse_after(
    current_a: f64,
    length_s: f64,
    prepare: impl FnOnce(&mut Rig<'static>),
) -> Rig<'static> {
    let start_s = SETTLED_S + 0.2;
    let rows = vec![
        row(0.0),
        row(start_s),
        row(start_s + 0.01).with_current(current_a),
        row(start_s + 0.01 + length_s).with_current(current_a),
        row(start_s + 0.02 + length_s),
    ];
    let mut rig = rig_of(Setup::nominal(
        Scenario::new(rows, Contactors::AlwaysClosed).unwrap(),
    ));
    prepare(&mut rig);
    rig.run_s(SETTLED_S).unwrap();
    rig
}

/// Charge of the newest frame, in C, whatever stands against it.
pub fn charge_c(rig: &Rig<'_>) -> f64 {
    rig.view.charge_c().value.expect("a charge on CAN")
}

/// What the board declares its charge to be off by at most, in C.
pub fn charge_bound_c(rig: &Rig<'_>) -> f64 {
    let bound_c = rig.view.signal("MeterCurrent", "ChargeUncertainty");
    bound_c.unwrap()
}

/// What the board has counted too much, in C, since `from` (its charge and the true one then).
pub fn charge_error_c(rig: &mut Rig<'_>, from: (f64, f64)) -> f64 {
    let counted_c = charge_c(rig) - from.0;
    let true_c = rig.truth().charge_c - from.1;
    counted_c - true_c
}

/// For [`charge_error_c`].
pub fn charges_c(rig: &mut Rig<'_>) -> (f64, f64) {
    (charge_c(rig), rig.truth().charge_c)
}

/// What AENERGY and the frame on CAN leave uncertain in a difference of two charges: one count and 1 mC.
pub fn quantum_c(range: Range) -> f64 {
    charge_per_count(range).get() as f64 * 1e-9 + 1e-3
}

/// Full scale of a range, in A.
pub fn full_scale_a(range: Range) -> f64 {
    let microamps = match range {
        Range::Small => SMALL_FULL_SCALE,
        Range::Large => LARGE_FULL_SCALE,
    };
    f64::from(microamps.get()) * 1e-6
}

/// Puts a fault in now.
pub fn strike(rig: &mut Rig<'_>, fault: &str) {
    let now = rig.machine.now();
    Fault::parse(fault).unwrap().apply(rig, now);
    rig.run_for(Ticks(0)).unwrap();
}

/// Time until `code` is on the bus, in s.
pub fn until_diagnosis(rig: &mut Rig<'_>, code: &str, limit_s: f64) -> f64 {
    until(rig, code, limit_s, |rig| {
        rig.view.active_diagnoses().contains(&code)
    })
}

/// Time until `condition` holds, in s; to a millisecond.
pub fn until(
    rig: &mut Rig<'_>,
    what: &str,
    limit_s: f64,
    mut condition: impl FnMut(&mut Rig<'_>) -> bool,
) -> f64 {
    let start = rig.machine.now();
    while !condition(rig) {
        assert!(
            rig.machine.now().since(start).seconds() < limit_s,
            "{what} did not come within {limit_s} s; active {:?}, log {:#?}",
            rig.view.active_diagnoses(),
            last_words(rig)
        );
        rig.run_for(Ticks::from_millis(1)).unwrap();
    }
    rig.machine.now().since(start).seconds()
}

/// Runs for `length_s` and looks every millisecond.
pub fn watch(rig: &mut Rig<'_>, length_s: f64, mut look: impl FnMut(&mut Rig<'_>)) {
    let end = rig.machine.now() + Ticks::from_seconds(length_s);
    while rig.machine.now() < end {
        rig.run_for(Ticks::from_millis(1)).unwrap();
        look(rig);
    }
}

pub fn last_words<'rig>(rig: &'rig Rig<'_>) -> &'rig [String] {
    &rig.log[rig.log.len().saturating_sub(12)..]
}

/// Whether a diagnosis is kept until it is cleared, by the newest frame that says so.
pub fn is_latched(rig: &Rig<'_>, code: &str) -> bool {
    rig.view.latched_diagnoses().contains(&code)
}

/// Diagnoses that were on the bus as active, or are kept as latched: what lasts for one tick is seen only there.
fn raised(rig: &Rig<'_>) -> Vec<&'static str> {
    let mut raised: Vec<&str> = rig.view.diagnoses.keys().copied().collect();
    raised.extend(rig.view.latched_diagnoses());
    raised.sort_unstable();
    raised.dedup();
    raised
}

/// Whether a diagnosis was ever raised.
pub fn was_raised(rig: &Rig<'_>, code: &str) -> bool {
    raised(rig).contains(&code)
}

/// Diagnoses that were raised, but for `expected` and the one that a board without history cannot but raise.
pub fn unexpected(rig: &Rig<'_>, expected: &[&str]) -> Vec<&'static str> {
    let mut raised = raised(rig);
    raised.retain(|code| *code != "SocUncertain" && !expected.contains(code));
    raised
}

/// Resets after the power-on.
pub fn resets(rig: &Rig<'_>) -> usize {
    rig.machine.resets().len() - 1
}

/// Input registers (function 4) as words.
pub fn input_registers(rig: &mut Rig<'_>, address: u16, count: u16) -> Vec<u16> {
    registers(rig, 4, address, count)
}

/// Holding registers (function 3) as words.
pub fn holding_registers(rig: &mut Rig<'_>, address: u16, count: u16) -> Vec<u16> {
    registers(rig, 3, address, count)
}

fn registers(rig: &mut Rig<'_>, function: u8, address: u16, count: u16) -> Vec<u16> {
    let ([a, b], [c, d]) = (address.to_be_bytes(), count.to_be_bytes());
    let answer = rig.modbus(&[1, function, a, b, c, d]).unwrap();
    assert_eq!(answer[..2], [1, function], "{answer:02X?}");
    answer[3..]
        .chunks(2)
        .map(|word| u16::from_be_bytes([word[0], word[1]]))
        .collect()
}

/// 32-bit input registers, most significant word first.
pub fn counters(rig: &mut Rig<'_>, address: u16, count: u16) -> Vec<u32> {
    input_registers(rig, address, 2 * count)
        .chunks(2)
        .map(|words| u32::from(words[0]) << 16 | u32::from(words[1]))
        .collect()
}

/// Writes holding registers; the exception code if the board refuses.
pub fn write_registers(rig: &mut Rig<'_>, address: u16, words: &[u16]) -> Result<(), u8> {
    let ([a, b], [c, d]) = (address.to_be_bytes(), (words.len() as u16).to_be_bytes());
    let mut request = vec![1, 16, a, b, c, d, 2 * words.len() as u8];
    request.extend(words.iter().flat_map(|word| word.to_be_bytes()));
    let answer = rig.modbus(&request).unwrap();
    if answer[1] & 0x80 != 0 {
        Err(answer[2])
    } else {
        Ok(())
    }
}

/// A command by its number; the exception code if the board refuses.
pub fn command(rig: &mut Rig<'_>, number: u16) -> Result<(), u8> {
    write_registers(rig, 0, &[0x5A00 | number])
}

/// Works on the board.
pub fn board<T>(rig: &mut Rig<'_>, work: impl FnOnce(&mut Board) -> T) -> T {
    rig.machine.board(work)
}
