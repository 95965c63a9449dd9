//! D0: which of the two sensors the analog switch passes, since when, and what follows from a change.
//!
//! The edge handler owns an [`EdgeRecorder`]; everybody else takes copies of its [`RangeHistory`]. The history is
//! cumulative, so an edge can be seen late but not lost: two histories tell how many edges lay between them and how
//! long each sensor was selected ([`RangeHistory::since`]).

use serde::{Deserialize, Serialize};

use crate::design_parameters as design;
use crate::units::{Duration, Instant, Microamps, Nanocoulombs, charge_of, elapsed};

/// The sensor that the analog switch passes, as the range flag says.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Range {
    /// Flag low: the ±60 A sensor.
    #[default]
    Small,
    /// Flag high: the ±600 A sensor.
    Large,
}

impl Range {
    /// The range that the flag's level names (D0: high is the large sensor).
    #[must_use]
    pub const fn from_flag(flag_high: bool) -> Self {
        if flag_high { Self::Large } else { Self::Small }
    }

    /// The other range.
    #[must_use]
    pub const fn other(self) -> Self {
        match self {
            Self::Small => Self::Large,
            Self::Large => Self::Small,
        }
    }
}

/// Records every edge of the range flag. Owned by the edge handler, the highest priority of the board.
///
/// A call costs additions and comparisons only, no division.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct EdgeRecorder {
    range: Range,
    /// Up to here the time is accounted for.
    accounted: Instant,
    large: Duration,
    edges: u32,
    coalesced: u16,
    last_edge: Option<Instant>,
    suspended: bool,
}

impl EdgeRecorder {
    /// Starts at `now` with the flag's present level and no edge.
    #[must_use]
    pub const fn new(now: Instant, flag_high: bool) -> Self {
        Self {
            range: Range::from_flag(flag_high),
            accounted: now,
            large: Duration::from_ticks(0),
            edges: 0,
            coalesced: 0,
            last_edge: None,
            suspended: false,
        }
    }

    /// An edge interrupt at `now`; `flag_high` is the flag's level read inside the handler.
    ///
    /// When the level is the one already known, the flag has gone and come back before the handler could read it: two
    /// edges in one interrupt. They count as two, and the saturating counter of coalesced pairs tells that there may
    /// have been more and that the time between them is not known.
    pub fn on_edge(&mut self, now: Instant, flag_high: bool) {
        let range = Range::from_flag(flag_high);
        self.account(now);
        self.last_edge = Some(self.accounted);
        if range == self.range {
            self.edges = self.edges.wrapping_add(2);
            self.coalesced = self.coalesced.saturating_add(1);
        } else {
            self.edges = self.edges.wrapping_add(1);
            self.range = range;
        }
    }

    /// Looks at the flag without an interrupt; `true` when an edge had been missed, which is then recorded at `now`.
    pub fn observe(&mut self, now: Instant, flag_high: bool) -> bool {
        let missed = Range::from_flag(flag_high) != self.range;
        if missed {
            self.on_edge(now, flag_high);
        }
        missed
    }

    /// A storm has masked the edge interrupt: from here on the flag is not watched.
    pub const fn suspend(&mut self) {
        self.suspended = true;
    }

    /// The edge interrupt is enabled again. What happened meanwhile is unknown, so a coalesced pair is recorded, and the
    /// edge as well when the level has changed.
    pub fn resume(&mut self, now: Instant, flag_high: bool) {
        self.suspended = false;
        let _changed = self.observe(now, flag_high);
        self.on_edge(now, flag_high);
    }

    /// Time of the newest edge, if there was any.
    #[must_use]
    pub const fn last_edge(&self) -> Option<Instant> {
        self.last_edge
    }

    /// Everything up to `now`, as a copy.
    ///
    /// For a meter reading, `now` is the instant at which the chip latches the register. When an edge falls between
    /// that and this call, two histories taken around the transfer differ in their edges: read again.
    #[must_use]
    pub fn history(&self, now: Instant) -> RangeHistory {
        let mut upto = *self;
        upto.account(now);
        RangeHistory {
            range: upto.range,
            at: upto.accounted,
            large: upto.large,
            edges: upto.edges,
            coalesced: upto.coalesced,
            last_edge: upto.last_edge,
            watched: !upto.suspended,
            high: upto.large,
        }
    }

    /// Books the time since the last call under the present range. A `now` from before that changes nothing.
    fn account(&mut self, now: Instant) {
        let Some(spent) = now.checked_duration_since(self.accounted) else {
            return;
        };
        if self.range == Range::Large {
            self.large = self.large.saturating_add(spent);
        }
        self.accounted = now;
    }
}

/// What the range flag has done from the start of the board up to [`RangeHistory::at`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct RangeHistory {
    /// The range at [`RangeHistory::at`].
    pub range: Range,
    /// The instant of this copy.
    pub at: Instant,
    /// Time in [`Range::Large`] so far; the rest was spent in [`Range::Small`].
    pub large: Duration,
    /// Edges so far; wraps at 2³².
    pub edges: u32,
    /// Interrupts in which the flag had already come back; stops at 65,535.
    pub coalesced: u16,
    /// Time of the newest edge, if there was any.
    pub last_edge: Option<Instant>,
    /// Whether the edge interrupt is enabled at [`RangeHistory::at`].
    pub watched: bool,
    /// How long the flag was high so far by a counter that its level gates, which misses no edge; the time in
    /// [`Range::Large`] where there is none.
    pub high: Duration,
}

