//! The report as `report.json`, schema 1.

use super::data::Report;

/// The report as indented JSON with a newline at its end. A number that is not finite becomes `null`.
pub fn render(report: &Report) -> String {
    // The report's types hold neither maps nor hand-written serialisers: turning them into JSON cannot fail.
    let mut text = serde_json::to_string_pretty(report).unwrap_or_default();
    text.push('\n');
    text
}
