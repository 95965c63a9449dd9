//! Nothing lost: for any profile of the current, any polling and any chain of range edges, the reported charge differs
//! from the integral of the current by no more than the ideal-sensor part of the error budget.
//!
//! The meter here is a model of its own: the 49-bit accumulator integrated analytically over pieces of linear current,
//! its upper 24 bits to be read, comparators with hysteresis that switch the range, an edge handler that comes late and
//! is masked in a storm, snapshots that come later still. Sensors are ideal; the crystal is not.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    clippy::cast_precision_loss,
    missing_docs
)]

use core_logic::design_parameters as design;
use core_logic::error_budget::{ProfileSummary, charge_bound};
use core_logic::meter::{MeterChannel, MeterConfig, MeterReading, ReadingOutcome};
use core_logic::range::{EdgeRecorder, Range, RangeHistory};
use core_logic::storm::{StormAction, StormConfig, StormGuard};
use core_logic::units::{Duration, Instant, Microamps};
use proptest::prelude::*;

/// Counts per second at full scale, from the data sheet's quantities.
const COUNTS_PER_SECOND: f64 = 1_677_722.0 * 0.2 * (3_579_545.0 / 4.0) / 33_554_432.0;
const SWITCHING: f64 = 160.0 / 3.0;
/// Intervals at an edge up to this length are chatter to the budget: taken at the switching current, slew · T² / 2 is 20 mC.
const CHATTER_US: u64 = 2_000;

/// A generator for everything random in a case (splitmix64).
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    fn unit(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }

    fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    /// Evenly distributed on a logarithmic scale.
    fn decades(&mut self, low: f64, high: f64) -> f64 {
        (self.between(low.ln(), high.ln())).exp()
    }
}

/// A piece of the profile: from where the current is to `to` A within `seconds`, or held while noise at the
/// comparators toggles the range flag.
#[derive(Clone, Copy, Debug)]
enum Piece {
    Ramp {
        to: f64,
        seconds: f64,
    },
    Chatter {
        hertz: f64,
        duty: f64,
        seconds: f64,
    },
    /// The same of a comparator that is broken, at any current.
    Broken {
        amps: f64,
        hertz: f64,
        duty: f64,
        seconds: f64,
    },
}

/// What the firmware does around the measuring logic.
#[derive(Clone, Copy, Debug)]
struct Timing {
    shortest_poll_s: f64,
    longest_poll_s: f64,
    snapshot_latency_us: f64,
    handler_delay_us: f64,
}

struct Board {
    random: Random,
    timing: Timing,
    hysteresis: f64,
    crystal: f64,
    /// Where sensor and meter end, of the range's full scale: their data sheets promise no more than 1.
    clip: f64,
    // physics
    start_us: f64,
    now_us: f64,
    current: f64,
    range: Range,
    counts: f64,
    charge: f64,
    square: f64,
    below_no_load_s: f64,
    /// How long the flag was high, as the counter that it gates has it.
    high_us: f64,
    // handler and meter task
    recorder: EdgeRecorder,
    guard: StormGuard,
    /// When the pending edge interrupt is served.
    handler_at: Option<f64>,
    snapshot_at: Option<f64>,
    poll_at: f64,
    unmask_at: Option<f64>,
    channel: MeterChannel,
    last_snapshot_us: u64,
    last_edges: u32,
    // what the budget asks for
    edges: u32,
    chatter_us: u64,
    chatter_squares: u64,
    chatter_runs: u32,
    in_run: bool,
    /// Whether a reading has had to wait for the next one, or an edge was missed.
    waited: bool,
}

impl Board {
    fn new(seed: u64, timing: Timing, config: MeterConfig) -> Self {
        let mut random = Random(seed);
        let start_us = random.between(0.0, 1e9).floor();
        let start = Instant::from_ticks(start_us as u64);
        let mut board = Self {
            hysteresis: random.between(0.1, 0.8),
            crystal: 1.0 + random.between(-100e-6, 100e-6),
            clip: random.between(1.0, 1.1),
            start_us,
            now_us: start_us,
            current: 0.0,
            range: Range::Small,
            // Anywhere in the register, so that wraps in both directions come up.
            counts: random.between(-(2f64.powi(23)), 2f64.powi(23)),
            charge: 0.0,
            square: 0.0,
            below_no_load_s: 0.0,
            high_us: 0.0,
            recorder: EdgeRecorder::new(start, false),
            guard: StormGuard::new(),
            handler_at: None,
            snapshot_at: None,
            poll_at: start_us,
            unmask_at: None,
            channel: MeterChannel::new(config),
            last_snapshot_us: start_us as u64,
            last_edges: 0,
            edges: 0,
            chatter_us: 0,
            chatter_squares: 0,
            chatter_runs: 0,
            in_run: false,
            waited: false,
            random,
            timing,
        };
        board.snapshot();
        board.schedule_poll();
        board
    }

