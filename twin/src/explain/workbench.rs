//! One problem, ready to be fitted: the rows that count, blocks of them, and what sizes are natural.

use std::borrow::Cow;
use std::collections::{HashMap, VecDeque};
use std::ops::Range;
use std::sync::{Arc, Mutex};

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng as _;
use rand_distr::{Distribution as _, StandardNormal};

use super::apart::reads_apart;
use super::censored::{Censored, Contradiction};
use super::robust::spread;
use super::screen::Screened;
use super::slope::change;
use super::starts::Start;
use super::steady::Steady;
use super::whiten::Whitening;
use crate::effects::chain::{Begun, Chain, Change, Nuisance, Variation};
use crate::effects::ocv::bend_v;
use crate::effects::scene::{ROUNDS, Scale, charge_range};
use crate::effects::{Clues, Effect, LIBRARY, Mark, Parameter, Says, Stage, find_with};
use crate::problem::{
    Base, Coloured, Drive, Moments, Problem, Series, View, median_step_s, spread_out,
};

/// Rows that fits look at; of longer recordings one is drawn from each of as many stretches (the simulation still runs over every row). [`Problem::thinned`]
/// does so ahead, for less memory; here it is done for what it leaves as it is.
pub const MOST_ROWS: usize = 250_000;
/// Values in the columns of the screenings that are remembered: 64 MB.
const MOST_SCREENED: usize = 8_000_000;
/// Blocks that are held out in turn.
const BLOCKS: usize = 24;
/// Rows that a block has at least: with fewer than eight blocks, random signs would be all the same too often to be placebos.
const LEAST_ROWS: usize = 6;
/// Share of a block that is left out at its end, so that neighbours do not tell each other's noise.
const GUARD: f64 = 0.08;
/// What is below the mean by more than a standard deviation, as a share of a normal distribution.
const SIXTH: f64 = 0.1587;
/// Steps whose standard deviation is a larger share of them are no even ones with a jitter.
const JITTER: f64 = 0.3;

/// An effect with values.
#[derive(Clone)]
pub struct Member {
    /// The effect.
    pub effect: &'static dyn Effect,
    /// A value for each of its parameters.
    pub values: Vec<f64>,
}

impl std::fmt::Debug for Member {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}{:?}", self.id(), self.values)
    }
}

impl Member {
    /// Its effect's id.
    pub fn id(&self) -> &'static str {
        self.effect.card().id
    }

    /// Its effect's id and how many values that has: an effect may have several forms.
    pub fn form(&self) -> (&'static str, usize) {
        (self.id(), self.values.len())
    }
}

/// A model: effects with values, and what the base may differ by.
#[derive(Clone, Debug, Default)]
pub struct Model {
    /// Effects.
    pub members: Vec<Member>,
    /// The base.
    pub nuisance: Nuisance,
    /// Samples stand at their rows, though an effect works between them.
    pub unaligned: bool,
    /// A value that fits leave as it is: its member and its place there.
    pub held: Option<(usize, usize)>,
}

impl Model {
    /// Whether an effect of this id is in it.
    pub fn has(&self, id: &str) -> bool {
        self.members.iter().any(|member| member.id() == id)
    }

    /// Whether one of its effects says this of the base.
    pub fn says(&self, what: Says) -> bool {
        self.members
            .iter()
            .any(|member| member.effect.says() == Some(what))
    }

    /// With one more effect.
    pub fn with(&self, member: Member) -> Self {
        let mut model = self.clone();
        model.members.push(member);
        model
    }

    /// Without the effect at an index.
    pub fn without(&self, index: usize) -> Self {
        let mut model = self.clone();
        model.members.remove(index);
        if model.members.is_empty() {
            // As designed, nothing was found at any temperature.
            model.nuisance.resistances_at_c = None;
        }
        model
    }

    /// Ids in the order of the library.
    pub fn ids(&self) -> Vec<&'static str> {
        self.members.iter().map(Member::id).collect()
    }
}

