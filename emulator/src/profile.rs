//! A recording as what the vehicle does: all that is driven is checked before anything runs.

use std::path::Path;

use recording::error::Kind;
use recording::{Mapping, Recording};

use crate::scenario::{Contactors, Key, Row};

/// The end of the large sensor's range, in A.
pub const SENSOR_RANGE_A: f64 = 600.0;

/// What is taken of a recording, and how.
#[derive(Clone, Debug)]
pub struct ProfileOptions {
    /// The recorded current is multiplied by this.
    pub scale: f64,
    /// Seconds of the recording to leave out at its beginning.
    pub skip_s: f64,
    /// Seconds to run; `None` = to the end.
    pub duration_s: Option<f64>,
    /// Seconds at rest, key on, before the recording begins.
    pub lead_s: f64,
    /// Seconds at rest after it: what the board says last can then be compared with what flowed.
    pub tail_s: f64,
    /// The end of the sensor's range, in A, beyond which a current is refused.
    pub limit_a: f64,
}

impl Default for ProfileOptions {
    fn default() -> Self {
        Self {
            scale: 1.0,
            skip_s: 0.0,
            duration_s: None,
            lead_s: 1.0,
            tail_s: 0.5,
            limit_a: SENSOR_RANGE_A,
        }
    }
}

/// A profile that can be run.
#[derive(Clone, Debug)]
pub struct Profile {
    /// In order of time, from 0 s.
    pub rows: Vec<Row>,
    /// With a column `key`, the contactors follow key and permit.
    pub contactors: Contactors,
    /// Where the recorded part begins, in s.
    pub begins_s: f64,
}

/// Key position: 0 = off, 1 = accessory, 2 = on.
const KEY: &str = "key";

/// What a column may say where it does not say a current. Beyond it the unit is wrong, or the board would not survive it.
const LIMITS: [(&str, f64, f64, &str); 6] = [
    // AEC-Q100 grade 0 and the storage range of LEM's sensors end within.
    ("temp_sensor_c", -60.0, 175.0, "°C"),
    // The ADS1100's and ADG849's absolute maximum is 6 V.
    ("v_supply_v", 0.0, 6.0, "V"),
    ("i_aux_a", -10_000.0, 10_000.0, "A"),
    // What the frame BatteryVoltage can carry.
    ("v_cell_v", 0.0, 6.5, "V"),
    ("v_pack_v", 0.0, 1_300.0, "V"),
    ("temp_cell_c", -40.0, 210.0, "°C"),
];

/// Reads a profile whose columns have the names that `mapping` gives them. `t_s` and `i_ref_a` have to be there;
/// `temp_sensor_c`, `v_supply_v`, `i_aux_a`, `v_cell_v`, `v_pack_v`, `temp_cell_c` and `key` (0 off, 1 accessory, 2 on) are
/// used where they are.
///
/// # Errors
/// With file, line and column: a column missing, time running backwards, a temperature or voltage that cannot be; in the part
/// that is driven a current that is missing or beyond the sensor, and up to its end a key position that does not exist.
pub fn read(
    path: &Path,
    mapping: &Mapping,
    options: &ProfileOptions,
) -> recording::Result<Profile> {
    from_recording(&recording::csv::read_mapped(path, mapping)?, options)
}