    fn schedule_poll(&mut self) {
        let seconds = self
            .random
            .decades(self.timing.shortest_poll_s, self.timing.longest_poll_s);
        self.poll_at = (self.now_us + seconds * 1e6).ceil();
    }

    /// Reads AENERGY at the present instant.
    fn snapshot(&mut self) {
        let at_us = self.now_us.round();
        assert!((at_us - self.now_us).abs() < 1e-6);
        let at = Instant::from_ticks(at_us as u64);
        let energy = (((self.counts.floor() as i64) << 40) >> 40) as i32;
        let history = RangeHistory {
            high: Duration::from_ticks(self.high_us as u64),
            ..self.recorder.history(at)
        };
        let outcome = self
            .channel
            .on_reading(MeterReading { energy, at }, history);
        assert!(
            !matches!(outcome, ReadingOutcome::Rejected(_)),
            "{outcome:?}"
        );
        if outcome == ReadingOutcome::Waits {
            // As the firmware does: the next reading is not left to the poll.
            self.waited = true;
            let soon = self.now_us + self.random.between(1_000.0, 2_000.0).floor();
            self.poll_at = self.poll_at.min(soon);
        }
        self.waited |= history.coalesced != 0;
        let length = at_us as u64 - self.last_snapshot_us;
        let edges = history.edges.wrapping_sub(self.last_edges);
        let short = CHATTER_US;
        let after = history
            .last_edge
            .map_or(u64::MAX, |edge| at.as_ticks() - edge.as_ticks());
        if length <= short && (edges >= 1 || (self.in_run && after <= short)) {
            self.chatter_us += length;
            self.chatter_squares += after * after + length.saturating_sub(after).pow(2);
            self.chatter_runs += u32::from(!self.in_run);
            self.in_run = true;
        } else {
            self.edges += edges;
            self.in_run = false;
        }
        self.last_snapshot_us = at_us as u64;
        self.last_edges = history.edges;
    }

    /// Lets time pass while the current changes at `slope` A/s, without an edge.
    fn pass(&mut self, until_us: f64, slope: f64) {
        let seconds = (until_us - self.now_us) * 1e-6;
        if seconds <= 0.0 {
            return;
        }
        let full_scale = match self.range {
            Range::Small => 60.0,
            Range::Large => 600.0,
        };
        let threshold = full_scale * 50e-6;
        let clip = full_scale * self.clip;
        // Split where the current passes the no-load threshold or the end of the range, either sign.
        let mut cuts = vec![0.0, seconds];
        if slope != 0.0 {
            for level in [-clip, -threshold, threshold, clip] {
                let cut = (level - self.current) / slope;
                if cut > 0.0 && cut < seconds {
                    cuts.push(cut);
                }
            }
        }
        cuts.sort_by(f64::total_cmp);
        for pair in cuts.windows(2) {
            let (from, to) = (pair[0], pair[1]);
            let (a, b) = (self.current + slope * from, self.current + slope * to);
            let charge = 0.5 * (a + b) * (to - from);
            self.charge += charge;
            self.square += (a * a + a * b + b * b) / 3.0 * (to - from);
            if (0.5 * (a + b)).abs() < threshold {
                self.below_no_load_s += to - from;
            } else {
                let end = clip * (to - from);
                self.counts +=
                    charge.clamp(-end, end) / full_scale * COUNTS_PER_SECOND * self.crystal;
            }
        }
        if self.range == Range::Large {
            self.high_us += until_us - self.now_us;
        }
        self.current += slope * seconds;
        self.now_us = until_us;
    }

    /// The flag changes now.
    fn edge(&mut self) {
        self.range = self.range.other();
        if !self.guard.is_masked() && self.handler_at.is_none() {
            let delay = self.random.between(0.0, self.timing.handler_delay_us);
            self.handler_at = Some((self.now_us + delay).ceil());
        }
    }

    fn request_snapshot(&mut self) {
        if self.snapshot_at.is_none() {
            // From the edge itself to the reading, and never before the handler is done.
            let latency = self.random.between(10.0, self.timing.snapshot_latency_us);
            self.snapshot_at = Some((self.now_us + latency - 7.0).floor().max(self.now_us));
        }
    }

