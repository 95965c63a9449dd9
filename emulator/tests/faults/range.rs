//! F9 and F10: the comparators and the range flag.

use core_logic::error_budget::{hand_over_hidden, hand_over_latency};
use core_logic::range::Range;
use emulator::bus_view::validity;

use super::bench::*;

/// Changes of the range as the board has counted them, and pairs of them that it knows it has not seen one by one.
fn edges(rig: &mut emulator::rig::Rig<'_>) -> (u32, u32) {
    let both = counters(rig, 0x004E, 2);
    (both[0], both[1])
}

#[test]
fn fault_f09_chatter_loses_no_edge_and_stays_within_the_declared_charge() {
    // What one change may cost behind ideal sensors.
    let per_edge_c = (hand_over_hidden() + hand_over_latency()) as f64 * 1e-9;
    // Chatter is at home at the threshold; that of a broken comparator may be anywhere.
    for (pattern, current_a) in [
        ("10Hz,50%", 53.3),
        ("10Hz,20%", 20.0),
        ("100Hz,10%", 53.3),
        ("100Hz,90%", -53.3),
        ("300Hz,30%", 30.0),
        ("1kHz,50%", 53.3),
        ("10kHz,30%", -53.3),
        ("100kHz,50%", 53.3),
        ("100kHz,10%", 53.3),
        ("100Hz,50%", 0.0),
        ("3kHz,50%", -30.0),
        ("10kHz,30%", 30.0),
        ("100kHz,90%", 5.0),
        ("1kHz,50%", 100.0),
    ] {
        let mut rig = pulse(current_a, 2.2);
        let before = charges_c(&mut rig);
        rig.run_s(0.4).unwrap();
        rig.machine.restart_load();
        rig.view.restart_periods();
        strike(&mut rig, &format!("F9:{pattern},1500ms"));
        rig.run_s(1.5).unwrap();
        let load = rig.machine.load().share();
        let longest_s = rig.view.period("Current").longest_s;
        rig.run_s(1.2).unwrap();
        let error_c = charge_error_c(&mut rig, before);
        let truth = rig.truth();
        let (counted, coalesced) = edges(&mut rig);
        let (storm, chatter) = (
            was_raised(&rig, "EdgeStorm"),
            was_raised(&rig, "RangeChatter"),
        );
        let declared_c = rig.view.signal("MeterCurrent", "ChargeUncertainty");
        println!(
            "F9 {pattern} at {current_a} A: {} edges, counted {counted} and {coalesced} pairs, storm {storm}, chatter \
             {chatter}; error {:+.1} mC, declared {declared_c:?} C, {:.3} mC per edge; load {:.1} %, frames at most {:.2} \
             ms apart",
            truth.edges,
            error_c * 1e3,
            error_c * 1e3 / truth.edges as f64,
            load * 100.0,
            longest_s * 1e3
        );
        if storm {
            assert!(chatter);
        } else {
            assert_eq!(u64::from(counted) + 2 * u64::from(coalesced), truth.edges);
        }
        assert!(
            error_c.abs() <= declared_c.unwrap() + quantum_c(Range::Large),
            "{pattern}: {error_c}"
        );
        // What the small sensor does not show of 100 A nobody knows. Else it is as right as without chatter, but for the
        // edges' snapshots, which are taken to be at the threshold where they stand alone.
        if current_a < 60.0 {
            assert!(error_c.abs() < 1.5, "{pattern}: {error_c}");
        }
        if truth.edges < 200 {
            let bound_c = truth.edges as f64 * per_edge_c + quantum_c(Range::Large);
            assert!(
                error_c.abs() <= bound_c,
                "{pattern}: {error_c} beyond {bound_c}"
            );
        }
        assert!(load < 0.5, "{pattern}: {load}");
        assert!(longest_s < 0.0125, "{pattern}: {longest_s}");
        assert_eq!(resets(&rig), 0);
        let expected = ["EdgeStorm", "RangeChatter", "FlagImplausible"];
        assert_eq!(unexpected(&rig, &expected), Vec::<&str>::new(), "{pattern}");
    }
}

/// The most that the settings of the storm may let through: in windows of each length.
#[test]
fn fault_f09_no_storm_setting_lets_chatter_starve_the_board() {
    for (events, window_us, hold_off_us) in
        [(10, 500, 500), (100, 5_000, 5_000), (100, 1_000_000, 5_000)]
    {
        let mut rig = steady(53.3);
        let [w0, w1, h0, h1] = [window_us >> 16, window_us, hold_off_us >> 16, hold_off_us]
            .map(|word: u32| word as u16);
        // A register lies between the number and the times.
        let order = if events > 20 { [1, 0] } else { [0, 1] };
        for part in order {
            let answer = match part {
                0 => write_registers(&mut rig, 0x0620, &[events]),
                _ => write_registers(&mut rig, 0x0622, &[w0, w1, h0, h1]),
            };
            assert_eq!(answer, Ok(()), "{events} in {window_us} µs, part {part}");
        }
        for pattern in ["100kHz,50%", "30kHz,50%"] {
            rig.machine.restart_load();
            rig.view.restart_periods();
            strike(&mut rig, &format!("F9:{pattern},1500ms"));
            rig.run_s(1.5).unwrap();
            let load = rig.machine.load().share();
            let longest_s = rig.view.period("Current").longest_s;
            println!(
                "F9 {pattern}, {events} in {window_us} µs: load {:.1} %, frames at most {:.2} ms apart",
                load * 100.0,
                longest_s * 1e3
            );
            assert!(load < 0.5, "{pattern}: {load}");
            assert!(longest_s < 0.0125, "{pattern}: {longest_s}");
            assert_eq!(resets(&rig), 0);
        }
    }
    // Beyond: what let 100 kHz end in a watchdog reset.
    let mut rig = steady(0.0);
    assert_eq!(write_registers(&mut rig, 0x0620, &[101]), Err(3));
    assert_eq!(write_registers(&mut rig, 0x0620, &[21]), Err(3));
    assert_eq!(write_registers(&mut rig, 0x0622, &[0, 499]), Err(3));
    assert_eq!(write_registers(&mut rig, 0x0624, &[0, 999]), Err(3));
}

