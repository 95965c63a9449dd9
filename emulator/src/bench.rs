//! The board's figures, measured on the emulated board: what `emulate bench` prints and docs/figures-emulated.md states.

use std::fmt;
use std::path::{Path, PathBuf};
use std::time::Instant as Clock;

use anyhow::{Context as _, Result, bail};

use plant::front_end::Sensors;
use recording::Mapping;

use crate::can_frame::CanFrame;
use crate::drive::{Drive, Figures};
use crate::mcu::rcc::ResetCause;
use crate::profile::{self, ProfileOptions};
use crate::rig::{Firmware, Rig, Setup};
use crate::scenario::{Contactors, Key, Row, Scenario};
use crate::time::Ticks;

/// What a figure has to be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Bound {
    /// No more than this.
    AtMost(f64),
    /// No less than this.
    AtLeast(f64),
}

/// Something measured.
#[derive(Clone, Debug, PartialEq)]
pub struct Figure {
    /// What.
    pub name: &'static str,
    /// How much.
    pub value: f64,
    /// Of what.
    pub unit: &'static str,
    /// What it has to be, where something was stated.
    pub bound: Option<Bound>,
    /// Under which conditions.
    pub conditions: String,
}

impl Figure {
    /// Whether it is what it has to be.
    pub fn holds(&self) -> bool {
        match self.bound {
            None => true,
            Some(Bound::AtMost(most)) => self.value <= most,
            Some(Bound::AtLeast(least)) => self.value >= least,
        }
    }
}

/// Figures as a table in Markdown.
#[derive(Clone, Copy, Debug)]
pub struct Table<'a>(pub &'a [Figure]);

impl fmt::Display for Table<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "| figure | value | bound | holds | conditions |")?;
        writeln!(f, "|---|---|---|---|---|")?;
        for figure in self.0 {
            let Figure {
                name,
                value,
                unit,
                bound,
                conditions,
            } = figure;
            let bound = match bound {
                None => String::new(),
                Some(Bound::AtMost(most)) => format!("≤ {}", number(*most)),
                Some(Bound::AtLeast(least)) => format!("≥ {}", number(*least)),
            };
            let holds = match (figure.bound, figure.holds()) {
                (None, _) => "",
                (_, true) => "yes",
                (_, false) => "**no**",
            };
            let value = number(*value);
            writeln!(
                f,
                "| {name} | {value} {unit} | {bound} | {holds} | {conditions} |"
            )?;
        }
        Ok(())
    }
}

/// Four digits, and whole numbers as they are.
fn number(value: f64) -> String {
    let magnitude = value.abs();
    if value.fract() == 0.0 {
        format!("{value:.0}")
    } else if magnitude >= 100.0 {
        format!("{value:.1}")
    } else if magnitude >= 1.0 {
        format!("{value:.3}")
    } else {
        format!("{value:.5}")
    }
}

/// How much is run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Extent {
    /// Length of the range changes under load, in s.
    pub edges_s: f64,
    /// Crossings of ±53.33 A.
    pub crossings: u32,
    /// Length of the drive, in s; it is driven twice.
    pub drive_s: f64,
}

impl Extent {
    /// What the figures are stated for: an hour.
    pub const FULL: Self = Self {
        edges_s: 10.0,
        crossings: 1_000,
        drive_s: 3_600.0,
    };
    /// A minute or so.
    pub const QUICK: Self = Self {
        edges_s: 2.0,
        crossings: 100,
        drive_s: 30.0,
    };
}

/// Runs all of it. `quick`: fewer range changes, and half a minute of the drive instead of an hour.
///
/// # Errors
/// If the recording cannot be read, or the image does what no board does.
pub fn run(firmware: &Firmware, quick: bool) -> Result<Vec<Figure>> {
    run_extent(firmware, if quick { &Extent::QUICK } else { &Extent::FULL })
}

