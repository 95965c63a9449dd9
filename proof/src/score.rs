//! Right, a class, unknown, missed, wrong: what the tool said against the opened truth.

use serde::{Deserialize, Serialize};

use crate::{
    case::{Place, Truth},
    table::Table,
    tool::{Location, Named, Parameter, Said},
};

/// From this strength on silence is a miss: an effect that moves the reading by nine tenths of the noise.
pub const PLAIN: f64 = 3.0;

/// How a case went.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Outcome {
    /// Every hidden effect is named, and nothing else.
    Exact,
    /// Every hidden effect is named or in a class that is.
    Class,
    /// Some hidden effects are named, nothing wrong is.
    Part,
    /// Something is said to be left that nothing accounts for.
    Unknown,
    /// No mismatch, on a recording in which nothing is hidden.
    Quiet,
    /// No mismatch, where what is hidden is weak.
    Silent,
    /// No mismatch, where what is hidden is plain to see.
    Missed,
    /// Something is named that is not there.
    Wrong,
    /// The program failed or took too long.
    Error,
    /// Nobody knows what is right.
    Unscored,
}

impl Outcome {
    /// The right name, or a class with it.
    pub fn right(self) -> bool {
        matches!(self, Self::Exact | Self::Class)
    }
}

/// How a case went, and what stands in the confusion matrix.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Judgement {
    /// How it went.
    pub outcome: Outcome,
    /// Wrong, and with the verdict "explained" or "partly explained".
    pub confident: bool,
    /// Column of the confusion matrix: an id, or class, part, unknown, missed, error.
    pub said: String,
}

/// A parameter against its truth.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    /// Effect.
    pub effect: String,
    /// Its parameter.
    pub name: String,
    /// As it is.
    pub truth: f64,
    /// As said.
    pub value: f64,
    /// Whether the 95 % interval has the truth in it; nothing if no interval is given.
    pub covered: Option<bool>,
}

/// What the tool said against the truth. `said` is nothing if it failed; `removed` are effects taken out of the library.
pub fn judge(truth: &Truth, strength: f64, removed: &[String], said: Option<&Said>) -> Judgement {
    let judgement = |outcome, confident, said: &str| Judgement {
        outcome,
        confident,
        said: said.to_owned(),
    };
    let Some(said) = said else {
        return judgement(Outcome::Error, false, "error");
    };
    if truth.unknown() {
        return judgement(Outcome::Unscored, false, "unscored");
    }
    let is_true = |id: &String| {
        truth.allowed.contains(id) || truth.required.iter().flatten().any(|one| one == id)
    };
    let acceptable = |named: &Named| is_true(&named.id) || named.equals.iter().any(is_true);
    if let Some(wrong) = said.named.iter().find(|named| !acceptable(named)) {
        let confident = matches!(said.verdict.as_str(), "explained" | "partly-explained");
        return judgement(Outcome::Wrong, confident, &wrong.id);
    }
    let quiet = said.verdict == "no-mismatch";
    let first = said.named.first().map(|named| named.id.as_str());

    // Without the true effect in the library, or with nothing hidden, there is nothing to find.
    let wanted: Vec<&Vec<String>> = if removed.is_empty() {
        truth.required.iter().collect()
    } else {
        Vec::new()
    };
    if wanted.is_empty() {
        let hidden = !truth.required.is_empty() || !truth.effects.is_empty();
        return match (first, quiet) {
            (Some(_), _) => judgement(Outcome::Class, false, "allowed"),
            (None, false) => judgement(Outcome::Unknown, false, "unknown"),
            (None, true) if !hidden => judgement(Outcome::Quiet, false, "quiet"),
            (None, true) if strength >= PLAIN => judgement(Outcome::Missed, false, "missed"),
            (None, true) => judgement(Outcome::Silent, false, "missed"),
        };
    }

    // By its own id with no doubt, or within a class.
    let exact = |named: &Named, list: &Vec<String>| {
        list.contains(&named.id) && named.equals.iter().all(|other| list.contains(other))
    };
    let within = |named: &Named, list: &Vec<String>| {
        list.contains(&named.id) || named.equals.iter().any(|other| list.contains(other))
    };
    if each_has_its_own(&wanted, &said.named, &within) {
        return if each_has_its_own(&wanted, &said.named, &exact) {
            // Of one effect the name that was said: it may be another one that no observer could tell from it.
            let id = match wanted.as_slice() {
                [only] => said.named.iter().find(|named| only.contains(&named.id)),
                _ => None,
            };
            judgement(Outcome::Exact, false, id.map_or("exact", |named| &named.id))
        } else {
            judgement(Outcome::Class, false, "class")
        };
    }
    match (first, quiet) {
        (Some(_), _) => judgement(Outcome::Part, false, "part"),
        (None, false) => judgement(Outcome::Unknown, false, "unknown"),
        (None, true) if strength >= PLAIN => judgement(Outcome::Missed, false, "missed"),
        (None, true) => judgement(Outcome::Silent, false, "missed"),
    }
}

