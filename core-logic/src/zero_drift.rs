//! D2: the zero drift of each sensor, set from a host or measured ("zero now").
//!
//! [`ZeroCalibration`] never changes a value: it hands the measured one over when it is complete, and the caller stores
//! it. A refused, interrupted or powered-off calibration therefore leaves the previous value as it was.

use serde::{Deserialize, Serialize};

use crate::converter::CurrentReading;
use crate::design_parameters as design;
use crate::front_end::PerRange;
use crate::range::Range;
use crate::steadiness::{Limit, Steadiness};
use crate::units::{Duration, Instant, Microamps, elapsed};

/// Readings of a calibration that [`ZeroDriftConfig::is_valid`] accepts.
pub const SAMPLE_LIMITS: (u16, u16) = (4, 1_024);

/// Configuration of the zero drift.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ZeroDriftConfig {
    /// The zero drift in use: what the sensor reads at 0 A.
    pub value: PerRange<Microamps>,
    /// Largest zero drift that is accepted, both signs: above it the sensor is broken, or current flows.
    pub limit: PerRange<Microamps>,
    /// Valid readings that a calibration takes.
    pub samples: u16,
    /// Largest distance between the lowest and the highest of them; of readings with noise ([`ZeroConditions::noisy`]) between the means
    /// of the run's quarters, and four times as much between single ones.
    pub max_spread: PerRange<Microamps>,
    /// Largest mean current of the energy meter, both signs, at which there may be no current flowing. The meter's own
    /// zero error is in it.
    pub max_meter_mean: PerRange<Microamps>,
    /// Longest time that a calibration takes.
    pub timeout_ms: u32,
}

impl Default for ZeroDriftConfig {
    fn default() -> Self {
        Self {
            value: PerRange::both(Microamps::ZERO),
            limit: PerRange {
                small: design::ZERO_LIMIT_SMALL,
                large: design::ZERO_LIMIT_LARGE,
            },
            samples: design::ZERO_SAMPLES,
            max_spread: PerRange {
                small: design::ZERO_SPREAD_SMALL,
                large: design::ZERO_SPREAD_LARGE,
            },
            max_meter_mean: PerRange {
                small: design::ZERO_METER_MEAN_SMALL,
                large: design::ZERO_METER_MEAN_LARGE,
            },
            timeout_ms: design::ZERO_TIMEOUT_MS,
        }
    }
}

impl ZeroDriftConfig {
    /// Whether every value is within its limits and the values in use are within theirs.
    #[must_use]
    pub fn is_valid(&self) -> bool {
        let positive = |bound: PerRange<Microamps>| bound.small.get() > 0 && bound.large.get() > 0;
        positive(self.limit)
            && positive(self.max_spread)
            && positive(self.max_meter_mean)
            && (SAMPLE_LIMITS.0..=SAMPLE_LIMITS.1).contains(&self.samples)
            && self.timeout_ms > 0
            && self.value_is_within_limit()
    }

    /// Whether the zero drift in use is; the rest are limits of each value alone.
    pub(crate) fn value_is_within_limit(&self) -> bool {
        [Range::Small, Range::Large]
            .into_iter()
            .all(|range| self.check_value(range, self.value.get(range)).is_ok())
    }

    /// Checks a value that a host wants to set.
    ///
    /// # Errors
    /// [`ZeroRefusal::BeyondLimit`].
    pub fn check_value(&self, range: Range, value: Microamps) -> Result<Microamps, ZeroRefusal> {
        let limit = self.limit.get(range);
        if value.saturating_abs() > limit {
            return Err(ZeroRefusal::BeyondLimit { value, limit });
        }
        Ok(value)
    }
}

/// Why a zero drift was not taken; the previous value stays.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ZeroRefusal {
    /// A calibration is already under way.
    Busy,
    /// High voltage is on, or the key state does not say that it is off.
    HighVoltage,
    /// The energy meter sees a current.
    CurrentFlows {
        /// What it saw.
        mean: Microamps,
    },
    /// The energy meter has no valid mean, so nothing tells a current from a zero drift.
    MeterUnknown,
    /// A reading is invalid: the sensor or the converter is not in order, or the range changed.
    InvalidReading,
    /// The readings lie too far apart.
    Unstable {
        /// Between the lowest and the highest.
        spread: Microamps,
    },
    /// The value is beyond the limit.
    BeyondLimit {
        /// The value.
        value: Microamps,
        /// The limit, both signs.
        limit: Microamps,
    },
    /// Too few readings in the time.
    Timeout,
    /// The caller stopped it.
    Cancelled,
}

