//! TIM2 (RM0090, section 18): a 32-bit counter that counts up. Its count is worked out when somebody asks.

use super::word::{check_width, merge, only_bits, part, period, refuse_bits, unknown, unmodelled};
use super::{Context, Peripheral, Unmodelled};
use crate::time::Ticks;

/// Its interrupt (RM0090, table 62).
const IRQ: u16 = 28;

const CR1_CEN: u32 = 1 << 0;
const CR1_UDIS: u32 = 1 << 1;
const CR1_URS: u32 = 1 << 2;
const CR1_ARPE: u32 = 1 << 7;
const CR1_MODELLED: u32 = CR1_CEN | CR1_UDIS | CR1_URS | CR1_ARPE;
const UPDATE: u32 = 1 << 0;
/// CC1IF … CC4IF. The compare registers are 0 and the channels in output mode, so the counter matches them whenever it
/// gets to 0 (RM0090, `TIMx_SR`).
const MATCHES: u32 = 0x1E;

/// Up-counter with prescaler and auto-reload.
///
/// Not modelled: down and centre-aligned counting, one-pulse mode, capture and compare, triggers, master and slave modes,
/// DMA. The timer clock must not change between two calls: the bus calls [`Peripheral::advance`] when clocks change.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tim2 {
    cr1: u32,
    dier: u32,
    sr: u32,
    /// As written; the counter uses what the last update event took over.
    psc: u32,
    psc_active: u32,
    arr: u32,
    arr_active: u32,
    /// Count and phase of the prescaler at `at`.
    count: u32,
    phase: u32,
    at: Ticks,
    clock: Ticks,
}

impl Default for Tim2 {
    fn default() -> Self {
        Self::new()
    }
}

impl Tim2 {
    /// After reset: stopped at 0, counting to 2³² − 1.
    pub const fn new() -> Self {
        Self {
            cr1: 0,
            dier: 0,
            sr: 0,
            psc: 0,
            psc_active: 0,
            arr: u32::MAX,
            arr_active: u32::MAX,
            count: 0,
            phase: 0,
            at: Ticks(0),
            clock: Ticks(1),
        }
    }

    /// Puts the counter to `count`, as if so much time had passed (F23).
    pub const fn preset(&mut self, count: u32) {
        self.count = count;
    }

    /// RM0090, `TIMx_ARR`: "The counter is blocked while the auto-reload value is null."
    const fn runs(&self) -> bool {
        self.cr1 & CR1_CEN != 0 && self.arr_active != 0
    }

    const fn clocks_per_count(&self) -> u64 {
        self.psc_active as u64 + 1
    }

    /// Timer clocks from `at` to the next overflow.
    const fn clocks_to_overflow(&self) -> u64 {
        (self.arr_active as u64 - self.count as u64 + 1) * self.clocks_per_count()
            - self.phase as u64
    }

    /// The preloaded values become active.
    const fn take_over(&mut self) {
        self.psc_active = self.psc;
        self.arr_active = self.arr;
    }

    const fn overflow(&mut self) {
        self.count = 0;
        self.phase = 0;
        self.sr |= MATCHES;
        if self.cr1 & CR1_UDIS == 0 {
            self.sr |= UPDATE;
            self.take_over();
        }
    }

    /// Counts up to `now`.
    fn count_to(&mut self, now: Ticks, clock: Ticks) {
        let mut clocks = now.since(self.at).0 / self.clock.0;
        if !self.runs() {
            self.at = self.at.max(now);
            self.clock = clock;
            return;
        }
        self.at += Ticks(clocks * self.clock.0);
        while self.runs() {
            let to_overflow = self.clocks_to_overflow();
            if clocks < to_overflow {
                let total = u64::from(self.phase) + clocks;
                self.count += (total / self.clocks_per_count()) as u32;
                self.phase = (total % self.clocks_per_count()) as u32;
                break;
            }
            clocks -= to_overflow;
            self.overflow();
            // From here on one period is like the other.
            clocks %= if self.runs() {
                self.clocks_to_overflow()
            } else {
                1
            };
        }
        if clock != self.clock {
            self.clock = clock;
            self.at = self.at.max(now);
        }
    }

