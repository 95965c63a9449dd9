//! Runs the simulation with effects, in the order of their stages.

use super::scene::Scene;
use super::{Effect, Stage};
use crate::problem::{Base, Problem, View};

/// What the base may differ by without being physics that was left out: within what the model file says it does not know.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Nuisance {
    /// Added to the initial state of charge, 0 … 1.
    pub soc_shift: f64,
    /// Relative change of the ohmic resistance.
    pub resistance: f64,
    /// Time by which readings are late, within half a step of the sampling: how samples stand for what is between them.
    pub alignment_s: f64,
}

/// Effects with their values.
pub type Members<'a> = [(&'static dyn Effect, &'a [f64])];

/// The simulation of one problem, ready to be run many times.
#[derive(Debug)]
pub struct Chain<'a> {
    problem: &'a Problem,
    /// The reading as designed less what this chain gives without effects: what the chain does not model itself.
    beside: Vec<f64>,
}

impl<'a> Chain<'a> {
    /// For a problem.
    pub fn new(problem: &'a Problem) -> Self {
        let mut chain = Self {
            problem,
            beside: Vec::new(),
        };
        if let Base::Sensor(base) = &problem.base
            && !base.reading.is_empty()
        {
            // The reading knows nothing of an alignment.
            let unaligned = Nuisance {
                alignment_s: -base.alignment_s,
                ..Nuisance::default()
            };
            let plain = chain.run(&[], unaligned);
            chain.beside = base
                .reading
                .iter()
                .zip(plain)
                .map(|(reading, plain)| reading - plain)
                .collect();
        }
        chain
    }

    /// What the simulation says at each observed row; NaN where the drive does not reach.
    pub fn run(&self, members: &Members<'_>, nuisance: Nuisance) -> Vec<f64> {
        self.run_with_noise(members, nuisance, &[])
    }

    /// The same with noise of the sensor, one value for each observed row, ahead of what ends the chain (steps, thresholds,
    /// rails).
    pub fn run_with_noise(
        &self,
        members: &Members<'_>,
        nuisance: Nuisance,
        noise: &[f64],
    ) -> Vec<f64> {
        let problem = self.problem;
        let mut scene = Scene::new(problem);
        let mut order: Vec<(&'static dyn Effect, &[f64])> = problem
            .modelled
            .iter()
            .filter_map(|(id, values)| {
                Some((super::find_with(id, values.len())?, values.as_slice()))
            })
            .chain(members.iter().copied())
            .collect();
        order.sort_by_key(|(effect, _)| effect.card().stage);
        let mut next = order.into_iter().peekable();
        let mut apply_through = |scene: &mut Scene<'_>, last: Stage| {
            while let Some((effect, values)) =
                next.next_if(|(effect, _)| effect.card().stage <= last)
            {
                effect.apply(values, scene);
            }
        };
        scene.delay_s = nuisance.alignment_s;
        if let Base::Sensor(base) = &problem.base {
            scene.delay_s += base.alignment_s;
        }
        match &problem.base {
            Base::Sensor(base) => {
                apply_through(&mut scene, Stage::Filter);
                if base.window_s > 0.0 {
                    let held = scene.held();
                    let drive = scene.drive;
                    scene.signal = super::scene::boxcar(
                        &drive.t_s,
                        &drive.segments,
                        &scene.signal,
                        base.window_s,
                        held,
                    );
                }
                apply_through(&mut scene, Stage::Converter);
                scene.sample(problem.view);
                scene
                    .signal
                    .iter_mut()
                    .zip(&self.beside)
                    .for_each(|(value, beside)| *value += beside);
                scene
                    .signal
                    .iter_mut()
                    .zip(noise)
                    .for_each(|(value, noise)| *value += noise);
                apply_through(&mut scene, Stage::BatteryVoltage);
            }
            Base::Battery(_) => {
                if let Some(battery) = &mut scene.battery {
                    battery.soc_shift = nuisance.soc_shift;
                    battery.resistance = 1.0 + nuisance.resistance;
                }
                apply_through(&mut scene, Stage::BatteryCharge);
                if let Some(battery) = &mut scene.battery {
                    battery.count(scene.drive, &scene.signal);
                }
                apply_through(&mut scene, Stage::BatteryTemperature);
                if let Some(battery) = &mut scene.battery {
                    battery.warm();
                }
                apply_through(&mut scene, Stage::BatteryVoltage);
                if let Some(battery) = &scene.battery {
                    scene.signal = match problem.view {
                        View::StateOfCharge => battery.soc.iter().map(|soc| 100.0 * soc).collect(),
                        _ => battery.voltage(&scene.signal),
                    };
                }
                scene.sample(problem.view);
            }
        }
        scene.signal
    }
}
