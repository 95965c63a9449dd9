//! The report as a screen of text.

use super::{
    data::{EffectReport, ParameterReport, Report},
    format::{
        change, count, found, meaning, p_value, percent, place, quantity, significant, unit_of,
        verdict,
    },
};

/// Lines of a small terminal, less one for its prompt.
pub const LINES: usize = 23;
/// Narrower than this nothing can be laid out.
const NARROWEST: usize = 40;

/// How full a screen is.
#[derive(Clone, Copy)]
struct Fullness {
    /// Entries of each kind.
    entries: usize,
    /// Lines of one entry.
    lines: usize,
    /// Whether sections stand apart.
    apart: bool,
}

impl Fullness {
    /// Lines of one note: all of it, or two of a full screen.
    fn notes(self) -> usize {
        if self.lines > 3 {
            self.lines
        } else {
            self.lines.min(2)
        }
    }
}

/// The report in at most [`LINES`] lines of at most `width` characters (and 40 at least). What does not fit is counted, and
/// is in the page.
pub fn render(report: &Report, width: usize) -> String {
    let width = width.max(NARROWEST);
    // The fullest that fits: a parameter cut short is worse than a place that is only counted.
    let generous = (3..=8).rev().flat_map(|entries| {
        [(8, true), (8, false), (3, true), (2, true), (2, false)]
            .map(|(lines, apart)| (entries, lines, apart))
    });
    let tight = (0..=2)
        .rev()
        .flat_map(|entries| [(2, false), (1, false)].map(|(l, a)| (entries, l, a)));
    for (entries, lines, apart) in generous.chain(tight) {
        let fullness = Fullness {
            entries,
            lines,
            apart,
        };
        let screen = screen(report, width, fullness);
        if screen.len() <= LINES {
            return finish(&screen);
        }
    }
    let fullness = Fullness {
        entries: 0,
        lines: 1,
        apart: false,
    };
    let mut screen = screen(report, width, fullness);
    // Beginning and end (what it is, where the files are) stay.
    while screen.len() > LINES {
        screen.remove(screen.len() / 2);
    }
    finish(&screen)
}

fn finish(lines: &[String]) -> String {
    let mut text = lines.join("\n");
    text.push('\n');
    text
}

fn screen(report: &Report, width: usize, fullness: Fullness) -> Vec<String> {
    let mut sections = vec![
        answer(report, width, fullness),
        errors(report, width, fullness),
        effects(report, width, fullness),
    ];
    if fullness.entries > 0 {
        sections.push(places(report, width, fullness));
    }
    sections.push(left(report, width, fullness));
    sections.push(files(report, width));
    let mut lines = Vec::new();
    for section in sections.into_iter().filter(|section| !section.is_empty()) {
        if fullness.apart && !lines.is_empty() {
            lines.push(String::new());
        }
        lines.extend(section);
    }
    lines
}

fn answer(report: &Report, width: usize, fullness: Fullness) -> Vec<String> {
    let summary = report.summary.trim();
    let summary = if summary.is_empty() {
        meaning(report.verdict)
    } else {
        summary
    };
    let words = format!("{}. {summary}", verdict(report.verdict).to_uppercase());
    let mut lines = Vec::new();
    wrap(&mut lines, &words, 0, width, 2 + fullness.lines);
    lines
}

/// Errors of the signals, and of the files that were not fitted.
fn errors(report: &Report, width: usize, fullness: Fullness) -> Vec<String> {
    if report.signals.is_empty() {
        return Vec::new();
    }
    let pair = |before: f64, after: f64, unit: &str| {
        let after = quantity(&significant(after, 3), unit);
        format!("{} → {after}", significant(before, 3))
    };
    let mut rows = vec![row(["error (RMS)", "held out", "", "all samples", "noise"])];
    let signals = fullness.entries.max(1);
    for signal in report.signals.iter().take(signals) {
        let held_out = (signal.held_out_blocks_before, signal.held_out_blocks_after);
        rows.push(vec![
            signal.name.clone(),
            pair(held_out.0, held_out.1, &signal.unit),
            change(held_out.0, held_out.1),
            pair(signal.rmse_before, signal.rmse_after, &signal.unit),
            quantity(&significant(signal.noise_floor, 2), &signal.unit),
        ]);
    }
    let files = fullness.entries.clamp(1, 3);
    for holdout in report.holdouts.iter().take(files) {
        rows.push(vec![
            tail(&holdout.file, width * 3 / 8),
            pair(
                holdout.rmse_before,
                holdout.rmse_after,
                unit_of(report, &holdout.signal),
            ),
            change(holdout.rmse_before, holdout.rmse_after),
            "never fitted".to_owned(),
            String::new(),
        ]);
    }
    let mut lines = table(&rows, "<>>>>", width);
    more(&mut lines, report.signals.len(), signals, "signal");
    more(&mut lines, report.holdouts.len(), files, "file");
    lines
}

