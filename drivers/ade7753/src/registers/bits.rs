//! Registers with named fields.

/// `1 << bit` if `set`.
const fn flag(set: bool, bit: u32) -> u16 {
    (set as u16) << bit
}

/// Whether `bit` is set.
const fn is_set(bits: u16, bit: u32) -> bool {
    bits >> bit & 1 == 1
}

/// How often WAVEFORM is updated (MODE bits 12:11).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum WaveformRate {
    /// CLKIN/128: 27.9 kSPS.
    #[default]
    ClkinBy128,
    /// CLKIN/256: 14 kSPS.
    ClkinBy256,
    /// CLKIN/512: 7 kSPS.
    ClkinBy512,
    /// CLKIN/1024: 3.5 kSPS.
    ClkinBy1024,
}

/// What WAVEFORM samples (MODE bits 14:13).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum WaveformSource {
    /// Active power, 24 bits.
    #[default]
    ActivePower,
    /// Reserved by the datasheet; only ever the result of reading.
    Reserved,
    /// Channel 1, 24 bits.
    Channel1,
    /// Channel 2.
    Channel2,
}

/// MODE (0x09). The default is the chip's after a reset, 0x000C.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Mode {
    /// Bit 0, DISHPF: bypasses the high-pass filter of channel 1. Without it DC has no energy.
    pub disable_high_pass: bool,
    /// Bit 1, DISLPF2: bypasses the 8.9 Hz low-pass after the multiplier.
    pub disable_low_pass: bool,
    /// Bit 2, DISCF: disables the CF output.
    pub disable_cf: bool,
    /// Bit 3, DISSAG: disables sag detection.
    pub disable_sag: bool,
    /// Bit 4, ASUSPEND: switches both converters off.
    pub suspend: bool,
    /// Bit 5, TEMPSEL: starts a temperature conversion; 0 again when it is finished.
    pub start_temperature: bool,
    /// Bit 6, SWRST: resets the chip. Not writable as a value; there is a method for it.
    pub software_reset: bool,
    /// Bit 7, CYCMODE: line-cycle accumulation.
    pub line_cycle: bool,
    /// Bit 8, DISCH1: shorts the inputs of channel 1 inside the chip.
    pub short_channel_1: bool,
    /// Bit 9, DISCH2: shorts the inputs of channel 2 inside the chip.
    pub short_channel_2: bool,
    /// Bit 10, SWAP: exchanges the two channels' inputs.
    pub swap_inputs: bool,
    /// Bits 12:11, DTRT.
    pub waveform_rate: WaveformRate,
    /// Bits 14:13, WAVSEL.
    pub waveform_source: WaveformSource,
    /// Bit 15, POAM: accumulates positive power only, which makes a charge counter lose one direction.
    pub positive_only: bool,
}

impl Mode {
    /// The fields of a register value.
    #[must_use]
    pub const fn from_register(bits: u16) -> Self {
        Self {
            disable_high_pass: is_set(bits, 0),
            disable_low_pass: is_set(bits, 1),
            disable_cf: is_set(bits, 2),
            disable_sag: is_set(bits, 3),
            suspend: is_set(bits, 4),
            start_temperature: is_set(bits, 5),
            software_reset: is_set(bits, 6),
            line_cycle: is_set(bits, 7),
            short_channel_1: is_set(bits, 8),
            short_channel_2: is_set(bits, 9),
            swap_inputs: is_set(bits, 10),
            waveform_rate: match bits >> 11 & 3 {
                0 => WaveformRate::ClkinBy128,
                1 => WaveformRate::ClkinBy256,
                2 => WaveformRate::ClkinBy512,
                _ => WaveformRate::ClkinBy1024,
            },
            waveform_source: match bits >> 13 & 3 {
                0 => WaveformSource::ActivePower,
                1 => WaveformSource::Reserved,
                2 => WaveformSource::Channel1,
                _ => WaveformSource::Channel2,
            },
            positive_only: is_set(bits, 15),
        }
    }

    pub(super) fn from_bits(raw: u32) -> Option<Self> {
        u16::try_from(raw).ok().map(Self::from_register)
    }

