//! The report as data, as text and as the source of a page.

use crate::report_sample;
use proptest::prelude::*;
use serde_json::Value;
use twin::report::{
    data::{Form, Known, OtherForm, Report, SignalPlots},
    html, json, text,
};

const PAGE_LIMIT: usize = 5_000_000;

fn all() -> Vec<Report> {
    vec![
        report_sample::partly_explained(),
        report_sample::explained(),
        report_sample::no_mismatch(),
        report_sample::ambiguous(),
        report_sample::unknown(),
    ]
}

#[track_caller]
fn keys(value: &Value, expected: &[&str]) {
    for key in expected {
        assert!(value.get(key).is_some(), "no {key:?} in {value}");
    }
}

#[test]
fn json_holds_every_key_of_the_contract() {
    let verdicts = [
        "partly-explained",
        "explained",
        "no-mismatch",
        "ambiguous",
        "unknown",
    ];
    for (report, verdict) in all().iter().zip(verdicts) {
        let value: Value = serde_json::from_str(&json::render(report)).unwrap();
        assert_eq!(value["schema"], 1);
        assert_eq!(value["verdict"], verdict);
        keys(
            &value,
            &[
                "signals",
                "locations",
                "effects",
                "holdouts",
                "unexplained",
                "seconds",
                "seed",
                "version",
            ],
        );
        let each = |list: &str, expected: &[&str]| {
            for entry in value[list].as_array().unwrap() {
                keys(entry, expected);
            }
        };
        each(
            "signals",
            &[
                "name",
                "unit",
                "noise_floor",
                "rmse_before",
                "rmse_after",
                "held_out_blocks_before",
                "held_out_blocks_after",
            ],
        );
        let location = [
            "signal",
            "kind",
            "variable",
            "from",
            "to",
            "energy_share",
            "sample_share",
            "p_value",
            "effect",
        ];
        each("locations", &location);
        each(
            "effects",
            &[
                "id",
                "statement",
                "equation",
                "parameters",
                "held_out_gain",
                "placebo_p99",
                "equivalent_to",
                "separated_by",
            ],
        );
        each("holdouts", &["file", "signal", "rmse_before", "rmse_after"]);
        each(
            "unexplained",
            &["signal", "rmse", "explainable_share", "location", "form"],
        );
        for left in value["unexplained"].as_array().unwrap() {
            keys(&left["location"], &location);
            if !left["form"].is_null() {
                keys(
                    &left["form"],
                    &["id", "description", "equivalent_to", "rmse"],
                );
            }
        }
        for effect in value["effects"].as_array().unwrap() {
            for parameter in effect["parameters"].as_array().unwrap() {
                keys(parameter, &["name", "value", "ci95", "unit"]);
                assert_eq!(parameter["ci95"].as_array().unwrap().len(), 2);
            }
        }
        for location in value["locations"].as_array().unwrap() {
            assert!(["time", "region", "frequency"].contains(&location["kind"].as_str().unwrap()));
        }
        // Neither the series nor where the files were written belong into it.
        assert!(value.get("plots").is_none() && value["inputs"].get("out").is_none());
    }
}

#[test]
fn json_gives_numbers_back_as_they_were() {
    let report = report_sample::partly_explained();
    let value: Value = serde_json::from_str(&json::render(&report)).unwrap();
    assert_eq!(
        value["signals"][0]["rmse_before"].as_f64(),
        Some(report.signals[0].rmse_before)
    );
    assert_eq!(
        value["effects"][1]["parameters"][0]["ci95"][1].as_f64(),
        Some(report.effects[1].parameters[0].ci95[1])
    );
}

#[test]
fn what_its_place_tells_is_not_shown_with_placebos() {
    let mut report = report_sample::partly_explained();
    report.effects.truncate(1);
    let placebos = "Of inputs that cannot be the cause (placebos)";
    assert!(html::render(&report).contains(placebos));
    report.effects[0].by_place = Some("one reading is off".into());
    let page = html::render(&report);
    assert!(page.contains("Its place tells it: one reading is off."));
    assert!(!page.contains(placebos));
    assert!(text::render(&report, 100).contains("by place"));
}

