//! A second run in the same folder.
#![allow(clippy::unwrap_used)]

use std::{
    fs::{self, File},
    path::Path,
    process::{Command, Output},
};

/// A run that cannot come far: there is no tool.
fn prove(out: &Path, docs: &Path) -> Output {
    Command::new(env!("CARGO_BIN_EXE_prove"))
        .args(["run", "--plan", "quick", "--twin", "no-such-tool"])
        .args(["--root", concat!(env!("CARGO_MANIFEST_DIR"), "/..")])
        .arg("--out")
        .arg(out)
        .arg("--docs")
        .arg(docs)
        .output()
        .unwrap()
}

#[test]
fn a_second_run_ends_with_the_reason_and_touches_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let [out, docs] = ["out", "docs"].map(|name| folder.path().join(name));
    for busy in [&out, &docs] {
        fs::create_dir_all(busy).unwrap();
        let first = File::open(busy).unwrap();
        first.lock().unwrap();
        let refused = prove(&out, &docs);
        let said = String::from_utf8(refused.stderr).unwrap();
        assert_eq!(refused.status.code(), Some(2), "{said}");
        assert_eq!(said.lines().count(), 1, "{said}");
        assert!(said.contains("another run"), "{said}");
        assert!(said.contains(busy.to_str().unwrap()), "{said}");
        assert_eq!(fs::read_dir(busy).unwrap().count(), 0);
    }
    // When they have ended the reason is another one.
    let said = String::from_utf8(prove(&out, &docs).stderr).unwrap();
    assert!(said.contains("no-such-tool"), "{said}");
}
