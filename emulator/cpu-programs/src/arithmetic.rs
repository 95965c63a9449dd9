//! What the compiler makes of arithmetic: 64-bit products and quotients, floating point in software and hardware, and the
//! conditions of branches.

use core::arch::asm;
use core::hint::black_box;

use crate::log;

const ROUNDS: u32 = 400;

/// xorshift32 (Marsaglia, 2003).
pub struct Random(pub u32);

impl Random {
    pub fn next(&mut self) -> u32 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 17;
        self.0 ^= self.0 << 5;
        self.0
    }

    /// Of any magnitude.
    fn wide(&mut self) -> u64 {
        let value = u64::from(self.next()) << 32 | u64::from(self.next());
        value >> (self.next() & 63)
    }
}

/// FNV-1a over words.
struct Digest(u32);

impl Digest {
    fn add(&mut self, value: u32) {
        self.0 = (self.0 ^ value).wrapping_mul(0x0100_0193);
    }

    fn add_wide(&mut self, value: u64) {
        self.add(value as u32);
        self.add((value >> 32) as u32);
    }
}

pub fn run() {
    let mut random = Random(0x2F6E_2B1D);
    let mut digest = Digest(0x811C_9DC5);
    for round in 0..ROUNDS {
        let (a, b) = (black_box(random.wide()), black_box(random.wide() | 1));
        let (signed_a, signed_b) = (a as i64, b as i64);
        digest.add_wide(a.wrapping_mul(b));
        digest.add_wide(a / b);
        digest.add_wide(a % b);
        digest.add_wide(signed_a.wrapping_div(signed_b) as u64);
        digest.add_wide(signed_a.wrapping_rem(signed_b) as u64);
        digest.add_wide(((u128::from(a) * u128::from(b)) >> 64) as u64);
        digest.add_wide(a << (round & 63) ^ a >> (b & 63) ^ (signed_a >> (a & 63)) as u64);
        digest.add_wide(signed_a.saturating_add(signed_b) as u64);
        digest.add((a as i32).saturating_sub(b as i32) as u32);
        digest.add(a.leading_zeros() ^ b.trailing_zeros() ^ a.count_ones());
        // Any bits are a number, an infinity or a NaN.
        let (x, y) = (black_box(f64::from_bits(a)), black_box(f64::from_bits(b)));
        let (p, q) = (black_box(a as i32 as f64), black_box(signed_b as f64));
        for value in [p * q, p / q, p + q, p - q] {
            digest.add_wide(value.to_bits());
        }
        digest.add(u32::from(x < y) | u32::from(x == y) << 1 | u32::from(x >= y) << 2);
        digest.add_wide(p as i64 as u64);
        digest.add(q as f32 as i32 as u32);
        let (s, t) = (black_box(f32::from_bits(a as u32)), black_box(b as f32));
        digest.add(u32::from(s < t) | u32::from(s == t) << 1 | u32::from(s >= t) << 2);
        digest.add((a as i32 as f32 / t).to_bits());
        digest.add(s as i32 as u32);
        digest.add(s as u32);
        if round % 20 == 19 {
            log(digest.0);
        }
    }
    conditions();
}

/// Which of the 14 conditions hold, for each combination of flags, as branches and as conditional blocks.
fn conditions() {
    macro_rules! hold {
        ($flags:expr, $($condition:literal $opposite:literal)*) => {{
            let mut held = 0_u32;
            $(
                let (branched, blocked): (u32, u32);
                // SAFETY: registers and flags only.
                unsafe {
                    asm!(
                        "msr apsr_nzcvq, {f}",
                        "mov {o}, #1",
                        concat!("b", $condition, " 2f"),
                        "mov {o}, #0",
                        "2:",
                        "msr apsr_nzcvq, {f}",
                        concat!("ite ", $condition),
                        concat!("mov", $condition, " {p}, #2"),
                        concat!("mov", $opposite, " {p}, #0"),
                        f = in(reg) $flags, o = out(reg) branched, p = out(reg) blocked,
                    );
                }
                held = held << 2 | branched | blocked;
            )*
            held
        }};
    }
    for flags in 0..16_u32 {
        let flags = flags << 28;
        log(hold!(flags,
            "eq" "ne" "ne" "eq" "cs" "cc" "cc" "cs" "mi" "pl" "pl" "mi" "vs" "vc" "vc" "vs"
            "hi" "ls" "ls" "hi" "ge" "lt" "lt" "ge" "gt" "le" "le" "gt"));
    }
}