    /// The register value.
    #[must_use]
    pub const fn bits(self) -> u16 {
        flag(self.disable_high_pass, 0)
            | flag(self.disable_low_pass, 1)
            | flag(self.disable_cf, 2)
            | flag(self.disable_sag, 3)
            | flag(self.suspend, 4)
            | flag(self.start_temperature, 5)
            | flag(self.software_reset, 6)
            | flag(self.line_cycle, 7)
            | flag(self.short_channel_1, 8)
            | flag(self.short_channel_2, 9)
            | flag(self.swap_inputs, 10)
            | (self.waveform_rate as u16) << 11
            | (self.waveform_source as u16) << 13
            | flag(self.positive_only, 15)
    }
}

impl Default for Mode {
    fn default() -> Self {
        Self::from_register(0x000C)
    }
}

/// A set of events, as IRQEN, STATUS and RSTSTATUS hold it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Interrupts(u16);

impl Interrupts {
    /// None.
    pub const NONE: Self = Self(0);
    /// AENERGY is more than half full.
    pub const AEHF: Self = Self(1 << 0);
    /// Sag on channel 2.
    pub const SAG: Self = Self(1 << 1);
    /// End of a line-cycle accumulation.
    pub const CYCEND: Self = Self(1 << 2);
    /// New data in WAVEFORM.
    pub const WSMP: Self = Self(1 << 3);
    /// Zero crossing of channel 2.
    pub const ZX: Self = Self(1 << 4);
    /// A temperature conversion has ended.
    pub const TEMP: Self = Self(1 << 5);
    /// A reset has ended. It is a flag only: it never pulls IRQ low.
    pub const RESET: Self = Self(1 << 6);
    /// AENERGY has overflowed.
    pub const AEOF: Self = Self(1 << 7);
    /// Channel 2 has exceeded VPKLVL.
    pub const PKV: Self = Self(1 << 8);
    /// Channel 1 has exceeded IPKLVL.
    pub const PKI: Self = Self(1 << 9);
    /// VAENERGY is more than half full.
    pub const VAEHF: Self = Self(1 << 10);
    /// VAENERGY has overflowed.
    pub const VAEOF: Self = Self(1 << 11);
    /// No zero crossing on channel 2 for ZXTOUT. It always comes with a DC channel 2: do not enable it there.
    pub const ZXTO: Self = Self(1 << 12);
    /// Power has turned from negative to positive.
    pub const PPOS: Self = Self(1 << 13);
    /// Power has turned from positive to negative.
    pub const PNEG: Self = Self(1 << 14);

    /// The set with these bits.
    #[must_use]
    pub const fn from_bits(bits: u16) -> Self {
        Self(bits)
    }

    /// The bits of the set.
    #[must_use]
    pub const fn bits(self) -> u16 {
        self.0
    }

    /// Whether all of `other` are in the set.
    #[must_use]
    pub const fn contains(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }

    /// Both sets together.
    #[must_use]
    pub const fn union(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }
}

impl core::ops::BitOr for Interrupts {
    type Output = Self;

    fn bitor(self, other: Self) -> Self {
        self.union(other)
    }
}

/// Gain of a channel's programmable amplifier.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Pga {
    /// 1: ±0.5 V at the input.
    #[default]
    X1,
    /// 2.
    X2,
    /// 4.
    X4,
    /// 8.
    X8,
    /// 16.
    X16,
}

impl Pga {
    const fn from_code(code: u8) -> Option<Self> {
        match code {
            0 => Some(Self::X1),
            1 => Some(Self::X2),
            2 => Some(Self::X4),
            3 => Some(Self::X8),
            4 => Some(Self::X16),
            _ => None,
        }
    }

    /// The gain as a number.
    #[must_use]
    pub const fn factor(self) -> u8 {
        1 << self as u8
    }
}

/// Full scale of channel 1's converter.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum FullScale {
    /// 0.5 V.
    #[default]
    HalfVolt,
    /// 0.25 V.
    QuarterVolt,
    /// 0.125 V.
    EighthVolt,
}

impl FullScale {
    const fn from_code(code: u8) -> Option<Self> {
        match code {
            0 => Some(Self::HalfVolt),
            1 => Some(Self::QuarterVolt),
            2 => Some(Self::EighthVolt),
            _ => None,
        }
    }
}

