use super::*;
use crate::front_end::tests::{any_front_end, any_range, any_supply, any_valid};
use crate::front_end::{ClosedLoop, Hah1bv, Network, SupplyRelations};
use proptest::prelude::*;
use std::vec::Vec;

const CONFIG: ConverterConfig = ConverterConfig {
    data_rate: DataRate::Sps32,
    gain: Gain::X1,
    supply_mode: SupplyMode::Ratiometric,
    reference: design::CONVERTER_NOMINAL_SUPPLY,
    settling_us: 5_000,
    adc1_period_us: 10_000,
    stale_after_periods: 3,
    saturation_margin: Microvolts::from_millivolts(5),
    max_amps_per_second: 1_000,
    step_confirmations: 1,
    stuck_count: 8,
    stuck_movement: PerRange {
        small: Microamps::from_amps(1),
        large: Microamps::from_amps(10),
    },
};
const FIVE: Microvolts = Microvolts::from_millivolts(5_000);

fn hah1bv() -> FrontEnd {
    FrontEnd::Hah1bv(Hah1bv::default())
}

fn prepare(config: &ConverterConfig, front_end: FrontEnd) -> ConverterCoefficients {
    ConverterCoefficients::prepare(config, &front_end, &Corrections::default(), None)
}

fn at(us: u64) -> Instant {
    Instant::from_ticks(us)
}

pub(crate) fn any_validity() -> impl Strategy<Value = Validity> {
    prop_oneof![
        3 => Just(Validity::VALID),
        1 => any::<u8>().prop_map(Validity::from_bits)
    ]
}

/// A channel that is fed one sample per period.
struct Bench {
    config: ConverterConfig,
    coefficients: ConverterCoefficients,
    converter: Converter,
    now: u64,
    context: SampleContext,
}

impl Bench {
    fn new(config: ConverterConfig, front_end: FrontEnd) -> Self {
        Self {
            config,
            coefficients: prepare(&config, front_end),
            converter: Converter::new(),
            now: 0,
            context: SampleContext::default(),
        }
    }

    fn sample(&mut self, configuration: u8, code: i16) -> CurrentReading {
        let period = self.config.data_rate.period().as_ticks();
        let started = self.now;
        self.now += period;
        let sample = ConverterSample {
            started: at(started),
            finished: at(self.now),
            configuration,
            code,
        };
        let context = SampleContext {
            meter_mean_begun: at(self.now - self.now.min(100_000)),
            ..self.context
        };
        self.converter
            .on_sample(&self.config, &self.coefficients, &sample, &context)
            .unwrap()
    }

    fn code(&mut self, code: i16) -> CurrentReading {
        self.sample(self.config.expected_configuration(), code)
    }

    /// The nearest code of the HAH1BV at 14 bits.
    fn amps(&mut self, amps: f64) -> CurrentReading {
        self.code(code_of(amps))
    }
}

fn code_of(amps: f64) -> i16 {
    ((2.5 + amps / 250.0) / 5.0 * 8_192.0).round() as i16
}

const RATES: [DataRate; 4] = [
    DataRate::Sps8,
    DataRate::Sps16,
    DataRate::Sps32,
    DataRate::Sps128,
];

#[test]
fn data_rate_is_resolution() {
    let config = |data_rate| ConverterConfig {
        data_rate,
        ..CONFIG
    };
    let steps = RATES.map(|rate| prepare(&config(rate), hah1bv()).step(Range::Small).get());
    assert_eq!(steps, [38_147, 76_294, 152_588, 610_352]);
    assert_eq!(RATES.map(DataRate::bits), [16, 15, 14, 12]);
    assert_eq!(RATES.map(DataRate::samples_per_second), [8, 16, 32, 128]);
    for rate in RATES {
        let exact = 1_000_000.0 / f64::from(rate.samples_per_second());
        assert!((rate.period().as_ticks() as f64 - exact).abs() <= 0.5);
    }
    assert_eq!(
        RATES.map(|rate| config(rate).expected_configuration()),
        [0x1C, 0x18, 0x14, 0x10]
    );
    let gains = [Gain::X1, Gain::X2, Gain::X4, Gain::X8];
    assert_eq!(
        gains.map(|gain| ConverterConfig { gain, ..CONFIG }.expected_configuration()),
        [0x14, 0x15, 0x16, 0x17]
    );
}

#[test]
fn codes_of_the_documents() {
    // Code 16384 of 16 bits is 2.5 V.
    let config = ConverterConfig {
        data_rate: DataRate::Sps8,
        ..CONFIG
    };
    let d2 = prepare(&config, hah1bv());
    assert_eq!(d2.current(16_384, Range::Small), Microamps::ZERO);
    assert_eq!(d2.volts(16_384, Range::Small), Microvolts(2_500_000));
    // A reset chip's 0 would read −625 A: the reason for looking at the configuration byte.
    assert_eq!(d2.current(0, Range::Small), Microamps::from_amps(-625));
    let d0 = prepare(&config, FrontEnd::default());
    // 4.5625 V is code 29900.8; 4.5 V is 29491.2.
    assert_eq!(d0.current(29_901, Range::Small), Microamps(55_000_814));
    assert_eq!(d0.current(29_901, Range::Large), Microamps(550_008_138));
    assert_eq!(d0.step(Range::Small), Microamps(4_069));
    assert_eq!(d0.step(Range::Large), Microamps(40_690));
    assert_eq!(d0.channel(), Channel::Ads1100);
    assert!(!d0.supply_fault());
    // Codes beyond the data rate's are held at its end.
    assert_eq!(
        prepare(&CONFIG, hah1bv()).current(20_000, Range::Small),
        Microamps::from_amps(625)
    );
    assert_eq!(
        prepare(&CONFIG, hah1bv()).volts(-20_000, Range::Small),
        Microvolts(-5_000_000)
    );
    let x4 = ConverterConfig {
        gain: Gain::X4,
        ..CONFIG
    };
    assert_eq!(
        prepare(&x4, hah1bv()).volts(4_096, Range::Small),
        Microvolts(625_000)
    );
}

