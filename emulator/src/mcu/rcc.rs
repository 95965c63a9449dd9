//! Reset and clock control (RM0090, section 7).

use super::word::{check_width, merge, only_bits, part, refuse_bits, unknown, unmodelled};
use super::{Clocks, Context, Peripheral, Unmodelled};
use crate::time::Ticks;

/// Internal high-speed oscillator, in Hz (data sheet of the STM32F405).
const HSI_HZ: u32 = 16_000_000;
/// Its start-up time (data sheet, HSI: 2.2 µs typical).
const HSI_STARTUP: Ticks = Ticks(Ticks::PER_MICROSECOND * 22 / 10);

const CR_HSION: u32 = 1 << 0;
const CR_HSIRDY: u32 = 1 << 1;
const CR_HSITRIM: u32 = 0x1F << 3;
const CR_HSITRIM_RESET: u32 = 16 << 3;
/// Factory calibration of HSI; differs from part to part (RM0090: "XX").
const CR_HSICAL: u32 = 0x5F << 8;
const CR_HSEON: u32 = 1 << 16;
const CR_HSERDY: u32 = 1 << 17;
const CR_HSEBYP: u32 = 1 << 18;
const CR_CSSON: u32 = 1 << 19;
const CR_PLLON: u32 = 1 << 24;
const CR_PLLRDY: u32 = 1 << 25;
const CR_PLLI2SON: u32 = 1 << 26;
const CR_DEFINED: u32 = 0x0F0F_FFFB;

const CIR_CSSF: u32 = 1 << 7;
const CIR_CSSC: u32 = 1 << 23;

const PLLCFGR_RESET: u32 = 0x2400_3010;
const PLLCFGR_DEFINED: u32 = 0x0F43_7FFF;
/// Reserved, but set in the reset value: kept as written.
const PLLCFGR_RESERVED_HIGH: u32 = 0xF000_0000;
const PLLCFGR_SOURCE_HSE: u32 = 1 << 22;
const PLLI2SCFGR_RESET: u32 = 0x2000_3000;

const CFGR_SW: u32 = 0b11;
const CFGR_PRESCALERS: u32 = 0xFCF0;
/// PPRE1 and PPRE2.
const CFGR_APB_PRESCALERS: u32 = 0xFC00;
/// MCO1, MCO2, I2SSRC and RTCPRE: outputs and clocks that this board does not use.
const CFGR_UNUSED: u32 = 0xFFFF_0000;

const CSR_LSION: u32 = 1 << 0;
const CSR_LSIRDY: u32 = 1 << 1;
const CSR_RMVF: u32 = 1 << 24;
const CSR_BORRSTF: u32 = 1 << 25;
const CSR_PINRSTF: u32 = 1 << 26;
const CSR_PORRSTF: u32 = 1 << 27;
const CSR_SFTRSTF: u32 = 1 << 28;
const CSR_IWDGRSTF: u32 = 1 << 29;
const CSR_WWDGRSTF: u32 = 1 << 30;
const CSR_LPWRRSTF: u32 = 1 << 31;

/// Limits of the tree at 2.7 … 3.6 V and voltage scale 1 (data sheet, general operating conditions), in Hz.
const AHB_LIMIT_HZ: u32 = 168_000_000;
const APB1_LIMIT_HZ: u32 = 42_000_000;
const APB2_LIMIT_HZ: u32 = 84_000_000;

/// Times of the oscillators and the health of the crystal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RccParameters {
    /// The crystal, in Hz (board: 8 MHz).
    pub crystal_hz: u32,
    /// Whether it swings. Where it does not, HSERDY never comes.
    pub crystal_swings: bool,
    /// From HSEON to HSERDY (data sheet, HSE: 2 ms typical).
    pub crystal_startup: Ticks,
    /// From PLLON to PLLRDY (data sheet, main PLL: 75 … 200 µs at the lowest VCO frequency, 100 … 300 µs at the highest).
    pub pll_lock: Ticks,
    /// From LSION to LSIRDY (data sheet, LSI: 15 µs typical, 40 µs at most).
    pub lsi_startup: Ticks,
}

impl Default for RccParameters {
    fn default() -> Self {
        Self {
            crystal_hz: 8_000_000,
            crystal_swings: true,
            crystal_startup: Ticks::from_millis(2),
            pll_lock: Ticks::from_micros(200),
            lsi_startup: Ticks::from_micros(15),
        }
    }
}

/// Peripherals of the board that RCC clocks and resets.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum PeripheralId {
    /// Port A.
    GpioA,
    /// Port B.
    GpioB,
    /// Port C.
    GpioC,
    /// TIM2.
    Tim2,
    /// TIM4.
    Tim4,
    /// SPI2.
    Spi2,
    /// USART2.
    Usart2,
    /// I2C1.
    I2c1,
    /// CAN1.
    Can1,
    /// Power controller.
    Pwr,
    /// ADC1; its reset is that of all three converters (RM0090, `RCC_APB2RSTR`).
    Adc1,
    /// SPI1.
    Spi1,
    /// System configuration controller.
    Syscfg,
}

impl PeripheralId {
    /// All of them.
    pub const ALL: [Self; 13] = [
        Self::GpioA,
        Self::GpioB,
        Self::GpioC,
        Self::Tim2,
        Self::Tim4,
        Self::Spi2,
        Self::Usart2,
        Self::I2c1,
        Self::Can1,
        Self::Pwr,
        Self::Adc1,
        Self::Spi1,
        Self::Syscfg,
    ];

    /// Port 0 … 2.
    pub const fn gpio(port: usize) -> Self {
        match port {
            0 => Self::GpioA,
            1 => Self::GpioB,
            _ => Self::GpioC,
        }
    }

