//! D4's bench calibration: how the sensor's zero and sensitivity follow its supply.
//!
//! Two sweeps of the supply Vc within its limits, straight lines through both by least squares:
//! at 0 A `Vout = c1·Vc + c2`, at a known current Ipt `Vout = c3·Vc + c4`. Then, with the turns ratio N,
//! `k2 = c1`, `m2 = c2`, `k1 = (c3 − c1)·N/Ipt` and `m1 = (c4 − c2)·N/Ipt`.
//!
//! The sums are exact. With points inside 0 … 10 V and at most [`MAX_POINTS`] of them, every sum fits 64 bits and every
//! product 128 bits, so nothing can overflow:
//! Σx, Σy ≤ 2.56·10⁹ and Σx², Σxy, Σy² ≤ 2.56·10¹⁶ (µV, µV²); n·Σx² − (Σx)² ≤ n²·(range/2)² = 1.64·10¹⁸, and by
//! Cauchy and Schwarz the same bounds n·Σxy − Σx·Σy, whose square is 2.7·10³⁶.

use core::fmt;

use serde::{Deserialize, Serialize};

use crate::design_parameters::{
    SENSOR_NOMINAL_SUPPLY, SENSOR_SUPPLY_HIGH, SENSOR_SUPPLY_LOW, SENSOR_ZERO,
};
use crate::front_end::{SupplyRelations, TURNS_LIMITS};
use crate::units::{
    Microamps, Microvolts, clamp_i32, clamp_i64, div_i128, div_round_i128, isqrt, mul_i64,
    mul_i128, mul_wide, sub_i128,
};

/// Points that one run takes.
pub const MAX_POINTS: u16 = 256;

/// Sensor outputs that a point may have; the bound on the sums rests on it.
pub const OUTPUT_LIMITS: (Microvolts, Microvolts) =
    (Microvolts::ZERO, Microvolts::from_millivolts(10_000));

/// Sensitivities, referred to the primary, that are a Hall sensor's: 0.1 mV/A … 1 V/A, in nV/A.
pub const SENSITIVITY_LIMITS_NANOVOLT_PER_AMP: (i64, i64) = (100_000, 1_000_000_000);

/// c1 and c3 are kept in 10⁻¹², c2 and c4 in 10⁻¹² V.
const PICO_PER_UNIT: i128 = 1_000_000_000_000;

/// What a calibration must satisfy.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct SupplyCalibrationConfig {
    /// Points that each run needs, at least 3 (with two points there is no residual).
    pub min_points: u16,
    /// Supply that each run must span.
    pub min_span: Microvolts,
    /// Largest root mean square of what a run's line leaves over.
    pub max_residual: Microvolts,
    /// Smallest magnitude of Ipt.
    pub min_test_current: Microamps,
    /// Largest difference of the zero output at the rated supply from the rated zero.
    pub zero_tolerance: Microvolts,
}

impl Default for SupplyCalibrationConfig {
    /// Figures *assumed* for the 300 A sensor of D4's example (2 V of swing).
    fn default() -> Self {
        Self {
            min_points: 5,
            // 0.8 V of the 1 V between the limits.
            min_span: Microvolts::from_millivolts(800),
            // 0.1 % of the swing.
            max_residual: Microvolts::from_millivolts(2),
            // A tenth of the range.
            min_test_current: Microamps::from_amps(30),
            // A tenth of the rated zero.
            zero_tolerance: Microvolts::from_millivolts(250),
        }
    }
}

/// The run that a point belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Run {
    /// Ip = 0.
    Zero,
    /// Ip = Ipt, the same for the whole run.
    Loaded(Microamps),
}

/// Which of the two runs a refusal is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum RunName {
    /// The run at 0 A.
    Zero,
    /// The run at Ipt.
    Loaded,
}

/// One point of a sweep; averaged by the caller.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct SupplyPoint {
    /// Vc, the sensor's supply.
    pub supply: Microvolts,
    /// Vout, the sensor's output.
    pub output: Microvolts,
}

