//! What happens to the vehicle: the recorded drive, the key, the contactors.

use std::fmt;

/// The key's position.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Key {
    /// Everything off.
    Off,
    /// Low-voltage loads on, high voltage off.
    Accessory,
    /// Driving: high voltage is asked for.
    #[default]
    On,
}

/// What a profile says at one moment. Between two rows every quantity is a straight line, the key stays.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Row {
    /// Time, in s.
    pub t_s: f64,
    /// Current that the vehicle wants, in A; positive = discharge. It flows when the contactors are closed.
    pub current_a: f64,
    /// Temperature of the Hall sensors, in °C.
    pub sensor_temperature_c: f64,
    /// Supply of the Hall sensors, in V.
    pub sensor_supply_v: f64,
    /// Supply and reference of the ADS1100, in V.
    pub converter_supply_v: f64,
    /// Current in a neighbouring conductor, in A.
    pub aux_current_a: f64,
    /// Shift of every sensor's output against the board's ground, in V: what low-voltage loads do with the key in ACC (D4),
    /// or a zero error that comes and goes.
    pub output_shift_v: f64,
    /// Voltage of the limiting cell as the battery management sends it, in V; `None` if it sends none.
    pub cell_v: Option<f64>,
    /// Voltage of the pack, in V.
    pub pack_v: Option<f64>,
    /// Temperature of the cells, in °C.
    pub cell_temperature_c: Option<f64>,
    /// Position of the key.
    pub key: Key,
}

impl Row {
    /// At rest: 0 A, 25 °C, 5 V, key on, nothing on CAN about the cells.
    pub const fn at_rest(t_s: f64) -> Self {
        Self {
            t_s,
            current_a: 0.0,
            sensor_temperature_c: 25.0,
            sensor_supply_v: 5.0,
            converter_supply_v: 5.0,
            aux_current_a: 0.0,
            output_shift_v: 0.0,
            cell_v: None,
            pack_v: None,
            cell_temperature_c: None,
            key: Key::On,
        }
    }

    /// The same with another current.
    pub const fn with_current(self, current_a: f64) -> Self {
        Self { current_a, ..self }
    }

    /// The same with another key position.
    pub const fn with_key(self, key: Key) -> Self {
        Self { key, ..self }
    }

    fn between(a: &Self, b: &Self, fraction: f64) -> Self {
        let mix = |a: f64, b: f64| a + (b - a) * fraction;
        let mix_known = |a: Option<f64>, b: Option<f64>| match (a, b) {
            (Some(a), Some(b)) => Some(mix(a, b)),
            _ => a,
        };
        Self {
            t_s: mix(a.t_s, b.t_s),
            current_a: mix(a.current_a, b.current_a),
            sensor_temperature_c: mix(a.sensor_temperature_c, b.sensor_temperature_c),
            sensor_supply_v: mix(a.sensor_supply_v, b.sensor_supply_v),
            converter_supply_v: mix(a.converter_supply_v, b.converter_supply_v),
            aux_current_a: mix(a.aux_current_a, b.aux_current_a),
            output_shift_v: mix(a.output_shift_v, b.output_shift_v),
            cell_v: mix_known(a.cell_v, b.cell_v),
            pack_v: mix_known(a.pack_v, b.pack_v),
            cell_temperature_c: mix_known(a.cell_temperature_c, b.cell_temperature_c),
            key: a.key,
        }
    }
}

/// How the contactors behave.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Contactors {
    /// High voltage is there from the first row to the last, as in a recording that knows no key.
    AlwaysClosed,
    /// They close when the key is on and the board permits it, after the pre-charge; they open with the key.
    Permitted,
}

/// Time from the permit to closed contactors, in s: pre-charge of the inverter's capacitors.
pub const PRE_CHARGE_S: f64 = 0.1;

/// Why rows are no scenario.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ScenarioError(pub String);

impl fmt::Display for ScenarioError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for ScenarioError {}

/// A drive with its vehicle.
#[derive(Clone, Debug)]
pub struct Scenario {
    rows: Vec<Row>,
    /// The row that began last.
    index: usize,
    contactors: Contactors,
    closed: bool,
    /// Since when key and permit have asked for high voltage.
    asked_since_s: Option<f64>,
}

impl Scenario {
    /// Rows in order of time; before the first and after the last they stay as they are.
    ///
    /// # Errors
    /// If there is no row or time runs backwards.
    pub fn new(rows: Vec<Row>, contactors: Contactors) -> Result<Self, ScenarioError> {
        let Some(first) = rows.first() else {
            return Err(ScenarioError(
                "a scenario needs at least one row".to_owned(),
            ));
        };
        if !first.t_s.is_finite() {
            return Err(ScenarioError("the first row has no time".to_owned()));
        }
        if let Some(pair) = rows
            .windows(2)
            .find(|pair| pair[1].t_s.is_nan() || pair[1].t_s < pair[0].t_s)
        {
            return Err(ScenarioError(format!(
                "time runs backwards from {} s to {} s",
                pair[0].t_s, pair[1].t_s
            )));
        }
        Ok(Self {
            rows,
            index: 0,
            contactors,
            closed: contactors == Contactors::AlwaysClosed,
            asked_since_s: None,
        })
    }

