//! The end-to-end check of protected frames: AUTOSAR E2E profile 11, variant C, as docs/can.md has it.

use crate::log::CLASSIC_BYTES;

/// SAE J1850's, without its top bit; start value and final XOR are 0.
const POLYNOMIAL: u8 = 0x1D;
/// This counter is reserved.
const RESERVED: u8 = 15;

/// Whether CRC, the part of the data ID that is sent, and counter are as a sender makes them.
pub(crate) fn holds(data_id: u16, payload: &[u8; CLASSIC_BYTES]) -> bool {
    let [crc, header, ..] = *payload;
    let [high, low] = data_id.to_be_bytes();
    let start = [low, 0].into_iter().fold(0, crc_step);
    let expected = payload[1..].iter().copied().fold(start, crc_step);
    crc == expected && header >> 4 == high & 0x0F && header & 0x0F != RESERVED
}

fn crc_step(crc: u8, byte: u8) -> u8 {
    (0..8).fold(crc ^ byte, |crc, _| {
        crc << 1 ^ if crc & 0x80 == 0 { 0 } else { POLYNOMIAL }
    })
}
