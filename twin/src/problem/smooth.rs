//! The reference between its rows: a smooth course through them instead of straight lines.
//!
//! Straight lines blunt a smooth current: a filter behind them is found too short, by Δt²/6 of its variance, and a delay of half a
//! step looks like a window of one. A cubic through four rows (Hermite, slopes of the parabola through each three; de Boor, A
//! Practical Guide to Splines, ch. IV) leaves a course of straight pieces where it is one and follows one that bends.

use std::ops::Range;

use super::{Base, Drive, Problem, Series};

/// Rows that take one step's place at most.
const PARTS: usize = 4;
/// And at least: a drive that has too many rows even so stays as it was recorded.
const LEAST_PARTS: usize = 2;
/// Rows of a smooth course at most, for the time that they take: twice those of three hours at 10 Hz (108,000), and some.
const MOST_ROWS: usize = 240_000;
/// Each second row is told by its neighbours: the course bends if a cubic's bend is there by more than this share.
const BENDS: f64 = 0.5;
/// The rows alone tell that it bends if that takes this share of the squared error of straight lines.
const TELLS: f64 = 0.9;
/// Steps that differ by more than this factor are no course.
const UNEVEN: f64 = 3.0;

impl Problem {
    /// The same with a smooth reference, and whether its rows alone tell that it is; `None` where it is held or straight as far as they
    /// tell, where a board's readings are simulated from the rows as they are, or where it is smooth already.
    pub fn smoothed(&self) -> Option<(Self, bool)> {
        let Base::Sensor(base) = &self.base else {
            return None;
        };
        let as_it_is = base.held_reference || base.quasi_static || base.smooth_reference;
        let too_many = self.drive.len() * LEAST_PARTS > MOST_ROWS;
        if as_it_is || !base.reading.is_empty() || too_many {
            return None;
        }
        let (bend, share) = bend(&self.drive);
        (bend > BENDS).then(|| (self.with_smooth_reference(), share > TELLS))
    }

    /// The same with a smooth reference, whatever its rows tell.
    pub fn with_smooth_reference(&self) -> Self {
        let mut smooth = self.clone();
        if let Base::Sensor(base) = &mut smooth.base {
            base.smooth_reference = true;
        }
        smooth.drive = finer(&self.drive);
        smooth.observed.on_drive_rows = false;
        smooth
    }
}

/// How much of a cubic's bend there is at rows that are told by their neighbours, at twice the step (0 for straight lines, 1 for a
/// smooth course), and the share of the squared error of straight lines that this takes.
fn bend(drive: &Drive) -> (f64, f64) {
    let (mut along, mut size, mut all) = (0.0, 0.0, 0.0);
    for rows in drive.segments.iter().filter(|rows| rows.len() >= 7) {
        for row in rows.start + 3..rows.end - 3 {
            let at = [row - 3, row - 1, row + 1, row + 3];
            let t_s = at.map(|row| drive.t_s[row]);
            let y = at.map(|row| drive.reference[row]);
            let Some((straight, cubic)) = between(t_s, y, drive.t_s[row]) else {
                continue;
            };
            along += (cubic - straight) * (drive.reference[row] - straight);
            size += (cubic - straight).powi(2);
            all += (drive.reference[row] - straight).powi(2);
        }
    }
    if size > 0.0 && all > 0.0 {
        (along / size, along * along / (size * all))
    } else {
        (0.0, 0.0)
    }
}

/// Value between the second and the third of four points: on the straight line, and on the cubic. `None` where the steps are too
/// uneven.
fn between(t_s: [f64; 4], y: [f64; 4], t: f64) -> Option<(f64, f64)> {
    let h = [t_s[1] - t_s[0], t_s[2] - t_s[1], t_s[3] - t_s[2]];
    let (least, most) = h.iter().fold((f64::INFINITY, 0.0f64), |(least, most), h| {
        (least.min(*h), most.max(*h))
    });
    if least.is_nan() || least <= 0.0 || most > UNEVEN * least {
        return None;
    }
    let rise = [0, 1, 2].map(|k| (y[k + 1] - y[k]) / h[k]);
    // Slopes at the two inner points.
    let slope = [0, 1].map(|k| (h[k + 1] * rise[k] + h[k] * rise[k + 1]) / (h[k] + h[k + 1]));
    let u = (t - t_s[1]) / h[1];
    let straight = y[1] + u * (y[2] - y[1]);
    let bent = u * (1.0 - u) * h[1] * ((1.0 - u) * (slope[0] - rise[1]) - u * (slope[1] - rise[1]));
    Some((straight, straight + bent))
}

/// Rows that take one step's place in a drive of so many.
fn parts(rows: usize) -> usize {
    (MOST_ROWS / rows.max(1)).clamp(LEAST_PARTS, PARTS)
}

