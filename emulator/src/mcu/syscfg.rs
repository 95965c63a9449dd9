//! System configuration controller (RM0090, section 9): which port an external interrupt line belongs to.

use super::word::{check_width, merge, only_bits, part, refuse_bits, unknown, unmodelled};
use super::{Context, Peripheral, Unmodelled};
use crate::outside::PORTS;
use crate::time::Ticks;

/// Its registers.
///
/// Not modelled: remapping of address 0, the Ethernet PHY's choice, the compensation cell, and lines on ports that the
/// package does not have.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Syscfg {
    exticr: [u32; 4],
}

impl Syscfg {
    /// After reset: every line belongs to port A.
    pub const fn new() -> Self {
        Self { exticr: [0; 4] }
    }

    /// The port of external interrupt line 0 … 15.
    pub const fn port_of_line(&self, line: usize) -> usize {
        (self.exticr[line / 4] >> (4 * (line % 4)) & 0xF) as usize
    }
}

impl Peripheral for Syscfg {
    fn read(
        &mut self,
        offset: u32,
        bytes: u8,
        _context: &mut Context<'_>,
    ) -> Result<u32, Unmodelled> {
        check_width("SYSCFG", offset, bytes, 1)?;
        let word = match offset & !3 {
            // Flash at address 0 with BOOT0 low; PMC; compensation cell off.
            0x00 | 0x04 | 0x20 => 0,
            0x08 => self.exticr[0],
            0x0C => self.exticr[1],
            0x10 => self.exticr[2],
            0x14 => self.exticr[3],
            _ => return Err(unknown("SYSCFG", offset, "read")),
        };
        Ok(part(word, offset, bytes))
    }

    fn write(
        &mut self,
        offset: u32,
        bytes: u8,
        value: u32,
        _context: &mut Context<'_>,
    ) -> Result<(), Unmodelled> {
        check_width("SYSCFG", offset, bytes, 1)?;
        let index = match offset & !3 {
            0x00 => return refuse_bits("SYSCFG_MEMRMP", value),
            0x04 => return refuse_bits("SYSCFG_PMC", value),
            0x20 => return refuse_bits("SYSCFG_CMPCR", value),
            0x08 => 0,
            0x0C => 1,
            0x10 => 2,
            0x14 => 3,
            _ => return Err(unknown("SYSCFG", offset, "write")),
        };
        let name = format!("SYSCFG_EXTICR{}", index + 1);
        let word = merge(self.exticr[index], offset, bytes, value);
        only_bits(&name, word, 0xFFFF)?;
        if (0..4).any(|line| (word >> (4 * line) & 0xF) as usize >= PORTS) {
            return Err(unmodelled(name, "line on a port beyond C"));
        }
        self.exticr[index] = word;
        Ok(())
    }

    fn next_event(&self) -> Option<Ticks> {
        None
    }

    fn advance(&mut self, _context: &mut Context<'_>) {}

    fn reset(&mut self, _context: &mut Context<'_>) {
        *self = Self::new();
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

    use super::super::test_world::World;
    use super::*;

    #[test]
    fn each_line_has_its_field() {
        for line in 0..16 {
            for port in 0..PORTS {
                let mut world = World::default();
                let mut syscfg = Syscfg::new();
                let offset = 0x08 + 4 * (line / 4);
                let field = u32::try_from(port).unwrap() << (4 * (line % 4));
                world.write(&mut syscfg, offset, field);
                assert_eq!(world.read(&mut syscfg, offset), field);
                for other in 0..16 {
                    let expected = if other == line { port } else { 0 };
                    assert_eq!(syscfg.port_of_line(other as usize), expected);
                }
            }
        }
    }

    #[test]
    fn what_is_missing_is_refused() {
        let mut world = World::default();
        let mut syscfg = Syscfg::new();
        assert!(world.refuses(&mut syscfg, 0x08, 3));
        assert!(world.refuses(&mut syscfg, 0x08, 0x1_0000));
        assert!(world.refuses(&mut syscfg, 0x00, 1));
        assert!(world.refuses(&mut syscfg, 0x20, 1));
        assert!(world.refuses(&mut syscfg, 0x18, 0));
        assert_eq!(world.read(&mut syscfg, 0x08), 0);
    }
}
