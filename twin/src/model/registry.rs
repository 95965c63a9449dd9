//! The effects that a model file may hold, and the names of their parameters.

/// Ids and parameters of the library, and whether the effect acts on the battery.
const TABLE: [(&str, &[&str], bool); 30] = [
    ("offset", &["offset_a"], false),
    ("gain", &["gain"], false),
    ("offset-temperature", &["tc_a_per_k"], false),
    ("gain-temperature", &["tc_per_k"], false),
    ("supply-ratiometric", &["ratio"], false),
    ("core-hysteresis", &["remanence_a", "coercivity_a"], false),
    ("core-saturation", &["knee_a", "softness"], false),
    ("clipping", &["high_a", "low_a"], false),
    ("lag", &["tau_s"], false),
    ("moving-average", &["window_s"], false),
    ("delay", &["delay_s"], false),
    ("clock-skew", &["skew_ppm"], false),
    ("hum", &["frequency_hz", "amplitude_a"], false),
    ("quantisation", &["step_a"], false),
    ("dead-band", &["threshold_a"], false),
    ("range-handover", &["tau_s"], false),
    ("range-mismatch", &["gain_ratio", "offset_a"], false),
    ("sensor-self-heating", &["tc_per_a2", "tau_s"], false),
    ("stray-field", &["coupling"], false),
    ("sampled-window", &["period_s", "duty"], false),
    ("coulombic-efficiency", &["efficiency"], true),
    ("parasitic-load", &["load_a"], true),
    ("capacity", &["capacity_ah"], true),
    (
        "polarisation",
        &["r1_ohm", "tau1_s", "r2_ohm", "tau2_s", "r3_ohm", "tau3_s"],
        true,
    ),
    ("diffusion", &["r_ohm", "tau_s"], true),
    ("ocv-hysteresis", &["m_v", "gamma"], true),
    ("resistance-temperature", &["b_k"], true),
    ("resistance-soc", &["rise", "knee_soc"], true),
    ("cell-self-heating", &["rth_k_per_w", "tau_s"], true),
    ("entropic", &["v_per_k"], true),
];

/// An effect's id, and the sets of parameters that it comes with (polarisation has one, two or three branches).
pub fn find(id: &str) -> Option<(&'static str, Vec<Vec<&'static str>>)> {
    let (id, names, _) = TABLE.iter().find(|(known, _, _)| *known == id)?;
    let variants = if *id == "polarisation" {
        [2, 4, 6].map(|count| names[..count].to_vec()).to_vec()
    } else {
        vec![names.to_vec()]
    };
    Some((id, variants))
}

/// Ids in the order of the documentation.
pub fn ids() -> Vec<&'static str> {
    TABLE.iter().map(|(id, _, _)| *id).collect()
}

/// Whether it acts on the battery and not on the sensing chain.
pub fn of_battery(id: &str) -> bool {
    TABLE.iter().any(|(known, _, battery)| *known == id && *battery)
}
