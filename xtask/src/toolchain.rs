//! The compiler for the board: rustup's target where it is or can be had, else Debian's compiler (docs/toolchain.md).

use std::{
    ffi::OsString,
    fs,
    path::{Path, PathBuf},
    process::Command,
    time::Duration,
};

use anyhow::{Context, Result, bail};

use crate::{apt, process, sysroot, workspace::Workspace};

/// The board's target.
pub const TARGET: &str = "thumbv7em-none-eabihf";

/// Where Debian's compiler lives; `/usr/bin` goes first on PATH when it is used, before rustup's proxies.
const DEBIAN_BIN: &str = "/usr/bin";
const DEBIAN_LIBRARY_SOURCES: &str = "/usr/lib/rustlib/src/rust/library/core/src/lib.rs";
/// The Rust that Debian ships for building its browsers: a current one, where plain `rustc` is years old.
const DEBIAN_PACKAGES: [&str; 7] = [
    "rustc-web",
    "cargo-web",
    "rust-web-src",
    "rust-web-clippy",
    "rustfmt-web",
    "rust-web-llvm",
    "binutils-arm-none-eabi",
];
/// Minor number of the newest stable compiler, 1.x, that the checks have been run with. A newer one knows other lints and makes an
/// image of another size, which is no fault of the code: what it says is shown, and fails nothing.
const NEWEST_CHECKED: u32 = 99;
/// A target download takes seconds; a network that answers nothing must not hold up a test run.
const DOWNLOAD_LIMIT: Duration = Duration::from_secs(120);

/// A compiler that builds for [`TARGET`].
pub struct Toolchain {
    origin: Origin,
    root: PathBuf,
    target_dir: PathBuf,
    encoded_flags: OsString,
    /// Whether the checks have been run with this compiler: a limit that follows from what it makes holds then.
    pub is_checked: bool,
}

enum Origin {
    /// The user's own, which has the target.
    Own,
    /// Debian's, with the library built here.
    Debian,
}

/// The first that is there of: the user's own compiler with the target, that target downloaded, Debian's compiler,
/// Debian's compiler installed.
pub fn choose(workspace: &Workspace) -> Result<Toolchain> {
    if own_has_target(workspace)? {
        return own(workspace);
    }
    let failed_before = workspace
        .target_dir
        .join("xtask")
        .join("target-not-downloadable");
    let stamp = rustc_version(&mut own_rustc(workspace))?;
    if fs::read_to_string(&failed_before).is_ok_and(|text| text == stamp) {
        // Not asked again for the same compiler: a network without that server stays so. `cargo xtask setup` asks again.
    } else if add_target(workspace) && own_has_target(workspace)? {
        return own(workspace);
    } else {
        write(&failed_before, &stamp)?;
    }
    if debian_missing().is_some() {
        install_debian()?;
    }
    debian(workspace)
}

/// As [`choose`], but tries a download that failed before once more.
pub fn choose_again(workspace: &Workspace) -> Result<Toolchain> {
    let failed_before = workspace
        .target_dir
        .join("xtask")
        .join("target-not-downloadable");
    if failed_before.exists() {
        fs::remove_file(&failed_before)
            .with_context(|| format!("removing {}", failed_before.display()))?;
    }
    choose(workspace)
}

impl Toolchain {
    /// `cargo` for the board; the caller adds the subcommand and its package.
    pub fn cargo(&self, subcommand: &str) -> Command {
        let mut command = match self.origin {
            Origin::Own => {
                Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()))
            }
            Origin::Debian => debian_cargo(),
        };
        process::forget_outer_package(&mut command);
        command
            .current_dir(&self.root)
            .env_remove("RUSTFLAGS")
            .env("CARGO_ENCODED_RUSTFLAGS", &self.encoded_flags)
            .args([subcommand, "--target", TARGET, "--release", "--target-dir"])
            .arg(&self.target_dir);
        command
    }

    /// For people.
    pub fn describe(&self) -> String {
        match self.origin {
            Origin::Own => format!("this one, which has {TARGET}"),
            Origin::Debian => format!(
                "Debian's {DEBIAN_BIN}/rustc; target files in {}",
                self.target_dir.display()
            ),
        }
    }
}

