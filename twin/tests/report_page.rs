//! The report's page in a browser: what it draws, what it fetches, and whether it can be used.

use crate::report_sample;
use std::{
    env,
    fs::{self, File},
    path::PathBuf,
    process::{Command, Stdio},
    thread,
    time::{Duration, Instant},
};

use serde_json::Value;
use twin::report::{data::Report, html};

const PROBE: &str = include_str!("report_page.js");
/// Far more than a page takes (3 s); a browser that hangs is a failure and not a wait.
const PATIENCE: Duration = Duration::from_secs(120);

/// What a page did, from the inside and from the browser's log.
struct Seen {
    found: Value,
    console: Vec<String>,
}

fn chromium() -> PathBuf {
    if let Some(named) = env::var_os("HALLMARK_CHROMIUM") {
        return PathBuf::from(named);
    }
    env::split_paths(&env::var_os("PATH").unwrap_or_default())
        .flat_map(|folder| ["chromium", "chromium-headless-shell"].map(|name| folder.join(name)))
        .find(|file| file.is_file())
        .expect("no browser: HALLMARK_CHROMIUM is not set and there is no chromium or chromium-headless-shell on PATH; `cargo xtask test` installs it")
}

/// Opens a page of so many pixels' width, in a frame: a window cannot be as narrow as a phone.
fn open(page: &str, width: u32, arguments: &[&str]) -> Seen {
    let folder = tempfile::tempdir().unwrap();
    let listen = "<script>window.probeErrors = [];\
        addEventListener('error', (event) => probeErrors.push(String(event.message)), true);\
        addEventListener('unhandledrejection', (event) => probeErrors.push(String(event.reason)));\
        addEventListener('securitypolicyviolation', (event) => probeErrors.push('blocked: ' + event.blockedURI));</script>";
    let probed = page
        .replacen("<meta charset", &format!("{listen}<meta charset"), 1)
        .replacen(
            "</body>\n</html>",
            &format!("<script>{PROBE}</script></body></html>"),
            1,
        );
    assert_ne!(
        probed.len(),
        page.len(),
        "the page has no place for the probe"
    );
    fs::write(folder.path().join("page.html"), probed).unwrap();
    let frame = format!(
        "<!DOCTYPE html><meta charset=utf-8><title>waiting</title><body style=margin:0><pre id=found></pre><script>addEventListener('message', \
         (event) => {{ document.getElementById('found').textContent = event.data; }});</script>\
         <iframe src=page.html style='width:{width}px;height:900px;border:0'></iframe>"
    );
    fs::write(folder.path().join("frame.html"), frame).unwrap();
    let log = folder.path().join("log");
    let dom = folder.path().join("dom");
    let mut browser = Command::new(chromium())
        .args([
            "--headless=new",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-background-networking",
            "--disable-component-update",
        ])
        .args([
            "--disable-default-apps",
            "--disable-sync",
            "--no-first-run",
            "--enable-logging=stderr",
            "--log-level=0",
        ])
        .args([
            "--virtual-time-budget=20000",
            "--window-size=1400,1000",
            "--dump-dom",
        ])
        .args(arguments)
        .arg(format!(
            "--user-data-dir={}",
            folder.path().join("profile").display()
        ))
        .arg(format!(
            "file://{}",
            folder.path().join("frame.html").display()
        ))
        .stdin(Stdio::null())
        .stdout(File::create(&dom).unwrap())
        .stderr(File::create(&log).unwrap())
        .spawn()
        .expect("the browser starts");
    let start = Instant::now();
    let status = loop {
        if let Some(status) = browser.try_wait().unwrap() {
            break status;
        }
        if start.elapsed() > PATIENCE {
            browser.kill().unwrap();
            browser.wait().unwrap();
            panic!(
                "the browser did not finish: {}",
                fs::read_to_string(&log).unwrap()
            );
        }
        thread::sleep(Duration::from_millis(20));
    };
    let log = String::from_utf8_lossy(&fs::read(&log).unwrap()).into_owned();
    assert!(status.success(), "the browser failed: {log}");
    let dom = fs::read_to_string(&dom).unwrap();
    let found = dom
        .split_once("<pre id=\"found\">")
        .and_then(|(_, rest)| rest.split_once("</pre>"))
        .map(|(found, _)| {
            found
                .replace("&lt;", "<")
                .replace("&gt;", ">")
                .replace("&nbsp;", " ")
                .replace("&amp;", "&")
        })
        .filter(|found| !found.is_empty())
        .unwrap_or_else(|| panic!("the page's probe did not report; the browser's log: {log}"));
    Seen {
        found: serde_json::from_str(&found).unwrap_or_else(|error| panic!("{error}: {found}")),
        console: log
            .lines()
            .filter(|line| line.contains("CONSOLE"))
            .map(str::to_owned)
            .collect(),
    }
}

