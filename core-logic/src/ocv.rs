//! Open-circuit voltage of a cell against its state of charge.
//!
//! A table of up to [`MAX_POINTS`] points, strictly rising in both columns, linear between its points and held beyond
//! its ends. The inverse also says how uncertain a state of charge is that was read from an uncertain voltage: where
//! the curve is flat, a few millivolts are many per cent.

use core::fmt;

use serde::{Deserialize, Serialize};

use crate::design_parameters::OCV_IMPLAUSIBLE_BEYOND;
use crate::units::{Microvolts, Ppm, add_i64, clamp_i32, div_round, mul_i64};

/// Points that a table holds at most: steps of 5 %.
pub const MAX_POINTS: usize = 21;

/// Plausible open-circuit voltages of one cell of any chemistry.
const LOWEST_VOLTAGE: Microvolts = Microvolts::from_millivolts(500);
/// See [`LOWEST_VOLTAGE`].
const HIGHEST_VOLTAGE: Microvolts = Microvolts::from_millivolts(5_000);

/// One point of the table.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct OcvPoint {
    /// State of charge, 0 … 1,000,000 ppm.
    pub soc: Ppm,
    /// Open-circuit voltage of one cell there.
    pub voltage: Microvolts,
}

/// The table (configuration).
///
/// The fields are open so that a register map can write single points into a copy; [`OcvTable::validate`] decides
/// whether the whole may be used. A table that is not valid never panics, it only reads nonsense.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct OcvTable {
    /// The points, rising; those from `count` on are not used.
    pub points: [OcvPoint; MAX_POINTS],
    /// Number of points in use.
    pub count: u8,
}

/// Why a table is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum OcvTableError {
    /// Fewer than two points or more than [`MAX_POINTS`].
    Count(usize),
    /// The first point is not at 0 ppm or the last not at 1,000,000 ppm.
    Ends,
    /// The state of charge of the point with this index is not above that of the point before.
    SocNotRising(usize),
    /// The voltage of the point with this index is not above that of the point before.
    VoltageNotRising(usize),
    /// The voltage of the point with this index is not one of a single cell (0.5 … 5 V).
    VoltageOutOfLimits(usize),
}

impl fmt::Display for OcvTableError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Count(count) => write!(f, "{count} points; 2 to {MAX_POINTS} are needed"),
            Self::Ends => write!(f, "the table must run from 0 to 1000000 ppm"),
            Self::SocNotRising(index) => write!(f, "point {index}: state of charge does not rise"),
            Self::VoltageNotRising(index) => write!(f, "point {index}: voltage does not rise"),
            Self::VoltageOutOfLimits(index) => {
                write!(f, "point {index}: voltage outside 0.5 to 5 V")
            }
        }
    }
}

impl core::error::Error for OcvTableError {}

/// A state of charge read from a voltage.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct OcvEstimate {
    /// The state of charge, held at 0 and 1,000,000 ppm.
    pub soc: Ppm,
    /// Half-width of the state of charge that belongs to the uncertainty of the voltage.
    pub uncertainty: Ppm,
}

impl OcvTable {
    /// A valid table of these points.
    ///
    /// # Errors
    /// The reason for which [`OcvTable::validate`] refuses them.
    pub fn new(points: &[OcvPoint]) -> Result<Self, OcvTableError> {
        let mut table = Self {
            points: [OcvPoint::default(); MAX_POINTS],
            count: 0,
        };
        if points.len() > MAX_POINTS {
            return Err(OcvTableError::Count(points.len()));
        }
        for (slot, point) in table.points.iter_mut().zip(points) {
            *slot = *point;
            table.count += 1;
        }
        table.validate()?;
        Ok(table)
    }

    /// The points in use.
    #[must_use]
    pub fn points(&self) -> &[OcvPoint] {
        self.points
            .get(..usize::from(self.count))
            .unwrap_or(&self.points)
    }

