//! The magnetic core of a Hall sensor: hysteresis and saturation, both independent of rate.
//!
//! **Hysteresis.** Along the core `i = H(B)·l + B·g/µ₀` (Ampère's law, gap g, mean path l), and the Hall plate reads the
//! second term. So the reading lacks the core's own magnetic potential `H·l`, which is bounded by the coercive field and
//! changes sign only after the current has moved back by some distance. A stop operator does just that: it follows the
//! current and stops at ±r. Their weighted sum is a Prandtl–Ishlinskii operator (Visintin, *Differential Models of
//! Hysteresis*, 1994, ch. III; Kuhnen, European Journal of Control 9 (2003) 407): loops close, minor loops leave no trace
//! once a larger swing has passed over them (wiping-out), equal minor loops are congruent, and the history is five numbers.
//!
//! **Saturation.** Beyond the knee the reading follows the Fröhlich–Kennelly curve x / (1 + x/s), which leaves the line
//! without a bend and ends at `knee + s`.

use serde::{Deserialize, Serialize};

/// Stop operators. Their thresholds lie evenly around the coercive current.
const STOPS: usize = 5;
/// Thresholds in units of the coercive current. Every one is at least a half of it and their mean is one: so the error
/// at 0 A is taken away by exactly one excursion of the coercive current to the other side.
const THRESHOLDS: [f64; STOPS] = [0.5, 0.75, 1.0, 1.25, 1.5];

/// Hysteresis and saturation of a core; nominal: neither.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MagneticCoreConfig {
    /// Zero error left after a swing to full range and back, in A; it has the sign of the swing. 0: no hysteresis.
    pub remanence_a: f64,
    /// Current to the other side that takes this error away again, in A. Sensitivity within small loops is lower by
    /// about `remanence_a / coercivity_a`, so this is many times the remanence. Full range should be at least three
    /// times as large, or the core never comes round.
    pub coercivity_a: f64,
    /// Current from which the reading falls short, in A. ∞: no saturation.
    pub knee_a: f64,
    /// Rise of the reading from the knee to complete saturation, in units of the knee. Small is a hard limit.
    pub softness: f64,
}

impl Default for MagneticCoreConfig {
    fn default() -> Self {
        Self {
            remanence_a: 0.0,
            coercivity_a: 0.0,
            knee_a: f64::INFINITY,
            softness: 1.0,
        }
    }
}

/// What a core remembers: the current, and the stops in A. `default()` is demagnetised at 0 A.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct MagneticCoreState {
    current_a: f64,
    stops_a: [f64; STOPS],
}

/// A [`MagneticCoreConfig`] made ready for a sensor of known range.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MagneticCore {
    weight: f64,
    thresholds_a: [f64; STOPS],
    knee_a: f64,
    span_a: f64,
}

impl MagneticCore {
    /// The core of a sensor whose range ends at ±`full_scale_a`.
    pub fn new(config: &MagneticCoreConfig, full_scale_a: f64) -> Self {
        let thresholds_a = THRESHOLDS.map(|share| share * config.coercivity_a.max(0.0));
        // From a demagnetised core out to full scale and back to 0 A, with weight one.
        let left_a: f64 = thresholds_a
            .iter()
            .map(|r| {
                let at_full_scale = full_scale_a.min(*r);
                -(at_full_scale - full_scale_a).max(-r)
            })
            .sum();
        let weight = if config.remanence_a != 0.0 && left_a > 0.0 {
            config.remanence_a / left_a
        } else {
            0.0
        };
        Self {
            weight,
            thresholds_a,
            knee_a: config.knee_a.max(0.0),
            span_a: (config.softness * config.knee_a).max(0.0),
        }
    }

    /// Whether the reading depends on the past.
    pub fn has_hysteresis(&self) -> bool {
        self.weight != 0.0
    }

    /// The state after the current has gone from where it was to `current_a` without turning back on its way.
    pub fn magnetise(&self, state: &MagneticCoreState, current_a: f64) -> MagneticCoreState {
        if !self.has_hysteresis() {
            return MagneticCoreState {
                current_a,
                ..*state
            };
        }
        let moved_a = current_a - state.current_a;
        MagneticCoreState {
            current_a,
            stops_a: std::array::from_fn(|k| {
                let r = self.thresholds_a[k];
                (state.stops_a[k] + moved_a).max(-r).min(r)
            }),
        }
    }

    /// The current that the field in the gap stands for, in A.
    pub fn reading_a(&self, state: &MagneticCoreState) -> f64 {
        self.saturated_a(state.current_a + self.zero_error_a(state))
    }

    /// The part of the reading that is the core's memory, in A.
    pub fn zero_error_a(&self, state: &MagneticCoreState) -> f64 {
        if self.has_hysteresis() {
            -self.weight * state.stops_a.iter().sum::<f64>()
        } else {
            0.0
        }
    }

    /// Saturation alone.
    pub fn saturated_a(&self, current_a: f64) -> f64 {
        let beyond_a = current_a.abs() - self.knee_a;
        if beyond_a <= 0.0 || beyond_a.is_nan() {
            return current_a;
        }
        if self.span_a == 0.0 {
            return self.knee_a.copysign(current_a);
        }
        (self.knee_a + beyond_a / (1.0 + beyond_a / self.span_a)).copysign(current_a)
    }
}
