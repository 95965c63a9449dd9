//! From recording and model file to problems: one for each signal that can be compared.
//!
//! Nothing is invented: a missing reading is masked, a row without a reference is not part of the drive, a reading that a
//! sensor merely holds counts once. Only the surroundings (temperatures, supply) are held over gaps.

mod battery;
mod charge;
pub mod checks;
mod codes;
mod counter;
mod frame;
mod held;
mod phase;
mod series;
mod slips;
mod stairs;
mod stamps;
mod start;

use std::{path::PathBuf, sync::Arc};

use recording::name;

pub use frame::Frame;
use held::is_held;
pub use held::{Freshness, freshness};

use crate::{
    align,
    effects::{find_with, lacks},
    explain,
    failure::Failure,
    model::{Model, Sensor, registry},
    problem::{
        Accuracy, Base, Coloured, Drive, Holds, Observed, Problem, SensorBase, Series, View,
    },
    report::format::count,
    simulate::board::{Board, Pace},
};

/// Fewest readings that are compared: below, no held-out block is long enough to say anything.
pub const FEWEST_ROWS: usize = 50;

/// Columns of a reference and of the sensor beside it, in the order in which they are looked for.
const PAIRS: [(&str, &str); 2] = [("i_ref_a", "i_meas_a"), ("p_ref_w", "p_meas_w")];

/// Columns of what surrounds the sensor and the battery.
const SURROUNDINGS: [&str; 6] = [
    "temp_sensor_c",
    "v_supply_v",
    "i_aux_a",
    "range_high",
    "temp_cell_c",
    "temp_ambient_c",
];

/// What is read.
#[derive(Clone, Debug, Default)]
pub struct Inputs {
    /// The recording.
    pub recording: PathBuf,
    /// A second recording with the reference, on a clock of its own.
    pub reference: Option<PathBuf>,
    /// `NAME=COLUMN`.
    pub mapping: Vec<String>,
}

/// What for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Purpose {
    /// To compare: what was recorded of each signal has to be there, and plausible.
    Compare,
    /// To compare a file that is never fitted: the same, but it begins at a state of charge of its own.
    HoldOut,
    /// To simulate: the drive is enough. It begins as a file that is never fitted does.
    Simulate,
}

impl Purpose {
    /// Whether readings are compared.
    pub fn compares(self) -> bool {
        matches!(self, Self::Compare | Self::HoldOut)
    }
}

/// A problem and where its rows are from.
#[derive(Clone, Debug)]
pub struct Item {
    /// The problem.
    pub problem: Problem,
    /// Row of the recording that each observed row is from.
    pub rows: Arc<Vec<usize>>,
    /// When the board's conversions end, for a sensor.
    pub pace: Pace,
    /// Rows at which a board's new conversion shows for the first time; empty: all.
    pub fresh: Vec<bool>,
}

/// Mean square of the width of a board's reading: the step of the range that it is in, and what the current moves by while the
/// moment is uncertain, by the board's jitter and by what the rows tell of it.
fn squared_width(
    sensor: &Sensor,
    slack_s: f64,
    base: &SensorBase,
    observed: &Observed,
    high: &[f64],
) -> f64 {
    let (mut rows, mut large) = (0.0, 0.0);
    let (mut pairs, mut slopes) = (0.0, 0.0);
    let mut last: Option<usize> = None;
    for row in (0..observed.t_s.len()).filter(|row| observed.valid[*row]) {
        rows += 1.0;
        large += f64::from(u8::from(high[row] > 0.5));
        if let Some(before) = last
            && observed.segment_of(before) == observed.segment_of(row)
        {
            let step_s = observed.t_s[row] - observed.t_s[before];
            let slope = (base.reading[row] - base.reading[before]) / step_s;
            if slope.is_finite() {
                pairs += 1.0;
                slopes += slope * slope;
            }
        }
        last = Some(row);
    }
    let share = large / f64::max(rows, 1.0);
    let steps = base.step.powi(2) * (1.0 - share + share * base.range_ratio.max(1.0).powi(2));
    let moments = sensor.jitter_s.powi(2) + slack_s.powi(2);
    steps + moments * slopes / f64::max(pairs, 1.0)
}

