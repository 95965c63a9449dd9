//! Parquet with the columns of the canonical CSV: one flat column of numbers each, null or NaN for a missing value. A column
//! of timestamps counts from its first one, in s.

use std::{
    fs,
    io::{self, Read, Write},
    panic::{self, AssertUnwindSafe},
    path::Path,
    sync::Arc,
};

use ::parquet::{
    basic::{Compression, ConvertedType, LogicalType, Repetition, TimeUnit, Type as Physical},
    column::reader::{ColumnReader, ColumnReaderImpl},
    data_type::{DataType, DoubleType},
    errors::ParquetError,
    file::{
        metadata::ColumnChunkMetaData,
        properties::WriterProperties,
        reader::{ChunkReader, FileReader, Length, SerializedFileReader},
        writer::SerializedFileWriter,
    },
    schema::types::{ColumnDescriptor, Type},
};
use bytes::{Buf, Bytes, buf};

use crate::{
    error::{Error, Kind, Place, Result, quoted},
    output::{Columns, WholeFile},
    table::{LeftOut, Table},
};

/// Rows that are written, and read, at once.
const GROUP: usize = 1 << 17;

/// Reads a table; columns that hold no numbers are left out.
pub fn read(path: &Path) -> Result<Table> {
    let bytes = fs::read(path).map_err(|error| Error::reading(path, &error))?;
    parse(&path.display().to_string(), bytes)
}

/// Reads a table from memory; `source` is what messages call it.
pub fn parse(source: &str, bytes: Vec<u8>) -> Result<Table> {
    // The crate panics at some damaged pages ("Decoder for dict should have been set"): that is an error of the file too.
    panic::catch_unwind(AssertUnwindSafe(|| parse_or_panic(source, bytes))).unwrap_or_else(|_| {
        Err(Error::new(
            Kind::Format,
            source,
            Place::default(),
            "damaged pages",
            "a Parquet file",
        ))
    })
}

fn parse_or_panic(source: &str, bytes: Vec<u8>) -> Result<Table> {
    let refused = |error: ParquetError| {
        let kind = match error {
            ParquetError::NYI(_) => Kind::Unsupported,
            _ => Kind::Format,
        };
        Error::new(
            kind,
            source,
            Place::default(),
            quoted(&error.to_string()),
            "a Parquet file",
        )
    };
    let size = bytes.len();
    let file = SerializedFileReader::new(Whole(Bytes::from(bytes))).map_err(refused)?;
    let schema = file.metadata().file_metadata().schema_descr();
    let mut columns: Vec<(String, Vec<f64>)> = Vec::new();
    let (mut positions, mut left_out) = (Vec::new(), Vec::new());
    for index in 0..schema.num_columns() {
        let column = schema.column(index);
        let name = column.path().string();
        let kind = match number(&column) {
            Ok(kind) => kind,
            Err(other) => {
                let place = Place {
                    column: Some(index + 1),
                    name: Some(name.clone()),
                    ..Place::default()
                };
                let expected = "numbers: whole ones, float, double, booleans or timestamps";
                let error = Error::new(Kind::Unsupported, source, place, other, expected);
                left_out.push(LeftOut { name, error });
                continue;
            }
        };
        let mut values = Vec::new();
        let mut origin = None;
        for group in 0..file.num_row_groups() {
            let group = file.get_row_group(group).map_err(refused)?;
            let chunk = group.metadata().column(index);
            if !inside(chunk, size) {
                return Err(Error::new(
                    Kind::Format,
                    source,
                    Place {
                        name: Some(name),
                        ..Place::default()
                    },
                    "values outside of the file",
                    "all of them inside",
                ));
            }
            let packing = chunk.compression();
            if !matches!(
                packing,
                Compression::UNCOMPRESSED | Compression::SNAPPY | Compression::GZIP(_)
            ) {
                return Err(Error::new(
                    Kind::Unsupported,
                    source,
                    Place {
                        name: Some(name),
                        ..Place::default()
                    },
                    format!("values packed by {packing}"),
                    "none, snappy or gzip",
                ));
            }
            let reader = group.get_column_reader(index).map_err(refused)?;
            let rows = group.metadata().num_rows();
            let read = column_values(reader, kind, &mut origin, &mut values).map_err(refused)?;
            if i64::try_from(read) != Ok(rows) {
                return Err(Error::new(
                    Kind::FieldCount,
                    source,
                    Place {
                        name: Some(name),
                        ..Place::default()
                    },
                    format!("{read} values in a row group"),
                    format!("{rows}, as it says"),
                ));
            }
        }
        if let Some(row) = values.iter().position(|value| value.is_infinite()) {
            let place = Place {
                row: Some(row as u64 + 1),
                column: Some(index + 1),
                name: Some(name.clone()),
                ..Place::default()
            };
            let expected = "a number, or null for a missing one";
            let error = Error::new(Kind::Infinite, source, place, "an infinite value", expected);
            left_out.push(LeftOut { name, error });
            continue;
        }
        columns.push((name, values));
        positions.push(index);
    }
    // Not one column of numbers: this is no recording.
    if let ([], Some(first)) = (columns.as_slice(), left_out.first()) {
        return Err(first.error.clone());
    }
    Ok(Table::new(source, columns)?.with_left_out(&positions, left_out))
}

