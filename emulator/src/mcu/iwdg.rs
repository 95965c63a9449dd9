//! Independent watchdog (RM0090, section 21): a down-counter on its own oscillator that nothing can stop.

use super::word::{check_width, only_bits, part, unknown, unmodelled};
use super::{Context, Peripheral, Unmodelled};
use crate::time::Ticks;

const KEY_UNLOCK: u32 = 0x5555;
const KEY_RELOAD: u32 = 0xAAAA;
const KEY_START: u32 = 0xCCCC;
const RELOAD_RESET: u16 = 0xFFF;

/// Its oscillator.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct IwdgParameters {
    /// LSI, in Hz: 32 kHz nominal, 17 … 47 kHz over temperature and supply (data sheet, LSI characteristics).
    pub lsi_hz: f64,
    /// LSI's start-up time (data sheet: 15 µs typical, 40 µs at most).
    pub lsi_startup: Ticks,
    /// Cycles of LSI until a written prescaler or reload value is in force: up to 5 (RM0090, `IWDG_SR`).
    pub update_cycles: u32,
}

impl Default for IwdgParameters {
    fn default() -> Self {
        Self {
            lsi_hz: 32_000.0,
            lsi_startup: Ticks::from_micros(15),
            update_cycles: 5,
        }
    }
}

/// A value on its way into the oscillator's clock domain.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Update<T> {
    value: T,
    /// Nothing here while the oscillator stands still.
    done_at: Option<Ticks>,
}

/// The watchdog.
///
/// The prescaler's phase starts anew with each reload: a real one may bite up to one prescaled clock earlier. LSI runs
/// here from the start command on; that LSION may have started it before is not seen. Not modelled: the hardware watchdog
/// of the option bytes, and the stop by the debugger.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Iwdg {
    parameters: IwdgParameters,
    unlocked: bool,
    started: Option<Ticks>,
    prescaler: u8,
    reload: u16,
    new_prescaler: Option<Update<u8>>,
    new_reload: Option<Update<u16>>,
    /// Count at `counted_at`.
    count: u16,
    counted_at: Ticks,
    bitten: bool,
}

impl Default for Iwdg {
    fn default() -> Self {
        Self::new(IwdgParameters::default())
    }
}

impl Iwdg {
    /// After reset: stopped.
    pub const fn new(parameters: IwdgParameters) -> Self {
        Self {
            parameters,
            unlocked: false,
            started: None,
            prescaler: 0,
            reload: RELOAD_RESET,
            new_prescaler: None,
            new_reload: None,
            count: RELOAD_RESET,
            counted_at: Ticks(0),
            bitten: false,
        }
    }

    /// LSI runs at another frequency from `now` on.
    pub fn set_lsi_hz(&mut self, lsi_hz: f64, now: Ticks) {
        if self.started.is_some_and(|from| from <= now) {
            self.count_from(self.count_at(now), now);
        }
        self.parameters.lsi_hz = lsi_hz;
    }

    /// Whether it was started since the last reset.
    pub const fn is_running(&self) -> bool {
        self.started.is_some()
    }

    /// Takes the demand for a system reset.
    pub const fn take_reset(&mut self) -> bool {
        std::mem::replace(&mut self.bitten, false)
    }

    fn cycles(&self, cycles: f64) -> Ticks {
        Ticks::from_seconds(cycles / self.parameters.lsi_hz)
    }

    /// LSI cycles per count: 4 … 256; codes 6 and 7 are the same (RM0090, `IWDG_PR`).
    fn divider(&self) -> f64 {
        f64::from(4_u16 << self.prescaler.min(6))
    }

    /// RM0090's time-out: (count + 1) · divider / LSI.
    fn bites_at(&self) -> Option<Ticks> {
        self.started?;
        let counts = f64::from(self.count) + 1.0;
        Some(self.counted_at + self.cycles(counts * self.divider()))
    }

    fn count_from(&mut self, count: u16, at: Ticks) {
        self.count = count;
        self.counted_at = at;
    }

    /// The count at `now`.
    fn count_at(&self, now: Ticks) -> u16 {
        let counts = now.since(self.counted_at).seconds() * self.parameters.lsi_hz / self.divider();
        self.count.saturating_sub(counts as u16)
    }

    fn done_at(&self, now: Ticks) -> Option<Ticks> {
        let from = now.max(self.started?);
        Some(from + self.cycles(f64::from(self.parameters.update_cycles)))
    }

