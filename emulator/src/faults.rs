//! Faults that can be put into the running board, by the numbers of docs/faults.md.
//!
//! A fault is written `F9`, with parameters `F9:10kHz,30%`, with a time `F9@2.5` (s after power-on), or with both. What
//! stands there only in words (a transmission log, a proof over all counter values) is no fault to inject: F4, F23, F27.

use std::fmt;

use plant::ade7753::{Flip, Level};
use plant::comparator::{FlagPattern, GateOverride};
use plant::front_end::SensorFault;
use plant::supply::SupplyProfile;

use core_logic::configuration::Configuration;
use core_logic::converter::{self, ConverterCoefficients, Corrections};
use core_logic::meter;
use core_logic::open_sensor::OpenSensorThresholds;
use core_logic::range::Range;
use core_logic::soc::SocCoefficients;
use core_logic::units::Ppm;

use crate::board::{Board, LineFault};
use crate::can_bus;
use crate::can_frame::CanFrame;
use crate::i2c_bus::I2cFault;
use crate::image::{SRAM_LENGTH, SRAM_START};
use crate::rig::{Rig, with_crc};
use crate::rs485_line::{CharacterFault, Flood, Outgoing};
use crate::time::Ticks;

/// One line of the catalogue.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Entry {
    /// As docs/faults.md numbers it.
    pub id: &'static str,
    /// What goes wrong.
    pub title: &'static str,
    /// Parameters that it takes, the first of each kind being what it does without them.
    pub parameters: &'static str,
}

const fn entry(id: &'static str, title: &'static str, parameters: &'static str) -> Entry {
    Entry {
        id,
        title,
        parameters,
    }
}

/// Every fault that can be injected.
pub const CATALOGUE: [Entry; 24] = [
    entry(
        "F1",
        "bits of the ADE7753's answers flip",
        "probability per bit (0.001), how long (1s)",
    ),
    entry(
        "F2",
        "two bits of an AENERGY reading flip so that its checksum stays right",
        "first bit 0 … 23 (18)",
    ),
    entry(
        "F3",
        "the ADE7753's MISO is stuck",
        "low or high, how long (200ms)",
    ),
    entry("F5", "the ADE7753 is reset by a brown-out", "none"),
    entry(
        "F6",
        "AENERGY is at the end of its range when the board starts",
        "positive or negative",
    ),
    entry(
        "F7",
        "the ADE7753's crystal stops or is off",
        "stopped or a deviation (100ppm), how long (2s)",
    ),
    entry(
        "F8",
        "the ADE7753's IRQ line is stuck or storms",
        "low, high or a frequency (100kHz), how long (1s)",
    ),
    entry(
        "F9",
        "the range comparators chatter",
        "frequency (1kHz), share that is high (50%), how long (1s)",
    ),
    entry(
        "F10",
        "the range flag's line is stuck against the switch",
        "other (than it is now), low or high, how long (1s)",
    ),
    entry(
        "F11",
        "the I²C bus fails",
        "sda (held in the middle of a byte), byte (in the middle of one whose bits alternate), nack, arbitration, glitch, spurious (a bus error that is none) or short, how long the short (100ms)",
    ),
    entry("F12", "the ADS1100 is reset", "none"),
    entry(
        "F13",
        "the ADS1100 repeats its last code",
        "how long (500ms)",
    ),
    entry(
        "F14",
        "a Hall sensor's output is open or forced",
        "open or a voltage (2.5V, from a divider), small or large, how long (1s)",
    ),
    entry(
        "F15",
        "the sensors' 5 V leaves its range",
        "voltage (4.2V), how long (1s); ramp: 4.5 to 5.5 V and back",
    ),
    entry(
        "F16",
        "the CAN bus fails",
        "short (2.5 ms in a frame), dominant or noack, how long (10s)",
    ),
    entry(
        "F17",
        "CAN and RS485 are flooded",
        "both, can or rs485, how long (1s)",
    ),
    entry(
        "F18",
        "RS485 carries damaged, cut-off and foreign requests",
        "how long (1s)",
    ),
    entry(
        "F19",
        "the supply fails while the flash is written and comes back",
        "bytes programmed or erased until then (300)",
    ),
    entry(
        "F20",
        "bits of every flash page of the state are worn out",
        "none",
    ),
    entry("F21", "the supply fails and comes back", "none"),
    entry(
        "F22",
        "a bit of the configuration flips in RAM, or of what is worked out from it",
        "number of its copy in RAM, all without it; or converter, meter, soc or sensor",
    ),
    entry(
        "F24",
        "the program hangs or faults",
        "hang (its lowest priority), deadlock (in an interrupt), fault or stack",
    ),
    entry(
        "F25",
        "the zero drift is commanded while current may flow",
        "none",
    ),
    entry(
        "F26",
        "chatter, a save, a zero command and I²C errors at once",
        "how long (2s)",
    ),
];

/// Why the text names no fault.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FaultError(String);

impl fmt::Display for FaultError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for FaultError {}

