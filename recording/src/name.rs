//! The columns that the project's tools know, and the units that a column's name ends in.

/// Time, non-decreasing, steps may differ.
pub const T_S: &str = "t_s";
/// Number of the operation that a row belongs to; where it changes, time may start anew.
pub const CYCLE: &str = "cycle";

/// A column that has a fixed meaning.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Canonical {
    /// Its name.
    pub name: &'static str,
    /// What it holds.
    pub meaning: &'static str,
}

/// Every column with a fixed meaning. Positive current and power flow out of the battery: discharge.
pub const CANONICAL: [Canonical; 18] = [
    canonical(T_S, "time"),
    canonical("i_ref_a", "trusted reference current"),
    canonical("i_meas_a", "current of the sensor under test"),
    canonical("q_meas_c", "charge counter of the sensor under test"),
    canonical(
        "range_high",
        "the sensor measures with its large range (0 or 1)",
    ),
    canonical("v_supply_v", "supply of the sensor"),
    canonical("temp_sensor_c", "temperature of the sensor"),
    canonical("i_aux_a", "current in a neighbouring conductor"),
    canonical("v_cell_v", "voltage of a cell"),
    canonical("v_pack_v", "voltage of the pack"),
    canonical("temp_cell_c", "temperature of a cell"),
    canonical("temp_ambient_c", "temperature of the surroundings"),
    canonical("soc_pct", "state of charge"),
    canonical("ah_meas_ah", "charge counter as its instrument reports it"),
    canonical("p_ref_w", "trusted reference power"),
    canonical("p_meas_w", "power of the sensor under test"),
    canonical("step", "number of the step of the test programme"),
    canonical(
        CYCLE,
        "number of the operation; where it changes, time may start anew",
    ),
];

const fn canonical(name: &'static str, meaning: &'static str) -> Canonical {
    Canonical { name, meaning }
}

/// The fixed meaning of a column, if it has one.
pub fn meaning(name: &str) -> Option<&'static str> {
    CANONICAL
        .iter()
        .find(|known| known.name == name)
        .map(|known| known.meaning)
}

/// Endings of names and what they stand for. Longer ones first: the first that fits counts.
const ENDINGS: [(&str, &str); 18] = [
    ("_a_per_m", "A/m"),
    ("_pct", "%"),
    ("_ohm", "Ω"),
    ("_deg", "°"),
    ("_ppm", "ppm"),
    ("_min", "min"),
    ("_as", "A·s"),
    ("_ah", "Ah"),
    ("_wh", "Wh"),
    ("_hz", "Hz"),
    ("_a", "A"),
    ("_v", "V"),
    ("_w", "W"),
    ("_s", "s"),
    ("_j", "J"),
    ("_k", "K"),
    ("_t", "T"),
    ("_h", "h"),
];

/// The unit that a column's name ends in; `None` for a plain number such as `step` or `range_high`.
///
/// `_c` is °C unless the signal is a charge, `q_…_c`: then it is coulomb.
pub fn unit(name: &str) -> Option<&'static str> {
    if name.ends_with("_c") {
        return Some(if name.starts_with("q_") { "C" } else { "°C" });
    }
    ENDINGS
        .iter()
        .find(|(ending, _)| name.len() > ending.len() && name.ends_with(ending))
        .map(|&(_, unit)| unit)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_of_the_known_columns() {
        let units: Vec<_> = CANONICAL.iter().map(|known| unit(known.name)).collect();
        let expected = [
            Some("s"),
            Some("A"),
            Some("A"),
            Some("C"),
            None,
            Some("V"),
            Some("°C"),
            Some("A"),
            Some("V"),
            Some("V"),
            Some("°C"),
            Some("°C"),
            Some("%"),
            Some("Ah"),
            Some("W"),
            Some("W"),
            None,
            None,
        ];
        assert_eq!(units, expected);
        assert_eq!(unit("h_a_per_m"), Some("A/m"));
        assert_eq!(unit("_a"), None);
        assert!(meaning(CYCLE).is_some());
        assert!(meaning("i_load_a").is_none());
    }
}
