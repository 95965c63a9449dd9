//! TIM4 (RM0090, section 18) as a clock that a pin stops: a 16-bit counter in gated mode, whose gate is channel 1.

use super::word::{check_width, merge, only_bits, part, period, unknown, unmodelled};
use super::{Context, Peripheral, Unmodelled};
use crate::time::Ticks;

const CEN: u32 = 1 << 0;
/// SMS = gated mode, TS = TI1FP1.
const GATED: u32 = 0b101 | 0b101 << 4;
/// CC1S: channel 1 is an input from TI1, without filter or prescaler.
const INPUT: u32 = 0b01;
const UPDATE: u32 = 1 << 0;

/// Up-counter that runs while its input is high.
///
/// The gate stops the prescaler as well (RM0090, figure of the block diagram: the trigger controller makes CK_PSC), so
/// parts of a count add up. *Assumed*: the resynchronisation of TI1 takes as long for a rising edge as for a falling one.
/// Not modelled: any other mode, flags, interrupts, an auto-reload value of 0, one changed while it counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tim4 {
    cr1: u32,
    smcr: u32,
    ccmr1: u32,
    psc: u16,
    psc_active: u16,
    auto_reload: u16,
    count: u16,
    phase: u32,
    at: Ticks,
    gate: bool,
}

impl Default for Tim4 {
    fn default() -> Self {
        Self::new()
    }
}

impl Tim4 {
    /// After reset: stopped at 0.
    pub const fn new() -> Self {
        Self {
            cr1: 0,
            smcr: 0,
            ccmr1: 0,
            psc: 0,
            psc_active: 0,
            auto_reload: u16::MAX,
            count: 0,
            phase: 0,
            at: Ticks(0),
            gate: false,
        }
    }

    /// The level of TI1.
    pub const fn gate(&self) -> bool {
        self.gate
    }

    /// TI1 changes now.
    pub fn set_gate(&mut self, high: bool, context: &mut Context<'_>) {
        self.advance(context);
        self.gate = high;
    }

    fn write_register(&mut self, register: u32, value: u32) -> Result<(), Unmodelled> {
        match register {
            0x00 => {
                only_bits("TIM4_CR1", value, CEN)?;
                if value & CEN != 0 && (self.smcr, self.ccmr1) != (GATED, INPUT) {
                    return Err(unmodelled("TIM4_CR1", "counting without a gate"));
                }
                self.cr1 = value;
            }
            0x08 => {
                only_bits("TIM4_SMCR", value, GATED)?;
                self.smcr = value;
            }
            0x14 => {
                only_bits("TIM4_EGR", value, UPDATE)?;
                if value & UPDATE != 0 {
                    (self.count, self.phase) = (0, 0);
                    self.psc_active = self.psc;
                }
            }
            0x18 => {
                only_bits("TIM4_CCMR1", value, INPUT)?;
                self.ccmr1 = value;
            }
            0x28 => {
                only_bits("TIM4_PSC", value, 0xFFFF)?;
                self.psc = u16::try_from(value).unwrap_or(u16::MAX);
            }
            0x2C => {
                only_bits("TIM4_ARR", value, 0xFFFF)?;
                let value = u16::try_from(value).unwrap_or(u16::MAX);
                // Without ARPE it works at once; a counter beyond it, or one that 0 blocks, is nothing the image wants.
                if value != self.auto_reload && self.cr1 & CEN != 0 {
                    return Err(unmodelled("TIM4_ARR", "another value while it counts"));
                }
                if value == 0 || value < self.count {
                    return Err(unmodelled("TIM4_ARR", "0, or less than the count"));
                }
                self.auto_reload = value;
            }
            _ => return Err(unknown("TIM4", register, "write")),
        }
        Ok(())
    }

    fn word(&self, register: u32) -> Result<u32, Unmodelled> {
        Ok(match register {
            0x00 => self.cr1,
            0x08 => self.smcr,
            // EGR is write-only.
            0x14 => 0,
            0x18 => self.ccmr1,
            0x24 => u32::from(self.count),
            0x28 => u32::from(self.psc),
            0x2C => u32::from(self.auto_reload),
            _ => return Err(unknown("TIM4", register, "read")),
        })
    }
}

impl Peripheral for Tim4 {
    fn read(
        &mut self,
        offset: u32,
        bytes: u8,
        context: &mut Context<'_>,
    ) -> Result<u32, Unmodelled> {
        check_width("TIM4", offset, bytes, 2)?;
        self.advance(context);
        Ok(part(self.word(offset & !3)?, offset, bytes))
    }

    fn write(
        &mut self,
        offset: u32,
        bytes: u8,
        value: u32,
        context: &mut Context<'_>,
    ) -> Result<(), Unmodelled> {
        check_width("TIM4", offset, bytes, 2)?;
        self.advance(context);
        let register = offset & !3;
        let value = merge(self.word(register)?, offset, bytes, value);
        self.write_register(register, value)
    }

