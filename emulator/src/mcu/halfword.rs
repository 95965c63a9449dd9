//! Peripherals whose registers are 16 bits wide and four bytes apart (SPI, I²C, USART). RM0090 lets half-words and
//! words through; the upper half of a word is reserved.

use super::Unmodelled;

/// A peripheral's registers by name, in the order of their offsets.
#[derive(Debug)]
pub(super) struct Registers {
    pub peripheral: &'static str,
    pub names: &'static [&'static str],
}

impl Registers {
    /// Which register an access of `bytes` at `offset` reaches.
    pub fn index(&self, offset: u32, bytes: u8) -> Result<usize, Unmodelled> {
        let index = (offset / 4) as usize;
        let Some(name) = self.names.get(index) else {
            return Err(Unmodelled {
                register: format!("{} offset {offset:#x}", self.peripheral),
                what: "a register here".into(),
            });
        };
        if !offset.is_multiple_of(4) || !matches!(bytes, 2 | 4) {
            return Err(Unmodelled {
                register: format!("{}_{name}", self.peripheral),
                what: format!("an access of {bytes} byte at offset {offset:#x}"),
            });
        }
        Ok(index)
    }

    /// The half-word that a write carries.
    pub fn value(&self, index: usize, value: u32) -> Result<u16, Unmodelled> {
        u16::try_from(value).map_err(|_| {
            self.unmodelled(index, format!("{value:#010x} in the reserved upper half"))
        })
    }

    /// The error for something missing about the register at `index`.
    pub fn unmodelled(&self, index: usize, what: impl Into<String>) -> Unmodelled {
        Unmodelled {
            register: format!(
                "{}_{}",
                self.peripheral,
                self.names.get(index).unwrap_or(&"?")
            ),
            what: what.into(),
        }
    }

    /// Refuses `value` if it has one of the named bits.
    pub fn refuse(&self, index: usize, value: u16, bits: &[(u16, &str)]) -> Result<(), Unmodelled> {
        bits.iter()
            .find(|(bit, _)| value & bit != 0)
            .map_or(Ok(()), |(_, name)| {
                Err(self.unmodelled(index, format!("{name} set")))
            })
    }
}

/// The time of `count` periods of a clock of `clock_hz`.
pub(super) fn periods(count: u64, clock_hz: u32) -> crate::time::Ticks {
    let clock_hz = u64::from(clock_hz.max(1));
    crate::time::Ticks((count * crate::time::Ticks::PER_SECOND + clock_hz / 2) / clock_hz)
}
