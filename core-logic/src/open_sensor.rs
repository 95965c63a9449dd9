//! D3: tells a sensor that is not connected from one that reads a current.
//!
//! The network pulls the signal of an open sensor to 0.148 V, below everything that a connected one gives; without the
//! pull-down it would be 2.02 V, in the middle of the normal span. Besides, a sensor that stands at 0 V or at its
//! supply is found on the network and on the converter. Every reading is first judged by itself ([`Finding`]) and then
//! debounced.
//!
//! **What it cannot find**: a sensor, or a wire, that floats at half the supply reads like 0 A on every channel that
//! hangs on it. Only a second sensor can contradict that.

use serde::{Deserialize, Serialize};

use crate::converter::CurrentReading;
use crate::design_parameters as design;
use crate::front_end::{FrontEnd, OutputLimits, PerRange, network_output_nanovolts};
use crate::range::Range;
use crate::units::{Duration, Instant, Microvolts, clamp_i32, div_round, elapsed, mul_div};
use crate::validity::Validity;

/// The network's output with a sensor connected, whatever its output stage (R4 is far larger than its resistance):
/// 0.225 · Vhall + 1.65 V.
#[must_use]
pub const fn network_output(hall: Microvolts) -> Microvolts {
    Microvolts(clamp_i32(div_round(
        network_output_nanovolts(hall.get() as i64 * 1_000),
        1_000,
    )))
}

/// The network's output with the sensor open, with D3's pull-down: 0.148 V. The + input then lies between the
/// reference behind R3 and the negative supply behind R4, R6 and R7.
#[must_use]
pub const fn network_output_open() -> Microvolts {
    let to_negative = design::R4_OHM + design::PULL_DOWN_OHM;
    let input_nanovolts = div_round(
        (design::NETWORK_REFERENCE.get() as i64 * to_negative
            + design::NEGATIVE_SUPPLY.get() as i64 * design::R3_OHM)
            * 1_000,
        design::R3_OHM + to_negative,
    );
    amplified(input_nanovolts)
}

/// The network's output with the sensor open and no pull-down: 2.02 V, which a connected sensor gives at +1.65 V.
#[must_use]
pub const fn network_output_open_without_pull_down() -> Microvolts {
    amplified(design::NETWORK_REFERENCE.get() as i64 * 1_000)
}

/// [`network_output_open`], and [`network_output`] of 0 V.
const OPEN: Microvolts = network_output_open();
pub(crate) const AT_GROUND: Microvolts = network_output(Microvolts::ZERO);

/// The amplifier's 1 + R1/R2, nV to µV.
const fn amplified(input_nanovolts: i64) -> Microvolts {
    Microvolts(clamp_i32(mul_div(
        input_nanovolts,
        design::R1_OHM + design::R2_OHM,
        design::R2_OHM * 1_000,
    )))
}

/// Configuration of the open-sensor detection.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct OpenSensorConfig {
    /// Network output below which the sensor is open; `None` for the middle between the open level and the lowest level
    /// of the front end in use.
    pub open_below: Option<Microvolts>,
    /// Faulty readings in succession until the sensor is reported …
    pub set_count: u8,
    /// … and the time from the first to the last of them.
    pub set_time_ms: u32,
    /// Good readings in succession until it is believed again …
    pub clear_count: u8,
    /// … and the time from the first to the last of them.
    pub clear_time_ms: u32,
}

impl Default for OpenSensorConfig {
    fn default() -> Self {
        Self {
            open_below: None,
            set_count: design::OPEN_SET_COUNT,
            set_time_ms: 0,
            clear_count: design::OPEN_CLEAR_COUNT,
            clear_time_ms: design::OPEN_CLEAR_TIME_MS,
        }
    }
}

impl OpenSensorConfig {
    /// Whether the counts are at least one, the times at most ten seconds, and the threshold lies between the open
    /// level and the lowest level of `front_end`.
    #[must_use]
    pub fn is_valid(&self, front_end: &FrontEnd) -> bool {
        self.set_count > 0
            && self.clear_count > 0
            && self.set_time_ms <= 10_000
            && self.clear_time_ms <= 10_000
            && self.threshold_is_valid(front_end)
    }

