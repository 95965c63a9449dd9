//! Tables out of the records. Everything that a page or a picture says is calculated here, and stands in results.json.

use std::{
    collections::{BTreeMap, BTreeSet},
    ops::RangeInclusive,
};

use serde::Serialize;

use crate::{
    board::Calibrated,
    case::{Group, Truth},
    forms::{self, Told},
    methods::Found,
    run::Record,
    score::{self, Judgement, Outcome, PLAIN},
    stats::{Share, median, quantile},
    tool::{Named, Said},
};

/// Version of results.json.
const SCHEMA: u32 = 1;
/// A baseline fits as well as the tool if its held-out error is at most so many times the tool's.
const AS_WELL: f64 = 1.05;
/// Two held-out errors within this share of each other are level.
const LEVEL: f64 = 0.01;
/// What a maker says of a case that it cannot have (proof/makers); anything else that leaves a case without data is a failure.
const MAKERS_LIMITS: [&str; 2] = ["cannot be had", "out of its reach"];
/// Detected: the lower strengths of an effect are those at which fewer than this share are right.
pub const DETECTED: f64 = 0.95;

/// How many of each outcome.
#[derive(Debug, Clone, Serialize)]
pub struct Counts {
    /// a, b, c, d, or a group's title.
    pub name: String,
    /// Who made the data.
    pub makers: Vec<String>,
    /// The same by its letter.
    pub kinds: Vec<String>,
    /// Cases with data.
    pub cases: usize,
    /// Of each outcome.
    pub outcomes: BTreeMap<Outcome, usize>,
    /// Right name or class, of the cases in which something of the library is hidden at strength 3 or more.
    pub right: Share,
    /// Something named that is not there, of all scored.
    pub wrong: Share,
    /// And said with confidence.
    pub confidently_wrong: Share,
}

/// One line of the confusion matrix.
#[derive(Debug, Clone, Serialize)]
pub struct Confusion {
    /// Kind of the data.
    pub kind: String,
    /// Hidden effect.
    pub effect: String,
    /// What was said, and how often.
    pub said: BTreeMap<String, usize>,
}

/// Shares of right answers of an effect over its strength.
#[derive(Debug, Clone, Serialize)]
pub struct Detection {
    /// Hidden effect.
    pub effect: String,
    /// Kind of the data.
    pub kind: String,
    /// Strength, share of right names or classes.
    pub strengths: Vec<(f64, Share)>,
    /// Smallest strength from which on the share stays at 95 % or more.
    pub limit: Option<f64>,
}

/// Errors of one parameter.
#[derive(Debug, Clone, Serialize)]
pub struct ParameterLine {
    /// Kind of the data.
    pub kind: String,
    /// Effect.
    pub effect: String,
    /// Its parameter.
    pub name: String,
    /// Estimates.
    pub cases: usize,
    /// Median of the relative error's magnitude.
    pub median_error: Option<f64>,
    /// 95 % intervals with the truth in them.
    pub covered: Share,
}

/// A real recording.
#[derive(Debug, Clone, Serialize)]
pub struct RealLine {
    /// Of expected.toml.
    pub id: String,
    /// published, beside or none.
    pub standing: String,
    /// Who says what is right.
    pub source: String,
    /// What has to be named.
    pub required: Vec<Vec<String>>,
    /// How it went.
    pub outcome: Outcome,
    /// And with confidence.
    pub confident: bool,
    /// Of the report.
    pub verdict: String,
    /// What was named, with its equals.
    pub named: Vec<Named>,
    /// Published parameter, and what was said of it.
    pub published: Vec<PublishedLine>,
    /// Of the model as designed, on what was not fitted.
    pub before: Option<f64>,
    /// Of the extended model.
    pub after: Option<f64>,
    /// Unit of the two.
    pub signal: String,
    /// Processor time of the explanation, s.
    pub processor_s: Option<f64>,
    /// Today's methods.
    pub methods: BTreeMap<String, Found>,
    /// The failure, if it failed.
    pub error: Option<String>,
}

/// A published parameter beside the reported one.
#[derive(Debug, Clone, Serialize)]
pub struct PublishedLine {
    /// Effect and parameter.
    pub name: String,
    /// As published.
    pub published: f64,
    /// What is right.
    pub low: f64,
    /// Its upper end.
    pub high: f64,
    /// As said; nothing if the effect was not named.
    pub said: Option<f64>,
    /// 95 % interval.
    pub interval: Option<(f64, f64)>,
}

/// One of today's methods, beside the tool on the same cases.
#[derive(Debug, Clone, Serialize)]
pub struct MethodLine {
    /// Who made the data: "(a) and (b)" or "(c) and (d)".
    pub data: String,
    /// Its name; `twin` on the same cases.
    pub name: String,
    /// Cases it was run on and has something to say about.
    pub cases: usize,
    /// Right names or classes, of those with a hidden effect.
    pub right: Share,
    /// Wrong names, of the same.
    pub wrong: Share,
    /// Something named though nothing is hidden, by who made the data.
    pub false_alarms: BTreeMap<String, Share>,
    /// Median of held-out error over that of the true model.
    pub over_oracle: Option<f64>,
    /// Median processor time, s.
    pub seconds: Option<f64>,
    /// Failed.
    pub errors: usize,
    /// What a method names is part of a linear or black-box model that names nothing.
    pub names_effects: bool,
}

/// The emulated board.
#[derive(Debug, Clone, Serialize)]
pub struct BoardLine {
    /// What was concealed.
    pub concealed: String,
    /// How it went.
    pub outcome: Option<Outcome>,
    /// What was named.
    pub named: Vec<Named>,
    /// The second drive with and without the calibration.
    pub calibrated: Option<Calibrated>,
    /// What failed.
    pub error: Option<String>,
}

