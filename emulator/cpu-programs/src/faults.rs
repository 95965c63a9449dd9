//! Faults, as far as they end in HardFault.

use core::sync::atomic::{AtomicU32, Ordering};

use crate::{log, read, start, write};

/// The stack pointer to go on with after a fault; 0 while none is expected.
pub static RESUME: AtomicU32 = AtomicU32::new(0);

const CFSR: *mut u32 = 0xE000_ED28 as *mut u32;
const HFSR: *mut u32 = 0xE000_ED2C as *mut u32;
const BFAR: *const u32 = 0xE000_ED38 as *const u32;
const CFSR_BFARVALID: u32 = 1 << 15;
const CFSR_STKERR: u32 = 1 << 12;
const ICPR: *mut u32 = 0xE000_E280 as *mut u32;
const IABR: *const u32 = 0xE000_E300 as *const u32;
const ISER: *mut u32 = 0xE000_E100 as *mut u32;
const ICER: *mut u32 = 0xE000_E180 as *mut u32;
const FPCCR: *mut u32 = 0xE000_EF34 as *mut u32;
const FPCCR_LSPACT: u32 = 1;
const KINDS: u32 = 12;

pub fn run() {
    // IRQ 0 is the exception that finds no room for its frame.
    write(ISER, 1);
    for kind in 0..KINDS {
        log(0xFA00_0000 | kind);
        // SAFETY: it saves and restores what a C function must.
        unsafe { start::fault_case(kind) };
    }
    RESUME.store(0, Ordering::Relaxed);
    write(ICER, 1);
}

/// `frame` is where the fault's exception frame is, `exc_return` what came with it.
pub extern "C" fn on_fault(frame: u32, exc_return: u32) {
    let status = read(CFSR);
    log(status);
    log(read(HFSR));
    log(exc_return);
    log(frame);
    log(read(IABR));
    if status & CFSR_BFARVALID != 0 {
        log(read(BFAR));
    }
    if status & CFSR_STKERR == 0 {
        // pc and xPSR of what faulted.
        log(read((frame + 24) as *const u32));
        log(read((frame + 28) as *const u32));
    }
    // The frame is given up, and with it what was owed to it.
    write(FPCCR, read(FPCCR) & !FPCCR_LSPACT);
    write(CFSR, u32::MAX);
    write(HFSR, u32::MAX);
    write(ICPR, u32::MAX);
}
