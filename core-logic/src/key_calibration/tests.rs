use super::*;
use crate::design_parameters::SENSOR_ZERO;
use crate::design_parameters::{D4_EXAMPLE_ACC, D4_EXAMPLE_OFF};
use crate::front_end::FrontEnd;
use proptest::prelude::*;
use std::string::ToString;

const PREVIOUS: KeyFactors = KeyFactors {
    k_ppb: 1_001_000_000,
    a: Microvolts(1_234),
};
const MS: u64 = 1_000;
/// A conversion at 32 a second.
const CONVERSION: u64 = 31_250;

/// 4 samples, 100 ms of settling, 1 s of delay.
fn config() -> KeyCalibrationConfig {
    KeyCalibrationConfig {
        samples: 4,
        settle_ms: 100,
        max_delay_ms: 1_000,
        ..KeyCalibrationConfig::default()
    }
}

struct Car {
    config: KeyCalibrationConfig,
    calibration: KeyCalibration,
    inputs: KeyInputs,
    voltage: Option<Microvolts>,
    zero: Microvolts,
    range: Range,
    /// Added to every other sample.
    ripple: i32,
    noisy: bool,
    samples: u64,
    /// By the meter's charge; its mean is what `inputs` says.
    milliamps: i64,
}

impl Car {
    fn new(config: KeyCalibrationConfig) -> Self {
        let now = Instant::from_ticks(1_000_000);
        Self {
            config,
            calibration: KeyCalibration::new(PREVIOUS, now),
            inputs: KeyInputs {
                now,
                acc_line: false,
                hv_feedback: false,
                can_key: None,
                can_high_voltage: None,
                meter_current: Some(Microamps::ZERO),
                meter_charge: None,
                sample: None,
            },
            voltage: Some(D4_EXAMPLE_OFF),
            zero: SENSOR_ZERO,
            range: Range::Small,
            ripple: 0,
            noisy: false,
            samples: 0,
            milliamps: 0,
        }
    }

    fn step(&mut self) -> KeyOutputs {
        self.calibration.step(&self.config, &self.inputs)
    }

    /// Runs with conversions; the last outputs, and the factors if any were taken meanwhile.
    fn run_ms(&mut self, milliseconds: u64) -> (KeyOutputs, Option<KeyFactors>) {
        let end = self.inputs.now.as_ticks() + milliseconds * MS;
        let mut factors = None;
        let mut outputs = self.step();
        while self.inputs.now.as_ticks() + CONVERSION <= end {
            self.inputs.now = Instant::from_ticks(self.inputs.now.as_ticks() + CONVERSION);
            self.samples += 1;
            let charge = self
                .inputs
                .meter_charge
                .map_or(0, |(_, charge)| charge.get());
            // mA · µs are nC.
            let charge = charge + self.milliamps * CONVERSION.cast_signed();
            self.inputs.meter_charge = Some((self.inputs.now, Nanocoulombs(charge)));
            let ripple = if self.samples.is_multiple_of(2) {
                self.ripple
            } else {
                0
            };
            self.inputs.sample = Some(KeySample {
                voltage: self.voltage.map(|v| Microvolts(v.get() + ripple)),
                zero: self.zero,
                range: self.range,
                at: self.inputs.now,
                noisy: self.noisy,
            });
            outputs = self.step();
            factors = factors.or(outputs.new_factors);
        }
        self.inputs.now = Instant::from_ticks(end);
        (outputs, factors)
    }

    fn wait_ms(&mut self, milliseconds: u64) -> KeyOutputs {
        self.inputs.now = Instant::from_ticks(self.inputs.now.as_ticks() + milliseconds * MS);
        self.step()
    }
}

/// OFF with 2.49 V, ready for ACC with 2.48 V.
fn after_off(config: KeyCalibrationConfig) -> Car {
    let mut car = Car::new(config);
    let (outputs, factors) = car.run_ms(500);
    assert_eq!(
        (outputs.phase, outputs.refusal, factors),
        (KeyPhase::Off, None, None)
    );
    assert!(!outputs.hv_permit);
    car.voltage = Some(D4_EXAMPLE_ACC);
    car.inputs.acc_line = true;
    car
}

