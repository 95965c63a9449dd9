//! The protocol controller of a CAN node, bit by bit (ISO 11898-1): sending, receiving, error frames and fault
//! confinement. The board's controller and the virtual nodes are the same.
//!
//! Rule numbers are those of the fault confinement rules in the CAN specification 2.0, which ISO 11898-1 took over.

use crate::can_frame::CanFrame;

use super::bits::{Bits, DOMINANT, Level, Meaning, Place, RECESSIVE, Reception};

/// Recessive bits that a node waits for before it takes part, and of which 128 lots end bus-off.
const SYNCHRONISING_BITS: u8 = 11;
/// Lots of eleven recessive bits that end bus-off (rule 12).
const RECOVERY_LOTS: u8 = 128;
/// Dominant bits of an active error flag and of an overload flag.
const FLAG_BITS: u8 = 6;
/// Recessive bits of the delimiter of an error or overload frame.
const DELIMITER_BITS: u8 = 8;
/// Recessive bits between frames.
const INTERMISSION_BITS: u8 = 3;
/// Recessive bits that an error passive sender waits in addition.
const SUSPEND_BITS: u8 = 8;
/// Counters from here on: error passive.
const PASSIVE_FROM: u16 = 128;
/// Transmit error counter from here on: bus-off.
const BUS_OFF_FROM: u16 = 256;
/// The receive error counter has eight bits (RM0090, CAN_ESR).
const REC_MAX: u16 = 255;

/// Last error code, with its value in CAN_ESR (RM0090).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ErrorCode {
    /// Six equal bits.
    Stuff = 1,
    /// A dominant bit in a field that is recessive.
    Form = 2,
    /// Nobody acknowledged.
    Acknowledgment = 3,
    /// Recessive sent, dominant read.
    BitRecessive = 4,
    /// Dominant sent, recessive read.
    BitDominant = 5,
    /// Wrong CRC sequence.
    Crc = 6,
}

/// What a bit brought for the owner of the node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event {
    /// Nothing.
    None,
    /// A frame from another node is valid.
    Received(CanFrame),
    /// The frame is sent.
    Sent(CanFrame),
    /// Another node won; this one goes on as receiver.
    ArbitrationLost,
    /// An error was found.
    Error {
        /// Which.
        code: ErrorCode,
        /// It ended an attempt of this node to send.
        while_sending: bool,
    },
}

/// Error states of ISO 11898-1.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ErrorState {
    /// Both counters below 128.
    Active,
    /// One of them from 128 on.
    Passive,
    /// Transmit error counter above 255.
    BusOff,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Flag {
    Active,
    Passive,
    Overload,
}

#[derive(Clone, Copy, Debug)]
enum State {
    /// Not on the bus.
    Off,
    /// Waits for eleven recessive bits in a row.
    Integrating { run: u8 },
    /// Waits for 128 times eleven; `recovering` false: has not been asked to.
    BusOff { recovering: bool, run: u8, lots: u8 },
    /// May start a frame.
    Idle,
    /// Within a frame.
    Frame,
    /// Sends a flag; `run` bits of it are done (of a passive one: that many equal ones).
    Flag { kind: Flag, run: u8, last: Level },
    /// After its flag, waits for the others to end theirs; dominant bits since.
    AfterFlag { kind: Flag, dominant: u32 },
    /// Recessive bits of the delimiter so far.
    Delimiter { bits: u8 },
    /// Recessive bits of intermission so far.
    Intermission { bits: u8 },
    /// Recessive bits of suspend transmission so far.
    Suspend { bits: u8 },
}

/// Gives the frame that a node wants to send next.
pub type Offer<'a> = &'a mut dyn FnMut() -> Option<Bits>;

/// A protocol controller.
#[derive(Clone, Debug)]
pub struct Node {
    state: State,
    /// Transmit and receive error counter.
    tec: u16,
    rec: u16,
    reception: Reception,
    sending: Option<Bits>,
    /// Next bit of `sending`.
    index: u16,
    /// What it drives in the present bit.
    driven: Level,
    /// Sender of the present or last frame: decides which counter takes an error after it.
    transmitter: bool,
    /// Exception 1 of rule 3: an error passive sender without acknowledge, as long as its flag is undisturbed.
    unacknowledged: bool,
    /// Leaves bus-off without being asked.
    pub recovers_by_itself: bool,
    /// Takes a missing acknowledge for one (RM0090, loop back mode).
    pub needs_no_acknowledge: bool,
}

impl Node {
    /// A node that is not on the bus.
    pub const fn new() -> Self {
        Self {
            state: State::Off,
            tec: 0,
            rec: 0,
            reception: Reception::new(),
            sending: None,
            index: 0,
            driven: RECESSIVE,
            transmitter: false,
            unacknowledged: false,
            recovers_by_itself: false,
            needs_no_acknowledge: false,
        }
    }

