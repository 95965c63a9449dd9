//! Interrupts that pend one another: priorities, masking, preemption, tail-chaining, and what each level's floating-point
//! context is worth afterwards.

use core::arch::asm;
use core::sync::atomic::{AtomicU32, Ordering};

use crate::arithmetic::Random;
use crate::{log, read, write};

const ISER: *mut u32 = 0xE000_E100 as *mut u32;
const ICER: *mut u32 = 0xE000_E180 as *mut u32;
const ISPR: *mut u32 = 0xE000_E200 as *mut u32;
const ICPR: *mut u32 = 0xE000_E280 as *mut u32;
const IABR: *const u32 = 0xE000_E300 as *const u32;
const IPR: *mut u32 = 0xE000_E400 as *mut u32;
const ICSR: *mut u32 = 0xE000_ED04 as *mut u32;
const SHPR3: *mut u32 = 0xE000_ED20 as *mut u32;
const STIR: *mut u32 = 0xE000_EF00 as *mut u32;
const FPCCR: *const u32 = 0xE000_EF34 as *const u32;

const PENDSVSET: u32 = 1 << 28;
const PENDSTSET: u32 = 1 << 26;
const NMIPENDSET: u32 = 1 << 31;
/// IRQ 0 … 7.
const SCRIPTED: u32 = 0xFF;
/// IRQ 8 … 11.
const TRANSPARENT: u32 = 0xF00;
const SCENARIOS: u32 = 400;
/// In the low half of an action: what to pend, 8 IRQs, then PendSV and SysTick.
const PEND_SV: u32 = 1 << 8;
const PEND_ST: u32 = 1 << 9;
/// In the upper half of an action.
const FLOAT: u32 = 1 << 16;
const MASK: u32 = 1 << 17;
const WITHDRAW: u32 = 1 << 18;
const BY_STIR: u32 = 1 << 19;

/// What each exception does when it is served next; by exception number.
static ACTIONS: [AtomicU32; 24] = [const { AtomicU32::new(0) }; 24];

/// IRQ 8 and 9 with a low priority, 10 and 11 with a high one.
pub fn enable_transparent() {
    write(IPR.wrapping_add(2), 0x4040_8080);
    write(SHPR3, 0x6060_0000);
    write(ISER, TRANSPARENT);
}

pub fn run() {
    let mut random = Random(0x1357_9BDF);
    for _ in 0..SCENARIOS {
        scenario(&mut random);
    }
    unhandled();
    write(ICER, SCRIPTED);
}

fn scenario(random: &mut Random) {
    write(ICER, SCRIPTED);
    // Enabled are most of them; priorities are of 16 levels as on the STM32F405.
    write(IPR, random.next() & 0x70F0_F0F0);
    write(IPR.wrapping_add(1), random.next() & 0xF0F0_70F0);
    write(SHPR3, random.next() & 0xF0F0_0000);
    for action in &ACTIONS {
        // Not everyone pends something, or it would never end.
        let pend = random.next() & random.next() & 0x3FF;
        action.store(pend | random.next() & 0xFFFF_0000, Ordering::Relaxed);
    }
    let enabled = (random.next() | random.next()) & SCRIPTED;
    write(ISER, enabled);
    log(0x5C00_0000 | enabled);

    let first = random.next();
    let basepri = if first & 0x100 != 0 {
        random.next() & 0xF0
    } else {
        0
    };
    set_basepri(basepri);
    act(first & 0x3FF | random.next() & 0xFFFF_0000 & !MASK);
    log(read(IABR));
    // BASEPRI_MAX only ever raises the priority.
    let wanted = random.next() & 0xF0;
    // SAFETY: BASEPRI, and an ISB after it.
    unsafe { asm!("msr basepri_max, {}", "isb", in(reg) wanted) };
    log(basepri_now());
    set_basepri(0);
    // SAFETY: PRIMASK; nothing here relies on it.
    unsafe { asm!("cpsid i", "isb") };
    act(random.next() & 0x3FF);
    log(read(ISPR) & SCRIPTED);
    // SAFETY: as above.
    unsafe { asm!("cpsie i", "isb") };
    // What was pended and not enabled.
    write(ISER, SCRIPTED);
    synchronise();
    log(read(ISPR) & SCRIPTED);
    log(read(ICSR) & (PENDSVSET | PENDSTSET));
}

