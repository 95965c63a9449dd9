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
mod tests {
    use super::*;
    use crate::range::EdgeRecorder;
    use proptest::prelude::*;

    const SWITCHING: f64 = 53.333_333;

    fn at(us: u64) -> Instant {
        Instant::from_ticks(us)
    }

    fn counts_per_second() -> f64 {
        1_677_722.0 * 0.2 * (3_579_545.0 / 4.0) / 2f64.powi(25)
    }

    fn per_count(range: Range) -> f64 {
        match range {
            Range::Small => 60.0 / counts_per_second(),
            Range::Large => 600.0 / counts_per_second(),
        }
    }

    /// A meter with a flag, read at will.
    struct Bench {
        channel: MeterChannel,
        recorder: EdgeRecorder,
        energy: i32,
    }

    impl Bench {
        fn new(config: MeterConfig, range: Range) -> Self {
            let mut bench = Self {
                channel: MeterChannel::new(config),
                recorder: EdgeRecorder::new(at(0), range == Range::Large),
                energy: 0,
            };
            assert_eq!(bench.read(0, 0), ReadingOutcome::First);
            bench
        }

        /// `counts` later, at `us`.
        fn read(&mut self, us: u64, counts: i32) -> ReadingOutcome {
            self.energy = self.energy.wrapping_add(counts);
            self.channel.on_reading(
                MeterReading {
                    energy: self.energy,
                    at: at(us),
                },
                self.recorder.history(at(us)),
            )
        }

        fn edge(&mut self, us: u64, range: Range) {
            self.recorder.on_edge(at(us), range == Range::Large);
        }

        fn coulombs(&self) -> f64 {
            self.channel.report().charge_total.get() as f64 * 1e-9
        }

        fn doubt(&self) -> f64 {
            self.channel.report().uncertainty.get() as f64 * 1e-9
        }
    }

    /// What the converter says of the time up to `until`: this mean current.
    fn bridge_of(current: Microamps, since: u64, until: u64) -> GapBridge {
        let length = Duration::from_ticks(until - since);
        let charge_of = |current: Microamps| {
            Nanocoulombs(i64::from(current.get()) * length.as_ticks() as i64 / 1_000)
        };
        GapBridge {
            since: at(since),
            until: at(until),
            charge: charge_of(current),
            doubt: charge_of(converter_error(&MeterConfig::default(), current)),
            current: Some(current),
            holds: Duration::from_ticks(55_000),
        }
    }

    fn near(value: f64, expected: f64, tolerance: f64) {
        assert!(
            (value - expected).abs() <= tolerance,
            "{value} instead of {expected}"
        );
    }

    /// F22, with edges in the time that is counted again and without.
    #[test]
    fn damaged_factors_are_found_and_their_counts_are_taken_again() {
        let flips: [fn(&mut MeterCalibration); 8] = [
            |c| c.coefficients.scale.small ^= 1 << 54,
            |c| c.coefficients.scale.large ^= 1 << 62,
            |c| c.coefficients.step.small ^= 1 << 33,
            |c| c.coefficients.step.large ^= 1 << 30,
            |c| c.config.offset.small.0 ^= 1 << 30,
            |c| c.config.full_scale.small.0 ^= 1 << 25,
            |c| c.config.switching_current.0 ^= 1 << 29,
            |c| c.config.mean_window_ms ^= 1 << 4,
        ];
        for has_edges in [false, true] {
            for (number, flip) in flips.into_iter().enumerate() {
                let calibration = MeterCalibration::new(MeterConfig::default(), 7);
                let run = |flip: Option<fn(&mut MeterCalibration)>| {
                    let mut bench = Bench::new(MeterConfig::default(), Range::Small);
                    bench.channel.set_calibration(&calibration);
                    let mut range = Range::Small;
                    for step in 1..=200 {
                        let us = step * 20_000;
                        if has_edges && step % 25 == 0 {
                            range = range.other();
                            bench.edge(us - 9_000, range);
                        }
                        // 53 A by what each range makes of them.
                        let counts = if range == Range::Small { 158 } else { 16 };
                        bench.read(us, counts);
                        if step == 60
                            && let Some(flip) = flip
                        {
                            flip(&mut bench.channel.calibration);
                        }
                        if step % 50 == 0 {
                            bench.channel.set_calibration(&calibration);
                        }
                    }
                    bench
                };
                let (sound, damaged) = (run(None), run(Some(flip)));
                let (expected, report) = (sound.channel.report(), damaged.channel.report());
                assert_eq!((expected.damaged, report.damaged), (0, 1), "{number}");
                if has_edges {
                    // By shares of a second, in which the current might have been any.
                    near(damaged.coulombs(), sound.coulombs(), 6.0);
                    assert!(damaged.doubt() <= sound.doubt() + 600.0);
                } else {
                    assert_eq!(
                        MeterReport {
                            damaged: 0,
                            ..report
                        },
                        expected,
                        "{number}"
                    );
                }
            }
        }
    }

    #[test]
    fn the_same_calibration_again_changes_nothing_and_another_one_is_no_damage() {
        let mut bench = Bench::new(MeterConfig::default(), Range::Small);
        let first = MeterCalibration::new(MeterConfig::default(), 1);
        bench.channel.set_calibration(&first);
        bench.read(20_000, 150);
        let before = bench.channel.report();
        bench.channel.set_calibration(&first);
        assert_eq!(bench.channel.report(), before);
        let mut config = MeterConfig::default();
        config.gain.small = Ppm(10_000);
        bench
            .channel
            .set_calibration(&MeterCalibration::new(config, 2));
        let report = bench.channel.report();
        assert_eq!(
            (report.charge_total, report.uncertainty),
            (before.charge_total, before.uncertainty)
        );
        bench.read(40_000, 150);
        assert_eq!(bench.channel.report().damaged, 0);
    }

    /// What was undone before, by the readings, is not had back from what was noted meanwhile.
    #[test]
    fn damage_after_a_disturbed_reading_that_was_undone_costs_nothing() {
        let calibration = MeterCalibration::new(MeterConfig::default(), 1);
        let mut bench = Bench::new(MeterConfig::default(), Range::Small);
        bench.read(20_000, 150);
        let truth = bench.energy + 300;
        bench.channel.on_reading(
            MeterReading {
                energy: bench.energy + 150 + 400,
                at: at(40_000),
            },
            bench.recorder.history(at(40_000)),
        );
        bench.channel.set_calibration(&calibration);
        bench.energy = truth;
        for us in [60_000, 60_100, 60_200] {
            bench.read(us, 0);
        }
        near(bench.coulombs(), 450.0 * per_count(Range::Small), 1e-8);
        bench.channel.calibration.coefficients.scale.small ^= 1 << 54;
        bench.read(80_000, 150);
        bench.channel.set_calibration(&calibration);
        near(bench.coulombs(), 600.0 * per_count(Range::Small), 1e-8);
        assert_eq!(bench.channel.report().damaged, 1);
    }

