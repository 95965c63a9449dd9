//! Names that are taken back: effects whose values waver, or that the recording does not tell.

use super::fit::{self, Fit};
use super::intervals::{self, Variation};
use super::robust::loss;
use super::select::{self, Selection};
use super::told::short;
use super::unfitted::{Unfitted, confirmed};
use super::workbench::{Member, Model, Workbench};
use crate::effects::scene::Scale;
use crate::effects::{IDEALISED, Parameter, Search, find};
use crate::problem::Base;
use crate::report::format::precise_percent;

/// An effect whose values would have to differ from stretch to stretch by so many times what equations may be off by (14 % of it,
/// rms, of a sensor's; 28 % of a battery's) is not what is there: true ones of other people's circuits and cells stay below.
pub(super) const WAVERS: f64 = 2.8;
/// An interval whose ends differ by this factor says nothing.
const VAGUE: f64 = 100.0;
/// Starts of an effect that are fitted in another's place; of more the nearest.
const STAND_INS: usize = 12;

/// Whether values would have to differ from stretch to stretch by more than noise makes them, and by much.
fn waver(bench: &Workbench<'_>, member: &Member, variation: &Variation) -> bool {
    variation.deviations > select::CERTAIN
        && variation.share > (WAVERS * roughness(bench, member)).powi(2)
}

/// What an effect's equation may be off by, as a share of its change, rms.
pub(super) fn roughness(bench: &Workbench<'_>, member: &Member) -> f64 {
    // Without relaxation and charge transfer the battery as designed is rougher than a sensor.
    let base = match bench.problem.base {
        Base::Sensor(_) => IDEALISED,
        Base::Battery(_) => 2.0 * IDEALISED,
    };
    member.effect.idealised().max(base)
}

