//! A current that stays at one value between its rows, instead of going in a straight line.
//!
//! A cycler logs a step's last row when the step ends and the next step's first row one interval later. A straight line between the two
//! counts half of that interval wrong. Where all intervals are alike the errors make up for one another at each return of the current;
//! where a rest is logged more rarely than a load they add up, to what a load beside the recorded one or another capacity would do.

use serde::{Deserialize, Serialize};

use super::{Base, Drive, Problem, median_step_s};
use crate::range::range;

/// The charge in question adds up if it comes to so many times what one interval between the lowest and the highest current could
/// hold: even rows never come beyond once.
const ADDS_UP: f64 = 3.0;

/// Which of two rows a current belongs to.
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

    /// The same with a reference that stays at one value between its rows; as it is where a counter or the model file tells.
    pub fn with_holding(&self, holds: Holds) -> Self {
        let mut held = self.clone();
        if held.drive.mean_share.is_none() {
            held.drive.hold(holds);
        }
        held
    }
}