    fn set_line(&self, context: &Context<'_>) {
        context
            .interrupts
            .set(IRQ, self.sr & self.dier & UPDATE != 0);
    }

    fn write_cr1(&mut self, value: u32, context: &Context<'_>) -> Result<(), Unmodelled> {
        only_bits("TIM2_CR1", value, CR1_MODELLED)?;
        if value & !self.cr1 & CR1_CEN != 0 {
            // RM0090, 18.3.2: the counter starts one clock after CEN.
            self.at = context.now + period(context.clocks.apb1_timers);
            self.clock = period(context.clocks.apb1_timers);
        }
        self.cr1 = value;
        Ok(())
    }

    fn generate_update(&mut self) {
        self.count = 0;
        self.phase = 0;
        self.sr |= MATCHES;
        if self.cr1 & CR1_UDIS == 0 {
            self.take_over();
            if self.cr1 & CR1_URS == 0 {
                self.sr |= UPDATE;
            }
        }
    }

    fn write_arr(&mut self, value: u32) -> Result<(), Unmodelled> {
        self.arr = value;
        if self.cr1 & CR1_ARPE == 0 {
            self.arr_active = value;
        }
        self.check_count("TIM2_ARR")
    }

    fn check_count(&self, register: &str) -> Result<(), Unmodelled> {
        if self.count > self.arr_active && self.arr_active != 0 {
            return Err(unmodelled(register, "counter beyond the auto-reload value"));
        }
        Ok(())
    }

    const fn word(&self, offset: u32) -> Option<u32> {
        Some(match offset {
            0x00 => self.cr1,
            0x0C => self.dier,
            0x10 => self.sr,
            // EGR is write-only.
            0x14 => 0,
            0x24 => self.count,
            0x28 => self.psc,
            0x2C => self.arr,
            _ => return None,
        })
    }
}

impl Peripheral for Tim2 {
    fn read(
        &mut self,
        offset: u32,
        bytes: u8,
        context: &mut Context<'_>,
    ) -> Result<u32, Unmodelled> {
        check_width("TIM2", offset, bytes, 2)?;
        self.advance(context);
        let word = self
            .word(offset & !3)
            .ok_or_else(|| unknown("TIM2", offset, "read"))?;
        Ok(part(word, offset, bytes))
    }

    fn write(
        &mut self,
        offset: u32,
        bytes: u8,
        value: u32,
        context: &mut Context<'_>,
    ) -> Result<(), Unmodelled> {
        check_width("TIM2", offset, bytes, 2)?;
        self.advance(context);
        let register = offset & !3;
        let word = self
            .word(register)
            .ok_or_else(|| unknown("TIM2", offset, "write"))?;
        let value = merge(word, offset, bytes, value);
        match register {
            0x00 => self.write_cr1(value, context)?,
            0x0C => {
                only_bits("TIM2_DIER", value, UPDATE)?;
                self.dier = value;
            }
            // Flags are cleared by 0; 1 leaves them.
            0x10 => self.sr &= value,
            0x14 => {
                refuse_bits("TIM2_EGR", value & !UPDATE)?;
                if value & UPDATE != 0 {
                    self.generate_update();
                }
            }
            0x24 => {
                self.count = value;
                self.check_count("TIM2_CNT")?;
            }
            0x28 => {
                only_bits("TIM2_PSC", value, 0xFFFF)?;
                self.psc = value;
            }
            _ => self.write_arr(value)?,
        }
        self.set_line(context);
        Ok(())
    }

    fn next_event(&self) -> Option<Ticks> {
        let waits = self.runs()
            && self.dier & UPDATE != 0
            && self.sr & UPDATE == 0
            && self.cr1 & CR1_UDIS == 0;
        waits.then(|| self.at + Ticks(self.clocks_to_overflow() * self.clock.0))
    }

    fn advance(&mut self, context: &mut Context<'_>) {
        self.count_to(context.now, period(context.clocks.apb1_timers));
        self.set_line(context);
    }

