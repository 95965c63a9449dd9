//! The image itself on the emulated board: what a healthy board must not do, and what an order must end in.
//!
//! The image as `rig::default_image` finds it.

use core_logic::can::layout::{Direction, MESSAGES, Message};
use emulator::can_frame::CanFrame;
use emulator::faults::Fault;
use emulator::mcu::flash_interface::FlashInterface;
use emulator::mcu::iwdg::{Iwdg, IwdgParameters};
use emulator::mcu::rcc::ResetCause;
use emulator::rig::{Firmware, Rig, Setup};
use emulator::scenario::{Contactors, Key, Row, Scenario};
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

/// docs/firmware.md wants the option bytes programmed with the image.
#[test]
fn a_brown_out_detector_that_is_off_is_told_at_each_start() {
    let firmware = firmware();
    let told = |rig: &mut Rig<'_>| {
        rig.run_s(0.1).unwrap();
        let lines = std::mem::take(&mut rig.log);
        lines
            .iter()
            .filter(|line| line.contains("brown-out"))
            .count()
    };
    let mut rig = Rig::new(&firmware, driving(10.0)).unwrap();
    assert_eq!(told(&mut rig), 0);
    rig.machine.flash(FlashInterface::set_delivered);
    rig.machine.reset(ResetCause::Pin);
    assert_eq!(told(&mut rig), 1);
}

/// Errata ES0182: the first revision's prefetch must stay off, and it calls itself 0x2000_6411.
#[test]
fn the_flash_is_prefetched_but_on_revision_a() {
    let firmware = firmware();
    for (idcode, prefetches) in [
        (0x2000_6411, false),
        (0x1000_6413, false),
        (0x1001_6413, true),
        (0x1007_6413, true),
        (0x100F_6413, true),
    ] {
        let mut rig = Rig::new(&firmware, driving(10.0)).unwrap();
        rig.machine.set_idcode(idcode);
        rig.run_s(0.1).unwrap();
        rig.machine.flash(|flash| {
            assert_eq!(flash.prefetch(), prefetches, "{idcode:#x}");
            assert_eq!(flash.wait_states(), 5);
        });
    }
}

