//! USART2, asynchronous, 8E1, sixteen samples a bit (RM0090, 30.3 and 30.6).
//!
//! Modelled: transmit and receive registers with their shift registers, every flag of SR that this mode has and its
//! clearing sequence, the idle frame after TE, baud rates, interrupts. Not modelled, and an error where the software
//! asks for it: other formats than 8E1, OVER8, RWU, SBK, LIN, smartcard, IrDA, single wire, flow control, DMA.
//!
//! SR followed by DR clears the flags that SR showed; an overrun that comes between the two stays, without RXNE (30.3.3, overrun error). A character
//! whose start bit came before the receiver was on is missed as a whole.

use super::halfword::{Registers, periods};
use super::{Context, Peripheral, Unmodelled};
use crate::outside::Character;
use crate::time::Ticks;

const IRQ: u16 = 38;

const SR: usize = 0;
const DR: usize = 1;
const BRR: usize = 2;
const CR1: usize = 3;
const CR2: usize = 4;
const CR3: usize = 5;
const GTPR: usize = 6;
static REGISTERS: Registers = Registers {
    peripheral: "USART2",
    names: &["SR", "DR", "BRR", "CR1", "CR2", "CR3", "GTPR"],
};

const PE: u16 = 1 << 0;
const FE: u16 = 1 << 1;
const NF: u16 = 1 << 2;
const ORE: u16 = 1 << 3;
const IDLE: u16 = 1 << 4;
const RXNE: u16 = 1 << 5;
const TC: u16 = 1 << 6;
const TXE: u16 = 1 << 7;
const RESET_STATUS: u16 = TC | TXE;

const RE: u16 = 1 << 2;
const TE: u16 = 1 << 3;
const IDLEIE: u16 = 1 << 4;
const RXNEIE: u16 = 1 << 5;
const TCIE: u16 = 1 << 6;
const TXEIE: u16 = 1 << 7;
const PEIE: u16 = 1 << 8;
const PS: u16 = 1 << 9;
const PCE: u16 = 1 << 10;
const M: u16 = 1 << 12;
const UE: u16 = 1 << 13;
const CR1_REFUSED: &[(u16, &str)] = &[
    (1 << 0, "SBK"),
    (1 << 1, "RWU"),
    (1 << 11, "WAKE"),
    (1 << 14, "a reserved bit"),
    (1 << 15, "OVER8"),
];
/// Error interrupts exist with DMA only, so the bit does nothing here.
const EIE: u16 = 1 << 0;

/// Bits of a character of 8E1: start, eight data bits, parity, stop.
const CHARACTER_BITS: u64 = 11;
/// Beyond this the receiver's samples no longer fall into the right bits for certain: 3.03 % for M = 1 with a fractional
/// divider (30.3.5, tolerance of the receiver).
const TOLERANCE: f64 = 0.03;

/// What the transmitter is shifting out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Shifting {
    /// The frame of ones that follows TE.
    Idle,
    Byte(u8),
}

/// USART2.
#[derive(Debug)]
pub struct Usart {
    line_baud: u32,
    status: u16,
    brr: u16,
    cr1: u16,
    cr3: u16,
    /// What SR showed when it was read: reading DR clears PE, FE, NF, ORE and IDLE of it.
    read_for_receive: u16,
    /// SR was read: writing DR clears TC.
    read_for_send: bool,
    to_send: Option<u8>,
    shifting: Option<(Shifting, Ticks)>,
    /// Data and parity bit.
    received: u16,
    receiver_since: Option<Ticks>,
    /// When the line has been idle for a frame.
    idle_at: Option<Ticks>,
    missed: u64,
    /// When the character in DR came.
    received_at: Ticks,
    longest_wait: Ticks,
}

impl Usart {
    /// After a reset, on a line whose characters come with `line_baud`.
    pub const fn new(line_baud: u32) -> Self {
        Self {
            line_baud,
            status: RESET_STATUS,
            brr: 0,
            cr1: 0,
            cr3: 0,
            read_for_receive: 0,
            read_for_send: false,
            to_send: None,
            shifting: None,
            received: 0,
            receiver_since: None,
            idle_at: None,
            missed: 0,
            received_at: Ticks(0),
            longest_wait: Ticks(0),
        }
    }

