use super::*;
use crate::ocv::OcvPoint;
use proptest::prelude::*;

const COULOMB: i64 = 1_000_000_000;

/// 10 Ah = 36,000 C, no loss, so that a per cent is 360 C.
fn config() -> SocConfig {
    SocConfig {
        capacity_mah: 10_000,
        coulombic_efficiency: Ppm::ONE,
        rest_current: Microamps::from_milliamps(500),
        rest_time_s: 600,
        stability: Microvolts(1_000),
        stability_window_s: 60,
        cell_voltage_max_age_ms: 1_000,
        ocv_uncertainty: Microvolts(10_000),
        offset_uncertainty: Microamps::ZERO,
        no_load_threshold: Microamps::ZERO,
        gain_uncertainty: Ppm::ZERO,
        capacity_uncertainty: Ppm::ZERO,
        presented_slew_ppm_per_s: 100,
    }
}

/// 3 V + 1 µV per ppm.
fn straight() -> OcvTable {
    let point = |soc, voltage| OcvPoint {
        soc: Ppm(soc),
        voltage: Microvolts(voltage),
    };
    OcvTable::new(&[point(0, 3_000_000), point(1_000_000, 4_000_000)]).unwrap()
}

struct Bench {
    coefficients: SocCoefficients,
    table: OcvTable,
    soc: Soc,
    now_us: u64,
    total: i64,
    current: Option<Microamps>,
    /// Sent with every step.
    cell: Option<Microvolts>,
    events: std::vec::Vec<SocEvent>,
}

impl Bench {
    fn new(config: &SocConfig, start: i32, uncertainty: i32) -> Self {
        let coefficients = SocCoefficients::new(config);
        let mut soc = Soc::new(&coefficients);
        soc.set(&coefficients, Ppm(start), Ppm(uncertainty));
        Self {
            coefficients,
            table: straight(),
            soc,
            now_us: 5_000_000,
            total: 0,
            current: None,
            cell: None,
            events: std::vec::Vec::new(),
        }
        .started()
    }

    fn started(mut self) -> Self {
        self.step(0, 0);
        self
    }

    /// `delta` flows within `us`, at constant current.
    fn step(&mut self, us: u64, delta: i64) {
        self.now_us += us;
        self.total += delta;
        let now = Instant::from_ticks(self.now_us);
        let input = SocInput {
            now,
            charge_total: Nanocoulombs(self.total),
            current: self.current,
            cell_voltage: self.cell.map(|voltage| CellVoltage { voltage, at: now }),
        };
        self.events
            .extend(self.soc.update(&self.coefficients, &self.table, &input));
    }

    fn rest(&mut self, seconds: u32) {
        for _ in 0..seconds {
            self.step(1_000_000, 0);
        }
    }

    fn reading(&self) -> SocReading {
        self.soc.reading(&self.coefficients)
    }
}

/// <https://github.com/foxBMS/foxbms-2/issues/82>: a state of charge computed from the magnitude of the current
/// sensor's counter jumps up by twice the counter when charging goes on after a re-anchoring at a negative counter.
#[test]
fn foxbms_2_issue_82_sign_of_the_counter_is_kept() {
    let mut bench = Bench::new(&config(), 750_000, 1_000_000);
    bench.current = Some(Microamps::from_amps(-20));
    for _ in 0..450 {
        bench.step(1_000_000, -20 * COULOMB);
    }
    // The counter stands at −9,000 As, the state of charge at 75 % + 25 % = 100 %; the rest finds it is 60 %.
    assert_eq!(bench.total, -9_000 * COULOMB);
    assert_eq!(bench.reading().estimate, Ppm::ONE);
    bench.current = Some(Microamps::ZERO);
    bench.cell = Some(Microvolts(3_600_000));
    bench.rest(601);
    assert_eq!(bench.reading().anchors, 1);
    let anchored = bench.reading().remaining.get();
    assert!(
        (anchored - 21_600 * COULOMB).abs() < 10 * COULOMB,
        "{anchored}"
    );
    // The first charging step moves it by that step and by nothing else: 10 C, not 2 · 9,000 C.
    bench.current = Some(Microamps::from_amps(-10));
    bench.step(1_000_000, -10 * COULOMB);
    assert_eq!(bench.reading().remaining.get() - anchored, 10 * COULOMB);
    // And through a counter that passes zero in discharge.
    bench.step(1_000_000, 9_020 * COULOMB);
    assert_eq!(bench.total, 10 * COULOMB);
    assert_eq!(bench.reading().remaining.get() - anchored, -9_010 * COULOMB);
}

#[test]
fn the_defaults_are_those_that_the_comments_give() {
    let config = SocConfig::default();
    assert_eq!(config.capacity_mah, 240_000);
    assert_eq!(config.no_load_threshold, Microamps(3_000));
    assert_eq!(EXCURSION, Nanocoulombs(1_000_000_000));
    let coefficients = SocCoefficients::new(&config);
    assert_eq!(coefficients.capacity(), Nanocoulombs(864_000 * COULOMB));
    // 0.2 % in 2^-32, and 200 ppm of 864,000 C in a second is 172,800 nC in a microsecond.
    assert_eq!(coefficients.loss_q32, 8_589_935);
    assert_eq!(coefficients.slew_per_us, 172_800 << SLEW_PLACES);
    // 3 %, 20 nC and 3 nC in a microsecond.
    assert_eq!(coefficients.throughput_q32, 128_849_019);
    assert_eq!(coefficients.offset_per_us, 20 << PER_US_PLACES);
    assert_eq!(coefficients.no_load_per_us, 3 << PER_US_PLACES);
}

