//! docs/proof: the pages, out of the tables.

use std::{fmt::Write as _, fs, path::Path};

use anyhow::{Context, Result};

use crate::{
    score::{Outcome, PLAIN},
    stats::Share,
    summary::{
        Confusion, Counts, DETECTED, Detection, FormLine, MethodLine, RealLine, Summary,
        kind_title, shown,
    },
    tool::Named,
};

/// Order and words of the outcomes in tables.
const OUTCOMES: [(Outcome, &str); 10] = [
    (Outcome::Exact, "exact"),
    (Outcome::Class, "class"),
    (Outcome::Quiet, "quiet, rightly"),
    (Outcome::Part, "part"),
    (Outcome::Unknown, "unknown"),
    (Outcome::Silent, "silent, weak"),
    (Outcome::Missed, "missed"),
    (Outcome::Wrong, "wrong"),
    (Outcome::Error, "failed"),
    (Outcome::Unscored, "no truth"),
];

/// Columns of the confusion matrix that are no names.
const NO_NAMES: [&str; 6] = ["class", "part", "allowed", "unknown", "missed", "error"];

fn outcome(outcome: Outcome) -> &'static str {
    OUTCOMES
        .iter()
        .find(|(one, _)| *one == outcome)
        .map_or("", |(_, word)| word)
}

/// Three significant digits, as a person would write it.
pub fn number(value: f64) -> String {
    if value == 0.0 || !value.is_finite() {
        return format!("{value}");
    }
    let digits = 2 - value.abs().log10().floor() as i32;
    if digits > 6 {
        return format!("{value:.2e}");
    }
    if digits < 0 {
        return format!("{value:.0}");
    }
    format!("{value:.*}", usize::try_from(digits).unwrap_or(0))
}

/// What a program said, in one cell of a table.
fn cell(error: &str) -> String {
    let line = error.replace(['|', '\n'], " ");
    let words: Vec<&str> = line.split_whitespace().collect();
    let mut short = words.join(" ");
    if let Some((end, _)) = short.char_indices().nth(160) {
        short.truncate(end);
        short.push('…');
    }
    short
}

fn maybe(value: Option<f64>) -> String {
    value.map_or("–".to_owned(), number)
}

fn names(named: &[Named]) -> String {
    if named.is_empty() {
        return "nothing".to_owned();
    }
    let mut words = Vec::new();
    for one in named {
        let word = if one.equals.is_empty() {
            one.id.clone()
        } else {
            format!("{} (or {})", one.id, one.equals.join(", "))
        };
        // The same in the current and in the charge view.
        if !words.contains(&word) {
            words.push(word);
        }
    }
    words.join("; ")
}

fn required(lists: &[Vec<String>]) -> String {
    lists
        .iter()
        .map(|list| list.join(" or "))
        .collect::<Vec<_>>()
        .join("; ")
}

fn short(share: &Share) -> String {
    if share.of == 0 {
        return "–".to_owned();
    }
    format!("{:.0} % of {}", 100.0 * share.value(), share.of)
}

fn picture(text: &mut String, folder: &Path, file: &str, what: &str) {
    if folder.join(file).exists() {
        let _ = writeln!(text, "![{what}]({file})\n");
    }
}

/// Writes index.md and tables.md into `folder`, in which the pictures are already.
pub fn write(summary: &Summary, folder: &Path) -> Result<()> {
    fs::create_dir_all(folder).with_context(|| format!("making {}", folder.display()))?;
    for (name, text) in [
        ("index.md", index(summary, folder)),
        ("tables.md", tables(summary)),
    ] {
        let path = folder.join(name);
        fs::write(&path, text).with_context(|| format!("writing {}", path.display()))?;
    }
    Ok(())
}

