//! The firmware image: an ELF file for the STM32F405RG, checked before anything runs.

use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};

use object::elf;
use object::read::elf::{ElfFile32, FileHeader as _, ProgramHeader as _};
use object::{LittleEndian, Object as _, ObjectSymbol as _};

/// Flash of the STM32F405RG: 1 MiB (data sheet, memory map).
pub const FLASH_START: u32 = 0x0800_0000;
/// Its length in bytes.
pub const FLASH_LENGTH: u32 = 1024 * 1024;
/// SRAM1 and SRAM2: 112 KiB and 16 KiB in one piece.
pub const SRAM_START: u32 = 0x2000_0000;
/// Their length in bytes.
pub const SRAM_LENGTH: u32 = 128 * 1024;
/// Core-coupled memory: on the data bus alone, nothing can be executed from it.
pub const CCM_START: u32 = 0x1000_0000;
/// Its length in bytes.
pub const CCM_LENGTH: u32 = 64 * 1024;

/// An image and what is known about it.
pub struct Image {
    /// Where it came from.
    pub path: PathBuf,
    /// The whole ELF file.
    pub elf: Vec<u8>,
    /// Content of the flash, erased (0xFF) where the image has nothing.
    pub flash: Vec<u8>,
    /// Initial stack pointer and reset vector.
    pub vectors: (u32, u32),
    /// Address of the RTT control block, if the image has one.
    pub rtt: Option<u32>,
}

/// Why an image is refused.
#[derive(Debug)]
pub struct ImageError {
    path: PathBuf,
    reason: String,
}

impl fmt::Display for ImageError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.path.display(), self.reason)
    }
}

impl std::error::Error for ImageError {}

const EXPECTED: &str =
    "an image for the STM32F405RG (32-bit little-endian ARM, flash from 0x08000000) was expected";

impl Image {
    /// Reads and checks the ELF file at `path`.
    ///
    /// # Errors
    /// If it cannot be read, is no ELF file for a 32-bit ARM, does not fit this chip's memories, or has no vector table
    /// at the beginning of the flash.
    pub fn load(path: &Path) -> Result<Self, ImageError> {
        let elf = fs::read(path).map_err(|error| ImageError {
            path: path.to_path_buf(),
            reason: format!("{error}; `cargo xtask build` makes the image"),
        })?;
        Self::from_elf(path, elf)
    }

    /// Checks an ELF file that is in memory already; `path` is for the messages.
    ///
    /// # Errors
    /// As [`Image::load`].
    pub fn from_elf(path: &Path, elf: Vec<u8>) -> Result<Self, ImageError> {
        match contents(&elf) {
            Ok((flash, vectors, rtt)) => Ok(Self {
                path: path.to_path_buf(),
                elf,
                flash,
                vectors,
                rtt,
            }),
            Err(reason) => Err(ImageError {
                path: path.to_path_buf(),
                reason,
            }),
        }
    }
}

impl Image {
    /// Address of the symbol whose name has `part` in it; `None` unless there is just one.
    pub fn symbol(&self, part: &str) -> Option<u32> {
        let file = ElfFile32::<LittleEndian>::parse(self.elf.as_slice()).ok()?;
        let mut found = file
            .symbols()
            .filter(|symbol| symbol.name().is_ok_and(|name| name.contains(part)));
        let address = found.next()?.address();
        found.next().is_none().then_some(address)?.try_into().ok()
    }
}

type Contents = (Vec<u8>, (u32, u32), Option<u32>);

fn contents(bytes: &[u8]) -> Result<Contents, String> {
    if !bytes.starts_with(b"\x7fELF") {
        return Err(format!("no ELF file; {EXPECTED}"));
    }
    if bytes.get(4) != Some(&elf::ELFCLASS32) || bytes.get(5) != Some(&elf::ELFDATA2LSB) {
        return Err(format!(
            "an ELF file of another width or byte order; {EXPECTED}"
        ));
    }
    let file =
        ElfFile32::<LittleEndian>::parse(bytes).map_err(|error| format!("{error}; {EXPECTED}"))?;
    let header = file.elf_header();
    let machine = header.e_machine(LittleEndian);
    if machine != elf::EM_ARM {
        return Err(format!(
            "made for machine {machine} of the ELF list, not for ARM (40); {EXPECTED}"
        ));
    }
    if header.e_type(LittleEndian) != elf::ET_EXEC {
        return Err(format!(
            "not linked to addresses (an object or a library); {EXPECTED}"
        ));
    }
    let mut flash = vec![0xFF; FLASH_LENGTH as usize];
    let mut any = false;
    for segment in file.elf_program_headers() {
        let length = segment.p_filesz(LittleEndian);
        if segment.p_type(LittleEndian) != elf::PT_LOAD || segment.p_memsz(LittleEndian) == 0 {
            continue;
        }
        let (run_at, run_length) = (segment.p_vaddr(LittleEndian), segment.p_memsz(LittleEndian));
        if ![
            (FLASH_START, FLASH_LENGTH),
            (SRAM_START, SRAM_LENGTH),
            (CCM_START, CCM_LENGTH),
        ]
        .iter()
        .any(|(start, size)| inside(run_at, run_length, *start, *size))
        {
            return Err(format!(
                "a segment of {run_length} bytes at {run_at:#010X} lies in no memory of the STM32F405RG \
                 (flash 1 MiB at 0x08000000, SRAM 128 KiB at 0x20000000, CCM 64 KiB at 0x10000000): made for another chip"
            ));
        }
        if length == 0 {
            continue;
        }
        let load_at = segment.p_paddr(LittleEndian);
        if !inside(load_at, length, FLASH_START, FLASH_LENGTH) {
            return Err(format!(
                "a segment of {length} bytes is to be loaded to {load_at:#010X}, outside the flash of the STM32F405RG \
                 (1 MiB at 0x08000000): made for another chip, or to run from RAM"
            ));
        }
        let data = segment.data(LittleEndian, bytes).map_err(|()| {
            format!("the segment at {load_at:#010X} is cut off; the file is not complete")
        })?;
        let offset = (load_at - FLASH_START) as usize;
        flash[offset..offset + data.len()].copy_from_slice(data);
        any = true;
    }
    if !any {
        return Err(format!("nothing to load in it; {EXPECTED}"));
    }
    let word =
        |at: usize| u32::from_le_bytes([flash[at], flash[at + 1], flash[at + 2], flash[at + 3]]);
    let vectors = (word(0), word(4));
    check_vectors(vectors)?;
    let rtt = file
        .symbols()
        .find(|symbol| symbol.name() == Ok("_SEGGER_RTT"))
        .and_then(|symbol| u32::try_from(symbol.address()).ok());
    Ok((flash, vectors, rtt))
}