#[test]
fn a_configuration_beyond_its_limits_is_taken_at_the_limit() {
    let smallest = SocCoefficients::new(&SocConfig {
        capacity_mah: 0,
        coulombic_efficiency: Ppm(i32::MIN),
        gain_uncertainty: Ppm(-7),
        capacity_uncertainty: Ppm(-7),
        presented_slew_ppm_per_s: 0,
        ..config()
    });
    assert_eq!(smallest.capacity, 3_600_000_000);
    assert_eq!(smallest.loss_q32, 1 << 31);
    assert_eq!(smallest.throughput_q32, 0);
    // One ppm of 1 mAh in a second rounds to 3 / 1024 nC in a microsecond.
    assert_eq!(smallest.slew_per_us, 3);
    let largest = SocCoefficients::new(&SocConfig {
        capacity_mah: u32::MAX,
        coulombic_efficiency: Ppm(i32::MAX),
        presented_slew_ppm_per_s: u32::MAX,
        ..config()
    });
    assert_eq!(largest.capacity, 2_000_000 * 3_600_000_000);
    assert_eq!(largest.loss_q32, 0);
    assert_eq!(largest.slew_per_us, 72_000_000 << SLEW_PLACES);
    for coefficients in [smallest, largest] {
        assert!((1 << 30..1i64 << 31).contains(&(coefficients.capacity >> coefficients.shift)));
    }
}

#[test]
fn discharge_is_positive_and_lowers_it() {
    let mut bench = Bench::new(&config(), 500_000, 0);
    bench.step(10_000, 360 * COULOMB);
    assert_eq!(bench.reading().remaining, Nanocoulombs(17_640 * COULOMB));
    assert!((bench.reading().estimate.get() - 490_000).abs() <= 1);
    bench.step(10_000, -720 * COULOMB);
    assert_eq!(bench.reading().remaining, Nanocoulombs(18_360 * COULOMB));
    assert_eq!(bench.soc.throughput().1, Nanocoulombs(360 * COULOMB));
    assert_eq!(bench.soc.throughput().0, Nanocoulombs(720 * COULOMB));
    assert_eq!(bench.reading().clipped, Nanocoulombs::ZERO);
    assert_eq!(bench.soc.equivalent_cycles_milli(&bench.coefficients), 10);
}

#[test]
fn leaving_empty_or_full_is_immediate() {
    let mut bench = Bench::new(&config(), 990_000, 0);
    bench.step(10_000, -400 * COULOMB);
    assert_eq!(bench.reading().estimate, Ppm::ONE);
    assert_eq!(bench.reading().clipped, Nanocoulombs(40 * COULOMB));
    bench.step(10_000, 36 * COULOMB);
    assert_eq!(bench.reading().remaining, Nanocoulombs(35_964 * COULOMB));
    bench.step(10_000, 35_970 * COULOMB);
    assert_eq!(bench.reading().presented, Ppm::ZERO);
    assert_eq!(bench.reading().clipped, Nanocoulombs(46 * COULOMB));
    bench.step(10_000, -36 * COULOMB);
    assert_eq!(bench.reading().remaining, Nanocoulombs(36 * COULOMB));
}

/// A sensor's zero drift of 2.5 A that is taken off by the meter: at 0 A four of five polls count once, 12.9 mC more than the
/// drift, and every fifth does not.
#[test]
fn a_zero_drift_that_is_taken_off_is_no_throughput() {
    let mut bench = Bench::new(&config(), 500_000, 0);
    let before = bench.reading().uncertainty;
    let mut net = 0;
    for poll in 0..3_600 * 50 {
        let delta = if net < 0 { 12_860_000 } else { -50_000_000 };
        net += delta;
        bench.step(20_000, delta);
        let kept = bench.soc.retained();
        assert_eq!(kept.discharged.get() - kept.charged.get(), net, "{poll}");
        let throughput = kept.charged.saturating_add(kept.discharged);
        assert!(throughput < EXCURSION, "{throughput:?} after {poll} polls");
    }
    // As an hour in which nothing was counted to and fro.
    let mut still = Bench::new(&config(), 500_000, 0);
    for _ in 0..3_600 * 50 {
        still.step(20_000, 1);
    }
    let grown = |bench: &Bench| bench.reading().uncertainty.get() - before.get();
    assert!(grown(&bench) <= grown(&still) + 1);
}

#[test]
fn charging_bears_the_loss_and_flicker_does_not() {
    let lossy = SocConfig {
        coulombic_efficiency: Ppm(990_000),
        ..config()
    };
    let mut bench = Bench::new(&lossy, 500_000, 0);
    // A count of the meter to and fro, a thousand times: nothing is lost.
    for _ in 0..1_000 {
        bench.step(10_000, -6_700_000);
        bench.step(10_000, 6_700_000);
    }
    assert_eq!(bench.reading().remaining, Nanocoulombs(18_000 * COULOMB));
    assert_eq!(bench.soc.throughput(), Default::default());
    // 101 C charged: 1 C in the band, 100 C with 1 % less.
    for _ in 0..101 {
        bench.step(10_000, -COULOMB);
    }
    assert!((bench.reading().remaining.get() - 18_100 * COULOMB).abs() <= 1);
    // The band opens again by what is discharged, up to 1 C.
    bench.step(10_000, COULOMB / 2);
    bench.step(10_000, -COULOMB);
    assert!((bench.reading().remaining.get() - (18_100_500_000_000 - 5_000_000)).abs() <= 2);
    bench.step(10_000, 2 * COULOMB);
    bench.step(10_000, -2 * COULOMB);
    assert!((bench.reading().remaining.get() - (18_100_500_000_000 - 15_000_000)).abs() <= 2);
    // Discharging bears none.
    bench.step(10_000, 100 * COULOMB);
    assert!((bench.reading().remaining.get() - (18_000_500_000_000 - 15_000_000)).abs() <= 2);
}

