//! How fast: one evaluation of a model, a whole explanation, the board's simulation.
//!
//! `cargo bench --profile tool -p twin`

#![allow(clippy::unwrap_used, clippy::single_range_in_vec_init)]

use divan::counter::ItemsCount;
use divan::{Bencher, black_box};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng as _, SeedableRng as _};
use twin::effects::find_with;
use twin::explain::workbench::{Member, Model, Workbench};
use twin::explain::{Options, explain};
use twin::model::FrontEndKind;
use twin::problem::{
    Accuracy, Base, BatteryBase, Coloured, Drive, Observed, Problem, SensorBase, Series, View,
};
use twin::simulate::board::{Board, Pace};

fn main() {
    divan::main();
}

/// Samples of one evaluation: six minutes at 10 Hz.
const EVALUATED: usize = 3600;
/// Samples of an explanation.
const EXPLAINED: usize = 6000;
/// Samples of a long one: three hours at 10 Hz.
const LONG: usize = 108_000;
/// Rows for each reading of a long one whose current bends between its rows.
const FINER: usize = 5;
/// Time constant of that current's steps, in s.
const BLUNT_S: f64 = 0.8;
/// Samples of a simulation.
const SIMULATED: usize = 1_000_000;
/// Noise of a reading, in A.
const NOISE_A: f64 = 0.5;

/// White noise of variance one: twelve evenly spread numbers have it.
fn noise(random: &mut ChaCha8Rng) -> f64 {
    (0..12)
        .map(|_| f64::from(random.next_u32()) / f64::from(u32::MAX))
        .sum::<f64>()
        - 6.0
}

/// Where the large range measures: beyond what the small one is designed for, in A.
fn range_high(reference: &[f64]) -> Series {
    reference
        .iter()
        .map(|i| f64::from(i.abs() > 53.33))
        .collect()
}

/// Effects as a simulation takes them.
fn owned(effects: &[(&str, &[f64])]) -> Vec<(String, Vec<f64>)> {
    effects
        .iter()
        .map(|(id, values)| ((*id).to_owned(), values.to_vec()))
        .collect()
}

/// A drive through discharge and charge, with steps and rests, and its surroundings.
fn drive(rows: usize, step_s: f64) -> Drive {
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let t_s: Vec<f64> = (0..rows).map(|row| row as f64 * step_s).collect();
    let mut current = 0.0;
    let mut left = 0;
    let reference: Vec<f64> = (0..rows)
        .map(|_| {
            if left == 0 {
                left = 5 + random.next_u32() % 60;
                let size = 60.0 * noise(&mut random) + 25.0;
                current = if random.next_u32() % 5 == 0 {
                    0.0
                } else {
                    size
                };
            }
            left -= 1;
            current
        })
        .collect();
    let slow = |period_s: f64| -> Vec<f64> {
        t_s.iter()
            .map(|t| (std::f64::consts::TAU * t / period_s).sin())
            .collect()
    };
    Drive {
        range_high: Some(range_high(&reference)),
        sensor_temperature_c: Some(slow(400.0).iter().map(|v| 25.0 + 12.0 * v).collect()),
        supply_v: Some(slow(150.0).iter().map(|v| 5.0 + 0.1 * v).collect()),
        cell_temperature_c: Some(slow(900.0).iter().map(|v| 22.0 + 6.0 * v).collect()),
        t_s: t_s.into(),
        reference: reference.into(),
        segments: vec![0..rows],
        continues: vec![false],
        ..Drive::default()
    }
}

fn problem(rows: usize, view: View, effects: &[(&str, &[f64])]) -> Problem {
    let drive = drive(rows, 0.1);
    let battery = view == View::Voltage;
    let mut problem = Problem {
        view,
        name: if battery { "v_cell_v" } else { "i_meas_a" }.into(),
        unit: if battery { "V" } else { "A" }.into(),
        observed: Observed::with_drive(drive.t_s.clone(), vec![0.0; rows]),
        base: if battery {
            Base::Battery(BatteryBase {
                capacity_ah: 60.0,
                efficiency: 1.0,
                initial_soc: vec![0.8],
                gap_excess_ah: Vec::new(),
                gap_soc_sigma: Vec::new(),
                initial_soc_sigma: vec![0.01],
                ocv: (0..=100)
                    .map(|k| f64::from(k) / 100.0)
                    .map(|soc| (soc, 3.0 + 1.1 * soc + 0.1 * (6.0 * soc).sin()))
                    .collect(),
                cells: 1.0,
                resistance_ohm: 0.001,
                resistance_sigma: 0.1,
                ..BatteryBase::default()
            })
        } else {
            Base::Sensor(SensorBase {
                full_scale: Some(600.0),
                range_ratio: 10.0,
                ..SensorBase::default()
            })
        },
        drive,
        modelled: Vec::new(),
        noise: if battery { 0.001 } else { NOISE_A },
        coloured: Coloured::default(),
        accuracy: Accuracy::default(),
    };
    let mut random = ChaCha8Rng::seed_from_u64(2);
    problem.observed.value = twin::explain::predict(&problem, &owned(effects))
        .into_iter()
        .map(|value| value + problem.noise * noise(&mut random))
        .collect();
    problem
}

/// Ids and values.
type Effects = &'static [(&'static str, &'static [f64])];

