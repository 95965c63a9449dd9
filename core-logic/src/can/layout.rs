//! Where each signal of `can/board.dbc` lies, what it may hold and how it scales. A host test compares every number
//! here with the DBC.

use crate::e2e::{DataId, Payload};

/// Who sends a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    /// This board.
    Transmitted,
    /// The vehicle or the battery management.
    Received,
}

/// A message's place on the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    /// 11-bit identifier.
    pub id: u16,
    /// Who sends it.
    pub direction: Direction,
    /// Period.
    pub cycle_ms: u16,
    /// Offset of its first sending, so that the slower messages do not all fall into one tick.
    pub phase_ms: u16,
    /// Data ID, when the message is protected.
    pub data_id: Option<DataId>,
}

impl Header {
    /// Whether the message is to be sent in the tick that begins `now_ms` after the start, with ticks of `tick_ms`.
    #[must_use]
    pub const fn is_due(&self, now_ms: u64, tick_ms: u64) -> bool {
        let phase = self.phase_ms as u64;
        let cycle = self.cycle_ms as u64;
        match now_ms.checked_sub(phase) {
            Some(since) => cycle != 0 && since % cycle < tick_ms,
            None => false,
        }
    }
}

/// A signal's bits (Intel order) and the raw numbers it may hold.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Field {
    /// Lowest bit, counted from bit 0 of byte 0.
    pub start: u8,
    /// Number of bits, 1 … 63.
    pub length: u8,
    /// Two's complement.
    pub signed: bool,
    /// One raw number says "not available": [`Field::not_available`].
    pub has_not_available: bool,
    /// Greatest raw number with a meaning.
    pub maximum: i64,
}

/// What follows from the rest is worked out: each signal's `Field` is in the image.
impl Field {
    /// Least raw number with a meaning: the greatest one's negative, or 0.
    #[must_use]
    pub const fn minimum(self) -> i64 {
        if self.signed { -self.maximum } else { 0 }
    }

    /// Raw number that says "not available": the least that a signed signal can hold, the greatest of an unsigned one.
    #[must_use]
    pub const fn not_available(self) -> Option<i64> {
        let raw = if self.signed {
            -(1 << (self.length - 1))
        } else {
            self.mask().cast_signed()
        };
        if self.has_not_available {
            Some(raw)
        } else {
            None
        }
    }

    const fn mask(self) -> u64 {
        (1 << self.length) - 1
    }

    /// `word` (a payload in Intel order) with this signal set to the low bits of `raw`.
    #[must_use]
    pub const fn put(self, word: u64, raw: i64) -> u64 {
        let mask = self.mask();
        (word & !(mask << self.start)) | ((raw.cast_unsigned() & mask) << self.start)
    }

    /// The raw number in `word`.
    #[must_use]
    pub const fn get(self, word: u64) -> i64 {
        let bits = (word >> self.start) & self.mask();
        if self.signed {
            let unused = u64::BITS - self.length as u32;
            (bits << unused).cast_signed() >> unused
        } else {
            bits.cast_signed()
        }
    }

    /// The nearest raw number with a meaning.
    #[must_use]
    pub const fn clamp(self, raw: i64) -> i64 {
        if raw < self.minimum() {
            self.minimum()
        } else if raw > self.maximum {
            self.maximum
        } else {
            raw
        }
    }

    /// Whether the raw number has a meaning, "not available" apart.
    #[must_use]
    pub const fn holds(self, raw: i64) -> bool {
        raw >= self.minimum() && raw <= self.maximum
    }
}

/// physical = raw · numerator / denominator + offset.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Scale {
    /// See [`Scale`].
    pub numerator: i64,
    /// See [`Scale`].
    pub denominator: i64,
    /// See [`Scale`].
    pub offset: i64,
}

/// A signal with its name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Signal {
    /// As in the DBC.
    pub name: &'static str,
    /// Its bits.
    pub field: Field,
    /// Its scale.
    pub scale: Scale,
    /// The page that carries it, in a multiplexed message.
    pub page: Option<u8>,
}

