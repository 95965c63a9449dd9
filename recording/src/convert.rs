//! Any file that a recording can come from, told by its first bytes.

use std::{
    fs::File,
    io::{self, BufRead, BufReader, Read},
    path::Path,
};

use crate::{
    csv,
    dbc::{Database, Decoded, Decoder},
    error::{Error, Kind, Place, Result, quoted},
    log::{self, Counts},
    mapping::Mapping,
    mdf,
    merge::Merged,
    output::Columns,
    parquet,
    series::Recording,
    table::Table,
};

/// What kind of file it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// The canonical CSV.
    Csv,
    /// `candump -L`.
    Candump,
    /// Vector's ASCII log.
    Asc,
    /// Vector's binary log.
    Blf,
    /// ASAM MDF 4.
    Mdf,
    /// Parquet with the canonical columns.
    Parquet,
}

impl Format {
    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Csv => "CSV",
            Self::Candump => "candump log",
            Self::Asc => "Vector ASC",
            Self::Blf => "Vector BLF",
            Self::Mdf => "ASAM MDF",
            Self::Parquet => "Parquet",
        }
    }

    /// Told by the first bytes of a file, and by its name where those leave it open.
    pub fn of(path: &Path, start: &[u8]) -> Self {
        let text = start.trim_ascii_start();
        let word = |word: &str| {
            text.get(..word.len())
                .is_some_and(|start| start.eq_ignore_ascii_case(word.as_bytes()))
        };
        let ending = path.extension().and_then(|ending| ending.to_str());
        let ending = ending.map(str::to_ascii_lowercase);
        if start.starts_with(b"LOGG") {
            Self::Blf
        } else if start.starts_with(b"MDF  ") || start.starts_with(b"UnFinMF ") {
            Self::Mdf
        } else if start.starts_with(b"PAR1") {
            Self::Parquet
        } else if text.starts_with(b"(") {
            Self::Candump
        } else if word("date ") || word("base ") || ending.as_deref() == Some("asc") {
            Self::Asc
        } else if ending.as_deref() == Some("blf") {
            Self::Blf
        } else if matches!(ending.as_deref(), Some("mf4" | "mdf")) {
            Self::Mdf
        } else if ending.as_deref() == Some("parquet") {
            Self::Parquet
        } else {
            Self::Csv
        }
    }
}

/// Bytes at a file's start that tell its format.
const TOLD_BY: u64 = 16;

/// How a file is to be read.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// What its frames mean.
    pub database: Option<Database>,
    /// The bus to take where a log has several.
    pub bus: Option<String>,
    /// Names for columns.
    pub mapping: Mapping,
}

/// A file as columns.
#[derive(Debug)]
pub struct Converted {
    /// What it was.
    pub format: Format,
    /// The log's frames and events, where it has any.
    pub counts: Option<(Counts, Decoded)>,
    /// Channels of a measurement that could not be read, and why.
    pub left_out: Vec<String>,
    /// What was read otherwise than it stands in the file.
    pub notes: Vec<String>,
    content: Content,
}

#[derive(Debug)]
enum Content {
    Table(Table),
    Merged(Merged),
}

impl Converted {
    /// The columns, to be written.
    pub fn columns(&self) -> &dyn Columns {
        match &self.content {
            Content::Table(table) => table,
            Content::Merged(merged) => merged,
        }
    }
}

/// Reads a file of any known format; `progress` is told the share done, 0 … 1.
pub fn read(path: &Path, options: &Options, progress: &mut dyn FnMut(f64)) -> Result<Converted> {
    let source = path.display().to_string();
    let fault = |error: &io::Error| Error::reading(path, error);
    let file = File::open(path).map_err(|error| fault(&error))?;
    let size = file.metadata().map_err(|error| fault(&error))?.len();
    let mut reader = BufReader::with_capacity(
        1 << 16,
        Watched {
            file,
            done: 0,
            size,
            progress,
        },
    );
    let start = reader.fill_buf().map_err(|error| fault(&error))?;
    if start.is_empty() {
        return Err(Error::new(
            Kind::Empty,
            source,
            Place::default(),
            "an empty file",
            "a log or a recording",
        ));
    }
    let format = Format::of(path, start);
    let log = match format {
        Format::Csv | Format::Mdf | Format::Parquet => {
            let mut bytes = Vec::new();
            reader
                .read_to_end(&mut bytes)
                .map_err(|error| fault(&error))?;
            if format == Format::Mdf {
                return from_mdf(&source, &bytes, options);
            }
            let table = if format == Format::Parquet {
                parquet::parse(&source, bytes)?
            } else {
                csv::parse(&source, &bytes)?
            };
            let replaced = replaced(&options.mapping, &table);
            let recording = table.mapped(&options.mapping)?.into_recording()?;
            let mut left_out = recording.table().left_out();
            left_out.extend(replaced);
            return Ok(Converted {
                format,
                counts: None,
                left_out,
                notes: recording.table().notes().to_vec(),
                content: Content::Table(recording.into_table()),
            });
        }
        Format::Candump => log::candump::read,
        Format::Asc => log::asc::read,
        Format::Blf => log::blf::read,
    };
    // A log of candump has the clock of its computer: seconds since 1970, which would leave few digits.
    let mut decoder = Decoder::new(
        database(&source, format, options)?,
        &source,
        options.bus.as_deref(),
        format == Format::Candump,
    );
    let bus = options.bus.as_deref();
    let counts = log(&source, bus, reader, &mut |frame| decoder.frame(frame))?;
    let (series, decoded) = decoder.finish()?;
    let merged = Merged::new(&source, series)?;
    Ok(Converted {
        format,
        counts: Some((counts, decoded)),
        left_out: replaced(&options.mapping, &merged),
        notes: Vec::new(),
        content: Content::Merged(merged.mapped(&options.mapping)?),
    })
}