/// Why a point or a calibration is refused. Nothing is changed by a refusal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum SupplyRefusal {
    /// Vc outside 4.5 … 5.5 V.
    SupplyOutOfLimits(Microvolts),
    /// Vout outside [`OUTPUT_LIMITS`].
    OutputOutOfLimits(Microvolts),
    /// The run has [`MAX_POINTS`] already.
    TooManyPoints,
    /// |Ipt| is below the smallest test current.
    TestCurrentTooSmall(Microamps),
    /// Ipt is not that of the points before.
    TestCurrentChanged,
    /// The run has too few points.
    TooFewPoints(RunName, u16),
    /// The run's points do not span enough supply.
    SpanTooSmall(RunName, Microvolts),
    /// The points scatter too much around their line: this root mean square.
    Unstable(RunName, Microvolts),
    /// N is outside [`TURNS_LIMITS`].
    Turns(i32),
    /// The zero output at the rated supply is too far from the rated zero: this output.
    ZeroOutOfLimits(Microvolts),
    /// The sensitivity is not a Hall sensor's somewhere between 4.5 and 5.5 V (too small, too large, reversed).
    SensitivityOutOfLimits,
}

impl fmt::Display for SupplyRefusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::SupplyOutOfLimits(supply) => {
                write!(f, "supply {} µV is outside its limits", supply.get())
            }
            Self::OutputOutOfLimits(output) => {
                write!(f, "output {} µV is outside its limits", output.get())
            }
            Self::TooManyPoints => write!(f, "the run has {MAX_POINTS} points already"),
            Self::TestCurrentTooSmall(current) => {
                write!(f, "test current {} µA is too small", current.get())
            }
            Self::TestCurrentChanged => write!(f, "the test current changed within the run"),
            Self::TooFewPoints(run, count) => write!(f, "{run:?} run: only {count} points"),
            Self::SpanTooSmall(run, span) => {
                write!(f, "{run:?} run: only {} µV of supply spanned", span.get())
            }
            Self::Unstable(run, rms) => {
                write!(
                    f,
                    "{run:?} run: unstable, {} µV rms around the line",
                    rms.get()
                )
            }
            Self::Turns(turns) => write!(f, "turns ratio {turns} is outside its limits"),
            Self::ZeroOutOfLimits(zero) => {
                write!(
                    f,
                    "zero output {} µV is too far from the rated one",
                    zero.get()
                )
            }
            Self::SensitivityOutOfLimits => {
                write!(f, "the sensitivity is not that of a Hall sensor")
            }
        }
    }
}

impl core::error::Error for SupplyRefusal {}

/// A finished calibration.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct SupplyCalibrated {
    /// k1, m1, k2, m2.
    pub relations: SupplyRelations,
    /// Root mean square of what the line at 0 A leaves over.
    pub zero_residual: Microvolts,
    /// Root mean square of what the line at Ipt leaves over.
    pub loaded_residual: Microvolts,
}

/// The state: the sums of both runs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SupplyCalibration {
    zero: Sums,
    loaded: Sums,
    test_current: Option<Microamps>,
}

impl SupplyCalibration {
    /// Nothing taken yet.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Points taken at 0 A and at Ipt.
    #[must_use]
    pub const fn points(&self) -> (u16, u16) {
        (self.zero.count, self.loaded.count)
    }

    /// Takes a point.
    ///
    /// # Errors
    /// What is wrong with it; the points before stay.
    pub fn add(
        &mut self,
        config: &SupplyCalibrationConfig,
        run: Run,
        point: SupplyPoint,
    ) -> Result<(), SupplyRefusal> {
        if !(SENSOR_SUPPLY_LOW..=SENSOR_SUPPLY_HIGH).contains(&point.supply) {
            return Err(SupplyRefusal::SupplyOutOfLimits(point.supply));
        }
        if !(OUTPUT_LIMITS.0..=OUTPUT_LIMITS.1).contains(&point.output) {
            return Err(SupplyRefusal::OutputOutOfLimits(point.output));
        }
        match run {
            Run::Zero => self.zero.add(point),
            Run::Loaded(current) => {
                if current == Microamps::ZERO || current.saturating_abs() < config.min_test_current
                {
                    return Err(SupplyRefusal::TestCurrentTooSmall(current));
                }
                if self.test_current.is_some_and(|before| before != current) {
                    return Err(SupplyRefusal::TestCurrentChanged);
                }
                self.loaded.add(point)?;
                self.test_current = Some(current);
                Ok(())
            }
        }
    }

