//! Active power as a function of the sample number, and the 49-bit accumulator that adds it up.
//!
//! The chip adds one number every four clocks. Within a stretch the input is a straight line, so the number is a
//! constant, a slope and at most two decaying exponentials, and its sum over any number of samples has a closed form.

/// Power at sample k of a stretch, k = 1 …
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Response {
    pub constant: f64,
    /// Per sample.
    pub slope: f64,
    /// Amplitude that decays with the high-pass filter of channel 1.
    pub high_pass: f64,
    /// Amplitude that decays with LPF2.
    pub low_pass: f64,
}

/// A decay per sample.
#[derive(Clone, Copy, Debug)]
pub(super) struct Decay {
    /// Logarithm of the factor per sample; negative.
    pub ln: f64,
    /// The factor.
    factor: f64,
    /// The factor less 1.
    less_one: f64,
    /// The last power asked for, less 1.
    cached: (f64, f64),
}

impl Decay {
    /// First order with this corner at this sampling rate.
    pub fn new(corner_hz: f64, sampling_hz: f64) -> Self {
        let ln = -std::f64::consts::TAU * corner_hz / sampling_hz;
        Self {
            ln,
            factor: ln.exp(),
            less_one: ln.exp_m1(),
            cached: (0.0, 0.0),
        }
    }

    pub const fn factor(&self) -> f64 {
        self.factor
    }

    /// 1 less the factor.
    pub const fn step(&self) -> f64 {
        -self.less_one
    }

    /// factor^samples − 1.
    pub fn power_less_one(&mut self, samples: f64) -> f64 {
        if self.cached.0 != samples {
            self.cached = (samples, (self.ln * samples).exp_m1());
        }
        self.cached.1
    }

    /// factor^samples, without working out what is known.
    fn power(&self, samples: f64) -> f64 {
        if samples == 1.0 {
            self.factor
        } else if self.cached.0 == samples {
            self.cached.1 + 1.0
        } else {
            (self.ln * samples).exp()
        }
    }

    /// Σ factor^k for k = first … first + samples − 1.
    fn sum(&mut self, first: f64, samples: f64) -> f64 {
        self.power(first) * self.power_less_one(samples) / self.less_one
    }
}

/// The two filters.
#[derive(Clone, Copy, Debug)]
pub(super) struct Decays {
    pub high_pass: Decay,
    pub low_pass: Decay,
}

impl Response {
    pub fn value(&self, sample: f64, decays: &Decays) -> f64 {
        let mut value = self.constant + self.slope * sample;
        if self.high_pass != 0.0 {
            value += self.high_pass * decays.high_pass.power(sample);
        }
        if self.low_pass != 0.0 {
            value += self.low_pass * decays.low_pass.power(sample);
        }
        value
    }

    /// Σ value(k) for k = first … last.
    pub fn sum(&self, first: f64, last: f64, decays: &mut Decays) -> f64 {
        let samples = last - first + 1.0;
        let mut sum = samples * (self.constant + self.slope * 0.5 * (first + last));
        if self.high_pass != 0.0 {
            sum += self.high_pass * decays.high_pass.sum(first, samples);
        }
        if self.low_pass != 0.0 {
            sum += self.low_pass * decays.low_pass.sum(first, samples);
        }
        sum
    }

    /// The least and the greatest value(k) for k = first … last: at the ends, or where the curve turns.
    ///
    /// It turns once at most: there is a slope or a second decay, never both, as the high-pass takes slopes away.
    pub fn bounds(&self, first: f64, last: f64, decays: &Decays) -> (f64, f64) {
        if self.high_pass == 0.0 && self.low_pass == 0.0 {
            let ends = (
                self.constant + self.slope * first,
                self.constant + self.slope * last,
            );
            return (ends.0.min(ends.1), ends.0.max(ends.1));
        }
        let ends = (self.value(first, decays), self.value(last, decays));
        let mut low = ends.0.min(ends.1);
        let mut high = ends.0.max(ends.1);
        let (high_ln, low_ln) = (decays.high_pass.ln, decays.low_pass.ln);
        let turn = if self.slope == 0.0 {
            let ratio = -self.low_pass * low_ln / (self.high_pass * high_ln);
            ratio.ln() / (high_ln - low_ln)
        } else {
            let ratio = -self.slope / (self.low_pass * low_ln);
            ratio.ln() / low_ln
        };
        // Not a number, or infinite, where it does not turn.
        if turn > first && turn < last {
            let there = self.value(turn, decays);
            low = low.min(there);
            high = high.max(there);
        }
        (low, high)
    }
}

/// How the accumulator treats a number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Sense {
    Negative,
    /// Below the no-load threshold.
    Dead,
    Positive,
}

impl Sense {
    pub fn of(power: f64, threshold: f64) -> Self {
        if power.abs() < threshold {
            Self::Dead
        } else if power < 0.0 {
            Self::Negative
        } else {
            Self::Positive
        }
    }
}

/// What an addition passed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Passed {
    /// Half the positive range, upwards.
    pub half_up: bool,
    /// Half the negative range, downwards.
    pub half_down: bool,
    /// The end of the range, either one.
    pub overflow: bool,
}

/// The internal accumulator, 49 bits and what is smaller.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Accumulator {
    /// −2⁴⁸ … 2⁴⁸ − 1.
    whole: i64,
    /// 0 … 1.
    fraction: f64,
}

/// Bits below AENERGY.
pub(super) const HIDDEN_BITS: u32 = 25;
const SPAN: i64 = 1 << 49;
const END: i64 = SPAN / 2;
const HALF: i64 = END / 2;

impl Accumulator {
    pub fn add(&mut self, amount: f64) -> Passed {
        let total = self.fraction + amount;
        let floor = total.floor();
        self.fraction = total - floor;
        let old = self.whole;
        // Saturates; a stretch of 10⁵ s at full scale is 2⁵⁷.
        let new = old.saturating_add(floor as i64);
        if (-HALF..HALF).contains(&old) && (-HALF..HALF).contains(&new) {
            self.whole = new;
            return Passed::default();
        }
        self.whole = (new.saturating_add(END)).rem_euclid(SPAN) - END;
        // Number of the period in which a value lies that is shifted by `offset`.
        let period = |value: i64, offset: i64| value.saturating_sub(offset).div_euclid(SPAN);
        Passed {
            half_up: period(new, HALF) > period(old, HALF),
            half_down: period(new, -HALF) < period(old, -HALF),
            overflow: period(new, -END) != period(old, -END),
        }
    }

    /// Upper 24 bits.
    pub const fn visible(&self) -> i32 {
        (self.whole >> HIDDEN_BITS) as i32
    }

    /// Everything, in units of the visible bits.
    pub fn exact(&self) -> f64 {
        (self.whole as f64 + self.fraction) / (1i64 << HIDDEN_BITS) as f64
    }

    /// Stands at `counts` of the visible bits, sign-extended from 24, and 0 below.
    pub const fn preset(&mut self, counts: i32) {
        self.whole = (counts as i64) << 40 >> 40 << HIDDEN_BITS;
        self.fraction = 0.0;
    }

    pub fn clear(&mut self, hidden_too: bool) {
        if hidden_too {
            *self = Self::default();
        } else {
            self.whole &= (1 << HIDDEN_BITS) - 1;
        }
    }

    /// Distance to the nearest point at which a flag could be set.
    pub fn room(&self) -> f64 {
        [-END, -HALF, HALF, END]
            .into_iter()
            .map(|at| (at - self.whole).abs())
            .min()
            .unwrap_or(0) as f64
    }
}