#[test]
fn the_example_of_the_document_returns_0_a_in_acc() {
    let mut car = after_off(config());
    let outputs = car.step();
    assert_eq!(
        (outputs.hv_permit, outputs.phase, outputs.key),
        (false, KeyPhase::Taking, KeyState::Acc)
    );
    let (outputs, factors) = car.run_ms(500);
    let factors = factors.unwrap();
    assert!(outputs.hv_permit);
    assert_eq!(
        (outputs.phase, outputs.refusal, outputs.new_factors),
        (KeyPhase::Taken, None, None)
    );
    // a = 0.01 V, k = 2.5 / 2.49 = 1.004 016 064
    assert_eq!(
        factors,
        KeyFactors {
            k_ppb: 1_004_016_064,
            a: Microvolts(10_000)
        }
    );
    assert_eq!(car.calibration.factors(), factors);
    assert_eq!(factors.apply(D4_EXAMPLE_ACC), SENSOR_ZERO);
    // Once per key cycle, also while the high voltage still waits.
    car.voltage = Some(Microvolts(2_470_000));
    assert_eq!(car.run_ms(1_000).1, None);
    assert_eq!(car.calibration.factors(), factors);
    let supply = crate::design_parameters::SENSOR_NOMINAL_SUPPLY;
    let current =
        FrontEnd::default().current(factors.apply(D4_EXAMPLE_ACC), KeyCalibration::RANGE, supply);
    assert_eq!(current, Microamps::ZERO);
}

#[test]
fn the_defaults_leave_time_for_two_batches() {
    let config = KeyCalibrationConfig::default();
    let batch_ms = u32::from(config.samples) * 1_000 / 32;
    assert!(config.settle_ms + 2 * batch_ms <= config.max_delay_ms);
    assert_eq!(config.on_failure, OnFailure::PermitWithPrevious);
    let mut car = after_off(config);
    car.calibration.off_output = Some(D4_EXAMPLE_OFF);
    car.calibration.off_zero = SENSOR_ZERO;
    assert!(car.run_ms(1_000).0.hv_permit);
}

#[test]
fn the_permit_comes_with_the_factors_stays_while_driving_and_goes_with_the_key() {
    let mut car = after_off(config());
    // Settled after 100 ms, and four samples: the 4th conversion is at 125 ms, the 7th at 218.75 ms.
    assert!(!car.run_ms(6 * 31 + 10).0.hv_permit);
    assert!(car.run_ms(32).0.hv_permit);
    car.inputs.can_key = Some(KeyState::On);
    car.inputs.hv_feedback = true;
    car.inputs.can_high_voltage = Some(true);
    car.voltage = Some(Microvolts(3_000_000));
    let (outputs, factors) = car.run_ms(10_000);
    assert!(outputs.hv_permit && !outputs.hv_without_permit && !outputs.key_contradiction);
    assert_eq!(
        (outputs.phase, outputs.key, factors),
        (KeyPhase::Taken, KeyState::On, None)
    );
    // A contact that bounces for less than 100 ms does no harm.
    car.inputs.acc_line = false;
    car.inputs.can_key = None;
    assert!(car.wait_ms(99).hv_permit);
    car.inputs.acc_line = true;
    assert!(car.wait_ms(1).hv_permit);
    car.inputs.acc_line = false;
    assert!(car.wait_ms(99).hv_permit);
    let outputs = car.wait_ms(1);
    assert_eq!(
        (outputs.hv_permit, outputs.key, outputs.phase),
        (false, KeyState::Off, KeyPhase::Off)
    );
    // The contactors have a second to open.
    assert!(!car.wait_ms(1_000).hv_without_permit);
    assert!(car.wait_ms(1).hv_without_permit);
    car.inputs.hv_feedback = false;
    assert!(!car.step().hv_without_permit);
}

#[test]
fn each_cycle_takes_its_own_off_value() {
    let mut car = after_off(config());
    assert!(car.run_ms(500).1.is_some());
    car.inputs.acc_line = false;
    car.wait_ms(100);
    // Too short an OFF for a new VC1: the old one is not used again.
    car.inputs.acc_line = true;
    let (outputs, factors) = car.run_ms(1_100);
    assert_eq!(outputs.phase, KeyPhase::Failed(KeyRefusal::NoOffValue));
    assert_eq!(factors, None);
    assert!(outputs.hv_permit);
    // The newest good batch of OFF is VC1.
    car.inputs.acc_line = false;
    car.wait_ms(100);
    car.voltage = Some(Microvolts(2_470_000));
    car.run_ms(300);
    car.voltage = Some(Microvolts(2_510_000));
    car.run_ms(400);
    car.inputs.acc_line = true;
    car.voltage = Some(Microvolts(2_515_000));
    let factors = car.run_ms(500).1.unwrap();
    assert_eq!(
        factors,
        KeyFactors {
            k_ppb: 996_015_936,
            a: Microvolts(-5_000)
        }
    );
    assert_eq!(factors.apply(Microvolts(2_515_000)), SENSOR_ZERO);
}

