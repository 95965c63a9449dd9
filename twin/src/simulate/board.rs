//! The board as designed: ideal sensors, comparators and switch in front of the very code that measures on the board.
//!
//! The current is a straight line between the rows of the drive (or held), so the signal behind the analog switch is
//! one too, but for its jumps at range changes and its flat ends. Its integral gives each conversion and each count of
//! the meter exactly; from there on it is `core-logic`: code to current, validity, sliding average, charge.
//!
//! Sensors, comparators and converter follow their supply alike (all ratiometric), so an ideal board's reading does not
//! depend on it. What a real one does is an effect.

use core_logic::{
    configuration::Configuration,
    converter::{
        Adc1Sample, Converter, ConverterCoefficients, ConverterSample, Corrections, SampleContext,
    },
    design_parameters as design,
    front_end::{Channel, ClosedLoop, DualRange, FrontEnd, Hah1bv, KeyFactors, Network, PerRange},
    meter::{LONGEST_INTERVAL, MeterChannel, MeterReading},
    range::{EdgeRecorder, Range as SensorRange},
    sliding_average::{SlidingAverage, SlidingAverageConfig},
    units::{Duration, Instant, Ppm},
};
use plant::comparator::ComparatorConfig;

use crate::{
    model::FrontEndKind,
    problem::{Drive, Observed},
};

/// Signal that is full scale of the meter, in V: ±0.5 V behind the scaling by 2/9.
const SIGNAL_SPAN_V: f64 = 2.25;
/// The pin's converter: 12 bits over 3.3 V (RM0090, ADC).
const ADC1_STEP_V: f64 = 3.3 / 4096.0;

/// Fewest conversions from which a grid is told.
const FEWEST_OF_A_GRID: usize = 20;
/// Share of the likeness that an even grid would show, from which there is one.
const GRID_LIKE: f64 = 0.85;
/// Changes to either side that tell the phase of the grid at one: each is late by up to a step between rows, so that their mean is
/// known to a thirtieth of a step.
const AROUND: usize = 40;
/// Rows that are further apart than this part of the grid's period saw two conversions.
const ANOTHER: f64 = 0.5;
/// The second of them ends no sooner than this part of it after the first: the phase moves by less than the rest.
const SOONEST: f64 = 0.75;
/// The ADS1100's clock may be off by a fifth (*assumed*, as `core-logic` has it).
const CLOCK_WITHIN: f64 = 0.2;

/// When conversions end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    /// Where a new reading was seen: at the valid rows of the observation, or rather on the grid that those tell
    /// of, since a row sees a conversion up to one step late.
    Seen,
    /// Rows are further apart than conversions: half a conversion before each row, the mean of what can be.
    Between,
    /// Nothing was seen: one after the other from the start of each segment.
    Free,
}

/// What the board would have reported at each observed row.
#[derive(Clone, Debug, Default)]
pub struct Reported {
    /// Current in A; NaN where the board itself marks the conversion as spoiled by a range change.
    pub current_a: Vec<f64>,
    /// Charge counter in C.
    pub charge_c: Vec<f64>,
    /// Range flag: 1 for the large sensor.
    pub range_high: Vec<f64>,
    /// True where a new conversion shows for the first time, and where one was seen.
    pub fresh: Vec<bool>,
}

/// A board as designed.
#[derive(Clone, Debug)]
pub struct Board {
    configuration: Configuration,
    coefficients: ConverterCoefficients,
    average: SlidingAverageConfig,
    /// Current at which the signal is [`SIGNAL_SPAN_V`] from its zero.
    span_a: PerRange<f64>,
    full_scale_a: PerRange<f64>,
    zero_v: f64,
    /// Codes per V, or per V at the pin.
    codes_per_v: f64,
    threshold_a: f64,
    release_a: f64,
}

/// A piece of the signal that is a straight line.
#[derive(Clone, Copy, Debug)]
struct Piece {
    start_s: f64,
    /// Signal over its span at start and end.
    from: f64,
    to: f64,
    end_s: f64,
    /// Integral of it up to the start, in s; and the same as the meter counts it.
    integral_s: f64,
    counted_s: f64,
    range: SensorRange,
}