    /// One state for ever.
    pub fn steady(row: Row, contactors: Contactors) -> Self {
        Self {
            rows: vec![row],
            index: 0,
            contactors,
            closed: contactors == Contactors::AlwaysClosed,
            asked_since_s: None,
        }
    }

    /// Time of the last row, in s.
    pub fn end_s(&self) -> f64 {
        self.rows.last().map_or(0.0, |row| row.t_s)
    }

    /// Goes on with other rows from now on; their times count as the old ones did.
    pub fn replace(&mut self, rows: Vec<Row>) {
        if !rows.is_empty() {
            self.rows = rows;
            self.index = 0;
        }
    }

    /// The next time after `t_s` at which something jumps: a row with the same time as its predecessor or another key.
    /// Steps of the simulation end there, so that a jump stays one.
    pub fn next_row_after(&self, t_s: f64) -> Option<f64> {
        self.rows[self.index..]
            .iter()
            .map(|row| row.t_s)
            .find(|row| *row > t_s)
    }

    /// The state at `t_s`, which must not be earlier than in the call before. Of rows with the same time the last counts;
    /// `before` takes the first instead, for the end of a step that ends there.
    pub fn at(&mut self, t_s: f64, before: bool) -> Row {
        let passed = |row: &Row| {
            if before {
                row.t_s < t_s
            } else {
                row.t_s <= t_s
            }
        };
        while self.rows.get(self.index + 1).is_some_and(passed) {
            self.index += 1;
        }
        let a = &self.rows[self.index];
        let Some(b) = self.rows.get(self.index + 1) else {
            return Row { t_s, ..*a };
        };
        if t_s <= a.t_s {
            return Row { t_s, ..*a };
        }
        let fraction = ((t_s - a.t_s) / (b.t_s - a.t_s)).clamp(0.0, 1.0);
        Row {
            t_s,
            ..Row::between(a, b, fraction)
        }
    }

    /// Tells the contactors of the board's permit; whether they are closed.
    pub fn permit(&mut self, permitted: bool, key: Key, t_s: f64) -> bool {
        if self.contactors == Contactors::AlwaysClosed {
            return true;
        }
        if key != Key::On {
            self.closed = false;
            self.asked_since_s = None;
        } else if self.closed {
            // Contactors are not opened under load because a permit is withdrawn while driving.
        } else if permitted {
            let since = *self.asked_since_s.get_or_insert(t_s);
            self.closed = t_s - since >= PRE_CHARGE_S;
        } else {
            self.asked_since_s = None;
        }
        self.closed
    }

    /// Whether high voltage is there.
    pub const fn closed(&self) -> bool {
        self.closed
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    #[test]
    fn between_rows_it_is_a_straight_line_and_beyond_them_it_stays() {
        let rows = vec![
            Row::at_rest(0.0).with_current(10.0),
            Row::at_rest(2.0).with_current(30.0),
            Row::at_rest(2.0).with_current(-5.0),
            Row::at_rest(3.0).with_current(-5.0),
        ];
        let mut scenario = Scenario::new(rows, Contactors::AlwaysClosed).unwrap();
        assert_eq!(scenario.at(-1.0, false).current_a, 10.0);
        assert_eq!(scenario.at(1.0, false).current_a, 20.0);
        assert_eq!(scenario.next_row_after(1.0), Some(2.0));
        assert_eq!(
            scenario.at(2.0, true).current_a,
            30.0,
            "just before the jump"
        );
        assert_eq!(scenario.at(2.0, false).current_a, -5.0, "just after it");
        assert_eq!(scenario.at(9.0, false).current_a, -5.0);
    }

    #[test]
    fn contactors_wait_for_key_permit_and_pre_charge() {
        let mut scenario = Scenario::steady(Row::at_rest(0.0), Contactors::Permitted);
        assert!(!scenario.permit(true, Key::Accessory, 0.0));
        assert!(!scenario.permit(false, Key::On, 1.0));
        assert!(!scenario.permit(true, Key::On, 2.0));
        assert!(!scenario.permit(true, Key::On, 2.05));
        assert!(scenario.permit(true, Key::On, 2.1 + 1e-9));
        assert!(
            scenario.permit(false, Key::On, 3.0),
            "never opened under load"
        );
        assert!(!scenario.permit(true, Key::Off, 4.0));
    }

    #[test]
    fn time_that_runs_backwards_is_refused() {
        let rows = vec![Row::at_rest(1.0), Row::at_rest(0.5)];
        let error = Scenario::new(rows, Contactors::Permitted).unwrap_err();
        assert!(error.to_string().contains("1 s to 0.5 s"), "{error}");
        assert!(Scenario::new(Vec::new(), Contactors::Permitted).is_err());
    }
}
