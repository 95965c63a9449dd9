//! What the converter has seen while the meter did not count.
//!
//! The mean of the last conversions says what flows at a gap's end, not what flowed in it: with 300 A for its first 3 s
//! and 5 A for the rest, a gap of 4 s would be 900 C short. So every conversion since the meter's newest reading is added
//! up, for the time that it covers, and the sum begins anew with each reading; in a gap it goes on.
//!
//! The doubt of a sum of conversions:
//! - where conversions cover the time, the converter's own error (`bridge_gain`, `bridge_offset`);
//! - at the gap's two ends a conversion lies across them, and how its charge divides is not known: at most the change from
//!   one conversion to the next, for one conversion. It is added for every change, for any of them may be at an end;
//! - where no valid conversion covers the time (an edge of the range flag fell into it, a refused step, no answer), the
//!   mean of its neighbours is taken, and anything within full scale doubted.

use crate::meter::MeterConfig;
use crate::range::Range;
use crate::units::{
    Duration, Instant, Microamps, Nanocoulombs, Ppm, charge_of, clamp_i32, elapsed, mul_div,
};

/// From one conversion's end to the next one's begin: a tick, with which ADC1 converts, and its jitter.
const PAUSE: Duration = Duration::from_ticks(12_000);

/// One conversion.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Conversion {
    /// When it began.
    pub started: Instant,
    /// When it was finished.
    pub finished: Instant,
    /// What it says.
    pub current: Microamps,
    /// The sensor that it was made with.
    pub range: Range,
    /// Edges of the range flag so far.
    pub edges: u32,
    /// Nothing speaks against it.
    pub is_valid: bool,
}

/// What is known about the current since the meter's newest reading.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct GapBridge {
    /// That reading's instant, or the board's start.
    pub since: Instant,
    /// The end of the newest valid conversion.
    pub until: Instant,
    /// Charge from `since` to `until`.
    pub charge: Nanocoulombs,
    /// Bound of its error.
    pub doubt: Nanocoulombs,
    /// The current at `until`; `None` while there was no valid conversion.
    pub current: Option<Microamps>,
    /// For how long after `until` a next conversion need not have come.
    pub holds: Duration,
}

impl GapBridge {
    /// Nothing is known: the gap's charge is missing, and full scale is doubted.
    pub const UNKNOWN: Self = Self {
        since: Instant::from_ticks(0),
        until: Instant::from_ticks(0),
        charge: Nanocoulombs::ZERO,
        doubt: Nanocoulombs::ZERO,
        current: None,
        holds: Duration::from_ticks(0),
    };
}

/// The newest valid conversion, as it was added.
#[derive(Clone, Copy, Debug)]
struct Newest {
    current: Microamps,
    until: Instant,
    length: Duration,
    /// Its share of the doubt in proportion to time …
    error: Microamps,
    /// … and the one of the change before it.
    change: Nanocoulombs,
    range: Range,
    edges: u32,
}

/// The sum of the conversions since the meter's newest reading.
#[derive(Clone, Copy, Debug)]
pub struct Gap {
    since: Instant,
    charge: Nanocoulombs,
    doubt: Nanocoulombs,
    newest: Option<Newest>,
    /// A conversion since the newest valid one was not valid.
    broken: bool,
}

/// How far a current may be off that the converter gives in the meter's stead.
pub fn converter_error(config: &MeterConfig, current: Microamps) -> Microamps {
    let gain = mul_div(
        i64::from(current.saturating_abs().get()),
        i64::from(config.bridge_gain.get()).abs(),
        i64::from(Ppm::ONE.get()),
    );
    config
        .bridge_offset
        .saturating_abs()
        .saturating_add(Microamps(clamp_i32(gain)))
}

impl Gap {
    /// From `since` on.
    #[must_use]
    pub const fn new(since: Instant) -> Self {
        Self {
            since,
            charge: Nanocoulombs::ZERO,
            doubt: Nanocoulombs::ZERO,
            newest: None,
            broken: false,
        }
    }

    /// The meter's newest reading is of `since`: what flowed before is counted.
    pub fn begin_at(&mut self, since: Instant) {
        if since == self.since {
            return;
        }
        self.since = since;
        (self.charge, self.doubt) = (Nanocoulombs::ZERO, Nanocoulombs::ZERO);
        // The reading is known a tick after it was made: a conversion may have ended in between.
        if let Some(newest) = self.newest
            && newest.until > since
        {
            self.add(&newest, elapsed(since, newest.until));
        }
    }

    fn add(&mut self, newest: &Newest, length: Duration) {
        self.charge = self
            .charge
            .saturating_add(charge_of(newest.current, length));
        self.doubt = self
            .doubt
            .saturating_add(charge_of(newest.error, length))
            .saturating_add(newest.change);
    }

    /// A finished conversion.
    pub fn on_conversion(&mut self, config: &MeterConfig, conversion: &Conversion) {
        if !conversion.is_valid {
            self.broken = true;
            return;
        }
        let &Conversion {
            started,
            finished,
            current,
            range,
            edges,
            ..
        } = conversion;
        let before = self.newest;
        let reached = before.map_or(self.since, |newest| newest.until);
        let follows = before.is_some()
            && !core::mem::take(&mut self.broken)
            && elapsed(reached, started) <= PAUSE;
        let previous = before.map_or(current, |newest| newest.current);
        if !follows {
            let full_scale = match before {
                Some(newest)
                    if newest.edges == edges
                        && (newest.range, range) == (Range::Small, Range::Small) =>
                {
                    config.full_scale.small
                }
                _ => config.full_scale.large,
            };
            let between = i64::from(previous.get()) + i64::from(current.get());
            let between = Microamps(clamp_i32(between / 2));
            let uncovered = Newest {
                current: between,
                until: started,
                length: Duration::from_ticks(0),
                error: full_scale
                    .saturating_abs()
                    .saturating_add(between.saturating_abs()),
                change: Nanocoulombs::ZERO,
                range,
                edges,
            };
            self.add(&uncovered, elapsed(reached.max(self.since), started));
        }
        let from = if follows { reached } else { started };
        let length = elapsed(from, finished);
        let change = previous.saturating_sub(current).saturating_abs();
        let newest = Newest {
            current,
            until: finished,
            length,
            error: converter_error(config, current),
            change: charge_of(change, length),
            range,
            edges,
        };
        self.add(&newest, elapsed(from.max(self.since), finished));
        self.newest = Some(newest);
    }

    /// As far as it is known.
    #[must_use]
    pub fn bridge(&self) -> GapBridge {
        let until = self.newest.map_or(self.since, |newest| newest.until);
        GapBridge {
            since: self.since,
            until,
            charge: self.charge,
            doubt: self.doubt,
            current: self.newest.map(|newest| newest.current),
            // Handed over with the tick, and used before the next one.
            holds: match self.newest {
                Some(newest) if !self.broken => {
                    newest.length.saturating_add(PAUSE).saturating_add(PAUSE)
                }
                _ => Duration::from_ticks(0),
            },
        }
    }
}