#[test]
fn uncertainty_grows_with_time_throughput_and_silence() {
    let uncertain = SocConfig {
        offset_uncertainty: Microamps::from_milliamps(20),
        no_load_threshold: Microamps::from_milliamps(3),
        gain_uncertainty: Ppm(10_000),
        capacity_uncertainty: Ppm(20_000),
        ..config()
    };
    let mut bench = Bench::new(&uncertain, 500_000, 1_000);
    let start = 36 * COULOMB;
    assert_eq!(bench.soc.retained().uncertainty.get(), start);
    bench.rest(100);
    // 100 s · 23 mA
    assert_eq!(
        bench.soc.retained().uncertainty.get(),
        start + 2_300_000_000
    );
    for _ in 0..50 {
        bench.step(1_000_000, 2 * COULOMB);
        bench.step(1_000_000, -2 * COULOMB);
    }
    // 100 s · 20 mA, and 3 % of 200 C; the counter was never silent.
    assert_eq!(
        bench.soc.retained().uncertainty.get(),
        start + 4_300_000_000 + 6 * COULOMB
    );
    // Only whole seconds count; the rest is kept for the next one.
    bench.step(600_000, 0);
    assert_eq!(
        bench.soc.retained().uncertainty.get(),
        start + 10_300_000_000
    );
    bench.step(400_000, 0);
    assert_eq!(
        bench.soc.retained().uncertainty.get(),
        start + 10_323_000_000
    );
    // Both directions within one second add up: 3 % of 4 C.
    bench.step(500_000, 2 * COULOMB);
    bench.step(500_000, -2 * COULOMB);
    let now = start + 10_323_000_000 + 20_000_000 + 120_000_000;
    assert_eq!(bench.soc.retained().uncertainty.get(), now);
    // What was charged and discharged before a reset has been counted already.
    bench.soc = Soc::restore(
        &bench.coefficients,
        &bench.soc.retained(),
        Nanocoulombs(bench.total),
    );
    bench.step(0, 0);
    bench.step(1_000_000, 0);
    assert_eq!(bench.soc.retained().uncertainty.get(), now + 23_000_000);
    // An hour in one step.
    bench.step(3_600_000_000, COULOMB);
    let now = now + 23_000_000 + 72_000_000_000 + 30_000_000;
    assert_eq!(bench.soc.retained().uncertainty.get(), now);
    bench
        .soc
        .declare_loss(&bench.coefficients, Nanocoulombs(-COULOMB));
    assert_eq!(bench.soc.retained().uncertainty.get(), now + COULOMB);
    bench
        .soc
        .declare_loss(&bench.coefficients, Nanocoulombs(i64::MAX));
    assert_eq!(bench.reading().uncertainty, Ppm::ONE);
}

#[test]
fn unknown_until_the_first_rest_which_is_presented_at_once() {
    let coefficients = SocCoefficients::new(&config());
    let mut bench = Bench::new(&config(), 0, 0);
    bench.soc = Soc::new(&coefficients);
    let reading = bench.reading();
    assert!(!reading.known && !reading.resting);
    assert_eq!(
        (reading.estimate, reading.uncertainty),
        (Ppm(500_000), Ppm::ONE)
    );
    bench.current = Some(Microamps::from_milliamps(-500));
    bench.cell = Some(Microvolts(3_800_000));
    bench.step(0, 0);
    bench.rest(599);
    assert!(!bench.reading().known && bench.reading().resting);
    bench.rest(1);
    let reading = bench.reading();
    assert!(reading.known);
    assert_eq!(reading.anchors, 1);
    assert_eq!(
        (reading.presented, reading.estimate),
        (Ppm(800_000), Ppm(800_000))
    );
    assert_eq!(reading.uncertainty, Ppm(10_000));
    assert_eq!(bench.events.len(), 1);
    assert!(matches!(
        bench.events[0],
        SocEvent::Anchored {
            ocv: Ppm(800_000),
            before: Ppm(500_000),
            after: Ppm(800_000)
        }
    ));
}

