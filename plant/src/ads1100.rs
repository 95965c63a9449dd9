//! ADS1100: converter with I²C, as its pins see it.
//!
//! Source: ADS1100 data sheet SBAS239. A conversion is the mean of input over supply during the conversion's time,
//! which is what a delta-sigma converter with single-cycle settling gives for an input that moves slowly. The real
//! decimation filter weights the middle of its window more than the ends and its notches lie elsewhere: for hum near
//! the data rate this model is rough.
//!
//! What a write does to a conversion under way is taken from the sister part's sheet (ADS1110, SBAS276A, operating modes): a start
//! has no effect on it, and what leaves the continuous mode lets it end, with the settings it began with. A part that begins anew
//! instead is one of the errors ([`Ads1100Config::restarts`]); the output register keeps its value until a conversion ends.

use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};

use crate::{bus::I2cDevice, stretch::Linear, violations::Violations};

/// ST/BSY.
const ST_BSY: u8 = 1 << 7;
/// Must be written as 0.
const RESERVED: u8 = 3 << 5;
/// Single conversions.
const SC: u8 = 1 << 4;
/// After power-up: continuous, 8 SPS, gain 1.
const POWER_UP: u8 = 0x8C;
/// The byte after the general call address that resets.
const GENERAL_CALL_RESET: u8 = 0x06;
/// First bits of the address, 1001.
const FIRST_ADDRESS: u8 = 0x48;

/// A part. The default is the data sheet's part without an error.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Ads1100Config {
    /// Suffix of the ordering number, 0 … 7 (A0 … A7): address 0x48 + n.
    pub suffix: u8,
    /// A write begins a new conversion in the place of one under way; off: it is ended first.
    pub restarts: bool,
    /// Deviation of the data rate, 1 = 100 %; off: 0 (SBAS239, 104 … 184 of 128 SPS, from memory:
    /// -0.19 … +0.44).
    pub rate_error: f64,
    /// Offset at the input, in V; off: 0.
    pub offset_v: f64,
    /// Gain; off: 1.
    pub gain: f64,
    /// Integral non-linearity at mid-scale, of the full span 2·VDD/PGA; off: 0 (SBAS239: 0.0125 % at most). The curve
    /// is a bow, zero at both ends.
    pub non_linearity: f64,
    /// Noise at the input, in V peak to peak (6.6 σ); off: 0 (SBAS239: 4 µV).
    pub noise_pp_v: f64,
    /// Seed of the noise.
    pub seed: u64,
}

impl Default for Ads1100Config {
    fn default() -> Self {
        Self {
            suffix: 0,
            restarts: false,
            rate_error: 0.0,
            offset_v: 0.0,
            gain: 1.0,
            non_linearity: 0.0,
            noise_pp_v: 0.0,
            seed: 0,
        }
    }
}

/// What the data sheet forbids.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Violation {
    /// Bits 6 and 5 of the configuration were written as 1.
    ReservedBits,
    /// More than one byte was written; only the first counts.
    ExtraByte,
    /// A general call with a second byte that the chip does not know.
    GeneralCall,
}

/// Data rate and resolution.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Rate {
    per_second: u32,
    bits: u32,
}

const fn rate(configuration: u8) -> Rate {
    let (per_second, bits) = match configuration >> 2 & 3 {
        0 => (128, 12),
        1 => (32, 14),
        2 => (16, 15),
        _ => (8, 16),
    };
    Rate { per_second, bits }
}

/// A conversion under way.
#[derive(Clone, Copy, Debug)]
struct Conversion {
    start_s: f64,
    end_s: f64,
    /// The configuration at its start.
    configuration: u8,
    /// ∫ input/supply dt so far, in s.
    integral: f64,
}

/// What the next byte on the bus means.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    Idle,
    /// Bytes written so far.
    Write(usize),
    /// What is shifted out, and the bytes so far.
    Read([u8; 3], usize),
    GeneralCall,
}

/// The chip.
#[derive(Clone, Debug)]
pub struct Ads1100 {
    config: Ads1100Config,
    now_s: f64,
    /// Bits 4 … 0.
    configuration: u8,
    output: i16,
    conversion: Option<Conversion>,
    conversions: u64,
    /// The last supply seen.
    supply_v: f64,
    phase: Phase,
    random: ChaCha8Rng,
    reset_at_s: Option<f64>,
    stuck: Option<i16>,
    absent: bool,
    violations: Violations<Violation>,
}

