use super::*;
use crate::range::EdgeRecorder;
use proptest::prelude::*;

const SWITCHING: f64 = 53.333_333;

fn at(us: u64) -> Instant {
    Instant::from_ticks(us)
}

fn counts_per_second() -> f64 {
    1_677_722.0 * 0.2 * (3_579_545.0 / 4.0) / 2f64.powi(25)
}

fn per_count(range: Range) -> f64 {
    match range {
        Range::Small => 60.0 / counts_per_second(),
        Range::Large => 600.0 / counts_per_second(),
    }
}

/// A meter with a flag, read at will.
struct Bench {
    channel: MeterChannel,
    recorder: EdgeRecorder,
    energy: i32,
}

impl Bench {
    fn new(config: MeterConfig, range: Range) -> Self {
        let mut bench = Self {
            channel: MeterChannel::new(config),
            recorder: EdgeRecorder::new(at(0), range == Range::Large),
            energy: 0,
        };
        assert_eq!(bench.read(0, 0), ReadingOutcome::First);
        bench
    }

    /// `counts` later, at `us`.
    fn read(&mut self, us: u64, counts: i32) -> ReadingOutcome {
        self.energy = self.energy.wrapping_add(counts);
        self.channel.on_reading(
            MeterReading {
                energy: self.energy,
                at: at(us),
            },
            self.recorder.history(at(us)),
        )
    }

    fn edge(&mut self, us: u64, range: Range) {
        self.recorder.on_edge(at(us), range == Range::Large);
    }

    fn coulombs(&self) -> f64 {
        self.channel.report().charge_total.get() as f64 * 1e-9
    }

    fn doubt(&self) -> f64 {
        self.channel.report().uncertainty.get() as f64 * 1e-9
    }
}

/// What the converter says of the time up to `until`: this mean current.
fn bridge_of(current: Microamps, since: u64, until: u64) -> GapBridge {
    let length = Duration::from_ticks(until - since);
    let charge_of = |current: Microamps| {
        Nanocoulombs(i64::from(current.get()) * length.as_ticks() as i64 / 1_000)
    };
    GapBridge {
        since: at(since),
        until: at(until),
        charge: charge_of(current),
        doubt: charge_of(converter_error(&MeterConfig::default(), current)),
        current: Some(current),
        holds: Duration::from_ticks(55_000),
    }
}

fn near(value: f64, expected: f64, tolerance: f64) {
    assert!(
        (value - expected).abs() <= tolerance,
        "{value} instead of {expected}"
    );
}

/// F22, with edges in the time that is counted again and without.
#[test]
fn damaged_factors_are_found_and_their_counts_are_taken_again() {
    let flips: [fn(&mut MeterCalibration); 8] = [
        |c| c.coefficients.scale.small ^= 1 << 54,
        |c| c.coefficients.scale.large ^= 1 << 62,
        |c| c.coefficients.step.small ^= 1 << 33,
        |c| c.coefficients.step.large ^= 1 << 30,
        |c| c.config.offset.small.0 ^= 1 << 30,
        |c| c.config.full_scale.small.0 ^= 1 << 25,
        |c| c.config.switching_current.0 ^= 1 << 29,
        |c| c.config.mean_window_ms ^= 1 << 4,
    ];
    for has_edges in [false, true] {
        for (number, flip) in flips.into_iter().enumerate() {
            let calibration = MeterCalibration::new(MeterConfig::default(), 7);
            let run = |flip: Option<fn(&mut MeterCalibration)>| {
                let mut bench = Bench::new(MeterConfig::default(), Range::Small);
                bench.channel.set_calibration(&calibration);
                let mut range = Range::Small;
                for step in 1..=200 {
                    let us = step * 20_000;
                    if has_edges && step % 25 == 0 {
                        range = range.other();
                        bench.edge(us - 9_000, range);
                    }
                    // 53 A by what each range makes of them.
                    let counts = if range == Range::Small { 158 } else { 16 };
                    bench.read(us, counts);
                    if step == 60
                        && let Some(flip) = flip
                    {
                        flip(&mut bench.channel.calibration);
                    }
                    if step % 50 == 0 {
                        bench.channel.set_calibration(&calibration);
                    }
                }
                bench
            };
            let (sound, damaged) = (run(None), run(Some(flip)));
            let (expected, report) = (sound.channel.report(), damaged.channel.report());
            assert_eq!((expected.damaged, report.damaged), (0, 1), "{number}");
            if has_edges {
                // By shares of a second, in which the current might have been any.
                near(damaged.coulombs(), sound.coulombs(), 6.0);
                assert!(damaged.doubt() <= sound.doubt() + 600.0);
            } else {
                assert_eq!(
                    MeterReport {
                        damaged: 0,
                        ..report
                    },
                    expected,
                    "{number}"
                );
            }
        }
    }
}

#[test]
fn the_same_calibration_again_changes_nothing_and_another_one_is_no_damage() {
    let mut bench = Bench::new(MeterConfig::default(), Range::Small);
    let first = MeterCalibration::new(MeterConfig::default(), 1);
    bench.channel.set_calibration(&first);
    bench.read(20_000, 150);
    let before = bench.channel.report();
    bench.channel.set_calibration(&first);
    assert_eq!(bench.channel.report(), before);
    let mut config = MeterConfig::default();
    config.gain.small = Ppm(10_000);
    bench
        .channel
        .set_calibration(&MeterCalibration::new(config, 2));
    let report = bench.channel.report();
    assert_eq!(
        (report.charge_total, report.uncertainty),
        (before.charge_total, before.uncertainty)
    );
    bench.read(40_000, 150);
    assert_eq!(bench.channel.report().damaged, 0);
}

/// What was undone before, by the readings, is not had back from what was noted meanwhile.
#[test]
fn damage_after_a_disturbed_reading_that_was_undone_costs_nothing() {
    let calibration = MeterCalibration::new(MeterConfig::default(), 1);
    let mut bench = Bench::new(MeterConfig::default(), Range::Small);
    bench.read(20_000, 150);
    let truth = bench.energy + 300;
    bench.channel.on_reading(
        MeterReading {
            energy: bench.energy + 150 + 400,
            at: at(40_000),
        },
        bench.recorder.history(at(40_000)),
    );
    bench.channel.set_calibration(&calibration);
    bench.energy = truth;
    for us in [60_000, 60_100, 60_200] {
        bench.read(us, 0);
    }
    near(bench.coulombs(), 450.0 * per_count(Range::Small), 1e-8);
    bench.channel.calibration.coefficients.scale.small ^= 1 << 54;
    bench.read(80_000, 150);
    bench.channel.set_calibration(&calibration);
    near(bench.coulombs(), 600.0 * per_count(Range::Small), 1e-8);
    assert_eq!(bench.channel.report().damaged, 1);
}

