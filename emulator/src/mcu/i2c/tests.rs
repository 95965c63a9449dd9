#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use proptest::prelude::*;

use super::super::bench::Bench;
use super::*;
use crate::i2c_bus::{Ending, I2cFault, OTHER_MASTER};
use crate::outside::Outside;

const CR1: u32 = 0x00;
const CR2: u32 = 0x04;
const DR: u32 = 0x10;
const SR1: u32 = 0x14;
const SR2: u32 = 0x18;
const CCR: u32 = 0x1C;
const TRISE: u32 = 0x20;

/// 42 MHz / 3 / 35 = 400 kHz: low 70 and high 35 clocks of 8 units of 1/336 µs.
const LOW: Ticks = Ticks(70 * 8);
const HIGH: Ticks = Ticks(35 * 8);
const BIT: Ticks = Ticks(105 * 8);
const BYTE: Ticks = Ticks(9 * 105 * 8);
const SLAVE: u8 = 0x48;

/// Standard library names of event combinations, SR2 << 16 | SR1 (RM0090, 27.3.3).
const MASTER_MODE: u32 = 0x0003_0001;
const TRANSMITTER: u32 = 0x0007_0082;
const RECEIVER: u32 = 0x0003_0002;
const BYTE_TRANSMITTED: u32 = 0x0007_0084;
const BYTE_RECEIVED: u32 = 0x0003_0040;

fn configure(bench: &mut Bench<I2c>) {
    bench.write(CR1, u32::from(SWRST));
    bench.write(CR1, 0);
    bench.write(CR2, 42);
    bench.write(CCR, u32::from(FAST) | 35);
    bench.write(TRISE, 13);
    bench.write(CR1, u32::from(PE));
}

fn fast() -> Bench<I2c> {
    let mut bench = Bench::new(I2c::new());
    configure(&mut bench);
    bench
}

fn set(bench: &mut Bench<I2c>, bits: u16) {
    let value = bench.read(CR1);
    bench.write(CR1, value | u32::from(bits));
}

fn clear(bench: &mut Bench<I2c>, bits: u16) {
    let value = bench.read(CR1);
    bench.write(CR1, value & !u32::from(bits));
}

/// SR1 as it is, without the side effects of reading it.
fn sr1(bench: &Bench<I2c>) -> u16 {
    bench.peripheral.sr1
}

fn both(bench: &Bench<I2c>) -> u32 {
    u32::from(bench.peripheral.status_2()) << 16 | u32::from(sr1(bench))
}

fn wait(bench: &mut Bench<I2c>, flag: u16, step: Ticks) -> u32 {
    bench.poll(SR1, step, |status| status & u32::from(flag) != 0)
}

/// EV5 and the address phase.
fn address(bench: &mut Bench<I2c>, read: bool, step: Ticks) {
    set(bench, START | ACK);
    wait(bench, SB, step);
    bench.write(DR, u32::from(SLAVE << 1 | u8::from(read)));
    wait(bench, ADDR, step);
}

fn until_free(bench: &mut Bench<I2c>, step: Ticks) {
    bench.poll(SR2, step, |status| status & u32::from(BUSY) == 0);
}

/// Master transmitter, EV6 … EV8_2.
fn write_bytes(bench: &mut Bench<I2c>, bytes: &[u8], pause: &mut dyn FnMut() -> Ticks) {
    let step = pause();
    address(bench, false, step);
    bench.read(SR2);
    for byte in bytes {
        let step = pause();
        wait(bench, TXE, step);
        bench.write(DR, u32::from(*byte));
    }
    let step = pause();
    wait(bench, BTF, step);
}

