//! I2C1 as a master with 7-bit addresses (RM0090, 27.3.3 and 27.6).
//!
//! The sequences EV5 … EV8 of the manual with their flags and clearing sequences, clock stretching by the master while
//! a flag waits for the software, acknowledge by ACK and POS, repeated start, stop during a byte, arbitration, BUSY from
//! the lines. The clock follows from CCR alone: rise times of the lines are not added to its period.
//!
//! Not modelled, and an error where the software asks for it: slave mode, 10-bit addresses, SMBus, PEC, DMA. An own
//! address is stored but nobody on this board calls it. Not modelled, and no error: that the software must not write CR1
//! while START, STOP or PEC is set (RM0090, I2C_CR1); such a write is taken as any other.
//!
//! Where the manual is silent:
//! - SR1 followed by SR2 (or DR) clears a flag that rose between the two, as the note at SR2 says of ADDR.
//! - With POS, a byte's acknowledge bit is the ACK bit as it was at the end of the byte before, the address included:
//!   the reading with which both the manual's and ST's own two-byte sequences work.
//! - A receiver that has not acknowledged goes on clocking bytes in until a stop or start is asked for.
//! - After a bus error in a byte SCL stays low until a stop or start is asked for.
//! - STOP set while the interface is no master stays set and ends the next transfer right after its start.

use super::halfword::{Registers, periods};
use super::{Context, Peripheral, Unmodelled};
use crate::outside::{I2cAnswer, I2cEvent};
use crate::time::Ticks;

const EVENT_IRQ: u16 = 31;
const ERROR_IRQ: u16 = 32;

const CR1: usize = 0;
const CR2: usize = 1;
const OAR1: usize = 2;
const OAR2: usize = 3;
const DR: usize = 4;
const SR1: usize = 5;
const SR2: usize = 6;
const CCR: usize = 7;
const TRISE: usize = 8;
static REGISTERS: Registers = Registers {
    peripheral: "I2C1",
    names: &[
        "CR1", "CR2", "OAR1", "OAR2", "DR", "SR1", "SR2", "CCR", "TRISE",
    ],
};

const PE: u16 = 1 << 0;
const START: u16 = 1 << 8;
const STOP: u16 = 1 << 9;
const ACK: u16 = 1 << 10;
const POS: u16 = 1 << 11;
const SWRST: u16 = 1 << 15;
const CR1_REFUSED: &[(u16, &str)] = &[
    (1 << 1, "SMBUS"),
    (1 << 2, "a reserved bit"),
    (1 << 3, "SMBTYPE"),
    (1 << 4, "ENARP"),
    (1 << 5, "ENPEC"),
    (1 << 6, "ENGC"),
    (1 << 7, "NOSTRETCH"),
    (1 << 12, "PEC"),
    (1 << 13, "ALERT"),
    (1 << 14, "a reserved bit"),
];

const FREQ: u16 = 0x3F;
const ITERREN: u16 = 1 << 8;
const ITEVTEN: u16 = 1 << 9;
const ITBUFEN: u16 = 1 << 10;
const CR2_REFUSED: &[(u16, &str)] = &[
    (0xC0, "a reserved bit"),
    (1 << 11, "DMAEN"),
    (1 << 12, "LAST"),
    (0xE000, "a reserved bit"),
];

const SB: u16 = 1 << 0;
const ADDR: u16 = 1 << 1;
const BTF: u16 = 1 << 2;
const RXNE: u16 = 1 << 6;
const TXE: u16 = 1 << 7;
const BERR: u16 = 1 << 8;
const ARLO: u16 = 1 << 9;
const AF: u16 = 1 << 10;
/// BERR, ARLO, AF, OVR, PECERR, TIMEOUT, SMBALERT: cleared by writing 0.
const ERRORS: u16 = 0xDF00;

const MSL: u16 = 1 << 0;
const BUSY: u16 = 1 << 1;
const TRA: u16 = 1 << 2;

const FAST: u16 = 1 << 15;
const DUTY: u16 = 1 << 14;

/// What the master does on the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// No master. A START that is asked for waits for the bus; the lines are looked at again at the given time.
    Idle {
        look: Option<Ticks>,
    },
    Starting {
        end: Ticks,
    },
    /// SB: SCL low until the address is in DR.
    AddressWanted,
    Address {
        byte: u8,
        end: Ticks,
    },
    /// ADDR: SCL low until it is cleared.
    AddressDone,
    Transmitting {
        byte: u8,
        end: Ticks,
    },
    /// SCL low until DR is written.
    TransmitterWaits,
    /// Not acknowledged, or a bus error: SCL low until a stop or start.
    Refused,
    Receiving {
        /// When the acknowledge bit is decided, then `None`.
        decide: Option<Ticks>,
        ack: bool,
        end: Ticks,
        bit: Ticks,
    },
    /// DR and shift register full: SCL low until DR is read.
    ReceiverFull,
    Stopping {
        end: Ticks,
    },
}

/// Clock of the bus as CCR has it.
#[derive(Clone, Copy, Debug)]
struct Clock {
    low: Ticks,
    high: Ticks,
}

impl Clock {
    fn bits(self, count: u64) -> Ticks {
        Ticks((self.low + self.high).0 * count)
    }
}

/// I2C1.
#[derive(Debug)]
pub struct I2c {
    cr1: u16,
    cr2: u16,
    oar1: u16,
    oar2: u16,
    ccr: u16,
    trise: u16,
    sr1: u16,
    /// MSL, from the start to the stop.
    master: bool,
    /// TRA.
    transmitter: bool,
    busy: bool,
    /// Lines at the last look, for the stop that clears BUSY.
    lines: (bool, bool),
    phase: Phase,
    to_send: Option<u8>,
    received: u8,
    /// A byte received while DR was full.
    shifted_in: Option<u8>,
    /// ACK at the end of the last byte, for POS.
    ack_before: bool,
    /// SR1 was read: SR2 may clear ADDR.
    read_for_sr2: bool,
    /// SR1 was read: DR may clear SB and BTF.
    read_for_dr: bool,
}

impl Default for I2c {
    fn default() -> Self {
        Self::new()
    }
}

impl I2c {
    /// After a reset.
    pub const fn new() -> Self {
        Self {
            cr1: 0,
            cr2: 0,
            oar1: 0,
            oar2: 0,
            ccr: 0,
            trise: 2,
            sr1: 0,
            master: false,
            transmitter: false,
            busy: false,
            lines: (true, true),
            phase: Phase::Idle { look: None },
            to_send: None,
            received: 0,
            shifted_in: None,
            ack_before: false,
            read_for_sr2: false,
            read_for_dr: false,
        }
    }

    fn clock(&self, context: &Context<'_>) -> Clock {
        let (low, high) = match self.ccr & (FAST | DUTY) {
            FAST => (2, 1),
            value if value & FAST != 0 => (16, 9),
            _ => (1, 1),
        };
        let ccr = u64::from(self.ccr & 0xFFF).max(1);
        Clock {
            low: periods(low * ccr, context.clocks.apb1),
            high: periods(high * ccr, context.clocks.apb1),
        }
    }

