//! The driver against a chip with faults.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss
)]

mod common;

use std::num::NonZeroU16;

use ade7753::registers::{
    Apos, Cfnum, Ch1os, Dierev, FullScale, OffsetTrim, Pga, Phcal, Raenergy, Temp, Tmode, Waveform,
    WaveformRate, WaveformSource, Wdiv, Wgain,
};
use ade7753::{
    Ade7753, Aenergy, Config, EnergyDelta, Error, Gain, Interrupts, Mode, Options, RegisterId,
    Statistics, StuckLevel, Timing,
};
use common::{Chip, Fault, Op};
use embedded_hal_mock::eh1::spi::{Mock, Transaction};
use proptest::prelude::*;

fn meter(chip: &Chip) -> Ade7753<Chip> {
    Ade7753::new(chip.clone(), Options::default())
}

/// A driver that has configured the chip with [`Config::DC`]; the log is empty.
fn configured(chip: &Chip) -> Ade7753<Chip> {
    let mut meter = meter(chip);
    meter.configure(&Config::DC).unwrap();
    chip.take_log();
    meter
}

fn read(address: u8, data: &[u8]) -> Vec<Op> {
    vec![
        Op::Write(vec![address]),
        Op::Delay(4_000),
        Op::Read(data.to_vec()),
    ]
}

fn written(address: u8, data: &[u8]) -> Vec<Op> {
    let mut ops = vec![Op::Write(vec![0x80 | address])];
    for &byte in data {
        ops.push(Op::Delay(4_000));
        ops.push(Op::Write(vec![byte]));
    }
    ops.push(Op::Delay(4_000));
    ops
}

/// A verified write and its read-back.
fn verified(address: u8, data: &[u8]) -> Vec<Vec<Op>> {
    vec![
        written(address, data),
        read(address, data),
        read(0x3E, &[ones(data)]),
    ]
}

fn checked(address: u8, data: &[u8]) -> Vec<Vec<Op>> {
    vec![read(address, data), read(0x3E, &[ones(data)])]
}

fn ones(data: &[u8]) -> u8 {
    data.iter().map(|byte| byte.count_ones() as u8).sum()
}

// Exact bytes

#[test]
fn a_read_is_command_gap_data_then_the_checksum() {
    let chip = Chip::new();
    chip.set(0x02, 0x12_3456);
    let mut meter = meter(&chip);
    assert_eq!(meter.energy(), Ok(Aenergy(0x12_3456)));
    assert_eq!(chip.take_log(), checked(0x02, &[0x12, 0x34, 0x56]));
    assert_eq!(meter.read::<Mode>(), Ok(Mode::default()));
    assert_eq!(chip.take_log(), checked(0x09, &[0x00, 0x0C]));
    assert_eq!(meter.read(), Ok(Dierev(0x21)));
    assert_eq!(chip.take_log(), checked(0x3F, &[0x21]));
    assert_eq!(meter.read(), Ok(Phcal(0x0D)));
    assert_eq!(meter.read(), Ok(Cfnum(0x3F)));
    chip.set(0x3D, 0x5A);
    assert_eq!(meter.read(), Ok(Tmode(0x5A)));
    assert_eq!(meter.statistics(), Statistics::default());
}

#[test]
fn a_write_has_gaps_and_is_read_back() {
    let chip = Chip::new();
    let mut meter = meter(&chip);
    assert_eq!(meter.write(Apos(-2)), Ok(()));
    assert_eq!(chip.take_log(), verified(0x11, &[0xFF, 0xFE]));
    assert_eq!(meter.write(Wdiv(7)), Ok(()));
    assert_eq!(chip.take_log(), verified(0x13, &[7]));
    assert_eq!(meter.write(Wgain(-1)), Ok(()));
    assert_eq!(chip.take_log(), verified(0x12, &[0x0F, 0xFF]));
    assert_eq!(meter.read(), Ok(Wgain(-1)));
}

#[test]
fn the_longest_gaps_of_the_family_are_kept_when_asked_for() {
    let chip = Chip::new();
    chip.set(0x02, 0x12_3456);
    let options = Options {
        timing: Timing::ADE7759,
        retries: 0,
    };
    let mut meter = Ade7753::new(chip.clone(), options);
    assert_eq!(meter.options(), options);
    let gapped = [
        Op::Write(vec![0x02]),
        Op::Delay(4_000),
        Op::Read(vec![0x12]),
        Op::Delay(4_000),
        Op::Read(vec![0x34]),
        Op::Delay(4_000),
        Op::Read(vec![0x56]),
    ]
    .to_vec();
    assert_eq!(meter.energy(), Ok(Aenergy(0x12_3456)));
    assert_eq!(chip.take_log(), [gapped.clone(), read(0x3E, &[9])]);

    let snapshot = meter.energy_snapshot().unwrap();
    assert_eq!(snapshot.verified(), Some(Aenergy(0x12_3456)));
    let mut both = gapped;
    both.push(Op::Delay(4_000));
    both.extend(read(0x3E, &[9]));
    assert_eq!(chip.take_log(), [both]);

    assert_eq!(meter.write(Apos(0x1234)), Ok(()));
    assert_eq!(
        chip.take_log(),
        [
            vec![
                Op::Write(vec![0x91]),
                Op::Delay(6_400),
                Op::Write(vec![0x12]),
                Op::Delay(6_400),
                Op::Write(vec![0x34]),
                Op::Delay(6_400),
            ],
            vec![
                Op::Write(vec![0x11]),
                Op::Delay(4_000),
                Op::Read(vec![0x12]),
                Op::Delay(4_000),
                Op::Read(vec![0x34]),
            ],
            read(0x3E, &[5]),
        ]
    );
}

