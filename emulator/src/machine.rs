//! The running MCU: core, memories, peripherals and virtual time.

use std::fmt;
use std::sync::Arc;

use rsemu::core::space::{
    AddressSpace, DispatchPolicy, Perms, RamStore, Region, RomStore, RomWrite,
};

use crate::board::Board;
use crate::can_bus::CanBus;
use crate::cpu::Cpu;
use crate::image::{
    CCM_LENGTH, CCM_START, FLASH_LENGTH, FLASH_START, Image, SRAM_LENGTH, SRAM_START,
};
use crate::mcu::adc::Adc1;
use crate::mcu::flash_interface::FlashInterface;
use crate::mcu::iwdg::Iwdg;
use crate::mcu::rcc::{Rcc, ResetCause};
use crate::mcu::system_bus::{Failure, SystemBus};
use crate::mcu::tim2::Tim2;
use crate::mcu::usart::Usart;
use crate::mcu::{Lines, Unmodelled, system_memory};
use crate::rtt::{Log, Memory};
use crate::time::Ticks;

/// Where the peripherals' addresses begin and how long the range is that the MCU decodes (RM0090, memory map).
const PERIPHERALS: (u64, u64) = (0x4000_0000, 0x0008_0000);
/// DBGMCU, its four registers. Nobody debugs: they keep what is written, and it has no effect.
const DEBUG: (u64, u64) = (0xE004_2000, 16);
/// Its first, IDCODE, of an STM32F405 (DEV_ID 0x413) of revision Z (RM0090, MCU device ID code).
const IDCODE: u32 = 0x1001_6413;
/// Factory values and unique ID.
const SYSTEM_MEMORY: u64 = 0x1FFF_7A00;
/// The longest time that a polling loop is let turn at once.
const LONGEST_SKIP: Ticks = Ticks::from_micros(8);
/// So many steps of one cycle in a row, and the core is asked whether it sleeps.
const ASK_AFTER: u8 = 8;
/// How often the log channel is read: a probe does it about as often.
const LOG_PERIOD: Ticks = Ticks::from_millis(1);

/// Why the machine stopped.
#[derive(Clone, Debug, PartialEq)]
pub enum MachineError {
    /// The image touched what the model lacks.
    Unmodelled {
        /// What.
        access: Unmodelled,
        /// Address of the instruction.
        pc: u32,
        /// When, in s.
        at_s: f64,
    },
    /// The core stopped executing, a fault where no handler can be taken, and no watchdog runs that would reset it.
    LockedUp {
        /// Where.
        pc: u32,
        /// When, in s.
        at_s: f64,
    },
}

impl fmt::Display for MachineError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Unmodelled { access, pc, at_s } => {
                write!(f, "at {at_s:.6} s, pc {pc:#010X}: {access}")
            }
            Self::LockedUp { pc, at_s } => {
                write!(f, "at {at_s:.6} s, pc {pc:#010X}: the core is locked up")
            }
        }
    }
}

impl std::error::Error for MachineError {}

/// A reset that the machine went through.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ResetEvent {
    /// When.
    pub at: Ticks,
    /// Why.
    pub cause: ResetCause,
}

/// Where the core's time went.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Load {
    /// Executing.
    pub busy: Ticks,
    /// In WFI.
    pub asleep: Ticks,
}

impl Load {
    /// Share of the time that the core executed, 0 … 1.
    pub fn share(&self) -> f64 {
        let total = self.busy.0 + self.asleep.0;
        if total == 0 {
            0.0
        } else {
            self.busy.0 as f64 / total as f64
        }
    }
}

/// The emulated board.
pub struct Machine<'table> {
    cpu: Cpu,
    bus: Arc<SystemBus>,
    memories: Memories,
    debug: Arc<RamStore>,
    log: Option<Log<'table>>,
    log_lines: Vec<String>,
    now: Ticks,
    next_log: Ticks,
    load: Load,
    resets: Vec<ResetEvent>,
    instructions: u64,
    locked_up: bool,
    /// The reset line is low until then.
    held_until: Ticks,
    exact: bool,
}

/// The RAMs.
#[derive(Clone)]
struct Memories {
    sram: Arc<RamStore>,
    ccm: Arc<RamStore>,
}

impl Memories {
    fn place(&self, address: u32) -> Option<(&RamStore, u64)> {
        if let Some(offset) = address
            .checked_sub(SRAM_START)
            .filter(|offset| *offset < SRAM_LENGTH)
        {
            return Some((&self.sram, u64::from(offset)));
        }
        address
            .checked_sub(CCM_START)
            .filter(|offset| *offset < CCM_LENGTH)
            .map(|offset| (&*self.ccm, u64::from(offset)))
    }
}

