//! Conversion rules of MDF 4 (ASAM MDF 4.1, block CC).

use super::blocks::{Block, File, f64_at, u16_at};
use crate::{
    error::Result,
    unit::{Scale, Unit},
};

/// How a raw value becomes a physical one, in our unit.
#[derive(Clone, Debug, PartialEq)]
pub enum Conversion {
    /// Offset and factor, as in a DBC.
    Linear {
        factor: Scale,
        offset: f64,
        unit: Scale,
    },
    /// (p1 x² + p2 x + p3) / (p4 x² + p5 x + p6).
    Rational([f64; 6], Scale),
    /// Pairs of raw and physical value in rising order; between them a straight line, or the nearest one.
    Table {
        pairs: Vec<(f64, f64)>,
        interpolated: bool,
        unit: Scale,
    },
    /// Raw values from … to, their physical value, and that of all others.
    Ranges {
        ranges: Vec<(f64, f64, f64)>,
        otherwise: f64,
        /// The upper end belongs to a range: so it is with whole numbers only.
        closed: bool,
        unit: Scale,
    },
    /// Raw values from … to are states, which have a text and no number; the others are converted.
    StatesAnd {
        states: Vec<(f64, f64)>,
        others: Box<Conversion>,
    },
}

impl Conversion {
    /// The rule at `address`, for a channel of whole numbers or not; `None` if it gives no number or is a formula.
    pub fn read(
        file: &File<'_>,
        address: Option<u64>,
        whole: bool,
        unit: Option<Unit>,
    ) -> Result<Option<Self>> {
        Self::read_at(file, address, whole, unit, 4)
    }

    fn read_at(
        file: &File<'_>,
        address: Option<u64>,
        whole: bool,
        unit: Option<Unit>,
        depth: u32,
    ) -> Result<Option<Self>> {
        let scale = unit.map_or(Scale::Times(1.0), |unit| unit.scale);
        let identity = Self::Linear {
            factor: scale,
            offset: 0.0,
            unit: scale,
        };
        let Some(address) = address else {
            return Ok(Some(identity));
        };
        let block = file.block_of(address, b"CC")?;
        let count = usize::from(u16_at(block.data, 6));
        if block.data.len() < VALUES + 8 * count {
            return Err(file.fault(
                address,
                &format!("a conversion cut before its {count} values"),
                "all of them",
            ));
        }
        let value = |index: usize| f64_at(block.data, VALUES + 8 * index);
        Ok(match (block.data[0], count) {
            (0, _) => Some(identity),
            (1, 2..) => Some(Self::Linear {
                factor: Scale::of(value(1), unit),
                offset: scale.apply(value(0)),
                unit: scale,
            }),
            (2, 6..) => Some(Self::Rational([0, 1, 2, 3, 4, 5].map(value), scale)),
            (kind @ (4 | 5), 2..) => Some(Self::Table {
                pairs: (0..count / 2)
                    .map(|pair| (value(2 * pair), value(2 * pair + 1)))
                    .collect(),
                interpolated: kind == 4,
                unit: scale,
            }),
            (6, 1..) => Some(Self::Ranges {
                ranges: (0..count / 3)
                    .map(|range| (value(3 * range), value(3 * range + 1), value(3 * range + 2)))
                    .collect(),
                otherwise: value(count - 1),
                closed: whole,
                unit: scale,
            }),
            (7, _) => {
                let states = (0..count).map(|index| (value(index), value(index)));
                return Self::states(file, &block, states.collect(), whole, unit, depth);
            }
            (8, _) => {
                let states = (0..count / 2).map(|range| (value(2 * range), value(2 * range + 1)));
                return Self::states(file, &block, states.collect(), whole, unit, depth);
            }
            _ => None,
        })
    }

    /// A value with a text is a state. Where all values are, the raw number names it; where the others are converted,
    /// they are quantities, and those with a text (such as "not available") have no number.
    fn states(
        file: &File<'_>,
        block: &Block<'_>,
        states: Vec<(f64, f64)>,
        whole: bool,
        unit: Option<Unit>,
        depth: u32,
    ) -> Result<Option<Self>> {
        // After name, unit, comment and inverse: a reference for each state, then the one for all others.
        let others = block.link(4 + states.len());
        let rule = match others {
            Some(address) if file.block(address)?.id == *b"CC" && depth > 0 => {
                Self::read_at(file, others, whole, unit, depth - 1)?
            }
            _ => return Self::read_at(file, None, whole, None, 0),
        };
        Ok(rule.map(|rule| Self::StatesAnd {
            states,
            others: Box::new(rule),
        }))
    }