fn set_basepri(value: u32) {
    // SAFETY: nothing here relies on what it masks.
    unsafe { asm!("msr basepri, {}", "isb", in(reg) value) };
}

fn basepri_now() -> u32 {
    let value;
    // SAFETY: reads a register.
    unsafe { asm!("mrs {}, basepri", out(reg) value) };
    value
}

fn synchronise() {
    // SAFETY: barriers.
    unsafe { asm!("dsb", "isb") };
}

/// Pends what the low half of an action says, in the way the upper half says, and logs what became of the floating-point
/// flags meanwhile.
fn act(action: u32) {
    let before = basepri_now();
    if action & MASK != 0 {
        set_basepri(0x40);
    }
    let system = if action & PEND_SV != 0 { PENDSVSET } else { 0 }
        | if action & PEND_ST != 0 { PENDSTSET } else { 0 };
    let irqs = action & SCRIPTED;
    if action & FLOAT != 0 {
        act_with_float(action, irqs, system);
    } else if action & BY_STIR != 0 && irqs != 0 {
        write(STIR, irqs.trailing_zeros());
        synchronise();
    } else {
        write(ISPR, irqs);
        write(ICSR, system);
        synchronise();
    }
    if action & WITHDRAW != 0 {
        write(ICPR, action >> 8 & SCRIPTED);
    }
    if action & MASK != 0 {
        // As RTIC ends a lock.
        set_basepri(before);
    }
}

/// Pends in between a comparison and the look at its flags. A function of its own, so that a level without floating point
/// saves no such registers either.
#[inline(never)]
fn act_with_float(action: u32, irqs: u32, system: u32) {
    // Some mode and some flags: 4 roundings, flush to zero, default NaN.
    let modes = action >> 4 & 0x03C0_0000;
    let (fpscr, sum): (u32, u32);
    // SAFETY: registers of the floating-point unit, all of which are named.
    unsafe {
        asm!(
            "vmsr fpscr, {modes}",
            "vmov s0, {x}",
            "vmov s5, {y}",
            "vmov s17, {y}",
            "vcmp.f32 s0, s5",
            "str {irqs}, [{ispr}]",
            "str {system}, [{icsr}]",
            "dsb",
            "isb",
            "vmrs {fpscr}, fpscr",
            "vdiv.f32 s0, s0, s17",
            "vadd.f32 s0, s0, s5",
            "vmov {sum}, s0",
            modes = in(reg) modes,
            x = in(reg) 0x3F80_0000_u32 | action >> 24,
            y = in(reg) 0x3F80_0040_u32,
            irqs = in(reg) irqs,
            ispr = in(reg) ISPR,
            system = in(reg) system,
            icsr = in(reg) ICSR,
            fpscr = out(reg) fpscr,
            sum = out(reg) sum,
            out("s0") _, out("s5") _, out("s17") _,
        );
    }
    log(fpscr);
    log(sum);
    // SAFETY: the compiler expects default modes.
    unsafe { asm!("vmsr fpscr, {}", in(reg) 0) };
}

/// Every exception of a script.
pub extern "C" fn on_interrupt(exc_return: u32) {
    let number: u32;
    let control: u32;
    // SAFETY: reads registers.
    unsafe {
        asm!("mrs {}, control", out(reg) control);
        asm!("mrs {}, ipsr", out(reg) number);
    }
    log(number << 24 | control << 16 | exc_return & 0xFFFF);
    log(read(FPCCR) & 1 | read(IABR) << 8);
    let action = ACTIONS
        .get(number as usize)
        .map_or(0, |action| action.swap(0, Ordering::Relaxed));
    act(action);
    log(0xE000_0000 | number);
}

/// A handler for whatever has none.
pub extern "C" fn on_default() {
    log(0xDEF0_0000 | read(ICSR) & 0x1FF);
}

fn unhandled() {
    write(ICSR, NMIPENDSET);
    synchronise();
    write(ISER, 1 << 20);
    write(ISPR, 1 << 20);
    synchronise();
    write(ICER, 1 << 20);
}
