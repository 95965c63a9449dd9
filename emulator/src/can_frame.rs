//! A classic CAN frame, outside of any node.

use std::fmt;

/// A frame of CAN 2.0.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct CanFrame {
    /// Identifier, 11 or 29 bits.
    pub id: u32,
    /// 29 bits.
    pub extended: bool,
    /// A request without data.
    pub remote: bool,
    /// The length code as it is on the wire, 0 … 15. One above 8 stands for eight bytes (ISO 11898-1).
    pub length: u8,
    /// Of which the first [`CanFrame::bytes`] count.
    pub data: [u8; 8],
}

impl CanFrame {
    /// A data frame with a standard identifier; data beyond eight bytes is cut off.
    pub fn standard(id: u16, data: &[u8]) -> Self {
        let mut frame = Self {
            id: u32::from(id),
            ..Self::default()
        };
        for (to, from) in frame.data.iter_mut().zip(data) {
            *to = *from;
            frame.length += 1;
        }
        frame
    }

    /// The bytes that count.
    pub fn bytes(&self) -> &[u8] {
        &self.data[..usize::from(self.length.min(8))]
    }
}

/// As candump -L writes it: `123#DEADBEEF`.
impl fmt::Display for CanFrame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.extended {
            write!(f, "{:08X}#", self.id)?;
        } else {
            write!(f, "{:03X}#", self.id)?;
        }
        if self.remote {
            return write!(f, "R");
        }
        self.bytes()
            .iter()
            .try_for_each(|byte| write!(f, "{byte:02X}"))
    }
}