    /// Index into [`BUSES`] and bit of both the enable and the reset register (the same for all of these).
    const fn place(self) -> (usize, u8) {
        match self {
            Self::GpioA => (0, 0),
            Self::GpioB => (0, 1),
            Self::GpioC => (0, 2),
            Self::Tim2 => (3, 0),
            Self::Tim4 => (3, 2),
            Self::Spi2 => (3, 14),
            Self::Usart2 => (3, 17),
            Self::I2c1 => (3, 21),
            Self::Can1 => (3, 25),
            Self::Pwr => (3, 28),
            Self::Adc1 => (4, 8),
            Self::Spi1 => (4, 12),
            Self::Syscfg => (4, 14),
        }
    }

    const fn is_in(self, words: &[u32; 5]) -> bool {
        let (bus, bit) = self.place();
        words[bus] >> bit & 1 != 0
    }
}

/// One bus with its three registers; the enable register is 0x20 and the low-power one 0x40 behind the reset register.
struct Bus {
    name: &'static str,
    reset_offset: u32,
    enable_bits: u32,
    enable_reset: u32,
    reset_bits: u32,
    low_power_reset: u32,
}

/// RM0090, register map of RCC for the STM32F405 … 407.
const BUSES: [Bus; 5] = [
    Bus {
        name: "AHB1",
        reset_offset: 0x10,
        enable_bits: 0x7E74_11FF,
        enable_reset: 0x0010_0000,
        reset_bits: 0x2260_11FF,
        low_power_reset: 0x7E67_91FF,
    },
    Bus {
        name: "AHB2",
        reset_offset: 0x14,
        enable_bits: 0xF1,
        enable_reset: 0,
        reset_bits: 0xF1,
        low_power_reset: 0xF1,
    },
    Bus {
        name: "AHB3",
        reset_offset: 0x18,
        enable_bits: 1,
        enable_reset: 0,
        reset_bits: 1,
        low_power_reset: 1,
    },
    Bus {
        name: "APB1",
        reset_offset: 0x20,
        enable_bits: 0x36FE_C9FF,
        enable_reset: 0,
        reset_bits: 0x36FE_C9FF,
        low_power_reset: 0x36FE_C9FF,
    },
    Bus {
        name: "APB2",
        reset_offset: 0x24,
        enable_bits: 0x0007_5F33,
        enable_reset: 0,
        reset_bits: 0x0007_5933,
        low_power_reset: 0x0007_5F33,
    },
];

/// A register of one of the buses.
enum BusRegister {
    Reset(usize),
    Enable(usize),
    LowPower(usize),
}

impl BusRegister {
    fn at(offset: u32) -> Option<Self> {
        let find = |reset_offset: u32| {
            BUSES
                .iter()
                .position(|bus| bus.reset_offset == reset_offset)
        };
        find(offset)
            .map(Self::Reset)
            .or_else(|| find(offset.checked_sub(0x20)?).map(Self::Enable))
            .or_else(|| find(offset.checked_sub(0x40)?).map(Self::LowPower))
    }
}

/// Why the MCU was reset (RM0090, `RCC_CSR`).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum ResetCause {
    /// The supply came up from nothing.
    PowerOn,
    /// The supply fell below the brown-out threshold, not so low that the flags were lost.
    BrownOut,
    /// NRST was pulled low from outside.
    Pin,
    /// SYSRESETREQ.
    Software,
    /// The independent watchdog.
    IndependentWatchdog,
    /// The window watchdog.
    WindowWatchdog,
    /// Entry into Stop or Standby with the option bit against it.
    LowPower,
}

/// What the core may run from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Source {
    Hsi,
    Hse,
    Pll,
}

/// An oscillator or PLL.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Oscillator {
    on: bool,
    /// Nothing here while it is on: it never gets ready.
    ready_at: Option<Ticks>,
}

impl Oscillator {
    const OFF: Self = Self {
        on: false,
        ready_at: None,
    };

    fn is_ready(self, now: Ticks) -> bool {
        self.on && self.ready_at.is_some_and(|at| at <= now)
    }

    fn set(&mut self, on: bool, ready_at: Option<Ticks>) {
        if on != self.on {
            *self = if on { Self { on, ready_at } } else { Self::OFF };
        }
    }
}

/// RCC.
///
/// Not modelled: bypass, PLLI2S, spread spectrum, LSE and RTC, the clock outputs, interrupts, clocks that stop in sleep, what a
/// PLL does whose crystal stops without clock security (it goes on), and tolerances of HSI and crystal (virtual time
/// has whole ticks per period).
#[derive(Clone, Debug)]
pub struct Rcc {
    parameters: RccParameters,
    hsi: Oscillator,
    hse: Oscillator,
    pll: Oscillator,
    lsi: Oscillator,
    /// Clock security is on.
    secured: bool,
    /// It has found the crystal stopped: CSSF.
    stopped: bool,
    pllcfgr: u32,
    /// SW and the prescalers.
    cfgr: u32,
    source: Source,
    clocks: Clocks,
    enable: [u32; 5],
    held: [u32; 5],
    resets: Vec<PeripheralId>,
    /// Flags of CSR: they outlive every reset but a power-on.
    flags: u32,
}

impl Default for Rcc {
    fn default() -> Self {
        Self::new(RccParameters::default())
    }
}

impl Rcc {
    /// After power-on: HSI runs, everything else is off.
    pub fn new(parameters: RccParameters) -> Self {
        Self {
            parameters,
            hsi: Oscillator {
                on: true,
                ready_at: Some(Ticks(0)),
            },
            hse: Oscillator::OFF,
            pll: Oscillator::OFF,
            lsi: Oscillator::OFF,
            secured: false,
            stopped: false,
            pllcfgr: PLLCFGR_RESET,
            cfgr: 0,
            source: Source::Hsi,
            clocks: Clocks {
                ahb: HSI_HZ,
                apb1: HSI_HZ,
                apb2: HSI_HZ,
                apb1_timers: HSI_HZ,
            },
            enable: std::array::from_fn(|bus| BUSES[bus].enable_reset),
            held: [0; 5],
            resets: Vec::new(),
            flags: CSR_PORRSTF | CSR_PINRSTF | CSR_BORRSTF,
        }
    }