#[test]
fn one_count_is_what_the_data_sheets_quantities_make_it() {
    let config = MeterConfig::default();
    near(counts_per_second(), 8_949.0, 0.5);
    for range in [Range::Small, Range::Large] {
        let nanocoulombs = config.charge_per_count(range).get() as f64;
        near(nanocoulombs, per_count(range) * 1e9, 0.6);
        // The scale itself, to the floating point's own precision.
        let scale = config.scale(range) as f64 / NANOCOULOMB as f64 * 1e-9;
        near(scale / per_count(range), 1.0, 1e-15);
    }
    // A second at full scale.
    let mut bench = Bench::new(config, Range::Small);
    assert_eq!(bench.read(1_000_000, 8_949), ReadingOutcome::Integrated);
    near(bench.coulombs(), 60.0 * 8_949.0 / counts_per_second(), 1e-9);
}

/// The chip's own arithmetic, V1 · V2 / Vref², with V2 from the same reference.
#[test]
fn reference_and_divider_enter_the_scale_as_derived() {
    let (reference_ppm, divider_ppm) = (600, -1_900);
    let reference = 1.0 + f64::from(reference_ppm) * 1e-6;
    let ratio = 1.0 + f64::from(divider_ppm) * 1e-6;
    // Rate against the nominal one, with V1 = 1.
    let v2 = reference * ratio;
    let rate = 1.0 * v2 / (reference * reference);
    let config = MeterConfig {
        reference_error: Ppm(reference_ppm),
        divider_error: Ppm(divider_ppm),
        ..MeterConfig::default()
    };
    let nominal = MeterConfig::default();
    for range in [Range::Small, Range::Large] {
        let scale = config.scale(range) as f64 / nominal.scale(range) as f64;
        near(scale * rate, 1.0, 1e-14);
    }
    let gain = MeterConfig {
        gain: PerRange {
            small: Ppm(1_000),
            large: Ppm(-2_000),
        },
        ..nominal
    };
    near(
        gain.scale(Range::Small) as f64 / nominal.scale(Range::Small) as f64,
        1.001,
        1e-14,
    );
    near(
        gain.scale(Range::Large) as f64 / nominal.scale(Range::Large) as f64,
        0.998,
        1e-14,
    );
    // Nonsense is refused by the limits of the configuration, but must not divide by zero either.
    let nonsense = MeterConfig {
        full_scale: PerRange::both(Microamps(-5)),
        divider_error: Ppm(i32::MIN),
        ..nominal
    };
    assert_eq!(nonsense.scale(Range::Small), 1);
}

/// Why DISLPF2: what the filter's memory adds when its output is scaled by the new range from the edge on.
#[test]
fn the_multipliers_low_pass_would_cost_coulombs_at_every_change() {
    let tau = 1.0 / (2.0 * std::f64::consts::PI * 8.9);
    near(tau, 17.9e-3, 0.05e-3);
    // A single pole, stepped through: 60 A is the whole of one range and a tenth of the other.
    let excess = |old: f64, new: f64, scale: f64| {
        let (mut product, mut charge) = (old, 0.0);
        let step = 1e-6;
        for _ in 0..300_000 {
            charge += (product - new) * scale * step;
            product += (new - product) * step / tau;
        }
        charge
    };
    near(excess(1.0, 0.1, 600.0), 9.7, 0.05);
    near(excess(0.1, 1.0, 60.0), -0.97, 0.005);
    near(600.0 * 0.9 * tau, 9.7, 0.05);
    near(60.0 * 0.9 * tau, 0.97, 0.005);
    // The same memory as a configured delay would be corrected on average, by the current at the edge.
    let config = MeterConfig {
        front_end_delay_us: 17_883,
        ..MeterConfig::default()
    };
    let mut bench = Bench::new(config, Range::Small);
    bench.edge(1_000_000, Range::Large);
    let _ = bench.read(1_000_000, 7_955);
    let _ = bench.read(1_100_000, 50);
    let counted = 7_955.0 * per_count(Range::Small) + 50.0 * per_count(Range::Large);
    near(
        bench.coulombs() - counted,
        -9.0 * SWITCHING * 17.883e-3,
        1e-5,
    );
    // And back.
    let before = bench.coulombs();
    bench.edge(2_000_000, Range::Small);
    let _ = bench.read(2_000_000, 700);
    let counted = 700.0 * per_count(Range::Large);
    near(
        bench.coulombs() - before - counted,
        0.9 * SWITCHING * 17.883e-3,
        1e-5,
    );
}

#[test]
fn the_filters_delay_is_counted_up_to_the_snapshot() {
    let config = MeterConfig {
        front_end_delay_us: 60,
        ..MeterConfig::default()
    };
    // 100 µs after the edge: 60 µs still at the old level, 40 µs at the new one.
    let mut bench = Bench::new(config, Range::Large);
    bench.edge(1_000_000, Range::Small);
    let _ = bench.read(1_000_100, 796);
    near(
        bench.coulombs() - 796.0 * per_count(Range::Large),
        -9.0 * SWITCHING * 40e-6,
        1e-8,
    );
    // 20 µs after it: 40 µs of the old level are still to come.
    let mut bench = Bench::new(config, Range::Large);
    bench.edge(1_000_000, Range::Small);
    let _ = bench.read(1_000_020, 796);
    near(
        bench.coulombs() - 796.0 * per_count(Range::Large),
        0.9 * SWITCHING * 40e-6,
        1e-8,
    );
    // The edge nearer to the begin: what comes after it is counted by the new range, with the whole delay.
    let mut bench = Bench::new(config, Range::Large);
    bench.edge(100, Range::Small);
    let _ = bench.read(1_000_000, 7_955);
    near(
        bench.coulombs() - 7_955.0 * per_count(Range::Small),
        0.9 * SWITCHING * 160e-6,
        1e-8,
    );
}

