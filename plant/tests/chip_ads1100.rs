//! ADS1100 against the figures of its data sheet (SBAS239).
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::{cell::RefCell, rc::Rc};

use embedded_hal::i2c::{ErrorKind, NoAcknowledgeSource, Operation};
use plant::{
    ads1100::{Ads1100, Ads1100Config, Violation},
    bus::I2cDevice,
    stretch::Linear,
};
use proptest::prelude::*;

/// A byte and its acknowledge at 400 kHz.
const BYTE_S: f64 = 9.0 / 400e3;
const SINGLE: u8 = 0x90;

/// Data rates: code in the configuration, per second, bits.
const RATES: [(u8, f64, u32); 4] = [(0, 128.0, 12), (1, 32.0, 14), (2, 16.0, 15), (3, 8.0, 16)];

/// A chip with constant inputs and a master.
struct Bench {
    chip: Ads1100,
    v: f64,
    vdd: f64,
    now_s: f64,
}

impl Bench {
    fn new(config: Ads1100Config) -> Self {
        Self {
            chip: Ads1100::new(config, 0.0),
            v: 0.0,
            vdd: 5.0,
            now_s: 0.0,
        }
    }

    fn wait(&mut self, s: f64) {
        self.now_s += s;
        let (v, vdd) = (Linear::constant(self.v), Linear::constant(self.vdd));
        self.chip.advance(self.now_s, v, vdd);
    }

    fn address(&mut self, byte: u8) -> bool {
        self.wait(BYTE_S);
        self.chip.address(byte, self.now_s)
    }

    fn write_byte(&mut self, byte: u8) -> bool {
        self.wait(BYTE_S);
        self.chip.write(byte, self.now_s)
    }

    fn read_byte(&mut self) -> u8 {
        self.wait(BYTE_S);
        self.chip.read(self.now_s)
    }

    fn stop(&mut self) {
        self.chip.stop(self.now_s);
    }

    fn configure(&mut self, byte: u8) {
        assert!(self.address(0x90));
        assert!(self.write_byte(byte));
        self.stop();
    }

    /// Output and configuration.
    fn read(&mut self) -> (i16, u8) {
        assert!(self.address(0x91));
        let code = i16::from_be_bytes([self.read_byte(), self.read_byte()]);
        let configuration = self.read_byte();
        self.stop();
        (code, configuration)
    }

    /// In single mode, with nothing under way: what power-up began has ended.
    fn settle(&mut self) {
        self.configure(0x10);
        self.wait(0.126);
    }

    /// The result of one single conversion.
    fn convert(&mut self, settings: u8) -> i16 {
        self.configure(SINGLE | settings);
        self.wait(0.2);
        let (code, configuration) = self.read();
        assert_eq!(configuration, 0x10 | settings);
        code
    }
}

#[test]
fn after_power_up_it_converts_continuously_at_8_sps() {
    let mut bench = Bench::new(Ads1100Config::default());
    bench.v = 2.5;
    bench.wait(0.1);
    assert_eq!(bench.read(), (0, 0x8C), "0 until the first result");
    bench.wait(0.025);
    assert_eq!(bench.read(), (16_384, 0x8C));
    // The same result again, and nothing tells that it is.
    assert_eq!(bench.read(), (16_384, 0x8C));
    assert_eq!(bench.chip.conversions(), 1);
    bench.wait(1.0);
    assert_eq!(bench.chip.conversions(), 9);
}

#[test]
fn addresses_are_48h_to_4fh() {
    for suffix in 0..8 {
        let config = Ads1100Config {
            suffix,
            ..Ads1100Config::default()
        };
        let mut bench = Bench::new(config);
        for address in 0..0x80 {
            let own = address == 0x48 + suffix;
            assert_eq!(bench.address(address << 1 | 1), own);
            bench.stop();
            // Address 0 for writing is the general call.
            assert_eq!(bench.address(address << 1), own || address == 0);
            bench.stop();
        }
    }
}

