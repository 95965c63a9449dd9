//! From recordings to problems: what is masked, cut and counted once, and nothing that is invented.

use std::{fs, path::Path};

use twin::{
    align::{Alignment, Signal, estimate},
    effects::scene::Scene,
    failure::Failure,
    model::Model,
    prepare::{Inputs, Prepared, Purpose, prepare},
    problem::{Base, BatteryBase, Problem, View},
};

const PAIR: &str = "schema = 1\n[sensor]\n";

fn text(header: &str, rows: impl Iterator<Item = Vec<f64>>) -> String {
    let mut text = format!("{header}\n");
    for row in rows {
        let fields: Vec<String> = row
            .iter()
            .map(|value| {
                if value.is_nan() {
                    String::new()
                } else {
                    value.to_string()
                }
            })
            .collect();
        text.push_str(&fields.join(","));
        text.push('\n');
    }
    text
}

fn read(
    folder: &Path,
    model: &str,
    recording: &str,
    mapping: &[&str],
) -> Result<Prepared, Failure> {
    let path = folder.join("r.csv");
    fs::write(&path, recording).unwrap();
    let model = Model::parse("m.toml", model.to_owned(), folder)?;
    let inputs = Inputs {
        recording: path,
        reference: None,
        mapping: mapping.iter().map(|text| (*text).to_owned()).collect(),
    };
    prepare(&model, &inputs, Purpose::Compare)
}

fn one(model: &str, recording: &str) -> (Problem, Vec<String>) {
    let folder = tempfile::tempdir().unwrap();
    let prepared = read(folder.path(), model, recording, &[]).unwrap();
    assert_eq!(prepared.items.len(), 1);
    (prepared.items[0].problem.clone(), prepared.remarks)
}

/// A current that never repeats itself.
fn current(t_s: f64) -> f64 {
    10.0 * (0.37 * t_s).sin() + 3.0 * (1.91 * t_s).sin() + 1.0
}

#[test]
fn a_plain_pair_is_taken_as_it_is() {
    let rows = (0..200).map(|k| {
        let t = f64::from(k) * 0.1;
        vec![t, current(t), current(t) + 0.5, 20.0 + t]
    });
    let (problem, remarks) = one(PAIR, &text("t_s,i_ref_a,i_meas_a,temp_sensor_c", rows));
    assert_eq!(problem.view, View::Sensor);
    assert_eq!(
        (problem.name.as_str(), problem.unit.as_str()),
        ("i_meas_a", "A")
    );
    assert!(problem.observed.on_drive_rows());
    assert_eq!(problem.observed.valid_rows(), 200);
    assert_eq!(problem.drive.segments, vec![0..200]);
    assert_eq!(problem.drive.reference[7], current(0.7));
    assert_eq!(problem.observed.value[7], current(0.7) + 0.5);
    assert!(problem.drive.supply_v.is_none());
    assert!(problem.drive.sensor_temperature_c.is_some());
    assert!(remarks.is_empty(), "{remarks:?}");
}

/// Ten million rows are to fit into 1 GB.
#[test]
fn a_column_that_two_share_is_held_once() {
    let rows = (0..200).map(|k| {
        let t_s = 0.1 * f64::from(k);
        vec![t_s, current(t_s), current(t_s)]
    });
    let (problem, _) = one(PAIR, &text("t_s,i_ref_a,i_meas_a", rows));
    assert_eq!(problem.drive.t_s.as_ptr(), problem.observed.t_s.as_ptr());
    let mut scene = Scene::new(&problem);
    assert_eq!(problem.drive.reference.as_ptr(), scene.signal.as_ptr());
    // Until one of them is written to.
    scene.signal[0] += 1.0;
    assert_eq!(scene.signal[0], problem.drive.reference[0] + 1.0);
    assert_eq!(scene.signal[1..], problem.drive.reference[1..]);
}

#[test]
fn nothing_is_filled_in_but_the_surroundings() {
    let rows = (0..200).map(|k| {
        let t = f64::from(k) * 0.1;
        let reference = if (40..45).contains(&k) {
            f64::NAN
        } else {
            current(t)
        };
        let measured = if (40..45).contains(&k) || (90..120).contains(&k) {
            f64::NAN
        } else {
            current(t)
        };
        let temperature = if k % 10 == 3 { 20.0 + t } else { f64::NAN };
        vec![t, reference, measured, temperature]
    });
    let (problem, _) = one(PAIR, &text("t_s,i_ref_a,i_meas_a,temp_sensor_c", rows));
    // Rows without a reference are no part of the drive; half a second is no gap.
    assert_eq!(problem.drive.len(), 195);
    assert_eq!(problem.drive.segments, vec![0..195]);
    assert_eq!(problem.observed.valid_rows(), 165);
    let masked = problem
        .observed
        .value
        .iter()
        .filter(|value| value.is_nan())
        .count();
    assert_eq!(masked, 30);
    let temperature = problem.drive.sensor_temperature_c.unwrap();
    assert_eq!(temperature[0], 20.3);
    assert_eq!(temperature[12], 20.3);
    assert_eq!(temperature[13], 21.3);
}

/// As a bus has them: a message of its own for the temperature, in rows without a reference.
#[test]
fn surroundings_in_rows_of_their_own_are_held() {
    let (mut rows, mut after_message) = (Vec::new(), Vec::new());
    let mut temperature = 20.0;
    for k in 0..200 {
        let t = f64::from(k) * 0.1;
        if k % 10 == 5 {
            temperature = 20.0 + t;
            rows.push(vec![t - 0.01, f64::NAN, f64::NAN, temperature]);
        }
        rows.push(vec![t, current(t), current(t), f64::NAN]);
        after_message.push(if k < 5 { 20.5 } else { temperature });
    }
    let (problem, _) = one(
        PAIR,
        &text("t_s,i_ref_a,i_meas_a,temp_sensor_c", rows.into_iter()),
    );
    assert_eq!(problem.drive.len(), 200);
    let held = problem.drive.sensor_temperature_c.unwrap();
    assert_eq!(held.to_vec(), after_message);
}

/// Two loggers of one make call their columns alike: the reference's name is the reference's.
#[test]
fn a_reference_whose_column_is_called_as_the_recordings_can_be_mapped() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let rows = |from: u32, size: f64| {
        text(
            "t_s,Current",
            (from..3_000).map(move |k| {
                let t = f64::from(k) * 0.1;
                vec![t, size * current(t)]
            }),
        )
    };
    fs::write(folder.join("r.csv"), rows(0, 1.1)).unwrap();
    fs::write(folder.join("shunt.csv"), rows(5, 1.0)).unwrap();
    let model = Model::parse("m.toml", PAIR.to_owned(), folder).unwrap();
    let inputs = Inputs {
        recording: folder.join("r.csv"),
        reference: Some(folder.join("shunt.csv")),
        mapping: vec!["i_meas_a=Current".into(), "i_ref_a=Current".into()],
    };
    let prepared = prepare(&model, &inputs, Purpose::Compare).unwrap();
    let problem = &prepared.items[0].problem;
    assert_eq!(problem.drive.len(), 2_995);
    let ratio = |values: &[f64]| values.iter().map(|value| value.abs()).fold(0.0, f64::max);
    let seen = ratio(&problem.observed.value) / ratio(&problem.drive.reference);
    assert!((seen - 1.1).abs() < 0.01, "{seen}");
}

/// A counter that a bus sends in a message of its own tells nothing at the current's rows, and that is said.
#[test]
fn a_testers_counter_in_rows_of_its_own_is_remarked() {
    let model =
        "schema = 1\n[battery]\ncapacity_ah = 3\ninitial_soc = 0.9\nocv = [[0, 3], [1, 4]]\n";
    for own_rows in [false, true] {
        let mut ah = 0.0;
        let rows = (0..2_000).flat_map(|k| {
            let t = f64::from(k);
            let current = current(0.1 * t);
            ah += current / 3_600.0;
            let volts = 3.9 - 0.3 * ah;
            if own_rows {
                vec![
                    vec![t, current, volts, f64::NAN],
                    vec![t + 0.5, f64::NAN, f64::NAN, ah],
                ]
            } else {
                vec![vec![t, current, volts, ah]]
            }
        });
        let rows: Vec<_> = rows.collect();
        let (_, remarks) = one(
            model,
            &text("t_s,i_ref_a,v_cell_v,ah_meas_ah", rows.into_iter()),
        );
        let told = remarks.join("; ");
        assert_eq!(
            told.contains("ah_meas_ah: 0 of its 2000 readings are in rows with i_ref_a"),
            own_rows,
            "{told}"
        );
    }
}

