//! W25Q32: 32 Mbit of NOR flash with SPI, as its pins see it.
//!
//! Source: W25Q32JV data sheet. A program clears bits, only an erase sets them, a sector at a time. What a loss of power
//! leaves is the point of this model: a program has written its first bytes, in the byte under way some of the bits are
//! cleared; an erase has set some of the sector's bits. Which ones is drawn from a seeded generator. Bits that read
//! differently from one time to the next, as a real erase cut off can leave them, are not modelled.
//!
//! Not modelled, and reported as [`Violation::Unmodelled`] when used: dual, quad and SFDP commands, security registers,
//! suspend and resume, individual block locks, the WP pin.

mod config;
mod protection;

use std::{collections::BTreeMap, ops::Range};

use rand_chacha::{
    ChaCha8Rng,
    rand_core::{Rng, SeedableRng},
};

use crate::{
    bus::{SpiByte, SpiDevice},
    violations::Violations,
};
pub use config::{Timing, W25q32Config};

/// Bytes of the chip.
pub const CAPACITY: usize = 4 * 1024 * 1024;
/// Bytes of a page, the most that one program writes.
pub const PAGE: usize = 256;
/// Bytes of a sector, the least that one erase sets.
pub const SECTOR: usize = 4096;

/// MISO while the chip does not drive it.
const UNDRIVEN: u8 = 0xFF;
/// Status register 1: an operation is under way.
const BUSY: u8 = 1 << 0;
/// Status register 1: write enable latch.
const WRITE_ENABLED: u8 = 1 << 1;
/// What a write of status registers 1 … 3 can change.
const STATUS_WRITABLE: [u8; 3] = [0xFC, 0x7B, 0xE4];
/// Status register 2, LB3 … LB1: can only be set.
const STATUS_2_ONCE: u8 = 0x38;
/// Status bits whose function is not modelled: SRP, SRL, WPS.
const STATUS_UNMODELLED: [u8; 3] = [0x80, 0x01, 0x04];
/// Times are sums of binary fractions: a gap of exactly the limit must not fail by its last digit. In s.
const EARLY_S: f64 = 1e-10;
/// The same as a factor, for frequencies.
const BARELY: f64 = 1.0 + 1e-9;

mod command {
    pub const WRITE_STATUS_1: u8 = 0x01;
    pub const PAGE_PROGRAM: u8 = 0x02;
    pub const READ: u8 = 0x03;
    pub const WRITE_DISABLE: u8 = 0x04;
    pub const READ_STATUS_1: u8 = 0x05;
    pub const WRITE_ENABLE: u8 = 0x06;
    pub const FAST_READ: u8 = 0x0B;
    pub const WRITE_STATUS_3: u8 = 0x11;
    pub const READ_STATUS_3: u8 = 0x15;
    pub const SECTOR_ERASE: u8 = 0x20;
    pub const WRITE_STATUS_2: u8 = 0x31;
    pub const READ_STATUS_2: u8 = 0x35;
    pub const UNIQUE_ID: u8 = 0x4B;
    pub const VOLATILE_ENABLE: u8 = 0x50;
    pub const HALF_BLOCK_ERASE: u8 = 0x52;
    pub const CHIP_ERASE_TOO: u8 = 0x60;
    pub const ENABLE_RESET: u8 = 0x66;
    pub const IDENTITY: u8 = 0x90;
    pub const RESET: u8 = 0x99;
    pub const JEDEC_ID: u8 = 0x9F;
    pub const RELEASE: u8 = 0xAB;
    pub const POWER_DOWN: u8 = 0xB9;
    pub const CHIP_ERASE: u8 = 0xC7;
    pub const BLOCK_ERASE: u8 = 0xD8;

    /// In the data sheet but not here.
    pub const UNMODELLED: [u8; 22] = [
        0x32, 0x36, 0x38, 0x39, 0x3B, 0x3C, 0x3D, 0x42, 0x44, 0x48, 0x5A, 0x6B, 0x75, 0x77, 0x7A,
        0x7E, 0x92, 0x94, 0x98, 0xBB, 0xE7, 0xEB,
    ];
}

