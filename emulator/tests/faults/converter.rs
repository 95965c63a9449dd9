//! F11 … F13: the ADS1100 and its bus.

use emulator::bus_view::validity;
use emulator::i2c_bus::{Ending, Transaction};
use emulator::mcu::rcc::ResetCause;
use emulator::rig::{Rig, Setup};
use emulator::scenario::{Contactors, Scenario};
use emulator::time::Ticks;

use super::bench::*;

/// One conversion at 32 per second, in s.
const PERIOD_S: f64 = 1.0 / 32.0;

fn conversions(rig: &Rig<'_>) -> f64 {
    rig.view.signal("Current", "CurrentConversions").unwrap()
}

#[test]
fn fault_f11_the_i2c_bus_is_recovered_and_what_is_old_is_marked() {
    for fault in ["sda", "byte", "nack", "arbitration", "glitch"] {
        let mut rig = steady(40.0);
        rig.run_s(0.5).unwrap();
        let recovered = counters(&mut rig, 0x0110, 2);
        board(&mut rig, |board| board.i2c_bus.take_log());
        let struck_s = rig.now_s();
        strike(&mut rig, &format!("F11:{fault}"));
        let mut wrong = 0;
        let mut stale = 0;
        watch(&mut rig, 0.5, |rig| {
            let current = rig.view.current_a();
            wrong += usize::from(
                current
                    .valid()
                    .is_some_and(|value_a| (value_a - 40.0).abs() > 0.1),
            );
            stale += usize::from(current.validity & validity::STALE != 0);
        });
        let log = board(&mut rig, |board| board.i2c_bus.take_log());
        let good =
            |transfer: &Transaction| transfer.acknowledged && transfer.ending == Ending::Stop;
        // The driver leaves the bus alone for 25 ms while a conversion runs; what is beyond that is the fault's.
        let starts: Vec<f64> = std::iter::once(struck_s)
            .chain(
                log.iter()
                    .filter(|transfer| good(transfer))
                    .map(|transfer| transfer.start.seconds()),
            )
            .collect();
        let gap_s = starts
            .windows(2)
            .map(|pair| pair[1] - pair[0])
            .fold(0.0, f64::max);
        let now = counters(&mut rig, 0x0110, 2);
        println!(
            "F11 {fault}: {:.1} ms without an answer, {} bus errors, {} recoveries, stale for {stale} ms, {wrong} wrong",
            gap_s * 1e3,
            now[0] - recovered[0],
            now[1] - recovered[1]
        );
        assert!(now[1] > recovered[1], "{fault}: no recovery");
        // Three refusals have a pause of 10 ms each behind them.
        let bound_s = 0.026 + if fault == "nack" { 0.035 } else { 0.02 };
        assert!(gap_s <= bound_s, "{fault}: {gap_s}");
        assert_eq!(wrong, 0, "{fault}");
        // A conversion that was cut off, one that is discarded after a recovery and one that counts, 33 ms each, and 10 ms after
        // each refusal: more than the three periods of 94 ms, and 10 ms to the frame that ends it.
        let refusals = if fault == "nack" { 3 } else { 1 };
        assert!(
            stale <= 3 * 33 + 10 * refusals - 94 + 10,
            "{fault}: stale for {stale} ms"
        );
        assert!(rig.view.current_a().valid().is_some());
        assert_eq!(
            unexpected(&rig, &["ConverterStale"]),
            Vec::<&str>::new(),
            "{fault}"
        );
    }

    let mut rig = steady(40.0);
    rig.run_s(0.5).unwrap();
    strike(&mut rig, "F11:short,500ms");
    let stale_s = until(&mut rig, "a stale current", 0.3, |rig| {
        rig.view.current_a().validity & validity::STALE != 0
    });
    let named_s = stale_s + until_diagnosis(&mut rig, "ConverterNoAnswer", 0.3);
    let rest_s = 0.5 - named_s;
    rig.run_s(rest_s).unwrap();
    let back_s = until(&mut rig, "a valid current", 0.7, |rig| {
        rig.view.current_a().valid().is_some()
    });
    println!(
        "F11 short of 500 ms: stale after {:.0} ms, ConverterNoAnswer on CAN after {:.0} ms, valid {:.0} ms after its end",
        stale_s * 1e3,
        named_s * 1e3,
        back_s * 1e3
    );
    // Three periods, counted from the last conversion, and the frame.
    assert!(stale_s <= 3.0 * PERIOD_S + 0.012, "{stale_s}");
    assert!(back_s <= 0.6, "{back_s}");
    let error_a = rig.view.meter_current_a().valid().unwrap() - 40.0;
    assert!(error_a.abs() < 0.1, "the meter went on: {error_a}");
}

