//! The quantities of the measuring path, one type each, so that a raw integer never crosses a module's edge.
//!
//! All arithmetic saturates: a reading at the end of its type's range is a reading beyond every sensor here, and the
//! validity rules refuse it long before. **Positive current is discharge**, and so is positive charge.

use serde::{Deserialize, Serialize};

/// Time since the board started, in microseconds (64 bit: 584,000 years before it wraps).
pub type Instant = fugit::MonotonicTimerInstantU64<1_000_000>;

/// A length of time in microseconds.
pub type Duration = fugit::MicrosDurationU64;

/// `later - earlier`, or zero when the two are in the wrong order. Not inlined: see below.
#[must_use]
#[inline(never)]
pub fn elapsed(earlier: Instant, later: Instant) -> Duration {
    later
        .checked_duration_since(earlier)
        .unwrap_or_else(|| Duration::from_ticks(0))
}

/// Charge that a constant current moves: µA · µs / 1000 = nC.
#[must_use]
pub fn charge_of(current: Microamps, time: Duration) -> Nanocoulombs {
    let time = i64::try_from(time.as_ticks()).unwrap_or(i64::MAX);
    Nanocoulombs(mul_div(time, i64::from(current.get()), 1_000))
}

/// A length of time in milliseconds, as configurations state it.
#[must_use]
pub const fn milliseconds(milliseconds: u32) -> Duration {
    Duration::from_ticks(milliseconds as u64 * 1_000)
}

