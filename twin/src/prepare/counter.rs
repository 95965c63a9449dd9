//! What a tester's own charge counter tells of the current between its rows.
//!
//! A cycler logs a step's last row when the step ends and the next step's first row one interval later: the current changed where the
//! interval began, and a straight line between the two rows counts half of it too much or too little. The counter beside the current
//! was integrated inside, and says where the mean of each interval lies.

use crate::{
    problem::{Drive, Series},
    range::range,
    report::format::at_most,
};

/// Share of the charge of a step by which counter and current may differ: two channels of a tester, each within 0.1 %.
const CHANNELS: f64 = 0.002;
/// A step whose mean is known to this standard uncertainty, as a share of the way between its ends, tells something.
const TELLS: f64 = 0.2;
/// Standard deviations beyond the ends of a step from which the counter did not count that current alone.
const RESET: f64 = 3.0;
/// The counter belongs to the current if it counted so many of the steps that tell something.
const COUNTED: f64 = 0.5;
/// Variance of a share that may be anything from 0 to 1: what is known before the counter is asked.
const ANYTHING: f64 = 1.0 / 12.0;
/// Share of the steps that tell how the counter scatters: those in which the current changes least.
const STILL: f64 = 0.25;
/// Rows for which a steady current stays: a drive does not by chance.
const WHILE: usize = 10;
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
    let [lowest_a, highest_a] = range(drive.reference.iter().copied())?;
    let is_reset = |step: &Step, sigma: f64| {
        let mean_a = step.counted_ah / step.hours;
        let wide_a = RESET * noise_ah / step.hours;
        // What it counted is more than any current of the recording, or less; or it is right from zero on, and only so.
        !(lowest_a - wide_a..=highest_a + wide_a).contains(&mean_a)
            || (!step.fits(step.counted_ah, sigma) && step.fits(ah[step.row], sigma))
    };
    let steady = steady(drive, CHANNELS * lowest_a.abs().max(highest_a.abs()));
    let mut mean_share = vec![0.5; drive.len()];
    let (mut telling, mut counted, mut most_ah, mut all_ah) = (0usize, 0usize, 0.0f64, 0.0);
    // What the counter has counted and the current between its rows has not yet: the counter does not forget, and a step that has to
    // stay between its ends, or tells little by itself, leaves the rest to the next ones. Else the errors of straight lines, which make up
    // for one another, were corrected in some steps and not in others. Where the current is steady there is nothing between its rows: what
    // the counter says there is how the two channels differ.
    let mut left_ah = 0.0f64;
    for step in &steps {
        let sigma = step.sigma(noise_ah);
        let tells = sigma < TELLS;
        telling += usize::from(tells);
        counted += usize::from(tells && step.fits(step.counted_ah, sigma));
        if steady[step.row] || is_reset(step, sigma) {
            continue;
        }
        left_ah += step.counted_ah - step.from_ah;
        let share = left_ah / step.change_ah;
        // The mean of what is known before and of what the counter says, each with the weight of its variance.
        let (before, told) = (1.0 / ANYTHING, 1.0 / (sigma * sigma));
        let known = ((0.5 * before + share * told) / (before + told)).clamp(0.0, 1.0);
        let known = if known.is_finite() { known } else { 0.5 };
        mean_share[step.row] = known;
        left_ah -= known * step.change_ah;
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

/// Rows that end a step in which the current stays where it is, to `within_a` either way, for a while.
fn steady(drive: &Drive, within_a: f64) -> Vec<bool> {
    let mut steady = vec![false; drive.len()];
    for rows in &drive.segments {
        let mut begin = rows.start;
        while begin < rows.end {
            let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
            let stays = rows.end.min(
                begin
                    + drive.reference[begin..rows.end]
                        .iter()
                        .take_while(|i| {
                            (low, high) = (low.min(**i), high.max(**i));
                            high - low <= 2.0 * within_a
                        })
                        .count(),
            );
            if stays - begin >= WHILE {
                steady[begin + 1..stays].fill(true);
                begin = stays - 1;
            }
            begin += 1;
        }
    }
    steady
}

/// A step of the current, in Ah over it.
struct Step {
    /// The row where it ends.
    row: usize,
    /// Its length in h.
    hours: f64,
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
            hours,
            counted_ah,
            from_ah: from * hours,
            change_ah: (to - from) * hours,
        })
    }

    /// What a straight line comes to.
    fn straight_ah(&self) -> f64 {
        self.from_ah + 0.5 * self.change_ah
    }

    /// Standard uncertainty of where the counter says that the mean lies, as a share of the way between the ends. The same whether the
    /// current goes up that way or down.
    fn sigma(&self, noise_ah: f64) -> f64 {
        noise_ah.hypot(CHANNELS * self.straight_ah()) / self.change_ah.abs()
    }

    /// Whether a charge is one of this step: its mean is between the ends.
    fn fits(&self, charge_ah: f64, sigma: f64) -> bool {
        let share = (charge_ah - self.from_ah) / self.change_ah;
        (-RESET * sigma..=1.0 + RESET * sigma).contains(&share)
    }
}

