//! The report: as data, as a page and as a screen of text.

pub mod data;
