//! The CAN bus: the board's controller, virtual nodes, and the wire between them, bit by bit.
//!
//! Every node has its own bit clock and synchronises to the edges it sees (ISO 11898-1), so a wrong bit rate, a short
//! circuit or a single wrong bit has the consequences that it has on a real bus: nothing here says what a fault does.
//! Where nothing can change nothing is computed: an idle bus and a long short circuit cost nothing.
//!
//! Two virtual nodes stand for all others. One sends (what is given to [`CanBus::inject`], and the flood); like every
//! node it counts its errors, and comes back from bus-off by itself. The other only listens and acknowledges.
//!
//! Not modelled: delays of wires and transceivers, tolerances of the clocks.

pub mod bits;
pub mod node;

use std::collections::BTreeMap;

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

use crate::can_frame::CanFrame;
use crate::mcu::bxcan::{BitTiming, Bxcan, Membership};
use crate::mcu::{Clocks, Context, Peripheral, Unmodelled};
use crate::time::Ticks;

use bits::{Bits, DOMINANT, Level, RECESSIVE, arbitration_rank};
use node::{ErrorState, Event, Node};

const BOARD: usize = 0;
const SENDER: usize = 1;
const STATIONS: usize = 3;

/// A frame that went over the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LoggedFrame {
    /// End of its last bit, the seventh of end of frame.
    pub at: Ticks,
    /// Beginning of its start bit.
    pub start: Ticks,
    /// The frame.
    pub frame: CanFrame,
    /// The board sent it.
    pub from_board: bool,
}

/// What can be wrong with the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// Dominant for everybody: CAN_H at the supply, a node that does not let go.
    Dominant,
    /// Recessive for everybody, whoever drives: CAN_H and CAN_L shorted.
    Recessive,
    /// The board's stub is off the bus: it hears itself alone, the others go on without it.
    BoardOpen,
    /// The board is the only node.
    NoOtherNode,
}

/// Where a bit is wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// For all nodes.
    Bus,
    /// For the board's receiver alone.
    Board,
}

/// Disturbances: in a frame, at most one inverted bit, at any place from its start to its end with the same probability.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BitErrors {
    /// That a frame has one, 0 … 1.
    pub probability: f64,
    /// Who sees it.
    pub place: Place,
    /// Of the random numbers.
    pub seed: u64,
}

/// Sums since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Frames that went over the bus.
    pub frames: u64,
    /// Those of them that the board sent.
    pub from_board: u64,
    /// Errors that the board's controller found.
    pub errors_at_board: u64,
    /// Attempts of the board that lost arbitration.
    pub lost_arbitration: u64,
}

/// State of the board's controller.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BoardState {
    /// Transmit error counter.
    pub tec: u16,
    /// Receive error counter.
    pub rec: u16,
    /// What they make of it.
    pub state: ErrorState,
}

#[derive(Clone, Debug)]
struct Station {
    node: Node,
    timing: BitTiming,
    bit_start: u64,
    sampled: bool,
    /// A resynchronisation is done with until the next sample (ISO 11898-1).
    synchronised: bool,
    last_sample: Level,
    drives: Level,
    sees: Level,
    /// Start bit of the frame it is sending.
    started: u64,
}

impl Station {
    const fn new(timing: BitTiming) -> Self {
        Self {
            node: Node::new(),
            timing,
            bit_start: 0,
            sampled: false,
            synchronised: false,
            last_sample: RECESSIVE,
            drives: RECESSIVE,
            sees: RECESSIVE,
            started: 0,
        }
    }

    /// Whether only an edge, or a start of its own, can change it.
    const fn rests(&self) -> bool {
        self.node.rests(self.sees) && matches!(self.drives, RECESSIVE)
    }

    const fn join(&mut self, now: u64) {
        self.node.join();
        self.restart(now);
    }

    const fn leave(&mut self) {
        self.node.leave();
        self.drives = RECESSIVE;
    }

    const fn restart(&mut self, at: u64) {
        self.bit_start = at;
        self.sampled = false;
        self.synchronised = true;
    }

