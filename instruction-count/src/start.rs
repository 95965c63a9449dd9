//! Vector table and reset, as little as QEMU needs (memory is loaded and cleared by it), and two functions of known length.

use core::arch::global_asm;

global_asm!(
    ".section .vectors, \"a\", %progbits",
    ".word stack_top",
    ".word reset",
    // NMI and the faults.
    ".rept 5",
    ".word fault",
    ".endr",
    ".section .text.reset, \"ax\", %progbits",
    ".global reset",
    ".type reset, %function",
    ".thumb_func",
    "reset:",
    // CPACR: full access to the floating-point unit, before the first code that may use it.
    "ldr r0, =0xE000ED88",
    "ldr r1, [r0]",
    "orr r1, r1, #(0xF << 20)",
    "str r1, [r0]",
    "dsb",
    "isb",
    "bl {main}",
    ".size reset, . - reset",
    ".type fault, %function",
    ".thumb_func",
    "fault:",
    "b {fault}",
    ".size fault, . - fault",
    ".global nothing",
    ".type nothing, %function",
    ".thumb_func",
    "nothing:",
    "bx lr",
    ".size nothing, . - nothing",
    ".global hundred_instructions",
    ".type hundred_instructions, %function",
    ".thumb_func",
    "hundred_instructions:",
    ".rept 100",
    "nop",
    ".endr",
    "bx lr",
    ".size hundred_instructions, . - hundred_instructions",
    main = sym enter,
    fault = sym fault,
);

extern "C" fn enter() -> ! {
    crate::main()
}

extern "C" fn fault() -> ! {
    crate::exit(false)
}

unsafe extern "C" {
    /// Returns at once.
    pub safe fn nothing(unused: *mut ());
    /// Runs 100 instructions and returns.
    pub safe fn hundred_instructions(unused: *mut ());
}