/// How the program is stopped (F24).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CoreFault {
    /// An endless loop at the lowest priority: the interrupts go on.
    Hang,
    /// An endless loop in the next interrupt handler.
    Deadlock,
    /// A jump to where nothing is.
    Fault,
    /// The stack pointer at the end of its memory.
    Stack,
}

/// A fault with its parameters. Where a length is `None` it lasts for ever.
#[derive(Clone, Debug, PartialEq)]
pub enum Fault {
    /// F1.
    MeterBitFlips {
        /// Probability of each bit.
        per_bit: f64,
        /// How long.
        length: Option<Ticks>,
    },
    /// F2.
    MeterCompensatedFlip {
        /// The first of the two bits, 0 … 23.
        bit: u32,
    },
    /// F3.
    MeterMisoStuck {
        /// Where.
        level: Level,
        /// How long.
        length: Option<Ticks>,
    },
    /// F5.
    MeterReset,
    /// F6; from power-on whatever the time.
    MeterWrap {
        /// At the positive end.
        positive: bool,
    },
    /// F7.
    MeterClock {
        /// Deviation; `None`: it stops.
        ppm: Option<f64>,
        /// How long.
        length: Option<Ticks>,
    },
    /// F8.
    MeterIrq {
        /// What the line does.
        line: LineFault,
        /// How long.
        length: Option<Ticks>,
    },
    /// F9.
    Chatter {
        /// Periods per second.
        frequency_hz: f64,
        /// Share of the period that is high.
        duty: f64,
        /// How long.
        length: Option<Ticks>,
    },
    /// F10.
    FlagStuck {
        /// Where; `None`: against what it is when the fault begins.
        high: Option<bool>,
        /// How long.
        length: Option<Ticks>,
    },
    /// F11.
    I2c(I2cFault),
    /// F12.
    ConverterReset,
    /// F13.
    ConverterStuck {
        /// How long.
        length: Option<Ticks>,
    },
    /// F14.
    Sensor {
        /// The large one.
        large: bool,
        /// What is wrong with it.
        fault: SensorFault,
        /// How long.
        length: Option<Ticks>,
    },
    /// F15.
    Supply {
        /// Voltage; `None`: a ramp from 4.5 to 5.5 V and back.
        volts: Option<f64>,
        /// How long.
        length: Ticks,
    },
    /// F16: a dominant short of 2.5 ms in the next frame of the board.
    CanShort,
    /// F16: the bus is dominant from within the next frame of the board on: only a sender is driven to bus-off.
    CanDominant {
        /// How long.
        length: Ticks,
    },
    /// F16: nobody acknowledges.
    CanAlone {
        /// How long.
        length: Ticks,
    },
    /// F17.
    Flood {
        /// CAN.
        can: bool,
        /// RS485.
        rs485: bool,
        /// How long.
        length: Ticks,
    },
    /// F18.
    Rs485Garbage {
        /// How long.
        length: Ticks,
    },
    /// F19.
    FlashPowerLoss {
        /// Bytes programmed or erased until then.
        bytes: u64,
    },
    /// F20.
    FlashWear,
    /// F21.
    PowerLoss,
    /// F22.
    ConfigurationBitFlip {
        /// Which of the copies in RAM, by address; `None`: all.
        copy: Option<usize>,
    },
    /// F22.
    FactorBitFlip(Factor),
    /// F24.
    Core(CoreFault),
    /// F25.
    ZeroWhileDriving,
    /// F26.
    Together {
        /// How long.
        length: Ticks,
    },
}

/// A fault with the time at which it strikes.
#[derive(Clone, Debug, PartialEq)]
pub struct Injection {
    /// What.
    pub fault: Fault,
    /// When.
    pub at: Ticks,
}

impl Injection {
    /// Whether a drive that ends at `end` never sees it.
    pub fn strikes_after(&self, end: Ticks) -> bool {
        // That one is done before power comes on.
        self.at >= end && !matches!(self.fault, Fault::MeterWrap { .. })
    }
}

/// When a fault strikes that was given without a time: the board has started and settled.
pub const DEFAULT_TIME: Ticks = Ticks::from_millis(2_000);

/// Reads a fault with or without its time.
///
/// # Errors
/// One sentence: which part was not understood and what was expected.
pub fn parse(text: &str) -> Result<Injection, FaultError> {
    let (fault, at) = match text.split_once('@') {
        Some((fault, at)) => {
            let seconds = at.strip_suffix('s').unwrap_or(at);
            let at_s = number(seconds).filter(|at_s| *at_s >= 0.0).ok_or_else(|| {
                FaultError(format!(
                    "the time '{at}' of fault '{text}' is no number of seconds from 0 on"
                ))
            })?;
            (fault, Ticks::from_seconds(at_s))
        }
        None => (text, DEFAULT_TIME),
    };
    Ok(Injection {
        fault: Fault::parse(fault)?,
        at,
    })
}

/// Puts a fault into a board, usually before its power comes on.
pub fn apply(injection: &Injection, rig: &mut Rig<'_>) {
    injection.fault.apply(rig, injection.at);
}

/// A number without an end that a float would take: no "inf", no "nan".
fn number(text: &str) -> Option<f64> {
    text.parse().ok().filter(|number: &f64| number.is_finite())
}