    /// The bit that `at` lies in, after a rest in which the clock ran on unseen.
    const fn catch_up(&mut self, at: u64) {
        if let Some(behind) = at.checked_sub(self.bit_start)
            && behind >= self.timing.bit
        {
            self.bit_start += behind / self.timing.bit * self.timing.bit;
            self.sampled = at > self.bit_start + self.timing.sample;
            self.synchronised = false;
            self.last_sample = self.sees;
        }
    }

    /// The start of its first bit from `at` on.
    const fn bit_from(&self, at: u64) -> u64 {
        match at.checked_sub(self.bit_start) {
            Some(late) => self.bit_start + late.div_ceil(self.timing.bit) * self.timing.bit,
            None => self.bit_start,
        }
    }

    const fn next(&self) -> u64 {
        self.bit_start
            + if self.sampled {
                self.timing.bit
            } else {
                self.timing.sample
            }
    }

    /// A falling edge: shifts the bit by at most the jump width, or starts it anew (ISO 11898-1). True: a bit starts now.
    const fn synchronise(&mut self, at: u64) -> bool {
        if self.node.synchronises_hard() {
            self.restart(at);
            // The node did not start by itself; it goes on as receiver.
            return false;
        }
        if self.synchronised || self.last_sample == DOMINANT || at <= self.bit_start {
            return false;
        }
        self.synchronised = true;
        let BitTiming {
            quantum, bit, jump, ..
        } = self.timing;
        if !self.sampled {
            let late = (at - self.bit_start) / quantum * quantum;
            self.bit_start += if late < jump { late } else { jump };
            return false;
        }
        let early = self.bit_start + bit - at;
        if early <= jump {
            self.restart(at);
            return true;
        }
        self.bit_start -= jump;
        false
    }
}

#[derive(Clone, Debug)]
enum Change {
    Fault(Fault, bool),
    Inverted(Place, bool),
    Flood(Vec<CanFrame>),
    BitErrors(Option<BitErrors>),
    ShortNextFrame(Ticks),
}

/// What the sending virtual node sends.
#[derive(Clone, Debug, Default)]
struct Traffic {
    /// By their earliest start.
    future: BTreeMap<(u64, u64), CanFrame>,
    /// By rank, then as injected.
    due: BTreeMap<(u32, u64), CanFrame>,
    injected: u64,
    flood: Vec<CanFrame>,
    flood_index: usize,
    /// What is being sent; without a key it is the flood's.
    current: Option<(u32, u64)>,
}

impl Traffic {
    fn next_due(&self, now: u64) -> Option<u64> {
        if self.due.is_empty() && self.flood.is_empty() {
            self.future.keys().next().map(|(due, _)| *due)
        } else {
            Some(now)
        }
    }

    fn offer(&mut self, now: u64) -> Option<Bits> {
        while let Some(entry) = self.future.first_entry()
            && entry.key().0 <= now
        {
            let ((_, order), frame) = entry.remove_entry();
            self.due.insert((arbitration_rank(&frame), order), frame);
        }
        let queued = self.due.iter().next().map(|(key, frame)| (*key, *frame));
        let flood = self.flood.get(self.flood_index).copied();
        let (current, frame) = match (queued, flood) {
            (Some((key, frame)), Some(flood)) if key.0 <= arbitration_rank(&flood) => {
                (Some(key), frame)
            }
            (_, Some(flood)) => (None, flood),
            (Some((key, frame)), None) => (Some(key), frame),
            (None, None) => return None,
        };
        self.current = current;
        Some(Bits::new(frame))
    }

    fn sent(&mut self) {
        match self.current.take() {
            Some(key) => {
                self.due.remove(&key);
            }
            None if !self.flood.is_empty() => {
                self.flood_index = (self.flood_index + 1) % self.flood.len();
            }
            None => {}
        }
    }
}

#[derive(Clone, Copy, Debug, Default)]
struct Faults {
    dominant: bool,
    recessive: bool,
    board_open: bool,
    no_other_node: bool,
    inverted: bool,
    inverted_at_board: bool,
}

