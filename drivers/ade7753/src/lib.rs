#![doc = include_str!("../README.md")]
#![no_std]
#![forbid(unsafe_code)]

mod config;
mod driver;
mod error;
mod front;
pub mod registers;
mod timing;
mod transport;

pub use config::Config;
pub use driver::{EnergySnapshot, OffsetTest, Options, Statistics};
pub use error::{Error, StuckLevel};
pub use front::Ade7753;
#[cfg(feature = "async")]
pub use front::Ade7753Async;
pub use registers::{Aenergy, EnergyDelta, Gain, Interrupts, Mode, RegisterId};
pub use timing::Timing;