#[test]
fn codes_are_right_justified_ratiometric_and_clip() {
    for (rate, _, bits) in RATES {
        let full = 1i32 << (bits - 1);
        for pga in 0..4u8 {
            let settings = rate << 2 | pga;
            let gain = f64::from(1 << pga);
            let mut bench = Bench::new(Ads1100Config::default());
            for vdd in [5.0, 4.5, 3.3] {
                bench.vdd = vdd;
                for (share, expected) in [
                    (0.0, 0),
                    (0.25, full / 4),
                    (-0.5, -full / 2),
                    (1.0, full - 1),
                    (1.2, full - 1),
                    (-1.0, -full),
                    (-1.2, -full),
                ] {
                    bench.v = share * vdd / gain;
                    assert_eq!(
                        i32::from(bench.convert(settings)),
                        expected,
                        "{share} of {vdd} V"
                    );
                }
            }
            // One code, as the design's table has it: 38 mA at 16 bits to 610 mA at 12 bits, at 4 mV/A and 5 V.
            bench.vdd = 5.0;
            bench.v = 5.0 / f64::from(full) / gain;
            assert_eq!(bench.convert(settings), 1);
        }
    }
}

#[test]
fn a_single_conversion_takes_one_period_and_then_rests() {
    for (rate, per_second, _) in RATES {
        // 104 … 184 of 128 SPS, and the other rates alike.
        for rate_error in [-0.19, 0.0, 0.2, 0.44] {
            let mut bench = Bench::new(Ads1100Config {
                rate_error,
                ..Ads1100Config::default()
            });
            bench.v = 1.0;
            bench.wait(0.3);
            bench.settle();
            bench.wait(0.1);
            let settings = rate << 2;
            bench.configure(SINGLE | settings);
            let began_s = bench.now_s;
            let period_s = 1.0 / (per_second * (1.0 + rate_error));
            // The read latches at its address byte.
            bench.wait(period_s - BYTE_S - 1e-6);
            assert_eq!(bench.read().1, SINGLE | settings, "busy");
            bench.now_s = bench.now_s.max(began_s + period_s);
            assert_eq!(bench.read().1, 0x10 | settings, "done");
            let count = bench.chip.conversions();
            bench.v = 2.0;
            bench.wait(1.0);
            assert_eq!(bench.chip.conversions(), count);
            // Writing 0 to ST has no effect.
            bench.configure(0x10 | settings);
            bench.wait(1.0);
            assert_eq!(bench.chip.conversions(), count);
        }
    }
}

/// ADS1110 data sheet (SBAS276A), operating modes.
#[test]
fn a_start_has_no_effect_on_a_conversion_under_way() {
    // (Whether the part begins anew, seconds from the start at which the conversion ends, its code.)
    for (restarts, end_s, code) in [(false, 0.125, 16_384), (true, 0.131_25, 4_096)] {
        let mut bench = Bench::new(Ads1100Config {
            restarts,
            ..Ads1100Config::default()
        });
        bench.v = 2.5;
        bench.wait(0.1);
        // From the chip's own 8 conversions per second of 16 bits to single ones, 32 per second of 14.
        bench.configure(SINGLE | 0x04);
        bench.wait(end_s - bench.now_s - 2.0 * BYTE_S);
        assert_eq!(bench.read(), (0, 0x94), "{restarts}");
        bench.wait(1e-3);
        // With the settings it began with.
        assert_eq!(bench.read(), (code, 0x14), "{restarts}");
        assert_eq!(bench.chip.conversions(), 1);
    }
}

#[test]
fn in_continuous_mode_busy_always_reads_1() {
    for (rate, per_second, _) in RATES {
        let mut bench = Bench::new(Ads1100Config::default());
        bench.v = 1.0;
        bench.settle();
        bench.configure(rate << 2);
        let before = bench.chip.conversions();
        for _ in 0..40 {
            bench.wait(0.3 / per_second);
            assert_eq!(bench.read().1, 0x80 | rate << 2);
        }
        // 40 · 0.3 periods and 40 reads of 90 µs.
        let expected = 12.0 + 40.0 * 4.0 * BYTE_S * per_second;
        let counted = (bench.chip.conversions() - before) as f64;
        assert!((counted - expected).abs() <= 1.0, "{counted} {expected}");
    }
}

#[test]
fn bytes_after_the_third_are_ff_and_written_ones_after_the_first_are_refused() {
    let mut bench = Bench::new(Ads1100Config::default());
    assert!(bench.address(0x91));
    let bytes: Vec<u8> = (0..6).map(|_| bench.read_byte()).collect();
    assert_eq!(bytes[2..], [0x8C, 0xFF, 0xFF, 0xFF]);
    bench.stop();
    assert!(bench.address(0x90));
    assert!(bench.write_byte(0x84));
    assert!(!bench.write_byte(0x8C));
    bench.stop();
    assert_eq!(bench.read().1, 0x84);
    assert_eq!(bench.chip.violations().count(Violation::ExtraByte), 1);
    bench.configure(0xE4);
    assert_eq!(bench.read().1, 0x84);
    assert_eq!(bench.chip.violations().count(Violation::ReservedBits), 1);
}