impl RangeHistory {
    /// No edge since the start of the board, all of the time in `range`: what a board with a single sensor hands on.
    #[must_use]
    pub const fn steady(now: Instant, range: Range) -> Self {
        let large = Duration::from_ticks(match range {
            Range::Small => 0,
            Range::Large => now.as_ticks(),
        });
        Self {
            range,
            at: now,
            large,
            edges: 0,
            coalesced: 0,
            last_edge: None,
            watched: true,
            high: large,
        }
    }

    /// What happened after `earlier`. Exact across the wrap of the edge counter.
    #[must_use]
    pub fn since(&self, earlier: &Self) -> RangeInterval {
        let edges = self.edges.wrapping_sub(earlier.edges);
        let missed_edges = !self.watched
            || !earlier.watched
            || self.coalesced != earlier.coalesced
            || (edges != 0 && self.coalesced == u16::MAX);
        let (from, to) = if missed_edges {
            (earlier.high, self.high)
        } else {
            (earlier.large, self.large)
        };
        let length = elapsed(earlier.at, self.at);
        let large = to.saturating_sub(from).min(length);
        RangeInterval {
            first: earlier.range,
            last: self.range,
            edges,
            missed_edges,
            small: length.saturating_sub(large),
            large,
            since_last_edge: self.last_edge.map(|edge| elapsed(edge, self.at)),
        }
    }

    /// Whether the signal has settled: no edge within `settling` before `now`.
    #[must_use]
    pub fn settled(&self, now: Instant, settling: Duration) -> bool {
        self.last_edge
            .is_none_or(|edge| elapsed(edge, now) >= settling)
    }

    /// Whether a conversion that began at `started` must not be used, this history being taken when its result was
    /// read: an edge fell into it, or came less than `settling` before it, or came between its end and the reading, or
    /// edges are not listened to.
    ///
    /// The last is deliberate. Of several edges a history tells only the newest, so an edge after the conversion may
    /// hide one inside it; and this history's range would no longer be the one that was converted.
    #[must_use]
    pub fn conversion_spoiled(&self, started: Instant, settling: Duration) -> bool {
        let edge = |edge| edge >= started || elapsed(edge, started) < settling;
        !self.watched || self.last_edge.is_some_and(edge)
    }
}

/// What lies between two histories.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct RangeInterval {
    /// Range at its begin.
    pub first: Range,
    /// Range at its end.
    pub last: Range,
    /// Edges in it; exact below 2³².
    pub edges: u32,
    /// Whether there may have been more edges: some came as a coalesced pair, or the flag was not watched all the time.
    /// The times in the two ranges are then those of [`RangeHistory::high`].
    pub missed_edges: bool,
    /// Time in [`Range::Small`].
    pub small: Duration,
    /// Time in [`Range::Large`].
    pub large: Duration,
    /// From the newest edge to the interval's end; the edge may lie before the interval.
    pub since_last_edge: Option<Duration>,
}

impl RangeInterval {
    /// The interval's length.
    #[must_use]
    pub const fn length(&self) -> Duration {
        self.small.saturating_add(self.large)
    }

    /// The range with the lesser time in it; when they are alike, the last one.
    #[must_use]
    pub fn shorter(&self) -> Range {
        if self.time_in(self.last.other()) < self.time_in(self.last) {
            self.last.other()
        } else {
            self.last
        }
    }

    /// Time spent in `range`.
    #[must_use]
    pub const fn time_in(&self, range: Range) -> Duration {
        match range {
            Range::Small => self.small,
            Range::Large => self.large,
        }
    }
}

/// When the flag changes so often that it counts as chatter.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ChatterConfig {
    /// Window in which edges are counted, in ms.
    pub window_ms: u32,
    /// Edges within one window from which on it is chatter.
    pub edges: u32,
}

impl Default for ChatterConfig {
    /// Ten edges a second: a drive cycle crosses the threshold a few times a second at most.
    fn default() -> Self {
        Self {
            window_ms: 1_000,
            edges: 10,
        }
    }
}

/// What the chatter detector knows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ChatterReport {
    /// Whether the flag chatters now.
    pub active: bool,
    /// Edges in the present window so far.
    pub edges_in_window: u32,
    /// Edges in the last complete window.
    pub edges_in_last_window: u32,
    /// How often chatter has begun; stops at the type's end.
    pub episodes: u32,
}

/// Counts edges per window. Chatter is reported as soon as the window's count reaches the threshold and withdrawn
/// after the first whole window below it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ChatterDetector {
    window: Option<(Instant, u32)>,
    report: ChatterReport,
}

impl ChatterDetector {
    /// Before the first history.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            window: None,
            report: ChatterReport {
                active: false,
                edges_in_window: 0,
                edges_in_last_window: 0,
                episodes: 0,
            },
        }
    }

    /// Takes the newest history, at least once per window.
    pub fn step(&mut self, config: &ChatterConfig, history: &RangeHistory) -> ChatterReport {
        let (begin, edges_at_begin) = *self.window.get_or_insert((history.at, history.edges));
        let count = history.edges.wrapping_sub(edges_at_begin);
        let chatters = count >= config.edges.max(1);
        if chatters && !self.report.active {
            self.report.active = true;
            self.report.episodes = self.report.episodes.saturating_add(1);
        }
        self.report.edges_in_window = count;
        if elapsed(begin, history.at).as_millis() >= u64::from(config.window_ms) {
            self.report.active = chatters;
            self.report.edges_in_last_window = count;
            self.report.edges_in_window = 0;
            self.window = Some((history.at, history.edges));
        }
        self.report
    }
}

