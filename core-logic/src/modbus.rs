//! The Modbus server of the board: one register map, declared in tables, behind function codes 03, 04, 06 and 16.
//!
//! Input registers are [`readings::INPUTS`], holding registers are the command register and
//! [`crate::configuration::FIELDS`]; `docs/modbus.md` is written from the same tables.
//!
//! Rules, with the exception that a client sees (*MODBUS Application Protocol V1.1b3*, chapter 7):
//!
//! | what | exception |
//! |---|---|
//! | another function code | 01 illegal function |
//! | a register that does not exist, a gap included | 02 illegal data address |
//! | a quantity of 0 or beyond the function's limit, a length that does not fit | 03 illegal data value |
//! | a part of a value of 32 or 64 bits, reading or writing | 03: the quantity is wrong, not the address |
//! | a value outside its limits, or one that contradicts another setting | 03 |
//! | a command without its key | 03 |
//! | high voltage is on or permitted and the setting or command needs it off | 04 server device failure |
//! | a command that the state has no use for, such as finishing a calibration that was not begun | 04 |
//! | the active configuration failed its check | 04 |
//! | a calibration is under way, or the flash is busy | 06 server device busy: try again |
//! | a setting, while the configuration is being saved or restored | 06 |
//!
//! The standard has no code for "not in this state"; its state diagrams answer 04 wherever carrying out a valid
//! request fails, and keep 06 for what a later repetition mends.
//!
//! A write of many registers is carried out whole or not at all: it changes a copy of the configuration, the copy is
//! checked whole and then takes the place of the active one. Own code in place of `rmodbus`, whose server (0.13)
//! answers an unknown function before it has looked at the CRC, and whose byte-count arithmetic overflows on a made-up
//! length; its client is the tests' independent opposite number.

pub mod readings;
pub mod register;

use heapless::Vec;

use crate::configuration::{self, ConfigurationStore, FIELDS, Field, When};
pub use readings::{Activity, CommandState, INPUTS, Readings};
use register::{Row, locate};

/// Most registers that one request may read (function 03 and 04).
pub const MAX_READ: u16 = 125;
/// Most registers that one request may write (function 16).
pub const MAX_WRITE: u16 = 123;
/// The holding register that takes commands.
pub const COMMAND_ADDRESS: u16 = 0x0000;

/// Why a request was refused; the number is the one on the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[repr(u8)]
pub enum Exception {
    /// The function code is not supported.
    IllegalFunction = 1,
    /// A register does not exist.
    IllegalDataAddress = 2,
    /// The request's structure or a value is wrong.
    IllegalDataValue = 3,
    /// The state does not allow it.
    ServerDeviceFailure = 4,
    /// Not now: repeat it later.
    ServerDeviceBusy = 6,
}

/// What a client can order. On the wire the upper byte is [`Command::KEY`], so that a stray number is no command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[repr(u8)]
pub enum Command {
    /// Take the present reading of the selected range as its zero (D2).
    ZeroNow = 0x01,
    /// Take the factors of D4 anew at the next OFF and ACC.
    StartKeyCalibration = 0x02,
    /// Add a point at 0 A to the supply sweep (D4).
    SupplyPointAtZero = 0x03,
    /// Add a point at the set test current to the supply sweep (D4).
    SupplyPointAtCurrent = 0x04,
    /// Work out k1, m1, k2, m2 from the points and use them (D4).
    FinishSupplyCalibration = 0x05,
    /// End whatever calibration is under way; its previous result stays.
    Abort = 0x06,
    /// Write the active configuration to flash.
    Save = 0x07,
    /// Go back to the configuration in flash.
    Restore = 0x08,
    /// Use the factory's configuration; flash keeps the saved one until the next save.
    FactoryDefaults = 0x09,
    /// Erase the log.
    ClearLog = 0x0A,
    /// Clear latched diagnoses whose cause has gone.
    ClearDiagnoses = 0x0B,
}

impl Command {
    /// Upper byte of every command.
    pub const KEY: u8 = 0x5A;

