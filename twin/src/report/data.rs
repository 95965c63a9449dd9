//! The report as data: `report.json` (schema 1), and beside it the series that the pictures are drawn from.

use serde::Serialize;

/// What the tool says about the mismatch.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// Recording and simulation agree within noise and accuracy.
    #[default]
    NoMismatch,
    /// The named effects account for the mismatch.
    Explained,
    /// The named effects account for a part; structure is left.
    PartlyExplained,
    /// Several models account for it equally well.
    Ambiguous,
    /// There is a mismatch, and no model of the library accounts for it.
    Unknown,
}

/// The whole report.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Report {
    /// Version of this format: 1.
    pub schema: u32,
    /// What the tool says.
    pub verdict: Verdict,
    /// The verdict in one or two plain sentences.
    pub summary: String,
    /// Each signal compared.
    pub signals: Vec<SignalReport>,
    /// Where the mismatch sits.
    pub locations: Vec<Location>,
    /// The effects named.
    pub effects: Vec<EffectReport>,
    /// Other files, never fitted.
    pub holdouts: Vec<HoldoutReport>,
    /// What stays unexplained.
    pub unexplained: Vec<Unexplained>,
    /// How it was decided, step by step, in plain words.
    pub decisions: Vec<String>,
    /// What the reader has to know about the input (an implausible reference, clipped rows left out, …).
    pub remarks: Vec<String>,
    /// Time taken.
    pub seconds: f64,
    /// Seed of whatever is random.
    pub seed: u64,
    /// The tool's version.
    pub version: String,
    /// Input files, as named by the user.
    pub inputs: Inputs,
    /// The fitted models, for the extended model file; not part of report.json.
    #[serde(skip)]
    pub models: Vec<FittedModel>,
    /// What the pictures are drawn from; not part of report.json.
    #[serde(skip)]
    pub plots: Vec<SignalPlots>,
}

/// What was fitted to one signal.
#[derive(Clone, Debug, Default)]
pub struct FittedModel {
    /// Column of the signal.
    pub signal: String,
    /// Effects: id, and the value of every parameter with its name (internal ones too).
    pub effects: Vec<(String, Vec<(String, f64)>)>,
    /// What the base differs by, within what the model file says it does not know.
    pub nuisance: crate::effects::chain::Nuisance,
    /// Whether that is a battery.
    pub of_battery: bool,
    /// Whether the reference was found to go from row to row in a smooth course.
    pub smooth_reference: bool,
    /// Whether a sensor's reference was found to stay at one value from row to row, and which.
    pub held_reference: Option<crate::problem::Holds>,
    /// The same of a battery's current.
    pub current_holds: Option<crate::problem::Holds>,
}

/// The files that the report is about.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Inputs {
    /// Model file.
    pub model: String,
    /// Recording.
    pub recording: String,
    /// Separate reference, if one was given.
    pub reference: Option<String>,
    /// Effects that were taken out of the library.
    pub without: Vec<String>,
    /// Folder that report and extended model are written to, as named by the user; not part of report.json, so that two
    /// runs of the same input write the same file wherever they write it.
    #[serde(skip)]
    pub out: Option<String>,
    /// Whether `calibration.toml` is written there too.
    #[serde(skip)]
    pub calibration: bool,
}

/// One signal, before and after.
#[derive(Clone, Debug, Serialize)]
pub struct SignalReport {
    /// Column, such as `i_meas_a`.
    pub name: String,
    /// Unit.
    pub unit: String,
    /// Noise that no model could go below, in the unit.
    pub noise_floor: f64,
    /// Over all valid samples, without the effects.
    pub rmse_before: f64,
    /// Over all valid samples, with them.
    pub rmse_after: f64,
    /// Over held-out blocks, without the effects.
    pub held_out_blocks_before: f64,
    /// Over held-out blocks, each predicted by a model that was fitted on the other blocks only.
    pub held_out_blocks_after: f64,
    /// Valid samples.
    pub samples: usize,
}

/// What a location is a range of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum LocationKind {
    /// A stretch of time.
    Time,
    /// A range of an operating variable.
    Region,
    /// A band of frequency.
    Frequency,
}

/// A place that holds more of the mismatch than its share of the samples.
#[derive(Clone, Debug, Serialize)]
pub struct Location {
    /// Column of the signal.
    pub signal: String,
    /// What it is a range of.
    pub kind: LocationKind,
    /// The variable, such as `abs(i)` (`abs(x)` where the reference is no current), `abs(di/dt)`, `t_s`, `frequency_hz`.
    pub variable: String,
    /// Unit of `from` and `to`.
    pub unit: String,
    /// Lower end; `None`: open.
    pub from: Option<f64>,
    /// Upper end; `None`: open.
    pub to: Option<f64>,
    /// Share of the mismatch's energy, 0 … 1. Where stretches were left out, theirs are of all of it, the others' of the rest.
    pub energy_share: f64,
    /// Share of the samples, 0 … 1.
    pub sample_share: f64,
    /// From block permutation; of a stretch that was left out, how often so many readings far off would follow one another, at the most,
    /// if they were anywhere.
    pub p_value: f64,
    /// The named effect that accounts for it, if one does.
    pub effect: Option<String>,
}

