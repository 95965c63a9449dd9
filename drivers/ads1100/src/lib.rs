#![doc = include_str!("../README.md")]
#![no_std]
#![forbid(unsafe_code)]

mod driver;
mod error;
mod front;
mod sample;
mod settings;
mod transport;

pub use driver::Conversion;
pub use error::{Error, Operation};
pub use front::Ads1100;
#[cfg(feature = "async")]
pub use front::Ads1100Async;
pub use sample::Sample;
pub use settings::{Address, DataRate, Gain, Settings};