    /// Every command, in the order of the codes, with its meaning for the documentation.
    pub const ALL: [(Self, &'static str, &'static str); 11] = [
        (
            Self::ZeroNow,
            "zero now",
            "take the present reading of the selected range as its zero",
        ),
        (
            Self::StartKeyCalibration,
            "start key calibration",
            "take the factors k and a anew at the next key OFF and ACC",
        ),
        (
            Self::SupplyPointAtZero,
            "supply point at 0 A",
            "add a point at 0 A to the supply sweep; the first point begins the calibration",
        ),
        (
            Self::SupplyPointAtCurrent,
            "supply point at the test current",
            "add a point at the set test current; the first point begins the calibration",
        ),
        (
            Self::FinishSupplyCalibration,
            "finish supply calibration",
            "work out k1, m1, k2, m2 and use them, without the zero drift and key factors of before",
        ),
        (
            Self::Abort,
            "abort",
            "end the calibration under way, the previous result stays",
        ),
        (
            Self::Save,
            "save",
            "write the active configuration to flash",
        ),
        (
            Self::Restore,
            "restore",
            "go back to the saved configuration",
        ),
        (
            Self::FactoryDefaults,
            "factory defaults",
            "use the factory's configuration, not saved until `save`",
        ),
        (Self::ClearLog, "clear log", "erase the log"),
        (
            Self::ClearDiagnoses,
            "clear diagnoses",
            "clear latched diagnoses whose cause has gone",
        ),
    ];

    /// Every command without the texts, which the board has no use for.
    const COMMANDS: [Self; 11] = {
        let [a, b, c, d, e, f, g, h, i, j, k] = Self::ALL;
        [a.0, b.0, c.0, d.0, e.0, f.0, g.0, h.0, i.0, j.0, k.0]
    };

    /// The value of the command register that orders it.
    #[must_use]
    pub const fn register(self) -> u16 {
        u16::from_be_bytes([Self::KEY, self as u8])
    }

    /// The command that a value of the command register orders.
    #[must_use]
    pub fn from_register(value: u16) -> Option<Self> {
        Self::COMMANDS
            .into_iter()
            .find(|command| command.register() == value)
    }

    /// When it is allowed.
    #[must_use]
    pub const fn when(self) -> CommandRule {
        match self {
            // Not before what is to be saved is in the flash, and not in the place of another order to it, whose end would be
            // taken for this one's.
            Self::ZeroNow
            | Self::StartKeyCalibration
            | Self::Restore
            | Self::FactoryDefaults
            | Self::ClearLog => CommandRule::Idle,
            Self::SupplyPointAtZero | Self::SupplyPointAtCurrent => CommandRule::SupplySweep,
            Self::FinishSupplyCalibration => CommandRule::SupplySweepBegun,
            Self::Save => CommandRule::SaveFree,
            Self::Abort | Self::ClearDiagnoses => CommandRule::Always,
        }
    }
}

/// The state that a command needs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CommandRule {
    /// None.
    Always,
    /// High voltage off, no calibration under way, flash not busy.
    Idle,
    /// High voltage off, no calibration but the supply sweep under way, flash not busy.
    SupplySweep,
    /// High voltage off, the supply sweep under way, flash not busy.
    SupplySweepBegun,
    /// No zero run under way, whose end would be taken for this order's; flash not busy. Another calibration waits for what
    /// may never come, and must not keep a client from saving.
    SaveFree,
}

impl CommandRule {
    /// As the documentation writes it.
    #[must_use]
    pub const fn text(self) -> &'static str {
        match self {
            Self::Always => "always",
            Self::Idle => "high voltage off, no calibration under way, flash not busy",
            Self::SupplySweep => "high voltage off, no other calibration under way, flash not busy",
            Self::SupplySweepBegun => {
                "high voltage off, supply calibration under way, flash not busy"
            }
            Self::SaveFree => "no zero run under way, flash not busy",
        }
    }

    fn check(self, readings: &Readings) -> Result<(), Exception> {
        match self {
            Self::Always => return Ok(()),
            Self::SaveFree if readings.activity == Activity::ZeroDrift => {
                return Err(Exception::ServerDeviceBusy);
            }
            Self::SaveFree => {}
            Self::Idle => When::Standstill.check(readings)?,
            Self::SupplySweep | Self::SupplySweepBegun => {
                let must_be_begun = self == Self::SupplySweepBegun;
                match readings.activity {
                    _ if readings.high_voltage() => return Err(Exception::ServerDeviceFailure),
                    Activity::None if must_be_begun => return Err(Exception::ServerDeviceFailure),
                    Activity::None | Activity::SupplyCalibration => {}
                    Activity::ZeroDrift | Activity::KeyCalibration => {
                        return Err(Exception::ServerDeviceBusy);
                    }
                }
            }
        }
        if readings.storage_busy {
            return Err(Exception::ServerDeviceBusy);
        }
        Ok(())
    }
}