/// See the module. Where the noise is made white ([`Workbench::whitened`]), simulations and residuals are those of innovations, which
/// is what fits and decisions are made of; [`Workbench::as_read`] leads back.
#[allow(missing_debug_implementations, reason = "effects are functions")]
pub struct Workbench<'a> {
    /// The problem.
    pub problem: &'a Problem,
    chain: Chain<'a>,
    /// Natural sizes.
    pub scale: Scale,
    /// Noise of the reference that its standstills show in the rows of the readings, rms, in the view's unit; 0 if they show none.
    pub reference_noise: f64,
    /// Energy of what standstills' means are off by, which a curve of the current takes for its own.
    pub standstills_left: f64,
    /// Ranges of the rows that count in which the current stands still, where the reference shows noise there.
    standstills: Vec<Range<usize>>,
    /// Observed rows that fits look at.
    pub rows: Vec<usize>,
    /// Their time in s.
    pub t_s: Vec<f64>,
    /// Their readings.
    pub y: Vec<f64>,
    /// The simulation as designed, at those rows, as read.
    pub plain: Vec<f64>,
    /// The drive's reference, but for what noise makes of it at a standstill: what readings are looked at over.
    pub steady: Series,
    /// The simulation of it as designed, at those rows, ahead of what censors (for battery views the current).
    pub reference: Vec<f64>,
    /// Ranges of those rows that are held out in turn, guards left out.
    pub blocks: Vec<Range<usize>>,
    /// At which states of charge operations begin, where that is not known exactly.
    pub starts: Vec<Start>,
    /// Lines of the open-circuit voltage's table that may be bent by more than what readings are off by and than a part of the mismatch,
    /// with by how much, in V of one cell.
    pub(super) bends: Vec<(usize, f64)>,
    /// Whether voltages were read at another moment than the currents of their rows.
    pub(super) apart: bool,
    /// Effects that may be named.
    pub library: Vec<&'static dyn Effect>,
    /// Energy by which the equations of the effects that the model file has may be off.
    pub modelled: f64,
    /// Fits that were made: from which model to which, with spread and loss.
    known: Mutex<HashMap<Key, (Model, f64, f64)>>,
    /// The last screenings, by the model whose residual was screened, the newest first.
    screened: Mutex<VecDeque<(ScreenedKey, Arc<Screened>)>>,
    /// What the readings show by themselves or beside the simulation as designed, by effect: found once.
    marks: Vec<(&'static str, Mark)>,
    /// Readings that tell no more than within what the signal was: simulations stop short of what makes them so.
    pub(super) censored: Option<Censored>,
    /// Readings that the model file's thresholds, steps or rails would not let through.
    pub(super) contradiction: Option<Contradiction>,
    /// Makes the stated noise white, with the readings after it.
    white: Option<(Whitening, Vec<f64>)>,
}

/// A bend of the open-circuit voltage that is less than this share of the mismatch, rms, is no reason for it.
const BENT: f64 = 0.03;
/// Lines that may bend at most, those that may most.
const MOST_BENDS: usize = 16;

/// See [`Workbench::bends`].
fn bends(problem: &Problem, mismatch: f64) -> Vec<(usize, f64)> {
    let Base::Battery(base) = &problem.base else {
        return Vec::new();
    };
    let lines = 0..base.ocv.len().saturating_sub(1);
    let seen_v = problem.noise + problem.accuracy.zero;
    let least_v = seen_v.max(BENT * mismatch);
    let mut bends: Vec<(usize, f64)> = lines
        .map(|line| (line, bend_v(&base.ocv, line)))
        .filter(|(_, bend_v)| problem.view == View::Voltage && *bend_v > least_v)
        .map(|(line, bend_v)| (line, bend_v / base.cells))
        .collect();
    bends.sort_by(|a, b| b.1.total_cmp(&a.1));
    bends.truncate(MOST_BENDS);
    bends.sort_unstable_by_key(|(line, _)| *line);
    bends
}

