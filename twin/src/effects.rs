//! The library of physics that a simulation can leave out: one file for each effect, and the list of them.
//!
//! An effect is a change of the simulation by few parameters; at their nominal values it changes nothing. Adding physics
//! is one new file and one line in [`LIBRARY`]: nothing else knows the effects by name.
//!
//! `chain` runs the simulation; [`scene`] is what effects act on, `between` what a signal does between the drive's rows, `means` what it is
//! in the mean over some time.

mod between;
mod capacity;
mod cell_self_heating;
pub mod chain;
mod charge_transfer;
mod clipping;
mod clock_skew;
mod core_hysteresis;
mod core_saturation;
mod coulombic_efficiency;
mod dead_band;
mod delay;
mod diffusion;
mod entropic;
mod gain;
mod gain_temperature;
mod hum;
mod lag;
mod means;
mod moving_average;
pub mod ocv;
mod ocv_hysteresis;
mod offset;
mod offset_temperature;
mod parasitic_load;
mod polarisation;
pub(crate) mod quantisation;
mod range_handover;
mod range_mismatch;
mod resistance;
mod resistance_soc;
mod resistance_temperature;
mod sampled_window;
pub mod scene;
mod sensor_self_heating;
mod stray_field;
mod supply_ratiometric;

use crate::problem::{Problem, View};
use scene::{Scale, Scene};

/// Every effect, in the order of the documentation's table.
pub static LIBRARY: [&dyn Effect; 40] = [
    &offset::Offset,
    &gain::Gain,
    &offset_temperature::OffsetTemperature,
    &gain_temperature::GainTemperature,
    &supply_ratiometric::SupplyRatiometric,
    &core_hysteresis::GAPPED,
    &core_hysteresis::CLOSED,
    &core_hysteresis::DRAGGED,
    &core_hysteresis::ADDED,
    &core_saturation::CoreSaturation,
    &clipping::Clipping,
    &lag::Lag,
    &moving_average::MovingAverage,
    &delay::Delay,
    &clock_skew::ClockSkew,
    &hum::Hum,
    &quantisation::Quantisation,
    &dead_band::DeadBand,
    &range_handover::RangeHandover,
    &range_mismatch::RangeMismatch,
    &sensor_self_heating::SETTLED,
    &sensor_self_heating::CUT_OUT,
    &stray_field::StrayField,
    &sampled_window::SampledWindow,
    &coulombic_efficiency::CoulombicEfficiency,
    &parasitic_load::ParasiticLoad,
    &capacity::Capacity,
    &charge_transfer::ChargeTransfer,
    &polarisation::ONE_BRANCH,
    &polarisation::TWO_BRANCHES,
    &polarisation::THREE_BRANCHES,
    &diffusion::STRAIGHT_LINE,
    &diffusion::THROUGH_OCV,
    &ocv_hysteresis::OcvHysteresis,
    &resistance::Resistance,
    &resistance_temperature::ResistanceTemperature,
    &resistance_soc::AT_EMPTY,
    &resistance_soc::AT_BOTH_ENDS,
    &cell_self_heating::CellSelfHeating,
    &entropic::Entropic,
];

/// How a parameter is searched for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Search {
    /// The prediction is linear in it, or nearly so, while everything else stays: it is solved for.
    Linear,
    /// Smooth and of either sign.
    Smooth,
    /// Smooth, positive, of unknown magnitude: its logarithm is searched.
    Logarithmic,
    /// The prediction jumps where it changes: it is searched without derivatives.
    Stepped,
}

impl Search {
    /// What is searched over orders of magnitude, or in steps, is a size: it has no sign.
    const fn limits(self) -> (f64, f64) {
        match self {
            Self::Linear | Self::Smooth => (f64::NEG_INFINITY, f64::INFINITY),
            Self::Logarithmic | Self::Stepped => (0.0, f64::INFINITY),
        }
    }
}

