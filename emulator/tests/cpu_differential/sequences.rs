//! Straight-line sequences of random instructions with random registers, and the block of memory they are handed over in
//! (`emulator/cpu-programs`).
//!
//! Encodings: ARMv7-M Architecture Reference Manual (DDI 0403E), A5 and A7. What the manual calls UNPREDICTABLE is left
//! out, and the stack pointer, the link register and r12 (the scratch memory's address) are left alone.
//!
//! Left out is also where `rsemu` 0.0.7 and QEMU 7.2 are known to differ, all of it in the floating-point unit, of which the
//! firmware's image has no instruction:
//! - VSUB of a NaN has the NaN's sign inverted in `rsemu`; here it is used with DN set only.
//! - VCVT from fixed point rounds as FPSCR says in `rsemu`, not to nearest; here it is not used with directed rounding.
//! - VCVT to fixed point does not extend the sign of 16 bits in `rsemu`, and sets OFC where the scaled number overflows.
//! - With FZ set the two disagree about cumulative bits (VMUL, VDIV, VFMA, half precision).

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

/// Address of the block.
pub const ADDRESS: u32 = 0x2010_0000;
const MAGIC: u32 = 0x5155_4553;
/// Words before the first slot.
pub const HEADER: usize = 4;
/// Words of a slot.
pub const SLOT: usize = 192;
/// Words of registers at its start: S0 … S31, FPSCR, APSR, r0 … r11.
pub const STATE: usize = 46;
/// Words of memory after that.
pub const SCRATCH: usize = 32;
/// Halfwords of code a slot has room for.
const CODE: usize = 2 * (SLOT - STATE - SCRATCH);
/// The longest thing that is added at once, and the return.
const RESERVE: usize = 16;

const BX_LR: u16 = 0x4770;

/// Options of the program.
#[derive(Clone, Copy, Debug, Default)]
pub struct Options {
    /// Floating-point registers are stacked at exception entry, not later.
    pub is_not_lazy: bool,
    /// Also what needs no sequences.
    pub is_directed: bool,
    /// SysTick's reload value, 0 for none.
    pub systick: u32,
}

/// The block with `count` sequences.
pub fn block(seed: u64, count: usize, options: Options) -> Vec<u32> {
    let mut random = Random::new(seed);
    let flags = u32::from(options.is_not_lazy) | u32::from(options.is_directed) << 1;
    let mut words = vec![MAGIC, flags, options.systick, count as u32];
    for _ in 0..count {
        words.extend(slot(&mut random));
    }
    words
}

/// The code of a slot, without the return.
pub fn code(slot: &[u32]) -> Vec<u16> {
    slot[STATE + SCRATCH..]
        .iter()
        .flat_map(|word| [*word as u16, (*word >> 16) as u16])
        .take_while(|half| *half != BX_LR)
        .collect()
}

/// Name of a word of a slot.
pub fn name(index: usize) -> String {
    match index {
        0..=31 => format!("s{index}"),
        32 => "fpscr".into(),
        33 => "apsr".into(),
        34..STATE => format!("r{}", index - 34),
        _ => format!("scratch[{}]", index - STATE),
    }
}

fn slot(random: &mut Random) -> Vec<u32> {
    let mut words = Vec::with_capacity(SLOT);
    random.is_rounding_directed = random.below(2) == 0;
    random.is_nan_default = random.below(2) == 0;
    words.extend((0..32).map(|_| random.float()));
    // Flags, modes and cumulative bits.
    let upper = u32::from(random.fpscr_upper());
    words.push(upper << 16 | random.word() & 0x9F);
    words.push(random.word() & 0xF80F_0000);
    words.extend((0..12).map(|_| random.integer()));
    words.extend((0..SCRATCH).map(|_| {
        if random.below(2) == 0 {
            random.float()
        } else {
            random.integer()
        }
    }));
    let mut code = Vec::with_capacity(CODE);
    while code.len() < CODE - RESERVE {
        piece(random, &mut code);
    }
    code.push(BX_LR);
    code.resize(CODE, BX_LR);
    words.extend(
        code.as_chunks()
            .0
            .iter()
            .map(|[low, high]| u32::from(*low) | u32::from(*high) << 16),
    );
    words
}