#[test]
fn an_independent_mock_sees_the_same_bytes() {
    let session = [
        Transaction::transaction_start(),
        Transaction::write_vec(vec![0x02]),
        Transaction::delay(4_000),
        Transaction::read_vec(vec![0xFF, 0xFF, 0xFE]),
        Transaction::transaction_end(),
        Transaction::transaction_start(),
        Transaction::write_vec(vec![0x3E]),
        Transaction::delay(4_000),
        Transaction::read_vec(vec![23]),
        Transaction::transaction_end(),
        Transaction::transaction_start(),
        Transaction::write_vec(vec![0x94]),
        Transaction::delay(4_000),
        Transaction::write_vec(vec![0x01]),
        Transaction::delay(4_000),
        Transaction::write_vec(vec![0x23]),
        Transaction::delay(4_000),
        Transaction::transaction_end(),
        Transaction::transaction_start(),
        Transaction::write_vec(vec![0x14]),
        Transaction::delay(4_000),
        Transaction::read_vec(vec![0x01, 0x23]),
        Transaction::transaction_end(),
        Transaction::transaction_start(),
        Transaction::write_vec(vec![0x3E]),
        Transaction::delay(4_000),
        Transaction::read_vec(vec![4]),
        Transaction::transaction_end(),
    ];
    let mut meter = Ade7753::new(Mock::new(&session), Options::default());
    assert_eq!(meter.energy(), Ok(Aenergy(-2)));
    assert_eq!(meter.write(Cfnum(0x123)), Ok(()));
    meter.release().done();
}

#[test]
fn configure_writes_verifies_and_clears_the_reset_flag() {
    let chip = Chip::new();
    let mut meter = meter(&chip);
    assert_eq!(meter.config(), None);
    assert_eq!(meter.die_revision(), None);
    let config = Config {
        bypass_low_pass: true,
        gain: Gain {
            channel_1: Pga::X2,
            channel_1_full_scale: FullScale::QuarterVolt,
            channel_2: Pga::X4,
        },
        channel_1_trim: OffsetTrim::new(-3).unwrap(),
        channel_2_trim: OffsetTrim::new(5).unwrap(),
        interrupts: Interrupts::AEHF | Interrupts::AEOF,
        cf_output: true,
        cf_numerator: NonZeroU16::new(0x123).unwrap(),
        waveform_source: WaveformSource::Channel1,
        waveform_rate: WaveformRate::ClkinBy1024,
    };
    assert_eq!(meter.configure(&config), Ok(()));
    let expected = [
        checked(0x09, &[0x00, 0x0C]),
        verified(0x0F, &[0b0100_1001]),
        verified(0x0D, &[0x23]),
        verified(0x0E, &[0x25]),
        verified(0x14, &[0x01, 0x23]),
        verified(0x09, &[0x58, 0x0B]),
        verified(0x0A, &[0x00, 0x81]),
        checked(0x3F, &[0x21]),
        vec![read(0x0C, &[0x00, 0x40])],
        checked(0x0B, &[0x00, 0x00]),
    ]
    .concat();
    assert_eq!(chip.take_log(), expected);
    assert_eq!(meter.config(), Some(&config));
    assert_eq!(meter.die_revision(), Some(Dierev(0x21)));
    assert_eq!(meter.verify_configuration(), Ok(()));
    let expected = [
        checked(0x09, &[0x58, 0x0B]),
        checked(0x0F, &[0b0100_1001]),
        checked(0x0D, &[0x23]),
        checked(0x14, &[0x01, 0x23]),
        checked(0x3F, &[0x21]),
    ]
    .concat();
    assert_eq!(chip.take_log(), expected);
}

#[test]
fn the_standard_configuration_is_mode_000f() {
    let mode = Config::DC.mode();
    assert_eq!(mode.bits(), 0x000F);
    assert!(mode.disable_high_pass && !mode.positive_only);
    assert_eq!(Config::default(), Config::DC);
    assert_eq!(Config::DC.cf_numerator.get(), 0x3F);
    let filtered = Config {
        bypass_low_pass: false,
        ..Config::DC
    };
    assert_eq!(filtered.mode().bits(), 0x000D);
    let chip = Chip::new();
    configured(&chip);
    assert_eq!(chip.register(0x09), 0x000F);
    assert_eq!(chip.register(0x0D), 0);
}

// CHKSUM

#[test]
fn every_single_flipped_bit_costs_one_retry_and_nothing_else() {
    for bit in 0..24 {
        let chip = Chip::new();
        chip.set(0x02, 0xA5_C3F0);
        chip.edit(|state| state.flips.push((0, 1 << bit)));
        let mut meter = meter(&chip);
        assert_eq!(
            meter.energy().map(|energy| energy.0),
            Ok(0xA5_C3F0 - (1 << 24))
        );
        let once = Statistics {
            retries: 1,
            checksum_failures: 1,
            ..Statistics::default()
        };
        assert_eq!(meter.statistics(), once, "bit {bit}");
        assert_eq!(chip.transactions(), 4);
        meter.reset_statistics();
        assert_eq!(meter.statistics(), Statistics::default());
    }
    // In the CHKSUM byte itself, its unused upper bits included.
    for bit in 0..8 {
        let chip = Chip::new();
        chip.set(0x02, 0xA5_C3F0);
        chip.edit(|state| state.flips.push((1, 1 << bit)));
        let mut meter = meter(&chip);
        assert_eq!(
            meter.energy().map(|energy| energy.0),
            Ok(0xA5_C3F0 - (1 << 24))
        );
        assert_eq!(meter.statistics().checksum_failures, 1, "bit {bit}");
    }
}

