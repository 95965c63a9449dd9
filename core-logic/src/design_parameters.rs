//! Every number of the board, once, with its calculation or source.
//!
//! Sources: **D0** CN104237623A (dual-range Hall measurement), **D1** CN101308196A (current integral in an energy
//! meter), **D2** Application of Electronic Technique 2014 no. 7 (HAH1BV and ADS1100), **D3** the open-sensor utility
//! model, **D4** the Hall correction method by vehicle state and supply; the chips' data sheets by name.
//! A value marked *assumed* is commonly quoted or worked out and still waits for a bench.

use crate::units::{Microamps, Microvolts, MilliCelsius, Ppm};

// ---------------------------------------------------------------------------------------------- sensors: D0, D2, D4

/// Supply at which the Hall sensors' sensitivity and zero are rated (D0, D2, D4).
pub const SENSOR_NOMINAL_SUPPLY: Microvolts = Microvolts::from_millivolts(5_000);
/// Output at 0 A with the rated supply: half the supply (D0, D2).
pub const SENSOR_ZERO: Microvolts = Microvolts::from_millivolts(2_500);
/// Output swing from 0 A to the end of a dual-range sensor's range (D0): 4.75 V − 2.5 V.
pub const DUAL_RANGE_SWING: Microvolts = Microvolts::from_millivolts(2_250);
/// Ends of a dual-range sensor's output; beyond them it is saturated or broken (D0).
pub const DUAL_RANGE_OUTPUT_LOW: Microvolts = Microvolts::from_millivolts(250);
/// See [`DUAL_RANGE_OUTPUT_LOW`].
pub const DUAL_RANGE_OUTPUT_HIGH: Microvolts = Microvolts::from_millivolts(4_750);
/// Full scale of the small sensor (D0).
pub const SMALL_FULL_SCALE: Microamps = Microamps::from_amps(60);
/// Full scale of the large sensor (D0).
pub const LARGE_FULL_SCALE: Microamps = Microamps::from_amps(600);
/// Comparator threshold on the small sensor's output for positive current (D0).
pub const COMPARATOR_HIGH: Microvolts = Microvolts::from_millivolts(4_500);
/// Comparator threshold for negative current (D0).
pub const COMPARATOR_LOW: Microvolts = Microvolts::from_millivolts(500);
/// Current at which the comparators switch, both signs: (4.5 V − 2.5 V) · 60 A / 2.25 V = 53.33 A (D0).
pub const SWITCHING_CURRENT: Microamps = Microamps(53_333_333);

/// HAH1BV S/02: 4 mV per ampere, that is I = 250 · (V − 2.5 V) (D2).
pub const HAH1BV_MICROVOLTS_PER_AMP: i32 = 4_000;
/// HAH1BV S/02 range (D2).
pub const HAH1BV_FULL_SCALE: Microamps = Microamps::from_amps(500);
/// Ends of its output (D2): 2.5 V ± 500 A · 4 mV/A.
pub const HAH1BV_OUTPUT_LOW: Microvolts = Microvolts::from_millivolts(500);
/// See [`HAH1BV_OUTPUT_LOW`].
pub const HAH1BV_OUTPUT_HIGH: Microvolts = Microvolts::from_millivolts(4_500);

/// Supply within which a Hall sensor measures: Vc0 ± 10 % (D4 sweeps Vc0 ± u; faults list: 4.5 … 5.5 V).
pub const SENSOR_SUPPLY_LOW: Microvolts = Microvolts::from_millivolts(4_500);
/// See [`SENSOR_SUPPLY_LOW`].
pub const SENSOR_SUPPLY_HIGH: Microvolts = Microvolts::from_millivolts(5_500);

/// Full scale of D4's example sensor: 300 A.
pub const CLOSED_LOOP_FULL_SCALE: Microamps = Microamps::from_amps(300);
/// Turns ratio N of the closed-loop sensor (D4 leaves it open; 1:2000 is common for 300 A class 1, *assumed*).
pub const CLOSED_LOOP_TURNS: i32 = 2_000;
/// k1 of the closed-loop sensor as rated, fully ratiometric: 2 V / 300 A · N / 5 V = 2.667 Ω/V, in nΩ/V (N *assumed*;
/// D4's calibration replaces it).
pub const CLOSED_LOOP_K1_NANOOHM_PER_VOLT: i64 = 2_666_666_667;
/// k2 of the closed-loop sensor as rated: half the supply, in nV/V.
pub const CLOSED_LOOP_K2_NANOVOLT_PER_VOLT: i64 = 500_000_000;

