use super::*;
use proptest::prelude::*;

const FIVE: Microvolts = Microvolts::from_millivolts(5_000);

fn millivolts(value: i32) -> Microvolts {
    Microvolts::from_millivolts(value)
}

fn all() -> [FrontEnd; 4] {
    [
        FrontEnd::DualRange(DualRange::default()),
        FrontEnd::Hah1bv(Hah1bv::default()),
        FrontEnd::Network(Network::default()),
        FrontEnd::ClosedLoop(ClosedLoop::default()),
    ]
}

pub(crate) fn any_range() -> impl Strategy<Value = Range> {
    prop_oneof![Just(Range::Small), Just(Range::Large)]
}

/// Front ends that `validate` accepts.
pub(crate) fn any_valid() -> impl Strategy<Value = FrontEnd> {
    let valid = prop_oneof![
        (1_000_000..100_000_000, 1..10_i32, 1_000_000..2_400_000).prop_map(
            |(small, ratio, swing)| {
                FrontEnd::DualRange(DualRange {
                    full_scale: PerRange {
                        small: Microamps(small),
                        large: Microamps(small * ratio + 1),
                    },
                    swing: Microvolts(swing),
                    zero: millivolts(2_500),
                })
            }
        ),
        (1_000..20_000, 1_000_000..1_000_000_000).prop_map(|(sensitivity, full_scale)| {
            FrontEnd::Hah1bv(Hah1bv {
                microvolts_per_amp: sensitivity,
                full_scale: Microamps(full_scale),
            })
        }),
        (
            5_000_000..80_000_000,
            -200_000..200_000,
            1_000_000..1_000_000_000
        )
            .prop_map(|(sensitivity, zero, full_scale)| {
                FrontEnd::Network(Network {
                    sensor_nanovolts_per_amp: sensitivity,
                    sensor_zero: Microvolts(zero),
                    full_scale: Microamps(full_scale),
                })
            }),
        any_closed_loop().prop_map(FrontEnd::ClosedLoop),
    ];
    valid.prop_filter("accepted", |front_end| front_end.validate().is_ok())
}

fn any_closed_loop() -> impl Strategy<Value = ClosedLoop> {
    (
        1..5_000_i32,
        3_000_000..20_000_000_i64,
        0..=100_i64,
        400_000_000..600_000_000_i64,
        -200_000_000..200_000_000_i64,
        1_000_000..600_000_000,
    )
        .prop_map(|(turns, nanovolts_per_amp, share, k2, m2, full_scale)| {
            // `share` percent of the impedance follows the supply.
            let impedance = nanovolts_per_amp * i64::from(turns);
            ClosedLoop {
                turns,
                relations: SupplyRelations {
                    k1_nanoohm_per_volt: impedance * share / 500,
                    m1_nanoohm: impedance * (100 - share) / 100,
                    k2_nanovolt_per_volt: k2,
                    m2_nanovolt: m2,
                },
                full_scale: Microamps(full_scale),
            }
        })
}

pub(crate) fn any_supply() -> impl Strategy<Value = Microvolts> {
    (4_500_000..=5_500_000).prop_map(Microvolts)
}

/// Front ends with any numbers at all.
pub(crate) fn any_front_end() -> impl Strategy<Value = FrontEnd> {
    prop_oneof![
        any::<[i32; 4]>().prop_map(|[small, large, swing, zero]| {
            FrontEnd::DualRange(DualRange {
                full_scale: PerRange {
                    small: Microamps(small),
                    large: Microamps(large),
                },
                swing: Microvolts(swing),
                zero: Microvolts(zero),
            })
        }),
        any::<[i32; 2]>().prop_map(|[sensitivity, full_scale]| {
            FrontEnd::Hah1bv(Hah1bv {
                microvolts_per_amp: sensitivity,
                full_scale: Microamps(full_scale),
            })
        }),
        any::<[i32; 3]>().prop_map(|[sensitivity, zero, full_scale]| {
            FrontEnd::Network(Network {
                sensor_nanovolts_per_amp: sensitivity,
                sensor_zero: Microvolts(zero),
                full_scale: Microamps(full_scale),
            })
        }),
        (any::<[i64; 4]>(), any::<i32>(), any::<i32>()).prop_map(
            |([k1, m1, k2, m2], turns, full_scale)| {
                FrontEnd::ClosedLoop(ClosedLoop {
                    turns,
                    relations: SupplyRelations {
                        k1_nanoohm_per_volt: k1,
                        m1_nanoohm: m1,
                        k2_nanovolt_per_volt: k2,
                        m2_nanovolt: m2,
                    },
                    full_scale: Microamps(full_scale),
                })
            }
        ),
    ]
}

