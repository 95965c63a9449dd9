//! The Cortex-M4 core of the STM32F405: `rsemu`'s, with what its exception entry loses put back.
//!
//! `rsemu` 0.0.7 departs from the architecture (DDI 0403E B1.5), mostly where an exception is taken:
//! 1. ITSTATE is missing from the stacked xPSR (B1.5.6, PushStack), so an interrupted IT block goes on unconditionally.
//! 2. FPSCR is overwritten by FPDSCR at entry, also at tail-chaining. The register must keep its value until the handler's
//!    first floating-point instruction (A2.5, ExecuteFPCheck): the lazy push saves it, or nobody touches it at all.
//! 3. A failed push of the frame (STKERR) is noted, but no fault follows (B1.5.14, derived exceptions).
//! 4. BKPT at the priority of HardFault takes HardFault again instead of locking up (B1.5.15).
//! 5. An exception return under a condition (`bxeq lr`, `popne {pc}`) advances the ITSTATE that it has just restored, so an
//!    interrupted IT block loses an instruction's condition.
//! 6. Interrupt lines are levels alone: an edge that comes and goes while its handler runs is lost (B3.4.1).
//! 7. ICSR.VECTACTIVE is always 0 (B3.2.4). The handler of exceptions without one of their own asks it; here such a handler
//!    is known by serving NMI too, as in the vector table of `cortex-m-rt`.
//! 8. SysTick counts HCLK whatever CLKSOURCE says (B3.3.3).
//!
//! Not modelled: SLEEPONEXIT and SEVONPEND of SCR; LSPERR (a lazy push that fails is a precise bus fault); ITSTATE and FPSCR
//! in the frame of a synchronous fault, from which the firmware never returns; VECTACTIVE in handlers of their own; SYST_CALIB;
//! a reload value of 0 written while SysTick's clock is HCLK / 8, which leaves the one before.
//! `emulator/tests/cpu_differential` compares the rest with QEMU.
//!
//! [`Cpu`] looks at the core's state only where one of them can happen: before an instruction when an interrupt is about
//! to be taken, after one that took as long as an exception entry takes at least.

use std::fmt;
use std::sync::Arc;

use rsemu::core::device::{Device, ResetKind};
use rsemu::core::space::{AddressSpace, MemAttrs};
use rsemu::core::value::Width;
use rsemu::cpu::arm::v7m::isa::{Cond, Insn, MemOffset, Size, decode, is_32bit};
use rsemu::cpu::arm::v7m::sys::{Exception, Sys, control, exc_return, fpccr, fsr};
use rsemu::cpu::arm::v7m::{ArmV7m, Config, Regs, xpsr};

/// Implemented priority bits of the NVIC (RM0090 12.1.1: 16 levels).
const PRIORITY_BITS: u8 = 4;
/// Where the vector table is at reset: flash, which boots with BOOT0 low.
const RESET_VECTORS: u32 = 0x0800_0000;
/// Lines of [`Cpu::set_interrupts`].
const LINES: u16 = 96;
/// Shorter instructions take no exception: `rsemu` charges 6 cycles for a tail-chain, 10 for a return, 12 for an entry.
const SHORTEST_EXCEPTION_CYCLES: u64 = 6;
/// Offset of xPSR in a frame (DDI 0403E B1.5.6).
const FRAME_XPSR: u32 = 0x1C;
/// Offset of FPSCR from FPCAR in an extended frame.
const FRAME_FPSCR: u32 = 0x40;
/// AHP, DN, FZ and RMode of FPSCR: what a new floating-point context takes from FPDSCR.
const FPSCR_MODES: u32 = 0x07C0_0000;
/// SysTick may pend its exception.
const SYST_CSR_TICKINT: u32 = 1 << 1;
/// SysTick counts HCLK, else HCLK / [`SLOW_SYSTICK`].
const SYST_CSR_CLKSOURCE: u32 = 1 << 2;
/// SysTick Reload Value Register.
const SYST_RVR: u32 = 0xE000_E014;
/// What divides HCLK for SysTick's other clock (RM0090, clock tree).
const SLOW_SYSTICK: u64 = 8;
/// Interrupt Control and State Register.
const ICSR: u32 = 0xE000_ED04;

/// The core with NVIC, SysTick and system control block.
pub struct Cpu {
    core: ArmV7m,
    space: Arc<AddressSpace>,
    /// Levels of IRQ 0 … 95.
    levels: [u32; 3],
    /// The same by exception number, as the NVIC's own bitmaps are.
    levels_by_exception: [u32; 4],
    /// Cycles since power-on, sleep included.
    cycles: u64,
    /// An enabled exception is pending: the next step may take it.
    is_exception_due: bool,
    /// Cycles to the wrap of SysTick that pends its exception; `u64::MAX` if none will.
    cycles_to_systick: u64,
    /// SysTick counts by its other clock, or would if it were on.
    is_systick_slow: bool,
    /// Cycles of that clock's present period.
    systick_phase: u64,
    /// The reload value while `rsemu` is not to see it.
    hidden_reload: u32,
    /// Repairs are on.
    is_repaired: bool,
    /// Where the frame is whose floating-point part has been reserved, and the FPSCR that belongs there.
    reserved: Option<Reserved>,
    /// A handler's floating-point context has not begun yet, and will not begin with the FPSCR as it is.
    is_new_fp_mode_due: bool,
    /// A handler that nobody wrote is running: it may ask ICSR which exception it serves.
    is_default_handler: bool,
    /// As far as the wrapper knows; right after each exception entry and return.
    exception: u16,
    is_locked_up: bool,
    reset_requested: bool,
}

