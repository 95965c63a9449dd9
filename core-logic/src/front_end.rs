//! The sensor in front of the converter: volt ↔ ampere for every front end that the board can carry.
//!
//! Which one is fitted is configuration ([`FrontEnd`]), not a compile-time fork. Each is a straight line at a given
//! range and supply ([`TransferLine`]); the measuring path folds that line into one multiplication
//! (`converter::ConverterCoefficients`), and the functions here are the exact reference for it.
//!
//! "Signal" means the voltage that the fitted channel converts: the sensor's output (through the analog switch) for
//! D0, D2 and D4, the network's output for D3.

use serde::{Deserialize, Serialize};

use crate::design_parameters as design;
use crate::range::Range;
use crate::units::{Microamps, Microvolts, add_i64, clamp_i32, div_round, mul_div, sub_i64};

/// Turns of a [`ClosedLoop`] sensor that [`FrontEnd::validate`] accepts.
pub const TURNS_LIMITS: (i32, i32) = (1, 20_000);
/// Full scales that [`FrontEnd::validate`] accepts: 1 A … 2,000 A.
pub const FULL_SCALE_LIMITS: (Microamps, Microamps) =
    (Microamps::from_amps(1), Microamps::from_amps(2_000));

/// Smallest sensitivity of the signal that [`FrontEnd::validate`] accepts: 1.053 mV/A, that is 950 µA per µV. Below it
/// [`FrontEnd::meter_full_scale`] would be above the 2,147 A that a current can be, and stay there; a converter step is above 2 A,
/// and the folded coefficients of the converter would not fit.
pub const MAX_MICROAMPS_PER_MICROVOLT: i64 = 950;

/// One value for each of the two sensors. A board with one sensor uses both alike, or the first.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct PerRange<T> {
    /// For the small sensor.
    pub small: T,
    /// For the large sensor.
    pub large: T,
}

impl<T> PerRange<T> {
    /// The value of `range`, in place.
    #[must_use]
    pub const fn of(&self, range: Range) -> &T {
        match range {
            Range::Small => &self.small,
            Range::Large => &self.large,
        }
    }

    /// The value of `range`, to be changed in place.
    #[must_use]
    pub const fn of_mut(&mut self, range: Range) -> &mut T {
        match range {
            Range::Small => &mut self.small,
            Range::Large => &mut self.large,
        }
    }
}

impl<T: Copy> PerRange<T> {
    /// The same value for both.
    #[must_use]
    pub const fn both(value: T) -> Self {
        Self {
            small: value,
            large: value,
        }
    }

    /// The value of `range`.
    #[must_use]
    pub const fn get(&self, range: Range) -> T {
        *self.of(range)
    }

    /// Replaces the value of `range`.
    pub const fn set(&mut self, range: Range, value: T) {
        *self.of_mut(range) = value;
    }
}

/// The analogue-to-digital converter that reads a front end's signal.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Channel {
    /// The external ΔΣ converter, 0 … 5 V.
    Ads1100,
    /// The microcontroller's own converter, 0 … 3.3 V.
    Adc1,
}

/// The span of a signal inside which it follows the current.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct OutputLimits {
    /// Lowest legal signal.
    pub low: Microvolts,
    /// Highest legal signal.
    pub high: Microvolts,
}

/// `I = (V − zero) · numerator / denominator` with I in µA and V, zero in nV.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TransferLine {
    /// Signal at 0 A in nV.
    pub zero_nanovolts: i64,
    /// µA …
    pub numerator: i64,
    /// … per nV. Positive.
    pub denominator: i64,
}

impl TransferLine {
    /// The current, rounded to the nearest µA, stopping at the ends of the type.
    #[must_use]
    pub const fn current(&self, volts: Microvolts) -> Microamps {
        let above_zero = sub_i64(volts.get() as i64 * 1_000, self.zero_nanovolts);
        Microamps(clamp_i32(mul_div(
            above_zero,
            self.numerator,
            self.denominator,
        )))
    }