    /// Written values that have arrived come into force.
    fn update(&mut self, now: Ticks) {
        let is_done = |done_at: Option<Ticks>| done_at.is_some_and(|at| at <= now);
        if let Some(update) = self.new_reload.filter(|update| is_done(update.done_at)) {
            self.reload = update.value;
            self.new_reload = None;
        }
        if let Some(update) = self.new_prescaler.filter(|update| is_done(update.done_at)) {
            if let Some(at) = update.done_at {
                self.count_from(self.count_at(at), at.max(self.counted_at));
            }
            self.prescaler = update.value;
            self.new_prescaler = None;
        }
    }

    fn write_key(&mut self, key: u32, now: Ticks) -> Result<(), Unmodelled> {
        // Any other key locks again.
        self.unlocked = key == KEY_UNLOCK;
        match key {
            KEY_START if self.started.is_none() => {
                let runs_from = now + self.parameters.lsi_startup;
                self.started = Some(runs_from);
                self.count_from(RELOAD_RESET, runs_from);
                let done_at = self.done_at(now);
                if let Some(update) = &mut self.new_prescaler {
                    update.done_at = done_at;
                }
                if let Some(update) = &mut self.new_reload {
                    update.done_at = done_at;
                }
            }
            KEY_RELOAD => {
                // Before the start there is nothing to feed; the counter then begins at 0xFFF.
                if let Some(runs_from) = self.started {
                    self.count_from(self.reload, now.max(runs_from));
                }
            }
            KEY_UNLOCK | KEY_START => {}
            other => {
                return Err(unmodelled("IWDG_KR", format!("key {other:#06X}")));
            }
        }
        Ok(())
    }
}

impl Peripheral for Iwdg {
    fn read(
        &mut self,
        offset: u32,
        bytes: u8,
        context: &mut Context<'_>,
    ) -> Result<u32, Unmodelled> {
        check_width("IWDG", offset, bytes, 2)?;
        self.update(context.now);
        let word = match offset & !3 {
            // The key is write-only.
            0x00 => 0,
            0x04 => u32::from(self.prescaler),
            0x08 => u32::from(self.reload),
            0x0C => {
                u32::from(self.new_prescaler.is_some()) | u32::from(self.new_reload.is_some()) << 1
            }
            _ => return Err(unknown("IWDG", offset, "read")),
        };
        Ok(part(word, offset, bytes))
    }

    fn write(
        &mut self,
        offset: u32,
        bytes: u8,
        value: u32,
        context: &mut Context<'_>,
    ) -> Result<(), Unmodelled> {
        check_width("IWDG", offset, bytes, 2)?;
        let now = context.now;
        self.update(now);
        match offset {
            0x00 => self.write_key(value & 0xFFFF, now)?,
            // Locked: hardware ignores the write.
            0x04 | 0x08 if !self.unlocked => {}
            0x04 => {
                only_bits("IWDG_PR", value, 7)?;
                if self.new_prescaler.is_some() {
                    return Err(unmodelled("IWDG_PR", "write while PVU is set"));
                }
                self.new_prescaler = Some(Update {
                    value: (value & 7) as u8,
                    done_at: self.done_at(now),
                });
            }
            0x08 => {
                only_bits("IWDG_RLR", value, 0xFFF)?;
                if self.new_reload.is_some() {
                    return Err(unmodelled("IWDG_RLR", "write while RVU is set"));
                }
                self.new_reload = Some(Update {
                    value: (value & 0xFFF) as u16,
                    done_at: self.done_at(now),
                });
            }
            _ => return Err(unknown("IWDG", offset, "write")),
        }
        Ok(())
    }

    fn next_event(&self) -> Option<Ticks> {
        let prescaler_at = self.new_prescaler.and_then(|update| update.done_at);
        let bites_at = self.bites_at()?;
        Some(prescaler_at.map_or(bites_at, |at| at.min(bites_at)))
    }

    fn advance(&mut self, context: &mut Context<'_>) {
        self.update(context.now);
        if let Some(at) = self.bites_at().filter(|at| *at <= context.now) {
            self.bitten = true;
            // The reset follows; should it not be taken, the counter starts over.
            self.count_from(RELOAD_RESET, at);
        }
    }