impl When {
    /// Whether the board's state allows a write.
    fn check(self, readings: &Readings) -> Result<(), Exception> {
        match self {
            Self::Always => Ok(()),
            Self::Standstill if readings.high_voltage() => Err(Exception::ServerDeviceFailure),
            Self::Standstill if readings.activity != Activity::None => {
                Err(Exception::ServerDeviceBusy)
            }
            Self::Standstill => Ok(()),
        }
    }
}

/// What the firmware has to do after a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Event {
    /// The active configuration is another one: hand it to the owners of its parts.
    ConfigurationChanged,
    /// An order, its state already checked.
    Command(Command),
}

/// What came of a request, beside the answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Outcome {
    /// The exception that was answered.
    pub exception: Option<Exception>,
    /// What the firmware has to do.
    pub event: Option<Event>,
}

/// Carries out the request `pdu` (function code and data) and appends the answer's to `reply`.
pub fn handle<const N: usize>(
    pdu: &[u8],
    readings: &Readings,
    store: &mut ConfigurationStore,
    reply: &mut Vec<u8, N>,
) -> Outcome {
    let begin = reply.len();
    match answer(pdu, readings, store, reply) {
        Ok(event) => Outcome {
            exception: None,
            event,
        },
        Err(exception) => {
            reply.truncate(begin);
            let function = pdu.first().copied().unwrap_or_default();
            let _ = reply.extend_from_slice(&[function | 0x80, exception as u8]);
            Outcome {
                exception: Some(exception),
                event: None,
            }
        }
    }
}

fn word(bytes: [u8; 2]) -> u16 {
    u16::from_be_bytes(bytes)
}

fn answer<const N: usize>(
    pdu: &[u8],
    readings: &Readings,
    store: &mut ConfigurationStore,
    reply: &mut Vec<u8, N>,
) -> Result<Option<Event>, Exception> {
    let (function, data) = pdu.split_first().ok_or(Exception::IllegalFunction)?;
    match function {
        0x03 | 0x04 => {
            let &[a, b, c, d] = data else {
                return Err(Exception::IllegalDataValue);
            };
            let (address, quantity) = (word([a, b]), word([c, d]));
            if quantity == 0 || quantity > MAX_READ {
                return Err(Exception::IllegalDataValue);
            }
            let bytes = u8::try_from(quantity * 2).map_err(|_| Exception::IllegalDataValue)?;
            put(reply, &[*function, bytes])?;
            if *function == 0x04 {
                read(INPUTS, address, quantity, reply, |row, element| {
                    row.get(readings, element)
                })?;
            } else if address == COMMAND_ADDRESS {
                if quantity != 1 {
                    return Err(Exception::IllegalDataAddress);
                }
                put(reply, &readings.last_command.to_be_bytes())?;
            } else {
                let mut active = *store.active();
                read(FIELDS, address, quantity, reply, |field, element| {
                    field.get_in(&mut active, element).unwrap_or_default()
                })?;
            }
            Ok(None)
        }
        0x06 => {
            let &[a, b, c, d] = data else {
                return Err(Exception::IllegalDataValue);
            };
            let event = write(word([a, b]), &[c, d], readings, store)?;
            put(reply, pdu)?;
            Ok(Some(event))
        }
        0x10 => {
            let &[a, b, c, d, bytes, ref values @ ..] = data else {
                return Err(Exception::IllegalDataValue);
            };
            let quantity = word([c, d]);
            if quantity == 0
                || quantity > MAX_WRITE
                || u16::from(bytes) != quantity * 2
                || values.len() != usize::from(bytes)
            {
                return Err(Exception::IllegalDataValue);
            }
            let event = write(word([a, b]), values, readings, store)?;
            put(reply, &[*function, a, b, c, d])?;
            Ok(Some(event))
        }
        _ => Err(Exception::IllegalFunction),
    }
}