    #[test]
    fn one_count_is_what_the_data_sheets_quantities_make_it() {
        let config = MeterConfig::default();
        near(counts_per_second(), 8_949.0, 0.5);
        for range in [Range::Small, Range::Large] {
            let nanocoulombs = config.charge_per_count(range).get() as f64;
            near(nanocoulombs, per_count(range) * 1e9, 0.6);
            // The scale itself, to the floating point's own precision.
            let scale = config.scale(range) as f64 / NANOCOULOMB as f64 * 1e-9;
            near(scale / per_count(range), 1.0, 1e-15);
        }
        // A second at full scale.
        let mut bench = Bench::new(config, Range::Small);
        assert_eq!(bench.read(1_000_000, 8_949), ReadingOutcome::Integrated);
        near(bench.coulombs(), 60.0 * 8_949.0 / counts_per_second(), 1e-9);
    }

    /// The chip's own arithmetic, V1 · V2 / Vref², with V2 from the same reference.
    #[test]
    fn reference_and_divider_enter_the_scale_as_derived() {
        let (reference_ppm, divider_ppm) = (600, -1_900);
        let reference = 1.0 + f64::from(reference_ppm) * 1e-6;
        let ratio = 1.0 + f64::from(divider_ppm) * 1e-6;
        // Rate against the nominal one, with V1 = 1.
        let v2 = reference * ratio;
        let rate = 1.0 * v2 / (reference * reference);
        let config = MeterConfig {
            reference_error: Ppm(reference_ppm),
            divider_error: Ppm(divider_ppm),
            ..MeterConfig::default()
        };
        let nominal = MeterConfig::default();
        for range in [Range::Small, Range::Large] {
            let scale = config.scale(range) as f64 / nominal.scale(range) as f64;
            near(scale * rate, 1.0, 1e-14);
        }
        let gain = MeterConfig {
            gain: PerRange {
                small: Ppm(1_000),
                large: Ppm(-2_000),
            },
            ..nominal
        };
        near(
            gain.scale(Range::Small) as f64 / nominal.scale(Range::Small) as f64,
            1.001,
            1e-14,
        );
        near(
            gain.scale(Range::Large) as f64 / nominal.scale(Range::Large) as f64,
            0.998,
            1e-14,
        );
        // Nonsense is refused by the limits of the configuration, but must not divide by zero either.
        let nonsense = MeterConfig {
            full_scale: PerRange::both(Microamps(-5)),
            divider_error: Ppm(i32::MIN),
            ..nominal
        };
        assert_eq!(nonsense.scale(Range::Small), 1);
    }

    /// Why DISLPF2: what the filter's memory adds when its output is scaled by the new range from the edge on.
    #[test]
    fn the_multipliers_low_pass_would_cost_coulombs_at_every_change() {
        let tau = 1.0 / (2.0 * std::f64::consts::PI * 8.9);
        near(tau, 17.9e-3, 0.05e-3);
        // A single pole, stepped through: 60 A is the whole of one range and a tenth of the other.
        let excess = |old: f64, new: f64, scale: f64| {
            let (mut product, mut charge) = (old, 0.0);
            let step = 1e-6;
            for _ in 0..300_000 {
                charge += (product - new) * scale * step;
                product += (new - product) * step / tau;
            }
            charge
        };
        near(excess(1.0, 0.1, 600.0), 9.7, 0.05);
        near(excess(0.1, 1.0, 60.0), -0.97, 0.005);
        near(600.0 * 0.9 * tau, 9.7, 0.05);
        near(60.0 * 0.9 * tau, 0.97, 0.005);
        // The same memory as a configured delay would be corrected on average, by the current at the edge.
        let config = MeterConfig {
            front_end_delay_us: 17_883,
            ..MeterConfig::default()
        };
        let mut bench = Bench::new(config, Range::Small);
        bench.edge(1_000_000, Range::Large);
        let _ = bench.read(1_000_000, 7_955);
        let _ = bench.read(1_100_000, 50);
        let counted = 7_955.0 * per_count(Range::Small) + 50.0 * per_count(Range::Large);
        near(
            bench.coulombs() - counted,
            -9.0 * SWITCHING * 17.883e-3,
            1e-5,
        );
        // And back.
        let before = bench.coulombs();
        bench.edge(2_000_000, Range::Small);
        let _ = bench.read(2_000_000, 700);
        let counted = 700.0 * per_count(Range::Large);
        near(
            bench.coulombs() - before - counted,
            0.9 * SWITCHING * 17.883e-3,
            1e-5,
        );
    }

    #[test]
    fn the_filters_delay_is_counted_up_to_the_snapshot() {
        let config = MeterConfig {
            front_end_delay_us: 60,
            ..MeterConfig::default()
        };
        // 100 µs after the edge: 60 µs still at the old level, 40 µs at the new one.
        let mut bench = Bench::new(config, Range::Large);
        bench.edge(1_000_000, Range::Small);
        let _ = bench.read(1_000_100, 796);
        near(
            bench.coulombs() - 796.0 * per_count(Range::Large),
            -9.0 * SWITCHING * 40e-6,
            1e-8,
        );
        // 20 µs after it: 40 µs of the old level are still to come.
        let mut bench = Bench::new(config, Range::Large);
        bench.edge(1_000_000, Range::Small);
        let _ = bench.read(1_000_020, 796);
        near(
            bench.coulombs() - 796.0 * per_count(Range::Large),
            0.9 * SWITCHING * 40e-6,
            1e-8,
        );
        // The edge nearer to the begin: what comes after it is counted by the new range, with the whole delay.
        let mut bench = Bench::new(config, Range::Large);
        bench.edge(100, Range::Small);
        let _ = bench.read(1_000_000, 7_955);
        near(
            bench.coulombs() - 7_955.0 * per_count(Range::Small),
            0.9 * SWITCHING * 160e-6,
            1e-8,
        );
    }

