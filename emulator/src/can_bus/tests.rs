#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::collections::BTreeMap;

use plant::bus::SpiByte;
use proptest::prelude::*;

use super::*;
use crate::mcu::Interrupts;
use crate::mcu::bxcan::{IRQ_RX0, IRQ_RX1, IRQ_SCE, IRQ_TX};
use crate::outside::{DrivenLevels, I2cAnswer, I2cEvent, Outputs, Outside, SpiBus};

/// A bit at 500 kbit/s.
const BIT: u64 = 672;
/// 42 MHz / 6 / 14: 500 kbit/s, sample point 12/14, jump width 2 quanta.
const BTR_500K: u32 = 1 << 24 | 1 << 20 | 10 << 16 | 5;

const MCR: u32 = 0x00;
const MSR: u32 = 0x04;
const TSR: u32 = 0x08;
const RF0R: u32 = 0x0C;
const RF1R: u32 = 0x10;
const IER: u32 = 0x14;
const ESR: u32 = 0x18;
const BTR: u32 = 0x1C;
const TI0R: u32 = 0x180;
const RI0R: u32 = 0x1B0;
const FMR: u32 = 0x200;
const FM1R: u32 = 0x204;
const FS1R: u32 = 0x20C;
const FFA1R: u32 = 0x214;
const FA1R: u32 = 0x21C;
const BANK0: u32 = 0x240;

const BOFF: u32 = 4;
const EPVF: u32 = 2;

struct Nowhere;

impl Outside for Nowhere {
    fn spi(&mut self, _: SpiBus, _: SpiByte) -> u8 {
        0
    }
    fn i2c(&mut self, _: I2cEvent, _: Ticks) -> I2cAnswer {
        I2cAnswer::Nack
    }
    fn i2c_lines(&mut self, _: Ticks) -> (bool, bool) {
        (true, true)
    }
    fn adc_v(&mut self, _: u8, _: Ticks) -> f64 {
        0.0
    }
    fn outputs_changed(&mut self, _: &Outputs, _: Ticks) {}
    fn uart_sent(&mut self, _: u8, _: Ticks) {}
    fn levels(&mut self, _: Ticks) -> DrivenLevels {
        DrivenLevels::default()
    }
}

/// A program on the MCU that talks to CAN1 as RM0090 says.
struct Mcu {
    bus: CanBus,
    interrupts: Interrupts,
    now: u64,
}