/// Ages that are tried to either side where the rows do not tell the age of a reading.
const PHASES: i32 = 10;

/// Everything that explaining and simulating need.
#[derive(Clone, Debug)]
pub struct Prepared {
    /// The problems.
    pub items: Vec<Item>,
    /// What the reader has to know about the input.
    pub remarks: Vec<String>,
    /// Time of each row of the recording, in s, on its own clock.
    pub t_s: Vec<f64>,
}

impl Prepared {
    /// The problems alone.
    pub fn into_problems(self) -> Vec<Problem> {
        self.items.into_iter().map(|item| item.problem).collect()
    }
}

/// Reads and checks.
pub fn prepare(model: &Model, inputs: &Inputs, purpose: Purpose) -> Result<Prepared, Failure> {
    let (frame, reference) = frame::read(model, inputs)?;
    let mut work = Work {
        model,
        frame: &frame,
        reference: reference.as_ref(),
        purpose,
        remarks: Vec::new(),
        clock: None,
    };
    for frame in [Some(&frame), reference.as_ref()].into_iter().flatten() {
        checks::time_goes_on(frame)?;
        for remark in checks::surroundings(frame)? {
            work.remark(remark);
        }
        if let Some(remark) = checks::milliseconds(frame)? {
            work.remark(remark);
        }
        for remark in frame.remarks() {
            work.remark(remark.clone());
        }
        if !frame.notes().is_empty() {
            work.remark(format!("{}: {}", frame.source(), frame.notes().join("; ")));
        }
        let left_out = frame.left_out();
        if !left_out.is_empty() {
            work.remark(format!(
                "columns of {} without numbers are left out: {}",
                frame.source(),
                left_out.join(", ")
            ));
        }
    }
    let mut items = Vec::new();
    if let Some(sensor) = &model.sensor {
        items.extend(work.sensor(sensor)?);
    }
    if let Some(battery) = &model.battery {
        items.extend(battery::items(&mut work, battery)?);
    }
    if items.is_empty() {
        return Err(nothing_to_compare(model, &frame));
    }
    if purpose.compares() {
        work.not_compared(&items);
    }
    for item in &mut items {
        model_effects(model, item)?;
        if purpose.compares()
            && let Some(remark) = slips::leave_out(&mut item.problem)
        {
            work.remark(remark);
        }
    }
    if purpose.compares() {
        work.few_of_a_counter(&mut items);
        for item in &items {
            checks::enough(&item.problem, frame.source())?;
        }
    }
    for item in &items {
        checks::can_be_simulated(model, &item.problem, purpose, frame.source())?;
    }
    let sources = [Some(&frame), reference.as_ref()];
    for remark in without_columns(
        model,
        &items,
        &sources.map(|frame| frame.map(Frame::source)),
    ) {
        work.remark(remark);
    }
    // One battery is behind all of its columns.
    let of_view = |view| items.iter().find(|item| item.problem.view == view);
    if let Some(remark) = of_view(View::Voltage)
        .or_else(|| of_view(View::StateOfCharge))
        .and_then(|item| battery::out_of_charge(&item.problem))
    {
        work.remark(remark);
    }
    if let Some(remark) =
        of_view(View::Voltage).and_then(|item| battery::beyond_known(&item.problem))
    {
        work.remark(remark);
    }
    if let Some(remark) =
        of_view(View::Voltage).and_then(|item| battery::other_cells(&item.problem))
    {
        work.remark(remark);
    }
    if let Some(remark) = battery::in_thousandths(model) {
        work.remark(remark);
    }
    if let Some(remark) = supply_without_range(&items) {
        work.remark(remark);
    }
    Ok(Prepared {
        items,
        remarks: work.remarks,
        t_s: frame.t_s().to_vec(),
    })
}