/// A floating-point frame that is reserved but not written (FPCCR.LSPACT).
#[derive(Clone, Copy)]
struct Reserved {
    fpcar: u32,
    fpscr: u32,
}

impl fmt::Debug for Cpu {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Cpu")
            .field("registers", &self.registers())
            .field("cycles", &self.cycles)
            .finish_non_exhaustive()
    }
}

impl Cpu {
    /// A core at power-on that fetches from `space`. The first [`Cpu::step`] is the reset sequence.
    pub fn new(space: Arc<AddressSpace>) -> Self {
        Self::with_vectors(space, RESET_VECTORS)
    }

    /// The same, with the vector table elsewhere at reset.
    pub fn with_vectors(space: Arc<AddressSpace>, reset_vectors: u32) -> Self {
        let config = Config::CORTEX_M4F
            .with_priority_bits(PRIORITY_BITS)
            .with_bit_band(true)
            .with_reset_vtor(reset_vectors);
        let core = ArmV7m::new(config);
        core.attach_space(Arc::clone(&space));
        Self {
            core,
            space,
            levels: [0; 3],
            levels_by_exception: [0; 4],
            cycles: 0,
            is_exception_due: false,
            cycles_to_systick: u64::MAX,
            is_systick_slow: false,
            systick_phase: 0,
            hidden_reload: 0,
            is_repaired: true,
            reserved: None,
            is_new_fp_mode_due: false,
            is_default_handler: false,
            exception: 0,
            is_locked_up: false,
            reset_requested: false,
        }
    }

    /// Without the repairs, so that a test can show what they are for.
    #[must_use]
    pub fn unrepaired(mut self) -> Self {
        self.is_repaired = false;
        self
    }

    /// Executes one instruction, exception entry or reset sequence; the cycles it took (`rsemu`'s timing: Cortex-M4 TRM
    /// without wait states and prefetch). A sleeping or locked-up core takes 1.
    pub fn step(&mut self) -> u64 {
        if self.is_systick_slow {
            return self.step_with_slow_systick();
        }
        if self.needs_care() {
            return self.step_with_care();
        }
        let used = self.core.step();
        self.account(used);
        used
    }

    /// Executes until `cycles` have passed, `stop` answers true, the core sleeps or locks up, or asks for a reset; the
    /// cycles that passed. `stop` is asked after each instruction that accessed memory.
    pub fn run(&mut self, cycles: u64, mut stop: impl FnMut() -> bool) -> u64 {
        let mut passed = 0;
        // WFI takes 1 cycle and so does each step asleep, and nothing is lost by noticing it a few cycles late.
        let mut single_cycles = 0;
        while passed < cycles {
            let used = self.step();
            passed += used;
            if used > 1 {
                single_cycles = 0;
                if self.reset_requested || stop() {
                    break;
                }
            } else {
                single_cycles += 1;
                if single_cycles == 8 {
                    single_cycles = 0;
                    if self.is_asleep() || self.is_locked_up() {
                        break;
                    }
                }
            }
        }
        passed
    }

    const fn needs_care(&self) -> bool {
        self.is_exception_due
            || self.is_new_fp_mode_due
            || self.is_default_handler
            || self.is_locked_up
    }

    /// A step while SysTick's clock is HCLK / 8: `rsemu` would count HCLK, but counts nothing without a reload value.
    fn step_with_slow_systick(&mut self) -> u64 {
        self.hidden_reload = self.core.with_sys(|sys| std::mem::take(&mut sys.syst_rvr));
        let used = self.step_with_care();
        let reload = std::mem::take(&mut self.hidden_reload);
        self.core.with_sys(|sys| {
            if sys.syst_rvr == 0 {
                sys.syst_rvr = reload;
            }
        });
        self.count_systick(used);
        self.refresh();
        used
    }

    /// Lets SysTick count for `cycles` of HCLK.
    fn count_systick(&mut self, cycles: u64) {
        let phase = &mut self.systick_phase;
        self.core.with_sys(|sys| {
            let mut counts = cycles;
            if is_systick_slow(sys) {
                *phase += cycles;
                counts = *phase / SLOW_SYSTICK;
                *phase %= SLOW_SYSTICK;
            }
            if sys.tick_systick(counts) && sys.syst_csr & SYST_CSR_TICKINT != 0 {
                sys.set_pending(Exception::SYSTICK, true);
            }
        });
    }

    /// A step at which an exception may be taken, or which must not be executed as `rsemu` would.
    fn step_with_care(&mut self) -> u64 {
        if self.is_locked_up {
            self.skip(1);
            return 1;
        }
        if !self.is_repaired {
            let used = self.core.step();
            self.account(used);
            return used;
        }
        let levels = self.levels_by_exception;
        let (due, faults) = self.core.with_sys(|sys| {
            // As the step itself will do.
            latch(sys, &levels);
            (sys.highest_pending(), sys.cfsr)
        });
        if due.is_some_and(|(_, priority)| priority < self.core.execution_priority()) {
            return self.enter_exception(faults);
        }
        let next = (self.is_default_handler || self.is_new_fp_mode_due || self.hidden_reload != 0)
            .then(|| self.next_instruction())
            .flatten();
        if self.is_new_fp_mode_due && matches!(next, Some(Insn::Fp(_))) {
            self.begin_fp_context();
        }
        let missing = next.and_then(|next| self.reads_what_is_missing(next));
        let used = self.core.step();
        if let Some((register, bits)) = missing {
            self.core.set_reg(register, self.core.reg(register) | bits);
        }
        self.account(used);
        used
    }

