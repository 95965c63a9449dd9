//! A drive on the emulated board, with everything written down: what `cargo xtask emulate` does.

use std::collections::VecDeque;
use std::fmt::Write as _;
use std::io::{BufWriter, Write as _};
use std::path::{Path, PathBuf};
use std::time::Instant as Clock;

use anyhow::{Context as _, Result};
use serde::Serialize;

use core_logic::can::layout;
use core_logic::error_budget::{ProfileSummary, charge_bound, no_load};
use core_logic::units::{Duration, Microamps};
use plant::violations::{Occurrences, Violations};
use recording::csv::Writer;
use recording::output::{self, Folder, WholeFile};

use crate::board::{Snapshot, TruthSample};
use crate::bus_view::BusView;
use crate::calibration::Account;
use crate::can_bus::LoggedFrame;
use crate::can_frame::CanFrame;
use crate::profile::SENSOR_RANGE_A;
use crate::rig::{Firmware, Rig, Setup};
use crate::rs485_line::{Direction, LogEntry};
use crate::serve;
use crate::time::Ticks;

/// What a drive leaves behind.
#[derive(Clone, Debug)]
pub struct Outputs {
    /// candump -L of everything on the bus.
    pub can_log: PathBuf,
    /// The board's own account beside the truth, as a canonical recording.
    pub recording: PathBuf,
    /// RS485, both directions.
    pub rs485_log: PathBuf,
    /// The image's log.
    pub defmt_log: PathBuf,
    /// The summary as the terminal shows it.
    pub summary_text: PathBuf,
    /// The summary for programs.
    pub summary_json: PathBuf,
}

impl Outputs {
    /// The files of a folder.
    pub fn in_folder(folder: &Path) -> Self {
        Self {
            can_log: folder.join("can.log"),
            recording: folder.join("board.csv"),
            rs485_log: folder.join("rs485.log"),
            defmt_log: folder.join("defmt.log"),
            summary_text: folder.join("summary.txt"),
            summary_json: folder.join("summary.json"),
        }
    }

    /// All of them.
    pub fn all(&self) -> [&Path; 6] {
        [
            &self.can_log,
            &self.recording,
            &self.rs485_log,
            &self.defmt_log,
            &self.summary_text,
            &self.summary_json,
        ]
    }
}

/// The figures of a drive.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Figures {
    /// What was written to the board before the drive.
    pub calibration: Option<Account>,
    /// Length of the run, in s of virtual time.
    pub length_s: f64,
    /// Wall-clock time that it took, in s.
    pub took_s: f64,
    /// ∫ i dt from the first to the newest charge frame, in C.
    pub true_charge_c: f64,
    /// ∫ abs(i) dt over the run, in C.
    pub throughput_c: f64,
    /// The board's charge less the true one, in C; `None` before the first charge frame.
    pub charge_error_c: Option<f64>,
    /// The bound that the error budget gives for ideal sensors, in C.
    pub charge_bound_c: f64,
    /// Changes of the range flag.
    pub edges: u64,
    /// Changes of the range flag that no charge snapshot has answered.
    pub unanswered: u64,
    /// From a range edge to the latching of AENERGY.
    pub latched: Latency,
    /// From a range edge to the value in the MCU.
    pub read: Latency,
    /// From power-on to the end of the first valid current frame, in s.
    pub first_valid_s: Option<f64>,
    /// Shortest time between two current frames after the first second, in s.
    pub shortest_current_period_s: f64,
    /// Longest time between two current frames after the first second, in s.
    pub longest_current_period_s: f64,
    /// Share of the time that the core executed, 0 … 1.
    pub load: f64,
    /// Instructions executed.
    pub instructions: u64,
    /// Share of the time that the CAN bus was busy, 0 … 1.
    pub can_load: f64,
    /// Frames that the board sent.
    pub frames: u64,
    /// Of those, the ones with a wrong CRC or data ID, and the ones that can/board.dbc does not know.
    pub wrong_frames: u64,
    /// Diagnoses that were raised, and when first.
    pub diagnoses: Vec<Event>,
    /// Resets after the power-on, by cause.
    pub resets: Vec<Event>,
    /// What the chips' data sheets forbid and the firmware did all the same.
    pub violations: Vec<Breach>,
    /// How often an input of the ADE7753 went beyond the range for which it is specified.
    pub meter_over_range: u64,
    /// The largest current of the drive, in A.
    pub largest_a: f64,
}

