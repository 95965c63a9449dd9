//! An ADE7753 as seen from its bus, with faults to order.

use std::cell::RefCell;
use std::rc::Rc;

use embedded_hal::spi::{ErrorKind, ErrorType, Operation, SpiDevice};

/// One operation inside a chip-select assertion.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Op {
    Write(Vec<u8>),
    Delay(u32),
    Read(Vec<u8>),
}

/// The error of transaction number `.0`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fault(pub usize);

impl embedded_hal::spi::Error for Fault {
    fn kind(&self) -> ErrorKind {
        ErrorKind::Other
    }
}

#[derive(Default)]
pub struct State {
    pub registers: Vec<u32>,
    ones: u32,
    /// Every transaction, in order.
    pub log: Vec<Vec<Op>>,
    /// The transaction that fails, without effect on the chip.
    pub fail: Option<usize>,
    /// The transactions that fail from this one on.
    pub fail_from: Option<usize>,
    /// Bits to flip in what the transaction reads: (transaction, exclusive-or of the bytes read, right-justified).
    pub flips: Vec<(usize, u32)>,
    /// Bits to flip in every read of a register: (address, exclusive-or).
    pub permanent_flips: Vec<(u8, u32)>,
    /// Every byte read is this.
    pub stuck: Option<u8>,
    /// Writes to be ignored: (address, how many).
    pub deaf: Option<(u8, usize)>,
    /// RSTSTATUS does not clear.
    pub sticky_status: bool,
    /// A software reset has no effect.
    pub no_software_reset: bool,
}

impl State {
    pub fn power_up(&mut self) {
        self.registers = vec![0; 64];
        for (address, value) in [
            (0x09, 0x000C),
            (0x0A, 0x0040),
            (0x0B, 0x0040),
            (0x10, 0x0D),
            (0x14, 0x3F),
            (0x15, 0x3F),
            (0x1C, 0xFFFF),
            (0x1D, 0xFFF),
            (0x1E, 0xFF),
            (0x20, 0xFF),
            (0x21, 0xFF),
            (0x3F, 0x21),
        ] {
            self.registers[address] = value;
        }
    }

    fn width(address: u8) -> usize {
        match address {
            0x01..=0x08 | 0x16 | 0x17 | 0x22..=0x25 => 3,
            0x09..=0x0C | 0x11 | 0x12 | 0x14 | 0x15 | 0x18..=0x1A | 0x1C | 0x1D | 0x27 => 2,
            _ => 1,
        }
    }

    /// What the chip shifts out.
    fn shift_out(&mut self, address: u8) -> u32 {
        if address == 0x3E {
            return self.ones;
        }
        let value = match address {
            0x0C => self.registers[0x0B],
            0x03 => self.registers[0x02],
            _ => self.registers[usize::from(address)],
        };
        match address {
            0x03 => self.registers[0x02] = 0,
            0x0C if !self.sticky_status => self.registers[0x0B] = 0,
            _ => {}
        }
        self.ones = value.count_ones();
        value
    }

    fn store(&mut self, address: u8, value: u32, wait_ns: u32) {
        if let Some((deaf, times)) = &mut self.deaf
            && *deaf == address
            && *times > 0
        {
            *times -= 1;
            return;
        }
        if address == 0x09 && value & 0x40 != 0 {
            assert!(wait_ns >= 18_000, "no 18 µs after a software reset");
            if !self.no_software_reset {
                self.power_up();
            }
            return;
        }
        self.registers[usize::from(address)] = value;
    }

