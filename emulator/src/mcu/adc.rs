//! ADC1 and the registers common to the converters (RM0090, section 13): one regular conversion, started by software.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

use super::word::{check_width, only_bits, part, refuse_bits, unknown, unmodelled};
use super::{Context, Peripheral, Unmodelled};
use crate::time::Ticks;

/// Its interrupt (RM0090, table 62).
const IRQ: u16 = 18;

const SR_EOC: u32 = 1 << 1;
const SR_STRT: u32 = 1 << 4;
const SR_OVR: u32 = 1 << 5;

const CR1_EOCIE: u32 = 1 << 5;
const CR1_OVRIE: u32 = 1 << 26;

const CR2_ADON: u32 = 1 << 0;
const CR2_EOCS: u32 = 1 << 10;
const CR2_SWSTART: u32 = 1 << 30;

const CCR_TSVREFE: u32 = 1 << 23;
const CCR_ADCPRE: u32 = 3 << 16;

/// Cycles by code of SMPx (RM0090, `ADC_SMPR1`).
const SAMPLING_CYCLES: [u64; 8] = [3, 15, 28, 56, 84, 112, 144, 480];
/// Cycles of the conversion itself at 12 bits (RM0090, 13.5).
const CONVERSION_CYCLES: u64 = 12;
/// ADCCLK at 2.4 … 3.6 V (data sheet, ADC characteristics), in Hz.
const CLOCK_RANGE_HZ: std::ops::RangeInclusive<u32> = 600_000..=36_000_000;
/// From ADON to a valid conversion (data sheet, t_STAB: 3 µs at most).
const STABILISATION: Ticks = Ticks::from_micros(3);
/// Start-up of temperature sensor and reference buffer, and their shortest sampling time (data sheet: 10 µs both).
const INTERNAL_STARTUP: Ticks = Ticks::from_micros(10);

const TEMPERATURE_CHANNEL: u8 = 16;
const REFERENCE_CHANNEL: u8 = 17;

/// Codes of 12 bits.
const CODES: f64 = 4_096.0;
/// Supply at which the factory takes its calibration values (data sheet, calibration values), in V.
pub const CALIBRATION_VDDA_V: f64 = 3.3;

/// The analogue side of one chip.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AdcParameters {
    /// VDDA, which is the reference as well: the package of 64 pins has no VREF+. In V.
    pub vdda_v: f64,
    /// Internal reference, 1.18 … 1.24 V, 1.21 V typical (data sheet, embedded reference voltage).
    pub reference_v: f64,
    /// Temperature sensor at 25 °C, 0.76 V typical (data sheet, temperature sensor characteristics).
    pub sensor_25_v: f64,
    /// Its slope, 2.5 mV/K typical (same table).
    pub sensor_slope_v_per_k: f64,
    /// Temperature of the die, in °C.
    pub die_temperature_c: f64,
    /// Standard deviation of the code's noise, in codes; 0 is none.
    pub noise_codes: f64,
    /// Seed of the noise.
    pub seed: u64,
}

impl Default for AdcParameters {
    fn default() -> Self {
        Self {
            vdda_v: CALIBRATION_VDDA_V,
            reference_v: 1.21,
            sensor_25_v: 0.76,
            sensor_slope_v_per_k: 2.5e-3,
            die_temperature_c: 30.0,
            noise_codes: 0.0,
            seed: 0,
        }
    }
}

impl AdcParameters {
    /// Output of the temperature sensor at `die_c`, in V (RM0090, 13.10: V = (T − 25 °C) · slope + V25).
    pub fn sensor_v(&self, die_c: f64) -> f64 {
        self.sensor_25_v + (die_c - 25.0) * self.sensor_slope_v_per_k
    }

    /// What a converter without errors makes of `input_v` with the reference `vdda_v`: steps of VDDA/4096, the first half a
    /// step above 0 V (AN2834, ideal transfer curve).
    pub fn ideal_code(input_v: f64, vdda_v: f64) -> u16 {
        Self::code(input_v / vdda_v * CODES)
    }

    fn code(value: f64) -> u16 {
        // NaN, of 0 V / 0 V, becomes 0.
        value.round().clamp(0.0, CODES - 1.0) as u16
    }
}

/// What the converter is at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    Idle,
    /// The input is connected until `until`.
    Sampling {
        channel: u8,
        until: Ticks,
        done: Ticks,
    },
    /// The code is being worked out.
    Converting {
        code: u16,
        done: Ticks,
    },
}