/// Whether each of the hidden effects has a name of its own that fits: one name does not stand for two.
fn each_has_its_own(
    wanted: &[&Vec<String>],
    named: &[Named],
    fits: &dyn Fn(&Named, &Vec<String>) -> bool,
) -> bool {
    let Some((list, others)) = wanted.split_first() else {
        return true;
    };
    (0..named.len()).any(|taken| {
        let mut left = named.to_vec();
        fits(&left.remove(taken), list) && each_has_its_own(others, &left, fits)
    })
}

/// Parameters of the hidden effects that were named.
pub fn estimates(truth: &Truth, said: &Said) -> Vec<Estimate> {
    let mut estimates = Vec::new();
    for effect in &truth.effects {
        let Some(named) = said.named.iter().find(|named| named.id == effect.id) else {
            continue;
        };
        for (name, value) in effect.parameters.iter().flatten() {
            let reported = named.parameters.iter().find(|one| one.name == *name);
            let (Some(truth), Some(reported)) = (value, reported) else {
                continue;
            };
            if let Some(value) = reported.value {
                estimates.push(Estimate {
                    effect: effect.id.clone(),
                    name: name.clone(),
                    truth: *truth,
                    value,
                    covered: covers(reported, *truth),
                });
            }
        }
    }
    estimates
}

/// Whether an interval has a value in it.
fn covers(reported: &Parameter, truth: f64) -> Option<bool> {
    Some((reported.low?..=reported.high?).contains(&truth))
}