#[test]
fn network_on_adc1_counts_microvolts() {
    let d3 = prepare(&CONFIG, FrontEnd::Network(Network::default()));
    assert_eq!(d3.channel(), Channel::Adc1);
    assert_eq!(
        d3.current(2_550_000, Range::Small),
        Microamps::from_amps(500)
    );
    assert_eq!(d3.current(1_650_000, Range::Small), Microamps::ZERO);
    assert_eq!(d3.volts(1_650_001, Range::Small), Microvolts(1_650_001));
    assert_eq!(d3.step(Range::Large), Microamps(556));
    assert_eq!(d3.volts(i32::MAX, Range::Small), Microvolts(1 << 22));
    assert_eq!(d3.volts(i32::MIN, Range::Small), Microvolts(-(1 << 22)));
}

#[test]
fn corrections_are_applied_in_their_order() {
    let corrections = Corrections {
        key_factors: PerRange {
            small: KeyFactors {
                k_ppb: 1_010_000_000,
                a: Microvolts(10_000),
            },
            large: KeyFactors::NONE,
        },
        gain: PerRange {
            small: Ppm(20_000),
            large: Ppm(-1_000),
        },
        zero_drift: PerRange {
            small: Microamps(1_500_000),
            large: Microamps(-500_000),
        },
    };
    let d2 = ConverterCoefficients::prepare(&CONFIG, &hah1bv(), &corrections, None);
    // Code 4505 of 14 bits is 2.749_633_789 V.
    let volts = 5.0 * 4_505.0 / 8_192.0;
    let small = (1.01 * (volts + 0.01) - 2.5) * 250.0 * 1.02 - 1.5;
    let large = (volts - 2.5) * 250.0 * 0.999 + 0.5;
    let got = |range| f64::from(d2.current(4_505, range).get());
    assert!((got(Range::Small) - small * 1e6).abs() <= 0.51);
    assert!((got(Range::Large) - large * 1e6).abs() <= 0.51);
    // The reading's signal is the one before the factors.
    assert_eq!(d2.volts(4_505, Range::Small), Microvolts(2_749_634));
}

#[test]
fn supply_is_asked_for_where_it_is_needed() {
    let d4 = FrontEnd::ClosedLoop(ClosedLoop::default());
    let d3 = FrontEnd::Network(Network::default());
    let fault = |front_end, supply_mode, supply| {
        let config = ConverterConfig {
            supply_mode,
            ..CONFIG
        };
        ConverterCoefficients::prepare(&config, &front_end, &Corrections::default(), supply)
            .supply_fault()
    };
    for mode in [
        SupplyMode::Ratiometric,
        SupplyMode::Measured,
        SupplyMode::Fixed,
    ] {
        let needed = mode == SupplyMode::Measured;
        assert_eq!(fault(hah1bv(), mode, None), needed);
        assert_eq!(fault(FrontEnd::default(), mode, None), needed);
        assert_eq!(fault(d4, mode, None), mode != SupplyMode::Fixed);
        assert!(!fault(d3, mode, None));
        for (volts, beyond) in [
            (4_499_999, true),
            (4_500_000, false),
            (5_500_000, false),
            (5_500_001, true),
        ] {
            assert_eq!(fault(hah1bv(), mode, Some(Microvolts(volts))), beyond);
            assert_eq!(fault(d4, mode, Some(Microvolts(volts))), beyond);
            assert!(!fault(d3, mode, Some(Microvolts(volts))));
        }
    }
}

#[test]
fn supply_fault_marks_every_reading_and_keeps_the_current() {
    let config = ConverterConfig {
        supply_mode: SupplyMode::Measured,
        ..CONFIG
    };
    let mut bench = Bench::new(config, hah1bv());
    let reading = bench.amps(100.0);
    assert_eq!(reading.validity, Validity::SUPPLY);
    assert!((reading.current.get() - 100_000_000).abs() < 153_000);
    // Beyond the limits the nearer one is used.
    let prepare_at = |volts| {
        ConverterCoefficients::prepare(
            &config,
            &hah1bv(),
            &Corrections::default(),
            Some(Microvolts(volts)),
        )
    };
    assert_eq!(
        prepare_at(6_000_000).current(4_700, Range::Small),
        prepare_at(5_500_000).current(4_700, Range::Small)
    );
    assert_ne!(
        prepare_at(5_400_000).current(4_700, Range::Small),
        prepare_at(5_500_000).current(4_700, Range::Small)
    );
}