/// When the flag and the signal's level contradict each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct FlagPlausibilityConfig {
    /// Current at which the comparators switch.
    pub switching_current: Microamps,
    /// Current at which the small sensor's output ends.
    pub small_full_scale: Microamps,
    /// How far beyond the switching current the small sensor may read before the missing edge is a contradiction.
    pub margin_above: Microamps,
    /// How far below it the large sensor may read before the missing edge back is one: comparator hysteresis plus the
    /// large sensor's zero error.
    pub margin_below: Microamps,
    /// How far two readings of the same sensor may differ, and how far apart the two hypotheses must lie to decide
    /// which sensor is passed; in the small sensor's amperes.
    pub match_tolerance: Microamps,
    /// A contradiction that lasts this long is reported, an agreement that lasts this long withdraws it, in ms. With
    /// two conversions of 31 ms on top it must stay below 200 ms.
    pub debounce_ms: u32,
}

impl Default for FlagPlausibilityConfig {
    fn default() -> Self {
        Self {
            switching_current: design::SWITCHING_CURRENT,
            small_full_scale: design::SMALL_FULL_SCALE,
            margin_above: design::FLAG_MARGIN_ABOVE,
            margin_below: design::FLAG_MARGIN_BELOW,
            match_tolerance: design::FLAG_MATCH_TOLERANCE,
            debounce_ms: design::FLAG_DEBOUNCE_MS,
        }
    }
}

/// One look at flag and levels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct FlagObservation {
    /// When.
    pub at: Instant,
    /// What the flag says.
    pub flag: Range,
    /// The converted level as a current of the *small* sensor, whatever the flag says: (V − 2.5 V) · 60 / 2.25.
    pub passed_as_small: Microamps,
    /// The same level as a current of the *large* sensor: (V − 2.5 V) · 600 / 2.25.
    pub passed_as_large: Microamps,
    /// The small sensor's own reading through the open-sensor network, which does not pass the analog switch. `None`
    /// without that channel or while the sensor is reported open.
    pub small_sensor: Option<Microamps>,
    /// What may flow at most: the large sensor's full scale.
    pub full_scale: Microamps,
}

/// The verdict on flag against level.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct FlagReport {
    /// The flag has contradicted the level for the debounce time.
    pub implausible: bool,
    /// The range that the current calls for, by its magnitude, if the level shows it.
    pub expected: Option<Range>,
    /// The sensor whose level the switch passes, as measured. `None` where it cannot be decided; the flag is then all there
    /// is. The readings stay on the flag's scale, and doubted, even so: edges and times in the two ranges are the flag's.
    pub passed: Option<Range>,
    /// How often a contradiction was reported; stops at the type's end.
    pub episodes: u32,
    /// Bound of the charge that contradictions have miscounted since the start, from the last agreement before to the first
    /// one after, whether they were long enough to be reported or not.
    pub miscounted: Nanocoulombs,
}

/// Bound of a charge that is counted while the current is known to be off.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Miscounted {
    /// So far.
    pub charge: Nanocoulombs,
    /// The newest look: when, and by how much the current was off.
    last: Option<(Instant, Microamps)>,
}

impl Miscounted {
    /// Nothing, and no look yet.
    pub const NONE: Self = Self {
        charge: Nanocoulombs::ZERO,
        last: None,
    };

    /// The current is off by `off` at `at`; since the look before, by as much or by what it was then.
    #[inline(never)]
    pub fn note(&mut self, at: Instant, off: Microamps) {
        if let Some((since, before)) = self.last.replace((at, off)) {
            let charge = charge_of(off.max(before), elapsed(since, at));
            self.charge = self.charge.saturating_add(charge);
        }
    }
}

/// Flag against measured level.
///
/// What the level alone decides:
/// - Flag *small*, level beyond the comparator threshold: the flag should be high. Certain.
/// - Flag *large*, level of the large sensor below the switching current less hysteresis: the flag should be low.
///   Certain, but not which of the two is wrong: an OR gate stuck high (the large sensor is passed and reads true) and
///   a flag line stuck high (the small sensor is passed, the current is a tenth) give the same level.
/// - A flag line stuck low while the large sensor is passed reads 53 … 533 A as 5.3 … 53 A, a flag line stuck high
///   while the small one is passed reads 5.3 … 53 A as 53 … 533 A: every such level is one that the other state
///   produces as well. Not decidable from one level.
///
/// With the small sensor's own level beside it all of these are decided, except near 0 A, where small and large
/// hypothesis lie closer together than the margins, and where a wrong scale costs least: below 9 A.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct FlagPlausibility {
    /// Since when the raw finding differs from the reported one.
    differs_since: Option<Instant>,
    /// Miscounted on the flag's scale since the last agreement by a contradiction that is neither reported yet nor over.
    pending: Miscounted,
    report: FlagReport,
}

impl FlagPlausibility {
    /// Nothing seen yet, nothing held against the flag.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            differs_since: None,
            pending: Miscounted::NONE,
            report: FlagReport {
                implausible: false,
                expected: None,
                passed: None,
                episodes: 0,
                miscounted: Nanocoulombs::ZERO,
            },
        }
    }

    /// Judges one valid conversion. Conversions spoiled by an edge must not be handed in.
    pub fn step(
        &mut self,
        config: &FlagPlausibilityConfig,
        observation: &FlagObservation,
    ) -> FlagReport {
        let passed = passed_sensor(config, observation);
        let expected = expected_range(config, observation, passed);
        let contradiction = expected.is_some_and(|range| range != observation.flag)
            || passed.is_some_and(|range| range != observation.flag)
            || large_stays_behind(config, observation);
        self.report.expected = expected;
        self.report.passed = passed;
        let off = if contradiction {
            off_by(config, observation, passed)
        } else {
            Microamps::ZERO
        };
        self.pending.note(observation.at, off);
        let was_implausible = self.report.implausible;
        if contradiction == self.report.implausible {
            self.differs_since = None;
        } else {
            let since = *self.differs_since.get_or_insert(observation.at);
            if elapsed(since, observation.at).as_millis() >= u64::from(config.debounce_ms) {
                self.differs_since = None;
                self.report.implausible = contradiction;
                if contradiction {
                    self.report.episodes = self.report.episodes.saturating_add(1);
                }
            }
        }
        if was_implausible || self.report.implausible || !contradiction {
            let pending = core::mem::take(&mut self.pending.charge);
            self.report.miscounted = self.report.miscounted.saturating_add(pending);
        }
        self.report
    }

    /// Nothing can be judged: a contradiction found before is withdrawn.
    pub const fn rest(&mut self) -> FlagReport {
        *self = Self {
            differs_since: None,
            report: FlagReport {
                episodes: self.report.episodes,
                miscounted: self.report.miscounted,
                ..Self::new().report
            },
            ..Self::new()
        };
        self.report
    }

    /// The newest verdict.
    #[must_use]
    pub const fn report(&self) -> FlagReport {
        self.report
    }
}

