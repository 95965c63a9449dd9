use super::*;
use crate::design_parameters::LARGE_FULL_SCALE;
use proptest::prelude::*;

const PERIOD: u64 = 31_250;
const POLL: u64 = 20_000;

fn at(us: u64) -> Instant {
    Instant::from_ticks(us)
}

fn agrees(outcome: Outcome) -> bool {
    matches!(outcome, Outcome::Agree { .. })
}

/// Both channels on a time axis of their own, each seeing what it is made to see.
struct Bench {
    compare: ChannelCompare,
    config: CompareConfig,
    now: u64,
    /// Length of a conversion in µs.
    period: u64,
    next_conversion: u64,
    next_meter: u64,
    /// nC of the meter.
    charge: i64,
    uncertainty: i64,
    gaps: u32,
    range: Range,
    usable: bool,
}

impl Bench {
    fn new() -> Self {
        Self {
            compare: ChannelCompare::new(),
            config: CompareConfig::default(),
            now: 0,
            period: PERIOD,
            next_conversion: PERIOD,
            next_meter: POLL,
            charge: 0,
            uncertainty: 0,
            gaps: 0,
            range: Range::Small,
            usable: true,
        }
    }

    fn resolution(&self) -> Nanocoulombs {
        error_budget::charge_per_count(self.range)
    }

    fn report(&self) -> MeterReport {
        // The register moves in counts.
        let count = self.resolution().get();
        MeterReport {
            at: Some(at(self.now)),
            energy: self.charge.div_euclid(count) as i32,
            charge_total: Nanocoulombs(self.charge.div_euclid(count) * count),
            uncertainty: Nanocoulombs(self.uncertainty),
            resolution: self.resolution(),
            gaps: self.gaps,
            ..MeterReport::default()
        }
    }

    /// Lets `ms` pass with these currents in mA; calls back after each report.
    fn run(&mut self, ms: u64, meter_ma: i64, converter_ma: i32) -> CompareReport {
        self.run_until(ms, meter_ma, converter_ma, |_| false);
        self.compare.report()
    }

    /// As `run`; stops where `done` says so and returns the time since the call, in ms.
    fn run_until(
        &mut self,
        ms: u64,
        meter_ma: i64,
        converter_ma: i32,
        done: impl Fn(&CompareReport) -> bool,
    ) -> Option<u64> {
        let (begin, end) = (self.now, self.now + ms * 1_000);
        while self.now < end {
            let next = self.next_conversion.min(self.next_meter).min(end);
            // mA · µs = nC.
            self.charge += meter_ma * (next - self.now) as i64;
            self.now = next;
            if self.now == self.next_conversion {
                let conversion = Conversion {
                    started: at(self.now - self.period + 300),
                    finished: at(self.now),
                    current: Microamps::from_milliamps(converter_ma),
                    range: self.range,
                    usable: self.usable,
                };
                let _ = self
                    .compare
                    .on_conversion(&self.config, &conversion, LARGE_FULL_SCALE);
                self.next_conversion += self.period;
            }
            if self.now == self.next_meter {
                let report = self.report();
                let _ = self.compare.on_meter(&self.config, &report);
                self.next_meter += POLL;
            }
            if done(&self.compare.report()) {
                return Some((self.now - begin) / 1_000);
            }
        }
        None
    }
}

#[test]
fn equal_currents_agree_in_both_windows() {
    for current in [0, 100, -20_000, 53_000] {
        let mut bench = Bench::new();
        let report = bench.run(25_000, current.into(), current);
        assert!(agrees(report.fast) && agrees(report.slow), "{report:?}");
        assert!(!report.frozen && !report.meter_lost);
        assert_eq!(report.disagreements, 0);
    }
}

