//! General-purpose I/Os (RM0090, section 8), ports A, B and C.

use super::word::{check_width, merge, only_bits, part, unknown, unmodelled};
use super::{Context, Peripheral, Unmodelled};
use crate::outside::{DrivenLevels, Outputs, PORTS, Pin};
use crate::time::Ticks;

/// Distance of two ports' registers.
pub const PORT_STRIDE: u32 = 0x400;

/// Input data register.
const IDR: u32 = 0x10;

/// What MODER makes of a pin.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// Input.
    Input = 0b00,
    /// General-purpose output.
    Output = 0b01,
    /// A peripheral's.
    Alternate = 0b10,
    /// Off for all digital use.
    Analog = 0b11,
}

impl Mode {
    /// In words.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Input => "input",
            Self::Output => "output",
            Self::Alternate => "alternate function",
            Self::Analog => "analogue",
        }
    }
}

/// One port.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Port {
    moder: u32,
    otyper: u16,
    ospeedr: u32,
    pupdr: u32,
    odr: u16,
    afr: [u32; 2],
}

impl Port {
    /// Reset values: PA13, PA14, PA15, PB3 and PB4 belong to the debug port (RM0090, 8.3.1 and register descriptions).
    const fn reset(port: usize) -> Self {
        let (moder, ospeedr, pupdr) = match port {
            0 => (0xA800_0000, 0x0C00_0000, 0x6400_0000),
            1 => (0x0000_0280, 0x0000_00C0, 0x0000_0100),
            _ => (0, 0, 0),
        };
        Self {
            moder,
            otyper: 0,
            ospeedr,
            pupdr,
            odr: 0,
            afr: [0; 2],
        }
    }

    /// The pins whose two-bit field in `register` is `value`.
    const fn pins_with(register: u32, value: u8) -> u16 {
        let equal = !(register ^ (value as u32 * 0x5555_5555));
        // One bit per pin, at the even places; then the even places close up.
        let mut pins = equal & equal >> 1 & 0x5555_5555;
        pins = (pins | pins >> 1) & 0x3333_3333;
        pins = (pins | pins >> 2) & 0x0F0F_0F0F;
        pins = (pins | pins >> 4) & 0x00FF_00FF;
        (pins | pins >> 8) as u16
    }

    fn outputs(&self) -> u16 {
        Self::pins_with(self.moder, Mode::Output as u8)
    }

    /// The pins that are driven from inside, high and low.
    fn drives(&self) -> (u16, u16) {
        let outputs = self.outputs();
        (outputs & self.odr & !self.otyper, outputs & !self.odr)
    }

    /// Pins where inside and outside drive against each other.
    ///
    /// An open-drain output is none of them: its low against a high is what a pull-up looks like.
    fn conflict(&self, driven: u16, level: u16) -> u16 {
        let (high, low) = self.drives();
        driven & (high & !level | low & level & !self.otyper)
    }

    fn input(&self, driven: u16, level: u16) -> u16 {
        let (high, low) = self.drives();
        let pulled_up = Self::pins_with(self.pupdr, 0b01);
        let undriven = !driven & !high & !low;
        // A low wins: over a pull-up, and over the high of a conflict, whose real level nobody knows.
        let pins = (high | driven & level | undriven & pulled_up) & !low & !(driven & !level);
        pins & !Self::pins_with(self.moder, Mode::Analog as u8)
    }

    fn write(&mut self, offset: u32, bytes: u8, value: u32) -> Result<(), Unmodelled> {
        let register = offset & !3;
        let merged = |word: u32| merge(word, offset, bytes, value);
        let half = |name: &str, word: u16| {
            let written = merged(u32::from(word));
            only_bits(name, written, 0xFFFF)?;
            Ok(u16::try_from(written).unwrap_or(0))
        };
        match register {
            0x00 => self.moder = merged(self.moder),
            0x04 => self.otyper = half("GPIO_OTYPER", self.otyper)?,
            0x08 => self.ospeedr = merged(self.ospeedr),
            0x0C => {
                let pupdr = merged(self.pupdr);
                if Self::pins_with(pupdr, 0b11) != 0 {
                    return Err(unmodelled("GPIO_PUPDR", "3 for a pin (reserved)"));
                }
                self.pupdr = pupdr;
            }
            0x14 => self.odr = half("GPIO_ODR", self.odr)?,
            0x18 => {
                let [set_low, set_high, clear_low, clear_high] = merged(0).to_le_bytes();
                let set = u16::from_le_bytes([set_low, set_high]);
                let clear = u16::from_le_bytes([clear_low, clear_high]);
                // "If both BSx and BRx are set, BSx has priority."
                self.odr = self.odr & !clear | set;
            }
            0x20 => self.afr[0] = merged(self.afr[0]),
            0x24 => self.afr[1] = merged(self.afr[1]),
            IDR => return Err(unmodelled("GPIO_IDR", "write")),
            0x1C => return Err(unmodelled("GPIO_LCKR", "write")),
            _ => return Err(unknown("GPIO", register, "write")),
        }
        Ok(())
    }

