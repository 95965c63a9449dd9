//! Registers that correct the board, from a file such as `twin explain` writes, brought onto it as a technician does: by
//! Modbus over RS485 on a parked vehicle, read back, saved.

use std::collections::HashSet;
use std::fmt::Display;
use std::path::Path;

use anyhow::{Context as _, Result, bail, ensure};
use serde::{Deserialize, Serialize};
use toml::Spanned;

use core_logic::configuration::{Configuration, FIELD_TEXTS, FIELDS};
use core_logic::modbus::readings::{INPUT_TEXTS, INPUTS};
use core_logic::modbus::register::{Kind, Layout};
use core_logic::modbus::{COMMAND_ADDRESS, Command};

use crate::rig::{Firmware, Rig, Setup};
use crate::scenario::{Contactors, Key, Row, Scenario};
use crate::time::Ticks;

/// The board's address from the factory.
const SERVER: u8 = 1;
/// Functions of docs/modbus.md.
const READ_HOLDING: u8 = 0x03;
const READ_INPUT: u8 = 0x04;
const WRITE_ONE: u8 = 0x06;
const WRITE_MANY: u8 = 0x10;
/// Added to the function in an answer that refuses.
const REFUSED: u8 = 0x80;
/// The server is busy: repeat it later.
const BUSY: u8 = 0x06;
/// A request that stays without an answer is sent so often, as masters do on a line with noise.
const ATTEMPTS: u32 = 3;
/// A start takes up to 0.45 s until the board answers.
const BOOT_S: f64 = 0.8;
/// Time between two looks at something that takes its time, and how often it is looked at: 10 s.
const PACE: Ticks = Ticks::from_millis(20);
const LOOKS: u32 = 500;
/// Settings that make another board of it, or one that is no longer found on the line.
const NO_CALIBRATION: [&str; 2] = ["front end", "Modbus address"];

/// A file as it is written.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    #[serde(default)]
    register: Vec<Spanned<Entry>>,
}

/// A setting: of both sensors, or one value.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    name: String,
    address: Option<u16>,
    unit: Option<String>,
    small: Option<i64>,
    large: Option<i64>,
    value: Option<i64>,
}

/// Settings to write, in their order, each whole.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Calibration {
    registers: Vec<Register>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
struct Register {
    name: &'static str,
    layout: Layout,
    values: Vec<i64>,
}

impl Calibration {
    /// Reads a file and judges it as the board will: names, places, limits, and values that contradict each other.
    ///
    /// # Errors
    /// The first thing that is wrong, with file, line and key, and what was expected.
    pub fn read(path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path)
            .map_err(|error| recording::Error::reading(path, &error))?;
        Self::parse(&text).with_context(|| path.display().to_string())
    }

    fn parse(text: &str) -> Result<Self> {
        let line = |at: usize| text[..at.min(text.len())].matches('\n').count() + 1;
        let file: File = toml::from_str(text).map_err(|error| {
            let at = error.span().map_or(0, |span| span.start);
            let message = error.message().lines().collect::<Vec<_>>().join(" ");
            anyhow::anyhow!("line {}: {message}", line(at))
        })?;
        ensure!(
            !file.register.is_empty(),
            "found no [[register]], expected at least one"
        );
        let mut configuration = Configuration::default();
        let mut known = HashSet::new();
        let mut registers = Vec::new();
        for entry in &file.register {
            let place = || format!("line {}", line(entry.span().start));
            let entry = entry.get_ref();
            let register = entry.register().with_context(place)?;
            ensure!(
                known.insert(register.name),
                "{}: name: found {:?} a second time, expected each register once",
                place(),
                register.name
            );
            // One after the other, as the board judges each write.
            register.put(&mut configuration).with_context(place)?;
            registers.push(register);
        }
        Ok(Self { registers })
    }

    /// Number of settings.
    pub fn len(&self) -> usize {
        self.registers.len()
    }

    /// Whether there is nothing to write; a file without a setting is refused.
    pub fn is_empty(&self) -> bool {
        self.registers.is_empty()
    }
}