    /// The physical value, NaN if there is none.
    pub fn apply(&self, raw: f64) -> f64 {
        match self {
            Self::Linear { factor, offset, .. } => factor.apply(raw) + offset,
            Self::Rational([p1, p2, p3, p4, p5, p6], unit) => {
                unit.apply(((p1 * raw + p2) * raw + p3) / ((p4 * raw + p5) * raw + p6))
            }
            Self::Table {
                pairs,
                interpolated,
                unit,
            } => unit.apply(looked_up(pairs, *interpolated, raw)),
            Self::Ranges {
                ranges,
                otherwise,
                closed,
                unit,
            } => {
                let range = ranges.iter().find(|(from, to, _)| {
                    *from <= raw && (raw < *to || raw == *to && (*closed || from == to))
                });
                unit.apply(range.map_or(*otherwise, |range| range.2))
            }
            Self::StatesAnd { states, others } => {
                if states.iter().any(|(from, to)| *from <= raw && raw <= *to) {
                    f64::NAN
                } else {
                    others.apply(raw)
                }
            }
        }
    }
}

/// Kind, precision, flags, counts of references and values, range: then the values.
const VALUES: usize = 24;

fn looked_up(pairs: &[(f64, f64)], interpolated: bool, raw: f64) -> f64 {
    let above = pairs.partition_point(|pair| pair.0 <= raw);
    let below = above.checked_sub(1).and_then(|index| pairs.get(index));
    match (below, pairs.get(above)) {
        (Some(below), Some(above)) => {
            let share = (raw - below.0) / (above.0 - below.0);
            if interpolated {
                below.1 + share * (above.1 - below.1)
            } else if share <= 0.5 {
                // Half way, the lower one (ASAM MDF 4.1, "tabular look-up without interpolation").
                below.1
            } else {
                above.1
            }
        }
        (Some(only), None) | (None, Some(only)) => only.1,
        (None, None) => f64::NAN,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const UNIT: Scale = Scale::Times(1.0);

    #[test]
    fn tables_end_flat() {
        let table = |interpolated| Conversion::Table {
            pairs: vec![(0.0, 1.0), (2.0, 5.0), (4.0, -3.0)],
            interpolated,
            unit: UNIT,
        };
        for (raw, line, nearest) in [
            (-1.0, 1.0, 1.0),
            (0.0, 1.0, 1.0),
            (1.0, 3.0, 1.0),
            (1.5, 4.0, 5.0),
            (3.0, 1.0, 5.0),
            (4.0, -3.0, -3.0),
            (9.0, -3.0, -3.0),
        ] {
            assert_eq!(table(true).apply(raw), line, "{raw}");
            assert_eq!(table(false).apply(raw), nearest, "{raw}");
        }
    }

    #[test]
    fn ranges_have_an_end_that_depends_on_the_channel() {
        let ranges = |closed| Conversion::Ranges {
            ranges: vec![(0.0, 2.0, 10.0), (3.0, 4.0, 20.0)],
            otherwise: -1.0,
            closed,
            unit: UNIT,
        };
        for (raw, whole, real) in [
            (0.0, 10.0, 10.0),
            (2.0, 10.0, -1.0),
            (3.0, 20.0, 20.0),
            (4.0, 20.0, -1.0),
        ] {
            assert_eq!(ranges(true).apply(raw), whole, "{raw}");
            assert_eq!(ranges(false).apply(raw), real, "{raw}");
        }
    }

    #[test]
    fn states_have_no_number() {
        let rule = Conversion::StatesAnd {
            states: vec![(254.0, 255.0)],
            others: Box::new(Conversion::Linear {
                factor: Scale::Over(2.0),
                offset: -40.0,
                unit: UNIT,
            }),
        };
        assert_eq!(rule.apply(100.0), 10.0);
        assert!(rule.apply(255.0).is_nan());
    }

    #[test]
    fn rational_rule() {
        let rule = Conversion::Rational([1.0, 2.0, 3.0, 0.0, 1.0, 1.0], Scale::Over(1e3));
        assert_eq!(rule.apply(2.0), (4.0 + 4.0 + 3.0) / 3.0 / 1e3);
    }
}