impl Board {
    /// The board with this front end and a sliding average of `average` readings; `None` for a pair, which is no board.
    pub fn new(kind: FrontEndKind, average: u8) -> Option<Self> {
        let front_end = match kind {
            FrontEndKind::Pair => return None,
            FrontEndKind::DualRange => FrontEnd::DualRange(DualRange::default()),
            FrontEndKind::Hah1bv => FrontEnd::Hah1bv(Hah1bv::default()),
            FrontEndKind::Network => FrontEnd::Network(Network::default()),
            FrontEndKind::ClosedLoop => FrontEnd::ClosedLoop(ClosedLoop::default()),
        };
        let mut configuration = Configuration {
            front_end,
            ..Configuration::default()
        };
        configuration.derive();
        let supply = design::SENSOR_NOMINAL_SUPPLY;
        let corrections = Corrections {
            key_factors: PerRange::both(KeyFactors::NONE),
            gain: PerRange::both(Ppm::ZERO),
            zero_drift: configuration.zero_drift.value,
        };
        let coefficients = ConverterCoefficients::prepare(
            &configuration.converter,
            &front_end,
            &corrections,
            Some(supply),
        );
        let amps = |of: &dyn Fn(SensorRange) -> i32| PerRange {
            small: f64::from(of(SensorRange::Small)) * 1e-6,
            large: f64::from(of(SensorRange::Large)) * 1e-6,
        };
        let full_scale_a = amps(&|range| front_end.full_scale(range).get());
        let comparators = ComparatorConfig::default();
        let small = f64::from(design::DUAL_RANGE_SWING.get()) * 1e-6;
        let zero_v = front_end.line(SensorRange::Small, supply).zero_nanovolts as f64 * 1e-9;
        // The comparators stand on the small sensor.
        let per_v = full_scale_a.small / small;
        let threshold_a =
            (comparators.high_v - f64::from(design::SENSOR_ZERO.get()) * 1e-6) * per_v;
        let bits = configuration.converter.data_rate.bits();
        let codes_per_v = match front_end.channel() {
            Channel::Ads1100 => f64::from(1_u32 << (bits - 1)) / (f64::from(supply.get()) * 1e-6),
            Channel::Adc1 => 1.0 / ADC1_STEP_V,
        };
        Some(Self {
            average: SlidingAverageConfig {
                length: average.max(1),
                ..configuration.average
            },
            span_a: amps(&|range| front_end.meter_full_scale(range).get()),
            full_scale_a,
            zero_v,
            codes_per_v,
            threshold_a,
            release_a: threshold_a - comparators.hysteresis_v * per_v,
            configuration,
            coefficients,
        })
    }

    /// Whether it has two sensors.
    pub fn has_two_ranges(&self) -> bool {
        self.configuration.front_end.has_two_ranges()
    }

    /// Time of a conversion, in s.
    pub fn conversion_s(&self) -> f64 {
        let channel = self.configuration.front_end.channel();
        self.configuration.converter.period(channel).as_ticks() as f64 * 1e-6
    }

    /// Step between two codes of the small or only sensor, in A.
    pub fn step_a(&self) -> f64 {
        self.span_a.small / (SIGNAL_SPAN_V * self.codes_per_v)
    }

    /// Largest current, in A.
    pub fn full_scale_a(&self) -> f64 {
        self.full_scale_a.large.max(self.full_scale_a.small)
    }

    /// Where the small range ends, in A; `None` with one range.
    pub fn range_limit_a(&self) -> Option<f64> {
        self.has_two_ranges().then_some(self.threshold_a)
    }

    /// Full scale of the large range over that of the small one; 0 with one range.
    pub fn range_ratio(&self) -> f64 {
        if self.has_two_ranges() {
            self.full_scale_a.large / self.full_scale_a.small
        } else {
            0.0
        }
    }

    /// Charge of one count in the small range, in C.
    pub fn charge_step_c(&self) -> f64 {
        let charge = self
            .configuration
            .meter
            .charge_per_count(SensorRange::Small);
        charge.get() as f64 * 1e-9
    }

    /// How closely the rows tell the time of the conversions on whose grid they are placed, in s; 0 where they are placed
    /// at the rows themselves.
    ///
    /// Each row is late by up to a step. Where the two periods have a common multiple, only a few latenesses occur, and the
    /// mean of those is known to about a quarter of a step.
    pub fn slack_s(&self, observed: &Observed) -> f64 {
        let rows = 0..observed.t_s.len();
        let step_s = row_step_s(observed, rows).unwrap_or(0.0);
        let seen = observed.valid.iter().filter(|valid| **valid).count();
        if tells_no_grid(observed, step_s, seen, self.conversion_s()) {
            0.0
        } else {
            0.25 * step_s
        }
    }

