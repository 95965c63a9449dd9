//! The two public flavours. Both only hand calls to the same logic.

use crate::config::Config;
use crate::driver::{Core, EnergySnapshot, Field, OffsetTest, Options, Statistics, decoded};
use crate::error::Error;
use crate::registers::{
    Aenergy, ClearedByRead, Dierev, EnergyDelta, Interrupts, NonDestructive, Temp, Waveform,
    Writable,
};
#[cfg(feature = "async")]
use crate::transport::Asynchronous;
use crate::transport::Blocking;

/// An ADE7753 on a blocking [`embedded_hal::spi::SpiDevice`].
#[derive(Debug)]
pub struct Ade7753<SPI> {
    core: Core<Blocking<SPI>>,
}

/// An ADE7753 on an async [`embedded_hal_async::spi::SpiDevice`].
///
/// Methods and behaviour are those of [`Ade7753`]. A future dropped half-way leaves the chip with part of the
/// operation done; after dropping `configure`, a write or an offset test call `configure` again.
#[cfg(feature = "async")]
#[derive(Debug)]
pub struct Ade7753Async<SPI> {
    core: Core<Asynchronous<SPI>>,
}

/// What needs no bus.
macro_rules! local {
    ($name:ident, $transport:ident) => {
        impl<SPI> $name<SPI> {
            /// A driver for the chip on `spi`: mode 1, at most 10 MHz. No transfer takes place.
            pub fn new(spi: SPI, options: Options) -> Self {
                Self {
                    core: Core::new($transport(spi), options),
                }
            }

            /// The bus, given back.
            pub fn release(self) -> SPI {
                self.core.transport.0
            }

            /// Counters of retries and errors.
            #[must_use]
            pub fn statistics(&self) -> Statistics {
                self.core.statistics
            }

            /// Sets the counters to zero.
            pub fn reset_statistics(&mut self) {
                self.core.statistics = Statistics::default();
            }

            /// The options given to `new`.
            #[must_use]
            pub fn options(&self) -> Options {
                self.core.options
            }

            /// The configuration in force; `None` before `configure` has succeeded.
            #[must_use]
            pub fn config(&self) -> Option<&Config> {
                self.core.config()
            }

            /// The die revision that `configure` read.
            #[must_use]
            pub fn die_revision(&self) -> Option<Dierev> {
                self.core.die_revision()
            }
        }
    };
}

local!(Ade7753, Blocking);
#[cfg(feature = "async")]
local!(Ade7753Async, Asynchronous);

