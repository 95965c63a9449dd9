//! SPI1 and SPI2 as masters, full duplex, eight bits (RM0090, 28.3 and 28.5).
//!
//! Modelled: transmit buffer and shift register with their flags, overrun, mode fault by SSI, interrupts. A byte takes
//! eight clocks, and one that waits in the buffer follows without a gap. Not modelled: slave, NSS as an input, one data
//! line, receive only, 16 bits, CRC, DMA, I²S; setting them is an error, and so is a change of clock or format under way.

use plant::bus::SpiByte;

use super::halfword::{Registers, periods};
use super::{Context, Peripheral, Unmodelled};
use crate::outside::SpiBus;
use crate::time::Ticks;

const CR1: usize = 0;
const CR2: usize = 1;
const SR: usize = 2;
const DR: usize = 3;
const I2SCFGR: usize = 7;
const NAMES: &[&str] = &[
    "CR1", "CR2", "SR", "DR", "CRCPR", "RXCRCR", "TXCRCR", "I2SCFGR", "I2SPR",
];
static METER: Registers = Registers {
    peripheral: "SPI1",
    names: NAMES,
};
static FLASH: Registers = Registers {
    peripheral: "SPI2",
    names: NAMES,
};

const CPHA: u16 = 1 << 0;
const CPOL: u16 = 1 << 1;
const MSTR: u16 = 1 << 2;
const BR: u16 = 7 << 3;
const SPE: u16 = 1 << 6;
const LSBFIRST: u16 = 1 << 7;
const SSI: u16 = 1 << 8;
const SSM: u16 = 1 << 9;
const CR1_REFUSED: &[(u16, &str)] = &[
    (1 << 10, "RXONLY"),
    (1 << 11, "DFF"),
    (1 << 12, "CRCNEXT"),
    (1 << 13, "CRCEN"),
    (1 << 14, "BIDIOE"),
    (1 << 15, "BIDIMODE"),
];

const SSOE: u16 = 1 << 2;
const ERRIE: u16 = 1 << 5;
const RXNEIE: u16 = 1 << 6;
const TXEIE: u16 = 1 << 7;
const CR2_REFUSED: &[(u16, &str)] = &[
    (1 << 0, "RXDMAEN"),
    (1 << 1, "TXDMAEN"),
    (1 << 3, "a reserved bit"),
    (1 << 4, "FRF"),
    (0xFF00, "a reserved bit"),
];

const RXNE: u16 = 1 << 0;
const TXE: u16 = 1 << 1;
const MODF: u16 = 1 << 5;
const OVR: u16 = 1 << 6;
const BSY: u16 = 1 << 7;

/// The byte in the shift register.
#[derive(Clone, Copy, Debug)]
struct Shifting {
    byte: u8,
    begin: Ticks,
    end: Ticks,
    clock_hz: f64,
}

/// One of the two SPI peripherals.
#[derive(Debug)]
pub struct Spi {
    bus: SpiBus,
    cr1: u16,
    cr2: u16,
    waiting: Option<u8>,
    shifting: Option<Shifting>,
    received: u8,
    receive_full: bool,
    overrun: bool,
    /// The first half of the sequence that clears OVR: DR was read since.
    overrun_data_read: bool,
    mode_fault: bool,
    /// The first half of the sequence that clears MODF: SR was accessed since.
    mode_fault_seen: bool,
}

impl Spi {
    /// The peripheral of `bus`, after a reset.
    pub const fn new(bus: SpiBus) -> Self {
        Self {
            bus,
            cr1: 0,
            cr2: 0,
            waiting: None,
            shifting: None,
            received: 0,
            receive_full: false,
            overrun: false,
            overrun_data_read: false,
            mode_fault: false,
            mode_fault_seen: false,
        }
    }

    /// Offset of the data register.
    pub const DATA: u32 = 4 * DR as u32;