impl Mcu {
    fn with<T>(&mut self, what: impl FnOnce(&mut CanBus, &mut Context<'_>) -> T) -> T {
        let mut outside = Nowhere;
        let mut context = Context {
            now: Ticks(self.now),
            clocks: Clocks {
                ahb: 168_000_000,
                apb1: 42_000_000,
                apb2: 84_000_000,
                apb1_timers: 84_000_000,
            },
            interrupts: &self.interrupts,
            outside: &mut outside,
        };
        what(&mut self.bus, &mut context)
    }

    /// After a reset.
    fn new() -> Self {
        Self {
            bus: CanBus::new(500_000),
            interrupts: Interrupts::default(),
            // Off the grid of the virtual nodes' bits.
            now: 1_000,
        }
    }

    fn read(&mut self, offset: u32) -> u32 {
        self.with(|bus, context| bus.read(offset, 4, context))
            .unwrap()
    }

    fn write(&mut self, offset: u32, value: u32) {
        self.with(|bus, context| bus.write(offset, 4, value, context))
            .unwrap();
    }

    fn modify(&mut self, offset: u32, clear: u32, set: u32) {
        let value = self.read(offset);
        self.write(offset, value & !clear | set);
    }

    /// Lets time pass, as the MCU's bus does: from event to event.
    fn run_to(&mut self, until: u64) {
        while let Some(at) = self.bus.next_event()
            && at.0 <= until
        {
            assert!(
                at.0 >= self.now,
                "an event in the past: {} at {}",
                at.0,
                self.now
            );
            self.now = at.0;
            self.with(|bus, context| bus.advance(context));
            assert!(self.bus.next_event().is_none_or(|next| next > at));
        }
        self.now = until;
        self.with(|bus, context| bus.advance(context));
    }

    fn run_bits(&mut self, bits: u64) {
        self.run_to(self.now + bits * BIT);
    }

    /// Bits until `done`, looked at after each; at most `limit`.
    fn bits_until(&mut self, limit: u64, mut done: impl FnMut(&mut Self) -> bool) -> u64 {
        for bits in 0..limit {
            if done(self) {
                return bits;
            }
            self.run_bits(1);
        }
        panic!("not within {limit} bits");
    }

    fn initialize(&mut self, btr: u32, mcr: u32) {
        self.modify(MCR, 2, 1);
        self.bits_until(20, |mcu| mcu.read(MSR) & 3 == 1);
        self.write(BTR, btr);
        self.modify(MCR, 1, mcr);
        self.bits_until(30, |mcu| mcu.read(MSR) & 3 == 0);
    }

    /// All into FIFO 0: one 32-bit mask of zeros.
    fn accept_all(&mut self) {
        self.modify(FMR, 0, 1);
        self.write(FM1R, 0);
        self.write(FS1R, 1);
        self.write(FFA1R, 0);
        self.write(BANK0, 0);
        self.write(BANK0 + 4, 0);
        self.write(FA1R, 1);
        self.modify(FMR, 1, 0);
    }

    /// Ready at 500 kbit/s.
    fn ready() -> Self {
        let mut mcu = Self::new();
        mcu.initialize(BTR_500K, 0);
        mcu.accept_all();
        mcu
    }

    fn load(&mut self, mailbox: u32, frame: &CanFrame) {
        let base = TI0R + 16 * mailbox;
        let word = |at: usize| u32::from_le_bytes(frame.data[at..at + 4].try_into().unwrap());
        self.write(base + 4, frame.length.into());
        self.write(base + 8, word(0));
        self.write(base + 12, word(4));
        let id = if frame.extended {
            frame.id << 3 | 4
        } else {
            frame.id << 21
        };
        self.write(base, id | u32::from(frame.remote) << 1 | 1);
    }

    /// Empties FIFO 0 or 1.
    fn receive(&mut self, fifo: u32) -> Vec<(CanFrame, u32)> {
        let mut frames = Vec::new();
        while self.read(RF0R + 4 * fifo) & 3 != 0 {
            let base = RI0R + 16 * fifo;
            let (id, length) = (self.read(base), self.read(base + 4));
            let mut data = [0; 8];
            data[..4].copy_from_slice(&self.read(base + 8).to_le_bytes());
            data[4..].copy_from_slice(&self.read(base + 12).to_le_bytes());
            let extended = id & 4 != 0;
            frames.push((
                CanFrame {
                    id: if extended { id >> 3 } else { id >> 21 },
                    extended,
                    remote: id & 2 != 0,
                    length: (length & 0xF) as u8,
                    data,
                },
                length >> 8 & 0xFF,
            ));
            self.write(RF0R + 4 * fifo, 1 << 5);
        }
        frames
    }

    fn tec(&mut self) -> u32 {
        self.read(ESR) >> 16 & 0xFF
    }

    fn rec(&mut self) -> u32 {
        self.read(ESR) >> 24
    }

    fn lec(&mut self) -> u32 {
        self.read(ESR) >> 4 & 7
    }
}

fn standard(id: u16) -> CanFrame {
    CanFrame::standard(id, &[1, 2, 3, 4, 5, 6, 7, 8])
}

#[test]
fn registers_after_reset() {
    // RM0090 §32.9, reset values.
    let mut mcu = Mcu::new();
    for (offset, value) in [
        (MCR, 0x0001_0002),
        (MSR, 0x0000_0C02),
        (TSR, 0x1C00_0000),
        (RF0R, 0),
        (RF1R, 0),
        (IER, 0),
        (ESR, 0),
        (BTR, 0x0123_0000),
        (FMR, 0x2A1C_0E01),
        (FM1R, 0),
        (FS1R, 0),
        (FFA1R, 0),
        (FA1R, 0),
    ] {
        assert_eq!(mcu.read(offset), value, "{offset:#X}");
    }
}

#[test]
fn what_is_not_modelled_is_an_error() {
    let mut mcu = Mcu::ready();
    let writes = [
        (MCR, 4, 1 << 7 | 1 << 16),
        (MCR, 4, 1 << 9),
        (IER, 4, 1 << 7),
        (TI0R + 4, 4, 1 << 8),
        (TI0R + 4, 4, 9),
        (FA1R, 4, 1 << 28),
        (MCR, 2, 1),
        (0x20, 4, 0),
        (0x320, 4, 0),
    ];
    for (offset, bytes, value) in writes {
        let result = mcu.with(|bus, context| bus.write(offset, bytes, value, context));
        assert!(result.is_err(), "{offset:#X} {bytes} {value:#X}");
    }
    for (offset, bytes) in [(RI0R, 4), (MSR, 1), (0x208, 4), (0x17C, 4)] {
        let result = mcu.with(|bus, context| bus.read(offset, bytes, context));
        assert!(result.is_err(), "{offset:#X} {bytes}");
    }
}

/// RM0090 §32.4: from initialization mode to normal mode after eleven recessive bits; to sleep mode and back at once.
#[test]
fn modes() {
    let mut mcu = Mcu::new();
    // What bxcan's builder does: sleep → initialization → sleep.
    mcu.modify(MCR, 2, 1);
    assert_eq!(mcu.read(MSR) & 3, 1);
    mcu.write(BTR, BTR_500K);
    mcu.modify(MCR, 1, 2);
    assert_eq!(mcu.read(MSR) & 3, 2);
    // Outside initialization mode the bit timing stays.
    mcu.write(BTR, 0x0123_0000);
    assert_eq!(mcu.read(BTR), BTR_500K);
    // Sleep → normal.
    mcu.modify(MCR, 2, 0);
    let bits = mcu.bits_until(20, |mcu| mcu.read(MSR) & 3 == 0);
    assert_eq!(bits, 11);
    // A mode is entered after the frame on the bus, not within.
    mcu.bus.inject(standard(0x100), Ticks(0));
    mcu.run_bits(20);
    mcu.modify(MCR, 0, 1);
    assert_eq!(mcu.read(MSR) & 1, 0);
    let bits = mcu.bits_until(200, |mcu| mcu.read(MSR) & 1 == 1);
    let length = u64::from(Bits::new(standard(0x100)).length());
    assert!(
        (length + 3 - 20..=length + 3 - 18).contains(&bits),
        "{bits} of {length}"
    );
    // The other node's acknowledge came from the listener, and the board's silence is no error.
    assert_eq!(mcu.bus.take_log().len(), 1);
}

#[test]
fn with_a_stuck_line_normal_mode_is_not_reached() {
    let mut mcu = Mcu::new();
    mcu.bus.set_fault(Fault::Dominant, true, Ticks(0));
    mcu.modify(MCR, 2, 1);
    mcu.write(BTR, BTR_500K);
    mcu.modify(MCR, 1, 0);
    mcu.run_bits(10_000);
    assert_eq!(mcu.read(MSR) & 1, 1);
    let now = Ticks(mcu.now);
    mcu.bus.set_fault(Fault::Dominant, false, now);
    assert_eq!(mcu.bits_until(20, |mcu| mcu.read(MSR) & 1 == 0), 11);
}

/// Start, end and status of one frame. 500 kbit/s: 2 µs a bit, frame and intermission 111 bits without stuff bits.
#[test]
fn a_frame_is_sent() {
    let mut mcu = Mcu::ready();
    mcu.write(IER, 1);
    mcu.run_bits(5);
    let frame = CanFrame::standard(0x555, &[0x55; 8]);
    mcu.load(0, &frame);
    assert_eq!(mcu.read(TSR), 0x1900_0000);
    assert_eq!(mcu.read(TI0R) & 1, 1);
    let requested = mcu.now;
    mcu.run_bits(150);
    let log = mcu.bus.take_log();
    let [logged] = log[..] else {
        panic!("{log:?}");
    };
    assert_eq!((logged.frame, logged.from_board), (frame, true));
    assert!(logged.start.0 - requested <= BIT);
    let bits = Bits::new(frame);
    assert_eq!(logged.at.0 - logged.start.0, u64::from(bits.length()) * BIT);
    assert_eq!(u32::from(bits.length()) + 3 - bits.stuff_bits(), 111);
    // Busy with it until the end of intermission.
    assert_eq!(mcu.bus.busy().0, u64::from(bits.length() + 3) * BIT);
    assert_eq!(mcu.read(TSR), 0x1C00_0003);
    assert_eq!(mcu.read(TI0R) & 1, 0);
    assert!(mcu.interrupts.is_asserted(IRQ_TX));
    mcu.write(TSR, 1);
    assert_eq!(mcu.read(TSR), 0x1C00_0000);
    assert!(!mcu.interrupts.is_asserted(IRQ_TX));
    assert_eq!((mcu.tec(), mcu.rec(), mcu.lec()), (0, 0, 0));
}

/// The interrupt comes at the sample point of the last bit of end of frame, not at a multiple of some step.
#[test]
fn the_interrupt_is_in_time() {
    let mut mcu = Mcu::ready();
    mcu.write(IER, 1 | 1 << 1);
    for frame in [standard(0x123), CanFrame::standard(0x7FF, &[])] {
        mcu.load(0, &frame);
        let mut at = 0;
        while !mcu.interrupts.is_asserted(IRQ_TX) {
            at = mcu.bus.next_event().unwrap().0;
            mcu.run_to(at);
        }
        let log = mcu.bus.take_log();
        assert_eq!(at, log[0].at.0 - 2 * BIT / 14);
        mcu.write(TSR, 1);

        mcu.run_bits(20);
        mcu.bus.inject(frame, Ticks(mcu.now));
        while !mcu.interrupts.is_asserted(IRQ_RX0) {
            at = mcu.bus.next_event().unwrap().0;
            mcu.run_to(at);
        }
        // Valid at the last but one bit.
        mcu.run_bits(2);
        let log = mcu.bus.take_log();
        assert_eq!(at, log[0].at.0 - BIT - 2 * BIT / 14);
        assert_eq!(mcu.receive(0), [(frame, 0)]);
        assert!(!mcu.interrupts.is_asserted(IRQ_RX0));
        mcu.run_bits(20);
    }
}

/// ISO 11898-1: a length code of 9 … 15 stands for eight bytes. RDTR shows the code as it came: ST's HAL makes 8 of it
/// in software.
#[test]
fn a_length_code_above_8_is_eight_bytes() {
    let mut mcu = Mcu::ready();
    for length in 0..=15 {
        for extended in [false, true] {
            for remote in [false, true] {
                let used = if remote {
                    0
                } else {
                    usize::from(length).min(8)
                };
                let mut frame = CanFrame {
                    id: 0x321,
                    extended,
                    remote,
                    length,
                    data: [0xA5, 1, 2, 3, 4, 5, 6, 0x5A],
                };
                mcu.bus.inject(frame, Ticks(mcu.now));
                mcu.run_bits(200);
                frame.data[used..].fill(0);
                assert_eq!(mcu.receive(0), [(frame, 0)]);
                assert_eq!(frame.bytes().len(), usize::from(length).min(8));
                let log = mcu.bus.take_log();
                assert_eq!(log[0].frame, frame);
            }
        }
    }
}

#[test]
fn mailboxes_go_by_identifier_or_by_request() {
    for (fifo_order, expected) in [
        (0, [0x101, 0x200, 0x200, 0x300]),
        (4, [0x300, 0x200, 0x101, 0x200]),
    ] {
        let mut mcu = Mcu::ready();
        mcu.modify(MCR, 0, fifo_order);
        // A frame from elsewhere keeps the bus busy while the mailboxes are filled.
        mcu.bus.inject(standard(0x001), Ticks(mcu.now));
        mcu.run_bits(30);
        let mut second = standard(0x200);
        mcu.load(0, &standard(0x300));
        mcu.load(1, &second);
        assert_eq!(mcu.read(TSR) >> 24 & 3, 2);
        mcu.load(2, &standard(0x101));
        let tsr = mcu.read(TSR);
        // CODE and LOW: the least urgent.
        let least = if fifo_order == 0 { 0 } else { 2 };
        assert_eq!(
            (tsr >> 24 & 3, tsr >> 29, tsr >> 26 & 7),
            (least, 1 << least, 0)
        );
        mcu.bits_until(400, |mcu| mcu.read(TSR) >> 26 & 7 != 0);
        // The mailbox that has become free takes another one with an identifier that waits already.
        second.data[0] = 99;
        let free = mcu.read(TSR) >> 24 & 3;
        mcu.load(free, &second);
        mcu.run_bits(700);
        let sent: Vec<CanFrame> = mcu
            .bus
            .take_log()
            .iter()
            .filter(|logged| logged.from_board)
            .map(|logged| logged.frame)
            .collect();
        assert_eq!(
            sent.iter().map(|frame| frame.id).collect::<Vec<_>>(),
            expected
        );
        // Equal identifiers: the lower mailbox, here 1 before 2 (or 0, loaded later: by the request).
        let of_200: Vec<u8> = sent
            .iter()
            .filter(|frame| frame.id == 0x200)
            .map(|frame| frame.data[0])
            .collect();
        assert_eq!(of_200, [1, 99]);
    }
}

#[test]
fn an_abort_before_and_within_a_transmission() {
    let mut mcu = Mcu::ready();
    mcu.write(IER, 1);
    mcu.bus.inject(standard(0x001), Ticks(mcu.now));
    mcu.run_bits(30);
    mcu.load(0, &standard(0x100));
    mcu.write(TSR, 1 << 7);
    // Pending: at once, not sent.
    assert_eq!(mcu.read(TSR), 0x1C00_0001);
    assert!(mcu.interrupts.is_asserted(IRQ_TX));
    mcu.write(TSR, 1);
    mcu.run_bits(130);
    // In transmission, and it succeeds.
    mcu.load(0, &standard(0x100));
    mcu.run_bits(30);
    mcu.write(TSR, 1 << 7);
    assert_eq!(mcu.read(TSR) & 0xFF, 1 << 7);
    mcu.run_bits(130);
    assert_eq!(mcu.read(TSR), 0x1C00_0003);
    mcu.write(TSR, 1);
    // In transmission, and it fails: no further attempt.
    mcu.bus.set_fault(Fault::NoOtherNode, true, Ticks(mcu.now));
    mcu.load(0, &standard(0x100));
    mcu.run_bits(30);
    mcu.write(TSR, 1 << 7);
    mcu.run_bits(130);
    assert_eq!(mcu.read(TSR), 0x1C00_0009);
    assert_eq!(mcu.tec(), 8);
    mcu.run_bits(300);
    assert_eq!(mcu.tec(), 8);
    // An empty mailbox has nothing to abort.
    mcu.write(TSR, 1);
    mcu.write(TSR, 1 << 7);
    assert_eq!(mcu.read(TSR), 0x1C00_0000);
}

#[test]
fn without_retransmission_a_lost_arbitration_is_the_end() {
    for single in [false, true] {
        let mut mcu = Mcu::ready();
        mcu.modify(MCR, 0, u32::from(single) << 4);
        mcu.bus.inject(standard(0x001), Ticks(mcu.now));
        mcu.run_bits(30);
        // Both wait for the end of the first frame.
        mcu.bus.inject(standard(0x0FF), Ticks(mcu.now));
        mcu.load(0, &standard(0x100));
        mcu.run_bits(600);
        let log = mcu.bus.take_log();
        let ids: Vec<u32> = log.iter().map(|logged| logged.frame.id).collect();
        assert_eq!(mcu.bus.counters().lost_arbitration, 1);
        if single {
            assert_eq!(ids, [0x001, 0x0FF]);
            assert_eq!(mcu.read(TSR), 0x1C00_0005);
        } else {
            assert_eq!(ids, [0x001, 0x0FF, 0x100]);
            assert_eq!(mcu.read(TSR), 0x1C00_0003);
        }
        // Back to back: three bits of intermission.
        for pair in log.windows(2) {
            assert_eq!(pair[1].start.0 - pair[0].at.0, 3 * BIT);
        }
        // The loser received the winner's frame.
        let received: Vec<u32> = mcu.receive(0).iter().map(|(frame, _)| frame.id).collect();
        assert_eq!(received, [0x001, 0x0FF]);
    }
}

/// A standard frame wins over an extended one with the same first eleven bits, a data frame over a remote frame.
#[test]
fn arbitration_beyond_the_identifier() {
    let extended = CanFrame {
        id: 0x100 << 18,
        extended: true,
        ..standard(0)
    };
    let remote = CanFrame {
        remote: true,
        data: [0; 8],
        ..standard(0x100)
    };
    let mut mcu = Mcu::ready();
    mcu.bus.inject(standard(0x001), Ticks(mcu.now));
    mcu.run_bits(30);
    mcu.bus.inject(extended, Ticks(mcu.now));
    mcu.bus.inject(standard(0x100), Ticks(mcu.now));
    mcu.load(0, &remote);
    mcu.run_bits(800);
    let frames: Vec<CanFrame> = mcu
        .bus
        .take_log()
        .iter()
        .skip(1)
        .map(|logged| logged.frame)
        .collect();
    assert_eq!(frames, [standard(0x100), remote, extended]);
}

/// RM0090 §32.7.3: three frames are kept; the fourth replaces the last, or is lost with RFLM.
#[test]
fn a_fifo_overruns() {
    for (locked, kept) in [(0, [0x10, 0x11, 0x14]), (1 << 3, [0x10, 0x11, 0x12])] {
        let mut mcu = Mcu::ready();
        mcu.modify(MCR, 0, locked);
        mcu.write(IER, 1 << 2 | 1 << 3);
        for id in 0x10..0x13 {
            mcu.bus.inject(standard(id), Ticks(mcu.now));
        }
        mcu.run_bits(400);
        assert_eq!(mcu.read(RF0R), 3 | 1 << 3);
        assert!(mcu.interrupts.is_asserted(IRQ_RX0));
        mcu.write(RF0R, 1 << 3);
        assert!(!mcu.interrupts.is_asserted(IRQ_RX0));
        for id in 0x13..0x15 {
            mcu.bus.inject(standard(id), Ticks(mcu.now));
        }
        mcu.run_bits(300);
        assert_eq!(mcu.read(RF0R), 3 | 1 << 4);
        assert!(mcu.interrupts.is_asserted(IRQ_RX0));
        mcu.write(RF0R, 1 << 4);
        let ids: Vec<u32> = mcu.receive(0).iter().map(|(frame, _)| frame.id).collect();
        assert_eq!(ids, kept);
        assert_eq!(mcu.read(RF0R), 0);
    }
}

/// The firmware's filter: one bank as a list of four 16-bit identifiers.
#[test]
fn a_list_of_16_bit_identifiers() {
    let mut mcu = Mcu::ready();
    mcu.modify(FMR, 0, 1);
    mcu.write(FA1R, 0);
    mcu.write(FM1R, 1);
    mcu.write(FS1R, 0);
    let entry = |id: u32| id << 5;
    mcu.write(BANK0, entry(0x201) << 16 | entry(0x200));
    mcu.write(BANK0 + 4, entry(0x201) << 16 | entry(0x200));
    mcu.write(FFA1R, 0);
    mcu.write(FA1R, 1);
    // In filter initialization mode nothing is received.
    mcu.bus.inject(standard(0x200), Ticks(mcu.now));
    mcu.run_bits(200);
    assert_eq!(mcu.receive(0), []);
    mcu.modify(FMR, 1, 0);
    // An active bank and the modes cannot be written now.
    mcu.write(BANK0, 0);
    mcu.write(FM1R, 0);
    assert_eq!(
        (mcu.read(BANK0), mcu.read(FM1R)),
        (entry(0x201) << 16 | entry(0x200), 1)
    );

    let remote = CanFrame {
        remote: true,
        ..CanFrame::standard(0x200, &[])
    };
    let extended = CanFrame {
        extended: true,
        id: 0x200 << 18,
        ..standard(0)
    };
    for frame in [
        standard(0x1FF),
        standard(0x201),
        remote,
        extended,
        standard(0x200),
        standard(0x202),
    ] {
        mcu.bus.inject(frame, Ticks(mcu.now));
    }
    mcu.run_bits(1_500);
    assert_eq!(mcu.bus.take_log().len(), 7);
    // By their rank: 0x200 came first. The filter's number is its place in the list.
    assert_eq!(mcu.receive(0), [(standard(0x200), 0), (standard(0x201), 1)]);
}

/// RM0090 §32.7.4: masks, both widths and FIFOs, the numbers of the filters, and which of several wins.
#[test]
fn masks_numbers_and_precedence() {
    let mut mcu = Mcu::ready();
    mcu.modify(FMR, 0, 1);
    mcu.write(FA1R, 0);
    // Bank 0: 16-bit masks, FIFO 0, inactive: filters 0 and 1. Bank 1: 32-bit mask, FIFO 0: filter 2.
    // Bank 2: 32-bit list, FIFO 1: filters 0 and 1. Bank 3: 16-bit masks, FIFO 0: filters 3 and 4.
    // Bank 4: 16-bit list, FIFO 1: filters 2 … 5. Bank 14 belongs to CAN2.
    mcu.write(FM1R, 1 << 2 | 1 << 4);
    mcu.write(FS1R, 1 << 1 | 1 << 2 | 1 << 14);
    mcu.write(FFA1R, 1 << 2 | 1 << 4);
    let bank = |index: u32, half: u32| BANK0 + 8 * index + 4 * half;
    mcu.write(bank(0, 0), 0);
    // Extended, 0x1ABCD00 … 0x1ABCDFF.
    mcu.write(bank(1, 0), 0x01AB_CD00 << 3 | 4);
    mcu.write(bank(1, 1), 0x1FFF_FF00 << 3 | 4);
    mcu.write(bank(2, 0), 0x01AB_CD42 << 3 | 4);
    mcu.write(bank(2, 1), 0x123 << 21 | 2);
    // 0x120 … 0x12F, data or remote, standard; then 0x300 … 0x3FF, data frames alone.
    mcu.write(bank(3, 0), (0x7F0 << 5 | 1 << 3) << 16 | 0x120 << 5);
    mcu.write(
        bank(3, 1),
        (0x700 << 5 | 1 << 3 | 1 << 4) << 16 | 0x300 << 5,
    );
    mcu.write(bank(4, 0), (0x125 << 5) << 16 | 0x301 << 5);
    mcu.write(bank(4, 1), 0x7FF << 5 | 0x7FE << 21);
    mcu.write(FA1R, 1 << 1 | 1 << 2 | 1 << 3 | 1 << 4 | 1 << 14);
    mcu.modify(FMR, 1, 0);

    let extended = |id| CanFrame {
        id,
        extended: true,
        ..CanFrame::standard(0, &[7])
    };
    let data = |id| CanFrame::standard(id, &[7]);
    let remote = |id| CanFrame {
        remote: true,
        ..CanFrame::standard(id, &[])
    };
    for (frame, expected) in [
        (extended(0x01AB_CD41), Some((0, 2))),
        // List before mask.
        (extended(0x01AB_CD42), Some((1, 0))),
        (extended(0x01AB_CE41), None),
        (data(0x123), Some((0, 3))),
        // 32 bits before 16.
        (remote(0x123), Some((1, 1))),
        (remote(0x12F), Some((0, 3))),
        (data(0x125), Some((1, 3))),
        (data(0x301), Some((1, 2))),
        (data(0x302), Some((0, 4))),
        (remote(0x302), None),
        (data(0x7FE), Some((1, 5))),
        (data(0x7FF), Some((1, 4))),
        (data(0x400), None),
    ] {
        mcu.bus.inject(frame, Ticks(mcu.now));
        mcu.run_bits(200);
        let received: Vec<_> = (0..2)
            .flat_map(|fifo| {
                let frames = mcu.receive(fifo);
                frames
                    .into_iter()
                    .map(move |(frame, number)| (frame, fifo, number))
            })
            .collect();
        let expected: Vec<_> = expected
            .into_iter()
            .map(|(fifo, number)| (frame, fifo, number))
            .collect();
        assert_eq!(received, expected, "{frame}");
    }
    mcu.write(IER, 1 << 4);
    mcu.bus.inject(data(0x301), Ticks(mcu.now));
    mcu.run_bits(200);
    assert!(mcu.interrupts.is_asserted(IRQ_RX1));
}

/// F16 without acknowledge: +8 a try, error passive after 16, and there it stays (rule 3, exception 1). On an
/// STM32F407 with open lines TEC was seen to rest at 0x80 with LEC 3.
#[test]
fn without_acknowledge_the_board_stays_error_passive() {
    let mut mcu = Mcu::ready();
    mcu.bus.set_fault(Fault::NoOtherNode, true, Ticks(mcu.now));
    mcu.write(IER, 1 << 9 | 1 << 15);
    let frame = standard(0x101);
    mcu.load(0, &frame);
    let mut tries = 0;
    let mut last = 0;
    let mut at = Vec::new();
    for _ in 0..20_000 {
        mcu.run_bits(1);
        let tec = mcu.tec();
        if tec != last {
            assert_eq!(tec, last + 8);
            last = tec;
            tries += 1;
            at.push(mcu.now / BIT);
        }
        assert_eq!(mcu.read(ESR) & EPVF != 0, tec >= 128);
    }
    assert_eq!((tries, last), (16, 128));
    assert_eq!((mcu.lec(), mcu.rec()), (3, 0));
    assert!(mcu.interrupts.is_asserted(IRQ_SCE));
    // From error to error: flag of 6, delimiter of 8, intermission of 3, and the frame up to the ACK slot, which
    // is followed by eight more bits.
    let period = 6 + 8 + 3 + u64::from(Bits::new(frame).length()) - 8;
    for pair in at.windows(2) {
        assert_eq!(pair[1] - pair[0], period);
    }
    // Error passive: the same with suspend transmission, 8 bits.
    let errors = mcu.bus.counters().errors_at_board;
    mcu.run_bits(10 * (period + 8));
    assert_eq!(mcu.bus.counters().errors_at_board, errors + 10);
    // One node is enough, and the frame has not been lost.
    let now = Ticks(mcu.now);
    mcu.bus.set_fault(Fault::NoOtherNode, false, now);
    mcu.run_bits(400);
    assert_eq!(mcu.bus.take_log().len(), 1);
    assert_eq!((mcu.tec(), mcu.lec()), (127, 0));
    assert_eq!(mcu.read(ESR) & 7, 1);
}

/// A short within a frame: the sender counts 8 for its bit error and for each eight dominant bits after its flag
/// (rules 3 and 6), so it is off after 1 + 6 + 8 · 31 bits and none of its frames is needed.
#[test]
fn a_short_within_a_frame_is_bus_off() {
    let mut mcu = Mcu::ready();
    mcu.write(IER, 1 << 10 | 1 << 15);
    let short = Ticks::from_micros(2_500);
    mcu.bus.short_in_next_frame(Ticks(mcu.now), short);
    let frame = standard(0x101);
    mcu.load(0, &frame);
    let begun = mcu.now;
    let mut asked = 0;
    while !mcu.interrupts.is_asserted(IRQ_SCE) {
        let at = mcu.bus.next_event().unwrap().0;
        mcu.run_to(at);
        asked += 1;
        assert!(asked < 1_000);
    }
    let bits = (mcu.now - begun) / BIT;
    let first_wrong = u64::from(Bits::new(frame).arbitration());
    assert!(
        (first_wrong + 255..first_wrong + 255 + 8).contains(&bits),
        "{bits} after {first_wrong}"
    );
    assert_eq!(mcu.read(ESR) & 7, 7);
    assert_eq!(mcu.bus.board_state().state, ErrorState::BusOff);
    // The flag falls with a write of one and does not rise again for the same bus-off.
    mcu.write(MSR, 1 << 2);
    assert!(!mcu.interrupts.is_asserted(IRQ_SCE));
    // It stays off without being asked, long after the short.
    mcu.run_bits(10_000);
    assert_eq!(mcu.read(ESR) & BOFF, BOFF);
    assert_eq!(mcu.bus.take_log(), []);
    // Asked: through initialization mode, then 128 times eleven recessive bits; the frame still waits.
    mcu.modify(MCR, 0, 1);
    assert_eq!(mcu.read(MSR) & 1, 1);
    mcu.run_bits(2_000);
    assert_eq!(mcu.read(ESR) & BOFF, BOFF);
    mcu.modify(MCR, 1, 0);
    let bits = mcu.bits_until(3_000, |mcu| mcu.read(ESR) & BOFF == 0);
    assert_eq!(bits, 128 * 11);
    assert_eq!((mcu.tec(), mcu.rec(), mcu.read(MSR) & 1), (0, 0, 0));
    mcu.run_bits(200);
    assert_eq!(mcu.bus.take_log().len(), 1);
}

#[test]
fn with_abom_it_comes_back_by_itself() {
    let mut mcu = Mcu::ready();
    mcu.modify(MCR, 0, 1 << 6);
    mcu.bus
        .short_in_next_frame(Ticks(mcu.now), Ticks::from_millis(10_000));
    mcu.load(0, &standard(0x101));
    mcu.run_bits(400);
    assert_eq!(mcu.read(ESR) & BOFF, BOFF);
    mcu.run_to(Ticks::from_millis(9_999).0);
    assert_eq!(mcu.read(ESR) & BOFF, BOFF);
    let end = mcu.bus.changes.keys().next().map(|(at, _)| *at).unwrap();
    mcu.run_to(end);
    let bits = mcu.bits_until(3_000, |mcu| mcu.read(ESR) & BOFF == 0);
    // The others, error passive by then, are silent meanwhile.
    assert!((128 * 11..=128 * 11 + 1).contains(&bits), "{bits}");
    mcu.run_bits(200);
    assert_eq!(mcu.bus.take_log().len(), 1);
}

/// Under full load each frame and its intermission hold eleven recessive bits once: the recovery takes 128 frames.
#[test]
fn recovery_under_full_load_takes_128_frames() {
    let mut mcu = Mcu::ready();
    mcu.bus
        .short_in_next_frame(Ticks(mcu.now), Ticks::from_micros(1_000));
    mcu.load(0, &standard(0x101));
    mcu.run_bits(1_000);
    assert_eq!(mcu.read(ESR) & BOFF, BOFF);
    let now = Ticks(mcu.now);
    mcu.bus
        .flood(vec![standard(0x050)], now, now + Ticks::from_millis(1_000));
    mcu.run_bits(1_000);
    mcu.modify(MCR, 0, 1);
    mcu.modify(MCR, 1, 0);
    mcu.bus.take_log();
    mcu.bits_until(40_000, |mcu| mcu.read(ESR) & BOFF == 0);
    let frames = mcu.bus.take_log().len();
    assert!((127..=129).contains(&frames), "{frames}");
}

/// A node that listens while the line is shorted becomes error passive and not more: only senders go off.
#[test]
fn a_short_while_idle_is_error_passive_only() {
    let mut mcu = Mcu::ready();
    let now = Ticks(mcu.now);
    mcu.bus.short(now, Ticks::from_millis(10_000));
    mcu.run_bits(7);
    // Start bit and five: stuff error, rule 1.
    assert_eq!((mcu.rec(), mcu.lec()), (1, 1));
    mcu.run_bits(7);
    // First bit after its flag: rule 2.
    assert_eq!(mcu.rec(), 9);
    mcu.run_bits(7);
    // The eighth: rule 6.
    assert_eq!(mcu.rec(), 17);
    mcu.run_bits(8);
    assert_eq!(mcu.rec(), 25);
    mcu.run_bits(1_000);
    assert_eq!((mcu.read(ESR) & 7, mcu.rec()), (3, 255));
    // A frame waits meanwhile and goes out when the line is free.
    mcu.load(0, &standard(0x101));
    // Nothing is computed until then.
    let next = mcu.bus.next_event();
    assert!(next.unwrap() >= now + Ticks::from_millis(10_000));
    mcu.run_to(now.0 + Ticks::from_millis(10_000).0);
    assert_eq!(mcu.read(TSR) & 0xF, 0);
    mcu.run_bits(200);
    assert_eq!(mcu.read(TSR) & 0xF, 3);
    // Rule 8 with RM0090's value.
    mcu.bus.inject(standard(0x200), Ticks(mcu.now));
    mcu.run_bits(200);
    assert_eq!(mcu.rec(), 120);
}

/// The bus stuck recessive: each dominant bit is an error. Active flags are nothing but dominant bits (rule 4): 16
/// bits to error passive. Then 16 tries with start bit, flag of 6, delimiter, intermission and suspend, 26 bits each.
#[test]
fn a_recessive_bus_is_bus_off() {
    let mut mcu = Mcu::ready();
    mcu.bus.set_fault(Fault::Recessive, true, Ticks(mcu.now));
    mcu.load(0, &standard(0x101));
    mcu.run_bits(1);
    let bits = mcu.bits_until(1_000, |mcu| mcu.tec() >= 128);
    assert!((15..=16).contains(&bits), "{bits}");
    assert_eq!(mcu.lec(), 5);
    // The flag that was begun at 120 was active still: one more error.
    mcu.run_bits(1);
    assert_eq!(mcu.tec(), 136);
    let bits = mcu.bits_until(1_000, |mcu| mcu.read(ESR) & BOFF != 0);
    assert!((14 * 26 + 25..=15 * 26 + 1).contains(&bits), "{bits}");
    // Nothing of all this was on the bus.
    assert_eq!(mcu.bus.stations[SENDER].node.rec(), 0);
    assert_eq!(mcu.bus.take_log(), []);
}

/// Cut off, the board hears itself alone; the others do not miss it.
#[test]
fn an_open_stub() {
    let mut mcu = Mcu::ready();
    mcu.bus.set_fault(Fault::BoardOpen, true, Ticks(mcu.now));
    mcu.load(0, &standard(0x101));
    for id in 0x200..0x205 {
        mcu.bus.inject(standard(id), Ticks(mcu.now));
    }
    mcu.run_bits(5_000);
    let ids: Vec<u32> = mcu
        .bus
        .take_log()
        .iter()
        .map(|logged| logged.frame.id)
        .collect();
    assert_eq!(ids, [0x200, 0x201, 0x202, 0x203, 0x204]);
    assert_eq!(mcu.receive(0), []);
    assert_eq!((mcu.tec(), mcu.lec()), (128, 3));
    let now = Ticks(mcu.now);
    mcu.bus.set_fault(Fault::BoardOpen, false, now);
    mcu.run_bits(400);
    assert_eq!(mcu.bus.take_log().len(), 1);
}

/// One wrong bit for all, at each place of a frame: the sender counts 8 (less one for the next attempt), sends again,
/// and the frame counts as sent once. Within the arbitration field a recessive bit seen dominant is arbitration lost,
/// or, if it is a stuff bit, an error that does not count (rule 3, exception 2).
#[test]
fn a_wrong_bit_anywhere_is_repaired() {
    // The first has stuff bits within the arbitration field, the second one right after it.
    for id in [0x41F, 0x550] {
        wrong_bits(CanFrame::standard(id, &[0, 0x5A, 0xFF]));
    }
}

fn wrong_bits(frame: CanFrame) {
    let bits = Bits::new(frame);
    for wrong in 0..bits.length() {
        let mut mcu = Mcu::ready();
        mcu.load(0, &frame);
        mcu.run_bits(2);
        let start = mcu.bus.stations[BOARD].started;
        // The start bit has gone by; it is hit in another test.
        if wrong < 2 {
            continue;
        }
        for (offset, inverted) in [(0, true), (1, false)] {
            mcu.bus.schedule(
                Ticks(start + (u64::from(wrong) + offset) * BIT),
                Change::Inverted(Place::Bus, inverted),
            );
        }
        mcu.run_bits(400);
        let log = mcu.bus.take_log();
        assert_eq!(log.len(), 1, "{wrong}");
        assert_eq!((log[0].frame, log[0].from_board), (frame, true), "{wrong}");
        assert_eq!(mcu.read(TSR) & 0xF, 3);
        let in_arbitration = wrong < bits.arbitration() && bits.level(wrong) == RECESSIVE;
        let expected = if in_arbitration { 0 } else { 7 };
        assert_eq!((mcu.tec(), mcu.lec()), (expected, 0), "{wrong}");
        let lost = in_arbitration && !bits.is_stuffed(wrong);
        assert_eq!(
            mcu.bus.counters().lost_arbitration,
            u64::from(lost),
            "{wrong}"
        );
        // The listener: 1 for the flag of the sender, or 9 if it was first, less one for the frame. Wrong in the last
        // bit, the frame was valid for it and comes twice.
        let listener = mcu.bus.stations[2].node.rec();
        if wrong + 1 == bits.length() {
            assert_eq!(listener, 0);
        } else {
            assert!([0, 8].contains(&listener), "{wrong}: {listener}");
        }
    }
}

/// Random ones: as many as asked for, and no frame is lost or sent twice.
#[test]
fn the_probability_holds() {
    let mut mcu = Mcu::ready();
    mcu.bus.set_bit_errors(
        Some(BitErrors {
            probability: 0.1,
            place: Place::Bus,
            seed: 1,
        }),
        Ticks(mcu.now),
    );
    mcu.run_bits(1);
    let mut disturbed = 0;
    for _ in 0..1_000 {
        mcu.load(0, &standard(0x101));
        let before = mcu.bus.counters().errors_at_board + mcu.bus.counters().lost_arbitration;
        mcu.run_bits(1_000);
        let after = mcu.bus.counters().errors_at_board + mcu.bus.counters().lost_arbitration;
        disturbed += u64::from(after > before);
        assert_eq!(mcu.read(TSR) & 0xF, 3);
        mcu.write(TSR, 1);
    }
    assert_eq!(mcu.bus.take_log().len(), 1_000);
    // Binomial: 100 ± 9.5; four times that.
    assert!((62..=138).contains(&disturbed), "{disturbed}");
}

/// With every frame disturbed for it the board goes off, and each of its errors is an error frame for the others.
#[test]
fn bit_errors_lead_to_bus_off() {
    let mut mcu = Mcu::ready();
    mcu.bus.set_bit_errors(
        Some(BitErrors {
            probability: 1.0,
            place: Place::Board,
            seed: 2,
        }),
        Ticks(mcu.now),
    );
    mcu.load(0, &standard(0x101));
    mcu.bits_until(20_000, |mcu| {
        let _ = mcu.read(TSR);
        mcu.write(TSR, 1);
        if mcu.read(TSR) >> 26 & 1 != 0 {
            mcu.load(0, &standard(0x101));
        }
        mcu.read(ESR) & BOFF != 0
    });
    assert!(mcu.bus.counters().errors_at_board >= 17);
}

/// As receiver the board destroys frames that it alone finds wrong, and gets 9 for being the first (rules 1 and 2).
#[test]
fn a_frame_that_the_board_alone_finds_wrong() {
    let mut mcu = Mcu::ready();
    mcu.run_bits(1);
    let frame = standard(0x200);
    mcu.bus.inject(frame, Ticks(mcu.now));
    mcu.run_bits(2);
    let start = mcu.bus.stations[SENDER].started;
    // Bit 40, in the data field.
    mcu.bus.schedule(
        Ticks(start + 40 * BIT),
        Change::Inverted(Place::Board, true),
    );
    mcu.bus.schedule(
        Ticks(start + 41 * BIT),
        Change::Inverted(Place::Board, false),
    );
    mcu.run_bits(400);
    let log = mcu.bus.take_log();
    assert_eq!(log.len(), 1);
    assert!(log[0].start.0 > start + 50 * BIT);
    assert_eq!(mcu.bus.stations[SENDER].node.tec(), 7);
    assert_eq!(mcu.receive(0).len(), 1);
    // 9, less one for the frame that came in the end.
    assert_eq!(mcu.rec(), 8);
}

/// Half and twice the bus's bit rate: nothing is understood, nothing gets through, and errors are counted.
#[test]
fn a_wrong_bit_rate() {
    for btr in [BTR_500K + 6, 1 << 24 | 1 << 20 | 10 << 16 | 2] {
        let mut mcu = Mcu::new();
        mcu.initialize(btr, 0);
        mcu.accept_all();
        mcu.run_bits(50);
        mcu.load(0, &standard(0x101));
        mcu.run_bits(20_000);
        assert_eq!(mcu.bus.take_log(), [], "{btr:#X}");
        let state = mcu.bus.board_state();
        assert_ne!(state.state, ErrorState::Active, "{btr:#X} {state:?}");
        // The others, error passive at last, do not reach it either.
        mcu.bus.inject(standard(0x055), Ticks(mcu.now));
        mcu.run_bits(2_000);
        assert_eq!(mcu.receive(0), [], "{btr:#X}");
    }
}

/// Resynchronisation (ISO 11898-1) holds a node whose clock is 0.5 % off: at most ten bits pass between two falling
/// edges, which is 0.05 of a bit against a jump width of 2/14.
#[test]
fn a_clock_half_a_percent_off_is_no_error() {
    for (numerator, denominator) in [(199, 200), (201, 200)] {
        let mut mcu = Mcu::ready();
        for station in &mut mcu.bus.stations[SENDER..] {
            let timing = &mut station.timing;
            timing.bit = timing.bit * numerator / denominator;
            timing.sample = timing.sample * numerator / denominator;
        }
        for id in 0..40_u16 {
            let fill = if id % 2 == 0 { 0x00 } else { 0xA5 };
            mcu.bus
                .inject(CanFrame::standard(0x100 + 2 * id, &[fill; 8]), Ticks(0));
            mcu.load(0, &CanFrame::standard(0x101 + 2 * id, &[!fill; 8]));
            mcu.run_bits(300);
        }
        assert_eq!(mcu.bus.take_log().len(), 80);
        assert_eq!(mcu.bus.counters().errors_at_board, 0);
        assert_eq!((mcu.tec(), mcu.rec()), (0, 0));
    }
}

/// F17: at full load a lower identifier of the flood starves the board, a higher one lets it pass at once.
#[test]
fn a_flood() {
    for (id, passes) in [(0x050, false), (0x700, true)] {
        let mut mcu = Mcu::ready();
        let from = Ticks(mcu.now);
        mcu.bus
            .flood(vec![standard(id)], from, from + Ticks::from_millis(20));
        mcu.run_bits(500);
        let busy = mcu.bus.busy();
        let begun = mcu.now;
        mcu.load(0, &standard(0x101));
        mcu.run_to(from.0 + Ticks::from_millis(19).0);
        let load = (mcu.bus.busy() - busy).0 as f64 / (mcu.now - begun) as f64;
        assert!(load > 0.999, "{load}");
        let log = mcu.bus.take_log();
        let from_board: Vec<_> = log.iter().filter(|logged| logged.from_board).collect();
        assert_eq!(from_board.len(), usize::from(passes));
        if let Some(logged) = from_board.first() {
            assert!(logged.start.0 - begun <= 135 * BIT);
        }
        for pair in log.windows(2) {
            assert_eq!(pair[1].start.0 - pair[0].at.0, 3 * BIT);
        }
        mcu.run_bits(1_500);
        assert_eq!(mcu.bus.counters().from_board, 1);
    }
}

#[test]
fn loop_back_and_silent_mode() {
    // Loop back: no acknowledge needed, received by itself, and on the bus unless silent, too.
    for (mode, on_bus) in [(1 << 30, true), (3 << 30, false)] {
        let mut mcu = Mcu::new();
        mcu.initialize(BTR_500K | mode, 0);
        mcu.accept_all();
        mcu.load(0, &standard(0x101));
        mcu.run_bits(200);
        assert_eq!(mcu.receive(0), [(standard(0x101), 0)]);
        assert_eq!((mcu.tec(), mcu.read(TSR)), (0, 0x1C00_0003));
        assert_eq!(mcu.bus.take_log().len(), usize::from(on_bus));
        assert_eq!(mcu.bus.stations[2].node.rec(), 0);
    }
    // Silent: it receives, does not acknowledge and cannot send.
    let mut mcu = Mcu::new();
    mcu.initialize(BTR_500K | 1 << 31, 0);
    mcu.accept_all();
    mcu.load(0, &standard(0x101));
    mcu.bus.stations[2].leave();
    mcu.bus.inject(standard(0x200), Ticks(mcu.now));
    mcu.run_bits(1_000);
    // The sender finds no acknowledge; the board's own stays in the chip.
    assert_eq!(mcu.bus.take_log(), []);
    assert!(mcu.bus.stations[SENDER].node.tec() >= 40);
    assert_eq!(mcu.tec(), 0);
}

#[test]
fn it_wakes_up() {
    for automatic in [false, true] {
        let mut mcu = Mcu::ready();
        mcu.write(IER, 1 << 16 | 1 << 17);
        mcu.modify(MCR, 0, 2 | u32::from(automatic) << 5);
        mcu.run_bits(2);
        assert_eq!(mcu.read(MSR) & 0x1F, 2 | 1 << 4);
        mcu.write(MSR, 1 << 4);
        assert!(!mcu.interrupts.is_asserted(IRQ_SCE));
        let now = Ticks(mcu.now);
        mcu.bus.inject(standard(0x100), now);
        mcu.bus.inject(standard(0x101), now + Ticks(200 * BIT));
        while !mcu.interrupts.is_asserted(IRQ_SCE) {
            let at = mcu.bus.next_event().unwrap().0;
            mcu.run_to(at);
        }
        assert!(mcu.now - now.0 <= BIT);
        mcu.run_bits(500);
        assert_eq!(mcu.read(MSR) & 0xF, if automatic { 8 } else { 10 });
        // The frame that woke it is lost.
        let ids: Vec<u32> = mcu.receive(0).iter().map(|(frame, _)| frame.id).collect();
        assert_eq!(ids, if automatic { vec![0x101] } else { vec![] });
    }
}

#[test]
fn resets() {
    // The master reset: sleep mode; filters and interrupts stay.
    let mut mcu = Mcu::ready();
    mcu.write(IER, 2);
    mcu.bus.inject(standard(0x100), Ticks(mcu.now));
    mcu.run_bits(200);
    assert_eq!(mcu.read(RF0R), 1);
    mcu.modify(MCR, 0, 1 << 15);
    assert_eq!((mcu.read(MCR), mcu.read(MSR) & 3), (0x0001_0002, 2));
    assert_eq!((mcu.read(RF0R), mcu.read(IER), mcu.read(FA1R)), (0, 2, 1));
    // A reset by RCC in the middle of a frame: the others find it broken, and go on.
    let mut mcu = Mcu::ready();
    mcu.load(0, &standard(0x100));
    mcu.run_bits(30);
    mcu.with(|bus, context| bus.reset(context));
    assert_eq!((mcu.read(MCR), mcu.read(FA1R)), (0x0001_0002, 0));
    mcu.bus.inject(standard(0x200), Ticks(mcu.now));
    mcu.run_bits(300);
    let log = mcu.bus.take_log();
    assert_eq!(log.len(), 1);
    assert!(!log[0].from_board);
    assert!(mcu.bus.stations[2].node.rec() > 0 || mcu.bus.stations[SENDER].node.rec() > 0);
    assert_eq!(mcu.read(TSR), 0x1C00_0000);
}

/// An idle bus costs nothing: no event to wait for; nor does a short, once all counters stand still.
#[test]
fn nothing_to_do_is_nothing() {
    let mut mcu = Mcu::ready();
    mcu.run_bits(20);
    assert_eq!(mcu.bus.next_event(), None);
    mcu.bus.set_fault(Fault::Dominant, true, Ticks(mcu.now));
    mcu.run_bits(1_000);
    assert_eq!(mcu.bus.next_event(), None);
}

#[derive(Clone, Debug)]
enum Action {
    Board(u8, u16),
    Others(u16),
    Wait(u16),
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Whatever is given to the bus goes over it exactly once; whoever waits and has the lowest identifier goes first;
    /// nobody counts an error; the FIFO holds what the others sent.
    #[test]
    fn arbitration_is_lossless_and_by_rank(actions in prop::collection::vec(prop_oneof![
        (0..3_u8, 0..0x80_u16).prop_map(|(mailbox, id)| Action::Board(mailbox, id)),
        (0x80..0x100_u16).prop_map(Action::Others),
        (0..300_u16).prop_map(Action::Wait),
    ], 1..40)) {
        let mut mcu = Mcu::ready();
        mcu.run_bits(2);
        // Identifiers of the board are mixed among those of the others.
        let scrambled = |id: u16| id.wrapping_mul(0x35D) & 0x7FF;
        let mut given: Vec<(u64, CanFrame, bool)> = Vec::new();
        let mut received = Vec::new();
        for (order, action) in actions.into_iter().enumerate() {
            match action {
                Action::Board(mailbox, id) => {
                    if mcu.read(TSR) >> (26 + mailbox) & 1 != 0 {
                        let frame = CanFrame::standard(scrambled(id), &[order as u8, 0xB0]);
                        mcu.load(mailbox.into(), &frame);
                        given.push((mcu.now, frame, true));
                    }
                }
                Action::Others(id) => {
                    let frame = CanFrame::standard(scrambled(id), &[order as u8]);
                    mcu.bus.inject(frame, Ticks(mcu.now));
                    given.push((mcu.now, frame, false));
                }
                Action::Wait(bits) => {
                    for _ in 0..bits / 40 {
                        mcu.run_bits(40);
                        received.extend(mcu.receive(0));
                    }
                    mcu.run_to(mcu.now + u64::from(bits));
                }
            }
            received.extend(mcu.receive(0));
        }
        for _ in 0..200 {
            mcu.run_bits(40);
            received.extend(mcu.receive(0));
        }
        let log = mcu.bus.take_log();
        prop_assert_eq!(log.len(), given.len());
        let mut waiting: BTreeMap<usize, (u64, CanFrame, bool)> = given.into_iter().enumerate().collect();
        for logged in &log {
            // Those that were there in good time before its start: none was more urgent.
            let urgent = waiting.values().filter(|(at, ..)| *at + 2 * BIT < logged.start.0).map(|(_, frame, _)| frame.id).min();
            prop_assert!(urgent.is_none_or(|id| logged.frame.id <= id));
            let key = waiting.iter().find(|(_, (_, frame, board))| *frame == logged.frame && *board == logged.from_board).map(|(key, _)| *key);
            let key = key.unwrap();
            waiting.remove(&key);
        }
        let others: Vec<CanFrame> = log.iter().filter(|logged| !logged.from_board).map(|logged| logged.frame).collect();
        prop_assert_eq!(received.iter().map(|(frame, _)| *frame).collect::<Vec<_>>(), others);
        prop_assert_eq!(mcu.bus.counters().errors_at_board, 0);
        prop_assert_eq!((mcu.tec(), mcu.rec()), (0, 0));
        for pair in log.windows(2) {
            prop_assert!(pair[1].start.0 >= pair[0].at.0 + 3 * BIT);
        }
    }