#[test]
fn a_channel_that_reads_0_a_is_found() {
    for (meter, converter) in [(30_000, 0), (0, 30_000), (-30_000, 0)] {
        let mut bench = Bench::new();
        let found = bench.run_until(3_000, meter, converter, |report| {
            matches!(report.fast, Outcome::Disagree { .. })
        });
        // The first window, its conversion, and the one before the first report.
        assert!(found.unwrap() <= 1_100, "{found:?}");
        let Outcome::Disagree { difference, bound } = bench.compare.report().fast else {
            panic!("{:?}", bench.compare.report());
        };
        let expected = (meter - i64::from(converter)) * 1_000_000;
        assert!(
            (difference.get() - expected).abs() < 25_000_000,
            "{difference:?}"
        );
        // 8 · 10⁻³ of what the converter sees, its zero, two counts.
        let gain = 7_940 * i64::from(converter) / 1_000 * 1_000;
        let zero = 134_805 * 1_000;
        let counts = 2 * 6_704_762;
        let stated = gain + zero + counts;
        assert!(
            (bound.get() - stated).abs() < stated / 50,
            "{bound:?} {stated}"
        );
        assert_eq!(bench.compare.report().disagreements, 1);
    }
}

#[test]
fn small_differences_are_within_the_bound_and_larger_ones_are_not() {
    // 0.79 % of 40 A and 135 mA of zero make 453 mA; the fast window adds two counts in a second, 13 mA.
    assert!(agrees(Bench::new().run(12_000, 40_400, 40_000).fast));
    assert!(agrees(Bench::new().run(12_000, 40_400, 40_000).slow));
    assert!(agrees(Bench::new().run(12_000, 40_440, 40_000).fast));
    for (meter, converter) in [(40_500, 40_000), (-40_500, -40_000), (39_500, 40_000)] {
        let report = Bench::new().run(22_000, meter, converter);
        assert!(
            matches!(report.fast, Outcome::Disagree { .. }),
            "{report:?}"
        );
        assert!(
            matches!(report.slow, Outcome::Disagree { .. }),
            "{report:?}"
        );
    }
}

#[test]
fn the_meters_own_doubt_widens_the_bound() {
    let mut bench = Bench::new();
    let _ = bench.run(500, 20_000, 20_000);
    bench.uncertainty = 1_000_000_000;
    // 0.7 C in a second.
    let report = bench.run(700, 20_700, 20_000);
    assert!(agrees(report.fast));
    let report = bench.run(1_500, 20_700, 20_000);
    assert!(matches!(report.fast, Outcome::Disagree { .. }));
}

#[test]
fn a_changing_current_is_no_disagreement() {
    let mut bench = Bench::new();
    for step in 0..200_i32 {
        let current = (step * 37) % 50_000 - 25_000;
        let report = bench.run(97, current.into(), current);
        assert!(
            !matches!(report.fast, Outcome::Disagree { .. }),
            "{report:?}"
        );
    }
}

/// A conversion that began before the last count is no evidence: the first that is ends 190 ms after it at 8 SPS.
#[test]
fn a_slow_conversion_under_way_at_the_last_count_is_no_frozen_meter() {
    let mut bench = Bench::new();
    bench.period = 125_000;
    bench.next_conversion = 125_000;
    let _ = bench.run(2_560, 50_000, 50_000);
    let found = bench.run_until(3_000, 0, 50_000, |report| report.frozen);
    assert!((190..=500).contains(&found.unwrap()), "{found:?} ms");
}

/// The current stops while a conversion is under way: its charge was counted before the last count, in part.
#[test]
fn a_current_that_stops_is_no_frozen_meter() {
    for period in [8_000, PERIOD, 125_000] {
        for stop_ms in 0..40 {
            let mut bench = Bench::new();
            bench.period = period;
            bench.next_conversion = period;
            let _ = bench.run(2_500 + stop_ms, -20_000, -20_000);
            let rest_us = bench.next_conversion - bench.now;
            let rest_ms = if rest_us < period {
                rest_us.div_ceil(1_000)
            } else {
                0
            };
            // The conversion under way says −20 A, or anything between.
            let first = bench.run(rest_ms, 0, -20_000);
            let then = bench.run_until(2_000, 0, 0, |report| report.frozen);
            assert!(!first.frozen, "{period} µs, {stop_ms} ms");
            assert_eq!(then, None, "{period} µs, {stop_ms} ms");
        }
    }
}

