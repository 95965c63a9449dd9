//! The registers as types: address, width, sign, reset value and access.
//!
//! A register's type is its value: `read::<Gain>()` returns a [`Gain`], `write(Gain { .. })` writes one. What the chip
//! does not allow does not compile: only [`Writable`] registers can be written, and a register that is cleared by being
//! read ([`ClearedByRead`]) is not readable by the retrying `read`, because a retry would return the value *after* the
//! clearing.
//!
//! ```compile_fail,E0277
//! # use ade7753::{Ade7753, Aenergy};
//! # fn f<S: embedded_hal::spi::SpiDevice>(meter: &mut Ade7753<S>) {
//! let _ = meter.write(Aenergy(0)); // read-only
//! # }
//! ```
//! ```compile_fail,E0277
//! # use ade7753::{Ade7753, registers::Raenergy};
//! # fn f<S: embedded_hal::spi::SpiDevice>(meter: &mut Ade7753<S>) {
//! let _ = meter.read::<Raenergy>(); // cleared by reading: `read_and_clear`
//! # }
//! ```
//!
//! Source: ADE7753 Rev C, register description; addresses common to ADE7763 Rev C except 0x08 (reserved there).

use core::fmt;

mod bits;

pub use bits::{
    Ch1os, Ch2os, FullScale, Gain, Interrupts, Mode, OffsetTrim, Pga, WaveformRate, WaveformSource,
};

mod sealed {
    pub trait Sealed {}
}
pub(crate) use sealed::Sealed;

/// How many bytes a register has on the wire. Narrower registers are right-justified.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Width {
    /// Up to 8 bits.
    One,
    /// Up to 16 bits.
    Two,
    /// Up to 24 bits.
    Three,
}

impl Width {
    /// The width that carries `bits` bits.
    #[must_use]
    pub const fn of(bits: u32) -> Self {
        match bits {
            0..=8 => Self::One,
            9..=16 => Self::Two,
            _ => Self::Three,
        }
    }

    /// The number of bytes.
    #[must_use]
    pub const fn bytes(self) -> usize {
        match self {
            Self::One => 1,
            Self::Two => 2,
            Self::Three => 3,
        }
    }

    /// The value in which every transferred bit is 1.
    #[must_use]
    pub const fn all_ones(self) -> u32 {
        match self {
            Self::One => 0xFF,
            Self::Two => 0xFFFF,
            Self::Three => 0x00FF_FFFF,
        }
    }
}

/// A register of the chip, as its value. Sealed: the list is the datasheet's.
pub trait Register: Sealed + Copy {
    /// Which register.
    const ID: RegisterId;
    /// How many bits it has.
    const BITS: u32;
    /// What it holds after a reset; `None` where the datasheet gives no value.
    const RESET: Option<u32>;
    /// The bytes on the wire.
    const WIDTH: Width = Width::of(Self::BITS);

    /// The value behind the bits; `None` for a code that the datasheet reserves.
    fn decode(raw: u32) -> Option<Self>;
}

/// A register that can be read any number of times without a change.
pub trait NonDestructive: Register {}

/// A register whose content is set to zero by being read.
pub trait ClearedByRead: Register {}

/// A register that can be written.
pub trait Writable: NonDestructive {
    /// The bits that must read back as written; the others are unused or change by themselves.
    const VERIFY_MASK: u32 = mask(Self::BITS);

    /// The bits of the value; `None` if it does not fit.
    fn encode(self) -> Option<u32>;
}

/// The lowest `bits` bits.
const fn mask(bits: u32) -> u32 {
    (1 << bits) - 1
}

/// The two's complement number in the lowest `bits` bits.
const fn sign_extended(raw: u32, bits: u32) -> i32 {
    let unused = 32 - bits;
    (raw << unused).cast_signed() >> unused
}

/// The two's complement of `value` in `bits` bits; `None` if it does not fit.
const fn twos_complement(value: i32, bits: u32) -> Option<u32> {
    let raw = value.cast_unsigned() & mask(bits);
    if sign_extended(raw, bits) == value {
        Some(raw)
    } else {
        None
    }
}