/// The parameters of a fault: each is taken once.
struct Parameters<'text> {
    text: &'text str,
    entry: &'static Entry,
    left: Vec<&'text str>,
}

impl<'text> Parameters<'text> {
    fn new(text: &'text str, entry: &'static Entry, parameters: Option<&'text str>) -> Self {
        Self {
            text,
            entry,
            left: parameters.map_or_else(Vec::new, |all| all.split(',').map(str::trim).collect()),
        }
    }

    /// Takes one of some words.
    fn word<T: Copy>(&mut self, words: &[(&str, T)]) -> Option<T> {
        let (place, value) = self.left.iter().enumerate().find_map(|(place, text)| {
            words
                .iter()
                .find(|(word, _)| word == text)
                .map(|(_, value)| (place, *value))
        })?;
        self.left.remove(place);
        Some(value)
    }

    /// Takes a number with one of some units.
    fn quantity(&mut self, units: &[(&str, f64)]) -> Option<f64> {
        let (place, value) = self.left.iter().enumerate().find_map(|(place, text)| {
            units.iter().find_map(|(unit, factor)| {
                let value = number(text.strip_suffix(unit)?)?;
                Some((place, value * factor))
            })
        })?;
        self.left.remove(place);
        Some(value)
    }

    fn length(&mut self, without: f64) -> Ticks {
        // What is negative is left over, and so not understood.
        let place = self
            .left
            .iter()
            .position(|text| text.starts_with('-') && text.ends_with('s'));
        if place.is_some() {
            return Ticks(0);
        }
        let length_s = self.quantity(&[("ms", 1e-3), ("s", 1.0)]);
        Ticks::from_seconds(length_s.unwrap_or(without))
    }

    /// Where every parameter has been taken, `fault`.
    fn end(self, fault: Fault) -> Result<Fault, FaultError> {
        match self.left.first() {
            None => Ok(fault),
            Some(left) => Err(self.not_understood(left)),
        }
    }

    fn not_understood(&self, part: &str) -> FaultError {
        FaultError(format!(
            "'{part}' of fault '{}' is not understood; {} ({}) takes: {}",
            self.text, self.entry.id, self.entry.title, self.entry.parameters
        ))
    }

    fn checked(&self, value: f64, from: f64, to: f64) -> Result<f64, FaultError> {
        if (from..=to).contains(&value) {
            Ok(value)
        } else {
            Err(FaultError(format!(
                "{value} in fault '{}' is beyond {from} … {to}",
                self.text
            )))
        }
    }
}

const FREQUENCY: [(&str, f64); 2] = [("kHz", 1e3), ("Hz", 1.0)];
const PLAIN: [(&str, f64); 1] = [("", 1.0)];