    #[test]
    fn counts_after_an_edge_belong_to_the_new_range() {
        for sign in [1, -1] {
            let s = f64::from(sign);
            let mut bench = Bench::new(MeterConfig::default(), Range::Small);
            bench.edge(1_000_000, Range::Large);
            assert_eq!(
                bench.read(1_000_100, 7_955 * sign),
                ReadingOutcome::Integrated
            );
            // The sign of a stay in the large range is not known before a count shows it: until then uncorrected.
            near(
                bench.coulombs(),
                s * 7_955.0 * per_count(Range::Small),
                1e-8,
            );
            assert_eq!(bench.read(1_010_000, 0), ReadingOutcome::Integrated);
            near(
                bench.coulombs(),
                s * 7_955.0 * per_count(Range::Small),
                1e-8,
            );
            let _ = bench.read(1_100_000, 80 * sign);
            let expected = 7_955.0 * per_count(Range::Small)
                + 0.9 * SWITCHING * 100e-6
                + 80.0 * per_count(Range::Large);
            near(bench.coulombs(), s * expected, 1e-8);
            // Back: 48 mC per 100 µs.
            bench.edge(2_000_000, Range::Small);
            assert_eq!(
                bench.read(2_000_100, 720 * sign),
                ReadingOutcome::Integrated
            );
            let expected = expected + 720.0 * per_count(Range::Large) - 9.0 * SWITCHING * 100e-6;
            near(bench.coulombs(), s * expected, 2e-8);
            near(9.0 * SWITCHING * 100e-6, 48e-3, 1e-6);
            let report = bench.channel.report();
            assert_eq!((report.hand_overs, report.estimated_intervals), (2, 0));
            // Two edges of 30.2 mC, a count's half at each end, latency: 100 µs · 1 A, 10 kA/s, 5 µs of stamp.
            let latency = 100e-6 + 50e-6 + SWITCHING * 5e-6;
            let doubt = 2.0 * 30.171e-3 + 6.7048e-3 + (0.9 + 9.0) * latency;
            near(bench.doubt(), doubt, 3e-6);
        }
    }

    #[test]
    fn the_part_nearer_to_the_edge_is_estimated() {
        let mut bench = Bench::new(MeterConfig::default(), Range::Large);
        bench.edge(100, Range::Small);
        assert_eq!(bench.read(1_000_000, -7_000), ReadingOutcome::Integrated);
        // 100 µs before the edge at the large range, counted by the small one: 0.9 · 53.3 A · 100 µs are missing.
        let expected = -7_000.0 * per_count(Range::Small) - 0.9 * SWITCHING * 100e-6;
        near(bench.coulombs(), expected, 1e-8);
        // A snapshot that came late is an estimate, and its doubt is what the range allows at most.
        let mut bench = Bench::new(MeterConfig::default(), Range::Large);
        bench.edge(10_000_000, Range::Small);
        assert_eq!(bench.read(10_000_201, 7_000), ReadingOutcome::Estimated);
        assert_eq!(bench.channel.report().estimated_intervals, 1);
        let mut bench = Bench::new(MeterConfig::default(), Range::Large);
        bench.edge(10_000_000, Range::Small);
        assert_eq!(bench.read(10_000_200, 7_000), ReadingOutcome::Integrated);
        let mut bench = Bench::new(MeterConfig::default(), Range::Large);
        bench.edge(10_000_000, Range::Small);
        let _ = bench.read(19_000_000, 7_000);
        near(
            bench.doubt(),
            9.0 * 9.0 * (60.0 + SWITCHING) + 67.05e-3 + 9.0 * SWITCHING * 5e-6,
            1e-3,
        );
    }

    /// 30 A, where no comparator switches, half of each millisecond in either range.
    #[test]
    fn chatter_is_shared_by_time_wherever_the_current_is() {
        for amps in [30.0, -50.0] {
            let mut bench = Bench::new(MeterConfig::default(), Range::Small);
            let mut counted = 0.0_f64;
            let mut read = |bench: &mut Bench, us: u64, ran: u64, range: Range| {
                let before = counted.round();
                counted += amps * ran as f64 * 1e-6 / per_count(range);
                bench.read(us, (counted.round() - before) as i32)
            };
            let steady = read(&mut bench, 1_000_000, 1_000_000, Range::Small);
            assert_eq!(steady, ReadingOutcome::Integrated);
            // The first edge has its counts, the next one comes too soon.
            bench.edge(1_010_000, Range::Large);
            let first = read(&mut bench, 1_010_000, 10_000, Range::Small);
            assert_eq!(first, ReadingOutcome::Integrated);
            let (charge, doubt) = (bench.coulombs(), bench.doubt());
            let (mut now, mut range, mut waited) = (1_010_000, Range::Large, 0);
            for _ in 0..200 {
                now += 500;
                bench.edge(now, range.other());
                match read(&mut bench, now, 500, range) {
                    ReadingOutcome::Waits => waited += 1,
                    outcome => assert_eq!(outcome, ReadingOutcome::Estimated),
                }
                range = range.other();
            }
            // Each ninth is later than 4 ms.
            assert_eq!(waited, 200 - 22);
            // What the last count hides is of the large range.
            let _ = read(&mut bench, now + 5_000, 5_000, range);
            near(
                bench.coulombs() - charge,
                amps * 105e-3,
                per_count(Range::Large),
            );
            // Per 4.5 ms: 22.5 A over 2 or 2.5 ms with an excess of 45/27 − 1 or 45/29.5 − 1, a stamp, and half of what one
            // scale differs from the next.
            let excess = |small_ms: f64| 4.5 / (small_ms + (4.5 - small_ms) / 10.0) - 1.0;
            let shape = 22.5 * (2e-3 * excess(2.0) + 2.5e-3 * excess(2.5)) / 2.0;
            let hidden = per_count(Range::Small) * (excess(2.0) - excess(2.5)) / 2.0;
            let each = shape + 9.0 * SWITCHING * 5e-6 + hidden;
            // And the rest up to the end.
            near(bench.doubt() - doubt, 22.0 * each, 0.15 * 22.0 * each);
            assert_eq!(bench.channel.report().hand_overs, 1);
        }
    }

    /// At 100 A the small sensor shows no more than 60 A: what is missing is declared.
    #[test]
    fn a_small_sensor_at_its_end_is_doubted() {
        let small = |ms: f64| (60.0 * ms * 1e-3 / per_count(Range::Small)) as i32;
        // Alone: anything that the large one could show.
        let mut bench = Bench::new(MeterConfig::default(), Range::Small);
        let doubt = bench.doubt();
        let _ = bench.read(20_000, small(20.0));
        near(bench.doubt() - doubt, 600.0 * 20e-3, 0.01);
        // Where its comparators should have switched it is not.
        let _ = bench.read(40_000, small(20.0 * 55.0 / 60.0));
        near(bench.doubt() - doubt, 600.0 * 20e-3, 0.01);
        // Of a time shared by both ranges it is what the large one shows.
        let mut bench = Bench::new(MeterConfig::default(), Range::Small);
        for edge in 1..4 {
            bench.edge(edge * 10_000, Range::from_flag(edge % 2 == 1));
        }
        let large = (100.0 * 20e-3 / per_count(Range::Large)) as i32;
        let _ = bench.read(40_000, small(20.0) + large);
        let missing = 100.0 * 40e-3 - bench.coulombs();
        assert!(missing > 1.4, "{missing}");
        assert!(bench.doubt() > missing && bench.doubt() < missing + 4.0);
    }

