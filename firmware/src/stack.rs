//! How much of the stack has ever been used: cortex-m-rt paints it before `main`, here the paint that is left is
//! counted. The stack has the core-coupled memory to itself (memory.x).

use core::sync::atomic::{AtomicU32, Ordering};

/// cortex-m-rt's `paint-stack`.
const PAINT: u32 = 0xCCCC_CCCC;
/// Size of the stack's memory.
pub const BYTES: usize = 64 * 1024;
const WORDS: usize = BYTES / 4;

unsafe extern "C" {
    /// The lowest word of the stack, of memory.x; every bit pattern is a word, and the stack's owner is this core.
    safe static _stack_end: [AtomicU32; WORDS];
}

/// Bytes of stack used since the start, at most.
pub fn high_water_bytes() -> usize {
    let untouched = _stack_end
        .iter()
        .take_while(|word| word.load(Ordering::Relaxed) == PAINT)
        .count();
    (WORDS - untouched) * 4
}