impl Fault {
    /// Reads a fault: its number, and after a colon its parameters.
    ///
    /// # Errors
    /// One sentence: which part was not understood and what was expected.
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "of numbers that were checked"
    )]
    pub fn parse(text: &str) -> Result<Self, FaultError> {
        let (id, parameters) = match text.split_once(':') {
            Some((id, parameters)) => (id, Some(parameters)),
            None => (text, None),
        };
        let Some(entry) = CATALOGUE
            .iter()
            .find(|entry| entry.id.eq_ignore_ascii_case(id.trim()))
        else {
            let known: Vec<&str> = CATALOGUE.iter().map(|entry| entry.id).collect();
            return Err(FaultError(format!(
                "there is no fault '{id}' to inject; known are {}",
                known.join(", ")
            )));
        };
        let mut given = Parameters::new(text, entry, parameters);
        let levels = [("low", false), ("high", true)];
        let fault = match entry.id {
            "F1" => {
                let length = Some(given.length(1.0));
                let per_bit = given.quantity(&PLAIN).unwrap_or(1e-3);
                Self::MeterBitFlips {
                    per_bit: given.checked(per_bit, 0.0, 1.0)?,
                    length,
                }
            }
            "F2" => {
                let bit = given.quantity(&PLAIN).unwrap_or(18.0);
                Self::MeterCompensatedFlip {
                    bit: given.checked(bit, 0.0, 23.0)? as u32,
                }
            }
            "F3" => Self::MeterMisoStuck {
                level: if given.word(&levels).unwrap_or(false) {
                    Level::High
                } else {
                    Level::Low
                },
                length: Some(given.length(0.2)),
            },
            "F5" => Self::MeterReset,
            "F6" => Self::MeterWrap {
                positive: given
                    .word(&[("positive", true), ("negative", false)])
                    .unwrap_or(true),
            },
            "F7" => {
                let ppm = given.quantity(&[("ppm", 1.0)]);
                let _ = given.word(&[("stopped", ())]);
                Self::MeterClock {
                    ppm: ppm
                        .map(|ppm| given.checked(ppm, -100_000.0, 100_000.0))
                        .transpose()?,
                    length: Some(given.length(2.0)),
                }
            }
            "F8" => {
                let frequency = given.quantity(&FREQUENCY);
                let level = given.word(&levels);
                let line = match (frequency, level) {
                    (Some(frequency_hz), _) => LineFault::Toggling {
                        every: Ticks::from_seconds(0.5 / given.checked(frequency_hz, 0.01, 1e6)?),
                    },
                    (None, Some(true)) => LineFault::StuckHigh,
                    (None, _) => LineFault::StuckLow,
                };
                Self::MeterIrq {
                    line,
                    length: Some(given.length(1.0)),
                }
            }
            "F9" => {
                let frequency_hz = given.quantity(&FREQUENCY).unwrap_or(1e3);
                let duty = given.quantity(&[("%", 0.01)]).unwrap_or(0.5);
                Self::Chatter {
                    frequency_hz: given.checked(frequency_hz, 0.01, 1e6)?,
                    duty: given.checked(duty, 0.0, 1.0)?,
                    length: Some(given.length(1.0)),
                }
            }
            "F10" => {
                let words = [("other", None), ("low", Some(false)), ("high", Some(true))];
                Self::FlagStuck {
                    high: given.word(&words).flatten(),
                    length: Some(given.length(1.0)),
                }
            }
            "F11" => {
                let short = I2cFault::SdaLow(Some(given.length(0.1)));
                let words = [
                    ("sda", I2cFault::HoldSda { clocks: 9 }),
                    // Zeros and ones by turns: a stop that takes a clock of its own after a one has been seen finds a zero.
                    (
                        "byte",
                        I2cFault::MidByte {
                            byte: 0x55,
                            shown: 0,
                        },
                    ),
                    ("nack", I2cFault::NackAddresses(3)),
                    ("arbitration", I2cFault::LoseArbitration(1)),
                    ("glitch", I2cFault::Glitch),
                    ("spurious", I2cFault::SpuriousBusErrors(1)),
                    ("short", short),
                ];
                Self::I2c(
                    given
                        .word(&words)
                        .unwrap_or(I2cFault::HoldSda { clocks: 9 }),
                )
            }
            "F12" => Self::ConverterReset,
            "F13" => Self::ConverterStuck {
                length: Some(given.length(0.5)),
            },
            "F14" => {
                let large = given.word(&[("small", false), ("large", true)]);
                let volts = given.quantity(&[("V", 1.0)]);
                let _ = given.word(&[("open", ())]);
                let fault = match volts {
                    Some(volts) => SensorFault::Divider {
                        volts: given.checked(volts, 0.0, 5.5)?,
                        // Of two equal resistors from the supply of the sensors.
                        ohms: 1_000.0,
                    },
                    None => SensorFault::Open,
                };
                Self::Sensor {
                    large: large.unwrap_or(false),
                    fault,
                    length: Some(given.length(1.0)),
                }
            }
            "F15" => {
                let ramp = given.word(&[("ramp", ())]).is_some();
                let volts = given.quantity(&[("V", 1.0)]).unwrap_or(4.2);
                let volts = given.checked(volts, 0.0, 6.0)?;
                Self::Supply {
                    volts: (!ramp).then_some(volts),
                    length: given.length(1.0),
                }
            }
            "F16" => {
                let length = given.length(10.0);
                match given.word(&[("short", 0), ("dominant", 1), ("noack", 2)]) {
                    Some(1) => Self::CanDominant { length },
                    Some(2) => Self::CanAlone { length },
                    _ => Self::CanShort,
                }
            }
            "F17" => {
                let words = [
                    ("both", (true, true)),
                    ("can", (true, false)),
                    ("rs485", (false, true)),
                ];
                let (can, rs485) = given.word(&words).unwrap_or((true, true));
                Self::Flood {
                    can,
                    rs485,
                    length: given.length(1.0),
                }
            }
            "F18" => Self::Rs485Garbage {
                length: given.length(1.0),
            },
            "F19" => {
                let bytes = given.quantity(&PLAIN).unwrap_or(300.0);
                Self::FlashPowerLoss {
                    bytes: given.checked(bytes, 0.0, 1e9)? as u64,
                }
            }
            "F20" => Self::FlashWear,
            "F21" => Self::PowerLoss,
            "F22" => {
                let words = [
                    ("converter", Factor::Converter),
                    ("meter", Factor::Meter),
                    ("soc", Factor::StateOfCharge),
                    ("sensor", Factor::OpenSensor),
                ];
                if let Some(factor) = given.word(&words) {
                    Self::FactorBitFlip(factor)
                } else {
                    let copy = given.quantity(&PLAIN);
                    Self::ConfigurationBitFlip {
                        copy: copy
                            .map(|copy| given.checked(copy, 0.0, 99.0))
                            .transpose()?
                            .map(|copy| copy as usize),
                    }
                }
            }
            "F24" => Self::Core(
                given
                    .word(&[
                        ("hang", CoreFault::Hang),
                        ("deadlock", CoreFault::Deadlock),
                        ("fault", CoreFault::Fault),
                        ("stack", CoreFault::Stack),
                    ])
                    .unwrap_or(CoreFault::Hang),
            ),
            "F25" => Self::ZeroWhileDriving,
            _ => Self::Together {
                length: given.length(2.0),
            },
        };
        given.end(fault)
    }

    /// Puts it into the board at `at`.
    pub fn apply(&self, rig: &mut Rig<'_>, at: Ticks) {
        let fault = self.clone();
        if let Self::MeterWrap { positive } = fault {
            // 100 counts before the end, some seconds at most; later it would be a jump that no counter makes.
            let counts = if positive {
                0x7F_FFFF - 100
            } else {
                -0x80_0000 + 100
            };
            rig.machine.board(|board| board.meter.preset_energy(counts));
            return;
        }
        rig.at(at, move |rig| fault.strike(rig));
    }

    /// Now.
    fn strike(self, rig: &mut Rig<'_>) {
        let now = rig.machine.now();
        let now_s = now.seconds();
        match self {
            Self::MeterBitFlips { per_bit, length } => {
                on_board(rig, move |board| board.meter.flip_bits_at_rate(per_bit, 1));
                end_after(rig, length, |board| board.meter.flip_bits_at_rate(0.0, 1));
            }
            Self::MeterCompensatedFlip { bit } => on_board(rig, |board| {
                board
                    .meter
                    .flip_bits(now_s, AENERGY, Flip::Compensated(bit));
            }),
            Self::MeterMisoStuck { level, length } => {
                on_board(rig, |board| board.meter.set_miso_stuck(Some(level)));
                end_after(rig, length, |board| board.meter.set_miso_stuck(None));
            }
            Self::MeterReset => on_board(rig, |board| board.meter.brown_out(now_s)),
            // Done before power came on.
            Self::MeterWrap { .. } => {}
            Self::MeterClock { ppm, length } => {
                on_board(rig, |board| match ppm {
                    Some(ppm) => board.meter.set_clkin_ppm(ppm),
                    None => board.meter.set_clkin_stopped(true),
                });
                end_after(rig, length, move |board| match ppm {
                    Some(_) => board.meter.set_clkin_ppm(0.0),
                    None => board.meter.set_clkin_stopped(false),
                });
            }
            Self::MeterIrq { line, length } => {
                on_board(rig, |board| board.irq_fault = line);
                end_after(rig, length, |board| board.irq_fault = LineFault::None);
            }
            Self::Chatter {
                frequency_hz,
                duty,
                length,
            } => {
                let pattern = FlagPattern {
                    start_s: now_s,
                    frequency_hz,
                    duty,
                };
                on_board(rig, |board| {
                    set_gate(board, GateOverride::Pattern(pattern));
                });
                end_after(rig, length, |board| set_gate(board, GateOverride::None));
            }
            Self::FlagStuck { high, length } => {
                on_board(rig, |board| {
                    let high = high.unwrap_or_else(|| !board.front_end.range_high());
                    board.flag_fault = if high {
                        LineFault::StuckHigh
                    } else {
                        LineFault::StuckLow
                    };
                });
                end_after(rig, length, |board| board.flag_fault = LineFault::None);
            }
            Self::I2c(fault) => on_board(rig, |board| board.i2c_bus.schedule(now, fault)),
            Self::ConverterReset => on_board(rig, |board| board.converter.reset(now_s)),
            Self::ConverterStuck { length } => {
                on_board(rig, |board| {
                    let code = board.converter.output();
                    board.converter.set_stuck_code(Some(code));
                });
                end_after(rig, length, |board| board.converter.set_stuck_code(None));
            }
            Self::Sensor {
                large,
                fault,
                length,
            } => {
                on_board(rig, |board| set_sensor(board, large, fault));
                end_after(rig, length, move |board| {
                    set_sensor(board, large, SensorFault::None);
                });
            }
            Self::Supply { volts, length } => {
                let end_s = now_s + length.seconds();
                let points = match volts {
                    Some(volts) => {
                        let edge_s = SUPPLY_EDGE_S.min(length.seconds() / 2.0);
                        vec![
                            (now_s, 5.0),
                            (now_s + edge_s, volts),
                            (end_s - edge_s, volts),
                            (end_s, 5.0),
                        ]
                    }
                    None => vec![
                        (now_s, 5.0),
                        (now_s + 0.25 * length.seconds(), 4.5),
                        (now_s + 0.75 * length.seconds(), 5.5),
                        (end_s, 5.0),
                    ],
                };
                on_board(rig, |board| {
                    board.supply = SupplyProfile::from_points(points);
                });
                end_after(rig, Some(length), |board| board.supply = None);
            }
            Self::CanShort => rig
                .machine
                .can(|can| can.short_in_next_frame(now, Ticks::from_micros(2_500))),
            Self::CanDominant { length } => {
                rig.machine.can(|can| can.short_in_next_frame(now, length));
            }
            Self::CanAlone { length } => rig.machine.can(|can| {
                can.set_fault(can_bus::Fault::NoOtherNode, true, now);
                can.set_fault(can_bus::Fault::NoOtherNode, false, now + length);
            }),
            Self::Flood { can, rs485, length } => flood(rig, can, rs485, length),
            Self::Rs485Garbage { length } => garbage(rig, length),
            Self::FlashPowerLoss { bytes } => {
                on_board(rig, |board| board.flash.shut_off_after(bytes));
                cycle_when_flash_is_off(rig);
            }
            Self::FlashWear => on_board(rig, |board| {
                for page in STATE_PAGES {
                    // In each record, wherever it begins: at one place alone what is written may have ones there anyway.
                    for at in (9..256).step_by(64) {
                        board.flash.wear_out(page * 256 + at, 0x55);
                    }
                }
            }),
            Self::PowerLoss => rig.power_cycle(),
            Self::ConfigurationBitFlip { copy } => {
                let copies = configurations_in_ram(rig);
                for (number, address) in copies.into_iter().enumerate() {
                    if copy.is_none_or(|copy| copy == number)
                        && let Some(word) = rig.machine.ram_word(address)
                    {
                        rig.machine.set_ram_word(address, word ^ 1 << 4);
                    }
                }
            }
            Self::FactorBitFlip(factor) => {
                for (address, bit) in factors_in_ram(rig, factor) {
                    if let Some(word) = rig.machine.ram_word(address) {
                        rig.machine.set_ram_word(address, word ^ bit);
                    }
                }
            }
            Self::Core(fault) => stop_core(rig, fault),
            Self::ZeroWhileDriving => rig.send_rs485(&with_crc(&ZERO_NOW)),
            Self::Together { length } => {
                Self::Chatter {
                    frequency_hz: 200.0,
                    duty: 0.3,
                    length: Some(length),
                }
                .strike(rig);
                Self::I2c(I2cFault::NackAddresses(3)).strike(rig);
                rig.send_rs485(&with_crc(&SAVE));
                for (part, fault) in [
                    Self::ZeroWhileDriving,
                    Self::I2c(I2cFault::HoldSda { clocks: 9 }),
                    Self::MeterBitFlips {
                        per_bit: 1e-3,
                        length: Some(Ticks(length.0 / 4)),
                    },
                ]
                .into_iter()
                .enumerate()
                {
                    let later = Ticks(length.0 / 4 * (part as u64 + 1));
                    rig.at(now + later, move |rig| fault.strike(rig));
                }
            }
        }
    }
}