/// Master receiver as the image does it: the three cases of the manual's closing procedure. `pause` is what passes
/// between two accesses where the manual allows it.
fn read_bytes(
    bench: &mut Bench<I2c>,
    length: usize,
    last: bool,
    pause: &mut dyn FnMut() -> Ticks,
) -> Vec<u8> {
    let step = pause();
    address(bench, true, step);
    match length {
        1 => {
            clear(bench, ACK);
            bench.read(SR2);
            if last {
                set(bench, STOP);
            }
        }
        2 => {
            set(bench, POS);
            bench.read(SR2);
            clear(bench, ACK);
        }
        _ => {
            bench.read(SR2);
        }
    }
    let mut bytes = Vec::new();
    for left in (1..=length).rev() {
        let step = pause();
        match left {
            3 => {
                wait(bench, BTF, step);
                clear(bench, ACK);
            }
            2 => {
                if length == 2 {
                    wait(bench, BTF, step);
                }
                if last {
                    set(bench, STOP);
                }
            }
            _ => {
                wait(bench, RXNE, step);
            }
        }
        bytes.push(bench.read(DR) as u8);
    }
    clear(bench, POS);
    bytes
}

fn micro() -> Ticks {
    Ticks::from_micros(1)
}

fn events(bench: &Bench<I2c>) -> Vec<I2cEvent> {
    bench.world.i2c.iter().map(|(event, _)| *event).collect()
}

#[test]
fn reset_values_are_the_manual_s() {
    let mut bench = Bench::new(I2c::new());
    for offset in [CR1, CR2, 0x08, 0x0C, DR, SR1, SR2, CCR] {
        assert_eq!(bench.read(offset), 0);
    }
    assert_eq!(bench.read(TRISE), 2);
    let mut used = fast();
    set(&mut used, START);
    used.with(|i2c, context| i2c.reset(context));
    assert_eq!(used.read(CCR), 0);
    assert_eq!(used.peripheral.next_event(), None);
}

#[test]
fn a_transmission_goes_through_the_manual_s_events() {
    let mut bench = fast();
    set(&mut bench, START);
    assert_eq!(bench.peripheral.next_event(), Some(HIGH));
    bench.run(HIGH);
    // EV5: SB, START cleared, no clock without the address.
    assert_eq!(both(&bench), MASTER_MODE);
    assert_eq!(bench.read(CR1), u32::from(PE));
    assert_eq!(bench.peripheral.next_event(), None);
    bench.run(Ticks::from_micros(50));
    bench.read(SR1);
    bench.write(DR, 0x90);
    assert_eq!(both(&bench), 0x0003_0000);
    let sent = bench.now;
    bench.run(BYTE);
    // EV6, TXE with it (EV8_1).
    assert_eq!(both(&bench), TRANSMITTER);
    assert_eq!(
        bench.world.i2c.last(),
        Some(&(I2cEvent::Address(0x90), sent + BYTE))
    );
    bench.run(Ticks::from_micros(50));
    bench.read(SR1);
    assert_eq!(bench.read(SR2), 0x0007);
    assert_eq!(sr1(&bench), TXE);
    // The first byte moves to the shift register at once, the second waits in DR.
    bench.write(DR, 0xAA);
    assert_eq!(sr1(&bench), TXE);
    bench.write(DR, 0xBB);
    assert_eq!(sr1(&bench), 0);
    bench.run(BYTE);
    assert_eq!(sr1(&bench), TXE);
    bench.run(BYTE);
    // EV8_2.
    assert_eq!(both(&bench), BYTE_TRANSMITTED);
    assert_eq!(bench.peripheral.next_event(), None);
    bench.read(SR1);
    bench.write(DR, 0xCC);
    assert_eq!(sr1(&bench), TXE);
    bench.run(BYTE);
    assert_eq!(both(&bench), BYTE_TRANSMITTED);
    let stop = bench.now;
    set(&mut bench, STOP);
    bench.run(LOW + HIGH);
    // TXE and BTF go with the stop, and so do MSL, BUSY, TRA and the STOP bit.
    assert_eq!(both(&bench), 0);
    assert_eq!(bench.read(CR1), u32::from(PE));
    assert_eq!(
        bench.world.i2c.last(),
        Some(&(I2cEvent::Stop, stop + LOW + HIGH))
    );
    assert_eq!(bench.world.slave.written, [0xAA, 0xBB, 0xCC]);
    assert_eq!(bench.world.slave.stops, 1);
}

