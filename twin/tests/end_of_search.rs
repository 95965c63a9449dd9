//! What a recording is too short, or a model file too generous, to tell.

use crate::common::{noise, prepared, said, sensor};
use twin::report::data::Verdict;

/// Two hours of a cell whose polarisation takes eleven: the search ends at three times the recording.
#[test]
fn a_time_at_the_end_of_the_search_is_that_or_more() {
    const ROWS: usize = 7200;
    let (r_ohm, tau_s) = (0.2, 40_000.0_f64);
    let ocv = |soc: f64| 3.0 + 1.1 * soc;
    let mut load_a = noise(1, 1.2);
    let mut reads_v = noise(2, 0.001);
    let (mut charge_c, mut current_a, mut polarised_v) = (0.0, 0.6, 0.0);
    let mut text = "t_s,i_ref_a,v_cell_v\n".to_owned();
    for second in 0..ROWS {
        let before_a = current_a;
        if second % 20 == 0 {
            current_a = 0.6 + load_a();
        }
        if second > 0 {
            let mean_a = 0.5 * (before_a + current_a);
            charge_c += mean_a;
            polarised_v += (r_ohm * mean_a - polarised_v) * (1.0 - (-1.0 / tau_s).exp());
        }
        let volts = ocv(0.9 - charge_c / 3600.0 / 3.0) - 0.03 * current_a - polarised_v;
        text.push_str(&format!("{second},{current_a},{:.5}\n", volts + reads_v()));
    }
    let model = "schema = 1\n[battery]\ncapacity_ah = 3\ninitial_soc = 0.9\nohmic_resistance_ohm = 0.03\n\
                 ocv = [[0, 3.0], [1, 4.1]]\nnoise_v = 0.001\n";
    let mut prepared = prepared(&text, model);
    let report = said(prepared.items.remove(0).problem, 1, &[]);
    let ids: Vec<&str> = report.effects.iter().map(|one| one.id.as_str()).collect();
    assert_eq!(ids, ["polarisation"], "{report:?}");
    assert_eq!(report.verdict, Verdict::Ambiguous, "{report:?}");
    let stands = |remark: &String| remark.contains("stands at the end of what is searched");
    assert!(report.remarks.iter().any(stands), "{:?}", report.remarks);
}

#[test]
fn a_noise_that_the_readings_cannot_have_is_said_to_be_none() {
    let mut load_a = noise(3, 60.0);
    let mut reads_a = noise(4, 0.35);
    let (t_s, currents): (Vec<f64>, Vec<f64>) = (0..3000)
        .map(|row| (0.1 * f64::from(row), load_a()))
        .unzip();
    let readings: Vec<f64> = currents.iter().map(|current| current + reads_a()).collect();
    for (stated_a, is_said) in [(350.0, true), (1.0, true), (0.35, false), (0.5, false)] {
        let problem = sensor(t_s.clone(), currents.clone(), readings.clone(), stated_a);
        let report = said(problem, 1, &[]);
        assert_eq!(
            report.verdict,
            Verdict::NoMismatch,
            "{stated_a}: {report:?}"
        );
        let remarks = report.remarks.iter();
        let found = remarks.filter(|remark| remark.contains("stated too large"));
        assert_eq!(found.count(), usize::from(is_said), "{stated_a}");
    }
}