impl Memory for Memories {
    fn word(&self, address: u32) -> Option<u32> {
        let (store, offset) = self.place(address)?;
        let mut bytes = [0; 4];
        store.read_at(offset, &mut bytes).ok()?;
        Some(u32::from_le_bytes(bytes))
    }

    fn byte(&self, address: u32) -> Option<u8> {
        let (store, offset) = self.place(address)?;
        store.read_u8(offset).ok()
    }

    fn set_word(&self, address: u32, value: u32) {
        if let Some((store, offset)) = self.place(address) {
            // The address was just found to be inside.
            let _ = store.write_at(offset, &value.to_le_bytes());
        }
    }
}

impl<'table> Machine<'table> {
    /// A board whose power comes on at time 0.
    ///
    /// # Errors
    /// If the memory map cannot be built, which no image can cause.
    pub fn new(image: &Image, log: Option<Log<'table>>, board: Board) -> anyhow::Result<Self> {
        let memories = Memories {
            sram: Arc::new(RamStore::new(u64::from(SRAM_LENGTH))),
            ccm: Arc::new(RamStore::new(u64::from(CCM_LENGTH))),
        };
        let flash = Arc::new(RomStore::new(image.flash.clone()));
        let factory = Arc::new(RomStore::new(system_memory::content().to_vec()));
        let bus = Arc::new(SystemBus::new(board));
        let debug = Arc::new(RamStore::new(DEBUG.1));
        // Most accesses are fetches: a table by page finds their memory faster than a search.
        let space = AddressSpace::new("stm32f405", 32).with_dispatch(DispatchPolicy::Dense {
            page_bits: 16,
            cover: PERIPHERALS.0 + PERIPHERALS.1,
        });
        {
            let mut map = space.topology();
            // With BOOT0 low the flash is seen at 0 as well.
            for start in [0, u64::from(FLASH_START)] {
                map.map(
                    Region::rom("flash", Arc::clone(&flash), RomWrite::Fault),
                    start,
                )?;
            }
            map.map(
                Region::ram("sram", Arc::clone(&memories.sram)),
                u64::from(SRAM_START),
            )?;
            // On the D-bus alone: nothing can be fetched from it.
            map.map_with_perms(
                Region::ram("ccm", Arc::clone(&memories.ccm)),
                u64::from(CCM_START),
                Perms::RW,
            )?;
            map.map(
                Region::rom("system memory", factory, RomWrite::Fault),
                SYSTEM_MEMORY,
            )?;
            // Execute Never (ARMv7-M, default memory map). The fault is a BusFault (IBUSERR) here, on silicon a MemManage.
            map.map_with_perms(
                Region::io("peripherals", PERIPHERALS.1, Arc::<SystemBus>::clone(&bus)),
                PERIPHERALS.0,
                Perms::RW,
            )?;
            map.map_with_perms(
                Region::ram("dbgmcu", Arc::clone(&debug)),
                DEBUG.0,
                Perms::RW,
            )?;
        }
        debug_assert_eq!(image.flash.len(), FLASH_LENGTH as usize);
        let cpu = Cpu::new(Arc::new(space));
        let mut machine = Self {
            cpu,
            bus,
            memories,
            debug,
            log,
            log_lines: Vec::new(),
            now: Ticks(0),
            next_log: LOG_PERIOD,
            load: Load::default(),
            resets: Vec::new(),
            instructions: 0,
            locked_up: false,
            held_until: Ticks(0),
            exact: false,
        };
        machine.set_idcode(IDCODE);
        machine.power_cycle();
        Ok(machine)
    }

    /// Another revision of the chip, as its whole IDCODE tells it: revision A's is wrong in DEV_ID as well.
    pub fn set_idcode(&mut self, idcode: u32) {
        // The register is there.
        let _ = self.debug.write_at(0, &idcode.to_le_bytes());
    }

    /// Executes every turn of polling loops instead of letting them pass at once: slower, and the reference for it.
    pub const fn set_exact(&mut self, exact: bool) {
        self.exact = exact;
    }

    /// Now.
    pub const fn now(&self) -> Ticks {
        self.now
    }

    /// Where the core's time went since the start or [`Machine::restart_load`].
    pub const fn load(&self) -> Load {
        self.load
    }

    /// Begins a new account of the load.
    pub fn restart_load(&mut self) {
        self.load = Load::default();
    }

    /// Instructions, exception entries included, since the start.
    pub const fn instructions(&self) -> u64 {
        self.instructions
    }

