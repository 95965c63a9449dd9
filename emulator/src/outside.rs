//! What the MCU sees of the world around it: pins, buses and voltages.

use plant::bus::SpiByte;

use crate::time::Ticks;

/// GPIO ports that the package has and the board uses: A, B, C.
pub const PORTS: usize = 3;

/// A pin: port 0 … 2 (A … C) and number 0 … 15.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Pin {
    /// 0 = A, 1 = B, 2 = C.
    pub port: u8,
    /// 0 … 15.
    pub number: u8,
}

impl Pin {
    /// Port by its letter, 'A' … 'C'.
    pub const fn new(port: char, number: u8) -> Self {
        Self {
            port: port as u8 - b'A',
            number,
        }
    }

    /// The pin's bit in its port's word.
    pub const fn bit(self) -> u16 {
        1 << self.number
    }
}

/// Levels that the outside drives; where it does not, the MCU's pull or the MCU itself decides.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DrivenLevels {
    /// One bit for each pin that the outside drives.
    pub driven: [u16; PORTS],
    /// Its level there.
    pub level: [u16; PORTS],
}

impl DrivenLevels {
    /// Drives `pin` to `level`, or lets go of it.
    pub fn set(&mut self, pin: Pin, level: Option<bool>) {
        let port = usize::from(pin.port);
        self.driven[port] =
            (self.driven[port] & !pin.bit()) | if level.is_some() { pin.bit() } else { 0 };
        self.level[port] =
            (self.level[port] & !pin.bit()) | if level == Some(true) { pin.bit() } else { 0 };
    }

    /// The level that the outside drives onto `pin`; `None` where it does not drive.
    pub fn driven(&self, pin: Pin) -> Option<bool> {
        let port = usize::from(pin.port);
        (self.driven[port] & pin.bit() != 0).then_some(self.level[port] & pin.bit() != 0)
    }
}

/// What the MCU drives as general-purpose outputs (alternate functions are not in here).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Outputs {
    /// Pins in output mode.
    pub enabled: [u16; PORTS],
    /// Their output data bits.
    pub level: [u16; PORTS],
    /// Of those, the open-drain ones: a 1 lets go of the line.
    pub open_drain: [u16; PORTS],
}

impl Outputs {
    /// The level that the MCU drives onto `pin`; `None` where it does not drive.
    pub const fn driven(&self, pin: Pin) -> Option<bool> {
        let port = pin.port as usize;
        if self.enabled[port] & pin.bit() == 0 {
            return None;
        }
        let high = self.level[port] & pin.bit() != 0;
        if high && self.open_drain[port] & pin.bit() != 0 {
            return None;
        }
        Some(high)
    }
}

/// The two SPI buses of the board.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SpiBus {
    /// SPI1: the meter.
    Meter,
    /// SPI2: the flash.
    Flash,
}

/// What an I²C master does on the bus. Each event is given at the time of its end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum I2cEvent {
    /// A start or repeated start.
    Start,
    /// The address byte: address in bits 7 … 1, read in bit 0.
    Address(u8),
    /// A data byte to the slave.
    Write(u8),
    /// A data byte from the slave; `ack` is what the master answers.
    Read {
        /// The master wants more.
        ack: bool,
    },
    /// A stop.
    Stop,
}

/// How the bus answers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum I2cAnswer {
    /// Start or stop done.
    Done,
    /// Acknowledged.
    Ack,
    /// Not acknowledged.
    Nack,
    /// The byte that the slave shifted out.
    Byte(u8),
    /// SDA was low where this master let go of it.
    ArbitrationLost,
    /// A start or stop at the wrong place.
    BusError,
    /// SCL or SDA does not rise: the event does not end.
    Stuck,
}

/// A character on the RS485 line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Character {
    /// Its data bits.
    pub byte: u8,
    /// Even parity was wrong.
    pub parity_error: bool,
    /// The stop bit was low.
    pub framing_error: bool,
    /// The samples of a bit differed.
    pub noise: bool,
}

impl Character {
    /// One without fault.
    pub const fn good(byte: u8) -> Self {
        Self {
            byte,
            parity_error: false,
            framing_error: false,
            noise: false,
        }
    }
}

/// The world around the MCU, as its peripherals reach it. `at` never decreases.
pub trait Outside {
    /// A byte was shifted on an SPI bus; the byte received.
    fn spi(&mut self, bus: SpiBus, byte: SpiByte) -> u8;
    /// An event on I²C1.
    fn i2c(&mut self, event: I2cEvent, at: Ticks) -> I2cAnswer;
    /// Whether the peripheral takes an event that has ended for a bus error though it was none. Asked once after each.
    fn i2c_spurious_bus_error(&mut self) -> bool {
        false
    }
    /// I²C1 was reset and lets go of the lines, `clocked` bits into a byte that it was receiving.
    fn i2c_abandoned(&mut self, _clocked: u8, _at: Ticks) {}
    /// Levels of SCL and SDA as seen by the MCU's pins, when it does not pull them itself.
    fn i2c_lines(&mut self, at: Ticks) -> (bool, bool);
    /// The voltage at ADC1's external input `channel` (0 … 15), in V.
    fn adc_v(&mut self, channel: u8, at: Ticks) -> f64;
    /// The MCU's general-purpose outputs changed.
    fn outputs_changed(&mut self, outputs: &Outputs, at: Ticks);
    /// USART2 sent a character, its stop bit ended at `at`.
    fn uart_sent(&mut self, byte: u8, at: Ticks);
    /// What the outside drives onto the pins now.
    fn levels(&mut self, at: Ticks) -> DrivenLevels;
}
