//! A bound on the stack, from the machine code of the image alone.
//!
//! Each function's frame is the sum of every stack adjustment in it. Calls come from `bl` and from branches that leave
//! the function; a call through a register may reach any function whose address is a constant of the image (in a table,
//! a literal pool or a `movw`/`movt` pair). Functions that call each other in a circle are counted once each: the bound
//! holds as long as none of them is entered again before it returned, and they are named. The image does not tell the
//! priorities of its interrupts, so every handler is taken to interrupt every other one, once: more than can happen.

use std::collections::{BTreeMap, BTreeSet};

use anyhow::{Context, Result, bail};
use object::{Object, ObjectSection, ObjectSymbol, SectionFlags, SectionKind, SymbolKind, elf};

use crate::thumb::{self, Effect};

/// Core-coupled memory holds the stack and nothing else (memory.x).
pub const LIMIT: u64 = 64 * 1024;

/// What the processor pushes when it takes an exception: 8 words, 18 more for the floating-point unit, and a word to
/// align (DDI 0403E, B1.5.7).
pub const EXCEPTION_FRAME: u64 = (8 + 18 + 1) * 4;

/// The bound and what it is made of.
#[derive(Debug)]
pub struct Bound {
    /// Every part together.
    pub total: u64,
    /// From reset: `main` and what it calls.
    pub thread: Chain,
    /// Each handler of the vector table, deepest first, without the exception frame.
    pub handlers: Vec<Chain>,
    /// What the bound rests on and a reader should know.
    pub remarks: Vec<Remark>,
}

/// An assumption or a gap, and the functions it concerns.
#[derive(Debug)]
pub struct Remark {
    /// In plain words.
    pub text: String,
    /// By name or by address.
    pub functions: Vec<String>,
}

/// The deepest calls from one entry.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Chain {
    /// Bytes.
    pub depth: u64,
    /// The function it begins with.
    pub entry: String,
    /// From the entry to the deepest function, each with its own bytes.
    pub names: Vec<String>,
}

/// The bound for an image.
pub fn bound(image: &[u8]) -> Result<Bound> {
    let file = object::File::parse(image).context("reading the image")?;
    let program = Program::read(&file)?;
    program.bound()
}

/// Addresses are without the Thumb bit throughout.
#[derive(Default)]
struct Program {
    functions: BTreeMap<u32, Function>,
    /// Functions that a call through a register may reach.
    address_taken: BTreeSet<u32>,
    reset: u32,
    handlers: BTreeSet<u32>,
}

#[derive(Default)]
struct Function {
    name: String,
    end: u32,
    frame: u64,
    /// Counts too if the function sets the stack pointer from a register.
    below: u64,
    calls: BTreeSet<u32>,
    calls_register: bool,
    sets_stack_pointer: bool,
}

impl Function {
    fn stack(&self) -> u64 {
        self.frame
            + if self.sets_stack_pointer {
                self.below
            } else {
                0
            }
    }
}

/// What a stretch of an executable section holds: the mapping symbols `$t` and `$d` of the ELF for the Arm Architecture.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Content {
    Code,
    Data,
}

/// An executable section's bytes and what each stretch of it is.
struct Code<'a> {
    start: u32,
    bytes: &'a [u8],
    /// From each address on.
    content: BTreeMap<u32, Content>,
}