    /// The resets so far; the first is the power-on.
    pub fn resets(&self) -> &[ResetEvent] {
        &self.resets
    }

    /// Takes the decoded lines of the image's log.
    pub fn take_log(&mut self) -> Vec<String> {
        self.read_log();
        std::mem::take(&mut self.log_lines)
    }

    /// Works on the board around the MCU, as it is now.
    pub fn board<T>(&mut self, work: impl FnOnce(&mut Board) -> T) -> T {
        self.bus.with_board(self.now, work)
    }

    /// Works on the CAN bus.
    pub fn can<T>(&mut self, work: impl FnOnce(&mut CanBus) -> T) -> T {
        self.bus.with_can(work)
    }

    /// Works on TIM2, which gives the image its time in µs.
    pub fn timer<T>(&mut self, work: impl FnOnce(&mut Tim2) -> T) -> T {
        self.bus.with_timer(work)
    }

    /// Looks at USART2.
    pub fn usart<T>(&mut self, work: impl FnOnce(&Usart) -> T) -> T {
        self.bus.with_usart(work)
    }

    /// Works on the flash interface.
    pub fn flash<T>(&mut self, work: impl FnOnce(&mut FlashInterface) -> T) -> T {
        self.bus.with_flash(work)
    }

    /// Works on ADC1.
    pub fn adc<T>(&mut self, work: impl FnOnce(&mut Adc1) -> T) -> T {
        self.bus.with_adc(work)
    }

    /// Works on the crystal and the watchdog's clock.
    pub fn clocks<T>(&mut self, work: impl FnOnce(&mut Rcc, &mut Iwdg) -> T) -> T {
        self.bus.with_clocks(work)
    }

    /// The crystal stops; with clock security on, that is an NMI.
    pub fn stop_crystal(&mut self) {
        let now = self.now;
        let is_found = self.bus.with_clocks(|rcc, _| rcc.stop_crystal(now));
        // Everything runs from HSI then.
        self.bus.advance(now);
        if is_found {
            self.cpu.raise_nmi();
        }
    }

    /// The core, for diagnosis.
    pub const fn cpu(&self) -> &Cpu {
        &self.cpu
    }

    /// The core, to be disturbed.
    pub const fn cpu_mut(&mut self) -> &mut Cpu {
        &mut self.cpu
    }

    /// A word of the MCU's RAM, as a probe would read it; `None` outside.
    pub fn ram_word(&self, address: u32) -> Option<u32> {
        self.memories.word(address)
    }

    /// Writes a word of the MCU's RAM (a flipped bit, say).
    pub fn set_ram_word(&mut self, address: u32, value: u32) {
        self.memories.set_word(address, value);
    }

    /// All supplies off and on again: RAM has lost its content.
    pub fn power_cycle(&mut self) {
        self.scramble_ram();
        self.reset(ResetCause::PowerOn);
    }

    /// RAM comes up with a pattern and not with zeros: what relies on zeros shows.
    fn scramble_ram(&self) {
        let mut state = 0x9E37_79B9_u32;
        for (store, length) in [
            (&self.memories.sram, SRAM_LENGTH),
            (&self.memories.ccm, CCM_LENGTH),
        ] {
            for offset in (0..length).step_by(4) {
                // Marsaglia's xorshift32.
                state ^= state << 13;
                state ^= state >> 17;
                state ^= state << 5;
                // Inside by construction.
                let _ = store.write_at(u64::from(offset), &state.to_le_bytes());
            }
        }
    }

    /// A system reset for `cause`.
    pub fn reset(&mut self, cause: ResetCause) {
        self.read_log();
        self.bus.reset(cause, self.now);
        self.cpu.reset();
        self.locked_up = false;
        self.held_until = self.now;
        self.resets.push(ResetEvent {
            at: self.now,
            cause,
        });
    }

    /// The same, and the core starts only after `length`.
    pub fn hold_in_reset(&mut self, cause: ResetCause, length: Ticks) {
        self.reset(cause);
        self.held_until = self.now + length;
    }

    fn read_log(&mut self) {
        if let Some(log) = &mut self.log {
            self.log_lines.extend(log.poll(&self.memories));
        }
    }

