//! The meter's charge against the converter's integral over the same time, with a bound that follows from the error
//! budget.
//!
//! Both channels hang on the analog switch's output and then go separate ways. So the comparison finds
//! - a break or a short in one of the two ways that makes that channel read like 0 A, or any other current,
//! - a meter that has stopped counting (frozen AENERGY, dead crystal), within 1 s while at least
//!   [`CompareConfig::frozen_current`] flows,
//! - a converter that repeats itself while the current moves,
//! - a wrong scale in one of the two, beyond the tolerances.
//!
//! It cannot find what both see alike: a sensor that has come off upstream of the switch and floats at 2.5 V reads 0 A
//! in both. Only another sensor can tell that from 0 A: the small sensor's own channel against the passed one
//! (`range::FlagPlausibility`), or the open-sensor network (`open_sensor`), which pulls an open input to a rail.
//!
//! # How the times are made to match
//!
//! A conversion is the mean over its own time. Between two usable conversions the current is interpolated; the
//! doubt of that is half their difference times the gap, or, where conversions were spoiled in between, both
//! magnitudes times the gap. A window ends at a meter report; its end is evaluated when the conversion that spans it
//! has come in.
//!
//! The sensor's output is a share of its supply, which the converter divides out at once, the meter with a later poll, and both
//! by a mean of readings. While a reading is off from that mean, the bound has in it what they differ by
//! ([`ChannelCompare::on_supply`]); other factors begin the comparison anew.

use serde::{Deserialize, Serialize};

use crate::error_budget;
use crate::front_end::PerRange;
use crate::meter::{MeterReport, energy_difference};
use crate::range::Range;
use crate::units::{
    self, Duration, Instant, Microamps, Nanocoulombs, Ppm, add_i64, clamp_i32, elapsed,
    milliseconds, mul_div, mul_i64,
};

/// Tolerances and windows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct CompareConfig {
    /// Length of the fast window, in ms.
    pub fast_window_ms: u32,
    /// Length of the slow window, in ms: it averages the quantisation away and so has the finer bound.
    pub slow_window_ms: u32,
    /// Share by which the channels may differ.
    pub gain_tolerance: Ppm,
    /// Current by which they may differ at any reading. A front end of one sensor has that of the large one.
    pub zero_tolerance: PerRange<Microamps>,
    /// Share of a window that usable conversions and the short gaps between them must cover.
    pub covered_share: Ppm,
    /// Longest gap between usable conversions that counts as short, in ms.
    pub short_gap_ms: u32,
}

impl CompareConfig {
    /// Current from which on a frozen meter is found within 1 s: the converter's charge since the last count has to
    /// exceed twice its doubt and three counts, in 80 % of that second, since conversions lag behind.
    #[must_use]
    pub const fn frozen_current(&self, range: Range, count: Nanocoulombs) -> Microamps {
        // nC in 1 s are nA.
        let counts =
            crate::units::div_round(crate::units::mul_i64(count.get(), 2 * FROZEN_COUNTS), 1_000);
        let doubt = 2 * self.zero_tolerance.get(range).get() as i64;
        Microamps(crate::units::clamp_i32(crate::units::mul_div(
            doubt.saturating_add(counts),
            5,
            4,
        )))
    }
}

impl Default for CompareConfig {
    fn default() -> Self {
        Self {
            fast_window_ms: 1_000,
            slow_window_ms: 10_000,
            gain_tolerance: error_budget::CHANNEL_GAIN_TOLERANCE,
            zero_tolerance: error_budget::CHANNEL_ZERO_TOLERANCE,
            covered_share: Ppm(500_000),
            short_gap_ms: 100,
        }
    }
}

/// Counts that a running meter would have made for certain before it is called frozen.
const FROZEN_COUNTS: i64 = 3;

/// A conversion, as the comparison needs it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Conversion {
    /// Begin of the time over which it averaged.
    pub started: Instant,
    /// End of it.
    pub finished: Instant,
    /// The mean current.
    pub current: Microamps,
    /// The range it was taken in.
    pub range: Range,
    /// Whether it is valid.
    pub usable: bool,
}