#[test]
fn fault_f10_a_flag_against_the_level_is_found_and_the_charge_is_doubted() {
    for (stuck, current_a) in [("high", 30.0), ("low", 100.0), ("low", -250.0)] {
        let mut rig = steady(current_a);
        // The longest average: two seconds.
        write_registers(&mut rig, 0x0320, &[64]).unwrap();
        rig.run_s(0.5).unwrap();
        let before = charges_c(&mut rig);
        let bound_before_c = charge_bound_c(&rig);
        strike(&mut rig, &format!("F10:{stuck},1s"));
        let doubted_s = until(&mut rig, "a doubted current", 0.5, |rig| {
            rig.view.current_a().validity & validity::IMPLAUSIBLE != 0
        });
        let named_s = doubted_s + until_diagnosis(&mut rig, "FlagImplausible", 0.2);
        let mut unmarked = 0;
        watch(&mut rig, 0.6, |rig| {
            let value = rig.view.current_a().valid();
            unmarked += usize::from(value.is_some_and(|value_a| (value_a - current_a).abs() > 1.0));
        });
        let charge = rig.view.charge_c();
        // Means that still have something of it in them.
        let mut wrong_means = Vec::new();
        watch(&mut rig, 3.5, |rig| {
            let means = [rig.view.average_a(), rig.view.meter_current_a()];
            wrong_means.extend(
                means
                    .into_iter()
                    .filter_map(|mean| mean.valid())
                    .filter(|mean_a| (mean_a - current_a).abs() > 1.0),
            );
        });
        let error_c = charge_error_c(&mut rig, before);
        let declared_c = charge_bound_c(&rig) - bound_before_c;
        println!(
            "F10 {stuck} at {current_a} A: current doubted after {:.0} ms, FlagImplausible on CAN after {:.0} ms, charge \
             meanwhile {charge:?}, in the end {error_c:.1} C off, declared {declared_c:.1} C",
            doubted_s * 1e3,
            named_s * 1e3
        );
        // The charge is valid again, and off: that is declared.
        assert_eq!(rig.view.charge_c().validity, 0);
        assert!(error_c.abs() > 50.0, "{error_c}");
        assert!(error_c.abs() <= declared_c, "{error_c} {declared_c}");
        assert!(declared_c < 1.3 * error_c.abs(), "{error_c} {declared_c}");
        // 200 ms, and the frame that says so.
        assert!(doubted_s <= 0.21, "{doubted_s}");
        assert!(named_s <= 0.3, "{named_s}");
        assert_eq!(unmarked, 0, "wrong currents marked valid");
        assert_eq!(wrong_means, [0.0; 0], "wrong means marked valid");
        assert!(charge.validity & validity::IMPLAUSIBLE != 0, "{charge:?}");
        for back in [
            rig.view.current_a(),
            rig.view.average_a(),
            rig.view.meter_current_a(),
        ] {
            assert!((back.valid().unwrap() - current_a).abs() < 0.5, "{back:?}");
        }
    }
}

/// Shorter than the debounce, with two conversions in it that no edge has spoiled.
#[test]
fn fault_f10_a_contradiction_too_short_to_be_reported_is_declared() {
    for (stuck, current_a) in [("high", 30.0), ("low", 100.0), ("low", -250.0)] {
        for length_ms in [70, 80, 90] {
            let mut rig = steady(current_a);
            rig.run_s(0.5).unwrap();
            let before = charges_c(&mut rig);
            let bound_before_c = charge_bound_c(&rig);
            strike(&mut rig, &format!("F10:{stuck},{length_ms}ms"));
            rig.run_s(2.0).unwrap();
            let error_c = charge_error_c(&mut rig, before);
            let declared_c = charge_bound_c(&rig) - bound_before_c;
            println!(
                "F10 {stuck} for {length_ms} ms at {current_a} A: {error_c:.1} C off, declared {declared_c:.1} C"
            );
            assert_eq!(unexpected(&rig, &[]), Vec::<&str>::new());
            assert!(error_c.abs() > 5.0, "{error_c}");
            assert!(error_c.abs() <= declared_c, "{error_c} {declared_c}");
            assert!(declared_c < 2.0 * error_c.abs(), "{error_c} {declared_c}");
        }
    }
}