/// Which sensor the switch passes: the one hypothesis that the small sensor's own level confirms.
fn passed_sensor(config: &FlagPlausibilityConfig, seen: &FlagObservation) -> Option<Range> {
    let own = seen.small_sensor?;
    let tolerance = config.match_tolerance.saturating_abs();
    // Once the small sensor saturates, every level of the large one beyond that fits.
    let saturated = config.small_full_scale.saturating_sub(tolerance);
    let beyond = |reading: Microamps| reading.saturating_abs() >= saturated;
    let below = config.margin_below.saturating_abs();
    let off = |reading: Microamps| own.saturating_sub(reading).saturating_abs();
    let as_small = off(seen.passed_as_small) <= tolerance;
    // The own level, through the network, may be off by more than the tolerance: at rest it then misses both by the
    // same, which only the wider margin of the large one lets pass. That proves nothing against the small one.
    let not_small = off(seen.passed_as_small) > tolerance.max(below);
    let as_large = off(seen.passed_as_large) <= below
        || (beyond(own)
            && beyond(seen.passed_as_large)
            && (own.get() < 0) == (seen.passed_as_large.get() < 0));
    match (as_small, as_large) {
        (true, false) => Some(Range::Small),
        (false, true) if not_small => Some(Range::Large),
        _ => None,
    }
}

/// By how much the current may be off on the flag's scale, where flag and level contradict each other.
fn off_by(
    config: &FlagPlausibilityConfig,
    seen: &FlagObservation,
    passed: Option<Range>,
) -> Microamps {
    let (small, large) = (seen.passed_as_small, seen.passed_as_large);
    let by_flag = match seen.flag {
        Range::Small => small,
        Range::Large => large,
    };
    match (passed, seen.small_sensor) {
        (Some(passed), _) if passed == seen.flag => Microamps::ZERO,
        (Some(_), _) | (None, None) => large.saturating_sub(small).saturating_abs(),
        (None, Some(own)) if own.saturating_abs() < config.small_full_scale => own
            .saturating_sub(by_flag)
            .saturating_abs()
            .saturating_add(config.margin_below.saturating_abs()),
        // The small sensor is at its end, and what is passed is no sensor's level: anything may flow.
        (None, Some(_)) => seen.full_scale.saturating_add(by_flag.saturating_abs()),
    }
}

/// The small sensor is beyond the switching current, and the large one, which is passed, reads less: an output that stands
/// still near half its supply, or a way to the converter that does.
fn large_stays_behind(config: &FlagPlausibilityConfig, seen: &FlagObservation) -> bool {
    let above = config.switching_current.saturating_add(config.margin_above);
    let below = config.switching_current.saturating_sub(config.margin_below);
    seen.flag == Range::Large
        && seen.passed_as_large.saturating_abs() < below
        && seen
            .small_sensor
            .is_some_and(|own| own.saturating_abs() > above)
}

/// Which range the magnitude of the current calls for; `None` inside the comparators' hysteresis.
fn expected_range(
    config: &FlagPlausibilityConfig,
    seen: &FlagObservation,
    passed: Option<Range>,
) -> Option<Range> {
    let by_small = |reading: Microamps| {
        let magnitude = reading.saturating_abs();
        if magnitude > config.switching_current.saturating_add(config.margin_above) {
            Some(Range::Large)
        } else if magnitude < config.switching_current.saturating_sub(config.margin_below) {
            Some(Range::Small)
        } else {
            None
        }
    };
    let by_large = |reading: Microamps| {
        let below = config.switching_current.saturating_sub(config.margin_below);
        if reading.saturating_abs() < below {
            Some(Range::Small)
        } else {
            Some(Range::Large)
        }
    };
    match (seen.small_sensor, passed.unwrap_or(seen.flag)) {
        (Some(own), _) => by_small(own),
        (None, Range::Small) => by_small(seen.passed_as_small),
        (None, Range::Large) => by_large(seen.passed_as_large),
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::cast_possible_truncation)]
mod tests {
    use super::*;
    use crate::units::Microvolts;
    use proptest::prelude::*;
    use std::vec::Vec;

    fn at(us: u64) -> Instant {
        Instant::from_ticks(us)
    }

    fn us(ticks: u64) -> Duration {
        Duration::from_ticks(ticks)
    }

