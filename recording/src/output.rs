//! Files that are there whole or not at all.

use std::{
    ffi::OsString,
    fs::{self, File},
    io::{self, BufWriter, Seek, SeekFrom, Write},
    path::{Path, PathBuf},
    sync::{Mutex, MutexGuard, PoisonError},
};

use tempfile::NamedTempFile;

use crate::error::{Error, Kind, Place, Result, quoted};

/// Refuses a file that is read as one to be written. `read` are the files with the arguments that they are given by. Names
/// are compared by what they lead to; a pipe or a terminal is nothing that could be lost.
pub fn refuse_overwrite<'a>(
    written: &Path,
    read: impl IntoIterator<Item = (&'a str, &'a Path)>,
) -> Result<()> {
    if !written.is_file() {
        return Ok(());
    }
    let Ok(there) = fs::canonicalize(written) else {
        return Ok(());
    };
    for (argument, path) in read {
        if fs::canonicalize(path).is_ok_and(|path| path == there) {
            return Err(Error::new(
                Kind::Overwrites,
                written.display().to_string(),
                Place::default(),
                format!("the file that is read as {argument}"),
                "another place to write to",
            ));
        }
    }
    Ok(())
}

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

/// What would stay behind if the process ended now: unfinished files, and folders that were made for them.
static UNFINISHED: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

fn unfinished() -> MutexGuard<'static, Vec<PathBuf>> {
    // A list of paths is whole after a panic too.
    UNFINISHED.lock().unwrap_or_else(PoisonError::into_inner)
}

fn forget(path: &Path) {
    let mut all = unfinished();
    if let Some(index) = all.iter().position(|known| known == path) {
        all.swap_remove(index);
    }
}

/// Removes every unfinished file, and every folder that was made for one and is empty: for a process that is about to be
/// ended by a signal, where nothing is dropped. From then on no file is begun or finished.
pub fn abandon() {
    let all = unfinished();
    // A folder was made before what is in it.
    for path in all.iter().rev() {
        let _ = fs::remove_file(path).or_else(|_| fs::remove_dir(path));
    }
    std::mem::forget(all);
}

/// Whether a file can be written at `path`, before long work is done for it; nothing stays behind. A pipe or a terminal is
/// not touched: who reads it would see its end.
pub fn check(path: &Path) -> Result<()> {
    if fs::metadata(path).is_ok_and(|there| !there.is_file() && !there.is_dir()) {
        return Ok(());
    }
    WholeFile::create(path).map(drop)
}

/// All files get their names, or none: whatever can fail by a full disk comes before the first of them does.
pub fn finish_all(mut files: Vec<WholeFile>) -> Result<()> {
    for file in &mut files {
        file.target
            .flush()
            .map_err(|error| Error::writing(&file.path, &error))?;
    }
    let mut new = Vec::new();
    for file in files {
        let path = file.path.clone();
        let is_new = !path.exists();
        if let Err(error) = file.finish() {
            for path in new {
                let _ = fs::remove_file(path);
            }
            return Err(error);
        }
        if is_new {
            new.push(path);
        }
    }
    Ok(())
}

/// A folder for results, made with those above it where they are missing. Dropped, it goes again if it was made here and
/// nothing came into it.
#[derive(Debug)]
pub struct Folder {
    path: PathBuf,
    /// The highest first.
    made: Vec<PathBuf>,
}

impl Folder {
    /// Makes the folder, unless it is there.
    pub fn make(path: &Path) -> Result<Self> {
        let mut made: Vec<PathBuf> = path
            .ancestors()
            .take_while(|folder| !folder.as_os_str().is_empty() && !folder.exists())
            .map(Path::to_owned)
            .collect();
        made.reverse();
        let mut all = unfinished();
        let folder = Self {
            path: path.to_owned(),
            made,
        };
        let done = fs::create_dir_all(path);
        if let Err(error) = done {
            drop(all);
            return Err(Error::writing(path, &error));
        }
        all.extend(folder.made.iter().cloned());
        drop(all);
        Ok(folder)
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        for folder in self.made.iter().rev() {
            // Refused where there are files in it.
            let _ = fs::remove_dir(folder);
            forget(folder);
        }
    }
}

#[derive(Debug)]
enum Target {
    /// Beside the place where it belongs, so that renaming it is one step.
    Beside(Unnamed, PathBuf),
    /// A pipe or a terminal: cannot be replaced.
    Stream(File),
}

/// A file without its name yet.
#[derive(Debug)]
struct Unnamed {
    /// There until it is named.
    file: Option<NamedTempFile>,
}

impl Unnamed {
    fn begin(builder: &tempfile::Builder<'_, '_>, folder: &Path) -> io::Result<Self> {
        let mut all = unfinished();
        let file = builder.tempfile_in(folder)?;
        all.push(file.path().to_owned());
        Ok(Self { file: Some(file) })
    }