// Sums of 64 bits are calls: inlined they take ten instructions each, where the Cortex-M4 has one for 32 bits.
macro_rules! quantity {
    ($(#[$doc:meta])* $name:ident($raw:ty), $unit:literal, $add:path, $sub:path, $abs:path) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
        #[cfg_attr(feature = "defmt", derive(defmt::Format))]
        #[serde(transparent)]
        pub struct $name(pub $raw);

        impl $name {
            /// Nothing of it.
            pub const ZERO: Self = Self(0);
            /// The symbol of the unit in which the number counts.
            pub const UNIT: &'static str = $unit;

            /// The bare number, for a wire format or a formula whose unit is stated there.
            #[must_use]
            pub const fn get(self) -> $raw {
                self.0
            }

            /// `self + other`, stopping at the type's ends.
            #[must_use]
            pub const fn saturating_add(self, other: Self) -> Self {
                Self($add(self.0, other.0))
            }

            /// `self - other`, stopping at the type's ends.
            #[must_use]
            pub const fn saturating_sub(self, other: Self) -> Self {
                Self($sub(self.0, other.0))
            }

            /// The magnitude; the most negative number becomes the most positive one.
            #[must_use]
            pub const fn saturating_abs(self) -> Self {
                Self($abs(self.0))
            }
        }
    };
}

quantity!(
    /// Electric current in microamperes: ±2,147 A.
    Microamps(i32), "µA", i32::saturating_add, i32::saturating_sub, i32::saturating_abs
);
quantity!(
    /// Voltage of a signal in microvolts: ±2,147 V.
    Microvolts(i32), "µV", i32::saturating_add, i32::saturating_sub, i32::saturating_abs
);
quantity!(
    /// Voltage of a supply, cell or pack in millivolts.
    Millivolts(i32), "mV", i32::saturating_add, i32::saturating_sub, i32::saturating_abs
);
quantity!(
    /// Electric charge in nanocoulombs: ±9.2·10⁹ C, that is 2.5 million ampere-hours.
    Nanocoulombs(i64), "nC", add_i64, sub_i64, abs_i64
);
quantity!(
    /// Temperature in thousandths of a degree Celsius.
    MilliCelsius(i32), "m°C", i32::saturating_add, i32::saturating_sub, i32::saturating_abs
);
quantity!(
    /// A dimensionless factor or share in millionths.
    Ppm(i32), "ppm", i32::saturating_add, i32::saturating_sub, i32::saturating_abs
);

impl Microamps {
    /// From whole amperes, stopping at the type's ends.
    #[must_use]
    pub const fn from_amps(amps: i32) -> Self {
        Self(amps.saturating_mul(1_000_000))
    }

    /// From milliamperes, stopping at the type's ends.
    #[must_use]
    pub const fn from_milliamps(milliamps: i32) -> Self {
        Self(milliamps.saturating_mul(1_000))
    }

    /// In milliamperes, rounded to nearest, halves away from zero.
    #[must_use]
    pub const fn to_milliamps(self) -> i32 {
        // A quotient by 1000 of an i32 is an i32.
        #[expect(clippy::cast_possible_truncation, reason = "|x / 1000| < 2^31")]
        {
            div_round(self.0 as i64, 1_000) as i32
        }
    }
}

impl Microvolts {
    /// From millivolts, stopping at the type's ends.
    #[must_use]
    pub const fn from_millivolts(millivolts: i32) -> Self {
        Self(millivolts.saturating_mul(1_000))
    }
}

impl Nanocoulombs {
    /// From whole coulombs, stopping at the type's ends.
    #[must_use]
    pub const fn from_coulombs(coulombs: i64) -> Self {
        Self(coulombs.saturating_mul(1_000_000_000))
    }

    /// From milliampere-hours (1 mAh = 3.6 C), stopping at the type's ends.
    #[must_use]
    pub const fn from_milliamp_hours(milliamp_hours: i64) -> Self {
        Self(milliamp_hours.saturating_mul(3_600_000_000))
    }
}

impl Ppm {
    /// The factor one.
    pub const ONE: Self = Self(1_000_000);
}

// Wide arithmetic is some 30 to 200 bytes of code on the Cortex-M4 wherever it is inlined, and a call costs a few
// cycles beside it: hence `inline(never)` below.

/// `numerator / denominator` rounded to nearest, halves away from zero; 0 when the denominator is 0.
#[must_use]
#[inline(never)]
pub const fn div_round(numerator: i64, denominator: i64) -> i64 {
    if denominator == 0 {
        return 0;
    }
    let Some(quotient) = numerator.checked_div(denominator) else {
        return i64::MAX; // i64::MIN / -1
    };
    let remainder = (numerator - quotient * denominator).unsigned_abs();
    if remainder == 0 || remainder < denominator.unsigned_abs() - remainder {
        quotient
    } else if (numerator < 0) == (denominator < 0) {
        quotient.saturating_add(1)
    } else {
        quotient.saturating_sub(1)
    }
}

/// As [`div_round`], with 128-bit numbers.
#[must_use]
#[inline(never)]
pub const fn div_round_i128(numerator: i128, denominator: i128) -> i128 {
    let quotient = div_i128(numerator, denominator);
    // Of MIN / −1, the one quotient that stops at the end, this wraps to 0, as it should.
    let exact = quotient.wrapping_mul(denominator);
    let remainder = numerator.wrapping_sub(exact).unsigned_abs();
    if denominator == 0 || remainder < denominator.unsigned_abs().wrapping_sub(remainder) {
        quotient
    } else if (numerator < 0) == (denominator < 0) {
        quotient.saturating_add(1)
    } else {
        quotient.saturating_sub(1)
    }
}

/// `numerator / denominator` without its fraction, stopping at the type's ends; 0 when the denominator is 0.
#[must_use]
#[inline(never)]
pub const fn div_i128(numerator: i128, denominator: i128) -> i128 {
    let quotient = div_u128(numerator.unsigned_abs(), denominator.unsigned_abs());
    if (numerator < 0) == (denominator < 0) {
        if quotient > i128::MAX.unsigned_abs() {
            i128::MAX
        } else {
            quotient.cast_signed()
        }
    } else {
        quotient.wrapping_neg().cast_signed()
    }
}

/// `n / d`, or 0 when `d` is 0: a long division by digits of 32 bits (Knuth, The Art of Computer Programming 4.3.1,
/// algorithm D). No division in it can panic: each panic is a place in the flash, whether it is ever reached or not.
///
/// The compiler's own goes bit by bit on this core, 5,500 clocks, too long for what must not delay a range edge.
#[inline(never)]
const fn div_u128(n: u128, d: u128) -> u128 {
    let (n_high, n_low) = halves(n);
    let (d_high, d_low) = halves(d);
    if d_high == 0 {
        let Some(high) = n_high.checked_div(d_low) else {
            return 0;
        };
        let low = div_2_by_1(n_high % d_low, n_low, d_low);
        return (high as u128) << 64 | low as u128;
    }
    // Of a divisor above 64 bits the upper 64 give the quotient to within one.
    let shift = d_high.leading_zeros();
    let (top, _) = halves(d << shift);
    let (half_high, half_low) = halves(n >> 1);
    let guess = div_2_by_1(half_high, half_low, top) as u128;
    let guess = ((guess << shift) >> 63).saturating_sub(1);
    if n - guess * d >= d { guess + 1 } else { guess }
}

const fn halves(value: u128) -> (u64, u64) {
    #[expect(clippy::cast_possible_truncation, reason = "the lower half")]
    ((value >> 64) as u64, value as u64)
}

/// `(high · 2⁶⁴ + low) / d` for `high` < `d`, so that the quotient fits.
#[inline(never)]
const fn div_2_by_1(high: u64, low: u64, d: u64) -> u64 {
    if high == 0 {
        return match low.checked_div(d) {
            Some(quotient) => quotient,
            None => 0,
        };
    }
    const DIGIT: u64 = 1 << 32;
    // With the divisor's top bit set a guessed digit is at most two too large.
    let shift = d.leading_zeros();
    let d = d << shift;
    let (d1, d0) = (d >> 32, d & (DIGIT - 1));
    let wide = ((high as u128) << 64 | low as u128) << shift;
    let (upper, lower) = halves(wide);
    let mut quotient = 0;
    let mut rest = upper;
    let mut place = 2;
    while place > 0 {
        place -= 1;
        let next = lower >> (32 * place) & (DIGIT - 1);
        let Some(mut digit) = rest.checked_div(d1) else {
            return 0;
        };
        let mut left = rest % d1;
        while digit >= DIGIT || digit * d0 > (left << 32 | next) {
            digit -= 1;
            left += d1;
            if left >= DIGIT {
                break;
            }
        }
        rest = (rest << 32 | next).wrapping_sub(digit.wrapping_mul(d));
        quotient = quotient << 32 | digit;
    }
    quotient
}

/// `value · multiplier / divisor` rounded to nearest without an intermediate overflow, stopping at the ends of `i64`.
///
/// A product that fits 64 bits is divided there: on the Cortex-M4 that is some ten times cheaper than 128 bits.
#[must_use]
#[inline(never)]
pub const fn mul_div(value: i64, multiplier: i64, divisor: i64) -> i64 {
    match value.checked_mul(multiplier) {
        Some(product) => div_round(product, divisor),
        None => clamp_i64(div_round_i128(
            value as i128 * multiplier as i128,
            divisor as i128,
        )),
    }
}

/// `a · b`, exact.
#[must_use]
#[inline(never)]
pub const fn mul_wide(a: i64, b: i64) -> i128 {
    a as i128 * b as i128
}

/// `a · b`, stopping at the type's ends.
#[must_use]
#[inline(never)]
pub const fn mul_i64(a: i64, b: i64) -> i64 {
    a.saturating_mul(b)
}

/// The magnitude, stopping at the type's end.
#[must_use]
#[inline(never)]
pub const fn abs_i64(a: i64) -> i64 {
    a.saturating_abs()
}

/// The magnitude, stopping at the type's end.
#[must_use]
#[inline(never)]
pub const fn abs_i128(a: i128) -> i128 {
    a.saturating_abs()
}

/// `a · b`, stopping at the type's ends.
#[must_use]
#[inline(never)]
pub const fn mul_i128(a: i128, b: i128) -> i128 {
    a.saturating_mul(b)
}

/// `a + b`, stopping at the type's ends.
#[must_use]
#[inline(never)]
pub const fn add_i128(a: i128, b: i128) -> i128 {
    a.saturating_add(b)
}

/// `a − b`, stopping at the type's ends.
#[must_use]
#[inline(never)]
pub const fn sub_i128(a: i128, b: i128) -> i128 {
    a.saturating_sub(b)
}

/// The nearest `i64`.
#[must_use]
#[inline(never)]
#[expect(clippy::cast_possible_truncation, reason = "the range is checked")]
pub const fn clamp_i64(value: i128) -> i64 {
    if value > i64::MAX as i128 {
        i64::MAX
    } else if value < i64::MIN as i128 {
        i64::MIN
    } else {
        value as i64
    }
}

/// The nearest `i32`.
#[must_use]
#[inline(never)]
pub const fn clamp_i32(value: i64) -> i32 {
    clamp_i32_inline(value)
}

/// As [`clamp_i32`], without the call: for what is done with every sample.
#[must_use]
#[inline(always)]
#[expect(clippy::cast_possible_truncation, reason = "the range is checked")]
pub const fn clamp_i32_inline(value: i64) -> i32 {
    if value > i32::MAX as i64 {
        i32::MAX
    } else if value < i32::MIN as i64 {
        i32::MIN
    } else {
        value as i32
    }
}

/// The square root, rounded down: digit by digit, as the language's own takes 1 KiB of flash for a speed that nothing
/// here needs.
#[must_use]
#[inline(never)]
pub const fn isqrt(value: u64) -> u64 {
    let (mut rest, mut root, mut bit) = (value, 0, 1_u64 << 62);
    while bit != 0 {
        let trial = root | bit;
        root >>= 1;
        if rest >= trial {
            rest -= trial;
            root |= bit;
        }
        bit >>= 2;
    }
    root
}

/// `a + b`, stopping at the type's ends.
#[must_use]
#[inline(never)]
pub const fn add_i64(a: i64, b: i64) -> i64 {
    a.saturating_add(b)
}

/// `a − b`, stopping at the type's ends.
#[must_use]
#[inline(never)]
pub const fn sub_i64(a: i64, b: i64) -> i64 {
    a.saturating_sub(b)
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::cast_possible_truncation)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn rounding_is_to_nearest_and_symmetric() {
        assert_eq!(div_round(7, 2), 4);
        assert_eq!(div_round(-7, 2), -4);
        assert_eq!(div_round(7, -2), -4);
        assert_eq!(div_round(-7, -2), 4);
        assert_eq!(div_round(5, 4), 1);
        assert_eq!(div_round(-5, 4), -1);
        assert_eq!(div_round(6, 3), 2);
        assert_eq!(div_round(1, 0), 0);
        assert_eq!(div_round_i128(i128::MIN, -1), i128::MAX);
        assert_eq!(div_round(0, 1), 0);
        assert_eq!(div_round(0, -1), 0);
    }

    #[test]
    fn conversions_and_their_ends() {
        assert_eq!(Microamps::from_amps(60).get(), 60_000_000);
        assert_eq!(Microamps::from_amps(-3_000), Microamps(i32::MIN));
        assert_eq!(Microamps::from_milliamps(5).get(), 5_000);
        assert_eq!(Microamps(1_499).to_milliamps(), 1);
        assert_eq!(Microamps(-1_500).to_milliamps(), -2);
        assert_eq!(Microvolts::from_millivolts(2_500).get(), 2_500_000);
        assert_eq!(Nanocoulombs::from_coulombs(2).get(), 2_000_000_000);
        assert_eq!(Nanocoulombs::from_milliamp_hours(1).get(), 3_600_000_000);
        assert_eq!(Microamps::UNIT, "µA");
        assert_eq!(Ppm::ONE.get(), 1_000_000);
        assert_eq!(Microamps::ZERO.get(), 0);
        assert_eq!(Microvolts(i32::MIN).saturating_abs(), Microvolts(i32::MAX));
        assert_eq!(Microvolts(3).saturating_add(Microvolts(4)).get(), 7);
        assert_eq!(Microvolts(3).saturating_sub(Microvolts(4)).get(), -1);
        assert_eq!(clamp_i32(i64::from(i32::MAX) + 1), i32::MAX);
        assert_eq!(clamp_i32(i64::from(i32::MIN) - 1), i32::MIN);
        assert_eq!(clamp_i64(i128::from(i64::MAX) + 1), i64::MAX);
        assert_eq!(clamp_i64(i128::from(i64::MIN) - 1), i64::MIN);
    }

    #[test]
    fn elapsed_never_goes_backwards() {
        let (early, late) = (Instant::from_ticks(5), Instant::from_ticks(12));
        assert_eq!(elapsed(early, late).as_ticks(), 7);
        assert_eq!(elapsed(late, early).as_ticks(), 0);
    }

    proptest! {
        #[test]
        fn rounded_quotient_is_within_half_of_the_divisor(n: i64, d in 1..i64::MAX) {
            let q = i128::from(div_round(n, d));
            let error = (i128::from(n) - q * i128::from(d)).abs();
            prop_assert!(2 * error <= i128::from(d));
            prop_assert_eq!(div_round(n.saturating_neg(), d), div_round(n, d).saturating_neg());
        }

        #[test]
        fn long_division_is_that_of_the_language(n: u128, d: u128, n_bits in 0..128u32, d_bits in 0..128u32) {
            let (n, d) = (n >> n_bits, (d >> d_bits).max(1));
            prop_assert_eq!(div_u128(n, d), n / d);
            // Neighbours of a multiple, where a digit is most easily one off.
            let product = (n / d) * d;
            prop_assert_eq!(div_u128(product, d), product / d);
            prop_assert_eq!(div_u128(product.saturating_sub(1), d), product.saturating_sub(1) / d);
        }

        #[test]
        fn square_root_is_that_of_the_language(value: u64, bits in 0..64u32) {
            let root = isqrt(value >> bits);
            prop_assert_eq!(root, (value >> bits).isqrt());
            // Beside a square, where it is most easily one off.
            for value in [root * root, (root * root).saturating_sub(1), u64::MAX] {
                prop_assert_eq!(isqrt(value), value.isqrt());
            }
        }

        #[test]
        fn signs_and_ends_are_those_of_the_language(n: i128, d: i128) {
            for n in [n, i128::MIN, i128::MAX] {
                for d in [d, -1, 1, i128::MIN] {
                    prop_assert_eq!(div_i128(n, d), if d == 0 { 0 } else { n.saturating_div(d) });
                }
            }
        }

        #[test]
        fn mul_div_agrees_with_wide_arithmetic(v: i32, m: i32, d in 1..i32::MAX) {
            let exact = f64::from(v) * f64::from(m) / f64::from(d);
            let got = mul_div(i64::from(v), i64::from(m), i64::from(d));
            prop_assert!((got as f64 - exact).abs() <= 0.5 + exact.abs() * 1e-12);
        }

        #[test]
        fn both_widths_round_alike(v: i64, m: i64, d: i64) {
            let wide = clamp_i64(div_round_i128(i128::from(v) * i128::from(m), i128::from(d)));
            prop_assert_eq!(mul_div(v, m, d), wide);
            prop_assert_eq!(div_round(v, d), clamp_i64(div_round_i128(i128::from(v), i128::from(d))));
        }

        #[test]
        fn wide_operations_are_exact_and_stop_at_the_ends(a: i64, b: i64) {
            let (wide_a, wide_b) = (i128::from(a), i128::from(b));
            prop_assert_eq!(mul_wide(a, b), wide_a * wide_b);
            prop_assert_eq!(mul_i128(wide_a, wide_b), wide_a * wide_b);
            prop_assert_eq!(add_i128(wide_a, wide_b), wide_a + wide_b);
            prop_assert_eq!(sub_i128(wide_a, wide_b), wide_a - wide_b);
            prop_assert_eq!(mul_i128(i128::MIN, 2 + wide_b.abs()), i128::MIN);
            prop_assert_eq!(add_i64(a, b), a.saturating_add(b));
            prop_assert_eq!(sub_i64(a, b), a.saturating_sub(b));
            prop_assert_eq!(add_i128(i128::MAX, 1 + wide_b.abs()), i128::MAX);
            prop_assert_eq!(sub_i128(i128::MIN, 1 + wide_b.abs()), i128::MIN);
        }

        #[test]
        fn no_operation_panics(a: i64, b: i64, c: i64) {
            let _ = (div_round(a, b), mul_div(a, b, c), clamp_i32(a));
        }
    }
}