    /// Exception entry before the next instruction. `faults` is CFSR before it.
    fn enter_exception(&mut self, faults: u32) -> u64 {
        let it = self.core.xpsr() & xpsr::IT_MASK;
        let fpscr = self.core.fpscr();
        let used = self.core.step();
        let registers = self.core.regs();
        if it != 0 {
            let frame = if registers.r[14] & 4 != 0 {
                registers.psp
            } else {
                registers.msp
            };
            let at = frame.wrapping_add(FRAME_XPSR);
            if let Some(stacked) = self.read(at) {
                // Where the push itself failed there is nothing to mend.
                let _ = self.write(at, stacked | it);
            }
        }
        self.core.set_fpscr(fpscr);
        let (is_lost, reserved) = self.core.with_sys(|sys| {
            (
                sys.cfsr & !faults & fsr::BF_STKERR != 0,
                (sys.fpccr & fpccr::LSPACT != 0).then_some(Reserved {
                    fpcar: sys.fpcar,
                    fpscr,
                }),
            )
        });
        self.reserved = reserved;
        if is_lost {
            self.take_derived_fault(registers.exception());
            self.note_exception(&self.core.regs());
        } else {
            self.note_exception(&registers);
        }
        self.cycles += used;
        self.refresh();
        used
    }

    /// The fault that follows from a frame that could not be pushed: HardFault in place of `exception`, which stays pending.
    /// The firmware does not enable BusFault; if it is, it is pended.
    fn take_derived_fault(&mut self, exception: Exception) {
        if exception <= Exception::HARD_FAULT {
            return;
        }
        let handler = self.handler(Exception::HARD_FAULT);
        let is_escalated = self.core.with_sys(|sys| {
            if sys.is_enabled(Exception::BUS_FAULT) {
                sys.set_pending(Exception::BUS_FAULT, true);
                return false;
            }
            sys.set_active(exception, false);
            sys.set_pending(exception, true);
            sys.set_active(Exception::HARD_FAULT, true);
            true
        });
        if is_escalated && let Some(handler) = handler {
            let xpsr = self.core.xpsr() & !xpsr::EXCEPTION;
            self.core
                .set_xpsr(xpsr | u32::from(Exception::HARD_FAULT.0));
            self.core.set_pc(handler);
        }
    }

    /// After a step of `used` cycles.
    fn account(&mut self, used: u64) {
        self.cycles += used;
        // An instruction of one cycle accesses no memory: it pends nothing, only SysTick may.
        if used == 1 && self.cycles_to_systick > 1 {
            self.cycles_to_systick -= 1;
            return;
        }
        if used >= SHORTEST_EXCEPTION_CYCLES && self.is_repaired {
            self.after_long_instruction();
        }
        self.refresh();
    }

    /// After an instruction that may have been an exception return, tail-chained or not, or have ended in a fault.
    fn after_long_instruction(&mut self) {
        let registers = self.core.regs();
        if let Some(reserved) = self.reserved {
            let (is_owed, fpcar) = self
                .core
                .with_sys(|sys| (sys.fpccr & fpccr::LSPACT != 0, sys.fpcar));
            if is_owed && fpcar == reserved.fpcar {
                // No floating-point instruction since, so FPSCR has not changed: if it has, by tail-chaining.
                self.core.set_fpscr(reserved.fpscr);
            } else {
                self.reserved = None;
            }
        }
        let number = registers.exception().0;
        if number != self.exception && self.handler(registers.exception()) != Some(registers.r[15])
        {
            self.restore_itstate(&registers);
        }
        if number == Exception::HARD_FAULT.0
            && matches!(self.exception, 2 | 3)
            && self.handler(Exception::HARD_FAULT) == Some(registers.r[15])
        {
            self.is_locked_up = true;
        }
        self.note_exception(&registers);
    }

    /// After an exception return: ITSTATE as it was stacked.
    fn restore_itstate(&self, registers: &Regs) {
        let size = if registers.control & control::FPCA != 0 {
            exc_return::EXTENDED_FRAME
        } else {
            exc_return::BASIC_FRAME
        };
        // A frame begins at a multiple of 8; what is beyond one was inserted at entry.
        let frame = (registers.r[13] & !7).wrapping_sub(size);
        if let Some(stacked) = self.read(frame.wrapping_add(FRAME_XPSR))
            && (stacked ^ registers.xpsr) & xpsr::IT_MASK != 0
        {
            self.core
                .set_xpsr(registers.xpsr & !xpsr::IT_MASK | stacked & xpsr::IT_MASK);
        }
    }

    /// What follows from the exception that is now being handled.
    fn note_exception(&mut self, registers: &Regs) {
        let exception = registers.exception();
        self.exception = exception.0;
        self.is_default_handler = exception != Exception::THREAD
            && self.handler(exception) == self.handler(Exception::NMI);
        self.is_new_fp_mode_due = registers.control & control::FPCA == 0 && {
            let fpscr = self.core.fpscr();
            self.core.with_sys(|sys| {
                sys.fpccr & fpccr::ASPEN != 0 && (sys.fpdscr ^ fpscr) & FPSCR_MODES != 0
            })
        };
    }

