//! The two flavours of bus. The logic over them is written once, for the async one; [`both_flavours`](::both_flavours) makes the
//! blocking one of it.

/// A bus of the blocking flavour.
#[derive(Debug)]
pub(crate) struct Blocking<SPI>(pub(crate) SPI);

/// A bus of the async flavour.
#[cfg(feature = "async")]
#[derive(Debug)]
pub(crate) struct Asynchronous<SPI>(pub(crate) SPI);