    /// Every register but IDR.
    fn read(&self, register: u32) -> Result<u32, Unmodelled> {
        Ok(match register {
            0x00 => self.moder,
            0x04 => u32::from(self.otyper),
            0x08 => self.ospeedr,
            0x0C => self.pupdr,
            0x14 => u32::from(self.odr),
            // Write-only: reads as 0.
            0x18 => 0,
            0x20 => self.afr[0],
            0x24 => self.afr[1],
            0x1C => return Err(unmodelled("GPIO_LCKR", "read")),
            _ => return Err(unknown("GPIO", register, "read")),
        })
    }
}

/// Ports A, B and C; their registers follow one another at [`PORT_STRIDE`].
///
/// The level of a pin in alternate mode is what the outside drives, or its pull: what the MCU's own peripheral puts on it
/// is not seen. A pin that nothing drives or pulls reads low. Of the output speed only the fastest clock is modelled
/// ([`GpioPorts::fastest_hz`]), which the bus holds the SPI masters to. Not modelled: the configuration lock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GpioPorts {
    ports: [Port; PORTS],
    conflicts: [u16; PORTS],
}

impl Default for GpioPorts {
    fn default() -> Self {
        Self::new()
    }
}

impl GpioPorts {
    /// After reset.
    pub fn new() -> Self {
        Self {
            ports: std::array::from_fn(Port::reset),
            conflicts: [0; PORTS],
        }
    }

    /// What is driven as general-purpose output.
    pub fn outputs(&self) -> Outputs {
        Outputs {
            enabled: self.ports.map(|port| port.outputs()),
            level: self.ports.map(|port| port.odr),
            open_drain: self.ports.map(|port| port.otyper),
        }
    }

    /// The two bits of a pin in a register of such fields.
    const fn field(register: u32, pin: Pin) -> u32 {
        register >> (2 * pin.number) & 3
    }

    /// The mode of a pin.
    pub const fn mode(&self, pin: Pin) -> Mode {
        match Self::field(self.ports[pin.port as usize].moder, pin) {
            0b00 => Mode::Input,
            0b01 => Mode::Output,
            0b10 => Mode::Alternate,
            _ => Mode::Analog,
        }
    }

    /// The alternate function of a pin, 0 … 15; `None` if it is not in alternate mode.
    pub fn alternate(&self, pin: Pin) -> Option<u8> {
        let afr = self.ports[usize::from(pin.port)].afr[usize::from(pin.number / 8)];
        (self.mode(pin) == Mode::Alternate).then_some((afr >> (4 * (pin.number % 8)) & 0xF) as u8)
    }

    /// Whether an output of a pin, general-purpose or a peripheral's, only pulls low.
    pub const fn is_open_drain(&self, pin: Pin) -> bool {
        self.ports[pin.port as usize].otyper & pin.bit() != 0
    }

    /// Whether a pin's pull-up or pull-down is on.
    pub const fn is_pulled(&self, pin: Pin) -> bool {
        Self::field(self.ports[pin.port as usize].pupdr, pin) != 0
    }

    /// The fastest clock that an output of this speed follows (STM32F405 data sheet, I/O AC characteristics, 2.7 … 3.6 V
    /// and 50, 50, 40 and 30 pF; *assumed* until it has been compared with the newest revision).
    pub fn fastest_hz(&self, pin: Pin) -> u64 {
        let ospeedr = self.ports[usize::from(pin.port)].ospeedr;
        [4_000_000, 25_000_000, 50_000_000, 100_000_000][Self::field(ospeedr, pin) as usize]
    }

    /// The levels that IDR and EXTI see; notes where inside and outside drive against each other.
    pub fn input_levels(&mut self, outside: &DrivenLevels) -> [u16; PORTS] {
        for (port, conflict) in self.conflicts.iter_mut().enumerate() {
            *conflict |= self.ports[port].conflict(outside.driven[port], outside.level[port]);
        }
        std::array::from_fn(|port| {
            self.ports[port].input(outside.driven[port], outside.level[port])
        })
    }