    /// Characters that came while the receiver was off or began before it was on.
    pub const fn missed(&self) -> u64 {
        self.missed
    }

    /// The longest time from the end of a character on the line until the software fetched it from DR; where the next one
    /// was lost meanwhile it is longer than a character.
    pub const fn longest_wait(&self) -> Ticks {
        self.longest_wait
    }

    /// Offset of the data register.
    pub const DATA: u32 = 4 * DR as u32;

    /// Whether its receiver is on.
    pub const fn listens(&self) -> bool {
        self.receiver_since.is_some()
    }

    /// Baud rate by BRR; 0 without a divider.
    pub fn baud(&self, context: &Context<'_>) -> f64 {
        if self.brr == 0 {
            0.0
        } else {
            f64::from(context.clocks.apb1) / f64::from(self.brr)
        }
    }

    fn mismatch(&self, context: &Context<'_>) -> bool {
        (self.baud(context) / f64::from(self.line_baud) - 1.0).abs() > TOLERANCE
    }

    fn character(&self, context: &Context<'_>) -> Ticks {
        periods(CHARACTER_BITS * u64::from(self.brr), context.clocks.apb1)
    }

    fn update_interrupt(&self, context: &Context<'_>) {
        // The enables have their flags' positions, but for PEIE; RXNEIE serves ORE too.
        let mut asks = self.cr1 & self.status & (IDLEIE | RXNEIE | TCIE | TXEIE) != 0;
        asks |= self.cr1 & RXNEIE != 0 && self.status & ORE != 0;
        asks |= self.cr1 & PEIE != 0 && self.status & PE != 0;
        context.interrupts.set(IRQ, asks);
    }

    fn shift_next(&mut self, begin: Ticks, context: &Context<'_>) {
        if let Some(byte) = self.to_send.take() {
            self.status |= TXE;
            self.shifting = Some((Shifting::Byte(byte), begin + self.character(context)));
        }
    }

    /// A character on the line begins before it has been idle for a frame; may be called as soon as that is known.
    /// Without this call a gap between two characters, however short, raises IDLE.
    pub fn start_bit(&mut self) {
        self.idle_at = None;
    }

    /// A character from the line. `at`: the end of its stop bit.
    pub fn receive(&mut self, character: Character, at: Ticks, context: &mut Context<'_>) {
        self.advance(context);
        let line_character = periods(CHARACTER_BITS, self.line_baud);
        if self
            .receiver_since
            .is_none_or(|since| at.since(line_character) < since)
        {
            self.missed += 1;
            return;
        }
        let character = if self.mismatch(context) {
            self.sample_at_own_rate(character, context)
        } else {
            character
        };
        self.idle_at = Some(at + self.character(context));
        if self.status & RXNE != 0 {
            // The one in DR stays, this one is lost.
            self.status |= ORE;
        } else {
            let parity = even_parity(character.byte) ^ character.parity_error;
            self.received = u16::from(character.byte) | u16::from(parity) << 8;
            self.status |= RXNE;
            self.received_at = at;
            for (bit, set) in [
                (PE, character.parity_error),
                (FE, character.framing_error),
                (NF, character.noise),
            ] {
                if set {
                    self.status |= bit;
                }
            }
        }
        self.update_interrupt(context);
    }

    /// What a receiver of another rate takes from a character: the middle of each of its own bits.
    fn sample_at_own_rate(&self, character: Character, context: &Context<'_>) -> Character {
        let parity = even_parity(character.byte) ^ character.parity_error;
        // Start, data, parity, stop, and the idle line after it.
        let bits = u32::from(character.byte) << 1
            | u32::from(parity) << 9
            | u32::from(!character.framing_error) << 10
            | !0 << 11;
        let ratio = f64::from(self.line_baud) / self.baud(context).max(1.0);
        let sample = |bit: u32| {
            let at = ((f64::from(bit) + 0.5) * ratio) as u32;
            bits >> at.min(31) & 1 != 0
        };
        let byte = (0..8).fold(0, |byte, bit| byte | u8::from(sample(bit + 1)) << bit);
        Character {
            byte,
            parity_error: sample(9) != even_parity(byte),
            framing_error: true,
            noise: character.noise,
        }
    }

