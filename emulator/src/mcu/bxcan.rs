//! CAN1's registers, mailboxes, FIFOs and filters (RM0090 §32). The protocol itself is a [`Node`]'s business, the wire
//! that of [`crate::can_bus::CanBus`], which owns both and is the peripheral for the MCU's bus.
//!
//! Not modelled, and an error: time triggered mode (TTCM, TGT), a length code above 8 in a transmit mailbox, accesses
//! narrower than a word, reading an empty FIFO. A received one is in RDTR as it came. The time stamps are 0. CAN2 is not there; the filter banks that CAN2SB gives it are its own.

use crate::can_bus::bits::{Bits, arbitration_rank};
use crate::can_bus::node::{ErrorState, Event, Node};
use crate::can_frame::CanFrame;
use crate::time::Ticks;

use super::{Clocks, Interrupts, Unmodelled};

/// Position of CAN1_TX in the vector table (RM0090 table 62).
pub const IRQ_TX: u16 = 19;
/// Position of CAN1_RX0.
pub const IRQ_RX0: u16 = 20;
/// Position of CAN1_RX1.
pub const IRQ_RX1: u16 = 21;
/// Position of CAN1_SCE.
pub const IRQ_SCE: u16 = 22;

const MAILBOXES: usize = 3;
const FIFO_DEPTH: usize = 3;
const BANKS: usize = 28;

// CAN_MCR
const INRQ: u32 = 1 << 0;
const SLEEP: u32 = 1 << 1;
const TXFP: u32 = 1 << 2;
const RFLM: u32 = 1 << 3;
const NART: u32 = 1 << 4;
const AWUM: u32 = 1 << 5;
const ABOM: u32 = 1 << 6;
const TTCM: u32 = 1 << 7;
const RESET: u32 = 1 << 15;
const DBF: u32 = 1 << 16;
const MCR_RESET: u32 = DBF | SLEEP;
const MCR_BITS: u32 = INRQ | SLEEP | TXFP | RFLM | NART | AWUM | ABOM | DBF;

// CAN_MSR
const INAK: u32 = 1 << 0;
const SLAK: u32 = 1 << 1;
const ERRI: u32 = 1 << 2;
const WKUI: u32 = 1 << 3;
const SLAKI: u32 = 1 << 4;

// CAN_TSR, for mailbox 0; the next ones are 8 bits further each.
const RQCP: u32 = 1 << 0;
const TXOK: u32 = 1 << 1;
const ALST: u32 = 1 << 2;
const TERR: u32 = 1 << 3;
const ABRQ: u32 = 1 << 7;

// CAN_RFxR
const FULL: u32 = 1 << 3;
const FOVR: u32 = 1 << 4;
const RFOM: u32 = 1 << 5;

// CAN_IER
const TMEIE: u32 = 1 << 0;
const FMPIE0: u32 = 1 << 1;
const FFIE0: u32 = 1 << 2;
const FOVIE0: u32 = 1 << 3;
const EWGIE: u32 = 1 << 8;
const EPVIE: u32 = 1 << 9;
const BOFIE: u32 = 1 << 10;
const LECIE: u32 = 1 << 11;
const ERRIE: u32 = 1 << 15;
const WKUIE: u32 = 1 << 16;
const SLKIE: u32 = 1 << 17;
const IER_BITS: u32 = 0x7F | 0xF << 8 | 0x7 << 15;

// CAN_ESR
const EWGF: u32 = 1 << 0;
const EPVF: u32 = 1 << 1;
const BOFF: u32 = 1 << 2;
const LEC: u32 = 0b111 << 4;

// CAN_BTR
const LBKM: u32 = 1 << 30;
const SILM: u32 = 1 << 31;
const BTR_BITS: u32 = 0x3FF | 0x37F << 16 | LBKM | SILM;
const BTR_RESET: u32 = 0x0123_0000;

// Mailbox identifier registers
const TXRQ: u32 = 1 << 0;
const RTR: u32 = 1 << 1;
const IDE: u32 = 1 << 2;
const TGT: u32 = 1 << 8;

