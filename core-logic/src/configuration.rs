//! The whole configuration of the board: one plain value, its limits, its record in flash and its change at run time.
//!
//! **Record**: version (2 bytes), length of the payload (2), payload, CRC-32/ISO-HDLC over all of that (4); numbers least
//! significant byte first. The payload is every value of [`FIELDS`] that is in use, in that order, as a signed postcard
//! number. So one table is limits, register map and format at once, and costs half the flash of derived serialisers (for
//! the target, this module, `modbus` and `modbus_rtu`: 19 KiB in place of 40). [`decode`] takes a record only whole, and
//! only when every value lies in its limits and none contradicts another; otherwise it says why and the caller keeps what
//! it had.
//!
//! **Change**: [`ConfigurationStore::stage`] hands out a copy, [`ConfigurationStore::commit`] judges it whole and then
//! puts it in force. So a refused change leaves nothing behind, whether it came over Modbus or from flash.
//!
//! **In memory**: the active configuration carries its CRC, which [`ConfigurationStore::stage`] checks, called at least
//! once a second. A corrupted one is never the base of a change; [`ConfigurationStore::load`] puts the stored one in its
//! place.

mod fields;

use core::fmt;

use crc::{CRC_32_ISO_HDLC, Crc, NoTable};
use serde::{Deserialize, Serialize};

use crate::converter::{ConverterConfigError, Gain};
use crate::design_parameters::{TEMPERATURE_HIGH, TEMPERATURE_LOW};
use crate::front_end::{KeyFactors, PerRange};
use crate::range::Range;
use crate::storm::StormConfig;
use crate::units::{Microamps, MilliCelsius, Ppm, milliseconds};
pub use fields::{FIELD_TEXTS, FIELDS, Field, FieldId, When};

/// Version of the record. It changes with every change of [`Configuration`]'s shape.
pub const VERSION: u16 = 2;
/// Bytes before the payload: version and length.
pub const HEADER: usize = 4;
/// Bytes behind the payload.
pub const TRAILER: usize = 4;
/// Largest payload that any configuration makes, whatever its values; a test works it out.
pub const MAX_PAYLOAD: usize = 520;
/// Largest record: what the flash buffer must hold.
pub const MAX_RECORD: usize = HEADER + MAX_PAYLOAD + TRAILER;

/// Without a table: a record is written and checked too rarely to be worth 1 KiB of flash.
static CRC: Crc<u32, NoTable> = Crc::<u32, NoTable>::new(&CRC_32_ISO_HDLC);

/// Two settings that cannot both be meant, each as its module judges it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Contradiction {
    /// The front end refuses its parameters.
    FrontEnd(crate::front_end::FrontEndError),
    /// The converter refuses its parameters.
    Converter(ConverterConfigError),
    /// The zero drift in use is beyond its own limit.
    ZeroDrift,
    /// The threshold of the open sensor does not lie below every legal level.
    OpenSensor,
    /// What a part repeats of another one ([`Configuration::derive`]) differs from it.
    Derived,
    /// The lowest temperature is not below the highest.
    Temperature,
    /// The key calibration's longest delay does not leave time to settle and to take its samples at the converter's data rate.
    KeyCalibrationDelay,
    /// The slow window of the channels' comparison is not longer than the fast one, or that is shorter than two conversions.
    CompareWindows,
    /// The average's gap is shorter than two conversions: between two of them the average would be empty.
    AverageGap,
    /// The comparators would switch where the small sensor of two is at the end of its range, or beyond.
    SwitchingCurrent,
    /// A storm's window or hold-off is too short for its events.
    Storm,
    /// The open-circuit table is not usable.
    Ocv(crate::ocv::OcvTableError),
}

/// Why a configuration may not be used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Violation {
    /// A value lies outside its limits.
    OutOfLimits {
        /// Which value.
        field: FieldId,
        /// What it is.
        value: i64,
        /// Smallest allowed.
        min: i64,
        /// Largest allowed.
        max: i64,
    },
    /// The value belongs to another front end than the one set.
    NotInUse(FieldId),
    /// Two values contradict each other.
    Contradiction(Contradiction),
}

impl fmt::Display for Violation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::OutOfLimits {
                field,
                value,
                min,
                max,
            } => write!(f, "{field} is {value}, its limits are {min} and {max}"),
            Self::NotInUse(field) => write!(f, "{field} does not belong to the front end in use"),
            Self::Contradiction(Contradiction::Ocv(error)) => {
                write!(f, "open-circuit table: {error}")
            }
            Self::Contradiction(contradiction) => write!(f, "contradiction: {contradiction:?}"),
        }
    }
}

