//! Flash memory interface (RM0090, section 3): wait states and caches. The image never programs the MCU's own flash.

use super::word::{check_width, only_bits, refuse_bits, unknown, unmodelled};
use super::{Clocks, Context, Peripheral, Unmodelled};

const ACR_LATENCY: u32 = 0x7;
const ACR_PRFTEN: u32 = 1 << 8;
const ACR_ICEN: u32 = 1 << 9;
const ACR_DCEN: u32 = 1 << 10;
const ACR_ICRST: u32 = 1 << 11;
const ACR_DCRST: u32 = 1 << 12;
const ACR_DEFINED: u32 = ACR_LATENCY | ACR_PRFTEN | ACR_ICEN | ACR_DCEN | ACR_ICRST | ACR_DCRST;

const SR_FLAGS: u32 = 0xF3;
const CR_LOCK: u32 = 1 << 31;
/// OPTCR as delivered, locked (RM0090, section 3.9.9): the brown-out detector is off.
const OPTCR_DELIVERED: u32 = 0x0FFF_AAED;
const OPTCR_BOR_LEV: u32 = 0b11 << 2;

/// Each wait state is good for so much of the AHB clock at 2.7 … 3.6 V (RM0090, table 10), in Hz.
const HZ_PER_STATE: u32 = 30_000_000;

/// Its registers.
///
/// Not modelled: unlocking, programming, erasing, what option bytes do. CR and OPTCR stay locked.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FlashInterface {
    acr: u32,
    /// As the option bytes say.
    optcr: u32,
}

impl FlashInterface {
    /// After reset: no wait state, no cache. The option bytes are those that docs/firmware.md wants: brown-out detector at level 3.
    pub const fn new() -> Self {
        Self {
            acr: 0,
            optcr: OPTCR_DELIVERED & !OPTCR_BOR_LEV,
        }
    }

    /// Option bytes as delivered.
    pub const fn set_delivered(&mut self) {
        self.optcr = OPTCR_DELIVERED;
    }

    /// Wait states of an access that no cache answers.
    pub const fn wait_states(&self) -> u32 {
        self.acr & ACR_LATENCY
    }

    /// Whether the instruction cache is on.
    pub const fn instruction_cache(&self) -> bool {
        self.acr & ACR_ICEN != 0
    }

    /// Whether the data cache is on.
    pub const fn data_cache(&self) -> bool {
        self.acr & ACR_DCEN != 0
    }

    /// Whether the next line is fetched ahead.
    pub const fn prefetch(&self) -> bool {
        self.acr & ACR_PRFTEN != 0
    }

    /// Whether the flash can follow these clocks; to be asked whenever they have changed.
    ///
    /// # Errors
    /// With fewer wait states than RM0090's table 10 wants: what the core then fetches is undefined.
    pub fn check(&self, clocks: Clocks) -> Result<(), Unmodelled> {
        let needed = clocks.ahb.div_ceil(HZ_PER_STATE).saturating_sub(1);
        if self.wait_states() < needed {
            return Err(unmodelled(
                "FLASH_ACR",
                format!(
                    "{} wait states at {} Hz, which takes {needed},",
                    self.wait_states(),
                    clocks.ahb
                ),
            ));
        }
        Ok(())
    }

    fn write_acr(&mut self, value: u32, clocks: Clocks) -> Result<(), Unmodelled> {
        only_bits("FLASH_ACR", value, ACR_DEFINED)?;
        // RM0090: "can be written only when the cache is disabled".
        for (reset, enable) in [(ACR_ICRST, ACR_ICEN), (ACR_DCRST, ACR_DCEN)] {
            if value & reset != 0 && self.acr & enable != 0 {
                return Err(unmodelled("FLASH_ACR", "reset of a cache that is on"));
            }
        }
        let written = Self {
            acr: value,
            ..*self
        };
        written.check(clocks)?;
        *self = written;
        Ok(())
    }
}

impl Peripheral for FlashInterface {
    fn read(
        &mut self,
        offset: u32,
        bytes: u8,
        _context: &mut Context<'_>,
    ) -> Result<u32, Unmodelled> {
        check_width("FLASH", offset, bytes, 4)?;
        match offset {
            0x00 => Ok(self.acr),
            // Nothing was ever programmed.
            0x0C => Ok(0),
            0x10 => Ok(CR_LOCK),
            0x14 => Ok(self.optcr),
            _ => Err(unknown("FLASH", offset, "read")),
        }
    }

