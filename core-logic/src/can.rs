//! The frames of `can/board.dbc`: 11-bit identifiers, 500 kbit/s, eight bytes, Intel order.
//!
//! Conventions on the wire
//! - Positive current and charge is discharge.
//! - A number beyond its signal's limits stays at the limit, and the signal's validity says *saturated*.
//! - A reading is never replaced by 0. While *stale*, *open* or *chip fault* stands against an instantaneous reading its
//!   number means nothing, and the signal's "not available" value is sent; under the other causes (saturated,
//!   implausible, range change, …) the number is sent with its causes. Charge and state of charge are sums: they keep
//!   their number under every cause except *stale*, which there means never counted.
//! - Current, charge and state of charge, and what is received, carry a counter and a CRC ([`crate::e2e`]).

pub mod layout;

use crate::design_parameters::{CAN_RECEIVE_MAX_LOST, CAN_RECEIVE_TIMEOUT_MS};
use crate::diagnosis::{Code, CodeSet, Detail};
use crate::e2e::{self, DataId, E2eError, Payload, ReceiverConfig, Sequence};
use crate::key_calibration::{KeyPhase, KeyState};
use crate::range::Range;
use crate::units::{
    Duration, Instant, Microamps, Microvolts, MilliCelsius, Millivolts, Nanocoulombs, Ppm,
    div_round, elapsed,
};
use crate::validity::Validity;
use layout::{Field, Header};

/// Version of the frames' meaning, sent in the identity frame.
pub const PROTOCOL_VERSION: u8 = 1;

/// A classic CAN data frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Frame {
    /// 11-bit identifier.
    pub id: u16,
    /// Length code: the number of data bytes, or 9 … 15 as it was received, which stand for eight (ISO 11898-1).
    pub dlc: u8,
    /// Data.
    pub data: Payload,
}

/// Causes under which an instantaneous reading's number means nothing.
const READING_MEANINGLESS: Validity = Validity::STALE
    .and(Validity::OPEN)
    .and(Validity::CHIP_FAULT);
/// Causes under which a sum's number means nothing.
const SUM_MEANINGLESS: Validity = Validity::STALE;

/// A payload in the making.
#[derive(Clone, Copy, Default)]
struct Word(u64);

impl Word {
    /// The low bits of `raw`: for counters that wrap and for sets of bits.
    fn with(self, field: Field, raw: i64) -> Self {
        Self(field.put(self.0, raw))
    }

    /// The nearest value with a meaning: for counters that stay at the end.
    fn with_clamped(self, field: Field, raw: i64) -> Self {
        self.with(field, field.clamp(raw))
    }

    /// A value, or "not available".
    fn with_optional(self, field: Field, raw: Option<i64>) -> Self {
        match (raw, field.not_available()) {
            (None, Some(not_available)) => self.with(field, not_available),
            (raw, _) => self.with_clamped(field, raw.unwrap_or(field.minimum())),
        }
    }

    /// A measured value with its validity, by the conventions of this module.
    fn with_measured(
        self,
        number: Field,
        causes: Field,
        raw: i64,
        validity: Validity,
        meaningless: Validity,
    ) -> Self {
        let available = validity.bits() & meaningless.bits() == 0;
        let beyond = available && !number.holds(raw);
        let validity = validity.and_if(beyond, Validity::SATURATED);
        self.with_optional(number, available.then_some(raw))
            .with(causes, i64::from(validity.bits()))
    }

    fn with_reading(self, number: Field, causes: Field, raw: i64, validity: Validity) -> Self {
        self.with_measured(number, causes, raw, validity, READING_MEANINGLESS)
    }

    fn with_sum(self, number: Field, causes: Field, raw: i64, validity: Validity) -> Self {
        self.with_measured(number, causes, raw, validity, SUM_MEANINGLESS)
    }

    fn frame(self, header: Header) -> Frame {
        Frame {
            id: header.id,
            dlc: 8,
            data: self.0.to_le_bytes(),
        }
    }