    /// Whether the threshold lies there; the rest are limits of each value alone.
    pub(crate) fn threshold_is_valid(&self, front_end: &FrontEnd) -> bool {
        let legal = legal_at_network(front_end, design::SENSOR_NOMINAL_SUPPLY);
        self.open_below
            .is_none_or(|level| level > OPEN && level < legal.low)
    }
}

/// What one reading says.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Finding {
    /// Inside the span of a connected sensor.
    #[default]
    Connected,
    /// At the level of an open sensor.
    Open,
    /// At 0 V: output or supply shorted to ground, supply missing.
    LowRail,
    /// At the supply.
    HighRail,
    /// At or beyond the clamps of the ADC's pin: says nothing about the sensor, so it is not believed.
    Unclear,
}

impl Finding {
    /// Whether the sensor cannot be believed.
    #[must_use]
    pub const fn is_fault(self) -> bool {
        !matches!(self, Self::Connected)
    }
}

/// Levels between the findings; to be renewed when the front end, the configuration or the supply changes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct OpenSensorThresholds {
    /// Network output below which the sensor is open.
    pub open_below: Microvolts,
    /// Network output below which the sensor is at 0 V.
    pub low_rail_below: Microvolts,
    /// Network output above which the sensor is at its supply.
    pub high_rail_above: Microvolts,
    /// Signals between which the converter's reading is no rail; `None` when no converter reads the sensor besides the
    /// network.
    pub converter: Option<PerRange<OutputLimits>>,
}

impl OpenSensorThresholds {
    /// Puts each level in the middle between its neighbours. `supply` is the sensor's supply where it is known: a rail
    /// and, for a ratiometric sensor, the ends of its range follow it.
    #[must_use]
    pub fn prepare(
        config: &OpenSensorConfig,
        front_end: &FrontEnd,
        supply: Option<Microvolts>,
    ) -> Self {
        let supply = supply
            .unwrap_or(design::SENSOR_NOMINAL_SUPPLY)
            .clamp(design::SENSOR_SUPPLY_LOW, design::SENSOR_SUPPLY_HIGH);
        let legal = legal_at_network(front_end, supply);
        let open_below = config.open_below.unwrap_or_else(|| middle(OPEN, legal.low));
        let (low_rail_below, high_rail_above, converter) = match front_end {
            // Its output stage runs from ±15 V: the negative rail is below the open level, the positive one is clamped.
            FrontEnd::Network(_) => (open_below, middle(legal.high, design::NETWORK_CLAMP), None),
            FrontEnd::DualRange(_) | FrontEnd::Hah1bv(_) | FrontEnd::ClosedLoop(_) => {
                // D4's readings carry the actual signal, the others' are referred to the rated supply.
                let rail = if matches!(front_end, FrontEnd::ClosedLoop(_)) {
                    supply
                } else {
                    design::SENSOR_NOMINAL_SUPPLY
                };
                let between_rails = |range| {
                    let limits = front_end.output_limits_at(range, rail);
                    OutputLimits {
                        low: middle(Microvolts::ZERO, limits.low),
                        high: middle(limits.high, rail),
                    }
                };
                (
                    middle(AT_GROUND, legal.low),
                    middle(legal.high, network_output(supply)),
                    Some(PerRange {
                        small: between_rails(Range::Small),
                        large: between_rails(Range::Large),
                    }),
                )
            }
        };
        Self {
            open_below,
            low_rail_below,
            high_rail_above,
            converter,
        }
    }

    /// What a voltage at the open-sensor channel's pin says.
    #[must_use]
    pub fn judge_network(&self, volts: Microvolts) -> Finding {
        if volts < Microvolts::ZERO || volts >= design::NETWORK_CLAMP {
            Finding::Unclear
        } else if volts < self.open_below {
            Finding::Open
        } else if volts < self.low_rail_below {
            Finding::LowRail
        } else if volts > self.high_rail_above {
            Finding::HighRail
        } else {
            Finding::Connected
        }
    }

