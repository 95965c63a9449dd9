//! The two cores that run `emulator/cpu-programs`.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::time::Duration;
use std::{env, thread};

use emulator::cpu::Cpu;
use object::{Object, ObjectSegment};
use rsemu::core::space::{AddressSpace, RamStore, Region};

use super::sequences::{self, HEADER, Random, SLOT};

const RAM: u32 = 0x2000_0000;
const MEMORY_BYTES: u64 = 4 << 20;
const LOG: u32 = 0x2020_0000;
/// More than any of the runs takes.
const STEP_LIMIT: u64 = 200_000_000;
/// QEMU takes a second or two; what hangs must not hold up a test run.
const QEMU_LIMIT_POLLS: u32 = 6_000;
const POLL: Duration = Duration::from_millis(20);
const HARD_FAULT: u16 = 3;
const HFSR_DEBUGEVT: u32 = 1 << 31;
/// Exception number of IRQ 0.
const IRQ0: u16 = 16;

/// What a core left behind.
#[derive(Clone, PartialEq, Eq)]
pub struct Results {
    /// What the programs wrote down.
    pub log: Vec<u32>,
    /// The slots after the sequences ran.
    pub slots: Vec<u32>,
}

/// The programs' ELF file.
pub fn programs() -> Vec<u8> {
    let path = env::var_os("HALLMARK_CPU_PROGRAMS").map_or_else(
        || {
            // The test runs from target/PROFILE/deps.
            let target = env::current_exe()
                .ok()
                .and_then(|path| path.ancestors().nth(3).map(Path::to_path_buf))
                .unwrap_or_default();
            target.join("thumbv7em-none-eabihf/release/cpu-programs")
        },
        PathBuf::from,
    );
    fs::read(&path).unwrap_or_else(|error| {
        panic!(
            "{}: {error}. Build it with `cargo build --release --target thumbv7em-none-eabihf -p cpu-programs`, or name it \
             in HALLMARK_CPU_PROGRAMS",
            path.display()
        )
    })
}

/// Runs them on QEMU's Cortex-M4, one instruction at a time, so that interrupts are taken where they are pended.
pub fn qemu(programs: &[u8], block: &[u32], name: &str) -> Results {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR"));
    let (elf, data) = (
        folder.join(format!("{name}.elf")),
        folder.join(format!("{name}.bin")),
    );
    fs::write(&elf, programs).unwrap();
    let bytes: Vec<u8> = block.iter().flat_map(|word| word.to_le_bytes()).collect();
    fs::write(&data, bytes).unwrap();
    let printed = folder.join(format!("{name}.out"));
    let mut machine = Command::new("qemu-system-arm")
        .args([
            "-M",
            "mps2-an386",
            "-nographic",
            "-monitor",
            "none",
            "-serial",
            "null",
        ])
        .args(["-icount", "shift=10", "-singlestep"])
        .args(["-semihosting-config", "enable=on,target=native", "-device"])
        .arg(format!(
            "loader,file={},addr={:#x}",
            data.display(),
            sequences::ADDRESS
        ))
        .arg("-kernel")
        .arg(&elf)
        .stdin(Stdio::null())
        .stdout(File::create(&printed).unwrap())
        .spawn()
        .unwrap_or_else(|error| {
            panic!("qemu-system-arm (Debian's package qemu-system-arm): {error}")
        });
    let mut polls = 0;
    let status = loop {
        if let Some(status) = machine.try_wait().unwrap() {
            break status;
        }
        if polls == QEMU_LIMIT_POLLS {
            machine.kill().unwrap();
        }
        polls += 1;
        thread::sleep(POLL);
    };
    assert!(status.success(), "QEMU ended with {status}");
    let words: Vec<u32> = fs::read(&printed)
        .unwrap()
        .as_chunks()
        .0
        .iter()
        .map(|word| u32::from_le_bytes(*word))
        .collect();
    let count = words[0] as usize;
    let log = words[1..1 + count].to_vec();
    let block_after = &words[1 + count..];
    assert_eq!(block_after.len(), block.len());
    Results {
        log,
        slots: block_after[HEADER..].to_vec(),
    }
}

/// Whether interrupts hit the sequences on the emulated core.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Interrupts {
    /// None.
    None,
    /// At each instruction one or two, and at some instructions of their handlers more.
    Everywhere,
}