/// The same from a recording in memory.
///
/// # Errors
/// As [`read`].
pub fn from_recording(
    recording: &Recording,
    options: &ProfileOptions,
) -> recording::Result<Profile> {
    let time = recording.time_s();
    let current = recording.need("i_ref_a")?;
    // One that is there must not count as not there.
    let used = LIMITS.iter().map(|(name, ..)| *name).chain([KEY]);
    recording.table().refuse_left_out(used)?;
    let optional = |name: &str| recording.column(name);
    let columns = Columns {
        sensor_temperature: optional("temp_sensor_c"),
        sensor_supply: optional("v_supply_v"),
        aux: optional("i_aux_a"),
        cell: optional("v_cell_v"),
        pack: optional("v_pack_v"),
        cell_temperature: optional("temp_cell_c"),
        key: optional(KEY),
    };
    check_limits(recording)?;
    let Some(start) = time.first().copied() else {
        return Err(recording
            .table()
            .error_at(Kind::Empty, 0, "t_s", "no row", "at least one"));
    };
    let mut rows: Vec<Row> = Vec::new();
    let mut last: Option<Row> = None;
    for (index, (t_s, recorded_a)) in time.iter().zip(current).enumerate() {
        let t_s = t_s - start - options.skip_s;
        let current_a = recorded_a * options.scale;
        let mut row = Row::at_rest(t_s).with_current(current_a);
        columns.fill(&mut row, recording, index, last.as_ref())?;
        last = Some(row);
        if t_s < 0.0 {
            continue;
        }
        if options.duration_s.is_some_and(|limit| t_s > limit) {
            break;
        }
        if !current_a.is_finite() {
            return Err(recording.table().error_at(
                Kind::Unsupported,
                index,
                "i_ref_a",
                if recorded_a.is_nan() {
                    "nothing".to_owned()
                } else {
                    recorded_a.to_string()
                },
                "a current in A: the board cannot be driven with a gap",
            ));
        }
        if current_a.abs() > options.limit_a {
            return Err(recording.table().error_at(
                Kind::Unsupported,
                index,
                "i_ref_a",
                format!("{current_a} A (scaled by {})", options.scale),
                format!(
                    "at most ±{} A, the end of the sensor's range",
                    options.limit_a
                ),
            ));
        }
        row.t_s = t_s + options.lead_s;
        rows.push(row);
    }
    let Some(first) = rows.first().copied() else {
        return Err(recording.table().error_at(
            Kind::Empty,
            time.len().saturating_sub(1),
            "t_s",
            format!("an end at {} s", recording.span_s()),
            format!("a recording longer than the {} s to skip", options.skip_s),
        ));
    };
    if options.lead_s > 0.0 {
        let rest = first.with_current(0.0);
        // From rest the current comes on within a millisecond, not over the whole lead.
        rows.insert(0, Row { t_s: 0.0, ..rest });
        rows.insert(
            1,
            Row {
                t_s: (first.t_s - 0.001).max(0.0),
                ..rest
            },
        );
    }
    if let Some(last) = rows.last().copied().filter(|_| options.tail_s > 0.0) {
        let rest = last.with_current(0.0);
        rows.extend(
            [options.tail_s.min(0.001), options.tail_s].map(|after_s| Row {
                t_s: last.t_s + after_s,
                ..rest
            }),
        );
    }
    Ok(Profile {
        rows,
        contactors: if columns.key.is_some() {
            Contactors::Permitted
        } else {
            Contactors::AlwaysClosed
        },
        begins_s: options.lead_s,
    })
}

fn check_limits(recording: &Recording) -> recording::Result<()> {
    for (name, lowest, highest, unit) in LIMITS {
        let outside = |value: &f64| !value.is_nan() && !(lowest..=highest).contains(value);
        let values = recording.column(name).unwrap_or_default();
        if let Some(index) = values.iter().position(outside) {
            return Err(recording.table().error_at(
                Kind::Unsupported,
                index,
                name,
                format!("{} {unit}", values[index]),
                format!("{lowest} … {highest} {unit}"),
            ));
        }
    }
    Ok(())
}

struct Columns<'a> {
    sensor_temperature: Option<&'a [f64]>,
    sensor_supply: Option<&'a [f64]>,
    aux: Option<&'a [f64]>,
    cell: Option<&'a [f64]>,
    pack: Option<&'a [f64]>,
    cell_temperature: Option<&'a [f64]>,
    key: Option<&'a [f64]>,
}

