//! State of charge: ampere-hours integrated from the meter's charge, re-anchored on the open-circuit voltage after a
//! rest (the two methods that the D2 paper uses together).
//!
//! **Integration.** The charge that remains, in nanocoulombs, follows the *differences* of the meter's signed counter.
//! The counter itself never enters, so neither its sign nor its size can move the state of charge. What is charged
//! counts with the coulombic efficiency; the fraction below a nanocoulomb is carried. A charging excursion bears the
//! loss only past [`EXCURSION`]: a counter that flickers by a count at rest would otherwise lose charge with
//! every flicker. For the same reason what is charged and what is discharged moves on by such excursions as a whole: what
//! goes to and fro within one is in neither sum for good. Integration itself has no dead band.
//!
//! **0 and 100 %.** The charge that remains stops at 0 and at the capacity, and what exceeds them is added to
//! [`SocReading::clipped`] (it says that capacity or offset are set wrong). So the first charge in the other direction
//! leaves the end at once.
//!
//! **Uncertainty.** One half-width, a linear and therefore cautious sum: current offset times time, gain and capacity
//! uncertainty times throughput, the meter's no-load threshold times the time without a count, and whatever charge loss
//! the caller declares.
//!
//! **Rest.** When the current has stayed below a threshold for the rest time and the cell voltage is fresh and has
//! stopped moving, the estimate from the OCV table is blended in by inverse variance: with the prior's half-width p and
//! the table's r the estimate moves by p²/(p² + r²) of the difference. A flat piece of the curve makes r large and so
//! counts little. Within one rest it happens once, and again only when the uncertainty has doubled since: the error of a
//! table is no noise that averages away. For the same reason the uncertainty never ends below r/√2 (unless it was
//! there before).
//!
//! **On the bus.** The estimate moves at once, the presented value follows it by at most
//! [`SocConfig::presented_slew_ppm_per_s`]; what is between them is added to the half-width that goes out. Only the very
//! first anchor is presented at once: until then the state of charge is marked as not known.

use serde::{Deserialize, Serialize};

use crate::design_parameters::{
    DEFAULT_CAPACITY_MAH, DEFAULT_COULOMBIC_EFFICIENCY_PPM, METER_NO_LOAD, SMALL_FULL_SCALE,
};
use crate::ocv::OcvTable;
use crate::units::{
    Duration, Instant, Microamps, Microvolts, Nanocoulombs, Ppm, add_i64, clamp_i32,
    clamp_i32_inline, clamp_i64, div_i128, div_round, elapsed, isqrt, milliseconds, mul_div,
    mul_wide, sub_i64,
};

/// Excursions of the charge up to this bear no efficiency loss and add up to no throughput: 150 counts of the small range, 15 of
/// the large one, and a part in 10⁶ of a common battery.
pub const EXCURSION: Nanocoulombs = Nanocoulombs::from_coulombs(1);

/// Capacities that the arithmetic is laid out for.
pub const CAPACITY_LIMITS_MAH: (u32, u32) = (1, 2_000_000);

/// Uncertainty and rest are worked out this often, the charge at every call.
const SLOW_STEP_US: u64 = 1_000_000;

/// Longest time between two updates, or without a valid conversion, through which a rest is believed to last.
pub(crate) const LONGEST_UNSEEN_REST: Duration = Duration::from_ticks(1_000_000);

/// Largest difference of the counter that is charge: 320,000 Ah. It keeps the sums below inside 64 bits.
const LARGEST_DIFFERENCE: u64 = 1 << 60;

/// Binary places of [`SocCoefficients::offset_per_us`] and [`SocCoefficients::no_load_per_us`].
const PER_US_PLACES: u32 = 22;

/// Binary places of the reciprocal that makes a charge a share of the capacity.
const RECIPROCAL_PLACES: u32 = 42;

/// Binary places of [`SocCoefficients::slew_per_us`].
const SLEW_PLACES: u32 = 10;

/// Configuration of the state of charge.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct SocConfig {
    /// Charge of the full battery in mAh, 1 … 2,000,000.
    pub capacity_mah: u32,
    /// Share of charged charge that can be discharged again, 500,000 … 1,000,000 ppm.
    pub coulombic_efficiency: Ppm,
    /// Currents up to this, both signs, are a rest.
    pub rest_current: Microamps,
    /// Length of a rest after which the cell's voltage is its open-circuit voltage, in seconds.
    pub rest_time_s: u32,
    /// Largest change of the cell voltage over [`SocConfig::stability_window_s`] at which it counts as settled.
    pub stability: Microvolts,
    /// Time over which the cell voltage must not move, in seconds.
    pub stability_window_s: u32,
    /// Oldest cell voltage that is used, in milliseconds.
    pub cell_voltage_max_age_ms: u32,
    /// Half-width of the open-circuit voltage: table, hysteresis, relaxation left, cell-voltage measurement.
    pub ocv_uncertainty: Microvolts,
    /// Half-width of the current offset that is left after the zero-drift compensation.
    pub offset_uncertainty: Microamps,
    /// Currents up to this may flow without a count (no-load threshold of the ADE7753). What the meter's configuration makes of the
    /// sensor's full scale is taken where it is more.
    pub no_load_threshold: Microamps,
    /// Half-width of the gain of the current measurement.
    pub gain_uncertainty: Ppm,
    /// Half-width of the capacity.
    pub capacity_uncertainty: Ppm,
    /// Rate at which the presented value follows the estimate after an anchor, 1 … 10,000 ppm/s.
    pub presented_slew_ppm_per_s: u32,
}

impl Default for SocConfig {
    /// A 240 Ah battery (D4's example); every figure without a source is *assumed*.
    fn default() -> Self {
        Self {
            capacity_mah: DEFAULT_CAPACITY_MAH,
            coulombic_efficiency: Ppm(DEFAULT_COULOMBIC_EFFICIENCY_PPM),
            // 1 A in a 240 Ah cell of about 1 mΩ shifts the voltage by 1 mV, well inside `ocv_uncertainty`.
            rest_current: Microamps::from_amps(1),
            rest_time_s: 1_800,
            stability: Microvolts::from_millivolts(1),
            stability_window_s: 300,
            cell_voltage_max_age_ms: 1_000,
            ocv_uncertainty: Microvolts::from_millivolts(5),
            offset_uncertainty: Microamps::from_milliamps(20),
            no_load_threshold: NO_LOAD,
            // D2: not worse than 1 % against the reference.
            gain_uncertainty: Ppm(10_000),
            capacity_uncertainty: Ppm(20_000),
            presented_slew_ppm_per_s: 200,
        }
    }
}

/// The no-load threshold in the small range, which is the one in use at rest.
#[expect(clippy::cast_possible_truncation, reason = "3,000 µA")]
const NO_LOAD: Microamps =
    Microamps((SMALL_FULL_SCALE.get() as i64 * METER_NO_LOAD.get() as i64 / 1_000_000) as i32);

/// [`SocConfig`] turned into multipliers, made once when the configuration changes: a division of 64 bits costs the
/// Cortex-M4 more than the whole update.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SocCoefficients {
    config: SocConfig,
    capacity: i64,
    /// Places by which a charge is shifted so that the capacity lies in 2³⁰ … 2³¹.
    shift: u32,
    /// 10⁶ / (capacity >> shift), with [`RECIPROCAL_PLACES`].
    reciprocal: i64,
    /// 1 − efficiency in 2⁻³²; its rounding is 1.2·10⁻¹⁰ of what is charged.
    loss_q32: u32,
    /// Nanocoulombs per microsecond by which the presented value approaches the estimate, with [`SLEW_PLACES`].
    slew_per_us: i64,
    /// Share of the throughput by which the uncertainty grows, in 2⁻³²; below one.
    throughput_q32: u32,
    /// Nanocoulombs per microsecond by which the uncertainty grows, with [`PER_US_PLACES`].
    offset_per_us: u64,
    /// The same for time without a count.
    no_load_per_us: u64,
}

impl SocCoefficients {
    /// The multipliers for a configuration; values outside the limits of their fields are taken at the limit.
    #[must_use]
    pub fn new(config: &SocConfig) -> Self {
        let (smallest, largest) = CAPACITY_LIMITS_MAH;
        let capacity_mah = config.capacity_mah.clamp(smallest, largest);
        let capacity = Nanocoulombs::from_milliamp_hours(i64::from(capacity_mah)).get();
        // The smallest capacity is 2^31.7 nC, so there is always something to shift.
        let shift = (i64::BITS - 31).saturating_sub(capacity.leading_zeros());
        let scaled = capacity >> shift;
        // 10⁶ · 2⁴² fits.
        let reciprocal = (i64::from(Ppm::ONE.get()) << RECIPROCAL_PLACES) / scaled.max(1);
        let lost = Ppm::ONE.get()
            - config
                .coulombic_efficiency
                .get()
                .clamp(500_000, Ppm::ONE.get());
        let slew = i64::from(config.presented_slew_ppm_per_s.clamp(1, 10_000));
        let slew_per_us = div_i128(mul_wide(capacity, slew) << SLEW_PLACES, 1_000_000_000_000);
        Self {
            config: *config,
            capacity,
            shift,
            reciprocal,
            loss_q32: share_q32(lost),
            slew_per_us: clamp_i64(slew_per_us).max(1),
            throughput_q32: share_q32(
                config
                    .gain_uncertainty
                    .get()
                    .max(0)
                    .saturating_add(config.capacity_uncertainty.get().max(0)),
            ),
            offset_per_us: per_us(config.offset_uncertainty),
            no_load_per_us: per_us(config.no_load_threshold),
        }
    }

