//! Accesses narrower than a register, and the refusals that the models share.

use super::Unmodelled;
use crate::time::Ticks;

/// An access that the model does not have.
pub(super) fn unmodelled(register: impl Into<String>, what: impl Into<String>) -> Unmodelled {
    Unmodelled {
        register: register.into(),
        what: what.into(),
    }
}

/// A register that has no name here.
pub(super) fn unknown(peripheral: &str, offset: u32, access: &str) -> Unmodelled {
    unmodelled(format!("{peripheral} + {offset:#05X}"), access)
}

/// Refuses set bits outside `defined`.
pub(super) fn only_bits(register: &str, value: u32, defined: u32) -> Result<(), Unmodelled> {
    refuse_bits(register, value & !defined)
}

/// Refuses any set bit.
pub(super) fn refuse_bits(register: &str, value: u32) -> Result<(), Unmodelled> {
    if value == 0 {
        return Ok(());
    }
    Err(unmodelled(register, format!("bits {value:#010X} set")))
}

/// Refuses accesses narrower than `narrowest` bytes, and those across a register's end.
pub(super) fn check_width(
    peripheral: &str,
    offset: u32,
    bytes: u8,
    narrowest: u8,
) -> Result<(), Unmodelled> {
    if bytes < narrowest || !offset.is_multiple_of(u32::from(bytes)) {
        return Err(unknown(
            peripheral,
            offset,
            &format!("access of {bytes} bytes"),
        ));
    }
    Ok(())
}

fn mask(bytes: u8) -> u32 {
    match bytes {
        1 => 0xFF,
        2 => 0xFFFF,
        _ => u32::MAX,
    }
}

/// What an access of `bytes` at `offset` sees of the register's `word`.
pub(super) fn part(word: u32, offset: u32, bytes: u8) -> u32 {
    word >> (8 * (offset % 4)) & mask(bytes)
}

/// `word` after a write of `bytes` at `offset`.
pub(super) fn merge(word: u32, offset: u32, bytes: u8, value: u32) -> u32 {
    let shift = 8 * (offset % 4);
    let mask = mask(bytes);
    word & !(mask << shift) | (value & mask) << shift
}

/// Period of a clock; RCC refuses those without a whole number of ticks.
pub(super) fn period(hz: u32) -> Ticks {
    Ticks(Ticks::PER_SECOND / u64::from(hz.max(1)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn narrow_accesses_reach_their_bytes_only() {
        assert_eq!(part(0x1122_3344, 0, 4), 0x1122_3344);
        assert_eq!(part(0x1122_3344, 2, 2), 0x1122);
        assert_eq!(part(0x1122_3344, 1, 1), 0x33);
        assert_eq!(merge(0x1122_3344, 0, 4, 0xAABB_CCDD), 0xAABB_CCDD);
        assert_eq!(merge(0x1122_3344, 2, 2, 0xFFFF_AABB), 0xAABB_3344);
        assert_eq!(merge(0x1122_3344, 3, 1, 0x00), 0x0022_3344);
    }

    #[test]
    fn width_is_checked() {
        assert!(check_width("X", 4, 4, 1).is_ok());
        assert!(check_width("X", 6, 2, 1).is_ok());
        assert!(check_width("X", 5, 2, 1).is_err());
        assert!(check_width("X", 4, 1, 2).is_err());
    }
}