// CAN_FMR
const FINIT: u32 = 1 << 0;
const CAN2SB: u32 = 0x3F << 8;
const FMR_RESET: u32 = 0x2A1C_0E01;
const BANK_BITS: u32 = (1 << BANKS) - 1;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Mode {
    Sleep,
    Initialization,
    /// Normal mode, or on the way to it.
    Normal,
}

/// What the node has to do after a change of mode.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Membership {
    /// Leave the bus.
    Leave,
    /// Join it.
    Join,
}

/// The bit time that CAN_BTR gives, in ticks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BitTiming {
    /// A time quantum.
    pub quantum: u64,
    /// A bit.
    pub bit: u64,
    /// From the bit's start to its sample point.
    pub sample: u64,
    /// Jump width.
    pub jump: u64,
}

#[derive(Clone, Copy, Debug, Default)]
struct Mailbox {
    identifier: u32,
    length: u32,
    data: [u32; 2],
    pending: bool,
    abort: bool,
    /// RQCP, TXOK, ALST, TERR.
    status: u32,
    /// Place in the order of requests.
    request: u64,
}

impl Mailbox {
    fn frame(&self) -> CanFrame {
        let mut data = [0; 8];
        for (to, from) in data
            .iter_mut()
            .zip(self.data.iter().flat_map(|word| word.to_le_bytes()))
        {
            *to = from;
        }
        let extended = self.identifier & IDE != 0;
        CanFrame {
            id: self.identifier >> if extended { 3 } else { 21 },
            extended,
            remote: self.identifier & RTR != 0,
            length: (self.length & 0xF) as u8,
            data,
        }
    }

    const fn complete(&mut self, status: u32) {
        self.pending = false;
        self.abort = false;
        self.status = status | RQCP;
    }
}

#[derive(Clone, Copy, Debug, Default)]
struct Fifo {
    frames: [(CanFrame, u8); FIFO_DEPTH],
    count: usize,
    full: bool,
    overrun: bool,
}

impl Fifo {
    fn push(&mut self, frame: CanFrame, filter: u8, locked: bool) {
        if self.count < FIFO_DEPTH {
            self.frames[self.count] = (frame, filter);
            self.count += 1;
            self.full |= self.count == FIFO_DEPTH;
        } else {
            self.overrun = true;
            if !locked {
                self.frames[FIFO_DEPTH - 1] = (frame, filter);
            }
        }
    }

    fn release(&mut self) {
        if self.count > 0 {
            self.frames.copy_within(1.., 0);
            self.count -= 1;
        }
    }
}

/// CAN1 but for its protocol controller.
#[derive(Clone, Debug)]
pub struct Bxcan {
    mode: Mode,
    mcr: u32,
    /// INAK and SLAK, which stay up until the bus is synchronised, and the interrupt flags.
    msr: u32,
    ier: u32,
    btr: u32,
    lec: u32,
    /// EWGF, EPVF and BOFF as they were.
    error_flags: u32,
    sampled: bool,
    mailboxes: [Mailbox; MAILBOXES],
    requests: u64,
    sending: Option<usize>,
    fifos: [Fifo; 2],
    fmr: u32,
    /// FM1R, FS1R, FFA1R, FA1R.
    list_mode: u32,
    wide: u32,
    second_fifo: u32,
    active: u32,
    banks: [[u32; 2]; BANKS],
}

impl Bxcan {
    /// After a reset: in sleep mode (RM0090 §32.4.3).
    pub const fn new() -> Self {
        const EMPTY: Mailbox = Mailbox {
            identifier: 0,
            length: 0,
            data: [0; 2],
            pending: false,
            abort: false,
            status: 0,
            request: 0,
        };
        const NOTHING: CanFrame = CanFrame {
            id: 0,
            extended: false,
            remote: false,
            length: 0,
            data: [0; 8],
        };
        const NO_FIFO: Fifo = Fifo {
            frames: [(NOTHING, 0); FIFO_DEPTH],
            count: 0,
            full: false,
            overrun: false,
        };
        Self {
            mode: Mode::Sleep,
            mcr: MCR_RESET,
            msr: SLAK,
            ier: 0,
            btr: BTR_RESET,
            lec: 0,
            error_flags: 0,
            sampled: true,
            mailboxes: [EMPTY; MAILBOXES],
            requests: 0,
            sending: None,
            fifos: [NO_FIFO; 2],
            fmr: FMR_RESET,
            list_mode: 0,
            wide: 0,
            second_fifo: 0,
            active: 0,
            banks: [[0; 2]; BANKS],
        }
    }