#[test]
fn retries_are_bounded_and_the_last_failure_is_reported() {
    for retries in [0, 1, 2, 5u8] {
        let chip = Chip::new();
        chip.set(0x02, 0x00_0007);
        chip.edit(|state| state.permanent_flips.push((0x02, 0x10)));
        let mut meter = Ade7753::new(
            chip.clone(),
            Options {
                retries,
                ..Options::default()
            },
        );
        assert_eq!(
            meter.energy(),
            Err(Error::Checksum {
                register: RegisterId::Aenergy,
                read: 0x17,
                expected: 4,
                got: 3
            })
        );
        assert_eq!(chip.transactions(), 2 * (1 + usize::from(retries)));
        assert_eq!(
            meter.statistics(),
            Statistics {
                retries: retries.into(),
                checksum_failures: u32::from(retries) + 1,
                ..Statistics::default()
            }
        );
    }
    assert_eq!(
        Options::default(),
        Options {
            timing: Timing::ADE7753,
            retries: 2
        }
    );
}

#[test]
fn two_compensating_flips_pass_as_documented() {
    let chip = Chip::new();
    chip.set(0x02, 0x00_0001);
    chip.edit(|state| state.flips.push((0, 0b11)));
    assert_eq!(meter(&chip).energy(), Ok(Aenergy(2)));
}

#[test]
fn a_register_cleared_by_reading_is_read_once() {
    let chip = Chip::new();
    chip.set(0x02, 0x00_0700);
    let mut meter = meter(&chip);
    assert_eq!(meter.read_and_clear(), Ok(Raenergy(0x700)));
    assert_eq!(chip.take_log(), checked(0x03, &[0x00, 0x07, 0x00]));
    chip.set(0x02, 0x00_0700);
    chip.edit(|state| state.flips.push((0, 1)));
    assert_eq!(
        meter.read_and_clear::<Raenergy>(),
        Err(Error::Checksum {
            register: RegisterId::Raenergy,
            read: 0x701,
            expected: 4,
            got: 3
        })
    );
    assert_eq!(chip.transactions(), 2);
    assert_eq!(
        meter.statistics(),
        Statistics {
            checksum_failures: 1,
            ..Statistics::default()
        }
    );
}

#[test]
fn a_reserved_code_is_an_error() {
    let chip = Chip::new();
    chip.set(0x0F, 0x07);
    assert_eq!(
        meter(&chip).read::<Gain>(),
        Err(Error::ReservedCode {
            register: RegisterId::Gain,
            read: 7
        })
    );
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// With every detectable flip retried, the value is exact and the counters are the number of flips.
    #[test]
    fn energy_survives_random_flips(
        energy in 0u32..1 << 24,
        flips in proptest::collection::vec(proptest::option::of(0u32..24), 8),
    ) {
        let chip = Chip::new();
        chip.set(0x02, energy);
        let mut meter = Ade7753::new(chip.clone(), Options { retries: 10, ..Options::default() });
        let mut injected = 0;
        for (attempt, flip) in flips.iter().enumerate() {
            let Some(bit) = flip else { break };
            chip.edit(|state| state.flips.push((2 * attempt, 1 << bit)));
            injected += 1;
        }
        let read = meter.energy().unwrap();
        prop_assert_eq!(read.0.cast_unsigned() & 0xFF_FFFF, energy);
        prop_assert_eq!(meter.statistics(), Statistics {
            retries: injected, checksum_failures: injected, ..Statistics::default()
        });
    }
}

// Snapshot

#[test]
fn a_snapshot_is_one_chip_select_and_one_attempt() {
    let chip = Chip::new();
    chip.set(0x02, 0xFF_FFFE);
    let mut meter = meter(&chip);
    let snapshot = meter.energy_snapshot().unwrap();
    assert_eq!(snapshot.verified(), Some(Aenergy(-2)));
    assert_eq!((snapshot.raw(), snapshot.checksum()), (0xFF_FFFE, 23));
    let mut once = read(0x02, &[0xFF, 0xFF, 0xFE]);
    once.extend(read(0x3E, &[23]));
    assert_eq!(chip.take_log(), [once]);

    chip.set(0x02, 0x12_3456);
    for (flip, raw, checksum) in [
        (0x100, 0x12_3457, 9),
        (0x8000_0000, 0x92_3456, 9),
        (1, 0x12_3456, 8),
    ] {
        chip.edit(|state| state.flips = vec![(state.log.len(), flip)]);
        let corrupted = meter.energy_snapshot().unwrap();
        assert_eq!(corrupted.verified(), None);
        assert_eq!((corrupted.raw(), corrupted.checksum()), (raw, checksum));
    }
    assert_eq!(meter.statistics(), Statistics::default());

    let now = chip.transactions();
    chip.edit(|state| state.fail = Some(now));
    assert_eq!(
        meter.energy_snapshot(),
        Err(Error::Bus {
            register: RegisterId::Aenergy,
            source: Fault(now)
        })
    );
    assert_eq!(meter.statistics().bus_errors, 1);
    let mut slow = Ade7753::new(
        chip.clone(),
        Options {
            timing: Timing::ADE7759,
            retries: 2,
        },
    );
    let now = chip.transactions();
    chip.edit(|state| state.fail = Some(now));
    assert_eq!(
        slow.energy_snapshot(),
        Err(Error::Bus {
            register: RegisterId::Aenergy,
            source: Fault(now)
        })
    );
}

// Writes

