//! Runs the simulation with effects, in the order of their stages.

use super::between::Converter;
use super::scene::Scene;
use super::{Effect, Stage};
use crate::problem::{Base, Problem, View};

/// What the base may differ by without being physics that was left out: within what the model file says it does not know.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Nuisance {
    /// Added to the state of charge at the start of each operation, 0 … 1; nothing where there is no value.
    pub soc_shift: Vec<f64>,
    /// Added to it over the gap before each segment, 0 … 1: what flowed there and was not recorded; nothing where there is no value.
    pub gap_soc_shift: Vec<f64>,
    /// Relative change of the ohmic resistance.
    pub resistance: f64,
    /// Added to what the recorded current is above the battery's, in A.
    pub current_zero_a: f64,
    /// Current in A that would have led, had it flowed for long, to what the battery remembers when the recording begins.
    pub before_a: f64,
    /// Lowest and highest temperature, in °C, at which the resistances were found, where the model file states none.
    pub resistances_at_c: Option<[f64; 2]>,
    /// What the open-circuit voltage of a cell is above each line of its table, half-way between its points, in V; nothing where there is
    /// no value.
    pub ocv_bend_v: Vec<f64>,
    /// Time by which readings are late, within half a step of the sampling: how samples stand for what is between them.
    pub alignment_s: f64,
}

impl Nuisance {
    /// The operation whose start is shifted most, from 0, and by how much (0 … 1).
    pub fn largest_soc_shift(&self) -> Option<(usize, f64)> {
        let shifts = self.soc_shift.iter().copied().enumerate();
        shifts.max_by(|a, b| a.1.abs().total_cmp(&b.1.abs()))
    }
}

/// Effects with their values.
pub type Members<'a> = [(&'static dyn Effect, &'a [f64])];

/// The simulation of one problem, ready to be run many times.
#[derive(Debug)]
pub struct Chain<'a> {
    problem: &'a Problem,
    /// How every run begins.
    start: Scene<'a>,
    /// The reading as designed less what this chain gives without effects: what the chain does not model itself.
    beside: Vec<f64>,
    /// It stops short of what cuts or rounds in the model file.
    ahead: bool,
}

/// A simulation that was run up to one of its members.
#[derive(Clone, Debug)]
pub struct Begun<'a> {
    scene: Scene<'a>,
    /// Links that were run.
    done: usize,
}

/// One step of the simulation.
#[derive(Clone, Copy)]
enum Link<'m> {
    /// An effect with its values, and its index among the members; effects of the model file have none.
    Effect(&'static dyn Effect, &'m [f64], Option<usize>),
    /// The averaging window by design.
    Window,
    /// The battery's current from what was recorded of it.
    Zero,
    /// From the drive's rows to the observation's.
    Sample,
    /// What the chain does not model itself.
    Beside,
    /// The state of charge and the open-circuit voltage.
    Count,
    /// The factor of resistance.
    Warm,
    /// The voltage, or the state of charge in %.
    Terminals,
}

/// What changes from one run to the next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Change {
    /// Values of the member at this index.
    Member(usize),
    /// [`Nuisance::soc_shift`].
    SocShift,
    /// [`Nuisance::resistance`].
    Resistance,
    /// [`Nuisance::current_zero_a`].
    CurrentZero,
    /// [`Nuisance::before_a`].
    Before,
    /// [`Nuisance::ocv_bend_v`].
    OcvBend,
    /// [`Nuisance::alignment_s`].
    Alignment,
}

/// The first link at which a change tells.
fn first(links: &[Link<'_>], change: Change) -> usize {
    let tells = |link: &Link<'_>| match (change, link) {
        (Change::Member(index), Link::Effect(_, _, member)) => *member == Some(index),
        (Change::CurrentZero, Link::Zero)
        | (Change::SocShift | Change::Before, Link::Count)
        | (Change::Resistance | Change::OcvBend, Link::Terminals)
        | (Change::Alignment, Link::Sample) => true,
        _ => false,
    };
    links.iter().position(tells).unwrap_or_default()
}

/// A run that differs from another: by what, and the members and the nuisance with it.
pub type Variation<'m> = (Change, Vec<(&'static dyn Effect, &'m [f64])>, Nuisance);

