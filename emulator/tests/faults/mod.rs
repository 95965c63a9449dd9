//! The faults of docs/faults.md on the running image, one test each, named by their numbers.

mod bench;
mod buses;
mod commands;
mod converter;
mod core;
mod flash;
mod meter;
mod range;
mod sensors;
