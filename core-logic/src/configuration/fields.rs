//! Every setting with its limits and its place in the register map: one table, used when a record is read, when a
//! client reads or writes, and for the documentation.

use core::{fmt, mem};

use super::{Configuration, Violation};
use crate::front_end::{self, ClosedLoop, DualRange, FrontEnd, Hah1bv, Network, PerRange};
use crate::modbus::readings::Text;
use crate::modbus::register::{Kind, Layout, Row};
use crate::ocv::MAX_POINTS;
use crate::soc::CAPACITY_LIMITS_MAH;
use crate::units::{Microamps, Microvolts, MilliCelsius, Millivolts, Nanocoulombs, Ppm, clamp_i32};
use crate::{
    converter, key_calibration, retained, sliding_average, supply_calibration, zero_drift,
};

/// The state of the board in which a setting may be written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum When {
    /// In any.
    Always,
    /// High voltage neither on nor permitted and no calibration under way: it changes what the current reads.
    Standstill,
}

impl When {
    /// As the documentation writes it.
    #[must_use]
    pub const fn text(self) -> &'static str {
        match self {
            Self::Always => "always",
            Self::Standstill => "standstill",
        }
    }
}

/// A row of [`FIELDS`].
#[derive(Clone, Copy, Debug)]
pub struct Field {
    /// Where it lies.
    pub layout: Layout,
    /// When a client may write it.
    pub when: When,
    /// Smallest and largest value; in millions for a value of 64 bits, so that a row keeps half the flash.
    min: i32,
    max: i32,
}

impl Row for Field {
    fn layout(&self) -> &Layout {
        &self.layout
    }
}

impl Field {
    fn id(&self, element: usize) -> FieldId {
        FieldId {
            address: self.layout.address,
            element,
        }
    }

    /// The value of an element; `None` when it belongs to another front end than the one set.
    #[must_use]
    pub fn get(&self, configuration: &Configuration, element: usize) -> Option<i64> {
        let mut copy = *configuration;
        self.get_in(&mut copy, element)
    }

    /// As [`Field::get`], from a configuration that the caller may change; it is not changed.
    pub(crate) fn get_in(&self, configuration: &mut Configuration, element: usize) -> Option<i64> {
        place(self.layout.address, configuration, element).map(|setting| setting.read())
    }

    /// Smallest and largest value.
    #[must_use]
    pub const fn limits(&self) -> (i64, i64) {
        let unit = limit_unit(self.layout.kind);
        (self.min as i64 * unit, self.max as i64 * unit)
    }

    /// Whether `value` lies in the limits of this field.
    ///
    /// # Errors
    /// [`Violation::OutOfLimits`] when it does not.
    pub fn check(&self, element: usize, value: i64) -> Result<(), Violation> {
        let (min, max) = self.limits();
        if (min..=max).contains(&value) {
            Ok(())
        } else {
            Err(Violation::OutOfLimits {
                field: self.id(element),
                value,
                min,
                max,
            })
        }
    }

    /// Sets an element, if `value` is in the limits and the element in use. Another front end comes without the zero drift, the key
    /// factors and the gains, which are the old one's, and without the meter's offset, found in amperes of its full scale.
    ///
    /// # Errors
    /// Why it was not set.
    pub fn put(
        &self,
        configuration: &mut Configuration,
        element: usize,
        value: i64,
    ) -> Result<(), Violation> {
        self.check(element, value)?;
        let front_end = mem::discriminant(&configuration.front_end);
        if place(self.layout.address, configuration, element)
            .is_some_and(|setting| setting.write(value))
        {
            if mem::discriminant(&configuration.front_end) != front_end {
                configuration.forget_zero();
                configuration.current_gain = PerRange::both(Ppm::ZERO);
                configuration.meter.gain = PerRange::both(Ppm::ZERO);
                configuration.meter.offset = PerRange::both(Microamps::ZERO);
            }
            configuration.derive();
            Ok(())
        } else {
            Err(Violation::NotInUse(self.id(element)))
        }
    }
}

/// One setting, named by its place in [`FIELDS`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct FieldId {
    /// Address of the row in the holding registers.
    pub address: u16,
    /// Which of the row's values.
    pub element: usize,
}