/// Stopped at the type's end it would be too small, and with it all of the charge.
#[test]
fn the_meters_full_scale_of_an_accepted_sensor_is_exact() {
    for signal_millivolts in 1_500..2_400 {
        let swing = millivolts(signal_millivolts);
        let sensors = [
            FrontEnd::DualRange(DualRange {
                full_scale: PerRange {
                    small: Microamps::from_amps(200),
                    large: FULL_SCALE_LIMITS.1,
                },
                swing,
                ..DualRange::default()
            }),
            FrontEnd::Hah1bv(Hah1bv {
                microvolts_per_amp: signal_millivolts / 2,
                full_scale: FULL_SCALE_LIMITS.1,
            }),
        ];
        for sensor in sensors {
            let line = sensor.line(Range::Large, FIVE);
            let exact = mul_div(2_250_000_000, line.numerator, line.denominator);
            let full_scale = i64::from(sensor.meter_full_scale(Range::Large).get());
            assert!(
                sensor.validate().is_err() || full_scale == exact,
                "{sensor:?}: {full_scale} of {exact}"
            );
        }
    }
}

#[test]
fn d0_reproduces_its_numbers() {
    let d0 = FrontEnd::default();
    let small = |volts| d0.current(volts, Range::Small, FIVE);
    assert_eq!(
        d0.voltage(Microamps::from_amps(55), Range::Small, FIVE),
        Microvolts(4_562_500)
    );
    assert_eq!(small(Microvolts(4_562_500)), Microamps::from_amps(55));
    assert_eq!(small(design::COMPARATOR_HIGH), design::SWITCHING_CURRENT);
    assert_eq!(
        small(design::COMPARATOR_LOW),
        Microamps(-design::SWITCHING_CURRENT.get())
    );
    assert_eq!(
        d0.voltage(design::SWITCHING_CURRENT, Range::Small, FIVE),
        design::COMPARATOR_HIGH
    );
    assert_eq!(
        d0.voltage(
            Microamps(-design::SWITCHING_CURRENT.get()),
            Range::Small,
            FIVE
        ),
        design::COMPARATOR_LOW
    );
    assert_eq!(
        d0.current(millivolts(4_750), Range::Large, FIVE),
        Microamps::from_amps(600)
    );
    assert_eq!(
        d0.current(millivolts(250), Range::Large, FIVE),
        Microamps::from_amps(-600)
    );
    assert_eq!(small(millivolts(2_500)), Microamps::ZERO);
}

#[test]
fn d2_is_250_times_the_distance_from_half_the_supply() {
    let d2 = FrontEnd::Hah1bv(Hah1bv::default());
    for offset in [-2_000_000, -123_457, -1, 0, 1, 77, 2_000_000] {
        let volts = Microvolts(2_500_000 + offset);
        assert_eq!(
            d2.current(volts, Range::Small, FIVE),
            Microamps(250 * offset)
        );
        assert_eq!(
            d2.voltage(Microamps(250 * offset), Range::Large, FIVE),
            volts
        );
    }
}

#[test]
fn d3_reproduces_its_numbers() {
    let d3 = FrontEnd::Network(Network::default());
    let volts = |amps| d3.voltage(Microamps::from_amps(amps), Range::Small, FIVE);
    assert_eq!(volts(0), millivolts(1_650));
    assert_eq!(volts(500), millivolts(2_550));
    assert_eq!(volts(-500), millivolts(750));
    assert_eq!(
        d3.current(millivolts(2_550), Range::Small, FIVE),
        Microamps::from_amps(500)
    );
    let shifted = FrontEnd::Network(Network {
        sensor_zero: millivolts(1_000),
        ..Network::default()
    });
    assert_eq!(shifted.zero_output(Range::Small, FIVE), millivolts(1_875));
    assert_eq!(design::NETWORK_GAIN, (9, 40));
}

