//! D1: charge from the energy meter's accumulator.
//!
//! # Scale
//!
//! The ADE7753 adds up V1·V2/Vref² (ADE7753 Rev C, energy calculation: both converters work against the reference).
//! V2 = Vref·ratio is divided from the same reference (D1), so one power of the reference cancels:
//! counts/s = K · V1 · ratio / Vref. A reference that is high by r and a divider that is high by d make the meter count
//! (1 + d)/(1 + r) times as fast, and the charge of one count is
//!
//! full scale / (counts/s at full scale) · (1 + gain) · (1 + r) / (1 + d).
//!
//! It is kept in units of 2⁻²⁴ pC (6·10⁻¹¹ nC): one count of the ±60 A range is 1.1·10¹⁷ of them, so rounding costs the
//! scale less than 2·10⁻¹⁷ of itself. All products are exact in that unit, and so is an offset in µA times a time in
//! µs, which is a pC. The remainder below one nC is carried in the same unit. Nothing is ever rounded while summing:
//! a year of discharge at 250 A (7.9·10⁹ C, most of what the type holds) is off by less than 10 nC, all of it from the
//! scale's own last digit.
//!
//! # Sign
//!
//! V1 is wired so that a positive current, a discharge, counts up.
//!
//! # Hand-over at a range edge
//!
//! AENERGY is the upper 24 of 49 bits. Between readings in one range the hidden bits do not matter, since differences
//! telescope. At a change of scale the hidden fraction f of a count, taken over from one scale to the other, is
//! misjudged by f·(old scale − new scale), with f uniform in [0, 1). Their means ½·(old − new) telescope as well and
//! cancel against the fractions at the run's two ends; an interval whose charge does not come from counts has the
//! scale 0 in this. So the plain sum is unbiased as it is, and adding half a count at every edge would bias it by
//! 30 mC. What is left per edge is ±½·|old − new| = ±30.2 mC.
//!
//! The reading that an edge asks for comes a time u later, and the counts of that time are already of the new scale.
//! At an edge the current is known by definition: ±53.33 A. So the counts of the time u are taken from it:
//! charge = old scale · counts + sign · 53.33 A · u · (1 − old scale / new scale). Without that, 100 µs cost 48 mC at
//! every edge from the large range to the small one. When an edge lies nearer to the interval's begin than to its end,
//! the part before it is estimated instead, by the same formula with the roles exchanged. The sign is that of the
//! stay in the large range, where the current cannot change its sign: a correction waits until a count shows it.
//!
//! # Chatter, and several edges between two readings
//!
//! Nothing says that a flag that chatters does so at its threshold: the comparator may be broken, and the current
//! anywhere. What is known is how long each sensor was passed on. So with a constant current I the counts are
//! I · Σ(tᵢ/sᵢ) and the charge is I · T, hence charge = counts · T / Σ(tᵢ/sᵢ), the counts times the harmonic mean of the
//! scales weighted by time. Where edges were missed, in a storm, the times are those of the counter that the flag gates
//! ([`RangeHistory::high`]).
//!
//! - A count is too coarse for an interval between two edges: 100 µs hold less than one, and each change between scales
//!   would cost its ±30 mC. So a reading less than [`MeterConfig::short_interval_us`] after the last one waits when a stay
//!   as short lies before it, and the next one takes its interval along. Over several periods the mean of the scales is
//!   nearly the same from one interval to the next, and the hidden bits cost little.
//! - Not longer than that either: a change of the current within the interval is not in the formula, and doubted.
//! - One or two edges with a short stay between readings that did not wait: the stay at the switching current, and all
//!   other counts by the other range's scale. That is a crossing of the threshold, or a snapshot that came late.
//!
//! Such intervals are marked as estimated, and their bound is added to [`MeterReport::uncertainty`].
//!
//! # The multiplier's low-pass is off (DISLPF2)
//!
//! LPF2 (−3 dB at 8.9 Hz, τ = 17.9 ms) still holds the old range's product when the scale changes. At 60 A,
//! scaled by the new range, that is 600 A · 0.9 · τ = 9.7 C too much for each change 60 → 600 A and
//! 60 A · 0.9 · τ = 0.97 C too little for each change back. Channel 2 is a constant, so there is no ripple at twice the
//! line frequency for the filter to remove. Correcting it instead, as [`MeterConfig::front_end_delay_us`] does for
//! the short filter in front of the meter, would leave 9 · 17.9 ms = 0.16 C per ampere of doubt about the current at
//! the edge, against the 30 mC of the hidden bits. A bench has to confirm that the gain with the filter off is the
//! gain with it on.

use serde::{Deserialize, Serialize};

use crate::design_parameters as design;
use crate::front_end::PerRange;
use crate::gap::{GapBridge, converter_error};
use crate::range::{Range, RangeHistory, RangeInterval};
use crate::units::{
    Duration, Instant, Microamps, Nanocoulombs, Ppm, abs_i64, abs_i128, add_i64, add_i128,
    clamp_i32, clamp_i64, div_round, div_round_i128, elapsed, milliseconds, mul_div, mul_i128,
    mul_wide, sub_i64, sub_i128,
};