    fn transaction(&mut self, operations: &mut [Operation<'_, u8>]) -> Result<(), Fault> {
        let number = self.log.len();
        let fails =
            self.fail == Some(number) || self.fail_from.is_some_and(|first| number >= first);
        if fails {
            self.log.push(Vec::new());
            for operation in operations {
                if let Operation::Read(bytes) = operation {
                    bytes.fill(0xA5);
                }
            }
            return Err(Fault(number));
        }
        let mut log = Vec::new();
        let mut command = None;
        let mut wait_ns = 0;
        let mut written = Vec::new();
        let mut out: Vec<u8> = Vec::new();
        let trailing_ns = match operations.last() {
            Some(Operation::DelayNs(ns)) => *ns,
            _ => 0,
        };
        for operation in operations.iter_mut() {
            match operation {
                Operation::DelayNs(ns) => {
                    wait_ns += *ns;
                    log.push(Op::Delay(*ns));
                }
                Operation::Write(bytes) => {
                    log.push(Op::Write(bytes.to_vec()));
                    for &byte in bytes.iter() {
                        match command {
                            None => {
                                command = Some(byte);
                                if byte & 0x80 == 0 {
                                    let width = Self::width(byte);
                                    let mut value = self.shift_out(byte);
                                    for &(address, flip) in &self.permanent_flips {
                                        if address == byte {
                                            value ^= flip;
                                        }
                                    }
                                    out = value.to_be_bytes()[4 - width..].to_vec();
                                }
                            }
                            Some(write) => {
                                assert!(write & 0x80 != 0, "data written to a read command");
                                assert!(wait_ns >= 4_000, "written bytes too close");
                                written.push(byte);
                                if written.len() == Self::width(write & 0x3F) {
                                    assert!(trailing_ns >= 4_000, "no gap after a write");
                                    let value =
                                        written.iter().fold(0, |v, &b| v << 8 | u32::from(b));
                                    self.store(write & 0x3F, value, trailing_ns);
                                }
                            }
                        }
                        wait_ns = 0;
                    }
                }
                Operation::Read(bytes) => {
                    let address = command.expect("read without a command");
                    assert!(address & 0x80 == 0, "read after a write command");
                    if out.len() == Self::width(address) {
                        assert!(wait_ns >= 4_000, "t9 violated");
                    }
                    wait_ns = 0;
                    for byte in bytes.iter_mut() {
                        *byte = self.stuck.unwrap_or(out.remove(0));
                    }
                    log.push(Op::Read(bytes.to_vec()));
                    if out.is_empty() {
                        command = None;
                    }
                }
                _ => panic!("full duplex is of no use with this chip"),
            }
        }
        if let Some(&(_, flip)) = self.flips.iter().find(|flip| flip.0 == number) {
            let mut flip = flip;
            for operation in operations.iter_mut().rev() {
                if let Operation::Read(bytes) = operation {
                    for byte in bytes.iter_mut().rev() {
                        *byte ^= flip.to_le_bytes()[0];
                        flip >>= 8;
                    }
                }
            }
        }
        self.log.push(log);
        Ok(())
    }
}

/// A handle on the chip; the driver gets a clone.
#[derive(Clone)]
pub struct Chip(Rc<RefCell<State>>);

impl Chip {
    /// After power-up.
    pub fn new() -> Self {
        let mut state = State::default();
        state.power_up();
        Self(Rc::new(RefCell::new(state)))
    }

    pub fn edit<R>(&self, edit: impl FnOnce(&mut State) -> R) -> R {
        edit(&mut self.0.borrow_mut())
    }

    pub fn register(&self, address: u8) -> u32 {
        self.edit(|state| state.registers[usize::from(address)])
    }

    pub fn set(&self, address: u8, value: u32) {
        self.edit(|state| state.registers[usize::from(address)] = value);
    }

    /// The transactions so far, forgotten with this call.
    pub fn take_log(&self) -> Vec<Vec<Op>> {
        self.edit(|state| std::mem::take(&mut state.log))
    }

    pub fn transactions(&self) -> usize {
        self.edit(|state| state.log.len())
    }
}

impl ErrorType for Chip {
    type Error = Fault;
}

impl SpiDevice for Chip {
    fn transaction(&mut self, operations: &mut [Operation<'_, u8>]) -> Result<(), Fault> {
        self.edit(|state| state.transaction(operations))
    }
}

#[cfg(feature = "async")]
impl embedded_hal_async::spi::SpiDevice for Chip {
    async fn transaction(&mut self, operations: &mut [Operation<'_, u8>]) -> Result<(), Fault> {
        // Not ready at the first poll, as a bus with an interrupt is not.
        let mut polled = false;
        std::future::poll_fn(|context| {
            if polled {
                return std::task::Poll::Ready(());
            }
            polled = true;
            context.waker().wake_by_ref();
            std::task::Poll::Pending
        })
        .await;
        self.edit(|state| state.transaction(operations))
    }
}