    fn protected(self, header: Header, counter: u8) -> Frame {
        let mut frame = self.frame(header);
        if let Some(id) = header.data_id {
            e2e::protect(id, counter, &mut frame.data);
        }
        frame
    }
}

fn saturated(value: u64) -> i64 {
    i64::try_from(value).unwrap_or(i64::MAX)
}

fn milliseconds(duration: Duration) -> i64 {
    saturated(duration.as_millis())
}

const fn range_bit(range: Range) -> i64 {
    match range {
        Range::Small => 0,
        Range::Large => 1,
    }
}

/// `Current`: the last conversion, every 10 ms.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Current {
    /// The current.
    pub current: Microamps,
    /// Its validity.
    pub validity: Validity,
    /// The range it was converted in.
    pub range: Range,
    /// Number of the conversion; its low eight bits are sent.
    pub conversions: u32,
    /// Time since the conversion ended; `None` before the first.
    pub age: Option<Duration>,
}

impl Current {
    /// The frame with this counter.
    #[must_use]
    pub fn encode(&self, counter: u8) -> Frame {
        use layout::current as at;
        Word::default()
            .with_reading(
                at::VALUE,
                at::VALIDITY,
                i64::from(self.current.to_milliamps()),
                self.validity,
            )
            .with(at::RANGE, range_bit(self.range))
            .with(at::CONVERSIONS, i64::from(self.conversions))
            .with_optional(at::AGE, self.age.map(milliseconds))
            .protected(at::HEADER, counter)
    }
}

/// `CurrentAverage`: the sliding average, every 10 ms.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CurrentAverage {
    /// The average.
    pub average: Microamps,
    /// Its validity.
    pub validity: Validity,
    /// Conversions in it.
    pub samples: u16,
    /// Time it covers.
    pub span: Duration,
}

impl CurrentAverage {
    /// The frame with this counter.
    #[must_use]
    pub fn encode(&self, counter: u8) -> Frame {
        use layout::current_average as at;
        Word::default()
            .with_reading(
                at::VALUE,
                at::VALIDITY,
                i64::from(self.average.to_milliamps()),
                self.validity,
            )
            .with_clamped(at::SAMPLES, i64::from(self.samples))
            .with_clamped(at::SPAN, milliseconds(self.span) / 2)
            .protected(at::HEADER, counter)
    }
}

/// `Charge`: the net charge, every 100 ms.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Charge {
    /// The net charge.
    pub charge: Nanocoulombs,
    /// Its validity.
    pub validity: Validity,
    /// Part of it was estimated, bridged or restored with loss.
    pub estimated: bool,
}

impl Charge {
    /// The frame with this counter.
    #[must_use]
    pub fn encode(&self, counter: u8) -> Frame {
        use layout::charge as at;
        Word::default()
            .with_sum(
                at::VALUE,
                at::VALIDITY,
                div_round(self.charge.get(), 1_000_000),
                self.validity,
            )
            .with(at::ESTIMATED, i64::from(self.estimated))
            .protected(at::HEADER, counter)
    }
}

/// `MeterCurrent`: the meter's mean current and the charge's uncertainty, every 100 ms.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MeterCurrent {
    /// Mean current.
    pub current: Microamps,
    /// Its validity.
    pub validity: Validity,
    /// Below the no-load threshold.
    pub below_no_load: bool,
    /// Bound on the charge's error by estimated intervals and gaps; `None` when unknown.
    pub charge_uncertainty: Option<Nanocoulombs>,
}

impl MeterCurrent {
    /// The frame with this counter.
    #[must_use]
    pub fn encode(&self, counter: u8) -> Frame {
        use layout::meter_current as at;
        // A bound is rounded up.
        let uncertainty = self
            .charge_uncertainty
            .map(|bound| div_round(bound.get().saturating_add(4_999_999), 10_000_000));
        Word::default()
            .with_reading(
                at::VALUE,
                at::VALIDITY,
                i64::from(self.current.to_milliamps()),
                self.validity,
            )
            .with(at::BELOW_NO_LOAD, i64::from(self.below_no_load))
            .with_optional(at::UNCERTAINTY, uncertainty)
            .protected(at::HEADER, counter)
    }
}