/// What the data sheet forbids, or the chip does not do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Violation {
    /// A command other than read status while an operation is under way: ignored.
    Busy,
    /// A command other than release in power-down: ignored.
    PoweredDown,
    /// A command too soon after power-on, release, power-down or reset: ignored.
    NotReady,
    /// A write without the write enable latch: ignored.
    NotEnabled,
    /// A write into a protected block: ignored.
    Protected,
    /// Chip select rose after the wrong number of bytes: ignored.
    BadLength,
    /// No such command: ignored.
    UnknownCommand,
    /// A command or status bit whose function this model does not have.
    Unmodelled,
    /// A software reset cut off the operation under way.
    ResetWhileBusy,
    /// Neither mode 0 nor mode 3; the byte was garbled.
    WrongMode,
    /// Clock above the command's limit; the byte was garbled.
    ClockTooFast,
    /// Chip select was high for too short a time: the command was ignored.
    SelectHigh,
    /// A byte without chip select.
    NotSelected,
}

/// What an operation does to the content.
#[derive(Clone, Debug)]
enum Work {
    /// Bytes in the order of their addresses within the page.
    Program(Vec<(usize, u8)>),
    Erase(Range<usize>),
    Status([u8; 3]),
}

impl Work {
    /// Bytes that it touches, for the count after which power fails.
    fn bytes(&self) -> u64 {
        match self {
            Self::Program(bytes) => bytes.len() as u64,
            Self::Erase(range) => range.len() as u64,
            Self::Status(_) => 0,
        }
    }
}

/// An operation under way.
#[derive(Clone, Debug)]
struct Operation {
    work: Work,
    start_s: f64,
    end_s: f64,
    /// Power fails when so many of its bytes are done.
    fails_after: Option<u64>,
}

impl Operation {
    /// When it ends, one way or the other.
    fn event_s(&self) -> f64 {
        match self.fails_after {
            Some(done) => {
                let share = done as f64 / self.work.bytes().max(1) as f64;
                self.start_s + share * (self.end_s - self.start_s)
            }
            None => self.end_s,
        }
    }
}

/// What arrived since chip select fell.
#[derive(Clone, Copy, Debug)]
struct Input {
    command: u8,
    /// Bytes, the command included.
    count: usize,
    /// The chip does not obey.
    ignored: bool,
    address: u32,
    /// Data bytes of a write; a program keeps the last of each place.
    data: [u8; PAGE],
}

impl Default for Input {
    fn default() -> Self {
        Self {
            command: 0,
            count: 0,
            ignored: false,
            address: 0,
            data: [0; PAGE],
        }
    }
}

/// The chip.
#[derive(Clone, Debug)]
pub struct W25q32 {
    config: W25q32Config,
    now_s: f64,
    content: Vec<u8>,
    /// Erases of each sector.
    erases: Vec<u32>,
    /// Bits that an erase does not set any more.
    worn: BTreeMap<usize, u8>,
    /// Status registers in force, without BUSY and WEL, and what power-on restores.
    status: [u8; 3],
    saved_status: [u8; 3],
    write_enabled: bool,
    volatile_enabled: bool,
    reset_enabled: bool,
    powered: bool,
    powered_down: bool,
    ready_s: f64,
    write_ready_s: f64,
    operation: Option<Operation>,
    selected: bool,
    deselected_s: f64,
    input: Input,
    slipped: (u8, u8),
    random: ChaCha8Rng,
    off_at_s: Option<f64>,
    on_at_s: Option<f64>,
    /// Bytes left until power fails.
    allowance: Option<u64>,
    lost_power_s: Option<f64>,
    programmed: u64,
    violations: Violations<Violation>,
}

impl W25q32 {
    /// The chip, erased, powered and ready.
    pub fn new(config: W25q32Config, at_s: f64) -> Self {
        Self::with_content(config, at_s, Vec::new())
    }

