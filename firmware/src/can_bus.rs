//! CAN1 at 500 kbit/s: the newest frame of each identifier, in the order of the bus, and the way back from bus-off.
//!
//! One frame at a time is in the controller. So nothing has ever to be displaced from a mailbox (bxcan waits for the
//! abort without a bound), and what waits behind it is the newest that there is.

use bxcan::{
    Data, Fifo, Frame as BusFrame, Interrupts, StandardId,
    filter::{BankConfig, ListEntry16},
};
use core_logic::{
    bus_off::{Action, BusOff, LatestQueue},
    can::Frame,
    design_parameters::CAN_BITRATE,
    units::{Duration, Instant, elapsed},
};
use stm32f4xx_hal::{
    pac::{CAN1, RCC},
    rcc::{Enable, Reset},
};

use crate::clock;

/// The identifiers that the board sends.
pub const SENT: usize = 12;

/// APB1's 42 MHz / 6 = 7 MHz, 14 quanta a bit: 500 kbit/s. Sample point after 1 + 11 quanta (85.7 %), jump width 2.
const BIT_TIMING: u32 = (2 - 1) << 24 | (2 - 1) << 20 | (11 - 1) << 16 | (6 - 1);
const _: () = {
    let quanta = 3 + (BIT_TIMING >> 16 & 0xF) + (BIT_TIMING >> 20 & 0x7);
    let clocks = quanta * ((BIT_TIMING & 0x3FF) + 1);
    assert!(clock::APB1_HZ == CAN_BITRATE * clocks);
};
/// A frame that the bus has not taken for so long is given up at the next step: half a period of the current's frame, which
/// may win where this one does not, and would wait behind it.
const ABANDON_AFTER: Duration = Duration::from_ticks(5_000);

/// TSR: give up all three mailboxes.
const ABORT_ALL: u32 = 1 << 7 | 1 << 15 | 1 << 23;
/// TSR: request completed, of all three mailboxes.
const COMPLETED_ALL: u32 = 1 | 1 << 8 | 1 << 16;

/// The peripheral as bxcan wants it; the register block stays reachable for what bxcan does not offer.
pub struct Controller(CAN1);

// SAFETY: these are CAN1's registers, which this type owns.
unsafe impl bxcan::Instance for Controller {
    const REGISTERS: *mut bxcan::RegisterBlock = CAN1::ptr() as *mut _;
}

// SAFETY: CAN1 has the filters, 28 with CAN2 (RM0090, bxCAN main features).
unsafe impl bxcan::FilterOwner for Controller {
    const NUM_FILTER_BANKS: u8 = 28;
}

// SAFETY: CAN1 is the master.
unsafe impl bxcan::MasterInstance for Controller {}

/// What happened, since the start; each stops at its end.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Frames that left the board.
    pub sent: u32,
    /// Frames received.
    pub received: u32,
    /// Times the receive buffer overran.
    pub overruns: u32,
}

/// The bus.
pub struct Bus {
    can: bxcan::Can<Controller>,
    queue: LatestQueue<SENT>,
    policy: BusOff,
    in_mailbox: Option<Instant>,
    error_counters: u32,
    counters: Counters,
}

impl Bus {
    /// Takes the peripheral, whose pins are connected to it already. `received`: the identifiers that pass its filter.
    pub fn new(can: CAN1, rcc: &mut RCC, received: [u16; 2]) -> Self {
        CAN1::enable(rcc);
        CAN1::reset(rcc);
        let mut can = bxcan::Can::builder(Controller(can))
            .set_bit_timing(BIT_TIMING)
            .leave_disabled();
        let [first, second] = received.map(|id| {
            ListEntry16::data_frames_with_id(StandardId::new(id).unwrap_or(StandardId::MAX))
        });
        can.modify_filters().clear().enable_bank(
            0,
            Fifo::Fifo0,
            BankConfig::List16([first, second, first, second]),
        );
        can.enable_interrupts(
            Interrupts::TRANSMIT_MAILBOX_EMPTY
                | Interrupts::FIFO0_MESSAGE_PENDING
                | Interrupts::ERROR,
        );
        // bxcan has no name for it: the bus-off interrupt.
        can.instance().0.ier().modify(|_, w| w.bofie().set_bit());
        // It joins the bus in the background: with a line stuck dominant that takes for ever, and the board measures
        // all the same.
        let _ = can.enable_non_blocking();
        // bxcan sets automatic bus-off management with it. The way back has a policy of its own.
        can.instance().0.mcr().modify(|_, w| w.abom().clear_bit());
        Self {
            can,
            queue: LatestQueue::default(),
            policy: BusOff::default(),
            in_mailbox: None,
            error_counters: 0,
            counters: Counters::default(),
        }
    }