// ---------------------------------------------------------------------------------------------- open-sensor network: D3

/// Hall output to the amplifier's + input (D3).
pub const R4_OHM: i64 = 120_000;
/// Reference to the same node (D3).
pub const R3_OHM: i64 = 27_000;
/// Feedback and ground resistors of the amplifier: gain 1 + R1/R2 = 1.225 (D3).
pub const R1_OHM: i64 = 2_700;
/// See [`R1_OHM`].
pub const R2_OHM: i64 = 12_000;
/// Added pull-down from the Hall side of R4 to the negative supply: R6 + R7 (D3).
pub const PULL_DOWN_OHM: i64 = 120_000 + 27_000;
/// Negative supply of the conditioning circuit (D3).
pub const NEGATIVE_SUPPLY: Microvolts = Microvolts::from_millivolts(-15_000);
/// Reference of the network, worked out from the outputs that D3 gives: Vadc = 0.225 · Vhall + 1.65 V.
pub const NETWORK_REFERENCE: Microvolts = Microvolts::from_millivolts(1_650);

/// Gain of the network, R3 / (R3 + R4) · (1 + R1/R2) = 0.225, as a reduced fraction.
pub const NETWORK_GAIN: (i64, i64) = {
    let numerator = R3_OHM * (R1_OHM + R2_OHM);
    let denominator = (R3_OHM + R4_OHM) * R2_OHM;
    let (mut a, mut b) = (numerator, denominator);
    while b != 0 {
        (a, b) = (b, a % b);
    }
    (numerator / a, denominator / a)
};
/// Sensitivity of the sensor before the network: ±4 V (D3) at ±500 A (*assumed*: D3 names no current), in nV/A.
pub const NETWORK_SENSOR_NANOVOLTS_PER_AMP: i32 = 8_000_000;
/// Full scale of the sensor before the network (*assumed*, see [`NETWORK_SENSOR_NANOVOLTS_PER_AMP`]).
pub const NETWORK_SENSOR_FULL_SCALE: Microamps = Microamps::from_amps(500);
/// Upper clamp of the ADC pin: diodes to 0 and 3.3 V (D3).
pub const NETWORK_CLAMP: Microvolts = Microvolts::from_millivolts(3_300);

// ---------------------------------------------------------------------------------------------- ADS1100: D2

/// The converter's supply is its reference (ADS1100 data sheet SBAS239; D2: 5 V).
pub const CONVERTER_NOMINAL_SUPPLY: Microvolts = Microvolts::from_millivolts(5_000);

/// Settling of the low-pass before the converter after a range edge: ten time constants of 0.5 ms (*assumed*: D1 and D2
/// leave the filter to the interference at hand).
pub const CONVERTER_SETTLING_US: u32 = 5_000;
/// Period at which ADC1 samples the open-sensor channel: with the current frame.
pub const ADC1_PERIOD_US: u32 = 10_000;
/// The current is stale after this many missed conversions (faults list, F11).
pub const STALE_AFTER_PERIODS: u8 = 3;
/// A saturated sensor stands at the end of its range and its code may be rounded inward: two codes at 12 bits,
/// 2 · 2.44 mV (*assumed* for noise as well).
pub const SATURATION_MARGIN: Microvolts = Microvolts::from_millivolts(5);
/// Fastest change of the battery current between two conversions that is believed at once: 312 A in 31.25 ms.
pub const MAX_AMPS_PER_SECOND: u32 = SLEW_LIMIT_AMPS_PER_SECOND;
/// Identical codes before a converter can be stuck: one second at 32 SPS (*assumed*).
pub const STUCK_COUNT: u16 = 32;
/// Movement of the meter's mean that a stuck small sensor contradicts: 2.5 coarsest converter steps (128 SPS: 65 mA)
/// plus the meter's own 2 · 0.34 A (one count in 20 ms), rounded up.
pub const STUCK_MOVEMENT_SMALL: Microamps = Microamps::from_amps(1);
/// The same for the large sensor: 2.5 · 651 mA + 2 · 3.4 A, rounded up.
pub const STUCK_MOVEMENT_LARGE: Microamps = Microamps::from_amps(10);