#[test]
fn a_rest_blends_by_inverse_variance_and_the_bus_follows_slowly() {
    // Prior 50 ± 2 %, table 60 ± 1 %: weight 4/5, so 58 ± 0.894 %.
    let mut bench = Bench::new(&config(), 500_000, 20_000);
    bench.current = Some(Microamps::ZERO);
    bench.cell = Some(Microvolts(3_600_000));
    bench.step(0, 0);
    bench.rest(600);
    let reading = bench.reading();
    assert_eq!(reading.anchors, 1);
    assert!((reading.estimate.get() - 580_000).abs() <= 2, "{reading:?}");
    assert!(
        (reading.uncertainty.get() - 8_944).abs() <= 2,
        "{reading:?}"
    );
    // Presented: still 50 %, then 100 ppm in a second.
    assert!((reading.presented.get() - 500_000).abs() <= 1);
    bench.rest(10);
    assert!((bench.reading().presented.get() - 501_000).abs() <= 1);
    // What flows shows at once: 360 C are 1 %.
    bench.step(1_000_000, 360 * COULOMB);
    assert!((bench.reading().presented.get() - 491_100).abs() <= 1);
    bench.rest(788);
    let reading = bench.reading();
    assert!(
        (reading.presented.get() - 569_900).abs() <= 1,
        "{reading:?}"
    );
    bench.rest(2);
    let reading = bench.reading();
    assert_eq!(reading.presented, reading.estimate);
    assert!(
        (reading.presented.get() - 570_000).abs() <= 2,
        "{reading:?}"
    );
}

#[test]
fn the_bus_follows_downwards_as_slowly() {
    let mut bench = Bench::new(&config(), 700_000, 20_000);
    bench.current = Some(Microamps::ZERO);
    bench.cell = Some(Microvolts(3_600_000));
    bench.step(0, 0);
    bench.rest(600);
    assert!((bench.reading().estimate.get() - 620_000).abs() <= 2);
    bench.rest(10);
    assert!((bench.reading().presented.get() - 699_000).abs() <= 1);
    bench.rest(900);
    assert_eq!(bench.reading().presented, bench.reading().estimate);
    assert_eq!(bench.soc.retained().presented_offset, Nanocoulombs::ZERO);
}

#[test]
fn presented_does_not_stick_to_an_end_either() {
    let mut bench = Bench::new(&config(), 995_000, 20_000);
    bench.current = Some(Microamps::ZERO);
    bench.cell = Some(Microvolts(3_970_000));
    bench.step(0, 0);
    bench.rest(600);
    // 99.5 → 97.5 %, presented 2 % above; charging 1 % brings presented to 100 % and the estimate to 98.5 %.
    bench.step(0, -360 * COULOMB);
    assert_eq!(bench.reading().presented, Ppm::ONE);
    assert!((bench.reading().estimate.get() - 985_000).abs() <= 2);
    bench.step(0, 36 * COULOMB);
    assert!((bench.reading().presented.get() - 999_000).abs() <= 1);
}

#[test]
fn a_flat_curve_counts_little() {
    let point = |soc, voltage| OcvPoint {
        soc: Ppm(soc),
        voltage: Microvolts(voltage),
    };
    let mut bench = Bench::new(&config(), 500_000, 20_000);
    bench.table = OcvTable::new(&[
        point(0, 3_000_000),
        point(200_000, 3_280_000),
        point(800_000, 3_320_000),
        point(1_000_000, 3_600_000),
    ])
    .unwrap();
    // 15 ppm per µV: 10 mV are 15 %, the table says 65 %; weight 4/229 of 15 %.
    bench.current = Some(Microamps::ZERO);
    bench.cell = Some(Microvolts(3_310_000));
    bench.step(0, 0);
    bench.rest(600);
    let reading = bench.reading();
    assert_eq!(reading.anchors, 1);
    assert!((reading.estimate.get() - 502_620).abs() <= 3, "{reading:?}");
    assert!(
        (reading.uncertainty.get() - 20_000).abs() <= 2,
        "{reading:?}"
    );
}

#[test]
fn a_rest_counts_once_until_the_uncertainty_has_doubled() {
    let drifting = SocConfig {
        // 1 % of 36,000 C in 1,000 s
        offset_uncertainty: Microamps::from_milliamps(360),
        ..config()
    };
    let mut bench = Bench::new(&drifting, 500_000, 0);
    bench.current = Some(Microamps::ZERO);
    bench.cell = Some(Microvolts(3_600_000));
    bench.step(0, 0);
    bench.rest(600);
    assert_eq!(bench.reading().anchors, 1);
    // Prior 0.6 %, table 1 %; afterwards 0.6 % again, for it was below 1/√2 % before.
    let first = bench.reading().uncertainty.get();
    assert!((first - 6_000).abs() <= 2, "{first}");
    bench.rest(599);
    assert_eq!(bench.reading().anchors, 1);
    bench.rest(2);
    assert_eq!(bench.reading().anchors, 2);
    // Prior 1.2 %: blended 0.768 %, above the floor.
    let second = bench.reading().uncertainty.get();
    assert!((second - 7_680).abs() <= 20, "{second}");
    // Exactly doubled is enough.
    let doubled = bench.soc.anchored_at.unwrap() * 2 - 360_000_000;
    bench.soc.kept.uncertainty = Nanocoulombs(doubled - 1);
    bench.rest(1);
    assert_eq!(bench.reading().anchors, 2);
    bench.soc.kept.uncertainty = Nanocoulombs(doubled);
    bench.rest(1);
    assert_eq!(bench.reading().anchors, 3);
    // A new rest counts again, after its own time.
    bench.current = Some(Microamps::from_milliamps(501));
    bench.rest(1);
    assert!(!bench.reading().resting);
    bench.current = Some(Microamps::ZERO);
    bench.rest(600);
    assert_eq!(bench.reading().anchors, 3);
    bench.rest(1);
    assert_eq!(bench.reading().anchors, 4);
}