fn counts_table(
    text: &mut String,
    lines: &[&Counts],
    first: &str,
    title: impl Fn(&Counts) -> String,
) {
    let used: Vec<&(Outcome, &str)> = OUTCOMES
        .iter()
        .filter(|(one, _)| lines.iter().any(|line| line.outcomes.contains_key(one)))
        .collect();
    let _ = write!(text, "| {first} | cases |");
    for (_, word) in &used {
        let _ = write!(text, " {word} |");
    }
    text.push_str(" right | confidently wrong |\n|---|---|");
    text.push_str(&"---|".repeat(used.len() + 2));
    text.push('\n');
    for line in lines {
        let _ = write!(text, "| {} | {} |", title(line), line.cases);
        for (one, _) in &used {
            let _ = write!(text, " {} |", line.outcomes.get(one).copied().unwrap_or(0));
        }
        let _ = writeln!(
            text,
            " {} | {} |",
            short(&line.right),
            short(&line.confidently_wrong)
        );
    }
    text.push('\n');
}

/// A line's name with the letters of who made its data.
fn with_kinds(line: &Counts) -> String {
    let letters: Vec<String> = line.kinds.iter().map(|kind| format!("({kind})")).collect();
    format!("{} {}", line.name, letters.join(" "))
}

fn index(summary: &Summary, folder: &Path) -> String {
    let mut text = String::new();
    let quick = summary.plan != "full";
    text.push_str("# Where `twin explain` is right, wrong and silent\n\n");
    if quick {
        text.push_str("**The quick part of the campaign only.**\n\n");
    }
    if summary.cases < summary.planned {
        let _ = writeln!(
            text,
            "**{} of the plan's {} cases: the run was ended before the rest, and nothing was chosen but the time.**\n",
            summary.cases, summary.planned
        );
    }
    let kinds: Vec<String> = summary
        .by_kind
        .iter()
        .map(|kind| format!("{} {}", kind.cases, kind_title(&kind.name)))
        .collect();
    let _ = writeln!(
        text,
        "{} cases with data: {}. An effect is concealed in a recording, the tool gets the recording, the model as designed and, of made \
         data, the noise of the reading, and what it says is compared with a truth that was sealed before. `cargo xtask prove` makes all \
         of this anew; [how](method.md), [all tables](tables.md), [every case](results.json).\n",
        summary.with_data,
        kinds.join(", ")
    );
    text.push_str(
        "- **Who made the data** stands in every table: (a) real recordings; (b) simulators that others wrote; (c) others' solver with our \
         equations; (d) our own generator. What stands on (d) alone is no proof of anything but the matrix it fills.\n\
         - **right**: every hidden effect is named, or is in a class that is said to be one and the same here. **unknown**: said that \
         something is left that nothing accounts for. **missed**: silence though the effect is at three times the just visible strength. \
         **wrong**: something is named that is not there, right names beside it or not; **confidently**: under the verdict *explained* or \
         *partly explained*.\n\
         - Shares carry Wilson's 95 % interval, which takes cases as independent: of the same circuit or cell they are not quite. *Not for \
         sure*: the interval reaches beyond what is wanted. *just visible* (strength 1): the effect moves the reading by 0.3 of the noise's rms.\n\n",
    );

    in_short(&mut text, summary);
    text.push_str(
        "## Against what was wanted\n\n| figure | wanted | found | |\n|---|---|---|---|\n",
    );
    for target in &summary.targets {
        let met = match target.met {
            Some(true) if target.sure == Some(false) => "met, not for sure",
            Some(true) => "met",
            Some(false) => "**MISSED**",
            None => "not measured",
        };
        let _ = writeln!(
            text,
            "| {} | {} | {} | {met} |",
            target.what, target.wanted, target.found
        );
    }
    text.push('\n');

    text.push_str("## Real recordings (a)\n\nWhat is right was [written down](../../proof/expected.toml) from what the publishers measured before the campaign ran. \
        Held out: rms on a file or piece that was never fitted.\n\n");
    picture(
        &mut text,
        folder,
        "real.png",
        "Held-out error on each real recording: as designed, twin, today's methods",
    );
    real_table(&mut text, &summary.real);

    let others: Vec<&Counts> = summary
        .by_group
        .iter()
        .filter(|line| line.name.contains("PyBaMM") || line.name.contains("ngspice"))
        .collect();
    if !others.is_empty() {
        text.push_str("## Simulators that others wrote (b)\n\n");
        picture(
            &mut text,
            folder,
            "others.png",
            "What was hidden in the data of other people's simulators, and what was said",
        );
        counts_table(&mut text, &others, "made by", with_kinds);
        confusion_table(&mut text, &summary.confusion, "b");
    }

    text.push_str("## Nothing concealed: false alarms\n\n");
    picture(
        &mut text,
        folder,
        "false-alarms.png",
        "Share of clean recordings in which something is named, by twin and by today's methods",
    );
    text.push_str(
        "| data | an effect named | anything but \"no mismatch\" said |\n|---|---|---|\n",
    );
    for line in &summary.clean {
        let _ = writeln!(
            text,
            "| {} | {} | {} |",
            kind_title(&line.kind),
            shown(&line.named),
            shown(&line.anything)
        );
    }
    let cells = &summary.clean_cells;
    if cells.named.of > 0 {
        let _ = writeln!(
            text,
            "\nNot among them: {} cells by PyBaMM (b) in which nothing is concealed either, but whose design is a circuit fitted to \
             them, which leaves something. An effect is named in {}, anything but \"no mismatch\" said of {}.",
            cells.named.of,
            shown(&cells.named),
            shown(&cells.anything)
        );
    }
    text.push('\n');

    forms_table(&mut text, &summary.forms);

    if !summary.methods.is_empty() {
        text.push_str("## Beside what people use today\n\nThe same files, the same held-out data, judged by the same rule; twin on all of these cases, PyBOP on the batteries among them. A straight line names a sensor's gain and \
            offset: nothing of a battery. What failed counts as not right. \
            Processor time, without the start of a program.\n\n");
        picture(
            &mut text,
            folder,
            "methods.png",
            "Right names and time, twin and today's methods",
        );
        methods_table(&mut text, summary);
    }

    text.push_str("## One concealed effect, by its strength (d)\n\nOur own generator: it shows where the tool begins to see an effect, not that it would in nature.\n\n");
    picture(
        &mut text,
        folder,
        "detection.png",
        "Share of right answers of each effect over its strength",
    );
    for (kind, (cases, median, most, within)) in &summary.over_oracle {
        let _ = writeln!(
            text,
            "Held-out error over that of the true model, {cases} cases of {}: median {}, 90 % below {}; at most 1.1 in {}.\n",
            kind_title(kind),
            number(*median),
            number(*most),
            shown(within)
        );
    }
    picture(
        &mut text,
        folder,
        "coverage.png",
        "Share of 95 % intervals that have the truth in them, by effect",
    );
    for (kind, (cases, low, middle, high)) in &summary.overlap {
        let _ = writeln!(
            text,
            "Overlap of the named place with the true one (samples in both over samples in either), {cases} cases of {}: median {}, quartiles {} and {}.\n",
            kind_title(kind),
            number(*middle),
            number(*low),
            number(*high)
        );
    }
    if summary.without.cases > 0 {
        text.push_str("### The true effect taken out of the library (of our own equations)\n\nRight is *unknown*. A name is wrong, even one that fits as well.\n\n");
        counts_table(&mut text, &[&summary.without], "data", with_kinds);
    }

    text.push_str("## The emulated board (our emulator, the unmodified image)\n\n");
    picture(
        &mut text,
        folder,
        "board.png",
        "Error of the board's current before and after the calibration",
    );
    board_table(&mut text, summary);

    text.push_str("## Misses\n\n");
    misses(&mut text, summary);
    let _ = writeln!(
        text,
        "\nProgram under test: SHA-256 `{}`, one processor per explanation, {} processors.",
        summary.tool_sha256, summary.processors
    );
    text
}

