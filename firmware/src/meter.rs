//! The energy meter's owner, at priority 3.
//!
//! It works in steps of one register each, at most 37 µs of polled SPI (2.6 MHz, two gaps of t9), and looks for a range
//! edge before every step. So the worst time from an edge to the instant at which the chip latches AENERGY is one step
//! under way, the way into the task and the command byte: 37 + 5 + 4 µs of the 100 µs that the hand-over is allowed, and
//! 65 + 5 + 4 µs when the step is the write that starts a temperature conversion, 68 + 5 + 4 µs when it is a snapshot near
//! AENERGY = 0.
//! Polling instead of an interrupt per byte: at 3 µs a byte an interrupt costs more than the wait.

use ade7753::{
    Ade7753, Config, Error, Interrupts, Options,
    registers::{Aenergy, Cfnum, Ch1os, Dierev, Gain, Mode, Status, Temp},
};
use core_logic::{
    gap::GapBridge,
    meter::{MeterChannel, MeterReading, MeterReport, ReadingOutcome, Rejection},
    range::RangeHistory,
    units::{Duration, Instant, MilliCelsius, elapsed},
};
use stm32f4xx_hal::{
    gpio::{Output, PA4},
    pac::SPI1,
};

use crate::{spi, time};

/// From the start of a read to the instant at which the chip has the command byte and latches the register: chip
/// select and eight bits of 2.625 MHz.
const LATCH_US: u64 = 4;
/// Attempts at one reading, against a disturbed transfer or an edge in the middle of it.
const ATTEMPTS: u8 = 3;
/// Below this AENERGY counts only after MODE was read: a reset falls to 0 from there within what a current may do between
/// two readings, 215 counts in 20 ms, with four polls missing. Adds 31 µs to such a step.
const NEAR_ZERO: u32 = 1_024;
/// Length of the self-test with channel 1 shorted: 900 counts at full scale, so that its few are the chip's own offset.
pub const SELF_TEST_MS: u32 = 100;
/// A turn of the read-back at which MODE is read.
const MODE: u8 = 0;
/// While the chip does not answer it is configured anew this often.
const RETRY: Duration = Duration::from_ticks(40_000);

/// Edges that may ask for a snapshot within [`SNAPSHOT_WINDOW`]; the next ones are answered together at its end, so
/// that chatter of any frequency takes no more than a tenth of the time.
const SNAPSHOTS: u8 = 4;
const SNAPSHOT_WINDOW: Duration = Duration::from_ticks(2_000);

type Chip = Ade7753<spi::Device<SPI1, PA4<Output>>>;

/// What the task is asked to do; bits of one word.
pub mod event {
    /// The range flag has changed: a snapshot within 100 µs.
    pub const EDGE: u32 = 1 << 0;
    /// The meter's IRQ line has fallen.
    pub const IRQ: u32 = 1 << 1;
}

/// The chip's state as far as the firmware is concerned.
#[derive(Clone, Copy, Debug, PartialEq, Eq, defmt::Format)]
enum State {
    /// To be configured, not before this time.
    Lost(Instant),
    /// Counting.
    Counting,
}

/// What the rest of the board may know of the chip.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, defmt::Format)]
pub struct Health {
    /// Transfers repeated.
    pub repeated: u32,
    /// Readings whose CHKSUM was wrong.
    pub checksum_failures: u32,
    /// Times the chip was found reset.
    pub resets: u32,
    /// Registers that did not read back as configured.
    pub read_back_failures: u32,
    /// A register reads back as a line that is stuck.
    pub dead_bus: bool,
    /// Counts that the self-test has gathered.
    pub self_test: Option<i32>,
    /// Configured and counting.
    pub counting: bool,
}

/// The meter with its charge.
pub struct Meter {
    chip: Chip,
    channel: MeterChannel,
    state: State,
    ever_configured: bool,
    /// The next good reading ends a gap.
    gap: bool,
    verify_turn: u8,
    /// MODE.TEMPSEL at the last read-back.
    converting: bool,
    /// Since the chip was last configured, and not fetched yet.
    temperature_asked: bool,
    window: (Option<Instant>, u8),
    health: Health,
}

impl Meter {
    /// Takes the bus. No transfer takes place.
    pub fn new(spi: spi::Device<SPI1, PA4<Output>>, channel: MeterChannel) -> Self {
        // One attempt per call: between two of them an edge may want its snapshot.
        let options = Options {
            retries: 0,
            ..Options::default()
        };
        Self {
            chip: Ade7753::new(spi, options),
            channel,
            state: State::Lost(Instant::from_ticks(0)),
            ever_configured: false,
            gap: false,
            verify_turn: 0,
            converting: false,
            temperature_asked: false,
            window: (None, 0),
            health: Health::default(),
        }
    }

    /// The charge.
    pub fn channel(&mut self) -> &mut MeterChannel {
        &mut self.channel
    }

    /// What has been counted.
    pub fn report(&self) -> MeterReport {
        self.channel.report()
    }