    fn write(
        &mut self,
        offset: u32,
        bytes: u8,
        value: u32,
        context: &mut Context<'_>,
    ) -> Result<(), Unmodelled> {
        check_width("FLASH", offset, bytes, 4)?;
        match offset {
            0x00 => self.write_acr(value, context.clocks),
            // Clears flags that are not set.
            0x0C => only_bits("FLASH_SR", value, SR_FLAGS),
            0x10 => refuse_bits("FLASH_CR", value & !CR_LOCK),
            0x04 => Err(unmodelled("FLASH_KEYR", "unlocking")),
            0x08 => Err(unmodelled("FLASH_OPTKEYR", "unlocking")),
            _ => Err(unknown("FLASH", offset, "write")),
        }
    }

    fn next_event(&self) -> Option<crate::time::Ticks> {
        None
    }

    fn advance(&mut self, _context: &mut Context<'_>) {}

    fn reset(&mut self, _context: &mut Context<'_>) {
        self.acr = 0;
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

    use super::super::test_world::{CLOCKS, World};
    use super::*;

    fn slow() -> World {
        World {
            clocks: Clocks {
                ahb: 16_000_000,
                apb1: 16_000_000,
                apb2: 16_000_000,
                apb1_timers: 16_000_000,
            },
            ..World::default()
        }
    }

    #[test]
    fn reset_values_are_the_manuals() {
        let mut world = slow();
        let mut flash = FlashInterface::new();
        assert_eq!(world.read(&mut flash, 0x00), 0);
        assert_eq!(world.read(&mut flash, 0x0C), 0);
        assert_eq!(world.read(&mut flash, 0x10), 0x8000_0000);
        assert_eq!(world.read(&mut flash, 0x14), 0x0FFF_AAE1);
        flash.set_delivered();
        assert_eq!(world.read(&mut flash, 0x14), 0x0FFF_AAED);
    }

    /// RM0090, table 10, column 2.7 … 3.6 V.
    #[test]
    fn wait_states_follow_the_table() {
        let rows = [
            (30_000_000, 0),
            (30_000_001, 1),
            (60_000_000, 1),
            (90_000_000, 2),
            (120_000_000, 3),
            (150_000_000, 4),
            (150_000_001, 5),
            (168_000_000, 5),
        ];
        for (ahb, needed) in rows {
            let clocks = Clocks { ahb, ..CLOCKS };
            for states in 0..8 {
                let flash = FlashInterface {
                    acr: states,
                    ..FlashInterface::new()
                };
                assert_eq!(
                    flash.check(clocks).is_ok(),
                    states >= needed,
                    "{ahb} Hz, {states}"
                );
            }
        }
    }

    #[test]
    fn caches_and_latency_are_kept() {
        let mut world = slow();
        let mut flash = FlashInterface::new();
        world.write(&mut flash, 0x00, 0x0705);
        assert_eq!(world.read(&mut flash, 0x00), 0x0705);
        assert_eq!(flash.wait_states(), 5);
        assert!(flash.prefetch() && flash.instruction_cache() && flash.data_cache());
        world.clocks = CLOCKS;
        assert!(
            world.refuses(&mut flash, 0x00, 0x0704),
            "four wait states at 168 MHz"
        );
        assert_eq!(world.read(&mut flash, 0x00), 0x0705);
    }

    #[test]
    fn what_is_missing_is_refused() {
        let mut world = slow();
        let mut flash = FlashInterface::new();
        assert!(world.refuses(&mut flash, 0x04, 0x4567_0123));
        assert!(world.refuses(&mut flash, 0x08, 0x0819_2A3B));
        assert!(world.refuses(&mut flash, 0x10, 1));
        assert!(world.refuses(&mut flash, 0x14, 0));
        world.write(&mut flash, 0x00, ACR_ICRST);
        world.write(&mut flash, 0x00, ACR_ICEN);
        assert!(world.refuses(&mut flash, 0x00, ACR_ICEN | ACR_ICRST));
        assert!(flash.read(0x00, 2, &mut world.context()).is_err());
    }
}
