//! ADE7753: energy meter with SPI, as its pins see it.
//!
//! Sources: ADE7753 data sheet Rev C; where it is silent its sister parts ADE7763 (Rev C), ADE7759 and the preliminary
//! sheets of the ADE7753 (PrC, PrF). What none of them settles is a parameter of [`Ade7753Config`].
//!
//! The active power path is modelled sample by sample: the chip adds one number to a 49-bit accumulator every four
//! clocks, and AENERGY is its upper 24 bits. As the inputs are straight lines within a stretch, the sum over all
//! samples of a stretch is a closed form, also through the high-pass filter and LPF2; where a stretch crosses the
//! no-load threshold or zero, the sample at which it does is found exactly. Splitting a stretch changes nothing.
//!
//! Not modelled, and reported as [`Violation::Unmodelled`] when used: rms and apparent energy, the line-cycle mode, sag
//! detection, the digital integrator, the test mode. Not modelled and without effect on a DC meter: rounding inside the
//! data path, phase calibration, the sinc filter's delay, CF, ZX and SAG pins.

mod config;
mod faults;
mod power;
pub mod registers;
mod serial;

use std::collections::VecDeque;

use crate::{stretch::Linear, violations::Violations};
pub use config::{Ade7753Config, ChannelConfig, SerialTiming, TemperatureTrigger};
use faults::Line;
pub use faults::{Flip, Level, Transaction, Violation};
use power::{Accumulator, Decay, Decays, Response, Sense};
use registers::{address, flag, mode, sign_magnitude, signed};
use serial::Serial;

/// Multiplier output for DC full scale on both channels: the peak of p(t) for full-scale sinusoids (Rev C, figure 61).
pub const FULL_SCALE_POWER: f64 = 0x19_999A as f64;
/// Channel 1 sample at full scale (Rev C, figure 51).
pub const FULL_SCALE_CHANNEL_1: f64 = 0x28_51EC as f64;
/// Channel 2 sample at full scale (PrC, channel 2 sampling).
pub const FULL_SCALE_CHANNEL_2: f64 = 0x2852 as f64;
/// Full-scale input at gain 1, in V (Rev C, analog inputs).
pub const FULL_SCALE_V: f64 = 0.5;
/// Nominal reference, in V (Rev C, specifications).
pub const NOMINAL_REFERENCE_V: f64 = 2.4;
/// Clocks per addition to the energy accumulator (Rev C, energy calculation: T = 4/CLKIN).
pub const CLOCKS_PER_SAMPLE: f64 = 4.0;
/// Additions per step of ZXTOUT, which counts CLKIN/128 (Rev C, zero-crossing timeout), and per waveform sample at the
/// highest rate.
const SAMPLES_PER_128_CLOCKS: u64 = 32;
/// Clocks of a temperature conversion: 24 periods of CLKIN/4, 26 µs (Rev C, temperature measurement).
const TEMPERATURE_SAMPLES: u64 = 24;
/// CLKIN/8 is the resolution of PERIOD, 2.2 µs (ADE7763 Rev C, period measurement).
const SAMPLES_PER_PERIOD_STEP: u64 = 2;

/// Which sample belongs to which time.
#[derive(Clone, Copy, Debug)]
struct Clock {
    anchor_s: f64,
    anchor_sample: u64,
    /// Additions per second; 0 while CLKIN stands still.
    sampling_hz: f64,
    period_s: f64,
}

impl Clock {
    fn new(anchor_s: f64, anchor_sample: u64, sampling_hz: f64) -> Self {
        Self {
            anchor_s,
            anchor_sample,
            sampling_hz,
            period_s: sampling_hz.recip(),
        }
    }

    /// The last sample at or before `at_s`.
    fn sample_at(&self, at_s: f64) -> u64 {
        self.anchor_sample + ((at_s - self.anchor_s) * self.sampling_hz) as u64
    }

    fn time_of(&self, sample: u64) -> f64 {
        self.anchor_s + (sample - self.anchor_sample) as f64 * self.period_s
    }
}

/// From the pin's volts to a share of full scale.
#[derive(Clone, Copy, Debug, Default)]
struct Channel {
    /// Input at which it clips, in V.
    limit_v: f64,
    /// Input up to which it is specified, in V.
    range_v: f64,
    per_volt: f64,
    offset: f64,
    shorted: bool,
}