/// A rule of a chip's data sheet that was broken.
#[derive(Clone, Debug, Serialize)]
pub struct Breach {
    /// The chip.
    pub chip: String,
    /// The rule, by its name in `plant`.
    pub rule: String,
    /// How often.
    pub count: u64,
    /// When last, in s.
    pub last_s: f64,
}

fn breaches<K: std::fmt::Debug + Copy + Ord>(
    chip: &str,
    violations: &Violations<K>,
) -> Vec<Breach> {
    let breach = |(kind, times): (K, Occurrences)| Breach {
        chip: chip.to_owned(),
        rule: format!("{kind:?}"),
        count: times.count,
        last_s: times.last_s,
    };
    violations.iter().map(breach).collect()
}

/// Times that something took.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Latency {
    /// Half of them took no longer, in s.
    pub median_s: f64,
    /// The longest, in s.
    pub worst_s: f64,
}

/// Something that happened.
#[derive(Clone, Debug, Serialize)]
pub struct Event {
    /// What.
    pub name: String,
    /// When, in s.
    pub at_s: f64,
}

/// Median and largest of some times; 0 if there are none.
fn latency(times: impl Iterator<Item = Ticks>) -> Latency {
    let mut times: Vec<Ticks> = times.collect();
    times.sort_unstable();
    let seconds = |ticks: Option<&Ticks>| ticks.map_or(0.0, |ticks| ticks.seconds());
    Latency {
        median_s: seconds(times.get(times.len() / 2)),
        worst_s: seconds(times.last()),
    }
}

/// Time between two looks at what the machine puts out.
const SLICE: Ticks = Ticks::from_millis(10);
/// Time between two samples of the truth.
const SAMPLE: Ticks = Ticks::from_millis(1);
/// Boot and self-test are over after this; periods count from here on.
const SETTLED_S: f64 = 1.0;
/// What a new board says although nothing is wrong: before the battery has rested it knows no state of charge.
const EXPECTED: &str = "SocUncertain";
/// What it says after it was written to and switched off: the charge since the last record is gone, of a parked car none.
const EXPECTED_AFTER_CALIBRATION: &str = "ChargeRestoredWithLoss";
/// Rows stand at what bends the current by more than this between two samples of the truth, in A.
const BEND_A: f64 = 0.01;
/// Lines of the image's log that are kept for a message.
const LAST_WORDS: usize = 10;

/// A board with everything that is written down about it.
pub struct Drive<'firmware> {
    /// The board.
    pub rig: Rig<'firmware>,
    sink: Option<Sink>,
    charge: ChargeAccount,
    flow: Flow,
    settled: bool,
    last_words: VecDeque<String>,
    for_clients: Option<Vec<(f64, CanFrame)>>,
    started: Clock,
}

impl<'firmware> Drive<'firmware> {
    /// A board before its power comes on. Its outputs will be in `folder`, if one is given, once [`Drive::finish`] has been
    /// called.
    ///
    /// # Errors
    /// If the folder cannot be written.
    pub fn new(firmware: &'firmware Firmware, setup: Setup, folder: Option<&Path>) -> Result<Self> {
        let mut rig = Rig::new(firmware, setup)?;
        rig.keep_frames = true;
        rig.machine.board(|board| board.trace(SAMPLE));
        Ok(Self {
            rig,
            sink: folder.map(Sink::create).transpose()?,
            charge: ChargeAccount::default(),
            flow: Flow::default(),
            settled: false,
            last_words: VecDeque::new(),
            for_clients: None,
            started: Clock::now(),
        })
    }

    /// Keeps frames for the clients of a served board too.
    pub fn keep_for_clients(&mut self) {
        self.for_clients = Some(Vec::new());
    }