    /// The relations from all points taken, for a sensor with `turns` turns.
    ///
    /// k1, m1 (and k2, m2) are rounded to 1 nΩ (1 nV) after lines that are kept to 10⁻¹² V.
    ///
    /// # Errors
    /// The first reason against them; the points stay, so that more can be added.
    pub fn finish(
        &self,
        config: &SupplyCalibrationConfig,
        turns: i32,
    ) -> Result<SupplyCalibrated, SupplyRefusal> {
        if !(TURNS_LIMITS.0..=TURNS_LIMITS.1).contains(&turns) {
            return Err(SupplyRefusal::Turns(turns));
        }
        let zero = self.zero.line(config, RunName::Zero)?;
        let loaded = self.loaded.line(config, RunName::Loaded)?;
        // `add` took no loaded point without a test current, and `line` wants at least two of them.
        let test_current = self
            .test_current
            .ok_or(SupplyRefusal::TestCurrentTooSmall(Microamps::ZERO))?;

        // 10⁻¹² V/V · N / (10⁻⁶ A) is 10⁻⁶ Ω/V, that is 1,000 nΩ/V; the same from 10⁻¹² V to nΩ.
        let referred = |difference: i128| {
            clamp_i64(div_round_i128(
                mul_i128(difference, i128::from(i64::from(turns) * 1_000)),
                i128::from(test_current.get()),
            ))
        };
        let nano = |pico: i128| clamp_i64(div_round_i128(pico, 1_000));
        let relations = SupplyRelations {
            k1_nanoohm_per_volt: referred(loaded.slope_pico - zero.slope_pico),
            m1_nanoohm: referred(loaded.intercept_pico - zero.intercept_pico),
            k2_nanovolt_per_volt: nano(zero.slope_pico),
            m2_nanovolt: nano(zero.intercept_pico),
        };
        check(config, &relations, turns)?;
        Ok(SupplyCalibrated {
            relations,
            zero_residual: zero.residual,
            loaded_residual: loaded.residual,
        })
    }
}

/// Whether these relations are those of a sensor of this board.
fn check(
    config: &SupplyCalibrationConfig,
    relations: &SupplyRelations,
    turns: i32,
) -> Result<(), SupplyRefusal> {
    let zero = i128::from(relations.zero_nanovolt(SENSOR_NOMINAL_SUPPLY));
    let zero = Microvolts(clamp_i32(clamp_i64(div_round_i128(zero, 1_000))));
    if zero.saturating_sub(SENSOR_ZERO).saturating_abs() > config.zero_tolerance {
        return Err(SupplyRefusal::ZeroOutOfLimits(zero));
    }
    let (least, most) = SENSITIVITY_LIMITS_NANOVOLT_PER_AMP;
    let turns = i64::from(turns);
    let allowed = mul_i64(least, turns)..=mul_i64(most, turns);
    // A straight line: what holds at both ends holds between them.
    let both = [SENSOR_SUPPLY_LOW, SENSOR_SUPPLY_HIGH];
    if both
        .iter()
        .all(|supply| allowed.contains(&relations.impedance_nanoohm(*supply)))
    {
        Ok(())
    } else {
        Err(SupplyRefusal::SensitivityOutOfLimits)
    }
}

/// One run: x is the supply, y the output, both in µV.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Sums {
    count: u16,
    x: i64,
    y: i64,
    xx: i64,
    xy: i64,
    yy: i64,
    lowest: i32,
    highest: i32,
}

/// a·b − c·d.
#[inline(never)]
fn determinant(a: i64, b: i64, c: i64, d: i64) -> i128 {
    sub_i128(mul_wide(a, b), mul_wide(c, d))
}

/// A run's line, in 10⁻¹².
struct Line {
    slope_pico: i128,
    intercept_pico: i128,
    residual: Microvolts,
}

impl Sums {
    fn add(&mut self, point: SupplyPoint) -> Result<(), SupplyRefusal> {
        if self.count >= MAX_POINTS {
            return Err(SupplyRefusal::TooManyPoints);
        }
        let (x, y) = (point.supply.get(), point.output.get());
        (self.lowest, self.highest) = if self.count == 0 {
            (x, x)
        } else {
            (self.lowest.min(x), self.highest.max(x))
        };
        let (x, y) = (i64::from(x), i64::from(y));
        self.count += 1;
        self.x += x;
        self.y += y;
        self.xx += x * x;
        self.xy += x * y;
        self.yy += y * y;
        Ok(())
    }

