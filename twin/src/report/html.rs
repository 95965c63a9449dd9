//! The report as one page that needs nothing else: no network, no other file.

use super::{
    data::{EffectReport, Known, Location, ParameterReport, Report, SignalReport, Verdict},
    format::{
        NONE, change, count, found, grouped, meaning, p_value, percent, place, quantity,
        significant, unit_of, verdict,
    },
    plots::{Pictures, Words, embed, pictures},
};

const STYLE: &str = include_str!("assets/page.css");
const SCRIPT: &str = include_str!("assets/page.js");
const PLOT_STYLE: &str = include_str!("assets/uplot/uPlot.min.css");
const PLOT_SCRIPT: &str = include_str!("assets/uplot/uPlot.iife.min.js");
const PLOT_LICENCE: &str = include_str!("assets/uplot/LICENSE");

/// The page. Text from outside (names of files and columns, statements) is escaped wherever it stands.
pub fn render(report: &Report) -> String {
    let drawn = pictures(report);
    let mut page = String::with_capacity(1 << 20);
    page.push_str("<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n");
    // The browser itself holds the page to what it promises: nothing is fetched from anywhere.
    page.push_str(
        "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; script-src 'unsafe-inline'; \
         style-src 'unsafe-inline'; img-src data:\">\n",
    );
    page.push_str("<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n");
    page.push_str("<meta name=\"color-scheme\" content=\"light dark\">\n<link rel=\"icon\" href=\"data:,\">\n");
    page.push_str(&format!(
        "<title>{}: {}</title>\n<style>\n{PLOT_STYLE}\n{STYLE}</style>\n</head>\n<body>\n",
        escape(verdict(report.verdict)),
        escape(&report.inputs.recording)
    ));
    page.push_str("<a class=\"skip\" href=\"#main\">Skip to the verdict</a>\n");
    head(&mut page, report);
    page.push_str("<main id=\"main\">\n");
    answer(&mut page, report);
    places(&mut page, report);
    effects(&mut page, report);
    before_and_after(&mut page, report, &drawn);
    holdouts(&mut page, report);
    unexplained(&mut page, report);
    list(
        &mut page,
        "decisions",
        "How it was decided",
        &report.decisions,
        true,
    );
    list(
        &mut page,
        "remarks",
        "Remarks on the input",
        &report.remarks,
        false,
    );
    page.push_str("</main>\n");
    foot(&mut page, report);
    let data: Vec<_> = drawn.iter().map(|(_, pictures)| &pictures.data).collect();
    page.push_str(&format!(
        "<script type=\"application/json\" id=\"series\">{}</script>\n<script>\n/*\n{}*/\n{PLOT_SCRIPT}\n</script>\n<script>\n{SCRIPT}</script>\n</body>\n</html>\n",
        embed(&data),
        PLOT_LICENCE.replace("*/", "* /"),
    ));
    page
}

fn escape(text: &str) -> String {
    let mut safe = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '&' => safe.push_str("&amp;"),
            '<' => safe.push_str("&lt;"),
            '>' => safe.push_str("&gt;"),
            '"' => safe.push_str("&quot;"),
            '\'' => safe.push_str("&#39;"),
            // Control characters mean nothing on a page and NUL is an error in one.
            '\u{0}'..='\u{8}' | '\u{b}'..='\u{1f}' | '\u{7f}' => safe.push('\u{fffd}'),
            _ => safe.push(character),
        }
    }
    safe
}

/// A name of a column or parameter. Only a long one may be broken: `i_mea` and `s_a` on two lines are hard to read.
fn code(name: &str) -> String {
    let class = if name.chars().count() > 20 {
        " class=\"long\""
    } else {
        ""
    };
    format!("<code{class}>{}</code>", escape(name))
}

/// The first cell of a row of text.
fn row_head(text: &str) -> String {
    let class = if text.chars().count() > 36 {
        " class=\"long\""
    } else {
        ""
    };
    format!("<th scope=\"row\"{class}>{}</th>", escape(text))
}