    /// Runs until `end_s`, as long as `go_on`, told the time in s, says so; whether it came to the end.
    ///
    /// # Errors
    /// If the image does what is not modelled, or a file cannot be written.
    pub fn run_to(&mut self, end_s: f64, mut go_on: impl FnMut(f64) -> bool) -> Result<bool> {
        let end = Ticks::from_seconds(end_s);
        while self.rig.machine.now() < end {
            if !go_on(self.rig.now_s()) {
                return Ok(false);
            }
            self.slice((self.rig.machine.now() + SLICE).min(end))?;
        }
        Ok(true)
    }

    fn slice(&mut self, end: Ticks) -> Result<()> {
        let result = self.rig.run_to(end);
        let rig = &mut self.rig;
        self.charge.note(rig);
        if !self.settled && rig.now_s() >= SETTLED_S {
            self.settled = true;
            rig.view.restart_periods();
        }
        let samples = rig.machine.board(|board| board.take_trace());
        samples.iter().for_each(|sample| self.flow.note(sample));
        let frames = std::mem::take(&mut rig.frames);
        let log = std::mem::take(&mut rig.log);
        let line = rig.machine.board(|board| board.line.take_log());
        if let Some(sink) = &mut self.sink {
            sink.take(&frames, &log, &line, samples)?;
        }
        if let Some(kept) = &mut self.for_clients {
            kept.extend(
                frames
                    .iter()
                    .map(|logged| (logged.at.seconds(), logged.frame)),
            );
        }
        self.last_words.extend(log);
        let superfluous = self.last_words.len().saturating_sub(LAST_WORDS);
        self.last_words.drain(..superfluous);
        result
    }

    /// The newest lines of the image's log.
    pub fn last_words(&self) -> impl Iterator<Item = &str> {
        self.last_words.iter().map(String::as_str)
    }

    /// The figures so far.
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "of positive numbers within range"
    )]
    pub fn figures(&mut self) -> Figures {
        let Self {
            rig,
            charge,
            flow,
            started,
            ..
        } = self;
        let truth = rig.truth();
        let length_s = rig.now_s();
        let micros = |seconds: f64| Duration::from_ticks((seconds * 1e6) as u64);
        let rms_a = (flow.squares_a2s / length_s.max(1e-9)).sqrt();
        let bound = charge_bound(&ProfileSummary {
            duration: micros(length_s),
            in_large: micros(truth.large_s),
            rms_current: Microamps((rms_a * 1e6) as i32),
            edges: truth.edges as u32,
            below_no_load: micros(flow.below_no_load_s),
            // Edges in quick succession would widen the bound: without them it is the narrower one.
            chatter: Duration::from_ticks(0),
            chatter_squares: 0,
            chatter_runs: 0,
        });
        let (true_charge_c, board_charge_c) = charge.flowed_c();
        let latency_of = |of: fn(&Snapshot) -> Ticks| {
            latency(
                rig.snapshots
                    .iter()
                    .map(|snapshot| of(snapshot).since(snapshot.edge)),
            )
        };
        let (latched, read) = (
            latency_of(|snapshot| snapshot.latched),
            latency_of(|snapshot| snapshot.read),
        );
        let period = rig.view.period("Current");
        let violations = rig.machine.board(|board| {
            [
                breaches("ADE7753", board.meter.violations()),
                breaches("ADS1100", board.converter.violations()),
                breaches("W25Q32", board.flash.violations()),
            ]
            .concat()
        });
        Figures {
            length_s,
            took_s: started.elapsed().as_secs_f64(),
            true_charge_c,
            throughput_c: flow.throughput_c,
            charge_error_c: charge.first.map(|_| board_charge_c - true_charge_c),
            charge_bound_c: bound.ideal_sensor.get() as f64 * 1e-9,
            edges: truth.edges,
            unanswered: truth.edges.saturating_sub(rig.snapshots.len() as u64),
            latched,
            read,
            first_valid_s: rig.view.first_valid_current.map(Ticks::seconds),
            shortest_current_period_s: period.shortest_s,
            longest_current_period_s: period.longest_s,
            load: rig.machine.load().share(),
            instructions: rig.machine.instructions(),
            can_load: rig.machine.can(|can| can.busy()).seconds() / length_s.max(1e-9),
            frames: rig.machine.can(|can| can.counters()).from_board,
            wrong_frames: rig.view.broken_frames + rig.view.unknown_frames,
            diagnoses: rig
                .view
                .diagnoses
                .iter()
                .map(|(name, at)| Event {
                    name: (*name).to_owned(),
                    at_s: at.seconds(),
                })
                .collect(),
            resets: rig
                .machine
                .resets()
                .iter()
                .skip(1)
                .map(|reset| Event {
                    name: format!("{:?}", reset.cause),
                    at_s: reset.at.seconds(),
                })
                .collect(),
            violations,
            meter_over_range: rig.machine.board(|board| board.meter.over_range()),
            largest_a: flow.largest_a,
            calibration: None,
        }
    }

    /// Gives the files their names, with `text` and `json` as the summary.
    ///
    /// # Errors
    /// If a file cannot be written.
    pub fn finish(self, text: &str, json: &str) -> Result<()> {
        self.sink.map_or(Ok(()), |sink| sink.finish(text, json))
    }
}