#[test]
fn a_write_that_is_ignored_once_is_repeated() {
    let chip = Chip::new();
    chip.edit(|state| state.deaf = Some((0x11, 1)));
    let mut meter = meter(&chip);
    assert_eq!(meter.write(Apos(3)), Ok(()));
    assert_eq!(chip.register(0x11), 3);
    assert_eq!(chip.transactions(), 6);
    assert_eq!(
        meter.statistics(),
        Statistics {
            retries: 1,
            verify_failures: 1,
            ..Statistics::default()
        }
    );
}

#[test]
fn a_write_that_is_always_ignored_is_an_error_with_both_values() {
    for retries in [0, 2u8] {
        let chip = Chip::new();
        chip.set(0x11, 0x0700);
        chip.edit(|state| state.deaf = Some((0x11, 100)));
        let mut meter = Ade7753::new(
            chip.clone(),
            Options {
                retries,
                ..Options::default()
            },
        );
        assert_eq!(
            meter.write(Apos(3)),
            Err(Error::Verify {
                register: RegisterId::Apos,
                written: 3,
                read: 0x700
            })
        );
        assert_eq!(chip.transactions(), 3 * (1 + usize::from(retries)));
        assert_eq!(
            meter.statistics(),
            Statistics {
                retries: retries.into(),
                verify_failures: u32::from(retries) + 1,
                ..Statistics::default()
            }
        );
    }
}

#[test]
fn bits_that_change_by_themselves_are_not_verified() {
    let chip = Chip::new();
    let mut meter = meter(&chip);
    // Bit 6 of CH1OS is unused: it may read as anything.
    chip.edit(|state| {
        state.deaf = Some((0x0D, 1));
        state.registers[0x0D] = 0x45;
    });
    let trim = OffsetTrim::new(5).unwrap();
    assert_eq!(
        meter.write(Ch1os {
            trim,
            integrator: false
        }),
        Ok(())
    );
    assert_eq!(meter.statistics().verify_failures, 0);
}

#[test]
fn what_does_not_fit_is_not_sent() {
    let chip = Chip::new();
    let mut meter = meter(&chip);
    let refused = |register| Err(Error::ValueOutOfRange { register });
    assert_eq!(meter.write(Wgain(2048)), refused(RegisterId::Wgain));
    assert_eq!(meter.write(Cfnum(0x1000)), refused(RegisterId::Cfnum));
    let reset = Mode {
        software_reset: true,
        ..Mode::default()
    };
    assert_eq!(meter.write(reset), refused(RegisterId::Mode));
    assert_eq!(chip.transactions(), 0);
    let config = Config {
        cf_numerator: NonZeroU16::new(0x1000).unwrap(),
        ..Config::DC
    };
    assert_eq!(meter.configure(&config), refused(RegisterId::Cfnum));
    let config = Config {
        waveform_source: WaveformSource::Reserved,
        ..Config::DC
    };
    assert_eq!(meter.configure(&config), refused(RegisterId::Mode));
    assert_eq!(meter.config(), None);
}

// Dead bus, reset, lost configuration

#[test]
fn a_line_stuck_low_reads_as_zero_energy_but_not_as_a_healthy_chip() {
    let chip = Chip::new();
    chip.set(0x02, 77);
    let mut meter = configured(&chip);
    chip.edit(|state| state.stuck = Some(0x00));
    let low = Error::DeadBus {
        register: RegisterId::Mode,
        level: StuckLevel::Low,
    };
    assert_eq!(meter.energy(), Ok(Aenergy(0)));
    assert_eq!(meter.verify_configuration(), Err(low));
    assert_eq!(meter.start_temperature(), Err(low));
    assert_eq!(meter.reset_detected(), Ok(false));
    assert_eq!(meter.configure(&Config::DC), Err(low));
    assert_eq!(meter.verify_configuration(), Err(Error::NotConfigured));
    chip.edit(|state| state.stuck = None);
    assert_eq!(meter.configure(&Config::DC), Ok(()));
}

#[test]
fn a_line_stuck_high_is_told_at_once() {
    let chip = Chip::new();
    let mut meter = configured(&chip);
    chip.edit(|state| state.stuck = Some(0xFF));
    let high = |register| Error::DeadBus {
        register,
        level: StuckLevel::High,
    };
    assert_eq!(meter.energy(), Err(high(RegisterId::Aenergy)));
    assert_eq!(meter.statistics().checksum_failures, 3);
    assert_eq!(meter.statistics().retries, 2);
    assert_eq!(meter.verify_configuration(), Err(high(RegisterId::Mode)));
    assert_eq!(meter.read::<Dierev>(), Err(high(RegisterId::Dierev)));
    assert_eq!(meter.take_status(), Err(high(RegisterId::Rststatus)));
    assert_eq!(meter.reset_detected(), Err(high(RegisterId::Status)));
    assert_eq!(meter.configure(&Config::DC), Err(high(RegisterId::Mode)));
    assert_eq!(meter.energy_snapshot().unwrap().verified(), None);
}

#[test]
fn all_ones_with_a_right_checksum_is_a_value() {
    let chip = Chip::new();
    chip.set(0x02, 0xFF_FFFF);
    assert_eq!(meter(&chip).energy(), Ok(Aenergy(-1)));
    // And a checksum byte of ones with other data is a checksum error.
    chip.set(0x02, 0x00_0001);
    chip.edit(|state| state.permanent_flips.push((0x3E, 0xFE)));
    assert_eq!(
        meter(&chip).energy(),
        Err(Error::Checksum {
            register: RegisterId::Aenergy,
            read: 1,
            expected: 1,
            got: 0xFF
        })
    );
    // Data of ones with a wrong checksum that is not all ones, too.
    let chip = Chip::new();
    chip.set(0x02, 0xFF_FFFF);
    chip.edit(|state| state.permanent_flips.push((0x3E, 1)));
    assert_eq!(
        meter(&chip).energy(),
        Err(Error::Checksum {
            register: RegisterId::Aenergy,
            read: 0xFF_FFFF,
            expected: 24,
            got: 25
        })
    );
}