#[test]
fn a_frozen_meter_is_found_within_a_second() {
    for range in [Range::Small, Range::Large] {
        let mut bench = Bench::new();
        bench.range = range;
        let least = bench.config.frozen_current(range, bench.resolution());
        let current = least.to_milliamps() + 1;
        let _ = bench.run(2_500, current.into(), current);
        assert!(!bench.compare.report().frozen);
        let found = bench.run_until(3_000, 0, -current, |report| report.frozen);
        assert!(found.unwrap() <= 1_000, "{found:?} ms at {current} mA");
        assert!(found.unwrap() > 100);
        // It counts again.
        let report = bench.run(200, (current * 10).into(), current * 10);
        assert!(!report.frozen);
    }
    // A current too small to say so.
    let mut bench = Bench::new();
    let report = bench.run(20_000, 0, 130);
    assert!(!report.frozen);
    let config = CompareConfig::default();
    let count = error_budget::charge_per_count(Range::Small);
    // 1.25 · (2 · 134.8 mA + 6 · 6.7 mC/s).
    assert_eq!(
        config.frozen_current(Range::Small, count).to_milliamps(),
        387
    );
}

#[test]
fn without_usable_conversions_nothing_is_decided() {
    let mut bench = Bench::new();
    let _ = bench.run(1_500, 10_000, 10_000);
    assert!(agrees(bench.compare.report().fast));
    bench.usable = false;
    let report = bench.run(3_000, 10_000, 0);
    assert_eq!(
        (report.fast, report.slow),
        (Outcome::Undecided, Outcome::Undecided)
    );
    bench.usable = true;
    let report = bench.run(2_500, 10_000, 10_000);
    assert!(agrees(report.fast));
}

#[test]
fn too_large_a_share_of_gaps_leaves_a_window_undecided() {
    let mut bench = Bench::new();
    bench.config.short_gap_ms = 50;
    let outcomes = |bench: &mut Bench, every: u64| {
        let mut last = Outcome::Undecided;
        for step in 0..120_u64 {
            bench.usable = step % every == 0;
            bench.run_until(31, 10_000, 10_000, |_| false);
            last = bench.compare.report().fast;
        }
        last
    };
    // One conversion in six is 17 %.
    assert_eq!(outcomes(&mut bench, 6), Outcome::Undecided);
    // With every second one spoiled, half is covered and the gaps of 31 ms between.
    assert!(agrees(outcomes(&mut bench, 2)));
}

#[test]
fn spoiled_conversions_widen_the_bound_by_the_gap() {
    let before = Conversion {
        started: at(0),
        finished: at(10),
        current: Microamps(5),
        range: Range::Small,
        usable: true,
    };
    let after = Conversion {
        started: at(20),
        finished: at(30),
        current: Microamps(-9),
        ..before
    };
    let config = CompareConfig::default();
    assert_eq!(gap_doubt(&config, &before, &after, false), 7);
    assert_eq!(gap_doubt(&config, &before, &after, true), 14);
    let late = Conversion {
        started: at(101_010),
        ..after
    };
    assert_eq!(gap_doubt(&config, &before, &late, false), 14);
    let just = Conversion {
        started: at(101_009),
        ..after
    };
    assert_eq!(gap_doubt(&config, &before, &just, false), 7);
    assert_eq!(midpoint(Microamps(10), Microamps(-4)), 3);
}

#[test]
fn repeated_conversions_add_no_time() {
    let mut compare = ChannelCompare::default();
    let config = CompareConfig::default();
    let conversion = |started, finished| Conversion {
        started: at(started),
        finished: at(finished),
        current: Microamps(1_000),
        range: Range::Small,
        usable: true,
    };
    let _ = compare.on_conversion(&config, &conversion(0, 100), LARGE_FULL_SCALE);
    let _ = compare.on_conversion(&config, &conversion(100, 200), LARGE_FULL_SCALE);
    let once = compare.integral;
    assert_eq!((once.charge, once.covered), (100, 100));
    let _ = compare.on_conversion(&config, &conversion(100, 200), LARGE_FULL_SCALE);
    let _ = compare.on_conversion(&config, &conversion(300, 250), LARGE_FULL_SCALE);
    assert_eq!(compare.integral, once);
    // A gap is interpolated.
    let _ = compare.on_conversion(&config, &conversion(250, 300), LARGE_FULL_SCALE);
    assert_eq!(compare.integral.covered, 200);
    assert_eq!(compare.integral.charge, 200);
}

