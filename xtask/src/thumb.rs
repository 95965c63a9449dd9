//! As much of the Thumb-2 instruction set as a stack bound needs: lengths, stack adjustments, branches and addresses
//! built in registers. Encodings: ARMv7-M Architecture Reference Manual (DDI 0403E), chapter A7.

/// What an instruction does to the stack or to the flow of control.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Effect {
    /// Nothing of interest.
    None,
    /// The stack grows by this many bytes.
    Grow(u32),
    /// The stack pointer takes a value that is not in the instruction.
    SetStackPointer,
    /// A register points this many bytes below the stack pointer: part of the frame if it becomes the stack pointer.
    Below(u32),
    /// The low bits of a register are cleared (`bfc`): how compilers align a frame; up to this many bytes lost.
    Align(u32),
    /// `bl`.
    Call(u32),
    /// `b`, conditional or not: a tail call if it leaves the function.
    Branch(u32),
    /// `blx rN`.
    CallRegister,
    /// `bx rN` (not `lr`), `mov pc`, `ldr pc`: an indirect tail call, or a jump table.
    BranchRegister,
    /// `tbb`, `tbh`: a jump within the function.
    TableBranch,
    /// `movw`: the lower half of a constant.
    MoveLow(u8, u16),
    /// `movt`: the upper half.
    MoveHigh(u8, u16),
}

const SP: u32 = 13;
const LR: u32 = 14;
const PC: u32 = 15;

/// Whether an instruction that begins with this halfword has a second one (A6.1).
pub fn is_wide(first: u16) -> bool {
    first >= 0xE800
}

/// A 16-bit instruction at `address`.
pub fn narrow(address: u32, code: u16) -> Effect {
    let code = u32::from(code);
    let pc = address.wrapping_add(4);
    match code {
        // PUSH (T1): eight low registers and LR.
        0xB400..=0xB5FF => Effect::Grow(4 * (code & 0x1FF).count_ones()),
        // SUB (SP minus immediate, T1).
        0xB080..=0xB0FF => Effect::Grow(4 * (code & 0x7F)),
        // B (T1), without the permanently undefined and SVC.
        0xD000..=0xDDFF => Effect::Branch(pc.wrapping_add(sign_extend((code & 0xFF) << 1, 9))),
        // B (T2).
        0xE000..=0xE7FF => Effect::Branch(pc.wrapping_add(sign_extend((code & 0x7FF) << 1, 12))),
        // BX, BLX (register).
        0x4700..=0x47FF => match ((code >> 7) & 1, (code >> 3) & 0xF) {
            (1, _) => Effect::CallRegister,
            (_, LR) => Effect::None,
            _ => Effect::BranchRegister,
        },
        // ADD (register, T2) and MOV (register, T1) with SP or PC as their destination.
        0x4400..=0x44FF | 0x4600..=0x46FF => match ((code >> 4) & 8) | (code & 7) {
            SP => Effect::SetStackPointer,
            PC if (code >> 3) & 0xF == LR => Effect::None,
            PC => Effect::BranchRegister,
            _ => Effect::None,
        },
        _ => Effect::None,
    }
}