/// Register of the ADE7753 with the energy.
const AENERGY: u8 = 0x02;
/// Rise and fall time of a supply with its capacitors (*assumed*).
const SUPPLY_EDGE_S: f64 = 5e-3;
/// Pages of 256 bytes of the flash in which charge and state of charge are kept.
const STATE_PAGES: std::ops::Range<usize> = 0x100..0x200;
/// Modbus: zero now, at server 1.
const ZERO_NOW: [u8; 6] = [1, 6, 0, 0, 0x5A, 0x01];
/// Modbus: save, at server 1.
const SAVE: [u8; 6] = [1, 6, 0, 0, 0x5A, 0x07];

fn on_board(rig: &mut Rig<'_>, change: impl FnOnce(&mut Board)) {
    rig.machine.board(change);
}

fn end_after(rig: &mut Rig<'_>, length: Option<Ticks>, end: impl FnOnce(&mut Board) + 'static) {
    if let Some(length) = length {
        let at = rig.machine.now() + length;
        rig.at(at, move |rig| rig.machine.board(end));
    }
}

fn set_gate(board: &mut Board, gate: GateOverride) {
    let mut faults = board.front_end.faults();
    faults.gate = gate;
    board.front_end.set_faults(faults);
}

fn set_sensor(board: &mut Board, large: bool, fault: SensorFault) {
    let mut faults = board.front_end.faults();
    if large {
        faults.large = fault;
    } else {
        faults.small = fault;
    }
    board.front_end.set_faults(faults);
}

