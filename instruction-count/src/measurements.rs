//! What is measured, with its limit. One entry per figure that is promised.

use core_logic::{
    configuration::Configuration,
    converter::ConverterSample,
    measurement::Measurement,
    meter::MeterReport,
    range::{EdgeRecorder, Range, RangeHistory},
    units::{Duration, Instant, Microamps, Nanocoulombs},
    validity::Validity,
};

use crate::Counter;

/// Every measurement.
pub fn all(counter: &mut Counter) {
    range_edge(counter);
    current_sample(counter);
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
    counter.measure("range edge", 200, &edges, |(now, flag_high)| {
        recorder.on_edge(*now, *flag_high);
    });
}

/// A conversion and the meter's report of the same moment: correction, validity, average, comparison and state of charge.
fn current_sample(counter: &mut Counter) {
    let configuration = Configuration::default();
    let mut measurement = Measurement::new(&configuration, None, Nanocoulombs::ZERO, at(0));
    let period = 70_000;
    // From rest over both signs to the ends of the converter; the average's window is filled before and wraps.
    let codes = [
        0, 16_384, 16_400, 16_000, 17_000, 15_000, 20_000, 12_000, 32_767, -32_768, 16_384, 16_390,
    ];
    let mut samples = codes.map(|code| (code, at(0), Range::Small));
    for (number, sample) in (1..).zip(&mut samples) {
        sample.1 = at(number * period);
    }
    let mut charge = Nanocoulombs::ZERO;
    counter.measure(
        "current sample: correction, average and SoC",
        800,
        &samples,
        |(code, now, range)| {
            let history = RangeHistory::steady(at(0), *range);
            let sample = ConverterSample {
                started: *now,
                finished: *now + Duration::from_ticks(66_000),
                configuration: configuration.converter.expected_configuration(),
                code: *code,
            };
            measurement.on_conversion(&configuration, &sample, &history);
            charge = charge.saturating_add(Nanocoulombs(1_234_567_890));
            let report = MeterReport {
                at: Some(sample.finished),
                charge_total: charge,
                mean_current: Microamps(17_636_684),
                mean_over: Duration::from_ticks(period),
                ..MeterReport::default()
            };
            measurement.on_meter(&configuration, &report, Validity::default());
        },
    );
}