    /// What divides the clock of its APB.
    pub const fn divider(&self) -> u64 {
        2 << ((self.cr1 & BR) >> 3)
    }

    const fn registers(&self) -> &'static Registers {
        match self.bus {
            SpiBus::Meter => &METER,
            SpiBus::Flash => &FLASH,
        }
    }

    const fn status(&self) -> u16 {
        let mut status = 0;
        if self.receive_full {
            status |= RXNE;
        }
        if self.waiting.is_none() {
            status |= TXE;
        }
        if self.mode_fault {
            status |= MODF;
        }
        if self.overrun {
            status |= OVR;
        }
        if self.shifting.is_some() {
            status |= BSY;
        }
        status
    }

    fn update_interrupt(&self, context: &Context<'_>) {
        let status = self.status();
        let asks = (self.cr2 & TXEIE != 0 && status & TXE != 0)
            || (self.cr2 & RXNEIE != 0 && status & RXNE != 0)
            || (self.cr2 & ERRIE != 0 && status & (OVR | MODF) != 0);
        let irq = match self.bus {
            SpiBus::Meter => 35,
            SpiBus::Flash => 36,
        };
        context.interrupts.set(irq, asks);
    }

    /// Moves the waiting byte to the shift register.
    fn shift_next(&mut self, begin: Ticks, context: &Context<'_>) {
        let Some(byte) = self.waiting.take() else {
            return;
        };
        let clock = match self.bus {
            SpiBus::Meter => context.clocks.apb2,
            SpiBus::Flash => context.clocks.apb1,
        };
        let divider = self.divider();
        self.shifting = Some(Shifting {
            byte,
            begin,
            end: begin + periods(8 * divider, clock),
            clock_hz: f64::from(clock) / divider as f64,
        });
    }

    fn finish(&mut self, done: Shifting, context: &mut Context<'_>) {
        let bit_reversed = self.cr1 & LSBFIRST != 0;
        let as_sent = |byte: u8| {
            if bit_reversed {
                byte.reverse_bits()
            } else {
                byte
            }
        };
        // Eight bits have 7.5 clocks from the first edge to the last. Without CPHA the first bit is out half a clock
        // before its edge; with CPHA the first edge shifts it out (data clock timing diagram).
        let second_edge = self.cr1 & CPHA != 0;
        let half_clock_s = 0.5 / done.clock_hz;
        let received = as_sent(context.outside.spi(
            self.bus,
            SpiByte {
                mosi: as_sent(done.byte),
                mode: u8::from(self.cr1 & CPOL != 0) << 1 | u8::from(second_edge),
                clock_hz: done.clock_hz,
                start_s: done.begin.seconds() + if second_edge { 0.0 } else { half_clock_s },
                end_s: done.end.seconds() - if second_edge { half_clock_s } else { 0.0 },
            },
        ));
        if self.overrun {
            // "All other subsequently transmitted data are lost" until the flag is cleared (28.3.10).
        } else if self.receive_full {
            self.overrun = true;
            self.overrun_data_read = false;
        } else {
            self.received = received;
            self.receive_full = true;
        }
    }

    fn write_cr1(&mut self, value: u16) -> Result<(), Unmodelled> {
        let registers = self.registers();
        registers.refuse(CR1, value, CR1_REFUSED)?;
        let fixed_under_way = CPHA | CPOL | MSTR | BR | SPE | LSBFIRST;
        if self.shifting.is_some() && (value ^ self.cr1) & fixed_under_way != 0 {
            return Err(registers.unmodelled(CR1, "a change while a byte is shifted"));
        }
        let mut value = value;
        if self.mode_fault {
            // The write that clears the flag does not yet set the two bits again (28.3.10).
            value &= !(SPE | MSTR);
            if self.mode_fault_seen {
                self.mode_fault = false;
            }
        }
        if value & SPE != 0 {
            if value & MSTR == 0 {
                return Err(registers.unmodelled(CR1, "a slave (SPE without MSTR)"));
            }
            if value & SSM == 0 && self.cr2 & SSOE == 0 {
                return Err(registers.unmodelled(CR1, "NSS as an input (SSM and SSOE clear)"));
            }
            if value & SSM != 0 && value & SSI == 0 {
                self.mode_fault = true;
                self.mode_fault_seen = false;
                value &= !(SPE | MSTR);
            }
        }
        self.cr1 = value;
        Ok(())
    }
}