    fn write_cr1(&mut self, value: u16, context: &Context<'_>) -> Result<(), Unmodelled> {
        REGISTERS.refuse(CR1, value, CR1_REFUSED)?;
        let on = value & UE != 0 && value & (RE | TE) != 0;
        if on && value & (M | PCE | PS) != M | PCE {
            return Err(REGISTERS.unmodelled(CR1, "a format other than 8E1"));
        }
        if on && self.brr < 16 {
            return Err(REGISTERS.unmodelled(BRR, format!("a divider of {}/16", self.brr)));
        }
        let sends = |cr1: u16| cr1 & (UE | TE) == UE | TE;
        let hears = |cr1: u16| cr1 & (UE | RE) == UE | RE;
        if !sends(value) && self.shifting.is_some() {
            return Err(REGISTERS.unmodelled(CR1, "the transmitter off during a character"));
        }
        if sends(value) && !sends(self.cr1) {
            self.shifting = Some((Shifting::Idle, context.now + self.character(context)));
        }
        if hears(value) != hears(self.cr1) {
            self.receiver_since = hears(value).then_some(context.now);
            self.idle_at = None;
        }
        self.cr1 = value;
        Ok(())
    }

    fn write_dr(&mut self, value: u16, context: &Context<'_>) -> Result<(), Unmodelled> {
        if self.cr1 & (UE | TE) != UE | TE {
            return Err(REGISTERS.unmodelled(DR, "written while the transmitter is off"));
        }
        if self.mismatch(context) {
            return Err(REGISTERS.unmodelled(
                DR,
                format!(
                    "a character of {:.0} baud on a line of {} baud",
                    self.baud(context),
                    self.line_baud
                ),
            ));
        }
        if std::mem::take(&mut self.read_for_send) {
            self.status &= !TC;
        }
        // Parity takes the place of the ninth bit; a byte that still waits is overwritten.
        self.to_send = Some(value.to_le_bytes()[0]);
        self.status &= !TXE;
        if self.shifting.is_none() {
            self.shift_next(context.now, context);
        }
        Ok(())
    }
}

fn even_parity(byte: u8) -> bool {
    !byte.count_ones().is_multiple_of(2)
}

impl Peripheral for Usart {
    fn read(
        &mut self,
        offset: u32,
        bytes: u8,
        context: &mut Context<'_>,
    ) -> Result<u32, Unmodelled> {
        let index = REGISTERS.index(offset, bytes)?;
        self.advance(context);
        let value = match index {
            SR => {
                self.read_for_receive = self.status;
                self.read_for_send = true;
                self.status
            }
            DR => {
                if self.status & RXNE != 0 {
                    let wait = context.now.since(self.received_at);
                    self.longest_wait = self.longest_wait.max(wait);
                }
                self.status &= !RXNE;
                let shown = std::mem::take(&mut self.read_for_receive);
                self.status &= !(shown & (PE | FE | NF | ORE | IDLE));
                self.received
            }
            BRR => self.brr,
            CR1 => self.cr1,
            CR3 => self.cr3,
            // CR2 and GTPR take no other value.
            _ => 0,
        };
        self.update_interrupt(context);
        Ok(u32::from(value))
    }

