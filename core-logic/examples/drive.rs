//! Drives a recorded current through the board's measuring logic and says what it made of it.
//!
//! The analogue side is an ideal one (`tests/support/ideal_board.rs`): sensors, comparators, switch, meter and converter
//! without a single imperfection. So what differs from the recording is what the measuring itself costs: quantisation,
//! range hand-over, sampling. The frames are those that the firmware sends.
//!
//! `drive RECORDING.csv SCALE OUT_DIR` writes `can.log` (candump) and `drive.csv` (truth beside measurement).

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    clippy::indexing_slicing
)]

use std::error::Error;
use std::fmt::Write as _;
use std::fs::{self, File};
use std::io::{BufWriter, Write as _};
use std::path::Path;
use std::process::ExitCode;
use std::time::Instant as Clock;

#[path = "../tests/support/host_board.rs"]
mod host_board;
#[path = "../tests/support/ideal_board.rs"]
mod ideal_board;

use core_logic::configuration::Configuration;
use core_logic::diagnosis::CodeSet;
use core_logic::error_budget::{ProfileSummary, charge_bound};
use core_logic::range::Range;
use core_logic::units::{Duration, Microamps};
use host_board::{HostBoard, Step};
use ideal_board::{Event, Row, Timing};

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [recording, scale, out] = arguments.as_slice() else {
        eprintln!("usage: drive RECORDING.csv SCALE OUT_DIR");
        return ExitCode::from(2);
    };
    match drive(recording, scale, Path::new(out)) {
        Ok(summary) => {
            print!("{summary}");
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::from(2)
        }
    }
}

/// Reads `t_s`, `i_ref_a` and, where it is there, `v_cell_v`; other columns are not needed.
fn read(path: &str, scale: f64) -> Result<Vec<Row>, Box<dyn Error>> {
    let mut reader = csv::Reader::from_path(path).map_err(|error| format!("{path}: {error}"))?;
    let header = reader.headers()?.clone();
    let find = |name: &str| header.iter().position(|column| column == name);
    let need = |name: &str| {
        find(name).ok_or_else(|| {
            let columns: Vec<&str> = header.iter().collect();
            format!(
                "{path}, line 1: no column {name:?}; the file has {}",
                columns.join(", ")
            )
        })
    };
    let (time, current, cell) = (need("t_s")?, need("i_ref_a")?, find("v_cell_v"));
    let mut rows: Vec<Row> = Vec::new();
    for record in reader.records() {
        let record = record.map_err(|error| format!("{path}: {error}"))?;
        let line = record.position().map_or(0, csv::Position::line);
        let number = |index: usize, name: &str| -> Result<f64, String> {
            let text = record.get(index).unwrap_or_default();
            text.parse()
                .ok()
                .filter(|value: &f64| value.is_finite())
                .ok_or_else(|| format!("{path}, line {line}, column {name}: {text:?} is no number"))
        };
        let t_s = number(time, "t_s")?;
        if let Some(last) = rows.last()
            && t_s < last.t_s
        {
            return Err(format!(
                "{path}, line {line}, column t_s: {t_s} s after {} s; time must not run backwards",
                last.t_s
            )
            .into());
        }
        let current_a = number(current, "i_ref_a")? * scale;
        if current_a.abs() > 600.0 {
            return Err(format!(
                "{path}, line {line}, column i_ref_a: {current_a} A is beyond the ±600 A of the large sensor"
            )
            .into());
        }
        let cell_v = cell.map_or(Ok(3.7), |index| number(index, "v_cell_v"))?;
        rows.push(Row {
            t_s,
            current_a,
            cell_v,
        });
    }
    if rows.len() < 2 {
        return Err(format!("{path}: {} rows; a drive needs at least two", rows.len()).into());
    }
    Ok(rows)
}