/// Binary digits of a picocoulomb in which charge is summed.
const FRACTION_BITS: u32 = 24;
/// One nC in the unit of the sum and of the factors.
pub const NANOCOULOMB: i64 = 1_000 << FRACTION_BITS;
/// Counts by which a difference may exceed the fastest rate, for the hidden bits at both ends and the time stamps.
pub const RATE_MARGIN_COUNTS: u32 = 4;
/// Readings refused in a row after which the meter counts as lost.
pub const REJECTIONS_UNTIL_LOST: u8 = 3;
/// Shortest interval whose mean current is compared with the one that bridged a gap: half a poll, in which a count is
/// 0.7 A in the small range.
const SHORTEST_MEAN: Duration = Duration::from_ticks(10_000);
/// From the board's start to the meter's first reading when nothing is amiss: the self-test of 100 ms and two polls.
const FIRST_READING: Duration = Duration::from_ticks(200_000);
/// 1.2 times the counts per µs at full scale, with 32 binary digits: the fastest that the meter may appear to count.
/// 1.2 covers the tolerances of gain, reference and divider and an input that clips beyond its full scale.
const FASTEST_COUNTS_PER_US_Q32: u64 = design::METER_COUNTS_PER_SECOND_Q32 * 6 / 5 / 1_000_000;
/// Scales further apart than 1 : 256 belong to no board; the limit keeps every product within 128 bits.
const LARGEST_STEP_Q32: i64 = 256 << 32;
/// Longest interval whose difference is unambiguous at that rate: 2²³ counts, 781 s.
pub const LONGEST_INTERVAL: Duration = Duration::from_ticks(
    (((1 << 23) - 1 - RATE_MARGIN_COUNTS as u64) << 32) / FASTEST_COUNTS_PER_US_Q32,
);

/// The meter's calibration and what its estimates may assume.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct MeterConfig {
    /// Current at which V1 is 0.5 V (`FrontEnd::meter_full_scale`); the same twice with a single sensor.
    pub full_scale: PerRange<Microamps>,
    /// Correction of the reading: what it lacks of the true charge.
    pub gain: PerRange<Ppm>,
    /// Current that the meter counts at 0 A.
    pub offset: PerRange<Microamps>,
    /// Error of the reference voltage (MAX6173: ±600 ppm): measured minus nominal. The rated 0.5 V full scale belongs
    /// to [`design::METER_FULL_SCALE_INPUT`]'s reference; another nominal reference is entered here as well.
    pub reference_error: Ppm,
    /// Error of the divider's ratio that makes 0.1 V for channel 2 (0.1 % resistors).
    pub divider_error: Ppm,
    /// No-load threshold as a share of channel 1's full scale.
    pub no_load: Ppm,
    /// Current at a range edge.
    pub switching_current: Microamps,
    /// Tolerance of that.
    pub switching_tolerance: Microamps,
    /// Fastest change of the current that estimates allow for, in A/s.
    pub slew_limit_amps_per_second: u32,
    /// Intervals with chatter up to this length wait for the next reading, in µs.
    pub short_interval_us: u32,
    /// Delay (first moment of the step response) of the filter between the analog switch and V1, in µs: for that long
    /// the meter still sees the old range after an edge. Exact for edges further apart than the filter remembers.
    pub front_end_delay_us: u32,
    /// Window of the mean current, in ms. One count is 6.7 mA of mean current in 1 s of the ±60 A range.
    pub mean_window_ms: u32,
    /// How far the current that bridges a gap may be off, of its reading …
    pub bridge_gain: Ppm,
    /// … and beside that.
    pub bridge_offset: Microamps,
}

impl MeterConfig {
    /// The board as designed, with these full scales.
    #[must_use]
    pub const fn full_scale_for(full_scale: PerRange<Microamps>) -> Self {
        Self {
            full_scale,
            gain: PerRange::both(Ppm(0)),
            offset: PerRange::both(Microamps(0)),
            reference_error: Ppm(0),
            divider_error: Ppm(0),
            no_load: design::METER_NO_LOAD,
            switching_current: design::SWITCHING_CURRENT,
            switching_tolerance: design::SWITCHING_TOLERANCE,
            slew_limit_amps_per_second: design::SLEW_LIMIT_AMPS_PER_SECOND,
            short_interval_us: design::SHORT_INTERVAL_US,
            front_end_delay_us: 0,
            mean_window_ms: 1_000,
            bridge_gain: design::BRIDGE_GAIN,
            bridge_offset: design::BRIDGE_OFFSET,
        }
    }

    /// Charge of one count in `range`, rounded to a nanocoulomb.
    #[must_use]
    pub const fn charge_per_count(&self, range: Range) -> Nanocoulombs {
        Nanocoulombs(div_round(self.scale(range), NANOCOULOMB))
    }

    /// Mean current below which the meter may count nothing at all.
    #[must_use]
    pub const fn no_load_current(&self, range: Range) -> Microamps {
        Microamps(clamp_i32(mul_div(
            self.full_scale.get(range).get() as i64,
            self.no_load.get() as i64,
            1_000_000,
        )))
    }

    /// Charge of one count in units of 2⁻²⁴ pC; at least 1, so that no configuration can make it a divisor of zero.
    #[inline(never)]
    const fn scale(&self, range: Range) -> i64 {
        const PICOAMPS_BY_INPUT: i64 = 1_000_000
            * design::METER_FULL_SCALE_INPUT.get() as i64
            * design::METER_CLOCKS_PER_ACCUMULATION as i64;
        // µA at full scale · 10⁶ pC/µC / (product · V2 / 0.5 V · CLKIN / 4 / 2²⁵) · 2²⁴: 2¹²¹ at most.
        let numerator = mul_wide(self.full_scale.get(range).get() as i64, PICOAMPS_BY_INPUT)
            << (design::METER_HIDDEN_BITS + FRACTION_BITS);
        let denominator = design::METER_DC_FULL_SCALE_PRODUCT as i128
            * design::METER_CHANNEL_2.get() as i128
            * design::METER_CLKIN_HZ as i128;
        let nominal = clamp_i64(div_round_i128(numerator, denominator));
        let corrected = div_round_i128(
            mul_i128(
                mul_wide(nominal, factor(self.gain.get(range))),
                factor(self.reference_error) as i128,
            ),
            mul_wide(factor(Ppm(0)), factor(self.divider_error)),
        );
        let scale = clamp_i64(corrected);
        if scale < 1 { 1 } else { scale }
    }
}

