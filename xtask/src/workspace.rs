//! Where things are: the checkout, its target directory, the compiler for the host.

use std::{
    env,
    fs::{self, File, TryLockError},
    path::{Path, PathBuf},
    process::Command,
};

use anyhow::{Context, Result, bail};

use crate::{apt, process};

/// The checkout this command was started in.
pub struct Workspace {
    /// Its top folder.
    pub root: PathBuf,
    /// Where cargo puts what it builds for the host; everything else is a subfolder of it.
    pub target_dir: PathBuf,
}

impl Workspace {
    /// Asks cargo, so that `CARGO_TARGET_DIR` and configuration files count.
    pub fn find() -> Result<Self> {
        let mut command = host_cargo();
        command.args(["metadata", "--no-deps", "--format-version=1"]);
        // `cargo run` says at run time where this package is, whatever folder the user is in. Not at compile time: two
        // checkouts that share a target folder share this program.
        if let Some(package) = env::var_os("CARGO_MANIFEST_DIR") {
            command
                .arg("--manifest-path")
                .arg(Path::new(&package).join("Cargo.toml"));
        }
        let metadata: serde_json::Value = serde_json::from_str(&process::output(&mut command)?)
            .context("reading `cargo metadata`")?;
        let path = |key: &str| {
            metadata
                .get(key)
                .and_then(serde_json::Value::as_str)
                .map(PathBuf::from)
                .with_context(|| format!("`cargo metadata` names no {key}"))
        };
        Ok(Self {
            root: path("workspace_root")?,
            target_dir: path("target_directory")?,
        })
    }

    /// `cargo`, as the user started it, in the checkout's top folder.
    pub fn cargo(&self) -> Command {
        let mut command = host_cargo();
        command.current_dir(&self.root);
        command
    }

    /// Keeps other runs in this checkout from setting up for as long as the file is open: two would make the same things under each
    /// other. Waits while another run does.
    pub fn set_up_alone(&self) -> Result<File> {
        fs::create_dir_all(&self.target_dir)
            .with_context(|| format!("making {}", self.target_dir.display()))?;
        let path = self.target_dir.join("set-up.lock");
        let file = File::create(&path).with_context(|| format!("opening {}", path.display()))?;
        match file.try_lock() {
            Ok(()) => return Ok(file),
            Err(TryLockError::WouldBlock) => {
                eprintln!(
                    "waiting for another run's set-up in {}",
                    self.target_dir.display()
                );
                file.lock()
            }
            Err(TryLockError::Error(error)) => Err(error),
        }
        .with_context(|| format!("locking {}", path.display()))?;
        Ok(file)
    }
}

/// The cargo that runs this command, else the first on PATH.
fn host_cargo() -> Command {
    let mut command = Command::new(env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    process::forget_outer_package(&mut command);
    command
}

/// Clippy and rustfmt are separate components of a toolchain: installs the one that is missing.
pub fn check_host_components() -> Result<()> {
    for (subcommand, component, package) in [
        ("clippy", "clippy", "rust-web-clippy"),
        ("fmt", "rustfmt", "rustfmt-web"),
    ] {
        if works(subcommand) {
            continue;
        }
        eprintln!("`cargo {subcommand}` is missing here");
        if process::on_path("rustup") {
            let mut rustup = Command::new("rustup");
            process::forget_outer_package(&mut rustup);
            process::run(rustup.args(["component", "add", component]))?;
        } else {
            apt::install(&[package])?;
        }
        if !works(subcommand) {
            bail!(
                "`cargo {subcommand}` still does not work: `rustup component add {component}`, or Debian's {package}"
            );
        }
    }
    Ok(())
}

fn works(subcommand: &str) -> bool {
    process::output(host_cargo().args([subcommand, "--version"])).is_ok()
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn one_run_sets_up_at_a_time() {
        let workspace = Workspace {
            root: PathBuf::new(),
            target_dir: env::temp_dir().join(format!("hallmark-set-up-{}", std::process::id())),
        };
        let first = workspace.set_up_alone().unwrap();
        let other = File::open(workspace.target_dir.join("set-up.lock")).unwrap();
        assert!(matches!(other.try_lock(), Err(TryLockError::WouldBlock)));
        drop(first);
        assert!(other.try_lock().is_ok());
        fs::remove_dir_all(&workspace.target_dir).unwrap();
    }
}
