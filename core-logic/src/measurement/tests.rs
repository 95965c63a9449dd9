use super::*;

fn at(us: u64) -> Instant {
    Instant::from_ticks(us)
}

#[test]
fn d0s_output_at_0_amps_is_that_of_its_budget() {
    let full_scale = Configuration::default().meter.full_scale;
    for share in [0, 1, 4_444, 444_444] {
        let of = |range| share_of_zero_output(full_scale.get(range), Ppm(share));
        let (small, large) = (of(Range::Small), of(Range::Large));
        assert_eq!((small.get(), large.get()), (67 * share, 670 * share));
    }
}

/// F22.
#[test]
fn damaged_factors_are_found_and_replaced() {
    let configuration = Configuration::default();
    let mut sound = Measurement::new(&configuration, None, Nanocoulombs::ZERO, at(0));
    sound.set_state_of_charge(Ppm(500_000), Ppm(10_000));
    let flips: [fn(&mut Prepared); 5] = [
        |p| p.converter = damaged_converter(),
        |p| p.open_sensor.open_below.0 ^= 1 << 20,
        |p| p.open_sensor.converter.as_mut().unwrap().large.high.0 ^= 1,
        |p| p.soc = damaged_soc(),
        |p| p.supply = Some(Microvolts(1 << 22)),
    ];
    for (number, flip) in flips.into_iter().enumerate() {
        let mut measurement = sound;
        let basis = measurement.basis();
        let prepared = prepare(&configuration, &basis);
        assert!(!measurement.check_factors(&basis, &prepared), "{number}");
        flip(&mut measurement.prepared);
        assert!(measurement.check_factors(&basis, &prepared), "{number}");
        assert_eq!(measurement.prepared, sound.prepared, "{number}");
        assert!(!measurement.check_factors(&basis, &prepared), "{number}");
        // What the state of charge has lost by them nobody knows.
        let uncertainty = measurement
            .soc
            .reading(&measurement.prepared.soc)
            .uncertainty;
        assert_eq!(uncertainty == Ppm::ONE, number == 3, "{number}");
    }
}

fn damaged_converter() -> ConverterCoefficients {
    let mut configuration = Configuration::default();
    configuration.converter.saturation_margin.0 ^= 1 << 8;
    prepare(&configuration, &NOMINAL).converter
}

fn damaged_soc() -> SocCoefficients {
    let mut configuration = Configuration::default();
    configuration.soc.capacity_mah ^= 1 << 8;
    SocCoefficients::new(&configuration.soc)
}

const NOMINAL: Basis = Basis {
    factors: KeyFactors::NONE,
    supply: None,
    number: 1,
};

/// Between the look at the basis and the comparison the supply has moved: no damage.
#[test]
fn factors_that_were_worked_out_anew_meanwhile_are_no_damage() {
    let configuration = Configuration::default();
    let mut measurement = Measurement::new(&configuration, None, Nanocoulombs::ZERO, at(0));
    let basis = measurement.basis();
    let prepared = prepare(&configuration, &basis);
    measurement.average_supply(&configuration, Some(Microvolts(4_900_000)), at(10_000));
    assert!(!measurement.check_factors(&basis, &prepared));
    assert_eq!(measurement.prepared.supply, Some(Microvolts(4_900_000)));
}

/// By one code of noise, rms, in each conversion of ADC1: the reference stands for two readings, as `firmware/src/analog.rs`
/// converts it. Each change makes the converter's comparison with the meter begin anew.
#[test]
fn noise_of_one_code_leaves_the_factors_for_minutes() {
    const VDDA_UV: f64 = 3_300_000.0;
    let configuration = Configuration::default();
    let mut measurement = Measurement::new(&configuration, None, Nanocoulombs::ZERO, at(0));
    let mut state = 0x9E37_79B9_7F4A_7C15_u64;
    // Twelve uniform ones are a normal one.
    let mut noise = || {
        (0..12).fold(-6.0, |sum, _| {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            sum + (state >> 11) as f64 / (1_u64 << 53) as f64
        })
    };
    let (mut vdda_uv, mut changes, mut number) = (VDDA_UV, std::vec::Vec::new(), 0);
    for tick in 0..60_000_u64 {
        if tick % 2 == 0 {
            let reference = 1.21e6 / VDDA_UV * 4_096.0;
            vdda_uv *= VDDA_UV / vdda_uv * reference / (reference + noise()).round();
        }
        let code = (2.5e6 / VDDA_UV * 4_096.0 + noise()).round();
        let supply = Microvolts((code * vdda_uv * 2.0 / 4_096.0) as i32);
        measurement.average_supply(&configuration, Some(supply), at(tick * 10_000));
        if core::mem::replace(&mut number, measurement.basis_number) != measurement.basis_number {
            changes.push(tick);
        }
    }
    assert!(changes.len() < 40, "{} in 10 min", changes.len());
    changes.push(60_000);
    let later = changes.iter().skip(1);
    let longest = changes.iter().zip(later).map(|(from, to)| to - from).max();
    let used = measurement.prepared.supply.unwrap();
    assert!(longest > Some(6_000), "{longest:?} ticks");
    // What the factors are off by, and the mean with its noise.
    assert!(used.saturating_sub(Microvolts(5_000_000)).saturating_abs() < Microvolts(5_000));
    let mean = measurement.supply.unwrap();
    assert!(mean.saturating_sub(used).saturating_abs() < SUPPLY_STEP);
}

/// The meter's factors are handed over again at each check, by the same number; by another one after a change.
#[test]
fn the_meter_is_handed_its_factors_at_each_check() {
    let configuration = Configuration::default();
    let mut measurement = Measurement::new(&configuration, None, Nanocoulombs::ZERO, at(0));
    let first = measurement.due_meter_calibration(&configuration).unwrap();
    assert_eq!(measurement.due_meter_calibration(&configuration), None);
    let basis = measurement.basis();
    measurement.check_factors(&basis, &prepare(&configuration, &basis));
    let again = measurement.due_meter_calibration(&configuration);
    assert_eq!(again, Some(first));
    measurement.configuration_changed(&configuration);
    let changed = measurement.due_meter_calibration(&configuration).unwrap();
    assert_ne!(changed, first);
}