/// Result of one window.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Outcome {
    /// Too few usable conversions, or the meter did not count throughout.
    #[default]
    Undecided,
    /// The charges differ by no more than the bound.
    Agree {
        /// Meter less converter.
        difference: Nanocoulombs,
        /// What they may differ by.
        bound: Nanocoulombs,
    },
    /// They differ by more.
    Disagree {
        /// Meter less converter.
        difference: Nanocoulombs,
        /// What they may differ by.
        bound: Nanocoulombs,
    },
}

/// The newest findings.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct CompareReport {
    /// Of the last complete fast window.
    pub fast: Outcome,
    /// Of the last complete slow window.
    pub slow: Outcome,
    /// The meter has not counted although the converter shows a current that it would have counted.
    pub frozen: bool,
    /// The meter is reported lost.
    pub meter_lost: bool,
    /// Fast windows that disagreed; stops at the type's end.
    pub disagreements: u32,
    /// Bound of the charge that the meter has missed or miscounted since the start while it stood still or disagreed. What a
    /// meter that stands still misses is in it once that is found, from its last count on.
    pub miscounted: Nanocoulombs,
}

/// What the converter has measured since the start. Its sums may wrap: only differences are used, over seconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
struct Integral {
    /// nC.
    charge: i64,
    /// nC by which it may differ from a meter without fault.
    doubt: i64,
    /// µs covered.
    covered: u64,
}

impl Integral {
    #[inline(never)]
    const fn since(&self, earlier: &Self) -> Self {
        Self {
            charge: self.charge.wrapping_sub(earlier.charge),
            doubt: self.doubt.wrapping_sub(earlier.doubt),
            covered: self.covered.saturating_sub(earlier.covered),
        }
    }
}

/// The meter's side at an instant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
struct MeterPoint {
    at: Instant,
    charge: Nanocoulombs,
    uncertainty: Nanocoulombs,
    resolution: Nanocoulombs,
}

impl MeterPoint {
    const fn new(at: Instant, report: &MeterReport) -> Self {
        Self {
            at,
            charge: report.charge_total,
            uncertainty: report.uncertainty,
            resolution: report.resolution,
        }
    }
}

/// A window from its begin on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
struct Window {
    meter: MeterPoint,
    converter: Integral,
}

/// What the channels may differ by because the sensor's supply moves.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
struct SupplyDoubt {
    /// Of the current.
    share: Ppm,
    /// That share of the sensor's output at 0 A.
    at_zero: PerRange<Microamps>,
    /// Readings of the supply for which it still holds.
    readings: u8,
}

/// A conversion may have begun before the supply moved; one at 8 samples a second is waited for half as long again as the nominal
/// 125 ms (`PollPace`), and the meter follows in 50 ms: (187.5 + 50) ms / 10 ms between two readings, rounded up.
const SUPPLY_DOUBT_READINGS: u8 = 24;

/// A meter that stands still, from the report that showed its last count on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
struct Count {
    at: Instant,
    /// [`MeterReport::energy`] then, which stands still since.
    energy: i32,
    /// [`MeterReport::charge_total`] then, which the offsets move on.
    charge: Nanocoulombs,
    /// [`ChannelCompare::flowed`] at the report before, up to which it has counted: what came later may be missing. Moves on with
    /// what is declared.
    before: Nanocoulombs,
    /// The converter's integral at the begin of the first conversion that began after that: what a conversion under way
    /// at the last count has measured may have been counted.
    converter: Option<Integral>,
}

