//! The one seam between the driver's logic and the two flavours of bus.
//!
//! The logic is written once as `async` code over [`Transport`]. A blocking bus never waits inside a transport call,
//! so [`run`] completes such a future in its first poll; no executor and no second copy of the logic is needed.

use core::future::Future;
use core::pin::pin;
use core::task::{Context, Poll, Waker};

/// A bus of either flavour.
pub(crate) trait Transport {
    /// The bus's own error.
    type Error;

    /// Reads `data` from the device at `address`.
    async fn read(&mut self, address: u8, data: &mut [u8]) -> Result<(), Self::Error>;

    /// Writes `data` to the device at `address`.
    async fn write(&mut self, address: u8, data: &[u8]) -> Result<(), Self::Error>;
}

/// A bus of the blocking flavour.
#[derive(Debug)]
pub(crate) struct Blocking<I2C>(pub(crate) I2C);

impl<I2C: embedded_hal::i2c::I2c> Transport for Blocking<I2C> {
    type Error = I2C::Error;

    async fn read(&mut self, address: u8, data: &mut [u8]) -> Result<(), Self::Error> {
        self.0.read(address, data)
    }

    async fn write(&mut self, address: u8, data: &[u8]) -> Result<(), Self::Error> {
        self.0.write(address, data)
    }
}

/// A bus of the async flavour.
#[cfg(feature = "async")]
#[derive(Debug)]
pub(crate) struct Asynchronous<I2C>(pub(crate) I2C);

#[cfg(feature = "async")]
impl<I2C: embedded_hal_async::i2c::I2c> Transport for Asynchronous<I2C> {
    type Error = I2C::Error;

    async fn read(&mut self, address: u8, data: &mut [u8]) -> Result<(), Self::Error> {
        self.0.read(address, data).await
    }

    async fn write(&mut self, address: u8, data: &[u8]) -> Result<(), Self::Error> {
        self.0.write(address, data).await
    }
}

/// Completes a future over a [`Blocking`] transport, which is ready at its first poll.
pub(crate) fn run<F: Future>(future: F) -> F::Output {
    let mut future = pin!(future);
    let mut context = Context::from_waker(Waker::noop());
    loop {
        if let Poll::Ready(output) = future.as_mut().poll(&mut context) {
            return output;
        }
    }
}