/// A file in memory whose end is an error to who reads beyond it. The crate skips what it does not know in a page's header and
/// takes the end for skipped: a list of 2^31 numbers of which there is none takes minutes.
struct Whole(Bytes);

/// See [`Whole`].
struct Rest(buf::Reader<Bytes>);

impl Length for Whole {
    fn len(&self) -> u64 {
        Length::len(&self.0)
    }
}

impl ChunkReader for Whole {
    type T = Rest;

    fn get_read(&self, start: u64) -> std::result::Result<Rest, ParquetError> {
        self.0.get_read(start).map(Rest)
    }

    fn get_bytes(&self, start: u64, length: usize) -> std::result::Result<Bytes, ParquetError> {
        self.0.get_bytes(start, length)
    }
}

impl Read for Rest {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if !buffer.is_empty() && !self.0.get_ref().has_remaining() {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        self.0.read(buffer)
    }
}

/// Whether a column's piece lies inside of a file of `size` bytes: the reader takes that for granted.
fn inside(chunk: &ColumnChunkMetaData, size: usize) -> bool {
    let start = chunk
        .dictionary_page_offset()
        .unwrap_or(chunk.data_page_offset());
    let end = start.checked_add(chunk.compressed_size());
    start >= 0
        && chunk.data_page_offset() >= 0
        && chunk.compressed_size() >= 0
        && chunk.num_values() >= 0
        && end.is_some_and(|end| usize::try_from(end).is_ok_and(|end| end <= size))
}

/// How a column's numbers are meant.
#[derive(Clone, Copy, Debug)]
enum Number {
    /// As they are.
    Plain,
    /// Whole numbers without a sign.
    Unsigned,
    /// A moment, in so many parts of a second.
    Moment(f64),
}

/// How a column is read; what it holds, if that is something else, such as text, dates or lists.
fn number(column: &ColumnDescriptor) -> std::result::Result<Number, String> {
    if column.max_rep_level() > 0 {
        return Err("a list".to_owned());
    }
    if column.max_def_level() > 1 {
        return Err("a part of a structure".to_owned());
    }
    flat_number(column).ok_or_else(|| match column.logical_type_ref() {
        Some(LogicalType::String) => "text".to_owned(),
        Some(LogicalType::Decimal(_)) => "decimals".to_owned(),
        Some(LogicalType::Float16) => "numbers of the type float16".to_owned(),
        Some(LogicalType::Date) => "dates".to_owned(),
        Some(LogicalType::Time(_)) => "times of the day".to_owned(),
        Some(LogicalType::Unknown) => "nothing but null".to_owned(),
        _ => match (column.converted_type(), column.physical_type()) {
            (ConvertedType::NONE, physical) => format!("values of the type {physical}"),
            (converted, _) => format!("values of the type {converted}"),
        },
    })
}

fn flat_number(column: &ColumnDescriptor) -> Option<Number> {
    let whole = match (column.logical_type_ref(), column.converted_type()) {
        (Some(LogicalType::Integer(whole)), _) if whole.is_signed => Number::Plain,
        (Some(LogicalType::Integer(_)), _) => Number::Unsigned,
        (Some(LogicalType::Timestamp(moment)), _) => Number::Moment(match moment.unit {
            TimeUnit::MILLIS => 1e3,
            TimeUnit::MICROS => 1e6,
            TimeUnit::NANOS => 1e9,
        }),
        (Some(_), _) => return None,
        (
            None,
            ConvertedType::NONE
            | ConvertedType::INT_8
            | ConvertedType::INT_16
            | ConvertedType::INT_32
            | ConvertedType::INT_64,
        ) => Number::Plain,
        (
            None,
            ConvertedType::UINT_8
            | ConvertedType::UINT_16
            | ConvertedType::UINT_32
            | ConvertedType::UINT_64,
        ) => Number::Unsigned,
        (None, ConvertedType::TIMESTAMP_MILLIS) => Number::Moment(1e3),
        (None, ConvertedType::TIMESTAMP_MICROS) => Number::Moment(1e6),
        _ => return None,
    };
    matches!(
        column.physical_type(),
        Physical::BOOLEAN | Physical::INT32 | Physical::INT64 | Physical::FLOAT | Physical::DOUBLE
    )
    .then_some(whole)
}