    fn line(&self, config: &SupplyCalibrationConfig, run: RunName) -> Result<Line, SupplyRefusal> {
        if self.count < config.min_points.max(3) {
            return Err(SupplyRefusal::TooFewPoints(run, self.count));
        }
        let span = self.highest - self.lowest;
        // A span of 0 has no line, whatever the configuration says.
        if span == 0 || span < config.min_span.get() {
            return Err(SupplyRefusal::SpanTooSmall(run, Microvolts(span)));
        }
        let n = i64::from(self.count);
        let spread = determinant(n, self.xx, self.x, self.x);
        let covariance = determinant(n, self.xy, self.x, self.y);
        let scatter = determinant(n, self.yy, self.y, self.y);
        // Sum of squared residuals: (scatter − covariance² / spread) / n.
        let squares = mul_i128(scatter, spread) - mul_i128(covariance, covariance);
        // At most the square of the largest output, 2.5·10¹³ µV².
        let variance = clamp_i64(div_i128(squares, mul_i128(i128::from(n * (n - 2)), spread)));
        let limit = i64::from(config.max_residual.saturating_abs().get());
        let residual = Microvolts(clamp_i32(
            isqrt(variance.max(0).cast_unsigned()).cast_signed(),
        ));
        if variance > limit * limit {
            return Err(SupplyRefusal::Unstable(run, residual));
        }
        Ok(Line {
            slope_pico: div_round_i128(mul_i128(covariance, PICO_PER_UNIT), spread),
            // µV to 10⁻¹² V
            intercept_pico: div_round_i128(
                mul_i128(determinant(self.y, self.xx, self.x, self.xy), 1_000_000),
                spread,
            ),
            residual,
        })
    }
}

#[cfg(test)]
#[allow(
    clippy::unwrap_used,
    clippy::indexing_slicing,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss
)]
mod tests {
    use super::*;
    use crate::front_end::{ClosedLoop, FrontEnd};
    use crate::range::Range;
    use proptest::prelude::*;
    use std::string::ToString;
    use std::vec::Vec;

    const IPT: Microamps = Microamps::from_amps(200);
    const TURNS: i32 = 2_000;

    /// A 300 A sensor, 2 V of swing at 5 V, not quite ratiometric.
    #[derive(Clone, Copy, Debug)]
    struct Sensor {
        k1: f64,
        m1: f64,
        k2: f64,
        m2: f64,
    }

    const SENSOR: Sensor = Sensor {
        k1: 2.5,
        m1: 0.8,
        k2: 0.49,
        m2: 0.06,
    };

    impl Sensor {
        fn output(&self, supply_v: f64, amps: f64) -> f64 {
            (self.k1 * supply_v + self.m1) * amps / f64::from(TURNS) + self.k2 * supply_v + self.m2
        }

        fn point(&self, supply: i32, amps: f64) -> SupplyPoint {
            SupplyPoint {
                supply: Microvolts(supply),
                output: Microvolts(
                    (self.output(f64::from(supply) * 1e-6, amps) * 1e6).round() as i32
                ),
            }
        }
    }

    fn config() -> SupplyCalibrationConfig {
        SupplyCalibrationConfig::default()
    }

    fn sweep(sensor: &Sensor, supplies: &[i32], current: Microamps) -> SupplyCalibration {
        let mut calibration = SupplyCalibration::new();
        for supply in supplies {
            calibration
                .add(&config(), Run::Zero, sensor.point(*supply, 0.0))
                .unwrap();
            let loaded = sensor.point(*supply, f64::from(current.get()) * 1e-6);
            calibration
                .add(&config(), Run::Loaded(current), loaded)
                .unwrap();
        }
        calibration
    }

    fn eleven() -> Vec<i32> {
        (0..11).map(|n| 4_500_000 + 100_000 * n).collect()
    }

