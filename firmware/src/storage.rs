//! What is in the flash: configuration, charge and the log, each in its own region, by sequential-storage.
//!
//! | region | content | its newest record is read at |
//! |---|---|---|
//! | 0x00_0000 … 0x00_4000 | configuration record | the start, and "restore" |
//! | 0x01_0000 … 0x02_0000 | retained state | the start |
//! | 0x20_0000 … 0x40_0000 | log | |
//!
//! Each is a queue that overwrites its oldest sector. A map would find the newest record without passing the older
//! ones, at most 0.1 s once, and cost 3 kB of code for it.
//!
//! A loss of power in any write leaves the old or the new item (sequential-storage's own guarantee); each record has a
//! CRC-32 of `core_logic` besides. Everything here runs at priority 1 and waits asynchronously.

use core::ops::Range;

use core_logic::{
    configuration::{self, Configuration, ConfigurationError, MAX_RECORD},
    design_parameters as design,
    retained::{LogRecord, MAX_LOG_BYTES, MAX_STATE_BYTES, RetainedState},
};
use embedded_storage_async::nor_flash::NorFlash;
use sequential_storage::{
    Error,
    cache::Cache,
    queue::{QueueConfig, QueueStorage},
};
use stm32f4xx_hal::{
    gpio::{Output, PB12},
    pac::SPI2,
};

use crate::{
    flash,
    flash::{Flash, Lent, SECTOR},
    pace::Pace,
    spi,
};

type Chip = Flash<spi::Device<SPI2, PB12<Output>>>;

const CONFIGURATION: Range<u32> = 0x00_0000..0x00_4000;
const STATE: Range<u32> = 0x01_0000..0x02_0000;
const LOG: Range<u32> = 0x20_0000..0x40_0000;
// The smallest intervals of saving are worked out by them.
const _: () = assert!((STATE.end - STATE.start) as i64 == design::STATE_FLASH_BYTES);
const _: () = assert!(SECTOR as i64 == design::FLASH_SECTOR_BYTES);

/// So much of the log is looked through in one turn: 32 sectors, 0.2 ms.
const LOOKED_AT: u32 = 32 * SECTOR;

/// What happened since the start; each stops at its end.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Records written.
    pub written: u32,
    /// Sectors erased to clear the log; those that sequential-storage erases on its way are not counted.
    pub erased: u32,
    /// Failed writes and erases.
    pub failures: u32,
    /// Records that were read and refused.
    pub refused: u32,
    /// Log records lost.
    pub lost: u32,
}

#[inline(never)]
fn count(counter: &mut u32) {
    *counter = counter.saturating_add(1);
}

/// What the flash held at the start.
pub enum Stored<T> {
    /// This.
    Value(T),
    /// This, and something newer that is damaged or was cut off.
    Older(T),
    /// Nothing yet.
    Nothing,
    /// Something that must not be used, or the flash could not be read.
    Refused,
}

impl<T> Stored<T> {
    fn read(value: T, is_older: bool) -> Self {
        if is_older {
            Self::Older(value)
        } else {
            Self::Value(value)
        }
    }
}

/// The flash with its regions.
pub struct Storage {
    flash: Chip,
    buffer: [u8; MAX_RECORD],
    record: [u8; MAX_RECORD],
    counters: Counters,
    ready: bool,
    log_full: bool,
    failed: bool,
    overwrites: bool,
    /// Where the clearing of the log goes on.
    cleared: u32,
}

impl Storage {
    /// Takes the bus. No transfer takes place.
    pub fn new(spi: spi::Device<SPI2, PB12<Output>>) -> Self {
        Self {
            flash: Flash::new(spi),
            buffer: [0; MAX_RECORD],
            record: [0; MAX_RECORD],
            counters: Counters::default(),
            ready: false,
            log_full: false,
            failed: false,
            overwrites: false,
            cleared: LOG.start,
        }
    }

    /// What happened so far.
    pub const fn counters(&self) -> Counters {
        self.counters
    }

    /// Whether the flash has failed, and the log has begun to overwrite its oldest records, since the last call.
    pub const fn take_conditions(&mut self) -> (bool, bool) {
        (
            core::mem::replace(&mut self.failed, false),
            core::mem::replace(&mut self.overwrites, false),
        )
    }