    /// Whether the table may be used.
    ///
    /// # Errors
    /// The first rule that it breaks, with the index of the point.
    pub fn validate(&self) -> Result<(), OcvTableError> {
        let count = usize::from(self.count);
        if !(2..=MAX_POINTS).contains(&count) {
            return Err(OcvTableError::Count(count));
        }
        let points = self.points();
        let mut previous: Option<OcvPoint> = None;
        for (index, point) in points.iter().enumerate() {
            if !(LOWEST_VOLTAGE..=HIGHEST_VOLTAGE).contains(&point.voltage) {
                return Err(OcvTableError::VoltageOutOfLimits(index));
            }
            if let Some(before) = previous {
                if point.soc <= before.soc {
                    return Err(OcvTableError::SocNotRising(index));
                }
                if point.voltage <= before.voltage {
                    return Err(OcvTableError::VoltageNotRising(index));
                }
            }
            previous = Some(*point);
        }
        let ends = (points.first().map(|p| p.soc), points.last().map(|p| p.soc));
        if ends != (Some(Ppm::ZERO), Some(Ppm::ONE)) {
            return Err(OcvTableError::Ends);
        }
        Ok(())
    }

    /// The open-circuit voltage at a state of charge, rounded to a microvolt.
    #[must_use]
    pub fn voltage(&self, soc: Ppm) -> Microvolts {
        Microvolts(interpolate(
            self.points().iter().map(|p| (p.soc.get(), p.voltage.get())),
            soc.get(),
        ))
    }

    /// The state of charge at an open-circuit voltage, rounded to a millionth.
    #[must_use]
    pub fn soc(&self, voltage: Microvolts) -> Ppm {
        Ppm(interpolate(
            self.points().iter().map(|p| (p.voltage.get(), p.soc.get())),
            voltage.get(),
        ))
    }

    /// The state of charge at a voltage that is known to ± `uncertainty`; `None` when the voltage is not that of a
    /// cell at rest (more than [`OCV_IMPLAUSIBLE_BEYOND`] beyond the table).
    ///
    /// The uncertainty of the state of charge follows from the flattest piece of the curve that the interval of the
    /// voltage touches, so it is never understated at a knee. It is at least one ppm.
    #[must_use]
    pub fn estimate(&self, voltage: Microvolts, uncertainty: Microvolts) -> Option<OcvEstimate> {
        let (first, last) = (self.points().first()?, self.points().last()?);
        if voltage < first.voltage.saturating_sub(OCV_IMPLAUSIBLE_BEYOND)
            || voltage > last.voltage.saturating_add(OCV_IMPLAUSIBLE_BEYOND)
        {
            return None;
        }
        let half = uncertainty.saturating_abs();
        // Beyond an end the end's own piece counts, therefore the interval is moved onto the table.
        let low = voltage.saturating_sub(half).min(last.voltage);
        let high = voltage.saturating_add(half).max(first.voltage);
        let mut widest = 0;
        for (from, to) in self.points().iter().zip(self.points().iter().skip(1)) {
            if to.voltage >= low && from.voltage <= high {
                let run = i64::from(to.soc.get()) - i64::from(from.soc.get());
                let rise = i64::from(to.voltage.get()) - i64::from(from.voltage.get());
                widest = div_round(mul_i64(i64::from(half.get()), run), rise).max(widest);
            }
        }
        Some(OcvEstimate {
            soc: self.soc(voltage),
            uncertainty: Ppm(clamp_i32(widest.clamp(1, i64::from(Ppm::ONE.get())))),
        })
    }
}

impl Default for OcvTable {
    /// An example, to be replaced by that of the cell in use: Panasonic NCR18650PF at 25 °C in steps of 10 %, the mean
    /// of a C/20 discharge and charge (P. Kollmeyer, "Panasonic 18650PF Li-ion Battery Data", Mendeley Data V1, 2018,
    /// DOI 10.17632/wykht8y7tg.1, CC BY 4.0; averaged and resampled).
    fn default() -> Self {
        const VOLTAGES: [i32; 11] = [
            2_713_100, 3_364_100, 3_485_500, 3_565_700, 3_620_700, 3_685_300, 3_788_300, 3_876_000,
            3_961_700, 4_069_500, 4_185_200,
        ];
        let mut table = Self {
            points: [OcvPoint::default(); MAX_POINTS],
            count: 0,
        };
        let mut soc = 0;
        for (slot, voltage) in table.points.iter_mut().zip(VOLTAGES) {
            *slot = OcvPoint {
                soc: Ppm(soc),
                voltage: Microvolts(voltage),
            };
            soc += 100_000;
            table.count += 1;
        }
        table
    }
}

