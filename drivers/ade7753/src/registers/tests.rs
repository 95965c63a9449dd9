#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss
)]

use core::fmt::Debug;

use proptest::prelude::*;

use super::*;

/// What the datasheet's table says of one register.
fn row<R: Register>(address: u8, name: &str, bits: u32, reset: Option<u32>) {
    assert_eq!(R::ID.address(), address, "{name}");
    assert_eq!(R::ID.name(), name);
    assert_eq!(R::BITS, bits, "{name}");
    assert_eq!(R::RESET, reset, "{name}");
    assert_eq!(R::WIDTH.bytes() as u32, bits.div_ceil(8), "{name}");
    assert_eq!(
        u64::from(R::WIDTH.all_ones()) + 1,
        256u64.pow(bits.div_ceil(8)),
        "{name}"
    );
}

#[test]
fn the_table_is_the_datasheets() {
    row::<Waveform>(0x01, "WAVEFORM", 24, Some(0));
    row::<Aenergy>(0x02, "AENERGY", 24, Some(0));
    row::<Raenergy>(0x03, "RAENERGY", 24, Some(0));
    row::<Laenergy>(0x04, "LAENERGY", 24, Some(0));
    row::<Vaenergy>(0x05, "VAENERGY", 24, Some(0));
    row::<Rvaenergy>(0x06, "RVAENERGY", 24, Some(0));
    row::<Lvaenergy>(0x07, "LVAENERGY", 24, Some(0));
    row::<Lvarenergy>(0x08, "LVARENERGY", 24, Some(0));
    row::<Mode>(0x09, "MODE", 16, Some(0x000C));
    row::<Irqen>(0x0A, "IRQEN", 16, Some(0x0040));
    row::<Status>(0x0B, "STATUS", 16, Some(0));
    row::<Rststatus>(0x0C, "RSTSTATUS", 16, Some(0));
    row::<Ch1os>(0x0D, "CH1OS", 8, Some(0));
    row::<Ch2os>(0x0E, "CH2OS", 8, Some(0));
    row::<Gain>(0x0F, "GAIN", 8, Some(0));
    row::<Phcal>(0x10, "PHCAL", 6, Some(0x0D));
    row::<Apos>(0x11, "APOS", 16, Some(0));
    row::<Wgain>(0x12, "WGAIN", 12, Some(0));
    row::<Wdiv>(0x13, "WDIV", 8, Some(0));
    row::<Cfnum>(0x14, "CFNUM", 12, Some(0x3F));
    row::<Cfden>(0x15, "CFDEN", 12, Some(0x3F));
    row::<Irms>(0x16, "IRMS", 24, Some(0));
    row::<Vrms>(0x17, "VRMS", 24, Some(0));
    row::<Irmsos>(0x18, "IRMSOS", 12, Some(0));
    row::<Vrmsos>(0x19, "VRMSOS", 12, Some(0));
    row::<Vagain>(0x1A, "VAGAIN", 12, Some(0));
    row::<Vadiv>(0x1B, "VADIV", 8, Some(0));
    row::<Linecyc>(0x1C, "LINECYC", 16, Some(0xFFFF));
    row::<Zxtout>(0x1D, "ZXTOUT", 12, Some(0xFFF));
    row::<Sagcyc>(0x1E, "SAGCYC", 8, Some(0xFF));
    row::<Saglvl>(0x1F, "SAGLVL", 8, Some(0));
    row::<Ipklvl>(0x20, "IPKLVL", 8, Some(0xFF));
    row::<Vpklvl>(0x21, "VPKLVL", 8, Some(0xFF));
    row::<Ipeak>(0x22, "IPEAK", 24, Some(0));
    row::<Rstipeak>(0x23, "RSTIPEAK", 24, Some(0));
    row::<Vpeak>(0x24, "VPEAK", 24, Some(0));
    row::<Rstvpeak>(0x25, "RSTVPEAK", 24, Some(0));
    row::<Temp>(0x26, "TEMP", 8, Some(0));
    row::<Period>(0x27, "PERIOD", 16, Some(0));
    row::<Tmode>(0x3D, "TMODE", 8, None);
    row::<Chksum>(0x3E, "CHKSUM", 6, Some(0));
    row::<Dierev>(0x3F, "DIEREV", 8, None);
    assert_eq!(RegisterId::ALL.len(), 42);
    assert!(
        RegisterId::ALL
            .windows(2)
            .all(|pair| pair[0].address() < pair[1].address())
    );
    assert!(
        RegisterId::ALL
            .iter()
            .all(|id| *id as u8 == id.address() && id.address() < 0x40)
    );
}