    /// Whether the crystal swings the next time it is switched on.
    pub const fn set_crystal_swings(&mut self, swings: bool) {
        self.parameters.crystal_swings = swings;
    }

    /// The crystal stops, and does not swing until [`Rcc::set_crystal_swings`] lets it. Whether clock security raises NMI: it has
    /// switched the crystal off, and where that fed the core, directly or through the PLL, HSI is in its place (RM0090, 7.2.7).
    pub fn stop_crystal(&mut self, now: Ticks) -> bool {
        self.parameters.crystal_swings = false;
        if !self.secured || !self.hse.is_ready(now) {
            return false;
        }
        self.hse = Oscillator::OFF;
        if self.pll_source() == Source::Hse {
            self.pll = Oscillator::OFF;
        }
        if self.source == Source::Hse || self.source == Source::Pll && !self.pll.on {
            self.hsi.set(true, Some(now));
            self.cfgr &= !CFGR_SW;
        }
        self.secured = false;
        self.stopped = true;
        true
    }

    /// The clocks as they are since the last write or event.
    pub const fn clocks(&self) -> Clocks {
        self.clocks
    }

    /// Whether the peripheral has its clock.
    pub const fn is_enabled(&self, peripheral: PeripheralId) -> bool {
        peripheral.is_in(&self.enable)
    }

    /// Whether its reset bit is still set: it does not keep what is written to it.
    pub const fn is_held_in_reset(&self, peripheral: PeripheralId) -> bool {
        peripheral.is_in(&self.held)
    }

    /// Takes the peripherals whose reset bit was set since the last call, in that order.
    pub fn take_resets(&mut self) -> Vec<PeripheralId> {
        std::mem::take(&mut self.resets)
    }

    /// Notes the cause of a system reset in CSR.
    ///
    /// Every internal reset drives NRST, so PINRSTF comes with all of them; a power-on also sets BORRSTF, and it alone
    /// clears the older flags (RM0090, `RCC_CSR`, reset value 0x0E00 0000).
    pub const fn set_reset_cause(&mut self, cause: ResetCause) {
        let flag = match cause {
            ResetCause::PowerOn => {
                self.flags = 0;
                CSR_PORRSTF | CSR_BORRSTF
            }
            ResetCause::BrownOut => CSR_BORRSTF,
            ResetCause::Pin => CSR_PINRSTF,
            ResetCause::Software => CSR_SFTRSTF,
            ResetCause::IndependentWatchdog => CSR_IWDGRSTF,
            ResetCause::WindowWatchdog => CSR_WWDGRSTF,
            ResetCause::LowPower => CSR_LPWRRSTF,
        };
        self.flags |= flag | CSR_PINRSTF;
    }

    const fn oscillator(&self, source: Source) -> Oscillator {
        match source {
            Source::Hsi => self.hsi,
            Source::Hse => self.hse,
            Source::Pll => self.pll,
        }
    }

    const fn pll_source(&self) -> Source {
        if self.pllcfgr & PLLCFGR_SOURCE_HSE == 0 {
            Source::Hsi
        } else {
            Source::Hse
        }
    }

    /// What SW asks for.
    const fn wanted(&self) -> Source {
        match self.cfgr & CFGR_SW {
            0 => Source::Hsi,
            1 => Source::Hse,
            _ => Source::Pll,
        }
    }

    /// Whether hardware keeps `source` on: it is the system clock, directly or through the PLL, or about to be.
    fn is_needed(&self, source: Source) -> bool {
        [self.source, self.wanted()]
            .into_iter()
            .filter(|used| *used == self.source || self.oscillator(*used).on)
            .any(|used| used == source || used == Source::Pll && self.pll_source() == source)
    }

    /// Changes over when the wanted source is ready (RM0090, 7.2.6).
    fn update(&mut self, now: Ticks) {
        let wanted = self.wanted();
        if wanted != self.source && self.oscillator(wanted).is_ready(now) {
            // It was checked when it was asked for.
            if let Ok(clocks) = self.clocks_from(wanted, self.cfgr) {
                self.source = wanted;
                self.clocks = clocks;
            }
        }
    }

    fn pll_hz(&self) -> Result<u32, Unmodelled> {
        let refuse = |what: String| Err(unmodelled("RCC_PLLCFGR", what));
        let m = self.pllcfgr & 0x3F;
        let n = self.pllcfgr >> 6 & 0x1FF;
        let p = 2 * (self.pllcfgr >> 16 & 3) + 2;
        let q = self.pllcfgr >> 24 & 0xF;
        let input = match self.pll_source() {
            Source::Hsi => HSI_HZ,
            _ => self.parameters.crystal_hz,
        };
        if m < 2 {
            return refuse(format!("PLLM = {m}, below 2"));
        }
        if !(50..=432).contains(&n) {
            return refuse(format!("PLLN = {n}, outside 50 … 432"));
        }
        if q < 2 {
            return refuse(format!("PLLQ = {q}, below 2"));
        }
        // As fractions: input / M.
        let (input, m, n, p) = (u64::from(input), u64::from(m), u64::from(n), u64::from(p));
        if !(1_000_000 * m..=2_000_000 * m).contains(&input) {
            return refuse(format!("{input} Hz / {m} into the PLL, outside 1 … 2 MHz"));
        }
        if !(100_000_000 * m..=432_000_000 * m).contains(&(input * n)) {
            return refuse(format!(
                "VCO at {input} Hz / {m} · {n}, outside 100 … 432 MHz"
            ));
        }
        let (dividend, divisor) = (input * n, m * p);
        if !dividend.is_multiple_of(divisor) {
            return refuse(format!(
                "PLL output of {dividend} / {divisor} Hz, not whole"
            ));
        }
        u32::try_from(dividend / divisor).or_else(|_| refuse("PLL output".to_owned()))
    }

