//! A Hall sensor: current through its conductor → output voltage.
//!
//! ```text
//! i + coupling·i_aux → core (hysteresis, saturation) → gain, zero → end of range → volts by supply → lag
//! ```
//!
//! Parameter names and their meaning are those of the library of effects; a nominal value takes the effect away.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};

use crate::filter::FirstOrder;
use crate::magnetic_core::{MagneticCore, MagneticCoreConfig, MagneticCoreState};
use crate::stretch::Linear;

/// Supply at which sensitivity and zero are rated, in V (D0, D2, D4).
pub const RATED_SUPPLY_V: f64 = 5.0;
/// Temperature at which they are, in °C.
pub const RATED_TEMPERATURE_C: f64 = 25.0;

/// From the sensor's reading in A to its output in V.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub enum Transfer {
    /// V = (1 + (Vc/5 V − 1)·ratio) · (zero + sensitivity·reading); with ratio 1 that is Vc/5 V · (…), LEM's definition
    /// of a ratiometric sensor.
    Line {
        /// Output at 0 A and rated supply, in V.
        zero_v: f64,
        /// V per A at rated supply.
        sensitivity_v_per_a: f64,
        /// How far the output follows the supply: 1 entirely, 0 not at all.
        ratio: f64,
    },
    /// D4: V = (k1·Vc + m1)·reading/N + k2·Vc + m2.
    ClosedLoop {
        /// Turns ratio N.
        turns: f64,
        /// k1, in Ω/V.
        k1_ohm_per_v: f64,
        /// m1, in Ω.
        m1_ohm: f64,
        /// k2, in V/V.
        k2: f64,
        /// m2, in V.
        m2_v: f64,
    },
}

impl Transfer {
    /// Output at 0 A, in V.
    pub fn zero_v(&self, supply_v: f64) -> f64 {
        match *self {
            Self::Line { zero_v, ratio, .. } => follow(supply_v, ratio) * zero_v,
            Self::ClosedLoop { k2, m2_v, .. } => k2 * supply_v + m2_v,
        }
    }

    /// V per A of the reading.
    pub fn sensitivity_v_per_a(&self, supply_v: f64) -> f64 {
        match *self {
            Self::Line {
                sensitivity_v_per_a,
                ratio,
                ..
            } => follow(supply_v, ratio) * sensitivity_v_per_a,
            Self::ClosedLoop {
                turns,
                k1_ohm_per_v,
                m1_ohm,
                ..
            } => (k1_ohm_per_v * supply_v + m1_ohm) / turns,
        }
    }

    fn output_v(&self, reading_a: f64, supply_v: f64) -> f64 {
        match *self {
            Self::Line {
                zero_v,
                sensitivity_v_per_a,
                ratio,
            } => follow(supply_v, ratio) * (zero_v + sensitivity_v_per_a * reading_a),
            Self::ClosedLoop { .. } => {
                self.zero_v(supply_v) + self.sensitivity_v_per_a(supply_v) * reading_a
            }
        }
    }
}

fn follow(supply_v: f64, ratio: f64) -> f64 {
    1.0 + (supply_v / RATED_SUPPLY_V - 1.0) * ratio
}

/// Sensitivity follows the low-passed square of the current: conductor and housing warm the Hall plate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SelfHeatingConfig {
    /// Change of gain per A², in 1/A². 0: none.
    pub tc_per_a2: f64,
    /// Time constant, in s.
    pub tau_s: f64,
}

/// White noise through a first-order low-pass, at the output.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NoiseConfig {
    /// Effective value within the bandwidth, in V. 0: none. A density of e V/√Hz is e·√(π/2·bandwidth).
    pub rms_v: f64,
    /// Corner frequency, in Hz.
    pub bandwidth_hz: f64,
    /// Seed of the generator.
    pub seed: u64,
}

impl Default for NoiseConfig {
    /// None; the bandwidth of an open-loop sensor is commonly quoted as 50 kHz (*assumed*).
    fn default() -> Self {
        Self {
            rms_v: 0.0,
            bandwidth_hz: 50e3,
            seed: 0,
        }
    }
}