    /// Readings in the sliding average.
    pub fn average(&self) -> u8 {
        self.average.length
    }

    /// What it reports at the rows of `observed`, driven by `drive`.
    pub fn run(
        &self,
        drive: &Drive,
        held: bool,
        observed: &Observed,
        pace: Pace,
        charge: bool,
    ) -> Reported {
        let rows = observed.t_s.len();
        let mut reported = Reported {
            current_a: vec![f64::NAN; rows],
            charge_c: vec![f64::NAN; if charge { rows } else { 0 }],
            range_high: vec![f64::NAN; rows],
            fresh: vec![false; rows],
        };
        let mut counted_before_c = 0.0;
        for (segment, these) in observed.stretches.iter() {
            if let Some(inside) = drive
                .segments
                .get(segment)
                .filter(|inside| !inside.is_empty())
            {
                let pieces = self.pieces(drive, inside.clone(), held);
                self.convert(&pieces, observed, these.clone(), pace, &mut reported);
                if charge {
                    counted_before_c =
                        self.count(&pieces, observed, these, counted_before_c, &mut reported);
                }
            }
        }
        reported
    }

    /// The signal over a segment.
    fn pieces(&self, drive: &Drive, rows: std::ops::Range<usize>, held: bool) -> Vec<Piece> {
        let mut maker = Maker {
            board: self,
            high: self.has_two_ranges() && drive.reference[rows.start].abs() > self.threshold_a,
            pieces: Vec::with_capacity(rows.len()),
            integral_s: 0.0,
            counted_s: 0.0,
        };
        for row in rows.start..rows.end - 1 {
            let (from_s, to_s) = (drive.t_s[row], drive.t_s[row + 1]);
            if to_s > from_s {
                let from = drive.reference[row];
                let to = if held { from } else { drive.reference[row + 1] };
                maker.line(from_s, from, to_s, to);
            }
        }
        if maker.pieces.is_empty() {
            let (at_s, current) = (drive.t_s[rows.start], drive.reference[rows.start]);
            maker.line(at_s, current, at_s + 1e-6, current);
        }
        maker.pieces
    }

    fn convert(
        &self,
        pieces: &[Piece],
        observed: &Observed,
        rows: std::ops::Range<usize>,
        pace: Pace,
        reported: &mut Reported,
    ) {
        let Some(first) = pieces.first() else {
            return;
        };
        let period_s = self.conversion_s();
        let length = usize::from(self.average.length);
        let mut chain = Chain::new(self, pieces, first.start_s - 1.0);
        let mut grid = 0_u64;
        // Before the first row the board stood at the first current for long.
        for back in (0..length).rev() {
            chain.conversion(first.start_s - back as f64 * period_s);
        }
        let (start, mut before_s) = (rows.start, first.start_s);
        let mut ends = match pace {
            Pace::Seen => ends(observed, rows.clone(), period_s),
            _ => Vec::new(),
        }
        .into_iter();
        for row in rows {
            let now_s = observed.t_s[row];
            let converted = chain.conversions;
            match pace {
                Pace::Seen => {
                    if observed.valid[row] {
                        chain.conversion(ends.next().unwrap_or(now_s));
                    }
                }
                Pace::Between => {
                    let missing = ((now_s - before_s) / period_s).ceil().max(0.0) as usize;
                    for back in (0..length.min(missing)).rev() {
                        chain.conversion(now_s - (0.5 + back as f64) * period_s);
                    }
                }
                Pace::Free => {
                    let due = ((now_s - first.start_s) / period_s).floor().max(0.0) as u64;
                    grid = grid.max(due.saturating_sub(length as u64));
                    while grid < due {
                        grid += 1;
                        chain.conversion(first.start_s + grid as f64 * period_s);
                    }
                }
            }
            before_s = now_s;
            reported.current_a[row] = chain.value;
            let seen = pace == Pace::Seen && observed.valid[row];
            reported.fresh[row] = seen || chain.conversions != converted || row == start;
            reported.range_high[row] = f64::from(u8::from(chain.range == SensorRange::Large));
        }
    }

