//! The error budget: every term that stands between the conductor's charge and the reported one, each worked out from
//! `design_parameters`, and their sums.
//!
//! Two parts are kept apart. The *ideal-sensor* part (quantisation, hand-over, no-load threshold, time base) is what the
//! board adds to whatever its sensors deliver; the property tests of the charge hold the code to it. The rest is
//! proportional to the reading or a current at its zero, and belongs to sensor, supply, reference and divider.
//!
//! `docs/error-budget.md` carries the table that [`write_markdown`] makes; a test compares them.

use core::fmt::{self, Write};

use crate::design_parameters as design;
use crate::front_end::PerRange;
use crate::meter::MeterConfig;
use crate::range::Range;
use crate::units::{Duration, Microamps, Nanocoulombs, Ppm, clamp_i64, div_round};

/// In what a term counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unit {
    /// Millionths of the reading.
    PpmOfReading,
    /// A current that is always there, in µA of the small range; ten times that in the large one.
    Microamps,
    /// A current that is missing while the current is below it, in µA.
    MicroampsBelowThreshold,
    /// Charge per range edge, in nC.
    NanocoulombsPerEdge,
    /// Charge once over the whole run, in nC.
    NanocoulombsOnce,
    /// Worst error of a single conversion, in µA; its mean is zero and it does not reach the meter's charge.
    MicroampsPerConversion,
}

impl Unit {
    /// As the table writes it.
    #[must_use]
    pub const fn symbol(self) -> &'static str {
        match self {
            Self::PpmOfReading => "ppm of reading",
            Self::Microamps => "µA, ±60 A range",
            Self::MicroampsBelowThreshold => "µA, below it only",
            Self::NanocoulombsPerEdge => "nC per edge",
            Self::NanocoulombsOnce => "nC once",
            Self::MicroampsPerConversion => "µA per conversion",
        }
    }
}

/// One line of the budget.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Term {
    /// What errs.
    pub name: &'static str,
    /// Where the figure comes from.
    pub source: &'static str,
    /// How it was worked out.
    pub calculation: &'static str,
    /// The worst case.
    pub value: i64,
    /// Its unit.
    pub unit: Unit,
    /// Whether a figure in it still waits for a bench or a data sheet.
    pub assumed: bool,
    /// Whether the board makes this error behind ideal sensors as well.
    pub ideal_sensor: bool,
}

/// Charge of one count with the dual-range front end as designed.
#[must_use]
pub const fn charge_per_count(range: Range) -> Nanocoulombs {
    MeterConfig::full_scale_for(PerRange {
        small: design::SMALL_FULL_SCALE,
        large: design::LARGE_FULL_SCALE,
    })
    .charge_per_count(range)
}

/// The sensor's share of its reading (D2: HAH1BV 0.5 %).
#[must_use]
pub const fn sensor() -> i64 {
    design::SENSOR_ACCURACY.get() as i64
}

/// What is left of the supply in the sensitivity after it was measured.
#[must_use]
pub const fn supply_gain() -> i64 {
    design::SUPPLY_RESIDUAL.get() as i64
}

/// What is left of it at 0 A: the same share of 2.5 V, in the small sensor's current.
#[must_use]
pub const fn supply_zero() -> i64 {
    let microvolts_at_zero =
        design::SENSOR_ZERO.get() as i64 * design::SUPPLY_RESIDUAL.get() as i64 / 1_000_000;
    small_current(microvolts_at_zero)
}

/// The reference enters the meter's scale once (`meter`).
#[must_use]
pub const fn reference() -> i64 {
    design::REFERENCE_TOLERANCE.get() as i64
}

/// Two resistors against each other; the ratio 0.1 V / 2.5 V damps their error by 1 − 0.04.
#[must_use]
pub const fn divider() -> i64 {
    divided(2 * design::DIVIDER_TOLERANCE.get() as i64)
}

/// Drift of reference and divider over the temperature span.
#[must_use]
pub const fn temperature_meter() -> i64 {
    let span = design::TEMPERATURE_SPAN_KELVIN;
    (design::REFERENCE_PPM_PER_KELVIN + divided(2 * design::DIVIDER_PPM_PER_KELVIN)) * span
}