    /// Charge of the full battery.
    #[must_use]
    pub const fn capacity(&self) -> Nanocoulombs {
        Nanocoulombs(self.capacity)
    }

    /// A charge cut to what the battery holds. Not `clamp`, which panics where the end lies below the begin, as damage can make it.
    fn within(&self, charge: i64) -> i64 {
        charge.min(self.capacity).max(0)
    }

    /// A charge as a share of the capacity: 0 … 1,000,000 ppm, never decreasing with the charge, within 0.51 ppm.
    #[must_use]
    pub fn share(&self, charge: Nanocoulombs) -> Ppm {
        let inside = self.within(charge.get());
        // At most 10⁶ · 2⁴², which fits.
        let product = (inside >> self.shift) * self.reciprocal;
        Ppm(clamp_i32_inline(
            (product + (1 << (RECIPROCAL_PLACES - 1))) >> RECIPROCAL_PLACES,
        ))
    }

    /// The charge that is this share of the capacity.
    fn charge_of(&self, share: Ppm) -> i64 {
        mul_div(
            self.capacity,
            i64::from(share.get()),
            i64::from(Ppm::ONE.get()),
        )
    }
}

/// A cell voltage as received over CAN. Of several cells it is the one whose charge limits the battery, usually the
/// lowest.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct CellVoltage {
    /// The voltage.
    pub voltage: Microvolts,
    /// When it arrived.
    pub at: Instant,
}

/// What one update is fed with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct SocInput {
    /// Time of the charge.
    pub now: Instant,
    /// The meter's cumulative signed counter, + is discharge.
    pub charge_total: Nanocoulombs,
    /// The current; `None` when it is not valid, then there is no rest.
    pub current: Option<Microamps>,
    /// The newest cell voltage received, if any.
    pub cell_voltage: Option<CellVoltage>,
}

/// What of the state must survive a reset.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct SocRetained {
    /// The capacity that the charges belong to, in mAh; 0 is none, and they are taken as they are. The settings may come back with another
    /// one: those of another version, or not saved.
    pub capacity_mah: u32,
    /// Charge that can still be discharged, 0 … capacity.
    pub remaining: Nanocoulombs,
    /// Presented minus estimated charge, on its way to 0.
    pub presented_offset: Nanocoulombs,
    /// Half-width of the remaining charge.
    pub uncertainty: Nanocoulombs,
    /// Whether the state of charge was ever anchored or set.
    pub known: bool,
    /// Everything ever charged, positive.
    pub charged: Nanocoulombs,
    /// Everything ever discharged, positive.
    pub discharged: Nanocoulombs,
    /// Fraction of a nanocoulomb of efficiency loss that is carried, in 2⁻³².
    pub loss_carry: u32,
}

/// The state of charge as others see it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct SocReading {
    /// The value for the bus, 0 … 1,000,000 ppm, slew-limited after an anchor.
    pub presented: Ppm,
    /// The best estimate, 0 … 1,000,000 ppm.
    pub estimate: Ppm,
    /// Half-width of the estimate.
    pub uncertainty: Ppm,
    /// Charge that can still be discharged, as estimated.
    pub remaining: Nanocoulombs,
    /// Whether the state of charge was ever anchored or set; if not, the values above say nothing.
    pub known: bool,
    /// Whether the current is at rest at present.
    pub resting: bool,
    /// Anchors on the open-circuit voltage since the start.
    pub anchors: u32,
    /// Charge that did not fit between empty and full since the start (magnitudes added).
    pub clipped: Nanocoulombs,
    /// Jumps of the counter that no charge can make (differences beyond 64 bits), since the start.
    pub counter_jumps: u32,
}

impl SocReading {
    /// Half-width of [`SocReading::presented`]: while it follows the estimate its distance counts too.
    #[must_use]
    pub fn presented_uncertainty(&self) -> Ppm {
        let distance = self.presented.get().abs_diff(self.estimate.get());
        let half_width = self.uncertainty.get().saturating_add_unsigned(distance);
        Ppm(half_width.min(Ppm::ONE.get()))
    }
}

/// What an update did beyond integrating.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum SocEvent {
    /// The estimate was re-anchored on the open-circuit voltage.
    Anchored {
        /// State of charge that the table gave.
        ocv: Ppm,
        /// Estimate before.
        before: Ppm,
        /// Estimate after.
        after: Ppm,
    },
    /// The cell voltage at the end of a qualified rest is not that of a cell; nothing was changed.
    ImplausibleVoltage(Microvolts),
}

/// The state.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Soc {
    kept: SocRetained,
    last_total: Option<Nanocoulombs>,
    last_update: Option<Instant>,
    /// Charging that may still happen without a loss, 0 … [`EXCURSION`].
    slack: i64,
    /// What has flowed since charged and discharged were last moved, within [`EXCURSION`].
    excursion: i64,
    clipped: i64,
    counter_jumps: u32,
    anchors: u32,
    /// Time since the last slow step.
    pending_us: u64,
    /// The part of it in which the counter stood still.
    pending_idle_us: u64,
    /// Everything charged and discharged at the last slow step.
    aged_throughput: i64,
    rest_since: Option<Instant>,
    /// Where the cell voltage stopped moving.
    settled: Option<CellVoltage>,
    /// Uncertainty right after the anchor of this rest.
    anchored_at: Option<i64>,
}

impl Soc {
    /// The state of a battery of which nothing is known: half full ± everything, until a first rest or
    /// [`Soc::set`].
    #[must_use]
    pub fn new(coefficients: &SocCoefficients) -> Self {
        Self::with(
            SocRetained {
                capacity_mah: coefficients.config.capacity_mah,
                remaining: Nanocoulombs(coefficients.capacity / 2),
                uncertainty: Nanocoulombs(coefficients.capacity),
                ..SocRetained::default()
            },
            None,
        )
    }

    /// Goes on after a reset. `charge_total` is the meter's counter that was saved together with `kept`: what the
    /// counter gained since is counted with the first update. Another capacity is taken over as [`Soc::change_capacity`] does; values that do
    /// not fit it are taken at its ends.
    #[must_use]
    pub fn restore(
        coefficients: &SocCoefficients,
        kept: &SocRetained,
        charge_total: Nanocoulombs,
    ) -> Self {
        let positive = |charge: Nanocoulombs| Nanocoulombs(charge.get().max(0));
        let kept = SocRetained {
            charged: positive(kept.charged),
            discharged: positive(kept.discharged),
            ..*kept
        };
        let mut soc = Self::with(kept, Some(charge_total));
        soc.change_capacity(coefficients);
        for charge in [&mut soc.kept.remaining, &mut soc.kept.uncertainty] {
            charge.0 = coefficients.within(charge.get());
        }
        soc.keep_presented_inside(coefficients);
        soc
    }

    const fn with(kept: SocRetained, last_total: Option<Nanocoulombs>) -> Self {
        Self {
            kept,
            last_total,
            last_update: None,
            slack: EXCURSION.get(),
            excursion: 0,
            clipped: 0,
            counter_jumps: 0,
            anchors: 0,
            pending_us: 0,
            pending_idle_us: 0,
            aged_throughput: kept.charged.saturating_add(kept.discharged).get(),
            rest_since: None,
            settled: None,
            anchored_at: None,
        }
    }

    /// What must be saved; with it belongs the counter of the last update.
    #[must_use]
    pub const fn retained(&self) -> SocRetained {
        let (charged, discharged) = self.throughput();
        SocRetained {
            charged,
            discharged,
            ..self.kept
        }
    }

    /// Everything ever charged and everything ever discharged, both positive, with the excursion under way.
    #[must_use]
    pub const fn throughput(&self) -> (Nanocoulombs, Nanocoulombs) {
        let SocRetained {
            charged,
            discharged,
            ..
        } = self.kept;
        let excursion = self.excursion;
        if excursion >= 0 {
            (
                charged,
                Nanocoulombs(discharged.get().saturating_add(excursion)),
            )
        } else {
            (Nanocoulombs(sub_i64(charged.get(), excursion)), discharged)
        }
    }

    /// Sets the state of charge, as a host does after service; presented at once.
    pub fn set(&mut self, coefficients: &SocCoefficients, soc: Ppm, uncertainty: Ppm) {
        let share = |ppm: Ppm| Ppm(ppm.get().clamp(0, Ppm::ONE.get()));
        self.kept.remaining.0 = coefficients.charge_of(share(soc));
        self.kept.uncertainty.0 = coefficients.charge_of(share(uncertainty));
        self.kept.presented_offset = Nanocoulombs::ZERO;
        self.kept.known = true;
    }

    /// Adds charge of which the counter may be wrong without knowing: a gap bridged, a save interval lost.
    pub fn declare_loss(&mut self, coefficients: &SocCoefficients, bound: Nanocoulombs) {
        self.grow_uncertainty(coefficients, bound.saturating_abs().get());
    }