/// Sliding average: eight conversions, 250 ms at 32 SPS (D2 leaves the length settable; *assumed*).
pub const AVERAGE_LENGTH: u8 = 8;
/// Time without a valid reading after which an average is no longer of the present (*assumed*).
pub const AVERAGE_MAX_GAP_MS: u32 = 1_000;
/// Readings of a zero calibration: two seconds at 32 SPS.
pub const ZERO_SAMPLES: u16 = 64;
/// Largest zero drift of a small sensor, a single one included: 10 mV of electrical and 7.5 mV of magnetic offset and
/// 0.08 mV/K over 65 K are 22.7 mV, at the HAH1BV's 4 mV/A 5.7 A (HAH1BV family, *assumed*), rounded up.
pub const ZERO_LIMIT_SMALL: Microamps = Microamps::from_amps(6);
/// The same at the large sensor's 3.75 mV/A: 6.05 A, rounded up.
pub const ZERO_LIMIT_LARGE: Microamps = Microamps::from_amps(7);
/// Largest spread of the readings of a zero calibration: three codes of the HAH1BV at 32 SPS, 0.46 A (*assumed*).
pub const ZERO_SPREAD_SMALL: Microamps = Microamps::from_milliamps(500);
/// The same for the large sensor at 32 SPS: three codes of 163 mA, rounded up.
pub const ZERO_SPREAD_LARGE: Microamps = Microamps::from_milliamps(500);
/// Mean of the energy meter up to which no current flows. Both converters hang on one sensor, so its zero drift is in
/// the mean: the limit of the zero drift, and two counts in 20 ms (0.34 A each).
pub const ZERO_METER_MEAN_SMALL: Microamps = Microamps::from_milliamps(6_700);
/// The same for the large sensor: 7 A, and two counts of 3.35 A.
pub const ZERO_METER_MEAN_LARGE: Microamps = Microamps::from_milliamps(13_700);
/// Longest time for a zero calibration: 64 readings at 8 SPS are 8 s.
pub const ZERO_TIMEOUT_MS: u32 = 20_000;
/// Readings in succession that an open or railed sensor needs to be reported (faults list, F14: two samples).
pub const OPEN_SET_COUNT: u8 = 2;
/// Readings in succession, and their time, that a sensor needs to be believed again: a loose contact chatters
/// (*assumed*).
pub const OPEN_CLEAR_COUNT: u8 = 10;
/// See [`OPEN_CLEAR_COUNT`].
pub const OPEN_CLEAR_TIME_MS: u32 = 100;

// ---------------------------------------------------------------------------------------------- ADE7753: D1

/// Crystal of the meter (ADE7753 Rev C, specifications).
pub const METER_CLKIN_HZ: u64 = 3_579_545;
/// The energy accumulator adds once per four clocks (ADE7753 Rev C, energy calculation: T = 4/CLKIN).
pub const METER_CLOCKS_PER_ACCUMULATION: u64 = 4;
/// Hidden bits below AENERGY: 49-bit accumulator, upper 24 visible (ADE7753 Rev C, energy calculation).
pub const METER_HIDDEN_BITS: u32 = 49 - 24;
/// Multiplier output for DC full scale on both channels: the peak of p(t) for full-scale sinusoids, twice their
/// average 0xCCCCD (ADE7753 Rev C, active power calculation). A bench has to confirm the factor of two.
pub const METER_DC_FULL_SCALE_PRODUCT: u64 = 0x19_999A;
/// Full-scale input of either channel at gain 1 (ADE7753 Rev C, analog inputs).
pub const METER_FULL_SCALE_INPUT: Microvolts = Microvolts::from_millivolts(500);
/// The constant on channel 2 (D1).
pub const METER_CHANNEL_2: Microvolts = Microvolts::from_millivolts(100);
/// Board scaling from the ADG849's output to channel 1: ±2.25 V becomes ±0.5 V, that is 2/9 (contract of the board).
pub const CHANNEL_1_SCALE: (i64, i64) = (2, 9);