fn head(page: &mut String, report: &Report) {
    page.push_str(
        "<header>\n<p class=\"kicker\">Why the recording and the simulation disagree</p>\n",
    );
    page.push_str(&format!(
        "<h1>{}</h1>\n<dl class=\"files\">",
        escape(file_name(&report.inputs.recording))
    ));
    let mut entry = |what: &str, file: &str| {
        page.push_str(&format!(
            "<div><dt>{what}</dt><dd>{}</dd></div>",
            escape(file)
        ));
    };
    entry("Recording", &report.inputs.recording);
    entry("Model", &report.inputs.model);
    if let Some(reference) = &report.inputs.reference {
        entry("Reference", reference);
    }
    if !report.inputs.without.is_empty() {
        entry(
            "Taken out of the library",
            &report.inputs.without.join(", "),
        );
    }
    page.push_str("</dl>\n<nav aria-label=\"Sections\"><ul>");
    for (id, title, shown) in [
        ("where", "Where", true),
        ("effects", "Effects", true),
        ("before-after", "Before and after", true),
        ("holdouts", "Other files", !report.holdouts.is_empty()),
        ("unexplained", "Unexplained", true),
        (
            "decisions",
            "How it was decided",
            !report.decisions.is_empty(),
        ),
        ("remarks", "Remarks", !report.remarks.is_empty()),
    ] {
        if shown {
            page.push_str(&format!("<li><a href=\"#{id}\">{title}</a></li>"));
        }
    }
    page.push_str("</ul></nav>\n</header>\n");
}

fn file_name(path: &str) -> &str {
    path.rsplit(['/', '\\'])
        .find(|part| !part.is_empty())
        .unwrap_or(path)
}

/// The verdict, and for each signal the one pair of numbers that counts.
fn answer(page: &mut String, report: &Report) {
    let (class, sign) = match report.verdict {
        Verdict::NoMismatch => ("good", "✓"),
        Verdict::Explained => ("good", "✓"),
        Verdict::PartlyExplained => ("part", "◐"),
        Verdict::Ambiguous => ("part", "≟"),
        Verdict::Unknown => ("unknown", "?"),
    };
    page.push_str(&format!(
        "<section class=\"verdict {class}\" aria-labelledby=\"verdict\">\n<h2 id=\"verdict\"><span class=\"sign\" aria-hidden=\"true\">{sign}</span>{}</h2>\n",
        verdict(report.verdict)
    ));
    let summary = if report.summary.trim().is_empty() {
        meaning(report.verdict)
    } else {
        report.summary.trim()
    };
    page.push_str(&format!("<p class=\"summary\">{}</p>\n", escape(summary)));
    page.push_str("<dl class=\"stats\">");
    for signal in &report.signals {
        let improved = change(signal.held_out_blocks_before, signal.held_out_blocks_after);
        page.push_str(&format!(
            "<div><dt>Held-out error of {}</dt><dd>{}<strong>{}</strong>{}</dd></div>",
            code(&signal.name),
            if report.effects.is_empty() {
                String::new()
            } else {
                format!("{} → ", significant(signal.held_out_blocks_before, 3))
            },
            escape(&quantity(
                &significant(signal.held_out_blocks_after, 3),
                &signal.unit
            )),
            if report.effects.is_empty() || improved.is_empty() {
                String::new()
            } else {
                format!(" <span class=\"change\">{improved}</span>")
            },
        ));
    }
    page.push_str("</dl>\n");
    if report.effects.is_empty() {
        page.push_str("</section>\n");
        return;
    }
    page.push_str("<ul class=\"named\">");
    for (number, effect) in report.effects.iter().enumerate() {
        page.push_str(&format!(
            "<li><a href=\"#effect-{number}\">{}</a>",
            escape(&effect.id)
        ));
        if report.signals.len() > 1 {
            page.push_str(&format!(" in {}", code(&effect.signal)));
        }
        page.push_str(": ");
        let parameters: Vec<String> = effect.parameters.iter().map(in_words).collect();
        page.push_str(&escape(&parameters.join(", ")));
        if !effect.equivalent_to.is_empty() {
            page.push_str(&format!(
                " – or {}",
                escape(&effect.equivalent_to.join(", "))
            ));
        }
        page.push_str("</li>");
    }
    page.push_str("</ul>\n</section>\n");
}