/// A model to the last digit.
type Key = (
    Vec<(&'static str, Vec<u64>)>,
    Vec<u64>,
    bool,
    Option<(usize, usize)>,
);

/// The same with [`Nuisance::resistances_at_c`], which no fit begins from.
type ScreenedKey = (Key, Option<[f64; 2]>);

fn key(model: &Model) -> Key {
    let bits = |values: &[f64]| values.iter().map(|value| value.to_bits()).collect();
    let nuisance = &model.nuisance;
    (
        model
            .members
            .iter()
            .map(|member| (member.id(), bits(&member.values)))
            .collect(),
        bits(
            &[
                nuisance.soc_shift.as_slice(),
                // Where the starts end, of which there may be any number; and the gaps.
                &[f64::NAN],
                nuisance.gap_soc_shift.as_slice(),
                &[f64::NAN],
                nuisance.ocv_bend_v.as_slice(),
                &[
                    nuisance.resistance,
                    nuisance.current_zero_a,
                    nuisance.before_a,
                    nuisance.alignment_s,
                ],
            ]
            .concat(),
        ),
        model.unaligned,
        model.held,
    )
}

impl<'a> Workbench<'a> {
    /// For a problem; `without` takes effects out of the library.
    pub fn new(problem: &'a Problem, without: &[String]) -> Self {
        let chain = Chain::new(problem);
        let all = chain.run(&[], &Nuisance::default());
        let observed = &problem.observed;
        let valid = (0..observed.t_s.len()).filter(|&row| {
            observed.valid[row] && observed.value[row].is_finite() && all[row].is_finite()
        });
        let rows = spread_out(valid.clone(), MOST_ROWS);
        let every_s = if observed.thinned_from_s > 0.0 {
            observed.thinned_from_s
        } else {
            median_step_s(valid.map(|row| observed.t_s[row]))
        };
        let at = |series: &[f64]| rows.iter().map(|&row| series[row]).collect::<Vec<f64>>();
        let (t_s, y, designed) = (at(&observed.t_s), at(&observed.value), at(&all));
        let (censored, contradiction) = match Censored::of(problem, &y) {
            Ok(censored) => (censored, None),
            Err(contradiction) => (None, Some(contradiction)),
        };
        // What a censored reading says is not what an equation makes of the signal.
        let speaks = |effect: &dyn Effect| censored.is_none() || !effect.cuts();
        let modelled = (0..problem.modelled.len())
            .filter_map(|index| {
                let (id, values) = &problem.modelled[index];
                let effect = find_with(id, values.len()).filter(|effect| speaks(*effect))?;
                let share = effect.idealised();
                let mut without = problem.clone();
                without.modelled.remove(index);
                let without = Chain::new(&without).run(&[], &Nuisance::default());
                let energy: f64 = rows
                    .iter()
                    .map(|&row| (all[row] - without[row]).powi(2))
                    .filter(|change| change.is_finite())
                    .sum();
                Some(share * share * energy)
            })
            .sum();
        drop(all);
        let chain = ahead_of(censored.as_ref(), chain);
        let ahead = |chain: &Chain<'_>| at(&chain.run(&[], &Nuisance::default()));
        let designed_ahead = censored.as_ref().map(|_| ahead(&chain));
        let plain = match (&censored, &designed_ahead) {
            (Some(censored), Some(ahead)) => Some(censored.as_compared(ahead.clone())),
            _ => None,
        };
        let scale = scale(
            problem,
            (&t_s, every_s),
            &y,
            plain.as_ref().unwrap_or(&designed),
        );
        let found = match &problem.base {
            Base::Sensor(_) => Steady::of(problem, &scale, &rows, [&y, &designed]),
            // No voltage is looked at over what a reference's noise makes of a current.
            Base::Battery(_) => None,
        };
        let reference_noise = found.as_ref().map_or(0.0, |still| still.noise);
        let standstills_left = found.as_ref().map_or(0.0, |still| still.left);
        let (steady, reference, standstills) = match (found, &problem.base) {
            (Some(still), _) => {
                let driven = problem.driven_by(still.reference.clone());
                let ahead = |censored| ahead(&ahead_of(Some(censored), Chain::new(&driven)));
                let plain = censored.as_ref().map_or(still.plain, ahead);
                (still.reference, plain, still.rows)
            }
            (None, base) => {
                let reference = match base {
                    Base::Sensor(_) => designed_ahead.unwrap_or_else(|| designed.clone()),
                    // Battery views are read on the drive's rows or between them: the nearest is near enough for regions.
                    Base::Battery(_) => nearest(problem, &rows),
                };
                (problem.drive.reference.clone(), reference, Vec::new())
            }
        };
        let plain = plain.unwrap_or(designed);
        let blocks = blocks(&rows);
        let library: Vec<&'static dyn Effect> = LIBRARY
            .iter()
            .copied()
            .filter(|effect| {
                let id = effect.card().id;
                effect.applies(problem)
                    && (!problem.quasi_static()
                        || !effect.card().parameters.iter().any(Parameter::timed))
                    && !without.iter().any(|name| name == id)
                    && !problem.modelled.iter().any(|(known, _)| *known == id)
            })
            .collect();
        let clues = Clues {
            t_s: &t_s,
            observed: &y,
            predicted: &plain,
        };
        let marks = library
            .iter()
            .filter_map(|effect| Some((effect.card().id, effect.mark(&scale, &clues)?)))
            .collect();
        Self {
            problem,
            chain,
            scale,
            starts: Start::all(problem, &rows),
            bends: bends(problem, scale.mismatch),
            apart: reads_apart(problem),
            marks,
            modelled,
            rows,
            t_s,
            y,
            plain,
            steady,
            reference,
            reference_noise,
            standstills_left,
            standstills,
            blocks,
            library,
            known: Mutex::default(),
            screened: Mutex::default(),
            censored,
            contradiction,
            white: None,
        }
    }

    /// The same with the stated noise made white, if it has a memory.
    pub fn whitened(&self) -> Option<Self> {
        let problem = self.problem;
        let whitening = Whitening::new(&self.t_s, problem.noise, problem.coloured)?;
        let mut y = self.y.clone();
        whitening.apply(&mut y);
        Some(Self {
            problem,
            chain: self.chain_of(problem),
            scale: self.scale,
            starts: self.starts.clone(),
            bends: self.bends.clone(),
            apart: self.apart,
            rows: self.rows.clone(),
            t_s: self.t_s.clone(),
            y: self.y.clone(),
            plain: self.plain.clone(),
            steady: self.steady.clone(),
            reference_noise: self.reference_noise,
            standstills_left: self.standstills_left,
            standstills: self.standstills.clone(),
            reference: self.reference.clone(),
            blocks: self.blocks.clone(),
            library: self.library.clone(),
            modelled: self.modelled,
            marks: self.marks.clone(),
            known: Mutex::default(),
            screened: Mutex::default(),
            censored: self.censored.clone(),
            contradiction: self.contradiction.clone(),
            white: Some((whitening, y)),
        })
    }

    /// What the readings show of an effect by themselves.
    pub fn mark(&self, effect: &dyn Effect) -> Option<&Mark> {
        let of_effect = |(id, _): &&(&str, Mark)| *id == effect.card().id;
        self.marks.iter().find(of_effect).map(|(_, mark)| mark)
    }

    /// How far the values of an effect may be off, if they are those that the readings show by themselves: no fit moves them.
    pub fn shown(&self, member: &Member) -> Option<&[f64]> {
        self.mark(member.effect)
            .filter(|mark| mark.values == member.values)
            .map(|mark| mark.within.as_slice())
    }

    /// Whether the noise was made white.
    pub fn is_white(&self) -> bool {
        self.white.is_some()
    }

    /// What of the stated noise has a memory here.
    pub fn coloured(&self) -> Coloured {
        if self.white.is_some() {
            Coloured::default()
        } else {
            self.problem.coloured
        }
    }

    /// A series of readings as fits see it.
    pub fn as_fitted(&self, mut series: Vec<f64>) -> Vec<f64> {
        if let Some((whitening, _)) = &self.white {
            whitening.apply(&mut series);
        }
        series
    }

    /// A simulation or a residual in the view's unit, row by row.
    pub fn as_read<'s>(&self, series: &'s [f64]) -> Cow<'s, [f64]> {
        match &self.white {
            None => Cow::Borrowed(series),
            Some((whitening, _)) => {
                let mut series = series.to_vec();
                whitening.undo(&mut series);
                Cow::Owned(series)
            }
        }
    }

    /// The model that a fit from this one ended at, with spread and loss, if it was made before.
    pub fn known(&self, from: &Model) -> Option<(Model, f64, f64)> {
        self.known.lock().ok()?.get(&key(from)).cloned()
    }

    /// Remembers where a fit ended.
    pub fn remember(&self, from: &Model, to: &Model, sigma: f64, cost: f64) {
        if let Ok(mut known) = self.known.lock() {
            known.insert(key(from), (to.clone(), sigma, cost));
        }
    }

    /// The screening of a model's residual, if it is one of the last, or a new one.
    pub(super) fn screened(&self, model: &Model, new: impl FnOnce() -> Screened) -> Arc<Screened> {
        let key = (key(model), model.nuisance.resistances_at_c);
        let is_same = |(known, _): &&(ScreenedKey, Arc<Screened>)| *known == key;
        if let Ok(known) = self.screened.lock()
            && let Some((_, screened)) = known.iter().find(is_same)
        {
            return Arc::clone(screened);
        }
        let screened = Arc::new(new());
        if let Ok(mut known) = self.screened.lock() {
            known.push_front((key, Arc::clone(&screened)));
            let mut size = 0;
            known.retain(|(_, screened)| {
                size += screened.size();
                size <= MOST_SCREENED
            });
        }
        screened
    }

    /// Rows that count.
    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// By how much reference and time stamps may be off at a row, in the view's unit.
    pub fn accuracy(&self, row: usize) -> f64 {
        self.problem
            .accuracy
            .at(self.plain[row], self.slope_per_s(row))
    }

    /// How fast the simulation as designed changes up to a row, in the view's unit per second; 0 at the first one.
    pub(super) fn slope_per_s(&self, row: usize) -> f64 {
        let Some(before) = row.checked_sub(1) else {
            return 0.0;
        };
        let step_s = self.t_s[row] - self.t_s[before];
        if step_s > 0.0 {
            (self.plain[row] - self.plain[before]) / step_s
        } else {
            0.0
        }
    }

    /// Energy by which stamps that should be even move readings and reference against each other. Effects that work between the rows are
    /// not told apart by less: a window of a few rows evens that out, whatever the sensor does.
    pub fn stamped(&self) -> f64 {
        let drive = &self.problem.drive;
        let jitter_s = unevenness(&self.t_s).hypot(match self.problem.observed.moments {
            Moments::EveryRow | Moments::Rows(_) => 0.0,
            Moments::Own => unevenness(&drive.t_s) * drive.stride() as f64,
        });
        (0..self.len())
            .map(|row| (jitter_s * self.slope_per_s(row)).powi(2))
            .sum()
    }

    /// True without any.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// The simulation at every observed row.
    pub fn everywhere(&self, model: &Model) -> Vec<f64> {
        self.chain.run(&members(model), &model.nuisance)
    }

    /// Squared change, summed over the rows that count, that noise of a standard deviation ahead of the end of the chain makes to
    /// the simulation: a reading near a threshold jumps by noise, and a stepped one has the steps twice.
    pub fn noise_energy(&self, model: &Model, predicted: &[f64], deviation: f64, seed: u64) -> f64 {
        let noisy = with_noise(&self.chain, model, deviation, seed);
        self.thinned(noisy)
            .iter()
            .zip(predicted)
            .map(|(noisy, predicted)| (noisy - predicted).powi(2))
            .filter(|change| change.is_finite())
            .sum()
    }

    /// What the stated noise leaves of a true model, rms, in the view's unit: all of itself, and less of it where readings tell no more
    /// than within what the signal was, by a drawing of readings.
    pub fn noise_left(&self, model: &Model, seed: u64) -> f64 {
        let stated = self.problem.noise;
        if self.censored.is_none() {
            return stated;
        }
        let drawn = self.at_rows(with_noise(&Chain::new(self.problem), model, stated, seed));
        // Beyond the drive's ends nothing is known: the reading stands there.
        let known = |(drawn, y): (f64, &f64)| if drawn.is_finite() { drawn } else { *y };
        let drawn: Vec<f64> = drawn.into_iter().zip(&self.y).map(known).collect();
        match Censored::of(self.problem, &drawn) {
            Ok(Some(censored)) => {
                let compared = censored.as_compared(self.at_rows(self.everywhere(model)));
                rms(drawn.iter().zip(&compared).map(|(y, p)| y - p))
            }
            Ok(None) | Err(_) => stated,
        }
    }

    /// Energy of the reference's noise that a model evens out, against the simulation as designed: the error is lower by that whatever
    /// the physics. `predicted`: its simulation. Told by how much it moves at the standstills, where noise is all that moves.
    pub fn evened_out(&self, model: &Model, predicted: &[f64]) -> f64 {
        if self.reference_noise <= 0.0 {
            return 0.0;
        }
        let steady = self.problem.driven_by(self.steady.clone());
        let steady = self.run_on(&self.chain_of(&steady), model);
        let moves = |noise: &[f64]| -> f64 {
            let each = self.standstills.iter().map(|rows| {
                let noise = &noise[rows.clone()];
                let mean = noise.iter().sum::<f64>() / noise.len().max(1) as f64;
                noise
                    .iter()
                    .map(|value| (value - mean).powi(2))
                    .sum::<f64>()
            });
            each.sum()
        };
        let reference = self.as_compared(self.reference.clone());
        let designed = self.as_fitted(change(&self.plain, &reference));
        let share = moves(&change(predicted, &steady)) / moves(&designed);
        // What works between the rows evens out noise wherever it is, a threshold where the current stands at it.
        let between = |member: &Member| member.effect.card().stage.is_between_rows();
        let rows = if model.members.iter().any(between) {
            self.len()
        } else {
            self.standstills.iter().map(Range::len).sum()
        };
        self.reference_noise.powi(2) * rows as f64 * (1.0 - share).max(0.0)
    }

    /// Puts a drawing of the noise that the model file states in place of a series; `false`, and nothing done, if that has no memory.
    pub fn draw_noise(&self, series: &mut [f64], random: &mut ChaCha8Rng) -> bool {
        let coloured = self.coloured();
        if !(coloured.rms > 0.0 && coloured.tau_s > 0.0) {
            return false;
        }
        let white = (self.problem.noise.powi(2) - coloured.rms.powi(2))
            .max(0.0)
            .sqrt();
        let mut noise = StandardNormal.sample_iter(random);
        let mut normal = || -> f64 { noise.next().unwrap_or_default() };
        let mut memory = coloured.rms * normal();
        let mut before = None;
        for (value, t) in series.iter_mut().zip(&self.t_s) {
            if let Some(before) = before.replace(*t) {
                // A clock that begins anew is another operation's.
                let kept = if *t < before {
                    0.0
                } else {
                    (-(t - before) / coloured.tau_s).exp()
                };
                memory = kept * memory + coloured.rms * (1.0 - kept * kept).sqrt() * normal();
            }
            *value = memory + white * normal();
        }
        true
    }

    /// Variance of a weighted sum of readings from a row on, `aᵀΣa`, under the noise that the model file states, with Σ of an
    /// exponential memory and white noise; `None` if it states none with a memory.
    pub fn carried(&self, from: usize, weights: &[f64]) -> Option<f64> {
        let coloured = self.coloured();
        if !(coloured.rms > 0.0 && coloured.tau_s > 0.0) {
            return None;
        }
        let (mut energy, mut together, mut memory) = (0.0, 0.0, 0.0);
        let mut last: Option<(f64, f64)> = None;
        for (t, a) in self.t_s[from..].iter().zip(weights) {
            if let Some((before, previous)) = last {
                // A clock that starts anew knows nothing of what was before.
                memory = if *t < before {
                    0.0
                } else {
                    (memory + previous) * ((before - t) / coloured.tau_s).exp()
                };
            }
            energy += a * a;
            together += a * memory;
            last = Some((*t, *a));
        }
        Some(self.problem.noise.powi(2) * energy + 2.0 * coloured.rms.powi(2) * together)
    }

    /// Variance of a weighted sum of readings from a row on that comes of their grid. What rounding takes has a twelfth of the step
    /// squared, less what noise evens out that is louder than that (Widrow and Kollár 2008, Quantization Noise, ch. 4 and 19), and is
    /// the same for as long as the signal stays within half a step.
    pub fn rounded(&self, from: usize, weights: &[f64]) -> f64 {
        let step = self.problem.observed.grid;
        if step <= 0.0 {
            return 0.0;
        }
        let own = step * step / 12.0;
        let beside = (self.problem.noise.powi(2) - own).max(0.0) / (step * step);
        let left = own * (-4.0 * std::f64::consts::PI.powi(2) * beside).exp();
        let (mut squares, mut together) = (0.0, 0.0);
        let mut began = f64::NAN;
        for (value, a) in self.plain[from..].iter().zip(weights) {
            if (value - began).abs() <= 0.5 * step {
                together += a;
            } else {
                squares += f64::powi(together, 2);
                (together, began) = (*a, *value);
            }
        }
        left * (squares + together * together)
    }

    /// How many standard deviations a fitted change is away from what the stated noise, and the readings' grid, do by themselves: its
    /// projection on the change has the variance `cᵀΣc`. Infinite if there is neither.
    pub fn deviations(&self, change: &[f64]) -> f64 {
        let energy: f64 = change.iter().map(|c| c * c).sum();
        let white = self.problem.noise.powi(2) * energy;
        let noise = self.carried(0, change).unwrap_or(white);
        energy / (noise + self.rounded(0, change)).sqrt()
    }

    /// By how much reference and time stamps, and the readings' grid, may put a reading off at a row, in the view's unit.
    pub fn inaccuracy(&self, row: usize) -> f64 {
        self.accuracy(row) + 0.5 * self.problem.observed.grid
    }

    /// Spread of a residual. Of readings that tell no more than within what the signal was, most say nothing: what the others are off by is
    /// no less common for that, and is as loud as the stated noise.
    pub fn spread(&self, residual: &[f64]) -> f64 {
        spread(residual).max(self.least_spread())
    }

    /// What [`Workbench::spread`] is at least.
    pub fn least_spread(&self) -> f64 {
        self.censored.as_ref().map_or(0.0, |_| self.problem.noise)
    }

    /// Variance of a weighted sum of readings from a row on under the stated noise, where that is not what they are seen to differ by:
    /// it has a memory ([`Workbench::carried`]), or most readings show nothing of it ([`Workbench::spread`]).
    pub fn stated(&self, from: usize, weights: &[f64]) -> f64 {
        let white = || self.least_spread().powi(2) * weights.iter().map(|a| a * a).sum::<f64>();
        self.carried(from, weights).unwrap_or_else(white)
    }

    /// The simulation at the rows that count.
    pub fn run(&self, model: &Model) -> Vec<f64> {
        self.thinned(self.everywhere(model))
    }

    /// A simulation at the rows that count as readings are compared with it ([`Censored::as_compared`]).
    fn as_compared(&self, simulation: Vec<f64>) -> Vec<f64> {
        match &self.censored {
            Some(censored) => censored.as_compared(simulation),
            None => simulation,
        }
    }

    /// The simulation of another problem with the same readings, as far as this one's goes.
    pub(super) fn chain_of<'b>(&self, problem: &'b Problem) -> Chain<'b> {
        ahead_of(self.censored.as_ref(), Chain::new(problem))
    }

    /// The simulation of another chain with the same readings, at the rows that count.
    pub(super) fn run_on(&self, chain: &Chain<'_>, model: &Model) -> Vec<f64> {
        self.thinned(chain.run(&members(model), &model.nuisance))
    }

    /// The simulation up to a member; see [`Chain::begin`].
    pub fn begin(&self, model: &Model, member: usize) -> Begun<'a> {
        self.chain.begin(&members(model), &model.nuisance, member)
    }

    /// The rest of it at the rows that count, the member's values being others.
    pub fn go_on(&self, begun: &Begun<'a>, model: &Model) -> Vec<f64> {
        let all = self.chain.go_on(begun, &members(model), &model.nuisance);
        self.thinned(all)
    }

    /// The simulation of models that each differ from one in a single respect, at the rows that count.
    pub fn vary(&self, model: &Model, others: &[(Change, Model)]) -> Vec<Vec<f64>> {
        let variations: Vec<Variation<'_>> = others
            .iter()
            .map(|(change, other)| (*change, members(other), other.nuisance.clone()))
            .collect();
        self.chain
            .vary(&members(model), &model.nuisance, &variations, |all| {
                self.thinned(all)
            })
    }

    /// A series over every observed row, at the rows that count.
    fn at_rows(&self, all: Vec<f64>) -> Vec<f64> {
        if self.rows.len() == all.len() {
            all
        } else {
            self.rows.iter().map(|&row| all[row]).collect()
        }
    }

    fn thinned(&self, all: Vec<f64>) -> Vec<f64> {
        let mut here = self.as_compared(self.at_rows(all));
        // What is not known (a clock of another rate points into a gap) stays as designed: a model gains nothing by not saying it.
        for (value, plain) in here.iter_mut().zip(&self.plain) {
            if !value.is_finite() {
                *value = *plain;
            }
        }
        self.as_fitted(here)
    }

    /// Reading less simulation.
    pub fn residual(&self, predicted: &[f64]) -> Vec<f64> {
        let y = self.white.as_ref().map_or(&self.y, |(_, y)| y);
        y.iter()
            .zip(predicted)
            // Nothing is known there, not even as designed.
            .map(|(y, p)| if p.is_finite() { y - p } else { 0.0 })
            .collect()
    }

    /// What starts may look at; `predicted` as read.
    pub fn clues<'b>(&'b self, predicted: &'b [f64]) -> Clues<'b> {
        Clues {
            t_s: &self.t_s,
            observed: &self.y,
            predicted,
        }
    }

    /// Whether the sub-step alignment is free in a model: an effect works on what is between the samples, or a tester reads voltage and
    /// current one after the other.
    pub fn aligns(&self, model: &Model) -> bool {
        if let Base::Battery(_) = self.problem.base {
            return self.apart && !model.unaligned;
        }
        !model.unaligned
            // These have a time of their own.
            && !model.has("delay")
            && !model.has("sampled-window")
            && model.members.iter().any(|member| {
                matches!(member.effect.card().stage, Stage::Filter | Stage::Converter)
            })
    }
}