/// AENERGY counts per 2³² seconds at full scale on channel 1 and [`METER_CHANNEL_2`] on channel 2:
/// product · (V2 / 0.5 V) · CLKIN / 4 / 2²⁵ = 8,949 counts/s.
pub const METER_COUNTS_PER_SECOND_Q32: u64 = {
    let product = METER_DC_FULL_SCALE_PRODUCT as u128;
    let share = METER_CHANNEL_2.get().unsigned_abs() as u128;
    let of = METER_FULL_SCALE_INPUT.get().unsigned_abs() as u128;
    let rate_times_of = product * share * METER_CLKIN_HZ as u128;
    let per_second = (rate_times_of << 32) / (of * METER_CLOCKS_PER_ACCUMULATION as u128);
    #[expect(clippy::cast_possible_truncation, reason = "8,949 · 2³²")]
    {
        (per_second >> METER_HIDDEN_BITS) as u64
    }
};

/// No-load threshold: products below 0.001 % of the full-scale output are not counted (ADE7753 Rev C, features;
/// figure *assumed*). With channel 2 at a fifth of its scale that is 0.005 % of channel 1's: 3 mA of 60 A.
pub const METER_NO_LOAD: Ppm = Ppm(50);

// ---------------------------------------------------------------------------------------------- supply and key state: D4

/// D4's example: output at 0 A with key OFF.
pub const D4_EXAMPLE_OFF: Microvolts = Microvolts::from_millivolts(2_490);
/// D4's example: output at 0 A with key ACC.
pub const D4_EXAMPLE_ACC: Microvolts = Microvolts::from_millivolts(2_480);

// ---------------------------------------------------------------------------------------------- battery: SoC, OCV

/// Capacity of the battery in D4's sizing example: 240 Ah (D4).
pub const DEFAULT_CAPACITY_MAH: u32 = 240_000;
/// Share of charged charge that can be discharged again: lithium-ion cells lie between 99.5 and 99.99 % (*assumed*).
pub const DEFAULT_COULOMBIC_EFFICIENCY_PPM: i32 = 998_000;
/// A cell voltage this far beyond either end of the OCV table is no cell at rest: a broken wire or a wrong frame
/// (*assumed*).
pub const OCV_IMPLAUSIBLE_BEYOND: Microvolts = Microvolts::from_millivolts(500);

// ---------------------------------------------------------------------------------------------- timing

/// Range edge to charge snapshot, the worst case that the firmware guarantees.
pub const SNAPSHOT_DEADLINE_US: u64 = 100;
/// Period at which AENERGY is polled: far below the 469 s to half full at full scale.
pub const METER_POLL_MS: u64 = 20;
/// Current frame on CAN.
pub const CURRENT_FRAME_MS: u64 = 10;
/// Charge and state-of-charge frames on CAN.
pub const CHARGE_FRAME_MS: u64 = 100;
/// CAN bit rate.
pub const CAN_BITRATE: u32 = 500_000;
/// A received message without an accepted frame for this long is missing: five of its 100 ms periods.
pub const CAN_RECEIVE_TIMEOUT_MS: u64 = 500;
/// Frames of a received message that may be missing between two accepted ones; more is a wrong sequence.
pub const CAN_RECEIVE_MAX_LOST: u8 = 2;
/// RS485: 115,200 baud, 8E1, so eleven bits a character.
pub const RS485_BAUD: u32 = 115_200;
/// Silence that ends a Modbus RTU frame above 19,200 baud (MODBUS over Serial Line V1.02, 2.5.1.1).
pub const MODBUS_FRAME_SILENCE_US: u64 = 1_750;
/// Longest gap between two characters of a frame above 19,200 baud (MODBUS over Serial Line V1.02, 2.5.1.1).
pub const MODBUS_CHARACTER_GAP_US: u64 = 750;
/// One character, rounded up: 11 bits / 115,200 baud = 95.5 µs.
pub const MODBUS_CHARACTER_US: u64 = (11 * 1_000_000_u64).div_ceil(RS485_BAUD as u64);
/// SPI clock of the meter: APB2 84 MHz / 32, of the 10 MHz that the meter takes (ADE7753 Rev C, timing). The gaps
/// between bytes that it needs besides (t6 and t9, *assumed* 4 µs) are the driver's, at any clock.
pub const METER_SPI_HZ: u32 = 2_625_000;

