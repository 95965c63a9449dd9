//! Who the board is and why it started, for CAN and RS485.

use core_logic::{
    can::{Identity, ResetCause as CanCause},
    configuration::Configuration,
    design_parameters::LARGE_FULL_SCALE,
    diagnosis::Code,
    modbus::Readings,
    range::Range,
    units::{Duration, Microamps, Nanocoulombs, charge_of},
};
use stm32f4xx_hal::signature::Uid;

use crate::{
    retain::{Previous, ResetCause},
    stack,
};

/// From the last write of the retained slots to the first reading of the meter after a reset: 100 ms between writes,
/// 450 ms for the flash, 30 ms for the start.
const RESTART: Duration = Duration::from_ticks(600_000);
/// A watchdog's reset has its longest period before it: 1.9 s at the slowest oscillator.
const WATCHDOG_PERIOD: Duration = Duration::from_ticks(1_900_000);
/// From the decision to save to the end of the write, with an erase of 400 ms in between and a turn of 100 ms.
const SAVE_LATENCY: Duration = Duration::from_ticks(1_000_000);

/// The identity frames' content.
pub fn identity(previous: &Previous) -> Identity {
    Identity {
        version: [MAJOR, MINOR, PATCH].map(|part| part.to_le_bytes()[0]),
        reset_cause: can_cause(previous.cause),
        boots: previous.resets,
        commit: COMMIT,
        modified: !env!("HALLMARK_MODIFIED").is_empty(),
        configuration_crc: 0,
        panic_hash: previous.fault_hash,
        panic_line: previous.panic_line,
        late_tasks: previous.late_tasks,
        unique_id: unique_id(),
        uptime: Duration::from_ticks(0),
        // Until it is looked at for the first time.
        stack_free: u32::try_from(stack::BYTES).unwrap_or(0),
        log_fill: None,
    }
}

/// The conditions that hold from the start on because of how the last run ended.
pub fn lasting(previous: &Previous) -> impl Iterator<Item = Code> {
    let bits = previous.cause.bits();
    let rows = [
        (
            Code::WatchdogReset,
            bits & (ResetCause::WATCHDOG | ResetCause::WINDOW_WATCHDOG) != 0,
        ),
        (Code::PanicReset, previous.fault.is_some()),
        (
            Code::BrownOutReset,
            bits & ResetCause::BROWN_OUT != 0 && bits & ResetCause::POWER_ON == 0,
        ),
    ];
    rows.into_iter()
        .filter(|(_, present)| *present)
        .map(|(code, _)| code)
}

/// Fills in what a client reads of it.
pub fn fill(identity: &Identity, readings: &mut Readings) {
    readings.firmware_version = identity.version.map(u16::from);
    readings.revision = identity.commit;
    readings.unique_id = identity.unique_id;
    readings.reset_cause = modbus_cause(identity.reset_cause);
    readings.resets = identity.boots;
    readings.panic_hash = identity.panic_hash;
}

/// The current that a loss is reckoned with: full scale of the front end that is set, and no less than D0's.
fn largest_current(configuration: &Configuration) -> Microamps {
    configuration
        .front_end
        .full_scale(Range::Large)
        .max(LARGE_FULL_SCALE)
}

/// Charge that the largest current moves while nobody counts over a reset.
pub fn loss_over_reset(previous: &Previous, configuration: &Configuration) -> Nanocoulombs {
    let bits = previous.cause.bits();
    // The pin alone (every other reset pulls it too), or a supply that sagged and did not break down: RAM outlives both, but
    // nobody knows how long it took.
    if bits == ResetCause::PIN || bits & ResetCause::BROWN_OUT != 0 {
        return loss_over_power_off(configuration);
    }
    let by_watchdog = bits & ResetCause::WATCHDOG != 0;
    let time = if by_watchdog {
        RESTART.saturating_add(WATCHDOG_PERIOD)
    } else {
        RESTART
    };
    charge_of(largest_current(configuration), time)
}

/// Charge that can have moved since the last record in flash, which this policy wrote.
pub fn loss_over_power_off(configuration: &Configuration) -> Nanocoulombs {
    configuration
        .save_policy
        .loss_bound(largest_current(configuration), SAVE_LATENCY)
}

/// The most telling of the causes.
fn can_cause(cause: ResetCause) -> CanCause {
    let bits = cause.bits();
    let order = [
        (ResetCause::POWER_ON, CanCause::PowerOn),
        (ResetCause::BROWN_OUT, CanCause::BrownOut),
        (ResetCause::WATCHDOG, CanCause::IndependentWatchdog),
        (ResetCause::WINDOW_WATCHDOG, CanCause::WindowWatchdog),
        (ResetCause::SOFTWARE, CanCause::Software),
        (ResetCause::LOW_POWER, CanCause::LowPower),
        (ResetCause::PIN, CanCause::Pin),
    ];
    order
        .into_iter()
        .find(|(bit, _)| bits & bit != 0)
        .map_or(CanCause::Unknown, |(_, cause)| cause)
}

fn modbus_cause(cause: CanCause) -> u16 {
    match cause {
        CanCause::Unknown => 0,
        CanCause::PowerOn => ResetCause::POWER_ON,
        CanCause::BrownOut => ResetCause::BROWN_OUT,
        CanCause::Pin => ResetCause::PIN,
        CanCause::Software => ResetCause::SOFTWARE,
        CanCause::IndependentWatchdog => ResetCause::WATCHDOG,
        CanCause::WindowWatchdog => ResetCause::WINDOW_WATCHDOG,
        CanCause::LowPower => ResetCause::LOW_POWER,
    }
}

fn unique_id() -> [u32; 3] {
    let uid = Uid::get();
    let mut lot = [0; 8];
    for (to, from) in lot.iter_mut().zip(uid.lot_num().bytes()) {
        *to = from;
    }
    let [a, b, c, d, e, f, g, _] = lot;
    [
        u32::from(uid.x()) | u32::from(uid.y()) << 16,
        u32::from_le_bytes([uid.waf_num(), a, b, c]),
        u32::from_le_bytes([d, e, f, g]),
    ]
}

/// The number that a text of digits stands for; worked out when the image is built.
const fn number(text: &str, radix: u32) -> u32 {
    let mut rest = text.as_bytes();
    let mut number = 0_u32;
    while let [digit, later @ ..] = rest {
        let digit = match digit.to_ascii_lowercase() {
            digit @ b'0'..=b'9' => digit - b'0',
            digit @ b'a'..=b'f' => digit - b'a' + 10,
            _ => return 0,
        };
        number = number.wrapping_mul(radix).wrapping_add(digit as u32);
        rest = later;
    }
    number
}

const MAJOR: u32 = number(env!("CARGO_PKG_VERSION_MAJOR"), 10);
const MINOR: u32 = number(env!("CARGO_PKG_VERSION_MINOR"), 10);
const PATCH: u32 = number(env!("CARGO_PKG_VERSION_PATCH"), 10);
const COMMIT: u32 = number(env!("HALLMARK_COMMIT"), 16);