    fn reset(&mut self, context: &mut Context<'_>) {
        *self = Self::new();
        self.at = context.now;
        self.set_line(context);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

    use proptest::prelude::*;

    use super::super::test_world::World;
    use super::*;

    const CR1: u32 = 0x00;
    const DIER: u32 = 0x0C;
    const SR: u32 = 0x10;
    const EGR: u32 = 0x14;
    const CNT: u32 = 0x24;
    const PSC: u32 = 0x28;
    const ARR: u32 = 0x2C;
    /// One clock of 84 MHz.
    const CLOCK: u64 = 4;

    fn started(world: &mut World, prescaler: u32, reload: u32, cr1: u32) -> Tim2 {
        let mut timer = Tim2::new();
        world.write(&mut timer, PSC, prescaler);
        world.write(&mut timer, ARR, reload);
        world.write(&mut timer, EGR, 1);
        world.write(&mut timer, SR, 0);
        world.write(&mut timer, CR1, cr1 | CR1_CEN);
        // The counter starts one clock later.
        world.now += Ticks(CLOCK);
        timer
    }

    #[test]
    fn reset_values_are_the_manuals() {
        let mut world = World::default();
        let mut timer = Tim2::new();
        for (offset, value) in [
            (CR1, 0),
            (DIER, 0),
            (SR, 0),
            (CNT, 0),
            (PSC, 0),
            (ARR, u32::MAX),
        ] {
            assert_eq!(world.read(&mut timer, offset), value);
        }
        assert_eq!(timer.next_event(), None);
    }

    #[test]
    fn counts_microseconds_from_84_mhz() {
        let mut world = World {
            now: Ticks(12_345),
            ..World::default()
        };
        let mut timer = started(&mut world, 83, u32::MAX, 0);
        let start = world.now;
        for (after, count) in [
            (0, 0),
            (335, 0),
            (336, 1),
            (336 * 1_000, 1_000),
            (336 * 1_000_000 - 1, 999_999),
            (336 * 0xFFFF_FFFF, u32::MAX),
            (336 * 0x1_0000_0000 - 1, u32::MAX),
            (336 * 0x1_0000_0000, 0),
            (336 * 0x3_0000_0005, 5),
        ] {
            world.now = start + Ticks(after);
            assert_eq!(world.read(&mut timer, CNT), count, "after {after}");
        }
        assert_ne!(world.read(&mut timer, SR) & UPDATE, 0);
    }

    #[test]
    fn prescaler_waits_for_an_update() {
        let mut world = World::default();
        let mut timer = started(&mut world, 0, 9, 0);
        world.write(&mut timer, PSC, 1);
        world.now += Ticks(9 * CLOCK);
        assert_eq!(world.read(&mut timer, CNT), 9, "still every clock");
        assert_eq!(world.read(&mut timer, SR) & UPDATE, 0);
        world.now += Ticks(CLOCK);
        assert_eq!(world.read(&mut timer, CNT), 0);
        assert_eq!(world.read(&mut timer, SR) & UPDATE, UPDATE);
        world.now += Ticks(7 * CLOCK);
        assert_eq!(world.read(&mut timer, CNT), 3, "now every other");
    }

    #[test]
    fn auto_reload_is_preloaded_with_arpe_only() {
        for (arpe, wraps_at) in [(0, 5), (CR1_ARPE, 9)] {
            let mut world = World::default();
            let mut timer = started(&mut world, 0, 9, arpe);
            world.write(&mut timer, ARR, 5);
            world.now += Ticks(wraps_at * CLOCK);
            assert_eq!(u64::from(world.read(&mut timer, CNT)), wraps_at);
            world.now += Ticks(CLOCK);
            assert_eq!(world.read(&mut timer, CNT), 0);
            world.now += Ticks(5 * CLOCK);
            assert_eq!(world.read(&mut timer, CNT), 5);
            world.now += Ticks(CLOCK);
            assert_eq!(world.read(&mut timer, CNT), 0);
        }
    }

    #[test]
    fn update_generation_heeds_urs_and_udis() {
        for (cr1, flag, taken) in [(0, 1, true), (CR1_URS, 0, true), (CR1_UDIS, 0, false)] {
            let mut world = World::default();
            let mut timer = Tim2::new();
            world.write(&mut timer, CR1, cr1);
            world.write(&mut timer, CNT, 77);
            world.write(&mut timer, PSC, 3);
            world.write(&mut timer, EGR, 1);
            assert_eq!(world.read(&mut timer, CNT), 0);
            assert_eq!(world.read(&mut timer, SR) & UPDATE, flag);
            assert_eq!(timer.psc_active == 3, taken);
        }
    }

    #[test]
    fn update_interrupt_comes_at_the_overflow() {
        let mut world = World::default();
        let mut timer = started(&mut world, 83, 999, 0);
        assert_eq!(timer.next_event(), None, "nobody waits for it");
        world.write(&mut timer, DIER, 1);
        let due = world.now + Ticks::from_millis(1);
        assert_eq!(timer.next_event(), Some(due));
        world.run_until(&mut timer, due - Ticks(1));
        assert!(!world.interrupts.is_asserted(IRQ));
        world.run_until(&mut timer, due);
        assert!(world.interrupts.is_asserted(IRQ));
        assert_eq!(timer.next_event(), None, "the flag is up already");
        world.write(&mut timer, SR, !1);
        assert!(!world.interrupts.is_asserted(IRQ));
        assert_eq!(timer.next_event(), Some(due + Ticks::from_millis(1)));
    }

    #[test]
    fn stopped_counter_keeps_its_count() {
        let mut world = World::default();
        let mut timer = started(&mut world, 0, u32::MAX, 0);
        world.now += Ticks(10 * CLOCK);
        world.write(&mut timer, CR1, 0);
        world.now += Ticks(1_000);
        assert_eq!(world.read(&mut timer, CNT), 10);
        world.write(&mut timer, CR1, 1);
        world.now += Ticks(CLOCK + 3 * CLOCK);
        assert_eq!(world.read(&mut timer, CNT), 13);
        assert_eq!(timer.read(CNT, 2, &mut world.context()).unwrap(), 13);
    }

    #[test]
    fn no_reload_value_blocks_the_counter() {
        let mut world = World::default();
        let mut timer = started(&mut world, 0, 0, 0);
        world.now += Ticks(1_000);
        assert_eq!(world.read(&mut timer, CNT), 0);
    }

    #[test]
    fn clock_change_counts_both_parts() {
        let mut world = World::default();
        let mut timer = started(&mut world, 0, u32::MAX, 0);
        world.now += Ticks(100 * CLOCK);
        world.clocks.apb1_timers = 42_000_000;
        timer.advance(&mut world.context());
        world.now += Ticks(100 * 2 * CLOCK);
        assert_eq!(world.read(&mut timer, CNT), 200);
    }

    #[test]
    fn what_is_missing_is_refused() {
        let mut world = World::default();
        let mut timer = Tim2::new();
        for bit in [3, 4, 5, 6, 8, 9] {
            assert!(world.refuses(&mut timer, CR1, 1 << bit));
        }
        assert!(world.refuses(&mut timer, DIER, 1 << 1));
        assert!(world.refuses(&mut timer, EGR, 1 << 1));
        assert!(world.refuses(&mut timer, PSC, 0x1_0000));
        for offset in [0x04, 0x08, 0x18, 0x20, 0x34, 0x48, 0x50] {
            assert!(world.refuses(&mut timer, offset, 0));
        }
        assert!(timer.read(CNT, 1, &mut world.context()).is_err());
        world.write(&mut timer, CNT, 50);
        assert!(world.refuses(&mut timer, ARR, 40));
    }

    proptest! {
        /// However often and whenever it is looked at, the count is the elapsed clocks by the manual's formula.
        #[test]
        fn count_does_not_depend_on_looking(
            prescaler in 0u32..100, reload in 1u32..500,
            steps in proptest::collection::vec(0u64..200_000, 1..30),
        ) {
            let mut world = World::default();
            let mut timer = started(&mut world, prescaler, reload, 0);
            let start = world.now;
            for step in steps {
                world.now += Ticks(step);
                let counts = world.now.since(start).0 / CLOCK / u64::from(prescaler + 1);
                let count = world.read(&mut timer, CNT);
                prop_assert_eq!(u64::from(count), counts % u64::from(reload + 1));
                let wrapped = counts > u64::from(reload);
                prop_assert_eq!(world.read(&mut timer, SR) & UPDATE != 0, wrapped);
            }
        }
    }
}