/// `StateOfCharge`, every 100 ms.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StateOfCharge {
    /// State of charge.
    pub state_of_charge: Ppm,
    /// Its validity; *stale* while it was never known.
    pub validity: Validity,
    /// Its half-width.
    pub uncertainty: Option<Ppm>,
    /// Charge left in the battery.
    pub remaining: Option<Nanocoulombs>,
}

impl StateOfCharge {
    /// The frame with this counter.
    #[must_use]
    pub fn encode(&self, counter: u8) -> Frame {
        use layout::state_of_charge as at;
        let percent_hundredths = div_round(i64::from(self.state_of_charge.get()), 100);
        // A bound is rounded up.
        let uncertainty = self
            .uncertainty
            .map(|ppm| div_round(i64::from(ppm.get()) + 499, 1_000));
        // 0.1 Ah = 360 C
        let remaining = self
            .remaining
            .map(|charge| div_round(charge.get(), 360_000_000_000));
        Word::default()
            .with_sum(at::VALUE, at::VALIDITY, percent_hundredths, self.validity)
            .with_optional(at::UNCERTAINTY, uncertainty)
            .with_optional(at::REMAINING, remaining)
            .protected(at::HEADER, counter)
    }
}

/// `Throughput`: charge in both directions, every second.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Throughput {
    /// Charge that left the battery, as a magnitude.
    pub discharged: Nanocoulombs,
    /// Charge that entered it, as a magnitude.
    pub charged: Nanocoulombs,
}

impl Throughput {
    /// The frame.
    #[must_use]
    pub fn encode(&self) -> Frame {
        use layout::throughput as at;
        let coulombs = |charge: Nanocoulombs| div_round(charge.get(), 1_000_000_000);
        Word::default()
            .with_clamped(at::DISCHARGED, coulombs(self.discharged))
            .with_clamped(at::CHARGED, coulombs(self.charged))
            .frame(at::HEADER)
    }
}

/// `Environment`: supply and temperatures, every 100 ms.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Environment {
    /// The sensors' supply.
    pub supply: Millivolts,
    /// Its validity.
    pub supply_validity: Validity,
    /// Temperature at the sensors.
    pub sensor_temperature: MilliCelsius,
    /// Its validity.
    pub sensor_temperature_validity: Validity,
    /// Temperature of the board.
    pub board_temperature: MilliCelsius,
    /// Its validity.
    pub board_temperature_validity: Validity,
}

impl Environment {
    /// The frame.
    #[must_use]
    pub fn encode(&self) -> Frame {
        use layout::environment as at;
        let tenths = |temperature: MilliCelsius| div_round(i64::from(temperature.get()), 100);
        Word::default()
            .with_reading(
                at::SUPPLY,
                at::SUPPLY_VALIDITY,
                i64::from(self.supply.get()),
                self.supply_validity,
            )
            .with_reading(
                at::SENSOR_TEMPERATURE,
                at::SENSOR_TEMPERATURE_VALIDITY,
                tenths(self.sensor_temperature),
                self.sensor_temperature_validity,
            )
            .with_reading(
                at::BOARD_TEMPERATURE,
                at::BOARD_TEMPERATURE_VALIDITY,
                tenths(self.board_temperature),
                self.board_temperature_validity,
            )
            .frame(at::HEADER)
    }
}

/// `BoardState`: key and high voltage, range and counters, every 100 ms.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BoardState {
    /// Key state that the board concludes; `None` when nothing tells.
    pub key: Option<KeyState>,
    /// High-voltage feedback; `None` when nothing tells.
    pub high_voltage: Option<bool>,
    /// The board's permit.
    pub permit: bool,
    /// Calibration by key state.
    pub key_calibration: Option<KeyPhase>,
    /// Range now.
    pub range: Range,
    /// `BatteryVoltage` is fresh.
    pub cell_voltage_fresh: bool,
    /// `VehicleState` is fresh.
    pub vehicle_state_fresh: bool,
    /// Range changes; the low sixteen bits are sent.
    pub edges: u32,
    /// Coalesced pairs of them.
    pub coalesced: u16,
    /// Meter intervals whose charge was estimated.
    pub estimated_intervals: u32,
    /// Times off the bus.
    pub bus_offs: u16,
    /// Received frames refused; the low eight bits are sent.
    pub refused: u32,
}

