//! The faults of docs/faults.md on the running image, one test each, named by their numbers. One binary: linking the
//! emulated core takes longer than most of the tests.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

mod bench;
mod buses;
mod commands;
mod converter;
mod core;
mod flash;
mod meter;
mod range;
mod sensors;