    /// Runs until `end`.
    ///
    /// # Errors
    /// [`MachineError`] if the image touched something that is not modelled, or the core is locked up and no watchdog runs.
    /// Where one runs, the log tells of it, and time passes until the reset.
    pub fn run_until(&mut self, end: Ticks) -> Result<(), MachineError> {
        while self.now < end {
            let mut next = self.bus.next_event();
            if self.now >= next {
                self.bus.advance(self.now);
                if let Some(cause) = self.bus.take_reset() {
                    self.reset(cause);
                }
                next = self.bus.next_event();
            }
            if self.now >= self.next_log {
                self.read_log();
                self.next_log = self.now + LOG_PERIOD;
            }
            if let Some(Lines { levels, rose }) = self.bus.take_interrupts() {
                self.cpu.set_interrupts(levels, rose);
            }
            let idle = self.cpu.is_asleep() && !self.cpu.wake_pending();
            let locked_up = self.cpu.is_locked_up();
            let mut stop = next.min(end).min(self.next_log);
            let held = self.now < self.held_until;
            if held {
                stop = stop.min(self.held_until);
            }
            if locked_up {
                let (pc, at_s) = (self.cpu.pc(), self.now.seconds());
                if !self.locked_up {
                    self.locked_up = true;
                    self.log_lines
                        .push(format!("{at_s:.6} the core is locked up at {pc:#010X}"));
                }
                if !self.bus.with_clocks(|_, watchdog| watchdog.is_running()) {
                    return Err(MachineError::LockedUp { pc, at_s });
                }
            }
            if idle || locked_up || held {
                self.sleep_until(stop);
                continue;
            }
            let per_cycle = self.bus.ticks_per_cycle();
            // Without an event of a peripheral in between, the core runs on alone. WFI takes one cycle, and so does a step
            // asleep: a few of them in a row are the sign to ask.
            let mut single_cycles = 0;
            while self.now < stop {
                self.bus.set_now(self.now);
                let cycles = self.cpu.step();
                self.instructions += 1;
                let spent = Ticks(cycles * per_cycle);
                self.now += spent;
                self.load.busy += spent;
                if self.bus.take_touched() {
                    break;
                }
                single_cycles = if cycles == 1 { single_cycles + 1 } else { 0 };
                if single_cycles == ASK_AFTER {
                    single_cycles = 0;
                    if self.cpu.is_asleep() || self.cpu.is_locked_up() {
                        break;
                    }
                }
            }
            self.skip_polling(stop);
            if let Some(Failure { access }) = self.bus.take_failure() {
                return Err(MachineError::Unmodelled {
                    access,
                    pc: self.cpu.pc(),
                    at_s: self.now.seconds(),
                });
            }
            if self.cpu.reset_requested() {
                self.cpu.clear_reset_request();
                self.reset(ResetCause::Software);
            }
        }
        self.bus.advance(self.now);
        Ok(())
    }

    /// Lets whole turns of a polling loop pass at once, while nothing happens: the loop reads a flag and the time, finds
    /// both as before, and turns again, so the state of the core after n turns is that after one. Where the loop gives
    /// up by the time, it does so up to [`LONGEST_SKIP`] late.
    fn skip_polling(&mut self, stop: Ticks) {
        if self.exact {
            return;
        }
        let per_cycle = self.bus.ticks_per_cycle();
        let Self {
            bus,
            cpu,
            now,
            load,
            ..
        } = self;
        bus.skip_polling(|period| {
            let systick = cpu
                .cycles_to_systick()
                .map_or(u64::MAX, |cycles| cycles.saturating_mul(per_cycle));
            // One turn is left over, so that the loop itself sees what happens next.
            let room = stop.since(*now).0.min(systick).min(LONGEST_SKIP.0);
            let turns = (room / period.0).saturating_sub(1);
            let skipped = Ticks(turns * period.0);
            if turns > 0 {
                cpu.skip(skipped.0 / per_cycle);
                *now += skipped;
                load.busy += skipped;
            }
            skipped
        });
    }

