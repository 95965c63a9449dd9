//! What the board, or any sensor, would have reported as designed.

pub mod board;
pub mod command;

use crate::explain;
use crate::problem::{Base, Drive, Problem, SensorBase, View};

/// What the simulation as designed says at each observed row, without any effect; NaN where the drive does not reach.
pub fn designed(problem: &Problem) -> Vec<f64> {
    match &problem.base {
        Base::Sensor(base) if base.reading.len() == problem.observed.t_s.len() => {
            base.reading.clone()
        }
        Base::Sensor(base) => {
            let mut said = unrounded(problem, base);
            if problem.view != View::Charge {
                for value in &mut said {
                    *value = base.stepped(*value);
                }
            }
            said
        }
        Base::Battery(_) => explain::predict(problem, &[]),
    }
}

/// The reference through the window, ahead of the step; between two readings of a charge counter, its mean.
fn unrounded(problem: &Problem, base: &SensorBase) -> Vec<f64> {
    let (drive, observed, view) = (&problem.drive, &problem.observed, problem.view);
    let area = Area::new(drive, &drive.reference, base.held_reference);
    let mut last: Option<(usize, f64)> = None;
    (0..observed.t_s.len())
        .map(|row| {
            let (segment, now_s) = (observed.segment_of(row), observed.t_s[row]);
            match view {
                View::Charge => {
                    let before =
                        last.filter(|(before, before_s)| *before == segment && now_s > *before_s);
                    last = Some((segment, now_s));
                    before.map_or(f64::NAN, |(_, before_s)| {
                        area.mean(segment, before_s, now_s)
                    })
                }
                _ if base.window_s > 0.0 => area.mean(segment, now_s - base.window_s, now_s),
                _ if observed.on_drive_rows() => drive.reference[row],
                _ => area.value(segment, now_s),
            }
        })
        .collect()
}

/// A series on drive rows with its integral over time.
struct Area<'a> {
    drive: &'a Drive,
    values: &'a [f64],
    /// Integral from the start of each segment.
    integral: Vec<f64>,
    held: bool,
}

impl<'a> Area<'a> {
    fn new(drive: &'a Drive, values: &'a [f64], held: bool) -> Self {
        let mut integral = vec![0.0; values.len()];
        for rows in &drive.segments {
            for row in rows.clone().skip(1) {
                let h = drive.t_s[row] - drive.t_s[row - 1];
                let mean = if held {
                    values[row - 1]
                } else {
                    0.5 * (values[row - 1] + values[row])
                };
                integral[row] = integral[row - 1] + mean * h;
            }
        }
        Self {
            drive,
            values,
            integral,
            held,
        }
    }

    /// The last row not after a time, the first one if there is none.
    fn row(&self, segment: usize, at_s: f64) -> Option<(usize, usize)> {
        let rows = self
            .drive
            .segments
            .get(segment)
            .filter(|rows| !rows.is_empty())?;
        let after = self.drive.t_s[rows.clone()].partition_point(|t| *t <= at_s);
        Some((rows.start + after.saturating_sub(1), rows.end))
    }

    fn value(&self, segment: usize, at_s: f64) -> f64 {
        let Some((row, end)) = self.row(segment, at_s) else {
            return f64::NAN;
        };
        let from = self.values[row];
        let h = at_s - self.drive.t_s[row];
        if row + 1 >= end || h <= 0.0 || self.held {
            return from;
        }
        from + (self.values[row + 1] - from) * h / (self.drive.t_s[row + 1] - self.drive.t_s[row])
    }

    /// Integral up to a time; beyond its ends the series stands still.
    fn until(&self, segment: usize, at_s: f64) -> f64 {
        let Some((row, _)) = self.row(segment, at_s) else {
            return f64::NAN;
        };
        let h = at_s - self.drive.t_s[row];
        let mean = if h > 0.0 {
            0.5 * (self.values[row] + self.value(segment, at_s))
        } else {
            self.values[row]
        };
        self.integral[row] + mean * h
    }

    fn mean(&self, segment: usize, from_s: f64, to_s: f64) -> f64 {
        (self.until(segment, to_s) - self.until(segment, from_s)) / (to_s - from_s)
    }
}