/// What happened on the emulated core.
pub struct Emulated {
    /// What it left behind.
    pub results: Results,
    /// Exceptions entered by way of the lines.
    pub entries: u64,
}

/// Runs the programs on [`Cpu`].
pub fn emulated(
    programs: &[u8],
    block: &[u32],
    interrupts: Interrupts,
    is_repaired: bool,
) -> Emulated {
    let (flash, ram) = (
        Arc::new(RamStore::new(MEMORY_BYTES)),
        Arc::new(RamStore::new(MEMORY_BYTES)),
    );
    for segment in object::File::parse(programs).unwrap().segments() {
        let address = segment.address();
        let (store, start) = if address < u64::from(RAM) {
            (&flash, 0)
        } else {
            (&ram, u64::from(RAM))
        };
        store
            .write_at(address - start, segment.data().unwrap())
            .unwrap();
    }
    for (index, word) in (0_u64..).zip(block) {
        store_word(&ram, sequences::ADDRESS, index, *word);
    }
    let space = AddressSpace::new("an386", 32);
    {
        let mut map = space.topology();
        map.map(Region::ram("flash", flash), 0).unwrap();
        map.map(Region::ram("ram", Arc::clone(&ram)), u64::from(RAM))
            .unwrap();
    }
    let mut cpu = Cpu::with_vectors(Arc::new(space), 0);
    if !is_repaired {
        cpu = cpu.unrepaired();
    }
    let entries = run(&mut cpu, block, interrupts);
    let words = |address: u32, from: u64, count: u64| {
        (from..from + count)
            .map(|index| load_word(&ram, address, index))
            .collect()
    };
    let results = Results {
        log: words(LOG, 1, u64::from(load_word(&ram, LOG, 0))),
        slots: words(
            sequences::ADDRESS,
            HEADER as u64,
            (block.len() - HEADER) as u64,
        ),
    };
    Emulated { results, entries }
}

fn run(cpu: &mut Cpu, block: &[u32], interrupts: Interrupts) -> u64 {
    let mut random = Random::new(7);
    let end = sequences::ADDRESS + 4 * (HEADER + SLOT * ((block.len() - HEADER) / SLOT)) as u32;
    let (mut entries, mut has_advanced) = (0, true);
    for _ in 0..STEP_LIMIT {
        let mut lines = 0_u32;
        if interrupts == Interrupts::Everywhere {
            match cpu.current_exception() {
                // Something must be executed between two interrupts, or nothing ever is.
                0 if (sequences::ADDRESS..end).contains(&cpu.pc()) => {
                    if has_advanced {
                        lines =
                            [0x100, 0x200, 0x300, 0x400, 0x800, 0xF00][random.below(6) as usize];
                    }
                    has_advanced = !has_advanced;
                }
                0 => has_advanced = true,
                // In a handler of the lower priority.
                24 | 25 if random.below(12) == 0 => {
                    lines = [0x400, 0x800, 0xC00][random.below(3) as usize];
                }
                _ => {}
            }
        }
        if lines == 0 {
            cpu.step();
        } else {
            // Up for the moment of the entry; what is not taken at once stays pending.
            cpu.set_interrupts([lines, 0, 0], [lines, 0, 0]);
            let before = cpu.current_exception();
            cpu.step();
            assert_ne!(cpu.current_exception(), before, "at {:#x}", cpu.pc());
            assert!(cpu.current_exception() >= IRQ0);
            entries += u64::from(lines.count_ones());
            cpu.set_interrupts([0; 3], [0; 3]);
        }
        if cpu.current_exception() == HARD_FAULT && cpu.fault_status().1 & HFSR_DEBUGEVT != 0 {
            return entries;
        }
        assert!(
            !cpu.is_locked_up(),
            "locked up: {cpu:x?} {:x?}",
            cpu.fault_status()
        );
    }
    panic!("no end: {cpu:x?}");
}

fn load_word(ram: &RamStore, address: u32, index: u64) -> u32 {
    let mut bytes = [0; 4];
    ram.read_at(u64::from(address - RAM) + 4 * index, &mut bytes)
        .unwrap();
    u32::from_le_bytes(bytes)
}

fn store_word(ram: &RamStore, address: u32, index: u64, word: u32) {
    ram.write_at(u64::from(address - RAM) + 4 * index, &word.to_le_bytes())
        .unwrap();
}