#[test]
fn a_general_call_reset_is_a_power_up() {
    let mut bench = Bench::new(Ads1100Config::default());
    bench.v = 3.0;
    bench.configure(0x80);
    bench.wait(0.1);
    assert_ne!(bench.read(), (0, 0x8C));
    assert!(bench.address(0x00));
    assert!(bench.write_byte(0x06));
    bench.stop();
    // 0 as if that were 0 V.
    assert_eq!(bench.read(), (0, 0x8C));
    bench.wait(0.126);
    assert_ne!(bench.read().0, 0);
    assert!(bench.address(0x00));
    assert!(!bench.write_byte(0x04));
    assert_eq!(bench.chip.violations().count(Violation::GeneralCall), 1);
}

#[test]
fn a_brown_out_loses_the_rate() {
    let mut bench = Bench::new(Ads1100Config::default());
    bench.v = 3.0;
    bench.settle();
    bench.configure(0x84);
    bench.wait(0.1);
    assert_eq!(bench.read(), (4_915, 0x84));
    bench.chip.reset(bench.now_s + 0.05);
    bench.wait(0.04);
    assert_eq!(bench.read().1, 0x84);
    bench.wait(0.02);
    assert_eq!(bench.read(), (0, 0x8C));
    bench.wait(0.125);
    assert_eq!(bench.read(), (19_661, 0x8C));
}

#[test]
fn faults_are_seen_on_the_bus() {
    let mut bench = Bench::new(Ads1100Config::default());
    bench.v = 3.0;
    bench.wait(0.2);
    bench.chip.set_stuck_code(Some(-7));
    assert_eq!(bench.read().0, -7);
    bench.wait(1.0);
    assert_eq!(bench.read().0, -7);
    bench.chip.set_stuck_code(None);
    assert_eq!(bench.read().0, 19_661);
    bench.chip.set_absent(true);
    assert!(!bench.address(0x91));
    assert!(!bench.address(0x90));
    assert!(!bench.address(0x00));
    bench.chip.set_absent(false);
    assert_eq!(bench.read().0, 19_661);
}

#[test]
fn errors_are_as_configured() {
    let code = |config: Ads1100Config, v: f64| {
        let mut bench = Bench::new(config);
        bench.v = v;
        bench.convert(0x0C)
    };
    let nominal = Ads1100Config::default();
    assert_eq!(code(nominal, 2.5), 16_384);
    let offset = Ads1100Config {
        offset_v: 1.2e-3,
        ..nominal
    };
    assert_eq!(code(offset, 2.5), 16_384 + 8);
    let gain = Ads1100Config {
        gain: 1.001,
        ..nominal
    };
    assert_eq!(code(gain, 2.5), 16_384 + 16);
    // 0.0125 % of the full span are 8 of 65,536 codes, in the middle of it.
    let bowed = Ads1100Config {
        non_linearity: 1.25e-4,
        ..nominal
    };
    assert_eq!(code(bowed, 0.0), 8);
    assert_eq!(code(bowed, -5.0), -32_768);
    assert_eq!(code(bowed, 4.999), 32_761);
}

#[test]
fn noise_is_4_microvolts_peak_to_peak_and_repeatable() {
    // Gain 8 and a supply of 2.7 V make a code of 10 µV; 40 µV of noise are 4 codes.
    let codes = |seed: u64| {
        let mut bench = Bench::new(Ads1100Config {
            noise_pp_v: 40e-6,
            seed,
            ..Ads1100Config::default()
        });
        (bench.vdd, bench.v) = (2.7, 0.1);
        bench.settle();
        (0..400).map(|_| bench.convert(0x0F)).collect::<Vec<_>>()
    };
    let first = codes(1);
    assert_eq!(first, codes(1));
    assert_ne!(first, codes(2));
    let mean = first.iter().map(|code| f64::from(*code)).sum::<f64>() / 400.0;
    let square = |code: &i16| (f64::from(*code) - mean).powi(2);
    let deviation = (first.iter().map(square).sum::<f64>() / 400.0).sqrt();
    // 40 µV / 6.6 / 10.3 µV, and 1/√12 of a code for the rounding.
    let expected = (40.0 / 6.6 / 10.3f64).hypot(12f64.sqrt().recip());
    assert!(
        (deviation / expected - 1.0).abs() < 0.15,
        "{deviation} {expected}"
    );
    assert!((mean - 9_709.0).abs() < 0.5, "{mean}");
}