/// A 32-bit instruction at `address`.
pub fn wide(address: u32, first: u16, second: u16) -> Effect {
    let (first, second) = (u32::from(first), u32::from(second));
    let pc = address.wrapping_add(4);
    let register = (second >> 8) & 0xF;
    match (first, second) {
        // PUSH (T2), that is STMDB SP!.
        (0xE92D, _) => Effect::Grow(4 * (second & 0x7FFF).count_ones()),
        // STR (immediate, T4) with SP as base, pre- or post-indexed downwards with write-back: PUSH (T3) among them.
        (0xF84D, _) if second & 0xB00 == 0x900 => Effect::Grow(second & 0xFF),
        // STRD (immediate) likewise: P or W set, U clear.
        (0xE96D | 0xE86D, _) => Effect::Grow(4 * (second & 0xFF)),
        // VPUSH, that is VSTMDB SP!, of double (…B..) or single (…A..) registers: the count is in words.
        (0xED2D | 0xED6D, _) if matches!((second >> 8) & 0xF, 0xA | 0xB) => {
            Effect::Grow(4 * (second & 0xFF))
        }
        // SUB (SP minus immediate, T2): modified constant.
        _ if first & 0xFBEF == 0xF1AD && second & 0x8000 == 0 && register == SP => {
            Effect::Grow(expand_immediate(constant(first, second)))
        }
        _ if first & 0xFBEF == 0xF1AD && second & 0x8000 == 0 && register != PC => {
            Effect::Below(expand_immediate(constant(first, second)))
        }
        // SUB (SP minus immediate, T3): plain 12 bits.
        _ if first & 0xFBFF == 0xF2AD && second & 0x8000 == 0 && register == SP => {
            Effect::Grow(constant(first, second))
        }
        _ if first & 0xFBFF == 0xF2AD && second & 0x8000 == 0 => {
            Effect::Below(constant(first, second))
        }
        // SUB or ADD (SP minus or plus register) into SP.
        _ if (first & 0xFFEF == 0xEBAD || first & 0xFFEF == 0xEB0D) && register == SP => {
            Effect::SetStackPointer
        }
        // BFC.
        (0xF36F, _) if second & 0x8000 == 0 => {
            let lowest = ((second >> 10) & 0x1C) | ((second >> 6) & 3);
            let highest = second & 0x1F;
            if lowest == 0 {
                Effect::Align(1_u32.checked_shl(highest + 1).unwrap_or(u32::MAX))
            } else {
                Effect::None
            }
        }
        // TBB, TBH.
        _ if first & 0xFFF0 == 0xE8D0 && second & 0xFFE0 == 0xF000 => Effect::TableBranch,
        // LDR (immediate, literal or register) into PC, unless it pops the return address.
        _ if first & 0xFF70 == 0xF850 && second >> 12 == PC => {
            if first == 0xF85D && second & 0xF00 == 0xB00 {
                Effect::None
            } else {
                Effect::BranchRegister
            }
        }
        // MOVW (T3), MOVT (T1).
        _ if first & 0xFBF0 == 0xF240 && second & 0x8000 == 0 => {
            half(first, second, Effect::MoveLow)
        }
        _ if first & 0xFBF0 == 0xF2C0 && second & 0x8000 == 0 => {
            half(first, second, Effect::MoveHigh)
        }
        // BL (T1).
        _ if first & 0xF800 == 0xF000 && second & 0xD000 == 0xD000 => {
            Effect::Call(far_target(pc, first, second))
        }
        // B (T4).
        _ if first & 0xF800 == 0xF000 && second & 0xD000 == 0x9000 => {
            Effect::Branch(far_target(pc, first, second))
        }
        // B (T3), conditional: conditions 14 and 15 are other instructions.
        _ if first & 0xF800 == 0xF000 && second & 0xD000 == 0x8000 && (first >> 7) & 7 != 7 => {
            let offset = ((first >> 10) & 1) << 20
                | ((second >> 11) & 1) << 19
                | ((second >> 13) & 1) << 18
                | (first & 0x3F) << 12
                | (second & 0x7FF) << 1;
            Effect::Branch(pc.wrapping_add(sign_extend(offset, 21)))
        }
        _ => Effect::None,
    }
}

/// The 12 bits i:imm3:imm8.
fn constant(first: u32, second: u32) -> u32 {
    ((first >> 10) & 1) << 11 | ((second >> 12) & 7) << 8 | (second & 0xFF)
}

/// `ThumbExpandImm` (A5.3.2).
fn expand_immediate(bits: u32) -> u32 {
    let byte = bits & 0xFF;
    match bits >> 8 {
        0 => byte,
        1 => byte << 16 | byte,
        2 => byte << 24 | byte << 8,
        3 => byte << 24 | byte << 16 | byte << 8 | byte,
        _ => (0x80 | (bits & 0x7F)).rotate_right(bits >> 7),
    }
}

fn half(first: u32, second: u32, effect: fn(u8, u16) -> Effect) -> Effect {
    let value = (first & 0xF) << 12 | constant(first, second);
    match (u8::try_from((second >> 8) & 0xF), u16::try_from(value)) {
        (Ok(register), Ok(value)) => effect(register, value),
        _ => Effect::None,
    }
}

