//! What the board does when its CAN controller leaves the bus (F16 of the fault list), and the queue that never lets
//! old data wait before new.
//!
//! After a bus-off the first recovery is asked for within 100 ms; each further one waits twice as long, up to a second,
//! so that a node with a broken transceiver does not keep a bus busy that others need. The waits start from the
//! beginning after ten seconds on the bus without another bus-off. Recovery itself is the controller's business (128
//! times 11 recessive bits, ISO 11898-1): while a dominant short lasts, it never ends, and measuring goes on untouched.

use crate::can::Frame;
use crate::units::{Duration, Instant, elapsed};

/// Wait before the first recovery. With the step called every 10 ms it is asked for after 60 ms at the latest.
pub const FIRST_WAIT: Duration = Duration::from_ticks(50_000);
/// The longest wait between two recoveries.
pub const LONGEST_WAIT: Duration = Duration::from_ticks(1_000_000);
/// Time on the bus after which the next bus-off waits [`FIRST_WAIT`] again.
pub const ERROR_FREE_TIME: Duration = Duration::from_ticks(10_000_000);

/// Waits 50, 100, 200, 400, 800 ms, then 1 s for ever.
fn wait(attempts: u8) -> Duration {
    let ticks = FIRST_WAIT.as_ticks() << attempts.min(8);
    Duration::from_ticks(ticks.min(LONGEST_WAIT.as_ticks()))
}

/// What the firmware has to do now.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Action {
    /// Nothing.
    None,
    /// Ask the controller to return to the bus.
    Recover,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum State {
    #[default]
    Start,
    On {
        since: Instant,
    },
    Off {
        since: Instant,
    },
}

/// State of the policy, with its counters.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BusOff {
    state: State,
    attempts: u8,
    bus_offs: u16,
    recoveries: u16,
}

impl BusOff {
    /// To be called with the controller's bus-off flag at least every 10 ms and at once when the flag rises.
    pub fn step(&mut self, now: Instant, bus_off: bool) -> Action {
        // The error-free time counts to its very end.
        if let State::On { since } = self.state
            && elapsed(since, now) >= ERROR_FREE_TIME
        {
            self.attempts = 0;
        }
        match (self.state, bus_off) {
            (State::Start, false) => self.state = State::On { since: now },
            (State::On { .. }, false) => {}
            (State::Start | State::On { .. }, true) => {
                self.bus_offs = self.bus_offs.saturating_add(1);
                self.state = State::Off { since: now };
            }
            (State::Off { .. }, false) => {
                self.recoveries = self.recoveries.saturating_add(1);
                self.state = State::On { since: now };
            }
            (State::Off { since }, true) => {
                if elapsed(since, now) >= wait(self.attempts) {
                    self.attempts = self.attempts.saturating_add(1);
                    self.state = State::Off { since: now };
                    return Action::Recover;
                }
            }
        }
        Action::None
    }

    /// Whether the controller is off the bus.
    #[must_use]
    pub const fn is_off(&self) -> bool {
        matches!(self.state, State::Off { .. })
    }

    /// Times the controller went off the bus, saturating.
    #[must_use]
    pub const fn bus_offs(&self) -> u16 {
        self.bus_offs
    }

    /// Times it came back, saturating.
    #[must_use]
    pub const fn recoveries(&self) -> u16 {
        self.recoveries
    }
}

/// The frames that wait to be sent: at most one per identifier, the newest, and the lowest identifier first, as the
/// bus itself arbitrates. `N` is the number of identifiers sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LatestQueue<const N: usize> {
    slots: [Option<Frame>; N],
    replaced: u32,
    refused: u32,
}

impl<const N: usize> Default for LatestQueue<N> {
    fn default() -> Self {
        Self {
            slots: [None; N],
            replaced: 0,
            refused: 0,
        }
    }
}

impl<const N: usize> LatestQueue<N> {
    fn slot_of(&mut self, id: u16) -> Option<&mut Option<Frame>> {
        self.slots
            .iter_mut()
            .find(|slot| slot.is_some_and(|frame| frame.id == id))
    }

