//! The driver's logic, once for both flavours.

use core::slice;

use both_flavours::both_flavours;
use embedded_hal::spi::Operation;

use crate::config::Config;
use crate::error::{Error, StuckLevel};
use crate::registers::{
    Aenergy, Cfnum, Ch1os, Ch2os, ClearedByRead, Dierev, EnergyDelta, Gain, Interrupts, Irqen,
    Mode, NonDestructive, Register, RegisterId, Rststatus, Status, Temp, Waveform, Width, Writable,
};
use crate::timing::Timing;
#[cfg(feature = "async")]
use crate::transport::Asynchronous;
use crate::transport::Blocking;

/// Bit 7 of the communications register: the transfer that follows is a write.
const WRITE: u8 = 0x80;

/// MODE after a reset.
const MODE_RESET: u32 = 0x000C;
/// MODE bit 6.
const MODE_SWRST: u32 = 0x0040;

/// How the driver talks to the chip.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Options {
    /// The interface's gaps.
    pub timing: Timing,
    /// How often a read with a wrong CHKSUM, and a write that does not read back, is repeated after the first attempt.
    pub retries: u8,
}

impl Default for Options {
    /// The ADE7753's gaps and two retries.
    fn default() -> Self {
        Self {
            timing: Timing::ADE7753,
            retries: 2,
        }
    }
}

/// Counters since the driver was made or `reset_statistics`; they stop at `u32::MAX`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Statistics {
    /// Reads and writes repeated.
    pub retries: u32,
    /// Reads whose CHKSUM was wrong.
    pub checksum_failures: u32,
    /// Writes that did not read back.
    pub verify_failures: u32,
    /// Errors reported by the bus.
    pub bus_errors: u32,
}

/// AENERGY and CHKSUM as they came in one chip-select assertion, not yet compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct EnergySnapshot {
    raw: u32,
    checksum: u8,
}

impl EnergySnapshot {
    /// The value if CHKSUM confirms it.
    #[must_use]
    pub fn verified(self) -> Option<Aenergy> {
        if self.raw.count_ones() == u32::from(self.checksum) {
            Aenergy::decode(self.raw)
        } else {
            None
        }
    }

    /// The 24 bits as received.
    #[must_use]
    pub const fn raw(self) -> u32 {
        self.raw
    }

    /// The CHKSUM byte as received.
    #[must_use]
    pub const fn checksum(self) -> u8 {
        self.checksum
    }
}

/// An offset test under way: channel 1 is shorted inside the chip until `finish_offset_test`.
#[must_use = "channel 1 stays shorted, and no current is counted, until the test is finished"]
#[derive(Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct OffsetTest {
    start: Aenergy,
}

/// A register as the transfers see it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Field {
    register: RegisterId,
    width: Width,
    verify_mask: u32,
}

impl Field {
    pub(crate) const fn of<R: NonDestructive>() -> Self {
        Self {
            register: R::ID,
            width: R::WIDTH,
            verify_mask: u32::MAX,
        }
    }

    pub(crate) const fn cleared<R: ClearedByRead>() -> Self {
        Self {
            register: R::ID,
            width: R::WIDTH,
            verify_mask: u32::MAX,
        }
    }

    pub(crate) const fn writable<R: Writable>() -> Self {
        Self {
            verify_mask: R::VERIFY_MASK,
            ..Self::of::<R>()
        }
    }
}

const MODE: Field = Field::writable::<Mode>();

#[derive(Debug)]
pub(crate) struct Core<T> {
    pub(crate) transport: T,
    pub(crate) options: Options,
    pub(crate) statistics: Statistics,
    /// The last one given to `configure`.
    config: Config,
    /// Whether it is in force.
    is_configured: bool,
    die_revision: Option<Dierev>,
    offset_test: bool,
}

impl<T> Core<T> {
    pub(crate) fn new(transport: T, options: Options) -> Self {
        Self {
            transport,
            options,
            statistics: Statistics::default(),
            config: Config::DC,
            is_configured: false,
            die_revision: None,
            offset_test: false,
        }
    }