#[test]
fn widths() {
    let expected = |bits| match bits {
        0..=8 => (Width::One, 1, 0xFF),
        9..=16 => (Width::Two, 2, 0xFFFF),
        _ => (Width::Three, 3, 0xFF_FFFF),
    };
    for bits in 0..=24 {
        let width = Width::of(bits);
        assert_eq!((width, width.bytes(), width.all_ones()), expected(bits));
    }
}

/// Whether every code of `bits` bits decodes to what `expected` says and encodes back.
fn every_code<R, V>(bits: u32, expected: impl Fn(u32) -> V)
where
    R: Writable + Debug,
    V: Into<i64>,
    i64: FromRegister<R>,
{
    for raw in 0..1u32 << bits {
        let value = R::decode(raw).expect("every code is a number");
        assert_eq!(i64::from_register(value), expected(raw).into(), "{raw:#x}");
        assert_eq!(value.encode(), Some(raw));
        // Bits above the register's are not part of it.
        let above = R::WIDTH.all_ones() & !mask(bits);
        assert_eq!(
            R::decode(raw | above).map(i64::from_register),
            Some(i64::from_register(value))
        );
    }
}

trait FromRegister<R> {
    fn from_register(register: R) -> Self;
}

macro_rules! from_register {
    ($($name:ident)*) => {$(
        impl FromRegister<$name> for i64 {
            fn from_register(register: $name) -> Self {
                register.0.into()
            }
        }
    )*};
}
from_register!(Phcal Apos Wgain Wdiv Cfnum Cfden Irmsos Vrmsos Vagain Vadiv Linecyc Zxtout Sagcyc Saglvl Ipklvl Vpklvl);

fn signed(bits: u32) -> impl Fn(u32) -> i64 {
    move |raw| {
        let raw = i64::from(raw);
        if raw < 1 << (bits - 1) {
            raw
        } else {
            raw - (1 << bits)
        }
    }
}

#[test]
fn every_code_of_every_writable_number_survives_the_round_trip() {
    every_code::<Phcal, _>(6, signed(6));
    every_code::<Apos, _>(16, signed(16));
    every_code::<Wgain, _>(12, signed(12));
    every_code::<Irmsos, _>(12, signed(12));
    every_code::<Vrmsos, _>(12, signed(12));
    every_code::<Vagain, _>(12, signed(12));
    every_code::<Wdiv, _>(8, |raw| raw);
    every_code::<Cfnum, _>(12, |raw| raw);
    every_code::<Cfden, _>(12, |raw| raw);
    every_code::<Vadiv, _>(8, |raw| raw);
    every_code::<Linecyc, _>(16, |raw| raw);
    every_code::<Zxtout, _>(12, |raw| raw);
    every_code::<Sagcyc, _>(8, |raw| raw);
    every_code::<Saglvl, _>(8, |raw| raw);
    every_code::<Ipklvl, _>(8, |raw| raw);
    every_code::<Vpklvl, _>(8, |raw| raw);
}

#[test]
fn numbers_that_do_not_fit_are_refused() {
    assert_eq!(Phcal(31).encode(), Some(31));
    assert_eq!(Phcal(32).encode(), None);
    assert_eq!(Phcal(-32).encode(), Some(0x20));
    assert_eq!(Phcal(-33).encode(), None);
    assert_eq!(Wgain(2047).encode(), Some(0x7FF));
    assert_eq!(Wgain(2048).encode(), None);
    assert_eq!(Wgain(-2048).encode(), Some(0x800));
    assert_eq!(Wgain(-2049).encode(), None);
    assert_eq!(Apos(i16::MIN).encode(), Some(0x8000));
    assert_eq!(Cfnum(0xFFF).encode(), Some(0xFFF));
    assert_eq!(Cfnum(0x1000).encode(), None);
    assert_eq!(Linecyc(u16::MAX).encode(), Some(0xFFFF));
}

