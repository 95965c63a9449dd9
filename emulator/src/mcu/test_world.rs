//! A world for the unit tests of peripherals: levels and voltages that a test sets.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use plant::bus::SpiByte;

use super::{Clocks, Context, Interrupts, Peripheral};
use crate::outside::{DrivenLevels, I2cAnswer, I2cEvent, Outputs, Outside, SpiBus};
use crate::time::Ticks;

/// The clocks of the image.
pub const CLOCKS: Clocks = Clocks {
    ahb: 168_000_000,
    apb1: 42_000_000,
    apb2: 84_000_000,
    apb1_timers: 84_000_000,
};

/// A voltage at a channel, in V, as a function of time.
pub type Voltage = fn(u8, Ticks) -> f64;

/// Pins and voltages only.
#[derive(Default)]
pub struct Pins {
    pub levels: DrivenLevels,
    /// At every external channel.
    pub adc_v: Option<Voltage>,
    /// When which channel was sampled.
    pub sampled: Vec<(u8, Ticks)>,
}

impl Outside for Pins {
    fn spi(&mut self, _: SpiBus, _: SpiByte) -> u8 {
        panic!("no SPI here")
    }
    fn i2c(&mut self, _: I2cEvent, _: Ticks) -> I2cAnswer {
        panic!("no I2C here")
    }
    fn i2c_lines(&mut self, _: Ticks) -> (bool, bool) {
        (true, true)
    }
    fn adc_v(&mut self, channel: u8, at: Ticks) -> f64 {
        self.sampled.push((channel, at));
        self.adc_v.map_or(0.0, |voltage| voltage(channel, at))
    }
    fn outputs_changed(&mut self, _: &Outputs, _: Ticks) {}
    fn uart_sent(&mut self, _: u8, _: Ticks) {}
    fn levels(&mut self, _: Ticks) -> DrivenLevels {
        self.levels
    }
}

/// Everything that a peripheral is called with.
pub struct World {
    pub now: Ticks,
    pub clocks: Clocks,
    pub interrupts: Interrupts,
    pub pins: Pins,
}

impl Default for World {
    fn default() -> Self {
        Self {
            now: Ticks(0),
            clocks: CLOCKS,
            interrupts: Interrupts::default(),
            pins: Pins::default(),
        }
    }
}

impl World {
    pub fn context(&mut self) -> Context<'_> {
        Context {
            now: self.now,
            clocks: self.clocks,
            interrupts: &self.interrupts,
            outside: &mut self.pins,
        }
    }

    pub fn read(&mut self, peripheral: &mut impl Peripheral, offset: u32) -> u32 {
        peripheral.read(offset, 4, &mut self.context()).unwrap()
    }

    pub fn write(&mut self, peripheral: &mut impl Peripheral, offset: u32, value: u32) {
        peripheral
            .write(offset, 4, value, &mut self.context())
            .unwrap();
    }

    /// Whether the write is refused.
    pub fn refuses(&mut self, peripheral: &mut impl Peripheral, offset: u32, value: u32) -> bool {
        peripheral
            .write(offset, 4, value, &mut self.context())
            .is_err()
    }

    /// Time goes on, with every event of `peripheral` at its moment.
    pub fn run_until(&mut self, peripheral: &mut impl Peripheral, end: Ticks) {
        while let Some(event) = peripheral.next_event().filter(|event| *event <= end) {
            self.now = self.now.max(event);
            peripheral.advance(&mut self.context());
            assert!(
                peripheral.next_event() != Some(event),
                "an event that stays due would hang the bus"
            );
        }
        self.now = end;
    }
}
