//! Gaps, drop-outs and held values.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use proptest::prelude::*;
use recording::{Recording, marks};

const NONE: f64 = f64::NAN;

fn recording(columns: &[(&str, &[f64])]) -> Recording {
    let columns = columns
        .iter()
        .map(|&(name, values)| (name.to_owned(), values.to_vec()))
        .collect();
    Recording::new("r", columns).unwrap()
}

#[test]
fn gaps_are_between_rows_or_between_values() {
    let read = recording(&[
        ("t_s", &[0.0, 1.0, 2.0, 5.0, 6.0]),
        ("v_cell_v", &[3.0, NONE, 3.0, 3.0, NONE]),
    ]);
    let gaps = read.gaps(1.0);
    assert_eq!(gaps.len(), 1);
    assert_eq!(
        (gaps[0].before, gaps[0].after, gaps[0].length_s),
        (2, 3, 3.0)
    );
    let gaps = read.gaps_of("v_cell_v", 1.0).unwrap();
    let rows: Vec<_> = gaps.iter().map(|gap| (gap.before, gap.after)).collect();
    assert_eq!(rows, [(0, 2), (2, 3)]);
    assert!(read.gaps_of("soc_pct", 1.0).is_err());
}

#[test]
fn a_new_clock_is_neither_gap_nor_repetition() {
    let read = recording(&[
        ("t_s", &[0.0, 9.0, 0.0, 1.0]),
        ("cycle", &[1.0, 1.0, 2.0, 2.0]),
        ("v_cell_v", &[3.0, 4.0, 4.0, NONE]),
    ]);
    assert_eq!(read.gaps(2.0).len(), 1);
    assert!(read.held_runs("v_cell_v").unwrap().is_empty());
    assert_eq!(read.fresh("v_cell_v").unwrap(), [true, true, true, false]);
    assert!(read.dropouts("v_cell_v").unwrap().iter().eq([&(3..4)]));
}

#[test]
fn held_values_are_found() {
    let values = [1.0, 1.0, 1.0, NONE, 1.0, 2.0, 2.0, 3.0];
    let time_s: Vec<f64> = (0..8).map(f64::from).collect();
    let read = recording(&[("t_s", &time_s), ("i_meas_a", &values)]);
    assert_eq!(read.held_runs("i_meas_a").unwrap(), [0..3, 5..7]);
    assert_eq!(
        read.fresh("i_meas_a").unwrap(),
        [true, false, false, false, false, true, false, true]
    );
    assert_eq!(
        marks::mask(8, &[0..1, 6..99]),
        [true, false, false, false, false, false, true, true]
    );
}

proptest! {
    /// What is neither missing nor held stands alone, and no row is both.
    #[test]
    fn runs_are_whole_and_apart(values in prop::collection::vec(prop_oneof![Just(NONE), Just(0.0), Just(1.0)], 1..60)) {
        let time_s: Vec<f64> = (0..values.len()).map(|row| row as f64).collect();
        let read = recording(&[("t_s", &time_s), ("x", &values)]);
        let held = marks::mask(values.len(), &read.held_runs("x").unwrap());
        let missing = marks::mask(values.len(), &read.dropouts("x").unwrap());
        for row in 0..values.len() {
            prop_assert_eq!(missing[row], values[row].is_nan());
            let like_before = row > 0 && values[row - 1] == values[row];
            let like_after = values.get(row + 1).is_some_and(|&after| after == values[row]);
            prop_assert_eq!(held[row], like_before || like_after);
        }
    }
}