#[test]
fn a_gap_begins_a_stretch_and_a_slow_rest_does_not() {
    // 0.1 s, a gap of 60 s, 0.1 s, a rest at 10 s a row, 0.1 s.
    let mut t = 0.0;
    let mut times = Vec::new();
    for k in 0..400 {
        t += match k {
            0 => 0.0,
            100 => 60.0,
            200..=230 => 10.0,
            _ => 0.1,
        };
        times.push(t);
    }
    let rows = times.iter().map(|t| vec![*t, current(*t), current(*t)]);
    let (problem, _) = one(PAIR, &text("t_s,i_ref_a,i_meas_a", rows));
    assert_eq!(problem.drive.segments, vec![0..100, 100..400]);
    assert_eq!(problem.drive.continues, [false, true]);
    let segments = [99, 100].map(|row| problem.observed.segment_of(row));
    assert_eq!(segments, [0, 1]);
}

#[test]
fn a_clock_that_starts_anew_begins_a_stretch_of_its_own() {
    let rows = (0..300).map(|k| {
        let t = f64::from(k % 100) * 0.1;
        vec![t, f64::from(k / 100), current(t), current(t)]
    });
    let (problem, _) = one(PAIR, &text("t_s,cycle,i_ref_a,i_meas_a", rows));
    assert_eq!(problem.drive.segments, vec![0..100, 100..200, 200..300]);
    assert_eq!(problem.drive.continues, [false, false, false]);
}

#[test]
fn a_held_value_counts_once() {
    // Measured each 0.1 s, read each 0.02 s.
    let rows = (0..1000).map(|k| {
        let t = f64::from(k) * 0.02;
        vec![t, current(t), current(f64::from(k / 5) * 0.1)]
    });
    let (problem, remarks) = one(PAIR, &text("t_s,i_ref_a,i_meas_a", rows));
    assert_eq!(problem.observed.valid_rows(), 200);
    assert!((0..1000).all(|row| problem.observed.valid[row] == (row % 5 == 0)));
    assert!(remarks[0].contains("100.000 ms"), "{remarks:?}");
}

#[test]
fn the_last_digits_of_arithmetic_are_no_new_reading() {
    let rows = (0..1000).map(|k| {
        let t = f64::from(k) * 0.02;
        let held = current(f64::from(k / 5) * 0.1);
        vec![
            t,
            current(t),
            held * (1.0 + f64::EPSILON * f64::from(k % 3)),
        ]
    });
    let (problem, _) = one(PAIR, &text("t_s,i_ref_a,i_meas_a", rows));
    assert_eq!(problem.observed.valid_rows(), 200);
}

#[test]
fn a_held_voltage_counts_once_and_a_rest_is_not_held() {
    let loads = (0..100).map(|k| (8, [0.5, 2.0, 1.0, -0.5][k % 4]));
    let steps: Vec<(usize, f64)> = loads.chain([(400, 0.0)]).collect();
    let rows = cell(&steps);
    // Written each second, read each 10 s; and in steps of 1 mV, read each second.
    let held = rows
        .iter()
        .map(|row| vec![row[0], row[1], rows[row[0] as usize / 10 * 10][2]]);
    let in_steps = rows
        .iter()
        .map(|row| vec![row[0], row[1], (1e3 * row[2]).round() / 1e3]);
    let header = "t_s,i_ref_a,v_cell_v";
    let (problem, remarks) = one(BATTERY, &text(header, held));
    // At rest it stays, and counts again when it must have been read again.
    let fresh =
        |rows: std::ops::Range<usize>| rows.filter(|row| problem.observed.valid[*row]).count();
    assert_eq!(fresh(0..800), 80);
    assert!((20..=40).contains(&fresh(800..1200)));
    let says = |remark: &String| remark.contains("a new value about every 10.0");
    assert!(remarks.iter().any(says), "{remarks:?}");
    let (problem, _) = one(BATTERY, &text(header, in_steps));
    assert_eq!(problem.observed.valid_rows(), 1200);
}

#[test]
fn a_held_value_that_stays_the_same_was_measured_again() {
    // At a rail from 5 s to 10 s.
    let rows = (0..1000).map(|k| {
        let t = f64::from(k) * 0.02;
        let held = f64::from(k / 5) * 0.1;
        let value = if (5.0..10.0).contains(&held) {
            20.0
        } else {
            current(held)
        };
        vec![t, current(t), value]
    });
    let (problem, _) = one(PAIR, &text("t_s,i_ref_a,i_meas_a", rows));
    let inside = (250..500)
        .filter(|row| problem.observed.valid[*row])
        .count();
    // Once for each interval and a half at the latest.
    assert!((30..=51).contains(&inside), "{inside}");
}

#[test]
fn clipping_and_a_dead_band_are_no_holding() {
    let clipped = (0..400).map(|k| {
        let t = f64::from(k) * 0.1;
        vec![t, current(t), current(t).clamp(-4.0, 5.0)]
    });
    let (problem, remarks) = one(PAIR, &text("t_s,i_ref_a,i_meas_a", clipped));
    assert_eq!(problem.observed.valid_rows(), 400);
    assert!(
        remarks.iter().any(|remark| remark.contains("clipped")),
        "{remarks:?}"
    );
    let dead = (0..400).map(|k| {
        let t = f64::from(k) * 0.1;
        let value = if current(t).abs() < 7.0 {
            0.0
        } else {
            current(t)
        };
        vec![t, current(t), value]
    });
    let (problem, _) = one(PAIR, &text("t_s,i_ref_a,i_meas_a", dead));
    assert_eq!(problem.observed.valid_rows(), 400);
    let coarse = (0..400).map(|k| {
        let t = f64::from(k) * 0.1;
        vec![t, current(t), (current(t) / 2.0).round() * 2.0]
    });
    let (problem, _) = one(PAIR, &text("t_s,i_ref_a,i_meas_a", coarse));
    assert_eq!(problem.observed.valid_rows(), 400);
}

#[test]
fn a_window_that_is_read_in_steps_with_noise_is_no_holding() {
    // A mean that is new each 0.37 s; noise takes the reading a step up or down from row to row.
    let rows = (0..1000).map(|k| {
        let t = f64::from(k) * 0.1;
        let noise = 0.6 * (12.9898 * f64::from(k * k % 977)).sin();
        let value = 40.0 * current((t / 0.37).floor() * 0.37) + noise;
        vec![t, 40.0 * current(t), value.round()]
    });
    let (problem, remarks) = one(PAIR, &text("t_s,i_ref_a,i_meas_a", rows));
    assert_eq!(problem.observed.valid_rows(), 1000, "{remarks:?}");
}

#[test]
fn rows_of_their_own_are_not_interpolated() {
    // As a bus delivers them: either the one or the other.
    let rows = (0..400).map(|k| {
        let t = f64::from(k) * 0.05;
        if k % 2 == 0 {
            vec![t, current(t), f64::NAN]
        } else {
            vec![t, f64::NAN, current(t) + 0.5]
        }
    });
    let (problem, _) = one(PAIR, &text("t_s,i_ref_a,i_meas_a", rows));
    assert!(!problem.observed.on_drive_rows());
    assert_eq!(problem.drive.len(), 200);
    assert_eq!(problem.observed.t_s.len(), 200);
    assert!((problem.observed.t_s[3] - 0.35).abs() < 1e-12);
    // The last one is after the drive's end.
    assert_eq!(problem.observed.valid_rows(), 199);
}

