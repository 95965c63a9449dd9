//! What the factory wrote into system memory: unique ID, size of the flash, calibration values (RM0090, section 39; data
//! sheet of the STM32F405, calibration values).

use super::adc::{AdcParameters, CALIBRATION_VDDA_V};

/// Address of the first byte of [`content`].
pub const BASE: u32 = 0x1FFF_7A00;
/// Bytes of it.
pub const LENGTH: usize = 0x100;

const UNIQUE_ID: usize = 0x10;
const FLASH_SIZE: usize = 0x22;
const VREFINT_CAL: usize = 0x2A;
const TS_CAL1: usize = 0x2C;
const TS_CAL2: usize = 0x2E;

/// Flash of the STM32F405RG, in KiB.
const FLASH_KIB: u16 = 1_024;

/// Where on which wafer of which lot the chip was.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UniqueId {
    /// Coordinates on the wafer.
    pub position: (u16, u16),
    /// Number of the wafer.
    pub wafer: u8,
    /// The lot's name, in ASCII.
    pub lot: [u8; 7],
}

impl Default for UniqueId {
    fn default() -> Self {
        Self {
            position: (0x0023, 0x0041),
            wafer: 7,
            lot: *b"Q104052",
        }
    }
}

impl UniqueId {
    /// As it lies in memory: x, y, wafer, lot.
    pub fn bytes(&self) -> [u8; 12] {
        let [x, y] = [self.position.0, self.position.1].map(u16::to_le_bytes);
        let mut bytes = [0; 12];
        bytes[..2].copy_from_slice(&x);
        bytes[2..4].copy_from_slice(&y);
        bytes[4] = self.wafer;
        bytes[5..].copy_from_slice(&self.lot);
        bytes
    }
}

/// The bytes from [`BASE`] on of a typical chip.
pub fn content() -> [u8; LENGTH] {
    content_of(&UniqueId::default(), &AdcParameters::default())
}

/// The bytes from [`BASE`] on of a chip with this ID and this analogue side; what the factory did not write is erased.
///
/// Its calibration values are what an ideal converter at 3.3 V makes of the chip's reference, and of its temperature sensor
/// at 30 and 110 °C.
pub fn content_of(id: &UniqueId, chip: &AdcParameters) -> [u8; LENGTH] {
    let mut bytes = [0xFF; LENGTH];
    bytes[UNIQUE_ID..UNIQUE_ID + 12].copy_from_slice(&id.bytes());
    let halves = [
        (FLASH_SIZE, FLASH_KIB),
        (
            VREFINT_CAL,
            AdcParameters::ideal_code(chip.reference_v, CALIBRATION_VDDA_V),
        ),
        (
            TS_CAL1,
            AdcParameters::ideal_code(chip.sensor_v(30.0), CALIBRATION_VDDA_V),
        ),
        (
            TS_CAL2,
            AdcParameters::ideal_code(chip.sensor_v(110.0), CALIBRATION_VDDA_V),
        ),
    ];
    for (offset, half) in halves {
        bytes[offset..offset + 2].copy_from_slice(&half.to_le_bytes());
    }
    bytes
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

    use proptest::prelude::*;

    use super::*;

    fn half(content: &[u8], address: u32) -> u16 {
        let offset = usize::try_from(address - BASE).unwrap();
        u16::from_le_bytes([content[offset], content[offset + 1]])
    }

    /// Addresses as in RM0090 (39.1, 39.2) and the data sheet (tables of the calibration values).
    #[test]
    fn a_typical_chip() {
        let content = content();
        assert_eq!(content[0x10..0x1C], *b"\x23\x00\x41\x00\x07Q104052");
        assert_eq!(half(&content, 0x1FFF_7A22), 1_024);
        assert_eq!(half(&content, 0x1FFF_7A2A), 1_502);
        assert_eq!(half(&content, 0x1FFF_7A2C), 959);
        assert_eq!(half(&content, 0x1FFF_7A2E), 1_207);
    }

    proptest! {
        /// The factory's two points lead back to the die's temperature within what rounding three codes can do, at any
        /// supply (RM0090, 13.10, with the calibration values instead of the typical ones).
        #[test]
        fn calibration_fits_the_converter(
            vdda_v in 2.7..3.6_f64, die_c in -40.0..125.0_f64,
            reference_v in 1.18..1.24_f64, sensor_25_v in 0.72..0.80_f64, slope in 2.2e-3..2.8e-3_f64,
        ) {
            let chip = AdcParameters {
                vdda_v, die_temperature_c: die_c, reference_v, sensor_25_v,
                sensor_slope_v_per_k: slope, ..AdcParameters::default()
            };
            let content = content_of(&UniqueId::default(), &chip);
            let calibration = |address| f64::from(half(&content, address));
            let reference = f64::from(AdcParameters::ideal_code(chip.reference_v, vdda_v));
            let supply_v = 3.3 * calibration(0x1FFF_7A2A) / reference;
            // Half a code of about 1500, twice.
            prop_assert!((supply_v / vdda_v - 1.0).abs() < 0.5 / 1_300.0 * 2.0);
            let code = f64::from(AdcParameters::ideal_code(chip.sensor_v(die_c), vdda_v));
            let (cold, hot) = (calibration(0x1FFF_7A2C), calibration(0x1FFF_7A2E));
            let measured_c = 30.0 + (code * vdda_v / 3.3 - cold) * 80.0 / (hot - cold);
            // A code is 3.3 V / 4096 / 2.2 mV/K = 0.37 K at most; half of it in the measurement, and half of it in each of the
            // two points, the farther one at most (125 − 30) / 80 as heavy.
            prop_assert!((measured_c - die_c).abs() < 0.37 * (0.6 + 2.0 * 0.6), "{measured_c} for {die_c}");
        }
    }
}
