//! The model file: what it may hold, what is said of faults, and how effects are added.

use std::{fs, path::Path};

use twin::{
    effects::chain::Nuisance,
    failure::Failure,
    model::{Found, FrontEndKind, Model, Shift},
};

const PAIR: &str = "\
# The user's own words.
schema = 1   # a version

[sensor]
step = 0.1     # of the display
noise = 0.02

[effects.offset]
offset_a = 0.25 # from last week
";

fn parse(text: &str) -> Result<Model, Failure> {
    Model::parse("m.toml", text.to_owned(), Path::new("."))
}

#[test]
fn reads_what_the_documentation_shows() {
    // Each block of TOML in the documentation that is a whole model file.
    let documentation = include_str!("../../docs/model-file.md");
    let blocks: Vec<&str> = documentation
        .split("```toml\n")
        .skip(1)
        .filter_map(|rest| rest.split("```").next())
        .filter(|block| block.contains("schema = 1"))
        .collect();
    assert!(blocks.len() >= 2);
    for block in blocks {
        let model = parse(block).unwrap_or_else(|fault| panic!("{fault}\n{block}"));
        assert!(model.sensor.is_some() || model.battery.is_some());
    }
}

#[test]
fn the_documentation_names_every_key() {
    let documentation = include_str!("../../docs/model-file.md");
    let unknown = [
        "[sensor]\nx = 1",
        "[charge]\nx = 1",
        "[battery]\nx = 1",
        "x = 1",
    ];
    for text in unknown {
        let Err(Failure(sentence)) = parse(&format!("schema = 1\n{text}\n")) else {
            panic!("{text}");
        };
        let keys: Vec<&str> = sentence
            .split("expected one of ")
            .nth(1)
            .unwrap()
            .split('`')
            .skip(1)
            .step_by(2)
            .collect();
        assert!(keys.len() >= 4, "{sentence}");
        for key in keys {
            assert!(documentation.contains(key), "{key}");
        }
    }
}

#[test]
fn the_models_of_this_project_are_read() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models");
    let mut read = 0;
    for file in fs::read_dir(folder).unwrap() {
        let path = file.unwrap().path();
        if path.extension().is_some_and(|ending| ending == "toml") {
            Model::read(&path).unwrap_or_else(|fault| panic!("{fault}"));
            read += 1;
        }
    }
    assert!(read >= 4);
}