#[test]
fn a_held_value_counts_once_on_rows_of_its_own() {
    // As a bus delivers them: measured each 0.1 s, sent each 0.02 s, the reference between.
    let rows = (0..2000).map(|k| {
        let t = f64::from(k) * 0.01;
        if k % 2 == 0 {
            vec![t, current(t), f64::NAN]
        } else {
            vec![t, f64::NAN, current(f64::from(k / 10) * 0.1)]
        }
    });
    let (problem, remarks) = one(PAIR, &text("t_s,i_ref_a,i_meas_a", rows));
    assert!(!problem.observed.on_drive_rows());
    let fresh = problem.observed.valid_rows();
    assert!((198..=202).contains(&fresh), "{fresh}");
    assert!(remarks[0].contains("100.000 ms"), "{remarks:?}");
    // A reference that comes each second does not jump there: readings in steps between two of its rows are new.
    let rows = (0..2000).map(|k| {
        let t = f64::from(k) * 0.1;
        if k % 10 == 0 {
            vec![t, current(0.1 * t), f64::NAN]
        } else {
            vec![t, f64::NAN, (current(0.1 * t) / 0.4).round() * 0.4]
        }
    });
    let (problem, remarks) = one(PAIR, &text("t_s,i_ref_a,i_meas_a", rows));
    let fresh = problem.observed.valid_rows();
    assert!(fresh > 1780, "{fresh} {remarks:?}");
}

#[test]
fn a_dead_sensor_is_not_in_another_unit() {
    let folder = tempfile::tempdir().unwrap();
    let rows = (0..400).map(|k| {
        let t = f64::from(k) * 0.1;
        let noise = 0.05 * (12.9898 * f64::from(k * k % 977)).sin();
        vec![t, 4.0 * current(t), noise]
    });
    let recording = text("t_s,i_ref_a,i_meas_a", rows);
    let prepared = read(folder.path(), PAIR, &recording, &[]).unwrap();
    let remarks = prepared.remarks;
    assert!(
        remarks
            .iter()
            .any(|remark| remark.contains("the sensor may be dead")),
        "{remarks:?}"
    );
}

#[test]
fn a_minus_turns_the_sign() {
    let folder = tempfile::tempdir().unwrap();
    let rows = (0..200).map(|k| {
        let t = f64::from(k) * 0.1;
        vec![t, current(t), -current(t)]
    });
    let recording = text("Time,Shunt,Board", rows);
    let mapping = ["t_s=Time", "i_ref_a=Shunt", "i_meas_a=-Board"];
    let prepared = read(folder.path(), PAIR, &recording, &mapping).unwrap();
    assert_eq!(prepared.items[0].problem.observed.value[5], current(0.5));
    // The same in the model file, which the command line overrules.
    let model = "schema = 1\n[columns]\nt_s = \"Time\"\ni_ref_a = \"Shunt\"\ni_meas_a = \"Shunt\"\n[sensor]\n";
    let prepared = read(folder.path(), model, &recording, &["i_meas_a=-Board"]).unwrap();
    assert_eq!(prepared.items[0].problem.observed.value[5], current(0.5));
}

#[test]
fn a_column_of_the_model_file_that_a_recording_lacks_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let rows = |more: bool| {
        (0..200).map(move |k| {
            let t = f64::from(k) * 0.1;
            let mut row = vec![t, current(t), current(t) + 0.5];
            row.extend(more.then_some(20.0 + t));
            row
        })
    };
    let without = text("t_s,Shunt,i_meas_a", rows(false));
    let columns = "schema = 1\n[columns]\ni_ref_a = \"Shunt\"\ntemp_sensor_c = \"-T7\"\n[sensor]\n";
    let prepared = read(folder.path(), columns, &without, &[]).unwrap();
    let says = |prepared: &Prepared| {
        let remarks = prepared.remarks.iter();
        remarks
            .filter(|remark| remark.contains("columns.temp_sensor_c"))
            .count()
    };
    assert_eq!(says(&prepared), 1, "{:?}", prepared.remarks);
    assert!(
        prepared.items[0]
            .problem
            .drive
            .sensor_temperature_c
            .is_none()
    );
    assert_eq!(
        prepared.items[0].problem.observed.value[5],
        current(0.5) + 0.5
    );
    // Where it is, either way, nothing is said.
    for name in ["T7", "-T7"] {
        let with = text(&format!("t_s,Shunt,i_meas_a,{name}"), rows(true));
        let prepared = read(folder.path(), columns, &with, &[]).unwrap();
        assert_eq!(says(&prepared), 0, "{:?}", prepared.remarks);
        assert!(
            prepared.items[0]
                .problem
                .drive
                .sensor_temperature_c
                .is_some()
        );
    }
    // In a file beside it, it is there too.
    let reference = (0..2000).map(|k| {
        let t = f64::from(k) * 0.01;
        vec![t, current(t), 20.0 + t]
    });
    fs::write(
        folder.path().join("ref.csv"),
        text("Time,Shunt,T7", reference),
    )
    .unwrap();
    fs::write(
        folder.path().join("r.csv"),
        text("t_s,i_meas_a", rows(false).map(|row| vec![row[0], row[2]])),
    )
    .unwrap();
    let inputs = Inputs {
        recording: folder.path().join("r.csv"),
        reference: Some(folder.path().join("ref.csv")),
        mapping: Vec::new(),
    };
    let timed = columns.replacen("[columns]", "[columns]\nt_s = \"Time\"", 1);
    let model = Model::parse("m.toml", timed, folder.path()).unwrap();
    let prepared = prepare(&model, &inputs, Purpose::Compare).unwrap();
    assert_eq!(says(&prepared), 0, "{:?}", prepared.remarks);
    assert!(
        prepared.items[0]
            .problem
            .drive
            .sensor_temperature_c
            .is_some()
    );
}

/// An effect of the model file that lacks what it goes by does nothing, and that is said.
#[test]
fn an_effect_without_its_column_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let sensor = "schema = 1\n[sensor]\nfull_scale = 60\n";
    let battery = "schema = 1\n[battery]\ncapacity_ah = 2\nocv = [[0, 3.0], [1, 4.0]]\nohmic_resistance_ohm = 0.01\n";
    let cases: [(&str, &str, &str, &[&str]); 8] = [
        (
            sensor,
            "offset-temperature",
            "tc_a_per_k = 0.01",
            &["temp_sensor_c"],
        ),
        (
            sensor,
            "gain-temperature",
            "tc_per_k = 0.001",
            &["temp_sensor_c"],
        ),
        (sensor, "stray-field", "coupling = 0.01", &["i_aux_a"]),
        (
            sensor,
            "range-mismatch",
            "gain_ratio = 1.01\noffset_a = 0.1",
            &["range_high"],
        ),
        (sensor, "range-handover", "tau_s = 0.2", &["range_high"]),
        (sensor, "supply-ratiometric", "ratio = 0.1", &["v_supply_v"]),
        (
            battery,
            "resistance-temperature",
            "b_k = 2000",
            &["temp_cell_c", "temp_ambient_c"],
        ),
        (
            battery,
            "entropic",
            "v_per_k = 1e-4",
            &["temp_cell_c", "temp_ambient_c"],
        ),
    ];
    for (model, id, values, columns) in cases {
        let model = format!("{model}[effects.{id}]\n{values}\n");
        let recording = |more: Option<&str>| {
            let rows = (0..200).map(|k| {
                let t = f64::from(k) * 0.1;
                let volts = 3.9 - 0.01 * current(t) + 1e-4 * (7919.0 * t * t).sin();
                let mut row = vec![t, current(t), current(t) + 0.5, volts];
                row.extend(more.map(|_| f64::from(k % 40 / 20) + 5.0));
                row
            });
            let more = more.map(|name| format!(",{name}")).unwrap_or_default();
            text(&format!("t_s,i_ref_a,i_meas_a,v_cell_v{more}"), rows)
        };
        let source = folder.path().join("r.csv").display().to_string();
        let remark = format!(
            "[effects.{id}] does nothing here: no column {} in {source}",
            columns.join(" or ")
        );
        let says = |more: Option<&str>| {
            let remarks = read(folder.path(), &model, &recording(more), &[])
                .unwrap()
                .remarks;
            let said = remarks
                .iter()
                .filter(|said| said.contains("does nothing here"));
            (said.cloned().collect::<Vec<_>>(), remarks)
        };
        let (said, remarks) = says(None);
        assert_eq!(said, [remark], "{remarks:?}");
        for column in columns {
            let (said, remarks) = says(Some(column));
            assert!(said.is_empty(), "{column}: {remarks:?}");
        }
    }
    // A cell that warms itself has a temperature.
    let warm = format!(
        "{battery}[effects.resistance-temperature]\nb_k = 2000\n[effects.cell-self-heating]\nrth_k_per_w = 5\ntau_s = 10\n"
    );
    let rows = (0..200).map(|k| {
        let t = f64::from(k) * 0.1;
        vec![t, current(t), 3.9 - 0.01 * current(t)]
    });
    let remarks = read(
        folder.path(),
        &warm,
        &text("t_s,i_ref_a,v_cell_v", rows),
        &[],
    )
    .unwrap()
    .remarks;
    assert!(
        !remarks
            .iter()
            .any(|said| said.contains("does nothing here")),
        "{remarks:?}"
    );
}

