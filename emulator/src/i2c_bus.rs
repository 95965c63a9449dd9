//! The I²C bus between the MCU and the one slave on it: lines, acknowledge bits, faults, and the bit-banging with which
//! a driver frees a slave that holds SDA (NXP UM10204, 3.1.16).
//!
//! Bytes are taken apart into bits only as far as somebody holds a line: the slave sees whole bytes. The MCU's open
//! drain outputs and its peripheral are told apart by who calls: [`I2cBus::event`] is the peripheral,
//! [`I2cBus::pins`] the outputs.

use std::collections::VecDeque;

use plant::bus::I2cDevice;

use crate::outside::{I2cAnswer, I2cEvent};
use crate::time::Ticks;

/// How long another master that won the arbitration keeps the bus: four bytes at 400 kHz.
pub const OTHER_MASTER: Ticks = Ticks::from_micros(90);
/// Transactions kept in the log.
pub const LOG_LENGTH: usize = 256;
/// Bytes kept of one transaction.
pub const LOG_BYTES: usize = 64;
/// The bit (0 = first) at which [`I2cFault::HoldSdaInByte`] strikes.
const STRUCK_BIT: u32 = 4;

/// What can be wrong with the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum I2cFault {
    /// The slave does not answer to its address so many times.
    NackAddresses(u32),
    /// The slave refuses so many written bytes; it does not take them either.
    NackData(u32),
    /// Another master wins so many address bytes and keeps the bus for [`OTHER_MASTER`].
    LoseArbitration(u32),
    /// So many byte events end in a start or stop seen at the wrong place.
    BusErrors(u32),
    /// So many events have the peripheral raise BERR though nothing is wrong: the transfer goes on (errata ES0182, spurious bus error
    /// detection in master mode).
    SpuriousBusErrors(u32),
    /// In the middle of the next data byte the slave loses step: it holds SDA low for the rest of the byte and then
    /// until it has got so many falling edges of SCL more.
    HoldSdaInByte {
        /// 1 … 9 for a slave in step with its own byte.
        clocks: u8,
    },
    /// The slave holds SDA low from now on until it has got so many falling edges of SCL: what a reset of the MCU in
    /// the middle of a read leaves behind.
    HoldSda {
        /// 1 … 9.
        clocks: u8,
    },
    /// The slave is in the middle of a byte that it sends, and nobody clocks it: what a reset of the MCU leaves behind.
    MidByte {
        /// The byte, most significant bit first.
        byte: u8,
        /// The bit (0 = first) that stands on SDA.
        shown: u8,
    },
    /// SDA is shorted low, for a time or for ever.
    SdaLow(Option<Ticks>),
    /// SCL is shorted low, for a time or for ever.
    SclLow(Option<Ticks>),
    /// A spike: on an idle bus the peripheral takes it for a start whose stop never comes (BUSY stays), within a
    /// transaction for a start at the wrong place.
    Glitch,
}

/// How a transaction ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ending {
    /// It has not.
    Open,
    /// With a stop.
    Stop,
    /// With a repeated start.
    RepeatedStart,
    /// Another master took the bus, or SDA was held.
    ArbitrationLost,
    /// A start or stop at the wrong place.
    BusError,
    /// The master was reset.
    Abandoned,
}

/// One address phase and the bytes that followed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Transaction {
    /// End of the start condition.
    pub start: Ticks,
    /// End of it all.
    pub end: Option<Ticks>,
    /// Address and direction bit.
    pub address: Option<u8>,
    /// Whether the address was acknowledged.
    pub acknowledged: bool,
    /// Bytes with their acknowledge bits, the first [`LOG_BYTES`].
    pub bytes: Vec<(u8, bool)>,
    /// How it ended.
    pub ending: Ending,
}

/// A line that is shorted low.
#[derive(Clone, Copy, Debug, Default)]
struct Short {
    /// `None`: not shorted. `Some(None)`: for ever.
    until: Option<Option<Ticks>>,
}

impl Short {
    fn new(from: Ticks, length: Option<Ticks>) -> Self {
        Self {
            until: Some(length.map(|length| from + length)),
        }
    }