    /// Takes over another capacity. The state of charge stays, the charge scales: what changes a capacity is that the
    /// battery has aged or was measured anew, and a full one is still full.
    pub fn change_capacity(&mut self, coefficients: &SocCoefficients) {
        let new = coefficients.config.capacity_mah;
        let old = core::mem::replace(&mut self.kept.capacity_mah, new);
        if old == new || old == 0 {
            return;
        }
        let scaled = |charge| mul_div(charge, i64::from(new), i64::from(old));
        for charge in [
            &mut self.kept.remaining,
            &mut self.kept.presented_offset,
            &mut self.kept.uncertainty,
        ] {
            charge.0 = scaled(charge.get());
        }
        self.anchored_at = self.anchored_at.map(scaled);
    }

    /// Integrates up to `input.now`, and once a second looks after uncertainty and rest.
    pub fn update(
        &mut self,
        coefficients: &SocCoefficients,
        table: &OcvTable,
        input: &SocInput,
    ) -> Option<SocEvent> {
        let time = self
            .last_update
            .map_or(Duration::from_ticks(0), |last| elapsed(last, input.now));
        self.last_update = Some(input.now);

        let delta = self.count(input.charge_total);
        self.integrate(coefficients, delta);
        if self.kept.presented_offset != Nanocoulombs::ZERO {
            self.approach_estimate(coefficients, time);
        }
        self.pending_us = self.pending_us.saturating_add(time.as_ticks());
        if delta == 0 {
            self.pending_idle_us = self.pending_idle_us.saturating_add(time.as_ticks());
        }

        let at_rest = input
            .current
            .is_some_and(|current| current.saturating_abs() <= coefficients.config.rest_current);
        if !at_rest || time > LONGEST_UNSEEN_REST {
            self.rest_since = None;
            self.settled = None;
            self.anchored_at = None;
        }
        if at_rest && self.rest_since.is_none() {
            self.rest_since = Some(input.now);
        }

        if self.pending_us < SLOW_STEP_US {
            return None;
        }
        self.age(coefficients);
        self.look_at_rest(coefficients, table, input)
    }

    /// The state of charge as others see it.
    #[must_use]
    pub fn reading(&self, coefficients: &SocCoefficients) -> SocReading {
        SocReading {
            presented: coefficients.share(Nanocoulombs(
                self.kept.remaining.get() + self.kept.presented_offset.get(),
            )),
            estimate: coefficients.share(self.kept.remaining),
            uncertainty: coefficients.share(self.kept.uncertainty),
            remaining: self.kept.remaining,
            known: self.kept.known,
            resting: self.rest_since.is_some(),
            anchors: self.anchors,
            clipped: Nanocoulombs(self.clipped),
            counter_jumps: self.counter_jumps,
        }
    }

    /// Full cycles that the discharged charge amounts to, in thousandths.
    #[must_use]
    pub fn equivalent_cycles_milli(&self, coefficients: &SocCoefficients) -> i64 {
        mul_div(self.kept.discharged.get(), 1_000, coefficients.capacity)
    }

    /// The counter's difference since the last update; its value and sign mean nothing here.
    fn count(&mut self, total: Nanocoulombs) -> i64 {
        let last = self.last_total.replace(total).unwrap_or(total);
        match total.get().checked_sub(last.get()) {
            Some(delta) if delta.unsigned_abs() <= LARGEST_DIFFERENCE => delta,
            _ => {
                self.counter_jumps = self.counter_jumps.saturating_add(1);
                0
            }
        }
    }

    /// Plain sums: a difference is at most 2⁶⁰ and a capacity below 2⁵³, see [`LARGEST_DIFFERENCE`].
    fn integrate(&mut self, coefficients: &SocCoefficients, delta: i64) {
        let mut remaining = self.kept.remaining.get() - delta;
        self.excursion += delta;
        // As [`Self::throughput`] has it, written out: every reading goes through here, and its instructions are bounded.
        if self.excursion >= EXCURSION.get() {
            self.kept.discharged.0 = self.kept.discharged.get().saturating_add(self.excursion);
            self.excursion = 0;
        } else if self.excursion <= -EXCURSION.get() {
            self.kept.charged.0 = sub_i64(self.kept.charged.get(), self.excursion);
            self.excursion = 0;
        }
        if delta >= 0 {
            self.slack = (self.slack + delta).min(EXCURSION.get());
        } else {
            self.slack += delta;
            if self.slack < 0 {
                remaining -= self.loss(coefficients, self.slack.unsigned_abs());
                self.slack = 0;
            }
        }
        let limited = coefficients.within(remaining);
        if limited != remaining {
            self.clipped = add_i64(self.clipped, (remaining - limited).abs());
        }
        self.kept.remaining.0 = limited;
    }

    /// `charged · (1 − efficiency)`, the fraction carried.
    fn loss(&mut self, coefficients: &SocCoefficients, charged: u64) -> i64 {
        let (whole, fraction) = mul_q32(charged, coefficients.loss_q32, self.kept.loss_carry);
        self.kept.loss_carry = fraction;
        whole
    }

    /// Presented and estimated value both lie between empty and full, so that neither sticks to an end.
    fn keep_presented_inside(&mut self, coefficients: &SocCoefficients) {
        let remaining = self.kept.remaining.get();
        // What was restored may be any number.
        let presented = coefficients.within(add_i64(remaining, self.kept.presented_offset.get()));
        self.kept.presented_offset.0 = presented - remaining;
    }

    fn approach_estimate(&mut self, coefficients: &SocCoefficients, time: Duration) {
        let offset = self.kept.presented_offset.get();
        let time_us = i64::try_from(time.as_ticks()).unwrap_or(i64::MAX);
        let step = coefficients.slew_per_us.saturating_mul(time_us) >> SLEW_PLACES;
        // Of opposite signs: neither sum leaves the type.
        self.kept.presented_offset.0 = if offset > 0 {
            (offset - step).max(0)
        } else {
            (offset + step).min(0)
        };
        self.keep_presented_inside(coefficients);
    }

    fn grow_uncertainty(&mut self, coefficients: &SocCoefficients, by: i64) {
        self.kept.uncertainty.0 =
            coefficients.within(self.kept.uncertainty.get().saturating_add(by));
    }

    fn age(&mut self, coefficients: &SocCoefficients) {
        let (charged, discharged) = (self.kept.charged.get(), self.kept.discharged.get());
        let throughput = charged.saturating_add(discharged);
        let new = throughput
            .saturating_sub(self.aged_throughput)
            .unsigned_abs();
        let (gain, _) = mul_q32(new, coefficients.throughput_q32, 0);
        let offset = grown(coefficients.offset_per_us, self.pending_us);
        let no_load = grown(coefficients.no_load_per_us, self.pending_idle_us);
        self.aged_throughput = throughput;
        self.pending_us = 0;
        self.pending_idle_us = 0;
        let grown = gain.saturating_add(offset).saturating_add(no_load);
        self.grow_uncertainty(coefficients, grown);
    }

    fn look_at_rest(
        &mut self,
        coefficients: &SocCoefficients,
        table: &OcvTable,
        input: &SocInput,
    ) -> Option<SocEvent> {
        let config = &coefficients.config;
        let since = self.rest_since?;
        // `now` is the meter's last reading: a voltage received since is as fresh as can be.
        let cell = input.cell_voltage.filter(|cell| {
            elapsed(cell.at, input.now) <= milliseconds(config.cell_voltage_max_age_ms)
        });
        let Some(cell) = cell else {
            self.settled = None;
            return None;
        };
        let settled = match self.settled {
            Some(start)
                if start.voltage.saturating_sub(cell.voltage).saturating_abs()
                    <= config.stability =>
            {
                start
            }
            _ => {
                let start = CellVoltage {
                    at: input.now,
                    ..cell
                };
                self.settled = Some(start);
                start
            }
        };
        let rested = elapsed(since, input.now) >= seconds(config.rest_time_s);
        let still = elapsed(settled.at, input.now) >= seconds(config.stability_window_s);
        let worth_it = self
            .anchored_at
            .is_none_or(|after| self.kept.uncertainty.get() >= after.saturating_mul(2).max(1));
        if !(rested && still && worth_it) {
            return None;
        }
        let event = self.anchor(coefficients, table, cell.voltage);
        if let SocEvent::Anchored { .. } = event {
            self.anchored_at = Some(self.kept.uncertainty.get());
        } else {
            // Told once: looked at again when it has moved, and been still since.
            self.settled = Some(CellVoltage {
                at: Instant::from_ticks(u64::MAX),
                ..settled
            });
        }
        Some(event)
    }

