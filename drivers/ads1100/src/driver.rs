//! The driver's logic, once for both flavours.

use both_flavours::both_flavours;

use crate::error::{Error, Operation};
use crate::sample::Sample;
use crate::settings::{Address, DataRate, Settings};
#[cfg(feature = "async")]
use crate::transport::Asynchronous;
use crate::transport::Blocking;

/// Bit 7: written, starts a single conversion; read, a conversion is under way.
const ST_BSY: u8 = 0x80;
/// Bit 4: single conversions.
const SC: u8 = 0x10;

/// The general call address and its reset command.
const GENERAL_CALL: u8 = 0x00;
const GENERAL_CALL_RESET: u8 = 0x06;

/// What a poll found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Conversion {
    /// Not finished yet: poll again later.
    Busy,
    /// Finished, but the result may be another conversion's: the first since power-up or a reset, after which the output register
    /// reads 0 as if that were a result, and the one after a start while another was under way, which goes on. Start the next one.
    Discarded,
    /// Finished; this result has not been delivered before.
    Ready(Sample),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Idle,
    Single,
    Continuous,
}

#[derive(Debug)]
pub(crate) struct Core<T> {
    pub(crate) transport: T,
    address: Address,
    settings: Settings,
    state: State,
    /// The next single conversion is the first since power-up or a reset.
    first: bool,
    /// When it was started another one may have been under way.
    restarted: bool,
    /// What was last written to the configuration register, if it is known that the chip took it.
    written: Option<u8>,
}

impl<T> Core<T> {
    pub(crate) fn new(transport: T, address: Address, settings: Settings) -> Self {
        Self {
            transport,
            address,
            settings,
            state: State::Idle,
            first: true,
            restarted: false,
            written: None,
        }
    }

    pub(crate) fn settings(&self) -> Settings {
        self.settings
    }

    pub(crate) fn set_settings(&mut self, settings: Settings) {
        self.settings = settings;
        self.abandon();
    }

    /// Of the conversion under way nothing more is wanted. It goes on all the same.
    fn abandon(&mut self) {
        self.restarted |= self.state != State::Idle;
        self.state = State::Idle;
    }

    /// The longest that the conversion under way takes.
    pub(crate) fn timeout_us(&self) -> u32 {
        // The chip's own, with the settings that it comes up with, ends first.
        let own = if self.first {
            DataRate::default().timeout_us()
        } else {
            0
        };
        self.settings.data_rate.timeout_us().max(own)
    }
}

#[both_flavours]
impl<I2C: embedded_hal_async::i2c::I2c> Core<Asynchronous<I2C>> {
    async fn write(&mut self, configuration: u8) -> Result<(), Error<I2C::Error>> {
        self.written = None;
        let result = self
            .transport
            .0
            .write(self.address.bits(), &[configuration])
            .await;
        result.map_err(|source| Error::Bus {
            operation: Operation::WriteConfiguration,
            source,
        })?;
        self.written = Some(configuration);
        Ok(())
    }

    /// Code and busy flag of a three-byte read whose configuration is as written, disregarding ST/BSY.
    async fn read(&mut self, expected: u8) -> Result<(i16, bool), Error<I2C::Error>> {
        let mut data = [0; 3];
        let result = self.transport.0.read(self.address.bits(), &mut data).await;
        result.map_err(|source| Error::Bus {
            operation: Operation::ReadOutput,
            source,
        })?;
        let [high, low, read] = data;
        if (read ^ expected) & !ST_BSY != 0 {
            return Err(self.lost(expected, read));
        }
        Ok((i16::from_be_bytes([high, low]), read & ST_BSY != 0))
    }

    fn lost(&mut self, expected: u8, read: u8) -> Error<I2C::Error> {
        self.state = State::Idle;
        self.first = true;
        self.written = None;
        Error::ConfigurationLost { expected, read }
    }

    fn sample(&self, code: i16) -> Result<Sample, Error<I2C::Error>> {
        let settings = self.settings;
        let data_rate = settings.data_rate;
        if (data_rate.min_code()..=data_rate.max_code()).contains(&code) {
            Ok(Sample { code, settings })
        } else {
            Err(Error::CodeOutOfRange { code, data_rate })
        }
    }

    pub(crate) async fn start(&mut self) -> Result<(), Error<I2C::Error>> {
        if let (State::Idle, Some(written)) = (self.state, self.written) {
            // After a reset since the last result the chip would end its own conversion first, and the write would hide it.
            self.read(written).await?;
        }
        self.abandon();
        let result = self.write(ST_BSY | SC | self.settings.bits()).await;
        // The chip may have taken it.
        self.restarted |= result.is_err();
        result?;
        self.state = State::Single;
        Ok(())
    }

    pub(crate) async fn poll(&mut self) -> Result<Conversion, Error<I2C::Error>> {
        if self.state != State::Single {
            return Err(Error::NotStarted);
        }
        let (code, busy) = self.read(ST_BSY | SC | self.settings.bits()).await?;
        if busy {
            return Ok(Conversion::Busy);
        }
        self.state = State::Idle;
        let restarted = core::mem::take(&mut self.restarted);
        if core::mem::take(&mut self.first) || restarted {
            return Ok(Conversion::Discarded);
        }
        self.sample(code).map(Conversion::Ready)
    }

    pub(crate) async fn start_continuous(&mut self) -> Result<(), Error<I2C::Error>> {
        self.state = State::Idle;
        self.write(ST_BSY | self.settings.bits()).await?;
        self.state = State::Continuous;
        Ok(())
    }

    pub(crate) async fn read_continuous(&mut self) -> Result<Sample, Error<I2C::Error>> {
        if self.state != State::Continuous {
            return Err(Error::NotStarted);
        }
        let expected = ST_BSY | self.settings.bits();
        let (code, busy) = self.read(expected).await?;
        if !busy {
            // ST/BSY always reads 1 in this mode.
            return Err(self.lost(expected, expected & !ST_BSY));
        }
        self.sample(code)
    }

    pub(crate) async fn general_call_reset(&mut self) -> Result<(), Error<I2C::Error>> {
        self.state = State::Idle;
        self.first = true;
        self.written = None;
        let result = self
            .transport
            .0
            .write(GENERAL_CALL, &[GENERAL_CALL_RESET])
            .await;
        result.map_err(|source| Error::Bus {
            operation: Operation::GeneralCallReset,
            source,
        })
    }
}