#[test]
fn no_rest_without_a_valid_small_current_seen_all_the_time() {
    let run = |current, gap_us| {
        let mut bench = Bench::new(&config(), 500_000, 20_000);
        bench.cell = Some(Microvolts(3_600_000));
        bench.current = Some(Microamps::ZERO);
        bench.step(0, 0);
        bench.rest(300);
        bench.current = current;
        bench.step(gap_us, 0);
        bench.current = Some(Microamps::ZERO);
        bench.rest(300);
        bench.reading().anchors
    };
    assert_eq!(run(Some(Microamps::ZERO), 1_000_000), 1);
    assert_eq!(run(Some(Microamps::from_milliamps(-500)), 1_000_000), 1);
    assert_eq!(run(Some(Microamps::from_milliamps(-501)), 1_000_000), 0);
    assert_eq!(run(Some(Microamps::from_milliamps(501)), 1_000), 0);
    assert_eq!(run(None, 1_000_000), 0);
    assert_eq!(run(Some(Microamps::ZERO), 1_000_001), 0);
}

#[test]
fn no_anchor_on_an_old_or_moving_or_missing_voltage() {
    let run = |voltage: &dyn Fn(u32) -> Option<(i32, i64)>| {
        let mut bench = Bench::new(&config(), 500_000, 20_000);
        for second in 0..=700u32 {
            bench.now_us += 1_000_000;
            let cell_voltage = voltage(second).map(|(voltage, age_us)| CellVoltage {
                voltage: Microvolts(voltage),
                at: Instant::from_ticks((bench.now_us as i64 - age_us) as u64),
            });
            let input = SocInput {
                now: Instant::from_ticks(bench.now_us),
                charge_total: Nanocoulombs::ZERO,
                current: Some(Microamps::ZERO),
                cell_voltage,
            };
            if bench
                .soc
                .update(&bench.coefficients, &bench.table, &input)
                .is_some()
            {
                return Some(second);
            }
        }
        None
    };
    assert_eq!(run(&|_| Some((3_600_000, 0))), Some(600));
    assert_eq!(run(&|_| Some((3_600_000, 1_000_000))), Some(600));
    assert_eq!(run(&|_| Some((3_600_000, 1_000_001))), None);
    // Received after the meter's last reading.
    assert_eq!(run(&|_| Some((3_600_000, -20_000))), Some(600));
    assert_eq!(run(&|_| None), None);
    // Missing at 590 s: the window of 60 s begins anew at 591 s.
    assert_eq!(run(&|s| (s != 590).then_some((3_600_000, 0))), Some(651));
    // 1 mV is still, more is not; by 20 µV a second the window never fills, by 16 µV it begins anew every 63 s.
    assert_eq!(
        run(&|s| Some((3_600_000 + 1_000 * i32::from(s >= 590), 0))),
        Some(600)
    );
    assert_eq!(
        run(&|s| Some((3_600_000 - 1_001 * i32::from(s >= 590), 0))),
        Some(650)
    );
    assert_eq!(run(&|s| Some((3_600_000 + 20 * s as i32, 0))), None);
    assert_eq!(
        run(&|s| Some((3_600_000 + 16 * s as i32, 0))),
        Some(9 * 63 + 60)
    );
}

#[test]
fn a_voltage_of_no_cell_changes_nothing_and_is_told() {
    let mut bench = Bench::new(&config(), 500_000, 20_000);
    bench.current = Some(Microamps::ZERO);
    bench.cell = Some(Microvolts::ZERO);
    let before = bench.soc.retained();
    bench.step(0, 0);
    bench.rest(700);
    assert_eq!(
        bench.events,
        [SocEvent::ImplausibleVoltage(Microvolts::ZERO)]
    );
    assert_eq!(bench.soc.retained(), before);
    assert_eq!(bench.reading().anchors, 0);
}

/// As of a battery monitor that has been set right, or that answers at last, with the vehicle parked and nothing known.
#[test]
fn a_cells_voltage_after_one_of_none_anchors_in_the_same_rest() {
    let mut bench = Bench::new(&config(), 500_000, 1_000_000);
    bench.current = Some(Microamps::ZERO);
    bench.cell = Some(Microvolts::ZERO);
    bench.step(0, 0);
    bench.rest(700);
    assert_eq!(bench.reading().anchors, 0);
    bench.cell = Some(Microvolts(3_600_000));
    bench.rest(config().stability_window_s);
    assert_eq!(bench.reading().anchors, 0);
    bench.rest(1);
    assert_eq!(bench.reading().anchors, 1);
    bench.rest(700);
    assert_eq!(bench.reading().anchors, 1);
}