impl FieldId {
    /// Its name.
    #[must_use]
    pub fn name(self) -> &'static str {
        FIELDS
            .iter()
            .zip(FIELD_TEXTS)
            .find(|(field, _)| field.layout.address == self.address)
            .map_or("unknown", |(_, text)| text.name)
    }
}

impl fmt::Display for FieldId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}[{}]", self.name(), self.element)
    }
}

/// A setting as the number in the register map.
trait Setting {
    fn read(&self) -> i64;
    /// Whether such a value exists; if not, the setting stays as it is.
    fn write(&mut self, number: i64) -> bool;
}

impl<T: Value> Setting for T {
    fn read(&self) -> i64 {
        self.number()
    }
    fn write(&mut self, number: i64) -> bool {
        assign(self, number)
    }
}

impl Setting for FrontEnd {
    fn read(&self) -> i64 {
        match self {
            Self::DualRange(_) => 0,
            Self::Hah1bv(_) => 1,
            Self::Network(_) => 2,
            Self::ClosedLoop(_) => 3,
        }
    }
    /// Another front end comes with its own defaults; the same one keeps its values.
    fn write(&mut self, number: i64) -> bool {
        if number == self.read() {
            return true;
        }
        *self = match number {
            0 => Self::DualRange(DualRange::default()),
            1 => Self::Hah1bv(Hah1bv::default()),
            2 => Self::Network(Network::default()),
            3 => Self::ClosedLoop(ClosedLoop::default()),
            _ => return false,
        };
        true
    }
}

/// What a setting is made of.
trait Value: Sized {
    fn number(&self) -> i64;
    /// `None` when no such value exists.
    fn from_number(number: i64) -> Option<Self>;
}

macro_rules! settings {
    ($($integer:ty),*; $($quantity:ident),*) => {
        $(impl Value for $integer {
            fn number(&self) -> i64 {
                i64::from(*self)
            }
            fn from_number(number: i64) -> Option<Self> {
                number.try_into().ok()
            }
        })*
        $(impl Value for $quantity {
            fn number(&self) -> i64 {
                self.get().into()
            }
            fn from_number(number: i64) -> Option<Self> {
                number.try_into().ok().map(Self)
            }
        })*
    };
}
settings!(u8, u16, u32, i32, i64; Microamps, Microvolts, Millivolts, Nanocoulombs, MilliCelsius, Ppm);

/// 0 stands for none.
impl<T: Value> Value for Option<T> {
    fn number(&self) -> i64 {
        self.as_ref().map_or(0, T::number)
    }
    fn from_number(number: i64) -> Option<Self> {
        match number {
            0 => Some(None),
            _ => T::from_number(number).map(Some),
        }
    }
}

impl Value for bool {
    fn number(&self) -> i64 {
        i64::from(*self)
    }
    fn from_number(number: i64) -> Option<Self> {
        match number {
            0 => Some(false),
            1 => Some(true),
            _ => None,
        }
    }
}

/// Enumerations are numbered in the order of their variants.
macro_rules! choices {
    ($($name:path: $($variant:ident),*;)*) => {
        $(impl Value for $name {
            fn number(&self) -> i64 {
                *self as i64
            }
            fn from_number(number: i64) -> Option<Self> {
                [$(Self::$variant),*].into_iter().find(|choice| choice.number() == number)
            }
        })*
    };
}
choices! {
    converter::DataRate: Sps128, Sps32, Sps16, Sps8;
    converter::Gain: X1, X2, X4, X8;
    converter::SupplyMode: Ratiometric, Measured, Fixed;
    key_calibration::OnFailure: PermitWithPrevious, Hold;
}

fn assign<T: Value>(place: &mut T, number: i64) -> bool {
    match T::from_number(number) {
        Some(value) => {
            *place = value;
            true
        }
        None => false,
    }
}

fn of_range_mut<T>(values: &mut PerRange<T>, element: usize) -> Option<&mut T> {
    match element {
        0 => Some(&mut values.small),
        1 => Some(&mut values.large),
        _ => None,
    }
}