    /// A system reset stops it. A bite not yet taken is forgotten.
    fn reset(&mut self, _context: &mut Context<'_>) {
        *self = Self::new(self.parameters);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

    use proptest::prelude::*;

    use super::super::test_world::World;
    use super::*;

    const KR: u32 = 0x00;
    const PR: u32 = 0x04;
    const RLR: u32 = 0x08;
    const SR: u32 = 0x0C;

    fn parameters(lsi_hz: f64) -> IwdgParameters {
        IwdgParameters {
            lsi_hz,
            ..IwdgParameters::default()
        }
    }

    /// Started, with prescaler and reload in force, fed at the returned moment.
    fn running(world: &mut World, lsi_hz: f64, prescaler: u32, reload: u32) -> (Iwdg, Ticks) {
        let mut iwdg = Iwdg::new(parameters(lsi_hz));
        world.write(&mut iwdg, KR, KEY_START);
        world.write(&mut iwdg, KR, KEY_UNLOCK);
        world.write(&mut iwdg, PR, prescaler);
        world.write(&mut iwdg, RLR, reload);
        world.now += Ticks::from_millis(1);
        assert_eq!(world.read(&mut iwdg, SR), 0);
        world.write(&mut iwdg, KR, KEY_RELOAD);
        let fed = world.now;
        (iwdg, fed)
    }

    fn bites(world: &mut World, iwdg: &mut Iwdg, at: Ticks) {
        world.run_until(iwdg, at - Ticks(1));
        assert!(!iwdg.take_reset());
        world.run_until(iwdg, at);
        assert!(iwdg.take_reset());
        assert!(!iwdg.take_reset());
    }

    #[test]
    fn reset_values_are_the_manuals() {
        let mut world = World::default();
        let mut iwdg = Iwdg::default();
        for (offset, value) in [(KR, 0), (PR, 0), (RLR, 0xFFF), (SR, 0)] {
            assert_eq!(world.read(&mut iwdg, offset), value);
        }
        assert_eq!(iwdg.next_event(), None);
    }

    /// RM0090, table 107: time-outs at 32 kHz, in ms, with reload values 0x000 and 0xFFF.
    #[test]
    fn time_outs_follow_the_table() {
        let rows = [
            (0, 0.125, 512.0),
            (1, 0.25, 1_024.0),
            (2, 0.5, 2_048.0),
            (3, 1.0, 4_096.0),
            (4, 2.0, 8_192.0),
            (5, 4.0, 16_384.0),
            (6, 8.0, 32_768.0),
            (7, 8.0, 32_768.0),
        ];
        for (prescaler, shortest_ms, longest_ms) in rows {
            for (reload, ms) in [(0, shortest_ms), (0xFFF, longest_ms)] {
                let mut world = World::default();
                let (mut iwdg, fed) = running(&mut world, 32_000.0, prescaler, reload);
                bites(&mut world, &mut iwdg, fed + Ticks::from_seconds(ms / 1e3));
            }
        }
    }

    /// The image's setting over the tolerance of LSI: 1000 counts of 32 cycles.
    #[test]
    fn tolerance_of_the_oscillator_is_in_the_time() {
        for (lsi_hz, after_s) in [
            (17_000.0, 1.882_352_941),
            (32_000.0, 1.0),
            (47_000.0, 0.680_851_064),
        ] {
            let mut world = World::default();
            let (iwdg, fed) = running(&mut world, lsi_hz, 3, 999);
            let bites_at = iwdg.next_event().unwrap();
            assert!((bites_at.since(fed).seconds() - after_s).abs() < 1e-8);
        }
    }

    #[test]
    fn feeding_in_time_keeps_it_quiet() {
        let mut world = World::default();
        let (mut iwdg, mut fed) = running(&mut world, 32_000.0, 3, 999);
        for _ in 0..20 {
            world.run_until(&mut iwdg, fed + Ticks(Ticks::from_millis(1_000).0 - 1));
            assert!(!iwdg.take_reset());
            world.write(&mut iwdg, KR, KEY_RELOAD);
            fed = world.now;
        }
        bites(&mut world, &mut iwdg, fed + Ticks::from_millis(1_000));
    }

    #[test]
    fn values_take_five_cycles_and_an_early_feed_loads_the_old_one() {
        let mut world = World::default();
        let mut iwdg = Iwdg::default();
        world.write(&mut iwdg, KR, KEY_START);
        world.now = Ticks::from_micros(100);
        world.write(&mut iwdg, KR, KEY_UNLOCK);
        world.write(&mut iwdg, PR, 3);
        assert_eq!(world.read(&mut iwdg, SR), 0b01);
        world.write(&mut iwdg, RLR, 999);
        assert_eq!(world.read(&mut iwdg, SR), 0b11);
        assert_eq!(world.read(&mut iwdg, RLR), 0xFFF);
        assert!(world.refuses(&mut iwdg, PR, 2), "PVU is set");
        assert!(world.refuses(&mut iwdg, RLR, 2), "RVU is set");
        // 5 / 32 kHz = 156.25 µs.
        let busy = Ticks::from_seconds(5.0 / 32_000.0);
        world.run_until(&mut iwdg, Ticks::from_micros(100) + busy - Ticks(1));
        assert_eq!(world.read(&mut iwdg, SR), 0b11);
        world.write(&mut iwdg, KR, KEY_RELOAD);
        let fed = world.now;
        world.run_until(&mut iwdg, Ticks::from_micros(100) + busy);
        assert_eq!(world.read(&mut iwdg, SR), 0);
        assert_eq!(
            (world.read(&mut iwdg, PR), world.read(&mut iwdg, RLR)),
            (3, 999)
        );
        // 4096 counts of 32 cycles.
        let bites_at = iwdg.next_event().unwrap();
        assert!(bites_at.since(fed).seconds() > 4.09);
    }

    #[test]
    fn nothing_arrives_while_the_oscillator_stands() {
        let mut world = World::default();
        let mut iwdg = Iwdg::default();
        world.write(&mut iwdg, KR, KEY_UNLOCK);
        world.write(&mut iwdg, RLR, 10);
        world.now = Ticks::from_millis(1_000);
        assert_eq!(world.read(&mut iwdg, SR), 0b10);
        assert_eq!(iwdg.next_event(), None);
        world.write(&mut iwdg, KR, KEY_START);
        world.now += Ticks::from_millis(1);
        assert_eq!(world.read(&mut iwdg, SR), 0);
        assert_eq!(world.read(&mut iwdg, RLR), 10);
    }

    #[test]
    fn locked_registers_ignore_writes() {
        let mut world = World::default();
        let (mut iwdg, _) = running(&mut world, 32_000.0, 3, 999);
        // The feed has locked them.
        world.write(&mut iwdg, PR, 6);
        world.write(&mut iwdg, RLR, 5);
        assert_eq!(world.read(&mut iwdg, SR), 0);
        assert_eq!(
            (world.read(&mut iwdg, PR), world.read(&mut iwdg, RLR)),
            (3, 999)
        );
    }

    #[test]
    fn only_a_reset_stops_it() {
        let mut world = World::default();
        let (mut iwdg, fed) = running(&mut world, 32_000.0, 3, 999);
        world.now += Ticks::from_millis(500);
        world.write(&mut iwdg, KR, KEY_START);
        assert_eq!(iwdg.next_event(), Some(fed + Ticks::from_millis(1_000)));
        assert!(iwdg.is_running());
        iwdg.reset(&mut world.context());
        assert!(!iwdg.is_running());
        assert_eq!(iwdg.next_event(), None);
        assert_eq!(world.read(&mut iwdg, RLR), 0xFFF);
    }

    #[test]
    fn what_is_missing_is_refused() {
        let mut world = World::default();
        let mut iwdg = Iwdg::default();
        assert!(world.refuses(&mut iwdg, KR, 0x1234));
        assert!(world.refuses(&mut iwdg, 0x10, 0));
        assert!(world.refuses(&mut iwdg, SR, 0));
        world.write(&mut iwdg, KR, KEY_UNLOCK);
        assert!(world.refuses(&mut iwdg, PR, 8));
        assert!(world.refuses(&mut iwdg, RLR, 0x1000));
        assert!(iwdg.read(PR, 1, &mut world.context()).is_err());
    }

    #[test]
    fn slower_oscillator_stretches_the_rest() {
        let mut world = World::default();
        let (mut iwdg, fed) = running(&mut world, 32_000.0, 3, 999);
        let half = fed + Ticks::from_millis(500);
        iwdg.set_lsi_hz(16_000.0, half);
        let rest_s = iwdg.next_event().unwrap().since(half).seconds();
        // The other 500 counts take twice as long, give or take one.
        assert!((rest_s - 1.0).abs() <= 0.002, "{rest_s}");
    }

    proptest! {
        /// It bites exactly one time-out after the last feed, whatever the feeds were.
        #[test]
        fn bites_one_time_out_after_the_last_feed(
            prescaler in 0u32..7, reload in 10u32..0x1000, lsi_hz in 17_000.0..47_000.0_f64,
            feeds in proptest::collection::vec(0.0..0.999_f64, 0..10),
        ) {
            let mut world = World::default();
            let (mut iwdg, mut fed) = running(&mut world, lsi_hz, prescaler, reload);
            let time_out_s = f64::from(reload + 1) * f64::from(4 << prescaler) / lsi_hz;
            for share in feeds {
                world.run_until(&mut iwdg, fed + Ticks::from_seconds(share * time_out_s));
                prop_assert!(!iwdg.take_reset());
                world.write(&mut iwdg, KR, KEY_RELOAD);
                fed = world.now;
            }
            world.run_until(&mut iwdg, fed + Ticks::from_seconds(time_out_s) - Ticks(2));
            prop_assert!(!iwdg.take_reset());
            world.run_until(&mut iwdg, fed + Ticks::from_seconds(time_out_s) + Ticks(2));
            prop_assert!(iwdg.take_reset());
        }
    }
}