    #[test]
    fn recovers_the_sensor_and_its_currents() {
        for current in [IPT, Microamps(-IPT.get())] {
            let calibration = sweep(&SENSOR, &eleven(), current);
            assert_eq!(calibration.points(), (11, 11));
            let done = calibration.finish(&config(), TURNS).unwrap();
            let relations = done.relations;
            // All outputs here are whole microvolts, so the lines are exact.
            assert_eq!(relations.k1_nanoohm_per_volt, 2_500_000_000);
            assert_eq!(relations.m1_nanoohm, 800_000_000);
            assert_eq!(relations.k2_nanovolt_per_volt, 490_000_000);
            assert_eq!(relations.m2_nanovolt, 60_000_000);
            assert_eq!(
                (done.zero_residual.get(), done.loaded_residual.get()),
                (0, 0)
            );
            // A residual at the limit is allowed, also at the limit 0.
            let strict = SupplyCalibrationConfig {
                max_residual: Microvolts::ZERO,
                ..config()
            };
            assert_eq!(calibration.finish(&strict, TURNS), Ok(done));
            let front_end = FrontEnd::ClosedLoop(ClosedLoop {
                turns: TURNS,
                relations,
                ..ClosedLoop::default()
            });
            assert_eq!(front_end.validate(), Ok(()));
            for (supply, amps) in [(4_600_000, -300), (5_000_000, 0), (5_430_000, 123)] {
                let output = SENSOR.point(supply, f64::from(amps)).output;
                let read = front_end.current(output, Range::Small, Microvolts(supply));
                assert!((read.get() - amps * 1_000_000).abs() < 500, "{read:?}");
            }
        }
    }

    #[test]
    fn points_are_refused_with_the_reason_and_leave_nothing_behind() {
        let mut calibration = SupplyCalibration::new();
        let point = |supply, output| SupplyPoint {
            supply: Microvolts(supply),
            output: Microvolts(output),
        };
        let good = point(5_000_000, 2_500_000);
        let mut add = |run, point| calibration.add(&config(), run, point);
        let supply = |v| Err(SupplyRefusal::SupplyOutOfLimits(Microvolts(v)));
        let output = |v| Err(SupplyRefusal::OutputOutOfLimits(Microvolts(v)));
        assert_eq!(add(Run::Zero, point(4_499_999, 0)), supply(4_499_999));
        assert_eq!(add(Run::Zero, point(5_500_001, 0)), supply(5_500_001));
        assert_eq!(add(Run::Zero, point(4_500_000, -1)), output(-1));
        assert_eq!(
            add(Run::Loaded(IPT), point(5_500_000, 10_000_001)),
            output(10_000_001)
        );
        let small = |i| Err(SupplyRefusal::TestCurrentTooSmall(Microamps(i)));
        assert_eq!(
            add(Run::Loaded(Microamps(29_999_999)), good),
            small(29_999_999)
        );
        assert_eq!(
            add(Run::Loaded(Microamps(-29_999_999)), good),
            small(-29_999_999)
        );
        assert_eq!(calibration, SupplyCalibration::new());
        let anything = SupplyCalibrationConfig {
            min_test_current: Microamps(0),
            ..config()
        };
        assert_eq!(
            calibration.add(&anything, Run::Loaded(Microamps(0)), good),
            small(0)
        );
        assert_eq!(
            calibration.add(&config(), Run::Loaded(Microamps(-30_000_000)), good),
            Ok(())
        );
        let before = calibration;
        assert_eq!(
            calibration.add(&config(), Run::Loaded(Microamps(30_000_000)), good),
            Err(SupplyRefusal::TestCurrentChanged)
        );
        assert_eq!(calibration, before);
        for run in [Run::Zero, Run::Loaded(Microamps(-30_000_000))] {
            let taken = if run == Run::Zero { 0 } else { 1 };
            for _ in taken..MAX_POINTS {
                assert_eq!(
                    calibration.add(&config(), run, point(5_500_000, 10_000_000)),
                    Ok(())
                );
            }
            let full = Err(SupplyRefusal::TooManyPoints);
            assert_eq!(calibration.add(&config(), run, good), full);
        }
        assert_eq!(calibration.points(), (256, 256));
    }