fn in_words(parameter: &ParameterReport) -> String {
    let name = &parameter.name;
    match (found(parameter), parameter.known) {
        ((value, Some([low, high])), Known::Nothing) => format!("{name}: {value} ({low} … {high})"),
        ((value, Some([low, high])), _) => format!("{name} = {value} ({low} … {high})"),
        ((value, None), _) => format!("{name} = {value}"),
    }
}

/// A share as a bar with its number.
fn bar(share: f64, class: &str) -> String {
    let width = if share.is_finite() {
        100.0 * share.clamp(0.0, 1.0)
    } else {
        0.0
    };
    format!(
        "<span class=\"share\"><span class=\"number\">{}</span><span class=\"track\" aria-hidden=\"true\"><span class=\"fill {class}\" style=\"width:{width:.1}%\"></span></span></span>",
        percent(share)
    )
}

fn places(page: &mut String, report: &Report) {
    page.push_str(
        "<section aria-labelledby=\"where\">\n<h2 id=\"where\">Where the mismatch sits</h2>\n",
    );
    if report.locations.is_empty() {
        page.push_str(if report.verdict == Verdict::NoMismatch {
            "<p>Not looked for: there is no mismatch to be placed.</p>\n</section>\n"
        } else {
            "<p>No place stands out: the mismatch is spread over time, operating regions and frequencies as the samples are.</p>\n</section>\n"
        });
        return;
    }
    page.push_str(
        "<p>Places that hold more of the mismatch's energy than of the samples. p is how often chance makes a place as telling: of time with the recording's blocks in any order, of a region with the recording moved against it, of a band of frequency with the noise that the model file states, or the readings in any order; of a stretch that was left out, with its readings anywhere.</p>\n\
         <table class=\"stack\">\n<thead><tr><th scope=\"col\">Place</th><th scope=\"col\">Signal</th><th scope=\"col\">Energy</th><th scope=\"col\">Samples</th>\
         <th scope=\"col\" class=\"n\">Density</th><th scope=\"col\">p</th><th scope=\"col\">Accounted for by</th></tr></thead>\n<tbody>\n",
    );
    for location in &report.locations {
        let density = location.energy_share / location.sample_share;
        page.push_str(&format!(
            "<tr>{}<td data-label=\"Signal\">{}</td><td data-label=\"Energy\">{}</td><td data-label=\"Samples\">{}</td>\
             <td class=\"n\" data-label=\"Density\">{}</td><td class=\"p\" data-label=\"p\">{}</td><td data-label=\"Effect\">{}</td></tr>\n",
            row_head(&place(location)),
            code(&location.signal),
            bar(location.energy_share, "energy"),
            bar(location.sample_share, "samples"),
            if density.is_finite() { format!("×{}", significant(density, 2)) } else { String::new() },
            escape(&p_value(location.p_value)),
            accounted_for(report, location),
        ));
    }
    page.push_str("</tbody>\n</table>\n</section>\n");
}

fn accounted_for(report: &Report, location: &Location) -> String {
    let Some(id) = &location.effect else {
        return "<span class=\"gap\">nothing named</span>".to_owned();
    };
    // The same effect may be named in two signals.
    let find = |same_signal: bool| {
        report.effects.iter().position(|effect| {
            effect.id == *id && (!same_signal || effect.signal == location.signal)
        })
    };
    match find(true).or_else(|| find(false)) {
        Some(number) => format!("<a href=\"#effect-{number}\">{}</a>", escape(id)),
        None => escape(id),
    }
}

fn effects(page: &mut String, report: &Report) {
    page.push_str("<section aria-labelledby=\"effects\">\n<h2 id=\"effects\">Physics that the simulation left out</h2>\n");
    if report.effects.is_empty() {
        page.push_str(if report.verdict == Verdict::NoMismatch {
            "<p>None is needed.</p>\n"
        } else {
            "<p>None is named. What was tried, and why it was not enough, is told under “How it was decided”.</p>\n"
        });
    }
    for (number, effect) in report.effects.iter().enumerate() {
        one_effect(page, number, effect);
    }
    page.push_str("</section>\n");
}