#[test]
fn faults_name_line_key_and_what_was_expected() {
    let cases: [(&str, &[&str]); 46] = [
        (
            "schema = 1\n[sensor]\nstepp = 1\n",
            &["line 3", "stepp", "`step`", "`noise_coloured`"],
        ),
        (
            "schema = 2\n[sensor]\n",
            &["line 1", "schema", "found 2", "expected 1"],
        ),
        ("[sensor]\n", &["schema"]),
        (
            "schema = 1\n[sensor]\nstep = \"x\"\n",
            &["line 3", "key step", "string", "expected a number"],
        ),
        (
            "schema = 1\n[sensor]\nnoise = -1\n",
            &["line 3", "sensor.noise", "-1", "zero or more"],
        ),
        (
            "schema = 1\n[sensor]\nnoise = 0.1\nnoise_coloured = 0.5\n",
            &[
                "line 4",
                "sensor.noise_coloured",
                "0.5",
                "noise_coloured_tau_s",
            ],
        ),
        (
            "schema = 1\n[battery]\ncapacity_ah = 2\nnoise_coloured_v = 0.001\n",
            &["line 4", "battery.noise_coloured_v", "noise_coloured_tau_s"],
        ),
        (
            "schema = 1\n[sensor]\nfront_end = \"hall\"\n",
            &["line 3", "hall", "`dual-range`"],
        ),
        ("schema = 1\n", &["neither [sensor] nor [battery]"]),
        (
            "schema = 1\n[sensor]\nfront_end = \"hah1bv\"\nstep = 1\n",
            &["line 4", "sensor.step", "its converter"],
        ),
        (
            "schema = 1\n[sensor]\naverage = 8\n",
            &["line 3", "average", "window_s"],
        ),
        (
            "schema = 1\n[battery]\ncapacity_ah = 0\n",
            &["line 3", "battery.capacity_ah", "above 0"],
        ),
        (
            "schema = 1\n[battery]\ncapacity_ah = 2\nresistances_at_c = [30, 20]\n",
            &[
                "line 4",
                "battery.resistances_at_c",
                "[30, 20]",
                "lowest and the highest",
            ],
        ),
        (
            "schema = 1\n[battery]\ncapacity_ah = 2\nresistances_at_c = [-300, 20]\n",
            &["line 4", "battery.resistances_at_c", "[-300, 20]", "°C"],
        ),
        (
            "schema = 1\n[battery]\ncapacity_ah = 2\ncurrent_zero_uncertainty_a = -0.01\n",
            &[
                "line 4",
                "battery.current_zero_uncertainty_a",
                "-0.01",
                "zero or more",
            ],
        ),
        (
            "schema = 1\n[battery]\ncapacity_ah = 2\ncurrent_zero_a = nan\n",
            &["line 4", "battery.current_zero_a", "without a current"],
        ),
        (
            "schema = 1\n[battery]\ncapacity_ah = 2\ninitial_soc = 95\n",
            &["line 4", "initial_soc", "0 to 1"],
        ),
        (
            "schema = 1\n[battery]\ncapacity_ah = 2\nocv = [[0.5, 3.6], [0.4, 3.5]]\n",
            &[
                "line 4",
                "battery.ocv",
                "(0.4, 3.5) as point 2",
                "ascending",
            ],
        ),
        (
            "schema = 1\n[sensor]\n[effects.ofset]\noffset_a = 1\n",
            &["line 3", "ofset", "offset, gain"],
        ),
        (
            "schema = 1\n[sensor]\n[effects.offset]\noffset = 1\n",
            &["line 4", "effects.offset.offset", "offset_a"],
        ),
        (
            "schema = 1\n[sensor]\n[effects.clipping]\nhigh_a = 1\n",
            &[
                "line 3",
                "effects.clipping",
                "not all parameters",
                "high_a, low_a",
            ],
        ),
        ("schema = 1\n[sensor\n", &["line 2"]),
        (
            "schema = 1\n[sensor]\naccuracy = 0.3\n",
            &["line 3", "key accuracy", "a table { zero = …, gain = … }"],
        ),
        (
            "schema = 1\n[sensor]\naccuracy = { zero = nan }\n",
            &[
                "line 3",
                "key sensor.accuracy.zero",
                "a number, zero or more",
            ],
        ),
        (
            "schema = 1\n[battery]\ncapacity_ah = 2\naccuracy_v = { gain = -0.01 }\n",
            &[
                "line 4",
                "key battery.accuracy_v.gain",
                "a number, zero or more",
            ],
        ),
        (
            "schema = 1\n[battery]\ncapacity_ah = 2\naccuracy_pct = { zero = nan }\n",
            &[
                "line 4",
                "key battery.accuracy_pct.zero",
                "a number, zero or more",
            ],
        ),
        (
            "schema = 1\n[sensor]\naverage = 1.5\n",
            &["line 3", "key average", "a whole number"],
        ),
        (
            "schema = 1\n[sensor]\nreference = 3\n",
            &["line 3", "key reference", "text in quotes"],
        ),
        (
            "schema = 1\n[battery]\ncapacity_ah = 2\nocv = 3.6\n",
            &["line 4", "key ocv", "a list in brackets"],
        ),
        (
            "schema = 1\n[sensor]\n[effects.lag]\ntau_s = -5\n",
            &["line 4", "effects.lag.tau_s", "found -5", "zero or more"],
        ),
        (
            "schema = 1\n[sensor]\n[effects.moving-average]\nwindow_s = -0.5\n",
            &["moving-average.window_s", "-0.5", "zero or more"],
        ),
        (
            "schema = 1\n[sensor]\n[effects.dead-band]\nthreshold_a = -3\n",
            &["dead-band.threshold_a", "-3", "zero or more"],
        ),
        (
            "schema = 1\n[sensor]\n[effects.hum]\nfrequency_hz = -5\namplitude_a = 1\n",
            &["hum.frequency_hz", "-5", "zero or more"],
        ),
        (
            "schema = 1\n[sensor]\n[effects.core-saturation]\nknee_a = -20\nsoftness = 1\n",
            &["core-saturation.knee_a", "-20", "zero or more"],
        ),
        (
            "schema = 1\n[sensor]\n[effects.sampled-window]\nperiod_s = 1\nduty = 7\n",
            &["sampled-window.duty", "found 7", "from 0 to 1"],
        ),
        (
            "schema = 1\n[sensor]\n[effects.clipping]\nhigh_a = -5\nlow_a = 5\n",
            &["line 3", "effects.clipping", "-5 and 5", "not below low_a"],
        ),
        (
            "schema = 1\n[battery]\ncapacity_ah = 2\n[effects.capacity]\ncapacity_ah = 0\n",
            &["capacity.capacity_ah", "found 0", "above 0"],
        ),
        // What is divided by is above nothing.
        (
            "schema = 1\n[sensor]\n[effects.core-hysteresis]\nremanence_a = 1\ncoercivity_a = 0\n",
            &["core-hysteresis.coercivity_a", "found 0", "above 0"],
        ),
        (
            "schema = 1\n[sensor]\n[effects.core-hysteresis]\nremanence_a = 1\ncoercivity_a = 2\nspread = 0\n",
            &["core-hysteresis.spread", "found 0", "above 0"],
        ),
        (
            "schema = 1\n[sensor]\n[effects.core-hysteresis]\nremanence_a = 1\ncoercivity_a = 0\nbeta = 1\n",
            &["core-hysteresis.coercivity_a", "found 0", "above 0"],
        ),
        (
            "schema = 1\n[sensor]\n[effects.core-hysteresis]\nremanence_a = 1\ncoercivity_a = 2\nbeta = 0\n",
            &["core-hysteresis.beta", "found 0", "above 0"],
        ),
        (
            "schema = 1\n[sensor]\n[effects.sensor-self-heating]\ntc_per_a2 = 1e-6\ntau_s = 0\nbefore = 0.1\n",
            &["sensor-self-heating.tau_s", "found 0", "above 0"],
        ),
        (
            "schema = 1\n[battery]\ncapacity_ah = 2\n[effects.charge-transfer]\ni0_a = 0\n",
            &["charge-transfer.i0_a", "found 0", "above 0"],
        ),
        (
            "schema = 1\n[sensor]\n[effects.capacity]\ncapacity_ah = 40\n",
            &[
                "line 3",
                "effects.capacity",
                "no [battery]",
                "[battery] beside it",
            ],
        ),
        (
            "schema = 1\n[battery]\ncapacity_ah = 2\n[effects.offset]\noffset_a = 1\n",
            &["line 4", "effects.offset", "[sensor] beside it"],
        ),
        (
            "schema = 1\n[columns]\ntemp_sensor = \"T7\"\n[sensor]\n",
            &["line 3", "columns.temp_sensor", "temp_sensor_c"],
        ),
    ];
    // A name of one's own is a name if the file goes by it.
    parse("schema = 1\n[columns]\nh_a = \"H\"\n[sensor]\nreference = \"h_a\"\n").unwrap();
    for (text, expected) in cases {
        let Err(Failure(sentence)) = parse(text) else {
            panic!("taken: {text}");
        };
        assert!(sentence.starts_with("m.toml"), "{sentence}");
        assert!(!sentence.contains('\n'), "{sentence}");
        for part in expected {
            assert!(sentence.contains(part), "no {part} in: {sentence}");
        }
    }
}