/// Real recordings by who says what is right, and how many intervals hold.
fn by_standing(text: &mut String, summary: &Summary) {
    let of = |standing: &str| {
        let lines = summary.real.iter().filter(|line| line.standing == standing);
        Share::of(lines, |line| line.outcome.right())
    };
    let _ = writeln!(
        text,
        "  By what the publisher measured {}, by what follows from other tests of the same publisher {}. Several are of one object (a \
         GPU, a cell): the interval is too narrow. Of the published parameters with a reported interval, it meets what counts as right \
         in {}.",
        short(&of("published")),
        short(&of("beside")),
        short(&summary.published)
    );
}

/// The answer to "and, does it work?".
fn in_short(text: &mut String, summary: &Summary) {
    text.push_str("## In short\n\n");
    let kind = |letter: &str| summary.by_kind.iter().find(|line| line.name == letter);
    for (letter, what) in [
        (
            "a",
            "Real recordings of which somebody else has measured what is right",
        ),
        ("b", "Simulators that others wrote"),
        ("c", "Others' solver with our equations"),
        ("d", "Our own generator, no headline"),
    ] {
        if let Some(line) = kind(letter) {
            let _ = writeln!(
                text,
                "- {what} ({letter}): right {}; wrong {}, confidently {}.",
                shown(&line.right),
                short(&line.wrong),
                short(&line.confidently_wrong)
            );
            if letter == "a" {
                by_standing(text, summary);
            }
        }
    }
    let plain: Vec<String> = summary
        .just_plain
        .iter()
        .map(|(kind, right)| format!("({kind}) {}", shown(right)))
        .collect();
    if !plain.is_empty() {
        let _ = writeln!(
            text,
            "- One effect at three times the just visible strength, right: {}.",
            plain.join("; ")
        );
    }
    for line in &summary.clean {
        let _ = write!(
            text,
            "- Nothing concealed ({}): an effect named in {}, anything but \"no mismatch\" said of {}",
            line.kind,
            shown(&line.named),
            short(&line.anything)
        );
        let theirs: Vec<String> = summary
            .methods
            .iter()
            .filter(|method| method.names_effects || method.name == "twin")
            .filter_map(|method| {
                let share = method.false_alarms.get(&line.kind)?;
                Some(format!("{} {} of {}", method.name, share.count, share.of))
            })
            .collect();
        if theirs.is_empty() {
            text.push_str("; today's methods were given none of these.\n");
        } else {
            let _ = writeln!(
                text,
                "; where today's methods were run too, named by: {}.",
                theirs.join(", ")
            );
        }
    }
    for line in &summary.outside {
        let _ = writeln!(
            text,
            "- The effect is not in the library ({}): named another in {}, confidently in {}.",
            line.name,
            shown(&line.wrong),
            short(&line.confidently_wrong)
        );
    }
    let with_form = |line: &&FormLine| !line.right.is_empty();
    let (cases, told) = (summary.forms.iter().filter(with_form))
        .fold((0, 0), |(cases, told), line| {
            (cases + line.cases, told + line.told)
        });
    let another: usize = summary.forms.iter().map(|line| line.another).sum();
    if cases > 0 {
        let _ = writeln!(
            text,
            "- Of these, what is left has a true simple form in {cases} cases: told in {told}. Another is told in {another} of {}.",
            summary.forms.iter().map(|line| line.cases).sum::<usize>()
        );
    }
    if let Some(target) = summary
        .targets
        .iter()
        .find(|target| target.what.starts_with("real recordings on which"))
    {
        let _ = writeln!(
            text,
            "- Real recordings on which twin's error on unseen data is below that of every one of today's methods: {}.",
            target.found
        );
    }
    let over_ideal = summary
        .board
        .iter()
        .filter_map(|line| line.calibrated.as_ref())
        .filter(|one| one.after_a < one.before_a)
        .map(|one| one.after_a / one.ideal_a)
        .collect::<Vec<f64>>();
    let worst = over_ideal.iter().copied().fold(0.0, f64::max);
    if !summary.board.is_empty() {
        let _ = writeln!(
            text,
            "- Emulated board: {} of {} concealed sensor errors were made smaller on another drive by writing the tool's calibration back, \
             to at most {worst:.2} times the error of a board without any.",
            over_ideal.len(),
            summary.board.len()
        );
    }
    text.push('\n');
}