/// Where a setting is kept, after how it is reached.
macro_rules! place {
    ($c:ident $i:ident [at $($path:ident).+]) => { &mut $c.$($path).+ };
    ($c:ident $i:ident [ranges $($path:ident).+]) => { of_range_mut(&mut $c.$($path).+, $i)? };
    ($c:ident $i:ident [each $($path:ident).+ ; $member:ident]) => {
        &mut $c.$($path).+.get_mut($i)?.$member
    };
    ($c:ident $i:ident [list $($path:ident).+]) => { $c.$($path).+.get_mut($i)? };
    ($c:ident $i:ident [sensor $variant:ident $($path:ident).+]) => { match &mut $c.front_end {
        FrontEnd::$variant(sensor) => &mut sensor.$($path).+,
        _ => return None,
    } };
    ($c:ident $i:ident [sensor_ranges $variant:ident $($path:ident).+]) => { match &mut $c.front_end {
        FrontEnd::$variant(sensor) => of_range_mut(&mut sensor.$($path).+, $i)?,
        _ => return None,
    } };
}

/// In what a row keeps its limits.
const fn limit_unit(kind: Kind) -> i64 {
    match kind {
        Kind::I64 => 1_000_000,
        _ => 1,
    }
}

/// A limit as a row keeps it; one that it cannot keep exactly does not compile.
const fn limit(kind: Kind, value: i64) -> i32 {
    let kept = clamp_i32(value / limit_unit(kind));
    assert!(kept as i64 * limit_unit(kind) == value);
    kept
}

macro_rules! fields {
    ($($address:literal $kind:ident $count:literal $when:ident ($min:expr, $max:expr)
        $name:literal $unit:literal $meaning:literal $access:tt;)*) => {
        /// Every setting, by address.
        pub static FIELDS: &[Field] = &[
            $(Field {
                layout: Layout { address: $address, kind: Kind::$kind, count: $count },
                when: When::$when,
                min: limit(Kind::$kind, $min as i64),
                max: limit(Kind::$kind, $max as i64),
            },)*
        ];
        /// Where an element of the row at `address` is kept; `None` when it belongs to another front end than the one
        /// set. One function for reading and writing, and for all rows: a function for each takes twice the flash.
        #[inline(never)]
        fn place(address: u16, configuration: &mut Configuration, element: usize) -> Option<&mut dyn Setting> {
            Some(match address {
                $($address => place!(configuration element $access),)*
                _ => return None,
            })
        }
        /// What [`FIELDS`] mean, row by row.
        pub static FIELD_TEXTS: &[Text] = &[
            $(Text { name: $name, unit: $unit, meaning: $meaning },)*
        ];
    };
}

/// Largest full scale of any sensor here.
const FULL_SCALE: (i32, i32) = (
    front_end::FULL_SCALE_LIMITS.0.get(),
    front_end::FULL_SCALE_LIMITS.1.get(),
);

