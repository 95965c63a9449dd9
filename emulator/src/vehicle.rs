//! The other nodes on the vehicle's bus: battery management and vehicle control, as can/board.dbc has their messages.

use core_logic::e2e::{self, DataId, Sequence};

use crate::can_frame::CanFrame;
use crate::scenario::{Key, Row};
use crate::time::Ticks;

const BATTERY_VOLTAGE: u16 = 0x201;
const VEHICLE_STATE: u16 = 0x202;
const PERIOD: Ticks = Ticks::from_millis(100);

/// What the vehicle sends.
#[derive(Debug, Default)]
pub struct Vehicle {
    battery: Sequence,
    state: Sequence,
    next: Ticks,
    /// Nothing is sent.
    pub silent: bool,
}

impl Vehicle {
    /// When the next frames are due.
    pub const fn next_event(&self) -> Ticks {
        self.next
    }

    /// The frames that are due at `now`.
    pub fn frames(&mut self, row: &Row, high_voltage: bool, now: Ticks) -> Vec<CanFrame> {
        if now < self.next {
            return Vec::new();
        }
        self.next = now + PERIOD;
        if self.silent {
            return Vec::new();
        }
        let mut frames = Vec::new();
        if row.cell_v.is_some() || row.pack_v.is_some() {
            let cell = raw(row.cell_v, 0.0001, 0.0, 65_000.0, 65_535);
            let pack = raw(row.pack_v, 0.02, 0.0, 65_000.0, 65_535);
            let temperature = raw(row.cell_temperature_c, 1.0, -40.0, 250.0, 255);
            let [temperature, _] = temperature.to_le_bytes();
            let ([c0, c1], [p0, p1]) = (cell.to_le_bytes(), pack.to_le_bytes());
            let payload = [0, 0, c0, c1, p0, p1, temperature, 0];
            frames.push(protected(BATTERY_VOLTAGE, payload, self.battery.advance()));
        }
        let key = match row.key {
            Key::Off => 0,
            Key::Accessory => 1,
            Key::On => 2,
        };
        let payload = [0, 0, key | u8::from(high_voltage) << 3, 0, 0, 0, 0, 0];
        frames.push(protected(VEHICLE_STATE, payload, self.state.advance()));
        frames
    }
}

fn protected(id: u16, mut payload: [u8; 8], counter: u8) -> CanFrame {
    e2e::protect(DataId::new(id), counter, &mut payload);
    CanFrame::standard(id, &payload)
}

/// The raw value of a signal; `absent` where nothing is known.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "limited to the signal's range"
)]
fn raw(value: Option<f64>, factor: f64, offset: f64, limit: f64, absent: u16) -> u16 {
    value.map_or(absent, |value| {
        ((value - offset) / factor).round().clamp(0.0, limit) as u16
    })
}