    pub(crate) fn config(&self) -> Option<&Config> {
        self.is_configured.then_some(&self.config)
    }

    pub(crate) fn die_revision(&self) -> Option<Dierev> {
        self.die_revision
    }
}

/// Compares received bits with the CHKSUM byte that followed them.
fn check<E>(register: RegisterId, width: Width, read: u32, got: u8) -> Result<(), Error<E>> {
    // CHKSUM has 6 bits: a byte of ones is no checksum at all, it is the line.
    if got == 0xFF && read == width.all_ones() {
        return Err(Error::DeadBus {
            register,
            level: StuckLevel::High,
        });
    }
    let [expected, ..] = read.count_ones().to_le_bytes();
    if expected == got {
        Ok(())
    } else {
        Err(Error::Checksum {
            register,
            read,
            expected,
            got,
        })
    }
}

/// What `configure` writes, in this order. A function and not a table: a table would live in the future.
fn setting(config: &Config, index: u8) -> Option<(Field, Option<u32>)> {
    Some(match index {
        0 => (Field::writable::<Gain>(), config.gain.encode()),
        1 => (Field::writable::<Ch1os>(), config.ch1os().encode()),
        2 => (Field::writable::<Ch2os>(), config.ch2os().encode()),
        3 => (Field::writable::<Cfnum>(), config.cfnum().encode()),
        4 => (MODE, config.mode().encode()),
        5 => (Field::writable::<Irqen>(), config.irqen().encode()),
        _ => return None,
    })
}

/// The number in bytes that came most significant first.
fn from_big_endian(bytes: &[u8]) -> u32 {
    bytes
        .iter()
        .fold(0, |number, &byte| number << 8 | u32::from(byte))
}

fn count(counter: &mut u32) {
    *counter = counter.saturating_add(1);
}

#[both_flavours]
impl<SPI: embedded_hal_async::spi::SpiDevice> Core<Asynchronous<SPI>> {
    fn bus_error(&mut self, register: RegisterId, source: SPI::Error) -> Error<SPI::Error> {
        count(&mut self.statistics.bus_errors);
        Error::Bus { register, source }
    }

    /// One read under one chip select, unchecked.
    async fn receive(
        &mut self,
        register: RegisterId,
        width: Width,
    ) -> Result<u32, Error<SPI::Error>> {
        let command = [register.address()];
        let mut buffer = [0; 3];
        let bytes = width.bytes();
        let timing = self.options.timing;
        let write = Operation::Write(&command);
        let wait = Operation::DelayNs(timing.command_to_data_ns);
        let gap = || Operation::DelayNs(timing.read_byte_gap_ns);
        let result = if timing.read_byte_gap_ns == 0 {
            let whole = Operation::Read(buffer.get_mut(..bytes).unwrap_or_default());
            self.transport
                .0
                .transaction(&mut [write, wait, whole])
                .await
        } else {
            let [first, second, third] = buffer.each_mut().map(slice::from_mut);
            let first = Operation::Read(first);
            let second = Operation::Read(second);
            let third = Operation::Read(third);
            let mut operations = [write, wait, first, gap(), second, gap(), third];
            let operations = operations.get_mut(..1 + 2 * bytes).unwrap_or_default();
            self.transport.0.transaction(operations).await
        };
        result.map_err(|source| self.bus_error(register, source))?;
        Ok(from_big_endian(buffer.get(..bytes).unwrap_or_default()))
    }

    /// One write under one chip select, unverified.
    async fn send(
        &mut self,
        register: RegisterId,
        width: Width,
        raw: u32,
        after_ns: u32,
    ) -> Result<(), Error<SPI::Error>> {
        let command = [WRITE | register.address()];
        let [_, _, high, low] = raw.to_be_bytes();
        let (high, low) = ([high], [low]);
        let gap = || Operation::DelayNs(self.options.timing.write_byte_gap_ns);
        // No register of 24 bits can be written. One of 8 bits begins with the second pair.
        let (second, skipped) = match width {
            Width::One => (&command, 2),
            Width::Two | Width::Three => (&high, 0),
        };
        let mut operations = [
            Operation::Write(&command),
            gap(),
            Operation::Write(second),
            gap(),
            Operation::Write(&low),
            // This gap belongs to the transaction: nobody else on the bus can then shorten it.
            Operation::DelayNs(after_ns),
        ];
        let operations = operations.get_mut(skipped..).unwrap_or_default();
        let result = self.transport.0.transaction(operations).await;
        result.map_err(|source| self.bus_error(register, source))
    }

