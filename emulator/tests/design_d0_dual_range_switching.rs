//! D0 on the running image: ramps through ±53.33 A in both directions. Which sensor measures, what the frames say on both
//! sides of an edge and across it, and what the meter has counted.

use crate::support::{Account, Bench, firmware};
use emulator::bus_view::validity;
use emulator::rig::Setup;
use emulator::scenario::{Contactors, Row, Scenario};

/// Where the comparators trip: 4.5 V is 2 V above the zero, of 2.25 V for 60 A (D0: 53.33 A).
const TRIP_A: f64 = 2.0 * 60.0 / 2.25;
/// Where they let go: 20 mV of hysteresis below.
const RELEASE_A: f64 = (2.0 - 0.02) * 60.0 / 2.25;

/// Half a code: 5 V in 2¹³ steps (ADS1100, 32 samples a second, single-ended), and a frame's last digit of 1 mA.
fn resolution_a(large: bool) -> f64 {
    let full_scale_a = if large { 600.0 } else { 60.0 };
    5.0 / 8192.0 / 2.0 * full_scale_a / 2.25 + 0.0006
}

/// Plateaus, in A, and on which sensor they are measured: between release and trip it is the one used before.
const PLATEAUS: [(f64, bool); 12] = [
    (5.0, false),
    (35.0, false),
    (52.0, false),
    (53.2, false),
    (55.0, true),
    (120.0, true),
    (350.0, true),
    (590.0, true),
    (300.0, true),
    (53.0, true),
    (52.5, false),
    (20.0, false),
];
const PLATEAU_S: f64 = 0.2;
const RAMP_S: f64 = 0.05;
/// A conversion at 32 samples a second.
const CONVERSION_S: f64 = 1.0 / 32.0;

/// Time from the drive's beginning, and current.
fn profile() -> Vec<(f64, f64)> {
    let mut points = vec![(0.0, 0.0)];
    let mut t_s = 0.0;
    for sign in [1.0, -1.0] {
        for (amps, _) in PLATEAUS.iter().chain(&[(0.0, false)]) {
            t_s += RAMP_S;
            points.push((t_s, sign * amps));
            t_s += PLATEAU_S;
            points.push((t_s, sign * amps));
        }
    }
    points
}

fn current_at(profile: &[(f64, f64)], t_s: f64) -> f64 {
    let after = profile.partition_point(|point| point.0 < t_s).max(1);
    let (from, to) = (profile[after - 1], profile[after]);
    from.1 + (to.1 - from.1) * (t_s - from.0) / (to.0 - from.0)
}

