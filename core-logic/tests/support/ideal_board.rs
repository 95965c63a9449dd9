//! The board's analogue side without a single imperfection, as a list of events: dual-range sensors that clip at their
//! ends, comparators with hysteresis, switch, the meter's accumulator and the converter. Current is linear between the
//! rows of a profile and every integral is exact, so what differs between its charge and the logic's is the logic's.
//!
//! It is a reference for tests and for the demonstration; floating point belongs here and nowhere in `core-logic`.

// Each user of this file needs another part of it.
#![allow(dead_code)]

use core_logic::design_parameters as design;

/// Counts per second of the meter at full scale on channel 1.
fn counts_per_second() -> f64 {
    design::METER_COUNTS_PER_SECOND_Q32 as f64 / 2f64.powi(32)
}

const NOMINAL_SUPPLY_V: f64 = 5.0;
const SMALL_A: f64 = 60.0;
const LARGE_A: f64 = 600.0;
/// Comparator threshold referred to the conductor and its hysteresis (20 mV at 37.5 mV/A).
const THRESHOLD_A: f64 = 160.0 / 3.0;
const HYSTERESIS_A: f64 = 0.53;

/// A point of the profile.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Row {
    pub t_s: f64,
    pub current_a: f64,
    pub cell_v: f64,
}

/// What the board's hardware hands to its firmware, in order of time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Event {
    /// The range flag changed.
    Edge { at_us: u64, flag_high: bool },
    /// AENERGY was read, 24 bit, sign extended.
    Energy { at_us: u64, counts: i32 },
    /// The firmware's clock: a tick.
    Tick { at_us: u64 },
    /// A conversion that began at `started_us` was read.
    Conversion {
        started_us: u64,
        at_us: u64,
        code: i16,
    },
}

/// When the hardware is read, and how.
#[derive(Clone, Copy, Debug)]
pub struct Timing {
    pub tick_s: f64,
    pub meter_poll_s: f64,
    pub snapshot_latency_s: f64,
    pub conversion_s: f64,
    /// Codes from 0 V to the converter's supply.
    pub codes: f64,
}

impl Default for Timing {
    fn default() -> Self {
        Self {
            tick_s: design::CURRENT_FRAME_MS as f64 * 1e-3,
            meter_poll_s: design::METER_POLL_MS as f64 * 1e-3,
            snapshot_latency_s: 60e-6,
            conversion_s: 1.0 / 32.0,
            codes: 8_192.0, // 14 bit, single ended
        }
    }
}

/// The running board.
pub struct IdealBoard<'a> {
    rows: &'a [Row],
    row: usize,
    timing: Timing,
    t: f64,
    flag_high: bool,
    energy: f64,
    conversion_started: f64,
    /// V·s
    conversion_integral: f64,
    /// What the sensors run from: their outputs, and the level that the meter measures against, are shares of it.
    pub supply_v: f64,
    /// The converter measures against 5 V of its own, instead of against the sensors' supply.
    pub own_reference: bool,
    next_tick: f64,
    next_poll: f64,
    snapshot_at: f64,
    /// ∫ i dt since the start.
    pub charge_c: f64,
    pub edges: u64,
}

impl<'a> IdealBoard<'a> {
    /// A board at rest at the profile's first row. Rows must be in order of time.
    pub fn new(rows: &'a [Row], timing: Timing) -> Self {
        let t = rows[0].t_s;
        Self {
            rows,
            row: 0,
            timing,
            t,
            flag_high: rows[0].current_a.abs() > THRESHOLD_A,
            energy: 0.0,
            conversion_started: t,
            conversion_integral: 0.0,
            supply_v: NOMINAL_SUPPLY_V,
            own_reference: false,
            next_tick: t,
            next_poll: t + timing.meter_poll_s,
            snapshot_at: f64::INFINITY,
            charge_c: 0.0,
            edges: 0,
        }
    }

    /// Seconds of the profile that have passed.
    pub fn elapsed_s(&self) -> f64 {
        self.t - self.rows[0].t_s
    }

    /// The row that began last.
    pub fn row(&self) -> Row {
        self.rows[self.row]
    }

    pub fn flag_high(&self) -> bool {
        self.flag_high
    }

    /// The true current at this moment.
    pub fn current_a(&self) -> f64 {
        self.current_at(self.t)
    }

    fn current_at(&self, t: f64) -> f64 {
        let (a, b) = (
            self.rows[self.row],
            self.rows[(self.row + 1).min(self.rows.len() - 1)],
        );
        if b.t_s <= a.t_s {
            return a.current_a;
        }
        a.current_a + (b.current_a - a.current_a) * (t - a.t_s) / (b.t_s - a.t_s)
    }

    /// The selected sensor's share of its full scale.
    fn share(&self, current: f64) -> f64 {
        let full = if self.flag_high { LARGE_A } else { SMALL_A };
        (current / full).clamp(-1.0, 1.0)
    }