/// Runs so much of it.
///
/// # Errors
/// As [`run`].
pub fn run_extent(firmware: &Firmware, extent: &Extent) -> Result<Vec<Figure>> {
    let mut bench = Bench {
        firmware,
        figures: Vec::new(),
    };
    bench.start_and_steady()?;
    bench.edges_under_load(extent.edges_s)?;
    bench.chatter()?;
    bench.crossings(extent.crossings)?;
    bench.watchdog()?;
    bench.ideal_drive(extent.drive_s)?;
    bench.calibrated_drive(extent.drive_s)?;
    Ok(bench.figures)
}

struct Bench<'firmware> {
    firmware: &'firmware Firmware,
    figures: Vec<Figure>,
}

/// An hour of it has currents of both signs in both ranges.
const PROFILE: &str = "recordings/panasonic-18650pf/25c-us06.csv";
const PROFILE_SCALE: f64 = 19.0;

fn profile_path() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("..")
        .join(PROFILE)
}

fn profile_rows(duration_s: f64) -> Result<Vec<Row>> {
    let options = ProfileOptions {
        scale: PROFILE_SCALE,
        duration_s: Some(duration_s),
        ..ProfileOptions::default()
    };
    let mapping = Mapping::parse(std::iter::empty())?;
    Ok(profile::read(&profile_path(), &mapping, &options)?.rows)
}

/// A current that goes from one row to the next in a straight line.
fn driven(points: impl IntoIterator<Item = (f64, f64)>) -> Result<Setup> {
    let rows = points
        .into_iter()
        .map(|(t_s, current_a)| Row {
            cell_v: Some(3.7),
            pack_v: Some(355.0),
            cell_temperature_c: Some(25.0),
            ..Row::at_rest(t_s).with_current(current_a)
        })
        .collect();
    Ok(Setup::nominal(Scenario::new(
        rows,
        Contactors::AlwaysClosed,
    )?))
}

/// Input registers 0 … 99, with the CRC.
const READ_INPUTS: [u8; 8] = [1, 4, 0, 0, 0, 100, 0xF1, 0xE1];
/// What load means here.
const LOAD: &str = "CAN full of other nodes' frames behind the board's own; RS485: 100 registers every 25 ms; log on";

/// Lets everything else on the board have as much to do as can be.
fn load(rig: &mut Rig<'_>, ms: u64) {
    // Four of 0.24 ms are more than the bus has room for beside the board's own; what waits stays short all the same.
    let room = 8_usize.saturating_sub(rig.machine.can(|can| can.waiting()));
    for _ in 0..room {
        // Behind the board's own frames: those before them would make it wait by the rules of the bus.
        rig.send_can(CanFrame::standard(0x700, &[0x55; 8]));
    }
    if ms.is_multiple_of(25) {
        rig.send_rs485(&READ_INPUTS);
    }
}

impl<'firmware> Bench<'firmware> {
    fn add(
        &mut self,
        name: &'static str,
        value: f64,
        unit: &'static str,
        bound: Option<Bound>,
        conditions: impl Into<String>,
    ) {
        self.figures.push(Figure {
            name,
            value,
            unit,
            bound,
            conditions: conditions.into(),
        });
    }

    fn periods(&mut self, figures: &Figures, conditions: &str) {
        let (least, most) = (Some(Bound::AtLeast(9.5)), Some(Bound::AtMost(10.5)));
        let shortest_ms = figures.shortest_current_period_s * 1e3;
        let longest_ms = figures.longest_current_period_s * 1e3;
        self.add(
            "current frames: shortest period",
            shortest_ms,
            "ms",
            least,
            conditions,
        );
        self.add(
            "current frames: longest period",
            longest_ms,
            "ms",
            most,
            conditions,
        );
    }

    fn start_and_steady(&mut self) -> Result<()> {
        let conditions =
            "power-on, erased flash, 10 A, nothing else on the buses but the vehicle's frames";
        let mut drive = Drive::new(self.firmware, driven([(0.0, 10.0)])?, None)?;
        drive.run_to(1.5, |_| true)?;
        drive.rig.machine.restart_load();
        drive.run_to(6.5, |_| true)?;
        let figures = drive.figures();
        let first_ms = figures.first_valid_s.context("no valid current came")? * 1e3;
        let first = "power-on to the end of the first valid current frame";
        self.add(
            first,
            first_ms,
            "ms",
            Some(Bound::AtMost(250.0)),
            conditions,
        );
        self.periods(&figures, "5 s, 10 A, vehicle's frames only");
        self.add(
            "CPU load",
            figures.load * 100.0,
            "%",
            None,
            "5 s, 10 A, vehicle's frames only",
        );
        Ok(())
    }

