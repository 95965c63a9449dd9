//! A part, as plain numbers.

use serde::{Deserialize, Serialize};

/// Times and limits (W25Q32JV, AC electrical characteristics).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Timing {
    /// tBP1: program of the first byte.
    pub first_byte_s: f64,
    /// tBP2: program of each further byte.
    pub further_byte_s: f64,
    /// tPP: program of a page; no program takes longer.
    pub page_s: f64,
    /// tSE: erase of a sector of 4 KiB.
    pub sector_erase_s: f64,
    /// tBE1: erase of a block of 32 KiB.
    pub half_block_erase_s: f64,
    /// tBE2: erase of a block of 64 KiB.
    pub block_erase_s: f64,
    /// tCE: erase of the chip.
    pub chip_erase_s: f64,
    /// tW: write of a status register.
    pub status_write_s: f64,
    /// tDP: chip select to power-down.
    pub power_down_s: f64,
    /// tRES1: chip select to the first command after a release from power-down.
    pub release_s: f64,
    /// tRES2: the same where the release read the device ID.
    pub release_with_id_s: f64,
    /// tRST: after a software reset.
    pub reset_s: f64,
    /// tVSL: from power-on to the first command.
    pub power_on_s: f64,
    /// tPUW: from power-on to the first write.
    pub power_on_write_s: f64,
    /// tSHSL2: chip select high.
    pub deselect_s: f64,
    /// fR: clock of Read Data (03h).
    pub read_clock_max_hz: f64,
    /// fC1: clock of everything else over the full supply range.
    pub clock_max_hz: f64,
}

impl Timing {
    /// Typical times.
    pub const TYPICAL: Self = Self {
        first_byte_s: 30e-6,
        further_byte_s: 2.5e-6,
        page_s: 0.7e-3,
        sector_erase_s: 45e-3,
        half_block_erase_s: 120e-3,
        block_erase_s: 150e-3,
        chip_erase_s: 10.0,
        status_write_s: 10e-3,
        power_down_s: 3e-6,
        release_s: 3e-6,
        release_with_id_s: 1.8e-6,
        reset_s: 30e-6,
        power_on_s: 20e-6,
        power_on_write_s: 5e-3,
        deselect_s: 50e-9,
        read_clock_max_hz: 50e6,
        clock_max_hz: 104e6,
    };

    /// The longest times.
    pub const SLOWEST: Self = Self {
        first_byte_s: 50e-6,
        further_byte_s: 12e-6,
        page_s: 3e-3,
        sector_erase_s: 400e-3,
        half_block_erase_s: 1.6,
        block_erase_s: 2.0,
        chip_erase_s: 50.0,
        status_write_s: 15e-3,
        ..Self::TYPICAL
    };
}

impl Default for Timing {
    fn default() -> Self {
        Self::TYPICAL
    }
}

/// A part.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct W25q32Config {
    /// Manufacturer, type and capacity (W25Q32JV-IQ, BV, FV: EF 40 16; JV-IM: EF 70 16).
    pub jedec_id: [u8; 3],
    /// Device ID of 90h and ABh.
    pub device_id: u8,
    /// Unique ID.
    pub unique_id: [u8; 8],
    /// Status registers 1 … 3 as delivered (drive strength 25 %).
    pub status: [u8; 3],
    /// Times and limits.
    pub timing: Timing,
    /// Seed of what a loss of power leaves.
    pub seed: u64,
}

impl Default for W25q32Config {
    fn default() -> Self {
        Self {
            jedec_id: [0xEF, 0x40, 0x16],
            device_id: 0x15,
            unique_id: [0xD2, 0x64, 0x5C, 0x31, 0x0B, 0x28, 0x17, 0x39],
            status: [0x00, 0x00, 0x60],
            timing: Timing::TYPICAL,
            seed: 0,
        }
    }
}