proptest! {
    #[test]
    fn a_conversion_is_the_mean_over_its_window(
        from_v in 0.0..5.0f64,
        to_v in 0.0..5.0f64,
        vdd in 4.5..5.5f64,
        cuts in prop::collection::vec(0.0..1.0f64, 0..30),
    ) {
        // The ramp begins a quarter of a window early and ends a quarter late.
        let mut bench = Bench::new(Ads1100Config::default());
        bench.vdd = vdd;
        bench.settle();
        bench.configure(SINGLE | 0x0C);
        let window_s = 0.125;
        let mut cuts = cuts;
        cuts.sort_by(f64::total_cmp);
        cuts.push(1.0);
        let ramp = Linear { start: from_v, end: to_v };
        let start_s = bench.now_s;
        let mut from = 0.0;
        for to in cuts {
            let end_s = start_s + to * 1.5 * window_s;
            bench.chip.advance(end_s, ramp.part(from, to), Linear::constant(vdd));
            from = to;
        }
        bench.now_s = start_s + 1.5 * window_s;
        let mean_v = ramp.part(0.0, 1.0 / 1.5).mean();
        let expected = (32_768.0 * mean_v / vdd).clamp(-32_768.0, 32_767.0);
        let (code, _) = bench.read();
        prop_assert!((f64::from(code) - expected).abs() <= 0.500_1, "{} {}", code, expected);
    }
}

// ---------------------------------------------------------------------------------------------------- real driver

/// The bench as an embedded-hal bus.
struct Hal(Rc<RefCell<Bench>>);

impl embedded_hal::i2c::ErrorType for Hal {
    type Error = ErrorKind;
}