fn one_effect(page: &mut String, number: usize, effect: &EffectReport) {
    page.push_str(&format!(
        "<article class=\"effect\" aria-labelledby=\"effect-{number}\">\n<h3 id=\"effect-{number}\">{}</h3>\n<p class=\"where\">shows in {}</p>\n<p>{}</p>\n",
        escape(&effect.id),
        code(&effect.signal),
        escape(&effect.statement)
    ));
    if !effect.equation.is_empty() {
        page.push_str(&format!(
            "<p class=\"equation\"><code>{}</code></p>\n",
            escape(&effect.equation)
        ));
    }
    if !effect.parameters.is_empty() {
        page.push_str(
            "<table class=\"stack parameters\">\n<thead><tr><th scope=\"col\">Parameter</th><th scope=\"col\" class=\"n\">Value</th>\
             <th scope=\"col\" class=\"n\">95 % interval</th><th scope=\"col\">Interval, and where the effect is off</th></tr></thead>\n<tbody>\n",
        );
        for parameter in &effect.parameters {
            let (value, ends) = found(parameter);
            let ends = ends.map_or(NONE.to_owned(), |[low, high]| {
                format!("{low} … {}", escape(&quantity(&high, &parameter.unit)))
            });
            page.push_str(&format!(
                "<tr><th scope=\"row\">{}</th><td class=\"n\" data-label=\"Value\">{}</td><td class=\"n\" data-label=\"95 % interval\">{ends}</td><td class=\"wide\">{}</td></tr>\n",
                code(&parameter.name),
                escape(&value),
                interval(parameter),
            ));
        }
        page.push_str("</tbody>\n</table>\n");
    }
    evidence(page, effect);
    if !effect.consequences.is_empty() {
        page.push_str("<h4>What follows</h4>\n<ul>");
        for consequence in &effect.consequences {
            page.push_str(&format!("<li>{}</li>", escape(consequence)));
        }
        page.push_str("</ul>\n");
    }
    page.push_str("<h4>What it could be confused with</h4>\n");
    if effect.by_place.is_some() {
        page.push_str(&format!(
            "<p class=\"confused\">A slip of the log at the same place would look the same. <strong>What would separate them:</strong> {}</p>\n",
            escape(&effect.separated_by)
        ));
    } else if effect.equivalent_to.is_empty() {
        page.push_str(
            "<p>Nothing in the library: no other effect fits this recording as well.</p>\n",
        );
    } else {
        let names: Vec<String> = effect.equivalent_to.iter().map(|id| code(id)).collect();
        page.push_str(&format!(
            "<p class=\"confused\">On this recording it cannot be told apart from {}.",
            names.join(", ")
        ));
        if !effect.separated_by.is_empty() {
            page.push_str(&format!(
                " <strong>What would separate them:</strong> {}",
                escape(&effect.separated_by)
            ));
        }
        page.push_str("</p>\n");
    }
    page.push_str("</article>\n");
}

/// The gain on samples that were not fitted, against what the best of the placebos reaches.
fn evidence(page: &mut String, effect: &EffectReport) {
    page.push_str("<h4>Evidence</h4>\n");
    if let Some(place) = &effect.by_place {
        page.push_str(&format!(
            "<p>Its place tells it: {}. That is too few for samples that were not fitted to confirm it.</p>\n",
            escape(place)
        ));
        return;
    }
    if effect.is_shown_by_readings() {
        page.push_str(&format!(
            "<p>The readings show it by themselves, and it is <strong>{}</strong> of the squared error that is left without it, on all samples. \
             No sample was left out for it and no placebo asked.</p>\n",
            percent(effect.held_out_gain)
        ));
        return;
    }
    let ratio = effect.held_out_gain / effect.placebo_p99;
    page.push_str("<div class=\"bars\" aria-hidden=\"true\">");
    for (what, class, share) in [
        ("this effect", "gain", effect.held_out_gain),
        ("placebos", "samples", effect.placebo_p99),
    ] {
        let width = if share.is_finite() {
            100.0 * share.clamp(0.0, 1.0)
        } else {
            0.0
        };
        page.push_str(&format!(
            "<span>{what}</span><span class=\"track tall\"><span class=\"fill {class}\" style=\"width:{width:.2}%\"></span></span><span class=\"n\">{}</span>",
            percent(share)
        ));
    }
    page.push_str(&format!(
        "</div>\n<p>It removes <strong>{}</strong> of the squared error that is left without it, on samples that were not fitted. \
         Of inputs that cannot be the cause (placebos), 99 % remove at most <strong>{}</strong>{}.</p>\n",
        percent(effect.held_out_gain),
        percent(effect.placebo_p99),
        if ratio.is_finite() && ratio > 1.0 { format!("; the effect removes {} times as much", significant(ratio, 2)) } else { String::new() },
    ));
}