#[test]
fn counts_after_an_edge_belong_to_the_new_range() {
    for sign in [1, -1] {
        let s = f64::from(sign);
        let mut bench = Bench::new(MeterConfig::default(), Range::Small);
        bench.edge(1_000_000, Range::Large);
        assert_eq!(
            bench.read(1_000_100, 7_955 * sign),
            ReadingOutcome::Integrated
        );
        // The sign of a stay in the large range is not known before a count shows it: until then uncorrected.
        near(
            bench.coulombs(),
            s * 7_955.0 * per_count(Range::Small),
            1e-8,
        );
        assert_eq!(bench.read(1_010_000, 0), ReadingOutcome::Integrated);
        near(
            bench.coulombs(),
            s * 7_955.0 * per_count(Range::Small),
            1e-8,
        );
        let _ = bench.read(1_100_000, 80 * sign);
        let expected = 7_955.0 * per_count(Range::Small)
            + 0.9 * SWITCHING * 100e-6
            + 80.0 * per_count(Range::Large);
        near(bench.coulombs(), s * expected, 1e-8);
        // Back: 48 mC per 100 µs.
        bench.edge(2_000_000, Range::Small);
        assert_eq!(
            bench.read(2_000_100, 720 * sign),
            ReadingOutcome::Integrated
        );
        let expected = expected + 720.0 * per_count(Range::Large) - 9.0 * SWITCHING * 100e-6;
        near(bench.coulombs(), s * expected, 2e-8);
        near(9.0 * SWITCHING * 100e-6, 48e-3, 1e-6);
        let report = bench.channel.report();
        assert_eq!((report.hand_overs, report.estimated_intervals), (2, 0));
        // Two edges of 30.2 mC, a count's half at each end, latency: 100 µs · 1 A, 10 kA/s, 5 µs of stamp.
        let latency = 100e-6 + 50e-6 + SWITCHING * 5e-6;
        let doubt = 2.0 * 30.171e-3 + 6.7048e-3 + (0.9 + 9.0) * latency;
        near(bench.doubt(), doubt, 3e-6);
    }
}

#[test]
fn the_part_nearer_to_the_edge_is_estimated() {
    let mut bench = Bench::new(MeterConfig::default(), Range::Large);
    bench.edge(100, Range::Small);
    assert_eq!(bench.read(1_000_000, -7_000), ReadingOutcome::Integrated);
    // 100 µs before the edge at the large range, counted by the small one: 0.9 · 53.3 A · 100 µs are missing.
    let expected = -7_000.0 * per_count(Range::Small) - 0.9 * SWITCHING * 100e-6;
    near(bench.coulombs(), expected, 1e-8);
    // A snapshot that came late is an estimate, and its doubt is what the range allows at most.
    let mut bench = Bench::new(MeterConfig::default(), Range::Large);
    bench.edge(10_000_000, Range::Small);
    assert_eq!(bench.read(10_000_201, 7_000), ReadingOutcome::Estimated);
    assert_eq!(bench.channel.report().estimated_intervals, 1);
    let mut bench = Bench::new(MeterConfig::default(), Range::Large);
    bench.edge(10_000_000, Range::Small);
    assert_eq!(bench.read(10_000_200, 7_000), ReadingOutcome::Integrated);
    let mut bench = Bench::new(MeterConfig::default(), Range::Large);
    bench.edge(10_000_000, Range::Small);
    let _ = bench.read(19_000_000, 7_000);
    near(
        bench.doubt(),
        9.0 * 9.0 * (60.0 + SWITCHING) + 67.05e-3 + 9.0 * SWITCHING * 5e-6,
        1e-3,
    );
}

/// 30 A, where no comparator switches, half of each millisecond in either range.
#[test]
fn chatter_is_shared_by_time_wherever_the_current_is() {
    for amps in [30.0, -50.0] {
        let mut bench = Bench::new(MeterConfig::default(), Range::Small);
        let mut counted = 0.0_f64;
        let mut read = |bench: &mut Bench, us: u64, ran: u64, range: Range| {
            let before = counted.round();
            counted += amps * ran as f64 * 1e-6 / per_count(range);
            bench.read(us, (counted.round() - before) as i32)
        };
        let steady = read(&mut bench, 1_000_000, 1_000_000, Range::Small);
        assert_eq!(steady, ReadingOutcome::Integrated);
        // The first edge has its counts, the next one comes too soon.
        bench.edge(1_010_000, Range::Large);
        let first = read(&mut bench, 1_010_000, 10_000, Range::Small);
        assert_eq!(first, ReadingOutcome::Integrated);
        let (charge, doubt) = (bench.coulombs(), bench.doubt());
        let (mut now, mut range, mut waited) = (1_010_000, Range::Large, 0);
        for _ in 0..200 {
            now += 500;
            bench.edge(now, range.other());
            match read(&mut bench, now, 500, range) {
                ReadingOutcome::Waits => waited += 1,
                outcome => assert_eq!(outcome, ReadingOutcome::Estimated),
            }
            range = range.other();
        }
        // Each ninth is later than 4 ms.
        assert_eq!(waited, 200 - 22);
        // What the last count hides is of the large range.
        let _ = read(&mut bench, now + 5_000, 5_000, range);
        near(
            bench.coulombs() - charge,
            amps * 105e-3,
            per_count(Range::Large),
        );
        // Per 4.5 ms: 22.5 A over 2 or 2.5 ms with an excess of 45/27 − 1 or 45/29.5 − 1, a stamp, and half of what one
        // scale differs from the next.
        let excess = |small_ms: f64| 4.5 / (small_ms + (4.5 - small_ms) / 10.0) - 1.0;
        let shape = 22.5 * (2e-3 * excess(2.0) + 2.5e-3 * excess(2.5)) / 2.0;
        let hidden = per_count(Range::Small) * (excess(2.0) - excess(2.5)) / 2.0;
        let each = shape + 9.0 * SWITCHING * 5e-6 + hidden;
        // And the rest up to the end.
        near(bench.doubt() - doubt, 22.0 * each, 0.15 * 22.0 * each);
        assert_eq!(bench.channel.report().hand_overs, 1);
    }
}

/// At 100 A the small sensor shows no more than 60 A: what is missing is declared.
#[test]
fn a_small_sensor_at_its_end_is_doubted() {
    let small = |ms: f64| (60.0 * ms * 1e-3 / per_count(Range::Small)) as i32;
    // Alone: anything that the large one could show.
    let mut bench = Bench::new(MeterConfig::default(), Range::Small);
    let doubt = bench.doubt();
    let _ = bench.read(20_000, small(20.0));
    near(bench.doubt() - doubt, 600.0 * 20e-3, 0.01);
    // Where its comparators should have switched it is not.
    let _ = bench.read(40_000, small(20.0 * 55.0 / 60.0));
    near(bench.doubt() - doubt, 600.0 * 20e-3, 0.01);
    // Of a time shared by both ranges it is what the large one shows.
    let mut bench = Bench::new(MeterConfig::default(), Range::Small);
    for edge in 1..4 {
        bench.edge(edge * 10_000, Range::from_flag(edge % 2 == 1));
    }
    let large = (100.0 * 20e-3 / per_count(Range::Large)) as i32;
    let _ = bench.read(40_000, small(20.0) + large);
    let missing = 100.0 * 40e-3 - bench.coulombs();
    assert!(missing > 1.4, "{missing}");
    assert!(bench.doubt() > missing && bench.doubt() < missing + 4.0);
}