    /// Joins the bus: after eleven recessive bits, or 128 times eleven if it had gone bus-off.
    pub const fn join(&mut self) {
        self.state = if self.tec >= BUS_OFF_FROM {
            State::BusOff {
                recovering: true,
                run: 0,
                lots: 0,
            }
        } else {
            State::Integrating { run: 0 }
        };
        self.leave_frame();
    }

    /// Leaves the bus at once. The error counters stay.
    pub const fn leave(&mut self) {
        self.state = State::Off;
        self.leave_frame();
    }

    const fn leave_frame(&mut self) {
        self.sending = None;
        self.driven = RECESSIVE;
        self.transmitter = false;
        self.unacknowledged = false;
    }

    /// Starts the recovery from bus-off if that is where it waits.
    pub const fn recover(&mut self) {
        if let State::BusOff { recovering, .. } = &mut self.state {
            *recovering = true;
        }
    }

    /// Transmit error counter, more than 255 in bus-off.
    pub const fn tec(&self) -> u16 {
        self.tec
    }

    /// Receive error counter, 0 … 255.
    pub const fn rec(&self) -> u16 {
        self.rec
    }

    /// Error state by the counters (rules 9 to 11).
    pub const fn error_state(&self) -> ErrorState {
        if self.tec >= BUS_OFF_FROM {
            ErrorState::BusOff
        } else if self.tec >= PASSIVE_FROM || self.rec >= PASSIVE_FROM {
            ErrorState::Passive
        } else {
            ErrorState::Active
        }
    }

    /// Whether it takes part, or waits to.
    pub const fn is_on(&self) -> bool {
        !matches!(self.state, State::Off)
    }

    /// Whether it has seen eleven recessive bits since it joined.
    pub const fn is_synchronised(&self) -> bool {
        match self.state {
            State::Off | State::Integrating { .. } => false,
            State::BusOff {
                recovering, lots, ..
            } => !recovering || lots > 0,
            _ => true,
        }
    }

    /// Whether it is within a frame, an error frame or intermission: what is not to be broken off.
    pub const fn is_busy(&self) -> bool {
        matches!(
            self.state,
            State::Frame
                | State::Flag { .. }
                | State::AfterFlag { .. }
                | State::Delimiter { .. }
                | State::Intermission { .. }
        )
    }

    /// Whether it may start a frame at its next bit.
    pub const fn is_idle(&self) -> bool {
        matches!(self.state, State::Idle)
    }

    /// Whether it is sending a frame.
    pub const fn is_sending(&self) -> bool {
        self.sending.is_some()
    }

    /// Whether it is receiving one.
    pub const fn is_receiving(&self) -> bool {
        matches!(self.state, State::Frame) && self.sending.is_none()
    }

    /// The frame that it is sending.
    pub const fn sending(&self) -> Option<&Bits> {
        self.sending.as_ref()
    }

    /// Whether nothing changes in it as long as the wire stays at `level`, but by a start of its own.
    pub const fn rests(&self, level: Level) -> bool {
        match (self.state, level) {
            (
                State::Off
                | State::BusOff {
                    recovering: false, ..
                },
                _,
            ) => true,
            (State::Idle, RECESSIVE) => true,
            (State::BusOff { run, .. } | State::Integrating { run }, DOMINANT) => run == 0,
            // Where nothing is left to count: the dominant bits since the flag matter to a counter at its end no more.
            (State::AfterFlag { .. }, DOMINANT) => !self.transmitter && self.rec == REC_MAX,
            _ => false,
        }
    }

    /// Whether a falling edge starts its bit anew (hard synchronisation) instead of shifting it.
    pub const fn synchronises_hard(&self) -> bool {
        match self.state {
            State::Idle
            | State::Suspend { .. }
            | State::Integrating { .. }
            | State::BusOff { .. } => true,
            // From its second bit on.
            State::Intermission { bits } => bits > 0,
            _ => false,
        }
    }

    /// A lower bound of the bits until something happens that is not an error.
    pub fn bits_to_next(&self) -> u64 {
        match self.state {
            State::Frame => self.reception.bits_left(),
            // The shortest frame has 44 bits; the last does not matter.
            _ => 43,
        }
    }

