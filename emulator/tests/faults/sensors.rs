//! F14 and F15: the Hall sensors and their supply.

use emulator::bus_view::validity;

use super::bench::*;

#[test]
fn fault_f14_an_open_sensor_at_a_rail_is_found() {
    // Of the small sensor the network tells; then the large one measures.
    let mut rig = steady(20.0);
    rig.run_s(0.6).unwrap();
    strike(&mut rig, "F14:open,small,2s");
    let mut wrong_ms = 0;
    let mut found_s = None;
    let mut t_s = 0.0;
    watch(&mut rig, 0.5, |rig| {
        t_s += 0.001;
        let current = rig.view.current_a();
        wrong_ms += usize::from(
            current
                .valid()
                .is_some_and(|value_a| (value_a - 20.0).abs() > 1.0),
        );
        if rig.view.active_diagnoses().contains(&"SmallSensorOpen") && found_s.is_none() {
            found_s = Some(t_s);
        }
    });
    let current = rig.view.current_a();
    println!(
        "F14 small open: SmallSensorOpen on CAN after {:.0} ms, wrong and valid for {wrong_ms} ms, then {current:?}",
        found_s.unwrap() * 1e3
    );
    // Two looks of 10 ms, and the frame of every 100 ms.
    assert!(found_s.unwrap() <= 0.13, "{found_s:?}");
    assert_eq!(wrong_ms, 0);
    assert!((current.valid().unwrap() - 20.0).abs() < 0.5, "{current:?}");

    // The large one has no network: a rail while it is selected.
    for (fault, current_a) in [
        ("open,large", 200.0),
        ("0V,large", 200.0),
        ("5V,large", -200.0),
    ] {
        let mut rig = steady(current_a);
        rig.run_s(0.6).unwrap();
        let before = charges_c(&mut rig);
        let bound_before_c = charge_bound_c(&rig);
        strike(&mut rig, &format!("F14:{fault},2s"));
        let mut wrong_ms = 0;
        let invalid_s = until(&mut rig, "an invalid current", 0.3, |rig| {
            let current = rig.view.current_a();
            let wrong = (current.value.unwrap_or(current_a) - current_a).abs() > 1.0;
            wrong_ms += usize::from(current.validity == validity::VALID && wrong);
            current.validity != 0
        });
        let named_s = invalid_s + until_diagnosis(&mut rig, "SensorRail", 0.3);
        println!(
            "F14 {fault} at {current_a} A: invalid after {:.0} ms, wrong and valid for {wrong_ms} ms, SensorRail on CAN \
             after {:.0} ms",
            invalid_s * 1e3,
            named_s * 1e3
        );
        // Two conversions of 31 ms, the one under way and the frame.
        assert!(invalid_s <= 0.105, "{invalid_s}");
        assert!(named_s <= 0.3, "{named_s}");
        // What the rail has counted stays in the charge, and is declared.
        rig.run_s(4.0).unwrap();
        assert_eq!(rig.view.charge_c().validity, 0);
        let error_c = charge_error_c(&mut rig, before);
        let declared_c = charge_bound_c(&rig) - bound_before_c;
        println!("F14 {fault} at {current_a} A: {error_c:.1} C off, declared {declared_c:.1} C");
        assert!(error_c.abs() > 1_000.0, "{error_c}");
        assert!(error_c.abs() <= declared_c, "{error_c} {declared_c}");
        assert!(declared_c < 2.0 * error_c.abs(), "{error_c} {declared_c}");
    }
}

/// Behind the switch both converters see the same sensor, so an open one that floats at 2.5 V reads 0 A in both: nothing on
/// this board can tell it from 0 A. This test says so; when it fails the board has learned something.
#[test]
fn fault_f14_an_open_sensor_that_floats_at_half_the_supply_reads_0_a() {
    let mut rig = steady(20.0);
    rig.run_s(0.6).unwrap();
    strike(&mut rig, "F14:2.5V,small,10s");
    rig.run_s(2.0).unwrap();
    let (current, meter) = (rig.view.current_a(), rig.view.meter_current_a());
    println!(
        "F14 2.5 V: converter {current:?}, meter {meter:?}, {:?}",
        rig.view.diagnoses
    );
    // The network pulls the divider's 1 kΩ down by 3.2 A.
    assert!(current.valid().is_some_and(|value_a| value_a.abs() < 4.0));
    assert!(meter.value.is_some_and(|value_a| value_a.abs() < 4.0));
}

#[test]
fn fault_f15_the_supply_cancels_within_its_range_and_is_reported_beyond() {
    for (current_a, supplies) in [(45.0, [4.5, 5.5]), (-450.0, [4.75, 5.5])] {
        for volts in supplies {
            let mut rig = steady(current_a);
            rig.run_s(0.3).unwrap();
            strike(&mut rig, &format!("F15:{volts}V,10s"));
            rig.run_s(2.5).unwrap();
            let full_a = if current_a.abs() > 60.0 { 600.0 } else { 60.0 };
            let (current, meter) = (rig.view.current_a(), rig.view.meter_current_a());
            let error = |value: Option<f64>| (value.unwrap() - current_a) / full_a;
            println!(
                "F15 {volts} V at {current_a} A: converter {:+.3} %, meter {:+.3} % of full scale, {:?} {:?}",
                100.0 * error(current.value),
                100.0 * error(meter.value),
                unexpected(&rig, &[]),
                current.validity
            );
            // 0.1 %, and half a code of 13 bits over 5 V against 2.25 V of swing.
            assert!(error(current.value).abs() <= 1e-3 + 0.5 / 8_192.0 * 5.0 / 2.25);
            assert!(error(meter.value).abs() <= 1e-3 + 2e-3);
        }
    }
    let mut rig = pulse(45.0, 4.0);
    let before = charges_c(&mut rig);
    rig.run_s(0.5).unwrap();
    strike(&mut rig, "F15:ramp,3s");
    rig.run_s(4.3).unwrap();
    let error_c = charge_error_c(&mut rig, before);
    println!(
        "F15 ramp: charge error {:.1} mC of 180 C, {:?}",
        error_c * 1e3,
        unexpected(&rig, &[])
    );
    assert!(error_c.abs() <= 0.001 * 180.0, "{error_c}");

    let mut rig = steady(45.0);
    rig.run_s(0.5).unwrap();
    strike(&mut rig, "F15:4.2V,1s");
    let mut wrong_ms = 0;
    let invalid_s = until(&mut rig, "an invalid current", 0.3, |rig| {
        let current = rig.view.current_a();
        wrong_ms += usize::from(
            current
                .valid()
                .is_some_and(|value_a| (value_a - 45.0).abs() > 0.5),
        );
        current.validity & validity::SUPPLY != 0
    });
    let named_s = invalid_s + until_diagnosis(&mut rig, "SupplyOutOfRange", 0.2);
    rig.run_s(1.0 - named_s).unwrap();
    let back_s = until(&mut rig, "a valid current", 1.0, |rig| {
        rig.view.current_a().valid().is_some()
    });
    println!(
        "F15 4.2 V: invalid after {:.0} ms, wrong and valid for {wrong_ms} ms, SupplyOutOfRange on CAN after {:.0} ms, valid \
         {:.0} ms after its end",
        invalid_s * 1e3,
        named_s * 1e3,
        back_s * 1e3
    );
    assert!(invalid_s <= 0.05, "{invalid_s}");
    assert_eq!(wrong_ms, 0);
    assert!(named_s <= 0.15 && back_s <= 0.35);
}