fn spoil(report: &mut Report, number: f64) {
    report.seconds = number;
    for signal in &mut report.signals {
        signal.noise_floor = number;
        signal.rmse_before = number;
        signal.held_out_blocks_before = number;
        signal.held_out_blocks_after = number;
    }
    for location in &mut report.locations {
        location.from = Some(number);
        location.to = Some(number);
        location.energy_share = number;
        location.sample_share = number;
        location.p_value = number;
    }
    for effect in &mut report.effects {
        effect.held_out_gain = number;
        effect.placebo_p99 = number;
        for parameter in &mut effect.parameters {
            parameter.value = number;
            parameter.ci95 = [number, -number];
            parameter.off = Some(number);
        }
    }
    for holdout in &mut report.holdouts {
        holdout.rmse_after = number;
    }
    for left in &mut report.unexplained {
        left.rmse = number;
        left.explainable_share = number;
        if let Some(form) = &mut left.form {
            form.rmse = number;
        }
    }
}

#[test]
fn a_form_of_what_is_left_is_said_on_the_page_and_to_programs() {
    let mut report = report_sample::unknown();
    report.unexplained[0].form = Some(Form {
        id: "square".into(),
        description: "+0.100 A, +1.00 % of i and +0.000500 A/A² times i²".into(),
        equivalent_to: vec![OtherForm {
            id: "direction".into(),
            description: "0 % of i where i > 0, +2.00 % of i where i < 0".into(),
        }],
        rmse: 0.0803,
    });
    let said = "+0.100 A, +1.00 % of i and +0.000500 A/A² times i², or 0 % of i where i > 0, +2.00 % of i where i < 0";
    let page = html::render(&report);
    assert!(page.contains(&said.replace('>', "&gt;").replace('<', "&lt;")));
    let value: Value = serde_json::from_str(&json::render(&report)).unwrap();
    assert_eq!(
        value["unexplained"][0]["form"]["equivalent_to"][0]["id"],
        "direction"
    );
}

#[test]
fn a_number_that_is_none_is_null_and_is_never_shown() {
    for number in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        let mut report = report_sample::partly_explained();
        report.plots.clear();
        spoil(&mut report, number);
        let value: Value = serde_json::from_str(&json::render(&report)).unwrap();
        assert!(value["seconds"].is_null());
        assert!(value["effects"][0]["parameters"][0]["ci95"][0].is_null());
        assert!(value["locations"][0]["from"].is_null());
        let page = html::render(&report);
        let body = &page[page.find("<header>").unwrap()..page.find("<script type").unwrap()];
        for rendered in [body, &text::render(&report, 80)] {
            for none in ["NaN", "inf", "null"] {
                assert!(!rendered.contains(none), "{none} in {rendered}");
            }
        }
    }
}

#[test]
fn the_summary_of_every_verdict_fits_a_screen_and_says_what_counts() {
    for report in all() {
        let screen = text::render(&report, 80);
        assert!(screen.lines().count() <= 23, "{screen}");
        assert!(
            screen.lines().all(|line| line.chars().count() <= 80),
            "{screen}"
        );
        assert!(screen.contains("out/city/: report.html, report.json, model.toml"));
        for effect in &report.effects {
            assert!(screen.contains(&effect.id), "{screen}");
            for parameter in &effect.parameters {
                assert!(screen.contains(&format!("{} ", parameter.name)), "{screen}");
            }
            for other in &effect.equivalent_to {
                assert!(screen.contains(other.as_str()), "{screen}");
            }
        }
        for signal in &report.signals {
            assert!(screen.contains(&signal.name), "{screen}");
        }
    }
    let screen = text::render(&report_sample::partly_explained(), 80);
    for expected in [
        "PARTLY EXPLAINED.",
        "tau_s 0.485 s (0.473 … 0.498)",
        "offset_a 0.64 A (0.57 … 0.72)",
        "di/dt > 3 A/s",
        "Unexplained in i_meas_a",
    ] {
        assert!(
            screen.contains(expected),
            "{expected:?} is not in\n{screen}"
        );
    }
}