/// A parameter of an effect.
#[derive(Clone, Copy, Debug)]
pub struct Parameter {
    /// Its name in the effects table; the last part is the unit.
    pub name: &'static str,
    /// Unit; `A` stands for the view's unit.
    pub unit: &'static str,
    /// Value that switches the effect off.
    pub off: f64,
    /// Lowest and highest value that mean anything, whatever the recording: a model file may hold no other.
    pub limits: (f64, f64),
    /// How it is searched for.
    pub search: Search,
    /// Needed to run the model, and no property of the physics (a phase): it is not reported.
    pub internal: bool,
    /// The end of its bounds is a value like any other (a rail out of reach, a window without a pause).
    pub open: bool,
    /// Its upper end is a value like any other (a bend so soft that it ends far beyond the range).
    pub to_top: bool,
    /// Its lower end is a value like any other (a curve that bends from the start has no knee).
    pub from_bottom: bool,
}

impl Parameter {
    const fn new(name: &'static str, unit: &'static str, off: f64, search: Search) -> Self {
        Self {
            name,
            unit,
            off,
            limits: search.limits(),
            search,
            internal: false,
            open: false,
            from_bottom: false,
            to_top: false,
        }
    }

    const fn ends_far_away(mut self) -> Self {
        self.to_top = true;
        self
    }

    const fn bends_at_once(mut self) -> Self {
        self.from_bottom = true;
        self
    }

    const fn open(mut self) -> Self {
        self.open = true;
        self
    }

    const fn within(mut self, lowest: f64, highest: f64) -> Self {
        self.limits = (lowest, highest);
        self
    }

    /// The equation divides by it.
    const fn above_nothing(self) -> Self {
        self.within(f64::MIN_POSITIVE, f64::INFINITY)
    }

    const fn internal(name: &'static str, unit: &'static str, off: f64, search: Search) -> Self {
        Self {
            name,
            unit,
            off,
            limits: (f64::NEG_INFINITY, f64::INFINITY),
            search,
            internal: true,
            open: false,
            from_bottom: false,
            to_top: false,
        }
    }

    /// Whether it is a time, or goes by one.
    pub fn timed(&self) -> bool {
        matches!(self.unit, "s" | "Hz" | "ppm" | "rad")
    }
}

/// Where in the chain from conductor to reading an effect acts. Effects are applied in this order, in whatever order they were found or
/// written down: what a value means must not depend on that. Those of one stage do the same in any order, or next to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Stage {
    /// What flows in, and beside, the conductor.
    Conductor,
    /// The memory of the sensor's magnetic core: the field that the current has to overcome.
    Core,
    /// What the core's flux is limited to.
    Saturation,
    /// What the current warms.
    Heat,
    /// The sensor's sensitivity: a reading is a factor times the current, and a zero error added to that.
    Sensitivity,
    /// The sensor's zero.
    Zero,
    /// What the supply does to both.
    Supply,
    /// The large sensor against the small one, each with its zero.
    Range,
    /// What a change from one to the other leaves behind.
    HandOver,
    /// Time stamps: from when a reading is.
    Clock,
    /// Filters.
    Filter,
    /// The converter: windows and averages.
    Converter,
    /// At the reading's own time stamps, as all that follows: what is added to it.
    Ripple,
    /// The ends of the output; of what a counter counts, at the rows of the drive.
    Rail,
    /// What is too small to count; likewise.
    Threshold,
    /// The converter's steps.
    Step,
    /// Charge that the battery takes and gives.
    BatteryCharge,
    /// The ohmic resistance at 25 °C, and what temperature does to the cell.
    BatteryTemperature,
    /// What the cell does to its temperature: its resistance, and how that follows temperature, is known by then.
    BatteryHeat,
    /// Ohmic resistance.
    BatteryResistance,
    /// Voltages beside the ohmic drop.
    BatteryVoltage,
}