    /// Range changes at all phases of what else the board does.
    fn edges_under_load(&mut self, length_s: f64) -> Result<()> {
        // 37.3 ms from change to change, against polls of 20 ms and conversions of 31 ms.
        let ramps = (0_u32..).map(|n| 1.0 + f64::from(n) * 0.037_3);
        let points = ramps
            .take_while(|t_s| *t_s < 1.0 + length_s)
            .enumerate()
            .flat_map(|(n, t_s)| {
                let (from_a, to_a) = if n % 2 == 0 {
                    (40.0, 66.0)
                } else {
                    (66.0, 40.0)
                };
                [(t_s, from_a), (t_s + 0.005, to_a)]
            });
        let mut drive = Drive::new(self.firmware, driven(points)?, None)?;
        drive.run_to(1.0, |_| true)?;
        drive.rig.machine.restart_load();
        let busy = |drive: &mut Drive<'_>| drive.rig.machine.can(|can| can.busy());
        let busy_before = busy(&mut drive);
        for ms in 0_u32.. {
            let at_s = 1.0 + f64::from(ms) * 1e-3;
            if at_s > 1.0 + length_s {
                break;
            }
            load(&mut drive.rig, ms.into());
            drive.run_to(at_s + 1e-3, |_| true)?;
        }
        let loaded_s = drive.rig.now_s() - 1.0;
        let can_load = busy(&mut drive).since(busy_before).seconds() / loaded_s;
        let figures = drive.figures();
        let conditions = format!("{} range changes at 5 kA/s. {LOAD}", figures.edges);
        let us = |seconds: f64| seconds * 1e6;
        let most = Some(Bound::AtMost(100.0));
        let latched = figures.latched;
        self.add(
            "range edge to AENERGY latched: median",
            us(latched.median_s),
            "µs",
            None,
            &*conditions,
        );
        self.add(
            "range edge to AENERGY latched: worst",
            us(latched.worst_s),
            "µs",
            most,
            &*conditions,
        );
        let read = figures.read;
        self.add(
            "range edge to AENERGY read: median",
            us(read.median_s),
            "µs",
            None,
            &*conditions,
        );
        self.add(
            "range edge to AENERGY read: worst",
            us(read.worst_s),
            "µs",
            None,
            &*conditions,
        );
        let unanswered = figures.unanswered as f64;
        self.add(
            "range changes without a charge snapshot",
            unanswered,
            "",
            Some(Bound::AtMost(0.0)),
            &*conditions,
        );
        self.periods(&figures, &conditions);
        self.add("CPU load", figures.load * 100.0, "%", None, conditions);
        self.add("CAN load", can_load * 100.0, "%", None, LOAD);
        Ok(())
    }

    /// A current that goes over the threshold and back a thousand times a second.
    fn chatter(&mut self) -> Result<()> {
        let toggles = (0..2_000).flat_map(|n| {
            let t_s = 1.0 + f64::from(n) * 0.5e-3;
            let a = if n % 2 == 0 { 56.0 } else { 50.0 };
            [(t_s, a), (t_s + 0.499e-3, a)]
        });
        let points: Vec<_> = [(0.0, 50.0)]
            .into_iter()
            .chain(toggles)
            .chain([(2.001, 50.0)])
            .collect();
        let mut rig = Rig::new(self.firmware, driven(points)?)?;
        rig.run_s(2.2)?;
        let edges = rig.truth().edges;
        let answer = rig.modbus(&[1, 4, 0, 0x4E, 0, 2])?;
        let Some(counted) = answer.get(3..7).and_then(|bytes| bytes.try_into().ok()) else {
            bail!("the answer {answer:02X?} is no pair of registers");
        };
        let lost = edges as f64 - f64::from(u32::from_be_bytes(counted));
        let conditions = format!("{edges} changes of the flag in 1 s, read back over Modbus");
        self.add(
            "range changes not counted at 1 kHz",
            lost,
            "",
            Some(Bound::AtMost(0.0)),
            conditions,
        );
        Ok(())
    }

