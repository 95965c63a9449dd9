//! What the stages hand on: what drives the simulation, what was observed, and what the design says about it.
//!
//! Recording and model file become one [`Problem`] for each signal that can be compared. Everything after that
//! (location, effects, selection) knows nothing of files.

mod begin;
mod holds;
mod smooth;

use std::ops::{Deref, DerefMut, Range};
use std::sync::Arc;

pub use holds::Holds;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng as _, SeedableRng as _};

/// A signal that is compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum View {
    /// A current, power or any other quantity that a sensor reads, against its reference; in the sensor's unit.
    Sensor,
    /// The mean current between two readings of the charge counter, in A: the counter's differences over time.
    Charge,
    /// State of charge, in %.
    StateOfCharge,
    /// Voltage of a cell or pack, in V.
    Voltage,
}

/// Values row by row, of which copies share the memory until one of them is written to: a long recording is held once.
#[derive(Clone, Debug, Default)]
pub struct Series(Arc<Vec<f64>>);

impl Series {
    /// The values, copied if others share them.
    pub fn into_vec(self) -> Vec<f64> {
        Arc::unwrap_or_clone(self.0)
    }
}

impl From<Vec<f64>> for Series {
    fn from(values: Vec<f64>) -> Self {
        Self(Arc::new(values))
    }
}

impl FromIterator<f64> for Series {
    fn from_iter<I: IntoIterator<Item = f64>>(values: I) -> Self {
        values.into_iter().collect::<Vec<f64>>().into()
    }
}

impl Deref for Series {
    type Target = [f64];

    fn deref(&self) -> &[f64] {
        &self.0
    }
}

impl DerefMut for Series {
    fn deref_mut(&mut self) -> &mut [f64] {
        Arc::<Vec<f64>>::make_mut(&mut self.0)
    }
}

impl<'s> IntoIterator for &'s Series {
    type Item = &'s f64;
    type IntoIter = std::slice::Iter<'s, f64>;

    fn into_iter(self) -> Self::IntoIter {
        self.0.iter()
    }
}

/// The drive: the reference and the environment, on the reference's own time stamps. All series have the same length.
#[derive(Clone, Debug, Default)]
pub struct Drive {
    /// Time in s, finite, non-decreasing within each segment.
    pub t_s: Series,
    /// The reference quantity, in the view's unit; for battery views the current in A, positive = discharge. Finite: rows
    /// without a reference are not part of the drive.
    pub reference: Series,
    /// Temperature of the sensor in °C, held over gaps; `None` where it was not recorded.
    pub sensor_temperature_c: Option<Series>,
    /// Supply of the sensor in V.
    pub supply_v: Option<Series>,
    /// Current of the neighbouring conductor in A.
    pub aux_a: Option<Series>,
    /// Range flag: 1 where the large range measures.
    pub range_high: Option<Series>,
    /// Temperature of the cell in °C.
    pub cell_temperature_c: Option<Series>,
    /// Temperature of the surroundings in °C.
    pub ambient_c: Option<Series>,
    /// Where the mean over the step that ends at each row lies, from the value where it begins (0) to the one where it ends (1), as a
    /// counter beside the current tells ([`ends`]); `None`: half-way, the reference goes in straight lines.
    pub mean_share: Option<Series>,
    /// The reference stays at one value between its rows, which [`Self::mean_share`] says of a battery's, and the rows themselves with
    /// [`SensorBase::held_reference`] of a sensor's.
    pub holds: Option<Holds>,
    /// Stretches with one clock and no gap; filters start anew in each.
    pub segments: Vec<Range<usize>>,
    /// True where the segment of the same index continues the one before: a gap, and no new operation. What a cell or a core
    /// remembers goes on over it ([`Drive::operations`]).
    pub continues: Vec<bool>,
    /// Rows that stand for one recorded step ([`Problem::smoothed`]); 0 and 1: the rows are those that were recorded.
    pub parts: usize,
}

