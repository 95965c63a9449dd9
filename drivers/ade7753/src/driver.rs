//! The driver's logic, once for both flavours.

use core::slice;

use embedded_hal::spi::Operation;

use crate::config::Config;
use crate::error::{Error, StuckLevel};
use crate::registers::{
    Aenergy, Cfnum, Ch1os, ClearedByRead, Dierev, EnergyDelta, Gain, Interrupts, Mode,
    NonDestructive, Register, RegisterId, Rststatus, Status, Temp, Waveform, Width, Writable,
};
use crate::timing::Timing;
use crate::transport::Transport;

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

#[derive(Debug)]
pub(crate) struct Core<T> {
    pub(crate) transport: T,
    pub(crate) options: Options,
    pub(crate) statistics: Statistics,
    config: Option<Config>,
    die_revision: Option<Dierev>,
    offset_test: bool,
}

impl<T> Core<T> {
    pub(crate) fn new(transport: T, options: Options) -> Self {
        Self {
            transport,
            options,
            statistics: Statistics::default(),
            config: None,
            die_revision: None,
            offset_test: false,
        }
    }

    pub(crate) fn config(&self) -> Option<&Config> {
        self.config.as_ref()
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

/// The number in bytes that came most significant first.
fn from_big_endian(bytes: &[u8]) -> u32 {
    bytes
        .iter()
        .fold(0, |number, &byte| number << 8 | u32::from(byte))
}

fn count(counter: &mut u32) {
    *counter = counter.saturating_add(1);
}

impl<T: Transport> Core<T> {
    async fn transfer(
        &mut self,
        register: RegisterId,
        operations: &mut [Operation<'_, u8>],
    ) -> Result<(), Error<T::Error>> {
        let result = self.transport.transaction(operations).await;
        result.map_err(|source| {
            count(&mut self.statistics.bus_errors);
            Error::Bus { register, source }
        })
    }

    /// One read under one chip select, unchecked.
    async fn receive(
        &mut self,
        register: RegisterId,
        width: Width,
    ) -> Result<u32, Error<T::Error>> {
        let command = [register.address()];
        let mut buffer = [0; 3];
        let data = buffer.get_mut(..width.bytes()).unwrap_or_default();
        let timing = self.options.timing;
        let write = Operation::Write(&command);
        let wait = Operation::DelayNs(timing.command_to_data_ns);
        let gap = || Operation::DelayNs(timing.read_byte_gap_ns);
        match data {
            [high, low] if timing.read_byte_gap_ns > 0 => {
                let high = Operation::Read(slice::from_mut(high));
                let low = Operation::Read(slice::from_mut(low));
                self.transfer(register, &mut [write, wait, high, gap(), low])
                    .await?;
            }
            [high, middle, low] if timing.read_byte_gap_ns > 0 => {
                let high = Operation::Read(slice::from_mut(high));
                let middle = Operation::Read(slice::from_mut(middle));
                let low = Operation::Read(slice::from_mut(low));
                self.transfer(
                    register,
                    &mut [write, wait, high, gap(), middle, gap(), low],
                )
                .await?;
            }
            whole => {
                self.transfer(register, &mut [write, wait, Operation::Read(whole)])
                    .await?;
            }
        }
        Ok(from_big_endian(
            buffer.get(..width.bytes()).unwrap_or_default(),
        ))
    }

    /// One write under one chip select, unverified.
    async fn send(
        &mut self,
        register: RegisterId,
        width: Width,
        raw: u32,
        after_ns: u32,
    ) -> Result<(), Error<T::Error>> {
        let command = [WRITE | register.address()];
        let [_, _, high, low] = raw.to_be_bytes();
        let (high, low) = ([high], [low]);
        let gap = || Operation::DelayNs(self.options.timing.write_byte_gap_ns);
        let command = Operation::Write(&command);
        let low = Operation::Write(&low);
        // The gap belongs to the transaction: nobody else on the bus can then shorten it.
        let after = Operation::DelayNs(after_ns);
        match width {
            Width::One => {
                let operations = &mut [command, gap(), low, after];
                self.transfer(register, operations).await
            }
            // No register of 24 bits can be written.
            Width::Two | Width::Three => {
                let high = Operation::Write(&high);
                let operations = &mut [command, gap(), high, gap(), low, after];
                self.transfer(register, operations).await
            }
        }
    }

    /// Data and CHKSUM, each under its own chip select, whose falling edge resynchronises the chip's interface.
    async fn read_checked(
        &mut self,
        register: RegisterId,
        width: Width,
    ) -> Result<u32, Error<T::Error>> {
        let read = self.receive(register, width).await?;
        let got = self.receive(RegisterId::Chksum, Width::One).await?;
        let [got, ..] = got.to_le_bytes();
        let result = check(register, width, read, got);
        if result.is_err() {
            count(&mut self.statistics.checksum_failures);
        }
        result.map(|()| read)
    }

    async fn read_bits<R: NonDestructive>(&mut self) -> Result<u32, Error<T::Error>> {
        let mut retries_left = self.options.retries;
        loop {
            match self.read_checked(R::ID, R::WIDTH).await {
                Err(Error::Checksum { .. } | Error::DeadBus { .. }) if retries_left > 0 => {
                    retries_left -= 1;
                    count(&mut self.statistics.retries);
                }
                result => return result,
            }
        }
    }

    pub(crate) async fn read<R: NonDestructive>(&mut self) -> Result<R, Error<T::Error>> {
        let read = self.read_bits::<R>().await?;
        decoded(read)
    }

    pub(crate) async fn read_and_clear<R: ClearedByRead>(&mut self) -> Result<R, Error<T::Error>> {
        let read = self.read_checked(R::ID, R::WIDTH).await?;
        decoded(read)
    }

    pub(crate) async fn write<R: Writable>(&mut self, value: R) -> Result<(), Error<T::Error>> {
        let register = R::ID;
        let Some(written) = value.encode() else {
            return Err(Error::ValueOutOfRange { register });
        };
        let after_write_ns = self.options.timing.after_write_ns;
        let mut retries_left = self.options.retries;
        loop {
            self.send(register, R::WIDTH, written, after_write_ns)
                .await?;
            let read = self.read_bits::<R>().await?;
            if (read ^ written) & R::VERIFY_MASK == 0 {
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

    pub(crate) async fn software_reset(&mut self) -> Result<(), Error<T::Error>> {
        // Without a configuration an offset test cannot be finished either; `configure` forgets it.
        self.config = None;
        let after_reset_ns = self.options.timing.after_reset_ns;
        self.send(
            RegisterId::Mode,
            Mode::WIDTH,
            MODE_RESET | MODE_SWRST,
            after_reset_ns,
        )
        .await?;
        let read = self.read_bits::<Mode>().await?;
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

    pub(crate) async fn configure(&mut self, config: &Config) -> Result<(), Error<T::Error>> {
        self.config = None;
        self.offset_test = false;
        if self.read_bits::<Mode>().await? == 0 {
            self.check_stuck_low().await?;
        }
        self.write(config.gain).await?;
        self.write(config.ch1os()).await?;
        self.write(config.ch2os()).await?;
        self.write(config.cfnum()).await?;
        self.write(config.mode()).await?;
        self.write(config.irqen()).await?;
        self.die_revision = Some(self.read().await?);
        self.clear_reset_flag().await?;
        self.config = Some(*config);
        Ok(())
    }

    /// Clears the flags and makes sure that RESET is among them, so that the next RESET is a new one.
    async fn clear_reset_flag(&mut self) -> Result<(), Error<T::Error>> {
        let mut retries_left = self.options.retries;
        loop {
            // The flags themselves do not matter here, so neither does their checksum.
            self.receive(RegisterId::Rststatus, Rststatus::WIDTH)
                .await?;
            let read = self.read_bits::<Status>().await?;
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
    async fn check_stuck_low(&mut self) -> Result<(), Error<T::Error>> {
        if self.read_bits::<Cfnum>().await? == 0 && self.read_bits::<Dierev>().await? == 0 {
            return Err(Error::DeadBus {
                register: RegisterId::Mode,
                level: StuckLevel::Low,
            });
        }
        Ok(())
    }

    fn configured(&self) -> Result<Config, Error<T::Error>> {
        self.config.ok_or(Error::NotConfigured)
    }

    /// MODE as configured, with what a running test changes in it.
    fn expected_mode(&self, config: &Config) -> Mode {
        Mode {
            short_channel_1: self.offset_test,
            ..config.mode()
        }
    }

    async fn check_mode(&mut self) -> Result<Config, Error<T::Error>> {
        let config = self.configured()?;
        let expected = self.expected_mode(&config).bits().into();
        let read = self.read_bits::<Mode>().await?;
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

    async fn check_register<R: NonDestructive>(
        &mut self,
        expected: u32,
        mask: u32,
    ) -> Result<(), Error<T::Error>> {
        let read = self.read_bits::<R>().await?;
        if (read ^ expected) & mask == 0 {
            return Ok(());
        }
        Err(Error::Configuration {
            register: R::ID,
            expected,
            read,
        })
    }

    pub(crate) async fn verify_configuration(&mut self) -> Result<(), Error<T::Error>> {
        let config = self.check_mode().await?;
        let gain = config.gain.bits().into();
        self.check_register::<Gain>(gain, Gain::VERIFY_MASK).await?;
        let ch1os = config.ch1os().bits().into();
        self.check_register::<Ch1os>(ch1os, Ch1os::VERIFY_MASK)
            .await?;
        let cfnum = config.cf_numerator.get().into();
        self.check_register::<Cfnum>(cfnum, Cfnum::VERIFY_MASK)
            .await?;
        if let Some(Dierev(revision)) = self.die_revision {
            self.check_register::<Dierev>(revision.into(), 0xFF).await?;
        }
        Ok(())
    }

    pub(crate) async fn reset_detected(&mut self) -> Result<bool, Error<T::Error>> {
        let Status(status) = self.read().await?;
        if status.contains(Interrupts::RESET) {
            return Ok(true);
        }
        Ok(self.read_bits::<Mode>().await? == MODE_RESET)
    }

    pub(crate) async fn energy(&mut self) -> Result<Aenergy, Error<T::Error>> {
        self.read().await
    }

    pub(crate) async fn energy_snapshot(&mut self) -> Result<EnergySnapshot, Error<T::Error>> {
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
            self.transfer(RegisterId::Aenergy, operations).await?;
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
            self.transfer(RegisterId::Aenergy, operations).await?;
        }
        let ([high], [middle], [low], [checksum]) = (high, middle, low, got);
        let raw = u32::from_be_bytes([0, high, middle, low]);
        Ok(EnergySnapshot { raw, checksum })
    }

    pub(crate) async fn waveform(&mut self) -> Result<Waveform, Error<T::Error>> {
        self.read().await
    }

    pub(crate) async fn start_temperature(&mut self) -> Result<(), Error<T::Error>> {
        // Writing MODE after a reset nobody has noticed would hide the reset.
        let config = self.check_mode().await?;
        let mode = Mode {
            start_temperature: true,
            ..self.expected_mode(&config)
        };
        self.write(mode).await
    }

    pub(crate) async fn temperature(&mut self) -> Result<Option<Temp>, Error<T::Error>> {
        let mode: Mode = self.read().await?;
        if mode.start_temperature {
            return Ok(None);
        }
        self.read().await.map(Some)
    }

    pub(crate) async fn take_status(&mut self) -> Result<Interrupts, Error<T::Error>> {
        let Rststatus(flags) = self.read_and_clear().await?;
        Ok(flags)
    }

    async fn end_offset_test(&mut self, config: &Config) -> Result<(), Error<T::Error>> {
        self.offset_test = false;
        self.write(config.mode()).await
    }

    async fn short_channel_1(&mut self, config: &Config) -> Result<Aenergy, Error<T::Error>> {
        self.write(self.expected_mode(config)).await?;
        self.read().await
    }

    pub(crate) async fn start_offset_test(&mut self) -> Result<OffsetTest, Error<T::Error>> {
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
    ) -> Result<EnergyDelta, Error<T::Error>> {
        let config = self.configured()?;
        if !self.offset_test {
            return Err(Error::OffsetTestAborted);
        }
        let end = match self.check_mode().await {
            Ok(_) => self.read::<Aenergy>().await,
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

fn decoded<R: Register, E>(read: u32) -> Result<R, Error<E>> {
    R::decode(read).ok_or(Error::ReservedCode {
        register: R::ID,
        read,
    })
}