    /// Whatever the firmware has to do next, and when.
    fn next_event(&self) -> f64 {
        [self.handler_at, self.snapshot_at, self.unmask_at]
            .into_iter()
            .flatten()
            .fold(self.poll_at, f64::min)
    }

    /// Serves everything that is due now.
    fn serve(&mut self) {
        let now = Instant::from_ticks(self.now_us.round() as u64);
        let flag = self.range == Range::Large;
        let due = |at: Option<f64>| at.is_some_and(|at| at <= self.now_us);
        if due(self.handler_at) {
            self.handler_at = None;
            self.recorder.on_edge(now, flag);
            if self.guard.on_event(&StormConfig::RANGE_EDGE, now) == StormAction::Mask {
                self.recorder.suspend();
                self.unmask_at = Some(self.now_us + f64::from(StormConfig::RANGE_EDGE.hold_off_us));
            }
            self.request_snapshot();
        } else if due(self.unmask_at) {
            self.unmask_at = None;
            assert_eq!(
                self.guard.poll(&StormConfig::RANGE_EDGE, now),
                StormAction::Unmask
            );
            self.recorder.resume(now, flag);
            self.request_snapshot();
        } else if due(self.snapshot_at) {
            self.snapshot_at = None;
            self.snapshot();
        } else if self.poll_at <= self.now_us {
            self.schedule_poll();
            self.snapshot();
        }
    }

    /// Advances to `until_us`, with firmware events on the way, and edges at the comparators if they are not driven
    /// by noise.
    fn advance(&mut self, until_us: f64, slope: f64, comparators: bool) {
        while self.now_us < until_us {
            let event = self.next_event().min(until_us);
            let crossing = if comparators {
                self.crossing(slope)
            } else {
                f64::INFINITY
            };
            if crossing <= event {
                self.pass(crossing, slope);
                self.edge();
            } else {
                self.pass(event, slope);
                while self.next_event() <= self.now_us {
                    self.serve();
                }
            }
        }
    }

    /// When the comparators switch next.
    fn crossing(&self, slope: f64) -> f64 {
        let magnitude_slope = slope * self.current.signum();
        let level = match self.range {
            Range::Small => SWITCHING,
            Range::Large => SWITCHING - self.hysteresis,
        };
        let beyond = match self.range {
            Range::Small => self.current.abs() >= level,
            Range::Large => self.current.abs() <= level,
        };
        if beyond {
            return self.now_us;
        }
        let candidates: &[f64] = match self.range {
            // Either threshold, since the current may pass through zero.
            Range::Small => &[level, -level],
            Range::Large if magnitude_slope < 0.0 => &[level * self.current.signum()],
            Range::Large => &[],
        };
        candidates
            .iter()
            .map(|target| (target - self.current) / slope)
            .filter(|seconds| seconds.is_finite() && *seconds > 0.0)
            .map(|seconds| self.now_us + seconds * 1e6)
            .fold(f64::INFINITY, f64::min)
    }

    fn run(&mut self, piece: Piece) {
        match piece {
            Piece::Ramp { to, seconds } => {
                // No faster than the slew limit that the budget assumes.
                let fastest = f64::from(design::SLEW_LIMIT_AMPS_PER_SECOND);
                let seconds = seconds.max((to - self.current).abs() / fastest).max(1e-5);
                let slope = (to - self.current) / seconds;
                let end = self.now_us + seconds * 1e6;
                self.advance(end, slope, true);
            }
            Piece::Chatter {
                hertz,
                duty,
                seconds,
            } => {
                let sign = if self.random.unit() < 0.5 { -1.0 } else { 1.0 };
                let level = sign * (SWITCHING + self.random.between(-0.7, 0.7));
                let approach =
                    (level - self.current).abs() / f64::from(design::SLEW_LIMIT_AMPS_PER_SECOND);
                self.run(Piece::Ramp {
                    to: level,
                    seconds: approach,
                });
                self.chatter(level, hertz, duty, seconds);
            }
            Piece::Broken {
                amps,
                hertz,
                duty,
                seconds,
            } => {
                self.run(Piece::Ramp {
                    to: amps,
                    seconds: 0.0,
                });
                self.chatter(amps, hertz, duty, seconds);
            }
        }
    }