/// The answer's buffer holds any answer that the limits allow; should it not, the client is told.
fn put<const N: usize>(reply: &mut Vec<u8, N>, bytes: &[u8]) -> Result<(), Exception> {
    reply
        .extend_from_slice(bytes)
        .map_err(|_| Exception::ServerDeviceFailure)
}

/// Checks that `quantity` registers from `address` exist and are whole values, and hands each value's row and index to
/// `each`. Addresses are judged first, as the standard's state diagrams do.
fn for_each<R: Row>(
    table: &'static [R],
    address: u16,
    quantity: u16,
    each: &mut dyn FnMut(&'static R, usize) -> Result<(), Exception>,
) -> Result<(), Exception> {
    let end = address
        .checked_add(quantity)
        .ok_or(Exception::IllegalDataAddress)?;
    let mut whole = true;
    for register in address..end {
        let (row, place) = locate(table, register).ok_or(Exception::IllegalDataAddress)?;
        let last_word = row.layout().kind.width() - 1;
        if (register == address && place.word != 0)
            || (end - register == 1 && place.word != last_word)
        {
            whole = false;
        }
    }
    if !whole {
        return Err(Exception::IllegalDataValue);
    }
    let mut register = address;
    while register < end {
        let (row, place) = locate(table, register).ok_or(Exception::IllegalDataAddress)?;
        each(row, place.element)?;
        register = register.saturating_add(row.layout().kind.width());
    }
    Ok(())
}

fn read<R: Row, const N: usize>(
    table: &'static [R],
    address: u16,
    quantity: u16,
    reply: &mut Vec<u8, N>,
    mut value: impl FnMut(&R, usize) -> i64,
) -> Result<(), Exception> {
    for_each(table, address, quantity, &mut |row, element| {
        let kind = row.layout().kind;
        let value = value(row, element);
        for word in 0..kind.width() {
            put(reply, &kind.word(value, word).to_be_bytes())?;
        }
        Ok(())
    })
}

fn write(
    address: u16,
    values: &[u8],
    readings: &Readings,
    store: &mut ConfigurationStore,
) -> Result<Event, Exception> {
    if address == COMMAND_ADDRESS {
        return command(values, readings);
    }
    let quantity = u16::try_from(values.len() / 2).map_err(|_| Exception::IllegalDataValue)?;
    let mut staged = *store.stage().map_err(|_| Exception::ServerDeviceFailure)?;
    for_each(FIELDS, address, quantity, &mut |field: &Field, _| {
        field.when.check(readings)
    })?;
    // What is saved is what was in force at the order, and what is restored is not changed before it is there.
    if readings.configuration_in_transfer {
        return Err(Exception::ServerDeviceBusy);
    }
    let mut words = values
        .iter()
        .zip(values.iter().skip(1))
        .step_by(2)
        .map(|(high, low)| word([*high, *low]));
    for_each(FIELDS, address, quantity, &mut |field: &Field, element| {
        let kind = field.layout.kind;
        let bits = words
            .by_ref()
            .take(usize::from(kind.width()))
            .fold(0, |bits, word| bits << 16 | u64::from(word));
        field
            .put(&mut staged, element, kind.value(bits))
            .map_err(|_: configuration::Violation| Exception::IllegalDataValue)
    })?;
    store
        .commit(staged)
        .map_err(|_| Exception::IllegalDataValue)?;
    Ok(Event::ConfigurationChanged)
}

fn command(values: &[u8], readings: &Readings) -> Result<Event, Exception> {
    // No register follows the command register.
    let &[high, low] = values else {
        return Err(Exception::IllegalDataAddress);
    };
    let command = Command::from_register(word([high, low])).ok_or(Exception::IllegalDataValue)?;
    command.when().check(readings)?;
    Ok(Event::Command(command))
}

#[cfg(test)]
#[allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss
)]
mod tests;