    /// Data and CHKSUM, each under its own chip select, whose falling edge resynchronises the chip's interface.
    ///
    /// Like every transfer here it works on bits and not on a register's type: one state machine for all registers.
    async fn read_checked(
        &mut self,
        register: RegisterId,
        width: Width,
        retries: u8,
    ) -> Result<u32, Error<SPI::Error>> {
        let mut retries_left = retries;
        loop {
            let read = self.receive(register, width).await?;
            let got = self.receive(RegisterId::Chksum, Width::One).await?;
            let [got, ..] = got.to_le_bytes();
            let Err(error) = check(register, width, read, got) else {
                return Ok(read);
            };
            count(&mut self.statistics.checksum_failures);
            if retries_left == 0 {
                return Err(error);
            }
            retries_left -= 1;
            count(&mut self.statistics.retries);
        }
    }

    /// A register that reading does not change, with retries.
    pub(crate) async fn read_bits(&mut self, field: Field) -> Result<u32, Error<SPI::Error>> {
        let retries = self.options.retries;
        self.read_checked(field.register, field.width, retries)
            .await
    }

    /// A register that reading clears.
    pub(crate) async fn take_bits(&mut self, field: Field) -> Result<u32, Error<SPI::Error>> {
        self.read_checked(field.register, field.width, 0).await
    }

    /// Writes and verifies; `None` is a value that does not fit.
    pub(crate) async fn write_bits(
        &mut self,
        field: Field,
        written: Option<u32>,
    ) -> Result<(), Error<SPI::Error>> {
        let Field {
            register,
            width,
            verify_mask,
        } = field;
        let Some(written) = written else {
            return Err(Error::ValueOutOfRange { register });
        };
        let after_write_ns = self.options.timing.after_write_ns;
        let mut retries_left = self.options.retries;
        loop {
            self.send(register, width, written, after_write_ns).await?;
            let read = self.read_bits(field).await?;
            if (read ^ written) & verify_mask == 0 {
                return Ok(());
            }
            count(&mut self.statistics.verify_failures);
            if retries_left == 0 {
                return Err(Error::Verify {
                    register,
                    written,
                    read,
                });
            }
            retries_left -= 1;
            count(&mut self.statistics.retries);
        }
    }

    pub(crate) async fn software_reset(&mut self) -> Result<(), Error<SPI::Error>> {
        // Without a configuration an offset test cannot be finished either; `configure` forgets it.
        self.is_configured = false;
        let after_reset_ns = self.options.timing.after_reset_ns;
        self.send(
            RegisterId::Mode,
            Mode::WIDTH,
            MODE_RESET | MODE_SWRST,
            after_reset_ns,
        )
        .await?;
        let read = self.read_bits(MODE).await?;
        if read == MODE_RESET {
            Ok(())
        } else {
            Err(Error::Configuration {
                register: RegisterId::Mode,
                expected: MODE_RESET,
                read,
            })
        }
    }

    pub(crate) async fn configure(&mut self, config: &Config) -> Result<(), Error<SPI::Error>> {
        self.config = *config;
        self.is_configured = false;
        self.offset_test = false;
        self.write_configuration().await
    }

    async fn write_configuration(&mut self) -> Result<(), Error<SPI::Error>> {
        if self.read_bits(MODE).await? == 0 {
            self.check_stuck_low().await?;
        }
        let mut index = 0;
        while let Some((field, value)) = setting(&self.config, index) {
            self.write_bits(field, value).await?;
            index += 1;
        }
        let revision = self.read_bits(Field::of::<Dierev>()).await?;
        self.die_revision = Dierev::decode(revision);
        self.clear_reset_flag().await?;
        self.is_configured = true;
        Ok(())
    }

