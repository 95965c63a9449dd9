//! What a signal does between the drive's rows.
//!
//! A reference is straight between its rows, or held. Behind a low-pass it bends there, a change of range leaves a decay that begins
//! there, and averages and late clocks look there: what one of them makes is no straight line to the next. So a signal is its values
//! at the rows and how it bends between them, both exact, and a converter waits until it is known at which times it is asked.

use std::sync::Arc;

use super::means::{Means, MeansOfMean};
use super::scene::{Cursor, Scene, floored};
use crate::problem::Series;

/// So many rows long is a window at most that is slid over a sliding mean.
const SHORT: f64 = 2.0;
/// Time constants after which a decay is less than the last digit of what it began with.
const GONE: f64 = 40.0;

/// How a signal differs from straight lines between rows (or held values), and what is still to look at it.
#[derive(Clone, Debug, Default)]
pub struct Between {
    low_pass: Option<LowPass>,
    decays: Vec<Decay>,
    /// Window in s of a sliding mean ahead of the converter; 0 without.
    mean_ahead_s: f64,
    converter: Option<Converter>,
}

/// What looks at a signal over stretches of time.
#[derive(Clone, Copy, Debug)]
pub enum Converter {
    /// The mean of the last `window_s`; before the start of a segment the signal stood at its first value.
    Mean {
        /// Length of the window in s.
        window_s: f64,
    },
    /// The mean over the first part of each period, held until the next one. It goes on while nothing is recorded: what flowed then
    /// is a straight line.
    Windows {
        /// Period in s.
        period_s: f64,
        /// Share of it that is measured.
        duty: f64,
        /// Begin of the first period in s after that of the operation.
        phase_s: f64,
    },
}

/// A signal behind a first-order low-pass, with what goes in: between rows τ·dy/dt + y = x with x straight, or held.
#[derive(Clone, Debug)]
pub(super) struct LowPass {
    tau_s: f64,
    input: Series,
    /// At the rows.
    output: Series,
}

impl LowPass {
    /// At a time beyond the row where a cursor stands.
    fn beyond(&self, cursor: &Cursor<'_>, t: f64, held: bool) -> f64 {
        let (row, since_s) = (cursor.row(), cursor.since_s(t));
        let (x, y) = (self.input[row], self.output[row]);
        if since_s <= 0.0 {
            return y;
        }
        let slope = match cursor.step_s() {
            Some(step_s) if !held => (self.input[row + 1] - x) / step_s,
            _ => 0.0,
        };
        let late = slope * self.tau_s;
        x + slope * since_s - late + (y - x + late) * (-since_s / self.tau_s).exp()
    }
}

/// Exponential decays of one time constant, each from an instant on, until the next one.
#[derive(Clone, Debug)]
struct Decay {
    tau_s: f64,
    /// Of each segment, in order.
    since: Arc<Vec<Vec<Since>>>,
}

/// The beginning of a decay.
#[derive(Clone, Copy, Debug)]
struct Since {
    t_s: f64,
    value: f64,
    /// Sum of all jumps up to here.
    jumped: f64,
}

impl Decay {
    /// From when each one begins, in s, and its value then, segment by segment.
    fn new(tau_s: f64, begins: Vec<Vec<(f64, f64)>>) -> Self {
        let of_segment = |begins: Vec<(f64, f64)>| {
            let mut last = Since {
                t_s: f64::NEG_INFINITY,
                value: 0.0,
                jumped: 0.0,
            };
            let since = begins.into_iter().map(|(t_s, value)| {
                last = Since {
                    t_s,
                    value,
                    jumped: last.jumped + value - last.at(t_s, tau_s),
                };
                last
            });
            since.collect()
        };
        Self {
            tau_s,
            since: Arc::new(begins.into_iter().map(of_segment).collect()),
        }
    }