#[test]
fn three_bytes_with_their_address_take_as_long_as_the_image_reckons() {
    let mut bench = fast();
    bench.world.slave.to_read.extend([0x12, 0x34, 0x8C]);
    let begin = bench.now;
    // A fast CPU: looks every 0.1 µs.
    let bytes = read_bytes(&mut bench, 3, true, &mut || Ticks(33));
    until_free(&mut bench, Ticks(33));
    assert_eq!(bytes, [0x12, 0x34, 0x8C]);
    let us = bench.now.since(begin).micros();
    // 36 bits of 2.5 µs, start and stop; docs/firmware.md: 93 µs.
    assert!((93.0..96.0).contains(&us), "{us} µs");
}

#[test]
fn duty_and_standard_mode_have_their_clocks() {
    // CCR, TRISE, bit in clocks of APB1 (27.6.8: 3, 25 and 2 times CCR).
    for (ccr, trise, low, high) in [
        (0x8000 | 35, 13, 70, 35),
        (0xC000 | 5, 13, 80, 45),
        (210, 43, 210, 210),
    ] {
        let mut bench = Bench::new(I2c::new());
        bench.write(CR2, 42);
        bench.write(CCR, ccr);
        bench.write(TRISE, trise);
        bench.write(CR1, u32::from(PE));
        set(&mut bench, START);
        assert_eq!(bench.peripheral.next_event(), Some(Ticks(high * 8)));
        bench.run(Ticks(high * 8));
        bench.read(SR1);
        let now = bench.now;
        bench.write(DR, 0x90);
        assert_eq!(
            bench.peripheral.next_event(),
            Some(now + Ticks((low + high) * 72))
        );
    }
}

#[test]
fn timing_registers_that_do_not_fit_are_errors() {
    // FREQ, CCR, TRISE.
    for (freq, ccr, trise, good) in [
        (42, 0x8000 | 35, 13, true),
        (41, 0x8000 | 35, 13, false),
        (42, 0x8000 | 34, 13, false),
        (42, 0x8000 | 36, 13, true),
        (42, 0x8000 | 35, 12, false),
        (42, 210, 43, true),
        (42, 209, 43, false),
        (42, 210, 13, false),
        (42, 0xC000 | 4, 13, false),
        (42, 0, 43, false),
    ] {
        let mut bench = Bench::new(I2c::new());
        bench.write(CR2, freq);
        bench.write(CCR, ccr);
        bench.write(TRISE, trise);
        bench.write(CR1, u32::from(PE));
        let started = bench.try_write(CR1, u32::from(PE | START));
        assert_eq!(started.is_ok(), good, "{freq} {ccr:#x} {trise}");
    }
    let mut bench = fast();
    assert!(bench.try_write(CCR, 0x8030).is_err());
    assert!(bench.try_write(TRISE, 14).is_err());
}

#[test]
fn one_byte_is_refused_and_stopped() {
    let mut bench = fast();
    bench.world.slave.to_read.extend([0x77, 0x66]);
    address(&mut bench, true, micro());
    assert_eq!(both(&bench), RECEIVER);
    clear(&mut bench, ACK);
    bench.read(SR2);
    assert_eq!(sr1(&bench), 0);
    set(&mut bench, STOP);
    bench.run(BYTE);
    assert_eq!(sr1(&bench), RXNE);
    bench.run(BIT);
    assert_eq!(bench.read(SR2), 0);
    assert_eq!(bench.read(DR), 0x77);
    assert_eq!(sr1(&bench), 0);
    assert_eq!(
        events(&bench),
        [
            I2cEvent::Start,
            I2cEvent::Address(0x91),
            I2cEvent::Read { ack: false },
            I2cEvent::Stop
        ]
    );
}

#[test]
fn a_stop_too_late_for_one_byte_clocks_another_in() {
    let mut bench = fast();
    bench.world.slave.to_read.push_back(0x77);
    address(&mut bench, true, micro());
    clear(&mut bench, ACK);
    bench.read(SR2);
    bench.run(BYTE + BIT);
    set(&mut bench, STOP);
    bench.run(Ticks::from_millis(1));
    assert_eq!(sr1(&bench), RXNE | BTF);
    // The slave let go after the first.
    assert_eq!(bench.read(DR), 0x77);
    assert_eq!(bench.read(DR), 0xFF);
    assert_eq!(sr1(&bench) & RXNE, 0);
}