    fn is_low(self, at: Ticks) -> bool {
        match self.until {
            None => false,
            Some(None) => true,
            Some(Some(end)) => at < end,
        }
    }
}

/// A slave in the middle of a byte that it sends (UM10204, 3.1.5 and 3.1.6): each falling edge of SCL brings the next bit; with the
/// ninth clock it looks whether it was acknowledged, and only then goes on. Start and stop end it anywhere.
#[derive(Clone, Copy, Debug)]
struct Sending {
    byte: u8,
    /// 0 … 7; 8 is the acknowledge bit, for which it lets go of SDA.
    shown: u8,
}

impl Sending {
    const fn is_low(self) -> bool {
        self.shown < 8 && self.byte & 0x80 >> self.shown == 0
    }

    fn clock_falls(&mut self) {
        if self.shown < 8 {
            self.shown += 1;
        } else {
            // Acknowledged, or it would have stopped: beyond its third byte the ADS1100 sends 0xFF.
            *self = Self {
                byte: 0xFF,
                shown: 0,
            };
        }
    }
}

/// The bus.
#[derive(Debug, Default)]
pub struct I2cBus {
    scheduled: VecDeque<(Ticks, I2cFault)>,
    nack_addresses: u32,
    nack_data: u32,
    lose_arbitration: u32,
    bus_errors: u32,
    spurious_bus_errors: u32,
    hold_in_byte: Option<u8>,
    /// Falling edges of SCL until the slave lets go of SDA.
    held: Option<u8>,
    sending: Option<Sending>,
    sda_short: Short,
    scl_short: Short,
    glitch: bool,
    other_master_until: Ticks,
    /// Between start and stop.
    started: bool,
    /// The slave has acknowledged its address and the master still wants it.
    selected: bool,
    /// The MCU's outputs pull SCL, SDA low.
    pulled: (bool, bool),
    /// A stop by the MCU's outputs that the slave has not been told of.
    stop_owed: bool,
    clock_pulses: u64,
    pin_stops: u64,
    log: VecDeque<Transaction>,
}

impl I2cBus {
    /// An idle bus without faults.
    pub fn new() -> Self {
        Self::default()
    }

    /// Switches a fault on now, or as soon as the bus is next looked at.
    pub fn inject(&mut self, fault: I2cFault) {
        self.schedule(Ticks(0), fault);
    }

    /// Switches a fault on at a time.
    pub fn schedule(&mut self, at: Ticks, fault: I2cFault) {
        let place = self.scheduled.partition_point(|(other, _)| *other <= at);
        self.scheduled.insert(place, (at, fault));
    }

    /// Ends every fault, and what is scheduled.
    pub fn clear_faults(&mut self) {
        self.scheduled.clear();
        self.nack_addresses = 0;
        self.nack_data = 0;
        self.lose_arbitration = 0;
        self.bus_errors = 0;
        self.spurious_bus_errors = 0;
        self.hold_in_byte = None;
        self.held = None;
        self.sending = None;
        self.sda_short = Short::default();
        self.scl_short = Short::default();
        self.glitch = false;
        self.other_master_until = Ticks(0);
    }

    fn apply_due(&mut self, at: Ticks) {
        while let Some((from, fault)) = self.scheduled.front().copied() {
            if from > at {
                return;
            }
            self.scheduled.pop_front();
            // One injected "now" begins when the bus is next looked at.
            let from = if from == Ticks(0) { at } else { from };
            match fault {
                I2cFault::NackAddresses(count) => self.nack_addresses += count,
                I2cFault::NackData(count) => self.nack_data += count,
                I2cFault::LoseArbitration(count) => self.lose_arbitration += count,
                I2cFault::BusErrors(count) => self.bus_errors += count,
                I2cFault::SpuriousBusErrors(count) => self.spurious_bus_errors += count,
                I2cFault::HoldSdaInByte { clocks } => self.hold_in_byte = Some(clocks),
                I2cFault::HoldSda { clocks } => self.held = (clocks > 0).then_some(clocks),
                I2cFault::MidByte { byte, shown } => self.sending = Some(Sending { byte, shown }),
                I2cFault::SdaLow(length) => self.sda_short = Short::new(from, length),
                I2cFault::SclLow(length) => self.scl_short = Short::new(from, length),
                I2cFault::Glitch if self.started => self.bus_errors += 1,
                I2cFault::Glitch => self.glitch = true,
            }
        }
    }