#[test]
fn a_counter_becomes_mean_currents_and_a_reset_cuts() {
    // 1 A for 300 s at 0.5 s, with a counter set anew after 150 s.
    let rows = (0..600).map(|k| {
        let t = f64::from(k) * 0.5;
        let reference = 1.0 + 0.1 * (0.2 * t).sin();
        let charge = t - 0.5 * ((0.2 * t).cos() - 1.0);
        vec![
            t,
            reference,
            if k < 300 {
                1e4 + charge
            } else {
                charge - 150.0
            },
        ]
    });
    let model = "schema = 1\n[sensor]\n[charge]\nstep_c = 0.001\n";
    let (problem, remarks) = one(model, &text("t_s,i_ref_a,q_meas_c", rows));
    assert_eq!(
        (problem.view, problem.name.as_str(), problem.unit.as_str()),
        (View::Charge, "q_meas_c", "A")
    );
    assert!(
        remarks
            .iter()
            .any(|remark| remark.contains("set anew once, where a new stretch begins")),
        "{remarks:?}"
    );
    assert_eq!(problem.drive.segments, vec![0..300, 300..600]);
    // Each second one, and the first of each stretch has no difference.
    assert_eq!(problem.observed.valid_rows(), 299 - 1);
    let predicted = twin::explain::predict(&problem, &[]);
    for (row, simulated) in predicted.iter().enumerate() {
        if problem.observed.valid[row] {
            // The counter is exact; straight lines between the rows of the drive are not, by h²/12 of the curvature.
            let bound = 0.25 / 12.0 * 0.1 * 0.04;
            assert!(
                (problem.observed.value[row] - simulated).abs() < 1.1 * bound,
                "row {row}"
            );
        }
    }
}

/// A counter of a drive: what it counts in floor steps, of a current at 10 rows a second.
fn counted(step_c: f64, current_a: impl Fn(f64) -> f64) -> (Problem, Vec<String>) {
    counted_through(step_c, current_a, |i| i)
}

/// The same with what is counted of the current.
fn counted_through(
    step_c: f64,
    current_a: impl Fn(f64) -> f64,
    of: impl Fn(f64) -> f64,
) -> (Problem, Vec<String>) {
    let mut charge = 0.0;
    let rows: Vec<Vec<f64>> = (0..6000)
        .map(|k| {
            let t = f64::from(k) * 0.1;
            let row = vec![
                t,
                current_a(t),
                if step_c > 0.0 {
                    step_c * (charge / step_c).floor()
                } else {
                    charge
                },
            ];
            charge += 0.1 * 0.5 * (of(current_a(t)) + of(current_a(t + 0.1)));
            row
        })
        .collect();
    let model = "schema = 1\n[sensor]\n[charge]\n";
    one(model, &text("t_s,i_ref_a,q_meas_c", rows.into_iter()))
}

/// A counter's creep threshold and its rail act on the current, not on its mean between two readings: of 5 A for a fifth of each second
/// and 1 A for the rest a threshold of 1.5 A leaves 1 A, and no threshold on their mean of 1.8 A does.
#[test]
fn a_counter_counts_what_comes_through_a_threshold() {
    let current_a = |t: f64| 1.0 + 60.0 * (0.03 * t).sin() * (2.0 * t).sin().powi(8);
    for (id, values, of) in [
        (
            "dead-band",
            vec![1.5],
            (|i| if i.abs() < 1.5 { 0.0 } else { i }) as fn(f64) -> f64,
        ),
        ("clipping", vec![20.0, -30.0], |i| i.clamp(-30.0, 20.0)),
    ] {
        let (problem, _) = counted_through(0.0, current_a, of);
        let predicted = twin::explain::predict(&problem, &[(id.to_owned(), values)]);
        let plain = twin::explain::predict(&problem, &[]);
        let off = |simulated: &[f64]| {
            let valid = (0..simulated.len()).filter(|row| problem.observed.valid[*row]);
            valid
                .map(|row| (problem.observed.value[row] - simulated[row]).abs())
                .fold(0.0, f64::max)
        };
        assert!(off(&plain) > 1.0, "{id}: nothing to be seen");
        assert!(off(&predicted) < 1e-9, "{id}: {}", off(&predicted));
    }
}

#[test]
fn a_step_that_a_counter_shows_is_taken_as_stated() {
    let drive = |t: f64| 20.0 + 30.0 * (0.11 * t).sin() + 15.0 * (0.7 * t).sin();
    let (problem, remarks) = counted(10.0, drive);
    assert!(
        remarks
            .iter()
            .any(|remark| remark.contains("steps of 10 C")),
        "{remarks:?}"
    );
    let Base::Sensor(base) = &problem.base else {
        panic!("a sensor");
    };
    assert!((base.step - 10.0).abs() < 1e-6, "{}", base.step);
    // Even over a step at both ends.
    let noise = (2.0 * 10.0_f64.powi(2) / 12.0).sqrt();
    assert!(
        (problem.noise / noise - 1.0).abs() < 1e-6,
        "{}",
        problem.noise
    );
    let report = twin::explain::explain(
        &[problem],
        &[],
        &twin::explain::Options::default(),
        &mut |_, _| (),
    );
    assert_eq!(report.verdict, twin::report::data::Verdict::NoMismatch);
    // Even levels of a current move a counter without steps by even amounts.
    for smooth in [
        counted(0.0, drive),
        counted(0.0, |t| 10.0 * (t / 60.0).floor()),
    ] {
        assert!(
            smooth.1.iter().all(|remark| !remark.contains("steps of")),
            "{:?}",
            smooth.1
        );
    }
}

const BATTERY: &str = "schema = 1\n[battery]\ncapacity_ah = 1\nocv = [[0, 3.0], [1, 4.0]]\nohmic_resistance_ohm = 0.01\n";

fn discharge(counter: bool) -> String {
    // 0.5 A for 600 s, 3000 s without a row, 0.5 A for 600 s. A constant current is a fine current.
    let header = if counter {
        "t_s,i_ref_a,v_cell_v,ah_meas_ah"
    } else {
        "t_s,i_ref_a,v_cell_v"
    };
    let rows = (0..1200).map(|k| {
        let t = f64::from(k) + if k < 600 { 0.0 } else { 3000.0 };
        // During the gap 0.1 A flowed.
        let ah = 0.5 * f64::from(k) / 3600.0
            + if k < 600 {
                0.0
            } else {
                (0.1 * 3001.0 - 0.5) / 3600.0
            };
        let ripple = 0.001 * f64::from(k % 7);
        let volts = 3.0 + (0.9 - ah) - 0.01 * (0.5 + ripple);
        let mut row = vec![t, 0.5 + ripple, volts];
        if counter {
            row.push(ah);
        }
        row
    });
    text(header, rows)
}