    fn anchor(
        &mut self,
        coefficients: &SocCoefficients,
        table: &OcvTable,
        voltage: Microvolts,
    ) -> SocEvent {
        let Some(ocv) = table.estimate(voltage, coefficients.config.ocv_uncertainty) else {
            return SocEvent::ImplausibleVoltage(voltage);
        };
        let before = self.kept.remaining.get();
        let target = coefficients.charge_of(ocv.soc);
        let table_width = u64::from(ocv.uncertainty.get().unsigned_abs());
        if self.kept.known {
            let prior = u64::from(
                coefficients
                    .share(self.kept.uncertainty)
                    .get()
                    .unsigned_abs(),
            );
            let blend = Blend::of(prior, table_width);
            let step = mul_div(sub_i64(target, before), blend.weight_ppm, 1_000_000);
            self.kept.remaining.0 = coefficients.within(add_i64(before, step));
            self.kept.uncertainty.0 = coefficients.charge_of(Ppm(clamp_i32(blend.width)));
            self.kept.presented_offset.0 = sub_i64(self.kept.presented_offset.get(), step);
            self.keep_presented_inside(coefficients);
        } else {
            self.kept.remaining.0 = target;
            self.kept.uncertainty.0 = coefficients.charge_of(ocv.uncertainty);
            self.kept.presented_offset = Nanocoulombs::ZERO;
            self.kept.known = true;
        }
        self.anchors = self.anchors.saturating_add(1);
        SocEvent::Anchored {
            ocv: ocv.soc,
            before: coefficients.share(Nanocoulombs(before)),
            after: coefficients.share(self.kept.remaining),
        }
    }
}

/// Two estimates of one quantity combined by inverse variance.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Blend {
    /// Weight of the second one.
    weight_ppm: i64,
    /// Half-width of the result, in ppm.
    width: i64,
}

impl Blend {
    /// From half-widths in ppm. At most 10⁶ each, so that the largest product below is 10¹⁸ and fits.
    fn of(prior: u64, table: u64) -> Self {
        let (prior, table) = (prior.min(1_000_000), table.clamp(1, 1_000_000));
        let (prior2, table2) = (prior * prior, table * table);
        let sum = prior2 + table2;
        let width = prior * table / isqrt(sum).max(1);
        // The table's error is common to every reading of it: below 1/√2 of it nothing is gained by repetition.
        let floor = prior.min(table * 707_107 / 1_000_000);
        Self {
            weight_ppm: div_round((prior2 * 1_000_000).cast_signed(), sum.cast_signed()),
            width: i64::try_from(width.max(floor)).unwrap_or(i64::MAX),
        }
    }
}

/// `value · factor / 2³² + carry / 2³²` as whole and fraction, in halves of 32 bits: without a 128-bit product.
fn mul_q32(value: u64, factor_q32: u32, carry: u32) -> (i64, u32) {
    let factor = u64::from(factor_q32);
    let low = (value & u64::from(u32::MAX)) * factor + u64::from(carry);
    let whole = (value >> 32) * factor + (low >> 32);
    #[expect(
        clippy::cast_possible_truncation,
        reason = "the low half is the fraction"
    )]
    let fraction = low as u32;
    (i64::try_from(whole).unwrap_or(i64::MAX), fraction)
}

/// A share in 2⁻³², rounded to nearest: by at most 1.2·10⁻¹⁰.
fn share_q32(ppm: i32) -> u32 {
    let share = div_round(i64::from(ppm) << 32, i64::from(Ppm::ONE.get()));
    u32::try_from(share).unwrap_or(u32::MAX)
}

/// µA as nC per µs, that is 10⁻³ of it, with [`PER_US_PLACES`].
fn per_us(current: Microamps) -> u64 {
    (u64::from(current.saturating_abs().get().unsigned_abs()) << PER_US_PLACES) / 1_000
}

/// What [`per_us`] makes in this time.
fn grown(per_us: u64, time_us: u64) -> i64 {
    let grown = (u128::from(per_us) * u128::from(time_us)) >> PER_US_PLACES;
    i64::try_from(grown).unwrap_or(i64::MAX)
}

fn seconds(seconds: u32) -> Duration {
    Duration::from_ticks(u64::from(seconds) * 1_000_000)
}

#[cfg(test)]
#[allow(
    clippy::unwrap_used,
    clippy::indexing_slicing,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss
)]
mod tests {
    use super::*;
    use crate::ocv::OcvPoint;
    use proptest::prelude::*;

    const COULOMB: i64 = 1_000_000_000;

    /// 10 Ah = 36,000 C, no loss, so that a per cent is 360 C.
    fn config() -> SocConfig {
        SocConfig {
            capacity_mah: 10_000,
            coulombic_efficiency: Ppm::ONE,
            rest_current: Microamps::from_milliamps(500),
            rest_time_s: 600,
            stability: Microvolts(1_000),
            stability_window_s: 60,
            cell_voltage_max_age_ms: 1_000,
            ocv_uncertainty: Microvolts(10_000),
            offset_uncertainty: Microamps::ZERO,
            no_load_threshold: Microamps::ZERO,
            gain_uncertainty: Ppm::ZERO,
            capacity_uncertainty: Ppm::ZERO,
            presented_slew_ppm_per_s: 100,
        }
    }

    /// 3 V + 1 µV per ppm.
    fn straight() -> OcvTable {
        let point = |soc, voltage| OcvPoint {
            soc: Ppm(soc),
            voltage: Microvolts(voltage),
        };
        OcvTable::new(&[point(0, 3_000_000), point(1_000_000, 4_000_000)]).unwrap()
    }

    struct Bench {
        coefficients: SocCoefficients,
        table: OcvTable,
        soc: Soc,
        now_us: u64,
        total: i64,
        current: Option<Microamps>,
        /// Sent with every step.
        cell: Option<Microvolts>,
        events: std::vec::Vec<SocEvent>,
    }

    impl Bench {
        fn new(config: &SocConfig, start: i32, uncertainty: i32) -> Self {
            let coefficients = SocCoefficients::new(config);
            let mut soc = Soc::new(&coefficients);
            soc.set(&coefficients, Ppm(start), Ppm(uncertainty));
            Self {
                coefficients,
                table: straight(),
                soc,
                now_us: 5_000_000,
                total: 0,
                current: None,
                cell: None,
                events: std::vec::Vec::new(),
            }
            .started()
        }

        fn started(mut self) -> Self {
            self.step(0, 0);
            self
        }

        /// `delta` flows within `us`, at constant current.
        fn step(&mut self, us: u64, delta: i64) {
            self.now_us += us;
            self.total += delta;
            let now = Instant::from_ticks(self.now_us);
            let input = SocInput {
                now,
                charge_total: Nanocoulombs(self.total),
                current: self.current,
                cell_voltage: self.cell.map(|voltage| CellVoltage { voltage, at: now }),
            };
            self.events
                .extend(self.soc.update(&self.coefficients, &self.table, &input));
        }

        fn rest(&mut self, seconds: u32) {
            for _ in 0..seconds {
                self.step(1_000_000, 0);
            }
        }

        fn reading(&self) -> SocReading {
            self.soc.reading(&self.coefficients)
        }
    }

    /// <https://github.com/foxBMS/foxbms-2/issues/82>: a state of charge computed from the magnitude of the current
    /// sensor's counter jumps up by twice the counter when charging goes on after a re-anchoring at a negative counter.
    #[test]
    fn foxbms_2_issue_82_sign_of_the_counter_is_kept() {
        let mut bench = Bench::new(&config(), 750_000, 1_000_000);
        bench.current = Some(Microamps::from_amps(-20));
        for _ in 0..450 {
            bench.step(1_000_000, -20 * COULOMB);
        }
        // The counter stands at −9,000 As, the state of charge at 75 % + 25 % = 100 %; the rest finds it is 60 %.
        assert_eq!(bench.total, -9_000 * COULOMB);
        assert_eq!(bench.reading().estimate, Ppm::ONE);
        bench.current = Some(Microamps::ZERO);
        bench.cell = Some(Microvolts(3_600_000));
        bench.rest(601);
        assert_eq!(bench.reading().anchors, 1);
        let anchored = bench.reading().remaining.get();
        assert!(
            (anchored - 21_600 * COULOMB).abs() < 10 * COULOMB,
            "{anchored}"
        );
        // The first charging step moves it by that step and by nothing else: 10 C, not 2 · 9,000 C.
        bench.current = Some(Microamps::from_amps(-10));
        bench.step(1_000_000, -10 * COULOMB);
        assert_eq!(bench.reading().remaining.get() - anchored, 10 * COULOMB);
        // And through a counter that passes zero in discharge.
        bench.step(1_000_000, 9_020 * COULOMB);
        assert_eq!(bench.total, 10 * COULOMB);
        assert_eq!(bench.reading().remaining.get() - anchored, -9_010 * COULOMB);
    }

    #[test]
    fn the_defaults_are_those_that_the_comments_give() {
        let config = SocConfig::default();
        assert_eq!(config.capacity_mah, 240_000);
        assert_eq!(config.no_load_threshold, Microamps(3_000));
        assert_eq!(EXCURSION, Nanocoulombs(1_000_000_000));
        let coefficients = SocCoefficients::new(&config);
        assert_eq!(coefficients.capacity(), Nanocoulombs(864_000 * COULOMB));
        // 0.2 % in 2^-32, and 200 ppm of 864,000 C in a second is 172,800 nC in a microsecond.
        assert_eq!(coefficients.loss_q32, 8_589_935);
        assert_eq!(coefficients.slew_per_us, 172_800 << SLEW_PLACES);
        // 3 %, 20 nC and 3 nC in a microsecond.
        assert_eq!(coefficients.throughput_q32, 128_849_019);
        assert_eq!(coefficients.offset_per_us, 20 << PER_US_PLACES);
        assert_eq!(coefficients.no_load_per_us, 3 << PER_US_PLACES);
    }