impl Stage {
    /// Whether effects of it work on what is between the rows.
    pub fn is_between_rows(self) -> bool {
        matches!(self, Self::Clock | Self::Filter | Self::Converter)
    }

    /// Whether effects of it change the reading at its own time stamps.
    pub fn is_output(self) -> bool {
        (Self::Ripple..=Self::Step).contains(&self)
    }
}

/// What is said of an effect: the row of the effects table.
#[derive(Debug)]
pub struct Card {
    /// Its id, fixed.
    pub id: &'static str,
    /// The physics in plain words.
    pub statement: &'static str,
    /// The equation that the code follows.
    pub equation: &'static str,
    /// Parameters, in the order in which values are given.
    pub parameters: &'static [Parameter],
    /// Where it shows.
    pub shows: &'static str,
    /// Ids of effects that a weak recording cannot tell apart from it.
    pub looks_like: &'static [&'static str],
    /// The recording that shows this effect and not the others.
    pub separated_by: &'static str,
    /// Where it acts.
    pub stage: Stage,
}

impl Card {
    /// Its place in the order in which effects act: by stage, and within one by id.
    pub fn place(&self) -> (Stage, &'static str) {
        (self.stage, self.id)
    }
}

/// A first-order filter, a linear drift or a branch of resistance and capacitance describes a real part to five percent.
pub const IDEALISED: f64 = 0.05;

/// Share of a constant, a factor or a step by which a real part's curve departs from it.
const STRAIGHT: f64 = 0.08;
/// The same of a bend, of which only the place and the end are physics.
const BENT: f64 = 0.3;

/// A period is told from how long readings stay, which is in whole rows: to so much of itself.
const WHOLE_ROWS: f64 = 1.1;

/// Of a time within the period for which readings stay: a mean over so long, or so late a reading, is what a part of each period,
/// measured and held, gives.
fn within_a_period(time_s: f64, held_s: f64) -> Option<&'static str> {
    (time_s <= WHOLE_ROWS * held_s).then_some(sampled_window::SampledWindow.card().id)
}

/// What edges leave open ([`Effect::left_open_by_edges`]) of the width of a filter's response, where a straight line is `line_s` wide in
/// the same measure: an edge is not, so that the filter is wider by that, in squares. (The mean is free, as an alignment.)
fn blunted(width_s: f64, line_s: f64) -> [f64; 2] {
    [0.0, width_s.hypot(line_s) - width_s]
}

/// A share of a change that is no longer looked for.
const TRACE: f64 = 1e-3;

/// The reach of readings that stand for a moment so much earlier than their row, or later, if negative ([`Effect::reach_s`]).
fn reach_of_shift(earlier_s: f64) -> [f64; 2] {
    [earlier_s.max(0.0), (-earlier_s).max(0.0)]
}

/// What of a battery's base an effect can say.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Says {
    /// What the ohmic resistance is.
    Resistance,
    /// How resistances follow temperature.
    ResistanceByTemperature,
    /// What the recorded current is off by.
    CurrentZero,
}

/// An error of the recorded current that does to a battery what an effect does.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum CurrentError {
    /// Off by so many A.
    Offset(f64),
    /// So many times the true one.
    Gain(f64),
}

/// An effect of the library.
pub trait Effect: Sync {
    /// What is said of it.
    fn card(&self) -> &'static Card;

    /// Whether it can show in this problem: the view and the inputs that it needs are there.
    fn applies(&self, problem: &Problem) -> bool {
        sensing(problem)
    }