/// Drift of the sensor's sensitivity over the temperature span.
#[must_use]
pub const fn temperature_sensor() -> i64 {
    design::SENSOR_PPM_PER_KELVIN * design::TEMPERATURE_SPAN_KELVIN
}

/// Drift of the sensor's zero over it, in the small sensor's current.
#[must_use]
pub const fn temperature_zero() -> i64 {
    small_current(design::SENSOR_ZERO_MICROVOLTS_PER_KELVIN * design::TEMPERATURE_SPAN_KELVIN)
}

/// The meter's crystal: it counts by its own clock.
#[must_use]
pub const fn time_base() -> i64 {
    design::CRYSTAL_TOLERANCE.get() as i64
}

/// Half a code of the converter at 32 SPS: 13 bits for 0 … 5 V, in the small sensor's current.
#[must_use]
pub const fn quantisation_converter() -> i64 {
    div_round(
        small_current(design::CONVERTER_NOMINAL_SUPPLY.get() as i64),
        2 << 13,
    )
}

/// Half a count at the start and half a count at the end, of the large range.
#[must_use]
pub const fn quantisation_meter() -> i64 {
    charge_per_count(Range::Large).get()
}

/// What the meter may leave out below its no-load threshold, in the small range.
#[must_use]
pub const fn no_load() -> i64 {
    design::SMALL_FULL_SCALE.get() as i64 * design::METER_NO_LOAD.get() as i64 / 1_000_000
}

/// The hidden bits at a change of scale.
#[must_use]
pub const fn hand_over_hidden() -> i64 {
    (charge_per_count(Range::Large).get() - charge_per_count(Range::Small).get() + 1) / 2
}

/// What is left of the counts between edge and snapshot: tolerance of the switching current, its slew and the delay of
/// the time stamp, for the worse direction, into the small range.
#[must_use]
pub const fn hand_over_latency() -> i64 {
    let time = design::SNAPSHOT_DEADLINE_US as i64;
    let picocoulombs = design::SWITCHING_TOLERANCE.get() as i64 * time
        + design::SLEW_LIMIT_AMPS_PER_SECOND as i64 * time * time / 2
        + design::SWITCHING_CURRENT.get() as i64 * design::EDGE_STAMP_DELAY_US as i64;
    div_round((RATIO - 1) * picocoulombs, 1_000)
}

/// The large range is that many times the small one.
const RATIO: i64 = design::LARGE_FULL_SCALE.get() as i64 / design::SMALL_FULL_SCALE.get() as i64;

/// A signal of the small sensor, in µV above its zero, as a current in µA.
const fn small_current(microvolts: i64) -> i64 {
    div_round(
        microvolts * design::SMALL_FULL_SCALE.get() as i64,
        design::DUAL_RANGE_SWING.get() as i64,
    )
}

/// An error of the two divider resistors against each other, as an error of the divided voltage.
const fn divided(error: i64) -> i64 {
    let reference = design::REFERENCE.get() as i64;
    div_round(
        error * (reference - design::METER_CHANNEL_2.get() as i64),
        reference,
    )
}