    #[test]
    fn times_and_edges_add_up() {
        let mut recorder = EdgeRecorder::new(at(100), false);
        let start = recorder.history(at(100));
        assert_eq!(start, RangeHistory::steady(at(100), Range::Small));
        recorder.on_edge(at(150), true);
        recorder.on_edge(at(170), false);
        let history = recorder.history(at(200));
        assert_eq!(
            history,
            RangeHistory {
                range: Range::Small,
                at: at(200),
                large: us(20),
                edges: 2,
                coalesced: 0,
                last_edge: Some(at(170)),
                watched: true,
                high: us(20),
            }
        );
        let interval = history.since(&start);
        assert_eq!(
            interval,
            RangeInterval {
                first: Range::Small,
                last: Range::Small,
                edges: 2,
                missed_edges: false,
                small: us(80),
                large: us(20),
                since_last_edge: Some(us(30)),
            }
        );
        assert_eq!(interval.length(), us(100));
        assert_eq!(interval.time_in(Range::Small), us(80));
        assert_eq!(interval.time_in(Range::Large), us(20));
        assert_eq!(interval.shorter(), Range::Large);
        // The copy did not move the recorder.
        assert_eq!(recorder.history(at(200)), history);
    }

    #[test]
    fn the_shorter_range() {
        let mut interval = RangeHistory::steady(at(0), Range::Small)
            .since(&RangeHistory::steady(at(0), Range::Large));
        assert_eq!(
            (interval.first, interval.last),
            (Range::Large, Range::Small)
        );
        // Alike: the last.
        assert_eq!(interval.shorter(), Range::Small);
        interval.small = us(1);
        assert_eq!(interval.shorter(), Range::Large);
        interval.large = us(2);
        assert_eq!(interval.shorter(), Range::Small);
    }

    #[test]
    fn an_edge_without_a_change_is_two() {
        let mut recorder = EdgeRecorder::new(at(0), false);
        let before = recorder.history(at(0));
        recorder.on_edge(at(10), false);
        let history = recorder.history(at(20));
        assert_eq!((history.edges, history.coalesced), (2, 1));
        assert_eq!(history.range, Range::Small);
        assert_eq!(history.last_edge, Some(at(10)));
        assert!(history.since(&before).missed_edges);
        assert!(!history.since(&history).missed_edges);
    }

    #[test]
    fn the_coalesced_counter_stops_and_then_marks_every_interval_with_edges() {
        let mut recorder = EdgeRecorder::new(at(0), true);
        for _ in 0..70_000 {
            recorder.on_edge(at(1), true);
        }
        let before = recorder.history(at(1));
        assert_eq!(before.coalesced, u16::MAX);
        assert_eq!(before.edges, 140_000);
        assert!(!recorder.history(at(2)).since(&before).missed_edges);
        recorder.on_edge(at(3), false);
        assert!(recorder.history(at(4)).since(&before).missed_edges);
    }

    #[test]
    fn a_missed_edge_is_found_by_looking() {
        let mut recorder = EdgeRecorder::new(at(0), false);
        assert!(!recorder.observe(at(5), false));
        assert_eq!(recorder.history(at(5)).edges, 0);
        assert!(recorder.observe(at(7), true));
        let history = recorder.history(at(9));
        assert_eq!((history.edges, history.range), (1, Range::Large));
        assert_eq!(history.large, us(2));
    }

    #[test]
    fn unwatched_time_is_divided_by_the_gated_counter() {
        let mut recorder = EdgeRecorder::new(at(0), false);
        let gated = |recorder: &EdgeRecorder, now, high| RangeHistory {
            high: us(high),
            ..recorder.history(at(now))
        };
        let start = gated(&recorder, 10, 0);
        recorder.suspend();
        let masked = gated(&recorder, 20, 7);
        let resting = gated(&recorder, 25, 11);
        recorder.resume(at(30), false);
        let resumed = gated(&recorder, 40, 12);
        let later = gated(&recorder, 90, 99);
        for (earlier, later, missed_edges, small, large) in [
            (start, masked, true, 3, 7),
            // Neither end is watched.
            (masked, resting, true, 1, 4),
            (resting, resumed, true, 14, 1),
            (start, resumed, true, 18, 12),
            // Where no edge is missed the time stamps are the exact ones.
            (resumed, later, false, 50, 0),
            // The counter is read a little later than the time.
            (masked, later, true, 0, 70),
        ] {
            let interval = later.since(&earlier);
            assert_eq!(interval.missed_edges, missed_edges);
            assert_eq!((interval.small, interval.large), (us(small), us(large)));
        }
        assert_eq!((resumed.edges, resumed.coalesced), (2, 1));
        // With the level changed there is an edge more.
        recorder.suspend();
        recorder.resume(at(95), true);
        let history = recorder.history(at(97));
        assert_eq!((history.edges, history.coalesced), (5, 2));
        assert_eq!(history.range, Range::Large);
        assert_eq!(history.last_edge, Some(at(95)));
    }

    #[test]
    fn time_never_runs_backwards() {
        let mut recorder = EdgeRecorder::new(at(100), false);
        recorder.on_edge(at(50), true);
        let history = recorder.history(at(20));
        assert_eq!(history.at, at(100));
        assert_eq!(history.last_edge, Some(at(100)));
        assert_eq!(history.large, us(0));
        assert_eq!(recorder.history(at(110)).large, us(10));
    }

    #[test]
    fn intervals_are_exact_across_the_wrap_of_the_counter() {
        let mut early = RangeHistory::steady(at(0), Range::Small);
        early.edges = u32::MAX - 1;
        let mut late = early;
        late.edges = 3;
        assert_eq!(late.since(&early).edges, 5);
    }

    #[test]
    fn flag_levels_name_the_ranges() {
        assert_eq!(Range::from_flag(false), Range::Small);
        assert_eq!(Range::from_flag(true), Range::Large);
        assert_eq!(Range::Small.other(), Range::Large);
        assert_eq!(Range::Large.other(), Range::Small);
        assert_eq!(Range::default(), Range::Small);
    }