#[test]
fn verify_masks() {
    assert_eq!(Phcal::VERIFY_MASK, 0x3F);
    assert_eq!(Wgain::VERIFY_MASK, 0xFFF);
    assert_eq!(Apos::VERIFY_MASK, 0xFFFF);
    assert_eq!(Gain::VERIFY_MASK, 0xFF);
    assert_eq!(Mode::VERIFY_MASK, 0xFF9F);
    assert_eq!(Ch1os::VERIFY_MASK, 0xBF);
    assert_eq!(Ch2os::VERIFY_MASK, 0x3F);
    assert_eq!(Irqen::VERIFY_MASK, 0x7FBF);
}

#[test]
fn read_only_numbers() {
    assert_eq!(Aenergy::decode(0x00_0000), Some(Aenergy(0)));
    assert_eq!(Aenergy::decode(0x7F_FFFF), Some(Aenergy(8_388_607)));
    assert_eq!(Aenergy::decode(0x80_0000), Some(Aenergy(-8_388_608)));
    assert_eq!(Aenergy::decode(0xFF_FFFF), Some(Aenergy(-1)));
    assert_eq!(Raenergy::decode(0xFF_FFFE), Some(Raenergy(-2)));
    assert_eq!(Laenergy::decode(0xFF_FFFD), Some(Laenergy(-3)));
    assert_eq!(Lvarenergy::decode(0xFF_FFFC), Some(Lvarenergy(-4)));
    assert_eq!(Waveform::decode(0xFF_FFFB), Some(Waveform(-5)));
    assert_eq!(Vaenergy::decode(0xFF_FFFF), Some(Vaenergy(0xFF_FFFF)));
    assert_eq!(Rvaenergy::decode(0xFF_FFFF), Some(Rvaenergy(0xFF_FFFF)));
    assert_eq!(Lvaenergy::decode(0xFF_FFFF), Some(Lvaenergy(0xFF_FFFF)));
    assert_eq!(Irms::decode(0x80_0000), Some(Irms(0x80_0000)));
    assert_eq!(Vrms::decode(0x80_0000), Some(Vrms(0x80_0000)));
    assert_eq!(Ipeak::decode(0x80_0000), Some(Ipeak(0x80_0000)));
    assert_eq!(Rstipeak::decode(0x80_0000), Some(Rstipeak(0x80_0000)));
    assert_eq!(Vpeak::decode(0x80_0000), Some(Vpeak(0x80_0000)));
    assert_eq!(Rstvpeak::decode(0x80_0000), Some(Rstvpeak(0x80_0000)));
    assert_eq!(Temp::decode(0xE7), Some(Temp(-25)));
    assert_eq!(Period::decode(0xFFFF), Some(Period(0xFFFF)));
    assert_eq!(Tmode::decode(0xFF), Some(Tmode(0xFF)));
    assert_eq!(Chksum::decode(0xFF), Some(Chksum(0x3F)));
    assert_eq!(Dierev::decode(0x81), Some(Dierev(0x81)));
}

#[test]
fn every_mode_survives_the_round_trip() {
    for bits in 0..=u16::MAX {
        let mode = Mode::from_register(bits);
        assert_eq!(mode.bits(), bits);
        assert_eq!(Mode::decode(bits.into()), Some(mode));
        let writable = bits & 0x40 == 0 && bits >> 13 & 3 != 1;
        assert_eq!(mode.encode(), writable.then_some(bits.into()));
    }
    assert_eq!(Mode::default().bits(), 0x000C);
    assert_eq!(Mode::decode(0x1_0000), None);
}