/// For clients on CAN and RS485.
impl serve::Board for Drive<'_> {
    fn run_for(&mut self, us: u64) -> Result<()> {
        self.slice(self.rig.machine.now() + Ticks::from_micros(us))
    }

    fn now_s(&self) -> f64 {
        self.rig.now_s()
    }

    fn inject_can(&mut self, frame: CanFrame) {
        self.rig.send_can(frame);
    }

    fn take_can(&mut self) -> Vec<(f64, CanFrame)> {
        self.for_clients
            .as_mut()
            .map_or_else(Vec::new, std::mem::take)
    }

    fn inject_rs485(&mut self, bytes: &[u8]) {
        self.rig.send_rs485(bytes);
    }

    fn take_rs485(&mut self) -> Vec<u8> {
        self.rig.take_rs485()
    }
}

/// Compares the meter's charge with the truth between the first and the newest moment at which both are known. The frame
/// is some milliseconds older than the truth: a drive that begins and ends at rest makes nothing of that.
#[derive(Default)]
struct ChargeAccount {
    first: Option<(f64, f64)>,
    newest: (f64, f64),
    seen_at: Option<Ticks>,
}

impl ChargeAccount {
    fn note(&mut self, rig: &mut Rig<'_>) {
        let at = rig.view.last_at("Charge");
        if at == self.seen_at {
            return;
        }
        self.seen_at = at;
        let Some(board_c) = rig.view.charge_c().value else {
            return;
        };
        let truth_c = rig.truth().charge_c;
        self.first.get_or_insert((truth_c, board_c));
        self.newest = (truth_c, board_c);
    }

    fn flowed_c(&self) -> (f64, f64) {
        let (truth_0, board_0) = self.first.unwrap_or(self.newest);
        (self.newest.0 - truth_0, self.newest.1 - board_0)
    }
}

/// What flowed, from the samples of the truth.
#[derive(Default)]
struct Flow {
    last_s: f64,
    throughput_c: f64,
    squares_a2s: f64,
    below_no_load_s: f64,
    largest_a: f64,
}

impl Flow {
    fn note(&mut self, sample: &TruthSample) {
        let length_s = sample.t_s - self.last_s;
        self.last_s = sample.t_s;
        let current_a = sample.current_a;
        self.largest_a = self.largest_a.max(current_a.abs());
        self.throughput_c += current_a.abs() * length_s;
        self.squares_a2s += current_a * current_a * length_s;
        // The budget's own threshold, in µA.
        if current_a.abs() * 1e6 < no_load() as f64 {
            self.below_no_load_s += length_s;
        }
    }
}

/// The files, written while it runs, named when it is done.
struct Sink {
    can_log: BufWriter<WholeFile>,
    rs485_log: BufWriter<WholeFile>,
    defmt_log: BufWriter<WholeFile>,
    recording: Writer,
    /// The board as its frames tell of it, one after the other: the rig's own view is ahead.
    view: BusView,
    /// Frames for whose end the truth is not known yet.
    frames: VecDeque<LoggedFrame>,
    /// The one before the newest row and all after it.
    samples: VecDeque<TruthSample>,
    /// Since the last row of the recording.
    news: News,
    /// The last field: it is dropped when the unfinished files are gone.
    folder: Folder,
}

/// What has been on the bus since the last row.
#[derive(Default)]
struct News {
    /// `CurrentConversions` of the last row.
    conversions: Option<f64>,
    charge: bool,
    environment: bool,
    soc: bool,
}

