//! From the current in the conductor to the nodes that the converters and the MCU are connected to.
//!
//! ```text
//! small or only sensor ─┬─ follower ─┬─ comparators ─ OR ─┬─ range flag
//!                       │            └─ low-pass ─┐       │ control
//!                       └─ network (D3) ─ ADC1    ├─ switch ─┬─ ADS1100
//! large sensor ──────────── follower ─ low-pass ──┘          └─ (V − level) · 2/9 ─ V1 of the ADE7753
//! ```
//!
//! With one sensor the switch always passes it, and nothing moves the range flag but a fault. D3's bipolar sensor cannot
//! pass the switch: there the network's output is the signal, and its output at 0 V of Hall voltage the level.
//!
//! Not in here: what happens within a step to signals that are not straight lines, beyond their mean and their end. A
//! lagged sensor that crosses a threshold twice within one step is not seen to do so.

use serde::{Deserialize, Serialize};

use crate::analog_switch::{AnalogSwitch, AnalogSwitchConfig};
use crate::comparator::{ComparatorConfig, Comparators, GateOverride};
use crate::filter::{LowPass, LowPassConfig, LowPassState};
use crate::hall::{HallSensor, HallSensorConfig, HallState, Noise, SensorInput};
use crate::network::{Network, NetworkConfig};
use crate::stretch::{Linear, Stretch};

/// The world around the sensors at a point in time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Conditions {
    /// Current through the conductor, in A; positive = discharge.
    pub current_a: f64,
    /// Temperature of the sensors, in °C.
    pub sensor_temperature_c: f64,
    /// Supply of the sensors and their followers, in V.
    pub sensor_supply_v: f64,
    /// Supply and so reference of the ADS1100, in V.
    pub converter_supply_v: f64,
    /// Current through a neighbouring conductor, in A.
    pub aux_current_a: f64,
    /// Shift of every sensor's output against the board's ground, in V: low-voltage loads with the key in ACC (D4).
    pub output_shift_v: f64,
}

impl Default for Conditions {
    /// 0 A, 25 °C, 5 V.
    fn default() -> Self {
        Self {
            current_a: 0.0,
            sensor_temperature_c: 25.0,
            sensor_supply_v: 5.0,
            converter_supply_v: 5.0,
            aux_current_a: 0.0,
            output_shift_v: 0.0,
        }
    }
}

impl Conditions {
    /// On the way to `end`, after `fraction` of it.
    fn towards(&self, end: &Self, fraction: f64) -> Self {
        let at = |a: f64, b: f64| a + (b - a) * fraction;
        Self {
            current_a: at(self.current_a, end.current_a),
            sensor_temperature_c: at(self.sensor_temperature_c, end.sensor_temperature_c),
            sensor_supply_v: at(self.sensor_supply_v, end.sensor_supply_v),
            converter_supply_v: at(self.converter_supply_v, end.converter_supply_v),
            aux_current_a: at(self.aux_current_a, end.aux_current_a),
            output_shift_v: at(self.output_shift_v, end.output_shift_v),
        }
    }

    const fn sensor(&self) -> SensorInput {
        SensorInput {
            current_a: self.current_a,
            aux_current_a: self.aux_current_a,
            temperature_c: self.sensor_temperature_c,
            supply_v: self.sensor_supply_v,
        }
    }
}

/// The sensors that are fitted: one variant for each front end of the measuring logic.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[expect(clippy::large_enum_variant, reason = "there is one of these")]
pub enum Sensors {
    /// D0: small and large sensor, comparators, switch.
    DualRange {
        /// ±60 A.
        small: HallSensorConfig,
        /// ±600 A.
        large: HallSensorConfig,
    },
    /// D2: one HAH1BV.
    Hah1bv(HallSensorConfig),
    /// D3: one bipolar sensor, read through the network.
    Network(HallSensorConfig),
    /// D4: one closed-loop sensor.
    ClosedLoop(HallSensorConfig),
}

impl Default for Sensors {
    /// D0.
    fn default() -> Self {
        Self::DualRange {
            small: HallSensorConfig::dual_range_small(),
            large: HallSensorConfig::dual_range_large(),
        }
    }
}