impl Channel {
    fn volts(&self, v: f64) -> f64 {
        if self.shorted { 0.0 } else { v }
    }
}

/// What registers and temperature make of the inputs.
#[derive(Clone, Copy, Debug, Default)]
struct Chain {
    channel_1: Channel,
    channel_2: Channel,
    bypass_high_pass: bool,
    bypass_low_pass: bool,
    suspended: bool,
    swapped: bool,
    positive_only: bool,
    /// APOS in LSB of LPF2's output.
    power_offset: f64,
    /// WGAIN and WDIV.
    power_gain: f64,
    threshold: f64,
}

/// The chip.
#[derive(Clone, Debug)]
pub struct Ade7753 {
    config: Ade7753Config,
    now_s: f64,
    clock: Clock,
    clkin_ppm: f64,
    stopped: bool,
    /// Additions so far.
    sample: u64,
    /// What can be written, by address.
    registers: [u32; 0x40],
    chain: Chain,
    decays: Decays,
    /// What the high-pass filter takes away from channel 1.
    high_pass_state: f64,
    low_pass_state: f64,
    accumulator: Accumulator,
    sign: Option<Sense>,
    status: u16,
    waveform: u32,
    temperature_code: u32,
    temperature_c: f64,
    temperature_pending: bool,
    temperature_done: Option<u64>,
    period: u32,
    last_rise: Option<u64>,
    channel_2_positive: Option<bool>,
    zero_crossing_timeout: u64,
    peak_1: f64,
    peak_2: f64,
    over_range: u64,
    is_over_range: bool,
    reset_until_s: Option<f64>,
    reset_by_command: bool,
    brown_out_at_s: Option<f64>,
    serial: Serial,
    line: Line,
    violations: Violations<Violation>,
}

impl Ade7753 {
    /// The chip at power-up: registers at their reset values, STATUS.RESET set.
    pub fn new(config: Ade7753Config, at_s: f64) -> Self {
        let sampling_hz = config.clkin_hz / CLOCKS_PER_SAMPLE;
        let mut chip = Self {
            config,
            now_s: at_s,
            clock: Clock::new(at_s, 0, sampling_hz * (1.0 + config.clkin_ppm * 1e-6)),
            clkin_ppm: config.clkin_ppm,
            stopped: false,
            sample: 0,
            registers: [0; 0x40],
            chain: Chain::default(),
            // Digital filters: their corners move with the crystal.
            decays: Decays {
                high_pass: Decay::new(config.high_pass_hz, sampling_hz),
                low_pass: Decay::new(config.low_pass_hz, sampling_hz),
            },
            high_pass_state: 0.0,
            low_pass_state: 0.0,
            accumulator: Accumulator::default(),
            sign: None,
            status: 0,
            waveform: 0,
            temperature_code: 0,
            temperature_c: 25.0,
            temperature_pending: false,
            temperature_done: None,
            period: 0,
            last_rise: None,
            channel_2_positive: None,
            zero_crossing_timeout: 0,
            peak_1: 0.0,
            peak_2: 0.0,
            over_range: 0,
            is_over_range: false,
            reset_until_s: None,
            reset_by_command: false,
            brown_out_at_s: None,
            serial: Serial::default(),
            line: Line::new(),
            violations: Violations::default(),
        };
        chip.load_defaults();
        chip.status = flag::RESET;
        chip
    }

    /// Moves to `end_s`, over which the input of channel 1 goes as `v1`, in V, and that of channel 2 stays at `v2_v`.
    pub fn advance(&mut self, end_s: f64, v1: Linear, v2_v: f64) {
        let mut v1 = v1;
        // Also refuses a time that is not a number.
        while end_s > self.now_s {
            let event_s = self.next_event_s();
            if event_s > end_s {
                self.stretch(end_s, v1, v2_v);
                return;
            }
            if event_s > self.now_s {
                let fraction = (event_s - self.now_s) / (end_s - self.now_s);
                self.stretch(event_s, v1.part(0.0, fraction), v2_v);
                v1 = v1.part(fraction, 1.0);
            }
            self.take_event();
        }
    }

    /// Time up to which the chip has been advanced, in s.
    pub fn now_s(&self) -> f64 {
        self.now_s
    }