fn inside(start: u32, length: u32, region: u32, size: u32) -> bool {
    start >= region && u64::from(start) + u64::from(length) <= u64::from(region) + u64::from(size)
}

fn check_vectors((stack, reset): (u32, u32)) -> Result<(), String> {
    if stack == u32::MAX && reset == u32::MAX {
        return Err(
            "no vector table: the flash is empty at 0x08000000, where the core looks for stack pointer and reset vector"
                .to_owned(),
        );
    }
    // A full-descending stack starts one past its memory's last byte.
    let stack_fits =
        inside(stack, 0, SRAM_START, SRAM_LENGTH) || inside(stack, 0, CCM_START, CCM_LENGTH);
    if !stack_fits || stack % 4 != 0 {
        return Err(format!(
            "no vector table: the first word, {stack:#010X}, is no stack pointer in the STM32F405RG's RAM"
        ));
    }
    if reset % 2 == 0 || !inside(reset, 2, FLASH_START, FLASH_LENGTH) {
        return Err(format!(
            "no vector table: the second word, {reset:#010X}, is no Thumb address in the flash"
        ));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::panic)]

    use super::*;

    /// A minimal ELF: header, one program header, `data` loaded to `address`.
    fn elf_file(machine: u16, address: u32, data: &[u8]) -> Vec<u8> {
        let mut file = Vec::new();
        file.extend_from_slice(b"\x7fELF\x01\x01\x01\0\0\0\0\0\0\0\0\0");
        file.extend_from_slice(&2u16.to_le_bytes()); // executable
        file.extend_from_slice(&machine.to_le_bytes());
        for word in [1u32, address | 1, 52, 0, 0x0500_0400] {
            file.extend_from_slice(&word.to_le_bytes());
        }
        for half in [52u16, 32, 1, 40, 0, 0] {
            file.extend_from_slice(&half.to_le_bytes());
        }
        let length = u32::try_from(data.len()).unwrap();
        for word in [1, 84, address, address, length, length, 5, 4] {
            file.extend_from_slice(&u32::to_le_bytes(word));
        }
        file.extend_from_slice(data);
        file
    }

    fn table(stack: u32, reset: u32) -> Vec<u8> {
        [stack.to_le_bytes(), reset.to_le_bytes()].concat()
    }

    fn refusal(file: Vec<u8>) -> String {
        match Image::from_elf(Path::new("some.elf"), file) {
            Ok(_) => panic!("accepted"),
            Err(error) => error.to_string(),
        }
    }

    #[test]
    fn an_image_with_a_vector_table_is_taken() {
        let file = elf_file(40, FLASH_START, &table(0x1001_0000, 0x0800_0009));
        let image = Image::from_elf(Path::new("some.elf"), file).ok().unwrap();
        assert_eq!(image.vectors, (0x1001_0000, 0x0800_0009));
        assert_eq!(image.flash[8], 0xFF, "erased beyond the image");
    }

    #[test]
    fn every_other_file_is_refused_by_name_with_its_reason() {
        let good = table(0x1001_0000, 0x0800_0009);
        for (file, reason) in [
            (b"hello".to_vec(), "no ELF file"),
            (elf_file(62, FLASH_START, &good), "not for ARM"),
            (elf_file(40, 0x0000_0000, &good), "made for another chip"),
            (elf_file(40, 0x0810_0000, &good), "made for another chip"),
            (elf_file(40, SRAM_START, &good), "to run from RAM"),
            (elf_file(40, FLASH_START + 0x200, &good), "flash is empty"),
            (
                elf_file(40, FLASH_START, &table(0x3000_0000, 0x0800_0009)),
                "no stack pointer",
            ),
            (
                elf_file(40, FLASH_START, &table(0x1001_0000, 0x0800_0008)),
                "no Thumb address",
            ),
            (elf_file(40, FLASH_START, &good)[..86].to_vec(), "cut off"),
        ] {
            let message = refusal(file);
            assert!(message.starts_with("some.elf: "), "{message}");
            assert!(message.contains(reason), "{message} should say {reason:?}");
        }
    }
}
