//! Why a reading may not be used. A reading that is not valid is never replaced by 0 A: it keeps its causes and goes
//! onto the bus marked with them.

use serde::{Deserialize, Serialize};

/// The set of causes that make a signal invalid; the empty set is a valid signal.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[serde(transparent)]
pub struct Validity(u8);

impl Validity {
    /// No cause against it.
    pub const VALID: Self = Self(0);
    /// Older than its period allows, or never measured.
    pub const STALE: Self = Self(1 << 0);
    /// The sensor or the converter is at an end of its range.
    pub const SATURATED: Self = Self(1 << 1);
    /// A calibration is under way.
    pub const CALIBRATING: Self = Self(1 << 2);
    /// The sensor is not connected.
    pub const OPEN: Self = Self(1 << 3);
    /// A range change fell into the conversion, or its settling time has not passed.
    pub const RANGE_CHANGE: Self = Self(1 << 4);
    /// It contradicts what is physically possible or another channel: rate of change, stuck code, flag against level.
    pub const IMPLAUSIBLE: Self = Self(1 << 5);
    /// The sensor's supply is outside its limits or unknown where it is needed.
    pub const SUPPLY: Self = Self(1 << 6);
    /// The chip did not answer as it must: bus error, lost configuration, reset.
    pub const CHIP_FAULT: Self = Self(1 << 7);

    /// Whether no cause stands against the signal.
    #[must_use]
    pub const fn is_valid(self) -> bool {
        self.0 == 0
    }

    /// Whether every cause in `other` is in this set.
    #[must_use]
    pub const fn contains(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }

    /// Both sets together.
    #[must_use]
    pub const fn and(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }

    /// This set, with `causes` added when `condition` holds.
    #[must_use]
    pub const fn and_if(self, condition: bool, causes: Self) -> Self {
        if condition { self.and(causes) } else { self }
    }

    /// This set without `causes`.
    #[must_use]
    pub const fn without(self, causes: Self) -> Self {
        Self(self.0 & !causes.0)
    }

    /// The causes as bits, in the order of the constants above, as CAN and Modbus carry them.
    #[must_use]
    pub const fn bits(self) -> u8 {
        self.0
    }

    /// The set that [`Validity::bits`] made.
    #[must_use]
    pub const fn from_bits(bits: u8) -> Self {
        Self(bits)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn causes_are_distinct_bits_and_add_up_to_a_byte() {
        let all = [
            Validity::STALE,
            Validity::SATURATED,
            Validity::CALIBRATING,
            Validity::OPEN,
            Validity::RANGE_CHANGE,
            Validity::IMPLAUSIBLE,
            Validity::SUPPLY,
            Validity::CHIP_FAULT,
        ];
        let union = all.iter().fold(Validity::VALID, |sum, cause| {
            assert!(!sum.contains(*cause));
            sum.and(*cause)
        });
        assert_eq!(union.bits(), 0xFF);
        assert_eq!(Validity::from_bits(0xFF), union);
    }

    #[test]
    fn sets_behave_as_sets() {
        let two = Validity::STALE.and(Validity::OPEN);
        assert!(two.contains(Validity::OPEN) && two.contains(two));
        assert!(!Validity::OPEN.contains(two));
        assert_eq!(two.without(Validity::STALE), Validity::OPEN);
        assert!(two.without(two).is_valid() && Validity::VALID.is_valid());
        assert!(!two.is_valid());
        assert_eq!(Validity::VALID.and_if(true, two), two);
        assert_eq!(Validity::OPEN.and_if(false, two), Validity::OPEN);
    }
}