#[test]
fn another_configuration_byte_is_a_chip_fault_and_not_a_current() {
    let mut bench = Bench::new(CONFIG, hah1bv());
    let good = bench.amps(50.0);
    assert!(good.validity.is_valid());
    assert_eq!(good.at, at(31_250));
    for configuration in [0x8C, 0x94, 0x15, 0x34] {
        let fault = bench.sample(configuration, 0);
        assert_eq!(fault.validity, Validity::CHIP_FAULT);
        assert_eq!(fault.current, good.current);
        assert_eq!(fault.volts, good.volts);
        assert_eq!(fault.at, at(bench.now));
    }
    assert_eq!(bench.sample(0x14, 8_192).validity, Validity::CHIP_FAULT);
    assert_eq!(bench.sample(0x14, -8_193).validity, Validity::CHIP_FAULT);
    assert_eq!(bench.converter.counters().chip_faults, 6);
    assert_eq!(bench.converter.counters().samples, 1);
    // Meanwhile the current has become old as well.
    let now = at(bench.now);
    let expected = Validity::CHIP_FAULT.and(Validity::STALE);
    assert_eq!(
        bench.converter.reading(&bench.coefficients, now).validity,
        expected
    );
    assert!(bench.amps(50.0).validity.is_valid());
}

#[test]
fn a_fault_before_the_first_sample_is_stale_too() {
    let mut converter = Converter::default();
    let reading = converter.on_fault(at(7));
    assert_eq!(reading.validity, Validity::CHIP_FAULT.and(Validity::STALE));
    assert_eq!(reading.at, at(7));
    let mut bench = Bench::new(CONFIG, hah1bv());
    bench.amps(1.0);
    assert_eq!(
        bench.converter.on_fault(at(40_000)).validity,
        Validity::CHIP_FAULT
    );
    assert_eq!(bench.converter.counters().chip_faults, 1);
}

#[test]
fn duplicates_are_dropped_and_counted() {
    let mut bench = Bench::new(CONFIG, hah1bv());
    bench.amps(10.0);
    bench.amps(20.0);
    let before = bench.converter.reading(&bench.coefficients, at(bench.now));
    for started in [31_250, 31_249, 0] {
        let sample = ConverterSample {
            started: at(started),
            finished: at(70_000),
            configuration: 0x14,
            code: 0,
        };
        let result =
            bench
                .converter
                .on_sample(&CONFIG, &bench.coefficients, &sample, &bench.context);
        assert_eq!(result, None);
    }
    assert_eq!(bench.converter.counters().duplicates, 3);
    assert_eq!(bench.converter.counters().samples, 2);
    assert_eq!(
        bench.converter.reading(&bench.coefficients, at(bench.now)),
        before
    );
}

#[test]
fn each_front_end_listens_to_its_own_converter() {
    let sample = ConverterSample {
        started: at(1),
        finished: at(2),
        configuration: 0x14,
        code: 4_096,
    };
    let adc1 = Adc1Sample {
        started: at(1),
        finished: at(2),
        volts: Microvolts(1_650_000),
    };
    let context = SampleContext::default();
    let (d2, d3) = (
        prepare(&CONFIG, hah1bv()),
        prepare(&CONFIG, FrontEnd::Network(Network::default())),
    );
    let mut converter = Converter::new();
    assert_eq!(converter.on_sample(&CONFIG, &d3, &sample, &context), None);
    assert_eq!(
        converter.on_adc1_sample(&CONFIG, &d2, &adc1, &context),
        None
    );
    assert_eq!(converter.counters().duplicates, 0);
    let reading = converter
        .on_adc1_sample(&CONFIG, &d3, &adc1, &context)
        .unwrap();
    assert_eq!(
        (reading.current, reading.validity),
        (Microamps::ZERO, Validity::VALID)
    );
    assert_eq!(reading.volts, Microvolts(1_650_000));
    assert_eq!(
        converter.on_adc1_sample(&CONFIG, &d3, &adc1, &context),
        None
    );
    assert_eq!(converter.counters().duplicates, 1);
}

#[test]
fn adc1_is_saturated_at_its_clamps_and_at_the_ends_of_the_range() {
    let d3 = prepare(&CONFIG, FrontEnd::Network(Network::default()));
    let saturated = |volts| {
        let sample = Adc1Sample {
            started: at(1),
            finished: at(2),
            volts: Microvolts(volts),
        };
        Converter::new()
            .on_adc1_sample(&CONFIG, &d3, &sample, &SampleContext::default())
            .unwrap()
            .validity
            .contains(Validity::SATURATED)
    };
    assert!(!saturated(755_001) && saturated(755_000));
    assert!(!saturated(2_544_999) && saturated(2_545_000));
    // The clamps alone, for a range that reaches beyond them.
    let wide = FrontEnd::Network(Network {
        full_scale: Microamps::from_amps(2_000),
        ..Network::default()
    });
    let wide = prepare(&CONFIG, wide);
    for (volts, expected) in [(0, true), (1, false), (3_299_999, false), (3_300_000, true)] {
        let sample = Adc1Sample {
            started: at(1),
            finished: at(2),
            volts: Microvolts(volts),
        };
        let reading =
            Converter::new().on_adc1_sample(&CONFIG, &wide, &sample, &SampleContext::default());
        assert_eq!(
            reading.unwrap().validity.contains(Validity::SATURATED),
            expected,
            "{volts}"
        );
    }
}

