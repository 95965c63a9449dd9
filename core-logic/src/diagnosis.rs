//! What the board says about its own health: one table of diagnoses, and the state that debounces, latches and counts
//! them.
//!
//! A row is a stable code (its number is its bit on CAN and in the log), the condition that raises it, where its
//! threshold lives, the debounce for setting and clearing, its severity, whether it latches, and the validity causes it
//! adds to current, charge and state of charge while it is active. A debounce of 0 means that the module which finds
//! the condition debounces it itself. `docs/diagnosis.md` is this table.

use crate::units::{Instant, elapsed, milliseconds};
use crate::validity::Validity;

/// How bad it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[repr(u8)]
pub enum Severity {
    /// Worth knowing.
    Info = 0,
    /// Measuring goes on; something needs attention.
    Warning = 1,
    /// A reading is invalid or degraded.
    Error = 2,
    /// The vehicle must not rely on this board, or is in a state it must not be in.
    Critical = 3,
}

/// How long a diagnosis stays reported.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Latch {
    /// Until its condition has gone.
    WhileActive,
    /// Until it is cleared by command after its condition has gone.
    UntilCleared,
}

/// Validity causes by signal.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Effects {
    /// Added to the current's validity.
    pub current: Validity,
    /// Added to the charge's validity.
    pub charge: Validity,
    /// Added to the validity of the state of charge.
    pub soc: Validity,
}

/// What the firmware needs of a row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rule {
    /// The condition must hold this long before the diagnosis is set, in ms.
    pub set_after_ms: u16,
    /// The condition must be gone this long before it is cleared, in ms.
    pub clear_after_ms: u16,
    /// Severity.
    pub severity: Severity,
    /// Latch.
    pub latch: Latch,
    /// What it does to the readings while active.
    pub effects: Effects,
}

/// What a reader needs of a row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Description {
    /// The code's name.
    pub name: &'static str,
    /// When it is raised.
    pub condition: &'static str,
    /// Its threshold, and where that is set.
    pub threshold: &'static str,
}