impl Default for MeterConfig {
    /// The dual-range front end (D0).
    fn default() -> Self {
        Self::full_scale_for(PerRange {
            small: design::SMALL_FULL_SCALE,
            large: design::LARGE_FULL_SCALE,
        })
    }
}

/// 1 + error, in millionths; at least one millionth.
const fn factor(error: Ppm) -> i64 {
    let sum = Ppm::ONE.get() as i64 + error.get() as i64;
    if sum < 1 { 1 } else { sum }
}

/// One reading of AENERGY.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct MeterReading {
    /// The register, sign-extended from 24 bits. Higher bits are ignored.
    pub energy: i32,
    /// When the chip latched it.
    pub at: Instant,
}

/// `later - earlier` of two AENERGY values across the wrap of the 24-bit register: exact while the true difference is
/// below 2²³ either way.
#[must_use]
pub const fn energy_difference(later: i32, earlier: i32) -> i32 {
    (later.wrapping_sub(earlier) << 8) >> 8
}

/// Why a reading was not used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Rejection {
    /// More counts than the meter can make in that time: a corrupted transfer or a reset chip. Read again.
    RateOfChange,
    /// The reading, or its range history, is older than the last.
    TimeBackwards,
    /// So late that the difference is ambiguous: to be handled as a gap.
    TooLate,
    /// The meter is lost: [`MeterChannel::on_meter_restarted`] has to come first.
    Lost,
}

/// What became of a reading.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ReadingOutcome {
    /// The first one: the difference begins here.
    First,
    /// Integrated; every count attributed to its range.
    Integrated,
    /// Integrated by estimate: edges faster than readings, or an edge whose snapshot came late.
    Estimated,
    /// Too short an interval with chatter: the next reading takes it along. It should not be long in coming.
    Waits,
    /// Not used.
    Rejected(Rejection),
}

/// What the meter has counted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct MeterReport {
    /// Time of the newest reading that was used; `None` before the first.
    pub at: Option<Instant>,
    /// That reading's register: it moves by counts alone, the charge by what the offsets have counted as well.
    pub energy: i32,
    /// Net charge; positive is discharged.
    pub charge_total: Nanocoulombs,
    /// Charge that went in, as a positive number.
    pub charge_in: Nanocoulombs,
    /// Charge that went out.
    pub charge_out: Nanocoulombs,
    /// Charge of one count in the present range: the step in which the charge moves.
    pub resolution: Nanocoulombs,
    /// Mean current over the last complete window.
    pub mean_current: Microamps,
    /// That window's length; zero before the first is complete.
    pub mean_over: Duration,
    /// When that window began.
    pub mean_begun: Instant,
    /// The mean is below the no-load threshold: the meter may be counting nothing at all.
    pub below_no_load: bool,
    /// The meter does not count; the charge stands still until it is restarted.
    pub lost: bool,
    /// Readings refused; stops at the type's end, as do all counters here.
    pub rejected: u32,
    /// Range edges whose counts were attributed one by one.
    pub hand_overs: u32,
    /// Intervals whose charge was estimated.
    pub estimated_intervals: u32,
    /// Gaps that were bridged.
    pub gaps: u32,
    /// Times the factors were found damaged, and what was counted by them was counted anew.
    pub damaged: u32,
    /// Bound of the error that hand-overs, estimates and gaps can have made since the start: their worst cases, added.
    /// Sensor, reference and the other errors proportional to the reading are not in it (`error_budget`).
    pub uncertainty: Nanocoulombs,
}

impl Default for MeterReport {
    /// Before the first reading.
    fn default() -> Self {
        Self {
            at: None,
            energy: 0,
            charge_total: Nanocoulombs::ZERO,
            charge_in: Nanocoulombs::ZERO,
            charge_out: Nanocoulombs::ZERO,
            resolution: Nanocoulombs::ZERO,
            mean_current: Microamps::ZERO,
            mean_over: Duration::from_ticks(0),
            mean_begun: Instant::from_ticks(0),
            below_no_load: false,
            lost: false,
            rejected: 0,
            hand_overs: 0,
            estimated_intervals: 0,
            gaps: 0,
            damaged: 0,
            uncertainty: Nanocoulombs::ZERO,
        }
    }
}

/// A sum of charge in nC that carries what is below one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
struct Accumulator {
    whole: i64,
    /// 0 ≤ carry < [`NANOCOULOMB`].
    carry: i64,
}

impl Accumulator {
    const fn at(charge: Nanocoulombs) -> Self {
        Self {
            whole: charge.get(),
            carry: 0,
        }
    }

    /// Adds `charge` in units of 2⁻²⁴ pC.
    #[inline(never)]
    fn add(&mut self, charge: i128) {
        let sum = add_i128(charge, i128::from(self.carry));
        // Split at the picocoulomb first: a shift, so that the division needs 64 bits only.
        let picocoulombs = clamp_i64(sum >> FRACTION_BITS);
        let fraction = clamp_i64(sum & ((1 << FRACTION_BITS) - 1));
        self.whole = add_i64(self.whole, picocoulombs.div_euclid(1_000));
        self.carry = (picocoulombs.rem_euclid(1_000) << FRACTION_BITS) + fraction;
    }

    /// To the nearest nC.
    #[inline(never)]
    const fn rounded(&self) -> Nanocoulombs {
        Nanocoulombs(add_i64(self.whole, (self.carry >= NANOCOULOMB / 2) as i64))
    }
}

/// What follows from the configuration, worked out when it changes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
struct Coefficients {
    /// 2⁻²⁴ pC per count.
    scale: PerRange<i64>,
    /// (scale − other scale) / scale with 32 binary digits: +0.9 for the large range, −9 for the small one.
    step: PerRange<i64>,
}