    /// One try to wake the chip, and to end what a loss of power has cut off in it; whether it answers. Without it nothing is
    /// read or written: one that has gone reads as blank.
    pub async fn start(&mut self, pace: Pace<'_>) -> bool {
        let mut result = self.flash.start(pace).await;
        for region in &[CONFIGURATION, STATE] {
            if result.is_err() || self.ready {
                break;
            }
            let at = self.torn(region);
            if at < region.end {
                result = Lent(&mut self.flash, pace).erase(at, at + SECTOR).await;
            }
        }
        if let Err(error) = &result {
            defmt::debug!("flash: {}", error);
        }
        self.ready = result.is_ok();
        self.ready
    }

    /// The sector whose erase was cut off, if it has left one that looks begun behind another one: the queue erases only
    /// the sector next to the one that it writes into, the first after the last, and has begun no other. It would not go on to
    /// that sector, or take what is left in it for the newest records.
    #[inline(never)]
    fn torn(&mut self, region: &Range<u32>) -> u32 {
        let mut behind = region.end;
        let mut at = region.start;
        while at < region.end && !(self.flash.is_begun(at) && self.flash.is_begun(behind - SECTOR))
        {
            at += SECTOR;
            behind = at;
        }
        at
    }

    /// Whether the chip has answered.
    pub const fn is_ready(&self) -> bool {
        self.ready
    }

    /// The stored configuration.
    pub async fn configuration(&mut self, pace: Pace<'_>) -> Stored<Configuration> {
        match self.newest(pace, CONFIGURATION).await {
            Ok(Some((bytes, is_older))) => match configuration::decode(bytes) {
                Ok(configuration) => Stored::read(configuration, is_older),
                Err(error) => {
                    self.refuse(&error);
                    Stored::Refused
                }
            },
            Ok(None) => Stored::Nothing,
            Err(()) => Stored::Refused,
        }
    }

    fn refuse(&mut self, error: &ConfigurationError) {
        // Not `Display`: the formatting of every field's name and limits would cost 3 KiB of flash.
        let reason = match error {
            ConfigurationError::TooShort { .. } => "too short",
            ConfigurationError::WrongVersion { .. } => "another version",
            ConfigurationError::TrailingBytes(_) => "too long",
            ConfigurationError::WrongCrc { .. } => "wrong CRC",
            ConfigurationError::Malformed => "no configuration",
            ConfigurationError::Invalid(_) => "beyond its limits",
        };
        defmt::error!("stored configuration refused: {=str}", reason);
        count(&mut self.counters.refused);
    }

    /// The stored charge and state of charge.
    pub async fn state(&mut self, pace: Pace<'_>) -> Stored<RetainedState> {
        match self.newest(pace, STATE).await {
            Ok(Some((bytes, is_older))) => match RetainedState::decode(bytes) {
                Ok(state) => Stored::read(state, is_older),
                Err(error) => {
                    defmt::error!("stored state refused: {}", error);
                    count(&mut self.counters.refused);
                    Stored::Refused
                }
            },
            Ok(None) => Stored::Nothing,
            Err(()) => Stored::Refused,
        }
    }

    /// The region's newest intact record, and whether it is older than one that is not intact.
    async fn newest(
        &mut self,
        pace: Pace<'_>,
        region: Range<u32>,
    ) -> Result<Option<(&[u8], bool)>, ()> {
        let (Ok(config), true) = (QueueConfig::try_new(region.clone()), self.ready) else {
            return Err(());
        };
        let mut queue =
            QueueStorage::new(Lent(&mut self.flash, pace), config, Cache::new_uncached());
        let mut length = None;
        let mut items = queue.iter().await.map_err(|error| log(&error))?;
        // A record that is damaged or was cut off by a loss of power has a wrong CRC: it is read, and passed over.
        while let Some(item) = items
            .next(&mut self.buffer)
            .await
            .map_err(|error| log(&error))?
        {
            length = Some(item.len());
            for (to, from) in self.record.iter_mut().zip(item.iter()) {
                *to = *from;
            }
        }
        // Nothing intact in a region that is not blank: there was a record once, and it is damaged.
        let end = region.end;
        if length.is_none() && self.first_written(region) < end {
            count(&mut self.counters.refused);
            self.failed = true;
            return Err(());
        }
        let Some((record, last_read)) =
            length.and_then(|length| self.record.get(..length).zip(self.buffer.get(..length)))
        else {
            return Ok(None);
        };
        // As in `Flash::compare`: `!=` would be `memcmp`.
        let is_older = !last_read.iter().eq(record);
        if is_older {
            count(&mut self.counters.refused);
            self.failed = true;
        }
        Ok(Some((record, is_older)))
    }