    fn scl_low(&self, at: Ticks) -> bool {
        self.scl_short.is_low(at)
    }

    fn sda_low(&self, at: Ticks) -> bool {
        self.held.is_some()
            || self.sending.is_some_and(Sending::is_low)
            || self.sda_short.is_low(at)
            || at < self.other_master_until
    }

    /// SCL falls: a slave that lost step shifts on.
    fn clock_falls(&mut self) {
        if let Some(left) = self.held {
            self.held = left.checked_sub(1).filter(|left| *left > 0);
        }
        if let Some(sending) = &mut self.sending {
            sending.clock_falls();
        }
    }

    /// SCL rises: with the ninth clock a slave that sends is acknowledged by a low SDA, or has ended.
    fn clock_rises(&mut self, sda: bool) {
        self.sending = self.sending.filter(|sending| sending.shown < 8 || !sda);
    }

    /// Whether the peripheral takes the event that has just ended for a bus error, and is wrong ([`I2cFault::SpuriousBusErrors`]).
    pub fn take_spurious_bus_error(&mut self) -> bool {
        let left = self.spurious_bus_errors.checked_sub(1);
        self.spurious_bus_errors = left.unwrap_or_default();
        left.is_some()
    }

    /// Levels of SCL and SDA as the peripheral's filters see them, without what the MCU itself pulls. A glitch is seen
    /// here once.
    pub fn lines(&mut self, at: Ticks) -> (bool, bool) {
        let (scl, sda) = self.levels(at);
        let spike = std::mem::take(&mut self.glitch);
        (scl && !spike, sda)
    }

    /// Levels of SCL and SDA as the input data register sees them, without what the MCU itself pulls.
    pub fn levels(&mut self, at: Ticks) -> (bool, bool) {
        self.apply_due(at);
        (!self.scl_low(at), !self.sda_low(at))
    }

    /// What the MCU's general-purpose outputs drive onto the lines (`None`: nothing, as while the peripheral has the
    /// pins). Counts clock pulses and recognises a stop.
    pub fn pins(&mut self, scl: Option<bool>, sda: Option<bool>, at: Ticks) {
        let pulled = (scl == Some(false), sda == Some(false));
        if pulled == self.pulled {
            return;
        }
        let (scl_was, sda_was) = self.levels_with_pins(at);
        // One output register can move both; a driver moves SCL first when it lets go of it, last when it pulls it.
        self.pulled.0 = pulled.0;
        let scl_is = self.levels_with_pins(at).0;
        if scl_was && !scl_is {
            self.clock_falls();
        }
        if !scl_was && scl_is {
            self.clock_pulses += 1;
            let sda = self.levels_with_pins(at).1;
            self.clock_rises(sda);
        }
        let sda_before = if scl_was == scl_is {
            sda_was
        } else {
            self.levels_with_pins(at).1
        };
        self.pulled.1 = pulled.1;
        let sda_is = self.levels_with_pins(at).1;
        if scl_is && !sda_before && sda_is {
            self.pin_stops += 1;
            self.stop_owed = true;
            self.sending = None;
            self.close(at, Ending::Stop);
        }
    }

    fn levels_with_pins(&mut self, at: Ticks) -> (bool, bool) {
        let (scl, sda) = self.levels(at);
        (scl && !self.pulled.0, sda && !self.pulled.1)
    }

    /// Clock pulses that the MCU's outputs made.
    pub const fn clock_pulses(&self) -> u64 {
        self.clock_pulses
    }

    /// Stops that the MCU's outputs made.
    pub const fn pin_stops(&self) -> u64 {
        self.pin_stops
    }

    /// The last [`LOG_LENGTH`] transactions, oldest first.
    pub fn log(&self) -> impl ExactSizeIterator<Item = &Transaction> {
        self.log.iter()
    }

