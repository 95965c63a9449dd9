//! What a chip sees of its bus, byte by byte, with the times that it could complain about.

/// One byte on an SPI bus, as the slave sees it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SpiByte {
    /// What the master shifts out.
    pub mosi: u8,
    /// Clock polarity (bit 1) and phase (bit 0): 0 … 3.
    pub mode: u8,
    /// Frequency of the clock while it runs, in Hz.
    pub clock_hz: f64,
    /// First clock edge, in s.
    pub start_s: f64,
    /// Last clock edge, in s.
    pub end_s: f64,
}

/// A slave on an SPI bus.
pub trait SpiDevice {
    /// Chip select falls.
    fn select(&mut self, at_s: f64);
    /// Chip select rises.
    fn deselect(&mut self, at_s: f64);
    /// A byte is exchanged while the chip is selected; what the slave shifts out.
    fn exchange(&mut self, byte: SpiByte) -> u8;
}

/// A slave on an I²C bus, after the bus has dealt with lines, clocks and acknowledge bits.
pub trait I2cDevice {
    /// A start condition and the byte that follows it (address in bits 7 … 1, read in bit 0): whether it acknowledges.
    fn address(&mut self, byte: u8, at_s: f64) -> bool;
    /// A byte from the master: whether it acknowledges.
    fn write(&mut self, byte: u8, at_s: f64) -> bool;
    /// The next byte that it shifts out.
    fn read(&mut self, at_s: f64) -> u8;
    /// A stop condition.
    fn stop(&mut self, at_s: f64);
}