/// What is added at once.
fn piece(random: &mut Random, code: &mut Vec<u16>) {
    match random.below(10) {
        // A conditional block.
        0..3 => {
            let length = random.below(4) as usize + 1;
            // The lowest set bit ends the block, what is above chooses between the condition and its opposite.
            let choices = random.below(16) as u16 & !((1 << (5 - length)) - 1);
            let mask = choices | 1 << (4 - length);
            code.push(0xBF00 | random.condition() << 4 | mask & 0xF);
            for _ in 0..length {
                code.extend(instruction(random));
            }
        }
        // A conditional branch over one instruction.
        3 => {
            let skipped = instruction(random);
            code.push(0xD000 | random.condition() << 8 | (skipped.len() as u16 - 1));
            code.extend(skipped);
        }
        4 => code.extend(with_own_base(random)),
        5 if random.below(3) == 0 => code.extend(set_fpscr(random)),
        _ => code.extend(instruction(random)),
    }
}

/// One instruction that may also be conditional.
fn instruction(random: &mut Random) -> Vec<u16> {
    match random.below(12) {
        0..2 => vec![narrow(random)],
        2..4 => data_processing(random),
        4 => shifts_and_fields(random),
        5 => multiplication(random),
        6 => parallel(random),
        7 => load_or_store(random),
        8..10 => float_arithmetic(random),
        10 => float_conversion(random),
        _ => float_moves(random),
    }
}

/// The 16-bit instructions: with flags outside of a conditional block, without them in it.
fn narrow(random: &mut Random) -> u16 {
    let (d, n) = (random.low(), random.low());
    match random.below(8) {
        // LSL, LSR, ASR by an immediate; LSL by 0 is MOVS, which may not be conditional.
        0 => (random.below(3) as u16) << 11 | (random.below(31) as u16 + 1) << 6 | n << 3 | d,
        // ADD, SUB of a register or 3 bits.
        1 => 0x1800 | (random.below(4) as u16) << 9 | random.low() << 6 | n << 3 | d,
        // MOV, CMP, ADD, SUB of 8 bits.
        2 => 0x2000 | (random.below(4) as u16) << 11 | d << 8 | random.below(256) as u16,
        3 | 4 => 0x4000 | (random.below(16) as u16) << 6 | n << 3 | d,
        // ADD, CMP, MOV of any registers; CMP of two low ones is another encoding.
        5 => {
            let high = random.below(4) as u16;
            let register = match random.below(3) {
                0 => 0x4480,
                1 => 0x4580,
                _ => 0x4680,
            };
            register | random.any() << 3 | high
        }
        // SXTH, SXTB, UXTH, UXTB.
        6 => 0xB200 | (random.below(4) as u16) << 6 | n << 3 | d,
        // REV, REV16, REVSH.
        _ => 0xBA00 | random.one_of(&[0, 1, 3]) << 6 | n << 3 | d,
    }
}

fn data_processing(random: &mut Random) -> Vec<u16> {
    let operation = random.one_of(&[0, 1, 2, 3, 4, 8, 10, 11, 13, 14]);
    let set_flags = random.below(2) as u16;
    let (mut n, mut d, mut s) = (random.any(), random.any(), set_flags);
    match (operation, random.below(4)) {
        // TST, TEQ, CMN, CMP.
        (0 | 4 | 8 | 13, 0) => (d, s) = (15, 1),
        // MOV, MVN.
        (2 | 3, 0) => n = 15,
        _ => {}
    }
    if random.below(2) == 0 {
        let shift = random.below(4) as u16;
        let (imm3, imm2) = (random.below(8) as u16, random.below(4) as u16);
        return vec![
            0xEA00 | operation << 5 | s << 4 | n,
            imm3 << 12 | d << 8 | imm2 << 6 | shift << 4 | random.any(),
        ];
    }
    // An immediate; one that is repeated must not be 0.
    let (i, imm3) = (random.below(2) as u16, random.below(8) as u16);
    vec![
        0xF000 | i << 10 | operation << 5 | s << 4 | n,
        imm3 << 12 | d << 8 | random.below(256) as u16 | 1,
    ]
}

