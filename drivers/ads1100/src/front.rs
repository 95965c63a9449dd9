//! The two public flavours. Both only hand calls to the same logic.

use crate::driver::{Conversion, Core};
use crate::error::Error;
use crate::sample::Sample;
use crate::settings::{Address, Settings};
#[cfg(feature = "async")]
use crate::transport::Asynchronous;
use crate::transport::Blocking;

/// An ADS1100 on a blocking [`embedded_hal::i2c::I2c`].
#[derive(Debug)]
pub struct Ads1100<I2C> {
    core: Core<Blocking<I2C>>,
}

/// An ADS1100 on an async [`embedded_hal_async::i2c::I2c`]; methods and behaviour are those of [`Ads1100`].
#[cfg(feature = "async")]
#[derive(Debug)]
pub struct Ads1100Async<I2C> {
    core: Core<Asynchronous<I2C>>,
}

/// What needs no bus.
macro_rules! local {
    ($name:ident, $transport:ident) => {
        impl<I2C> $name<I2C> {
            /// A driver for the chip at `address`. No transfer takes place.
            pub fn new(i2c: I2C, address: Address, settings: Settings) -> Self {
                Self {
                    core: Core::new($transport(i2c), address, settings),
                }
            }

            /// The bus, given back.
            pub fn release(self) -> I2C {
                self.core.transport.0
            }

            /// The settings for the next conversion.
            #[must_use]
            pub fn settings(&self) -> Settings {
                self.core.settings()
            }

            /// Changes the settings for the next conversion and forgets the one under way.
            pub fn set_settings(&mut self, settings: Settings) {
                self.core.set_settings(settings);
            }

            /// The longest that a single conversion takes from its start, in µs:
            /// [`DataRate::timeout_us`](crate::DataRate::timeout_us), and after power-up or a reset that of the rate which the chip then
            /// converts at.
            #[must_use]
            pub fn timeout_us(&self) -> u32 {
                self.core.timeout_us()
            }
        }
    };
}

local!(Ads1100, Blocking);
#[cfg(feature = "async")]
local!(Ads1100Async, Asynchronous);

/// Public methods of both flavours: name and documentation once, the call twice.
macro_rules! methods {
    ($($(#[$doc:meta])* fn $name:ident() -> $output:ty;)*) => {
        impl<I2C: embedded_hal::i2c::I2c> Ads1100<I2C> {
            $(
                $(#[$doc])*
                pub fn $name(&mut self) -> Result<$output, Error<I2C::Error>> {
                    self.core.$name()
                }
            )*
        }

        #[cfg(feature = "async")]
        impl<I2C: embedded_hal_async::i2c::I2c> Ads1100Async<I2C> {
            $(
                $(#[$doc])*
                pub async fn $name(&mut self) -> Result<$output, Error<I2C::Error>> {
                    self.core.$name().await
                }
            )*
        }
    };
}

methods! {
    /// Starts a single conversion. One under way goes on instead (ADS1110 data sheet SBAS276A, operating modes; that page of the
    /// ADS1100's was not at hand): what comes next is [`Conversion::Discarded`].
    ///
    /// Between conversions the configuration is read first, since writing it would hide a reset.
    ///
    /// # Errors
    /// [`Error::ConfigurationLost`] after a reset or a brown-out since the last result (start again); [`Error::Bus`]. No conversion
    /// counts as under way then.
    fn start() -> ();

    /// Reads code and configuration, and delivers the result once the conversion has finished.
    ///
    /// Each result is delivered once, so what comes out is always new. A conversion still [`Conversion::Busy`] after `timeout_us` is a
    /// fault.
    ///
    /// # Errors
    /// [`Error::NotStarted`]; [`Error::ConfigurationLost`] after a reset, a brown-out, or on a stuck bus;
    /// [`Error::CodeOutOfRange`]; [`Error::Bus`] (poll again).
    fn poll() -> Conversion;

    /// Starts continuous conversions.
    ///
    /// This mode tells nothing about freshness: ST/BSY always reads 1, and until the next conversion ends a read
    /// returns the previous result again, at first even that of the settings before. Count the time: a result is new at
    /// the earliest [`DataRate::worst_conversion_us`](crate::DataRate::worst_conversion_us) after the previous one.
    /// With 8 SPS and gain 1 it equals the chip's reset state 0x8C, in which a reset cannot be seen. Prefer `start`.
    ///
    /// # Errors
    /// [`Error::Bus`].
    fn start_continuous() -> ();

    /// Reads the output register in continuous mode; the same result may come any number of times.
    ///
    /// # Errors
    /// [`Error::NotStarted`]; [`Error::ConfigurationLost`]; [`Error::CodeOutOfRange`]; [`Error::Bus`].
    fn read_continuous() -> Sample;

    /// Resets *every* device on the bus that obeys the general call reset (address 0x00, byte 0x06).
    ///
    /// The ADS1100 is then as after power-up: continuous mode, 8 SPS, gain 1, output register 0. The result of the next
    /// single conversion is discarded.
    ///
    /// # Errors
    /// [`Error::Bus`].
    fn general_call_reset() -> ();
}