/// An interval on its own axis, with the value that turns the effect off if there is one.
fn interval(parameter: &ParameterReport) -> String {
    let [low, high] = parameter.ci95;
    let value = parameter.value;
    if parameter.known == Known::AtLeast {
        return "<span class=\"gap\">the end of what is searched</span>".to_owned();
    }
    if ![low, high, value].iter().all(|v| v.is_finite()) || high < low {
        return "<span class=\"gap\">not bounded</span>".to_owned();
    }
    let off = parameter.off.filter(|v| v.is_finite());
    let (mut from, mut to) = (low.min(value), high.max(value));
    if let Some(off) = off {
        from = from.min(off);
        to = to.max(off);
    } else {
        let width = to - from;
        (from, to) = (from - width, to + width);
    }
    let span = if to > from {
        to - from
    } else {
        value.abs().max(1.0)
    };
    // A margin, so that neither end sits on the edge.
    let at = |v: f64| 4.0 + 92.0 * ((v - from) / span).clamp(0.0, 1.0);
    let mut drawing =
        String::from("<span class=\"interval\" aria-hidden=\"true\"><span class=\"axis\"></span>");
    if let Some(off) = off {
        drawing.push_str(&format!(
            "<span class=\"off\" style=\"left:{:.2}%\"><span>off</span></span>",
            at(off)
        ));
    }
    drawing.push_str(&format!(
        "<span class=\"range\" style=\"left:{:.2}%;width:{:.2}%\"></span>",
        at(low),
        at(high) - at(low)
    ));
    if parameter.known == Known::Value {
        let dot = at(value);
        drawing.push_str(&format!(
            "<span class=\"dot\" style=\"left:{dot:.2}%\"></span>"
        ));
    }
    drawing.push_str("</span>");
    drawing
}