    /// What the signal behind a current reading says; `None` when no converter reads the sensor besides the network.
    #[must_use]
    pub fn judge_converter(&self, volts: Microvolts, range: Range) -> Option<Finding> {
        let limits = self.converter.as_ref()?.of(range);
        Some(if volts < limits.low {
            Finding::LowRail
        } else if volts > limits.high {
            Finding::HighRail
        } else {
            Finding::Connected
        })
    }
}

/// The span of the network's output for a connected sensor: the small one, or the only one.
fn legal_at_network(front_end: &FrontEnd, supply: Microvolts) -> OutputLimits {
    let limits = front_end.output_limits_at(Range::Small, supply);
    let through_network = |volts: Microvolts| match front_end {
        FrontEnd::Network(_) => volts,
        FrontEnd::ClosedLoop(_) => network_output(volts),
        FrontEnd::DualRange(_) | FrontEnd::Hah1bv(_) => {
            let actual = mul_div(
                i64::from(volts.get()),
                i64::from(supply.get()),
                i64::from(design::SENSOR_NOMINAL_SUPPLY.get()),
            );
            network_output(Microvolts(clamp_i32(actual)))
        }
    };
    OutputLimits {
        low: through_network(limits.low),
        high: through_network(limits.high),
    }
}

fn middle(low: Microvolts, high: Microvolts) -> Microvolts {
    Microvolts(clamp_i32(
        (i64::from(low.get()) + i64::from(high.get())) / 2,
    ))
}

/// A finding that has to persist before it counts, in both directions.
#[derive(Clone, Copy, Debug)]
struct Debounced {
    finding: Finding,
    contrary: u8,
    since: Instant,
    last: Option<Instant>,
}

impl Debounced {
    const fn new() -> Self {
        Self {
            finding: Finding::Connected,
            contrary: 0,
            since: Instant::from_ticks(0),
            last: None,
        }
    }

    fn step(&mut self, config: &OpenSensorConfig, finding: Finding, at: Instant) {
        if self.last.is_some_and(|last| at <= last) {
            return;
        }
        self.last = Some(at);
        if finding.is_fault() == self.finding.is_fault() {
            self.contrary = 0;
            self.finding = finding;
            return;
        }
        if self.contrary == 0 {
            self.since = at;
        }
        self.contrary = self.contrary.saturating_add(1);
        let (count, time_ms) = if finding.is_fault() {
            (config.set_count, config.set_time_ms)
        } else {
            (config.clear_count, config.clear_time_ms)
        };
        let time = Duration::from_ticks(u64::from(time_ms) * 1_000);
        if self.contrary >= count && elapsed(self.since, at) >= time {
            self.finding = finding;
            self.contrary = 0;
        }
    }
}

/// State of the detection.
#[derive(Clone, Copy, Debug)]
pub struct OpenSensor {
    network: Debounced,
    converter: PerRange<Debounced>,
}

impl Default for OpenSensor {
    fn default() -> Self {
        Self::new()
    }
}

