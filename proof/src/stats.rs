//! Counts with their uncertainty.

use serde::Serialize;

/// Two-sided 95 % of a normal distribution.
const Z_95: f64 = 1.959_963_984_540_054;

/// So many of so many, with the 95 % interval of the share.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Share {
    /// How many.
    pub count: usize,
    /// Of how many.
    pub of: usize,
    /// Lower end of the interval, 0 … 1.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

impl Share {
    /// With Wilson's score interval (E. B. Wilson, J. Am. Stat. Assoc. 22 (1927) 209), which holds near 0 and 1 too.
    pub fn new(count: usize, of: usize) -> Self {
        if of == 0 {
            return Self {
                count,
                of,
                low: 0.0,
                high: 1.0,
            };
        }
        let (n, p) = (of as f64, count as f64 / of as f64);
        let square = Z_95 * Z_95;
        let middle = (p + square / (2.0 * n)) / (1.0 + square / n);
        let half = Z_95 / (1.0 + square / n) * (p * (1.0 - p) / n + square / (4.0 * n * n)).sqrt();
        Self {
            count,
            of,
            low: (middle - half).max(0.0),
            high: (middle + half).min(1.0),
        }
    }

    /// 0 … 1; nothing of nothing is not a number.
    pub fn value(&self) -> f64 {
        self.count as f64 / self.of as f64
    }

    /// How many of `values` hold.
    pub fn of<T>(values: impl IntoIterator<Item = T>, holds: impl Fn(&T) -> bool) -> Self {
        let (mut count, mut of) = (0, 0);
        for value in values {
            of += 1;
            count += usize::from(holds(&value));
        }
        Self::new(count, of)
    }
}

/// The middle value; the mean of the two middle ones of an even number. None of none.
pub fn median(values: &[f64]) -> Option<f64> {
    quantile(values, 0.5)
}

/// By straight lines between the sorted values.
pub fn quantile(values: &[f64], share: f64) -> Option<f64> {
    let mut sorted: Vec<f64> = values.iter().copied().filter(|v| v.is_finite()).collect();
    sorted.sort_by(f64::total_cmp);
    let last = sorted.len().checked_sub(1)?;
    let place = share.clamp(0.0, 1.0) * last as f64;
    let below = place.floor() as usize;
    let above = (below + 1).min(last);
    Some(sorted[below] + (place - below as f64) * (sorted[above] - sorted[below]))
}

/// Root of the mean square; None of none.
pub fn rms(values: impl IntoIterator<Item = f64>) -> Option<f64> {
    let (mut sum, mut count) = (0.0, 0usize);
    for value in values {
        sum += value * value;
        count += 1;
    }
    (count > 0).then(|| (sum / count as f64).sqrt())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    /// Agresti and Coull, The American Statistician 52 (1998) 119: 0 of 10 gives 0 … 0.2775.
    #[test]
    fn wilsons_interval_is_the_published_one() {
        let share = Share::new(0, 10);
        assert_eq!(share.low, 0.0);
        assert!((share.high - 0.2775).abs() < 5e-4, "{}", share.high);
        let half = Share::new(5, 10);
        assert!((half.low - 0.2366).abs() < 5e-4 && (half.high - 0.7634).abs() < 5e-4);
    }

    #[test]
    fn a_median_is_in_the_middle() {
        assert_eq!(median(&[3.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(&[1.0, 2.0]), Some(1.5));
        assert_eq!(median(&[]), None);
        assert_eq!(quantile(&[0.0, 1.0, 2.0], 1.0), Some(2.0));
    }

    #[test]
    fn rms_of_a_constant_is_its_magnitude() {
        assert_eq!(rms([-2.0, 2.0]), Some(2.0));
        assert_eq!(rms([]), None);
    }
}
