//! The peripherals of the STM32F405 that the image uses (RM0090).
//!
//! A register or bit that the image touches and a model lacks is an error, never a silent zero.

pub mod adc;
#[cfg(test)]
pub(crate) mod bench;
pub mod bxcan;
pub mod exti;
pub mod flash_interface;
pub mod gpio;
mod halfword;
pub mod i2c;
pub mod iwdg;
pub mod pin_mux;
pub mod rcc;
pub mod spi;
pub mod syscfg;
pub mod system_bus;
pub mod system_memory;
#[cfg(test)]
mod test_world;
pub mod tim2;
pub mod tim4;
pub mod usart;
mod word;

use std::cell::Cell;
use std::fmt;

use crate::outside::Outside;
use crate::time::Ticks;

/// Frequencies of the clock tree, in Hz.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Clocks {
    /// Core, AHB.
    pub ahb: u32,
    /// APB1.
    pub apb1: u32,
    /// APB2.
    pub apb2: u32,
    /// Timers on APB1 (twice APB1 unless its divider is 1).
    pub apb1_timers: u32,
}

/// An access that the model does not have.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Unmodelled {
    /// Peripheral and register ("SPI1_CR2"), or offset where it has no name here.
    pub register: String,
    /// What about it is missing ("RXDMAEN set", "read").
    pub what: String,
}

impl fmt::Display for Unmodelled {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {} is not modelled", self.register, self.what)
    }
}

impl std::error::Error for Unmodelled {}

/// Interrupt request lines, one bit each, by position in the vector table (RM0090 table 62).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Lines {
    /// Those that are up.
    pub levels: [u32; 3],
    /// Those that have risen since they were last looked at, whether they are still up or not: the NVIC sees each edge.
    pub rose: [u32; 3],
}

/// The lines as the peripherals drive them. Levels: a line stays up while its peripheral asks.
#[derive(Debug, Default)]
pub struct Interrupts {
    lines: Cell<Lines>,
    changed: Cell<bool>,
}

impl Interrupts {
    /// Sets the level of line `irq` (0 … 95).
    pub fn set(&self, irq: u16, asserted: bool) {
        let (word, bit) = (usize::from(irq / 32), 1 << (irq % 32));
        let mut lines = self.lines.get();
        if (lines.levels[word] & bit != 0) == asserted {
            return;
        }
        lines.levels[word] ^= bit;
        if asserted {
            lines.rose[word] |= bit;
        }
        self.lines.set(lines);
        self.changed.set(true);
    }

    /// Whether line `irq` is up.
    pub fn is_asserted(&self, irq: u16) -> bool {
        self.lines.get().levels[usize::from(irq / 32)] >> (irq % 32) & 1 != 0
    }

    /// Whether one of the lines changed since [`Interrupts::take_changed`].
    pub fn is_changed(&self) -> bool {
        self.changed.get()
    }

    /// All lines, if one of them changed since the last call.
    pub fn take_changed(&self) -> Option<Lines> {
        self.changed.replace(false).then(|| {
            let lines = self.lines.get();
            self.lines.set(Lines {
                rose: [0; 3],
                ..lines
            });
            lines
        })
    }
}

/// What a peripheral is given with each call.
pub struct Context<'a> {
    /// Now.
    pub now: Ticks,
    /// The clocks as RCC has them.
    pub clocks: Clocks,
    /// Interrupt lines.
    pub interrupts: &'a Interrupts,
    /// The world at the pins.
    pub outside: &'a mut dyn Outside,
}

/// A peripheral on AHB or APB.
///
/// Registers are words; the bus gives narrower accesses as `bytes` 1 or 2 with the offset of the access itself.
/// A peripheral whose clock is off in RCC is not reached by the bus at all: that is an error of its own.
pub trait Peripheral {
    /// Reads the register at `offset` from the peripheral's base.
    ///
    /// # Errors
    /// [`Unmodelled`] for a register that is not there.
    fn read(
        &mut self,
        offset: u32,
        bytes: u8,
        context: &mut Context<'_>,
    ) -> Result<u32, Unmodelled>;

    /// Writes the register at `offset`.
    ///
    /// # Errors
    /// [`Unmodelled`] for a register that is not there or a function that is not modelled.
    fn write(
        &mut self,
        offset: u32,
        bytes: u8,
        value: u32,
        context: &mut Context<'_>,
    ) -> Result<(), Unmodelled>;

    /// When this peripheral next changes by itself; `None` if it waits for somebody else.
    fn next_event(&self) -> Option<Ticks>;

    /// Does what is due at or before `context.now`. The bus calls it when [`Peripheral::next_event`] has come, never late
    /// by more than one instruction.
    fn advance(&mut self, context: &mut Context<'_>);

    /// Reset by RCC or by a system reset: registers to their reset values, outputs and interrupt lines off.
    fn reset(&mut self, context: &mut Context<'_>);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_edge_is_kept_until_it_was_looked_at() {
        let interrupts = Interrupts::default();
        assert_eq!(interrupts.take_changed(), None);
        for irq in [0, 31, 32, 95] {
            interrupts.set(irq, true);
        }
        let up = [1 << 31 | 1, 1, 1 << 31];
        assert_eq!(
            interrupts.take_changed(),
            Some(Lines {
                levels: up,
                rose: up
            })
        );
        interrupts.set(0, true);
        assert_eq!(interrupts.take_changed(), None);
        // Down and up again, up and down again.
        interrupts.set(0, false);
        interrupts.set(0, true);
        interrupts.set(1, true);
        interrupts.set(1, false);
        assert_eq!(
            interrupts.take_changed(),
            Some(Lines {
                levels: up,
                rose: [0b11, 0, 0]
            })
        );
        interrupts.set(95, false);
        assert_eq!(
            interrupts.take_changed(),
            Some(Lines {
                levels: [up[0], up[1], 0],
                rose: [0; 3]
            })
        );
    }
}
