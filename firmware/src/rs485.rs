//! RS485 on USART2, 115,200 baud 8E1, half duplex with a driver enable.
//!
//! The interrupt only moves characters; frames and answers are `core_logic::modbus_rtu`'s, at priority 1. A character
//! takes 95 µs, less than the meter's owner may take at priority 3, so the interrupt runs at 4, below the range edge alone.
//! docs/firmware.md has the bound on its wait.

use core_logic::{
    design_parameters::RS485_BAUD,
    modbus_rtu::{LineErrors, MAX_FRAME},
    units::{Duration, Instant},
};
use heapless::{Vec, spsc};
use stm32f4xx_hal::{
    gpio::{Output, PA1},
    pac::{RCC, USART2},
    rcc::{Enable, Reset},
};

use crate::time;

/// Characters between interrupt and task: 6 ms of them.
pub const QUEUE_LENGTH: usize = 64;
/// The task is woken by the first character after a pause of this length, and then looks by itself when the frame may
/// have ended. (Not by the idle interrupt: clearing its flag reads the data register and could swallow a character.)
const PAUSE_US: u32 = 1_000;
/// It is woken as well after this many characters.
const WAKE_EVERY: u8 = 16;

const PERIPHERAL_CLOCK: u32 = 42_000_000;

/// A character as it came from the line.
#[derive(Clone, Copy)]
pub struct Character {
    byte: u8,
    errors: LineErrors,
    /// End of the character, microseconds modulo 2³².
    at: u32,
}

impl Character {
    /// The byte, what was wrong with it and when it ended.
    pub fn unpack(self) -> (u8, LineErrors, Instant) {
        let now = time::now();
        // Of the same moment: with a second look at the counter a preemption between them would make it older.
        let [a, b, c, d, ..] = now.as_ticks().to_le_bytes();
        let age = u32::from_le_bytes([a, b, c, d]).wrapping_sub(self.at);
        let at = now
            .checked_sub_duration(Duration::from_ticks(u64::from(age)))
            .unwrap_or(now);
        (self.byte, self.errors, at)
    }
}

/// The port, owned by its interrupt; [`Port::send`] is called by the task under the resource's lock.
pub struct Port {
    usart: USART2,
    driver_enable: PA1<Output>,
    frame: Vec<u8, MAX_FRAME>,
    sent: usize,
    since_wake: u8,
    /// End of the last character.
    last_at: u32,
    /// Characters lost because the task did not fetch them in time.
    lost: bool,
}

impl Port {
    /// Takes the peripheral; its pins are connected to it already, and the driver is off.
    pub fn new(usart: USART2, driver_enable: PA1<Output>, rcc: &mut RCC) -> Self {
        USART2::enable(rcc);
        USART2::reset(rcc);
        // Sixteen samples a bit: the divider in sixteenths is the clock over the baud rate, 364.58 → 365 (−0.1 %).
        const DIVIDER: u16 = ((PERIPHERAL_CLOCK + RS485_BAUD / 2) / RS485_BAUD) as u16;
        // SAFETY: any 16 bits are a divider.
        usart.brr().write(|w| unsafe { w.bits(DIVIDER) });
        let port = Self {
            usart,
            driver_enable,
            frame: Vec::new(),
            sent: 0,
            since_wake: 0,
            last_at: 0,
            lost: false,
        };
        port.listen();
        port
    }

    /// Receiver on; parity takes the ninth bit of the word.
    fn listen(&self) {
        self.usart.cr1().write(|w| {
            w.ue().set_bit();
            w.m().set_bit();
            w.pce().set_bit();
            w.ps().clear_bit();
            w.te().set_bit();
            w.re().set_bit();
            w.rxneie().set_bit()
        });
    }

    /// Sends a frame. The receiver is off meanwhile: the line would give the frame back.
    pub fn send(&mut self, frame: &[u8]) {
        if self.sending() {
            return;
        }
        self.frame.clear();
        // A frame fits: it comes from a buffer of the same length.
        let _ = self.frame.extend_from_slice(frame);
        self.sent = 0;
        self.driver_enable.set_high();
        self.usart.cr1().write(|w| {
            w.ue().set_bit();
            w.m().set_bit();
            w.pce().set_bit();
            w.te().set_bit();
            w.txeie().set_bit()
        });
    }

    /// Whether a frame is on its way.
    pub fn sending(&self) -> bool {
        self.driver_enable.is_set_high()
    }

    /// The interrupt. Whether the task has something to do.
    pub fn on_interrupt(&mut self, received: &mut spsc::Producer<'static, Character>) -> bool {
        let status = self.usart.sr().read();
        if self.sending() {
            self.on_transmit(status.txe().bit_is_set(), status.tc().bit_is_set());
            return false;
        }
        if status.rxne().bit_is_clear() && status.ore().bit_is_clear() {
            return false;
        }
        // Reading the data register after the status clears every flag of reception.
        let [byte, _] = self.usart.dr().read().dr().bits().to_le_bytes();
        let at = time::micros();
        let errors = LineErrors {
            parity: status.pe().bit_is_set(),
            framing: status.fe().bit_is_set(),
            noise: status.nf().bit_is_set(),
            overrun: status.ore().bit_is_set() || self.lost,
        };
        self.lost = received.enqueue(Character { byte, errors, at }).is_err();
        let after_pause = at.wrapping_sub(core::mem::replace(&mut self.last_at, at)) > PAUSE_US;
        self.since_wake += 1;
        let wake = after_pause || self.since_wake >= WAKE_EVERY;
        if wake {
            self.since_wake = 0;
        }
        wake
    }

    fn on_transmit(&mut self, empty: bool, complete: bool) {
        if let Some(byte) = self.frame.get(self.sent) {
            if empty {
                self.usart.dr().write(|w| w.dr().set(u16::from(*byte)));
                self.sent += 1;
                if self.sent == self.frame.len() {
                    self.usart.cr1().modify(|_, w| {
                        w.txeie().clear_bit();
                        w.tcie().set_bit()
                    });
                }
            }
        } else if complete {
            // The last stop bit is out: the line is the client's again.
            self.driver_enable.set_low();
            self.listen();
        }
    }
}
