//! I²C master with bounded waits and bus recovery.
//!
//! The HAL's blocking I²C waits for ever on a stuck bus. Here every transaction ends within [`TRANSACTION_LIMIT_US`]:
//! three bytes with their address take 93 µs at 400 kHz. Its task has the lowest priority, so the limit also holds what
//! the others take meanwhile: a tick of 0.3 ms, and a meter that is set up, 0.6 ms.

use embedded_hal::i2c::{
    ErrorKind, ErrorType, I2c, NoAcknowledgeSource, Operation, SevenBitAddress,
};
use stm32f4xx_hal::{
    gpio::{Alternate, OpenDrain, PB8, PB9, PinState},
    pac::{I2C1, RCC},
    rcc::{Enable, Reset},
};

use crate::time;

/// The longest that one transaction may take.
const TRANSACTION_LIMIT_US: u32 = 1_500;
/// Half a clock of the recovery: 100 kHz, which every slave can follow.
const RECOVERY_HALF_CLOCK_US: u32 = 4;
/// A slave holds SDA for at most eight bits in a row and the acknowledge.
const RECOVERY_CLOCKS: u8 = 9;

/// APB1, which clocks the peripheral.
const PERIPHERAL_CLOCK_MHZ: u8 = 42;
/// 400 kHz with a low to high ratio of 2: 42 MHz / (3 · 35).
const FAST_MODE_DIVIDER: u16 = 35;
/// Rise time of at most 300 ns in clocks, plus one (RM0090, I2C_TRISE).
const RISE_TIME: u8 = 13;

/// Why a transaction failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, defmt::Format)]
pub enum Error {
    /// The address was not acknowledged.
    NoAddressAcknowledge,
    /// A data byte was not acknowledged.
    NoDataAcknowledge,
    /// A failed acknowledge where none is asked for.
    Bus,
    /// Another master, or a line that does not follow.
    ArbitrationLost,
    /// A line stayed low or the peripheral did not answer in time.
    Timeout,
    /// Adjacent operations of one direction, or an empty one: nothing on this bus needs them.
    Unsupported,
}

impl embedded_hal::i2c::Error for Error {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::NoAddressAcknowledge => ErrorKind::NoAcknowledge(NoAcknowledgeSource::Address),
            Self::NoDataAcknowledge => ErrorKind::NoAcknowledge(NoAcknowledgeSource::Data),
            Self::Bus => ErrorKind::Bus,
            Self::ArbitrationLost => ErrorKind::ArbitrationLoss,
            Self::Timeout | Self::Unsupported => ErrorKind::Other,
        }
    }
}

/// I²C1 with its pins.
pub struct Bus {
    i2c: I2C1,
    clock: PB8<Alternate<4, OpenDrain>>,
    data: PB9<Alternate<4, OpenDrain>>,
    /// When the transaction under way began.
    started: u32,
}

impl Bus {
    /// Takes the peripheral and its pins.
    pub fn new(
        i2c: I2C1,
        clock: PB8<Alternate<4, OpenDrain>>,
        data: PB9<Alternate<4, OpenDrain>>,
        rcc: &mut RCC,
    ) -> Self {
        I2C1::enable(rcc);
        I2C1::reset(rcc);
        let bus = Self {
            i2c,
            clock,
            data,
            started: 0,
        };
        bus.configure();
        bus
    }

    fn configure(&self) {
        // A peripheral that took a glitch for a start believes the bus busy until it is reset.
        self.i2c.cr1().write(|w| w.swrst().set_bit());
        self.i2c.cr1().reset();
        // SAFETY: 42 MHz, within the 2 … 50 that the field takes.
        self.i2c
            .cr2()
            .write(|w| unsafe { w.freq().bits(PERIPHERAL_CLOCK_MHZ) });
        // SAFETY: 35, within the 1 … 4095 that the field takes.
        self.i2c.ccr().write(|w| unsafe {
            w.f_s().set_bit();
            w.ccr().bits(FAST_MODE_DIVIDER)
        });
        self.i2c.trise().write(|w| w.trise().set(RISE_TIME));
        self.i2c.cr1().write(|w| w.pe().set_bit());
    }

