//! Hands the linker the memory map and the linker scripts of cortex-m-rt and defmt.

use std::{env, fs, path::PathBuf, process::Command};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let out = PathBuf::from(env::var("OUT_DIR")?);
    fs::copy("../memory.x", out.join("memory.x"))?;
    println!("cargo:rustc-link-search={}", out.display());
    println!("cargo:rerun-if-changed=../memory.x");
    println!("cargo:rerun-if-changed=build.rs");
    // `--nmagic`: sections need no page alignment in a flash image. `--icf=all`: equal functions are one; nothing here tells
    // functions apart by their addresses.
    for argument in ["--nmagic", "--icf=all", "-Tlink.x", "-Tdefmt.x"] {
        println!("cargo:rustc-link-arg-bins={argument}");
    }
    // The revision goes into the identity frames; a source without git has none.
    let commit = git(&["rev-parse", "--short=8", "HEAD"]).unwrap_or_default();
    let modified = git(&["status", "--porcelain", "--untracked-files=no"]).unwrap_or_default();
    println!("cargo:rustc-env=HALLMARK_COMMIT={commit}");
    println!(
        "cargo:rustc-env=HALLMARK_MODIFIED={}",
        if modified.is_empty() { "" } else { "1" }
    );
    // Asked, not assumed: in a linked worktree `.git` is a file that names another folder.
    for name in ["HEAD", "index"] {
        if let Some(file) =
            git(&["rev-parse", "--git-path", name]).filter(|file| fs::exists(file).unwrap_or(false))
        {
            println!("cargo:rerun-if-changed={file}");
        }
    }
    Ok(())
}

fn git(arguments: &[&str]) -> Option<String> {
    let output = Command::new("git").args(arguments).output().ok()?;
    let text = String::from_utf8(output.stdout).ok()?;
    output.status.success().then(|| text.trim().to_owned())
}
