//! The tool that explains a mismatch.

pub mod convert;
pub mod effects;
pub mod explain;
pub mod failure;
pub mod problem;
pub mod progress;
pub mod report;
pub mod spectrum;
