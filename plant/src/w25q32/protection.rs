//! Block protection (W25Q32JV, status register memory protection).

use std::ops::Range;

use super::CAPACITY;

/// BP2 … BP0.
const BLOCK: (u8, u8) = (2, 7);
/// TB: from the bottom.
const BOTTOM: u8 = 1 << 5;
/// SEC: sectors instead of blocks.
const SECTORS: u8 = 1 << 6;
/// CMP, in status register 2.
const COMPLEMENT: u8 = 1 << 6;

/// Whether any byte of `range` is protected.
pub(super) fn covers(status: [u8; 3], range: &Range<usize>) -> bool {
    let [first, second, _] = status;
    let level = first >> BLOCK.0 & BLOCK.1;
    let size = match level {
        0 => 0,
        7 => CAPACITY,
        _ if first & SECTORS == 0 => 0x1_0000 << (level - 1),
        _ => (0x1000 << (level - 1)).min(0x8000),
    };
    let protected = if first & BOTTOM != 0 {
        0..size
    } else {
        CAPACITY - size..CAPACITY
    };
    if second & COMPLEMENT == 0 {
        range.start < protected.end && protected.start < range.end
    } else {
        range.start < protected.start || range.end > protected.end
    }
}
