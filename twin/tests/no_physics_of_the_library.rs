//! What no effect of the library is gets no name, though one of them may take most of the mismatch. Where the design states no noise, what
//! the readings change by from one to the next has to tell how much of it is left.

use crate::common::{noise, prepared, said, sensor, steps};
use twin::report::data::{Report, Verdict};

/// What is said of a state of charge in steps of half a per cent over 2000 s around a usual current that is off by so many
/// points, by the second and the current. The capacity is right.
fn state_of_charge(seed: u64, usual_a: f64, off_points: impl Fn(u32, f64) -> f64) -> Report {
    let (capacity_ah, initial_soc) = (60.0, 0.9);
    let mut load_a = noise(seed, 25.0);
    let (mut charge_c, mut current_a) = (0.0, 30.0);
    let mut text = "t_s,i_ref_a,soc_pct\n".to_owned();
    for second in 0..2000 {
        let before_a = current_a;
        if second % 20 == 0 {
            current_a = usual_a + load_a();
        }
        charge_c += 0.5 * (before_a + current_a);
        let soc_pct =
            100.0 * (initial_soc - charge_c / 3600.0 / capacity_ah) + off_points(second, current_a);
        text.push_str(&format!(
            "{second},{current_a},{}\n",
            (2.0 * soc_pct).round() / 2.0
        ));
    }
    let model = format!(
        "schema = 1\n[battery]\ncapacity_ah = {capacity_ah}\ninitial_soc = {initial_soc}\n"
    );
    let mut prepared = prepared(&text, &model);
    said(prepared.items.remove(0).problem, seed, &[])
}

#[test]
fn a_state_of_charge_that_is_corrected_once_is_no_capacity() {
    for (points, seed) in [(10.0, 1), (7.0, 2), (-5.0, 3), (-8.0, 4)] {
        let corrected = |second, _| if second < 1200 { 0.0 } else { points };
        let report = state_of_charge(seed, 30.0, corrected);
        assert_eq!(report.verdict, Verdict::Unknown, "{points}: {report:?}");
        let form = report.unexplained[0].form.as_ref();
        let form = form.unwrap_or_else(|| panic!("{points}: {:?}", report.unexplained));
        assert_eq!(form.id, "step", "{form:?}");
        let step = form.description.split(" until 1200.0 s, ").nth(1);
        let step = step.and_then(|step| step.split(' ').next());
        let step: f64 = step.unwrap().replace('−', "-").parse().unwrap();
        assert!((step - points).abs() < 0.1, "{points}: {form:?}");
    }
}

/// It reads the load's drop of the voltage as charge.
#[test]
fn a_state_of_charge_that_falls_with_the_load_is_told_by_the_current() {
    let report = state_of_charge(5, 10.0, |_, current_a| -0.05 * current_a);
    assert_eq!(report.verdict, Verdict::Unknown, "{report:?}");
    let form = report.unexplained[0].form.as_ref().expect("a form");
    assert_eq!(form.id, "follows", "{form:?}");
    assert!(form.description.starts_with("−0.05"), "{form:?}");
    assert!(form.description.ends_with(" % per A of i"), "{form:?}");
}

/// A counter that counts less of what is charged than of what is drawn.
#[test]
fn a_counter_that_counts_one_direction_otherwise_is_told_so() {
    let mut load_a = noise(6, 40.0);
    let mut noise_c = noise(7, 0.1);
    let (mut counted_c, mut current_a) = (0.0, 0.0);
    let mut text = "t_s,i_ref_a,q_meas_c\n".to_owned();
    for second in 0..2000 {
        let before_a: f64 = current_a;
        if second % 20 == 0 {
            current_a = load_a();
        }
        let mean_a = 0.5 * (before_a + current_a);
        counted_c += mean_a * if mean_a < 0.0 { 0.96 } else { 1.0 };
        let read_c = counted_c + noise_c();
        text.push_str(&format!("{second},{current_a},{read_c:.4}\n"));
    }
    let mut prepared = prepared(&text, "schema = 1\n[sensor]\n[charge]\nnoise_c = 0.1\n");
    let report = said(prepared.items.remove(0).problem, 5, &[]);
    assert_eq!(report.verdict, Verdict::Unknown, "{report:?}");
    let form = report.unexplained[0].form.as_ref().expect("a form");
    assert_eq!(form.id, "direction", "{form:?}");
    assert!(
        form.description.ends_with("−4.00 % of i where i < 0"),
        "{form:?}"
    );
}

#[test]
fn a_dead_sensor_is_clipped_by_nothing() {
    for (seed, stated_a) in [(1, 0.15), (2, 0.0), (3, 0.15), (4, 0.0)] {
        let mut reads_a = noise(seed + 100, 0.15);
        let (t_s, currents) = steps(seed, 60.0, 2000, 10);
        let readings = currents.iter().map(|_| 0.05 + reads_a()).collect();
        let report = said(sensor(t_s, currents, readings, stated_a), seed, &[]);
        assert_eq!(report.verdict, Verdict::Unknown, "{seed}: {report:?}");
    }
}

#[test]
fn what_is_left_of_another_physics_is_told_by_its_form() {
    type Reads = fn(f64, f64) -> f64;
    let cases: [(&str, Reads); 3] = [
        ("square", |_, i| i + 4e-4 * i * i),
        (
            "slope-step",
            |t_s, i| if t_s < 120.0 { i } else { 0.97 * i },
        ),
        ("direction", |_, i| if i > 0.0 { i } else { 1.03 * i }),
    ];
    for (id, reads) in cases {
        let mut noise_a = noise(5, 0.15);
        let (t_s, currents) = steps(5, 60.0, 3000, 10);
        let readings = t_s.iter().zip(&currents);
        let readings = readings.map(|(t_s, i)| reads(*t_s, *i) + noise_a());
        let readings = readings.collect();
        let report = said(sensor(t_s, currents, readings, 0.15), 5, &[]);
        assert_eq!(report.verdict, Verdict::Unknown, "{id}: {}", report.summary);
        let form = report.unexplained[0].form.as_ref();
        let form = form.unwrap_or_else(|| panic!("{id}: {:?}", report.unexplained));
        assert_eq!(form.id, id, "{form:?}");
        assert!((form.rmse - 0.15).abs() < 0.01, "{form:?}");
        assert!(report.summary.contains(&form.said()), "{}", report.summary);
    }
}