    /// Skips to the next event: of a peripheral, of SysTick, or `limit`.
    fn sleep_until(&mut self, limit: Ticks) {
        let per_cycle = self.bus.ticks_per_cycle();
        let to_limit = limit.since(self.now).0.div_ceil(per_cycle).max(1);
        let cycles = self
            .cpu
            .cycles_to_systick()
            .map_or(to_limit, |systick| systick.clamp(1, to_limit));
        self.cpu.skip(cycles);
        let spent = Ticks(cycles * per_cycle);
        self.now += spent;
        self.load.asleep += spent;
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

    use std::path::PathBuf;

    use plant::ade7753::{Ade7753, Ade7753Config};
    use plant::ads1100::{Ads1100, Ads1100Config};
    use plant::w25q32::{W25q32, W25q32Config};

    use super::*;
    use crate::board::BoardConfig;
    use crate::scenario::{Contactors, Row, Scenario};

    const START: u32 = FLASH_START + 0x200;
    const HANDLER: u32 = FLASH_START + 0x240;
    const UDF: u16 = 0xDE00;
    const NOP: u16 = 0xBF00;
    /// `b .`
    const HERE: u16 = 0xE7FE;
    /// `str r1, [r0]`
    const STORE: u16 = 0x6001;
    /// `adds r0, #1`
    const TO_THUMB: u16 = 0x3001;
    /// `bx r0`
    const JUMP: u16 = 0x4700;

    /// A board whose MCU loads `operands` into r0 and r1, goes on with `code`, and answers a fault by `handler`.
    fn machine(operands: [u32; 2], code: [u16; 3], handler: u16) -> Machine<'static> {
        let mut flash = vec![0xFF; FLASH_LENGTH as usize];
        let mut put = |address: u32, halves: &[u16]| {
            for (at, half) in (address - FLASH_START..).step_by(2).zip(halves) {
                flash[at as usize..at as usize + 2].copy_from_slice(&half.to_le_bytes());
            }
        };
        let word = |word: u32| [word as u16, (word >> 16) as u16];
        let vectors = (SRAM_START + SRAM_LENGTH, START | 1);
        put(FLASH_START, &word(vectors.0));
        put(FLASH_START + 4, &word(vectors.1));
        put(FLASH_START + 12, &word(HANDLER | 1));
        // ldr r0, [pc, #8]; ldr r1, [pc, #12]
        put(START, &[0x4802, 0x4903]);
        put(START + 4, &code);
        put(START + 12, &operands.map(word).concat());
        put(HANDLER, &[handler]);
        let image = Image {
            path: PathBuf::new(),
            elf: Vec::new(),
            flash,
            vectors,
            rtt: None,
        };
        let board = Board::new(
            BoardConfig::default(),
            Scenario::steady(Row::at_rest(0.0), Contactors::AlwaysClosed),
            Ade7753::new(Ade7753Config::default(), 0.0),
            Ads1100::new(Ads1100Config::default(), 0.0),
            W25q32::with_content(W25q32Config::default(), 0.0, Vec::new()),
        );
        Machine::new(&image, None, board).unwrap()
    }

    #[test]
    fn a_locked_up_core_ends_the_run_where_no_watchdog_runs() {
        let mut machine = machine([0; 2], [UDF; 3], UDF);
        for _ in 0..2 {
            // What the program counter reads as then (ARMv7-M, lockup).
            let Err(MachineError::LockedUp {
                pc: 0xFFFF_FFFE,
                at_s,
            }) = machine.run_until(Ticks::from_millis(10))
            else {
                panic!("at {:#010X}", machine.cpu().pc());
            };
            assert!(at_s < 1e-3, "{at_s}");
        }
        let log = machine.take_log();
        assert_eq!(log.len(), 1, "{log:?}");
        assert!(log[0].contains("locked up"), "{log:?}");
        assert_eq!(machine.resets().len(), 1);
    }

    #[test]
    fn a_locked_up_core_waits_for_the_watchdog() {
        // IWDG_KR.
        let mut machine = machine([0x4000_3000, 0xCCCC], [STORE, UDF, UDF], UDF);
        machine.run_until(Ticks::from_millis(1_200)).unwrap();
        let causes: Vec<ResetCause> = machine.resets().iter().map(|reset| reset.cause).collect();
        // After reset 4096 steps of LSI / 4: 512 ms.
        let watchdog = ResetCause::IndependentWatchdog;
        assert_eq!(causes, [ResetCause::PowerOn, watchdog, watchdog]);
        assert_eq!(
            machine.take_log().len(),
            3,
            "it locks up after each of them"
        );
    }

    /// On the F405 the CCM hangs on the D-bus alone, and peripherals are Execute Never.
    #[test]
    fn nothing_is_executed_from_ccm_or_registers() {
        for (target, first, reached) in [
            (SRAM_START, STORE, SRAM_START),
            (CCM_START, STORE, HANDLER),
            (0xE004_2000, STORE, HANDLER),
            // GPIOA, whose clock is off: a load from there would end the run.
            (0x4002_0000, NOP, HANDLER),
        ] {
            let mut machine = machine([target, HERE.into()], [first, TO_THUMB, JUMP], HERE);
            machine.run_until(Ticks::from_millis(1)).unwrap();
            assert_eq!(machine.cpu().pc(), reached, "{target:#010X}");
            let exception = if reached == HANDLER { 3 } else { 0 };
            assert_eq!(machine.cpu().current_exception(), exception);
        }
    }
}