/// Debian's cargo with Debian's compiler and nothing of the outer one.
pub fn debian_cargo() -> Command {
    let mut command = Command::new(Path::new(DEBIAN_BIN).join("cargo"));
    process::forget_outer_compiler(&mut command);
    let mut path = OsString::from(DEBIAN_BIN);
    if let Some(rest) = std::env::var_os("PATH") {
        path.push(":");
        path.push(rest);
    }
    command.env("PATH", path);
    command
}

/// `rustc -vV` of Debian's compiler.
pub fn debian_version() -> Result<String> {
    rustc_version(&mut debian_rustc())
}

fn debian_rustc() -> Command {
    let mut command = Command::new(Path::new(DEBIAN_BIN).join("rustc"));
    process::forget_outer_compiler(&mut command);
    command
}

fn own_rustc(workspace: &Workspace) -> Command {
    let mut command = Command::new(std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into()));
    process::forget_outer_package(&mut command);
    command.current_dir(&workspace.root);
    command
}

/// Whether the checks have been run with the host's compiler.
pub fn host_is_checked(workspace: &Workspace) -> Result<bool> {
    is_checked(&rustc_version(&mut own_rustc(workspace))?)
}

/// Of `rustc -vV`.
fn is_checked(version: &str) -> Result<bool> {
    let minor = version
        .lines()
        .find_map(|line| line.strip_prefix("release: 1.")?.split('.').next())
        .and_then(|minor| minor.parse::<u32>().ok())
        .with_context(|| format!("`rustc -vV` names no release 1.x: {version:?}"))?;
    Ok(minor <= NEWEST_CHECKED)
}

/// Says that what follows does not fail a run.
pub fn remark_unchecked(what: &str) {
    println!(
        "   the compiler is newer than 1.{NEWEST_CHECKED}, the newest that has been checked: {what}"
    );
}

fn rustc_version(rustc: &mut Command) -> Result<String> {
    process::output(rustc.arg("-vV"))
}

/// Whether the library for the board is among the compiler's own files.
fn own_has_target(workspace: &Workspace) -> Result<bool> {
    let folder = process::output(own_rustc(workspace).args([
        "--print",
        "target-libdir",
        "--target",
        TARGET,
    ]))?;
    let Ok(entries) = fs::read_dir(folder.trim()) else {
        return Ok(false);
    };
    Ok(entries
        .flatten()
        .any(|entry| entry.file_name().to_string_lossy().starts_with("libcore-")))
}

/// `rustup target add`; `false` if there is no rustup or it could not.
fn add_target(workspace: &Workspace) -> bool {
    if !process::on_path("rustup") {
        return false;
    }
    eprintln!("{TARGET} is missing here: trying `rustup target add {TARGET}`");
    let mut rustup = Command::new("rustup");
    process::forget_outer_package(&mut rustup);
    rustup
        .current_dir(&workspace.root)
        .env("RUSTUP_MAX_RETRIES", "0")
        .env("RUST_BACKTRACE", "0")
        .args(["target", "add", TARGET]);
    let reason = match process::run_for(&mut rustup, DOWNLOAD_LIMIT) {
        Ok(finished) if finished.success => return true,
        Ok(finished) => finished
            .stderr
            .lines()
            .find_map(|line| line.strip_prefix("error: "))
            .unwrap_or("it failed")
            .to_owned(),
        Err(error) => format!("{error:#}"),
    };
    eprintln!("not possible ({reason}): using Debian's compiler");
    false
}

/// What of Debian's compiler is not there.
fn debian_missing() -> Option<&'static str> {
    for program in [
        "rustc",
        "cargo",
        "clippy-driver",
        "cargo-clippy",
        "rust-lld",
    ] {
        if !process::is_program(&Path::new(DEBIAN_BIN).join(program)) {
            return Some(program);
        }
    }
    (!Path::new(DEBIAN_LIBRARY_SOURCES).exists()).then_some("the library's sources")
}

fn install_debian() -> Result<()> {
    let both_ways = format!(
        "no compiler for {TARGET}: either `rustup target add {TARGET}`, or on Debian, as root, \
         `apt-get install --no-install-recommends {} lld-22`",
        DEBIAN_PACKAGES.join(" ")
    );
    if !apt::usable() {
        bail!("{both_ways}");
    }
    apt::install(&DEBIAN_PACKAGES).context(both_ways.clone())?;
    // `rust-lld` is a link into the package of the linker with this compiler's LLVM version.
    let version = debian_version()?;
    let llvm = version
        .lines()
        .find_map(|line| line.strip_prefix("LLVM version: ")?.split('.').next())
        .context("`rustc -vV` names no LLVM version")?;
    apt::install(&[&format!("lld-{llvm}")]).context(both_ways.clone())?;
    match debian_missing() {
        None => Ok(()),
        Some(what) => bail!(
            "Debian's packages are installed, yet {what} is missing in {DEBIAN_BIN}. {both_ways}"
        ),
    }
}