/// The target of BL and B (T4): a 25-bit offset of which two bits are stored inverted by the sign.
fn far_target(pc: u32, first: u32, second: u32) -> u32 {
    let sign = (first >> 10) & 1;
    let i1 = !(((second >> 13) & 1) ^ sign) & 1;
    let i2 = !(((second >> 11) & 1) ^ sign) & 1;
    let offset = sign << 24 | i1 << 23 | i2 << 22 | (first & 0x3FF) << 12 | (second & 0x7FF) << 1;
    pc.wrapping_add(sign_extend(offset, 25))
}

fn sign_extend(value: u32, bits: u32) -> u32 {
    let sign = 1 << (bits - 1);
    (value ^ sign).wrapping_sub(sign)
}

#[cfg(test)]
mod tests {
    use super::*;

    // The codes are what `arm-none-eabi-as -mcpu=cortex-m4 -mfpu=fpv4-sp-d16` makes of the comments.

    #[test]
    fn pushes() {
        assert_eq!(narrow(0, 0xB5F0), Effect::Grow(20)); // push {r4-r7, lr}
        assert_eq!(narrow(0, 0xB401), Effect::Grow(4)); // push {r0}
        assert_eq!(wide(0, 0xE92D, 0x4FF0), Effect::Grow(36)); // push.w {r4-r11, lr}
        assert_eq!(wide(0, 0xF84D, 0xBD04), Effect::Grow(4)); // str.w r11, [sp, #-4]!
        assert_eq!(wide(0, 0xE96D, 0x0104), Effect::Grow(16)); // strd r0, r1, [sp, #-16]!
        assert_eq!(wide(0, 0xED2D, 0x8B10), Effect::Grow(64)); // vpush {d8-d15}
        assert_eq!(wide(0, 0xED2D, 0x8A01), Effect::Grow(4)); // vpush {s16}
        assert_eq!(wide(0, 0xED6D, 0x8A03), Effect::Grow(12)); // vpush {s17-s19}
    }

    #[test]
    fn stores_that_do_not_move_the_stack_pointer() {
        assert_eq!(wide(0, 0xF84D, 0x0C04), Effect::None); // str.w r0, [sp, #-4]
        assert_eq!(wide(0, 0xF8CD, 0x0104), Effect::None); // str.w r0, [sp, #260]
        assert_eq!(wide(0, 0xE9CD, 0x0102), Effect::None); // strd r0, r1, [sp, #8]
        assert_eq!(wide(0, 0xE94D, 0x0102), Effect::None); // strd r0, r1, [sp, #-8]
        assert_eq!(wide(0, 0xED8D, 0x0A02), Effect::None); // vstr s0, [sp, #8]
        assert_eq!(wide(0, 0xE8BD, 0x8FF0), Effect::None); // pop.w {r4-r11, pc}
        assert_eq!(wide(0, 0xECBD, 0x8B10), Effect::None); // vpop {d8-d15}
        assert_eq!(narrow(0, 0xBDF0), Effect::None); // pop {r4-r7, pc}
        assert_eq!(narrow(0, 0xB002), Effect::None); // add sp, #8
        assert_eq!(wide(0, 0xF50D, 0x7D80), Effect::None); // add.w sp, sp, #256
    }

    #[test]
    fn subtractions() {
        assert_eq!(narrow(0, 0xB082), Effect::Grow(8)); // sub sp, #8
        assert_eq!(wide(0, 0xF5AD, 0x7D00), Effect::Grow(512)); // sub.w sp, sp, #512
        assert_eq!(wide(0, 0xF2AD, 0x4D04), Effect::Grow(1028)); // subw sp, sp, #1028
        assert_eq!(wide(0, 0xF1AD, 0x0D0C), Effect::Grow(12)); // sub.w sp, sp, #12
        assert_eq!(wide(0, 0xF5AD, 0x5D80), Effect::Grow(4096)); // sub.w sp, sp, #4096
        assert_eq!(wide(0, 0xF1AD, 0x0408), Effect::Below(8)); // sub.w r4, sp, #8
    }