/// The bus with the board's controller on it: for the MCU, the peripheral CAN1.
#[derive(Clone, Debug)]
pub struct CanBus {
    board: Bxcan,
    clocks: Option<Clocks>,
    stations: [Station; STATIONS],
    now: u64,
    next: Option<u64>,
    changes: BTreeMap<(u64, u64), Change>,
    scheduled: u64,
    faults: Faults,
    traffic: Traffic,
    bit_errors: Option<(BitErrors, ChaCha8Rng)>,
    short_next_frame: Option<Ticks>,
    /// Start of the last frame for which the die was cast.
    cast_at: Option<u64>,
    log: Vec<LoggedFrame>,
    counters: Counters,
    busy: u64,
    busy_since: Option<u64>,
    busy_until: u64,
}

impl CanBus {
    /// A bus whose virtual nodes run at `bit_rate` bit/s with their sample point at 6/7 (85.7 %) and a jump width of
    /// 1/7 of a bit.
    pub fn new(bit_rate: u32) -> Self {
        let quantum = (Ticks::PER_SECOND / u64::from(bit_rate.max(1)) / 14).max(1);
        let timing = BitTiming {
            quantum,
            bit: 14 * quantum,
            sample: 12 * quantum,
            jump: 2 * quantum,
        };
        let mut stations = [const { Station::new(NO_TIMING) }; STATIONS];
        for station in &mut stations {
            station.timing = timing;
        }
        for station in &mut stations[SENDER..] {
            station.node.recovers_by_itself = true;
            station.join(0);
        }
        let mut bus = Self {
            board: Bxcan::new(),
            clocks: None,
            stations,
            now: 0,
            next: None,
            changes: BTreeMap::new(),
            scheduled: 0,
            faults: Faults::default(),
            traffic: Traffic::default(),
            bit_errors: None,
            short_next_frame: None,
            cast_at: None,
            log: Vec::new(),
            counters: Counters::default(),
            busy: 0,
            busy_since: None,
            busy_until: 0,
        };
        bus.update_next();
        bus
    }

    /// A frame for the sending virtual node, to be started at `not_before` at the earliest; of several that are due the
    /// most urgent goes first, as if each came from a node of its own. Times before the present count as the present.
    pub fn inject(&mut self, frame: CanFrame, not_before: Ticks) {
        let order = self.traffic.injected;
        self.traffic.injected += 1;
        let due = not_before.0.max(self.now);
        self.traffic.future.insert((due, order), frame);
        self.update_next();
    }

    /// Frames injected that are not sent yet.
    pub fn waiting(&self) -> usize {
        self.traffic.future.len() + self.traffic.due.len()
    }

    /// Puts a fault on the bus, or takes it off it, at `at`.
    pub fn set_fault(&mut self, fault: Fault, present: bool, at: Ticks) {
        self.schedule(at, Change::Fault(fault, present));
    }

    /// The bus is dominant from `from` for `length`.
    pub fn short(&mut self, from: Ticks, length: Ticks) {
        self.set_fault(Fault::Dominant, true, from);
        self.set_fault(Fault::Dominant, false, from + length);
    }

    /// From `from` on the first frame that the board starts is hit by a dominant short of `length` just after its
    /// arbitration field: the case in which a short drives a sender to bus-off. A node that only listens never goes there.
    pub fn short_in_next_frame(&mut self, from: Ticks, length: Ticks) {
        self.schedule(from, Change::ShortNextFrame(length));
    }

    /// Bit errors from `from` on, or none any more.
    pub fn set_bit_errors(&mut self, errors: Option<BitErrors>, from: Ticks) {
        self.schedule(from, Change::BitErrors(errors));
    }

    /// From `from` to `until` the sending virtual node has always one of `frames` to send, in this order: a load of 100 %.
    pub fn flood(&mut self, frames: Vec<CanFrame>, from: Ticks, until: Ticks) {
        self.schedule(from, Change::Flood(frames));
        self.schedule(until, Change::Flood(Vec::new()));
    }

    fn schedule(&mut self, at: Ticks, change: Change) {
        let order = self.scheduled;
        self.scheduled += 1;
        self.changes.insert((at.0.max(self.now), order), change);
        self.update_next();
    }

    /// Every frame that went over the bus since the last call, by its end.
    pub fn take_log(&mut self) -> Vec<LoggedFrame> {
        std::mem::take(&mut self.log)
    }

    /// Sums since the start.
    pub const fn counters(&self) -> Counters {
        self.counters
    }

