//! The memory of QEMU's AN386 board and the linker settings for it.

use std::{env, error::Error, fs, path::PathBuf};

const SCRIPT: &str = "\
ENTRY(reset)
MEMORY
{
  FLASH (rx)  : ORIGIN = 0x00000000, LENGTH = 4M
  /* The rest of the 4 MiB is for sequences (1 MiB up) and results (2 MiB up); see main.rs. */
  RAM   (rwx) : ORIGIN = 0x20000000, LENGTH = 1M
}
stack_top = ORIGIN(RAM) + LENGTH(RAM);
SECTIONS
{
  .text   : { KEEP(*(.vectors)); *(.text .text.*); *(.rodata .rodata.*); } > FLASH
  /* The loader puts initial values where they are used and memory starts cleared. */
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