impl Peripheral for Spi {
    fn read(
        &mut self,
        offset: u32,
        bytes: u8,
        context: &mut Context<'_>,
    ) -> Result<u32, Unmodelled> {
        let registers = self.registers();
        let index = registers.index(offset, bytes)?;
        self.advance(context);
        let value = match index {
            CR1 => self.cr1,
            CR2 => self.cr2,
            SR => {
                let status = self.status();
                if self.overrun_data_read {
                    self.overrun = false;
                    self.overrun_data_read = false;
                }
                self.mode_fault_seen = self.mode_fault;
                status
            }
            DR => {
                self.receive_full = false;
                self.overrun_data_read = self.overrun;
                u16::from(self.received)
            }
            I2SCFGR => 0,
            _ => return Err(registers.unmodelled(index, "read")),
        };
        self.update_interrupt(context);
        Ok(u32::from(value))
    }

    fn write(
        &mut self,
        offset: u32,
        bytes: u8,
        value: u32,
        context: &mut Context<'_>,
    ) -> Result<(), Unmodelled> {
        let registers = self.registers();
        let index = registers.index(offset, bytes)?;
        let value = registers.value(index, value)?;
        self.advance(context);
        match index {
            CR1 => self.write_cr1(value)?,
            CR2 => {
                registers.refuse(CR2, value, CR2_REFUSED)?;
                if value & SSOE == 0 && self.cr1 & SPE != 0 && self.cr1 & SSM == 0 {
                    return Err(registers.unmodelled(CR2, "NSS as an input (SSM and SSOE clear)"));
                }
                self.cr2 = value;
            }
            // Every flag but CRCERR is cleared by other means; the access counts for MODF.
            SR => self.mode_fault_seen = self.mode_fault,
            DR => {
                if self.cr1 & SPE == 0 {
                    return Err(registers.unmodelled(DR, "written while SPE is clear"));
                }
                // A byte that still waits is overwritten (28.3.7). Only the lower eight bits count.
                self.waiting = Some(value.to_le_bytes()[0]);
                if self.shifting.is_none() {
                    self.shift_next(context.now, context);
                }
            }
            I2SCFGR if value == 0 => {}
            _ => return Err(registers.unmodelled(index, format!("{value:#06x} written"))),
        }
        self.update_interrupt(context);
        Ok(())
    }

    fn next_event(&self) -> Option<Ticks> {
        self.shifting.map(|shifting| shifting.end)
    }

    fn advance(&mut self, context: &mut Context<'_>) {
        while let Some(done) = self.shifting.filter(|byte| byte.end <= context.now) {
            self.shifting = None;
            self.finish(done, context);
            self.shift_next(done.end, context);
            self.update_interrupt(context);
        }
    }