#[test]
fn the_end_of_the_range_is_saturated() {
    // 16 bits, so that a code is 152.6 µV.
    let config = ConverterConfig {
        data_rate: DataRate::Sps8,
        ..CONFIG
    };
    let code = |volts: f64| (volts / 5.0 * 32_768.0).floor() as i16;
    let saturated = |front_end, code| {
        Bench::new(config, front_end)
            .code(code)
            .validity
            .contains(Validity::SATURATED)
    };
    // 4.745 V and 0.255 V with the margin of 5 mV.
    let d0 = FrontEnd::default();
    assert!(saturated(d0, code(4.745) + 1) && !saturated(d0, code(4.745)));
    assert!(saturated(d0, code(0.255)) && !saturated(d0, code(0.255) + 1));
    assert!(saturated(hah1bv(), code(4.495) + 1) && !saturated(hah1bv(), code(4.495)));
    // The current is still told.
    let reading = Bench::new(config, d0).code(code(4.9));
    assert_eq!(reading.validity, Validity::SATURATED);
    assert!(reading.current > Microamps::from_amps(63));
    // The converter's own ends, for a sensor whose range reaches beyond them.
    let wide = FrontEnd::Hah1bv(Hah1bv {
        full_scale: Microamps::from_amps(2_000),
        ..Hah1bv::default()
    });
    assert!(saturated(wide, i16::MAX) && !saturated(wide, i16::MAX - 1));
    assert!(saturated(wide, i16::MIN) && !saturated(wide, i16::MIN + 1));
}

#[test]
fn stale_after_three_periods() {
    let mut bench = Bench::new(CONFIG, hah1bv());
    let stale = |bench: &Bench, now| {
        bench
            .converter
            .reading(&bench.coefficients, at(now))
            .validity
            .contains(Validity::STALE)
    };
    assert!(stale(&bench, 0));
    let reading = bench.amps(5.0);
    assert!(!stale(&bench, 31_250 + 93_750));
    assert!(stale(&bench, 31_250 + 93_751));
    let old = bench.converter.reading(&bench.coefficients, at(10_000_000));
    assert_eq!((old.current, old.at), (reading.current, reading.at));
    bench.amps(5.0);
    assert!(!stale(&bench, 62_500));
    let d3 = prepare(&CONFIG, FrontEnd::Network(Network::default()));
    assert_eq!(d3.stale_after.as_ticks(), 30_000);
    assert_eq!(CONFIG.settling().as_ticks(), 5_000);
}

#[test]
fn a_conversion_over_an_edge_is_marked_and_is_no_witness() {
    let mut bench = Bench::new(CONFIG, hah1bv());
    bench.amps(0.0);
    bench.context.spoiled_by_edge = true;
    let spoiled = bench.amps(400.0);
    assert_eq!(spoiled.validity, Validity::RANGE_CHANGE);
    assert!((spoiled.current.get() - 400_000_000).abs() < 153_000);
    bench.context.spoiled_by_edge = false;
    assert!(bench.amps(0.0).validity.is_valid());
    assert_eq!(bench.converter.counters().steps_refused, 0);
}

#[test]
fn range_of_the_sample_is_the_range_of_the_reading() {
    let mut bench = Bench::new(CONFIG, FrontEnd::default());
    assert_eq!(bench.code(4_200).range, Range::Small);
    bench.context.range = Range::Large;
    let large = bench.code(4_200);
    assert_eq!(large.range, Range::Large);
    assert_eq!(
        large.current,
        bench.coefficients.current(4_200, Range::Large)
    );
}

#[test]
fn a_glitch_costs_one_sample_and_a_step_one_more() {
    // 1,000 A/s over 31.25 ms is 31.25 A.
    let mut bench = Bench::new(CONFIG, hah1bv());
    assert!(bench.amps(0.0).validity.is_valid());
    assert!(bench.amps(31.0).validity.is_valid());
    let glitch = bench.amps(-200.0);
    assert_eq!(glitch.validity, Validity::IMPLAUSIBLE);
    assert!((glitch.current.get() + 200_000_000).abs() < 153_000);
    assert!(bench.amps(31.0).validity.is_valid());
    assert_eq!(bench.amps(300.0).validity, Validity::IMPLAUSIBLE);
    assert!(bench.amps(300.0).validity.is_valid());
    assert!(bench.amps(290.0).validity.is_valid());
    assert_eq!(bench.converter.counters().steps_refused, 2);
}

#[test]
fn a_step_is_confirmed_by_readings_that_agree() {
    let config = ConverterConfig {
        step_confirmations: 2,
        ..CONFIG
    };
    let mut bench = Bench::new(config, hah1bv());
    let valid: Vec<bool> = [0.0, 300.0, -300.0, 200.0, 210.0, 220.0, 225.0]
        .into_iter()
        .map(|amps| bench.amps(amps).validity.is_valid())
        .collect();
    // 5 periods after 0 A, 156 A are permitted: 200 A is not, until it is confirmed twice.
    assert_eq!(valid, [true, false, false, false, false, true, true]);
    // A refused reading is forgotten once another was accepted.
    assert!(!bench.amps(-200.0).validity.is_valid());
    assert!(bench.amps(225.0).validity.is_valid());
    assert!(!bench.amps(-200.0).validity.is_valid());
    let none = ConverterConfig {
        step_confirmations: 0,
        ..CONFIG
    };
    let mut bench = Bench::new(none, hah1bv());
    assert!(bench.amps(0.0).validity.is_valid() && bench.amps(400.0).validity.is_valid());
}

#[test]
fn the_permitted_step_grows_with_time_and_can_be_switched_off() {
    let mut bench = Bench::new(CONFIG, hah1bv());
    bench.amps(0.0);
    bench.now += 9 * 31_250;
    // 312.5 A in ten periods, and two codes of 153 mA.
    assert!(bench.amps(312.0).validity.is_valid());
    let off = ConverterConfig {
        max_amps_per_second: 0,
        ..CONFIG
    };
    let mut bench = Bench::new(off, hah1bv());
    assert!(bench.amps(-490.0).validity.is_valid() && bench.amps(490.0).validity.is_valid());
}