#[test]
fn a_reset_goes_on_where_it_was() {
    let mut bench = Bench::new(&config(), 500_000, 20_000);
    bench.step(10_000, 100 * COULOMB);
    let (kept, total) = (bench.soc.retained(), Nanocoulombs(bench.total));
    bench.soc = Soc::restore(&bench.coefficients, &kept, total);
    assert_eq!(bench.soc.retained(), kept);
    // What the counter gained meanwhile is counted.
    bench.step(0, 7 * COULOMB);
    assert_eq!(
        bench.reading().remaining,
        Nanocoulombs((18_000 - 107) * COULOMB)
    );
    assert!(bench.reading().known);
    // A fresh one has no counter before, so its first value is its zero.
    let mut fresh = Soc::new(&bench.coefficients);
    let input = SocInput {
        now: Instant::from_ticks(1),
        charge_total: Nanocoulombs(i64::MIN),
        current: None,
        cell_voltage: None,
    };
    fresh.update(&bench.coefficients, &bench.table, &input);
    assert_eq!(fresh.retained().remaining, Nanocoulombs(18_000 * COULOMB));
    // The largest difference that is charge, and the next one.
    bench.step(0, 1 << 60);
    assert_eq!(
        bench.soc.throughput().1,
        Nanocoulombs(107 * COULOMB + (1 << 60))
    );
    bench.step(0, -(1 << 60) - 1);
    assert_eq!(bench.soc.throughput().0, Nanocoulombs::ZERO);
    assert_eq!(bench.reading().counter_jumps, 1);
    // A jump that no counter makes is not charge.
    let jump = SocInput {
        charge_total: Nanocoulombs(i64::MAX),
        ..input
    };
    fresh.update(&bench.coefficients, &bench.table, &jump);
    assert_eq!(fresh.retained().remaining, Nanocoulombs(18_000 * COULOMB));
    assert_eq!(fresh.reading(&bench.coefficients).counter_jumps, 1);
}

#[test]
fn what_does_not_fit_is_restored_at_the_ends() {
    let coefficients = SocCoefficients::new(&config());
    let full = 36_000 * COULOMB;
    let kept = SocRetained {
        capacity_mah: config().capacity_mah,
        remaining: Nanocoulombs(2 * full),
        presented_offset: Nanocoulombs(full),
        uncertainty: Nanocoulombs(-1),
        known: true,
        charged: Nanocoulombs(-5),
        discharged: Nanocoulombs(-6),
        loss_carry: 7,
    };
    let restored = Soc::restore(&coefficients, &kept, Nanocoulombs::ZERO).retained();
    assert_eq!(
        restored,
        SocRetained {
            capacity_mah: config().capacity_mah,
            remaining: Nanocoulombs(full),
            presented_offset: Nanocoulombs::ZERO,
            uncertainty: Nanocoulombs::ZERO,
            known: true,
            charged: Nanocoulombs::ZERO,
            discharged: Nanocoulombs::ZERO,
            loss_carry: 7,
        }
    );
    let low = SocRetained {
        remaining: Nanocoulombs(-1),
        presented_offset: Nanocoulombs(-full),
        uncertainty: Nanocoulombs(2 * full),
        ..kept
    };
    let restored = Soc::restore(&coefficients, &low, Nanocoulombs::ZERO).retained();
    assert_eq!(
        (restored.remaining.get(), restored.presented_offset.get()),
        (0, 0)
    );
    assert_eq!(restored.uncertainty.get(), full);
}

#[test]
fn another_capacity_keeps_the_state_of_charge() {
    let mut bench = Bench::new(&config(), 500_000, 20_000);
    bench.current = Some(Microamps::ZERO);
    bench.cell = Some(Microvolts(3_600_000));
    bench.step(0, 0);
    bench.rest(600);
    let before = bench.reading();
    let aged = SocCoefficients::new(&SocConfig {
        capacity_mah: 8_000,
        ..config()
    });
    bench.soc.change_capacity(&aged);
    let after = bench.soc.reading(&aged);
    assert!((after.estimate.get() - before.estimate.get()).abs() <= 1);
    assert!((after.presented.get() - before.presented.get()).abs() <= 1);
    assert!((after.uncertainty.get() - before.uncertainty.get()).abs() <= 1);
    assert_eq!(after.remaining.get(), before.remaining.get() / 5 * 4);
    // Of the same share, the uncertainty has not doubled: no second anchor within this rest.
    bench.coefficients = SocCoefficients::new(&SocConfig {
        capacity_mah: 1_000_000,
        ..config()
    });
    bench.soc.change_capacity(&bench.coefficients);
    bench.rest(600);
    assert_eq!(bench.reading().anchors, before.anchors);
}

proptest! {
    /// Settings that come back with another capacity than the state was saved with: those of another version, or not saved. A full
    /// battery is still full, and back again.
    #[test]
    fn another_capacity_at_a_restart_keeps_the_state_of_charge(
        before_mah in 1_000_u32..2_000_000, after_mah in 1_000_u32..2_000_000, soc_ppm in 0..=1_000_000_i32,
        total: i32,
    ) {
        let of = |capacity_mah| SocCoefficients::new(&SocConfig { capacity_mah, ..config() });
        let (before, after) = (of(before_mah), of(after_mah));
        let total = Nanocoulombs(i64::from(total) << 20);
        let mut soc = Soc::new(&before);
        soc.set(&before, Ppm(soc_ppm), Ppm(5_000));
        let restored = Soc::restore(&after, &soc.retained(), total);
        let reading = restored.reading(&after);
        prop_assert!((reading.estimate.get() - soc_ppm).abs() <= 1, "{:?}", reading);
        prop_assert!((reading.uncertainty.get() - 5_000).abs() <= 1, "{:?}", reading);
        let back = Soc::restore(&before, &restored.retained(), total).reading(&before);
        prop_assert!((back.estimate.get() - soc_ppm).abs() <= 2, "{:?}", back);
    }
}