#[test]
fn d4_follows_its_supply() {
    let d4 = FrontEnd::ClosedLoop(ClosedLoop::default());
    let at = |volts, supply| d4.current(millivolts(volts), Range::Small, millivolts(supply));
    let close = |current: Microamps, amps: i32| {
        // k1 is rounded in its tenth digit.
        assert!(
            (current.get() - amps * 1_000_000).abs() <= 1,
            "{current:?} {amps}"
        );
    };
    close(at(4_500, 5_000), 300);
    close(at(4_050, 4_500), 300);
    close(at(550, 5_500), -300);
    assert_eq!(at(2_250, 4_500), Microamps::ZERO);
    assert_eq!(
        d4.zero_output(Range::Large, millivolts(5_500)),
        millivolts(2_750)
    );
    // Both relations with all four numbers: (2 Ω/V · 5 V + 3 Ω) · I / 1000 + 0.4 · 5 V + 0.1 V.
    let sensor = FrontEnd::ClosedLoop(ClosedLoop {
        turns: 1_000,
        relations: SupplyRelations {
            k1_nanoohm_per_volt: 2_000_000_000,
            m1_nanoohm: 3_000_000_000,
            k2_nanovolt_per_volt: 400_000_000,
            m2_nanovolt: 100_000_000,
        },
        full_scale: Microamps::from_amps(100),
    });
    assert_eq!(
        sensor.voltage(Microamps::from_amps(100), Range::Small, FIVE),
        millivolts(3_400)
    );
    assert_eq!(
        sensor.current(millivolts(3_400), Range::Small, FIVE),
        Microamps::from_amps(100)
    );
    assert_eq!(
        sensor.output_limits_at(Range::Small, FIVE).low,
        millivolts(800)
    );
}

#[test]
fn d4_example_returns_0_a_in_acc() {
    // VOUT0 = 2.5 V, VC1 = 2.49 V, VC2 = 2.48 V: a = 0.01 V, k = 2.5 / 2.49.
    let factors = KeyFactors {
        k_ppb: 1_004_016_064,
        a: millivolts(10),
    };
    let d4 = FrontEnd::ClosedLoop(ClosedLoop::default());
    let corrected = factors.apply(millivolts(2_480));
    assert_eq!(corrected, millivolts(2_500));
    assert_eq!(d4.current(corrected, Range::Small, FIVE), Microamps::ZERO);
    assert_eq!(
        KeyFactors {
            a: Microvolts::ZERO,
            ..factors
        }
        .apply(millivolts(2_490)),
        millivolts(2_500)
    );
    assert_eq!(KeyFactors::default(), KeyFactors::NONE);
    assert_eq!(
        KeyFactors::NONE.apply(Microvolts(-1_234_567)),
        Microvolts(-1_234_567)
    );
}

#[test]
fn outputs_end_where_the_documents_say() {
    let limits = all().map(|front_end| front_end.output_limits(Range::Small));
    assert_eq!(limits[0].low, design::DUAL_RANGE_OUTPUT_LOW);
    assert_eq!(limits[0].high, design::DUAL_RANGE_OUTPUT_HIGH);
    assert_eq!(limits[1].low, design::HAH1BV_OUTPUT_LOW);
    assert_eq!(limits[1].high, design::HAH1BV_OUTPUT_HIGH);
    assert_eq!(limits[2].low, millivolts(750));
    assert_eq!(limits[2].high, millivolts(2_550));
    assert_eq!(limits[3].low, millivolts(500));
    assert_eq!(limits[3].high, millivolts(4_500));
    assert_eq!(all()[0].output_limits(Range::Large), limits[0]);
    let at_4_5 = all()[3].output_limits_at(Range::Small, millivolts(4_500));
    assert_eq!(
        (at_4_5.low, at_4_5.high),
        (millivolts(450), millivolts(4_050))
    );
}

#[test]
fn meter_is_at_full_scale_with_2_25_v_of_signal() {
    let full_scales = all().map(|front_end| front_end.meter_full_scale(Range::Small));
    assert_eq!(full_scales[0], Microamps::from_amps(60));
    assert_eq!(
        all()[0].meter_full_scale(Range::Large),
        Microamps::from_amps(600)
    );
    assert_eq!(full_scales[1], Microamps(562_500_000));
    assert_eq!(full_scales[2], Microamps::from_amps(1_250));
    assert_eq!(full_scales[3], Microamps(337_500_000));
}