fields! {
    0x0100 U16 1 Standstill (0, 3) "front end" "" "0 dual range (D0), 1 HAH1BV (D2), 2 network (D3), 3 closed loop (D4); another one than before comes with its defaults, and without the old one's zero drift, key factors, current gain, and gain and offset of the meter" [at front_end];
    0x0102 I32 2 Standstill (FULL_SCALE.0, FULL_SCALE.1) "dual range: full scale" "µA" "small and large sensor" [sensor_ranges DualRange full_scale];
    0x0106 I32 1 Standstill (1_000_000, 2_500_000) "dual range: swing" "µV" "output from 0 A to the end of the range" [sensor DualRange swing];
    0x0108 I32 1 Standstill (1_000_000, 4_000_000) "dual range: zero" "µV" "output at 0 A" [sensor DualRange zero];
    0x0110 I32 1 Standstill (500, 50_000) "HAH1BV: sensitivity" "µV/A" "at the rated supply" [sensor Hah1bv microvolts_per_amp];
    0x0112 I32 1 Standstill (FULL_SCALE.0, FULL_SCALE.1) "HAH1BV: full scale" "µA" "" [sensor Hah1bv full_scale];
    0x0120 I32 1 Standstill (1_000_000, 1_000_000_000) "network: sensitivity" "nV/A" "at the Hall output" [sensor Network sensor_nanovolts_per_amp];
    0x0122 I32 1 Standstill (-1_000_000, 1_000_000) "network: zero" "µV" "Hall output at 0 A" [sensor Network sensor_zero];
    0x0124 I32 1 Standstill (FULL_SCALE.0, FULL_SCALE.1) "network: full scale" "µA" "" [sensor Network full_scale];
    0x0130 U32 1 Standstill (front_end::TURNS_LIMITS.0, front_end::TURNS_LIMITS.1) "closed loop: turns" "" "turns ratio N" [sensor ClosedLoop turns];
    0x0132 I32 1 Standstill (FULL_SCALE.0, FULL_SCALE.1) "closed loop: full scale" "µA" "" [sensor ClosedLoop full_scale];
    0x0134 I64 1 Standstill (-1_000_000_000_000i64, 1_000_000_000_000i64) "closed loop: k1" "nΩ/V" "transfer impedance per volt of supply" [sensor ClosedLoop relations.k1_nanoohm_per_volt];
    0x0138 I64 1 Standstill (-1_000_000_000_000i64, 1_000_000_000_000i64) "closed loop: m1" "nΩ" "transfer impedance at a supply of 0 V" [sensor ClosedLoop relations.m1_nanoohm];
    0x013C I64 1 Standstill (-2_000_000_000i64, 2_000_000_000i64) "closed loop: k2" "nV/V" "zero output per volt of supply" [sensor ClosedLoop relations.k2_nanovolt_per_volt];
    0x0140 I64 1 Standstill (-10_000_000_000i64, 10_000_000_000i64) "closed loop: m2" "nV" "zero output at a supply of 0 V" [sensor ClosedLoop relations.m2_nanovolt];

    0x0200 U16 1 Standstill (0, 3) "converter: data rate" "" "0 128/s 12 bits, 1 32/s 14 bits, 2 16/s 15 bits, 3 8/s 16 bits" [at converter.data_rate];
    0x0201 U16 1 Standstill (0, 3) "converter: gain" "" "0 ×1, 1 ×2, 2 ×4, 3 ×8; only ×1 takes the sensors' 0 to 5 V" [at converter.gain];
    0x0202 U16 1 Standstill (0, 2) "converter: supply mode" "" "0 ratiometric, 1 measured, 2 fixed" [at converter.supply_mode];
    0x0204 I32 1 Standstill (2_700_000, 5_500_000) "converter: reference" "µV" "its supply, in the modes measured and fixed" [at converter.reference];
    0x0206 U32 1 Standstill (0, 1_000_000) "converter: settling" "µs" "of the low-pass before it, after a range edge" [at converter.settling_us];
    0x0208 U32 1 Standstill (100, 1_000_000) "ADC1: period" "µs" "of the samples for a front end there" [at converter.adc1_period_us];
    0x020A U16 1 Always (2, 50) "stale after" "periods" "without a new sample" [at converter.stale_after_periods];
    0x020C I32 1 Standstill (0, 100_000) "saturation margin" "µV" "distance from the ends of the sensor's range" [at converter.saturation_margin];
    0x020E U32 1 Always (0, 10_000_000) "rate of change" "A/s" "fastest that is believed; 0 switches the check off" [at converter.max_amps_per_second];
    0x0210 U16 1 Always (0, 10) "step confirmations" "" "readings that must agree before a step is believed" [at converter.step_confirmations];
    0x0211 U16 1 Always (8, 65_535) "stuck count" "" "identical codes before they can count as stuck" [at converter.stuck_count];
    0x0212 I32 2 Always (1, 600_000_000) "stuck movement" "µA" "of the meter's mean meanwhile; small, large sensor" [ranges converter.stuck_movement];
    0x0216 I32 2 Standstill (-100_000, 100_000) "current gain" "ppm" "correction of the converter's current; small, large sensor" [ranges current_gain];

    0x0300 I32 2 Standstill (-50_000_000, 50_000_000) "zero drift" "µA" "what the sensor reads at 0 A, subtracted; small, large sensor" [ranges zero_drift.value];
    0x0304 I32 2 Standstill (1, 50_000_000) "zero drift: limit" "µA" "largest magnitude accepted; small, large sensor" [ranges zero_drift.limit];
    0x0308 U16 1 Standstill (zero_drift::SAMPLE_LIMITS.0, zero_drift::SAMPLE_LIMITS.1) "zero drift: samples" "" "valid readings that `zero now` takes" [at zero_drift.samples];
    0x030A I32 2 Standstill (1, 50_000_000) "zero drift: spread" "µA" "largest distance between them; with the network (D3), whose noise is larger, between the means of the run's quarters, and four times as much between readings; small, large sensor" [ranges zero_drift.max_spread];
    0x030E I32 2 Standstill (1, 50_000_000) "zero drift: meter mean" "µA" "largest mean of the meter at which no current may flow; small, large sensor" [ranges zero_drift.max_meter_mean];
    0x0312 U32 1 Standstill (100, 600_000) "zero drift: timeout" "ms" "longest time that `zero now` takes" [at zero_drift.timeout_ms];
    0x0320 U16 1 Always (sliding_average::LENGTH_LIMITS.0, sliding_average::LENGTH_LIMITS.1) "average: length" "readings" "of the sliding average" [at average.length];
    0x0322 U32 1 Always (sliding_average::GAP_LIMITS_MS.0, sliding_average::GAP_LIMITS_MS.1) "average: gap" "ms" "without a valid reading after which it starts anew; at least two conversions at the data rate" [at average.max_gap_ms];

    0x0400 U16 1 Standstill (0, 1) "key calibration: enabled" "" "0 off, 1 on" [at key_calibration.enabled];
    0x0401 U16 1 Standstill (0, 1) "key calibration: on failure" "" "0 permit with the previous factors, 1 hold the permit" [at key_calibration.on_failure];
    0x0404 U16 1 Standstill (1, 1_024) "key calibration: samples" "" "that are averaged" [at key_calibration.samples];
    0x0406 U32 1 Standstill (0, 10_000) "key calibration: settling" "ms" "after a change of key or high voltage" [at key_calibration.settle_ms];
    0x0408 U32 1 Standstill (100, 60_000) "key calibration: longest delay" "ms" "of the high-voltage permit" [at key_calibration.max_delay_ms];
    0x040A I32 1 Standstill (1, 100_000) "key calibration: spread" "µV" "largest, of one average; with the network (D3), whose noise is larger, between the means of its quarters, and four times as much between samples" [at key_calibration.max_spread];
    0x040C I32 1 Standstill (1, 50_000_000) "key calibration: current" "µA" "largest magnitude by the meter that counts as none" [at key_calibration.max_current];
    0x040E I32 1 Standstill (1, 100_000) "key calibration: k" "ppm" "largest magnitude of k − 1" [at key_calibration.max_k_deviation_ppm];
    0x0410 I32 1 Standstill (1, 500_000) "key calibration: a" "µV" "largest magnitude of a" [at key_calibration.max_a];
    0x0412 U32 1 Standstill (0, 5_000) "key calibration: key-off debounce" "ms" "for which the key line must be low" [at key_calibration.key_off_debounce_ms];
    0x0414 U32 1 Standstill (0, 60_000) "key calibration: feedback grace" "ms" "that the contactors have to open" [at key_calibration.feedback_grace_ms];
    0x0420 I32 1 Standstill (900_000_000, 1_100_000_000) "key factor k" "10⁻⁹" "in use until one is taken; small sensor" [at key_factors.k_ppb];
    0x0422 I32 1 Standstill (-500_000, 500_000) "key factor a" "µV" "in use until one is taken; small sensor" [at key_factors.a];
    0x0440 U16 1 Standstill (3, supply_calibration::MAX_POINTS) "supply calibration: points" "" "that each run needs" [at supply_calibration.min_points];
    0x0442 I32 1 Standstill (100_000, 1_000_000) "supply calibration: span" "µV" "of the supply, that each run needs" [at supply_calibration.min_span];
    0x0444 I32 1 Standstill (1, 100_000) "supply calibration: residual" "µV" "largest root mean square" [at supply_calibration.max_residual];
    0x0446 I32 1 Standstill (1_000_000, 2_000_000_000) "supply calibration: smallest test current" "µA" "magnitude" [at supply_calibration.min_test_current];
    0x0448 I32 1 Standstill (1_000, 1_000_000) "supply calibration: zero tolerance" "µV" "of the zero output at the rated supply" [at supply_calibration.zero_tolerance];
    0x044A I32 1 Standstill (-2_000_000_000, 2_000_000_000) "supply calibration: test current" "µA" "Ipt of `supply point at the test current`" [at supply_test_current];

    0x0500 I32 2 Standstill (-100_000, 100_000) "meter: gain" "ppm" "what the reading lacks of the true charge; small, large sensor" [ranges meter.gain];
    0x0504 I32 2 Standstill (-10_000_000, 10_000_000) "meter: offset" "µA" "counted at 0 A; small, large sensor" [ranges meter.offset];
    0x0508 I32 1 Standstill (-50_000, 50_000) "meter: reference error" "ppm" "of the reference voltage, measured less nominal" [at meter.reference_error];
    0x050A I32 1 Standstill (-50_000, 50_000) "meter: divider error" "ppm" "of the ratio that makes 0.1 V for channel 2" [at meter.divider_error];
    0x050C I32 1 Always (0, 1_000) "meter: no-load threshold" "ppm" "share of the full scale" [at meter.no_load];
    0x050E I32 1 Standstill (FULL_SCALE.0, FULL_SCALE.1) "switching current" "µA" "at which the comparators switch; of two sensors below the small one's full scale" [at meter.switching_current];
    0x0510 I32 1 Standstill (0, 100_000_000) "switching tolerance" "µA" "of the switching current" [at meter.switching_tolerance];
    0x0512 U32 1 Standstill (0, 10_000_000) "meter: slew limit" "A/s" "fastest change of the current that estimates allow for" [at meter.slew_limit_amps_per_second];
    0x0514 U32 1 Standstill (0, 80_000) "meter: short interval" "µs" "intervals with chatter up to this wait for the next reading, which the meter is not stale by: 100 ms" [at meter.short_interval_us];
    0x0516 U32 1 Standstill (0, 10_000) "meter: front-end delay" "µs" "of the filter before V1" [at meter.front_end_delay_us];
    0x0518 U32 1 Always (20, 60_000) "meter: mean window" "ms" "of the mean current" [at meter.mean_window_ms];
    0x051A I32 1 Always (0, 1_000_000) "meter: bridge gain" "ppm" "by which the current that bridges a gap may be off" [at meter.bridge_gain];
    0x051C I32 1 Always (0, 50_000_000) "meter: bridge offset" "µA" "beside that" [at meter.bridge_offset];

    0x0600 U32 1 Always (10, 60_000) "chatter: window" "ms" "" [at chatter.window_ms];
    0x0602 U32 1 Always (1, 1_000_000) "chatter: edges" "" "within one window from which on it is chatter" [at chatter.edges];
    0x0614 I32 1 Always (0, 100_000_000) "flag: margin above" "µA" "beyond the switching current, on the small sensor" [at flag.margin_above];
    0x0616 I32 1 Always (0, 100_000_000) "flag: margin below" "µA" "below the switching current, on the large sensor" [at flag.margin_below];
    0x0618 I32 1 Always (500_000, 100_000_000) "flag: match tolerance" "µA" "between readings of one sensor" [at flag.match_tolerance];
    0x061A U32 1 Always (0, 169) "flag: debounce" "ms" "with one conversion on top below 200 ms" [at flag.debounce_ms];
    0x0620 U16 1 Always (1, 100) "edge storm: events" "" "within the window" [at edge_storm.events];
    0x0622 U32 1 Always (500, 1_000_000) "edge storm: window" "µs" "at least 50 µs for each of the events" [at edge_storm.window_us];
    0x0624 U32 1 Always (500, 1_000_000) "edge storm: hold-off" "µs" "for which the line stays masked; at least 50 µs for each of the events" [at edge_storm.hold_off_us];
    0x0628 U16 1 Always (1, 100) "meter line storm: events" "" "within the window" [at meter_line_storm.events];
    0x062A U32 1 Always (500, 1_000_000) "meter line storm: window" "µs" "at least 50 µs for each of the events" [at meter_line_storm.window_us];
    0x062C U32 1 Always (500, 1_000_000) "meter line storm: hold-off" "µs" "for which the line stays masked; at least 50 µs for each of the events" [at meter_line_storm.hold_off_us];
    0x0640 U32 1 Always (100, 60_000) "channels: fast window" "ms" "over which meter and converter are compared" [at compare.fast_window_ms];
    0x0642 U32 1 Always (100, 600_000) "channels: slow window" "ms" "the same with the finer bound; longer than the fast one" [at compare.slow_window_ms];
    0x0644 I32 1 Always (0, 500_000) "channels: gain tolerance" "ppm" "share by which they may differ" [at compare.gain_tolerance];
    0x0646 I32 2 Always (0, 100_000_000) "channels: zero tolerance" "µA" "by which they may differ at any reading; small, large sensor, which is that of a single one too" [ranges compare.zero_tolerance];
    0x064A I32 1 Always (100_000, 1_000_000) "channels: covered share" "ppm" "of a window that usable conversions must cover" [at compare.covered_share];
    0x064C U32 1 Always (10, 10_000) "channels: short gap" "ms" "longest gap between usable conversions that is bridged" [at compare.short_gap_ms];

    0x0700 U32 1 Always (CAPACITY_LIMITS_MAH.0, CAPACITY_LIMITS_MAH.1) "capacity" "mAh" "charge of the full battery" [at soc.capacity_mah];
    0x0702 I32 1 Always (500_000, 1_000_000) "coulombic efficiency" "ppm" "share of what is charged that can be discharged again" [at soc.coulombic_efficiency];
    0x0704 I32 1 Always (0, 20_000_000) "rest current" "µA" "currents up to this, both signs, are a rest" [at soc.rest_current];
    0x0706 U32 1 Always (60, 86_400) "rest time" "s" "rest after which the cell voltage is its open-circuit voltage" [at soc.rest_time_s];
    0x0708 I32 1 Always (1, 100_000) "rest stability" "µV" "largest change of the cell voltage over the stability window" [at soc.stability];
    0x070A U32 1 Always (1, 86_400) "stability window" "s" "time over which the cell voltage must not move" [at soc.stability_window_s];
    0x070C U32 1 Always (10, 60_000) "cell voltage age" "ms" "oldest cell voltage that is used" [at soc.cell_voltage_max_age_ms];
    0x070E I32 1 Always (100, 100_000) "open-circuit uncertainty" "µV" "half-width: table, hysteresis, relaxation, measurement" [at soc.ocv_uncertainty];
    0x0710 I32 1 Always (0, 10_000_000) "offset uncertainty" "µA" "half-width of the offset that is left" [at soc.offset_uncertainty];
    0x0712 I32 1 Always (0, 10_000_000) "no-load threshold" "µA" "currents up to this may flow without a count; at least the meter's own of the small or only sensor is reckoned with" [at soc.no_load_threshold];
    0x0714 I32 1 Always (0, 100_000) "gain uncertainty" "ppm" "half-width of the gain of the current" [at soc.gain_uncertainty];
    0x0716 I32 1 Always (0, 500_000) "capacity uncertainty" "ppm" "half-width of the capacity" [at soc.capacity_uncertainty];
    0x0718 U32 1 Always (1, 10_000) "presented slew" "ppm/s" "rate at which the presented state of charge follows an anchoring" [at soc.presented_slew_ppm_per_s];

    0x0781 U16 1 Always (2, MAX_POINTS) "open-circuit points" "" "points in use, from the first; written with the table in one request" [at ocv.count];
    0x0782 I32 21 Always (0, 1_000_000) "open-circuit state of charge" "ppm" "of each point, rising from 0 to 1,000,000" [each ocv.points ; soc];
    0x07AC I32 21 Always (0, 5_000_000) "open-circuit voltage" "µV" "of each point, rising; one cell" [each ocv.points ; voltage];

    0x0800 I32 1 Standstill (0, 3_000_000) "open sensor: threshold" "µV" "network output below which the sensor is open; 0 for the middle between open and the lowest legal level" [at open_sensor.open_below];
    0x0802 U16 1 Always (1, 255) "open sensor: set count" "" "faulty readings in succession" [at open_sensor.set_count];
    0x0803 U16 1 Always (1, 255) "open sensor: clear count" "" "good readings in succession" [at open_sensor.clear_count];
    0x0804 U32 1 Always (0, 10_000) "open sensor: set time" "ms" "from the first to the last of the faulty ones" [at open_sensor.set_time_ms];
    0x0806 U32 1 Always (0, 10_000) "open sensor: clear time" "ms" "from the first to the last of the good ones" [at open_sensor.clear_time_ms];
    0x0808 I32 2 Always (-55_000, 150_000) "temperature limits" "m°C" "lowest and highest of sensors and board, beyond which it is reported" [list temperature_limits];
    0x0840 I64 1 Always (retained::MIN_CHARGE_INTERVAL.get(), 100_000_000_000_000i64) "save: charge interval" "nC" "change of the charge counter after which it is written to flash; less would wear the flash out in a vehicle's life" [at save_policy.charge_interval];
    0x0844 U32 1 Always (retained::MIN_TIME_INTERVAL_S, 86_400) "save: time interval" "s" "after which the state is written to flash, whatever has changed" [at save_policy.time_interval_s];

    0x0900 U16 1 Always (1, 247) "Modbus address" "" "answers from the next request on" [at rtu.address];
    0x0901 U16 1 Always (0, 50_000) "turnaround" "µs" "silence before an answer, at least the 1,750 µs that end a request" [at rtu.turnaround_us];
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::indexing_slicing)]
mod tests {
    use super::*;