macro_rules! diagnoses {
    ($($number:literal $name:ident: $condition:literal, $threshold:literal;
        $set_ms:literal ms, $clear_ms:literal ms, $severity:ident, $latch:ident,
        [$($current:ident)*] [$($charge:ident)*] [$($soc:ident)*])*) => {
        /// The code of a diagnosis; numbers are never reused.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        #[cfg_attr(feature = "defmt", derive(defmt::Format))]
        #[repr(u8)]
        pub enum Code {
            $(#[doc = $condition] $name = $number,)*
        }

        impl Code {
            /// All codes, in the order of their numbers.
            pub const ALL: [Self; Self::COUNT] = [$(Self::$name,)*];
            /// How many there are.
            pub const COUNT: usize = [$($number,)*].len();
        }

        /// The rules, by code.
        pub const RULES: [Rule; Code::COUNT] = [$(
            Rule {
                set_after_ms: $set_ms,
                clear_after_ms: $clear_ms,
                severity: Severity::$severity,
                latch: Latch::$latch,
                effects: Effects {
                    current: Validity::VALID$(.and(Validity::$current))*,
                    charge: Validity::VALID$(.and(Validity::$charge))*,
                    soc: Validity::VALID$(.and(Validity::$soc))*,
                },
            },
        )*];

        /// The words, by code; apart from the rules so that they take no flash where nobody reads them.
        pub const DESCRIPTIONS: [Description; Code::COUNT] = [$(
            Description { name: stringify!($name), condition: $condition, threshold: $threshold },
        )*];
    };
}

diagnoses! {
    // 15 clears when the factory's window of the meter's mean, a second, has nothing of it any more.
    // number, name: condition, threshold; set, clear, severity, latch, effect on [current] [charge] [soc]
    0 OpenSensor: "The sensor in use is not connected.",
        "network output below the open threshold: 0.15 V open, lowest legal output from the front end (D3; `OpenSensorConfig`)";
        0 ms, 1000 ms, Error, WhileActive, [OPEN] [OPEN] [OPEN]
    1 SensorRail: "The sensor's output is stuck at ground or at its supply.",
        "half-way between the end of the sensor's range and the rail (D0: 0.125 / 4.875 V), or the like level on the network, two readings (`OpenSensorThresholds`)";
        0 ms, 1000 ms, Error, WhileActive, [OPEN] [OPEN] [OPEN]
    2 SensorSaturated: "The selected sensor is at the end of its range.",
        "front end's output limits: 0.25 / 4.75 V (D0), 0.5 / 4.5 V (D2)";
        0 ms, 100 ms, Warning, WhileActive, [SATURATED] [SATURATED] [SATURATED]
    3 ConverterNoAnswer: "The ADS1100 does not answer, bus recovery included.",
        "no completed read for 100 ms";
        100 ms, 500 ms, Error, WhileActive, [CHIP_FAULT] [] []
    4 ConverterConfigurationLost: "The ADS1100's configuration byte is not the one written: it was reset.",
        "third byte of any read (`ConverterConfig`)";
        0 ms, 100 ms, Warning, WhileActive, [CHIP_FAULT] [] []
    5 ConverterStale: "No new conversion in time.",
        "three conversion periods (`ConverterConfig`); the readings say *stale* themselves, just as long as they are";
        0 ms, 500 ms, Error, WhileActive, [] [] []
    6 ConverterStuck: "The conversion result does not move although the current does.",
        "repeats beyond `ConverterConfig` while the meter's mean current moves";
        0 ms, 1000 ms, Error, WhileActive, [IMPLAUSIBLE] [] []
    7 RateImplausible: "The current changed faster than it can.",
        "rate limit in A/s (`ConverterConfig`)";
        0 ms, 100 ms, Warning, WhileActive, [IMPLAUSIBLE] [] []
    8 MeterNoAnswer: "The ADE7753 cannot be read: every retry failed.",
        "no reading for 100 ms, or the chip does not take its configuration";
        40 ms, 500 ms, Error, WhileActive, [] [CHIP_FAULT] [CHIP_FAULT]
    9 MeterDeadBus: "The ADE7753's MODE or DIEREV reads back wrong: its bus is stuck.",
        "one turn of the read-back, its register read twice";
        0 ms, 500 ms, Error, WhileActive, [] [CHIP_FAULT] [CHIP_FAULT]
    10 MeterChecksum: "Reads of the ADE7753 fail their checksum too often.",
        "retries per second above the limit of the meter's owner";
        0 ms, 10000 ms, Warning, WhileActive, [] [] []
    11 MeterReset: "The ADE7753 was reset and set up again; the gap is bridged from the converter.",
        "STATUS.RESET, or MODE back at its default";
        0 ms, 100 ms, Warning, WhileActive, [] [CHIP_FAULT] []
    12 MeterFrozen: "AENERGY stands still although the converter shows current.",
        "1 s (channel comparison)";
        0 ms, 1000 ms, Error, WhileActive, [] [CHIP_FAULT] [CHIP_FAULT]
    13 MeterDeltaRejected: "AENERGY moved further than the full-scale current can move it.",
        "1.2 times the full-scale rate (`METER_COUNTS_PER_SECOND_Q32`)";
        0 ms, 1000 ms, Warning, WhileActive, [] [IMPLAUSIBLE] []
    14 ChannelsDisagree: "Meter charge and the converter's integral differ.",
        "bound from the error budget (`ChannelCompareConfig`)";
        0 ms, 10000 ms, Error, WhileActive, [IMPLAUSIBLE] [IMPLAUSIBLE] [IMPLAUSIBLE]
    15 FlagImplausible: "Range flag and signal level contradict each other.",
        "switching current ±53.33 A with margin, 200 ms at most (`SWITCHING_CURRENT`)";
        0 ms, 2000 ms, Error, WhileActive, [IMPLAUSIBLE] [IMPLAUSIBLE] [IMPLAUSIBLE]
    16 RangeChatter: "The range changes more often than a drive profile explains; charge is estimated.",
        "edges per window (`ChatterConfig`)";
        0 ms, 1000 ms, Warning, WhileActive, [] [] []
    17 EdgeStorm: "The range-flag or meter interrupt is masked: too many edges.",
        "events per window (`StormConfig`)";
        0 ms, 1000 ms, Warning, WhileActive, [] [] []
    18 SupplyOutOfRange: "The sensors' supply is outside its limits, or not measured.",
        "4.5 … 5.5 V (`SENSOR_SUPPLY_LOW`, `SENSOR_SUPPLY_HIGH`)";
        20 ms, 200 ms, Error, WhileActive, [SUPPLY] [SUPPLY] [SUPPLY]
    19 TemperatureOutOfRange: "Sensor or board temperature is outside its limits.",
        "limits of the configuration";
        1000 ms, 5000 ms, Warning, WhileActive, [] [] []
    20 KeyCalibrationFailed: "The factors by key state were refused or came too late; the previous ones are in use.",
        "stability, current and time limits (`KeyCalibrationConfig`)";
        0 ms, 0 ms, Warning, UntilCleared, [] [] []
    21 HvWithoutPermit: "High voltage is on without this board's permit.",
        "feedback on, permit withheld for longer than the feedback grace (`KeyCalibrationConfig`)";
        100 ms, 100 ms, Critical, UntilCleared, [] [] []
    22 SupplyCalibrationInvalid: "The front end needs supply relations (D4) and has none.",
        "limits of the supply relations";
        0 ms, 0 ms, Error, WhileActive, [SUPPLY] [SUPPLY] [SUPPLY]
    23 ZeroDriftBeyondLimit: "The zero drift at rest is beyond what may be compensated.",
        "limit of the zero drift (`ZeroDriftConfig`)";
        1000 ms, 1000 ms, Error, WhileActive, [IMPLAUSIBLE] [IMPLAUSIBLE] [IMPLAUSIBLE]
    24 SocUncertain: "The state of charge is less certain than its limit.",
        "half-width above 10 % of the capacity (`SOC_UNCERTAINTY_LIMIT`, no setting)";
        1000 ms, 10000 ms, Warning, WhileActive, [] [] [IMPLAUSIBLE]
    25 CellVoltageMissing: "No cell voltage received, or only as not available, so the state of charge cannot be re-anchored.",
        "500 ms (`CAN_RECEIVE_TIMEOUT_MS`)";
        5000 ms, 1000 ms, Warning, WhileActive, [] [] []
    26 VehicleStateMissing: "No vehicle state received.",
        "500 ms (`CAN_RECEIVE_TIMEOUT_MS`)";
        5000 ms, 1000 ms, Warning, WhileActive, [] [] []
    27 CanBusOff: "The CAN controller left the bus.",
        "its bus-off flag";
        0 ms, 1000 ms, Error, WhileActive, [] [] []
    28 CanRxE2e: "Received frames fail their end-to-end check.",
        "any refused frame (CRC, data ID, counter, length, reserved value)";
        0 ms, 5000 ms, Warning, WhileActive, [] [] []
    29 CanRxOverrun: "Received CAN frames were dropped: the bus floods the board.",
        "any overrun of the controller's queue";
        0 ms, 5000 ms, Info, WhileActive, [] [] []
    30 Rs485Errors: "Requests on RS485 are damaged.",
        "CRC, parity or framing errors since the last look";
        0 ms, 5000 ms, Info, WhileActive, [] [] []
    31 FlashFault: "A write, erase or check of the flash failed, or a stored record is damaged or was cut off.",
        "any failure after retries";
        0 ms, 0 ms, Error, UntilCleared, [] [] []
    32 ConfigurationDefault: "The stored configuration was refused, or none was there for a lost one; defaults are in use.",
        "CRC, version or limits of the configuration record";
        0 ms, 0 ms, Error, UntilCleared, [] [] []
    33 ConfigurationCorruptRam: "The configuration in RAM or a factor worked out from it failed its check; nothing is valid until both are right, from the stored one or without one the defaults.",
        "CRC and comparison once a second";
        0 ms, 1000 ms, Critical, UntilCleared, [IMPLAUSIBLE] [IMPLAUSIBLE] [IMPLAUSIBLE]
    34 LogFull: "The log is full: every new record replaces the oldest.",
        "oldest record replaced";
        0 ms, 0 ms, Info, UntilCleared, [] [] []
    35 WatchdogReset: "The last reset came from a watchdog.",
        "reset cause";
        0 ms, 0 ms, Error, UntilCleared, [] [] []
    36 PanicReset: "The last run ended in a panic or a fault exception.",
        "retained panic record";
        0 ms, 0 ms, Error, UntilCleared, [] [] []
    37 BrownOutReset: "The last reset came from the supply without an orderly power-off.",
        "reset flags: brown-out without power-on";
        0 ms, 0 ms, Info, UntilCleared, [] [] []
    38 StackHighWater: "Less stack has stayed free than the reserve.",
        "reserve of the firmware's stack check";
        0 ms, 0 ms, Warning, UntilCleared, [] [] []
    39 ChargeRestoredWithLoss: "Charge and state of charge were restored from an older record, or their record cannot be used.",
        "a bound on the loss that is not 0: ChargeUncertainty";
        0 ms, 0 ms, Warning, UntilCleared, [] [] []
    40 SmallSensorOpen: "The small sensor is open; the large one measures in its place with its coarser resolution.",
        "as OpenSensor, with the dual-range front end in the large range";
        0 ms, 1000 ms, Error, WhileActive, [] [] []
    41 KeyContradiction: "Key line and CAN contradict each other; the line decides, and no key factors are taken.",
        "OFF by one and not OFF by the other, while VehicleState is received";
        1000 ms, 1000 ms, Warning, WhileActive, [] [] []
}

impl Code {
    /// The code with this number.
    #[must_use]
    pub fn from_number(number: u8) -> Option<Self> {
        Self::ALL.get(usize::from(number)).copied()
    }

    /// Its number: its bit in a [`CodeSet`].
    #[must_use]
    pub const fn number(self) -> u8 {
        self as u8
    }

    /// Its rule.
    #[must_use]
    #[expect(
        clippy::indexing_slicing,
        reason = "the table has one row per code, in order"
    )]
    pub const fn rule(self) -> &'static Rule {
        &RULES[self as usize]
    }

    /// Its words.
    #[must_use]
    #[expect(
        clippy::indexing_slicing,
        reason = "the table has one row per code, in order"
    )]
    pub const fn description(self) -> &'static Description {
        &DESCRIPTIONS[self as usize]
    }
}