#[test]
fn a_failure_permits_with_the_previous_factors_or_holds() {
    let mut car = after_off(config());
    car.ripple = 2_001;
    let (outputs, _) = car.run_ms(990);
    assert_eq!(
        (outputs.phase, outputs.hv_permit),
        (KeyPhase::Taking, false)
    );
    assert_eq!(
        outputs.refusal,
        Some(KeyRefusal::Unstable(Microvolts(2_001)))
    );
    car.inputs.now = Instant::from_ticks(car.calibration.left_off_at.as_ticks() + 1_000 * MS - 1);
    assert!(!car.step().hv_permit);
    car.inputs.now = Instant::from_ticks(car.inputs.now.as_ticks() + 1);
    let outputs = car.step();
    assert_eq!(
        outputs.phase,
        KeyPhase::Failed(KeyRefusal::Unstable(Microvolts(2_001)))
    );
    assert!(outputs.hv_permit);
    // With the permit out nothing is taken any more.
    car.ripple = 0;
    let (outputs, factors) = car.run_ms(2_000);
    assert_eq!(
        (outputs.hv_permit, factors, car.calibration.factors()),
        (true, None, PREVIOUS)
    );

    let mut car = after_off(KeyCalibrationConfig {
        on_failure: OnFailure::Hold,
        ..config()
    });
    car.ripple = 2_001;
    let (outputs, _) = car.run_ms(2_000);
    assert_eq!(
        outputs.phase,
        KeyPhase::Failed(KeyRefusal::Unstable(Microvolts(2_001)))
    );
    assert!(!outputs.hv_permit);
    car.ripple = 2_000;
    let (outputs, factors) = car.run_ms(500);
    assert!(outputs.hv_permit && factors.is_some());
    assert_eq!(outputs.phase, KeyPhase::Taken);
}

/// Of D3's samples the means of quarters have to lie within the limit, single ones within four times it.
#[test]
fn noisy_samples_are_judged_by_the_means_of_quarters() {
    let config = KeyCalibrationConfig {
        samples: 8,
        ..config()
    };
    let with = |noisy, ripple| {
        let mut car = after_off(config);
        (car.noisy, car.ripple) = (noisy, ripple);
        let (outputs, factors) = car.run_ms(800);
        factors.map(|factors| factors.a).ok_or(outputs.refusal)
    };
    let unstable = |spread| Err(Some(KeyRefusal::Unstable(Microvolts(spread))));
    assert_eq!(with(false, 2_001), unstable(2_001));
    // Half of the ripple is in the mean.
    assert_eq!(with(true, 8_000), Ok(Microvolts(10_000 - 4_000)));
    assert_eq!(with(true, 8_001), unstable(8_001));
}