    /// Temperature of the die, in °C; 25 at first.
    pub fn set_temperature_c(&mut self, temperature_c: f64) {
        self.temperature_c = temperature_c;
        self.rebuild();
    }

    /// Whether the chip, or a fault, pulls IRQ low.
    pub fn irq_low(&self) -> bool {
        match self.line.stuck_irq {
            Some(level) => level == Level::Low,
            None => {
                self.reset_until_s.is_none()
                    && !self.serial.releases_irq()
                    && self.interrupting() != 0
            }
        }
    }

    /// Not before this time, in s, does IRQ fall by itself; `None` if nothing that is enabled can make it.
    ///
    /// A bound: for the accumulator it takes the fastest input there is.
    pub fn next_irq_s(&self) -> Option<f64> {
        let enabled = self.irq_enable() & !flag::RESET;
        if enabled == 0 || self.irq_low() || self.clock.sampling_hz == 0.0 {
            return None;
        }
        let in_samples = |samples: u64| self.clock.time_of(self.sample + samples).max(self.now_s);
        let mut next = f64::INFINITY;
        if enabled & (flag::PKI | flag::PKV | flag::PPOS | flag::PNEG | flag::ZX) != 0 {
            next = self.now_s;
        }
        if enabled & flag::WSMP != 0 {
            let step = self.waveform_step();
            next = next.min(in_samples(step - self.sample % step));
        }
        if enabled & flag::ZXTO != 0 {
            next = next.min(in_samples(
                self.zero_crossing_timeout.saturating_sub(self.sample),
            ));
        }
        if enabled & flag::TEMP != 0 {
            if let Some(done) = self.temperature_done {
                next = next.min(in_samples(done.saturating_sub(self.sample)));
            } else if self.temperature_pending {
                next = self.now_s;
            }
        }
        if enabled & (flag::AEHF | flag::AEOF) != 0 {
            let full =
                |channel: &Channel| channel.limit_v * channel.per_volt.abs() + channel.offset.abs();
            let fastest =
                (FULL_SCALE_POWER * full(&self.chain.channel_1) * full(&self.chain.channel_2)
                    + self.chain.power_offset.abs())
                    * self.chain.power_gain;
            let samples = (self.accumulator.room() / fastest) as u64;
            next = next.min(in_samples(samples));
        }
        next.is_finite().then_some(next)
    }

    /// AENERGY as a read would give it now, without side effects.
    pub fn energy(&self) -> i32 {
        self.accumulator.visible()
    }

    /// The whole 49-bit accumulator, in AENERGY counts: what a read rounds down.
    pub fn energy_exact(&self) -> f64 {
        self.accumulator.exact()
    }

    /// Puts AENERGY to `counts`, its lower 24 bits counting, as if so much had gone through before (F6).
    pub const fn preset_energy(&mut self, counts: i32) {
        self.accumulator.preset(counts);
    }

    /// A register's value now, without side effects; `None` for an address without register.
    pub fn peek(&self, address: u8) -> Option<u32> {
        registers::at(address).map(|register| self.value(register.address) & register.mask())
    }

    /// The flags of STATUS.
    pub fn status(&self) -> u16 {
        self.status
    }

    /// How often an input went beyond the range for which the chip is specified.
    pub fn over_range(&self) -> u64 {
        self.over_range
    }

    /// What the bus did that it may not.
    pub fn violations(&self) -> &Violations<Violation> {
        &self.violations
    }

    /// Forgets the violations.
    pub fn clear_violations(&mut self) {
        self.violations.clear();
    }

    /// The last transfers, oldest first.
    pub fn transactions(&self) -> &VecDeque<Transaction> {
        &self.line.log
    }

    /// Empties the log of transfers and bounds it to `length`; 256 at first.
    pub fn log_transactions(&mut self, length: usize) {
        self.line.log.clear();
        self.line.log_length = length;
    }

    /// Flips each bit that the chip shifts out with this probability (F1); 0 ends it.
    pub fn flip_bits_at_rate(&mut self, per_bit: f64, seed: u64) {
        self.line.flip_at_rate(per_bit, seed);
    }

    /// Flips bits in the data of the first read of `register` whose command ends at or after `not_before_s` (F1, F2).
    pub fn flip_bits(&mut self, not_before_s: f64, register: u8, flip: Flip) {
        self.line.schedule(not_before_s, register, flip);
    }

