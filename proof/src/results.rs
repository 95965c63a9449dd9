//! results.json: the tables, then one line for each case, so that two campaigns can be compared with a text tool.

use anyhow::{Context, Result};
use serde_json::Value;

use crate::summary::Summary;

/// The file's text; a number that is not finite is `null`.
pub fn text(summary: &Summary) -> Result<String> {
    let mut all = serde_json::to_value(summary).context("results.json")?;
    let records = all
        .as_object_mut()
        .and_then(|object| object.remove("records"))
        .unwrap_or_default();
    let mut text = serde_json::to_string_pretty(&all)?;
    if text.ends_with("\n}") {
        text.truncate(text.len() - 2);
    }
    text.push_str(",\n  \"records\": [\n");
    let lines: Vec<String> = records
        .as_array()
        .map(Vec::as_slice)
        .unwrap_or_default()
        .iter()
        .map(Value::to_string)
        .collect();
    text.push_str(&lines.join(",\n"));
    text.push_str("\n  ]\n}\n");
    Ok(text)
}