    /// State of chip and line.
    pub fn health(&self) -> Health {
        let statistics = self.chip.statistics();
        Health {
            checksum_failures: statistics.checksum_failures,
            counting: self.state == State::Counting,
            ..self.health
        }
    }

    /// Whether the chip was just powered, so that a self-test costs no charge. A chip that still holds its
    /// configuration has counted through the reset of the microcontroller.
    ///
    /// A temperature conversion may still be waiting, for ever: see [`Meter::temperature`]. A transfer that CHKSUM shows
    /// disturbed says nothing: it is repeated, or a chip that counts would be stopped by it.
    pub fn is_fresh(&mut self) -> bool {
        (0..ATTEMPTS).find_map(|_| self.holds_twice(MODE).ok()) != Some(true)
    }

    /// Whether MODE is as configured. A reset clears it, and a line stuck low reads it as 0.
    fn holds_mode(&mut self) -> Result<bool, Error<spi::Error>> {
        self.chip.read::<Mode>().map(|mode| {
            self.converting = mode.start_temperature;
            Mode {
                start_temperature: false,
                ..mode
            } == configuration().mode()
        })
    }

    /// Shorts channel 1 in the chip; to be ended by [`Meter::finish_self_test`] after [`SELF_TEST_MS`].
    ///
    /// Written out here: the driver's own test looks at the configuration before each step, which the read-back does
    /// right after this one.
    pub fn start_self_test(&mut self) -> Option<Aenergy> {
        let shorted = Mode {
            short_channel_1: true,
            ..configuration().mode()
        };
        let started = self
            .chip
            .configure(&configuration())
            .and_then(|()| self.chip.write(shorted))
            .and_then(|()| self.chip.energy());
        if let Err(error) = &started {
            defmt::warn!("meter: {}", error);
        }
        started.ok()
    }

    /// Ends the self-test. Whatever goes wrong, the chip is configured anew before it counts.
    pub fn finish_self_test(&mut self, start: Aenergy) {
        let end = self.chip.energy();
        let restored = self.chip.write(configuration().mode());
        match restored.and(end) {
            Ok(end) => {
                let counts = end.since(start).0;
                defmt::info!("meter: self-test {} counts in {} ms", counts, SELF_TEST_MS);
                self.health.self_test = Some(counts);
            }
            Err(error) => defmt::warn!("meter: self-test {}", error),
        }
    }

    /// Whether an edge may have its snapshot at once; if not, the flag's chatter is answered at the window's end.
    pub fn may_snapshot(&mut self, now: Instant) -> bool {
        match self.window {
            (Some(begin), used) if elapsed(begin, now) < SNAPSHOT_WINDOW => {
                self.window.1 = used.saturating_add(1);
                used < SNAPSHOTS
            }
            _ => {
                self.window = (Some(now), 1);
                true
            }
        }
    }

    /// Reads AENERGY and hands it to the charge, with the range history of the instant at which it was latched.
    /// `bridge`: what is known of the current if there was a gap. Whether the reading waits for the next one.
    pub fn snapshot(
        &mut self,
        mut history: impl FnMut(Instant) -> RangeHistory,
        bridge: &GapBridge,
    ) -> bool {
        for attempt in 0..ATTEMPTS {
            let started = time::now();
            let before = history(started);
            let reading = match self.chip.energy() {
                Ok(Aenergy(energy)) => {
                    let at = started
                        .checked_add_duration(Duration::from_ticks(LATCH_US))
                        .unwrap_or(started);
                    MeterReading { energy, at }
                }
                Err(error) => {
                    self.note_repeat(attempt, &error);
                    continue;
                }
            };
            // At the reading the gated counter is asked before the transfer, each time by as much.
            let after = RangeHistory {
                high: before.high,
                ..history(reading.at)
            };
            let last = attempt + 1 == ATTEMPTS;
            if after.edges != before.edges && !last {
                // An edge during the transfer: nobody can tell on which side of it the register was latched.
                continue;
            }
            // The fall of AENERGY to 0 by a reset could be taken for a current.
            if reading.energy.unsigned_abs() < NEAR_ZERO {
                match self.holds_twice(MODE) {
                    Ok(true) => {}
                    Ok(false) => {
                        self.lose(reading.at, 0);
                        return false;
                    }
                    Err(error) => {
                        self.note_repeat(attempt, &error);
                        continue;
                    }
                }
            }
            if core::mem::take(&mut self.gap) {
                self.channel.on_meter_restarted(reading, after, bridge);
                return false;
            }
            match self.channel.on_reading(reading, after) {
                ReadingOutcome::Rejected(Rejection::RateOfChange) if !last => {}
                ReadingOutcome::Rejected(Rejection::TooLate | Rejection::Lost) => {
                    self.channel.on_meter_restarted(reading, after, bridge);
                    return false;
                }
                outcome => return outcome == ReadingOutcome::Waits,
            }
        }
        false
    }

    fn note_repeat(&mut self, attempt: u8, error: &Error<spi::Error>) {
        self.health.repeated = self.health.repeated.saturating_add(1);
        if attempt + 1 == ATTEMPTS {
            defmt::warn!("meter: no reading: {}", error);
        }
    }

