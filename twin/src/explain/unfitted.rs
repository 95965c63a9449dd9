//! What files that were never fitted say of the effects.

use std::path::Path;

use super::beyond::beyond_known;
use super::dropout;
use super::fit;
use super::normal::dot;
use super::starts::begun;
use super::told::short;
use super::trust::{WAVERS, roughness};
use super::workbench::{Model, Workbench};
use super::{Holdout, Selection, rms, select};
use crate::effects::lacks;
use crate::report::data::HoldoutReport;

/// An effect that makes the error in another file larger by this factor is not that file's physics.
const WORSE: f64 = 1.05;
/// A file that was never fitted confirms the effects if they bring its error down to this share.
const CONFIRMED: f64 = 0.6;
/// Places in a turn that are tried for a file that was never fitted.
const PHASES: f64 = 24.0;
/// What is left in a file that was never fitted is told from this multiple of the stated noise on.
const TOLD_NOISE: f64 = 3.0;

/// A file that was never fitted, ready to be predicted.
pub(super) struct Unfitted<'a> {
    file: &'a Path,
    bench: Workbench<'a>,
    /// What the simulation as designed leaves, begun as this file does.
    mismatch: Vec<f64>,
}

impl<'a> Unfitted<'a> {
    /// Every such file that has a signal.
    pub(super) fn all(holdouts: &'a [Holdout], signal: &str) -> Vec<Self> {
        let problems = holdouts
            .iter()
            .flat_map(|holdout| holdout.problems.iter().map(move |other| (holdout, other)));
        problems
            .filter(|(_, other)| other.name == signal)
            .map(|(holdout, other)| {
                let bench = Workbench::new(other, &[]);
                Self {
                    file: &holdout.file,
                    mismatch: begun(&bench, Model::default()).1,
                    bench,
                }
            })
            .collect()
    }

    /// Its line in the report.
    pub(super) fn report(&self, model: &Model) -> HoldoutReport {
        HoldoutReport {
            file: self.file.display().to_string(),
            signal: self.bench.problem.name.clone(),
            rmse_before: self.rmse_before(),
            rmse_after: self.rmse(model),
        }
    }

    /// What is left there, where that is far more than the stated noise.
    pub(super) fn left(&self, model: &Model) -> Option<String> {
        let problem = self.bench.problem;
        let left = self.rmse(model);
        (problem.noise > 0.0 && left > TOLD_NOISE * problem.noise).then(|| {
            format!(
                "In {}, which was never fitted, {} {} are left, {} times the stated noise.",
                self.file.display(),
                short(left),
                problem.unit,
                short(left / problem.noise)
            )
        })
    }

    /// Stretches of it that no physics makes, in what a model leaves.
    pub(super) fn dropouts(&self, model: &Model) -> Option<String> {
        let said = dropout::of_unfitted(&self.bench, &self.left_by(model))?;
        Some(format!("{}: {said}", self.file.display()))
    }

    /// What is taken of its resistances, where it is colder or warmer than what was fitted.
    pub(super) fn beyond(&self, model: &Model) -> Option<String> {
        let at_c = model.nuisance.resistances_at_c?;
        let beyond = beyond_known(&self.bench.problem.drive, at_c)?;
        Some(format!("{}: {beyond}", self.file.display()))
    }

    /// What of a model does nothing there, as the file has nothing of what it goes by.
    pub(super) fn idle(&self, model: &Model) -> Vec<String> {
        let problem = self.bench.problem;
        let stated = problem.modelled.iter().map(|(id, _)| *id);
        let found = model.members.iter().map(|member| member.id());
        let idle = model.members.iter().filter_map(|member| {
            let columns = lacks(member.effect, problem, stated.clone().chain(found.clone()))?;
            Some(format!(
                "{}: {}, found in {}, does nothing there: no column {columns}",
                self.file.display(),
                member.id(),
                problem.name
            ))
        });
        idle.collect()
    }

    /// Error with a model.
    fn rmse(&self, model: &Model) -> f64 {
        rms(self.left_by(model).into_iter())
    }

    /// What a model leaves as it is taken to this file: how a file starts, and where in a turn, is its own; the physics is not.
    fn left_by(&self, model: &Model) -> Vec<f64> {
        let (mut model, residual) = begun(&self.bench, model.clone());
        let mut turned = false;
        let error = |model: &Model| rms(self.bench.residual(&self.bench.run(model)).into_iter());
        for m in 0..model.members.len() {
            let member = &model.members[m];
            let internal = member.effect.card().parameters.iter();
            let Some(p) = internal.clone().position(|parameter| parameter.internal) else {
                continue;
            };
            let Some(turn) = member.effect.turn(&member.values) else {
                continue;
            };
            let mut best = (error(&model), member.values[p]);
            for step in [1.0, 0.25, 0.0625].map(|share| share * turn / PHASES) {
                let around = best.1;
                for k in 0..PHASES as i32 {
                    let mut tried = model.clone();
                    tried.members[m].values[p] = around + (f64::from(k) - 0.5 * PHASES) * step;
                    let there = error(&tried);
                    if there < best.0 {
                        best = (there, tried.members[m].values[p]);
                    }
                }
            }
            model.members[m].values[p] = best.1;
            turned = true;
        }
        if turned {
            self.bench.residual(&self.bench.run(&model))
        } else {
            residual
        }
    }

