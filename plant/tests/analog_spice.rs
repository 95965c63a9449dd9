//! The circuits against ngspice. Values and inputs are read from the netlists, so each is written down once.
//!
//! Without ngspice on the machine these tests say so and do nothing.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::collections::HashMap;
use std::io::ErrorKind;
use std::process::Command;

use plant::comparator::ComparatorConfig;
use plant::filter::{LowPass, LowPassConfig, SecondOrder};
use plant::front_end::{Conditions, Faults, FrontEnd, FrontEndConfig, SensorFault, Sensors};
use plant::hall::HallSensorConfig;
use plant::network::NetworkConfig;
use plant::stretch::{Linear, Stretch};

/// A number with SPICE's suffix.
fn number(text: &str) -> f64 {
    let scale = match text.chars().last() {
        Some('k') => 1e3,
        Some('m') => 1e-3,
        Some('u') => 1e-6,
        Some('n') => 1e-9,
        _ => return text.parse().unwrap(),
    };
    text[..text.len() - 1].parse::<f64>().unwrap() * scale
}

struct Netlist {
    parameters: HashMap<String, f64>,
    /// The piecewise linear source: time in s, volts.
    input: Vec<(f64, f64)>,
    measured: HashMap<String, f64>,
}

impl Netlist {
    /// Runs `plant/spice/<name>`; `None` without ngspice.
    fn run(name: &str) -> Option<Self> {
        let path = format!("{}/spice/{name}", env!("CARGO_MANIFEST_DIR"));
        let output = match Command::new("ngspice").args(["-b", &path]).output() {
            Err(error) if error.kind() == ErrorKind::NotFound => {
                println!("ngspice is not installed: {name} is not compared");
                return None;
            }
            output => output.unwrap(),
        };
        let text = std::fs::read_to_string(&path).unwrap();
        let parameters = text
            .lines()
            .filter_map(|line| line.strip_prefix(".param "))
            .flat_map(str::split_whitespace)
            .map(|pair| pair.split_once('=').unwrap())
            .map(|(name, value)| (name.to_owned(), number(value)))
            .collect();
        let points: Vec<f64> = text
            .split_once("PWL(")
            .and_then(|(_, rest)| rest.split_once(')'))
            .unwrap()
            .0
            .split_whitespace()
            .map(number)
            .collect();
        let printed = String::from_utf8_lossy(&output.stdout).into_owned();
        let measured: HashMap<String, f64> = printed
            .split_once("Measurements for Transient Analysis")
            .unwrap_or_else(|| panic!("{printed}{}", String::from_utf8_lossy(&output.stderr)))
            .1
            .lines()
            .filter_map(|line| line.split_once('='))
            .filter_map(|(name, value)| {
                let value = value.split_whitespace().next()?.parse().ok()?;
                Some((name.trim().to_owned(), value))
            })
            .collect();
        Some(Self {
            parameters,
            input: points.chunks(2).map(|pair| (pair[0], pair[1])).collect(),
            measured,
        })
    }

    fn at(&self, time_s: f64) -> f64 {
        let after = self.input.partition_point(|point| point.0 <= time_s);
        if after == self.input.len() {
            return self.input[after - 1].1;
        }
        let (from, to) = (self.input[after - 1], self.input[after]);
        from.1 + (to.1 - from.1) * (time_s - from.0) / (to.0 - from.0)
    }

    /// The times at which the input has a corner, up to `end_s`, and `end_s`.
    fn corners(&self, end_s: f64) -> Vec<f64> {
        let corners = self.input.iter().map(|point| point.0);
        corners
            .filter(|time_s| *time_s > 0.0 && *time_s < end_s)
            .chain([end_s])
            .collect()
    }

    fn close(&self, name: &str, ours: f64, within: f64) {
        let theirs = self.measured[name];
        assert!(
            (ours - theirs).abs() <= within,
            "{name}: {ours}, ngspice {theirs}"
        );
    }
}

#[test]
fn sallen_key_and_rc() {
    let Some(spice) = Netlist::run("sallen_key_rc.cir") else {
        return;
    };
    let p = &spice.parameters;
    let second_order = Some(SecondOrder::sallen_key(
        p["r55"], p["r56"], p["c44"], p["c45"],
    ));
    let response = |rc_tau_s: f64, end_s: f64| {
        let mut filter = LowPass::new(&LowPassConfig {
            second_order,
            rc_tau_s,
        });
        let mut state = LowPass::settled(spice.at(0.0));
        let (mut now_s, mut integral_vs) = (0.0, 0.0);
        for at_s in spice.corners(end_s) {
            let input = Linear {
                start: spice.at(now_s),
                end: spice.at(at_s),
            };
            let (new, line) = filter.step(at_s - now_s, &state, input);
            integral_vs += line.mean() * (at_s - now_s);
            (state, now_s) = (new, at_s);
        }
        (filter.output(&state), integral_vs)
    };
    let rc_tau_s = p["r58"] * p["c46"];
    for (name, at_s) in [
        ("at_200u", 200e-6),
        ("at_300u", 300e-6),
        ("at_500u", 500e-6),
        ("at_900u", 900e-6),
        ("at_1200u", 1.2e-3),
        ("at_3500u", 3.5e-3),
    ] {
        spice.close(name, response(rc_tau_s, at_s).0, 20e-6);
    }
    spice.close("amp_at_200u", response(0.0, 200e-6).0, 20e-6);
    spice.close("integral", response(rc_tau_s, 3.5e-3).1, 20e-9);
}