    fn write(
        &mut self,
        offset: u32,
        bytes: u8,
        value: u32,
        context: &mut Context<'_>,
    ) -> Result<(), Unmodelled> {
        let index = REGISTERS.index(offset, bytes)?;
        let value = REGISTERS.value(index, value)?;
        self.advance(context);
        match index {
            // TC and RXNE are cleared by a 0, the others by their sequences.
            SR => self.status &= value | !(TC | RXNE),
            DR => self.write_dr(value, context)?,
            BRR => {
                if self.shifting.is_some() {
                    return Err(REGISTERS.unmodelled(BRR, "written during a character"));
                }
                self.brr = value;
            }
            CR1 => self.write_cr1(value, context)?,
            CR3 => {
                REGISTERS.refuse(CR3, value, &[(!EIE, "a bit other than EIE")])?;
                self.cr3 = value;
            }
            CR2 | GTPR if value == 0 => {}
            _ => return Err(REGISTERS.unmodelled(index, format!("{value:#06x} written"))),
        }
        self.update_interrupt(context);
        Ok(())
    }

    fn next_event(&self) -> Option<Ticks> {
        let sent = self.shifting.map(|(_, end)| end);
        [sent, self.idle_at].into_iter().flatten().min()
    }

    fn advance(&mut self, context: &mut Context<'_>) {
        while let Some((done, end)) = self.shifting.filter(|(_, end)| *end <= context.now) {
            self.shifting = None;
            if let Shifting::Byte(byte) = done {
                context.outside.uart_sent(byte, context.now);
            }
            self.shift_next(end, context);
            if self.shifting.is_none() && done != Shifting::Idle {
                self.status |= TC;
            }
        }
        if self.idle_at.is_some_and(|at| at <= context.now) {
            self.idle_at = None;
            self.status |= IDLE;
        }
        self.update_interrupt(context);
    }