    #[test]
    fn a_pulse_is_taken_along_by_the_next_reading() {
        let mut bench = Bench::new(MeterConfig::default(), Range::Small);
        bench.edge(1_000_000, Range::Large);
        assert_eq!(bench.read(1_000_000, 4_000), ReadingOutcome::Integrated);
        let charge = bench.coulombs();
        bench.edge(1_001_000, Range::Small);
        assert_eq!(bench.read(1_001_000, 0), ReadingOutcome::Waits);
        assert_eq!(bench.channel.report().at, Some(at(1_000_000)));
        near(bench.coulombs(), charge, 1e-9);
        // Without an edge it waits as well, until 4 ms have passed since the last one that was booked.
        assert_eq!(bench.read(1_004_000, 4), ReadingOutcome::Waits);
        assert_eq!(bench.read(1_004_001, 0), ReadingOutcome::Estimated);
        let weight = 3_001.0 / per_count(Range::Small) + 1_000.0 / per_count(Range::Large);
        near(bench.coulombs() - charge, 4.0 * 4_001.0 / weight, 1e-8);
        // A reading in between that is impossible is refused, and the one after the gap has nothing to take along.
        bench.edge(1_004_500, Range::Large);
        assert_eq!(bench.read(1_004_500, 2), ReadingOutcome::Waits);
        let _ = bench.read(1_004_600, 9_999);
        assert_eq!(bench.channel.report().rejected, 1);
    }

    #[test]
    fn a_filter_in_front_adds_doubt_to_chatter() {
        let read = |front_end_delay_us| {
            let config = MeterConfig {
                front_end_delay_us,
                ..MeterConfig::default()
            };
            let mut bench = Bench::new(config, Range::Small);
            for (us, range) in [(50, Range::Large), (80, Range::Small), (110, Range::Large)] {
                bench.edge(us, range);
            }
            assert_eq!(bench.read(5_000, 1), ReadingOutcome::Estimated);
            bench.doubt()
        };
        near(read(10) - read(0), 9.0 * SWITCHING * 10e-6, 1e-8);
    }

    #[test]
    fn short_stays_within_a_long_interval() {
        let mut bench = Bench::new(MeterConfig::default(), Range::Large);
        let _ = bench.read(1_000_000, 800);
        let before = bench.coulombs();
        let doubt = bench.doubt();
        // 300 µs in the small range in the middle of 20 ms: 2.4 counts there, 15.7 in the large one.
        bench.edge(1_010_000, Range::Small);
        bench.edge(1_010_300, Range::Large);
        assert_eq!(bench.read(1_020_000, 18), ReadingOutcome::Estimated);
        near(
            bench.coulombs() - before,
            18.0 * per_count(Range::Large) - 9.0 * SWITCHING * 300e-6,
            1e-8,
        );
        // No change of scale, so no hidden bits: 9 · (1 A · 300 µs + slew + two stamps).
        let expected = 9.0 * (300e-6 + 1e4 * 9e-8 / 2.0 + SWITCHING * 10e-6);
        near(bench.doubt() - doubt, expected, 3e-9);
        assert_eq!(bench.channel.report().hand_overs, 2);
    }

    /// A storm's rest of 14 ms, in which nobody sees an edge: what the gated counter says decides.
    #[test]
    fn unwatched_time_is_shared_as_the_gated_counter_says() {
        let mut bench = Bench::new(MeterConfig::default(), Range::Large);
        let _ = bench.read(1_000_000, 800);
        let before = bench.coulombs();
        bench.edge(1_000_100, Range::Small);
        bench.recorder.suspend();
        bench.recorder.resume(at(1_015_000), true);
        bench.energy += 60;
        let reading = MeterReading {
            energy: bench.energy,
            at: at(1_016_000),
        };
        let history = RangeHistory {
            high: Duration::from_ticks(1_000_000 + 4_000),
            ..bench.recorder.history(reading.at)
        };
        let outcome = bench.channel.on_reading(reading, history);
        assert_eq!(outcome, ReadingOutcome::Estimated);
        let weight = 12e-3 / per_count(Range::Small) + 4e-3 / per_count(Range::Large);
        near(bench.coulombs() - before, 60.0 * 16e-3 / weight, 1e-8);
    }

    #[test]
    fn long_stays_in_both_ranges_are_shared_by_time() {
        // A constant current of 50 A: 60 ms of it in the small range, 40 ms in the large one.
        let config = MeterConfig {
            slew_limit_amps_per_second: 10,
            ..MeterConfig::default()
        };
        let mut bench = Bench::new(config, Range::Small);
        bench.edge(30_000, Range::Large);
        bench.edge(70_000, Range::Small);
        let counts = 50.0 * (60e-3 / per_count(Range::Small) + 40e-3 / per_count(Range::Large));
        assert_eq!(
            bench.read(100_000, counts.round() as i32),
            ReadingOutcome::Estimated
        );
        near(
            bench.coulombs(),
            50.0 * 100e-3 * counts.round() / counts,
            1e-7,
        );
        assert_eq!(bench.channel.report().estimated_intervals, 1);
        // 1 A of change at most, half of it over the excess of the small range's weight: 0.1 / (0.06 + 0.004) − 1; the
        // hidden bits at both ends; a stamp.
        let harmonic = per_count(Range::Small) * 0.1 / 0.064;
        near(
            bench.doubt(),
            0.5 * 60e-3 * (0.1 / 0.064 - 1.0) + harmonic + 9.0 * SWITCHING * 5e-6,
            1e-6,
        );
        // No faster change than from one end of the large range to the other is assumed.
        let mut bench = Bench::new(MeterConfig::default(), Range::Small);
        bench.edge(3_000_000, Range::Large);
        bench.edge(7_000_000, Range::Small);
        let _ = bench.read(10_000_000, 40_000);
        near(
            bench.doubt(),
            1_200.0 * 6.0 * (0.1 / 0.064 - 1.0) + harmonic + 9.0 * SWITCHING * 5e-6,
            1e-4,
        );
    }

    #[test]
    fn the_sign_of_a_stay_is_remembered_while_the_current_cannot_reverse() {
        // A stay with a positive sign, then out and in again.
        let run = |pause: u64| {
            let mut bench = Bench::new(MeterConfig::default(), Range::Large);
            let _ = bench.read(1_000_000, 900);
            bench.edge(2_000_000, Range::Small);
            let _ = bench.read(2_000_000, 900);
            let edge = 2_000_000 + pause;
            bench.edge(edge, Range::Large);
            let before = bench.coulombs();
            let _ = bench.read(edge + 100, 0);
            bench.coulombs() - before
        };
        // 2 · 53.3 A at 10 kA/s: 10.67 ms.
        near(run(10_500), 0.9 * SWITCHING * 100e-6, 1e-8);
        near(run(10_700), 0.0, 1e-9);
    }

