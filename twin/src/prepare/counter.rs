//! What a tester's own charge counter tells of the current between its rows.
//!
//! A cycler logs a step's last row when the step ends and the next step's first row one interval later: the current changed where the
//! interval began, and a straight line between the two rows counts half of it too much or too little. The counter beside the current
//! was integrated inside, and says where the mean of each interval lies.

use crate::{
    problem::{Drive, Series},
    report::format::at_most,
};

/// Share of the charge of a step by which counter and current may differ: two channels of a tester, each within 0.1 %.
const CHANNELS: f64 = 0.002;
/// A step whose mean is known to this standard uncertainty, as a share of the way between its ends, tells something.
const TELLS: f64 = 0.2;
/// Standard deviations beyond the ends of a step from which the counter did not count that current: it was reset.
const RESET: f64 = 3.0;
/// The counter belongs to the current if it counted so many of the steps that tell something.
const COUNTED: f64 = 0.5;
/// Variance of a share that may be anything from 0 to 1: what is known before the counter is asked.
const ANYTHING: f64 = 1.0 / 12.0;
/// Decimal digits behind the point up to which a counter may round.
const DIGITS: i32 = 9;
/// Standard deviations in a median of absolute values.
const OF_MEDIAN: f64 = 1.4826;

/// How the current goes between its rows.
pub(super) struct Told {
    /// [`Drive::mean_share`].
    pub mean_share: Series,
    /// In words.
    pub remark: String,
}

/// Where the mean of each step lies by a counter in Ah on the drive's rows; nothing where it tells nothing, or is of another current.
pub(super) fn between_rows(drive: &Drive, ah: &[f64]) -> Option<Told> {
    let steps: Vec<Step> = drive
        .segments
        .iter()
        .flat_map(|rows| rows.clone().skip(1))
        .filter_map(|row| Step::new(drive, ah, row))
        .collect();
    let noise_ah = noise_ah(&steps, ah)?;
    let mut mean_share = vec![0.5; drive.len()];
    let (mut telling, mut counted, mut most_ah, mut all_ah) = (0usize, 0usize, 0.0f64, 0.0);
    for step in &steps {
        let sigma = noise_ah.hypot(CHANNELS * step.from_ah) / step.change_ah.abs();
        let share = (step.counted_ah - step.from_ah) / step.change_ah;
        let tells = sigma < TELLS;
        telling += usize::from(tells);
        if !sigma.is_finite() || share < -RESET * sigma || share > 1.0 + RESET * sigma {
            continue;
        }
        counted += usize::from(tells);
        // The mean of what is known before and of what the counter says, each with the weight of its variance.
        let (before, told) = (1.0 / ANYTHING, 1.0 / (sigma * sigma));
        let known = ((0.5 * before + share * told) / (before + told)).clamp(0.0, 1.0);
        mean_share[step.row] = known;
        let off_ah = (0.5 - known) * step.change_ah;
        most_ah = most_ah.max(off_ah.abs());
        all_ah += off_ah;
    }
    if telling == 0 || (counted as f64) < COUNTED * telling as f64 {
        return None;
    }
    Some(Told {
        mean_share: mean_share.into(),
        remark: format!(
            "ah_meas_ah tells how the current goes between its rows ({counted} steps): straight lines would count up to {} Ah wrong in one step, \
             {} Ah in all",
            at_most(most_ah, 3),
            at_most(all_ah, 3)
        ),
    })
}

/// A step of the current, in Ah over it.
struct Step {
    /// The row where it ends.
    row: usize,
    /// What the counter says.
    counted_ah: f64,
    /// What the current of the row where it begins comes to.
    from_ah: f64,
    /// What that of the row where it ends comes to beyond that.
    change_ah: f64,
}

impl Step {
    /// The one that ends at a row, if the counter was read at both ends.
    fn new(drive: &Drive, ah: &[f64], row: usize) -> Option<Self> {
        let hours = (drive.t_s[row] - drive.t_s[row - 1]) / 3600.0;
        let [from, to] = [drive.reference[row - 1], drive.reference[row]];
        let counted_ah = ah[row] - ah[row - 1];
        (hours > 0.0 && counted_ah.is_finite()).then_some(Self {
            row,
            counted_ah,
            from_ah: from * hours,
            change_ah: (to - from) * hours,
        })
    }
}

