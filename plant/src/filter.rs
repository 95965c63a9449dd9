//! Low-pass filters, exact for an input that is a straight line within the step, however long the step is.
//!
//! A filter's output is a curve. It is handed on as the line with the curve's mean and the curve's end: whoever
//! integrates it gets the exact integral, whoever samples it at the end of a step the exact value. Its `start` is the
//! curve's own to second order in step length over time constant.

use std::f64::consts::TAU;

use serde::{Deserialize, Serialize};

use crate::stretch::Linear;

/// Steps shorter than this share of a time constant are taken with a constant input: what that leaves out, the square
/// of it, is below the rounding of an `f64`.
const SHORT_STEP: f64 = 1e-6;
/// A step that differs from the last one by less than this share of a time constant uses its coefficients: times are
/// absolute, so the difference of two of them is never the same number twice.
const SAME_STEP: f64 = 1e-8;

/// The line with this mean and this end.
pub(crate) const fn line_with_mean(mean: f64, end: f64) -> Linear {
    Linear {
        start: 2.0 * mean - end,
        end,
    }
}

/// A first-order low-pass. The state is its output.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FirstOrder {
    tau_s: f64,
    step_s: f64,
    /// 1 − exp(−dt/τ).
    approach: f64,
    /// Share of the input's change within the step that has arrived at its end.
    follow: f64,
}

impl FirstOrder {
    /// A low-pass with time constant `tau_s` in s; 0 or less is none.
    pub const fn new(tau_s: f64) -> Self {
        Self {
            tau_s,
            step_s: 0.0,
            approach: 0.0,
            follow: 0.0,
        }
    }

    /// Whether it does anything.
    pub const fn is_on(&self) -> bool {
        self.tau_s > 0.0
    }

    /// The output `dt_s` after it was `output`: the new output, and the line that stands for it.
    pub fn step(&mut self, dt_s: f64, output: f64, input: Linear) -> (f64, Linear) {
        if !self.is_on() {
            return (input.end, input);
        }
        if dt_s <= 0.0 {
            return (output, Linear::constant(output));
        }
        let x = dt_s / self.tau_s;
        if (dt_s - self.step_s).abs() > SAME_STEP * self.tau_s {
            self.step_s = dt_s;
            self.approach = -(-x).exp_m1();
            self.follow = 1.0 - self.approach / x;
        }
        let end = output
            + (input.start - output) * self.approach
            + (input.end - input.start) * self.follow;
        // τ·y' = u − y, integrated over the step.
        let line = if x < SHORT_STEP {
            Linear { start: output, end }
        } else {
            line_with_mean(input.mean() - (end - output) / x, end)
        };
        (end, line)
    }
}

/// A second-order low-pass with unity gain at DC.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SecondOrder {
    /// Natural frequency, in Hz.
    pub f0_hz: f64,
    /// Quality factor; 1/√2 is Butterworth.
    pub q: f64,
}

impl SecondOrder {
    /// The unity-gain Sallen-Key low-pass of D1: `r1` from the input, `r2` to the amplifier's + input, `c1` from between
    /// them to the output, `c2` from the + input to ground. Ideal amplifier: f₀ = 1 / (2π·√(R₁R₂C₁C₂)),
    /// Q = √(R₁R₂C₁C₂) / (C₂·(R₁ + R₂)) (Sallen and Key, 1955).
    pub fn sallen_key(r1_ohm: f64, r2_ohm: f64, c1_f: f64, c2_f: f64) -> Self {
        let root_s = (r1_ohm * r2_ohm * c1_f * c2_f).sqrt();
        Self {
            f0_hz: 1.0 / (TAU * root_s),
            q: root_s / (c2_f * (r1_ohm + r2_ohm)),
        }
    }
}

/// A conditioning filter: D1's second-order low-pass followed by an RC, or either, or (nominal) neither. D2's RC with
/// its follower is the RC alone.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LowPassConfig {
    /// The active part.
    pub second_order: Option<SecondOrder>,
    /// Time constant of the RC behind it, in s; 0 is none.
    pub rc_tau_s: f64,
}

/// Output of the active part, its slope over ω₀, output of the RC.
pub type LowPassState = [f64; 3];

/// A [`LowPassConfig`] with its coefficients for the last step length. Several filters with the same parts share one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LowPass {
    kind: Kind,
    step_s: f64,
    transition: [[f64; 3]; 3],
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    Off,
    Rc(FirstOrder),
    Active {
        omega_per_s: f64,
        /// Delay of a ramp in the active part: 1 / (Q·ω₀).
        delay_s: f64,
        rc_tau_s: f64,
        shortest_s: f64,
    },
}

impl LowPass {
    /// The filter of `config`.
    pub fn new(config: &LowPassConfig) -> Self {
        let kind = match config.second_order {
            Some(SecondOrder { f0_hz, q }) if f0_hz > 0.0 && q > 0.0 => {
                let omega_per_s = TAU * f0_hz;
                let delay_s = 1.0 / (q * omega_per_s);
                let rc_tau_s = config.rc_tau_s.max(0.0);
                let mut shortest_s = delay_s.min(1.0 / omega_per_s);
                if rc_tau_s > 0.0 {
                    shortest_s = shortest_s.min(rc_tau_s);
                }
                Kind::Active {
                    omega_per_s,
                    delay_s,
                    rc_tau_s,
                    shortest_s,
                }
            }
            _ if config.rc_tau_s > 0.0 => Kind::Rc(FirstOrder::new(config.rc_tau_s)),
            _ => Kind::Off,
        };
        Self {
            kind,
            step_s: 0.0,
            transition: IDENTITY,
        }
    }