    /// The chip with this content; what it does not reach is erased.
    pub fn with_content(config: W25q32Config, at_s: f64, content: Vec<u8>) -> Self {
        let mut content = content;
        content.resize(CAPACITY, 0xFF);
        Self {
            config,
            now_s: at_s,
            content,
            erases: vec![0; CAPACITY / SECTOR],
            worn: BTreeMap::new(),
            status: config.status,
            saved_status: config.status,
            write_enabled: false,
            volatile_enabled: false,
            reset_enabled: false,
            powered: true,
            powered_down: false,
            ready_s: at_s,
            write_ready_s: at_s,
            operation: None,
            selected: false,
            deselected_s: f64::NEG_INFINITY,
            input: Input::default(),
            slipped: (0, 0),
            random: ChaCha8Rng::seed_from_u64(config.seed),
            off_at_s: None,
            on_at_s: None,
            allowance: None,
            lost_power_s: None,
            programmed: 0,
            violations: Violations::default(),
        }
    }

    /// Moves to `end_s`. The bus does this too; it is needed before a look at the content.
    pub fn advance(&mut self, end_s: f64) {
        loop {
            let operation_s = self
                .operation
                .as_ref()
                .map_or(f64::INFINITY, Operation::event_s);
            let off_s = self.off_at_s.unwrap_or(f64::INFINITY);
            let on_s = self.on_at_s.unwrap_or(f64::INFINITY);
            let event_s = operation_s.min(off_s).min(on_s);
            if event_s > end_s || event_s.is_infinite() {
                break;
            }
            self.now_s = self.now_s.max(event_s);
            // An operation that ends just when power fails has ended.
            if operation_s <= event_s {
                self.end_operation();
            } else if off_s <= event_s {
                self.off_at_s = None;
                self.switch_off();
            } else {
                self.on_at_s = None;
                self.switch_on();
            }
        }
        self.now_s = self.now_s.max(end_s);
    }

    /// Every byte, as of the last time that the chip was advanced to.
    pub fn content(&self) -> &[u8] {
        &self.content
    }

    /// The content, for another board.
    pub fn into_content(self) -> Vec<u8> {
        self.content
    }

    /// Whether an operation is under way.
    pub fn is_busy(&self) -> bool {
        self.operation.is_some()
    }

    /// Whether the chip has power.
    pub fn is_powered(&self) -> bool {
        self.powered
    }

    /// When [`W25q32::shut_off_after`] cut the power, in s; `None` if it has not.
    pub fn lost_power(&self) -> Option<f64> {
        self.lost_power_s
    }

    /// Power fails at `at_s`, at once if that is past (F19).
    pub fn power_off(&mut self, at_s: f64) {
        if at_s <= self.now_s {
            self.switch_off();
        } else {
            self.off_at_s = Some(at_s);
        }
    }

    /// Power returns at `at_s`, at once if that is past.
    pub fn power_on(&mut self, at_s: f64) {
        if at_s <= self.now_s {
            self.switch_on();
        } else {
            self.on_at_s = Some(at_s);
        }
    }

    /// Power fails once `bytes` more bytes have been programmed or erased: within the operation that would go beyond, at
    /// the corresponding share of its time (F19). It stays off until [`W25q32::power_on`].
    pub fn shut_off_after(&mut self, bytes: u64) {
        self.allowance = Some(bytes);
        self.lost_power_s = None;
        // Another draw for each byte of a sweep.
        self.random = ChaCha8Rng::seed_from_u64(self.config.seed);
        self.random.set_stream(bytes);
    }

    /// Bytes programmed so far.
    pub fn programmed_bytes(&self) -> u64 {
        self.programmed
    }

    /// Erases of the sector that holds `address`.
    pub fn erase_count(&self, address: usize) -> u32 {
        self.erases.get(address / SECTOR).copied().unwrap_or(0)
    }

    /// Bit rot (F20): flips the bits of `mask` in the byte at `address`.
    pub fn flip_bits(&mut self, address: usize, mask: u8) {
        if let Some(byte) = self.content.get_mut(address) {
            *byte ^= mask;
        }
    }