#[test]
fn the_state_of_charge_goes_on_over_a_gap() {
    let (problem, remarks) = one(BATTERY, &discharge(true));
    assert_eq!(problem.view, View::Voltage);
    let Base::Battery(base) = &problem.base else {
        panic!("{problem:?}");
    };
    assert_eq!(base.initial_soc.len(), 2);
    // From the first reading: open circuit is 3 V and the state of charge.
    assert!(
        (base.initial_soc[0] - 0.9).abs() < 1e-6,
        "{:?}",
        base.initial_soc
    );
    assert_eq!(base.initial_soc_sigma.len(), 1);
    assert!(base.initial_soc_sigma[0] > 0.005);
    assert!(
        remarks.iter().any(|remark| remark.contains("initial_soc")),
        "{remarks:?}"
    );
    // By the counter: 0.1 A in the gap, and nothing is open.
    let after = 0.9 - (0.503 * 599.0 + 0.1 * 3001.0) / 3600.0;
    assert_eq!(base.gap_soc_sigma, [0.0, 0.0]);
    assert!(
        (base.initial_soc[1] - after).abs() < 1e-3,
        "{:?}",
        base.initial_soc
    );
    // Without a counter the reading after it tells: the current stays as it is on both sides, but the voltages say that it was another.
    let (problem, remarks) = one(BATTERY, &discharge(false));
    let Base::Battery(base) = &problem.base else {
        panic!("{problem:?}");
    };
    assert_eq!(base.gap_soc_sigma[0], 0.0);
    assert!(base.gap_soc_sigma[1] > 0.05, "{:?}", base.gap_soc_sigma);
    assert!(
        (base.initial_soc[1] - after).abs() < 2e-3,
        "{:?}",
        base.initial_soc
    );
    assert!(
        remarks
            .iter()
            .any(|remark| remark.contains("straight line")),
        "{remarks:?}"
    );
}

/// A cell of `BATTERY` from 90 % on, through currents in A for so many seconds each: time, current and voltage of each second.
fn cell(steps: &[(usize, f64)]) -> Vec<Vec<f64>> {
    let each = steps.iter();
    let currents: Vec<f64> = each
        .flat_map(|(length_s, current_a)| vec![*current_a; *length_s])
        .collect();
    let mut soc = 0.9;
    let mut before_a = currents[0];
    let rows = currents.iter().enumerate();
    rows.map(|(k, current_a)| {
        if k > 0 {
            soc -= 0.5 * (before_a + current_a) / 3600.0;
        }
        before_a = *current_a;
        vec![k as f64, *current_a, 3.0 + soc - 0.01 * current_a]
    })
    .collect()
}

#[test]
fn what_goes_by_the_resistance_needs_one() {
    let recording = text(
        "t_s,i_ref_a,v_cell_v",
        cell(&[(300, 0.5), (300, 1.0)]).into_iter(),
    );
    let lacks = |model: &str| {
        let (_, remarks) = one(model, &recording);
        let says = |remark: &String| remark.contains("no ohmic_resistance_ohm: resistance");
        remarks.iter().any(says)
    };
    assert!(!lacks(BATTERY));
    assert!(lacks(&BATTERY.replace("ohmic_resistance_ohm = 0.01\n", "")));
}

fn battery_of(problem: &Problem) -> &BatteryBase {
    match &problem.base {
        Base::Battery(base) => base,
        Base::Sensor(_) => panic!("{problem:?}"),
    }
}

#[test]
fn what_flowed_before_the_first_reading_is_not_lost() {
    let is_read = |row: &[f64]| row[0] >= 700.0;
    let rows = cell(&[(600, 1.0), (1200, 0.5)]);
    // On the current's rows, on rows of their own, and beside a current that reads 0.1 A too much.
    let shared = rows.iter().map(|row| {
        let volts = if is_read(row) { row[2] } else { f64::NAN };
        vec![row[0], row[1], volts]
    });
    let own = rows.iter().flat_map(|row| {
        let current = vec![row[0], row[1], f64::NAN];
        let volts = is_read(row).then(|| vec![row[0] + 0.25, f64::NAN, row[2]]);
        std::iter::once(current).chain(volts)
    });
    let off = shared.clone().map(|row| vec![row[0], row[1] + 0.1, row[2]]);
    let header = "t_s,i_ref_a,v_cell_v";
    let zero = format!("{BATTERY}current_zero_a = 0.1\n");
    for (model, recording) in [
        (BATTERY, text(header, shared.clone())),
        (BATTERY, text(header, own)),
        (&zero, text(header, off)),
    ] {
        let (problem, remarks) = one(model, &recording);
        let base = battery_of(&problem);
        assert!(
            (base.initial_soc[0] - 0.9).abs() < 1e-6,
            "{:?} {remarks:?}",
            base.initial_soc
        );
    }
}

#[test]
fn what_flowed_after_the_last_reading_is_no_contradiction() {
    // 1 A throughout, no row for 100 s, and voltages until ten minutes before that.
    let rows = cell(&[(1900, 1.0)]).into_iter();
    let rows = rows
        .filter(|row| !(1200.0..1300.0).contains(&row[0]))
        .map(|row| {
            let is_read = row[0] < 600.0 || row[0] >= 1300.0;
            vec![row[0], row[1], if is_read { row[2] } else { f64::NAN }]
        });
    let (problem, _) = one(BATTERY, &text("t_s,i_ref_a,v_cell_v", rows));
    let base = battery_of(&problem);
    assert_eq!(base.gap_soc_sigma, [0.0, 0.0]);
    assert!((base.initial_soc[1] - (0.9 - 1300.0 / 3600.0)).abs() < 1e-6);
}

#[test]
fn a_zero_that_follows_the_supply_needs_the_full_scale() {
    let rows = (0..200).map(|k| {
        let t = f64::from(k);
        let v = 5.0 + 0.1 * (0.05 * t).sin();
        vec![t, steps(t), steps(t) + 0.1 * (0.4 * t).sin(), v]
    });
    let recording = text("t_s,i_ref_a,i_meas_a,v_supply_v", rows);
    let effect = twin::effects::find("supply-ratiometric").unwrap();
    let says = |model: &str| {
        let (problem, remarks) = one(&format!("schema = 1\n[sensor]\n{model}"), &recording);
        let remark = remarks
            .into_iter()
            .find(|remark| remark.contains("no full_scale"));
        (effect.applies(&problem), remark)
    };
    assert_eq!(says("full_scale = 100\n"), (true, None));
    let (applies, remark) = says("");
    assert!(!applies && remark.unwrap().contains("is not looked for"));
    let (_, remark) = says("[effects.supply-ratiometric]\nratio = 0.5\n");
    assert!(remark.unwrap().contains("sensitivity only"));
}

#[test]
fn a_pack_is_its_cells_in_series() {
    let rows = (0..100).map(|k| {
        let i = current(f64::from(k));
        vec![f64::from(k), i, 4.0 * (3.9 - 0.01 * i)]
    });
    let model = format!("{BATTERY}cells = 4\ninitial_soc = 0.9\n");
    let (problem, _) = one(&model, &text("t_s,i_ref_a,v_pack_v", rows));
    let Base::Battery(base) = &problem.base else {
        panic!("{problem:?}");
    };
    assert_eq!(base.ocv, [(0.0, 12.0), (1.0, 16.0)]);
    assert!((base.resistance_ohm - 0.04).abs() < 1e-12);
    assert_eq!(base.initial_soc, [0.9]);
}

/// A load of steps at times that follow no rule.
fn steps(t_s: f64) -> f64 {
    let at = [
        0.0, 7.1, 9.8, 17.3, 21.9, 30.2, 31.7, 44.0, 52.6, 61.1, 64.9, 78.3, 85.5, 97.0, 108.4,
        118.9,
    ];
    let before = at.iter().filter(|step| **step <= t_s).count();
    [2.0, 9.0, -3.0, 14.0, 5.0][before % 5] + 0.3 * (2.3 * t_s).sin()
}