#[test]
fn a_note_is_told_in_full_where_there_is_room() {
    let mut report = report_sample::no_mismatch();
    let long = "what is known about the input ".repeat(10) + "and what follows from it";
    report.remarks = vec![long.clone(), long];
    let screen = text::render(&report, 80);
    assert!(screen.lines().count() <= 23, "{screen}");
    assert!(!screen.contains('…'), "{screen}");
    let words = screen.split_whitespace().collect::<Vec<_>>().join(" ");
    assert_eq!(words.matches("and what follows from it").count(), 2);
}

#[test]
fn a_value_that_is_none_is_not_shown_as_one() {
    let mut report = report_sample::explained();
    let parameter = &mut report.effects[0].parameters[0];
    (parameter.value, parameter.ci95) = (0.0, [0.0, 30.0]);
    let name = parameter.name.clone();
    let shown = |report: &Report, known: Known| {
        let mut report = report.clone();
        report.effects[0].parameters[0].known = known;
        let json: Value = serde_json::from_str(&json::render(&report)).unwrap();
        let said = json["effects"][0]["parameters"][0]["known"].clone();
        (text::render(&report, 100), html::render(&report), said)
    };
    let (screen, page, said) = shown(&report, Known::Nothing);
    assert!(
        screen.contains(&format!("{name} not told (0 … 30)")),
        "{screen}"
    );
    assert!(page.contains(&format!("{name}: not told (0 … 30)")));
    assert_eq!(said, "nothing");
    // At the end of what is searched it is that or more, and has no interval.
    report.effects[0].parameters[0].value = 7198.5;
    report.effects[0].parameters[0].ci95 = [514.0, 1e5];
    let (screen, page, said) = shown(&report, Known::AtLeast);
    assert!(
        screen.contains(&format!("{name} 7198 s or more")),
        "{screen}"
    );
    assert!(page.contains("7198 s or more") && !page.contains("514 …"));
    assert_eq!(said, "at-least");
    assert!(shown(&report, Known::Value).2.is_null());
}

#[test]
fn what_no_effect_changed_is_not_said_to_be_one() {
    let caption = |report: &Report| html::render(report).contains("with the effects above");
    let mut report = report_sample::explained();
    assert!(caption(&report));
    // The state of charge at the start was found, and nothing else.
    report.effects.clear();
    assert!(!caption(&report));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// However much there is to say, and however narrow the terminal.
    #[test]
    fn the_summary_always_fits(
        width in 40_usize..200,
        copies in 0_usize..30,
        words in "[a-zäλ\u{1b}\n /<]{0,300}",
    ) {
        let mut report = report_sample::partly_explained_of(10);
        report.plots.clear();
        report.summary = words.clone();
        report.inputs.out = Some(words.clone());
        report.effects = report.effects.iter().cycle().take(copies).cloned().collect();
        report.locations = report.locations.iter().cycle().take(copies).cloned().collect();
        report.signals = report.signals.iter().cycle().take(copies).cloned().collect();
        report.unexplained = report.unexplained.iter().cycle().take(copies).cloned().collect();
        report.remarks = vec![words.clone(); copies];
        for effect in &mut report.effects {
            effect.id = words.clone();
            effect.separated_by = words.clone();
        }
        for holdout in &mut report.holdouts {
            holdout.file = words.clone();
        }
        let screen = text::render(&report, width);
        prop_assert!(screen.lines().count() <= 23, "{}", screen);
        for line in screen.lines() {
            prop_assert!(line.chars().count() <= width, "{} characters: {}", line.chars().count(), line);
            prop_assert!(!line.chars().any(char::is_control));
        }
    }
}

/// The JSON of the page's series.
fn series(page: &str) -> Value {
    let (_, rest) = page.split_once("id=\"series\">").unwrap();
    let (data, _) = rest.split_once("</script>").unwrap();
    serde_json::from_str(data).unwrap()
}

/// A column as the page's script reads it.
fn decode(column: &Value) -> Vec<f64> {
    let step = column["s"].as_f64().unwrap();
    let mut now = 0.0;
    column["d"]
        .as_array()
        .unwrap()
        .iter()
        .map(|value| match value.as_f64() {
            Some(value) => {
                now += value;
                now * step
            }
            None => f64::NAN,
        })
        .collect()
}