    #[test]
    fn a_sign_that_never_showed_is_guessed_and_doubted() {
        let mut bench = Bench::new(MeterConfig::default(), Range::Small);
        bench.edge(1_000_000, Range::Large);
        let _ = bench.read(1_000_100, 0);
        bench.edge(1_050_000, Range::Small);
        let _ = bench.read(1_050_000, 0);
        let doubt = bench.doubt();
        near(bench.coulombs(), 0.0, 1e-9);
        let pending = 0.9 * SWITCHING * 100e-6;
        let _ = bench.read(2_000_000, -100);
        near(
            bench.coulombs(),
            -100.0 * per_count(Range::Small) - pending,
            1e-8,
        );
        // Waiting counts once, a guess twice.
        near(bench.doubt() - doubt, pending, 1e-8);
        // The stay's own counts are no guess.
        let mut bench = Bench::new(MeterConfig::default(), Range::Small);
        bench.edge(1_000_000, Range::Large);
        let _ = bench.read(1_000_100, 5_000);
        bench.edge(1_100_000, Range::Small);
        let _ = bench.read(1_100_000, -80);
        near(
            bench.coulombs(),
            5_000.0 * per_count(Range::Small) - 80.0 * per_count(Range::Large) - pending,
            2e-8,
        );
    }

    #[test]
    fn offset_is_taken_off_exactly() {
        let config = MeterConfig {
            offset: PerRange {
                small: Microamps(1),
                large: Microamps(-2_000_000),
            },
            ..MeterConfig::default()
        };
        let mut bench = Bench::new(config, Range::Small);
        // 1 µA · 1 µs a thousand times is 1 nC.
        for step in 1..=1_000 {
            let _ = bench.read(step, 0);
        }
        assert_eq!(bench.channel.report().charge_total, Nanocoulombs(-1));
        for step in 1_001..=2_000 {
            let _ = bench.read(step, 0);
        }
        assert_eq!(bench.channel.report().charge_total, Nanocoulombs(-2));
        let mut bench = Bench::new(config, Range::Large);
        let _ = bench.read(10_000_000, 0);
        assert_eq!(
            bench.channel.report().charge_total,
            Nanocoulombs::from_coulombs(20)
        );
        // By the times in each range where there is an edge.
        bench.edge(10_500_000, Range::Small);
        let _ = bench.read(11_000_000, 0);
        let report = bench.channel.report();
        near(report.charge_total.get() as f64 * 1e-9, 21.0 - 0.5e-6, 1e-9);
    }

    #[test]
    fn throughputs_are_kept_apart_and_restored() {
        let mut bench = Bench::new(MeterConfig::default(), Range::Small);
        let _ = bench.read(1_000_000, 1_000);
        let _ = bench.read(2_000_000, -400);
        let report = bench.channel.report();
        near(
            report.charge_out.get() as f64 * 1e-9,
            1_000.0 * per_count(Range::Small),
            1e-8,
        );
        near(
            report.charge_in.get() as f64 * 1e-9,
            400.0 * per_count(Range::Small),
            1e-8,
        );
        near(
            report.charge_total.get() as f64 * 1e-9,
            600.0 * per_count(Range::Small),
            1e-8,
        );
        assert_eq!(
            report.resolution,
            bench.channel.config().charge_per_count(Range::Small)
        );
        bench
            .channel
            .restore(Nanocoulombs(-7), Nanocoulombs(12), Nanocoulombs(5));
        let report = bench.channel.report();
        assert_eq!(report.charge_total, Nanocoulombs(-7));
        assert_eq!(
            (report.charge_in, report.charge_out),
            (Nanocoulombs(12), Nanocoulombs(5))
        );
        let _ = bench.read(3_000_000, 1);
        near(
            bench.channel.report().charge_total.get() as f64,
            per_count(Range::Small) * 1e9 - 7.0,
            1.0,
        );
    }

    #[test]
    fn the_mean_current_is_that_of_the_last_whole_window() {
        let mut bench = Bench::new(MeterConfig::default(), Range::Small);
        assert_eq!(bench.channel.report().mean_over, Duration::from_ticks(0));
        assert!(!bench.channel.report().below_no_load);
        let _ = bench.read(600_000, 600);
        assert_eq!(bench.channel.report().mean_over, Duration::from_ticks(0));
        let _ = bench.read(1_200_000, 600);
        let report = bench.channel.report();
        assert_eq!(report.mean_over, Duration::from_ticks(1_200_000));
        let mean = 1_200.0 * per_count(Range::Small) / 1.2;
        near(f64::from(report.mean_current.get()) * 1e-6, mean, 1e-6);
        assert!(!report.below_no_load);
        let _ = bench.read(2_200_000, -100);
        let report = bench.channel.report();
        let mean = -100.0 * per_count(Range::Small);
        near(f64::from(report.mean_current.get()) * 1e-6, mean, 1e-6);
        // Nothing for a window: 0 A, or anything below 3 mA.
        let _ = bench.read(3_200_000, 0);
        assert!(bench.channel.report().below_no_load);
        assert_eq!(bench.channel.report().mean_current, Microamps(0));
        let config = MeterConfig::default();
        assert_eq!(config.no_load_current(Range::Small), Microamps(3_000));
        assert_eq!(config.no_load_current(Range::Large), Microamps(30_000));
        // One count in 2.235 s is 3.0 mA, in 2.234 s just above.
        let _ = bench.read(5_440_000, 1);
        assert!(bench.channel.report().below_no_load);
        let _ = bench.read(7_670_000, 1);
        assert!(!bench.channel.report().below_no_load);
    }