    fn chatter(&mut self, level: f64, hertz: f64, duty: f64, seconds: f64) {
        let end = self.now_us + seconds * 1e6;
        let mut high = true;
        while self.now_us < end {
            let share = if high { duty } else { 1.0 - duty };
            let stay = share * 1e6 / hertz * self.random.between(0.7, 1.3);
            // The current itself moves a little as well.
            let target = level + self.random.between(-0.3, 0.3);
            let fastest = f64::from(design::SLEW_LIMIT_AMPS_PER_SECOND);
            let slope = ((target - self.current) / (stay * 1e-6)).clamp(-fastest, fastest);
            self.advance(self.now_us + stay, slope, false);
            self.edge();
            high = !high;
        }
    }

    /// Waits until nothing is pending, reads once more, and compares: the error and its bound in C.
    fn finish(&mut self) -> (f64, f64) {
        let end = (self.now_us + 8_000.0).ceil();
        self.advance(end, 0.0, true);
        self.snapshot();
        let report = self.channel.report();
        let error = report.charge_total.get() as f64 * 1e-9 - self.charge;
        let duration_s = (self.now_us - self.start_us) * 1e-6;
        let us = |micros: f64| Duration::from_ticks(micros.ceil() as u64);
        let bound = charge_bound(&ProfileSummary {
            duration: us(duration_s * 1e6),
            // Of no account behind ideal sensors.
            in_large: us(0.0),
            rms_current: Microamps(((self.square / duration_s).sqrt() * 1e6).ceil() as i32),
            edges: self.edges,
            below_no_load: us(self.below_no_load_s * 1e6),
            chatter: Duration::from_ticks(self.chatter_us),
            chatter_runs: self.chatter_runs,
            chatter_squares: self.chatter_squares,
        });
        let ideal = bound.ideal_sensor.get() as f64 * 1e-9;
        // The channel's own bound leaves out only what it cannot know.
        let own = report.uncertainty.get() as f64 * 1e-9
            + self.below_no_load_s * 3e-3
            + 100e-6 * (self.square / duration_s).sqrt() * duration_s;
        assert!(
            error.abs() <= own,
            "error {error} C beyond the reported {own} C: {report:?}"
        );
        if !self.waited {
            assert_eq!(report.hand_overs, self.last_edges);
        }
        (error, ideal)
    }
}

/// Runs a profile; error and bound in C.
fn conserve(seed: u64, timing: Timing, profile: &[Piece]) -> (f64, f64) {
    let mut board = Board::new(seed, timing, MeterConfig::default());
    for piece in profile {
        board.run(*piece);
    }
    board.finish()
}

fn timings() -> impl Strategy<Value = Timing> {
    (
        0.001..0.02_f64,
        0.02..400.0_f64,
        30.0..100.0_f64,
        0.0..4.0_f64,
    )
        .prop_map(
            |(shortest_poll_s, longest_poll_s, snapshot_latency_us, handler_delay_us)| Timing {
                shortest_poll_s,
                longest_poll_s,
                snapshot_latency_us,
                handler_delay_us,
            },
        )
}

/// As the firmware reads: every 20 ms, edges apart.
fn firmware_timings() -> impl Strategy<Value = Timing> {
    (30.0..100.0_f64, 0.0..4.0_f64).prop_map(|(snapshot_latency_us, handler_delay_us)| Timing {
        shortest_poll_s: 0.02,
        longest_poll_s: 0.021,
        snapshot_latency_us,
        handler_delay_us,
    })
}

fn ramp() -> impl Strategy<Value = Piece> {
    let anywhere = -600.0..600.0_f64;
    let near_threshold = prop_oneof![50.0..56.0_f64, -56.0..-50.0_f64];
    let near_zero = -0.01..0.01_f64;
    let to = prop_oneof![anywhere, near_threshold, near_zero, Just(0.0)];
    let seconds = (-3.0..3.0_f64).prop_map(|exponent| 10f64.powf(exponent));
    (to, seconds).prop_map(|(to, seconds)| Piece::Ramp { to, seconds })
}

fn chatter() -> impl Strategy<Value = Piece> {
    (1.0..5.0_f64, 0.1..0.9_f64, 20.0..2_000.0_f64).prop_map(|(exponent, duty, cycles)| {
        let hertz = 10f64.powf(exponent);
        Piece::Chatter {
            hertz,
            duty,
            seconds: cycles / hertz,
        }
    })
}

