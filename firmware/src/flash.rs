//! W25Q32 on SPI2 as an asynchronous NOR flash. A page program takes up to 3 ms and a sector erase up to 400 ms; the
//! chip is asked once a millisecond meanwhile, so neither blocks anybody.

use core_logic::check_in::Task;
use embedded_hal::spi::{Operation, SpiDevice};
use embedded_storage_async::nor_flash::{
    ErrorType, MultiwriteNorFlash, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash,
};

use crate::{
    app,
    pace::{self, Pace},
};

/// 32 Mbit.
pub const CAPACITY: usize = 4 * 1024 * 1024;
/// The smallest unit that can be erased.
pub const SECTOR: u32 = 4 * 1024;
const PAGE: u32 = 256;
/// Bytes read back at once.
const COMPARED: usize = 32;

const READ_IDENTITY: u8 = 0x9F;
const READ_STATUS: u8 = 0x05;
const WRITE_ENABLE: u8 = 0x06;
const READ: u8 = 0x03;
const PAGE_PROGRAM: u8 = 0x02;
const SECTOR_ERASE: u8 = 0x20;
const RELEASE_POWER_DOWN: u8 = 0xAB;

const STATUS_BUSY: u8 = 1 << 0;
const STATUS_WRITE_ENABLED: u8 = 1 << 1;
/// Winbond, SPI NOR, 2²² bytes. The later W25Q32JV-M answers 0x70 as its type.
const MANUFACTURER: u8 = 0xEF;
const SIZE: u8 = 0x16;

/// Twice the data sheet's longest page program (3 ms) and sector erase (400 ms).
const PROGRAM_LIMIT_MS: u32 = 6;
const ERASE_LIMIT_MS: u32 = 800;

/// What can go wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq, defmt::Format)]
pub enum Error<E> {
    /// The bus.
    Bus(E),
    /// Another chip, or none: the identity read.
    Identity([u8; 3]),
    /// Still busy after the longest time.
    Timeout,
    /// A write was not enabled: the chip is protected, busy or not there.
    NotEnabled,
    /// Beyond the chip's end.
    OutOfBounds,
    /// Not a sector's beginning.
    NotAligned,
    /// What was written does not read back: the chip is worn out there.
    NotWritten,
}

impl<E: core::fmt::Debug> NorFlashError for Error<E> {
    fn kind(&self) -> NorFlashErrorKind {
        match self {
            Self::OutOfBounds => NorFlashErrorKind::OutOfBounds,
            Self::NotAligned => NorFlashErrorKind::NotAligned,
            _ => NorFlashErrorKind::Other,
        }
    }
}

/// The chip.
pub struct Flash<SPI>(SPI);

/// A command and its 24-bit address.
fn command(code: u8, address: u32) -> [u8; 4] {
    let [_, high, middle, low] = address.to_be_bytes();
    [code, high, middle, low]
}

impl<SPI: SpiDevice> Flash<SPI> {
    /// Takes the chip without a transfer.
    pub fn new(spi: SPI) -> Self {
        Self(spi)
    }

    /// Wakes the chip and makes sure that it is the one expected: one try of 1 ms, which fails as well while an erase
    /// runs that a reset of the MCU cut off from us.
    pub async fn start(&mut self, pace: Pace<'_>) -> Result<(), Error<SPI::Error>> {
        self.0.write(&[RELEASE_POWER_DOWN]).map_err(Error::Bus)?;
        // 3 µs until it listens.
        pace.pause(pace::whole(1)).await;
        if self.status()? & STATUS_BUSY != 0 {
            return Err(Error::Timeout);
        }
        let mut identity = [0; 3];
        self.transfer(&[READ_IDENTITY], &mut identity)?;
        match identity {
            [MANUFACTURER, _, SIZE] => Ok(()),
            other => Err(Error::Identity(other)),
        }
    }

    fn transfer(&mut self, command: &[u8], answer: &mut [u8]) -> Result<(), Error<SPI::Error>> {
        self.0
            .transaction(&mut [Operation::Write(command), Operation::Read(answer)])
            .map_err(Error::Bus)
    }

    fn status(&mut self) -> Result<u8, Error<SPI::Error>> {
        let mut status = [0];
        self.transfer(&[READ_STATUS], &mut status)?;
        let [status] = status;
        Ok(status)
    }

    /// Four bytes, the first as the highest; 0 where they cannot be read. 5 µs.
    pub fn word(&mut self, at: u32) -> u32 {
        let mut word = [0; 4];
        match self.transfer(&command(READ, at), &mut word) {
            Ok(()) => u32::from_be_bytes(word),
            Err(_) => 0,
        }
    }