    /// Whether the timing registers fit the peripheral's clock (27.6.2, 27.6.8, 27.6.9).
    fn check_timing(&self, context: &Context<'_>) -> Result<(), Unmodelled> {
        let apb1 = context.clocks.apb1;
        let frequency = self.cr2 & FREQ;
        if u32::from(frequency) * 1_000_000 != apb1 || !(2..=42).contains(&frequency) {
            return Err(REGISTERS.unmodelled(
                CR2,
                format!("FREQ {frequency} with an APB1 clock of {apb1} Hz"),
            ));
        }
        let fast = self.ccr & FAST != 0;
        if fast && frequency < 4 {
            return Err(REGISTERS.unmodelled(CR2, "fast mode below 4 MHz"));
        }
        let (periods, limit_hz) = match self.ccr & (FAST | DUTY) {
            FAST => (3, 400_000),
            value if value & FAST != 0 => (25, 400_000),
            _ => (2, 100_000),
        };
        let ccr = self.ccr & 0xFFF;
        let least = if fast && self.ccr & DUTY != 0 { 1 } else { 4 };
        if ccr < least || apb1 > periods * u32::from(ccr) * limit_hz {
            return Err(REGISTERS.unmodelled(
                CCR,
                format!(
                    "{:#06x} (above {limit_hz} Hz or below the field's least)",
                    self.ccr
                ),
            ));
        }
        let rise_ns = if fast { 300 } else { 1_000 };
        let expected = frequency * rise_ns / 1_000 + 1;
        if self.trise != expected {
            return Err(REGISTERS.unmodelled(
                TRISE,
                format!("{} where the mode's rise time gives {expected}", self.trise),
            ));
        }
        Ok(())
    }

    /// BUSY follows the lines while somebody else has them: a low line sets it, a stop clears it.
    fn watch_lines(&mut self, context: &mut Context<'_>) {
        if self.phase_has_bus() {
            return;
        }
        let (scl, sda) = context.outside.i2c_lines(context.now);
        if !scl || !sda {
            self.busy = true;
        } else if self.lines == (true, false) {
            self.busy = false;
        }
        self.lines = (scl, sda);
    }

    /// Whether it drives the lines, or is about to.
    pub const fn uses_pins(&self) -> bool {
        self.phase_has_bus() || self.cr1 & START != 0
    }

    const fn phase_has_bus(&self) -> bool {
        !matches!(self.phase, Phase::Idle { .. })
    }

    fn status_2(&self) -> u16 {
        let mut status = 0;
        if self.master {
            status |= MSL;
        }
        if self.busy {
            status |= BUSY;
        }
        if self.transmitter {
            status |= TRA;
        }
        status
    }

    fn update_interrupts(&self, context: &Context<'_>) {
        let events = SB
            | ADDR
            | BTF
            | if self.cr2 & ITBUFEN != 0 {
                RXNE | TXE
            } else {
                0
            };
        context
            .interrupts
            .set(EVENT_IRQ, self.cr2 & ITEVTEN != 0 && self.sr1 & events != 0);
        context
            .interrupts
            .set(ERROR_IRQ, self.cr2 & ITERREN != 0 && self.sr1 & ERRORS != 0);
    }

    fn start(&mut self, at: Ticks, repeated: bool, clock: Clock) {
        // From an idle bus SDA falls at once and is held for the clock's high time. A repeated start lets SDA rise
        // while SCL is low and waits for its set-up time first.
        let end = if repeated {
            at + clock.low + clock.high + clock.high
        } else {
            at + clock.high
        };
        self.busy = true;
        self.phase = Phase::Starting { end };
    }

    fn stop(&mut self, at: Ticks, clock: Clock) {
        self.phase = Phase::Stopping {
            end: at + clock.low + clock.high,
        };
    }

    /// SCL is low between two bytes: whether a stop or a repeated start is asked for, which then begins.
    fn close(&mut self, at: Ticks, clock: Clock) -> bool {
        if self.cr1 & STOP != 0 {
            self.stop(at, clock);
        } else if self.cr1 & START != 0 {
            self.start(at, true, clock);
        } else {
            return false;
        }
        true
    }

    fn transmit_next(&mut self, at: Ticks, clock: Clock) -> bool {
        let Some(byte) = self.to_send.take() else {
            return false;
        };
        self.sr1 |= TXE;
        self.phase = Phase::Transmitting {
            byte,
            end: at + clock.bits(9),
        };
        true
    }

    fn receive_next(&mut self, at: Ticks, clock: Clock) {
        self.phase = Phase::Receiving {
            decide: Some(at + clock.bits(8)),
            ack: false,
            end: at + clock.bits(9),
            bit: clock.bits(1),
        };
    }

    /// What the software has just done may let the bus go on.
    fn resume(&mut self, context: &mut Context<'_>) -> Result<(), Unmodelled> {
        let at = context.now;
        let clock = self.clock(context);
        match self.phase {
            Phase::Idle { .. } => {
                let wanted = self.cr1 & (PE | START) == PE | START;
                if wanted {
                    self.check_timing(context)?;
                }
                self.try_start(wanted, context);
            }
            Phase::AddressWanted | Phase::Refused => {
                self.close(at, clock);
            }
            Phase::TransmitterWaits => {
                let _ = self.close(at, clock) || self.transmit_next(at, clock);
            }
            Phase::ReceiverFull => {
                let closed = self.close(at, clock);
                if !closed && self.shifted_in.is_none() {
                    self.receive_next(at, clock);
                }
            }
            _ => {}
        }
        Ok(())
    }

    /// Sends the start that waits for a free bus, or looks again one bit later.
    fn try_start(&mut self, wanted: bool, context: &mut Context<'_>) {
        let mut look = None;
        if wanted {
            self.watch_lines(context);
            let clock = self.clock(context);
            if !self.busy {
                self.start(context.now, false, clock);
                return;
            }
            look = Some(context.now + clock.bits(1));
        }
        self.phase = Phase::Idle { look };
    }

    /// Back to slave mode.
    fn release(&mut self) {
        self.phase = Phase::Idle { look: None };
        self.master = false;
        self.transmitter = false;
        self.to_send = None;
        self.sr1 &= !TXE;
    }

    fn lose_arbitration(&mut self) {
        self.release();
        self.sr1 = self.sr1 & !(SB | ADDR | BTF) | ARLO;
        self.cr1 &= !START;
        // SDA was low; whoever holds it ends with a stop.
        self.lines = (true, false);
        self.busy = true;
    }

    fn refuse(&mut self, flag: u16, at: Ticks, clock: Clock) {
        self.sr1 |= flag;
        self.phase = Phase::Refused;
        self.close(at, clock);
    }

    /// Offers what ended at `end` to the bus. `None`: the bus is stuck, and the event is offered again one bit later.
    fn offer(
        &mut self,
        event: I2cEvent,
        end: &mut Ticks,
        clock: Clock,
        context: &mut Context<'_>,
    ) -> Option<I2cAnswer> {
        match context.outside.i2c(event, context.now) {
            I2cAnswer::Stuck => {
                *end = (*end).max(context.now) + clock.bits(1);
                None
            }
            answer => {
                if context.outside.i2c_spurious_bus_error() {
                    self.sr1 |= BERR;
                }
                Some(answer)
            }
        }
    }

    fn finish_start(&mut self, mut end: Ticks, clock: Clock, context: &mut Context<'_>) {
        match self.offer(I2cEvent::Start, &mut end, clock, context) {
            None => self.phase = Phase::Starting { end },
            Some(I2cAnswer::ArbitrationLost) => self.lose_arbitration(),
            Some(answer) => {
                if answer == I2cAnswer::BusError {
                    self.sr1 |= BERR;
                }
                self.sr1 = self.sr1 & !(BTF | TXE | ADDR) | SB;
                self.cr1 &= !START;
                self.master = true;
                self.transmitter = false;
                self.to_send = None;
                self.phase = Phase::AddressWanted;
                self.close(end, clock);
            }
        }
    }

