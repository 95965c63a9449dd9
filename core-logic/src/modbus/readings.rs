//! Everything that a client can read: one plain snapshot, and the table of input registers over it.

use super::register::{Kind, Layout, Row};
use crate::range::Range;
use crate::units::{Microamps, Microvolts, MilliCelsius, Millivolts, Nanocoulombs, Ppm};
use crate::validity::Validity;

/// Version of the register map: the upper byte counts incompatible changes, the lower one additions.
pub const MAP_VERSION: u16 = 0x0201;

/// The calibration under way.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[repr(u8)]
pub enum Activity {
    /// None.
    #[default]
    None = 0,
    /// The zero of a range is being taken (D2).
    ZeroDrift = 1,
    /// The factors by key state are being taken (D4).
    KeyCalibration = 2,
    /// A supply sweep is under way (D4).
    SupplyCalibration = 3,
}

/// How the last command ended.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[repr(u8)]
pub enum CommandState {
    /// No command since the start.
    #[default]
    None = 0,
    /// Under way.
    Running = 1,
    /// Carried out.
    Done = 2,
    /// Refused or given up; see the reason.
    Failed = 3,
}

macro_rules! readings {
    ($($(#[$doc:meta])* $name:ident: $kind:ty,)*) => {
        /// A snapshot of every quantity and counter, taken at one time and answered from as a whole.
        ///
        /// A value whose validity word is not 0 is the last one or a guess, never a replacement by 0.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
        pub struct Readings {
            $($(#[$doc])* pub $name: $kind,)*
        }
    };
}

readings! {
    /// Firmware version: major, minor, patch.
    firmware_version: [u16; 3],
    /// First 32 bits of the firmware's revision hash.
    revision: u32,
    /// The microcontroller's unique number.
    unique_id: [u32; 3],
    /// Time since the start in seconds.
    uptime_s: u32,
    /// Why the board started: bits as in the firmware's reset cause.
    reset_cause: u16,
    /// Resets since the retained memory was last lost.
    resets: u32,
    /// Of the last panic the CRC-32 of its file's name, of a fault the program counter; 0 without one.
    panic_hash: u32,
    /// Most stack ever used, in bytes.
    stack_high_water: u32,
    /// Longest time from a range edge to its charge snapshot, in microseconds.
    snapshot_latency_us: u32,

    /// The calibration under way.
    activity: Activity,
    /// Flash is being written or erased.
    storage_busy: bool,
    /// The configuration is being saved or restored, or will be.
    configuration_in_transfer: bool,
    /// The last command's register value.
    last_command: u16,
    /// How it ended.
    command_state: CommandState,
    /// Why it failed: the number of the reason in the module that refused.
    command_reason: u16,
    /// Share of the calibration under way that is done, in percent.
    activity_progress: u16,
    /// Points of the supply sweep taken at 0 A and at the test current.
    supply_points: [u16; 2],
    /// State of the key calibration, as its module numbers it.
    key_calibration_state: u16,
    /// Counts every change of the active configuration.
    configuration_generation: u32,
    /// CRC-32 of the active configuration.
    configuration_crc: u32,
    /// Whether flash holds the active configuration.
    configuration_saved: bool,

    /// Current of the last conversion, positive is discharge.
    current: Microamps,
    /// Current after the sliding average.
    current_average: Microamps,
    /// Mean current by the meter.
    meter_current: Microamps,
    /// Why the current is not valid.
    current_validity: Validity,
    /// Why the averaged current is not valid.
    average_validity: Validity,
    /// Why the meter's charge and mean current are not both valid.
    meter_validity: Validity,
    /// Counts the conversions, so that a repetition is visible.
    conversions: u32,
    /// Output of the selected sensor.
    sensor_voltage: Microvolts,
    /// The selected sensor.
    range: Range,
    /// Changes of the range.
    range_edges: u32,
    /// Pairs of changes that came too fast to be seen one by one.
    coalesced_edges: u32,
    /// Times that chatter was found.
    chatter: u32,

    /// Net charge, positive is discharge.
    charge: Nanocoulombs,
    /// Why it is not valid.
    charge_validity: Validity,
    /// Charge that flowed in.
    charge_in: Nanocoulombs,
    /// Charge that flowed out.
    charge_out: Nanocoulombs,
    /// Bound on what hand-overs and bridged gaps may have cost.
    charge_uncertainty: Nanocoulombs,
    /// Meter intervals whose split between the ranges was estimated.
    estimated_intervals: u32,
    /// Charge of the meter less the converter's integral over the last window.
    channel_difference: Nanocoulombs,
    /// What they may differ by.
    channel_bound: Nanocoulombs,

    /// State of charge.
    soc: Ppm,
    /// Its uncertainty, a half-width: the true value lies within plus or minus this.
    soc_uncertainty: Ppm,
    /// Why it is not valid.
    soc_validity: Validity,
    /// Charge left in the battery.
    remaining_charge: Nanocoulombs,
    /// Open-circuit re-anchorings.
    soc_anchors: u32,
    /// Cell voltage as received.
    cell_voltage: Millivolts,
    /// Pack voltage as received.
    pack_voltage: Millivolts,
    /// Why the cell voltage is not valid.
    cell_validity: Validity,

    /// Supply of the sensors.
    supply: Microvolts,
    /// Output of the open-sensor network.
    network_voltage: Microvolts,
    /// The microcontroller's own supply.
    mcu_supply: Millivolts,
    /// Temperature of the sensors.
    sensor_temperature: MilliCelsius,
    /// Temperature of the microcontroller.
    board_temperature: MilliCelsius,
    /// Why the supply is not valid.
    supply_validity: Validity,
    /// Why the sensor's temperature is not valid.
    temperature_validity: Validity,
    /// Key: 0 off, 1 accessory, 2 on, 3 start, 255 unknown.
    key_state: u16,
    /// High voltage is on by its feedback or as received.
    high_voltage_on: bool,
    /// High voltage is permitted.
    high_voltage_permit: bool,

    /// Diagnoses that are present, bit n is code n.
    diagnoses_active: u64,
    /// Diagnoses that are latched.
    diagnoses_latched: u64,
    /// The latest codes, newest first, 255 for none.
    last_codes: [u8; 8],

    /// Meter: reads that were repeated, checksum failures, resets, rejected differences, failed read-backs.
    meter_counters: [u32; 5],
    /// Converter: bus errors, bus recoveries, lost configurations, missed conversions, invalid samples.
    converter_counters: [u32; 5],
    /// CAN: frames sent, received, dropped, E2E failures, bus-off, error counters (transmit·256 + receive).
    can_counters: [u32; 6],
    /// RS485: as `modbus_rtu::Counters`, in its order.
    rs485_counters: [u32; 9],
    /// Flash: records written, sectors erased by *clear log*, failed writes and erases, refused records, log records lost.
    flash_counters: [u32; 5],
}

impl Readings {
    /// Whether high voltage is on or may be switched on at any moment.
    #[must_use]
    pub const fn high_voltage(&self) -> bool {
        self.high_voltage_on || self.high_voltage_permit
    }
}

/// A row of [`INPUTS`].
#[derive(Clone, Copy, Debug)]
pub struct Input {
    /// Where it lies.
    pub layout: Layout,
}

impl Input {
    /// The value of one of its elements.
    #[must_use]
    pub fn get(&self, readings: &Readings, element: usize) -> i64 {
        value(self.layout.address, readings, element)
    }
}

impl Row for Input {
    fn layout(&self) -> &Layout {
        &self.layout
    }
}

/// What the documentation says of a row. Kept apart from the table, so that the firmware carries no text.
#[derive(Clone, Copy, Debug)]
pub struct Text {
    /// Name.
    pub name: &'static str,
    /// Unit and scale.
    pub unit: &'static str,
    /// Meaning.
    pub meaning: &'static str,
}

macro_rules! inputs {
    ($($address:literal $kind:ident $count:literal $name:literal $unit:literal $meaning:literal
        |$r:pat_param, $i:pat_param| $value:expr;)*) => {
        /// Every input register, by address.
        pub static INPUTS: &[Input] = &[
            $(Input {
                layout: Layout { address: $address, kind: Kind::$kind, count: $count },
            },)*
        ];
        /// The value of an element of the row at `address`. One function for all rows: a function for each takes more flash.
        #[inline(never)]
        fn value(address: u16, readings: &Readings, element: usize) -> i64 {
            match (address, readings, element) {
                $(($address, $r, $i) => $value,)*
                _ => 0,
            }
        }
        /// What [`INPUTS`] mean, row by row.
        pub static INPUT_TEXTS: &[Text] = &[
            $(Text { name: $name, unit: $unit, meaning: $meaning },)*
        ];
    };
}

fn element<T: Copy + Into<i64>>(values: &[T], index: usize) -> i64 {
    values.get(index).map_or(0, |value| (*value).into())
}

/// Millicoulombs, rounded to nearest.
fn mc(charge: Nanocoulombs) -> i64 {
    crate::units::div_round(charge.get(), 1_000_000)
}

#[expect(clippy::cast_possible_wrap, reason = "the bits are wanted")]
const fn bits(set: u64) -> i64 {
    set as i64
}

fn validity(validity: Validity) -> i64 {
    i64::from(validity.bits())
}

inputs! {
    // Who is there.
    0x0000 U16 1 "map version" "" "major·256 + minor of this register map" |_, _| MAP_VERSION.into();
    0x0001 U16 3 "firmware version" "" "major, minor, patch" |r, i| element(&r.firmware_version, i);
    0x0004 U32 1 "revision" "" "first 32 bits of the firmware's revision hash" |r, _| r.revision.into();
    0x0006 U32 3 "unique number" "" "of the microcontroller" |r, i| element(&r.unique_id, i);
    0x000C U16 1 "configuration format" "" "version of the configuration record" |_, _| crate::configuration::VERSION.into();
    0x000D U16 1 "reset cause" "bits" "the weightiest: 1 power, 2 reset pin, 4 software, 8 independent watchdog, 16 window watchdog, 32 low power, 64 brown-out" |r, _| r.reset_cause.into();
    0x000E U32 1 "uptime" "s" "time since the start" |r, _| r.uptime_s.into();
    0x0010 U32 1 "resets" "" "resets since the retained memory was last lost" |r, _| r.resets.into();
    0x0012 U32 1 "panic" "" "of the last panic the CRC-32 of its file's name, of a fault the program counter; 0 without one" |r, _| r.panic_hash.into();
    0x0014 U32 1 "stack high water" "B" "most stack ever used" |r, _| r.stack_high_water.into();
    0x0016 U32 1 "snapshot latency" "µs" "longest time from a range edge to its charge snapshot" |r, _| r.snapshot_latency_us.into();

    // What it is doing.
    0x0020 U16 1 "calibration under way" "" "0 none, 1 zero drift, 2 key calibration, 3 supply calibration" |r, _| r.activity as i64;
    0x0021 U16 1 "progress" "%" "of the calibration under way" |r, _| r.activity_progress.into();
    0x0022 U16 1 "last command" "" "as it was written" |r, _| r.last_command.into();
    0x0023 U16 1 "command state" "" "0 none, 1 running, 2 done, 3 failed" |r, _| r.command_state as i64;
    0x0024 U16 1 "command reason" "" "why it failed: number of the reason in the module that refused" |r, _| r.command_reason.into();
    0x0025 U16 2 "supply points" "" "points of the supply sweep at 0 A and at the test current" |r, i| element(&r.supply_points, i);
    0x0027 U16 1 "key calibration state" "" "as `key_calibration` numbers its states" |r, _| r.key_calibration_state.into();
    0x0028 U32 1 "configuration generation" "" "changes of the active configuration since the start" |r, _| r.configuration_generation.into();
    0x002A U32 1 "configuration CRC" "" "CRC-32 of the active configuration" |r, _| r.configuration_crc.into();
    0x002C U16 1 "configuration saved" "" "1 when flash holds the active configuration" |r, _| r.configuration_saved.into();
    0x002D U16 1 "flash busy" "" "1 while a client's save, restore or clear log is under way" |r, _| r.storage_busy.into();

    // Current.
    0x0040 I32 1 "current" "mA" "of the last conversion, positive is discharge" |r, _| r.current.to_milliamps().into();
    0x0042 I32 1 "average current" "mA" "after the sliding average" |r, _| r.current_average.to_milliamps().into();
    0x0044 I32 1 "meter current" "mA" "mean by the meter" |r, _| r.meter_current.to_milliamps().into();
    0x0046 U16 1 "current validity" "bits" "causes, see below; 0 is valid" |r, _| validity(r.current_validity);
    0x0047 U16 1 "average validity" "bits" "of the averaged current" |r, _| validity(r.average_validity);
    0x0048 U16 1 "meter validity" "bits" "of the meter's charge and current: after a fault until its mean has nothing of it" |r, _| validity(r.meter_validity);
    0x0049 U16 1 "range" "" "0 small sensor, 1 large sensor" |r, _| r.range as i64;
    0x004A U32 1 "conversions" "" "counts the conversions, so that a repetition is visible" |r, _| r.conversions.into();
    0x004C I32 1 "sensor voltage" "µV" "output of the selected sensor" |r, _| r.sensor_voltage.get().into();
    0x004E U32 1 "range edges" "" "changes of the range" |r, _| r.range_edges.into();
    0x0050 U32 1 "coalesced edges" "" "pairs of changes too fast to be seen one by one" |r, _| r.coalesced_edges.into();
    0x0052 U32 1 "chatter" "" "times that chatter was found" |r, _| r.chatter.into();
    0x0054 I32 1 "current, fine" "µA" "as `current`, for calibrations" |r, _| r.current.get().into();
    0x0056 I32 1 "meter current, fine" "µA" "as `meter current`, for calibrations" |r, _| r.meter_current.get().into();

    // Charge.
    0x0060 I64 1 "charge" "mC" "net, positive is discharge (1 mC = 1 mA·s)" |r, _| mc(r.charge);
    0x0064 I64 1 "charge in" "mC" "charged since the start, by the sign of each reading; `charge` goes on over it" |r, _| mc(r.charge_in);
    0x0068 I64 1 "charge out" "mC" "discharged since the start, likewise: around 0 A both grow, as an offset and a count take turns" |r, _| mc(r.charge_out);
    0x006C I64 1 "charge uncertainty" "mC" "bound on what the last start, hand-overs and bridged gaps may have cost" |r, _| mc(r.charge_uncertainty);
    0x0070 I64 1 "channel difference" "mC" "meter less converter over the last slow window; 0 if that was undecided" |r, _| mc(r.channel_difference);
    0x0074 I64 1 "channel bound" "mC" "what they may differ by" |r, _| mc(r.channel_bound);
    0x0078 U32 1 "estimated intervals" "" "meter intervals whose split between the ranges was estimated" |r, _| r.estimated_intervals.into();
    0x007A U16 1 "charge validity" "bits" "of the charge alone, as on CAN" |r, _| validity(r.charge_validity);

    // State of charge.
    0x0080 I32 1 "state of charge" "ppm" "1,000,000 is full" |r, _| r.soc.get().into();
    0x0082 I32 1 "uncertainty" "ppm" "half-width of the state of charge: the true value lies within plus or minus this" |r, _| r.soc_uncertainty.get().into();
    0x0084 U16 1 "state of charge validity" "bits" "causes; 0 is valid" |r, _| validity(r.soc_validity);
    0x0085 U16 1 "cell voltage validity" "bits" "causes; 0 is valid; not available on CAN counts as stale" |r, _| validity(r.cell_validity);
    0x0086 I64 1 "remaining charge" "mC" "left in the battery" |r, _| mc(r.remaining_charge);
    0x008A U32 1 "anchorings" "" "re-anchorings on the open-circuit voltage" |r, _| r.soc_anchors.into();
    0x008C I32 1 "cell voltage" "mV" "as received on CAN" |r, _| r.cell_voltage.get().into();
    0x008E I32 1 "pack voltage" "mV" "as received on CAN; 0 if not available" |r, _| r.pack_voltage.get().into();

    // Surroundings.
    0x00A0 I32 1 "sensor supply" "µV" "" |r, _| r.supply.get().into();
    0x00A2 I32 1 "network voltage" "µV" "output of the open-sensor network" |r, _| r.network_voltage.get().into();
    0x00A4 I32 1 "controller supply" "mV" "" |r, _| r.mcu_supply.get().into();
    0x00A6 I32 1 "sensor temperature" "m°C" "of the ADE7753's die" |r, _| r.sensor_temperature.get().into();
    0x00A8 I32 1 "controller temperature" "m°C" "" |r, _| r.board_temperature.get().into();
    0x00AA U16 1 "supply validity" "bits" "causes; 0 is valid" |r, _| validity(r.supply_validity);
    0x00AB U16 1 "temperature validity" "bits" "of the sensor temperature" |r, _| validity(r.temperature_validity);
    0x00AC U16 1 "key" "" "0 off, 1 accessory, 2 on, 3 start, 255 unknown" |r, _| r.key_state.into();
    0x00AD U16 1 "high voltage" "" "1 on" |r, _| r.high_voltage_on.into();
    0x00AE U16 1 "high-voltage permit" "" "1 given" |r, _| r.high_voltage_permit.into();

    // Diagnosis.
    0x00C0 I64 1 "active diagnoses" "bits" "bit n is code n" |r, _| bits(r.diagnoses_active);
    0x00C4 I64 1 "latched diagnoses" "bits" "until they are cleared" |r, _| bits(r.diagnoses_latched);
    0x00C8 U16 8 "last codes" "" "newest first, 255 for none" |r, i| element(&r.last_codes, i);

    // Counters; each stops at its end.
    0x0100 U32 5 "meter counters" "" "reads repeated, checksum failures, resets, rejected differences, failed read-backs" |r, i| element(&r.meter_counters, i);
    0x0110 U32 5 "converter counters" "" "bus errors, bus recoveries, lost configurations, missed conversions, invalid samples" |r, i| element(&r.converter_counters, i);
    0x0120 U32 6 "CAN counters" "" "sent, received, dropped, E2E failures, bus-off, error counters (transmit·256 + receive)" |r, i| element(&r.can_counters, i);
    0x0130 U32 9 "RS485 counters" "" "messages, communication errors, exceptions, messages for this server, no responses, character overruns, busy, missed, character gaps" |r, i| element(&r.rs485_counters, i);
    0x0148 U32 5 "flash counters" "" "records written, sectors erased by *clear log* (not those the queues erase), failed writes and erases, refused records, log records lost" |r, i| element(&r.flash_counters, i);
}