    /// Queues a frame in place of an older one with its identifier, and sends what can be sent.
    pub fn send(&mut self, frame: Frame, now: Instant) {
        self.queue.push(frame);
        self.pump(now);
    }

    /// Counts what has left the board, by how the request ended: a frame that is just on the bus when it is given up may
    /// still be sent (RM0090, bxCAN, abort).
    ///
    /// Only the flags that were read are cleared: a frame may end in between.
    fn count_sent(&mut self) {
        let register = self.can.instance().0.tsr();
        let status = register.read();
        let sent = status.txok0().bit_is_set()
            || status.txok1().bit_is_set()
            || status.txok2().bit_is_set();
        // SAFETY: clears the flags that are one; the other bits of this register ignore a zero.
        register.write(|w| unsafe { w.bits(status.bits() & COMPLETED_ALL) });
        if sent {
            self.counters.sent = self.counters.sent.saturating_add(1);
        }
    }

    /// Hands the most urgent frame to the controller when it is idle.
    fn pump(&mut self, now: Instant) {
        if self.policy.is_off() || !self.can.is_transmitter_idle() {
            return;
        }
        // Here and not in the interrupt: the next request clears the flags of the one before it.
        self.count_sent();
        self.in_mailbox = None;
        let Some(frame) = self.queue.pop() else {
            return;
        };
        let data = frame.data.get(..usize::from(frame.dlc)).and_then(Data::new);
        if let (Some(id), Some(data)) = (StandardId::new(frame.id), data)
            && self.can.transmit(&BusFrame::new_data(id, data)).is_ok()
        {
            self.in_mailbox = Some(now);
        }
    }

    /// The transmit interrupt: a mailbox has become empty.
    pub fn on_transmitted(&mut self, now: Instant) {
        self.count_sent();
        self.pump(now);
    }

    /// The receive interrupt: the next frame that has passed the filter, a data frame with a standard identifier.
    ///
    /// bxcan's own `receive` panics at the length codes 9 … 15, which ISO 11898-1 allows for eight bytes and the register
    /// shows as they are; here they are passed on.
    pub fn receive(&mut self) -> Option<Frame> {
        let controller = &self.can.instance().0;
        let state = controller.rfr(0).read();
        if state.fovr().bit_is_set() {
            // The oldest frames are still there.
            self.counters.overruns = self.counters.overruns.saturating_add(1);
            controller.rfr(0).write(|w| w.fovr().set_bit());
        }
        if state.fmp().bits() == 0 {
            return None;
        }
        self.counters.received = self.counters.received.saturating_add(1);
        let mailbox = controller.rx(0);
        let [low, high] = [mailbox.rdlr().read().bits(), mailbox.rdhr().read().bits()];
        let frame = Frame {
            id: mailbox.rir().read().stid().bits(),
            dlc: mailbox.rdtr().read().dlc().bits(),
            data: (u64::from(high) << 32 | u64::from(low)).to_le_bytes(),
        };
        controller.rfr(0).write(|w| w.rfom().set_bit());
        Some(frame)
    }

    /// The error interrupt: bus-off.
    pub fn on_error(&mut self, now: Instant) {
        self.can.instance().0.msr().write(|w| w.erri().set_bit());
        self.step(now);
    }

    /// Every 10 ms: bus-off, and frames that nobody takes.
    pub fn step(&mut self, now: Instant) {
        let controller = &self.can.instance().0;
        let errors = controller.esr().read();
        let off = errors.boff().bit_is_set();
        self.error_counters = u32::from(errors.tec().bits()) << 8 | u32::from(errors.rec().bits());
        // Initialization mode, asked for in an earlier step, is left again: that starts the controller's own recovery.
        if controller.msr().read().inak().bit_is_set() {
            controller.mcr().modify(|_, w| w.inrq().clear_bit());
        }
        match self.policy.step(now, off) {
            Action::Recover => {
                controller.mcr().modify(|_, w| w.inrq().set_bit());
            }
            Action::None => {}
        }
        let waits_too_long = self
            .in_mailbox
            .is_some_and(|since| elapsed(since, now) >= ABANDON_AFTER);
        if off || waits_too_long {
            // SAFETY: abort requests; the other bits of this register ignore a zero.
            controller.tsr().write(|w| unsafe { w.bits(ABORT_ALL) });
            self.in_mailbox = None;
        }
        self.pump(now);
    }

    /// Whether the controller is off the bus.
    pub const fn is_off(&self) -> bool {
        self.policy.is_off()
    }

    /// Transmit · 256 + receive error counter.
    pub const fn error_counters(&self) -> u32 {
        self.error_counters
    }

    /// State of the bus-off policy.
    pub const fn policy(&self) -> &BusOff {
        &self.policy
    }

    /// What happened so far.
    pub const fn counters(&self) -> Counters {
        self.counters
    }
}