impl core::error::Error for Violation {}

/// Why a record was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ConfigurationError {
    /// Fewer bytes than the record announces, or than any record has.
    TooShort {
        /// Bytes that the record needs, as far as that is known.
        needed: usize,
        /// Bytes there are.
        found: usize,
    },
    /// Another version of the firmware wrote it.
    WrongVersion {
        /// The version that can be read.
        known: u16,
        /// The record's.
        found: u16,
    },
    /// Bytes follow the record, or the payload does not fill its length.
    TrailingBytes(usize),
    /// The record was damaged.
    WrongCrc {
        /// Of the bytes.
        computed: u32,
        /// The record's.
        found: u32,
    },
    /// The CRC is right and the payload is none all the same.
    Malformed,
    /// Its values may not be used.
    Invalid(Violation),
}

impl fmt::Display for ConfigurationError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::TooShort { needed, found } => {
                write!(f, "{found} bytes of at least {needed}")
            }
            Self::WrongVersion { known, found } => {
                write!(f, "version {found}, this firmware reads version {known}")
            }
            Self::TrailingBytes(count) => write!(f, "{count} bytes too many"),
            Self::WrongCrc { computed, found } => {
                write!(f, "CRC {found:#010x}, computed {computed:#010x}")
            }
            Self::Malformed => write!(f, "not a configuration"),
            Self::Invalid(violation) => violation.fmt(f),
        }
    }
}

impl core::error::Error for ConfigurationError {}

/// The buffer cannot hold the record; [`MAX_RECORD`] bytes always can.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BufferTooSmall;

/// Every setting of the board. Plain data: each part is what its module is made from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Configuration {
    /// The sensor that is fitted.
    pub front_end: crate::front_end::FrontEnd,
    /// The converter's path.
    pub converter: crate::converter::ConverterConfig,
    /// Correction of the converter's current, per range.
    pub current_gain: PerRange<Ppm>,
    /// Zero drift in use, and how it is taken.
    pub zero_drift: crate::zero_drift::ZeroDriftConfig,
    /// Sliding average of the current.
    pub average: crate::sliding_average::SlidingAverageConfig,
    /// How the factors by key state are taken.
    pub key_calibration: crate::key_calibration::KeyCalibrationConfig,
    /// The factors in use until some are taken; for the small sensor, which is the one selected at 0 A.
    pub key_factors: crate::front_end::KeyFactors,
    /// What a supply sweep must satisfy.
    pub supply_calibration: crate::supply_calibration::SupplyCalibrationConfig,
    /// Current of the sweep's loaded run, Ipt; 0 until a bench sets it.
    pub supply_test_current: Microamps,
    /// Charge from the energy meter. Its full scales follow from the front end.
    pub meter: crate::meter::MeterConfig,
    /// When the range flag chatters.
    pub chatter: crate::range::ChatterConfig,
    /// When the range flag contradicts the level. Its switching current is the meter's, its full scale the front
    /// end's.
    pub flag: crate::range::FlagPlausibilityConfig,
    /// When meter and converter disagree.
    pub compare: crate::channel_compare::CompareConfig,
    /// When the range edge is masked.
    pub edge_storm: StormConfig,
    /// When the meter's interrupt is masked.
    pub meter_line_storm: StormConfig,
    /// When a sensor is open.
    pub open_sensor: crate::open_sensor::OpenSensorConfig,
    /// Lowest and highest temperature of sensors and board, beyond which it is reported.
    pub temperature_limits: [MilliCelsius; 2],
    /// When charge and state of charge are written to flash.
    pub save_policy: crate::retained::SavePolicyConfig,
    /// State of charge.
    pub soc: crate::soc::SocConfig,
    /// Open-circuit voltage over state of charge.
    pub ocv: crate::ocv::OcvTable,
    /// The board on the RS485 line.
    pub rtu: crate::modbus_rtu::RtuConfig,
}

impl Default for Configuration {
    /// The factory's.
    fn default() -> Self {
        let mut configuration = Self {
            front_end: Default::default(),
            converter: Default::default(),
            current_gain: PerRange::both(Ppm::ZERO),
            zero_drift: Default::default(),
            average: Default::default(),
            key_calibration: Default::default(),
            key_factors: Default::default(),
            supply_calibration: Default::default(),
            supply_test_current: Microamps::ZERO,
            meter: Default::default(),
            chatter: Default::default(),
            flag: Default::default(),
            compare: Default::default(),
            edge_storm: StormConfig::RANGE_EDGE,
            meter_line_storm: StormConfig::METER_LINE,
            open_sensor: Default::default(),
            temperature_limits: [TEMPERATURE_LOW, TEMPERATURE_HIGH],
            save_policy: Default::default(),
            soc: Default::default(),
            ocv: Default::default(),
            rtu: Default::default(),
        };
        configuration.derive();
        configuration
    }
}

