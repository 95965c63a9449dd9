//! Interrupt storms: a line that fires too often is masked for a while, and polling goes on without it.
//!
//! Used for the meter's interrupt line and for the range edge. Pure state: the caller masks and unmasks the line as it
//! is told. Cheap enough for the edge handler: no division.
//!
//! For the range edge: at [`StormAction::Mask`] call `EdgeRecorder::suspend` and ask for a charge snapshot, at
//! [`StormAction::Unmask`] call `EdgeRecorder::resume` and ask for another, so that the time without edges stands alone.

use serde::{Deserialize, Serialize};

use crate::units::{Duration, Instant, elapsed};

/// How many events in which time are a storm, and how long the line then stays masked.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct StormConfig {
    /// Events within the window that make a storm. 0 counts as 1.
    pub events: u16,
    /// Length of the window in µs.
    pub window_us: u32,
    /// How long the line stays masked, in µs.
    pub hold_off_us: u32,
}

impl StormConfig {
    /// For the range edge: 20 edges in 1 ms, that is 10 kHz, then 1 ms of rest, so that chatter of any frequency costs
    /// at most 21 edge interrupts in 2 ms (one may be pending when it is masked). The meter's charge is estimated meanwhile (`meter`).
    pub const RANGE_EDGE: Self = Self {
        events: 20,
        window_us: 1_000,
        hold_off_us: 1_000,
    };
    /// For the meter's interrupt: ten in 10 ms, where one in minutes is normal, then 100 ms of rest, five polls.
    pub const METER_LINE: Self = Self {
        events: 10,
        window_us: 10_000,
        hold_off_us: 100_000,
    };
}

impl StormConfig {
    /// Shortest window and shortest rest for each event: 20 in a millisecond. More of them would be served at the cost of
    /// all else that the processor has to do, the watchdog included.
    const MIN_US_PER_EVENT: u32 = 50;

    /// Whether no line can take more than its share of the time.
    #[must_use]
    pub fn is_valid(&self) -> bool {
        let shortest = u32::from(self.events).saturating_mul(Self::MIN_US_PER_EVENT);
        self.window_us.min(self.hold_off_us) >= shortest
    }
}

impl Default for StormConfig {
    fn default() -> Self {
        Self::METER_LINE
    }
}

/// What to do with the line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum StormAction {
    /// Leave it as it is.
    Pass,
    /// Mask it now.
    Mask,
    /// Unmask it now, and look at the line's level, since events went by unseen.
    Unmask,
}

/// Counts events in windows that begin with an event; the same number may straddle two windows, so the densest burst
/// that passes unmasked is twice the configured one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct StormGuard {
    window: Option<Instant>,
    in_window: u16,
    masked_since: Option<Instant>,
    storms: u32,
    events: u32,
}