    /// Clears the flags and makes sure that RESET is among them, so that the next RESET is a new one.
    async fn clear_reset_flag(&mut self) -> Result<(), Error<SPI::Error>> {
        let mut retries_left = self.options.retries;
        loop {
            // The flags themselves do not matter here, so neither does their checksum.
            self.receive(RegisterId::Rststatus, Rststatus::WIDTH)
                .await?;
            let read = self.read_bits(Field::of::<Status>()).await?;
            if read & u32::from(Interrupts::RESET.bits()) == 0 {
                return Ok(());
            }
            if retries_left == 0 {
                return Err(Error::Configuration {
                    register: RegisterId::Status,
                    expected: 0,
                    read,
                });
            }
            retries_left -= 1;
            count(&mut self.statistics.retries);
        }
    }

    /// After MODE has read 0, which no [`Config`] and no reset makes it: is it the line?
    async fn check_stuck_low(&mut self) -> Result<(), Error<SPI::Error>> {
        if self.read_bits(Field::of::<Cfnum>()).await? == 0
            && self.read_bits(Field::of::<Dierev>()).await? == 0
        {
            return Err(Error::DeadBus {
                register: RegisterId::Mode,
                level: StuckLevel::Low,
            });
        }
        Ok(())
    }

    fn configured(&self) -> Result<Config, Error<SPI::Error>> {
        self.config().copied().ok_or(Error::NotConfigured)
    }

    /// MODE as configured, with what a running test changes in it.
    fn expected_mode(&self, config: &Config) -> Mode {
        Mode {
            short_channel_1: self.offset_test,
            ..config.mode()
        }
    }

    async fn check_mode(&mut self) -> Result<Config, Error<SPI::Error>> {
        let config = self.configured()?;
        let expected = self.expected_mode(&config).bits().into();
        let read = self.read_bits(MODE).await?;
        if (read ^ expected) & Mode::VERIFY_MASK == 0 {
            return Ok(config);
        }
        if read == 0 {
            self.check_stuck_low().await?;
        }
        if read == MODE_RESET {
            return Err(Error::Reset);
        }
        Err(Error::Configuration {
            register: RegisterId::Mode,
            expected,
            read,
        })
    }

    pub(crate) async fn verify_configuration(&mut self) -> Result<(), Error<SPI::Error>> {
        let config = self.check_mode().await?;
        for &(field, expected) in &[
            (Field::writable::<Gain>(), config.gain.encode()),
            (Field::writable::<Ch1os>(), config.ch1os().encode()),
            (Field::writable::<Cfnum>(), config.cfnum().encode()),
            (
                Field::of::<Dierev>(),
                self.die_revision.map(|Dierev(revision)| revision.into()),
            ),
        ] {
            // What could not be encoded could not be written either.
            let Some(expected) = expected else { continue };
            let read = self.read_bits(field).await?;
            if (read ^ expected) & field.verify_mask != 0 {
                return Err(Error::Configuration {
                    register: field.register,
                    expected,
                    read,
                });
            }
        }
        Ok(())
    }

    pub(crate) async fn reset_detected(&mut self) -> Result<bool, Error<SPI::Error>> {
        let status = self.read_bits(Field::of::<Status>()).await?;
        if status & u32::from(Interrupts::RESET.bits()) != 0 {
            return Ok(true);
        }
        Ok(self.read_bits(MODE).await? == MODE_RESET)
    }

    pub(crate) async fn energy(&mut self) -> Result<Aenergy, Error<SPI::Error>> {
        let read = self.read_bits(Field::of::<Aenergy>()).await?;
        decoded(read)
    }