/// Where the low-pass of D1 stands.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum FilterPlace {
    /// One for each sensor, in front of the switch.
    #[default]
    BeforeSwitch,
    /// One behind the switch: it holds the old range's level at each edge.
    BehindSwitch,
}

/// The analogue side of the board. Default: D0, nominal.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FrontEndConfig {
    /// Sensors.
    pub sensors: Sensors,
    /// D3's network, at the small or only sensor.
    pub network: NetworkConfig,
    /// Comparators on the small sensor.
    pub comparators: ComparatorConfig,
    /// The analog switch.
    pub switch: AnalogSwitchConfig,
    /// D1's low-pass.
    pub filter: LowPassConfig,
    /// Where it stands.
    pub filter_place: FilterPlace,
    /// V1 of the meter per volt of signal: 2/9 makes ±0.5 V of ±2.25 V.
    pub meter_scale: f64,
}

impl Default for FrontEndConfig {
    fn default() -> Self {
        Self {
            sensors: Sensors::default(),
            network: NetworkConfig::default(),
            comparators: ComparatorConfig::default(),
            switch: AnalogSwitchConfig::default(),
            filter: LowPassConfig::default(),
            filter_place: FilterPlace::default(),
            meter_scale: 2.0 / 9.0,
        }
    }
}

impl FrontEndConfig {
    /// D0, nominal.
    pub fn dual_range() -> Self {
        Self::default()
    }

    /// D2, nominal.
    pub fn hah1bv() -> Self {
        Self::with(Sensors::Hah1bv(HallSensorConfig::hah1bv()))
    }

    /// D3, nominal.
    pub fn network() -> Self {
        Self::with(Sensors::Network(HallSensorConfig::bipolar()))
    }

    /// D4, nominal.
    pub fn closed_loop() -> Self {
        Self::with(Sensors::ClosedLoop(HallSensorConfig::closed_loop()))
    }

    fn with(sensors: Sensors) -> Self {
        Self {
            sensors,
            ..Self::default()
        }
    }
}

/// What can be wrong with a sensor's output (fault F14).
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub enum SensorFault {
    /// Nothing.
    #[default]
    None,
    /// The wire is open. The network pulls the small or only sensor's node to −6.7 V; the large sensor's, where no
    /// network is, leaks to ground.
    Open,
    /// The output is forced, in V.
    Forced(f64),
    /// The wire is open and something else is connected: a divider, a leak.
    Divider {
        /// Its voltage without load, in V.
        volts: f64,
        /// Its resistance, in Ω.
        ohms: f64,
    },
}

/// Faults that are present.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Faults {
    /// Of the small or only sensor.
    pub small: SensorFault,
    /// Of the large sensor.
    pub large: SensorFault,
    /// Stands in for the output of the OR gate, and so moves switch and flag (F9).
    pub gate: GateOverride,
    /// The range flag's line to the MCU is stuck, while the switch follows the gate (F10).
    pub flag_line: Option<bool>,
}

/// One sensor with the node behind it.
#[derive(Clone, Debug)]
struct Path {
    sensor: HallSensor,
    state: HallState,
    noise: Noise,
    /// Noise in this call of `advance`.
    noise_v: f64,
    fault: SensorFault,
    /// Node = factor · source + offset.
    load: (f64, f64),
    filter: LowPassState,
}

/// A step of a [`Path`] that was tried.
#[derive(Clone, Copy)]
struct PathStep {
    state: HallState,
    /// Node ahead of the follower: true mean, true end.
    node_v: Linear,
    /// Follower: the same.
    follower_v: Linear,
    /// Follower, true start and end.
    ends_v: (f64, f64),
}