    fn count(
        &self,
        pieces: &[Piece],
        observed: &Observed,
        rows: std::ops::Range<usize>,
        before_c: f64,
        reported: &mut Reported,
    ) -> f64 {
        let Some(first) = pieces.first() else {
            return before_c;
        };
        let start_s = first.start_s;
        let instant =
            |at_s: f64| Instant::from_ticks(((at_s - start_s) * 1e6).round().max(0.0) as u64);
        let per_s = design::METER_COUNTS_PER_SECOND_Q32 as f64 / 2_f64.powi(32);
        let mut meter = MeterChannel::new(self.configuration.meter);
        let mut edges = EdgeRecorder::new(instant(start_s), first.range == SensorRange::Large);
        let mut walk = Walk::new(pieces);
        let read = |meter: &mut MeterChannel, edges: &EdgeRecorder, counted_s: f64, at_s: f64| {
            let counts = (counted_s * per_s).floor() as i64;
            let energy = (((counts.rem_euclid(1 << 24)) as i32) << 8) >> 8;
            let at = instant(at_s);
            meter.on_reading(MeterReading { energy, at }, edges.history(at));
        };
        read(&mut meter, &edges, 0.0, start_s);
        let longest_s = Duration::as_ticks(&LONGEST_INTERVAL) as f64 * 0.5e-6;
        let mut last_s = start_s;
        let mut piece = 0;
        let mut total = before_c;
        for row in rows {
            let now_s = observed.t_s[row].max(last_s);
            // A range edge asks for a reading at once.
            while piece + 1 < pieces.len() && pieces[piece + 1].start_s <= now_s {
                piece += 1;
                let new = &pieces[piece];
                if new.range != pieces[piece - 1].range {
                    read(&mut meter, &edges, new.counted_s, new.start_s);
                    edges.on_edge(instant(new.start_s), new.range == SensorRange::Large);
                    last_s = new.start_s.max(last_s);
                }
            }
            while now_s - last_s > longest_s {
                last_s += longest_s;
                read(&mut meter, &edges, walk.counted(last_s), last_s);
            }
            read(&mut meter, &edges, walk.counted(now_s), now_s);
            last_s = now_s;
            total = before_c + meter.report().charge_total.get() as f64 * 1e-9;
            reported.charge_c[row] = total;
        }
        total
    }
}

/// Share of a step between rows by which the few may be earlier still.
const EARLY: f64 = 0.05;

/// When the conversions ended that valid rows saw for the first time: on a grid of their own if the changes of the
/// reading fit one, else at the rows.
fn ends(observed: &Observed, rows: std::ops::Range<usize>, period_s: f64) -> Vec<f64> {
    let valid: Vec<usize> = rows.clone().filter(|row| observed.valid[*row]).collect();
    let times = || valid.iter().map(|row| observed.t_s[*row]);
    let step_s = row_step_s(observed, rows).unwrap_or(0.0);
    if tells_no_grid(observed, step_s, valid.len(), period_s) {
        return times().collect();
    }
    // A value that stayed tells nothing either.
    let changes: Vec<f64> = valid
        .windows(2)
        .filter(|pair| observed.value[pair[0]] != observed.value[pair[1]])
        .map(|pair| observed.t_s[pair[1]])
        .collect();
    match grid(&changes, period_s, step_s) {
        Some((grid_s, start_s)) => {
            // The grid is known to a part of a step only, and no change comes before its conversion: but for the few that a range
            // change makes. A row can come much later, where a value was the same again.
            let wander = Wander::new(&changes, grid_s, start_s + 0.5 * step_s);
            let mut late_s: Vec<f64> = changes
                .iter()
                .map(|t| (t - start_s - wander.at(*t)) / grid_s)
                .map(|late| (late - late.round()) * grid_s)
                .collect();
            let few = late_s.len() / 200;
            let first_s = *late_s.select_nth_unstable_by(few, f64::total_cmp).1;
            let early_s = if first_s < 0.0 {
                (EARLY * step_s - first_s).min(0.5 * step_s)
            } else {
                0.0
            };
            let mut last: Option<(f64, f64)> = None;
            times()
                .map(|t| {
                    let start_s = start_s + wander.at(t);
                    let mut end_s =
                        start_s + ((t - start_s + early_s) / grid_s + 1e-6).floor() * grid_s;
                    // Where the phase moves, two rows that saw a conversion each could seem to see the same.
                    if let Some((row_s, before_s)) = last
                        && t - row_s > ANOTHER * grid_s
                    {
                        end_s = end_s.max(t.min(before_s + SOONEST * grid_s));
                    }
                    last = Some((t, end_s));
                    end_s
                })
                .collect()
        }
        None => times().collect(),
    }
}

