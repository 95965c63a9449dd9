//! Instructions that parts of `core-logic` take on a Cortex-M4, counted under QEMU.

use anyhow::{Context, Result, bail};

use crate::{image, qemu, toolchain::Toolchain};

/// One line of the measuring image: `COUNT LIMIT NAME`.
#[derive(Debug, PartialEq, Eq)]
struct Count {
    name: String,
    instructions: u32,
    limit: u32,
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
        println!("   {name:<52} {instructions:>6} instructions of {limit}");
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
        limit: limit.parse().ok()?,
    })
}

fn check(counts: &[Count]) -> Result<()> {
    if counts.is_empty() {
        bail!("the measuring image measured nothing");
    }
    let over: Vec<String> = counts
        .iter()
        .filter(|count| count.instructions > count.limit)
        .map(|count| {
            format!(
                "{} takes {} instructions of {}",
                count.name, count.instructions, count.limit
            )
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
        let counts = parse("143 200 range edge: worst of 4\n7 800 sample\n").unwrap();
        assert_eq!(
            counts,
            [
                Count {
                    name: "range edge: worst of 4".into(),
                    instructions: 143,
                    limit: 200
                },
                Count {
                    name: "sample".into(),
                    instructions: 7,
                    limit: 800
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
