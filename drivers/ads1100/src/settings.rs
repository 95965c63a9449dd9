//! Address, data rate and gain.

/// The factory-coded address of the chip, by the suffix of its ordering number: 0x48 + n.
///
/// The package marking is easily misread (there are reports of an "A3" that answers at 0x48): if nothing answers, try
/// the others.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Address {
    /// ADS1100A0, 0x48.
    #[default]
    A0 = 0x48,
    /// ADS1100A1, 0x49.
    A1 = 0x49,
    /// ADS1100A2, 0x4A.
    A2 = 0x4A,
    /// ADS1100A3, 0x4B.
    A3 = 0x4B,
    /// ADS1100A4, 0x4C.
    A4 = 0x4C,
    /// ADS1100A5, 0x4D.
    A5 = 0x4D,
    /// ADS1100A6, 0x4E.
    A6 = 0x4E,
    /// ADS1100A7, 0x4F.
    A7 = 0x4F,
}

impl Address {
    /// The 7-bit address.
    #[must_use]
    pub const fn bits(self) -> u8 {
        self as u8
    }
}

/// Conversions per second, which is also the resolution.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum DataRate {
    /// 128 conversions per second, 12 bits.
    Sps128,
    /// 32 conversions per second, 14 bits.
    Sps32,
    /// 16 conversions per second, 15 bits.
    Sps16,
    /// 8 conversions per second, 16 bits: the chip's default.
    #[default]
    Sps8,
}

impl DataRate {
    /// Conversions per second, nominally.
    #[must_use]
    pub const fn samples_per_second(self) -> u32 {
        match self {
            Self::Sps128 => 128,
            Self::Sps32 => 32,
            Self::Sps16 => 16,
            Self::Sps8 => 8,
        }
    }

    /// Bits of the result, the sign included.
    #[must_use]
    pub const fn bits(self) -> u32 {
        match self {
            Self::Sps128 => 12,
            Self::Sps32 => 14,
            Self::Sps16 => 15,
            Self::Sps8 => 16,
        }
    }

    /// The largest code; the smallest is `-max_code() - 1`.
    #[must_use]
    pub const fn max_code(self) -> i16 {
        i16::MAX >> (16 - self.bits())
    }

    /// The smallest code.
    #[must_use]
    pub const fn min_code(self) -> i16 {
        i16::MIN >> (16 - self.bits())
    }

    /// Time of one conversion in microseconds, nominally, rounded up.
    #[must_use]
    pub const fn conversion_us(self) -> u32 {
        1_000_000u32.div_ceil(self.samples_per_second())
    }

    /// Time of one conversion with the internal clock 20 % slow, in microseconds, rounded up. (20 % is commonly quoted
    /// for the clock's tolerance; it is not a figure confirmed from the datasheet.)
    #[must_use]
    pub const fn worst_conversion_us(self) -> u32 {
        1_200_000u32.div_ceil(self.samples_per_second())
    }

    /// Time in microseconds after which a conversion still under way is a fault: 1.5 nominal periods, rounded up.
    #[must_use]
    pub const fn timeout_us(self) -> u32 {
        1_500_000u32.div_ceil(self.samples_per_second())
    }
}

/// Gain of the programmable amplifier.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Gain {
    /// 1.
    #[default]
    X1,
    /// 2.
    X2,
    /// 4.
    X4,
    /// 8.
    X8,
}

impl Gain {
    /// The gain as a number.
    #[must_use]
    pub const fn factor(self) -> u8 {
        1 << self as u8
    }
}

/// What the configuration register selects beside the mode.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Settings {
    /// Data rate and resolution.
    pub data_rate: DataRate,
    /// Gain.
    pub gain: Gain,
}

impl Settings {
    /// Bits 3:0 of the configuration register.
    pub(crate) const fn bits(self) -> u8 {
        (self.data_rate as u8) << 2 | self.gain as u8
    }
}
