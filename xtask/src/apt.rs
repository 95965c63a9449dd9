//! Installing packages on Debian, never without saying so.

use std::{fs, path::PathBuf, process::Command};

use anyhow::{Context, Result, bail};

use crate::process;

/// How this user may install packages.
enum Way {
    Root,
    Sudo,
}

/// A program's path; installs the Debian package of the same name if it is missing.
pub fn program(name: &str) -> Result<PathBuf> {
    if let Some(path) = process::find_on_path(name) {
        return Ok(path);
    }
    eprintln!("{name} is missing here");
    install(&[name])?;
    process::find_on_path(name).with_context(|| format!("{name} is installed and yet not on PATH"))
}

/// Installs the packages, or says which ones the user has to install.
pub fn install(packages: &[&str]) -> Result<()> {
    let list = packages.join(" ");
    let Some(way) = way()? else {
        bail!(
            "missing Debian packages: run `apt-get install --no-install-recommends {list}` as root"
        );
    };
    eprintln!("installing Debian packages: {list}");
    let apt = |arguments: &[&str]| {
        let mut command = match way {
            Way::Root => Command::new("apt-get"),
            Way::Sudo => {
                let mut sudo = Command::new("sudo");
                // What is set for `sudo` itself does not reach what it runs.
                sudo.args(["-n", "env", "DEBIAN_FRONTEND=noninteractive", "apt-get"]);
                sudo
            }
        };
        command
            .env("DEBIAN_FRONTEND", "noninteractive")
            .args(["-q", "-o", "Dpkg::Use-Pty=0"])
            // Another run, or the system's own, may be at it.
            .args(["-o", "DPkg::Lock::Timeout=600"])
            .args(arguments);
        process::run_to_stderr(&mut command)
    };
    apt(&["update"])?;
    let mut arguments = vec!["install", "--yes", "--no-install-recommends"];
    arguments.extend(packages);
    apt(&arguments).with_context(|| format!("installing {list}"))
}

/// Whether this is a Debian (or a descendant) on which this user may install packages.
pub fn usable() -> bool {
    matches!(way(), Ok(Some(_)))
}

fn way() -> Result<Option<Way>> {
    if !process::on_path("apt-get") || !process::on_path("dpkg") {
        return Ok(None);
    }
    Ok(if effective_user()? == 0 {
        Some(Way::Root)
    } else if process::on_path("sudo")
        && process::output(Command::new("sudo").args(["-n", "true"])).is_ok()
    {
        Some(Way::Sudo)
    } else {
        None
    })
}

/// From /proc, because the standard library does not tell.
fn effective_user() -> Result<u32> {
    let status = fs::read_to_string("/proc/self/status").context("reading /proc/self/status")?;
    status
        .lines()
        .find_map(|line| {
            line.strip_prefix("Uid:")?
                .split_whitespace()
                .nth(1)?
                .parse()
                .ok()
        })
        .context("/proc/self/status names no user")
}