#[test]
fn two_bytes_use_pos_and_btf() {
    let mut bench = fast();
    bench.world.slave.to_read.extend([1, 2, 3]);
    address(&mut bench, true, micro());
    set(&mut bench, POS);
    bench.read(SR2);
    clear(&mut bench, ACK);
    bench.run(BYTE);
    assert_eq!(both(&bench), BYTE_RECEIVED);
    bench.run(BYTE);
    // Both registers full: the clock stays low, however long.
    assert_eq!(sr1(&bench), RXNE | BTF);
    bench.run(Ticks::from_millis(1));
    assert_eq!(bench.world.i2c.len(), 4);
    bench.read(SR1);
    set(&mut bench, STOP);
    assert_eq!(bench.read(DR), 1);
    assert_eq!(sr1(&bench), RXNE);
    assert_eq!(bench.read(DR), 2);
    assert_eq!(sr1(&bench), 0);
    bench.run(BIT);
    assert_eq!(
        events(&bench)[2..],
        [
            I2cEvent::Read { ack: true },
            I2cEvent::Read { ack: false },
            I2cEvent::Stop
        ]
    );
}

/// ST's own library clears ACK before ADDR; the manual after it. Both refuse the second byte, and ACK cleared
/// without POS refuses the first.
#[test]
fn pos_defers_the_acknowledge_bit_by_one_byte() {
    for (pos, first) in [(true, true), (false, false)] {
        let mut bench = fast();
        address(&mut bench, true, micro());
        if pos {
            set(&mut bench, POS);
        }
        clear(&mut bench, ACK);
        bench.read(SR1);
        bench.read(SR2);
        bench.run(Ticks(BYTE.0 * 2));
        assert_eq!(
            events(&bench)[2..],
            [I2cEvent::Read { ack: first }, I2cEvent::Read { ack: false }]
        );
    }
}

#[test]
fn the_acknowledge_bit_is_decided_before_the_ninth_clock() {
    for (after, acknowledged) in [(Ticks(BIT.0 * 8 - 1), false), (Ticks(BIT.0 * 8), true)] {
        let mut bench = fast();
        address(&mut bench, true, micro());
        bench.read(SR2);
        bench.run(after);
        clear(&mut bench, ACK);
        bench.run(BYTE);
        assert_eq!(events(&bench)[2], I2cEvent::Read { ack: acknowledged });
    }
}

#[test]
fn a_receiver_with_both_registers_full_stretches_the_clock() {
    let mut bench = fast();
    bench.world.slave.to_read.extend(1..=5);
    address(&mut bench, true, micro());
    bench.read(SR2);
    bench.run(Ticks::from_millis(1));
    assert_eq!(sr1(&bench), RXNE | BTF);
    assert_eq!(bench.peripheral.next_event(), None);
    bench.read(SR1);
    assert_eq!(bench.read(DR), 1);
    assert_eq!(sr1(&bench), RXNE);
    assert_eq!(
        bench.peripheral.next_event(),
        Some(bench.now + Ticks(BIT.0 * 8))
    );
}

#[test]
fn a_repeated_start_turns_the_direction() {
    let mut bench = fast();
    bench.world.slave.to_read.extend([9, 8, 7]);
    write_bytes(&mut bench, &[5], &mut micro);
    let at = bench.now;
    assert_eq!(read_bytes(&mut bench, 3, true, &mut micro), [9, 8, 7]);
    assert_eq!(
        bench.world.i2c[3],
        (I2cEvent::Start, at + LOW + HIGH + HIGH)
    );
    until_free(&mut bench, micro());
    assert_eq!(bench.world.slave.stops, 1);
    assert_eq!(bench.world.slave.addressed, [0x90, 0x91]);
}

#[test]
fn a_stop_during_a_byte_follows_it() {
    let mut bench = fast();
    address(&mut bench, false, micro());
    bench.read(SR2);
    bench.write(DR, 0x11);
    bench.run(BIT);
    set(&mut bench, STOP);
    bench.run(BYTE);
    until_free(&mut bench, micro());
    assert_eq!(bench.world.slave.written, [0x11]);
    assert_eq!(*events(&bench).last().unwrap(), I2cEvent::Stop);
}