/// A Hall sensor.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct HallSensorConfig {
    /// Reading → volts.
    pub transfer: Transfer,
    /// End of the range, both signs, in A; the remanence refers to it.
    pub full_scale_a: f64,
    /// The reading stops here, in A. Nominal: at the range's end (D0: past its range the output no longer moves).
    pub high_a: f64,
    /// See [`HallSensorConfig::high_a`].
    pub low_a: f64,
    /// The output cannot leave 0 V … Vc. Not so for D3's sensor on ±15 V.
    pub single_supply: bool,
    /// Resistance of the output, in Ω. Loaded by D3's network alone.
    pub output_ohm: f64,
    /// Zero error, in A.
    pub offset_a: f64,
    /// Sensitivity error as a factor; 1: none.
    pub gain: f64,
    /// Drift of the zero, in A/K from 25 °C.
    pub tc_a_per_k: f64,
    /// Drift of the sensitivity, in 1/K from 25 °C.
    pub tc_per_k: f64,
    /// Share of a neighbouring conductor's current that the core sees.
    pub coupling: f64,
    /// Hysteresis and saturation.
    pub core: MagneticCoreConfig,
    /// Drift of the sensitivity under load.
    pub self_heating: SelfHeatingConfig,
    /// First-order lag of the output, in s. LEM's BMS types filter: 4 … 6 ms to 90 %, that is 1.7 … 2.6 ms (HAH1BV
    /// family, *assumed*).
    pub tau_s: f64,
    /// Noise at the output.
    pub noise: NoiseConfig,
}

impl HallSensorConfig {
    /// An ideal sensor with `zero_v` at 0 A and `swing_v` from there to `full_scale_a`, ratiometric.
    pub fn ratiometric(zero_v: f64, swing_v: f64, full_scale_a: f64) -> Self {
        Self {
            transfer: Transfer::Line {
                zero_v,
                sensitivity_v_per_a: swing_v / full_scale_a,
                ratio: 1.0,
            },
            full_scale_a,
            high_a: full_scale_a,
            low_a: -full_scale_a,
            single_supply: true,
            output_ohm: 0.0,
            offset_a: 0.0,
            gain: 1.0,
            tc_a_per_k: 0.0,
            tc_per_k: 0.0,
            coupling: 0.0,
            core: MagneticCoreConfig::default(),
            self_heating: SelfHeatingConfig::default(),
            tau_s: 0.0,
            noise: NoiseConfig::default(),
        }
    }

    /// D0's small sensor: ±60 A, 2.5 V ± 2.25 V.
    pub fn dual_range_small() -> Self {
        Self::ratiometric(2.5, 2.25, 60.0)
    }

    /// D0's large sensor: ±600 A, 2.5 V ± 2.25 V.
    pub fn dual_range_large() -> Self {
        Self::ratiometric(2.5, 2.25, 600.0)
    }

    /// D2's LEM HAH1BV S/02: ±500 A at 4 mV/A around 2.5 V.
    pub fn hah1bv() -> Self {
        Self::ratiometric(2.5, 2.0, 500.0)
    }

    /// D3's sensor: ±4 V on ±15 V; ±500 A is *assumed*, D3 names no current.
    pub fn bipolar() -> Self {
        let mut sensor = Self::ratiometric(0.0, 4.0, 500.0);
        if let Transfer::Line { ratio, .. } = &mut sensor.transfer {
            *ratio = 0.0;
        }
        sensor.single_supply = false;
        sensor
    }

    /// D4's closed-loop sensor as rated: 300 A, 2.5 V ± 2 V at 5 V, fully ratiometric; N = 2,000 is *assumed*.
    pub fn closed_loop() -> Self {
        const TURNS: f64 = 2_000.0;
        let mut sensor = Self::ratiometric(2.5, 2.0, 300.0);
        sensor.transfer = Transfer::ClosedLoop {
            turns: TURNS,
            k1_ohm_per_v: 2.0 / 300.0 * TURNS / RATED_SUPPLY_V,
            m1_ohm: 0.0,
            k2: 0.5,
            m2_v: 0.0,
        };
        sensor
    }
}

