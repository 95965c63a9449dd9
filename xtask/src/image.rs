//! The release image: built, checked for paths of the machine that built it, copied to a place that stays.

use std::{
    fs, io,
    path::{Path, PathBuf},
    process::Command,
};

use anyhow::{Context, Result, bail};

use crate::{
    process,
    toolchain::{self, Toolchain},
    workspace::Workspace,
};

/// Builds the firmware; the path of its ELF file.
pub fn build(workspace: &Workspace, toolchain: &Toolchain) -> Result<PathBuf> {
    let built = build_package(toolchain, "firmware")?;
    check_paths(workspace, &built)?;
    let elf = workspace.target_dir.join("hallmark.elf");
    replace(&built, &elf)
        .with_context(|| format!("copying {} to {}", built.display(), elf.display()))?;
    Ok(elf)
}

/// Copies a file over another in one step: what runs beside this reads the old one or the new one, and never a part.
fn replace(from: &Path, to: &Path) -> io::Result<()> {
    if fs::exists(to)? && fs::read(from)? == fs::read(to)? {
        return Ok(());
    }
    let beside = to.with_extension(format!("{}.new", std::process::id()));
    fs::copy(from, &beside)?;
    fs::rename(&beside, to)
}

/// Builds one package for the board; the path of its only executable.
pub fn build_package(toolchain: &Toolchain, package: &str) -> Result<PathBuf> {
    process::run_to_stderr(toolchain.cargo("build").args(["--package", package]))?;
    // Everything is built; this run only says where.
    let mut list: Command = toolchain.cargo("build");
    let messages =
        process::output(list.args(["--quiet", "--package", package, "--message-format=json"]))?;
    executable(&messages).with_context(|| format!("package {package} has no executable"))
}

/// The first executable among the messages of `--message-format=json`.
pub fn executable(messages: &str) -> Option<PathBuf> {
    messages
        .lines()
        .filter_map(|line| serde_json::from_str::<serde_json::Value>(line).ok())
        .find_map(|message| message.get("executable")?.as_str().map(PathBuf::from))
}

/// Refuses an image that names the checkout or the user's cargo folder.
fn check_paths(workspace: &Workspace, elf: &Path) -> Result<()> {
    let bytes = fs::read(elf).with_context(|| format!("reading {}", elf.display()))?;
    let folders = [Some(workspace.root.clone()), toolchain::cargo_home()];
    for folder in folders.iter().flatten() {
        // A checkout at the file system's root would be found everywhere.
        if folder.components().count() > 2
            && contains(&bytes, folder.as_os_str().as_encoded_bytes())
        {
            bail!(
                "the image contains this machine's path {}",
                folder.display()
            );
        }
    }
    Ok(())
}

fn contains(bytes: &[u8], wanted: &[u8]) -> bool {
    bytes.windows(wanted.len()).any(|window| window == wanted)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_executable_is_found_among_cargos_messages() {
        let messages = concat!(
            "{\"reason\":\"compiler-artifact\",\"executable\":null}\n",
            "{\"reason\":\"compiler-artifact\",\"executable\":\"/t/firmware\"}\n",
            "{\"reason\":\"build-finished\",\"success\":true}\n"
        );
        assert_eq!(executable(messages), Some(PathBuf::from("/t/firmware")));
        assert_eq!(executable("{\"reason\":\"build-finished\"}\n"), None);
    }

    #[test]
    fn a_path_is_found_anywhere() {
        assert!(contains(b"xx/home/me/project/src", b"/home/me"));
        assert!(!contains(b"xx/home/you", b"/home/me"));
    }
}
