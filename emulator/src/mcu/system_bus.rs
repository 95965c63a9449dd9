//! AHB and APB: which peripheral an address belongs to, and what of one peripheral another one sees.

use std::fmt;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use rsemu::core::error::BusError;
use rsemu::core::space::{MemAttrs, MemOps, MemResult};

use crate::board::{Board, pins};
use crate::can_bus::CanBus;
use crate::mcu::adc::Adc1;
use crate::mcu::exti::Exti;
use crate::mcu::flash_interface::FlashInterface;
use crate::mcu::gpio::GpioPorts;
use crate::mcu::i2c::I2c;
use crate::mcu::iwdg::Iwdg;
use crate::mcu::pin_mux::{self, Signal};
use crate::mcu::rcc::{PeripheralId, Rcc, ResetCause};
use crate::mcu::spi::Spi;
use crate::mcu::syscfg::Syscfg;
use crate::mcu::tim2::Tim2;
use crate::mcu::tim4::Tim4;
use crate::mcu::usart::Usart;
use crate::mcu::{Clocks, Context, Interrupts, Lines, Peripheral, Unmodelled};
use crate::outside::{Outputs, Outside, PORTS, Pin, SpiBus};
use crate::rs485_line::LineConfig;
use crate::time::Ticks;

/// Base of the peripherals' address range.
const BASE: u32 = 0x4000_0000;
/// Bit rate of the vehicle's bus.
const CAN_BIT_RATE: u32 = 500_000;
/// Up to here a pad of any speed brings SPI's clock back in time. *Assumed*: the errata sheet's table was not at hand.
const SLOW_APB_HZ: u32 = 25_000_000;
/// Beyond, the pad has to be one for this and more: high or very high speed.
const FEEDBACK_HZ: u64 = 50_000_000;

/// An access that ends the run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Failure {
    /// What was touched.
    pub access: Unmodelled,
}

/// The bus matrix with everything behind it.
pub struct SystemBus {
    /// Locked for each access: the core's trait wants `&self`.
    state: Mutex<State>,
    now: AtomicU64,
    next: AtomicU64,
    ticks_per_cycle: AtomicU64,
    touched: AtomicBool,
}

impl fmt::Debug for SystemBus {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("SystemBus")
    }
}

struct State {
    rcc: Rcc,
    flash: FlashInterface,
    gpio: GpioPorts,
    exti: Exti,
    syscfg: Syscfg,
    tim2: Tim2,
    tim4: Tim4,
    iwdg: Iwdg,
    adc1: Adc1,
    spi1: Spi,
    spi2: Spi,
    i2c1: I2c,
    usart2: Usart,
    can: CanBus,
    clocks: Clocks,
    interrupts: Interrupts,
    levels: [u16; PORTS],
    outputs: Outputs,
    reset: Option<ResetCause>,
    failure: Option<Failure>,
    poll: Poll,
    board: Board,
}

/// The counter that bounded waits look at between two looks at a flag: TIM2_CNT.
const TIME_COUNTER: u32 = 0x4000_0024;
/// So many equal turns make a polling loop.
const EQUAL_TURNS: u8 = 3;

/// A loop that reads the same register again and again, and finds the same value.
#[derive(Clone, Copy, Debug, Default)]
struct Poll {
    address: u32,
    value: u32,
    at: u64,
    period: u64,
    turns: u8,
}

impl Poll {
    /// A register was read. Whether the loop has turned often enough to be one.
    fn on_read(&mut self, address: u32, value: u32, now: Ticks) -> bool {
        if address == TIME_COUNTER {
            return false;
        }
        if address != self.address || value != self.value {
            *self = Self {
                address,
                value,
                at: now.0,
                period: 0,
                turns: 0,
            };
            return false;
        }
        let period = now.0 - self.at;
        self.turns = if period == self.period {
            self.turns.saturating_add(1)
        } else {
            0
        };
        self.period = period;
        self.at = now.0;
        self.turns >= EQUAL_TURNS
    }
}

/// A block of registers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Block {
    Rcc,
    Flash,
    Gpio,
    Exti,
    Syscfg,
    Tim2,
    Tim4,
    Iwdg,
    Adc1,
    Spi1,
    Spi2,
    I2c1,
    Usart2,
    Can1,
}