#[test]
fn only_d3_is_on_adc1_and_only_d0_has_two_ranges() {
    assert_eq!(
        all().map(|front_end| front_end.channel()),
        [
            Channel::Ads1100,
            Channel::Ads1100,
            Channel::Adc1,
            Channel::Ads1100
        ]
    );
    assert_eq!(
        all().map(|front_end| front_end.has_two_ranges()),
        [true, false, false, false]
    );
    assert_eq!(
        all().map(|front_end| front_end.full_scale(Range::Large).get() / 1_000_000),
        [600, 500, 500, 300]
    );
    assert_eq!(all()[0].full_scale(Range::Small), Microamps::from_amps(60));
}

#[test]
fn per_range_keeps_its_two_values_apart() {
    let mut pair = PerRange::both(1);
    pair.set(Range::Large, 2);
    assert_eq!((pair.get(Range::Small), pair.get(Range::Large)), (1, 2));
    pair.set(Range::Small, 3);
    assert_eq!(pair, PerRange { small: 3, large: 2 });
}

#[test]
fn validation_names_the_reason() {
    for front_end in all() {
        assert_eq!(front_end.validate(), Ok(()));
    }
    let d0 = |small: i32, large: i32, swing: i32| {
        FrontEnd::DualRange(DualRange {
            full_scale: PerRange {
                small: Microamps(small),
                large: Microamps(large),
            },
            swing: Microvolts(swing),
            ..DualRange::default()
        })
        .validate()
    };
    assert_eq!(
        d0(999_999, 600_000_000, 2_250_000),
        Err(FrontEndError::FullScale)
    );
    assert_eq!(d0(1_000_000, 2_000_000_000, 2_250_000), Ok(()));
    assert_eq!(
        d0(60_000_000, 2_000_000_001, 2_250_000),
        Err(FrontEndError::FullScale)
    );
    assert_eq!(
        d0(60_000_000, 60_000_000, 2_250_000),
        Err(FrontEndError::FullScale)
    );
    assert_eq!(d0(60_000_000, 60_000_001, 2_250_000), Ok(()));
    assert_eq!(
        d0(60_000_000, 600_000_000, 0),
        Err(FrontEndError::Sensitivity)
    );
    assert_eq!(
        d0(60_000_000, 600_000_000, -1),
        Err(FrontEndError::Sensitivity)
    );
    assert_eq!(
        d0(60_000_000, 600_000_000, 2_500_000),
        Err(FrontEndError::Sensitivity)
    );
    assert_eq!(d0(60_000_000, 600_000_000, 2_499_999), Ok(()));
    assert_eq!(d0(60_000_000, 600_000_000, 631_579), Ok(()));
    assert_eq!(
        d0(60_000_000, 601_000_000, 631_579),
        Err(FrontEndError::Sensitivity)
    );
    let high_zero = |zero| {
        FrontEnd::DualRange(DualRange {
            zero: Microvolts(zero),
            ..DualRange::default()
        })
        .validate()
    };
    assert_eq!(high_zero(2_749_999), Ok(()));
    assert_eq!(high_zero(2_750_000), Err(FrontEndError::Sensitivity));
    assert_eq!(high_zero(2_250_000), Err(FrontEndError::Sensitivity));
    let hah1bv = |microvolts_per_amp| {
        FrontEnd::Hah1bv(Hah1bv {
            microvolts_per_amp,
            ..Hah1bv::default()
        })
        .validate()
    };
    assert_eq!(hah1bv(0), Err(FrontEndError::Sensitivity));
    assert_eq!(hah1bv(1_053), Ok(()));
    assert_eq!(hah1bv(1_052), Err(FrontEndError::Sensitivity));
    let network = |sensor_nanovolts_per_amp| {
        FrontEnd::Network(Network {
            sensor_nanovolts_per_amp,
            ..Network::default()
        })
        .validate()
    };
    assert_eq!(network(-1), Err(FrontEndError::Sensitivity));
    // ±1.65 V of 0 … 3.3 V: 1.65 V / 0.225 / 500 A.
    assert_eq!(network(14_666_000), Ok(()));
    assert_eq!(network(14_667_000), Err(FrontEndError::Sensitivity));
}