    #[test]
    fn stack_pointer_from_a_register() {
        assert_eq!(narrow(0, 0x46A5), Effect::SetStackPointer); // mov sp, r4
        assert_eq!(wide(0, 0xEBAD, 0x0D04), Effect::SetStackPointer); // sub.w sp, sp, r4
        assert_eq!(narrow(0, 0x466C), Effect::None); // mov r4, sp
        assert_eq!(wide(0, 0xF36F, 0x0404), Effect::Align(32)); // bfc r4, #0, #5
        assert_eq!(wide(0, 0xF36F, 0x1404), Effect::None); // bfc r4, #4, #1
    }

    #[test]
    fn branches() {
        assert_eq!(wide(0x0800_0100, 0xF000, 0xF87E), Effect::Call(0x0800_0200)); // bl .+0x100
        assert_eq!(wide(0x0800_0100, 0xF7FF, 0xFFFE), Effect::Call(0x0800_0100)); // bl .
        assert_eq!(
            wide(0x0800_0100, 0xF7FF, 0xBFFE),
            Effect::Branch(0x0800_0100)
        ); // b.w .
        assert_eq!(
            wide(0x0800_0100, 0xF47F, 0xAFFE),
            Effect::Branch(0x0800_0100)
        ); // bne.w .
        assert_eq!(wide(0x0800_0100, 0xF3BF, 0x8F4F), Effect::None); // dsb sy
        assert_eq!(wide(0x0800_0100, 0xF380, 0x8811), Effect::None); // msr basepri, r0
        assert_eq!(wide(0x0800_0100, 0xF7F0, 0xA000), Effect::None); // udf.w
        assert_eq!(narrow(0x0800_0100, 0xE7FE), Effect::Branch(0x0800_0100)); // b .
        assert_eq!(narrow(0x0800_0100, 0xD0FE), Effect::Branch(0x0800_0100)); // beq .
        assert_eq!(narrow(0x0800_0100, 0xD00E), Effect::Branch(0x0800_0120)); // beq .+0x20
        assert_eq!(narrow(0x0800_0100, 0xDEFE), Effect::None); // udf #254
        assert_eq!(narrow(0, 0x4798), Effect::CallRegister); // blx r3
        assert_eq!(narrow(0, 0x4718), Effect::BranchRegister); // bx r3
        assert_eq!(narrow(0, 0x4770), Effect::None); // bx lr
        assert_eq!(narrow(0, 0x46F7), Effect::None); // mov pc, lr
        assert_eq!(narrow(0, 0x469F), Effect::BranchRegister); // mov pc, r3
        assert_eq!(wide(0, 0xE8DF, 0xF001), Effect::TableBranch); // tbb [pc, r1]
        assert_eq!(wide(0, 0xE8DF, 0xF011), Effect::TableBranch); // tbh [pc, r1, lsl #1]
        assert_eq!(wide(0, 0xF8DF, 0xF004), Effect::BranchRegister); // ldr.w pc, [pc, #4]
        assert_eq!(wide(0, 0xF85D, 0xFB04), Effect::None); // ldr.w pc, [sp], #4
        assert_eq!(wide(0, 0xF852, 0xF023), Effect::BranchRegister); // ldr.w pc, [r2, r3, lsl #2]
    }

    #[test]
    fn constants_in_two_halves() {
        assert_eq!(wide(0, 0xF241, 0x2334), Effect::MoveLow(3, 0x1234)); // movw r3, #0x1234
        assert_eq!(wide(0, 0xF6C0, 0x0300), Effect::MoveHigh(3, 0x0800)); // movt r3, #0x800
        assert_eq!(wide(0, 0xF64F, 0x70FF), Effect::MoveLow(0, 0xFFFF)); // movw r0, #0xffff
    }

    #[test]
    fn lengths() {
        assert!(!is_wide(0xE7FE));
        assert!(is_wide(0xE92D));
        assert!(is_wide(0xF000));
        assert!(!is_wide(0xDFFF));
    }

    #[test]
    fn modified_constants() {
        assert_eq!(expand_immediate(0x0AB), 0xAB);
        assert_eq!(expand_immediate(0x1AB), 0x00AB_00AB);
        assert_eq!(expand_immediate(0x2AB), 0xAB00_AB00);
        assert_eq!(expand_immediate(0x3AB), 0xABAB_ABAB);
        assert_eq!(expand_immediate(0x47F), 0xFF00_0000);
        assert_eq!(expand_immediate(0xF80), 0x0000_0100);
    }
}