    /// Takes the pins that were driven from both sides, to different levels, since the last call.
    pub fn take_conflicts(&mut self) -> [u16; PORTS] {
        std::mem::take(&mut self.conflicts)
    }

    /// Reset of one port (`RCC_AHB1RSTR`).
    pub const fn reset_port(&mut self, port: usize) {
        self.ports[port] = Port::reset(port);
    }

    /// Port and register of an offset from port A's base.
    fn place(offset: u32) -> Result<(usize, u32), Unmodelled> {
        usize::try_from(offset / PORT_STRIDE)
            .ok()
            .filter(|port| *port < PORTS)
            .map(|port| (port, offset % PORT_STRIDE))
            .ok_or_else(|| unknown("GPIO", offset, "port"))
    }

    fn named(port: usize, refused: Unmodelled) -> Unmodelled {
        let letter = ["A", "B", "C"][port];
        Unmodelled {
            register: refused
                .register
                .replacen("GPIO", &format!("GPIO{letter}"), 1),
            ..refused
        }
    }
}

/// `offset` counts from port A's base, 0x4002_0000. The bus compares [`GpioPorts::outputs`] after a write.
impl Peripheral for GpioPorts {
    fn read(
        &mut self,
        offset: u32,
        bytes: u8,
        context: &mut Context<'_>,
    ) -> Result<u32, Unmodelled> {
        let (port, within) = Self::place(offset)?;
        check_width("GPIO", within, bytes, 1)
            .and_then(|()| match within & !3 {
                IDR => {
                    let outside = context.outside.levels(context.now);
                    Ok(u32::from(self.input_levels(&outside)[port]))
                }
                register => self.ports[port].read(register),
            })
            .map(|word| part(word, within, bytes))
            .map_err(|refused| Self::named(port, refused))
    }

    fn write(
        &mut self,
        offset: u32,
        bytes: u8,
        value: u32,
        _context: &mut Context<'_>,
    ) -> Result<(), Unmodelled> {
        let (port, within) = Self::place(offset)?;
        check_width("GPIO", within, bytes, 1)
            .and_then(|()| self.ports[port].write(within, bytes, value))
            .map_err(|refused| Self::named(port, refused))
    }

    fn next_event(&self) -> Option<Ticks> {
        None
    }

