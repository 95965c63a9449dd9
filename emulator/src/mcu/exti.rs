//! External interrupts (RM0090, section 12): edges at pins become pending bits, and those interrupts.

use super::syscfg::Syscfg;
use super::word::{check_width, only_bits, refuse_bits, unknown};
use super::{Context, Interrupts, Peripheral, Unmodelled};
use crate::outside::PORTS;
use crate::time::Ticks;

/// Lines 0 … 15 are pins.
const PIN_LINES: u32 = 0xFFFF;
/// Lines 0 … 22 exist; those from 16 on belong to PVD, RTC and USB.
const LINES: u32 = 0x007F_FFFF;

/// Interrupt and its lines (RM0090, table 62).
const INTERRUPTS: [(u16, u32); 7] = [
    (6, 1 << 0),
    (7, 1 << 1),
    (8, 1 << 2),
    (9, 1 << 3),
    (10, 1 << 4),
    (23, 0x03E0),
    (40, 0xFC00),
];

/// Its registers.
///
/// A pending bit is set by a selected edge whether or not its interrupt is masked, and stays until 1 is written to it.
/// Not modelled: events (EMR) and the lines from 16 on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Exti {
    imr: u32,
    rtsr: u32,
    ftsr: u32,
    swier: u32,
    pr: u32,
}

impl Exti {
    /// After reset: everything masked, no edge selected.
    pub const fn new() -> Self {
        Self {
            imr: 0,
            rtsr: 0,
            ftsr: 0,
            swier: 0,
            pr: 0,
        }
    }

    fn ask(&self, interrupts: &Interrupts) {
        for (irq, lines) in INTERRUPTS {
            interrupts.set(irq, self.pr & self.imr & lines != 0);
        }
    }

    /// Pins went from the levels `old` to `new`, one edge each.
    pub fn on_levels(
        &mut self,
        old: [u16; PORTS],
        new: [u16; PORTS],
        syscfg: &Syscfg,
        interrupts: &Interrupts,
    ) {
        self.on_edges(
            std::array::from_fn(|port| !old[port] & new[port]),
            std::array::from_fn(|port| old[port] & !new[port]),
            syscfg,
            interrupts,
        );
    }

    /// Pins had edges since the last call; one that had a pulse is in both sets.
    pub fn on_edges(
        &mut self,
        rising: [u16; PORTS],
        falling: [u16; PORTS],
        syscfg: &Syscfg,
        interrupts: &Interrupts,
    ) {
        if rising == [0; PORTS] && falling == [0; PORTS] {
            return;
        }
        let at_lines = |edges: [u16; PORTS]| {
            (0..16)
                .filter(|line| {
                    edges
                        .get(syscfg.port_of_line(*line))
                        .is_some_and(|port| port >> line & 1 != 0)
                })
                .fold(0, |lines, line| lines | 1 << line)
        };
        self.pr |= at_lines(rising) & self.rtsr | at_lines(falling) & self.ftsr;
        self.ask(interrupts);
    }
}

impl Peripheral for Exti {
    fn read(
        &mut self,
        offset: u32,
        bytes: u8,
        _context: &mut Context<'_>,
    ) -> Result<u32, Unmodelled> {
        check_width("EXTI", offset, bytes, 4)?;
        Ok(match offset {
            0x00 => self.imr,
            // EMR: no event can be enabled.
            0x04 => 0,
            0x08 => self.rtsr,
            0x0C => self.ftsr,
            0x10 => self.swier,
            0x14 => self.pr,
            _ => return Err(unknown("EXTI", offset, "read")),
        })
    }

