//! Flash and static RAM of an image, from the load addresses and sizes of its ELF sections.

use anyhow::{Context, Result, bail};
use object::{
    LittleEndian,
    elf::{FileHeader32, PT_LOAD, SHF_ALLOC, SHT_NOBITS},
    read::elf::{FileHeader as _, ProgramHeader as _, SectionHeader as _},
};

/// The image is meant to fill no more than this much of the flash.
pub const FLASH_GOAL: u64 = 64 * 1024;
/// **The goal is not reached.** Until it is, an image beyond this fails, so that it can only shrink: lower it with every
/// step, never raise it.
pub const FLASH_RATCHET: u64 = 108_600;
/// Statics may fill this much RAM; the stack is apart, in core-coupled memory.
pub const RAM_LIMIT: u64 = 16 * 1024;

/// RM0090: flash of the STM32F405xG.
const FLASH: std::ops::Range<u64> = 0x0800_0000..0x0810_0000;
/// RM0090: core-coupled memory, which holds the stack.
const CCM: std::ops::Range<u64> = 0x1000_0000..0x1001_0000;
/// RM0090: SRAM1 and SRAM2.
const SRAM: std::ops::Range<u64> = 0x2000_0000..0x2002_0000;

/// One section that takes memory.
#[derive(Debug, PartialEq, Eq)]
pub struct Section {
    /// `.text`, `.bss`, …
    pub name: String,
    /// Bytes of flash: code, constants and the first values of variables.
    pub flash: u64,
    /// Bytes of RAM.
    pub ram: u64,
}

/// Every section that takes memory.
pub fn sections(elf: &[u8]) -> Result<Vec<Section>> {
    let header = FileHeader32::<LittleEndian>::parse(elf).context("not a 32-bit ELF file")?;
    let endian = header.endian()?;
    let segments = header.program_headers(endian, elf)?;
    let table = header.sections(endian, elf)?;
    let mut sections = Vec::new();
    for section in table.iter() {
        let size = u64::from(section.sh_size(endian));
        if size == 0 || section.sh_flags(endian) & SHF_ALLOC == 0 {
            continue;
        }
        let name = String::from_utf8_lossy(table.section_name(endian, section)?).into_owned();
        let address = u64::from(section.sh_addr(endian));
        let loaded = section.sh_type(endian) != SHT_NOBITS;
        // Where the bytes are flashed: the segment that holds the section tells the difference to where they run.
        let load_address = segments
            .iter()
            .filter(|segment| segment.p_type(endian) == PT_LOAD)
            .find_map(|segment| {
                let start = u64::from(segment.p_vaddr(endian));
                let offset = address.checked_sub(start)?;
                (offset + size <= u64::from(segment.p_memsz(endian)))
                    .then(|| u64::from(segment.p_paddr(endian)) + offset)
            })
            .unwrap_or(address);
        if loaded && !FLASH.contains(&load_address) {
            bail!(
                "section {name} would be loaded to {load_address:#010x}, where the board has no flash"
            );
        }
        let in_ram = SRAM.contains(&address) || CCM.contains(&address);
        if !in_ram && !FLASH.contains(&address) {
            bail!("section {name} is at {address:#010x}, where the board has no memory");
        }
        sections.push(Section {
            name,
            flash: if loaded { size } else { 0 },
            ram: if in_ram { size } else { 0 },
        });
    }
    if sections.is_empty() {
        bail!("the image is empty");
    }
    Ok(sections)
}

/// Sums of (flash, RAM).
pub fn totals(sections: &[Section]) -> (u64, u64) {
    sections.iter().fold((0, 0), |(flash, ram), section| {
        (flash + section.flash, ram + section.ram)
    })
}