impl Coefficients {
    fn new(config: &MeterConfig) -> Self {
        let scale = PerRange {
            small: config.scale(Range::Small),
            large: config.scale(Range::Large),
        };
        let step = |range: Range| {
            let own = scale.get(range);
            // Both are positive.
            let difference = own - scale.get(range.other());
            let quotient = clamp_i64(div_round_i128(
                mul_wide(difference, 1 << 32),
                i128::from(own),
            ));
            quotient.clamp(-LARGEST_STEP_Q32, LARGEST_STEP_Q32)
        };
        Self {
            scale,
            step: PerRange {
                small: step(Range::Small),
                large: step(Range::Large),
            },
        }
    }

    /// By how much the harmonic mean of the scales, weighted by the times in the ranges, exceeds the small range's scale;
    /// of that, with 32 binary digits.
    fn excess(&self, interval: &RangeInterval) -> i64 {
        let ticks = |time: Duration| time.min(LONGEST_INTERVAL).as_ticks().cast_signed();
        let shifted = mul_wide(ticks(interval.large), self.step.large);
        let rest = (i128::from(ticks(interval.length())) << 32) - shifted;
        clamp_i64(div_round_i128(shifted << 32, rest)).clamp(-LARGEST_STEP_Q32, LARGEST_STEP_Q32)
    }

    /// What may be missing if the mean current of an interval lies `beyond` the small sensor's end, as a charge: that sensor
    /// counted its end then, and all that is beyond it are counts of the large range, whose scale and share of the time
    /// they stand for.
    fn hidden_by_small_sensor(&self, beyond: i128, interval: &RangeInterval) -> i128 {
        let ticks = |time: Duration| time.min(LONGEST_INTERVAL).as_ticks().cast_signed();
        let large_per_small = (1 << 32) - self.step.small;
        let shares = div_round_i128(
            mul_wide(ticks(interval.small), large_per_small),
            i128::from(ticks(interval.large)),
        );
        times(beyond, clamp_i64(shares).min(LARGEST_STEP_Q32))
    }
}

/// A configuration with the factors that follow from it. Working them out takes 128-bit divisions: to be done where nobody
/// waits, so that [`MeterChannel::set_calibration`] only has to copy.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct MeterCalibration {
    config: MeterConfig,
    coefficients: Coefficients,
    number: u32,
}

impl MeterCalibration {
    /// Works the factors out. `number` tells this calibration from others: two of the same one are equal.
    #[must_use]
    pub fn new(config: MeterConfig, number: u32) -> Self {
        Self {
            config,
            coefficients: Coefficients::new(&config),
            number,
        }
    }
}

/// Charge in units of 2⁻²⁴ pC from a current in µA over a time in µs.
#[inline(never)]
fn charge_of(current: Microamps, time: Duration) -> i128 {
    // 2⁶³ µs are 292,000 years.
    mul_wide(i64::from(current.get()), time.as_ticks().cast_signed()) << FRACTION_BITS
}

/// The counts from `last` to `reading`, if the meter can make as many in that time.
#[inline(never)]
fn plausible_counts(last: &MeterReading, reading: &MeterReading) -> Option<i32> {
    let counts = energy_difference(reading.energy, last.energy);
    let length = elapsed(last.at, reading.at);
    // At most 781 s · 10,739/s: below 2²³ · 2³².
    let limit = ((length.as_ticks() * FASTEST_COUNTS_PER_US_Q32) >> 32)
        .saturating_add(u64::from(RATE_MARGIN_COUNTS));
    (length <= LONGEST_INTERVAL && u64::from(counts.unsigned_abs()) <= limit).then_some(counts)
}

/// `charge` times a factor with 32 binary digits.
#[inline(never)]
fn times(charge: i128, factor_q32: i64) -> i128 {
    // Split, so that no product leaves 128 bits.
    let (high, low) = (charge >> 32, clamp_i64(charge & 0xFFFF_FFFF));
    add_i128(
        mul_i128(high, i128::from(factor_q32)),
        mul_wide(low, factor_q32) >> 32,
    )
}

/// What the readings up to the newest one have added up to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
struct Booked {
    last: Option<(MeterReading, RangeHistory)>,
    total: Accumulator,
    input: Accumulator,
    output: Accumulator,
    /// Sign of the current in the present stay in the large range: 0 while no count has shown it.
    sign: i8,
    /// Until when a known sign is known to have held.
    sign_at: Instant,
    /// Corrections that wait for the sign, as for a positive current.
    pending: i128,
    /// The scale by which the last interval's counts were taken, 0 if its charge did not come from counts.
    last_scale: i64,
}

/// The meter's charge. Owned by the meter task.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct MeterChannel {
    /// The newest one; number 0 before the first.
    calibration: MeterCalibration,
    booked: Booked,
    /// The same and the uncertainty at the newest calibration: counted by factors that were sound.
    sound: (Booked, Accumulator),
    /// As it was before the newest reading, should that one turn out to be wrong.
    before: Option<Booked>,
    uncertainty: Accumulator,
    /// The time at the last gap's end which no conversion covered, and the current that bridged it, until a reading
    /// behind it shows what flowed there.
    bridged: Option<(Duration, Microamps)>,
    /// When the board has started, if it has said so.
    started: Option<Instant>,
    window: Option<(Instant, Accumulator)>,
    mean_current: Microamps,
    mean_over: Duration,
    mean_begun: Instant,
    lost: bool,
    /// A reading since the one that is booked has waited.
    waited: bool,
    consecutive_rejections: u8,
    rejected: u32,
    hand_overs: u32,
    estimated_intervals: u32,
    gaps: u32,
    damaged: u32,
}