/// Forms of what is left, effect by effect.
fn forms_table(text: &mut String, lines: &[FormLine]) {
    if lines.is_empty() {
        return;
    }
    text.push_str(
        "## Not in the library: the form of what is left\n\nWhere no effect accounts for a mismatch, the report says which simple function of the \
         recorded inputs takes nineteen twentieths of what is left beyond the noise, if one does: no name, but what to look for. Which is true of which effect was \
         written down [before](../../proof/src/forms.rs).\n\n\
         | hidden | data | true form | cases | told | another told |\n|---|---|---|---|---|---|\n",
    );
    for line in lines {
        let right = if line.right.is_empty() {
            "none".to_owned()
        } else {
            line.right.join(" or ")
        };
        let told = if line.right.is_empty() {
            "–".to_owned()
        } else {
            line.told.to_string()
        };
        let _ = writeln!(
            text,
            "| {} | ({}) | {right} | {} | {told} | {} |",
            line.effect, line.kind, line.cases, line.another
        );
    }
    text.push('\n');
}

fn real_table(text: &mut String, lines: &[RealLine]) {
    text.push_str("| recording | right is | by | said | | held out | lowest of today's methods |\n|---|---|---|---|---|---|---|\n");
    for line in lines {
        let by = match line.standing.as_str() {
            "published" => "publisher",
            "beside" => "publisher's other tests",
            _ => "nobody",
        };
        let best = line
            .methods
            .iter()
            .filter(|(_, found)| found.error.is_none())
            .filter_map(|(name, found)| Some((name, found.held_out_rms?)))
            .min_by(|a, b| a.1.total_cmp(&b.1))
            .map_or("–".to_owned(), |(name, rms)| {
                format!("{} ({name})", number(rms))
            });
        let mut judged = outcome(line.outcome).to_owned();
        if line.confident {
            judged = format!("**{judged}**, confidently");
        }
        if let Some(error) = &line.error {
            judged.push_str(&format!(" ({})", cell(error)));
        }
        let _ = writeln!(
            text,
            "| {} | {} | {by} | {}: {} | {judged} | {} → {} | {best} |",
            line.id,
            if line.required.is_empty() {
                "–".to_owned()
            } else {
                required(&line.required)
            },
            line.verdict,
            names(&line.named),
            maybe(line.before),
            maybe(line.after),
        );
    }
    text.push('\n');
    let published: Vec<_> = lines
        .iter()
        .flat_map(|line| line.published.iter().map(move |one| (line, one)))
        .collect();
    if published.is_empty() {
        return;
    }
    text.push_str("| recording | parameter | published | counts as right | said, with 95 % interval | |\n|---|---|---|---|---|---|\n");
    for (line, one) in published {
        let said = match (one.said, one.interval) {
            (Some(value), Some((low, high))) => {
                format!("{} ({} … {})", number(value), number(low), number(high))
            }
            (Some(value), None) => number(value),
            (None, _) => "not named".to_owned(),
        };
        let judged = match one.said {
            Some(value) if (one.low..=one.high).contains(&value) => "right",
            Some(_) => "**off**",
            None => "–",
        };
        let _ = writeln!(
            text,
            "| {} | {} | {} | {} … {} | {said} | {judged} |",
            line.id,
            one.name,
            number(one.published),
            number(one.low),
            number(one.high)
        );
    }
    text.push('\n');
}

