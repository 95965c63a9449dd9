//! The report as a screen of text.

use super::{
    data::{EffectReport, Report, SignalReport},
    format::{change, meaning, p_value, percent, place, quantity, significant, unit_of, verdict, with_interval},
};

/// Lines of a small terminal, less one for its prompt.
pub const LINES: usize = 23;
/// Narrower than this nothing can be laid out.
const NARROWEST: usize = 40;

/// The report in at most [`LINES`] lines of at most `width` characters (and 40 at least). What does not fit is counted, and
/// is in the page.
pub fn render(report: &Report, width: usize) -> String {
    let width = width.max(NARROWEST);
    // The fullest that fits.
    for entries in (1..=8).rev() {
        let lines = screen(report, width, entries);
        if lines.len() <= LINES {
            return finish(&lines);
        }
    }
    let mut lines = screen(report, width, 0);
    // Long names of files may still be too much: the end (where the files are) stays.
    while lines.len() > LINES {
        lines.remove(lines.len() / 2);
    }
    finish(&lines)
}

fn finish(lines: &[String]) -> String {
    let mut text = lines.join("\n");
    text.push('\n');
    text
}

/// The screen with so many entries of each kind.
fn screen(report: &Report, width: usize, entries: usize) -> Vec<String> {
    let mut lines = Vec::new();
    let mut push = |text: String, indent: usize, most: usize| wrap(&mut lines, &text, indent, width, most);

    let summary = report.summary.trim();
    let summary = if summary.is_empty() { meaning(report.verdict) } else { summary };
    push(format!("{}. {summary}", verdict(report.verdict).to_uppercase()), 0, if entries > 2 { 5 } else { 3 });

    let signals = entries.max(1);
    if !report.signals.is_empty() {
        push("Error (RMS), held out before → after; all samples; noise floor".to_owned(), 0, 1);
    }
    for signal in report.signals.iter().take(signals) {
        push(errors(signal), 2, 1);
    }
    more(&mut push, report.signals.len(), signals);
    let files = if entries > 3 { 3 } else { 1 };
    for holdout in report.holdouts.iter().take(files) {
        let unit = unit_of(report, &holdout.signal);
        push(
            format!(
                "not fitted: {} {} → {}{}",
                tail(&holdout.file, width / 3),
                significant(holdout.rmse_before, 3),
                quantity(&significant(holdout.rmse_after, 3), unit),
                bracketed(&change(holdout.rmse_before, holdout.rmse_after)),
            ),
            2,
            1,
        );
    }
    more(&mut push, report.holdouts.len(), files);

    if !report.effects.is_empty() {
        push("Physics that was left out".to_owned(), 0, 1);
    }
    let effects = entries.max(1);
    for effect in report.effects.iter().take(effects) {
        push(named(effect), 2, if entries > 1 { 2 } else { 1 });
        if !effect.equivalent_to.is_empty() {
            let separated = if effect.separated_by.is_empty() { String::new() } else { format!("; separated by: {}", effect.separated_by) };
            push(format!("or {}{separated}", effect.equivalent_to.join(", ")), 4, if entries > 2 { 2 } else { 1 });
        }
    }
    more(&mut push, report.effects.len(), effects);

    if entries > 0 && !report.locations.is_empty() {
        push("Where".to_owned(), 0, 1);
        for location in report.locations.iter().take(entries) {
            let effect = location.effect.as_deref().unwrap_or("nothing named");
            push(
                format!(
                    "{}: {} of the energy in {} of the samples, {} ({effect})",
                    place(location),
                    percent(location.energy_share),
                    percent(location.sample_share),
                    p_value(location.p_value)
                ),
                2,
                1,
            );
        }
        more(&mut push, report.locations.len(), entries);
    }

    for left in report.unexplained.iter().take(signals) {
        let at = left.location.as_ref().map(|location| format!("; largest at {}", place(location))).unwrap_or_default();
        push(
            format!(
                "Unexplained in {}: {}; {} of its energy explainable{at}",
                left.signal,
                quantity(&significant(left.rmse, 3), unit_of(report, &left.signal)),
                percent(left.explainable_share),
            ),
            0,
            if entries > 2 { 2 } else { 1 },
        );
    }
    for remark in report.remarks.iter().take(entries.saturating_sub(1).min(2)) {
        push(format!("Note: {remark}"), 0, if entries > 3 { 2 } else { 1 });
    }

    let files = match &report.inputs.out {
        Some(out) => {
            let out = tail(out.trim_end_matches('/'), width / 2);
            format!("{out}/: report.html, report.json, model.toml")
        }
        None => "All of it: report.html, report.json, model.toml".to_owned(),
    };
    push(format!("{files}  ({} s, seed {})", significant(report.seconds, 2), report.seed), 0, 2);
    lines
}

fn more(push: &mut impl FnMut(String, usize, usize), all: usize, shown: usize) {
    if all > shown {
        push(format!("and {} more", all - shown), 2, 1);
    }
}

fn bracketed(text: &str) -> String {
    if text.is_empty() { String::new() } else { format!(" ({text})") }
}

fn errors(signal: &SignalReport) -> String {
    format!(
        "{}: {} → {}{}; all {} → {}; noise {}",
        signal.name,
        significant(signal.held_out_blocks_before, 3),
        quantity(&significant(signal.held_out_blocks_after, 3), &signal.unit),
        bracketed(&change(signal.held_out_blocks_before, signal.held_out_blocks_after)),
        significant(signal.rmse_before, 3),
        significant(signal.rmse_after, 3),
        significant(signal.noise_floor, 2),
    )
}

fn named(effect: &EffectReport) -> String {
    let parameters: Vec<String> = effect
        .parameters
        .iter()
        .map(|parameter| {
            let [value, low, high] = with_interval(parameter.value, parameter.ci95);
            format!("{} {} ({low} … {high})", parameter.name, quantity(&value, &parameter.unit))
        })
        .collect();
    format!(
        "{}: {}; gain {}, placebo {}",
        effect.id,
        parameters.join(", "),
        percent(effect.held_out_gain),
        percent(effect.placebo_p99)
    )
}

/// The end of a text that is too long: of a path that is the telling part.
fn tail(text: &str, most: usize) -> String {
    let length = text.chars().count();
    if length <= most {
        return text.to_owned();
    }
    format!("…{}", text.chars().skip(length + 1 - most.max(1)).collect::<String>())
}

/// Adds `text` in lines of `width`, at most `most` of them; the last ends in `…` if more was to say.
fn wrap(lines: &mut Vec<String>, text: &str, indent: usize, width: usize, most: usize) {
    // A terminal obeys control characters: none may come from a file's name.
    let clean: String = text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
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
