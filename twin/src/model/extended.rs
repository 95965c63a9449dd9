//! The model file with effects added.

use toml_edit::{DocumentMut, Item, Table, value};

use crate::failure::Failure;

/// An effect to be written into a model file.
#[derive(Clone, Debug, PartialEq)]
pub struct Found {
    /// Its id.
    pub id: String,
    /// Names and values of its parameters.
    pub parameters: Vec<(String, f64)>,
    /// What is said of it, line by line; becomes a comment.
    pub comment: Vec<String>,
}

/// `text` with `effects` in it; everything else stays as it is.
pub(super) fn extended(source: &str, text: &str, effects: &[Found]) -> Result<String, Failure> {
    if effects.is_empty() {
        return Ok(text.to_owned());
    }
    let wrong = |what: &str| Failure::Input(format!("{source}: {what}, expected tables [effects.<id>]"));
    let mut document: DocumentMut = text.parse().map_err(|_| wrong("not TOML"))?;
    let place = document.as_table_mut().entry("effects").or_insert_with(|| {
        let mut table = Table::new();
        // Only [effects.<id>] is written, not an empty [effects].
        table.set_implicit(true);
        Item::Table(table)
    });
    for effect in effects {
        let place = place.as_table_like_mut().ok_or_else(|| wrong("effects is no table"))?;
        let mut table = Table::new();
        for (name, number) in &effect.parameters {
            // Written in full: reading it back gives the same number.
            table.insert(name, value(*number));
        }
        let comment: String = effect.comment.iter().map(|line| format!("# {line}\n")).collect();
        table.decor_mut().set_prefix(format!("\n{comment}"));
        place.insert(&effect.id, Item::Table(table));
    }
    let mut written = document.to_string();
    if !written.ends_with('\n') {
        written.push('\n');
    }
    Ok(written)
}