#[test]
fn a_mode_of_zero_alone_is_not_a_dead_bus() {
    for (cfnum, dierev) in [(0x3F, 0x21), (0, 0x21), (0x3F, 0)] {
        let chip = Chip::new();
        let mut meter = configured(&chip);
        chip.set(0x09, 0);
        chip.set(0x14, cfnum);
        chip.set(0x3F, dierev);
        assert_eq!(
            meter.verify_configuration(),
            Err(Error::Configuration {
                register: RegisterId::Mode,
                expected: 0x0F,
                read: 0
            })
        );
        assert_eq!(meter.configure(&Config::DC), Ok(()));
    }
}

#[test]
fn a_reset_is_seen_by_mode_and_by_the_flag() {
    let chip = Chip::new();
    let mut meter = configured(&chip);
    assert_eq!(meter.reset_detected(), Ok(false));
    assert_eq!(
        chip.take_log(),
        [checked(0x0B, &[0, 0]), checked(0x09, &[0x00, 0x0F])].concat()
    );
    chip.edit(|state| state.power_up());
    assert_eq!(meter.reset_detected(), Ok(true));
    assert_eq!(chip.take_log(), checked(0x0B, &[0x00, 0x40]));
    assert_eq!(meter.verify_configuration(), Err(Error::Reset));
    // The flag taken by an interrupt handler: MODE still tells.
    assert_eq!(meter.take_status(), Ok(Interrupts::RESET));
    assert_eq!(meter.reset_detected(), Ok(true));
    // And the flag alone is enough.
    chip.set(0x09, 0x000F);
    chip.set(0x0B, 0x0041);
    assert_eq!(meter.reset_detected(), Ok(true));
    chip.set(0x0B, 0x0001);
    assert_eq!(meter.reset_detected(), Ok(false));
    assert_eq!(meter.configure(&Config::DC), Ok(()));
    assert_eq!(meter.verify_configuration(), Ok(()));
}

#[test]
fn each_register_of_the_configuration_is_compared() {
    for (address, register, expected, read) in [
        (0x09, RegisterId::Mode, 0x0F, 0x0E),
        (0x09, RegisterId::Mode, 0x0F, 0x800F),
        (0x0F, RegisterId::Gain, 0, 1),
        (0x0D, RegisterId::Ch1os, 0, 0x80),
        (0x14, RegisterId::Cfnum, 0x3F, 0x3E),
        (0x3F, RegisterId::Dierev, 0x21, 0x22),
    ] {
        let chip = Chip::new();
        let mut meter = configured(&chip);
        chip.set(address, read);
        assert_eq!(
            meter.verify_configuration(),
            Err(Error::Configuration {
                register,
                expected,
                read
            })
        );
    }
    // Bits that mean nothing there.
    let chip = Chip::new();
    let mut meter = configured(&chip);
    chip.set(0x0D, 0x40);
    chip.set(0x09, 0x002F);
    assert_eq!(meter.verify_configuration(), Ok(()));
}

#[test]
fn operations_on_the_configuration_need_one() {
    let chip = Chip::new();
    let mut other = configured(&chip);
    let test = other.start_offset_test().unwrap();
    let chip = Chip::new();
    let mut meter = meter(&chip);
    assert_eq!(meter.verify_configuration(), Err(Error::NotConfigured));
    assert_eq!(meter.start_temperature(), Err(Error::NotConfigured));
    assert_eq!(meter.start_offset_test(), Err(Error::NotConfigured));
    assert_eq!(meter.finish_offset_test(test), Err(Error::NotConfigured));
    assert_eq!(chip.transactions(), 0);
}

#[test]
fn a_reset_flag_that_cannot_be_cleared_is_an_error() {
    let chip = Chip::new();
    chip.edit(|state| state.sticky_status = true);
    let mut meter = meter(&chip);
    assert_eq!(
        meter.configure(&Config::DC),
        Err(Error::Configuration {
            register: RegisterId::Status,
            expected: 0,
            read: 0x40
        })
    );
    assert_eq!(meter.config(), None);
    let attempts = chip.edit(|state| {
        state
            .log
            .iter()
            .filter(|ops| ops[0] == Op::Write(vec![0x0C]))
            .count()
    });
    assert_eq!(attempts, 3);
    assert_eq!(meter.statistics().retries, 2);
    // Other flags than RESET may be set again at once.
    chip.set(0x0B, 0xFFBF);
    assert_eq!(meter.configure(&Config::DC), Ok(()));
}

#[test]
fn software_reset_waits_in_its_own_transaction_and_is_checked() {
    let chip = Chip::new();
    let mut meter = configured(&chip);
    chip.set(0x0F, 3);
    assert_eq!(meter.software_reset(), Ok(()));
    let mut reset = written(0x09, &[0x00, 0x4C]);
    *reset.last_mut().unwrap() = Op::Delay(20_000);
    let expected = [vec![reset], checked(0x09, &[0x00, 0x0C])].concat();
    assert_eq!(chip.take_log(), expected);
    assert_eq!(chip.register(0x0F), 0);
    assert_eq!(meter.config(), None);
    assert_eq!(meter.reset_detected(), Ok(true));

    chip.set(0x09, 0x000F);
    chip.edit(|state| state.no_software_reset = true);
    assert_eq!(
        meter.software_reset(),
        Err(Error::Configuration {
            register: RegisterId::Mode,
            expected: 0x0C,
            read: 0x0F
        })
    );
}

