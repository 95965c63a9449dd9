//! ADC1: sensor supply, open-sensor network, and the MCU's own temperature and reference.
//!
//! The converter's full scale is VDDA, which the 3.3 V regulator knows to a few per cent only; the factory's value of
//! the internal reference takes that out. Of the conversions of a tick only the network's, 4.6 µs each, are waited for: the
//! internal channel's goes on from the end of one tick to the next, and the supply's runs beside the tick's own work.
//!
//! D3 measures the current by the network, of which a code is 0.45 A. With a code of noise (rms) four conversions leave 0.23 A, and
//! the reference, a code of which is 0.61 A at 0 A, averaged over 16, 0.61 A · √(1/31) = 0.11 A: 0.25 A together.

use core_logic::units::{Microvolts, MilliCelsius, clamp_i32, div_round, mul_i64};
use stm32f4xx_hal::{
    pac::{ADC_COMMON, ADC1, RCC},
    rcc::{Enable, Reset},
    signature::{VrefCal, VtempCal30, VtempCal110},
};

use crate::time;

/// PC0.
const SUPPLY: u8 = 10;
/// PC1.
const NETWORK: u8 = 11;
const TEMPERATURE: u8 = 16;
const REFERENCE: u8 = 17;

/// The longest conversion takes 480 + 12 clocks of 21 MHz: 23.4 µs.
const CONVERSION_LIMIT_US: u32 = 60;
/// The board halves the sensor's supply.
const SUPPLY_DIVIDER: i64 = 2;
/// VDDA at which the factory took its values (data sheet of the STM32F405, calibration values).
const CALIBRATION_VDDA_UV: i64 = 3_300_000;
const FULL_SCALE: i64 = 4_096;
/// Of the network in a tick.
const NETWORK_CONVERSIONS: i64 = 4;
/// The mean of the reference moves by this part of what a conversion differs from it: 16 of them, 20 ms apart.
const REFERENCE_CONVERSIONS: i64 = 16;
/// A conversion that differs by more codes is another supply, 0.5 % away, and no noise: the mean begins anew.
const REFERENCE_JUMP: i64 = 8;

/// What the converter knows; `None` where it did not answer or has no reference yet.
#[derive(Clone, Copy, Debug, Default)]
pub struct Readings {
    /// Supply of the Hall sensors.
    pub supply: Option<Microvolts>,
    /// Output of the open-sensor network.
    pub network: Option<Microvolts>,
    /// Die temperature of the MCU.
    pub temperature: Option<MilliCelsius>,
    /// The MCU's analogue supply.
    pub vdda: Option<Microvolts>,
}

/// The converter.
pub struct Analog {
    adc: ADC1,
    reference_next: bool,
    /// Mean code of the reference, times [`REFERENCE_CONVERSIONS`].
    reference: Option<i64>,
    vdda_uv: Option<i64>,
    temperature: Option<MilliCelsius>,
    /// Code of the supply.
    supply: Option<i64>,
    /// The internal channel whose conversion was started last.
    internal: Option<u8>,
}

impl Analog {
    /// Takes the converter; its pins are analogue already.
    pub fn new(adc: ADC1, common: &ADC_COMMON, rcc: &mut RCC) -> Self {
        ADC1::enable(rcc);
        ADC1::reset(rcc);
        common.ccr().write(|w| {
            // APB2 / 4 = 21 MHz, below the 36 MHz that the converter takes.
            w.adcpre().div4();
            w.tsvrefe().set_bit()
        });
        // The internal channels want 10 µs; the pins have dividers and networks of some kiloohms behind them.
        adc.smpr1().write(|w| {
            w.smp10().cycles84();
            w.smp11().cycles84();
            w.smp16().cycles480();
            w.smp17().cycles480()
        });
        adc.cr2().write(|w| w.adon().set_bit());
        Self {
            adc,
            reference_next: true,
            reference: None,
            vdda_uv: None,
            temperature: None,
            supply: None,
            internal: None,
        }
    }