#[test]
fn a_stop_and_a_start_together_follow_each_other() {
    let mut bench = fast();
    write_bytes(&mut bench, &[1], &mut micro);
    set(&mut bench, STOP | START);
    bench.run(LOW + HIGH);
    assert_eq!(*events(&bench).last().unwrap(), I2cEvent::Stop);
    bench.run(HIGH);
    assert_eq!(*events(&bench).last().unwrap(), I2cEvent::Start);
    assert_eq!(both(&bench), MASTER_MODE);
}

#[test]
fn no_acknowledge_sets_af_and_holds_the_bus() {
    let mut bench = fast();
    set(&mut bench, START);
    wait(&mut bench, SB, micro());
    bench.write(DR, 0x92);
    bench.run(BYTE);
    assert_eq!(sr1(&bench), AF);
    bench.run(Ticks::from_millis(1));
    assert_eq!(
        bench.read(SR2) & u32::from(MSL | BUSY),
        u32::from(MSL | BUSY)
    );
    // Only a 0 clears it.
    bench.write(SR1, 0xFFFF);
    assert_eq!(sr1(&bench), AF);
    bench.write(SR1, !u32::from(AF) & 0xFFFF);
    assert_eq!(sr1(&bench), 0);
    set(&mut bench, STOP);
    until_free(&mut bench, micro());

    // A refused data byte: no BTF, the next one is not sent.
    let mut bench = fast();
    bench.world.slave.accepts = Some(0);
    address(&mut bench, false, micro());
    bench.read(SR2);
    bench.write(DR, 1);
    bench.write(DR, 2);
    bench.run(Ticks::from_millis(1));
    assert_eq!(sr1(&bench) & (AF | BTF), AF);
    assert_eq!(bench.world.slave.written, [1]);
}

#[test]
fn clearing_sequences_need_both_halves() {
    let mut bench = fast();
    set(&mut bench, START);
    bench.run(HIGH);
    // The address without SR1: what the hardware does with it the manual does not say.
    assert!(bench.try_write(DR, 0x90).is_err());
    bench.read(SR1);
    bench.write(DR, 0x90);
    bench.run(BYTE);
    // SR2 alone after the SR1 that was used up: ADDR was read for SB, and SR1 followed by SR2 clears a flag that
    // rose between the two.
    bench.read(SR2);
    assert_eq!(sr1(&bench) & ADDR, 0);

    let mut bench = fast();
    set(&mut bench, START);
    bench.run(HIGH);
    bench.read(SR1);
    bench.write(DR, 0x90);
    bench.read(SR2);
    bench.run(BYTE);
    bench.read(SR2);
    assert_eq!(sr1(&bench) & ADDR, ADDR);
    bench.read(SR1);
    assert_eq!(sr1(&bench) & ADDR, ADDR);
    bench.read(SR2);
    assert_eq!(sr1(&bench) & ADDR, 0);
}

#[test]
fn lost_arbitration_goes_back_to_slave_until_the_other_stops() {
    let mut bench = fast();
    bench.world.bus.inject(I2cFault::LoseArbitration(1));
    set(&mut bench, START);
    wait(&mut bench, SB, micro());
    bench.write(DR, 0x90);
    bench.run(BYTE);
    assert_eq!(sr1(&bench), ARLO);
    assert_eq!(bench.read(SR2), u32::from(BUSY));
    bench.write(SR1, 0);
    // A start waits for the bus.
    set(&mut bench, START);
    bench.run(Ticks(OTHER_MASTER.0 - BIT.0));
    assert_eq!(sr1(&bench), 0);
    bench.run(Ticks(BIT.0 * 3));
    assert_eq!(sr1(&bench), SB);
    bench.read(SR1);
    bench.write(DR, 0x90);
    bench.run(BYTE);
    assert_eq!(both(&bench), TRANSMITTER);
}

#[test]
fn a_bus_error_is_a_flag() {
    let mut bench = fast();
    bench.world.bus.inject(I2cFault::BusErrors(1));
    set(&mut bench, START);
    wait(&mut bench, SB, micro());
    bench.write(DR, 0x90);
    bench.run(BYTE);
    assert_eq!(sr1(&bench), BERR);
    // The lines are not let go of (27.3.4).
    assert_eq!(bench.read(SR2) & 3, 3);
    bench.write(SR1, 0);
    set(&mut bench, STOP);
    until_free(&mut bench, micro());
}