    /// Wear (F20): from now on the bits of `mask` in the byte at `address` stay 0, whatever is erased.
    pub fn wear_out(&mut self, address: usize, mask: u8) {
        if let Some(byte) = self.content.get_mut(address) {
            *byte &= !mask;
            *self.worn.entry(address).or_default() |= mask;
        }
    }

    /// What the bus did that it may not, or the chip did not do.
    pub fn violations(&self) -> &Violations<Violation> {
        &self.violations
    }

    /// Forgets the violations.
    pub fn clear_violations(&mut self) {
        self.violations.clear();
    }

    fn switch_off(&mut self) {
        if !self.powered {
            return;
        }
        if let Some(operation) = self.operation.take() {
            let share = (self.now_s - operation.start_s) / (operation.end_s - operation.start_s);
            let done = share.clamp(0.0, 1.0) * operation.work.bytes() as f64;
            self.cut_off(operation.work, done as u64);
        }
        self.powered = false;
        self.volatile_state();
    }

    fn switch_on(&mut self) {
        if self.powered {
            return;
        }
        self.powered = true;
        self.volatile_state();
        self.ready_s = self.now_s + self.config.timing.power_on_s;
        self.write_ready_s = self.now_s + self.config.timing.power_on_write_s;
        // A chip select that is low already shows no edge.
        self.input.ignored = true;
    }

    /// What a loss of power or a reset forgets.
    fn volatile_state(&mut self) {
        self.status = self.saved_status;
        self.write_enabled = false;
        self.volatile_enabled = false;
        self.reset_enabled = false;
        self.powered_down = false;
        self.input.ignored = true;
    }

    /// Work that power left after `done` of its bytes.
    fn cut_off(&mut self, work: Work, done: u64) {
        match work {
            Work::Program(bytes) => {
                for (index, (address, byte)) in bytes.into_iter().enumerate() {
                    let index = index as u64;
                    if index < done {
                        self.program_byte(address, byte);
                    } else if index == done {
                        // Some of the bits that were to become 0 have.
                        let spared = self.random.next_u32() as u8;
                        self.program_byte(address, byte | spared);
                    }
                }
            }
            Work::Erase(range) => {
                // Each bit on its own, with the share of the time as its probability.
                let share = (done << 32) / (range.len() as u64).max(1);
                for address in range {
                    if self.content[address] == 0xFF {
                        continue;
                    }
                    let mut set = 0;
                    for bit in 0..8 {
                        if u64::from(self.random.next_u32()) < share {
                            set |= 1 << bit;
                        }
                    }
                    self.content[address] |= set & !self.worn_mask(address);
                }
            }
            Work::Status(_) => {}
        }
    }

    fn worn_mask(&self, address: usize) -> u8 {
        self.worn.get(&address).copied().unwrap_or(0)
    }

    fn program_byte(&mut self, address: usize, byte: u8) {
        self.content[address] &= byte;
        self.programmed += 1;
    }

    fn end_operation(&mut self) {
        let Some(operation) = self.operation.take() else {
            return;
        };
        if let Some(done) = operation.fails_after {
            self.cut_off(operation.work, done);
            self.lost_power_s = Some(self.now_s);
            self.switch_off();
            return;
        }
        self.write_enabled = false;
        match operation.work {
            Work::Program(bytes) => {
                for (address, byte) in bytes {
                    self.program_byte(address, byte);
                }
            }
            Work::Erase(range) => {
                for sector in range.start / SECTOR..range.end / SECTOR {
                    self.erases[sector] += 1;
                }
                self.content[range.clone()].fill(0xFF);
                for (&address, &mask) in self.worn.range(range) {
                    self.content[address] &= !mask;
                }
            }
            Work::Status(status) => {
                self.status = status;
                self.saved_status = status;
            }
        }
    }