    /// Bits flipped so far.
    pub fn flipped_bits(&self) -> u64 {
        self.line.flipped_bits
    }

    /// MISO stuck at a level, or free (F3).
    pub fn set_miso_stuck(&mut self, level: Option<Level>) {
        self.line.stuck_miso = level;
    }

    /// IRQ stuck at a level, or free (F8).
    pub fn set_irq_stuck(&mut self, level: Option<Level>) {
        self.line.stuck_irq = level;
    }

    /// A brown-out at `at_s`, at once if that is past (F5): registers as at power-up, accumulator 0, STATUS.RESET after
    /// the time of a reset.
    pub fn brown_out(&mut self, at_s: f64) {
        if at_s <= self.now_s {
            self.reset(self.now_s, false);
        } else {
            self.brown_out_at_s = Some(at_s);
        }
    }

    /// Deviation of the crystal from now on, in ppm (F7).
    pub fn set_clkin_ppm(&mut self, ppm: f64) {
        self.clkin_ppm = ppm;
        self.reclock();
    }

    /// Stops CLKIN, or lets it run again (F7). The serial interface has its own clock.
    pub fn set_clkin_stopped(&mut self, stopped: bool) {
        self.stopped = stopped;
        self.reclock();
    }

    fn reclock(&mut self) {
        let sampling_hz = if self.stopped {
            0.0
        } else {
            self.config.clkin_hz / CLOCKS_PER_SAMPLE * (1.0 + self.clkin_ppm * 1e-6)
        };
        // The sample under way goes on at the new rate; after a stand-still it begins anew.
        let anchor_s = if self.stopped || self.clock.sampling_hz == 0.0 {
            self.now_s
        } else {
            self.clock.time_of(self.sample)
        };
        self.clock = Clock::new(anchor_s, self.sample, sampling_hz);
    }

    fn load_defaults(&mut self) {
        self.registers = [0; 0x40];
        for register in registers::REGISTERS {
            self.registers[usize::from(register.address)] = register.reset;
        }
        self.high_pass_state = 0.0;
        self.low_pass_state = 0.0;
        self.accumulator = Accumulator::default();
        self.sign = None;
        self.status = 0;
        self.waveform = 0;
        self.temperature_code = 0;
        self.temperature_pending = false;
        self.temperature_done = None;
        self.period = 0;
        self.last_rise = None;
        self.channel_2_positive = None;
        self.peak_1 = 0.0;
        self.peak_2 = 0.0;
        self.zero_crossing_timeout = self.sample + self.zero_crossing_limit();
        self.rebuild();
    }

    fn reset(&mut self, at_s: f64, by_command: bool) {
        self.load_defaults();
        self.reset_until_s = Some(at_s + self.config.serial.reset_s);
        self.reset_by_command = by_command;
        self.serial.reset(by_command);
    }

    fn next_event_s(&self) -> f64 {
        let brown_out = self.brown_out_at_s.unwrap_or(f64::INFINITY);
        brown_out.min(self.reset_until_s.unwrap_or(f64::INFINITY))
    }

    fn take_event(&mut self) {
        if self.brown_out_at_s.is_some_and(|at_s| at_s <= self.now_s) {
            self.brown_out_at_s = None;
            self.reset(self.now_s, false);
        } else {
            self.reset_until_s = None;
            self.status |= flag::RESET;
        }
    }

    fn mode(&self) -> u32 {
        self.registers[usize::from(address::MODE)]
    }

    fn irq_enable(&self) -> u16 {
        self.registers[usize::from(address::IRQEN)] as u16
    }

    /// Enabled events that have not been read. RESET cannot interrupt.
    fn interrupting(&self) -> u16 {
        self.status & self.irq_enable() & !flag::RESET
    }

    fn waveform_step(&self) -> u64 {
        SAMPLES_PER_128_CLOCKS << mode::rate(self.mode())
    }

    /// Additions until ZXTO without a zero crossing.
    fn zero_crossing_limit(&self) -> u64 {
        let steps = u64::from(self.registers[usize::from(address::ZXTOUT)]).max(1);
        steps * SAMPLES_PER_128_CLOCKS
    }