    /// Address in the vector table, without the Thumb bit.
    fn handler(&self, exception: Exception) -> Option<u32> {
        self.read(self.core.vtor().wrapping_add(exception.vector_offset()))
            .map(|vector| vector & !1)
    }

    /// Begins the floating-point context of a handler before its first floating-point instruction, as ExecuteFPCheck does
    /// (DDI 0403E A2.5): what is owed to the interrupted context's frame is written, then the modes come from FPDSCR.
    fn begin_fp_context(&mut self) {
        let (is_enabled, is_owed, fpcar, fpdscr) = self.core.with_sys(|sys| {
            (
                sys.fp_enabled(true),
                sys.fpccr & fpccr::LSPACT != 0,
                sys.fpcar,
                sys.fpdscr,
            )
        });
        if !is_enabled {
            return;
        }
        let fpscr = self.core.fpscr();
        if is_owed {
            let is_written = (0..16)
                .map(|index| (fpcar + 4 * u32::from(index), self.core.s(index)))
                .chain([(fpcar + FRAME_FPSCR, fpscr)])
                .all(|(at, value)| self.write(at, value).is_some());
            if !is_written {
                // `rsemu` fails at it again and takes the fault.
                return;
            }
            self.core.with_sys(|sys| sys.fpccr &= !fpccr::LSPACT);
            self.reserved = None;
        }
        self.core
            .set_fpscr(fpscr & !FPSCR_MODES | fpdscr & FPSCR_MODES);
        self.is_new_fp_mode_due = false;
    }

    /// The instruction that the next step executes; `None` if its condition fails.
    fn next_instruction(&self) -> Option<Insn> {
        let pc = self.core.pc();
        let fetch = |at: u32| {
            self.space
                .read(u64::from(at), Width::U16, MemAttrs::DEBUG)
                .ok()
                .and_then(|half| u16::try_from(half).ok())
        };
        let first = fetch(pc)?;
        let second = if is_32bit(first) {
            fetch(pc.wrapping_add(2))?
        } else {
            0
        };
        let xpsr = self.core.xpsr();
        // ITSTATE[7:4], of which [7:2] are in xPSR[15:10].
        let is_conditional = xpsr & xpsr::IT_MASK != 0;
        let condition = Cond((xpsr >> 12 & 0xF) as u8);
        (!is_conditional || condition.passes(xpsr)).then(|| decode(first, second))
    }

    /// The destination of a load from ICSR or SYST_RVR, and the bits that `rsemu` leaves 0 there: VECTACTIVE, and a hidden
    /// reload value.
    fn reads_what_is_missing(&self, instruction: Insn) -> Option<(u8, u32)> {
        let Insn::LoadStore {
            load: true,
            size,
            rt,
            rn,
            offset: MemOffset::Imm(offset),
            index: true,
            add,
            ..
        } = instruction
        else {
            return None;
        };
        let base = self.core.reg(rn);
        let address = if add {
            base.wrapping_add(offset)
        } else {
            base.wrapping_sub(offset)
        };
        let bits = match address {
            ICSR if self.is_default_handler => u32::from(self.exception),
            SYST_RVR => self.hidden_reload,
            _ => return None,
        };
        let mask = match size {
            Size::Byte => 0xFF,
            Size::Half => 0xFFFF,
            Size::Word => u32::MAX,
        };
        Some((rt, bits & mask))
    }

    fn read(&self, address: u32) -> Option<u32> {
        self.space
            .read(u64::from(address), Width::U32, MemAttrs::DEFAULT)
            .ok()
            .and_then(|value| u32::try_from(value).ok())
    }

    fn write(&self, address: u32, value: u32) -> Option<()> {
        self.space
            .write(
                u64::from(address),
                Width::U32,
                u64::from(value),
                MemAttrs::DEFAULT,
            )
            .ok()
    }

    /// Looks again at what may be taken and when SysTick will be.
    fn refresh(&mut self) {
        let (levels, phase) = (self.levels_by_exception, self.systick_phase);
        let (is_due, to_wrap, is_slow, reset) = self.core.with_sys(|sys| {
            (
                is_any_due(sys, &levels),
                cycles_to_wrap(sys, phase),
                is_systick_slow(sys),
                sys.reset_requested,
            )
        });
        self.is_exception_due = is_due;
        self.cycles_to_systick = to_wrap;
        self.is_systick_slow = is_slow;
        self.reset_requested = reset;
    }

    /// Whether the core waits in WFI or WFE.
    pub fn is_asleep(&self) -> bool {
        self.core.is_asleep()
    }

    /// Lets `cycles` pass without executing: SysTick and CYCCNT go on, and SysTick's exception is pended if it is due.
    pub fn skip(&mut self, cycles: u64) {
        self.core.with_sys(|sys| sys.tick_cyccnt(cycles));
        self.count_systick(cycles);
        self.cycles += cycles;
        self.refresh();
    }

    /// Cycles until SysTick next pends its exception, if it is going to.
    pub fn cycles_to_systick(&self) -> Option<u64> {
        (self.cycles_to_systick != u64::MAX).then_some(self.cycles_to_systick)
    }

