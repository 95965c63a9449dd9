//! `core`, `alloc` and `compiler_builtins` for the board, built once from Debian's library sources.
//!
//! Debian's compiler has no library for the board. Building it apart and passing `--sysroot` keeps everything else on
//! plain stable cargo; `-Zbuild-std` at each build would compile it for each profile and again for Clippy, and its
//! `RUSTC_BOOTSTRAP=1` makes build scripts of dependencies believe in a nightly compiler.

use std::{
    fs::{self, File},
    hash::{DefaultHasher, Hash, Hasher},
    path::{Path, PathBuf},
};

use anyhow::{Context, Result, bail};

use crate::{
    process,
    toolchain::{self, TARGET},
};

/// Counted up when what is built here changes, so that older ones are left behind.
const REVISION: u32 = 1;
const MANIFEST: &str = "[package]\nname = \"sysroot\"\nversion = \"0.0.0\"\nedition = \"2024\"\n\n[workspace]\n\n\
                        [profile.release]\ncodegen-units = 1\ndebug = 1\n";

/// The sysroot's path; builds it if this compiler's is not there.
pub fn build(target_dir: &Path) -> Result<PathBuf> {
    let version = toolchain::debian_version()?;
    let mut hasher = DefaultHasher::new();
    (REVISION, &version).hash(&mut hasher);
    let sysroot = target_dir.join(format!("sysroot-{:016x}", hasher.finish()));
    if sysroot.exists() {
        return Ok(sysroot);
    }
    fs::create_dir_all(target_dir).with_context(|| format!("creating {}", target_dir.display()))?;
    // One builds, others wait for it.
    let lock = File::create(target_dir.join("sysroot.lock"))?;
    lock.lock()?;
    if sysroot.exists() {
        return Ok(sysroot);
    }
    eprintln!(
        "building the library for {TARGET} with Debian's compiler (once, about half a minute)"
    );
    let package = target_dir.join("sysroot-package");
    fs::create_dir_all(package.join("src"))
        .with_context(|| format!("creating {}", package.display()))?;
    fs::write(package.join("Cargo.toml"), MANIFEST)?;
    fs::write(package.join("src/lib.rs"), "#![no_std]\n")?;

    let sources = Path::new("/usr/lib/rustlib/src/rust");
    let mut flags = vec![
        // Fat link-time optimisation needs the bitcode.
        "-Cembed-bitcode=yes".into(),
        // The name under which rustup's own library is known to debuggers and panic messages.
        toolchain::remap(
            &fs::canonicalize(sources).unwrap_or_else(|_| sources.into()),
            &format!("/rustc/{}", commit(&version)?),
        ),
        toolchain::remap(sources, &format!("/rustc/{}", commit(&version)?)),
        toolchain::remap(&package, "sysroot"),
    ];
    if let Some(home) = toolchain::cargo_home() {
        flags.push(toolchain::remap(&home, "/cargo"));
    }
    let built = package.join("target");
    let mut cargo = toolchain::debian_cargo();
    cargo
        .current_dir(&package)
        // `-Z build-std` is all it is for; nothing but the library is built with it.
        .env("RUSTC_BOOTSTRAP", "1")
        .env("CARGO_ENCODED_RUSTFLAGS", toolchain::encode(&flags))
        .args([
            "build",
            "--quiet",
            "--release",
            "-Zbuild-std=core,alloc",
            "--target",
            TARGET,
            "--target-dir",
        ])
        .arg(&built);
    process::run_to_stderr(&mut cargo)?;

    // Moved into place when complete, so that an interrupted run leaves no half of it.
    let half = target_dir.join(format!("sysroot-{}", std::process::id()));
    let library = half.join("lib/rustlib").join(TARGET).join("lib");
    fs::create_dir_all(&library)?;
    let mut copied = 0;
    for entry in fs::read_dir(built.join(TARGET).join("release/deps"))? {
        let path = entry?.path();
        let Some(name) = path.file_name().and_then(|name| name.to_str()) else {
            continue;
        };
        if path
            .extension()
            .is_some_and(|extension| extension == "rlib")
            && !name.starts_with("libsysroot-")
        {
            fs::copy(&path, library.join(name))?;
            copied += 1;
        }
    }
    if copied < 3 {
        bail!(
            "the library for {TARGET} is incomplete: {copied} of core, alloc and compiler_builtins"
        );
    }
    fs::rename(&half, &sysroot).with_context(|| format!("creating {}", sysroot.display()))?;
    fs::remove_dir_all(&built)?;
    Ok(sysroot)
}

fn commit(version: &str) -> Result<&str> {
    version
        .lines()
        .find_map(|line| line.strip_prefix("commit-hash: "))
        .context("`rustc -vV` names no commit")
}
