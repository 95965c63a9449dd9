//! Key and high-voltage lines. Debouncing and meaning are `core_logic::key_calibration`'s.

use stm32f4xx_hal::gpio::{Input, Output, PC6, PC7, PC8};

/// The three lines.
pub struct Lines {
    key_acc: PC6<Input>,
    hv_feedback: PC7<Input>,
    hv_permit: PC8<Output>,
}

/// Their levels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Levels {
    /// Key line: high from ACC on.
    pub key_acc: bool,
    /// Feedback: high when the contactors are closed.
    pub hv_feedback: bool,
}

impl Lines {
    /// Takes the pins; the permit is low.
    pub fn new(key_acc: PC6<Input>, hv_feedback: PC7<Input>, hv_permit: PC8<Output>) -> Self {
        Self {
            key_acc,
            hv_feedback,
            hv_permit,
        }
    }

    /// Reads both inputs.
    pub fn levels(&self) -> Levels {
        Levels {
            key_acc: self.key_acc.is_high(),
            hv_feedback: self.hv_feedback.is_high(),
        }
    }

    /// Gives or withdraws the permit for high voltage.
    pub fn permit(&mut self, permit: bool) {
        if permit {
            self.hv_permit.set_high();
        } else {
            self.hv_permit.set_low();
        }
    }
}