fn shifts_and_fields(random: &mut Random) -> Vec<u16> {
    let (d, n, m) = (random.any(), random.any(), random.any());
    let (imm3, imm2) = (random.below(8) as u16, random.below(4) as u16);
    let lsb = imm3 << 2 | imm2;
    match random.below(11) {
        // LSL, LSR, ASR, ROR by a register.
        0 => vec![
            0xFA00 | (random.below(4) as u16) << 5 | (random.below(2) as u16) << 4 | n,
            0xF000 | d << 8 | m,
        ],
        // Extensions, with or without an addition.
        1 => vec![
            0xFA00 | (random.below(6) as u16) << 4 | if random.below(2) == 0 { 15 } else { n },
            0xF080 | d << 8 | (random.below(4) as u16) << 4 | m,
        ],
        // ADDW, SUBW.
        2 => vec![
            random.one_of(&[0xF200, 0xF2A0]) | (random.below(2) as u16) << 10 | n,
            imm3 << 12 | d << 8 | random.below(256) as u16,
        ],
        // MOVW, MOVT.
        3 => vec![
            random.one_of(&[0xF240, 0xF2C0])
                | (random.below(2) as u16) << 10
                | random.below(16) as u16,
            imm3 << 12 | d << 8 | random.below(256) as u16,
        ],
        // SSAT, USAT, and of halfwords.
        4 => {
            let right = if lsb == 0 { 0 } else { random.below(2) as u16 };
            vec![
                random.one_of(&[0xF300, 0xF380]) | right << 5 | n,
                imm3 << 12 | d << 8 | imm2 << 6 | random.below(32) as u16,
            ]
        }
        5 => vec![
            random.one_of(&[0xF320, 0xF3A0]) | n,
            d << 8 | random.below(16) as u16,
        ],
        // SBFX, UBFX.
        6 => vec![
            random.one_of(&[0xF340, 0xF3C0]) | n,
            imm3 << 12 | d << 8 | imm2 << 6 | random.below(u32::from(32 - lsb)) as u16,
        ],
        // BFI, BFC.
        7 => vec![
            0xF360 | if random.below(4) == 0 { 15 } else { n },
            imm3 << 12 | d << 8 | imm2 << 6 | (lsb + random.below(u32::from(32 - lsb)) as u16),
        ],
        // PKHBT, PKHTB.
        8 => vec![
            0xEAC0 | n,
            imm3 << 12 | d << 8 | imm2 << 6 | (random.below(2) as u16) << 5 | m,
        ],
        // REV, REV16, RBIT, REVSH, CLZ.
        9 => {
            if random.below(5) == 0 {
                vec![0xFAB0 | m, 0xF080 | d << 8 | m]
            } else {
                vec![
                    0xFA90 | m,
                    0xF080 | d << 8 | (random.below(4) as u16) << 4 | m,
                ]
            }
        }
        // APSR.
        _ => {
            if random.below(2) == 0 {
                vec![0xF3EF, 0x8000 | d << 8]
            } else {
                vec![0xF380 | n, random.one_of(&[0x8400, 0x8800, 0x8C00])]
            }
        }
    }
}

fn multiplication(random: &mut Random) -> Vec<u16> {
    let (d, n, m) = (random.any(), random.any(), random.any());
    let mut a = random.any();
    let choice = random.below(4) as u16;
    match random.below(12) {
        0 => vec![0xFB00 | n, a << 12 | d << 8 | m],
        1 => vec![0xFB00 | n, a << 12 | d << 8 | 0x10 | m],
        2 => vec![0xFB00 | n, 0xF000 | d << 8 | m],
        // SMLAxy, SMULxy.
        3 => vec![
            0xFB10 | n,
            random.or_none(a) << 12 | d << 8 | choice << 4 | m,
        ],
        // SMLAD, SMLAW, SMLSD, SMMLA and their kin without an addend.
        4 | 5 => vec![
            random.one_of(&[0xFB20, 0xFB30, 0xFB40, 0xFB50]) | n,
            random.or_none(a) << 12 | d << 8 | (choice & 1) << 4 | m,
        ],
        // SMMLS.
        6 => vec![0xFB60 | n, a << 12 | d << 8 | (choice & 1) << 4 | m],
        // USAD8, USADA8.
        7 => vec![0xFB70 | n, random.or_none(a) << 12 | d << 8 | m],
        // SDIV, UDIV.
        8 | 9 => vec![random.one_of(&[0xFB90, 0xFBB0]) | n, 0xF0F0 | d << 8 | m],
        _ => {
            if a == d {
                a = (d + 1) % 12;
            }
            let (first, second) = match random.below(9) {
                0 => (0xFB80, 0),
                1 => (0xFBA0, 0),
                2 => (0xFBC0, 0),
                3 => (0xFBC0, 0x80 | choice << 4),
                4 => (0xFBC0, 0xC0 | (choice & 1) << 4),
                5 => (0xFBD0, 0xC0 | (choice & 1) << 4),
                6 => (0xFBE0, 0),
                _ => (0xFBE0, 0x60),
            };
            vec![first | n, a << 12 | d << 8 | second | m]
        }
    }
}