impl BoardState {
    /// The frame.
    #[must_use]
    pub fn encode(&self) -> Frame {
        use layout::board_state as at;
        let phase = self.key_calibration.map(|phase| i64::from(phase.number()));
        Word::default()
            .with_optional(at::KEY, self.key.map(key_number))
            .with_optional(at::HIGH_VOLTAGE, self.high_voltage.map(i64::from))
            .with(at::PERMIT, i64::from(self.permit))
            .with_optional(at::KEY_CALIBRATION, phase)
            .with(at::RANGE, range_bit(self.range))
            .with(at::CELL_VOLTAGE_FRESH, i64::from(self.cell_voltage_fresh))
            .with(at::VEHICLE_STATE_FRESH, i64::from(self.vehicle_state_fresh))
            .with(at::EDGES, i64::from(self.edges))
            .with_clamped(at::COALESCED, i64::from(self.coalesced))
            .with_clamped(at::ESTIMATED_INTERVALS, i64::from(self.estimated_intervals))
            .with_clamped(at::BUS_OFFS, i64::from(self.bus_offs))
            .with(at::REFUSED, i64::from(self.refused))
            .frame(at::HEADER)
    }
}

const fn key_number(key: KeyState) -> i64 {
    match key {
        KeyState::Off => 0,
        KeyState::Acc => 1,
        KeyState::On => 2,
        KeyState::Start => 3,
    }
}

/// `DiagnosisActive`: bit n is the code with number n.
#[must_use]
pub const fn diagnosis_active(codes: CodeSet) -> Frame {
    codes_frame(layout::diagnosis_active::HEADER, codes)
}

/// `DiagnosisLatched`: bit n is the code with number n.
#[must_use]
pub const fn diagnosis_latched(codes: CodeSet) -> Frame {
    codes_frame(layout::diagnosis_latched::HEADER, codes)
}

const fn codes_frame(header: Header, codes: CodeSet) -> Frame {
    Frame {
        id: header.id,
        dlc: 8,
        data: codes.bits().to_le_bytes(),
    }
}

/// `DiagnosisDetail`: one reported code, every 100 ms; [`CodeSet::next_after`] gives the turn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DiagnosisDetail {
    /// The code and what is known about it; `None` when none is reported.
    pub code: Option<(Code, Detail)>,
    /// How many are reported.
    pub reported: u32,
}

impl DiagnosisDetail {
    /// The frame.
    #[must_use]
    pub fn encode(&self) -> Frame {
        use layout::diagnosis_detail as at;
        let code = self.code.map(|(code, _)| code);
        let detail = self.code.map(|(_, detail)| detail);
        let first_seen = detail.and_then(|detail| detail.first_seen);
        let seconds = first_seen.map(|at| saturated(at.as_ticks() / 1_000_000));
        Word::default()
            .with_optional(at::CODE, code.map(|code| i64::from(code.number())))
            .with(
                at::SEVERITY,
                code.map_or(0, |code| code.rule().severity as i64),
            )
            .with(
                at::ACTIVE,
                i64::from(detail.is_some_and(|detail| detail.active)),
            )
            .with(
                at::LATCHED,
                i64::from(detail.is_some_and(|detail| detail.latched)),
            )
            .with_clamped(at::REPORTED, i64::from(self.reported))
            .with(
                at::OCCURRENCES,
                detail.map_or(0, |detail| i64::from(detail.occurrences)),
            )
            .with_optional(at::FIRST_SEEN, seconds)
            .frame(at::HEADER)
    }
}

