//! One run at a time in a folder: two would clear the data of each other's cases.

use std::{
    fs::{self, File, TryLockError},
    path::Path,
};

use anyhow::{Context, Result, bail};

/// Keeps other runs out of `folder`, which is made if need be, for as long as the file is open: the folder itself is
/// locked, so that nothing stays behind, however this process ends.
pub fn alone_in(folder: &Path) -> Result<File> {
    let named = |what: &str| format!("{what} {}", folder.display());
    fs::create_dir_all(folder).with_context(|| named("making"))?;
    let file = File::open(folder).with_context(|| named("opening"))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => bail!(
            "another run is at work in {}: start this one again when that has ended",
            folder.display()
        ),
        Err(TryLockError::Error(error)) => Err(error).with_context(|| named("locking")),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    #[test]
    fn a_folder_has_one_run_at_a_time() {
        let folder = tempfile::tempdir().unwrap();
        let [one, other] = ["one", "other"].map(|name| folder.path().join(name));
        let first = alone_in(&one).unwrap();
        let refused = format!("{:#}", alone_in(&one).unwrap_err());
        assert!(refused.contains(one.to_str().unwrap()), "{refused}");
        assert!(alone_in(&other).is_ok());
        // Not dropped: a child of another test may have inherited it for a moment.
        first.unlock().unwrap();
        assert!(alone_in(&one).is_ok());
    }
}
