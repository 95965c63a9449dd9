//! Stretches in which a log is of something else: what the rest says is named, and the stretch is told with its place. What physics
//! makes in one place only is no such stretch.

use crate::common::{noise, said, sensor};
use twin::problem::Problem;
use twin::report::data::{LocationKind, Report, Verdict};

const ROWS: usize = 6000;
const STEP_S: f64 = 0.1;
const NOISE_A: f64 = 0.1;
const GAIN: f64 = 1.02;

fn t_s() -> Vec<f64> {
    (0..ROWS).map(|row| STEP_S * row as f64).collect()
}

/// A drive in A with steps and waves, and a peak that comes once.
fn current_a() -> Vec<f64> {
    let current = |t: &f64| {
        let steps = if t % 30.0 < 12.0 { 60.0 } else { 0.0 };
        let peak = if (333.0..335.0).contains(t) {
            80.0
        } else {
            0.0
        };
        40.0 * (t / 5.0).sin() + 25.0 * (1.7 * t).sin() + steps + peak
    };
    t_s().iter().map(current).collect()
}

/// A sensor's readings in noise, as they are made of the row and the current.
fn problem(reads: impl Fn(usize, &[f64]) -> f64) -> Problem {
    let current_a = current_a();
    let mut noise = noise(7, NOISE_A);
    let reading_a = (0..ROWS)
        .map(|row| reads(row, &current_a) + noise())
        .collect();
    sensor(t_s(), current_a, reading_a, NOISE_A)
}

fn explained(problem: Problem) -> Report {
    said(problem, 0, &[])
}

/// First and last time of the places in time that nothing named accounts for.
fn left_out(report: &Report) -> Vec<[f64; 2]> {
    report
        .locations
        .iter()
        .filter(|place| place.kind == LocationKind::Time && place.effect.is_none())
        .map(|place| [place.from.unwrap(), place.to.unwrap()])
        .collect()
}

fn names(report: &Report) -> Vec<&str> {
    report
        .effects
        .iter()
        .map(|effect| effect.id.as_str())
        .collect()
}

#[test]
fn what_is_right_beside_a_dropout_is_named_and_the_dropout_is_told() {
    type Instead = fn(usize, &[f64]) -> f64;
    // Nothing; what was read last; a contact that loses half of it; a wild burst.
    let instead: [(Instead, f64); 4] = [
        (|_, _| 0.0, 10.0),
        (|_, i| GAIN * i[2009], 10.0),
        (|row, i| 0.5 * i[row], 20.0),
        (|row, i| i[row] + 40.0 * (0.9 * row as f64).sin(), 3.0),
    ];
    for (case, (instead, lasts_s)) in instead.into_iter().enumerate() {
        let [from, to] = [2010, 2010 + (lasts_s / STEP_S) as usize];
        let report = explained(problem(|row, i| {
            if (from..to).contains(&row) {
                instead(row, i)
            } else {
                GAIN * i[row]
            }
        }));
        // A sensor that warms itself may do the same in some of them.
        let verdicts = [Verdict::PartlyExplained, Verdict::Ambiguous];
        assert!(
            verdicts.contains(&report.verdict),
            "{case}: {}",
            report.summary
        );
        assert_eq!(names(&report), ["gain"], "{case}");
        let gain = &report.effects[0].parameters[0];
        assert!((gain.value - GAIN).abs() < 2e-4, "{case}: {}", gain.value);
        let places = left_out(&report);
        assert_eq!(places.len(), 1, "{case}: {places:?}");
        // It begins and ends to half a second: there the log may be right by chance.
        let ends = [from as f64 * STEP_S, (to - 1) as f64 * STEP_S];
        for (told, is) in places[0].iter().zip(ends) {
            assert!((told - is).abs() < 0.5, "{case}: {places:?} for {ends:?}");
        }
        assert!(
            report.summary.contains("Left out are"),
            "{}",
            report.summary
        );
        assert!(!report.unexplained.is_empty(), "{case}");
    }
}

#[test]
fn a_dropout_beside_nothing_stays_unknown_with_its_place() {
    let report = explained(problem(|row, i| {
        if (2010..2110).contains(&row) {
            0.0
        } else {
            i[row]
        }
    }));
    assert_eq!(report.verdict, Verdict::Unknown, "{}", report.summary);
    assert_eq!(names(&report), Vec::<&str>::new());
    assert_eq!(left_out(&report).len(), 1);
    assert!(
        report.summary.contains("agree with the simulation"),
        "{}",
        report.summary
    );
    assert!(
        report.summary.contains("while the simulation moves"),
        "{}",
        report.summary
    );
}

#[test]
fn several_stretches_are_left_out_and_a_reference_that_stays_is_told() {
    let froze = |row: usize| row / 1000 % 2 == 1 && row % 1000 < 15;
    let mut several = problem(|_, _| 0.0);
    let (mut noise, current_a) = (noise(8, NOISE_A), current_a());
    several.observed.value = current_a.iter().map(|i| GAIN * i + noise()).collect();
    several.drive.reference = (0..ROWS)
        .map(|row| if froze(row) { 0.0 } else { current_a[row] })
        .collect::<Vec<f64>>()
        .into();
    let report = explained(several);
    assert_eq!(names(&report), ["gain"], "{}", report.summary);
    assert_eq!(left_out(&report).len(), 3, "{}", report.summary);
    assert!(
        report.summary.contains("the simulation at 0"),
        "{}",
        report.summary
    );
}

/// What acts at one peak, which comes nowhere else, may be the current's doing: nothing is left out.
#[test]
fn what_the_current_may_have_made_is_not_left_out() {
    type Reads = fn(usize, &[f64]) -> f64;
    let peak = |row: usize| (3330..3350).contains(&row);
    let reads: [Reads; 5] = [
        // A rail; a core that saturates otherwise than in the library; what is left of the peak and fades; a limit of the slope; a drift that
        // comes and goes.
        |row, i| (GAIN * i[row]).min(120.0),
        |row, i| GAIN * i[row] - 0.4 * (i[row].abs() - 110.0).max(0.0),
        |row, i| {
            let since_s = (row as f64 - 3350.0) * STEP_S;
            i[row]
                + if since_s > 0.0 {
                    20.0 * (-since_s / 2.0).exp()
                } else {
                    0.0
                }
        },
        |row, i| {
            let before = i[row.saturating_sub(1)];
            before + (i[row] - before).clamp(-45.0, 45.0)
        },
        |row, i| i[row] + 10.0 * (-((row as f64 - 2000.0) / 60.0).powi(2)).exp(),
    ];
    assert!((0..ROWS).filter(|&row| current_a()[row] > 125.0).all(peak));
    for (case, reads) in reads.into_iter().enumerate() {
        let report = explained(problem(reads));
        assert!(
            !report.summary.contains("Left out"),
            "{case}: {}",
            report.summary
        );
        assert!(
            !report.summary.contains("all but"),
            "{case}: {}",
            report.summary
        );
    }
}

#[test]
fn more_than_a_tenth_of_a_recording_is_not_left_out() {
    let report = explained(problem(|row, i| {
        if (2000..2700).contains(&row) {
            0.0
        } else {
            GAIN * i[row]
        }
    }));
    assert!(!report.summary.contains("Left out"), "{}", report.summary);
}
