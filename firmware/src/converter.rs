//! The ADS1100's owner, at priority 1: one single conversion after the other.
//!
//! The chip is asked when the last conversion's time has passed and then once a millisecond until its time-out. A transfer takes
//! 0.1 ms; a bus that hangs costs 1.5 ms, a recovery of 0.1 ms and one sample.

use ads1100::{Address, Ads1100, Conversion, Error, Sample};
use core_logic::{
    converter::{ConverterConfig, DataRate, Gain},
    measurement::ConverterFault,
};

use crate::i2c;

/// Where the chip may be: D2 names the ADS1100A1; until one has answered, the others are tried, since the marking is
/// easily misread.
const ADDRESSES: [Address; 8] = [
    Address::A1,
    Address::A0,
    Address::A2,
    Address::A3,
    Address::A4,
    Address::A5,
    Address::A6,
    Address::A7,
];

/// How far a conversion is.
pub enum Progress {
    /// Under way.
    Busy,
    /// Finished, but perhaps not the one that was started: no result.
    Discarded,
    /// Finished.
    Ready(Sample),
}

/// The chip. Its bus is inside; [`Converter::recover`] gets at it.
pub struct Converter {
    chip: Option<Ads1100<i2c::Bus>>,
    address: usize,
    address_known: bool,
    counters: Counters,
}

/// What happened since the start; each stops at its end.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Bus errors.
    pub bus_errors: u32,
    /// Recoveries that freed the bus.
    pub recoveries: u32,
    /// Recoveries that did not.
    pub stuck: u32,
    /// Times the chip had lost its configuration.
    pub resets: u32,
    /// Conversions that did not end in time.
    pub timeouts: u32,
}

fn count(counter: &mut u32) {
    *counter = counter.saturating_add(1);
}

/// The driver's settings for the configuration.
fn settings(config: &ConverterConfig) -> ads1100::Settings {
    ads1100::Settings {
        data_rate: match config.data_rate {
            DataRate::Sps128 => ads1100::DataRate::Sps128,
            DataRate::Sps32 => ads1100::DataRate::Sps32,
            DataRate::Sps16 => ads1100::DataRate::Sps16,
            DataRate::Sps8 => ads1100::DataRate::Sps8,
        },
        gain: match config.gain {
            Gain::X1 => ads1100::Gain::X1,
            Gain::X2 => ads1100::Gain::X2,
            Gain::X4 => ads1100::Gain::X4,
            Gain::X8 => ads1100::Gain::X8,
        },
    }
}

impl Converter {
    /// Takes the bus. No transfer takes place.
    pub fn new(bus: i2c::Bus, config: &ConverterConfig) -> Self {
        Self {
            chip: Some(Ads1100::new(bus, Address::A1, settings(config))),
            address: 0,
            address_known: false,
            counters: Counters::default(),
        }
    }

    /// Starts a conversion with the settings of the configuration; until a chip has answered, at whichever address one does.
    pub fn start(&mut self, config: &ConverterConfig) -> Result<(), ConverterFault> {
        let wanted = settings(config);
        let mut untried = ADDRESSES.len();
        loop {
            let address = self.address;
            let result = match &mut self.chip {
                Some(chip) => {
                    if chip.settings() != wanted {
                        chip.set_settings(wanted);
                    }
                    chip.start()
                }
                None => Err(Error::NotStarted),
            };
            let Err(error) = result else {
                return Ok(());
            };
            let fault = self.on_error(&error, config);
            untried -= 1;
            if untried == 0 || self.address == address {
                return Err(fault);
            }
        }
    }

    /// How far the conversion is.
    pub fn poll(&mut self, config: &ConverterConfig) -> Result<Progress, ConverterFault> {
        let result = match &mut self.chip {
            Some(chip) => chip.poll(),
            None => Err(Error::NotStarted),
        };
        match result {
            Ok(Conversion::Busy) => Ok(Progress::Busy),
            Ok(Conversion::Discarded) => Ok(Progress::Discarded),
            Ok(Conversion::Ready(sample)) => {
                self.address_known = true;
                Ok(Progress::Ready(sample))
            }
            Err(error) => Err(self.on_error(&error, config)),
        }
    }

    /// The longest that the conversion under way takes from its start.
    pub fn longest_ms(&self) -> u32 {
        let longest_us = self.chip.as_ref().map_or(0, Ads1100::timeout_us);
        longest_us.div_ceil(1_000)
    }

    /// A conversion did not end in time.
    pub fn on_timeout(&mut self) {
        count(&mut self.counters.timeouts);
    }

    fn address(&self) -> Address {
        ADDRESSES.get(self.address).copied().unwrap_or_default()
    }

    fn on_error(&mut self, error: &Error<i2c::Error>, config: &ConverterConfig) -> ConverterFault {
        match error {
            Error::Bus { source, .. } => {
                count(&mut self.counters.bus_errors);
                if *source == i2c::Error::NoAddressAcknowledge && !self.address_known {
                    self.address = (self.address + 1) % ADDRESSES.len();
                }
                self.recover(config);
                ConverterFault::NoAnswer
            }
            Error::ConfigurationLost { .. } => {
                count(&mut self.counters.resets);
                ConverterFault::ConfigurationLost
            }
            _ => ConverterFault::NoAnswer,
        }
    }

    fn recover(&mut self, config: &ConverterConfig) {
        if let Some(chip) = self.chip.take() {
            let mut bus = chip.release();
            match bus.recover() {
                Ok(()) => count(&mut self.counters.recoveries),
                Err(_) => count(&mut self.counters.stuck),
            }
            self.chip = Some(Ads1100::new(bus, self.address(), settings(config)));
        }
    }

    /// What happened so far.
    pub const fn counters(&self) -> Counters {
        self.counters
    }
}