    fn free(&mut self) -> Option<&mut Option<Frame>> {
        self.slots.iter_mut().find(|slot| slot.is_none())
    }

    /// Queues `frame` in place of an older one with its identifier. With all slots taken by other identifiers it is
    /// refused and counted.
    pub fn push(&mut self, frame: Frame) {
        if let Some(slot) = self.slot_of(frame.id) {
            *slot = Some(frame);
            self.replaced = self.replaced.saturating_add(1);
        } else if let Some(slot) = self.free() {
            *slot = Some(frame);
        } else {
            self.refused = self.refused.saturating_add(1);
        }
    }

    /// Gives back a frame that the controller had taken and did not send (displaced from its mailbox, or aborted):
    /// it waits again unless a newer one has come meanwhile.
    pub fn give_back(&mut self, frame: Frame) {
        if self.slot_of(frame.id).is_some() {
            self.replaced = self.replaced.saturating_add(1);
        } else {
            self.push(frame);
        }
    }

    /// Takes the most urgent frame.
    pub fn pop(&mut self) -> Option<Frame> {
        let urgent = self.slots.iter().flatten().map(|frame| frame.id).min()?;
        self.slot_of(urgent)?.take()
    }

    /// The identifier that [`LatestQueue::pop`] would take.
    #[must_use]
    pub fn most_urgent(&self) -> Option<u16> {
        self.slots.iter().flatten().map(|frame| frame.id).min()
    }

    /// Frames waiting.
    #[must_use]
    pub fn len(&self) -> usize {
        self.slots.iter().flatten().count()
    }

    /// Whether none waits.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Frames never sent because a newer one took their place, saturating.
    #[must_use]
    pub const fn replaced(&self) -> u32 {
        self.replaced
    }

    /// Frames refused for want of a slot, saturating; not zero means that `N` is too small.
    #[must_use]
    pub const fn refused(&self) -> u32 {
        self.refused
    }
}

