//! The memory of QEMU's AN386 board and the linker settings for it.
//!
//! A script of its own instead of cortex-m-rt's: that one includes `memory.x` from the folder the linker runs in, the top
//! of the checkout, where the one of the real board is.

use std::{env, error::Error, fs, path::PathBuf};

const SCRIPT: &str = "\
ENTRY(reset)
MEMORY
{
  FLASH (rx)  : ORIGIN = 0x00000000, LENGTH = 4M
  RAM   (rwx) : ORIGIN = 0x20000000, LENGTH = 4M
}
stack_top = ORIGIN(RAM) + LENGTH(RAM);
SECTIONS
{
  .text   : { KEEP(*(.vectors)); *(.text .text.*); *(.rodata .rodata.*); } > FLASH
  /* QEMU loads initial values to where they are used and starts with cleared memory. */
  .data   : { *(.data .data.*); } > RAM
  .bss (NOLOAD) : { *(.bss .bss.* COMMON); } > RAM
  /DISCARD/ : { *(.ARM.exidx .ARM.exidx.* .ARM.extab.*); }
}
";

fn main() -> Result<(), Box<dyn Error>> {
    let script = PathBuf::from(env::var("OUT_DIR")?).join("an386.x");
    fs::write(&script, SCRIPT)?;
    println!("cargo:rustc-link-arg-bins=-T{}", script.display());
    println!("cargo:rustc-link-arg-bins=--nmagic");
    println!("cargo:rerun-if-changed=build.rs");
    Ok(())
}