/// Compares the two channels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ChannelCompare {
    integral: Integral,
    /// The newest usable conversion, and whether a spoiled one came after it.
    last: Option<(Conversion, bool)>,
    fast: Option<Window>,
    slow: Option<Window>,
    /// A meter point for which the conversion that spans it has not come yet.
    pending: Option<MeterPoint>,
    /// The meter's last count.
    moved: Option<Count>,
    /// Bound of the charge, without sign, that has flowed up to the end of the newest usable conversion.
    flowed: (Nanocoulombs, Instant),
    /// [`ChannelCompare::flowed`] at the newest report, and that report's instant.
    reported: (Nanocoulombs, Instant),
    /// A stand-still that has ended by the report of this instant, up to which conversions have not come yet; and
    /// [`Count::before`].
    ended: Option<(Nanocoulombs, Instant)>,
    gaps: u32,
    /// Reports of an earlier time are not looked at.
    not_before: Instant,
    supply_doubt: SupplyDoubt,
    report: CompareReport,
}

impl Default for ChannelCompare {
    fn default() -> Self {
        Self::new()
    }
}

impl ChannelCompare {
    /// Nothing compared yet.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            integral: Integral {
                charge: 0,
                doubt: 0,
                covered: 0,
            },
            last: None,
            fast: None,
            slow: None,
            pending: None,
            moved: None,
            flowed: (Nanocoulombs::ZERO, Instant::from_ticks(0)),
            reported: (Nanocoulombs::ZERO, Instant::from_ticks(0)),
            ended: None,
            gaps: 0,
            not_before: Instant::from_ticks(0),
            supply_doubt: SupplyDoubt {
                share: Ppm(0),
                at_zero: PerRange::both(Microamps::ZERO),
                readings: 0,
            },
            report: CompareReport {
                fast: Outcome::Undecided,
                slow: Outcome::Undecided,
                frozen: false,
                meter_lost: false,
                disagreements: 0,
                miscounted: Nanocoulombs::ZERO,
            },
        }
    }

    /// The newest findings.
    #[must_use]
    pub const fn report(&self) -> CompareReport {
        self.report
    }

    /// Takes a conversion, usable or not. No more than `full_scale` flows, the larger sensor's.
    pub fn on_conversion(
        &mut self,
        config: &CompareConfig,
        conversion: &Conversion,
        full_scale: Microamps,
    ) -> CompareReport {
        if !conversion.usable {
            if let Some((_, spoiled)) = &mut self.last {
                *spoiled = true;
            }
            return self.report;
        }
        let Some((previous, spoiled)) = self.last else {
            // Of what flowed since the newest conversion before nobody has seen anything.
            self.follow(full_scale, conversion.finished);
            self.last = Some((*conversion, false));
            self.pending = None;
            return self.report;
        };
        if conversion.started < previous.finished || conversion.finished < conversion.started {
            // A repeated or disordered one adds no time.
            return self.report;
        }
        self.integrate(config, &previous, conversion, spoiled);
        let (a, b) = (previous.current, conversion.current);
        let (a, b) = (a.saturating_abs(), b.saturating_abs());
        let largest = if spoiled {
            a.saturating_add(b)
        } else {
            a.max(b)
        };
        let zero = config.zero_tolerance.get(conversion.range);
        let gain = config.gain_tolerance.get();
        let off = mul_div(i64::from(largest.get()), i64::from(gain), 1_000_000);
        let bound = largest
            .saturating_add(zero)
            .saturating_add(Microamps(clamp_i32(off)));
        self.follow(bound, conversion.finished);
        self.last = Some((*conversion, false));
        self.report
    }

    fn integrate(
        &mut self,
        config: &CompareConfig,
        previous: &Conversion,
        conversion: &Conversion,
        spoiled: bool,
    ) {
        let (from, to) = (previous.finished, conversion.started);
        let gap = Gap {
            mean: Microamps(midpoint(previous.current, conversion.current)),
            doubt: gap_doubt(config, previous, conversion, spoiled),
            covered: elapsed(from, to).as_millis() <= u64::from(config.short_gap_ms),
        };
        // A report that came later than the conversion after it: the next one will do.
        self.pending = self.pending.filter(|point| point.at >= from);
        let split = self.pending.filter(|point| point.at <= conversion.finished);
        let Some(point) = split else {
            self.span_gap(config, &gap, from, to, conversion.range);
            self.note_begin(conversion.started);
            self.span(config, conversion, conversion.started, conversion.finished);
            return;
        };
        let end = point.at;
        self.span_gap(config, &gap, from, end.min(to), conversion.range);
        if end >= to {
            self.note_begin(to);
        }
        self.span(config, conversion, to, end.max(to));
        // Inside one conversion only its mean is known.
        let step = i64::from(conversion.current.get()) - i64::from(previous.current.get());
        let length = elapsed(from, conversion.finished);
        let edge = charge_of(step.abs(), length) / 2;
        self.integral.doubt = self.integral.doubt.wrapping_add(edge);
        self.evaluate(config, point);
        self.integral.doubt = self.integral.doubt.wrapping_add(edge);
        self.span_gap(config, &gap, end.min(to), to, conversion.range);
        if end < to {
            self.note_begin(to);
        }
        self.span(config, conversion, end.max(to), conversion.finished);
        self.pending = None;
    }

    /// No more than `bound` has flowed up to `to`: what of it a meter that stands still has missed.
    #[inline(never)]
    fn follow(&mut self, bound: Microamps, to: Instant) {
        let (before, since) = self.flowed;
        let flowed = before.saturating_add(units::charge_of(bound, elapsed(since, to)));
        self.flowed = (flowed, to);
        if let Some(count) = self.moved.as_mut().filter(|_| self.report.frozen) {
            let missed = flowed.saturating_sub(core::mem::replace(&mut count.before, flowed));
            self.declare(missed);
        }
        if let Some((before, _)) = self.ended.filter(|(_, until)| to >= *until) {
            self.ended = None;
            self.declare(flowed.saturating_sub(before));
        }
    }

    const fn declare(&mut self, charge: Nanocoulombs) {
        self.report.miscounted = self.report.miscounted.saturating_add(charge);
    }

    /// Takes the meter's newest report.
    pub fn on_meter(&mut self, config: &CompareConfig, report: &MeterReport) -> CompareReport {
        self.report.meter_lost = report.lost;
        let Some(at) = report.at else {
            return self.report;
        };
        if report.lost || report.gaps != self.gaps {
            // What bridges a gap comes from the converter: nothing to compare.
            self.gaps = report.gaps;
            self.restart(report.lost);
        }
        if report.lost || at < self.not_before {
            return self.report;
        }
        let point = MeterPoint::new(at, report);
        match self.moved {
            Some(count) if energy_difference(report.energy, count.energy) == 0 => {
                self.check_frozen(config, at, report.charge_total);
            }
            before => {
                if let Some(count) = before.filter(|_| self.report.frozen) {
                    self.ended = Some((count.before, at));
                    // A window with a stand-still in it would count that once more.
                    self.restart_windows();
                }
                self.moved = Some(Count {
                    at,
                    energy: report.energy,
                    charge: report.charge_total,
                    before: self.reported.0,
                    converter: None,
                });
                self.report.frozen = false;
            }
        }
        if at != self.reported.1 {
            self.reported = (self.flowed.0, at);
        }
        let due = |window: &Option<Window>, length_ms: u32| {
            window.is_none_or(|window| elapsed(window.meter.at, at) >= milliseconds(length_ms))
        };
        match self.pending {
            None => {
                if due(&self.fast, config.fast_window_ms) || due(&self.slow, config.slow_window_ms)
                {
                    self.pending = Some(point);
                }
            }
            Some(pending) => {
                // No usable conversion for a whole window: there is nothing to wait for.
                if elapsed(pending.at, at) >= milliseconds(config.fast_window_ms) {
                    self.restart(true);
                }
            }
        }
        self.report
    }

    /// The factors are others, in the converter at once and in the meter by `at`: the comparison begins anew there.
    pub fn restart_at(&mut self, at: Instant) {
        self.not_before = at;
        self.restart(true);
    }

    /// The newest reading of the sensor's supply is off by `share` from what the channels take it for; 0 within its noise. The bound is
    /// wider by the largest of `SUPPLY_DOUBT_READINGS`; and by `at_zero`, that share of the sensor's output at 0 A, where a channel has
    /// that from the supply too.
    pub fn on_supply(&mut self, share: Ppm, at_zero: PerRange<Microamps>) {
        let doubt = &mut self.supply_doubt;
        if share >= doubt.share || doubt.readings == 0 {
            *doubt = SupplyDoubt {
                share,
                at_zero,
                readings: SUPPLY_DOUBT_READINGS,
            };
        } else {
            doubt.readings -= 1;
        }
    }

    /// Compares from here on. A meter that stands still goes on doing so until it has counted, or its gap is bridged.
    fn restart(&mut self, keep_frozen: bool) {
        self.restart_windows();
        self.last = None;
        self.report.frozen &= keep_frozen;
        if !self.report.frozen {
            self.moved = None;
        }
    }

    fn restart_windows(&mut self) {
        (self.fast, self.slow, self.pending) = (None, None, None);
        self.report.fast = Outcome::Undecided;
        self.report.slow = Outcome::Undecided;
    }

    #[inline(never)]
    fn span(&mut self, config: &CompareConfig, of: &Conversion, from: Instant, to: Instant) {
        self.add(config, of.current, of.range, elapsed(from, to), true);
    }

    #[inline(never)]
    fn span_gap(
        &mut self,
        config: &CompareConfig,
        gap: &Gap,
        from: Instant,
        to: Instant,
        range: Range,
    ) {
        let time = elapsed(from, to);
        self.add(config, gap.mean, range, time, gap.covered);
        let doubt = charge_of(gap.doubt, time);
        self.integral.doubt = self.integral.doubt.wrapping_add(doubt);
    }

    #[inline(never)]
    fn add(
        &mut self,
        config: &CompareConfig,
        current: Microamps,
        range: Range,
        time: Duration,
        covered: bool,
    ) {
        let charge = charge_of(i64::from(current.get()), time);
        let gain = mul_div(
            charge.saturating_abs(),
            i64::from(
                config
                    .gain_tolerance
                    .get()
                    .max(0)
                    .saturating_add(self.supply_doubt.share.get()),
            ),
            i64::from(Ppm::ONE.get()),
        );
        let at_zero = self.supply_doubt.at_zero.get(range).get();
        let zero = config.zero_tolerance.get(range).get().max(0);
        let doubt = gain.wrapping_add(charge_of(i64::from(zero.saturating_add(at_zero)), time));
        self.integral.charge = self.integral.charge.wrapping_add(charge);
        self.integral.doubt = self.integral.doubt.wrapping_add(doubt);
        if covered {
            self.integral.covered = self.integral.covered.saturating_add(time.as_ticks());
        }
    }

    fn evaluate(&mut self, config: &CompareConfig, point: MeterPoint) {
        let now = Window {
            meter: point,
            converter: self.integral,
        };
        if let Some(outcome) = close(&mut self.fast, &now, config.fast_window_ms, config) {
            self.report.fast = outcome;
            if matches!(outcome, Outcome::Disagree { .. }) {
                self.report.disagreements = self.report.disagreements.saturating_add(1);
            }
            self.declare_window(outcome);
        }
        if let Some(outcome) = close(&mut self.slow, &now, config.slow_window_ms, config) {
            self.report.slow = outcome;
            self.declare_window(outcome);
        }
    }

    /// What the meter may have miscounted, if it was the meter; twice where both windows say so. Of a stand-still its own bound
    /// is declared.
    #[inline(never)]
    fn declare_window(&mut self, outcome: Outcome) {
        if let Outcome::Disagree { difference, bound } = outcome
            && !self.report.frozen
        {
            self.declare(difference.saturating_abs().saturating_add(bound));
        }
    }

    /// A conversion begins: the first after the meter's last count is where the two can be compared from.
    fn note_begin(&mut self, at: Instant) {
        if let Some(count) = &mut self.moved
            && count.converter.is_none()
            && at >= count.at
        {
            count.converter = Some(self.integral);
        }
    }

    /// AENERGY stands still at `at` although the converter's charge since its last count, less what the meter books for its
    /// offsets alone, exceeds twice what the channels may differ by. Only conversions that have ended by then: the rest may be
    /// counted, and not be read yet.
    fn check_frozen(&mut self, config: &CompareConfig, at: Instant, booked: Nanocoulombs) {
        let (Some(count), Some((last, _)), Some(fast)) = (&self.moved, &self.last, &self.fast)
        else {
            return;
        };
        let Some(then) = count.converter.filter(|_| last.finished <= at) else {
            return;
        };
        let since = self.integral.since(&then);
        if !elapsed_at_least(since.covered, config.short_gap_ms) {
            return;
        }
        // Over the time that the conversions cover.
        let offsets = mul_div(
            booked.get().wrapping_sub(count.charge.get()),
            (since.covered / 1_000).cast_signed(),
            elapsed(count.at, at).as_millis().cast_signed().max(1),
        );
        let counts = mul_i64(fast.meter.resolution.get(), FROZEN_COUNTS);
        let once = Nanocoulombs(add_i64(since.doubt, counts));
        let bound = once.saturating_add(once);
        let charge = Nanocoulombs(since.charge.wrapping_sub(offsets)).saturating_abs();
        if charge > bound {
            self.report.frozen = true;
        }
    }
}

