//! A reference that was written more often than it was read: a staircase of which the current knows nothing.

use super::{seconds, series::median};
use crate::problem::{Drive, Observed};

/// Fewest steps that show a rule.
const FEWEST_STEPS: usize = 20;
/// Fewest rows between two steps: with fewer there is none in the middle.
const FEWEST_HELD: usize = 3;
/// Share of the steps that come after the same number of rows, …
const REGULAR: f64 = 0.8;
/// … which may differ by one where the rows' times wander, or by this share.
const WANDERS: f64 = 0.1;
/// Share of the rows between steps at which the sensor moves.
const MOVES: f64 = 0.8;
/// Share of the steps that are of one size in a slow current that is read in whole counts.
const OF_ONE_SIZE: f64 = 0.5;
/// Differences of numbers of some seven digits are the same size if they are within this share.
const DIGITS: f64 = 1e-6;
/// Share of a step that the sensor goes ahead of it, at least, …
const AHEAD: f64 = 0.3;
/// … with this many standard deviations, …
const SURELY: f64 = 5.0;
/// … and of that in the middle, about half: a sensor that only is ahead of the reference goes at once, and a slow one bends.
const HALF_WAY: (f64, f64) = (0.3, 0.65);
/// Two steps in succession are told apart where they share less than this of their squares.
const ALIKE: f64 = 0.9999;

/// Says so where the reference stands for the same number of rows between its steps while the sensor already goes where the
/// next step leads. A current that is set in steps does not: no sensor knows what comes.
pub(super) fn remark(
    drive: &Drive,
    observed: &Observed,
    [reference, measured]: [&str; 2],
) -> Option<String> {
    if !observed.on_drive_rows() {
        return None;
    }
    let held = held(drive);
    let rows = rule(&held)?;
    if one_size(&held) || !moves(observed, &held) {
        return None;
    }
    let read = |row: usize| observed.valid[row].then(|| observed.value[row]);
    let ahead = |at: &dyn Fn(&Held) -> usize| {
        foreseen(held.iter().filter_map(|held| {
            let went = read(at(held))? - read(held.start)?;
            Some([held.before, held.after, went])
        }))
    };
    let (last, error) = ahead(&|held| held.end - 1)?;
    let (middle, _) = ahead(&|held| held.start + (held.end - held.start) / 2)?;
    let in_the_middle = (HALF_WAY.0..HALF_WAY.1).contains(&(middle / last));
    if last < AHEAD || last < SURELY * error || !in_the_middle {
        return None;
    }
    let mut times_s: Vec<f64> = held
        .iter()
        .map(|held| drive.t_s[held.end] - drive.t_s[held.start])
        .collect();
    let held_s = median(&mut times_s)?;
    Some(format!(
        "{reference} stays as it is for {rows} rows ({}) and then steps, while {measured} already goes where the next step leads: it \
         was read more seldom than it was written (or its times are late), and what the current did between two steps is taken \
         for the sensor's; give only the rows in which it is new, or the reference as a file of its own with --reference",
        seconds(held_s)
    ))
}

/// Rows over which the reference stands, and its steps before and after.
struct Held {
    start: usize,
    end: usize,
    before: f64,
    after: f64,
}

/// All of them that begin and end with a step.
fn held(drive: &Drive) -> Vec<Held> {
    let reference = &drive.reference;
    let mut found = Vec::new();
    for rows in &drive.segments {
        let mut start = rows.start;
        for end in rows.start + 1..rows.end {
            if reference[end] == reference[start] {
                continue;
            }
            if start > rows.start {
                found.push(Held {
                    start,
                    end,
                    before: reference[start] - reference[start - 1],
                    after: reference[end] - reference[start],
                });
            }
            start = end;
        }
    }
    found
}

/// The number of rows after which it steps as a rule.
fn rule(held: &[Held]) -> Option<usize> {
    let length = |held: &Held| held.end - held.start;
    let mut lengths: Vec<f64> = held.iter().map(|held| length(held) as f64).collect();
    if lengths.len() < FEWEST_STEPS {
        return None;
    }
    let middle = median(&mut lengths)?;
    let off = if middle > FEWEST_HELD as f64 {
        (WANDERS * middle).max(1.0)
    } else {
        0.0
    };
    let regular = lengths.iter().filter(|rows| (*rows - middle).abs() <= off);
    let is_rule =
        middle >= FEWEST_HELD as f64 && regular.count() as f64 >= REGULAR * lengths.len() as f64;
    is_rule.then_some(middle as usize)
}

/// Whether most steps are of one size.
fn one_size(held: &[Held]) -> bool {
    let sizes = held.iter().map(|held| held.after.abs());
    let Some(middle) = median(&mut sizes.clone().collect::<Vec<_>>()) else {
        return true;
    };
    let alike = sizes.filter(|size| (size - middle).abs() <= DIGITS * middle);
    alike.count() as f64 > OF_ONE_SIZE * held.len() as f64
}

/// Whether the sensor moves while the reference stands.
fn moves(observed: &Observed, held: &[Held]) -> bool {
    let pairs = held.iter().flat_map(|held| held.start + 1..held.end);
    let known = pairs.filter(|row| observed.valid[*row] && observed.valid[row - 1]);
    let (moved, all) = known.fold((0, 0), |(moved, all), row| {
        let moves = observed.value[row] != observed.value[row - 1];
        (moved + usize::from(moves), all + 1)
    });
    moved as f64 >= MOVES * f64::from(all) && all > 0
}

/// By how much of the step that comes the sensor has gone, and the standard deviation of that: least squares over the step
/// before, which it may still follow, and the one after.
fn foreseen(went: impl Iterator<Item = [f64; 3]>) -> Option<(f64, f64)> {
    let went: Vec<[f64; 3]> = went.collect();
    if went.len() < FEWEST_STEPS {
        return None;
    }
    let count = went.len() as f64;
    let mean = |of: usize| went.iter().map(|row| row[of]).sum::<f64>() / count;
    let means = [mean(0), mean(1), mean(2)];
    let sum = |one: usize, other: usize| -> f64 {
        went.iter()
            .map(|row| (row[one] - means[one]) * (row[other] - means[other]))
            .sum()
    };
    let (before, after, cross) = (sum(0, 0), sum(1, 1), sum(0, 1));
    let own = before * after - cross * cross;
    if own <= (1.0 - ALIKE) * before * after {
        return None;
    }
    let (of_before, of_after) = (sum(0, 2), sum(1, 2));
    let next = (of_after * before - of_before * cross) / own;
    let last = (of_before * after - of_after * cross) / own;
    let left = (sum(2, 2) - next * of_after - last * of_before).max(0.0);
    Some((next, (left / (count - 3.0) * before / own).sqrt()))
}