impl Path {
    fn new(
        config: HallSensorConfig,
        stream: u64,
        network: Option<&Network>,
        conditions: &Conditions,
    ) -> Self {
        let sensor = HallSensor::new(config);
        let state = sensor.settled(&conditions.sensor());
        let mut new = Self {
            sensor,
            state,
            noise: Noise::new(&config.noise, stream),
            noise_v: 0.0,
            fault: SensorFault::None,
            load: (1.0, 0.0),
            filter: LowPass::settled(0.0),
        };
        new.set_fault(SensorFault::None, network);
        new.filter = LowPass::settled(new.follower_v(conditions));
        new
    }

    fn set_fault(&mut self, fault: SensorFault, network: Option<&Network>) {
        self.fault = fault;
        let source_ohm = match fault {
            SensorFault::None => self.sensor.config().output_ohm,
            SensorFault::Open => f64::INFINITY,
            SensorFault::Forced(_) => 0.0,
            SensorFault::Divider { ohms, .. } => ohms,
        };
        self.load = match network {
            Some(network) => network.load(source_ohm),
            None if source_ohm == f64::INFINITY => (0.0, 0.0),
            None => (1.0, 0.0),
        };
    }

    fn source_v(&self, output_v: f64, shift_v: f64) -> f64 {
        match self.fault {
            SensorFault::None => output_v + self.noise_v + shift_v,
            SensorFault::Open => 0.0,
            SensorFault::Forced(volts) | SensorFault::Divider { volts, .. } => volts,
        }
    }

    fn node_v(&self, output_v: f64, shift_v: f64) -> f64 {
        self.load.0 * self.source_v(output_v, shift_v) + self.load.1
    }

    /// The follower's output now.
    fn follower_v(&self, conditions: &Conditions) -> f64 {
        followed_v(
            self.node_v(self.state.output_v(), conditions.output_shift_v),
            conditions.sensor_supply_v,
        )
    }

    fn try_step(&mut self, dt_s: f64, from: &Conditions, to: &Conditions) -> PathStep {
        let (state, output) = self.sensor.step(dt_s, &self.state, &to.sensor());
        let node_v = Linear {
            start: self.node_v(output.start, from.output_shift_v),
            end: self.node_v(output.end, to.output_shift_v),
        };
        let follower_v = Linear {
            start: followed_v(node_v.start, from.sensor_supply_v),
            end: followed_v(node_v.end, to.sensor_supply_v),
        };
        PathStep {
            state,
            node_v,
            follower_v,
            ends_v: (self.follower_v(from), follower_v.end),
        }
    }
}

/// A follower with its rails at ground and at the sensors' supply.
fn followed_v(node_v: f64, supply_v: f64) -> f64 {
    node_v.min(supply_v).max(0.0)
}

/// What was tried for both sensors.
#[derive(Clone, Copy)]
struct Trial {
    end_s: f64,
    conditions: Conditions,
    small: PathStep,
    large: Option<PathStep>,
}

/// The analogue side of the board.
#[derive(Clone, Debug)]
pub struct FrontEnd {
    config: FrontEndConfig,
    now_s: f64,
    conditions: Conditions,
    small: Path,
    large: Option<Path>,
    network: Network,
    comparators: Comparators,
    switch: AnalogSwitch,
    filter: LowPass,
    /// State of a filter behind the switch.
    common_filter: LowPassState,
    faults: Faults,
    next_pattern_edge: u64,
}

impl FrontEnd {
    /// The front end at `at_s`, settled under `conditions`, its cores without history.
    pub fn new(config: FrontEndConfig, at_s: f64, conditions: Conditions) -> Self {
        let (small, large) = match config.sensors {
            Sensors::DualRange { small, large } => (small, Some(large)),
            Sensors::Hah1bv(only) | Sensors::Network(only) | Sensors::ClosedLoop(only) => {
                (only, None)
            }
        };
        let unconnected = Network::new(&config.network, 0.0);
        let small = Path::new(small, 0, Some(&unconnected), &conditions);
        let large = large.map(|sensor| Path::new(sensor, 1, None, &conditions));
        let network = Network::new(
            &config.network,
            small.node_v(small.state.output_v(), conditions.output_shift_v),
        );
        let follower_v = small.follower_v(&conditions);
        let comparators =
            Comparators::new(config.comparators, follower_v, conditions.sensor_supply_v);
        let high = large.is_some() && comparators.output();
        let mut new = Self {
            config,
            now_s: at_s,
            conditions,
            small,
            large,
            network,
            comparators,
            switch: AnalogSwitch::new(config.switch, high, 0.0),
            filter: LowPass::new(&config.filter),
            common_filter: LowPass::settled(0.0),
            faults: Faults::default(),
            next_pattern_edge: 0,
        };
        if matches!(config.sensors, Sensors::Network(_)) {
            new.small.filter = LowPass::settled(new.network.output_v());
        }
        let signal_v = new.signal_v();
        new.switch = AnalogSwitch::new(config.switch, high, signal_v);
        new.common_filter = LowPass::settled(signal_v);
        new
    }

