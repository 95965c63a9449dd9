//! Columns under other names: `NAME=COLUMN`.

use crate::error::{Error, Kind, Place, Result, quoted};

/// Which column of a file stands for which name.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Mapping {
    pairs: Vec<(String, String)>,
}

impl Mapping {
    /// No mapping: every column keeps its name.
    pub fn new() -> Self {
        Self::default()
    }

    /// From arguments such as `i_ref_a=Shunt current`.
    pub fn parse<'a>(arguments: impl IntoIterator<Item = &'a str>) -> Result<Self> {
        let mut mapping = Self::new();
        for argument in arguments {
            let Some((name, column)) = argument.split_once('=') else {
                return Err(fault(
                    quoted(argument),
                    "NAME=COLUMN, such as i_ref_a=Current",
                ));
            };
            mapping.add(name, column)?;
        }
        Ok(mapping)
    }

    /// `column` of the file is called `name`. A column of the file that has this name already is then not seen.
    pub fn add(&mut self, name: &str, column: &str) -> Result<()> {
        let (name, column) = (name.trim(), column.trim());
        if name.is_empty() || column.is_empty() {
            return Err(fault(
                quoted(&format!("{name}={column}")),
                "a name on either side of the equals sign",
            ));
        }
        if self.pairs.iter().any(|(known, _)| known == name) {
            return Err(fault(
                format!("{} twice", quoted(name)),
                "each name once in a mapping",
            ));
        }
        self.pairs.push((name.to_owned(), column.to_owned()));
        Ok(())
    }

    /// Pairs of name and column, in the order given.
    pub fn pairs(&self) -> impl ExactSizeIterator<Item = (&str, &str)> {
        self.pairs
            .iter()
            .map(|(name, column)| (name.as_str(), column.as_str()))
    }

    /// Nothing is mapped.
    pub fn is_empty(&self) -> bool {
        self.pairs.is_empty()
    }
}

fn fault(found: String, expected: &str) -> Error {
    Error::new(
        Kind::Mapping,
        "column mapping",
        Place::default(),
        found,
        expected,
    )
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

    use super::*;

    #[test]
    fn reads_arguments() {
        let mapping = Mapping::parse(["i_ref_a=Shunt = A", "t_s = Time"]).unwrap();
        let pairs: Vec<_> = mapping.pairs().collect();
        assert_eq!(pairs, [("i_ref_a", "Shunt = A"), ("t_s", "Time")]);
    }

    #[test]
    fn refuses_what_cannot_be_followed() {
        for wrong in [vec!["i_ref_a"], vec!["=x"], vec!["x="], vec!["a=x", "a=y"]] {
            let error = Mapping::parse(wrong.iter().copied()).unwrap_err();
            assert_eq!(error.kind(), Kind::Mapping, "{error}");
        }
    }
}