impl Program {
    fn read(file: &object::File<'_>) -> Result<Self> {
        let mut program = Self::default();
        program.read_functions(file)?;
        let mut constants = BTreeSet::new();
        let mut vectors = None;
        for section in file.sections() {
            let SectionFlags::Elf { sh_flags } = section.flags() else {
                continue;
            };
            if sh_flags & u64::from(elf::SHF_ALLOC) == 0
                || section.kind() == SectionKind::UninitializedData
            {
                continue;
            }
            let bytes = section.data()?;
            if section.name()? == ".vector_table" {
                vectors = Some(words(bytes).collect::<Vec<_>>());
            } else if sh_flags & u64::from(elf::SHF_EXECINSTR) == 0 {
                constants.extend(words(bytes));
            } else {
                let start = u32::try_from(section.address())?;
                let code = Code {
                    start,
                    bytes,
                    content: mapping(file, start, bytes.len())?,
                };
                program.scan(&code, &mut constants);
            }
        }
        let vectors = vectors.context("the image has no .vector_table")?;
        program.reset = *vectors.get(1).context("the vector table is empty")? & !1;
        let entries = vectors
            .iter()
            .skip(2)
            .filter(|entry| **entry & 1 == 1)
            .map(|entry| entry & !1);
        program.handlers = entries
            .filter(|entry| program.functions.contains_key(entry))
            .collect();
        program.address_taken = constants
            .into_iter()
            .filter(|constant| constant & 1 == 1)
            .map(|constant| constant & !1)
            .filter(|address| program.functions.contains_key(address))
            .collect();
        if !program.functions.contains_key(&program.reset) {
            bail!(
                "the vector table's reset entry {:#010x} is no function of the image",
                program.reset
            );
        }
        Ok(program)
    }

    fn read_functions(&mut self, file: &object::File<'_>) -> Result<()> {
        for symbol in file
            .symbols()
            .filter(|symbol| symbol.kind() == SymbolKind::Text && symbol.is_definition())
        {
            let name = symbol.name()?;
            if name.starts_with('$') || name.is_empty() {
                continue;
            }
            let address = u32::try_from(symbol.address())? & !1;
            let end = address.saturating_add(u32::try_from(symbol.size())?);
            let function = self.functions.entry(address).or_default();
            function.end = function.end.max(end);
            // Of several names for the same code: that of the default handler, else the first in alphabetical order.
            let name = format!("{:#}", rustc_demangle::demangle(name));
            let other = |name: &str| !name.starts_with("DefaultHandler");
            if function.name.is_empty()
                || (other(&name), name.as_str()) < (other(&function.name), function.name.as_str())
            {
                function.name = name;
            }
        }
        // Hand-written assembly may not say how long it is.
        let starts: Vec<u32> = self.functions.keys().copied().collect();
        for (start, next) in starts
            .iter()
            .zip(starts.iter().skip(1).copied().chain([u32::MAX]))
        {
            if let Some(function) = self.functions.get_mut(start)
                && (function.end == *start || function.end > next)
            {
                function.end = next;
            }
        }
        Ok(())
    }

    /// The function that holds this address.
    fn at(&self, address: u32) -> Option<u32> {
        let (start, function) = self.functions.range(..=address).next_back()?;
        (address < function.end).then_some(*start)
    }

    fn scan(&mut self, code: &Code<'_>, constants: &mut BTreeSet<u32>) {
        let halfwords: Vec<u16> = code
            .bytes
            .as_chunks()
            .0
            .iter()
            .map(|pair| u16::from_le_bytes(*pair))
            .collect();
        // Literal pools and jump tables.
        for (offset, word) in (0..).step_by(4).zip(words(code.bytes)) {
            if code.content_at(code.start + offset) == Content::Data {
                constants.insert(word);
            }
        }
        let mut address = code.start;
        let mut rest = halfwords.as_slice();
        let mut low_halves: BTreeMap<u8, u16> = BTreeMap::new();
        let mut current = None;
        while let Some((&first, tail)) = rest.split_first() {
            if code.content_at(address) == Content::Data {
                (address, rest) = (address + 2, tail);
                continue;
            }
            let here = self.at(address);
            if here != current {
                current = here;
                low_halves.clear();
            }
            let (effect, length, next) = match tail.split_first() {
                Some((&second, next)) if thumb::is_wide(first) => {
                    (thumb::wide(address, first, second), 4, next)
                }
                _ => (thumb::narrow(address, first), 2, tail),
            };
            match effect {
                Effect::MoveLow(register, value) => {
                    low_halves.insert(register, value);
                }
                Effect::MoveHigh(register, high) => {
                    if let Some(low) = low_halves.get(&register) {
                        constants.insert(u32::from(high) << 16 | u32::from(*low));
                    }
                }
                _ => {}
            }
            self.apply(here, effect);
            (address, rest) = (address + length, next);
        }
    }