    /// Error as designed.
    fn rmse_before(&self) -> f64 {
        rms(self.mismatch.iter().copied())
    }

    /// How many times the change that a model makes here is in this file's mismatch, and the standard error of that: regression of
    /// the one on the other, blocks as clusters (Liang and Zeger 1986). 1 is what a true effect has; `None` without a change.
    fn times_there(&self, model: &Model) -> Option<(f64, f64)> {
        let mismatch = &self.mismatch;
        let left = self.left_by(model);
        let change: Vec<f64> = mismatch.iter().zip(&left).map(|(a, b)| a - b).collect();
        let blocks = &self.bench.blocks;
        let energy: f64 = blocks
            .iter()
            .map(|rows| dot(&change[rows.clone()], &change[rows.clone()]))
            .sum();
        if blocks.len() < 2 || energy <= 0.0 {
            return None;
        }
        let along: f64 = blocks
            .iter()
            .map(|rows| dot(&change[rows.clone()], &mismatch[rows.clone()]))
            .sum();
        let times = along / energy;
        let scatter: f64 = blocks
            .iter()
            .map(|rows| {
                let of_block = rows
                    .clone()
                    .map(|row| change[row] * (mismatch[row] - times * change[row]));
                of_block.sum::<f64>().powi(2)
            })
            .sum();
        let count = blocks.len() as f64;
        Some((times, (scatter * count / (count - 1.0)).sqrt() / energy))
    }
}

/// What files that were never fitted say against the effects: the share, in energy, of their change that is too much or too
/// little there, and in which file, where that is more than an equation's being idealised and chance make it.
pub(super) fn not_there(
    bench: &Workbench<'_>,
    selection: &Selection,
    others: &[Unfitted<'_>],
) -> Option<(f64, String)> {
    let members = &selection.fit.model.members;
    let rough = members
        .iter()
        .map(|member| roughness(bench, member))
        .fold(0.0, f64::max);
    others
        .iter()
        .filter_map(|other| {
            let (times, error) = other.times_there(&selection.fit.model)?;
            let off = (1.0 - times).abs();
            (off - select::CERTAIN * error > WAVERS * rough).then(|| {
                let text = format!(
                    "{}, which was never fitted, has {} times the change that is expected there",
                    other.file.display(),
                    short(times)
                );
                (off.powi(2), text)
            })
        })
        .max_by(|a, b| a.0.total_cmp(&b.0))
}

/// Whether every file that was never fitted is predicted much better with the effects than without.
pub(super) fn confirmed(selection: &Selection, others: &[Unfitted<'_>]) -> bool {
    let better =
        |other: &Unfitted<'_>| other.rmse(&selection.fit.model) <= CONFIRMED * other.rmse_before();
    !others.is_empty() && others.iter().all(better)
}

/// Takes effects out again that make the prediction of files that were never fitted worse; which.
pub(super) fn veto(
    bench: &Workbench<'_>,
    selection: &mut Selection,
    others: &[Unfitted<'_>],
) -> Vec<&'static str> {
    let mut vetoed = Vec::new();
    if others.is_empty() {
        return vetoed;
    }
    let worst = |with: &Model, without: &Model| -> f64 {
        others
            .iter()
            .map(|other| other.rmse(with) / other.rmse(without).max(1e-300))
            .fold(0.0, f64::max)
    };
    while !selection.named.is_empty() {
        let count = selection.fit.model.members.len();
        let worse_with = |out: Vec<Vec<usize>>| {
            let tried = out.into_iter().map(|out| {
                let without = out
                    .iter()
                    .rev()
                    .fold(selection.fit.model.clone(), |model, index| {
                        model.without(*index)
                    });
                let without = fit::fit(bench, &without, None);
                let ratio = worst(&selection.fit.model, &without.model);
                (out, without, ratio)
            });
            tried
                .max_by(|a, b| a.2.total_cmp(&b.2))
                .filter(|(_, _, ratio)| *ratio > WORSE)
        };
        let single = (0..count).map(|index| vec![index]).collect();
        // Two that make up for each other here show there only if both are left out.
        let pairs = || {
            let pairs = (0..count).flat_map(|one| (one + 1..count).map(move |two| vec![one, two]));
            pairs.collect()
        };
        let Some((out, without, ratio)) = worse_with(single).or_else(|| worse_with(pairs())) else {
            break;
        };
        let ids: Vec<&'static str> = out
            .iter()
            .map(|index| selection.fit.model.members[*index].id())
            .collect();
        let verb = if ids.len() == 1 {
            "fits here, but makes"
        } else {
            "fit here, but make"
        };
        selection.refused.push(format!(
            "{}: {verb} the error in a file that was not fitted {ratio:.2} times as large",
            ids.join(" with ")
        ));
        vetoed.extend(ids);
        selection.fit = select::settled(bench, &without);
        selection.rename(bench);
    }
    vetoed
}