#[test]
fn a_pulse_is_taken_along_by_the_next_reading() {
    let mut bench = Bench::new(MeterConfig::default(), Range::Small);
    bench.edge(1_000_000, Range::Large);
    assert_eq!(bench.read(1_000_000, 4_000), ReadingOutcome::Integrated);
    let charge = bench.coulombs();
    bench.edge(1_001_000, Range::Small);
    assert_eq!(bench.read(1_001_000, 0), ReadingOutcome::Waits);
    assert_eq!(bench.channel.report().at, Some(at(1_000_000)));
    near(bench.coulombs(), charge, 1e-9);
    // Without an edge it waits as well, until 4 ms have passed since the last one that was booked.
    assert_eq!(bench.read(1_004_000, 4), ReadingOutcome::Waits);
    assert_eq!(bench.read(1_004_001, 0), ReadingOutcome::Estimated);
    let weight = 3_001.0 / per_count(Range::Small) + 1_000.0 / per_count(Range::Large);
    near(bench.coulombs() - charge, 4.0 * 4_001.0 / weight, 1e-8);
    // A reading in between that is impossible is refused, and the one after the gap has nothing to take along.
    bench.edge(1_004_500, Range::Large);
    assert_eq!(bench.read(1_004_500, 2), ReadingOutcome::Waits);
    let _ = bench.read(1_004_600, 9_999);
    assert_eq!(bench.channel.report().rejected, 1);
}

#[test]
fn a_filter_in_front_adds_doubt_to_chatter() {
    let read = |front_end_delay_us| {
        let config = MeterConfig {
            front_end_delay_us,
            ..MeterConfig::default()
        };
        let mut bench = Bench::new(config, Range::Small);
        for (us, range) in [(50, Range::Large), (80, Range::Small), (110, Range::Large)] {
            bench.edge(us, range);
        }
        assert_eq!(bench.read(5_000, 1), ReadingOutcome::Estimated);
        bench.doubt()
    };
    near(read(10) - read(0), 9.0 * SWITCHING * 10e-6, 1e-8);
}

#[test]
fn short_stays_within_a_long_interval() {
    let mut bench = Bench::new(MeterConfig::default(), Range::Large);
    let _ = bench.read(1_000_000, 800);
    let before = bench.coulombs();
    let doubt = bench.doubt();
    // 300 µs in the small range in the middle of 20 ms: 2.4 counts there, 15.7 in the large one.
    bench.edge(1_010_000, Range::Small);
    bench.edge(1_010_300, Range::Large);
    assert_eq!(bench.read(1_020_000, 18), ReadingOutcome::Estimated);
    near(
        bench.coulombs() - before,
        18.0 * per_count(Range::Large) - 9.0 * SWITCHING * 300e-6,
        1e-8,
    );
    // No change of scale, so no hidden bits: 9 · (1 A · 300 µs + slew + two stamps).
    let expected = 9.0 * (300e-6 + 1e4 * 9e-8 / 2.0 + SWITCHING * 10e-6);
    near(bench.doubt() - doubt, expected, 3e-9);
    assert_eq!(bench.channel.report().hand_overs, 2);
}

/// A storm's rest of 14 ms, in which nobody sees an edge: what the gated counter says decides.
#[test]
fn unwatched_time_is_shared_as_the_gated_counter_says() {
    let mut bench = Bench::new(MeterConfig::default(), Range::Large);
    let _ = bench.read(1_000_000, 800);
    let before = bench.coulombs();
    bench.edge(1_000_100, Range::Small);
    bench.recorder.suspend();
    bench.recorder.resume(at(1_015_000), true);
    bench.energy += 60;
    let reading = MeterReading {
        energy: bench.energy,
        at: at(1_016_000),
    };
    let history = RangeHistory {
        high: Duration::from_ticks(1_000_000 + 4_000),
        ..bench.recorder.history(reading.at)
    };
    let outcome = bench.channel.on_reading(reading, history);
    assert_eq!(outcome, ReadingOutcome::Estimated);
    let weight = 12e-3 / per_count(Range::Small) + 4e-3 / per_count(Range::Large);
    near(bench.coulombs() - before, 60.0 * 16e-3 / weight, 1e-8);
}

#[test]
fn long_stays_in_both_ranges_are_shared_by_time() {
    // A constant current of 50 A: 60 ms of it in the small range, 40 ms in the large one.
    let config = MeterConfig {
        slew_limit_amps_per_second: 10,
        ..MeterConfig::default()
    };
    let mut bench = Bench::new(config, Range::Small);
    bench.edge(30_000, Range::Large);
    bench.edge(70_000, Range::Small);
    let counts = 50.0 * (60e-3 / per_count(Range::Small) + 40e-3 / per_count(Range::Large));
    assert_eq!(
        bench.read(100_000, counts.round() as i32),
        ReadingOutcome::Estimated
    );
    near(
        bench.coulombs(),
        50.0 * 100e-3 * counts.round() / counts,
        1e-7,
    );
    assert_eq!(bench.channel.report().estimated_intervals, 1);
    // 1 A of change at most, half of it over the excess of the small range's weight: 0.1 / (0.06 + 0.004) − 1; the
    // hidden bits at both ends; a stamp.
    let harmonic = per_count(Range::Small) * 0.1 / 0.064;
    near(
        bench.doubt(),
        0.5 * 60e-3 * (0.1 / 0.064 - 1.0) + harmonic + 9.0 * SWITCHING * 5e-6,
        1e-6,
    );
    // No faster change than from one end of the large range to the other is assumed.
    let mut bench = Bench::new(MeterConfig::default(), Range::Small);
    bench.edge(3_000_000, Range::Large);
    bench.edge(7_000_000, Range::Small);
    let _ = bench.read(10_000_000, 40_000);
    near(
        bench.doubt(),
        1_200.0 * 6.0 * (0.1 / 0.064 - 1.0) + harmonic + 9.0 * SWITCHING * 5e-6,
        1e-4,
    );
}

#[test]
fn the_sign_of_a_stay_is_remembered_while_the_current_cannot_reverse() {
    // A stay with a positive sign, then out and in again.
    let run = |pause: u64| {
        let mut bench = Bench::new(MeterConfig::default(), Range::Large);
        let _ = bench.read(1_000_000, 900);
        bench.edge(2_000_000, Range::Small);
        let _ = bench.read(2_000_000, 900);
        let edge = 2_000_000 + pause;
        bench.edge(edge, Range::Large);
        let before = bench.coulombs();
        let _ = bench.read(edge + 100, 0);
        bench.coulombs() - before
    };
    // 2 · 53.3 A at 10 kA/s: 10.67 ms.
    near(run(10_500), 0.9 * SWITCHING * 100e-6, 1e-8);
    near(run(10_700), 0.0, 1e-9);
}

