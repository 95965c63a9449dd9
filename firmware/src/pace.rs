//! How the storage task waits: what works on the flash only says for how long, and the task keeps the one timer.
//!
//! A timer of the queue has to be dropped with whatever holds it. In the flash it would lie beneath some thirty futures of
//! sequential-storage and of `storage`, each with code to drop it: 1.4 KB.

use core::{
    convert::Infallible,
    future::{Future, poll_fn},
    marker::PhantomData,
    pin::{Pin, pin},
    sync::atomic::{AtomicU32, Ordering},
    task::Poll,
};

use rtic_monotonics::{
    Timebase,
    rtic_time::timer_queue::{Delay, Timeout, TimerQueue, TimerQueueBackend as _},
    systick::{SystickBackend, prelude::*},
};

use crate::Mono;

/// A time of the timer queue.
pub type Millisecond = <Mono as Timebase>::Instant;

/// What [`paced`] waits before it goes on, in milliseconds.
static PAUSE_MS: AtomicU32 = AtomicU32::new(0);

/// Lets the other tasks and interrupts of the same priority run.
pub fn yield_now() -> impl Future<Output = ()> {
    let mut yielded = false;
    poll_fn(move |context| {
        if core::mem::replace(&mut yielded, true) {
            return Poll::Ready(());
        }
        context.waker().wake_by_ref();
        Poll::Pending
    })
}

fn queue() -> &'static TimerQueue<SystickBackend> {
    SystickBackend::timer_queue()
}

/// Now. Not inlined: a look at SysTick and at the count of its wraps, thirty bytes at a dozen places.
#[inline(never)]
pub fn now() -> Millisecond {
    Mono::now()
}

/// Whether `instant` has come, as the queue sees it: the count wraps after 49.7 days, and instants compare as plain numbers, by which
/// one before the wrap would never come after it.
pub fn has_come(instant: Millisecond) -> bool {
    now().as_ticks().wrapping_sub(instant.as_ticks()) < 1 << 31
}

/// Until `instant`. Not `Mono::delay_until`, an async function around the same future.
pub fn until(instant: Millisecond) -> Delay<'static, SystickBackend> {
    queue().delay_until(instant.as_ticks())
}

/// Milliseconds of the queue until `ms` have passed: the one under way is no whole one.
pub const fn whole(ms: u32) -> u32 {
    ms + 1
}

/// When at least `ms` milliseconds will have passed.
pub fn after(ms: u32) -> Millisecond {
    now() + whole(ms).millis()
}

/// Until [`after`] `ms`.
pub fn at_least(ms: u32) -> Delay<'static, SystickBackend> {
    until(after(ms))
}

/// Until `event` or `instant`, whichever comes first.
pub fn until_event<F: Future>(
    instant: Millisecond,
    event: F,
) -> Timeout<'static, SystickBackend, F> {
    queue().timeout_at(instant.as_ticks(), event)
}

/// Leave to wait by [`Pace::pause`], which nobody but [`paced`] wakes from: it alone hands this out, and the lifetime keeps it
/// within.
#[derive(Clone, Copy)]
pub struct Pace<'a>(PhantomData<&'a ()>);

impl Pace<'_> {
    /// The time until the `ms`-th next millisecond begins; with 0 as [`yield_now`].
    pub fn pause(self, ms: u32) -> impl Future<Output = ()> {
        let mut said = false;
        poll_fn(move |_| {
            if core::mem::replace(&mut said, true) {
                return Poll::Ready(());
            }
            PAUSE_MS.store(ms, Ordering::Relaxed);
            Poll::Pending
        })
    }

    /// `work`, which waits by [`Pace::pause`] too, unless it has not ended `limit_ms` from now. Pinned by the caller: taken by
    /// value it would be held twice.
    pub fn limited(
        self,
        limit_ms: u32,
        mut work: Pin<&mut impl Future<Output = ()>>,
    ) -> impl Future<Output = ()> {
        let end = now() + limit_ms.millis();
        poll_fn(move |context| {
            if work.as_mut().poll(context).is_ready() || has_come(end) {
                Poll::Ready(())
            } else {
                Poll::Pending
            }
        })
    }
}

/// Does `work`, which waits by the [`Pace`] that it is given alone.
pub async fn paced(work: impl AsyncFnOnce(Pace<'_>) -> Infallible) {
    let mut work = pin!(work(Pace(PhantomData)));
    loop {
        poll_fn(|context| {
            let _ = work.as_mut().poll(context);
            Poll::Ready(())
        })
        .await;
        match PAUSE_MS.load(Ordering::Relaxed) {
            0 => yield_now().await,
            ms => until(now() + ms.millis()).await,
        }
    }
}