/// Columns of the board's account.
const COLUMNS: [&str; 11] = [
    "t_s",
    "i_ref_a",
    "i_meas_a",
    "q_ref_c",
    "q_meas_c",
    "range_high",
    "v_supply_v",
    "temp_sensor_c",
    "i_aux_a",
    "v_cell_v",
    "soc_pct",
];

impl Sink {
    fn create(folder: &Path) -> Result<Self> {
        let files = Outputs::in_folder(folder);
        let folder = Folder::make(folder)?;
        let open = |path: &Path| -> Result<BufWriter<WholeFile>> {
            Ok(BufWriter::new(WholeFile::create(path)?))
        };
        Ok(Self {
            can_log: open(&files.can_log)?,
            rs485_log: open(&files.rs485_log)?,
            defmt_log: open(&files.defmt_log)?,
            recording: Writer::create(&files.recording, &COLUMNS)?,
            view: BusView::default(),
            frames: VecDeque::new(),
            samples: VecDeque::new(),
            news: News::default(),
            folder,
        })
    }

    fn take(
        &mut self,
        frames: &[LoggedFrame],
        log: &[String],
        line: &[LogEntry],
        samples: Vec<TruthSample>,
    ) -> Result<()> {
        for text in log {
            writeln!(self.defmt_log, "{text}").context("writing defmt.log")?;
        }
        for entry in line {
            writeln!(self.rs485_log, "{}", rs485_line(entry)).context("writing rs485.log")?;
        }
        self.samples.extend(samples);
        for logged in frames {
            writeln!(
                self.can_log,
                "({:.6}) can0 {}",
                logged.at.seconds(),
                logged.frame
            )
            .context("writing can.log")?;
            if logged.from_board {
                self.frames.push_back(*logged);
            }
        }
        while let Some(logged) = self.frames.front().copied() {
            // Nearly all of the time the newest sample is from the end of this slice.
            if !self.truth_until(logged.at.seconds())? {
                break;
            }
            self.frames.pop_front();
            self.view.take(logged.at, &logged.frame);
            self.tell(&logged)?;
        }
        Ok(())
    }

    /// Brings the two samples around `at_s` to the front, with a row for each bend of the current on the way; `false` if the
    /// second one has not come yet.
    ///
    /// Without these rows a straight line from row to row would cut the corners of the truth.
    fn truth_until(&mut self, at_s: f64) -> Result<bool> {
        loop {
            let Some(next) = self.samples.get(1).copied() else {
                return Ok(false);
            };
            if next.t_s > at_s {
                return Ok(true);
            }
            let Some(after) = self.samples.get(2) else {
                return Ok(false);
            };
            let bend_a = after.current_a - 2.0 * next.current_a + self.samples[0].current_a;
            self.samples.pop_front();
            if bend_a.abs() > BEND_A && next.t_s < at_s {
                self.row(next.t_s, &News::default(), false)?;
            }
        }
    }

    /// Each current frame and each charge frame makes a row. What is slower is in the first row after it came, and in between
    /// its field is empty: nobody shall take a held value for a measured one.
    fn tell(&mut self, logged: &LoggedFrame) -> Result<()> {
        let is = |header: &layout::Header| logged.frame.id == u32::from(header.id);
        let charge = is(&layout::charge::HEADER);
        if is(&layout::environment::HEADER) {
            self.news.environment = true;
        } else if is(&layout::state_of_charge::HEADER) {
            self.news.soc = true;
        }
        let at_s = logged.at.seconds();
        if charge {
            let news = News {
                charge,
                ..News::default()
            };
            return self.row(at_s, &news, false);
        }
        if !is(&layout::current::HEADER) {
            return Ok(());
        }
        let conversions = self.view.signal("Current", "CurrentConversions");
        let news = News {
            conversions,
            ..News::default()
        };
        let before = std::mem::replace(&mut self.news, news);
        let converted = conversions != before.conversions;
        self.row(at_s, &before, converted)
    }

