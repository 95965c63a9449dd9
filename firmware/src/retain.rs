//! What outlives a reset: 128 words at the end of SRAM that no start-up code touches (memory.x).
//!
//! | words | content |
//! |---|---|
//! | 0 | magic of this layout: the statistics below are ours |
//! | 1 | resets since the memory was last lost |
//! | 2 | how far the start got, and the tasks that were late when the watchdog was last refused |
//! | 3 … 6 | fault record: magic and kind, program counter, link register, configurable fault status |
//! | 7 | line of the last panic, 0 without one |
//! | 8 … 55 | the two slots of `core_logic::retained` |
//! | 56 | CRC-32 of the last panic's file name |
//! | 57 … 72 | end of that name, in bytes |
//!
//! Every word is an atomic of its own, so the fault handler may write whatever it interrupted.

use core::sync::atomic::{AtomicU32, Ordering};

use core_logic::retained::{SLOT_BYTES, SLOT_WORDS, Slot, from_words, to_words};
use crc::{CRC_32_ISO_HDLC, Crc, NoTable};
use stm32f4xx_hal::pac::RCC;

const WORDS: usize = 128;

unsafe extern "C" {
    /// Of memory.x; every bit pattern is a word, and nothing else is placed there.
    safe static _retain: [AtomicU32; WORDS];
}

const MAGIC: usize = 0;
const RESETS: usize = 1;
const PROGRESS: usize = 2;
const FAULT: usize = 3;
const FAULT_PC: usize = 4;
const FAULT_LR: usize = 5;
const FAULT_STATUS: usize = 6;
const PANIC_LINE: usize = 7;
const SLOTS: usize = 8;
const PANIC_FILE_CRC: usize = SLOTS + 2 * SLOT_WORDS;
const PANIC_FILE: usize = PANIC_FILE_CRC + 1;

/// Words of the file's name that are kept, from its end: crate, module and file.
const FILE_WORDS: usize = 16;

const LAYOUT_MAGIC: u32 = 0x4841_4C04;
const FAULT_MAGIC: u32 = 0xFA17_0000;

fn get(index: usize) -> u32 {
    _retain
        .get(index)
        .map_or(0, |word| word.load(Ordering::Relaxed))
}

fn set(index: usize, value: u32) {
    if let Some(word) = _retain.get(index) {
        word.store(value, Ordering::Relaxed);
    }
}

/// Why the core started, as RCC tells; several may hold at once. The bits are those of the Modbus
/// map, which shows only the weightiest of them (`identity`).
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct ResetCause(u16);

impl ResetCause {
    /// Power-on.
    pub const POWER_ON: u16 = 1 << 0;
    /// Reset pin; also set with every internal reset, which drives the pin.
    pub const PIN: u16 = 1 << 1;
    /// Asked for by software: after a panic or a fault.
    pub const SOFTWARE: u16 = 1 << 2;
    /// Independent watchdog.
    pub const WATCHDOG: u16 = 1 << 3;
    /// Window watchdog, which is not used here.
    pub const WINDOW_WATCHDOG: u16 = 1 << 4;
    /// Illegal entry into a low-power mode.
    pub const LOW_POWER: u16 = 1 << 5;
    /// Brown-out.
    pub const BROWN_OUT: u16 = 1 << 6;

    /// Reads the flags and clears them for the next reset.
    pub fn take(rcc: &RCC) -> Self {
        let csr = rcc.csr().read();
        let flags = [
            (csr.porrstf().bit_is_set(), Self::POWER_ON),
            (csr.padrstf().bit_is_set(), Self::PIN),
            (csr.sftrstf().bit_is_set(), Self::SOFTWARE),
            (csr.wdgrstf().bit_is_set(), Self::WATCHDOG),
            (csr.wwdgrstf().bit_is_set(), Self::WINDOW_WATCHDOG),
            (csr.lpwrrstf().bit_is_set(), Self::LOW_POWER),
            (csr.borrstf().bit_is_set(), Self::BROWN_OUT),
        ];
        rcc.csr().modify(|_, w| w.rmvf().set_bit());
        Self(
            flags
                .iter()
                .filter(|(flag, _)| *flag)
                .fold(0, |bits, (_, bit)| bits | bit),
        )
    }