    #[test]
    fn a_configuration_beyond_its_limits_is_taken_at_the_limit() {
        let smallest = SocCoefficients::new(&SocConfig {
            capacity_mah: 0,
            coulombic_efficiency: Ppm(i32::MIN),
            gain_uncertainty: Ppm(-7),
            capacity_uncertainty: Ppm(-7),
            presented_slew_ppm_per_s: 0,
            ..config()
        });
        assert_eq!(smallest.capacity, 3_600_000_000);
        assert_eq!(smallest.loss_q32, 1 << 31);
        assert_eq!(smallest.throughput_q32, 0);
        // One ppm of 1 mAh in a second rounds to 3 / 1024 nC in a microsecond.
        assert_eq!(smallest.slew_per_us, 3);
        let largest = SocCoefficients::new(&SocConfig {
            capacity_mah: u32::MAX,
            coulombic_efficiency: Ppm(i32::MAX),
            presented_slew_ppm_per_s: u32::MAX,
            ..config()
        });
        assert_eq!(largest.capacity, 2_000_000 * 3_600_000_000);
        assert_eq!(largest.loss_q32, 0);
        assert_eq!(largest.slew_per_us, 72_000_000 << SLEW_PLACES);
        for coefficients in [smallest, largest] {
            assert!((1 << 30..1i64 << 31).contains(&(coefficients.capacity >> coefficients.shift)));
        }
    }

    #[test]
    fn discharge_is_positive_and_lowers_it() {
        let mut bench = Bench::new(&config(), 500_000, 0);
        bench.step(10_000, 360 * COULOMB);
        assert_eq!(bench.reading().remaining, Nanocoulombs(17_640 * COULOMB));
        assert!((bench.reading().estimate.get() - 490_000).abs() <= 1);
        bench.step(10_000, -720 * COULOMB);
        assert_eq!(bench.reading().remaining, Nanocoulombs(18_360 * COULOMB));
        assert_eq!(bench.soc.throughput().1, Nanocoulombs(360 * COULOMB));
        assert_eq!(bench.soc.throughput().0, Nanocoulombs(720 * COULOMB));
        assert_eq!(bench.reading().clipped, Nanocoulombs::ZERO);
        assert_eq!(bench.soc.equivalent_cycles_milli(&bench.coefficients), 10);
    }

    #[test]
    fn leaving_empty_or_full_is_immediate() {
        let mut bench = Bench::new(&config(), 990_000, 0);
        bench.step(10_000, -400 * COULOMB);
        assert_eq!(bench.reading().estimate, Ppm::ONE);
        assert_eq!(bench.reading().clipped, Nanocoulombs(40 * COULOMB));
        bench.step(10_000, 36 * COULOMB);
        assert_eq!(bench.reading().remaining, Nanocoulombs(35_964 * COULOMB));
        bench.step(10_000, 35_970 * COULOMB);
        assert_eq!(bench.reading().presented, Ppm::ZERO);
        assert_eq!(bench.reading().clipped, Nanocoulombs(46 * COULOMB));
        bench.step(10_000, -36 * COULOMB);
        assert_eq!(bench.reading().remaining, Nanocoulombs(36 * COULOMB));
    }

    /// A sensor's zero drift of 2.5 A that is taken off by the meter: at 0 A four of five polls count once, 12.9 mC more than the
    /// drift, and every fifth does not.
    #[test]
    fn a_zero_drift_that_is_taken_off_is_no_throughput() {
        let mut bench = Bench::new(&config(), 500_000, 0);
        let before = bench.reading().uncertainty;
        let mut net = 0;
        for poll in 0..3_600 * 50 {
            let delta = if net < 0 { 12_860_000 } else { -50_000_000 };
            net += delta;
            bench.step(20_000, delta);
            let kept = bench.soc.retained();
            assert_eq!(kept.discharged.get() - kept.charged.get(), net, "{poll}");
            let throughput = kept.charged.saturating_add(kept.discharged);
            assert!(throughput < EXCURSION, "{throughput:?} after {poll} polls");
        }
        // As an hour in which nothing was counted to and fro.
        let mut still = Bench::new(&config(), 500_000, 0);
        for _ in 0..3_600 * 50 {
            still.step(20_000, 1);
        }
        let grown = |bench: &Bench| bench.reading().uncertainty.get() - before.get();
        assert!(grown(&bench) <= grown(&still) + 1);
    }

    #[test]
    fn charging_bears_the_loss_and_flicker_does_not() {
        let lossy = SocConfig {
            coulombic_efficiency: Ppm(990_000),
            ..config()
        };
        let mut bench = Bench::new(&lossy, 500_000, 0);
        // A count of the meter to and fro, a thousand times: nothing is lost.
        for _ in 0..1_000 {
            bench.step(10_000, -6_700_000);
            bench.step(10_000, 6_700_000);
        }
        assert_eq!(bench.reading().remaining, Nanocoulombs(18_000 * COULOMB));
        assert_eq!(bench.soc.throughput(), Default::default());
        // 101 C charged: 1 C in the band, 100 C with 1 % less.
        for _ in 0..101 {
            bench.step(10_000, -COULOMB);
        }
        assert!((bench.reading().remaining.get() - 18_100 * COULOMB).abs() <= 1);
        // The band opens again by what is discharged, up to 1 C.
        bench.step(10_000, COULOMB / 2);
        bench.step(10_000, -COULOMB);
        assert!((bench.reading().remaining.get() - (18_100_500_000_000 - 5_000_000)).abs() <= 2);
        bench.step(10_000, 2 * COULOMB);
        bench.step(10_000, -2 * COULOMB);
        assert!((bench.reading().remaining.get() - (18_100_500_000_000 - 15_000_000)).abs() <= 2);
        // Discharging bears none.
        bench.step(10_000, 100 * COULOMB);
        assert!((bench.reading().remaining.get() - (18_000_500_000_000 - 15_000_000)).abs() <= 2);
    }

    #[test]
    fn uncertainty_grows_with_time_throughput_and_silence() {
        let uncertain = SocConfig {
            offset_uncertainty: Microamps::from_milliamps(20),
            no_load_threshold: Microamps::from_milliamps(3),
            gain_uncertainty: Ppm(10_000),
            capacity_uncertainty: Ppm(20_000),
            ..config()
        };
        let mut bench = Bench::new(&uncertain, 500_000, 1_000);
        let start = 36 * COULOMB;
        assert_eq!(bench.soc.retained().uncertainty.get(), start);
        bench.rest(100);
        // 100 s · 23 mA
        assert_eq!(
            bench.soc.retained().uncertainty.get(),
            start + 2_300_000_000
        );
        for _ in 0..50 {
            bench.step(1_000_000, 2 * COULOMB);
            bench.step(1_000_000, -2 * COULOMB);
        }
        // 100 s · 20 mA, and 3 % of 200 C; the counter was never silent.
        assert_eq!(
            bench.soc.retained().uncertainty.get(),
            start + 4_300_000_000 + 6 * COULOMB
        );
        // Only whole seconds count; the rest is kept for the next one.
        bench.step(600_000, 0);
        assert_eq!(
            bench.soc.retained().uncertainty.get(),
            start + 10_300_000_000
        );
        bench.step(400_000, 0);
        assert_eq!(
            bench.soc.retained().uncertainty.get(),
            start + 10_323_000_000
        );
        // Both directions within one second add up: 3 % of 4 C.
        bench.step(500_000, 2 * COULOMB);
        bench.step(500_000, -2 * COULOMB);
        let now = start + 10_323_000_000 + 20_000_000 + 120_000_000;
        assert_eq!(bench.soc.retained().uncertainty.get(), now);
        // What was charged and discharged before a reset has been counted already.
        bench.soc = Soc::restore(
            &bench.coefficients,
            &bench.soc.retained(),
            Nanocoulombs(bench.total),
        );
        bench.step(0, 0);
        bench.step(1_000_000, 0);
        assert_eq!(bench.soc.retained().uncertainty.get(), now + 23_000_000);
        // An hour in one step.
        bench.step(3_600_000_000, COULOMB);
        let now = now + 23_000_000 + 72_000_000_000 + 30_000_000;
        assert_eq!(bench.soc.retained().uncertainty.get(), now);
        bench
            .soc
            .declare_loss(&bench.coefficients, Nanocoulombs(-COULOMB));
        assert_eq!(bench.soc.retained().uncertainty.get(), now + COULOMB);
        bench
            .soc
            .declare_loss(&bench.coefficients, Nanocoulombs(i64::MAX));
        assert_eq!(bench.reading().uncertainty, Ppm::ONE);
    }

    #[test]
    fn unknown_until_the_first_rest_which_is_presented_at_once() {
        let coefficients = SocCoefficients::new(&config());
        let mut bench = Bench::new(&config(), 0, 0);
        bench.soc = Soc::new(&coefficients);
        let reading = bench.reading();
        assert!(!reading.known && !reading.resting);
        assert_eq!(
            (reading.estimate, reading.uncertainty),
            (Ppm(500_000), Ppm::ONE)
        );
        bench.current = Some(Microamps::from_milliamps(-500));
        bench.cell = Some(Microvolts(3_800_000));
        bench.step(0, 0);
        bench.rest(599);
        assert!(!bench.reading().known && bench.reading().resting);
        bench.rest(1);
        let reading = bench.reading();
        assert!(reading.known);
        assert_eq!(reading.anchors, 1);
        assert_eq!(
            (reading.presented, reading.estimate),
            (Ppm(800_000), Ppm(800_000))
        );
        assert_eq!(reading.uncertainty, Ppm(10_000));
        assert_eq!(bench.events.len(), 1);
        assert!(matches!(
            bench.events[0],
            SocEvent::Anchored {
                ocv: Ppm(800_000),
                before: Ppm(500_000),
                after: Ppm(800_000)
            }
        ));
    }

