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
mod tests;
