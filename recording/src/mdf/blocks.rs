//! Blocks of an MDF 4 file and the data that hangs on them.

use std::{
    borrow::Cow,
    cell::Cell,
    collections::HashSet,
    io::{self, Read},
};

use flate2::bufread::ZlibDecoder;

use crate::error::{Error, Kind, Place, Result, quoted};

/// Identification, reserved bytes, length, number of links.
const HEADER: usize = 24;
/// Deflate packs at most so many bytes into one (zlib's technical details): more is damage.
const LARGEST_RATIO: u64 = 1_032;

/// The whole file.
pub struct File<'a> {
    pub source: &'a str,
    pub bytes: &'a [u8],
    /// Channels read so far.
    pub channels: Cell<usize>,
    /// Bytes of data read so far, packed as they are.
    pub stored: Cell<usize>,
}

/// A block: its links, and the data after them.
#[derive(Clone, Copy)]
pub struct Block<'a> {
    pub address: u64,
    pub id: [u8; 2],
    links: &'a [u8],
    pub data: &'a [u8],
}

impl<'a> Block<'a> {
    /// The address in link `index`; `None` for nil or where there is no such link.
    pub fn link(&self, index: usize) -> Option<u64> {
        let address = u64_at(self.links, index * 8);
        (address != 0).then_some(address)
    }

    pub fn links(&self) -> usize {
        self.links.len() / 8
    }
}

impl<'a> File<'a> {
    /// The block at an address, of any kind.
    pub fn block(&self, address: u64) -> Result<Block<'a>> {
        let header = usize::try_from(address)
            .ok()
            .and_then(|start| self.bytes.get(start..))
            .filter(|rest| rest.len() >= HEADER && rest.starts_with(b"##"));
        let Some(rest) = header else {
            return Err(self.fault(address, "no block", "a block of the file"));
        };
        let (length, links) = (u64_at(rest, 8), u64_at(rest, 16));
        let body = usize::try_from(length)
            .ok()
            .and_then(|length| rest.get(HEADER..length));
        let parts = body.and_then(|body| {
            let links = usize::try_from(links).ok()?.checked_mul(8)?;
            body.split_at_checked(links)
        });
        let Some((links, data)) = parts else {
            return Err(self.fault(
                address,
                &format!("a block of {length} bytes and {links} links"),
                "one that fits the file",
            ));
        };
        Ok(Block {
            address,
            id: [rest[2], rest[3]],
            links,
            data,
        })
    }

    /// The block at an address, which must be of one kind.
    pub fn block_of(&self, address: u64, id: &[u8; 2]) -> Result<Block<'a>> {
        let block = self.block(address)?;
        if block.id == *id {
            return Ok(block);
        }
        Err(self.fault(
            address,
            &format!("a block {}", name(block.id)),
            &format!("a block {}", name(*id)),
        ))
    }

    /// Blocks of one kind, each linked by the one before it in its first link.
    pub fn chain(&self, first: Option<u64>, id: &[u8; 2]) -> Result<Vec<Block<'a>>> {
        let mut blocks = Vec::new();
        let mut next = first;
        // More than the file has room for is a circle.
        let most = self.bytes.len() / HEADER;
        while let Some(address) = next {
            if blocks.len() > most {
                return Err(self.fault(address, "a chain in a circle", "one with an end"));
            }
            let block = self.block_of(address, id)?;
            next = block.link(0);
            blocks.push(block);
        }
        Ok(blocks)
    }

    /// One more channel is read. A damaged file can link one chain from many places, and chains of those again: then there
    /// are more than it has room for.
    pub fn count_channel(&self, address: u64) -> Result<()> {
        self.channels.set(self.channels.get() + 1);
        if self.channels.get() <= self.bytes.len() / HEADER {
            return Ok(());
        }
        Err(self.fault(
            address,
            "channels that are linked again and again",
            "each once",
        ))
    }

    /// The data of one more block are read. They are in the file once: what is more than it has room for is linked from
    /// many places, or lies in blocks one inside of the other.
    fn count_data(&self, block: &Block<'_>) -> Result<()> {
        self.stored.set(self.stored.get() + block.data.len());
        if self.stored.get() <= self.bytes.len() {
            return Ok(());
        }
        Err(self.fault(
            block.address,
            "data that are linked again and again",
            "each once",
        ))
    }

    /// The text of a TX block, or the text inside an MD block's XML.
    pub fn text(&self, address: Option<u64>) -> Result<String> {
        let Some(address) = address else {
            return Ok(String::new());
        };
        let block = self.block(address)?;
        let end = memchr::memchr(0, block.data).unwrap_or(block.data.len());
        let text = String::from_utf8_lossy(&block.data[..end]).into_owned();
        if block.id != *b"MD" {
            return Ok(text);
        }
        let inside = text
            .split_once("<TX>")
            .and_then(|(_, rest)| rest.split_once("</TX>"));
        Ok(inside
            .map(|(inside, _)| inside.trim().to_owned())
            .unwrap_or_default())
    }

    /// All data of a DT or SD block, of its packed form, or of a list of them.
    pub fn data(&self, address: Option<u64>) -> Result<Cow<'a, [u8]>> {
        let Some(address) = address else {
            return Ok(Cow::Borrowed(&[]));
        };
        let block = self.block(address)?;
        match &block.id {
            b"DT" | b"SD" => {
                self.count_data(&block)?;
                Ok(Cow::Borrowed(block.data))
            }
            b"DZ" => self.unpacked(&block).map(Cow::Owned),
            b"HL" => self.list(block.link(0)).map(Cow::Owned),
            b"DL" => self.list(Some(address)).map(Cow::Owned),
            _ => Err(self.unsupported(
                address,
                &format!("data in a block {}", name(block.id)),
                "DT, SD, DZ, DL or HL",
            )),
        }
    }

    fn list(&self, first: Option<u64>) -> Result<Vec<u8>> {
        let mut data = Vec::new();
        let mut met = HashSet::new();
        for list in self.chain(first, b"DL")? {
            for address in (1..list.links()).filter_map(|index| list.link(index)) {
                if !met.insert(address) {
                    return Err(self.fault(
                        address,
                        "a block twice in a list of data",
                        "each block once",
                    ));
                }
                let block = self.block(address)?;
                match &block.id {
                    b"DT" | b"SD" => {
                        self.count_data(&block)?;
                        data.extend_from_slice(block.data);
                    }
                    b"DZ" => data.extend(self.unpacked(&block)?),
                    _ => {
                        return Err(self.unsupported(
                            address,
                            &format!("a block {} in a list of data", name(block.id)),
                            "DT, SD or DZ",
                        ));
                    }
                }
            }
        }
        Ok(data)
    }

    /// The data of a DZ block: its kind, the way of packing and its parameter, the length before and after.
    fn unpacked(&self, block: &Block<'_>) -> Result<Vec<u8>> {
        const FIELDS: usize = 24;
        self.count_data(block)?;
        let Some((fields, packed)) = block.data.split_at_checked(FIELDS) else {
            return Err(self.fault(block.address, "a cut block DZ", "24 bytes and its data"));
        };
        let (way, parameter) = (fields[2], u32_at(fields, 4) as usize);
        let (length, packed_length) = (u64_at(fields, 8), u64_at(fields, 16));
        if way > 1 {
            return Err(self.unsupported(
                block.address,
                &format!("data packed in way {way}"),
                "way 0 or 1",
            ));
        }
        let packed = usize::try_from(packed_length)
            .ok()
            .and_then(|length| packed.get(..length))
            .filter(|packed| length / LARGEST_RATIO <= packed.len() as u64);
        let bytes = packed.and_then(|packed| inflate(packed, length).ok());
        let Some(bytes) = bytes else {
            return Err(self.fault(
                block.address,
                "a block DZ that cannot be unpacked",
                &format!("{length} bytes packed by deflate"),
            ));
        };
        Ok(if way == 1 && parameter > 0 {
            rows(&bytes, parameter)
        } else {
            bytes
        })
    }

    pub fn fault(&self, address: u64, found: &str, expected: &str) -> Error {
        self.error(Kind::Format, address, found, expected)
    }

    pub fn unsupported(&self, address: u64, found: &str, expected: &str) -> Error {
        self.error(Kind::Unsupported, address, found, expected)
    }

    fn error(&self, kind: Kind, address: u64, found: &str, expected: &str) -> Error {
        Error::new(kind, self.source, Place::offset(address), found, expected)
    }
}