/// Additions and subtractions of bytes and halfwords, and what saturates.
fn parallel(random: &mut Random) -> Vec<u16> {
    let (d, n, m) = (random.any(), random.any(), random.any());
    match random.below(8) {
        // QADD, QDADD, QSUB, QDSUB.
        0 | 1 => vec![
            0xFA80 | n,
            0xF080 | d << 8 | (random.below(4) as u16) << 4 | m,
        ],
        // SEL.
        2 => vec![0xFAA0 | n, 0xF080 | d << 8 | m],
        _ => vec![
            0xFA80 | random.one_of(&[0, 1, 2, 4, 5, 6]) << 4 | n,
            0xF000 | d << 8 | random.one_of(&[0x00, 0x10, 0x20, 0x40, 0x50, 0x60]) | m,
        ],
    }
}

/// From and to the scratch memory by r12, also unaligned.
fn load_or_store(random: &mut Random) -> Vec<u16> {
    let t = random.any();
    match random.below(8) {
        0..4 => {
            let first = random.one_of(&[
                0xF8D0, 0xF8B0, 0xF890, 0xF9B0, 0xF990, 0xF8C0, 0xF8A0, 0xF880,
            ]);
            vec![
                first | 12,
                t << 12 | random.below(4 * SCRATCH as u32 - 4) as u16,
            ]
        }
        // LDRD, STRD.
        4 => {
            let second = (t + 1 + random.below(11) as u16) % 12;
            vec![
                random.one_of(&[0xE9D0, 0xE9C0]) | 12,
                t << 12 | second << 8 | random.below(SCRATCH as u32 - 1) as u16,
            ]
        }
        // LDM, STM.
        5 => vec![random.one_of(&[0xE890, 0xE880]) | 12, random.list()],
        // VLDR, VSTR of one or two words.
        6 => {
            let first = random.one_of(&[0xED90, 0xED80]) | 12;
            let word = random.below(SCRATCH as u32 - 1) as u16;
            if random.below(2) == 0 {
                let s = random.float_register();
                vec![first | (s & 1) << 6, (s >> 1) << 12 | 0x0A00 | word]
            } else {
                vec![first, (random.below(16) as u16) << 12 | 0x0B00 | word]
            }
        }
        // VLDM, VSTM.
        _ => {
            let s = random.float_register();
            let count = random.below(u32::from(32 - s)) as u16 + 1;
            vec![
                random.one_of(&[0xEC90, 0xEC80]) | (s & 1) << 6 | 12,
                (s >> 1) << 12 | 0x0A00 | count,
            ]
        }
    }
}

/// Accesses that write their base back, which is first made an address in the middle of the scratch memory.
fn with_own_base(random: &mut Random) -> Vec<u16> {
    let base = random.any();
    let other = |random: &mut Random| (base + 1 + random.below(11) as u16) % 12;
    let mut code = vec![0xF10C, base << 8 | 64];
    match random.below(5) {
        // LDR, STR with pre- or post-indexing in either direction.
        0 | 1 => {
            let (before, up) = (random.below(2) as u16, random.below(2) as u16);
            code.extend([
                random.one_of(&[0xF850, 0xF840]) | base,
                other(random) << 12 | 0x0900 | before << 10 | up << 9 | random.below(60) as u16,
            ]);
        }
        // LDRD, STRD.
        2 => {
            let (before, up) = (random.below(2) as u16, random.below(2) as u16);
            let t = other(random);
            let mut second = other(random);
            if second == t {
                second = (1..12)
                    .map(|step| (t + step) % 12)
                    .find(|r| *r != base)
                    .unwrap();
            }
            code.extend([
                random.one_of(&[0xE870, 0xE860]) | before << 8 | up << 7 | base,
                t << 12 | second << 8 | random.below(14) as u16,
            ]);
        }
        // LDM, STM, both directions.
        3 => {
            let list = loop {
                let list = random.list() & !(1 << base);
                if list.count_ones() > 1 {
                    break list;
                }
            };
            code.extend([
                random.one_of(&[0xE8B0, 0xE8A0, 0xE930, 0xE920]) | base,
                list,
            ]);
        }
        // VLDM, VSTM.
        _ => {
            let s = random.float_register();
            let count = random.below(u32::from(32 - s).min(15)) as u16 + 1;
            code.extend([
                random.one_of(&[0xECB0, 0xECA0, 0xED30, 0xED20]) | (s & 1) << 6 | base,
                (s >> 1) << 12 | 0x0A00 | count,
            ]);
        }
    }
    code
}

