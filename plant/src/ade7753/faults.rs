//! What can be made to go wrong, and what the chip remembers of its bus.

use std::collections::VecDeque;

use rand_chacha::{
    ChaCha8Rng,
    rand_core::{Rng, SeedableRng},
};

/// What the data sheet forbids.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Violation {
    /// t9: the first data byte of a read came too soon after the command; the chip gave what its shift register still
    /// held.
    ReadTooSoon,
    /// t6 or t7: the bytes of a write came too fast; the write had no effect.
    WriteTooFast,
    /// The command after a write came before the chip had taken the write in; the read that follows is stale.
    CommandTooSoon,
    /// SCLK above its limit; the byte was garbled.
    ClockTooFast,
    /// Not mode 1; the byte was garbled.
    WrongMode,
    /// t1: the first edge too soon after the falling edge of chip select.
    SelectSetup,
    /// t8: chip select rose too soon after the last edge of a write.
    SelectHold,
    /// A transfer within 18 µs after a software reset; the chip did not listen.
    InReset,
    /// A byte without chip select.
    NotSelected,
    /// A write to a register that can only be read.
    ReadOnly,
    /// An address without a register.
    NoSuchRegister,
    /// A register or a bit whose function this model does not have: its result means nothing.
    Unmodelled,
}

/// A level forced onto a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Level {
    /// Stuck low.
    Low,
    /// Stuck high.
    High,
}

/// Bits to flip in the data of one read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Flip {
    /// Exclusive-or with the register's value, right-justified.
    Mask(u32),
    /// This bit, and the nearest one above (else below) that has the opposite value: CHKSUM stays right.
    Compensated(u32),
}

impl Flip {
    fn mask(self, value: u32, bits: u32) -> u32 {
        match self {
            Self::Mask(mask) => mask,
            Self::Compensated(bit) => {
                let opposite = |&other: &u32| (value >> other ^ value >> bit) & 1 == 1;
                (bit + 1..bits)
                    .find(opposite)
                    .or_else(|| (0..bit.min(bits)).rev().find(opposite))
                    .map_or(0, |other| 1 << bit | 1 << other)
            }
        }
    }
}

#[derive(Clone, Copy, Debug)]
struct Scheduled {
    not_before_s: f64,
    register: u8,
    flip: Flip,
}

/// One transfer as the bus saw it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Transaction {
    /// First edge of the command, in s.
    pub start_s: f64,
    /// Last edge of the command, in s.
    pub command_end_s: f64,
    /// First edge of the first data byte, in s; NaN if there was none.
    pub data_start_s: f64,
    /// Last edge of the last byte, in s.
    pub end_s: f64,
    /// Address.
    pub register: u8,
    /// A write.
    pub write: bool,
    /// Data bytes transferred.
    pub bytes: usize,
    /// What the chip shifted out, or took in.
    pub sent: u32,
    /// What arrived at the master, or `sent`.
    pub seen: u32,
    /// All bytes of the register were transferred.
    pub complete: bool,
}

impl Transaction {
    /// From the end of the command to the first data bit, in s (t9); NaN if there was no data.
    pub fn command_to_data_s(&self) -> f64 {
        self.data_start_s - self.command_end_s
    }
}

#[derive(Clone, Debug)]
pub(super) struct Line {
    /// Per bit, as a share of 2³².
    flip_threshold: u64,
    random: ChaCha8Rng,
    scheduled: Vec<Scheduled>,
    pub stuck_miso: Option<Level>,
    pub stuck_irq: Option<Level>,
    pub flipped_bits: u64,
    pub log: VecDeque<Transaction>,
    pub log_length: usize,
}

impl Line {
    pub fn new() -> Self {
        Self {
            flip_threshold: 0,
            random: ChaCha8Rng::seed_from_u64(0),
            scheduled: Vec::new(),
            stuck_miso: None,
            stuck_irq: None,
            flipped_bits: 0,
            log: VecDeque::new(),
            log_length: 256,
        }
    }

    pub fn flip_at_rate(&mut self, per_bit: f64, seed: u64) {
        self.flip_threshold = (per_bit.clamp(0.0, 1.0) * 2f64.powi(32)) as u64;
        self.random = ChaCha8Rng::seed_from_u64(seed);
    }

    pub fn schedule(&mut self, not_before_s: f64, register: u8, flip: Flip) {
        self.scheduled.push(Scheduled {
            not_before_s,
            register,
            flip,
        });
    }

    /// The flips ordered for a read that begins now.
    pub fn take_scheduled(&mut self, at_s: f64, register: u8, value: u32, bits: u32) -> u32 {
        let due = self
            .scheduled
            .iter()
            .position(|flip| flip.register == register && flip.not_before_s <= at_s);
        due.map_or(0, |index| {
            self.scheduled.remove(index).flip.mask(value, bits)
        })
    }

    /// A byte on its way to the master.
    pub fn carry(&mut self, sent: u8, ordered: u8) -> u8 {
        let mut flips = ordered;
        if self.flip_threshold != 0 {
            for bit in 0..8 {
                if u64::from(self.random.next_u32()) < self.flip_threshold {
                    flips ^= 1 << bit;
                }
            }
        }
        self.flipped_bits += u64::from(flips.count_ones());
        self.stuck(sent ^ flips)
    }

    pub const fn stuck(&self, byte: u8) -> u8 {
        match self.stuck_miso {
            None => byte,
            Some(Level::Low) => 0x00,
            Some(Level::High) => 0xFF,
        }
    }

    pub fn record(&mut self, transaction: Transaction) {
        if self.log_length == 0 {
            return;
        }
        while self.log.len() >= self.log_length {
            self.log.pop_front();
        }
        self.log.push_back(transaction);
    }
}