impl Block {
    /// The block at an address, the block's base, and the clock it needs (RM0090, register boundary addresses).
    const fn at(address: u32) -> Option<(Self, u32, Option<PeripheralId>)> {
        Some(match address {
            0x4000_0000..=0x4000_03FF => (Self::Tim2, 0x4000_0000, Some(PeripheralId::Tim2)),
            0x4000_0800..=0x4000_0BFF => (Self::Tim4, 0x4000_0800, Some(PeripheralId::Tim4)),
            0x4000_3000..=0x4000_33FF => (Self::Iwdg, 0x4000_3000, None),
            0x4000_3800..=0x4000_3BFF => (Self::Spi2, 0x4000_3800, Some(PeripheralId::Spi2)),
            0x4000_4400..=0x4000_47FF => (Self::Usart2, 0x4000_4400, Some(PeripheralId::Usart2)),
            0x4000_5400..=0x4000_57FF => (Self::I2c1, 0x4000_5400, Some(PeripheralId::I2c1)),
            0x4000_6400..=0x4000_67FF => (Self::Can1, 0x4000_6400, Some(PeripheralId::Can1)),
            0x4001_2000..=0x4001_23FF => (Self::Adc1, 0x4001_2000, Some(PeripheralId::Adc1)),
            0x4001_3000..=0x4001_33FF => (Self::Spi1, 0x4001_3000, Some(PeripheralId::Spi1)),
            0x4001_3800..=0x4001_3BFF => (Self::Syscfg, 0x4001_3800, Some(PeripheralId::Syscfg)),
            // EXTI's registers are always reachable.
            0x4001_3C00..=0x4001_3FFF => (Self::Exti, 0x4001_3C00, None),
            0x4002_0000..=0x4002_03FF => (Self::Gpio, 0x4002_0000, Some(PeripheralId::GpioA)),
            0x4002_0400..=0x4002_07FF => (Self::Gpio, 0x4002_0000, Some(PeripheralId::GpioB)),
            0x4002_0800..=0x4002_0BFF => (Self::Gpio, 0x4002_0000, Some(PeripheralId::GpioC)),
            0x4002_3800..=0x4002_3BFF => (Self::Rcc, 0x4002_3800, None),
            0x4002_3C00..=0x4002_3FFF => (Self::Flash, 0x4002_3C00, None),
            _ => return None,
        })
    }
}

/// Calls `$peripheral.$method(.., context)` with a context made of the rest of the state.
macro_rules! call {
    ($state:expr, $now:expr, $peripheral:ident . $method:ident ( $($argument:expr),* )) => {{
        let state = &mut *$state;
        let mut context = Context {
            now: $now,
            clocks: state.clocks,
            interrupts: &state.interrupts,
            outside: &mut state.board,
        };
        state.$peripheral.$method($($argument,)* &mut context)
    }};
}

/// The same for every peripheral that can have events of its own.
macro_rules! each_active {
    ($macro:ident) => {
        $macro!(rcc, tim2, iwdg, adc1, spi1, spi2, i2c1, usart2, can)
    };
}

impl State {
    fn read(&mut self, address: u32, bytes: u8, now: Ticks) -> Result<u32, Unmodelled> {
        let (block, offset) = self.reach(address)?;
        match block {
            Block::Rcc => call!(self, now, rcc.read(offset, bytes)),
            Block::Flash => call!(self, now, flash.read(offset, bytes)),
            Block::Gpio => call!(self, now, gpio.read(offset, bytes)),
            Block::Exti => call!(self, now, exti.read(offset, bytes)),
            Block::Syscfg => call!(self, now, syscfg.read(offset, bytes)),
            Block::Tim2 => call!(self, now, tim2.read(offset, bytes)),
            Block::Tim4 => call!(self, now, tim4.read(offset, bytes)),
            Block::Iwdg => call!(self, now, iwdg.read(offset, bytes)),
            Block::Adc1 => call!(self, now, adc1.read(offset, bytes)),
            Block::Spi1 => call!(self, now, spi1.read(offset, bytes)),
            Block::Spi2 => call!(self, now, spi2.read(offset, bytes)),
            Block::I2c1 => call!(self, now, i2c1.read(offset, bytes)),
            Block::Usart2 => call!(self, now, usart2.read(offset, bytes)),
            Block::Can1 => call!(self, now, can.read(offset, bytes)),
        }
    }

    fn write(&mut self, address: u32, bytes: u8, value: u32, now: Ticks) -> Result<(), Unmodelled> {
        let (block, offset) = self.reach(address)?;
        match block {
            Block::Rcc => call!(self, now, rcc.write(offset, bytes, value)),
            Block::Flash => call!(self, now, flash.write(offset, bytes, value)),
            Block::Gpio => {
                call!(self, now, gpio.write(offset, bytes, value))?;
                self.follow_outputs(now);
                self.check_pulls()
            }
            Block::Exti => call!(self, now, exti.write(offset, bytes, value)),
            Block::Syscfg => call!(self, now, syscfg.write(offset, bytes, value)),
            Block::Tim2 => call!(self, now, tim2.write(offset, bytes, value)),
            Block::Tim4 => call!(self, now, tim4.write(offset, bytes, value)),
            Block::Iwdg => call!(self, now, iwdg.write(offset, bytes, value)),
            Block::Adc1 => call!(self, now, adc1.write(offset, bytes, value)),
            Block::Spi1 => call!(self, now, spi1.write(offset, bytes, value)),
            Block::Spi2 => call!(self, now, spi2.write(offset, bytes, value)),
            Block::I2c1 => call!(self, now, i2c1.write(offset, bytes, value)),
            Block::Usart2 => call!(self, now, usart2.write(offset, bytes, value)),
            Block::Can1 => call!(self, now, can.write(offset, bytes, value)),
        }?;
        match block {
            Block::Rcc => self.follow_rcc(now),
            Block::Spi1 | Block::Spi2 if offset == Spi::DATA => self.check_spi(block),
            Block::I2c1 if self.i2c1.uses_pins() => self.check_signals(&pin_mux::I2C1),
            Block::Usart2 if offset == Usart::DATA => self.check_signals(&[pin_mux::USART2_TX]),
            Block::Can1 => {
                let rx = self.can.uses_rx().then_some(pin_mux::CAN1_RX);
                let tx = self.can.uses_tx().then_some(pin_mux::CAN1_TX);
                self.check_signals([rx, tx].iter().flatten())
            }
            Block::Adc1 => {
                let input = self.adc1.sampled_channel().and_then(pin_mux::adc1_input);
                self.check_signals(&input)
            }
            _ => Ok(()),
        }
    }