/// What must hold for the current to be zero.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ZeroConditions {
    /// Whether key state and high-voltage feedback both say that the high voltage is off.
    pub high_voltage_is_off: bool,
    /// The energy meter's mean current, `None` when not valid.
    pub meter_mean: Option<Microamps>,
    /// The readings are of ADC1 (D3), whose noise alone spreads them further than a zero may.
    pub noisy: bool,
}

/// How far a calibration has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ZeroProgress {
    /// The sensor that it is for.
    pub range: Range,
    /// Readings taken.
    pub taken: u16,
    /// Readings that it takes.
    pub of: u16,
}

/// A complete calibration.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ZeroResult {
    /// The sensor that it is for.
    pub range: Range,
    /// The new zero drift, to be stored by the caller.
    pub value: Microamps,
    /// Between the lowest and the highest reading.
    pub spread: Microamps,
}

#[derive(Clone, Copy, Debug)]
struct Run {
    range: Range,
    /// The zero drift already subtracted from the readings.
    in_use: Microamps,
    started: Instant,
    last_at: Option<Instant>,
    readings: Steadiness,
}

/// State of "zero now".
#[derive(Clone, Copy, Debug, Default)]
pub struct ZeroCalibration {
    run: Option<Run>,
}

impl ZeroCalibration {
    /// No calibration under way.
    #[must_use]
    pub const fn new() -> Self {
        Self { run: None }
    }

    /// Whether a calibration is under way.
    #[must_use]
    pub const fn is_running(&self) -> bool {
        self.run.is_some()
    }

    /// How far it has come.
    #[must_use]
    pub fn progress(&self, config: &ZeroDriftConfig) -> Option<ZeroProgress> {
        self.run.map(|run| ZeroProgress {
            range: run.range,
            taken: run.readings.taken(),
            of: config.samples,
        })
    }

    /// Starts for the sensor that is selected now.
    ///
    /// # Errors
    /// [`ZeroRefusal::Busy`], or what speaks against a zero current.
    pub fn start(
        &mut self,
        config: &ZeroDriftConfig,
        range: Range,
        conditions: &ZeroConditions,
        now: Instant,
    ) -> Result<(), ZeroRefusal> {
        if self.run.is_some() {
            return Err(ZeroRefusal::Busy);
        }
        check(config, range, conditions)?;
        self.run = Some(Run {
            range,
            in_use: config.value.get(range),
            started: now,
            last_at: None,
            readings: Steadiness::EMPTY,
        });
        Ok(())
    }

    /// Takes a reading, made with the zero drift in `config` subtracted. `None` while more are needed, or when no
    /// calibration is under way.
    ///
    /// A reading taken before the start, or the same reading again, is passed over.
    pub fn on_reading(
        &mut self,
        config: &ZeroDriftConfig,
        reading: &CurrentReading,
        conditions: &ZeroConditions,
    ) -> Option<Result<ZeroResult, ZeroRefusal>> {
        let run = self.run.as_mut()?;
        let is_new = match run.last_at {
            None => reading.at >= run.started,
            Some(last) => reading.at > last,
        };
        if !is_new {
            return None;
        }
        let outcome = take(config, run, reading, conditions);
        if outcome.is_some() {
            self.run = None;
        }
        outcome
    }

    /// Ends a calibration that takes too long, also when no readings come.
    pub fn tick(&mut self, config: &ZeroDriftConfig, now: Instant) -> Option<ZeroRefusal> {
        let run = self.run?;
        let limit = Duration::from_ticks(u64::from(config.timeout_ms) * 1_000);
        if elapsed(run.started, now) <= limit {
            return None;
        }
        self.run = None;
        Some(ZeroRefusal::Timeout)
    }

    /// Stops a calibration that is under way.
    pub fn cancel(&mut self) -> Option<ZeroRefusal> {
        self.run.take().map(|_| ZeroRefusal::Cancelled)
    }
}