    #[test]
    fn a_rest_blends_by_inverse_variance_and_the_bus_follows_slowly() {
        // Prior 50 ± 2 %, table 60 ± 1 %: weight 4/5, so 58 ± 0.894 %.
        let mut bench = Bench::new(&config(), 500_000, 20_000);
        bench.current = Some(Microamps::ZERO);
        bench.cell = Some(Microvolts(3_600_000));
        bench.step(0, 0);
        bench.rest(600);
        let reading = bench.reading();
        assert_eq!(reading.anchors, 1);
        assert!((reading.estimate.get() - 580_000).abs() <= 2, "{reading:?}");
        assert!(
            (reading.uncertainty.get() - 8_944).abs() <= 2,
            "{reading:?}"
        );
        // Presented: still 50 %, then 100 ppm in a second.
        assert!((reading.presented.get() - 500_000).abs() <= 1);
        bench.rest(10);
        assert!((bench.reading().presented.get() - 501_000).abs() <= 1);
        // What flows shows at once: 360 C are 1 %.
        bench.step(1_000_000, 360 * COULOMB);
        assert!((bench.reading().presented.get() - 491_100).abs() <= 1);
        bench.rest(788);
        let reading = bench.reading();
        assert!(
            (reading.presented.get() - 569_900).abs() <= 1,
            "{reading:?}"
        );
        bench.rest(2);
        let reading = bench.reading();
        assert_eq!(reading.presented, reading.estimate);
        assert!(
            (reading.presented.get() - 570_000).abs() <= 2,
            "{reading:?}"
        );
    }

    #[test]
    fn the_bus_follows_downwards_as_slowly() {
        let mut bench = Bench::new(&config(), 700_000, 20_000);
        bench.current = Some(Microamps::ZERO);
        bench.cell = Some(Microvolts(3_600_000));
        bench.step(0, 0);
        bench.rest(600);
        assert!((bench.reading().estimate.get() - 620_000).abs() <= 2);
        bench.rest(10);
        assert!((bench.reading().presented.get() - 699_000).abs() <= 1);
        bench.rest(900);
        assert_eq!(bench.reading().presented, bench.reading().estimate);
        assert_eq!(bench.soc.retained().presented_offset, Nanocoulombs::ZERO);
    }

    #[test]
    fn presented_does_not_stick_to_an_end_either() {
        let mut bench = Bench::new(&config(), 995_000, 20_000);
        bench.current = Some(Microamps::ZERO);
        bench.cell = Some(Microvolts(3_970_000));
        bench.step(0, 0);
        bench.rest(600);
        // 99.5 → 97.5 %, presented 2 % above; charging 1 % brings presented to 100 % and the estimate to 98.5 %.
        bench.step(0, -360 * COULOMB);
        assert_eq!(bench.reading().presented, Ppm::ONE);
        assert!((bench.reading().estimate.get() - 985_000).abs() <= 2);
        bench.step(0, 36 * COULOMB);
        assert!((bench.reading().presented.get() - 999_000).abs() <= 1);
    }

    #[test]
    fn a_flat_curve_counts_little() {
        let point = |soc, voltage| OcvPoint {
            soc: Ppm(soc),
            voltage: Microvolts(voltage),
        };
        let mut bench = Bench::new(&config(), 500_000, 20_000);
        bench.table = OcvTable::new(&[
            point(0, 3_000_000),
            point(200_000, 3_280_000),
            point(800_000, 3_320_000),
            point(1_000_000, 3_600_000),
        ])
        .unwrap();
        // 15 ppm per µV: 10 mV are 15 %, the table says 65 %; weight 4/229 of 15 %.
        bench.current = Some(Microamps::ZERO);
        bench.cell = Some(Microvolts(3_310_000));
        bench.step(0, 0);
        bench.rest(600);
        let reading = bench.reading();
        assert_eq!(reading.anchors, 1);
        assert!((reading.estimate.get() - 502_620).abs() <= 3, "{reading:?}");
        assert!(
            (reading.uncertainty.get() - 20_000).abs() <= 2,
            "{reading:?}"
        );
    }

    #[test]
    fn a_rest_counts_once_until_the_uncertainty_has_doubled() {
        let drifting = SocConfig {
            // 1 % of 36,000 C in 1,000 s
            offset_uncertainty: Microamps::from_milliamps(360),
            ..config()
        };
        let mut bench = Bench::new(&drifting, 500_000, 0);
        bench.current = Some(Microamps::ZERO);
        bench.cell = Some(Microvolts(3_600_000));
        bench.step(0, 0);
        bench.rest(600);
        assert_eq!(bench.reading().anchors, 1);
        // Prior 0.6 %, table 1 %; afterwards 0.6 % again, for it was below 1/√2 % before.
        let first = bench.reading().uncertainty.get();
        assert!((first - 6_000).abs() <= 2, "{first}");
        bench.rest(599);
        assert_eq!(bench.reading().anchors, 1);
        bench.rest(2);
        assert_eq!(bench.reading().anchors, 2);
        // Prior 1.2 %: blended 0.768 %, above the floor.
        let second = bench.reading().uncertainty.get();
        assert!((second - 7_680).abs() <= 20, "{second}");
        // Exactly doubled is enough.
        let doubled = bench.soc.anchored_at.unwrap() * 2 - 360_000_000;
        bench.soc.kept.uncertainty = Nanocoulombs(doubled - 1);
        bench.rest(1);
        assert_eq!(bench.reading().anchors, 2);
        bench.soc.kept.uncertainty = Nanocoulombs(doubled);
        bench.rest(1);
        assert_eq!(bench.reading().anchors, 3);
        // A new rest counts again, after its own time.
        bench.current = Some(Microamps::from_milliamps(501));
        bench.rest(1);
        assert!(!bench.reading().resting);
        bench.current = Some(Microamps::ZERO);
        bench.rest(600);
        assert_eq!(bench.reading().anchors, 3);
        bench.rest(1);
        assert_eq!(bench.reading().anchors, 4);
    }

    #[test]
    fn no_rest_without_a_valid_small_current_seen_all_the_time() {
        let run = |current, gap_us| {
            let mut bench = Bench::new(&config(), 500_000, 20_000);
            bench.cell = Some(Microvolts(3_600_000));
            bench.current = Some(Microamps::ZERO);
            bench.step(0, 0);
            bench.rest(300);
            bench.current = current;
            bench.step(gap_us, 0);
            bench.current = Some(Microamps::ZERO);
            bench.rest(300);
            bench.reading().anchors
        };
        assert_eq!(run(Some(Microamps::ZERO), 1_000_000), 1);
        assert_eq!(run(Some(Microamps::from_milliamps(-500)), 1_000_000), 1);
        assert_eq!(run(Some(Microamps::from_milliamps(-501)), 1_000_000), 0);
        assert_eq!(run(Some(Microamps::from_milliamps(501)), 1_000), 0);
        assert_eq!(run(None, 1_000_000), 0);
        assert_eq!(run(Some(Microamps::ZERO), 1_000_001), 0);
    }

    #[test]
    fn no_anchor_on_an_old_or_moving_or_missing_voltage() {
        let run = |voltage: &dyn Fn(u32) -> Option<(i32, i64)>| {
            let mut bench = Bench::new(&config(), 500_000, 20_000);
            for second in 0..=700u32 {
                bench.now_us += 1_000_000;
                let cell_voltage = voltage(second).map(|(voltage, age_us)| CellVoltage {
                    voltage: Microvolts(voltage),
                    at: Instant::from_ticks((bench.now_us as i64 - age_us) as u64),
                });
                let input = SocInput {
                    now: Instant::from_ticks(bench.now_us),
                    charge_total: Nanocoulombs::ZERO,
                    current: Some(Microamps::ZERO),
                    cell_voltage,
                };
                if bench
                    .soc
                    .update(&bench.coefficients, &bench.table, &input)
                    .is_some()
                {
                    return Some(second);
                }
            }
            None
        };
        assert_eq!(run(&|_| Some((3_600_000, 0))), Some(600));
        assert_eq!(run(&|_| Some((3_600_000, 1_000_000))), Some(600));
        assert_eq!(run(&|_| Some((3_600_000, 1_000_001))), None);
        // Received after the meter's last reading.
        assert_eq!(run(&|_| Some((3_600_000, -20_000))), Some(600));
        assert_eq!(run(&|_| None), None);
        // Missing at 590 s: the window of 60 s begins anew at 591 s.
        assert_eq!(run(&|s| (s != 590).then_some((3_600_000, 0))), Some(651));
        // 1 mV is still, more is not; by 20 µV a second the window never fills, by 16 µV it begins anew every 63 s.
        assert_eq!(
            run(&|s| Some((3_600_000 + 1_000 * i32::from(s >= 590), 0))),
            Some(600)
        );
        assert_eq!(
            run(&|s| Some((3_600_000 - 1_001 * i32::from(s >= 590), 0))),
            Some(650)
        );
        assert_eq!(run(&|s| Some((3_600_000 + 20 * s as i32, 0))), None);
        assert_eq!(
            run(&|s| Some((3_600_000 + 16 * s as i32, 0))),
            Some(9 * 63 + 60)
        );
    }