fn before_and_after(page: &mut String, report: &Report, drawn: &[(usize, Pictures)]) {
    page.push_str("<section aria-labelledby=\"before-after\">\n<h2 id=\"before-after\">Before and after</h2>\n");
    if !report.signals.is_empty() {
        page.push_str(
            "<p>Root mean square of recorded − simulated. A held-out block is predicted by a model that was fitted on the other blocks only.</p>\n\
             <div class=\"scroll\" role=\"region\" tabindex=\"0\" aria-label=\"Errors before and after\"><table>\n<thead><tr><th rowspan=\"2\" scope=\"col\">Signal</th>\
             <th colspan=\"3\" scope=\"colgroup\" class=\"group\">Held-out blocks</th><th colspan=\"3\" scope=\"colgroup\" class=\"group\">All samples (fitted)</th><th rowspan=\"2\" scope=\"col\" class=\"n\">Noise floor</th>\
             <th rowspan=\"2\" scope=\"col\" class=\"n\">Samples</th></tr>\n<tr><th scope=\"col\" class=\"n\">before</th><th scope=\"col\" class=\"n\">after</th><th scope=\"col\" class=\"n\">change</th>\
             <th scope=\"col\" class=\"n\">before</th><th scope=\"col\" class=\"n\">after</th><th scope=\"col\" class=\"n\">change</th></tr></thead>\n<tbody>\n",
        );
        for signal in &report.signals {
            let cell = |value: f64| {
                format!(
                    "<td class=\"n\">{}</td>",
                    escape(&quantity(&significant(value, 3), &signal.unit))
                )
            };
            let strong = |text: String| format!("<td class=\"n\"><strong>{text}</strong></td>");
            page.push_str(&format!(
                "<tr><th scope=\"row\">{}</th>{}{}{}{}{}<td class=\"n\">{}</td>{}<td class=\"n\">{}</td></tr>\n",
                code(&signal.name),
                cell(signal.held_out_blocks_before),
                cell(signal.held_out_blocks_after),
                strong(change(signal.held_out_blocks_before, signal.held_out_blocks_after)),
                cell(signal.rmse_before),
                cell(signal.rmse_after),
                change(signal.rmse_before, signal.rmse_after),
                cell(signal.noise_floor),
                grouped(signal.samples),
            ));
        }
        page.push_str("</tbody>\n</table></div>\n");
    }
    if !drawn.is_empty() {
        page.push_str(
            "<p class=\"hint screen\">Drag over a plot to zoom in; double-click to see all. Click a plot and its wheel zooms, too (or hold Ctrl). \
             With the keyboard: <kbd>+</kbd> <kbd>−</kbd> zoom, <kbd>←</kbd> <kbd>→</kbd> move, <kbd>0</kbd> shows all. By touch: two fingers. \
             A click on a name of the legend hides its line. Shaded: places of the table above.</p>\n\
             <noscript><p class=\"hint\">The plots are drawn by a script, which this browser does not run. Every number is in the tables and texts.</p></noscript>\n",
        );
    }
    for (number, (index, pictures)) in drawn.iter().enumerate() {
        let Some(plots) = report.plots.get(*index) else {
            continue;
        };
        page.push_str(&format!(
            "<h3 class=\"signal\">{}</h3>\n",
            code(&plots.name)
        ));
        let mut signals = report.signals.iter();
        let signal = signals.find(|signal| signal.name == plots.name);
        if let Some(signal) = signal.filter(|_| !pictures.same) {
            error_bars(page, signal);
        }
        let named = report.effects.iter().any(|it| it.signal == plots.name);
        signal_figures(page, number, (&plots.name, &plots.unit), named, pictures);
    }
    page.push_str("</section>\n");
}

/// Held-out error before and after as bars, with the noise floor.
fn error_bars(page: &mut String, signal: &SignalReport) {
    let largest = signal
        .held_out_blocks_before
        .max(signal.held_out_blocks_after);
    if !(largest.is_finite() && largest > 0.0) {
        return;
    }
    let width = |value: f64| {
        if value.is_finite() {
            100.0 * (value / largest).clamp(0.0, 1.0)
        } else {
            0.0
        }
    };
    page.push_str("<div class=\"bars\" aria-hidden=\"true\">");
    for (what, value) in [
        ("before", signal.held_out_blocks_before),
        ("after", signal.held_out_blocks_after),
    ] {
        page.push_str(&format!(
            "<span>{what}</span><span class=\"track tall\"><span class=\"fill {what}\" style=\"width:{:.2}%\"></span><span class=\"floor\" style=\"left:{:.2}%\"></span></span><span class=\"n\">{}</span>",
            width(value),
            width(signal.noise_floor),
            escape(&quantity(&significant(value, 3), &signal.unit)),
        ));
    }
    page.push_str(&format!(
        "</div><p class=\"hint\">Held-out error of {}. The mark is the noise that is stated or counted: what lies at it has nothing left to explain.</p>\n",
        count(signal.samples, "sample")
    ));
}

/// The parts of a figure that differ.
struct Figure<'a> {
    signal: usize,
    kind: &'a str,
    index: usize,
    title: String,
    axes: String,
    caption: String,
}