    /// Takes the log away.
    pub fn take_log(&mut self) -> Vec<Transaction> {
        self.log.drain(..).collect()
    }

    fn close(&mut self, at: Ticks, ending: Ending) {
        self.started = false;
        self.selected = false;
        if let Some(last) = self.log.back_mut().filter(|last| last.end.is_none()) {
            last.end = Some(at);
            last.ending = ending;
        }
    }

    /// The master is reset in the middle of a byte that the slave sends, after so many of its bits.
    pub fn abandon(&mut self, clocked: u8, at: Ticks, device: &mut dyn I2cDevice) {
        // In the ninth clock nobody acknowledges any more.
        if self.selected && clocked < 8 {
            self.sending = Some(Sending {
                byte: device.read(at.seconds()),
                shown: clocked,
            });
        }
        self.close(at, Ending::Abandoned);
    }

    fn note_byte(&mut self, byte: u8, acknowledged: bool) {
        if let Some(last) = self
            .log
            .back_mut()
            .filter(|last| last.bytes.len() < LOG_BYTES)
        {
            last.bytes.push((byte, acknowledged));
        }
    }

    /// Clocks a byte through: the levels that SDA takes for eight data bits and the acknowledge bit if the sender of
    /// the byte puts `byte` and nobody but a fault acknowledges. `Err` at the first bit that the master lets go of and
    /// finds low.
    fn clock_byte(&mut self, byte: u8, from_master: bool, at: Ticks) -> Result<(u8, bool), ()> {
        let strike = self.hold_in_byte.take();
        // It no longer knows which byte is its own.
        let in_step = self.selected && strike.is_none();
        let mut seen = byte;
        for bit in 0..8 {
            self.clock_falls();
            let low = strike.is_some() && bit >= STRUCK_BIT || self.sda_low(at);
            let mask = 0x80 >> bit;
            self.clock_rises(!low && byte & mask != 0);
            if low && byte & mask != 0 {
                if from_master {
                    self.held = strike.or(self.held);
                    self.selected = in_step;
                    return Err(());
                }
                seen &= !mask;
            }
        }
        self.clock_falls();
        let acknowledged = strike.is_some() || self.sda_low(at);
        self.clock_rises(!acknowledged);
        self.held = strike.or(self.held);
        self.selected = in_step;
        Ok((seen, acknowledged))
    }

    /// What the MCU's peripheral does on the bus. `at`: the end of the event.
    ///
    /// [`I2cAnswer::Stuck`] changes nothing: the same event is offered again.
    pub fn event(&mut self, event: I2cEvent, at: Ticks, device: &mut dyn I2cDevice) -> I2cAnswer {
        self.apply_due(at);
        if std::mem::take(&mut self.stop_owed) {
            device.stop(at.seconds());
        }
        // A start needs SDA to fall and a stop needs it to rise.
        let needs_sda = matches!(event, I2cEvent::Start | I2cEvent::Stop);
        if self.scl_low(at) || needs_sda && self.sda_low(at) {
            return I2cAnswer::Stuck;
        }
        if !needs_sda && self.bus_errors > 0 {
            self.bus_errors -= 1;
            self.selected = false;
            self.close(at, Ending::BusError);
            return I2cAnswer::BusError;
        }
        if needs_sda {
            self.sending = None;
        }
        match event {
            I2cEvent::Start => {
                self.close(at, Ending::RepeatedStart);
                self.started = true;
                if self.log.len() == LOG_LENGTH {
                    self.log.pop_front();
                }
                self.log.push_back(Transaction {
                    start: at,
                    end: None,
                    address: None,
                    acknowledged: false,
                    bytes: Vec::new(),
                    ending: Ending::Open,
                });
                I2cAnswer::Done
            }
            I2cEvent::Stop => {
                device.stop(at.seconds());
                self.close(at, Ending::Stop);
                I2cAnswer::Done
            }
            I2cEvent::Address(byte) => self.address(byte, at, device),
            I2cEvent::Write(byte) => self.write(byte, at, device),
            I2cEvent::Read { ack } => self.read(ack, at, device),
        }
    }