impl Entry {
    fn register(&self) -> Result<Register> {
        let name = &self.name;
        let Some((field, text)) = FIELDS
            .iter()
            .zip(FIELD_TEXTS)
            .find(|(_, text)| text.name == *name)
            .filter(|(_, text)| !NO_CALIBRATION.contains(&text.name))
        else {
            bail!(
                "name: found {name:?}, expected a setting of docs/configuration.md that calibrates"
            );
        };
        let layout = field.layout;
        if let Some(address) = self.address.filter(|address| *address != layout.address) {
            bail!(
                "{name}: address: found {address:#06X}, expected {:#06X}",
                layout.address
            );
        }
        if let Some(unit) = self.unit.as_ref().filter(|unit| *unit != text.unit) {
            bail!("{name}: unit: found {unit:?}, expected {:?}", text.unit);
        }
        let values = match (layout.count, self.value, self.small, self.large) {
            (1, Some(value), None, None) => vec![value],
            (2, None, Some(small), Some(large)) => vec![small, large],
            (1, ..) => bail!("{name}: expected one whole number, `value`"),
            (2, ..) => bail!("{name}: expected two whole numbers, `small` and `large`"),
            _ => bail!("{name}: found a table, expected a setting of one or two values"),
        };
        let keys = if values.len() == 2 {
            &["small", "large"][..]
        } else {
            &["value"]
        };
        for (key, value) in keys.iter().zip(&values) {
            let (min, max) = field.limits();
            ensure!(
                (min..=max).contains(value),
                "{name}: {key}: found {value}, expected {min} to {max} {}",
                text.unit
            );
        }
        Ok(Register {
            name: text.name,
            layout,
            values,
        })
    }
}

impl Register {
    /// Has it in `configuration`, which must then be one that the board takes.
    fn put(&self, configuration: &mut Configuration) -> Result<()> {
        let refused =
            |why: &dyn Display| anyhow::anyhow!("{}: the board refuses: {why}", self.name);
        let field = FIELDS
            .iter()
            .find(|field| field.layout.address == self.layout.address)
            .context("a setting without a place")?;
        for (element, value) in self.values.iter().enumerate() {
            field
                .put(configuration, element, *value)
                .map_err(|violation| refused(&violation))?;
        }
        configuration
            .validate()
            .map_err(|violation| refused(&violation))
    }

    fn words(&self) -> Vec<u16> {
        let kind = self.layout.kind;
        self.values
            .iter()
            .flat_map(|value| (0..kind.width()).map(move |word| kind.word(*value, word)))
            .collect()
    }
}

/// What was done.
#[derive(Clone, Debug, Serialize)]
pub struct Account {
    /// Settings written and read back.
    pub registers: usize,
    /// Requests on the line.
    pub requests: u32,
    /// From power on to power off, in s of virtual time.
    pub length_s: f64,
}

/// A board with the sensors of `setup` on a parked vehicle: written to, read back, told to save, and switched off; the flash chip's
/// content, for the board that drives.
///
/// # Errors
/// If the board refuses or does not answer, or the image does what is not modelled.
pub fn commission(
    firmware: &Firmware,
    setup: Setup,
    calibration: &Calibration,
) -> Result<(Vec<u8>, Account)> {
    let parked = Scenario::steady(Row::at_rest(0.0).with_key(Key::Off), Contactors::Permitted);
    let mut rig = Rig::new(
        firmware,
        Setup {
            scenario: parked,
            ..setup
        },
    )?;
    rig.run_s(BOOT_S)?;
    let mut master = Master { rig, requests: 0 };
    for register in &calibration.registers {
        master
            .write(register)
            .with_context(|| format!("calibration over RS485: {}", register.name))?;
    }
    master.save().context("calibration over RS485: save")?;
    let Master { mut rig, requests } = master;
    let now_s = rig.now_s();
    let flash = rig.machine.board(|board| {
        board.flash.advance(now_s);
        board.flash.power_off(now_s);
        board.flash.content().to_vec()
    });
    let account = Account {
        registers: calibration.len(),
        requests,
        length_s: now_s,
    };
    Ok((flash, account))
}

/// A Modbus master on the board's line.
struct Master<'firmware> {
    rig: Rig<'firmware>,
    requests: u32,
}