#[test]
fn mode_bits_are_where_the_datasheet_has_them() {
    let zero = Mode::from_register(0);
    let cases = [
        (
            Mode {
                disable_high_pass: true,
                ..zero
            },
            0x0001,
        ),
        (
            Mode {
                disable_low_pass: true,
                ..zero
            },
            0x0002,
        ),
        (
            Mode {
                disable_cf: true,
                ..zero
            },
            0x0004,
        ),
        (
            Mode {
                disable_sag: true,
                ..zero
            },
            0x0008,
        ),
        (
            Mode {
                suspend: true,
                ..zero
            },
            0x0010,
        ),
        (
            Mode {
                start_temperature: true,
                ..zero
            },
            0x0020,
        ),
        (
            Mode {
                software_reset: true,
                ..zero
            },
            0x0040,
        ),
        (
            Mode {
                line_cycle: true,
                ..zero
            },
            0x0080,
        ),
        (
            Mode {
                short_channel_1: true,
                ..zero
            },
            0x0100,
        ),
        (
            Mode {
                short_channel_2: true,
                ..zero
            },
            0x0200,
        ),
        (
            Mode {
                swap_inputs: true,
                ..zero
            },
            0x0400,
        ),
        (
            Mode {
                waveform_rate: WaveformRate::ClkinBy256,
                ..zero
            },
            0x0800,
        ),
        (
            Mode {
                waveform_rate: WaveformRate::ClkinBy512,
                ..zero
            },
            0x1000,
        ),
        (
            Mode {
                waveform_rate: WaveformRate::ClkinBy1024,
                ..zero
            },
            0x1800,
        ),
        (
            Mode {
                waveform_source: WaveformSource::Reserved,
                ..zero
            },
            0x2000,
        ),
        (
            Mode {
                waveform_source: WaveformSource::Channel1,
                ..zero
            },
            0x4000,
        ),
        (
            Mode {
                waveform_source: WaveformSource::Channel2,
                ..zero
            },
            0x6000,
        ),
        (
            Mode {
                positive_only: true,
                ..zero
            },
            0x8000,
        ),
    ];
    for (mode, bits) in cases {
        assert_eq!(mode.bits(), bits, "{mode:?}");
        assert_eq!(Mode::from_register(bits), mode);
    }
}

#[test]
fn gain_codes() {
    let mut valid = 0;
    for bits in 0..=u8::MAX {
        let reserved = bits & 7 > 4 || bits >> 3 & 3 == 3 || bits >> 5 > 4;
        let gain = Gain::decode(bits.into());
        assert_eq!(gain.is_none(), reserved, "{bits:#04x}");
        if let Some(gain) = gain {
            valid += 1;
            assert_eq!(gain.encode(), Some(bits.into()));
            assert_eq!(gain.channel_1.factor(), 1 << (bits & 7));
            assert_eq!(gain.channel_2.factor(), 1 << (bits >> 5));
        }
    }
    assert_eq!(valid, 5 * 3 * 5);
    let gain = Gain {
        channel_1: Pga::X8,
        channel_1_full_scale: FullScale::QuarterVolt,
        channel_2: Pga::X16,
    };
    assert_eq!(gain.bits(), 0b1000_1011);
    assert_eq!(
        Gain {
            channel_1_full_scale: FullScale::EighthVolt,
            ..Gain::default()
        }
        .bits(),
        0b0001_0000
    );
    assert_eq!(Gain::decode(0x100), None);
}

#[test]
fn offsets_are_sign_and_magnitude_and_channel_2_is_inverted() {
    for steps in -31..=31i8 {
        let trim = OffsetTrim::new(steps).expect("in range");
        assert_eq!(trim.steps(), steps);
        let magnitude = steps.unsigned_abs();
        let ch1os = Ch1os {
            trim,
            integrator: false,
        };
        let ch2os = Ch2os { trim };
        let sign_1 = if steps < 0 { 0x20 } else { 0 };
        let sign_2 = if steps > 0 { 0x20 } else { 0 };
        assert_eq!(ch1os.bits(), sign_1 | magnitude);
        assert_eq!(ch2os.bits(), sign_2 | magnitude);
        assert_eq!(ch1os.encode(), Some(ch1os.bits().into()));
        assert_eq!(ch2os.encode(), Some(ch2os.bits().into()));
        assert_eq!(Ch1os::decode(ch1os.bits().into()), Some(ch1os));
        assert_eq!(Ch2os::decode(ch2os.bits().into()), Some(ch2os));
        let integrating = Ch1os {
            trim,
            integrator: true,
        };
        assert_eq!(integrating.bits(), 0x80 | sign_1 | magnitude);
        assert_eq!(Ch1os::decode(integrating.bits().into()), Some(integrating));
    }
    assert_eq!(OffsetTrim::new(32), None);
    assert_eq!(OffsetTrim::new(-32), None);
    assert_eq!(OffsetTrim::new(i8::MIN), None);
    // Unused bits and the negative zero.
    assert_eq!(Ch1os::decode(0x60), Some(Ch1os::default()));
    assert_eq!(Ch2os::decode(0xE0), Some(Ch2os::default()));
    assert_eq!(Ch1os::decode(0x100), None);
    assert_eq!(Ch2os::decode(0x100), None);
}