#[test]
fn an_extended_model_is_still_its_users_file() {
    let model = parse(PAIR).unwrap();
    let found = [
        Found {
            id: "lag".into(),
            parameters: vec![("tau_s".into(), 0.1 + 0.2)],
            comment: vec!["A low-pass.".into()],
        },
        Found {
            id: "gain".into(),
            parameters: vec![("gain".into(), 1.01)],
            comment: Vec::new(),
        },
    ];
    let here = Path::new(".");
    let text = model
        .extended(&found, Shift::default(), here, here)
        .unwrap();
    assert!(text.starts_with(PAIR), "{text}");
    assert!(text.contains("# A low-pass.\n[effects.lag]"), "{text}");
    let again = parse(&text).unwrap();
    // In the order of the file, and to the last digit.
    assert_eq!(
        again.effects,
        [
            ("offset", vec![0.25]),
            ("lag", vec![0.1 + 0.2]),
            ("gain", vec![1.01])
        ]
    );
    assert_eq!(again.sensor, model.sensor);
    // Nothing found: nothing changed.
    assert_eq!(
        model.extended(&[], Shift::default(), here, here).unwrap(),
        PAIR
    );
}

#[test]
fn an_effect_that_is_there_gets_the_new_values() {
    let model = parse(PAIR).unwrap();
    let found = [Found {
        id: "offset".into(),
        parameters: vec![("offset_a".into(), 0.5)],
        comment: Vec::new(),
    }];
    let here = Path::new(".");
    let text = model
        .extended(&found, Shift::default(), here, here)
        .unwrap();
    assert_eq!(parse(&text).unwrap().effects, [("offset", vec![0.5])]);
}

#[test]
fn what_the_sensor_is_off_by_does_not_hide_what_the_battery_is() {
    let mut shift = Shift::default();
    let found = [
        (0.02, 0.0, false),
        (0.3, -0.03, true),
        (0.05, 0.0, false),
        (0.4, 0.01, true),
    ];
    for (alignment_s, soc_shift, of_battery) in found {
        let found = Nuisance {
            alignment_s,
            soc_shift: vec![soc_shift],
            ..Nuisance::default()
        };
        shift.take(&found, of_battery);
    }
    assert_eq!((shift.alignment_s, shift.soc), (0.02, -0.03));
    assert_eq!(shift.voltage_alignment_s, 0.3);
}