    /// Frees a slave that is in the middle of a byte: up to nine clocks, each with a stop in it, the peripheral reset. 0.1 ms.
    ///
    /// Each clock brings the slave's next bit. One that is 1 leaves SDA to the master, and a stop in that same clock ends the
    /// transfer; after a clock more the next bit may hold SDA again. No clock is made beyond the first stop, and in none SDA stays high:
    /// a slave that was being written to takes nothing for a byte.
    ///
    /// # Errors
    /// [`Error::Timeout`] if a line is still low afterwards: a short or a slave without end.
    pub fn recover(&mut self) -> Result<(), Error> {
        let Self { clock, data, .. } = self;
        let free = clock.with_open_drain_output_in_state(PinState::High, |clock| {
            data.with_open_drain_output_in_state(PinState::High, |data| {
                (0..RECOVERY_CLOCKS).any(|_| {
                    clock.set_low();
                    data.set_low();
                    time::delay_us(RECOVERY_HALF_CLOCK_US);
                    clock.set_high();
                    time::delay_us(RECOVERY_HALF_CLOCK_US);
                    // Where the slave lets it, SDA rises while SCL is high: a stop.
                    data.set_high();
                    time::delay_us(RECOVERY_HALF_CLOCK_US);
                    clock.is_high() && data.is_high()
                })
            })
        });
        self.configure();
        if free { Ok(()) } else { Err(Error::Timeout) }
    }

    fn expired(&self) -> bool {
        time::micros().wrapping_sub(self.started) > TRANSACTION_LIMIT_US
    }

    /// Polls until `done` of SR1 or an error flag or the transaction's end of time.
    fn wait(&self, acknowledged: Error, done: impl Fn(u16) -> bool) -> Result<(), Error> {
        loop {
            // Asked first: a flag that came during a preemption beyond the limit counts.
            let expired = self.expired();
            let status = self.i2c.sr1().read();
            if status.af().bit_is_set() {
                return Err(acknowledged);
            }
            if status.arlo().bit_is_set() {
                return Err(Error::ArbitrationLost);
            }
            if status.berr().bit_is_set() {
                // A master may see one where nothing is wrong, and the transfer goes on (errata ES0182, spurious bus error detection in
                // master mode): cleared, and no more. After a real one nothing more comes, and the time ends.
                self.i2c.sr1().write(|w| {
                    // SAFETY: the other errors are cleared by writing 0, which 1 leaves; the flags ignore it.
                    unsafe { w.bits(ERRORS & !BERR) }
                });
            }
            if done(status.bits()) {
                return Ok(());
            }
            if expired {
                return Err(Error::Timeout);
            }
        }
    }

    fn start(&self, address: SevenBitAddress, read: bool) -> Result<(), Error> {
        // POS is cleared here and not at the end of a read: then STOP may still be set, and while it is CR1 must not be
        // written (RM0090, I2C_CR1): read before the hardware clears it and written after, STOP would be asked for again.
        self.i2c.cr1().modify(|_, w| {
            w.start().set_bit();
            w.ack().set_bit();
            w.pos().clear_bit()
        });
        self.wait(Error::Bus, |status| status & SB != 0)?;
        let byte = address << 1 | u8::from(read);
        self.i2c.dr().write(|w| w.dr().set(byte));
        self.wait(Error::NoAddressAcknowledge, |status| status & ADDR != 0)
    }

    /// Reading SR2 after SR1 ends the address phase.
    fn clear_address(&self) {
        let _ = self.i2c.sr2().read();
    }

    fn stop(&self) {
        self.i2c.cr1().modify(|_, w| w.stop().set_bit());
    }

    fn write_bytes(&self, address: SevenBitAddress, bytes: &[u8]) -> Result<(), Error> {
        self.start(address, false)?;
        self.clear_address();
        for byte in bytes {
            self.wait(Error::NoDataAcknowledge, |status| status & TXE != 0)?;
            self.i2c.dr().write(|w| w.dr().set(*byte));
        }
        self.wait(Error::NoDataAcknowledge, |status| status & BTF != 0)
    }

