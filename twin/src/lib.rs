//! The tool that explains a mismatch.

pub mod align;
pub mod convert;
pub mod effects;
pub mod effects_command;
pub mod explain;
pub mod explain_command;
pub mod failure;
pub mod model;
pub mod prepare;
pub mod problem;
pub mod progress;
pub mod range;
pub mod report;
pub mod simulate;
pub mod spectrum;
pub mod standstill;