impl<'a> Chain<'a> {
    /// For a problem.
    pub fn new(problem: &'a Problem) -> Self {
        let mut chain = Self {
            problem,
            start: Scene::new(problem),
            beside: Vec::new(),
            ahead: false,
        };
        if let Base::Sensor(base) = &problem.base
            && !base.reading.is_empty()
        {
            // The reading knows nothing of an alignment.
            let unaligned = Nuisance {
                alignment_s: -base.alignment_s,
                ..Nuisance::default()
            };
            let plain = chain.run(&[], &unaligned);
            chain.beside = base
                .reading
                .iter()
                .zip(plain)
                .map(|(reading, plain)| reading - plain)
                .collect();
        }
        chain
    }

    /// The same without the effects of the model file that cut or round.
    pub fn ahead_of_cuts(mut self) -> Self {
        self.ahead = true;
        self
    }

    /// What the simulation says at each observed row; NaN where the drive does not reach.
    pub fn run(&self, members: &Members<'_>, nuisance: &Nuisance) -> Vec<f64> {
        self.run_with_noise(members, nuisance, None)
    }

    /// The same with noise of the sensor, one value for each observed row, ahead of what ends the chain (steps, thresholds,
    /// rails).
    pub fn run_with_noise(
        &self,
        members: &Members<'_>,
        nuisance: &Nuisance,
        mut noise: Option<&mut dyn Iterator<Item = f64>>,
    ) -> Vec<f64> {
        let links = self.links(members);
        let mut scene = self.start.clone();
        for link in links {
            self.apply(&mut scene, link, nuisance);
            if matches!(link, Link::Beside)
                && let Some(noise) = noise.take()
            {
                scene
                    .signal
                    .iter_mut()
                    .zip(noise)
                    .for_each(|(value, noise)| *value += noise);
            }
        }
        scene.signal.into_vec()
    }

    /// The simulation up to a member, to be gone on with for many values of it.
    pub fn begin(&self, members: &Members<'_>, nuisance: &Nuisance, index: usize) -> Begun<'a> {
        let links = self.links(members);
        let mut begun = self.begun();
        self.advance(
            &mut begun,
            &links,
            first(&links, Change::Member(index)),
            nuisance,
        );
        begun
    }

    /// A simulation of which nothing was run.
    fn begun(&self) -> Begun<'a> {
        Begun {
            scene: self.start.clone(),
            done: 0,
        }
    }