    /// What it was made of.
    pub const fn config(&self) -> &FrontEndConfig {
        &self.config
    }

    /// Now, in s.
    pub const fn now_s(&self) -> f64 {
        self.now_s
    }

    /// The conditions now.
    pub const fn conditions(&self) -> &Conditions {
        &self.conditions
    }

    /// Level of the range flag at the MCU: high = large sensor.
    pub fn range_high(&self) -> bool {
        self.faults.flag_line.unwrap_or_else(|| self.gate())
    }

    /// Which sensor the switch passes, or is about to: high = large. It is [`FrontEnd::range_high`] unless the flag's
    /// line is stuck.
    pub const fn switch_high(&self) -> bool {
        self.switch.is_high()
    }

    /// Output of the small or only sensor itself, in V.
    pub const fn small_sensor_v(&self) -> f64 {
        self.small.state.output_v()
    }

    /// Output of the large sensor itself, in V.
    pub fn large_sensor_v(&self) -> Option<f64> {
        self.large.as_ref().map(|path| path.state.output_v())
    }

    /// Output of the small or only sensor's follower, in V: what the comparators see.
    pub fn small_follower_v(&self) -> f64 {
        self.small.follower_v(&self.conditions)
    }

    /// Output of the open-sensor network at the MCU's pin, in V.
    pub fn network_v(&self) -> f64 {
        self.network.output_v()
    }

    /// The faults that are present.
    pub const fn faults(&self) -> Faults {
        self.faults
    }

    /// Faults come or go, now.
    pub fn set_faults(&mut self, faults: Faults) {
        self.faults = faults;
        self.small.set_fault(faults.small, Some(&self.network));
        if let Some(large) = &mut self.large {
            large.set_fault(faults.large, None);
        }
        if let GateOverride::Pattern(pattern) = faults.gate {
            self.next_pattern_edge = pattern.edges_until(self.now_s);
        }
        self.drive_switch();
    }

    /// Moves to `end_s`, where `conditions` hold; in between they move in straight lines. `each` gets the stretches in
    /// order; each ends at an edge of the flag, at a corner of a signal, or at the end. With `end_s` now or earlier the
    /// conditions jump.
    pub fn advance(&mut self, end_s: f64, conditions: &Conditions, mut each: impl FnMut(&Stretch)) {
        let whole_s = end_s - self.now_s;
        if whole_s <= 0.0 || whole_s.is_nan() {
            let trial = self.attempt(self.now_s, self.now_s, conditions);
            self.keep(&trial);
            return;
        }
        self.small.noise_v = self.small.noise.step(whole_s);
        if let Some(large) = &mut self.large {
            large.noise_v = large.noise.step(whole_s);
        }
        while self.now_s < end_s {
            self.advance_one_stretch(end_s, conditions, &mut each);
        }
    }