// ---------------------------------------------------------------------------------------------- range flag: D0

/// Small sensor beyond the comparator threshold by this much while the flag is low is a contradiction: 5 % of its
/// range for sensor and comparator together (*assumed*).
pub const FLAG_MARGIN_ABOVE: Microamps = Microamps::from_amps(3);
/// Large sensor below the switching current by this much while the flag is high is one: 1 % of its range, a class 1
/// sensor (D4), and 2 A of comparator hysteresis (*assumed*).
pub const FLAG_MARGIN_BELOW: Microamps = Microamps::from_amps(8);
/// Two readings of the small sensor by different converters agree within this (*assumed*: 5 % of its range).
pub const FLAG_MATCH_TOLERANCE: Microamps = Microamps::from_amps(3);
/// Time for which flag and level must contradict each other, three conversions of 31 ms; with the one that an edge falls
/// into and the first one after it below 200 ms.
pub const FLAG_DEBOUNCE_MS: u32 = 90;

// ---------------------------------------------------------------------------------------------- charge at an edge

/// How far the current at a range edge may lie from [`SWITCHING_CURRENT`]: threshold tolerance, hysteresis and the
/// small sensor's own error (*assumed*: 1 A, that is 37.5 mV at the comparator).
pub const SWITCHING_TOLERANCE: Microamps = Microamps::from_amps(1);
/// Fastest change of the current that the estimates at an edge allow for (*assumed*: 10 kA/s, full scale in 60 ms).
pub const SLEW_LIMIT_AMPS_PER_SECOND: u32 = 10_000;
/// Longest delay of the edge's time stamp: the edge handler's deadline.
pub const EDGE_STAMP_DELAY_US: u64 = 5;
/// Intervals with chatter up to this length are put together. At the slew limit that is worth doubting 10 A of the mean
/// current at worst, as much as the 30 mC that the hidden bits of the accumulator cost at each edge less often than that.
pub const SHORT_INTERVAL_US: u32 = 4_000;
/// Error of the converter's current where it stands in for the meter: 1 % of the reading, the result of D2 …
pub const BRIDGE_GAIN: Ppm = Ppm(10_000);
/// … and 1 A beside it: six codes of 153 mA at 32 SPS on the coarsest sensor (D2).
pub const BRIDGE_OFFSET: Microamps = Microamps::from_amps(1);

// ---------------------------------------------------------------------------------------------- surroundings

/// Lowest temperature of the sensors and the board (HAH1BV family: −40 … 125 °C; STM32F405: −40 … 105 °C).
pub const TEMPERATURE_LOW: MilliCelsius = MilliCelsius(-40_000);
/// Highest: the microcontroller's.
pub const TEMPERATURE_HIGH: MilliCelsius = MilliCelsius(105_000);

// ---------------------------------------------------------------------------------------------- wear of the flash

/// Sector of the flash, which is erased whole (W25Q32JV data sheet).
pub const FLASH_SECTOR_BYTES: i64 = 4_096;
/// Erasures that a sector takes (W25Q32JV data sheet, features: more than 100,000 erase/program cycles).
pub const FLASH_ENDURANCE: i64 = 100_000;
/// Ring of sectors that the states are written to.
pub const STATE_FLASH_BYTES: i64 = 64 * 1_024;
/// What the queue adds to a record: lengths and two CRCs (sequential-storage, `ItemHeader`), …
pub const FLASH_RECORD_HEADER_BYTES: i64 = 8;
/// … and to a sector: a mark at its begin and one at its end.
pub const FLASH_SECTOR_MARK_BYTES: i64 = 2;
/// Charge that a vehicle moves in its life, both ways, in C: 300,000 km at 0.2 kWh/km are 60 MWh, at D4's 384 V 156 Ah a thousand times,
/// 563 MC; drawn, charged again, and a quarter of it recuperated and drawn anew: 2.5 times as much (*assumed* but for the voltage).
pub const VEHICLE_LIFE_COULOMBS: i64 = 1_406_250_000;
/// Time that it is switched on or charges in its life: 15 years of nine hours a day (*assumed*).
pub const VEHICLE_LIFE_S: i64 = 15 * 365 * 9 * 3_600;

// ---------------------------------------------------------------------------------------------- error budget