    #[test]
    fn impossible_rates_are_refused_until_the_meter_counts_as_lost() {
        // 1.2 · 8,949 /s and four counts.
        let most = (1.2 * counts_per_second()).floor() as i32 + 4;
        let mut bench = Bench::new(MeterConfig::default(), Range::Small);
        assert_eq!(bench.read(1_000_000, most), ReadingOutcome::Integrated);
        assert_eq!(bench.read(2_000_000, -most), ReadingOutcome::Integrated);
        let refused = ReadingOutcome::Rejected(Rejection::RateOfChange);
        for sign in [1, -1] {
            assert_eq!(bench.read(3_000_000, sign * (most + 1)), refused);
            bench.energy -= sign * (most + 1);
            near(bench.coulombs(), 0.0, 1e-9);
        }
        assert_eq!(bench.channel.report().rejected, 2);
        // A good one ends the row.
        assert_eq!(bench.read(3_000_000, 10), ReadingOutcome::Integrated);
        for _ in 0..2 {
            assert_eq!(bench.read(3_100_000, 500_000), refused);
            assert!(!bench.channel.report().lost);
        }
        assert_eq!(bench.read(3_100_000, 500_000), refused);
        assert!(bench.channel.report().lost);
        assert_eq!(
            bench.read(3_100_000, 0),
            ReadingOutcome::Rejected(Rejection::Lost)
        );
        assert_eq!(bench.channel.report().rejected, 6);
        // Within one instant a few counts are the hidden bits.
        let mut bench = Bench::new(MeterConfig::default(), Range::Small);
        assert_eq!(bench.read(0, 4), ReadingOutcome::Integrated);
        assert_eq!(bench.read(0, 5), refused);
    }

    #[test]
    fn readings_out_of_order_or_too_late_are_refused() {
        let mut bench = Bench::new(MeterConfig::default(), Range::Small);
        let _ = bench.read(1_000, 0);
        let backwards = ReadingOutcome::Rejected(Rejection::TimeBackwards);
        assert_eq!(bench.read(999, 0), backwards);
        let stale = EdgeRecorder::new(at(0), false).history(at(500));
        let reading = MeterReading {
            energy: 0,
            at: at(2_000),
        };
        assert_eq!(bench.channel.on_reading(reading, stale), backwards);
        assert_eq!(LONGEST_INTERVAL.as_ticks() / 1_000_000, 781);
        let last = 1_000 + LONGEST_INTERVAL.as_ticks();
        assert_eq!(
            bench.read(last + 1, 0),
            ReadingOutcome::Rejected(Rejection::TooLate)
        );
        let mut bench = Bench::new(MeterConfig::default(), Range::Small);
        assert_eq!(
            bench.read(LONGEST_INTERVAL.as_ticks(), 8_000_000),
            ReadingOutcome::Integrated
        );
    }

    /// F5: a step from 0 to 50 A shortly before the gap, or anywhere in it, is not in the mean that bridges it.
    #[test]
    fn a_step_beside_a_gap_is_doubted_by_what_flows_behind_it() {
        let mut bench = Bench::new(MeterConfig::default(), Range::Small);
        let hidden_bits = 1.01 * per_count(Range::Small);
        let _ = bench.read(1_000_000, 0);
        bench.channel.on_meter_lost();
        let doubt = bench.doubt();
        let history = bench.recorder.history(at(1_040_000));
        let reading = MeterReading {
            energy: 0,
            at: at(1_040_000),
        };
        bench.channel.on_meter_restarted(
            reading,
            history,
            &bridge_of(Microamps::from_amps(0), 960_000, 991_000),
        );
        near(bench.doubt() - doubt, 0.04, 3e-9);
        // Too short an interval to tell a current.
        assert_eq!(bench.read(1_045_000, 37), ReadingOutcome::Integrated);
        near(bench.doubt() - doubt, 0.04, hidden_bits);
        // 149 counts in 20 ms are 49.95 A, for 40 ms of gap; and that once.
        for us in [1_065_000, 1_085_000] {
            assert_eq!(bench.read(us, 149), ReadingOutcome::Integrated);
            let change = 149.0 * per_count(Range::Small) / 0.02;
            near(bench.doubt() - doubt, 0.04 + change * 0.04, hidden_bits);
        }
    }

    proptest! {
        /// F2: a reading that is wrong by less than its rate shows. Either the next one undoes it, or it is refused each
        /// time it is read, and then the wrong one is taken back: the charge is what it would have been without it.
        #[test]
        fn a_disturbed_reading_leaves_nothing_in_the_charge(
            range: bool,
            rate in -180_i32..=180,
            wrong in -430_i32..=430,
            good in 2_usize..20,
        ) {
            let range = Range::from_flag(range);
            let mut bench = Bench::new(MeterConfig::default(), range);
            let mut us = 0;
            for _ in 0..good {
                us += 20_000;
                prop_assert_eq!(bench.read(us, rate), ReadingOutcome::Integrated);
            }
            us += 20_000;
            bench.energy += rate;
            let disturbed = bench.channel.on_reading(
                MeterReading { energy: bench.energy + wrong, at: at(us) },
                bench.recorder.history(at(us)),
            );
            us += 20_000;
            bench.energy += rate;
            let mut outcomes = std::vec::Vec::new();
            for attempt in 0..3 {
                us += 100 * attempt;
                outcomes.push(bench.read(us, 0));
                if outcomes.last() == Some(&ReadingOutcome::Integrated) {
                    break;
                }
            }
            prop_assert_eq!(outcomes.last(), Some(&ReadingOutcome::Integrated), "{:?}", disturbed);
            prop_assert!(!bench.channel.report().lost);
            us += 20_000;
            prop_assert_eq!(bench.read(us, rate), ReadingOutcome::Integrated);
            let counts = rate * (good as i32 + 3);
            let (charge, carried) = (f64::from(counts) * per_count(range), bench.channel.report());
            prop_assert!((bench.coulombs() - charge).abs() <= 2e-9 + 1e-12 * charge.abs());
            let net = carried.charge_out.get() - carried.charge_in.get();
            prop_assert!((net - carried.charge_total.get()).abs() <= 1);
        }
    }

