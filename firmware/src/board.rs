//! Pins, clocks and the start of the hardware.

use core_logic::{
    can,
    configuration::Configuration,
    design_parameters::METER_SPI_HZ,
    range::{EdgeRecorder, RangeHistory},
    storm::{StormAction, StormConfig, StormGuard},
    units::{Duration, Instant},
};
use stm32f4xx_hal::{
    gpio::{Edge, ExtiPin, GpioExt, Input, Output, PA0, PA4, PB12, PC4, PinState, Speed},
    pac::{self, EXTI, RCC, SPI1, SPI2, TIM4},
    rcc::{Enable, Reset},
    syscfg::SysCfgExt,
};

use crate::{
    analog::Analog,
    can_bus, clock, i2c,
    inputs::Lines,
    retain::{self, Previous, ResetCause, Stage},
    rs485, spi, time,
    watchdog::Watchdog,
};

/// RTIC's priority 3 in the four bits that the core has: (16 − 3) << 4.
pub const SYSTICK_PRIORITY: u8 = (16 - 3) << 4;

/// Mode 1 at APB2 / 32 = 2.625 MHz.
const METER_SPI: spi::Settings = spi::Settings {
    second_edge: true,
    baud: 4,
};
const _: () = assert!(clock::APB2_HZ >> (METER_SPI.baud + 1) == METER_SPI_HZ);
/// Mode 0 at APB1 / 2 = 21 MHz; the flash's slowest read command takes 50 MHz.
const FLASH_SPI: spi::Settings = spi::Settings {
    second_edge: false,
    baud: 0,
};
/// For its clock and data: as they come out of a reset, pins follow 4 MHz, and with this 50 MHz (STM32F405 data sheet,
/// I/O AC characteristics, 2.7 … 3.6 V; *assumed*, as in the emulator).
const FLASH_EDGES: Speed = Speed::High;
/// For the meter's clock, though 2.625 MHz is slow: the SPI strobes what it receives by the clock that comes back through this pad, and
/// where that is late against APB2 the last bit of a byte is the one of the byte before (errata ES0182, corrupted last bit of data
/// received in master mode with delayed SCK feedback).
const METER_CLOCK_EDGES: Speed = Speed::VeryHigh;

/// How long the range flag has been high: TIM4 counts microseconds while its channel 1, the same line, is high. It sees what
/// no interrupt is fast enough for.
struct HighTime {
    timer: TIM4,
    counted: u16,
    total: Duration,
}

impl HighTime {
    fn start(timer: TIM4, rcc: &mut RCC) -> Self {
        TIM4::enable(rcc);
        TIM4::reset(rcc);
        timer.psc().write(|w| w.psc().set(time::PRESCALER));
        // [`HighTime::read`] relies on a wrap at 2^16.
        timer.arr().write(|w| w.arr().set(u16::MAX));
        timer.ccmr1_input().write(|w| w.cc1s().ti1());
        timer.smcr().write(|w| w.ts().ti1fp1().sms().gated_mode());
        // The prescaler takes effect with an update event.
        timer.egr().write(|w| w.ug().set_bit());
        timer.cr1().write(|w| w.cen().set_bit());
        Self {
            timer,
            counted: 0,
            total: Duration::from_ticks(0),
        }
    }

    /// Up to now. Exact while it is asked once in 65 ms at least; the tick asks every 10 ms.
    fn read(&mut self) -> Duration {
        let count = self.timer.cnt().read().cnt().bits();
        let passed = count.wrapping_sub(core::mem::replace(&mut self.counted, count));
        self.total = self
            .total
            .saturating_add(Duration::from_ticks(passed.into()));
        self.total
    }
}

/// The range flag with its interrupt, and the external interrupts' mask that both lines share.
pub struct Edges {
    exti: EXTI,
    flag: PA0<Input>,
    recorder: EdgeRecorder,
    high: HighTime,
    guard: StormGuard,
    config: StormConfig,
}

impl Edges {
    /// The edge interrupt, at priority 5; `now` was read before anything else.
    ///
    /// The pending bit is cleared before the level is read: an edge after that asks for another interrupt. The APB's bridge takes the
    /// clear and passes it on later; what is read back has waited for it.
    #[inline]
    pub fn on_interrupt(&mut self, now: Instant) {
        self.flag.clear_interrupt_pending_bit();
        let _ = self.flag.check_interrupt();
        self.recorder.on_edge(now, self.flag.is_high());
        if self.guard.on_event(&self.config, now) == StormAction::Mask {
            self.flag.disable_interrupt(&mut self.exti);
            self.recorder.suspend();
        }
    }