impl embedded_hal::i2c::I2c for Hal {
    fn transaction(
        &mut self,
        address: u8,
        operations: &mut [Operation<'_>],
    ) -> Result<(), ErrorKind> {
        let mut bench = self.0.borrow_mut();
        for operation in operations {
            let read = matches!(operation, Operation::Read(_));
            if !bench.address(address << 1 | u8::from(read)) {
                bench.stop();
                return Err(ErrorKind::NoAcknowledge(NoAcknowledgeSource::Address));
            }
            match operation {
                Operation::Read(bytes) => {
                    bytes.iter_mut().for_each(|byte| *byte = bench.read_byte())
                }
                Operation::Write(bytes) => {
                    for byte in bytes.iter() {
                        if !bench.write_byte(*byte) {
                            bench.stop();
                            return Err(ErrorKind::NoAcknowledge(NoAcknowledgeSource::Data));
                        }
                    }
                }
            }
        }
        bench.stop();
        Ok(())
    }
}

#[test]
fn our_driver_reads_the_voltage_and_sees_a_reset() {
    use ads1100::{Address, Conversion, DataRate, Error, Gain, Settings};

    let bench = Rc::new(RefCell::new(Bench::new(Ads1100Config {
        suffix: 2,
        ..Ads1100Config::default()
    })));
    let settings = Settings {
        data_rate: DataRate::Sps32,
        gain: Gain::X1,
    };
    let mut driver = ads1100::Ads1100::new(Hal(bench.clone()), Address::A2, settings);
    let convert = |driver: &mut ads1100::Ads1100<Hal>, v: f64, longest_s: f64| {
        bench.borrow_mut().v = v;
        driver.start().unwrap();
        let started_s = bench.borrow().now_s;
        loop {
            match driver.poll() {
                Ok(Conversion::Busy) => bench.borrow_mut().wait(1e-3),
                Ok(other) => {
                    let took_s = bench.borrow().now_s - started_s;
                    assert!((0.031..longest_s).contains(&took_s), "{took_s}");
                    return Ok(other);
                }
                Err(error) => return Err(error),
            }
        }
    };
    // What power-up began ends first.
    assert_eq!(convert(&mut driver, 1.0, 0.126), Ok(Conversion::Discarded));
    for v in [0.25, 2.5, 4.75, 0.0] {
        let Ok(Conversion::Ready(sample)) = convert(&mut driver, v, 0.033) else {
            panic!("no sample");
        };
        let read_v = f64::from(sample.microvolts(5_000_000)) * 1e-6;
        assert!(
            (read_v - v).abs() <= 0.5 * 5.0 / 8_192.0 + 1e-6,
            "{read_v} {v}"
        );
    }
    driver.start().unwrap();
    {
        let mut bench = bench.borrow_mut();
        let now_s = bench.now_s;
        bench.chip.reset(now_s);
    }
    assert_eq!(
        driver.poll(),
        Err(Error::ConfigurationLost {
            expected: 0x94,
            read: 0x8C
        })
    );
    bench.borrow_mut().chip.set_absent(true);
    assert!(matches!(driver.start(), Err(Error::Bus { .. })));
    assert_eq!(bench.borrow().chip.violations().total(), 0);
}

/// What a master does to our driver.
#[derive(Clone, Copy, Debug)]
enum Act {
    Start,
    Poll,
    WaitMs(u32),
    Rate(ads1100::DataRate),
    Reset,
}

fn act() -> impl Strategy<Value = Act> {
    use ads1100::DataRate;
    prop_oneof![
        3 => Just(Act::Start),
        4 => Just(Act::Poll),
        4 => (1..90u32).prop_map(Act::WaitMs),
        1 => prop::sample::select(vec![DataRate::Sps128, DataRate::Sps32, DataRate::Sps8])
            .prop_map(Act::Rate),
        1 => Just(Act::Reset),
    ]
}

proptest! {
    /// The input rises all the time: what is delivered tells when it was converted.
    #[test]
    fn what_our_driver_delivers_was_converted_after_its_start_with_its_settings(
        restarts: bool,
        acts in prop::collection::vec(act(), 0..60),
    ) {
        use ads1100::{Address, Conversion, DataRate, Error, Gain, Settings};

        const RISE_V_PER_S: f64 = 0.5;
        let bench = Rc::new(RefCell::new(Bench::new(Ads1100Config {
            restarts,
            ..Ads1100Config::default()
        })));
        let mut settings = Settings { data_rate: DataRate::Sps32, gain: Gain::X1 };
        let mut driver = ads1100::Ads1100::new(Hal(bench.clone()), Address::A0, settings);
        let mut started_s = f64::NAN;
        let mut was_reset = false;
        for act in acts {
            match act {
                Act::Start => {
                    started_s = bench.borrow().now_s;
                    if let Err(error) = driver.start() {
                        let lost = matches!(error, Error::ConfigurationLost { .. });
                        prop_assert!(lost && was_reset, "{}", error);
                        driver.start().unwrap();
                    }
                    was_reset = false;
                }
                Act::Poll => {
                    if let Ok(Conversion::Ready(sample)) = driver.poll() {
                        let read_v = f64::from(sample.microvolts(5_000_000)) * 1e-6;
                        let step_v = 5.0 / f64::from(sample.settings.data_rate.max_code());
                        let between = (started_s * RISE_V_PER_S - step_v)
                            ..=(bench.borrow().now_s * RISE_V_PER_S + step_v);
                        prop_assert!(between.contains(&read_v), "{} V, {:?}", read_v, between);
                        prop_assert_eq!(sample.settings, settings);
                    }
                }
                Act::WaitMs(ms) => {
                    for _ in 0..ms {
                        let mut bench = bench.borrow_mut();
                        bench.v = bench.now_s * RISE_V_PER_S;
                        bench.wait(1e-3);
                    }
                }
                Act::Rate(data_rate) => {
                    settings.data_rate = data_rate;
                    driver.set_settings(settings);
                }
                Act::Reset => {
                    let mut bench = bench.borrow_mut();
                    let now_s = bench.now_s;
                    bench.chip.reset(now_s);
                    was_reset = true;
                }
            }
        }
    }

    /// Whatever ended the last conversion, a reset before the next start is told by it.
    #[test]
    fn our_driver_sees_a_reset_between_conversions(waits_ms in prop::collection::vec(0..200u32, 1..8)) {
        use ads1100::{Address, Conversion, DataRate, Error, Gain, Settings};

        let bench = Rc::new(RefCell::new(Bench::new(Ads1100Config::default())));
        let settings = Settings { data_rate: DataRate::Sps32, gain: Gain::X1 };
        let mut driver = ads1100::Ads1100::new(Hal(bench.clone()), Address::A0, settings);
        for wait_ms in waits_ms {
            driver.start().unwrap();
            bench.borrow_mut().wait(0.2);
            prop_assert!(matches!(driver.poll(), Ok(Conversion::Ready(_) | Conversion::Discarded)));
            bench.borrow_mut().wait(f64::from(wait_ms) * 1e-3);
            {
                let mut bench = bench.borrow_mut();
                let now_s = bench.now_s;
                bench.chip.reset(now_s);
            }
            let lost = Error::ConfigurationLost { expected: 0x94, read: 0x8C };
            prop_assert_eq!(driver.start(), Err(lost));
            prop_assert_eq!(driver.poll(), Err(Error::NotStarted));
        }
    }
}
