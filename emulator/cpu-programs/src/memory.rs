//! Block transfers, exclusive accesses, unaligned accesses and bit-banding, the first two under SysTick's interrupt.

use core::ptr;
use core::sync::atomic::{AtomicU32, Ordering};

use crate::{log, read, set_systick, start, write};

/// Counted up by the loop and by SysTick's handler, with exclusive accesses. While it is 0, SysTick is part of a script.
pub static COUNTER: AtomicU32 = AtomicU32::new(0);
/// Mistakes that handlers found in their own floating-point context.
pub static FLOAT_ERRORS: AtomicU32 = AtomicU32::new(0);

const ITERATIONS: u32 = 3_000;
/// SysTick's periods, in cycles. Short ones and long ones hit the loop at every place.
const RELOADS: [u32; 6] = [0, 4_999, 4_001, 3_511, 3_001, 2_503];

/// From now on SysTick's handler counts.
pub fn count_ticks() {
    COUNTER.store(1, Ordering::Relaxed);
}

/// What [`FLOAT_ERRORS`] counts.
pub fn float_errors() -> u32 {
    FLOAT_ERRORS.load(Ordering::Relaxed)
}

pub fn run() {
    for reload in RELOADS {
        let mut buffer: [u32; 10] =
            core::array::from_fn(|index| 0x3F81_2345_u32.wrapping_mul(index as u32 + 1));
        COUNTER.store(1, Ordering::Relaxed);
        set_systick(reload);
        // SAFETY: ten words, and a counter that is accessed atomically.
        let sum = unsafe {
            start::memory_loop(
                ITERATIONS,
                ptr::from_mut(&mut buffer).cast(),
                COUNTER.as_ptr(),
            )
        };
        set_systick(0);
        let ticks = COUNTER.load(Ordering::Relaxed) - ITERATIONS - 1;
        log(u32::from(ticks > 20));
        log(sum);
        for word in buffer {
            log(word);
        }
        COUNTER.store(0, Ordering::Relaxed);
    }
    bits();
}

fn bits() {
    const WORD: usize = 0x200E_0000;
    const ALIAS: usize = 0x2200_0000 + (WORD - 0x2000_0000) * 32;
    let word = WORD as *mut u32;
    let alias = |bit: usize| (ALIAS + 4 * bit) as *mut u32;
    write(word, 0xA000_0005);
    for bit in [0, 1, 2, 29, 30, 31] {
        log(read(alias(bit)));
    }
    for (bit, value) in [(0, 0), (1, 1), (7, 0xFFFF_FFFE), (30, 0xFF), (31, 2)] {
        write(alias(bit), value);
        log(read(word));
    }
    for offset in 0..4 {
        // SAFETY: RAM; the core does unaligned word and halfword accesses itself.
        let (value, half): (u32, u32);
        unsafe {
            core::arch::asm!(
                "str {v}, [{a}]", "ldr {w}, [{a}]", "ldrsh {h}, [{a}, #1]",
                a = in(reg) WORD + offset, v = in(reg) 0x8182_8384_u32, w = out(reg) value, h = out(reg) half,
            );
        }
        log(value);
        log(half);
        log(read(word));
        log(read(word.wrapping_add(1)));
    }
}