    fn crossings(&mut self, count: u32) -> Result<()> {
        // A triangle of ±80 A crosses +53.33 A and −53.33 A twice each.
        let quarter_s = 0.04;
        let corners = (0..=count).map(|n| {
            let a = [0.0, 80.0, 0.0, -80.0][n as usize % 4];
            (1.0 + f64::from(n) * quarter_s, a)
        });
        let end_s = 1.0 + f64::from(count) * quarter_s;
        let points = [(0.0, 0.0)]
            .into_iter()
            .chain(corners)
            .chain([(end_s + 0.04, 0.0)]);
        let mut drive = Drive::new(self.firmware, driven(points)?, None)?;
        drive.run_to(end_s + 0.5, |_| true)?;
        let figures = drive.figures();
        let error_c = figures.charge_error_c.context("no charge came")?;
        let conditions = format!(
            "{} changes of the range at 2 kA/s, {:.0} C both ways, ideal sensors; bound of the error budget",
            figures.edges, figures.throughput_c
        );
        let bound = Some(Bound::AtMost(figures.charge_bound_c));
        self.add(
            "charge error after crossings of ±53.33 A",
            error_c.abs(),
            "C",
            bound,
            conditions,
        );
        Ok(())
    }

    fn watchdog(&mut self) -> Result<()> {
        let mut rig = Rig::new(self.firmware, driven([(0.0, 100.0)])?)?;
        rig.run_s(3.0)?;
        let at = rig.machine.now();
        let (truth_c, board_c) = (rig.truth().charge_c, rig.view.charge_c().value);
        rig.machine.reset(ResetCause::IndependentWatchdog);
        rig.view.first_valid_current = None;
        let limit = Ticks::from_seconds(1.0);
        rig.run_until("a valid current", limit, |rig| {
            rig.view.first_valid_current.is_some()
        })?;
        let back = rig
            .view
            .first_valid_current
            .map_or(0.0, |back| back.since(at).seconds());
        let conditions = "the watchdog's reset (its own time-out, 0.68 … 1.88 s by the tolerance of LSI, comes before it), 100 A";
        let most = Some(Bound::AtMost(250.0));
        self.add(
            "watchdog reset to the first valid current frame",
            back * 1e3,
            "ms",
            most,
            conditions,
        );
        rig.run_s(1.0)?;
        let (after_c, flowed_c) = (rig.view.charge_c().value, rig.truth().charge_c - truth_c);
        let kept = board_c.zip(after_c).context("no charge came")?;
        let lost_c = (flowed_c - (kept.1 - kept.0)).abs();
        let most = Some(Bound::AtMost(1_500.0));
        self.add(
            "charge that the reset cost",
            lost_c,
            "C",
            most,
            "100 A flowing, 1.1 s after it; up to 10 C are the age of the frames (100 ms) at 100 A",
        );
        Ok(())
    }

    /// Nothing but the board's own errors.
    fn ideal_drive(&mut self, duration_s: f64) -> Result<()> {
        let rows = profile_rows(duration_s)?;
        let end_s = rows.last().map_or(0.0, |row| row.t_s);
        let setup = Setup::nominal(Scenario::new(rows, Contactors::AlwaysClosed)?);
        // By its number, so that two at once do not meet.
        let folder = std::env::temp_dir().join(format!("hallmark-bench-{}", std::process::id()));
        let clock = Clock::now();
        let mut drive = Drive::new(self.firmware, setup, Some(&folder))?;
        drive.run_to(end_s, |_| true)?;
        let figures = drive.figures();
        drive.finish("", "")?;
        let took_s = clock.elapsed().as_secs_f64();
        std::fs::remove_dir_all(&folder)?;
        let error_c = figures.charge_error_c.context("no charge came")?;
        let conditions = format!(
            "{PROFILE} × {PROFILE_SCALE}, {duration_s:.0} s, {:.0} C both ways, {} range changes, ideal sensors; diagnoses: {}",
            figures.throughput_c,
            figures.edges,
            names(&figures)
        );
        let share = 100.0 * error_c.abs() / figures.throughput_c;
        self.add(
            "charge error of a real drive",
            share,
            "%",
            Some(Bound::AtMost(0.05)),
            &*conditions,
        );
        let bound = Some(Bound::AtMost(figures.charge_bound_c));
        self.add(
            "charge error of a real drive",
            error_c.abs(),
            "C",
            bound,
            conditions,
        );
        let speed = figures.length_s / took_s;
        let conditions =
            format!("the same drive with CAN log, {took_s:.1} s on the machine that printed this");
        self.add(
            "emulation against real time",
            speed,
            "times",
            Some(Bound::AtLeast(5.0)),
            conditions,
        );
        Ok(())
    }