#[test]
fn the_rate_limit_is_exact() {
    let from = Level {
        current: Microamps(100),
        at: at(1_000),
    };
    let to = |current, us| Level {
        current: Microamps(current),
        at: at(us),
    };
    let within = |to| is_within_rate(1_000, Microamps(7), from, to);
    // 1,000 A/s · 5 µs = 5 mA = 5,000 µA.
    assert!(within(to(100 + 5_007, 1_005)) && !within(to(100 + 5_008, 1_005)));
    assert!(within(to(100 - 5_007, 1_005)) && !within(to(100 - 5_008, 1_005)));
    assert!(within(to(107, 0)) && !within(to(108, 0)));
    assert!(within(to(i32::MIN, u64::MAX)));
    // Two steps of the input are always within the limit.
    let slow = ConverterConfig {
        max_amps_per_second: 1,
        ..CONFIG
    };
    let mut bench = Bench::new(slow, hah1bv());
    bench.code(4_096);
    assert!(bench.code(4_098).validity.is_valid());
    assert!(!bench.code(4_101).validity.is_valid());
}

#[test]
fn a_conversion_is_asked_for_three_times_at_most_once_its_time_is_known() {
    // 0.70 to 1.23 of the nominal time (184 and 104 of 128 SPS), drifting by 1 ms over 50 conversions.
    for (rate, nominal_ms) in [
        (DataRate::Sps32, 31.25),
        (DataRate::Sps128, 7.8125),
        (DataRate::Sps8, 125.0),
    ] {
        for share in [0.7, 0.9, 1.0, 1.1, 1.23] {
            let mut pace = PollPace::default();
            for turn in 0..50 {
                let length = nominal_ms * share + f64::from(turn) / 50.0;
                let first = pace.first_ms(rate);
                let mut at = first;
                while f64::from(at) < length {
                    at += 1;
                }
                assert!(at <= PollPace::limit_ms(rate), "{rate:?} {share}");
                let questions = at - first + 1;
                assert!(
                    turn == 0 || questions <= 3,
                    "{rate:?} {share} {turn}: {questions}"
                );
                // Never found later than a millisecond after its end, but where it ends before anybody would ask.
                assert!(
                    f64::from(at) < length + 1.0 || turn == 0 || questions == 1,
                    "{rate:?} {share} {turn}: {at} {length}"
                );
                pace.ended(at);
            }
        }
    }
    let mut pace = PollPace::default();
    pace.first_ms(DataRate::Sps32);
    pace.ended(40);
    assert_eq!(pace.first_ms(DataRate::Sps32), 40);
    // Another rate, and a conversion that never ended, begin anew.
    assert_eq!(pace.first_ms(DataRate::Sps128), 4);
    pace.unknown();
    assert_eq!(pace.first_ms(DataRate::Sps32), 20);
}

#[test]
fn no_conversion_of_the_chip_ends_before_it_is_asked_for() {
    for (rate, slowest_hz, fastest_hz) in [
        (DataRate::Sps128, 104.0, 184.0),
        (DataRate::Sps32, 26.0, 46.0),
        (DataRate::Sps16, 13.0, 23.0),
        (DataRate::Sps8, 6.5, 11.5),
    ] {
        let first_ms = PollPace::default().first_ms(rate);
        assert!(
            f64::from(first_ms) <= 1e3 / fastest_hz,
            "{rate:?}: {first_ms} ms"
        );
        let limit_ms = PollPace::limit_ms(rate);
        assert!(
            f64::from(limit_ms) >= 1e3 / slowest_hz + 1.0,
            "{rate:?}: {limit_ms} ms"
        );
    }
}

#[test]
fn stuck_needs_a_run_and_a_meter_that_moves() {
    let run = |meter: &dyn Fn(u32) -> Option<Microamps>| {
        let mut bench = Bench::new(CONFIG, hah1bv());
        (0..40).position(|index| {
            bench.context.meter_mean = meter(index);
            bench.amps(20.0).validity == Validity::IMPLAUSIBLE
        })
    };
    // At rest, without a meter, or with a meter that moves by no more than the limit, repeats are legal.
    assert_eq!(run(&|_| Some(Microamps::from_amps(20))), None);
    assert_eq!(run(&|_| None), None);
    assert_eq!(
        run(&|index| Some(Microamps(1_000_000 * (index as i32 & 1)))),
        None
    );
    // The eighth identical code with a meter that moves by more, up or down.
    assert_eq!(
        run(&|index| Some(Microamps(1_000_001 * (index as i32 & 1)))),
        Some(7)
    );
    assert_eq!(
        run(&|index| Some(Microamps(-500_000 * index as i32))),
        Some(7)
    );
    // A mean over the last 100 ms reaches back before the run at samples 0 to 3.
    assert_eq!(
        run(&|index| Some(Microamps::from_amps(if index < 4 { 50 } else { 20 }))),
        None
    );
    assert_eq!(
        run(&|index| Some(Microamps::from_amps(if index < 5 { 50 } else { 20 }))),
        Some(7)
    );
    // A movement late in the run counts as well.
    assert_eq!(
        run(&|index| Some(Microamps::from_amps(if index < 30 { 50 } else { 20 }))),
        Some(30)
    );
}

