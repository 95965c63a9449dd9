//! A part and its surroundings, as plain numbers.

use serde::{Deserialize, Serialize};

use super::NOMINAL_REFERENCE_V;

/// What starts a temperature conversion once TEMPSEL is set.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TemperatureTrigger {
    /// The next zero crossing of channel 2 (PrF, zero crossing detection; Rev C, temperature measurement): with DC
    /// there it never comes, and TEMPSEL stays set.
    #[default]
    ZeroCrossing,
    /// The write of TEMPSEL: for a part that does not wait.
    Immediate,
}

/// Limits of the serial interface, in s and Hz.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SerialTiming {
    /// t1: chip select to first edge, 50 ns (ADE7754, timing).
    pub select_setup_s: f64,
    /// t6: end of one written byte to the end of the next, 4 µs (ADE7759, serial write operation; the ADE7753's own
    /// value is not known).
    pub write_byte_end_to_end_s: f64,
    /// t7: end of one written byte to the beginning of the next, 50 ns (ADE7754, timing).
    pub write_byte_gap_s: f64,
    /// t8: last edge of a write to chip select, 100 ns (ADE7754, timing).
    pub select_hold_s: f64,
    /// t9: end of a read command to the first data bit, 4 µs (ADE7754, timing; the same in all sister parts).
    pub command_to_data_s: f64,
    /// End of a write to the next command, 4 µs (ADE7756, serial read operation).
    pub write_to_command_s: f64,
    /// After a software reset, 18 µs (Rev C, mode register).
    pub reset_s: f64,
    /// SCLK: 50 ns high and low (ADE7754, timing).
    pub clock_max_hz: f64,
}

impl Default for SerialTiming {
    fn default() -> Self {
        Self {
            select_setup_s: 50e-9,
            write_byte_end_to_end_s: 4e-6,
            write_byte_gap_s: 50e-9,
            select_hold_s: 100e-9,
            command_to_data_s: 4e-6,
            write_to_command_s: 4e-6,
            reset_s: 18e-6,
            clock_max_hz: 10e6,
        }
    }
}

/// One channel's deviations.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ChannelConfig {
    /// Offset at the input at 25 °C, in V; off: 0.
    pub offset_v: f64,
    /// Drift of the offset, in V/K; off: 0.
    pub offset_tempco_v_per_k: f64,
    /// Gain at 25 °C; off: 1.
    pub gain: f64,
    /// Drift of the gain, in 1/K; off: 0.
    pub gain_tempco_per_k: f64,
}

impl Default for ChannelConfig {
    fn default() -> Self {
        Self {
            offset_v: 0.0,
            offset_tempco_v_per_k: 0.0,
            gain: 1.0,
            gain_tempco_per_k: 0.0,
        }
    }
}

/// A part and its surroundings. The default is the data sheet's part without an error.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Ade7753Config {
    /// Crystal, in Hz (Rev C, specifications).
    pub clkin_hz: f64,
    /// Deviation of the crystal, in ppm; off: 0.
    pub clkin_ppm: f64,
    /// Reference, in V: 2.4 internal, 2.5 from outside. The codes are proportional to its inverse.
    pub reference_v: f64,
    /// Drift of the reference, in 1/K; off: 0 (Rev C, specifications: 30 ppm/K typical for the internal one).
    pub reference_tempco_per_k: f64,
    /// Channel 1: current.
    pub channel_1: ChannelConfig,
    /// Channel 2: voltage.
    pub channel_2: ChannelConfig,
    /// Input at which a converter clips, as a share of full scale. Beyond 1 is beyond the specification; the
    /// preliminary sheet (PrC, channel 1 ADC) has the code go on to 0x400000, that is 1.587.
    pub clip: f64,
    /// No-load threshold as a share of the full-scale output (Rev C, features; 0.001 % is commonly quoted).
    pub no_load: f64,
    /// Corner of LPF2, in Hz (Rev C, equation 20).
    pub low_pass_hz: f64,
    /// Corner of channel 1's high-pass, in Hz (*assumed*: no figure found; no use of it with DC). Must differ from
    /// `low_pass_hz`.
    pub high_pass_hz: f64,
    /// RAENERGY clears the 25 bits below AENERGY too (not documented).
    pub raenergy_clears_hidden: bool,
    /// AEHF also for the negative half (not documented).
    pub half_full_when_negative: bool,
    /// What starts a temperature conversion.
    pub temperature_trigger: TemperatureTrigger,
    /// Offset of TEMP, in codes of 1/1.5 K (Rev C, temperature measurement: up to 25 K); off: 0.
    pub temperature_offset_codes: f64,
    /// DIEREV (not documented).
    pub die_revision: u8,
    /// Limits of the serial interface.
    pub serial: SerialTiming,
}

impl Default for Ade7753Config {
    fn default() -> Self {
        Self {
            clkin_hz: 3_579_545.0,
            clkin_ppm: 0.0,
            reference_v: NOMINAL_REFERENCE_V,
            reference_tempco_per_k: 0.0,
            channel_1: ChannelConfig::default(),
            channel_2: ChannelConfig::default(),
            clip: 1.0,
            no_load: 1e-5,
            low_pass_hz: 8.9,
            high_pass_hz: 1.0,
            raenergy_clears_hidden: true,
            half_full_when_negative: true,
            temperature_trigger: TemperatureTrigger::default(),
            temperature_offset_codes: 0.0,
            die_revision: 0x01,
            serial: SerialTiming::default(),
        }
    }
}