/// A reset finds the converter at any bit of a read, and it goes on showing that bit: one recovery frees it.
#[test]
fn fault_f11_a_reset_in_the_middle_of_a_read_costs_one_recovery() {
    let mut rig = steady(40.0);
    // The image looks for the chip at another address first.
    let looked_for = counters(&mut rig, 0x0110, 1)[0];
    let (mut held, mut worst_s) = (0, 0_f64);
    for bytes in 0..3 {
        for bit in 0..9 {
            rig.run_s(0.4).unwrap();
            let reading = |board: &mut emulator::board::Board| {
                board.i2c_bus.log().last().is_some_and(|transfer| {
                    transfer.end.is_none()
                        && transfer.address.is_some_and(|address| address & 1 == 1)
                        && transfer.acknowledged
                        && transfer.bytes.len() == bytes
                })
            };
            let begin = rig.machine.now();
            while !board(&mut rig, reading) {
                assert!(rig.machine.now().since(begin).seconds() < 0.1);
                rig.run_for(Ticks::from_micros(1)).unwrap();
            }
            // A bit takes 2.5 µs.
            rig.run_for(Ticks::from_seconds(2.5e-6 * f64::from(bit) + 1e-6))
                .unwrap();
            rig.machine.reset(ResetCause::IndependentWatchdog);
            rig.view.first_valid_current = None;
            let now = rig.machine.now();
            held += usize::from(board(&mut rig, |board| !board.i2c_bus.levels(now).1));
            let valid_s = until(&mut rig, "a valid current", 0.3, |rig| {
                rig.view.first_valid_current.is_some()
            });
            worst_s = worst_s.max(valid_s);
            let [errors, recoveries] = counters(&mut rig, 0x0110, 2)[..] else {
                panic!("two counters");
            };
            assert!(
                errors <= looked_for + 1 && recoveries == errors,
                "byte {bytes}, bit {bit}: {errors} errors, {recoveries} recoveries"
            );
        }
    }
    println!(
        "F11: of 27 resets in the middle of a read {held} left SDA low; valid after {:.0} ms at most",
        worst_s * 1e3
    );
    assert!(held >= 9, "{held}");
}

#[test]
fn fault_f12_a_reset_of_the_converter_gives_no_wrong_current() {
    let mut wrong = 0;
    let mut raised = 0;
    for phase in 0..6 {
        let mut rig = steady(40.0);
        rig.run_s(0.3 + 0.005 * f64::from(phase)).unwrap();
        strike(&mut rig, "F12");
        watch(&mut rig, 0.4, |rig| {
            let value = rig.view.current_a().valid();
            wrong += usize::from(value.is_some_and(|value_a| (value_a - 40.0).abs() > 0.1));
        });
        let value = rig.view.current_a();
        assert!(value.valid().is_some(), "phase {phase}: {value:?}");
        raised += usize::from(was_raised(&rig, "ConverterConfigurationLost"));
        // The conversion that was lost and the one that is discarded after a reset are more than three periods.
        assert_eq!(
            unexpected(&rig, &["ConverterConfigurationLost", "ConverterStale"]),
            Vec::<&str>::new()
        );
    }
    println!(
        "F12: {raised} of 6 resets met a conversion; {wrong} ms with a wrong current marked valid"
    );
    assert_eq!(wrong, 0);
    assert!(raised >= 5, "{raised}");
}

