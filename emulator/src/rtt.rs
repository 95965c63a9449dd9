//! What the image prints: SEGGER RTT's up channel 0, defmt-encoded.
//!
//! The control block is in the MCU's RAM: 16 bytes of identification, the numbers of up and down channels, then for
//! each channel name, buffer, size, write offset, read offset and flags (SEGGER UM08001, "RTT control block").

use std::fmt::Write as _;

use defmt_decoder::{DecodeError, Locations, StreamDecoder, Table};

/// Reads and decodes the channel. The decoder borrows the table, so both live as long as the machine's log.
pub struct Log<'table> {
    decoder: Box<dyn StreamDecoder + Send + Sync + 'table>,
    locations: Option<&'table Locations>,
    control_block: u32,
    /// Frames that could not be decoded.
    pub malformed: u64,
}

/// Table and locations out of an image.
pub struct LogTable {
    table: Table,
    locations: Option<Locations>,
}

impl LogTable {
    /// `None` if the image has no defmt section.
    ///
    /// # Errors
    /// If the section is of a version that the decoder does not know.
    pub fn of(elf: &[u8]) -> anyhow::Result<Option<Self>> {
        let Some(table) = Table::parse(elf)? else {
            return Ok(None);
        };
        // Without debug information a message is shown without its place.
        let locations = table.get_locations(elf).ok().filter(|locations| {
            table
                .indices()
                .all(|index| locations.contains_key(&(index as u64)))
        });
        Ok(Some(Self { table, locations }))
    }
}

/// Access to the MCU's RAM as a probe has it.
pub trait Memory {
    /// A word; `None` outside of RAM.
    fn word(&self, address: u32) -> Option<u32>;
    /// A byte.
    fn byte(&self, address: u32) -> Option<u8>;
    /// Writes a word.
    fn set_word(&self, address: u32, value: u32);
}

const IDENTIFICATION: &[u8; 16] = b"SEGGER RTT\0\0\0\0\0\0";
const UP_CHANNEL_0: u32 = 24;

impl<'table> Log<'table> {
    /// A log that reads the control block at `control_block`.
    pub fn new(table: &'table LogTable, control_block: u32) -> Self {
        Self {
            decoder: table.table.new_stream_decoder(),
            locations: table.locations.as_ref(),
            control_block,
            malformed: 0,
        }
    }

    /// Takes what has been written since the last call; whole lines with time, level, text and place.
    pub fn poll(&mut self, memory: &dyn Memory) -> Vec<String> {
        if let Some(bytes) = self.take_bytes(memory) {
            self.decoder.received(&bytes);
        }
        let mut lines = Vec::new();
        loop {
            match self.decoder.decode() {
                Ok(frame) => {
                    let mut line = frame.display(false).to_string();
                    if let Some(place) = self.locations.and_then(|all| all.get(&frame.index())) {
                        let file = place
                            .file
                            .file_name()
                            .map_or_else(Default::default, |name| name.to_string_lossy());
                        // Writing to a string cannot fail.
                        let _ = write!(line, " ({file}:{})", place.line);
                    }
                    lines.push(line);
                }
                Err(DecodeError::UnexpectedEof) => return lines,
                Err(DecodeError::Malformed) => {
                    self.malformed += 1;
                    // The encoding ends frames with zeros; the next call goes on behind the bad one.
                    if lines.len() > 10_000 {
                        return lines;
                    }
                }
            }
        }
    }

    fn take_bytes(&self, memory: &dyn Memory) -> Option<Vec<u8>> {
        let block = self.control_block;
        let found = (0..16)
            .all(|offset| memory.byte(block + offset) == Some(IDENTIFICATION[offset as usize]));
        if !found {
            return None;
        }
        let channel = block + UP_CHANNEL_0;
        let (buffer, size) = (memory.word(channel + 4)?, memory.word(channel + 8)?);
        let (write, mut read) = (memory.word(channel + 12)?, memory.word(channel + 16)?);
        if write >= size || read >= size {
            return None;
        }
        let mut bytes = Vec::new();
        while read != write {
            bytes.push(memory.byte(buffer + read)?);
            read = (read + 1) % size;
        }
        memory.set_word(channel + 16, read);
        Some(bytes)
    }
}