    /// Called by the meter's task: ends the rest after a storm, and finds an edge that no interrupt told of. Whether
    /// a snapshot is due.
    pub fn poll(&mut self, now: Instant) -> bool {
        match self.guard.poll(&self.config, now) {
            StormAction::Unmask => {
                self.flag.clear_interrupt_pending_bit();
                self.flag.enable_interrupt(&mut self.exti);
                self.recorder.resume(now, self.flag.is_high());
                true
            }
            _ => {
                // Of an edge before this look the pending bit tells at the next one, and its handler, held off by the caller's lock,
                // records it as soon as that ends. Recorded here as well it would count three times.
                let is_high = self.flag.is_high();
                !self.guard.is_masked()
                    && !self.flag.check_interrupt()
                    && self.recorder.observe(now, is_high)
            }
        }
    }

    /// The newest edge.
    pub const fn last_edge(&self) -> Option<Instant> {
        self.recorder.last_edge()
    }

    /// Everything up to `now`; how long the flag was high up to the call.
    pub fn history(&mut self, now: Instant) -> RangeHistory {
        RangeHistory {
            high: self.high.read(),
            ..self.recorder.history(now)
        }
    }

    /// Whether the edge interrupt rests after a storm.
    pub const fn is_masked(&self) -> bool {
        self.guard.is_masked()
    }

    /// Times the edge interrupt was masked.
    pub const fn storms(&self) -> u32 {
        self.guard.storms()
    }

    /// Takes the limits of the active configuration.
    pub fn set_config(&mut self, config: StormConfig) {
        self.config = config;
    }
}

/// The meter's interrupt line.
pub struct MeterLine {
    pin: PC4<Input>,
    guard: StormGuard,
    config: StormConfig,
}

impl MeterLine {
    /// The interrupt: clears it; with one too many in the window the line is masked.
    pub fn on_interrupt(&mut self, edges: &mut Edges, now: Instant) {
        self.pin.clear_interrupt_pending_bit();
        if self.guard.on_event(&self.config, now) == StormAction::Mask {
            self.pin.disable_interrupt(&mut edges.exti);
        }
    }

    /// To be called before the chip's flags are read: an event during that makes the line fall again at its end.
    pub fn clear_pending(&mut self) {
        self.pin.clear_interrupt_pending_bit();
    }

    /// Whether the chip still asks for attention after its flags were read: an event of its own for the storm guard,
    /// so that a line stuck low ends as a storm and not as an endless loop.
    pub fn still_low(&mut self, edges: &mut Edges, now: Instant) -> bool {
        if self.pin.is_high() || self.guard.is_masked() {
            return false;
        }
        if self.guard.on_event(&self.config, now) == StormAction::Mask {
            self.pin.disable_interrupt(&mut edges.exti);
            return false;
        }
        true
    }

    /// Called by the meter's task: ends the rest after a storm. Whether the line has then to be looked at.
    pub fn poll(&mut self, edges: &mut Edges, now: Instant) -> bool {
        let unmask = self.guard.poll(&self.config, now) == StormAction::Unmask;
        if unmask {
            self.pin.clear_interrupt_pending_bit();
            self.pin.enable_interrupt(&mut edges.exti);
        }
        unmask && self.pin.is_low()
    }

    /// Times the line was masked.
    pub const fn storms(&self) -> u32 {
        self.guard.storms()
    }

    /// Takes the limits of the active configuration.
    pub fn set_config(&mut self, config: StormConfig) {
        self.config = config;
    }
}

/// The started hardware.
pub struct Board {
    /// Runs since the first line of the start.
    pub watchdog: Watchdog,
    /// What the program before this one left.
    pub previous: Previous,
    /// Range flag.
    pub edges: Edges,
    /// IRQ of the meter.
    pub meter_line: MeterLine,
    /// The meter's bus.
    pub meter_spi: spi::Device<SPI1, PA4<Output>>,
    /// The flash's bus.
    pub flash_spi: spi::Device<SPI2, PB12<Output>>,
    /// The converter's bus.
    pub i2c: i2c::Bus,
    /// ADC1.
    pub analog: Analog,
    /// CAN1.
    pub can: can_bus::Bus,
    /// USART2.
    pub rs485: rs485::Port,
    /// Key and high-voltage lines.
    pub lines: Lines,
}

