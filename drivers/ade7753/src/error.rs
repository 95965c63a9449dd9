//! What can go wrong.

use core::fmt;

use crate::registers::RegisterId;

/// The level at which a data line appears to be stuck.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum StuckLevel {
    /// Every bit reads 0: MISO shorted to ground, the chip unpowered or its clock stopped.
    Low,
    /// Every bit reads 1: MISO open with a pull-up, or shorted to the supply.
    High,
}

/// An error of the driver; `E` is the bus's own error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum Error<E> {
    /// The bus reported an error during a transfer with this register. It is not retried here.
    Bus {
        /// The register of the failed transfer ([`RegisterId::Chksum`] if the data had already arrived).
        register: RegisterId,
        /// The bus's own error.
        source: E,
    },
    /// CHKSUM disagreed with the data in every permitted attempt.
    Checksum {
        /// The register that was read.
        register: RegisterId,
        /// The bits received in the last attempt.
        read: u32,
        /// The number of ones in `read`.
        expected: u8,
        /// The CHKSUM byte received.
        got: u8,
    },
    /// A written register did not read back as written in every permitted attempt.
    Verify {
        /// The register that was written.
        register: RegisterId,
        /// The bits written.
        written: u32,
        /// The bits read back in the last attempt.
        read: u32,
    },
    /// A correctly transferred register holds a code that the datasheet reserves.
    ReservedCode {
        /// The register that was read.
        register: RegisterId,
        /// The bits read.
        read: u32,
    },
    /// The value does not fit the register, or asks for what has its own method (software reset). Nothing was sent.
    ValueOutOfRange {
        /// The register that was to be written.
        register: RegisterId,
    },
    /// The data line is stuck.
    DeadBus {
        /// The register whose read showed it.
        register: RegisterId,
        /// The level of the line.
        level: StuckLevel,
    },
    /// The chip has been reset since it was configured: MODE is back at its default. Configure it again.
    Reset,
    /// A register no longer holds what was configured.
    Configuration {
        /// The register.
        register: RegisterId,
        /// The bits it should hold.
        expected: u32,
        /// The bits it holds.
        read: u32,
    },
    /// The operation needs a successful `configure` first.
    NotConfigured,
    /// The offset test being finished has been ended by `configure`, `software_reset` or an earlier error.
    OffsetTestAborted,
}

impl<E: fmt::Debug> fmt::Display for Error<E> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Bus { register, source } => write!(f, "bus error at {register}: {source:?}"),
            Self::Checksum {
                register,
                read,
                expected,
                got,
            } => write!(
                f,
                "{register} read as {read:#x} has {expected} ones, CHKSUM says {got}"
            ),
            Self::Verify {
                register,
                written,
                read,
            } => {
                write!(
                    f,
                    "{register} written as {written:#x} reads back as {read:#x}"
                )
            }
            Self::ReservedCode { register, read } => {
                write!(f, "{register} holds the reserved code {read:#x}")
            }
            Self::ValueOutOfRange { register } => write!(f, "value does not fit {register}"),
            Self::DeadBus {
                register,
                level: StuckLevel::Low,
            } => {
                write!(f, "data line stuck low (seen at {register})")
            }
            Self::DeadBus {
                register,
                level: StuckLevel::High,
            } => {
                write!(f, "data line stuck high (seen at {register})")
            }
            Self::Reset => f.write_str("the chip has been reset"),
            Self::Configuration {
                register,
                expected,
                read,
            } => {
                write!(f, "{register} should hold {expected:#x}, holds {read:#x}")
            }
            Self::NotConfigured => f.write_str("the chip has not been configured"),
            Self::OffsetTestAborted => f.write_str("the offset test was aborted"),
        }
    }
}

impl<E: fmt::Debug> core::error::Error for Error<E> {}
