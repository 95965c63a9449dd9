//! Instructions that parts of `core-logic` take on a Cortex-M4, counted under QEMU.

use anyhow::{Context, Result, bail};

use crate::{image, qemu, toolchain::Toolchain};

/// One line of the measuring image: `COUNT LIMIT NAME`.
#[derive(Debug, PartialEq, Eq)]
struct Count {
    name: String,
    instructions: u32,
    limit: Option<u32>,
}

/// Builds and runs the measurements; an error if one takes more than its limit.
pub fn run(toolchain: &Toolchain) -> Result<()> {
    let elf = image::build_package(toolchain, "instruction-count")?;
    let counts = parse(&qemu::run(&elf)?)?;
    for Count {
        name,
        instructions,
        limit,
    } in &counts
    {
        let limit = limit.map_or_else(String::new, |limit| format!(" of {limit}"));
        println!("   {name:<52} {instructions:>6} instructions{limit}");
    }
    check(&counts)
}

fn parse(text: &str) -> Result<Vec<Count>> {
    text.lines()
        .map(|line| {
            parse_line(line).with_context(|| {
                format!(
                    "the measuring image printed {line:?} where `COUNT LIMIT NAME` was expected"
                )
            })
        })
        .collect()
}

fn parse_line(line: &str) -> Option<Count> {
    let (count, rest) = line.split_once(' ')?;
    let (limit, name) = rest.split_once(' ')?;
    (!name.is_empty()).then_some(Count {
        name: name.to_owned(),
        instructions: count.parse().ok()?,
        limit: match limit {
            "-" => None,
            limit => Some(limit.parse().ok()?),
        },
    })
}

fn check(counts: &[Count]) -> Result<()> {
    if counts.is_empty() {
        bail!("the measuring image measured nothing");
    }
    let over: Vec<String> = counts
        .iter()
        .filter_map(|count| {
            let limit = count.limit.filter(|limit| count.instructions > *limit)?;
            Some(format!(
                "{} takes {} instructions of {limit}",
                count.name, count.instructions
            ))
        })
        .collect();
    if !over.is_empty() {
        bail!("{}", over.join("; "));
    }
    Ok(())
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn counts_and_limits_are_read() {
        let counts = parse("143 200 range edge: worst of 4\n7 800 sample\n900 - all\n").unwrap();
        assert_eq!(
            counts,
            [
                Count {
                    name: "range edge: worst of 4".into(),
                    instructions: 143,
                    limit: Some(200)
                },
                Count {
                    name: "sample".into(),
                    instructions: 7,
                    limit: Some(800)
                },
                Count {
                    name: "all".into(),
                    instructions: 900,
                    limit: None
                },
            ]
        );
        assert!(check(&counts).is_ok());
    }

    #[test]
    fn a_count_beyond_its_limit_fails_and_the_limit_itself_does_not() {
        assert!(check(&parse("200 200 a").unwrap()).is_ok());
        let error = check(&parse("201 200 a").unwrap()).unwrap_err();
        assert_eq!(error.to_string(), "a takes 201 instructions of 200");
    }

    #[test]
    fn anything_else_is_an_error() {
        for text in ["panic", "12 a b", "1 2", "1 2 ", "\n"] {
            assert!(parse(text).is_err(), "{text:?}");
        }
        assert!(check(&parse("").unwrap()).is_err());
    }
}