    /// Sets ZXTO if it is due at `sample`. *Assumed* to begin anew then: the sheet does not say what the counter does
    /// at 0.
    fn expire_zero_crossing(&mut self, sample: u64) {
        if let Some(late) = sample.checked_sub(self.zero_crossing_timeout) {
            let limit = self.zero_crossing_limit();
            self.status |= flag::ZXTO;
            self.zero_crossing_timeout += (late / limit + 1) * limit;
        }
    }

    /// Works out the chain from the registers.
    fn rebuild(&mut self) {
        let read = |address: u8| self.registers[usize::from(address)];
        let bits = read(address::MODE);
        let gain = read(address::GAIN);
        let warmer_k = self.temperature_c - 25.0;
        let reference = NOMINAL_REFERENCE_V
            / (self.config.reference_v * (1.0 + self.config.reference_tempco_per_k * warmer_k));
        let channel = |config: &ChannelConfig, pga: u32, range: u32, steps: i32, shorted: bool| {
            let pga = pga.min(4);
            // Rev C, analog inputs: offset correction, V per step at gain 1, 2, 4, 8, 16.
            let step_v = [1.61e-3, 1.19e-3, 0.97e-3, 0.84e-3, 0.77e-3][pga as usize];
            let amplification = f64::from(1u32 << pga) * f64::from(1u32 << range.min(2));
            let scale = amplification / FULL_SCALE_V * reference;
            let gain = config.gain * (1.0 + config.gain_tempco_per_k * warmer_k);
            let offset_v = config.offset_v
                + config.offset_tempco_v_per_k * warmer_k
                + f64::from(steps) * step_v;
            Channel {
                limit_v: FULL_SCALE_V / amplification * self.config.clip,
                // Not one rounding error of whoever worked out full scale.
                range_v: FULL_SCALE_V / amplification * (1.0 + 1e-9),
                per_volt: scale * gain,
                offset: scale * offset_v,
                shorted,
            }
        };
        self.chain = Chain {
            channel_1: channel(
                &self.config.channel_1,
                gain & 7,
                gain >> 3 & 3,
                sign_magnitude(read(address::CH1OS)),
                bits & mode::DISCH1 != 0,
            ),
            channel_2: channel(
                &self.config.channel_2,
                gain >> 5 & 7,
                0,
                // Inverted sense.
                -sign_magnitude(read(address::CH2OS)),
                bits & mode::DISCH2 != 0,
            ),
            bypass_high_pass: bits & mode::DISHPF != 0,
            bypass_low_pass: bits & mode::DISLPF2 != 0,
            suspended: bits & mode::ASUSPEND != 0,
            swapped: bits & mode::SWAP != 0,
            positive_only: bits & mode::POAM != 0,
            power_offset: f64::from(signed(read(address::APOS), 16)) / 256.0,
            power_gain: (1.0 + f64::from(signed(read(address::WGAIN), 12)) / 4096.0)
                / f64::from(read(address::WDIV).max(1)),
            threshold: self.config.no_load * FULL_SCALE_POWER,
        };
    }

    /// A stretch without an event in it: finds where the moving input clips.
    fn stretch(&mut self, end_s: f64, v1: Linear, v2_v: f64) {
        let (moving, still) = if self.chain.swapped {
            (self.chain.channel_2, self.chain.channel_1)
        } else {
            (self.chain.channel_1, self.chain.channel_2)
        };
        let v1 = Linear {
            start: moving.volts(v1.start),
            end: moving.volts(v1.end),
        };
        let v2_v = still.volts(v2_v);
        let extreme_v = v1.start.abs().max(v1.end.abs());
        if extreme_v > moving.range_v || v2_v.abs() > still.range_v {
            if !self.is_over_range {
                self.over_range += 1;
            }
            self.is_over_range = v1.end.abs() > moving.range_v || v2_v.abs() > still.range_v;
        } else {
            self.is_over_range = false;
        }
        let v2_v = v2_v.clamp(-still.limit_v, still.limit_v);
        let limit_v = moving.limit_v;
        if extreme_v <= limit_v {
            self.unclipped(end_s, v1, v2_v);
            return;
        }
        let start_s = self.now_s;
        let length_s = end_s - start_s;
        let crossing = |limit_v: f64| (limit_v - v1.start) / (v1.end - v1.start);
        let (low, high) = (crossing(-limit_v), crossing(limit_v));
        for fraction in [low.min(high), low.max(high), 1.0] {
            // Not a number where the input is constant.
            if fraction > 0.0 && fraction <= 1.0 {
                let from = ((self.now_s - start_s) / length_s).clamp(0.0, 1.0);
                let part = v1.part(from, fraction);
                let clipped = Linear {
                    start: part.start.clamp(-limit_v, limit_v),
                    end: part.end.clamp(-limit_v, limit_v),
                };
                let to_s = if fraction < 1.0 {
                    start_s + fraction * length_s
                } else {
                    end_s
                };
                self.unclipped(to_s, clipped, v2_v);
            }
        }
    }