#[test]
fn each_condition_against_it_is_the_reason() {
    type Change = fn(&mut Car);
    let cases: [(Change, KeyRefusal); 12] = [
        (|car| car.inputs.sample = None, KeyRefusal::NoSamples),
        (
            |car| car.ripple = -2_001,
            KeyRefusal::Unstable(Microvolts(2_001)),
        ),
        (
            |car| car.inputs.meter_current = Some(Microamps(3_500_001)),
            KeyRefusal::CurrentFlows(Microamps(3_500_001)),
        ),
        (
            |car| car.inputs.meter_current = Some(Microamps(-3_500_001)),
            KeyRefusal::CurrentFlows(Microamps(-3_500_001)),
        ),
        (
            |car| car.inputs.hv_feedback = true,
            KeyRefusal::HighVoltageOn,
        ),
        (
            |car| car.inputs.can_high_voltage = Some(true),
            KeyRefusal::HighVoltageOn,
        ),
        (|car| car.voltage = None, KeyRefusal::InvalidSample),
        (|car| car.range = Range::Large, KeyRefusal::WrongRange),
        (
            |car| car.inputs.can_key = Some(KeyState::Off),
            KeyRefusal::KeyContradiction,
        ),
        (
            |car| car.calibration.off_output = None,
            KeyRefusal::NoOffValue,
        ),
        (
            |car| car.voltage = Some(Microvolts(2_439_999)),
            KeyRefusal::AOutOfLimits(Microvolts(50_001)),
        ),
        (
            |car| car.voltage = Some(Microvolts(2_540_001)),
            KeyRefusal::AOutOfLimits(Microvolts(-50_001)),
        ),
    ];
    for (index, (change, reason)) in cases.into_iter().enumerate() {
        let mut car = after_off(config());
        change(&mut car);
        let outputs = if index == 0 {
            car.step();
            car.wait_ms(1_000)
        } else {
            car.run_ms(1_100).0
        };
        assert_eq!(outputs.phase, KeyPhase::Failed(reason));
        assert_eq!(car.calibration.factors(), PREVIOUS, "{reason:?}");
        assert_eq!(
            outputs.key_contradiction,
            reason == KeyRefusal::KeyContradiction
        );
    }
    // At the limits themselves, and without what is optional, they are taken.
    let good: [Change; 7] = [
        |car| car.ripple = 2_000,
        |car| car.inputs.meter_current = Some(Microamps(-3_500_000)),
        |car| car.inputs.meter_current = None,
        |car| car.inputs.can_high_voltage = Some(false),
        |car| car.inputs.can_key = Some(KeyState::Start),
        |car| car.voltage = Some(Microvolts(2_440_000)),
        |car| car.voltage = Some(Microvolts(2_540_000)),
    ];
    for change in good {
        let mut car = after_off(config());
        change(&mut car);
        assert!(car.run_ms(500).1.is_some());
    }
}

/// The meter's mean is that of a whole second, and the current began with the key.
#[test]
fn a_current_that_the_mean_does_not_show_yet_is_seen_by_the_charge() {
    for milliamps in [-5_000, 5_000] {
        let mut car = after_off(config());
        car.inputs.acc_line = true;
        car.milliamps = milliamps;
        let (outputs, factors) = car.run_ms(2_000);
        assert_eq!(factors, None);
        let KeyPhase::Failed(KeyRefusal::CurrentFlows(current)) = outputs.phase else {
            panic!("{:?}", outputs.phase);
        };
        assert_eq!(i64::from(current.get()), milliamps * 1_000);
    }
    // What the offset to be found makes of 0 A is none.
    let mut car = after_off(config());
    car.inputs.acc_line = true;
    car.milliamps = -3_000;
    assert!(car.run_ms(2_000).1.is_some());
}

#[test]
fn one_bad_sample_starts_the_batch_anew() {
    let mut car = after_off(config());
    // Samples 4, 5, 6 count.
    car.run_ms(6 * 31 + 4);
    assert_eq!(car.calibration.batch.outputs.taken(), 3);
    car.voltage = None;
    let outputs = car.run_ms(31 + 1).0;
    assert_eq!(
        (outputs.refusal, car.calibration.batch.outputs.taken()),
        (Some(KeyRefusal::InvalidSample), 0)
    );
}

#[test]
fn key_off_refuses_what_is_not_a_zero_output() {
    let off = |change: fn(&mut Car)| {
        let mut car = Car::new(config());
        change(&mut car);
        let refusal = car.run_ms(500).0.refusal;
        assert_eq!(car.calibration.off_output.is_some(), refusal.is_none());
        refusal
    };
    assert_eq!(off(|_| ()), None);
    assert_eq!(off(|car| car.inputs.can_key = Some(KeyState::Off)), None);
    assert_eq!(
        off(|car| car.inputs.can_key = Some(KeyState::Acc)),
        Some(KeyRefusal::KeyContradiction)
    );
    // 2.5 / 2.45 is 2.04 %, 2.5 / 2.46 is 1.63 %.
    assert_eq!(
        off(|car| car.voltage = Some(Microvolts(2_450_000))),
        Some(KeyRefusal::KOutOfLimits(20_408))
    );
    assert_eq!(off(|car| car.voltage = Some(Microvolts(2_460_000))), None);
    assert_eq!(
        off(|car| car.voltage = Some(Microvolts(2_560_000))),
        Some(KeyRefusal::KOutOfLimits(-23_438))
    );
    assert_eq!(
        off(|car| car.voltage = Some(Microvolts(0))),
        Some(KeyRefusal::KOutOfLimits(-1_000_000))
    );
    assert_eq!(
        off(|car| car.voltage = Some(Microvolts(-2_490_000))),
        Some(KeyRefusal::KOutOfLimits(-2_004_016))
    );
    // An output of 0 V has no factor, however wide the limit.
    assert_eq!(
        off(|car| {
            car.config.max_k_deviation_ppm = 1_000_000;
            car.voltage = Some(Microvolts(0));
        }),
        Some(KeyRefusal::KOutOfLimits(-1_000_000))
    );
    // Exactly 2 %: 2.5 V / 2.5 V · 1.02.
    assert_eq!(
        off(|car| {
            car.zero = Microvolts(2_550_000);
            car.voltage = Some(Microvolts(2_500_000));
        }),
        None
    );
}