#[test]
fn two_clocks_are_compared() {
    for (offset_s, fast_ppm, tau_s) in [
        (3.217, 0.0, 0.0),
        (-1.13, 300.0, 0.0),
        (0.45, -200.0, 0.4),
        (12.0, 100.0, 0.2),
    ] {
        // The reference at 100 Hz, the sensor at 20 Hz through a low-pass.
        let reference: Vec<(f64, f64)> = (0..12_000)
            .map(|k| f64::from(k) * 0.01)
            .map(|t| (t, steps(t)))
            .collect();
        let mut slow = steps(0.0);
        let mut sensed = Vec::new();
        for (row, (t, value)) in reference.iter().enumerate() {
            if tau_s > 0.0 {
                slow += (value - slow) * (1.0 - f64::exp(-0.01 / tau_s));
            } else {
                slow = *value;
            }
            if row % 5 == 0 && *t > 5.0 && *t < 105.0 {
                sensed.push((
                    (t - 5.0) * (1.0 + fast_ppm * 1e-6) + 5.0 - offset_s,
                    1.02 * slow + 0.1,
                ));
            }
        }
        let split = |rows: &[(f64, f64)]| -> (Vec<f64>, Vec<f64>) { rows.iter().copied().unzip() };
        let (t_ref, x) = split(&reference);
        let (t_sensor, y) = split(&sensed);
        let driven = Signal::new(&t_ref, &x, |_| true);
        let found = estimate(&driven, &Signal::new(&t_sensor, &y, |_| true)).unwrap();
        // Within a fifth of the sensor's step; with a lag within a fifth of that.
        let bound = 0.01_f64.max(0.2 * tau_s);
        for at in [0, t_sensor.len() / 2, t_sensor.len() - 1] {
            let truth = 5.0 + (t_sensor[at] + offset_s - 5.0) / (1.0 + fast_ppm * 1e-6);
            let error = found.on_reference(t_sensor[at]) - truth;
            assert!(
                error.abs() < bound,
                "{offset_s} {fast_ppm} {tau_s}: off by {error} s, {found:?}"
            );
        }
        assert!(
            (found.fast_ppm - fast_ppm).abs() < 60.0,
            "{fast_ppm}: {found:?}"
        );
    }
}

#[test]
fn a_reference_of_its_own_becomes_the_drive() {
    let folder = tempfile::tempdir().unwrap();
    let reference = (0..6000).map(|k| {
        let t = f64::from(k) * 0.02;
        vec![t, steps(t), 20.0 + t]
    });
    let reference = text("t_s,i_ref_a,temp_sensor_c", reference);
    let sensor = (0..900).map(|k| {
        let t = f64::from(k) * 0.1;
        // 100 s later on a clock of its own.
        vec![t + 100.0, steps(t + 10.0) + 0.2, 5.0 + 0.001 * t]
    });
    fs::write(folder.path().join("ref.csv"), reference).unwrap();
    fs::write(
        folder.path().join("r.csv"),
        text("t_s,i_meas_a,v_supply_v", sensor),
    )
    .unwrap();
    let model = Model::parse("m.toml", PAIR.to_owned(), folder.path()).unwrap();
    let inputs = Inputs {
        recording: folder.path().join("r.csv"),
        reference: Some(folder.path().join("ref.csv")),
        mapping: Vec::new(),
    };
    let prepared = prepare(&model, &inputs, Purpose::Compare).unwrap();
    let problem = &prepared.items[0].problem;
    assert_eq!(problem.drive.len(), 6000);
    assert!(!problem.observed.on_drive_rows());
    assert!(
        (problem.observed.t_s[0] - 10.0).abs() < 0.03,
        "{}",
        problem.observed.t_s[0]
    );
    assert_eq!(
        problem.drive.sensor_temperature_c.as_ref().unwrap()[50],
        21.0
    );
    assert!(problem.drive.supply_v.is_some());
    assert!(
        prepared
            .remarks
            .iter()
            .any(|remark| remark.contains("clocks")),
        "{:?}",
        prepared.remarks
    );
}

#[test]
fn a_reference_that_is_missing_masks_its_reading() {
    let gap = |k: usize| (100..109).contains(&k) || k % 97 == 50;
    let rows = (0..600).map(|k| {
        let t = k as f64 * 0.1;
        let reference = if gap(k) { f64::NAN } else { current(t) };
        vec![t, reference, 1.02 * current(t)]
    });
    let (problem, _) = one(PAIR, &text("t_s,i_ref_a,i_meas_a", rows));
    let left_out = (0..600).filter(|k| gap(*k)).count();
    assert_eq!(problem.observed.valid_rows(), 600 - left_out);
    assert!(problem.observed.on_drive_rows());
}

#[test]
fn a_code_for_not_available_is_no_reading() {
    let recording = |column: usize, code: f64, is_code: &dyn Fn(i32) -> bool| {
        let rows = (0..400).map(|k| {
            let t = f64::from(k) * 0.1;
            let mut row = vec![t, current(t), current(t) + 0.5, 20.0 + 0.1 * t];
            if is_code(k) {
                row[column] = code;
            }
            row
        });
        text("t_s,i_ref_a,i_meas_a,temp_sensor_c", rows)
    };
    let now_and_then = |k: i32| k % 20 == 7;
    let stretch = |k: i32| (100..160).contains(&k);
    for code in [
        3276.7, -3276.8, 6553.5, 65_535.0, 32_767.0, -32_768.0, -999.0, 9999.0, 65.535,
    ] {
        let (problem, remarks) = one(PAIR, &recording(2, code, &now_and_then));
        assert_eq!(problem.observed.valid_rows(), 380, "{code}");
        let [remark] = remarks.as_slice() else {
            panic!("{code}: {remarks:?}");
        };
        assert!(
            remark.starts_with(&format!("i_meas_a is {code} in 20 of 400 rows of "))
                && remark.contains("r.csv, the first at 0.7")
                && remark.contains("\"not available\" and is taken as missing there"),
            "{remark}"
        );
        let (problem, remarks) = one(PAIR, &recording(2, code, &stretch));
        assert_eq!(problem.observed.valid_rows(), 340, "{code}");
        assert_eq!(remarks.len(), 1, "{remarks:?}");
        // Nothing is simulated from it, and surroundings hold what they were.
        let (problem, remarks) = one(PAIR, &recording(1, code, &now_and_then));
        assert_eq!(problem.drive.len(), 380, "{code}: {remarks:?}");
        assert_eq!(remarks.len(), 1, "{remarks:?}");
        let (problem, remarks) = one(PAIR, &recording(3, code, &now_and_then));
        let held = problem.drive.sensor_temperature_c.as_ref().unwrap();
        assert!(held.iter().all(|c| (20.0..25.0).contains(c)), "{code}");
        assert_eq!(remarks.len(), 1, "{remarks:?}");
    }
    // Ends of shorter numbers, of a reading beside its reference or the other way round, …
    for code in [819.1, 409.5, -204.8, 102.3] {
        for column in [1, 2] {
            let (problem, remarks) = one(PAIR, &recording(column, code, &now_and_then));
            assert_eq!(problem.observed.valid_rows(), 380, "{code}");
            assert!(
                remarks
                    .join("; ")
                    .contains(&format!("is {code} in 20 of 400 rows"))
            );
        }
    }
    // … and of temperatures, that jump there and back; a chamber goes there and stays.
    let a_while = |k: i32| (100..130).contains(&k);
    let for_good = |k: i32| k >= 300;
    let odd = |k: i32| k % 2 == 1;
    for code in [-40.0, 215.0, 819.1] {
        for rows in [&now_and_then as &dyn Fn(i32) -> bool, &a_while] {
            let (problem, remarks) = one(PAIR, &recording(3, code, rows));
            let held = problem.drive.sensor_temperature_c.as_ref().unwrap();
            assert!(held.iter().all(|c| (20.0..25.0).contains(c)), "{code}");
            let said = remarks.join("; ");
            assert!(
                said.contains(&format!("temp_sensor_c is {code} in ")),
                "{said}"
            );
        }
    }
    for (code, rows) in [
        (-40.0, &for_good as &dyn Fn(i32) -> bool),
        (-40.0, &odd),
        (-39.9, &a_while),
        (20.47, &a_while),
    ] {
        let (_, remarks) = one(PAIR, &recording(3, code, rows));
        assert!(
            !remarks.join("; ").contains("not available"),
            "{code}: {remarks:?}"
        );
    }
    // Once is a slip, any other value an end of the range, and so is a code's next to the readings.
    let (problem, remarks) = one(PAIR, &recording(2, 3276.7, &|k| k == 77));
    assert_eq!(problem.observed.valid_rows(), 399);
    assert!(
        remarks.join("; ").contains("slips of the log, left out"),
        "{remarks:?}"
    );
    for end in [3000.0, 327.0] {
        let (problem, remarks) = one(PAIR, &recording(2, end, &now_and_then));
        assert_eq!(problem.observed.valid_rows(), 400);
        assert!(
            remarks.join("; ").contains("it may be clipped"),
            "{remarks:?}"
        );
    }
    // Pulses that a counter of 16 bits cannot show.
    let rows = (0..400).map(|k| {
        let t = f64::from(k) * 0.1;
        let on = if k % 40 < 10 { 40.0 } else { 0.0 };
        let true_a = on + 0.1 * current(t);
        vec![t, true_a, true_a.min(32.767)]
    });
    let (problem, remarks) = one(PAIR, &text("t_s,i_ref_a,i_meas_a", rows));
    assert_eq!(problem.observed.valid_rows(), 400);
    assert!(
        remarks.join("; ").contains("it may be clipped"),
        "{remarks:?}"
    );
}

