//! A reference between its rows: in straight lines, or smoothly.

use std::borrow::Cow;

use super::fit::{self, Fit};
use super::unfitted::Unfitted;
use super::workbench::{Member, Model, Workbench};
use super::{Decided, Holdout, Options, decide, gained};
use crate::effects::Search;
use crate::problem::Problem;

/// A signal with the files that were never fitted, as the reference goes from row to row: in straight lines, or smoothly.
pub(super) struct Course<'a> {
    pub(super) problem: Cow<'a, Problem>,
    pub(super) holdouts: Cow<'a, [Holdout]>,
}

impl Course<'_> {
    /// The smooth one, if there may be one, and whether the rows alone tell that it is.
    pub(super) fn smooth(&self) -> Option<(Course<'static>, bool)> {
        let (problem, told) = self.problem.smoothed()?;
        let smooth = |holdout: &Holdout| Holdout {
            file: holdout.file.clone(),
            problems: holdout
                .problems
                .iter()
                .map(Problem::with_smooth_reference)
                .collect(),
        };
        let smooth = Course {
            holdouts: self.holdouts.iter().map(smooth).collect(),
            problem: Cow::Owned(problem),
        };
        Some((smooth, told))
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
            } else if parameter.search == Search::Linear && effect.idealised() == 0.0 {
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
