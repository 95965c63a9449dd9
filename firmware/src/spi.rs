//! SPI master with bounded polling, as an embedded-hal device of its own bus.
//!
//! The HAL's SPI polls its flags without a bound. A master that makes its own clock cannot be held up from outside,
//! but a peripheral that lost its clock or its mode would hang the task; here it is an error after [`BYTE_LIMIT_US`].

use core::ops::Deref;

use embedded_hal::{
    digital::OutputPin,
    spi::{ErrorKind, ErrorType, Operation, SpiDevice},
};
use stm32f4xx_hal::pac::spi1;

use crate::time;

/// Far above one byte: 3.0 µs at 2.6 MHz.
const BYTE_LIMIT_US: u32 = 50;

/// Clock polarity and phase, and the divider of the peripheral's clock.
#[derive(Clone, Copy)]
pub struct Settings {
    /// Sample on the second edge (mode 1) instead of the first (mode 0).
    pub second_edge: bool,
    /// The clock is divided by 2^(n+1).
    pub baud: u8,
}

/// What can go wrong on a bus that has no handshake.
#[derive(Clone, Copy, Debug, PartialEq, Eq, defmt::Format)]
pub enum Error {
    /// A byte was not shifted in time: the peripheral does not run.
    Timeout,
    /// A received byte was overwritten.
    Overrun,
}

impl embedded_hal::spi::Error for Error {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Timeout => ErrorKind::Other,
            Self::Overrun => ErrorKind::Overrun,
        }
    }
}

/// The only device on a bus.
pub struct Device<SPI, CS> {
    spi: SPI,
    select: CS,
}

impl<SPI, CS> Device<SPI, CS>
where
    SPI: Deref<Target = spi1::RegisterBlock>,
    CS: OutputPin,
{
    /// Takes the peripheral, whose clock is on, and the chip select, which is high.
    pub fn new(spi: SPI, select: CS, settings: Settings) -> Self {
        spi.cr1().write(|w| {
            w.cpha().bit(settings.second_edge);
            w.br().set(settings.baud);
            // Software slave management with the select held high: the pin is a plain output.
            w.ssm().set_bit();
            w.ssi().set_bit();
            w.mstr().set_bit();
            w.spe().set_bit()
        });
        Self { spi, select }
    }
}

fn byte(spi: &spi1::RegisterBlock, out: u8) -> Result<u8, Error> {
    spi.dr().write(|w| w.dr().set(u16::from(out)));
    if !time::wait_until(BYTE_LIMIT_US, || spi.sr().read().rxne().bit_is_set()) {
        return Err(Error::Timeout);
    }
    let status = spi.sr().read();
    let [received, _] = spi.dr().read().dr().bits().to_le_bytes();
    if status.ovr().bit_is_set() {
        return Err(Error::Overrun);
    }
    Ok(received)
}

fn carry_out(spi: &spi1::RegisterBlock, operation: &mut Operation<'_, u8>) -> Result<(), Error> {
    match operation {
        Operation::Read(bytes) => {
            for received in bytes.iter_mut() {
                *received = byte(spi, 0)?;
            }
        }
        Operation::Write(bytes) => {
            for sent in bytes.iter() {
                byte(spi, *sent)?;
            }
        }
        Operation::Transfer(read, write) => {
            let length = read.len().max(write.len());
            for index in 0..length {
                let received = byte(spi, write.get(index).copied().unwrap_or(0))?;
                if let Some(place) = read.get_mut(index) {
                    *place = received;
                }
            }
        }
        Operation::TransferInPlace(bytes) => {
            for place in bytes.iter_mut() {
                *place = byte(spi, *place)?;
            }
        }
        Operation::DelayNs(ns) => time::delay_us(ns.div_ceil(1_000)),
    }
    Ok(())
}

/// All of a transaction but the chip select; once in the image for both buses.
#[inline(never)]
fn carry_out_all(
    spi: &spi1::RegisterBlock,
    operations: &mut [Operation<'_, u8>],
) -> Result<(), Error> {
    let mut result = operations
        .iter_mut()
        .try_for_each(|operation| carry_out(spi, operation));
    if !time::wait_until(BYTE_LIMIT_US, || spi.sr().read().bsy().bit_is_clear()) {
        result = result.and(Err(Error::Timeout));
    }
    result
}

impl<SPI, CS> ErrorType for Device<SPI, CS> {
    type Error = Error;
}

impl<SPI, CS> SpiDevice for Device<SPI, CS>
where
    SPI: Deref<Target = spi1::RegisterBlock>,
    CS: OutputPin,
{
    fn transaction(&mut self, operations: &mut [Operation<'_, u8>]) -> Result<(), Error> {
        // The pin is a GPIO output, which cannot fail.
        let _ = self.select.set_low();
        let result = carry_out_all(&self.spi, operations);
        let _ = self.select.set_high();
        if result.is_err() {
            // A byte left over must not be taken for the next one's answer.
            let _ = self.spi.dr().read();
            let _ = self.spi.sr().read();
        }
        result
    }
}