    /// The region's first sector that was written, or cannot be read; its end without one.
    fn first_written(&mut self, region: Range<u32>) -> u32 {
        let mut at = region.start;
        while at < region.end && self.flash.word(at) == u32::MAX {
            at += SECTOR;
        }
        at
    }

    /// Writes the configuration; an error if it is not in the flash then. Like [`Storage::save_state`] it encodes at once and
    /// returns the future of the writing alone, which both then share.
    pub fn save_configuration(
        &mut self,
        pace: Pace<'_>,
        configuration: &Configuration,
    ) -> impl Future<Output = Result<bool, ()>> {
        let record = configuration::encode(configuration, &mut self.record);
        let length = record.ok().map(<[u8]>::len);
        self.push(pace, CONFIGURATION, length)
    }

    /// Writes charge and state of charge; an error if they are not in the flash then.
    pub fn save_state(
        &mut self,
        pace: Pace<'_>,
        state: &RetainedState,
    ) -> impl Future<Output = Result<bool, ()>> {
        let buffer = self.record.get_mut(..MAX_STATE_BYTES);
        let record = buffer.and_then(|buffer| state.encode(buffer).ok());
        let length = record.map(<[u8]>::len);
        self.push(pace, STATE, length)
    }

    /// Writes the first `length` bytes of `record`, if it could be encoded; whether the oldest sector had to be given up for
    /// it.
    async fn push(
        &mut self,
        pace: Pace<'_>,
        region: Range<u32>,
        length: Option<usize>,
    ) -> Result<bool, ()> {
        let length = length.ok_or(())?;
        let (Some(record), Ok(config), true) = (
            self.record.get(..length),
            QueueConfig::try_new(region),
            self.ready,
        ) else {
            self.failed = true;
            return Err(());
        };
        let mut queue =
            QueueStorage::new(Lent(&mut self.flash, pace), config, Cache::new_uncached());
        let mut full = false;
        let result = loop {
            let result = queue.push(record, full).await;
            if full || !matches!(result, Err(Error::FullStorage)) {
                break result;
            }
            full = true;
        };
        match result {
            Ok(()) => {
                count(&mut self.counters.written);
                Ok(full)
            }
            Err(error) => {
                self.has_failed(&error);
                Err(())
            }
        }
    }

    fn has_failed(&mut self, error: &Error<flash::Error<spi::Error>>) {
        log(error);
        count(&mut self.counters.failures);
        self.failed = true;
    }

    /// Appends to the log, over its oldest records when it is full.
    pub async fn append(&mut self, pace: Pace<'_>, record: &LogRecord) {
        let length = self
            .record
            .get_mut(..MAX_LOG_BYTES)
            .and_then(|buffer| record.encode(buffer).ok())
            .map(<[u8]>::len);
        match self.push(pace, LOG, length).await {
            Ok(full) => {
                self.overwrites |= full && !self.log_full;
                self.log_full |= full;
            }
            Err(()) => count(&mut self.counters.lost),
        }
    }

    /// Erases the log's next sector that was written, 45 ms, at most 400 ms; whether there may be another one. All of
    /// them in one go would take 23 s and more, in which no charge is saved. An error if one could not be erased, or the
    /// chip has not answered: what is read then looks blank.
    pub async fn clear_log_sector(&mut self, pace: Pace<'_>) -> Result<bool, ()> {
        if !self.ready {
            self.failed = true;
            return Err(());
        }
        // On from the last one, for a worn sector may never look blank.
        let from = core::mem::replace(&mut self.cleared, LOG.start);
        let end = LOG.end.min(from + LOOKED_AT);
        let at = self.first_written(from..end);
        if at >= LOG.end {
            self.log_full = false;
            return Ok(false);
        }
        if at >= end {
            self.cleared = at;
            return Ok(true);
        }
        if let Err(value) = Lent(&mut self.flash, pace).erase(at, at + SECTOR).await {
            self.has_failed(&Error::Storage { value });
            return Err(());
        }
        count(&mut self.counters.erased);
        self.cleared = at + SECTOR;
        Ok(true)
    }
}

fn log(error: &Error<flash::Error<spi::Error>>) {
    defmt::error!("storage: {}", error);
}