fn drive(recording: &str, scale: &str, out: &Path) -> Result<String, Box<dyn Error>> {
    let factor: f64 = scale
        .parse()
        .ok()
        .filter(|factor: &f64| factor.is_finite() && *factor != 0.0)
        .ok_or_else(|| format!("SCALE is {scale:?}; a number other than 0 was expected"))?;
    let rows = read(recording, factor)?;
    fs::create_dir_all(out)?;
    let mut can_log = BufWriter::new(File::create(out.join("can.log"))?);
    let mut table = BufWriter::new(File::create(out.join("drive.csv"))?);
    writeln!(
        table,
        "t_s,i_ref_a,i_meas_a,q_ref_c,q_meas_c,range_high,soc_pct"
    )?;

    let mut configuration = Configuration::default();
    // The cell's 2.9 Ah, scaled as its current is.
    configuration.soc.capacity_mah = (2_900.0 * factor.abs()) as u32;
    let started = Clock::now();
    let mut board = HostBoard::new(&rows, Timing::default(), configuration);
    let mut frames = 0u64;
    let mut first_valid_ms = None;
    let mut seen = CodeSet::EMPTY;
    let (mut valid, mut invalid) = (0u64, 0u64);
    let mut largest_current = [0.0f64; 2];
    let mut written = Ok(());
    while let Some(step) = board.step() {
        match step {
            Step::Event(Event::Conversion { .. }) => {
                let sent = board.measurement.current();
                if sent.validity.is_valid() {
                    valid += 1;
                    let of_range = &mut largest_current[sent.range as usize];
                    *of_range = of_range.max((f64::from(sent.current.get()) * 1e-6).abs());
                } else {
                    invalid += 1;
                }
            }
            Step::Event(_) => {}
            Step::Tick(tick) => {
                let at_us = board.now_us;
                seen = seen.union(tick.changes.set);
                if first_valid_ms.is_none() && board.measurement.current().validity.is_valid() {
                    first_valid_ms = Some(at_us / 1_000);
                }
                let seconds = at_us as f64 * 1e-6;
                board.frames(at_us, |frame| {
                    frames += 1;
                    let mut line = format!("({seconds:.6}) can0 {:03X}#", frame.id);
                    for byte in &frame.data[..usize::from(frame.dlc)] {
                        let _ = write!(line, "{byte:02X}");
                    }
                    if let (Ok(()), Err(error)) = (&written, writeln!(can_log, "{line}")) {
                        written = Err(error);
                    }
                });
                if at_us.is_multiple_of(100_000) {
                    let current = board.measurement.current();
                    let measured = if current.validity.is_valid() {
                        format!("{:.6}", f64::from(current.current.get()) * 1e-6)
                    } else {
                        String::new()
                    };
                    let soc = board.measurement.state_of_charge();
                    let share = if soc.validity.is_valid() {
                        format!("{:.4}", f64::from(soc.state_of_charge.get()) * 1e-4)
                    } else {
                        String::new()
                    };
                    writeln!(
                        table,
                        "{seconds:.3},{:.6},{measured},{:.4},{:.4},{},{share}",
                        board.world.current_a(),
                        board.world.charge_c,
                        board.meter.report().charge_total.get() as f64 * 1e-9,
                        u8::from(board.world.flag_high()),
                    )?;
                }
            }
        }
    }
    written?;
    can_log.flush()?;
    table.flush()?;

    let elapsed_s = board.world.elapsed_s();
    let mut squares = 0.0;
    let mut through_c = 0.0;
    for pair in rows.windows(2) {
        let (dt, mean) = (
            pair[1].t_s - pair[0].t_s,
            0.5 * (pair[0].current_a + pair[1].current_a),
        );
        squares += mean * mean * dt;
        through_c += mean.abs() * dt;
    }
    let rms = (squares / elapsed_s).sqrt();
    let error_c = board.charge_error_c();
    let bound_c = charge_bound(&ProfileSummary {
        duration: Duration::from_ticks((elapsed_s * 1e6) as u64),
        in_large: board.in_large(),
        rms_current: Microamps((rms * 1e6) as i32),
        edges: board.world.edges as u32,
        below_no_load: Duration::from_ticks(0),
        chatter: Duration::from_ticks(0),
        chatter_squares: 0,
        chatter_runs: 0,
    })
    .ideal_sensor
    .get() as f64
        * 1e-9;
    let report = board.meter.report();
    let mut summary = String::new();
    let s = &mut summary;
    writeln!(
        s,
        "recording        {recording} × {factor}: {} rows, {elapsed_s:.0} s, rms {rms:.1} A",
        rows.len()
    )?;
    writeln!(
        s,
        "range changes    {} across ±53.33 A, {} handed over one by one, {} estimated",
        board.world.edges, report.hand_overs, report.estimated_intervals
    )?;
    writeln!(
        s,
        "charge           {:.3} As flowed out net, {through_c:.0} As both ways",
        board.world.charge_c
    )?;
    writeln!(
        s,
        "board            {:.3} As, error {error_c:+.3} As = {:+.5} % of both ways; bound {bound_c:.1} As",
        report.charge_total.get() as f64 * 1e-9,
        100.0 * error_c / through_c
    )?;
    writeln!(
        s,
        "current          {valid} conversions valid, {invalid} marked invalid; up to {:.2} A by the small sensor, {:.1} A by the large one",
        largest_current[Range::Small as usize],
        largest_current[Range::Large as usize]
    )?;
    let soc = board.measurement.state_of_charge();
    let share = |ppm: core_logic::units::Ppm| f64::from(ppm.get()) * 1e-4;
    match soc.uncertainty {
        Some(uncertainty) => writeln!(
            s,
            "state of charge  {:.2} % ± {:.2} % at the end",
            share(soc.state_of_charge),
            share(uncertainty)
        )?,
        None => writeln!(
            s,
            "state of charge  not known: the recording has no rest on which it could be anchored; marked so on the bus"
        )?,
    }
    match first_valid_ms {
        Some(ms) => writeln!(s, "first valid      {ms} ms after the start")?,
        None => writeln!(s, "first valid      never")?,
    }
    let names: Vec<&str> = seen.iter().map(|code| code.description().name).collect();
    writeln!(
        s,
        "diagnoses        {}",
        if names.is_empty() {
            "none".into()
        } else {
            names.join(", ")
        }
    )?;
    writeln!(
        s,
        "on the bus       {frames} frames in {}",
        out.join("can.log").display()
    )?;
    writeln!(s, "truth beside it  {}", out.join("drive.csv").display())?;
    writeln!(
        s,
        "took             {:.2} s, {:.0} times real time",
        started.elapsed().as_secs_f64(),
        elapsed_s / started.elapsed().as_secs_f64()
    )?;
    if error_c.abs() > bound_c {
        return Err(format!(
            "{summary}\nthe charge error {error_c} As exceeds its bound {bound_c} As"
        )
        .into());
    }
    Ok(summary)
}