    fn start(&mut self, channel: u8) {
        self.adc.sr().write(|w| w.eoc().clear_bit());
        // SAFETY: a channel number of 0 … 18, of the constants above.
        self.adc.sqr3().write(|w| unsafe { w.sq1().bits(channel) });
        self.adc.cr2().modify(|_, w| w.swstart().set_bit());
    }

    /// What [`Analog::start`] has begun.
    fn result(&mut self) -> Option<i64> {
        time::wait_until(CONVERSION_LIMIT_US, || {
            self.adc.sr().read().eoc().bit_is_set()
        })
        .then(|| i64::from(self.adc.dr().read().data().bits()))
    }

    fn microvolts(&self, code: i64, full_scale: i64) -> Option<Microvolts> {
        let vdda = self.vdda_uv?;
        Some(Microvolts(clamp_i32(div_round(
            mul_i64(code, vdda),
            full_scale,
        ))))
    }

    /// Sum of [`NETWORK_CONVERSIONS`].
    fn network(&mut self) -> Option<i64> {
        let mut sum = 0;
        for _ in 0..NETWORK_CONVERSIONS {
            self.start(NETWORK);
            sum += self.result()?;
        }
        Some(sum)
    }

    /// Takes a conversion of the reference into its mean; the supply by that.
    fn supply_by(&mut self, code: i64) -> Option<i64> {
        let calibration = i64::from(VrefCal::get().read());
        if code <= 0 || !(1..FULL_SCALE).contains(&calibration) {
            self.reference = None;
            return None;
        }
        let code = code * REFERENCE_CONVERSIONS;
        let mean = self
            .reference
            .filter(|mean| (code - mean).abs() <= REFERENCE_JUMP * REFERENCE_CONVERSIONS)
            .map_or(code, |mean| {
                mean + div_round(code - mean, REFERENCE_CONVERSIONS)
            });
        self.reference = Some(mean);
        Some(div_round(
            CALIBRATION_VDDA_UV * REFERENCE_CONVERSIONS * calibration,
            mean,
        ))
    }

    /// RM0090, temperature sensor, with the factory's two points.
    fn die_temperature(&self, code: i64) -> Option<MilliCelsius> {
        let at_30 = i64::from(VtempCal30::get().read());
        let at_110 = i64::from(VtempCal110::get().read());
        let span = at_110 - at_30;
        if span <= 0 {
            return None; // Never calibrated.
        }
        let at_calibration_supply =
            div_round(mul_i64(code, self.vdda_uv?), CALIBRATION_VDDA_UV / 1_000);
        let above_30 = at_calibration_supply - at_30 * 1_000;
        Some(MilliCelsius(clamp_i32(
            30_000 + div_round(above_30 * 80, span),
        )))
    }

    /// At the begin of a tick: the network now, the supply of the tick before, and the internal channels in turn.
    pub fn begin_tick(&mut self) -> Readings {
        if let Some(channel) = self.internal.take() {
            let code = self.result();
            if channel == REFERENCE {
                self.vdda_uv = code.and_then(|code| self.supply_by(code));
            } else {
                self.temperature = code.and_then(|code| self.die_temperature(code));
            }
        }
        let network = self.network();
        self.start(SUPPLY);
        Readings {
            supply: self
                .supply
                .and_then(|code| self.microvolts(code * SUPPLY_DIVIDER, FULL_SCALE)),
            network: network.and_then(|sum| self.microvolts(sum, FULL_SCALE * NETWORK_CONVERSIONS)),
            temperature: self.temperature,
            vdda: self.vdda_uv.map(|uv| Microvolts(clamp_i32(uv))),
        }
    }

    /// At the end of a tick.
    pub fn end_tick(&mut self) {
        self.supply = self.result();
        let channel = if self.reference_next {
            REFERENCE
        } else {
            TEMPERATURE
        };
        self.reference_next = !self.reference_next;
        self.internal = Some(channel);
        self.start(channel);
    }
}