/// A set of codes; bit n is the code with number n.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct CodeSet(u64);

impl CodeSet {
    /// No code.
    pub const EMPTY: Self = Self(0);
    /// Every code there is.
    pub const ALL: Self = Self((1 << Code::COUNT) - 1);

    /// Those that stand against the charge, and the meter's mean with it.
    pub const AGAINST_CHARGE: Self = Self::against(true);

    /// Those that stand against the current, without those that each reading says of itself: readings that look sound are none.
    pub const AGAINST_SOUND_READINGS: Self = Self::against(false)
        .without(Self::of(Code::SensorSaturated))
        .without(Self::of(Code::ConverterNoAnswer))
        .without(Self::of(Code::ConverterConfigurationLost))
        .without(Self::of(Code::RateImplausible));

    /// Those that stand against the charge, or against the current.
    const fn against(charge: bool) -> Self {
        let (mut bits, mut bit) = (0, 1);
        let mut rules: &[Rule] = &RULES;
        while let [rule, rest @ ..] = rules {
            let effects = &rule.effects;
            let causes = if charge {
                effects.charge
            } else {
                effects.current
            };
            if !causes.is_valid() {
                bits |= bit;
            }
            (rules, bit) = (rest, bit << 1);
        }
        Self(bits)
    }

    const fn of(code: Code) -> Self {
        Self(1 << code.number())
    }