/// By how much the phase of a grid differs from its mean in the course of a recording: single conversions are each started when the
/// last one was found, and a change of range starts one anew.
struct Wander {
    t_s: Vec<f64>,
    by_s: Vec<f64>,
}

impl Wander {
    /// From the times at which changes were seen, and the mean of where they fall on the grid.
    fn new(changes: &[f64], grid_s: f64, mean_s: f64) -> Self {
        let turns: Vec<(f64, f64)> = changes
            .iter()
            .map(|t| (std::f64::consts::TAU * (t - mean_s) / grid_s).sin_cos())
            .collect();
        // Sums from the first on: a window's is a difference of two.
        let mut sums = vec![(0.0, 0.0)];
        for (sine, cosine) in turns {
            let (sines, cosines) = sums[sums.len() - 1];
            sums.push((sines + sine, cosines + cosine));
        }
        let by_s = (0..changes.len())
            .map(|at| {
                let from = sums[at.saturating_sub(AROUND)];
                let to = sums[(at + AROUND + 1).min(changes.len())];
                let turns = f64::atan2(to.0 - from.0, to.1 - from.1) / std::f64::consts::TAU;
                turns * grid_s
            })
            .collect();
        Self {
            t_s: changes.to_vec(),
            by_s,
        }
    }

    /// At a time, in s: that of the nearest change.
    fn at(&self, t: f64) -> f64 {
        let after = self.t_s.partition_point(|change| *change < t);
        let before = after.saturating_sub(1);
        let nearer = match self.t_s.get(after) {
            Some(next) if next - t < (t - self.t_s[before]).abs() => after,
            _ => before,
        };
        self.by_s.get(nearer).copied().unwrap_or_default()
    }
}