    /// Columns without any of which it does nothing.
    fn columns(&self) -> &'static [&'static str] {
        &[]
    }

    /// Lowest and highest value of a parameter that is still physics.
    fn bounds(&self, parameter: usize, scale: &Scale) -> (f64, f64);

    /// Points from which it is searched: values for every parameter, those of [`Search::Linear`] at a small step from off.
    fn starts(&self, scale: &Scale, clues: &Clues<'_>) -> Vec<Vec<f64>>;

    /// The instants, in s and in order, at which alone it begins to change readings; `None`: it acts all along.
    fn instants_s(&self, _problem: &Problem) -> Option<Vec<f64>> {
        None
    }

    /// What values that are each within their limits have to be beside one another, if these are not.
    fn at_odds(&self, _values: &[f64]) -> Option<&'static str> {
        None
    }

    /// Changes the scene.
    fn apply(&self, values: &[f64], scene: &mut Scene<'_>);

    /// Values to be tried around `values`, for parameters that are searched without derivatives and depend on one another; `share`
    /// says how far away. `None`: each by itself.
    fn near(&self, _values: &[f64], _scale: &Scale, _share: f64) -> Option<Vec<Vec<f64>>> {
        None
    }

    /// Values that do the same at evenly spaced rows but for how much they do: with a period (the first of them) that fits into the
    /// time between two rows by so many turns more. `None`: rows, however they are spaced, tell the values.
    fn alias(&self, _values: &[f64], _scale: &Scale, _turns: f64) -> Option<Vec<f64>> {
        None
    }

    /// Number of independent values among which the best is chosen without any of them being near another (periods, each a line
    /// of its own in noise): 1 for a value that is followed from a start.
    fn choices(&self, _scale: &Scale) -> f64 {
        1.0
    }

    /// What the readings show of it by themselves, or beside the simulation as designed, without a fit.
    fn mark(&self, _scale: &Scale, _clues: &Clues<'_>) -> Option<Mark> {
        None
    }

    /// Whether it is another form of the effect of the same id, and no more of it: it may be named without the smaller one.
    fn alternative(&self) -> bool {
        false
    }

    /// Whether it is general enough to follow any process of its kind, so that a fit is no proof of this one.
    fn general(&self) -> bool {
        false
    }

    /// Share of its own change by which its equation may be off: most are idealisations of what happens.
    fn idealised(&self) -> f64 {
        IDEALISED
    }

    /// Whether it is one of the plainest there are: exact, with a size and nothing else, at the row (a factor, a constant).
    fn is_plainest(&self) -> bool {
        let card = self.card();
        let is_size = matches!(card.parameters, [one] if one.search == Search::Linear);
        self.idealised() == 0.0 && !card.stage.is_between_rows() && is_size
    }

    /// Whether the loss has a kink in a parameter (an end, a threshold, the start of a window): its interval is then found by
    /// profile likelihood, not from slopes.
    fn kinked(&self, _parameter: usize) -> bool {
        false
    }

    /// Whether it rounds readings to a grid: in the mean they follow what is ahead of it, though hardly one does at a time.
    fn rounds(&self) -> bool {
        false
    }

    /// Two effects at a time that look as it does where they act together: it is not named before they were tried in its place.
    fn stands_for(&self) -> &'static [[&'static str; 2]] {
        &[]
    }

    /// What it says of the base: nothing of that is left open then.
    fn says(&self) -> Option<Says> {
        None
    }

    /// Whether it cuts or rounds what comes in, noise with it: what comes out is no longer a signal with the stated noise on it.
    fn cuts(&self) -> bool {
        false
    }

    /// Of an effect that cuts or rounds: the ends between which a signal was that came out of it between these, in the view's unit, the
    /// lower one first; the same ends if it came through as it is, infinite ones where nothing is known. `off`: how far readings may be off
    /// what comes out. `None` if nothing comes out there.
    fn came_of(&self, _values: &[f64], came_out: [f64; 2], _off: f64) -> Option<[f64; 2]> {
        Some(came_out)
    }

    /// Of an effect that cuts or rounds: whether the readings show that noise went in with the signal, and was not added behind it.
    fn noise_ahead(&self, _values: &[f64], _clues: &Clues<'_>) -> bool {
        true
    }

    /// Whether a parameter is a level at which readings stay.
    fn level(&self, _parameter: usize) -> bool {
        false
    }

    /// The value of a parameter from which on it does what a simpler effect does (a time longer than the recording): the effect is
    /// not named then, but an equal of what is.
    fn endless(&self, _parameter: usize, _scale: &Scale) -> f64 {
        f64::INFINITY
    }

    /// Share of its size, rms, by which the recording's own curve may differ from this one, if it is a curve of the present
    /// current: parts that an instrument is made of are straight to some percent of what they are off by.
    fn curve(&self) -> f64 {
        STRAIGHT
    }

    /// Puts values that mean the same in different orders (branches) into one.
    fn ordered(&self, _values: &mut [f64]) {}

    /// The effect that does the same where readings stay for `held_s`, though the design says that each is new: what a reading holds
    /// is then part of a period.
    fn when_held(&self, _values: &[f64], _held_s: f64) -> Option<&'static str> {
        None
    }

    /// What the recorded current would be off by if that, and not this effect, were behind a battery's voltage.
    fn in_the_current(&self, _values: &[f64], _scale: &Scale) -> Option<CurrentError> {
        None
    }

    /// Why values within the bounds can hardly be what the effect says, if so.
    fn unlikely(&self, _values: &[f64]) -> Option<&'static str> {
        None
    }

    /// How far from its row, before and after, in s, a reading depends on the reference by more than a thousandth.
    fn reach_s(&self, _values: &[f64], _scale: &Scale) -> [f64; 2] {
        [0.0; 2]
    }

    /// By how much a value may be lower, and higher, than what is found where only edges of the reference tell it, each somewhere between
    /// two rows that are `step_s` apart: the simulation has a straight line there.
    fn left_open_by_edges(&self, _parameter: usize, _value: f64, _step_s: f64) -> [f64; 2] {
        [0.0; 2]
    }

    /// By how much an internal parameter comes round: where in a turn a file begins is no property of the physics.
    fn turn(&self, _values: &[f64]) -> Option<f64> {
        None
    }

    /// Whether it is a curve of the present current with a memory, and named for the memory.
    fn remembers(&self) -> bool {
        false
    }

    /// The parameter that says how a recording begins, if there is one: its first rows tell it and no others.
    fn beginning(&self) -> Option<usize> {
        None
    }

    /// What follows from the values, in plain words.
    fn consequences(&self, _values: &[f64], _problem: &Problem) -> Vec<String> {
        Vec::new()
    }
}

