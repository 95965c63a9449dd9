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

/// Interrupt request lines (position in the vector table, RM0090 table 62). Levels: a line stays up while its
/// peripheral asks.
#[derive(Debug, Default)]
pub struct Interrupts {
    asserted: [Cell<u32>; 3],
    changed: Cell<bool>,
}

impl Interrupts {
    /// Sets the level of line `irq` (0 … 95).
    pub fn set(&self, irq: u16, asserted: bool) {
        let word = &self.asserted[usize::from(irq / 32)];
        let bit = 1 << (irq % 32);
        let new = if asserted {
            word.get() | bit
        } else {
            word.get() & !bit
        };
        if new != word.replace(new) {
            self.changed.set(true);
        }
    }

    /// Whether line `irq` is up.
    pub fn is_asserted(&self, irq: u16) -> bool {
        self.asserted[usize::from(irq / 32)].get() >> (irq % 32) & 1 != 0
    }

    /// Whether one of the lines changed since [`Interrupts::take_changed`].
    pub fn is_changed(&self) -> bool {
        self.changed.get()
    }

    /// All lines, if one of them changed since the last call.
    pub fn take_changed(&self) -> Option<[u32; 3]> {
        self.changed
            .replace(false)
            .then(|| std::array::from_fn(|word| self.asserted[word].get()))
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