/// A simulation at every observed row, with white noise of a standard deviation ahead of the end of its chain.
fn with_noise(chain: &Chain<'_>, model: &Model, deviation: f64, seed: u64) -> Vec<f64> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut noise = StandardNormal
        .sample_iter(&mut random)
        .map(|value: f64| deviation * value);
    chain.run_with_noise(&members(model), &model.nuisance, Some(&mut noise))
}

/// A simulation that stops short of what censors, if something does.
fn ahead_of<'a>(censored: Option<&Censored>, chain: Chain<'a>) -> Chain<'a> {
    match censored {
        Some(_) => chain.ahead_of_cuts(),
        None => chain,
    }
}

fn members(model: &Model) -> Vec<(&'static dyn Effect, &[f64])> {
    model
        .members
        .iter()
        .map(|member| (member.effect, member.values.as_slice()))
        .collect()
}

fn nearest(problem: &Problem, rows: &[usize]) -> Vec<f64> {
    let reference = &problem.drive.reference;
    rows.iter()
        .map(|&row| drive_row(problem, row).map_or(0.0, |row| reference[row]))
        .collect()
}

/// The drive's row at which an observed one was taken, or the last before it.
pub(super) fn drive_row(problem: &Problem, row: usize) -> Option<usize> {
    problem.observed.drive_row_before(&problem.drive, row)
}