    /// What is under way or has just begun needs its pins.
    fn check_signals<'a>(
        &self,
        signals: impl IntoIterator<Item = &'a Signal>,
    ) -> Result<(), Unmodelled> {
        signals
            .into_iter()
            .try_for_each(|signal| signal.check(&self.gpio))
    }

    /// A pin stands more than VDD + 0.3 V only while its pulls are off (STM32F405 data sheet, FT pins).
    fn check_pulls(&self) -> Result<(), Unmodelled> {
        let pulled = |pin: &&Pin| self.gpio.is_pulled(**pin);
        let Some(Pin { port, number }) = pins::FROM_5_V.iter().find(pulled) else {
            return Ok(());
        };
        let port = char::from(b'A' + port);
        Err(Unmodelled {
            register: format!("GPIO{port}_PUPDR"),
            what: format!("a pull at P{port}{number}, which sees 5 V, in place of none"),
        })
    }

    /// Two outputs against each other: real ones would not last.
    fn check_conflicts(&mut self) {
        let conflicts = self.gpio.take_conflicts();
        let Some(port) = conflicts.iter().position(|pins| *pins != 0) else {
            return;
        };
        let letter = ["A", "B", "C"][port];
        let number = conflicts[port].trailing_zeros();
        self.failure.get_or_insert(Failure {
            access: Unmodelled {
                register: format!("GPIO{letter}_ODR"),
                what: format!(
                    "P{letter}{number} driven against the level that the board drives onto it"
                ),
            },
        });
    }

    /// The signals of an SPI master that sends have to reach their pins, and clock and data to be able to follow its clock: real pins would
    /// round the edges off. And the clock's pad has to be fast against the clock of the APB, however slow the SPI is: what is received is
    /// strobed by what comes back through that pad, and if it comes late the last bit is the one of the byte before (errata ES0182,
    /// corrupted last bit of data received in master mode with delayed SCK feedback).
    fn check_spi(&self, block: Block) -> Result<(), Unmodelled> {
        let (spi, clock, signals) = if block == Block::Spi1 {
            (&self.spi1, self.clocks.apb2, pin_mux::SPI1)
        } else {
            (&self.spi2, self.clocks.apb1, pin_mux::SPI2)
        };
        self.check_signals(&signals)?;
        let [sck, _, mosi] = signals.map(|signal| signal.pin);
        let port = char::from(b'A' + sck.port);
        let clock_hz = u64::from(clock) / spi.divider();
        let feedback_hz = self.gpio.fastest_hz(sck);
        if clock > SLOW_APB_HZ && feedback_hz < FEEDBACK_HZ {
            return Err(Unmodelled {
                register: format!("GPIO{port}_OSPEEDR"),
                what: format!(
                    "SCK of {block:?} on pin {} at an output speed for {feedback_hz} Hz: with {clock} Hz on its APB the last bit of a \
                     received byte may be wrong, expected high or very high speed",
                    sck.number
                ),
            });
        }
        for pin in [sck, mosi] {
            let fastest_hz = self.gpio.fastest_hz(pin);
            if clock_hz > fastest_hz {
                return Err(Unmodelled {
                    register: format!("GPIO{port}_OSPEEDR"),
                    what: format!(
                        "{clock_hz} Hz of {block:?} on pin {}, whose speed is for {fastest_hz} Hz",
                        pin.number
                    ),
                });
            }
        }
        Ok(())
    }

    /// The block at `address`, whose clock has to be on and whose reset over, and the offset in it.
    fn reach(&self, address: u32) -> Result<(Block, u32), Unmodelled> {
        let Some((block, base, clock)) = Block::at(address) else {
            return Err(Unmodelled {
                register: format!("{address:#010X}"),
                what: "a peripheral that this board does not use".to_owned(),
            });
        };
        if let Some(clock) = clock.filter(|clock| !self.rcc.is_enabled(*clock)) {
            return Err(Unmodelled {
                register: format!("{block:?} at {address:#010X}"),
                what: format!("an access while RCC keeps the clock of {clock:?} off"),
            });
        }
        if let Some(held) = clock.filter(|held| self.rcc.is_held_in_reset(*held)) {
            return Err(Unmodelled {
                register: format!("{block:?} at {address:#010X}"),
                what: format!("an access while RCC holds {held:?} in reset"),
            });
        }
        Ok((block, address - base))
    }

    /// Clocks and reset bits have an effect elsewhere.
    fn follow_rcc(&mut self, now: Ticks) -> Result<(), Unmodelled> {
        let clocks = self.rcc.clocks();
        if clocks != self.clocks {
            self.clocks = clocks;
            self.flash.check(clocks)?;
            // It counts up to now with the old clock.
            call!(self, now, tim2.advance());
        }
        for peripheral in self.rcc.take_resets() {
            match peripheral {
                PeripheralId::GpioA => self.gpio.reset_port(0),
                PeripheralId::GpioB => self.gpio.reset_port(1),
                PeripheralId::GpioC => self.gpio.reset_port(2),
                PeripheralId::Tim2 => call!(self, now, tim2.reset()),
                PeripheralId::Tim4 => call!(self, now, tim4.reset()),
                PeripheralId::Spi1 => call!(self, now, spi1.reset()),
                PeripheralId::Spi2 => call!(self, now, spi2.reset()),
                PeripheralId::Usart2 => call!(self, now, usart2.reset()),
                PeripheralId::I2c1 => call!(self, now, i2c1.reset()),
                PeripheralId::Can1 => call!(self, now, can.reset()),
                PeripheralId::Adc1 => call!(self, now, adc1.reset()),
                PeripheralId::Syscfg => call!(self, now, syscfg.reset()),
                PeripheralId::Pwr => {}
            }
        }
        self.follow_outputs(now);
        Ok(())
    }

    fn follow_outputs(&mut self, now: Ticks) {
        let outputs = self.gpio.outputs();
        if outputs != self.outputs {
            self.outputs = outputs;
            self.board.outputs_changed(&outputs, now);
        }
        self.follow_levels(now);
    }

    /// Pins that changed reach EXTI and the gate of TIM4. One that is driven from both sides ends the run.
    fn follow_levels(&mut self, now: Ticks) {
        let driven = self.board.levels(now);
        let levels = self.gpio.input_levels(&driven);
        self.check_conflicts();
        if levels != self.levels {
            self.exti
                .on_levels(self.levels, levels, &self.syscfg, &self.interrupts);
            self.levels = levels;
        }
        let Pin { port, number } = pins::RANGE_GATE;
        let gate = levels[usize::from(port)] >> number & 1 != 0
            && pin_mux::TIM4_CH1.check(&self.gpio).is_ok();
        if gate != self.tim4.gate() {
            call!(self, now, tim4.set_gate(gate));
        }
    }

    fn next_event(&self) -> Ticks {
        let mut next = self.board.next_event();
        macro_rules! earliest {
            ($($peripheral:ident),*) => {
                $(if let Some(at) = self.$peripheral.next_event() {
                    next = next.min(at);
                })*
            };
        }
        each_active!(earliest);
        next
    }

    /// Everything that is due at `now`.
    fn advance(&mut self, now: Ticks) -> Result<(), Unmodelled> {
        if self.board.next_event() <= now {
            self.board.advance(now);
            for frame in self.board.take_vehicle_frames(now) {
                self.can.inject(frame, now);
            }
            for (at, character) in self.board.line.take_due(now) {
                if self.usart2.listens() {
                    pin_mux::USART2_RX.check(&self.gpio)?;
                }
                call!(self, now, usart2.receive(character, at));
                let follows = self.board.line.next_start(at);
                if follows.is_some_and(|start| start < at + self.board.line.character()) {
                    self.usart2.start_bit();
                }
            }
        }
        macro_rules! due {
            ($($peripheral:ident),*) => {
                $(if self.$peripheral.next_event().is_some_and(|at| at <= now) {
                    call!(self, now, $peripheral.advance());
                })*
            };
        }
        each_active!(due);
        self.follow_rcc(now)?;
        if self.iwdg.take_reset() {
            self.reset = Some(ResetCause::IndependentWatchdog);
        }
        Ok(())
    }

    /// A system reset: every peripheral but the reset flags in RCC.
    fn reset(&mut self, cause: ResetCause, now: Ticks) {
        macro_rules! all {
            ($($peripheral:ident),*) => {
                $(call!(self, now, $peripheral.reset());)*
            };
        }
        all!(
            rcc, flash, gpio, exti, syscfg, tim2, tim4, iwdg, adc1, spi1, spi2, i2c1, usart2, can
        );
        self.rcc.set_reset_cause(cause);
        self.clocks = self.rcc.clocks();
        self.reset = None;
        self.follow_outputs(now);
    }
}