/// A figure that the project wants to reach.
#[derive(Debug, Clone, Serialize)]
pub struct Target {
    /// In words.
    pub what: String,
    /// What it should be.
    pub wanted: String,
    /// What it is.
    pub found: String,
    /// Whether it is reached; nothing if it was not measured.
    pub met: Option<bool>,
    /// Whether all of the share's 95 % interval reaches it; nothing where there is none.
    pub sure: Option<bool>,
}

/// Clean recordings.
#[derive(Debug, Clone, Serialize)]
pub struct Clean {
    /// Kind of the data.
    pub kind: String,
    /// An effect was named.
    pub named: Share,
    /// Anything but "no mismatch" was said.
    pub anything: Share,
}

/// Everything.
#[derive(Debug, Serialize)]
pub struct Summary {
    /// Of this file.
    pub schema: u32,
    /// quick or full.
    pub plan: String,
    /// SHA-256 of the program under test.
    pub tool_sha256: String,
    /// Processors of the machine.
    pub processors: usize,
    /// Cases that were run.
    pub cases: usize,
    /// Of these, the ones that have data.
    pub with_data: usize,
    /// Cases of the plan.
    pub planned: usize,
    /// Seconds of the wall clock that each part took in all, on one processor.
    pub parts_s: BTreeMap<String, f64>,
    /// Without data, by the maker's own limits: id and reason.
    pub not_made: Vec<(String, String)>,
    /// Failed: id and reason.
    pub errors: Vec<(String, String)>,
    /// By who made the data.
    pub by_kind: Vec<Counts>,
    /// By what the cases are for.
    pub by_group: Vec<Counts>,
    /// Real recordings and other people's simulators together.
    pub others_together: Counts,
    /// Strength 3 and more.
    pub confusion: Vec<Confusion>,
    /// Over the strengths.
    pub detection: Vec<Detection>,
    /// Of single hidden effects.
    pub parameters: Vec<ParameterLine>,
    /// All intervals together, by kind.
    pub coverage: BTreeMap<String, Share>,
    /// Overlap of the place by kind: count, quartiles.
    pub overlap: BTreeMap<String, (usize, f64, f64, f64)>,
    /// Held-out error over the oracle's by kind: count, median, 90 %, share within 1.1.
    pub over_oracle: BTreeMap<String, (usize, f64, f64, Share)>,
    /// By kind.
    pub clean: Vec<Clean>,
    /// Cells in which nothing is concealed, though the circuit that is their design leaves something of them.
    pub clean_cells: Clean,
    /// With the true effect taken out: outcomes.
    pub without: Counts,
    /// Something is hidden that the library does not have, by who made the data.
    pub outside: Vec<Counts>,
    /// Which form of what is left was told of them, by effect and by who made the data.
    pub forms: Vec<FormLine>,
    /// One effect at strength 3, by who made the data: right.
    pub just_plain: Vec<(String, Share)>,
    /// Intervals of real recordings that meet what counts as right of a published parameter.
    pub published: Share,
    /// Every real recording.
    pub real: Vec<RealLine>,
    /// Side by side.
    pub methods: Vec<MethodLine>,
    /// Of real recordings, a method is lower held out (1 % or more): id, method.
    pub beaten_on_real: Vec<(String, String)>,
    /// The same, neither lower nor higher by 1 %.
    pub level_on_real: Vec<(String, String)>,
    /// Time of the fastest method that names an effect rightly and fits as well, over the tool's; median, count.
    pub speed: Option<(f64, usize)>,
    /// The emulated board.
    pub board: Vec<BoardLine>,
    /// Same input, same report.
    pub same: Option<bool>,
    /// Figures to reach.
    pub targets: Vec<Target>,
    /// One short line a case.
    pub records: Vec<Line>,
}

/// Forms that were told of one effect outside the library.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct FormLine {
    /// The effect.
    pub effect: String,
    /// Who made the data.
    pub kind: String,
    /// Forms that are true of it.
    pub right: Vec<String>,
    /// Cases.
    pub cases: usize,
    /// Told a true form, or one that is said not to be told apart from one.
    pub told: usize,
    /// Told another.
    pub another: usize,
}

/// A case in short.
#[derive(Debug, Clone, Serialize)]
pub struct Line {
    /// Unique.
    pub id: String,
    /// What it is for.
    pub group: Group,
    /// Who made the data.
    pub kind: String,
    /// How it went.
    pub outcome: Option<Outcome>,
    /// Wrong and confident.
    pub confident: bool,
    /// Of the report.
    pub verdict: String,
    /// Ids; equals behind a slash.
    pub named: Vec<String>,
    /// Of the truth.
    pub truth: Vec<String>,
    /// SHA-256 of the sealed truth.
    pub sealed: String,
    /// Held out: as designed, extended, true model.
    pub held_out: Option<(f64, f64, Option<f64>)>,
    /// Of the place.
    pub overlap: Option<f64>,
    /// Processor time, s.
    pub processor_s: Option<f64>,
    /// How it went with the true effect taken out.
    pub without: Option<Outcome>,
}

/// A record with its truth and judgement.
struct Scored<'a> {
    record: &'a Record,
    truth: &'a Truth,
    judged: Judgement,
}

impl Scored<'_> {
    fn hidden(&self) -> bool {
        !self.truth.required.is_empty()
    }

    fn strength(&self) -> f64 {
        self.truth.strength(self.record.planned.case.strength())
    }

    fn plain(&self) -> bool {
        self.strength() >= PLAIN
    }

    /// One effect of the library, and nothing else.
    fn single(&self) -> bool {
        let group = self.record.planned.group;
        let one = self.record.planned.case.effects.len() == 1;
        one && self.hidden() && matches!(group, Group::Single | Group::Circuits)
    }

    /// What is hidden is none of the library's. (Cells by others have some of it by nature, and are another thing.)
    fn outside(&self) -> bool {
        let nothing = self.truth.effects.is_empty() || self.hidden();
        !nothing && self.record.planned.group != Group::Cells
    }
}