    /// A bit starts: what it drives. `offer` is asked if it may start a frame.
    pub fn drive(&mut self, offer: Offer<'_>) -> Level {
        self.driven = match self.state {
            State::Idle => match offer() {
                Some(bits) => {
                    self.begin(Some(bits));
                    DOMINANT
                }
                None => RECESSIVE,
            },
            State::Frame => match &self.sending {
                Some(bits) => bits.level(self.index),
                None => {
                    !(self.reception.place() == Place::AckSlot && self.reception.crc_is_right())
                }
            },
            State::Flag {
                kind: Flag::Active | Flag::Overload,
                ..
            } => DOMINANT,
            _ => RECESSIVE,
        };
        self.driven
    }

    const fn begin(&mut self, sending: Option<Bits>) {
        self.state = State::Frame;
        self.reception = Reception::new();
        self.transmitter = sending.is_some();
        self.sending = sending;
        self.index = 0;
    }

    /// The sample point of a bit. `offer` is asked if another node has just started a frame and this one may join.
    pub fn sample(&mut self, level: Level, offer: Offer<'_>) -> Event {
        match self.state {
            State::Off => Event::None,
            State::Integrating { run } => {
                self.state = match level {
                    DOMINANT => State::Integrating { run: 0 },
                    _ if run + 1 == SYNCHRONISING_BITS => State::Idle,
                    _ => State::Integrating { run: run + 1 },
                };
                Event::None
            }
            State::BusOff {
                recovering,
                run,
                lots,
            } => {
                self.sample_bus_off(level, recovering, run, lots);
                Event::None
            }
            State::Idle => self.sample_idle(level, offer),
            State::Frame => self.sample_frame(level),
            State::Flag { kind, run, last } => self.sample_flag(level, kind, run, last),
            State::AfterFlag { kind, dominant } => self.sample_after_flag(level, kind, dominant),
            State::Delimiter { bits } => self.sample_delimiter(level, bits),
            State::Intermission { bits } => match level {
                DOMINANT if bits + 1 < INTERMISSION_BITS => self.overload(),
                // Dominant in the third bit is a start of frame.
                DOMINANT if self.transmitter && self.is_passive() => {
                    self.sample_idle(level, &mut || None)
                }
                DOMINANT => self.sample_idle(level, offer),
                _ => {
                    self.state = match bits + 1 {
                        INTERMISSION_BITS if self.transmitter && self.is_passive() => {
                            State::Suspend { bits: 0 }
                        }
                        INTERMISSION_BITS => State::Idle,
                        bits => State::Intermission { bits },
                    };
                    Event::None
                }
            },
            State::Suspend { bits } => {
                if level == DOMINANT {
                    return self.sample_idle(level, &mut || None);
                }
                self.state = match bits + 1 {
                    SUSPEND_BITS => State::Idle,
                    bits => State::Suspend { bits },
                };
                Event::None
            }
        }
    }

    /// Rule 12.
    const fn sample_bus_off(&mut self, level: Level, recovering: bool, run: u8, lots: u8) {
        if !recovering {
            return;
        }
        let (mut run, mut lots) = match level {
            DOMINANT => (0, lots),
            _ => (run + 1, lots),
        };
        if run == SYNCHRONISING_BITS {
            run = 0;
            lots += 1;
        }
        self.state = if lots == RECOVERY_LOTS {
            self.tec = 0;
            self.rec = 0;
            State::Idle
        } else {
            State::BusOff {
                recovering,
                run,
                lots,
            }
        };
    }

    fn sample_idle(&mut self, level: Level, offer: Offer<'_>) -> Event {
        if level == DOMINANT {
            // The start bit of another node serves for a frame of this one, too.
            let bits = offer();
            self.begin(bits);
            self.index = 1;
            self.reception.accept(level);
        }
        Event::None
    }

    fn sample_frame(&mut self, level: Level) -> Event {
        let place = self.reception.place();
        let mut event = Event::None;
        if let Some(bits) = &self.sending {
            let index = self.index;
            self.index += 1;
            match (self.driven, level) {
                (DOMINANT, RECESSIVE) => return self.error(ErrorCode::BitDominant, true),
                (RECESSIVE, DOMINANT) if place == Place::AckSlot => {}
                (RECESSIVE, DOMINANT) if index < bits.arbitration() => {
                    if bits.is_stuffed(index) {
                        // Exception 2 of rule 3.
                        return self.error(ErrorCode::Stuff, false);
                    }
                    self.sending = None;
                    self.transmitter = false;
                    event = Event::ArbitrationLost;
                }
                (RECESSIVE, DOMINANT) => return self.error(ErrorCode::BitRecessive, true),
                (RECESSIVE, RECESSIVE) if place == Place::AckSlot && !self.needs_no_acknowledge => {
                    let passive = self.is_passive();
                    let event = self.error(ErrorCode::Acknowledgment, !passive);
                    self.unacknowledged = passive;
                    return event;
                }
                _ => {}
            }
        } else if self.driven == DOMINANT && level == RECESSIVE {
            // Its acknowledge did not reach the wire.
            return self.error(ErrorCode::BitDominant, true);
        }
        match self.reception.accept(level) {
            Meaning::Part => event,
            Meaning::Valid => {
                if self.transmitter {
                    return event;
                }
                // Rule 8, with the value that RM0090 gives.
                self.rec = if self.rec > PASSIVE_FROM {
                    120
                } else {
                    self.rec.saturating_sub(1)
                };
                Event::Received(self.reception.frame())
            }
            Meaning::End => {
                self.state = State::Intermission { bits: 0 };
                match self.sending.take() {
                    Some(bits) => {
                        // Rule 7.
                        self.tec = self.tec.saturating_sub(1);
                        Event::Sent(*bits.frame())
                    }
                    None => event,
                }
            }
            Meaning::Overload => self.overload(),
            Meaning::StuffError => self.error(ErrorCode::Stuff, true),
            Meaning::FormError => self.error(ErrorCode::Form, true),
            Meaning::CrcError => self.error(ErrorCode::Crc, true),
        }
    }