/// An effect that shows without a fit.
#[derive(Clone, Debug)]
pub struct Mark {
    /// A value for each of its parameters.
    pub values: Vec<f64>,
    /// How far each of them may be off.
    pub within: Vec<f64>,
    /// Variance that it adds to the residual, in the view's unit squared. If it rounds ([`Effect::rounds`]), a simulation that
    /// rounds too has as much again where noise is ahead of the grid.
    pub variance: f64,
    /// What the readings do.
    pub what: &'static str,
}

/// What is known when starts are looked for: the readings that count, with the simulation so far.
#[derive(Clone, Copy, Debug)]
pub struct Clues<'a> {
    /// Time of each reading in s.
    pub t_s: &'a [f64],
    /// The reading.
    pub observed: &'a [f64],
    /// The simulation so far.
    pub predicted: &'a [f64],
}

/// The effect of an id; of several with the same id (branches of polarisation) the one with `parameters` parameters.
pub fn find_with(id: &str, parameters: usize) -> Option<&'static dyn Effect> {
    LIBRARY
        .iter()
        .copied()
        .find(|effect| effect.card().id == id && effect.card().parameters.len() == parameters)
}

/// The effect of an id; of several, the one with the most parameters.
pub fn find(id: &str) -> Option<&'static dyn Effect> {
    LIBRARY
        .iter()
        .copied()
        .filter(|effect| effect.card().id == id)
        .max_by_key(|effect| effect.card().parameters.len())
}