/// Standard deviation of one stamp of a series that is sent at even times, in s: each step has two. 0 where steps differ by more than
/// a jitter.
fn unevenness(t_s: &[f64]) -> f64 {
    let mut steps: Vec<f64> = t_s.windows(2).map(|pair| pair[1] - pair[0]).collect();
    if steps.len() < 20 {
        return 0.0;
    }
    steps.sort_unstable_by(f64::total_cmp);
    // A sixth to either side of the middle is beyond one standard deviation; gaps are no jitter.
    let at = |share: f64| steps[(share * (steps.len() - 1) as f64) as usize];
    let deviation = 0.5 * (at(1.0 - SIXTH) - at(SIXTH));
    if deviation < JITTER * at(0.5) {
        deviation / std::f64::consts::SQRT_2
    } else {
        0.0
    }
}

fn rms(values: impl Iterator<Item = f64>) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for value in values.filter(|value| value.is_finite()) {
        sum += value * value;
        count += 1.0;
    }
    if count > 0.0 {
        f64::sqrt(sum / count)
    } else {
        0.0
    }
}

/// Cells of the longest grid of a spectrum of readings that were thinned out.
const MOST_CELLS: f64 = (1 << 20) as f64;

/// `t_s`: times of the readings that are looked at, and the step between all of them.
fn scale(problem: &Problem, (t_s, every_s): (&[f64], f64), y: &[f64], plain: &[f64]) -> Scale {
    let drive = &problem.drive;
    let largest = drive
        .reference
        .iter()
        .fold(0.0f64, |most, x| most.max(x.abs()));
    let step_s = drive.median_step_s();
    let or_row = |reading_s: f64| if reading_s > 0.0 { reading_s } else { step_s };
    let reading_step_s = or_row(median_step_s(t_s.iter().copied()));
    let covered_s = match t_s {
        [first, .., last] => last - first,
        _ => 0.0,
    };
    // Of readings that were thinned out lines are told up to half the rate at which they came, as far as that can be laid out.
    let spectral_step_s = if every_s > 0.0 && covered_s <= MOST_CELLS * every_s {
        every_s.min(reading_step_s)
    } else {
        reading_step_s
    };
    let longest_s = |stretches: &[Range<usize>]| {
        stretches
            .iter()
            .filter(|rows| !rows.is_empty())
            .map(|rows| drive.t_s[rows.end - 1] - drive.t_s[rows.start])
            .fold(0.0, f64::max)
    };
    let mut scale = Scale {
        largest,
        both_ways: both_ways(drive, largest),
        rms: rms(drive.reference.iter().copied()),
        full_scale: largest.max(y.iter().fold(0.0f64, |most, value| most.max(value.abs()))),
        mismatch: rms(y.iter().zip(plain).map(|(y, p)| y - p)),
        step_s,
        reading_step_s,
        spectral_step_s,
        even_s: match t_s {
            [first, .., last] if reading_step_s > 0.0 && last > first => {
                (last - first) / ((last - first) / reading_step_s).round().max(1.0)
            }
            _ => reading_step_s,
        },
        fastest_s: 0.02 * step_s.min(reading_step_s),
        begin_s: problem.observed.t_s.first().copied().unwrap_or_default(),
        span_s: longest_s(&drive.segments),
        operation_s: longest_s(&drive.operations()),
        ..Scale::default()
    };
    if problem.view == View::Charge {
        // A counter's differences tell nothing that is faster than themselves, however fast the current was recorded.
        scale.step_s = scale.step_s.max(reading_step_s);
        scale.fastest_s = 0.1 * reading_step_s;
    }
    match &problem.base {
        Base::Sensor(base) => {
            scale.full_scale = base.full_scale.unwrap_or(scale.full_scale);
            scale.window_s = base.window_s;
            scale.quantum = base.step;
        }
        Base::Battery(base) => {
            scale.capacity_ah = base.capacity_ah;
            scale.resistance_ohm = base.resistance_ohm / base.cells;
            scale.soc = charge_range(base, drive).unwrap_or_default();
        }
    }
    scale
}