fn list<'a>(value: &'a Value, key: &str) -> &'a [Value] {
    value[key]
        .as_array()
        .unwrap_or_else(|| panic!("no list {key:?} in {value}"))
}

/// What holds for every page.
fn check(report: &Report, seen: &Seen, width: u32) {
    let found = &seen.found;
    assert!(
        seen.console.is_empty(),
        "the console says {:?}",
        seen.console
    );
    for empty in ["errors", "resources", "twice", "dangling"] {
        assert!(list(found, empty).is_empty(), "{empty}: {}", found[empty]);
    }
    assert_eq!(found["unscoped"], 0, "table headers without a scope");
    assert_eq!(found["overflow"], 0, "the page is wider than {width} px");
    let levels: Vec<i64> = list(found, "levels")
        .iter()
        .map(|level| level.as_i64().unwrap())
        .collect();
    assert_eq!(levels.iter().filter(|level| **level == 1).count(), 1);
    assert!(
        levels.windows(2).all(|pair| pair[1] <= pair[0] + 1),
        "a level of headings is left out: {levels:?}"
    );

    let pictures: usize = report
        .plots
        .iter()
        .map(|plots| 2 + plots.variables.len() + usize::from(!plots.spectrum.is_empty()))
        .sum();
    let figures = list(found, "figures");
    assert_eq!(figures.len(), pictures);
    for figure in figures {
        assert_eq!(
            (&figure["caption"], &figure["described"]),
            (&Value::Bool(true), &Value::Bool(true)),
            "{figure}"
        );
        assert!(
            figure["label"]
                .as_str()
                .is_some_and(|label| label.len() > 10),
            "{figure}"
        );
        let series = list(figure, "series");
        // Without an effect there is no second simulation.
        let simulations = if report.effects.is_empty() { 1 } else { 2 };
        let recorded = usize::from(figure["kind"] == "time");
        assert!(series.len() >= simulations + recorded, "{figure}");
        for one in series {
            // The recorded line may be hidden under the one that fits it.
            let least = if one[0] == "recorded" { 1 } else { 20 };
            assert!(
                one[1].as_u64().unwrap() >= least,
                "{} is not to be seen in {figure}",
                one[0]
            );
        }
    }
}

fn step(found: &Value, name: &str) -> f64 {
    found["steps"][name]
        .as_f64()
        .unwrap_or_else(|| panic!("no step {name:?} in {found}"))
}

#[track_caller]
fn near(found: &Value, name: &str, expected: f64, tolerance: f64) {
    let got = step(found, name);
    assert!(
        (got - expected).abs() <= tolerance,
        "{name}: {got}, expected {expected} ± {tolerance}"
    );
}

#[test]
fn the_page_of_every_verdict_draws_everything_and_fetches_nothing() {
    for (report, words) in [
        (report_sample::partly_explained(), "Partly explained"),
        (report_sample::explained(), "Explained"),
        (report_sample::no_mismatch(), "No mismatch"),
        (report_sample::ambiguous(), "Ambiguous"),
        (report_sample::unknown(), "Unknown"),
    ] {
        let seen = open(&html::render(&report), 1200, &[]);
        check(&report, &seen, 1200);
        let text = seen.found["text"].as_str().unwrap();
        assert!(
            text.contains(words),
            "the verdict does not come first: {text}"
        );
    }
}

#[test]
fn plots_zoom_by_drag_wheel_keys_buttons_and_fingers() {
    let seen = open(&html::render(&report_sample::partly_explained()), 1200, &[]);
    let found = &seen.found;
    near(found, "wheel that passes by", 1.0, 1e-9);
    near(found, "wheel with Ctrl", 1.0015_f64.powi(-200), 0.01);
    near(found, "arrow", step(found, "wheel with Ctrl"), 0.01);
    near(found, "arrow moved", 0.2 * step(found, "arrow"), 0.01);
    near(found, "0", 1.0, 1e-9);
    near(found, "+", 0.6, 0.01);
    near(found, "plot below", 0.6, 0.01);
    near(found, "double click", 1.0, 1e-9);
    near(found, "drag over half", 0.5, 0.01);
    near(found, "button All", 1.0, 1e-9);
    near(found, "wheel after a click", 1.0015_f64.powi(-200), 0.01);
    near(found, "two fingers, twice apart", 0.5, 0.02);
    near(found, "out beyond everything", 1.0, 1e-9);
    let closest = step(found, "in beyond every sample") * report_sample::ROWS as f64;
    assert!(
        (0.1..5.0).contains(&closest),
        "{closest} samples on the screen"
    );
    assert!(
        step(found, "hidden before") < 0.6,
        "hiding the larger residual does not show the smaller: {found}"
    );
    near(found, "scatter dragged", 0.5, 0.02);
    near(found, "scatter reset", 1.0, 1e-6);
    near(found, "width in print", 640.0, 0.0);
    near(found, "white in print", 1.0, 0.0);
    near(found, "width after print", 1.0, 1e-9);
}

