//! A reference between its rows: in straight lines, smoothly, or at one value.

use std::borrow::Cow;

use super::dropout::{self, Dropout};
use super::fit::{self, Fit};
use super::normal::dot;
use super::slope;
use super::unfitted::Unfitted;
use super::workbench::{Member, Model, Workbench};
use super::{Decided, Holdout, Options, decide, gained, lead_in, rms};
use crate::problem::{Holds, Problem, View};
use crate::report::data::Verdict;

/// The reference goes smoothly from row to row, or stays, if that makes the loss smaller by this (odds of e¹⁰, for no value more); where its
/// rows alone tell so, unless it makes it larger by this.
const CLEARLY: f64 = 10.0;
/// A sensor's reference may be held if the nearest single time leaves less than this share of the squared error that it leaves with
/// straight lines: an edge that is off by half a row is most of what is left beside edges.
const MOSTLY: f64 = 0.5;

/// What a battery remembers of before the recording has faded within this share of the recording's time, to …
const FADES_WITHIN: f64 = 0.25;
/// … where this share of its energy is.
const FADED: f64 = 0.9;

/// A signal with the files that were never fitted, as the reference goes from row to row.
pub(super) struct Course<'a> {
    pub(super) problem: Cow<'a, Problem>,
    pub(super) holdouts: Cow<'a, [Holdout]>,
}

/// What a battery's problem may be beside what it is: a form of it that the model file does not exclude.
#[derive(Clone, Copy)]
enum Form {
    /// [`Problem::with_holding`].
    Holding(Holds),
    /// [`Problem::with_open_begin`].
    OpenBegin,
}

impl Form {
    fn of(self, problem: &Problem) -> Problem {
        match self {
            Self::Holding(holds) => problem.with_holding(holds),
            Self::OpenBegin => problem.with_open_begin(),
        }
    }

    /// All is decided again from this gain on of what was named. Nothing but a counter tells what a current does between its rows, so that what
    /// is as good counts; what a log begins with is its first minutes'.
    fn asked_from(self) -> f64 {
        match self {
            Self::Holding(_) => -CLEARLY,
            Self::OpenBegin => CLEARLY,
        }
    }

    /// Whether what was decided with it is what the form says: what a battery remembers of before fades, or it is a drift of the whole
    /// recording, which has other reasons.
    fn stands(self, course: &Course<'_>, decided: &Decided) -> bool {
        if let Self::Holding(_) = self {
            return true;
        }
        let bench = Workbench::new(&course.problem, &[]);
        let with = &decided.selection.fit.model;
        let mut without = with.clone();
        without.nuisance.before_a = 0.0;
        let remembered = slope::change(&bench.run(with), &bench.run(&without));
        let end_s = |share: f64| {
            bench
                .t_s
                .first()
                .map(|from| from + share * bench.scale.span_s)
        };
        let early = bench
            .t_s
            .partition_point(|t| Some(*t) < end_s(FADES_WITHIN));
        let energy = |rows: &[f64]| rows.iter().map(|v| v * v).sum::<f64>();
        energy(&remembered[..early]) >= FADED * energy(&remembered)
    }

    /// What is held against a name that turns on it.
    fn but_if(self) -> String {
        match self {
            Self::Holding(holds) => format!(
                "not if each row's current {}, which no counter tells (current_holds = \"{}\" in [battery])",
                holds.in_words(),
                holds.as_str()
            ),
            Self::OpenBegin => {
                "not if another current flowed before the recording, which begins under load or not long after"
                    .to_owned()
            }
        }
    }
}

/// The error that a fit leaves, rms.
fn left(fit: &Fit) -> f64 {
    rms(fit.residual.iter().copied())
}

/// What is decided about a signal, on the course of the reference that it is decided on.
pub(super) struct Answer {
    /// The course, if it is not in straight lines.
    pub(super) other: Option<Course<'static>>,
    pub(super) decided: Decided,
    /// What the answer leaves of the readings as they were read.
    pub(super) shown: Fit,
    /// The error with straight lines and with that course.
    pub(super) between: Option<[f64; 2]>,
}