#[test]
fn a_mean_counts_that_began_no_earlier_than_the_first_of_the_codes() {
    for (second, third, expected) in [(99_999, 200_000, false), (100_000, 200_000, true)] {
        let config = ConverterConfig {
            stuck_count: 3,
            ..CONFIG
        };
        let mut converter = Converter::new();
        let mut step = |us: u64, amps| {
            let context = SampleContext {
                meter_mean: Some(Microamps::from_amps(amps)),
                meter_mean_begun: at(us - us.min(100_000)),
                ..SampleContext::default()
            };
            converter.is_stuck(&config, 4_096, at(us), &context)
        };
        assert!(!step(1_000_000, 90));
        assert!(!step(1_000_000 + second, 50));
        assert_eq!(step(1_000_000 + third, 20), expected);
    }
}

#[test]
fn stuck_ends_with_another_code_or_another_range() {
    let mut bench = Bench::new(CONFIG, FrontEnd::default());
    let moving = |bench: &mut Bench, code, count: i32| {
        (0..count)
            .filter(|index| {
                bench.context.meter_mean = Some(Microamps::from_amps(*index * 20));
                bench.code(code).validity.contains(Validity::IMPLAUSIBLE)
            })
            .count()
    };
    assert_eq!(moving(&mut bench, 4_200, 10), 3);
    assert!(bench.code(4_201).validity.is_valid());
    assert_eq!(moving(&mut bench, 4_201, 6), 0);
    bench.context.range = Range::Large;
    assert_eq!(moving(&mut bench, 4_201, 7), 0);
    assert_eq!(moving(&mut bench, 4_201, 1), 1);
    // In the large range a movement of ten amperes is not enough.
    let mut bench = Bench::new(CONFIG, FrontEnd::default());
    bench.context.range = Range::Large;
    let mut invalid = 0;
    for index in 0..20 {
        bench.context.meter_mean = Some(Microamps::from_amps(10 * (index & 1)));
        invalid += i32::from(!bench.code(4_300).validity.is_valid());
    }
    assert_eq!(invalid, 0);
}