    fn reset(&mut self, context: &mut Context<'_>) {
        *self = Self::new(self.bus);
        self.update_interrupt(context);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

    use proptest::prelude::*;

    use super::super::bench::Bench;
    use super::*;

    const CR1: u32 = 0x00;
    const CR2: u32 = 0x04;
    const SR: u32 = 0x08;
    const DR: u32 = 0x0C;
    /// Master, software NSS, mode 1, divider 32, as the image has the meter's bus.
    const METER_CR1: u32 = 0x345 | 4 << 3;
    /// 8 · 32 clocks of 84 MHz in units of 1/336 µs.
    const METER_BYTE: Ticks = Ticks(8 * 32 * 4);

    fn meter() -> Bench<Spi> {
        let mut bench = Bench::new(Spi::new(SpiBus::Meter));
        bench.write(CR1, METER_CR1);
        bench
    }

    #[test]
    fn reset_values_are_the_manual_s() {
        let mut bench = Bench::new(Spi::new(SpiBus::Meter));
        assert_eq!(bench.read(CR1), 0);
        assert_eq!(bench.read(CR2), 0);
        assert_eq!(bench.read(SR), 0x0002);
        assert_eq!(bench.read(DR), 0);
        assert_eq!(bench.read(0x1C), 0);
        meter().with(|spi, context| {
            spi.reset(context);
            assert_eq!(spi.read(0, 4, context), Ok(0));
        });
    }

    #[test]
    fn a_byte_takes_eight_clocks_and_sets_its_flags() {
        let mut bench = meter();
        bench.now = Ticks::from_micros(5);
        bench.world.spi_answers.push_back(0x5A);
        bench.write(DR, 0xA5);
        // The buffer is free at once, the shift register is not.
        assert_eq!(bench.read(SR), u32::from(TXE | BSY));
        assert_eq!(bench.peripheral.next_event(), Some(bench.now + METER_BYTE));
        bench.run(Ticks(METER_BYTE.0 - 1));
        assert_eq!(bench.read(SR), u32::from(TXE | BSY));
        assert!(bench.world.spi.is_empty());
        bench.run(Ticks(1));
        assert_eq!(bench.read(SR), u32::from(TXE | RXNE));
        assert_eq!(bench.read(DR), 0x5A);
        assert_eq!(bench.read(SR), u32::from(TXE));

        let (bus, byte) = bench.world.spi[0];
        assert_eq!(bus, SpiBus::Meter);
        assert_eq!(byte.mosi, 0xA5);
        assert_eq!(byte.mode, 1);
        // 84 MHz / 32; 7.5 clocks from the first edge, at once in mode 1, to the last.
        assert_eq!(byte.clock_hz, 2_625_000.0);
        assert!((byte.start_s - 5e-6).abs() < 1e-12);
        assert!((byte.end_s - 5e-6 - 7.5 / 2_625_000.0).abs() < 1e-12);
    }

    #[test]
    fn the_flash_s_bus_runs_in_mode_0_from_apb1() {
        let mut bench = Bench::new(Spi::new(SpiBus::Flash));
        bench.write(CR1, 0x344);
        bench.write(DR, 0x9F);
        bench.run(Ticks::from_micros(1));
        let (bus, byte) = bench.world.spi[0];
        assert_eq!((bus, byte.mode, byte.clock_hz), (SpiBus::Flash, 0, 21e6));
        assert!((byte.start_s - 0.5 / 21e6).abs() < 1e-12);
        assert!((byte.end_s - 8.0 / 21e6).abs() < 1e-12);
        bench.write(CR2, u32::from(RXNEIE));
        assert!(bench.interrupts.is_asserted(36) && !bench.interrupts.is_asserted(35));
    }

    #[test]
    fn every_divider_and_mode_reaches_the_bus() {
        for setting in 0..32_u32 {
            let mut bench = meter();
            let (br, mode) = (setting >> 2, setting & 3);
            bench.write(CR1, 0x344 | br << 3 | mode >> 1 << 1 | mode & 1);
            bench.write(DR, 1);
            let clocks = 8 * (2 << br) * 4;
            assert_eq!(bench.peripheral.next_event(), Some(Ticks(clocks)));
            bench.run(Ticks(clocks));
            let (_, byte) = bench.world.spi[0];
            assert_eq!(u32::from(byte.mode), mode);
            assert_eq!(byte.clock_hz, 84e6 / f64::from(2 << br));
        }
    }

    #[test]
    fn the_least_significant_bit_can_go_first() {
        let mut bench = meter();
        bench.write(CR1, METER_CR1 | u32::from(LSBFIRST));
        bench.world.spi_answers.push_back(0x01);
        bench.write(DR, 0x13);
        bench.run(METER_BYTE);
        assert_eq!(bench.world.spi[0].1.mosi, 0xC8);
        assert_eq!(bench.read(DR), 0x80);
    }

    #[test]
    fn a_waiting_byte_follows_without_a_gap() {
        let mut bench = meter();
        bench.world.spi_answers.extend([1, 2]);
        bench.write(DR, 0x11);
        bench.write(DR, 0x22);
        assert_eq!(bench.read(SR), u32::from(BSY));
        bench.run(METER_BYTE);
        assert_eq!(bench.read(SR), u32::from(RXNE | TXE | BSY));
        assert_eq!(bench.read(DR), 1);
        bench.run(METER_BYTE);
        assert_eq!(bench.read(SR), u32::from(RXNE | TXE));
        assert_eq!(bench.read(DR), 2);
        let starts: Vec<_> = bench
            .world
            .spi
            .iter()
            .map(|(_, byte)| byte.start_s)
            .collect();
        assert!((starts[1] - starts[0] - METER_BYTE.seconds()).abs() < 1e-12);
    }

    #[test]
    fn a_byte_written_over_a_waiting_one_replaces_it() {
        let mut bench = meter();
        for byte in [0x11, 0x22, 0x33] {
            bench.write(DR, byte);
        }
        bench.run(Ticks(METER_BYTE.0 * 3));
        let sent: Vec<_> = bench.world.spi.iter().map(|(_, byte)| byte.mosi).collect();
        assert_eq!(sent, [0x11, 0x33]);
    }

    #[test]
    fn overrun_keeps_the_first_byte_and_is_cleared_by_dr_then_sr() {
        let mut bench = meter();
        bench.world.spi_answers.extend([1, 2, 3, 4]);
        for byte in 0..2 {
            bench.write(DR, byte);
            bench.run(METER_BYTE);
        }
        let lost = u32::from(RXNE | TXE | OVR);
        assert_eq!(bench.read(SR), lost);
        // SR alone does not clear it.
        assert_eq!(bench.read(SR), lost);
        assert_eq!(bench.read(DR), 1);
        // Until it is cleared every further byte is lost.
        bench.write(DR, 2);
        bench.run(METER_BYTE);
        assert_eq!(bench.read(SR), u32::from(TXE | OVR));
        assert_eq!(bench.read(SR), u32::from(TXE));
        bench.write(DR, 3);
        bench.run(METER_BYTE);
        assert_eq!(bench.read(DR), 4);
    }

    #[test]
    fn a_mode_fault_is_cleared_by_sr_then_cr1() {
        let mut bench = meter();
        bench.write(CR2, u32::from(ERRIE));
        bench.write(CR1, METER_CR1 & !u32::from(SSI));
        assert!(bench.interrupts.is_asserted(35));
        assert_eq!(bench.read(CR1), METER_CR1 & !u32::from(SSI | SPE | MSTR));
        // CR1 without SR first: stays.
        let mut early = meter();
        early.write(CR1, METER_CR1 & !u32::from(SSI));
        early.write(CR1, METER_CR1);
        assert_eq!(early.read(SR), u32::from(TXE | MODF));

        assert_eq!(bench.read(SR), u32::from(TXE | MODF));
        bench.write(CR1, METER_CR1);
        assert_eq!(bench.read(SR), u32::from(TXE));
        assert_eq!(bench.read(CR1), METER_CR1 & !u32::from(SPE | MSTR));
        bench.write(CR1, METER_CR1);
        assert_eq!(bench.read(CR1), METER_CR1);
        assert!(!bench.interrupts.is_asserted(35));
    }

    #[test]
    fn interrupts_are_levels_of_flags_and_enables() {
        let mut bench = meter();
        assert!(!bench.interrupts.is_asserted(35));
        bench.write(CR2, u32::from(TXEIE));
        assert!(bench.interrupts.is_asserted(35));
        bench.write(CR2, u32::from(RXNEIE));
        assert!(!bench.interrupts.is_asserted(35));
        bench.write(DR, 0);
        bench.run(METER_BYTE);
        assert!(bench.interrupts.is_asserted(35));
        bench.read(DR);
        assert!(!bench.interrupts.is_asserted(35));
        bench.write(CR2, u32::from(ERRIE));
        for _ in 0..2 {
            bench.write(DR, 0);
            bench.run(METER_BYTE);
        }
        assert!(bench.interrupts.is_asserted(35));
        bench.with(|spi, context| spi.reset(context));
        assert!(!bench.interrupts.is_asserted(35));
    }

    #[test]
    fn what_is_missing_is_an_error() {
        for bit in [10, 11, 12, 13, 14, 15] {
            assert!(meter().try_write(CR1, METER_CR1 | 1 << bit).is_err());
        }
        for bit in [0, 1, 3, 4, 8, 15] {
            assert!(meter().try_write(CR2, 1 << bit).is_err());
        }
        // Slave; NSS as an input.
        assert!(meter().try_write(CR1, 0x340).is_err());
        assert!(meter().try_write(CR1, 0x44).is_err());
        for offset in [0x10, 0x14, 0x18, 0x20, 0x24] {
            assert!(meter().try_read(offset).is_err());
        }
        assert!(meter().try_write(0x1C, 0x800).is_err());
        assert!(meter().try_write(0x1C, 0).is_ok());
        let mut off = Bench::new(Spi::new(SpiBus::Meter));
        assert!(off.try_write(DR, 1).is_err());
        let mut busy = meter();
        busy.write(DR, 1);
        assert!(busy.try_write(CR1, METER_CR1 ^ 8).is_err());
        assert!(busy.try_write(CR1, METER_CR1).is_ok());
        busy.with(|spi, context| {
            assert!(spi.write(DR, 1, 1, context).is_err());
            assert!(spi.read(SR + 2, 2, context).is_err());
            assert!(spi.write(DR, 4, 0x1_0000, context).is_err());
            assert!(spi.write(DR, 4, 0x22, context).is_ok());
        });
    }

    proptest! {
        /// A master that follows TXE and RXNE loses and repeats nothing, however late it looks, as long as it looks
        /// once a byte.
        #[test]
        fn bytes_arrive_in_order_and_once(
            bytes in prop::collection::vec(any::<u8>(), 1..40),
            pauses in prop::collection::vec(1_u64..METER_BYTE.0, 1..50),
        ) {
            let mut bench = meter();
            bench.world.spi_answers.extend(bytes.iter().map(|byte| !byte));
            let mut pauses = pauses.iter().cycle();
            let (mut written, mut got) = (0, Vec::new());
            while got.len() < bytes.len() {
                let status = bench.read(SR);
                prop_assert_eq!(status & u32::from(OVR), 0);
                if status & u32::from(RXNE) != 0 {
                    got.push(bench.read(DR) as u8);
                }
                if status & u32::from(TXE) != 0 && written < bytes.len() {
                    bench.write(DR, u32::from(bytes[written]));
                    written += 1;
                }
                bench.run(Ticks(*pauses.next().unwrap()));
            }
            let sent: Vec<_> = bench.world.spi.iter().map(|(_, byte)| byte.mosi).collect();
            prop_assert_eq!(&sent, &bytes);
            let wanted: Vec<_> = bytes.iter().map(|byte| !byte).collect();
            prop_assert_eq!(got, wanted);
            // Bytes never overlap on the wire.
            for pair in bench.world.spi.windows(2) {
                prop_assert!(pair[1].1.start_s > pair[0].1.end_s);
            }
        }
    }
}