/// The drive's segment that each row of an observation belongs to: rows of one segment follow one another, and only where another
/// begins is it said.
#[derive(Clone, Debug, Default)]
pub struct Stretches {
    /// The first row of each stretch, and its segment.
    starts: Vec<(usize, usize)>,
    rows: usize,
}

impl Stretches {
    /// So many rows of the first segment.
    pub fn one(rows: usize) -> Self {
        Self {
            starts: vec![(0, 0)],
            rows,
        }
    }

    /// The next row, with the index of its segment.
    pub fn push(&mut self, segment: usize) {
        if self.starts.last().is_none_or(|(_, last)| *last != segment) {
            self.starts.push((self.rows, segment));
        }
        self.rows += 1;
    }

    /// Index of the segment that a row belongs to.
    pub fn segment_of(&self, row: usize) -> usize {
        let after = self.starts.partition_point(|(first, _)| *first <= row);
        self.starts[after - 1].1
    }

    /// The rows of a segment, empty if it has none. Segments ascend with the rows.
    pub fn of(&self, segment: usize) -> Range<usize> {
        let at = self.starts.partition_point(|(_, of)| *of < segment);
        match self.starts.get(at) {
            Some((first, of)) if *of == segment => {
                let next = self.starts.get(at + 1);
                *first..next.map_or(self.rows, |(next, _)| *next)
            }
            _ => 0..0,
        }
    }

    /// Each stretch: the index of its segment, and its rows.
    pub fn iter(&self) -> impl Iterator<Item = (usize, Range<usize>)> + '_ {
        let ends = self.starts.iter().skip(1).map(|(first, _)| *first);
        self.starts
            .iter()
            .zip(ends.chain([self.rows]))
            .map(|((first, segment), end)| (*segment, *first..end))
    }
}

impl FromIterator<usize> for Stretches {
    fn from_iter<I: IntoIterator<Item = usize>>(segments: I) -> Self {
        let mut stretches = Self::default();
        segments
            .into_iter()
            .for_each(|segment| stretches.push(segment));
        stretches
    }
}

/// When readings were taken.
#[derive(Clone, Debug, Default)]
pub enum Moments {
    /// Reading `k` at row `k` of the drive (same time stamps): no interpolation then.
    EveryRow,
    /// Each at a row of the drive, but not at all of them ([`Problem::thinned`]).
    Rows(Vec<usize>),
    /// At times of their own.
    #[default]
    Own,
}

/// What was recorded of the signal under test.
#[derive(Clone, Debug, Default)]
pub struct Observed {
    /// Time in s on the sensor's own clock; when reference and sensor share rows, the drive's time.
    pub t_s: Series,
    /// The reading; NaN where there is none.
    pub value: Vec<f64>,
    /// True where the reading counts: present, not a repeat of a held value, not in a drop-out, within the drive's time.
    pub valid: Vec<bool>,
    /// The drive's segment that each row belongs to.
    pub stretches: Stretches,
    /// When they were taken.
    pub moments: Moments,
    /// Time between two new readings, in s, where readings repeat though the design says that each is new; else 0.
    pub held_s: f64,
    /// Time between two readings before they were thinned out ([`Problem::thinned`]), in s; 0 if all are here.
    pub thinned_from_s: f64,
    /// Step of the grid on which readings lie and to which the simulation does not round, in the view's unit; 0 if there is none.
    pub grid: f64,
}

impl Observed {
    /// Readings on the rows of a drive of one segment, all of which count. `t_s` in s.
    pub fn with_drive(t_s: impl Into<Series>, value: Vec<f64>) -> Self {
        Self {
            valid: vec![true; value.len()],
            stretches: Stretches::one(value.len()),
            moments: Moments::EveryRow,
            held_s: 0.0,
            thinned_from_s: 0.0,
            grid: 0.0,
            t_s: t_s.into(),
            value,
        }
    }
}

/// What the simulation as designed says, at each observed row, and what it needs to be run again with effects.
#[derive(Clone, Debug)]
pub enum Base {
    /// A sensor that reads its reference.
    Sensor(SensorBase),
    /// A battery's state of charge or voltage.
    Battery(BatteryBase),
}