#[test]
fn a_sample_counts_once_and_only_after_settling() {
    let mut car = Car::new(config());
    car.config.samples = 1;
    let sample = |us: u64| {
        Some(KeySample {
            voltage: Some(D4_EXAMPLE_OFF),
            zero: SENSOR_ZERO,
            range: Range::Small,
            at: Instant::from_ticks(1_000_000 + us),
            noisy: false,
        })
    };
    car.step();
    car.inputs.now = Instant::from_ticks(1_200_000);
    // Converted before it had settled, though looked at afterwards.
    car.inputs.sample = sample(99_999);
    car.step();
    assert_eq!(car.calibration.off_output, None);
    car.inputs.sample = sample(100_000);
    car.step();
    assert_eq!(car.calibration.off_output, Some(D4_EXAMPLE_OFF));
    car.config.samples = 3;
    car.step();
    car.step();
    assert_eq!(car.calibration.batch.outputs.taken(), 0);
    car.inputs.sample = sample(131_250);
    car.step();
    car.step();
    assert_eq!(car.calibration.batch.outputs.taken(), 1);
    // A change of the high voltage begins anew, also without a settling time.
    car.config.settle_ms = 0;
    car.inputs.can_high_voltage = Some(true);
    car.step();
    assert_eq!(car.calibration.batch.outputs.taken(), 0);
    car.inputs.can_high_voltage = Some(false);
    car.inputs.sample = sample(199_999);
    car.step();
    assert_eq!(car.calibration.batch.outputs.taken(), 0);
    car.inputs.sample = sample(200_000);
    car.step();
    assert_eq!(car.calibration.batch.outputs.taken(), 1);
}

#[test]
fn after_a_reset_on_the_road_the_permit_is_there_at_once() {
    let mut car = Car::new(config());
    car.inputs.acc_line = true;
    car.inputs.hv_feedback = true;
    let outputs = car.step();
    assert_eq!(
        (outputs.hv_permit, outputs.phase),
        (true, KeyPhase::Resumed)
    );
    assert_eq!(car.calibration.factors(), PREVIOUS);
    // It lasts until the key is turned off; afterwards everything is as always.
    car.inputs.hv_feedback = false;
    assert!(car.run_ms(3_000).0.hv_permit);
    car.inputs.acc_line = false;
    car.wait_ms(100);
    car.inputs.acc_line = true;
    car.inputs.hv_feedback = true;
    let outputs = car.step();
    assert_eq!(
        (outputs.hv_permit, outputs.phase),
        (false, KeyPhase::Taking)
    );
    // Started in ACC without high voltage there is no VC1, but a permit after the delay.
    let mut car = Car::new(config());
    car.inputs.acc_line = true;
    assert_eq!(car.step().phase, KeyPhase::Taking);
    assert_eq!(
        car.run_ms(1_100).0.phase,
        KeyPhase::Failed(KeyRefusal::NoOffValue)
    );
    // One wrong look at either line is made good by the next one, and no later than the key's debounce.
    for (key, feedback) in [(false, true), (true, false)] {
        for (looks_ms, permits) in [(10, true), (90, true), (100, false)] {
            let mut car = Car::new(config());
            (car.inputs.acc_line, car.inputs.hv_feedback) = (key, feedback);
            assert!(!car.step().hv_permit);
            car.wait_ms(looks_ms);
            (car.inputs.acc_line, car.inputs.hv_feedback) = (true, true);
            assert_eq!(car.step().hv_permit, permits, "{key} {looks_ms} ms");
        }
    }
    // Started with the key OFF and high voltage on: welded contactors.
    let mut car = Car::new(config());
    car.inputs.hv_feedback = true;
    assert!(!car.step().hv_without_permit);
    assert!(!car.wait_ms(1_000).hv_without_permit);
    assert!(car.wait_ms(1).hv_without_permit);
    // The time counts from the start, not from the first look.
    let mut car = Car::new(config());
    car.inputs.hv_feedback = true;
    assert!(car.wait_ms(1_001).hv_without_permit);
}