/// See [`Scale::both_ways`]: the count falls with the size, so it is found by halves.
fn both_ways(drive: &Drive, largest: f64) -> f64 {
    let rounds = |size: f64| -> usize {
        let of_one = |rows: Range<usize>| {
            let mut side = 0.0;
            let mut rounds = 0;
            for value in drive.reference[rows].iter().filter(|x| x.abs() > size) {
                if side != 0.0 && value.signum() != side {
                    rounds += 1;
                }
                side = value.signum();
            }
            rounds
        };
        drive.operations().into_iter().map(of_one).sum()
    };
    let (mut low, mut high) = (0.0, largest);
    if rounds(low) < ROUNDS {
        return 0.0;
    }
    for _ in 0..16 {
        let middle = 0.5 * (low + high);
        if rounds(middle) < ROUNDS {
            high = middle;
        } else {
            low = middle;
        }
    }
    low
}

/// Blocks of equal numbers of rows.
fn blocks(rows: &[usize]) -> Vec<Range<usize>> {
    let count = (rows.len() / LEAST_ROWS).clamp(1, BLOCKS);
    (0..count)
        .map(|block| {
            let start = rows.len() * block / count;
            let end = rows.len() * (block + 1) / count;
            // Nothing comes after the last one.
            let guard = if block + 1 < count { GUARD } else { 0.0 };
            start..end - ((end - start) as f64 * guard) as usize
        })
        .collect()
}