/// The drive with some rows for each step. What surrounds the sensor goes in straight lines, a range flag stays until its next
/// row.
fn finer(drive: &Drive) -> Drive {
    let mut segments: Vec<Range<usize>> = Vec::with_capacity(drive.segments.len());
    let in_a_step = parts(drive.len());
    let mut places: Vec<(usize, usize)> = Vec::with_capacity(in_a_step * drive.len());
    for rows in &drive.segments {
        let first = places.len();
        for row in rows.clone() {
            let parts = if row + 1 < rows.end { in_a_step } else { 1 };
            places.extend((0..parts).map(|part| (row, part)));
        }
        segments.push(first..places.len());
    }
    let straight = |series: &[f64]| -> Series {
        let at = |(row, part): &(usize, usize)| match part {
            0 => series[*row],
            part => {
                let (from, to) = (series[*row], series[row + 1]);
                from + (to - from) * *part as f64 / in_a_step as f64
            }
        };
        places.iter().map(at).collect()
    };
    let t_s = straight(&drive.t_s);
    let mut reference = straight(&drive.reference);
    for (rows, own) in segments.iter().zip(&drive.segments) {
        for place in rows.clone() {
            let (row, part) = places[place];
            if part == 0 || row == own.start || row + 2 >= own.end {
                continue;
            }
            let at = [row - 1, row, row + 1, row + 2];
            let four = between(
                at.map(|row| drive.t_s[row]),
                at.map(|row| drive.reference[row]),
                t_s[place],
            );
            if let Some((_, cubic)) = four {
                reference[place] = cubic;
            }
        }
    }
    let held = |series: &Series| places.iter().map(|(row, _)| series[*row]).collect();
    let also = |series: &Option<Series>| series.as_ref().map(|series| straight(series));
    Drive {
        t_s,
        reference,
        sensor_temperature_c: also(&drive.sensor_temperature_c),
        supply_v: also(&drive.supply_v),
        aux_a: also(&drive.aux_a),
        range_high: drive.range_high.as_ref().map(held),
        cell_temperature_c: also(&drive.cell_temperature_c),
        ambient_c: also(&drive.ambient_c),
        segments,
        continues: drive.continues.clone(),
        parts: in_a_step,
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::single_range_in_vec_init)]
mod tests {
    use super::*;
    use crate::problem::{Accuracy, Coloured, Observed, SensorBase, View};

    fn problem(t_s: Vec<f64>, reference: Vec<f64>) -> Problem {
        let drive = Drive {
            segments: std::iter::once(0..t_s.len()).collect(),
            continues: vec![false],
            reference: reference.clone().into(),
            t_s: t_s.clone().into(),
            ..Drive::default()
        };
        Problem {
            view: View::Sensor,
            name: "i_meas_a".into(),
            unit: "A".into(),
            observed: Observed::with_drive(t_s, reference),
            drive,
            base: Base::Sensor(SensorBase::default()),
            modelled: Vec::new(),
            noise: 0.1,
            coloured: Coloured::default(),
            accuracy: Accuracy::default(),
        }
    }

    #[test]
    fn a_long_drive_is_followed_in_fewer_parts() {
        for (rows, in_a_step) in [(10, 4), (60_000, 4), (80_000, 3), (108_000, 2)] {
            assert_eq!(parts(rows), in_a_step, "{rows}");
            assert!(rows * in_a_step <= MOST_ROWS);
        }
        let wave =
            |rows: u32| -> Vec<f64> { (0..rows).map(|k| (f64::from(k) / 9.0).sin()).collect() };
        let t_s = |rows: u32| (0..rows).map(f64::from).collect();
        assert_eq!(
            problem(t_s(108_000), wave(108_000))
                .smoothed()
                .unwrap()
                .0
                .drive
                .parts,
            2
        );
        assert!(problem(t_s(121_000), wave(121_000)).smoothed().is_none());
    }

    #[test]
    fn a_wave_is_followed_between_its_rows_and_steps_are_left_alone() {
        let wave = |t: f64| 50.0 * (t / 3.0).sin() + 40.0 * (1.3 * t).sin();
        // Rows as a bus gives them.
        let t_s: Vec<f64> = (0..2000)
            .map(|row| 0.1 * f64::from(row) + 0.004 * f64::from(row * 7 % 11) / 11.0)
            .collect();
        let (smooth, told) = problem(t_s.clone(), t_s.iter().map(|t| wave(*t)).collect())
            .smoothed()
            .unwrap();
        assert!(told);
        assert_eq!(smooth.drive.parts, PARTS);
        assert_eq!(smooth.drive.len(), PARTS * (t_s.len() - 1) + 1);
        let inner = 2 * PARTS..smooth.drive.len() - 2 * PARTS;
        let worst = inner
            .map(|row| (smooth.drive.reference[row] - wave(smooth.drive.t_s[row])).abs())
            .fold(0.0, f64::max);
        // A straight line is off by up to Δt²/8 of the second derivative, 0.09.
        assert!(worst < 2e-3, "{worst}");
        assert!((smooth.drive.median_step_s() - 0.1).abs() < 5e-3);
        // Recorded rows are what they were.
        assert!((0..t_s.len()).all(|row| smooth.drive.t_s[PARTS * row] == t_s[row]));

        let steps = t_s.iter().map(|t| ((t / 3.7).floor() * 17.0) % 40.0);
        assert!(problem(t_s.clone(), steps.collect()).smoothed().is_none());
    }
}
