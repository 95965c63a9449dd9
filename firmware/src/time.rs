//! Time since start: TIM2 counts microseconds in 32 bits (71.6 min), a word beside it counts its half periods.
//!
//! Reading takes no lock and no interrupt, so that the range-flag edge can be stamped at the highest priority. The
//! parity of the half-period count tells whether the counter has passed the middle since it was written; that is
//! right as long as [`extend`] runs at least once in 35 minutes, and it runs every 10 ms.

use core::sync::atomic::{AtomicU32, Ordering};

use core_logic::units::Instant;
use stm32f4xx_hal::{
    pac::{RCC, TIM2, tim2},
    rcc::{Enable, Reset},
};

static HALF_PERIODS: AtomicU32 = AtomicU32::new(0);

/// To 1 MHz: the timers' clock is twice APB1's, 84 MHz.
pub const PRESCALER: u16 = 84 - 1;

/// Starts the counter from zero.
pub fn start(timer: TIM2, rcc: &mut RCC) {
    TIM2::enable(rcc);
    TIM2::reset(rcc);
    timer.psc().write(|w| w.psc().set(PRESCALER));
    timer.arr().write(|w| w.arr().set(u32::MAX));
    // The prescaler takes effect with an update event.
    timer.egr().write(|w| w.ug().set_bit());
    timer.sr().write(|w| w.uif().clear_bit());
    timer.cr1().write(|w| w.cen().set_bit());
    HALF_PERIODS.store(0, Ordering::Relaxed);
}

fn registers() -> &'static tim2::RegisterBlock {
    // SAFETY: TIM2 is consumed by `start` and from then on only its counter is read, here; a read has no side effect.
    unsafe { &*TIM2::ptr() }
}

/// The counter: microseconds modulo 2³².
#[inline]
pub fn micros() -> u32 {
    registers().cnt().read().bits()
}

/// Now.
#[inline]
pub fn now() -> Instant {
    // In this order: a half period that is counted in between is seen by the parity.
    let half_periods = HALF_PERIODS.load(Ordering::Acquire);
    let counter = micros() ^ (half_periods & 1) << 31;
    Instant::from_ticks((u64::from(half_periods) << 31) + u64::from(counter))
}

/// Counts half periods; from one task only.
pub fn extend() {
    let half_periods = HALF_PERIODS.load(Ordering::Relaxed);
    if micros() >> 31 != half_periods & 1 {
        HALF_PERIODS.store(half_periods.wrapping_add(1), Ordering::Release);
    }
}

/// Polls `done` until it holds or `limit_us` have passed; whether it holds.
///
/// `done` is asked once more after the time, for a caller that was preempted beyond it.
pub fn wait_until(limit_us: u32, mut done: impl FnMut() -> bool) -> bool {
    let start = micros();
    loop {
        if done() {
            return true;
        }
        if micros().wrapping_sub(start) > limit_us {
            return done();
        }
    }
}

/// Waits at least `us` microseconds, at most one more (and what preemption takes).
pub fn delay_us(us: u32) {
    let start = micros();
    while micros().wrapping_sub(start) <= us {}
}