    #[test]
    fn a_gap_is_bridged_and_doubted() {
        let mut bench = Bench::new(MeterConfig::default(), Range::Small);
        let _ = bench.read(1_000_000, 1_000);
        let before = bench.coulombs();
        let restart = |bench: &mut Bench, us: u64, bridge: GapBridge| {
            bench.channel.on_meter_lost();
            assert!(bench.channel.report().lost);
            bench.energy = 0;
            let reading = MeterReading {
                energy: 0,
                at: at(us),
            };
            let doubt = bench.doubt();
            let history = bench.recorder.history(at(us));
            bench.channel.on_meter_restarted(reading, history, &bridge);
            assert!(!bench.channel.report().lost);
            bench.doubt() - doubt
        };
        // 20 A for 50 ms, with 1 % and 1 A of doubt. The hidden bits count as before.
        let doubt = restart(
            &mut bench,
            1_050_000,
            bridge_of(Microamps::from_amps(20), 1_000_000, 1_030_000),
        );
        near(bench.coulombs() - before, 1.0, 1e-9);
        near(doubt, 0.01 + 0.05, 3e-9);
        // Counting goes on from the new register.
        assert_eq!(bench.read(1_070_000, 50), ReadingOutcome::Integrated);
        near(
            bench.coulombs() - before,
            1.0 + 50.0 * per_count(Range::Small),
            1e-8,
        );
        let _ = bench.read(1_180_000, 0);
        // Nothing is known of the current: anything that the sensor in use can show …
        let doubt = restart(&mut bench, 2_180_000, GapBridge::UNKNOWN);
        near(
            bench.coulombs() - before,
            1.0 + 50.0 * per_count(Range::Small),
            1e-8,
        );
        near(doubt, 60.0, 3e-9);
        assert_eq!(bench.channel.report().gaps, 2);
        assert_eq!(bench.channel.report().at, Some(at(2_180_000)));
        // Nothing bridged that gap, so there is nothing to compare.
        let hidden_bits = 1.01 * per_count(Range::Small);
        let doubt = bench.doubt();
        let _ = bench.read(2_200_000, 100);
        near(bench.doubt(), doubt, hidden_bits);
        // … or the large one, where the flag has changed.
        bench.edge(2_300_000, Range::Large);
        bench.edge(2_400_000, Range::Small);
        let doubt = restart(&mut bench, 3_200_000, GapBridge::UNKNOWN);
        near(doubt, 600.0, hidden_bits);
        // What the converter saw of another time counts no further than to its end: 20 A for the 40 ms of the gap.
        let _ = bench.read(3_220_000, 100);
        let before = bench.coulombs();
        let other = bridge_of(Microamps::from_amps(20), 3_200_000, 3_240_000);
        let doubt = restart(&mut bench, 3_260_000, other);
        near(bench.coulombs() - before, 0.8, 1e-9);
        near(doubt, 0.04 * 1.2, hidden_bits);
        // No conversion for too long: the last one is held, and what it may hide doubted.
        let stale = bridge_of(Microamps::from_amps(20), 3_260_000, 3_290_000);
        let doubt = restart(&mut bench, 3_390_000, stale);
        near(doubt, 0.03 * 1.2 + 0.1 * (60.0 + 20.0), hidden_bits);
    }

    /// From 300 A before the gap to −53.3 A behind it: the hand-over at the edge is that of a charging current.
    #[test]
    fn a_sign_does_not_outlast_a_gap() {
        let mut bench = Bench::new(MeterConfig::default(), Range::Large);
        let _ = bench.read(20_000, 90);
        bench.channel.on_meter_lost();
        let history = bench.recorder.history(at(40_000));
        let reading = MeterReading {
            energy: bench.energy,
            at: at(40_000),
        };
        let bridge = bridge_of(Microamps::from_amps(-53), 20_000, 40_000);
        bench.channel.on_meter_restarted(reading, history, &bridge);
        let before = bench.coulombs();
        bench.edge(58_000, Range::Small);
        let _ = bench.read(60_000, -30);
        near(
            bench.coulombs() - before,
            -SWITCHING * 0.02,
            per_count(Range::Large),
        );
    }

    #[test]
    fn a_first_reading_that_comes_late_ends_a_gap() {
        for (late, gaps) in [(false, 0), (true, 1)] {
            let mut channel = MeterChannel::new(MeterConfig::default());
            channel.start(at(5_000));
            let now = at(5_000 + FIRST_READING.as_ticks() + u64::from(late));
            let reading = MeterReading {
                energy: 77,
                at: now,
            };
            let history = RangeHistory::steady(now, Range::Large);
            let bridge = bridge_of(Microamps::from_amps(300), 5_000, now.as_ticks() - 1);
            match channel.on_reading(reading, history) {
                ReadingOutcome::First => assert!(!late),
                outcome => {
                    assert_eq!(outcome, ReadingOutcome::Rejected(Rejection::TooLate));
                    channel.on_meter_restarted(reading, history, &bridge);
                }
            }
            let report = channel.report();
            let charge = report.charge_total.get() as f64 * 1e-9;
            near(charge, if late { 60.0 } else { 0.0 }, 1e-3);
            assert_eq!((report.gaps, report.at), (gaps, Some(now)));
            assert_eq!(report.rejected, 0);
        }
    }

    #[test]
    fn a_meter_that_never_counted_begins_at_its_restart() {
        let mut channel = MeterChannel::new(MeterConfig::default());
        assert_eq!(
            channel.report(),
            MeterReport {
                resolution: MeterConfig::default().charge_per_count(Range::Small),
                uncertainty: Nanocoulombs(2),
                ..MeterReport::default()
            }
        );
        channel.on_meter_lost();
        let history = EdgeRecorder::new(at(0), false).history(at(0));
        let reading = MeterReading {
            energy: 77,
            at: at(0),
        };
        assert_eq!(
            channel.on_reading(reading, history),
            ReadingOutcome::Rejected(Rejection::Lost)
        );
        channel.on_meter_restarted(reading, history, &GapBridge::UNKNOWN);
        assert_eq!(channel.report().gaps, 0);
        assert_eq!(channel.report().charge_total, Nanocoulombs(0));
        assert!(!channel.report().lost);
        assert_eq!(
            channel.on_reading(reading, history),
            ReadingOutcome::Integrated
        );
    }

    #[test]
    fn a_restart_ends_the_row_of_refusals() {
        let mut bench = Bench::new(MeterConfig::default(), Range::Small);
        let _ = (bench.read(1_000, 9_999), bench.read(1_000, 9_999));
        let reading = MeterReading {
            energy: bench.energy,
            at: at(2_000),
        };
        let history = bench.recorder.history(at(2_000));
        bench
            .channel
            .on_meter_restarted(reading, history, &GapBridge::UNKNOWN);
        let _ = bench.read(3_000, 9_999);
        assert!(!bench.channel.report().lost);
    }

    #[test]
    fn another_calibration_keeps_what_was_counted() {
        let mut bench = Bench::new(MeterConfig::default(), Range::Small);
        let _ = bench.read(1_000_000, 3);
        let carry = bench.channel.booked.total;
        assert!(carry.carry != 0);
        let config = MeterConfig {
            gain: PerRange::both(Ppm(100_000)),
            ..MeterConfig::default()
        };
        bench.channel.set_config(config);
        assert_eq!(bench.channel.booked.total, carry);
        assert_eq!(bench.channel.config(), &config);
        let _ = bench.read(2_000_000, 10);
        near(
            bench.coulombs(),
            (3.0 + 11.0) * per_count(Range::Small),
            1e-8,
        );
    }