/// The budget of the dual-range front end.
pub const TERMS: [Term; 15] = [
    Term {
        name: "sensor",
        source: "D2, HAH1BV S/02",
        calculation: "0.5 %; the D0 pair is taken to be alike",
        value: sensor(),
        unit: Unit::PpmOfReading,
        assumed: true,
        ideal_sensor: false,
    },
    Term {
        name: "supply, sensitivity",
        source: "D4",
        calculation: "what a measured supply leaves, 0.1 %",
        value: supply_gain(),
        unit: Unit::PpmOfReading,
        assumed: true,
        ideal_sensor: false,
    },
    Term {
        name: "supply, zero",
        source: "D4",
        calculation: "0.1 % · 2.5 V · 60 A / 2.25 V",
        value: supply_zero(),
        unit: Unit::Microamps,
        assumed: true,
        ideal_sensor: false,
    },
    Term {
        name: "reference",
        source: "D1, MAX6173",
        calculation: "0.06 %, once: REF and V2 come from the same voltage",
        value: reference(),
        unit: Unit::PpmOfReading,
        assumed: false,
        ideal_sensor: false,
    },
    Term {
        name: "divider",
        source: "D1, 0.1 % resistors",
        calculation: "2 · 0.1 % · (1 − 0.1 V / 2.5 V)",
        value: divider(),
        unit: Unit::PpmOfReading,
        assumed: false,
        ideal_sensor: false,
    },
    Term {
        name: "temperature, reference and divider",
        source: "D1, MAX6173, 10 ppm resistors",
        calculation: "(3 + 2 · 10 · 0.96 ppm/K, rounded) · 60 K",
        value: temperature_meter(),
        unit: Unit::PpmOfReading,
        assumed: false,
        ideal_sensor: false,
    },
    Term {
        name: "temperature, sensor",
        source: "HAH1BV family",
        calculation: "0.03 %/K · 60 K",
        value: temperature_sensor(),
        unit: Unit::PpmOfReading,
        assumed: true,
        ideal_sensor: false,
    },
    Term {
        name: "temperature, sensor's zero",
        source: "HAH1BV family, after compensation at 25 °C",
        calculation: "80 µV/K · 60 K · 60 A / 2.25 V",
        value: temperature_zero(),
        unit: Unit::Microamps,
        assumed: true,
        ideal_sensor: false,
    },
    Term {
        name: "time base",
        source: "crystal of the ADE7753",
        calculation: "50 ppm tolerance + 50 ppm drift",
        value: time_base(),
        unit: Unit::PpmOfReading,
        assumed: true,
        ideal_sensor: true,
    },
    Term {
        name: "quantisation, converter",
        source: "ADS1100 (SBAS239), D0",
        calculation: "5 V / 2¹³ / 2 · 60 A / 2.25 V",
        value: quantisation_converter(),
        unit: Unit::MicroampsPerConversion,
        assumed: false,
        ideal_sensor: true,
    },
    Term {
        name: "quantisation, meter",
        source: "ADE7753 Rev C, energy calculation",
        calculation: "½ count at start and end, 600 A / 8,949 counts/s",
        value: quantisation_meter(),
        unit: Unit::NanocoulombsOnce,
        assumed: false,
        ideal_sensor: true,
    },
    Term {
        name: "integration, no-load threshold",
        source: "ADE7753 Rev C, features",
        calculation: "0.005 % of channel 1 · 60 A",
        value: no_load(),
        unit: Unit::MicroampsBelowThreshold,
        assumed: true,
        ideal_sensor: true,
    },
    Term {
        name: "hand-over, hidden bits",
        source: "ADE7753 Rev C, energy calculation",
        calculation: "½ · (67.0 mC − 6.70 mC)",
        value: hand_over_hidden(),
        unit: Unit::NanocoulombsPerEdge,
        assumed: false,
        ideal_sensor: true,
    },
    Term {
        name: "hand-over, latency",
        source: "D0, board",
        calculation: "9 · (1 A · 100 µs + 10 kA/s · (100 µs)² / 2 + 53.3 A · 5 µs)",
        value: hand_over_latency(),
        unit: Unit::NanocoulombsPerEdge,
        assumed: true,
        ideal_sensor: true,
    },
    Term {
        name: "zero of the meter's channel 1",
        source: "board, after calibration",
        calculation: "0.1 % of 60 A",
        value: meter_zero(),
        unit: Unit::Microamps,
        assumed: true,
        ideal_sensor: false,
    },
];

/// What calibration leaves of channel 1's zero, in the small range.
#[must_use]
pub const fn meter_zero() -> i64 {
    design::SMALL_FULL_SCALE.get() as i64 * design::METER_ZERO_RESIDUAL.get() as i64 / 1_000_000
}

/// How far meter and converter may differ, in proportion to the current: everything that only one of the two passes
/// through.
pub const CHANNEL_GAIN_TOLERANCE: Ppm = {
    #[expect(clippy::cast_possible_truncation, reason = "a sum of small constants")]
    Ppm(
        (reference() + divider() + temperature_meter() + supply_gain() + time_base()) as i32
            + design::CONVERTER_GAIN_TOLERANCE.get(),
    )
};

/// How far they may differ at 0 A: zero of the meter's channel, half a code, and the supply, which the converter
/// divides out and the meter does not.
pub const CHANNEL_ZERO_TOLERANCE: PerRange<Microamps> = {
    let small = meter_zero() + quantisation_converter() + supply_zero();
    #[expect(clippy::cast_possible_truncation, reason = "a sum of small constants")]
    PerRange {
        small: Microamps(small as i32),
        large: Microamps((small * RATIO) as i32),
    }
};