/// `y` at `x` on the line through `points`, which rise in both; the end's `y` beyond either end, 0 without a point.
fn interpolate(points: impl Iterator<Item = (i32, i32)>, x: i32) -> i32 {
    let mut previous: Option<(i32, i32)> = None;
    for (x1, y1) in points {
        if x <= x1 {
            let Some((x0, y0)) = previous else {
                return y1;
            };
            let run = i64::from(x1) - i64::from(x0);
            let rise = i64::from(y1) - i64::from(y0);
            let along = i64::from(x) - i64::from(x0);
            // |rise · along| < 2^65 only for a table that is not valid; saturating keeps that harmless.
            return clamp_i32(add_i64(i64::from(y0), div_round(mul_i64(rise, along), run)));
        }
        previous = Some((x1, y1));
    }
    previous.map_or(0, |(_, y)| y)
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
    use proptest::prelude::*;
    use std::string::ToString;
    use std::vec::Vec;

    fn point(soc: i32, voltage: i32) -> OcvPoint {
        OcvPoint {
            soc: Ppm(soc),
            voltage: Microvolts(voltage),
        }
    }

    /// Flat in its middle third, as LFP is.
    fn flat() -> OcvTable {
        OcvTable::new(&[
            point(0, 3_000_000),
            point(300_000, 3_300_000),
            point(700_000, 3_304_000),
            point(1_000_000, 3_604_000),
        ])
        .unwrap()
    }

    fn any_table() -> impl Strategy<Value = OcvTable> {
        proptest::collection::vec((1..50_000i32, 1..200_000i32), 1..MAX_POINTS).prop_map(|steps| {
            let total: i64 = steps.iter().map(|(soc, _)| i64::from(*soc)).sum();
            let mut points = std::vec![point(0, 1_000_000)];
            let (mut soc, mut voltage) = (0i64, 1_000_000);
            for (index, (by, rise)) in steps.iter().enumerate() {
                soc += i64::from(*by);
                voltage += *rise;
                let last = points[index].soc.get();
                let scaled = ((soc * 1_000_000 / total) as i32).max(last + 1);
                points.push(point(scaled, voltage));
            }
            points.last_mut().unwrap().soc = Ppm::ONE;
            OcvTable::new(&points).unwrap()
        })
    }

    #[test]
    fn the_example_is_the_recorded_cell_in_steps_of_ten_per_cent() {
        let table = OcvTable::default();
        assert_eq!(table.validate(), Ok(()));
        assert_eq!(table.points().len(), 11);
        for (tenth, millivolts_10) in [
            27_131, 33_641, 34_855, 35_657, 36_207, 36_853, 37_883, 38_760, 39_617, 40_695, 41_852,
        ]
        .into_iter()
        .enumerate()
        {
            let at = point(tenth as i32 * 100_000, millivolts_10 * 100);
            assert_eq!(table.points()[tenth], at);
            assert_eq!(table.voltage(at.soc), at.voltage);
            assert_eq!(table.soc(at.voltage), at.soc);
        }
    }

    #[test]
    fn between_points_it_is_a_straight_line_and_beyond_them_held() {
        let table = flat();
        assert_eq!(table.voltage(Ppm(150_000)), Microvolts(3_150_000));
        assert_eq!(table.voltage(Ppm(400_000)), Microvolts(3_301_000));
        assert_eq!(table.soc(Microvolts(3_301_000)), Ppm(400_000));
        assert_eq!(table.soc(Microvolts(3_454_000)), Ppm(850_000));
        assert_eq!(table.voltage(Ppm(-5)), Microvolts(3_000_000));
        assert_eq!(table.voltage(Ppm(1_000_001)), Microvolts(3_604_000));
        assert_eq!(table.soc(Microvolts(i32::MIN)), Ppm(0));
        assert_eq!(table.soc(Microvolts(i32::MAX)), Ppm(1_000_000));
    }

    #[test]
    fn a_flat_piece_makes_the_state_of_charge_uncertain() {
        let table = flat();
        let estimate = |voltage, uncertainty| {
            table
                .estimate(Microvolts(voltage), Microvolts(uncertainty))
                .unwrap()
        };
        // 1 µV per ppm on the slopes, 0.01 µV per ppm in the middle.
        assert_eq!(estimate(3_100_000, 5_000).uncertainty, Ppm(5_000));
        assert_eq!(estimate(3_100_000, -5_000).uncertainty, Ppm(5_000));
        assert_eq!(estimate(3_302_000, 1_000).uncertainty, Ppm(100_000));
        assert_eq!(estimate(3_302_000, 1_000).soc, Ppm(500_000));
        assert_eq!(estimate(3_302_000, 100_000_000).uncertainty, Ppm(1_000_000));
        // 5 mV below the knee the flat piece is out of reach, at 5 mV it is not; the same above.
        assert_eq!(estimate(3_294_999, 5_000).uncertainty, Ppm(5_000));
        assert_eq!(estimate(3_295_000, 5_000).uncertainty, Ppm(500_000));
        assert_eq!(estimate(3_309_001, 5_000).uncertainty, Ppm(5_000));
        assert_eq!(estimate(3_309_000, 5_000).uncertainty, Ppm(500_000));
        assert_eq!(estimate(3_100_000, 0).uncertainty, Ppm(1));
    }

    #[test]
    fn beyond_the_ends_the_end_counts_until_it_is_no_cell() {
        let table = flat();
        let low = OcvEstimate {
            soc: Ppm(0),
            uncertainty: Ppm(2_000),
        };
        let high = OcvEstimate {
            soc: Ppm(1_000_000),
            ..low
        };
        let uncertainty = Microvolts(2_000);
        let estimate = |voltage| table.estimate(Microvolts(voltage), uncertainty);
        assert_eq!(estimate(2_900_000), Some(low));
        assert_eq!(estimate(2_500_000), Some(low));
        assert_eq!(estimate(2_499_999), None);
        assert_eq!(estimate(4_104_000), Some(high));
        assert_eq!(estimate(4_104_001), None);
        let empty = OcvTable {
            points: [OcvPoint::default(); MAX_POINTS],
            count: 0,
        };
        assert_eq!(empty.estimate(Microvolts(0), uncertainty), None);
        assert_eq!(empty.voltage(Ppm(5)), Microvolts(0));
    }

    #[test]
    fn a_bad_table_is_refused_with_the_reason() {
        let good = [
            point(0, 3_000_000),
            point(500_000, 3_500_000),
            point(1_000_000, 4_000_000),
        ];
        let with = |index: usize, replacement| {
            let mut points = good;
            points[index] = replacement;
            OcvTable::new(&points)
        };
        assert!(OcvTable::new(&good).is_ok());
        assert!(OcvTable::new(&[good[0], good[2]]).is_ok());
        assert_eq!(OcvTable::new(&good[..1]), Err(OcvTableError::Count(1)));
        assert_eq!(OcvTable::new(&[]), Err(OcvTableError::Count(0)));
        let many = [good[0]; MAX_POINTS + 1];
        assert_eq!(OcvTable::new(&many), Err(OcvTableError::Count(22)));
        assert_eq!(with(0, point(1, 3_000_000)), Err(OcvTableError::Ends));
        assert_eq!(with(2, point(999_999, 4_000_000)), Err(OcvTableError::Ends));
        assert_eq!(
            with(1, point(0, 3_500_000)),
            Err(OcvTableError::SocNotRising(1))
        );
        assert_eq!(
            with(2, point(400_000, 4_000_000)),
            Err(OcvTableError::SocNotRising(2))
        );
        assert_eq!(
            with(1, point(500_000, 3_000_000)),
            Err(OcvTableError::VoltageNotRising(1))
        );
        assert_eq!(
            with(0, point(0, 499_999)),
            Err(OcvTableError::VoltageOutOfLimits(0))
        );
        assert!(with(0, point(0, 500_000)).is_ok());
        assert!(with(2, point(1_000_000, 5_000_000)).is_ok());
        assert_eq!(
            with(2, point(1_000_000, 5_000_001)),
            Err(OcvTableError::VoltageOutOfLimits(2))
        );
        let overlong = OcvTable {
            count: 22,
            ..OcvTable::default()
        };
        assert_eq!(overlong.validate(), Err(OcvTableError::Count(22)));
        assert_eq!(overlong.points().len(), MAX_POINTS);
        let texts: Vec<_> = [
            OcvTableError::Count(1),
            OcvTableError::Ends,
            OcvTableError::SocNotRising(3),
            OcvTableError::VoltageNotRising(4),
            OcvTableError::VoltageOutOfLimits(5),
        ]
        .iter()
        .map(ToString::to_string)
        .collect();
        assert!(texts[0].starts_with("1 points") && texts[1].contains("1000000"));
        assert!(texts[2].contains("3: state") && texts[3].contains("4: voltage does"));
        assert!(texts[4].contains("5: voltage outside"));
    }

    #[test]
    fn a_full_table_survives_the_wire() {
        let points: Vec<_> = (0..MAX_POINTS as i32)
            .map(|n| point(n * 50_000, 2_000_000 + n * 100_000))
            .collect();
        let table = OcvTable::new(&points).unwrap();
        let mut buffer = [0; 256];
        let bytes = postcard::to_slice(&table, &mut buffer).unwrap();
        assert_eq!(postcard::from_bytes::<OcvTable>(bytes).unwrap(), table);
    }

    proptest! {
        #[test]
        fn there_and_back(table in any_table(), soc in 0..=1_000_000i32) {
            let voltage = table.voltage(Ppm(soc));
            let back = table.soc(voltage);
            // Half a microvolt of rounding, seen through the flattest piece, and half a ppm.
            let reach = table.estimate(voltage, Microvolts(1)).unwrap().uncertainty.get() / 2 + 2;
            prop_assert!((back.get() - soc).abs() <= reach, "{} {}", back.get(), soc);
        }

        #[test]
        fn both_directions_rise(table in any_table(), a in -10..1_000_010i32, b in -10..1_000_010i32,
                                v in 0..6_000_000i32, w in 0..6_000_000i32) {
            let (a, b) = (a.min(b), a.max(b));
            prop_assert!(table.voltage(Ppm(a)) <= table.voltage(Ppm(b)));
            let (v, w) = (v.min(w), v.max(w));
            prop_assert!(table.soc(Microvolts(v)) <= table.soc(Microvolts(w)));
        }

        #[test]
        fn the_stated_uncertainty_covers_the_voltage_interval(
            table in any_table(), soc in 0..=1_000_000i32, half in 0..50_000i32, share in -100..=100i32,
        ) {
            let truth = table.voltage(Ppm(soc));
            let seen = Microvolts(truth.get() + half * share / 100);
            let estimate = table.estimate(seen, Microvolts(half)).unwrap();
            let true_soc = table.soc(truth);
            prop_assert!((estimate.soc.get() - true_soc.get()).abs() <= estimate.uncertainty.get() + 2);
        }

        #[test]
        fn no_table_and_no_input_panics(
            points in proptest::array::uniform21((any::<i32>(), any::<i32>())), count: u8,
            a: i32, b: i32,
        ) {
            let table = OcvTable { points: points.map(|(s, v)| point(s, v)), count };
            let _ = (table.validate(), table.voltage(Ppm(a)), table.soc(Microvolts(b)));
            let _ = table.estimate(Microvolts(a), Microvolts(b));
        }
    }
}