    fn sample_flag(&mut self, level: Level, kind: Flag, run: u8, last: Level) -> Event {
        if kind != Flag::Passive && level == RECESSIVE {
            // Rules 4 and 5; a receiver's single count (rule 1) is not for this.
            let next = self.flag();
            self.start_flag(next);
            self.count(8);
            return Event::Error {
                code: ErrorCode::BitDominant,
                while_sending: false,
            };
        }
        if kind == Flag::Passive && level == DOMINANT && self.unacknowledged {
            self.unacknowledged = false;
            self.count(8);
        }
        let run = if run > 0 && level == last { run + 1 } else { 1 };
        if !matches!(self.state, State::BusOff { .. }) {
            self.state = if run == FLAG_BITS {
                State::AfterFlag { kind, dominant: 0 }
            } else {
                State::Flag {
                    kind,
                    run,
                    last: level,
                }
            };
        }
        Event::None
    }

    fn sample_after_flag(&mut self, level: Level, kind: Flag, dominant: u32) -> Event {
        self.unacknowledged = false;
        if level == RECESSIVE {
            self.state = State::Delimiter { bits: 1 };
            return Event::None;
        }
        let dominant = dominant.wrapping_add(1);
        self.state = State::AfterFlag { kind, dominant };
        // Rule 2, and rule 6: the eighth after the flag is the fourteenth of an active one.
        let first = dominant == 1 && kind != Flag::Overload && !self.transmitter;
        if first || dominant.is_multiple_of(8) {
            self.count(8);
        }
        Event::None
    }

    fn sample_delimiter(&mut self, level: Level, bits: u8) -> Event {
        match (level, bits + 1) {
            (DOMINANT, DELIMITER_BITS) => self.overload(),
            (DOMINANT, _) => self.error(ErrorCode::Form, true),
            (_, DELIMITER_BITS) => {
                self.state = State::Intermission { bits: 0 };
                Event::None
            }
            (_, bits) => {
                self.state = State::Delimiter { bits };
                Event::None
            }
        }
    }

    const fn is_passive(&self) -> bool {
        matches!(self.error_state(), ErrorState::Passive)
    }

    const fn flag(&self) -> Flag {
        if self.is_passive() {
            Flag::Passive
        } else {
            Flag::Active
        }
    }

    const fn start_flag(&mut self, kind: Flag) {
        self.state = State::Flag {
            kind,
            run: 0,
            last: RECESSIVE,
        };
    }

    const fn overload(&mut self) -> Event {
        self.start_flag(Flag::Overload);
        Event::None
    }

    /// An error frame follows. `counts`: with rule 1 or 3.
    const fn error(&mut self, code: ErrorCode, counts: bool) -> Event {
        let while_sending = self.sending.take().is_some();
        // The error that makes a node passive still has an active flag (rule 9).
        let flag = self.flag();
        self.start_flag(flag);
        if counts {
            self.count(if self.transmitter { 8 } else { 1 });
        }
        Event::Error {
            code,
            while_sending,
        }
    }

    const fn count(&mut self, errors: u16) {
        if self.transmitter {
            self.tec += errors;
            if self.tec >= BUS_OFF_FROM {
                self.state = State::BusOff {
                    recovering: self.recovers_by_itself,
                    run: 0,
                    lots: 0,
                };
                self.leave_frame();
            }
        } else {
            self.rec += errors;
            if self.rec > REC_MAX {
                self.rec = REC_MAX;
            }
        }
    }
}

impl Default for Node {
    fn default() -> Self {
        Self::new()
    }
}