    fn source_hz(&self, source: Source) -> Result<u32, Unmodelled> {
        match source {
            Source::Hsi => Ok(HSI_HZ),
            Source::Hse => Ok(self.parameters.crystal_hz),
            Source::Pll => self.pll_hz(),
        }
    }

    /// The tree fed by `source` with the prescalers of `cfgr`.
    fn clocks_from(&self, source: Source, cfgr: u32) -> Result<Clocks, Unmodelled> {
        let hz = self.source_hz(source)?;
        let apb_divider = |shift: u32| match cfgr >> shift & 7 {
            code @ 4.. => 2 << (code - 4),
            _ => 1,
        };
        let ahb_divider = match cfgr >> 4 & 0xF {
            code @ 8..=11 => 2 << (code - 8),
            code @ 12.. => 64 << (code - 12),
            _ => 1,
        };
        let ahb = hz / ahb_divider;
        let (apb1_divider, apb2_divider) = (apb_divider(10), apb_divider(13));
        let clocks = Clocks {
            ahb,
            apb1: ahb / apb1_divider,
            apb2: ahb / apb2_divider,
            apb1_timers: ahb / (apb1_divider / 2).max(1),
        };
        let limits = [
            ("AHB", clocks.ahb, AHB_LIMIT_HZ),
            ("APB1", clocks.apb1, APB1_LIMIT_HZ),
            ("APB2", clocks.apb2, APB2_LIMIT_HZ),
        ];
        for (name, hz, limit) in limits {
            if hz > limit {
                return Err(unmodelled(
                    "RCC_CFGR",
                    format!("{name} at {hz} Hz, above {limit} Hz"),
                ));
            }
        }
        let slowest = apb1_divider.max(apb2_divider);
        if hz % ahb_divider != 0
            || ahb % slowest != 0
            || !Ticks::PER_SECOND.is_multiple_of(u64::from(ahb))
        {
            return Err(unmodelled(
                "RCC_CFGR",
                format!("{hz} Hz / {ahb_divider} without whole ticks of virtual time"),
            ));
        }
        Ok(clocks)
    }

    fn read_cr(&self, now: Ticks) -> u32 {
        let flag = |bit: u32, set: bool| if set { bit } else { 0 };
        CR_HSITRIM_RESET
            | CR_HSICAL
            | flag(CR_HSION, self.hsi.on)
            | flag(CR_HSIRDY, self.hsi.is_ready(now))
            | flag(CR_HSEON, self.hse.on)
            | flag(CR_HSERDY, self.hse.is_ready(now))
            | flag(CR_CSSON, self.secured)
            | flag(CR_PLLON, self.pll.on)
            | flag(CR_PLLRDY, self.pll.is_ready(now))
    }

    fn write_cr(&mut self, value: u32, now: Ticks) -> Result<(), Unmodelled> {
        only_bits("RCC_CR", value, CR_DEFINED)?;
        refuse_bits("RCC_CR", value & (CR_HSEBYP | CR_PLLI2SON))?;
        if value & CR_HSITRIM != CR_HSITRIM_RESET {
            return Err(unmodelled("RCC_CR", "HSITRIM other than 16"));
        }
        let on = |bit: u32| value & bit != 0;
        // RM0090 lets it be set before, and hardware waits for HSERDY with it: nobody here does.
        if on(CR_CSSON) && !self.hse.is_ready(now) {
            return Err(unmodelled("RCC_CR", "CSSON before the crystal is ready"));
        }
        let pll_on = on(CR_PLLON) || self.is_needed(Source::Pll);
        let kept = |source: Source, bit: u32| {
            let fed_pll_runs = self.pll.on && pll_on && self.pll_source() == source;
            if !on(bit) && fed_pll_runs && !self.is_needed(source) {
                return Err(unmodelled("RCC_CR", "PLL running without its source"));
            }
            Ok(on(bit) || self.is_needed(source))
        };
        let (hsi_on, hse_on) = (kept(Source::Hsi, CR_HSION)?, kept(Source::Hse, CR_HSEON)?);
        self.hsi.set(hsi_on, Some(now + HSI_STARTUP));
        let ready_at = self
            .parameters
            .crystal_swings
            .then(|| now + self.parameters.crystal_startup);
        self.hse.set(hse_on, ready_at);
        if pll_on && !self.pll.on {
            self.pll_hz()?;
            if self.wanted() == Source::Pll {
                self.clocks_from(Source::Pll, self.cfgr)?;
            }
            if !self.oscillator(self.pll_source()).is_ready(now) {
                return Err(unmodelled("RCC_CR", "PLLON before its source is ready"));
            }
        }
        self.pll.set(pll_on, Some(now + self.parameters.pll_lock));
        self.secured = on(CR_CSSON);
        Ok(())
    }

    fn write_cfgr(&mut self, value: u32, now: Ticks) -> Result<(), Unmodelled> {
        // SWS is read-only.
        only_bits("RCC_CFGR", value, CFGR_UNUSED | CFGR_PRESCALERS | 0xF)?;
        refuse_bits("RCC_CFGR", value & CFGR_UNUSED)?;
        if value & CFGR_SW == CFGR_SW {
            return Err(unmodelled("RCC_CFGR", "SW = 3"));
        }
        let cfgr = value & (CFGR_PRESCALERS | CFGR_SW);
        let old = std::mem::replace(&mut self.cfgr, cfgr);
        let wanted = self.wanted();
        let checked = self.clocks_from(wanted, cfgr).and_then(|clocks| {
            // A source that is left at once never sees the new prescalers.
            if wanted == self.source || self.oscillator(wanted).is_ready(now) {
                Ok(clocks)
            } else {
                self.clocks_from(self.source, cfgr)
            }
        });
        // A new PPRE works 1 … 16 AHB cycles after the write (RM0090, RCC_CFGR): the old one would divide the new clock.
        let checked = checked.and_then(|clocks| {
            let risen = self.source_hz(wanted)? > self.source_hz(self.source)?;
            if risen && (cfgr ^ old) & CFGR_APB_PRESCALERS != 0 {
                return Err(unmodelled(
                    "RCC_CFGR",
                    "another PPRE in the write that raises SYSCLK: it works up to 16 AHB cycles later",
                ));
            }
            Ok(clocks)
        });
        match checked {
            Ok(clocks) => self.clocks = clocks,
            Err(refused) => {
                self.cfgr = old;
                return Err(refused);
            }
        }
        Ok(())
    }