// Waveform, temperature, interrupts

#[test]
fn waveform() {
    let chip = Chip::new();
    chip.set(0x01, 0xFF_FF00);
    assert_eq!(meter(&chip).waveform(), Ok(Waveform(-256)));
    assert_eq!(chip.take_log(), checked(0x01, &[0xFF, 0xFF, 0x00]));
}

#[test]
fn temperature_is_started_and_read_later() {
    let chip = Chip::new();
    let mut meter = configured(&chip);
    assert_eq!(meter.start_temperature(), Ok(()));
    assert_eq!(
        chip.take_log(),
        [checked(0x09, &[0x00, 0x0F]), verified(0x09, &[0x00, 0x2F])].concat()
    );
    assert_eq!(meter.temperature(), Ok(None));
    assert_eq!(chip.take_log(), checked(0x09, &[0x00, 0x2F]));
    chip.set(0x26, 0xF6);
    chip.set(0x09, 0x000F);
    assert_eq!(meter.temperature(), Ok(Some(Temp(-10))));
    assert_eq!(
        chip.take_log(),
        [checked(0x09, &[0x00, 0x0F]), checked(0x26, &[0xF6])].concat()
    );
    // A reset nobody has noticed is not written over.
    chip.edit(|state| state.power_up());
    assert_eq!(meter.start_temperature(), Err(Error::Reset));
    assert_eq!(chip.register(0x09), 0x000C);
}

#[test]
fn taking_the_status_clears_it() {
    let chip = Chip::new();
    let mut meter = configured(&chip);
    chip.set(0x0B, 0x0081);
    let flags = meter.take_status().unwrap();
    assert_eq!(flags, Interrupts::AEHF | Interrupts::AEOF);
    assert_eq!(chip.take_log(), checked(0x0C, &[0x00, 0x81]));
    assert_eq!(meter.take_status(), Ok(Interrupts::NONE));
    chip.set(0x0B, 0x0081);
    let now = chip.transactions();
    chip.edit(|state| state.flips.push((now, 0x80)));
    assert_eq!(
        meter.take_status(),
        Err(Error::Checksum {
            register: RegisterId::Rststatus,
            read: 1,
            expected: 1,
            got: 2
        })
    );
    assert_eq!(chip.transactions(), now + 2);
}

// Offset test

#[test]
fn the_offset_test_shorts_channel_1_and_restores_mode() {
    let chip = Chip::new();
    let mut meter = configured(&chip);
    chip.set(0x02, 0xFF_FFF0);
    let test = meter.start_offset_test().unwrap();
    let expected = [
        checked(0x09, &[0x00, 0x0F]),
        verified(0x09, &[0x01, 0x0F]),
        checked(0x02, &[0xFF, 0xFF, 0xF0]),
    ]
    .concat();
    assert_eq!(chip.take_log(), expected);
    // The changed MODE belongs to the test.
    assert_eq!(meter.verify_configuration(), Ok(()));
    assert_eq!(meter.start_temperature(), Ok(()));
    assert_eq!(chip.register(0x09), 0x012F);
    chip.set(0x09, 0x010F);
    chip.take_log();
    chip.set(0x02, 0x00_0005);
    assert_eq!(meter.finish_offset_test(test), Ok(EnergyDelta(21)));
    let expected = [
        checked(0x09, &[0x01, 0x0F]),
        checked(0x02, &[0x00, 0x00, 0x05]),
        verified(0x09, &[0x00, 0x0F]),
    ]
    .concat();
    assert_eq!(chip.take_log(), expected);
    assert_eq!(meter.verify_configuration(), Ok(()));
}

#[test]
fn a_failed_offset_test_restores_mode() {
    // Starting: transactions 0, 1 check MODE; 2 … 4 write it; 5, 6 read AENERGY.
    for fail in 2..7 {
        let chip = Chip::new();
        let mut meter = configured(&chip);
        chip.edit(|state| state.fail = Some(fail));
        assert!(matches!(
            meter.start_offset_test(),
            Err(Error::Bus { source: Fault(number), .. }) if number == fail
        ));
        assert_eq!(chip.register(0x09), 0x000F, "transaction {fail}");
        assert_eq!(meter.verify_configuration(), Ok(()));
    }
    // Finishing: 0, 1 check MODE; 2, 3 read AENERGY; 4 … 6 restore.
    for fail in 0..4 {
        let chip = Chip::new();
        let mut meter = configured(&chip);
        let test = meter.start_offset_test().unwrap();
        chip.take_log();
        chip.edit(|state| state.fail = Some(fail));
        assert!(matches!(
            meter.finish_offset_test(test),
            Err(Error::Bus { source: Fault(number), .. }) if number == fail
        ));
        assert_eq!(chip.register(0x09), 0x000F, "transaction {fail}");
        assert_eq!(meter.verify_configuration(), Ok(()));
    }
}

