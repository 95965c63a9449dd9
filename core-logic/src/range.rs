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
mod tests;