    /// The signal, within 0.501 µV of the exact one, stopping at the ends of the type.
    #[must_use]
    pub const fn voltage(&self, current: Microamps) -> Microvolts {
        let above_zero = mul_div(current.get() as i64, self.denominator, self.numerator);
        Microvolts(clamp_i32(div_round(
            add_i64(self.zero_nanovolts, above_zero),
            1_000,
        )))
    }

    const fn new(zero_nanovolts: i64, numerator: i64, denominator: i64) -> Self {
        Self {
            zero_nanovolts,
            numerator,
            // Reached by a configuration that `validate` refuses: a huge current is then marked as beyond limits,
            // where a division by zero would read 0 A.
            denominator: if denominator > 0 { denominator } else { 1 },
        }
    }
}

/// D4's two linear relations of a sensor to its supply Vc:
/// `Vout = (k1·Vc + m1)·Ip/N + k2·Vc + m2`, as the least-squares calibration fills them.
///
/// Rounding k1, m1 to 1 nΩ and k2, m2 to 1 nV costs less than 1 mA over ±600 A and 4.5 … 5.5 V for every sensor with
/// at least 3 mV/A, also with N = 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct SupplyRelations {
    /// k1: transfer impedance per volt of supply, in nΩ/V (referred to the secondary, Ip/N).
    pub k1_nanoohm_per_volt: i64,
    /// m1: transfer impedance at Vc = 0, in nΩ.
    pub m1_nanoohm: i64,
    /// k2: zero output per volt of supply, in nV/V.
    pub k2_nanovolt_per_volt: i64,
    /// m2: zero output at Vc = 0, in nV.
    pub m2_nanovolt: i64,
}

impl SupplyRelations {
    /// `k1·Vc + m1` in nΩ, rounded to nearest.
    #[must_use]
    pub const fn impedance_nanoohm(&self, supply: Microvolts) -> i64 {
        mul_div(self.k1_nanoohm_per_volt, supply.get() as i64, 1_000_000)
            .saturating_add(self.m1_nanoohm)
    }

    /// `k2·Vc + m2`, the output at 0 A, in nV, rounded to nearest.
    #[must_use]
    pub const fn zero_nanovolt(&self, supply: Microvolts) -> i64 {
        let by_supply = mul_div(self.k2_nanovolt_per_volt, supply.get() as i64, 1_000_000);
        add_i64(by_supply, self.m2_nanovolt)
    }
}

impl Default for SupplyRelations {
    /// The rated sensor, fully ratiometric.
    fn default() -> Self {
        Self {
            k1_nanoohm_per_volt: design::CLOSED_LOOP_K1_NANOOHM_PER_VOLT,
            m1_nanoohm: 0,
            k2_nanovolt_per_volt: design::CLOSED_LOOP_K2_NANOVOLT_PER_VOLT,
            m2_nanovolt: 0,
        }
    }
}

/// D4's two factors, taken before the high voltage is switched on: the signal is corrected to `k·(V + a)`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct KeyFactors {
    /// `k = VOUT0 / VC1` in 10⁻⁹ (one is 1,000,000,000): 0.5·10⁻⁹ of a 5 V signal is 2.5 nV.
    pub k_ppb: i32,
    /// `a = VC1 − VC2`.
    pub a: Microvolts,
}

impl KeyFactors {
    /// `k` = 1.
    pub const K_ONE_PPB: i32 = 1_000_000_000;
    /// No correction.
    pub const NONE: Self = Self {
        k_ppb: Self::K_ONE_PPB,
        a: Microvolts::ZERO,
    };

    /// `k·(V + a)`, rounded to the nearest µV.
    #[must_use]
    pub const fn apply(&self, volts: Microvolts) -> Microvolts {
        let sum = volts.get() as i64 + self.a.get() as i64;
        Microvolts(clamp_i32(mul_div(
            sum,
            self.k_ppb as i64,
            Self::K_ONE_PPB as i64,
        )))
    }
}

impl Default for KeyFactors {
    fn default() -> Self {
        Self::NONE
    }
}