    /// Compares one register with its configuration: MODE every other time, for a reset clears it and a line stuck low
    /// reads it as 0; the others in turn. A chip that has lost its configuration gets it back at once.
    /// Whether MODE was read and is right.
    pub fn verify(&mut self, now: Instant) -> bool {
        if let State::Lost(not_before) = self.state {
            if now >= not_before {
                self.configure(now);
            }
            return false;
        }
        let turn = self.verify_turn;
        self.verify_turn = (turn + 1) % 10;
        match self.holds_twice(turn) {
            Ok(true) => {
                self.health.dead_bus = false;
                return turn.is_multiple_of(2);
            }
            // A disturbed transfer: the next turn looks again.
            Err(Error::Checksum { .. }) => self.note_repeat(0, &Error::NotConfigured),
            Ok(false) | Err(_) => self.lose(now, turn),
        }
        false
    }

    /// Whether the register of a turn is as configured. What CHKSUM does not see disturbed is read once more: a chip that is taken
    /// for reset loses what it has counted.
    fn holds_twice(&mut self, turn: u8) -> Result<bool, Error<spi::Error>> {
        match self.holds(turn) {
            Ok(false) => self.holds(turn),
            read => read,
        }
    }

    fn holds(&mut self, turn: u8) -> Result<bool, Error<spi::Error>> {
        let expected = configuration();
        match turn {
            1 => self.chip.read::<Gain>().map(|gain| gain == expected.gain),
            3 => self
                .chip
                .read::<Cfnum>()
                .map(|Cfnum(number)| number == expected.cf_numerator.get()),
            5 => {
                let known = self.chip.die_revision();
                self.chip
                    .read::<Dierev>()
                    .map(|revision| Some(revision) == known)
            }
            7 => self
                .chip
                .read::<Ch1os>()
                .map(|offset| offset.trim == expected.channel_1_trim && !offset.integrator),
            9 => self
                .chip
                .read::<Status>()
                .map(|Status(flags)| !flags.contains(Interrupts::RESET)),
            _ => self.holds_mode(),
        }
    }

    /// The chip has lost its configuration, as this turn of the read-back shows: gives it back.
    fn lose(&mut self, now: Instant, turn: u8) {
        self.health.read_back_failures = self.health.read_back_failures.saturating_add(1);
        if turn.is_multiple_of(2) || turn == 9 {
            self.health.resets = self.health.resets.saturating_add(1);
        }
        defmt::warn!(
            "meter: configuration lost (register {} of the read-back)",
            turn
        );
        self.channel.on_meter_lost();
        self.gap = true;
        self.configure(now);
    }

    /// About 20 transfers, 0.6 ms. Nothing is counted meanwhile, so an edge has nothing to be handed over either.
    fn configure(&mut self, now: Instant) {
        self.temperature_asked = false;
        match self.chip.configure(&configuration()) {
            Ok(()) => {
                self.state = State::Counting;
                self.ever_configured = true;
                defmt::info!(
                    "meter: configured, die revision {}",
                    self.chip.die_revision()
                );
            }
            Err(error) => {
                self.health.dead_bus = matches!(error, Error::DeadBus { .. });
                if self.state == State::Counting || !self.ever_configured {
                    defmt::warn!("meter: {}", error);
                    self.ever_configured = true;
                }
                self.state = State::Lost(now.checked_add_duration(RETRY).unwrap_or(now));
            }
        }
    }

    /// Starts a conversion of the chip's temperature sensor. To be called right after a read-back of MODE: one write
    /// with its verification, 65 µs, the longest of the steps.
    pub fn start_temperature(&mut self) {
        self.temperature_asked = self
            .chip
            .write(Mode {
                start_temperature: true,
                ..configuration().mode()
            })
            .is_ok();
    }

    /// The temperature, if the conversion has finished by the last read-back of MODE. It may never: parts of this
    /// family wait for a zero crossing of channel 2, which a constant has not.
    pub fn temperature(&mut self) -> Option<MilliCelsius> {
        // A reset since then has cleared the register and the request.
        if self.converting || !core::mem::take(&mut self.temperature_asked) {
            return None;
        }
        let code = self.chip.read::<Temp>().ok()?;
        Some(MilliCelsius(code.rated_millicelsius()))
    }

    /// Whether readings make sense.
    pub fn is_counting(&self) -> bool {
        self.state == State::Counting
    }

    /// Reads and clears the chip's flags, which releases the line.
    pub fn take_status(&mut self) -> Interrupts {
        match self.chip.take_status() {
            Ok(status) => status,
            // The flags are lost: every enabled event is possible.
            Err(_) => configuration().interrupts,
        }
    }
}

/// Channel 2 is a constant: nothing but the accumulator is wanted. The interrupt at half full backs the poll up, and
/// RESET cannot interrupt.
const fn configuration() -> Config {
    Config {
        interrupts: Interrupts::AEHF.union(Interrupts::AEOF),
        ..Config::DC
    }
}