#[test]
fn a_report_that_comes_late_is_passed_over() {
    let mut bench = Bench::new();
    let _ = bench.run(500, 20_000, 20_000);
    // Of an instant before the newest conversion, and with a charge that would disagree.
    bench.compare.fast = None;
    let late = MeterReport {
        at: Some(at(bench.now - 60_000)),
        charge_total: Nanocoulombs(0),
        ..bench.report()
    };
    let _ = bench.compare.on_meter(&bench.config, &late);
    assert!(bench.compare.pending.is_some());
    let report = bench.run(2_000, 20_000, 20_000);
    assert!(agrees(report.fast));
    assert_eq!(report.disagreements, 0);
}

/// The converter reads by the new factors at once, the meter 60 ms later.
#[test]
fn new_factors_are_not_compared_with_old_ones() {
    let mut bench = Bench::new();
    let _ = bench.run(2_400, 0, 0);
    bench.compare.restart_at(at(bench.now + 60_000));
    let _ = bench.run(60, 0, 3_000);
    for _ in 0..30 {
        let report = bench.run(100, 3_000, 3_000);
        assert_eq!(report.disagreements, 0, "{report:?}");
        assert!(!report.frozen);
    }
    assert!(agrees(bench.compare.report().fast));
}

#[test]
fn a_lost_meter_and_a_bridged_gap_are_not_compared() {
    let mut bench = Bench::new();
    let _ = bench.run(2_500, 10_000, 10_000);
    let lost = MeterReport {
        lost: true,
        ..bench.report()
    };
    let report = bench.compare.on_meter(&bench.config, &lost);
    assert!(report.meter_lost);
    assert_eq!(report.fast, Outcome::Undecided);
    // Restarted: what lay in the gap is the converter's own.
    bench.gaps = 1;
    bench.charge += 50_000_000_000;
    let report = bench.run(900, 10_000, 10_000);
    assert!(!report.meter_lost);
    assert_eq!(report.fast, Outcome::Undecided);
    let report = bench.run(1_500, 10_000, 10_000);
    assert!(agrees(report.fast));
    assert_eq!(report.disagreements, 0);
    // A meter that never counted says nothing.
    let mut compare = ChannelCompare::new();
    let report = compare.on_meter(&bench.config, &MeterReport::default());
    assert_eq!(report, CompareReport::default());
}

#[test]
fn what_agrees_declares_nothing() {
    let mut bench = Bench::new();
    for ma in [40_000, -5_000, 0, 20] {
        let report = bench.run(25_000, i64::from(ma), ma);
        assert_eq!(report.miscounted, Nanocoulombs::ZERO, "{ma} mA");
    }
}

#[test]
fn a_meter_stands_still_until_it_counts_even_with_no_converter() {
    let mut bench = Bench::new();
    bench.run(3_000, 40_000, 40_000);
    assert!(bench.run(1_000, 0, 40_000).frozen);
    bench.usable = false;
    assert!(bench.run(3_000, 0, 500_000).frozen);
    let now = bench.now;
    bench.compare.restart_at(at(now));
    assert!(bench.run(1_000, 0, 0).frozen);
    bench.usable = true;
    assert!(bench.run(500, 0, 40_000).frozen);
    let report = bench.run(1_000, 40_000, 40_000);
    assert!(!report.frozen);
    let missed = 40_000 * 1_500_000 + 500_000 * 3_000_000_i64;
    let declared = report.miscounted.get();
    assert!(declared > missed, "{declared} of {missed}");
    // Full scale for as long as nobody saw anything.
    assert!(
        declared < 600_000 * 4_100_000 + 70_000_000_000,
        "{declared}"
    );
}