/// GAIN (0x0F).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Gain {
    /// Bits 2:0: amplifier of channel 1.
    pub channel_1: Pga,
    /// Bits 4:3: full scale of channel 1's converter.
    pub channel_1_full_scale: FullScale,
    /// Bits 7:5: amplifier of channel 2.
    pub channel_2: Pga,
}

impl Gain {
    /// The fields of a register value; `None` for a reserved code.
    #[must_use]
    pub const fn from_register(bits: u8) -> Option<Self> {
        match (
            Pga::from_code(bits & 7),
            FullScale::from_code(bits >> 3 & 3),
            Pga::from_code(bits >> 5),
        ) {
            (Some(channel_1), Some(channel_1_full_scale), Some(channel_2)) => Some(Self {
                channel_1,
                channel_1_full_scale,
                channel_2,
            }),
            _ => None,
        }
    }

    pub(super) fn from_bits(raw: u32) -> Option<Self> {
        u8::try_from(raw).ok().and_then(Self::from_register)
    }

    /// The register value.
    #[must_use]
    pub const fn bits(self) -> u8 {
        self.channel_1 as u8 | (self.channel_1_full_scale as u8) << 3 | (self.channel_2 as u8) << 5
    }
}

/// An offset correction in steps, -31 to 31: the amount *added to the channel's reading*, for both channels.
///
/// One step is 1.61 mV at gain 1, 1.19 mV at 2, 0.97 mV at 4, 0.84 mV at 8, 0.77 mV at 16 (ADE7753 Rev C, analog
/// inputs): far too coarse for a current measurement, where APOS or software does the rest.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct OffsetTrim(i8);

impl OffsetTrim {
    /// No correction.
    pub const ZERO: Self = Self(0);

    /// A correction of `steps`; `None` outside -31 to 31.
    #[must_use]
    pub const fn new(steps: i8) -> Option<Self> {
        if steps.unsigned_abs() <= 31 {
            Some(Self(steps))
        } else {
            None
        }
    }

    /// The number of steps.
    #[must_use]
    pub const fn steps(self) -> i8 {
        self.0
    }

    /// Sign (bit 5, set for negative) and magnitude (bits 4:0).
    const fn sign_magnitude(self) -> u8 {
        let sign = if self.0 < 0 { 0x20 } else { 0 };
        sign | self.0.unsigned_abs()
    }

    const fn from_sign_magnitude(bits: u8) -> Self {
        let magnitude = (bits & 0x1F).cast_signed();
        if bits & 0x20 == 0 {
            Self(magnitude)
        } else {
            Self(-magnitude)
        }
    }

    const fn inverted(self) -> Self {
        Self(-self.0)
    }
}

/// CH1OS (0x0D): sign-magnitude offset of channel 1 in bits 5:0, digital integrator in bit 7.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Ch1os {
    /// The correction.
    pub trim: OffsetTrim,
    /// Bit 7: the digital integrator for di/dt sensors. It must be off for a sensor that measures current itself.
    pub integrator: bool,
}

impl Ch1os {
    pub(super) fn from_bits(raw: u32) -> Option<Self> {
        u8::try_from(raw).ok().map(|bits| Self {
            trim: OffsetTrim::from_sign_magnitude(bits),
            integrator: bits & 0x80 != 0,
        })
    }

    /// The register value.
    #[must_use]
    pub const fn bits(self) -> u8 {
        let integrator = if self.integrator { 0x80 } else { 0 };
        integrator | self.trim.sign_magnitude()
    }
}

/// CH2OS (0x0E): offset of channel 2 in bits 5:0. The chip counts it the other way round than channel 1's; the
/// [`OffsetTrim`] here has the same sense for both.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Ch2os {
    /// The correction.
    pub trim: OffsetTrim,
}

impl Ch2os {
    pub(super) fn from_bits(raw: u32) -> Option<Self> {
        u8::try_from(raw).ok().map(|bits| Self {
            trim: OffsetTrim::from_sign_magnitude(bits).inverted(),
        })
    }

    /// The register value.
    #[must_use]
    pub const fn bits(self) -> u8 {
        self.trim.inverted().sign_magnitude()
    }
}