/// Why the board started.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[repr(u8)]
pub enum ResetCause {
    /// No flag was set.
    #[default]
    Unknown = 0,
    /// Power came on.
    PowerOn = 1,
    /// The supply dipped.
    BrownOut = 2,
    /// The reset pin.
    Pin = 3,
    /// By software: a panic, or a command.
    Software = 4,
    /// The independent watchdog.
    IndependentWatchdog = 5,
    /// The window watchdog.
    WindowWatchdog = 6,
    /// A forbidden low-power entry.
    LowPower = 7,
}

/// `Identity`: six pages, one every 200 ms, so that all of them are out 1.2 s after the first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Identity {
    /// Major, minor, patch.
    pub version: [u8; 3],
    /// Cause of the last reset.
    pub reset_cause: ResetCause,
    /// Resets since the retained memory was last lost; the low sixteen bits are sent.
    pub boots: u32,
    /// First eight hexadecimal digits of the source revision.
    pub commit: u32,
    /// The source differed from it.
    pub modified: bool,
    /// CRC of the configuration in use; the low sixteen bits are sent.
    pub configuration_crc: u32,
    /// CRC-32 of the last panic's file name; 0 when there was none.
    pub panic_hash: u32,
    /// Line of the last panic.
    pub panic_line: u32,
    /// Tasks that had not checked in when the watchdog bit.
    pub late_tasks: u8,
    /// The microcontroller's 96-bit unique ID, lowest word first.
    pub unique_id: [u32; 3],
    /// Time since the start.
    pub uptime: Duration,
    /// Least free stack so far, in bytes.
    pub stack_free: u32,
    /// Share of the log in use; the firmware does not know it and leaves it out.
    pub log_fill: Option<Ppm>,
}

impl Identity {
    /// Number of pages.
    pub const PAGES: u8 = 6;

    /// The frame with this page, modulo [`Identity::PAGES`].
    #[must_use]
    pub fn encode(&self, page: u8) -> Frame {
        use layout::identity as at;
        let page = page % Self::PAGES;
        let word = Word::default().with(at::PAGE, i64::from(page));
        let [low, middle, high] = self.unique_id.map(i64::from);
        let [major, minor, patch] = self.version.map(i64::from);
        let word = match page {
            0 => word
                .with(at::PROTOCOL, i64::from(PROTOCOL_VERSION))
                .with(at::MAJOR, major)
                .with(at::MINOR, minor)
                .with(at::PATCH, patch)
                .with(at::RESET_CAUSE, self.reset_cause as i64)
                .with(at::BOOTS, i64::from(self.boots)),
            1 => word
                .with(at::COMMIT, i64::from(self.commit))
                .with(at::MODIFIED, i64::from(self.modified))
                .with(at::CONFIGURATION_CRC, i64::from(self.configuration_crc)),
            2 => word
                .with(at::PANIC_HASH, i64::from(self.panic_hash))
                .with_clamped(at::PANIC_LINE, i64::from(self.panic_line))
                .with(at::LATE_TASKS, i64::from(self.late_tasks)),
            3 => word.with(at::UID_LOW, low | (middle << 32)),
            4 => word.with(at::UID_HIGH, (middle >> 16) | (high << 16)),
            _ => word
                .with_clamped(at::UPTIME, saturated(self.uptime.as_secs()))
                .with_clamped(at::STACK_FREE, i64::from(self.stack_free))
                .with_optional(
                    at::LOG_FILL,
                    self.log_fill
                        .map(|share| div_round(i64::from(share.get()), 5_000)),
                ),
        };
        word.frame(at::HEADER)
    }
}

/// Encodes the protected messages, each with its own counter.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Sender {
    current: Sequence,
    current_average: Sequence,
    charge: Sequence,
    meter_current: Sequence,
    state_of_charge: Sequence,
}

impl Sender {
    /// The next `Current`.
    pub fn current(&mut self, values: &Current) -> Frame {
        values.encode(self.current.advance())
    }

    /// The next `CurrentAverage`.
    pub fn current_average(&mut self, values: &CurrentAverage) -> Frame {
        values.encode(self.current_average.advance())
    }

    /// The next `Charge`.
    pub fn charge(&mut self, values: &Charge) -> Frame {
        values.encode(self.charge.advance())
    }