fn inflate(packed: &[u8], length: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    ZlibDecoder::new(packed)
        .take(length.saturating_add(1))
        .read_to_end(&mut bytes)?;
    if bytes.len() as u64 == length {
        Ok(bytes)
    } else {
        Err(io::ErrorKind::InvalidData.into())
    }
}

/// Records that were stored column by column (byte by byte of a record, `width` bytes wide) one after the other; what
/// does not fill a record stays at the end.
fn rows(columns: &[u8], width: usize) -> Vec<u8> {
    let count = columns.len() / width;
    let mut rows = columns.to_vec();
    if count > 0 {
        for (column, bytes) in columns[..count * width].chunks_exact(count).enumerate() {
            for (row, &byte) in bytes.iter().enumerate() {
                rows[row * width + column] = byte;
            }
        }
    }
    rows
}

fn name(id: [u8; 2]) -> String {
    quoted(&String::from_utf8_lossy(&id))
}

fn field<const N: usize>(bytes: &[u8], at: usize) -> [u8; N] {
    bytes
        .get(at..)
        .and_then(|rest| rest.first_chunk())
        .copied()
        .unwrap_or([0; N])
}

/// A little-endian number; 0 beyond the end, as fields that later versions added are in earlier ones.
pub fn u16_at(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes(field(bytes, at))
}

/// See `u16_at`.
pub fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(field(bytes, at))
}

/// See `u16_at`.
pub fn u64_at(bytes: &[u8], at: usize) -> u64 {
    u64::from_le_bytes(field(bytes, at))
}

/// See `u16_at`.
pub fn f64_at(bytes: &[u8], at: usize) -> f64 {
    f64::from_le_bytes(field(bytes, at))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_become_rows() {
        // Two records of three bytes and one byte left.
        assert_eq!(rows(&[1, 4, 2, 5, 3, 6, 7], 3), [1, 2, 3, 4, 5, 6, 7]);
        assert_eq!(rows(&[1, 2], 3), [1, 2]);
    }
}
