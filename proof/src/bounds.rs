//! What the quick campaign has to hold. Loose enough for its few cases, tight enough that a tool that guesses fails.

use crate::{
    run::Record,
    score::Outcome,
    summary::{Summary, shown},
};

/// Of all scored cases.
const CONFIDENTLY_WRONG: f64 = 0.10;
/// Of the clean recordings: an effect is named.
const FALSE_ALARMS: f64 = 0.12;
/// Right name or class, strength 3 and more.
const RIGHT: f64 = 0.75;

/// What does not hold, in words; nothing if all does.
pub fn broken(summary: &Summary, records: &[Record]) -> Vec<String> {
    let mut broken = Vec::new();
    for (id, why) in summary.not_made.iter().chain(&summary.errors) {
        broken.push(format!("{id}: {why}"));
    }
    for record in records {
        if record.truth.is_some() && record.truth_sha256.len() != 64 {
            broken.push(format!(
                "{}: the truth was not sealed",
                record.planned.case.id
            ));
        }
    }
    if summary.same != Some(true) {
        broken
            .push("the same input gave two different reports, or no case was run twice".to_owned());
    }
    let scored = summary
        .by_kind
        .iter()
        .map(|kind| kind.confidently_wrong)
        .fold((0, 0), |(count, of), share| {
            (count + share.count, of + share.of)
        });
    if scored.1 == 0 || scored.0 as f64 > CONFIDENTLY_WRONG * scored.1 as f64 {
        broken.push(format!(
            "confidently wrong in {} of {}, allowed {:.0} %",
            scored.0,
            scored.1,
            100.0 * CONFIDENTLY_WRONG
        ));
    }
    for line in &summary.clean {
        if line.named.value() > FALSE_ALARMS {
            broken.push(format!(
                "false alarms on clean recordings ({}): {}, allowed {:.0} %",
                line.kind,
                shown(&line.named),
                100.0 * FALSE_ALARMS
            ));
        }
    }
    if summary.clean.is_empty() {
        broken.push("no clean recording was run".to_owned());
    }
    let right = summary
        .by_kind
        .iter()
        .map(|kind| kind.right)
        .fold((0, 0), |(count, of), share| {
            (count + share.count, of + share.of)
        });
    if right.1 == 0 || (right.0 as f64) < RIGHT * right.1 as f64 {
        broken.push(format!(
            "right in {} of {}, wanted {:.0} %",
            right.0,
            right.1,
            100.0 * RIGHT
        ));
    }
    let published: Vec<_> = summary
        .real
        .iter()
        .filter(|line| line.standing == "published" && line.outcome == Outcome::Missed)
        .collect();
    for line in published {
        broken.push(format!(
            "{}: nothing was found in a real recording",
            line.id
        ));
    }
    broken
}