#[test]
fn if_mode_cannot_be_restored_that_is_the_error_and_stays_visible() {
    let chip = Chip::new();
    let mut meter = configured(&chip);
    chip.edit(|state| state.fail_from = Some(5));
    assert_eq!(
        meter.start_offset_test(),
        Err(Error::Bus {
            register: RegisterId::Mode,
            source: Fault(6)
        })
    );
    chip.edit(|state| state.fail_from = None);
    let stays = Error::Configuration {
        register: RegisterId::Mode,
        expected: 0x0F,
        read: 0x10F,
    };
    assert_eq!(meter.verify_configuration(), Err(stays));

    let chip = Chip::new();
    let mut meter = configured(&chip);
    let test = meter.start_offset_test().unwrap();
    chip.take_log();
    chip.edit(|state| state.fail_from = Some(2));
    assert_eq!(
        meter.finish_offset_test(test),
        Err(Error::Bus {
            register: RegisterId::Mode,
            source: Fault(3)
        })
    );
    chip.edit(|state| state.fail_from = None);
    assert_eq!(meter.verify_configuration(), Err(stays));
}

#[test]
fn a_reset_during_the_offset_test_stays_visible() {
    let chip = Chip::new();
    let mut meter = configured(&chip);
    let test = meter.start_offset_test().unwrap();
    chip.edit(|state| state.power_up());
    assert_eq!(meter.finish_offset_test(test), Err(Error::Reset));
    assert_eq!(chip.register(0x09), 0x000C);
    assert_eq!(meter.verify_configuration(), Err(Error::Reset));
    chip.set(0x09, 0x000F);
    assert_eq!(meter.verify_configuration(), Ok(()));
}

#[test]
fn configure_and_reset_end_the_offset_test() {
    let chip = Chip::new();
    let mut meter = configured(&chip);
    let test = meter.start_offset_test().unwrap();
    assert_eq!(meter.configure(&Config::DC), Ok(()));
    assert_eq!(chip.register(0x09), 0x000F);
    assert_eq!(
        meter.finish_offset_test(test),
        Err(Error::OffsetTestAborted)
    );
    let test = meter.start_offset_test().unwrap();
    assert_eq!(meter.software_reset(), Ok(()));
    assert_eq!(meter.finish_offset_test(test), Err(Error::NotConfigured));
    let test = meter
        .configure(&Config::DC)
        .and_then(|()| meter.start_offset_test())
        .unwrap();
    assert_eq!(meter.software_reset(), Ok(()));
    assert_eq!(meter.configure(&Config::DC), Ok(()));
    assert_eq!(
        meter.finish_offset_test(test),
        Err(Error::OffsetTestAborted)
    );
}

// Bus errors

/// Runs `operation` with a bus error at each of its transactions and checks that it is reported with its register.
fn bus_error_everywhere<R: std::fmt::Debug + PartialEq>(
    prepare: impl Fn(&Chip) -> Ade7753<Chip>,
    operation: impl Fn(&mut Ade7753<Chip>) -> Result<R, Error<Fault>>,
) -> usize {
    let chip = Chip::new();
    let mut meter = prepare(&chip);
    chip.take_log();
    operation(&mut meter).unwrap();
    let log = chip.take_log();
    for (fail, ops) in log.iter().enumerate() {
        let chip = Chip::new();
        let mut meter = prepare(&chip);
        chip.take_log();
        chip.edit(|state| state.fail = Some(fail));
        let Op::Write(command) = &ops[0] else {
            panic!("no command")
        };
        let register = *RegisterId::ALL
            .iter()
            .find(|id| id.address() == command[0] & 0x3F)
            .unwrap();
        let source = Fault(fail);
        assert_eq!(operation(&mut meter), Err(Error::Bus { register, source }));
        assert_eq!(meter.statistics().bus_errors, 1);
        assert_eq!(meter.statistics().retries, 0, "a bus error is not retried");
    }
    log.len()
}

#[test]
fn a_bus_error_at_any_position_is_reported_with_its_register() {
    assert_eq!(bus_error_everywhere(meter, |m| m.energy()), 2);
    assert_eq!(bus_error_everywhere(meter, |m| m.write(Apos(1))), 3);
    assert_eq!(
        bus_error_everywhere(meter, |m| m.read_and_clear::<Raenergy>()),
        2
    );
    assert_eq!(
        bus_error_everywhere(meter, |m| m.configure(&Config::DC)),
        25
    );
    assert_eq!(
        bus_error_everywhere(configured, |m| m.verify_configuration()),
        10
    );
    assert_eq!(bus_error_everywhere(configured, |m| m.reset_detected()), 4);
    assert_eq!(bus_error_everywhere(configured, |m| m.software_reset()), 3);
    assert_eq!(bus_error_everywhere(configured, |m| m.waveform()), 2);
    assert_eq!(
        bus_error_everywhere(configured, |m| m.start_temperature()),
        5
    );
    assert_eq!(bus_error_everywhere(configured, |m| m.temperature()), 4);
    assert_eq!(bus_error_everywhere(configured, |m| m.take_status()), 2);
    let zeroed = |chip: &Chip| {
        let meter = configured(chip);
        chip.set(0x09, 0);
        meter
    };
    // MODE, then CFNUM to tell a dead line.
    assert_eq!(
        bus_error_everywhere(zeroed, |m| m.configure(&Config::DC)),
        27
    );
}

#[test]
fn a_failed_configuration_does_not_count() {
    for fail in 0..25 {
        let chip = Chip::new();
        let mut meter = configured(&chip);
        chip.edit(|state| state.fail = Some(fail));
        assert!(meter.configure(&Config::DC).is_err());
        assert_eq!(meter.config(), None);
        assert_eq!(meter.verify_configuration(), Err(Error::NotConfigured));
        assert_eq!(meter.configure(&Config::DC), Ok(()));
    }
}

// Timing and text