/// See [`Summary::forms`].
fn form_lines(scored: &[Scored<'_>]) -> Vec<FormLine> {
    let mut lines: BTreeMap<(String, String), FormLine> = BTreeMap::new();
    for one in scored.iter().filter(|one| one.outside()) {
        let (Some(effect), Some(said)) =
            (one.record.planned.case.effects.first(), &one.record.said)
        else {
            continue;
        };
        let Some(right) = forms::of(&effect.id) else {
            continue;
        };
        let kind = one.truth.kind.clone();
        let line = lines
            .entry((kind.clone(), effect.id.clone()))
            .or_insert_with(|| FormLine {
                effect: effect.id.clone(),
                kind,
                right: right.iter().map(|form| (*form).to_owned()).collect(),
                cases: 0,
                told: 0,
                another: 0,
            });
        line.cases += 1;
        match forms::judged(right, &said.forms) {
            Told::Right => line.told += 1,
            Told::Another => line.another += 1,
            Told::None => {}
        }
    }
    lines.into_values().collect()
}

/// Counts the outcomes of some cases.
fn counts<'a>(
    name: &str,
    cases: impl Iterator<Item = (&'a Scored<'a>, Judgement)>,
    right: impl Fn(Outcome) -> bool,
) -> Counts {
    let cases: Vec<_> = cases.collect();
    let mut outcomes = BTreeMap::new();
    let (mut makers, mut kinds) = (BTreeSet::new(), BTreeSet::new());
    for (one, judged) in &cases {
        kinds.insert(one.truth.kind.clone());
        *outcomes.entry(judged.outcome).or_insert(0) += 1;
        makers.insert(one.truth.maker.clone());
    }
    let scored = || {
        cases
            .iter()
            .filter(|(_, judged)| judged.outcome != Outcome::Unscored)
    };
    Counts {
        name: name.to_owned(),
        makers: makers.into_iter().collect(),
        kinds: kinds.into_iter().collect(),
        cases: cases.len(),
        outcomes,
        right: Share::of(
            scored().filter(|(one, _)| one.hidden() && one.plain()),
            |(_, judged)| right(judged.outcome),
        ),
        wrong: Share::of(scored(), |(_, judged)| judged.outcome == Outcome::Wrong),
        confidently_wrong: Share::of(scored(), |(_, judged)| judged.confident),
    }
}

/// What a kind's letter stands for.
pub fn kind_title(kind: &str) -> &'static str {
    match kind {
        "a" => "(a) real recordings",
        "b" => "(b) simulators that others wrote",
        "c" => "(c) others' solver, our equations",
        _ => "(d) our own",
    }
}

/// Every table.
pub fn summary(
    records: &[Record],
    planned: usize,
    plan: &str,
    tool_sha256: String,
    processors: usize,
) -> Summary {
    let scored: Vec<Scored<'_>> = records
        .iter()
        .filter_map(|record| {
            Some(Scored {
                record,
                truth: record.truth.as_ref()?,
                judged: record.judgement()?,
            })
        })
        .collect();
    let with = |keep: &dyn Fn(&Scored<'_>) -> bool, name: &str| {
        counts(
            name,
            scored
                .iter()
                .filter(|one| keep(one))
                .map(|one| (one, one.judged.clone())),
            Outcome::right,
        )
    };
    let kinds: BTreeSet<&str> = scored.iter().map(|one| one.truth.kind.as_str()).collect();
    let by_kind: Vec<Counts> = kinds
        .iter()
        .map(|kind| with(&|one| one.truth.kind == **kind, kind))
        .collect();
    let by_group = Group::ALL
        .into_iter()
        .map(|group| with(&|one| one.record.planned.group == group, group.title()))
        .filter(|counts| counts.cases > 0)
        .collect();
    let others_together = with(
        &|one| ["a", "b"].contains(&one.truth.kind.as_str()),
        "(a) and (b) together",
    );
    let without = counts(
        "true effect taken out of the library",
        scored
            .iter()
            .filter_map(|one| Some((one, one.record.judgement_without()?))),
        |outcome| outcome == Outcome::Unknown,
    );
    let outside = kinds
        .iter()
        .map(|kind| {
            let keep = |one: &Scored<'_>| one.outside() && one.truth.kind == **kind;
            with(&keep, kind)
        })
        .filter(|counts| counts.cases > 0)
        .collect();
    let just_plain = kinds
        .iter()
        .map(|kind| {
            let of_kind = scored.iter().filter(|one| one.truth.kind == **kind);
            let cases = of_kind.filter(|one| one.single() && one.strength() == PLAIN);
            let right = Share::of(cases, |one| one.judged.outcome.right());
            ((*kind).to_owned(), right)
        })
        .filter(|(_, right)| right.of > 0)
        .collect();
    let real = real(&scored);
    let published = Share::of(
        real.iter()
            .flat_map(|line| &line.published)
            .filter_map(|one| Some((one, one.interval?))),
        |(one, (low, high))| *low <= one.high && *high >= one.low,
    );
    let (not_made, broken): (Vec<_>, Vec<_>) = records
        .iter()
        .filter_map(|record| Some((record, record.not_made.clone()?)))
        .partition(|(_, why)| MAKERS_LIMITS.iter().any(|limit| why.contains(limit)));
    let named = |(record, why): (&Record, String)| (record.planned.case.id.clone(), why);
    let mut errors: Vec<(String, String)> = broken.into_iter().map(named).collect();
    for record in records {
        let id = || record.planned.case.id.clone();
        if let Some(error) = &record.error {
            errors.push((id(), error.clone()));
        } else if record.failed_without() {
            errors.push((
                id(),
                "nothing was said with the true effect taken out".to_owned(),
            ));
        }
    }
    let mut summary = Summary {
        schema: SCHEMA,
        plan: plan.to_owned(),
        tool_sha256,
        processors,
        cases: records.len(),
        with_data: records
            .iter()
            .filter(|record| record.truth.is_some())
            .count(),
        planned,
        parts_s: parts(records),
        not_made: not_made.into_iter().map(named).collect(),
        errors,
        by_kind,
        by_group,
        others_together,
        confusion: confusion(&scored),
        detection: detection(&scored),
        parameters: parameters(&scored),
        coverage: coverage(&scored),
        overlap: overlap(&scored),
        over_oracle: over_oracle(&scored),
        clean: clean(&scored),
        clean_cells: clean_of(&scored, "b", |one| {
            one.record.planned.group == Group::Cells && !one.hidden()
        }),
        without,
        outside,
        forms: form_lines(&scored),
        just_plain,
        published,
        real,
        methods: methods(&scored),
        beaten_on_real: against_methods(&scored, |ratio| ratio < 1.0 - LEVEL),
        level_on_real: against_methods(&scored, |ratio| (ratio - 1.0).abs() <= LEVEL),
        speed: speed(&scored),
        board: board(records),
        same: records
            .iter()
            .filter_map(|record| record.same)
            .reduce(|all, one| all && one),
        targets: Vec::new(),
        records: records.iter().map(line).collect(),
    };
    summary.targets = targets(&summary);
    summary
}

