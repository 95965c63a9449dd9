//! End of the output.

use super::scene::{Scale, Scene};
use super::{BENT, Card, Clues, Effect, Mark, Parameter, Search, Stage};

/// See [`CARD`].
#[derive(Debug)]
pub struct Clipping;

static CARD: Card = Card {
    id: "clipping",
    statement: "The output stops at a rail: larger readings do not exist.",
    equation: "y = min(max(i, low), high)",
    parameters: &[
        Parameter::new("high_a", "A", f64::INFINITY, Search::Smooth).open(),
        Parameter::new("low_a", "A", f64::NEG_INFINITY, Search::Smooth).open(),
    ],
    shows: "flat tops",
    looks_like: &["core-saturation"],
    separated_by: "currents beyond the rail: the reading stays flat",
    stage: Stage::Rail,
};

impl Effect for Clipping {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn bounds(&self, parameter: usize, scale: &Scale) -> (f64, f64) {
        if parameter == 0 {
            (-scale.full_scale, 4.0 * scale.full_scale)
        } else {
            (-4.0 * scale.full_scale, scale.full_scale)
        }
    }

    fn starts(&self, scale: &Scale, clues: &Clues<'_>) -> Vec<Vec<f64>> {
        // A rail shows as readings that pile up at the end: the extremes, a little within for noise.
        let mut sorted: Vec<f64> = clues.observed.to_vec();
        if sorted.len() < 20 {
            return Vec::new();
        }
        sorted.sort_unstable_by(f64::total_cmp);
        let at = |share: f64| sorted[((sorted.len() - 1) as f64 * share) as usize];
        let far = 4.0 * scale.full_scale;
        let mut starts = Vec::new();
        for share in [0.0, 0.002, 0.01, 0.03] {
            let (low, high) = (at(share), at(1.0 - share));
            starts.push(vec![high, -far]);
            starts.push(vec![far, low]);
            starts.push(vec![high, low]);
        }
        starts
    }

    fn mark(&self, _scale: &Scale, clues: &Clues<'_>) -> Option<Mark> {
        let side = |sign: f64| {
            rail(
                clues.observed.iter().map(|y| sign * y),
                clues.predicted.iter().map(|p| sign * p),
            )
        };
        let rails = [side(1.0), side(-1.0)];
        let known: Vec<&Rail> = rails.iter().flatten().collect();
        if known.is_empty() {
            return None;
        }
        let [high, low] = &rails;
        Some(Mark {
            values: vec![
                high.as_ref().map_or(f64::INFINITY, |rail| rail.at),
                low.as_ref().map_or(f64::NEG_INFINITY, |rail| -rail.at),
            ],
            within: [high, low]
                .map(|rail| rail.as_ref().map_or(0.0, |rail| rail.within))
                .to_vec(),
            variance: known.iter().map(|rail| rail.variance).sum(),
            what: "stay at an end",
        })
    }

    fn kinked(&self, _parameter: usize) -> bool {
        true
    }

    fn level(&self, _parameter: usize) -> bool {
        true
    }

    fn curve(&self) -> f64 {
        BENT
    }

    fn cuts(&self) -> bool {
        true
    }

    fn came_of(&self, values: &[f64], [low, high]: [f64; 2], off: f64) -> Option<[f64; 2]> {
        let (top, bottom) = (values[0], values[1]);
        if low > top + off || high < bottom - off {
            return None;
        }
        // What came out between two ends was at a rail if that is between them, and not if it is one of them.
        let near = if low < high { -off } else { off };
        let low = if low <= bottom + near {
            f64::NEG_INFINITY
        } else {
            low
        };
        let high = if high >= top - near {
            f64::INFINITY
        } else {
            high
        };
        Some([low, high])
    }

    fn at_odds(&self, values: &[f64]) -> Option<&'static str> {
        (values[0] < values[1]).then_some("high_a, not below low_a")
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let (high, low) = (values[0], values[1]);
        scene
            .signal
            .iter_mut()
            .for_each(|value| *value = value.min(high).max(low));
    }
}

/// Readings that stay at an end, at least.
const STAY: usize = 5;
/// Of the readings that should be larger than the middle one of them, this share is there as well.
const NEARLY_ALL: f64 = 0.9;
/// Levels next to the end that tell how finely readings are written there.
const NEXT: usize = 100;
/// What is cut off of the middle one of them, in spreads of the mismatch.
const CUT_OFF: f64 = 3.0;

/// An upper end at which readings stay while the simulation goes on.
struct Rail {
    at: f64,
    /// Half of the least by which two readings near it differ.
    within: f64,
    /// Mean square of what it takes from the simulation.
    variance: f64,
}