#[test]
fn fault_f13_repeated_samples_count_once_and_only_stuck_ones_are_called_so() {
    // The ADS1100's slowest and fastest: 104 and 184 of 128 SPS (plant's `Ads1100Config::rate_error`).
    for rate_error in [-0.19, 0.0, 0.2, 0.44] {
        let mut setup = Setup::nominal(Scenario::steady(
            row(0.0).with_current(40.0),
            Contactors::AlwaysClosed,
        ));
        setup.converter.rate_error = rate_error;
        let mut rig = rig_of(setup);
        rig.run_s(1.0).unwrap();
        let from = (
            conversions(&rig),
            board(&mut rig, |board| board.converter.conversions()),
        );
        rig.run_s(3.0).unwrap();
        let by_board = (conversions(&rig) - from.0).rem_euclid(256.0);
        let by_chip = (board(&mut rig, |board| board.converter.conversions()) - from.1) as f64;
        println!(
            "F13 rate {rate_error:+}: chip made {by_chip} conversions, the board counted {by_board}"
        );
        assert!((by_board - by_chip).abs() <= 1.0);
        // The same code all the time, and rightly so.
        assert_eq!(unexpected(&rig, &[]), Vec::<&str>::new(), "{rate_error}");
    }

    // The run of equal codes is as long as to have a mean of the meter's before the current moves.
    let rows = vec![row(0.0), row(2.5), row(4.5).with_current(40.0)];
    let mut rig = rig_of(Setup::nominal(
        Scenario::new(rows, Contactors::AlwaysClosed).unwrap(),
    ));
    rig.run_s(2.5).unwrap();
    strike(&mut rig, "F13:5s");
    let found_s = until_diagnosis(&mut rig, "ConverterStuck", 3.0);
    println!(
        "F13 stuck while the current rises by 20 A/s: found after {:.0} ms",
        found_s * 1e3
    );
    // 32 repeats are one second.
    assert!(found_s <= 1.3, "{found_s}");
    assert_eq!(rig.view.current_a().valid(), None);
}

/// Each move of the measured supply that gives the meter other factors makes the comparison begin anew: noise must not.
#[test]
fn fault_f13_a_stuck_converter_is_found_beside_a_noisy_supply() {
    let rows = vec![row(0.0), row(5.0), row(7.0).with_current(40.0)];
    let mut rig = rig_of(Setup::nominal(
        Scenario::new(rows, Contactors::AlwaysClosed).unwrap(),
    ));
    rig.machine.adc(|adc| adc.set_noise_codes(1.0));
    rig.run_s(5.0).unwrap();
    assert_eq!(unexpected(&rig, &[]), Vec::<&str>::new());
    strike(&mut rig, "F13:5s");
    let found_s = until_diagnosis(&mut rig, "ConverterStuck", 3.0);
    println!(
        "F13 stuck while the current rises by 20 A/s, ADC1 with a code of noise: found after {:.0} ms",
        found_s * 1e3
    );
    assert!(found_s <= 1.3, "{found_s}");
}

#[test]
fn fault_f11_a_bus_error_that_is_none_costs_no_conversion() {
    let mut rig = steady(40.0);
    rig.run_s(0.5).unwrap();
    let counters_before = counters(&mut rig, 0x0110, 2);
    let before = conversions(&rig);
    rig.run_s(0.5).unwrap();
    let undisturbed = conversions(&rig) - before;
    let before = conversions(&rig);
    // In starts, addresses, data and stops: wherever one of the events ends.
    let mut struck = 0;
    watch(&mut rig, 0.5, |rig| {
        strike(rig, "F11:spurious");
        struck += 1;
        assert!(
            rig.view
                .current_a()
                .valid()
                .is_some_and(|a| (a - 40.0).abs() < 0.1)
        );
    });
    let disturbed = conversions(&rig) - before;
    println!("F11 spurious: {struck} struck, {disturbed} conversions, {undisturbed} without");
    assert!(struck > 100, "{struck}");
    assert!(
        (disturbed - undisturbed).abs() <= 1.0,
        "{disturbed} of {undisturbed}"
    );
    assert_eq!(counters(&mut rig, 0x0110, 2), counters_before);
    assert_eq!(unexpected(&rig, &[]), Vec::<&str>::new());
}