    #[test]
    fn a_voltage_of_no_cell_changes_nothing_and_is_told() {
        let mut bench = Bench::new(&config(), 500_000, 20_000);
        bench.current = Some(Microamps::ZERO);
        bench.cell = Some(Microvolts::ZERO);
        let before = bench.soc.retained();
        bench.step(0, 0);
        bench.rest(700);
        assert_eq!(
            bench.events,
            [SocEvent::ImplausibleVoltage(Microvolts::ZERO)]
        );
        assert_eq!(bench.soc.retained(), before);
        assert_eq!(bench.reading().anchors, 0);
    }

    /// As of a battery monitor that has been set right, or that answers at last, with the vehicle parked and nothing known.
    #[test]
    fn a_cells_voltage_after_one_of_none_anchors_in_the_same_rest() {
        let mut bench = Bench::new(&config(), 500_000, 1_000_000);
        bench.current = Some(Microamps::ZERO);
        bench.cell = Some(Microvolts::ZERO);
        bench.step(0, 0);
        bench.rest(700);
        assert_eq!(bench.reading().anchors, 0);
        bench.cell = Some(Microvolts(3_600_000));
        bench.rest(config().stability_window_s);
        assert_eq!(bench.reading().anchors, 0);
        bench.rest(1);
        assert_eq!(bench.reading().anchors, 1);
        bench.rest(700);
        assert_eq!(bench.reading().anchors, 1);
    }

    #[test]
    fn a_reset_goes_on_where_it_was() {
        let mut bench = Bench::new(&config(), 500_000, 20_000);
        bench.step(10_000, 100 * COULOMB);
        let (kept, total) = (bench.soc.retained(), Nanocoulombs(bench.total));
        bench.soc = Soc::restore(&bench.coefficients, &kept, total);
        assert_eq!(bench.soc.retained(), kept);
        // What the counter gained meanwhile is counted.
        bench.step(0, 7 * COULOMB);
        assert_eq!(
            bench.reading().remaining,
            Nanocoulombs((18_000 - 107) * COULOMB)
        );
        assert!(bench.reading().known);
        // A fresh one has no counter before, so its first value is its zero.
        let mut fresh = Soc::new(&bench.coefficients);
        let input = SocInput {
            now: Instant::from_ticks(1),
            charge_total: Nanocoulombs(i64::MIN),
            current: None,
            cell_voltage: None,
        };
        fresh.update(&bench.coefficients, &bench.table, &input);
        assert_eq!(fresh.retained().remaining, Nanocoulombs(18_000 * COULOMB));
        // The largest difference that is charge, and the next one.
        bench.step(0, 1 << 60);
        assert_eq!(
            bench.soc.throughput().1,
            Nanocoulombs(107 * COULOMB + (1 << 60))
        );
        bench.step(0, -(1 << 60) - 1);
        assert_eq!(bench.soc.throughput().0, Nanocoulombs::ZERO);
        assert_eq!(bench.reading().counter_jumps, 1);
        // A jump that no counter makes is not charge.
        let jump = SocInput {
            charge_total: Nanocoulombs(i64::MAX),
            ..input
        };
        fresh.update(&bench.coefficients, &bench.table, &jump);
        assert_eq!(fresh.retained().remaining, Nanocoulombs(18_000 * COULOMB));
        assert_eq!(fresh.reading(&bench.coefficients).counter_jumps, 1);
    }

    #[test]
    fn what_does_not_fit_is_restored_at_the_ends() {
        let coefficients = SocCoefficients::new(&config());
        let full = 36_000 * COULOMB;
        let kept = SocRetained {
            capacity_mah: config().capacity_mah,
            remaining: Nanocoulombs(2 * full),
            presented_offset: Nanocoulombs(full),
            uncertainty: Nanocoulombs(-1),
            known: true,
            charged: Nanocoulombs(-5),
            discharged: Nanocoulombs(-6),
            loss_carry: 7,
        };
        let restored = Soc::restore(&coefficients, &kept, Nanocoulombs::ZERO).retained();
        assert_eq!(
            restored,
            SocRetained {
                capacity_mah: config().capacity_mah,
                remaining: Nanocoulombs(full),
                presented_offset: Nanocoulombs::ZERO,
                uncertainty: Nanocoulombs::ZERO,
                known: true,
                charged: Nanocoulombs::ZERO,
                discharged: Nanocoulombs::ZERO,
                loss_carry: 7,
            }
        );
        let low = SocRetained {
            remaining: Nanocoulombs(-1),
            presented_offset: Nanocoulombs(-full),
            uncertainty: Nanocoulombs(2 * full),
            ..kept
        };
        let restored = Soc::restore(&coefficients, &low, Nanocoulombs::ZERO).retained();
        assert_eq!(
            (restored.remaining.get(), restored.presented_offset.get()),
            (0, 0)
        );
        assert_eq!(restored.uncertainty.get(), full);
    }

    #[test]
    fn another_capacity_keeps_the_state_of_charge() {
        let mut bench = Bench::new(&config(), 500_000, 20_000);
        bench.current = Some(Microamps::ZERO);
        bench.cell = Some(Microvolts(3_600_000));
        bench.step(0, 0);
        bench.rest(600);
        let before = bench.reading();
        let aged = SocCoefficients::new(&SocConfig {
            capacity_mah: 8_000,
            ..config()
        });
        bench.soc.change_capacity(&aged);
        let after = bench.soc.reading(&aged);
        assert!((after.estimate.get() - before.estimate.get()).abs() <= 1);
        assert!((after.presented.get() - before.presented.get()).abs() <= 1);
        assert!((after.uncertainty.get() - before.uncertainty.get()).abs() <= 1);
        assert_eq!(after.remaining.get(), before.remaining.get() / 5 * 4);
        // Of the same share, the uncertainty has not doubled: no second anchor within this rest.
        bench.coefficients = SocCoefficients::new(&SocConfig {
            capacity_mah: 1_000_000,
            ..config()
        });
        bench.soc.change_capacity(&bench.coefficients);
        bench.rest(600);
        assert_eq!(bench.reading().anchors, before.anchors);
    }

    proptest! {
        /// Settings that come back with another capacity than the state was saved with: those of another version, or not saved. A full
        /// battery is still full, and back again.
        #[test]
        fn another_capacity_at_a_restart_keeps_the_state_of_charge(
            before_mah in 1_000_u32..2_000_000, after_mah in 1_000_u32..2_000_000, soc_ppm in 0..=1_000_000_i32,
            total: i32,
        ) {
            let of = |capacity_mah| SocCoefficients::new(&SocConfig { capacity_mah, ..config() });
            let (before, after) = (of(before_mah), of(after_mah));
            let total = Nanocoulombs(i64::from(total) << 20);
            let mut soc = Soc::new(&before);
            soc.set(&before, Ppm(soc_ppm), Ppm(5_000));
            let restored = Soc::restore(&after, &soc.retained(), total);
            let reading = restored.reading(&after);
            prop_assert!((reading.estimate.get() - soc_ppm).abs() <= 1, "{:?}", reading);
            prop_assert!((reading.uncertainty.get() - 5_000).abs() <= 1, "{:?}", reading);
            let back = Soc::restore(&before, &restored.retained(), total).reading(&before);
            prop_assert!((back.estimate.get() - soc_ppm).abs() <= 2, "{:?}", back);
        }
    }

    #[test]
    fn setting_is_presented_at_once_and_held_inside() {
        let mut bench = Bench::new(&config(), 500_000, 20_000);
        bench.soc.kept.presented_offset = Nanocoulombs(COULOMB);
        bench.soc.set(&bench.coefficients, Ppm(2_000_000), Ppm(-1));
        let reading = bench.reading();
        assert_eq!(
            (reading.presented, reading.estimate, reading.uncertainty),
            (Ppm::ONE, Ppm::ONE, Ppm::ZERO)
        );
        bench.soc.set(&bench.coefficients, Ppm(-2), Ppm(2_000_000));
        let reading = bench.reading();
        assert_eq!(
            (reading.presented, reading.estimate, reading.uncertainty),
            (Ppm::ZERO, Ppm::ZERO, Ppm::ONE)
        );
    }

    #[test]
    fn blends_by_hand() {
        let blend = |prior, table| {
            let blend = Blend::of(prior, table);
            (blend.weight_ppm, blend.width)
        };
        assert_eq!(blend(20_000, 10_000), (800_000, 8_944));
        assert_eq!(blend(30_000, 40_000), (360_000, 28_284));
        // Floor 0.7071 · 10,000 and, when the prior was below it already, the prior.
        assert_eq!(blend(8_000, 10_000), (390_244, 7_071));
        assert_eq!(blend(5_000, 10_000), (200_000, 5_000));
        assert_eq!(blend(0, 10_000), (0, 0));
        assert_eq!(blend(0, 0), (0, 0));
        assert_eq!(blend(1_000_000, 1), (1_000_000, 1));
        assert_eq!(blend(u64::MAX, u64::MAX), (500_000, 707_107));
    }