#[test]
fn defaults_are_valid_and_each_limit_is_named() {
    use ConverterConfigError as Error;
    let default = ConverterConfig::default();
    assert_eq!(default.validate(), Ok(()));
    assert_eq!(default.data_rate, DataRate::Sps32);
    assert_eq!(default.stale_after_periods, 3);
    type Change<'a> = &'a dyn Fn(&mut ConverterConfig);
    let cases: [(Change<'_>, Result<(), Error>); 24] = [
        (&|c| c.gain = Gain::X2, Err(Error::Gain)),
        (
            &|c| c.reference = Microvolts(2_699_999),
            Err(Error::Reference),
        ),
        (&|c| c.reference = Microvolts(2_700_000), Ok(())),
        (
            &|c| c.reference = Microvolts(5_500_001),
            Err(Error::Reference),
        ),
        (&|c| c.settling_us = 1_000_000, Ok(())),
        (&|c| c.settling_us = 1_000_001, Err(Error::Settling)),
        (&|c| c.adc1_period_us = 99, Err(Error::Adc1Period)),
        (&|c| c.adc1_period_us = 100, Ok(())),
        (&|c| c.adc1_period_us = 1_000_001, Err(Error::Adc1Period)),
        (&|c| c.stale_after_periods = 1, Err(Error::StaleAfter)),
        (&|c| c.stale_after_periods = 2, Ok(())),
        (&|c| c.stale_after_periods = 51, Err(Error::StaleAfter)),
        (
            &|c| c.saturation_margin = Microvolts(-1),
            Err(Error::SaturationMargin),
        ),
        (&|c| c.saturation_margin = Microvolts(0), Ok(())),
        (
            &|c| c.saturation_margin = Microvolts(100_001),
            Err(Error::SaturationMargin),
        ),
        (&|c| c.step_confirmations = 10, Ok(())),
        (
            &|c| c.step_confirmations = 11,
            Err(Error::StepConfirmations),
        ),
        (&|c| c.stuck_count = 7, Err(Error::StuckCount)),
        (&|c| c.stuck_count = 8, Ok(())),
        (
            &|c| c.stuck_movement.small = Microamps(0),
            Err(Error::StuckMovement),
        ),
        (
            &|c| c.stuck_movement.large = Microamps(0),
            Err(Error::StuckMovement),
        ),
        (&|c| c.stuck_movement.large = Microamps(1), Ok(())),
        (&|c| c.stuck_movement.small = Microamps(1), Ok(())),
        (&|c| c.max_amps_per_second = 0, Ok(())),
    ];
    for (index, (change, expected)) in cases.into_iter().enumerate() {
        let mut config = default;
        change(&mut config);
        assert_eq!(config.validate(), expected, "case {index}");
    }
}

fn any_rate() -> impl Strategy<Value = DataRate> {
    (0..4_usize).prop_map(|index| *RATES.get(index).unwrap())
}

fn any_mode() -> impl Strategy<Value = SupplyMode> {
    prop_oneof![
        Just(SupplyMode::Ratiometric),
        Just(SupplyMode::Measured),
        Just(SupplyMode::Fixed)
    ]
}

fn any_corrections() -> impl Strategy<Value = Corrections> {
    let key = (900_000_000..1_100_000_000, -100_000..100_000).prop_map(|(k_ppb, a)| KeyFactors {
        k_ppb,
        a: Microvolts(a),
    });
    (key, -50_000..50_000, -20_000_000..20_000_000).prop_map(|(key, gain, zero)| Corrections {
        key_factors: PerRange::both(key),
        gain: PerRange::both(Ppm(gain)),
        zero_drift: PerRange::both(Microamps(zero)),
    })
}

/// The chain of the module's description, step by step.
fn chain(
    config: &ConverterConfig,
    front_end: &FrontEnd,
    corrections: &Corrections,
    supply: Microvolts,
    range: Range,
    input: i32,
) -> f64 {
    let vc = f64::from(supply.get()) * 1e-6;
    let closed_loop = matches!(front_end, FrontEnd::ClosedLoop(_));
    let volts = if front_end.channel() == Channel::Adc1 {
        f64::from(input) * 1e-6
    } else {
        let own = f64::from(config.reference.get()) * 1e-6;
        let share = f64::from(input) / 2f64.powi(config.data_rate.bits() as i32 - 1);
        match config.supply_mode {
            SupplyMode::Ratiometric => share * if closed_loop { vc } else { 5.0 },
            SupplyMode::Measured => share * own * if closed_loop { 1.0 } else { 5.0 / vc },
            SupplyMode::Fixed => share * own,
        }
    };
    let key = corrections.key_factors.get(range);
    let signal = f64::from(key.k_ppb) * 1e-9 * (volts + f64::from(key.a.get()) * 1e-6);
    let line_supply = if config.supply_mode == SupplyMode::Fixed {
        FIVE
    } else {
        supply
    };
    let line = front_end.line(range, line_supply);
    let current = (signal * 1e9 - line.zero_nanovolts as f64) * line.numerator as f64
        / line.denominator as f64;
    current * (1.0 + f64::from(corrections.gain.get(range).get()) * 1e-6)
        - f64::from(corrections.zero_drift.get(range).get())
}

proptest! {
    #[test]
    fn folded_coefficients_agree_with_the_chain(
        front_end in any_valid(), rate in any_rate(), supply_mode in any_mode(), corrections in any_corrections(),
        range in any_range(), supply in any_supply(), reference in 4_500_000..5_500_000, share in 0.0..1.0_f64
    ) {
        let config = ConverterConfig {
            data_rate: rate, supply_mode, reference: Microvolts(reference), ..CONFIG
        };
        let coefficients = ConverterCoefficients::prepare(&config, &front_end, &corrections, Some(supply));
        let input = match front_end.channel() {
            Channel::Adc1 => (share * 3_300_000.0) as i32,
            Channel::Ads1100 => (share * f64::from(coefficients.code_limit)) as i32,
        };
        let exact = chain(&config, &front_end, &corrections, supply, range, input)
            .clamp(f64::from(i32::MIN), f64::from(i32::MAX));
        let got = f64::from(coefficients.current(input, range).get());
        prop_assert!((got - exact).abs() <= 0.51, "{} {}", got, exact);
    }

    #[test]
    fn more_code_is_more_current(
        front_end in any_valid(), rate in any_rate(), range in any_range(), corrections in any_corrections(),
        code: i16, more in 1..1_000
    ) {
        let config = ConverterConfig { data_rate: rate, ..CONFIG };
        let coefficients = ConverterCoefficients::prepare(&config, &front_end, &corrections, None);
        let code = i32::from(code);
        prop_assert!(coefficients.current(code, range) <= coefficients.current(code + more, range));
        prop_assert!(coefficients.volts(code, range) <= coefficients.volts(code + more, range));
    }

    #[test]
    fn both_signs_are_treated_alike(rate in any_rate(), range in any_range(), distance in 0..16_384_i32) {
        for front_end in [FrontEnd::default(), hah1bv()] {
            let config = ConverterConfig { data_rate: rate, ..CONFIG };
            let coefficients = prepare(&config, front_end);
            let zero = coefficients.code_limit / 2;
            let distance = distance.min(zero);
            let up = coefficients.current(zero + distance, range).get();
            let down = coefficients.current(zero - distance, range).get();
            // Halves are rounded upward; all else is symmetric.
            prop_assert!((up + down).abs() <= 1);
        }
    }

    /// A ratiometric sensor, supplied with 4.5 … 5.5 V: the error stays below one code and 0.1 % (F15).
    #[test]
    fn supply_cancels_or_is_compensated(supply in any_supply(), amps in -450.0..450.0_f64) {
        let vc = f64::from(supply.get()) * 1e-6;
        let signal = vc / 5.0 * (2.5 + amps / 250.0);
        for (supply_mode, reference) in [(SupplyMode::Ratiometric, vc), (SupplyMode::Measured, 5.0)] {
            let config = ConverterConfig { supply_mode, data_rate: DataRate::Sps8, ..CONFIG };
            let coefficients = ConverterCoefficients::prepare(
                &config, &hah1bv(), &Corrections::default(), Some(supply));
            let code = (signal / reference * 32_768.0).floor().min(32_767.0);
            let got = f64::from(coefficients.current(code as i32, Range::Small).get()) * 1e-6;
            if code < 32_767.0 {
                prop_assert!(got <= amps + 1e-5 && got > amps - 0.044, "{} {}", got, amps);
            }
        }
        // A supply that is not compensated is what makes the mode matter.
        let fixed = ConverterConfig { supply_mode: SupplyMode::Fixed, ..CONFIG };
        let coefficients = ConverterCoefficients::prepare(&fixed, &hah1bv(), &Corrections::default(), Some(supply));
        prop_assert_eq!(coefficients, prepare(&fixed, hah1bv()));
    }

    #[test]
    fn closed_loop_with_shared_or_own_reference(supply in any_supply(), amps in -280.0..280.0_f64) {
        let d4 = FrontEnd::ClosedLoop(ClosedLoop {
            relations: SupplyRelations {
                k1_nanoohm_per_volt: 2_000_000_000,
                m1_nanoohm: 3_300_000_000,
                k2_nanovolt_per_volt: 480_000_000,
                m2_nanovolt: 100_000_000,
            },
            ..ClosedLoop::default()
        });
        let vc = f64::from(supply.get()) * 1e-6;
        let signal = (2.0 * vc + 3.3) * amps / 2_000.0 + 0.48 * vc + 0.1;
        for (supply_mode, reference) in [(SupplyMode::Ratiometric, vc), (SupplyMode::Measured, 5.0)] {
            let config = ConverterConfig { supply_mode, data_rate: DataRate::Sps8, ..CONFIG };
            let coefficients = ConverterCoefficients::prepare(&config, &d4, &Corrections::default(), Some(supply));
            let code = (signal / reference * 32_768.0).round();
            let got = f64::from(coefficients.current(code as i32, Range::Small).get()) * 1e-6;
            prop_assert!((got - amps).abs() < 0.015, "{} {}", got, amps);
        }
    }

    #[test]
    fn a_constant_current_is_believed_whatever_came_before(
        before in prop::collection::vec(500..7_500_i16, 0..30), then in 1_000..7_000_i16, confirmations in 0..5_u8
    ) {
        let config = ConverterConfig { step_confirmations: confirmations, ..CONFIG };
        let mut bench = Bench::new(config, hah1bv());
        for code in before {
            bench.code(code);
        }
        for _ in 0..confirmations {
            bench.code(then);
        }
        prop_assert!(bench.code(then).validity.is_valid());
    }

    #[test]
    fn within_the_rate_limit_nothing_is_refused(start in 2_000..6_000_i16, steps in prop::collection::vec(-200..=200_i16, 1..40)) {
        // 200 codes of 153 mA are 30.5 A, below 31.25 A.
        let mut bench = Bench::new(CONFIG, hah1bv());
        let mut code = start;
        for step in steps {
            code = (code + step).clamp(1_000, 7_000);
            prop_assert!(bench.code(code).validity.is_valid());
        }
    }

    #[test]
    fn an_invalid_sample_never_becomes_0_a(code in 4_200..8_192_i16, bad in 0..4_u8) {
        let mut bench = Bench::new(CONFIG, hah1bv());
        bench.amps(100.0);
        let reading = match bad {
            0 => bench.sample(0x8C, 0),
            1 => { bench.context.spoiled_by_edge = true; bench.code(code) }
            2 => bench.converter.on_fault(at(50_000)),
            _ => { bench.coefficients.supply_fault = true; bench.code(code) }
        };
        prop_assert!(!reading.validity.is_valid());
        prop_assert!(reading.current > Microamps::from_amps(5));
    }

    #[test]
    fn nothing_panics(
        front_end in any_front_end(), corrections in any::<([i32; 8], u8)>(), supply: Option<i32>, numbers: [i32; 4],
        rate in any_rate(), supply_mode in any_mode(),
        samples in prop::collection::vec(any::<(u64, u64, u8, i16, bool, Option<i32>, bool)>(), 1..20)
    ) {
        let ([k1, a1, k2, a2, g1, g2, z1, z2], small) = corrections;
        let corrections = Corrections {
            key_factors: PerRange {
                small: KeyFactors { k_ppb: k1, a: Microvolts(a1) },
                large: KeyFactors { k_ppb: k2, a: Microvolts(a2) },
            },
            gain: PerRange { small: Ppm(g1), large: Ppm(g2) },
            zero_drift: PerRange { small: Microamps(z1), large: Microamps(z2) },
        };
        let config = ConverterConfig {
            data_rate: rate,
            gain: Gain::X8,
            supply_mode,
            reference: Microvolts(numbers[0]),
            adc1_period_us: u32::MAX,
            settling_us: u32::MAX,
            stale_after_periods: u8::MAX,
            saturation_margin: Microvolts(numbers[1]),
            max_amps_per_second: numbers[2] as u32,
            step_confirmations: small,
            stuck_count: u16::from(small),
            stuck_movement: PerRange::both(Microamps(numbers[3])),
        };
        let _ = config.validate();
        let coefficients = ConverterCoefficients::prepare(&config, &front_end, &corrections, supply.map(Microvolts));
        let mut converter = Converter::new();
        for (started, finished, byte, code, expected, mean, large) in samples {
            let context = SampleContext {
                range: if large { Range::Large } else { Range::Small },
                spoiled_by_edge: byte & 1 == 1,
                meter_mean: mean.map(Microamps),
                meter_mean_begun: at(finished / 2),
            };
            let configuration = if expected { config.expected_configuration() } else { byte };
            let (started, finished) = (at(started), at(finished));
            let volts = Microvolts(mean.unwrap_or(0));
            converter.on_sample(&config, &coefficients, &ConverterSample { started, finished, configuration, code }, &context);
            converter.on_adc1_sample(&config, &coefficients, &Adc1Sample { started, finished, volts }, &context);
            let _ = converter.reading(&coefficients, finished);
        }
        let _ = (coefficients.step(Range::Small), coefficients.current(i32::MIN, Range::Large));
    }
}