/// The columns of which an effect lacks all, so that it does nothing in a problem beside effects with these ids.
pub fn lacks<'e>(
    effect: &dyn Effect,
    problem: &Problem,
    mut beside: impl Iterator<Item = &'e str>,
) -> Option<String> {
    let columns = effect.columns();
    let mut recorded = problem.drive.surroundings();
    if columns.is_empty() || recorded.any(|(name, ..)| columns.contains(&name)) {
        return None;
    }
    // A cell that warms itself has a temperature that nobody recorded.
    let heated = cell_self_heating::CellSelfHeating.card().id;
    let warms = columns.contains(&"temp_cell_c") && beside.any(|id| id == heated);
    (!warms).then(|| columns.join(" or "))
}

/// Ids in the order of the table, each once.
pub fn ids() -> Vec<&'static str> {
    let mut ids: Vec<&'static str> = LIBRARY.iter().map(|effect| effect.card().id).collect();
    ids.dedup();
    ids
}

/// A view in which the sensing chain shows.
fn sensing(problem: &Problem) -> bool {
    matches!(problem.view, View::Sensor | View::Charge)
}

/// A view in which charge and state of charge show.
fn counting(problem: &Problem) -> bool {
    matches!(problem.view, View::StateOfCharge | View::Voltage)
}