fn methods_table(text: &mut String, summary: &Summary) {
    text.push_str("| data | method | cases | right | wrong | false alarms | held out over the true model, median | processor time, median | failed |\n|---|---|---|---|---|---|---|---|---|\n");
    for line in &summary.methods {
        let right = if line.names_effects || line.name == "twin" {
            (short(&line.right), short(&line.wrong), false_alarms(line))
        } else {
            ("names none".to_owned(), "–".to_owned(), "–".to_owned())
        };
        let _ = writeln!(
            text,
            "| {} | {} | {} | {} | {} | {} | {} | {} s | {} |",
            line.data,
            line.name,
            line.cases,
            right.0,
            right.1,
            right.2,
            maybe(line.over_oracle),
            maybe(line.seconds),
            line.errors
        );
    }
    text.push('\n');
}

/// By who made the data.
fn false_alarms(line: &MethodLine) -> String {
    let shares = line.false_alarms.iter();
    let shares: Vec<String> = shares
        .map(|(kind, share)| format!("({kind}) {} of {}", share.count, share.of))
        .collect();
    if shares.is_empty() {
        "–".to_owned()
    } else {
        shares.join(", ")
    }
}

fn board_table(text: &mut String, summary: &Summary) {
    if summary.board.is_empty() {
        text.push_str("Not run.\n\n");
        return;
    }
    text.push_str("| concealed in the sensors | said | | second drive, error of the current, rms | a board without error | error of its charge |\n|---|---|---|---|---|---|\n");
    for line in &summary.board {
        let (current, ideal, charge) = match &line.calibrated {
            Some(one) => (
                format!("{} → {} A", number(one.before_a), number(one.after_a)),
                format!("{} A", number(one.ideal_a)),
                format!(
                    "{} → {} C",
                    number(one.charge_before_c),
                    number(one.charge_after_c)
                ),
            ),
            None => (
                line.error
                    .clone()
                    .unwrap_or("no calibration was written".to_owned()),
                "–".to_owned(),
                "–".to_owned(),
            ),
        };
        let _ = writeln!(
            text,
            "| {} | {} | {} | {current} | {ideal} | {charge} |",
            line.concealed,
            names(&line.named),
            line.outcome.map_or("", outcome)
        );
    }
    text.push('\n');
}