impl Ads1100 {
    /// The chip at power-up: output 0, converting continuously.
    pub fn new(config: Ads1100Config, at_s: f64) -> Self {
        let mut chip = Self {
            config,
            now_s: at_s,
            configuration: POWER_UP & !ST_BSY,
            output: 0,
            conversion: None,
            conversions: 0,
            supply_v: 5.0,
            phase: Phase::Idle,
            random: ChaCha8Rng::seed_from_u64(config.seed),
            reset_at_s: None,
            stuck: None,
            absent: false,
            violations: Violations::default(),
        };
        chip.begin(at_s);
        chip
    }

    /// Moves to `end_s`, over which the differential input goes as `v`, in V, and the supply as `vdd`, in V.
    pub fn advance(&mut self, end_s: f64, v: Linear, vdd: Linear) {
        let (mut v, mut vdd) = (v, vdd);
        while end_s > self.now_s {
            let conversion_s = self
                .conversion
                .map_or(f64::INFINITY, |under_way| under_way.end_s);
            let event_s = self.reset_at_s.unwrap_or(f64::INFINITY).min(conversion_s);
            if event_s > end_s {
                self.integrate(end_s, v, vdd);
                return;
            }
            if event_s > self.now_s {
                let fraction = (event_s - self.now_s) / (end_s - self.now_s);
                self.integrate(event_s, v.part(0.0, fraction), vdd.part(0.0, fraction));
                v = v.part(fraction, 1.0);
                vdd = vdd.part(fraction, 1.0);
            }
            if self.reset_at_s.is_some_and(|at_s| at_s <= event_s) {
                self.power_up(event_s);
            } else {
                self.finish(event_s);
            }
        }
    }

    /// Time up to which the chip has been advanced, in s.
    pub fn now_s(&self) -> f64 {
        self.now_s
    }

    /// Its 7-bit address.
    pub fn i2c_address(&self) -> u8 {
        FIRST_ADDRESS + (self.config.suffix & 7)
    }

    /// The configuration register as the third byte of a read gives it.
    pub fn configuration(&self) -> u8 {
        let continuous = self.configuration & SC == 0;
        let busy = continuous || self.conversion.is_some();
        self.configuration | if busy { ST_BSY } else { 0 }
    }

    /// The output register.
    pub fn output(&self) -> i16 {
        self.stuck.unwrap_or(self.output)
    }

    /// Conversions finished so far.
    pub fn conversions(&self) -> u64 {
        self.conversions
    }

    /// End of the conversion under way, in s.
    pub fn conversion_end_s(&self) -> Option<f64> {
        self.conversion.map(|under_way| under_way.end_s)
    }

    /// What the bus did that it may not.
    pub fn violations(&self) -> &Violations<Violation> {
        &self.violations
    }

    /// A brown-out or reset at `at_s`, at once if that is past (F12).
    pub fn reset(&mut self, at_s: f64) {
        if at_s <= self.now_s {
            self.power_up(self.now_s);
        } else {
            self.reset_at_s = Some(at_s);
        }
    }

    /// The output register stuck at a code, or free.
    pub fn set_stuck_code(&mut self, code: Option<i16>) {
        self.stuck = code;
    }

    /// Takes the chip off the bus, or puts it back: it acknowledges nothing.
    pub fn set_absent(&mut self, absent: bool) {
        self.absent = absent;
        self.phase = Phase::Idle;
    }

    fn begin(&mut self, at_s: f64) {
        let per_second =
            f64::from(rate(self.configuration).per_second) * (1.0 + self.config.rate_error);
        self.conversion = Some(Conversion {
            start_s: at_s,
            end_s: at_s + per_second.recip(),
            configuration: self.configuration,
            integral: 0.0,
        });
    }

    fn power_up(&mut self, at_s: f64) {
        self.reset_at_s = None;
        self.configuration = POWER_UP & !ST_BSY;
        self.output = 0;
        self.phase = Phase::Idle;
        self.begin(at_s);
    }