#[test]
fn interrupt_bits() {
    let by_bit = [
        Interrupts::AEHF,
        Interrupts::SAG,
        Interrupts::CYCEND,
        Interrupts::WSMP,
        Interrupts::ZX,
        Interrupts::TEMP,
        Interrupts::RESET,
        Interrupts::AEOF,
        Interrupts::PKV,
        Interrupts::PKI,
        Interrupts::VAEHF,
        Interrupts::VAEOF,
        Interrupts::ZXTO,
        Interrupts::PPOS,
        Interrupts::PNEG,
    ];
    for (bit, flag) in by_bit.into_iter().enumerate() {
        assert_eq!(flag.bits(), 1 << bit);
        assert!(Interrupts::from_bits(0xFFFF).contains(flag));
        assert!(!Interrupts::from_bits(!flag.bits()).contains(flag));
        assert!(!Interrupts::NONE.contains(flag));
    }
    let both = Interrupts::AEHF | Interrupts::AEOF;
    assert_eq!(both.bits(), 0x81);
    assert_eq!(both | Interrupts::AEHF, both);
    assert!(both.contains(Interrupts::NONE));
    assert!(!Interrupts::AEHF.contains(both));
    assert_eq!(Irqen(both).encode(), Some(0x81));
    assert_eq!(Irqen::decode(0x81), Some(Irqen(both)));
    assert_eq!(Status::decode(0x81), Some(Status(both)));
    assert_eq!(Rststatus::decode(0x81), Some(Rststatus(both)));
    assert_eq!(Status::decode(0x1_0000), None);
}

#[test]
fn energy_differences_are_exact_across_the_wrap() {
    let energy = |raw| Aenergy::decode(raw).expect("every code is a number");
    assert_eq!(energy(0x80_0000).since(energy(0x7F_FFFF)), EnergyDelta(1));
    assert_eq!(energy(0x7F_FFFF).since(energy(0x80_0000)), EnergyDelta(-1));
    assert_eq!(energy(5).since(energy(0xFF_FFFB)), EnergyDelta(10));
    assert_eq!(
        energy(0x40_0000).since(energy(0xC0_0001)),
        EnergyDelta(0x7F_FFFF)
    );
    assert_eq!(
        energy(0x40_0000).since(energy(0xC0_0000)),
        EnergyDelta(-0x80_0000)
    );
}

proptest! {
    #[test]
    fn a_difference_below_half_the_range_is_exact(start in 0u32..1 << 24, delta in -(1i32 << 23)..1 << 23) {
        let end = start.wrapping_add(delta.cast_unsigned()) & 0xFF_FFFF;
        let (start, end) = (Aenergy::decode(start).unwrap(), Aenergy::decode(end).unwrap());
        prop_assert_eq!(end.since(start), EnergyDelta(delta));
    }

    #[test]
    fn unusual_differences_do_not_overflow(start: i32, end: i32) {
        let EnergyDelta(delta) = Aenergy(end).since(Aenergy(start));
        prop_assert!((-(1 << 23)..1 << 23).contains(&delta));
    }

    #[test]
    fn signed_numbers_of_24_bits_keep_their_value(raw in 0u32..1 << 24) {
        prop_assert_eq!(Aenergy::decode(raw).map(|energy| i64::from(energy.0)), Some(signed(24)(raw)));
        prop_assert_eq!(Vaenergy::decode(raw), Some(Vaenergy(raw)));
    }
}