impl SystemBus {
    /// Everything off, with the board around it.
    pub fn new(board: Board) -> Self {
        let rcc = Rcc::default();
        let clocks = rcc.clocks();
        let state = State {
            rcc,
            flash: FlashInterface::new(),
            gpio: GpioPorts::new(),
            exti: Exti::new(),
            syscfg: Syscfg::new(),
            tim2: Tim2::new(),
            tim4: Tim4::new(),
            iwdg: Iwdg::default(),
            adc1: Adc1::default(),
            spi1: Spi::new(SpiBus::Meter),
            spi2: Spi::new(SpiBus::Flash),
            i2c1: I2c::new(),
            usart2: Usart::new(LineConfig::default().baud),
            can: CanBus::new(CAN_BIT_RATE),
            clocks,
            interrupts: Interrupts::default(),
            levels: [0; PORTS],
            outputs: Outputs::default(),
            reset: None,
            failure: None,
            poll: Poll::default(),
            board,
        };
        let bus = Self {
            state: Mutex::new(state),
            now: AtomicU64::new(0),
            next: AtomicU64::new(0),
            ticks_per_cycle: AtomicU64::new(1),
            touched: AtomicBool::new(false),
        };
        let state = bus.lock();
        bus.publish(&state);
        drop(state);
        bus
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // One thread: nobody can have left it poisoned and gone on.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What the run loop needs without the lock.
    fn publish(&self, state: &State) {
        self.next.store(state.next_event().0, Ordering::Relaxed);
        let per_cycle = Ticks::PER_SECOND / u64::from(state.clocks.ahb.max(1));
        self.ticks_per_cycle
            .store(per_cycle.max(1), Ordering::Relaxed);
    }

    /// The next time at which something happens by itself.
    pub fn next_event(&self) -> Ticks {
        Ticks(self.next.load(Ordering::Relaxed))
    }

    /// Units of time per cycle of the core.
    pub fn ticks_per_cycle(&self) -> u64 {
        self.ticks_per_cycle.load(Ordering::Relaxed)
    }

    /// The time at which the core's next access happens.
    pub fn set_now(&self, now: Ticks) {
        self.now.store(now.0, Ordering::Relaxed);
    }

    /// Whether an access may have changed the next event, a clock or an interrupt since the last call.
    pub fn take_touched(&self) -> bool {
        self.touched.load(Ordering::Relaxed) && self.touched.swap(false, Ordering::Relaxed)
    }

    /// Everything that is due at `now`.
    pub fn advance(&self, now: Ticks) {
        self.set_now(now);
        let mut state = self.lock();
        if let Err(access) = state.advance(now) {
            state.failure.get_or_insert(Failure { access });
        }
        self.publish(&state);
    }

    /// The period of a polling loop that the core is in. The loop has just read its register; the caller may let whole
    /// turns of it pass at once, and says how long that was.
    pub fn skip_polling(&self, skip: impl FnOnce(Ticks) -> Ticks) {
        let mut state = self.lock();
        if state.poll.turns >= EQUAL_TURNS && state.poll.period > 0 {
            state.poll.at += skip(Ticks(state.poll.period)).0;
        }
    }

    /// Interrupt lines, if one changed since the last call.
    pub fn take_interrupts(&self) -> Option<Lines> {
        self.lock().interrupts.take_changed()
    }

    /// The access that ends the run, if there was one.
    pub fn take_failure(&self) -> Option<Failure> {
        self.lock().failure.take()
    }

    /// A reset that a peripheral asked for.
    pub fn take_reset(&self) -> Option<ResetCause> {
        self.lock().reset.take()
    }

    /// A system reset.
    pub fn reset(&self, cause: ResetCause, now: Ticks) {
        let mut state = self.lock();
        state.reset(cause, now);
        self.publish(&state);
    }

    /// Works on the board at `now`.
    pub fn with_board<T>(&self, now: Ticks, work: impl FnOnce(&mut Board) -> T) -> T {
        let mut state = self.lock();
        let result = work(&mut state.board);
        state.follow_levels(now);
        self.publish(&state);
        result
    }

    /// Works on the CAN bus.
    pub fn with_can<T>(&self, work: impl FnOnce(&mut CanBus) -> T) -> T {
        let mut state = self.lock();
        let result = work(&mut state.can);
        self.publish(&state);
        result
    }

    /// Works on ADC1, for the faults that sit in its supply.
    pub fn with_adc<T>(&self, work: impl FnOnce(&mut Adc1) -> T) -> T {
        work(&mut self.lock().adc1)
    }

    /// Works on the flash interface, for the option bytes that it shows.
    pub fn with_flash<T>(&self, work: impl FnOnce(&mut FlashInterface) -> T) -> T {
        work(&mut self.lock().flash)
    }

    /// Works on USART2, for what it knows of how it is served.
    pub fn with_usart<T>(&self, work: impl FnOnce(&Usart) -> T) -> T {
        work(&self.lock().usart2)
    }

    /// Works on TIM2, for a clock that is about to wrap.
    pub fn with_timer<T>(&self, work: impl FnOnce(&mut Tim2) -> T) -> T {
        let mut state = self.lock();
        let result = work(&mut state.tim2);
        self.publish(&state);
        result
    }

    /// Works on clocks and watchdog, for the faults that sit in the MCU's surroundings (crystal, LSI).
    pub fn with_clocks<T>(&self, work: impl FnOnce(&mut Rcc, &mut Iwdg) -> T) -> T {
        let mut state = self.lock();
        let State { rcc, iwdg, .. } = &mut *state;
        let result = work(rcc, iwdg);
        self.publish(&state);
        result
    }

    fn failed(&self, state: &mut State, access: Unmodelled) -> BusError {
        state.failure.get_or_insert(Failure { access });
        self.touched.store(true, Ordering::Relaxed);
        BusError::BadAccess
    }
}

impl MemOps for SystemBus {
    fn read(&self, offset: u64, dst: &mut [u8], attrs: MemAttrs) -> MemResult {
        let (Some(address), Ok(bytes)) = (address(offset), u8::try_from(dst.len())) else {
            return Err(BusError::BadAccess);
        };
        // A debugger's look must not clear flags; nothing here debugs, so it is refused.
        if attrs.debug {
            return Err(BusError::BadAccess);
        }
        let now = Ticks(self.now.load(Ordering::Relaxed));
        let mut state = self.lock();
        match state.read(address, bytes, now) {
            Ok(value) => {
                for (to, from) in dst.iter_mut().zip(value.to_le_bytes()) {
                    *to = from;
                }
                if state.poll.on_read(address, value, now) {
                    self.touched.store(true, Ordering::Relaxed);
                }
                // Reading can clear a flag or take a byte.
                if state.interrupts.is_changed() {
                    self.touched.store(true, Ordering::Relaxed);
                }
                let next = state.next_event().0;
                if next != self.next.load(Ordering::Relaxed) {
                    self.next.store(next, Ordering::Relaxed);
                    self.touched.store(true, Ordering::Relaxed);
                }
                Ok(())
            }
            Err(access) => Err(self.failed(&mut state, access)),
        }
    }