fn nothing_to_compare(model: &Model, frame: &Frame) -> Failure {
    let mut wanted = Vec::new();
    if model.sensor.is_some() {
        wanted.push("a reference with the sensor under test (i_ref_a with i_meas_a or q_meas_c, p_ref_w with p_meas_w)");
    }
    if let Some(battery) = &model.battery {
        wanted.push(if battery.ocv.is_empty() {
            "a current with soc_pct (and a voltage, if [battery] had ocv or ocv_file)"
        } else {
            "a current with soc_pct, v_cell_v or v_pack_v"
        });
    }
    Failure(format!(
        "{}: found the columns {}, expected {}; other names: --map NAME=COLUMN, or [columns] in {}{}",
        frame.source(),
        frame.names().join(", "),
        wanted.join(", or "),
        model.source,
        frame.absent()
    ))
}

/// What is known while problems are made.
struct Work<'a> {
    model: &'a Model,
    frame: &'a Frame,
    reference: Option<&'a Frame>,
    purpose: Purpose,
    remarks: Vec<String>,
    /// Time of the recording's rows on the reference's clock, once it has been found.
    clock: Option<Vec<f64>>,
}

impl<'a> Work<'a> {
    /// The frame that the reference is in.
    fn drive_frame(&self) -> &'a Frame {
        self.reference.unwrap_or(self.frame)
    }

    fn remark(&mut self, remark: String) {
        if !self.remarks.contains(&remark) {
            self.remarks.push(remark);
        }
    }

    /// Says what the model file states and the recording has no column for.
    fn not_compared(&mut self, items: &[Item]) {
        let has = |view| items.iter().any(|item| item.problem.view == view);
        let model = self.model;
        if let Some(sensor) = model.sensor.as_ref().filter(|_| !has(View::Sensor))
            && let Ok((_, measured)) = self.names(sensor)
        {
            self.remark(format!(
                "[sensor]'s readings are not compared: no column {measured} in {}",
                self.frame.source()
            ));
        }
        if let Some(charge) = model.charge.as_ref()
            && !has(View::Charge)
            && self.charge_column().is_none()
        {
            self.remark(format!(
                "[charge] is not compared: no column {} in {}",
                charge.column.as_deref().unwrap_or("q_meas_c"),
                self.frame.source()
            ));
        }
        if let Some(battery) = &model.battery {
            battery::not_compared(self, battery, items);
        }
    }

    /// Puts a charge counter aside that has too few readings, where something else has enough.
    fn few_of_a_counter(&mut self, items: &mut Vec<Item>) {
        let has_enough = |item: &Item| item.problem.observed.valid_rows() >= FEWEST_ROWS;
        let is_counter = |item: &Item| item.problem.view == View::Charge;
        if !items
            .iter()
            .any(|item| !is_counter(item) && has_enough(item))
        {
            return;
        }
        items.retain(|item| {
            let stays = !is_counter(item) || has_enough(item);
            if !stays {
                let rows = item.problem.observed.valid_rows();
                self.counter_aside(&item.problem.name, rows);
            }
            stays
        });
    }

    fn counter_aside(&mut self, column: &str, rows: usize) {
        self.remark(format!(
            "[charge] is not compared: {column} has {rows} readings to compare in {}, expected at least {FEWEST_ROWS}",
            self.frame.source()
        ));
    }

    /// The sensor, and its charge counter.
    fn sensor(&mut self, sensor: &Sensor) -> Result<Vec<Item>, Failure> {
        let (reference, measured) = self.names(sensor)?;
        let column = self.frame.origin(&measured);
        if self.purpose.compares()
            && self.reference.is_none()
            && self.frame.origin(&reference) == column
        {
            return Err(Failure(format!(
                "{}: found the column {column} as the sensor's reference and as its reading, expected two columns",
                self.frame.source()
            )));
        }
        let found = self.drive_frame().need(&reference)?;
        checks::some_values(found, &reference, self.drive_frame().source())?;
        let value = self.frame.column(&measured);
        let counter = self.charge_column();
        if value.is_none() && self.purpose.compares() && counter.is_none() {
            // Asked for by name, or nothing else to do: the error names the columns that are there.
            if sensor.measured.is_some() || self.model.battery.is_none() {
                self.frame.need(&measured)?;
            }
            return Ok(Vec::new());
        }
        if let Some(value) = &value
            && self.purpose.compares()
        {
            checks::some_values(value, &measured, self.frame.source())?;
            checks::not_constant(value, &measured, self.frame.source())?;
            // A file that is never fitted may be of a standstill: it tells whether a zero holds.
            if self.purpose == Purpose::Compare {
                checks::not_constant(found, &reference, self.drive_frame().source())?;
            }
        }
        if sensor.range_limit.is_some()
            && !self.frame.has("range_high")
            && !self.drive_frame().has("range_high")
        {
            self.remark(format!(
                "range_limit is stated and {} has no column range_high: range-mismatch and range-handover, which go by it, are not \
                 looked for",
                self.frame.source()
            ));
        }
        let board = Board::new(sensor.front_end, sensor.average.unwrap_or(1));
        let fresh = match &value {
            Some(value) => freshness(
                self.frame,
                found,
                value,
                self.reference.is_none(),
                sensor.interval_s,
            ),
            None => Freshness::all(self.frame.t_s().len()),
        };
        if let Some(interval_s) = fresh.interval_s {
            self.remark(is_held(&measured, interval_s));
        }
        self.find_clock(found, value, &fresh, &measured)?;
        let parts = series::drive(self.drive_frame(), found);
        let mut drive = parts.drive;
        self.surroundings(&mut drive, &parts.rows);
        let (mut observed, rows) = match &value {
            Some(value) => self.observe(&drive, &parts.rows, &parts.clocks, value, &fresh),
            None => (series::every_row(&drive), Arc::clone(&parts.rows)),
        };
        if self.clock.is_some() && value.is_some() {
            let left_out = series::leave_out_beside_steps(&drive, &mut observed);
            if left_out > 0 {
                self.remark(format!(
                    "{} of {measured} left out: between the rows on either side the reference steps, and two clocks do not tell \
                     whether before or after the reading",
                    count(left_out, "reading")
                ));
            }
        }
        if board.is_none() && sensor.interval_s == 0.0 {
            observed.held_s = fresh.interval_s.unwrap_or_default();
        }
        if self.purpose.compares() && value.is_some() {
            let wild = checks::wild(&drive, &observed);
            let names = [reference.as_str(), measured.as_str()];
            let (errors, remarks) = (
                checks::pair(&drive, &observed, &wild, self.frame, names),
                checks::plausible(&drive, &observed, &wild, sensor, names),
            );
            for remark in remarks {
                self.remark(remark);
            }
            errors?;
        }
        let pace = match (&value, &board) {
            (None, _) => Pace::Free,
            (Some(_), Some(board)) if series::spacing_s(&observed) > 1.5 * board.conversion_s() => {
                Pace::Between
            }
            _ => Pace::Seen,
        };
        let mut items = Vec::new();
        let unit = name::unit(&measured)
            .or_else(|| name::unit(&reference))
            .unwrap_or("1")
            .to_owned();
        if value.is_some() || self.purpose == Purpose::Simulate {
            let (problem, fresh) = self.sensor_problem(
                sensor,
                board.as_ref(),
                drive.clone(),
                observed,
                pace,
                &measured,
                &unit,
            );
            items.push(Item {
                problem,
                rows,
                pace,
                fresh,
            });
        }
        let is_empty = |column: &str| {
            let values = self.frame.column(column);
            values.is_some_and(|values| values.iter().all(|value| value.is_nan()))
        };
        let empty = counter
            .as_deref()
            .filter(|column| value.is_some() && self.purpose.compares() && is_empty(column));
        if let Some(counter) = empty {
            self.counter_aside(counter, 0);
        } else if let Some(counter) = counter {
            items.extend(charge::item(
                self,
                sensor,
                board.as_ref(),
                &drive,
                &parts.clocks,
                &counter,
            )?);
        }
        for item in &mut items {
            if sensor.smooth_reference {
                item.problem = item.problem.with_smooth_reference();
            }
            if let Some(holds @ Holds::SinceLastRow) = sensor.held_reference {
                item.problem = item.problem.with_held_reference(holds);
            }
        }
        Ok(items)
    }

    #[expect(clippy::too_many_arguments, reason = "the parts of one problem")]
    fn sensor_problem(
        &mut self,
        sensor: &Sensor,
        board: Option<&Board>,
        mut drive: Drive,
        mut observed: Observed,
        pace: Pace,
        measured: &str,
        unit: &str,
    ) -> (Problem, Vec<bool>) {
        let mut fresh = Vec::new();
        let mut squares = sensor.step.powi(2);
        let mut base = SensorBase {
            window_s: sensor.window_s,
            step: sensor.step,
            full_scale: sensor.full_scale,
            range_limit: sensor.range_limit,
            held_reference: sensor.is_held(),
            quasi_static: sensor.quasi_static,
            alignment_s: sensor.alignment_s,
            ..SensorBase::default()
        };
        let slack_s = match board {
            Some(board) if pace == Pace::Seen => board.slack_s(&observed),
            _ => 0.0,
        };
        if let Some(board) = board {
            base.step = board.step_a();
            base.full_scale = Some(board.full_scale_a());
            base.range_limit = board.range_limit_a();
            base.range_ratio = board.range_ratio();
            base.window_s = board.conversion_s() * f64::from(board.average());
            let run = |age_s: f64| {
                let mut earlier = observed.clone();
                earlier.t_s.iter_mut().for_each(|t| *t -= age_s);
                board.run(&drive, sensor.is_held(), &earlier, pace, false)
            };
            let (_, reported) = phase::closest(sensor.age_s, (slack_s, PHASES), &observed, run);
            self.compare_range_flag(board, &mut drive, &observed, &reported.range_high);
            base.reading = reported.current_a;
            fresh = reported.fresh;
            squares = squared_width(sensor, slack_s, &base, &observed, &reported.range_high);
            let mut spoiled = 0;
            for (row, reading) in base.reading.iter().enumerate() {
                if reading.is_nan() && observed.valid[row] {
                    observed.valid[row] = false;
                    spoiled += 1;
                }
            }
            if spoiled > 0 {
                self.remark(format!(
                    "{} of {measured} left out: a range change fell into the conversion, and the board itself marks that invalid",
                    count(spoiled, "reading")
                ));
            }
        }
        let problem = Problem {
            view: View::Sensor,
            name: measured.to_owned(),
            unit: unit.to_owned(),
            drive,
            observed,
            base: Base::Sensor(base),
            modelled: Vec::new(),
            // Steps and uncertain moments are spread evenly: the variance of a width is its square by twelve.
            noise: (sensor.noise.powi(2) + sensor.noise_coloured.powi(2) + squares / 12.0).sqrt(),
            coloured: Coloured {
                rms: sensor.noise_coloured,
                tau_s: sensor.noise_coloured_tau_s,
            },
            accuracy: Accuracy {
                zero: sensor.accuracy.zero,
                gain: sensor.accuracy.gain,
                scatter: 0.0,
                // The width, to either side.
                moment_s: 0.5 * slack_s,
            },
        };
        (problem, fresh)
    }

    /// The range flag of the simulated board where none was recorded, and a remark where it differs from a recorded one.
    fn compare_range_flag(
        &mut self,
        board: &Board,
        drive: &mut Drive,
        observed: &Observed,
        simulated: &[f64],
    ) {
        if !board.has_two_ranges() {
            return;
        }
        match &drive.range_high {
            None if observed.on_drive_rows() => {
                drive.range_high = Some(simulated.to_vec().into());
                self.remark(
                    "range_high was not recorded: the simulated board's is used".to_owned(),
                );
            }
            Some(recorded) if observed.on_drive_rows() => {
                let differ = recorded
                    .iter()
                    .zip(simulated)
                    .filter(|(recorded, simulated)| (*recorded - *simulated).abs() > 0.5)
                    .count();
                if differ * 50 > recorded.len() {
                    self.remark(format!(
                        "range_high differs from the simulated board's in {differ} of {} rows",
                        recorded.len()
                    ));
                }
            }
            _ => {}
        }
    }

    /// Names of reference and sensor.
    fn names(&self, sensor: &Sensor) -> Result<(String, String), Failure> {
        let has = |name: &str| self.drive_frame().has(name);
        let pair = PAIRS
            .iter()
            .find(|(reference, measured)| has(reference) && self.frame.has(measured))
            .or_else(|| PAIRS.iter().find(|(reference, _)| has(reference)));
        let reference = match (&sensor.reference, pair) {
            (Some(stated), _) => stated.clone(),
            (None, Some((reference, _))) => (*reference).to_owned(),
            (None, None) => {
                self.drive_frame().need(PAIRS[0].0)?;
                PAIRS[0].0.to_owned()
            }
        };
        let measured = sensor.measured.clone().unwrap_or_else(|| {
            let beside = PAIRS.iter().find(|(known, _)| *known == reference);
            let beside = beside.or(pair).unwrap_or(&PAIRS[0]);
            beside.1.to_owned()
        });
        Ok((reference, measured))
    }

    /// The counter's column, if it is there or asked for.
    fn charge_column(&self) -> Option<String> {
        let stated = self
            .model
            .charge
            .as_ref()
            .and_then(|charge| charge.column.clone());
        let name = stated.unwrap_or_else(|| "q_meas_c".to_owned());
        self.frame.has(&name).then_some(name)
    }

    /// Where the reference has a clock of its own: offset and rate between the two.
    fn find_clock(
        &mut self,
        found: &[f64],
        value: Option<&[f64]>,
        fresh: &Freshness,
        measured: &str,
    ) -> Result<(), Failure> {
        let Some(reference) = self.reference else {
            return Ok(());
        };
        if self.clock.is_some() {
            return Ok(());
        }
        for frame in [reference, self.frame] {
            if frame.clocks().len() > 1 {
                return Err(Failure(format!(
                    "{}: found a clock that starts anew with each cycle, expected one clock for the whole file where --reference is given",
                    frame.source()
                )));
            }
        }
        let Some(value) = value else {
            return Err(Failure(format!(
                "{}: found no column {measured}, expected it beside --reference: the clocks are compared by it",
                self.frame.source()
            )));
        };
        let sensed = align::Signal::new(self.frame.t_s(), value, |row| fresh.rows[row]);
        let driven = align::Signal::new(reference.t_s(), found, |_| true);
        let alignment = align::estimate(&driven, &sensed).map_err(|what| {
            Failure(format!(
                "{} and {}: {what}",
                reference.source(),
                self.frame.source()
            ))
        })?;
        self.remark(alignment.remark());
        self.clock = Some(
            self.frame
                .t_s()
                .iter()
                .map(|t| alignment.on_reference(*t))
                .collect(),
        );
        Ok(())
    }

    /// Environment columns, from the drive's own file or else from the other one. Rows without a reference count too: a bus has a
    /// message of its own for a temperature.
    fn surroundings(&self, drive: &mut Drive, rows: &[usize]) {
        let held = |name: &str| {
            if let Some(values) = self.drive_frame().column(name) {
                let held = series::held_over_gaps(values.iter().copied())?;
                let held: Vec<f64> = rows.iter().map(|row| held[*row]).collect();
                return Some(Series::from(held));
            }
            let clock = self.clock.as_ref()?;
            let values = self.frame.column(name)?;
            series::held_at(clock, values, &drive.t_s).map(Series::from)
        };
        let surroundings = SURROUNDINGS.map(held);
        [
            drive.sensor_temperature_c,
            drive.supply_v,
            drive.aux_a,
            drive.range_high,
            drive.cell_temperature_c,
            drive.ambient_c,
        ] = surroundings;
    }

    /// Where and when a column was recorded.
    fn observe(
        &self,
        drive: &Drive,
        rows: &Arc<Vec<usize>>,
        clocks: &[usize],
        value: &[f64],
        fresh: &Freshness,
    ) -> (Observed, Arc<Vec<usize>>) {
        match (&self.clock, self.reference) {
            (Some(clock), Some(_)) => series::own_rows(
                drive,
                clocks,
                self.frame.clocks(),
                clock,
                value,
                &fresh.rows,
            ),
            _ => {
                let frame = self.frame;
                if series::share_rows(rows, value) {
                    series::drive_rows(drive, rows, value, &fresh.rows)
                } else {
                    series::own_rows(
                        drive,
                        clocks,
                        frame.clocks(),
                        frame.t_s(),
                        value,
                        &fresh.rows,
                    )
                }
            }
        }
    }
}