    /// A row of the recording, with what is new in it. What the board marks as not valid is missing, as `twin convert` leaves
    /// it out.
    fn row(&mut self, at_s: f64, news: &News, converted: bool) -> Result<()> {
        let Some(sample) = self.samples.front() else {
            return Ok(());
        };
        let next = self.samples.get(1).unwrap_or(sample);
        let length_s = next.t_s - sample.t_s;
        let share = if length_s > 0.0 {
            ((at_s - sample.t_s) / length_s).clamp(0.0, 1.0)
        } else {
            0.0
        };
        let between = |from: f64, to: f64| from + (to - from) * share;
        // As in can.log, so that the two can be laid side by side.
        let stamp_s = (at_s * 1e6).round() / 1e6;
        let view = &self.view;
        let new = |is_new: bool, value: Option<f64>| value.filter(|_| is_new).unwrap_or(f64::NAN);
        self.recording.row(&[
            stamp_s,
            between(sample.current_a, next.current_a),
            new(converted, view.current_a().valid()),
            between(sample.charge_c, next.charge_c),
            new(news.charge, view.charge_c().valid()),
            new(true, view.signal("Current", "CurrentRange")),
            new(news.environment, view.supply_v().valid()),
            new(news.environment, view.sensor_c().valid()),
            sample.row.aux_current_a,
            new(true, sample.row.cell_v),
            new(news.soc, view.soc_pct().valid()),
        ])?;
        Ok(())
    }

    fn finish(mut self, text: &str, json: &str) -> Result<()> {
        // The truth ends a sample before the run does.
        while let Some(logged) = self.frames.pop_front() {
            self.truth_until(logged.at.seconds())?;
            self.view.take(logged.at, &logged.frame);
            self.tell(&logged)?;
        }
        let files = Outputs::in_folder(self.folder.path());
        let mut finished = vec![self.recording.into_file()];
        for file in [self.can_log, self.rs485_log, self.defmt_log] {
            finished.push(file.into_inner().map_err(|error| error.into_error())?);
        }
        for (path, content) in [(&files.summary_text, text), (&files.summary_json, json)] {
            let mut file = WholeFile::create(path)?;
            file.write_all(content.as_bytes())
                .map_err(|error| recording::Error::writing(path, &error))?;
            finished.push(file);
        }
        Ok(output::finish_all(finished)?)
    }
}

/// Time, direction and byte.
fn rs485_line(entry: &LogEntry) -> String {
    let direction = match entry.direction {
        Direction::ToBoard => "to board",
        Direction::FromBoard => "from board",
    };
    let character = entry.character;
    let mut line = format!(
        "{:.6} {direction} {:02X}",
        entry.at.seconds(),
        character.byte
    );
    for (is, what) in [
        (character.parity_error, "parity"),
        (character.framing_error, "framing"),
        (character.noise, "noise"),
    ] {
        if is {
            line.push(' ');
            line.push_str(what);
        }
    }
    line
}

/// What speaks against the board in a drive without a fault: nothing, if all is well.
pub fn complaints(figures: &Figures) -> Vec<String> {
    let mut complaints = Vec::new();
    match figures.charge_error_c {
        Some(error_c) if error_c.abs() > figures.charge_bound_c => complaints.push(format!(
            "the charge error of {error_c:.3} As is beyond the bound of {:.3} As",
            figures.charge_bound_c
        )),
        Some(_) => {}
        None => complaints.push("no charge came".to_owned()),
    }
    if figures.first_valid_s.is_none() {
        complaints.push("no valid current came".to_owned());
    }
    if figures.unanswered > 0 {
        complaints.push(format!(
            "{} range changes without a charge snapshot",
            figures.unanswered
        ));
    }
    if figures.wrong_frames > 0 {
        complaints.push(format!(
            "{} frames with a wrong CRC or identifier",
            figures.wrong_frames
        ));
    }
    let raised = |event: &Event| format!("diagnosis {} at {:.3} s", event.name, event.at_s);
    let unexpected = |event: &&Event| {
        event.name != EXPECTED
            && (figures.calibration.is_none() || event.name != EXPECTED_AFTER_CALIBRATION)
    };
    complaints.extend(figures.diagnoses.iter().filter(unexpected).map(raised));
    let reset = |event: &Event| format!("reset by {} at {:.3} s", event.name, event.at_s);
    complaints.extend(figures.resets.iter().map(reset));
    let breach = |breach: &Breach| {
        format!(
            "{}: {} against the data sheet, {} times, last at {:.3} s",
            breach.chip, breach.rule, breach.count, breach.last_s
        )
    };
    complaints.extend(figures.violations.iter().map(breach));
    // At the end of its range the current itself may be the reason.
    if figures.meter_over_range > 0 && figures.largest_a < SENSOR_RANGE_A {
        complaints.push(format!(
            "ADE7753: an input {} at no more than {:.1} A",
            over_range(figures.meter_over_range),
            figures.largest_a
        ));
    }
    complaints
}