fn extremes(values: &[f64]) -> (f64, f64) {
    let finite = || values.iter().copied().filter(|v| v.is_finite());
    (
        finite().fold(f64::INFINITY, f64::min),
        finite().fold(f64::NEG_INFINITY, f64::max),
    )
}

#[test]
fn a_short_recording_is_drawn_in_full() {
    let report = report_sample::partly_explained();
    let plots = &report.plots[0];
    let page = html::render(&report);
    assert!(!page.contains("smallest and largest value"));
    let data = &series(&page)[0];
    for (drawn, given) in [
        (&data["t"], &plots.t_s),
        (&data["values"]["recorded"], &plots.recorded),
        (&data["values"]["after"], &plots.after),
        (&data["residuals"]["after"], &plots.held_out_residual),
    ] {
        let drawn = decode(drawn);
        // The drop-out is no gap in time: its rows have times but no reading.
        assert_eq!(drawn.len(), given.len());
        let (low, high) = extremes(given);
        for (drawn, given) in drawn.iter().zip(given) {
            assert_eq!(drawn.is_nan(), given.is_nan());
            assert!(
                drawn.is_nan() || (drawn - given).abs() <= 1e-6 * (high - low),
                "{drawn} for {given}"
            );
        }
    }
}

#[test]
fn a_long_recording_keeps_its_peaks_and_the_page_its_size() {
    let mut report = report_sample::partly_explained_of(200_000);
    let mut second = report.plots[0].clone();
    second.name = "p_meas_w".to_owned();
    // A single row, where no bucket ends.
    second.recorded[123_457] = 4_321.0;
    second.recorded[123_459] = -4_321.0;
    report.plots.push(second);
    // Nothing takes more characters than a series that jumps over its whole range.
    let mut third = report.plots[0].clone();
    third.name = "worst".to_owned();
    for series in [
        &mut third.recorded,
        &mut third.before,
        &mut third.after,
        &mut third.held_out_residual,
    ] {
        for (row, value) in series.iter_mut().enumerate() {
            *value = 999.0 * (row as f64 * 1.7).sin() * if row % 2 == 0 { 1.0 } else { -1.0 };
        }
    }
    report.plots.push(third);
    let page = html::render(&report);
    assert!(page.len() < PAGE_LIMIT, "{} bytes", page.len());
    assert!(page.contains("200,000 rows are drawn as"));
    let data = &series(&page)[1];
    let recorded = decode(&data["values"]["recorded"]);
    assert!(recorded.len() < 50_000);
    let (low, high) = extremes(&recorded);
    assert!(
        (high - 4_321.0).abs() < 0.01 && (low + 4_321.0).abs() < 0.01,
        "{low} … {high}"
    );
    // The peak is where it was.
    let t_s = decode(&data["t"]);
    let at = recorded.iter().position(|v| *v > 4_000.0).unwrap();
    assert!((t_s[at] - 12_345.7).abs() < 10.0, "{}", t_s[at]);
    assert!(t_s.windows(2).all(|pair| pair[0] <= pair[1]));
}

#[test]
fn time_that_starts_anew_is_laid_end_to_end_and_gaps_are_not_bridged() {
    let mut report = report_sample::partly_explained_of(3);
    report.plots = vec![SignalPlots {
        name: "i_meas_a".to_owned(),
        unit: "A".to_owned(),
        t_s: vec![0.0, 1.0, 2.0, 50.0, 51.0, 0.0, 1.0],
        recorded: vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0],
        before: vec![0.0; 7],
        after: vec![0.5; 7],
        ..SignalPlots::default()
    }];
    let page = html::render(&report);
    assert!(page.contains("starts anew once"));
    let data = &series(&page)[0];
    assert_eq!(
        decode(&data["t"]),
        [0.0, 1.0, 2.0, 26.0, 50.0, 51.0, 51.5, 52.0, 53.0]
    );
    let recorded = decode(&data["values"]["recorded"]);
    assert!(recorded[3].is_nan() && recorded[6].is_nan());
    assert_eq!(recorded.iter().filter(|v| v.is_finite()).count(), 7);
}