    fn reset(&mut self, context: &mut Context<'_>) {
        *self = Self {
            missed: self.missed,
            longest_wait: self.longest_wait,
            ..Self::new(self.line_baud)
        };
        self.update_interrupt(context);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

    use proptest::prelude::*;

    use super::super::bench::Bench;
    use super::*;

    const SR: u32 = 0x00;
    const DR: u32 = 0x04;
    const BRR: u32 = 0x08;
    const CR1: u32 = 0x0C;
    const CR3: u32 = 0x14;
    const LISTENING: u32 = (UE | M | PCE | TE | RE | RXNEIE) as u32;
    /// 365/16 bits of 42 MHz: eleven of them in units of 1/336 µs.
    const CHARACTER: Ticks = Ticks(11 * 365 * 8);

    /// Set up as the image has it, the idle frame over.
    fn port() -> Bench<Usart> {
        let mut bench = Bench::new(Usart::new(115_200));
        bench.write(BRR, 365);
        bench.write(CR1, LISTENING);
        bench.run(Ticks::from_millis(1));
        bench
    }

    fn hear(bench: &mut Bench<Usart>, character: Character) {
        let at = bench.now;
        bench.with(|usart, context| usart.receive(character, at, context));
    }

    #[test]
    fn reset_values_are_the_manual_s() {
        let mut bench = Bench::new(Usart::new(115_200));
        assert_eq!(bench.read(SR), 0xC0);
        for offset in [BRR, CR1, 0x10, CR3, 0x18] {
            assert_eq!(bench.read(offset), 0);
        }
        let mut used = port();
        used.with(|usart, context| usart.reset(context));
        assert_eq!(used.read(CR1), 0);
        assert_eq!(used.read(SR), 0xC0);
        assert!(!used.interrupts.is_asserted(38));
    }

    #[test]
    fn a_character_takes_eleven_bits() {
        let mut bench = port();
        let start = bench.now;
        assert_eq!(bench.read(SR), u32::from(TC | TXE));
        bench.write(DR, 0x155);
        // TC goes with the write that follows SR, the buffer is free at once.
        assert_eq!(bench.read(SR), u32::from(TXE));
        bench.run(Ticks(CHARACTER.0 - 1));
        assert!(bench.world.uart.is_empty());
        bench.run(Ticks(1));
        assert_eq!(bench.read(SR), u32::from(TC | TXE));
        assert_eq!(bench.world.uart, [(0x55, start + CHARACTER)]);
        // 11 bits of 42 MHz / 365 = 115,068 baud: 95.6 µs.
        assert!((CHARACTER.micros() - 95.595).abs() < 0.001);
    }

    #[test]
    fn the_buffer_bridges_two_characters() {
        let mut bench = port();
        let start = bench.now;
        bench.read(SR);
        bench.write(DR, 1);
        bench.write(DR, 2);
        assert_eq!(bench.read(SR), 0);
        bench.run(CHARACTER);
        assert_eq!(bench.read(SR), u32::from(TXE));
        bench.run(CHARACTER);
        assert_eq!(bench.read(SR), u32::from(TXE | TC));
        assert_eq!(
            bench.world.uart,
            [(1, start + CHARACTER), (2, start + CHARACTER + CHARACTER)]
        );
    }

    #[test]
    fn tc_needs_its_sequence_or_a_zero() {
        let mut bench = port();
        // DR without SR: TC stays (30.6.1).
        bench.write(DR, 1);
        assert_eq!(bench.read(SR), u32::from(TXE | TC));
        bench.write(SR, !u32::from(TC) & 0xFFFF);
        assert_eq!(bench.read(SR), u32::from(TXE));
        bench.run(CHARACTER);
        assert_eq!(bench.read(SR), u32::from(TXE | TC));
    }

    #[test]
    fn an_idle_frame_precedes_the_first_character() {
        let mut bench = Bench::new(Usart::new(115_200));
        bench.write(BRR, 365);
        bench.write(CR1, LISTENING);
        bench.write(DR, 7);
        assert_eq!(bench.read(SR) & u32::from(TXE), 0);
        bench.run(Ticks::from_millis(1));
        assert_eq!(bench.world.uart, [(7, CHARACTER + CHARACTER)]);
        // The transmitter stays on from one CR1 value of the image to the other: no second idle frame.
        let start = bench.now;
        bench.write(CR1, u32::from(UE | M | PCE | TE | TXEIE));
        bench.write(DR, 8);
        bench.run(CHARACTER);
        assert_eq!(bench.world.uart[1], (8, start + CHARACTER));
    }

    #[test]
    fn received_characters_show_parity_and_faults() {
        for byte in 0..=255_u8 {
            for faults in 0..8_u8 {
                let mut bench = port();
                let character = Character {
                    byte,
                    parity_error: faults & 1 != 0,
                    framing_error: faults & 2 != 0,
                    noise: faults & 4 != 0,
                };
                hear(&mut bench, character);
                assert!(bench.interrupts.is_asserted(38));
                assert_eq!(
                    bench.read(SR),
                    u32::from(TXE | TC | RXNE) | u32::from(faults)
                );
                let parity = (byte.count_ones() + u32::from(faults & 1)) % 2;
                assert_eq!(bench.read(DR), u32::from(byte) | parity << 8);
                assert_eq!(bench.read(SR), u32::from(TXE | TC));
                assert!(!bench.interrupts.is_asserted(38));
            }
        }
    }

    #[test]
    fn error_flags_need_sr_before_dr() {
        let mut bench = port();
        bench.write(DR, 0);
        // The write that clears TC leaves the receive half of the sequence alone and the other way round.
        bench.read(DR);
        hear(
            &mut bench,
            Character {
                noise: true,
                ..Character::good(1)
            },
        );
        bench.read(DR);
        assert_eq!(bench.read(SR) & u32::from(NF | RXNE), u32::from(NF));
        bench.read(DR);
        assert_eq!(bench.read(SR) & u32::from(NF), 0);
    }

    #[test]
    fn an_overrun_keeps_the_first_character() {
        let mut bench = port();
        hear(&mut bench, Character::good(1));
        bench.peripheral.start_bit();
        bench.run(CHARACTER);
        hear(&mut bench, Character::good(2));
        let both = u32::from(TXE | TC | RXNE | ORE);
        assert_eq!(bench.read(SR), both);
        assert_eq!(bench.read(DR) & 0xFF, 1);
        assert_eq!(bench.read(SR), u32::from(TXE | TC));
        bench.run(CHARACTER);
        hear(&mut bench, Character::good(3));
        assert_eq!(bench.read(DR) & 0xFF, 3);
        // ORE alone asks for the interrupt of RXNEIE.
        hear(&mut bench, Character::good(4));
        hear(&mut bench, Character::good(5));
        bench.write(SR, !u32::from(RXNE) & 0xFFFF);
        assert!(bench.interrupts.is_asserted(38));
    }

    #[test]
    fn an_overrun_between_the_two_reads_stays() {
        let mut bench = port();
        hear(&mut bench, Character::good(1));
        assert_eq!(bench.read(SR) & u32::from(RXNE | ORE), u32::from(RXNE));
        bench.run(CHARACTER);
        hear(&mut bench, Character::good(2));
        assert_eq!(bench.read(DR) & 0xFF, 1);
        assert!(bench.interrupts.is_asserted(38));
        assert_eq!(bench.read(SR) & u32::from(RXNE | ORE), u32::from(ORE));
        bench.read(DR);
        assert_eq!(bench.read(SR) & u32::from(RXNE | ORE), 0);
    }

    #[test]
    fn a_receiver_that_is_off_hears_nothing() {
        let mut bench = port();
        bench.write(CR1, u32::from(UE | M | PCE | TE));
        hear(&mut bench, Character::good(1));
        assert_eq!(bench.read(SR) & u32::from(RXNE), 0);
        bench.write(CR1, LISTENING);
        // Begun before the receiver was on.
        bench.run(Ticks::from_micros(90));
        hear(&mut bench, Character::good(2));
        assert_eq!(bench.read(SR) & u32::from(RXNE), 0);
        assert_eq!(bench.peripheral.missed(), 2);
        bench.run(Ticks::from_micros(96));
        hear(&mut bench, Character::good(3));
        assert_eq!(bench.read(DR) & 0xFF, 3);
    }

    #[test]
    fn idle_follows_a_frame_of_silence_once() {
        let mut bench = port();
        bench.write(CR1, LISTENING & !u32::from(RXNEIE) | u32::from(IDLEIE));
        assert_eq!(bench.read(SR) & u32::from(IDLE), 0);
        bench.run(Ticks::from_millis(1));
        hear(&mut bench, Character::good(1));
        bench.read(DR);
        bench.run(Ticks(CHARACTER.0 - 1));
        assert_eq!(bench.read(SR) & u32::from(IDLE), 0);
        bench.run(Ticks(1));
        assert!(bench.interrupts.is_asserted(38));
        assert_ne!(bench.read(SR) & u32::from(IDLE), 0);
        bench.read(DR);
        bench.run(Ticks::from_millis(1));
        assert_eq!(bench.read(SR) & u32::from(IDLE), 0);
        // A start bit within the frame keeps it away.
        hear(&mut bench, Character::good(1));
        bench.run(Ticks(CHARACTER.0 / 2));
        bench.peripheral.start_bit();
        bench.run(CHARACTER);
        assert_eq!(bench.read(SR) & u32::from(IDLE), 0);
    }

    #[test]
    fn another_rate_gives_framing_errors() {
        // 42 MHz / 354 is 3.0 % fast, /353 3.3 %; /375 2.8 % slow, /376 3.04 %.
        for (divider, good) in [
            (355, true),
            (353, false),
            (375, true),
            (376, false),
            (2_188, false),
        ] {
            let mut bench = port();
            bench.write(BRR, divider);
            hear(&mut bench, Character::good(0x42));
            let status = bench.read(SR);
            assert_eq!(status & u32::from(FE) == 0, good, "divider {divider}");
            if good {
                assert_eq!(bench.read(DR) & 0xFF, 0x42);
            } else {
                assert!(bench.try_write(DR, 1).is_err());
            }
        }
        // At a sixth of the rate the first data bit is taken after nine bits of the line: parity or stop.
        let mut slow = port();
        slow.write(BRR, 365 * 6);
        hear(&mut slow, Character::good(0));
        assert_eq!(slow.read(DR) & 0xFE, 0xFE);
    }

    #[test]
    fn interrupts_are_levels_of_flags_and_enables() {
        let mut bench = port();
        let on = u32::from(UE | M | PCE | TE | RE);
        for (enable, asked) in [(TXEIE, true), (TCIE, true), (RXNEIE, false), (PEIE, false)] {
            bench.write(CR1, on | u32::from(enable));
            assert_eq!(bench.interrupts.is_asserted(38), asked);
        }
        bench.write(CR1, on | u32::from(TCIE));
        bench.read(SR);
        bench.write(DR, 1);
        assert!(!bench.interrupts.is_asserted(38));
        bench.run(CHARACTER);
        assert!(bench.interrupts.is_asserted(38));
        bench.write(CR1, on | u32::from(PEIE));
        hear(
            &mut bench,
            Character {
                parity_error: true,
                ..Character::good(1)
            },
        );
        assert!(bench.interrupts.is_asserted(38));
        // Without DMA the error interrupt enable does nothing.
        bench.write(CR1, on);
        bench.write(CR3, 1);
        hear(&mut bench, Character::good(1));
        assert_ne!(bench.read(SR) & u32::from(ORE), 0);
        assert!(!bench.interrupts.is_asserted(38));
    }

    #[test]
    fn what_is_missing_is_an_error() {
        for bit in [0, 1, 11, 14, 15] {
            assert!(port().try_write(CR1, LISTENING | 1 << bit).is_err());
        }
        // 8O1, 8N1, 9N1, 7E1.
        for format in [M | PCE | PS, 0, M, PCE] {
            let mut bench = port();
            let value = LISTENING & !u32::from(M | PCE | PS) | u32::from(format);
            assert!(bench.try_write(CR1, value).is_err());
        }
        assert!(port().try_write(0x10, 0x2000).is_err());
        assert!(port().try_write(0x10, 0).is_ok());
        for bit in 1..16 {
            assert!(port().try_write(CR3, 1 << bit).is_err());
        }
        assert!(port().try_write(0x18, 1).is_err());
        assert!(port().try_read(0x1C).is_err());
        let mut sending = port();
        sending.write(DR, 1);
        assert!(sending.try_write(BRR, 364).is_err());
        assert!(sending.try_write(CR1, LISTENING & !u32::from(TE)).is_err());
        let mut off = Bench::new(Usart::new(115_200));
        assert!(off.try_write(DR, 1).is_err());
        assert!(off.try_write(CR1, LISTENING).is_err());
    }

    proptest! {
        /// However the software's looks fall between the characters, those it reads in time come in order and once, and
        /// what it sends comes out in order, once and without overlap.
        #[test]
        fn characters_come_and_go_in_order_and_once(
            sent in prop::collection::vec(any::<u8>(), 1..40),
            heard in prop::collection::vec(any::<u8>(), 1..40),
            pauses in prop::collection::vec(1_u64..30_000, 1..50),
        ) {
            let mut bench = port();
            let mut pauses = pauses.iter().cycle();
            let mut next_heard = bench.now + CHARACTER;
            let (mut arrived, mut written, mut got) = (0, 0, Vec::new());
            while got.len() < heard.len() || bench.world.uart.len() < sent.len() {
                let status = bench.read(SR);
                prop_assert_eq!(status & u32::from(ORE), 0);
                if status & u32::from(RXNE) != 0 {
                    got.push(bench.read(DR) as u8);
                }
                if status & u32::from(TXE) != 0 && written < sent.len() {
                    bench.write(DR, u32::from(sent[written]));
                    written += 1;
                }
                let end = bench.now + Ticks(*pauses.next().unwrap());
                if arrived < heard.len() && next_heard <= end {
                    let pause = next_heard.since(bench.now);
                    bench.run(pause);
                    hear(&mut bench, Character::good(heard[arrived]));
                    arrived += 1;
                    next_heard += CHARACTER;
                }
                let rest = end.since(bench.now);
                bench.run(rest);
            }
            prop_assert_eq!(got, heard);
            let out: Vec<_> = bench.world.uart.iter().map(|(byte, _)| *byte).collect();
            prop_assert_eq!(out, sent);
            for pair in bench.world.uart.windows(2) {
                prop_assert!(pair[1].1.since(pair[0].1) >= CHARACTER);
            }
        }
    }
}
