use super::*;
use crate::units::Microvolts;
use proptest::prelude::*;
use std::vec::Vec;

fn at(us: u64) -> Instant {
    Instant::from_ticks(us)
}

fn us(ticks: u64) -> Duration {
    Duration::from_ticks(ticks)
}

#[test]
fn times_and_edges_add_up() {
    let mut recorder = EdgeRecorder::new(at(100), false);
    let start = recorder.history(at(100));
    assert_eq!(start, RangeHistory::steady(at(100), Range::Small));
    recorder.on_edge(at(150), true);
    recorder.on_edge(at(170), false);
    let history = recorder.history(at(200));
    assert_eq!(
        history,
        RangeHistory {
            range: Range::Small,
            at: at(200),
            large: us(20),
            edges: 2,
            coalesced: 0,
            last_edge: Some(at(170)),
            watched: true,
            high: us(20),
        }
    );
    let interval = history.since(&start);
    assert_eq!(
        interval,
        RangeInterval {
            first: Range::Small,
            last: Range::Small,
            edges: 2,
            missed_edges: false,
            small: us(80),
            large: us(20),
            since_last_edge: Some(us(30)),
        }
    );
    assert_eq!(interval.length(), us(100));
    assert_eq!(interval.time_in(Range::Small), us(80));
    assert_eq!(interval.time_in(Range::Large), us(20));
    assert_eq!(interval.shorter(), Range::Large);
    // The copy did not move the recorder.
    assert_eq!(recorder.history(at(200)), history);
}

#[test]
fn the_shorter_range() {
    let mut interval =
        RangeHistory::steady(at(0), Range::Small).since(&RangeHistory::steady(at(0), Range::Large));
    assert_eq!(
        (interval.first, interval.last),
        (Range::Large, Range::Small)
    );
    // Alike: the last.
    assert_eq!(interval.shorter(), Range::Small);
    interval.small = us(1);
    assert_eq!(interval.shorter(), Range::Large);
    interval.large = us(2);
    assert_eq!(interval.shorter(), Range::Small);
}

#[test]
fn an_edge_without_a_change_is_two() {
    let mut recorder = EdgeRecorder::new(at(0), false);
    let before = recorder.history(at(0));
    recorder.on_edge(at(10), false);
    let history = recorder.history(at(20));
    assert_eq!((history.edges, history.coalesced), (2, 1));
    assert_eq!(history.range, Range::Small);
    assert_eq!(history.last_edge, Some(at(10)));
    assert!(history.since(&before).missed_edges);
    assert!(!history.since(&history).missed_edges);
}

#[test]
fn the_coalesced_counter_stops_and_then_marks_every_interval_with_edges() {
    let mut recorder = EdgeRecorder::new(at(0), true);
    for _ in 0..70_000 {
        recorder.on_edge(at(1), true);
    }
    let before = recorder.history(at(1));
    assert_eq!(before.coalesced, u16::MAX);
    assert_eq!(before.edges, 140_000);
    assert!(!recorder.history(at(2)).since(&before).missed_edges);
    recorder.on_edge(at(3), false);
    assert!(recorder.history(at(4)).since(&before).missed_edges);
}

#[test]
fn a_missed_edge_is_found_by_looking() {
    let mut recorder = EdgeRecorder::new(at(0), false);
    assert!(!recorder.observe(at(5), false));
    assert_eq!(recorder.history(at(5)).edges, 0);
    assert!(recorder.observe(at(7), true));
    let history = recorder.history(at(9));
    assert_eq!((history.edges, history.range), (1, Range::Large));
    assert_eq!(history.large, us(2));
}