    #[test]
    fn settling_and_conversions_at_an_edge() {
        let settling = us(50);
        let mut recorder = EdgeRecorder::new(at(0), false);
        let none = recorder.history(at(0));
        assert!(none.settled(at(0), settling));
        assert!(!none.conversion_spoiled(at(0), settling));
        recorder.on_edge(at(100), true);
        let history = recorder.history(at(1_000));
        assert!(!history.settled(at(149), settling));
        assert!(history.settled(at(150), settling));
        // Began after the settling time, within it, at the edge, before the edge.
        assert!(!history.conversion_spoiled(at(150), settling));
        assert!(history.conversion_spoiled(at(149), settling));
        assert!(history.conversion_spoiled(at(100), settling));
        assert!(history.conversion_spoiled(at(99), settling));
        assert!(history.conversion_spoiled(at(100), us(0)));
        assert!(!history.conversion_spoiled(at(101), us(0)));
    }

    #[test]
    fn chatter_is_reported_at_the_threshold_and_withdrawn_after_a_calm_window() {
        let config = ChatterConfig {
            window_ms: 100,
            edges: 4,
        };
        let mut detector = ChatterDetector::new();
        let mut recorder = EdgeRecorder::new(at(0), false);
        let _ = detector.step(&config, &recorder.history(at(0)));
        let mut flag = false;
        for time in [1_000, 2_000, 3_000] {
            flag = !flag;
            recorder.on_edge(at(time), flag);
            assert!(!detector.step(&config, &recorder.history(at(time))).active);
        }
        recorder.on_edge(at(4_000), !flag);
        let report = detector.step(&config, &recorder.history(at(4_000)));
        assert!(report.active);
        assert_eq!((report.edges_in_window, report.episodes), (4, 1));
        // Still in the window, it stays; so it does at the window's end.
        assert!(detector.step(&config, &recorder.history(at(99_999))).active);
        let report = detector.step(&config, &recorder.history(at(100_000)));
        assert!(report.active);
        assert_eq!(report.edges_in_last_window, 4);
        assert_eq!(report.edges_in_window, 0);
        // A calm window.
        assert!(
            detector
                .step(&config, &recorder.history(at(150_000)))
                .active
        );
        let report = detector.step(&config, &recorder.history(at(200_000)));
        assert!(!report.active);
        assert_eq!((report.edges_in_last_window, report.episodes), (0, 1));
        assert_eq!(ChatterDetector::default(), ChatterDetector::new());
    }

    #[test]
    fn a_threshold_of_no_edges_counts_as_one() {
        let config = ChatterConfig {
            window_ms: 1,
            edges: 0,
        };
        let mut detector = ChatterDetector::new();
        let history = RangeHistory::steady(at(0), Range::Small);
        assert!(!detector.step(&config, &history).active);
        assert_eq!(ChatterConfig::default().edges, 10);
    }

    /// Both readings of a level, from the level as the small sensor's current.
    fn observation(
        time_ms: u64,
        flag: Range,
        level_as_small: f64,
        small_sensor: Option<f64>,
    ) -> FlagObservation {
        let microamps = |amps: f64| Microamps((amps * 1e6) as i32);
        FlagObservation {
            at: at(time_ms * 1_000),
            flag,
            passed_as_small: microamps(level_as_small),
            passed_as_large: microamps(level_as_small * 10.0),
            small_sensor: small_sensor.map(microamps),
            full_scale: design::LARGE_FULL_SCALE,
        }
    }

    /// The verdict once the debounce time is over.
    fn verdict(flag: Range, level_as_small: f64, small_sensor: Option<f64>) -> FlagReport {
        let config = FlagPlausibilityConfig::default();
        let mut plausibility = FlagPlausibility::new();
        let mut report = plausibility.report();
        for step in 0..=8 {
            report = plausibility.step(
                &config,
                &observation(step * 25, flag, level_as_small, small_sensor),
            );
        }
        report
    }

    #[test]
    fn what_the_level_alone_decides() {
        for sign in [1.0, -1.0] {
            // Small sensor at its threshold and its margin: nothing wrong.
            assert!(!verdict(Range::Small, sign * 53.3, None).implausible);
            assert!(!verdict(Range::Small, sign * 56.3, None).implausible);
            let beyond = verdict(Range::Small, sign * 56.4, None);
            assert!(beyond.implausible);
            assert_eq!((beyond.expected, beyond.passed), (Some(Range::Large), None));
            assert_eq!(beyond.episodes, 1);
            // Large sensor: 46 A is within hysteresis and zero error, 45 A is not.
            assert!(!verdict(Range::Large, sign * 4.6, None).implausible);
            assert!(!verdict(Range::Large, sign * 40.0, None).implausible);
            let below = verdict(Range::Large, sign * 4.5, None);
            assert!(below.implausible);
            assert_eq!((below.expected, below.passed), (Some(Range::Small), None));
        }
        assert_eq!(verdict(Range::Small, 50.0, None).expected, None);
        assert_eq!(
            verdict(Range::Small, 40.0, None).expected,
            Some(Range::Small)
        );
    }