#[test]
fn what_was_found_of_a_battery_and_its_tester_is_written_into_its_table() {
    let text = "schema = 1\n[battery]\ncapacity_ah = 2\nalignment_s = 0.1\n# From the data sheet.\nocv = [[0, 3.0], [0.5, 3.6], [1, 4.0]]\n";
    let model = parse(text).unwrap();
    let shift = Shift {
        ocv_bend_v: vec![0.03],
        voltage_alignment_s: -0.3,
        ..Shift::default()
    };
    let here = Path::new(".");
    let written = model.extended(&[], shift, here, here).unwrap();
    assert!(written.contains("# From the data sheet."), "{written}");
    let battery = parse(&written).unwrap().battery.unwrap();
    assert!((battery.alignment_s + 0.2).abs() < 1e-12);
    // The points that were stated, and between the first two the bend.
    for point in [(0.0, 3.0), (0.25, 3.33), (0.5, 3.6), (1.0, 4.0)] {
        let is_there = |at: &&(f64, f64)| (at.0 - point.0).abs() < 1e-9;
        let at = battery.ocv.iter().find(is_there).expect("a point");
        assert!((at.1 - point.1).abs() < 1e-9, "{at:?}");
    }
}

#[test]
fn an_effect_without_end_is_refused_unless_that_is_what_switches_it_off() {
    let with = |effect: &str| {
        parse(&format!(
            "schema = 1\n[sensor]\nfront_end = \"pair\"\n{effect}\n"
        ))
    };
    for effect in [
        "[effects.offset]\noffset_a = inf",
        "[effects.gain]\ngain = -inf",
        "[effects.lag]\ntau_s = inf",
        "[effects.lag]\ntau_s = nan",
        "[effects.clipping]\nhigh_a = -inf\nlow_a = -50",
    ] {
        let said = with(effect).unwrap_err().to_string();
        assert!(said.contains("finite number"), "{effect}: {said}");
    }
    with("[effects.clipping]\nhigh_a = inf\nlow_a = -50").unwrap();
}

#[test]
fn an_extended_model_in_another_folder_finds_its_table() {
    let folder = tempfile::tempdir().unwrap();
    let models = folder.path().join("models");
    fs::create_dir(&models).unwrap();
    fs::write(folder.path().join("ocv.csv"), "soc,ocv_v\n0,3\n1,4\n").unwrap();
    let path = models.join("m.toml");
    let text = "schema = 1\n[battery]\ncapacity_ah = 2\nocv_file = \"../ocv.csv\" # measured\n\
                ohmic_resistance_ohm = 0.02\ninitial_soc = 0.9\ncurrent_zero_a = 0.002\n\
                current_zero_uncertainty_a = 0.01\n";
    fs::write(&path, text).unwrap();
    let model = Model::read(&path).unwrap();
    assert_eq!(
        model.battery.as_ref().unwrap().ocv,
        [(0.0, 3.0), (1.0, 4.0)]
    );
    // A folder that is not there yet.
    let out = folder.path().join("deep/er");
    let shift = Shift {
        soc: -0.02,
        resistance: 0.5,
        current_zero_a: -0.012,
        ..Shift::default()
    };
    let extended = model.extended(&[], shift, &models, &out).unwrap();
    assert!(extended.contains("# measured"), "{extended}");
    fs::create_dir_all(&out).unwrap();
    let path = out.join("model.toml");
    fs::write(&path, &extended).unwrap();
    let again = Model::read(&path).unwrap().battery.unwrap();
    assert_eq!(again.ocv, [(0.0, 3.0), (1.0, 4.0)]);
    assert!((again.initial_soc.unwrap() - 0.88).abs() < 1e-12);
    assert!((again.resistance_ohm - 0.03).abs() < 1e-12);
    // The zero of a current is one recording's own: it is said, and stated as before.
    assert_eq!(again.current_zero_a, 0.002);
    assert!(extended.contains("a current_zero_a of -0.01"), "{extended}");
    // A cell may begin fuller than the full one of its table, and is read so again.
    let fuller = Shift {
        soc: 0.109,
        ..Shift::default()
    };
    fs::write(&path, model.extended(&[], fuller, &models, &out).unwrap()).unwrap();
    let again = Model::read(&path).unwrap().battery.unwrap();
    assert!((again.initial_soc.unwrap() - 1.009).abs() < 1e-12);
}

#[test]
fn a_board_has_what_its_design_says() {
    let model = parse("schema = 1\n[sensor]\nfront_end = \"closed-loop\"\naverage = 8\n").unwrap();
    let sensor = model.sensor.unwrap();
    assert_eq!(sensor.front_end, FrontEndKind::ClosedLoop);
    assert_eq!(sensor.average, Some(8));
}