/// HAH1BV S/02, share of the reading (D2); *assumed* for the D0 pair.
pub const SENSOR_ACCURACY: Ppm = Ppm(5_000);
/// Drift of the sensor's sensitivity, 0.03 %/K (*assumed*: typical of the HAH1BV family).
pub const SENSOR_PPM_PER_KELVIN: i64 = 300;
/// Drift of its zero (*assumed*: typical of the HAH1BV family).
pub const SENSOR_ZERO_MICROVOLTS_PER_KELVIN: i64 = 80;
/// From a calibration at 25 °C to the board's end at 85 °C.
pub const TEMPERATURE_SPAN_KELVIN: i64 = 60;
/// What a measured sensor supply leaves of the supply's error (*assumed*: ADC1 against its internal reference).
pub const SUPPLY_RESIDUAL: Ppm = Ppm(1_000);
/// MAX6173 (D1).
pub const REFERENCE: Microvolts = Microvolts::from_millivolts(2_500);
/// MAX6173: 0.06 % (D1).
pub const REFERENCE_TOLERANCE: Ppm = Ppm(600);
/// MAX6173: 3 ppm/°C (D1).
pub const REFERENCE_PPM_PER_KELVIN: i64 = 3;
/// Resistors of the divider for channel 2: 0.1 % (D1).
pub const DIVIDER_TOLERANCE: Ppm = Ppm(1_000);
/// The same: 10 ppm/°C (D1).
pub const DIVIDER_PPM_PER_KELVIN: i64 = 10;
/// Crystal of the meter, tolerance and drift (*assumed*).
pub const CRYSTAL_TOLERANCE: Ppm = Ppm(100);
/// Zero of the meter's channel 1 after calibration, of its full scale (*assumed*).
pub const METER_ZERO_RESIDUAL: Ppm = Ppm(1_000);
/// Gain error of the converter and of the scaling in front of the meter (*assumed*: 0.1 % and 2 · 0.1 % resistors).
pub const CONVERTER_GAIN_TOLERANCE: Ppm = Ppm(3_000);

#[cfg(test)]
#[allow(clippy::cast_precision_loss)]
mod tests {
    use super::*;

    #[test]
    fn the_meter_counts_8949_a_second_at_full_scale() {
        let per_second = METER_COUNTS_PER_SECOND_Q32 as f64 / 2f64.powi(32);
        // 1,677,722 · (0.1/0.5) · 894,886.25 Hz / 2^25
        let expected = 1_677_722.0 * 0.2 * (3_579_545.0 / 4.0) / 33_554_432.0;
        assert!(
            (per_second - expected).abs() < 1e-6,
            "{per_second} {expected}"
        );
        assert!((per_second - 8_949.0).abs() < 0.5);
        // So one count is 6.70 mC of the small range and 67.0 mC of the large one.
        assert!((60.0 / per_second - 6.70e-3).abs() < 0.01e-3);
        assert!((600.0 / per_second - 67.0e-3).abs() < 0.1e-3);
    }

    #[test]
    fn a_vehicle_s_life_is_what_its_energy_makes() {
        let coulombs = 300_000.0 * 200.0 * 3_600.0 / 384.0 * 2.5;
        assert!((VEHICLE_LIFE_COULOMBS as f64 - coulombs).abs() < 1.0);
    }

    #[test]
    fn the_comparators_switch_where_the_document_says() {
        let swing = f64::from((COMPARATOR_HIGH.get()) - SENSOR_ZERO.get());
        let amps = swing * 60.0 / f64::from(DUAL_RANGE_SWING.get());
        assert!((amps - f64::from(SWITCHING_CURRENT.get()) * 1e-6).abs() < 1e-6);
        assert_eq!(
            SENSOR_ZERO.get() - COMPARATOR_LOW.get(),
            COMPARATOR_HIGH.get() - SENSOR_ZERO.get()
        );
    }

    #[test]
    fn channel_1_is_full_scale_at_the_end_of_either_range() {
        let (numerator, denominator) = CHANNEL_1_SCALE;
        assert_eq!(
            i64::from(DUAL_RANGE_SWING.get()) * numerator / denominator,
            i64::from(METER_FULL_SCALE_INPUT.get())
        );
    }
}