    /// Runs links up to one.
    fn advance(&self, begun: &mut Begun<'a>, links: &[Link<'_>], to: usize, nuisance: &Nuisance) {
        for link in &links[begun.done..to] {
            self.apply(&mut begun.scene, *link, nuisance);
        }
        begun.done = to;
    }

    /// The rest of it: what the simulation says at each observed row. The members are those that it was begun with; the
    /// values may differ of the one up to which it was begun.
    pub fn go_on(&self, begun: &Begun<'a>, members: &Members<'_>, nuisance: &Nuisance) -> Vec<f64> {
        let links = self.links(members);
        let mut begun = begun.clone();
        self.advance(&mut begun, &links, links.len(), nuisance);
        begun.scene.signal.into_vec()
    }

    /// What variations of a simulation say, each through `take`: what comes before a change is run once for all of them.
    pub fn vary(
        &self,
        members: &Members<'_>,
        nuisance: &Nuisance,
        variations: &[Variation<'_>],
        take: impl Fn(Vec<f64>) -> Vec<f64>,
    ) -> Vec<Vec<f64>> {
        let links = self.links(members);
        let first: Vec<usize> = variations
            .iter()
            .map(|(change, _, _)| self::first(&links, *change))
            .collect();
        let mut order: Vec<usize> = (0..variations.len()).collect();
        order.sort_by_key(|k| first[*k]);
        let mut outputs = vec![Vec::new(); variations.len()];
        let mut begun = self.begun();
        for k in order {
            self.advance(&mut begun, &links, first[k], nuisance);
            let (_, members, nuisance) = &variations[k];
            outputs[k] = take(self.go_on(&begun, members, nuisance));
        }
        outputs
    }

    /// The steps of the simulation, in their order.
    fn links<'m>(&'m self, members: &Members<'m>) -> Vec<Link<'m>> {
        let mut order: Vec<Link<'m>> = Vec::with_capacity(members.len() + 4);
        let mut effects: Vec<(&'static dyn Effect, &'m [f64], Option<usize>)> = self
            .problem
            .modelled
            .iter()
            .filter_map(|(id, values)| {
                Some((super::find_with(id, values.len())?, values.as_slice(), None))
            })
            .filter(|(effect, _, _)| !(self.ahead && effect.cuts()))
            .chain(
                members
                    .iter()
                    .enumerate()
                    .map(|(index, (effect, values))| (*effect, *values, Some(index))),
            )
            .collect();
        effects.sort_by_key(|(effect, _, _)| effect.card().place());
        // A counter counts what comes through rails and thresholds; its readings are differences of that.
        let (counted, effects): (Vec<_>, Vec<_>) =
            effects.into_iter().partition(|(effect, _, _)| {
                let stage = effect.card().stage;
                self.problem.view == View::Charge && matches!(stage, Stage::Rail | Stage::Threshold)
            });
        let counted = counted
            .into_iter()
            .map(|(effect, values, index)| Link::Effect(effect, values, index));
        let mut next = effects.into_iter().peekable();
        let mut through = |order: &mut Vec<Link<'m>>, last: Stage| {
            while let Some((effect, values, index)) =
                next.next_if(|(effect, _, _)| effect.card().stage <= last)
            {
                order.push(Link::Effect(effect, values, index));
            }
        };
        match &self.problem.base {
            Base::Sensor(base) => {
                through(&mut order, Stage::Filter);
                if base.window_s > 0.0 {
                    order.push(Link::Window);
                }
                through(&mut order, Stage::Converter);
                order.extend(counted);
                order.extend([Link::Sample, Link::Beside]);
                through(&mut order, Stage::BatteryVoltage);
            }
            Base::Battery(_) => {
                order.push(Link::Zero);
                through(&mut order, Stage::BatteryCharge);
                order.push(Link::Count);
                through(&mut order, Stage::BatteryHeat);
                order.push(Link::Warm);
                through(&mut order, Stage::BatteryVoltage);
                order.extend([Link::Terminals, Link::Sample]);
            }
        }
        order
    }

    fn apply(&self, scene: &mut Scene<'_>, link: Link<'_>, nuisance: &Nuisance) {
        match link {
            Link::Effect(effect, values, _) => {
                // A counter's rails and thresholds are behind the converter.
                if effect.card().stage > Stage::Converter {
                    scene.onto_rows();
                }
                effect.apply(values, scene);
            }
            Link::Window => {
                let window_s = scene.sensor.map_or(0.0, |sensor| sensor.window_s);
                scene.convert(Converter::Mean { window_s });
                // Not from time to time: over a drive of the board's 10,000 uneven rows that took seven times as long, and named a
                // moving average beside the gain that was there.
                scene.onto_rows();
            }
            Link::Sample => {
                let by_design_s = match &self.problem.base {
                    Base::Sensor(base) => base.alignment_s,
                    Base::Battery(base) => base.alignment_s,
                };
                scene.delay_s += nuisance.alignment_s + by_design_s;
                scene.sample(self.problem.view);
            }
            Link::Zero => {
                let by_design_a = scene
                    .battery
                    .as_ref()
                    .map_or(0.0, |it| it.base.current_zero_a);
                let zero_a = by_design_a + nuisance.current_zero_a;
                // Without a zero the series stays shared.
                if zero_a != 0.0 {
                    scene.signal.iter_mut().for_each(|i| *i -= zero_a);
                }
            }
            // Without a reading as designed the series stays shared.
            Link::Beside if self.beside.is_empty() => {}
            Link::Beside => scene
                .signal
                .iter_mut()
                .zip(&self.beside)
                .for_each(|(value, beside)| *value += beside),
            Link::Count => {
                if let Some(battery) = &mut scene.battery {
                    battery.soc_shift.clone_from(&nuisance.soc_shift);
                    battery.gap_soc_shift.clone_from(&nuisance.gap_soc_shift);
                    battery.before_a = nuisance.before_a;
                    battery.count(scene.drive, &scene.signal);
                    if self.problem.view != View::StateOfCharge {
                        battery.open_circuit();
                    }
                }
            }
            Link::Warm => {
                if let Some(battery) = &mut scene.battery {
                    let known_at_c = battery.base.resistances_at_c;
                    battery.warm(known_at_c.or(nuisance.resistances_at_c), scene.drive);
                }
            }
            Link::Terminals => {
                if let Some(battery) = &mut scene.battery {
                    battery.resistance *= 1.0 + nuisance.resistance;
                    if self.problem.view == View::StateOfCharge {
                        scene.signal = battery.soc.iter().map(|soc| 100.0 * soc).collect();
                    } else {
                        battery.bend(&nuisance.ocv_bend_v);
                        battery.voltage(&mut scene.signal);
                    }
                }
            }
        }
    }
}