    fn lost(&mut self, at: Ticks) -> I2cAnswer {
        self.close(at, Ending::ArbitrationLost);
        I2cAnswer::ArbitrationLost
    }

    fn address(&mut self, byte: u8, at: Ticks, device: &mut dyn I2cDevice) -> I2cAnswer {
        if let Some(last) = self.log.back_mut() {
            last.address = Some(byte);
        }
        if self.lose_arbitration > 0 {
            self.lose_arbitration -= 1;
            self.other_master_until = at + OTHER_MASTER;
            return self.lost(at);
        }
        // The slave loses step in a data byte only.
        let strike = self.hold_in_byte.take();
        let clocked = self.clock_byte(byte, true, at);
        self.hold_in_byte = strike;
        let Ok((_, pulled)) = clocked else {
            return self.lost(at);
        };
        let answered = if self.nack_addresses > 0 {
            self.nack_addresses -= 1;
            false
        } else {
            // While somebody holds SDA every bit reads 0, and no slave knows its address.
            !pulled && device.address(byte, at.seconds())
        };
        self.selected = answered;
        let acknowledged = answered || pulled;
        if let Some(last) = self.log.back_mut() {
            last.acknowledged = acknowledged;
        }
        if acknowledged {
            I2cAnswer::Ack
        } else {
            I2cAnswer::Nack
        }
    }

    fn write(&mut self, byte: u8, at: Ticks, device: &mut dyn I2cDevice) -> I2cAnswer {
        let Ok((_, pulled)) = self.clock_byte(byte, true, at) else {
            return self.lost(at);
        };
        let refused = self.nack_data > 0;
        self.nack_data = self.nack_data.saturating_sub(1);
        let taken = self.selected && !refused && !pulled && device.write(byte, at.seconds());
        let acknowledged = taken || pulled;
        self.note_byte(byte, acknowledged);
        if acknowledged {
            I2cAnswer::Ack
        } else {
            I2cAnswer::Nack
        }
    }