    #[test]
    fn a_calibration_is_refused_with_the_reason() {
        let finish = |calibration: &SupplyCalibration| calibration.finish(&config(), TURNS);
        let reason = |calibration: &SupplyCalibration| finish(calibration).unwrap_err();
        let four = [4_500_000, 4_800_000, 5_200_000, 5_300_000];
        let few = sweep(&SENSOR, &four, IPT);
        assert_eq!(reason(&few), SupplyRefusal::TooFewPoints(RunName::Zero, 4));
        let mut one_sided = few;
        one_sided
            .add(&config(), Run::Zero, SENSOR.point(5_000_000, 0.0))
            .unwrap();
        assert_eq!(
            reason(&one_sided),
            SupplyRefusal::TooFewPoints(RunName::Loaded, 4)
        );
        assert_eq!(
            reason(&SupplyCalibration::new()),
            SupplyRefusal::TooFewPoints(RunName::Zero, 0)
        );
        let lax = SupplyCalibrationConfig {
            min_points: 0,
            min_span: Microvolts(-1),
            ..config()
        };
        let three = sweep(&SENSOR, &four[..3], IPT);
        assert!(three.finish(&lax, TURNS).is_ok());
        let two = sweep(&SENSOR, &four[..2], IPT);
        assert_eq!(
            two.finish(&lax, TURNS),
            Err(SupplyRefusal::TooFewPoints(RunName::Zero, 2))
        );
        let still = sweep(&SENSOR, &[5_000_000; 5], IPT);
        let span = |run, v| SupplyRefusal::SpanTooSmall(run, Microvolts(v));
        assert_eq!(still.finish(&lax, TURNS), Err(span(RunName::Zero, 0)));

        let narrow = [4_600_000, 4_700_000, 4_800_000, 5_000_000, 5_399_999];
        assert_eq!(
            reason(&sweep(&SENSOR, &narrow, IPT)),
            span(RunName::Zero, 799_999)
        );
        let wide = [4_600_000, 4_700_000, 4_800_000, 5_000_000, 5_400_000];
        assert!(finish(&sweep(&SENSOR, &wide, IPT)).is_ok());
        // The lowest supply may come last.
        let falling = [5_400_000, 5_000_000, 4_800_000, 4_700_000, 4_600_000];
        assert!(finish(&sweep(&SENSOR, &falling, IPT)).is_ok());
        for turns in [0, -5, 20_001] {
            assert_eq!(
                few.finish(&config(), turns),
                Err(SupplyRefusal::Turns(turns))
            );
        }
        let zero_at = |m2| {
            reason(&sweep(
                &Sensor {
                    k2: 0.5,
                    m2,
                    ..SENSOR
                },
                &eleven(),
                IPT,
            ))
        };
        assert_eq!(
            zero_at(0.251),
            SupplyRefusal::ZeroOutOfLimits(Microvolts(2_751_000))
        );
        assert_eq!(
            zero_at(-0.251),
            SupplyRefusal::ZeroOutOfLimits(Microvolts(2_249_000))
        );
        let edge = Sensor {
            k2: 0.5,
            m2: 0.25,
            ..SENSOR
        };
        assert!(finish(&sweep(&edge, &eleven(), IPT)).is_ok());
        let with = |k1, m1| {
            finish(&sweep(
                &Sensor {
                    k1,
                    m1,
                    k2: 0.5,
                    m2: 0.0,
                },
                &eleven(),
                IPT,
            ))
        };
        let sensitivity = Err(SupplyRefusal::SensitivityOutOfLimits);
        // 0.1 mV/A · 2,000 is 0.2 Ω.
        assert_eq!(with(0.0, 0.19), sensitivity);
        assert!(with(0.0, 0.21).is_ok());
        assert_eq!(with(-2.5, -0.8), sensitivity);
        // Fine at one end, not at the other.
        assert_eq!(with(0.5, -2.3), sensitivity);
        assert_eq!(with(-0.5, 2.9), sensitivity);
    }

    #[test]
    fn scatter_is_measured_and_limits_the_calibration() {
        // Outputs alternate by ± 2.1 mV around the line of either run.
        let noisy = |which: Run, by: i32| {
            let mut calibration = sweep(&SENSOR, &eleven(), IPT);
            let line = SENSOR
                .point(4_500_000, if which == Run::Zero { 0.0 } else { 200.0 })
                .output;
            for n in 0..100 {
                let point = SupplyPoint {
                    supply: Microvolts(4_500_000),
                    output: Microvolts(line.get() + if n % 2 == 0 { by } else { -by }),
                };
                calibration.add(&config(), which, point).unwrap();
            }
            calibration.finish(&config(), TURNS)
        };
        // Variance 100 · 2.1² / 109 = 2.011² mV².
        let unstable = |run| Err(SupplyRefusal::Unstable(run, Microvolts(2_011)));
        assert_eq!(noisy(Run::Zero, 2_100), unstable(RunName::Zero));
        assert_eq!(noisy(Run::Loaded(IPT), 2_100), unstable(RunName::Loaded));
        let done = noisy(Run::Zero, 2_000).unwrap();
        assert_eq!(done.zero_residual, Microvolts(1_915));
        assert_eq!(done.loaded_residual, Microvolts(0));
        assert_eq!(
            noisy(Run::Loaded(IPT), 1_000).unwrap().loaded_residual,
            Microvolts(957)
        );
    }