    /// The set as bits.
    pub const fn bits(self) -> u16 {
        self.0
    }

    /// Whether the supply was gone, and the retained memory with it.
    const fn lost_power(self) -> bool {
        self.0 & Self::POWER_ON != 0
    }

    /// Whether the flash may have lost its supply within an erase. A power-on sets this flag as well (RM0090, `RCC_CSR`).
    pub const fn may_have_cut_off(self) -> bool {
        self.0 & Self::BROWN_OUT != 0
    }

    /// The first cause in the order of their weight.
    pub const fn describe(self) -> &'static str {
        match self.0 {
            bits if bits & Self::POWER_ON != 0 => "power on",
            bits if bits & Self::BROWN_OUT != 0 => "brown-out",
            bits if bits & Self::WATCHDOG != 0 => "watchdog",
            bits if bits & Self::WINDOW_WATCHDOG != 0 => "window watchdog",
            bits if bits & Self::SOFTWARE != 0 => "software",
            bits if bits & Self::LOW_POWER != 0 => "low power",
            bits if bits & Self::PIN != 0 => "reset pin",
            _ => "unknown",
        }
    }
}

/// How far the start got. The number of the last stage reached is kept, so that a watchdog reset names what hung.
#[derive(Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Stage {
    /// Waiting for the crystal and the PLL.
    Clock = 1,
    /// Setting the peripherals up.
    Peripherals = 2,
    /// The tasks run.
    Running = 3,
}

/// What stopped the program.
#[derive(Clone, Copy, Debug, PartialEq, Eq, defmt::Format)]
#[repr(u8)]
pub enum FaultKind {
    /// A panic, with its text.
    Panic = 1,
    /// The stack grew below its memory.
    StackOverflow = 2,
    /// Any other fault.
    HardFault = 3,
    /// An exception without a handler.
    Exception = 4,
}

/// The last fault before this start.
#[derive(Clone, Copy, defmt::Format)]
pub struct Fault {
    /// What it was.
    pub kind: FaultKind,
    /// Where.
    pub pc: u32,
    /// From where.
    pub lr: u32,
    /// CFSR at the time.
    pub status: u32,
}

/// The last words of the program before this one.
pub struct Previous {
    /// Why this one started.
    pub cause: ResetCause,
    /// Resets since the memory was last lost.
    pub resets: u32,
    /// The last stage that the previous start reached.
    pub stage: u8,
    /// The tasks that were late when the watchdog was last refused, as bits of `core_logic::check_in::Task`.
    pub late_tasks: u8,
    /// A fault, if one stopped it.
    pub fault: Option<Fault>,
    /// CRC-32 of the panic's file name, or where a fault stopped the program; 0 without either.
    pub fault_hash: u32,
    /// Line of the panic; 0 without one.
    pub panic_line: u32,
    /// The end of the panic's file name, with zeros before it; zeros without a panic.
    pub panic_file: [u8; FILE_WORDS * 4],
}

const CHECKSUM: Crc<u32, NoTable> = Crc::<u32, NoTable>::new(&CRC_32_ISO_HDLC);