    fn read(&mut self, ack: bool, at: Ticks, device: &mut dyn I2cDevice) -> I2cAnswer {
        let sent = if self.selected {
            device.read(at.seconds())
        } else {
            0xFF
        };
        // Its own bits come from the slave, so nothing is lost by finding them low.
        let seen = self
            .clock_byte(sent, false, at)
            .map_or(sent, |(seen, _)| seen);
        // A slave that was not acknowledged lets go of SDA.
        self.selected &= ack;
        self.note_byte(seen, ack);
        I2cAnswer::Byte(seen)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

    use proptest::prelude::*;

    use super::*;
    use crate::mcu::bench::Slave;

    const LOW: Option<bool> = Some(false);

    fn slave() -> Slave {
        Slave {
            address: 0x48,
            to_read: [0xFF; 64].into(),
            ..Slave::default()
        }
    }

    fn start(bus: &mut I2cBus, device: &mut Slave, byte: u8) -> I2cAnswer {
        assert_eq!(
            bus.event(I2cEvent::Start, Ticks(0), device),
            I2cAnswer::Done
        );
        bus.event(I2cEvent::Address(byte), Ticks(1), device)
    }

    #[test]
    fn a_transaction_reaches_the_slave_and_the_log() {
        let (mut bus, mut device) = (I2cBus::new(), slave());
        device.accepts = Some(1);
        device.to_read.push_front(0x34);
        assert_eq!(start(&mut bus, &mut device, 0x90), I2cAnswer::Ack);
        let write = |byte| I2cEvent::Write(byte);
        assert_eq!(bus.event(write(1), Ticks(2), &mut device), I2cAnswer::Ack);
        assert_eq!(bus.event(write(2), Ticks(3), &mut device), I2cAnswer::Nack);
        assert_eq!(start(&mut bus, &mut device, 0x91), I2cAnswer::Ack);
        let read = |ack| I2cEvent::Read { ack };
        assert_eq!(
            bus.event(read(false), Ticks(4), &mut device),
            I2cAnswer::Byte(0x34)
        );
        // Not acknowledged: the slave is off the bus.
        assert_eq!(
            bus.event(read(true), Ticks(5), &mut device),
            I2cAnswer::Byte(0xFF)
        );
        assert_eq!(device.to_read.len(), 64);
        bus.event(I2cEvent::Stop, Ticks(9), &mut device);
        assert_eq!((device.stops, device.written.as_slice()), (1, &[1, 2][..]));
        let log = bus.take_log();
        assert_eq!(log[0].address, Some(0x90));
        assert_eq!(log[0].bytes, [(1, true), (2, false)]);
        assert_eq!(log[0].ending, Ending::RepeatedStart);
        assert_eq!(log[1].bytes, [(0x34, false), (0xFF, true)]);
        assert_eq!((log[1].ending, log[1].end), (Ending::Stop, Some(Ticks(9))));
        assert_eq!(bus.log().len(), 0);
    }

    #[test]
    fn another_address_reaches_nobody() {
        let (mut bus, mut device) = (I2cBus::new(), slave());
        assert_eq!(start(&mut bus, &mut device, 0x92), I2cAnswer::Nack);
        assert_eq!(
            bus.event(I2cEvent::Write(1), Ticks(2), &mut device),
            I2cAnswer::Nack
        );
        assert!(device.written.is_empty());
    }

    #[test]
    fn counted_faults_strike_as_often_as_they_say() {
        let (mut bus, mut device) = (I2cBus::new(), slave());
        bus.inject(I2cFault::NackAddresses(2));
        let answers: Vec<_> = (0..3).map(|_| start(&mut bus, &mut device, 0x90)).collect();
        assert_eq!(answers, [I2cAnswer::Nack, I2cAnswer::Nack, I2cAnswer::Ack]);
        assert_eq!(device.addressed, [0x90]);

        bus.inject(I2cFault::NackData(2));
        let answers: Vec<_> = (0..3)
            .map(|byte| bus.event(I2cEvent::Write(byte), Ticks(3), &mut device))
            .collect();
        assert_eq!(answers, [I2cAnswer::Nack, I2cAnswer::Nack, I2cAnswer::Ack]);
        assert_eq!(device.written, [2]);

        bus.inject(I2cFault::BusErrors(1));
        let errors = (0..3)
            .filter(|_| start(&mut bus, &mut device, 0x90) == I2cAnswer::BusError)
            .count();
        assert_eq!(errors, 1);
        bus.event(I2cEvent::Stop, Ticks(4), &mut device);

        bus.inject(I2cFault::LoseArbitration(2));
        for _ in 0..2 {
            assert_eq!(
                start_at(&mut bus, &mut device, Ticks::from_millis(1)),
                I2cAnswer::ArbitrationLost
            );
            bus.other_master_until = Ticks(0);
        }
        assert_eq!(
            start_at(&mut bus, &mut device, Ticks::from_millis(1)),
            I2cAnswer::Ack
        );
    }

    fn start_at(bus: &mut I2cBus, device: &mut Slave, at: Ticks) -> I2cAnswer {
        match bus.event(I2cEvent::Start, at, device) {
            I2cAnswer::Done => bus.event(I2cEvent::Address(0x90), at, device),
            other => other,
        }
    }

    #[test]
    fn the_winner_keeps_the_bus_for_its_transfer() {
        let (mut bus, mut device) = (I2cBus::new(), slave());
        bus.inject(I2cFault::LoseArbitration(1));
        let at = Ticks::from_millis(1);
        assert_eq!(
            start_at(&mut bus, &mut device, at),
            I2cAnswer::ArbitrationLost
        );
        let before = Ticks((at + OTHER_MASTER).0 - 1);
        assert_eq!(bus.lines(before), (true, false));
        assert_eq!(start_at(&mut bus, &mut device, before), I2cAnswer::Stuck);
        assert_eq!(bus.lines(at + OTHER_MASTER), (true, true));
        assert!(device.addressed.is_empty());
    }

    #[test]
    fn a_scheduled_fault_waits_for_its_time() {
        let (mut bus, _) = (I2cBus::new(), slave());
        let at = Ticks::from_micros(100);
        bus.schedule(at, I2cFault::SdaLow(Some(Ticks::from_micros(50))));
        bus.schedule(
            Ticks::from_micros(10),
            I2cFault::SclLow(Some(Ticks::from_micros(5))),
        );
        let mut at_us = |us| bus.lines(Ticks::from_micros(us));
        assert_eq!(at_us(9), (true, true));
        assert_eq!(at_us(14), (false, true));
        assert_eq!(at_us(15), (true, true));
        assert_eq!(at_us(99), (true, true));
        assert_eq!(at_us(100), (true, false));
        assert_eq!(at_us(149), (true, false));
        assert_eq!(at_us(150), (true, true));
    }

    #[test]
    fn a_held_sda_loses_ones_and_fakes_an_acknowledge() {
        let (mut bus, mut device) = (I2cBus::new(), slave());
        start(&mut bus, &mut device, 0x90);
        bus.inject(I2cFault::HoldSdaInByte { clocks: 9 });
        // Bits 4 … 7 of 0xF0 are zeros anyway.
        assert_eq!(
            bus.event(I2cEvent::Write(0xF0), Ticks(2), &mut device),
            I2cAnswer::Ack
        );
        // The slave lost step: it has not taken the byte.
        assert!(device.written.is_empty());
        assert_eq!(
            bus.event(I2cEvent::Stop, Ticks(3), &mut device),
            I2cAnswer::Stuck
        );
        // The next byte's clocks are the ones that it waits for.
        assert_eq!(
            bus.event(I2cEvent::Write(0x00), Ticks(4), &mut device),
            I2cAnswer::Nack
        );
        assert_eq!(
            bus.event(I2cEvent::Stop, Ticks(5), &mut device),
            I2cAnswer::Done
        );

        start(&mut bus, &mut device, 0x90);
        bus.inject(I2cFault::HoldSdaInByte { clocks: 1 });
        assert_eq!(
            bus.event(I2cEvent::Write(0x0F), Ticks(6), &mut device),
            I2cAnswer::ArbitrationLost
        );
        assert_eq!(bus.levels(Ticks(6)), (true, false));
    }

    #[test]
    fn a_glitch_is_seen_once_by_the_peripheral_and_never_by_the_pins() {
        let mut bus = I2cBus::new();
        bus.inject(I2cFault::Glitch);
        assert_eq!(bus.levels(Ticks(1)), (true, true));
        assert_eq!(bus.lines(Ticks(2)), (false, true));
        assert_eq!(bus.lines(Ticks(3)), (true, true));
        // Within a transaction it is a bus error.
        let mut device = slave();
        start(&mut bus, &mut device, 0x90);
        bus.inject(I2cFault::Glitch);
        assert_eq!(
            bus.event(I2cEvent::Write(1), Ticks(4), &mut device),
            I2cAnswer::BusError
        );
    }

    #[test]
    fn pins_count_pulses_and_make_stops() {
        let (mut bus, mut device) = (I2cBus::new(), slave());
        for _ in 0..3 {
            bus.pins(LOW, None, Ticks(1));
            bus.pins(LOW, None, Ticks(1));
            bus.pins(Some(true), None, Ticks(1));
        }
        assert_eq!((bus.clock_pulses(), bus.pin_stops()), (3, 0));
        // SDA low and high again while SCL is low: nothing.
        for (scl, sda) in [(LOW, None), (LOW, LOW), (LOW, None), (None, None)] {
            bus.pins(scl, sda, Ticks(2));
        }
        assert_eq!(bus.pin_stops(), 0);
        for (scl, sda) in [(LOW, None), (LOW, LOW), (None, LOW), (None, None)] {
            bus.pins(scl, sda, Ticks(3));
        }
        assert_eq!((bus.clock_pulses(), bus.pin_stops()), (5, 1));
        // The slave hears of it with the next event.
        assert_eq!(device.stops, 0);
        bus.event(I2cEvent::Start, Ticks(4), &mut device);
        assert_eq!(device.stops, 1);
        // A short swallows both.
        bus.inject(I2cFault::SclLow(None));
        for (scl, sda) in [(LOW, LOW), (None, LOW), (None, None)] {
            bus.pins(scl, sda, Ticks(5));
        }
        assert_eq!((bus.clock_pulses(), bus.pin_stops()), (5, 1));
    }

    #[test]
    fn the_log_is_bounded() {
        let (mut bus, mut device) = (I2cBus::new(), slave());
        for _ in 0..LOG_LENGTH + 5 {
            start(&mut bus, &mut device, 0x90);
        }
        for byte in 0..=LOG_BYTES {
            bus.event(I2cEvent::Write(byte as u8), Ticks(5), &mut device);
        }
        assert_eq!(bus.log().len(), LOG_LENGTH);
        assert_eq!(bus.log().last().unwrap().bytes.len(), LOG_BYTES);
    }

    proptest! {
        /// A slave in the middle of a byte lets go after exactly the pulses that it misses, by pins or by bytes.
        #[test]
        fn a_held_slave_needs_its_clocks(clocks in 1_u8..10) {
            let mut bus = I2cBus::new();
            bus.inject(I2cFault::HoldSda { clocks });
            for pulse in 0..9 {
                prop_assert_eq!(bus.levels(Ticks(1)).1, pulse >= clocks);
                bus.pins(LOW, None, Ticks(1));
                bus.pins(None, None, Ticks(1));
            }
            prop_assert_eq!(bus.levels(Ticks(1)), (true, true));

            let (mut bus, mut device) = (I2cBus::new(), slave());
            start(&mut bus, &mut device, 0x91);
            bus.inject(I2cFault::HoldSda { clocks });
            // Low until its falling edge number `clocks`.
            let seen = 0xFF_u16 >> (clocks - 1);
            prop_assert_eq!(
                bus.event(I2cEvent::Read { ack: true }, Ticks(2), &mut device),
                I2cAnswer::Byte(seen as u8)
            );
            prop_assert_eq!(bus.levels(Ticks(2)), (true, true));
        }

        /// A slave in the middle of a byte shows bit after bit, and is free at the first clock with a 1 in which a stop is made. A
        /// stop that takes a clock of its own after the 1 was seen finds the next bit.
        #[test]
        fn a_slave_in_the_middle_of_a_byte_shows_its_bits(byte: u8, shown in 0_u8..8) {
            let bits: Vec<bool> = (shown..8).map(|bit| byte & 0x80 >> bit != 0).collect();
            let at = Ticks(1);
            let inject = || {
                let mut bus = I2cBus::new();
                bus.inject(I2cFault::MidByte { byte, shown });
                bus
            };
            let mut bus = inject();
            for bit in &bits {
                prop_assert_eq!(bus.levels(at).1, *bit);
                bus.pins(LOW, None, at);
                bus.pins(None, None, at);
            }
            // Not acknowledged: it has ended, whatever is clocked.
            prop_assert_eq!(bus.levels(at).1, true);
            prop_assert!(bus.sending.is_none());

            // Acknowledged by whoever pulls SDA in the ninth clock: it goes on.
            let mut bus = inject();
            for _ in &bits {
                bus.pins(LOW, LOW, at);
                bus.pins(None, LOW, at);
            }
            bus.pins(LOW, LOW, at);
            bus.pins(LOW, None, at);
            bus.pins(None, None, at);
            prop_assert!(bus.sending.is_some());

            let stop = |bus: &mut I2cBus| {
                for (scl, sda) in [(LOW, None), (LOW, LOW), (None, LOW), (None, None)] {
                    bus.pins(scl, sda, at);
                }
                bus.sending.is_none()
            };
            // The clock of the stop brings the bit after the one that stands there.
            let mut bus = inject();
            let clocks = (1..=9).find(|_| stop(&mut bus));
            let first = bits.iter().skip(1).position(|bit| *bit).unwrap_or(bits.len() - 1);
            prop_assert_eq!(clocks, Some(first + 1));
            prop_assert_eq!(bus.pin_stops(), 1);
        }
    }
}