impl Answer {
    fn straight((decided, shown): (Decided, Fit)) -> Self {
        Self {
            other: None,
            decided,
            shown,
            between: None,
        }
    }

    fn on(other: Course<'static>, (decided, shown): (Decided, Fit), straight: &Fit) -> Self {
        let errors = [straight, &shown].map(left);
        Self {
            other: Some(other),
            decided,
            shown,
            between: Some(errors),
        }
    }

    /// How far, in s, readings that the answer cannot foretell reach out of their stretch, before and after, if there are such.
    pub(super) fn reach_s(&self, straight: &Course<'_>, options: &Options) -> Option<[f64; 2]> {
        if !self.decided.asks_between() {
            return None;
        }
        let course = self.other.as_ref().unwrap_or(straight);
        let bench = Workbench::new(&course.problem, &options.without);
        if self.decided.names_nothing() {
            // Such readings may be why.
            return lead_in::missed(&bench, &course.nearest(options)?);
        }
        lead_in::missed(&bench, &self.shown)
    }

    /// Stretches of the log that no physics makes, where they may be in the way of this answer.
    pub(super) fn dropouts(&self, straight: &Course<'_>, options: &Options) -> Vec<Dropout> {
        let decided = &self.decided;
        if !decided.leaves_something() {
            return Vec::new();
        }
        let course = self.other.as_ref().unwrap_or(straight);
        let bench = Workbench::new(&course.problem, &options.without);
        // Where nothing is named, what is nearest to a name is not to hide them.
        let nearest = (decided.names_nothing() && course.problem.view == View::Sensor)
            .then(|| course.nearest(options))
            .flatten();
        let fit = dropout::without_far(&bench, nearest.as_ref().unwrap_or(&self.shown));
        dropout::found(&bench, &fit.residual)
    }
}

impl<'a> Course<'a> {
    /// Straight lines. What flowed before a file that was never fitted is that file's own, as its start is.
    pub(super) fn new(problem: &'a Problem, holdouts: &'a [Holdout]) -> Self {
        let course = Self {
            problem: Cow::Borrowed(problem),
            holdouts: Cow::Borrowed(holdouts),
        };
        let open = |one: &Problem| one.begins_loaded();
        if !holdouts
            .iter()
            .any(|holdout| holdout.problems.iter().any(open))
        {
            return course;
        }
        Course {
            problem: course.problem.clone(),
            ..course.with(problem.clone(), Problem::with_open_begin)
        }
    }
}