    /// RM0090, closing the communication: the last bytes are fetched in steps that the held clock makes safe against
    /// preemption. `last`: a stop follows, else a repeated start.
    fn read_bytes(
        &self,
        address: SevenBitAddress,
        bytes: &mut [u8],
        last: bool,
    ) -> Result<(), Error> {
        let length = bytes.len();
        self.start(address, true)?;
        match length {
            1 => {
                self.i2c.cr1().modify(|_, w| w.ack().clear_bit());
                // The stop has to be asked for while the only byte is under way.
                cortex_m::interrupt::free(|_| {
                    self.clear_address();
                    if last {
                        self.stop();
                    }
                });
            }
            2 => {
                self.i2c.cr1().modify(|_, w| w.pos().set_bit());
                cortex_m::interrupt::free(|_| {
                    self.clear_address();
                    self.i2c.cr1().modify(|_, w| w.ack().clear_bit());
                });
            }
            _ => self.clear_address(),
        }
        for (index, byte) in bytes.iter_mut().enumerate() {
            let left = length - index;
            match left {
                // Three left: two are held in the peripheral, the third is not acknowledged.
                3 => {
                    self.wait(Error::Bus, |status| status & BTF != 0)?;
                    self.i2c.cr1().modify(|_, w| w.ack().clear_bit());
                }
                // Both last ones are held, and the clock with them, so that nothing hurries.
                2 => {
                    self.wait(Error::Bus, |status| status & BTF != 0)?;
                    if last {
                        self.stop();
                    }
                }
                _ => self.wait(Error::Bus, |status| status & RXNE != 0)?,
            }
            *byte = self.i2c.dr().read().dr().bits();
        }
        Ok(())
    }

    fn operations(
        &mut self,
        address: SevenBitAddress,
        operations: &mut [Operation<'_>],
    ) -> Result<(), Error> {
        self.started = time::micros();
        while self.i2c.sr2().read().busy().bit_is_set() {
            if self.expired() {
                return Err(Error::Timeout);
            }
        }
        let mut left = operations.len();
        let mut previous_read = None;
        for operation in operations {
            left -= 1;
            let read = matches!(operation, Operation::Read(_));
            if previous_read == Some(read) {
                return Err(Error::Unsupported);
            }
            previous_read = Some(read);
            match operation {
                Operation::Read([]) | Operation::Write([]) => return Err(Error::Unsupported),
                Operation::Read(bytes) => self.read_bytes(address, bytes, left == 0)?,
                Operation::Write(bytes) => {
                    self.write_bytes(address, bytes)?;
                    if left == 0 {
                        self.stop();
                    }
                }
            }
        }
        Ok(())
    }
}

/// SR1: start sent.
const SB: u16 = 1 << 0;
/// SR1: address acknowledged.
const ADDR: u16 = 1 << 1;
/// SR1: byte transfer finished.
const BTF: u16 = 1 << 2;
/// SR1: a byte was received.
const RXNE: u16 = 1 << 6;
/// SR1: the next byte may be written.
const TXE: u16 = 1 << 7;
/// SR1: start or stop at the wrong place.
const BERR: u16 = 1 << 8;
/// SR1: BERR, ARLO, AF, OVR, PECERR, TIMEOUT and SMBALERT.
const ERRORS: u16 = 0xDF00;

impl ErrorType for Bus {
    type Error = Error;
}

impl I2c for Bus {
    fn transaction(
        &mut self,
        address: SevenBitAddress,
        operations: &mut [Operation<'_>],
    ) -> Result<(), Error> {
        let result = self.operations(address, operations);
        if result.is_err() {
            self.stop();
            // AF, ARLO and BERR are cleared by writing 0; the other bits of SR1 ignore it.
            self.i2c.sr1().write(|w| w);
        }
        result
    }
}