impl Board {
    /// Starts the hardware, with interrupts disabled.
    ///
    /// The watchdog is first: crystal and PLL are waited for without a bound, and a crystal that does not swing then
    /// ends in a watchdog reset whose stage is kept. Its pins are in their reset state meanwhile, that is they float: what
    /// keeps the board silent and its permit withheld until they are set up are the resistors of docs/firmware.md.
    pub fn start(dp: pac::Peripherals, configuration: &Configuration) -> Self {
        let watchdog = Watchdog::start(dp.IWDG, &dp.DBGMCU);
        let previous = retain::begin(ResetCause::take(&dp.RCC));

        retain::note_stage(Stage::Clock);
        let mut rcc = dp.RCC;
        clock::start(&rcc, &dp.FLASH, &dp.DBGMCU);

        retain::note_stage(Stage::Peripherals);
        time::start(dp.TIM2, &mut rcc);
        // The log has the time.
        clock::check_brown_out_level(&dp.FLASH);
        let a = dp.GPIOA.split(&mut rcc);
        let b = dp.GPIOB.split(&mut rcc);
        let c = dp.GPIOC.split(&mut rcc);
        let (mut exti, mut syscfg) = (dp.EXTI, dp.SYSCFG.constrain(&mut rcc));

        // The pin table; docs/firmware.md shows it with the outside's names. PA0, PA6 and PB6 may see 5 V, which their
        // pads stand only with the internal pulls off.
        let mut range_flag = /*  PA0  */ a.pa0.into_floating_input();
        let rs485_driver = /*    PA1  */ a.pa1.into_push_pull_output_in_state(PinState::Low);
        let _rs485_tx = /*       PA2  */ a.pa2.into_alternate::<7>();
        let _rs485_rx = /*       PA3  */ a.pa3.into_alternate::<7>().internal_pull_up(true);
        let meter_select = /*    PA4  */ a.pa4.into_push_pull_output_in_state(PinState::High);
        let _meter_clock = /*    PA5  */ a.pa5.into_alternate::<5>().speed(METER_CLOCK_EDGES);
        let _meter_miso = /*     PA6  */ a.pa6.into_alternate::<5>();
        let _meter_mosi = /*     PA7  */ a.pa7.into_alternate::<5>();
        let _can_rx = /*         PA11 */ a.pa11.into_alternate::<9>().internal_pull_up(true);
        let _can_tx = /*         PA12 */ a.pa12.into_alternate::<9>();
        let _range_gate = /*     PB6  */ b.pb6.into_alternate::<2>();
        let i2c_clock = /*       PB8  */ b.pb8.into_alternate_open_drain::<4>();
        let i2c_data = /*        PB9  */ b.pb9.into_alternate_open_drain::<4>();
        let flash_select = /*    PB12 */ b.pb12.into_push_pull_output_in_state(PinState::High);
        let _flash_clock = /*    PB13 */ b.pb13.into_alternate::<5>().speed(FLASH_EDGES);
        let _flash_miso = /*     PB14 */ b.pb14.into_alternate::<5>();
        let _flash_mosi = /*     PB15 */ b.pb15.into_alternate::<5>().speed(FLASH_EDGES);
        let _sensor_supply = /*  PC0  */ c.pc0.into_analog();
        let _open_sensor = /*    PC1  */ c.pc1.into_analog();
        let mut meter_irq = /*   PC4  */ c.pc4.into_pull_up_input();
        let key_acc = /*         PC6  */ c.pc6.into_pull_down_input();
        let hv_feedback = /*     PC7  */ c.pc7.into_pull_down_input();
        let hv_permit = /*       PC8  */ c.pc8.into_push_pull_output_in_state(PinState::Low);

        range_flag.make_interrupt_source(&mut syscfg);
        range_flag.trigger_on_edge(&mut exti, Edge::RisingFalling);
        range_flag.clear_interrupt_pending_bit();
        range_flag.enable_interrupt(&mut exti);
        meter_irq.make_interrupt_source(&mut syscfg);
        meter_irq.trigger_on_edge(&mut exti, Edge::Falling);
        meter_irq.clear_interrupt_pending_bit();
        meter_irq.enable_interrupt(&mut exti);

        SPI1::enable(&mut rcc);
        SPI1::reset(&mut rcc);
        SPI2::enable(&mut rcc);
        SPI2::reset(&mut rcc);

        let recorder = EdgeRecorder::new(time::now(), range_flag.is_high());
        Self {
            watchdog,
            previous,
            edges: Edges {
                exti,
                flag: range_flag,
                recorder,
                high: HighTime::start(dp.TIM4, &mut rcc),
                guard: StormGuard::new(),
                config: configuration.edge_storm,
            },
            meter_line: MeterLine {
                pin: meter_irq,
                guard: StormGuard::new(),
                config: configuration.meter_line_storm,
            },
            meter_spi: spi::Device::new(dp.SPI1, meter_select, METER_SPI),
            flash_spi: spi::Device::new(dp.SPI2, flash_select, FLASH_SPI),
            i2c: i2c::Bus::new(dp.I2C1, i2c_clock, i2c_data, &mut rcc),
            analog: Analog::new(dp.ADC1, &dp.ADC_COMMON, &mut rcc),
            can: can_bus::Bus::new(dp.CAN1, &mut rcc, can::Receiver::IDS),
            rs485: rs485::Port::new(dp.USART2, rs485_driver, &mut rcc),
            lines: Lines::new(key_acc, hv_feedback, hv_permit),
        }
    }
}