/// ADC1 with the common registers at 0x300.
///
/// Not modelled: sequences of more than one channel, scan, continuous and discontinuous mode, injected channels, triggers
/// by timers, DMA, resolutions below 12 bits, left alignment, the analogue watchdog, VBAT, several converters together;
/// settling of a source through its resistance, offset, gain and linearity errors.
#[derive(Clone, Debug)]
pub struct Adc1 {
    parameters: AdcParameters,
    noise: ChaCha8Rng,
    sr: u32,
    cr1: u32,
    /// SWSTART is cleared as soon as the conversion starts, so it is never in here.
    cr2: u32,
    smpr: [u32; 2],
    channel: u8,
    dr: u16,
    ccr: u32,
    on_since: Ticks,
    internal_since: Ticks,
    phase: Phase,
}

impl Default for Adc1 {
    fn default() -> Self {
        Self::new(AdcParameters::default())
    }
}

impl Adc1 {
    /// After reset: switched off.
    pub fn new(parameters: AdcParameters) -> Self {
        Self {
            parameters,
            noise: ChaCha8Rng::seed_from_u64(parameters.seed),
            sr: 0,
            cr1: 0,
            cr2: 0,
            smpr: [0; 2],
            channel: 0,
            dr: 0,
            ccr: 0,
            on_since: Ticks(0),
            internal_since: Ticks(0),
            phase: Phase::Idle,
        }
    }

    /// The analogue side.
    pub const fn parameters(&self) -> &AdcParameters {
        &self.parameters
    }

    /// Another supply, in V.
    pub const fn set_vdda_v(&mut self, vdda_v: f64) {
        self.parameters.vdda_v = vdda_v;
    }

    /// Another temperature of the die, in °C.
    pub const fn set_die_temperature_c(&mut self, die_temperature_c: f64) {
        self.parameters.die_temperature_c = die_temperature_c;
    }

    /// Another noise of the code, as a standard deviation in codes.
    pub const fn set_noise_codes(&mut self, noise_codes: f64) {
        self.parameters.noise_codes = noise_codes;
    }

    /// The input that is connected to the converter now.
    pub const fn sampled_channel(&self) -> Option<u8> {
        match self.phase {
            Phase::Sampling { channel, .. } => Some(channel),
            _ => None,
        }
    }

    const fn is_on(&self) -> bool {
        self.cr2 & CR2_ADON != 0
    }

    fn sampling_cycles(&self, channel: u8) -> u64 {
        let (word, place) = if channel >= 10 {
            (self.smpr[0], channel - 10)
        } else {
            (self.smpr[1], channel)
        };
        SAMPLING_CYCLES[(word >> (3 * place) & 7) as usize]
    }

    /// Divider of ADCCLK: 2, 4, 6 or 8.
    const fn divider(&self) -> u32 {
        2 * ((self.ccr & CCR_ADCPRE) >> 16) + 2
    }

    fn cycles(&self, cycles: u64, context: &Context<'_>) -> Ticks {
        let divider = u64::from(self.divider());
        Ticks(cycles * divider * Ticks::PER_SECOND / u64::from(context.clocks.apb2.max(1)))
    }

    fn start(&mut self, context: &Context<'_>) -> Result<(), Unmodelled> {
        let refuse = |what: &str| Err(unmodelled("ADC1_CR2", format!("SWSTART {what}")));
        // RM0090, `ADC_CR2`: "can be set only when ADON = 1 otherwise no conversion is launched". After an overrun,
        // triggers are ignored until OVR is cleared (13.8.1).
        if !self.is_on() || self.sr & SR_OVR != 0 {
            return Ok(());
        }
        if self.phase != Phase::Idle {
            return refuse("during a conversion");
        }
        let now = context.now;
        if now.since(self.on_since) < STABILISATION {
            return refuse("before the converter is stable");
        }
        let clock_hz = context.clocks.apb2 / self.divider();
        if !CLOCK_RANGE_HZ.contains(&clock_hz) {
            return Err(unmodelled(
                "ADC_CCR",
                format!("ADCCLK of {clock_hz} Hz, outside 0.6 … 36 MHz,"),
            ));
        }
        let sampling = self.cycles(self.sampling_cycles(self.channel), context);
        if matches!(self.channel, TEMPERATURE_CHANNEL | REFERENCE_CHANNEL) {
            if self.ccr & CCR_TSVREFE == 0 {
                return refuse("of an internal channel without TSVREFE");
            }
            if sampling < INTERNAL_STARTUP {
                return refuse("of an internal channel with less than 10 µs of sampling");
            }
            if now.since(self.internal_since) < INTERNAL_STARTUP {
                return refuse("of an internal channel within 10 µs of TSVREFE");
            }
        }
        self.sr |= SR_STRT;
        self.phase = Phase::Sampling {
            channel: self.channel,
            until: now + sampling,
            done: now + sampling + self.cycles(CONVERSION_CYCLES, context),
        };
        Ok(())
    }