fn effects(report: &Report, width: usize, fullness: Fullness) -> Vec<String> {
    if report.effects.is_empty() {
        return Vec::new();
    }
    let shown = fullness.entries.max(1);
    let mut rows = vec![row(["left out", "with 95 % interval", "gain", "placebos"])];
    let mut remarks = Vec::new();
    for effect in report.effects.iter().take(shown) {
        let parameters: Vec<String> = effect.parameters.iter().map(parameter).collect();
        let parameters = if fullness.lines > 1 {
            parameters
        } else {
            vec![parameters.join(", ")]
        };
        let mut parameters = parameters.into_iter();
        let [gain, placebos] = if effect.by_place.is_some() {
            ["by place".to_owned(), String::new()]
        } else if effect.is_shown_by_readings() {
            [percent(effect.held_out_gain), "none".to_owned()]
        } else {
            [effect.held_out_gain, effect.placebo_p99].map(percent)
        };
        rows.push(vec![
            effect.id.clone(),
            parameters.next().unwrap_or_default(),
            gain,
            placebos,
        ]);
        rows.extend(parameters.map(|parameter| row(["", &parameter, "", ""])));
        // After so many rows of the table.
        remarks.push((rows.len(), confused(effect, width, fullness)));
    }
    let mut lines = table(&rows, "<<>>", width);
    for (after, remark) in remarks.into_iter().rev() {
        let after = after.min(lines.len());
        lines.splice(after..after, remark);
    }
    more(&mut lines, report.effects.len(), shown, "effect");
    lines
}

fn parameter(parameter: &ParameterReport) -> String {
    let name = &parameter.name;
    match found(parameter) {
        (value, Some([low, high])) => format!("{name} {value} ({low} … {high})"),
        (value, None) => format!("{name} {value}"),
    }
}

fn confused(effect: &EffectReport, width: usize, fullness: Fullness) -> Vec<String> {
    let mut lines = Vec::new();
    if !effect.equivalent_to.is_empty() {
        let mut words = format!("or {}", effect.equivalent_to.join(", "));
        if !effect.separated_by.is_empty() {
            words.push_str("; to tell them apart: ");
            words.push_str(&effect.separated_by);
        }
        wrap(&mut lines, &words, 2, width, fullness.lines);
    }
    lines
}

fn places(report: &Report, width: usize, fullness: Fullness) -> Vec<String> {
    if report.locations.is_empty() {
        return Vec::new();
    }
    let several = report.signals.len() > 1;
    let mut rows = vec![row(["energy", "samples", "where", "p", "because of"])];
    for location in report.locations.iter().take(fullness.entries) {
        let place = place(location);
        rows.push(vec![
            percent(location.energy_share),
            percent(location.sample_share),
            if several {
                format!("{}: {place}", location.signal)
            } else {
                place
            },
            p_value(location.p_value),
            location
                .effect
                .clone()
                .unwrap_or_else(|| "nothing named".to_owned()),
        ]);
    }
    let mut lines = table(&rows, ">><><", width);
    more(
        &mut lines,
        report.locations.len(),
        fullness.entries,
        "place",
    );
    lines
}

/// What is unexplained, and remarks.
fn left(report: &Report, width: usize, fullness: Fullness) -> Vec<String> {
    let mut lines = Vec::new();
    let shown = fullness.entries.max(1);
    for left in report.unexplained.iter().take(shown) {
        let at = left
            .location
            .as_ref()
            .map(|location| format!("; largest at {}", place(location)))
            .unwrap_or_default();
        let follows = if left.explainable_share > 0.0 {
            format!("{} of its energy follows", percent(left.explainable_share))
        } else {
            "no more than chance of it follows".to_owned()
        };
        let words = format!(
            "Unexplained in {}: {}; {follows} the recorded inputs{at}",
            left.signal,
            quantity(&significant(left.rmse, 3), unit_of(report, &left.signal)),
        );
        wrap(&mut lines, &words, 0, width, fullness.notes());
    }
    more(&mut lines, report.unexplained.len(), shown, "remainder");
    let shown = fullness.entries.saturating_sub(1).min(3);
    for remark in report.remarks.iter().take(shown) {
        let words = format!("Note: {remark}");
        wrap(&mut lines, &words, 0, width, fullness.notes());
    }
    more(&mut lines, report.remarks.len(), shown, "note");
    lines
}

