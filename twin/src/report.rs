//! The report: as data, as a page and as a screen of text.

pub mod data;
pub mod format;
pub mod html;
pub mod json;
mod plots;
pub mod text;