/// Median step between rows.
fn row_step_s(observed: &Observed, rows: std::ops::Range<usize>) -> Option<f64> {
    let mut steps: Vec<f64> = observed.t_s[rows]
        .windows(2)
        .map(|pair| pair[1] - pair[0])
        .collect();
    let middle = steps.len() / 2;
    (!steps.is_empty()).then(|| *steps.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Without repeats between them the rows tell nothing of a grid.
fn tells_no_grid(observed: &Observed, step_s: f64, seen: usize, period_s: f64) -> bool {
    seen < FEWEST_OF_A_GRID
        || step_s <= 0.0
        || step_s > 0.75 * period_s
        || seen * 5 > observed.t_s.len() * 4
}

/// Period and phase of the grid from which rows `step_s` apart see changes, each late by less than that.
fn grid(changes: &[f64], period_s: f64, step_s: f64) -> Option<(f64, f64)> {
    let start_s = *changes.first()?;
    // How alike the phases are, 0 … 1, and their mean.
    let phase = |used: &[f64], trial_s: f64| {
        let (mut x, mut y) = (0.0, 0.0);
        for t in used {
            let angle = std::f64::consts::TAU * (t - start_s) / trial_s;
            x += angle.cos();
            y += angle.sin();
        }
        (x.hypot(y) / used.len() as f64, y.atan2(x))
    };
    // A wide range of periods for the first few, then more of them and a finer one.
    let mut count = FEWEST_OF_A_GRID.min(changes.len());
    let mut best_s = period_s;
    let mut width = CLOCK_WITHIN;
    loop {
        let used = &changes[..count];
        let cycles = ((used[count - 1] - start_s) / best_s).max(1.0);
        let tries = (width * cycles * 10.0).ceil().clamp(10.0, 2000.0) as i32;
        let (mut best, middle_s) = (0.0, best_s);
        for index in -tries..=tries {
            let trial_s = middle_s * (1.0 + width * f64::from(index) / f64::from(tries));
            let alike = phase(used, trial_s).0;
            if alike > best {
                (best, best_s) = (alike, trial_s);
            }
        }
        if count == changes.len() {
            break;
        }
        width = 0.3 / cycles;
        count = (2 * count).min(changes.len());
    }
    let (alike, angle) = phase(changes, best_s);
    // Evenly late by up to a step, phases are as alike as sin(x)/x of half of it.
    let half = std::f64::consts::PI * step_s / best_s;
    if alike < GRID_LIKE * half.sin() / half {
        return None;
    }
    let mean_s = angle / std::f64::consts::TAU * best_s;
    Some((best_s, start_s + mean_s - 0.5 * step_s))
}

/// Cuts the current into pieces of the signal.
struct Maker<'a> {
    board: &'a Board,
    high: bool,
    pieces: Vec<Piece>,
    integral_s: f64,
    counted_s: f64,
}

impl Maker<'_> {
    /// A straight line of current, cut where the range changes.
    fn line(&mut self, from_s: f64, from: f64, to_s: f64, to: f64) {
        let board = self.board;
        let (mut from_s, mut from) = (from_s, from);
        if board.has_two_ranges() {
            // Each pass cuts off one stay in a range.
            while let Some(share) = self.crossing(from, to) {
                let (at_s, at) = (from_s + (to_s - from_s) * share, from + (to - from) * share);
                self.clipped(from_s, from, at_s, at);
                self.high = !self.high;
                (from_s, from) = (at_s, at);
            }
        }
        self.clipped(from_s, from, to_s, to);
    }

    /// Where on the line the range changes, as a share of it.
    fn crossing(&self, from: f64, to: f64) -> Option<f64> {
        let board = self.board;
        if self.high {
            let level = board.release_a;
            if from.abs() < level {
                return Some(0.0);
            }
            // Only from the side on which it is.
            let level = level.copysign(from);
            let inside = if from > 0.0 { to < level } else { to > level };
            inside.then(|| (level - from) / (to - from))
        } else {
            let level = board.threshold_a;
            if from.abs() > level {
                return Some(0.0);
            }
            (to.abs() > level).then(|| (level.copysign(to) - from) / (to - from))
        }
    }

    /// A line within one range, cut where the sensor reaches its end.
    fn clipped(&mut self, from_s: f64, from: f64, to_s: f64, to: f64) {
        if to_s <= from_s {
            return;
        }
        let range = SensorRange::from_flag(self.high);
        let limit = self.board.full_scale_a.get(range);
        if from.abs().max(to.abs()) <= limit {
            self.piece(from_s, from, to_s, to, range);
            return;
        }
        let mut cuts = [0.0, 1.0, 1.0, 1.0];
        let mut count = 1;
        for level in [limit, -limit] {
            let share = (level - from) / (to - from);
            if share > 0.0 && share < 1.0 {
                cuts[count] = share;
                count += 1;
            }
        }
        cuts[1..count].sort_by(f64::total_cmp);
        for pair in cuts[..=count].windows(2) {
            let at = |share: f64| (from + (to - from) * share).clamp(-limit, limit);
            let time = |share: f64| from_s + (to_s - from_s) * share;
            self.piece(
                time(pair[0]),
                at(pair[0]),
                time(pair[1]),
                at(pair[1]),
                range,
            );
        }
    }

    fn piece(&mut self, start_s: f64, from: f64, end_s: f64, to: f64, range: SensorRange) {
        let span = self.board.span_a.get(range);
        let (from, to) = (from / span, to / span);
        self.pieces.push(Piece {
            start_s,
            from,
            to,
            end_s,
            integral_s: self.integral_s,
            counted_s: self.counted_s,
            range,
        });
        let area_s = 0.5 * (from + to) * (end_s - start_s);
        self.integral_s += area_s;
        let no_load = f64::from(design::METER_NO_LOAD.get()) * 1e-6;
        if from.abs().max(to.abs()) >= no_load {
            self.counted_s += area_s;
        }
    }
}

/// Looks the integral up, for times that mostly go forward.
struct Walk<'a> {
    pieces: &'a [Piece],
    at: usize,
}

impl<'a> Walk<'a> {
    fn new(pieces: &'a [Piece]) -> Self {
        Self { pieces, at: 0 }
    }