    /// From its bits; bits without a code are dropped.
    #[must_use]
    pub const fn from_bits(bits: u64) -> Self {
        Self(bits & Self::ALL.0)
    }

    /// Its bits, as CAN and the log carry them.
    #[must_use]
    pub const fn bits(self) -> u64 {
        self.0
    }

    /// This set with `code` when `present`, without it otherwise.
    pub const fn set(&mut self, code: Code, present: bool) {
        if present {
            self.0 |= Self::of(code).0;
        } else {
            self.0 &= !Self::of(code).0;
        }
    }

    /// Whether `code` is in the set.
    #[must_use]
    pub const fn contains(self, code: Code) -> bool {
        self.0 & Self::of(code).0 != 0
    }

    /// Both sets together.
    #[must_use]
    pub const fn union(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }

    /// The codes that are in both sets.
    #[must_use]
    pub const fn intersection(self, other: Self) -> Self {
        Self(self.0 & other.0)
    }

    /// This set without `other`.
    #[must_use]
    pub const fn without(self, other: Self) -> Self {
        Self(self.0 & !other.0)
    }

    /// The codes that are in one of the two sets only.
    #[must_use]
    pub const fn difference(self, other: Self) -> Self {
        Self(self.0 ^ other.0)
    }

    /// Whether there is no code in it.
    #[must_use]
    pub const fn is_empty(self) -> bool {
        self.0 == 0
    }

