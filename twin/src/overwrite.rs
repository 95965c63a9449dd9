//! No command writes over what it reads.

use std::{fs, path::Path};

use crate::failure::Failure;

/// Refuses a file that is read as one to be written. `read` are the files with the arguments that they are given by. Names
/// are compared by what they lead to; a pipe or a terminal is nothing that could be lost.
pub fn refuse<'a>(
    written: &Path,
    read: impl IntoIterator<Item = (&'a str, &'a Path)>,
) -> Result<(), Failure> {
    if !written.is_file() {
        return Ok(());
    }
    let Ok(there) = fs::canonicalize(written) else {
        return Ok(());
    };
    for (argument, path) in read {
        if fs::canonicalize(path).is_ok_and(|path| path == there) {
            return Err(Failure::Input(format!(
                "{}: found the file that is read as {argument}, expected another place to write to",
                written.display()
            )));
        }
    }
    Ok(())
}