    fn apply(&mut self, here: Option<u32>, effect: Effect) {
        let target = match effect {
            Effect::Call(target) | Effect::Branch(target) => self.at(target),
            _ => None,
        };
        let Some(start) = here else {
            return;
        };
        let Some(function) = self.functions.get_mut(&start) else {
            return;
        };
        match effect {
            Effect::Grow(bytes) => function.frame += u64::from(bytes),
            Effect::Below(bytes) | Effect::Align(bytes) => function.below += u64::from(bytes),
            Effect::SetStackPointer => function.sets_stack_pointer = true,
            Effect::Call(_) => function.calls.extend(target),
            // A branch to its own first instruction is a loop.
            Effect::Branch(_) => function
                .calls
                .extend(target.filter(|target| *target != start)),
            Effect::CallRegister | Effect::BranchRegister => function.calls_register = true,
            Effect::None | Effect::TableBranch | Effect::MoveLow(..) | Effect::MoveHigh(..) => {}
        }
    }

    fn callees(&self, start: u32) -> impl Iterator<Item = u32> + '_ {
        let function = self.functions.get(&start);
        let direct = function
            .into_iter()
            .flat_map(|function| function.calls.iter().copied());
        let any = function.is_some_and(|function| function.calls_register);
        direct.chain(self.address_taken.iter().copied().filter(move |_| any))
    }

    fn bound(&self) -> Result<Bound> {
        let groups = Groups::find(self);
        let mut deepest = BTreeMap::new();
        let mut depth_of = |entry: u32| -> Result<Chain> {
            let group = *groups
                .of
                .get(&entry)
                .context("a function belongs to no group")?;
            let (depth, path) = groups.deepest(self, group, &mut deepest);
            let entry = self
                .functions
                .get(&entry)
                .map(|function| function.name.clone())
                .unwrap_or_default();
            Ok(Chain {
                depth,
                entry,
                names: path,
            })
        };
        let thread = depth_of(self.reset)?;
        let mut handlers = self
            .handlers
            .iter()
            .map(|handler| depth_of(*handler))
            .collect::<Result<Vec<_>>>()?;
        handlers.sort_by(|a, b| b.depth.cmp(&a.depth).then_with(|| a.names.cmp(&b.names)));
        let total = thread.depth
            + handlers
                .iter()
                .map(|handler| handler.depth + EXCEPTION_FRAME)
                .sum::<u64>();
        Ok(Bound {
            total,
            thread,
            handlers,
            remarks: self.remarks(&groups),
        })
    }

    fn remarks(&self, groups: &Groups) -> Vec<Remark> {
        let reached = self.reached();
        let names = |starts: &mut dyn Iterator<Item = &u32>| -> Vec<String> {
            let functions = starts.filter_map(|start| self.functions.get(start));
            functions.map(|function| function.name.clone()).collect()
        };
        let those = |property: fn(&Function) -> bool| {
            names(
                &mut reached
                    .iter()
                    .filter(|start| self.functions.get(start).is_some_and(property)),
            )
        };
        let mut remarks = Vec::new();
        let functions = those(|function| function.calls_register);
        if !functions.is_empty() {
            remarks.push(Remark {
                text: format!(
                    "{} functions call through a register; each is taken to reach any of the {} functions whose address \
                     is a constant",
                    functions.len(),
                    self.address_taken.len()
                ),
                functions,
            });
        }
        for members in &groups.members {
            let circle = members.len() > 1
                || members
                    .iter()
                    .any(|member| self.callees(*member).any(|callee| callee == *member));
            if circle && members.iter().any(|member| reached.contains(member)) {
                let mut functions = names(&mut members.iter());
                functions.sort();
                remarks.push(Remark {
                    text: format!(
                        "{} functions may call each other in a circle: each is counted once",
                        functions.len()
                    ),
                    functions,
                });
            }
        }
        let functions = those(|function| function.sets_stack_pointer);
        if !functions.is_empty() {
            remarks.push(Remark {
                text: format!(
                    "{} functions set the stack pointer from a register: taken as aligning it or as going back to an \
                     earlier value",
                    functions.len()
                ),
                functions,
            });
        }
        remarks
    }

    /// Everything that can run.
    fn reached(&self) -> BTreeSet<u32> {
        let mut reached = BTreeSet::new();
        let mut waiting: Vec<u32> = self.handlers.iter().copied().chain([self.reset]).collect();
        while let Some(start) = waiting.pop() {
            if reached.insert(start) {
                waiting.extend(self.callees(start));
            }
        }
        reached
    }
}

