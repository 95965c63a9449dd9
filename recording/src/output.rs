//! Files that are there whole or not at all.

use std::{
    ffi::OsString,
    fs::{self, File},
    io::{self, BufWriter, Seek, SeekFrom, Write},
    path::{Path, PathBuf},
};

use tempfile::NamedTempFile;

use crate::error::{Error, Result};

/// Columns that can be written out a block of rows at a time, so that they need not be there all at once.
pub trait Columns {
    /// Names of the columns.
    fn names(&self) -> Vec<&str>;
    /// Number of rows.
    fn rows(&self) -> usize;
    /// The values of a column (by its place among the names) from row `first` on, NaN where one is missing.
    fn fill(&self, column: usize, first: usize, values: &mut [f64]);
}

/// A file under construction: it gets its name when it is finished, and is removed when it is dropped before.
#[derive(Debug)]
pub struct WholeFile {
    path: PathBuf,
    target: BufWriter<Target>,
}

#[derive(Debug)]
enum Target {
    /// Beside the place where it belongs, so that renaming it is one step.
    Beside(NamedTempFile, PathBuf),
    /// A pipe or a terminal: cannot be replaced.
    Stream(File),
}

impl WholeFile {
    /// Begins a file that will be at `path`; what is there now stays until `finish`.
    pub fn create(path: &Path) -> Result<Self> {
        let fault = |error: &io::Error| Error::writing(path, error);
        let target = match fs::metadata(path) {
            Ok(metadata) if metadata.is_dir() => {
                return Err(fault(&io::ErrorKind::IsADirectory.into()));
            }
            Ok(metadata) if !metadata.is_file() => Target::Stream(
                File::options()
                    .write(true)
                    .open(path)
                    .map_err(|error| fault(&error))?,
            ),
            there => {
                // A symbolic link stays, what it points to is replaced.
                let place = if there.is_ok() {
                    fs::canonicalize(path).map_err(|error| fault(&error))?
                } else {
                    path.to_owned()
                };
                beside(&place).map_err(|error| fault(&error))?
            }
        };
        Ok(Self {
            path: path.to_owned(),
            target: BufWriter::with_capacity(1 << 16, target),
        })
    }

    /// Where it will be.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Everything is written: the file appears under its name.
    pub fn finish(self) -> Result<()> {
        let Self { path, target } = self;
        let fault = |error: &io::Error| Error::writing(&path, error);
        let target = target
            .into_inner()
            .map_err(|error| fault(&error.into_error()))?;
        match target {
            Target::Beside(file, place) => {
                file.persist(place).map_err(|error| fault(&error.error))?;
            }
            Target::Stream(mut file) => file.flush().map_err(|error| fault(&error))?,
        }
        Ok(())
    }

    /// The error of this file for what the system said.
    pub(crate) fn fault(&self, error: &io::Error) -> Error {
        Error::writing(&self.path, error)
    }
}

fn beside(place: &Path) -> io::Result<Target> {
    let Some(name) = place.file_name() else {
        return Err(io::ErrorKind::IsADirectory.into());
    };
    let folder = match place.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    let mut prefix = OsString::from(".");
    prefix.push(name);
    let mut builder = tempfile::Builder::new();
    builder.prefix(&prefix).suffix(".part");
    // A temporary file is for its owner only; this one will be a file like any other.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    Ok(Target::Beside(
        builder.tempfile_in(folder)?,
        place.to_owned(),
    ))
}

impl Write for Target {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self {
            Self::Beside(file, _) => file.write(bytes),
            Self::Stream(file) => file.write(bytes),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        match self {
            Self::Beside(file, _) => file.flush(),
            Self::Stream(file) => file.flush(),
        }
    }
}

impl Seek for Target {
    fn seek(&mut self, position: SeekFrom) -> io::Result<u64> {
        match self {
            Self::Beside(file, _) => file.seek(position),
            Self::Stream(file) => file.seek(position),
        }
    }
}

impl Write for WholeFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.target.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.target.flush()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

    use super::*;
    use crate::error::Kind;

    #[test]
    fn appears_only_when_finished() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.csv");
        fs::write(&path, "before").unwrap();

        let mut file = WholeFile::create(&path).unwrap();
        file.write_all(b"half").unwrap();
        file.flush().unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "before");
        drop(file);
        assert_eq!(fs::read_to_string(&path).unwrap(), "before");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);

        let mut file = WholeFile::create(&path).unwrap();
        file.write_all(b"whole").unwrap();
        file.finish().unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "whole");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[cfg(unix)]
    #[test]
    fn others_may_read_it_as_any_new_file() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let (ours, plain) = (folder.path().join("a"), folder.path().join("b"));
        WholeFile::create(&ours).unwrap().finish().unwrap();
        fs::write(&plain, "").unwrap();
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode();
        assert_eq!(mode(&ours), mode(&plain));
    }

    #[test]
    fn names_the_place_it_cannot_write() {
        let folder = tempfile::tempdir().unwrap();
        for path in [folder.path().join("no/such/a.csv"), folder.path().into()] {
            let error = WholeFile::create(&path).unwrap_err();
            assert_eq!(error.kind(), Kind::Io);
            assert_eq!(error.file(), path.display().to_string());
        }
    }
}