    fn input_v(&self, channel: u8, context: &mut Context<'_>) -> f64 {
        match channel {
            TEMPERATURE_CHANNEL => self.parameters.sensor_v(self.parameters.die_temperature_c),
            REFERENCE_CHANNEL => self.parameters.reference_v,
            // The world's time never goes back, so it is asked about now.
            external => context.outside.adc_v(external, context.now),
        }
    }

    fn sample(&mut self, channel: u8, context: &mut Context<'_>) -> u16 {
        let input_v = self.input_v(channel, context);
        let mut value = input_v / self.parameters.vdda_v * CODES;
        if self.parameters.noise_codes > 0.0 {
            let deviation: f64 = StandardNormal.sample(&mut self.noise);
            value += self.parameters.noise_codes * deviation;
        }
        AdcParameters::code(value)
    }

    const fn finish(&mut self, code: u16) {
        // RM0090, 13.8.1: the data in DR stays what it was. Without EOCS or DMA overruns are not watched for.
        if self.cr2 & CR2_EOCS != 0 && self.sr & SR_EOC != 0 {
            self.sr |= SR_OVR;
        } else {
            self.dr = code;
            self.sr |= SR_EOC;
        }
    }

    fn set_line(&self, context: &Context<'_>) {
        let asks = self.sr & SR_EOC != 0 && self.cr1 & CR1_EOCIE != 0
            || self.sr & SR_OVR != 0 && self.cr1 & CR1_OVRIE != 0;
        context.interrupts.set(IRQ, asks);
    }

    fn write_cr2(&mut self, value: u32, context: &Context<'_>) -> Result<(), Unmodelled> {
        only_bits("ADC1_CR2", value, CR2_ADON | CR2_EOCS | CR2_SWSTART)?;
        let was_on = self.is_on();
        self.cr2 = value & !CR2_SWSTART;
        if !self.is_on() {
            self.phase = Phase::Idle;
        } else if !was_on {
            self.on_since = context.now;
        }
        if value & CR2_SWSTART != 0 {
            self.start(context)?;
        }
        Ok(())
    }

    fn write_ccr(&mut self, value: u32, context: &Context<'_>) -> Result<(), Unmodelled> {
        only_bits("ADC_CCR", value, CCR_ADCPRE | CCR_TSVREFE)?;
        if value & !self.ccr & CCR_TSVREFE != 0 {
            self.internal_since = context.now;
        }
        self.ccr = value;
        Ok(())
    }

    /// Refuses a change of the settings that a running conversion depends on.
    fn while_idle(&self, register: &str, changes: bool) -> Result<(), Unmodelled> {
        if changes && self.phase != Phase::Idle {
            return Err(unmodelled(register, "change during a conversion"));
        }
        Ok(())
    }
}

/// `offset` counts from ADC1's base, 0x4001_2000.
impl Peripheral for Adc1 {
    fn read(
        &mut self,
        offset: u32,
        bytes: u8,
        context: &mut Context<'_>,
    ) -> Result<u32, Unmodelled> {
        check_width("ADC", offset, bytes, 1)?;
        self.advance(context);
        let word = match offset & !3 {
            0x00 => self.sr,
            0x04 => self.cr1,
            0x08 => self.cr2,
            0x0C => self.smpr[0],
            0x10 => self.smpr[1],
            // A sequence of one.
            0x2C | 0x30 => 0,
            0x34 => u32::from(self.channel),
            0x4C => {
                // Reading the data clears EOC.
                self.sr &= !SR_EOC;
                self.set_line(context);
                u32::from(self.dr)
            }
            0x300 => self.sr,
            0x304 => self.ccr,
            _ => return Err(unknown("ADC", offset, "read")),
        };
        Ok(part(word, offset, bytes))
    }