/// Functions that can reach each other, found by Tarjan's algorithm (1972) without recursion. A group comes after every
/// group that it calls.
struct Groups {
    members: Vec<Vec<u32>>,
    of: BTreeMap<u32, usize>,
}

impl Groups {
    fn find(program: &Program) -> Self {
        let mut groups = Self {
            members: Vec::new(),
            of: BTreeMap::new(),
        };
        let mut index: BTreeMap<u32, usize> = BTreeMap::new();
        let mut lowest: BTreeMap<u32, usize> = BTreeMap::new();
        let mut open: Vec<u32> = Vec::new();
        for root in program.functions.keys() {
            if index.contains_key(root) {
                continue;
            }
            let mut path = vec![(*root, program.callees(*root).collect::<Vec<_>>())];
            index.insert(*root, index.len());
            lowest.insert(*root, index.len() - 1);
            open.push(*root);
            while let Some((here, callees)) = path.last_mut() {
                let here = *here;
                if let Some(callee) = callees.pop() {
                    if let Some(seen) = index.get(&callee) {
                        // Only one that is still open can lead back here.
                        if !groups.of.contains_key(&callee) {
                            lower(&mut lowest, here, *seen);
                        }
                    } else {
                        index.insert(callee, index.len());
                        lowest.insert(callee, index.len() - 1);
                        open.push(callee);
                        path.push((callee, program.callees(callee).collect()));
                    }
                    continue;
                }
                path.pop();
                let low = lowest.get(&here).copied().unwrap_or_default();
                if let Some((parent, _)) = path.last() {
                    lower(&mut lowest, *parent, low);
                }
                if index.get(&here) == Some(&low) {
                    let from = open
                        .iter()
                        .rposition(|start| *start == here)
                        .unwrap_or_default();
                    let members = open.split_off(from);
                    for member in &members {
                        groups.of.insert(*member, groups.members.len());
                    }
                    groups.members.push(members);
                }
            }
        }
        groups
    }

    /// The deepest stack from this group on, and the names along it.
    fn deepest(
        &self,
        program: &Program,
        group: usize,
        known: &mut BTreeMap<usize, (u64, Vec<String>)>,
    ) -> (u64, Vec<String>) {
        // Callees have lower numbers, so going upwards from the lowest finds each of them ready.
        for number in 0..=group {
            if known.contains_key(&number) {
                continue;
            }
            let Some(members) = self.members.get(number) else {
                continue;
            };
            let functions = || {
                members
                    .iter()
                    .filter_map(|member| program.functions.get(member))
            };
            let own: u64 = functions().map(Function::stack).sum();
            let below = members
                .iter()
                .flat_map(|member| program.callees(*member))
                .filter_map(|callee| self.of.get(&callee))
                .filter(|callee| **callee != number)
                .filter_map(|callee| known.get(callee))
                .max_by_key(|(depth, _)| *depth)
                .cloned()
                .unwrap_or_default();
            let mut name = functions()
                .map(|function| function.name.as_str())
                .min()
                .unwrap_or("?")
                .to_owned();
            if members.len() > 1 {
                name.push_str(&format!(" and {} more", members.len() - 1));
            }
            let names = std::iter::once(format!("{name} ({own})"))
                .chain(below.1)
                .collect();
            known.insert(number, (own + below.0, names));
        }
        known.get(&group).cloned().unwrap_or_default()
    }
}

fn lower(lowest: &mut BTreeMap<u32, usize>, start: u32, value: usize) {
    if let Some(low) = lowest.get_mut(&start) {
        *low = value.min(*low);
    }
}

impl Code<'_> {
    fn content_at(&self, address: u32) -> Content {
        self.content
            .range(..=address)
            .next_back()
            .map_or(Content::Code, |(_, content)| *content)
    }
}