impl StormGuard {
    /// No event yet, not masked.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            window: None,
            in_window: 0,
            masked_since: None,
            storms: 0,
            events: 0,
        }
    }

    /// An event at `now`: [`StormAction::Mask`] when it is the one too many.
    pub fn on_event(&mut self, config: &StormConfig, now: Instant) -> StormAction {
        self.events = self.events.wrapping_add(1);
        if self.masked_since.is_some() {
            // Was pending when the line was masked.
            return StormAction::Pass;
        }
        let length = Duration::from_ticks(u64::from(config.window_us));
        match self.window {
            Some(begin) if elapsed(begin, now) < length => {
                self.in_window = self.in_window.saturating_add(1);
            }
            _ => {
                self.window = Some(now);
                self.in_window = 1;
            }
        }
        if self.in_window < config.events.max(1) {
            return StormAction::Pass;
        }
        self.window = None;
        self.in_window = 0;
        self.masked_since = Some(now);
        self.storms = self.storms.saturating_add(1);
        StormAction::Mask
    }

    /// Called by the polling task: [`StormAction::Unmask`] once when the hold-off has passed.
    pub fn poll(&mut self, config: &StormConfig, now: Instant) -> StormAction {
        let hold_off = Duration::from_ticks(u64::from(config.hold_off_us));
        match self.masked_since {
            Some(since) if elapsed(since, now) >= hold_off => {
                self.masked_since = None;
                StormAction::Unmask
            }
            _ => StormAction::Pass,
        }
    }

    /// Whether the line is masked.
    #[must_use]
    pub const fn is_masked(&self) -> bool {
        self.masked_since.is_some()
    }

    /// How often the line was masked; stops at the type's end.
    #[must_use]
    pub const fn storms(&self) -> u32 {
        self.storms
    }

    /// Events so far; wraps at 2³².
    #[must_use]
    pub const fn events(&self) -> u32 {
        self.events
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const CONFIG: StormConfig = StormConfig {
        events: 3,
        window_us: 100,
        hold_off_us: 1_000,
    };

    fn at(us: u64) -> Instant {
        Instant::from_ticks(us)
    }

    #[test]
    fn the_event_too_many_masks_and_the_hold_off_unmasks_once() {
        let mut guard = StormGuard::new();
        assert_eq!(guard.on_event(&CONFIG, at(0)), StormAction::Pass);
        assert_eq!(guard.on_event(&CONFIG, at(50)), StormAction::Pass);
        assert!(!guard.is_masked());
        assert_eq!(guard.on_event(&CONFIG, at(99)), StormAction::Mask);
        assert!(guard.is_masked());
        assert_eq!(guard.storms(), 1);
        // One that was pending.
        assert_eq!(guard.on_event(&CONFIG, at(100)), StormAction::Pass);
        assert_eq!(guard.events(), 4);
        assert_eq!(guard.poll(&CONFIG, at(1_098)), StormAction::Pass);
        assert_eq!(guard.poll(&CONFIG, at(1_099)), StormAction::Unmask);
        assert!(!guard.is_masked());
        assert_eq!(guard.poll(&CONFIG, at(5_000)), StormAction::Pass);
        // Counting begins anew.
        assert_eq!(guard.on_event(&CONFIG, at(5_000)), StormAction::Pass);
        assert_eq!(guard.on_event(&CONFIG, at(5_001)), StormAction::Pass);
        assert_eq!(guard.on_event(&CONFIG, at(5_002)), StormAction::Mask);
        assert_eq!(guard.storms(), 2);
    }

    #[test]
    fn a_window_ends_after_its_length() {
        let mut guard = StormGuard::default();
        assert_eq!(guard.on_event(&CONFIG, at(0)), StormAction::Pass);
        assert_eq!(guard.on_event(&CONFIG, at(1)), StormAction::Pass);
        assert_eq!(guard.on_event(&CONFIG, at(100)), StormAction::Pass);
        assert_eq!(guard.on_event(&CONFIG, at(101)), StormAction::Pass);
        assert_eq!(guard.on_event(&CONFIG, at(102)), StormAction::Mask);
    }

    #[test]
    fn twenty_events_a_millisecond_are_the_most() {
        assert!(StormConfig::RANGE_EDGE.is_valid() && StormConfig::METER_LINE.is_valid());
        let config = |events, window_us| StormConfig {
            events,
            window_us,
            hold_off_us: 5_000,
        };
        assert!(config(100, 5_000).is_valid() && config(10, 500).is_valid());
        assert!(!config(100, 4_999).is_valid() && !config(11, 500).is_valid());
        assert!(!config(u16::MAX, 10).is_valid());
        let long_window = config(101, 1_000_000);
        assert!(!long_window.is_valid());
    }

    #[test]
    fn no_events_allowed_counts_as_one() {
        let config = StormConfig {
            events: 0,
            ..CONFIG
        };
        assert_eq!(
            StormGuard::new().on_event(&config, at(0)),
            StormAction::Mask
        );
        assert_eq!(StormConfig::default(), StormConfig::METER_LINE);
    }

    proptest! {
        /// However dense the events, the interrupts served stay below two windows' worth in each hold-off.
        #[test]
        fn load_is_bounded(gaps in prop::collection::vec(1_u64..50, 1..500)) {
            let mut guard = StormGuard::new();
            let (mut now, mut served) = (0, 0_u64);
            for gap in gaps {
                now += gap;
                if guard.is_masked() {
                    let _ = guard.poll(&CONFIG, at(now));
                } else {
                    served += 1;
                    let _ = guard.on_event(&CONFIG, at(now));
                }
            }
            let bound = (now / u64::from(CONFIG.hold_off_us) + 1) * 2 * u64::from(CONFIG.events);
            prop_assert!(served <= bound, "{served} in {now} µs");
        }

        /// Less than the threshold in any window never masks.
        #[test]
        fn a_calm_line_stays_unmasked(gaps in prop::collection::vec(51_u64..10_000, 1..100)) {
            let mut guard = StormGuard::new();
            let mut now = 0;
            for gap in gaps {
                now += gap;
                prop_assert_eq!(guard.on_event(&CONFIG, at(now)), StormAction::Pass);
            }
            prop_assert_eq!(guard.storms(), 0);
        }

        #[test]
        fn nothing_panics(
            events: u16, window_us: u32, hold_off_us: u32,
            times: [u64; 8],
        ) {
            let config = StormConfig { events, window_us, hold_off_us };
            let mut guard = StormGuard::new();
            for time in times {
                let _ = guard.on_event(&config, at(time));
                let _ = guard.poll(&config, at(time / 2));
            }
        }
    }
}