#[test]
fn a_spurious_bus_error_changes_nothing_else() {
    let mut bench = fast();
    bench.world.bus.inject(I2cFault::SpuriousBusErrors(2));
    set(&mut bench, START);
    wait(&mut bench, SB, micro());
    assert_eq!(sr1(&bench), SB | BERR);
    bench.write(DR, 0x90);
    bench.run(BYTE);
    assert_eq!(sr1(&bench), ADDR | TXE | BERR);
    // Writing 0 clears it, and nothing else.
    bench.write(SR1, 0);
    assert_eq!(sr1(&bench), ADDR | TXE);
}

#[test]
fn busy_follows_a_line_that_is_low() {
    let mut bench = fast();
    bench
        .world
        .bus
        .inject(I2cFault::SdaLow(Some(Ticks::from_micros(500))));
    assert_eq!(bench.read(SR2), u32::from(BUSY));
    set(&mut bench, START);
    bench.run(Ticks::from_micros(499));
    assert_eq!(sr1(&bench), 0);
    // The master's own SDA rises with SCL high: a stop, and the start goes out.
    bench.run(Ticks::from_micros(10));
    assert_eq!(sr1(&bench), SB);

    let mut stuck = fast();
    stuck.world.bus.inject(I2cFault::SclLow(None));
    set(&mut stuck, START);
    stuck.run(Ticks::from_millis(5));
    assert_eq!(stuck.read(SR2), u32::from(BUSY));
    assert!(stuck.world.i2c.is_empty());
    // Software reset does not help while the line is low.
    configure(&mut stuck);
    assert_eq!(stuck.read(SR2), u32::from(BUSY));
}

#[test]
fn a_glitch_leaves_busy_until_the_software_reset() {
    let mut bench = fast();
    bench.world.bus.inject(I2cFault::Glitch);
    bench.read(SR2);
    bench.run(Ticks::from_millis(5));
    assert_eq!(bench.read(SR2), u32::from(BUSY));
    set(&mut bench, START);
    bench.run(Ticks::from_millis(1));
    assert_eq!(sr1(&bench), 0);
    configure(&mut bench);
    assert_eq!(bench.read(SR2), 0);
    write_bytes(&mut bench, &[1], &mut micro);
    assert_eq!(bench.world.slave.written, [1]);
}

#[test]
fn a_clock_that_is_held_delays_the_byte() {
    let mut bench = fast();
    address(&mut bench, false, micro());
    bench.read(SR2);
    bench
        .world
        .bus
        .inject(I2cFault::SclLow(Some(Ticks::from_micros(100))));
    // The short begins with the next look at the bus, the end of this byte.
    bench.write(DR, 1);
    bench.run(Ticks::from_micros(100));
    assert!(bench.world.slave.written.is_empty());
    bench.run(Ticks::from_micros(50));
    assert_eq!(bench.world.slave.written, [1]);
    assert_eq!(sr1(&bench), TXE | BTF);
}

#[test]
fn a_slave_that_lost_step_keeps_the_stop_from_ending() {
    for clocks in 1..=9 {
        let mut bench = fast();
        bench.world.slave.to_read.extend([0xFF, 0xFF, 0xFF]);
        bench.world.bus.inject(I2cFault::HoldSdaInByte { clocks });
        address(&mut bench, true, micro());
        clear(&mut bench, ACK);
        bench.read(SR2);
        set(&mut bench, STOP);
        bench.run(Ticks::from_millis(2));
        // The upper half of the byte was read before the slave lost step.
        assert_eq!(bench.read(DR), 0xF0);
        assert_eq!(bench.read(SR2) & u32::from(BUSY), u32::from(BUSY));
        assert_eq!(bench.world.i2c_lines(bench.now), (true, false));
        assert_eq!(bench.world.slave.stops, 0);
        // The image's recovery: pulses while SDA is low, then a stop, then the peripheral's reset.
        let mut pulses = 0;
        while !bench.world.bus.levels(bench.now).1 {
            for scl in [Some(false), None] {
                bench.world.bus.pins(scl, None, bench.now);
                bench.run(Ticks::from_micros(4));
            }
            pulses += 1;
            assert!(pulses <= 9);
        }
        assert_eq!(pulses, clocks);
        for (scl, sda) in [
            (Some(false), Some(false)),
            (None, Some(false)),
            (None, None),
        ] {
            bench.world.bus.pins(scl, sda, bench.now);
            bench.run(Ticks::from_micros(4));
        }
        configure(&mut bench);
        assert_eq!(bench.read(SR2), 0);
        bench.world.slave.to_read = [3, 2, 1].into();
        assert_eq!(read_bytes(&mut bench, 3, true, &mut micro), [3, 2, 1]);
    }
}