/// D0: two linear sensors, selected by the analog switch; `I = (V − zero) · full scale / swing`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct DualRange {
    /// Current at the end of each sensor's range.
    pub full_scale: PerRange<Microamps>,
    /// Output swing from 0 A to the end of the range, both sensors.
    pub swing: Microvolts,
    /// Output at 0 A, both sensors.
    pub zero: Microvolts,
}

impl Default for DualRange {
    fn default() -> Self {
        Self {
            full_scale: PerRange {
                small: design::SMALL_FULL_SCALE,
                large: design::LARGE_FULL_SCALE,
            },
            swing: design::DUAL_RANGE_SWING,
            zero: design::SENSOR_ZERO,
        }
    }
}

/// D2: one LEM HAH1BV; `I = (V − 2.5 V) / (4 mV/A)`, that is `250 · (V − 2.5)`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Hah1bv {
    /// Sensitivity at the rated supply.
    pub microvolts_per_amp: i32,
    /// End of the range, both signs.
    pub full_scale: Microamps,
}

impl Default for Hah1bv {
    fn default() -> Self {
        Self {
            microvolts_per_amp: design::HAH1BV_MICROVOLTS_PER_AMP,
            full_scale: design::HAH1BV_FULL_SCALE,
        }
    }
}

/// D3: one sensor with a bipolar output, read through the open-sensor network: `Vadc = 0.225 · Vhall + 1.65 V`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Network {
    /// Sensitivity at the Hall output.
    pub sensor_nanovolts_per_amp: i32,
    /// Hall output at 0 A.
    pub sensor_zero: Microvolts,
    /// End of the range, both signs.
    pub full_scale: Microamps,
}

impl Default for Network {
    fn default() -> Self {
        Self {
            sensor_nanovolts_per_amp: design::NETWORK_SENSOR_NANOVOLTS_PER_AMP,
            sensor_zero: Microvolts::ZERO,
            full_scale: design::NETWORK_SENSOR_FULL_SCALE,
        }
    }
}

/// D4: one closed-loop sensor with turns ratio N, calibrated over its supply:
/// `Ip = (V − (k2·Vc + m2)) · N / (k1·Vc + m1)`, V being the signal after the key-state factors.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct ClosedLoop {
    /// Turns ratio N.
    pub turns: i32,
    /// k1, m1, k2, m2.
    pub relations: SupplyRelations,
    /// End of the range, both signs.
    pub full_scale: Microamps,
}

impl Default for ClosedLoop {
    fn default() -> Self {
        Self {
            turns: design::CLOSED_LOOP_TURNS,
            relations: SupplyRelations::default(),
            full_scale: design::CLOSED_LOOP_FULL_SCALE,
        }
    }
}

/// Why [`FrontEnd::validate`] refuses a front end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum FrontEndError {
    /// A full scale is outside [`FULL_SCALE_LIMITS`], or the large one is not above the small one.
    FullScale,
    /// The sensitivity is not positive or below [`MAX_MICROAMPS_PER_MICROVOLT`], or the signal would leave the
    /// channel's input before full scale.
    Sensitivity,
    /// N is outside [`TURNS_LIMITS`].
    Turns,
    /// `k1·Vc + m1` is not positive, or the zero output is outside the supply, somewhere in 4.5 … 5.5 V.
    Relations,
}

/// The front end that is fitted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum FrontEnd {
    /// D0: small and large Hall sensor with analog switch.
    DualRange(DualRange),
    /// D2: one HAH1BV.
    Hah1bv(Hah1bv),
    /// D3: the current itself through the open-sensor network.
    Network(Network),
    /// D4: closed loop with turns ratio and supply relations.
    ClosedLoop(ClosedLoop),
}

impl Default for FrontEnd {
    fn default() -> Self {
        Self::DualRange(DualRange::default())
    }
}