    fn write(
        &mut self,
        offset: u32,
        bytes: u8,
        value: u32,
        context: &mut Context<'_>,
    ) -> Result<(), Unmodelled> {
        check_width("EXTI", offset, bytes, 4)?;
        match offset {
            0x00 => {
                only_bits("EXTI_IMR", value, PIN_LINES)?;
                self.imr = value;
            }
            0x04 => refuse_bits("EXTI_EMR", value)?,
            0x08 => {
                only_bits("EXTI_RTSR", value, PIN_LINES)?;
                self.rtsr = value;
            }
            0x0C => {
                only_bits("EXTI_FTSR", value, PIN_LINES)?;
                self.ftsr = value;
            }
            0x10 => {
                only_bits("EXTI_SWIER", value, PIN_LINES)?;
                // A 1 over a 0 asks, if the line is not masked; the bit stays until PR is cleared.
                self.pr |= value & !self.swier & self.imr;
                self.swier |= value;
            }
            0x14 => {
                // Bits of lines that are never pending have nothing to clear.
                only_bits("EXTI_PR", value, LINES)?;
                self.pr &= !value;
                self.swier &= !value;
            }
            _ => return Err(unknown("EXTI", offset, "write")),
        }
        self.ask(context.interrupts);
        Ok(())
    }

    fn next_event(&self) -> Option<Ticks> {
        None
    }