impl Columns<'_> {
    fn fill(
        &self,
        row: &mut Row,
        recording: &Recording,
        index: usize,
        last: Option<&Row>,
    ) -> recording::Result<()> {
        // A slow channel is recorded now and then: until its next value the last one holds.
        let held = |column: Option<&[f64]>, last: f64| {
            column
                .map(|values| values[index])
                .filter(|value| value.is_finite())
                .unwrap_or(last)
        };
        let known = |column: Option<&[f64]>, last: Option<f64>| {
            column
                .map(|values| values[index])
                .filter(|value| value.is_finite())
                .or(last)
        };
        let rest = Row::at_rest(0.0);
        let last = last.unwrap_or(&rest);
        row.sensor_temperature_c = held(self.sensor_temperature, last.sensor_temperature_c);
        row.sensor_supply_v = held(self.sensor_supply, last.sensor_supply_v);
        row.converter_supply_v = row.sensor_supply_v;
        row.aux_current_a = held(self.aux, last.aux_current_a);
        row.cell_v = known(self.cell, last.cell_v);
        row.pack_v = known(self.pack, last.pack_v);
        row.cell_temperature_c = known(self.cell_temperature, last.cell_temperature_c);
        if let Some(values) = self.key {
            let value = values[index];
            row.key = match value {
                0.0 => Key::Off,
                1.0 => Key::Accessory,
                2.0 => Key::On,
                _ if value.is_nan() => last.key,
                _ => {
                    return Err(recording.table().error_at(
                        Kind::Unsupported,
                        index,
                        KEY,
                        value.to_string(),
                        "0 (off), 1 (accessory) or 2 (on)",
                    ));
                }
            };
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    fn profile(text: &str, options: &ProfileOptions) -> recording::Result<Profile> {
        let table = recording::csv::parse("drive.csv", text.as_bytes())?;
        from_recording(&table.into_recording()?, options)
    }

    fn refusal(text: &str) -> String {
        profile(text, &ProfileOptions::default())
            .unwrap_err()
            .to_string()
    }

    #[test]
    fn a_recording_becomes_rows_after_a_rest() {
        let text = "t_s,i_ref_a,v_cell_v\n10,1.5,3.7\n11,-2,\n12,3,3.6\n";
        let options = ProfileOptions {
            scale: 100.0,
            tail_s: 0.25,
            ..ProfileOptions::default()
        };
        let profile = profile(text, &options).unwrap();
        let currents: Vec<(f64, f64)> = profile
            .rows
            .iter()
            .map(|row| (row.t_s, row.current_a))
            .collect();
        assert_eq!(
            currents,
            [
                (0.0, 0.0),
                (0.999, 0.0),
                (1.0, 150.0),
                (2.0, -200.0),
                (3.0, 300.0),
                (3.001, 0.0),
                (3.25, 0.0)
            ]
        );
        assert_eq!(profile.rows[3].cell_v, Some(3.7), "the last value holds");
        assert_eq!(profile.contactors, Contactors::AlwaysClosed);
    }

    #[test]
    fn parts_of_a_recording_can_be_taken() {
        let text = "t_s,i_ref_a,key\n0,1,0\n1,2,1\n2,3,2\n3,4,2\n";
        let options = ProfileOptions {
            skip_s: 1.0,
            duration_s: Some(1.0),
            lead_s: 0.0,
            tail_s: 0.0,
            ..ProfileOptions::default()
        };
        let profile = profile(text, &options).unwrap();
        assert_eq!(profile.rows.len(), 2);
        assert_eq!(
            (profile.rows[0].t_s, profile.rows[0].key),
            (0.0, Key::Accessory)
        );
        assert_eq!(profile.contactors, Contactors::Permitted);
    }

    /// A recording with a gap still has parts that can be driven.
    #[test]
    fn only_the_current_of_the_part_that_is_driven_has_to_be_there() {
        let text = "t_s,i_ref_a\n0,1\n1,\n2,3\n3,4\n4,700\n";
        let part = |skip_s, duration_s| {
            let options = ProfileOptions {
                skip_s,
                duration_s: Some(duration_s),
                lead_s: 0.0,
                tail_s: 0.0,
                ..ProfileOptions::default()
            };
            profile(text, &options).map(|profile| profile.rows.len())
        };
        assert_eq!(part(2.0, 1.0).unwrap(), 2);
        assert_eq!(part(0.0, 0.5).unwrap(), 1);
        assert!(part(0.0, 1.0).unwrap_err().to_string().contains("line 3"));
        assert!(part(2.0, 2.0).unwrap_err().to_string().contains("line 6"));
    }

    #[test]
    fn bad_input_is_refused_with_file_line_and_column() {
        for (text, parts) in [
            ("t_s,u_v\n0,1\n", &["drive.csv", "i_ref_a", "u_v"][..]),
            (
                "t_s,i_ref_a\n0,1\n2,1\n1,1\n",
                &["drive.csv", "line 4", "t_s"],
            ),
            (
                "t_s,i_ref_a\n0,1\n1,NaN\n",
                &["drive.csv", "line 3", "i_ref_a"],
            ),
            (
                "t_s,i_ref_a\n0,1\n1,\n",
                &["drive.csv", "line 3", "i_ref_a"],
            ),
            (
                "t_s,i_ref_a\n0,1\n1,601\n",
                &["drive.csv", "line 3", "i_ref_a", "601 A", "±600 A"],
            ),
            (
                "t_s,i_ref_a,key\n0,1,5\n",
                &["drive.csv", "line 2", "key", "0 (off)"],
            ),
            (
                "t_s,i_ref_a,temp_sensor_c\n0,1,25\n1,1,298\n",
                &["drive.csv", "line 3", "temp_sensor_c", "298 °C", "175 °C"],
            ),
            (
                "t_s,i_ref_a,v_cell_v\n0,1,3700\n",
                &["drive.csv", "line 2", "v_cell_v", "3700 V", "6.5 V"],
            ),
            ("t_s,i_ref_a\n", &["drive.csv"]),
        ] {
            let message = refusal(text);
            for part in parts {
                assert!(message.contains(part), "{message:?} should name {part:?}");
            }
        }
    }
}