/// Models of one evaluation: what a sensor and a battery usually come down to.
const MODELS: [(&str, View, Effects); 6] = [
    ("sensor, gain", View::Sensor, &[("gain", &[1.01])]),
    (
        "sensor, lag and gain with temperature",
        View::Sensor,
        &[("gain-temperature", &[1e-3]), ("lag", &[0.3])],
    ),
    (
        "sensor, core hysteresis and moving average",
        View::Sensor,
        &[
            ("core-hysteresis", &[0.5, 30.0]),
            ("moving-average", &[0.45]),
        ],
    ),
    (
        "battery, two RC branches",
        View::Voltage,
        &[("polarisation", &[5e-4, 3.0, 8e-4, 60.0])],
    ),
    (
        "battery, diffusion and Arrhenius",
        View::Voltage,
        &[
            ("resistance-temperature", &[2000.0]),
            ("diffusion", &[1e-3, 200.0]),
        ],
    ),
    (
        "battery, OCV hysteresis and three RC branches",
        View::Voltage,
        &[
            ("ocv-hysteresis", &[0.01, 40.0]),
            ("polarisation", &[4e-4, 1.0, 5e-4, 20.0, 6e-4, 200.0]),
        ],
    ),
];

#[divan::bench(args = MODELS.map(|(name, _, _)| name))]
fn evaluate_3600_samples(bencher: Bencher<'_, '_>, name: &str) {
    let (_, view, effects) = MODELS.iter().find(|(known, _, _)| *known == name).unwrap();
    let problem = problem(EVALUATED, *view, effects);
    let bench = Workbench::new(&problem, &[]);
    let model = Model {
        members: effects
            .iter()
            .map(|(id, values)| Member {
                effect: find_with(id, values.len()).unwrap(),
                values: values.to_vec(),
            })
            .collect(),
        ..Model::default()
    };
    bencher
        .counter(ItemsCount::new(EVALUATED))
        .bench_local(|| bench.run(black_box(&model)));
}

#[divan::bench(args = MODELS.map(|(name, _, _)| name), sample_count = 5, sample_size = 1)]
fn explain_6000_samples(bencher: Bencher<'_, '_>, name: &str) {
    let (_, view, effects) = MODELS.iter().find(|(known, _, _)| *known == name).unwrap();
    let problem = problem(EXPLAINED, *view, effects);
    bencher.counter(ItemsCount::new(EXPLAINED)).bench_local(|| {
        explain(
            black_box(std::slice::from_ref(&problem)),
            &[],
            &Options::default(),
            &mut |_, _| {},
        )
    });
}

/// Effects of a long recording.
const LONG_EFFECTS: Effects = &[("offset", &[0.8]), ("gain", &[1.01]), ("delay", &[0.05])];

fn explain_all(bencher: Bencher<'_, '_>, problem: &Problem) {
    bencher.counter(ItemsCount::new(LONG)).bench_local(|| {
        explain(
            black_box(std::slice::from_ref(problem)),
            &[],
            &Options::default(),
            &mut |_, _| {},
        )
    });
}

#[divan::bench(args = [0, 1, 3], sample_count = 1, sample_size = 1)]
fn explain_three_hours(bencher: Bencher<'_, '_>, concealed: usize) {
    let problem = problem(LONG, View::Sensor, &LONG_EFFECTS[..concealed]);
    explain_all(bencher, &problem);
}

/// The same with steps that are low-passed, as a motor's current is: what flows between the rows is no straight line, and much looks
/// like a delay.
#[divan::bench(sample_count = 1, sample_size = 1)]
fn explain_three_blunt_hours(bencher: Bencher<'_, '_>) {
    let mut fine = problem(LONG * FINER, View::Sensor, &[]);
    let step_s = 0.1 / FINER as f64;
    fine.drive.t_s = (0..LONG * FINER).map(|row| row as f64 * step_s).collect();
    // Steps of a reading's rows, each held over the finer ones.
    let coarse = drive(LONG, 0.1).reference;
    let mut now = coarse[0];
    fine.drive.reference = (0..LONG * FINER)
        .map(|row| {
            now += (coarse[row / FINER] - now) * (1.0 - (-step_s / BLUNT_S).exp());
            now
        })
        .collect();
    fine.observed = Observed::with_drive(fine.drive.t_s.clone(), vec![0.0; LONG * FINER]);
    let seen = twin::explain::predict(&fine, &owned(LONG_EFFECTS));
    let mut problem = problem(LONG, View::Sensor, &[]);
    let mut random = ChaCha8Rng::seed_from_u64(2);
    problem.drive.reference = fine
        .drive
        .reference
        .iter()
        .copied()
        .step_by(FINER)
        .collect();
    problem.drive.range_high = Some(range_high(&problem.drive.reference));
    problem.observed.value = seen
        .into_iter()
        .step_by(FINER)
        .map(|value| value + problem.noise * noise(&mut random))
        .collect();
    explain_all(bencher, &problem);
}

#[divan::bench(args = ["dual range", "dual range, with charge", "closed loop"], sample_count = 5, sample_size = 1)]
fn simulate_board(bencher: Bencher<'_, '_>, name: &str) {
    // A current frame each 10 ms.
    let drive = drive(SIMULATED, 0.01);
    let observed = Observed::with_drive(drive.t_s.clone(), vec![f64::NAN; SIMULATED]);
    let kind = if name.starts_with("dual") {
        FrontEndKind::DualRange
    } else {
        FrontEndKind::ClosedLoop
    };
    let board = Board::new(kind, 1).unwrap();
    bencher.counter(ItemsCount::new(SIMULATED)).bench_local(|| {
        board.run(
            black_box(&drive),
            false,
            &observed,
            Pace::Seen,
            name.ends_with("charge"),
        )
    });
}
