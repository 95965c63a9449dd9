//! The independent watchdog. It runs from its own oscillator (LSI, 17 … 47 kHz), so it also ends a start-up that waits
//! for a crystal that does not swing; and it can never be stopped again. Not by a debugger that halts the core, either: a core that
//! stands at a fault because a probe catches it must not hold the permit.

use stm32f4xx_hal::pac::{DBGMCU, IWDG};

/// 0.68 … 1.88 s over the tolerance of LSI, 1.0 s nominal.
const RELOAD: u16 = 1_000 - 1;

/// 30 ms at least: the start runs from HSI, 16 MHz, and a poll takes at least six clocks. Should five periods of the *prescaled* clock
/// be meant (9.4 ms at 17 kHz; ST's driver waits 48 ms for the largest prescaler), it is enough. The watchdog already runs by then,
/// with the reset's 0.35 s or more.
const UPDATE_POLLS: u32 = 80_000;

/// The running watchdog.
pub struct Watchdog(IWDG);

impl Watchdog {
    /// Starts it, and waits until prescaler and reload value have reached its clock domain, five periods of LSI: a feed
    /// before that would load the reset's 4 s. The wait is bounded; the watchdog runs either way.
    pub fn start(iwdg: IWDG, debug: &DBGMCU) -> Self {
        // In an image with debug assertions a breakpoint does not end in a reset. The bit outlives resets: it is cleared as well.
        debug
            .apb1_fz()
            .modify(|_, w| w.dbg_iwdg_stop().bit(cfg!(debug_assertions)));
        iwdg.kr().write(|w| w.key().start());
        iwdg.kr().write(|w| w.key().unlock());
        // LSI / 32: 1 ms at the nominal 32 kHz.
        iwdg.pr().write(|w| w.pr().divide_by32());
        iwdg.rlr().write(|w| w.rl().set(RELOAD));
        for _ in 0..UPDATE_POLLS {
            if iwdg.sr().read().bits() == 0 {
                break;
            }
        }
        iwdg.kr().write(|w| w.key().feed());
        Self(iwdg)
    }

    /// One more period.
    pub fn feed(&mut self) {
        self.0.kr().write(|w| w.key().feed());
    }
}