    /// Whether the sector at `at` is marked at its begin and not at its end, as sequential-storage judges it: by half of a byte's
    /// bits. One that cannot be read is not.
    pub fn is_begun(&mut self, at: u32) -> bool {
        let is_marked = |byte: u32| (byte & 0xFF).count_ones() <= 4;
        is_marked(self.word(at) >> 24) && !is_marked(self.word(at + SECTOR - 4))
    }

    async fn wait(&mut self, pace: Pace<'_>, limit_ms: u32) -> Result<(), Error<SPI::Error>> {
        for _ in 0..=limit_ms {
            if self.status()? & STATUS_BUSY == 0 {
                return Ok(());
            }
            app::alive(Task::Storage);
            pace.pause(1).await;
        }
        Err(Error::Timeout)
    }

    /// A worn cell takes a program without a word: only what reads back is written.
    fn compare(&mut self, mut at: u32, written: &[u8]) -> Result<(), Error<SPI::Error>> {
        for part in written.chunks(COMPARED) {
            let mut buffer = [0; COMPARED];
            let Some(read) = buffer.get_mut(..part.len()) else {
                return Err(Error::OutOfBounds);
            };
            self.transfer(&command(READ, at), read)?;
            // `!=` of two slices is `memcmp`, which nothing else needs: 130 bytes of the image.
            if !read.iter().eq(part) {
                return Err(Error::NotWritten);
            }
            at = at.saturating_add(u32::try_from(part.len()).unwrap_or(0));
        }
        Ok(())
    }

    fn enable_write(&mut self) -> Result<(), Error<SPI::Error>> {
        self.0.write(&[WRITE_ENABLE]).map_err(Error::Bus)?;
        // An erase keeps the latch set for as long as it runs, and what is written meanwhile is ignored.
        if self.status()? & (STATUS_BUSY | STATUS_WRITE_ENABLED) != STATUS_WRITE_ENABLED {
            return Err(Error::NotEnabled);
        }
        Ok(())
    }
}

fn within(offset: u32, length: usize) -> Option<u32> {
    let end = usize::try_from(offset).ok()?.checked_add(length)?;
    (end <= CAPACITY).then_some(offset)
}

/// The chip lent to a queue of sequential-storage. The traits are for this and not for the chip itself, of which a queue would
/// take a `&mut`: the traits' own implementation for that wraps each of its futures in another one.
pub struct Lent<'a, SPI>(pub &'a mut Flash<SPI>, pub Pace<'a>);

impl<SPI: SpiDevice> ErrorType for Lent<'_, SPI> {
    type Error = Error<SPI::Error>;
}

impl<SPI: SpiDevice> ReadNorFlash for Lent<'_, SPI> {
    const READ_SIZE: usize = 1;

    async fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), Self::Error> {
        let offset = within(offset, bytes.len()).ok_or(Error::OutOfBounds)?;
        self.0.transfer(&command(READ, offset), bytes)?;
        self.1.pause(0).await;
        Ok(())
    }

    fn capacity(&self) -> usize {
        CAPACITY
    }
}

impl<SPI: SpiDevice> NorFlash for Lent<'_, SPI> {
    const WRITE_SIZE: usize = 1;
    const ERASE_SIZE: usize = SECTOR as usize;

    async fn erase(&mut self, from: u32, to: u32) -> Result<(), Self::Error> {
        within(to, 0).ok_or(Error::OutOfBounds)?;
        if from > to || !(from | to).is_multiple_of(SECTOR) {
            return Err(Error::NotAligned);
        }
        let mut at = from;
        while at < to {
            self.0.enable_write()?;
            self.0
                .0
                .write(&command(SECTOR_ERASE, at))
                .map_err(Error::Bus)?;
            self.0.wait(self.1, ERASE_LIMIT_MS).await?;
            at += SECTOR;
        }
        Ok(())
    }

    async fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Self::Error> {
        let mut at = within(offset, bytes.len()).ok_or(Error::OutOfBounds)?;
        let mut left = bytes;
        while !left.is_empty() {
            // A program wraps within its page.
            let room = usize::try_from(PAGE - at % PAGE).unwrap_or(1);
            let Some((now, later)) = left.split_at_checked(room.min(left.len())) else {
                return Err(Error::OutOfBounds);
            };
            self.0.enable_write()?;
            self.0
                .0
                .transaction(&mut [
                    Operation::Write(&command(PAGE_PROGRAM, at)),
                    Operation::Write(now),
                ])
                .map_err(Error::Bus)?;
            self.0.wait(self.1, PROGRAM_LIMIT_MS).await?;
            self.0.compare(at, now)?;
            at = at.saturating_add(u32::try_from(now.len()).unwrap_or(0));
            left = later;
        }
        Ok(())
    }
}

/// NOR flash clears bits: the same byte may be written again with more zeros.
impl<SPI: SpiDevice> MultiwriteNorFlash for Lent<'_, SPI> {}