    /// Behind a low-pass: e^(−t/τ₁) becomes τ₁/(τ₁−τ₂)·e^(−t/τ₁), and a decay of its own time constant.
    fn low_passed(&self, tau_s: f64) -> [Self; 2] {
        /// Closer than this they are taken as apart by as much: the two parts cancel.
        const ALIKE: f64 = 1e-5;
        let apart = self.tau_s - tau_s;
        let apart = if apart.abs() < ALIKE * tau_s {
            (ALIKE * tau_s).copysign(apart)
        } else {
            apart
        };
        let own_s = tau_s + apart;
        let share = own_s / apart;
        let (mut kept, mut filtered) = (Vec::new(), Vec::new());
        for since in self.since.iter() {
            let (mut before, mut here, mut free) = (f64::NEG_INFINITY, 0.0, 0.0);
            let (mut kept_here, mut filtered_here) = (Vec::new(), Vec::new());
            for begin in since {
                let since_s = begin.t_s - before;
                let output = if since_s.is_finite() {
                    here * (-since_s / own_s).exp() + free * (-since_s / tau_s).exp()
                } else {
                    0.0
                };
                (before, here) = (begin.t_s, share * begin.value);
                free = output - here;
                kept_here.push((begin.t_s, here));
                filtered_here.push((begin.t_s, free));
            }
            kept.push(kept_here);
            filtered.push(filtered_here);
        }
        [Self::new(own_s, kept), Self::new(tau_s, filtered)]
    }
}

impl Since {
    fn at(&self, t: f64, tau_s: f64) -> f64 {
        let taus = (t - self.t_s) / tau_s;
        // What is left then is less than the last digit.
        if self.value == 0.0 || taus > GONE {
            return 0.0;
        }
        self.value * (-taus).exp()
    }
}

/// A place in the decays of a segment, for times that mostly go forward.
#[derive(Clone, Debug)]
struct Decaying<'s> {
    tau_s: f64,
    since: &'s [Since],
    /// How many have begun.
    begun: usize,
}

impl Decaying<'_> {
    /// The decay that a time is in.
    #[inline]
    fn of(&mut self, t: f64) -> Option<&Since> {
        while self.since.get(self.begun).is_some_and(|next| next.t_s <= t) {
            self.begun += 1;
        }
        while self.begun > 0 && self.since[self.begun - 1].t_s > t {
            self.begun -= 1;
        }
        self.since[..self.begun].last()
    }

    #[inline]
    fn value(&mut self, t: f64) -> f64 {
        let tau_s = self.tau_s;
        self.of(t).map_or(0.0, |since| since.at(t, tau_s))
    }

    /// Integral up to a time: e′ = −e/τ between jumps.
    #[inline]
    fn until(&mut self, t: f64) -> f64 {
        let tau_s = self.tau_s;
        self.of(t)
            .map_or(0.0, |since| tau_s * (since.jumped - since.at(t, tau_s)))
    }

    /// Integral of [`Decaying::until`] from one time to a later one.
    fn integral_until(&mut self, from: f64, to: f64) -> f64 {
        let before = self.until(from);
        let mut jumped = 0.0;
        let mut at = from;
        while at < to {
            let next = self
                .since
                .get(self.begun)
                .map_or(to, |next| next.t_s.min(to));
            let last = self.since[..self.begun].last();
            jumped += last.map_or(0.0, |since| since.jumped) * (next - at);
            at = next;
            self.begun += usize::from(at < to);
        }
        let tau_s = self.tau_s;
        tau_s * (jumped - (self.until(to) - before))
    }
}

/// The signal of a segment, at times that mostly go forward.
struct Course<'s> {
    between: &'s Between,
    /// Straight lines: the signal, or what goes into its low-pass.
    lines: &'s [f64],
    at: Place<'s>,
    /// Where a mean is ahead of the converter: the lines behind it, and the place a window earlier.
    ahead: Option<(MeansOfMean<'s>, Place<'s>)>,
}

