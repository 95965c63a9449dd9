//! What is measured, with its limit. One entry per figure that is promised.

use core_logic::{
    configuration::Configuration,
    converter::{Converter, ConverterCoefficients, ConverterSample, Corrections, SampleContext},
    measurement::{Measurement, prepare},
    meter::MeterReport,
    range::{EdgeRecorder, Range, RangeHistory},
    sliding_average::SlidingAverage,
    soc::{Soc, SocCoefficients, SocInput},
    units::{Duration, Instant, Microamps, Nanocoulombs},
    validity::Validity,
};

use crate::Counter;

/// Every measurement.
pub fn all(counter: &mut Counter) {
    range_edge(counter);
    current_sample(counter);
    whole_conversion(counter);
    factors(counter);
}

fn at(micros: u64) -> Instant {
    Instant::from_ticks(micros)
}

/// The highest priority: what it takes delays every other task.
fn range_edge(counter: &mut Counter) {
    let mut recorder = EdgeRecorder::new(at(0), false);
    let edges = [
        (at(100), true),
        (at(250), false),
        // The level already known: two edges in one interrupt.
        (at(300), false),
        // Beyond 32 bits.
        (at(1 << 40), true),
        // A clock that stood still, and one that went back.
        (at(1 << 40), false),
        (at(7), true),
    ];
    counter.measure("range edge", Some(200), &edges, |(now, flag_high)| {
        recorder.on_edge(*now, *flag_high);
    });
}

/// Codes of the ADS1100 at 32 samples a second, 14 bits: from rest over both signs to the ends of the sensor's range.
const CODES: [i16; 12] = [
    4_096, 4_097, 4_100, 4_000, 4_250, 3_750, 5_000, 3_000, 7_700, 500, 4_096, 4_098,
];
const PERIOD_US: u64 = 31_250;

fn samples(configuration: &Configuration) -> [ConverterSample; CODES.len()] {
    let mut number = 0;
    CODES.map(|code| {
        number += 1;
        ConverterSample {
            started: at((number - 1) * PERIOD_US),
            finished: at(number * PERIOD_US),
            configuration: configuration.converter.expected_configuration(),
            code,
        }
    })
}

/// One conversion through correction, validity, average and state of charge. Twelve conversions hold no full second, so
/// the last one is a second late: with the step that looks after uncertainty and rest.
fn current_sample(counter: &mut Counter) {
    let configuration = Configuration::default();
    let coefficients = ConverterCoefficients::prepare(
        &configuration.converter,
        &configuration.front_end,
        &Corrections::default(),
        None,
    );
    let soc_coefficients = SocCoefficients::new(&configuration.soc);
    let mut converter = Converter::new();
    let mut average = SlidingAverage::new();
    let mut soc = Soc::new(&soc_coefficients);
    let mut charge_total = Nanocoulombs::ZERO;
    let mut samples = samples(&configuration);
    if let Some(last) = samples.last_mut() {
        last.finished += Duration::from_ticks(1_000_000);
    }
    counter.measure(
        "current sample: correction, average and SoC",
        Some(800),
        &samples,
        |sample| {
            let reading = converter.on_sample(
                &configuration.converter,
                &coefficients,
                sample,
                &SampleContext::default(),
            );
            if let Some(reading) = reading {
                average.push(&configuration.average, &reading);
                charge_total = charge_total.saturating_add(Nanocoulombs(1_234_567_890));
                soc.update(
                    &soc_coefficients,
                    &configuration.ocv,
                    &SocInput {
                        now: reading.at,
                        charge_total,
                        current: reading.validity.is_valid().then_some(reading.current),
                        cell_voltage: None,
                    },
                );
            }
        },
    );
}

/// The same with everything else that hangs on a conversion and a meter report: open sensor, flag against level,
/// comparison of the channels, zero calibration. Stated, not promised.
fn whole_conversion(counter: &mut Counter) {
    let configuration = Configuration::default();
    let mut measurement = Measurement::new(&configuration, None, Nanocoulombs::ZERO, at(0));
    let history = RangeHistory::steady(at(0), Range::Small);
    let mut charge_total = Nanocoulombs::ZERO;
    counter.measure(
        "everything that hangs on a conversion",
        None,
        &samples(&configuration),
        |sample| {
            measurement.on_conversion(&configuration, sample, &history);
            charge_total = charge_total.saturating_add(Nanocoulombs(1_234_567_890));
            let report = MeterReport {
                at: Some(sample.finished),
                charge_total,
                mean_current: Microamps(39_506_172),
                mean_over: Duration::from_ticks(1_000_000),
                ..MeterReport::default()
            };
            measurement.on_meter(&configuration, &report, Validity::VALID);
        },
    );
}

/// What the check of the factors takes once a second, and a change of the supply by 1 mV. Stated, not promised.
fn factors(counter: &mut Counter) {
    let configuration = Configuration::default();
    let mut measurement = Measurement::new(&configuration, None, Nanocoulombs::ZERO, at(0));
    let basis = measurement.basis();
    let prepared = prepare(&configuration, &basis);
    counter.measure("factors: worked out", None, &[()], |()| {
        prepare(&configuration, &basis)
    });
    counter.measure("factors: compared", None, &[()], |()| {
        measurement.check_factors(&basis, &prepared)
    });
    counter.measure("factors: the meter's", None, &[()], |()| {
        measurement.due_meter_calibration(&configuration)
    });
}