/// A gap between two usable conversions.
#[derive(Clone, Copy)]
struct Gap {
    mean: Microamps,
    /// µA by which the mean may be off.
    doubt: i64,
    covered: bool,
}

fn gap_doubt(
    config: &CompareConfig,
    before: &Conversion,
    after: &Conversion,
    spoiled: bool,
) -> i64 {
    let (a, b) = (
        i64::from(before.current.get()),
        i64::from(after.current.get()),
    );
    let length = elapsed(before.finished, after.started);
    if spoiled || length.as_millis() > u64::from(config.short_gap_ms) {
        a.abs() + b.abs()
    } else {
        (a - b).abs() / 2
    }
}

/// nC of a current in µA over a time.
fn charge_of(microamps: i64, time: Duration) -> i64 {
    // 2⁶³ µs are 292,000 years.
    mul_div(time.as_ticks().cast_signed(), microamps, 1_000)
}

fn midpoint(a: Microamps, b: Microamps) -> i32 {
    a.get().midpoint(b.get())
}

const fn elapsed_at_least(micros: u64, millis: u32) -> bool {
    micros >= milliseconds(millis).as_ticks()
}

/// Ends `window` at `now` if it is due and begins the next; `None` when it is not.
#[inline(never)]
fn close(
    window: &mut Option<Window>,
    now: &Window,
    length_ms: u32,
    config: &CompareConfig,
) -> Option<Outcome> {
    let Some(begun) = window else {
        *window = Some(*now);
        return None;
    };
    let length = elapsed(begun.meter.at, now.meter.at);
    if length < milliseconds(length_ms) {
        return None;
    }
    let measured = now.converter.since(&begun.converter);
    let needed = mul_div(
        length.as_ticks().cast_signed(),
        i64::from(config.covered_share.get()),
        i64::from(Ppm::ONE.get()),
    );
    let outcome = if measured.covered.cast_signed() < needed {
        Outcome::Undecided
    } else {
        let (from, to) = (&begun.meter, &now.meter);
        let meter = to.charge.saturating_sub(from.charge);
        let difference = meter.saturating_sub(Nanocoulombs(measured.charge));
        let uncertainty = to.uncertainty.saturating_sub(from.uncertainty);
        let bound = Nanocoulombs(measured.doubt)
            .saturating_add(uncertainty.saturating_abs())
            .saturating_add(from.resolution)
            .saturating_add(to.resolution);
        if difference.saturating_abs() > bound {
            Outcome::Disagree { difference, bound }
        } else {
            Outcome::Agree { difference, bound }
        }
    };
    *window = Some(*now);
    Some(outcome)
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::panic, clippy::cast_possible_truncation)]
mod tests;
