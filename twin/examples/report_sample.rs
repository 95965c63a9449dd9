//! Writes a sample of every kind of report: `cargo run -p twin --example report_sample -- FOLDER [ROWS]`.

#[path = "../tests/report_sample/mod.rs"]
mod report_sample;

use std::{env, error::Error, fs, path::PathBuf};

use twin::report::{html, json, text};

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = env::args().skip(1);
    let folder = PathBuf::from(arguments.next().ok_or("name a folder to write to")?);
    fs::create_dir_all(&folder)?;
    let rows = match arguments.next() {
        Some(rows) => rows.parse()?,
        None => report_sample::ROWS,
    };
    for (name, report) in [
        ("partly-explained", report_sample::partly_explained_of(rows)),
        ("explained", report_sample::explained()),
        ("no-mismatch", report_sample::no_mismatch()),
        ("ambiguous", report_sample::ambiguous()),
        ("unknown", report_sample::unknown()),
    ] {
        fs::write(folder.join(format!("{name}.html")), html::render(&report))?;
        fs::write(folder.join(format!("{name}.json")), json::render(&report))?;
        fs::write(
            folder.join(format!("{name}.txt")),
            text::render(&report, 80),
        )?;
    }
    Ok(())
}
