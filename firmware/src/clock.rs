//! Clocks from the 8 MHz crystal: core and AHB 168 MHz, APB1 42 MHz, APB2 84 MHz.
//!
//! Written out for this one tree: the HAL's search for dividers costs 1.5 kB of flash.

use stm32f4xx_hal::pac::{DBGMCU, FLASH, RCC};

/// Core and AHB; SysTick counts it.
pub const CORE_HZ: u32 = 168_000_000;
/// CAN1 and SPI2, among others.
pub const APB1_HZ: u32 = CORE_HZ / 4;
/// SPI1, among others.
pub const APB2_HZ: u32 = CORE_HZ / 2;

/// DBGMCU_IDCODE, DEV_ID of the STM32F405 and REV_ID of revision A (RM0090, MCU device ID code). Revision A itself shows 0x2000 of
/// DEV_ID 0x411 (errata ES0182, MCU device ID is incorrect).
const DEVICE: u16 = 0x413;
const REVISION_A: u16 = 0x1000;
/// ACR.LATENCY for 168 MHz: above 150 MHz at 2.7 … 3.6 V (RM0090, table 10).
const WAIT_STATES: u8 = 5;

/// Starts crystal and PLL and changes over to them (RM0090, reset and clock control).
///
/// It waits without a bound, for nothing works without a clock: the watchdog, started before, ends the wait.
pub fn start(rcc: &RCC, flash: &FLASH, debug: &DBGMCU) {
    // The first revision's prefetch must stay off (errata ES0182, ART accelerator prefetch queue instruction is not supported).
    let id = debug.idcode().read();
    let prefetches = id.dev_id().bits() == DEVICE && id.rev_id().bits() != REVISION_A;
    flash.acr().write(|w| {
        w.latency().set(WAIT_STATES);
        w.prften().bit(prefetches);
        w.icen().set_bit();
        w.dcen().set_bit()
    });
    // Before the clock rises: five wait states, in force when they are read back, and the prescalers, which work up to 16 AHB cycles
    // after the write (RM0090, 3.5.1 and RCC_CFGR).
    while flash.acr().read().latency().bits() != WAIT_STATES {}
    rcc.cfgr().write(|w| {
        w.hpre().div1();
        w.ppre1().div4();
        w.ppre2().div2()
    });
    rcc.cr().modify(|_, w| w.hseon().set_bit());
    while rcc.cr().read().hserdy().bit_is_clear() {}
    // 8 MHz / 4 · 168 / 2 = 168 MHz; 336 MHz / 7 = 48 MHz. 2 MHz into the PLL has the least jitter (RM0090, PLLCFGR).
    // SAFETY: values within the ranges of RM0090: M 2 … 63, N 50 … 432, Q 2 … 15.
    rcc.pllcfgr().write(|w| unsafe {
        w.pllm().bits(4);
        w.plln().bits(168);
        w.pllp().div2();
        w.pllq().bits(7);
        w.pllsrc().hse()
    });
    rcc.cr().modify(|_, w| w.pllon().set_bit());
    while rcc.cr().read().pllrdy().bit_is_clear() {}
    rcc.cfgr().modify(|_, w| w.sw().pll());
    while !rcc.cfgr().read().sws().is_pll() {}
    // A crystal that stops later would leave a PLL without its reference, and every time wrong: clock security goes back to HSI and
    // raises NMI, for which there is no handler (`fault`).
    rcc.cr().modify(|_, w| w.csson().set_bit());
}

/// Logs it if the option bytes let the core go on below 2.7 V, where five wait states are too few: nothing but the brown-out
/// detector's highest level stops it there.
pub fn check_brown_out_level(flash: &FLASH) {
    // 0 is level 3 and 3 is off (RM0090, FLASH_OPTCR): the PAC's names have it the other way round.
    if flash.optcr().read().bor_lev().bits() != 0 {
        defmt::warn!("brown-out detector below level 3: program the option bytes (BOR_LEV = 0)");
    }
}
