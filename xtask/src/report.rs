//! `size`: what the image takes, against its limits.

use std::fs;

use anyhow::{Context, Result, bail};

use crate::{
    image, instruction_count, size, stack,
    steps::Steps,
    toolchain::{self, Toolchain},
    workspace::Workspace,
};

/// Builds the image and prints flash, static RAM, the stack bound and the instruction counts.
pub fn size_of_image(steps: &mut Steps, workspace: &Workspace, toolchain: &Toolchain, calls: bool) {
    if let Some(elf) = steps.step("release image", || image::build(workspace, toolchain)) {
        steps.step("size", || memory(&elf, toolchain, calls));
    }
    steps.step("instruction counts", || instruction_count::run(toolchain));
}

/// Prints what the image takes; an error if it is more than a limit. The limit of the flash is that of what checked compilers make.
pub fn memory(elf: &std::path::Path, toolchain: &Toolchain, calls: bool) -> Result<()> {
    let bytes = fs::read(elf).with_context(|| format!("reading {}", elf.display()))?;
    let sections = size::sections(&bytes)?;
    println!("   {:<20} {:>8} {:>8}", "section", "flash", "RAM");
    for section in &sections {
        println!(
            "   {:<20} {:>8} {:>8}",
            section.name, section.flash, section.ram
        );
    }
    let (flash, ram) = size::totals(&sections);
    let bound = stack::bound(&bytes)?;
    let mut exceeded = Vec::new();
    for (name, value, limit, holds) in [
        ("flash", flash, size::FLASH_RATCHET, toolchain.is_checked),
        ("static RAM", ram, size::RAM_LIMIT, true),
        ("stack bound", bound.total, stack::LIMIT, true),
    ] {
        println!(
            "   {name:<20} {value:>8} bytes of {limit} ({} %)",
            value * 100 / limit
        );
        if value > limit && !holds {
            toolchain::remark_unchecked("a larger image fails nothing");
        } else if value > limit {
            exceeded.push(format!("{name} takes {value} bytes of {limit}"));
        }
    }
    if flash > size::FLASH_GOAL {
        println!(
            "   MISSED: the goal for flash is {} bytes; the image is {} bytes too large",
            size::FLASH_GOAL,
            flash - size::FLASH_GOAL
        );
    }
    print_stack(&bound, calls);
    if !exceeded.is_empty() {
        bail!("{}", exceeded.join("; "));
    }
    Ok(())
}

fn print_stack(bound: &stack::Bound, calls: bool) {
    println!("   the stack bound is the sum of");
    println!("   {:>8} from reset", bound.thread.depth);
    if calls {
        println!("            {}", bound.thread.names.join(" > "));
    }
    for handler in &bound.handlers {
        let name = handler.entry.as_str();
        let depth = handler.depth + stack::EXCEPTION_FRAME;
        println!(
            "   {depth:>8} {name}, with its exception frame of {}",
            stack::EXCEPTION_FRAME
        );
        if calls {
            println!("            {}", handler.names.join(" > "));
        }
    }
    println!(
        "   as if every handler interrupted every other: the image does not tell their priorities"
    );
    for remark in &bound.remarks {
        println!("   {}", remark.text);
        if calls {
            println!("            {}", remark.functions.join(", "));
        }
    }
}