    #[test]
    fn the_small_sensors_own_level_decides_the_rest() {
        for sign in [1.0, -1.0] {
            // Flag line stuck high, switch at the small sensor: 30 A reads 300 A.
            let stuck_high = verdict(Range::Large, sign * 30.0, Some(sign * 30.0));
            assert!(stuck_high.implausible);
            assert_eq!(stuck_high.passed, Some(Range::Small));
            assert_eq!(stuck_high.expected, Some(Range::Small));
            // Flag line stuck low, switch at the large sensor: 300 A reads 30 A, the small sensor is saturated.
            let stuck_low = verdict(Range::Small, sign * 30.0, Some(sign * 60.0));
            assert!(stuck_low.implausible);
            assert_eq!(stuck_low.passed, Some(Range::Large));
            assert_eq!(stuck_low.expected, Some(Range::Large));
            // OR gate stuck high: the large sensor is passed and flagged, only the current is too low for it.
            let gate = verdict(Range::Large, sign * 3.0, Some(sign * 30.0));
            assert!(gate.implausible);
            assert_eq!(
                (gate.passed, gate.expected),
                (Some(Range::Large), Some(Range::Small))
            );
            // All in order.
            let small = verdict(Range::Small, sign * 30.0, Some(sign * 31.0));
            assert!(!small.implausible);
            assert_eq!(small.passed, Some(Range::Small));
            let large = verdict(Range::Large, sign * 20.0, Some(sign * 60.0));
            assert!(!large.implausible);
            assert_eq!(large.passed, Some(Range::Large));
            assert_eq!(large.expected, Some(Range::Large));
            // Both saturated: either is possible.
            assert_eq!(
                verdict(Range::Large, sign * 59.9, Some(sign * 60.0)).passed,
                None
            );
            // A level of the wrong sign fits neither.
            assert_eq!(
                verdict(Range::Large, sign * -20.0, Some(sign * 60.0)).passed,
                None
            );
        }
        // A large sensor that stands at half its supply: 0 A, and the small one at its end.
        assert!(verdict(Range::Large, 0.0, Some(60.0)).implausible);
        assert!(verdict(Range::Large, 0.0, Some(-60.0)).implausible);
        assert!(!verdict(Range::Large, 15.0, Some(60.0)).implausible);
        // Near 0 A the two lie within the tolerance.
        let zero = verdict(Range::Small, 0.5, Some(0.6));
        assert_eq!(zero.passed, None);
        assert!(!zero.implausible);
        // 9 A of the large sensor are told from 0.9 A of the small one.
        let large = verdict(Range::Small, 0.9, Some(9.0));
        assert_eq!(large.passed, Some(Range::Large));
        assert!(large.implausible);
        // Not saturated: the level of the large sensor is compared itself. 55 A and 580 A are not the same.
        assert_eq!(
            verdict(Range::Small, 55.0, Some(55.0)).passed,
            Some(Range::Small)
        );
        assert_eq!(
            verdict(Range::Large, 5.5, Some(55.0)).passed,
            Some(Range::Large)
        );
        assert_eq!(verdict(Range::Large, 4.6, Some(55.0)).passed, None);
    }

    /// 8 A are 67 mV at the pin: an offset of the network's channel, and no matter of the switch.
    #[test]
    fn an_own_level_that_is_off_does_not_contradict_a_small_current() {
        for sign in [1.0, -1.0] {
            for off in (-79..=79).map(|tenth| f64::from(tenth) * 0.1) {
                for current in (0..=200).map(|tenth| f64::from(tenth) * 0.1 * sign) {
                    let report = verdict(Range::Small, current, Some(current + off));
                    assert!(!report.implausible, "{current} A, off by {off} A");
                }
            }
        }
    }

    #[test]
    fn a_contradiction_is_debounced_both_ways_and_found_within_200_ms() {
        let config = FlagPlausibilityConfig::default();
        let mut plausibility = FlagPlausibility::new();
        let (mut found, mut cleared) = (None, None);
        // A conversion every 31 ms; the contradiction lasts from 0 to 620 ms.
        for step in 0..60_u64 {
            let time = step * 31;
            let level = if time < 620 { 58.0 } else { 20.0 };
            let report = plausibility.step(&config, &observation(time, Range::Small, level, None));
            if report.implausible {
                found.get_or_insert(time);
            } else if found.is_some() {
                cleared.get_or_insert(time);
            }
        }
        // Up to 31 ms pass before the first conversion that shows it.
        assert!(found.unwrap() + 31 <= 200, "{found:?}");
        assert_eq!(found, Some(93));
        assert_eq!(cleared, Some(620 + 93));
        assert_eq!(plausibility.report().episodes, 1);
        // A short one is not reported.
        let mut plausibility = FlagPlausibility::new();
        for (time, level) in [
            (0, 58.0),
            (60, 58.0),
            (89, 58.0),
            (90, 20.0),
            (100, 58.0),
            (189, 58.0),
        ] {
            assert!(
                !plausibility
                    .step(&config, &observation(time, Range::Small, level, None))
                    .implausible
            );
        }
        assert!(
            plausibility
                .step(&config, &observation(190, Range::Small, 58.0, None))
                .implausible
        );
    }

    /// Looks every 31 ms at a flag that is stuck from 0.5 to `end_ms`, the small sensor being passed or the large one.
    fn miscounted(flag: Range, passed: Range, amps: f64, end_ms: u64, network: bool) -> FlagReport {
        let config = FlagPlausibilityConfig::default();
        let mut plausibility = FlagPlausibility::new();
        let microamps = |amps: f64| Microamps((amps * 1e6) as i32);
        let level = match passed {
            Range::Small => amps.clamp(-66.0, 66.0),
            Range::Large => amps / 10.0,
        };
        for ms in (0..end_ms + 500).step_by(31) {
            let is_stuck = (500..end_ms).contains(&ms);
            plausibility.step(
                &config,
                &FlagObservation {
                    at: at(ms * 1_000),
                    flag: if is_stuck { flag } else { passed },
                    passed_as_small: microamps(level),
                    passed_as_large: microamps(10.0 * level),
                    small_sensor: network.then(|| microamps(amps.clamp(-66.0, 66.0))),
                    full_scale: design::LARGE_FULL_SCALE,
                },
            );
        }
        plausibility.report()
    }