    /// How many codes are in it.
    #[must_use]
    pub const fn len(self) -> u32 {
        self.0.count_ones()
    }

    /// The codes, lowest number first.
    pub fn iter(self) -> impl Iterator<Item = Code> {
        let mut left = self.0;
        core::iter::from_fn(move || {
            // 64 when nothing is left, which is no code's number.
            let number = u8::try_from(left.trailing_zeros()).ok()?;
            left &= left.wrapping_sub(1);
            Code::from_number(number)
        })
    }

    /// The code after `previous`, starting over at the end; the first one for `None`. For a frame that shows one code
    /// at a time.
    #[must_use]
    pub fn next_after(self, previous: Option<Code>) -> Option<Code> {
        let later = self
            .iter()
            .find(|code| previous.is_some_and(|previous| code.number() > previous.number()));
        later.or_else(|| self.iter().next())
    }
}

/// What a step or a command changed: the events of the log.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Changes {
    /// Became active.
    pub set: CodeSet,
    /// Is active no longer.
    pub cleared: CodeSet,
}

/// What is known about one code.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Detail {
    /// Its condition holds, debounced.
    pub active: bool,
    /// It waits to be cleared by command.
    pub latched: bool,
    /// Times it was set since it was last forgotten, saturating.
    pub occurrences: u16,
    /// When it was set first; `None` if it never was.
    pub first_seen: Option<Instant>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Entry {
    /// Since when the condition has differed from `active`, while the code is pending.
    differs_since: Instant,
    /// When it was set first, if it ever was.
    first_seen: Instant,
    occurrences: u16,
}

impl Entry {
    const NEW: Self = Self {
        differs_since: Instant::from_ticks(0),
        first_seen: Instant::from_ticks(0),
        occurrences: 0,
    };
}

/// State of all diagnoses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Diagnosis {
    active: CodeSet,
    latched: CodeSet,
    /// Codes whose condition differs from `active`, their debounce not having passed.
    pending: CodeSet,
    entries: [Entry; Code::COUNT],
}

impl Default for Diagnosis {
    fn default() -> Self {
        Self {
            active: CodeSet::EMPTY,
            latched: CodeSet::EMPTY,
            pending: CodeSet::EMPTY,
            entries: [Entry::NEW; Code::COUNT],
        }
    }
}

impl Diagnosis {
    /// Takes the conditions as they are `now`; called every 10 ms, so a debounce is exact to 10 ms.
    pub fn step(&mut self, now: Instant, conditions: CodeSet) -> Changes {
        let mut changes = Changes::default();
        let differing = conditions.difference(self.active);
        for code in differing.iter() {
            let Some(entry) = self.entries.get_mut(usize::from(code.number())) else {
                continue;
            };
            if !self.pending.contains(code) {
                entry.differs_since = now;
            }
            let rule = code.rule();
            let sets = conditions.contains(code);
            let debounce = if sets {
                rule.set_after_ms
            } else {
                rule.clear_after_ms
            };
            if elapsed(entry.differs_since, now) < milliseconds(u32::from(debounce)) {
                continue;
            }
            self.active.set(code, sets);
            if sets {
                changes.set.set(code, true);
                if entry.occurrences == 0 {
                    entry.first_seen = now;
                }
                entry.occurrences = entry.occurrences.saturating_add(1);
                if rule.latch == Latch::UntilCleared {
                    self.latched.set(code, true);
                }
            } else {
                changes.cleared.set(code, true);
            }
        }
        self.pending = conditions.difference(self.active);
        changes
    }

    /// The debounced conditions that hold.
    #[must_use]
    pub const fn active(&self) -> CodeSet {
        self.active
    }

    /// The latched codes: set since they were last cleared, whether or not their condition still holds.
    #[must_use]
    pub const fn latched(&self) -> CodeSet {
        self.latched
    }

    /// Active or latched.
    #[must_use]
    pub const fn reported(&self) -> CodeSet {
        self.active.union(self.latched)
    }

    /// Forgets everything about the codes whose condition has gone: latches, counts and first times. An active code
    /// stays as it is. The answer is the codes that are reported no longer.
    pub fn clear(&mut self) -> CodeSet {
        let gone = self.latched.without(self.active);
        self.latched = self.latched.without(gone);
        for (code, entry) in Code::ALL.into_iter().zip(&mut self.entries) {
            if !self.active.contains(code) {
                entry.occurrences = 0;
            }
        }
        gone
    }

