//! What somebody on the CAN bus knows of the board: its frames decoded by `core_logic::can::layout`, which a test compares
//! with can/board.dbc.

use std::collections::BTreeMap;

use core_logic::can::layout::{self, MESSAGES, Message};
use core_logic::e2e;

use crate::can_frame::CanFrame;
use crate::time::Ticks;

/// Cause bits of a validity signal.
pub mod validity {
    /// Nothing stands against the value.
    pub const VALID: u8 = 0;
    /// Never measured, or too old.
    pub const STALE: u8 = 1 << 0;
    /// Beyond the sensor's range.
    pub const SATURATED: u8 = 1 << 1;
    /// A calibration runs.
    pub const CALIBRATING: u8 = 1 << 2;
    /// The sensor is open.
    pub const OPEN: u8 = 1 << 3;
    /// The range changed during the measurement.
    pub const RANGE_CHANGE: u8 = 1 << 4;
    /// Not plausible.
    pub const IMPLAUSIBLE: u8 = 1 << 5;
    /// Supply beyond its limits.
    pub const SUPPLY: u8 = 1 << 6;
    /// A chip does not answer as it should.
    pub const CHIP_FAULT: u8 = 1 << 7;
}

/// A value with the causes against it; `None` for "not available".
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Reading {
    /// Physical value in the signal's unit.
    pub value: Option<f64>,
    /// Bits of [`validity`].
    pub validity: u8,
}

impl Reading {
    /// The value if nothing stands against it.
    pub fn valid(self) -> Option<f64> {
        self.value.filter(|_| self.validity == validity::VALID)
    }
}

/// How regularly a message comes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Period {
    /// Frames.
    pub frames: u64,
    /// The shortest time between two, in s.
    pub shortest_s: f64,
    /// The longest, in s.
    pub longest_s: f64,
    last: Option<Ticks>,
}

impl Period {
    fn note(&mut self, at: Ticks) {
        self.frames += 1;
        if let Some(last) = self.last.replace(at) {
            let gap_s = at.since(last).seconds();
            if self.frames == 2 {
                (self.shortest_s, self.longest_s) = (gap_s, gap_s);
            }
            self.shortest_s = self.shortest_s.min(gap_s);
            self.longest_s = self.longest_s.max(gap_s);
        }
    }
}

/// The newest of everything.
#[derive(Clone, Debug, Default)]
pub struct BusView {
    payloads: BTreeMap<u32, (Ticks, [u8; 8])>,
    periods: BTreeMap<u32, Period>,
    /// Frames of the board whose CRC or data ID was wrong.
    pub broken_frames: u64,
    /// Frames that no message of the DBC stands for.
    pub unknown_frames: u64,
    /// The first valid current.
    pub first_valid_current: Option<Ticks>,
    /// Every diagnosis that was ever active, by its name in the DBC.
    pub diagnoses: BTreeMap<&'static str, Ticks>,
}

fn message_of(id: u32) -> Option<&'static Message> {
    MESSAGES
        .iter()
        .find(|message| u32::from(message.header.id) == id)
}

impl BusView {
    /// Takes a frame that the board sent; `at` is the frame's end.
    pub fn take(&mut self, at: Ticks, frame: &CanFrame) {
        let Some(message) = message_of(frame.id).filter(|_| !frame.extended && frame.length == 8)
        else {
            self.unknown_frames += 1;
            return;
        };
        if let Some(data_id) = message.header.data_id
            && e2e::verify(data_id, &frame.data).is_err()
        {
            self.broken_frames += 1;
            return;
        }
        self.payloads.insert(frame.id, (at, frame.data));
        self.periods.entry(frame.id).or_default().note(at);
        if frame.id == u32::from(layout::current::HEADER.id)
            && self.first_valid_current.is_none()
            && self.current_a().valid().is_some()
        {
            self.first_valid_current = Some(at);
        }
        if frame.id == u32::from(layout::diagnosis_active::HEADER.id) {
            for name in self.active_diagnoses() {
                self.diagnoses.entry(name).or_insert(at);
            }
        }
    }