#[test]
fn validation_of_d4_holds_over_the_supply() {
    let default = ClosedLoop::default();
    let with = |turns, relations| {
        FrontEnd::ClosedLoop(ClosedLoop {
            turns,
            relations,
            ..default
        })
        .validate()
    };
    assert_eq!(with(0, default.relations), Err(FrontEndError::Turns));
    assert_eq!(with(20_001, default.relations), Err(FrontEndError::Turns));
    // 1 turn: 13.3 Ω is 13.3 V/A.
    assert_eq!(with(1, default.relations), Err(FrontEndError::Sensitivity));
    assert_eq!(
        with(20_000, default.relations),
        Err(FrontEndError::Sensitivity)
    );
    let relations = |k1, m1, k2, m2| SupplyRelations {
        k1_nanoohm_per_volt: k1,
        m1_nanoohm: m1,
        k2_nanovolt_per_volt: k2,
        m2_nanovolt: m2,
    };
    let half = 500_000_000;
    // Zero impedance at one end of the supply alone.
    assert_eq!(
        with(2_000, relations(4_000_000_000, -18_000_000_000, half, 0)),
        Err(FrontEndError::Relations)
    );
    assert_eq!(
        with(2_000, relations(-4_000_000_000, 22_000_000_000, half, 0)),
        Err(FrontEndError::Relations)
    );
    // Zero output at ground, and at the supply, at one end alone.
    assert_eq!(
        with(2_000, relations(0, 13_000_000_000, half, -2_250_000_000)),
        Err(FrontEndError::Relations)
    );
    assert_eq!(
        with(2_000, relations(0, 13_000_000_000, 0, 4_500_000_000)),
        Err(FrontEndError::Relations)
    );
    assert_eq!(
        with(2_000, relations(0, 13_000_000_000, 0, 2_500_000_000)),
        Ok(())
    );
    // 1.053 mV/A with N = 2,000 is 2.105 Ω: below it at one end of the supply alone.
    let coarse = Err(FrontEndError::Sensitivity);
    assert_eq!(
        with(2_000, relations(1_000_000_000, -2_396_000_000, half, 0)),
        coarse
    );
    assert_eq!(
        with(2_000, relations(-1_000_000_000, 7_604_000_000, half, 0)),
        coarse
    );
    assert_eq!(
        with(2_000, relations(-1_000_000_000, 7_605_000_000, half, 0)),
        Ok(())
    );
    assert_eq!(
        FrontEnd::ClosedLoop(ClosedLoop {
            full_scale: Microamps::ZERO,
            ..default
        })
        .validate(),
        Err(FrontEndError::FullScale)
    );
}

#[test]
fn a_broken_configuration_reads_out_of_range_and_not_0_a() {
    let broken = FrontEnd::ClosedLoop(ClosedLoop {
        relations: SupplyRelations {
            k1_nanoohm_per_volt: 0,
            ..SupplyRelations::default()
        },
        ..ClosedLoop::default()
    });
    assert_eq!(
        broken.current(millivolts(2_501), Range::Small, FIVE),
        Microamps(i32::MAX)
    );
    assert_eq!(
        broken.current(millivolts(2_499), Range::Small, FIVE),
        Microamps(i32::MIN)
    );
}