/// ST's driver lets the watchdog's registers take periods of the *prescaled* clock to come into force, 48 ms at most; 25 ms here. Nothing
/// feeds a board whose crystal does not swing after the first time: it must not be left with the reset's 7.7 s.
#[test]
fn a_slow_watchdog_still_ends_a_start_without_a_crystal() {
    let firmware = firmware();
    let mut rig = Rig::new(&firmware, driving(10.0)).unwrap();
    rig.machine.clocks(|rcc, iwdg| {
        rcc.set_crystal_swings(false);
        *iwdg = Iwdg::new(IwdgParameters {
            lsi_hz: 17_000.0,
            update_cycles: 17 * 25,
            ..IwdgParameters::default()
        });
    });
    // The firmware counts its questions: each of them is executed.
    rig.machine.set_exact(true);
    rig.run_s(0.06).unwrap();
    rig.machine.set_exact(false);
    rig.run_s(2.0).unwrap();
    let reset = rig.machine.resets().get(1).copied().unwrap();
    assert_eq!(reset.cause, ResetCause::IndependentWatchdog);
    assert!((1.85..1.95).contains(&reset.at.seconds()), "{reset:?}");
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

/// `GenMsgStartDelayTime` of can/board.dbc, which is compared with these headers: counted from the first `Current`.
#[test]
fn each_message_first_goes_out_when_the_dbc_says() {
    let firmware = firmware();
    let mut rig = Rig::new(&firmware, driving(10.0)).unwrap();
    let mut first_ms = [None; MESSAGES.len()];
    for ms in 0..1_500_u32 {
        rig.run_s(0.001).unwrap();
        for (message, first_ms) in MESSAGES.iter().zip(&mut first_ms) {
            if rig.view.period(message.name).frames > 0 {
                first_ms.get_or_insert(ms);
            }
        }
    }
    let begin_ms = first_ms[0].unwrap();
    assert_eq!(MESSAGES[0].name, "Current");
    for (message, first_ms) in MESSAGES.iter().zip(first_ms) {
        if message.header.direction == Direction::Received {
            continue;
        }
        // Up to four frames of 0.25 ms in one tick, and the look every millisecond.
        let delay_ms = first_ms.unwrap() - begin_ms;
        let expected_ms = u32::from(message.header.phase_ms);
        assert!(
            (expected_ms..=expected_ms + 2).contains(&delay_ms),
            "{}: {delay_ms} ms",
            message.name
        );
    }
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

/// Holding registers as words.
fn settings(rig: &mut Rig<'_>, address: u16, count: u16) -> Vec<u16> {
    let ([a, b], [c, d]) = (address.to_be_bytes(), count.to_be_bytes());
    let answer = rig.modbus(&[1, 3, a, b, c, d]).unwrap();
    assert_eq!(answer[..2], [1, 3], "{answer:02X?}");
    answer[3..]
        .chunks(2)
        .map(|word| u16::from_be_bytes([word[0], word[1]]))
        .collect()
}

/// Writes holding registers; the exception code if the board refuses.
fn set(rig: &mut Rig<'_>, address: u16, words: &[u16]) -> Result<(), u8> {
    let ([a, b], [c, d]) = (address.to_be_bytes(), (words.len() as u16).to_be_bytes());
    let mut request = vec![1, 0x10, a, b, c, d, 2 * words.len() as u8];
    request.extend(words.iter().flat_map(|word| word.to_be_bytes()));
    let answer = rig.modbus(&request).unwrap();
    if answer[1] & 0x80 != 0 {
        return Err(answer[2]);
    }
    Ok(())
}

fn words_of(value: i32) -> [u16; 2] {
    [(value >> 16) as u16, value as u16]
}

/// Count and points contradict each other when they come one after the other: one request carries both.
#[test]
fn a_client_sets_an_open_circuit_table_of_any_length() {
    const COUNT: u16 = 0x0781;
    let firmware = firmware();
    let mut rig = Rig::new(&firmware, driving(0.0)).unwrap();
    rig.run_s(0.5).unwrap();
    assert_eq!(settings(&mut rig, COUNT, 1), [11]);
    for points in [21, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11] {
        let soc = |n: i32| match n {
            n if n < points => n * 1_000_000 / (points - 1),
            _ => 0,
        };
        let voltage = |n: i32| match n {
            n if n < points => 3_000_000 + n * 1_200_000 / (points - 1),
            _ => 0,
        };
        let mut words = vec![points as u16];
        words.extend((0..21).flat_map(|n| words_of(soc(n))));
        words.extend((0..21).flat_map(|n| words_of(voltage(n))));
        assert_eq!(set(&mut rig, COUNT, &words), Ok(()), "{points} points");
        assert_eq!(settings(&mut rig, COUNT, 85), words, "{points} points");
    }
    // The count alone would leave a table that does not end at full charge.
    assert_eq!(set(&mut rig, COUNT, &[10]), Err(3));
}

/// A factor of 2 % in place of none; what is taken by key state later still replaces it.
#[test]
fn key_factors_that_a_client_sets_are_used() {
    let firmware = firmware();
    let mut parked = Row::at_rest(0.0).with_key(Key::Off);
    // A sensor that reads 10.7 A.
    parked.output_shift_v = 0.4;
    let scenario = Scenario::steady(parked, Contactors::Permitted);
    let mut rig = Rig::new(&firmware, Setup::nominal(scenario)).unwrap();
    rig.run_s(1.5).unwrap();
    let before_a = rig.view.current_a().value.unwrap();
    assert_eq!(set(&mut rig, 0x0420, &words_of(1_020_000_000)), Ok(()));
    rig.run_s(0.5).unwrap();
    let after_a = rig.view.current_a().value.unwrap();
    // 2 % of 2.9 V, at 37.5 mV/A.
    let moved_a = after_a - before_a;
    assert!((moved_a - 1.547).abs() < 0.05, "{before_a} {after_a}");
    // They outlive a reset, and are what a client reads.
    rig.machine.reset(ResetCause::Software);
    rig.view = Default::default();
    rig.run_s(1.0).unwrap();
    let reset_a = rig.view.current_a().value.unwrap();
    assert!((reset_a - after_a).abs() < 0.05, "{after_a} {reset_a}");
    assert_eq!(settings(&mut rig, 0x0420, 2), words_of(1_020_000_000));
    assert_eq!(set(&mut rig, 0x0420, &words_of(1_000_000_000)), Ok(()));
    rig.run_s(0.5).unwrap();
    let back_a = rig.view.current_a().value.unwrap();
    assert!((back_a - before_a).abs() < 0.05, "{before_a} {back_a}");
}

/// Over a loss of power those that were saved: not what the charge's record had before the save, nor what came after it.
#[test]
fn key_factors_that_were_saved_are_in_force_after_a_loss_of_power() {
    const FACTOR_K: u16 = 0x0420;
    let firmware = firmware();
    let parked = Row::at_rest(0.0).with_key(Key::Off);
    let scenario = Scenario::steady(parked, Contactors::Permitted);
    let mut rig = Rig::new(&firmware, Setup::nominal(scenario)).unwrap();
    rig.run_s(1.5).unwrap();
    assert_eq!(set(&mut rig, FACTOR_K, &words_of(1_020_000_000)), Ok(()));
    assert_eq!(set(&mut rig, 0x0000, &[0x5A07]), Ok(()));
    rig.run_s(0.5).unwrap();
    for _ in 0..2 {
        rig.power_cycle();
        rig.view = Default::default();
        rig.run_s(1.0).unwrap();
        assert_eq!(settings(&mut rig, FACTOR_K, 2), words_of(1_020_000_000));
        // Not saved.
        assert_eq!(set(&mut rig, FACTOR_K, &words_of(1_030_000_000)), Ok(()));
        rig.run_s(0.5).unwrap();
    }
}

/// Not at the factory's address either, which may be another one's on the line.
#[test]
fn nobody_is_answered_before_the_configuration_is_loaded() {
    let firmware = firmware();
    let mut rig = Rig::new(&firmware, driving(0.0)).unwrap();
    rig.run_s(0.5).unwrap();
    assert_eq!(set(&mut rig, 0x0900, &[7]), Ok(()));
    let ask = |rig: &mut Rig<'_>, address: u8| rig.modbus(&[address, 4, 0, 0x28, 0, 4]);
    assert!(rig.modbus(&[7, 6, 0, 0, 0x5A, 0x07]).is_ok());
    rig.run_s(0.5).unwrap();
    rig.power_cycle();
    rig.view = Default::default();
    // A flash that answers late: time for a request.
    let now_s = rig.now_s();
    rig.machine.board(|board| {
        board.flash.power_off(now_s);
        board.flash.power_on(now_s + 0.3);
    });
    rig.run_for(Ticks::from_millis(100)).unwrap();
    assert!(rig.view.current_a().value.is_none(), "it measures already");
    assert!(ask(&mut rig, 1).is_err());
    assert!(ask(&mut rig, 7).is_ok());
}

/// 25 °C is too warm when the limit is 10 °C.
#[test]
fn temperature_limits_that_a_client_sets_are_used() {
    let firmware = firmware();
    let mut rig = Rig::new(&firmware, driving(0.0)).unwrap();
    rig.run_s(1.0).unwrap();
    assert!(!rig.view.diagnoses.contains_key("TemperatureOutOfRange"));
    let mut words = words_of(-55_000).to_vec();
    words.extend(words_of(10_000));
    assert_eq!(set(&mut rig, 0x0808, &words), Ok(()));
    rig.run_s(3.0).unwrap();
    let active = rig.view.active_diagnoses();
    assert!(active.contains(&"TemperatureOutOfRange"), "{active:?}");
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
        .as_chunks()
        .0
        .iter()
        .map(|bytes| u32::from_be_bytes(*bytes))
        .collect();
    assert_eq!((counters[1], counters[5]), (0, 0), "{counters:?}");
    let wait_s = rig.machine.usart(|usart| usart.longest_wait()).seconds();
    assert!(wait_s > 0.0 && wait_s <= 5.8e-6, "{wait_s}");
    println!("longest wait of a character: {:.2} µs", wait_s * 1e6);
}