fn broken() -> impl Strategy<Value = Piece> {
    let amps = prop_oneof![Just(0.0), -110.0..110.0_f64];
    (amps, chatter()).prop_map(|(amps, piece)| match piece {
        Piece::Chatter {
            hertz,
            duty,
            seconds,
        } => Piece::Broken {
            amps,
            hertz,
            duty,
            seconds,
        },
        other => other,
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    /// The budget knows of comparators that chatter at their threshold; of any others the counter itself has to know.
    #[test]
    fn chatter_at_any_current_costs_no_more_than_is_declared(
        seed: u64,
        timing in firmware_timings(),
        profile in prop::collection::vec(prop_oneof![ramp(), broken()], 1..8),
    ) {
        let _ = conserve(seed, timing, &profile);
    }

    #[test]
    fn charge_is_conserved_on_ramps(
        seed: u64,
        timing in timings(),
        profile in prop::collection::vec(ramp(), 1..40),
    ) {
        let (error, bound) = conserve(seed, timing, &profile);
        prop_assert!(error.abs() <= bound, "error {error} C, bound {bound} C");
    }

    #[test]
    fn charge_is_conserved_with_chatter(
        seed: u64,
        timing in timings(),
        profile in prop::collection::vec(prop_oneof![ramp(), chatter()], 1..8),
    ) {
        let (error, bound) = conserve(seed, timing, &profile);
        prop_assert!(error.abs() <= bound, "error {error} C, bound {bound} C");
    }
}

/// A triangle that crosses the threshold `crossings` times, of a sign of its own.
fn crossings(random: &mut Random, crossings: u32) -> Vec<Piece> {
    let sign = if random.unit() < 0.5 { -1.0 } else { 1.0 };
    (0..crossings)
        .map(|index| {
            let to = if index % 2 == 0 {
                random.between(54.0, 90.0)
            } else {
                random.between(0.0, 52.0)
            };
            Piece::Ramp {
                to: sign * to,
                seconds: random.between(0.01, 0.2),
            }
        })
        .collect()
}

/// A thousand crossings, the firmware's timing, forty times: the bound holds; the scatter is that of the hidden bits
/// alone; and there is no bias, which every uncorrected latency would be.
#[test]
fn a_thousand_crossings_lose_no_more_than_the_bound_and_nothing_on_average() {
    const RUNS: u32 = 40;
    let (mut sum, mut squares, mut worst_ratio, mut worst) = (0.0, 0.0, 0.0_f64, 0.0_f64);
    for seed in 0..u64::from(RUNS) {
        let timing = Timing {
            shortest_poll_s: 0.02,
            longest_poll_s: 0.021,
            snapshot_latency_us: 100.0,
            handler_delay_us: 0.0,
        };
        let profile = crossings(&mut Random(seed ^ 0xABCD), 1_000);
        let (error, bound) = conserve(seed, timing, &profile);
        assert!(error.abs() <= bound, "{error} C beyond {bound} C");
        // The same in either direction of the current: errors of discharge and charge do not cancel each other here.
        let sign = profile
            .iter()
            .map(|piece| match piece {
                Piece::Ramp { to, .. } => *to,
                Piece::Chatter { .. } | Piece::Broken { .. } => 0.0,
            })
            .sum::<f64>()
            .signum();
        sum += error * sign;
        squares += error * error;
        worst = worst.max(error.abs());
        worst_ratio = worst_ratio.max(error.abs() / bound);
    }
    let runs = f64::from(RUNS);
    let (mean, rms) = (sum / runs, (squares / runs).sqrt());
    println!(
        "1000 crossings: worst {worst:.3} C, {worst_ratio:.4} of the bound; mean {mean:.3} C, rms {rms:.3} C"
    );
    // The hidden bits: 60.3 mC / √12 a crossing, as if independent.
    let hidden = 60.33e-3 / 12f64.sqrt() * 1_000f64.sqrt();
    assert!(rms < 2.0 * hidden, "rms {rms} C, hidden bits {hidden} C");
    assert!(mean.abs() < 0.5, "biased by {mean} C");
}

/// Few edges, the worst of many runs: the bound is not far above what happens.
#[test]
fn the_bound_is_no_slacker_than_needed() {
    let worst = |count: u32, runs: u64| {
        (0..runs)
            .map(|seed| {
                let timing = Timing {
                    shortest_poll_s: 0.001,
                    longest_poll_s: 1.0,
                    snapshot_latency_us: 100.0,
                    handler_delay_us: 4.0,
                };
                let profile = crossings(&mut Random(seed ^ 0x1234), count);
                let (error, bound) = conserve(seed, timing, &profile);
                assert!(error.abs() <= bound, "{error} C beyond {bound} C");
                error.abs() / bound
            })
            .fold(0.0, f64::max)
    };
    for (count, runs, least) in [(1, 300, 0.4), (2, 300, 0.4), (10, 100, 0.15)] {
        let ratio = worst(count, runs);
        println!("{count} crossings: worst error {ratio:.3} of the bound in {runs} runs");
        assert!(ratio >= least, "{ratio} with {count} crossings");
    }
}

/// Chatter at each frequency for ten seconds or 20,000 cycles: error per edge and per second.
#[test]
fn chatter_of_any_frequency_stays_within_the_bound() {
    for hertz in [10.0, 100.0, 1e3, 3e3, 1e4, 3e4, 1e5_f64] {
        let mut worst = (0.0_f64, 0.0_f64);
        for seed in 0..4 {
            let timing = Timing {
                shortest_poll_s: 0.02,
                longest_poll_s: 0.021,
                snapshot_latency_us: 100.0,
                handler_delay_us: 4.0,
            };
            let duty = 0.2 + 0.2 * seed as f64;
            let seconds = (10.0_f64).min(20_000.0 / hertz);
            let profile = [
                Piece::Ramp {
                    to: 30.0,
                    seconds: 1.0,
                },
                Piece::Chatter {
                    hertz,
                    duty,
                    seconds,
                },
            ];
            let (error, bound) = conserve(seed, timing, &profile);
            assert!(
                error.abs() <= bound,
                "{hertz} Hz: {error} C beyond {bound} C"
            );
            let ratio = error.abs() / bound;
            if ratio > worst.0 {
                worst = (ratio, error / (seconds * SWITCHING));
            }
        }
        println!(
            "chatter at {hertz} Hz: worst error {:.3} of the bound, {:.2} % of the charge",
            worst.0,
            worst.1 * 100.0
        );
    }
}

/// The grid of a comparator that is broken: the error itself is small, and what is declared is not out of proportion.
#[test]
fn chatter_of_a_broken_comparator_is_counted_wherever_the_current_is() {
    for hertz in [10.0, 100.0, 300.0, 1e3, 1e4, 1e5_f64] {
        let (mut worst, mut most) = (0.0_f64, 0.0_f64);
        for amps in [0.0, 5.0, -5.0, 30.0, -30.0, 53.0, -53.0, 100.0, -100.0] {
            for duty in [0.1, 0.3, 0.5, 0.7, 0.9] {
                let timing = Timing {
                    shortest_poll_s: 0.02,
                    longest_poll_s: 0.021,
                    snapshot_latency_us: 100.0,
                    handler_delay_us: 4.0,
                };
                let profile = [Piece::Broken {
                    amps,
                    hertz,
                    duty,
                    seconds: 1.5,
                }];
                let mut board = Board::new(7, timing, MeterConfig::default());
                for piece in profile {
                    board.run(piece);
                }
                let (error, _) = board.finish();
                let declared = board.channel.report().uncertainty.get() as f64 * 1e-9;
                // Beyond the small sensor's end what it does not show is missing, and declared.
                if amps.abs() < 60.0 {
                    worst = worst.max(error.abs());
                    most = most.max(declared);
                }
            }
        }
        println!("{hertz} Hz for 1.5 s: error at most {worst:.3} C, declared at most {most:.2} C");
        assert!(
            worst < 4.0 && most < 25.0,
            "{hertz} Hz: {worst} C, {most} C"
        );
    }
}

/// Full scale and a reading every 300 to 400 s: the register wraps between every few of them, in both directions.
#[test]
fn polling_as_rarely_as_every_400_seconds_is_exact() {
    for seed in 0..20 {
        let timing = Timing {
            shortest_poll_s: 300.0,
            longest_poll_s: 400.0,
            snapshot_latency_us: 100.0,
            handler_delay_us: 0.0,
        };
        let sign = if seed % 2 == 0 { 1.0 } else { -1.0 };
        // Wraps the register every 15 minutes.
        let profile = [
            Piece::Ramp {
                to: 590.0 * sign,
                seconds: 1.0,
            },
            Piece::Ramp {
                to: 595.0 * sign,
                seconds: 20_000.0,
            },
        ];
        let (error, bound) = conserve(seed, timing, &profile);
        // One crossing and the crystal: 100 ppm of 12 MC is most of the bound.
        assert!(error.abs() <= bound, "{error} C beyond {bound} C");
    }
}
