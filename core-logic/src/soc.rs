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
mod tests;
