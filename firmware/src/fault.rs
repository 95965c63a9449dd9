//! The end of a program that cannot go on: the cause goes into retained memory, then the core is reset.
//!
//! A debug build panics through panic-probe, which formats the whole message for an attached probe. A release image
//! has no room for the formatting of messages (`core::fmt`, 12 kB with its texts): its handler keeps file and line,
//! shows them to a probe, and ends as panic-probe does, with `udf`. The HardFault handler recognises that instruction.

use cortex_m::peripheral::SCB;
use cortex_m_rt::exception;
#[cfg(debug_assertions)]
use panic_probe as _;

use crate::retain::{self, Fault, FaultKind};

/// So short that the compiler sees through it: nobody looks at the message, so none is built.
#[cfg(not(debug_assertions))]
#[panic_handler]
#[allow(
    unused_attributes,
    reason = "the compiler warns that it ignores this; link-time optimization heeds it and saves 2 kB"
)]
#[inline(always)]
fn panic(info: &core::panic::PanicInfo<'_>) -> ! {
    end(info.location())
}

#[cfg(not(debug_assertions))]
#[inline(never)]
fn end(location: Option<&core::panic::Location<'_>>) -> ! {
    cortex_m::interrupt::disable();
    // There always is one, as Rust documents.
    let (file, line) = location.map_or(("", 0), |location| (location.file(), location.line()));
    // Kept before it is shown: showing it is code that may have panicked itself.
    if retain::note_panic(file, line) {
        defmt::error!("panicked at {=str}:{=u32}", file, line);
    }
    cortex_m::asm::udf()
}

/// The lowest address of the stack (memory.x).
const STACK_BOTTOM: u32 = 0x1000_0000;
/// An exception frame with floating-point registers: less room than that below the stack pointer is an overflow.
const FRAME_BYTES: u32 = 0x68;
const STACK_TOP: u32 = STACK_BOTTOM + 64 * 1024;

// The handler must run whatever the stack pointer is worth after an overflow: it goes back to the top of the stack,
// over frames that nobody will return to, and hands the old pointer on.
core::arch::global_asm!(
    ".syntax unified",
    ".section .HardFault.user, \"ax\", %progbits",
    ".global HardFault",
    ".type HardFault, %function",
    ".thumb_func",
    "HardFault:",
    "mrs r0, msp",
    "ldr r1, =_stack_start",
    "mov sp, r1",
    "b {handler}",
    ".ltorg",
    ".size HardFault, . - HardFault",
    handler = sym on_hard_fault,
);

/// The stacked registers of an exception (ARMv7-M, exception entry).
#[repr(C)]
struct Frame {
    _r0_to_r3: [u32; 4],
    _r12: u32,
    lr: u32,
    pc: u32,
    _psr: u32,
}

extern "C" fn on_hard_fault(stack_pointer: u32) -> ! {
    cortex_m::interrupt::disable();
    // SAFETY: reading a register of the core that nobody will use after this.
    let status = unsafe { (*SCB::PTR).cfsr.read() };
    let readable =
        (STACK_BOTTOM..STACK_TOP - 32).contains(&stack_pointer) && stack_pointer.is_multiple_of(4);
    let frame = if readable {
        // SAFETY: the pointer is aligned and the frame lies within the stack's memory; whatever it holds are words.
        let frame = unsafe { &*(stack_pointer as *const Frame) };
        (frame.pc, frame.lr)
    } else {
        (0, 0)
    };
    let (pc, lr) = frame;
    let overflow = stack_pointer < STACK_BOTTOM + FRAME_BYTES;
    let kind = if overflow {
        FaultKind::StackOverflow
    } else if is_udf(pc) {
        FaultKind::Panic
    } else {
        FaultKind::HardFault
    };
    retain::note_fault(Fault {
        kind,
        pc,
        lr,
        status,
    });
    SCB::sys_reset()
}

/// Whether the instruction is `udf`, with which a panic ends.
fn is_udf(pc: u32) -> bool {
    const FLASH: core::ops::Range<u32> = 0x0800_0000..0x0810_0000;
    if !FLASH.contains(&pc) || !pc.is_multiple_of(2) {
        return false;
    }
    // SAFETY: an aligned address within the flash, which can always be read.
    let instruction = unsafe { core::ptr::read_volatile(pc as *const u16) };
    instruction & 0xFF00 == 0xDE00
}

/// Anything else that has no handler; NMI among it, of a crystal that has stopped (`clock`).
#[exception]
unsafe fn DefaultHandler(_number: i16) -> ! {
    let number = SCB::vect_active();
    let pc = match number {
        cortex_m::peripheral::scb::VectActive::Interrupt { irqn } => u32::from(irqn),
        _ => 0,
    };
    retain::note_fault(Fault {
        kind: FaultKind::Exception,
        pc,
        lr: 0,
        status: 0,
    });
    SCB::sys_reset()
}