    /// The piece at a time, and how far the signal's integral has grown since its start.
    fn seek(&mut self, at_s: f64) -> (&'a Piece, f64) {
        while self.at > 0 && self.pieces[self.at].start_s > at_s {
            self.at -= 1;
        }
        while self.at + 1 < self.pieces.len() && self.pieces[self.at + 1].start_s <= at_s {
            self.at += 1;
        }
        let piece = &self.pieces[self.at];
        let since = at_s - piece.start_s;
        let grown = if since <= 0.0 {
            piece.from * since
        } else if at_s >= piece.end_s {
            // Beyond the last piece the signal stands still.
            let length = piece.end_s - piece.start_s;
            0.5 * (piece.from + piece.to) * length + piece.to * (at_s - piece.end_s)
        } else {
            let share = since / (piece.end_s - piece.start_s);
            (piece.from + 0.5 * (piece.to - piece.from) * share) * since
        };
        (piece, grown)
    }

    fn integral(&mut self, at_s: f64) -> f64 {
        let (piece, grown) = self.seek(at_s);
        piece.integral_s + grown
    }

    fn counted(&mut self, at_s: f64) -> f64 {
        let no_load = f64::from(design::METER_NO_LOAD.get()) * 1e-6;
        let (piece, grown) = self.seek(at_s);
        if piece.from.abs().max(piece.to.abs()) >= no_load {
            piece.counted_s + grown
        } else {
            piece.counted_s
        }
    }
}

/// From conversions to the reported current, in the board's own code.
struct Chain<'a> {
    board: &'a Board,
    begin: Walk<'a>,
    end: Walk<'a>,
    converter: Converter,
    average: SlidingAverage,
    /// Zero of the board's clock.
    clock_s: f64,
    value: f64,
    conversions: u64,
    range: SensorRange,
    configuration: u8,
}

impl<'a> Chain<'a> {
    fn new(board: &'a Board, pieces: &'a [Piece], clock_s: f64) -> Self {
        // The longest average there can be reaches back before the first row.
        let reach_s = board.conversion_s() * (f64::from(board.average.length) + 1.0);
        Self {
            board,
            begin: Walk::new(pieces),
            end: Walk::new(pieces),
            converter: Converter::new(),
            average: SlidingAverage::new(),
            clock_s: clock_s - reach_s,
            value: f64::NAN,
            conversions: 0,
            range: SensorRange::Small,
            configuration: board.configuration.converter.expected_configuration(),
        }
    }

    /// A conversion that ends at `end_s`.
    fn conversion(&mut self, end_s: f64) {
        let board = self.board;
        let period_s = board.conversion_s();
        let start_s = end_s - period_s;
        let from = self.begin.integral(start_s);
        let mean = (self.end.integral(end_s) - from) / period_s;
        let (first, last) = (self.begin.at, self.end.at);
        self.range = self.end.pieces[last].range;
        // Two edges cancel in the range, not in the reading.
        let spoiled = board.has_two_ranges()
            && self.end.pieces[first..=last.max(first)]
                .iter()
                .any(|piece| piece.range != self.range);
        let volts = board.zero_v + mean * SIGNAL_SPAN_V;
        let code = (volts * board.codes_per_v).round();
        let ticks =
            |at_s: f64| Instant::from_ticks(((at_s - self.clock_s) * 1e6).round().max(0.0) as u64);
        let context = SampleContext {
            range: self.range,
            spoiled_by_edge: spoiled,
            ..SampleContext::default()
        };
        let converter = &board.configuration.converter;
        let reading = match board.configuration.front_end.channel() {
            Channel::Ads1100 => self.converter.on_sample(
                converter,
                &board.coefficients,
                &ConverterSample {
                    started: ticks(start_s),
                    finished: ticks(end_s),
                    configuration: self.configuration,
                    code: code.clamp(-32_768.0, 32_767.0) as i16,
                },
                &context,
            ),
            Channel::Adc1 => self.converter.on_adc1_sample(
                converter,
                &board.coefficients,
                &Adc1Sample {
                    started: ticks(start_s),
                    finished: ticks(end_s),
                    volts: core_logic::units::Microvolts((code * ADC1_STEP_V * 1e6).round() as i32),
                },
                &context,
            ),
        };
        // Not newer than the last one: the board drops it.
        let Some(reading) = reading else {
            return;
        };
        self.conversions += 1;
        let amps = |current: core_logic::units::Microamps| f64::from(current.get()) * 1e-6;
        if board.average.length > 1 {
            self.average.push(&board.average, &reading);
            self.value = self
                .average
                .average(&board.average, reading.at)
                .map_or(f64::NAN, |average| amps(average.current));
        } else {
            self.value = if spoiled {
                f64::NAN
            } else {
                amps(reading.current)
            };
        }
    }
}