#[test]
fn switched_off_the_permit_follows_the_key() {
    let mut car = Car::new(KeyCalibrationConfig {
        enabled: false,
        ..config()
    });
    let (outputs, _) = car.run_ms(500);
    assert_eq!((outputs.hv_permit, outputs.phase), (false, KeyPhase::Off));
    assert_eq!(car.calibration.off_output, None);
    car.inputs.acc_line = true;
    let outputs = car.step();
    assert_eq!(
        (outputs.hv_permit, outputs.phase),
        (true, KeyPhase::Disabled)
    );
    assert_eq!(car.run_ms(2_000).1, None);
    // Switched on in between, it begins with the next key cycle.
    car.config.enabled = true;
    assert_eq!(car.run_ms(1_000).0.phase, KeyPhase::Disabled);
}

#[test]
fn line_and_can_make_the_key() {
    let key = |acc_line, can_key| {
        let mut car = Car::new(config());
        car.inputs.acc_line = acc_line;
        car.inputs.can_key = can_key;
        let outputs = car.step();
        (outputs.key, outputs.key_contradiction)
    };
    assert_eq!(key(false, None), (KeyState::Off, false));
    assert_eq!(key(false, Some(KeyState::Off)), (KeyState::Off, false));
    assert_eq!(key(false, Some(KeyState::On)), (KeyState::Off, true));
    assert_eq!(key(true, None), (KeyState::Acc, false));
    assert_eq!(key(true, Some(KeyState::Off)), (KeyState::Acc, true));
    assert_eq!(key(true, Some(KeyState::Acc)), (KeyState::Acc, false));
    assert_eq!(key(true, Some(KeyState::On)), (KeyState::On, false));
    assert_eq!(key(true, Some(KeyState::Start)), (KeyState::Start, false));
}

#[test]
fn every_refusal_says_what_it_is() {
    for (refusal, part) in [
        (KeyRefusal::NoSamples, "no samples"),
        (KeyRefusal::Unstable(Microvolts(3)), "over 3 µV"),
        (KeyRefusal::CurrentFlows(Microamps(-4)), "-4 µA"),
        (KeyRefusal::HighVoltageOn, "high voltage"),
        (KeyRefusal::InvalidSample, "not valid"),
        (KeyRefusal::WrongRange, "range"),
        (KeyRefusal::KeyContradiction, "contradict"),
        (KeyRefusal::NoOffValue, "key OFF"),
        (KeyRefusal::KOutOfLimits(7), "7 ppm"),
        (KeyRefusal::AOutOfLimits(Microvolts(8)), "8 µV"),
    ] {
        assert!(refusal.to_string().contains(part), "{refusal}");
    }
}