#[test]
fn time_of_an_energy_read() {
    let timing = Timing::default();
    assert_eq!(timing, Timing::ADE7753);
    for (sclk_hz, ns) in [
        (1_000_000, 56_000),
        (2_000_000, 32_000),
        (2_625_000, 26_286),
        (5_250_000, 17_143),
        (10_000_000, 12_800),
    ] {
        assert_eq!(timing.energy_ns(sclk_hz), ns);
        assert_eq!(Timing::ADE7759.energy_ns(sclk_hz), ns + 8_000);
    }
    assert_eq!(timing.energy_ns(0), u32::MAX);
    assert_eq!(timing.energy_ns(11), u32::MAX);
    // 48 bits at 12 Hz are 4 s: the longest whole-hertz clock that fits.
    assert_eq!(timing.energy_ns(12), 4_000_008_000);
}

#[test]
fn errors_say_what_happened() {
    let register = RegisterId::Gain;
    let cases: [(Error<Fault>, &str); 12] = [
        (
            Error::Bus {
                register,
                source: Fault(3),
            },
            "bus error at GAIN: Fault(3)",
        ),
        (
            Error::Checksum {
                register,
                read: 0x17,
                expected: 4,
                got: 3,
            },
            "GAIN read as 0x17 has 4 ones, CHKSUM says 3",
        ),
        (
            Error::Verify {
                register,
                written: 1,
                read: 0x10,
            },
            "GAIN written as 0x1 reads back as 0x10",
        ),
        (
            Error::ReservedCode { register, read: 7 },
            "GAIN holds the reserved code 0x7",
        ),
        (
            Error::ValueOutOfRange { register },
            "value does not fit GAIN",
        ),
        (
            Error::DeadBus {
                register,
                level: StuckLevel::Low,
            },
            "data line stuck low (seen at GAIN)",
        ),
        (
            Error::DeadBus {
                register,
                level: StuckLevel::High,
            },
            "data line stuck high (seen at GAIN)",
        ),
        (Error::Reset, "the chip has been reset"),
        (
            Error::Configuration {
                register,
                expected: 1,
                read: 0x10,
            },
            "GAIN should hold 0x1, holds 0x10",
        ),
        (Error::NotConfigured, "the chip has not been configured"),
        (Error::OffsetTestAborted, "the offset test was aborted"),
        (
            Error::Bus {
                register: RegisterId::Chksum,
                source: Fault(0),
            },
            "bus error at CHKSUM: Fault(0)",
        ),
    ];
    for (error, text) in cases {
        assert_eq!(error.to_string(), text);
        let error: Box<dyn std::error::Error> = Box::new(error);
        assert!(error.source().is_none());
    }
}

// Async

#[cfg(feature = "async")]
mod asynchronous {
    use super::*;
    use ade7753::Ade7753Async;

    /// One session in which every method and most faults occur; gives the results as text.
    #[rustfmt::skip] // it would move the repetition's `$`
    macro_rules! session {
        ($meter:ident, $chip:ident $(, $await:tt)?) => {{
            let mut results = Vec::new();
            macro_rules! call {
                ($call:expr) => {
                    results.push(format!("{:?}", $call$(.$await)?))
                };
            }
            call!($meter.verify_configuration());
            call!($meter.configure(&Config { interrupts: Interrupts::AEHF, ..Config::DC }));
            call!($meter.verify_configuration());
            $chip.set(0x02, 0x80_0001);
            call!($meter.energy());
            call!($meter.energy_snapshot());
            $chip.edit(|state| state.flips.push((state.log.len(), 4)));
            call!($meter.energy());
            call!($meter.waveform());
            call!($meter.start_temperature());
            call!($meter.temperature());
            $chip.set(0x09, 0x000F);
            call!($meter.temperature());
            $chip.set(0x0B, 0x0001);
            call!($meter.take_status());
            call!($meter.write(Apos(-7)));
            call!($meter.read::<Apos>());
            call!($meter.read_and_clear::<Raenergy>());
            let test = $meter.start_offset_test()$(.$await)?.unwrap();
            $chip.set(0x02, 0x00_0100);
            call!($meter.finish_offset_test(test));
            $chip.edit(|state| state.deaf = Some((0x13, 100)));
            call!($meter.write(Wdiv(9)));
            call!($meter.reset_detected());
            $chip.edit(|state| state.fail = Some(state.log.len() + 1));
            call!($meter.energy());
            $chip.edit(|state| state.stuck = Some(0));
            call!($meter.verify_configuration());
            $chip.edit(|state| state.stuck = Some(0xFF));
            call!($meter.verify_configuration());
            $chip.edit(|state| state.stuck = None);
            call!($meter.software_reset());
            call!($meter.reset_detected());
            results.push(format!("{:?}", $meter.statistics()));
            results.push(format!("{:?} {:?} {:?}", $meter.config(), $meter.die_revision(), $meter.options()));
            $meter.reset_statistics();
            assert_eq!($meter.statistics(), Statistics::default());
            let log = $meter.release().take_log();
            (results, log)
        }};
    }

    #[test]
    fn both_flavours_do_the_same() {
        let chip = Chip::new();
        let mut meter = meter(&chip);
        let blocking = session!(meter, chip);
        let chip = Chip::new();
        let mut meter = Ade7753Async::new(chip.clone(), Options::default());
        let asynchronous = pollster::block_on(async { session!(meter, chip, await) });
        assert_eq!(blocking, asynchronous);
        assert_eq!(blocking.0[0], "Err(NotConfigured)");
        assert_eq!(blocking.0[3], "Ok(Aenergy(-8388607))");
        assert_eq!(
            blocking
                .0
                .iter()
                .filter(|result| result.starts_with("Ok"))
                .count(),
            17
        );
    }
}