fn mapping(file: &object::File<'_>, start: u32, length: usize) -> Result<BTreeMap<u32, Content>> {
    let end = start.saturating_add(u32::try_from(length)?);
    let mut content = BTreeMap::new();
    for symbol in file.symbols() {
        let address = u32::try_from(symbol.address())?;
        if !(start..end).contains(&address) {
            continue;
        }
        let name = symbol.name()?;
        if name == "$t" || name.starts_with("$t.") {
            content.insert(address, Content::Code);
        } else if name == "$d" || name.starts_with("$d.") {
            content.insert(address, Content::Data);
        }
    }
    Ok(content)
}

fn words(bytes: &[u8]) -> impl Iterator<Item = u32> + '_ {
    bytes
        .as_chunks()
        .0
        .iter()
        .map(|word| u32::from_le_bytes(*word))
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::indexing_slicing)]
mod tests {
    use super::*;

    const START: u32 = 0x0800_0100;

    /// A program of functions that each begin at the next of `starts` and end with the next one.
    fn program(codes: &[(&str, &[u16])], data_at: Option<u32>) -> Program {
        let mut program = Program::default();
        let mut bytes = Vec::new();
        for (name, code) in codes {
            let start = START + u32::try_from(bytes.len()).unwrap();
            bytes.extend(code.iter().flat_map(|halfword| halfword.to_le_bytes()));
            let end = START + u32::try_from(bytes.len()).unwrap();
            program.functions.insert(
                start,
                Function {
                    name: (*name).to_owned(),
                    end,
                    ..Function::default()
                },
            );
        }
        let mut content = BTreeMap::from([(START, Content::Code)]);
        content.extend(data_at.map(|address| (address, Content::Data)));
        let mut constants = BTreeSet::new();
        program.scan(
            &Code {
                start: START,
                bytes: &bytes,
                content,
            },
            &mut constants,
        );
        program.address_taken = constants
            .into_iter()
            .filter(|constant| {
                constant & 1 == 1 && program.functions.contains_key(&(constant & !1))
            })
            .map(|constant| constant & !1)
            .collect();
        program.reset = START;
        program
    }

    #[test]
    fn frames_add_up_along_the_deepest_calls() {
        let program = program(
            &[
                // push {r4, lr}; bl b; bl c; pop {r4, pc}
                ("a", &[0xB510, 0xF000, 0xF803, 0xF000, 0xF803, 0xBD10]),
                // sub sp, #8; bx lr
                ("b", &[0xB082, 0x4770]),
                // push {lr}; sub sp, #64; bx lr
                ("c", &[0xB500, 0xB090, 0x4770]),
            ],
            None,
        );
        let bound = program.bound().unwrap();
        assert_eq!(
            bound.thread,
            Chain {
                depth: 8 + 68,
                entry: "a".into(),
                names: vec!["a (8)".into(), "c (68)".into()]
            }
        );
        assert_eq!(bound.total, 76);
        assert!(bound.remarks.is_empty(), "{:?}", bound.remarks);
    }

    #[test]
    fn each_handler_adds_its_depth_and_an_exception_frame() {
        let mut program = program(
            &[
                ("main", &[0xB082, 0xE7FE]),
                ("first", &[0xB083, 0x4770]),
                ("second", &[0xB084, 0x4770]),
            ],
            None,
        );
        program.handlers = BTreeSet::from([START + 4, START + 8]);
        let bound = program.bound().unwrap();
        assert_eq!(bound.total, 8 + (12 + 108) + (16 + 108));
        assert_eq!(
            bound.handlers[0],
            Chain {
                depth: 16,
                entry: "second".into(),
                names: vec!["second (16)".into()]
            }
        );
    }

    #[test]
    fn a_branch_out_of_the_function_is_a_call_and_a_loop_is_none() {
        let program = program(
            &[
                // push {r4, lr}; b a; b.w b
                ("a", &[0xB510, 0xE7FD, 0xF000, 0xB800]),
                // sub sp, #32; bx lr
                ("b", &[0xB088, 0x4770]),
            ],
            None,
        );
        assert_eq!(program.functions[&START].calls, BTreeSet::from([START + 8]));
        assert_eq!(program.bound().unwrap().total, 40);
    }

