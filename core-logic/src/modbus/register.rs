//! How a value lies in 16-bit registers: width, sign and word order.

/// The type of a value in the register map. Wide values lie most significant word first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// One register, 0 to 65,535.
    U16,
    /// One register, two's complement.
    I16,
    /// Two registers, 0 to 2³² − 1.
    U32,
    /// Two registers, two's complement.
    I32,
    /// Four registers, two's complement.
    I64,
}

impl Kind {
    /// Registers that one value takes.
    #[must_use]
    pub const fn width(self) -> u16 {
        match self {
            Self::U16 | Self::I16 => 1,
            Self::U32 | Self::I32 => 2,
            Self::I64 => 4,
        }
    }

    /// Smallest value of the type.
    #[must_use]
    pub const fn min(self) -> i64 {
        match self {
            Self::U16 | Self::U32 => 0,
            Self::I16 => i16::MIN as i64,
            Self::I32 => i32::MIN as i64,
            Self::I64 => i64::MIN,
        }
    }

    /// Largest value of the type.
    #[must_use]
    pub const fn max(self) -> i64 {
        match self {
            Self::U16 => u16::MAX as i64,
            Self::I16 => i16::MAX as i64,
            Self::U32 => u32::MAX as i64,
            Self::I32 => i32::MAX as i64,
            Self::I64 => i64::MAX,
        }
    }

    /// As the documentation writes it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::U16 => "u16",
            Self::I16 => "i16",
            Self::U32 => "u32",
            Self::I32 => "i32",
            Self::I64 => "i64",
        }
    }

    /// The 16 bits of `value` that lie in register `word` of it (0 is the most significant), the value stopped at the
    /// type's ends before.
    #[must_use]
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "the 16 bits of two's complement are wanted"
    )]
    pub fn word(self, value: i64, word: u16) -> u16 {
        let shift = self.width().saturating_sub(1).saturating_sub(word) * 16;
        (value.min(self.max()).max(self.min()) >> shift) as u16
    }

    /// The value whose two's complement the low bits of `bits` are, all the words shifted in.
    #[must_use]
    pub const fn value(self, bits: u64) -> i64 {
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_possible_wrap,
            reason = "the width is the type's"
        )]
        match self {
            Self::U16 => bits as u16 as i64,
            Self::I16 => bits as u16 as i16 as i64,
            Self::U32 => bits as u32 as i64,
            Self::I32 => bits as u32 as i32 as i64,
            Self::I64 => bits as i64,
        }
    }
}

/// Where a row of a register table lies: `count` values of one kind, one behind the other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Layout {
    /// Address of the first register, as on the wire (0-based).
    pub address: u16,
    /// Type of each value.
    pub kind: Kind,
    /// Number of values.
    pub count: u16,
}

/// The value that a register belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Place {
    /// Which of the row's values.
    pub element: usize,
    /// Which register of that value, 0 is the most significant.
    pub word: u16,
}

impl Layout {
    /// The first address behind the row.
    #[must_use]
    pub const fn end(&self) -> u16 {
        self.address
            .saturating_add(self.count.saturating_mul(self.kind.width()))
    }

    /// What lies at `address`, if it belongs to this row.
    #[must_use]
    pub fn place(&self, address: u16) -> Option<Place> {
        let offset = address.checked_sub(self.address)?;
        if address >= self.end() {
            return None;
        }
        Some(Place {
            element: usize::from(offset / self.kind.width()),
            word: offset % self.kind.width(),
        })
    }
}

/// A row of a table of registers.
pub trait Row {
    /// Where it lies.
    fn layout(&self) -> &Layout;
}

/// The row and the value in it to which the register `address` belongs; the table is sorted by address.
pub fn locate<R: Row>(table: &[R], address: u16) -> Option<(&R, Place)> {
    let behind = table.partition_point(|row| row.layout().address <= address);
    let row = table.get(behind.checked_sub(1)?)?;
    Some((row, row.layout().place(address)?))
}

#[cfg(test)]
#[allow(clippy::indexing_slicing)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const KINDS: [Kind; 5] = [Kind::U16, Kind::I16, Kind::U32, Kind::I32, Kind::I64];

    struct Plain(Layout);
    impl Row for Plain {
        fn layout(&self) -> &Layout {
            &self.0
        }
    }

    #[test]
    fn words_lie_most_significant_first() {
        assert_eq!(Kind::U32.word(0x0001_0002, 0), 1);
        assert_eq!(Kind::U32.word(0x0001_0002, 1), 2);
        let value = 0x0001_0002_0003_0004;
        assert_eq!(
            [0, 1, 2, 3].map(|word| Kind::I64.word(value, word)),
            [1, 2, 3, 4]
        );
        assert_eq!(Kind::I32.word(-2, 0), 0xFFFF);
        assert_eq!(Kind::I32.word(-2, 1), 0xFFFE);
        assert_eq!(Kind::I16.word(-2, 0), 0xFFFE);
    }

    #[test]
    fn values_beyond_the_type_stop_at_its_ends() {
        assert_eq!(Kind::U16.word(70_000, 0), u16::MAX);
        assert_eq!(Kind::U16.word(-1, 0), 0);
        assert_eq!(Kind::I16.word(40_000, 0), 0x7FFF);
        assert_eq!(Kind::I16.word(-40_000, 0), 0x8000);
        assert_eq!(Kind::I32.word(i64::MAX, 0), 0x7FFF);
        assert_eq!(Kind::U32.word(-1, 1), 0);
    }

    #[test]
    fn the_ends_of_the_types() {
        let ends = KINDS.map(|kind| (kind.name(), kind.width(), kind.min(), kind.max()));
        assert_eq!(
            ends,
            [
                ("u16", 1, 0, 65_535),
                ("i16", 1, -32_768, 32_767),
                ("u32", 2, 0, 4_294_967_295),
                ("i32", 2, -2_147_483_648, 2_147_483_647),
                ("i64", 4, i64::MIN, i64::MAX),
            ]
        );
    }

    #[test]
    fn a_register_belongs_to_one_value_or_to_none() {
        let table = [
            Plain(Layout {
                address: 10,
                kind: Kind::U32,
                count: 2,
            }),
            Plain(Layout {
                address: 14,
                kind: Kind::U16,
                count: 1,
            }),
            Plain(Layout {
                address: 20,
                kind: Kind::I64,
                count: 1,
            }),
        ];
        let found = |address| {
            locate(&table, address)
                .map(|(row, place)| (row.layout().address, place.element, place.word))
        };
        assert_eq!(found(9), None);
        assert_eq!(found(10), Some((10, 0, 0)));
        assert_eq!(found(11), Some((10, 0, 1)));
        assert_eq!(found(12), Some((10, 1, 0)));
        assert_eq!(found(13), Some((10, 1, 1)));
        assert_eq!(found(14), Some((14, 0, 0)));
        assert_eq!(found(15), None);
        assert_eq!(found(23), Some((20, 0, 3)));
        assert_eq!(found(24), None);
        assert_eq!(found(0), None);
        assert_eq!(found(u16::MAX), None);
        assert_eq!(table[0].0.end(), 14);
    }

    proptest! {
        #[test]
        fn words_and_value_are_inverse(value: i64, which in 0..5usize) {
            let kind = KINDS[which];
            let value = value.clamp(kind.min(), kind.max());
            let bits = (0..kind.width())
                .fold(0u64, |bits, word| bits << 16 | u64::from(kind.word(value, word)));
            prop_assert_eq!(kind.value(bits), value);
        }
    }
}