    fn configure(&mut self, byte: u8, at_s: f64) {
        if byte & RESERVED != 0 {
            self.violations.record(Violation::ReservedBits, at_s);
        }
        self.configuration = byte & !(ST_BSY | RESERVED);
        let begins = self.configuration & SC == 0 || byte & ST_BSY != 0;
        if begins && (self.config.restarts || self.conversion.is_none()) {
            self.begin(at_s);
        }
    }

    fn integrate(&mut self, end_s: f64, v: Linear, vdd: Linear) {
        let length_s = end_s - self.now_s;
        if let Some(conversion) = &mut self.conversion {
            // A conversion may begin within: the bus can be ahead of the last stretch.
            let from = ((conversion.start_s - self.now_s) / length_s).clamp(0.0, 1.0);
            let (v, vdd) = (v.part(from, 1.0), vdd.part(from, 1.0));
            let offset_v = self.config.offset_v;
            let ratio = |fraction: f64| (v.at(fraction) + offset_v) / vdd.at(fraction);
            // Simpson's rule: exact for a constant supply.
            let mean = (ratio(0.0) + 4.0 * ratio(0.5) + ratio(1.0)) / 6.0;
            conversion.integral += mean * length_s * (1.0 - from);
        }
        self.supply_v = vdd.end;
        self.now_s = end_s;
    }

    fn finish(&mut self, at_s: f64) {
        let Some(conversion) = self.conversion.take() else {
            return;
        };
        let mut mean = conversion.integral / (conversion.end_s - conversion.start_s);
        if self.config.noise_pp_v != 0.0 {
            let normal: f64 = StandardNormal.sample(&mut self.random);
            mean += normal * self.config.noise_pp_v / 6.6 / self.supply_v;
        }
        self.output = self.code(mean, conversion.configuration);
        self.conversions += 1;
        if self.configuration & SC == 0 {
            self.begin(at_s);
        }
    }

    /// SBAS239, output code calculation: 2^(N−1)·PGA·V/VDD, clipped.
    fn code(&self, ratio: f64, configuration: u8) -> i16 {
        let Rate { bits, .. } = rate(configuration);
        let gain = f64::from(1u8 << (configuration & 3));
        let half = f64::from(1u32 << (bits - 1));
        // Share of the span's half: −1 … 1.
        let share = gain * ratio * self.config.gain;
        let bow = 2.0 * self.config.non_linearity * (1.0 - share.clamp(-1.0, 1.0).powi(2));
        let code = half * (share + bow);
        code.round().clamp(-half, half - 1.0) as i16
    }
}

impl I2cDevice for Ads1100 {
    fn address(&mut self, byte: u8, _at_s: f64) -> bool {
        // The registers are handed to the interface as a whole.
        self.phase = if self.absent {
            Phase::Idle
        } else if byte == 0x00 {
            Phase::GeneralCall
        } else if byte >> 1 != self.i2c_address() {
            Phase::Idle
        } else if byte & 1 == 0 {
            Phase::Write(0)
        } else {
            let [high, low] = self.output().to_be_bytes();
            Phase::Read([high, low, self.configuration()], 0)
        };
        self.phase != Phase::Idle
    }

    fn write(&mut self, byte: u8, at_s: f64) -> bool {
        match self.phase {
            Phase::Write(0) => {
                self.phase = Phase::Write(1);
                self.configure(byte, at_s);
                true
            }
            Phase::Write(_) => {
                self.violations.record(Violation::ExtraByte, at_s);
                false
            }
            Phase::GeneralCall if byte == GENERAL_CALL_RESET => {
                self.power_up(at_s);
                true
            }
            Phase::GeneralCall => {
                self.phase = Phase::Idle;
                self.violations.record(Violation::GeneralCall, at_s);
                false
            }
            Phase::Idle | Phase::Read(..) => false,
        }
    }

    fn read(&mut self, _at_s: f64) -> u8 {
        match &mut self.phase {
            Phase::Read(bytes, given) => {
                // SBAS239, reading: FF from the fourth byte on.
                let byte = bytes.get(*given).copied().unwrap_or(0xFF);
                *given += 1;
                byte
            }
            // Nobody drives the line.
            _ => 0xFF,
        }
    }

    fn stop(&mut self, _at_s: f64) {
        self.phase = Phase::Idle;
    }
}