    fn finish_address(
        &mut self,
        byte: u8,
        mut end: Ticks,
        clock: Clock,
        context: &mut Context<'_>,
    ) {
        match self.offer(I2cEvent::Address(byte), &mut end, clock, context) {
            None => self.phase = Phase::Address { byte, end },
            Some(I2cAnswer::ArbitrationLost) => self.lose_arbitration(),
            Some(I2cAnswer::BusError) => self.refuse(BERR, end, clock),
            Some(I2cAnswer::Ack) => {
                self.transmitter = byte & 1 == 0;
                self.sr1 |= ADDR;
                if self.transmitter {
                    self.sr1 |= TXE;
                }
                self.ack_before = self.cr1 & ACK != 0;
                self.phase = Phase::AddressDone;
            }
            Some(_) => {
                self.transmitter = byte & 1 == 0;
                self.refuse(AF, end, clock);
            }
        }
    }

    fn finish_write(&mut self, byte: u8, mut end: Ticks, clock: Clock, context: &mut Context<'_>) {
        match self.offer(I2cEvent::Write(byte), &mut end, clock, context) {
            None => self.phase = Phase::Transmitting { byte, end },
            Some(I2cAnswer::ArbitrationLost) => self.lose_arbitration(),
            Some(I2cAnswer::BusError) => self.refuse(BERR, end, clock),
            Some(I2cAnswer::Ack) => {
                if !self.close(end, clock) && !self.transmit_next(end, clock) {
                    self.sr1 |= BTF;
                    self.phase = Phase::TransmitterWaits;
                }
            }
            Some(_) => self.refuse(AF, end, clock),
        }
    }

    fn finish_read(&mut self, ack: bool, mut end: Ticks, clock: Clock, context: &mut Context<'_>) {
        match self.offer(I2cEvent::Read { ack }, &mut end, clock, context) {
            None => {
                self.phase = Phase::Receiving {
                    decide: None,
                    ack,
                    end,
                    bit: clock.bits(1),
                }
            }
            Some(I2cAnswer::ArbitrationLost) => self.lose_arbitration(),
            Some(I2cAnswer::BusError) => self.refuse(BERR, end, clock),
            Some(answer) => {
                let byte = match answer {
                    I2cAnswer::Byte(byte) => byte,
                    _ => 0xFF,
                };
                self.ack_before = self.cr1 & ACK != 0;
                if self.sr1 & RXNE == 0 {
                    self.received = byte;
                    self.sr1 |= RXNE;
                } else {
                    self.shifted_in = Some(byte);
                    self.sr1 |= BTF;
                }
                if self.close(end, clock) {
                } else if self.shifted_in.is_some() {
                    self.phase = Phase::ReceiverFull;
                } else {
                    self.receive_next(end, clock);
                }
            }
        }
    }

    fn finish_stop(&mut self, mut end: Ticks, clock: Clock, context: &mut Context<'_>) {
        match self.offer(I2cEvent::Stop, &mut end, clock, context) {
            None => self.phase = Phase::Stopping { end },
            Some(answer) => {
                if answer == I2cAnswer::BusError {
                    self.sr1 |= BERR;
                }
                if self.transmitter {
                    self.sr1 &= !BTF;
                }
                self.release();
                self.cr1 &= !STOP;
                self.busy = false;
                self.lines = (true, true);
                self.try_start(self.cr1 & START != 0, context);
            }
        }
    }

    /// A reset lets go of the lines. The slave knows nothing of it: one that sends goes on showing its bit.
    fn abandon(&self, context: &mut Context<'_>) {
        let clocked = match self.phase {
            Phase::Receiving { end, bit, .. } => {
                let left = end.since(context.now).0.div_ceil(bit.0);
                9_u64.saturating_sub(left).min(8) as u8
            }
            // The first bit of the next byte stands on SDA while SCL is held low.
            Phase::ReceiverFull => 0,
            Phase::AddressDone if !self.transmitter => 0,
            _ => return,
        };
        context.outside.i2c_abandoned(clocked, context.now);
    }

    fn software_reset(&mut self, value: u16, context: &mut Context<'_>) {
        self.abandon(context);
        *self = Self::new();
        self.cr1 = value;
    }

    fn write_cr1(&mut self, value: u16, context: &mut Context<'_>) -> Result<(), Unmodelled> {
        if value & SWRST != 0 {
            // Everything is held in reset; the lines are let go of.
            self.software_reset(SWRST, context);
            return Ok(());
        }
        REGISTERS.refuse(CR1, value, CR1_REFUSED)?;
        if value & PE == 0 {
            if self.phase_has_bus() {
                return Err(REGISTERS.unmodelled(CR1, "PE cleared during a transfer"));
            }
            // All bits that PE = 0 clears, among them START, STOP, ACK and POS.
            self.cr1 = 0;
            self.sr1 = 0;
            self.release();
            self.shifted_in = None;
            return Ok(());
        }
        let set = value & !self.cr1;
        if self.phase == Phase::AddressDone && !self.transmitter && set & (START | STOP) != 0 {
            return Err(REGISTERS.unmodelled(CR1, "STOP or START before ADDR of a read is cleared"));
        }
        let receiving = matches!(self.phase, Phase::Receiving { .. } | Phase::ReceiverFull);
        if receiving && set & POS != 0 {
            return Err(REGISTERS.unmodelled(CR1, "POS set after reception began"));
        }
        self.cr1 = value;
        self.resume(context)
    }

    fn write_dr(&mut self, byte: u8, context: &mut Context<'_>) -> Result<(), Unmodelled> {
        let sr1_was_read = std::mem::take(&mut self.read_for_dr);
        match self.phase {
            Phase::AddressWanted => {
                if !sr1_was_read {
                    return Err(REGISTERS.unmodelled(DR, "an address without SR1 read after SB"));
                }
                if byte & 0xF8 == 0xF0 {
                    return Err(REGISTERS.unmodelled(DR, "a 10-bit address"));
                }
                self.sr1 &= !SB;
                self.shifted_in = None;
                self.phase = Phase::Address {
                    byte,
                    end: context.now + self.clock(context).bits(9),
                };
                return Ok(());
            }
            Phase::Address { .. } | Phase::Receiving { .. } | Phase::ReceiverFull => {
                return Err(REGISTERS.unmodelled(DR, "written while receiving or in an address"));
            }
            Phase::AddressDone if !self.transmitter => {
                return Err(REGISTERS.unmodelled(DR, "written while receiving"));
            }
            _ => {}
        }
        // Outside of a transmission the byte stays in DR until a start or stop empties it.
        self.to_send = Some(byte);
        self.sr1 &= !TXE;
        if sr1_was_read {
            self.sr1 &= !(BTF | SB);
        }
        self.resume(context)
    }

    fn read_dr(&mut self, context: &mut Context<'_>) -> Result<u16, Unmodelled> {
        let byte = self.received;
        if std::mem::take(&mut self.read_for_dr) {
            self.sr1 &= !BTF;
        }
        match self.shifted_in.take() {
            Some(next) => self.received = next,
            None => self.sr1 &= !RXNE,
        }
        self.resume(context)?;
        Ok(u16::from(byte))
    }

    fn read_sr2(&mut self, context: &mut Context<'_>) -> u16 {
        self.watch_lines(context);
        let status = self.status_2();
        let sr1_was_read = std::mem::take(&mut self.read_for_sr2);
        if sr1_was_read && self.phase == Phase::AddressDone {
            self.sr1 &= !ADDR;
            let clock = self.clock(context);
            if !self.transmitter {
                self.receive_next(context.now, clock);
            } else if !self.close(context.now, clock) && !self.transmit_next(context.now, clock) {
                self.phase = Phase::TransmitterWaits;
            }
        }
        status
    }