fn misses(text: &mut String, summary: &Summary) {
    for target in summary
        .targets
        .iter()
        .filter(|target| target.met == Some(false))
    {
        let _ = writeln!(
            text,
            "- {}: {}, wanted {}",
            target.what, target.found, target.wanted
        );
    }
    for line in &summary.real {
        if matches!(
            line.outcome,
            Outcome::Wrong | Outcome::Missed | Outcome::Error | Outcome::Part | Outcome::Unknown
        ) {
            let _ = writeln!(
                text,
                "- {}: {} (right: {}; said: {})",
                line.id,
                outcome(line.outcome),
                required(&line.required),
                names(&line.named)
            );
        }
    }
    for line in &summary.real {
        for one in &line.published {
            let off = one
                .said
                .filter(|value| !(one.low..=one.high).contains(value));
            let missed = one
                .interval
                .filter(|(low, high)| *low > one.high || *high < one.low);
            if off.is_none() && missed.is_none() {
                continue;
            }
            let interval = one.interval.map_or(String::new(), |(low, high)| {
                format!(" ({} … {})", number(low), number(high))
            });
            let _ = writeln!(
                text,
                "- {}: {} {}{interval}, right is {} … {}",
                line.id,
                one.name,
                maybe(one.said),
                number(one.low),
                number(one.high)
            );
        }
    }
    let mut beaten: Vec<(&str, Vec<&str>)> = Vec::new();
    for (id, method) in &summary.beaten_on_real {
        match beaten.last_mut() {
            Some((last, methods)) if *last == id.as_str() => methods.push(method.as_str()),
            _ => beaten.push((id.as_str(), vec![method.as_str()])),
        }
    }
    for (id, methods) in beaten {
        let _ = writeln!(
            text,
            "- {id}: lower held-out error by {}",
            methods.join(", ")
        );
    }
    for kind in ["b", "c", "d"] {
        let lines = || summary.detection.iter().filter(|line| line.kind == kind);
        let at = |line: &Detection, strength: f64| {
            let found = line.strengths.iter().find(|(one, _)| *one == strength);
            found.map(|(_, share)| *share)
        };
        let weak = |share: &Share| share.value() < DETECTED;
        let at_plain: Vec<String> = lines()
            .filter_map(|line| Some((line, at(line, PLAIN).filter(weak)?)))
            .map(|(line, share)| format!("{} {} of {}", line.effect, share.count, share.of))
            .collect();
        if !at_plain.is_empty() {
            let _ = writeln!(
                text,
                "- not right in 95 % at three times the just visible strength ({kind}): {}",
                at_plain.join(", ")
            );
        }
        let larger: Vec<String> = lines()
            .flat_map(|line| {
                line.strengths
                    .iter()
                    .map(move |(at, share)| (line, *at, share))
            })
            .filter(|(_, at, share)| *at > PLAIN && weak(share))
            .map(|(line, at, share)| {
                format!("{} at {at} {} of {}", line.effect, share.count, share.of)
            })
            .collect();
        if !larger.is_empty() {
            let _ = writeln!(
                text,
                "- not right in 95 % at a larger strength ({kind}): {}",
                larger.join(", ")
            );
        }
    }
    if !summary.errors.is_empty() {
        let _ = writeln!(
            text,
            "- failed: {} cases ([tables](tables.md))",
            summary.errors.len()
        );
    }
}