/// A sensor as designed.
#[derive(Clone, Debug, Default)]
pub struct SensorBase {
    /// What the sensor as designed would have read at each observed row, with effects of the model file already in it;
    /// empty: its reference, through [`SensorBase::window_s`].
    pub reading: Vec<f64>,
    /// Averaging window by design, in s; 0: none.
    pub window_s: f64,
    /// The converter's step by design, in the view's unit; 0: continuous.
    pub step: f64,
    /// Time by which readings stand for an earlier moment than their row, within half a step; found with an effect, 0 by design.
    pub alignment_s: f64,
    /// Full scale, in the view's unit, if stated.
    pub full_scale: Option<f64>,
    /// Full scale of the large range over that of the small one; 0 if there is one range.
    pub range_ratio: f64,
    /// Where the small range ends by design, in the view's unit, if there are two.
    pub range_limit: Option<f64>,
    /// True if the reference stays at its value until its next row instead of going there in a straight line.
    pub held_reference: bool,
    /// True if the reference goes from row to row in a smooth course instead of a straight line ([`Problem::smoothed`]).
    pub smooth_reference: bool,
    /// True if the recording's time means nothing (a loop measured point by point): no effect goes by the clock.
    pub quasi_static: bool,
}

impl SensorBase {
    /// A value as the converter by design gives it.
    pub fn stepped(&self, value: f64) -> f64 {
        if self.step > 0.0 {
            (value / self.step).round() * self.step
        } else {
            value
        }
    }
}

/// A battery as designed: open-circuit voltage and ohmic resistance.
#[derive(Clone, Debug, Default)]
pub struct BatteryBase {
    /// Capacity in Ah.
    pub capacity_ah: f64,
    /// Coulombic efficiency by design, 1 if not stated.
    pub efficiency: f64,
    /// State of charge at the start of each segment, 0 … 1.
    pub initial_soc: Vec<f64>,
    /// What flowed over the gap before each segment beyond a straight line through the current at the gap's ends, in Ah, as a counter or
    /// the first reading after it tells; 0, or no value, where neither does.
    pub gap_excess_ah: Vec<f64>,
    /// Standard uncertainty of what the gap before each segment leaves of the state of charge, 0 … 1; 0, or no value: nothing is open.
    pub gap_soc_sigma: Vec<f64>,
    /// Standard uncertainty of [`BatteryBase::initial_soc`] at the start of each operation, 0 … 1; 0, or no value: exact.
    pub initial_soc_sigma: Vec<f64>,
    /// Open-circuit voltage of the whole series string: state of charge (ascending) and V.
    pub ocv: Vec<(f64, f64)>,
    /// Cells in series in what the voltage is of.
    pub cells: f64,
    /// Ohmic resistance at 25 °C, in Ω, of the whole string.
    pub resistance_ohm: f64,
    /// Relative standard uncertainty of [`BatteryBase::resistance_ohm`]; 0: exact.
    pub resistance_sigma: f64,
    /// Lowest and highest temperature, in °C, at which the resistances are known; beyond them they follow it as is usual.
    pub resistances_at_c: Option<[f64; 2]>,
    /// What the recorded current is above the battery's, in A.
    pub current_zero_a: f64,
    /// Standard uncertainty of [`BatteryBase::current_zero_a`]; 0: exact.
    pub current_zero_sigma_a: f64,
    /// Standard uncertainty of the current that flowed before the recording, beside none, in A; 0: the battery had rested.
    pub before_sigma_a: f64,
    /// Time by which voltages were read before the current of their row, in s.
    pub alignment_s: f64,
}