/// Frames that pass the board's filter but not its end-to-end check, and frames to other Modbus servers.
fn flood(rig: &mut Rig<'_>, can: bool, rs485: bool, length: Ticks) {
    let now = rig.machine.now();
    let until = now + length;
    if can {
        let frames = (0..4_u8)
            .map(|content| CanFrame::standard(0x201 + u16::from(content % 2), &[content; 8]))
            .collect();
        rig.machine.can(|bus| bus.flood(frames, now, until));
    }
    if rs485 {
        on_board(rig, |board| {
            board.line.flood(Flood {
                from: now,
                until,
                gap: Ticks::from_micros(1_800),
                spare_address: 1,
                seed: 1,
            });
        });
    }
}

/// A request for the current, in every way in which it can be spoiled, again and again.
fn garbage(rig: &mut Rig<'_>, length: Ticks) {
    let request = with_crc(&[1, 4, 0, 0x40, 0, 2]);
    let spoiled = |fault: CharacterFault| {
        let mut characters: Vec<Outgoing> = request.iter().copied().map(Outgoing::plain).collect();
        characters[3].fault = Some(fault);
        characters
    };
    let plain = |bytes: &[u8]| bytes.iter().copied().map(Outgoing::plain).collect();
    let mut wrong_crc = request.clone();
    wrong_crc[7] ^= 1;
    let frames: [Vec<Outgoing>; 8] = [
        plain(&wrong_crc),
        plain(&request[..5]),
        plain(&with_crc(&[2, 4, 0, 0x40, 0, 2])),
        plain(&[0x55]),
        spoiled(CharacterFault::Parity),
        spoiled(CharacterFault::Framing),
        spoiled(CharacterFault::Noise),
        spoiled(CharacterFault::Truncated(3)),
    ];
    let now = rig.machine.now();
    on_board(rig, |board| {
        let mut at = now;
        for characters in frames.iter().cycle() {
            if at >= now + length {
                break;
            }
            // 3.5 characters and some more.
            at = board.line.send(characters, at) + Ticks::from_millis(5);
        }
    });
}