#[test]
fn a_phone_and_a_dark_screen_show_the_same() {
    let report = report_sample::ambiguous();
    let page = html::render(&report);
    let seen = open(&page, 360, &["--blink-settings=preferredColorScheme=0"]);
    check(&report, &seen, 360);
    assert_eq!(seen.found["dark"], true);
    near(&seen.found, "white in print", 1.0, 0.0);
}

#[test]
fn what_a_file_is_called_is_never_run() {
    let evil = "</script><script>probeErrors.push('ran')</script><img src=x onerror=\"probeErrors.push('ran')\">'\"&\u{2028}<!--";
    let unit = "</script><b>&\"'";
    let mut report = report_sample::partly_explained();
    report.inputs.recording = evil.to_owned();
    report.inputs.model = evil.to_owned();
    report.inputs.reference = Some(evil.to_owned());
    report.summary = evil.to_owned();
    report.version = evil.to_owned();
    report.decisions.push(evil.to_owned());
    report.remarks.push(evil.to_owned());
    report.signals[0].name = evil.to_owned();
    report.signals[0].unit = unit.to_owned();
    report.plots[0].name = evil.to_owned();
    report.plots[0].unit = unit.to_owned();
    report.plots[0].variables[0].0 = evil.to_owned();
    for location in &mut report.locations {
        location.signal = evil.to_owned();
        location.variable = evil.to_owned();
        location.unit = unit.to_owned();
        location.effect = Some(evil.to_owned());
    }
    for holdout in &mut report.holdouts {
        holdout.file = evil.to_owned();
        holdout.signal = evil.to_owned();
    }
    report.unexplained[0].signal = evil.to_owned();
    let effect = &mut report.effects[0];
    effect.id = evil.to_owned();
    effect.signal = evil.to_owned();
    effect.statement = evil.to_owned();
    effect.equation = evil.to_owned();
    effect.separated_by = evil.to_owned();
    effect.equivalent_to = vec![evil.to_owned()];
    effect.consequences = vec![evil.to_owned()];
    effect.parameters[0].name = evil.to_owned();
    effect.parameters[0].unit = unit.to_owned();
    let seen = open(&html::render(&report), 1200, &[]);
    check(&report, &seen, 1200);
}

#[test]
fn series_with_holes_and_extremes_are_drawn_without_an_error() {
    let mut report = report_sample::partly_explained_of(3_000);
    let plots = &mut report.plots[0];
    for (row, value) in plots.recorded.iter_mut().enumerate() {
        match row % 50 {
            0 => *value = f64::NAN,
            1 => *value = f64::INFINITY,
            _ => {}
        }
    }
    plots
        .variables
        .push(("never recorded".to_owned(), vec![f64::NAN; 3_000]));
    plots
        .variables
        .push(("constant".to_owned(), vec![1e300; 3_000]));
    plots
        .variables
        .push(("of another length".to_owned(), vec![1.0; 7]));
    plots.spectrum[3] = (f64::NAN, 1.0, 1.0);
    plots.spectrum[4].1 = 0.0;
    let page = html::render(&report);
    // A variable without values makes no picture.
    report.plots[0]
        .variables
        .retain(|(name, _)| name != "never recorded" && name != "of another length");
    let seen = open(&page, 1200, &[]);
    check(&report, &seen, 1200);
}

#[test]
fn the_probe_sees_an_error_a_request_and_a_plot_that_is_not_drawn() {
    let report = report_sample::partly_explained_of(2_000);
    let page = html::render(&report)
        .replacen(
            "</main>",
            "<img src=\"https://example.invalid/x.png\" alt=\"\"><script>null.x</script></main>",
            1,
        )
        .replacen(
            "stroke: () => colour(name)",
            "stroke: () => \"transparent\"",
            1,
        );
    let seen = open(&page, 1200, &[]);
    assert!(!seen.console.is_empty());
    let errors = seen.found["errors"].to_string();
    assert!(
        errors.contains("blocked: https://example.invalid") && errors.contains("null"),
        "{errors}"
    );
    let drawn = &seen.found["figures"][1]["series"];
    assert_eq!(
        (&drawn[0][0], &drawn[0][1]),
        (&Value::from("before"), &Value::from(0)),
        "{drawn}"
    );
}