    fn write(&self, offset: u64, src: &[u8], _attrs: MemAttrs) -> MemResult {
        let (Some(address), Ok(bytes)) = (address(offset), u8::try_from(src.len())) else {
            return Err(BusError::BadAccess);
        };
        let mut word = [0; 4];
        for (to, from) in word.iter_mut().zip(src) {
            *to = *from;
        }
        let now = Ticks(self.now.load(Ordering::Relaxed));
        let mut state = self.lock();
        state.poll = Poll::default();
        let result = state.write(address, bytes, u32::from_le_bytes(word), now);
        self.touched.store(true, Ordering::Relaxed);
        match result {
            Ok(()) => {
                self.publish(&state);
                Ok(())
            }
            Err(access) => Err(self.failed(&mut state, access)),
        }
    }
}

fn address(offset: u64) -> Option<u32> {
    u32::try_from(offset)
        .ok()
        .and_then(|offset| BASE.checked_add(offset))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

    use plant::ade7753::{Ade7753, Ade7753Config};
    use plant::ads1100::{Ads1100, Ads1100Config};
    use plant::w25q32::{W25q32, W25q32Config};

    use super::*;
    use crate::board::BoardConfig;
    use crate::scenario::{Contactors, Row, Scenario};

    const AHB1ENR: u32 = 0x4002_3830;
    const APB1RSTR: u32 = 0x4002_3820;
    const APB1ENR: u32 = 0x4002_3840;
    const APB2ENR: u32 = 0x4002_3844;
    const USART2: u32 = 0x4000_4400;

    fn bus() -> SystemBus {
        SystemBus::new(Board::new(
            BoardConfig::default(),
            Scenario::steady(Row::at_rest(0.0), Contactors::AlwaysClosed),
            Ade7753::new(Ade7753Config::default(), 0.0),
            Ads1100::new(Ads1100Config::default(), 0.0),
            W25q32::with_content(W25q32Config::default(), 0.0, Vec::new()),
        ))
    }

    /// The clocks of the ports and of what is tested here, from the 16 MHz of HSI.
    fn with_clocks(bus: &SystemBus) -> MutexGuard<'_, State> {
        let mut state = bus.lock();
        for (register, bits) in [
            (AHB1ENR, 0b111),
            (APB1ENR, 1 << 2 | 1 << 14 | 1 << 17 | 1 << 21 | 1 << 25),
            (APB2ENR, 1 << 8 | 1 << 12),
        ] {
            state.write(register, 4, bits, Ticks(0)).unwrap();
        }
        state
    }