/// `value` if it fits `bits` bits.
const fn unsigned(value: u32, bits: u32) -> Option<u32> {
    if value & mask(bits) == value {
        Some(value)
    } else {
        None
    }
}

/// Names, addresses and the trait implementations that only restate the table.
macro_rules! register_table {
    ($($(#[$doc:meta])* $name:ident = $address:literal, $mnemonic:literal;)*) => {
        /// A register of the chip.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        #[cfg_attr(feature = "defmt", derive(defmt::Format))]
        pub enum RegisterId {
            $($(#[$doc])* $name = $address,)*
        }

        impl RegisterId {
            /// Every register, by address.
            pub const ALL: &[Self] = &[$(Self::$name),*];

            /// The address in the communications register's bits 5:0.
            #[must_use]
            pub const fn address(self) -> u8 {
                match self {
                    $(Self::$name => $address,)*
                }
            }

            /// The datasheet's name.
            #[must_use]
            pub const fn name(self) -> &'static str {
                match self {
                    $(Self::$name => $mnemonic,)*
                }
            }
        }

        impl fmt::Display for RegisterId {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(self.name())
            }
        }
    };
}

register_table! {
    /// Sampled waveform.
    Waveform = 0x01, "WAVEFORM";
    /// Active energy.
    Aenergy = 0x02, "AENERGY";
    /// Active energy, cleared by reading.
    Raenergy = 0x03, "RAENERGY";
    /// Line-cycle active energy.
    Laenergy = 0x04, "LAENERGY";
    /// Apparent energy.
    Vaenergy = 0x05, "VAENERGY";
    /// Apparent energy, cleared by reading.
    Rvaenergy = 0x06, "RVAENERGY";
    /// Line-cycle apparent energy.
    Lvaenergy = 0x07, "LVAENERGY";
    /// Line-cycle reactive energy.
    Lvarenergy = 0x08, "LVARENERGY";
    /// Mode.
    Mode = 0x09, "MODE";
    /// Interrupt enable.
    Irqen = 0x0A, "IRQEN";
    /// Interrupt status.
    Status = 0x0B, "STATUS";
    /// Interrupt status, cleared by reading.
    Rststatus = 0x0C, "RSTSTATUS";
    /// Channel 1 offset and digital integrator.
    Ch1os = 0x0D, "CH1OS";
    /// Channel 2 offset.
    Ch2os = 0x0E, "CH2OS";
    /// Amplifier gains.
    Gain = 0x0F, "GAIN";
    /// Phase calibration.
    Phcal = 0x10, "PHCAL";
    /// Active power offset.
    Apos = 0x11, "APOS";
    /// Active power gain.
    Wgain = 0x12, "WGAIN";
    /// Active energy divider.
    Wdiv = 0x13, "WDIV";
    /// CF numerator.
    Cfnum = 0x14, "CFNUM";
    /// CF denominator.
    Cfden = 0x15, "CFDEN";
    /// Channel 1 rms.
    Irms = 0x16, "IRMS";
    /// Channel 2 rms.
    Vrms = 0x17, "VRMS";
    /// Channel 1 rms offset.
    Irmsos = 0x18, "IRMSOS";
    /// Channel 2 rms offset.
    Vrmsos = 0x19, "VRMSOS";
    /// Apparent power gain.
    Vagain = 0x1A, "VAGAIN";
    /// Apparent energy divider.
    Vadiv = 0x1B, "VADIV";
    /// Half line cycles per line-cycle accumulation.
    Linecyc = 0x1C, "LINECYC";
    /// Zero-crossing time-out.
    Zxtout = 0x1D, "ZXTOUT";
    /// Half line cycles below SAGLVL before a sag is reported.
    Sagcyc = 0x1E, "SAGCYC";
    /// Sag level.
    Saglvl = 0x1F, "SAGLVL";
    /// Channel 1 peak level.
    Ipklvl = 0x20, "IPKLVL";
    /// Channel 2 peak level.
    Vpklvl = 0x21, "VPKLVL";
    /// Channel 1 peak.
    Ipeak = 0x22, "IPEAK";
    /// Channel 1 peak, cleared by reading.
    Rstipeak = 0x23, "RSTIPEAK";
    /// Channel 2 peak.
    Vpeak = 0x24, "VPEAK";
    /// Channel 2 peak, cleared by reading.
    Rstvpeak = 0x25, "RSTVPEAK";
    /// Temperature.
    Temp = 0x26, "TEMP";
    /// Period of channel 2.
    Period = 0x27, "PERIOD";
    /// Test mode.
    Tmode = 0x3D, "TMODE";
    /// Number of ones in the previous read.
    Chksum = 0x3E, "CHKSUM";
    /// Die revision.
    Dierev = 0x3F, "DIEREV";
}

macro_rules! access {
    ($name:ident, none) => {};
    ($name:ident, read) => {
        impl NonDestructive for $name {}
    };
    ($name:ident, clear) => {
        impl ClearedByRead for $name {}
    };
    ($name:ident, write) => {
        impl NonDestructive for $name {}
        impl Writable for $name {
            fn encode(self) -> Option<u32> {
                self.to_bits()
            }
        }
    };
}

/// Registers that are plain numbers.
macro_rules! numbers {
    ($($(#[$doc:meta])* $name:ident($raw:ty), $bits:literal, $sign:ident, $access:ident, $reset:expr;)*) => {$(
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
        #[cfg_attr(feature = "defmt", derive(defmt::Format))]
        pub struct $name(pub $raw);

        impl Sealed for $name {}

        impl Register for $name {
            const ID: RegisterId = RegisterId::$name;
            const BITS: u32 = $bits;
            const RESET: Option<u32> = $reset;

            fn decode(raw: u32) -> Option<Self> {
                <$raw>::try_from(numbers!(@decode $sign, raw, $bits)).ok().map(Self)
            }
        }

        numbers!(@encode $access, $name, $sign, $bits);
        access!($name, $access);
    )*};
    (@decode signed, $value:ident, $bits:literal) => { sign_extended($value, $bits) };
    (@decode unsigned, $value:ident, $bits:literal) => { $value & mask($bits) };
    (@encode write, $name:ident, signed, $bits:literal) => {
        impl $name {
            fn to_bits(self) -> Option<u32> {
                twos_complement(i32::from(self.0), $bits)
            }
        }
    };
    (@encode write, $name:ident, unsigned, $bits:literal) => {
        impl $name {
            fn to_bits(self) -> Option<u32> {
                unsigned(u32::from(self.0), $bits)
            }
        }
    };
    (@encode $access:ident, $name:ident, $sign:ident, $bits:literal) => {};
}

numbers! {
    /// WAVEFORM: the sample that MODE's waveform source selects. STATUS.WSMP flags a new one.
    Waveform(i32), 24, signed, read, Some(0);
    /// AENERGY: the upper 24 bits of the 49-bit accumulator of active power. It wraps; use [`Aenergy::since`].
    Aenergy(i32), 24, signed, read, Some(0);
    /// RAENERGY: as [`Aenergy`], but reading clears it. Not for charge: a corrupted transfer is lost for good, and
    /// whether the accumulator's 25 hidden bits are cleared as well is not documented.
    Raenergy(i32), 24, signed, clear, Some(0);
    /// LAENERGY: active energy over a number of half line cycles; needs zero crossings on channel 2.
    Laenergy(i32), 24, signed, read, Some(0);
    /// VAENERGY: apparent energy.
    Vaenergy(u32), 24, unsigned, read, Some(0);
    /// RVAENERGY: as [`Vaenergy`], but reading clears it.
    Rvaenergy(u32), 24, unsigned, clear, Some(0);
    /// LVAENERGY: apparent energy over a number of half line cycles.
    Lvaenergy(u32), 24, unsigned, read, Some(0);
    /// LVARENERGY: reactive energy over a number of half line cycles (ADE7753 only).
    Lvarenergy(i32), 24, signed, read, Some(0);
    /// PHCAL: phase calibration.
    Phcal(i8), 6, signed, write, Some(0x0D);
    /// APOS: active power offset; 256 LSB are one LSB at the output of LPF2.
    Apos(i16), 16, signed, write, Some(0);
    /// WGAIN: active power gain, ±50 % in steps of 0.0244 %.
    Wgain(i16), 12, signed, write, Some(0);
    /// WDIV: active energy divider; 0 divides by 1.
    Wdiv(u8), 8, unsigned, write, Some(0);
    /// CFNUM: numerator of the CF output's frequency.
    Cfnum(u16), 12, unsigned, write, Some(0x3F);
    /// CFDEN: denominator of the CF output's frequency.
    Cfden(u16), 12, unsigned, write, Some(0x3F);
    /// IRMS: rms of channel 1.
    Irms(u32), 24, unsigned, read, Some(0);
    /// VRMS: rms of channel 2.
    Vrms(u32), 24, unsigned, read, Some(0);
    /// IRMSOS: rms offset of channel 1.
    Irmsos(i16), 12, signed, write, Some(0);
    /// VRMSOS: rms offset of channel 2.
    Vrmsos(i16), 12, signed, write, Some(0);
    /// VAGAIN: apparent power gain, ±50 % in steps of 0.0244 %.
    Vagain(i16), 12, signed, write, Some(0);
    /// VADIV: apparent energy divider; 0 divides by 1.
    Vadiv(u8), 8, unsigned, write, Some(0);
    /// LINECYC: half line cycles per line-cycle accumulation.
    Linecyc(u16), 16, unsigned, write, Some(0xFFFF);
    /// ZXTOUT: time without zero crossing on channel 2 until STATUS.ZXTO. It always expires with a DC channel 2.
    Zxtout(u16), 12, unsigned, write, Some(0xFFF);
    /// SAGCYC: half line cycles below [`Saglvl`] before a sag is reported.
    Sagcyc(u8), 8, unsigned, write, Some(0xFF);
    /// SAGLVL: peak level of channel 2 below which a sag is counted.
    Saglvl(u8), 8, unsigned, write, Some(0);
    /// IPKLVL: level of channel 1 above which STATUS.PKI is set.
    Ipklvl(u8), 8, unsigned, write, Some(0xFF);
    /// VPKLVL: level of channel 2 above which STATUS.PKV is set.
    Vpklvl(u8), 8, unsigned, write, Some(0xFF);
    /// IPEAK: peak of channel 1.
    Ipeak(u32), 24, unsigned, read, Some(0);
    /// RSTIPEAK: as [`Ipeak`], but reading clears it.
    Rstipeak(u32), 24, unsigned, clear, Some(0);
    /// VPEAK: peak of channel 2.
    Vpeak(u32), 24, unsigned, read, Some(0);
    /// RSTVPEAK: as [`Vpeak`], but reading clears it.
    Rstvpeak(u32), 24, unsigned, clear, Some(0);
    /// TEMP: result of the last temperature conversion; the offset has to be calibrated.
    Temp(i8), 8, signed, read, Some(0);
    /// PERIOD: period of channel 2.
    Period(u16), 16, unsigned, read, Some(0);
    /// TMODE: test mode. The chip would accept a write; this driver does not offer it.
    Tmode(u8), 8, unsigned, read, None;
    /// CHKSUM: number of ones in the previous read. The driver reads it; by itself it is of no use.
    Chksum(u8), 6, unsigned, none, Some(0);
    /// DIEREV: revision of the die.
    Dierev(u8), 8, unsigned, read, None;
}

impl Temp {
    /// The temperature in m°C by the rated offset and scale: code 0 at −25 °C, 1.5 codes a kelvin (Rev C, temperature
    /// measurement). The offset has to be calibrated for more than a rough value.
    ///
    /// Eight bits hold 170.7 K and roll over, at 60.3 °C (the sheet of the sister part ADE7758, Rev. E, says so and leaves it to
    /// the master). Of the temperatures that a code stands for this is the one between −62.3 and +107.7 °C, around the chip's
    /// own range of −40 … +85 °C.
    #[must_use]
    pub const fn rated_millicelsius(self) -> i32 {
        const LOWEST: i8 = -56;
        let above_lowest = self.0.wrapping_sub(LOWEST).cast_unsigned();
        let code = above_lowest as i32 + LOWEST as i32;
        code * 2_000 / 3 - 25_000
    }
}

/// Readable registers with named fields, which `bits` knows.
macro_rules! fields {
    ($($name:ident, $bits:literal, $reset:literal;)*) => {$(
        impl Sealed for $name {}

        impl Register for $name {
            const ID: RegisterId = RegisterId::$name;
            const BITS: u32 = $bits;
            const RESET: Option<u32> = Some($reset);

            fn decode(raw: u32) -> Option<Self> {
                Self::from_bits(raw)
            }
        }
        impl NonDestructive for $name {}
    )*};
}

fields! {
    Mode, 16, 0x000C;
    Ch1os, 8, 0;
    Ch2os, 8, 0;
    Gain, 8, 0;
}

impl Writable for Mode {
    /// TEMPSEL and SWRST return to 0 by themselves.
    const VERIFY_MASK: u32 = 0xFF9F;

    /// `None` with the software reset bit set (the chip would not answer the read-back that follows) and for the
    /// reserved waveform source.
    fn encode(self) -> Option<u32> {
        if self.software_reset || self.waveform_source == WaveformSource::Reserved {
            None
        } else {
            Some(self.bits().into())
        }
    }
}

impl Writable for Ch1os {
    /// Bit 6 is unused.
    const VERIFY_MASK: u32 = 0xBF;

    fn encode(self) -> Option<u32> {
        Some(self.bits().into())
    }
}

impl Writable for Ch2os {
    /// Bits 7:6 are unused.
    const VERIFY_MASK: u32 = 0x3F;

    fn encode(self) -> Option<u32> {
        Some(self.bits().into())
    }
}

impl Writable for Gain {
    fn encode(self) -> Option<u32> {
        Some(self.bits().into())
    }
}

/// The three registers that are sets of [`Interrupts`].
macro_rules! interrupt_registers {
    ($($(#[$doc:meta])* $name:ident, $reset:literal;)*) => {$(
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        #[cfg_attr(feature = "defmt", derive(defmt::Format))]
        pub struct $name(pub Interrupts);

        impl Sealed for $name {}

        impl Register for $name {
            const ID: RegisterId = RegisterId::$name;
            const BITS: u32 = 16;
            const RESET: Option<u32> = Some($reset);

            fn decode(raw: u32) -> Option<Self> {
                u16::try_from(raw).ok().map(|bits| Self(Interrupts::from_bits(bits)))
            }
        }
    )*};
}

interrupt_registers! {
    /// IRQEN: the events that pull IRQ low.
    Irqen, 0x0040;
    /// STATUS: the events since the flags were last cleared.
    Status, 0;
    /// RSTSTATUS: as [`Status`], but reading clears every flag and releases IRQ.
    Rststatus, 0;
}

impl NonDestructive for Irqen {}
impl NonDestructive for Status {}
impl ClearedByRead for Rststatus {}

impl Writable for Irqen {
    /// The RESET bit has no function here and bit 15 is unused.
    const VERIFY_MASK: u32 = 0x7FBF;

    fn encode(self) -> Option<u32> {
        Some(self.0.bits().into())
    }
}

impl Aenergy {
    /// The counts from `earlier` to `self`, exact across the wrap in both directions while the true difference is less
    /// than half the range (2²³ counts; at full scale on both channels, DC, that is 187 s).
    #[must_use]
    pub const fn since(self, earlier: Self) -> EnergyDelta {
        EnergyDelta(sign_extended(
            self.0.wrapping_sub(earlier.0).cast_unsigned(),
            24,
        ))
    }
}

/// A difference of two [`Aenergy`] readings in counts, -2²³ to 2²³ - 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct EnergyDelta(pub i32);

#[cfg(test)]
mod tests;