fn parts(records: &[Record]) -> BTreeMap<String, f64> {
    let mut all = BTreeMap::new();
    for (part, seconds) in records.iter().flat_map(|record| &record.parts_s) {
        *all.entry(part.clone()).or_insert(0.0) += seconds;
    }
    all
}

fn confusion(scored: &[Scored<'_>]) -> Vec<Confusion> {
    let mut lines: BTreeMap<(String, String), BTreeMap<String, usize>> = BTreeMap::new();
    for one in scored {
        let case = &one.record.planned.case;
        if case.effects.len() != 1 || !one.plain() || one.record.planned.group == Group::Inseparable
        {
            continue;
        }
        let line = lines
            .entry((one.truth.kind.clone(), case.effects[0].id.clone()))
            .or_default();
        let said = &one.judged.said;
        let as_right = one.judged.outcome == Outcome::Exact && *said != case.effects[0].id;
        let said = if as_right && said != "exact" {
            format!("{said} (as right)")
        } else {
            said.clone()
        };
        *line.entry(said).or_insert(0) += 1;
    }
    lines
        .into_iter()
        .map(|((kind, effect), said)| Confusion { kind, effect, said })
        .collect()
}

fn detection(scored: &[Scored<'_>]) -> Vec<Detection> {
    let mut effects: BTreeMap<(String, String), Vec<(f64, bool)>> = BTreeMap::new();
    for one in scored {
        let case = &one.record.planned.case;
        if one.single() {
            effects
                .entry((one.truth.kind.clone(), case.effects[0].id.clone()))
                .or_default()
                .push((case.strength(), one.judged.outcome.right()));
        }
    }
    effects
        .into_iter()
        .map(|((kind, effect), cases)| {
            let mut used: Vec<f64> = cases.iter().map(|(strength, _)| *strength).collect();
            used.sort_by(f64::total_cmp);
            used.dedup();
            let strengths: Vec<(f64, Share)> = used
                .into_iter()
                .map(|strength| {
                    let of_it = cases.iter().filter(|(s, _)| *s == strength);
                    (strength, Share::of(of_it, |(_, right)| *right))
                })
                .collect();
            let mut limit = None;
            for (strength, share) in strengths.iter().rev() {
                if share.value() < DETECTED {
                    break;
                }
                limit = Some(*strength);
            }
            Detection {
                effect,
                kind,
                strengths,
                limit,
            }
        })
        .collect()
}

/// Estimates of cases that were named rightly; a wrong model's parameters mean something else.
fn right_estimates<'a>(
    scored: &'a [Scored<'_>],
) -> impl Iterator<Item = (&'a str, score::Estimate)> {
    scored
        .iter()
        .filter(|one| one.judged.outcome.right())
        .filter_map(|one| Some((one.truth, one.record.said.as_ref()?)))
        .flat_map(|(truth, said)| {
            score::estimates(truth, said)
                .into_iter()
                .map(|estimate| (truth.kind.as_str(), estimate))
        })
}