impl MeterChannel {
    /// Nothing counted yet.
    #[must_use]
    pub fn new(config: MeterConfig) -> Self {
        let booked = Booked {
            last: None,
            total: Accumulator::default(),
            input: Accumulator::default(),
            output: Accumulator::default(),
            sign: 0,
            sign_at: Instant::from_ticks(0),
            pending: 0,
            last_scale: 0,
        };
        Self {
            calibration: MeterCalibration::new(config, 0),
            booked,
            sound: (booked, Accumulator::default()),
            before: None,
            uncertainty: Accumulator::default(),
            bridged: None,
            started: None,
            window: None,
            mean_current: Microamps::ZERO,
            mean_over: Duration::from_ticks(0),
            mean_begun: Instant::from_ticks(0),
            lost: false,
            waited: false,
            consecutive_rejections: 0,
            rejected: 0,
            hand_overs: 0,
            estimated_intervals: 0,
            gaps: 0,
            damaged: 0,
        }
    }

    /// Another calibration: counts after the last reading are taken by it. Charge and remainder stay as they are.
    ///
    /// The same one again: the factors in use have to be its factors. If they are not, they are damaged, and the counts since
    /// the last time are taken again.
    pub fn set_calibration(&mut self, calibration: &MeterCalibration) {
        let is_damaged =
            calibration.number == self.calibration.number && *calibration != self.calibration;
        self.calibration = *calibration;
        if is_damaged {
            self.damaged = self.damaged.saturating_add(1);
            self.count_again();
        }
        self.note_sound();
    }

    /// As [`MeterChannel::set_calibration`], with the factors worked out here.
    pub fn set_config(&mut self, config: MeterConfig) {
        self.set_calibration(&MeterCalibration::new(
            config,
            self.calibration.number.wrapping_add(1),
        ));
    }

    /// What is booked is right. Not inlined: a copy of all of it at five places, and the image is 156 bytes smaller.
    #[inline(never)]
    fn note_sound(&mut self) {
        self.sound = (self.booked, self.uncertainty);
    }

    /// The counts from [`MeterChannel::note_sound`] to the newest reading, in one interval: by the shares of the ranges if
    /// there were edges.
    fn count_again(&mut self) {
        let newest = self.booked.last;
        (self.booked, self.uncertainty) = self.sound;
        self.before = None;
        self.mean_over = Duration::from_ticks(0);
        if let Some((reading, history)) = newest
            && let Some((last, earlier)) = self.booked.last
            && let Some(counts) = plausible_counts(&last, &reading)
        {
            self.window = Some((last.at, self.booked.total));
            let interval = history.since(&earlier);
            self.waited |= interval.edges != 0;
            self.integrate(counts, &interval, reading, history);
        }
    }

    /// The configuration in use.
    #[must_use]
    pub const fn config(&self) -> &MeterConfig {
        &self.calibration.config
    }

    /// Sets the counters to values kept over a reset. What was summed before is replaced.
    pub fn restore(
        &mut self,
        charge_total: Nanocoulombs,
        charge_in: Nanocoulombs,
        charge_out: Nanocoulombs,
    ) {
        self.booked.total = Accumulator::at(charge_total);
        self.booked.input = Accumulator::at(charge_in);
        self.booked.output = Accumulator::at(charge_out);
        self.before = None;
        self.window = None;
        self.note_sound();
    }

    /// The board has started at `at`: what flows before the first reading is a gap if that comes late.
    pub const fn start(&mut self, at: Instant) {
        self.started = Some(at);
    }

    /// A reading, with the range history of the same instant.
    pub fn on_reading(&mut self, reading: MeterReading, history: RangeHistory) -> ReadingOutcome {
        if self.lost {
            return self.reject(Rejection::Lost);
        }
        let Some((last, earlier)) = self.booked.last else {
            if self.gap_before_first(reading.at).is_some() {
                return ReadingOutcome::Rejected(Rejection::TooLate);
            }
            self.begin(reading, history);
            return ReadingOutcome::First;
        };
        let Some(length) = reading.at.checked_duration_since(last.at) else {
            return self.reject(Rejection::TimeBackwards);
        };
        if history.at < earlier.at {
            return self.reject(Rejection::TimeBackwards);
        }
        if length > LONGEST_INTERVAL {
            return self.reject(Rejection::TooLate);
        }
        if let Some(counts) = plausible_counts(&last, &reading) {
            self.consecutive_rejections = 0;
            let interval = history.since(&earlier);
            if self.is_chatter(&interval, &earlier, &history) && length <= self.short_interval() {
                self.waited = true;
                return ReadingOutcome::Waits;
            }
            self.before = Some(self.booked);
            return self.integrate(counts, &interval, reading, history);
        }
        let refused = self.reject(Rejection::RateOfChange);
        // It was read again and again, and it fits the reading before the last: it is the last one that was disturbed,
        // by too little for its rate to show it.
        if self.lost
            && let Some(before) = self.before.take()
            && let Some((last, earlier)) = before.last
            && let Some(counts) = plausible_counts(&last, &reading)
        {
            self.lost = false;
            self.consecutive_rejections = 0;
            self.booked = before;
            self.window = None;
            self.note_sound();
            return self.integrate(counts, &history.since(&earlier), reading, history);
        }
        refused
    }

    fn short_interval(&self) -> Duration {
        Duration::from_ticks(u64::from(self.calibration.config.short_interval_us))
    }

    /// Whether edges were missed or follow each other so fast that a count is too coarse for the stays between them.
    fn is_chatter(
        &self,
        interval: &RangeInterval,
        earlier: &RangeHistory,
        history: &RangeHistory,
    ) -> bool {
        match interval.edges {
            _ if interval.missed_edges => true,
            0 => false,
            1 => earlier
                .last_edge
                .zip(history.last_edge)
                .is_some_and(|(previous, edge)| elapsed(previous, edge) <= self.short_interval()),
            _ => true,
        }
    }