    /// The bit time (RM0090, CAN_BTR): 1 + TS1 + 1 and TS2 + 1 quanta of (BRP + 1) periods of APB1.
    pub fn timing(&self, clocks: &Clocks) -> BitTiming {
        let field = |shift: u32, mask: u32| u64::from(self.btr >> shift & mask) + 1;
        let quantum = field(0, 0x3FF) * Ticks::PER_SECOND / u64::from(clocks.apb1.max(1));
        let (first, second) = (field(16, 0xF), field(20, 0x7));
        BitTiming {
            quantum,
            bit: quantum * (1 + first + second),
            sample: quantum * (1 + first),
            // ISO 11898-1: not longer than either segment.
            jump: quantum * field(24, 0x3).min(first).min(second),
        }
    }

    /// Loop back mode: it hears itself alone.
    pub const fn loops_back(&self) -> bool {
        self.btr & LBKM != 0
    }

    /// Silent mode: nobody hears it.
    pub const fn is_silent(&self) -> bool {
        self.btr & SILM != 0
    }

    /// Whether a falling edge on the wire wakes it or sets a flag.
    pub const fn sleeps(&self) -> bool {
        matches!(self.mode, Mode::Sleep)
    }

    /// A falling edge in sleep mode.
    pub const fn wake(&mut self) {
        if self.sleeps() {
            self.msr |= WKUI;
            if self.mcr & AWUM != 0 {
                self.mcr &= !SLEEP;
            }
        }
    }

    /// Whether there is something to send.
    pub fn wants_to_send(&self) -> bool {
        self.may_send() && self.mailboxes.iter().any(|mailbox| mailbox.pending)
    }

    const fn may_send(&self) -> bool {
        matches!(self.mode, Mode::Normal)
            && self.mcr & (INRQ | SLEEP) == 0
            && (!self.is_silent() || self.loops_back())
    }

    /// The node may send: the most urgent mailbox.
    pub fn offer(&mut self) -> Option<Bits> {
        if !self.may_send() {
            return None;
        }
        let urgent = self.by_priority().next()?;
        self.sending = Some(urgent);
        Some(Bits::new(self.mailboxes[urgent].frame()))
    }

    /// Pending mailboxes, the most urgent first.
    fn by_priority(&self) -> impl DoubleEndedIterator<Item = usize> {
        let mut pending: Vec<usize> = (0..MAILBOXES)
            .filter(|index| self.mailboxes[*index].pending)
            .collect();
        pending.sort_by_key(|index| {
            let mailbox = &self.mailboxes[*index];
            if self.mcr & TXFP == 0 {
                (u64::from(arbitration_rank(&mailbox.frame())), *index)
            } else {
                (mailbox.request, *index)
            }
        });
        pending.into_iter()
    }

    /// A lower bound, in bits, of the time until an interrupt can come, other than by the CPU's own doing.
    pub fn bits_to_interrupt(&self, node: &Node) -> u64 {
        if self.sleeps() {
            return 1;
        }
        let single = self.mcr & NART != 0
            || self.mailboxes.iter().any(|mailbox| mailbox.abort)
            || self.ier & (LECIE | SLKIE) != 0;
        if single {
            return 1;
        }
        // No bit adds more than 8 to a counter.
        let errors = |limit: u16, count: u16| match limit.saturating_sub(count) {
            // Passed already; the flag can only fall first.
            0 => u64::MAX,
            left => u64::from(left).div_ceil(8),
        };
        let both = |limit| errors(limit, node.tec()).min(errors(limit, node.rec()));
        let mut bits = node.bits_to_next();
        for (enable, left) in [(EWGIE, both(96)), (EPVIE, both(128)), (BOFIE, both(256))] {
            if self.ier & enable != 0 {
                bits = bits.min(left);
            }
        }
        bits.max(1)
    }