    #[test]
    fn a_number_that_is_no_value_of_the_type_is_not_taken() {
        assert_eq!(u8::from_number(256), None);
        assert_eq!(u8::from_number(-1), None);
        assert_eq!(u16::from_number(65_535), Some(65_535));
        assert_eq!(i32::from_number(1 << 31), None);
        assert_eq!(
            Microamps::from_number(-(1 << 31)),
            Some(Microamps(i32::MIN))
        );
        assert_eq!(Microamps::from_number(1 << 31), None);
        assert_eq!(
            Nanocoulombs::from_number(i64::MAX),
            Some(Nanocoulombs(i64::MAX))
        );
        assert_eq!(
            [0, 1, 2, -1].map(bool::from_number),
            [Some(false), Some(true), None, None]
        );
        assert_eq!([true.number(), false.number()], [1, 0]);
        assert_eq!(Option::<u8>::from_number(0), Some(None));
        assert_eq!(Option::<u8>::from_number(7), Some(Some(7)));
        assert_eq!(Option::<u8>::from_number(256), None);
        assert_eq!([None, Some(7u8)].map(|value| value.number()), [0, 7]);
        assert_eq!(converter::Gain::from_number(4), None);
        assert_eq!(converter::Gain::from_number(3), Some(converter::Gain::X8));
        assert_eq!(
            converter::DataRate::from_number(3),
            Some(converter::DataRate::Sps8)
        );
        assert_eq!(
            converter::SupplyMode::from_number(2),
            Some(converter::SupplyMode::Fixed)
        );
        assert_eq!(
            key_calibration::OnFailure::from_number(1),
            Some(key_calibration::OnFailure::Hold)
        );
    }