    fn write_timing(&mut self, index: usize, value: u16) -> Result<(), Unmodelled> {
        if self.cr1 & PE != 0 {
            return Err(REGISTERS.unmodelled(index, "written while PE is set"));
        }
        if index == CCR {
            REGISTERS.refuse(CCR, value, &[(0x3000, "a reserved bit")])?;
            self.ccr = value;
        } else {
            REGISTERS.refuse(TRISE, value, &[(0xFFC0, "a reserved bit")])?;
            self.trise = value;
        }
        Ok(())
    }
}

impl Peripheral for I2c {
    fn read(
        &mut self,
        offset: u32,
        bytes: u8,
        context: &mut Context<'_>,
    ) -> Result<u32, Unmodelled> {
        let index = REGISTERS.index(offset, bytes)?;
        self.advance(context);
        let value = match index {
            CR1 => self.cr1,
            CR2 => self.cr2,
            OAR1 => self.oar1,
            OAR2 => self.oar2,
            DR => self.read_dr(context)?,
            SR1 => {
                self.read_for_sr2 = true;
                self.read_for_dr = true;
                self.sr1
            }
            SR2 => self.read_sr2(context),
            CCR => self.ccr,
            _ => self.trise,
        };
        self.update_interrupts(context);
        Ok(u32::from(value))
    }

    fn write(
        &mut self,
        offset: u32,
        bytes: u8,
        value: u32,
        context: &mut Context<'_>,
    ) -> Result<(), Unmodelled> {
        let index = REGISTERS.index(offset, bytes)?;
        let value = REGISTERS.value(index, value)?;
        self.advance(context);
        if self.cr1 & SWRST != 0 && index != CR1 {
            return Err(REGISTERS.unmodelled(index, "written while SWRST is set"));
        }
        match index {
            CR1 => self.write_cr1(value, context)?,
            CR2 => {
                REGISTERS.refuse(CR2, value, CR2_REFUSED)?;
                if self.phase_has_bus() && (value ^ self.cr2) & FREQ != 0 {
                    return Err(REGISTERS.unmodelled(CR2, "FREQ changed during a transfer"));
                }
                self.cr2 = value;
            }
            OAR1 => {
                REGISTERS.refuse(OAR1, value, &[(0x3C00, "a reserved bit")])?;
                self.oar1 = value;
            }
            OAR2 => {
                REGISTERS.refuse(OAR2, value, &[(0xFF00, "a reserved bit")])?;
                self.oar2 = value;
            }
            DR => self.write_dr(value.to_le_bytes()[0], context)?,
            SR1 => self.sr1 &= value | !ERRORS,
            CCR | TRISE => self.write_timing(index, value)?,
            _ => return Err(REGISTERS.unmodelled(index, "written")),
        }
        self.update_interrupts(context);
        Ok(())
    }

    fn next_event(&self) -> Option<Ticks> {
        match self.phase {
            Phase::Idle { look } => look,
            Phase::Starting { end }
            | Phase::Address { end, .. }
            | Phase::Transmitting { end, .. }
            | Phase::Stopping { end } => Some(end),
            Phase::Receiving { decide, end, .. } => Some(decide.unwrap_or(end)),
            Phase::AddressWanted
            | Phase::AddressDone
            | Phase::TransmitterWaits
            | Phase::Refused
            | Phase::ReceiverFull => None,
        }
    }

    fn advance(&mut self, context: &mut Context<'_>) {
        while self.next_event().is_some_and(|at| at <= context.now) {
            let clock = self.clock(context);
            match self.phase {
                Phase::Idle { .. } => self.try_start(self.cr1 & START != 0, context),
                Phase::Starting { end } => self.finish_start(end, clock, context),
                Phase::Address { byte, end } => self.finish_address(byte, end, clock, context),
                Phase::Transmitting { byte, end } => self.finish_write(byte, end, clock, context),
                Phase::Receiving {
                    decide: Some(_),
                    end,
                    bit,
                    ..
                } => {
                    let ack = if self.cr1 & POS != 0 {
                        self.ack_before
                    } else {
                        self.cr1 & ACK != 0
                    };
                    self.phase = Phase::Receiving {
                        decide: None,
                        ack,
                        end,
                        bit,
                    };
                }
                Phase::Receiving { ack, end, .. } => self.finish_read(ack, end, clock, context),
                Phase::Stopping { end } => self.finish_stop(end, clock, context),
                _ => break,
            }
            self.update_interrupts(context);
        }
    }