/// What a bound needs to know of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ProfileSummary {
    /// How long it lasted …
    pub duration: Duration,
    /// … and how much of that in the large range.
    pub in_large: Duration,
    /// Its rms current: duration times this is at least the magnitude of its charge.
    pub rms_current: Microamps,
    /// Range edges that were handed over one at a time.
    pub edges: u32,
    /// Time with a current below the no-load threshold.
    pub below_no_load: Duration,
    /// Time in short intervals at edges, where the current is at the threshold …
    pub chatter: Duration,
    /// … how many unbroken runs of them there were …
    pub chatter_runs: u32,
    /// … and the sum, over them, of the squared times from the newest edge to the interval's two ends, in µs².
    pub chatter_squares: u64,
}

/// Bounds of the error of a charge.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ChargeBound {
    /// Worst case behind ideal sensors.
    pub ideal_sensor: Nanocoulombs,
    /// Worst case of everything: the terms added.
    pub worst_case: Nanocoulombs,
    /// The terms' root of the sum of squares; edges count as independent of each other.
    pub rss: Nanocoulombs,
}

/// The bounds for a run of the dual-range front end.
#[must_use]
pub fn charge_bound(profile: &ProfileSummary) -> ChargeBound {
    let mut sums = Sums::default();
    let time = profile.duration;
    let throughput = charge_of(profile.rms_current, time);
    for term in &TERMS {
        let value = i128::from(term.value);
        match term.unit {
            Unit::PpmOfReading => {
                sums.add(
                    throughput.saturating_mul(value) / 1_000_000,
                    1,
                    term.ideal_sensor,
                );
            }
            Unit::Microamps => {
                let large = i128::from(profile.in_large.as_ticks());
                let small = i128::from(time.saturating_sub(profile.in_large).as_ticks());
                let weighted = small + i128::from(RATIO) * large;
                sums.add(value * weighted / 1_000, 1, term.ideal_sensor);
            }
            Unit::MicroampsBelowThreshold => sums.add(
                value * i128::from(profile.below_no_load.as_ticks()) / 1_000,
                1,
                term.ideal_sensor,
            ),
            Unit::NanocoulombsPerEdge => sums.add(value, profile.edges, term.ideal_sensor),
            Unit::NanocoulombsOnce => sums.add(value, 1, term.ideal_sensor),
            Unit::MicroampsPerConversion => {}
        }
    }
    // Intervals at the threshold: the current lies within the tolerance of the switching current and as far from it as
    // the slew allows, and the counts end and begin anew.
    let chatter = i128::from(profile.chatter.as_ticks());
    let slew =
        i128::from(design::SLEW_LIMIT_AMPS_PER_SECOND) * i128::from(profile.chatter_squares) / 2;
    let off = i128::from(design::SWITCHING_TOLERANCE.get()) * chatter;
    sums.add(off.saturating_add(slew) / 1_000, 1, true);
    sums.add(i128::from(quantisation_meter()), profile.chatter_runs, true);
    // The reported number is rounded.
    sums.add(1, 1, true);
    ChargeBound {
        ideal_sensor: Nanocoulombs(clamp_i64(sums.ideal_sensor)),
        worst_case: Nanocoulombs(clamp_i64(sums.worst_case)),
        rss: Nanocoulombs(clamp_i64(
            i128::try_from(sums.squares.isqrt()).unwrap_or(i128::MAX),
        )),
    }
}

#[derive(Default)]
struct Sums {
    ideal_sensor: i128,
    worst_case: i128,
    squares: u128,
}

impl Sums {
    /// `times` independent errors of `each` nC at worst.
    fn add(&mut self, each: i128, times: u32, ideal_sensor: bool) {
        let sum = each.saturating_abs().saturating_mul(i128::from(times));
        self.worst_case = self.worst_case.saturating_add(sum);
        if ideal_sensor {
            self.ideal_sensor = self.ideal_sensor.saturating_add(sum);
        }
        let square = each.unsigned_abs().saturating_mul(each.unsigned_abs());
        self.squares = self
            .squares
            .saturating_add(square.saturating_mul(u128::from(times)));
    }
}