fn parameters(scored: &[Scored<'_>]) -> Vec<ParameterLine> {
    let mut lines: BTreeMap<(String, String, String), Vec<score::Estimate>> = BTreeMap::new();
    for (kind, estimate) in right_estimates(scored) {
        lines
            .entry((
                kind.to_owned(),
                estimate.effect.clone(),
                estimate.name.clone(),
            ))
            .or_default()
            .push(estimate);
    }
    lines
        .into_iter()
        .map(|((kind, effect, name), estimates)| {
            // A gain's error counts against its distance from 1, what it would be without the effect.
            let off = if name == "gain" || name == "gain_ratio" {
                1.0
            } else {
                0.0
            };
            let errors: Vec<f64> = estimates
                .iter()
                .filter(|one| one.truth != off)
                .map(|one| ((one.value - one.truth) / (one.truth - off)).abs())
                .collect();
            ParameterLine {
                kind,
                effect,
                name,
                cases: estimates.len(),
                median_error: median(&errors),
                covered: Share::of(estimates.iter().filter_map(|one| one.covered), |covered| {
                    *covered
                }),
            }
        })
        .collect()
}

fn coverage(scored: &[Scored<'_>]) -> BTreeMap<String, Share> {
    let mut kinds: BTreeMap<String, Vec<bool>> = BTreeMap::new();
    for (kind, estimate) in right_estimates(scored) {
        if let Some(covered) = estimate.covered {
            kinds.entry(kind.to_owned()).or_default().push(covered);
        }
    }
    kinds
        .into_iter()
        .map(|(kind, covered)| (kind, Share::of(covered, |one| *one)))
        .collect()
}

/// Figures of some cases, by kind.
fn by_kind(
    scored: &[Scored<'_>],
    figure: impl Fn(&Scored<'_>) -> Option<f64>,
) -> BTreeMap<String, Vec<f64>> {
    let mut kinds: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    for one in scored {
        if let Some(value) = figure(one) {
            kinds.entry(one.truth.kind.clone()).or_default().push(value);
        }
    }
    kinds
}

fn overlap(scored: &[Scored<'_>]) -> BTreeMap<String, (usize, f64, f64, f64)> {
    by_kind(scored, |one| {
        let counts = one.plain() && one.judged.outcome.right();
        one.record.overlap.filter(|_| counts)
    })
    .into_iter()
    .filter_map(|(kind, values)| {
        let quartiles = (
            values.len(),
            quantile(&values, 0.25)?,
            median(&values)?,
            quantile(&values, 0.75)?,
        );
        Some((kind, quartiles))
    })
    .collect()
}

/// Held-out error over that of the true model.
fn ratio(one: &Scored<'_>) -> Option<f64> {
    let oracle = one.truth.oracle_rms.as_ref()?.holdout?;
    let (_, errors) = one.record.said.as_ref()?.main_held_out()?;
    (oracle > 0.0).then(|| errors.after / oracle)
}

fn over_oracle(scored: &[Scored<'_>]) -> BTreeMap<String, (usize, f64, f64, Share)> {
    by_kind(scored, |one| {
        ratio(one).filter(|_| one.hidden() && one.plain())
    })
    .into_iter()
    .filter_map(|(kind, ratios)| {
        let figures = (
            ratios.len(),
            median(&ratios)?,
            quantile(&ratios, 0.9)?,
            Share::of(&ratios, |ratio| **ratio <= 1.1),
        );
        Some((kind, figures))
    })
    .collect()
}

fn clean_of(scored: &[Scored<'_>], kind: &str, is: impl Fn(&Scored<'_>) -> bool) -> Clean {
    let cases = || scored.iter().filter(|one| is(one));
    let named = |one: &&Scored<'_>| {
        let said = one.record.said.as_ref();
        said.is_some_and(|said| !said.named.is_empty())
    };
    Clean {
        kind: kind.to_owned(),
        named: Share::of(cases(), named),
        anything: Share::of(cases(), |one| one.judged.outcome != Outcome::Quiet),
    }
}

fn clean(scored: &[Scored<'_>]) -> Vec<Clean> {
    ["b", "c", "d"]
        .into_iter()
        .map(|kind| {
            clean_of(scored, kind, |one| {
                one.record.planned.group == Group::Clean && one.truth.kind == kind
            })
        })
        .filter(|line| line.named.of > 0)
        .collect()
}

fn real(scored: &[Scored<'_>]) -> Vec<RealLine> {
    scored
        .iter()
        .filter(|one| one.record.planned.group == Group::Real)
        .map(|one| {
            let said = one.record.said.clone().unwrap_or_default();
            let main = said
                .main_held_out()
                .map(|(name, errors)| (name.to_owned(), errors));
            RealLine {
                id: one.record.planned.case.drive.clone(),
                standing: one.truth.standing.clone().unwrap_or_default(),
                source: one.truth.why.clone().unwrap_or_default(),
                required: one.truth.required.clone(),
                outcome: one.judged.outcome,
                confident: one.judged.confident,
                verdict: said.verdict.clone(),
                published: one
                    .truth
                    .published
                    .iter()
                    .map(|wanted| {
                        let found = said
                            .named
                            .iter()
                            .filter(|named| named.id == wanted.effect)
                            .flat_map(|named| &named.parameters)
                            .find(|parameter| parameter.name == wanted.name);
                        PublishedLine {
                            name: format!("{}.{}", wanted.effect, wanted.name),
                            published: wanted.value,
                            low: wanted.low,
                            high: wanted.high,
                            said: found.and_then(|parameter| parameter.value),
                            interval: found
                                .and_then(|parameter| Some((parameter.low?, parameter.high?))),
                        }
                    })
                    .collect(),
                before: main.as_ref().map(|(_, errors)| errors.before),
                after: main.as_ref().map(|(_, errors)| errors.after),
                signal: main.map(|(name, _)| name).unwrap_or_default(),
                processor_s: one.record.said.as_ref().map(|said| said.taken.processor_s),
                named: said.named,
                methods: one.record.methods.clone(),
                error: one.record.error.clone(),
            }
        })
        .collect()
}

/// A method's names as the tool would say them.
fn as_said(found: &Found) -> Said {
    Said {
        verdict: if found.named.is_empty() {
            "no-mismatch"
        } else {
            "explained"
        }
        .to_owned(),
        named: found
            .named
            .iter()
            .map(|id| Named {
                id: id.clone(),
                equals: found
                    .classes
                    .iter()
                    .filter(|class| class.contains(id))
                    .flatten()
                    .filter(|other| *other != id)
                    .cloned()
                    .collect(),
                ..Named::default()
            })
            .collect(),
        ..Said::default()
    }
}

fn applies(found: &Found) -> bool {
    found.error.is_none() && found.held_out_rms.is_some()
}

fn methods(scored: &[Scored<'_>]) -> Vec<MethodLine> {
    let mut lines = methods_on(scored, "(a) and (b)", &["a", "b"]);
    lines.extend(methods_on(scored, "(c) and (d)", &["c", "d"]));
    lines
}

fn methods_on(scored: &[Scored<'_>], data: &str, kinds: &[&str]) -> Vec<MethodLine> {
    let compared: Vec<&Scored<'_>> = scored
        .iter()
        .filter(|one| kinds.contains(&one.truth.kind.as_str()))
        .filter(|one| !one.record.methods.is_empty())
        .collect();
    let names: BTreeSet<&String> = compared
        .iter()
        .flat_map(|one| one.record.methods.keys())
        .collect();
    if names.is_empty() {
        return Vec::new();
    }
    let twin: Vec<Compared<'_>> = compared
        .iter()
        .map(|one| {
            let said = one.record.said.as_ref();
            Compared {
                scored: one,
                judged: one.judged.clone(),
                names: said.is_some_and(|said| !said.named.is_empty()),
                held_out: said.and_then(|said| Some(said.main_held_out()?.1.after)),
                seconds: said.map(|said| said.taken.processor_s),
            }
        })
        .collect();
    let failed = compared.iter().filter(|one| one.record.error.is_some());
    let mut lines = vec![method_line(data, "twin", &twin, failed.count())];
    for name in names {
        let mut cases = Vec::new();
        let mut errors = 0;
        for one in &compared {
            let Some(found) = one.record.methods.get(name) else {
                continue;
            };
            // What failed counts against it, as it does against the tool; what a method is not made for does not.
            let failed = found.error.is_some();
            errors += usize::from(failed);
            if !failed && !applies(found) {
                continue;
            }
            let said = as_said(found);
            cases.push(Compared {
                scored: one,
                judged: score::judge(one.truth, one.strength(), &[], (!failed).then_some(&said)),
                names: !found.named.is_empty(),
                held_out: found.held_out_rms.filter(|_| !failed),
                seconds: found.seconds.filter(|_| !failed),
            });
        }
        lines.push(method_line(data, name, &cases, errors));
    }
    lines
}

/// A method, or the tool, on one case.
struct Compared<'a> {
    scored: &'a Scored<'a>,
    judged: Judgement,
    names: bool,
    held_out: Option<f64>,
    seconds: Option<f64>,
}

fn method_line(data: &str, name: &str, cases: &[Compared<'_>], errors: usize) -> MethodLine {
    let hidden = || {
        cases
            .iter()
            .filter(|case| case.scored.hidden() && case.judged.outcome != Outcome::Unscored)
    };
    let over_oracle: Vec<f64> = cases
        .iter()
        .filter_map(|case| Some(case.held_out? / case.scored.truth.oracle_rms.as_ref()?.holdout?))
        .collect();
    let seconds: Vec<f64> = cases.iter().filter_map(|case| case.seconds).collect();
    let mut clean: BTreeMap<String, Vec<bool>> = BTreeMap::new();
    for case in cases
        .iter()
        .filter(|case| case.scored.record.planned.group == Group::Clean)
    {
        let kind = case.scored.truth.kind.clone();
        clean.entry(kind).or_default().push(case.names);
    }
    let false_alarms = clean
        .into_iter()
        .map(|(kind, named)| (kind, Share::of(named, |named| *named)))
        .collect();
    MethodLine {
        data: data.to_owned(),
        name: name.to_owned(),
        cases: cases.len(),
        right: Share::of(hidden(), |case| case.judged.outcome.right()),
        wrong: Share::of(hidden(), |case| case.judged.outcome == Outcome::Wrong),
        false_alarms,
        over_oracle: median(&over_oracle),
        seconds: median(&seconds),
        errors,
        names_effects: cases.iter().any(|case| case.names),
    }
}

/// Real recordings and methods whose held-out error over the tool's is as asked for.
fn against_methods(scored: &[Scored<'_>], asked: impl Fn(f64) -> bool) -> Vec<(String, String)> {
    let mut found = Vec::new();
    for one in scored
        .iter()
        .filter(|one| one.record.planned.group == Group::Real)
    {
        let ours = one
            .record
            .said
            .as_ref()
            .and_then(|said| Some(said.main_held_out()?.1.after));
        for (name, method) in &one.record.methods {
            let Some(theirs) = method.held_out_rms.filter(|_| method.error.is_none()) else {
                continue;
            };
            // A tool that failed is beaten by anything that did not.
            if asked(ours.map_or(0.0, |ours| theirs / ours)) {
                found.push((one.record.planned.case.drive.clone(), name.clone()));
            }
        }
    }
    found
}

/// Of the cases in which the tool is right and a method is too: the fastest such method's time over the tool's.
fn speed(scored: &[Scored<'_>]) -> Option<(f64, usize)> {
    let mut ratios = Vec::new();
    for one in scored
        .iter()
        .filter(|one| one.hidden() && one.judged.outcome.right())
    {
        let Some(said) = &one.record.said else {
            continue;
        };
        let Some((_, ours)) = said.main_held_out() else {
            continue;
        };
        let fastest = one
            .record
            .methods
            .values()
            .filter(|found| applies(found))
            .filter(|found| {
                found
                    .held_out_rms
                    .is_some_and(|theirs| theirs <= AS_WELL * ours.after)
            })
            .filter(|found| {
                let judged = score::judge(one.truth, one.strength(), &[], Some(&as_said(found)));
                judged.outcome.right()
            })
            .filter_map(|found| found.seconds)
            .min_by(f64::total_cmp);
        if let Some(fastest) = fastest
            && said.taken.processor_s > 0.0
        {
            ratios.push(fastest / said.taken.processor_s);
        }
    }
    Some((median(&ratios)?, ratios.len()))
}

fn board(records: &[Record]) -> Vec<BoardLine> {
    records
        .iter()
        .filter(|record| record.planned.group == Group::Board)
        .map(|record| BoardLine {
            concealed: record
                .planned
                .case
                .options
                .get("sensor")
                .and_then(|list| list.as_array())
                .map(|list| {
                    list.iter()
                        .filter_map(|one| one.as_str())
                        .collect::<Vec<_>>()
                        .join(", ")
                })
                .unwrap_or_default(),
            outcome: record.judgement().map(|judged| judged.outcome),
            named: record.said.clone().unwrap_or_default().named,
            calibrated: record.calibrated.clone(),
            error: record.error.clone().or_else(|| record.not_made.clone()),
        })
        .collect()
}

fn line(record: &Record) -> Line {
    let judged = record.judgement();
    let said = record.said.clone().unwrap_or_default();
    let truth = record.truth.clone().unwrap_or_default();
    Line {
        id: record.planned.case.id.clone(),
        group: record.planned.group,
        kind: truth.kind.clone(),
        outcome: judged.as_ref().map(|judged| judged.outcome),
        confident: judged.is_some_and(|judged| judged.confident),
        verdict: said.verdict.clone(),
        named: said
            .named
            .iter()
            .map(|named| {
                let mut all = vec![named.id.clone()];
                all.extend(named.equals.iter().cloned());
                all.join("/")
            })
            .collect(),
        truth: truth.required.iter().map(|list| list.join("/")).collect(),
        sealed: record.truth_sha256.clone(),
        held_out: said.main_held_out().map(|(_, errors)| {
            let oracle = truth.oracle_rms.as_ref().and_then(|oracle| oracle.holdout);
            (errors.before, errors.after, oracle)
        }),
        overlap: record.overlap,
        processor_s: record.said.as_ref().map(|said| said.taken.processor_s),
        without: record.judgement_without().map(|judged| judged.outcome),
    }
}

/// 12.3 % (4 of 33; 5 … 27 %).
pub fn shown(share: &Share) -> String {
    if share.of == 0 {
        return "not measured".to_owned();
    }
    format!(
        "{:.1} % ({} of {}; {:.0} … {:.0} %)",
        100.0 * share.value(),
        share.count,
        share.of,
        100.0 * share.low,
        100.0 * share.high
    )
}

fn targets(summary: &Summary) -> Vec<Target> {
    let share = |what: &str, wanted: &str, share: &Share, within: RangeInclusive<f64>| {
        let measured = share.of > 0;
        Target {
            what: what.to_owned(),
            wanted: wanted.to_owned(),
            found: shown(share),
            met: measured.then(|| within.contains(&share.value())),
            sure: measured.then(|| within.contains(&share.low) && within.contains(&share.high)),
        }
    };
    let others = &summary.others_together;
    let mut targets = vec![
        share(
            "right id or class, (a) and (b) together",
            "≥ 90 %",
            &others.right,
            0.9..=1.0,
        ),
        share(
            "confidently wrong, (a) and (b) together",
            "≤ 3 %",
            &others.confidently_wrong,
            0.0..=0.03,
        ),
    ];
    for line in &summary.clean {
        targets.push(share(
            &format!(
                "false alarms on clean recordings, {}",
                kind_title(&line.kind)
            ),
            "≤ 5 %",
            &line.anything,
            0.0..=0.05,
        ));
    }
    targets.push(share(
        "confidently wrong with the true effect taken out, (c) and (d)",
        "≤ 5 %",
        &summary.without.confidently_wrong,
        0.0..=0.05,
    ));
    for line in &summary.outside {
        targets.push(share(
            &format!(
                "confidently wrong where the effect is not in the library, {}",
                kind_title(&line.name)
            ),
            "≤ 5 %",
            &line.confidently_wrong,
            0.0..=0.05,
        ));
    }
    for (kind, covered) in &summary.coverage {
        targets.push(share(
            &format!(
                "95 % intervals with the truth in them, {}",
                kind_title(kind)
            ),
            "90 … 98 %",
            covered,
            0.9..=0.98,
        ));
    }
    targets.push(share(
        "95 % intervals that meet what was published, (a) real recordings",
        "90 … 98 %",
        &summary.published,
        0.9..=0.98,
    ));
    let compared: BTreeSet<&str> = summary
        .real
        .iter()
        .filter(|line| line.methods.values().any(applies))
        .map(|line| line.id.as_str())
        .collect();
    let ids = |list: &[(String, String)]| {
        list.iter()
            .map(|(id, _)| id.clone())
            .collect::<BTreeSet<String>>()
    };
    let worse = ids(&summary.beaten_on_real);
    let level = ids(&summary.level_on_real).difference(&worse).count();
    targets.push(Target {
        what: "real recordings on which the held-out error is lower than every baseline's"
            .to_owned(),
        wanted: "all".to_owned(),
        found: format!(
            "{} of {}; {level} level with the best (within 1 %), {} higher",
            compared.len() - worse.len() - level,
            compared.len(),
            worse.len()
        ),
        met: (!compared.is_empty()).then_some(worse.is_empty() && level == 0),
        sure: None,
    });
    targets.push(Target {
        what: "processor time of the fastest baseline that is right and fits as well, over twin's (median)".to_owned(),
        wanted: "≥ 10".to_owned(),
        found: summary
            .speed
            .map_or("not measured".to_owned(), |(ratio, cases)| format!("{ratio:.2} ({cases} cases)")),
        met: summary.speed.map(|(ratio, _)| ratio >= 10.0),
        sure: None,
    });
    targets
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use serde_json::{Value, json};

    /// A case of one effect, or none, and what a tool and a method named in it.
    fn record(group: &str, kind: &str, strength: f64, truth: Value, named: &[&str]) -> Value {
        let effects = truth["effects"].as_array().cloned().unwrap_or_default();
        let concealed: Vec<Value> = effects
            .iter()
            .map(|one| json!({ "id": one["id"], "strength": strength }))
            .collect();
        let mut whole = json!({ "kind": kind, "maker": "m" });
        for (name, value) in truth.as_object().into_iter().flatten() {
            whole[name] = value.clone();
        }
        let names: Vec<Value> = named
            .iter()
            .map(|id| json!({ "id": id, "signal": "i_meas_a", "equals": [], "parameters": [] }))
            .collect();
        json!({
            "key": "", "truth_sha256": "", "removed": [], "methods": {}, "parts_s": {},
            "planned": {
                "group": group, "without": false, "twice": false, "methods": [],
                "case": {
                    "id": "x", "maker": "m", "effects": concealed, "noise": "white", "drive": "us06", "seed": 1, "rows": 9,
                },
            },
            "truth": whole,
            "said": {
                "verdict": if named.is_empty() { "no-mismatch" } else { "explained" },
                "named": names, "locations": [], "held_out": {},
                "taken": { "seconds": 1.0, "processor_s": 1.0 },
            },
        })
    }

    fn summed(records: Vec<Value>) -> Summary {
        let records: Vec<Record> = records
            .into_iter()
            .map(|record| serde_json::from_value(record).unwrap())
            .collect();
        summary(&records, records.len(), "full", String::new(), 1)
    }

    fn gain(group: &str, kind: &str, strength: f64, named: &[&str]) -> Value {
        let truth = json!({ "effects": [{ "id": "gain" }], "required": [["gain"]] });
        record(group, kind, strength, truth, named)
    }

    #[test]
    fn the_strength_near_the_limit_is_told_by_who_made_the_data() {
        let summary = summed(vec![
            gain("single", "d", 3.0, &["gain"]),
            gain("single", "d", 10.0, &[]),
            gain("circuits", "b", 3.0, &["lag"]),
            gain("circuits", "b", 3.0, &["gain"]),
        ]);
        let of = |kind: &str| {
            let found = summary.just_plain.iter().find(|(one, _)| one == kind);
            found.map(|(_, right)| (right.count, right.of))
        };
        assert_eq!(
            (of("b"), of("d"), of("a")),
            (Some((1, 2)), Some((1, 1)), None)
        );
    }

    #[test]
    fn what_is_not_in_the_library_is_told_by_who_made_the_data() {
        let crossover = || json!({ "effects": [{ "id": "crossover" }] });
        let summary = summed(vec![
            record("circuits", "b", 10.0, crossover(), &["gain"]),
            record("circuits", "b", 10.0, crossover(), &[]),
            record("outside", "d", 10.0, crossover(), &[]),
            record("clean", "b", 0.0, json!({}), &["gain"]),
        ]);
        let shares: Vec<_> = summary
            .outside
            .iter()
            .map(|line| {
                (
                    line.name.as_str(),
                    line.confidently_wrong.count,
                    line.confidently_wrong.of,
                )
            })
            .collect();
        assert_eq!(shares, [("b", 1, 2), ("d", 0, 1)]);
    }

    #[test]
    fn forms_of_what_is_left_are_counted_where_the_library_lacks_the_effect() {
        let quadratic = |forms: &[&str]| {
            let truth = json!({ "effects": [{ "id": "quadratic" }] });
            let mut one = record("outside", "d", 10.0, truth, &[]);
            one["said"]["forms"] = json!(forms);
            one
        };
        let mut inside = gain("single", "d", 10.0, &["gain"]);
        inside["said"]["forms"] = json!(["step"]);
        let summary = summed(vec![
            quadratic(&["square"]),
            quadratic(&["cube", "square"]),
            quadratic(&["drift"]),
            quadratic(&[]),
            inside,
        ]);
        assert_eq!(
            summary.forms,
            [FormLine {
                effect: "quadratic".into(),
                kind: "d".into(),
                right: vec!["square".into(), "curve".into()],
                cases: 4,
                told: 2,
                another: 1,
            }]
        );
    }

    #[test]
    fn false_alarms_of_methods_are_of_the_kind_they_were_run_on() {
        let clean = |kind: &str, named: &[&str]| {
            let mut clean = record("clean", kind, 0.0, json!({}), &[]);
            clean["methods"] = json!({ "bic": { "named": named, "held_out_rms": 1.0 } });
            clean
        };
        let summary = summed(vec![
            clean("c", &["lag"]),
            clean("d", &[]),
            clean("d", &["lag"]),
        ]);
        let bic = summary
            .methods
            .iter()
            .find(|line| line.name == "bic")
            .unwrap();
        let of = |kind: &str| (bic.false_alarms[kind].count, bic.false_alarms[kind].of);
        assert_eq!((of("c"), of("d")), ((1, 1), (1, 2)));
    }

    #[test]
    fn a_method_that_failed_is_not_right_and_no_machine_that_broke_is_a_makers_limit() {
        let mut failed = gain("single", "d", 10.0, &["gain"]);
        failed["methods"] = json!({ "bic": { "error": "took too long" } });
        let mut broken = gain("single", "d", 10.0, &[]);
        let mut limit = broken.clone();
        for (one, why) in [
            (&mut broken, "ngspice is not installed"),
            (
                &mut limit,
                "offset: strength 30 cannot be had on this drive",
            ),
        ] {
            one["not_made"] = json!(why);
            one["truth"] = Value::Null;
            one["said"] = Value::Null;
        }
        let summary = summed(vec![failed, broken, limit]);
        let bic = summary
            .methods
            .iter()
            .find(|line| line.name == "bic")
            .unwrap();
        assert_eq!(
            (bic.cases, bic.errors, bic.right.count, bic.right.of),
            (1, 1, 0, 1)
        );
        assert_eq!((summary.errors.len(), summary.not_made.len()), (1, 1));
        assert_eq!((summary.cases, summary.with_data), (3, 1));
    }

    #[test]
    fn an_interval_counts_if_it_meets_what_was_published() {
        let real = |low: f64, high: f64| {
            let truth = json!({
                "required": [["gain"]], "standing": "published",
                "published": [{ "effect": "gain", "name": "gain", "value": 1.02, "low": 1.01, "high": 1.03 }],
            });
            let mut real = record("real", "a", 0.0, truth, &["gain"]);
            real["said"]["named"][0]["parameters"] =
                json!([{ "name": "gain", "value": 1.02, "low": low, "high": high }]);
            real
        };
        let summary = summed(vec![real(1.025, 1.04), real(1.031, 1.04), real(0.0, 1.005)]);
        assert_eq!((summary.published.count, summary.published.of), (1, 3));
    }
}