    /// MODER, OTYPER and AFR of a pin.
    #[derive(Clone, Copy, Debug, PartialEq)]
    struct Setting {
        mode: u32,
        open_drain: u32,
        alternate: u32,
    }

    impl Setting {
        const fn alternate(alternate: u32) -> Self {
            Self {
                mode: 0b10,
                open_drain: 0,
                alternate,
            }
        }
        const fn open_drain(alternate: u32) -> Self {
            Self {
                open_drain: 1,
                ..Self::alternate(alternate)
            }
        }
        const ANALOG: Self = Self {
            mode: 0b11,
            ..Self::alternate(0)
        };
    }

    fn set_field(state: &mut State, register: u32, shift: u32, width: u32, value: u32) {
        let mask = ((1 << width) - 1) << shift;
        let was = state.read(register, 4, Ticks(0)).unwrap();
        state
            .write(register, 4, was & !mask | value << shift, Ticks(0))
            .unwrap();
    }

    fn set_pin(state: &mut State, pin: Pin, setting: Setting) {
        let port = 0x4002_0000 + 0x400 * u32::from(pin.port);
        let number = u32::from(pin.number);
        set_field(state, port, 2 * number, 2, setting.mode);
        set_field(state, port + 0x04, number, 1, setting.open_drain);
        let register = port + 0x20 + number / 8 * 4;
        set_field(state, register, number % 8 * 4, 4, setting.alternate);
    }

