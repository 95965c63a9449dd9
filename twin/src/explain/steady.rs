//! The reference as it is while the current stands still: without noise of its own, which no sensor follows.
//!
//! A curve of the current, or any function of it, that is looked for over the readings of a reference takes their noise for current
//! (regression dilution; Fuller 1987, *Measurement Error Models*, section 1.1). While the current moves by far more than that noise,
//! this is next to nothing. Where it stands still, as for much of a drive, noise is all that the readings differ by: a sensor that is
//! right then falls short by all of it, as if it had a dead band. So the readings of a standstill count with their mean there.

use std::ops::Range;

use super::workbench::drive_row;
use crate::effects::chain::{Chain, Nuisance};
use crate::effects::scene::Scale;
use crate::problem::{Base, Problem, Series};
use crate::standstill::{Evened, evened};

/// It is noise if no more than this share of it is in the reading.
const FOLLOWED: f64 = 0.5;
/// Several rows go to a reading from so many on.
const SEVERAL: f64 = 1.5;

/// A reference whose standstills show noise.
pub(super) struct Steady {
    /// With the mean in place of each of its readings at a standstill.
    pub reference: Series,
    /// Which of the rows that count are in each standstill.
    pub rows: Vec<Range<usize>>,
    /// The simulation of that as designed, at the rows that count.
    pub plain: Vec<f64>,
    /// The noise, rms, in the view's unit; 0 where several recorded rows go to a reading: what that does not follow may as well be a
    /// ripple of the current.
    pub noise: f64,
    /// Energy of what the means are still off by, a reading's noise for each, in the view's unit squared.
    pub left: f64,
}

impl Steady {
    /// Of a problem: `rows` count, with their readings and the simulation as designed. `None` if standstills show no noise, or one that
    /// the readings have as well: that is a current.
    pub fn of(
        problem: &Problem,
        scale: &Scale,
        rows: &[usize],
        [y, plain]: [&[f64]; 2],
    ) -> Option<Self> {
        // What a board reports of the true current goes beside the chain: the reference's noise is in none of it.
        if matches!(&problem.base, Base::Sensor(base) if !base.reading.is_empty()) {
            return None;
        }
        let Evened {
            reference,
            standstills,
            variance,
        } = evened(&problem.drive)?;
        let still = problem.driven_by(reference.clone());
        let all = Chain::new(&still).run(&[], &Nuisance::default());
        let still: Vec<f64> = rows.iter().map(|&row| all[row]).collect();
        // Of the reference's noise the mismatch has all, with the other sign.
        let (mut missing, mut there) = (0.0, 0.0);
        for ((y, plain), still) in y.iter().zip(plain).zip(&still) {
            let noise = plain - still;
            if noise.is_finite() {
                missing -= (y - plain) * noise;
                there += noise * noise;
            }
        }
        if there <= 0.0 {
            return None;
        }
        let share = (missing / there).min(1.0);
        (share > 1.0 - FOLLOWED).then(|| Self {
            reference,
            rows: at_rows(problem, rows, &standstills),
            plain: still,
            left: share * variance * standstills.len() as f64,
            noise: if scale.reading_step_s < SEVERAL * scale.step_s {
                (share * variance).sqrt()
            } else {
                0.0
            },
        })
    }
}

/// Which rows that count lie in each of some ranges of the drive's rows.
fn at_rows(problem: &Problem, rows: &[usize], standstills: &[Range<usize>]) -> Vec<Range<usize>> {
    let of_drive: Vec<usize> = rows
        .iter()
        .map(|&row| drive_row(problem, row).unwrap_or(0))
        .collect();
    let before = |place: usize| of_drive.partition_point(|row| *row < place);
    standstills
        .iter()
        .map(|still| before(still.start)..before(still.end))
        .collect()
}