    /// Whether a write may begin; if not, why not.
    fn may_write(&mut self, range: &Range<usize>, at_s: f64) -> bool {
        let refusal = if !self.write_enabled {
            Some(Violation::NotEnabled)
        } else if self.write_ready_s - at_s > EARLY_S {
            Some(Violation::NotReady)
        } else if protection::covers(self.status, range) {
            Some(Violation::Protected)
        } else {
            None
        };
        if let Some(refusal) = refusal {
            self.violations.record(refusal, at_s);
        }
        refusal.is_none()
    }

    fn begin(&mut self, work: Work, at_s: f64, length_s: f64) {
        let bytes = work.bytes();
        let mut fails_after = None;
        if let Some(left) = &mut self.allowance {
            if bytes > *left {
                fails_after = Some(*left);
                self.allowance = None;
            } else {
                *left -= bytes;
            }
        }
        self.operation = Some(Operation {
            work,
            start_s: at_s,
            end_s: at_s + length_s,
            fails_after,
        });
    }

    fn status_register(&self, index: usize) -> u8 {
        let mut status = self.status[index];
        if index == 0 {
            status &= !(BUSY | WRITE_ENABLED);
            status |= if self.operation.is_some() { BUSY } else { 0 };
            status |= if self.write_enabled { WRITE_ENABLED } else { 0 };
        }
        status
    }

    /// Whether the chip obeys a command that begins now.
    fn refusal(&self, code: u8, at_s: f64) -> Option<Violation> {
        use command::{ENABLE_RESET, READ_STATUS_1, READ_STATUS_2, READ_STATUS_3, RELEASE, RESET};
        if self.ready_s - at_s > EARLY_S {
            Some(Violation::NotReady)
        } else if self.powered_down && code != RELEASE {
            Some(Violation::PoweredDown)
        } else if self.operation.is_some()
            && ![
                READ_STATUS_1,
                READ_STATUS_2,
                READ_STATUS_3,
                ENABLE_RESET,
                RESET,
            ]
            .contains(&code)
        {
            Some(Violation::Busy)
        } else if command::UNMODELLED.contains(&code) {
            Some(Violation::Unmodelled)
        } else {
            None
        }
    }

    /// Output for the byte now under way; `input.count` bytes came before it.
    fn output(&self) -> u8 {
        let Input {
            command: code,
            count,
            address,
            ..
        } = self.input;
        let read = |first: usize| {
            count.checked_sub(first).map_or(UNDRIVEN, |offset| {
                self.content[(address as usize + offset) % CAPACITY]
            })
        };
        match code {
            command::READ_STATUS_1 => self.status_register(0),
            command::READ_STATUS_2 => self.status_register(1),
            command::READ_STATUS_3 => self.status_register(2),
            command::READ => read(4),
            command::FAST_READ => read(5),
            command::JEDEC_ID => {
                let id = self.config.jedec_id;
                id.get(count - 1).copied().unwrap_or(UNDRIVEN)
            }
            command::RELEASE if count >= 4 => self.config.device_id,
            command::IDENTITY if count >= 4 => {
                // Bit 0 of the address swaps the order.
                if (count as u32 ^ address) & 1 == 0 {
                    self.config.jedec_id[0]
                } else {
                    self.config.device_id
                }
            }
            command::UNIQUE_ID => {
                let id = self.config.unique_id;
                count
                    .checked_sub(5)
                    .and_then(|index| id.get(index).copied())
                    .unwrap_or(UNDRIVEN)
            }
            _ => UNDRIVEN,
        }
    }

    fn take(&mut self, byte: u8) {
        let input = &mut self.input;
        let address_first = matches!(
            input.command,
            command::READ
                | command::FAST_READ
                | command::PAGE_PROGRAM
                | command::SECTOR_ERASE
                | command::HALF_BLOCK_ERASE
                | command::BLOCK_ERASE
                | command::IDENTITY
        );
        if address_first && input.count < 4 {
            input.address = input.address << 8 | u32::from(byte);
        } else {
            let first = if address_first { 4 } else { 1 };
            // The address wraps within its page.
            let low = input.address as usize % PAGE;
            input.data[(low + input.count - first) % PAGE] = byte;
        }
        input.count += 1;
    }