/// A comparison of one signal: the input of every later stage.
#[derive(Clone, Debug)]
pub struct Problem {
    /// Which signal.
    pub view: View,
    /// Its column, such as `i_meas_a`.
    pub name: String,
    /// Its unit, such as `A`.
    pub unit: String,
    /// What drives it.
    pub drive: Drive,
    /// What was recorded.
    pub observed: Observed,
    /// The simulation as designed.
    pub base: Base,
    /// Effects that the model file already holds: id and values in the order of the effect's parameters.
    pub modelled: Vec<(&'static str, Vec<f64>)>,
    /// Standard deviation of the noise that the design specifies for one reading (white and quantisation), in the view's unit;
    /// 0 if nothing is stated.
    pub noise: f64,
    /// The part of `noise` that has a memory.
    pub coloured: Coloured,
    /// Accuracy of the reference instrument, in the view's unit: a constant part and a share of the reading.
    pub accuracy: Accuracy,
}

/// Noise whose correlation falls exponentially with time.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Coloured {
    /// Standard deviation, in the view's unit.
    pub rms: f64,
    /// Time in which the correlation falls to 1/e, in s.
    pub tau_s: f64,
}

/// Accuracy of an instrument, and of when it was read: `zero + (gain + scatter)·abs(reading) + moment·abs(d reading/dt)`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Accuracy {
    /// Constant part, in the view's unit.
    pub zero: f64,
    /// Share of the reading.
    pub gain: f64,
    /// Share of the reading by which each is off by itself, and not all alike.
    pub scatter: f64,
    /// Time by which the moments of readings may all be off, in s.
    pub moment_s: f64,
}

impl Accuracy {
    /// By how much a reading may be off that changes by `slope_per_s` in a second, in the view's unit.
    pub fn at(self, reading: f64, slope_per_s: f64) -> f64 {
        self.zero + (self.gain + self.scatter) * reading.abs() + self.moment_s * slope_per_s.abs()
    }
}

/// At most so many of some rows, one of each stretch of as many: where in it is drawn, the same way each time. With the first of each, what is
/// faster than two stretches would be taken for something slower.
pub fn spread_out(rows: impl Iterator<Item = usize> + Clone, most: usize) -> Vec<usize> {
    let stride = rows.clone().count().div_ceil(most.max(1)).max(1);
    if stride == 1 {
        return rows.collect();
    }
    let mut random = ChaCha8Rng::seed_from_u64(stride as u64);
    let mut wanted = 0;
    let mut chosen = Vec::with_capacity(most);
    for (at, row) in rows.enumerate() {
        // The first stays: times count from it.
        if at % stride == 0 && at > 0 {
            wanted = ((u64::from(random.next_u32()) * stride as u64) >> 32) as usize;
        }
        if at % stride == wanted {
            chosen.push(row);
        }
    }
    chosen
}