#[test]
fn range_switches_at_53_33_a_in_both_directions_and_both_sides_are_right() {
    let firmware = firmware();
    let at_rest = Row {
        cell_v: Some(3.7),
        ..Row::at_rest(0.0)
    };
    let scenario = Scenario::steady(at_rest, Contactors::AlwaysClosed);
    let mut bench = Bench::new(&firmware, Setup::nominal(scenario));
    let account = Account::open(&mut bench);
    bench.rig.snapshots.clear();
    bench.record();
    let profile = profile();
    let rows: Vec<Row> = profile
        .iter()
        .map(|(t_s, amps)| {
            Row {
                t_s: *t_s,
                ..at_rest
            }
            .with_current(*amps)
        })
        .collect();
    let start_s = bench.now_s();
    bench.drive(&rows);
    let charge = account.close(&mut bench);

    // The flag's edges, where the ramp was then.
    let edges: Vec<f64> = bench
        .rig
        .snapshots
        .iter()
        .map(|snapshot| snapshot.edge.seconds() - start_s)
        .collect();
    let at_edges: Vec<f64> = edges.iter().map(|t_s| current_at(&profile, *t_s)).collect();
    println!("D0: the flag changes at {at_edges:.4?} A");
    let expected = [TRIP_A, RELEASE_A, -TRIP_A, -RELEASE_A];
    assert_eq!(at_edges.len(), expected.len(), "each edge has its snapshot");
    for (found, expected) in at_edges.iter().zip(expected) {
        assert!(
            (found - expected).abs() < 1e-3,
            "{found} A instead of {expected} A"
        );
    }
    assert_eq!(charge.edges, 4);
    assert_eq!(bench.signal("BoardState", "RangeEdges"), 4.0);
    assert_eq!(bench.signal("BoardState", "Range"), 0.0);
    let latch_us = bench
        .rig
        .snapshots
        .iter()
        .map(|snapshot| snapshot.latched.since(snapshot.edge).micros())
        .fold(0.0, f64::max);
    println!("D0: at the latest {latch_us:.1} µs from an edge to the latching of AENERGY");
    assert!(latch_us <= 100.0, "the deadline of the hand-over");

    // Frames: a conversion's end is known to a millisecond and the time until its frame has left.
    let frames = bench.conversions();
    let (mut worst_small_a, mut worst_large_a) = (0.0_f64, 0.0_f64);
    let mut on_plateaus = vec![0; 2 * PLATEAUS.len()];
    let (mut straddling, mut range_changes) = (0, 0);
    for frame in &frames {
        let end_s = frame.at_s - frame.age_s - start_s;
        let (earliest_s, latest_s) = (end_s - CONVERSION_S - 0.003, end_s + 0.001);
        let (certainly_from_s, certainly_to_s) = (end_s - CONVERSION_S + 0.001, end_s - 0.003);
        let changes = frame.validity & validity::RANGE_CHANGE != 0;
        range_changes += u32::from(changes);
        if edges
            .iter()
            .any(|edge_s| (certainly_from_s..certainly_to_s).contains(edge_s))
        {
            straddling += 1;
            assert!(changes, "a conversion across an edge: {frame:?}");
        }
        for (index, (amps, large)) in PLATEAUS.iter().chain(&PLATEAUS).enumerate() {
            let negative = index >= PLATEAUS.len();
            let ramps = index + 1 + usize::from(negative);
            let begin_s = ramps as f64 * RAMP_S + (ramps - 1) as f64 * PLATEAU_S;
            // The low-pass settles within ten of its time constants of 0.5 ms.
            if earliest_s < begin_s + 0.005 || latest_s > begin_s + PLATEAU_S {
                continue;
            }
            let expected_a = if negative { -amps } else { *amps };
            assert_eq!(frame.validity, validity::VALID, "{expected_a} A: {frame:?}");
            assert_eq!(frame.large, *large, "{expected_a} A: {frame:?}");
            let error_a = (frame.current_a.unwrap() - expected_a).abs();
            assert!(
                error_a <= resolution_a(*large),
                "{error_a} A off at {expected_a} A: {frame:?}"
            );
            let worst_a = if *large {
                &mut worst_large_a
            } else {
                &mut worst_small_a
            };
            *worst_a = worst_a.max(error_a);
            on_plateaus[index] += 1;
        }
    }
    println!(
        "D0: {} conversions, {straddling} certainly across an edge, {range_changes} marked as range change; largest error \
         {worst_small_a:.4} A on the small sensor (half a code is {:.4} A), {worst_large_a:.4} A on the large one ({:.4} A)",
        frames.len(),
        resolution_a(false),
        resolution_a(true)
    );
    assert!(
        on_plateaus.iter().all(|count| *count >= 3),
        "{on_plateaus:?}"
    );
    assert!(
        straddling >= 1,
        "not all four edges can fall on a conversion's end"
    );
    assert!(
        (4..=8).contains(&range_changes),
        "one or two for each edge: {range_changes}"
    );

    let stated_c = bench.signal("MeterCurrent", "ChargeUncertainty");
    println!(
        "D0: {:.1} C both ways, error {:+.4} C, bound {:.4} C, the board's own for its hand-overs {stated_c:.2} C",
        charge.throughput_c, charge.error_c, charge.bound_c
    );
    assert!(charge.throughput_c > 500.0);
    assert!(charge.error_c.abs() <= charge.bound_c, "{charge:?}");
    // Half a count of either range at both ends comes on top.
    assert!(
        charge.error_c.abs() <= stated_c + 0.067,
        "{charge:?}, stated {stated_c} C"
    );
    let complaints = bench.complaints(&["SocUncertain"]);
    assert!(complaints.is_empty(), "{complaints:?}");
}