/// Samples in both places over samples in either, for the best of the reported regions. Nothing if the truth has no place.
pub fn overlap(place: &Place, locations: &[Location], recording: &Table) -> Option<f64> {
    let column = recording.get(&place.column)?;
    let inside =
        |values: &[f64], absolute: bool, from: Option<f64>, to: Option<f64>| -> Vec<bool> {
            values
                .iter()
                .map(|value| {
                    let value = if absolute { value.abs() } else { *value };
                    from.is_none_or(|from| value >= from) && to.is_none_or(|to| value <= to)
                })
                .collect()
        };
    let truth = inside(column, place.absolute, place.from, place.to);
    let reference = if recording.get("i_ref_a").is_some() {
        "i_ref_a"
    } else {
        "p_ref_w"
    };
    locations
        .iter()
        .filter_map(|location| {
            let (name, absolute) = match location.variable.as_str() {
                "abs(i)" | "abs(x)" => (reference, true),
                "i" | "x" => (reference, false),
                other => (other, false),
            };
            let said = inside(recording.get(name)?, absolute, location.from, location.to);
            let both = truth.iter().zip(&said).filter(|(a, b)| **a && **b).count();
            let either = truth.iter().zip(&said).filter(|(a, b)| **a || **b).count();
            (either > 0).then(|| both as f64 / either as f64)
        })
        .max_by(f64::total_cmp)
        .or(Some(0.0))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;
    use crate::case::TrueEffect;

    fn hidden(required: &[&[&str]], allowed: &[&str]) -> Truth {
        let words = |ids: &[&str]| ids.iter().map(|id| (*id).to_owned()).collect::<Vec<_>>();
        Truth {
            kind: "d".to_owned(),
            effects: required
                .iter()
                .map(|ids| TrueEffect {
                    id: ids[0].to_owned(),
                    ..TrueEffect::default()
                })
                .collect(),
            required: required.iter().map(|ids| words(ids)).collect(),
            allowed: words(allowed),
            ..Truth::default()
        }
    }

    fn said(verdict: &str, named: &[(&str, &[&str])]) -> Said {
        Said {
            verdict: verdict.to_owned(),
            named: named
                .iter()
                .map(|(id, equals)| Named {
                    id: (*id).to_owned(),
                    equals: equals.iter().map(|id| (*id).to_owned()).collect(),
                    ..Named::default()
                })
                .collect(),
            ..Said::default()
        }
    }

    fn outcome(truth: &Truth, strength: f64, said: &Said) -> Outcome {
        judge(truth, strength, &[], Some(said)).outcome
    }

    #[test]
    fn the_right_name_alone_is_exact() {
        let truth = hidden(&[&["lag"]], &["offset"]);
        assert_eq!(
            outcome(&truth, 10.0, &said("explained", &[("lag", &[])])),
            Outcome::Exact
        );
        // What is true beside it does not spoil it.
        let both = said("explained", &[("offset", &[]), ("lag", &[])]);
        assert_eq!(outcome(&truth, 10.0, &both), Outcome::Exact);
        assert_eq!(judge(&truth, 10.0, &[], Some(&both)).said, "lag");
    }

    #[test]
    fn one_name_does_not_stand_for_two_effects() {
        let alike: &[&str] = &["lag", "moving-average"];
        let truth = hidden(&[alike, alike], &[]);
        let one = said("explained", &[("lag", &[])]);
        assert_eq!(outcome(&truth, 10.0, &one), Outcome::Part);
        let both = said("explained", &[("lag", &[]), ("moving-average", &[])]);
        assert_eq!(outcome(&truth, 10.0, &both), Outcome::Exact);
        // Whichever of two that fit the first effect is the only one that fits the second.
        let truth = hidden(&[alike, &["lag"]], &[]);
        assert_eq!(outcome(&truth, 10.0, &both), Outcome::Exact);
        let class = said("ambiguous", &[("gain", &["sensor-self-heating"])]);
        let truth = hidden(&[&["gain"], &["sensor-self-heating"]], &[]);
        assert_eq!(outcome(&truth, 10.0, &class), Outcome::Part);
    }

    #[test]
    fn a_class_with_the_right_name_is_a_class() {
        let truth = hidden(&[&["lag"]], &[]);
        for named in [("lag", &["delay"][..]), ("delay", &["lag"][..])] {
            assert_eq!(
                outcome(&truth, 10.0, &said("ambiguous", &[named])),
                Outcome::Class
            );
        }
        // Two names that are as right as each other are no doubt.
        let either = hidden(&[&["offset", "offset-temperature"]], &[]);
        let class = said("ambiguous", &[("offset", &["offset-temperature"])]);
        assert_eq!(outcome(&either, 10.0, &class), Outcome::Exact);
    }

    #[test]
    fn a_wrong_name_is_wrong_even_beside_the_right_one() {
        let truth = hidden(&[&["lag"]], &[]);
        let beside = said("explained", &[("lag", &[]), ("gain", &[])]);
        let judged = judge(&truth, 10.0, &[], Some(&beside));
        assert_eq!(
            (judged.outcome, judged.confident, judged.said.as_str()),
            (Outcome::Wrong, true, "gain")
        );
        let unsure = judge(
            &truth,
            10.0,
            &[],
            Some(&said("ambiguous", &[("gain", &["capacity"])])),
        );
        assert_eq!((unsure.outcome, unsure.confident), (Outcome::Wrong, false));
    }

    #[test]
    fn of_two_hidden_effects_one_is_a_part() {
        let truth = hidden(&[&["lag"], &["gain"]], &["offset"]);
        assert_eq!(
            outcome(&truth, 10.0, &said("partly-explained", &[("lag", &[])])),
            Outcome::Part
        );
        assert_eq!(
            outcome(&truth, 10.0, &said("partly-explained", &[("offset", &[])])),
            Outcome::Part
        );
        let both = said("explained", &[("lag", &[]), ("gain", &[])]);
        assert_eq!(outcome(&truth, 10.0, &both), Outcome::Exact);
        let one_in_a_class = said("ambiguous", &[("lag", &[]), ("capacity", &["gain"])]);
        assert_eq!(outcome(&truth, 10.0, &one_in_a_class), Outcome::Class);
    }

    #[test]
    fn silence_is_a_miss_only_of_what_is_plain() {
        let truth = hidden(&[&["lag"]], &[]);
        let quiet = said("no-mismatch", &[]);
        assert_eq!(outcome(&truth, 3.0, &quiet), Outcome::Missed);
        assert_eq!(outcome(&truth, 1.0, &quiet), Outcome::Silent);
        assert_eq!(
            outcome(&truth, 1.0, &said("unknown", &[])),
            Outcome::Unknown
        );
        assert_eq!(
            outcome(&truth, 30.0, &said("partly-explained", &[])),
            Outcome::Unknown
        );
    }

    #[test]
    fn with_nothing_hidden_only_quiet_is_right() {
        let clean = Truth::default();
        assert_eq!(
            outcome(&clean, f64::INFINITY, &said("no-mismatch", &[])),
            Outcome::Quiet
        );
        assert_eq!(
            outcome(&clean, f64::INFINITY, &said("unknown", &[])),
            Outcome::Unknown
        );
        assert_eq!(
            outcome(&clean, f64::INFINITY, &said("explained", &[("gain", &[])])),
            Outcome::Wrong
        );
    }

    #[test]
    fn outside_the_library_unknown_is_right_and_a_name_wrong() {
        let mut truth = hidden(&[], &["offset"]);
        truth.effects = vec![TrueEffect {
            id: "creep".to_owned(),
            ..TrueEffect::default()
        }];
        assert_eq!(
            outcome(&truth, 10.0, &said("unknown", &[])),
            Outcome::Unknown
        );
        assert_eq!(
            outcome(&truth, 10.0, &said("explained", &[("lag", &[])])),
            Outcome::Wrong
        );
        assert_eq!(
            outcome(&truth, 10.0, &said("explained", &[("offset", &[])])),
            Outcome::Class
        );
        assert_eq!(
            outcome(&truth, 10.0, &said("no-mismatch", &[])),
            Outcome::Missed
        );
    }

    #[test]
    fn a_true_effect_taken_out_asks_for_unknown() {
        let truth = hidden(&[&["lag"]], &[]);
        let removed = ["lag".to_owned()];
        let judged = |said: &Said| judge(&truth, 10.0, &removed, Some(said));
        assert_eq!(judged(&said("unknown", &[])).outcome, Outcome::Unknown);
        let wrong = judged(&said("explained", &[("moving-average", &[])]));
        assert_eq!((wrong.outcome, wrong.confident), (Outcome::Wrong, true));
        assert_eq!(judged(&said("no-mismatch", &[])).outcome, Outcome::Missed);
    }

    #[test]
    fn failures_and_open_questions_are_their_own() {
        let truth = hidden(&[&["lag"]], &[]);
        assert_eq!(judge(&truth, 1.0, &[], None).outcome, Outcome::Error);
        let open = Truth {
            standing: Some("none".to_owned()),
            ..Truth::default()
        };
        assert_eq!(
            outcome(&open, 1.0, &said("explained", &[("gain", &[])])),
            Outcome::Unscored
        );
    }

    #[test]
    fn intervals_are_compared_with_the_truth() {
        let mut truth = hidden(&[&["lag"]], &[]);
        truth.effects[0].parameters = Some([("tau_s".to_owned(), Some(0.1))].into());
        let mut report = said("explained", &[("lag", &[])]);
        report.named[0].parameters.push(Parameter {
            name: "tau_s".to_owned(),
            value: Some(0.11),
            low: Some(0.09),
            high: Some(0.12),
        });
        assert_eq!(estimates(&truth, &report)[0].covered, Some(true));
        report.named[0].parameters[0].low = Some(0.105);
        assert_eq!(estimates(&truth, &report)[0].covered, Some(false));
        report.named[0].parameters[0].low = None;
        assert_eq!(estimates(&truth, &report)[0].covered, None);
    }

    #[test]
    fn the_same_place_overlaps_wholly() {
        let mut recording = Table::default();
        recording.push("i_ref_a", vec![-60.0, -10.0, 10.0, 60.0]);
        let place = Place {
            column: "i_ref_a".to_owned(),
            from: Some(48.0),
            to: None,
            absolute: true,
        };
        let said = |variable: &str, from| {
            vec![Location {
                variable: variable.to_owned(),
                from: Some(from),
                to: None,
                energy_share: None,
            }]
        };
        assert_eq!(
            overlap(&place, &said("abs(i)", 50.0), &recording),
            Some(1.0)
        );
        assert_eq!(overlap(&place, &said("i", 50.0), &recording), Some(0.5));
        assert_eq!(overlap(&place, &[], &recording), Some(0.0));
    }
}