    #[test]
    fn what_a_stuck_flag_has_miscounted_is_declared() {
        for (flag, passed, amps, network) in [
            (Range::Large, Range::Small, 30.0, true),
            (Range::Large, Range::Small, -30.0, true),
            (Range::Large, Range::Small, 4.0, true),
            (Range::Large, Range::Small, 4.0, false),
            (Range::Small, Range::Large, 100.0, true),
            (Range::Small, Range::Large, -250.0, true),
        ] {
            let report = miscounted(flag, passed, amps, 2_500, network);
            assert!(report.episodes == 1 && !report.implausible, "{report:?}");
            let counted = if flag == Range::Large {
                10.0 * amps
            } else {
                amps / 10.0
            };
            let off_c = (counted - amps).abs() * 2.0;
            let declared_c = report.miscounted.get() as f64 / 1e9;
            assert!(declared_c >= off_c, "{amps} A: {declared_c} of {off_c} C");
            // A look more at either end, and the margin of a sensor's own level.
            let margin_c = 2.2 * (f64::from(design::FLAG_MARGIN_BELOW.get()) / 1e6);
            assert!(
                declared_c <= 1.05 * off_c + margin_c,
                "{amps} A: {declared_c} of {off_c} C"
            );
        }
        // Not long enough to be reported: one look, from the one before it to the one after.
        let short = miscounted(Range::Large, Range::Small, 30.0, 550, true);
        assert_eq!(short.episodes, 0);
        assert_eq!(short.miscounted, Nanocoulombs(270 * 62_000_000));
        // An OR gate that is stuck: the flag says what is passed.
        let stuck_gate = miscounted(Range::Large, Range::Large, 30.0, 2_500, true);
        assert!(stuck_gate.implausible, "{stuck_gate:?}");
        assert_eq!(stuck_gate.miscounted, Nanocoulombs::ZERO);
    }

    #[test]
    fn unwatched_edges_spoil_a_conversion() {
        let mut recorder = EdgeRecorder::new(at(0), false);
        let spoiled = |recorder: &EdgeRecorder| {
            recorder
                .history(at(9_000))
                .conversion_spoiled(at(8_000), us(5_000))
        };
        assert!(!spoiled(&recorder));
        recorder.suspend();
        assert!(spoiled(&recorder));
    }

    #[test]
    fn the_flags_levels_are_those_of_the_document() {
        // 4.5 V and 0.5 V at ±53.33 A of the small sensor.
        assert_eq!(design::COMPARATOR_HIGH, Microvolts(4_500_000));
        // The conversion that the edge falls into, the first one after it, the debounce in whole conversions, a tick.
        const { assert!((2 + design::FLAG_DEBOUNCE_MS.div_ceil(32)) * 32 + 10 < 200) };
    }

    proptest! {
        /// Whatever the chain of edges and looks, times and edges between any two histories add up.
        #[test]
        fn histories_add_up(steps in prop::collection::vec((0_u64..1_000, any::<bool>(), any::<bool>()), 1..50)) {
            let mut recorder = EdgeRecorder::new(at(0), false);
            let mut histories: Vec<RangeHistory> = std::vec![recorder.history(at(0))];
            let (mut now, mut large) = (0, 0);
            let mut level = false;
            for (gap, flag, interrupt) in steps {
                now += gap;
                large += if level { gap } else { 0 };
                level = flag;
                if interrupt {
                    recorder.on_edge(at(now), flag);
                } else {
                    let _ = recorder.observe(at(now), flag);
                }
                histories.push(recorder.history(at(now)));
            }
            let last = histories.last().unwrap();
            prop_assert_eq!(last.large.as_ticks(), large);
            prop_assert_eq!(last.since(histories.first().unwrap()).small.as_ticks(), now - large);
            for earlier in &histories {
                let interval = last.since(earlier);
                prop_assert_eq!(interval.length().as_ticks(), now - earlier.at.as_ticks());
                // An odd number of edges changes the range, an even one does not.
                prop_assert_eq!(interval.edges % 2 == 1, interval.first != interval.last);
            }
        }

        #[test]
        fn nothing_panics(
            times: [u64; 6], flags: [bool; 6], window_ms: u32, edges: u32,
            currents: [i32; 8], debounce_ms: u32, settling: u64,
        ) {
            let mut recorder = EdgeRecorder::new(at(times[0]), flags[0]);
            let first = recorder.history(at(times[1]));
            let mut detector = ChatterDetector::new();
            let mut plausibility = FlagPlausibility::new();
            let config = FlagPlausibilityConfig {
                switching_current: Microamps(currents[0]),
                small_full_scale: Microamps(currents[1]),
                margin_above: Microamps(currents[2]),
                margin_below: Microamps(currents[3]),
                match_tolerance: Microamps(currents[4]),
                debounce_ms,
            };
            for (time, flag) in times.into_iter().zip(flags) {
                recorder.on_edge(at(time), flag);
                recorder.suspend();
                recorder.resume(at(time / 2), !flag);
                let history = recorder.history(at(time));
                let _ = (history.since(&first), first.since(&history), history.since(&first).shorter());
                let _ = history.since(&first).length();
                let _ = (history.settled(at(times[3]), us(settling)), history.conversion_spoiled(at(times[2]), us(settling)));
                let _ = detector.step(&ChatterConfig { window_ms, edges }, &history);
                let _ = plausibility.step(&config, &FlagObservation {
                    at: at(time),
                    flag: history.range,
                    passed_as_small: Microamps(currents[5]),
                    passed_as_large: Microamps(currents[6]),
                    small_sensor: flag.then_some(Microamps(currents[7])),
                    full_scale: Microamps(currents[1]),
                });
            }
        }
    }
}