/// Remarks on a reference that is a staircase, of the current `reference` that is read every 0.1 s beside `sensor`.
fn stairs(reference: Course<'_>, sensor: Course<'_>) -> Vec<String> {
    let rows = (0..2000).map(|k| {
        let noise = 0.05 * ((12.9898 * f64::from(k)).sin() * 43_758.547).fract();
        vec![f64::from(k) * 0.1, reference(k), sensor(k) + noise]
    });
    let (_, remarks) = one(PAIR, &text("t_s,i_ref_a,i_meas_a", rows));
    let about = |remark: &String| remark.contains("more seldom than it was written");
    remarks.into_iter().filter(about).collect()
}

/// What is made of rows each 0.1 s, from a time on, with these stamps.
fn stamped(begin_s: f64, stamp: impl Fn(f64) -> f64) -> (Vec<f64>, Vec<String>) {
    let rows = (0..1000).map(|k| {
        let t_s = begin_s + 0.1 * f64::from(k);
        vec![stamp(t_s), current(t_s), current(t_s) + 0.5]
    });
    let (problem, remarks) = one(PAIR, &text("t_s,i_ref_a,i_meas_a", rows));
    (problem.observed.t_s.to_vec(), remarks)
}

#[test]
fn rows_of_one_time_stamp_are_spread_until_the_next() {
    // Whole seconds, from anywhere within one; days since 1970 in one case, in which a double keeps 0.2 us.
    for begin_s in [0.0, 0.35, 7.95, 1.7e9 + 0.35] {
        let (t_s, remarks) = stamped(begin_s, f64::floor);
        let [remark] = remarks.as_slice() else {
            panic!("{remarks:?}");
        };
        assert!(
            remark.contains("mostly 10 rows say the same one, 1 s apart"),
            "{remark}"
        );
        // A row is within its tenth of a second: the second says no more.
        for (k, t_s) in t_s.iter().enumerate() {
            let off_s = t_s - (begin_s + 0.1 * k as f64);
            assert!((-0.1..=1e-6).contains(&off_s), "row {k}: {off_s} s");
        }
    }
    // Eleven and twelve rows by turns are a rate of its own, too.
    let (t_s, remarks) = stamped(0.0, |t| (t / 1.15).floor() * 1.15);
    assert_eq!(remarks.len(), 1, "{remarks:?}");
    assert!(
        t_s.windows(2)
            .all(|pair| (0.09..0.11).contains(&(pair[1] - pair[0])))
    );
}

#[test]
fn a_time_that_comes_twice_now_and_then_stays() {
    let (t_s, remarks) = stamped(0.0, |t| {
        let row = (10.0 * t).round();
        0.1 * (row - f64::from(row % 7.0 == 3.0))
    });
    assert!(remarks.is_empty(), "{remarks:?}");
    assert_eq!(
        t_s.windows(2).filter(|pair| pair[0] == pair[1]).count(),
        143
    );
    // Rows that were written twice.
    let rows = (0..1000).map(|k| {
        let t_s = 0.1 * f64::from(k / 2);
        vec![t_s, current(t_s), current(t_s)]
    });
    let (problem, remarks) = one(PAIR, &text("t_s,i_ref_a,i_meas_a", rows));
    let spread = |remark: &String| remark.contains("spread evenly");
    assert!(!remarks.iter().any(spread), "{remarks:?}");
    assert!(
        problem
            .drive
            .t_s
            .iter()
            .all(|t| (10.0 * t).fract().abs() < 1e-6 || (10.0 * t).fract() > 1.0 - 1e-6)
    );
    // Two series that were joined by time: one moment, two rows.
    let rows = (0..1000).map(|k| {
        let t_s = 0.1 * f64::from(k / 2);
        let (reference, measured) = if k % 2 == 0 {
            (current(t_s), f64::NAN)
        } else {
            (f64::NAN, current(t_s))
        };
        vec![t_s, reference, measured]
    });
    let (_, remarks) = one(PAIR, &text("t_s,i_ref_a,i_meas_a", rows));
    assert!(!remarks.iter().any(spread), "{remarks:?}");
}

/// A value for each row.
type Course<'a> = &'a dyn Fn(i32) -> f64;

/// A current that is set anew every ten rows.
fn set(k: i32) -> f64 {
    100.0 * ((78.233 * f64::from(k.div_euclid(10))).sin() * 43_758.547).fract()
}

#[test]
fn a_reference_that_is_repeated_is_a_staircase() {
    let at = |k: i32| current(0.1 * f64::from(k));
    for rows in [3, 5, 10, 20] {
        let stands = move |k: i32| at(k - k % rows);
        let said = stairs(&stands, &at);
        let [remark] = said.as_slice() else {
            panic!("{rows}: {said:?}");
        };
        let start = format!("i_ref_a stays as it is for {rows} rows (");
        assert!(remark.starts_with(&start), "{remark}");
        assert!(remark.contains("--reference"), "{remark}");
        // With a gain, behind a lag of a few rows, in steps of its own, after a standstill.
        assert_eq!(stairs(&stands, &|k| 1.3 * at(k - 1) + 2.0).len(), 1);
        assert_eq!(stairs(&|k| (10.0 * stands(k)).round() / 10.0, &at).len(), 1);
        let rests = |k: i32| if k < 500 { 0.0 } else { at(k) };
        assert_eq!(stairs(&|k| rests(k - k % rows), &rests).len(), 1);
        // What is asked for: the repeats left out.
        let once = |k: i32| if k % rows == 0 { at(k) } else { f64::NAN };
        assert_eq!(stairs(&once, &at), [""; 0]);
    }
}

#[test]
fn a_current_in_steps_is_no_staircase() {
    let at = |k: i32| current(0.1 * f64::from(k));
    let lagging = |k: i32| {
        (0..60)
            .map(|back| set(k - back) * 0.8_f64.powi(back))
            .sum::<f64>()
            * 0.2
    };
    let pulses = |k: i32| if k.rem_euclid(40) < 10 { 20.0 } else { 0.0 };
    let cases: [(Course<'_>, Course<'_>); 9] = [
        (&at, &at),
        // Set in steps: a sensor at once, later, before (its clock), behind a lag, in a window.
        (&set, &set),
        (&set, &|k| set(k - 4)),
        (&set, &|k| set(k + 3)),
        (&set, &lagging),
        (&set, &|k| {
            (0..7).map(|back| set(k - back)).sum::<f64>() / 7.0
        }),
        (&pulses, &|k| pulses(k - 2)),
        // Slow currents in whole counts.
        (&|k| (0.1 * f64::from(k)).floor(), &|k| 0.1 * f64::from(k)),
        (&|k| at(k / 40).round(), &|k| at(k / 40)),
    ];
    for (case, (reference, sensor)) in cases.into_iter().enumerate() {
        assert_eq!(stairs(reference, sensor), [""; 0], "{case}");
    }
}