impl Configuration {
    /// Judges every value and every pair of values that could contradict each other.
    ///
    /// # Errors
    /// The first violation: limits in the order of [`FIELDS`], then contradictions.
    pub fn validate(&self) -> Result<(), Violation> {
        for (field, element, value) in self.values() {
            field.check(element, value)?;
        }
        self.contradiction()
            .map_or(Ok(()), |found| Err(Violation::Contradiction(found)))
    }

    /// Renews what a part repeats of another one, so that no client has to keep the two alike.
    pub fn derive(&mut self) {
        let (full_scale, switching_current, small_full_scale) = self.derived();
        self.meter.full_scale = full_scale;
        self.flag.switching_current = switching_current;
        self.flag.small_full_scale = small_full_scale;
    }

    /// What was found of another sensor's zero, or of one that is known otherwise now, would be taken off once more.
    #[inline(never)]
    pub fn forget_zero(&mut self) {
        self.zero_drift.value = PerRange::both(Microamps::ZERO);
        self.key_factors = KeyFactors::NONE;
    }

    fn contradiction(&self) -> Option<Contradiction> {
        if let Err(violation) = self.front_end.validate() {
            Some(Contradiction::FrontEnd(violation))
        } else if self.converter.gain != Gain::X1 {
            // Of what these parts refuse, the limits of single values are those of `FIELDS`, which have been looked at.
            Some(Contradiction::Converter(ConverterConfigError::Gain))
        } else if !self.zero_drift.value_is_within_limit() {
            Some(Contradiction::ZeroDrift)
        } else if !self.open_sensor.threshold_is_valid(&self.front_end) {
            Some(Contradiction::OpenSensor)
        } else if !self.temperature_limits.is_sorted_by(|low, high| low < high) {
            Some(Contradiction::Temperature)
        } else if !self.key_calibration_has_time() {
            Some(Contradiction::KeyCalibrationDelay)
        } else if self.compare.fast_window_ms >= self.compare.slow_window_ms
            || self.is_within_two_conversions(self.compare.fast_window_ms)
        {
            Some(Contradiction::CompareWindows)
        } else if self.is_within_two_conversions(self.average.max_gap_ms) {
            Some(Contradiction::AverageGap)
        } else if self.front_end.has_two_ranges()
            && self.meter.switching_current >= self.front_end.full_scale(Range::Small)
        {
            Some(Contradiction::SwitchingCurrent)
        } else if !self.edge_storm.is_valid() || !self.meter_line_storm.is_valid() {
            Some(Contradiction::Storm)
        } else if self.derived() != self.repeated() {
            Some(Contradiction::Derived)
        } else {
            self.ocv.validate().err().map(Contradiction::Ocv)
        }
    }

    const fn is_within_two_conversions(&self, time_ms: u32) -> bool {
        let period = self.converter.period(self.front_end.channel());
        milliseconds(time_ms).as_ticks() < 2 * period.as_ticks()
    }

    /// Whether settling and a batch of samples end before the key calibration's longest delay.
    const fn key_calibration_has_time(&self) -> bool {
        let key = &self.key_calibration;
        let period = self.converter.period(self.front_end.channel());
        // One conversion is under way when the signal has settled.
        let conversions = if key.enabled {
            key.samples as u64 + 1
        } else {
            0
        };
        let needed = milliseconds(key.settle_ms).as_ticks() + conversions * period.as_ticks();
        needed < milliseconds(key.max_delay_ms).as_ticks()
    }

    /// CRC-32 over every value, those that [`Configuration::derive`] makes included.
    #[must_use]
    pub fn crc(&self) -> u32 {
        let mut digest = CRC.digest();
        for (_, _, value) in self.values() {
            digest.update(&value.to_le_bytes());
        }
        let (full_scale, switching_current, small_full_scale) = self.repeated();
        for current in [
            full_scale.small,
            full_scale.large,
            switching_current,
            small_full_scale,
        ] {
            digest.update(&current.get().to_le_bytes());
        }
        digest.finalize()
    }

    /// Every value in use, in the order of [`FIELDS`].
    const fn values(&self) -> Values {
        Values {
            configuration: *self,
            row: 0,
            element: 0,
        }
    }