    fn reset(&mut self, context: &mut Context<'_>) {
        self.abandon(context);
        *self = Self::new();
        self.update_interrupts(context);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

    use proptest::prelude::*;

    use super::super::bench::Bench;
    use super::*;
    use crate::i2c_bus::{Ending, I2cFault, OTHER_MASTER};
    use crate::outside::Outside;

    const CR1: u32 = 0x00;
    const CR2: u32 = 0x04;
    const DR: u32 = 0x10;
    const SR1: u32 = 0x14;
    const SR2: u32 = 0x18;
    const CCR: u32 = 0x1C;
    const TRISE: u32 = 0x20;

    /// 42 MHz / 3 / 35 = 400 kHz: low 70 and high 35 clocks of 8 units of 1/336 µs.
    const LOW: Ticks = Ticks(70 * 8);
    const HIGH: Ticks = Ticks(35 * 8);
    const BIT: Ticks = Ticks(105 * 8);
    const BYTE: Ticks = Ticks(9 * 105 * 8);
    const SLAVE: u8 = 0x48;

    /// Standard library names of event combinations, SR2 << 16 | SR1 (RM0090, 27.3.3).
    const MASTER_MODE: u32 = 0x0003_0001;
    const TRANSMITTER: u32 = 0x0007_0082;
    const RECEIVER: u32 = 0x0003_0002;
    const BYTE_TRANSMITTED: u32 = 0x0007_0084;
    const BYTE_RECEIVED: u32 = 0x0003_0040;

    fn configure(bench: &mut Bench<I2c>) {
        bench.write(CR1, u32::from(SWRST));
        bench.write(CR1, 0);
        bench.write(CR2, 42);
        bench.write(CCR, u32::from(FAST) | 35);
        bench.write(TRISE, 13);
        bench.write(CR1, u32::from(PE));
    }

    fn fast() -> Bench<I2c> {
        let mut bench = Bench::new(I2c::new());
        configure(&mut bench);
        bench
    }

    fn set(bench: &mut Bench<I2c>, bits: u16) {
        let value = bench.read(CR1);
        bench.write(CR1, value | u32::from(bits));
    }

    fn clear(bench: &mut Bench<I2c>, bits: u16) {
        let value = bench.read(CR1);
        bench.write(CR1, value & !u32::from(bits));
    }

    /// SR1 as it is, without the side effects of reading it.
    fn sr1(bench: &Bench<I2c>) -> u16 {
        bench.peripheral.sr1
    }

    fn both(bench: &Bench<I2c>) -> u32 {
        u32::from(bench.peripheral.status_2()) << 16 | u32::from(sr1(bench))
    }

    fn wait(bench: &mut Bench<I2c>, flag: u16, step: Ticks) -> u32 {
        bench.poll(SR1, step, |status| status & u32::from(flag) != 0)
    }

    /// EV5 and the address phase.
    fn address(bench: &mut Bench<I2c>, read: bool, step: Ticks) {
        set(bench, START | ACK);
        wait(bench, SB, step);
        bench.write(DR, u32::from(SLAVE << 1 | u8::from(read)));
        wait(bench, ADDR, step);
    }

    fn until_free(bench: &mut Bench<I2c>, step: Ticks) {
        bench.poll(SR2, step, |status| status & u32::from(BUSY) == 0);
    }

    /// Master transmitter, EV6 … EV8_2.
    fn write_bytes(bench: &mut Bench<I2c>, bytes: &[u8], pause: &mut dyn FnMut() -> Ticks) {
        let step = pause();
        address(bench, false, step);
        bench.read(SR2);
        for byte in bytes {
            let step = pause();
            wait(bench, TXE, step);
            bench.write(DR, u32::from(*byte));
        }
        let step = pause();
        wait(bench, BTF, step);
    }

    /// Master receiver as the image does it: the three cases of the manual's closing procedure. `pause` is what passes
    /// between two accesses where the manual allows it.
    fn read_bytes(
        bench: &mut Bench<I2c>,
        length: usize,
        last: bool,
        pause: &mut dyn FnMut() -> Ticks,
    ) -> Vec<u8> {
        let step = pause();
        address(bench, true, step);
        match length {
            1 => {
                clear(bench, ACK);
                bench.read(SR2);
                if last {
                    set(bench, STOP);
                }
            }
            2 => {
                set(bench, POS);
                bench.read(SR2);
                clear(bench, ACK);
            }
            _ => {
                bench.read(SR2);
            }
        }
        let mut bytes = Vec::new();
        for left in (1..=length).rev() {
            let step = pause();
            match left {
                3 => {
                    wait(bench, BTF, step);
                    clear(bench, ACK);
                }
                2 => {
                    if length == 2 {
                        wait(bench, BTF, step);
                    }
                    if last {
                        set(bench, STOP);
                    }
                }
                _ => {
                    wait(bench, RXNE, step);
                }
            }
            bytes.push(bench.read(DR) as u8);
        }
        clear(bench, POS);
        bytes
    }

    fn micro() -> Ticks {
        Ticks::from_micros(1)
    }

    fn events(bench: &Bench<I2c>) -> Vec<I2cEvent> {
        bench.world.i2c.iter().map(|(event, _)| *event).collect()
    }

    #[test]
    fn reset_values_are_the_manual_s() {
        let mut bench = Bench::new(I2c::new());
        for offset in [CR1, CR2, 0x08, 0x0C, DR, SR1, SR2, CCR] {
            assert_eq!(bench.read(offset), 0);
        }
        assert_eq!(bench.read(TRISE), 2);
        let mut used = fast();
        set(&mut used, START);
        used.with(|i2c, context| i2c.reset(context));
        assert_eq!(used.read(CCR), 0);
        assert_eq!(used.peripheral.next_event(), None);
    }

    #[test]
    fn a_transmission_goes_through_the_manual_s_events() {
        let mut bench = fast();
        set(&mut bench, START);
        assert_eq!(bench.peripheral.next_event(), Some(HIGH));
        bench.run(HIGH);
        // EV5: SB, START cleared, no clock without the address.
        assert_eq!(both(&bench), MASTER_MODE);
        assert_eq!(bench.read(CR1), u32::from(PE));
        assert_eq!(bench.peripheral.next_event(), None);
        bench.run(Ticks::from_micros(50));
        bench.read(SR1);
        bench.write(DR, 0x90);
        assert_eq!(both(&bench), 0x0003_0000);
        let sent = bench.now;
        bench.run(BYTE);
        // EV6, TXE with it (EV8_1).
        assert_eq!(both(&bench), TRANSMITTER);
        assert_eq!(
            bench.world.i2c.last(),
            Some(&(I2cEvent::Address(0x90), sent + BYTE))
        );
        bench.run(Ticks::from_micros(50));
        bench.read(SR1);
        assert_eq!(bench.read(SR2), 0x0007);
        assert_eq!(sr1(&bench), TXE);
        // The first byte moves to the shift register at once, the second waits in DR.
        bench.write(DR, 0xAA);
        assert_eq!(sr1(&bench), TXE);
        bench.write(DR, 0xBB);
        assert_eq!(sr1(&bench), 0);
        bench.run(BYTE);
        assert_eq!(sr1(&bench), TXE);
        bench.run(BYTE);
        // EV8_2.
        assert_eq!(both(&bench), BYTE_TRANSMITTED);
        assert_eq!(bench.peripheral.next_event(), None);
        bench.read(SR1);
        bench.write(DR, 0xCC);
        assert_eq!(sr1(&bench), TXE);
        bench.run(BYTE);
        assert_eq!(both(&bench), BYTE_TRANSMITTED);
        let stop = bench.now;
        set(&mut bench, STOP);
        bench.run(LOW + HIGH);
        // TXE and BTF go with the stop, and so do MSL, BUSY, TRA and the STOP bit.
        assert_eq!(both(&bench), 0);
        assert_eq!(bench.read(CR1), u32::from(PE));
        assert_eq!(
            bench.world.i2c.last(),
            Some(&(I2cEvent::Stop, stop + LOW + HIGH))
        );
        assert_eq!(bench.world.slave.written, [0xAA, 0xBB, 0xCC]);
        assert_eq!(bench.world.slave.stops, 1);
    }

    #[test]
    fn three_bytes_with_their_address_take_as_long_as_the_image_reckons() {
        let mut bench = fast();
        bench.world.slave.to_read.extend([0x12, 0x34, 0x8C]);
        let begin = bench.now;
        // A fast CPU: looks every 0.1 µs.
        let bytes = read_bytes(&mut bench, 3, true, &mut || Ticks(33));
        until_free(&mut bench, Ticks(33));
        assert_eq!(bytes, [0x12, 0x34, 0x8C]);
        let us = bench.now.since(begin).micros();
        // 36 bits of 2.5 µs, start and stop; docs/firmware.md: 93 µs.
        assert!((93.0..96.0).contains(&us), "{us} µs");
    }

    #[test]
    fn duty_and_standard_mode_have_their_clocks() {
        // CCR, TRISE, bit in clocks of APB1 (27.6.8: 3, 25 and 2 times CCR).
        for (ccr, trise, low, high) in [
            (0x8000 | 35, 13, 70, 35),
            (0xC000 | 5, 13, 80, 45),
            (210, 43, 210, 210),
        ] {
            let mut bench = Bench::new(I2c::new());
            bench.write(CR2, 42);
            bench.write(CCR, ccr);
            bench.write(TRISE, trise);
            bench.write(CR1, u32::from(PE));
            set(&mut bench, START);
            assert_eq!(bench.peripheral.next_event(), Some(Ticks(high * 8)));
            bench.run(Ticks(high * 8));
            bench.read(SR1);
            let now = bench.now;
            bench.write(DR, 0x90);
            assert_eq!(
                bench.peripheral.next_event(),
                Some(now + Ticks((low + high) * 72))
            );
        }
    }

    #[test]
    fn timing_registers_that_do_not_fit_are_errors() {
        // FREQ, CCR, TRISE.
        for (freq, ccr, trise, good) in [
            (42, 0x8000 | 35, 13, true),
            (41, 0x8000 | 35, 13, false),
            (42, 0x8000 | 34, 13, false),
            (42, 0x8000 | 36, 13, true),
            (42, 0x8000 | 35, 12, false),
            (42, 210, 43, true),
            (42, 209, 43, false),
            (42, 210, 13, false),
            (42, 0xC000 | 4, 13, false),
            (42, 0, 43, false),
        ] {
            let mut bench = Bench::new(I2c::new());
            bench.write(CR2, freq);
            bench.write(CCR, ccr);
            bench.write(TRISE, trise);
            bench.write(CR1, u32::from(PE));
            let started = bench.try_write(CR1, u32::from(PE | START));
            assert_eq!(started.is_ok(), good, "{freq} {ccr:#x} {trise}");
        }
        let mut bench = fast();
        assert!(bench.try_write(CCR, 0x8030).is_err());
        assert!(bench.try_write(TRISE, 14).is_err());
    }

    #[test]
    fn one_byte_is_refused_and_stopped() {
        let mut bench = fast();
        bench.world.slave.to_read.extend([0x77, 0x66]);
        address(&mut bench, true, micro());
        assert_eq!(both(&bench), RECEIVER);
        clear(&mut bench, ACK);
        bench.read(SR2);
        assert_eq!(sr1(&bench), 0);
        set(&mut bench, STOP);
        bench.run(BYTE);
        assert_eq!(sr1(&bench), RXNE);
        bench.run(BIT);
        assert_eq!(bench.read(SR2), 0);
        assert_eq!(bench.read(DR), 0x77);
        assert_eq!(sr1(&bench), 0);
        assert_eq!(
            events(&bench),
            [
                I2cEvent::Start,
                I2cEvent::Address(0x91),
                I2cEvent::Read { ack: false },
                I2cEvent::Stop
            ]
        );
    }

    #[test]
    fn a_stop_too_late_for_one_byte_clocks_another_in() {
        let mut bench = fast();
        bench.world.slave.to_read.push_back(0x77);
        address(&mut bench, true, micro());
        clear(&mut bench, ACK);
        bench.read(SR2);
        bench.run(BYTE + BIT);
        set(&mut bench, STOP);
        bench.run(Ticks::from_millis(1));
        assert_eq!(sr1(&bench), RXNE | BTF);
        // The slave let go after the first.
        assert_eq!(bench.read(DR), 0x77);
        assert_eq!(bench.read(DR), 0xFF);
        assert_eq!(sr1(&bench) & RXNE, 0);
    }

    #[test]
    fn two_bytes_use_pos_and_btf() {
        let mut bench = fast();
        bench.world.slave.to_read.extend([1, 2, 3]);
        address(&mut bench, true, micro());
        set(&mut bench, POS);
        bench.read(SR2);
        clear(&mut bench, ACK);
        bench.run(BYTE);
        assert_eq!(both(&bench), BYTE_RECEIVED);
        bench.run(BYTE);
        // Both registers full: the clock stays low, however long.
        assert_eq!(sr1(&bench), RXNE | BTF);
        bench.run(Ticks::from_millis(1));
        assert_eq!(bench.world.i2c.len(), 4);
        bench.read(SR1);
        set(&mut bench, STOP);
        assert_eq!(bench.read(DR), 1);
        assert_eq!(sr1(&bench), RXNE);
        assert_eq!(bench.read(DR), 2);
        assert_eq!(sr1(&bench), 0);
        bench.run(BIT);
        assert_eq!(
            events(&bench)[2..],
            [
                I2cEvent::Read { ack: true },
                I2cEvent::Read { ack: false },
                I2cEvent::Stop
            ]
        );
    }

    /// ST's own library clears ACK before ADDR; the manual after it. Both refuse the second byte, and ACK cleared
    /// without POS refuses the first.
    #[test]
    fn pos_defers_the_acknowledge_bit_by_one_byte() {
        for (pos, first) in [(true, true), (false, false)] {
            let mut bench = fast();
            address(&mut bench, true, micro());
            if pos {
                set(&mut bench, POS);
            }
            clear(&mut bench, ACK);
            bench.read(SR1);
            bench.read(SR2);
            bench.run(Ticks(BYTE.0 * 2));
            assert_eq!(
                events(&bench)[2..],
                [I2cEvent::Read { ack: first }, I2cEvent::Read { ack: false }]
            );
        }
    }

    #[test]
    fn the_acknowledge_bit_is_decided_before_the_ninth_clock() {
        for (after, acknowledged) in [(Ticks(BIT.0 * 8 - 1), false), (Ticks(BIT.0 * 8), true)] {
            let mut bench = fast();
            address(&mut bench, true, micro());
            bench.read(SR2);
            bench.run(after);
            clear(&mut bench, ACK);
            bench.run(BYTE);
            assert_eq!(events(&bench)[2], I2cEvent::Read { ack: acknowledged });
        }
    }

    #[test]
    fn a_receiver_with_both_registers_full_stretches_the_clock() {
        let mut bench = fast();
        bench.world.slave.to_read.extend(1..=5);
        address(&mut bench, true, micro());
        bench.read(SR2);
        bench.run(Ticks::from_millis(1));
        assert_eq!(sr1(&bench), RXNE | BTF);
        assert_eq!(bench.peripheral.next_event(), None);
        bench.read(SR1);
        assert_eq!(bench.read(DR), 1);
        assert_eq!(sr1(&bench), RXNE);
        assert_eq!(
            bench.peripheral.next_event(),
            Some(bench.now + Ticks(BIT.0 * 8))
        );
    }

    #[test]
    fn a_repeated_start_turns_the_direction() {
        let mut bench = fast();
        bench.world.slave.to_read.extend([9, 8, 7]);
        write_bytes(&mut bench, &[5], &mut micro);
        let at = bench.now;
        assert_eq!(read_bytes(&mut bench, 3, true, &mut micro), [9, 8, 7]);
        assert_eq!(
            bench.world.i2c[3],
            (I2cEvent::Start, at + LOW + HIGH + HIGH)
        );
        until_free(&mut bench, micro());
        assert_eq!(bench.world.slave.stops, 1);
        assert_eq!(bench.world.slave.addressed, [0x90, 0x91]);
    }

    #[test]
    fn a_stop_during_a_byte_follows_it() {
        let mut bench = fast();
        address(&mut bench, false, micro());
        bench.read(SR2);
        bench.write(DR, 0x11);
        bench.run(BIT);
        set(&mut bench, STOP);
        bench.run(BYTE);
        until_free(&mut bench, micro());
        assert_eq!(bench.world.slave.written, [0x11]);
        assert_eq!(*events(&bench).last().unwrap(), I2cEvent::Stop);
    }

    #[test]
    fn a_stop_and_a_start_together_follow_each_other() {
        let mut bench = fast();
        write_bytes(&mut bench, &[1], &mut micro);
        set(&mut bench, STOP | START);
        bench.run(LOW + HIGH);
        assert_eq!(*events(&bench).last().unwrap(), I2cEvent::Stop);
        bench.run(HIGH);
        assert_eq!(*events(&bench).last().unwrap(), I2cEvent::Start);
        assert_eq!(both(&bench), MASTER_MODE);
    }

    #[test]
    fn no_acknowledge_sets_af_and_holds_the_bus() {
        let mut bench = fast();
        set(&mut bench, START);
        wait(&mut bench, SB, micro());
        bench.write(DR, 0x92);
        bench.run(BYTE);
        assert_eq!(sr1(&bench), AF);
        bench.run(Ticks::from_millis(1));
        assert_eq!(
            bench.read(SR2) & u32::from(MSL | BUSY),
            u32::from(MSL | BUSY)
        );
        // Only a 0 clears it.
        bench.write(SR1, 0xFFFF);
        assert_eq!(sr1(&bench), AF);
        bench.write(SR1, !u32::from(AF) & 0xFFFF);
        assert_eq!(sr1(&bench), 0);
        set(&mut bench, STOP);
        until_free(&mut bench, micro());

        // A refused data byte: no BTF, the next one is not sent.
        let mut bench = fast();
        bench.world.slave.accepts = Some(0);
        address(&mut bench, false, micro());
        bench.read(SR2);
        bench.write(DR, 1);
        bench.write(DR, 2);
        bench.run(Ticks::from_millis(1));
        assert_eq!(sr1(&bench) & (AF | BTF), AF);
        assert_eq!(bench.world.slave.written, [1]);
    }

    #[test]
    fn clearing_sequences_need_both_halves() {
        let mut bench = fast();
        set(&mut bench, START);
        bench.run(HIGH);
        // The address without SR1: what the hardware does with it the manual does not say.
        assert!(bench.try_write(DR, 0x90).is_err());
        bench.read(SR1);
        bench.write(DR, 0x90);
        bench.run(BYTE);
        // SR2 alone after the SR1 that was used up: ADDR was read for SB, and SR1 followed by SR2 clears a flag that
        // rose between the two.
        bench.read(SR2);
        assert_eq!(sr1(&bench) & ADDR, 0);

        let mut bench = fast();
        set(&mut bench, START);
        bench.run(HIGH);
        bench.read(SR1);
        bench.write(DR, 0x90);
        bench.read(SR2);
        bench.run(BYTE);
        bench.read(SR2);
        assert_eq!(sr1(&bench) & ADDR, ADDR);
        bench.read(SR1);
        assert_eq!(sr1(&bench) & ADDR, ADDR);
        bench.read(SR2);
        assert_eq!(sr1(&bench) & ADDR, 0);
    }

    #[test]
    fn lost_arbitration_goes_back_to_slave_until_the_other_stops() {
        let mut bench = fast();
        bench.world.bus.inject(I2cFault::LoseArbitration(1));
        set(&mut bench, START);
        wait(&mut bench, SB, micro());
        bench.write(DR, 0x90);
        bench.run(BYTE);
        assert_eq!(sr1(&bench), ARLO);
        assert_eq!(bench.read(SR2), u32::from(BUSY));
        bench.write(SR1, 0);
        // A start waits for the bus.
        set(&mut bench, START);
        bench.run(Ticks(OTHER_MASTER.0 - BIT.0));
        assert_eq!(sr1(&bench), 0);
        bench.run(Ticks(BIT.0 * 3));
        assert_eq!(sr1(&bench), SB);
        bench.read(SR1);
        bench.write(DR, 0x90);
        bench.run(BYTE);
        assert_eq!(both(&bench), TRANSMITTER);
    }

    #[test]
    fn a_bus_error_is_a_flag() {
        let mut bench = fast();
        bench.world.bus.inject(I2cFault::BusErrors(1));
        set(&mut bench, START);
        wait(&mut bench, SB, micro());
        bench.write(DR, 0x90);
        bench.run(BYTE);
        assert_eq!(sr1(&bench), BERR);
        // The lines are not let go of (27.3.4).
        assert_eq!(bench.read(SR2) & 3, 3);
        bench.write(SR1, 0);
        set(&mut bench, STOP);
        until_free(&mut bench, micro());
    }

    #[test]
    fn a_spurious_bus_error_changes_nothing_else() {
        let mut bench = fast();
        bench.world.bus.inject(I2cFault::SpuriousBusErrors(2));
        set(&mut bench, START);
        wait(&mut bench, SB, micro());
        assert_eq!(sr1(&bench), SB | BERR);
        bench.write(DR, 0x90);
        bench.run(BYTE);
        assert_eq!(sr1(&bench), ADDR | TXE | BERR);
        // Writing 0 clears it, and nothing else.
        bench.write(SR1, 0);
        assert_eq!(sr1(&bench), ADDR | TXE);
    }

    #[test]
    fn busy_follows_a_line_that_is_low() {
        let mut bench = fast();
        bench
            .world
            .bus
            .inject(I2cFault::SdaLow(Some(Ticks::from_micros(500))));
        assert_eq!(bench.read(SR2), u32::from(BUSY));
        set(&mut bench, START);
        bench.run(Ticks::from_micros(499));
        assert_eq!(sr1(&bench), 0);
        // The master's own SDA rises with SCL high: a stop, and the start goes out.
        bench.run(Ticks::from_micros(10));
        assert_eq!(sr1(&bench), SB);

        let mut stuck = fast();
        stuck.world.bus.inject(I2cFault::SclLow(None));
        set(&mut stuck, START);
        stuck.run(Ticks::from_millis(5));
        assert_eq!(stuck.read(SR2), u32::from(BUSY));
        assert!(stuck.world.i2c.is_empty());
        // Software reset does not help while the line is low.
        configure(&mut stuck);
        assert_eq!(stuck.read(SR2), u32::from(BUSY));
    }

    #[test]
    fn a_glitch_leaves_busy_until_the_software_reset() {
        let mut bench = fast();
        bench.world.bus.inject(I2cFault::Glitch);
        bench.read(SR2);
        bench.run(Ticks::from_millis(5));
        assert_eq!(bench.read(SR2), u32::from(BUSY));
        set(&mut bench, START);
        bench.run(Ticks::from_millis(1));
        assert_eq!(sr1(&bench), 0);
        configure(&mut bench);
        assert_eq!(bench.read(SR2), 0);
        write_bytes(&mut bench, &[1], &mut micro);
        assert_eq!(bench.world.slave.written, [1]);
    }

    #[test]
    fn a_clock_that_is_held_delays_the_byte() {
        let mut bench = fast();
        address(&mut bench, false, micro());
        bench.read(SR2);
        bench
            .world
            .bus
            .inject(I2cFault::SclLow(Some(Ticks::from_micros(100))));
        // The short begins with the next look at the bus, the end of this byte.
        bench.write(DR, 1);
        bench.run(Ticks::from_micros(100));
        assert!(bench.world.slave.written.is_empty());
        bench.run(Ticks::from_micros(50));
        assert_eq!(bench.world.slave.written, [1]);
        assert_eq!(sr1(&bench), TXE | BTF);
    }

    #[test]
    fn a_slave_that_lost_step_keeps_the_stop_from_ending() {
        for clocks in 1..=9 {
            let mut bench = fast();
            bench.world.slave.to_read.extend([0xFF, 0xFF, 0xFF]);
            bench.world.bus.inject(I2cFault::HoldSdaInByte { clocks });
            address(&mut bench, true, micro());
            clear(&mut bench, ACK);
            bench.read(SR2);
            set(&mut bench, STOP);
            bench.run(Ticks::from_millis(2));
            // The upper half of the byte was read before the slave lost step.
            assert_eq!(bench.read(DR), 0xF0);
            assert_eq!(bench.read(SR2) & u32::from(BUSY), u32::from(BUSY));
            assert_eq!(bench.world.i2c_lines(bench.now), (true, false));
            assert_eq!(bench.world.slave.stops, 0);
            // The image's recovery: pulses while SDA is low, then a stop, then the peripheral's reset.
            let mut pulses = 0;
            while !bench.world.bus.levels(bench.now).1 {
                for scl in [Some(false), None] {
                    bench.world.bus.pins(scl, None, bench.now);
                    bench.run(Ticks::from_micros(4));
                }
                pulses += 1;
                assert!(pulses <= 9);
            }
            assert_eq!(pulses, clocks);
            for (scl, sda) in [
                (Some(false), Some(false)),
                (None, Some(false)),
                (None, None),
            ] {
                bench.world.bus.pins(scl, sda, bench.now);
                bench.run(Ticks::from_micros(4));
            }
            configure(&mut bench);
            assert_eq!(bench.read(SR2), 0);
            bench.world.slave.to_read = [3, 2, 1].into();
            assert_eq!(read_bytes(&mut bench, 3, true, &mut micro), [3, 2, 1]);
        }
    }

    /// RM0090 warns of writing CR1 while STOP is set: a STOP that is written back after the hardware has cleared it
    /// ends the next transfer after its start.
    #[test]
    fn a_stop_that_is_left_over_spoils_the_next_start() {
        let mut bench = fast();
        set(&mut bench, STOP);
        set(&mut bench, START);
        bench.run(Ticks::from_micros(100));
        assert_eq!(events(&bench), [I2cEvent::Start, I2cEvent::Stop]);
        assert_eq!(bench.read(SR2), 0);
        assert_eq!(bench.read(CR1), u32::from(PE));
        // The driver that waits for SB goes on and is never answered.
        wait(&mut bench, SB, micro());
        bench.write(DR, 0x90);
        bench.run(Ticks::from_millis(1));
        assert_eq!(sr1(&bench) & (ADDR | AF | SB), 0);
    }

    #[test]
    fn interrupts_are_levels_of_flags_and_enables() {
        let mut bench = fast();
        bench.write(CR2, 42 | u32::from(ITEVTEN | ITERREN));
        set(&mut bench, START);
        assert!(!bench.interrupts.is_asserted(31));
        bench.run(HIGH);
        assert!(bench.interrupts.is_asserted(31));
        bench.read(SR1);
        bench.write(DR, 0x90);
        assert!(!bench.interrupts.is_asserted(31));
        bench.run(BYTE);
        assert!(bench.interrupts.is_asserted(31));
        bench.read(SR1);
        bench.read(SR2);
        // TXE asks with ITBUFEN only.
        assert!(!bench.interrupts.is_asserted(31));
        bench.write(CR2, 42 | u32::from(ITEVTEN | ITBUFEN));
        assert!(bench.interrupts.is_asserted(31));
        assert!(!bench.interrupts.is_asserted(32));
        bench.world.slave.accepts = Some(0);
        bench.write(CR2, 42 | u32::from(ITERREN));
        bench.write(DR, 1);
        bench.run(BYTE);
        assert!(bench.interrupts.is_asserted(32) && !bench.interrupts.is_asserted(31));
        bench.write(SR1, 0);
        assert!(!bench.interrupts.is_asserted(32));
    }

    #[test]
    fn what_is_missing_is_an_error() {
        for bit in [1, 2, 3, 4, 5, 6, 7, 12, 13, 14] {
            assert!(fast().try_write(CR1, 1 | 1 << bit).is_err());
        }
        for bit in [6, 7, 11, 12, 13] {
            assert!(fast().try_write(CR2, 42 | 1 << bit).is_err());
        }
        assert!(fast().try_write(SR2, 0).is_err());
        assert!(fast().try_read(0x24).is_err());
        fast().with(|i2c, context| {
            assert!(i2c.read(SR1, 1, context).is_err());
            assert!(i2c.read(SR1, 4, context).is_ok());
            assert!(i2c.write(0x08, 2, 0x4090, context).is_ok());
            assert_eq!(i2c.read(0x08, 2, context), Ok(0x4090));
        });
        let mut bench = fast();
        set(&mut bench, START);
        bench.run(HIGH);
        assert!(bench.try_write(CR1, 0).is_err());
        bench.read(SR1);
        assert!(bench.try_write(DR, 0xF0).is_err());
        let mut bench = fast();
        address(&mut bench, true, micro());
        assert!(bench.try_write(CR1, u32::from(PE | STOP)).is_err());
        assert!(bench.try_write(DR, 1).is_err());
        bench.read(SR2);
        assert!(bench.try_write(CR1, u32::from(PE | ACK | POS)).is_err());
        // Held in reset.
        bench.write(CR1, u32::from(SWRST));
        assert!(bench.try_write(CCR, 35).is_err());
    }

    proptest! {
        /// Whatever passes between two looks, every byte is transferred in order and exactly once, and the master ends
        /// with one refused byte and one stop. Looks are late by up to 1 ms, as behind a preemption.
        #[test]
        fn bytes_arrive_in_order_and_once(
            write in prop::collection::vec(any::<u8>(), 1..6),
            read in prop::collection::vec(any::<u8>(), 1..8),
            repeated in any::<bool>(),
            pauses in prop::collection::vec(prop_oneof![1_u64..2_000, 1_u64..100_000], 1..30),
        ) {
            let mut bench = fast();
            bench.world.slave.to_read.extend(&read);
            bench.world.slave.to_read.extend([0xEE; 4]);
            let mut cycle = pauses.iter().cycle();
            let mut pause = || Ticks(*cycle.next().unwrap());
            write_bytes(&mut bench, &write, &mut pause);
            if !repeated {
                set(&mut bench, STOP);
                until_free(&mut bench, pause());
            }
            let got = read_bytes(&mut bench, read.len(), true, &mut pause);
            until_free(&mut bench, pause());
            prop_assert_eq!(&got, &read);
            prop_assert_eq!(&bench.world.slave.written, &write);
            prop_assert_eq!(bench.world.slave.to_read.len(), 4);
            prop_assert_eq!(bench.world.slave.stops, if repeated { 1 } else { 2 });
            prop_assert_eq!(sr1(&bench), 0);
            let log = bench.world.bus.take_log();
            prop_assert_eq!(log.len(), 2);
            prop_assert_eq!(log[0].ending, if repeated { Ending::RepeatedStart } else { Ending::Stop });
            let refused = log[1].bytes.iter().filter(|(_, acknowledged)| !acknowledged).count();
            prop_assert_eq!(refused, 1);
            prop_assert!(!log[1].bytes.last().unwrap().1);
        }

        /// Whatever the bus answers and whatever the driver's wait finds, a transaction with the image's error path
        /// ends, and after clearing the fault and the image's recovery the next one is right.
        #[test]
        fn after_any_fault_the_software_reset_brings_the_bus_back(
            fault in prop_oneof![
                (1_u32..3).prop_map(I2cFault::NackAddresses),
                (1_u32..3).prop_map(I2cFault::NackData),
                (1_u32..3).prop_map(I2cFault::LoseArbitration),
                (1_u32..3).prop_map(I2cFault::BusErrors),
                (1_u8..10).prop_map(|clocks| I2cFault::HoldSdaInByte { clocks }),
                (1_u8..10).prop_map(|clocks| I2cFault::HoldSda { clocks }),
                Just(I2cFault::SdaLow(None)),
                Just(I2cFault::SclLow(None)),
                Just(I2cFault::Glitch),
            ],
            at in 0_u64..40_000,
        ) {
            let mut bench = fast();
            bench.world.bus.schedule(Ticks(at), fault);
            // A driver that goes through a two-byte write with a bound on every wait.
            set(&mut bench, START | ACK);
            let mut good = true;
            for (flag, byte) in [(SB, 0x90), (ADDR, 0), (TXE, 1), (TXE, 2), (BTF, 0)] {
                let mut seen = 0;
                for _ in 0..300 {
                    seen = bench.read(SR1) as u16;
                    if seen & (flag | ERRORS) != 0 {
                        break;
                    }
                    bench.run(micro());
                }
                if seen & ERRORS != 0 || seen & flag == 0 {
                    good = false;
                    break;
                }
                match flag {
                    ADDR => {
                        bench.read(SR2);
                    }
                    BTF => {}
                    _ => bench.write(DR, byte),
                }
            }
            set(&mut bench, STOP);
            bench.write(SR1, 0);
            bench.run(Ticks::from_micros(300));
            if good {
                prop_assert!(bench.world.slave.written.starts_with(&[1]));
            }
            bench.world.bus.clear_faults();
            configure(&mut bench);
            bench.world.slave.written.clear();
            write_bytes(&mut bench, &[3, 4], &mut micro);
            prop_assert_eq!(&bench.world.slave.written, &[3, 4]);
        }
    }
}
