//! The physical world around the board, as plain configuration, plain state and a step function.
//!
//! No MCU and no files here. Every non-ideal part has a nominal value that switches it off, so the world "as designed"
//! and the world with an effect are the same code. Quantities are SI in `f64` and carry their unit in the name.

pub mod ade7753;
pub mod ads1100;
pub mod analog_switch;
pub mod battery;
pub mod bus;
pub mod comparator;
pub mod filter;
pub mod front_end;
pub mod hall;
pub mod magnetic_core;
pub mod network;
pub mod stretch;
pub mod supply;
pub mod violations;
pub mod w25q32;