#[test]
fn a_sign_that_never_showed_is_guessed_and_doubted() {
    let mut bench = Bench::new(MeterConfig::default(), Range::Small);
    bench.edge(1_000_000, Range::Large);
    let _ = bench.read(1_000_100, 0);
    bench.edge(1_050_000, Range::Small);
    let _ = bench.read(1_050_000, 0);
    let doubt = bench.doubt();
    near(bench.coulombs(), 0.0, 1e-9);
    let pending = 0.9 * SWITCHING * 100e-6;
    let _ = bench.read(2_000_000, -100);
    near(
        bench.coulombs(),
        -100.0 * per_count(Range::Small) - pending,
        1e-8,
    );
    // Waiting counts once, a guess twice.
    near(bench.doubt() - doubt, pending, 1e-8);
    // The stay's own counts are no guess.
    let mut bench = Bench::new(MeterConfig::default(), Range::Small);
    bench.edge(1_000_000, Range::Large);
    let _ = bench.read(1_000_100, 5_000);
    bench.edge(1_100_000, Range::Small);
    let _ = bench.read(1_100_000, -80);
    near(
        bench.coulombs(),
        5_000.0 * per_count(Range::Small) - 80.0 * per_count(Range::Large) - pending,
        2e-8,
    );
}

#[test]
fn offset_is_taken_off_exactly() {
    let config = MeterConfig {
        offset: PerRange {
            small: Microamps(1),
            large: Microamps(-2_000_000),
        },
        ..MeterConfig::default()
    };
    let mut bench = Bench::new(config, Range::Small);
    // 1 µA · 1 µs a thousand times is 1 nC.
    for step in 1..=1_000 {
        let _ = bench.read(step, 0);
    }
    assert_eq!(bench.channel.report().charge_total, Nanocoulombs(-1));
    for step in 1_001..=2_000 {
        let _ = bench.read(step, 0);
    }
    assert_eq!(bench.channel.report().charge_total, Nanocoulombs(-2));
    let mut bench = Bench::new(config, Range::Large);
    let _ = bench.read(10_000_000, 0);
    assert_eq!(
        bench.channel.report().charge_total,
        Nanocoulombs::from_coulombs(20)
    );
    // By the times in each range where there is an edge.
    bench.edge(10_500_000, Range::Small);
    let _ = bench.read(11_000_000, 0);
    let report = bench.channel.report();
    near(report.charge_total.get() as f64 * 1e-9, 21.0 - 0.5e-6, 1e-9);
}

#[test]
fn throughputs_are_kept_apart_and_restored() {
    let mut bench = Bench::new(MeterConfig::default(), Range::Small);
    let _ = bench.read(1_000_000, 1_000);
    let _ = bench.read(2_000_000, -400);
    let report = bench.channel.report();
    near(
        report.charge_out.get() as f64 * 1e-9,
        1_000.0 * per_count(Range::Small),
        1e-8,
    );
    near(
        report.charge_in.get() as f64 * 1e-9,
        400.0 * per_count(Range::Small),
        1e-8,
    );
    near(
        report.charge_total.get() as f64 * 1e-9,
        600.0 * per_count(Range::Small),
        1e-8,
    );
    assert_eq!(
        report.resolution,
        bench.channel.config().charge_per_count(Range::Small)
    );
    bench
        .channel
        .restore(Nanocoulombs(-7), Nanocoulombs(12), Nanocoulombs(5));
    let report = bench.channel.report();
    assert_eq!(report.charge_total, Nanocoulombs(-7));
    assert_eq!(
        (report.charge_in, report.charge_out),
        (Nanocoulombs(12), Nanocoulombs(5))
    );
    let _ = bench.read(3_000_000, 1);
    near(
        bench.channel.report().charge_total.get() as f64,
        per_count(Range::Small) * 1e9 - 7.0,
        1.0,
    );
}

#[test]
fn the_mean_current_is_that_of_the_last_whole_window() {
    let mut bench = Bench::new(MeterConfig::default(), Range::Small);
    assert_eq!(bench.channel.report().mean_over, Duration::from_ticks(0));
    assert!(!bench.channel.report().below_no_load);
    let _ = bench.read(600_000, 600);
    assert_eq!(bench.channel.report().mean_over, Duration::from_ticks(0));
    let _ = bench.read(1_200_000, 600);
    let report = bench.channel.report();
    assert_eq!(report.mean_over, Duration::from_ticks(1_200_000));
    let mean = 1_200.0 * per_count(Range::Small) / 1.2;
    near(f64::from(report.mean_current.get()) * 1e-6, mean, 1e-6);
    assert!(!report.below_no_load);
    let _ = bench.read(2_200_000, -100);
    let report = bench.channel.report();
    let mean = -100.0 * per_count(Range::Small);
    near(f64::from(report.mean_current.get()) * 1e-6, mean, 1e-6);
    // Nothing for a window: 0 A, or anything below 3 mA.
    let _ = bench.read(3_200_000, 0);
    assert!(bench.channel.report().below_no_load);
    assert_eq!(bench.channel.report().mean_current, Microamps(0));
    let config = MeterConfig::default();
    assert_eq!(config.no_load_current(Range::Small), Microamps(3_000));
    assert_eq!(config.no_load_current(Range::Large), Microamps(30_000));
    // One count in 2.235 s is 3.0 mA, in 2.234 s just above.
    let _ = bench.read(5_440_000, 1);
    assert!(bench.channel.report().below_no_load);
    let _ = bench.read(7_670_000, 1);
    assert!(!bench.channel.report().below_no_load);
}