    /// The levels of IRQ 0 … 95, as RM0090 table 62 numbers them, and which of them have risen since the last call. An edge
    /// pends its exception also while that is being served, and for good (DDI 0403E B3.4.1); a level as `latch` has it.
    pub fn set_interrupts(&mut self, levels: [u32; 3], rose: [u32; 3]) {
        for irq in 0..LINES {
            let (word, bit) = (usize::from(irq / 32), 1 << (irq % 32));
            if (levels[word] ^ self.levels[word]) & bit != 0 {
                self.core.set_irq(irq, levels[word] & bit != 0);
            }
        }
        self.levels = levels;
        self.levels_by_exception = by_exception(levels);
        self.core.with_sys(|sys| {
            for (pending, rose) in sys.pending.iter_mut().zip(by_exception(rose)) {
                *pending |= rose;
            }
        });
        self.refresh();
    }

    /// Pends NMI.
    pub fn raise_nmi(&mut self) {
        self.core
            .with_sys(|sys| sys.set_pending(Exception::NMI, true));
        self.refresh();
    }

    /// Whether a sleeping core would wake at the next step. `rsemu` wakes for any enabled exception that is pending, also one
    /// that BASEPRI masks (the architecture allows a wake-up without cause, B1.5.19).
    pub fn wake_pending(&self) -> bool {
        let levels = self.levels_by_exception;
        self.core.with_sys(|sys| {
            latch(sys, &levels);
            sys.highest_pending().is_some()
        })
    }

    /// System reset: registers and system control space as at power-on, memory and interrupt lines as they are.
    /// [`Cpu::cycles`] goes on.
    pub fn reset(&mut self) {
        self.core.reset(ResetKind::Cold);
        let levels = std::mem::take(&mut self.levels);
        self.reserved = None;
        self.is_new_fp_mode_due = false;
        self.is_default_handler = false;
        self.is_locked_up = false;
        self.exception = 0;
        self.set_interrupts(levels, [0; 3]);
    }

    /// Whether the program asked for a system reset (AIRCR.SYSRESETREQ).
    pub const fn reset_requested(&self) -> bool {
        self.reset_requested
    }

    /// Takes notice of the request.
    pub fn clear_reset_request(&mut self) {
        self.core.clear_reset_request();
        self.reset_requested = false;
    }

    /// Whether a fault came where no handler can be taken: only a reset helps (DDI 0403E B1.5.15).
    pub fn is_locked_up(&self) -> bool {
        self.is_locked_up || self.core.is_locked_up()
    }

    /// Address of the next instruction.
    pub fn pc(&self) -> u32 {
        self.core.pc()
    }

    /// IPSR: number of the exception that is handled, 0 in thread mode.
    pub fn current_exception(&self) -> u16 {
        self.core.current_exception().0
    }

    /// Priority the core executes at; an exception needs a lower number to preempt. 256 in thread mode unmasked.
    pub fn execution_priority(&self) -> i32 {
        self.core.execution_priority()
    }

    /// Core registers.
    pub fn registers(&self) -> Regs {
        self.core.regs()
    }

    /// Puts other values into the core registers (a fault, a debugger).
    pub fn set_registers(&mut self, registers: Regs) {
        self.core.set_regs(registers);
        self.refresh();
    }

    /// S0 … S31 as bits, then FPSCR.
    pub fn float_registers(&self) -> ([u32; 32], u32) {
        let mut registers = [0; 32];
        for (index, register) in (0u8..).zip(&mut registers) {
            *register = self.core.s(index);
        }
        (registers, self.core.fpscr())
    }

    /// CFSR and HFSR: why a fault was taken (DDI 0403E B3.2.15, B3.2.16).
    pub fn fault_status(&self) -> (u32, u32) {
        self.core.with_sys(|sys| (sys.cfsr, sys.hfsr))
    }

    /// Cycles that have passed since power-on, sleep included.
    pub const fn cycles(&self) -> u64 {
        self.cycles
    }
}

/// The levels of interrupt lines as bitmaps by exception number: IRQ 0 is exception 16.
fn by_exception(levels: [u32; 3]) -> [u32; 4] {
    [
        levels[0] << 16,
        levels[0] >> 16 | levels[1] << 16,
        levels[1] >> 16 | levels[2] << 16,
        levels[2] >> 16,
    ]
}

/// Pends the lines that are up and not being served, as the NVIC does (DDI 0403E B3.4.1).
fn latch(sys: &mut Sys, levels: &[u32; 4]) {
    for (word, level) in levels.iter().enumerate() {
        sys.pending[word] |= level & !sys.active[word];
    }
}

/// Whether an exception is pending that is enabled, whatever the masks say.
fn is_any_due(sys: &Sys, levels: &[u32; 4]) -> bool {
    (0..levels.len()).any(|word| {
        let pending = sys.pending[word] | levels[word] & !sys.active[word];
        // MemManage, BusFault and UsageFault have their enable bits elsewhere, NMI has none.
        let always = if word == 0 { 0b111_0100 } else { 0 };
        pending & (sys.enable[word] | always) != 0
    })
}

/// Whether SysTick's clock is HCLK / 8; without a reload value it counts nothing.
const fn is_systick_slow(sys: &Sys) -> bool {
    sys.syst_csr & SYST_CSR_CLKSOURCE == 0 && sys.syst_rvr != 0
}