/// Takes what the program before this one left, counts the reset and begins a new record.
pub fn begin(cause: ResetCause) -> Previous {
    if cause.lost_power() || get(MAGIC) != LAYOUT_MAGIC {
        for word in &_retain {
            word.store(0, Ordering::Relaxed);
        }
        set(MAGIC, LAYOUT_MAGIC);
    } else {
        set(RESETS, get(RESETS).saturating_add(1));
    }
    let [stage, late_tasks, ..] = get(PROGRESS).to_le_bytes();
    let [kind, ..] = get(FAULT).to_le_bytes();
    let kind = match kind {
        1 => Some(FaultKind::Panic),
        2 => Some(FaultKind::StackOverflow),
        3 => Some(FaultKind::HardFault),
        4 => Some(FaultKind::Exception),
        _ => None,
    };
    let fault = kind
        .filter(|_| get(FAULT) & 0xFFFF_0000 == FAULT_MAGIC)
        .map(|kind| Fault {
            kind,
            pc: get(FAULT_PC),
            lr: get(FAULT_LR),
            status: get(FAULT_STATUS),
        });
    let line = get(PANIC_LINE);
    let is_panic = fault.is_some_and(|fault| fault.kind == FaultKind::Panic) && line != 0;
    let mut panic_file = [0; FILE_WORDS * 4];
    if is_panic {
        for (index, chunk) in panic_file.as_chunks_mut::<4>().0.iter_mut().enumerate() {
            *chunk = get(PANIC_FILE + index).to_le_bytes();
        }
    }
    let previous = Previous {
        cause,
        resets: get(RESETS),
        stage,
        late_tasks,
        fault,
        fault_hash: if is_panic {
            get(PANIC_FILE_CRC)
        } else {
            fault.map_or(0, |fault| fault.pc)
        },
        panic_line: if is_panic { line } else { 0 },
        panic_file,
    };
    set(FAULT, 0);
    set(PANIC_LINE, 0);
    set(PROGRESS, 0);
    previous
}

/// Notes how far the start has got.
pub fn note_stage(stage: Stage) {
    set(PROGRESS, get(PROGRESS) & !0xFF | stage as u32);
}

/// Notes the tasks that keep the watchdog from being fed.
pub fn note_late_tasks(late: u8) {
    set(PROGRESS, get(PROGRESS) & !0xFF00 | u32::from(late) << 8);
}

/// Notes a fault; the first one counts, for what follows is its consequence.
pub fn note_fault(fault: Fault) {
    if get(FAULT) & 0xFFFF_0000 == FAULT_MAGIC {
        return;
    }
    set(FAULT_PC, fault.pc);
    set(FAULT_LR, fault.lr);
    set(FAULT_STATUS, fault.status);
    set(FAULT, FAULT_MAGIC | fault.kind as u32);
}

/// Notes where a panic happened; the first one counts. Whether this was the first.
#[cfg_attr(
    debug_assertions,
    expect(dead_code, reason = "panic-probe handles the panics of a debug build")
)]
pub fn note_panic(file: &str, line: u32) -> bool {
    if get(PANIC_LINE) != 0 {
        return false;
    }
    let mut end = file.as_bytes().iter().rev();
    for index in (PANIC_FILE..PANIC_FILE + FILE_WORDS).rev() {
        let mut word = 0;
        for _ in 0..4 {
            word = word << 8 | u32::from(end.next().copied().unwrap_or(0));
        }
        set(index, word);
    }
    set(PANIC_FILE_CRC, CHECKSUM.checksum(file.as_bytes()));
    set(PANIC_LINE, line);
    true
}

/// Where a slot begins.
const fn start_of(slot: Slot) -> usize {
    match slot {
        Slot::A => SLOTS,
        Slot::B => SLOTS + SLOT_WORDS,
    }
}

/// A copy of a slot.
pub fn slot(slot: Slot) -> [u8; SLOT_BYTES] {
    let mut words = [0; SLOT_WORDS];
    for (index, word) in words.iter_mut().enumerate() {
        *word = get(start_of(slot) + index);
    }
    from_words(&words)
}

/// Writes a slot.
pub fn set_slot(slot: Slot, bytes: &[u8; SLOT_BYTES]) {
    for (index, word) in to_words(bytes).iter().enumerate() {
        set(start_of(slot) + index, *word);
    }
}