/// Standard deviation of what the counter says of one step: rounding of the two readings, or more if it scatters more about straight
/// lines where the current hardly changes.
fn noise_ah(steps: &[Step], ah: &[f64]) -> Option<f64> {
    let mut changes: Vec<f64> = steps.iter().map(|step| step.change_ah.abs()).collect();
    let even_ah = super::series::quantile(&mut changes, STILL)?;
    let mut off: Vec<f64> = steps
        .iter()
        .filter(|step| step.change_ah.abs() <= even_ah)
        .map(|step| (step.counted_ah - step.straight_ah()).abs())
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
    use crate::problem::Problem;

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
        let drive = Problem::pair(t_s, reference, ah.clone(), 0.0).drive;
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

    /// A drive of some seconds a row with a counter of what really flowed, in digits of a size.
    fn driven(
        row_s: usize,
        shows: fn(&[f64]) -> f64,
        digit: f64,
        drift: f64,
    ) -> (Drive, Vec<f64>, Vec<f64>) {
        // Fast up and slowly down, charge between.
        let current = |s: usize| {
            let t = s as f64;
            let burst = 30.0 * (1.0 - (t % 23.0) / 23.0).powi(3) - 12.0 * f64::from(s % 61 > 50);
            burst + 5.0 * (t / 7.0).sin() + 2.0 * (t * t * 0.37).sin()
        };
        let fine: Vec<f64> = (0..=7200).map(current).collect();
        let rows: Vec<usize> = (0..fine.len() / row_s).map(|row| row * row_s).collect();
        let sums: Vec<f64> = std::iter::once(0.0)
            .chain(fine.iter().scan(0.0, |sum, i| {
                *sum += i / 3600.0;
                Some(*sum)
            }))
            .collect();
        let flowed: Vec<f64> = rows.iter().map(|s| sums[*s + 1] - sums[1]).collect();
        let ah = flowed
            .iter()
            .map(|ah| ((1.0 + drift) * ah / digit).round() * digit);
        let reference: Vec<f64> = rows
            .iter()
            .map(|s| shows(&fine[s.saturating_sub(row_s - 1)..=*s]))
            .collect();
        let t_s: Vec<f64> = rows.iter().map(|s| *s as f64).collect();
        let ah: Vec<f64> = ah.collect();
        let drive = Problem::pair(t_s, reference, ah.clone(), 0.0).drive;
        (drive, ah, flowed)
    }

    /// Whatever the rows show of the current: errors of straight lines make up for one another, and so must what is left of them.
    #[test]
    fn no_charge_is_made_by_steps_that_tell_more_than_others() {
        let mean: fn(&[f64]) -> f64 = |i| i.iter().sum::<f64>() / i.len() as f64;
        let last: fn(&[f64]) -> f64 = |i| i[i.len() - 1];
        for row_s in [1, 2, 5, 10] {
            for (name, shows) in [("mean", mean), ("last", last)] {
                for digit in [1e-8, 1e-5, 1e-3] {
                    for drift in [0.0, 0.001] {
                        let (mut drive, ah, flowed) = driven(row_s, shows, digit, drift);
                        let Some(told) = between_rows(&drive, &ah) else {
                            continue;
                        };
                        let largest_ah = 30.0 * row_s as f64 / 3600.0;
                        let off = |drive: &Drive| -> f64 {
                            let charge = drive.charge();
                            let off = charge.iter().zip(&flowed);
                            off.map(|(charge, flowed)| (charge / 3600.0 - flowed).abs())
                                .fold(0.0, f64::max)
                        };
                        let straight = off(&drive);
                        drive.mean_share = Some(told.mean_share);
                        let with = off(&drive);
                        println!(
                            "{name} of {row_s} s, {digit} Ah, {drift}: {straight:.5} -> {with:.5} Ah"
                        );
                        // What may be left: a step that waits for the next, and what the two channels differ by.
                        let all_ah = flowed.iter().fold(0.0f64, |most, ah| most.max(ah.abs()));
                        let most = largest_ah + 3.0 * digit + 2.0 * drift * all_ah;
                        assert!(with <= most, "{with} Ah, {most} Ah");
                    }
                }
            }
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