    /// First time in (t, end] at which the linear current reaches ±`level`, given it is not beyond already.
    fn crossing(&self, end: f64, level: f64, outwards: bool) -> Option<f64> {
        let (i0, i1) = (self.current_at(self.t), self.current_at(end));
        let beyond = |i: f64| {
            if outwards {
                i.abs() > level
            } else {
                i.abs() < level
            }
        };
        if beyond(i0) {
            return Some(self.t);
        }
        // Piecewise linear: the way out is monotonic in one sign; the way in may pass zero.
        let mut first = None::<f64>;
        for target in [level, -level] {
            let slope = (i1 - i0) / (end - self.t);
            if slope != 0.0 {
                let at = self.t + (target - i0) / slope;
                let inwards_side = i0 * target > 0.0;
                if at > self.t && at <= end && (outwards || inwards_side) {
                    first = Some(first.map_or(at, |f| f.min(at)));
                }
            }
        }
        first
    }

    /// Moves to `end` within one row and one range, integrating exactly; a sensor that clips within is split.
    fn advance(&mut self, end: f64) {
        if end <= self.t {
            return;
        }
        let (i0, i1) = (self.current_at(self.t), self.current_at(end));
        let dt = end - self.t;
        self.charge_c += 0.5 * (i0 + i1) * dt;
        let full = if self.flag_high { LARGE_A } else { SMALL_A };
        // ∫ clamp(i/full) over a linear current: cut at the clip points.
        let mut cuts = [0.0, 1.0, 1.0, 1.0];
        let mut n = 1;
        for level in [full, -full] {
            if i1 != i0 {
                let x = (level - i0) / (i1 - i0);
                if x > 0.0 && x < 1.0 {
                    cuts[n] = x;
                    n += 1;
                }
            }
        }
        cuts[n] = 1.0;
        cuts[..=n].sort_by(f64::total_cmp);
        let integral: f64 = cuts[..=n]
            .windows(2)
            .map(|w| {
                let (a, b) = (i0 + (i1 - i0) * w[0], i0 + (i1 - i0) * w[1]);
                0.5 * (self.share(a) + self.share(b)) * (w[1] - w[0]) * dt
            })
            .sum();
        let ratio = self.supply_v / NOMINAL_SUPPLY_V;
        self.energy += counts_per_second() * integral * ratio;
        let ratio = if self.own_reference { ratio } else { 1.0 };
        self.conversion_integral += (2.5 * dt + 2.25 * integral) * ratio;
        self.t = end;
    }

    fn us(&self) -> u64 {
        ((self.t - self.rows[0].t_s) * 1e6).round() as u64
    }

    /// The next event, or `None` at the end of the profile.
    pub fn next_event(&mut self) -> Option<Event> {
        loop {
            while self.row + 1 < self.rows.len() && self.rows[self.row + 1].t_s <= self.t {
                self.row += 1;
            }
            if self.row + 1 >= self.rows.len() {
                return None;
            }
            let row_end = self.rows[self.row + 1].t_s;
            let conversion_end = self.conversion_started + self.timing.conversion_s;
            let stop = row_end
                .min(conversion_end)
                .min(self.next_tick)
                .min(self.next_poll)
                .min(self.snapshot_at);
            let edge = if self.flag_high {
                self.crossing(stop, THRESHOLD_A - HYSTERESIS_A, false)
            } else {
                self.crossing(stop, THRESHOLD_A, true)
            };
            if let Some(at) = edge {
                self.advance(at);
                self.flag_high = !self.flag_high;
                self.edges += 1;
                self.snapshot_at = self.t + self.timing.snapshot_latency_s;
                return Some(Event::Edge {
                    at_us: self.us(),
                    flag_high: self.flag_high,
                });
            }
            self.advance(stop);
            if stop == self.next_tick {
                self.next_tick += self.timing.tick_s;
                return Some(Event::Tick { at_us: self.us() });
            }
            if stop == self.snapshot_at || stop == self.next_poll {
                if stop == self.next_poll {
                    self.next_poll += self.timing.meter_poll_s;
                }
                if stop == self.snapshot_at {
                    self.snapshot_at = f64::INFINITY;
                }
                let counts = (self.energy.floor() as i64).rem_euclid(1 << 24) as i32;
                return Some(Event::Energy {
                    at_us: self.us(),
                    counts: (counts << 8) >> 8,
                });
            }
            if stop == conversion_end {
                let volts = self.conversion_integral / self.timing.conversion_s;
                let started_us =
                    ((self.conversion_started - self.rows[0].t_s) * 1e6).round() as u64;
                self.conversion_started = self.t;
                self.conversion_integral = 0.0;
                return Some(Event::Conversion {
                    started_us,
                    at_us: self.us(),
                    code: (volts / 5.0 * self.timing.codes).round() as i16,
                });
            }
        }
    }
}
