//! Counts the instructions that functions of `core-logic` take on a Cortex-M4.
//!
//! Runs under QEMU, where every instruction takes 2^10 ns (`-icount shift=10`) and SysTick counts 25 MHz: the number of
//! instructions is the number of ticks times 40 ns / 1024 ns, and the same on each run. Built with the profile and flags
//! of the board's image. `cargo xtask size` builds it, runs it and compares with the limits below.
//!
//! What is printed, one line per measurement: `COUNT LIMIT NAME`; `-` for a figure without a limit.

#![no_std]
#![no_main]

mod measurements;
mod start;

use core::{arch::asm, hint::black_box, ptr::from_mut};

use cortex_m::peripheral::{SYST, syst::SystClkSource};
use cortex_m_semihosting::{debug, hprintln};

/// SysTick counts down from here: 655,000 instructions.
const RELOAD: u32 = 0x00FF_FFFF;

/// A running SysTick and what a call of nothing takes.
pub struct Counter {
    overhead: u32,
    failed: bool,
}

/// What one counted call works on.
struct Job<'a, I, R, W> {
    work: &'a mut W,
    input: &'a I,
    result: Option<R>,
}

impl Counter {
    fn start(mut systick: SYST) -> Self {
        systick.set_clock_source(SystClkSource::Core);
        systick.set_reload(RELOAD);
        systick.clear_current();
        systick.enable_counter();
        let count_known = |function| count(function, core::ptr::null_mut());
        let overhead = count_known(start::nothing);
        // A QEMU that counts otherwise must not go unnoticed.
        let hundred = count_known(start::hundred_instructions).saturating_sub(overhead);
        if hundred != 100 {
            hprintln!("{} instructions counted where 100 ran", hundred);
        }
        Self {
            overhead,
            failed: hundred != 100,
        }
    }

    /// Measures `work` on each of `inputs` and prints the worst; state that `work` captures goes on from one to the next.
    /// Loading the input and storing the result count too.
    pub fn measure<I, R, W: FnMut(&I) -> R>(
        &mut self,
        name: &str,
        limit: Option<u32>,
        inputs: &[I],
        mut work: W,
    ) {
        let mut worst = None;
        for input in inputs {
            let mut job: Job<'_, I, R, W> = Job {
                work: &mut work,
                input,
                result: None,
            };
            let counted = count(run::<I, R, W>, from_mut(&mut job).cast());
            black_box(&job.result);
            worst = worst.max(Some(counted.saturating_sub(self.overhead)));
        }
        // Nothing measured is no measurement: the line would claim 0 instructions.
        if let Some(worst) = worst {
            match limit {
                Some(limit) => hprintln!("{} {} {}", worst, limit, name),
                None => hprintln!("{} - {}", worst, name),
            }
        } else {
            hprintln!("no inputs for {}", name);
            self.failed = true;
        }
    }
}

/// Does a [`Job`]; `job` points to one of exactly these types.
extern "C" fn run<I, R, W: FnMut(&I) -> R>(job: *mut ()) {
    // SAFETY: `measure` passes a pointer to such a job, which lives until `count` returns and which nothing else uses.
    let job = unsafe { &mut *job.cast::<Job<'_, I, R, W>>() };
    job.result = Some((job.work)(job.input));
}

/// Instructions from one reading of SysTick to the next, with one call in between. In assembly, so that the compiler moves
/// nothing in or out.
fn count(function: extern "C" fn(*mut ()), argument: *mut ()) -> u32 {
    let (start, end): (u32, u32);
    // SAFETY: the register is only read; the call keeps to the C calling convention, which preserves r4 and r5.
    unsafe {
        asm!(
            "ldr r4, [r5, #8]",
            "blx r3",
            "ldr r0, [r5, #8]",
            in("r5") SYST::PTR,
            inlateout("r3") function => _,
            inlateout("r0") argument => end,
            out("r4") start,
            // What a C function may change. Not `clobber_abi`: it names registers that this floating-point unit has not.
            out("r1") _, out("r2") _, out("r12") _, out("lr") _,
            out("s0") _, out("s1") _, out("s2") _, out("s3") _, out("s4") _, out("s5") _, out("s6") _, out("s7") _,
            out("s8") _, out("s9") _, out("s10") _, out("s11") _, out("s12") _, out("s13") _, out("s14") _, out("s15") _,
        );
    }
    let ticks = start.wrapping_sub(end) & RELOAD;
    // 40 ns per tick, 1024 ns per instruction, rounded to nearest: 24 bits times 40 fit in 32.
    (ticks * 40 + 512) >> 10
}

/// Where `start::reset` goes.
fn main() -> ! {
    let failed = if let Some(peripherals) = cortex_m::Peripherals::take() {
        let mut counter = Counter::start(peripherals.SYST);
        measurements::all(&mut counter);
        counter.failed
    } else {
        true
    };
    exit(!failed)
}

fn exit(success: bool) -> ! {
    loop {
        debug::exit(if success {
            debug::EXIT_SUCCESS
        } else {
            debug::EXIT_FAILURE
        });
    }
}

#[panic_handler]
fn panic(info: &core::panic::PanicInfo<'_>) -> ! {
    hprintln!("{}", info);
    exit(false)
}
