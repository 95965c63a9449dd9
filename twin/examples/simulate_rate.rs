//! Prints how many samples a second the board's simulation makes on one core.
//!
//! `cargo run -p twin --profile tool --example simulate_rate`

#![allow(clippy::unwrap_used, clippy::single_range_in_vec_init)]

use std::time::Instant;

use twin::{
    model::FrontEndKind,
    problem::{Drive, Observed},
    simulate::board::{Board, Pace},
};

const ROWS: usize = 1_000_000;

fn main() {
    // A drive that goes through both ranges: 0.01 s apart, as the current frame is.
    let t_s: Vec<f64> = (0..ROWS).map(|row| row as f64 * 0.01).collect();
    let reference: Vec<f64> = t_s
        .iter()
        .map(|t| 80.0 * (0.7 * t).sin() + 30.0 * (5.3 * t).sin())
        .collect();
    let drive = Drive {
        t_s: t_s.clone(),
        reference,
        segments: vec![0..ROWS],
        continues: vec![false],
        ..Drive::default()
    };
    let observed = Observed {
        t_s,
        value: vec![f64::NAN; ROWS],
        valid: vec![true; ROWS],
        segment: vec![0; ROWS],
        on_drive_rows: true,
    };
    for (kind, name) in [
        (FrontEndKind::DualRange, "dual-range"),
        (FrontEndKind::Hah1bv, "hah1bv"),
        (FrontEndKind::Network, "network"),
        (FrontEndKind::ClosedLoop, "closed-loop"),
    ] {
        for (average, charge) in [(1, false), (8, false), (1, true)] {
            let board = Board::new(kind, average).unwrap();
            let start = Instant::now();
            let reported = board.run(&drive, false, &observed, Pace::Seen, charge);
            let seconds = start.elapsed().as_secs_f64();
            println!(
                "{name}, average of {average}{}: {:.2} million samples/s (last {:.3} A)",
                if charge { ", with charge" } else { "" },
                ROWS as f64 / seconds * 1e-6,
                reported.current_a.last().unwrap()
            );
        }
    }
}
