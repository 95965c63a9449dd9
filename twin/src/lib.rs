//! The tool that explains a mismatch.

pub mod convert;
pub mod failure;
pub mod progress;