/// A message with its signals.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Message {
    /// As in the DBC.
    pub name: &'static str,
    /// Its place on the bus.
    pub header: Header,
    /// Its signals.
    pub signals: &'static [Signal],
    /// Set for the two messages with one bit per diagnosis code: the signals are this prefix and the code's name.
    pub prefix_of_codes: Option<&'static str>,
}

/// A payload as one number in Intel order.
#[must_use]
pub const fn word(payload: Payload) -> u64 {
    u64::from_le_bytes(payload)
}

macro_rules! optional {
    () => {
        None
    };
    ($value:expr) => {
        Some($value)
    };
}

macro_rules! is_signed {
    (signed) => {
        true
    };
    (unsigned) => {
        false
    };
}

const fn is_stated(not_available: Option<i64>) -> bool {
    not_available.is_some()
}

/// The numbers of the table below, as the DBC has them, are those that [`Field`] works out.
const fn check(field: Field, minimum: i64, not_available: Option<i64>) {
    assert!(field.minimum() == minimum);
    if let (Some(stated), Some(follows)) = (not_available, field.not_available()) {
        assert!(stated == follows);
    }
}

macro_rules! messages {
    ($($(#[$doc:meta])* $module:ident $name:literal = $id:literal, $direction:ident, $cycle:literal ms + $phase:literal ms
        $(, data id $data_id:literal)? $(, codes $prefix:literal)? {
        $($field:ident $signal:literal = $sign:ident $start:literal | $length:literal, $minimum:literal ..= $maximum:literal
            $(, not available $sna:literal)?, $numerator:literal / $denominator:literal $(+ $offset:literal)?
            $(, page $page:literal)?;)*
    })*) => {
        $(
            $(#[$doc])*
            pub mod $module {
                use super::*;
                $(
                    /// Data ID of the end-to-end protection.
                    pub const DATA_ID: DataId = DataId::new($data_id);
                )?
                /// Place on the bus.
                pub const HEADER: Header = Header {
                    id: $id,
                    direction: Direction::$direction,
                    cycle_ms: $cycle,
                    phase_ms: $phase,
                    data_id: optional!($(DataId::new($data_id))?),
                };
                $(
                    #[doc = concat!("Signal `", $signal, "`.")]
                    pub const $field: Field = Field {
                        start: $start,
                        length: $length,
                        signed: is_signed!($sign),
                        has_not_available: is_stated(optional!($($sna)?)),
                        maximum: $maximum,
                    };
                    const _: () = check($field, $minimum, optional!($($sna)?));
                )*
                /// With names and scales.
                pub const MESSAGE: Message = Message {
                    name: $name,
                    header: HEADER,
                    signals: &[$(
                        Signal {
                            name: $signal,
                            field: $field,
                            scale: Scale { numerator: $numerator, denominator: $denominator, offset: 0 $(+ $offset)? },
                            page: optional!($($page)?),
                        },
                    )*],
                    prefix_of_codes: optional!($($prefix)?),
                };
            }
        )*

        /// Every message, lowest identifier first.
        pub const MESSAGES: [Message; [$($id,)*].len()] = [$($module::MESSAGE,)*];
    };
}

messages! {
    /// Current of the last conversion.
    current "Current" = 0x101, Transmitted, 10 ms + 0 ms, data id 0x101 {
        CRC "CurrentCrc" = unsigned 0 | 8, 0 ..= 255, 1 / 1;
        COUNTER "CurrentCounter" = unsigned 8 | 4, 0 ..= 14, 1 / 1;
        ID_NIBBLE "CurrentIdNibble" = unsigned 12 | 4, 0 ..= 15, 1 / 1;
        VALIDITY "CurrentValidity" = unsigned 16 | 8, 0 ..= 255, 1 / 1;
        CONVERSIONS "CurrentConversions" = unsigned 24 | 8, 0 ..= 255, 1 / 1;
        VALUE "Current" = signed 32 | 21, -1_048_575 ..= 1_048_575, not available -1_048_576, 1 / 1000;
        RANGE "CurrentRange" = unsigned 53 | 1, 0 ..= 1, 1 / 1;
        AGE "CurrentAge" = unsigned 54 | 10, 0 ..= 1_022, not available 1_023, 1 / 1;
    }
    /// Sliding average of the current.
    current_average "CurrentAverage" = 0x102, Transmitted, 10 ms + 0 ms, data id 0x102 {
        CRC "CurrentAverageCrc" = unsigned 0 | 8, 0 ..= 255, 1 / 1;
        COUNTER "CurrentAverageCounter" = unsigned 8 | 4, 0 ..= 14, 1 / 1;
        ID_NIBBLE "CurrentAverageIdNibble" = unsigned 12 | 4, 0 ..= 15, 1 / 1;
        VALIDITY "CurrentAverageValidity" = unsigned 16 | 8, 0 ..= 255, 1 / 1;
        VALUE "CurrentAverage" = signed 24 | 21, -1_048_575 ..= 1_048_575, not available -1_048_576, 1 / 1000;
        SAMPLES "CurrentAverageSamples" = unsigned 45 | 7, 0 ..= 127, 1 / 1;
        SPAN "CurrentAverageSpan" = unsigned 52 | 12, 0 ..= 4_095, 2 / 1;
    }
    /// Net charge.
    charge "Charge" = 0x110, Transmitted, 100 ms + 0 ms, data id 0x110 {
        CRC "ChargeCrc" = unsigned 0 | 8, 0 ..= 255, 1 / 1;
        COUNTER "ChargeCounter" = unsigned 8 | 4, 0 ..= 14, 1 / 1;
        ID_NIBBLE "ChargeIdNibble" = unsigned 12 | 4, 0 ..= 15, 1 / 1;
        VALIDITY "ChargeValidity" = unsigned 16 | 8, 0 ..= 255, 1 / 1;
        VALUE "Charge" = signed 24 | 39, -274_877_906_943 ..= 274_877_906_943, not available -274_877_906_944, 1 / 1000;
        ESTIMATED "ChargeEstimated" = unsigned 63 | 1, 0 ..= 1, 1 / 1;
    }
    /// Mean current by the meter.
    meter_current "MeterCurrent" = 0x111, Transmitted, 100 ms + 10 ms, data id 0x111 {
        CRC "MeterCurrentCrc" = unsigned 0 | 8, 0 ..= 255, 1 / 1;
        COUNTER "MeterCurrentCounter" = unsigned 8 | 4, 0 ..= 14, 1 / 1;
        ID_NIBBLE "MeterCurrentIdNibble" = unsigned 12 | 4, 0 ..= 15, 1 / 1;
        VALIDITY "MeterCurrentValidity" = unsigned 16 | 8, 0 ..= 255, 1 / 1;
        VALUE "MeterCurrent" = signed 24 | 21, -1_048_575 ..= 1_048_575, not available -1_048_576, 1 / 1000;
        BELOW_NO_LOAD "MeterBelowNoLoad" = unsigned 45 | 1, 0 ..= 1, 1 / 1;
        UNCERTAINTY "ChargeUncertainty" = unsigned 46 | 18, 0 ..= 262_142, not available 262_143, 1 / 100;
    }
    /// State of charge.
    state_of_charge "StateOfCharge" = 0x112, Transmitted, 100 ms + 20 ms, data id 0x112 {
        CRC "StateOfChargeCrc" = unsigned 0 | 8, 0 ..= 255, 1 / 1;
        COUNTER "StateOfChargeCounter" = unsigned 8 | 4, 0 ..= 14, 1 / 1;
        ID_NIBBLE "StateOfChargeIdNibble" = unsigned 12 | 4, 0 ..= 15, 1 / 1;
        VALIDITY "StateOfChargeValidity" = unsigned 16 | 8, 0 ..= 255, 1 / 1;
        VALUE "StateOfCharge" = unsigned 24 | 14, 0 ..= 10_000, not available 16_383, 1 / 100;
        UNCERTAINTY "StateOfChargeUncertainty" = unsigned 38 | 10, 0 ..= 1_000, not available 1_023, 1 / 10;
        REMAINING "RemainingCharge" = unsigned 48 | 16, 0 ..= 65_534, not available 65_535, 1 / 10;
    }
    /// Charge throughput.
    throughput "Throughput" = 0x121, Transmitted, 1000 ms + 90 ms {
        DISCHARGED "ChargeDischarged" = unsigned 0 | 32, 0 ..= 4_294_967_295, 1 / 1;
        CHARGED "ChargeCharged" = unsigned 32 | 32, 0 ..= 4_294_967_295, 1 / 1;
    }
    /// Supply and temperatures.
    environment "Environment" = 0x130, Transmitted, 100 ms + 30 ms {
        SUPPLY "SensorSupply" = unsigned 0 | 14, 0 ..= 16_382, not available 16_383, 1 / 1;
        SUPPLY_VALIDITY "SensorSupplyValidity" = unsigned 16 | 8, 0 ..= 255, 1 / 1;
        SENSOR_TEMPERATURE "SensorTemperature" = signed 24 | 12, -2_047 ..= 2_047, not available -2_048, 1 / 10;
        SENSOR_TEMPERATURE_VALIDITY "SensorTemperatureValidity" = unsigned 36 | 8, 0 ..= 255, 1 / 1;
        BOARD_TEMPERATURE "BoardTemperature" = signed 44 | 12, -2_047 ..= 2_047, not available -2_048, 1 / 10;
        BOARD_TEMPERATURE_VALIDITY "BoardTemperatureValidity" = unsigned 56 | 8, 0 ..= 255, 1 / 1;
    }
    /// Key and high-voltage state, range, counters.
    board_state "BoardState" = 0x131, Transmitted, 100 ms + 40 ms {
        KEY "KeyState" = unsigned 0 | 3, 0 ..= 3, not available 7, 1 / 1;
        HIGH_VOLTAGE "HighVoltage" = unsigned 3 | 2, 0 ..= 1, not available 3, 1 / 1;
        PERMIT "HighVoltagePermit" = unsigned 5 | 1, 0 ..= 1, 1 / 1;
        KEY_CALIBRATION "KeyCalibration" = unsigned 6 | 3, 0 ..= 5, not available 7, 1 / 1;
        RANGE "Range" = unsigned 9 | 1, 0 ..= 1, 1 / 1;
        CELL_VOLTAGE_FRESH "CellVoltageFresh" = unsigned 10 | 1, 0 ..= 1, 1 / 1;
        VEHICLE_STATE_FRESH "VehicleStateFresh" = unsigned 11 | 1, 0 ..= 1, 1 / 1;
        EDGES "RangeEdges" = unsigned 16 | 16, 0 ..= 65_535, 1 / 1;
        COALESCED "CoalescedEdges" = unsigned 32 | 8, 0 ..= 255, 1 / 1;
        ESTIMATED_INTERVALS "EstimatedIntervals" = unsigned 40 | 8, 0 ..= 255, 1 / 1;
        BUS_OFFS "BusOffs" = unsigned 48 | 8, 0 ..= 255, 1 / 1;
        REFUSED "RefusedFrames" = unsigned 56 | 8, 0 ..= 255, 1 / 1;
    }
    /// Active diagnoses.
    diagnosis_active "DiagnosisActive" = 0x140, Transmitted, 100 ms + 50 ms, codes "Active" {
    }
    /// Latched diagnoses.
    diagnosis_latched "DiagnosisLatched" = 0x141, Transmitted, 100 ms + 60 ms, codes "Latched" {
    }
    /// One reported diagnosis.
    diagnosis_detail "DiagnosisDetail" = 0x142, Transmitted, 100 ms + 70 ms {
        CODE "DiagnosisCode" = unsigned 0 | 8, 0 ..= 254, not available 255, 1 / 1;
        SEVERITY "DiagnosisSeverity" = unsigned 8 | 2, 0 ..= 3, 1 / 1;
        ACTIVE "DiagnosisIsActive" = unsigned 10 | 1, 0 ..= 1, 1 / 1;
        LATCHED "DiagnosisIsLatched" = unsigned 11 | 1, 0 ..= 1, 1 / 1;
        REPORTED "DiagnosisReported" = unsigned 16 | 8, 0 ..= 255, 1 / 1;
        OCCURRENCES "DiagnosisOccurrences" = unsigned 24 | 16, 0 ..= 65_535, 1 / 1;
        FIRST_SEEN "DiagnosisFirstSeen" = unsigned 40 | 24, 0 ..= 16_777_214, not available 16_777_215, 1 / 1;
    }
    /// Identity pages.
    identity "Identity" = 0x150, Transmitted, 200 ms + 80 ms {
        PAGE "IdentityPage" = unsigned 0 | 8, 0 ..= 5, 1 / 1;
        PROTOCOL "ProtocolVersion" = unsigned 8 | 8, 0 ..= 255, 1 / 1, page 0;
        MAJOR "FirmwareMajor" = unsigned 16 | 8, 0 ..= 255, 1 / 1, page 0;
        MINOR "FirmwareMinor" = unsigned 24 | 8, 0 ..= 255, 1 / 1, page 0;
        PATCH "FirmwarePatch" = unsigned 32 | 8, 0 ..= 255, 1 / 1, page 0;
        RESET_CAUSE "ResetCause" = unsigned 40 | 8, 0 ..= 7, 1 / 1, page 0;
        BOOTS "BootCount" = unsigned 48 | 16, 0 ..= 65_535, 1 / 1, page 0;
        COMMIT "BuildCommit" = unsigned 8 | 32, 0 ..= 4_294_967_295, 1 / 1, page 1;
        MODIFIED "BuildModified" = unsigned 40 | 1, 0 ..= 1, 1 / 1, page 1;
        CONFIGURATION_CRC "ConfigurationCrc" = unsigned 48 | 16, 0 ..= 65_535, 1 / 1, page 1;
        PANIC_HASH "PanicHash" = unsigned 8 | 32, 0 ..= 4_294_967_295, 1 / 1, page 2;
        PANIC_LINE "PanicLine" = unsigned 40 | 16, 0 ..= 65_535, 1 / 1, page 2;
        LATE_TASKS "LateTasks" = unsigned 56 | 8, 0 ..= 255, 1 / 1, page 2;
        UID_LOW "UniqueIdLow" = unsigned 8 | 48, 0 ..= 281_474_976_710_655, 1 / 1, page 3;
        UID_HIGH "UniqueIdHigh" = unsigned 8 | 48, 0 ..= 281_474_976_710_655, 1 / 1, page 4;
        UPTIME "Uptime" = unsigned 8 | 32, 0 ..= 4_294_967_295, 1 / 1, page 5;
        STACK_FREE "StackFree" = unsigned 40 | 16, 0 ..= 65_535, 1 / 1, page 5;
        LOG_FILL "LogFill" = unsigned 56 | 8, 0 ..= 200, not available 255, 1 / 2, page 5;
    }
    /// Received: voltages of the battery.
    battery_voltage "BatteryVoltage" = 0x201, Received, 100 ms + 0 ms, data id 0x201 {
        CRC "BatteryVoltageCrc" = unsigned 0 | 8, 0 ..= 255, 1 / 1;
        COUNTER "BatteryVoltageCounter" = unsigned 8 | 4, 0 ..= 14, 1 / 1;
        ID_NIBBLE "BatteryVoltageIdNibble" = unsigned 12 | 4, 0 ..= 15, 1 / 1;
        CELL "CellVoltage" = unsigned 16 | 16, 0 ..= 65_000, not available 65_535, 1 / 10000;
        PACK "PackVoltage" = unsigned 32 | 16, 0 ..= 65_000, not available 65_535, 1 / 50;
        CELL_TEMPERATURE "CellTemperature" = unsigned 48 | 8, 0 ..= 250, not available 255, 1 / 1 + -40;
    }
    /// Received: state of the vehicle.
    vehicle_state "VehicleState" = 0x202, Received, 100 ms + 0 ms, data id 0x202 {
        CRC "VehicleStateCrc" = unsigned 0 | 8, 0 ..= 255, 1 / 1;
        COUNTER "VehicleStateCounter" = unsigned 8 | 4, 0 ..= 14, 1 / 1;
        ID_NIBBLE "VehicleStateIdNibble" = unsigned 12 | 4, 0 ..= 15, 1 / 1;
        KEY "VehicleKeyState" = unsigned 16 | 3, 0 ..= 3, not available 7, 1 / 1;
        HIGH_VOLTAGE "VehicleHighVoltage" = unsigned 19 | 2, 0 ..= 1, not available 3, 1 / 1;
    }
}