fn files(report: &Report, width: usize) -> Vec<String> {
    let mut lines = Vec::new();
    let without = &report.inputs.without;
    if !without.is_empty() {
        let words = format!("Taken out of the library: {}", without.join(", "));
        wrap(&mut lines, &words, 0, width, 2);
    }
    let seconds = significant(report.seconds, 2);
    let names = if report.inputs.calibration {
        "report.html, report.json, model.toml, calibration.toml"
    } else {
        "report.html, report.json, model.toml"
    };
    let words = match &report.inputs.out {
        Some(out) => {
            let out = tail(out.trim_end_matches('/'), width / 2);
            format!("{out}/: {names} ({seconds} s, seed {})", report.seed)
        }
        None => format!("All of it: {names} ({seconds} s, seed {})", report.seed),
    };
    wrap(&mut lines, &words, 0, width, 2);
    lines
}

fn row<const N: usize>(cells: [&str; N]) -> Vec<String> {
    cells.map(str::to_owned).to_vec()
}

/// Says how many are not shown.
fn more(lines: &mut Vec<String>, all: usize, shown: usize, what: &str) {
    if all > shown {
        let more = count(all - shown, what);
        lines.push(format!("  and {more} more in report.html"));
    }
}

/// Rows under each other, their columns aligned to the left (`<`) or right (`>`). What is too wide loses its end.
fn table(rows: &[Vec<String>], alignment: &str, width: usize) -> Vec<String> {
    const BETWEEN: usize = 2;
    let columns = alignment.chars().count();
    let rows: Vec<Vec<String>> = rows
        .iter()
        .map(|row| row.iter().map(|cell| clean(cell)).collect())
        .collect();
    let mut widths: Vec<usize> = (0..columns)
        .map(|column| {
            rows.iter()
                .filter_map(|row| row.get(column))
                .map(|cell| cell.chars().count())
                .max()
                .unwrap_or(0)
        })
        .collect();
    // The widest column gives way, one character after the other.
    while widths.iter().sum::<usize>() + BETWEEN * (columns - 1) > width {
        match widths.iter_mut().max() {
            Some(widest) if *widest > 1 => *widest -= 1,
            _ => break,
        }
    }
    rows.iter()
        .map(|row| {
            let mut line = String::new();
            for ((cell, side), &room) in row.iter().zip(alignment.chars()).zip(&widths) {
                if !line.is_empty() {
                    line.push_str("  ");
                }
                let mut cell = cell.clone();
                if cell.chars().count() > room {
                    cell = cell.chars().take(room - 1).collect::<String>() + "…";
                }
                if side == '>' {
                    line.push_str(&format!("{cell:>room$}"));
                } else {
                    line.push_str(&format!("{cell:<room$}"));
                }
            }
            line.trim_end().to_owned()
        })
        .collect()
}

/// A terminal obeys control characters: none may come from a file's name.
fn clean(text: &str) -> String {
    text.chars()
        .map(|c| if c.is_control() { ' ' } else { c })
        .collect()
}

/// The end of a text that is too long: of a path that is the telling part.
fn tail(text: &str, most: usize) -> String {
    let length = text.chars().count();
    if length <= most {
        return text.to_owned();
    }
    format!(
        "…{}",
        text.chars()
            .skip(length + 1 - most.max(1))
            .collect::<String>()
    )
}

/// Adds `text` in lines of `width`, at most `most` of them; the last ends in `…` if more was to say.
fn wrap(lines: &mut Vec<String>, text: &str, indent: usize, width: usize, most: usize) {
    let clean = clean(text);
    let mut wrapped: Vec<String> = Vec::new();
    // Continued lines stand two further in.
    let room_of = |wrapped: &[String]| width - indent - if wrapped.is_empty() { 0 } else { 2 };
    let mut line = String::new();
    let mut used = 0;
    for word in clean.split(' ').filter(|word| !word.is_empty()) {
        let mut word: Vec<char> = word.chars().collect();
        let space = usize::from(used > 0);
        if used + space + word.len() > room_of(&wrapped) && used > 0 {
            wrapped.push(std::mem::take(&mut line));
            used = 0;
        }
        while word.len() > room_of(&wrapped) {
            let rest = word.split_off(room_of(&wrapped));
            wrapped.push(word.iter().collect());
            word = rest;
        }
        if used > 0 {
            line.push(' ');
            used += 1;
        }
        used += word.len();
        line.extend(word);
    }
    if used > 0 {
        wrapped.push(line);
    }
    let cut = wrapped.len() > most;
    wrapped.truncate(most.max(1));
    let last = wrapped.len().saturating_sub(1);
    for (number, mut line) in wrapped.into_iter().enumerate() {
        let indent = if number == 0 { indent } else { indent + 2 };
        if cut && number == last {
            while indent + line.chars().count() + 2 > width {
                line.pop();
            }
            line = format!("{} …", line.trim_end());
        }
        lines.push(format!("{}{line}", " ".repeat(indent)));
    }
}
