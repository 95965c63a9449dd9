//! The serial interface's gaps.

/// Minimum gaps on the serial interface, in nanoseconds.
///
/// | gap | ADE7754 Rev 0, CLKIN 10 MHz | ADE7759 Rev A, CLKIN 3.579545 MHz | [`Timing::ADE7753`] |
/// |---|---|---|---|
/// | t9, read command to data | 4 µs | 4 µs | 4 µs |
/// | t10, between bytes of a read | 50 ns | 4 µs | none added (see below) |
/// | t7, between bytes of a write | 50 ns | 4 µs | 4 µs (assumed) |
/// | t6, end of one written byte to the end of the next | 400 ns | 6.4 µs | at least 4 µs + 8 SCLK (assumed) |
/// | write to the next command | not listed | 4 µs (ADE7756, serial read operation) | 4 µs (assumed) |
/// | software reset to the next transfer | | | 20 µs (ADE7753 Rev C, mode register: at least 18 µs) |
///
/// t9 is the same in all sister parts. The others differ by a factor of ten and more between the generations of this
/// family, so the longer figure is used where it costs little: writes are rare. Gaps inside reads are left out because
/// the ADE7753's SCLK limits (50 ns high and low) are those of the ADE7754's generation, whose t10 (50 ns) every SPI
/// peripheral keeps between two bytes up to 10 MHz. [`Timing::ADE7759`] keeps the longest gaps of the family everywhere.
///
/// The gaps follow from the chip's own clock: with a CLKIN slower than 3.58 MHz lengthen them in proportion.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Timing {
    /// t9: from the end of a read command to the first data bit.
    pub command_to_data_ns: u32,
    /// t10: between two bytes of a multi-byte read; 0 transfers them back to back.
    pub read_byte_gap_ns: u32,
    /// t7 and t6: between two bytes of a write, the command included.
    pub write_byte_gap_ns: u32,
    /// From the last byte of a write to the next command; chip select stays low for it.
    pub after_write_ns: u32,
    /// From a software reset to the next transfer.
    pub after_reset_ns: u32,
}

impl Timing {
    /// The gaps for an ADE7753 or ADE7763 at CLKIN = 3.579545 MHz.
    pub const ADE7753: Self = Self {
        command_to_data_ns: 4_000,
        read_byte_gap_ns: 0,
        write_byte_gap_ns: 4_000,
        after_write_ns: 4_000,
        after_reset_ns: 20_000,
    };

    /// The longest gaps of the family at CLKIN = 3.579545 MHz.
    pub const ADE7759: Self = Self {
        command_to_data_ns: 4_000,
        read_byte_gap_ns: 4_000,
        write_byte_gap_ns: 6_400,
        after_write_ns: 6_400,
        after_reset_ns: 20_000,
    };

    /// Time on the wire of one verified 24-bit read (6 bytes, 2 × t9, 2 byte gaps) at an SCLK of `sclk_hz`, rounded up.
    ///
    /// The bus driver's own overhead comes on top; each retry costs the same again. `u32::MAX` if `sclk_hz` is 0 or the
    /// time does not fit.
    #[must_use]
    pub const fn energy_ns(&self, sclk_hz: u32) -> u32 {
        /// Command, three data bytes, CHKSUM command and its data byte.
        const BITS: u64 = 6 * 8;
        if sclk_hz == 0 {
            return u32::MAX;
        }
        let wire = (BITS * 1_000_000_000).div_ceil(sclk_hz as u64);
        let gaps = 2 * (self.command_to_data_ns as u64 + self.read_byte_gap_ns as u64);
        let total = wire + gaps;
        if total > u32::MAX as u64 {
            u32::MAX
        } else {
            #[expect(
                clippy::cast_possible_truncation,
                reason = "bounded in the line above; try_from is not const"
            )]
            let total = total as u32;
            total
        }
    }
}

impl Default for Timing {
    fn default() -> Self {
        Self::ADE7753
    }
}
