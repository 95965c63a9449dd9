//! The reference between its rows: a smooth course through them instead of straight lines.
//!
//! Straight lines blunt a smooth current: a filter behind them is found too short, by Δt²/6 of its variance, and a delay of half a
//! step looks like a window of one. A cubic (Hermite's) leaves a course of straight pieces where it is one and follows one that bends.
//! Its slopes at the rows are those of the parabola through each three (de Boor, A Practical Guide to Splines, ch. IV), which is
//! nearest where the course has no kinks, or Akima's (1970, J. ACM 17, 589), which do not carry a kink into the steps beside it: a load
//! that is switched and low-passed once has one at each switching. The rows themselves tell which.

use std::ops::Range;

use super::{Base, Drive, Moments, Problem, Series};

/// Rows that take one step's place at most.
const PARTS: usize = 4;
/// And at least: a drive that has too many rows even so stays as it was recorded.
const LEAST_PARTS: usize = 2;
/// Rows of a smooth course at most, for the time that they take: twice those of three hours at 10 Hz (108,000), and some.
const MOST_ROWS: usize = 240_000;
/// Rows of which a step between the middle two is told.
const AROUND: usize = 6;
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
        let bend = Bend::of(&self.drive);
        (bend.there > BENDS).then(|| (self.bent(bend.slopes), bend.taken > TELLS))
    }

    /// The same with a smooth reference, whatever its rows tell.
    pub fn with_smooth_reference(&self) -> Self {
        self.bent(Bend::of(&self.drive).slopes)
    }

    fn bent(&self, slopes: Slopes) -> Self {
        let mut smooth = self.clone();
        if let Base::Sensor(base) = &mut smooth.base {
            base.smooth_reference = true;
        }
        smooth.drive = finer(&self.drive, slopes);
        smooth.observed.moments = Moments::Own;
        smooth
    }
}

/// Where a cubic has its slopes at the rows from.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Slopes {
    /// The parabola through a row and its neighbours.
    Parabola,
    /// Akima's mean of the steps to both sides, the heavier the less the course bends on its side.
    Akima,
}

impl Slopes {
    /// At the middle of five rows, of which the steps have these lengths and rises per length.
    fn at(self, h: [f64; 4], rise: [f64; 4]) -> f64 {
        let parabola = || (h[2] * rise[1] + h[1] * rise[2]) / (h[1] + h[2]);
        match self {
            Self::Parabola => parabola(),
            Self::Akima => {
                let (before, after) = ((rise[1] - rise[0]).abs(), (rise[3] - rise[2]).abs());
                let both = before + after;
                if both > 0.0 {
                    (after * rise[1] + before * rise[2]) / both
                } else {
                    parabola()
                }
            }
        }
    }
}

/// How well a cubic tells rows from their neighbours, at twice the step.
struct Bend {
    slopes: Slopes,
    /// How much of the cubic's bend there is: 0 for straight lines, 1 for a smooth course.
    there: f64,
    /// Share of the squared error of straight lines that this takes.
    taken: f64,
}

impl Bend {
    /// With the slopes that tell the rows best.
    fn of(drive: &Drive) -> Self {
        let with = |slopes| {
            let (mut along, mut size, mut all) = (0.0, 0.0, 0.0);
            for rows in drive
                .segments
                .iter()
                .filter(|rows| rows.len() >= 2 * AROUND)
            {
                for row in rows.start + AROUND - 1..=rows.end - AROUND {
                    let at = std::array::from_fn(|k| row + 2 * k + 1 - AROUND);
                    let Some((straight, cubic)) = between(drive, at, drive.t_s[row], slopes) else {
                        continue;
                    };
                    along += (cubic - straight) * (drive.reference[row] - straight);
                    size += (cubic - straight).powi(2);
                    all += (drive.reference[row] - straight).powi(2);
                }
            }
            let known = size > 0.0 && all > 0.0;
            let bend = Self {
                slopes,
                there: if known { along / size } else { 0.0 },
                taken: if known {
                    along * along / (size * all)
                } else {
                    0.0
                },
            };
            (bend, size - 2.0 * along)
        };
        let [(parabola, error), (akima, other)] = [Slopes::Parabola, Slopes::Akima].map(with);
        if other < error { akima } else { parabola }
    }
}