/// Standard deviation of what the counter says of one step: rounding of the two readings, or more if it scatters more about straight
/// lines.
fn noise_ah(steps: &[Step], ah: &[f64]) -> Option<f64> {
    let mut off: Vec<f64> = steps
        .iter()
        .map(|step| (step.counted_ah - step.from_ah - 0.5 * step.change_ah).abs())
        .collect();
    let scatter = OF_MEDIAN * super::series::median(&mut off)?;
    // Each of two readings is off by up to half a digit, evenly: variance 1/12 of its square each.
    let rounding = last_digit(ah) / 6f64.sqrt();
    Some(scatter.max(rounding)).filter(|noise| *noise > 0.0)
}

/// The last decimal digit that is in use. (A grid of the readings would be no rounding: at a constant current any counter climbs in even
/// steps.)
fn last_digit(ah: &[f64]) -> f64 {
    let read = || ah.iter().filter(|ah| ah.is_finite());
    let is_whole = |digit: f64| {
        read().all(|ah| {
            let digits = ah / digit;
            (digits - digits.round()).abs() < 1e-3
        })
    };
    (0..=DIGITS)
        .map(|digits| 0.1f64.powi(digits))
        .find(|digit| is_whole(*digit))
        .unwrap_or_default()
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    /// Steps of 20 A every ten minutes, logged each minute; the current changes at a share of the interval after which it was logged
    /// first, and a counter of 0.01 Ah counts it, with a factor.
    fn logged(share: f64, factor: f64) -> (Drive, Vec<f64>, f64) {
        let current = |row: i32| if row / 10 % 2 == 1 { 20.0 } else { 0.0 };
        let rows = 400;
        let t_s: Vec<f64> = (0..rows).map(|row| 60.0 * f64::from(row)).collect();
        let reference: Vec<f64> = (0..rows).map(current).collect();
        let mut flowed = 0.0;
        let ah = (0..rows).map(|row| {
            if row > 0 {
                let (from, to) = (current(row - 1), current(row));
                flowed += (from + share * (to - from)) / 60.0;
            }
            (factor * flowed * 100.0).round() / 100.0
        });
        let ah: Vec<f64> = ah.collect();
        let drive = Drive {
            segments: std::iter::once(0..t_s.len()).collect(),
            continues: vec![false],
            t_s: t_s.into(),
            reference: reference.into(),
            ..Drive::default()
        };
        (drive, ah, flowed)
    }

    #[test]
    fn charge_follows_the_counter_wherever_the_current_changed() {
        for share in [0.0, 0.2, 0.5, 1.0] {
            let (mut drive, ah, flowed) = logged(share, 1.0);
            let told = between_rows(&drive, &ah).unwrap();
            for row in
                (1..drive.len()).filter(|row| drive.reference[*row] != drive.reference[row - 1])
            {
                let there = told.mean_share[row];
                assert!(
                    (there - share).abs() < 0.06,
                    "row {row}: {there} for {share}"
                );
            }
            drive.mean_share = Some(told.mean_share);
            let counted = drive.charge()[drive.len() - 1] / 3600.0;
            assert!((counted - flowed).abs() < 0.05, "{counted} Ah of {flowed}");
        }
    }

    #[test]
    fn a_reset_tells_nothing_of_its_step() {
        let (drive, mut ah, _) = logged(1.0, 1.0);
        // The counter begins anew with each discharge.
        let mut zero = 0.0;
        for (row, ah) in ah.iter_mut().enumerate().skip(1) {
            if drive.reference[row] > 0.0 && drive.reference[row - 1] == 0.0 {
                zero = *ah;
            }
            *ah -= zero;
        }
        let told = between_rows(&drive, &ah).unwrap();
        for row in 11..drive.len() {
            let (from, to) = (drive.reference[row - 1], drive.reference[row]);
            if from == 0.0 && to > 0.0 {
                assert_eq!(told.mean_share[row], 0.5, "row {row}");
            } else if from > 0.0 && to == 0.0 {
                assert!(told.mean_share[row] > 0.94, "row {row}");
            }
        }
    }

    #[test]
    fn a_counter_of_another_current_is_not_asked() {
        for factor in [-1.0, 0.3, 3.0] {
            let (drive, ah, _) = logged(0.5, factor);
            assert!(between_rows(&drive, &ah).is_none(), "{factor}");
        }
        let (drive, ah, _) = logged(0.5, 0.0);
        assert!(between_rows(&drive, &ah).is_none());
    }
}