    fn advance(&mut self, _context: &mut Context<'_>) {}

    fn reset(&mut self, context: &mut Context<'_>) {
        *self = Self::new();
        self.ask(context.interrupts);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

    use proptest::prelude::*;

    use super::super::test_world::World;
    use super::*;

    const IMR: u32 = 0x00;
    const RTSR: u32 = 0x08;
    const FTSR: u32 = 0x0C;
    const SWIER: u32 = 0x10;
    const PR: u32 = 0x14;

    fn levels(world: &World, exti: &mut Exti, syscfg: &Syscfg, old: [u16; 3], new: [u16; 3]) {
        exti.on_levels(old, new, syscfg, &world.interrupts);
    }

    #[test]
    fn every_line_asks_for_its_interrupt() {
        for line in 0..16_u32 {
            let mut world = World::default();
            let mut exti = Exti::new();
            world.write(&mut exti, IMR, 1 << line);
            world.write(&mut exti, RTSR, 1 << line);
            levels(&world, &mut exti, &Syscfg::new(), [0; 3], [1 << line, 0, 0]);
            let irq = match line {
                0..=4 => 6 + u16::try_from(line).unwrap(),
                5..=9 => 23,
                _ => 40,
            };
            for other in 0..96 {
                assert_eq!(
                    world.interrupts.is_asserted(other),
                    other == irq,
                    "line {line}"
                );
            }
            world.write(&mut exti, PR, 1 << line);
            assert!(!world.interrupts.is_asserted(irq));
            assert_eq!(world.read(&mut exti, PR), 0);
        }
    }

    #[test]
    fn writing_one_clears_that_bit_only() {
        let mut world = World::default();
        let mut exti = Exti::new();
        world.write(&mut exti, FTSR, 0x11);
        levels(&world, &mut exti, &Syscfg::new(), [0x11, 0, 0], [0; 3]);
        assert_eq!(world.read(&mut exti, PR), 0x11);
        world.write(&mut exti, PR, 0x01);
        assert_eq!(world.read(&mut exti, PR), 0x10);
        world.write(&mut exti, PR, 0);
        assert_eq!(world.read(&mut exti, PR), 0x10);
    }

    #[test]
    fn masked_edge_asks_when_it_is_unmasked() {
        let mut world = World::default();
        let mut exti = Exti::new();
        world.write(&mut exti, RTSR, 1);
        levels(&world, &mut exti, &Syscfg::new(), [0; 3], [1, 0, 0]);
        assert!(!world.interrupts.is_asserted(6));
        world.write(&mut exti, IMR, 1);
        assert!(world.interrupts.is_asserted(6));
        world.write(&mut exti, IMR, 0);
        assert!(!world.interrupts.is_asserted(6));
        assert_eq!(world.read(&mut exti, PR), 1);
    }

    #[test]
    fn pulse_between_two_looks_is_not_lost() {
        let mut world = World::default();
        let mut exti = Exti::new();
        world.write(&mut exti, FTSR, 1);
        exti.on_edges([1, 0, 0], [1, 0, 0], &Syscfg::new(), &world.interrupts);
        assert_eq!(world.read(&mut exti, PR), 1);
    }

    #[test]
    fn software_asks_for_unmasked_lines() {
        let mut world = World::default();
        let mut exti = Exti::new();
        world.write(&mut exti, IMR, 1 << 4);
        world.write(&mut exti, SWIER, 1 << 4 | 1 << 5);
        assert_eq!(world.read(&mut exti, PR), 1 << 4);
        assert!(world.interrupts.is_asserted(10));
        world.write(&mut exti, PR, 1 << 4);
        assert_eq!(world.read(&mut exti, SWIER), 1 << 5);
        world.write(&mut exti, SWIER, 1 << 4);
        assert_eq!(world.read(&mut exti, PR), 1 << 4);
    }

    #[test]
    fn what_is_missing_is_refused() {
        let mut world = World::default();
        let mut exti = Exti::new();
        assert!(world.refuses(&mut exti, IMR, 1 << 16));
        assert!(world.refuses(&mut exti, 0x04, 1));
        assert!(world.refuses(&mut exti, RTSR, 1 << 22));
        assert!(world.refuses(&mut exti, 0x18, 0));
        assert!(exti.read(PR, 2, &mut world.context()).is_err());
    }

    #[test]
    fn reset_lets_go_of_the_interrupts() {
        let mut world = World::default();
        let mut exti = Exti::new();
        world.write(&mut exti, IMR, 1);
        world.write(&mut exti, SWIER, 1);
        exti.reset(&mut world.context());
        assert!(!world.interrupts.is_asserted(6));
        for offset in [IMR, RTSR, FTSR, SWIER, PR] {
            assert_eq!(world.read(&mut exti, offset), 0);
        }
    }

    proptest! {
        /// Any sequence of levels, of selections and of clearing: a bit is pending if and only if an edge that was selected
        /// at its time came to the line's port since it was last cleared.
        #[test]
        fn pending_is_a_selected_edge_since_cleared(
            ports in proptest::collection::vec(0usize..3, 16),
            steps in proptest::collection::vec(
                (any::<[u16; 3]>(), any::<u16>(), any::<u16>(), any::<u16>(), 0u8..4), 1..40),
        ) {
            let mut world = World::default();
            let mut exti = Exti::new();
            let mut syscfg = Syscfg::new();
            for register in 0..4 {
                let word = (0..4).fold(0, |word, field| {
                    word | u32::try_from(ports[4 * register + field]).unwrap() << (4 * field)
                });
                world.write(&mut syscfg, 0x08 + 4 * u32::try_from(register).unwrap(), word);
            }
            let (mut rising, mut falling) = (0, 0);
            let mut old = [0; 3];
            let mut expected = [false; 16];
            for (new, first, second, third, what) in steps {
                match what {
                    0 => {
                        (rising, falling) = (first, second);
                        world.write(&mut exti, RTSR, u32::from(rising));
                        world.write(&mut exti, FTSR, u32::from(falling));
                    }
                    1 => {
                        world.write(&mut exti, PR, u32::from(third));
                        for (line, pending) in expected.iter_mut().enumerate() {
                            *pending &= third >> line & 1 == 0;
                        }
                    }
                    _ => {
                        exti.on_levels(old, new, &syscfg, &world.interrupts);
                        for (line, pending) in expected.iter_mut().enumerate() {
                            let at = |word: u16| word >> line & 1 != 0;
                            let (before, after) = (at(old[ports[line]]), at(new[ports[line]]));
                            *pending |= before != after && at(if after { rising } else { falling });
                        }
                        old = new;
                    }
                }
                let pr = world.read(&mut exti, PR);
                for (line, pending) in expected.iter().enumerate() {
                    prop_assert_eq!(pr >> line & 1 != 0, *pending, "line {}", line);
                }
            }
        }
    }
}