    /// What [`Configuration::derive`] sets.
    const fn repeated(&self) -> (PerRange<Microamps>, Microamps, Microamps) {
        (
            self.meter.full_scale,
            self.flag.switching_current,
            self.flag.small_full_scale,
        )
    }

    /// What it should be.
    const fn derived(&self) -> (PerRange<Microamps>, Microamps, Microamps) {
        (
            PerRange {
                small: self.front_end.meter_full_scale(Range::Small),
                large: self.front_end.meter_full_scale(Range::Large),
            },
            self.meter.switching_current,
            self.front_end.full_scale(Range::Small),
        )
    }
}

/// See [`Configuration::values`]. A copy, since a field gives access to what it reads.
struct Values {
    configuration: Configuration,
    row: usize,
    element: usize,
}

impl Iterator for Values {
    type Item = (&'static Field, usize, i64);

    #[inline(never)]
    fn next(&mut self) -> Option<Self::Item> {
        loop {
            let field = FIELDS.get(self.row)?;
            let element = self.element;
            if element >= usize::from(field.layout.count) {
                self.row += 1;
                self.element = 0;
                continue;
            }
            self.element += 1;
            if let Some(value) = field.get_in(&mut self.configuration, element) {
                return Some((field, element, value));
            }
        }
    }
}

/// Writes the record of `configuration` to the beginning of `buffer` and returns it.
///
/// # Errors
/// [`BufferTooSmall`]; the buffer's content is then undefined.
pub fn encode<'b>(
    configuration: &Configuration,
    buffer: &'b mut [u8],
) -> Result<&'b [u8], BufferTooSmall> {
    let mut payload = 0;
    for (_, _, value) in configuration.values() {
        let rest = buffer.get_mut(HEADER + payload..).ok_or(BufferTooSmall)?;
        payload += postcard::to_slice(&value, rest)
            .map_err(|_| BufferTooSmall)?
            .len();
    }
    let length = u16::try_from(payload).map_err(|_| BufferTooSmall)?;
    let [v0, v1] = VERSION.to_le_bytes();
    let [l0, l1] = length.to_le_bytes();
    *buffer.first_chunk_mut::<HEADER>().ok_or(BufferTooSmall)? = [v0, v1, l0, l1];
    let end = HEADER + payload;
    let crc = CRC.checksum(buffer.get(..end).ok_or(BufferTooSmall)?);
    buffer
        .get_mut(end..)
        .and_then(|rest| rest.first_chunk_mut::<TRAILER>())
        .map(|trailer| *trailer = crc.to_le_bytes())
        .ok_or(BufferTooSmall)?;
    buffer.get(..end + TRAILER).ok_or(BufferTooSmall)
}

/// Reads a record, which `bytes` must be to the byte.
///
/// # Errors
/// Why it may not be used; see [`ConfigurationError`].
pub fn decode(bytes: &[u8]) -> Result<Configuration, ConfigurationError> {
    let too_short = |needed| ConfigurationError::TooShort {
        needed,
        found: bytes.len(),
    };
    let (&[v0, v1, l0, l1], rest) = bytes
        .split_first_chunk::<HEADER>()
        .ok_or(too_short(HEADER + TRAILER))?;
    let version = u16::from_le_bytes([v0, v1]);
    if version != VERSION {
        return Err(ConfigurationError::WrongVersion {
            known: VERSION,
            found: version,
        });
    }
    let length = usize::from(u16::from_le_bytes([l0, l1]));
    let (payload, trailer) = rest
        .split_at_checked(length)
        .ok_or(too_short(HEADER + length + TRAILER))?;
    let (trailer, extra) = trailer
        .split_first_chunk::<TRAILER>()
        .ok_or(too_short(HEADER + length + TRAILER))?;
    if !extra.is_empty() {
        return Err(ConfigurationError::TrailingBytes(extra.len()));
    }
    let found = u32::from_le_bytes(*trailer);
    let mut digest = CRC.digest();
    digest.update(&[v0, v1, l0, l1]);
    digest.update(payload);
    let computed = digest.finalize();
    if computed != found {
        return Err(ConfigurationError::WrongCrc { computed, found });
    }
    let configuration = values_from(payload)?;
    configuration
        .validate()
        .map_err(ConfigurationError::Invalid)?;
    Ok(configuration)
}