#[test]
fn open_sensor_network() {
    let Some(spice) = Netlist::run("open_sensor_network.cir") else {
        return;
    };
    let p = &spice.parameters;
    let network = NetworkConfig {
        r1_ohm: p["r1"],
        r2_ohm: p["r2"],
        r3_ohm: p["r3"],
        r4_ohm: p["r4"],
        pull_down_ohm: p["r67"],
        negative_supply_v: p["vneg"],
        reference_v: p["vref"],
        c3_f: p["c3"],
        ..NetworkConfig::default()
    };
    let config = FrontEndConfig {
        network,
        ..FrontEndConfig::network()
    };
    // The Hall output as forced by the netlist's source.
    let volts_per_amp = 4.0 / 500.0;
    let conditions = |volts: f64| Conditions {
        current_a: volts / volts_per_amp,
        ..Conditions::default()
    };
    let mut sensor = HallSensorConfig::bipolar();
    (sensor.low_a, sensor.high_a) = (-1e3, 1e3);
    let connected = |end_s: f64| {
        let config = FrontEndConfig {
            sensors: Sensors::Network(sensor),
            ..config
        };
        let mut front_end = FrontEnd::new(config, 0.0, conditions(spice.at(0.0)));
        for at_s in spice.corners(end_s) {
            front_end.advance(at_s, &conditions(spice.at(at_s)), |_| ());
        }
        front_end.network_v()
    };
    spice.close("zero", connected(90e-6), 1e-6);
    spice.close("rising", connected(120e-6), 50e-6);
    spice.close("plus_4", connected(590e-6), 1e-6);
    spice.close("minus_5", connected(990e-6), 1e-6);

    let faulty = |network: NetworkConfig, small: SensorFault| {
        let config = FrontEndConfig { network, ..config };
        let mut front_end = FrontEnd::new(config, 0.0, conditions(0.0));
        front_end.set_faults(Faults {
            small,
            ..Faults::default()
        });
        front_end.advance(0.01, &conditions(0.0), |_| ());
        front_end.network_v()
    };
    spice.close("open_pin", faulty(network, SensorFault::Open), 2e-6);
    let without = NetworkConfig {
        pull_down_ohm: f64::INFINITY,
        ..network
    };
    spice.close("without_pin", faulty(without, SensorFault::Open), 2e-6);

    // A single sensor with 10 kΩ inside: its follower is at the node.
    let mut loaded = FrontEndConfig {
        network,
        ..FrontEndConfig::hah1bv()
    };
    if let Sensors::Hah1bv(sensor) = &mut loaded.sensors {
        sensor.output_ohm = 10e3;
    }
    let front_end = FrontEnd::new(loaded, 0.0, Conditions::default());
    spice.close("loaded_node", front_end.small_follower_v(), 2e-6);
}

#[test]
fn comparators_with_hysteresis() {
    let Some(spice) = Netlist::run("comparators.cir") else {
        return;
    };
    let p = &spice.parameters;
    let config = FrontEndConfig {
        sensors: Sensors::DualRange {
            small: HallSensorConfig::ratiometric(2.5, 2.25, p["full"]),
            large: HallSensorConfig::dual_range_large(),
        },
        comparators: ComparatorConfig {
            high_v: p["high"],
            low_v: p["low"],
            hysteresis_v: p["hysteresis"],
            ..ComparatorConfig::default()
        },
        ..FrontEndConfig::default()
    };
    let at = |current_a| Conditions {
        current_a,
        ..Conditions::default()
    };
    let mut front_end = FrontEnd::new(config, 0.0, at(spice.at(0.0)));
    let mut edges_s = Vec::new();
    let mut flag = false;
    for at_s in spice.corners(22e-3) {
        front_end.advance(at_s, &at(spice.at(at_s)), |stretch: &Stretch| {
            if stretch.range_high != flag {
                flag = stretch.range_high;
                edges_s.push(stretch.start_s);
            }
        });
    }
    assert_eq!(edges_s.len(), 4);
    // ngspice finds a switch at its next time step.
    for (name, edge_s) in ["rise1", "fall1", "rise2", "fall2"].iter().zip(edges_s) {
        spice.close(name, edge_s, 0.5e-6);
    }
}