/// Logarithmically spaced values, both ends included.
fn spaced(from: f64, to: f64, count: usize) -> Vec<f64> {
    if !(from > 0.0 && to > from) || count < 2 {
        return vec![from.max(to)];
    }
    let ratio = (to / from).ln() / (count - 1) as f64;
    (0..count)
        .map(|k| from * (ratio * k as f64).exp())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::problem::{
        Accuracy, Base, BatteryBase, Coloured, Drive, Observed, SensorBase, Series,
    };

    #[test]
    fn ids_and_parameter_names_are_the_contract() {
        let table: Vec<(&str, Vec<&str>)> = ids()
            .into_iter()
            .map(|id| {
                let parameters = find(id).map(|effect| effect.card().parameters);
                let named = parameters
                    .unwrap_or_default()
                    .iter()
                    .filter(|p| !p.internal);
                let names = named.map(|p| p.name).collect();
                (id, names)
            })
            .collect();
        let expected: [(&str, &[&str]); 32] = [
            ("offset", &["offset_a"]),
            ("gain", &["gain"]),
            ("offset-temperature", &["tc_a_per_k"]),
            ("gain-temperature", &["tc_per_k"]),
            ("supply-ratiometric", &["ratio"]),
            (
                "core-hysteresis",
                &["remanence_a", "coercivity_a", "spread", "scatter"],
            ),
            ("core-saturation", &["knee_a", "softness"]),
            ("clipping", &["high_a", "low_a"]),
            ("lag", &["tau_s"]),
            ("moving-average", &["window_s"]),
            ("delay", &["delay_s"]),
            ("clock-skew", &["skew_ppm"]),
            ("hum", &["frequency_hz", "amplitude_a"]),
            ("quantisation", &["step_a"]),
            ("dead-band", &["threshold_a"]),
            ("range-handover", &["tau_s"]),
            ("range-mismatch", &["gain_ratio", "offset_a"]),
            ("sensor-self-heating", &["tc_per_a2", "tau_s"]),
            ("stray-field", &["coupling"]),
            ("sampled-window", &["period_s", "duty"]),
            ("coulombic-efficiency", &["efficiency"]),
            ("parasitic-load", &["load_a"]),
            ("capacity", &["capacity_ah"]),
            ("charge-transfer", &["i0_a"]),
            (
                "polarisation",
                &["r1_ohm", "tau1_s", "r2_ohm", "tau2_s", "r3_ohm", "tau3_s"],
            ),
            ("diffusion", &["r_ohm", "tau_s", "ocv_share"]),
            ("ocv-hysteresis", &["m_v", "gamma"]),
            ("resistance", &["scale"]),
            ("resistance-temperature", &["b_k"]),
            (
                "resistance-soc",
                &["rise", "knee_soc", "rise_full", "knee_full_soc"],
            ),
            ("cell-self-heating", &["rth_k_per_w", "tau_s"]),
            ("entropic", &["v_per_k"]),
        ];
        assert_eq!(table.len(), expected.len());
        for ((id, names), (expected_id, expected_names)) in table.iter().zip(expected) {
            assert_eq!((*id, names.as_slice()), (expected_id, expected_names));
        }
    }

    /// 300 rows of a drive with everything that an effect asks for; the battery's surroundings at 0 °C.
    fn problem(view: View, base: Base, has_cell_temperature: bool) -> Problem {
        let series =
            |of: &dyn Fn(f64) -> f64| -> Series { (0..300).map(|k| of(f64::from(k))).collect() };
        let t_s = series(&|k| 0.5 * k);
        let drive = Drive {
            mean_share: None,
            holds: None,
            t_s: t_s.clone(),
            reference: series(&|k| {
                30.0 * (0.05 * k).sin() + if k % 70.0 < 30.0 { 20.0 } else { 0.0 }
            }),
            sensor_temperature_c: Some(series(&|k| 20.0 + 0.05 * k)),
            supply_v: Some(series(&|k| 5.0 + 0.1 * (0.02 * k).sin())),
            aux_a: Some(series(&|k| 10.0 * (0.09 * k).cos())),
            range_high: Some(series(&|k| f64::from(k % 70.0 < 30.0))),
            cell_temperature_c: has_cell_temperature.then(|| series(&|k| 5.0 + 0.01 * k)),
            ambient_c: Some(series(&|_| 0.0)),
            segments: std::iter::once(0..300).collect(),
            continues: vec![false],
            parts: 0,
        };
        Problem {
            view,
            name: "x".into(),
            unit: "1".into(),
            drive,
            observed: Observed::with_drive(t_s, vec![0.0; 300]),
            base,
            modelled: Vec::new(),
            noise: 0.0,
            coloured: Coloured::default(),
            accuracy: Accuracy::default(),
        }
    }

    /// Of so many cells in series, as [`crate::prepare`] makes it.
    fn battery(cells: f64) -> Base {
        let cell = [(0.0, 3.0), (0.3, 3.5), (1.0, 4.1)];
        Base::Battery(BatteryBase {
            capacity_ah: 2.0,
            efficiency: 1.0,
            initial_soc: vec![0.5],
            ocv: cell.map(|(soc, v)| (soc, cells * v)).to_vec(),
            cells,
            resistance_ohm: cells * 0.002,
            ..BatteryBase::default()
        })
    }

    fn said(problem: &Problem, effects: &[(&'static dyn Effect, Vec<f64>)]) -> Vec<f64> {
        let members: Vec<(&'static dyn Effect, &[f64])> = effects
            .iter()
            .map(|(effect, values)| (*effect, values.as_slice()))
            .collect();
        chain::Chain::new(problem).run(&members, &chain::Nuisance::default())
    }

    #[test]
    fn an_effect_that_is_off_changes_nothing() {
        let sensor = || {
            Base::Sensor(SensorBase {
                full_scale: Some(60.0),
                range_ratio: 10.0,
                range_limit: Some(15.0),
                ..SensorBase::default()
            })
        };
        let problems = [
            problem(View::Sensor, sensor(), false),
            problem(View::StateOfCharge, battery(1.0), false),
            problem(View::Voltage, battery(1.0), false),
            problem(View::Voltage, battery(96.0), true),
        ];
        let mut not_off = Vec::new();
        for effect in LIBRARY {
            let card = effect.card();
            // Without a value of its own it is off at the design's.
            let off = card.parameters.iter().map(|parameter| {
                if parameter.off.is_nan() {
                    2.0
                } else {
                    parameter.off
                }
            });
            let off: Vec<f64> = off.collect();
            let mut asked = 0;
            for problem in problems.iter().filter(|problem| effect.applies(problem)) {
                asked += 1;
                let plain = said(problem, &[]);
                let with = said(problem, &[(effect, off.clone())]);
                let same = |(plain, with): (&f64, f64)| (plain - with).abs() < 1e-9;
                if !plain.iter().zip(with).all(same) {
                    not_off.push((card.id, problem.view));
                }
            }
            assert!(asked > 0, "{}", card.id);
        }
        assert!(not_off.is_empty(), "{not_off:?}");
    }

    #[test]
    fn a_pack_is_its_cells_with_the_same_values() {
        for effect in LIBRARY {
            let id = effect.card().id;
            let values = match id {
                "charge-transfer" => vec![4.0],
                "polarisation" => [0.003, 5.0, 0.002, 20.0, 0.004, 60.0].to_vec(),
                "diffusion" => vec![0.01, 50.0, 0.5],
                "ocv-hysteresis" => vec![0.02, 300.0],
                "resistance" => vec![1.6],
                "resistance-temperature" => vec![2500.0],
                "resistance-soc" => vec![2.0, 0.9, 1.0, 0.3],
                "cell-self-heating" => vec![20.0, 30.0],
                "entropic" => vec![4e-4],
                _ => continue,
            };
            let values = values[..effect.card().parameters.len()].to_vec();
            let has_cell_temperature = id != "cell-self-heating";
            let [cell, pack] = [1.0, 96.0].map(|cells| {
                let problem = problem(View::Voltage, battery(cells), has_cell_temperature);
                let plain = said(&problem, &[]);
                let with = said(&problem, &[(effect, values.clone())]);
                (plain, with)
            });
            assert!(cell.0 != cell.1, "{id} did nothing");
            for (cell, pack) in cell.1.iter().zip(&pack.1) {
                assert!((96.0 * cell - pack).abs() < 1e-9, "{id}: {cell}, {pack}");
            }
        }
    }

    /// Values must mean the same whichever effect was found, or written down, first.
    #[test]
    fn effects_act_in_one_order() {
        let sensor = Base::Sensor(SensorBase {
            full_scale: Some(60.0),
            range_ratio: 10.0,
            range_limit: Some(15.0),
            ..SensorBase::default()
        });
        let problems = [
            problem(View::Sensor, sensor, false),
            problem(View::Voltage, battery(1.0), true),
        ];
        let scale = Scale {
            full_scale: 60.0,
            largest: 50.0,
            rms: 25.0,
            step_s: 0.5,
            reading_step_s: 0.5,
            spectral_step_s: 0.5,
            span_s: 150.0,
            capacity_ah: 2.0,
            soc: (0.1, 0.95),
            ..Scale::default()
        };
        let clues = Clues {
            t_s: &[],
            observed: &[],
            predicted: &[],
        };
        for problem in &problems {
            let effects: Vec<(&'static dyn Effect, Vec<f64>)> = LIBRARY
                .iter()
                .filter(|effect| effect.applies(problem))
                .filter_map(|effect| {
                    let start = effect.starts(&scale, &clues).pop()?;
                    Some((*effect, start))
                })
                .collect();
            assert!(effects.len() > 10);
            for one in &effects {
                for other in effects
                    .iter()
                    .filter(|other| other.0.card().id != one.0.card().id)
                {
                    let there = said(problem, &[one.clone(), other.clone()]);
                    let back = said(problem, &[other.clone(), one.clone()]);
                    let ids = [one, other].map(|(effect, _)| effect.card().id);
                    assert_eq!(there, back, "{ids:?}");
                }
            }
        }
    }

    #[test]
    fn what_it_looks_like_exists() {
        for effect in LIBRARY {
            for other in effect.card().looks_like {
                assert!(find(other).is_some(), "{}: {other}", effect.card().id);
            }
        }
    }
}