    fn write_bus(&mut self, register: &BusRegister, value: u32) -> Result<(), Unmodelled> {
        match *register {
            BusRegister::Enable(bus) => {
                only_bits(
                    &format!("RCC_{}ENR", BUSES[bus].name),
                    value,
                    BUSES[bus].enable_bits,
                )?;
                self.enable[bus] = value;
            }
            BusRegister::Reset(bus) => {
                only_bits(
                    &format!("RCC_{}RSTR", BUSES[bus].name),
                    value,
                    BUSES[bus].reset_bits,
                )?;
                let before = std::mem::replace(&mut self.held[bus], value);
                self.resets
                    .extend(PeripheralId::ALL.into_iter().filter(|peripheral| {
                        let (place, bit) = peripheral.place();
                        place == bus && (value & !before) >> bit & 1 != 0
                    }));
            }
            BusRegister::LowPower(bus) => {
                if value != BUSES[bus].low_power_reset {
                    return Err(unmodelled(
                        format!("RCC_{}LPENR", BUSES[bus].name),
                        "clock that stops in sleep",
                    ));
                }
            }
        }
        Ok(())
    }

    /// The register's word, without side effects.
    fn word(&self, offset: u32, now: Ticks) -> Result<u32, Unmodelled> {
        Ok(match offset {
            0x00 => self.read_cr(now),
            0x04 => self.pllcfgr,
            0x08 => {
                let sws = match self.source {
                    Source::Hsi => 0,
                    Source::Hse => 1,
                    Source::Pll => 2,
                };
                self.cfgr | sws << 2
            }
            // CIR: its flags come with interrupt enables only, but for CSSF. BDCR: nothing of it is on. SSCGR: off.
            0x0C => u32::from(self.stopped) << 7,
            0x70 | 0x80 => 0,
            0x74 => {
                let mut csr = self.flags;
                if self.lsi.on {
                    csr |= CSR_LSION;
                }
                if self.lsi.is_ready(now) {
                    csr |= CSR_LSIRDY;
                }
                csr
            }
            0x84 => PLLI2SCFGR_RESET,
            _ => match BusRegister::at(offset) {
                Some(BusRegister::Enable(bus)) => self.enable[bus],
                Some(BusRegister::Reset(bus)) => self.held[bus],
                Some(BusRegister::LowPower(bus)) => BUSES[bus].low_power_reset,
                None => return Err(unknown("RCC", offset, "read")),
            },
        })
    }
}

impl Peripheral for Rcc {
    fn read(
        &mut self,
        offset: u32,
        bytes: u8,
        context: &mut Context<'_>,
    ) -> Result<u32, Unmodelled> {
        check_width("RCC", offset, bytes, 1)?;
        self.update(context.now);
        Ok(part(self.word(offset & !3, context.now)?, offset, bytes))
    }

    fn write(
        &mut self,
        offset: u32,
        bytes: u8,
        value: u32,
        context: &mut Context<'_>,
    ) -> Result<(), Unmodelled> {
        check_width("RCC", offset, bytes, 1)?;
        let now = context.now;
        self.update(now);
        let register = offset & !3;
        let value = merge(self.word(register, now)?, offset, bytes, value);
        match register {
            0x00 => self.write_cr(value, now)?,
            0x04 => {
                only_bits(
                    "RCC_PLLCFGR",
                    value,
                    PLLCFGR_DEFINED | PLLCFGR_RESERVED_HIGH,
                )?;
                if self.pll.on && value != self.pllcfgr {
                    return Err(unmodelled("RCC_PLLCFGR", "change while the PLL is on"));
                }
                self.pllcfgr = value;
            }
            0x08 => self.write_cfgr(value, now)?,
            0x0C => {
                // The clear bits have nothing to clear, but for CSSC.
                only_bits("RCC_CIR", value & !CIR_CSSF, 0x00BF_0000)?;
                self.stopped &= value & CIR_CSSC == 0;
            }
            0x70 => refuse_bits("RCC_BDCR", value)?,
            0x74 => {
                only_bits("RCC_CSR", value, 0xFF00_0003)?;
                self.lsi.set(
                    value & CSR_LSION != 0,
                    Some(now + self.parameters.lsi_startup),
                );
                if value & CSR_RMVF != 0 {
                    self.flags = 0;
                }
            }
            0x80 => refuse_bits("RCC_SSCGR", value)?,
            _ => match BusRegister::at(register) {
                Some(bus_register) => self.write_bus(&bus_register, value)?,
                None => return Err(unknown("RCC", register, "write")),
            },
        }
        self.update(now);
        Ok(())
    }

    fn next_event(&self) -> Option<Ticks> {
        let wanted = self.wanted();
        let oscillator = self.oscillator(wanted);
        if wanted == self.source || !oscillator.on {
            return None;
        }
        oscillator.ready_at
    }

    fn advance(&mut self, context: &mut Context<'_>) {
        self.update(context.now);
    }

