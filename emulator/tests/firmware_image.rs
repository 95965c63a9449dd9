//! The image itself on the emulated board: what a healthy board must not do, and what an order must end in.
//!
//! The image as `rig::default_image` finds it.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use core_logic::can::layout::{MESSAGES, Message};
use emulator::can_frame::CanFrame;
use emulator::faults::Fault;
use emulator::rig::{Firmware, Rig, Setup};
use emulator::scenario::{Contactors, Row, Scenario};
use emulator::time::Ticks;

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

/// docs/architecture.md: 0.5 ms of jitter; here with a bus that others fill, a client on RS485, a sensor supply that
/// moves, so that the meter's factors are worked out anew, and from the first frame on.
#[test]
fn current_frames_keep_their_period_under_load() {
    let firmware = firmware();
    let row = |t_s: f64, sensor_supply_v: f64| Row {
        sensor_supply_v,
        ..Row::at_rest(t_s).with_current(40.0)
    };
    let rows = (0..=10).map(|n| row(f64::from(n) * 0.2, if n % 2 == 0 { 4.9 } else { 5.1 }));
    let scenario = Scenario::new(rows.collect(), Contactors::AlwaysClosed).unwrap();
    let mut rig = Rig::new(&firmware, Setup::nominal(scenario)).unwrap();
    // Input registers 0 … 99, with the CRC.
    let read_inputs = [1, 4, 0, 0, 0, 100, 0xF1, 0xE1];
    for ms in 0..2_000_u32 {
        // Three frames of 0.25 ms in every millisecond; none of them goes before the board's.
        for _ in 0..3 {
            rig.send_can(CanFrame::standard(0x700, &[0x55; 8]));
        }
        if ms % 50 == 0 {
            rig.send_rs485(&read_inputs);
        }
        rig.run_s(0.001).unwrap();
    }
    let period = rig.view.period("Current");
    assert!(period.frames > 180, "{period:?}");
    assert!(
        period.shortest_s > 0.0095 && period.longest_s < 0.0105,
        "{period:?}"
    );
    assert!(!rig.take_rs485().is_empty());
}

/// A frame is given up after 20 ms on a bus that others fill. Some are on the bus in just that moment, and go out.
#[test]
fn every_frame_that_goes_out_is_counted_once() {
    let firmware = firmware();
    let mut rig = Rig::new(&firmware, driving(10.0)).unwrap();
    rig.run_s(0.3).unwrap();
    for frames in 80..120 {
        // 0.24 ms each, before any frame of the board's: 19 … 29 ms, so that the bus is free around the step that gives up.
        for _ in 0..frames {
            rig.send_can(CanFrame::standard(0x001, &[0x55; 8]));
        }
        rig.run_s(0.05).unwrap();
    }
    let on_the_bus = |rig: &Rig<'_>| -> u64 {
        let frames = |message: &Message| rig.view.period(message.name).frames;
        MESSAGES.iter().map(frames).sum()
    };
    let before = on_the_bus(&rig);
    let answer = rig.modbus(&[1, 4, 0x01, 0x20, 0, 2]).unwrap();
    let after = on_the_bus(&rig);
    let sent = u64::from(u32::from_be_bytes(answer[3..7].try_into().unwrap()));
    assert!((before..=after).contains(&sent), "{before} {sent} {after}");
}

/// Writes and reads in turn, each read at another time after its write, while the meter's owner takes the changed
/// configuration, sets the chip up anew after resets (0.6 ms) and follows a flag that chatters. The bound on a character's
/// wait is that of docs/firmware.md, *RS485*, with one range edge: at 10 kHz two of them are 30 µs apart. From 95 µs on
/// characters would be lost.
#[test]
fn every_request_is_answered_whatever_else_the_board_does() {
    let firmware = firmware();
    let mut rig = Rig::new(&firmware, driving(53.3)).unwrap();
    rig.run_s(0.5).unwrap();
    let chatter = Fault::parse("F9:10kHz,30%,10s").unwrap();
    chatter.apply(&mut rig, Ticks(0));
    let reset = Fault::parse("F5").unwrap();
    for turn in 0..60_u32 {
        // The no-load threshold, which may be written at any time: the meter's owner gets another calibration.
        let write = [1, 0x10, 0x05, 0x0C, 0, 2, 4, 0, 0, 0, 10 + (turn % 2) as u8];
        let answer = rig.modbus(&write);
        assert!(answer.is_ok(), "write {turn}: {answer:?}");
        if turn % 3 == 0 {
            reset.apply(&mut rig, Ticks(0));
        }
        // The hand-over lies within a tick and a poll of the answer: 30 ms.
        rig.run_for(Ticks::from_micros(u64::from(turn) * 7_717 % 30_000))
            .unwrap();
        let answer = rig.modbus(&[1, 4, 0, 0x28, 0, 4]);
        assert!(answer.is_ok(), "read {turn}: {answer:?}");
    }
    // Messages, communication errors … character overruns.
    let answer = rig.modbus(&[1, 4, 0x01, 0x30, 0, 12]).unwrap();
    let counters: Vec<u32> = answer[3..]
        .chunks_exact(4)
        .map(|bytes| u32::from_be_bytes(bytes.try_into().unwrap()))
        .collect();
    assert_eq!((counters[1], counters[5]), (0, 0), "{counters:?}");
    let wait_s = rig.machine.usart(|usart| usart.longest_wait()).seconds();
    assert!(wait_s > 0.0 && wait_s <= 5.8e-6, "{wait_s}");
    println!("longest wait of a character: {:.2} µs", wait_s * 1e6);
}