#[test]
fn a_wrong_scale_is_declared_as_long_as_it_lasts() {
    // 20 % is found in every fast window, 1.3 % more than what the fast one allows for in the slow one alone.
    for (share_ppm, seconds) in [(1_200_000, 21), (800_000, 21), (1_040_000, 61)] {
        let mut bench = Bench::new();
        bench.run(11_000, 40_000, 40_000);
        let wrong = 40_000 * share_ppm / 1_000_000;
        bench.run(seconds * 1_000, wrong, 40_000);
        let report = bench.run(31_000, 40_000, 40_000);
        let off = (wrong - 40_000).abs() * seconds as i64 * 1_000_000;
        let declared = report.miscounted.get();
        assert!(
            declared > off - off / 10,
            "{share_ppm}: {declared} of {off}"
        );
        assert!(declared < 3 * off, "{share_ppm}: {declared} of {off}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    /// Both see the same current, whatever it does: no disagreement, never frozen.
    #[test]
    fn alike_channels_never_disagree(
        steps in prop::collection::vec((-50_000..50_000_i32, 1_u64..2_000), 1..30),
    ) {
        let mut bench = Bench::new();
        for (current, ms) in steps {
            // Whole conversions, so that each is a mean of one current.
            let ms = ms.div_ceil(125) * 125;
            let report = bench.run(ms, current.into(), current);
            prop_assert!(!matches!(report.fast, Outcome::Disagree { .. }), "{:?}", report);
            prop_assert!(!matches!(report.slow, Outcome::Disagree { .. }), "{:?}", report);
            prop_assert!(!report.frozen);
        }
    }

    #[test]
    fn no_input_panics(
        words in prop::array::uniform5(any::<u32>()),
        signed in prop::array::uniform4(any::<i32>()),
        inputs in prop::collection::vec(
            (any::<[u64; 3]>(), any::<[i64; 3]>(), any::<i32>(), any::<[bool; 4]>(), any::<u32>()), 1..12),
    ) {
        let config = CompareConfig {
            fast_window_ms: words[0],
            slow_window_ms: words[1],
            gain_tolerance: Ppm(signed[0]),
            zero_tolerance: PerRange { small: Microamps(signed[1]), large: Microamps(signed[2]) },
            covered_share: Ppm(signed[3]),
            short_gap_ms: words[2],
        };
        let _ = config.frozen_current(Range::Small, Nanocoulombs(i64::from(signed[0]) << 32));
        let mut compare = ChannelCompare::new();
        for (times, charges, current, flags, gaps) in inputs {
            let _ = compare.on_conversion(&config, &Conversion {
                started: at(times[0]),
                finished: at(times[1]),
                current: Microamps(current),
                range: Range::from_flag(flags[0]),
                usable: flags[1],
            }, Microamps(signed[0]));
            let _ = compare.on_meter(&config, &MeterReport {
                at: flags[2].then_some(at(times[2])),
                energy: if flags[0] { current } else { 0 },
                charge_total: Nanocoulombs(charges[0]),
                uncertainty: Nanocoulombs(charges[1]),
                resolution: Nanocoulombs(charges[2]),
                lost: flags[3],
                gaps: gaps % 2,
                ..MeterReport::default()
            });
        }
    }

    /// However long the meter stands still, and whatever flows meanwhile: what it has missed is declared once it counts
    /// again, and not much more.
    #[test]
    fn what_a_meter_that_stood_still_has_missed_is_declared(
        steps in prop::collection::vec((300_u64..3_000, 5_000_i32..60_000), 1..4),
        sign in prop::bool::ANY,
        begin in 0_u64..40,
    ) {
        let sign = if sign { 1 } else { -1 };
        let mut bench = Bench::new();
        bench.run(3_000 + begin, 40_000, 40_000);
        let before = bench.compare.report().miscounted;
        prop_assert_eq!(before, Nanocoulombs::ZERO);
        let (mut missed, mut largest, mut time) = (0, 0, 0);
        let mut found = false;
        for (ms, ma) in &steps {
            let ma = sign * ma;
            found |= bench.run(*ms, 0, ma).frozen;
            missed += i64::from(ma) * (*ms as i64) * 1_000;
            largest = largest.max(i64::from(ma.abs()));
            time += *ms as i64;
        }
        prop_assume!(found);
        let report = bench.run(2_000, i64::from(sign) * 10_000, sign * 10_000);
        prop_assert!(!report.frozen);
        let declared = report.miscounted.get();
        prop_assert!(declared >= missed.abs(), "{} of {}", declared, missed);
        // Four conversions at the ends, two per cent and an ampere; the steps between conversions.
        let slack = 250 * largest.max(40_000) * 1_000 + (largest / 20 + 1_000) * time * 1_000;
        prop_assert!(declared <= missed.abs() + slack, "{} of {}", declared, missed);
    }
}
