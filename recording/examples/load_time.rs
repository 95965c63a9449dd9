//! How long a recording takes to load: `cargo run --profile tool -p recording --example load_time [FILE]`.
//!
//! Without a file it makes one of a million rows and five columns.

use std::{env, error::Error, path::PathBuf, time::Instant};

use recording::csv;

const ROWS: u32 = 1_000_000;

fn main() -> Result<(), Box<dyn Error>> {
    let folder;
    let path = match env::args().nth(1) {
        Some(path) => PathBuf::from(path),
        None => {
            folder = tempfile::tempdir()?;
            let path = folder.path().join("made.csv");
            let start = Instant::now();
            make(&path)?;
            println!("written in {:.3} s", start.elapsed().as_secs_f64());
            path
        }
    };
    let start = Instant::now();
    let read = csv::read(&path)?;
    println!(
        "{} rows of {} columns read in {:.3} s",
        read.len(),
        read.table().names().len(),
        start.elapsed().as_secs_f64()
    );
    Ok(())
}

fn make(path: &std::path::Path) -> recording::Result<()> {
    let names = ["t_s", "i_ref_a", "i_meas_a", "v_cell_v", "temp_cell_c"];
    let mut writer = csv::Writer::create(path, &names)?;
    for row in 0..ROWS {
        let time_s = f64::from(row) * 1e-3;
        let current_a = 100.0 * (time_s * 0.37).sin();
        writer.row(&[
            time_s,
            current_a,
            (current_a * 1e3).round() / 1e3,
            3.7 - 1e-3 * current_a,
            25.0 + (time_s * 0.01).cos(),
        ])?;
    }
    writer.finish()
}