    /// What the last bit brought, and its level.
    pub fn on_bit(&mut self, event: Event, level: bool, node: &Node) {
        self.sampled = level;
        match event {
            Event::None => {}
            Event::Received(frame) => {
                self.lec = 0;
                self.receive(frame);
            }
            Event::Sent(frame) => {
                self.lec = 0;
                if let Some(index) = self.sending.take() {
                    self.mailboxes[index].complete(TXOK);
                }
                if self.loops_back() {
                    self.receive(frame);
                }
            }
            Event::ArbitrationLost => self.failed(ALST),
            Event::Error {
                code,
                while_sending,
            } => {
                self.lec = code as u32;
                if self.ier & LECIE != 0 {
                    self.msr |= ERRI;
                }
                if while_sending {
                    self.failed(TERR);
                }
            }
        }
        self.update_error_flags(node);
    }

    /// CAN_TSR: its status is that of the last attempt, whether another one follows or not.
    fn failed(&mut self, why: u32) {
        let single = self.mcr & NART != 0;
        if let Some(index) = self.sending.take() {
            let mailbox = &mut self.mailboxes[index];
            if single || mailbox.abort {
                mailbox.complete(why);
            } else {
                mailbox.status = why;
            }
        }
    }

    fn update_error_flags(&mut self, node: &Node) {
        let highest = node.tec().max(node.rec());
        let mut flags = 0;
        for (flag, is_set) in [
            (EWGF, highest >= 96),
            (EPVF, highest > 127),
            (BOFF, node.error_state() == ErrorState::BusOff),
        ] {
            if is_set {
                flags |= flag;
            }
        }
        // EWGIE … BOFIE lie 8 bits above their flags.
        if (flags & !self.error_flags) << 8 & self.ier != 0 {
            self.msr |= ERRI;
        }
        self.error_flags = flags;
    }

    /// Follows the requests in CAN_MCR as far as the bus allows (RM0090 figure "bxCAN operating modes").
    pub fn update_mode(&mut self, node: &Node) -> Option<Membership> {
        let initialize = self.mcr & INRQ != 0;
        let sleep = self.mcr & SLEEP != 0;
        let wanted = match self.mode {
            // With both requests it stays where it is.
            Mode::Sleep if sleep => Mode::Sleep,
            _ if initialize => Mode::Initialization,
            _ if sleep => Mode::Sleep,
            _ => Mode::Normal,
        };
        if wanted == self.mode {
            if self.mode == Mode::Normal && node.is_synchronised() {
                self.msr &= !(INAK | SLAK);
            }
            return None;
        }
        if self.mode == Mode::Normal && node.is_busy() {
            return None;
        }
        if wanted == Mode::Normal {
            self.mode = wanted;
            return Some(Membership::Join);
        }
        self.msr = self.msr & !(INAK | SLAK)
            | match wanted {
                Mode::Sleep => SLAK,
                _ => INAK,
            };
        if wanted == Mode::Sleep && self.ier & SLKIE != 0 {
            self.msr |= SLAKI;
        }
        let was_on = self.mode == Mode::Normal;
        self.mode = wanted;
        self.sending = None;
        was_on.then_some(Membership::Leave)
    }