    fn name(mut self, place: &Path) -> io::Result<()> {
        let Some(file) = self.file.take() else {
            return Ok(());
        };
        let mut all = unfinished();
        let beside = file.path().to_owned();
        let done = file.persist(place).map_err(|error| error.error);
        all.retain(|known| *known != beside);
        drop(all);
        done.map(drop)
    }

    /// The file itself: the errors of [`NamedTempFile`] tell its hidden name.
    fn file(&mut self) -> io::Result<&mut File> {
        let file = self.file.as_mut().map(NamedTempFile::as_file_mut);
        file.ok_or_else(|| io::ErrorKind::NotFound.into())
    }
}

impl Drop for Unnamed {
    fn drop(&mut self) {
        if let Some(file) = self.file.take() {
            let path = file.path().to_owned();
            drop(file);
            forget(&path);
        }
    }
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
                beside(path, &place)?
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
            Target::Beside(file, place) => file.name(&place).map_err(|error| fault(&error))?,
            Target::Stream(mut file) => file.flush().map_err(|error| fault(&error))?,
        }
        Ok(())
    }

    /// The error of this file for what the system said.
    pub(crate) fn fault(&self, error: &io::Error) -> Error {
        Error::writing(&self.path, error)
    }
}

fn beside(path: &Path, place: &Path) -> Result<Target> {
    let Some(name) = place.file_name() else {
        return Err(Error::writing(path, &io::ErrorKind::IsADirectory.into()));
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
    match Unnamed::begin(&builder, folder) {
        Ok(file) => Ok(Target::Beside(file, place.to_owned())),
        Err(_) if !folder.is_dir() => Err(Error::new(
            Kind::NotFound,
            path.display().to_string(),
            Place::default(),
            format!("no folder {}", quoted(&folder.display().to_string())),
            "one that is there",
        )),
        // Without what the error says of a hidden name that nobody asked for.
        Err(error) => Err(Error::writing(path, &error.kind().into())),
    }
}

impl Write for Target {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self {
            Self::Beside(file, _) => file.file()?.write(bytes),
            Self::Stream(file) => file.write(bytes),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        match self {
            Self::Beside(file, _) => file.file()?.flush(),
            Self::Stream(file) => file.flush(),
        }
    }
}

impl Seek for Target {
    fn seek(&mut self, position: SeekFrom) -> io::Result<u64> {
        match self {
            Self::Beside(file, _) => file.file()?.seek(position),
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
        let missing = folder.path().join("no/such/a.csv");
        for (path, kind) in [
            (missing.clone(), Kind::NotFound),
            (folder.path().into(), Kind::Io),
        ] {
            let error = WholeFile::create(&path).unwrap_err();
            assert_eq!(error.kind(), kind);
            assert_eq!(error.file(), path.display().to_string());
            assert!(check(&path).is_err());
        }
        // The folder is what is missing, and the hidden name is nobody's business.
        let text = WholeFile::create(&missing).unwrap_err().to_string();
        assert!(text.contains("found no folder"), "{text}");
        assert!(!text.contains(".part"), "{text}");
    }

    #[test]
    fn what_is_read_is_not_written() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.csv");
        refuse_overwrite(&path, [("--profile", path.as_path())]).unwrap();
        fs::write(&path, "").unwrap();
        let roundabout = folder.path().join("./a.csv");
        let error = refuse_overwrite(&path, [("--profile", roundabout.as_path())]).unwrap_err();
        assert_eq!(error.kind(), Kind::Overwrites);
        assert!(error.to_string().contains("--profile"), "{error}");
    }

    #[test]
    fn all_files_or_none() {
        let folder = tempfile::tempdir().unwrap();
        let (one, other) = (folder.path().join("a"), folder.path().join("b"));
        let begin = |path: &Path| WholeFile::create(path).unwrap();
        let files = vec![begin(&one), begin(&other)];
        // A name that cannot be taken any more.
        fs::create_dir(&other).unwrap();
        assert!(finish_all(files).is_err());
        assert!(!one.exists());
        fs::remove_dir(&other).unwrap();
        finish_all(vec![begin(&one), begin(&other)]).unwrap();
        assert!(one.is_file() && other.is_file());
    }

    #[test]
    fn a_folder_goes_with_all_that_was_made_for_it() {
        let folder = tempfile::tempdir().unwrap();
        let deep = folder.path().join("x/y/z");
        drop(Folder::make(&deep).unwrap());
        assert!(!folder.path().join("x").exists());
        let made = Folder::make(&deep).unwrap();
        fs::write(deep.join("a"), "").unwrap();
        drop(made);
        assert!(deep.join("a").exists());
    }
}
