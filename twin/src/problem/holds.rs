//! A reference that stays at one value between its rows, instead of going in a straight line.
//!
//! A straight line puts each edge of a load that goes in steps into the middle between two rows; a sensor that follows it late shows where
//! it was.
//!
//! A cycler logs a step's last row when the step ends and the next step's first row one interval later. A straight line between the two
//! counts half of that interval wrong. Where all intervals are alike the errors make up for one another at each return of the current;
//! where a rest is logged more rarely than a load they add up, to what a load beside the recorded one or another capacity would do.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::{Base, Drive, Moments, Problem, Series, median_step_s};
use crate::range::range;

/// The charge in question adds up if it comes to so many times what one interval between the lowest and the highest current could
/// hold: even rows never come beyond once.
const ADDS_UP: f64 = 3.0;
/// A sensor's reference goes in steps if half of its rows differ from the one before by no more than this share of what all do, rms.
const STAYS: f64 = 0.1;
/// Where a step begins after the row before it, as a share of the time to the next one: a reading at that row is of before.
const JUST_AFTER: f64 = 1e-6;

/// Which of two rows the value between them belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Holds {
    /// Each row's current has flowed since the row before, as a cycler logs its steps.
    SinceLastRow,
    /// Each row's current flows until the next row, as a source logs what it is set to.
    UntilNextRow,
}

impl Holds {
    /// Both.
    pub const ALL: [Self; 2] = [Self::SinceLastRow, Self::UntilNextRow];

    /// As the model file has it.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::SinceLastRow => "since-last-row",
            Self::UntilNextRow => "until-next-row",
        }
    }

    /// What each row's current does.
    pub fn in_words(self) -> &'static str {
        match self {
            Self::SinceLastRow => "has flowed since the row before",
            Self::UntilNextRow => "flows until the next row",
        }
    }

    /// [`Drive::mean_share`] of every step.
    fn mean_share(self) -> f64 {
        match self {
            Self::SinceLastRow => 1.0,
            Self::UntilNextRow => 0.0,
        }
    }
}

impl Drive {
    /// Lets the reference stay at one value between its rows.
    pub fn hold(&mut self, holds: Holds) {
        self.mean_share = Some(vec![holds.mean_share(); self.len()].into());
        self.holds = Some(holds);
    }

    /// Whether most of what the reference changes by is in few of its rows.
    fn goes_in_steps(&self) -> bool {
        let rows = self.segments.iter().flat_map(|rows| rows.clone().skip(1));
        let mut by: Vec<f64> = rows
            .map(|row| (self.reference[row] - self.reference[row - 1]).abs())
            .collect();
        if by.is_empty() {
            return false;
        }
        let rms = (by.iter().map(|by| by * by).sum::<f64>() / by.len() as f64).sqrt();
        let middle = by.len() / 2;
        let median = *by.select_nth_unstable_by(middle, f64::total_cmp).1;
        rms > 0.0 && median <= STAYS * rms
    }

    /// What the charge could be off by where it is not known how the reference goes from row to row, beyond what even rows would leave: from
    /// the lowest to the highest in the course of the recording, and what one interval could hold; both in the reference's unit times s.
    fn uneven(&self) -> (f64, f64) {
        let even_s = median_step_s(self.t_s.iter().copied());
        let steps = self
            .segments
            .iter()
            .flat_map(|rows| rows.clone().skip(1))
            .map(|row| {
                let length_s = self.t_s[row] - self.t_s[row - 1];
                0.5 * (self.reference[row] - self.reference[row - 1]) * (length_s - even_s)
            });
        let course = steps.scan(0.0, |sum, step| {
            *sum += step;
            Some(*sum)
        });
        let width = |limits: Option<[f64; 2]>| limits.map_or(0.0, |[low, high]| high - low);
        let single = 0.5 * even_s * width(range(self.reference.iter().copied()));
        (width(range(course)), single)
    }
}

impl Problem {
    /// Whether it matters for a battery how its current goes from row to row, and nothing tells: neither a counter nor the model file.
    pub fn may_hold(&self) -> bool {
        if !matches!(self.base, Base::Battery(_)) || self.drive.mean_share.is_some() {
            return false;
        }
        let (off, single) = self.drive.uneven();
        off > ADDS_UP * single
    }

    /// Whether a sensor's reference goes in steps, and the model file does not say when.
    pub fn may_be_held(&self) -> bool {
        let Base::Sensor(base) = &self.base else {
            return false;
        };
        let as_it_is = base.held_reference || base.quasi_static || base.smooth_reference;
        !as_it_is && base.reading.is_empty() && self.drive.goes_in_steps()
    }

    /// The same with a sensor's reference that stays at one value between its rows.
    pub fn with_held_reference(&self, holds: Holds) -> Self {
        let mut held = self.clone();
        if let Base::Sensor(base) = &mut held.base {
            base.held_reference = true;
        }
        if holds == Holds::SinceLastRow {
            held.drive = since_last_row(&self.drive);
            held.observed.moments = Moments::Own;
        }
        held.drive.holds = Some(holds);
        held
    }

    /// The same with a reference that stays at one value between its rows; as it is where a counter or the model file tells.
    pub fn with_holding(&self, holds: Holds) -> Self {
        let mut held = self.clone();
        if held.drive.mean_share.is_none() {
            held.drive.hold(holds);
        }
        held
    }
}

/// The drive whose reference has each row's value from the row before on, until its next row: what surrounds it stays where it was.
fn since_last_row(drive: &Drive) -> Drive {
    // Each with the row that it comes just after, and that of its reference.
    let mut places: Vec<(usize, usize)> = Vec::with_capacity(drive.len() + drive.segments.len());
    let mut segments: Vec<Range<usize>> = Vec::with_capacity(drive.segments.len());
    for rows in &drive.segments {
        let first = places.len();
        if let Some(last) = rows.clone().last() {
            places.extend(rows.clone().take(1).map(|row| (row, row)));
            places.extend(rows.clone().zip(rows.clone().skip(1)));
            if rows.len() > 1 {
                places.push((last, last));
            }
        }
        segments.push(first..places.len());
    }
    let at_s = |(row, of): &(usize, usize)| {
        let (from, to) = (drive.t_s[*row], drive.t_s[*of]);
        from + JUST_AFTER * (to - from)
    };
    let of_row =
        |series: &Series| -> Series { places.iter().map(|(row, _)| series[*row]).collect() };
    let also = |series: &Option<Series>| series.as_ref().map(of_row);
    Drive {
        mean_share: None,
        holds: None,
        t_s: places.iter().map(at_s).collect(),
        reference: places.iter().map(|(_, of)| drive.reference[*of]).collect(),
        sensor_temperature_c: also(&drive.sensor_temperature_c),
        supply_v: also(&drive.supply_v),
        aux_a: also(&drive.aux_a),
        range_high: (drive.range_high.as_ref())
            .map(|high| places.iter().map(|(row, _)| high[*row]).collect()),
        cell_temperature_c: also(&drive.cell_temperature_c),
        ambient_c: also(&drive.ambient_c),
        segments,
        continues: drive.continues.clone(),
        parts: drive.parts,
    }
}