    /// The next `MeterCurrent`.
    pub fn meter_current(&mut self, values: &MeterCurrent) -> Frame {
        values.encode(self.meter_current.advance())
    }

    /// The next `StateOfCharge`.
    pub fn state_of_charge(&mut self, values: &StateOfCharge) -> Frame {
        values.encode(self.state_of_charge.advance())
    }
}

/// `BatteryVoltage` as received.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct BatteryVoltage {
    /// Voltage of the limiting cell.
    pub cell: Option<Microvolts>,
    /// Voltage of the pack.
    pub pack: Option<Millivolts>,
    /// Temperature of the cells.
    pub cell_temperature: Option<MilliCelsius>,
}

/// `VehicleState` as received.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct VehicleState {
    /// Key state.
    pub key: Option<KeyState>,
    /// High voltage is on.
    pub high_voltage: Option<bool>,
}

/// A received message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Received {
    /// `BatteryVoltage`.
    BatteryVoltage(BatteryVoltage),
    /// `VehicleState`.
    VehicleState(VehicleState),
}

/// Why a received frame is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ReceiveError {
    /// None of the messages that this board receives.
    UnknownId(u16),
    /// It has this many bytes instead of eight.
    Length {
        /// Identifier.
        id: u16,
        /// Bytes.
        dlc: u8,
    },
    /// Its end-to-end check failed.
    EndToEnd {
        /// Identifier.
        id: u16,
        /// Why.
        error: E2eError,
    },
    /// A signal holds a number without a meaning.
    Reserved {
        /// Identifier.
        id: u16,
        /// First bit of the signal.
        start_bit: u8,
        /// The number.
        raw: i64,
    },
}

impl core::fmt::Display for ReceiveError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::UnknownId(id) => write!(f, "message {id:#05x} is not received here"),
            Self::Length { id, dlc } => write!(
                f,
                "message {id:#05x} has the length code {dlc} instead of 8"
            ),
            Self::EndToEnd { id, error } => {
                write!(f, "message {id:#05x} fails its end-to-end check: {error:?}")
            }
            Self::Reserved { id, start_bit, raw } => {
                write!(
                    f,
                    "message {id:#05x} holds the reserved value {raw} at bit {start_bit}"
                )
            }
        }
    }
}

impl core::error::Error for ReceiveError {}

const fn receiver_config(data_id: DataId) -> ReceiverConfig {
    ReceiverConfig {
        data_id,
        max_lost: CAN_RECEIVE_MAX_LOST,
        timeout: Duration::from_ticks(CAN_RECEIVE_TIMEOUT_MS * 1_000),
    }
}

const BATTERY_VOLTAGE: ReceiverConfig = receiver_config(layout::battery_voltage::DATA_ID);
const VEHICLE_STATE: ReceiverConfig = receiver_config(layout::vehicle_state::DATA_ID);

/// Reads one signal of message `id`: a number, `None` for "not available".
fn read(id: u16, data: Payload, field: Field) -> Result<Option<i64>, ReceiveError> {
    let raw = field.get(layout::word(data));
    if Some(raw) == field.not_available() {
        Ok(None)
    } else if field.holds(raw) {
        Ok(Some(raw))
    } else {
        Err(ReceiveError::Reserved {
            id,
            start_bit: field.start,
            raw,
        })
    }
}

/// A received number; every one of them is far below the ends of `i32`.
fn small(raw: i64) -> i32 {
    crate::units::clamp_i32(raw)
}

fn battery_voltage(data: Payload) -> Result<BatteryVoltage, ReceiveError> {
    use layout::battery_voltage as at;
    let read = |field| read(at::HEADER.id, data, field);
    Ok(BatteryVoltage {
        cell: read(at::CELL)?.map(|raw| Microvolts(small(raw * 100))),
        pack: read(at::PACK)?.map(|raw| Millivolts(small(raw * 20))),
        cell_temperature: read(at::CELL_TEMPERATURE)?
            .map(|raw| MilliCelsius(small((raw - 40) * 1_000))),
    })
}