    /// A year at 250 A, read every 400 s: off by the scale's last digit alone.
    #[test]
    fn a_year_drifts_by_less_than_10_nanocoulombs() {
        let mut bench = Bench::new(MeterConfig::default(), Range::Large);
        let (mut counts, intervals) = (0_i128, 365 * 24 * 9);
        for interval in 1..=intervals {
            let step = 1_491_500 + (interval % 7) as i32;
            counts += i128::from(step);
            assert_eq!(
                bench.read(interval * 400_000_000, step),
                ReadingOutcome::Integrated
            );
        }
        // 600 A · 10⁹ nC · counts · 0.5 V · 4 · 2²⁵ / (product · 0.1 V · CLKIN), in whole numbers.
        let numerator = counts * 600_000_000_000 * 500 * 4 * (1 << 25);
        let exact = numerator / (1_677_722 * 100 * 3_579_545);
        let error = i128::from(bench.channel.report().charge_total.get()) - exact;
        assert!(error.abs() < 10, "{error} nC");
        assert!(exact > 7_880_000_000 * 1_000_000_000);
    }

    proptest! {
        /// F6: exact for every pair less than 2²³ apart, also where the register wraps.
        #[test]
        fn differences_are_exact_across_the_wrap(start: i32, difference in -(1 << 23) + 1..1_i32 << 23) {
            let register = |value: i32| (value << 8) >> 8;
            let earlier = register(start);
            let later = register(earlier.wrapping_add(difference));
            prop_assert_eq!(energy_difference(later, earlier), difference);
            // Bits above the 24 do not matter.
            prop_assert_eq!(energy_difference(later ^ (0x5A << 24), earlier), difference);
        }

        /// However the counts are split over readings, their charge is the same to the last digit.
        #[test]
        fn charge_does_not_depend_on_the_split(
            steps in prop::collection::vec(-10_000..10_000_i32, 1..200),
            offset in -100_000..100_000_i32,
            ppm in -5_000..5_000_i32,
            large: bool,
        ) {
            let range = Range::from_flag(large);
            let config = MeterConfig {
                offset: PerRange::both(Microamps(offset)),
                gain: PerRange::both(Ppm(ppm)),
                ..MeterConfig::default()
            };
            let mut split = Bench::new(config, range);
            let mut now = 0;
            for step in &steps {
                now += 1_000_001;
                prop_assert_eq!(split.read(now, *step), ReadingOutcome::Integrated);
            }
            let total: i32 = steps.iter().sum();
            let expected = i128::from(total) * i128::from(config.scale(range))
                - ((i128::from(offset) * i128::from(now)) << FRACTION_BITS);
            let sum = i128::from(split.channel.booked.total.whole) * i128::from(NANOCOULOMB)
                + i128::from(split.channel.booked.total.carry);
            prop_assert_eq!(sum, expected);
            if now <= LONGEST_INTERVAL.as_ticks() {
                let mut whole = Bench::new(config, range);
                prop_assert_eq!(whole.read(now, total), ReadingOutcome::Integrated);
                prop_assert_eq!(whole.channel.booked.total, split.channel.booked.total);
            }
            // And the throughputs are the net charge taken apart.
            let report = split.channel.report();
            let net = report.charge_out.get() - report.charge_in.get();
            prop_assert!((net - report.charge_total.get()).abs() <= 1);
        }

        #[test]
        fn the_accumulator_carries_exactly(parts in prop::collection::vec(any::<i64>(), 1..50)) {
            let mut sum = Accumulator::default();
            let mut exact = 0_i128;
            for part in parts {
                sum.add(i128::from(part));
                exact += i128::from(part);
            }
            prop_assert!((0..NANOCOULOMB).contains(&sum.carry));
            prop_assert_eq!(
                i128::from(sum.whole) * i128::from(NANOCOULOMB) + i128::from(sum.carry),
                exact
            );
            let rounded = i128::from(sum.rounded().get()) * i128::from(NANOCOULOMB);
            prop_assert!((rounded - exact).abs() * 2 <= i128::from(NANOCOULOMB));
        }

        #[test]
        fn factors_multiply(charge: i64, factor in -(9_i64 << 32)..9 << 32) {
            let wide = i128::from(charge) << 20;
            let exact = wide as f64 * factor as f64 / 2f64.powi(32);
            prop_assert!((times(wide, factor) as f64 - exact).abs() <= 2.0 + exact.abs() * 1e-12);
        }

        #[test]
        fn no_input_panics(
            currents in prop::array::uniform8(any::<i32>()),
            ppm in prop::array::uniform6(any::<i32>()),
            words in prop::array::uniform4(any::<u32>()),
            readings in prop::collection::vec(
                (any::<i32>(), any::<u64>(), any::<[u64; 5]>(), any::<[u32; 2]>(), any::<u16>(), any::<[bool; 3]>(), 0_u32..60),
                1..12,
            ),
        ) {
            let pair = |small, large| PerRange { small, large };
            let config = MeterConfig {
                full_scale: pair(Microamps(currents[0]), Microamps(currents[1])),
                gain: PerRange { small: Ppm(ppm[0]), large: Ppm(ppm[1]) },
                offset: pair(Microamps(currents[2]), Microamps(currents[3])),
                reference_error: Ppm(ppm[2]),
                divider_error: Ppm(ppm[3]),
                no_load: Ppm(ppm[4]),
                switching_current: Microamps(currents[4]),
                switching_tolerance: Microamps(currents[5]),
                slew_limit_amps_per_second: words[0],
                short_interval_us: words[1],
                front_end_delay_us: words[2],
                mean_window_ms: words[3],
                bridge_gain: Ppm(ppm[5]),
                bridge_offset: Microamps(currents[6]),
            };
            let mut channel = MeterChannel::new(config);
            let mut now = 0_u64;
            for (energy, gap, times, edges, coalesced, flags, shift) in readings {
                now = now.wrapping_add(gap >> shift);
                let history = RangeHistory {
                    range: Range::from_flag(flags[0]),
                    at: at(now),
                    large: Duration::from_ticks(times[1]),
                    edges: edges[0] % 4,
                    coalesced,
                    last_edge: flags[1].then_some(at(times[2])),
                    watched: edges[1] % 2 == 0,
                    high: Duration::from_ticks(times[3]),
                };
                let reading = MeterReading { energy, at: at(now) };
                let outcome = channel.on_reading(reading, history);
                if matches!(outcome, ReadingOutcome::Rejected(_)) && flags[2] {
                    let bridge = GapBridge {
                        since: at(times[0]),
                        until: at(times[1]),
                        charge: Nanocoulombs(i64::from(currents[6]) << (edges[1] % 33)),
                        doubt: Nanocoulombs(i64::from(currents[5]) << (edges[1] % 33)),
                        current: (edges[1] % 3 != 0).then_some(Microamps(currents[7])),
                        holds: Duration::from_ticks(times[2]),
                    };
                    channel.on_meter_restarted(reading, history, &bridge);
                }
                let _ = channel.report();
            }
            let _ = [Range::Small, Range::Large].map(|range| (config.charge_per_count(range), config.no_load_current(range)));
        }
    }
}