    fn advance_one_stretch(
        &mut self,
        end_s: f64,
        conditions: &Conditions,
        each: &mut impl FnMut(&Stretch),
    ) {
        let start_s = self.now_s;
        let until_s = self
            .next_scheduled_s()
            .map_or(end_s, |at_s| at_s.max(start_s).min(end_s));
        let mut trial = self.attempt(until_s, end_s, conditions);
        if let Some(at_s) = self.corner_s(&trial) {
            trial = self.attempt(at_s, end_s, conditions);
        }
        let change = if self.large.is_some() {
            self.comparators.first_change(
                (trial.small.ends_v.0, self.conditions.sensor_supply_v),
                (trial.small.ends_v.1, trial.conditions.sensor_supply_v),
            )
        } else {
            None
        };
        if let Some((side, fraction)) = change {
            let mut at_s = start_s + (trial.end_s - start_s) * fraction;
            if fraction > 0.0 && self.small.sensor.is_curved() {
                at_s = self.crossing_s(side, at_s, trial.end_s, end_s, conditions);
            }
            trial = self.attempt(at_s, end_s, conditions);
        }

        let dt_s = trial.end_s - start_s;
        if dt_s > 0.0 {
            each(&self.stretch(dt_s, &trial));
        }
        self.keep(&trial);
        self.now_s = trial.end_s;

        if let Some((side, _)) = change {
            self.comparators.change(side, self.now_s);
        }
        self.comparators.advance(self.now_s);
        self.switch.advance(self.now_s);
        if let GateOverride::Pattern(pattern) = self.faults.gate {
            while pattern.edge_s(self.next_pattern_edge) <= self.now_s {
                self.next_pattern_edge += 1;
            }
        }
        self.drive_switch();
    }

    /// Level of the gate's output.
    fn gate(&self) -> bool {
        match self.faults.gate {
            GateOverride::None => self.large.is_some() && self.comparators.output(),
            GateOverride::Constant(level) => level,
            // After an odd number of edges it is high.
            GateOverride::Pattern(_) => self.next_pattern_edge % 2 == 1,
        }
    }

    fn drive_switch(&mut self) {
        if self.large.is_some() {
            self.switch.set(self.gate(), self.now_s);
        }
    }

    fn next_scheduled_s(&self) -> Option<f64> {
        let pattern_s = match self.faults.gate {
            GateOverride::Pattern(pattern) => Some(pattern.edge_s(self.next_pattern_edge)),
            GateOverride::None | GateOverride::Constant(_) => None,
        };
        [
            pattern_s,
            self.comparators.pending_s(),
            self.switch.pending_s(),
        ]
        .into_iter()
        .flatten()
        .reduce(f64::min)
    }

    /// Both sensors at `at_s` on the way to `conditions` at `end_s`, without going there.
    fn attempt(&mut self, at_s: f64, end_s: f64, conditions: &Conditions) -> Trial {
        let to = if at_s >= end_s {
            *conditions
        } else {
            let fraction = (at_s - self.now_s) / (end_s - self.now_s);
            self.conditions.towards(conditions, fraction)
        };
        let dt_s = at_s - self.now_s;
        Trial {
            end_s: at_s,
            small: self.small.try_step(dt_s, &self.conditions, &to),
            large: self
                .large
                .as_mut()
                .map(|path| path.try_step(dt_s, &self.conditions, &to)),
            conditions: to,
        }
    }

    /// The first corner of a sensor's characteristic inside a trial.
    fn corner_s(&self, trial: &Trial) -> Option<f64> {
        let small = self
            .small
            .sensor
            .corner(&self.small.state, &trial.small.state);
        let large = match (&self.large, &trial.large) {
            (Some(path), Some(step)) => path.sensor.corner(&path.state, &step.state),
            _ => None,
        };
        let fraction = match (small, large) {
            (Some(small), Some(large)) => small.min(large),
            (small, large) => small.or(large)?,
        };
        let at_s = self.now_s + (trial.end_s - self.now_s) * fraction;
        (at_s > self.now_s).then_some(at_s)
    }