/// RM0090 warns of writing CR1 while STOP is set: a STOP that is written back after the hardware has cleared it
/// ends the next transfer after its start.
#[test]
fn a_stop_that_is_left_over_spoils_the_next_start() {
    let mut bench = fast();
    set(&mut bench, STOP);
    set(&mut bench, START);
    bench.run(Ticks::from_micros(100));
    assert_eq!(events(&bench), [I2cEvent::Start, I2cEvent::Stop]);
    assert_eq!(bench.read(SR2), 0);
    assert_eq!(bench.read(CR1), u32::from(PE));
    // The driver that waits for SB goes on and is never answered.
    wait(&mut bench, SB, micro());
    bench.write(DR, 0x90);
    bench.run(Ticks::from_millis(1));
    assert_eq!(sr1(&bench) & (ADDR | AF | SB), 0);
}

#[test]
fn interrupts_are_levels_of_flags_and_enables() {
    let mut bench = fast();
    bench.write(CR2, 42 | u32::from(ITEVTEN | ITERREN));
    set(&mut bench, START);
    assert!(!bench.interrupts.is_asserted(31));
    bench.run(HIGH);
    assert!(bench.interrupts.is_asserted(31));
    bench.read(SR1);
    bench.write(DR, 0x90);
    assert!(!bench.interrupts.is_asserted(31));
    bench.run(BYTE);
    assert!(bench.interrupts.is_asserted(31));
    bench.read(SR1);
    bench.read(SR2);
    // TXE asks with ITBUFEN only.
    assert!(!bench.interrupts.is_asserted(31));
    bench.write(CR2, 42 | u32::from(ITEVTEN | ITBUFEN));
    assert!(bench.interrupts.is_asserted(31));
    assert!(!bench.interrupts.is_asserted(32));
    bench.world.slave.accepts = Some(0);
    bench.write(CR2, 42 | u32::from(ITERREN));
    bench.write(DR, 1);
    bench.run(BYTE);
    assert!(bench.interrupts.is_asserted(32) && !bench.interrupts.is_asserted(31));
    bench.write(SR1, 0);
    assert!(!bench.interrupts.is_asserted(32));
}

#[test]
fn what_is_missing_is_an_error() {
    for bit in [1, 2, 3, 4, 5, 6, 7, 12, 13, 14] {
        assert!(fast().try_write(CR1, 1 | 1 << bit).is_err());
    }
    for bit in [6, 7, 11, 12, 13] {
        assert!(fast().try_write(CR2, 42 | 1 << bit).is_err());
    }
    assert!(fast().try_write(SR2, 0).is_err());
    assert!(fast().try_read(0x24).is_err());
    fast().with(|i2c, context| {
        assert!(i2c.read(SR1, 1, context).is_err());
        assert!(i2c.read(SR1, 4, context).is_ok());
        assert!(i2c.write(0x08, 2, 0x4090, context).is_ok());
        assert_eq!(i2c.read(0x08, 2, context), Ok(0x4090));
    });
    let mut bench = fast();
    set(&mut bench, START);
    bench.run(HIGH);
    assert!(bench.try_write(CR1, 0).is_err());
    bench.read(SR1);
    assert!(bench.try_write(DR, 0xF0).is_err());
    let mut bench = fast();
    address(&mut bench, true, micro());
    assert!(bench.try_write(CR1, u32::from(PE | STOP)).is_err());
    assert!(bench.try_write(DR, 1).is_err());
    bench.read(SR2);
    assert!(bench.try_write(CR1, u32::from(PE | ACK | POS)).is_err());
    // Held in reset.
    bench.write(CR1, u32::from(SWRST));
    assert!(bench.try_write(CCR, 35).is_err());
}