    /// A stretch in which both inputs are straight lines to the converters too.
    fn unclipped(&mut self, end_s: f64, v1: Linear, v2_v: f64) {
        let start_s = self.now_s;
        self.now_s = end_s;
        let last = self.clock.sample_at(end_s);
        if last <= self.sample {
            return;
        }
        let count = (last - self.sample) as f64;
        // Input at sample k = 1 … count: at_0 + per_sample · k.
        let per_second = (v1.end - v1.start) / (end_s - start_s);
        let per_sample = per_second * self.clock.period_s;
        let at_0 = v1.start + per_second * (self.clock.time_of(self.sample) - start_s);
        if self.reset_until_s.is_none() {
            self.samples(count, at_0, per_sample, v2_v);
        }
        self.sample = last;
        self.timers();
    }

    /// Adds `count` samples, at which the input of channel 1 is `at_0 + per_sample · k` volts.
    fn samples(&mut self, count: f64, at_0: f64, per_sample: f64, v2_v: f64) {
        let Chain {
            channel_1,
            channel_2,
            ..
        } = self.chain;
        // Share of full scale of either channel, one of them constant.
        let mut x1 = (channel_1.offset, 0.0);
        let mut x2 = (channel_2.offset, 0.0);
        if self.chain.suspended {
            (x1, x2) = ((0.0, 0.0), (0.0, 0.0));
        } else if self.chain.swapped {
            x1.0 += v2_v * channel_1.per_volt;
            x2.0 += at_0 * channel_2.per_volt;
            x2.1 = per_sample * channel_2.per_volt;
        } else {
            x1.0 += at_0 * channel_1.per_volt;
            x1.1 = per_sample * channel_1.per_volt;
            x2.0 += v2_v * channel_2.per_volt;
        }
        let mut current = Response {
            constant: x1.0,
            slope: x1.1,
            ..Response::default()
        };
        let mut power;
        if self.chain.bypass_high_pass {
            self.high_pass_state = x1.0 + x1.1 * count;
            power = Response {
                constant: FULL_SCALE_POWER * x1.0 * x2.0,
                slope: FULL_SCALE_POWER * (x1.1 * x2.0 + x1.0 * x2.1),
                ..Response::default()
            };
        } else {
            // h(k) = r·h(k−1) + (1−r)·x(k) follows a ramp at a distance; what is left of x is that and a decay.
            let decay = &mut self.decays.high_pass;
            let distance = decay.factor() * x1.1 / decay.step();
            let remainder = self.high_pass_state - x1.0 + distance;
            let at_end = decay.power_less_one(count) + 1.0;
            self.high_pass_state = x1.0 + x1.1 * count - distance + remainder * at_end;
            current = Response {
                constant: distance,
                high_pass: -remainder,
                ..Response::default()
            };
            // With swapped inputs channel 2 moves: its middle stands for it, the only inexact product here.
            let factor = FULL_SCALE_POWER * (x2.0 + x2.1 * 0.5 * (count + 1.0));
            power = Response {
                constant: current.constant * factor,
                high_pass: current.high_pass * factor,
                ..Response::default()
            };
        }
        if self.chain.bypass_low_pass {
            self.low_pass_state = power.value(count, &self.decays);
        } else {
            let decay = &mut self.decays.low_pass;
            power.constant -= decay.factor() * power.slope / decay.step();
            if power.high_pass != 0.0 {
                power.high_pass *=
                    decay.step() / (1.0 - (decay.ln - self.decays.high_pass.ln).exp());
            }
            power.low_pass = self.low_pass_state - power.constant - power.high_pass;
            let mut at_end = power.constant + power.slope * count;
            at_end += power.low_pass * (decay.power_less_one(count) + 1.0);
            if power.high_pass != 0.0 {
                at_end += power.high_pass * (self.decays.high_pass.power_less_one(count) + 1.0);
            }
            self.low_pass_state = at_end;
        }
        self.note_waveform(count, &current, &power, x2);
        self.note_peaks(count, &current, x2);
        self.note_zero_crossing(x2.0 + x2.1, self.sample);
        if x2.1 != 0.0 {
            // A straight line crosses once at most.
            let crossing = (-x2.0 / x2.1).clamp(1.0, count);
            self.note_zero_crossing(x2.0 + x2.1 * count, self.sample + crossing as u64);
        }
        power.constant += self.chain.power_offset;
        self.accumulate(&power, 1.0, count);
    }