fn over_range(times: u64) -> String {
    format!("beyond its range {times} times")
}

/// The figures as the terminal shows them.
pub fn summary(figures: &Figures) -> String {
    let mut text = String::new();
    let mut line = |name: &str, value: String| {
        // Writing to a string cannot fail.
        let _ = writeln!(text, "{name:<16}{value}");
    };
    if let Some(account) = &figures.calibration {
        line(
            "calibration",
            format!(
                "{} registers written, read back and saved over RS485 in {:.2} s before the drive",
                account.registers, account.length_s
            ),
        );
    }
    line(
        "charge",
        format!(
            "{:.3} As out net, {:.1} As both ways in {:.1} s",
            figures.true_charge_c, figures.throughput_c, figures.length_s
        ),
    );
    line(
        "charge error",
        figures.charge_error_c.map_or_else(
            || "unknown: no charge came".to_owned(),
            |error_c| {
                format!(
                    "{error_c:+.3} As, {:+.5} % of both ways (bound behind ideal sensors ±{:.3} As)",
                    100.0 * error_c / figures.throughput_c.max(1e-9),
                    figures.charge_bound_c
                )
            },
        ),
    );
    line(
        "range changes",
        format!(
            "{}, {} without a charge snapshot",
            figures.edges, figures.unanswered
        ),
    );
    if figures.edges > 0 {
        let micros = |latency: Latency| {
            format!(
                "{:.1} µs median, {:.1} µs worst",
                latency.median_s * 1e6,
                latency.worst_s * 1e6
            )
        };
        line("edge to latch", micros(figures.latched));
        line("edge to value", micros(figures.read));
    }
    line(
        "first valid",
        figures.first_valid_s.map_or_else(
            || "never".to_owned(),
            |s| format!("{:.1} ms after power-on", s * 1e3),
        ),
    );
    line(
        "current frames",
        format!(
            "every {:.3} … {:.3} ms",
            figures.shortest_current_period_s * 1e3,
            figures.longest_current_period_s * 1e3
        ),
    );
    line(
        "load",
        format!(
            "CPU {:.2} %, CAN {:.1} %, {} frames sent",
            100.0 * figures.load,
            100.0 * figures.can_load,
            figures.frames
        ),
    );
    if figures.meter_over_range > 0 {
        line(
            "ADE7753",
            format!("an input {}", over_range(figures.meter_over_range)),
        );
    }
    let complaints = complaints(figures);
    line(
        "against it",
        if complaints.is_empty() {
            "nothing".to_owned()
        } else {
            complaints.join("; ")
        },
    );
    line(
        "took",
        format!(
            "{:.2} s: {:.1} times real time, {:.1} million instructions/s",
            figures.took_s,
            figures.length_s / figures.took_s.max(1e-9),
            figures.instructions as f64 / figures.took_s.max(1e-9) * 1e-6
        ),
    );
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A sensor that the drive does not take to its end has no business beyond the meter's range; one at its end may.
    #[test]
    fn an_input_beyond_the_meters_range_is_shown_and_speaks_against_the_board() {
        let good = complaints(&Figures::default()).len();
        for (largest_a, meter_over_range, against) in
            [(300.0, 0, 0), (300.0, 2, 1), (600.0, 2, 0), (600.0, 0, 0)]
        {
            let figures = Figures {
                largest_a,
                meter_over_range,
                ..Figures::default()
            };
            let complaints = complaints(&figures);
            assert_eq!(complaints.len(), good + against, "{complaints:?}");
            let shown = summary(&figures).contains("beyond its range 2 times");
            assert_eq!(shown, meter_over_range > 0);
        }
    }
}
