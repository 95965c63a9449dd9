//! What the emulated core and QEMU's Cortex-M4 both run, for comparison (`emulator/tests/cpu_differential`).
//!
//! Results are written to a log in RAM; sequences of instructions that the test put there are run and leave their
//! registers where they found them. At the end both blocks go to the standard output by semihosting. Without a debugger
//! the first semihosting call is a HardFault with DEBUGEVT, which tells the emulated core's test that all is done.

#![no_std]
#![no_main]

mod arithmetic;
mod faults;
mod memory;
mod scripts;
mod start;

use core::arch::asm;
use core::ptr;

/// Where the test puts the sequences.
const SEQUENCES: *mut u32 = 0x2010_0000 as *mut u32;
/// First word there, if there are any.
const MAGIC: u32 = 0x5155_4553;
/// Words of the header: magic, options, SysTick reload, number of slots.
const HEADER: usize = 4;
/// Words of a slot: 46 of state, 32 of scratch, then code.
const SLOT: usize = 192;
const STATE: usize = 46;
const SCRATCH: usize = 32;
/// Option: floating-point registers are stacked at once.
const NOT_LAZY: u32 = 1;
/// Option: also run what needs no sequences.
const DIRECTED: u32 = 2;

/// Number of words, then the words.
const LOG: *mut u32 = 0x2020_0000 as *mut u32;

const FPCCR: *mut u32 = 0xE000_EF34 as *mut u32;
const FPCCR_LSPEN: u32 = 1 << 30;
const SYST_CSR: *mut u32 = 0xE000_E010 as *mut u32;
const SYST_RVR: *mut u32 = 0xE000_E014 as *mut u32;
const SYST_CVR: *mut u32 = 0xE000_E018 as *mut u32;

/// Reads a register or a word of RAM.
fn read(address: *const u32) -> u32 {
    // SAFETY: every address in this program is an aligned register or RAM that no Rust object occupies.
    unsafe { ptr::read_volatile(address) }
}

/// Writes a register or a word of RAM.
fn write(address: *mut u32, value: u32) {
    // SAFETY: as for `read`.
    unsafe { ptr::write_volatile(address, value) }
}

/// Appends a word.
fn log(value: u32) {
    let count = read(LOG);
    write(LOG, count + 1);
    write(LOG.wrapping_add(1 + count as usize), value);
}

/// SysTick interrupts every `reload` + 1 cycles, or not at all.
fn set_systick(reload: u32) {
    write(SYST_CSR, 0);
    write(SYST_RVR, reload);
    write(SYST_CVR, 0);
    if reload != 0 {
        write(SYST_CSR, 7);
    }
}

extern "C" fn main() -> ! {
    let options = if read(SEQUENCES) == MAGIC {
        read(SEQUENCES.wrapping_add(1))
    } else {
        DIRECTED
    };
    if options & NOT_LAZY != 0 {
        write(FPCCR, read(FPCCR) & !FPCCR_LSPEN);
    }
    if options & DIRECTED != 0 {
        log(1);
        arithmetic::run();
        log(2);
        scripts::run();
        log(3);
        memory::run();
        log(4);
        faults::run();
    }
    log(5);
    if read(SEQUENCES) == MAGIC {
        run_sequences();
    }
    log(memory::float_errors());
    finish()
}

fn run_sequences() {
    scripts::enable_transparent();
    memory::count_ticks();
    set_systick(read(SEQUENCES.wrapping_add(2)));
    let count = read(SEQUENCES.wrapping_add(3)) as usize;
    for index in 0..count {
        let slot = SEQUENCES.wrapping_add(HEADER + index * SLOT);
        let scratch = slot.wrapping_add(STATE);
        let code = scratch.wrapping_add(SCRATCH);
        // SAFETY: the test writes code there that changes no register but those of the state, keeps to the scratch
        // memory, and ends with `bx lr`.
        unsafe { start::run_sequence(code.cast_const().cast(), slot, scratch) };
    }
    set_systick(0);
}

/// A semihosting call (Arm's specification).
fn semihosting(operation: u32, argument: *const u32) -> u32 {
    let mut value = operation;
    // SAFETY: the debugger reads the argument block and what it points to.
    unsafe { asm!("bkpt #0xAB", inout("r0") value, in("r1") argument) };
    value
}

/// Hands the results over and ends.
extern "C" fn finish() -> ! {
    const SYS_OPEN: u32 = 0x01;
    const SYS_WRITE: u32 = 0x05;
    const SYS_EXIT: u32 = 0x18;
    const MODE_WRITE: u32 = 4;
    const APPLICATION_EXIT: u32 = 0x2_0026;
    let name = b":tt\0";
    let file = semihosting(SYS_OPEN, [name.as_ptr() as u32, MODE_WRITE, 3].as_ptr());
    let log_bytes = 4 * (1 + read(LOG));
    semihosting(SYS_WRITE, [file, LOG as u32, log_bytes].as_ptr());
    if read(SEQUENCES) == MAGIC {
        let bytes = 4 * (HEADER as u32 + SLOT as u32 * read(SEQUENCES.wrapping_add(3)));
        semihosting(SYS_WRITE, [file, SEQUENCES as u32, bytes].as_ptr());
    }
    loop {
        semihosting(SYS_EXIT, APPLICATION_EXIT as *const u32);
    }
}

#[panic_handler]
fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
    log(0xDEAD_0000);
    finish()
}