/// Where stretches of the signal begin, and where they end.
struct Place<'s> {
    cursors: [Cursor<'s>; 2],
    decays: [Vec<Decaying<'s>>; 2],
    /// Of the lines; nothing without a converter.
    means: Option<Means<'s>>,
    held: bool,
}

impl<'s> Course<'s> {
    fn of(scene: &'s Scene<'_>, segment: usize) -> Self {
        let (drive, between) = (scene.drive, &scene.between);
        let held = scene.held();
        let lines = match &between.low_pass {
            Some(low_pass) => &low_pass.input[..],
            None => &scene.signal[..],
        };
        let decays = between.decays.iter().map(|decay| Decaying {
            tau_s: decay.tau_s,
            since: &decay.since[segment],
            begun: 0,
        });
        let decays: Vec<Decaying<'_>> = decays.collect();
        let place = || {
            let cursor = Cursor::new(&drive.t_s, drive.segments[segment].clone());
            let means = between.converter.is_some();
            Place {
                cursors: [cursor.clone(), cursor],
                decays: [decays.clone(), decays.clone()],
                means: means.then(|| scene.steps.means(drive, segment, lines, held)),
                held,
            }
        };
        let window_s = between.mean_ahead_s;
        let ahead = (window_s > 0.0).then(|| {
            let of_lines = MeansOfMean::new(drive, segment, lines, held, window_s);
            (of_lines, place())
        });
        Self {
            between,
            lines,
            at: place(),
            ahead,
        }
    }

    fn value(&mut self, t: f64) -> f64 {
        let (held, cursor) = (self.at.held, &mut self.at.cursors[0]);
        let straight = match &self.between.low_pass {
            Some(low_pass) => {
                cursor.seek(t);
                low_pass.beyond(cursor, t, held)
            }
            None => cursor.value(self.lines, t, held),
        };
        let decays = self.at.decays[0].iter_mut();
        straight + decays.map(|decay| decay.value(t)).sum::<f64>()
    }

    /// Mean from one time to a later one; beyond the ends the lines hold their end values.
    fn mean(&mut self, from_s: f64, to_s: f64) -> f64 {
        let window_s = self.between.mean_ahead_s;
        let length_s = to_s - from_s;
        let Some((of_lines, earlier)) = &mut self.ahead else {
            return self.mean_of_signal(from_s, to_s);
        };
        if length_s.is_nan() || length_s <= 0.0 {
            return self.mean_of_signal(to_s - window_s, to_s);
        }
        let mut mean = of_lines.mean(from_s, to_s);
        let before = [from_s - window_s, to_s - window_s];
        if let Some(low_pass) = &self.between.low_pass {
            // The mean of ∫y = ∫x − τ·Δy over the window.
            let now = self.at.mean(Some(low_pass), from_s, to_s);
            let then = earlier.mean(Some(low_pass), before[0], before[1]);
            mean -= low_pass.tau_s * (now - then) / window_s;
        }
        let now = self.at.decays[0].iter_mut();
        let decays = now.zip(&mut earlier.decays[0]).map(|(now, then)| {
            now.integral_until(from_s, to_s) - then.integral_until(before[0], before[1])
        });
        mean + decays.sum::<f64>() / (window_s * length_s)
    }

    fn mean_of_signal(&mut self, from_s: f64, to_s: f64) -> f64 {
        let length_s = to_s - from_s;
        if self.at.means.is_none() || length_s.is_nan() || length_s <= 0.0 {
            return self.value(to_s);
        }
        let mean = self.at.mean(self.between.low_pass.as_ref(), from_s, to_s);
        if self.between.decays.is_empty() {
            return mean;
        }
        let [from, to] = &mut self.at.decays;
        let ends = from.iter_mut().zip(to);
        let decayed = ends.map(|(from, to)| to.until(to_s) - from.until(from_s));
        mean + decayed.sum::<f64>() / length_s
    }
}

impl Place<'_> {
    /// Mean of the lines, or of what comes out of their low-pass, from one time to a later one.
    #[inline]
    fn mean(&mut self, low_pass: Option<&LowPass>, from_s: f64, to_s: f64) -> f64 {
        let Some(means) = &mut self.means else {
            return f64::NAN;
        };
        let mean = means.mean(from_s, to_s);
        let Some(low_pass) = low_pass else {
            return mean;
        };
        // ∫y = ∫x − τ·Δy.
        let [from, to] = &mut self.cursors;
        from.seek(from_s);
        to.seek(to_s);
        let at = |cursor: &Cursor<'_>, t| low_pass.beyond(cursor, t, self.held);
        mean - low_pass.tau_s * (at(to, to_s) - at(from, from_s)) / (to_s - from_s)
    }
}