    fn integrate(
        &mut self,
        counts: i32,
        interval: &RangeInterval,
        reading: MeterReading,
        history: RangeHistory,
    ) -> ReadingOutcome {
        let before = self.booked.total;
        let short_stays =
            interval.edges <= 2 && interval.time_in(interval.shorter()) <= self.short_interval();
        let shared = core::mem::take(&mut self.waited)
            || interval.missed_edges
            || (interval.edges > 1 && !short_stays);
        let outcome = if shared {
            self.by_time_shares(counts, interval)
        } else if interval.edges == 0 {
            self.same_range(counts, interval, reading.at)
        } else {
            self.short_stays(counts, interval, reading.at)
        };
        self.booked.last = Some((reading, history));
        self.doubt_small_sensor(counts, shared, interval);
        self.doubt_bridge(before, interval.length());
        self.update_mean(reading.at);
        outcome
    }

    /// The meter does not answer or has lost its configuration: nothing is counted from its last good reading on.
    pub fn on_meter_lost(&mut self) {
        self.lost = true;
    }

    /// The meter counts again from `reading` on; `bridge` covers the time since the last good reading. Also the way
    /// out of [`Rejection::TooLate`].
    pub fn on_meter_restarted(
        &mut self,
        reading: MeterReading,
        history: RangeHistory,
        bridge: &GapBridge,
    ) {
        self.lost = false;
        self.waited = false;
        self.consecutive_rejections = 0;
        let begin = match self.booked.last {
            Some((last, _)) => Some(last.at),
            None => self.gap_before_first(reading.at),
        };
        let Some(begin) = begin else {
            self.begin(reading, history);
            return;
        };
        self.gaps = self.gaps.saturating_add(1);
        self.settle_pending(0);
        // The current may have reversed in the gap.
        self.booked.sign = 0;
        // A bridge that begins elsewhere is of before the newest reading became known, a tick ago: of it the current alone.
        let (charge, doubt, reached) = if bridge.since == begin {
            (bridge.charge, bridge.doubt, bridge.until.max(begin))
        } else {
            (Nanocoulombs::ZERO, Nanocoulombs::ZERO, begin)
        };
        let current = bridge.current.unwrap_or_default();
        let tail = elapsed(reached, reading.at);
        let holds = elapsed(bridge.until, reading.at) <= bridge.holds;
        let error = if holds {
            self.bridged = Some((tail, current));
            converter_error(&self.calibration.config, current)
        } else {
            self.bridged = None;
            let stays_small = self.booked.last.is_some_and(|(_, earlier)| {
                earlier.edges == history.edges && history.range == Range::Small
            });
            let full_scale = if stays_small {
                self.calibration.config.full_scale.small
            } else {
                self.calibration.config.full_scale.large
            };
            full_scale
                .saturating_abs()
                .saturating_add(current.saturating_abs())
        };
        self.book(add_i128(
            mul_wide(charge.get(), NANOCOULOMB),
            charge_of(current, tail),
        ));
        self.change_scale(0);
        self.uncertainty.add(add_i128(
            mul_wide(doubt.get(), NANOCOULOMB),
            charge_of(error, tail),
        ));
        self.before = None;
        self.booked.last = Some((reading, history));
        self.update_mean(reading.at);
        self.note_sound();
    }

    /// Everything counted so far.
    #[must_use]
    pub fn report(&self) -> MeterReport {
        let mut uncertainty = self.uncertainty;
        let range = self
            .booked
            .last
            .map_or(Range::Small, |(_, history)| history.range);
        if self.booked.last.is_some() {
            // The hidden bits of the newest reading.
            uncertainty.add(i128::from(self.booked.last_scale) / 2);
            uncertainty.add(abs_i128(self.booked.pending));
        }
        let magnitude = self.mean_current.saturating_abs();
        MeterReport {
            at: self.booked.last.map(|(reading, _)| reading.at),
            energy: self.booked.last.map_or(0, |(reading, _)| reading.energy),
            charge_total: self.booked.total.rounded(),
            charge_in: self.booked.input.rounded(),
            charge_out: self.booked.output.rounded(),
            resolution: Nanocoulombs(div_round(
                self.calibration.coefficients.scale.get(range),
                NANOCOULOMB,
            )),
            mean_current: self.mean_current,
            mean_over: self.mean_over,
            mean_begun: self.mean_begun,
            below_no_load: !self.mean_over.is_zero()
                && magnitude < self.calibration.config.no_load_current(range),
            lost: self.lost,
            rejected: self.rejected,
            hand_overs: self.hand_overs,
            estimated_intervals: self.estimated_intervals,
            gaps: self.gaps,
            damaged: self.damaged,
            // Rounded up, with the rounding of the total itself.
            uncertainty: Nanocoulombs(add_i64(uncertainty.whole, 2)),
        }
    }

    /// When the gap has begun that ends with a first reading at `now`, if there is one.
    fn gap_before_first(&self, now: Instant) -> Option<Instant> {
        self.started
            .filter(|&start| elapsed(start, now) > FIRST_READING)
    }

    fn begin(&mut self, reading: MeterReading, history: RangeHistory) {
        self.booked.last = Some((reading, history));
        self.window = Some((reading.at, self.booked.total));
        self.note_sound();
    }

    fn reject(&mut self, reason: Rejection) -> ReadingOutcome {
        self.rejected = self.rejected.saturating_add(1);
        if reason != Rejection::Lost {
            self.consecutive_rejections = self.consecutive_rejections.saturating_add(1);
            self.lost = self.consecutive_rejections >= REJECTIONS_UNTIL_LOST;
        }
        ReadingOutcome::Rejected(reason)
    }

    fn same_range(
        &mut self,
        counts: i32,
        interval: &RangeInterval,
        now: Instant,
    ) -> ReadingOutcome {
        let range = interval.last;
        if range == Range::Large {
            self.learn_sign(counts, now);
        } else if self.booked.pending != 0 {
            self.settle_pending(counts);
        }
        self.change_scale(self.calibration.coefficients.scale.get(range));
        self.book(self.counted_charge(counts, range) - self.offset_charge(interval));
        ReadingOutcome::Integrated
    }