/// Takes effects out again whose values would have to differ from stretch to stretch by more than noise makes them; true if there
/// were any.
pub(super) fn wavering(
    bench: &Workbench<'_>,
    selection: &mut Selection,
    others: &[Unfitted<'_>],
) -> bool {
    let mut refused: Vec<&'static str> = Vec::new();
    while !selection.named.is_empty() && !confirmed(selection, others) {
        let members = &selection.fit.model.members;
        let found = intervals::variations(bench, &selection.fit)
            .into_iter()
            .enumerate()
            .filter(|(index, variation)| waver(bench, &members[*index], variation))
            .max_by(|a, b| a.1.share.total_cmp(&b.1.share));
        let Some((index, variation)) = found else {
            break;
        };
        let id = members[index].id();
        // What was refused once does not come back in another's place: else two could take turns for ever.
        refused.push(id);
        selection.refused.push(format!(
            "{id}: fits, but its values would have to differ by {} from stretch to stretch, {:.0} standard deviations more than noise: what is there is not constant",
            precise_percent(variation.share.sqrt()),
            variation.deviations
        ));
        let steady = |fit: &Fit| {
            let last = intervals::variations(bench, fit);
            let last = last.last().zip(fit.model.members.last());
            last.is_some_and(|(variation, member)| !waver(bench, member, variation))
        };
        replace(
            bench,
            selection,
            index,
            ("its values stay", &refused),
            &steady,
        );
    }
    !refused.is_empty()
}

/// Takes effects out again whose values the recording does not tell, or that ended where physics does; where others would do as
/// well, the best of those whose values it does tell takes the place.
pub(super) fn vague(bench: &Workbench<'_>, selection: &mut Selection) {
    let why = |member: &Member, intervals: &[[f64; 2]]| {
        untold(&bench.scale, member, intervals).or_else(|| ended(bench, member))
    };
    withdraw(bench, selection, 0.0, &why);
}

/// The same of doubted names with values that are searched in steps (a period, a threshold), where so much energy may be another
/// physics': with thousands of them to choose from, one follows a part of whatever is left. True if there were any.
pub(super) fn vague_beside(bench: &Workbench<'_>, selection: &mut Selection, beside: f64) -> bool {
    let in_steps = |member: &Member| {
        let mut parameters = member.effect.card().parameters.iter();
        parameters.any(|parameter| parameter.search == Search::Stepped && !parameter.internal)
    };
    let members = &selection.fit.model.members;
    if !members.iter().any(in_steps) {
        return false;
    }
    withdraw(bench, selection, beside, &|member, intervals| {
        in_magnitudes(member, intervals, Search::Stepped)
    })
}

/// What the intervals of an effect say against its name.
type Why<'a> = dyn Fn(&Member, &[[f64; 2]]) -> Option<String> + 'a;

/// Takes effects out, one after the other, against which their intervals say something, or puts the best of its equals in the place;
/// `beside` as in [`intervals::intervals`]. True if there were any.
fn withdraw(bench: &Workbench<'_>, selection: &mut Selection, beside: f64, why: &Why<'_>) -> bool {
    let mut refused: Vec<&'static str> = Vec::new();
    while !selection.named.is_empty() {
        let intervals = intervals::intervals(bench, &selection.fit, beside);
        let members = &selection.fit.model.members;
        let mut asked = members.iter().zip(&intervals).enumerate();
        let found =
            asked.find_map(|(index, (member, intervals))| Some((index, why(member, intervals)?)));
        let Some((index, why)) = found else {
            break;
        };
        let id = members[index].id();
        refused.push(id);
        selection.refused.push(format!(
            "{id}: fits, but this recording does not tell its values: {why}"
        ));
        replace(
            bench,
            selection,
            index,
            ("the recording tells its values", &refused),
            &|_| true,
        );
    }
    !refused.is_empty()
}

/// Whether the last fit brought a value to the end of what is physics, where no effect is accepted; what readings show by
/// themselves no fit has moved.
fn ended(bench: &Workbench<'_>, member: &Member) -> Option<String> {
    match bench.shown(member) {
        Some(_) => None,
        None => select::at_end(bench, member),
    }
}

/// Takes an effect out of the model, or puts the best of its equals of which something holds in its place.
fn replace(
    bench: &Workbench<'_>,
    selection: &mut Selection,
    index: usize,
    (why, refused): (&str, &[&'static str]),
    holds: &dyn Fn(&Fit) -> bool,
) {
    let id = selection.fit.model.members[index].id();
    let holds = |fit: &Fit| {
        let last = fit.model.members.last();
        last.is_none_or(|member| !refused.contains(&member.id())) && holds(fit)
    };
    let without = fit::fit(bench, &selection.fit.model.without(index), None);
    match stand_in(bench, selection, &without.model, index, &holds) {
        Some(better) => {
            selection.decisions.push(format!(
                "{} instead of {id}: as good, and {why}.",
                better.model.members.last().map_or("", Member::id)
            ));
            selection.take(index, better);
        }
        None => selection.fit = select::settled(bench, &without),
    }
    selection.rename(bench);
}

/// The best of what would have done as well in the place of an effect that was taken out, if the recording tells its values.
fn stand_in(
    bench: &Workbench<'_>,
    selection: &Selection,
    without: &Model,
    index: usize,
    holds: &dyn Fn(&Fit) -> bool,
) -> Option<Fit> {
    let named = selection.named.iter().find(|one| one.index == index)?;
    let as_read = bench.as_read(&selection.fit.predicted);
    let clues = bench.clues(&as_read);
    let mut fits: Vec<Fit> = named
        .equivalent
        .iter()
        .filter_map(|id| find(id))
        // A form with more branches stands for what was taken out and for the smaller form beside it.
        .filter(|effect| select::joins(without, *effect))
        .flat_map(|effect| {
            let starts = effect.starts(&bench.scale, &clues).into_iter();
            let models = starts.map(|values| select::added(without, Member { effect, values }));
            nearest(bench, models.collect())
        })
        .map(|model| fit::fit(bench, &model, None))
        .collect();
    // In one spread for all: in its own, a bad fit's residual is a small one.
    let sigma = fits
        .iter()
        .fold(selection.fit.sigma, |least, fit| least.min(fit.sigma));
    let loss = |fit: &Fit| loss(&fit.residual, sigma);
    fits.sort_by(|a, b| loss(a).total_cmp(&loss(b)));
    let found = fits.into_iter().find(|fit| {
        let last = fit.model.members.len() - 1;
        let member = &fit.model.members[last];
        select::at_end(bench, member).is_none()
            && untold(
                &bench.scale,
                member,
                &intervals::intervals(bench, fit, 0.0)[last],
            )
            .is_none()
            && holds(fit)
            && select::does_as_well(bench, fit, &selection.fit, index)
    });
    found.map(|fit| select::settled(bench, &fit))
}

/// Of many models the nearest to the readings as they are.
fn nearest(bench: &Workbench<'_>, models: Vec<Model>) -> Vec<Model> {
    if models.len() <= STAND_INS {
        return models;
    }
    let mut ranked: Vec<(f64, Model)> = models
        .into_iter()
        .map(|model| {
            let residual = bench.residual(&bench.run(&model));
            (residual.iter().map(|r| r.abs()).sum(), model)
        })
        .collect();
    ranked.sort_by(|a, b| a.0.total_cmp(&b.0));
    let nearest = ranked.into_iter().take(STAND_INS);
    nearest.map(|(_, model)| model).collect()
}

/// A value whose interval says nothing, where all of those that are searched for in a way are such: where one size is told (a knee),
/// another (how soft it is) need not be.
fn in_magnitudes(member: &Member, intervals: &[[f64; 2]], search: Search) -> Option<String> {
    let parameters = member.effect.card().parameters.iter().zip(intervals);
    let mut sizes = parameters
        .filter(|(parameter, _)| !parameter.internal && parameter.search == search)
        // A share of something says nothing of how large that is.
        .filter(|(parameter, _)| search != Search::Stepped || !parameter.open);
    let (parameter, [low, high]) = sizes.next()?;
    let vague = |low: f64, high: f64| high > VAGUE * low;
    (vague(*low, *high) && sizes.all(|(_, [low, high])| vague(*low, *high)))
        .then(|| could_be(parameter, *low, *high))
}

fn could_be(parameter: &Parameter, low: f64, high: f64) -> String {
    format!(
        "{} could be {} … {}",
        parameter.name,
        short(low),
        short(high)
    )
}

/// Why the recording does not tell an effect's values: an interval over orders of magnitude or over all that is physics, or
/// every size that the effect has could as well be none.
fn untold(scale: &Scale, member: &Member, intervals: &[[f64; 2]]) -> Option<String> {
    let parameters = member.effect.card().parameters;
    let known = || {
        parameters
            .iter()
            .zip(intervals)
            .enumerate()
            .filter(|(_, (parameter, _))| !parameter.internal)
    };
    let magnitudes = [Search::Logarithmic, Search::Stepped]
        .into_iter()
        .find_map(|search| in_magnitudes(member, intervals, search));
    if magnitudes.is_some() {
        return magnitudes;
    }
    for (index, (parameter, [low, high])) in known() {
        let (lowest, highest) = member.effect.bounds(index, scale);
        if !parameter.open && !parameter.to_top && low <= &lowest && high >= &highest {
            return Some(could_be(parameter, *low, *high));
        }
    }
    // At 0 there is none of it; a knee or a frequency is where it is, and none at no value.
    let is_size = |parameter: &Parameter| match parameter.search {
        Search::Linear => parameter.off.is_finite(),
        Search::Smooth => parameter.off == 0.0 && !parameter.open,
        Search::Logarithmic | Search::Stepped => false,
    };
    let sizes: Vec<_> = known()
        .filter(|(_, (parameter, _))| is_size(parameter))
        .collect();
    let none =
        |(parameter, [low, high]): (&Parameter, &[f64; 2])| (*low..=*high).contains(&parameter.off);
    (!sizes.is_empty() && sizes.iter().all(|(_, pair)| none(*pair))).then(|| {
        format!(
            "{} could as well be {}",
            sizes[0].1.0.name,
            short(sizes[0].1.0.off)
        )
    })
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)]
mod tests {
    use super::*;
    use crate::explain::normal::dot;
    use crate::problem::{Accuracy, BatteryBase, Coloured, Drive, Observed, Problem, View};

    #[test]
    fn what_a_recording_does_not_tell_is_told_from_what_it_does() {
        let scale = Scale {
            full_scale: 600.0,
            largest: 400.0,
            rms: 100.0,
            step_s: 0.1,
            reading_step_s: 0.1,
            spectral_step_s: 0.1,
            span_s: 1000.0,
            capacity_ah: 50.0,
            ..Scale::default()
        };
        let says = |id: &str, intervals: &[[f64; 2]]| {
            let effect = find(id).unwrap();
            let values = intervals.iter().map(|[low, high]| 0.5 * (low + high));
            let member = Member {
                effect,
                values: values.collect(),
            };
            untold(&scale, &member, intervals)
        };
        assert_eq!(says("offset", &[[0.1, 0.3]]), None);
        assert!(
            says("offset", &[[-0.1, 0.3]])
                .unwrap()
                .contains("offset_a could as well be 0")
        );
        // One size is enough.
        assert_eq!(says("range-mismatch", &[[1.01, 1.02], [-0.1, 0.1]]), None);
        assert!(says("range-mismatch", &[[0.99, 1.02], [-0.1, 0.1]]).is_some());
        // Nor is a size that is searched for otherwise.
        let heat = says("cell-self-heating", &[[0.0, 17.7], [100.0, 300.0]]);
        assert!(heat.unwrap().contains("rth_k_per_w could as well be 0"));
        assert_eq!(
            says("cell-self-heating", &[[5.0, 17.7], [100.0, 300.0]]),
            None
        );
        assert!(says("clock-skew", &[[-30.0, 200.0]]).is_some());
        assert_eq!(says("clock-skew", &[[150.0, 250.0]]), None);
        assert!(says("delay", &[[-0.1, 0.1]]).is_some());
        assert!(says("resistance-temperature", &[[-200.0, 900.0]]).is_some());
        // What is a place is none at no value.
        assert!(says("resistance-soc", &[[-0.1, 0.3], [0.2, 0.25]]).is_some());
        assert_eq!(says("resistance-soc", &[[0.5, 1.0], [0.2, 0.4]]), None);
        assert!(says("coulombic-efficiency", &[[-1.0, 12.0]]).is_some());
        assert_eq!(says("coulombic-efficiency", &[[0.97, 0.99]]), None);
        assert_eq!(says("lag", &[[0.1, 0.4]]), None);
        assert!(says("lag", &[[0.01, 2.0]]).unwrap().contains("tau_s"));
        // A share of a period that may be any says nothing; of one that is known it is open.
        let window = says("sampled-window", &[[1e-4, 0.7], [0.01, 1.0], [0.0, 0.0]]);
        assert!(window.unwrap().contains("period_s could be"));
        assert_eq!(
            says("sampled-window", &[[0.2, 0.7], [0.01, 1.0], [0.0, 0.0]]),
            None
        );
        assert!(says("dead-band", &[[0.001, 0.7]]).is_some());
        assert_eq!(says("dead-band", &[[0.5, 0.7]]), None);
        assert!(says("ocv-hysteresis", &[[-3.0, 1.8], [1e-6, 1e-5]]).is_some());
        assert_eq!(says("ocv-hysteresis", &[[0.01, 0.02], [60.0, 300.0]]), None);
    }

    /// A ramp to and fro whose readings saturate beyond 60 A.
    fn saturating(softness: f64) -> Problem {
        let t_s: Vec<f64> = (0..2400).map(|row| 0.1 * f64::from(row)).collect();
        let current: Vec<f64> = t_s
            .iter()
            .map(|t| 80.0 * (0.11 * t).sin() + 30.0 * (0.83 * t).sin())
            .collect();
        let noise = t_s.iter().map(|t| 0.1 * (9973.0 * t * t).sin());
        let reading = current.iter().zip(noise).map(|(i, noise)| {
            let beyond = (i.abs() - 60.0).max(0.0);
            let read = i.abs().min(60.0) + beyond / (1.0 + beyond / (softness * 60.0));
            read.copysign(*i) + noise
        });
        let reading = reading.collect();
        Problem::pair(t_s, current, reading, 0.08)
    }

    #[test]
    fn what_the_last_fit_brought_to_the_end_of_physics_is_taken_back() {
        let problem = saturating(1.0);
        let bench = Workbench::new(&problem, &[]);
        let mut selection = select::select(&bench, 0, &mut |_, _| {});
        let saturates = |selection: &Selection| {
            let ids = selection.fit.model.ids();
            ids.iter().position(|id| *id == "core-saturation")
        };
        vague(&bench, &mut selection);
        let index = saturates(&selection).expect("a core that saturates is named and stays");
        // As a fit after selection may leave it: as sharp as a corner.
        let mut model = selection.fit.model.clone();
        model.members[index].values[1] = model.members[index].effect.bounds(1, &bench.scale).0;
        selection.fit = Fit::of(&bench, model, selection.fit.cost);
        vague(&bench, &mut selection);
        let why = selection.refused.join("\n");
        assert!(saturates(&selection).is_none(), "{why}");
        assert!(why.contains("end of what is physics"), "{why}");
    }

    #[test]
    fn a_period_that_another_physics_leaves_open_is_taken_back() {
        // A beat of two loads, by a sensor that holds the mean of a part of each period.
        let t_s: Vec<f64> = (0..1200).map(|row| 0.1 * f64::from(row)).collect();
        let current: Vec<f64> = t_s
            .iter()
            .map(|t| 40.0 * (1.7 * t).sin() + 20.0 * (4.3 * t).sin())
            .collect();
        let mut problem = Problem::pair(t_s.clone(), current, vec![0.0; t_s.len()], 0.1);
        let truth = [("sampled-window".to_owned(), vec![0.25, 0.4, 0.03])];
        let read = crate::explain::predict(&problem, &truth).into_iter();
        let noise = t_s.iter().map(|t| 0.14 * (9973.0 * t * t).sin());
        problem.observed.value = read.zip(noise).map(|(read, noise)| read + noise).collect();
        let bench = Workbench::new(&problem, &[]);
        let mut selection = select::select(&bench, 0, &mut |_, _| {});
        let ids = |selection: &Selection| selection.fit.model.ids();
        assert_eq!(ids(&selection), ["sampled-window"]);
        // As much beside it as is left says nothing against it; as much as it takes itself does.
        let left = dot(&selection.fit.residual, &selection.fit.residual);
        assert!(!vague_beside(&bench, &mut selection, left));
        let taken = dot(&selection.plain.residual, &selection.plain.residual);
        assert!(vague_beside(&bench, &mut selection, taken));
        assert!(!ids(&selection).contains(&"sampled-window"));
        let why = selection.refused.join("\n");
        assert!(why.contains("sampled-window: fits, but this recording does not tell its values: period_s could be"), "{why}");
    }

    /// A cell under a load of steps, that relaxes as a diffusion and two branches do, read with a ripple that none of them has.
    fn relaxing(ripple_v: f64) -> Problem {
        let t_s: Vec<f64> = (0..2400).map(f64::from).collect();
        let on = |t: f64, period_s: f64| f64::from(u8::from(t % period_s < 0.5 * period_s));
        let current: Vec<f64> = t_s
            .iter()
            .map(|&t| on(t, 14.0) + 2.0 * on(t, 170.0) + 2.0 * on(t, 1400.0))
            .collect();
        let mut problem = Problem {
            view: View::Voltage,
            name: "v_cell_v".into(),
            unit: "V".into(),
            observed: Observed::with_drive(t_s.clone(), vec![0.0; t_s.len()]),
            drive: Drive {
                segments: std::iter::once(0..t_s.len()).collect(),
                continues: vec![false],
                reference: current.into(),
                t_s: t_s.clone().into(),
                ..Drive::default()
            },
            base: Base::Battery(BatteryBase {
                capacity_ah: 5.0,
                efficiency: 1.0,
                initial_soc: vec![0.9],
                ocv: vec![(0.0, 3.2), (1.0, 4.1)],
                cells: 1.0,
                resistance_ohm: 0.02,
                ..BatteryBase::default()
            }),
            modelled: Vec::new(),
            noise: 2e-4,
            coloured: Coloured::default(),
            accuracy: Accuracy::default(),
        };
        let truth = [
            ("diffusion".to_owned(), vec![0.02, 4000.0]),
            ("polarisation".to_owned(), vec![0.02, 3.0, 0.02, 40.0]),
        ];
        let noise = t_s.iter().map(|t| 2e-4 * (9973.0 * t * t).sin());
        let read = crate::explain::predict(&problem, &truth).into_iter();
        let ripple = t_s.iter().map(|t| ripple_v * t.sin());
        let beside = noise.zip(ripple).map(|(noise, ripple)| noise + ripple);
        problem.observed.value = read.zip(beside).map(|(v, beside)| v + beside).collect();
        problem
    }

    /// The form of diffusion's stand-in, and whether it is told from what it stands for.
    fn larger_form(ripple_v: f64) -> Option<((&'static str, usize), bool)> {
        let problem = relaxing(ripple_v);
        let bench = Workbench::new(&problem, &[]);
        let mut selection = select::select(&bench, 0, &mut |_, _| {});
        let member = |id: &str, values: &[f64]| Member {
            effect: crate::effects::find_with(id, values.len()).unwrap(),
            values: values.to_vec(),
        };
        let slow = member("diffusion", &[0.02, 4000.0]);
        let both = Model::default()
            .with(member("polarisation", &[0.02, 3.0, 0.02, 40.0]))
            .with(slow);
        selection.fit = fit::fit(&bench, &both, None);
        selection.named = vec![select::Named {
            index: 1,
            held_out_gain: 0.5,
            placebo_p99: 0.1,
            by_place: None,
            equivalent: vec!["polarisation"],
        }];
        let without = selection.fit.model.without(1);
        let found = stand_in(&bench, &selection, &without, 1, &|_| true)?;
        assert_eq!(found.model.members.len(), 1, "{:?}", found.model);
        let told = select::beaten(&bench, &found, &selection.fit);
        Some((found.model.members[0].form(), told))
    }

    #[test]
    fn a_larger_form_stands_for_an_equal_and_for_the_smaller_form_beside_it() {
        // It is told from the two, but by less than what branches may be off by.
        assert_eq!(larger_form(4e-4), Some((("polarisation", 6), true)));
    }

    #[test]
    fn where_only_noise_is_left_what_is_told_from_the_fit_does_not_stand_for_it() {
        assert_eq!(larger_form(0.0), None);
    }
}