/// The upper rail that readings show by themselves: they stay at their highest value, nearly all of those that should be larger are
/// there, and what is cut off is much beside what is not. One that hangs at its highest value is no rail: it stays there below as well.
fn rail(observed: impl Iterator<Item = f64>, predicted: impl Iterator<Item = f64>) -> Option<Rail> {
    let rows: Vec<(f64, f64)> = observed
        .zip(predicted)
        .filter(|(y, p)| y.is_finite() && p.is_finite())
        .collect();
    let at = rows.iter().map(|(y, _)| *y).reduce(f64::max)?;
    let there = || rows.iter().filter(|(y, _)| *y == at);
    let count = there().count();
    if count < STAY {
        return None;
    }
    let middle = |mut values: Vec<f64>| -> Option<f64> {
        let at = values.len() / 2;
        (!values.is_empty()).then(|| *values.select_nth_unstable_by(at, f64::total_cmp).1)
    };
    let spread = 1.4826 * middle(rows.iter().map(|(y, p)| (y - p).abs()).collect())?;
    let expected = middle(there().map(|(_, p)| *p).collect())?;
    let larger = rows.iter().filter(|(_, p)| *p > expected);
    let (larger, stay) = larger.fold((0.0, 0.0), |(all, stay), (y, _)| {
        (all + 1.0, stay + f64::from(u8::from(*y == at)))
    });
    let hang = there().filter(|(_, p)| *p < at - CUT_OFF * spread).count();
    if larger == 0.0
        || stay < NEARLY_ALL * larger
        || expected - at <= CUT_OFF * spread
        || hang as f64 > (1.0 - NEARLY_ALL) * count as f64
    {
        return None;
    }
    let taken: f64 = rows.iter().map(|(_, p)| (p - at).max(0.0).powi(2)).sum();
    // Large readings may be written more coarsely than small ones.
    let mut values: Vec<f64> = rows.iter().map(|(y, _)| *y).collect();
    values.sort_unstable_by(|a, b| b.total_cmp(a));
    values.dedup();
    values.truncate(NEXT);
    let steps = values.windows(2).map(|pair| pair[0] - pair[1]);
    let least = steps.reduce(f64::min)?;
    Some(Rail {
        at,
        within: 0.5 * least,
        variance: taken / rows.len() as f64,
    })
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    /// A wave of ±100 in 400 rows, with an error that is not much.
    fn rows() -> impl Iterator<Item = (f64, f64)> {
        (0..400).map(|row| {
            let p = 100.0 * (0.05 * f64::from(row)).sin();
            (p + 0.3 * (7.1 * f64::from(row)).sin(), p)
        })
    }

    fn seen(read: impl Fn(f64) -> f64) -> Option<Rail> {
        let (y, p): (Vec<f64>, Vec<f64>) = rows().map(|(y, p)| (read(y), p)).unzip();
        rail(y.into_iter(), p.into_iter())
    }

    #[test]
    fn readings_that_stay_at_an_end_show_it() {
        let rail = seen(|y| y.min(90.0)).unwrap();
        assert_eq!(rail.at, 90.0);
        assert!(rail.variance > 1.0 && rail.variance < 100.0);
        let (y, p): (Vec<f64>, Vec<f64>) = rows().map(|(y, p)| (-y.max(-80.0), -p)).unzip();
        assert_eq!(super::rail(y.into_iter(), p.into_iter()).unwrap().at, 80.0);
    }

    #[test]
    fn a_rail_is_known_to_the_digits_that_are_written_there() {
        const RAIL: f64 = 190.123_456;
        // Seven digits: six behind the point below ten, four above a hundred.
        let written = |y: f64| {
            let size = 1e6 / 10_f64.powf(y.abs().log10().floor());
            (y * size).round() / size
        };
        let (y, p): (Vec<f64>, Vec<f64>) = rows()
            .map(|(y, p)| (written((2.2 * y).min(RAIL)), 2.2 * p))
            .unzip();
        let rail = rail(y.into_iter(), p.into_iter()).unwrap();
        assert!(rail.at != RAIL && (rail.at - RAIL).abs() <= rail.within);
        assert!(rail.within < 0.05, "{}", rail.within);
    }

    #[test]
    fn a_highest_reading_alone_is_no_rail() {
        assert!(seen(|y| y).is_none());
        // Steps repeat the highest one.
        assert!(seen(|y| (y / 2.0).round() * 2.0).is_none());
        // One that hangs there, whatever the current does.
        assert!(seen(|_| 90.0).is_none());
        let hanging = |y: f64| if y < 0.0 { 90.0 } else { y.min(90.0) };
        assert!(seen(hanging).is_none());
    }
}