/// Value between the middle two of some rows at a time: on the straight line, and on the cubic. `None` where the steps are too
/// uneven.
fn between(drive: &Drive, at: [usize; AROUND], t: f64, slopes: Slopes) -> Option<(f64, f64)> {
    let (t_s, y) = (
        at.map(|row| drive.t_s[row]),
        at.map(|row| drive.reference[row]),
    );
    let h: [f64; AROUND - 1] = std::array::from_fn(|k| t_s[k + 1] - t_s[k]);
    let (least, most) = h.iter().fold((f64::INFINITY, 0.0f64), |(least, most), h| {
        (least.min(*h), most.max(*h))
    });
    if least.is_nan() || least <= 0.0 || most > UNEVEN * least {
        return None;
    }
    let rise: [f64; AROUND - 1] = std::array::from_fn(|k| (y[k + 1] - y[k]) / h[k]);
    let slope = [0, 1].map(|from| {
        slopes.at(
            std::array::from_fn(|k| h[from + k]),
            std::array::from_fn(|k| rise[from + k]),
        )
    });
    let u = (t - t_s[2]) / h[2];
    let straight = y[2] + u * (y[3] - y[2]);
    let bent = u * (1.0 - u) * h[2] * ((1.0 - u) * (slope[0] - rise[2]) - u * (slope[1] - rise[2]));
    Some((straight, straight + bent))
}

/// Rows that take one step's place in a drive of so many.
fn parts(rows: usize) -> usize {
    (MOST_ROWS / rows.max(1)).clamp(LEAST_PARTS, PARTS)
}

/// The drive with some rows for each step. What surrounds the sensor goes in straight lines, a range flag stays until its next
/// row.
fn finer(drive: &Drive, slopes: Slopes) -> Drive {
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
            if part == 0 || row < own.start + 2 || row + 3 >= own.end {
                continue;
            }
            let at = std::array::from_fn(|k| row + k - 2);
            if let Some((_, cubic)) = between(drive, at, t_s[place], slopes) {
                reference[place] = cubic;
            }
        }
    }
    let held = |series: &Series| places.iter().map(|(row, _)| series[*row]).collect();
    let also = |series: &Option<Series>| series.as_ref().map(|series| straight(series));
    Drive {
        mean_share: None,
        holds: None,
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

    fn problem(t_s: Vec<f64>, reference: Vec<f64>) -> Problem {
        Problem::pair(t_s, reference.clone(), reference, 0.1)
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

    #[test]
    fn a_kink_does_not_bend_the_steps_beside_it() {
        // First-order low-passes of steps between the rows, as a switched load has them.
        let wave = |t: f64| -> f64 {
            let steps = [(1.03, 80.0), (3.97, -120.0), (8.25, 60.0), (12.5, -20.0)];
            let after = |(at, size): (f64, f64)| size * (1.0 - (-(t - at).max(0.0) / 0.8).exp());
            (0..20)
                .flat_map(|turn| steps.map(|(at, size)| (at + 15.03 * f64::from(turn), size)))
                .map(after)
                .sum()
        };
        let t_s: Vec<f64> = (0..3000).map(|row| 0.1 * f64::from(row)).collect();
        let reference = t_s.iter().map(|t| wave(*t)).collect();
        let own = problem(t_s, reference);
        assert_eq!(Bend::of(&own.drive).slopes, Slopes::Akima);
        let error = |slopes| {
            let smooth = own.bent(slopes).drive;
            let squares = (0..smooth.len())
                .map(|row| (smooth.reference[row] - wave(smooth.t_s[row])).powi(2));
            (squares.sum::<f64>() / smooth.len() as f64).sqrt()
        };
        let [parabola, akima] = [Slopes::Parabola, Slopes::Akima].map(error);
        assert!(akima < 0.8 * parabola, "{akima} {parabola}");
    }
}