    /// A system reset. The flags of CSR stay: [`Rcc::set_reset_cause`] adds the new one.
    fn reset(&mut self, _context: &mut Context<'_>) {
        let flags = self.flags;
        *self = Self::new(self.parameters);
        self.flags = flags;
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

    use proptest::prelude::*;

    use super::super::test_world::World;
    use super::*;

    const CR: u32 = 0x00;
    const PLLCFGR: u32 = 0x04;
    const CFGR: u32 = 0x08;
    const CSR: u32 = 0x74;

    fn pllcfgr(m: u32, n: u32, p: u32, q: u32, hse: bool) -> u32 {
        m | n << 6 | (p / 2 - 1) << 16 | q << 24 | u32::from(hse) << 22
    }

    /// 168 MHz from the crystal, as far as the ready PLL.
    fn with_pll(world: &mut World) -> Rcc {
        let mut rcc = Rcc::default();
        world.write(&mut rcc, CR, 0x0001_0083);
        world.now += Ticks::from_millis(2);
        world.write(&mut rcc, PLLCFGR, pllcfgr(4, 168, 2, 7, true));
        world.write(&mut rcc, CR, 0x0101_0083);
        world.now += Ticks::from_micros(200);
        rcc
    }

    /// PPRE1 / 4, PPRE2 / 2, then PLL.
    fn run_from_pll(world: &mut World, rcc: &mut Rcc) {
        world.write(rcc, CFGR, 0b101 << 10 | 0b100 << 13);
        world.write(rcc, CFGR, 0b101 << 10 | 0b100 << 13 | 2);
    }

    #[test]
    fn reset_values_are_the_manuals() {
        let mut world = World::default();
        let mut rcc = Rcc::default();
        // CR: 0x0000 XX83, the calibration being the part's own.
        assert_eq!(world.read(&mut rcc, CR) & !0xFF00, 0x83);
        let values = [
            (PLLCFGR, 0x2400_3010),
            (CFGR, 0),
            (0x0C, 0),
            (0x10, 0),
            (0x20, 0),
            (0x24, 0),
            (0x30, 0x0010_0000),
            (0x34, 0),
            (0x38, 0),
            (0x40, 0),
            (0x44, 0),
            (0x50, 0x7E67_91FF),
            (0x54, 0xF1),
            (0x58, 1),
            (0x60, 0x36FE_C9FF),
            (0x64, 0x0007_5F33),
            (0x70, 0),
            (CSR, 0x0E00_0000),
            (0x80, 0),
            (0x84, 0x2000_3000),
        ];
        for (offset, value) in values {
            assert_eq!(world.read(&mut rcc, offset), value, "offset {offset:#X}");
        }
        assert_eq!(rcc.clocks().ahb, 16_000_000);
        for offset in [0x1C, 0x28, 0x3C, 0x48, 0x68, 0x78, 0x88] {
            assert!(rcc.read(offset, 4, &mut world.context()).is_err());
        }
    }

    #[test]
    fn crystal_and_pll_are_ready_after_their_times() {
        let mut world = World::default();
        let mut rcc = Rcc::default();
        world.now = Ticks::from_micros(7);
        world.write(&mut rcc, CR, 0x0001_0083);
        world.now += Ticks(Ticks::from_millis(2).0 - 1);
        assert_eq!(world.read(&mut rcc, CR) & CR_HSERDY, 0);
        world.now += Ticks(1);
        assert_ne!(world.read(&mut rcc, CR) & CR_HSERDY, 0);
        world.write(&mut rcc, PLLCFGR, pllcfgr(4, 168, 2, 7, true));
        world.write(&mut rcc, CR, 0x0101_0083);
        world.now += Ticks(Ticks::from_micros(200).0 - 1);
        assert_eq!(world.read(&mut rcc, CR) & CR_PLLRDY, 0);
        world.now += Ticks(1);
        assert_ne!(world.read(&mut rcc, CR) & CR_PLLRDY, 0);
    }

    #[test]
    fn tree_of_the_board() {
        let mut world = World::default();
        let mut rcc = with_pll(&mut world);
        assert_eq!(rcc.clocks().ahb, 16_000_000);
        run_from_pll(&mut world, &mut rcc);
        assert_eq!(world.read(&mut rcc, CFGR) & 0xF, 0b1010);
        assert_eq!(
            rcc.clocks(),
            Clocks {
                ahb: 168_000_000,
                apb1: 42_000_000,
                apb2: 84_000_000,
                apb1_timers: 84_000_000,
            }
        );
        // What runs the core cannot be switched off.
        world.write(&mut rcc, CR, 0x80);
        assert_eq!(world.read(&mut rcc, CR) & !0xFF00, 0x0303_0080);
    }

    #[test]
    fn back_to_hsi_in_one_write() {
        let mut world = World::default();
        let mut rcc = with_pll(&mut world);
        run_from_pll(&mut world, &mut rcc);
        world.write(&mut rcc, CFGR, 0);
        assert_eq!(rcc.clocks(), Rcc::default().clocks());
        world.write(&mut rcc, CR, 0x83);
        assert_eq!(world.read(&mut rcc, CR) & !0xFF00, 0x83);
    }

    #[test]
    fn prescalers_come_before_the_faster_clock() {
        let mut world = World::default();
        let mut rcc = with_pll(&mut world);
        let refused = rcc
            .write(CFGR, 4, 0b101 << 10 | 0b100 << 13 | 2, &mut world.context())
            .unwrap_err();
        assert!(refused.what.contains("PPRE"), "{refused}");
        assert_eq!(
            rcc.clocks().ahb,
            16_000_000,
            "a refused write leaves nothing"
        );
        run_from_pll(&mut world, &mut rcc);
        assert_eq!(rcc.clocks().ahb, 168_000_000);
        // Down again in one write: the old dividers are for more than the new clock.
        world.write(&mut rcc, CFGR, 0b100 << 10);
        assert_eq!(rcc.clocks().apb1, 8_000_000);
    }

    #[test]
    fn pending_source_is_checked_with_both() {
        // From HSI to a crystal that is still starting: HSI is divided meanwhile.
        let mut world = World::default();
        let mut rcc = Rcc::default();
        world.write(&mut rcc, CR, 0x0001_0083);
        world.write(&mut rcc, CFGR, 0b100 << 10 | 1);
        assert_eq!(rcc.clocks().apb1, 8_000_000);
        world.run_until(&mut rcc, Ticks::from_millis(2));
        assert_eq!(rcc.clocks().apb1, 4_000_000);
    }

    #[test]
    fn crystal_that_does_not_swing_never_gets_ready() {
        let mut world = World::default();
        let mut rcc = Rcc::default();
        rcc.set_crystal_swings(false);
        world.write(&mut rcc, CR, 0x0001_0083);
        world.write(&mut rcc, CFGR, 1);
        assert_eq!(rcc.next_event(), None);
        world.now = Ticks::from_millis(60_000);
        assert_eq!(world.read(&mut rcc, CR) & !0xFF00, 0x0001_0083);
        assert_eq!(world.read(&mut rcc, CFGR), 1, "SWS stays with HSI");
        assert_eq!(rcc.clocks().ahb, 16_000_000);
    }

    #[test]
    fn a_crystal_that_stops_is_replaced_where_it_is_watched() {
        let (running, secured) = (0x0303_0083, 0x030B_0083);
        let mut world = World::default();
        let mut rcc = with_pll(&mut world);
        run_from_pll(&mut world, &mut rcc);
        world.write(&mut rcc, CR, 0x0101_0083 | CR_CSSON);
        assert_eq!(world.read(&mut rcc, CR) & !0xFF00, secured);
        assert!(rcc.stop_crystal(world.now));
        world.run_until(&mut rcc, world.now + Ticks::from_micros(1));
        assert_eq!(rcc.clocks().ahb, 16_000_000);
        assert_eq!(world.read(&mut rcc, CR) & !0xFF00, 0x83);
        assert_eq!(world.read(&mut rcc, CFGR) & 0xF, 0);
        assert_eq!(world.read(&mut rcc, 0x0C), CIR_CSSF);
        world.write(&mut rcc, 0x0C, CIR_CSSC);
        assert_eq!(world.read(&mut rcc, 0x0C), 0);
        // Once.
        assert!(!rcc.stop_crystal(world.now));

        let mut rcc = with_pll(&mut world);
        run_from_pll(&mut world, &mut rcc);
        assert!(!rcc.stop_crystal(world.now));
        assert_eq!(world.read(&mut rcc, CR) & !0xFF00, running);
        assert_eq!(world.read(&mut rcc, 0x0C), 0);
    }

    #[test]
    fn switch_waits_for_its_source() {
        let mut world = World::default();
        let mut rcc = Rcc::default();
        world.write(&mut rcc, CR, 0x0001_0083);
        world.write(&mut rcc, CFGR, 1);
        assert_eq!(world.read(&mut rcc, CFGR), 1);
        assert_eq!(rcc.next_event(), Some(Ticks::from_millis(2)));
        world.run_until(&mut rcc, Ticks::from_millis(2));
        assert_eq!(rcc.clocks().ahb, 8_000_000);
        assert_eq!(world.read(&mut rcc, CFGR), 0b101);
        assert_eq!(rcc.next_event(), None);
    }

    #[test]
    fn impossible_settings_are_refused() {
        let settings = [
            (1, 168, 2, 7, "PLLM"),
            (4, 49, 2, 7, "PLLN"),
            (4, 433, 2, 7, "PLLN"),
            (4, 168, 2, 1, "PLLQ"),
            (3, 168, 2, 7, "2 MHz"),
            (9, 168, 2, 7, "1"),
            (8, 99, 2, 7, "VCO"),
            (4, 217, 2, 7, "VCO"),
        ];
        for (m, n, p, q, reason) in settings {
            let mut world = World::default();
            let mut rcc = Rcc::default();
            world.write(&mut rcc, CR, 0x0001_0083);
            world.now += Ticks::from_millis(2);
            world.write(&mut rcc, PLLCFGR, pllcfgr(m, n, p, q, true));
            let refused = rcc
                .write(CR, 4, 0x0101_0083, &mut world.context())
                .unwrap_err();
            assert!(refused.what.contains(reason), "{refused}");
        }
        let mut world = World::default();
        let mut rcc = with_pll(&mut world);
        for (prescalers, bus) in [(0b100 << 13, "APB1"), (0b101 << 10, "APB2")] {
            world.write(&mut rcc, CFGR, prescalers);
            let refused = rcc
                .write(CFGR, 4, prescalers | 2, &mut world.context())
                .unwrap_err();
            assert!(refused.what.contains(bus), "{refused}");
            assert_eq!(
                world.read(&mut rcc, CFGR),
                prescalers,
                "a refused write leaves nothing"
            );
        }
        assert!(
            world.refuses(&mut rcc, PLLCFGR, pllcfgr(4, 160, 2, 7, true)),
            "PLLCFGR while on"
        );
        for bits in [CR_HSEBYP, CR_PLLI2SON] {
            assert!(world.refuses(&mut rcc, CR, 0x0101_0083 | bits));
        }
        let mut off = Rcc::default();
        assert!(world.refuses(&mut off, CR, 0x83 | CR_CSSON), "no crystal");
        assert!(world.refuses(&mut rcc, CFGR, 3));
        assert!(world.refuses(&mut rcc, CFGR, 1 << 21));
        assert!(world.refuses(&mut rcc, 0x0C, 1 << 12), "CIR");
        assert!(world.refuses(&mut rcc, 0x70, 1), "BDCR");
        assert!(world.refuses(&mut rcc, 0x50, 0), "AHB1LPENR");
        assert!(world.refuses(&mut rcc, 0x40, 1 << 9), "reserved");
    }

    #[test]
    fn pll_needs_its_source_first() {
        let mut world = World::default();
        let mut rcc = Rcc::default();
        world.write(&mut rcc, PLLCFGR, pllcfgr(4, 168, 2, 7, true));
        assert!(world.refuses(&mut rcc, CR, 0x0101_0083));
    }

    #[test]
    fn reset_flags_accumulate_until_removed() {
        let mut world = World::default();
        let mut rcc = Rcc::default();
        world.write(&mut rcc, CSR, CSR_RMVF);
        assert_eq!(world.read(&mut rcc, CSR), 0);
        rcc.reset(&mut world.context());
        rcc.set_reset_cause(ResetCause::Software);
        assert_eq!(world.read(&mut rcc, CSR), CSR_SFTRSTF | CSR_PINRSTF);
        rcc.reset(&mut world.context());
        rcc.set_reset_cause(ResetCause::IndependentWatchdog);
        assert_eq!(
            world.read(&mut rcc, CSR),
            CSR_SFTRSTF | CSR_IWDGRSTF | CSR_PINRSTF
        );
        rcc.reset(&mut world.context());
        rcc.set_reset_cause(ResetCause::PowerOn);
        assert_eq!(world.read(&mut rcc, CSR), 0x0E00_0000);
    }

    #[test]
    fn lsi_starts_and_stops() {
        let mut world = World::default();
        let mut rcc = Rcc::default();
        world.write(&mut rcc, CSR, CSR_RMVF | CSR_LSION);
        assert_eq!(world.read(&mut rcc, CSR), CSR_LSION);
        world.now = Ticks::from_micros(40);
        assert_eq!(world.read(&mut rcc, CSR), CSR_LSION | CSR_LSIRDY);
        world.write(&mut rcc, CSR, 0);
        assert_eq!(world.read(&mut rcc, CSR), 0);
    }

    #[test]
    fn peripherals_are_clocked_and_reset_by_their_own_bit() {
        let rows = [
            (PeripheralId::GpioA, 0x30, 0),
            (PeripheralId::GpioB, 0x30, 1),
            (PeripheralId::GpioC, 0x30, 2),
            (PeripheralId::Tim2, 0x40, 0),
            (PeripheralId::Tim4, 0x40, 2),
            (PeripheralId::Spi2, 0x40, 14),
            (PeripheralId::Usart2, 0x40, 17),
            (PeripheralId::I2c1, 0x40, 21),
            (PeripheralId::Can1, 0x40, 25),
            (PeripheralId::Pwr, 0x40, 28),
            (PeripheralId::Adc1, 0x44, 8),
            (PeripheralId::Spi1, 0x44, 12),
            (PeripheralId::Syscfg, 0x44, 14),
        ];
        for (peripheral, offset, bit) in rows {
            let mut world = World::default();
            let mut rcc = Rcc::default();
            assert!(!rcc.is_enabled(peripheral));
            let before = world.read(&mut rcc, offset);
            world.write(&mut rcc, offset, before | 1 << bit);
            for other in PeripheralId::ALL {
                assert_eq!(rcc.is_enabled(other), other == peripheral, "{other:?}");
            }
            world.write(&mut rcc, offset - 0x20, 1 << bit);
            assert!(rcc.is_held_in_reset(peripheral));
            world.write(&mut rcc, offset - 0x20, 0);
            assert!(!rcc.is_held_in_reset(peripheral));
            assert_eq!(rcc.take_resets(), [peripheral]);
            assert_eq!(rcc.take_resets(), []);
        }
    }

    #[test]
    fn narrow_writes_leave_the_rest() {
        let mut world = World::default();
        let mut rcc = Rcc::default();
        rcc.write(0x42, 2, 1 << 5, &mut world.context()).unwrap();
        rcc.write(0x41, 1, 1 << 6, &mut world.context()).unwrap();
        assert!(rcc.is_enabled(PeripheralId::I2c1));
        assert!(rcc.is_enabled(PeripheralId::Spi2));
        assert_eq!(world.read(&mut rcc, 0x40), 1 << 21 | 1 << 14);
    }

    #[test]
    fn system_reset_goes_back_to_hsi() {
        let mut world = World::default();
        let mut rcc = with_pll(&mut world);
        run_from_pll(&mut world, &mut rcc);
        world.write(&mut rcc, 0x40, 1);
        rcc.reset(&mut world.context());
        assert_eq!(rcc.clocks().ahb, 16_000_000);
        assert_eq!(world.read(&mut rcc, CR) & !0xFF00, 0x83);
        assert!(!rcc.is_enabled(PeripheralId::Tim2));
    }

    proptest! {
        /// Prescalers as in RM0090's tables: HSI through any of them.
        #[test]
        fn prescalers_divide(ahb in 0u32..16, apb1 in 0u32..8, apb2 in 0u32..8) {
            let divider = [1, 1, 1, 1, 1, 1, 1, 1, 2, 4, 8, 16, 64, 128, 256, 512][ahb as usize];
            let apb = [1, 1, 1, 1, 2, 4, 8, 16];
            let mut world = World::default();
            let mut rcc = Rcc::default();
            let written = rcc.write(
                CFGR, 4, ahb << 4 | apb1 << 10 | apb2 << 13, &mut world.context(),
            );
            let slowest = 16_000_000 % (divider * apb[apb1 as usize].max(apb[apb2 as usize]));
            prop_assert_eq!(written.is_ok(), slowest == 0);
            if written.is_ok() {
                let clocks = rcc.clocks();
                prop_assert_eq!(clocks.ahb, 16_000_000 / divider);
                prop_assert_eq!(clocks.apb1, clocks.ahb / apb[apb1 as usize]);
                prop_assert_eq!(clocks.apb2, clocks.ahb / apb[apb2 as usize]);
                let timers = if apb1 < 4 { clocks.apb1 } else { 2 * clocks.apb1 };
                prop_assert_eq!(clocks.apb1_timers, timers);
            }
        }
    }
}
