//! `docs/error-budget.md` carries the table that the code makes. `UPDATE_DOCS=1` rewrites it.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use core_logic::error_budget::write_markdown;

const BEGIN: &str = "<!-- budget: begin -->\n";
const END: &str = "<!-- budget: end -->";

#[test]
fn the_table_in_the_docs_is_the_one_in_the_code() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/error-budget.md");
    let text = std::fs::read_to_string(path).unwrap();
    let (before, rest) = text.split_once(BEGIN).expect("begin of the table");
    let (_, after) = rest.split_once(END).expect("end of the table");
    let mut table = String::new();
    write_markdown(&mut table).unwrap();
    let expected = format!("{before}{BEGIN}\n{table}\n{END}{after}");
    if std::env::var_os("UPDATE_DOCS").is_some() {
        std::fs::write(path, &expected).unwrap();
    } else {
        assert!(
            text == expected,
            "docs/error-budget.md is out of date: run this test with UPDATE_DOCS=1"
        );
    }
}