/// New modes and flags.
fn set_fpscr(random: &mut Random) -> Vec<u16> {
    let t = random.any();
    let upper = random.fpscr_upper();
    vec![
        // MOVT, and BFC of the lower half.
        0xF2C0 | (upper >> 11 & 1) << 10 | upper >> 12,
        (upper >> 8 & 7) << 12 | t << 8 | upper & 0xFF,
        0xF36F,
        t << 8 | 15,
        0xEEE1,
        t << 12 | 0x0A10,
    ]
}

fn registers(random: &mut Random, first: u16, second: u16) -> Vec<u16> {
    let (d, n, m) = (
        random.float_register(),
        random.float_register(),
        random.float_register(),
    );
    vec![
        first | (d & 1) << 6 | n >> 1,
        second | (d >> 1) << 12 | 0x0A00 | (n & 1) << 7 | (m & 1) << 5 | m >> 1,
    ]
}

fn float_arithmetic(random: &mut Random) -> Vec<u16> {
    if random.is_nan_default && random.below(8) == 0 {
        // VSUB.
        return registers(random, 0xEE30, 0x40);
    }
    // VMLA, VMLS, VNMLS, VNMLA, VMUL, VNMUL, VADD, VDIV, VFNMS, VFNMA, VFMA, VFMS.
    let (first, second) = random.one_of(&[
        (0xEE00, 0),
        (0xEE00, 0x40),
        (0xEE10, 0),
        (0xEE10, 0x40),
        (0xEE20, 0),
        (0xEE20, 0x40),
        (0xEE30, 0),
        (0xEE80, 0),
        (0xEE80, 0),
        (0xEE90, 0),
        (0xEE90, 0x40),
        (0xEEA0, 0),
        (0xEEA0, 0x40),
    ]);
    registers(random, first, second)
}

fn float_conversion(random: &mut Random) -> Vec<u16> {
    let (d, m) = (random.float_register(), random.float_register());
    let (operation, top) = match random.below(12) {
        // VABS, VNEG, VSQRT.
        0 => (0, 0xC0),
        1 => (1, 0x40),
        2 | 3 => (1, 0xC0),
        // Halves.
        4 => (2, random.one_of(&[0x40, 0xC0])),
        5 => (3, random.one_of(&[0x40, 0xC0])),
        // Integers: from, to, to with FPSCR's rounding.
        6 => (8, random.one_of(&[0x40, 0xC0])),
        7 | 8 => (random.one_of(&[12, 13]), random.one_of(&[0x40, 0xC0])),
        _ if random.is_rounding_directed => (1, 0xC0),
        // From fixed point, signed and unsigned, of 16 or 32 bits.
        _ => {
            let operation = random.one_of(&[10, 11]);
            let is_wide = random.one_of(&[0, 0x80]);
            let bits = random.below(if is_wide == 0 { 17 } else { 32 }) as u16;
            return vec![
                0xEEB0 | (d & 1) << 6 | operation,
                (d >> 1) << 12 | 0x0A40 | is_wide | (bits & 1) << 5 | bits >> 1,
            ];
        }
    };
    vec![
        0xEEB0 | (d & 1) << 6 | operation,
        (d >> 1) << 12 | 0x0A00 | top | (m & 1) << 5 | m >> 1,
    ]
}