    /// Which FIFO, and which number of its filters, takes `frame` (RM0090 §32.7.4).
    fn filter(&self, frame: &CanFrame) -> Option<(usize, u8)> {
        if self.fmr & FINIT != 0 {
            return None;
        }
        let (wide, narrow) = if frame.extended {
            let id = frame.id & 0x1FFF_FFFF;
            (id << 3 | IDE, (id >> 18) << 5 | 1 << 3 | id >> 15 & 0b111)
        } else {
            (frame.id << 21, frame.id << 5)
        };
        let wide = wide | if frame.remote { RTR } else { 0 };
        let narrow = narrow | if frame.remote { 1 << 4 } else { 0 };
        let mut numbers = [0_u8; 2];
        // (mask before list, narrow before wide): the lowest wins, then the lowest number.
        let mut best: Option<((bool, bool, u8), usize)> = None;
        for bank in 0..((self.fmr & CAN2SB) >> 8).min(BANKS as u32) {
            let bit = 1 << bank;
            let fifo = usize::from(self.second_fifo & bit != 0);
            let (list, is_wide) = (self.list_mode & bit != 0, self.wide & bit != 0);
            let [first, second] = self.banks[bank as usize];
            let halves = |word: u32| (word & 0xFFFF, word >> 16);
            let ((a, b), (c, d)) = (halves(first), halves(second));
            let matches: &[bool] = match (list, is_wide) {
                (true, true) => &[wide & !1 == first & !1, wide & !1 == second & !1],
                (false, true) => &[(wide ^ first) & second & !1 == 0],
                (true, false) => &[narrow == a, narrow == b, narrow == c, narrow == d],
                (false, false) => &[(narrow ^ a) & b == 0, (narrow ^ c) & d == 0],
            };
            // Inactive banks have numbers, too.
            let base = numbers[fifo];
            numbers[fifo] += matches.len() as u8;
            if self.active & bit == 0 {
                continue;
            }
            if let Some(index) = matches.iter().position(|matches| *matches) {
                let key = (!is_wide, !list, base + index as u8);
                if best.is_none_or(|(other, _)| key < other) {
                    best = Some((key, fifo));
                }
            }
        }
        best.map(|((.., number), fifo)| (fifo, number))
    }

    fn receive(&mut self, frame: CanFrame) {
        if let Some((fifo, number)) = self.filter(&frame) {
            let locked = self.mcr & RFLM != 0;
            self.fifos[fifo].push(frame, number, locked);
        }
    }

    /// Puts the four lines at their levels.
    pub fn drive_interrupts(&self, interrupts: &Interrupts) {
        let completed = self
            .mailboxes
            .iter()
            .any(|mailbox| mailbox.status & RQCP != 0);
        interrupts.set(IRQ_TX, self.ier & TMEIE != 0 && completed);
        for (irq, fifo, enabled) in [
            (IRQ_RX0, &self.fifos[0], self.ier),
            (IRQ_RX1, &self.fifos[1], self.ier >> 3),
        ] {
            let asserted = enabled & FMPIE0 != 0 && fifo.count > 0
                || enabled & FFIE0 != 0 && fifo.full
                || enabled & FOVIE0 != 0 && fifo.overrun;
            interrupts.set(irq, asserted);
        }
        let has = |enable: u32, flag: u32| self.ier & enable != 0 && self.msr & flag != 0;
        interrupts.set(
            IRQ_SCE,
            has(ERRIE, ERRI) || has(WKUIE, WKUI) || has(SLKIE, SLAKI),
        );
    }

    fn tsr(&self) -> u32 {
        let mut tsr = 0;
        for (index, mailbox) in self.mailboxes.iter().enumerate() {
            tsr |= mailbox.status << (8 * index);
            if mailbox.abort {
                tsr |= ABRQ << (8 * index);
            }
            if !mailbox.pending {
                tsr |= 1 << (26 + index);
            }
        }
        let pending = self.by_priority().count();
        let lowest = self.by_priority().next_back();
        let code = match lowest {
            Some(lowest) if pending == MAILBOXES => lowest,
            _ => (0..MAILBOXES)
                .find(|index| !self.mailboxes[*index].pending)
                .unwrap_or(0),
        };
        tsr |= (code as u32) << 24;
        if let Some(lowest) = lowest
            && pending > 1
        {
            tsr |= 1 << (29 + lowest);
        }
        tsr
    }

    fn rfr(&self, fifo: usize) -> u32 {
        let fifo = &self.fifos[fifo];
        fifo.count as u32 | if fifo.full { FULL } else { 0 } | if fifo.overrun { FOVR } else { 0 }
    }