    fn advance(&mut self, _context: &mut Context<'_>) {}

    fn reset(&mut self, _context: &mut Context<'_>) {
        self.ports = std::array::from_fn(Port::reset);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

    use proptest::prelude::*;

    use super::super::test_world::World;
    use super::*;

    const MODER: u32 = 0x00;
    const OTYPER: u32 = 0x04;
    const PUPDR: u32 = 0x0C;
    const ODR: u32 = 0x14;
    const BSRR: u32 = 0x18;
    const B: u32 = PORT_STRIDE;
    const C: u32 = 2 * PORT_STRIDE;

    #[test]
    fn reset_values_are_the_manuals() {
        let mut world = World::default();
        let mut gpio = GpioPorts::new();
        let rows = [
            (0, [0xA800_0000, 0, 0x0C00_0000, 0x6400_0000]),
            (B, [0x0000_0280, 0, 0x0000_00C0, 0x0000_0100]),
            (C, [0; 4]),
        ];
        for (base, values) in rows {
            for (offset, value) in (0..).step_by(4).zip(values) {
                assert_eq!(world.read(&mut gpio, base + offset), value);
            }
            for offset in [ODR, BSRR, 0x20, 0x24] {
                assert_eq!(world.read(&mut gpio, base + offset), 0);
            }
        }
        // JTMS/SWDIO, JTCK/SWCLK, JTDI, JTDO and NJTRST are AF0 after reset.
        for (port, number) in [('A', 13), ('A', 14), ('A', 15), ('B', 3), ('B', 4)] {
            assert_eq!(gpio.alternate(Pin::new(port, number)), Some(0));
        }
        assert_eq!(gpio.alternate(Pin::new('A', 12)), None);
        assert_eq!(gpio.outputs(), Outputs::default());
        // SWDIO, JTDI and NJTRST are pulled up, SWCLK is pulled down.
        assert_eq!(world.read(&mut gpio, IDR), 0xA000);
        assert_eq!(world.read(&mut gpio, B + IDR), 0x0010);
    }

    #[test]
    fn fields_are_found_by_pin() {
        for pin in 0..16 {
            for value in 0..4_u8 {
                let register = u32::from(value) << (2 * pin);
                assert_eq!(Port::pins_with(register, value) >> pin & 1, 1);
                for other in (0..4).filter(|other| *other != value) {
                    assert_eq!(Port::pins_with(register, other) >> pin & 1, 0);
                }
                assert_eq!(
                    Port::pins_with(register, 0).count_ones(),
                    15 + u32::from(value == 0)
                );
            }
        }
    }

    #[test]
    fn set_wins_over_clear_and_halves_are_their_own() {
        let mut world = World::default();
        let mut gpio = GpioPorts::new();
        world.write(&mut gpio, B + BSRR, 0x0003_0005);
        assert_eq!(world.read(&mut gpio, B + ODR), 0x0005);
        gpio.write(B + BSRR, 2, 0x8000, &mut world.context())
            .unwrap();
        gpio.write(B + BSRR + 2, 2, 0x0004, &mut world.context())
            .unwrap();
        gpio.write(B + BSRR + 1, 1, 0x01, &mut world.context())
            .unwrap();
        assert_eq!(world.read(&mut gpio, B + ODR), 0x8101);
        assert_eq!(world.read(&mut gpio, B + BSRR), 0);
        assert_eq!(world.read(&mut gpio, ODR), 0, "port A is another one");
    }

    #[test]
    fn alternate_functions_by_pin() {
        let mut world = World::default();
        let mut gpio = GpioPorts::new();
        world.write(&mut gpio, MODER, 0b10 << 4 | 0b10 << 22);
        world.write(&mut gpio, 0x20, 7 << 8);
        world.write(&mut gpio, 0x24, 9 << 12);
        assert_eq!(gpio.alternate(Pin::new('A', 2)), Some(7));
        assert_eq!(gpio.alternate(Pin::new('A', 11)), Some(9));
        assert_eq!(gpio.alternate(Pin::new('A', 3)), None);
    }

    #[test]
    fn inputs_follow_outside_then_pull() {
        let mut world = World::default();
        let mut gpio = GpioPorts::new();
        let pins = [Pin::new('C', 4), Pin::new('C', 6), Pin::new('C', 0)];
        // PC4 pull-up, PC6 pull-down, PC0 analogue.
        world.write(&mut gpio, C + PUPDR, 0b01 << 8 | 0b10 << 12);
        world.write(&mut gpio, C + MODER, 0b11);
        assert_eq!(
            pins.map(|pin| gpio.mode(pin)),
            [Mode::Input, Mode::Input, Mode::Analog]
        );
        assert_eq!(world.read(&mut gpio, C + IDR), 1 << 4);
        for pin in pins {
            world.pins.levels.set(pin, Some(true));
        }
        assert_eq!(world.read(&mut gpio, C + IDR), 1 << 4 | 1 << 6);
        world.pins.levels.set(pins[0], Some(false));
        assert_eq!(world.read(&mut gpio, C + IDR), 1 << 6);
        assert_eq!(gpio.take_conflicts(), [0; PORTS]);
    }

    #[test]
    fn outputs_read_back_and_conflicts_are_noted() {
        let mut world = World::default();
        let mut gpio = GpioPorts::new();
        let pin = Pin::new('C', 8);
        world.write(&mut gpio, C + BSRR, 1 << 8);
        world.write(&mut gpio, C + MODER, 0b01 << 16);
        assert_eq!(gpio.outputs().driven(pin), Some(true));
        assert_eq!(world.read(&mut gpio, C + IDR), 1 << 8);
        world.pins.levels.set(pin, Some(true));
        assert_eq!(world.read(&mut gpio, C + IDR), 1 << 8);
        assert_eq!(gpio.take_conflicts(), [0; PORTS]);
        world.pins.levels.set(pin, Some(false));
        world.read(&mut gpio, C + IDR);
        assert_eq!(gpio.take_conflicts(), [0, 0, 1 << 8]);
        world.pins.levels.set(pin, Some(true));
        world.write(&mut gpio, C + BSRR, 1 << 24);
        world.read(&mut gpio, C + IDR);
        assert_eq!(gpio.take_conflicts(), [0, 0, 1 << 8]);
    }

    #[test]
    fn open_drain_is_a_wired_and() {
        let mut world = World::default();
        let mut gpio = GpioPorts::new();
        let pin = Pin::new('B', 9);
        world.write(&mut gpio, B + OTYPER, 1 << 9);
        world.write(&mut gpio, B + MODER, 0b01 << 18);
        for (own, outside, seen) in [
            (true, true, true),
            (true, false, false),
            (false, true, false),
            (false, false, false),
        ] {
            world.write(&mut gpio, B + BSRR, if own { 1 << 9 } else { 1 << 25 });
            world.pins.levels.set(pin, Some(outside));
            assert_eq!(world.read(&mut gpio, B + IDR) >> 9 & 1 != 0, seen);
            assert_eq!(
                gpio.outputs().driven(pin),
                if own { None } else { Some(false) }
            );
        }
        assert_eq!(gpio.take_conflicts(), [0; PORTS]);
        // Let go of by everybody, the pull decides.
        world.pins.levels.set(pin, None);
        world.write(&mut gpio, B + BSRR, 1 << 9);
        assert_eq!(world.read(&mut gpio, B + IDR) >> 9 & 1, 0);
        world.write(&mut gpio, B + PUPDR, 0b01 << 18);
        assert_eq!(world.read(&mut gpio, B + IDR) >> 9 & 1, 1);
    }

    #[test]
    fn reset_of_a_port_is_its_own() {
        let mut world = World::default();
        let mut gpio = GpioPorts::new();
        world.write(&mut gpio, MODER, 0);
        world.write(&mut gpio, B + MODER, 0);
        gpio.reset_port(0);
        assert_eq!(world.read(&mut gpio, MODER), 0xA800_0000);
        assert_eq!(world.read(&mut gpio, B + MODER), 0);
    }

    #[test]
    fn what_is_missing_is_refused() {
        let mut world = World::default();
        let mut gpio = GpioPorts::new();
        assert!(world.refuses(&mut gpio, 0x1C, 0));
        assert!(world.refuses(&mut gpio, IDR, 0));
        assert!(world.refuses(&mut gpio, ODR, 0x1_0000));
        assert!(world.refuses(&mut gpio, PUPDR, 0b11));
        assert!(world.refuses(&mut gpio, 3 * PORT_STRIDE, 0));
        let refused = gpio.read(B + 0x1C, 4, &mut world.context()).unwrap_err();
        assert_eq!(refused.register, "GPIOB_LCKR");
    }

    proptest! {
        /// Any writes to BSRR: the data bits are what the last write for each pin asked for.
        #[test]
        fn bsrr_is_last_write_wins(writes in proptest::collection::vec(any::<u32>(), 1..20)) {
            let mut world = World::default();
            let mut gpio = GpioPorts::new();
            for value in &writes {
                world.write(&mut gpio, BSRR, *value);
            }
            for pin in 0..16 {
                let last = writes.iter().rev().find_map(|value| {
                    if value >> pin & 1 != 0 {
                        Some(1)
                    } else {
                        (value >> (pin + 16) & 1 != 0).then_some(0)
                    }
                });
                prop_assert_eq!(world.read(&mut gpio, ODR) >> pin & 1, last.unwrap_or(0));
            }
        }

        /// A pin that only the outside drives reads as driven, whatever mode but analogue it has.
        #[test]
        fn outside_decides_where_the_port_does_not(
            moder in any::<u32>(), odr in any::<u16>(), otyper in any::<u16>(), level in any::<u16>(),
        ) {
            let mut world = World::default();
            let mut gpio = GpioPorts::new();
            world.write(&mut gpio, C + OTYPER, u32::from(otyper));
            world.write(&mut gpio, C + ODR, u32::from(odr));
            world.write(&mut gpio, C + MODER, moder);
            let outside = DrivenLevels { driven: [0, 0, 0xFFFF], level: [0, 0, level] };
            let seen = gpio.input_levels(&outside)[2];
            let conflicts = gpio.take_conflicts()[2];
            for number in 0..16 {
                let pin = Pin { port: 2, number };
                let bit = |word: u16| word & pin.bit() != 0;
                match gpio.outputs().driven(pin) {
                    _ if gpio.mode(pin) == Mode::Analog => prop_assert!(!bit(seen)),
                    None => prop_assert_eq!(bit(seen), bit(level)),
                    Some(own) => {
                        prop_assert_eq!(bit(seen), own && bit(level));
                        prop_assert_eq!(bit(conflicts), own != bit(level) && !bit(otyper));
                    }
                }
            }
        }
    }
}
