//! What is wrong with the board's own sensors, told in words: `large.gain=1.01`. The firmware is not told.

use anyhow::{Result, anyhow, ensure};
use plant::front_end::Sensors;
use plant::hall::HallSensorConfig;
use serde_json::Value;

/// Changes one parameter of a sensor, or of both: `SENSOR.PARAMETER=VALUE`, where the sensor is `small`, `large` or `both` and
/// the parameter one of [`HallSensorConfig`]'s numbers; those of its parts follow a dot, such as `small.core.remanence_a=0.4`.
///
/// # Errors
/// If that is not what `text` is.
pub fn change(sensors: &mut Sensors, text: &str) -> Result<()> {
    let wrong = |found: &str, expected: &str| {
        anyhow!("--sensor {text}: found {found}, expected {expected}")
    };
    let (name, value) = text
        .split_once('=')
        .ok_or_else(|| wrong("no =", "SENSOR.PARAMETER=VALUE"))?;
    let (sensor, path) = name
        .split_once('.')
        .ok_or_else(|| wrong("no parameter", "one such as large.gain"))?;
    let value: f64 = value
        .trim()
        .parse()
        .ok()
        .filter(|value: &f64| value.is_finite())
        .ok_or_else(|| wrong(&format!("the value {value:?}"), "a number"))?;
    let Sensors::DualRange { small, large } = sensors else {
        return Err(wrong("a board with one sensor", "the dual-range board"));
    };
    let meant: Vec<&mut HallSensorConfig> = match sensor {
        "small" => vec![small],
        "large" => vec![large],
        "both" => vec![small, large],
        other => {
            return Err(wrong(
                &format!("the sensor {other:?}"),
                "small, large or both",
            ));
        }
    };
    for config in meant {
        *config = with(config, path, value).map_err(|names| {
            wrong(
                &format!("the parameter {path:?}"),
                &format!("one of {}", names.join(", ")),
            )
        })?;
        ensure!(
            config.gain > 0.0 && config.tau_s >= 0.0,
            "--sensor {text}: a gain is above 0 and a time constant not below it"
        );
    }
    Ok(())
}

/// `config` with one of its numbers changed; else the names of all of them.
fn with(
    config: &HallSensorConfig,
    path: &str,
    value: f64,
) -> std::result::Result<HallSensorConfig, Vec<String>> {
    let mut tree = serde_json::to_value(config).unwrap_or_default();
    let mut names = Vec::new();
    leaves(&tree, "", &mut names);
    if !names.iter().any(|name| name == path) {
        return Err(names);
    }
    let pointer = format!("/{}", path.replace('.', "/"));
    if let Some(leaf) = tree.pointer_mut(&pointer) {
        *leaf = Value::from(value);
    }
    without_nulls(&mut tree);
    serde_json::from_value(tree).map_err(|_| names)
}

/// Numbers by the way to them. A seed is none: it is the command line's.
fn leaves(tree: &Value, before: &str, names: &mut Vec<String>) {
    let Value::Object(members) = tree else {
        // JSON has no infinity: a core's knee that is not there.
        if tree.is_f64() || tree.is_null() {
            names.push(before.to_owned());
        }
        return;
    };
    for (name, member) in members {
        let dot = if before.is_empty() { "" } else { "." };
        leaves(member, &format!("{before}{dot}{name}"), names);
    }
}

/// Takes out what is at its default, infinity.
fn without_nulls(tree: &mut Value) {
    if let Value::Object(members) = tree {
        members.retain(|_, member| !member.is_null());
        members.values_mut().for_each(without_nulls);
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::panic)]
mod tests {
    use super::*;

    fn pair(text: &str) -> Result<(HallSensorConfig, HallSensorConfig)> {
        let mut sensors = Sensors::default();
        change(&mut sensors, text)?;
        match sensors {
            Sensors::DualRange { small, large } => Ok((small, large)),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn only_what_is_named_changes() {
        let (nominal_small, nominal_large) = (
            HallSensorConfig::dual_range_small(),
            HallSensorConfig::dual_range_large(),
        );
        let (small, large) = pair("large.gain=1.02").unwrap();
        assert_eq!(small, nominal_small);
        assert_eq!(
            large,
            HallSensorConfig {
                gain: 1.02,
                ..nominal_large
            }
        );
        let (small, large) = pair("both.core.remanence_a=-0.25").unwrap();
        assert_eq!(small.core.remanence_a, -0.25);
        assert_eq!(small.core.knee_a, f64::INFINITY);
        assert_eq!(large.core.remanence_a, -0.25);
        assert_eq!(
            pair("small.core.knee_a=50").unwrap().0.core.knee_a,
            50.0,
            "what was infinite can be set"
        );
    }

    #[test]
    fn what_is_wrong_says_what_was_expected() {
        for (text, says) in [
            ("large.gain", "SENSOR.PARAMETER=VALUE"),
            ("gain=1.1", "large.gain"),
            ("middle.gain=1.1", "small, large or both"),
            ("large.gain=much", "a number"),
            ("large.gains=1.1", "tau_s"),
            ("large.noise.seed=3", "noise.rms_v"),
            ("large.gain=0", "above 0"),
        ] {
            let error = pair(text).unwrap_err().to_string();
            assert!(error.contains(text) && error.contains(says), "{error}");
        }
    }
}