fn figure(page: &mut String, figure: &Figure<'_>, words: &Words) {
    let Figure {
        signal,
        kind,
        index,
        title,
        axes,
        caption,
    } = figure;
    let id = format!("caption-{signal}-{kind}-{index}");
    page.push_str(&format!(
        "<figure class=\"plot {kind}\" data-signal=\"{signal}\" data-plot=\"{kind}\" data-index=\"{index}\">\n<div class=\"head\"><h4>{}</h4><span class=\"axes\">{}</span></div>\n\
         <div class=\"area\" role=\"group\" aria-roledescription=\"plot\" tabindex=\"0\" aria-label=\"{}: {}\" aria-describedby=\"{id}\"></div>\n<figcaption id=\"{id}\">{}",
        escape(title),
        escape(axes),
        escape(title),
        escape(axes),
        escape(caption),
    ));
    if !words.reduced.is_empty() {
        page.push_str(&format!(
            " <span class=\"reduced\">{}</span>",
            escape(&words.reduced)
        ));
    }
    page.push_str(&format!(
        "<details><summary>In numbers</summary><p>{}</p></details></figcaption>\n</figure>\n",
        escape(&words.text)
    ));
}

fn signal_figures(
    page: &mut String,
    number: usize,
    (name, unit): (&str, &str),
    named: bool,
    pictures: &Pictures,
) {
    let per_second = quantity(&format!("{name},"), unit);
    let after = if pictures.same {
        "No effect was added to the simulation."
    } else if pictures.held_out {
        "After: each block predicted by a model that was fitted on the other blocks only (held out)."
    } else {
        "After: the fitted model."
    };
    if let Some(words) = &pictures.time {
        figure(
            page,
            &Figure {
                signal: number,
                kind: "time",
                index: 0,
                title: "Recorded and simulated".to_owned(),
                axes: format!("{per_second} over time, s"),
                caption: if pictures.same {
                    "Recorded and simulated."
                } else if !named {
                    "Recorded, as simulated before, and as simulated within what the model file leaves open."
                } else {
                    "Recorded, as simulated before, and as simulated with the effects above."
                }
                .to_owned(),
            },
            words,
        );
    }
    if let Some(words) = &pictures.residual {
        figure(
            page,
            &Figure {
                signal: number,
                kind: "residual",
                index: 0,
                title: "What is left: recorded − simulated".to_owned(),
                axes: format!("{unit} over time, s"),
                caption: if pictures.same {
                    after.to_owned()
                } else {
                    format!("{after} Hide “before” in the legend to see in detail what is left.")
                },
            },
            words,
        );
    }
    page.push_str("<div class=\"grid\">\n");
    for (index, (variable, words)) in pictures.against.iter().enumerate() {
        figure(
            page,
            &Figure {
                signal: number,
                kind: "against",
                index,
                title: format!("Residual against {variable}"),
                axes: format!("residual, {unit}"),
                caption: "Dots: samples. Line and band: median and 5 … 95 % in bins.".to_owned(),
            },
            words,
        );
    }
    if let Some(words) = &pictures.spectrum {
        figure(
            page,
            &Figure {
                signal: number,
                kind: "spectrum",
                index: 0,
                title: "Spectrum of the residual".to_owned(),
                axes: format!("{unit}/√Hz over frequency, Hz"),
                caption: "Amplitude spectral density of the residual.".to_owned(),
            },
            words,
        );
    }
    page.push_str("</div>\n");
}

fn holdouts(page: &mut String, report: &Report) {
    if report.holdouts.is_empty() {
        return;
    }
    page.push_str(
        "<section aria-labelledby=\"holdouts\">\n<h2 id=\"holdouts\">Other files, never fitted</h2>\n<table class=\"stack\">\n<thead><tr><th scope=\"col\">File</th><th scope=\"col\">Signal</th>\
         <th scope=\"col\" class=\"n\">RMSE before</th><th scope=\"col\" class=\"n\">RMSE after</th><th scope=\"col\" class=\"n\">Change</th></tr></thead>\n<tbody>\n",
    );
    for holdout in &report.holdouts {
        let unit = unit_of(report, &holdout.signal);
        let worse = holdout.rmse_after > holdout.rmse_before;
        page.push_str(&format!(
            "<tr>{}<td data-label=\"Signal\">{}</td><td class=\"n\" data-label=\"RMSE before\">{}</td><td class=\"n\" data-label=\"RMSE after\">{}</td>\
             <td class=\"n\" data-label=\"Change\"><strong{}>{}</strong></td></tr>\n",
            row_head(&holdout.file),
            code(&holdout.signal),
            escape(&quantity(&significant(holdout.rmse_before, 3), unit)),
            escape(&quantity(&significant(holdout.rmse_after, 3), unit)),
            if worse { " class=\"gap\"" } else { "" },
            change(holdout.rmse_before, holdout.rmse_after) + if worse { " (worse)" } else { "" },
        ));
    }
    page.push_str("</tbody>\n</table>\n</section>\n");
}