    #[test]
    fn every_refusal_says_what_it_is() {
        for (refusal, part) in [
            (
                SupplyRefusal::SupplyOutOfLimits(Microvolts(1)),
                "supply 1 µV",
            ),
            (
                SupplyRefusal::OutputOutOfLimits(Microvolts(2)),
                "output 2 µV",
            ),
            (SupplyRefusal::TooManyPoints, "256 points"),
            (
                SupplyRefusal::TestCurrentTooSmall(Microamps(3)),
                "3 µA is too small",
            ),
            (SupplyRefusal::TestCurrentChanged, "changed within"),
            (
                SupplyRefusal::TooFewPoints(RunName::Zero, 4),
                "Zero run: only 4 points",
            ),
            (
                SupplyRefusal::SpanTooSmall(RunName::Loaded, Microvolts(5)),
                "Loaded run: only 5 µV",
            ),
            (
                SupplyRefusal::Unstable(RunName::Zero, Microvolts(6)),
                "unstable, 6 µV",
            ),
            (SupplyRefusal::Turns(7), "turns ratio 7"),
            (
                SupplyRefusal::ZeroOutOfLimits(Microvolts(8)),
                "zero output 8 µV",
            ),
            (SupplyRefusal::SensitivityOutOfLimits, "Hall sensor"),
        ] {
            assert!(refusal.to_string().contains(part), "{refusal}");
        }
    }

    fn reference_line(points: &[(f64, f64)]) -> (f64, f64) {
        let n = points.len() as f64;
        let (mx, my) = points
            .iter()
            .fold((0.0, 0.0), |(x, y), p| (x + p.0 / n, y + p.1 / n));
        let (sxx, sxy) = points.iter().fold((0.0, 0.0), |(xx, xy), (x, y)| {
            (xx + (x - mx) * (x - mx), xy + (x - mx) * (y - my))
        });
        (sxy / sxx, my - sxy / sxx * mx)
    }