/// Appends a column's values, NaN for null, and says how many. Moments count from `origin`, the first one: as a number of
/// seconds since 1970 they would have few digits left.
fn column_values(
    reader: ColumnReader,
    kind: Number,
    origin: &mut Option<i64>,
    values: &mut Vec<f64>,
) -> std::result::Result<usize, ParquetError> {
    match (reader, kind) {
        (ColumnReader::BoolColumnReader(reader), _) => {
            append(reader, values, |&value| f64::from(u8::from(value)))
        }
        (ColumnReader::Int64ColumnReader(reader), Number::Moment(parts)) => {
            append(reader, values, |&value| {
                let since = i128::from(value) - i128::from(*origin.get_or_insert(value));
                since as f64 / parts
            })
        }
        (ColumnReader::Int32ColumnReader(reader), Number::Plain) => {
            append(reader, values, |&value| f64::from(value))
        }
        (ColumnReader::Int32ColumnReader(reader), Number::Unsigned) => {
            append(reader, values, |&value| f64::from(value.cast_unsigned()))
        }
        (ColumnReader::Int64ColumnReader(reader), Number::Plain) => {
            append(reader, values, |&value| value as f64)
        }
        (ColumnReader::Int64ColumnReader(reader), Number::Unsigned) => {
            append(reader, values, |&value| value.cast_unsigned() as f64)
        }
        (ColumnReader::FloatColumnReader(reader), _) => {
            append(reader, values, |&value| f64::from(value))
        }
        (ColumnReader::DoubleColumnReader(reader), _) => append(reader, values, |&value| value),
        _ => Err(ParquetError::General("a column of another type".into())),
    }
}

fn append<T: DataType>(
    mut reader: ColumnReaderImpl<T>,
    values: &mut Vec<f64>,
    mut number: impl FnMut(&T::T) -> f64,
) -> std::result::Result<usize, ParquetError> {
    let before = values.len();
    let (mut levels, mut present) = (Vec::new(), Vec::new());
    loop {
        levels.clear();
        present.clear();
        let (rows, _, _) = reader.read_records(GROUP, Some(&mut levels), None, &mut present)?;
        if rows == 0 {
            return Ok(values.len() - before);
        }
        let mut present = present.iter().map(&mut number);
        if levels.is_empty() {
            values.extend(present);
        } else {
            // A level of 1 is a value, one of 0 is null.
            values.extend(levels.iter().map(|&level| {
                let value = if level > 0 { present.next() } else { None };
                value.unwrap_or(f64::NAN)
            }));
        }
    }
}

/// Writes whole columns; `progress` is told the share done, 0 … 1.
pub fn write(path: &Path, columns: &dyn Columns, progress: &mut dyn FnMut(f64)) -> Result<()> {
    let refused = |error: ParquetError| {
        Error::new(
            Kind::Io,
            path.display().to_string(),
            Place::default(),
            quoted(&error.to_string()),
            "a file that can be written",
        )
    };
    let names = columns.names();
    if let Some(column) = names.iter().position(|name| name.is_empty()) {
        return Err(Error::new(
            Kind::ColumnName,
            path.display().to_string(),
            Place {
                column: Some(column + 1),
                ..Place::default()
            },
            "a column without a name",
            "a name for each column",
        ));
    }
    let fields = names.iter().map(|name| {
        let field = Type::primitive_type_builder(name, Physical::DOUBLE);
        field
            .with_repetition(Repetition::OPTIONAL)
            .build()
            .map(Arc::new)
    });
    let fields: Vec<_> = fields
        .collect::<std::result::Result<_, _>>()
        .map_err(refused)?;
    let schema = Type::group_type_builder("recording")
        .with_fields(fields)
        .build()
        .map_err(refused)?;
    // Snappy is what every reader has.
    let properties = WriterProperties::builder()
        .set_compression(Compression::SNAPPY)
        .build();
    let file = WholeFile::create(path)?;
    let mut writer =
        SerializedFileWriter::new(file, Arc::new(schema), Arc::new(properties)).map_err(refused)?;
    let rows = columns.rows();
    let (mut values, mut levels) = (Vec::new(), Vec::new());
    for first in (0..rows).step_by(GROUP) {
        let mut group = writer.next_row_group().map_err(refused)?;
        let mut column = 0;
        while let Some(mut chunk) = group.next_column().map_err(refused)? {
            let length = GROUP.min(rows - first);
            let share = column as f64 / names.len() as f64;
            progress((first as f64 + share * length as f64) / rows as f64);
            values.resize(length, 0.0);
            columns.fill(column, first, &mut values);
            if let Some(row) = values.iter().position(|value: &f64| value.is_infinite()) {
                return Err(Error::new(
                    Kind::Infinite,
                    path.display().to_string(),
                    Place {
                        row: Some((first + row) as u64 + 1),
                        column: Some(column + 1),
                        name: names.get(column).map(|&name| name.to_owned()),
                        ..Place::default()
                    },
                    "an infinite value",
                    "a number, or NaN for a missing one",
                ));
            }
            levels.clear();
            levels.extend(values.iter().map(|value| i16::from(!value.is_nan())));
            values.retain(|value| !value.is_nan());
            chunk
                .typed::<DoubleType>()
                .write_batch(&values, Some(&levels), None)
                .map_err(refused)?;
            chunk.close().map_err(refused)?;
            column += 1;
        }
        group.close().map_err(refused)?;
    }
    let mut file = writer.into_inner().map_err(refused)?;
    file.flush().map_err(|error| Error::writing(path, &error))?;
    file.finish()
}