    /// The time at which a curve reaches the threshold of `side`, by regula falsi with the Illinois rule, to 1 nV.
    fn crossing_s(
        &mut self,
        side: crate::comparator::Side,
        first_guess_s: f64,
        until_s: f64,
        end_s: f64,
        conditions: &Conditions,
    ) -> f64 {
        let excess = |front_end: &mut Self, at_s: f64| {
            let trial = front_end.attempt(at_s, end_s, conditions);
            front_end.comparators.excess_v(
                side,
                trial.small.ends_v.1,
                trial.conditions.sensor_supply_v,
            )
        };
        let (mut low_s, mut high_s) = (self.now_s, until_s);
        let start_v = self.small.follower_v(&self.conditions);
        let mut low_v = self
            .comparators
            .excess_v(side, start_v, self.conditions.sensor_supply_v)
            .min(0.0);
        let mut high_v = excess(self, until_s);
        let mut at_s = first_guess_s;
        let mut last_was_beyond = None;
        for _ in 0..60 {
            let at_v = excess(self, at_s);
            if at_v.abs() < 1e-9 {
                break;
            }
            // The end that stays twice in a row counts half.
            let beyond = at_v > 0.0;
            let again = last_was_beyond == Some(beyond);
            last_was_beyond = Some(beyond);
            if beyond {
                (high_s, high_v) = (at_s, at_v);
                low_v *= if again { 0.5 } else { 1.0 };
            } else {
                (low_s, low_v) = (at_s, at_v);
                high_v *= if again { 0.5 } else { 1.0 };
            }
            let next_s = low_s + (high_s - low_s) * (-low_v / (high_v - low_v));
            if next_s == at_s {
                break;
            }
            at_s = next_s;
        }
        at_s
    }

    fn keep(&mut self, trial: &Trial) {
        self.small.state = trial.small.state;
        if let (Some(path), Some(step)) = (&mut self.large, &trial.large) {
            path.state = step.state;
        }
        self.conditions = trial.conditions;
    }

    /// The nodes during a trial; filters, network and switch move on.
    fn stretch(&mut self, dt_s: f64, trial: &Trial) -> Stretch {
        let (from, to) = (self.conditions, trial.conditions);
        let network_v = self.network.step(dt_s, trial.small.node_v);
        let small_signal_v = match self.config.sensors {
            Sensors::Network(_) => network_v,
            _ => trial.small.follower_v,
        };
        let before_switch = self.config.filter_place == FilterPlace::BeforeSwitch;
        let (mut small_v, mut large_v) = (small_signal_v, trial.large.map(|step| step.follower_v));
        if before_switch && self.filter.is_on() {
            (self.small.filter, small_v) = self.filter.step(dt_s, &self.small.filter, small_v);
            if let (Some(path), Some(line)) = (&mut self.large, &mut large_v) {
                (path.filter, *line) = self.filter.step(dt_s, &path.filter, *line);
            }
        }
        let selected_v = match large_v {
            Some(large_v) if self.switch.is_high() => large_v,
            _ => small_v,
        };
        let mut converter_v = self.switch.step(dt_s, selected_v);
        if !before_switch {
            (self.common_filter, converter_v) =
                self.filter.step(dt_s, &self.common_filter, converter_v);
        }
        let (level_from_v, level_to_v) = match self.config.sensors {
            Sensors::Network(_) => (self.network.zero_v(), self.network.zero_v()),
            _ => (0.5 * from.sensor_supply_v, 0.5 * to.sensor_supply_v),
        };
        let line = |value: fn(&Conditions) -> f64| Linear {
            start: value(&from),
            end: value(&to),
        };
        Stretch {
            start_s: self.now_s,
            end_s: trial.end_s,
            current_a: line(|conditions| conditions.current_a),
            converter_v,
            meter_v1_v: Linear {
                start: (converter_v.start - level_from_v) * self.config.meter_scale,
                end: (converter_v.end - level_to_v) * self.config.meter_scale,
            },
            network_v,
            sensor_supply_v: line(|conditions| conditions.sensor_supply_v),
            converter_supply_v: line(|conditions| conditions.converter_supply_v),
            range_high: self.range_high(),
        }
    }

    /// What is at the selected contact now, before any filter.
    fn signal_v(&self) -> f64 {
        match (&self.large, self.config.sensors) {
            (Some(large), _) if self.switch.is_high() => large.follower_v(&self.conditions),
            (_, Sensors::Network(_)) => self.network.output_v(),
            _ => self.small.follower_v(&self.conditions),
        }
    }
}