    /// What is known about `code`.
    #[must_use]
    pub fn detail(&self, code: Code) -> Detail {
        let entry = self.entries.get(code as usize).unwrap_or(&Entry::NEW);
        Detail {
            active: self.active.contains(code),
            latched: self.latched.contains(code),
            occurrences: entry.occurrences,
            first_seen: (entry.occurrences > 0).then_some(entry.first_seen),
        }
    }

    /// The highest severity reported.
    #[must_use]
    pub fn worst(&self) -> Option<Severity> {
        self.reported()
            .iter()
            .map(|code| code.rule().severity)
            .max()
    }

    /// The causes that the active codes add to the readings.
    #[must_use]
    pub fn effects(&self) -> Effects {
        let mut sum = Effects::default();
        for code in self.active.iter() {
            let effects = code.rule().effects;
            sum.current = sum.current.and(effects.current);
            sum.charge = sum.charge.and(effects.charge);
            sum.soc = sum.soc.and(effects.soc);
        }
        sum
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

    fn only(code: Code) -> CodeSet {
        let mut set = CodeSet::EMPTY;
        set.set(code, true);
        set
    }

    #[test]
    fn sets_by_what_the_codes_stand_against() {
        for code in Code::ALL {
            let effects = code.rule().effects;
            let charge = CodeSet::AGAINST_CHARGE.contains(code);
            assert_eq!(charge, !effects.charge.is_valid(), "{code:?}");
            let current = CodeSet::AGAINST_SOUND_READINGS.contains(code);
            assert!(!current || !effects.current.is_valid(), "{code:?}");
        }
        assert_eq!(CodeSet::AGAINST_SOUND_READINGS.len(), 9);
    }

    #[test]
    fn numbers_are_bits_in_order() {
        for (index, code) in Code::ALL.into_iter().enumerate() {
            assert_eq!(usize::from(code.number()), index);
            assert_eq!(Code::from_number(code.number()), Some(code));
            assert_eq!(only(code).bits(), 1 << index);
            assert_eq!(std::format!("{code:?}"), code.description().name);
        }
        assert_eq!(Code::from_number(42), None);
        assert_eq!(CodeSet::ALL.bits(), (1 << 42) - 1);
        assert_eq!(CodeSet::from_bits(u64::MAX), CodeSet::ALL);
        assert_eq!(CodeSet::ALL.len(), 42);
        assert!(CodeSet::EMPTY.is_empty() && !CodeSet::ALL.is_empty());
        let (one, other) = (only(Code::OpenSensor), only(Code::LogFull));
        assert_eq!(one.union(other).difference(other), one);
        assert_eq!(one.difference(other), one.union(other));
        assert_eq!(one.union(other).without(other), one);
        assert_eq!(one.without(other), one);
    }

    /// Rows that others rely on: the fault list and the documents fix them.
    #[test]
    fn rows_that_are_fixed_elsewhere() {
        let rule = Code::ConverterNoAnswer.rule();
        assert_eq!((rule.set_after_ms, rule.clear_after_ms), (100, 500));
        assert_eq!(rule.effects.current, Validity::CHIP_FAULT);
        assert_eq!(rule.effects.charge, Validity::VALID);
        let open = Code::OpenSensor.rule();
        assert_eq!(
            open.effects,
            Effects {
                current: Validity::OPEN,
                charge: Validity::OPEN,
                soc: Validity::OPEN
            }
        );
        assert_eq!(Code::HvWithoutPermit.rule().severity, Severity::Critical);
        assert_eq!(Code::HvWithoutPermit.rule().latch, Latch::UntilCleared);
        // F3 and F10: validity drops within 100 ms and 200 ms.
        assert!(Code::MeterDeadBus.rule().set_after_ms + 2 * 20 <= 100);
        assert_eq!(Code::FlagImplausible.rule().set_after_ms, 0);
        assert!(Severity::Critical > Severity::Error && Severity::Warning > Severity::Info);
    }

    #[test]
    fn set_and_cleared_after_their_debounce_exactly() {
        let mut diagnosis = Diagnosis::default();
        let code = Code::SupplyOutOfRange; // 20 ms, 200 ms
        let on = only(code);
        let none = Changes::default();
        assert_eq!(diagnosis.step(at(100), on), none);
        assert_eq!(diagnosis.step(Instant::from_ticks(119_999), on), none);
        assert_eq!(diagnosis.step(at(120), on), Changes { set: on, ..none });
        assert_eq!(diagnosis.step(at(130), on), none);
        assert_eq!(diagnosis.effects().current, Validity::SUPPLY);
        // A gap shorter than the debounce changes nothing and starts it anew.
        assert_eq!(diagnosis.step(at(140), CodeSet::EMPTY), none);
        assert_eq!(diagnosis.step(at(330), on), none);
        assert_eq!(diagnosis.step(at(340), CodeSet::EMPTY), none);
        assert_eq!(diagnosis.step(at(539), CodeSet::EMPTY), none);
        assert!(diagnosis.active().contains(code));
        assert_eq!(
            diagnosis.step(at(540), CodeSet::EMPTY),
            Changes {
                cleared: on,
                ..none
            }
        );
        assert_eq!(
            (diagnosis.reported(), diagnosis.effects()),
            (CodeSet::EMPTY, Effects::default())
        );
        assert_eq!(
            diagnosis.detail(code),
            Detail {
                active: false,
                latched: false,
                occurrences: 1,
                first_seen: Some(at(120))
            }
        );
        assert_eq!(diagnosis.clear(), CodeSet::EMPTY);
        assert_eq!(diagnosis.detail(code).first_seen, None);
        assert_eq!(diagnosis.detail(code).occurrences, 0);
    }

    #[test]
    fn a_spike_never_sets() {
        let mut diagnosis = Diagnosis::default();
        let on = only(Code::ConverterNoAnswer);
        for n in 0..50 {
            assert_eq!(diagnosis.step(at(200 * n), on), Changes::default());
            assert_eq!(diagnosis.step(at(200 * n + 90), on), Changes::default());
            assert_eq!(
                diagnosis.step(at(200 * n + 95), CodeSet::EMPTY),
                Changes::default()
            );
        }
    }

    #[test]
    fn a_latched_code_stays_until_cleared_and_cannot_be_cleared_while_active() {
        let mut diagnosis = Diagnosis::default();
        let flash = only(Code::FlashFault);
        assert_eq!(diagnosis.worst(), None);
        assert_eq!(diagnosis.step(at(5), flash).set, flash);
        assert_eq!(diagnosis.worst(), Some(Severity::Error));
        assert_eq!(diagnosis.clear(), CodeSet::EMPTY);
        assert_eq!(diagnosis.detail(Code::FlashFault).occurrences, 1);
        assert_eq!(diagnosis.step(at(6), CodeSet::EMPTY).cleared, flash);
        assert_eq!(
            (diagnosis.active(), diagnosis.latched()),
            (CodeSet::EMPTY, flash)
        );
        assert_eq!(diagnosis.reported(), flash);
        assert!(diagnosis.detail(Code::FlashFault).latched);
        // Again, and it counts; the first time stays.
        diagnosis.step(at(7), flash);
        diagnosis.step(at(8), CodeSet::EMPTY);
        let detail = diagnosis.detail(Code::FlashFault);
        assert_eq!((detail.occurrences, detail.first_seen), (2, Some(at(5))));
        assert_eq!(diagnosis.clear(), flash);
        assert_eq!(
            (diagnosis.reported(), diagnosis.worst()),
            (CodeSet::EMPTY, None)
        );
    }

    #[test]
    fn the_worst_of_several_and_their_effects_together() {
        let mut diagnosis = Diagnosis::default();
        let mut on = only(Code::OpenSensor);
        on.set(Code::FlagImplausible, true);
        on.set(Code::LogFull, true);
        diagnosis.step(at(0), on);
        assert_eq!(diagnosis.worst(), Some(Severity::Error));
        let both = Validity::OPEN.and(Validity::IMPLAUSIBLE);
        assert_eq!(
            diagnosis.effects(),
            Effects {
                current: both,
                charge: both,
                soc: both
            }
        );
        on.set(Code::OpenSensor, false);
        assert_eq!(on, only(Code::FlagImplausible).union(only(Code::LogFull)));
        diagnosis.step(at(0), on);
        assert!(
            diagnosis.active().contains(Code::OpenSensor),
            "clears after its debounce"
        );
    }

    #[test]
    fn occurrences_saturate() {
        /// Without a time: it comes and goes with each step.
        const UNDEBOUNCED: Code = Code::SupplyCalibrationInvalid;
        let mut diagnosis = Diagnosis::default();
        for n in 0..70_000 {
            let on = if n % 2 == 0 {
                only(UNDEBOUNCED)
            } else {
                CodeSet::EMPTY
            };
            diagnosis.step(at(n), on);
        }
        assert_eq!(diagnosis.detail(UNDEBOUNCED).occurrences, 35_000);
        for n in 70_000..140_000 {
            let on = if n % 2 == 0 {
                only(UNDEBOUNCED)
            } else {
                CodeSet::EMPTY
            };
            diagnosis.step(at(n), on);
        }
        assert_eq!(diagnosis.detail(UNDEBOUNCED).occurrences, u16::MAX);
    }

    #[test]
    fn codes_are_shown_in_turn() {
        let mut set = only(Code::MeterReset);
        set.set(Code::OpenSensor, true);
        set.set(Code::SmallSensorOpen, true);
        let first = set.next_after(None);
        let second = set.next_after(first);
        let third = set.next_after(second);
        assert_eq!(
            [first, second, third, set.next_after(third)],
            [
                Some(Code::OpenSensor),
                Some(Code::MeterReset),
                Some(Code::SmallSensorOpen),
                Some(Code::OpenSensor)
            ]
        );
        // A code that has gone meanwhile does not stop the turn.
        assert_eq!(
            set.next_after(Some(Code::ConverterStuck)),
            Some(Code::MeterReset)
        );
        assert_eq!(CodeSet::EMPTY.next_after(first), None);
        assert_eq!(set.iter().collect::<Vec<_>>().len(), 3);
    }

    #[derive(Clone, Copy, Default)]
    struct Reference {
        active: bool,
        latched: bool,
        occurrences: u16,
        history: Option<(bool, u64)>,
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// Against the rule said differently: the condition has had its present value, against `active`, without a
        /// break since `t`; it wins when now − t reaches the debounce.
        #[test]
        fn agrees_with_a_model(steps in prop::collection::vec((any::<u64>(), any::<u64>(), 0u64..300, 0u8..20), 1..120)) {
            let mut diagnosis = Diagnosis::default();
            let mut model = [Reference::default(); Code::COUNT];
            let mut now = 0;
            for (a, b, wait, clear) in steps {
                now += wait;
                // Two random words: conditions change in a quarter of the bits.
                let conditions = CodeSet::from_bits(diagnosis.active().bits() ^ (a & b));
                let changes = diagnosis.step(at(now), conditions);
                for (code, reference) in Code::ALL.into_iter().zip(&mut model) {
                    let condition = conditions.contains(code);
                    let rule = code.rule();
                    let before = reference.active;
                    if condition == reference.active {
                        reference.history = None;
                    } else {
                        let (_, since) = *reference.history.get_or_insert((condition, now));
                        let debounce = if condition { rule.set_after_ms } else { rule.clear_after_ms };
                        if now - since >= u64::from(debounce) {
                            reference.active = condition;
                            reference.history = None;
                            reference.occurrences += u16::from(condition);
                            reference.latched |= condition && rule.latch == Latch::UntilCleared;
                        }
                    }
                    prop_assert_eq!(changes.set.contains(code), !before && reference.active);
                    prop_assert_eq!(changes.cleared.contains(code), before && !reference.active);
                }
                if clear == 0 {
                    diagnosis.clear();
                    for reference in model.iter_mut().filter(|reference| !reference.active) {
                        reference.latched = false;
                        reference.occurrences = 0;
                    }
                }
                for (code, reference) in Code::ALL.into_iter().zip(model) {
                    let detail = diagnosis.detail(code);
                    prop_assert_eq!(detail.active, reference.active);
                    prop_assert_eq!(detail.latched, reference.latched);
                    prop_assert_eq!(detail.occurrences, reference.occurrences);
                    prop_assert_eq!(detail.first_seen.is_some(), reference.occurrences > 0);
                }
            }
        }

        #[test]
        fn no_input_panics(inputs in prop::collection::vec((any::<u64>(), any::<u64>()), 0..40)) {
            let mut diagnosis = Diagnosis::default();
            for (now, bits) in inputs {
                diagnosis.step(Instant::from_ticks(now), CodeSet::from_bits(bits));
                let _ = (diagnosis.effects(), diagnosis.worst());
            }
        }
    }
}
