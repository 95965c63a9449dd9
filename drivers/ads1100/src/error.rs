//! What can go wrong.

use core::fmt;

use crate::settings::DataRate;

/// What the driver was doing on the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Operation {
    /// Writing the configuration register.
    WriteConfiguration,
    /// Reading the output and configuration registers.
    ReadOutput,
    /// The general call reset.
    GeneralCallReset,
}

/// An error of the driver; `E` is the bus's own error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum Error<E> {
    /// The bus reported an error. A conversion under way stays so and can be polled again.
    Bus {
        /// What the driver was doing.
        operation: Operation,
        /// The bus's own error.
        source: E,
    },
    /// The configuration register does not hold what was written: the chip was reset (0x8C) or browned out, the bus is
    /// stuck (0x00, 0xFF), or another device answers. The code read with it is not delivered, the conversion is void,
    /// and the result of the next one is discarded.
    ConfigurationLost {
        /// The byte written.
        expected: u8,
        /// The byte read; bit 7 is ST/BSY.
        read: u8,
    },
    /// The code lies outside the range of the data rate: the transfer was corrupted. The conversion is void.
    CodeOutOfRange {
        /// The code read.
        code: i16,
        /// The data rate whose range it exceeds.
        data_rate: DataRate,
    },
    /// No conversion is under way: `start` (or `start_continuous`) comes first, and each result is delivered once.
    NotStarted,
}

impl<E: fmt::Debug> fmt::Display for Error<E> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Bus { operation, source } => write!(f, "bus error in {operation:?}: {source:?}"),
            Self::ConfigurationLost { expected, read } => {
                write!(f, "configuration is {read:#04x}, expected {expected:#04x}")
            }
            Self::CodeOutOfRange { code, data_rate } => {
                write!(f, "code {code} is beyond {} bits", data_rate.bits())
            }
            Self::NotStarted => f.write_str("no conversion is under way"),
        }
    }
}

impl<E: fmt::Debug> core::error::Error for Error<E> {}