    /// Time for which the bus has not been idle: frames, error frames and the intermissions after them.
    pub fn busy(&self) -> Ticks {
        Ticks(
            self.busy
                + self
                    .busy_since
                    .map_or(0, |since| self.now.saturating_sub(since)),
        )
    }

    /// The time up to which the bus is computed.
    pub const fn now(&self) -> Ticks {
        Ticks(self.now)
    }

    /// The error counters of the board's controller.
    pub const fn board_state(&self) -> BoardState {
        let node = &self.stations[BOARD].node;
        BoardState {
            tec: node.tec(),
            rec: node.rec(),
            state: node.error_state(),
        }
    }

    /// Whether the board's controller hears by its RX pin (RM0090, 32.4: in loop back mode it does not).
    pub const fn uses_rx(&self) -> bool {
        self.stations[BOARD].node.is_on() && !self.board.loops_back()
    }

    /// Whether it sends by its TX pin.
    pub const fn uses_tx(&self) -> bool {
        self.stations[BOARD].node.is_on() && !self.board.is_silent()
    }

    fn is_on_bus(&self, index: usize) -> bool {
        if index == BOARD {
            !self.faults.board_open
        } else {
            !self.faults.no_other_node
        }
    }

    /// Computes the bus up to `until`.
    fn run(&mut self, until: u64) {
        while let Some(at) = self.next_instant()
            && at <= until
        {
            self.now = at;
            self.apply_changes();
            for index in 0..STATIONS {
                if self.starts_bit(index) {
                    self.start_bit(index);
                }
            }
            self.settle();
            for index in 0..STATIONS {
                self.sample(index);
            }
            self.account();
        }
        self.now = self.now.max(until);
    }

    /// When something can next change on the bus.
    fn next_instant(&self) -> Option<u64> {
        let change = self.changes.keys().next().map(|(at, _)| *at);
        (0..STATIONS)
            .filter_map(|index| self.next_of(index))
            .chain(change)
            .min()
    }

    fn next_of(&self, index: usize) -> Option<u64> {
        let station = &self.stations[index];
        if !station.rests() {
            return Some(station.next());
        }
        if !station.node.is_idle() {
            return None;
        }
        let due = match index {
            BOARD => self.board.wants_to_send().then_some(self.now)?,
            SENDER => self.traffic.next_due(self.now)?,
            _ => return None,
        };
        // A bit that has begun cannot begin again.
        Some(station.bit_from(due.max(station.bit_start + 1)))
    }

    fn starts_bit(&self, index: usize) -> bool {
        let station = &self.stations[index];
        if station.rests() {
            station.node.is_idle() && self.next_of(index) == Some(self.now)
        } else {
            station.sampled && station.next() == self.now
        }
    }

    fn start_bit(&mut self, index: usize) {
        let now = self.now;
        let station = &mut self.stations[index];
        station.bit_start = now;
        station.sampled = false;
        station.synchronised = false;
        let was_idle = station.node.is_idle();
        let mut offer = || match index {
            BOARD => self.board.offer(),
            SENDER => self.traffic.offer(now),
            _ => None,
        };
        station.drives = station.node.drive(&mut offer);
        if was_idle && station.node.is_sending() {
            station.started = now;
            self.on_start(index);
        }
    }

    /// A frame starts on the bus: is it to be disturbed?
    fn on_start(&mut self, index: usize) {
        let now = self.now;
        let station = &self.stations[index];
        let Some((length, arbitration)) = station
            .node
            .sending()
            .map(|bits| (u64::from(bits.length()), u64::from(bits.arbitration())))
        else {
            return;
        };
        let bit = station.timing.bit;
        if index == BOARD
            && let Some(short) = self.short_next_frame.take()
        {
            self.short(Ticks(now + arbitration * bit), short);
        }
        if self.cast_at == Some(now) {
            return;
        }
        self.cast_at = Some(now);
        if let Some((errors, random)) = &mut self.bit_errors
            && uniform(random) < errors.probability
        {
            let place = errors.place;
            let hit = now + (uniform(random) * length as f64) as u64 * bit;
            self.schedule(Ticks(hit), Change::Inverted(place, true));
            self.schedule(Ticks(hit + bit), Change::Inverted(place, false));
            if hit == now {
                self.apply_changes();
            }
        }
    }