impl Default for HallSensorConfig {
    /// [`HallSensorConfig::dual_range_small`].
    fn default() -> Self {
        Self::dual_range_small()
    }
}

/// What acts on a sensor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SensorInput {
    /// Current through its conductor, in A.
    pub current_a: f64,
    /// Current through the neighbouring conductor, in A.
    pub aux_current_a: f64,
    /// Its temperature, in °C.
    pub temperature_c: f64,
    /// Its supply, in V.
    pub supply_v: f64,
}

/// The state of a sensor at a point in time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HallState {
    core: MagneticCoreState,
    current_a: f64,
    heat_a2: f64,
    reading_a: f64,
    before_lag_v: f64,
    output_v: f64,
}

impl HallState {
    /// Output, in V.
    pub const fn output_v(&self) -> f64 {
        self.output_v
    }

    /// The reading in A before it is held at the range's ends.
    pub const fn reading_a(&self) -> f64 {
        self.reading_a
    }

    /// What the core remembers.
    pub const fn core(&self) -> &MagneticCoreState {
        &self.core
    }
}

/// A [`HallSensorConfig`] made ready; the state is apart, so that a step can be tried.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HallSensor {
    config: HallSensorConfig,
    core: MagneticCore,
    heating: FirstOrder,
    lag: FirstOrder,
}

impl HallSensor {
    /// The sensor of `config`.
    pub fn new(config: HallSensorConfig) -> Self {
        Self {
            config,
            core: MagneticCore::new(&config.core, config.full_scale_a),
            heating: FirstOrder::new(config.self_heating.tau_s),
            lag: FirstOrder::new(config.tau_s),
        }
    }

    /// What it was made of.
    pub const fn config(&self) -> &HallSensorConfig {
        &self.config
    }

    /// Settled: a demagnetised core that the current was led to without turning back, warm, without lag.
    pub fn settled(&self, input: &SensorInput) -> HallState {
        let field_a = input.current_a + self.config.coupling * input.aux_current_a;
        let core = self.core.magnetise(&MagneticCoreState::default(), field_a);
        let heat_a2 = input.current_a * input.current_a;
        let reading_a = self.reading_a(&core, heat_a2, input);
        let output_v = self.unlagged_v(reading_a, input);
        HallState {
            core,
            current_a: input.current_a,
            heat_a2,
            reading_a,
            before_lag_v: output_v,
            output_v,
        }
    }

    /// The state `dt_s` later, when the inputs have moved in straight lines to `end`, and the output meanwhile (true
    /// mean and end). `dt_s` = 0 is a jump. Inside the step a curved characteristic is taken as its chord.
    pub fn step(&mut self, dt_s: f64, state: &HallState, end: &SensorInput) -> (HallState, Linear) {
        let field_a = end.current_a + self.config.coupling * end.aux_current_a;
        let core = self.core.magnetise(&state.core, field_a);
        let heat_a2 = if self.config.self_heating.tc_per_a2 == 0.0 {
            0.0
        } else {
            // The mean square of a straight line. Heat is slow against a step.
            let (a, b) = (state.current_a, end.current_a);
            let square_a2 = (a * a + a * b + b * b) / 3.0;
            self.heating
                .step(dt_s, state.heat_a2, Linear::constant(square_a2))
                .0
        };
        let reading_a = self.reading_a(&core, heat_a2, end);
        let before_lag_v = self.unlagged_v(reading_a, end);
        let (output_v, line) = self.lag.step(
            dt_s,
            state.output_v,
            Linear {
                start: state.before_lag_v,
                end: before_lag_v,
            },
        );
        (
            HallState {
                core,
                current_a: end.current_a,
                heat_a2,
                reading_a,
                before_lag_v,
                output_v,
            },
            line,
        )
    }