impl FrontEnd {
    /// The line between signal and current.
    ///
    /// For D0, D2 and D3 the signal is the one at the rated supply and `supply` has no influence (the converter
    /// refers a ratiometric signal to 5 V before). For D4 the signal is the actual one and `supply` is Vc.
    #[must_use]
    pub const fn line(&self, range: Range, supply: Microvolts) -> TransferLine {
        match self {
            Self::DualRange(sensor) => TransferLine::new(
                sensor.zero.get() as i64 * 1_000,
                sensor.full_scale.get(range).get() as i64,
                sensor.swing.get() as i64 * 1_000,
            ),
            Self::Hah1bv(sensor) => TransferLine::new(
                design::SENSOR_ZERO.get() as i64 * 1_000,
                1_000_000,
                sensor.microvolts_per_amp as i64 * 1_000,
            ),
            Self::Network(sensor) => {
                let (gain, per) = design::NETWORK_GAIN;
                TransferLine::new(
                    network_output_nanovolts(sensor.sensor_zero.get() as i64 * 1_000),
                    1_000_000 * per,
                    sensor.sensor_nanovolts_per_amp as i64 * gain,
                )
            }
            // nV / nΩ is the secondary current in A.
            Self::ClosedLoop(sensor) => TransferLine::new(
                sensor.relations.zero_nanovolt(supply),
                sensor.turns as i64 * 1_000_000,
                sensor.relations.impedance_nanoohm(supply),
            ),
        }
    }

    /// The current behind a signal, rounded to the nearest µA, stopping at the ends of the type. See
    /// [`FrontEnd::line`] for what `volts` and `supply` mean.
    #[must_use]
    pub const fn current(&self, volts: Microvolts, range: Range, supply: Microvolts) -> Microamps {
        self.line(range, supply).current(volts)
    }

    /// The signal at a current, within 0.501 µV, stopping at the ends of the type. The sensor's saturation is not
    /// in it: see [`FrontEnd::output_limits`].
    #[must_use]
    pub const fn voltage(
        &self,
        current: Microamps,
        range: Range,
        supply: Microvolts,
    ) -> Microvolts {
        self.line(range, supply).voltage(current)
    }

    /// The signal at 0 A.
    #[must_use]
    pub const fn zero_output(&self, range: Range, supply: Microvolts) -> Microvolts {
        self.voltage(Microamps::ZERO, range, supply)
    }

    /// The signals at both ends of the range at the rated supply; at them, or beyond, the sensor may be saturated.
    #[must_use]
    pub const fn output_limits(&self, range: Range) -> OutputLimits {
        self.output_limits_at(range, design::SENSOR_NOMINAL_SUPPLY)
    }

    /// As [`FrontEnd::output_limits`] at another supply, which moves them for D4 alone.
    #[must_use]
    pub const fn output_limits_at(&self, range: Range, supply: Microvolts) -> OutputLimits {
        let full_scale = self.full_scale(range);
        OutputLimits {
            low: self.voltage(Microamps(full_scale.get().saturating_neg()), range, supply),
            high: self.voltage(full_scale, range, supply),
        }
    }

    /// The current at the end of the sensor's range.
    #[must_use]
    pub const fn full_scale(&self, range: Range) -> Microamps {
        match self {
            Self::DualRange(sensor) => sensor.full_scale.get(range),
            Self::Hah1bv(sensor) => sensor.full_scale,
            Self::Network(sensor) => sensor.full_scale,
            Self::ClosedLoop(sensor) => sensor.full_scale,
        }
    }

    /// The current at which V1 of the energy meter is 0.5 V: the board scales the signal's distance from its zero by
    /// [`design::CHANNEL_1_SCALE`], so that is 2.25 V of signal. 60 A and 600 A for D0, 562.5 A for the HAH1BV.
    ///
    /// D3 is the same with the network's output as the signal: its bipolar Hall output cannot pass the 5 V switch.
    #[must_use]
    pub const fn meter_full_scale(&self, range: Range) -> Microamps {
        const SIGNAL_NANOVOLTS: i64 = mul_div(
            design::METER_FULL_SCALE_INPUT.get() as i64 * 1_000,
            design::CHANNEL_1_SCALE.1,
            design::CHANNEL_1_SCALE.0,
        );
        let line = self.line(range, design::SENSOR_NOMINAL_SUPPLY);
        Microamps(clamp_i32(mul_div(
            SIGNAL_NANOVOLTS,
            line.numerator,
            line.denominator,
        )))
    }

