//! A result and its voltage.

use crate::settings::Settings;

/// The result of one conversion.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Sample {
    /// The code, right-justified: within `data_rate.min_code()` and `data_rate.max_code()`.
    pub code: i16,
    /// The settings of the conversion, as read back together with the code.
    pub settings: Settings,
}

impl Sample {
    /// Whether the code is at an end of its range, so that the input may be beyond it.
    #[must_use]
    pub const fn is_clipped(self) -> bool {
        self.code == self.settings.data_rate.max_code()
            || self.code == self.settings.data_rate.min_code()
    }

    /// The differential input voltage in microvolts for a supply of `vdd_microvolts`, which is the reference.
    ///
    /// V = code·VDD / (2^(bits - 1)·gain) (SBAS239, output code calculation), rounded to the nearest microvolt, halves
    /// away from zero. Saturates at the ends of `i32`, which needs a VDD above 2147 V.
    #[must_use]
    pub fn microvolts(self, vdd_microvolts: u32) -> i32 {
        let full_scale = 1i64 << (self.settings.data_rate.bits() - 1);
        let divisor = full_scale * i64::from(self.settings.gain.factor());
        // At most 2^15 · 2^32: far inside i64.
        let product = i64::from(self.code) * i64::from(vdd_microvolts);
        let half = if product < 0 {
            -divisor / 2
        } else {
            divisor / 2
        };
        let rounded = (product + half) / divisor;
        i32::try_from(rounded).unwrap_or(if rounded < 0 { i32::MIN } else { i32::MAX })
    }
}