/// The median of the steps between times that go on; 0 without any. In s. Of very many some do.
pub fn median_step_s(times_s: impl Iterator<Item = f64> + Clone) -> f64 {
    const MOST: usize = 1 << 18;
    let every = times_s.clone().count().div_ceil(MOST).max(1);
    let next = times_s.clone().skip(1);
    let mut steps: Vec<f64> = times_s
        .zip(next)
        .step_by(every)
        .map(|(from, to)| to - from)
        .filter(|step| *step > 0.0)
        .collect();
    let middle = steps.len() / 2;
    if steps.is_empty() {
        return 0.0;
    }
    *steps.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// Values between which a quantity goes in a straight line over a step whose mean lies at a share of the way from one of its ends to the
/// other: 0, it stays and jumps where the step ends; 0.5, a straight line; 1, it jumps where the step begins.
#[inline]
pub fn ends(mean_share: f64, [from, to]: [f64; 2]) -> [f64; 2] {
    let at = |share: f64| from + share * (to - from);
    [
        at((2.0 * mean_share - 1.0).max(0.0)),
        at((2.0 * mean_share).min(1.0)),
    ]
}

impl Problem {
    /// Whether time means nothing in this recording.
    pub fn quasi_static(&self) -> bool {
        matches!(&self.base, Base::Sensor(base) if base.quasi_static)
    }

    /// What another reference would have the simulation say at the same moments; the readings are left out, as no simulation looks at
    /// them.
    pub fn driven_by(&self, reference: Series) -> Self {
        let observed = &self.observed;
        Self {
            drive: Drive {
                reference,
                ..self.drive.clone()
            },
            observed: Observed {
                t_s: observed.t_s.clone(),
                value: Vec::new(),
                valid: observed.valid.clone(),
                stretches: observed.stretches.clone(),
                moments: observed.moments.clone(),
                ..*observed
            },
            name: self.name.clone(),
            unit: self.unit.clone(),
            base: self.base.clone(),
            modelled: self.modelled.clone(),
            ..*self
        }
    }

    /// The same with at most so many of its readings, thinned out ([`spread_out`]): the simulation still runs over every row of the drive. Means
    /// from one reading to the next stay as they are.
    pub fn thinned(mut self, most: usize) -> Self {
        let observed = &self.observed;
        if self.view == View::Charge || observed.valid_rows() <= most {
            return self;
        }
        let counts = |row: &usize| observed.valid[*row] && observed.value[*row].is_finite();
        let rows = spread_out((0..observed.t_s.len()).filter(counts), most);
        let thinned_from_s = median_step_s(
            (0..observed.t_s.len())
                .filter(counts)
                .map(|row| observed.t_s[row]),
        );
        let of = |series: &[f64]| rows.iter().map(|&row| series[row]).collect::<Vec<f64>>();
        if let Base::Sensor(base) = &mut self.base
            && !base.reading.is_empty()
        {
            base.reading = of(&base.reading);
        }
        self.observed = Observed {
            t_s: of(&observed.t_s).into(),
            value: of(&observed.value),
            valid: vec![true; rows.len()],
            stretches: rows.iter().map(|&row| observed.segment_of(row)).collect(),
            held_s: observed.held_s,
            thinned_from_s,
            grid: observed.grid,
            moments: match &observed.moments {
                Moments::EveryRow => Moments::Rows(rows),
                Moments::Rows(at) => Moments::Rows(rows.iter().map(|&row| at[row]).collect()),
                Moments::Own => Moments::Own,
            },
        };
        self
    }

    /// The same, of which the readings of some rows of the observation do not count.
    pub(crate) fn without_readings(&self, rows: impl IntoIterator<Item = usize>) -> Self {
        let mut other = self.clone();
        rows.into_iter()
            .for_each(|row| other.observed.valid[row] = false);
        other
    }

    /// A sensor beside its reference in one stretch, both in A and read in the same rows, with white noise of an rms.
    #[cfg(test)]
    pub(crate) fn pair(t_s: Vec<f64>, reference: Vec<f64>, reading: Vec<f64>, noise: f64) -> Self {
        Self {
            view: View::Sensor,
            name: "i_meas_a".into(),
            unit: "A".into(),
            observed: Observed::with_drive(t_s.clone(), reading),
            drive: Drive {
                segments: std::iter::once(0..t_s.len()).collect(),
                continues: vec![false],
                reference: reference.into(),
                t_s: t_s.into(),
                ..Drive::default()
            },
            base: Base::Sensor(SensorBase::default()),
            modelled: Vec::new(),
            noise,
            coloured: Coloured::default(),
            accuracy: Accuracy::default(),
        }
    }
}

/// A current rests where it is at most this share of its largest size: below what instruments resolve of it.
const AT_REST: f64 = 2e-3;
/// Rests that are shorter in all tell nothing, in s.
const LEAST_REST_S: f64 = 600.0;

impl Drive {
    /// What the reference is at rest, in the mean over time, and the time in s that it rests: steps that begin and end near nothing.
    pub fn at_rest(&self) -> Option<(f64, f64)> {
        let largest = self
            .reference
            .iter()
            .fold(0.0_f64, |most, i| most.max(i.abs()));
        let rests = |row: usize| self.reference[row].abs() <= AT_REST * largest;
        let (mut integral, mut time_s) = (0.0, 0.0);
        for rows in &self.segments {
            for row in rows
                .clone()
                .skip(1)
                .filter(|row| rests(row - 1) && rests(*row))
            {
                let step_s = self.t_s[row] - self.t_s[row - 1];
                integral += 0.5 * (self.reference[row - 1] + self.reference[row]) * step_s;
                time_s += step_s;
            }
        }
        (time_s >= LEAST_REST_S).then(|| (integral / time_s, time_s))
    }

    /// Number of rows.
    pub fn len(&self) -> usize {
        self.t_s.len()
    }

    /// What surrounds it, as far as it was recorded: column, unit and values.
    pub fn surroundings(&self) -> impl Iterator<Item = (&'static str, &'static str, &Series)> {
        [
            ("temp_sensor_c", "°C", &self.sensor_temperature_c),
            ("v_supply_v", "V", &self.supply_v),
            ("i_aux_a", "A", &self.aux_a),
            ("range_high", "1", &self.range_high),
            ("temp_cell_c", "°C", &self.cell_temperature_c),
            ("temp_ambient_c", "°C", &self.ambient_c),
        ]
        .into_iter()
        .filter_map(|(column, unit, series)| Some((column, unit, series.as_ref()?)))
    }

    /// What was recorded of the battery's temperature, in °C: the cell's, else its surroundings'.
    pub fn battery_temperature(&self) -> Option<&Series> {
        self.cell_temperature_c.as_ref().or(self.ambient_c.as_ref())
    }

    /// The lowest and the highest of it.
    pub fn battery_temperatures(&self) -> Option<[f64; 2]> {
        let known = self.battery_temperature()?.iter().filter(|t| t.is_finite());
        known.fold(None, |range, &t| {
            let [low, high] = range.unwrap_or([t, t]);
            Some([f64::min(low, t), f64::max(high, t)])
        })
    }

    /// True without rows.
    pub fn is_empty(&self) -> bool {
        self.t_s.is_empty()
    }

    /// Operations: segments with those that continue them.
    pub fn operations(&self) -> Vec<Range<usize>> {
        let mut operations: Vec<Range<usize>> = Vec::new();
        for (index, rows) in self.segments.iter().enumerate() {
            match operations.last_mut() {
                Some(last) if self.is_continued(index) && last.end == rows.start => {
                    last.end = rows.end;
                }
                _ => operations.push(rows.clone()),
            }
        }
        operations
    }

    /// Of each segment, the operation that it is a part of.
    pub fn operation_of_each(&self) -> Vec<Range<usize>> {
        let operations = self.operations();
        let of_segment = |rows: &Range<usize>| {
            let at = operations.partition_point(|operation| operation.end <= rows.start);
            operations.get(at).cloned().unwrap_or_else(|| rows.clone())
        };
        self.segments.iter().map(of_segment).collect()
    }

    /// Of each segment, the number of the operation that it is a part of.
    pub fn operation_numbers(&self) -> Vec<usize> {
        let begins = (0..self.segments.len()).map(|index| usize::from(!self.is_continued(index)));
        begins
            .scan(0, |begun, begins| {
                *begun += begins;
                Some(*begun - 1)
            })
            .collect()
    }

    /// Whether a segment continues the one before.
    pub fn is_continued(&self, segment: usize) -> bool {
        segment > 0 && self.continues.get(segment).copied().unwrap_or_default()
    }

    /// Values between which the current goes in a straight line over the step that ends at a row, from its values at the two rows.
    #[inline]
    pub fn ends(&self, row: usize, pair: [f64; 2]) -> [f64; 2] {
        let share = self.mean_share.as_ref().and_then(|share| share.get(row));
        share.map_or(pair, |share| ends(*share, pair))
    }

    /// Integral of the reference over time from the start of each segment: Coulomb, if it is a current in A.
    pub fn charge(&self) -> Vec<f64> {
        let mut charge = vec![0.0; self.len()];
        for rows in &self.segments {
            for row in rows.clone().skip(1) {
                let [from, to] = self.ends(row, [self.reference[row - 1], self.reference[row]]);
                let step_s = self.t_s[row] - self.t_s[row - 1];
                charge[row] = charge[row - 1] + 0.5 * (from + to) * step_s;
            }
        }
        charge
    }

    /// Rows that stand for one recorded step, 1 or more.
    pub fn stride(&self) -> usize {
        self.parts.max(1)
    }

    /// Median recorded step in s over all segments; 0 with fewer than two rows.
    pub fn median_step_s(&self) -> f64 {
        let mut steps: Vec<f64> = self
            .segments
            .iter()
            .flat_map(|rows| {
                self.t_s[rows.clone()]
                    .windows(2)
                    .map(|pair| (pair[1] - pair[0]) * self.stride() as f64)
            })
            .filter(|step| *step > 0.0)
            .collect();
        if steps.is_empty() {
            return 0.0;
        }
        let middle = steps.len() / 2;
        *steps.select_nth_unstable_by(middle, f64::total_cmp).1
    }

    /// Time covered, in s.
    pub fn span_s(&self) -> f64 {
        self.segments
            .iter()
            .filter(|rows| !rows.is_empty())
            .map(|rows| self.t_s[rows.end - 1] - self.t_s[rows.start])
            .sum()
    }
}

impl Observed {
    /// Index of the drive's segment that a row belongs to.
    pub fn segment_of(&self, row: usize) -> usize {
        self.stretches.segment_of(row)
    }

    /// Whether row `k` of the observation is row `k` of the drive.
    pub fn on_drive_rows(&self) -> bool {
        matches!(self.moments, Moments::EveryRow)
    }

    /// The drive's row at which a reading was taken, unless it has a time of its own.
    pub fn drive_row(&self, row: usize) -> Option<usize> {
        match &self.moments {
            Moments::EveryRow => Some(row),
            Moments::Rows(rows) => rows.get(row).copied(),
            Moments::Own => None,
        }
    }

    /// The drive's row at which a reading was taken, or the last before it.
    pub fn drive_row_before(&self, drive: &Drive, row: usize) -> Option<usize> {
        self.drive_row(row).or_else(|| {
            let range = drive.segments.get(self.segment_of(row))?;
            let times = &drive.t_s[range.clone()];
            let at = times
                .partition_point(|t| *t <= self.t_s[row])
                .saturating_sub(1);
            (range.start + at < range.end).then_some(range.start + at)
        })
    }

    /// Rows that count.
    pub fn valid_rows(&self) -> usize {
        self.valid.iter().filter(|valid| **valid).count()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_mean_of_a_step_lies_where_its_share_says(
            share in 0.0..=1.0f64,
            pair in [-500.0..500.0f64, -500.0..500.0f64],
        ) {
            let [from, to] = ends(share, pair);
            let mean = pair[0] + share * (pair[1] - pair[0]);
            prop_assert!((0.5 * (from + to) - mean).abs() < 1e-9);
            // It never leaves what lies between the two rows.
            let [low, high] = [pair[0].min(pair[1]), pair[0].max(pair[1])];
            prop_assert!([from, to].iter().all(|end| (low - 1e-9..=high + 1e-9).contains(end)));
        }
    }

    #[test]
    fn a_current_is_read_at_rest() {
        // An hour of 30 A, then an hour that reads a tenth of a per mille, in steps of a minute.
        let reference: Vec<f64> = (0..120)
            .map(|k| if k < 60 { 30.0 } else { -0.003 })
            .collect();
        let mut drive = Drive {
            t_s: (0..120).map(|k| f64::from(k) * 60.0).collect(),
            reference: reference.into(),
            segments: std::iter::once(0..120).collect(),
            ..Drive::default()
        };
        let (reads, time_s) = drive.at_rest().unwrap_or_default();
        assert!((reads + 0.003).abs() < 1e-12, "{reads}");
        assert_eq!(time_s, 59.0 * 60.0);
        // A drive that never rests, and one that rests for minutes.
        drive.reference = (0..120).map(|k| 30.0 + f64::from(k)).collect();
        assert_eq!(drive.at_rest(), None);
        drive.reference = (0..120).map(|k| if k < 110 { 30.0 } else { 0.0 }).collect();
        assert_eq!(drive.at_rest(), None);
    }

    #[test]
    fn a_step_stays_is_straight_or_comes_before() {
        let pair = [2.0, 10.0];
        assert_eq!(ends(0.0, pair), [2.0, 2.0]);
        assert_eq!(ends(0.5, pair), pair);
        assert_eq!(ends(1.0, pair), [10.0, 10.0]);
    }
}
