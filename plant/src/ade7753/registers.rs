//! Register map (ADE7753 Rev C, register table).

/// What an access does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Access {
    /// Read only.
    Read,
    /// Read only; the read clears what it stands for.
    ReadClear,
    /// Read and write.
    ReadWrite,
}

/// One register.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Register {
    /// Address, 0 … 0x3F.
    pub address: u8,
    /// The data sheet's name.
    pub name: &'static str,
    /// What an access does.
    pub access: Access,
    /// Width in bits.
    pub bits: u32,
    /// Two's complement.
    pub signed: bool,
    /// Value after a reset.
    pub reset: u32,
}

impl Register {
    /// Bytes of a transfer: right-justified, the spare bits of the first byte are 0.
    pub const fn bytes(&self) -> usize {
        self.bits.div_ceil(8) as usize
    }

    /// The bits that exist.
    pub const fn mask(&self) -> u32 {
        u32::MAX >> (32 - self.bits)
    }
}

const fn register(
    address: u8,
    name: &'static str,
    access: Access,
    bits: u32,
    signed: bool,
    reset: u32,
) -> Register {
    Register {
        address,
        name,
        access,
        bits,
        signed,
        reset,
    }
}

use Access::{Read, ReadClear, ReadWrite};

/// Every register.
///
/// TMODE has no documented reset value; DIEREV is what the configuration says.
pub const REGISTERS: [Register; 42] = [
    register(0x01, "WAVEFORM", Read, 24, true, 0),
    register(0x02, "AENERGY", Read, 24, true, 0),
    register(0x03, "RAENERGY", ReadClear, 24, true, 0),
    register(0x04, "LAENERGY", Read, 24, true, 0),
    register(0x05, "VAENERGY", Read, 24, false, 0),
    register(0x06, "RVAENERGY", ReadClear, 24, false, 0),
    register(0x07, "LVAENERGY", Read, 24, false, 0),
    register(0x08, "LVARENERGY", Read, 24, true, 0),
    register(0x09, "MODE", ReadWrite, 16, false, 0x000C),
    register(0x0A, "IRQEN", ReadWrite, 16, false, 0x0040),
    register(0x0B, "STATUS", Read, 16, false, 0),
    register(0x0C, "RSTSTATUS", ReadClear, 16, false, 0),
    register(0x0D, "CH1OS", ReadWrite, 8, true, 0),
    register(0x0E, "CH2OS", ReadWrite, 8, true, 0),
    register(0x0F, "GAIN", ReadWrite, 8, false, 0),
    register(0x10, "PHCAL", ReadWrite, 6, true, 0x0D),
    register(0x11, "APOS", ReadWrite, 16, true, 0),
    register(0x12, "WGAIN", ReadWrite, 12, true, 0),
    register(0x13, "WDIV", ReadWrite, 8, false, 0),
    register(0x14, "CFNUM", ReadWrite, 12, false, 0x3F),
    register(0x15, "CFDEN", ReadWrite, 12, false, 0x3F),
    register(0x16, "IRMS", Read, 24, false, 0),
    register(0x17, "VRMS", Read, 24, false, 0),
    register(0x18, "IRMSOS", ReadWrite, 12, true, 0),
    register(0x19, "VRMSOS", ReadWrite, 12, true, 0),
    register(0x1A, "VAGAIN", ReadWrite, 12, true, 0),
    register(0x1B, "VADIV", ReadWrite, 8, false, 0),
    register(0x1C, "LINECYC", ReadWrite, 16, false, 0xFFFF),
    register(0x1D, "ZXTOUT", ReadWrite, 12, false, 0xFFF),
    register(0x1E, "SAGCYC", ReadWrite, 8, false, 0xFF),
    register(0x1F, "SAGLVL", ReadWrite, 8, false, 0),
    register(0x20, "IPKLVL", ReadWrite, 8, false, 0xFF),
    register(0x21, "VPKLVL", ReadWrite, 8, false, 0xFF),
    register(0x22, "IPEAK", Read, 24, false, 0),
    register(0x23, "RSTIPEAK", ReadClear, 24, false, 0),
    register(0x24, "VPEAK", Read, 24, false, 0),
    register(0x25, "RSTVPEAK", ReadClear, 24, false, 0),
    register(0x26, "TEMP", Read, 8, true, 0),
    register(0x27, "PERIOD", Read, 16, false, 0),
    register(0x3D, "TMODE", ReadWrite, 8, false, 0),
    register(0x3E, "CHKSUM", Read, 6, false, 0),
    register(0x3F, "DIEREV", Read, 8, false, 0),
];

/// The register at `address`.
pub const fn at(address: u8) -> Option<Register> {
    let mut index = 0;
    while index < REGISTERS.len() {
        if REGISTERS[index].address == address {
            return Some(REGISTERS[index]);
        }
        index += 1;
    }
    None
}