#[test]
fn setting_is_presented_at_once_and_held_inside() {
    let mut bench = Bench::new(&config(), 500_000, 20_000);
    bench.soc.kept.presented_offset = Nanocoulombs(COULOMB);
    bench.soc.set(&bench.coefficients, Ppm(2_000_000), Ppm(-1));
    let reading = bench.reading();
    assert_eq!(
        (reading.presented, reading.estimate, reading.uncertainty),
        (Ppm::ONE, Ppm::ONE, Ppm::ZERO)
    );
    bench.soc.set(&bench.coefficients, Ppm(-2), Ppm(2_000_000));
    let reading = bench.reading();
    assert_eq!(
        (reading.presented, reading.estimate, reading.uncertainty),
        (Ppm::ZERO, Ppm::ZERO, Ppm::ONE)
    );
}

#[test]
fn blends_by_hand() {
    let blend = |prior, table| {
        let blend = Blend::of(prior, table);
        (blend.weight_ppm, blend.width)
    };
    assert_eq!(blend(20_000, 10_000), (800_000, 8_944));
    assert_eq!(blend(30_000, 40_000), (360_000, 28_284));
    // Floor 0.7071 · 10,000 and, when the prior was below it already, the prior.
    assert_eq!(blend(8_000, 10_000), (390_244, 7_071));
    assert_eq!(blend(5_000, 10_000), (200_000, 5_000));
    assert_eq!(blend(0, 10_000), (0, 0));
    assert_eq!(blend(0, 0), (0, 0));
    assert_eq!(blend(1_000_000, 1), (1_000_000, 1));
    assert_eq!(blend(u64::MAX, u64::MAX), (500_000, 707_107));
}