/// Public methods of both flavours: name, arguments and documentation once, the call twice.
macro_rules! methods {
    ($(
        $(#[$doc:meta])*
        fn $name:ident ($($argument:ident: $type:ty),*) -> $output:ty;
    )*) => {
        impl<SPI: embedded_hal::spi::SpiDevice> Ade7753<SPI> {
            $(
                $(#[$doc])*
                pub fn $name(&mut self $(, $argument: $type)*)
                    -> Result<$output, Error<SPI::Error>>
                {
                    self.core.$name($($argument),*)
                }
            )*
        }

        #[cfg(feature = "async")]
        impl<SPI: embedded_hal_async::spi::SpiDevice> Ade7753Async<SPI> {
            $(
                $(#[$doc])*
                pub async fn $name(&mut self $(, $argument: $type)*)
                    -> Result<$output, Error<SPI::Error>>
                {
                    self.core.$name($($argument),*).await
                }
            )*
        }
    };
}

methods! {
    /// Writes and verifies a configuration, reads the die revision and clears the flags (RESET among them).
    ///
    /// # Errors
    /// [`Error::DeadBus`], [`Error::Verify`], [`Error::Checksum`], [`Error::Bus`]; [`Error::ValueOutOfRange`] for a
    /// CFNUM above 0xFFF or the reserved waveform source; [`Error::Configuration`] for STATUS if the RESET flag cannot
    /// be cleared. After an error the driver counts as not configured.
    fn configure(config: &Config) -> ();

    /// Resets the chip, holds the bus for [`Timing::after_reset_ns`](crate::Timing::after_reset_ns) and checks that
    /// MODE is at its default. AENERGY is lost and the driver is not configured any more.
    ///
    /// # Errors
    /// [`Error::Configuration`] if MODE is not at its default afterwards; [`Error::Checksum`], [`Error::DeadBus`],
    /// [`Error::Bus`].
    fn software_reset() -> ();

    /// Reads MODE, GAIN, CH1OS, CFNUM and DIEREV back and compares them with the configuration.
    ///
    /// To be called periodically: CHKSUM cannot see a MISO stuck low, which reads 0 with 0 ones. MODE and CFNUM are
    /// never 0 in a [`Config`], and MODE is never at its reset default, so the three faults are told apart:
    ///
    /// # Errors
    /// [`Error::DeadBus`] with the level of the line; [`Error::Reset`] if MODE is at its reset default;
    /// [`Error::Configuration`] for the first other register that differs; [`Error::NotConfigured`];
    /// [`Error::Checksum`], [`Error::Bus`].
    fn verify_configuration() -> ();

    /// Whether the chip has been reset since `configure`: STATUS.RESET is set, or MODE is at its default.
    ///
    /// It does not clear the flag; `configure` does. On a line stuck low it is `false`: see `verify_configuration`.
    ///
    /// # Errors
    /// [`Error::Checksum`], [`Error::DeadBus`], [`Error::Bus`].
    fn reset_detected() -> bool;

    /// AENERGY, confirmed by CHKSUM, with retries.
    ///
    /// Reading it does not change it, so a corrupted transfer costs a retry and no charge; that is why RAENERGY, which
    /// is cleared even when its transfer fails, has no method of its own. The chip copies the register into its output
    /// shifter when the command byte is complete. Cost on the wire: 6 bytes and 2 × t9 per attempt, see
    /// [`Timing::energy_ns`](crate::Timing::energy_ns).
    ///
    /// # Errors
    /// [`Error::Checksum`] or [`Error::DeadBus`] after the last retry; [`Error::Bus`].
    fn energy() -> Aenergy;

    /// AENERGY and CHKSUM in one chip-select assertion and one attempt: the shortest bounded time, and nothing can come
    /// between the two on a shared bus. The comparison is left to [`EnergySnapshot::verified`].
    ///
    /// The chip returns to communications mode when a transfer is complete (ADE7753 PrC, serial interface), so a second
    /// command may follow under the same chip select. `energy` uses two assertions, each of which resynchronises the
    /// interface after a disturbed clock.
    ///
    /// # Errors
    /// [`Error::Bus`].
    fn energy_snapshot() -> EnergySnapshot;

    /// WAVEFORM. A new sample is flagged by [`Interrupts::WSMP`].
    ///
    /// # Errors
    /// [`Error::Checksum`], [`Error::DeadBus`], [`Error::Bus`].
    fn waveform() -> Waveform;

    /// Starts a temperature conversion. It adds a little noise to the energy: not more than once in some seconds.
    ///
    /// # Errors
    /// As `verify_configuration` for MODE (nothing is written then), and [`Error::Verify`].
    fn start_temperature() -> ();

    /// The last temperature conversion's result, or `None` while one is under way (MODE.TEMPSEL still set).
    ///
    /// Bound the wait: parts of this family start the conversion at a zero crossing of channel 2, and a DC channel 2
    /// may never have one (to be confirmed on the bench).
    ///
    /// # Errors
    /// [`Error::Checksum`], [`Error::DeadBus`], [`Error::ReservedCode`], [`Error::Bus`].
    fn temperature() -> Option<Temp>;

    /// The events since the last call; clears them and releases IRQ (RSTSTATUS).
    ///
    /// One attempt only: a second read would find the flags cleared. In an interrupt handler clear the controller's
    /// pending bit *before* this call and look at the pin's level after it: an event during the transfer makes IRQ fall
    /// again at its end.
    ///
    /// # Errors
    /// [`Error::Checksum`] or [`Error::DeadBus`]: the flags are lost, take every enabled event as possible;
    /// [`Error::Bus`].
    fn take_status() -> Interrupts;

    /// Starts a self-test: shorts channel 1 inside the chip (DISCH1) and reads AENERGY.
    ///
    /// Until `finish_offset_test` no current is counted: do it at start-up, or account for the time. With LPF2 in use
    /// its 90 ms of settling (5 τ) fall into the test.
    ///
    /// # Errors
    /// As `verify_configuration` for MODE (nothing is changed then). If the test cannot be started MODE is restored,
    /// and if even that fails its error is the one returned.
    fn start_offset_test() -> OffsetTest;

    /// Ends the self-test: reads AENERGY and restores MODE, also when the read fails.
    ///
    /// The result is the counts gathered from the chip's own offset; divide by the time between the two calls.
    ///
    /// # Errors
    /// [`Error::Reset`] if the chip was reset meanwhile (MODE is left alone, so that the reset stays visible);
    /// [`Error::OffsetTestAborted`]; [`Error::NotConfigured`]; otherwise the error of restoring MODE or, if that
    /// worked, of reading.
    fn finish_offset_test(test: OffsetTest) -> EnergyDelta;
}

/// The methods for any register, of both flavours: only the bits go through the shared logic.
macro_rules! any_register {
    ($name:ident, $bus:path, $wait:ident $(, $async:ident)?) => {
        impl<SPI: $bus> $name<SPI> {
            /// Any register that reading does not change, confirmed by CHKSUM, with retries.
            ///
            /// # Errors
            /// [`Error::Checksum`], [`Error::DeadBus`], [`Error::ReservedCode`], [`Error::Bus`].
            pub $($async)? fn read<R: NonDestructive>(&mut self) -> Result<R, Error<SPI::Error>> {
                $wait!(self.core.read_bits(Field::of::<R>())).and_then(decoded)
            }

            /// Any register that reading clears, checked by CHKSUM, in one attempt.
            ///
            /// # Errors
            /// [`Error::Checksum`] (the content is lost; the bits received are in the error), [`Error::DeadBus`],
            /// [`Error::Bus`].
            pub $($async)? fn read_and_clear<R: ClearedByRead>(
                &mut self,
            ) -> Result<R, Error<SPI::Error>> {
                $wait!(self.core.take_bits(Field::cleared::<R>())).and_then(decoded)
            }

            /// Writes a register and reads it back, with retries.
            ///
            /// A register of the [`Config`] written to another value is reported by `verify_configuration`.
            ///
            /// # Errors
            /// [`Error::ValueOutOfRange`] (nothing is sent); [`Error::Verify`]; [`Error::Checksum`],
            /// [`Error::DeadBus`], [`Error::Bus`].
            pub $($async)? fn write<R: Writable>(
                &mut self,
                value: R,
            ) -> Result<(), Error<SPI::Error>> {
                $wait!(self.core.write_bits(Field::writable::<R>(), value.encode()))
            }
        }
    };
}

macro_rules! at_once {
    ($future:expr) => {
        $future
    };
}

#[cfg(feature = "async")]
macro_rules! wait_for {
    ($future:expr) => {
        $future.await
    };
}

any_register!(Ade7753, embedded_hal::spi::SpiDevice, at_once);
#[cfg(feature = "async")]
any_register!(
    Ade7753Async,
    embedded_hal_async::spi::SpiDevice,
    wait_for,
    async
);