proptest! {
    #[test]
    fn current_to_voltage_and_back(
        front_end in any_valid(), range in any_range(), supply in any_supply(), amps in -1.0..1.0_f64
    ) {
        let full_scale = front_end.full_scale(range).get();
        let current = (f64::from(full_scale) * amps) as i32;
        let volts = front_end.voltage(Microamps(current), range, supply);
        let back = front_end.current(volts, range, supply).get();
        let line = front_end.line(range, supply);
        let microamps_per_microvolt = 1e3 * line.numerator as f64 / line.denominator as f64;
        let error = f64::from(back - current).abs();
        prop_assert!(error <= 0.501 * microamps_per_microvolt + 0.501, "{} {}", error, microamps_per_microvolt);
    }

    #[test]
    fn voltage_to_current_and_back(
        front_end in any_valid(), range in any_range(), supply in any_supply(), volts in 0..5_000_000
    ) {
        let current = front_end.current(Microvolts(volts), range, supply);
        // Beyond ±2,147 A the type ends.
        prop_assume!(current.get() > i32::MIN && current.get() < i32::MAX);
        let back = front_end.voltage(current, range, supply).get();
        let line = front_end.line(range, supply);
        let microvolts_per_microamp = 1e-3 * line.denominator as f64 / line.numerator as f64;
        prop_assert!(f64::from(back - volts).abs() <= 0.51 + 0.51 * microvolts_per_microamp);
    }

    #[test]
    fn more_volts_are_more_amperes(
        front_end in any_valid(), range in any_range(), supply in any_supply(),
        volts in 0..5_000_000, more in 1..1_000_000
    ) {
        let at = |volts| front_end.current(Microvolts(volts), range, supply);
        prop_assert!(at(volts) <= at(volts + more));
        prop_assert!(front_end.voltage(Microamps(volts), range, supply)
            <= front_end.voltage(Microamps(volts + more), range, supply));
    }

    #[test]
    fn both_signs_are_treated_alike(range in any_range(), volts in 0..2_500_000) {
        for front_end in all() {
            let zero = front_end.zero_output(range, FIVE).get();
            let up = front_end.current(Microvolts(zero + volts), range, FIVE);
            let down = front_end.current(Microvolts(zero - volts), range, FIVE);
            prop_assert_eq!(up.get(), -down.get());
        }
    }

    #[test]
    fn supply_matters_to_d4_alone(range in any_range(), supply in any_supply(), volts in 0..5_000_000) {
        for front_end in &all()[..3] {
            prop_assert_eq!(
                front_end.current(Microvolts(volts), range, supply),
                front_end.current(Microvolts(volts), range, FIVE)
            );
        }
    }

    #[test]
    fn rounding_of_the_relations_costs_less_than_1_ma(
        turns in 1..5_000_i32, sensitivity in 3e-3..20e-3_f64, share in 0.0..1.0_f64,
        k2 in 0.4..0.6_f64, supply in any_supply(), amps in -600.0..600.0_f64
    ) {
        let impedance = sensitivity * f64::from(turns);
        let (k1, m1) = (impedance * share / 5.0, impedance * (1.0 - share));
        let vc = f64::from(supply.get()) * 1e-6;
        let signal = (k1 * vc + m1) * amps / f64::from(turns) + k2 * vc;
        let nanovolts = (signal * 1e9).round() as i64;
        let sensor = FrontEnd::ClosedLoop(ClosedLoop {
            turns,
            relations: SupplyRelations {
                k1_nanoohm_per_volt: (k1 * 1e9).round() as i64,
                m1_nanoohm: (m1 * 1e9).round() as i64,
                k2_nanovolt_per_volt: (k2 * 1e9).round() as i64,
                m2_nanovolt: 0,
            },
            full_scale: Microamps::from_amps(600),
        });
        let line = sensor.line(Range::Small, supply);
        let current = mul_div(nanovolts - line.zero_nanovolts, line.numerator, line.denominator);
        prop_assert!((current as f64 - amps * 1e6).abs() < 1_000.0);
    }

    #[test]
    fn key_factors_agree_with_the_formula(volts in 0..5_000_000, k in 900_000_000..1_100_000_000, a in -100_000..100_000) {
        let exact = f64::from(k) * 1e-9 * f64::from(volts + a);
        let got = KeyFactors { k_ppb: k, a: Microvolts(a) }.apply(Microvolts(volts));
        prop_assert!((f64::from(got.get()) - exact).abs() <= 0.500_001);
    }

    #[test]
    fn nothing_panics(front_end in any_front_end(), range in any_range(), volts: i32, supply: i32, key: [i32; 2]) {
        let (volts, supply) = (Microvolts(volts), Microvolts(supply));
        let _ = front_end.current(volts, range, supply);
        let _ = front_end.voltage(Microamps(volts.get()), range, supply);
        let _ = (front_end.output_limits_at(range, supply), front_end.meter_full_scale(range), front_end.validate());
        let _ = KeyFactors { k_ppb: key[0], a: Microvolts(key[1]) }.apply(volts);
    }
}