    /// Reads a register; `level` is the wire as its receiver sees it.
    ///
    /// # Errors
    /// [`Unmodelled`], see the module.
    pub fn read(
        &self,
        offset: u32,
        bytes: u8,
        node: &Node,
        level: bool,
    ) -> Result<u32, Unmodelled> {
        word(offset, bytes)?;
        Ok(match offset {
            0x00 => self.mcr,
            0x04 => {
                let mut msr = self.msr;
                for (bit, is_set) in [
                    (8, node.is_sending()),
                    (9, node.is_receiving()),
                    (10, self.sampled),
                    (11, level),
                ] {
                    msr |= u32::from(is_set) << bit;
                }
                msr
            }
            0x08 => self.tsr(),
            0x0C => self.rfr(0),
            0x10 => self.rfr(1),
            0x14 => self.ier,
            0x18 => {
                // TEC is the lower byte of nine bits.
                u32::from(node.rec()) << 24
                    | u32::from(node.tec() & 0xFF) << 16
                    | self.lec << 4
                    | self.error_flags
            }
            0x1C => self.btr,
            0x180..=0x1AC => {
                let mailbox = &self.mailboxes[(offset as usize - 0x180) / 16];
                match offset & 0xF {
                    0x0 => mailbox.identifier | u32::from(mailbox.pending),
                    0x4 => mailbox.length,
                    0x8 => mailbox.data[0],
                    _ => mailbox.data[1],
                }
            }
            0x1B0..=0x1CC => {
                let fifo = &self.fifos[(offset as usize - 0x1B0) / 16];
                if fifo.count == 0 {
                    return Err(unmodelled(offset, "reading an empty FIFO"));
                }
                let (frame, filter) = &fifo.frames[0];
                match offset & 0xF {
                    0x0 => {
                        (if frame.extended {
                            frame.id << 3 | IDE
                        } else {
                            frame.id << 21
                        }) | if frame.remote { RTR } else { 0 }
                    }
                    0x4 => u32::from(*filter) << 8 | u32::from(frame.length),
                    0x8 => u32::from_le_bytes([
                        frame.data[0],
                        frame.data[1],
                        frame.data[2],
                        frame.data[3],
                    ]),
                    _ => u32::from_le_bytes([
                        frame.data[4],
                        frame.data[5],
                        frame.data[6],
                        frame.data[7],
                    ]),
                }
            }
            0x200 => self.fmr,
            0x204 => self.list_mode,
            0x20C => self.wide,
            0x214 => self.second_fifo,
            0x21C => self.active,
            0x240..=0x31C => self.banks[(offset as usize - 0x240) / 8][offset as usize / 4 % 2],
            _ => return Err(unmodelled(offset, "read")),
        })
    }

    /// Writes a register.
    ///
    /// # Errors
    /// [`Unmodelled`], see the module.
    pub fn write(
        &mut self,
        offset: u32,
        bytes: u8,
        value: u32,
        node: &mut Node,
    ) -> Result<(), Unmodelled> {
        word(offset, bytes)?;
        let filters_open = self.fmr & FINIT != 0;
        match offset {
            0x00 => self.write_mcr(value, node)?,
            0x04 => self.msr &= !(value & (ERRI | WKUI | SLAKI)),
            0x08 => self.write_tsr(value),
            0x0C | 0x10 => {
                let fifo = &mut self.fifos[usize::from(offset == 0x10)];
                fifo.full &= value & FULL == 0;
                fifo.overrun &= value & FOVR == 0;
                if value & RFOM != 0 {
                    fifo.release();
                }
            }
            0x14 => {
                only(offset, value, IER_BITS)?;
                self.ier = value;
            }
            0x18 => self.lec = (value & LEC) >> 4,
            // Outside initialization mode it cannot be written.
            0x1C => {
                only(offset, value, BTR_BITS)?;
                if self.mode == Mode::Initialization {
                    self.btr = value;
                    node.needs_no_acknowledge = self.loops_back();
                }
            }
            0x180..=0x1AC => self.write_mailbox(offset, value)?,
            0x200 => {
                only(
                    offset,
                    value & !(FMR_RESET & !(CAN2SB | FINIT)),
                    CAN2SB | FINIT,
                )?;
                self.fmr = FMR_RESET & !(CAN2SB | FINIT) | value & (CAN2SB | FINIT);
            }
            // These can be written in filter initialization mode alone.
            0x204 | 0x20C | 0x214 => {
                only(offset, value, BANK_BITS)?;
                if filters_open {
                    *match offset {
                        0x204 => &mut self.list_mode,
                        0x20C => &mut self.wide,
                        _ => &mut self.second_fifo,
                    } = value;
                }
            }
            0x21C => {
                only(offset, value, BANK_BITS)?;
                self.active = value;
            }
            0x240..=0x31C => {
                let bank = (offset as usize - 0x240) / 8;
                // An active bank can be written in filter initialization mode alone.
                if filters_open || self.active >> bank & 1 == 0 {
                    self.banks[bank][offset as usize / 4 % 2] = value;
                }
            }
            _ => return Err(unmodelled(offset, "write")),
        }
        Ok(())
    }