pub(super) mod address {
    pub const WAVEFORM: u8 = 0x01;
    pub const AENERGY: u8 = 0x02;
    pub const RAENERGY: u8 = 0x03;
    pub const LAENERGY: u8 = 0x04;
    pub const VAENERGY: u8 = 0x05;
    pub const RVAENERGY: u8 = 0x06;
    pub const LVAENERGY: u8 = 0x07;
    pub const LVARENERGY: u8 = 0x08;
    pub const MODE: u8 = 0x09;
    pub const IRQEN: u8 = 0x0A;
    pub const STATUS: u8 = 0x0B;
    pub const RSTSTATUS: u8 = 0x0C;
    pub const CH1OS: u8 = 0x0D;
    pub const CH2OS: u8 = 0x0E;
    pub const GAIN: u8 = 0x0F;
    pub const APOS: u8 = 0x11;
    pub const WGAIN: u8 = 0x12;
    pub const WDIV: u8 = 0x13;
    pub const IRMS: u8 = 0x16;
    pub const VRMS: u8 = 0x17;
    pub const ZXTOUT: u8 = 0x1D;
    pub const SAGLVL: u8 = 0x1F;
    pub const IPKLVL: u8 = 0x20;
    pub const VPKLVL: u8 = 0x21;
    pub const IPEAK: u8 = 0x22;
    pub const RSTIPEAK: u8 = 0x23;
    pub const VPEAK: u8 = 0x24;
    pub const RSTVPEAK: u8 = 0x25;
    pub const TEMP: u8 = 0x26;
    pub const PERIOD: u8 = 0x27;
    pub const TMODE: u8 = 0x3D;
    pub const CHKSUM: u8 = 0x3E;
    pub const DIEREV: u8 = 0x3F;
}

/// Bits of MODE (0x09).
pub(super) mod mode {
    pub const DISHPF: u32 = 1 << 0;
    pub const DISLPF2: u32 = 1 << 1;
    pub const ASUSPEND: u32 = 1 << 4;
    pub const TEMPSEL: u32 = 1 << 5;
    pub const SWRST: u32 = 1 << 6;
    pub const CYCMODE: u32 = 1 << 7;
    pub const DISCH1: u32 = 1 << 8;
    pub const DISCH2: u32 = 1 << 9;
    pub const SWAP: u32 = 1 << 10;
    pub const POAM: u32 = 1 << 15;

    /// DTRT, bits 12:11.
    pub const fn rate(mode: u32) -> u32 {
        mode >> 11 & 3
    }

    /// WAVSEL, bits 14:13.
    pub const fn source(mode: u32) -> u32 {
        mode >> 13 & 3
    }
}

/// Bits of IRQEN, STATUS and RSTSTATUS.
pub mod flag {
    /// AENERGY is more than half full.
    pub const AEHF: u16 = 1 << 0;
    /// Sag on channel 2.
    pub const SAG: u16 = 1 << 1;
    /// End of a line-cycle accumulation.
    pub const CYCEND: u16 = 1 << 2;
    /// New data in WAVEFORM.
    pub const WSMP: u16 = 1 << 3;
    /// Zero crossing of channel 2.
    pub const ZX: u16 = 1 << 4;
    /// End of a temperature conversion.
    pub const TEMP: u16 = 1 << 5;
    /// End of a reset; never pulls IRQ.
    pub const RESET: u16 = 1 << 6;
    /// AENERGY has overflowed.
    pub const AEOF: u16 = 1 << 7;
    /// Channel 2 beyond VPKLVL.
    pub const PKV: u16 = 1 << 8;
    /// Channel 1 beyond IPKLVL.
    pub const PKI: u16 = 1 << 9;
    /// VAENERGY is more than half full.
    pub const VAEHF: u16 = 1 << 10;
    /// VAENERGY has overflowed.
    pub const VAEOF: u16 = 1 << 11;
    /// No zero crossing for ZXTOUT.
    pub const ZXTO: u16 = 1 << 12;
    /// Power turned positive.
    pub const PPOS: u16 = 1 << 13;
    /// Power turned negative.
    pub const PNEG: u16 = 1 << 14;
}

/// Two's complement of `bits` bits.
pub(super) const fn signed(value: u32, bits: u32) -> i32 {
    let shift = 32 - bits;
    (value << shift).cast_signed() >> shift
}

/// Sign and magnitude in bits 5:0, as CH1OS and CH2OS hold it.
pub(super) const fn sign_magnitude(value: u32) -> i32 {
    let magnitude = (value & 0x1F).cast_signed();
    if value & 0x20 == 0 {
        magnitude
    } else {
        -magnitude
    }
}