/// What the supply moves is the zero, by the full scale: where that is not stated, a remark.
fn supply_without_range(items: &[Item]) -> Option<String> {
    const ID: &str = "supply-ratiometric";
    let lacks = |item: &&Item| {
        item.problem.drive.supply_v.is_some()
            && matches!(&item.problem.base, Base::Sensor(sensor) if sensor.full_scale.is_none())
    };
    let problem = &items.iter().find(lacks)?.problem;
    let is_stated = problem.modelled.iter().any(|(id, _)| *id == ID);
    Some(format!(
        "{}: the supply is recorded, but [sensor] states no full_scale, by which the zero moves with it: {}",
        problem.name,
        if is_stated {
            format!("[effects.{ID}] moves the sensitivity only")
        } else {
            format!("{ID} is not looked for")
        }
    ))
}

/// Effects of the model file that do nothing, as nothing was recorded of what they go by.
fn without_columns(model: &Model, items: &[Item], sources: &[Option<&str>]) -> Vec<String> {
    let sources: Vec<&str> = sources.iter().copied().flatten().collect();
    let effects = model.effects.iter();
    let told = effects.filter_map(|(id, values)| {
        let effect = find_with(id, values.len())?;
        let has_it = |item: &&Item| item.problem.modelled.iter().any(|(known, _)| known == id);
        let mut lacking = items.iter().filter(has_it).map(|item| {
            let beside = item.problem.modelled.iter().map(|(id, _)| *id);
            lacks(effect, &item.problem, beside)
        });
        // A board's range is known where its rows are, and not to its counter.
        let first = lacking.next()??;
        lacking.all(|lacks| lacks.is_some()).then(|| {
            format!(
                "[effects.{id}] does nothing here: no column {first} in {}",
                sources.join(" or ")
            )
        })
    });
    told.collect()
}