    /// What makes a peripheral use its pins, and how docs/firmware.md has them.
    struct Transfer {
        writes: &'static [(u32, u32)],
        /// A client's character is on the line meanwhile.
        hears: bool,
        pins: &'static [(&'static str, Pin, Setting)],
    }

    const TRANSFERS: [Transfer; 8] = [
        Transfer {
            // Master, software NSS, divider 256; a byte.
            writes: &[(0x4001_3000, 0x037C), (0x4001_300C, 0xA5)],
            hears: false,
            pins: &[
                ("SPI1_SCK", Pin::new('A', 5), Setting::alternate(5)),
                ("SPI1_MISO", Pin::new('A', 6), Setting::alternate(5)),
                ("SPI1_MOSI", Pin::new('A', 7), Setting::alternate(5)),
            ],
        },
        Transfer {
            writes: &[(0x4000_3800, 0x037C), (0x4000_380C, 0xA5)],
            hears: false,
            pins: &[
                ("SPI2_SCK", Pin::new('B', 13), Setting::alternate(5)),
                ("SPI2_MISO", Pin::new('B', 14), Setting::alternate(5)),
                ("SPI2_MOSI", Pin::new('B', 15), Setting::alternate(5)),
            ],
        },
        Transfer {
            // FREQ, CCR and TRISE of fast mode; PE, then START.
            writes: &[
                (0x4000_5404, 16),
                (0x4000_541C, 0x800E),
                (0x4000_5420, 5),
                (0x4000_5400, 1),
                (0x4000_5400, 0x101),
            ],
            hears: false,
            pins: &[
                ("I2C1_SCL", Pin::new('B', 8), Setting::open_drain(4)),
                ("I2C1_SDA", Pin::new('B', 9), Setting::open_drain(4)),
            ],
        },
        Transfer {
            // 115,200 baud, 8E1, transmitter alone; a character.
            writes: &[
                (USART2 + 0x08, 139),
                (USART2 + 0x0C, 0x3408),
                (USART2 + 0x04, 1),
            ],
            hears: false,
            pins: &[("USART2_TX", Pin::new('A', 2), Setting::alternate(7))],
        },
        Transfer {
            // Receiver alone.
            writes: &[(USART2 + 0x08, 139), (USART2 + 0x0C, 0x3404)],
            hears: true,
            pins: &[("USART2_RX", Pin::new('A', 3), Setting::alternate(7))],
        },
        Transfer {
            // From sleep to initialization, and on to normal mode.
            writes: &[(0x4000_6400, 1), (0x4000_6400, 0)],
            hears: false,
            pins: &[
                ("CAN1_RX", Pin::new('A', 11), Setting::alternate(9)),
                ("CAN1_TX", Pin::new('A', 12), Setting::alternate(9)),
            ],
        },
        Transfer {
            // ADON, channel 10, SWSTART.
            writes: &[
                (0x4001_2008, 1),
                (0x4001_2034, 10),
                (0x4001_2008, 1 << 30 | 1),
            ],
            hears: false,
            pins: &[("ADC1_IN10", Pin::new('C', 0), Setting::ANALOG)],
        },
        Transfer {
            writes: &[
                (0x4001_2008, 1),
                (0x4001_2034, 11),
                (0x4001_2008, 1 << 30 | 1),
            ],
            hears: false,
            pins: &[("ADC1_IN11", Pin::new('C', 1), Setting::ANALOG)],
        },
    ];

    impl Transfer {
        /// With its pins as they have to be, but for `wrong`.
        fn run(&self, wrong: Option<(Pin, Setting)>) -> Result<(), Unmodelled> {
            let bus = bus();
            let mut state = with_clocks(&bus);
            let right = self.pins.iter().map(|(_, pin, setting)| (*pin, *setting));
            for (pin, setting) in right.chain(wrong) {
                set_pin(&mut state, pin, setting);
            }
            let mut now = Ticks(0);
            for (register, value) in self.writes {
                // The converter takes 3 µs to get stable.
                now += Ticks::from_micros(5);
                state.write(*register, 4, *value, now)?;
            }
            if self.hears {
                let end = state.board.line.send_bytes(&[0x55], now);
                state.advance(end)?;
            }
            Ok(())
        }
    }

    /// PC6 is the key's line, which the board drives.
    #[test]
    fn driving_against_the_outside_ends_the_run() {
        const GPIOC: u32 = 0x4002_0800;
        let bus = bus();
        let mut state = with_clocks(&bus);
        let outside = state.board.levels(Ticks(0)).driven(pins::KEY).unwrap();
        let level = |high: bool| u32::from(high) << 6;
        state
            .write(GPIOC + 0x14, 4, level(outside), Ticks(0))
            .unwrap();
        state.write(GPIOC, 4, 0b01 << 12, Ticks(0)).unwrap();
        assert_eq!(state.failure, None);
        state
            .write(GPIOC + 0x14, 4, level(!outside), Ticks(0))
            .unwrap();
        let failure = state.failure.take().unwrap().access;
        assert_eq!(failure.register, "GPIOC_ODR");
        assert!(failure.what.contains("PC6"), "{failure}");
        // A low of an open drain is what a pull-up outside looks like.
        state
            .write(GPIOC + 0x14, 4, level(outside), Ticks(0))
            .unwrap();
        state.write(GPIOC + 0x04, 4, 1 << 6, Ticks(0)).unwrap();
        state.write(GPIOC + 0x14, 4, 0, Ticks(0)).unwrap();
        assert_eq!(state.failure, None);
    }

    #[test]
    fn a_transfer_needs_its_pins() {
        for transfer in &TRANSFERS {
            assert_eq!(transfer.run(None), Ok(()));
            for (name, pin, right) in transfer.pins {
                let mut wrong: Vec<Setting> =
                    (0..4).map(|mode| Setting { mode, ..*right }).collect();
                if *right != Setting::ANALOG {
                    wrong.extend((0..16).map(|alternate| Setting {
                        alternate,
                        ..*right
                    }));
                    // Of an input the output type does not matter.
                    if !name.ends_with("RX") && !name.ends_with("MISO") {
                        wrong.push(Setting {
                            open_drain: 1 - right.open_drain,
                            ..*right
                        });
                    }
                }
                for wrong in wrong.into_iter().filter(|wrong| wrong != right) {
                    let refused = transfer.run(Some((*pin, wrong))).unwrap_err();
                    let port = char::from(b'A' + pin.port);
                    assert!(
                        refused.register.starts_with(&format!("GPIO{port}_")),
                        "{refused}"
                    );
                    let place = format!("{name} on P{port}{} ", pin.number);
                    assert!(refused.what.starts_with(&place), "{refused}");
                }
            }
        }
    }

    /// What a controller does not use may be as it likes: a silent one sends nothing, in loop back mode it hears itself.
    #[test]
    fn can_in_test_modes_needs_fewer_pins() {
        let [rx, tx] = [('A', 11), ('A', 12)].map(|(port, number)| Pin::new(port, number));
        for (mode, needed) in [(0, &[rx, tx][..]), (1 << 31, &[rx]), (1 << 30, &[tx])] {
            for connected in [&[][..], &[rx], &[tx], &[rx, tx]] {
                let bus = bus();
                let mut state = with_clocks(&bus);
                for pin in connected {
                    set_pin(&mut state, *pin, Setting::alternate(9));
                }
                state.write(0x4000_6400, 4, 1, Ticks(0)).unwrap();
                state
                    .write(0x4000_641C, 4, 0x0123_0000 | mode, Ticks(0))
                    .unwrap();
                let joined = state.write(0x4000_6400, 4, 0, Ticks(0));
                assert_eq!(
                    joined.is_ok(),
                    needed.iter().all(|pin| connected.contains(pin)),
                    "{mode:#x}, {connected:?}: {joined:?}"
                );
            }
        }
    }

    #[test]
    fn a_pin_that_sees_5_v_has_no_pull() {
        for (port, number) in [('A', 0), ('A', 6), ('B', 6)] {
            let bus = bus();
            let mut state = with_clocks(&bus);
            let pin = Pin::new(port, number);
            let register = 0x4002_000C + 0x400 * u32::from(pin.port);
            for pull in [0b01, 0b10] {
                let value = pull << (2 * number);
                let refused = state.write(register, 4, value, Ticks(0)).unwrap_err();
                assert_eq!(refused.register, format!("GPIO{port}_PUPDR"));
            }
            state
                .write(register, 4, 0b01 << (2 * number + 2), Ticks(0))
                .unwrap();
        }
    }

    #[test]
    fn a_peripheral_is_reached_with_its_clock_on_and_its_reset_over() {
        const TIM4: u32 = 1 << 2;
        const TIM4_PSC: u32 = 0x4000_0828;
        let bus = bus();
        let mut state = bus.lock();
        let mut refusal = |writes: &[(u32, u32)]| {
            for (address, value) in writes {
                state.write(*address, 4, *value, Ticks(0)).unwrap();
            }
            let written = state.write(TIM4_PSC, 4, 1, Ticks(0)).err();
            let read = state.read(TIM4_PSC, 4, Ticks(0)).err();
            assert_eq!(written, read);
            read.map(|refused| refused.what)
        };
        assert!(refusal(&[]).unwrap().contains("clock"));
        assert!(
            refusal(&[(APB1ENR, TIM4), (APB1RSTR, TIM4)])
                .unwrap()
                .contains("reset")
        );
        assert_eq!(refusal(&[(APB1RSTR, 0)]), None);
    }
}