/// Charge in nC.
fn charge_of(current: Microamps, time: Duration) -> i128 {
    i128::from(current.get()).abs() * i128::from(time.as_ticks()) / 1_000
}

/// The sum of the terms in proportion to the reading, worst case and root of the sum of squares.
#[must_use]
pub fn proportional() -> (Ppm, Ppm) {
    let ppm = || {
        TERMS
            .iter()
            .filter(|term| term.unit == Unit::PpmOfReading)
            .map(|term| term.value)
    };
    let squares: i64 = ppm().map(|value| value * value).sum();
    (
        Ppm(crate::units::clamp_i32(ppm().sum())),
        Ppm(crate::units::clamp_i32(squares.isqrt())),
    )
}

/// Writes the budget as a Markdown table and its sums.
///
/// # Errors
///
/// Those of the writer.
pub fn write_markdown(out: &mut impl Write) -> fmt::Result {
    writeln!(
        out,
        "| term | worst case | unit | ideal sensor | calculation | source |"
    )?;
    writeln!(out, "|---|---:|---|---|---|---|")?;
    for term in &TERMS {
        writeln!(
            out,
            "| {}{} | {} | {} | {} | {} | {} |",
            term.name,
            if term.assumed { " (*assumed*)" } else { "" },
            Grouped(term.value),
            term.unit.symbol(),
            if term.ideal_sensor { "yes" } else { "no" },
            term.calculation,
            term.source,
        )?;
    }
    let (worst, rss) = proportional();
    writeln!(out)?;
    writeln!(
        out,
        "In proportion to the reading: {} ppm at worst, {} ppm as root of the sum of squares.",
        Grouped(i64::from(worst.get())),
        Grouped(i64::from(rss.get())),
    )?;
    writeln!(out)?;
    writeln!(
        out,
        "| run | ideal sensor, worst case | everything, worst case | root of squares |"
    )?;
    writeln!(out, "|---|---:|---:|---:|")?;
    for (name, profile) in EXAMPLES {
        let bound = charge_bound(&profile);
        writeln!(
            out,
            "| {name} | {} mC | {} mC | {} mC |",
            Grouped(div_round(bound.ideal_sensor.get(), 1_000_000)),
            Grouped(div_round(bound.worst_case.get(), 1_000_000)),
            Grouped(div_round(bound.rss.get(), 1_000_000)),
        )?;
    }
    Ok(())
}

/// Runs for which the table shows the bounds.
const EXAMPLES: [(&str, ProfileSummary); 3] = [
    ("one hour at 30 A", example(3_600, 30)),
    (
        "one hour at 70 A rms, a thousand range edges, half of it in the large range",
        ProfileSummary {
            in_large: Duration::from_ticks(1_800_000_000),
            edges: 1_000,
            ..example(3_600, 70)
        },
    ),
    (
        "a day parked below the no-load threshold",
        ProfileSummary {
            below_no_load: Duration::from_ticks(86_400_000_000),
            ..example(86_400, 0)
        },
    ),
];

const fn example(seconds: u64, amps: i32) -> ProfileSummary {
    ProfileSummary {
        duration: Duration::from_ticks(seconds * 1_000_000),
        in_large: Duration::from_ticks(0),
        rms_current: Microamps::from_amps(amps),
        edges: 0,
        below_no_load: Duration::from_ticks(0),
        chatter: Duration::from_ticks(0),
        chatter_runs: 0,
        chatter_squares: 0,
    }
}

/// A number with its thousands apart.
struct Grouped(i64);