    /// Under random disturbances nothing is lost while nobody is off: each frame arrives at least once, the order of
    /// the counters holds, and no event is ever in the past.
    #[test]
    fn disturbed_frames_arrive(seed in any::<u64>(), place in prop_oneof![Just(Place::Bus), Just(Place::Board)]) {
        let mut mcu = Mcu::ready();
        mcu.run_bits(2);
        mcu.bus.set_bit_errors(Some(BitErrors { probability: 0.05, place, seed }), Ticks(mcu.now));
        for number in 0..30_u8 {
            mcu.load(0, &CanFrame::standard(0x101, &[number]));
            mcu.bus.inject(CanFrame::standard(0x200, &[number]), Ticks(mcu.now));
            mcu.run_bits(600);
            let state = mcu.bus.board_state();
            prop_assert_eq!(state.state == ErrorState::Passive, state.tec > 127 || state.rec > 127);
            prop_assert_eq!(mcu.read(TSR) >> 26 & 1, 1);
            let received: Vec<u8> = mcu.receive(0).iter().map(|(frame, _)| frame.data[0]).collect();
            prop_assert!(!received.is_empty() && received.iter().all(|data| *data == number), "{number}: {received:?}");
        }
        let log = mcu.bus.take_log();
        for from_board in [true, false] {
            let numbers: Vec<u8> = log.iter().filter(|logged| logged.from_board == from_board).map(|logged| logged.frame.data[0]).collect();
            prop_assert_eq!(numbers, (0..30).collect::<Vec<u8>>());
        }
    }
}