impl Scene<'_> {
    /// Whether the signal is straight between its rows, and nothing is still to look at it.
    pub(super) fn is_straight(&self) -> bool {
        let Between {
            low_pass,
            decays,
            converter,
            ..
        } = &self.between;
        low_pass.is_none() && decays.is_empty() && converter.is_none()
    }

    /// Has the signal go through a first-order low-pass. How it bent behind another one is not followed further.
    pub fn low_pass(&mut self, tau_s: f64) {
        if tau_s.is_nan() || tau_s <= 0.0 {
            return;
        }
        let low_pass = self.low_passed(tau_s);
        self.signal = low_pass.output.clone();
        self.between.low_pass = Some(low_pass);
        let decays = std::mem::take(&mut self.between.decays);
        let decays = decays.iter().flat_map(|decay| decay.low_passed(tau_s));
        self.between.decays = decays.collect();
    }

    /// The signal's straight lines behind a first-order low-pass.
    fn low_passed(&self, tau_s: f64) -> LowPass {
        let segments = &self.drive.segments;
        let output = self
            .steps
            .low_pass(segments, &self.signal, tau_s, self.held());
        LowPass {
            tau_s,
            input: self.signal.clone(),
            output: output.into(),
        }
    }

    /// Adds decays that begin at each change of the range: from what a low-pass of the signal is then, what has decayed by then, and
    /// whether the change is to the large range.
    pub fn decay_from_changes(&mut self, tau_s: f64, begin: impl Fn(f64, f64, bool) -> f64) {
        let (drive, held) = (self.drive, self.held());
        let low_pass = self.low_passed(tau_s);
        let mut changes = self.changes.iter().peekable();
        let mut begins = vec![Vec::new(); drive.segments.len()];
        for (rows, begins) in drive.segments.iter().zip(&mut begins) {
            let mut cursor = Cursor::new(&drive.t_s, rows.clone());
            let mut last: Option<(f64, f64)> = None;
            while let Some(change) = changes.next_if(|change| change.row < rows.end) {
                let t = drive.t_s[change.row] - change.since_s;
                cursor.seek(t);
                let plain = low_pass.beyond(&cursor, t, held);
                let decayed = last.map_or(0.0, |(then, value): (f64, f64)| {
                    value * ((then - t) / tau_s).exp()
                });
                let value = begin(plain, decayed, change.high);
                begins.push((t, value));
                last = Some((t, value));
            }
        }
        self.between.decays.push(Decay::new(tau_s, begins));
    }

    /// Has a converter look at the signal, at the times at which it will be asked.
    pub fn convert(&mut self, converter: Converter) {
        match self.between.converter {
            Some(Converter::Mean { window_s })
                if self.between.mean_ahead_s <= 0.0 && self.is_short(converter) =>
            {
                self.between.mean_ahead_s = window_s;
            }
            // What it has looked at is a straight line from one row to the next from here on.
            Some(_) => self.onto_rows(),
            None => {}
        }
        self.between.converter = Some(converter);
    }

    /// Whether it looks at so little each time that what is ahead of it can be worked out for that.
    fn is_short(&self, converter: Converter) -> bool {
        let length_s = match converter {
            Converter::Mean { window_s } => window_s,
            Converter::Windows { period_s, duty, .. } => duty * period_s,
        };
        let segments = self.drive.segments.iter().filter(|rows| !rows.is_empty());
        let (span_s, steps) = segments.fold((0.0, 0usize), |(span_s, steps), rows| {
            let [first, last] = [rows.start, rows.end - 1].map(|row| self.drive.t_s[row]);
            (span_s + last - first, steps + rows.len() - 1)
        });
        length_s * steps as f64 <= SHORT * span_s
    }

    /// The signal as it is at the drive's rows, with straight lines between them from here on.
    pub fn onto_rows(&mut self) {
        let (drive, between) = (self.drive, &self.between);
        if self.is_straight() {
            return;
        }
        let is_bent = between.low_pass.is_some() || !between.decays.is_empty();
        match between.converter {
            // What bends between rows is at the rows what it is.
            None if between.decays.is_empty() => {}
            Some(Converter::Mean { window_s }) if !is_bent && between.mean_ahead_s <= 0.0 => {
                let mean = self
                    .steps
                    .boxcar(drive, &self.signal, window_s, self.held());
                self.signal = mean.into();
            }
            _ => {
                let mut output = self.signal.to_vec();
                for (segment, rows) in drive.segments.iter().enumerate() {
                    if !rows.is_empty() {
                        let times = &drive.t_s[rows.clone()];
                        self.at(segment, times, |t| t, &mut output[rows.clone()]);
                    }
                }
                self.signal = output.into();
            }
        }
        self.between = Between::default();
    }

    /// What has looked at the signal says at times of a segment, by the sensor's clock; `reference_s` says when those were.
    pub(super) fn at(
        &self,
        segment: usize,
        times: &[f64],
        reference_s: impl Fn(f64) -> f64,
        out: &mut [f64],
    ) {
        let mut course = Course::of(self, segment);
        let pairs = out.iter_mut().zip(times);
        match self.between.converter {
            None => pairs.for_each(|(out, t)| *out = course.value(reference_s(*t))),
            Some(Converter::Mean { window_s }) => pairs.for_each(|(out, t)| {
                *out = course.mean(reference_s(t - window_s), reference_s(*t));
            }),
            Some(Converter::Windows {
                period_s,
                duty,
                phase_s,
            }) => {
                let drive = self.drive;
                let rows = &drive.segments[segment];
                let operation = self.operations[segment].clone();
                let start = drive.t_s[operation.start] + phase_s;
                // What is recorded, and what is held before and after an operation.
                let recorded = |from_s: f64, to_s: f64| {
                    (operation.start == rows.start || from_s >= drive.t_s[rows.start])
                        && (operation.end == rows.end || to_s <= drive.t_s[rows.end - 1])
                };
                let mut lines: Option<Means<'_>> = None;
                let (mut value, mut until) = (self.signal[operation.start], f64::NEG_INFINITY);
                let mut known = f64::NAN;
                for (out, t) in pairs {
                    let elapsed = t - start;
                    // Well before the next window ends there is nothing to ask.
                    if elapsed.is_nan() || elapsed >= until {
                        // The newest window that has ended.
                        let ended = floored((elapsed - duty * period_s) / period_s);
                        until = (ended + 1.0 - 1e-6) * period_s + duty * period_s;
                        if ended >= 0.0 && ended != known {
                            known = ended;
                            let from = start + ended * period_s;
                            let [from, to] = [from, from + duty * period_s].map(&reference_s);
                            value = if recorded(from, to) {
                                course.mean(from, to)
                            } else {
                                let lines = lines.get_or_insert_with(|| {
                                    let (operation, at) = (operation.clone(), rows.start);
                                    Means::around(drive, operation, at, &self.signal, self.held())
                                });
                                lines.mean(from, to)
                            };
                        }
                    }
                    *out = value;
                }
            }
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use proptest::prelude::*;

    use crate::effects::chain::{Chain, Nuisance};
    use crate::effects::find;
    use crate::problem::{Base, Moments, Problem};

    /// Rows made of each step of a drive.
    const PARTS: usize = 5;

    /// The same straight lines (or held values), told in more rows.
    fn told_in_more_rows(problem: &Problem) -> Problem {
        let Base::Sensor(sensor) = &problem.base else {
            return problem.clone();
        };
        let drive = &problem.drive;
        let mut finer = problem.clone();
        let (mut t_s, mut reference, mut range_high) = (Vec::new(), Vec::new(), Vec::new());
        let mut recorded = Vec::new();
        finer.drive.segments = (drive.segments.iter())
            .map(|rows| {
                let start = t_s.len();
                for row in rows.clone() {
                    recorded.push(t_s.len());
                    let last = row + 1 == rows.end;
                    for part in 0..if last { 1 } else { PARTS } {
                        let share = part as f64 / PARTS as f64;
                        let between = |series: &[f64]| {
                            let next = series[(row + 1).min(rows.end - 1)];
                            series[row] + share * (next - series[row])
                        };
                        t_s.push(between(&drive.t_s));
                        reference.push(if sensor.held_reference {
                            drive.reference[row]
                        } else {
                            between(&drive.reference)
                        });
                        range_high.extend(drive.range_high.as_ref().map(|flag| flag[row]));
                    }
                }
                start..t_s.len()
            })
            .collect();
        finer.drive.range_high = drive.range_high.is_some().then(|| range_high.into());
        (finer.drive.t_s, finer.drive.reference) = (t_s.into(), reference.into());
        finer.drive.parts = PARTS;
        finer.observed.moments = Moments::Rows(recorded);
        finer
    }

    /// A drive of two stretches with a gap between them, its steps even or not.
    fn problem() -> impl Strategy<Value = Problem> {
        let rows = prop::collection::vec((-200.0f64..200.0, 0.5f64..1.5), 12..40);
        (rows, any::<bool>(), any::<bool>(), 0.0f64..3.0).prop_map(|(rows, even, held, gap_s)| {
            let half = rows.len() / 2;
            let mut t = 0.0;
            let t_s: Vec<f64> = (rows.iter().enumerate())
                .map(|(row, (_, step))| {
                    t += if even { 0.1 } else { 0.1 * step };
                    t += if row == half { gap_s } else { 0.0 };
                    t
                })
                .collect();
            let reference: Vec<f64> = rows.iter().map(|(value, _)| *value).collect();
            let flag = reference.iter().map(|value| f64::from(value.abs() > 60.0));
            let range_high = flag.collect::<Vec<f64>>();
            let mut problem = Problem::pair(t_s, reference.clone(), reference, 0.0);
            problem.drive.segments = vec![0..half, half..rows.len()];
            problem.drive.continues = vec![false, gap_s > 1.0];
            problem.drive.range_high = Some(range_high.into());
            let segment = |row| usize::from(row >= half);
            problem.observed.stretches = (0..rows.len()).map(segment).collect();
            if let Base::Sensor(sensor) = &mut problem.base {
                sensor.held_reference = held;
            }
            problem
        })
    }

    type Members = Vec<(&'static str, Vec<f64>)>;

    /// Effects that look, or bend, between rows of 0.1 s; of converters there is one, or a mean ahead of short windows.
    fn members() -> impl Strategy<Value = Members> {
        let tau_s = || (-3.0f64..0.0).prop_map(|power| 10f64.powf(power));
        let handover = tau_s().prop_map(|tau_s| ("range-handover", vec![tau_s]));
        let delay = (-0.2f64..0.2).prop_map(|delay_s| ("delay", vec![delay_s]));
        let skew = (-3000.0f64..3000.0).prop_map(|ppm| ("clock-skew", vec![ppm]));
        let lag = tau_s().prop_map(|tau_s| ("lag", vec![tau_s]));
        let converter = prop_oneof![
            (0.001f64..0.15).prop_map(|window_s| ("moving-average", vec![window_s])),
            (tau_s(), 0.01f64..1.0, 0.0f64..0.1).prop_map(|(period_s, duty, phase_s)| {
                ("sampled-window", vec![period_s, duty, phase_s])
            }),
        ];
        // Windows that are short beside a row look at what a mean makes between rows.
        let short =
            (0.001f64..0.15, -3.0f64..-1.7, 0.01f64..1.0).prop_map(|(window_s, power, duty)| {
                let windows = ("sampled-window", vec![10f64.powf(power), duty, 0.0]);
                vec![("moving-average", vec![window_s]), windows]
            });
        let converters = prop_oneof![converter.prop_map(|one| vec![one]), short];
        let option = prop::option::of::<BoxedStrategy<(&'static str, Vec<f64>)>>;
        let all = (
            option(handover.boxed()),
            option(delay.boxed()),
            option(skew.boxed()),
            option(lag.boxed()),
            prop::option::of(converters),
        );
        all.prop_map(|(a, b, c, d, converters)| {
            let ahead = [a, b, c, d].into_iter().flatten();
            ahead.chain(converters.into_iter().flatten()).collect()
        })
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(2000))]

        /// More rows on the same straight lines are no other current.
        #[test]
        fn how_many_rows_tell_a_current_does_not_matter(
            problem in problem(),
            members in members(),
            alignment_s in prop_oneof![Just(0.0), -0.05f64..0.05],
        ) {
            // A window over a gap is known to within what bends at its ends.
            let windows = members.iter().any(|(id, _)| *id == "sampled-window");
            prop_assume!(!(windows && problem.drive.continues[1]));
            let finer = told_in_more_rows(&problem);
            let members = members.iter().map(|(id, values)| (find(id).unwrap(), &values[..]));
            let members: Vec<_> = members.collect();
            let nuisance = Nuisance { alignment_s, ..Nuisance::default() };
            let coarse = Chain::new(&problem).run(&members, &nuisance);
            let fine = Chain::new(&finer).run(&members, &nuisance);
            for (row, (coarse, fine)) in coarse.iter().zip(&fine).enumerate() {
                prop_assert_eq!(coarse.is_nan(), fine.is_nan(), "row {}", row);
                let apart = (coarse - fine).abs();
                prop_assert!(coarse.is_nan() || apart < 1e-6, "row {row}: {coarse} and {fine}");
            }
        }
    }
}
