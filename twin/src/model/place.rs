//! Where in the model file something stands, for messages.

use toml_edit::{Document, Item};

use crate::failure::Failure;

/// What the reader of TOML calls what it expected, and what a reader of the file calls that; the first that fits counts.
const IN_WORDS: [(&str, &str); 11] = [
    ("f64", "a number"),
    ("u8", "a whole number"),
    ("u32", "a whole number"),
    ("struct AccuracySpec", "a table { zero = …, gain = … }"),
    ("struct Sensor", "a table, [sensor]"),
    ("struct Charge", "a table, [charge]"),
    ("struct BatteryText", "a table, [battery]"),
    ("a map", "a table"),
    ("a sequence", "a list in brackets"),
    ("path string", "a file's name in quotes"),
    ("a string", "text in quotes"),
];

/// A model file's text with the lines of its keys.
pub(super) struct Places<'a> {
    source: &'a str,
    text: &'a str,
    document: Option<Document<String>>,
}

impl<'a> Places<'a> {
    pub(super) fn new(source: &'a str, text: &'a str) -> Self {
        Self {
            source,
            text,
            document: Document::parse(text.to_owned()).ok(),
        }
    }

    /// Keys of a table in the order of the file.
    pub(super) fn order(&self, table: &str) -> Vec<String> {
        let table = self
            .document
            .as_ref()
            .and_then(|document| document.get(table));
        let table = table.and_then(Item::as_table_like);
        table.map_or_else(Vec::new, |table| {
            table.iter().map(|(key, _)| key.to_owned()).collect()
        })
    }

    /// What the reader of TOML says, as one sentence.
    pub(super) fn syntax(&self, error: &toml::de::Error) -> Failure {
        let mut message = error.message().trim().replace('\n', ", ");
        for (internal, words) in IN_WORDS {
            message = message.replace(
                &format!("expected {internal}"),
                &format!("expected {words}"),
            );
        }
        let Some(span) = error.span() else {
            return Failure(format!("{}: {message}", self.source));
        };
        let line = self.line(span.start);
        let text = self.text.lines().nth(line - 1).unwrap_or_default();
        let key = text.split('=').next().unwrap_or_default().trim();
        let key = if text.contains('=') && !key.is_empty() {
            format!(", key {key}")
        } else {
            String::new()
        };
        Failure(format!("{}, line {line}{key}: {message}", self.source))
    }

    /// A fault at a key, or at the nearest table above it that is there.
    pub(super) fn fault(&self, path: &[&str], found: &str, expected: &str) -> Failure {
        let mut place = self.source.to_owned();
        if let Some(line) = self.find(path) {
            place.push_str(&format!(", line {line}"));
        }
        if !path.is_empty() {
            place.push_str(&format!(", key {}", path.join(".")));
        }
        Failure(format!("{place}: found {found}, expected {expected}"))
    }

    fn find(&self, path: &[&str]) -> Option<usize> {
        let mut item: &Item = self.document.as_ref()?.as_item();
        let mut line = None;
        for part in path {
            let table = item.as_table_like()?;
            let Some((key, next)) = table.get_key_value(part) else {
                break;
            };
            if let Some(span) = key.span().or_else(|| next.span()) {
                line = Some(self.line(span.start));
            }
            item = next;
        }
        line
    }

    /// Line of a byte, from 1.
    fn line(&self, byte: usize) -> usize {
        let before = self.text.get(..byte).unwrap_or(self.text);
        before.matches('\n').count() + 1
    }
}