#[test]
fn unwatched_time_is_divided_by_the_gated_counter() {
    let mut recorder = EdgeRecorder::new(at(0), false);
    let gated = |recorder: &EdgeRecorder, now, high| RangeHistory {
        high: us(high),
        ..recorder.history(at(now))
    };
    let start = gated(&recorder, 10, 0);
    recorder.suspend();
    let masked = gated(&recorder, 20, 7);
    let resting = gated(&recorder, 25, 11);
    recorder.resume(at(30), false);
    let resumed = gated(&recorder, 40, 12);
    let later = gated(&recorder, 90, 99);
    for (earlier, later, missed_edges, small, large) in [
        (start, masked, true, 3, 7),
        // Neither end is watched.
        (masked, resting, true, 1, 4),
        (resting, resumed, true, 14, 1),
        (start, resumed, true, 18, 12),
        // Where no edge is missed the time stamps are the exact ones.
        (resumed, later, false, 50, 0),
        // The counter is read a little later than the time.
        (masked, later, true, 0, 70),
    ] {
        let interval = later.since(&earlier);
        assert_eq!(interval.missed_edges, missed_edges);
        assert_eq!((interval.small, interval.large), (us(small), us(large)));
    }
    assert_eq!((resumed.edges, resumed.coalesced), (2, 1));
    // With the level changed there is an edge more.
    recorder.suspend();
    recorder.resume(at(95), true);
    let history = recorder.history(at(97));
    assert_eq!((history.edges, history.coalesced), (5, 2));
    assert_eq!(history.range, Range::Large);
    assert_eq!(history.last_edge, Some(at(95)));
}

#[test]
fn time_never_runs_backwards() {
    let mut recorder = EdgeRecorder::new(at(100), false);
    recorder.on_edge(at(50), true);
    let history = recorder.history(at(20));
    assert_eq!(history.at, at(100));
    assert_eq!(history.last_edge, Some(at(100)));
    assert_eq!(history.large, us(0));
    assert_eq!(recorder.history(at(110)).large, us(10));
}

#[test]
fn intervals_are_exact_across_the_wrap_of_the_counter() {
    let mut early = RangeHistory::steady(at(0), Range::Small);
    early.edges = u32::MAX - 1;
    let mut late = early;
    late.edges = 3;
    assert_eq!(late.since(&early).edges, 5);
}

#[test]
fn flag_levels_name_the_ranges() {
    assert_eq!(Range::from_flag(false), Range::Small);
    assert_eq!(Range::from_flag(true), Range::Large);
    assert_eq!(Range::Small.other(), Range::Large);
    assert_eq!(Range::Large.other(), Range::Small);
    assert_eq!(Range::default(), Range::Small);
}

#[test]
fn settling_and_conversions_at_an_edge() {
    let settling = us(50);
    let mut recorder = EdgeRecorder::new(at(0), false);
    let none = recorder.history(at(0));
    assert!(none.settled(at(0), settling));
    assert!(!none.conversion_spoiled(at(0), settling));
    recorder.on_edge(at(100), true);
    let history = recorder.history(at(1_000));
    assert!(!history.settled(at(149), settling));
    assert!(history.settled(at(150), settling));
    // Began after the settling time, within it, at the edge, before the edge.
    assert!(!history.conversion_spoiled(at(150), settling));
    assert!(history.conversion_spoiled(at(149), settling));
    assert!(history.conversion_spoiled(at(100), settling));
    assert!(history.conversion_spoiled(at(99), settling));
    assert!(history.conversion_spoiled(at(100), us(0)));
    assert!(!history.conversion_spoiled(at(101), us(0)));
}