/// What the recording tells of a parameter.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Known {
    /// Its value.
    #[default]
    Value,
    /// That it is this or more: it stands at the end of what is searched.
    AtLeast,
    /// Nothing: with anything in its interval the simulation is the same.
    Nothing,
}

impl Known {
    fn is_value(&self) -> bool {
        *self == Self::Value
    }
}

/// A parameter of an effect.
#[derive(Clone, Debug, Serialize)]
pub struct ParameterReport {
    /// Its name in the effects table.
    pub name: String,
    /// Fitted value.
    pub value: f64,
    /// 95 % interval.
    pub ci95: [f64; 2],
    /// Unit.
    pub unit: String,
    /// The value that turns the effect off, if a finite one does.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub off: Option<f64>,
    /// What of it is known, if that is not its value.
    #[serde(skip_serializing_if = "Known::is_value")]
    pub known: Known,
}

/// A named effect.
#[derive(Clone, Debug, Serialize)]
pub struct EffectReport {
    /// Its id in the effects table.
    pub id: String,
    /// Column of the signal in which it shows.
    pub signal: String,
    /// What it says, in plain words.
    pub statement: String,
    /// Its equation.
    pub equation: String,
    /// Fitted parameters.
    pub parameters: Vec<ParameterReport>,
    /// Share of the held-out squared error that goes when the effect is added last, 0 … 1.
    pub held_out_gain: f64,
    /// 99th percentile of the same figure for placebos, maximum over the library; 0 where none was asked, because the readings show the
    /// effect by themselves (they stay at an end, lie on a grid). The share is then of the error on all samples.
    pub placebo_p99: f64,
    /// What tells it if its place does: readings at instants at which alone it acts, too few for held-out samples and placebos.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub by_place: Option<String>,
    /// Effects that fit equally well on this recording.
    pub equivalent_to: Vec<String>,
    /// The recording that would separate them, or confirm what its place tells; empty if nothing is equivalent.
    pub separated_by: String,
    /// Results that follow from the parameters (charge per switch), in plain words.
    pub consequences: Vec<String>,
}

impl EffectReport {
    /// Whether the readings show it by themselves, so that no placebo was asked.
    pub fn is_shown_by_readings(&self) -> bool {
        self.placebo_p99 == 0.0
    }
}

/// A file that was never fitted.
#[derive(Clone, Debug, Serialize)]
pub struct HoldoutReport {
    /// The file.
    pub file: String,
    /// Column of the signal.
    pub signal: String,
    /// Without the effects.
    pub rmse_before: f64,
    /// With them.
    pub rmse_after: f64,
}

/// Structure that is left.
#[derive(Clone, Debug, Serialize)]
pub struct Unexplained {
    /// Column of the signal.
    pub signal: String,
    /// Root mean square of what is left, in the signal's unit.
    pub rmse: f64,
    /// Share of its energy that a smooth function of the recorded inputs could explain on held-out blocks, 0 … 1; 0 if that is no more than
    /// placebos explain.
    pub explainable_share: f64,
    /// Where it is largest.
    pub location: Option<Location>,
    /// The simple form that it has, if it has one.
    pub form: Option<Form>,
}

/// A simple function of the recorded inputs that takes nearly all of what is left: a description, no effect of the library.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Form {
    /// Which function: `step`, `slope-step` (in time), `step-over`, `slope-step-over` (where another quantity passes a value),
    /// `direction`, `sign`, `square`, `cube`, `drift`, `slope-drift`, `itself`, `follows`, `follows-square`, `slope-follows`,
    /// `memory`, `second-order`,
    /// `speed-limit` or `toward-zero`.
    pub id: String,
    /// In words, with its values.
    pub description: String,
    /// Others that the recording does not tell apart from it.
    pub equivalent_to: Vec<OtherForm>,
    /// Root mean square of what it would leave on parts of the recording that it was not fitted on, in the signal's unit.
    pub rmse: f64,
}

/// A form that another one is not told apart from.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct OtherForm {
    /// As in [`Form`].
    pub id: String,
    /// In words, with its values.
    pub description: String,
}

impl Form {
    /// In words, with those that it is not told apart from.
    pub fn said(&self) -> String {
        let others = self.equivalent_to.iter().map(|other| &other.description);
        let all = std::iter::once(&self.description).chain(others);
        all.map(String::as_str).collect::<Vec<_>>().join(", or ")
    }
}

/// Series for the pictures of one signal. All series have the length of `t_s`; NaN where there is no value.
#[derive(Clone, Debug, Default)]
pub struct SignalPlots {
    /// Column.
    pub name: String,
    /// Unit.
    pub unit: String,
    /// Time, in s.
    pub t_s: Vec<f64>,
    /// As recorded.
    pub recorded: Vec<f64>,
    /// As the simulation without the effects says.
    pub before: Vec<f64>,
    /// As the simulation with the effects says.
    pub after: Vec<f64>,
    /// The reference.
    pub reference: Vec<f64>,
    /// Held-out residual of the model with the effects.
    pub held_out_residual: Vec<f64>,
    /// Operating variables: name with unit, and series, for pictures of the residual against them.
    pub variables: Vec<(String, Vec<f64>)>,
    /// Frequency in Hz, and the amplitude spectral density of the residual before and after, in unit/√Hz.
    pub spectrum: Vec<(f64, f64, f64)>,
}