    /// It asks for nothing by itself.
    fn next_event(&self) -> Option<Ticks> {
        None
    }

    fn advance(&mut self, context: &mut Context<'_>) {
        if self.cr1 & CEN == 0 || !self.gate {
            self.at = context.now;
            return;
        }
        let clock = period(context.clocks.apb1_timers);
        let clocks = context.now.since(self.at).0 / clock.0;
        self.at += Ticks(clocks * clock.0);
        let per_count = u64::from(self.psc_active) + 1;
        let total = u64::from(self.phase) + clocks;
        let counts = u64::from(self.count) + total / per_count;
        self.phase = (total % per_count) as u32;
        self.count = (counts % (u64::from(self.auto_reload) + 1)) as u16;
    }

    fn reset(&mut self, context: &mut Context<'_>) {
        *self = Self {
            at: context.now,
            gate: self.gate,
            ..Self::new()
        };
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

    use super::super::test_world::World;
    use super::*;

    const CR1: u32 = 0x00;
    const SMCR: u32 = 0x08;
    const EGR: u32 = 0x14;
    const CCMR1: u32 = 0x18;
    const CNT: u32 = 0x24;
    const PSC: u32 = 0x28;
    const ARR: u32 = 0x2C;

    fn started(world: &mut World) -> Tim4 {
        let mut timer = Tim4::new();
        world.write(&mut timer, PSC, 83);
        world.write(&mut timer, CCMR1, INPUT);
        world.write(&mut timer, SMCR, GATED);
        world.write(&mut timer, EGR, UPDATE);
        world.write(&mut timer, CR1, CEN);
        timer
    }

    #[test]
    fn counts_while_the_gate_is_high() {
        let mut world = World::default();
        let mut timer = started(&mut world);
        world.now += Ticks::from_micros(50);
        assert_eq!(world.read(&mut timer, CNT), 0);
        timer.set_gate(true, &mut world.context());
        world.now += Ticks::from_micros(30);
        assert_eq!(world.read(&mut timer, CNT), 30);
        timer.set_gate(false, &mut world.context());
        world.now += Ticks::from_millis(5);
        assert_eq!(world.read(&mut timer, CNT), 30);
        // It wraps.
        timer.set_gate(true, &mut world.context());
        world.now += Ticks::from_micros(65_536);
        assert_eq!(world.read(&mut timer, CNT), 30);
    }

    #[test]
    fn it_begins_anew_after_its_auto_reload_value() {
        let mut world = World::default();
        let mut timer = Tim4::new();
        assert_eq!(world.read(&mut timer, ARR), 0xFFFF);
        let mut timer = started(&mut world);
        assert!(world.refuses(&mut timer, ARR, 99), "while it counts");
        world.write(&mut timer, ARR, 0xFFFF);
        world.write(&mut timer, CR1, 0);
        assert!(world.refuses(&mut timer, ARR, 0));
        world.write(&mut timer, ARR, 99);
        world.write(&mut timer, CR1, CEN);
        timer.set_gate(true, &mut world.context());
        world.now += Ticks::from_micros(230);
        assert_eq!(world.read(&mut timer, CNT), 30);
        timer.reset(&mut world.context());
        assert_eq!(world.read(&mut timer, ARR), 0xFFFF);
    }

    #[test]
    fn pulses_shorter_than_a_count_add_up() {
        let mut world = World::default();
        let mut timer = started(&mut world);
        for _ in 0..1_000 {
            timer.set_gate(true, &mut world.context());
            world.now += Ticks(100);
            timer.set_gate(false, &mut world.context());
            world.now += Ticks::from_micros(3);
        }
        // 100,000 of 336 units each.
        assert_eq!(world.read(&mut timer, CNT), 297);
    }

    #[test]
    fn what_is_missing_is_refused() {
        let mut world = World::default();
        let mut timer = Tim4::new();
        assert!(world.refuses(&mut timer, CR1, CEN), "no gate");
        assert!(world.refuses(&mut timer, CR1, 1 << 2));
        assert!(world.refuses(&mut timer, SMCR, 0b110));
        assert!(world.refuses(&mut timer, CCMR1, 0b10));
        for offset in [0x04, 0x0C, 0x20, 0x34] {
            assert!(world.refuses(&mut timer, offset, 0));
        }
    }

    #[test]
    fn a_reset_leaves_the_pin_alone() {
        let mut world = World::default();
        let mut timer = started(&mut world);
        timer.set_gate(true, &mut world.context());
        world.now += Ticks::from_micros(9);
        timer.reset(&mut world.context());
        assert_eq!(world.read(&mut timer, CNT), 0);
        assert!(timer.gate());
    }
}