/// The configuration whose values these are. The first one says which front end, and with it which values follow.
fn values_from(mut payload: &[u8]) -> Result<Configuration, ConfigurationError> {
    let mut configuration = Configuration::default();
    for field in FIELDS {
        for element in 0..usize::from(field.layout.count) {
            if field.get_in(&mut configuration, element).is_none() {
                continue;
            }
            let (value, rest) = postcard::take_from_bytes::<i64>(payload)
                .map_err(|_| ConfigurationError::Malformed)?;
            payload = rest;
            field
                .put(&mut configuration, element, value)
                .map_err(ConfigurationError::Invalid)?;
        }
    }
    match payload.len() {
        0 => Ok(configuration),
        extra => Err(ConfigurationError::TrailingBytes(extra)),
    }
}

/// The memory that holds the active configuration no longer holds what was put there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Corrupted;

/// Why a change was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CommitError {
    /// The new configuration may not be used.
    Invalid(Violation),
    /// The active one is damaged: [`ConfigurationStore::load`] first.
    Corrupted,
}

/// A configuration with the CRC that it had when it was put in force.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GuardedConfiguration {
    configuration: Configuration,
    crc: u32,
}

impl GuardedConfiguration {
    /// Seals `configuration` as it is.
    #[must_use]
    pub fn new(configuration: Configuration) -> Self {
        Self {
            crc: configuration.crc(),
            configuration,
        }
    }

    /// What is inside, unchecked.
    #[must_use]
    pub const fn get(&self) -> &Configuration {
        &self.configuration
    }

    /// The CRC that it had.
    #[must_use]
    pub const fn crc(&self) -> u32 {
        self.crc
    }

    /// Whether it still has it.
    ///
    /// # Errors
    /// [`Corrupted`] when it has not.
    pub fn verify(&self) -> Result<(), Corrupted> {
        if self.configuration.crc() == self.crc {
            Ok(())
        } else {
            Err(Corrupted)
        }
    }
}

/// The active configuration and the only way to change it.
#[derive(Clone, Copy, Debug)]
pub struct ConfigurationStore {
    active: GuardedConfiguration,
    generation: u32,
}

impl Default for ConfigurationStore {
    /// The factory's configuration.
    fn default() -> Self {
        Self {
            active: GuardedConfiguration::new(Configuration::default()),
            generation: 0,
        }
    }
}

impl ConfigurationStore {
    /// The configuration in force.
    #[must_use]
    pub const fn active(&self) -> &Configuration {
        self.active.get()
    }

    /// CRC-32 of the configuration in force.
    #[must_use]
    pub const fn crc(&self) -> u32 {
        self.active.crc()
    }

    /// Counts the changes, wrapping: who keeps something made from the configuration compares it.
    #[must_use]
    pub const fn generation(&self) -> u32 {
        self.generation
    }

    /// The configuration in force, to be copied, changed and committed.
    ///
    /// # Errors
    /// [`Corrupted`] when it is damaged.
    pub fn stage(&self) -> Result<&Configuration, Corrupted> {
        self.active.verify()?;
        Ok(self.active.get())
    }

    /// Puts `staged` in force, if all of it may be used. Settings that are those in force already change nothing: a master that
    /// writes them again and again restarts no comparison.
    ///
    /// # Errors
    /// Why not; then nothing has changed.
    pub fn commit(&mut self, mut staged: Configuration) -> Result<(), CommitError> {
        self.active
            .verify()
            .map_err(|Corrupted| CommitError::Corrupted)?;
        staged.derive();
        // Of its own check, not field by field: that is code which there is already.
        if GuardedConfiguration::new(staged).crc() == self.active.crc() {
            return Ok(());
        }
        self.load(staged).map_err(CommitError::Invalid)
    }

    /// Puts a configuration in force that was not made from the active one, which may be damaged: the stored one.
    ///
    /// # Errors
    /// Why it may not be used; then nothing has changed.
    pub fn load(&mut self, mut configuration: Configuration) -> Result<(), Violation> {
        configuration.derive();
        configuration.validate()?;
        self.replace(configuration);
        Ok(())
    }

    /// Puts the factory's configuration in force.
    pub fn factory_defaults(&mut self) {
        self.replace(Configuration::default());
    }

    /// Flips a bit behind the store's back.
    #[cfg(test)]
    pub(crate) const fn corrupt(&mut self) {
        self.active.configuration.soc.capacity_mah ^= 1 << 4;
    }

    fn replace(&mut self, configuration: Configuration) {
        self.active = GuardedConfiguration::new(configuration);
        self.generation = self.generation.wrapping_add(1);
    }
}

#[cfg(test)]
#[allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss
)]
mod tests;
