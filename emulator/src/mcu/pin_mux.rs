//! Which of a peripheral's signals reach the board's pins (RM0090, 8.3.2, I/O pin multiplexer and mapping).
//!
//! On silicon a signal whose pin is set up for something else goes nowhere, and what a peripheral's input sees then is not
//! documented. Here such a transfer is an error where it begins. Not looked for: a second pin with the same function.

use super::Unmodelled;
use super::gpio::{GpioPorts, Mode};
use super::word::unmodelled;
use crate::board::pins;
use crate::outside::Pin;

/// A peripheral's signal at the pin where the board has it, and how that has to be set up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Signal {
    name: &'static str,
    /// Where.
    pub pin: Pin,
    mode: Mode,
    /// Its number, in alternate mode.
    function: u8,
    /// `None`: an input, whose output type does not matter.
    open_drain: Option<bool>,
}

impl Signal {
    const fn input(name: &'static str, pin: Pin, function: u8) -> Self {
        Self {
            name,
            pin,
            mode: Mode::Alternate,
            function,
            open_drain: None,
        }
    }

    const fn push_pull(name: &'static str, pin: Pin, function: u8) -> Self {
        Self {
            open_drain: Some(false),
            ..Self::input(name, pin, function)
        }
    }

    const fn open_drain(name: &'static str, pin: Pin, function: u8) -> Self {
        Self {
            open_drain: Some(true),
            ..Self::input(name, pin, function)
        }
    }

    const fn analog(name: &'static str, pin: Pin) -> Self {
        Self {
            mode: Mode::Analog,
            ..Self::input(name, pin, 0)
        }
    }

    /// Whether its pin carries it.
    ///
    /// # Errors
    /// [`Unmodelled`] with the register that keeps it from its pin, what that says and what it should say.
    pub fn check(&self, gpio: &GpioPorts) -> Result<(), Unmodelled> {
        let Pin { port, number } = self.pin;
        let port = char::from(b'A' + port);
        let refuse = |register: &str, found: &str, expected: &str| {
            let name = self.name;
            Err(unmodelled(
                format!("GPIO{port}_{register}"),
                format!("{name} on P{port}{number} as {found} in place of {expected}"),
            ))
        };
        let mode = gpio.mode(self.pin);
        if mode != self.mode {
            return refuse("MODER", mode.name(), self.mode.name());
        }
        if let Some(found) = gpio.alternate(self.pin)
            && found != self.function
        {
            return refuse(
                if number < 8 { "AFRL" } else { "AFRH" },
                &format!("alternate function {found}"),
                &self.function.to_string(),
            );
        }
        match (gpio.is_open_drain(self.pin), self.open_drain) {
            (true, Some(false)) => refuse("OTYPER", "open drain", "push-pull"),
            (false, Some(true)) => refuse("OTYPER", "push-pull", "open drain"),
            _ => Ok(()),
        }
    }
}

// STM32F405 data sheet (DS8626): table 9, alternate function mapping; ADC1's channels by table 7, pin and ball definitions.

/// SCK, MISO and MOSI of SPI1.
pub const SPI1: [Signal; 3] = [
    Signal::push_pull("SPI1_SCK", Pin::new('A', 5), 5),
    Signal::input("SPI1_MISO", pins::METER_MISO, 5),
    Signal::push_pull("SPI1_MOSI", Pin::new('A', 7), 5),
];
/// SCK, MISO and MOSI of SPI2.
pub const SPI2: [Signal; 3] = [
    Signal::push_pull("SPI2_SCK", Pin::new('B', 13), 5),
    Signal::input("SPI2_MISO", Pin::new('B', 14), 5),
    Signal::push_pull("SPI2_MOSI", Pin::new('B', 15), 5),
];
/// SCL and SDA of I2C1.
pub const I2C1: [Signal; 2] = [
    Signal::open_drain("I2C1_SCL", pins::I2C_CLOCK, 4),
    Signal::open_drain("I2C1_SDA", pins::I2C_DATA, 4),
];
/// TX of USART2.
pub const USART2_TX: Signal = Signal::push_pull("USART2_TX", Pin::new('A', 2), 7);
/// RX of USART2.
pub const USART2_RX: Signal = Signal::input("USART2_RX", Pin::new('A', 3), 7);
/// RX of CAN1.
pub const CAN1_RX: Signal = Signal::input("CAN1_RX", Pin::new('A', 11), 9);
/// TX of CAN1.
pub const CAN1_TX: Signal = Signal::push_pull("CAN1_TX", Pin::new('A', 12), 9);
/// Channel 1 of TIM4.
pub const TIM4_CH1: Signal = Signal::input("TIM4_CH1", pins::RANGE_GATE, 2);
/// The external channel of ADC1 that is connected on this board.
pub const fn adc1_input(channel: u8) -> Option<Signal> {
    match channel {
        10 => Some(Signal::analog("ADC1_IN10", Pin::new('C', 0))),
        11 => Some(Signal::analog("ADC1_IN11", Pin::new('C', 1))),
        _ => None,
    }
}