    /// Few or short stays in one of the ranges: its counts are taken from the switching current, all others are of the
    /// other range.
    fn short_stays(
        &mut self,
        counts: i32,
        interval: &RangeInterval,
        now: Instant,
    ) -> ReadingOutcome {
        let short = interval.shorter();
        let long = short.other();
        let estimated = interval.time_in(short);
        self.sign_in(counts, interval, now);
        self.change_scale(self.calibration.coefficients.scale.get(long));

        let mut correction = self.misscaled(estimated, short);
        // For its delay after an edge the filter still passes the old range.
        let delay = Duration::from_ticks(u64::from(self.calibration.config.front_end_delay_us));
        if interval.first == short {
            correction += self.misscaled(delay, short);
        }
        if interval.last == short {
            let old_level = interval.since_last_edge.unwrap_or(delay).min(delay);
            correction += self.misscaled(delay.saturating_sub(old_level), long)
                - self.misscaled(old_level, short);
        }
        let charge = self.counted_charge(counts, long) - self.offset_charge(interval);
        if self.booked.sign == 0 {
            self.booked.pending = add_i128(self.booked.pending, correction);
            self.book(charge);
        } else {
            self.book(charge + self.signed(correction));
        }
        self.hand_overs = self.hand_overs.saturating_add(interval.edges);

        let switching_current = self.calibration.config.switching_current.saturating_abs();
        // The estimated part cannot be further off than its sensor's range allows.
        let span = self
            .calibration
            .config
            .full_scale
            .get(short)
            .saturating_abs()
            .saturating_add(switching_current);
        let stamps = Duration::from_ticks(
            design::EDGE_STAMP_DELAY_US.saturating_mul(u64::from(interval.edges)),
        );
        let doubt = add_i128(
            add_i128(
                charge_of(
                    self.calibration.config.switching_tolerance.saturating_abs(),
                    estimated,
                ),
                self.slew_charge(estimated),
            )
            .min(charge_of(span, estimated)),
            charge_of(switching_current, stamps),
        );
        self.uncertainty.add(times(
            doubt,
            abs_i64(self.calibration.coefficients.step.get(short)),
        ));
        if interval.edges == 1 && estimated.as_ticks() <= 2 * design::SNAPSHOT_DEADLINE_US {
            ReadingOutcome::Integrated
        } else {
            self.estimated_intervals = self.estimated_intervals.saturating_add(1);
            ReadingOutcome::Estimated
        }
    }

    /// Edges faster than readings, or long stays in both ranges between two of them.
    fn by_time_shares(&mut self, counts: i32, interval: &RangeInterval) -> ReadingOutcome {
        self.settle_pending(counts);
        self.booked.sign = 0;
        let excess = self.calibration.coefficients.excess(interval);
        let small = self.calibration.coefficients.scale.small;
        let scale = clamp_i64(add_i128(
            i128::from(small),
            times(i128::from(small), excess),
        ));
        self.change_scale(scale);
        self.book(mul_wide(i64::from(counts), scale) - self.offset_charge(interval));
        let doubt = self.shares_doubt(excess, interval);
        self.uncertainty.add(doubt);
        self.estimated_intervals = self.estimated_intervals.saturating_add(1);
        ReadingOutcome::Estimated
    }

    /// What is wrong with the counts that the switching current makes in `range` when they are taken by the other scale.
    fn misscaled(&self, time: Duration, range: Range) -> i128 {
        times(
            charge_of(self.calibration.config.switching_current, time),
            self.calibration.coefficients.step.get(range),
        )
    }

    /// What the offsets have counted.
    #[inline(never)]
    fn offset_charge(&self, interval: &RangeInterval) -> i128 {
        charge_of(
            self.calibration.config.offset.small,
            interval.small.min(LONGEST_INTERVAL),
        ) + charge_of(
            self.calibration.config.offset.large,
            interval.large.min(LONGEST_INTERVAL),
        )
    }

    /// The small range in use where its comparators should have ended it. In an interval of its own that is between their
    /// threshold and the sensor's end, by a count at least: the current may be any then. In one that is `shared` it is
    /// beyond the sensor's end.
    fn doubt_small_sensor(&mut self, counts: i32, shared: bool, interval: &RangeInterval) {
        let time = interval.length().min(LONGEST_INTERVAL);
        let PerRange { small, large } = self.calibration.config.full_scale;
        let counted = abs_i128(mul_wide(i64::from(counts), self.booked.last_scale));
        let beyond = |current: Microamps| sub_i128(counted, charge_of(current, time)).max(0);
        let doubt = if shared {
            self.calibration
                .coefficients
                .hidden_by_small_sensor(beyond(small), interval)
        } else if interval.shorter() == Range::Large {
            let between = self
                .calibration
                .config
                .switching_current
                .saturating_add(small)
                .get()
                / 2;
            if beyond(Microamps(between)) <= i128::from(self.booked.last_scale) {
                return;
            }
            charge_of(large.saturating_abs(), time)
        } else {
            return;
        };
        self.uncertainty.add(doubt);
    }