proptest! {
    /// The zero output follows the supply, and the low-voltage loads may pull that.
    #[test]
    fn acc_reads_0_a_when_the_supply_has_changed_since_off(
        zero in 2_375_000..2_625_000i32, fall in -50_000..50_000i32, shifts in proptest::array::uniform2(-20_000..20_000i32),
    ) {
        let mut car = Car::new(config());
        car.zero = Microvolts(zero);
        car.voltage = Some(Microvolts(zero + shifts[0]));
        car.run_ms(500);
        car.inputs.acc_line = true;
        car.zero = Microvolts(zero + fall);
        let acc = Microvolts(zero + fall + shifts[1]);
        car.voltage = Some(acc);
        let factors = car.run_ms(500).1.unwrap();
        // a is a whole number of microvolts, and k may stretch its half.
        prop_assert!((factors.apply(acc).get() - car.zero.get()).abs() <= 1);
    }

    #[test]
    fn acc_reads_0_a_whatever_the_outputs_are(off in 2_451_000..2_551_000i32, shift in -50_000..=50_000i32) {
        let mut car = Car::new(config());
        car.voltage = Some(Microvolts(off));
        car.run_ms(500);
        car.inputs.acc_line = true;
        car.voltage = Some(Microvolts(off + shift));
        let factors = car.run_ms(500).1.unwrap();
        prop_assert_eq!(factors.apply(Microvolts(off + shift)), SENSOR_ZERO);
    }

    /// No permit with the key off; without a permit before, only after factors, failure or a resumed drive; and
    /// never later than the longest delay when a failure permits.
    #[test]
    fn the_permit_keeps_its_rules(
        hold: bool,
        steps in proptest::collection::vec(
            (0..200_000u64, any::<bool>(), any::<bool>(), 2_400_000..2_600_000i32, 0..5u8), 1..200),
    ) {
        let mut car = Car::new(config());
        if hold {
            car.config.on_failure = OnFailure::Hold;
        }
        let mut left_off: Option<Instant> = None;
        for (us, line, feedback, voltage, can) in steps {
            car.inputs.now = Instant::from_ticks(car.inputs.now.as_ticks() + us);
            car.inputs.acc_line = line;
            car.inputs.hv_feedback = feedback;
            car.inputs.can_key =
                [None, Some(KeyState::Off), Some(KeyState::Acc), Some(KeyState::On), Some(KeyState::Start)][usize::from(can)];
            car.inputs.sample = Some(KeySample {
                voltage: Some(Microvolts(voltage)), zero: SENSOR_ZERO, range: Range::Small, at: car.inputs.now,
                noisy: false,
            });
            let outputs = car.step();
            if outputs.key == KeyState::Off {
                left_off = None;
                prop_assert!(!outputs.hv_permit);
            } else {
                let since = *left_off.get_or_insert(car.inputs.now);
                let late = elapsed(since, car.inputs.now) >= milliseconds(1_000);
                match outputs.phase {
                    KeyPhase::Taken | KeyPhase::Resumed => prop_assert!(outputs.hv_permit),
                    KeyPhase::Failed(_) => prop_assert_eq!(outputs.hv_permit, !hold),
                    KeyPhase::Taking => prop_assert!(!outputs.hv_permit && !late),
                    KeyPhase::Off | KeyPhase::Disabled => prop_assert!(false, "key is not OFF"),
                }
            }
            if outputs.new_factors.is_some() {
                prop_assert!(outputs.hv_permit && !feedback);
            }
        }
    }

    #[test]
    fn no_input_panics(
        wild in (any::<bool>(), any::<i32>(), 0..4u16, any::<u32>(), any::<u32>()),
        limits in proptest::array::uniform4(any::<i32>()), times in proptest::array::uniform2(any::<u32>()),
        steps in proptest::collection::vec(
            (any::<u64>(), any::<[bool; 4]>(), any::<Option<i32>>(), any::<Option<(Option<i32>, u64)>>()), 1..60),
    ) {
        let config = KeyCalibrationConfig {
            enabled: wild.0,
            samples: wild.2,
            settle_ms: wild.3 % 3,
            max_delay_ms: wild.4,
            max_spread: Microvolts(limits[0]),
            max_current: Microamps(limits[1]),
            max_k_deviation_ppm: limits[2],
            max_a: Microvolts(limits[3]),
            on_failure: OnFailure::Hold,
            key_off_debounce_ms: times[0] % 2,
            feedback_grace_ms: times[1],
        };
        let mut calibration = KeyCalibration::new(KeyFactors::NONE, Instant::from_ticks(0));
        for (now, flags, current, sample) in steps {
            let outputs = calibration.step(&config, &KeyInputs {
                now: Instant::from_ticks(now),
                acc_line: flags[0],
                hv_feedback: flags[1],
                can_key: flags[2].then_some(KeyState::Acc),
                can_high_voltage: None,
                meter_current: current.map(Microamps),
                meter_charge: current
                    .map(|charge| (Instant::from_ticks(now / 2), Nanocoulombs(i64::from(charge) << 31))),
                sample: sample.map(|(voltage, at)| KeySample {
                    voltage: voltage.map(Microvolts),
                    zero: Microvolts(wild.1.wrapping_add(wild.3.cast_signed())),
                    range: if flags[3] { Range::Small } else { Range::Large },
                    at: Instant::from_ticks(at),
                    noisy: flags[0],
                }),
            });
            if outputs.key == KeyState::Off {
                prop_assert!(!outputs.hv_permit);
            }
        }
    }
}