    proptest! {
        #[test]
        fn neither_value_nor_sign_of_the_counter_matters(
            start in -1_000_000_000 * COULOMB..1_000_000_000 * COULOMB,
            deltas in proptest::collection::vec(-2_000 * COULOMB..2_000 * COULOMB, 1..50),
        ) {
            let lossy = SocConfig { coulombic_efficiency: Ppm(990_000), ..config() };
            let mut here = Bench::new(&lossy, 500_000, 0);
            let mut there = Bench::new(&lossy, 500_000, 0);
            there.total = start;
            there.soc = Soc::restore(&there.coefficients, &here.soc.retained(), Nanocoulombs(start));
            there.soc.last_update = here.soc.last_update;
            for delta in deltas {
                here.step(20_000, delta);
                there.step(20_000, delta);
                prop_assert_eq!(here.reading(), there.reading());
            }
        }

        #[test]
        fn charge_is_conserved_and_clipping_is_accounted_for(
            deltas in proptest::collection::vec(-9_000 * COULOMB..9_000 * COULOMB, 1..60),
        ) {
            let mut bench = Bench::new(&config(), 500_000, 0);
            let full = 36_000 * COULOMB;
            let (mut model, mut clipped) = (full / 2, 0);
            for delta in deltas {
                bench.step(20_000, delta);
                let next = model - delta;
                model = next.clamp(0, full);
                clipped += (next - model).abs();
                let reading = bench.reading();
                prop_assert_eq!(reading.remaining.get(), model);
                prop_assert_eq!(reading.clipped.get(), clipped);
                let exact = model as f64 / full as f64 * 1e6;
                prop_assert!((exact - f64::from(reading.estimate.get())).abs() <= 0.51);
            }
        }

        #[test]
        fn the_loss_is_exact_to_the_rounding_of_the_factor(
            efficiency in 500_000..=1_000_000i32,
            charges in proptest::collection::vec(0..3 * COULOMB, 1..200),
        ) {
            let large = SocConfig {
                coulombic_efficiency: Ppm(efficiency), capacity_mah: 1_000_000, ..config()
            };
            let mut bench = Bench::new(&large, 0, 0);
            for charge in &charges {
                bench.step(20_000, -charge);
            }
            let sum: i64 = charges.iter().sum();
            let lossy = (sum - EXCURSION.get()).max(0);
            let loss = lossy as f64 * f64::from(1_000_000 - efficiency) / 1e6;
            let expected = sum as f64 - loss;
            let allowed = 1.001 + sum as f64 * 2f64.powi(-33);
            let got = bench.reading().remaining.get() as f64;
            prop_assert!((got - expected).abs() <= allowed, "{got} {expected}");
        }

        #[test]
        fn the_split_of_a_charge_does_not_matter(
            charge in 0..5_000 * COULOMB, cuts in proptest::collection::vec(0..5_000 * COULOMB, 0..20),
        ) {
            let lossy = SocConfig { coulombic_efficiency: Ppm(987_654), ..config() };
            let (mut whole, mut split) = (Bench::new(&lossy, 100_000, 0), Bench::new(&lossy, 100_000, 0));
            whole.step(20_000, -charge);
            let mut cuts: std::vec::Vec<_> = cuts.into_iter().map(|cut| cut.min(charge)).collect();
            cuts.push(charge);
            cuts.sort_unstable();
            let mut before = 0;
            for cut in cuts {
                split.step(1_000, before - cut);
                before = cut;
            }
            prop_assert_eq!(whole.soc.retained(), split.soc.retained());
        }

        #[test]
        fn the_share_is_within_half_a_ppm_and_never_falls(
            capacity_mah in 1..2_000_000u32, a: i64, b: i64, share_a in -0.1..1.1f64,
        ) {
            let coefficients = SocCoefficients::new(&SocConfig { capacity_mah, ..config() });
            let near = (coefficients.capacity as f64 * share_a) as i64;
            for charge in [a, b, near, near + 1, coefficients.capacity - 1] {
                let share = coefficients.share(Nanocoulombs(charge)).get();
                let exact = charge.clamp(0, coefficients.capacity) as f64 / coefficients.capacity as f64 * 1e6;
                prop_assert!((f64::from(share) - exact).abs() <= 0.51, "{share} {exact}");
            }
            let (low, high) = (near.min(a), near.max(a));
            prop_assert!(coefficients.share(Nanocoulombs(low)) <= coefficients.share(Nanocoulombs(high)));
        }

        #[test]
        fn the_bus_never_jumps(
            start in 0..=1_000_000i32, uncertainty in 1_000..200_000i32, cell in 2_900_000..4_100_000i32,
            steps in proptest::collection::vec((1..1_000_000u64, -5 * COULOMB..5 * COULOMB), 1..200),
        ) {
            // Whatever the rest finds, presented moves by what flows and by 100 ppm/s.
            let quick = SocConfig { rest_time_s: 5, stability_window_s: 2, ..config() };
            let mut bench = Bench::new(&quick, start, uncertainty);
            bench.current = Some(Microamps::ZERO);
            bench.cell = Some(Microvolts(cell));
            let mut before = bench.reading().presented.get();
            for (us, delta) in steps {
                bench.step(us, delta);
                let now = bench.reading().presented.get();
                let flows = delta.abs() as f64 / (36_000.0 * COULOMB as f64) * 1e6;
                let slews = us as f64 * 1e-4;
                prop_assert!(f64::from((now - before).abs()) <= flows + slews + 2.0, "{before} {now} {flows} {slews}");
                before = now;
            }
        }

        #[test]
        fn an_anchor_lies_between_and_never_adds_uncertainty(
            start in 0..=1_000_000i32, uncertainty in 0..=1_000_000i32, cell in 2_500_000..=4_500_000i32,
        ) {
            let quick = SocConfig { rest_time_s: 3, stability_window_s: 2, ..config() };
            let mut bench = Bench::new(&quick, start, uncertainty);
            bench.current = Some(Microamps::ZERO);
            bench.cell = Some(Microvolts(cell));
            bench.step(0, 0);
            let before = bench.reading();
            bench.rest(3);
            let after = bench.reading();
            prop_assert_eq!(after.anchors, 1);
            let ocv = (cell - 3_000_000).clamp(0, 1_000_000);
            let (low, high) = (ocv.min(before.estimate.get()), ocv.max(before.estimate.get()));
            prop_assert!((low - 1..=high + 1).contains(&after.estimate.get()));
            prop_assert!(after.uncertainty.get() <= before.uncertainty.get() + 1);
            let (p, r) = (f64::from(uncertainty), 10_000.0);
            let weight = p * p / (p * p + r * r);
            let expected = f64::from(start) + weight * f64::from(ocv - start);
            prop_assert!((f64::from(after.estimate.get()) - expected).abs() <= 5.0);
        }

        #[test]
        fn no_input_panics_and_the_ends_hold(
            capacity_mah: u32, efficiency: i32, others in proptest::array::uniform8(any::<i32>()),
            times in proptest::array::uniform5(any::<u32>()), kept_values in proptest::array::uniform5(any::<i64>()),
            steps in proptest::collection::vec((any::<u64>(), any::<i64>(), any::<Option<i32>>(), any::<Option<(i32, u64)>>()), 1..20),
        ) {
            let wild = SocConfig {
                capacity_mah,
                coulombic_efficiency: Ppm(efficiency),
                rest_current: Microamps(others[0]),
                rest_time_s: times[0],
                stability: Microvolts(others[1]),
                stability_window_s: times[1],
                cell_voltage_max_age_ms: times[2],
                ocv_uncertainty: Microvolts(others[2]),
                offset_uncertainty: Microamps(others[3]),
                no_load_threshold: Microamps(others[4]),
                gain_uncertainty: Ppm(others[5]),
                capacity_uncertainty: Ppm(others[6]),
                presented_slew_ppm_per_s: times[3],
            };
            let coefficients = SocCoefficients::new(&wild);
            let kept = SocRetained {
                capacity_mah: times[4],
                remaining: Nanocoulombs(kept_values[0]),
                presented_offset: Nanocoulombs(kept_values[1]),
                uncertainty: Nanocoulombs(kept_values[2]),
                known: others[7] > 0,
                charged: Nanocoulombs(kept_values[3]),
                discharged: Nanocoulombs(kept_values[4]),
                loss_carry: u32::MAX,
            };
            let mut soc = Soc::restore(&coefficients, &kept, Nanocoulombs(kept_values[3]));
            let table = OcvTable::default();
            for (now, total, current, cell) in steps {
                soc.update(&coefficients, &table, &SocInput {
                    now: Instant::from_ticks(now),
                    charge_total: Nanocoulombs(total),
                    current: current.map(Microamps),
                    cell_voltage: cell.map(|(voltage, at)| CellVoltage {
                        voltage: Microvolts(voltage), at: Instant::from_ticks(at),
                    }),
                });
                soc.declare_loss(&coefficients, Nanocoulombs(total));
                let reading = soc.reading(&coefficients);
                prop_assert!((0..=coefficients.capacity).contains(&reading.remaining.get()));
                prop_assert!((0..=1_000_000).contains(&reading.presented.get()));
                prop_assert!((0..=1_000_000).contains(&reading.uncertainty.get()));
                let _ = soc.equivalent_cycles_milli(&coefficients);
            }
        }
    }
}