    /// With weights wᵢ = harmonic mean / sᵢ, whose mean over time is 1, the error is ∫ I·(w − 1) dt = −∫ İ·W dt, where W,
    /// the integral of w − 1, is 0 at both ends. It is largest when the small range comes first or last: a triangle of
    /// height t_small · (w_small − 1), so the error is at most half the slew over the interval times that height. Besides,
    /// the times may be wrong by a stamp, and by what the filter in front remembers.
    fn shares_doubt(&self, excess: i64, interval: &RangeInterval) -> i128 {
        let slew = u64::from(self.calibration.config.slew_limit_amps_per_second)
            .saturating_mul(interval.length().as_ticks())
            / 2;
        // No further than from one end of the large range to the other.
        let full = self
            .calibration
            .config
            .full_scale
            .large
            .saturating_abs()
            .get();
        let span = clamp_i32(clamp_i64(i128::from(slew).min(2 * i128::from(full))));
        let of_shape = times(charge_of(Microamps(span), interval.small), abs_i64(excess));
        let misjudged = u64::from(self.calibration.config.front_end_delay_us)
            .saturating_add(design::EDGE_STAMP_DELAY_US);
        let of_times = abs_i128(self.misscaled(Duration::from_ticks(misjudged), Range::Small));
        add_i128(of_shape, of_times)
    }

    /// What the slew limit allows a current to add within a time from a known point: slew · t² / 2.
    fn slew_charge(&self, time: Duration) -> i128 {
        // (7.8·10⁸ µs)² is below 2⁶⁰.
        let ticks = time.min(LONGEST_INTERVAL).as_ticks().cast_signed();
        mul_wide(
            i64::from(self.calibration.config.slew_limit_amps_per_second),
            ticks * ticks,
        ) << (FRACTION_BITS - 1)
    }

    fn counted_charge(&self, counts: i32, range: Range) -> i128 {
        mul_wide(
            i64::from(counts),
            self.calibration.coefficients.scale.get(range),
        )
    }

    /// `charge`, which is as for a positive current, by the known sign.
    const fn signed(&self, charge: i128) -> i128 {
        if self.booked.sign < 0 {
            charge.saturating_neg()
        } else {
            charge
        }
    }

    /// The counts are taken by another scale from here on: the hidden bits of the reading in between are misjudged by
    /// up to half the difference.
    #[inline(never)]
    fn change_scale(&mut self, scale: i64) {
        let difference = i128::from(scale) - i128::from(self.booked.last_scale);
        self.booked.last_scale = scale;
        self.uncertainty.add(difference.abs() / 2);
    }

    #[inline(never)]
    fn book(&mut self, charge: i128) {
        self.booked.total.add(charge);
        if charge < 0 {
            self.booked.input.add(charge.saturating_neg());
        } else {
            self.booked.output.add(charge);
        }
    }

    /// Counts made while the current could not change its sign.
    #[inline(never)]
    fn learn_sign(&mut self, counts: i32, now: Instant) {
        if counts != 0 {
            self.booked.sign = if counts < 0 { -1 } else { 1 };
        }
        if self.booked.sign != 0 {
            self.booked.sign_at = now;
            self.settle_pending(counts);
        }
    }

    /// Books what waited for the sign: by the sign if it is known, else by that of `counts`, a guess that may be wrong
    /// by twice the amount.
    #[inline(never)]
    fn settle_pending(&mut self, counts: i32) {
        let sign = if self.booked.sign == 0 {
            counts.signum()
        } else {
            i32::from(self.booked.sign)
        };
        if self.booked.pending != 0 && sign != 0 {
            let pending = self.booked.pending;
            self.booked.pending = 0;
            if self.booked.sign == 0 {
                self.uncertainty.add(mul_i128(abs_i128(pending), 2));
            }
            self.book(mul_i128(pending, i128::from(sign)));
        }
    }

    /// The sign of the current at the edges of an interval. At an edge into the large range the sign of an earlier stay
    /// still holds if a current at the slew limit could not have reversed since. At an edge out of it, the stay's own
    /// counts show it, should it still be unknown.
    fn sign_in(&mut self, counts: i32, interval: &RangeInterval, now: Instant) {
        if interval.first == Range::Large {
            if self.booked.sign == 0 {
                self.learn_sign(counts, now);
            }
        } else {
            // µA by A/s is µs.
            let switching = self
                .calibration
                .config
                .switching_current
                .saturating_abs()
                .get();
            let reversal = u64::from(switching.unsigned_abs()) * 2
                / u64::from(self.calibration.config.slew_limit_amps_per_second.max(1));
            if elapsed(self.booked.sign_at, now).as_ticks() >= reversal {
                self.settle_pending(counts);
                self.booked.sign = 0;
            }
        }
        if self.booked.sign != 0 {
            self.booked.sign_at = now;
        }
    }

    /// A step shortly before a gap, or in it, is not in the mean that bridged it: what flows behind it shows by how much the
    /// current has changed.
    fn doubt_bridge(&mut self, before: Accumulator, length: Duration) {
        if length >= SHORTEST_MEAN
            && let Some((gap, current)) = self.bridged.take()
        {
            let change = self
                .mean_since(before, length)
                .saturating_sub(current)
                .saturating_abs();
            self.uncertainty.add(charge_of(change, gap));
        }
    }

    /// Mean current of the `length` since the total was `before`; 0 for no time.
    fn mean_since(&self, before: Accumulator, length: Duration) -> Microamps {
        // nC per µs is mA.
        let counted = sub_i64(self.booked.total.whole, before.whole);
        let ticks = i64::try_from(length.as_ticks()).unwrap_or(i64::MAX);
        Microamps(clamp_i32(mul_div(counted, 1_000, ticks)))
    }

    #[inline(never)]
    fn update_mean(&mut self, now: Instant) {
        let (begin, charge) = *self.window.get_or_insert((now, self.booked.total));
        let length = elapsed(begin, now);
        if length < milliseconds(self.calibration.config.mean_window_ms) || length.is_zero() {
            return;
        }
        self.mean_current = self.mean_since(charge, length);
        self.mean_over = length;
        self.mean_begun = begin;
        self.window = Some((now, self.booked.total));
    }
}

#[cfg(test)]
#[allow(
    clippy::unwrap_used,
    clippy::cast_possible_truncation,
    clippy::cast_precision_loss
)]
mod tests;