    /// Where, as a share of the way from `from` to `to`, the reading first meets an end of the range: there the output
    /// has a corner. Closer to either end than 10⁻⁹ it counts as that end: a cut at a corner is rounded.
    pub fn corner(&self, from: &HallState, to: &HallState) -> Option<f64> {
        let (a, b) = (from.reading_a, to.reading_a);
        let at = |limit_a: f64| {
            ((a < limit_a) != (b < limit_a))
                .then(|| (limit_a - a) / (b - a))
                .filter(|fraction| (1e-9..=1.0 - 1e-9).contains(fraction))
        };
        match (at(self.config.low_a), at(self.config.high_a)) {
            (Some(low), Some(high)) => Some(low.min(high)),
            (low, high) => low.or(high),
        }
    }

    /// Whether the output can move within a step other than in a straight line.
    pub const fn is_curved(&self) -> bool {
        self.lag.is_on()
    }

    fn reading_a(&self, core: &MagneticCoreState, heat_a2: f64, input: &SensorInput) -> f64 {
        let c = &self.config;
        let warm_k = input.temperature_c - RATED_TEMPERATURE_C;
        let gain = c.gain * (1.0 + c.tc_per_k * warm_k + c.self_heating.tc_per_a2 * heat_a2);
        gain * self.core.reading_a(core) + (c.offset_a + c.tc_a_per_k * warm_k)
    }

    fn unlagged_v(&self, reading_a: f64, input: &SensorInput) -> f64 {
        let c = &self.config;
        let volts = c
            .transfer
            .output_v(reading_a.max(c.low_a).min(c.high_a), input.supply_v);
        if c.single_supply {
            volts.min(input.supply_v).max(0.0)
        } else {
            volts
        }
    }
}

/// A sensor's noise: the exact mean, over each step, of white noise behind a first-order low-pass.
///
/// A step's value is drawn from the joint distribution of end and mean of the Ornstein–Uhlenbeck process (Gillespie,
/// Physical Review E 54 (1996) 2084), so its power is right for any step length.
#[derive(Clone, Debug)]
pub struct Noise {
    rms_v: f64,
    tau_s: f64,
    random: ChaCha8Rng,
    value_v: f64,
    step_s: f64,
    kept: f64,
    fresh_v: f64,
    mean_of_ends: f64,
    within_v: f64,
}

impl Noise {
    /// The noise of `config`; `stream` keeps two sensors with one seed apart.
    pub fn new(config: &NoiseConfig, stream: u64) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(config.seed);
        random.set_stream(stream);
        let value_v = config.rms_v * normal(&mut random);
        Self {
            rms_v: config.rms_v,
            tau_s: 1.0 / (std::f64::consts::TAU * config.bandwidth_hz),
            random,
            value_v,
            step_s: 0.0,
            kept: 1.0,
            fresh_v: 0.0,
            mean_of_ends: 0.5,
            within_v: 0.0,
        }
    }

    /// Its mean over the next `dt_s`, in V.
    pub fn step(&mut self, dt_s: f64) -> f64 {
        if self.rms_v == 0.0 {
            return 0.0;
        }
        if (dt_s - self.step_s).abs() > 1e-6 * dt_s {
            self.step_s = dt_s;
            let x = dt_s / self.tau_s;
            self.kept = (-x).exp();
            self.fresh_v = self.rms_v * (-(-2.0 * x).exp_m1()).sqrt();
            let half = (0.5 * x).tanh();
            // What the two ends leave open about the mean; below x = 0.001 the difference would be rounding.
            let (of_ends, within) = if x > 1e-3 {
                (half / x, 2.0 * (x - 2.0 * half) / (x * x))
            } else {
                (0.5, x / 6.0)
            };
            self.mean_of_ends = of_ends;
            self.within_v = self.rms_v * within.sqrt();
        }
        let before_v = self.value_v;
        self.value_v = before_v * self.kept + self.fresh_v * normal(&mut self.random);
        (before_v + self.value_v) * self.mean_of_ends + self.within_v * normal(&mut self.random)
    }
}

fn normal(random: &mut ChaCha8Rng) -> f64 {
    StandardNormal.sample(random)
}
