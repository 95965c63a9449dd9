//! The board on a test bench: machine, what its buses carry, and a client on RS485.

use std::collections::BTreeMap;
use std::path::PathBuf;

use anyhow::{Context as _, Result, bail};

use plant::ade7753::{Ade7753, Ade7753Config};
use plant::ads1100::{Ads1100, Ads1100Config};
use plant::w25q32::{W25q32, W25q32Config};

use crate::board::{Board, BoardConfig, Snapshot, Truth};
use crate::bus_view::BusView;
use crate::can_bus::LoggedFrame;
use crate::can_frame::CanFrame;
use crate::image::Image;
use crate::machine::Machine;
use crate::rtt::{Log, LogTable};
use crate::scenario::Scenario;
use crate::time::Ticks;

/// Names the image for tests and tools that are not told one.
pub const IMAGE_VARIABLE: &str = "HALLMARK_IMAGE";

/// Where the image is: [`IMAGE_VARIABLE`], else where `cargo xtask build` puts it.
pub fn default_image() -> PathBuf {
    std::env::var_os(IMAGE_VARIABLE).map_or_else(
        || {
            let workspace = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
            let target = std::env::var_os("CARGO_TARGET_DIR")
                .map_or_else(|| workspace.join("target"), PathBuf::from);
            target.join("hallmark.elf")
        },
        PathBuf::from,
    )
}

/// An image and its log's table, which outlive every rig that runs it.
pub struct Firmware {
    /// The image.
    pub image: Image,
    log: Option<LogTable>,
}

impl Firmware {
    /// Loads an image.
    ///
    /// # Errors
    /// As [`Image::load`], and if the log's table in it cannot be read.
    pub fn load(path: &std::path::Path) -> Result<Self> {
        let image = Image::load(path)?;
        let log = LogTable::of(&image.elf)
            .with_context(|| format!("{}: the table of the defmt log", path.display()))?;
        Ok(Self { image, log })
    }

    /// Loads the image at [`default_image`].
    ///
    /// # Errors
    /// As [`Firmware::load`].
    pub fn load_default() -> Result<Self> {
        Self::load(&default_image())
    }
}

/// What a rig is built from.
pub struct Setup {
    /// Sensors, filters, switch, step.
    pub board: BoardConfig,
    /// The meter.
    pub meter: Ade7753Config,
    /// The converter.
    pub converter: Ads1100Config,
    /// The flash chip.
    pub nor: W25q32Config,
    /// Its content; `None` = erased.
    pub flash: Option<Vec<u8>>,
    /// The drive.
    pub scenario: Scenario,
}

impl Setup {
    /// A nominal board with an erased flash.
    pub fn nominal(scenario: Scenario) -> Self {
        Self {
            board: BoardConfig::default(),
            meter: Ade7753Config::default(),
            converter: Ads1100Config::default(),
            nor: W25q32Config::default(),
            flash: None,
            scenario,
        }
    }
}

/// Something that happens to the board at a set time.
type Action = Box<dyn FnOnce(&mut Rig<'_>)>;

/// The running board with its observers.
pub struct Rig<'firmware> {
    /// The MCU.
    pub machine: Machine<'firmware>,
    /// What the CAN bus shows of the board.
    pub view: BusView,
    /// Edges with their snapshots, so far.
    pub snapshots: Vec<Snapshot>,
    /// The image's log, so far.
    pub log: Vec<String>,
    /// Every frame on the bus, while [`Rig::keep_frames`] is set.
    pub frames: Vec<LoggedFrame>,
    /// Whether frames are kept.
    pub keep_frames: bool,
    /// By time and order.
    actions: BTreeMap<(Ticks, u64), Action>,
    ordered: u64,
}

/// Observers are served this often.
const SLICE: Ticks = Ticks::from_millis(1);

impl<'firmware> Rig<'firmware> {
    /// Power comes on at time 0.
    ///
    /// # Errors
    /// If the machine cannot be built.
    pub fn new(firmware: &'firmware Firmware, setup: Setup) -> Result<Self> {
        let flash = W25q32::with_content(setup.nor, 0.0, setup.flash.unwrap_or_default());
        let board = Board::new(
            setup.board,
            setup.scenario,
            Ade7753::new(setup.meter, 0.0),
            Ads1100::new(setup.converter, 0.0),
            flash,
        );
        let log = match (&firmware.log, firmware.image.rtt) {
            (Some(table), Some(control_block)) => Some(Log::new(table, control_block)),
            _ => None,
        };
        Ok(Self {
            machine: Machine::new(&firmware.image, log, board)?,
            view: BusView::default(),
            snapshots: Vec::new(),
            log: Vec::new(),
            frames: Vec::new(),
            keep_frames: false,
            actions: BTreeMap::new(),
            ordered: 0,
        })
    }

    /// Now, in s.
    pub fn now_s(&self) -> f64 {
        self.machine.now().seconds()
    }

    /// Runs for `time`.
    ///
    /// # Errors
    /// As [`Machine::run_until`].
    pub fn run_for(&mut self, time: Ticks) -> Result<()> {
        self.run_to(self.machine.now() + time)
    }

    /// Runs for so many seconds.
    ///
    /// # Errors
    /// As [`Machine::run_until`].
    pub fn run_s(&mut self, seconds: f64) -> Result<()> {
        self.run_for(Ticks::from_seconds(seconds))
    }