/// Looks every 100 µs whether the flash's power has failed; the whole board's has then failed, and comes back.
fn cycle_when_flash_is_off(rig: &mut Rig<'_>) {
    let now_s = rig.now_s();
    let lost = rig.machine.board(|board| {
        board.flash.advance(now_s);
        board.flash.lost_power().is_some()
    });
    if lost {
        rig.power_cycle();
        return;
    }
    let again = rig.machine.now() + Ticks::from_micros(100);
    rig.at(again, cycle_when_flash_is_off);
}

/// The words of the open-circuit table's second point wherever the MCU's RAM holds a configuration from the factory, by
/// their addresses. The table is looked for because nothing else in RAM looks like it.
pub fn configurations_in_ram(rig: &Rig<'_>) -> Vec<u32> {
    let configuration = Configuration::default();
    let wanted: Vec<u32> = configuration
        .ocv
        .points()
        .iter()
        .flat_map(|point| [point.soc.get(), point.voltage.get()])
        .map(i32::cast_unsigned)
        .collect();
    find_in_ram(rig, wanted.len(), |window| *window == wanted)
        .map(|address| address + 12)
        .collect()
}

/// Where as many words of the MCU's RAM are what is looked for.
fn find_in_ram(
    rig: &Rig<'_>,
    length: usize,
    fits: impl Fn(&[u32]) -> bool,
) -> impl Iterator<Item = u32> {
    let words: Vec<u32> = (SRAM_START..SRAM_START + SRAM_LENGTH)
        .step_by(4)
        .map(|address| rig.machine.ram_word(address).unwrap_or(0))
        .collect();
    let fitting: Vec<bool> = words.windows(length).map(fits).collect();
    (SRAM_START..)
        .step_by(4)
        .zip(fitting)
        .filter_map(|(address, fits)| fits.then_some(address))
}

/// What is worked out from the configuration.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Factor {
    /// Amperes per code of the ADS1100 in the small range.
    Converter,
    /// Charge of a count of the ADE7753 in the small range.
    Meter,
    /// The capacity that the state of charge is a share of.
    StateOfCharge,
    /// The level below which the small sensor is open.
    OpenSensor,
}

/// Wherever the MCU's RAM holds this factor of the factory's configuration: the address of a word, and the bit in it that
/// changes the factor by an eighth to a quarter. Looked for with a neighbour of the same kind, and to a per cent where the
/// supply goes into it.
pub fn factors_in_ram(rig: &Rig<'_>, factor: Factor) -> Vec<(u32, u32)> {
    /// Places below the largest bit: an eighth to a quarter of the value.
    const DOWN: u32 = 2;
    let configuration = Configuration::default();
    if factor == Factor::OpenSensor {
        let levels = OpenSensorThresholds::prepare(
            &configuration.open_sensor,
            &configuration.front_end,
            None,
        );
        let wanted = [
            levels.open_below,
            levels.low_rail_below,
            levels.high_rail_above,
        ]
        .map(|level| i64::from(level.get()));
        let bit = 1 << (wanted[0].ilog2() - DOWN);
        return find_in_ram(rig, wanted.len(), |window| {
            let values = window.iter().map(|word| i64::from(word.cast_signed()));
            values
                .zip(wanted)
                .all(|(value, wanted)| is_near(value, wanted))
        })
        .map(|address| (address, bit))
        .collect();
    }
    // The factor and its neighbour.
    let (wanted, is_neighbour): (i64, Box<dyn Fn(i64) -> bool>) = match factor {
        Factor::Meter => {
            let [small, large] = [Range::Small, Range::Large].map(|range| {
                configuration.meter.charge_per_count(range).get() * meter::NANOCOULOMB
            });
            (small, Box::new(move |value| is_near(value, large)))
        }
        Factor::StateOfCharge => {
            let capacity = SocCoefficients::new(&configuration.soc).capacity().get();
            // The reciprocal that makes a charge a share: whatever its binary places, exact to 31 of them.
            let is_reciprocal = move |value: i64| {
                let places = (value as f64 * capacity as f64 / f64::from(Ppm::ONE.get())).log2();
                (places - places.round()).abs() < 1e-6
            };
            (capacity, Box::new(is_reciprocal))
        }
        Factor::Converter | Factor::OpenSensor => {
            let coefficients = ConverterCoefficients::prepare(
                &configuration.converter,
                &configuration.front_end,
                &Corrections::default(),
                None,
            );
            // The neighbour is the current at code 0.
            let [slope, offset] = [
                coefficients.step(Range::Small),
                coefficients.current(0, Range::Small),
            ]
            .map(|current| i64::from(current.get()) << converter::FRACTION_BITS);
            (slope, Box::new(move |value| is_near(value, offset)))
        }
    };
    let place = wanted.ilog2() - DOWN;
    find_in_ram(rig, 4, |window| {
        let [a, b, c, d] = *window else {
            return false;
        };
        let value = |low, high| (u64::from(high) << 32 | u64::from(low)).cast_signed();
        is_near(value(a, b), wanted) && is_neighbour(value(c, d))
    })
    .map(|address| (address + place / 32 * 4, 1 << (place % 32)))
    .collect()
}