impl Master<'_> {
    /// A request, its CRC aside, and what its answer says behind the function code.
    fn ask(&mut self, function: u8, data: &[u8]) -> Result<Vec<u8>> {
        let request = [&[SERVER, function], data].concat();
        let mut unanswered = 0;
        for _ in 0..LOOKS {
            self.requests += 1;
            let answer = match self.rig.modbus(&request) {
                Ok(answer) => answer,
                Err(error) => {
                    unanswered += 1;
                    if unanswered >= ATTEMPTS {
                        return Err(error);
                    }
                    continue;
                }
            };
            match answer[..] {
                [SERVER, answered, ref data @ ..] if answered == function => {
                    return Ok(data.to_vec());
                }
                [SERVER, answered, BUSY] if answered == function | REFUSED => {
                    self.rig.run_for(PACE)?;
                }
                [SERVER, answered, code] if answered == function | REFUSED => {
                    bail!("the board refuses it with Modbus exception {code:02}")
                }
                _ => {
                    bail!("the answer {answer:02X?} does not belong to the request {request:02X?}")
                }
            }
        }
        bail!("the board was busy all the time")
    }

    fn write(&mut self, register: &Register) -> Result<()> {
        let words = register.words();
        let place = [register.layout.address, words.len() as u16]
            .map(u16::to_be_bytes)
            .concat();
        let content: Vec<u8> = words.iter().flat_map(|word| word.to_be_bytes()).collect();
        let length = [content.len() as u8];
        let taken = self.ask(WRITE_MANY, &[&place, &length[..], &content].concat())?;
        ensure!(taken == place, "the board confirms other registers");
        let back = self.ask(READ_HOLDING, &place)?;
        ensure!(
            back == [&length[..], &content].concat(),
            "reads back as {back:02X?}"
        );
        Ok(())
    }

    /// Until flash holds what is in use.
    fn save(&mut self) -> Result<()> {
        let order = [COMMAND_ADDRESS, Command::Save.register()]
            .map(u16::to_be_bytes)
            .concat();
        self.ask(WRITE_ONE, &order)?;
        for _ in 0..LOOKS {
            if self.input("configuration saved")? == 1 && self.input("flash busy")? == 0 {
                return Ok(());
            }
            self.rig.run_for(PACE)?;
        }
        bail!("the board has not saved")
    }

    /// A quantity of one register.
    fn input(&mut self, name: &str) -> Result<u16> {
        let layout = INPUTS
            .iter()
            .zip(INPUT_TEXTS)
            .find(|(input, text)| text.name == name && input.layout.kind == Kind::U16)
            .map(|(input, _)| input.layout)
            .with_context(|| format!("docs/modbus.md has no {name:?} of one register"))?;
        let answer = self.ask(
            READ_INPUT,
            &[layout.address, 1].map(u16::to_be_bytes).concat(),
        )?;
        match answer[..] {
            [2, high, low] => Ok(u16::from_be_bytes([high, low])),
            _ => bail!("{name}: the answer {answer:02X?} is not one register"),
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    const GAIN: &str = "[[register]]\nname = \"current gain\"\naddress = 0x0216\nunit = \"ppm\"\n";

    #[test]
    fn registers_are_taken_in_their_order() {
        let text = format!(
            "{GAIN}small = 0\nlarge = -19608\n\n[[register]]\nname = \"converter: supply mode\"\nvalue = 1\n"
        );
        let calibration = Calibration::parse(&text).unwrap();
        assert_eq!(calibration.len(), 2);
        let gain = &calibration.registers[0];
        // Most significant word first; −19608 is 0xFFFF_B368.
        assert_eq!(gain.words(), [0, 0, 0xFFFF, 0xB368]);
        assert_eq!(calibration.registers[1].words(), [1]);
    }

    #[test]
    fn what_is_wrong_says_where_and_what_was_expected() {
        let register = |rest: &str| format!("[[register]]\nname = {rest}\n");
        for (text, says) in [
            (String::new(), "expected at least one"),
            ("schema = 1\n".to_owned(), "schema"),
            (format!("{GAIN}small = 0\n"), "`small` and `large`"),
            (format!("{GAIN}small = 0\nlarge = 0.5\n"), "line 6: "),
            (
                format!("{GAIN}small = 0\nlarge = 200000\n"),
                "line 1: current gain: large: found 200000, expected -100000 to 100000 ppm",
            ),
            (
                register("\"current gain\"\naddress = 0x0217\nsmall = 0\nlarge = 0"),
                "address: found 0x0217, expected 0x0216",
            ),
            (
                register("\"current gain\"\nunit = \"%\"\nsmall = 0\nlarge = 0"),
                "unit: found \"%\", expected \"ppm\"",
            ),
            (register("\"gain\"\nvalue = 0"), "name: found \"gain\""),
            (
                register("\"Modbus address\"\nvalue = 2"),
                "\"Modbus address\"",
            ),
            (
                register("\"zero drift\"\nsmall = 6500000\nlarge = 0"),
                "zero drift: the board refuses: contradiction: ZeroDrift",
            ),
            (
                format!("{GAIN}small = 0\nlarge = 0\n{GAIN}small = 0\nlarge = 0\n"),
                "line 7: name: found \"current gain\" a second time",
            ),
        ] {
            let error = format!("{:#}", Calibration::parse(&text).unwrap_err());
            assert!(error.contains(says), "{text}\n{error}");
            assert_eq!(error.lines().count(), 1, "{error}");
        }
    }
}
