//! A small world around one peripheral, for the tests of the peripherals.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::collections::VecDeque;

use plant::bus::{I2cDevice, SpiByte};

use super::{Clocks, Context, Interrupts, Peripheral, Unmodelled};
use crate::i2c_bus::I2cBus;
use crate::outside::{DrivenLevels, I2cAnswer, I2cEvent, Outputs, Outside, SpiBus};
use crate::time::Ticks;

/// The clocks of the image.
pub const CLOCKS: Clocks = Clocks {
    ahb: 168_000_000,
    apb1: 42_000_000,
    apb2: 84_000_000,
    apb1_timers: 84_000_000,
};

/// A slave that acknowledges its address, keeps what is written and shifts out what it was given.
#[derive(Debug, Default)]
pub struct Slave {
    pub address: u8,
    pub written: Vec<u8>,
    pub to_read: VecDeque<u8>,
    /// Acknowledged at most.
    pub accepts: Option<usize>,
    pub stops: usize,
    pub addressed: Vec<u8>,
}

impl I2cDevice for Slave {
    fn address(&mut self, byte: u8, _: f64) -> bool {
        self.addressed.push(byte);
        byte >> 1 == self.address
    }
    fn write(&mut self, byte: u8, _: f64) -> bool {
        self.written.push(byte);
        self.accepts
            .is_none_or(|accepts| self.written.len() <= accepts)
    }
    fn read(&mut self, _: f64) -> u8 {
        self.to_read.pop_front().unwrap_or(0xFF)
    }
    fn stop(&mut self, _: f64) {
        self.stops += 1;
    }
}

/// What the peripheral did, and what it is answered.
pub struct World {
    pub spi: Vec<(SpiBus, SpiByte)>,
    pub spi_answers: VecDeque<u8>,
    pub uart: Vec<(u8, Ticks)>,
    pub bus: I2cBus,
    pub slave: Slave,
    pub i2c: Vec<(I2cEvent, Ticks)>,
    /// Answers that override the bus's.
    pub i2c_answers: VecDeque<I2cAnswer>,
}

impl Outside for World {
    fn spi(&mut self, bus: SpiBus, byte: SpiByte) -> u8 {
        self.spi.push((bus, byte));
        self.spi_answers.pop_front().unwrap_or(0xFF)
    }
    fn i2c(&mut self, event: I2cEvent, at: Ticks) -> I2cAnswer {
        let answer = match self.i2c_answers.pop_front() {
            Some(answer) => answer,
            None => self.bus.event(event, at, &mut self.slave),
        };
        if answer != I2cAnswer::Stuck {
            self.i2c.push((event, at));
        }
        answer
    }
    fn i2c_spurious_bus_error(&mut self) -> bool {
        self.bus.take_spurious_bus_error()
    }
    fn i2c_lines(&mut self, at: Ticks) -> (bool, bool) {
        self.bus.lines(at)
    }
    fn adc_v(&mut self, _: u8, _: Ticks) -> f64 {
        0.0
    }
    fn outputs_changed(&mut self, _: &Outputs, _: Ticks) {}
    fn uart_sent(&mut self, byte: u8, at: Ticks) {
        self.uart.push((byte, at));
    }
    fn levels(&mut self, _: Ticks) -> DrivenLevels {
        DrivenLevels::default()
    }
}

/// A peripheral and its world.
pub struct Bench<P> {
    pub peripheral: P,
    pub world: World,
    pub interrupts: Interrupts,
    pub clocks: Clocks,
    pub now: Ticks,
}

impl<P: Peripheral> Bench<P> {
    pub fn new(peripheral: P) -> Self {
        Self {
            peripheral,
            world: World {
                spi: Vec::new(),
                spi_answers: VecDeque::new(),
                uart: Vec::new(),
                bus: I2cBus::new(),
                slave: Slave {
                    address: 0x48,
                    ..Slave::default()
                },
                i2c: Vec::new(),
                i2c_answers: VecDeque::new(),
            },
            interrupts: Interrupts::default(),
            clocks: CLOCKS,
            now: Ticks(0),
        }
    }

    pub fn with<R>(&mut self, call: impl FnOnce(&mut P, &mut Context<'_>) -> R) -> R {
        let mut context = Context {
            now: self.now,
            clocks: self.clocks,
            interrupts: &self.interrupts,
            outside: &mut self.world,
        };
        call(&mut self.peripheral, &mut context)
    }

    pub fn try_read(&mut self, offset: u32) -> Result<u32, Unmodelled> {
        self.with(|peripheral, context| peripheral.read(offset, 2, context))
    }

    pub fn try_write(&mut self, offset: u32, value: u32) -> Result<(), Unmodelled> {
        self.with(|peripheral, context| peripheral.write(offset, 2, value, context))
    }

    pub fn read(&mut self, offset: u32) -> u32 {
        self.try_read(offset).unwrap()
    }

    pub fn write(&mut self, offset: u32, value: u32) {
        self.try_write(offset, value).unwrap();
    }

    /// Lets time pass, event by event, as the emulator does.
    pub fn run(&mut self, length: Ticks) {
        let end = self.now + length;
        while let Some(event) = self.peripheral.next_event().filter(|at| *at <= end) {
            self.now = self.now.max(event);
            self.with(|peripheral, context| peripheral.advance(context));
        }
        self.now = end;
    }

    /// Polls every `step` until `done`; fails after a millisecond.
    pub fn poll(&mut self, offset: u32, step: Ticks, done: impl Fn(u32) -> bool) -> u32 {
        let limit = self.now + Ticks::from_millis(1);
        loop {
            let value = self.read(offset);
            if done(value) {
                return value;
            }
            assert!(self.now < limit, "offset {offset:#x} stays {value:#06x}");
            self.run(step);
        }
    }
}
