//! What the driver keeps in the chip and checks there.

use core::num::NonZeroU16;

use crate::registers::{
    Cfnum, Ch1os, Ch2os, Gain, Interrupts, Irqen, Mode, OffsetTrim, WaveformRate, WaveformSource,
};

/// A configuration for DC metering: current on channel 1, a constant voltage on channel 2, charge from AENERGY.
///
/// What would break a charge counter cannot be expressed: the high-pass filter is always bypassed (DISHPF = 1), energy
/// is always accumulated with its sign (POAM = 0), the digital integrator is always off (CH1OS bit 7 = 0).
/// MODE therefore never is 0 nor its reset value 0x000C, which lets `verify_configuration` tell a bus stuck low and a
/// reset from each other and from a healthy chip.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Config {
    /// Bypasses the 8.9 Hz low-pass after the multiplier (DISLPF2). With a constant channel 2 it has no ripple to
    /// remove, and it would carry the product of one range of a switched sensor into the next.
    pub bypass_low_pass: bool,
    /// Gains of both channels.
    pub gain: Gain,
    /// Offset correction of channel 1.
    pub channel_1_trim: OffsetTrim,
    /// Offset correction of channel 2.
    pub channel_2_trim: OffsetTrim,
    /// The events that pull IRQ low.
    pub interrupts: Interrupts,
    /// Enables the CF pulse output.
    pub cf_output: bool,
    /// CFNUM, 1 to 0xFFF; not 0, because its read-back tells a dead bus.
    pub cf_numerator: NonZeroU16,
    /// What WAVEFORM samples.
    pub waveform_source: WaveformSource,
    /// How often WAVEFORM is updated.
    pub waveform_rate: WaveformRate,
}

impl Config {
    /// Gain 1, no offset correction, low-pass bypassed, no interrupt: MODE = 0x000F, CFNUM = 0x3F.
    pub const DC: Self = Self {
        bypass_low_pass: true,
        gain: Gain {
            channel_1: crate::registers::Pga::X1,
            channel_1_full_scale: crate::registers::FullScale::HalfVolt,
            channel_2: crate::registers::Pga::X1,
        },
        channel_1_trim: OffsetTrim::ZERO,
        channel_2_trim: OffsetTrim::ZERO,
        interrupts: Interrupts::NONE,
        cf_output: false,
        cf_numerator: match NonZeroU16::new(0x3F) {
            Some(reset) => reset,
            None => NonZeroU16::MIN,
        },
        waveform_source: WaveformSource::ActivePower,
        waveform_rate: WaveformRate::ClkinBy128,
    };

    /// The MODE value.
    #[must_use]
    pub const fn mode(&self) -> Mode {
        Mode {
            disable_high_pass: true,
            disable_low_pass: self.bypass_low_pass,
            disable_cf: !self.cf_output,
            // Sag detection counts line cycles, of which a DC channel 2 has none.
            disable_sag: true,
            suspend: false,
            start_temperature: false,
            software_reset: false,
            line_cycle: false,
            short_channel_1: false,
            short_channel_2: false,
            swap_inputs: false,
            waveform_rate: self.waveform_rate,
            waveform_source: self.waveform_source,
            positive_only: false,
        }
    }

    pub(crate) const fn ch1os(&self) -> Ch1os {
        Ch1os {
            trim: self.channel_1_trim,
            integrator: false,
        }
    }

    pub(crate) const fn ch2os(&self) -> Ch2os {
        Ch2os {
            trim: self.channel_2_trim,
        }
    }

    pub(crate) const fn cfnum(&self) -> Cfnum {
        Cfnum(self.cf_numerator.get())
    }

    pub(crate) const fn irqen(&self) -> Irqen {
        Irqen(self.interrupts)
    }
}

impl Default for Config {
    fn default() -> Self {
        Self::DC
    }
}