impl Course<'_> {
    /// The smooth one, if there may be one, and whether the rows alone tell that it is.
    pub(super) fn smooth(&self) -> Option<(Course<'static>, bool)> {
        let (problem, told) = self.problem.smoothed()?;
        Some((self.with(problem, Problem::with_smooth_reference), told))
    }

    /// The one whose reference stays at one value between its rows, of both the one that the readings are nearer to, if they are much
    /// nearer to it than to straight lines.
    fn held(&self, options: &Options) -> Option<Course<'static>> {
        if !self.problem.may_be_held() {
            return None;
        }
        let squares = |fit: &Fit| dot(&fit.residual, &fit.residual);
        let straight = squares(&self.nearest(options)?);
        let held = Holds::ALL.into_iter().filter_map(|holds| {
            let course = self.with(self.problem.with_held_reference(holds), |other| {
                other.with_held_reference(holds)
            });
            let left = squares(&course.nearest(options)?);
            Some((course, left))
        });
        let (course, left) = held.min_by(|one, other| one.1.total_cmp(&other.1))?;
        (left < MOSTLY * straight).then_some(course)
    }

    /// Another form of the problem, and the same of the files that were never fitted.
    fn with(&self, problem: Problem, form: impl Fn(&Problem) -> Problem) -> Course<'static> {
        let holdout = |holdout: &Holdout| Holdout {
            file: holdout.file.clone(),
            problems: holdout.problems.iter().map(&form).collect(),
        };
        Course {
            problem: Cow::Owned(problem),
            holdouts: self.holdouts.iter().map(holdout).collect(),
        }
    }

    /// Whether what was named on another course, fitted here, makes the loss smaller by so much: if not, to decide again is in vain.
    /// Where nothing was named there is nothing to ask with.
    pub(super) fn may_fit(&self, other: &Decided, shown: &Fit, by: f64) -> bool {
        other.names_nothing() || gained(shown, &self.left_by(&other.selection.fit.model)) > by
    }

    /// What a model leaves of this course, fitted to it as it was read.
    pub(super) fn left_by(&self, model: &Model) -> Fit {
        fit::fit(&Workbench::new(&self.problem, &[]), model, None)
    }

    /// The best fit of a single time (the effects between the rows that have one value) with a factor and a constant (the exact linear
    /// ones); nothing if the library has no such time.
    pub(super) fn nearest(&self, options: &Options) -> Option<Fit> {
        let bench = Workbench::new(&self.problem, &options.without);
        let clues = bench.clues(&bench.plain);
        let mut plainest = Model::default();
        let mut times = Vec::new();
        for effect in bench.library.iter().copied() {
            let card = effect.card();
            let [parameter] = card.parameters else {
                continue;
            };
            if card.stage.is_between_rows() {
                times.push(effect);
            } else if effect.is_plainest() {
                let values = vec![parameter.off];
                plainest.members.push(Member { effect, values });
            }
        }
        let fits = times.into_iter().filter_map(|effect| {
            let starts = effect.starts(&bench.scale, &clues).into_iter();
            let models = starts.map(|values| plainest.with(Member { effect, values }));
            models
                .map(|model| Fit::of(&bench, model, 0.0))
                .min_by(|one, other| gained(one, other).total_cmp(&0.0))
                .map(|start| fit::fit(&bench, &start.model, None))
        });
        fits.min_by(|one, other| gained(one, other).total_cmp(&0.0))
    }

    /// Decided in straight lines or as a smooth course, whichever may be better, or both ways; where that leaves something, with a reference
    /// that is held too.
    pub(super) fn answered(
        &self,
        options: &Options,
        progress: &mut dyn FnMut(f64, &str),
    ) -> Answer {
        let answer = self.answered_bent(options, progress);
        let decided = &answer.decided;
        let is_open = decided.asks_between() && decided.leaves_something();
        let Some(held) = is_open.then(|| self.held(options)).flatten() else {
            return answer;
        };
        let (again, there) = held.decided(options, progress);
        // A load that is switched may be nearer to edges at the rows and have them at other moments: then something is left again.
        if again.says_more_than(decided) && gained(&answer.shown, &there) > CLEARLY {
            return Answer::on(held, (again, there), &answer.shown);
        }
        answer
    }

    /// The same of what is not held.
    fn answered_bent(&self, options: &Options, progress: &mut dyn FnMut(f64, &str)) -> Answer {
        let Some((smooth, told)) = self.smooth() else {
            return self.answered_of_battery(options, progress);
        };
        let enough = if told { -CLEARLY } else { CLEARLY };
        // Where the smooth one is clearly nearer to begin with, the straight one would lead to names of what it lacks.
        let [from, to] = [self, &smooth].map(|course| course.nearest(options));
        let nearer = from
            .zip(to)
            .is_some_and(|(from, to)| gained(&from, &to) > CLEARLY);
        let mut ahead = None;
        if nearer {
            let (decided, shown) = smooth.decided(options, progress);
            let otherwise = self.left_by(&decided.selection.fit.model);
            let names = !decided.names_nothing() && decided.asks_between();
            if names && gained(&otherwise, &shown) > enough {
                return Answer::on(smooth, (decided, shown), &otherwise);
            }
            ahead = Some((decided, shown));
        }
        let (decided, shown) = self.decided(options, progress);
        if decided.asks_between() && smooth.may_fit(&decided, &shown, enough) {
            let (again, there) = ahead.unwrap_or_else(|| smooth.decided(options, progress));
            if gained(&shown, &there) > enough {
                return Answer::on(smooth, (again, there), &shown);
            }
        }
        Answer::straight((decided, shown))
    }

    /// The same of a battery, of which the model file leaves open what its current does between its rows, and did before the first.
    fn answered_of_battery(
        &self,
        options: &Options,
        progress: &mut dyn FnMut(f64, &str),
    ) -> Answer {
        let mut answer = Answer::straight(self.decided(options, progress));
        if answer.decided.verdict != Verdict::NoMismatch && self.problem.may_hold() {
            let holds = Holds::ALL.map(Form::Holding);
            answer = self.answered_or(answer, &holds, options, progress);
        }
        if self.problem.begins_loaded() {
            answer = self.answered_or(answer, &[Form::OpenBegin], options, progress);
        }
        answer
    }

    /// An answer, or that on the form of the problem that what was named fits best, if it is clearly better.
    fn answered_or(
        &self,
        mut answer: Answer,
        forms: &[Form],
        options: &Options,
        progress: &mut dyn FnMut(f64, &str),
    ) -> Answer {
        let agrees = |decided: &Decided| decided.verdict == Verdict::NoMismatch;
        let agreed = agrees(&answer.decided);
        let here = answer.other.as_ref().unwrap_or(self);
        let model = &answer.decided.selection.fit.model;
        let nearest = forms
            .iter()
            .map(|form| {
                let course = here.with(form.of(&here.problem), |other| form.of(other));
                let gained = gained(&answer.shown, &course.left_by(model));
                (form, course, gained)
            })
            .max_by(|one, other| one.2.total_cmp(&other.2));
        let Some((form, course, nearer)) = nearest else {
            return answer;
        };
        let is_open = answer.decided.names_nothing() && !agreed;
        if !is_open && nearer <= form.asked_from() {
            return answer;
        }
        let (again, there) = course.decided(options, progress);
        let better = gained(&answer.shown, &there);
        // Where nothing was missing nothing is.
        let may_stand = better > CLEARLY && (!agreed || agrees(&again));
        if may_stand && form.stands(&course, &again) {
            let straight = answer
                .between
                .map_or_else(|| left(&answer.shown), |[straight, _]| straight);
            return Answer {
                between: Some([straight, left(&there)]),
                ..Answer::on(course, (again, there), &answer.shown)
            };
        }
        // As good either way, and what is named turns on it.
        let names = answer.decided.names();
        if better > -CLEARLY && !names.is_empty() && again.names() != names {
            answer.decided.verdict = Verdict::Ambiguous;
            answer.decided.but = Some(form.but_if());
        }
        answer
    }

    /// The same without the readings that reach so far, in s, out of their stretch ([`lead_in`]).
    pub(super) fn without_ends(&self, reach_s: [f64; 2]) -> Course<'static> {
        let without = |problem: &Problem| lead_in::without(problem, reach_s);
        self.with(without(&self.problem), |other| {
            if other.name == self.problem.name {
                without(other)
            } else {
                other.clone()
            }
        })
    }

    /// The same without the readings of some stretches ([`dropout`]).
    pub(super) fn without_dropouts(&self, dropouts: &[Dropout]) -> Course<'static> {
        self.with(dropout::without(&self.problem, dropouts), Problem::clone)
    }

    /// What is decided about it, and what that leaves of the readings.
    pub(super) fn decided(
        &self,
        options: &Options,
        progress: &mut dyn FnMut(f64, &str),
    ) -> (Decided, Fit) {
        let read = Workbench::new(&self.problem, &options.without);
        // Noise with a memory is made white for all that is decided; what is shown is as it was read.
        let white = read.whitened();
        let bench = white.as_ref().unwrap_or(&read);
        let others = Unfitted::all(&self.holdouts, &self.problem.name);
        let mut decided = decide((bench, &read), &others, options.seed, progress);
        // Behind what cuts or rounds, noise is not what the model file states: there readings have to do as they are.
        if bench.is_white() && (decided.names_nothing() || decided.names_a_cut()) {
            let again = decide((&read, &read), &others, options.seed, progress);
            if again.names_a_cut() || (decided.names_a_cut() && !again.names_nothing()) {
                decided = again;
            }
        }
        let bench = decided.bench(&read, white.as_ref());
        let shown = decided.selection.fit.as_read(bench, &read);
        (decided, shown)
    }
}