    /// Sensors as bad as a data sheet lets them be, then calibrated over Modbus by two known currents in each range.
    fn calibrated_drive(&mut self, duration_s: f64) -> Result<()> {
        let stretch = |t_s: f64, key: Key, current_a: f64| {
            Row::at_rest(t_s).with_key(key).with_current(current_a)
        };
        let known = [10.0, 40.0, 200.0, 400.0];
        let mut rows = vec![
            stretch(0.0, Key::Off, 0.0),
            stretch(2.0, Key::Off, 0.0),
            stretch(2.0, Key::On, 0.0),
        ];
        for (n, current_a) in known.into_iter().enumerate() {
            let from_s = 5.0 + 3.0 * n as f64;
            rows.push(stretch(from_s + 0.2, Key::On, current_a));
            rows.push(stretch(from_s + 3.0, Key::On, current_a));
        }
        rows.extend([
            stretch(17.2, Key::On, 0.0),
            stretch(18.0, Key::On, 0.0),
            stretch(18.0, Key::Off, 0.0),
        ]);
        let mut setup = Setup::nominal(Scenario::new(rows, Contactors::Permitted)?);
        let Sensors::DualRange { small, large } = &mut setup.board.front_end.sensors else {
            bail!("the nominal board has two sensors");
        };
        (small.gain, small.offset_a) = (1.01, 0.3);
        (large.gain, large.offset_a) = (0.99, 3.0);
        let mut rig = Rig::new(self.firmware, setup)?;
        // No factors by key state: they would take the zero error as well.
        rig.run_s(1.0)?;
        write(&mut rig, KEY_CALIBRATION, &[0])?;
        let mut seen = [0.0; 4];
        for (n, seen_a) in seen.iter_mut().enumerate() {
            rig.run_to(Ticks::from_seconds(7.9 + 3.0 * n as f64))?;
            *seen_a = rig
                .view
                .meter_current_a()
                .value
                .context("no meter current came")?;
        }
        // reading = gain · current + zero, in each range.
        let line = |n: usize| {
            let gain = (seen[n + 1] - seen[n]) / (known[n + 1] - known[n]);
            (gain, seen[n] - gain * known[n])
        };
        let ((gain_s, zero_s), (gain_l, zero_l)) = (line(0), line(2));
        rig.run_to(Ticks::from_seconds(19.0))?;
        write(&mut rig, ZERO_DRIFT, &pair(zero_s * 1e6, zero_l * 1e6))?;
        let lacks = |gain: f64| (1.0 / gain - 1.0) * 1e6;
        let gains = pair(lacks(gain_s), lacks(gain_l));
        write(&mut rig, METER_GAIN, &gains)?;
        write(&mut rig, CURRENT_GAIN, &gains)?;
        rig.run_s(1.5)?;

        let start_s = rig.now_s();
        let mut rows = vec![Row::at_rest(start_s), Row::at_rest(start_s + 2.0)];
        rows.extend(profile_rows(duration_s)?.into_iter().map(|row| Row {
            t_s: row.t_s + start_s + 3.0,
            ..row
        }));
        let end_s = rows.last().map_or(0.0, |row| row.t_s);
        let profile = rows.clone();
        rig.machine.board(|board| board.scenario.replace(rows));
        rig.run_s(2.5)?;
        let before = (
            rig.truth().charge_c,
            rig.view.charge_c().value.context("no charge came")?,
        );
        rig.view.diagnoses.clear();
        rig.run_to(Ticks::from_seconds(end_s + 0.5))?;
        let after = (
            rig.truth().charge_c,
            rig.view.charge_c().value.context("no charge came")?,
        );
        let error_c = (after.1 - before.1) - (after.0 - before.0);
        let throughput_c: f64 = profile
            .windows(2)
            .map(|pair| {
                (pair[0].current_a.abs() + pair[1].current_a.abs()) / 2.0
                    * (pair[1].t_s - pair[0].t_s)
            })
            .sum();
        let conditions = format!(
            "the same drive, {duration_s:.0} s; small sensor +1 % and 0.3 A, large −1 % and 3 A, calibrated over Modbus by the meter's mean at {known:?} A; diagnoses: {:?}",
            rig.view.diagnoses.keys().collect::<Vec<_>>()
        );
        let share = 100.0 * error_c.abs() / throughput_c;
        self.add(
            "charge error with calibrated sensor errors",
            share,
            "%",
            Some(Bound::AtMost(0.5)),
            conditions,
        );
        Ok(())
    }
}