/// Puts the effects of the model file into a problem, those that act in its view.
fn model_effects(model: &Model, item: &mut Item) -> Result<(), Failure> {
    let problem = &mut item.problem;
    let battery = matches!(problem.view, View::StateOfCharge | View::Voltage);
    problem.modelled = model
        .effects
        .iter()
        .filter(|(id, _)| registry::of_battery(id) == battery)
        .cloned()
        .collect();
    checks::moments(model, problem)?;
    if problem.modelled.is_empty() {
        return Ok(());
    }
    let changed = modelled_change(problem);
    let Base::Sensor(base) = &mut problem.base else {
        return Ok(());
    };
    if base.reading.is_empty() {
        return Ok(());
    }
    // Between two conversions the board holds its reading, with what the effects made of it.
    let mut held = 0.0;
    for (row, reading) in base.reading.iter_mut().enumerate() {
        if item.fresh.get(row).is_none_or(|fresh| *fresh) {
            held = changed[row];
        }
        *reading += held;
    }
    Ok(())
}

/// What the effects of the model file change of an ideal sensor's reading, at each observed row.
pub fn modelled_change(problem: &Problem) -> Vec<f64> {
    let mut plain = problem.clone();
    plain.modelled.clear();
    if let Base::Sensor(base) = &mut plain.base {
        base.reading.clear();
    }
    let effects: Vec<(String, Vec<f64>)> = problem
        .modelled
        .iter()
        .map(|(id, values)| ((*id).to_owned(), values.clone()))
        .collect();
    let (with, without) = (
        explain::predict(&plain, &effects),
        explain::predict(&plain, &[]),
    );
    with.iter().zip(without).map(|(w, o)| w - o).collect()
}

/// A time in a remark.
pub(crate) fn seconds(s: f64) -> String {
    if s.abs() < 1.0 {
        format!("{:.3} ms", s * 1e3)
    } else {
        format!("{s:.3} s")
    }
}