    fn write(
        &mut self,
        offset: u32,
        bytes: u8,
        value: u32,
        context: &mut Context<'_>,
    ) -> Result<(), Unmodelled> {
        // RM0090, 13.13: registers are written as words.
        check_width("ADC", offset, bytes, 4)?;
        self.advance(context);
        match offset {
            // Flags are cleared by 0; 1 leaves them.
            0x00 => self.sr &= value,
            0x04 => {
                only_bits("ADC1_CR1", value, CR1_EOCIE | CR1_OVRIE)?;
                self.cr1 = value;
            }
            0x08 => self.write_cr2(value, context)?,
            0x0C => {
                only_bits("ADC1_SMPR1", value, 0x07FF_FFFF)?;
                self.while_idle("ADC1_SMPR1", value != self.smpr[0])?;
                self.smpr[0] = value;
            }
            0x10 => {
                only_bits("ADC1_SMPR2", value, 0x3FFF_FFFF)?;
                self.while_idle("ADC1_SMPR2", value != self.smpr[1])?;
                self.smpr[1] = value;
            }
            // A longer sequence.
            0x2C => refuse_bits("ADC1_SQR1", value)?,
            0x30 => refuse_bits("ADC1_SQR2", value)?,
            0x34 => {
                let channel = (value & 0x1F) as u8;
                refuse_bits("ADC1_SQR3", value & !0x1F)?;
                if channel > REFERENCE_CHANNEL {
                    return Err(unmodelled("ADC1_SQR3", format!("channel {channel}")));
                }
                self.while_idle("ADC1_SQR3", channel != self.channel)?;
                self.channel = channel;
            }
            0x304 => {
                self.while_idle("ADC_CCR", value != self.ccr)?;
                self.write_ccr(value, context)?;
            }
            _ => return Err(unknown("ADC", offset, "write")),
        }
        self.set_line(context);
        Ok(())
    }

    fn next_event(&self) -> Option<Ticks> {
        match self.phase {
            Phase::Idle => None,
            Phase::Sampling { until, .. } => Some(until),
            Phase::Converting { done, .. } => Some(done),
        }
    }

    fn advance(&mut self, context: &mut Context<'_>) {
        if let Phase::Sampling {
            channel,
            until,
            done,
        } = self.phase
            && until <= context.now
        {
            let code = self.sample(channel, context);
            self.phase = Phase::Converting { code, done };
        }
        if let Phase::Converting { code, done } = self.phase
            && done <= context.now
        {
            self.phase = Phase::Idle;
            self.finish(code);
            self.set_line(context);
        }
    }