fn names(figures: &Figures) -> String {
    let names: Vec<_> = figures
        .diagnoses
        .iter()
        .map(|event| event.name.as_str())
        .collect();
    if names.is_empty() {
        "none".to_owned()
    } else {
        names.join(", ")
    }
}

// Holding registers, by docs/modbus.md.
const CURRENT_GAIN: u16 = 0x0216;
const ZERO_DRIFT: u16 = 0x0300;
const METER_GAIN: u16 = 0x0500;
const KEY_CALIBRATION: u16 = 0x0400;

/// Two signed 32-bit settings, the upper word first.
#[expect(
    clippy::cast_possible_truncation,
    reason = "currents and shares of a sensor"
)]
fn pair(small: f64, large: f64) -> [u16; 4] {
    let words = |value: f64| {
        let [a, b, c, d] = (value.round() as i32).to_be_bytes();
        [u16::from_be_bytes([a, b]), u16::from_be_bytes([c, d])]
    };
    let ([a, b], [c, d]) = (words(small), words(large));
    [a, b, c, d]
}

fn write(rig: &mut Rig<'_>, address: u16, words: &[u16]) -> Result<()> {
    let [high, low] = address.to_be_bytes();
    #[expect(clippy::cast_possible_truncation, reason = "four words at most")]
    let count = words.len() as u8;
    let mut request = vec![1, 0x10, high, low, 0, count, 2 * count];
    request.extend(words.iter().flat_map(|word| word.to_be_bytes()));
    let answer = rig.modbus(&request)?;
    if answer.get(1) != Some(&0x10) {
        bail!("writing {words:?} to {address:#06X} was answered by {answer:02X?}");
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_says_what_holds_and_what_does_not() {
        let figure = |value: f64, bound| Figure {
            name: "time",
            value,
            unit: "ms",
            bound,
            conditions: "none".to_owned(),
        };
        let figures = [
            figure(1.5, Some(Bound::AtMost(2.0))),
            figure(1.5, Some(Bound::AtLeast(2.0))),
            figure(0.25, None),
        ];
        assert_eq!(figures.each_ref().map(Figure::holds), [true, false, true]);
        let text = Table(&figures).to_string();
        assert!(
            text.contains("| time | 1.500 ms | ≤ 2 | yes | none |"),
            "{text}"
        );
        assert!(
            text.contains("| time | 1.500 ms | ≥ 2 | **no** | none |"),
            "{text}"
        );
        assert!(
            text.contains("| time | 0.25000 ms |  |  | none |"),
            "{text}"
        );
    }

    #[test]
    fn settings_go_out_with_the_upper_word_first() {
        assert_eq!(pair(1.0, -2.0), [0, 1, 0xFFFF, 0xFFFE]);
        assert_eq!(pair(70_000.4, 0.0), [1, 4_464, 0, 0]);
    }
}