fn vehicle_state(data: Payload) -> Result<VehicleState, ReceiveError> {
    use layout::vehicle_state as at;
    let key = read(at::HEADER.id, data, at::KEY)?.map(|raw| match raw {
        0 => KeyState::Off,
        1 => KeyState::Acc,
        2 => KeyState::On,
        _ => KeyState::Start, // 3, for `read` has refused all others
    });
    let high_voltage = read(at::HEADER.id, data, at::HIGH_VOLTAGE)?.map(|raw| raw != 0);
    Ok(VehicleState { key, high_voltage })
}

/// The receiving side: the newest accepted content of each message, as long as it is fresh.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Receiver {
    battery: e2e::Receiver,
    vehicle: e2e::Receiver,
    battery_voltage: Option<(Instant, BatteryVoltage)>,
    vehicle_state: Option<(Instant, VehicleState)>,
    accepted: u32,
    refused: u32,
    lost: u32,
}

impl Receiver {
    /// The identifiers to let through, for the controller's filters.
    pub const IDS: [u16; 2] = [
        layout::battery_voltage::HEADER.id,
        layout::vehicle_state::HEADER.id,
    ];

    /// Takes a frame. Nothing but the counters changes when it is refused.
    ///
    /// # Errors
    /// As [`ReceiveError`]. An unknown identifier is not counted as refused: it was not meant for this board.
    pub fn on_frame(&mut self, now: Instant, frame: &Frame) -> Result<Received, ReceiveError> {
        let result = self.judge(now, frame);
        match result {
            Ok(_) => self.accepted = self.accepted.saturating_add(1),
            Err(ReceiveError::UnknownId(_)) => {}
            Err(_) => self.refused = self.refused.saturating_add(1),
        }
        result
    }

    fn judge(&mut self, now: Instant, frame: &Frame) -> Result<Received, ReceiveError> {
        const BATTERY: u16 = layout::battery_voltage::HEADER.id;
        const VEHICLE: u16 = layout::vehicle_state::HEADER.id;
        let id = frame.id;
        let (receiver, config) = match id {
            BATTERY => (&mut self.battery, &BATTERY_VOLTAGE),
            VEHICLE => (&mut self.vehicle, &VEHICLE_STATE),
            _ => return Err(ReceiveError::UnknownId(id)),
        };
        if frame.dlc != 8 {
            return Err(ReceiveError::Length { id, dlc: frame.dlc });
        }
        let lost = receiver
            .check(config, now, &frame.data)
            .map_err(|error| ReceiveError::EndToEnd { id, error })?;
        self.lost = self.lost.saturating_add(u32::from(lost));
        if id == BATTERY {
            let content = battery_voltage(frame.data)?;
            self.battery_voltage = Some((now, content));
            Ok(Received::BatteryVoltage(content))
        } else {
            let content = vehicle_state(frame.data)?;
            self.vehicle_state = Some((now, content));
            Ok(Received::VehicleState(content))
        }
    }

    /// The newest `BatteryVoltage` and when it came; `None` once it is older than its time-out.
    #[must_use]
    pub fn battery_voltage(&self, now: Instant) -> Option<(Instant, BatteryVoltage)> {
        self.battery_voltage
            .filter(|(at, _)| elapsed(*at, now) <= BATTERY_VOLTAGE.timeout)
    }

    /// The newest `VehicleState`; `None` once it is older than its time-out.
    #[must_use]
    pub fn vehicle_state(&self, now: Instant) -> Option<VehicleState> {
        self.vehicle_state
            .filter(|(at, _)| elapsed(*at, now) <= VEHICLE_STATE.timeout)
            .map(|(_, content)| content)
    }

    /// Frames accepted; stops at its end.
    #[must_use]
    pub const fn accepted(&self) -> u32 {
        self.accepted
    }

    /// Frames refused; stops at its end.
    #[must_use]
    pub const fn refused(&self) -> u32 {
        self.refused
    }

    /// Frames that were missing before an accepted one; stops at its end.
    #[must_use]
    pub const fn lost(&self) -> u32 {
        self.lost
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
