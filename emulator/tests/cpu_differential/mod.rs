//! The emulated core against QEMU's Cortex-M4, bit by bit.
//!
//! Both run `emulator/cpu-programs`. QEMU runs the random sequences undisturbed; the emulated core also with interrupts
//! between any two instructions, whose handlers spoil what an exception saves: afterwards nobody may be able to tell.

mod machines;
mod sequences;

use std::fmt::Write;

use machines::{Emulated, Interrupts, Results, emulated, programs, qemu};
use sequences::{Options, SCRATCH, SLOT, STATE, block};

const SEED: u64 = 0x5EED;
const COUNT: usize = 600;
/// Enough where every instruction is interrupted: some 25,000 instructions, each under a handler or several.
const INTERRUPTED_COUNT: usize = 200;
/// SysTick interrupts QEMU about every 200 instructions, at another place each time; its handler takes a third of that.
const SYSTICK: u32 = 5_003;

/// What differs, in words; empty if nothing does.
fn differences(block: &[u32], expected: &Results, found: &Results) -> String {
    let mut text = String::new();
    if expected.log != found.log {
        let at = (0..)
            .find(|at| expected.log.get(*at) != found.log.get(*at))
            .unwrap();
        let around = |log: &[u32]| {
            log[at.saturating_sub(6).min(log.len())..(at + 4).min(log.len())].to_vec()
        };
        writeln!(
            text,
            "log, {} and {} words, differs at {at}: {:08x?} and {:08x?}",
            expected.log.len(),
            found.log.len(),
            around(&expected.log),
            around(&found.log)
        )
        .unwrap();
    }
    let slots = expected.slots.chunks(SLOT).zip(found.slots.chunks(SLOT));
    let different: Vec<_> = slots.enumerate().filter(|(_, (a, b))| a != b).collect();
    for (slot, (a, b)) in different.iter().take(3) {
        let before = &block[sequences::HEADER + slot * SLOT..][..SLOT];
        for word in (0..STATE + SCRATCH).filter(|word| a[*word] != b[*word]) {
            writeln!(
                text,
                "sequence {slot}: {} is {:08x} and {:08x}, was {:08x}",
                sequences::name(word),
                a[word],
                b[word],
                before[word]
            )
            .unwrap();
        }
        writeln!(text, "{}", listing(&sequences::code(before))).unwrap();
    }
    if !different.is_empty() {
        writeln!(text, "{} sequences differ", different.len()).unwrap();
    }
    text
}

fn listing(code: &[u16]) -> String {
    use rsemu::cpu::arm::v7m::isa::{decode, is_32bit};
    let mut text = String::new();
    let mut at = 0;
    while let Some(first) = code.get(at) {
        let second = if is_32bit(*first) {
            code.get(at + 1).copied().unwrap_or(0)
        } else {
            0
        };
        write!(text, "{}; ", decode(*first, second)).unwrap();
        at += 1 + usize::from(is_32bit(*first));
    }
    text
}

fn assert_same(what: &str, block: &[u32], expected: &Results, found: &Results) {
    let text = differences(block, expected, found);
    assert!(
        text.is_empty(),
        "{what}: QEMU and the emulated core\n{text}"
    );
}

fn options(is_not_lazy: bool) -> Options {
    Options {
        is_not_lazy,
        is_directed: true,
        systick: 0,
    }
}

#[test]
fn programs_and_sequences_give_what_qemu_gives() {
    let programs = programs();
    for is_not_lazy in [false, true] {
        let block = block(SEED, COUNT, options(is_not_lazy));
        let expected = qemu(&programs, &block, &format!("plain{is_not_lazy}"));
        assert_eq!(expected.log.last(), Some(&0), "mistakes on QEMU");
        let Emulated { results, .. } = emulated(&programs, &block, Interrupts::None, true);
        assert_same("undisturbed", &block, &expected, &results);
    }
}

#[test]
fn interrupts_between_any_two_instructions_leave_no_trace() {
    let programs = programs();
    for is_not_lazy in [false, true] {
        let block = block(SEED, INTERRUPTED_COUNT, options(is_not_lazy));
        let expected = qemu(&programs, &block, &format!("interrupted{is_not_lazy}"));
        let Emulated { results, entries } =
            emulated(&programs, &block, Interrupts::Everywhere, true);
        assert!(entries > 100_000, "{entries} interrupts only");
        assert_same("interrupted", &block, &expected, &results);
    }
}

#[test]
fn the_handlers_leave_no_trace_on_qemu_either() {
    let programs = programs();
    let undisturbed = block(SEED, COUNT, Options::default());
    let with_systick = block(
        SEED,
        COUNT,
        Options {
            systick: SYSTICK,
            ..Options::default()
        },
    );
    assert_same(
        "SysTick on QEMU",
        &undisturbed,
        &qemu(&programs, &undisturbed, "without"),
        &qemu(&programs, &with_systick, "with"),
    );
}

#[test]
fn without_the_repairs_interrupts_leave_traces() {
    let programs = programs();
    let block = block(SEED, INTERRUPTED_COUNT, Options::default());
    let expected = emulated(&programs, &block, Interrupts::None, true).results;
    let found = emulated(&programs, &block, Interrupts::Everywhere, false).results;
    let differ = |words: std::ops::Range<usize>| {
        expected
            .slots
            .chunks(SLOT)
            .zip(found.slots.chunks(SLOT))
            .filter(|(a, b)| a[words.clone()] != b[words.clone()])
            .count()
    };
    // Conditional blocks that went on unconditionally, and lost flags and modes.
    assert!(
        differ(34..STATE) > INTERRUPTED_COUNT / 2,
        "{} of {INTERRUPTED_COUNT}",
        differ(34..STATE)
    );
    assert!(
        differ(32..33) > INTERRUPTED_COUNT / 2,
        "{} of {INTERRUPTED_COUNT}",
        differ(32..33)
    );
}