    /// Adds samples `first` … `last`, piece by piece where they pass zero or the no-load threshold.
    fn accumulate(&mut self, power: &Response, first: f64, last: f64) {
        let (low, high) = power.bounds(first, last, &self.decays);
        let threshold = self.chain.threshold;
        let sense = Sense::of(low, threshold);
        // Senses are in order: both bounds in one means all in it. A single sample's bounds differ by rounding at most.
        if sense == Sense::of(high, threshold) || first >= last {
            let sum = power.sum(first, last, &mut self.decays);
            self.add(sum, sense);
        } else {
            let middle = (0.5 * (first + last)).floor();
            self.accumulate(power, first, middle);
            self.accumulate(power, middle + 1.0, last);
        }
    }

    fn add(&mut self, sum: f64, sense: Sense) {
        if sense == Sense::Dead {
            return;
        }
        if self.sign != Some(sense) {
            if self.sign.is_some() {
                self.status |= match sense {
                    Sense::Negative => flag::PNEG,
                    _ => flag::PPOS,
                };
            }
            self.sign = Some(sense);
        }
        if sense == Sense::Negative && self.chain.positive_only {
            return;
        }
        let passed = self.accumulator.add(sum * self.chain.power_gain);
        if passed.half_up || passed.half_down && self.config.half_full_when_negative {
            self.status |= flag::AEHF;
        }
        if passed.overflow {
            self.status |= flag::AEOF;
        }
    }

    fn note_waveform(&mut self, count: f64, current: &Response, power: &Response, x2: (f64, f64)) {
        // Rev C, channel 1 sampling: WSMP in IRQEN must be set.
        if self.irq_enable() & flag::WSMP == 0 {
            return;
        }
        let step = self.waveform_step();
        let latest = (self.sample + count as u64) / step * step;
        if latest <= self.sample {
            return;
        }
        let k = (latest - self.sample) as f64;
        let value = match mode::source(self.mode()) {
            0 => power.value(k, &self.decays),
            2 => FULL_SCALE_CHANNEL_1 * current.value(k, &self.decays),
            3 => FULL_SCALE_CHANNEL_2 * (x2.0 + x2.1 * k),
            // Reserved, and reported when it was written.
            _ => return,
        };
        self.waveform = (value.round() as i32).cast_unsigned() & 0xFF_FFFF;
        self.status |= flag::WSMP;
    }

    fn note_peaks(&mut self, count: f64, current: &Response, x2: (f64, f64)) {
        let ends = if current.high_pass == 0.0 {
            current
                .constant
                .abs()
                .max((current.constant + current.slope * count).abs())
        } else {
            let at = |k| current.value(k, &self.decays).abs();
            at(1.0).max(at(count))
        };
        let other = x2.0.abs().max((x2.0 + x2.1 * count).abs());
        self.peak_1 = self.peak_1.max(ends);
        self.peak_2 = self.peak_2.max(other);
        // Rev C, peak detection: the upper byte of twice the sample.
        let level = |address: u8| f64::from(self.registers[usize::from(address)]);
        if ends * FULL_SCALE_CHANNEL_1 * 2.0 > level(address::IPKLVL) * 65_536.0 {
            self.status |= flag::PKI;
        }
        if other * FULL_SCALE_CHANNEL_2 * 2.0 > level(address::VPKLVL) * 256.0 {
            self.status |= flag::PKV;
        }
    }