    fn erase(&mut self, size: usize, at_s: f64, length_s: f64) {
        let start = self.input.address as usize % CAPACITY / size * size;
        let range = start..start + size;
        if self.may_write(&range, at_s) {
            self.begin(Work::Erase(range), at_s, length_s);
        }
    }

    fn program(&mut self, at_s: f64) {
        let timing = self.config.timing;
        let address = self.input.address as usize % CAPACITY;
        let page = address / PAGE * PAGE;
        if !self.may_write(&(page..page + PAGE), at_s) {
            return;
        }
        let count = (self.input.count - 4).min(PAGE);
        // Of more than a page the last bytes count, which end where the last one went.
        let first = if self.input.count - 4 > PAGE {
            (address % PAGE + self.input.count - 4) % PAGE
        } else {
            address % PAGE
        };
        let bytes = (0..count)
            .map(|index| (first + index) % PAGE)
            .map(|place| (page + place, self.input.data[place]))
            .collect();
        let length_s = timing.first_byte_s + (count - 1) as f64 * timing.further_byte_s;
        self.begin(Work::Program(bytes), at_s, length_s.min(timing.page_s));
    }

    fn write_status(&mut self, register: usize, at_s: f64) {
        // 01h takes status register 2 as a second byte.
        let bytes = self.input.count - 1;
        let most = if register == 0 { 2 } else { 1 };
        if bytes == 0 || bytes > most {
            self.violations.record(Violation::BadLength, at_s);
            return;
        }
        if !self.write_enabled && !self.volatile_enabled {
            self.violations.record(Violation::NotEnabled, at_s);
            return;
        }
        let mut status = self.status;
        for index in 0..bytes {
            let register = register + index;
            let value = self.input.data[index];
            let writable = STATUS_WRITABLE[register];
            let kept = status[register] & !writable;
            let once = if register == 1 {
                status[1] & STATUS_2_ONCE
            } else {
                0
            };
            status[register] = kept | value & writable | once;
            if value & STATUS_UNMODELLED[register] != 0 {
                self.violations.record(Violation::Unmodelled, at_s);
            }
        }
        if self.write_enabled {
            let length_s = self.config.timing.status_write_s;
            self.begin(Work::Status(status), at_s, length_s);
        } else {
            self.volatile_enabled = false;
            self.status = status;
        }
    }

    fn reset(&mut self, at_s: f64) {
        if let Some(operation) = self.operation.take() {
            self.violations.record(Violation::ResetWhileBusy, at_s);
            let share = (at_s - operation.start_s) / (operation.end_s - operation.start_s);
            let done = share.clamp(0.0, 1.0) * operation.work.bytes() as f64;
            self.cut_off(operation.work, done as u64);
        }
        self.volatile_state();
        self.ready_s = at_s + self.config.timing.reset_s;
    }