#[cfg(test)]
#[allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss
)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeMap;
    use std::vec::Vec;

    fn at(milliseconds: u64) -> Instant {
        Instant::from_ticks(milliseconds * 1_000)
    }

    fn frame(id: u16, content: u8) -> Frame {
        Frame {
            id,
            dlc: 8,
            data: [content; 8],
        }
    }

    /// Times at which a bus that is off from `from` on sees recoveries.
    fn attempts(policy: &mut BusOff, from: u64, to: u64) -> Vec<u64> {
        (from..to)
            .filter(|ms| policy.step(at(*ms), true) == Action::Recover)
            .collect()
    }

    #[test]
    fn waits_double_from_50_ms_to_a_second() {
        let mut policy = BusOff::default();
        assert_eq!(policy.step(at(0), false), Action::None);
        assert_eq!(
            attempts(&mut policy, 1_000, 6_000),
            [1_050, 1_150, 1_350, 1_750, 2_550, 3_550, 4_550, 5_550]
        );
        assert!(policy.is_off());
        assert_eq!((policy.bus_offs(), policy.recoveries()), (1, 0));
        assert_eq!(policy.step(at(6_000), false), Action::None);
        assert!(!policy.is_off());
        assert_eq!((policy.bus_offs(), policy.recoveries()), (1, 1));
        assert!(
            FIRST_WAIT.as_millis() + 10 <= 100,
            "F16: the first try within 100 ms"
        );
    }

    #[test]
    fn waits_stay_long_until_ten_seconds_without_error() {
        let mut policy = BusOff::default();
        // Off at the very first look is a bus-off too.
        assert_eq!(attempts(&mut policy, 0, 200), [50, 150]);
        policy.step(at(200), false);
        policy.step(at(10_199), false);
        assert_eq!(attempts(&mut policy, 10_199, 10_400), [10_399]);
        policy.step(at(10_400), false);
        // Nobody looked between: the time is what counts.
        assert_eq!(attempts(&mut policy, 20_400, 20_460), [20_450]);
        assert_eq!((policy.bus_offs(), policy.recoveries()), (3, 2));
    }

    #[test]
    fn a_short_of_2_5_ms_costs_one_wait() {
        let mut policy = BusOff::default();
        policy.step(at(0), false);
        let mut tried = 0;
        for ms in 1..=60 {
            if policy.step(at(ms), true) == Action::Recover {
                tried = ms;
                break;
            }
        }
        assert_eq!(tried, 51);
        assert_eq!(policy.step(at(54), false), Action::None);
        assert!(!policy.is_off());
    }

    #[test]
    fn counters_stop_at_their_ends() {
        let mut policy = BusOff {
            bus_offs: u16::MAX,
            recoveries: u16::MAX,
            ..BusOff::default()
        };
        policy.step(at(0), true);
        policy.step(at(1), false);
        assert_eq!(
            (policy.bus_offs(), policy.recoveries()),
            (u16::MAX, u16::MAX)
        );
        // 300 attempts: more than the counter of waits holds.
        assert_eq!(attempts(&mut policy, 2, 300_000).len(), 4 + 299);
    }

    #[test]
    fn a_newer_frame_replaces_the_older_one() {
        let mut queue = LatestQueue::<2>::default();
        assert!(queue.is_empty());
        queue.push(frame(0x110, 1));
        queue.push(frame(0x101, 2));
        queue.push(frame(0x110, 3));
        queue.push(frame(0x102, 4));
        assert_eq!((queue.len(), queue.replaced(), queue.refused()), (2, 1, 1));
        assert!(!queue.is_empty());
        assert_eq!(queue.most_urgent(), Some(0x101));
        assert_eq!(queue.pop(), Some(frame(0x101, 2)));
        // Given back with nothing newer: it waits again; with something newer: it is gone.
        queue.give_back(frame(0x101, 2));
        assert_eq!(queue.pop(), Some(frame(0x101, 2)));
        queue.give_back(frame(0x110, 1));
        assert_eq!(queue.replaced(), 2);
        assert_eq!(queue.pop(), Some(frame(0x110, 3)));
        assert_eq!((queue.pop(), queue.most_urgent()), (None, None));
    }

    proptest! {
        /// While off, recoveries are never closer than the first wait nor further apart than the longest plus one step.
        #[test]
        fn attempts_keep_their_distance(steps in prop::collection::vec(1u64..=10, 100..1_500)) {
            let mut policy = BusOff::default();
            let mut now = 5;
            policy.step(at(now), true);
            let mut last = now;
            for step in steps {
                now += step;
                let recover = policy.step(at(now), true) == Action::Recover;
                prop_assert!(now - last <= LONGEST_WAIT.as_millis() + 10);
                if recover {
                    prop_assert!(now - last >= FIRST_WAIT.as_millis());
                    last = now;
                }
            }
        }

        #[test]
        fn no_input_panics(inputs in prop::collection::vec((any::<u64>(), any::<bool>()), 0..50)) {
            let mut policy = BusOff::default();
            for (ticks, off) in inputs {
                let _ = policy.step(Instant::from_ticks(ticks), off);
                prop_assert_eq!(policy.is_off(), off);
            }
        }

        /// Always the newest content of each identifier, always the lowest identifier first.
        #[test]
        fn holds_the_newest_of_each(actions in prop::collection::vec((0u16..6, any::<u8>(), 0u8..3), 0..100)) {
            let mut queue = LatestQueue::<6>::default();
            let mut model = BTreeMap::new();
            for (id, content, action) in actions {
                match action {
                    0 => { queue.push(frame(id, content)); model.insert(id, content); }
                    1 => { queue.give_back(frame(id, content)); model.entry(id).or_insert(content); }
                    _ => {
                        let expected = model.pop_first().map(|(id, content)| frame(id, content));
                        prop_assert_eq!(queue.pop(), expected);
                    }
                }
                prop_assert_eq!(queue.len(), model.len());
            }
            prop_assert_eq!(queue.refused(), 0);
        }
    }
}
