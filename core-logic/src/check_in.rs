//! The watchdog is fed only when every task has checked in (F24 of the fault list): a task that hangs, starves or is
//! never started keeps the watchdog hungry, and the board resets.

use crate::units::{Duration, Instant, elapsed};

macro_rules! tasks {
    ($($(#[$doc:meta])* $name:ident = $period_ms:literal;)*) => {
        /// A task that has to check in.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        #[cfg_attr(feature = "defmt", derive(defmt::Format))]
        #[repr(u8)]
        pub enum Task {
            $($(#[$doc])* $name,)*
        }

        impl Task {
            /// All of them, in the order of their numbers.
            pub const ALL: [Self; Self::COUNT] = [$(Self::$name,)*];
            /// How many there are.
            pub const COUNT: usize = [$($period_ms,)*].len();

            /// The longest time between two check-ins.
            #[must_use]
            pub const fn period(self) -> Duration {
                match self {
                    $(Self::$name => Duration::from_ticks($period_ms * 1_000),)*
                }
            }
        }
    };
}

tasks! {
    /// Meter poll, every 20 ms: five periods.
    Meter = 100;
    /// Conversion poll; a conversion takes 8 … 125 ms (ADS1100, 128 … 8 SPS) and may be retried once after recovery.
    Conversion = 400;
    /// The 10 ms tick with the CAN frames.
    Tick = 100;
    /// RS485 server.
    Rs485 = 500;
    /// Configuration, state and log; it checks in while it waits for the flash, a sector's erase of up to 400 ms.
    Storage = 500;
    /// Analogue inputs, key state and its calibration.
    Environment = 500;
}

impl Task {
    const fn bit(self) -> u8 {
        1 << (self as u8)
    }
}

/// A set of tasks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct TaskSet(u8);

impl TaskSet {
    /// Whether `task` is in the set.
    #[must_use]
    pub const fn contains(self, task: Task) -> bool {
        self.0 & task.bit() != 0
    }

    /// Whether no task is in the set.
    #[must_use]
    pub const fn is_empty(self) -> bool {
        self.0 == 0
    }

    /// Bit n is the task with number n, as it is kept over a reset and reported.
    #[must_use]
    pub const fn bits(self) -> u8 {
        self.0
    }

    /// The tasks in the set.
    pub fn iter(self) -> impl Iterator<Item = Task> {
        Task::ALL
            .into_iter()
            .filter(move |task| self.contains(*task))
    }
}

/// Who has checked in, and when.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CheckIn {
    enabled: TaskSet,
    last: [Option<Instant>; Task::COUNT],
    ever_late: TaskSet,
}

impl CheckIn {
    /// From now on `task` has to check in; its first period starts `now`.
    pub fn enable(&mut self, task: Task, now: Instant) {
        self.enabled.0 |= task.bit();
        self.note(task, now);
    }

    /// `task` no longer has to check in (a task that the configuration switches off).
    pub const fn disable(&mut self, task: Task) {
        self.enabled.0 &= !task.bit();
    }

    /// `task` is alive. Before [`CheckIn::enable`] it has no effect.
    pub fn check_in(&mut self, task: Task, now: Instant) {
        if self.enabled.contains(task) {
            self.note(task, now);
        }
    }

    fn note(&mut self, task: Task, now: Instant) {
        if let Some(last) = self.last.get_mut(task as usize) {
            *last = Some(now);
        }
    }

    /// The enabled tasks whose period has passed.
    #[must_use]
    pub fn late(&self, now: Instant) -> TaskSet {
        let mut late = TaskSet::default();
        for (task, last) in Task::ALL.into_iter().zip(self.last) {
            let overdue = last.is_some_and(|last| elapsed(last, now) > task.period());
            if overdue && self.enabled.contains(task) {
                late.0 |= task.bit();
            }
        }
        late
    }

    /// Whether the watchdog may be fed.
    ///
    /// # Errors
    /// The late tasks; and all of them when none is enabled yet, for a board without tasks must not live.
    pub fn may_feed(&mut self, now: Instant) -> Result<(), TaskSet> {
        if self.enabled.is_empty() {
            return Err(Task::ALL
                .into_iter()
                .fold(TaskSet::default(), |set, task| TaskSet(set.0 | task.bit())));
        }
        let late = self.late(now);
        self.ever_late.0 |= late.0;
        if late.is_empty() { Ok(()) } else { Err(late) }
    }

    /// The tasks that were late at any [`CheckIn::may_feed`] since the start, recovered or not.
    #[must_use]
    pub const fn ever_late(&self) -> TaskSet {
        self.ever_late
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
    use std::vec::Vec;

    fn at(milliseconds: u64) -> Instant {
        Instant::from_ticks(milliseconds * 1_000)
    }

    #[test]
    fn nothing_enabled_is_no_life() {
        let mut all = CheckIn::default();
        let missing = all.may_feed(at(0)).unwrap_err();
        assert_eq!(missing.bits(), 0b11_1111);
        assert_eq!(missing.iter().count(), Task::COUNT);
        // Checking in does not enable.
        all.check_in(Task::Meter, at(0));
        assert!(all.may_feed(at(0)).is_err());
    }

    #[test]
    fn fed_to_the_end_of_the_period_and_not_beyond() {
        let mut check_in = CheckIn::default();
        check_in.enable(Task::Meter, at(1_000));
        assert_eq!(check_in.may_feed(at(1_100)), Ok(()));
        let late = check_in
            .may_feed(Instant::from_ticks(1_100_001))
            .unwrap_err();
        assert_eq!(late.iter().collect::<Vec<_>>(), [Task::Meter]);
        assert!(late.contains(Task::Meter) && !late.contains(Task::Tick) && !late.is_empty());
        check_in.check_in(Task::Meter, at(1_150));
        assert_eq!(check_in.may_feed(at(1_250)), Ok(()));
        assert_eq!(check_in.ever_late(), late);
    }

    #[test]
    fn a_disabled_task_is_not_waited_for() {
        let mut check_in = CheckIn::default();
        check_in.enable(Task::Tick, at(0));
        check_in.enable(Task::Rs485, at(0));
        check_in.check_in(Task::Tick, at(550));
        assert_eq!(
            check_in.may_feed(at(600)).unwrap_err().bits(),
            Task::Rs485.bit()
        );
        check_in.disable(Task::Rs485);
        assert_eq!(check_in.may_feed(at(600)), Ok(()));
        assert!(check_in.late(at(600)).is_empty());
        // Enabled again, it starts with a whole period.
        check_in.enable(Task::Rs485, at(600));
        assert_eq!(check_in.may_feed(at(650)), Ok(()));
    }

    #[test]
    fn periods_are_longer_than_what_they_watch() {
        assert_eq!(
            Task::ALL.map(|task| task.period().as_millis()),
            [100, 400, 100, 500, 500, 500]
        );
        let mut union = 0u8;
        for task in Task::ALL {
            assert_eq!(union & task.bit(), 0);
            union |= task.bit();
        }
    }

    proptest! {
        /// Fed exactly when the youngest check-in of every enabled task is no older than its period.
        #[test]
        fn agrees_with_the_rule(events in prop::collection::vec((0usize..6, 0u64..200, 0u8..4), 1..80)) {
            let mut check_in = CheckIn::default();
            let mut model: [Option<u64>; 6] = [None; 6];
            let mut now = 0;
            for (index, wait, kind) in events {
                now += wait;
                let task = Task::ALL[index];
                match kind {
                    0 => { check_in.enable(task, at(now)); model[index] = Some(now); }
                    1 => { check_in.disable(task); model[index] = None; }
                    _ => { check_in.check_in(task, at(now)); if model[index].is_some() { model[index] = Some(now); } }
                }
                let enabled = model.iter().any(Option::is_some);
                for (other, last) in Task::ALL.into_iter().zip(model) {
                    let late = last.is_some_and(|last| now - last > other.period().as_millis());
                    prop_assert_eq!(check_in.late(at(now)).contains(other), late);
                }
                let fed = check_in.may_feed(at(now)).is_ok();
                prop_assert_eq!(fed, enabled && check_in.late(at(now)).is_empty());
            }
        }

        /// A task that never checks in again stops the feeding for good.
        #[test]
        fn a_hung_task_starves_the_watchdog(hung in 0usize..6, start in 0u64..1_000_000, steps in prop::collection::vec(1u64..90, 20..60)) {
            let mut check_in = CheckIn::default();
            for task in Task::ALL { check_in.enable(task, at(start)); }
            let mut now = start;
            for step in steps {
                now += step;
                for task in Task::ALL.into_iter().filter(|task| *task as usize != hung) {
                    check_in.check_in(task, at(now));
                }
                let allowed = now - start <= Task::ALL[hung].period().as_millis();
                prop_assert_eq!(check_in.may_feed(at(now)).is_ok(), allowed);
            }
        }
    }
}