/// Columns whose names the mapping gives to others, and that get no name themselves.
fn replaced(mapping: &Mapping, columns: &dyn Columns) -> Vec<String> {
    let names = columns.names();
    let plain = |from: &str| from.strip_prefix('-').unwrap_or(from).to_owned();
    mapping
        .pairs()
        .filter(|(to, _)| names.contains(to))
        .filter(|(to, _)| mapping.pairs().all(|(_, from)| plain(from) != *to))
        .map(|(to, from)| format!("{to} ({} has its name now)", plain(from)))
        .collect()
}

/// Measured signals and logged frames of one file, merged.
fn from_mdf(source: &str, bytes: &[u8], options: &Options) -> Result<Converted> {
    let contents = mdf::read(source, options.bus.as_deref(), bytes)?;
    let mut series = contents.series;
    let mut counts = None;
    if !contents.frames.is_empty() {
        let database = database(source, Format::Mdf, options)?;
        let mut decoder = Decoder::new(database, source, options.bus.as_deref(), false);
        contents.frames.give(&mut |frame| decoder.frame(frame))?;
        let (decoded_series, decoded) = decoder.finish()?;
        series.extend(decoded_series);
        counts = Some((contents.counts, decoded));
    }
    let merged = Merged::new(source, series)?.counted_from_its_start();
    let merged = merged.leaving_out(contents.left_out.clone());
    let mut left_out = contents.left_out;
    left_out.extend(replaced(&options.mapping, &merged));
    Ok(Converted {
        format: Format::Mdf,
        counts,
        left_out,
        notes: Vec::new(),
        content: Content::Merged(merged.mapped(&options.mapping)?),
    })
}

fn database<'a>(source: &str, format: Format, options: &'a Options) -> Result<&'a Database> {
    options.database.as_ref().ok_or_else(|| {
        Error::new(
            Kind::Mapping,
            source,
            Place::default(),
            format!("CAN frames ({})", format.name()),
            "a DBC that says what they mean",
        )
    })
}

/// A file that tells how far it has been read.
struct Watched<'a> {
    file: File,
    done: u64,
    size: u64,
    progress: &'a mut dyn FnMut(f64),
}

impl Read for Watched<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let count = self.file.read(buffer)?;
        self.done += count as u64;
        (self.progress)(self.done as f64 / self.size.max(1) as f64);
        Ok(count)
    }
}

/// Writes columns to a file of the kind that its name ends in.
pub fn write(path: &Path, columns: &dyn Columns, progress: &mut dyn FnMut(f64)) -> Result<()> {
    if is_parquet(path)? {
        parquet::write(path, columns, progress)
    } else {
        csv::write(path, columns, progress)
    }
}

/// Whether a file of this name is written as Parquet and not as CSV; the error says that it is neither. To be asked
/// before a long log is read.
pub fn is_parquet(path: &Path) -> Result<bool> {
    let ending = path.extension().and_then(|ending| ending.to_str());
    match ending {
        Some("csv") => return Ok(false),
        Some("parquet") => return Ok(true),
        // A pipe or a terminal takes CSV.
        _ if path.exists() && !path.is_file() && !path.is_dir() => return Ok(false),
        _ => {}
    }
    let found = ending.map_or_else(
        || "a name without an ending".to_owned(),
        |ending| quoted(&format!(".{ending}")),
    );
    Err(Error::new(
        Kind::Unsupported,
        path.display().to_string(),
        Place::default(),
        found,
        ".csv or .parquet",
    ))
}

/// Reads a recording in either canonical form, CSV or Parquet.
pub fn recording(path: &Path, mapping: &Mapping) -> Result<Recording> {
    table(path)?.mapped(mapping)?.into_recording()
}

/// The same without a look at its time. A log is refused by its name. Opened once: a pipe can be read from its start only then.
pub fn table(path: &Path) -> Result<Table> {
    let source = path.display().to_string();
    let mut bytes = Vec::new();
    let reading = |error: io::Error| Error::reading(path, &error);
    let mut file = File::open(path).map_err(reading)?;
    Read::take(&mut file, TOLD_BY)
        .read_to_end(&mut bytes)
        .map_err(reading)?;
    let ending = path.extension().and_then(|ending| ending.to_str());
    let format = match Format::of(path, &bytes) {
        // An empty file is told by the reader of CSV, and a name of a column may begin as a log does.
        Format::Candump | Format::Asc if bytes.is_empty() || ending == Some("csv") => Format::Csv,
        format => format,
    };
    if !matches!(format, Format::Csv | Format::Parquet) {
        return Err(Error::new(
            Kind::Unsupported,
            source,
            Place::default(),
            format!("a log ({})", format.name()),
            "a recording as CSV or Parquet: `twin convert` makes one of it",
        ));
    }
    file.read_to_end(&mut bytes).map_err(reading)?;
    if format == Format::Parquet {
        parquet::parse(&source, bytes)
    } else {
        csv::parse(&source, &bytes)
    }
}