#[test]
fn impossible_rates_are_refused_until_the_meter_counts_as_lost() {
    // 1.2 · 8,949 /s and four counts.
    let most = (1.2 * counts_per_second()).floor() as i32 + 4;
    let mut bench = Bench::new(MeterConfig::default(), Range::Small);
    assert_eq!(bench.read(1_000_000, most), ReadingOutcome::Integrated);
    assert_eq!(bench.read(2_000_000, -most), ReadingOutcome::Integrated);
    let refused = ReadingOutcome::Rejected(Rejection::RateOfChange);
    for sign in [1, -1] {
        assert_eq!(bench.read(3_000_000, sign * (most + 1)), refused);
        bench.energy -= sign * (most + 1);
        near(bench.coulombs(), 0.0, 1e-9);
    }
    assert_eq!(bench.channel.report().rejected, 2);
    // A good one ends the row.
    assert_eq!(bench.read(3_000_000, 10), ReadingOutcome::Integrated);
    for _ in 0..2 {
        assert_eq!(bench.read(3_100_000, 500_000), refused);
        assert!(!bench.channel.report().lost);
    }
    assert_eq!(bench.read(3_100_000, 500_000), refused);
    assert!(bench.channel.report().lost);
    assert_eq!(
        bench.read(3_100_000, 0),
        ReadingOutcome::Rejected(Rejection::Lost)
    );
    assert_eq!(bench.channel.report().rejected, 6);
    // Within one instant a few counts are the hidden bits.
    let mut bench = Bench::new(MeterConfig::default(), Range::Small);
    assert_eq!(bench.read(0, 4), ReadingOutcome::Integrated);
    assert_eq!(bench.read(0, 5), refused);
}

#[test]
fn readings_out_of_order_or_too_late_are_refused() {
    let mut bench = Bench::new(MeterConfig::default(), Range::Small);
    let _ = bench.read(1_000, 0);
    let backwards = ReadingOutcome::Rejected(Rejection::TimeBackwards);
    assert_eq!(bench.read(999, 0), backwards);
    let stale = EdgeRecorder::new(at(0), false).history(at(500));
    let reading = MeterReading {
        energy: 0,
        at: at(2_000),
    };
    assert_eq!(bench.channel.on_reading(reading, stale), backwards);
    assert_eq!(LONGEST_INTERVAL.as_ticks() / 1_000_000, 781);
    let last = 1_000 + LONGEST_INTERVAL.as_ticks();
    assert_eq!(
        bench.read(last + 1, 0),
        ReadingOutcome::Rejected(Rejection::TooLate)
    );
    let mut bench = Bench::new(MeterConfig::default(), Range::Small);
    assert_eq!(
        bench.read(LONGEST_INTERVAL.as_ticks(), 8_000_000),
        ReadingOutcome::Integrated
    );
}

/// F5: a step from 0 to 50 A shortly before the gap, or anywhere in it, is not in the mean that bridges it.
#[test]
fn a_step_beside_a_gap_is_doubted_by_what_flows_behind_it() {
    let mut bench = Bench::new(MeterConfig::default(), Range::Small);
    let hidden_bits = 1.01 * per_count(Range::Small);
    let _ = bench.read(1_000_000, 0);
    bench.channel.on_meter_lost();
    let doubt = bench.doubt();
    let history = bench.recorder.history(at(1_040_000));
    let reading = MeterReading {
        energy: 0,
        at: at(1_040_000),
    };
    bench.channel.on_meter_restarted(
        reading,
        history,
        &bridge_of(Microamps::from_amps(0), 960_000, 991_000),
    );
    near(bench.doubt() - doubt, 0.04, 3e-9);
    // Too short an interval to tell a current.
    assert_eq!(bench.read(1_045_000, 37), ReadingOutcome::Integrated);
    near(bench.doubt() - doubt, 0.04, hidden_bits);
    // 149 counts in 20 ms are 49.95 A, for 40 ms of gap; and that once.
    for us in [1_065_000, 1_085_000] {
        assert_eq!(bench.read(us, 149), ReadingOutcome::Integrated);
        let change = 149.0 * per_count(Range::Small) / 0.02;
        near(bench.doubt() - doubt, 0.04 + change * 0.04, hidden_bits);
    }
}

proptest! {
    /// F2: a reading that is wrong by less than its rate shows. Either the next one undoes it, or it is refused each
    /// time it is read, and then the wrong one is taken back: the charge is what it would have been without it.
    #[test]
    fn a_disturbed_reading_leaves_nothing_in_the_charge(
        range: bool,
        rate in -180_i32..=180,
        wrong in -430_i32..=430,
        good in 2_usize..20,
    ) {
        let range = Range::from_flag(range);
        let mut bench = Bench::new(MeterConfig::default(), range);
        let mut us = 0;
        for _ in 0..good {
            us += 20_000;
            prop_assert_eq!(bench.read(us, rate), ReadingOutcome::Integrated);
        }
        us += 20_000;
        bench.energy += rate;
        let disturbed = bench.channel.on_reading(
            MeterReading { energy: bench.energy + wrong, at: at(us) },
            bench.recorder.history(at(us)),
        );
        us += 20_000;
        bench.energy += rate;
        let mut outcomes = std::vec::Vec::new();
        for attempt in 0..3 {
            us += 100 * attempt;
            outcomes.push(bench.read(us, 0));
            if outcomes.last() == Some(&ReadingOutcome::Integrated) {
                break;
            }
        }
        prop_assert_eq!(outcomes.last(), Some(&ReadingOutcome::Integrated), "{:?}", disturbed);
        prop_assert!(!bench.channel.report().lost);
        us += 20_000;
        prop_assert_eq!(bench.read(us, rate), ReadingOutcome::Integrated);
        let counts = rate * (good as i32 + 3);
        let (charge, carried) = (f64::from(counts) * per_count(range), bench.channel.report());
        prop_assert!((bench.coulombs() - charge).abs() <= 2e-9 + 1e-12 * charge.abs());
        let net = carried.charge_out.get() - carried.charge_in.get();
        prop_assert!((net - carried.charge_total.get()).abs() <= 1);
    }
}