fn check(
    config: &ZeroDriftConfig,
    range: Range,
    conditions: &ZeroConditions,
) -> Result<(), ZeroRefusal> {
    if !conditions.high_voltage_is_off {
        return Err(ZeroRefusal::HighVoltage);
    }
    let mean = conditions.meter_mean.ok_or(ZeroRefusal::MeterUnknown)?;
    if mean.saturating_abs() > config.max_meter_mean.get(range) {
        return Err(ZeroRefusal::CurrentFlows { mean });
    }
    Ok(())
}

fn take(
    config: &ZeroDriftConfig,
    run: &mut Run,
    reading: &CurrentReading,
    conditions: &ZeroConditions,
) -> Option<Result<ZeroResult, ZeroRefusal>> {
    if let Err(refusal) = check(config, run.range, conditions) {
        return Some(Err(refusal));
    }
    if !reading.validity.is_valid() || reading.range != run.range {
        return Some(Err(ZeroRefusal::InvalidReading));
    }
    run.last_at = Some(reading.at);
    let limit = Limit {
        spread: config.max_spread.get(run.range).get(),
        samples: config.samples,
        noisy: conditions.noisy,
    };
    match run.readings.take(limit, reading.current.get()) {
        Ok(true) => {}
        Ok(false) => return None,
        Err(spread) => {
            let spread = Microamps(spread);
            return Some(Err(ZeroRefusal::Unstable { spread }));
        }
    }
    let value = run.in_use.saturating_add(Microamps(run.readings.mean()));
    let result = config
        .check_value(run.range, value)
        .map(|value| ZeroResult {
            range: run.range,
            value,
            spread: Microamps(run.readings.spread()),
        });
    Some(result)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::converter::tests::any_validity;
    use crate::front_end::tests::any_range;
    use crate::units::Microvolts;
    use crate::validity::Validity;
    use proptest::prelude::*;

    const CONFIG: ZeroDriftConfig = ZeroDriftConfig {
        value: PerRange {
            small: Microamps(700_000),
            large: Microamps(-900_000),
        },
        limit: PerRange {
            small: Microamps(2_000_000),
            large: Microamps(5_000_000),
        },
        samples: 4,
        max_spread: PerRange {
            small: Microamps(100_000),
            large: Microamps(300_000),
        },
        max_meter_mean: PerRange {
            small: Microamps(2_500_000),
            large: Microamps(6_000_000),
        },
        timeout_ms: 1_000,
    };
    const REST: ZeroConditions = ZeroConditions {
        high_voltage_is_off: true,
        meter_mean: Some(Microamps::ZERO),
        noisy: false,
    };

    fn at(us: u64) -> Instant {
        Instant::from_ticks(us)
    }

    fn reading(current: i32, us: u64, range: Range) -> CurrentReading {
        CurrentReading {
            current: Microamps(current),
            validity: Validity::VALID,
            range,
            at: at(us),
            volts: Microvolts::ZERO,
        }
    }

    fn started(range: Range) -> ZeroCalibration {
        let mut calibration = ZeroCalibration::new();
        calibration.start(&CONFIG, range, &REST, at(1_000)).unwrap();
        calibration
    }

    /// Feeds readings and returns the outcome with the number of readings that it took.
    fn run(range: Range, currents: &[i32]) -> (usize, Option<Result<ZeroResult, ZeroRefusal>>) {
        let mut calibration = started(range);
        for (index, current) in currents.iter().enumerate() {
            let reading = reading(*current, 2_000 + index as u64, range);
            if let Some(outcome) = calibration.on_reading(&CONFIG, &reading, &REST) {
                assert!(!calibration.is_running());
                return (index + 1, Some(outcome));
            }
        }
        assert!(calibration.is_running());
        (currents.len(), None)
    }

    #[test]
    fn new_zero_is_the_old_one_and_what_is_left_of_it() {
        let small = run(Range::Small, &[10_000, 20_000, 30_000, 42_000]);
        let expected = ZeroResult {
            range: Range::Small,
            value: Microamps(725_500),
            spread: Microamps(32_000),
        };
        assert_eq!(small, (4, Some(Ok(expected))));
        let (_, large) = run(Range::Large, &[-100_000, 200_000, -100_000, 1]);
        let large = large.unwrap().unwrap();
        assert_eq!(
            (large.range, large.value),
            (Range::Large, Microamps(-900_000))
        );
        assert_eq!(large.spread, Microamps(300_000));
        assert_eq!(run(Range::Small, &[0, 0, 0]), (3, None));
    }

    #[test]
    fn unstable_readings_are_refused_at_once() {
        let unstable = |spread| {
            Some(Err(ZeroRefusal::Unstable {
                spread: Microamps(spread),
            }))
        };
        assert_eq!(run(Range::Small, &[0, 100_001]), (2, unstable(100_001)));
        assert_eq!(
            run(Range::Small, &[50_000, 0, -50_000, -50_001]),
            (4, unstable(100_001))
        );
        assert!(run(Range::Small, &[0, 100_000, 0, 0]).1.unwrap().is_ok());
    }

    /// Readings with noise: the means of quarters within the limit, single readings within four times it.
    #[test]
    fn noisy_readings_are_judged_by_the_means_of_quarters() {
        let noisy = |samples: u16, currents: &[i32]| {
            let config = ZeroDriftConfig { samples, ..CONFIG };
            let conditions = ZeroConditions {
                noisy: true,
                ..REST
            };
            let mut calibration = started(Range::Small);
            for (index, current) in currents.iter().enumerate() {
                let reading = reading(*current, 2_000 + index as u64, Range::Small);
                if let Some(outcome) = calibration.on_reading(&config, &reading, &conditions) {
                    let value = outcome.map(|result| result.value.get() - 700_000);
                    return (index + 1, Some(value));
                }
            }
            (currents.len(), None)
        };
        let unstable = |spread| {
            Some(Err(ZeroRefusal::Unstable {
                spread: Microamps(spread),
            }))
        };
        // Quarters of two: ±100 mA within each of them, 100 mA from the first to the last.
        let currents = [100_000, -100_000, 150_000, -50_000, 0, 0, 200_000, 0];
        assert_eq!(noisy(8, &currents), (8, Some(Ok(37_500))));
        let mut moved = currents;
        moved[7] = 2;
        assert_eq!(noisy(8, &moved), (8, unstable(100_001)));
        // What a quarter hides is within 400 mA.
        assert_eq!(noisy(8, &[200_000, -200_000]), (2, None));
        assert_eq!(noisy(8, &[200_000, -200_001]), (2, unstable(400_001)));
        // A part that is begun is completed, and a quarter of less than two readings is one.
        assert_eq!(noisy(9, &[50_000; 10]), (10, Some(Ok(50_000))));
        assert_eq!(noisy(10, &[50_000; 10]), (10, Some(Ok(50_000))));
        assert_eq!(noisy(11, &[50_000; 11]), (11, None));
        assert_eq!(noisy(4, &[0, 100_000, 0, 0]), (4, Some(Ok(25_000))));
        assert_eq!(noisy(4, &[0, 100_001]), (2, unstable(100_001)));
        // A limit of four times the largest is none.
        let widest = ZeroDriftConfig {
            max_spread: PerRange::both(Microamps(i32::MAX)),
            ..CONFIG
        };
        let conditions = ZeroConditions {
            noisy: true,
            ..REST
        };
        let mut calibration = started(Range::Small);
        for (us, current) in [(2_000, i32::MIN), (2_001, i32::MAX)] {
            let reading = reading(current, us, Range::Small);
            let outcome = calibration.on_reading(&widest, &reading, &conditions);
            assert_eq!(outcome, None);
        }
    }

    #[test]
    fn a_value_beyond_the_limit_is_refused() {
        let beyond = |value, limit| ZeroRefusal::BeyondLimit {
            value: Microamps(value),
            limit: Microamps(limit),
        };
        assert_eq!(
            run(Range::Small, &[1_300_001; 4]).1,
            Some(Err(beyond(2_000_001, 2_000_000)))
        );
        assert!(run(Range::Small, &[1_300_000; 4]).1.unwrap().is_ok());
        assert_eq!(
            run(Range::Large, &[-4_100_001; 4]).1,
            Some(Err(beyond(-5_000_001, 5_000_000)))
        );
        // The same for a value from the host.
        assert_eq!(
            CONFIG.check_value(Range::Small, Microamps(-2_000_000)),
            Ok(Microamps(-2_000_000))
        );
        assert_eq!(
            CONFIG.check_value(Range::Small, Microamps(-2_000_001)),
            Err(beyond(-2_000_001, 2_000_000))
        );
        assert_eq!(
            CONFIG.check_value(Range::Large, Microamps(2_000_001)),
            Ok(Microamps(2_000_001))
        );
    }

    #[test]
    fn current_high_voltage_and_an_unknown_meter_are_refused() {
        let mean = |mean| ZeroConditions {
            meter_mean: mean,
            ..REST
        };
        let cases = [
            (
                ZeroConditions {
                    high_voltage_is_off: false,
                    ..REST
                },
                ZeroRefusal::HighVoltage,
            ),
            (mean(None), ZeroRefusal::MeterUnknown),
            (
                mean(Some(Microamps(2_500_001))),
                ZeroRefusal::CurrentFlows {
                    mean: Microamps(2_500_001),
                },
            ),
            (
                mean(Some(Microamps(-2_500_001))),
                ZeroRefusal::CurrentFlows {
                    mean: Microamps(-2_500_001),
                },
            ),
        ];
        for (conditions, refusal) in cases {
            let mut calibration = ZeroCalibration::new();
            assert_eq!(
                calibration.start(&CONFIG, Range::Small, &conditions, at(0)),
                Err(refusal)
            );
            assert!(!calibration.is_running());
            // The same when it begins in mid-run.
            let mut calibration = started(Range::Small);
            let reading = reading(0, 2_000, Range::Small);
            assert_eq!(
                calibration.on_reading(&CONFIG, &reading, &conditions),
                Some(Err(refusal))
            );
            assert!(!calibration.is_running());
            assert_eq!(calibration.on_reading(&CONFIG, &reading, &REST), None);
        }
        let mut calibration = ZeroCalibration::new();
        assert_eq!(
            calibration.start(
                &CONFIG,
                Range::Small,
                &mean(Some(Microamps(-2_500_000))),
                at(0)
            ),
            Ok(())
        );
        let mut calibration = ZeroCalibration::new();
        assert_eq!(
            calibration.start(
                &CONFIG,
                Range::Large,
                &mean(Some(Microamps(2_500_001))),
                at(0)
            ),
            Ok(())
        );
    }

    #[test]
    fn an_invalid_reading_or_another_range_is_refused() {
        let mut calibration = started(Range::Small);
        let saturated = CurrentReading {
            validity: Validity::SATURATED,
            ..reading(0, 2_000, Range::Small)
        };
        assert_eq!(
            calibration.on_reading(&CONFIG, &saturated, &REST),
            Some(Err(ZeroRefusal::InvalidReading))
        );
        let mut calibration = started(Range::Small);
        let other = reading(0, 2_000, Range::Large);
        assert_eq!(
            calibration.on_reading(&CONFIG, &other, &REST),
            Some(Err(ZeroRefusal::InvalidReading))
        );
        assert!(!calibration.is_running());
    }

    #[test]
    fn busy_cancel_progress_and_time() {
        let mut calibration = started(Range::Large);
        assert_eq!(
            calibration.start(&CONFIG, Range::Small, &REST, at(5_000)),
            Err(ZeroRefusal::Busy)
        );
        let progress = |taken| {
            Some(ZeroProgress {
                range: Range::Large,
                taken,
                of: 4,
            })
        };
        assert_eq!(calibration.progress(&CONFIG), progress(0));
        assert_eq!(
            calibration.on_reading(&CONFIG, &reading(0, 2_000, Range::Large), &REST),
            None
        );
        assert_eq!(calibration.progress(&CONFIG), progress(1));
        assert_eq!(calibration.tick(&CONFIG, at(1_001_000)), None);
        assert_eq!(
            calibration.tick(&CONFIG, at(1_001_001)),
            Some(ZeroRefusal::Timeout)
        );
        assert_eq!(calibration.progress(&CONFIG), None);
        assert_eq!(calibration.tick(&CONFIG, at(9_000_000)), None);
        assert_eq!(calibration.cancel(), None);
        let mut calibration = started(Range::Small);
        assert_eq!(calibration.cancel(), Some(ZeroRefusal::Cancelled));
        assert!(!calibration.is_running());
    }

    #[test]
    fn old_and_repeated_readings_are_passed_over() {
        let mut calibration = started(Range::Small);
        for (us, taken) in [(999, 0), (1_000, 1), (1_000, 1), (900, 1), (1_001, 2)] {
            assert_eq!(
                calibration.on_reading(&CONFIG, &reading(0, us, Range::Small), &REST),
                None
            );
            assert_eq!(calibration.progress(&CONFIG).unwrap().taken, taken, "{us}");
        }
        // A repeated invalid reading is no reason either.
        let stale = CurrentReading {
            validity: Validity::STALE,
            ..reading(0, 1_001, Range::Small)
        };
        assert_eq!(calibration.on_reading(&CONFIG, &stale, &REST), None);
    }

    #[test]
    fn limits_of_the_configuration() {
        assert!(ZeroDriftConfig::default().is_valid());
        assert!(CONFIG.is_valid());
        let refused: [&dyn Fn(&mut ZeroDriftConfig); 11] = [
            &|c| c.value.small = Microamps(2_000_001),
            &|c| c.value.large = Microamps(-5_000_001),
            &|c| {
                c.limit = PerRange {
                    small: Microamps(0),
                    large: Microamps(900_000),
                }
            },
            &|c| c.limit.large = Microamps(0),
            &|c| c.max_spread.small = Microamps(0),
            &|c| c.max_spread.large = Microamps(-1),
            &|c| c.max_meter_mean.small = Microamps(0),
            &|c| c.max_meter_mean.large = Microamps(0),
            &|c| c.samples = 3,
            &|c| c.samples = 1_025,
            &|c| c.timeout_ms = 0,
        ];
        for (index, change) in refused.into_iter().enumerate() {
            let mut config = CONFIG;
            change(&mut config);
            assert!(!config.is_valid(), "case {index}");
        }
        // A limit of nothing is refused also for a value of nothing.
        for (small, large) in [(0, 1), (1, 0)] {
            let none = ZeroDriftConfig {
                value: PerRange::both(Microamps::ZERO),
                limit: PerRange {
                    small: Microamps(small),
                    large: Microamps(large),
                },
                ..CONFIG
            };
            assert!(!none.is_valid());
        }
        assert!(
            ZeroDriftConfig {
                samples: 1_024,
                timeout_ms: 1,
                ..CONFIG
            }
            .is_valid()
        );
    }

    proptest! {
        /// With the new value in use the same readings average to zero.
        #[test]
        fn the_rest_is_gone(currents in prop::collection::vec(-50_000..50_000_i32, 4), range in any_range()) {
            let (_, outcome) = run(range, &currents);
            let result = outcome.unwrap().unwrap();
            let change = i64::from(result.value.get() - CONFIG.value.get(range).get());
            let left: i64 = currents.iter().map(|current| i64::from(*current) - change).sum();
            prop_assert!(left.abs() <= 2);
        }

        #[test]
        fn a_result_is_always_within_the_limit(
            readings in prop::collection::vec((any::<i32>(), any_validity(), any_range(), any::<u64>()), 1..60),
            near in -3_000_000..3_000_000_i32, samples: u16, mean: Option<i32>
        ) {
            let config = ZeroDriftConfig { samples, ..CONFIG };
            let mut calibration = ZeroCalibration::default();
            let conditions = ZeroConditions { meter_mean: mean.map(Microamps), ..REST };
            let _ = calibration.start(&config, Range::Small, &conditions, at(0));
            for (current, validity, range, us) in readings {
                let current = near.saturating_add(current % 60_000);
                let reading = CurrentReading { validity, ..reading(current, us, range) };
                if let Some(Ok(result)) = calibration.on_reading(&config, &reading, &conditions) {
                    prop_assert!(result.value.saturating_abs() <= CONFIG.limit.small);
                    prop_assert!(result.spread <= CONFIG.max_spread.small);
                }
                calibration.tick(&config, at(us));
                let _ = calibration.start(&config, range, &REST, at(us / 2));
            }
        }
    }
}