    /// The converter that reads the signal.
    #[must_use]
    pub const fn channel(&self) -> Channel {
        match self {
            Self::Network(_) => Channel::Adc1,
            Self::DualRange(_) | Self::Hah1bv(_) | Self::ClosedLoop(_) => Channel::Ads1100,
        }
    }

    /// Whether the range flag selects between two sensors. With one sensor the range has no influence on anything
    /// here, and the caller keeps it at [`Range::Small`].
    #[must_use]
    pub const fn has_two_ranges(&self) -> bool {
        matches!(self, Self::DualRange(_))
    }

    /// Refuses what cannot be a sensor of this board.
    ///
    /// # Errors
    /// The first of the reasons in [`FrontEndError`].
    pub fn validate(&self) -> Result<(), FrontEndError> {
        let full_scale_fits =
            |current: Microamps| (FULL_SCALE_LIMITS.0..=FULL_SCALE_LIMITS.1).contains(&current);
        if !full_scale_fits(self.full_scale(Range::Small))
            || !full_scale_fits(self.full_scale(Range::Large))
        {
            return Err(FrontEndError::FullScale);
        }
        match self {
            Self::DualRange(sensor) if sensor.full_scale.large <= sensor.full_scale.small => {
                return Err(FrontEndError::FullScale);
            }
            Self::ClosedLoop(sensor) => {
                if !(TURNS_LIMITS.0..=TURNS_LIMITS.1).contains(&sensor.turns) {
                    return Err(FrontEndError::Turns);
                }
                // Both relations are straight lines: what holds at the ends holds between them.
                for supply in [design::SENSOR_SUPPLY_LOW, design::SENSOR_SUPPLY_HIGH] {
                    let zero = sensor.relations.zero_nanovolt(supply);
                    if sensor.relations.impedance_nanoohm(supply) <= 0
                        || zero <= 0
                        || zero >= i64::from(supply.get()) * 1_000
                    {
                        return Err(FrontEndError::Relations);
                    }
                }
            }
            Self::DualRange(_) | Self::Hah1bv(_) | Self::Network(_) => {}
        }
        let input = match self.channel() {
            Channel::Ads1100 => design::CONVERTER_NOMINAL_SUPPLY,
            Channel::Adc1 => design::NETWORK_CLAMP,
        };
        let limits = self.output_limits(Range::Small);
        // A sensitivity that is not positive has become an immense one in the line.
        let is_too_coarse = [design::SENSOR_SUPPLY_LOW, design::SENSOR_SUPPLY_HIGH]
            .into_iter()
            .map(|supply| self.line(Range::Large, supply))
            .any(|line| {
                mul_div(line.numerator, 1_000, line.denominator) > MAX_MICROAMPS_PER_MICROVOLT
            });
        if is_too_coarse || limits.low <= Microvolts::ZERO || limits.high >= input {
            return Err(FrontEndError::Sensitivity);
        }
        Ok(())
    }
}

/// D3's network with the sensor connected: 0.225 · Vhall + 1.65 V, in nV.
pub(crate) const fn network_output_nanovolts(hall_nanovolts: i64) -> i64 {
    // (Vref · R4 / (R3 + R4)) · (1 + R1/R2)
    const REFERENCE: i64 = mul_div(
        design::NETWORK_REFERENCE.get() as i64 * 1_000 * design::R4_OHM,
        design::R1_OHM + design::R2_OHM,
        (design::R3_OHM + design::R4_OHM) * design::R2_OHM,
    );
    let (gain, per) = design::NETWORK_GAIN;
    add_i64(mul_div(hall_nanovolts, gain, per), REFERENCE)
}

#[cfg(test)]
#[allow(
    clippy::unwrap_used,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss
)]
pub(crate) mod tests;