#[test]
fn a_gap_is_bridged_and_doubted() {
    let mut bench = Bench::new(MeterConfig::default(), Range::Small);
    let _ = bench.read(1_000_000, 1_000);
    let before = bench.coulombs();
    let restart = |bench: &mut Bench, us: u64, bridge: GapBridge| {
        bench.channel.on_meter_lost();
        assert!(bench.channel.report().lost);
        bench.energy = 0;
        let reading = MeterReading {
            energy: 0,
            at: at(us),
        };
        let doubt = bench.doubt();
        let history = bench.recorder.history(at(us));
        bench.channel.on_meter_restarted(reading, history, &bridge);
        assert!(!bench.channel.report().lost);
        bench.doubt() - doubt
    };
    // 20 A for 50 ms, with 1 % and 1 A of doubt. The hidden bits count as before.
    let doubt = restart(
        &mut bench,
        1_050_000,
        bridge_of(Microamps::from_amps(20), 1_000_000, 1_030_000),
    );
    near(bench.coulombs() - before, 1.0, 1e-9);
    near(doubt, 0.01 + 0.05, 3e-9);
    // Counting goes on from the new register.
    assert_eq!(bench.read(1_070_000, 50), ReadingOutcome::Integrated);
    near(
        bench.coulombs() - before,
        1.0 + 50.0 * per_count(Range::Small),
        1e-8,
    );
    let _ = bench.read(1_180_000, 0);
    // Nothing is known of the current: anything that the sensor in use can show …
    let doubt = restart(&mut bench, 2_180_000, GapBridge::UNKNOWN);
    near(
        bench.coulombs() - before,
        1.0 + 50.0 * per_count(Range::Small),
        1e-8,
    );
    near(doubt, 60.0, 3e-9);
    assert_eq!(bench.channel.report().gaps, 2);
    assert_eq!(bench.channel.report().at, Some(at(2_180_000)));
    // Nothing bridged that gap, so there is nothing to compare.
    let hidden_bits = 1.01 * per_count(Range::Small);
    let doubt = bench.doubt();
    let _ = bench.read(2_200_000, 100);
    near(bench.doubt(), doubt, hidden_bits);
    // … or the large one, where the flag has changed.
    bench.edge(2_300_000, Range::Large);
    bench.edge(2_400_000, Range::Small);
    let doubt = restart(&mut bench, 3_200_000, GapBridge::UNKNOWN);
    near(doubt, 600.0, hidden_bits);
    // What the converter saw of another time counts no further than to its end: 20 A for the 40 ms of the gap.
    let _ = bench.read(3_220_000, 100);
    let before = bench.coulombs();
    let other = bridge_of(Microamps::from_amps(20), 3_200_000, 3_240_000);
    let doubt = restart(&mut bench, 3_260_000, other);
    near(bench.coulombs() - before, 0.8, 1e-9);
    near(doubt, 0.04 * 1.2, hidden_bits);
    // No conversion for too long: the last one is held, and what it may hide doubted.
    let stale = bridge_of(Microamps::from_amps(20), 3_260_000, 3_290_000);
    let doubt = restart(&mut bench, 3_390_000, stale);
    near(doubt, 0.03 * 1.2 + 0.1 * (60.0 + 20.0), hidden_bits);
}

/// From 300 A before the gap to −53.3 A behind it: the hand-over at the edge is that of a charging current.
#[test]
fn a_sign_does_not_outlast_a_gap() {
    let mut bench = Bench::new(MeterConfig::default(), Range::Large);
    let _ = bench.read(20_000, 90);
    bench.channel.on_meter_lost();
    let history = bench.recorder.history(at(40_000));
    let reading = MeterReading {
        energy: bench.energy,
        at: at(40_000),
    };
    let bridge = bridge_of(Microamps::from_amps(-53), 20_000, 40_000);
    bench.channel.on_meter_restarted(reading, history, &bridge);
    let before = bench.coulombs();
    bench.edge(58_000, Range::Small);
    let _ = bench.read(60_000, -30);
    near(
        bench.coulombs() - before,
        -SWITCHING * 0.02,
        per_count(Range::Large),
    );
}

#[test]
fn a_first_reading_that_comes_late_ends_a_gap() {
    for (late, gaps) in [(false, 0), (true, 1)] {
        let mut channel = MeterChannel::new(MeterConfig::default());
        channel.start(at(5_000));
        let now = at(5_000 + FIRST_READING.as_ticks() + u64::from(late));
        let reading = MeterReading {
            energy: 77,
            at: now,
        };
        let history = RangeHistory::steady(now, Range::Large);
        let bridge = bridge_of(Microamps::from_amps(300), 5_000, now.as_ticks() - 1);
        match channel.on_reading(reading, history) {
            ReadingOutcome::First => assert!(!late),
            outcome => {
                assert_eq!(outcome, ReadingOutcome::Rejected(Rejection::TooLate));
                channel.on_meter_restarted(reading, history, &bridge);
            }
        }
        let report = channel.report();
        let charge = report.charge_total.get() as f64 * 1e-9;
        near(charge, if late { 60.0 } else { 0.0 }, 1e-3);
        assert_eq!((report.gaps, report.at), (gaps, Some(now)));
        assert_eq!(report.rejected, 0);
    }
}

#[test]
fn a_meter_that_never_counted_begins_at_its_restart() {
    let mut channel = MeterChannel::new(MeterConfig::default());
    assert_eq!(
        channel.report(),
        MeterReport {
            resolution: MeterConfig::default().charge_per_count(Range::Small),
            uncertainty: Nanocoulombs(2),
            ..MeterReport::default()
        }
    );
    channel.on_meter_lost();
    let history = EdgeRecorder::new(at(0), false).history(at(0));
    let reading = MeterReading {
        energy: 77,
        at: at(0),
    };
    assert_eq!(
        channel.on_reading(reading, history),
        ReadingOutcome::Rejected(Rejection::Lost)
    );
    channel.on_meter_restarted(reading, history, &GapBridge::UNKNOWN);
    assert_eq!(channel.report().gaps, 0);
    assert_eq!(channel.report().charge_total, Nanocoulombs(0));
    assert!(!channel.report().lost);
    assert_eq!(
        channel.on_reading(reading, history),
        ReadingOutcome::Integrated
    );
}

#[test]
fn a_restart_ends_the_row_of_refusals() {
    let mut bench = Bench::new(MeterConfig::default(), Range::Small);
    let _ = (bench.read(1_000, 9_999), bench.read(1_000, 9_999));
    let reading = MeterReading {
        energy: bench.energy,
        at: at(2_000),
    };
    let history = bench.recorder.history(at(2_000));
    bench
        .channel
        .on_meter_restarted(reading, history, &GapBridge::UNKNOWN);
    let _ = bench.read(3_000, 9_999);
    assert!(!bench.channel.report().lost);
}

#[test]
fn another_calibration_keeps_what_was_counted() {
    let mut bench = Bench::new(MeterConfig::default(), Range::Small);
    let _ = bench.read(1_000_000, 3);
    let carry = bench.channel.booked.total;
    assert!(carry.carry != 0);
    let config = MeterConfig {
        gain: PerRange::both(Ppm(100_000)),
        ..MeterConfig::default()
    };
    bench.channel.set_config(config);
    assert_eq!(bench.channel.booked.total, carry);
    assert_eq!(bench.channel.config(), &config);
    let _ = bench.read(2_000_000, 10);
    near(
        bench.coulombs(),
        (3.0 + 11.0) * per_count(Range::Small),
        1e-8,
    );
}

