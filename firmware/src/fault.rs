//! The end of a program that cannot go on: the cause goes into retained memory, then the core is reset.
//!
//! A panic is panic-probe's: it prints the panic through defmt and executes `udf`. The handler here finds that
//! instruction, takes the printed frame out of the RTT channel and keeps its text. So panic-probe stays the one panic
//! handler, a probe sees the panic as ever, and a board in the field still knows after its reset where it was.

use core::sync::atomic::{AtomicU32, Ordering};

use cortex_m::peripheral::SCB;
use cortex_m_rt::exception;

use crate::retain::{self, Fault, FaultKind};

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
    if kind == FaultKind::Panic {
        retain::note_text(rtt::last_panic());
    }
    retain::note_fault(Fault {
        kind,
        pc,
        lr,
        status,
    });
    SCB::sys_reset()
}

/// Whether the instruction is `udf`, with which panic-probe ends.
fn is_udf(pc: u32) -> bool {
    const FLASH: core::ops::Range<u32> = 0x0800_0000..0x0810_0000;
    if !FLASH.contains(&pc) || !pc.is_multiple_of(2) {
        return false;
    }
    // SAFETY: an aligned address within the flash, which can always be read.
    let instruction = unsafe { core::ptr::read_volatile(pc as *const u16) };
    instruction & 0xFF00 == 0xDE00
}

/// Anything else that has no handler.
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

/// The last frame in the RTT channel that defmt-rtt writes, decoded from reverse-zero-compressing COBS.
mod rtt {
    use super::{AtomicU32, Ordering};

    /// SEGGER's control block with one channel, the public layout that every RTT host searches for.
    #[repr(C)]
    struct ControlBlock {
        id: [u8; 16],
        up_channels: u32,
        down_channels: u32,
        name: u32,
        buffer: u32,
        size: u32,
        write: AtomicU32,
        read: AtomicU32,
        flags: AtomicU32,
    }

    unsafe extern "C" {
        /// Of defmt-rtt, which writes it with atomic stores only.
        safe static _SEGGER_RTT: ControlBlock;
    }

    /// A frame longer than this does not come from a panic's print.
    const LONGEST_FRAME: usize = 512;
    const START: &[u8] = b"panicked at ";

    /// The channel's bytes, counted backwards from the newest.
    fn newest(index: usize) -> Option<u8> {
        let size = usize::try_from(_SEGGER_RTT.size).ok()?;
        let write = usize::try_from(_SEGGER_RTT.write.load(Ordering::Acquire)).ok()?;
        if index >= size || write >= size {
            return None;
        }
        let offset = (write + size - 1 - index) % size;
        let address = usize::try_from(_SEGGER_RTT.buffer).ok()? + offset;
        // SAFETY: within the buffer that defmt-rtt gave to the control block; the core is in the fault handler, so
        // nothing writes it meanwhile.
        Some(unsafe { core::ptr::read_volatile(address as *const u8) })
    }

    /// Hands the bytes of the last frame to `each`, last byte first, until it returns false.
    ///
    /// Each group is followed by its code, so the stream is read backwards. A code below 0x80 stands for seven bytes,
    /// of which those with a set bit are zero; one from 0x80 for n + 7 bytes and a zero; 0xFF for 134 bytes.
    fn decoded_backwards(mut each: impl FnMut(u8) -> bool) {
        // The newest byte is the frame's end mark.
        if newest(0) != Some(0) {
            return;
        }
        let mut index = 1;
        while index < LONGEST_FRAME {
            let Some(code) = newest(index).filter(|code| *code != 0) else {
                return;
            };
            index += 1;
            let long = code & 0x80 != 0;
            if long && code != 0xFF && !each(0) {
                return;
            }
            let count = if long { code & 0x7F } else { 0 } + 7;
            for place in 0..count {
                let zero = !long && code >> (6 - place) & 1 != 0;
                let byte = if zero {
                    0
                } else {
                    let Some(byte) = newest(index).filter(|byte| *byte != 0) else {
                        return;
                    };
                    index += 1;
                    byte
                };
                if !each(byte) {
                    return;
                }
            }
        }
    }

    /// The text of the panic that was printed last, or nothing.
    pub fn last_panic() -> impl Iterator<Item = u8> {
        // The whole text backwards first: its start is found last.
        let mut reversed = heapless::Vec::<u8, LONGEST_FRAME>::new();
        decoded_backwards(|byte| reversed.push(byte).is_ok());
        reversed.reverse();
        let start = reversed
            .windows(START.len())
            .position(|window| window == START);
        let skip = start.map_or(reversed.len(), |start| start + START.len());
        // A print ends with a mark that UTF-8 never has.
        reversed
            .into_iter()
            .skip(skip)
            .take_while(|byte| *byte != 0xFF)
    }
}