    #[test]
    fn what_cannot_be_assigned_leaves_the_place_as_it_was() {
        let mut place = 5u8;
        assert!(!assign(&mut place, 256));
        assert_eq!(place, 5);
        assert!(assign(&mut place, 255));
        assert_eq!(place, 255);
        let mut configuration = Configuration::default();
        assert!(!configuration.front_end.write(4));
        assert_eq!(configuration, Configuration::default());
        let mut both = PerRange { small: 1, large: 2 };
        assert_eq!(
            [0, 1, 2].map(|i| of_range_mut(&mut both, i).copied()),
            [Some(1), Some(2), None]
        );
        *of_range_mut(&mut both, 1).unwrap() = 9;
        *of_range_mut(&mut both, 0).unwrap() = 8;
        assert_eq!(
            (both.small, both.large, of_range_mut(&mut both, 2)),
            (8, 9, None)
        );
    }

    #[test]
    fn the_setter_refuses_what_the_limits_let_through() {
        // Limits wider than the type: the value is refused all the same.
        let field = Field {
            max: 300,
            ..*FIELDS.iter().find(|f| f.layout.address == 0x0900).unwrap()
        };
        let mut configuration = Configuration::default();
        let id = FieldId {
            address: 0x0900,
            element: 0,
        };
        assert_eq!(
            field.put(&mut configuration, 0, 256),
            Err(Violation::NotInUse(id))
        );
        assert_eq!(configuration, Configuration::default());
    }

    #[test]
    fn states_are_named() {
        assert_eq!(
            (When::Always.text(), When::Standstill.text()),
            ("always", "standstill")
        );
    }
}