/// Cycles until SysTick's counter reaches 0 and pends the exception (DDI 0403E B3.3.1); `u64::MAX` if it will not.
fn cycles_to_wrap(sys: &Sys, phase: u64) -> u64 {
    const RUNNING: u32 = 1 | SYST_CSR_TICKINT;
    if sys.syst_csr & RUNNING != RUNNING || sys.syst_rvr == 0 {
        return u64::MAX;
    }
    let counts = if sys.syst_cvr == 0 {
        u64::from(sys.syst_rvr) + 1
    } else {
        u64::from(sys.syst_cvr)
    };
    if is_systick_slow(sys) {
        counts * SLOW_SYSTICK - phase
    } else {
        counts
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]
mod tests {
    use rsemu::core::space::{RamStore, Region};

    use super::*;

    const FLASH: u32 = 0x0800_0000;
    const RAM: u32 = 0x2000_0000;
    const CODE: u32 = FLASH + 0x200;
    const HANDLER: u32 = FLASH + 0x300;
    const SECOND_HANDLER: u32 = FLASH + 0x380;
    const NVIC_ISER0: u32 = 0xE000_E100;
    const SYST_CSR: u32 = 0xE000_E010;

    /// `code` in thread mode; `handler` serves SysTick and IRQ 0, `second_handler` HardFault and NMI.
    fn program(code: &[u16], handler: &[u16], second_handler: &[u16]) -> (Cpu, Arc<RamStore>) {
        let (flash, ram) = (
            Arc::new(RamStore::new(0x1000)),
            Arc::new(RamStore::new(0x1000)),
        );
        let word = |offset: u32, value: u32| {
            flash
                .write_at(u64::from(offset), &value.to_le_bytes())
                .unwrap();
        };
        word(0, RAM + 0x1000);
        word(4, CODE | 1);
        for exception in 2..4 {
            word(4 * exception, SECOND_HANDLER | 1);
        }
        for exception in 15..17 {
            word(4 * exception, HANDLER | 1);
        }
        for (address, halves) in [
            (CODE, code),
            (HANDLER, handler),
            (SECOND_HANDLER, second_handler),
        ] {
            for (at, half) in (u64::from(address - FLASH)..).step_by(2).zip(halves) {
                flash.write_at(at, &half.to_le_bytes()).unwrap();
            }
        }
        let space = AddressSpace::new("test", 32);
        {
            let mut map = space.topology();
            map.map(Region::ram("flash", flash), u64::from(FLASH))
                .unwrap();
            map.map(Region::ram("ram", Arc::clone(&ram)), u64::from(RAM))
                .unwrap();
        }
        let mut cpu = Cpu::new(Arc::new(space));
        cpu.step();
        assert_eq!(cpu.pc(), CODE);
        (cpu, ram)
    }

    fn write_system(cpu: &Cpu, address: u32, value: u32) {
        assert!(cpu.core.with_sys(|sys| sys.write_word(address, value)));
    }

    fn start_systick(cpu: &mut Cpu, reload: u32) {
        write_system(cpu, SYST_CSR + 4, reload);
        write_system(cpu, SYST_CSR + 8, 0);
        write_system(cpu, SYST_CSR, 7);
        cpu.refresh();
    }

    const WFI: u16 = 0xBF30;
    const NOP: u16 = 0xBF00;
    const BX_LR: u16 = 0x4770;
    const BKPT: u16 = 0xBE00;
    const UDF: u16 = 0xDE00;
    /// Branch to itself, and to the instruction before.
    const HERE: u16 = 0xE7FE;
    const BACK: u16 = 0xE7FD;

    #[test]
    fn sleep_skipped_is_sleep_stepped() {
        for skip_most in [false, true] {
            let (mut cpu, _) = program(&[WFI, BACK], &[NOP, BX_LR], &[HERE]);
            start_systick(&mut cpu, 999);
            let mut interrupts = vec![];
            while interrupts.len() < 5 {
                if cpu.is_asleep() && !cpu.wake_pending() && skip_most {
                    cpu.skip(cpu.cycles_to_systick().unwrap());
                }
                let before = cpu.current_exception();
                cpu.step();
                if before == 0 && cpu.current_exception() != 0 {
                    assert_eq!(cpu.current_exception(), 15);
                    interrupts.push(cpu.cycles());
                }
            }
            // A period is the reload value and 1 (DDI 0403E B3.3.1).
            for pair in interrupts.windows(2) {
                assert_eq!(pair[1] - pair[0], 1_000, "skipping: {skip_most}");
            }
        }
    }

    #[test]
    fn systick_is_announced_to_the_cycle() {
        let (mut cpu, _) = program(&[NOP, NOP, BACK, HERE], &[BX_LR], &[HERE]);
        assert_eq!(cpu.cycles_to_systick(), None);
        start_systick(&mut cpu, 99);
        // One cycle to load the reload value.
        assert_eq!(cpu.cycles_to_systick(), Some(100));
        cpu.skip(40);
        assert_eq!(cpu.cycles_to_systick(), Some(60));
        cpu.skip(59);
        assert!(!cpu.wake_pending());
        cpu.skip(1);
        assert!(cpu.wake_pending());
        assert_eq!(cpu.cycles_to_systick(), Some(100));
        cpu.step();
        assert_eq!((cpu.pc(), cpu.current_exception()), (HANDLER, 15));
        // Not the counter alone, the exception.
        write_system(&cpu, SYST_CSR, 5);
        cpu.refresh();
        assert_eq!(cpu.cycles_to_systick(), None);
    }

    /// RM0090, clock tree: with CLKSOURCE clear SysTick counts HCLK / 8.
    #[test]
    fn systick_by_its_slow_clock_takes_eight_times_as_long() {
        for skip_most in [false, true] {
            let (mut cpu, _) = program(&[WFI, BACK], &[NOP, BX_LR], &[HERE]);
            start_systick(&mut cpu, 99);
            write_system(&cpu, SYST_CSR, 3);
            cpu.refresh();
            let mut interrupts = vec![];
            while interrupts.len() < 5 {
                if cpu.is_asleep() && !cpu.wake_pending() && skip_most {
                    cpu.skip(cpu.cycles_to_systick().unwrap());
                }
                let before = cpu.current_exception();
                cpu.step();
                if before == 0 && cpu.current_exception() != 0 {
                    interrupts.push(cpu.cycles());
                }
            }
            for pair in interrupts.windows(2) {
                assert_eq!(pair[1] - pair[0], 8 * 100, "skipping: {skip_most}");
            }
        }
    }

    #[test]
    fn systick_by_its_slow_clock_reads_as_any_other() {
        // r0 = SYST_CSR; r1 = RVR, r2 = CVR, r3 = CSR; RVR = r4.
        let code = [
            0x4803, 0x6841, 0x6882, 0x6803, 0x6044, HERE, NOP, NOP, 0xE010, 0xE000,
        ];
        let (mut cpu, _) = program(&code, &[HERE], &[HERE]);
        start_systick(&mut cpu, 99);
        write_system(&cpu, SYST_CSR, 1);
        cpu.refresh();
        // One count to load the reload value, three to 97, seven eighths of the next.
        cpu.skip(8 * 3 + 7);
        let mut registers = cpu.registers();
        registers.r[4] = 0xFF_0007;
        cpu.set_registers(registers);
        for _ in 0..4 {
            cpu.step();
        }
        let [_, rvr, cvr, csr, ..] = cpu.registers().r;
        assert_eq!((rvr, cvr, csr), (99, 96, 1));
        cpu.step();
        let reload = cpu.core.with_sys(|sys| sys.read_word(SYST_CSR + 4, false));
        assert_eq!(reload, Some(0xFF_0007));
        // COUNTFLAG, once; the new reload value comes after the wrap.
        cpu.skip(8 * 98);
        let read = |register| cpu.core.with_sys(|sys| sys.read_word(register, false));
        assert_eq!(read(SYST_CSR), Some(1 << 16 | 1));
        assert_eq!(read(SYST_CSR), Some(1));
        assert!((0xFF_0000..=0xFF_0007).contains(&read(SYST_CSR + 8).unwrap()));
        // Back to the core's clock.
        write_system(&cpu, SYST_CSR + 4, 99);
        write_system(&cpu, SYST_CSR + 8, 0);
        write_system(&cpu, SYST_CSR, 7);
        cpu.refresh();
        assert_eq!(cpu.cycles_to_systick(), Some(100));
    }

    #[test]
    fn cycle_counter_goes_on_in_sleep() {
        const DEMCR: u32 = 0xE000_EDFC;
        const DWT_CTRL: u32 = 0xE000_1000;
        let (mut cpu, _) = program(&[WFI, HERE], &[BX_LR], &[HERE]);
        write_system(&cpu, DEMCR, 1 << 24);
        write_system(&cpu, DWT_CTRL, 1);
        cpu.step();
        let start = cpu.core.with_sys(|sys| sys.dwt_cyccnt);
        cpu.skip(12_345);
        assert_eq!(
            cpu.core.with_sys(|sys| sys.dwt_cyccnt).wrapping_sub(start),
            12_345
        );
    }

    #[test]
    fn a_line_that_stays_up_is_served_again_and_one_without_enable_never() {
        let (mut cpu, _) = program(&[WFI, BACK], &[BX_LR], &[HERE]);
        cpu.set_interrupts([1, 0, 0], [1, 0, 0]);
        assert!(!cpu.wake_pending());
        write_system(&cpu, NVIC_ISER0, 1);
        assert!(cpu.wake_pending());
        let mut entries = 0;
        for _ in 0..12 {
            cpu.step();
            entries += u32::from(cpu.pc() == HANDLER);
        }
        assert!(entries >= 5, "{entries}");
        cpu.set_interrupts([0; 3], [0; 3]);
        // What was pending is still served.
        for _ in 0..6 {
            cpu.step();
        }
        assert!(cpu.is_asleep() && !cpu.wake_pending());
    }

    /// DDI 0403E B3.4.1, and the Cortex-M4 Devices Generic User Guide 4.2.9, level-sensitive and pulse interrupts.
    #[test]
    fn an_edge_while_the_handler_runs_is_served_after_it() {
        // How often the handler runs if the line falls in it, and then `pulses` more come before it returns.
        let entries = |pulses: usize| {
            let (mut cpu, _) = program(&[WFI, BACK], &[NOP, NOP, BX_LR], &[HERE]);
            write_system(&cpu, NVIC_ISER0, 1);
            cpu.set_interrupts([1, 0, 0], [1, 0, 0]);
            cpu.step();
            assert_eq!(cpu.current_exception(), 16);
            cpu.set_interrupts([0; 3], [0; 3]);
            for _ in 0..pulses {
                cpu.set_interrupts([1, 0, 0], [1, 0, 0]);
                cpu.set_interrupts([0; 3], [0; 3]);
            }
            let mut entries = 1;
            for _ in 0..20 {
                cpu.step();
                entries += usize::from(cpu.pc() == HANDLER);
            }
            assert!(cpu.is_asleep() && !cpu.wake_pending());
            entries
        };
        assert_eq!(entries(0), 1);
        assert_eq!(entries(1), 2);
        // One bit remembers them.
        assert_eq!(entries(3), 2);
    }

    #[test]
    fn a_pulse_between_two_steps_is_served_once() {
        let (mut cpu, _) = program(&[WFI, BACK], &[BX_LR], &[HERE]);
        write_system(&cpu, NVIC_ISER0, 1);
        cpu.set_interrupts([0; 3], [1, 0, 0]);
        let mut entries = 0;
        for _ in 0..20 {
            cpu.step();
            entries += usize::from(cpu.pc() == HANDLER);
        }
        assert_eq!(entries, 1);
    }

    #[test]
    fn every_line_has_its_exception() {
        for irq in 0..LINES {
            let (mut cpu, _) = program(&[HERE], &[HERE], &[HERE]);
            let (word, bit) = (irq / 32, 1 << (irq % 32));
            write_system(&cpu, NVIC_ISER0 + 4 * u32::from(word), bit);
            let mut levels = [0; 3];
            levels[usize::from(word)] = bit;
            cpu.set_interrupts(levels, levels);
            cpu.step();
            assert_eq!(cpu.current_exception(), 16 + irq);
        }
    }

    #[test]
    fn nmi_is_taken_through_every_mask_and_wakes() {
        // CPSID i, then asleep.
        let (mut cpu, _) = program(&[0xB672, NOP, WFI, HERE], &[HERE], &[HERE]);
        for _ in 0..8 {
            cpu.step();
        }
        assert!(cpu.is_asleep() && !cpu.wake_pending());
        cpu.raise_nmi();
        assert!(cpu.wake_pending());
        cpu.step();
        cpu.step();
        assert_eq!((cpu.pc(), cpu.current_exception()), (SECOND_HANDLER, 2));
    }

    #[test]
    fn a_run_ends_where_something_is_to_be_done() {
        // LDR r0, [r0] of address 0x20000000 in r0, then a loop.
        let load = [0xF04F, 0x5000, 0x6800, 0xE7FD];
        let (mut cpu, _) = program(&load, &[BX_LR], &[HERE]);
        assert!(cpu.run(1_000, || true) < 5);
        let (mut cpu, _) = program(&load, &[BX_LR], &[HERE]);
        assert!((1_000..1_005).contains(&cpu.run(1_000, || false)));
        let (mut cpu, _) = program(&[NOP, WFI, HERE], &[BX_LR], &[HERE]);
        assert!(cpu.run(1_000, || false) < 20);
        assert!(cpu.is_asleep());
        // AIRCR = 0x05FA0004.
        let reset = [0x4801, 0x4902, 0x6001, HERE, 0xED0C, 0xE000, 0x0004, 0x05FA];
        let (mut cpu, _) = program(&reset, &[BX_LR], &[HERE]);
        assert!(cpu.run(1_000, || false) < 20);
        assert!(cpu.reset_requested());
        cpu.clear_reset_request();
        assert!(!cpu.reset_requested());
    }

    #[test]
    fn a_reset_starts_over_and_keeps_memory_lines_and_time() {
        let (mut cpu, ram) = program(&[HERE], &[HERE], &[HERE]);
        ram.write_at(0, &[7]).unwrap();
        write_system(&cpu, NVIC_ISER0, 1);
        cpu.set_interrupts([1, 0, 0], [1, 0, 0]);
        cpu.step();
        assert_eq!(cpu.current_exception(), 16);
        let cycles = cpu.cycles();
        cpu.reset();
        cpu.step();
        assert_eq!((cpu.pc(), cpu.current_exception()), (CODE, 0));
        assert!(cpu.cycles() > cycles);
        // Enabled by nobody any more.
        assert!(!cpu.wake_pending());
        write_system(&cpu, NVIC_ISER0, 1);
        assert!(cpu.wake_pending());
        let mut byte = [0];
        ram.read_at(0, &mut byte).unwrap();
        assert_eq!(byte, [7]);
    }

    #[test]
    fn a_fault_or_breakpoint_at_the_priority_of_hardfault_locks_up_until_reset() {
        for last in [UDF, BKPT] {
            for first in [UDF, BKPT] {
                let (mut cpu, _) = program(&[first], &[BX_LR], &[NOP, last]);
                cpu.step();
                assert_eq!((cpu.pc(), cpu.current_exception()), (SECOND_HANDLER, 3));
                cpu.step();
                assert!(!cpu.is_locked_up());
                cpu.step();
                assert!(cpu.is_locked_up());
                let cycles = cpu.cycles();
                assert_eq!(cpu.step(), 1);
                assert_eq!(cpu.cycles(), cycles + 1);
                cpu.reset();
                assert!(!cpu.is_locked_up());
                cpu.step();
                assert_eq!(cpu.pc(), CODE);
            }
        }
    }

    #[test]
    fn sixteen_priorities() {
        // RM0090 12.1.1: 16 programmable priority levels, in the upper half of each byte.
        let (cpu, _) = program(&[HERE], &[BX_LR], &[HERE]);
        write_system(&cpu, 0xE000_E400, 0xFFFF_FFFF);
        let read = cpu
            .core
            .with_sys(|sys| sys.read_word(0xE000_E400, false))
            .unwrap();
        assert_eq!(read, 0xF0F0_F0F0);
    }
}
