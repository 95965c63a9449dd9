//! The one seam between the driver's logic and the two flavours of bus.
//!
//! The logic is written once as `async` code over [`Transport`]. A blocking bus never waits inside a transport call,
//! so [`run`] completes such a future in its first poll; no executor and no second copy of the logic is needed.

use core::future::Future;
use core::pin::pin;
use core::task::{Context, Poll, Waker};

use embedded_hal::spi::Operation;

/// One chip-select assertion on a bus of either flavour.
pub(crate) trait Transport {
    /// The bus's own error.
    type Error;

    /// Performs `operations` under one chip select.
    async fn transaction(
        &mut self,
        operations: &mut [Operation<'_, u8>],
    ) -> Result<(), Self::Error>;
}

/// A bus of the blocking flavour.
#[derive(Debug)]
pub(crate) struct Blocking<SPI>(pub(crate) SPI);

impl<SPI: embedded_hal::spi::SpiDevice> Transport for Blocking<SPI> {
    type Error = SPI::Error;

    async fn transaction(
        &mut self,
        operations: &mut [Operation<'_, u8>],
    ) -> Result<(), Self::Error> {
        self.0.transaction(operations)
    }
}

/// A bus of the async flavour.
#[cfg(feature = "async")]
#[derive(Debug)]
pub(crate) struct Asynchronous<SPI>(pub(crate) SPI);

#[cfg(feature = "async")]
impl<SPI: embedded_hal_async::spi::SpiDevice> Transport for Asynchronous<SPI> {
    type Error = SPI::Error;

    async fn transaction(
        &mut self,
        operations: &mut [Operation<'_, u8>],
    ) -> Result<(), Self::Error> {
        self.0.transaction(operations).await
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