#[test]
fn a_cell_that_is_emptied_twice_is_said() {
    // 1 A and what swings about it for 200 s: 0.055 Ah.
    let recording = |sign: f64| {
        let rows = (0..2000).map(move |k| {
            let t = f64::from(k) * 0.1;
            let i = sign * current(t);
            vec![t, i, 3.6 - 0.01 * i - 0.0005 * sign * t]
        });
        text("t_s,i_ref_a,v_cell_v", rows)
    };
    let model = |capacity_ah: f64, soc: f64, more: &str| {
        format!(
            "schema = 1\n[battery]\ncapacity_ah = {capacity_ah}\ninitial_soc = {soc}\nohmic_resistance_ohm = 0.01\n\
             ocv = [[0, 3.0], [1, 4.0]]\n{more}"
        )
    };
    let said = |model: &str, sign: f64| {
        let (_, remarks) = one(model, &recording(sign));
        remarks
            .into_iter()
            .find(|remark| remark.contains("state of charge"))
    };
    let empty = said(&model(0.05, 0.9, ""), 1.0).unwrap();
    let full = said(&model(0.05, 0.1, ""), -1.0).unwrap();
    for (remark, end) in [(&empty, "empty"), (&full, "full")] {
        assert!(remark.contains("behind v_cell_v runs to "), "{remark}");
        assert!(
            remark.contains(&format!("is beyond {end} from ")),
            "{remark}"
        );
        assert!(remark.contains("capacity_ah or initial_soc"), "{remark}");
        assert!(remark.contains("straight line"), "{remark}");
    }
    // Within what is known of a capacity, and with what was found on another day.
    assert_eq!(said(&model(0.2, 0.9, ""), 1.0), None);
    let found = "[effects.capacity]\ncapacity_ah = 0.2\n";
    assert_eq!(said(&model(0.05, 0.9, found), 1.0), None);
}

#[test]
fn holding_is_told_where_the_design_says_nothing_of_it() {
    let held = |model: &str| {
        let rows = (0..600_i32).map(|k| {
            let t = f64::from(k) * 0.1;
            vec![t, current(t), current(f64::from(k / 10))]
        });
        one(model, &text("t_s,i_ref_a,i_meas_a", rows))
            .0
            .observed
            .held_s
    };
    assert!((held(PAIR) - 1.0).abs() < 1e-9);
    assert_eq!(held(&format!("{PAIR}interval_s = 1.0\n")), 0.0);
}

/// A log of a column of times that went through single precision: of each 100 ms that count from `since_s`.
fn single_precision(since_s: f64) -> String {
    let rows = (0..3000).map(|k| {
        let t_s = f64::from(k) * 0.1;
        let told_s = f64::from((t_s + since_s) as f32);
        vec![told_s, current(t_s), current(t_s) + 0.5]
    });
    text("t_s,i_ref_a,i_meas_a", rows)
}

#[test]
fn times_of_single_precision_are_told() {
    let said = |since_s: f64| {
        let (_, remarks) = one(PAIR, &single_precision(since_s));
        let mut said = remarks.into_iter();
        said.find(|remark| remark.contains("single precision"))
    };
    let since_1970 = said(1.7e9).unwrap();
    assert!(since_1970.contains("128 s apart"), "{since_1970}");
    assert!(since_1970.contains("2,997 of 3,000 rows"), "{since_1970}");
    // Two days: steps of 1/64 s.
    assert!(said(172_800.0).unwrap().contains("0.01562 s apart"));
    // What moves no row by as much as matters.
    assert_eq!(said(0.0), None);
    // Double precision, from the same origin; whole seconds, even; and rows that come when they like.
    for of_row in [
        |k: u32| 1.7e9 + 0.1 * f64::from(k),
        |k: u32| 1_699_999_232.0 + 128.0 * f64::from(k),
        |k: u32| f64::from(2 * k + k % 3),
    ] {
        let rows = (0..300).map(|k| {
            let t_s = f64::from(k) * 0.1;
            vec![of_row(k), current(t_s), current(t_s) + 0.5]
        });
        let (_, remarks) = one(PAIR, &text("t_s,i_ref_a,i_meas_a", rows));
        let told = remarks.iter().any(|remark| remark.contains("precision"));
        assert!(!told, "{remarks:?}");
    }
    // A log that ends before the first step.
    let rows = (0..300).map(|k| {
        let t_s = f64::from(k) * 0.1;
        vec![1.7e9, current(t_s), current(t_s) + 0.5]
    });
    let folder = tempfile::tempdir().unwrap();
    let refused = read(
        folder.path(),
        PAIR,
        &text("t_s,i_ref_a,i_meas_a", rows),
        &[],
    );
    let refused = refused.unwrap_err().0;
    assert!(
        refused.contains("numbers of single precision, 24 bits, are 128 s apart there"),
        "{refused}"
    );
}

#[test]
fn a_reference_that_hardly_moves_shows_no_dead_sensor() {
    let log = |amplitude: f64| {
        let rows = (0..2000).map(|k| {
            let t_s = f64::from(k);
            // Two courses that have nothing in common, one of them of 0.1 A.
            let [reference, reading] = [amplitude * (37.7 * t_s).sin(), 0.1 * (1.91 * t_s).sin()];
            vec![t_s, reference, 0.25 + reading]
        });
        one(PAIR, &text("t_s,i_ref_a,i_meas_a", rows)).1.join("\n")
    };
    let parked = log(0.01);
    assert!(parked.contains("may tell a zero"), "{parked}");
    assert!(!parked.contains("dead"), "{parked}");
    assert!(log(10.0).contains("may be dead"));
}

/// Remarks on a pack's log of 10 minutes at rest and then under load, at 3.7 V a cell of `cells`.
fn pack(cells: f64, battery: &str) -> Vec<String> {
    let rows = (0..1200).map(|k| {
        let t_s = f64::from(k) * 0.5;
        let current_a = if k < 60 { 0.0 } else { 2.0 + current(t_s) };
        vec![t_s, current_a, cells * (3.7 - 0.02 * current_a)]
    });
    let model =
        format!("schema = 1\n[battery]\nocv = [[0, 3.2], [1, 4.2]]\ninitial_soc = 0.5\n{battery}");
    one(&model, &text("t_s,i_ref_a,v_pack_v", rows)).1
}

#[test]
fn a_pack_of_another_number_of_cells_is_told() {
    let stated = |cells: u32, sigma: f64| {
        format!(
            "capacity_ah = 50\nohmic_resistance_ohm = 0.02\nnoise_v = 0.05\ncells = {cells}\ninitial_soc_uncertainty = {sigma}\n"
        )
    };
    let said = |cells: f64, stated: &str| {
        let mut remarks = pack(cells, stated).into_iter();
        remarks.find(|remark| remark.contains("cells would"))
    };
    let more = said(96.0, &stated(95, 0.01)).unwrap();
    assert!(
        more.contains("begins at 355.2 V, where 95 cells in series")
            && more.contains("as 96 cells would"),
        "{more}"
    );
    assert!(
        said(96.0, &stated(97, 0.01))
            .unwrap()
            .contains("as 96 cells would")
    );
    // As stated; off by no whole cell, or by two; and where the start may be off by as much.
    for (cells, stated) in [
        (96.0, stated(96, 0.01)),
        (95.5, stated(95, 0.01)),
        (97.0, stated(95, 0.01)),
        (96.0, stated(95, 0.05)),
    ] {
        assert_eq!(said(cells, &stated), None, "{cells} {stated}");
    }
}

#[test]
fn a_capacity_and_a_resistance_that_no_cell_has_together_are_told() {
    let said = |capacity_ah: f64, ohm: f64| {
        let battery = format!(
            "capacity_ah = {capacity_ah}\nohmic_resistance_ohm = {ohm}\ncells = 96\nnoise_v = 0.05\n"
        );
        pack(96.0, &battery)
            .into_iter()
            .find(|remark| remark.contains("in thousandths"))
    };
    let in_mah = said(2810.0, 0.02).unwrap();
    assert!(
        in_mah.contains("capacity_ah = 2810 and") && in_mah.contains("would take 56.2 V"),
        "{in_mah}"
    );
    // An 18650, a truck's battery, and a cell of 300 Ah.
    for (capacity_ah, ohm) in [(2.81, 0.0225), (60.0, 0.005), (300.0, 0.0005)] {
        assert_eq!(said(capacity_ah, ohm), None);
    }
}

#[test]
fn clocks_of_different_origins_are_told_by_one_moment_of_both() {
    let said = |offset_s: f64| {
        let alignment = Alignment {
            offset_s,
            fast_ppm: 79.2,
            start_s: 1_239.567_2,
            correlation: 0.996_7,
        };
        alignment.remark()
    };
    let near = said(3.2);
    assert!(
        near.contains("the sensor's time is -3.200000 s from the reference's at its first reading and runs fast by 79.2 ppm"),
        "{near}"
    );
    let since_1970 = said(1_699_998_765.434_863);
    assert!(
        since_1970.contains("first reading, at 1239.567 s of its own clock, was at 1700000005.002 s of the reference's"),
        "{since_1970}"
    );
}