/// A year at 250 A, read every 400 s: off by the scale's last digit alone.
#[test]
fn a_year_drifts_by_less_than_10_nanocoulombs() {
    let mut bench = Bench::new(MeterConfig::default(), Range::Large);
    let (mut counts, intervals) = (0_i128, 365 * 24 * 9);
    for interval in 1..=intervals {
        let step = 1_491_500 + (interval % 7) as i32;
        counts += i128::from(step);
        assert_eq!(
            bench.read(interval * 400_000_000, step),
            ReadingOutcome::Integrated
        );
    }
    // 600 A · 10⁹ nC · counts · 0.5 V · 4 · 2²⁵ / (product · 0.1 V · CLKIN), in whole numbers.
    let numerator = counts * 600_000_000_000 * 500 * 4 * (1 << 25);
    let exact = numerator / (1_677_722 * 100 * 3_579_545);
    let error = i128::from(bench.channel.report().charge_total.get()) - exact;
    assert!(error.abs() < 10, "{error} nC");
    assert!(exact > 7_880_000_000 * 1_000_000_000);
}

proptest! {
    /// F6: exact for every pair less than 2²³ apart, also where the register wraps.
    #[test]
    fn differences_are_exact_across_the_wrap(start: i32, difference in -(1 << 23) + 1..1_i32 << 23) {
        let register = |value: i32| (value << 8) >> 8;
        let earlier = register(start);
        let later = register(earlier.wrapping_add(difference));
        prop_assert_eq!(energy_difference(later, earlier), difference);
        // Bits above the 24 do not matter.
        prop_assert_eq!(energy_difference(later ^ (0x5A << 24), earlier), difference);
    }

    /// However the counts are split over readings, their charge is the same to the last digit.
    #[test]
    fn charge_does_not_depend_on_the_split(
        steps in prop::collection::vec(-10_000..10_000_i32, 1..200),
        offset in -100_000..100_000_i32,
        ppm in -5_000..5_000_i32,
        large: bool,
    ) {
        let range = Range::from_flag(large);
        let config = MeterConfig {
            offset: PerRange::both(Microamps(offset)),
            gain: PerRange::both(Ppm(ppm)),
            ..MeterConfig::default()
        };
        let mut split = Bench::new(config, range);
        let mut now = 0;
        for step in &steps {
            now += 1_000_001;
            prop_assert_eq!(split.read(now, *step), ReadingOutcome::Integrated);
        }
        let total: i32 = steps.iter().sum();
        let expected = i128::from(total) * i128::from(config.scale(range))
            - ((i128::from(offset) * i128::from(now)) << FRACTION_BITS);
        let sum = i128::from(split.channel.booked.total.whole) * i128::from(NANOCOULOMB)
            + i128::from(split.channel.booked.total.carry);
        prop_assert_eq!(sum, expected);
        if now <= LONGEST_INTERVAL.as_ticks() {
            let mut whole = Bench::new(config, range);
            prop_assert_eq!(whole.read(now, total), ReadingOutcome::Integrated);
            prop_assert_eq!(whole.channel.booked.total, split.channel.booked.total);
        }
        // And the throughputs are the net charge taken apart.
        let report = split.channel.report();
        let net = report.charge_out.get() - report.charge_in.get();
        prop_assert!((net - report.charge_total.get()).abs() <= 1);
    }

    #[test]
    fn the_accumulator_carries_exactly(parts in prop::collection::vec(any::<i64>(), 1..50)) {
        let mut sum = Accumulator::default();
        let mut exact = 0_i128;
        for part in parts {
            sum.add(i128::from(part));
            exact += i128::from(part);
        }
        prop_assert!((0..NANOCOULOMB).contains(&sum.carry));
        prop_assert_eq!(
            i128::from(sum.whole) * i128::from(NANOCOULOMB) + i128::from(sum.carry),
            exact
        );
        let rounded = i128::from(sum.rounded().get()) * i128::from(NANOCOULOMB);
        prop_assert!((rounded - exact).abs() * 2 <= i128::from(NANOCOULOMB));
    }

    #[test]
    fn factors_multiply(charge: i64, factor in -(9_i64 << 32)..9 << 32) {
        let wide = i128::from(charge) << 20;
        let exact = wide as f64 * factor as f64 / 2f64.powi(32);
        prop_assert!((times(wide, factor) as f64 - exact).abs() <= 2.0 + exact.abs() * 1e-12);
    }

    #[test]
    fn no_input_panics(
        currents in prop::array::uniform8(any::<i32>()),
        ppm in prop::array::uniform6(any::<i32>()),
        words in prop::array::uniform4(any::<u32>()),
        readings in prop::collection::vec(
            (any::<i32>(), any::<u64>(), any::<[u64; 5]>(), any::<[u32; 2]>(), any::<u16>(), any::<[bool; 3]>(), 0_u32..60),
            1..12,
        ),
    ) {
        let pair = |small, large| PerRange { small, large };
        let config = MeterConfig {
            full_scale: pair(Microamps(currents[0]), Microamps(currents[1])),
            gain: PerRange { small: Ppm(ppm[0]), large: Ppm(ppm[1]) },
            offset: pair(Microamps(currents[2]), Microamps(currents[3])),
            reference_error: Ppm(ppm[2]),
            divider_error: Ppm(ppm[3]),
            no_load: Ppm(ppm[4]),
            switching_current: Microamps(currents[4]),
            switching_tolerance: Microamps(currents[5]),
            slew_limit_amps_per_second: words[0],
            short_interval_us: words[1],
            front_end_delay_us: words[2],
            mean_window_ms: words[3],
            bridge_gain: Ppm(ppm[5]),
            bridge_offset: Microamps(currents[6]),
        };
        let mut channel = MeterChannel::new(config);
        let mut now = 0_u64;
        for (energy, gap, times, edges, coalesced, flags, shift) in readings {
            now = now.wrapping_add(gap >> shift);
            let history = RangeHistory {
                range: Range::from_flag(flags[0]),
                at: at(now),
                large: Duration::from_ticks(times[1]),
                edges: edges[0] % 4,
                coalesced,
                last_edge: flags[1].then_some(at(times[2])),
                watched: edges[1] % 2 == 0,
                high: Duration::from_ticks(times[3]),
            };
            let reading = MeterReading { energy, at: at(now) };
            let outcome = channel.on_reading(reading, history);
            if matches!(outcome, ReadingOutcome::Rejected(_)) && flags[2] {
                let bridge = GapBridge {
                    since: at(times[0]),
                    until: at(times[1]),
                    charge: Nanocoulombs(i64::from(currents[6]) << (edges[1] % 33)),
                    doubt: Nanocoulombs(i64::from(currents[5]) << (edges[1] % 33)),
                    current: (edges[1] % 3 != 0).then_some(Microamps(currents[7])),
                    holds: Duration::from_ticks(times[2]),
                };
                channel.on_meter_restarted(reading, history, &bridge);
            }
            let _ = channel.report();
        }
        let _ = [Range::Small, Range::Large].map(|range| (config.charge_per_count(range), config.no_load_current(range)));
    }
}