impl OpenSensor {
    /// Nothing found yet.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            network: Debounced::new(),
            converter: PerRange::both(Debounced::new()),
        }
    }

    /// Takes a reading of the open-sensor channel. One that is not newer than the last is passed over.
    pub fn on_network(
        &mut self,
        config: &OpenSensorConfig,
        thresholds: &OpenSensorThresholds,
        volts: Microvolts,
        at: Instant,
    ) {
        self.network
            .step(config, thresholds.judge_network(volts), at);
    }

    /// Takes a current reading for the signal behind it. One whose signal says nothing (chip fault, stale, range
    /// change), or that is not newer than the last of its sensor, is passed over.
    pub fn on_converter(
        &mut self,
        config: &OpenSensorConfig,
        thresholds: &OpenSensorThresholds,
        reading: &CurrentReading,
    ) {
        let silent = Validity::CHIP_FAULT
            .and(Validity::STALE)
            .and(Validity::RANGE_CHANGE);
        if reading.validity.bits() & silent.bits() != 0 {
            return;
        }
        if let Some(finding) = thresholds.judge_converter(reading.volts, reading.range) {
            self.converter
                .of_mut(reading.range)
                .step(config, finding, reading.at);
        }
    }

    /// The debounced finding about a sensor. The network's comes first: it alone knows "open". A finding about the
    /// large sensor stays until that sensor is selected again and reads well.
    #[must_use]
    pub const fn finding(&self, range: Range) -> Finding {
        match range {
            Range::Small if self.network.finding.is_fault() => self.network.finding,
            Range::Small => self.converter.small.finding,
            Range::Large => self.converter.large.finding,
        }
    }

    /// The cause against a sensor's current: [`Validity::OPEN`], or none.
    #[must_use]
    pub const fn validity(&self, range: Range) -> Validity {
        Validity::VALID.and_if(self.finding(range).is_fault(), Validity::OPEN)
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::converter::tests::any_validity;
    use crate::front_end::tests::{any_front_end, any_range};
    use crate::front_end::{ClosedLoop, DualRange, Hah1bv, Network};
    use crate::units::Microamps;
    use proptest::prelude::*;

    fn millivolts(value: i32) -> Microvolts {
        Microvolts::from_millivolts(value)
    }

    fn at(us: u64) -> Instant {
        Instant::from_ticks(us)
    }

    fn all() -> [FrontEnd; 4] {
        [
            FrontEnd::DualRange(DualRange::default()),
            FrontEnd::Hah1bv(Hah1bv::default()),
            FrontEnd::Network(Network::default()),
            FrontEnd::ClosedLoop(ClosedLoop::default()),
        ]
    }

    fn prepare(front_end: FrontEnd) -> OpenSensorThresholds {
        OpenSensorThresholds::prepare(&OpenSensorConfig::default(), &front_end, None)
    }

    fn reading(volts: Microvolts, us: u64, range: Range, validity: Validity) -> CurrentReading {
        CurrentReading {
            current: Microamps::ZERO,
            validity,
            range,
            at: at(us),
            volts,
        }
    }

    #[test]
    fn transfer_function_of_the_document() {
        assert_eq!(network_output(Microvolts::ZERO), millivolts(1_650));
        for (hall, adc) in [
            (-5_000, 525),
            (-4_000, 750),
            (4_000, 2_550),
            (5_000, 2_775),
            (1_000, 1_875),
        ] {
            assert_eq!(network_output(millivolts(hall)), millivolts(adc));
        }
        // (1.65 V · 267 − 15 V · 27) / 294 · 1.225 = 0.148125 V
        assert_eq!(network_output_open(), Microvolts(148_125));
        assert_eq!(
            network_output_open_without_pull_down(),
            Microvolts(2_021_250)
        );
        // Inside the normal span without, outside with the pull-down.
        let d3 = prepare(all()[2]);
        assert_eq!(
            d3.judge_network(network_output_open_without_pull_down()),
            Finding::Connected
        );
        assert_eq!(d3.judge_network(network_output_open()), Finding::Open);
    }

    #[test]
    fn thresholds_lie_in_the_middle() {
        let d3 = prepare(all()[2]);
        assert_eq!(d3.open_below, Microvolts(449_062));
        assert_eq!(d3.low_rail_below, d3.open_below);
        assert_eq!(d3.high_rail_above, millivolts(2_925));
        assert_eq!(d3.converter, None);
        // D0: 0.25 V is 1.70625 V at the network, 4.75 V is 2.71875 V, 5 V is 2.775 V.
        let d0 = prepare(all()[0]);
        assert_eq!(d0.open_below, Microvolts(927_187));
        assert_eq!(d0.low_rail_below, Microvolts(1_678_125));
        assert_eq!(d0.high_rail_above, Microvolts(2_746_875));
        let between = OutputLimits {
            low: millivolts(125),
            high: millivolts(4_875),
        };
        assert_eq!(d0.converter, Some(PerRange::both(between)));
        // D2 at 5.5 V: 0.55 V and 4.95 V at the sensor, the rail at 5.5 V; referred to 5 V on the converter.
        let d2 = OpenSensorThresholds::prepare(
            &OpenSensorConfig::default(),
            &all()[1],
            Some(millivolts(5_500)),
        );
        assert_eq!(d2.low_rail_below, Microvolts((1_650_000 + 1_773_750) / 2));
        assert_eq!(d2.high_rail_above, Microvolts((2_763_750 + 2_887_500) / 2));
        assert_eq!(
            d2.converter.unwrap().small,
            OutputLimits {
                low: millivolts(250),
                high: millivolts(4_750)
            }
        );
        // D4 at 4.5 V: 0.45 V and 4.05 V, actual volts.
        let d4 = OpenSensorThresholds::prepare(
            &OpenSensorConfig::default(),
            &all()[3],
            Some(millivolts(4_500)),
        );
        assert_eq!(
            d4.converter.unwrap().large,
            OutputLimits {
                low: millivolts(225),
                high: millivolts(4_275)
            }
        );
        assert_eq!(d4.high_rail_above, Microvolts((2_561_250 + 2_662_500) / 2));
        assert_eq!(
            OpenSensorThresholds::prepare(
                &OpenSensorConfig::default(),
                &all()[3],
                Some(millivolts(1_000))
            ),
            d4
        );
        let own = OpenSensorConfig {
            open_below: Some(millivolts(500)),
            ..OpenSensorConfig::default()
        };
        assert_eq!(
            OpenSensorThresholds::prepare(&own, &all()[0], None).open_below,
            millivolts(500)
        );
    }

    #[test]
    fn each_level_has_its_finding() {
        let d0 = prepare(all()[0]);
        let cases = [
            (i32::MIN, Finding::Unclear),
            (-1, Finding::Unclear),
            (0, Finding::Open),
            (927_186, Finding::Open),
            (927_187, Finding::LowRail),
            (1_678_124, Finding::LowRail),
            (1_678_125, Finding::Connected),
            (2_746_875, Finding::Connected),
            (2_746_876, Finding::HighRail),
            (3_299_999, Finding::HighRail),
            (3_300_000, Finding::Unclear),
            (i32::MAX, Finding::Unclear),
        ];
        for (volts, finding) in cases {
            assert_eq!(d0.judge_network(Microvolts(volts)), finding, "{volts}");
            assert_eq!(finding.is_fault(), finding != Finding::Connected);
        }
        let cases = [
            (124_999, Finding::LowRail),
            (125_000, Finding::Connected),
            (4_875_000, Finding::Connected),
            (4_875_001, Finding::HighRail),
        ];
        for (volts, finding) in cases {
            assert_eq!(
                d0.judge_converter(Microvolts(volts), Range::Large),
                Some(finding)
            );
        }
        assert_eq!(
            prepare(all()[2]).judge_converter(Microvolts::ZERO, Range::Small),
            None
        );
    }

    #[test]
    fn open_is_reported_with_the_second_reading_and_cleared_with_the_tenth() {
        let (config, thresholds) = (OpenSensorConfig::default(), prepare(all()[0]));
        let mut sensor = OpenSensor::default();
        let (open, well) = (network_output_open(), network_output(millivolts(2_500)));
        let mut now = 0;
        let mut feed = |sensor: &mut OpenSensor, volts| {
            now += 20_000;
            sensor.on_network(&config, &thresholds, volts, at(now));
            sensor.finding(Range::Small)
        };
        assert_eq!(feed(&mut sensor, well), Finding::Connected);
        assert_eq!(feed(&mut sensor, open), Finding::Connected);
        // A good reading between them starts anew.
        assert_eq!(feed(&mut sensor, well), Finding::Connected);
        assert_eq!(feed(&mut sensor, open), Finding::Connected);
        assert_eq!(feed(&mut sensor, open), Finding::Open);
        assert_eq!(sensor.validity(Range::Small), Validity::OPEN);
        assert_eq!(sensor.validity(Range::Large), Validity::VALID);
        for _ in 0..9 {
            assert_eq!(feed(&mut sensor, well), Finding::Open);
        }
        // A faulty one starts the way back anew, and names the latest finding.
        assert_eq!(feed(&mut sensor, millivolts(1_650)), Finding::LowRail);
        for _ in 0..9 {
            assert_eq!(feed(&mut sensor, well), Finding::LowRail);
        }
        assert_eq!(feed(&mut sensor, well), Finding::Connected);
        assert_eq!(sensor.validity(Range::Small), Validity::VALID);
    }

    #[test]
    fn debounce_asks_for_count_and_time() {
        let config = OpenSensorConfig {
            set_count: 3,
            set_time_ms: 10,
            clear_count: 2,
            clear_time_ms: 5,
            ..OpenSensorConfig::default()
        };
        let mut debounced = Debounced::new();
        let mut step = |us, finding| {
            debounced.step(&config, finding, at(us));
            debounced.finding.is_fault()
        };
        // Enough readings, too short.
        assert!(!step(1_000, Finding::Open));
        assert!(!step(2_000, Finding::Open));
        assert!(!step(3_000, Finding::Open));
        assert!(!step(10_999, Finding::Open));
        assert!(step(11_000, Finding::Open));
        assert!(step(20_000, Finding::Connected));
        assert!(step(24_999, Finding::Connected));
        assert!(!step(25_000, Finding::Connected));
        // Long enough, too few readings.
        assert!(!step(30_000, Finding::HighRail));
        assert!(!step(50_000, Finding::HighRail));
        // The same reading again, or an older one, does not count.
        assert!(!step(50_000, Finding::HighRail));
        assert!(!step(49_000, Finding::HighRail));
        assert!(step(50_001, Finding::HighRail));
    }

    #[test]
    fn rails_are_found_on_the_converter_within_two_samples() {
        let (config, thresholds) = (OpenSensorConfig::default(), prepare(all()[0]));
        for (volts, finding) in [(0, Finding::LowRail), (5_000, Finding::HighRail)] {
            let mut sensor = OpenSensor::new();
            for us in 1..=2 {
                assert_eq!(sensor.finding(Range::Large), Finding::Connected);
                let rail = reading(millivolts(volts), us, Range::Large, Validity::SATURATED);
                sensor.on_converter(&config, &thresholds, &rail);
            }
            assert_eq!(sensor.finding(Range::Large), finding);
            assert_eq!(sensor.validity(Range::Large), Validity::OPEN);
            // The other sensor is not touched, and the finding waits for its sensor.
            assert_eq!(sensor.finding(Range::Small), Finding::Connected);
            for us in 3..=50 {
                let well = reading(millivolts(2_500), us * 1_000, Range::Small, Validity::VALID);
                sensor.on_converter(&config, &thresholds, &well);
            }
            assert_eq!(sensor.finding(Range::Large), finding);
        }
    }

    #[test]
    fn small_sensor_is_watched_by_both_and_the_network_comes_first() {
        let (config, thresholds) = (OpenSensorConfig::default(), prepare(all()[0]));
        let mut sensor = OpenSensor::new();
        for us in 1..=2 {
            let rail = reading(Microvolts::ZERO, us, Range::Small, Validity::SATURATED);
            sensor.on_converter(&config, &thresholds, &rail);
        }
        assert_eq!(sensor.finding(Range::Small), Finding::LowRail);
        for us in 1..=2 {
            sensor.on_network(&config, &thresholds, network_output_open(), at(us));
        }
        assert_eq!(sensor.finding(Range::Small), Finding::Open);
    }

    #[test]
    fn readings_without_a_signal_say_nothing() {
        let (config, thresholds) = (OpenSensorConfig::default(), prepare(all()[0]));
        let silent = [
            Validity::CHIP_FAULT,
            Validity::STALE,
            Validity::RANGE_CHANGE,
        ];
        let mut sensor = OpenSensor::new();
        for (us, cause) in silent.iter().cycle().take(12).enumerate() {
            let rail = reading(Microvolts::ZERO, us as u64 + 1, Range::Small, *cause);
            sensor.on_converter(&config, &thresholds, &rail);
        }
        assert_eq!(sensor.finding(Range::Small), Finding::Connected);
        // With D3 the converter is the network itself.
        let d3 = prepare(all()[2]);
        for us in 20..30 {
            let rail = reading(Microvolts::ZERO, us, Range::Small, Validity::VALID);
            sensor.on_converter(&config, &d3, &rail);
        }
        assert_eq!(sensor.finding(Range::Small), Finding::Connected);
    }

    #[test]
    fn limits_of_the_configuration() {
        let default = OpenSensorConfig::default();
        for front_end in all() {
            assert!(default.is_valid(&front_end));
        }
        let d0 = all()[0];
        let with = |change: &dyn Fn(&mut OpenSensorConfig)| {
            let mut config = default;
            change(&mut config);
            config.is_valid(&d0)
        };
        assert!(!with(&|c| c.set_count = 0) && !with(&|c| c.clear_count = 0));
        assert!(!with(&|c| c.set_time_ms = 10_001) && !with(&|c| c.clear_time_ms = 10_001));
        assert!(with(&|c| c.set_time_ms = 10_000) && with(&|c| c.clear_time_ms = 10_000));
        let threshold = |volts| with(&|c| c.open_below = Some(Microvolts(volts)));
        assert!(!threshold(148_125) && threshold(148_126));
        assert!(!threshold(1_706_250) && threshold(1_706_249));
    }

    proptest! {
        /// No current inside the range and no permitted supply looks like a fault, on either channel.
        #[test]
        fn a_connected_sensor_is_never_reported(
            index in 0..4_usize, range in any_range(), share in -1.0..=1.0_f64, supply in 4_500_000..=5_500_000
        ) {
            let front_end = *all().get(index).unwrap();
            let supply = Microvolts(supply);
            let full_scale = f64::from(front_end.full_scale(range).get());
            #[allow(clippy::cast_possible_truncation)]
            let signal = front_end.voltage(Microamps((share * full_scale) as i32), range, supply);
            let thresholds = OpenSensorThresholds::prepare(&OpenSensorConfig::default(), &front_end, Some(supply));
            let at_sensor = match front_end {
                FrontEnd::DualRange(_) | FrontEnd::Hah1bv(_) => {
                    Microvolts(clamp_i32(i64::from(signal.get()) * i64::from(supply.get()) / 5_000_000))
                }
                _ => signal,
            };
            let at_pin = if index == 2 { signal } else { network_output(at_sensor) };
            prop_assert_eq!(thresholds.judge_network(at_pin), Finding::Connected);
            if index != 2 {
                prop_assert_eq!(thresholds.judge_converter(signal, range), Some(Finding::Connected));
                // And both rails do.
                prop_assert_eq!(thresholds.judge_network(network_output(supply)), Finding::HighRail);
                prop_assert_eq!(thresholds.judge_network(network_output(Microvolts::ZERO)), Finding::LowRail);
            }
            prop_assert_eq!(thresholds.judge_network(network_output_open()), Finding::Open);
        }

        #[test]
        fn more_at_the_sensor_is_more_at_the_pin(hall in -5_000_000..5_000_000, more in 5..1_000_000) {
            prop_assert!(network_output(Microvolts(hall)) < network_output(Microvolts(hall + more)));
            let exact = 0.225 * f64::from(hall) + 1_650_000.0;
            prop_assert!((f64::from(network_output(Microvolts(hall)).get()) - exact).abs() <= 0.501);
        }

        #[test]
        fn nothing_panics(
            front_end in any_front_end(), config in any::<(Option<i32>, u8, u32, u8, u32)>(), supply: Option<i32>,
            readings in prop::collection::vec((any::<i32>(), any::<u64>(), any_range(), any_validity()), 1..20)
        ) {
            let (open_below, set_count, set_time_ms, clear_count, clear_time_ms) = config;
            let config = OpenSensorConfig {
                open_below: open_below.map(Microvolts), set_count, set_time_ms, clear_count, clear_time_ms
            };
            let _ = config.is_valid(&front_end);
            let thresholds = OpenSensorThresholds::prepare(&config, &front_end, supply.map(Microvolts));
            let mut sensor = OpenSensor::new();
            for (volts, us, range, validity) in readings {
                sensor.on_network(&config, &thresholds, Microvolts(volts), at(us));
                sensor.on_converter(&config, &thresholds, &reading(Microvolts(volts), us, range, validity));
                let _ = (sensor.validity(range), network_output(Microvolts(volts)));
            }
        }
    }
}