#[test]
fn chatter_is_reported_at_the_threshold_and_withdrawn_after_a_calm_window() {
    let config = ChatterConfig {
        window_ms: 100,
        edges: 4,
    };
    let mut detector = ChatterDetector::new();
    let mut recorder = EdgeRecorder::new(at(0), false);
    let _ = detector.step(&config, &recorder.history(at(0)));
    let mut flag = false;
    for time in [1_000, 2_000, 3_000] {
        flag = !flag;
        recorder.on_edge(at(time), flag);
        assert!(!detector.step(&config, &recorder.history(at(time))).active);
    }
    recorder.on_edge(at(4_000), !flag);
    let report = detector.step(&config, &recorder.history(at(4_000)));
    assert!(report.active);
    assert_eq!((report.edges_in_window, report.episodes), (4, 1));
    // Still in the window, it stays; so it does at the window's end.
    assert!(detector.step(&config, &recorder.history(at(99_999))).active);
    let report = detector.step(&config, &recorder.history(at(100_000)));
    assert!(report.active);
    assert_eq!(report.edges_in_last_window, 4);
    assert_eq!(report.edges_in_window, 0);
    // A calm window.
    assert!(
        detector
            .step(&config, &recorder.history(at(150_000)))
            .active
    );
    let report = detector.step(&config, &recorder.history(at(200_000)));
    assert!(!report.active);
    assert_eq!((report.edges_in_last_window, report.episodes), (0, 1));
    assert_eq!(ChatterDetector::default(), ChatterDetector::new());
}

#[test]
fn a_threshold_of_no_edges_counts_as_one() {
    let config = ChatterConfig {
        window_ms: 1,
        edges: 0,
    };
    let mut detector = ChatterDetector::new();
    let history = RangeHistory::steady(at(0), Range::Small);
    assert!(!detector.step(&config, &history).active);
    assert_eq!(ChatterConfig::default().edges, 10);
}

/// Both readings of a level, from the level as the small sensor's current.
fn observation(
    time_ms: u64,
    flag: Range,
    level_as_small: f64,
    small_sensor: Option<f64>,
) -> FlagObservation {
    let microamps = |amps: f64| Microamps((amps * 1e6) as i32);
    FlagObservation {
        at: at(time_ms * 1_000),
        flag,
        passed_as_small: microamps(level_as_small),
        passed_as_large: microamps(level_as_small * 10.0),
        small_sensor: small_sensor.map(microamps),
        full_scale: design::LARGE_FULL_SCALE,
    }
}

/// The verdict once the debounce time is over.
fn verdict(flag: Range, level_as_small: f64, small_sensor: Option<f64>) -> FlagReport {
    let config = FlagPlausibilityConfig::default();
    let mut plausibility = FlagPlausibility::new();
    let mut report = plausibility.report();
    for step in 0..=8 {
        report = plausibility.step(
            &config,
            &observation(step * 25, flag, level_as_small, small_sensor),
        );
    }
    report
}

#[test]
fn what_the_level_alone_decides() {
    for sign in [1.0, -1.0] {
        // Small sensor at its threshold and its margin: nothing wrong.
        assert!(!verdict(Range::Small, sign * 53.3, None).implausible);
        assert!(!verdict(Range::Small, sign * 56.3, None).implausible);
        let beyond = verdict(Range::Small, sign * 56.4, None);
        assert!(beyond.implausible);
        assert_eq!((beyond.expected, beyond.passed), (Some(Range::Large), None));
        assert_eq!(beyond.episodes, 1);
        // Large sensor: 46 A is within hysteresis and zero error, 45 A is not.
        assert!(!verdict(Range::Large, sign * 4.6, None).implausible);
        assert!(!verdict(Range::Large, sign * 40.0, None).implausible);
        let below = verdict(Range::Large, sign * 4.5, None);
        assert!(below.implausible);
        assert_eq!((below.expected, below.passed), (Some(Range::Small), None));
    }
    assert_eq!(verdict(Range::Small, 50.0, None).expected, None);
    assert_eq!(
        verdict(Range::Small, 40.0, None).expected,
        Some(Range::Small)
    );
}