    fn apply_changes(&mut self) {
        while let Some(entry) = self.changes.first_entry()
            && entry.key().0 <= self.now
        {
            match entry.remove() {
                Change::Fault(Fault::Dominant, present) => self.faults.dominant = present,
                Change::Fault(Fault::Recessive, present) => self.faults.recessive = present,
                Change::Fault(Fault::BoardOpen, present) => self.faults.board_open = present,
                Change::Fault(Fault::NoOtherNode, present) => {
                    if present != self.faults.no_other_node {
                        self.faults.no_other_node = present;
                        for station in &mut self.stations[SENDER..] {
                            if present {
                                station.leave();
                            } else {
                                station.join(self.now);
                            }
                        }
                    }
                }
                Change::Inverted(Place::Bus, inverted) => self.faults.inverted = inverted,
                Change::Inverted(Place::Board, inverted) => {
                    self.faults.inverted_at_board = inverted;
                }
                Change::Flood(frames) => {
                    self.traffic.flood = frames;
                    self.traffic.flood_index = 0;
                }
                Change::BitErrors(errors) => {
                    self.bit_errors =
                        errors.map(|errors| (errors, ChaCha8Rng::seed_from_u64(errors.seed)));
                }
                Change::ShortNextFrame(length) => self.short_next_frame = Some(length),
            }
        }
    }

    /// The level that `index` sees.
    fn level_at(&self, index: usize) -> Level {
        let own = self.stations[BOARD].drives;
        let silent = self.board.is_silent();
        if index == BOARD && self.board.loops_back() {
            return own;
        }
        let stub = own || silent;
        let bus = if self.faults.dominant {
            DOMINANT
        } else {
            let others = self.stations[SENDER..]
                .iter()
                .all(|station| station.drives == RECESSIVE);
            self.faults.recessive || (others && (stub || self.faults.board_open))
        };
        let bus = bus != self.faults.inverted;
        if index != BOARD {
            return bus;
        }
        let level = if self.faults.board_open { stub } else { bus };
        // In silent mode it hears itself within the chip.
        (level && (own || !silent)) != self.faults.inverted_at_board
    }

    /// Lets the wire follow its drivers, and the nodes' clocks its edges.
    fn settle(&mut self) {
        let now = self.now;
        // A node that is made to start its next bit by an edge can make another edge; each does so at most once.
        for _ in 0..=STATIONS {
            let mut restarted = false;
            for index in 0..STATIONS {
                let level = self.level_at(index);
                let station = &mut self.stations[index];
                if level == station.sees {
                    continue;
                }
                station.catch_up(now);
                station.sees = level;
                if level == DOMINANT {
                    if index == BOARD && self.board.sleeps() {
                        self.board.wake();
                        self.follow_mode();
                    } else if station.synchronise(now) {
                        self.start_bit(index);
                        restarted = true;
                    }
                }
            }
            if !restarted {
                break;
            }
        }
    }

    fn sample(&mut self, index: usize) {
        let now = self.now;
        let station = &mut self.stations[index];
        if station.sampled
            || !station.node.is_on()
            || station.bit_start + station.timing.sample != now
        {
            return;
        }
        station.sampled = true;
        station.synchronised = false;
        let level = station.sees;
        station.last_sample = level;
        let was_sending = station.node.is_sending();
        let mut offer = || match index {
            BOARD => self.board.offer(),
            SENDER => self.traffic.offer(now),
            _ => None,
        };
        let event = station.node.sample(level, &mut offer);
        if !was_sending && station.node.is_sending() {
            station.started = station.bit_start;
        }
        if let Event::Sent(frame) = event
            && !(index == BOARD && self.board.is_silent())
        {
            let logged = LoggedFrame {
                at: Ticks(station.bit_start + station.timing.bit),
                start: Ticks(station.started),
                frame,
                from_board: index == BOARD,
            };
            self.log_frame(logged);
        }
        match index {
            BOARD => {
                match event {
                    Event::Error { .. } => self.counters.errors_at_board += 1,
                    Event::ArbitrationLost => self.counters.lost_arbitration += 1,
                    _ => {}
                }
                self.board.on_bit(event, level, &self.stations[BOARD].node);
                self.follow_mode();
            }
            SENDER if matches!(event, Event::Sent(_)) => self.traffic.sent(),
            _ => {}
        }
    }