    pub(crate) async fn energy_snapshot(&mut self) -> Result<EnergySnapshot, Error<SPI::Error>> {
        let energy = [RegisterId::Aenergy.address()];
        let checksum = [RegisterId::Chksum.address()];
        let [mut high, mut middle, mut low, mut got] = [[0u8]; 4];
        let timing = self.options.timing;
        let wait = || Operation::DelayNs(timing.command_to_data_ns);
        if timing.read_byte_gap_ns == 0 {
            let mut data = [0; 3];
            let operations = &mut [
                Operation::Write(&energy),
                wait(),
                Operation::Read(&mut data),
                Operation::Write(&checksum),
                wait(),
                Operation::Read(&mut got),
            ];
            let result = self.transport.0.transaction(operations).await;
            result.map_err(|source| self.bus_error(RegisterId::Aenergy, source))?;
            let [first, second, third] = data;
            [high, middle, low] = [[first], [second], [third]];
        } else {
            let gap = || Operation::DelayNs(timing.read_byte_gap_ns);
            let operations = &mut [
                Operation::Write(&energy),
                wait(),
                Operation::Read(&mut high),
                gap(),
                Operation::Read(&mut middle),
                gap(),
                Operation::Read(&mut low),
                gap(),
                Operation::Write(&checksum),
                wait(),
                Operation::Read(&mut got),
            ];
            let result = self.transport.0.transaction(operations).await;
            result.map_err(|source| self.bus_error(RegisterId::Aenergy, source))?;
        }
        let ([high], [middle], [low], [checksum]) = (high, middle, low, got);
        let raw = u32::from_be_bytes([0, high, middle, low]);
        Ok(EnergySnapshot { raw, checksum })
    }

    pub(crate) async fn waveform(&mut self) -> Result<Waveform, Error<SPI::Error>> {
        let read = self.read_bits(Field::of::<Waveform>()).await?;
        decoded(read)
    }

    pub(crate) async fn start_temperature(&mut self) -> Result<(), Error<SPI::Error>> {
        // Writing MODE after a reset nobody has noticed would hide the reset.
        let config = self.check_mode().await?;
        let mode = Mode {
            start_temperature: true,
            ..self.expected_mode(&config)
        };
        self.write_bits(MODE, mode.encode()).await
    }

    pub(crate) async fn temperature(&mut self) -> Result<Option<Temp>, Error<SPI::Error>> {
        let mode: Mode = decoded(self.read_bits(MODE).await?)?;
        if mode.start_temperature {
            return Ok(None);
        }
        let read = self.read_bits(Field::of::<Temp>()).await?;
        decoded(read).map(Some)
    }

    pub(crate) async fn take_status(&mut self) -> Result<Interrupts, Error<SPI::Error>> {
        let read = self.take_bits(Field::cleared::<Rststatus>()).await?;
        decoded(read).map(|Rststatus(flags)| flags)
    }

    async fn end_offset_test(&mut self, config: &Config) -> Result<(), Error<SPI::Error>> {
        self.offset_test = false;
        self.write_bits(MODE, config.mode().encode()).await
    }

    async fn short_channel_1(&mut self, config: &Config) -> Result<Aenergy, Error<SPI::Error>> {
        let mode = self.expected_mode(config).encode();
        self.write_bits(MODE, mode).await?;
        self.energy().await
    }

    pub(crate) async fn start_offset_test(&mut self) -> Result<OffsetTest, Error<SPI::Error>> {
        let config = self.check_mode().await?;
        self.offset_test = true;
        match self.short_channel_1(&config).await {
            Ok(start) => Ok(OffsetTest { start }),
            Err(error) => {
                // Not knowing whether channel 1 is shorted is worse than what went wrong first.
                self.end_offset_test(&config).await?;
                Err(error)
            }
        }
    }

    pub(crate) async fn finish_offset_test(
        &mut self,
        test: OffsetTest,
    ) -> Result<EnergyDelta, Error<SPI::Error>> {
        let config = self.configured()?;
        if !self.offset_test {
            return Err(Error::OffsetTestAborted);
        }
        let end = match self.check_mode().await {
            Ok(_) => self.energy().await,
            Err(Error::Reset) => {
                // Restoring MODE would hide the reset; channel 1 is not shorted any more.
                self.offset_test = false;
                return Err(Error::Reset);
            }
            Err(error) => Err(error),
        };
        self.end_offset_test(&config).await?;
        end.map(|end| end.since(test.start))
    }
}

pub(crate) fn decoded<R: Register, E>(read: u32) -> Result<R, Error<E>> {
    R::decode(read).ok_or(Error::ReservedCode {
        register: R::ID,
        read,
    })
}