fn own(workspace: &Workspace) -> Result<Toolchain> {
    Ok(Toolchain {
        origin: Origin::Own,
        root: workspace.root.clone(),
        target_dir: workspace.target_dir.clone(),
        encoded_flags: encode(&path_flags(workspace)),
        is_checked: host_is_checked(workspace)?,
    })
}

fn debian(workspace: &Workspace) -> Result<Toolchain> {
    // Apart from the host's files: two compilers in one folder would rebuild each other's.
    let target_dir = workspace.target_dir.join("debian");
    let sysroot = sysroot::build(&target_dir)?;
    let mut flags = path_flags(workspace);
    flags.push("--sysroot".into());
    flags.push(sysroot.into());
    Ok(Toolchain {
        origin: Origin::Debian,
        root: workspace.root.clone(),
        target_dir,
        encoded_flags: encode(&flags),
        is_checked: is_checked(&debian_version()?)?,
    })
}

/// No path of the machine that built it may be in an image: not in panic messages, not in debug information. The last
/// rule that fits wins, so the checkout comes first and what may lie within it later.
fn path_flags(workspace: &Workspace) -> Vec<OsString> {
    let mut flags = vec![
        remap(&workspace.root, "."),
        remap(&workspace.target_dir, "target"),
    ];
    let Some(home) = cargo_home() else {
        return flags;
    };
    flags.push(remap(&home, "/cargo"));
    // One folder for each package host, named after it. The one in use is there: this command's own dependencies are.
    let mut hosts: Vec<PathBuf> = fs::read_dir(home.join("registry/src"))
        .into_iter()
        .flatten()
        .flatten()
        .map(|entry| entry.path())
        .collect();
    hosts.sort();
    flags.extend(hosts.iter().map(|host| remap(host, "/cargo/registry")));
    flags
}

/// Where cargo keeps the sources of dependencies.
pub fn cargo_home() -> Option<PathBuf> {
    match std::env::var_os("CARGO_HOME") {
        Some(home) => Some(home.into()),
        None => Some(Path::new(&std::env::var_os("HOME")?).join(".cargo")),
    }
}

/// `--remap-path-prefix FROM=TO` as one flag.
pub fn remap(from: &Path, to: &str) -> OsString {
    let mut flag = OsString::from("--remap-path-prefix=");
    flag.push(from);
    flag.push("=");
    flag.push(to);
    flag
}

/// Cargo's own form of a list of flags, in which a flag may have spaces.
pub fn encode(flags: &[OsString]) -> OsString {
    flags.join(&OsString::from("\u{1f}"))
}

fn write(path: &Path, text: &str) -> Result<()> {
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder).with_context(|| format!("creating {}", folder.display()))?;
    }
    fs::write(path, text).with_context(|| format!("writing {}", path.display()))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn a_compiler_is_checked_up_to_the_newest_that_was_tried() {
        let version = |release: &str| {
            format!("rustc {release} (0123 2026-01-01)\nbinary: rustc\nrelease: {release}\n")
        };
        assert!(is_checked(&version("1.95.0")).unwrap());
        assert!(is_checked(&version(&format!("1.{NEWEST_CHECKED}.1"))).unwrap());
        assert!(!is_checked(&version(&format!("1.{}.0-nightly", NEWEST_CHECKED + 1))).unwrap());
        for unreadable in ["", "release: ", "release: 2.0.0", "release: 1.x.0"] {
            let error = is_checked(unreadable).unwrap_err().to_string();
            assert!(error.contains("release"), "{error}");
        }
    }

    #[test]
    fn flags_keep_their_spaces() {
        let flags = [
            remap(Path::new("/home/a b"), "."),
            "--sysroot".into(),
            "/x".into(),
        ];
        assert_eq!(
            encode(&flags),
            "--remap-path-prefix=/home/a b=.\u{1f}--sysroot\u{1f}/x"
        );
    }
}