fn unexplained(page: &mut String, report: &Report) {
    page.push_str("<section aria-labelledby=\"unexplained\">\n<h2 id=\"unexplained\">What stays unexplained</h2>\n");
    if report.unexplained.is_empty() {
        page.push_str("<p>Nothing above noise and accuracy.</p>\n</section>\n");
        return;
    }
    page.push_str(
        "<table class=\"stack\">\n<thead><tr><th scope=\"col\">Signal</th><th scope=\"col\" class=\"n\">Left (RMS)</th><th scope=\"col\" class=\"n\">Noise floor</th>\
         <th scope=\"col\">A smooth function of the recorded inputs could explain</th><th scope=\"col\">Largest at</th></tr></thead>\n<tbody>\n",
    );
    for left in &report.unexplained {
        let unit = unit_of(report, &left.signal);
        let floor = report
            .signals
            .iter()
            .find(|signal| signal.name == left.signal)
            .map_or(f64::NAN, |signal| signal.noise_floor);
        page.push_str(&format!(
            "<tr><th scope=\"row\">{}</th><td class=\"n\" data-label=\"Left (RMS)\">{}</td><td class=\"n\" data-label=\"Noise floor\">{}</td><td data-label=\"Explainable\">{}</td><td data-label=\"Largest at\">{}</td></tr>\n",
            code(&left.signal),
            escape(&quantity(&significant(left.rmse, 3), unit)),
            escape(&quantity(&significant(floor, 3), unit)),
            bar(left.explainable_share, "energy"),
            left.location.as_ref().map_or_else(
                || "no place stands out".to_owned(),
                |location| {
                    escape(&format!(
                        "{}: {} of its energy in {} of the samples",
                        place(location),
                        percent(location.energy_share),
                        percent(location.sample_share)
                    ))
                }
            ),
        ));
    }
    page.push_str("</tbody>\n</table>\n");
    for left in &report.unexplained {
        if let Some(form) = &left.form {
            page.push_str(&format!(
                "<p>What is left of {} has a simple form: <strong>{}</strong>. With it {} would be left, on parts of the recording that it was not fitted on. It is a description, and no effect of the library.</p>\n",
                code(&left.signal),
                escape(&form.said()),
                escape(&quantity(&significant(form.rmse, 3), unit_of(report, &left.signal))),
            ));
        }
    }
    page.push_str(
        "<p class=\"hint\">The share that a smooth function could explain, on held-out blocks, is physics or wiring that the library does not hold. The rest depends on something that was not recorded, or is noise.</p>\n</section>\n",
    );
}

fn list(page: &mut String, id: &str, title: &str, lines: &[String], ordered: bool) {
    if lines.is_empty() {
        return;
    }
    let tag = if ordered { "ol" } else { "ul" };
    page.push_str(&format!(
        "<section aria-labelledby=\"{id}\">\n<h2 id=\"{id}\">{title}</h2>\n<{tag}>\n"
    ));
    for line in lines {
        page.push_str(&format!("<li>{}</li>\n", escape(line)));
    }
    page.push_str(&format!("</{tag}>\n</section>\n"));
}

fn foot(page: &mut String, report: &Report) {
    page.push_str(&format!(
        "<footer><p>twin {} · {} s · seed {} · report format {}. The same numbers are in <code>report.json</code>, the extended model in <code>model.toml</code>.</p></footer>\n",
        escape(&report.version),
        significant(report.seconds, 2),
        report.seed,
        report.schema
    ));
}
