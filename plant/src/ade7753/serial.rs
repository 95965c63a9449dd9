//! The serial interface (Rev C, serial interface section).

use super::{
    Ade7753, Transaction, Violation,
    registers::{self, Access, Register, address},
};
use crate::bus::{SpiByte, SpiDevice};

/// MISO while the chip does not drive it: pulled up.
const UNDRIVEN: u8 = 0xFF;
/// Bit 7 of the communications register: the transfer is a write.
const WRITE: u8 = 0x80;

/// Where the interface is.
#[derive(Clone, Copy, Debug, Default)]
enum Phase {
    /// Chip select is high.
    #[default]
    Deselected,
    /// Communications mode: the next byte is a command.
    Command,
    /// Data of a read or a write.
    Data(Transfer),
    /// Garbled or in reset: waits for chip select.
    Deaf,
}

/// A transfer under way.
#[derive(Clone, Copy, Debug)]
struct Transfer {
    register: Register,
    log: Transaction,
    /// What is shifted out, or in so far.
    value: u32,
    /// Flips ordered for it.
    flips: u32,
    /// The command came too soon after a write, or the data after the command.
    spoilt: bool,
}

/// State of the interface.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Serial {
    phase: Phase,
    selected_s: f64,
    /// No byte since chip select fell.
    fresh: bool,
    /// Ones in the last read.
    ones: u32,
    /// The output shift register as the last read left it.
    shift: u32,
    /// End of the last written data byte.
    written_s: Option<f64>,
    /// Last bit shifted in and out, for what a wrong clock makes of the next byte.
    slipped: (u8, u8),
}

impl Serial {
    pub const fn ones(&self) -> u32 {
        self.ones
    }

    /// IRQ is high while RSTSTATUS is shifted out (ADE7763 Rev C, interrupts).
    pub const fn releases_irq(&self) -> bool {
        matches!(
            self.phase,
            Phase::Data(Transfer { register, .. }) if register.address == address::RSTSTATUS
        )
    }

    pub fn reset(&mut self, by_command: bool) {
        *self = Self {
            phase: match self.phase {
                Phase::Deselected => Phase::Deselected,
                // The transfer that carried the reset is over; a brown-out cuts one off.
                _ if by_command => Phase::Command,
                _ => Phase::Deaf,
            },
            selected_s: self.selected_s,
            ..Self::default()
        };
    }
}

impl Ade7753 {
    fn violation(&mut self, kind: Violation, at_s: f64) {
        self.violations.record(kind, at_s);
    }

    /// Starts a transfer; what follows is its data.
    fn command(&mut self, mosi: u8, byte: &SpiByte) -> Phase {
        let timing = self.config.serial;
        let written_s = self.serial.written_s.take();
        let too_soon = written_s
            .is_some_and(|end_s| byte.start_s - end_s < timing.write_to_command_s - EARLY_S);
        if too_soon {
            self.violation(Violation::CommandTooSoon, byte.start_s);
        }
        let write = mosi & WRITE != 0;
        // Bit 6 does not exist.
        let Some(register) = registers::at(mosi & !WRITE) else {
            self.violation(Violation::NoSuchRegister, byte.start_s);
            return Phase::Deaf;
        };
        if write && register.access != Access::ReadWrite {
            self.violation(Violation::ReadOnly, byte.start_s);
        }
        let mut transfer = Transfer {
            register,
            log: Transaction {
                start_s: byte.start_s,
                command_end_s: byte.end_s,
                data_start_s: f64::NAN,
                end_s: byte.end_s,
                register: register.address,
                write,
                bytes: 0,
                sent: 0,
                seen: 0,
                complete: false,
            },
            value: 0,
            flips: 0,
            spoilt: too_soon,
        };
        if !write {
            // The whole register goes to the interface at once (ADE7756, serial read operation), when the command ends.
            transfer.value = self.latch(register.address, byte.end_s) & register.mask();
            transfer.flips = self.line.take_scheduled(
                byte.end_s,
                register.address,
                transfer.value,
                register.bits,
            );
            self.serial.ones = 0;
        }
        Phase::Data(transfer)
    }