    fn write_mcr(&mut self, value: u32, node: &mut Node) -> Result<(), Unmodelled> {
        if value & TTCM != 0 {
            return Err(unmodelled(0x00, "TTCM set"));
        }
        only(0x00, value, MCR_BITS | RESET)?;
        if value & RESET != 0 {
            // Master reset: sleep mode, this register and the FIFOs' counts; the protocol controller begins anew.
            *node = Node::new();
            node.needs_no_acknowledge = self.loops_back();
            self.mode = Mode::Sleep;
            self.mcr = MCR_RESET;
            self.msr = self.msr & !INAK | SLAK;
            self.sending = None;
            for fifo in &mut self.fifos {
                fifo.count = 0;
            }
            self.update_error_flags(node);
            return Ok(());
        }
        self.mcr = value;
        node.recovers_by_itself = value & ABOM != 0;
        if node.recovers_by_itself {
            node.recover();
        }
        Ok(())
    }

    fn write_tsr(&mut self, value: u32) {
        for (index, mailbox) in self.mailboxes.iter_mut().enumerate() {
            let bits = value >> (8 * index);
            if bits & RQCP != 0 {
                mailbox.status = 0;
            }
            mailbox.status &= !(bits & (TXOK | ALST | TERR));
            if bits & ABRQ != 0 && mailbox.pending {
                if self.sending == Some(index) {
                    mailbox.abort = true;
                } else {
                    // Aborted at once; TXOK stays 0.
                    let status = mailbox.status;
                    mailbox.complete(status);
                }
            }
        }
    }

    fn write_mailbox(&mut self, offset: u32, value: u32) -> Result<(), Unmodelled> {
        let index = (offset as usize - 0x180) / 16;
        let mailbox = &mut self.mailboxes[index];
        // Write protected while the mailbox is not empty.
        if mailbox.pending {
            return Ok(());
        }
        match offset & 0xF {
            0x0 => {
                mailbox.identifier = value & !TXRQ;
                if value & TXRQ != 0 {
                    mailbox.pending = true;
                    mailbox.status = 0;
                    mailbox.request = self.requests;
                    self.requests += 1;
                }
            }
            0x4 => {
                if value & TGT != 0 {
                    return Err(unmodelled(offset, "TGT set"));
                }
                if value & 0xF > 8 {
                    return Err(unmodelled(offset, "a length code above 8"));
                }
                mailbox.length = value & 0xF;
            }
            0x8 => mailbox.data[0] = value,
            _ => mailbox.data[1] = value,
        }
        Ok(())
    }
}

impl Default for Bxcan {
    fn default() -> Self {
        Self::new()
    }
}

fn unmodelled(offset: u32, what: &str) -> Unmodelled {
    Unmodelled {
        register: match offset {
            0x00 => "CAN1_MCR".into(),
            0x14 => "CAN1_IER".into(),
            0x1C => "CAN1_BTR".into(),
            0x184 | 0x194 | 0x1A4 => format!("CAN1_TDT{}R", (offset - 0x184) / 16),
            0x1B0..=0x1CC => format!("CAN1 FIFO {}", (offset - 0x1B0) / 16),
            _ => format!("CAN1 + {offset:#05X}"),
        },
        what: what.into(),
    }
}

fn word(offset: u32, bytes: u8) -> Result<(), Unmodelled> {
    if bytes == 4 && offset.is_multiple_of(4) {
        Ok(())
    } else {
        Err(unmodelled(offset, "an access that is not a word"))
    }
}

fn only(offset: u32, value: u32, bits: u32) -> Result<(), Unmodelled> {
    match value & !bits {
        0 => Ok(()),
        others => Err(unmodelled(
            offset,
            &format!("setting the bits {others:#010X}"),
        )),
    }
}