fn confusion_table(text: &mut String, lines: &[Confusion], kind: &str) {
    let lines: Vec<&Confusion> = lines.iter().filter(|line| line.kind == kind).collect();
    if lines.is_empty() {
        return;
    }
    text.push_str("| hidden (strength 3 and more) | itself |");
    for word in NO_NAMES {
        let _ = write!(text, " {word} |");
    }
    text.push_str(" another |\n|---|---|");
    text.push_str(&"---|".repeat(NO_NAMES.len() + 1));
    text.push('\n');
    for line in lines {
        let count = |word: &str| line.said.get(word).copied().unwrap_or(0);
        let _ = write!(
            text,
            "| {} | {} |",
            line.effect,
            count(&line.effect) + count("exact")
        );
        for word in NO_NAMES {
            let _ = write!(text, " {} |", count(word));
        }
        let others: Vec<String> = line
            .said
            .iter()
            .filter(|(word, _)| {
                **word != line.effect && !NO_NAMES.contains(&word.as_str()) && *word != "exact"
            })
            .map(|(word, count)| format!("{word} {count}"))
            .collect();
        let _ = writeln!(text, " {} |", others.join(", "));
    }
    text.push('\n');
}

fn tables(summary: &Summary) -> String {
    let mut text = String::from(
        "# Tables of the campaign\n\n[What they mean](index.md), [how they come about](method.md).\n\n",
    );
    text.push_str("## By who made the data\n\n");
    let mut kinds: Vec<&Counts> = summary.by_kind.iter().collect();
    kinds.push(&summary.others_together);
    counts_table(&mut text, &kinds, "data", |line| {
        if line.name.len() == 1 {
            kind_title(&line.name).to_owned()
        } else {
            line.name.clone()
        }
    });
    for line in &summary.by_kind {
        let _ = writeln!(
            text,
            "- {}: {}",
            kind_title(&line.name),
            line.makers.join("; ")
        );
    }
    text.push_str("\n## By what the cases are for\n\n");
    counts_table(
        &mut text,
        &summary.by_group.iter().collect::<Vec<_>>(),
        "cases",
        with_kinds,
    );
    for kind in ["b", "c", "d"] {
        if summary.confusion.iter().any(|line| line.kind == kind) {
            let _ = writeln!(text, "## Confusion, {}\n", kind_title(kind));
            confusion_table(&mut text, &summary.confusion, kind);
        }
    }
    text.push_str("## Detection limit (single effects)\n\nThe smallest strength from which on at least 95 % are right.\n\n| effect | data | limit |");
    let mut strengths: Vec<f64> = summary
        .detection
        .iter()
        .flat_map(|line| line.strengths.iter().map(|(strength, _)| *strength))
        .collect();
    strengths.sort_by(f64::total_cmp);
    strengths.dedup();
    for strength in &strengths {
        let _ = write!(text, " {strength} |");
    }
    text.push_str("\n|---|---|---|");
    text.push_str(&"---|".repeat(strengths.len()));
    text.push('\n');
    for line in &summary.detection {
        let _ = write!(
            text,
            "| {} | ({}) | {} |",
            line.effect,
            line.kind,
            line.limit
                .map_or("none".to_owned(), |limit| limit.to_string())
        );
        for strength in &strengths {
            let share = line.strengths.iter().find(|(one, _)| one == strength);
            let _ = write!(
                text,
                " {} |",
                share.map_or("–".to_owned(), |(_, share)| format!(
                    "{}/{}",
                    share.count, share.of
                ))
            );
        }
        text.push('\n');
    }
    text.push_str("\n## Parameters and their 95 % intervals\n\nOf cases that were named rightly. A gain's error is relative to its distance from 1.\n\n| data | effect | parameter | cases | median error | interval has the truth |\n|---|---|---|---|---|---|\n");
    for line in &summary.parameters {
        let _ = writeln!(
            text,
            "| ({}) | {} | {} | {} | {} | {} |",
            line.kind,
            line.effect,
            line.name,
            line.cases,
            line.median_error
                .map_or("–".to_owned(), |error| format!("{:.1} %", 100.0 * error)),
            shown(&line.covered)
        );
    }
    text.push_str("\n## What it took\n\nSeconds of the wall clock, one processor each.\n\n| part | s |\n|---|---|\n");
    for (part, seconds) in &summary.parts_s {
        let _ = writeln!(text, "| {part} | {seconds:.0} |");
    }
    if !summary.not_made.is_empty() {
        text.push_str("\n## Not made\n\nThe maker cannot have such a case (an effect of that strength on that drive); it counts nowhere.\n\n");
        for (id, why) in &summary.not_made {
            let _ = writeln!(text, "- {id}: {}", cell(why));
        }
    }
    if !summary.errors.is_empty() {
        text.push_str("\n## Failed\n\n");
        for (id, why) in &summary.errors {
            let _ = writeln!(text, "- {id}: {}", cell(why));
        }
    }
    let bad: Vec<_> = summary
        .records
        .iter()
        .filter(|line| line.outcome == Some(Outcome::Wrong))
        .collect();
    if !bad.is_empty() {
        text.push_str(
            "\n## Every wrong answer\n\n| case | data | hidden | said | |\n|---|---|---|---|---|\n",
        );
        for line in bad {
            let _ = writeln!(
                text,
                "| {} | ({}) | {} | {}: {} | {} |",
                line.id,
                line.kind,
                line.truth.join("; "),
                line.verdict,
                line.named.join("; "),
                if line.confident { "confidently" } else { "" }
            );
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_three_digits() {
        assert_eq!(number(0.0), "0");
        assert_eq!(number(123.4), "123");
        assert_eq!(number(0.012345), "0.0123");
        assert_eq!(number(-1.2345), "-1.23");
        assert_eq!(number(12345.6), "12346");
    }
}
