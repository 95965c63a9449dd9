//! Every number of the board, once, with its calculation or source.
//!
//! Sources: **D0** CN104237623A (dual-range Hall measurement), **D1** CN101308196A (current integral in an energy
//! meter), **D2** Application of Electronic Technique 2014 no. 7 (HAH1BV and ADS1100), **D3** the open-sensor utility
//! model, **D4** the Hall correction method by vehicle state and supply; the chips' data sheets by name.
//! A value marked *assumed* is commonly quoted or worked out and still waits for a bench.

use crate::units::{Microamps, Microvolts};

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

// ---------------------------------------------------------------------------------------------- ADS1100: D2

/// The converter's supply is its reference (ADS1100 data sheet SBAS239; D2: 5 V).
pub const CONVERTER_NOMINAL_SUPPLY: Microvolts = Microvolts::from_millivolts(5_000);

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
    let share = METER_CHANNEL_2.get() as u128;
    let of = METER_FULL_SCALE_INPUT.get() as u128;
    let accumulations_times_4 = METER_CLKIN_HZ as u128;
    ((product * share * accumulations_times_4 << 32)
        / (of * METER_CLOCKS_PER_ACCUMULATION as u128)
        >> METER_HIDDEN_BITS) as u64
};

/// No-load threshold: products below 0.001 % of the full-scale output are not counted (ADE7753 Rev C, features;
/// figure *assumed*). With channel 2 at a fifth of its scale that is 0.005 % of channel 1's: 3 mA of 60 A.
pub const METER_NO_LOAD_PPM_OF_CHANNEL_1: i64 = 50;

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
/// RS485: 115,200 baud, 8E1, so eleven bits a character.
pub const RS485_BAUD: u32 = 115_200;
/// SPI clock of the meter: APB2 84 MHz / 64; the meter takes at most 2 MHz without further gaps between bytes
/// (ADE7753 Rev C, timing; t6 and t9 *assumed* 4 µs).
pub const METER_SPI_HZ: u32 = 1_312_500;

#[cfg(test)]
#[allow(clippy::cast_precision_loss)]
mod tests {
    use super::*;

    #[test]
    fn the_meter_counts_8949_a_second_at_full_scale() {
        let per_second = METER_COUNTS_PER_SECOND_Q32 as f64 / 2f64.powi(32);
        // 1,677,722 · (0.1/0.5) · 894,886.25 Hz / 2^25
        let expected = 1_677_722.0 * 0.2 * (3_579_545.0 / 4.0) / 33_554_432.0;
        assert!((per_second - expected).abs() < 1e-6, "{per_second} {expected}");
        assert!((per_second - 8_949.0).abs() < 0.5);
        // So one count is 6.70 mC of the small range and 67.0 mC of the large one.
        assert!((60.0 / per_second - 6.70e-3).abs() < 0.01e-3);
        assert!((600.0 / per_second - 67.0e-3).abs() < 0.1e-3);
    }

    #[test]
    fn the_comparators_switch_where_the_document_says() {
        let swing = f64::from((COMPARATOR_HIGH.get()) - SENSOR_ZERO.get());
        let amps = swing * 60.0 / f64::from(DUAL_RANGE_SWING.get());
        assert!((amps - f64::from(SWITCHING_CURRENT.get()) * 1e-6).abs() < 1e-6);
        assert_eq!(SENSOR_ZERO.get() - COMPARATOR_LOW.get(), COMPARATOR_HIGH.get() - SENSOR_ZERO.get());
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
