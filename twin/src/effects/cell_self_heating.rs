//! The cell warms itself.

use super::scene::{Scale, Scene, USUAL_B_K, arrhenius};
use super::{Card, Clues, Effect, Parameter, Search, Stage, spaced};
use crate::problem::{Problem, View};

/// See [`CARD`].
#[derive(Debug)]
pub struct CellSelfHeating;

static CARD: Card = Card {
    id: "cell-self-heating",
    statement: "Losses warm the cell, which lowers its resistance.",
    equation: "T = T₀ + ΔT, τ·dΔT/dt + ΔT = rth·R(T)·i²; R(T) of resistance-temperature; without it the resistance by design is that at T₀, and B is 2000 K",
    parameters: &[
        Parameter::new("rth_k_per_w", "K/W", 0.0, Search::Smooth),
        Parameter::new("tau_s", "s", 300.0, Search::Logarithmic),
    ],
    shows: "slow under load, where no cell temperature is recorded",
    looks_like: &["resistance-temperature"],
    separated_by: "the temperature of the cell",
    stage: Stage::BatteryHeat,
};

impl Effect for CellSelfHeating {
    fn card(&self) -> &'static Card {
        &CARD
    }

    fn applies(&self, problem: &Problem) -> bool {
        problem.view == View::Voltage && problem.drive.cell_temperature_c.is_none()
    }

    fn bounds(&self, parameter: usize, scale: &Scale) -> (f64, f64) {
        if parameter == 0 {
            (0.0, 1000.0)
        } else {
            (10.0 * scale.step_s, 3.0 * scale.span_s)
        }
    }

    fn starts(&self, scale: &Scale, _clues: &Clues<'_>) -> Vec<Vec<f64>> {
        spaced(30.0 * scale.step_s, scale.span_s, 5)
            .into_iter()
            .map(|tau| vec![1.0, tau])
            .collect()
    }

    fn apply(&self, values: &[f64], scene: &mut Scene<'_>) {
        let drive = scene.drive;
        let Some(battery) = &mut scene.battery else {
            return;
        };
        let (rth_k_per_w, tau_s) = (values[0], values[1]);
        let ohms = battery.resistance * battery.base.resistance_ohm / battery.base.cells;
        // Where the surroundings' temperature acts on nothing, only the cell's own heat does.
        let (b_k, stated) = match battery.arrhenius_k {
            Some(b_k) => (b_k, true),
            None => (USUAL_B_K, false),
        };
        let factor_at = |around_c: f64, warmer_k: f64| {
            let from_25 = arrhenius(b_k, around_c + warmer_k);
            if stated {
                from_25
            } else {
                from_25 / arrhenius(b_k, around_c)
            }
        };
        for rows in drive
            .operations()
            .into_iter()
            .filter(|rows| !rows.is_empty())
        {
            let mut warmer_k = 0.0;
            let (mut step_s, mut kept) = (0.0, 1.0);
            let times = drive.t_s[rows.clone()].windows(2);
            let currents = scene.signal[rows.clone()].windows(2);
            let around = &mut battery.temperature_c[rows.start..rows.end];
            let mut before_c = around[0];
            let factors = &mut battery.factor[rows.start + 1..rows.end];
            for ((((times, pair), t), factor), row) in times
                .zip(currents)
                .zip(&mut around[1..])
                .zip(factors)
                .zip(rows.start + 1..)
            {
                let step = times[1] - times[0];
                if step != step_s {
                    (step_s, kept) = (step, (-step / tau_s).exp());
                }
                // The mean square of a current that goes in a straight line, at the temperature where the step begins.
                let [from, to] = drive.ends(row, [pair[0], pair[1]]);
                let square = (from * from + from * to + to * to) / 3.0;
                let loss_w = ohms * factor_at(before_c, warmer_k) * square;
                warmer_k = kept * warmer_k + (1.0 - kept) * rth_k_per_w * loss_w;
                before_c = *t;
                if !stated {
                    *factor *= factor_at(before_c, warmer_k);
                }
                *t += warmer_k;
            }
        }
    }
}