    /// Whether it does anything.
    pub const fn is_on(&self) -> bool {
        !matches!(self.kind, Kind::Off)
    }

    /// How much a ramp comes out late, in s. That is also what a step of the input costs in its integral.
    pub fn delay_s(&self) -> f64 {
        match self.kind {
            Kind::Off => 0.0,
            Kind::Rc(rc) => rc.tau_s,
            Kind::Active {
                delay_s, rc_tau_s, ..
            } => delay_s + rc_tau_s,
        }
    }

    /// The state after `input_v` has been there for long.
    pub const fn settled(input_v: f64) -> LowPassState {
        [input_v, 0.0, input_v]
    }

    /// The output of a state.
    pub const fn output(&self, state: &LowPassState) -> f64 {
        match self.kind {
            Kind::Active { rc_tau_s: 0.0, .. } => state[0],
            _ => state[2],
        }
    }

    /// The state `dt_s` later, and the line that stands for the output meanwhile.
    pub fn step(
        &mut self,
        dt_s: f64,
        state: &LowPassState,
        input: Linear,
    ) -> (LowPassState, Linear) {
        let (omega_per_s, delay_s, rc_tau_s, shortest_s) = match &mut self.kind {
            Kind::Off => return (Self::settled(input.end), input),
            Kind::Rc(rc) => {
                let (end, line) = rc.step(dt_s, state[2], input);
                return ([end, 0.0, end], line);
            }
            Kind::Active {
                omega_per_s,
                delay_s,
                rc_tau_s,
                shortest_s,
            } => (*omega_per_s, *delay_s, *rc_tau_s, *shortest_s),
        };
        if dt_s <= 0.0 {
            return (*state, Linear::constant(self.output(state)));
        }
        if (dt_s - self.step_s).abs() > SAME_STEP * shortest_s {
            self.step_s = dt_s;
            self.transition = transition(omega_per_s, delay_s, rc_tau_s, dt_s);
        }
        let short = dt_s < SHORT_STEP * shortest_s;
        let input_line = if short {
            Linear::constant(input.mean())
        } else {
            input
        };
        // A ramp comes out as a ramp, late; the distance from it dies away by itself.
        let slope = (input_line.end - input_line.start) / dt_s;
        let settled_at = |u: f64| {
            [
                u - slope * delay_s,
                slope / omega_per_s,
                u - slope * (delay_s + rc_tau_s),
            ]
        };
        let (from, to) = (settled_at(input_line.start), settled_at(input_line.end));
        let distance: [f64; 3] = std::array::from_fn(|i| state[i] - from[i]);
        let new: LowPassState = std::array::from_fn(|i| {
            to[i]
                + self.transition[i][0] * distance[0]
                + self.transition[i][1] * distance[1]
                + self.transition[i][2] * distance[2]
        });
        let end = self.output(&new);
        let line = if short {
            Linear {
                start: self.output(state),
                end,
            }
        } else {
            // Both differential equations, integrated over the step.
            let late = (new[0] - state[0]) * delay_s
                + (new[1] - state[1]) / omega_per_s
                + (new[2] - state[2]) * rc_tau_s;
            line_with_mean(input.mean() - late / dt_s, end)
        };
        (new, line)
    }
}

type Matrix = [[f64; 3]; 3];
const IDENTITY: Matrix = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

fn product(a: &Matrix, b: &Matrix) -> Matrix {
    std::array::from_fn(|i| {
        std::array::from_fn(|j| a[i][0] * b[0][j] + a[i][1] * b[1][j] + a[i][2] * b[2][j])
    })
}

/// exp(A·t) of active part and RC by scaling and squaring (Moler and Van Loan, SIAM Review 45 (2003), method 3): no
/// special case for coinciding poles.
fn transition(omega_per_s: f64, delay_s: f64, rc_tau_s: f64, dt_s: f64) -> Matrix {
    let damping_per_s = omega_per_s * omega_per_s * delay_s;
    let rc_per_s = if rc_tau_s > 0.0 { 1.0 / rc_tau_s } else { 0.0 };
    let norm = dt_s * (omega_per_s + damping_per_s).max(2.0 * rc_per_s);
    // Thirteen terms at a norm of a half: 0.5¹³/13! is 2·10⁻¹⁴.
    let mut squarings = 0_u32;
    let mut scale = dt_s;
    let mut scaled_norm = norm;
    while scaled_norm > 0.5 && squarings < 64 {
        scaled_norm *= 0.5;
        scale *= 0.5;
        squarings += 1;
    }
    let a: Matrix = [
        [0.0, omega_per_s * scale, 0.0],
        [-omega_per_s * scale, -damping_per_s * scale, 0.0],
        [rc_per_s * scale, 0.0, -rc_per_s * scale],
    ];
    let mut sum = IDENTITY;
    for k in (1..13).rev() {
        // Horner: I + A/k·(…).
        let mut next = product(&a, &sum);
        for (i, row) in next.iter_mut().enumerate() {
            for (j, entry) in row.iter_mut().enumerate() {
                *entry = *entry / f64::from(k) + IDENTITY[i][j];
            }
        }
        sum = next;
    }
    for _ in 0..squarings {
        sum = product(&sum, &sum);
    }
    sum
}