    /// Two nodes that send the same frame at the same time send one frame.
    fn log_frame(&mut self, logged: LoggedFrame) {
        if let Some(last) = self.log.last_mut()
            && (last.start, last.frame) == (logged.start, logged.frame)
            && last.from_board != logged.from_board
        {
            last.from_board = true;
            return;
        }
        self.log.push(logged);
        self.counters.frames += 1;
        self.counters.from_board += u64::from(logged.from_board);
    }

    fn account(&mut self) {
        let mut busy = false;
        let mut end = self.now;
        for index in 0..STATIONS {
            let station = &self.stations[index];
            if self.is_on_bus(index) && station.node.is_on() {
                busy |= station.node.is_busy();
                if station.sampled {
                    end = end.max(station.next());
                }
            }
        }
        match (busy, self.busy_since) {
            (true, None) => self.busy_since = Some(self.now.max(self.busy_until)),
            // The last bit of intermission is over a little later than its sample point.
            (false, Some(since)) => {
                self.busy += end - since.min(end);
                self.busy_until = end;
                self.busy_since = None;
            }
            _ => {}
        }
    }

    /// Lets the board's node join or leave as its mode says.
    fn follow_mode(&mut self) {
        let station = &mut self.stations[BOARD];
        match self.board.update_mode(&station.node) {
            Some(Membership::Join) => {
                if let Some(clocks) = &self.clocks {
                    station.timing = self.board.timing(clocks);
                }
                station.join(self.now);
                // A node that joins with the wire dominant has no edge to wait for.
                self.board.update_mode(&station.node);
            }
            Some(Membership::Leave) => station.leave(),
            None => {}
        }
    }

    fn update_next(&mut self) {
        let board = &self.stations[BOARD];
        let bits = self.board.bits_to_interrupt(&board.node) - 1;
        // Synchronisation can shorten each bit by the jump width.
        let shortest = board.timing.bit - board.timing.jump;
        self.next = self.next_instant().map(|at| at + bits * shortest);
    }

    fn arrive(&mut self, context: &Context<'_>) {
        self.run(context.now.0);
        if self.clocks != Some(context.clocks) {
            self.clocks = Some(context.clocks);
            let station = &mut self.stations[BOARD];
            station.timing = self.board.timing(&context.clocks);
            station.restart(self.now);
        }
    }

    fn depart(&mut self, context: &Context<'_>) {
        self.update_next();
        self.board.drive_interrupts(context.interrupts);
    }
}

const NO_TIMING: BitTiming = BitTiming {
    quantum: 1,
    bit: 14,
    sample: 12,
    jump: 2,
};

/// 0 … 1, without 1.
fn uniform(random: &mut ChaCha8Rng) -> f64 {
    (random.next_u64() >> 11) as f64 / (1_u64 << 53) as f64
}

impl Peripheral for CanBus {
    fn read(
        &mut self,
        offset: u32,
        bytes: u8,
        context: &mut Context<'_>,
    ) -> Result<u32, Unmodelled> {
        self.arrive(context);
        self.depart(context);
        let station = &self.stations[BOARD];
        self.board.read(offset, bytes, &station.node, station.sees)
    }

    fn write(
        &mut self,
        offset: u32,
        bytes: u8,
        value: u32,
        context: &mut Context<'_>,
    ) -> Result<(), Unmodelled> {
        self.arrive(context);
        let result = self
            .board
            .write(offset, bytes, value, &mut self.stations[BOARD].node);
        self.follow_mode();
        // A master reset takes a node off the bus in the middle of a bit.
        if !self.stations[BOARD].node.is_on() {
            self.stations[BOARD].leave();
        }
        self.settle();
        self.depart(context);
        result
    }

    fn next_event(&self) -> Option<Ticks> {
        self.next.map(Ticks)
    }

    fn advance(&mut self, context: &mut Context<'_>) {
        self.arrive(context);
        self.depart(context);
    }

    fn reset(&mut self, context: &mut Context<'_>) {
        self.arrive(context);
        self.board = Bxcan::new();
        self.stations[BOARD] = Station::new(self.board.timing(&context.clocks));
        self.settle();
        self.depart(context);
    }
}

#[cfg(test)]
mod tests;