    fn note_zero_crossing(&mut self, x2: f64, sample: u64) {
        let positive = x2 >= 0.0;
        match self.channel_2_positive.replace(positive) {
            Some(before) if before != positive => {}
            _ => return,
        }
        self.status |= flag::ZX;
        self.expire_zero_crossing(sample);
        self.zero_crossing_timeout = sample + self.zero_crossing_limit();
        if positive && let Some(before) = self.last_rise.replace(sample) {
            let steps = (sample - before) / SAMPLES_PER_PERIOD_STEP;
            self.period = u32::try_from(steps).map_or(0x7FFF, |steps| steps.min(0x7FFF));
        }
        if self.temperature_pending && self.temperature_done.is_none() {
            self.temperature_done = Some(sample + TEMPERATURE_SAMPLES);
        }
        if self.mode() & mode::CYCMODE != 0 {
            self.violations.record(Violation::Unmodelled, self.now_s);
        }
    }

    fn timers(&mut self) {
        self.expire_zero_crossing(self.sample);
        if self
            .temperature_done
            .is_some_and(|done| self.sample >= done)
        {
            self.temperature_done = None;
            self.temperature_pending = false;
            self.registers[usize::from(address::MODE)] &= !mode::TEMPSEL;
            // Rev C, temperature measurement: 1.5 LSB/K, code 0 at −25 °C. It rolls over (sister part ADE7758, Rev. E).
            let code = 1.5 * (self.temperature_c + 25.0) + self.config.temperature_offset_codes;
            self.temperature_code = (code.round() as i64 as u8).into();
            self.status |= flag::TEMP;
        }
    }

    /// What a read gives, before it clears anything.
    fn value(&self, address: u8) -> u32 {
        let energy = || self.accumulator.visible().cast_unsigned();
        match address {
            address::WAVEFORM => self.waveform,
            address::AENERGY | address::RAENERGY => energy(),
            address::STATUS | address::RSTSTATUS => self.status.into(),
            address::IPEAK | address::RSTIPEAK => (self.peak_1 * FULL_SCALE_CHANNEL_1) as u32,
            address::VPEAK | address::RSTVPEAK => (self.peak_2 * FULL_SCALE_CHANNEL_2) as u32,
            address::TEMP => self.temperature_code,
            address::PERIOD => self.period,
            address::CHKSUM => self.serial.ones(),
            address::DIEREV => self.config.die_revision.into(),
            _ => self.registers[usize::from(address & 0x3F)],
        }
    }

    /// What a read gives, with everything that the read does.
    fn latch(&mut self, address: u8, at_s: f64) -> u32 {
        let value = self.value(address);
        match address {
            address::RAENERGY => self.accumulator.clear(self.config.raenergy_clears_hidden),
            address::RSTSTATUS => self.status = 0,
            address::RSTIPEAK => self.peak_1 = 0.0,
            address::RSTVPEAK => self.peak_2 = 0.0,
            // Line-cycle registers hold 0 until a zero crossing; the others would hold something else than 0.
            address::LAENERGY | address::LVAENERGY | address::LVARENERGY => {}
            address::VAENERGY
            | address::RVAENERGY
            | address::IRMS
            | address::VRMS
            | address::TMODE => self.violations.record(Violation::Unmodelled, at_s),
            _ => {}
        }
        value
    }

    /// What a complete write does.
    fn store(&mut self, address: u8, value: u32, at_s: f64) {
        let Some(register) = registers::at(address) else {
            return;
        };
        let value = value & register.mask();
        self.registers[usize::from(address)] = value;
        let unmodelled = match address {
            address::MODE => {
                if value & mode::SWRST != 0 {
                    self.reset(at_s, true);
                    return;
                }
                if value & mode::TEMPSEL == 0 {
                    self.temperature_pending = false;
                    self.temperature_done = None;
                } else if !self.temperature_pending {
                    self.temperature_pending = true;
                    if self.config.temperature_trigger == TemperatureTrigger::Immediate {
                        self.temperature_done = Some(self.sample + TEMPERATURE_SAMPLES);
                    }
                }
                mode::source(value) == 1
            }
            // The digital integrator.
            address::CH1OS => value & 0x80 != 0,
            address::GAIN => value & 7 > 4 || value >> 3 & 3 > 2 || value >> 5 > 4,
            address::SAGLVL => value != 0,
            address::TMODE => true,
            address::ZXTOUT => {
                self.zero_crossing_timeout = self.sample + self.zero_crossing_limit();
                false
            }
            _ => false,
        };
        if unmodelled {
            self.violations.record(Violation::Unmodelled, at_s);
        }
        self.rebuild();
    }
}