    /// A signal's physical value; `None` if its message never came, or it says "not available".
    pub fn signal(&self, message: &str, signal: &str) -> Option<f64> {
        let message = MESSAGES
            .iter()
            .find(|candidate| candidate.name == message)?;
        let signal = message
            .signals
            .iter()
            .find(|candidate| candidate.name == signal)?;
        let (_, payload) = self.payloads.get(&u32::from(message.header.id))?;
        let raw = signal.field.get(layout::word(*payload));
        if signal.field.not_available() == Some(raw) {
            return None;
        }
        let scale = signal.scale;
        Some(raw as f64 * scale.numerator as f64 / scale.denominator as f64 + scale.offset as f64)
    }

    fn reading(&self, message: &str, value: &str, validity: &str) -> Reading {
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "an eight-bit signal"
        )]
        let causes = self
            .signal(message, validity)
            .map_or(validity::STALE, |bits| bits as u8);
        Reading {
            value: self.signal(message, value),
            validity: causes,
        }
    }

    /// Current of the last conversion, in A.
    pub fn current_a(&self) -> Reading {
        self.reading("Current", "Current", "CurrentValidity")
    }

    /// Sliding average, in A.
    pub fn average_a(&self) -> Reading {
        self.reading("CurrentAverage", "CurrentAverage", "CurrentAverageValidity")
    }

    /// Charge by the meter, in C.
    pub fn charge_c(&self) -> Reading {
        self.reading("Charge", "Charge", "ChargeValidity")
    }

    /// Mean current by the meter, in A.
    pub fn meter_current_a(&self) -> Reading {
        self.reading("MeterCurrent", "MeterCurrent", "MeterCurrentValidity")
    }

    /// State of charge, in %.
    pub fn soc_pct(&self) -> Reading {
        self.reading("StateOfCharge", "StateOfCharge", "StateOfChargeValidity")
    }

    /// Supply of the sensors, in V.
    pub fn supply_v(&self) -> Reading {
        let reading = self.reading("Environment", "SensorSupply", "SensorSupplyValidity");
        Reading {
            value: reading.value.map(|mv| mv / 1e3),
            ..reading
        }
    }

    /// Temperature at the sensors, in °C.
    pub fn sensor_c(&self) -> Reading {
        self.reading(
            "Environment",
            "SensorTemperature",
            "SensorTemperatureValidity",
        )
    }

    /// When the newest frame of a message ended.
    pub fn last_at(&self, message: &str) -> Option<Ticks> {
        let message = MESSAGES
            .iter()
            .find(|candidate| candidate.name == message)?;
        self.payloads
            .get(&u32::from(message.header.id))
            .map(|(at, _)| *at)
    }

    /// How regularly a message came.
    pub fn period(&self, message: &str) -> Period {
        MESSAGES
            .iter()
            .find(|candidate| candidate.name == message)
            .and_then(|message| self.periods.get(&u32::from(message.header.id)))
            .copied()
            .unwrap_or_default()
    }

    /// Begins the account of the periods anew.
    pub fn restart_periods(&mut self) {
        self.periods.clear();
    }

    /// The codes that the newest `DiagnosisActive` has set, by their names in `core_logic::diagnosis`.
    pub fn active_diagnoses(&self) -> Vec<&'static str> {
        self.codes(&layout::diagnosis_active::HEADER)
    }

    /// The same of the newest `DiagnosisLatched`.
    pub fn latched_diagnoses(&self) -> Vec<&'static str> {
        self.codes(&layout::diagnosis_latched::HEADER)
    }

    fn codes(&self, header: &layout::Header) -> Vec<&'static str> {
        let Some((_, payload)) = self.payloads.get(&u32::from(header.id)) else {
            return Vec::new();
        };
        let word = layout::word(*payload);
        core_logic::diagnosis::Code::ALL
            .iter()
            .filter(|code| word >> code.number() & 1 != 0)
            .map(|code| code.description().name)
            .collect()
    }
}