impl fmt::Display for Grouped {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (mut group, mut rest) = (1_i64, self.0.unsigned_abs());
        if self.0 < 0 {
            f.write_str("-")?;
        }
        while rest >= 1_000 {
            rest /= 1_000;
            group = group.saturating_mul(1_000);
        }
        write!(f, "{rest}")?;
        while group > 1 {
            let below = self.0.unsigned_abs() % group.unsigned_abs();
            group /= 1_000;
            write!(f, ",{:03}", below / group.unsigned_abs())?;
        }
        Ok(())
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::cast_precision_loss)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::string::String;

    /// From the sources' own figures, in floating point.
    #[test]
    fn each_term_is_what_its_calculation_says() {
        let near = |value: i64, expected: f64| {
            assert!(
                (value as f64 - expected).abs() <= 0.5 + expected.abs() * 1e-7,
                "{value} {expected}"
            );
        };
        near(sensor(), 5_000.0);
        near(supply_gain(), 1_000.0);
        near(supply_zero(), 1e-3 * 2.5 * 60.0 / 2.25 * 1e6);
        near(reference(), 600.0);
        near(divider(), 2_000.0 * (1.0 - 0.1 / 2.5));
        near(temperature_meter(), (3.0 + 19.0) * 60.0);
        near(temperature_sensor(), 300.0 * 60.0);
        near(temperature_zero(), 80e-6 * 60.0 * 60.0 / 2.25 * 1e6);
        near(time_base(), 100.0);
        near(
            quantisation_converter(),
            5.0 / 8_192.0 / 2.0 * 60.0 / 2.25 * 1e6,
        );
        let counts = 1_677_722.0 * 0.2 * (3_579_545.0 / 4.0) / 2f64.powi(25);
        near(charge_per_count(Range::Small).get(), 60.0 / counts * 1e9);
        near(quantisation_meter(), 600.0 / counts * 1e9);
        near(no_load(), 3_000.0);
        near(hand_over_hidden(), 0.5 * 540.0 / counts * 1e9);
        near(
            hand_over_latency(),
            9.0 * (1.0 * 100e-6 + 1e4 * 1e-8 / 2.0 + 160.0 / 3.0 * 5e-6) * 1e9,
        );
        near(meter_zero(), 60_000.0);
    }

    #[test]
    fn the_table_holds_each_term_once() {
        let value = |name: &str| TERMS.iter().find(|term| term.name == name).unwrap().value;
        for (name, expected) in [
            ("sensor", sensor()),
            ("supply, sensitivity", supply_gain()),
            ("supply, zero", supply_zero()),
            ("reference", reference()),
            ("divider", divider()),
            ("temperature, reference and divider", temperature_meter()),
            ("temperature, sensor", temperature_sensor()),
            ("temperature, sensor's zero", temperature_zero()),
            ("time base", time_base()),
            ("quantisation, converter", quantisation_converter()),
            ("quantisation, meter", quantisation_meter()),
            ("integration, no-load threshold", no_load()),
            ("hand-over, hidden bits", hand_over_hidden()),
            ("hand-over, latency", hand_over_latency()),
            ("zero of the meter's channel 1", meter_zero()),
        ] {
            assert_eq!(value(name), expected, "{name}");
        }
    }

    #[test]
    fn proportional_terms_add_up() {
        let terms = [
            5_000.0, 1_000.0, 600.0, 1_920.0, 1_320.0, 18_000.0, 100.0_f64,
        ];
        let (worst, rss) = proportional();
        assert_eq!(f64::from(worst.get()), terms.iter().sum::<f64>());
        let squares: f64 = terms.iter().map(|term| term * term).sum();
        assert!((f64::from(rss.get()) - squares.sqrt()).abs() <= 1.0);
    }

    #[test]
    fn channels_differ_by_what_only_one_of_them_passes_through() {
        assert_eq!(
            CHANNEL_GAIN_TOLERANCE,
            Ppm(600 + 1_920 + 1_320 + 1_000 + 100 + 3_000)
        );
        assert_eq!(
            CHANNEL_ZERO_TOLERANCE.small,
            Microamps(60_000 + 8_138 + 66_667)
        );
        assert_eq!(
            CHANNEL_ZERO_TOLERANCE.large.get(),
            10 * CHANNEL_ZERO_TOLERANCE.small.get()
        );
    }

    #[test]
    fn a_bound_adds_its_terms() {
        let once = quantisation_meter() + 1;
        let nothing = example(0, 0);
        assert_eq!(charge_bound(&nothing).ideal_sensor.get(), once);
        assert_eq!(charge_bound(&nothing).worst_case.get(), once);
        // Edges.
        let edges = ProfileSummary {
            edges: 7,
            ..nothing
        };
        let per_edge = hand_over_hidden() + hand_over_latency();
        assert_eq!(charge_bound(&edges).ideal_sensor.get(), once + 7 * per_edge);
        // 100 ppm of 10 A · 100 s, and the rest in proportion; zeros of 60 + 128 + 66.7 mA over 100 s.
        let run = example(100, 10);
        let bound = charge_bound(&run);
        assert_eq!(bound.ideal_sensor.get(), once + 100_000_000);
        let zeros = (meter_zero() + supply_zero() + temperature_zero()) * 100_000;
        let worst = once + 27_940 * 1_000_000 + zeros;
        assert_eq!(bound.worst_case.get(), worst);
        assert!(bound.rss < bound.worst_case && bound.rss.get() > 18_862 * 1_000_000);
        // Ten times the zeros in the large range.
        let large = ProfileSummary {
            in_large: Duration::from_ticks(40_000_000),
            ..run
        };
        assert_eq!(
            charge_bound(&large).worst_case.get(),
            worst + zeros * 9 * 4 / 10
        );
        // 3 mA over 10 s.
        let parked = ProfileSummary {
            below_no_load: Duration::from_ticks(10_000_000),
            ..nothing
        };
        assert_eq!(charge_bound(&parked).ideal_sensor.get(), once + 30_000_000);
        // 1 A over 3 ms, 10 kA/s · 8 µs² / 2 · 10⁶, and two counts anew.
        let chatter = ProfileSummary {
            chatter: Duration::from_ticks(3_000),
            chatter_runs: 2,
            chatter_squares: 8_000_000,
            ..nothing
        };
        assert_eq!(
            charge_bound(&chatter).ideal_sensor.get(),
            once + 3_000_000 + 40_000_000 + 2 * quantisation_meter()
        );
    }

    #[test]
    fn independent_edges_grow_with_their_root() {
        let root = |edges: u32| {
            let profile = ProfileSummary {
                edges,
                ..example(0, 0)
            };
            charge_bound(&profile).rss.get() as f64
        };
        let per_edge = (hand_over_hidden() as f64).hypot(hand_over_latency() as f64);
        let expected = (per_edge * 100.0).hypot(quantisation_meter() as f64);
        assert!((root(10_000) - expected).abs() < 2.0 + expected * 1e-9);
    }

    #[test]
    fn numbers_are_grouped_by_thousands() {
        for (number, text) in [
            (0, "0"),
            (999, "999"),
            (1_000, "1,000"),
            (-12_005, "-12,005"),
            (1_020_300, "1,020,300"),
            (i64::MIN, "-9,223,372,036,854,775,808"),
        ] {
            assert_eq!(std::format!("{}", Grouped(number)), text);
        }
    }

    #[test]
    fn the_table_is_whole() {
        let mut table = String::new();
        write_markdown(&mut table).unwrap();
        let rows = table.lines().filter(|line| line.starts_with("| ")).count();
        assert_eq!(rows, 1 + TERMS.len() + 1 + EXAMPLES.len());
        assert!(table.contains("| reference | 600 | ppm of reading | no |"));
        assert!(table.contains("| time base (*assumed*) | 100 | ppm of reading | yes |"));
        assert!(table.contains("27,940 ppm at worst, 18,862 ppm as root"));
        let units = [
            Unit::PpmOfReading,
            Unit::Microamps,
            Unit::MicroampsBelowThreshold,
            Unit::NanocoulombsPerEdge,
            Unit::NanocoulombsOnce,
            Unit::MicroampsPerConversion,
        ];
        for unit in units {
            assert!(table.contains(unit.symbol()) && !unit.symbol().is_empty());
        }
    }

    proptest! {
        #[test]
        fn no_profile_panics_and_more_of_anything_is_no_less(
            times: [u64; 3], rms: i32, edges: u32, runs: u32, squares: u64,
        ) {
            let profile = ProfileSummary {
                duration: Duration::from_ticks(times[0]),
                in_large: Duration::from_ticks(times[1]),
                rms_current: Microamps(rms),
                edges,
                below_no_load: Duration::from_ticks(times[2]),
                chatter: Duration::from_ticks(times[1]),
                chatter_runs: runs,
                chatter_squares: squares,
            };
            let bound = charge_bound(&profile);
            prop_assert!(bound.worst_case >= bound.ideal_sensor);
            prop_assert!(bound.worst_case >= bound.rss);
            let more = charge_bound(&ProfileSummary { edges: edges.saturating_add(1), ..profile });
            prop_assert!(more.ideal_sensor >= bound.ideal_sensor);
        }
    }
}