    /// Runs until `end`.
    ///
    /// # Errors
    /// As [`Machine::run_until`].
    pub fn run_to(&mut self, end: Ticks) -> Result<()> {
        self.act();
        while self.machine.now() < end {
            let mut slice = (self.machine.now() + SLICE).min(end);
            if let Some(((due, _), _)) = self.actions.first_key_value() {
                slice = slice.min(*due);
            }
            let result = self.machine.run_until(slice);
            self.observe();
            result?;
            self.act();
        }
        Ok(())
    }

    /// Has something happen at `at`, or at once if that has passed; what has the same time happens in the order of the calls.
    pub fn at(&mut self, at: Ticks, action: impl FnOnce(&mut Rig<'_>) + 'static) {
        self.ordered += 1;
        self.actions.insert((at, self.ordered), Box::new(action));
    }

    fn act(&mut self) {
        while let Some(entry) = self.actions.first_entry()
            && entry.key().0 <= self.machine.now()
        {
            entry.remove()(self);
        }
    }

    /// All supplies off and on again, now: every chip and the MCU begin anew, the flash keeps its content.
    pub fn power_cycle(&mut self) {
        let now_s = self.now_s();
        self.machine.board(|board| {
            board.flash.advance(now_s);
            board.flash.power_off(now_s);
            board.meter.brown_out(now_s);
            board.converter.reset(now_s);
        });
        self.machine.power_cycle();
        self.machine.board(|board| board.flash.power_on(now_s));
    }

    /// Runs until `condition` holds, looked at every millisecond; how long it took.
    ///
    /// # Errors
    /// If it does not hold within `limit`, with what was waited for; as [`Machine::run_until`].
    pub fn run_until(
        &mut self,
        what: &str,
        limit: Ticks,
        mut condition: impl FnMut(&mut Self) -> bool,
    ) -> Result<Ticks> {
        let start = self.machine.now();
        while !condition(self) {
            if self.machine.now().since(start) >= limit {
                bail!(
                    "{what} did not come within {:.3} s (now {:.3} s)",
                    limit.seconds(),
                    self.now_s()
                );
            }
            self.run_for(SLICE)?;
        }
        Ok(self.machine.now().since(start))
    }

    /// Takes what the machine has put out.
    fn observe(&mut self) {
        for logged in self.machine.can(|can| can.take_log()) {
            if logged.from_board {
                self.view.take(logged.at, &logged.frame);
            }
            if self.keep_frames {
                self.frames.push(logged);
            }
        }
        let snapshots = self.machine.board(Board::take_snapshots);
        self.snapshots.extend(snapshots);
        self.log.extend(self.machine.take_log());
    }

    /// What really happened.
    pub fn truth(&mut self) -> Truth {
        self.machine.board(|board| board.truth())
    }

    /// A frame from another node, now.
    pub fn send_can(&mut self, frame: CanFrame) {
        let now = self.machine.now();
        self.machine.can(|can| can.inject(frame, now));
    }

    /// Bytes from a client on RS485, one after the other.
    pub fn send_rs485(&mut self, bytes: &[u8]) {
        let now = self.machine.now();
        self.machine.board(|board| {
            board.line.send_bytes(bytes, now);
        });
    }

    /// Takes what the board has sent on RS485.
    pub fn take_rs485(&mut self) -> Vec<u8> {
        self.machine.board(|board| {
            board
                .line
                .take_sent()
                .into_iter()
                .map(|(_, byte)| byte)
                .collect()
        })
    }

    /// Sends a Modbus request (without CRC) and waits for the answer.
    ///
    /// # Errors
    /// If no answer with a right CRC comes within half a second.
    pub fn modbus(&mut self, request: &[u8]) -> Result<Vec<u8>> {
        let _ = self.take_rs485();
        self.send_rs485(&with_crc(request));
        let mut answer = Vec::new();
        let mut quiet = Ticks(0);
        for _ in 0..500 {
            self.run_for(SLICE)?;
            let new = self.take_rs485();
            quiet = if new.is_empty() {
                quiet + SLICE
            } else {
                Ticks(0)
            };
            answer.extend(new);
            // 3.5 characters are 0.33 ms: three milliseconds of silence end a frame whatever its length.
            if !answer.is_empty() && quiet >= Ticks::from_millis(3) {
                break;
            }
        }
        let Some((body, crc)) = answer.split_last_chunk::<2>() else {
            bail!(
                "no answer to the request {request:02X?} within 0.5 s (now {:.3} s)",
                self.now_s()
            );
        };
        if crc != &crc16(body) {
            bail!("the answer {answer:02X?} has a wrong CRC");
        }
        Ok(body.to_vec())
    }
}

/// A Modbus frame: `body` and its CRC.
pub fn with_crc(body: &[u8]) -> Vec<u8> {
    [body, &crc16(body)].concat()
}

/// CRC-16/MODBUS, low byte first (Modbus over serial line V1.02, 6.2.2), bit by bit: nothing shared with the firmware.
fn crc16(bytes: &[u8]) -> [u8; 2] {
    let mut crc = 0xFFFF_u16;
    for byte in bytes {
        crc ^= u16::from(*byte);
        for _ in 0..8 {
            crc = if crc & 1 != 0 {
                crc >> 1 ^ 0xA001
            } else {
                crc >> 1
            };
        }
    }
    crc.to_le_bytes()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_crc_is_that_of_the_specification() {
        // Read ten registers from 0 of server 1: 01 03 00 00 00 0A C5 CD, the example found in every manual.
        assert_eq!(crc16(&[1, 3, 0, 0, 0, 10]), [0xC5, 0xCD]);
    }
}