fn is_near(value: i64, wanted: i64) -> bool {
    value.abs_diff(wanted) <= wanted.unsigned_abs() / 100
}

/// Where nothing is on the chip's buses: the external memory's range, which this board has none in.
const NOWHERE: u32 = 0x6000_0000;
/// `b .`, twice.
const ENDLESS_LOOP: u32 = 0xE7FE_E7FE;
/// RAM that no image of this size uses, for the endless loop: 2 KiB before the end.
const UNUSED_RAM: u32 = SRAM_START + SRAM_LENGTH - 2_048;
/// Less room than an exception frame takes (0x68 bytes with floating-point registers), above the end of the stack.
const STACK_LEFT: u32 = 0x1000_0010;

fn stop_core(rig: &mut Rig<'_>, fault: CoreFault) {
    let in_handler = rig.machine.cpu().current_exception() != 0;
    let wanted = match fault {
        CoreFault::Deadlock => in_handler,
        CoreFault::Hang => !in_handler,
        CoreFault::Fault | CoreFault::Stack => true,
    };
    if !wanted {
        let again = rig.machine.now() + Ticks(200);
        rig.at(again, move |rig| stop_core(rig, fault));
        return;
    }
    let mut registers = rig.machine.cpu().registers();
    match fault {
        CoreFault::Hang | CoreFault::Deadlock => {
            rig.machine.set_ram_word(UNUSED_RAM, ENDLESS_LOOP);
            registers.r[15] = UNUSED_RAM;
        }
        CoreFault::Fault => registers.r[15] = NOWHERE,
        CoreFault::Stack => {
            registers.msp = STACK_LEFT;
            registers.r[13] = STACK_LEFT;
        }
    }
    rig.machine.cpu_mut().set_registers(registers);
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

    use super::*;

    #[test]
    fn every_fault_of_the_catalogue_is_read_by_its_number() {
        for entry in CATALOGUE {
            Fault::parse(entry.id).unwrap();
            Fault::parse(&entry.id.to_lowercase()).unwrap();
        }
    }

    #[test]
    fn parameters_and_time_are_read() {
        let injection = parse("F9:10kHz,30%,500ms@2.5").unwrap();
        assert_eq!(injection.at, Ticks::from_millis(2_500));
        let Fault::Chatter {
            frequency_hz,
            duty,
            length,
        } = injection.fault
        else {
            panic!("{injection:?}");
        };
        assert!((frequency_hz - 1e4).abs() < 1e-6 && (duty - 0.3).abs() < 1e-9);
        assert_eq!(length, Some(Ticks::from_millis(500)));
        assert_eq!(parse("F21").unwrap().at, DEFAULT_TIME);
        assert_eq!(
            Fault::parse("F3:high,1s"),
            Ok(Fault::MeterMisoStuck {
                level: Level::High,
                length: Some(Ticks::from_millis(1_000))
            })
        );
        assert_eq!(
            Fault::parse("F16:dominant,2s"),
            Ok(Fault::CanDominant {
                length: Ticks::from_millis(2_000)
            })
        );
        assert_eq!(
            Fault::parse("F7:-100ppm,1s"),
            Ok(Fault::MeterClock {
                ppm: Some(-100.0),
                length: Some(Ticks::from_millis(1_000))
            })
        );
    }

    #[test]
    fn what_is_not_understood_is_said_in_one_sentence() {
        for (text, says) in [
            ("F4", "known are F1, F2"),
            ("", "known are F1, F2"),
            ("F9:loud", "'loud'"),
            ("F9:10kHz,20kHz", "'20kHz'"),
            ("F9:", "''"),
            ("F9:2MHz", "'2MHz'"),
            ("F9:5000kHz", "beyond"),
            ("F9:150%", "beyond"),
            ("F5:1s", "F5"),
            ("F9@soon", "'soon'"),
            ("F9@-1", "'-1'"),
            ("F9:-1s", "'-1s'"),
            ("F1:nan", "'nan'"),
            ("F1:inf", "'inf'"),
            ("F9:1s@", "''"),
            ("F22:battery", "'battery'"),
            ("F22:meter,1", "'1'"),
        ] {
            let error = parse(text).unwrap_err().to_string();
            assert!(error.contains(says), "{text}: {error}");
            assert!(!error.contains('\n'), "{text}: {error}");
        }
    }
}