#[test]
fn the_small_sensors_own_level_decides_the_rest() {
    for sign in [1.0, -1.0] {
        // Flag line stuck high, switch at the small sensor: 30 A reads 300 A.
        let stuck_high = verdict(Range::Large, sign * 30.0, Some(sign * 30.0));
        assert!(stuck_high.implausible);
        assert_eq!(stuck_high.passed, Some(Range::Small));
        assert_eq!(stuck_high.expected, Some(Range::Small));
        // Flag line stuck low, switch at the large sensor: 300 A reads 30 A, the small sensor is saturated.
        let stuck_low = verdict(Range::Small, sign * 30.0, Some(sign * 60.0));
        assert!(stuck_low.implausible);
        assert_eq!(stuck_low.passed, Some(Range::Large));
        assert_eq!(stuck_low.expected, Some(Range::Large));
        // OR gate stuck high: the large sensor is passed and flagged, only the current is too low for it.
        let gate = verdict(Range::Large, sign * 3.0, Some(sign * 30.0));
        assert!(gate.implausible);
        assert_eq!(
            (gate.passed, gate.expected),
            (Some(Range::Large), Some(Range::Small))
        );
        // All in order.
        let small = verdict(Range::Small, sign * 30.0, Some(sign * 31.0));
        assert!(!small.implausible);
        assert_eq!(small.passed, Some(Range::Small));
        let large = verdict(Range::Large, sign * 20.0, Some(sign * 60.0));
        assert!(!large.implausible);
        assert_eq!(large.passed, Some(Range::Large));
        assert_eq!(large.expected, Some(Range::Large));
        // Both saturated: either is possible.
        assert_eq!(
            verdict(Range::Large, sign * 59.9, Some(sign * 60.0)).passed,
            None
        );
        // A level of the wrong sign fits neither.
        assert_eq!(
            verdict(Range::Large, sign * -20.0, Some(sign * 60.0)).passed,
            None
        );
    }
    // A large sensor that stands at half its supply: 0 A, and the small one at its end.
    assert!(verdict(Range::Large, 0.0, Some(60.0)).implausible);
    assert!(verdict(Range::Large, 0.0, Some(-60.0)).implausible);
    assert!(!verdict(Range::Large, 15.0, Some(60.0)).implausible);
    // Near 0 A the two lie within the tolerance.
    let zero = verdict(Range::Small, 0.5, Some(0.6));
    assert_eq!(zero.passed, None);
    assert!(!zero.implausible);
    // 9 A of the large sensor are told from 0.9 A of the small one.
    let large = verdict(Range::Small, 0.9, Some(9.0));
    assert_eq!(large.passed, Some(Range::Large));
    assert!(large.implausible);
    // Not saturated: the level of the large sensor is compared itself. 55 A and 580 A are not the same.
    assert_eq!(
        verdict(Range::Small, 55.0, Some(55.0)).passed,
        Some(Range::Small)
    );
    assert_eq!(
        verdict(Range::Large, 5.5, Some(55.0)).passed,
        Some(Range::Large)
    );
    assert_eq!(verdict(Range::Large, 4.6, Some(55.0)).passed, None);
}

/// 8 A are 67 mV at the pin: an offset of the network's channel, and no matter of the switch.
#[test]
fn an_own_level_that_is_off_does_not_contradict_a_small_current() {
    for sign in [1.0, -1.0] {
        for off in (-79..=79).map(|tenth| f64::from(tenth) * 0.1) {
            for current in (0..=200).map(|tenth| f64::from(tenth) * 0.1 * sign) {
                let report = verdict(Range::Small, current, Some(current + off));
                assert!(!report.implausible, "{current} A, off by {off} A");
            }
        }
    }
}

