//! Recordings in their canonical form.
//!
//! A [`Recording`] is a table of numbers with a column `t_s` of time; the other columns are called `<signal>_<unit>`
//! ([`name`] has those that the project's tools know). A missing value is NaN; nothing is interpolated, and nothing is
//! put where nothing was recorded. Positive current is discharge.

pub mod convert;
pub mod csv;
pub mod dbc;
mod e2e;
pub mod error;
pub mod log;
pub mod mapping;
pub mod marks;
pub mod mdf;
pub mod merge;
pub mod name;
pub mod output;
pub mod parquet;
mod series;
pub mod table;
pub mod unit;

pub use error::{Error, Result};
pub use mapping::Mapping;
pub use series::Recording;
pub use table::Table;
