#![no_std]
#![forbid(unsafe_code)]
//! The measuring logic of the Hallmark board: everything between a converter's code and a number on the bus.
//!
//! No hardware, no heap, no unsafe, no floating point; nothing that arrives from outside can make it panic. The same
//! code runs in the firmware, in the simulation of the board and inside a fit. `docs/architecture.md` draws how the
//! modules hand their results on.

#[cfg(test)]
extern crate std;

pub mod bus_off;
pub mod can;
pub mod channel_compare;
pub mod check_in;
pub mod configuration;
pub mod converter;
pub mod design_parameters;
pub mod diagnosis;
pub mod e2e;
pub mod error_budget;
pub mod front_end;
pub mod gap;
pub mod key_calibration;
pub mod measurement;
pub mod meter;
pub mod modbus;
pub mod modbus_rtu;
pub mod ocv;
pub mod open_sensor;
pub mod range;
pub mod retained;
pub mod sliding_average;
pub mod soc;
mod steadiness;
pub mod storm;
pub mod supply_calibration;
pub mod units;
pub mod validity;
pub mod zero_drift;