    proptest! {
        #[test]
        fn agrees_with_a_floating_point_reference(
            steps in proptest::collection::vec((4_500_000..=5_500_000i32, -3_000..3_000i32, -3_000..3_000i32), 3..60),
        ) {
            let mut calibration = SupplyCalibration::new();
            let (mut zero, mut loaded) = (Vec::new(), Vec::new());
            let mut ends = std::vec![(4_500_000, 0, 0), (5_500_000, 0, 0)];
            ends.extend(steps);
            for (supply, noise, other_noise) in ends {
                for (points, run, amps, by) in [
                    (&mut zero, Run::Zero, 0.0, noise), (&mut loaded, Run::Loaded(IPT), 200.0, other_noise),
                ] {
                    let mut point = SENSOR.point(supply, amps);
                    point.output.0 += by;
                    calibration.add(&config(), run, point).unwrap();
                    points.push((f64::from(supply) * 1e-6, f64::from(point.output.get()) * 1e-6));
                }
            }
            let lax = SupplyCalibrationConfig { max_residual: Microvolts(5_000), ..config() };
            let relations = calibration.finish(&lax, TURNS).unwrap().relations;
            let ((c1, c2), (c3, c4)) = (reference_line(&zero), reference_line(&loaded));
            let turns_per_amp = f64::from(TURNS) / 200.0;
            for (got, expected) in [
                (relations.k1_nanoohm_per_volt, (c3 - c1) * turns_per_amp),
                (relations.m1_nanoohm, (c4 - c2) * turns_per_amp),
                (relations.k2_nanovolt_per_volt, c1),
                (relations.m2_nanovolt, c2),
            ] {
                prop_assert!((got as f64 - expected * 1e9).abs() <= 1.0, "{got} {expected}");
            }
        }

        /// Outputs rounded to `quantum` are off by half of it at most, so a line at x is off by at most
        /// quantum/2 · Σ |1/n + (x − x̄)(xᵢ − x̄)/Σ(xⱼ − x̄)²|, and the impedance by twice that times N/Ipt.
        #[test]
        fn quantised_outputs_cost_no_more_than_the_derived_bound(
            k1 in 1.0..4.0f64, m1 in -1.0..1.0f64, k2 in 0.48..0.52f64, m2 in -0.1..0.1f64,
            quantum in 1..700i32, at in 4.5..5.5f64,
            supplies in proptest::collection::vec(4_500_000..=5_500_000i32, 3..40),
        ) {
            let sensor = Sensor { k1, m1, k2, m2 };
            let mut all = std::vec![4_500_000, 5_500_000];
            all.extend(supplies);
            let mut calibration = SupplyCalibration::new();
            for supply in &all {
                for (run, amps) in [(Run::Zero, 0.0), (Run::Loaded(IPT), 200.0)] {
                    let exact = sensor.output(f64::from(*supply) * 1e-6, amps) * 1e6;
                    let output = (exact / f64::from(quantum)).round() as i32 * quantum;
                    let point = SupplyPoint { supply: Microvolts(*supply), output: Microvolts(output) };
                    calibration.add(&config(), run, point).unwrap();
                }
            }
            let relations = calibration.finish(&config(), TURNS).unwrap().relations;
            let n = all.len() as f64;
            let mean = all.iter().map(|x| f64::from(*x) * 1e-6 / n).sum::<f64>();
            let spread = all.iter().map(|x| (f64::from(*x) * 1e-6 - mean).powi(2)).sum::<f64>();
            let bound = all.iter()
                .map(|x| (1.0 / n + (at - mean) * (f64::from(*x) * 1e-6 - mean) / spread).abs())
                .sum::<f64>() * f64::from(quantum) * 0.5e-6;
            let supply = Microvolts((at * 1e6).round() as i32);
            let at = f64::from(supply.get()) * 1e-6;
            let zero = relations.zero_nanovolt(supply) as f64 * 1e-9;
            prop_assert!((zero - (k2 * at + m2)).abs() <= bound + 5e-9);
            let impedance = relations.impedance_nanoohm(supply) as f64 * 1e-9;
            let impedance_bound = 2.0 * bound * f64::from(TURNS) / 200.0;
            prop_assert!((impedance - (k1 * at + m1)).abs() <= impedance_bound + 5e-8);
        }

        #[test]
        fn no_point_and_no_configuration_panics(
            points in proptest::collection::vec((any::<i32>(), 0..=10_000_000i32, any::<bool>(), 4_500_000..=5_500_000i32), 0..300),
            current: i32, turns: i32, min_points: u16, limits in proptest::array::uniform4(any::<i32>()),
        ) {
            let wild = SupplyCalibrationConfig {
                min_points: min_points % 8,
                min_span: Microvolts(limits[0]),
                max_residual: Microvolts(limits[1]),
                min_test_current: Microamps(limits[2]),
                zero_tolerance: Microvolts(limits[3]),
            };
            let mut calibration = SupplyCalibration::new();
            for (any, output, loaded, supply) in points {
                let run = if loaded { Run::Loaded(Microamps(current)) } else { Run::Zero };
                let _ = calibration.add(&wild, run, SupplyPoint { supply: Microvolts(any), output: Microvolts(any) });
                let _ = calibration.add(&wild, run, SupplyPoint { supply: Microvolts(supply), output: Microvolts(output) });
            }
            let _ = calibration.finish(&wild, turns);
            let _ = calibration.finish(&wild, TURNS);
        }
    }

    #[test]
    fn the_sums_hold_at_the_worst_they_can_be() {
        let mut calibration = SupplyCalibration::new();
        for n in 0..MAX_POINTS {
            let half = i32::from(n >= MAX_POINTS / 2);
            let point = SupplyPoint {
                supply: Microvolts(4_500_000 + half * 1_000_000),
                output: Microvolts(10_000_000 * half),
            };
            for run in [Run::Zero, Run::Loaded(Microamps(1))] {
                let lax = SupplyCalibrationConfig {
                    min_test_current: Microamps(1),
                    ..config()
                };
                calibration.add(&lax, run, point).unwrap();
            }
        }
        // c1 = 10 V/V and c2 = −45 V: 5 V at the rated supply.
        assert_eq!(
            calibration.finish(&config(), TURNS),
            Err(SupplyRefusal::ZeroOutOfLimits(Microvolts(5_000_000)))
        );
    }
}