proptest! {
    #[test]
    fn neither_value_nor_sign_of_the_counter_matters(
        start in -1_000_000_000 * COULOMB..1_000_000_000 * COULOMB,
        deltas in proptest::collection::vec(-2_000 * COULOMB..2_000 * COULOMB, 1..50),
    ) {
        let lossy = SocConfig { coulombic_efficiency: Ppm(990_000), ..config() };
        let mut here = Bench::new(&lossy, 500_000, 0);
        let mut there = Bench::new(&lossy, 500_000, 0);
        there.total = start;
        there.soc = Soc::restore(&there.coefficients, &here.soc.retained(), Nanocoulombs(start));
        there.soc.last_update = here.soc.last_update;
        for delta in deltas {
            here.step(20_000, delta);
            there.step(20_000, delta);
            prop_assert_eq!(here.reading(), there.reading());
        }
    }

    #[test]
    fn charge_is_conserved_and_clipping_is_accounted_for(
        deltas in proptest::collection::vec(-9_000 * COULOMB..9_000 * COULOMB, 1..60),
    ) {
        let mut bench = Bench::new(&config(), 500_000, 0);
        let full = 36_000 * COULOMB;
        let (mut model, mut clipped) = (full / 2, 0);
        for delta in deltas {
            bench.step(20_000, delta);
            let next = model - delta;
            model = next.clamp(0, full);
            clipped += (next - model).abs();
            let reading = bench.reading();
            prop_assert_eq!(reading.remaining.get(), model);
            prop_assert_eq!(reading.clipped.get(), clipped);
            let exact = model as f64 / full as f64 * 1e6;
            prop_assert!((exact - f64::from(reading.estimate.get())).abs() <= 0.51);
        }
    }

    #[test]
    fn the_loss_is_exact_to_the_rounding_of_the_factor(
        efficiency in 500_000..=1_000_000i32,
        charges in proptest::collection::vec(0..3 * COULOMB, 1..200),
    ) {
        let large = SocConfig {
            coulombic_efficiency: Ppm(efficiency), capacity_mah: 1_000_000, ..config()
        };
        let mut bench = Bench::new(&large, 0, 0);
        for charge in &charges {
            bench.step(20_000, -charge);
        }
        let sum: i64 = charges.iter().sum();
        let lossy = (sum - EXCURSION.get()).max(0);
        let loss = lossy as f64 * f64::from(1_000_000 - efficiency) / 1e6;
        let expected = sum as f64 - loss;
        let allowed = 1.001 + sum as f64 * 2f64.powi(-33);
        let got = bench.reading().remaining.get() as f64;
        prop_assert!((got - expected).abs() <= allowed, "{got} {expected}");
    }

    #[test]
    fn the_split_of_a_charge_does_not_matter(
        charge in 0..5_000 * COULOMB, cuts in proptest::collection::vec(0..5_000 * COULOMB, 0..20),
    ) {
        let lossy = SocConfig { coulombic_efficiency: Ppm(987_654), ..config() };
        let (mut whole, mut split) = (Bench::new(&lossy, 100_000, 0), Bench::new(&lossy, 100_000, 0));
        whole.step(20_000, -charge);
        let mut cuts: std::vec::Vec<_> = cuts.into_iter().map(|cut| cut.min(charge)).collect();
        cuts.push(charge);
        cuts.sort_unstable();
        let mut before = 0;
        for cut in cuts {
            split.step(1_000, before - cut);
            before = cut;
        }
        prop_assert_eq!(whole.soc.retained(), split.soc.retained());
    }

    #[test]
    fn the_share_is_within_half_a_ppm_and_never_falls(
        capacity_mah in 1..2_000_000u32, a: i64, b: i64, share_a in -0.1..1.1f64,
    ) {
        let coefficients = SocCoefficients::new(&SocConfig { capacity_mah, ..config() });
        let near = (coefficients.capacity as f64 * share_a) as i64;
        for charge in [a, b, near, near + 1, coefficients.capacity - 1] {
            let share = coefficients.share(Nanocoulombs(charge)).get();
            let exact = charge.clamp(0, coefficients.capacity) as f64 / coefficients.capacity as f64 * 1e6;
            prop_assert!((f64::from(share) - exact).abs() <= 0.51, "{share} {exact}");
        }
        let (low, high) = (near.min(a), near.max(a));
        prop_assert!(coefficients.share(Nanocoulombs(low)) <= coefficients.share(Nanocoulombs(high)));
    }

    #[test]
    fn the_bus_never_jumps(
        start in 0..=1_000_000i32, uncertainty in 1_000..200_000i32, cell in 2_900_000..4_100_000i32,
        steps in proptest::collection::vec((1..1_000_000u64, -5 * COULOMB..5 * COULOMB), 1..200),
    ) {
        // Whatever the rest finds, presented moves by what flows and by 100 ppm/s.
        let quick = SocConfig { rest_time_s: 5, stability_window_s: 2, ..config() };
        let mut bench = Bench::new(&quick, start, uncertainty);
        bench.current = Some(Microamps::ZERO);
        bench.cell = Some(Microvolts(cell));
        let mut before = bench.reading().presented.get();
        for (us, delta) in steps {
            bench.step(us, delta);
            let now = bench.reading().presented.get();
            let flows = delta.abs() as f64 / (36_000.0 * COULOMB as f64) * 1e6;
            let slews = us as f64 * 1e-4;
            prop_assert!(f64::from((now - before).abs()) <= flows + slews + 2.0, "{before} {now} {flows} {slews}");
            before = now;
        }
    }

    #[test]
    fn an_anchor_lies_between_and_never_adds_uncertainty(
        start in 0..=1_000_000i32, uncertainty in 0..=1_000_000i32, cell in 2_500_000..=4_500_000i32,
    ) {
        let quick = SocConfig { rest_time_s: 3, stability_window_s: 2, ..config() };
        let mut bench = Bench::new(&quick, start, uncertainty);
        bench.current = Some(Microamps::ZERO);
        bench.cell = Some(Microvolts(cell));
        bench.step(0, 0);
        let before = bench.reading();
        bench.rest(3);
        let after = bench.reading();
        prop_assert_eq!(after.anchors, 1);
        let ocv = (cell - 3_000_000).clamp(0, 1_000_000);
        let (low, high) = (ocv.min(before.estimate.get()), ocv.max(before.estimate.get()));
        prop_assert!((low - 1..=high + 1).contains(&after.estimate.get()));
        prop_assert!(after.uncertainty.get() <= before.uncertainty.get() + 1);
        let (p, r) = (f64::from(uncertainty), 10_000.0);
        let weight = p * p / (p * p + r * r);
        let expected = f64::from(start) + weight * f64::from(ocv - start);
        prop_assert!((f64::from(after.estimate.get()) - expected).abs() <= 5.0);
    }

    #[test]
    fn no_input_panics_and_the_ends_hold(
        capacity_mah: u32, efficiency: i32, others in proptest::array::uniform8(any::<i32>()),
        times in proptest::array::uniform5(any::<u32>()), kept_values in proptest::array::uniform5(any::<i64>()),
        steps in proptest::collection::vec((any::<u64>(), any::<i64>(), any::<Option<i32>>(), any::<Option<(i32, u64)>>()), 1..20),
    ) {
        let wild = SocConfig {
            capacity_mah,
            coulombic_efficiency: Ppm(efficiency),
            rest_current: Microamps(others[0]),
            rest_time_s: times[0],
            stability: Microvolts(others[1]),
            stability_window_s: times[1],
            cell_voltage_max_age_ms: times[2],
            ocv_uncertainty: Microvolts(others[2]),
            offset_uncertainty: Microamps(others[3]),
            no_load_threshold: Microamps(others[4]),
            gain_uncertainty: Ppm(others[5]),
            capacity_uncertainty: Ppm(others[6]),
            presented_slew_ppm_per_s: times[3],
        };
        let coefficients = SocCoefficients::new(&wild);
        let kept = SocRetained {
            capacity_mah: times[4],
            remaining: Nanocoulombs(kept_values[0]),
            presented_offset: Nanocoulombs(kept_values[1]),
            uncertainty: Nanocoulombs(kept_values[2]),
            known: others[7] > 0,
            charged: Nanocoulombs(kept_values[3]),
            discharged: Nanocoulombs(kept_values[4]),
            loss_carry: u32::MAX,
        };
        let mut soc = Soc::restore(&coefficients, &kept, Nanocoulombs(kept_values[3]));
        let table = OcvTable::default();
        for (now, total, current, cell) in steps {
            soc.update(&coefficients, &table, &SocInput {
                now: Instant::from_ticks(now),
                charge_total: Nanocoulombs(total),
                current: current.map(Microamps),
                cell_voltage: cell.map(|(voltage, at)| CellVoltage {
                    voltage: Microvolts(voltage), at: Instant::from_ticks(at),
                }),
            });
            soc.declare_loss(&coefficients, Nanocoulombs(total));
            let reading = soc.reading(&coefficients);
            prop_assert!((0..=coefficients.capacity).contains(&reading.remaining.get()));
            prop_assert!((0..=1_000_000).contains(&reading.presented.get()));
            prop_assert!((0..=1_000_000).contains(&reading.uncertainty.get()));
            let _ = soc.equivalent_cycles_milli(&coefficients);
        }
    }
}