    /// Chip select rises: commands without an answer take effect.
    fn execute(&mut self, at_s: f64) {
        let timing = self.config.timing;
        let Input {
            command: code,
            count,
            ..
        } = self.input;
        let reset_enabled = std::mem::take(&mut self.reset_enabled);
        // How many bytes a command that acts has: exactly, or at least.
        let right_length = match code {
            command::WRITE_ENABLE
            | command::WRITE_DISABLE
            | command::VOLATILE_ENABLE
            | command::ENABLE_RESET
            | command::RESET
            | command::POWER_DOWN
            | command::CHIP_ERASE
            | command::CHIP_ERASE_TOO => count == 1,
            command::SECTOR_ERASE | command::HALF_BLOCK_ERASE | command::BLOCK_ERASE => count == 4,
            command::PAGE_PROGRAM => count > 4,
            _ => true,
        };
        if !right_length {
            self.violations.record(Violation::BadLength, at_s);
            return;
        }
        match code {
            command::WRITE_ENABLE => self.write_enabled = true,
            command::WRITE_DISABLE => self.write_enabled = false,
            command::VOLATILE_ENABLE => self.volatile_enabled = true,
            command::WRITE_STATUS_1 => self.write_status(0, at_s),
            command::WRITE_STATUS_2 => self.write_status(1, at_s),
            command::WRITE_STATUS_3 => self.write_status(2, at_s),
            command::PAGE_PROGRAM => self.program(at_s),
            command::SECTOR_ERASE => self.erase(SECTOR, at_s, timing.sector_erase_s),
            command::HALF_BLOCK_ERASE => self.erase(0x8000, at_s, timing.half_block_erase_s),
            command::BLOCK_ERASE => self.erase(0x1_0000, at_s, timing.block_erase_s),
            command::CHIP_ERASE | command::CHIP_ERASE_TOO => {
                self.erase(CAPACITY, at_s, timing.chip_erase_s);
            }
            command::POWER_DOWN => {
                self.powered_down = true;
                self.ready_s = at_s + timing.power_down_s;
            }
            command::RELEASE => {
                if std::mem::take(&mut self.powered_down) {
                    self.ready_s = at_s
                        + if count > 4 {
                            timing.release_with_id_s
                        } else {
                            timing.release_s
                        };
                }
            }
            command::ENABLE_RESET => self.reset_enabled = true,
            command::RESET if reset_enabled => self.reset(at_s),
            command::READ
            | command::FAST_READ
            | command::READ_STATUS_1
            | command::READ_STATUS_2
            | command::READ_STATUS_3
            | command::JEDEC_ID
            | command::IDENTITY
            | command::UNIQUE_ID => {}
            _ => self.violations.record(Violation::UnknownCommand, at_s),
        }
    }
}

impl SpiDevice for W25q32 {
    fn select(&mut self, at_s: f64) {
        self.advance(at_s);
        self.selected = true;
        self.input = Input::default();
        if self.powered && at_s - self.deselected_s < self.config.timing.deselect_s - EARLY_S {
            self.violations.record(Violation::SelectHigh, at_s);
            self.input.ignored = true;
        }
    }

    fn deselect(&mut self, at_s: f64) {
        self.advance(at_s);
        let complete = self.selected && self.powered && !self.input.ignored;
        if complete && self.input.count > 0 {
            self.execute(at_s);
        }
        self.selected = false;
        self.deselected_s = at_s;
    }

    fn exchange(&mut self, byte: SpiByte) -> u8 {
        self.advance(byte.start_s);
        if !self.powered {
            return UNDRIVEN;
        }
        if !self.selected {
            self.violations.record(Violation::NotSelected, byte.start_s);
            return UNDRIVEN;
        }
        let wrong_mode = byte.mode != 0 && byte.mode != 3;
        if wrong_mode {
            self.violations.record(Violation::WrongMode, byte.start_s);
        }
        let limit_hz = if self.input.count > 0 && self.input.command == command::READ {
            self.config.timing.read_clock_max_hz
        } else {
            self.config.timing.clock_max_hz
        };
        let too_fast = byte.clock_hz > limit_hz * BARELY;
        if too_fast {
            self.violations
                .record(Violation::ClockTooFast, byte.start_s);
        }
        // Either way the bits are sampled an edge off: everything slips by one bit.
        let garbled = wrong_mode || too_fast;
        let mut mosi = byte.mosi;
        if garbled {
            mosi = mosi >> 1 | self.slipped.0 << 7;
            self.slipped.0 = byte.mosi & 1;
        }
        let mut miso = UNDRIVEN;
        if self.input.count == 0 {
            self.input.command = mosi;
            self.input.count = 1;
            if !self.input.ignored
                && let Some(refusal) = self.refusal(mosi, byte.start_s)
            {
                self.violations.record(refusal, byte.start_s);
                self.input.ignored = true;
            }
        } else if !self.input.ignored {
            miso = self.output();
            self.take(mosi);
        }
        if garbled {
            let slipped = miso >> 1 | self.slipped.1 << 7;
            self.slipped.1 = miso & 1;
            miso = slipped;
        }
        miso
    }
}