    fn data(&mut self, mut transfer: Transfer, mosi: u8, byte: &SpiByte) -> (Phase, u8) {
        let timing = self.config.serial;
        let length = transfer.register.bytes();
        let first = transfer.log.bytes == 0;
        if first {
            transfer.log.data_start_s = byte.start_s;
        }
        let mut miso = UNDRIVEN;
        if transfer.log.write {
            let gap_s = byte.start_s - transfer.log.end_s;
            let end_to_end_s = byte.end_s - transfer.log.end_s;
            if gap_s < timing.write_byte_gap_s - EARLY_S
                || end_to_end_s < timing.write_byte_end_to_end_s - EARLY_S
            {
                self.violation(Violation::WriteTooFast, byte.start_s);
                transfer.spoilt = true;
            }
            transfer.value = transfer.value << 8 | u32::from(mosi);
            transfer.log.sent = transfer.value;
            transfer.log.seen = transfer.value;
            self.serial.written_s = Some(byte.end_s);
        } else {
            if first {
                let gap_s = byte.start_s - transfer.log.command_end_s;
                if gap_s < timing.command_to_data_s - EARLY_S {
                    self.violation(Violation::ReadTooSoon, byte.start_s);
                    transfer.spoilt = true;
                }
                if transfer.spoilt {
                    transfer.value = self.serial.shift & transfer.register.mask();
                }
            }
            let shift = 8 * (length - 1 - transfer.log.bytes);
            let sent = (transfer.value >> shift) as u8;
            // Each bit counts as it is shifted out, whatever the line makes of it.
            self.serial.ones = (self.serial.ones + sent.count_ones()) & 0x3F;
            miso = self.line.carry(sent, (transfer.flips >> shift) as u8);
            transfer.log.sent = transfer.log.sent << 8 | u32::from(sent);
            transfer.log.seen = transfer.log.seen << 8 | u32::from(miso);
        }
        transfer.log.bytes += 1;
        transfer.log.end_s = byte.end_s;
        if transfer.log.bytes < length {
            return (Phase::Data(transfer), miso);
        }
        transfer.log.complete = true;
        self.line.record(transfer.log);
        self.serial.phase = Phase::Command;
        if !transfer.log.write {
            self.serial.shift = transfer.value;
        } else if transfer.register.access == Access::ReadWrite && !transfer.spoilt {
            self.store(transfer.register.address, transfer.value, byte.end_s);
        }
        (self.serial.phase, miso)
    }

    fn in_reset(&self, at_s: f64) -> bool {
        self.reset_until_s
            .is_some_and(|until_s| at_s < until_s - EARLY_S)
    }
}

/// Times are sums of binary fractions: a gap of exactly the limit must not fail by its last digit. In s.
const EARLY_S: f64 = 1e-10;
/// The same as a factor, for frequencies.
const BARELY: f64 = 1.0 + 1e-9;

impl SpiDevice for Ade7753 {
    fn select(&mut self, at_s: f64) {
        self.serial.phase = Phase::Command;
        self.serial.selected_s = at_s;
        self.serial.fresh = true;
        // A write's time to be taken in runs on over chip select.
    }

    fn deselect(&mut self, at_s: f64) {
        if let Phase::Data(transfer) = self.serial.phase {
            self.line.record(transfer.log);
            // Byte by byte into the register (ADE7759, serial write operation): those that were complete stay.
            let missing = transfer.register.bytes() - transfer.log.bytes;
            let begun = transfer.log.write && transfer.log.bytes > 0 && !transfer.spoilt;
            if begun && transfer.register.access == Access::ReadWrite {
                let address = transfer.register.address;
                let kept = self.registers[usize::from(address)] & ((1 << (8 * missing)) - 1);
                let value = transfer.value << (8 * missing) | kept;
                self.store(address, value, at_s);
            }
        }
        if let Some(end_s) = self.serial.written_s
            && at_s - end_s < self.config.serial.select_hold_s - EARLY_S
        {
            self.violation(Violation::SelectHold, at_s);
        }
        self.serial.phase = Phase::Deselected;
    }

    /// The chip is to be advanced to the end of the byte before: a register is latched with what it has then.
    fn exchange(&mut self, byte: SpiByte) -> u8 {
        let timing = self.config.serial;
        if matches!(self.serial.phase, Phase::Deselected) {
            self.violation(Violation::NotSelected, byte.start_s);
            return self.line.stuck(UNDRIVEN);
        }
        if self.in_reset(byte.start_s) {
            if self.reset_by_command {
                self.violation(Violation::InReset, byte.start_s);
            }
            self.serial.phase = Phase::Deaf;
        }
        let fresh = std::mem::replace(&mut self.serial.fresh, false);
        if fresh && byte.start_s - self.serial.selected_s < timing.select_setup_s - EARLY_S {
            self.violation(Violation::SelectSetup, byte.start_s);
            self.serial.phase = Phase::Deaf;
        }
        let too_fast = byte.clock_hz > timing.clock_max_hz * BARELY;
        if too_fast {
            self.violation(Violation::ClockTooFast, byte.start_s);
        }
        let wrong_mode = byte.mode != 1;
        if wrong_mode {
            self.violation(Violation::WrongMode, byte.start_s);
        }
        // Either way the bits are sampled an edge off: everything slips by one bit.
        let garbled = too_fast || wrong_mode;
        let mut mosi = byte.mosi;
        if garbled {
            mosi = mosi >> 1 | self.serial.slipped.0 << 7;
            self.serial.slipped.0 = byte.mosi & 1;
        }
        let mut miso = UNDRIVEN;
        self.serial.phase = match self.serial.phase {
            Phase::Command => self.command(mosi, &byte),
            Phase::Data(transfer) => {
                let (phase, out) = self.data(transfer, mosi, &byte);
                miso = out;
                phase
            }
            other => other,
        };
        if garbled {
            let slipped = miso >> 1 | self.serial.slipped.1 << 7;
            self.serial.slipped.1 = miso & 1;
            miso = slipped;
        }
        self.line.stuck(miso)
    }
}