/// Moves, comparisons and their flags.
fn float_moves(random: &mut Random) -> Vec<u16> {
    let (d, m) = (random.float_register(), random.float_register());
    let t = random.any();
    match random.below(10) {
        0..4 => {
            let (operation, m) = random.one_of(&[(4, m), (5, 0)]);
            vec![
                0xEEB0 | (d & 1) << 6 | operation,
                (d >> 1) << 12 | 0x0A00 | random.one_of(&[0x40, 0xC0]) | (m & 1) << 5 | m >> 1,
            ]
        }
        4 | 5 => vec![0xEEF1, 0xFA10],
        6 => vec![0xEEF1, t << 12 | 0x0A10],
        7 => vec![
            0xEE00 | (random.below(2) as u16) << 4 | d >> 1,
            t << 12 | 0x0A10 | (d & 1) << 7,
        ],
        8 => {
            let second = (t + 1 + random.below(11) as u16) % 12;
            let m = m.min(30);
            vec![
                0xEC40 | (random.below(2) as u16) << 4 | second,
                t << 12 | 0x0A10 | (m & 1) << 5 | m >> 1,
            ]
        }
        // VMOV of an immediate or a register.
        _ => {
            if random.below(2) == 0 {
                vec![
                    0xEEB0 | (d & 1) << 6 | random.below(16) as u16,
                    (d >> 1) << 12 | 0x0A00 | random.below(16) as u16,
                ]
            } else {
                vec![
                    0xEEB0 | (d & 1) << 6,
                    (d >> 1) << 12 | 0x0A40 | (m & 1) << 5 | m >> 1,
                ]
            }
        }
    }
}

/// Choices.
pub struct Random {
    generator: ChaCha8Rng,
    /// Rounding may be other than to nearest.
    is_rounding_directed: bool,
    /// DN of FPSCR is set.
    is_nan_default: bool,
}

impl Random {
    /// With a seed.
    pub fn new(seed: u64) -> Self {
        Self {
            generator: ChaCha8Rng::seed_from_u64(seed),
            is_rounding_directed: false,
            is_nan_default: false,
        }
    }

    /// Any 32 bits.
    pub fn word(&mut self) -> u32 {
        self.generator.next_u32()
    }

    /// 0 … `limit` − 1.
    pub fn below(&mut self, limit: u32) -> u32 {
        self.word() % limit
    }

    fn one_of<T: Copy>(&mut self, choices: &[T]) -> T {
        choices[self.below(choices.len() as u32) as usize]
    }

    /// r0 … r7.
    fn low(&mut self) -> u16 {
        self.below(8) as u16
    }

    /// r0 … r11.
    fn any(&mut self) -> u16 {
        self.below(12) as u16
    }

    /// A register, or 15: no addend.
    fn or_none(&mut self, register: u16) -> u16 {
        if self.below(2) == 0 { 15 } else { register }
    }

    fn float_register(&mut self) -> u16 {
        self.below(32) as u16
    }

    fn condition(&mut self) -> u16 {
        self.below(14) as u16
    }

    /// Two registers of r0 … r11 at least.
    fn list(&mut self) -> u16 {
        loop {
            let list = (self.word() & 0xFFF) as u16;
            if list.count_ones() > 1 {
                return list;
            }
        }
    }

    /// Upper half of FPSCR: any flags, DN and rounding as this sequence has them.
    fn fpscr_upper(&mut self) -> u16 {
        let rounding = if self.is_rounding_directed { 0xC0 } else { 0 };
        let dn = u16::from(self.is_nan_default) << 9;
        (self.word() & (0xF000 | rounding)) as u16 | dn
    }

    fn integer(&mut self) -> u32 {
        match self.below(6) {
            0 => self.below(16),
            1 => self.one_of(&[
                0x7FFF_FFFF,
                0x8000_0000,
                0xFFFF_FFFF,
                0x8000_7FFF,
                0xFFFF,
                0x7FFF,
                0x8000,
            ]),
            2 => self.word() >> self.below(32),
            _ => self.word(),
        }
    }

    fn float(&mut self) -> u32 {
        let sign = self.word() & 0x8000_0000;
        let fraction = self.word() & 0x007F_FFFF;
        sign | match self.below(10) {
            // Zero, infinity, NaN of both kinds, denormal.
            0 => self.one_of(&[0, 0, 0x7F80_0000, 0x3F80_0000, 0x4F00_0000, 0x4F80_0000]),
            1 => self.one_of(&[0x7F80_0000, 0x7FC0_0000]) | fraction,
            2 => fraction >> self.below(23),
            // Near the limits.
            3 => self.one_of(&[0x0080_0000, 0x0100_0000, 0x7F00_0000, 0x3F80_0000]) | fraction,
            // Halves and integers.
            4 => (self.below(2000) as f32 / 2.0).to_bits(),
            // Near an integer's range.
            5 => (0x4600_0000 + (self.below(22) << 23)) | fraction,
            // Moderate, where sums cancel.
            6..9 => (0x3E00_0000 + (self.below(6) << 23)) | fraction,
            _ => self.word() & 0x7FFF_FFFF,
        }
    }
}