proptest! {
    /// Whatever passes between two looks, every byte is transferred in order and exactly once, and the master ends
    /// with one refused byte and one stop. Looks are late by up to 1 ms, as behind a preemption.
    #[test]
    fn bytes_arrive_in_order_and_once(
        write in prop::collection::vec(any::<u8>(), 1..6),
        read in prop::collection::vec(any::<u8>(), 1..8),
        repeated in any::<bool>(),
        pauses in prop::collection::vec(prop_oneof![1_u64..2_000, 1_u64..100_000], 1..30),
    ) {
        let mut bench = fast();
        bench.world.slave.to_read.extend(&read);
        bench.world.slave.to_read.extend([0xEE; 4]);
        let mut cycle = pauses.iter().cycle();
        let mut pause = || Ticks(*cycle.next().unwrap());
        write_bytes(&mut bench, &write, &mut pause);
        if !repeated {
            set(&mut bench, STOP);
            until_free(&mut bench, pause());
        }
        let got = read_bytes(&mut bench, read.len(), true, &mut pause);
        until_free(&mut bench, pause());
        prop_assert_eq!(&got, &read);
        prop_assert_eq!(&bench.world.slave.written, &write);
        prop_assert_eq!(bench.world.slave.to_read.len(), 4);
        prop_assert_eq!(bench.world.slave.stops, if repeated { 1 } else { 2 });
        prop_assert_eq!(sr1(&bench), 0);
        let log = bench.world.bus.take_log();
        prop_assert_eq!(log.len(), 2);
        prop_assert_eq!(log[0].ending, if repeated { Ending::RepeatedStart } else { Ending::Stop });
        let refused = log[1].bytes.iter().filter(|(_, acknowledged)| !acknowledged).count();
        prop_assert_eq!(refused, 1);
        prop_assert!(!log[1].bytes.last().unwrap().1);
    }

    /// Whatever the bus answers and whatever the driver's wait finds, a transaction with the image's error path
    /// ends, and after clearing the fault and the image's recovery the next one is right.
    #[test]
    fn after_any_fault_the_software_reset_brings_the_bus_back(
        fault in prop_oneof![
            (1_u32..3).prop_map(I2cFault::NackAddresses),
            (1_u32..3).prop_map(I2cFault::NackData),
            (1_u32..3).prop_map(I2cFault::LoseArbitration),
            (1_u32..3).prop_map(I2cFault::BusErrors),
            (1_u8..10).prop_map(|clocks| I2cFault::HoldSdaInByte { clocks }),
            (1_u8..10).prop_map(|clocks| I2cFault::HoldSda { clocks }),
            Just(I2cFault::SdaLow(None)),
            Just(I2cFault::SclLow(None)),
            Just(I2cFault::Glitch),
        ],
        at in 0_u64..40_000,
    ) {
        let mut bench = fast();
        bench.world.bus.schedule(Ticks(at), fault);
        // A driver that goes through a two-byte write with a bound on every wait.
        set(&mut bench, START | ACK);
        let mut good = true;
        for (flag, byte) in [(SB, 0x90), (ADDR, 0), (TXE, 1), (TXE, 2), (BTF, 0)] {
            let mut seen = 0;
            for _ in 0..300 {
                seen = bench.read(SR1) as u16;
                if seen & (flag | ERRORS) != 0 {
                    break;
                }
                bench.run(micro());
            }
            if seen & ERRORS != 0 || seen & flag == 0 {
                good = false;
                break;
            }
            match flag {
                ADDR => {
                    bench.read(SR2);
                }
                BTF => {}
                _ => bench.write(DR, byte),
            }
        }
        set(&mut bench, STOP);
        bench.write(SR1, 0);
        bench.run(Ticks::from_micros(300));
        if good {
            prop_assert!(bench.world.slave.written.starts_with(&[1]));
        }
        bench.world.bus.clear_faults();
        configure(&mut bench);
        bench.world.slave.written.clear();
        write_bytes(&mut bench, &[3, 4], &mut micro);
        prop_assert_eq!(&bench.world.slave.written, &[3, 4]);
    }
}