    #[test]
    fn a_call_through_a_register_may_reach_whatever_has_its_address_taken() {
        let program = program(
            &[
                // movw r3, #0x0109; movt r3, #0x0800; blx r3
                ("a", &[0xF240, 0x1309, 0xF6C0, 0x0300, 0x4798]),
                // nop: ends a at an address that is no function's
                ("gap", &[0xBF00]),
                ("b", &[0xB088, 0x4770]),
            ],
            None,
        );
        assert!(program.address_taken.is_empty());
        let program = super::tests::program(
            &[
                // movw r3, #0x010d; movt r3, #0x0800; blx r3; nop
                ("a", &[0xF240, 0x130D, 0xF6C0, 0x0300, 0x4798, 0xBF00]),
                // sub sp, #32; bx lr
                ("b", &[0xB088, 0x4770]),
            ],
            None,
        );
        assert_eq!(program.address_taken, BTreeSet::from([START + 12]));
        let bound = program.bound().unwrap();
        assert_eq!(bound.total, 32);
        assert!(
            bound.remarks[0].text.contains("any of the 1 functions")
                && bound.remarks[0].functions == ["a"],
            "{:?}",
            bound.remarks
        );
    }

    #[test]
    fn a_literal_pool_is_data_and_takes_addresses() {
        let program = program(
            &[
                // blx r3; bx lr; then .word 0x0800010d and a halfword pair that would be `push {r4-r7, lr}` as code
                ("a", &[0x4798, 0x4770, 0x010D, 0x0800, 0xB5F0, 0xB5F0]),
                // sub sp, #32; bx lr
                ("b", &[0xB088, 0x4770]),
            ],
            Some(START + 4),
        );
        assert_eq!(program.functions[&START].frame, 0);
        assert_eq!(program.address_taken, BTreeSet::from([START + 12]));
    }

    #[test]
    fn a_circle_is_counted_once_and_named() {
        let program = program(
            &[
                // push {r4, lr}; bl b; pop {r4, pc}
                ("a", &[0xB510, 0xF000, 0xF801, 0xBD10]),
                // push {r4, lr}; sub sp, #8; bl a; bl c; pop {r4, pc}
                (
                    "b",
                    &[0xB510, 0xB082, 0xF7FF, 0xFFF8, 0xF000, 0xF801, 0xBD10],
                ),
                // sub sp, #100; bx lr
                ("c", &[0xB099, 0x4770]),
            ],
            None,
        );
        let bound = program.bound().unwrap();
        assert_eq!(bound.total, 8 + 16 + 100);
        assert!(
            bound.remarks[0]
                .text
                .starts_with("2 functions may call each other in a circle"),
            "{:?}",
            bound.remarks
        );
        assert_eq!(bound.remarks[0].functions, ["a", "b"]);
    }

    #[test]
    fn a_function_that_calls_itself_is_named() {
        // push {r4, lr}; bl a; pop {r4, pc}
        let program = program(&[("a", &[0xB510, 0xF7FF, 0xFFFD, 0xBD10])], None);
        let bound = program.bound().unwrap();
        assert_eq!(bound.total, 8);
        assert!(
            bound.remarks[0]
                .text
                .starts_with("1 functions may call each other in a circle")
        );
        assert_eq!(bound.remarks[0].functions, ["a"]);
    }

    #[test]
    fn masking_a_number_is_no_frame() {
        // push {r4, lr}; bfc r4, #0, #23; pop {r4, pc}
        let program = program(&[("a", &[0xB510, 0xF36F, 0x0416, 0xBD10])], None);
        assert_eq!(program.bound().unwrap().total, 8);
    }

    #[test]
    fn an_aligned_frame_counts_what_alignment_may_lose() {
        // push {r4, lr}; sub.w r4, sp, #32; bfc r4, #0, #5; mov sp, r4
        let program = program(
            &[("a", &[0xB510, 0xF1AD, 0x0420, 0xF36F, 0x0404, 0x46A5])],
            None,
        );
        let bound = program.bound().unwrap();
        assert!(
            bound.remarks[0].text.contains("from a register"),
            "{:?}",
            bound.remarks
        );
        assert_eq!(bound.total, 8 + 32 + 32);
    }
}