#[test]
fn a_contradiction_is_debounced_both_ways_and_found_within_200_ms() {
    let config = FlagPlausibilityConfig::default();
    let mut plausibility = FlagPlausibility::new();
    let (mut found, mut cleared) = (None, None);
    // A conversion every 31 ms; the contradiction lasts from 0 to 620 ms.
    for step in 0..60_u64 {
        let time = step * 31;
        let level = if time < 620 { 58.0 } else { 20.0 };
        let report = plausibility.step(&config, &observation(time, Range::Small, level, None));
        if report.implausible {
            found.get_or_insert(time);
        } else if found.is_some() {
            cleared.get_or_insert(time);
        }
    }
    // Up to 31 ms pass before the first conversion that shows it.
    assert!(found.unwrap() + 31 <= 200, "{found:?}");
    assert_eq!(found, Some(93));
    assert_eq!(cleared, Some(620 + 93));
    assert_eq!(plausibility.report().episodes, 1);
    // A short one is not reported.
    let mut plausibility = FlagPlausibility::new();
    for (time, level) in [
        (0, 58.0),
        (60, 58.0),
        (89, 58.0),
        (90, 20.0),
        (100, 58.0),
        (189, 58.0),
    ] {
        assert!(
            !plausibility
                .step(&config, &observation(time, Range::Small, level, None))
                .implausible
        );
    }
    assert!(
        plausibility
            .step(&config, &observation(190, Range::Small, 58.0, None))
            .implausible
    );
}

/// Looks every 31 ms at a flag that is stuck from 0.5 to `end_ms`, the small sensor being passed or the large one.
fn miscounted(flag: Range, passed: Range, amps: f64, end_ms: u64, network: bool) -> FlagReport {
    let config = FlagPlausibilityConfig::default();
    let mut plausibility = FlagPlausibility::new();
    let microamps = |amps: f64| Microamps((amps * 1e6) as i32);
    let level = match passed {
        Range::Small => amps.clamp(-66.0, 66.0),
        Range::Large => amps / 10.0,
    };
    for ms in (0..end_ms + 500).step_by(31) {
        let is_stuck = (500..end_ms).contains(&ms);
        plausibility.step(
            &config,
            &FlagObservation {
                at: at(ms * 1_000),
                flag: if is_stuck { flag } else { passed },
                passed_as_small: microamps(level),
                passed_as_large: microamps(10.0 * level),
                small_sensor: network.then(|| microamps(amps.clamp(-66.0, 66.0))),
                full_scale: design::LARGE_FULL_SCALE,
            },
        );
    }
    plausibility.report()
}

#[test]
fn what_a_stuck_flag_has_miscounted_is_declared() {
    for (flag, passed, amps, network) in [
        (Range::Large, Range::Small, 30.0, true),
        (Range::Large, Range::Small, -30.0, true),
        (Range::Large, Range::Small, 4.0, true),
        (Range::Large, Range::Small, 4.0, false),
        (Range::Small, Range::Large, 100.0, true),
        (Range::Small, Range::Large, -250.0, true),
    ] {
        let report = miscounted(flag, passed, amps, 2_500, network);
        assert!(report.episodes == 1 && !report.implausible, "{report:?}");
        let counted = if flag == Range::Large {
            10.0 * amps
        } else {
            amps / 10.0
        };
        let off_c = (counted - amps).abs() * 2.0;
        let declared_c = report.miscounted.get() as f64 / 1e9;
        assert!(declared_c >= off_c, "{amps} A: {declared_c} of {off_c} C");
        // A look more at either end, and the margin of a sensor's own level.
        let margin_c = 2.2 * (f64::from(design::FLAG_MARGIN_BELOW.get()) / 1e6);
        assert!(
            declared_c <= 1.05 * off_c + margin_c,
            "{amps} A: {declared_c} of {off_c} C"
        );
    }
    // Not long enough to be reported: one look, from the one before it to the one after.
    let short = miscounted(Range::Large, Range::Small, 30.0, 550, true);
    assert_eq!(short.episodes, 0);
    assert_eq!(short.miscounted, Nanocoulombs(270 * 62_000_000));
    // An OR gate that is stuck: the flag says what is passed.
    let stuck_gate = miscounted(Range::Large, Range::Large, 30.0, 2_500, true);
    assert!(stuck_gate.implausible, "{stuck_gate:?}");
    assert_eq!(stuck_gate.miscounted, Nanocoulombs::ZERO);
}