#[test]
fn medians_and_bands_are_of_all_samples() {
    let rows = 20_000;
    let mut report = report_sample::partly_explained_of(3);
    let x: Vec<f64> = (0..rows).map(|row| (row % 100) as f64).collect();
    report.plots = vec![SignalPlots {
        name: "i_meas_a".to_owned(),
        unit: "A".to_owned(),
        t_s: (0..rows).map(|row| row as f64).collect(),
        // At each x evenly from 0 to 1, so that median and 5 … 95 % are known.
        recorded: (0..rows).map(|row| (row / 100) as f64 / 199.0).collect(),
        before: vec![0.0; rows],
        after: vec![0.25; rows],
        variables: vec![
            ("x".to_owned(), x),
            (
                "flag".to_owned(),
                (0..rows).map(|row| (row % 2) as f64).collect(),
            ),
        ],
        ..SignalPlots::default()
    }];
    let data = &series(&html::render(&report))[0];
    for (against, discrete) in [(&data["against"][0], false), (&data["against"][1], true)] {
        assert_eq!(against["bins"]["discrete"], discrete);
        for bin in against["bins"]["before"].as_array().unwrap() {
            for (value, expected) in bin.as_array().unwrap().iter().zip([0.05, 0.5, 0.95]) {
                assert!((value.as_f64().unwrap() - expected).abs() < 0.01, "{bin}");
            }
        }
        for bin in against["bins"]["after"].as_array().unwrap() {
            assert!((bin[1].as_f64().unwrap() - 0.25).abs() < 0.01, "{bin}");
        }
    }
    assert_eq!(
        data["against"][1]["bins"]["x"],
        serde_json::json!([0.0, 1.0])
    );
}

#[test]
fn the_page_names_no_other_place() {
    let page = html::render(&report_sample::partly_explained());
    for attribute in ["src=", "href=", "@import", "url("] {
        for (at, _) in page.match_indices(attribute) {
            let rest = &page[at + attribute.len()..];
            assert!(
                rest.starts_with("\"#") || rest.starts_with("\"data:,\""),
                "{attribute} leads to {}",
                &rest[..rest.len().min(40)]
            );
        }
    }
    assert!(page.contains("default-src 'none'"));
    assert!(
        page.contains("Copyright (c) 2022 Leon Sorokin"),
        "uPlot's licence has to be in every copy"
    );
}

/// WCAG 2.2, relative luminance and contrast ratio.
fn contrast(left: &str, right: &str) -> f64 {
    let luminance = |colour: &str| {
        let channel = |at: usize| {
            let value = f64::from(u8::from_str_radix(&colour[at..at + 2], 16).unwrap()) / 255.0;
            if value <= 0.040_45 {
                value / 12.92
            } else {
                ((value + 0.055) / 1.055).powf(2.4)
            }
        };
        0.2126 * channel(1) + 0.7152 * channel(3) + 0.0722 * channel(5)
    };
    let (left, right) = (luminance(left), luminance(right));
    (left.max(right) + 0.05) / (left.min(right) + 0.05)
}

#[test]
fn text_and_lines_stand_out_in_light_and_dark() {
    let style = include_str!("../src/report/assets/page.css");
    let mut schemes = style.split(":root").skip(1);
    for _ in 0..2 {
        let scheme = schemes.next().unwrap();
        let colour = |name: &str| {
            let (_, rest) = scheme
                .split_once(&format!("--{name}: "))
                .unwrap_or_else(|| panic!("no {name}"));
            rest[..7].to_owned()
        };
        for (text, back) in [
            ("ink", "back"),
            ("ink", "panel"),
            ("soft", "back"),
            ("link", "back"),
            ("open", "back"),
            ("good", "good-back"),
            ("part", "part-back"),
            ("open", "open-back"),
            ("ink", "part-back"),
            ("soft", "part-back"),
            ("soft", "open-back"),
            ("soft", "good-back"),
            ("link", "part-back"),
        ] {
            let ratio = contrast(&colour(text), &colour(back));
            assert!(ratio >= 4.5, "{text} on {back}: {ratio:.2}");
        }
        for line in ["recorded", "before", "after", "reference", "fitted"] {
            let ratio = contrast(&colour(line), &colour("back"));
            assert!(ratio >= 3.0, "{line}: {ratio:.2}");
        }
    }
}