    /// The analogue side and its noise go on.
    fn reset(&mut self, context: &mut Context<'_>) {
        *self = Self {
            noise: self.noise.clone(),
            ..Self::new(self.parameters)
        };
        self.set_line(context);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

    use proptest::prelude::*;

    use super::super::test_world::{Voltage, World};
    use super::*;

    const SR: u32 = 0x00;
    const CR1: u32 = 0x04;
    const CR2: u32 = 0x08;
    const SMPR1: u32 = 0x0C;
    const SMPR2: u32 = 0x10;
    const SQR3: u32 = 0x34;
    const DR: u32 = 0x4C;
    const CCR: u32 = 0x304;
    /// One cycle of 21 MHz.
    const CYCLE: u64 = 16;

    /// On and stable, APB2 / 4, internal channels on, their sampling time the longest.
    fn ready(world: &mut World, parameters: AdcParameters) -> Adc1 {
        let mut adc = Adc1::new(parameters);
        world.write(&mut adc, CCR, 1 << 16 | CCR_TSVREFE);
        world.write(&mut adc, SMPR1, 7 << 18 | 7 << 21);
        world.write(&mut adc, CR2, CR2_ADON);
        world.now += Ticks::from_micros(20);
        adc
    }

    fn convert(world: &mut World, adc: &mut Adc1, channel: u32) -> u32 {
        world.write(adc, SQR3, channel);
        world.write(adc, CR2, CR2_ADON | CR2_SWSTART);
        let end = world.now + Ticks::from_micros(60);
        world.run_until(adc, end);
        assert_ne!(world.read(adc, SR) & SR_EOC, 0);
        world.read(adc, DR)
    }

    #[test]
    fn reset_values_are_the_manuals() {
        let mut world = World::default();
        let mut adc = Adc1::default();
        for offset in [SR, CR1, CR2, SMPR1, SMPR2, 0x2C, 0x30, SQR3, DR, 0x300, CCR] {
            assert_eq!(world.read(&mut adc, offset), 0, "offset {offset:#X}");
        }
        assert_eq!(adc.next_event(), None);
    }

    /// RM0090, 13.5: sampling time plus 12 cycles.
    #[test]
    fn conversion_takes_sampling_and_twelve_cycles() {
        let cycles = [3, 15, 28, 56, 84, 112, 144, 480];
        for (prescaler, apb2_cycles) in [(0, 2), (1, 4), (2, 6), (3, 8)] {
            for (code, sampling) in (0..).zip(cycles) {
                for channel in [3, 11] {
                    let mut world = World::default();
                    // 42 MHz: ADCCLK is in its range with every prescaler.
                    world.clocks.apb2 = 42_000_000;
                    let mut adc = Adc1::default();
                    world.write(&mut adc, CCR, prescaler << 16);
                    world.write(&mut adc, SMPR2, code << 9);
                    world.write(&mut adc, SMPR1, code << 3);
                    world.write(&mut adc, CR2, CR2_ADON);
                    world.now = Ticks::from_micros(10);
                    world.write(&mut adc, SQR3, channel);
                    world.write(&mut adc, CR2, CR2_ADON | CR2_SWSTART);
                    assert_eq!(world.read(&mut adc, SR), SR_STRT);
                    let start = world.now;
                    let sampled = start + Ticks(8 * apb2_cycles * sampling);
                    let done = sampled + Ticks(8 * apb2_cycles * 12);
                    world.run_until(&mut adc, done - Ticks(1));
                    assert_eq!(world.read(&mut adc, SR), SR_STRT);
                    world.run_until(&mut adc, done);
                    assert_eq!(world.read(&mut adc, SR), SR_STRT | SR_EOC);
                    let seen = u8::try_from(channel).unwrap();
                    assert_eq!(world.pins.sampled, [(seen, sampled)]);
                }
            }
        }
    }

    #[test]
    fn codes_round_and_clip() {
        let mut world = World::default();
        let mut adc = ready(&mut world, AdcParameters::default());
        let rows: [(Voltage, u32); 8] = [
            (|_, _| -0.3, 0),
            (|_, _| 0.0, 0),
            (|_, _| 0.49 * 3.3 / 4_096.0, 0),
            (|_, _| 0.51 * 3.3 / 4_096.0, 1),
            (|_, _| 1.65, 2_048),
            (|_, _| 4_095.0 * 3.3 / 4_096.0, 4_095),
            (|_, _| 3.3, 4_095),
            (|_, _| 5.0, 4_095),
        ];
        for (voltage, code) in rows {
            world.pins.adc_v = Some(voltage);
            assert_eq!(convert(&mut world, &mut adc, 10), code);
        }
        adc.set_vdda_v(3.0);
        world.pins.adc_v = Some(|channel, _| f64::from(channel) * 0.1);
        assert_eq!(convert(&mut world, &mut adc, 15), 2_048);
    }

    #[test]
    fn input_is_taken_at_the_end_of_the_sampling_time() {
        let mut world = World::default();
        let mut adc = ready(&mut world, AdcParameters::default());
        world.pins.adc_v = Some(|_, at| if at.micros() < 20.0 + 3.9 { 1.0 } else { 2.0 });
        // 84 cycles of 21 MHz: 4 µs.
        world.write(&mut adc, SMPR1, 4);
        assert_eq!(
            convert(&mut world, &mut adc, 10),
            (2.0_f64 / 3.3 * 4_096.0).round() as u32
        );
    }

    /// Data sheet, typical values: V25 = 0.76 V, 2.5 mV/K, VREFINT = 1.21 V.
    #[test]
    fn internal_channels() {
        let mut world = World::default();
        let mut adc = ready(&mut world, AdcParameters::default());
        for (die_c, code) in [(25.0, 943), (30.0, 959), (110.0, 1_207), (-40.0, 742)] {
            adc.set_die_temperature_c(die_c);
            assert_eq!(convert(&mut world, &mut adc, 16), code, "{die_c} °C");
        }
        assert_eq!(convert(&mut world, &mut adc, 17), 1_502);
        assert!(world.pins.sampled.is_empty());
        adc.set_vdda_v(3.0);
        assert_eq!(convert(&mut world, &mut adc, 17), 1_652);
    }

    #[test]
    fn flags_are_cleared_by_zero_and_by_reading_the_data() {
        let mut world = World::default();
        let mut adc = ready(&mut world, AdcParameters::default());
        world.write(&mut adc, CR1, CR1_EOCIE);
        convert(&mut world, &mut adc, 10);
        assert_eq!(world.read(&mut adc, SR), SR_STRT);
        assert!(!world.interrupts.is_asserted(IRQ));
        world.write(&mut adc, CR2, CR2_ADON | CR2_SWSTART);
        assert_eq!(world.read(&mut adc, CR2), CR2_ADON, "SWSTART is cleared");
        let end = world.now + Ticks::from_micros(30);
        world.run_until(&mut adc, end);
        assert!(world.interrupts.is_asserted(IRQ));
        assert_eq!(world.read(&mut adc, 0x300), SR_STRT | SR_EOC);
        world.write(&mut adc, SR, !SR_EOC);
        assert_eq!(world.read(&mut adc, SR), SR_STRT);
        assert!(!world.interrupts.is_asserted(IRQ));
        world.write(&mut adc, SR, 0);
        assert_eq!(world.read(&mut adc, SR), 0);
    }

    #[test]
    fn overrun_keeps_the_old_data_with_eocs_only() {
        for (eocs, code, flags) in [(0, 2_048, SR_STRT | SR_EOC), (CR2_EOCS, 1_024, 0x32)] {
            let mut world = World::default();
            let mut adc = ready(&mut world, AdcParameters::default());
            for voltage in [|_, _| 0.825, |_, _| 1.65] {
                world.pins.adc_v = Some(voltage);
                world.write(&mut adc, CR2, CR2_ADON | CR2_SWSTART | eocs);
                let end = world.now + Ticks::from_micros(30);
                world.run_until(&mut adc, end);
            }
            assert_eq!(world.read(&mut adc, SR), flags);
            assert_eq!(world.read(&mut adc, DR), code);
            // Ignored until OVR is cleared.
            world.write(&mut adc, CR2, CR2_ADON | CR2_SWSTART | eocs);
            assert_eq!(adc.next_event().is_none(), eocs != 0);
        }
    }

    #[test]
    fn nothing_starts_while_off_and_switching_off_ends_it() {
        let mut world = World::default();
        let mut adc = Adc1::default();
        world.write(&mut adc, CR2, CR2_SWSTART);
        assert_eq!(adc.next_event(), None);
        let mut adc = ready(&mut world, AdcParameters::default());
        world.write(&mut adc, CR2, CR2_ADON | CR2_SWSTART);
        assert!(adc.next_event().is_some());
        world.write(&mut adc, CR2, 0);
        assert_eq!(adc.next_event(), None);
        assert_eq!(world.read(&mut adc, SR) & SR_EOC, 0);
    }

    #[test]
    fn what_a_real_converter_would_do_wrong_is_refused() {
        let start = CR2_ADON | CR2_SWSTART;
        let mut world = World::default();
        let mut adc = Adc1::default();
        world.write(&mut adc, CR2, CR2_ADON);
        world.now += Ticks(STABILISATION.0 - 1);
        assert!(world.refuses(&mut adc, CR2, start), "not stable");
        world.now += Ticks(1);
        assert!(world.refuses(&mut adc, CR2, start), "84 MHz / 2");
        let mut adc = ready(&mut world, AdcParameters::default());
        world.write(&mut adc, CR2, start);
        assert!(world.refuses(&mut adc, CR2, start), "still converting");
        assert!(world.refuses(&mut adc, SQR3, 5));
        assert!(world.refuses(&mut adc, SMPR1, 0));
        assert!(world.refuses(&mut adc, CCR, 0));
        let end = world.now + Ticks::from_micros(30);
        world.run_until(&mut adc, end);
        world.write(&mut adc, SMPR1, 0);
        world.write(&mut adc, SQR3, 16);
        assert!(world.refuses(&mut adc, CR2, start), "3 cycles");
        world.write(&mut adc, SMPR1, 7 << 18);
        world.write(&mut adc, CCR, 1 << 16);
        assert!(world.refuses(&mut adc, CR2, start), "no TSVREFE");
        world.write(&mut adc, CCR, 1 << 16 | CCR_TSVREFE);
        assert!(world.refuses(&mut adc, CR2, start), "TSVREFE just now");
        world.now += INTERNAL_STARTUP;
        world.write(&mut adc, CR2, start);
    }

    #[test]
    fn what_is_missing_is_refused() {
        let mut world = World::default();
        let mut adc = ready(&mut world, AdcParameters::default());
        for bit in [6, 7, 8, 10, 11, 12, 22, 23, 24, 25] {
            assert!(world.refuses(&mut adc, CR1, 1 << bit));
        }
        for bit in [1, 8, 9, 11, 20, 22, 24, 28] {
            assert!(world.refuses(&mut adc, CR2, CR2_ADON | 1 << bit));
        }
        for bit in [0, 8, 14, 22] {
            assert!(world.refuses(&mut adc, CCR, 1 << bit));
        }
        assert!(world.refuses(&mut adc, 0x2C, 1 << 20), "two channels");
        assert!(world.refuses(&mut adc, SQR3, 18), "VBAT");
        for offset in [0x14, 0x24, 0x38, DR, 0x100, 0x200, 0x300, 0x308] {
            assert!(world.refuses(&mut adc, offset, 0), "offset {offset:#X}");
        }
        assert!(adc.write(SMPR1, 2, 0, &mut world.context()).is_err());
    }

    #[test]
    fn noise_has_its_size_and_repeats() {
        let parameters = AdcParameters {
            noise_codes: 2.0,
            seed: 7,
            ..AdcParameters::default()
        };
        let run = || {
            let mut world = World::default();
            world.pins.adc_v = Some(|_, _| 1.65);
            let mut adc = ready(&mut world, parameters);
            (0..2_000)
                .map(|_| f64::from(convert(&mut world, &mut adc, 10)))
                .collect::<Vec<_>>()
        };
        let codes = run();
        assert_eq!(codes, run());
        let count = codes.len() as f64;
        let mean = codes.iter().sum::<f64>() / count;
        let variance = codes.iter().map(|code| (code - mean).powi(2)).sum::<f64>() / count;
        // Four standard errors; 1/12 is the rounding's own variance.
        assert!((mean - 2_048.0).abs() < 4.0 * 2.0 / count.sqrt(), "{mean}");
        let expected: f64 = 4.0 + 1.0 / 12.0;
        assert!(
            (variance - expected).abs() < 4.0 * expected * (2.0 / count).sqrt(),
            "{variance}"
        );
    }

    #[test]
    fn reset_switches_it_off() {
        let mut world = World::default();
        let mut adc = ready(&mut world, AdcParameters::default());
        adc.set_vdda_v(3.1);
        world.write(&mut adc, CR2, CR2_ADON | CR2_SWSTART);
        adc.reset(&mut world.context());
        assert_eq!(adc.next_event(), None);
        assert_eq!(world.read(&mut adc, CR2), 0);
        assert_eq!(adc.parameters().vdda_v, 3.1);
    }

    proptest! {
        /// Within half a step of the voltage, in the whole range and at any supply.
        #[test]
        fn code_is_within_half_a_step(share in 0.0..1.0_f64, vdda_v in 2.4..3.6_f64) {
            let code = f64::from(AdcParameters::ideal_code(share * vdda_v, vdda_v));
            let error = code - share * CODES;
            prop_assert!(error.abs() <= 0.5 + 1e-9 || code == CODES - 1.0 && error >= -1.0);
        }

        /// Polling at any times changes neither the result nor its time.
        #[test]
        fn polling_changes_nothing(polls in proptest::collection::vec(1u64..2_000, 0..20)) {
            let mut world = World::default();
            world.pins.adc_v = Some(|_, _| 2.0);
            let mut adc = ready(&mut world, AdcParameters::default());
            world.write(&mut adc, SMPR1, 4);
            world.write(&mut adc, SQR3, 10);
            world.write(&mut adc, CR2, CR2_ADON | CR2_SWSTART);
            let done = world.now + Ticks((84 + 12) * CYCLE);
            for step in polls {
                let end = world.now + Ticks(step);
                world.run_until(&mut adc, end);
                prop_assert_eq!(world.read(&mut adc, SR) & SR_EOC != 0, world.now >= done);
            }
        }
    }
}