#[test]
fn unwatched_edges_spoil_a_conversion() {
    let mut recorder = EdgeRecorder::new(at(0), false);
    let spoiled = |recorder: &EdgeRecorder| {
        recorder
            .history(at(9_000))
            .conversion_spoiled(at(8_000), us(5_000))
    };
    assert!(!spoiled(&recorder));
    recorder.suspend();
    assert!(spoiled(&recorder));
}

#[test]
fn the_flags_levels_are_those_of_the_document() {
    // 4.5 V and 0.5 V at ±53.33 A of the small sensor.
    assert_eq!(design::COMPARATOR_HIGH, Microvolts(4_500_000));
    // The conversion that the edge falls into, the first one after it, the debounce in whole conversions, a tick.
    const { assert!((2 + design::FLAG_DEBOUNCE_MS.div_ceil(32)) * 32 + 10 < 200) };
}

proptest! {
    /// Whatever the chain of edges and looks, times and edges between any two histories add up.
    #[test]
    fn histories_add_up(steps in prop::collection::vec((0_u64..1_000, any::<bool>(), any::<bool>()), 1..50)) {
        let mut recorder = EdgeRecorder::new(at(0), false);
        let mut histories: Vec<RangeHistory> = std::vec![recorder.history(at(0))];
        let (mut now, mut large) = (0, 0);
        let mut level = false;
        for (gap, flag, interrupt) in steps {
            now += gap;
            large += if level { gap } else { 0 };
            level = flag;
            if interrupt {
                recorder.on_edge(at(now), flag);
            } else {
                let _ = recorder.observe(at(now), flag);
            }
            histories.push(recorder.history(at(now)));
        }
        let last = histories.last().unwrap();
        prop_assert_eq!(last.large.as_ticks(), large);
        prop_assert_eq!(last.since(histories.first().unwrap()).small.as_ticks(), now - large);
        for earlier in &histories {
            let interval = last.since(earlier);
            prop_assert_eq!(interval.length().as_ticks(), now - earlier.at.as_ticks());
            // An odd number of edges changes the range, an even one does not.
            prop_assert_eq!(interval.edges % 2 == 1, interval.first != interval.last);
        }
    }

    #[test]
    fn nothing_panics(
        times: [u64; 6], flags: [bool; 6], window_ms: u32, edges: u32,
        currents: [i32; 8], debounce_ms: u32, settling: u64,
    ) {
        let mut recorder = EdgeRecorder::new(at(times[0]), flags[0]);
        let first = recorder.history(at(times[1]));
        let mut detector = ChatterDetector::new();
        let mut plausibility = FlagPlausibility::new();
        let config = FlagPlausibilityConfig {
            switching_current: Microamps(currents[0]),
            small_full_scale: Microamps(currents[1]),
            margin_above: Microamps(currents[2]),
            margin_below: Microamps(currents[3]),
            match_tolerance: Microamps(currents[4]),
            debounce_ms,
        };
        for (time, flag) in times.into_iter().zip(flags) {
            recorder.on_edge(at(time), flag);
            recorder.suspend();
            recorder.resume(at(time / 2), !flag);
            let history = recorder.history(at(time));
            let _ = (history.since(&first), first.since(&history), history.since(&first).shorter());
            let _ = history.since(&first).length();
            let _ = (history.settled(at(times[3]), us(settling)), history.conversion_spoiled(at(times[2]), us(settling)));
            let _ = detector.step(&ChatterConfig { window_ms, edges }, &history);
            let _ = plausibility.step(&config, &FlagObservation {
                at: at(time),
                flag: history.range,
                passed_as_small: Microamps(currents[5]),
                passed_as_large: Microamps(currents[6]),
                small_sensor: flag.then_some(Microamps(currents[7])),
                full_scale: Microamps(currents[1]),
            });
        }
    }
}
