//! `can/board.dbc` is the definition of the frames: every number in the code is compared with it, and `docs/can.md` and
//! `docs/diagnosis.md` are made from it and from the table of diagnoses. `UPDATE_DOCS=1 cargo test` writes the two.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing
)]

use can_dbc::{
    AttributeValue, ByteOrder, Dbc, MessageId, MultiplexIndicator, NumericValue, ValueType,
};
use core_logic::can::layout::{Direction, Field, MESSAGES, Message, Scale};
use core_logic::diagnosis::{Code, Latch, Severity};
use core_logic::validity::Validity;
use core_logic::{can, design_parameters};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

const NOT_AVAILABLE: &str = "not available";

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn dbc() -> Dbc {
    let text = std::fs::read_to_string(root().join("can/board.dbc")).unwrap();
    assert!(text.is_ascii(), "tools disagree on the encoding of a DBC");
    Dbc::try_from(text.as_str()).unwrap()
}

fn number(value: NumericValue) -> f64 {
    match value {
        NumericValue::Uint(value) => value as f64,
        NumericValue::Int(value) => value as f64,
        NumericValue::Double(value) => value,
    }
}

fn attribute(dbc: &Dbc, id: MessageId, name: &str) -> String {
    match dbc.resolved_message_attribute(id, name).unwrap() {
        AttributeValue::Uint(value) => value.to_string(),
        AttributeValue::Int(value) => value.to_string(),
        AttributeValue::Double(value) => value.to_string(),
        AttributeValue::String(value) => value.clone(),
    }
}

/// The signals of a message as the code has them; the two with a bit per diagnosis are spelled out here.
fn signals(message: &Message) -> Vec<(String, Field, Scale, Option<u8>)> {
    let plain = Scale {
        numerator: 1,
        denominator: 1,
        offset: 0,
    };
    match message.prefix_of_codes {
        Some(prefix) => Code::ALL
            .into_iter()
            .map(|code| {
                let field = Field {
                    start: code.number(),
                    length: 1,
                    signed: false,
                    has_not_available: false,
                    maximum: 1,
                };
                (format!("{prefix}{code:?}"), field, plain, None)
            })
            .collect(),
        None => message
            .signals
            .iter()
            .map(|signal| {
                (
                    signal.name.to_string(),
                    signal.field,
                    signal.scale,
                    signal.page,
                )
            })
            .collect(),
    }
}

fn close(a: f64, b: f64) -> bool {
    (a - b).abs() <= 1e-12 * a.abs().max(b.abs())
}

#[test]
fn code_and_dbc_have_the_same_messages() {
    let dbc = dbc();
    assert_eq!(dbc.messages.len(), MESSAGES.len());
    for message in &MESSAGES {
        let id = MessageId::Standard(message.header.id);
        let theirs = dbc.messages.iter().find(|theirs| theirs.id == id).unwrap();
        assert_eq!(theirs.name, message.name);
        assert_eq!(theirs.size, 8, "{}", message.name);
        let sent_by_board = theirs.transmitter.as_deref() == Some("HALLMARK");
        assert_eq!(
            sent_by_board,
            message.header.direction == Direction::Transmitted,
            "{}",
            message.name
        );
        assert_eq!(
            attribute(&dbc, id, "GenMsgCycleTime"),
            message.header.cycle_ms.to_string()
        );
        assert_eq!(
            attribute(&dbc, id, "GenMsgStartDelayTime"),
            message.header.phase_ms.to_string()
        );
        let (profile, data_id) = match message.header.data_id {
            Some(data_id) => ("P11C", data_id.get()),
            None => ("none", 0),
        };
        assert_eq!(
            attribute(&dbc, id, "E2EProfile"),
            profile,
            "{}",
            message.name
        );
        assert_eq!(
            attribute(&dbc, id, "E2EDataId"),
            data_id.to_string(),
            "{}",
            message.name
        );
    }
    let cycle = |header: can::layout::Header| u64::from(header.cycle_ms);
    assert_eq!(
        cycle(can::layout::current::HEADER),
        design_parameters::CURRENT_FRAME_MS
    );
    assert_eq!(
        cycle(can::layout::charge::HEADER),
        design_parameters::CHARGE_FRAME_MS
    );
    assert_eq!(
        cycle(can::layout::state_of_charge::HEADER),
        design_parameters::CHARGE_FRAME_MS
    );
    let baudrate = dbc
        .attribute_values_database
        .iter()
        .find(|attribute| attribute.name == "Baudrate");
    assert_eq!(
        baudrate.unwrap().value,
        AttributeValue::Uint(u64::from(design_parameters::CAN_BITRATE))
    );
}

#[test]
fn code_and_dbc_have_the_same_signals() {
    let dbc = dbc();
    let mut compared = 0;
    for message in &MESSAGES {
        let id = MessageId::Standard(message.header.id);
        let theirs = dbc.messages.iter().find(|theirs| theirs.id == id).unwrap();
        let ours = signals(message);
        assert_eq!(theirs.signals.len(), ours.len(), "{}", message.name);
        let paged = ours.iter().any(|(_, _, _, page)| page.is_some());
        for (name, field, scale, page) in ours {
            let their = dbc
                .signal_by_name(id, &name)
                .unwrap_or_else(|| panic!("{name} is not in the DBC"));
            assert_eq!(
                (their.start_bit, their.size),
                (u64::from(field.start), u64::from(field.length)),
                "{name}"
            );
            assert_eq!(their.byte_order, ByteOrder::LittleEndian, "{name}");
            assert_eq!(
                their.value_type == ValueType::Signed,
                field.signed,
                "{name}"
            );
            let factor = scale.numerator as f64 / scale.denominator as f64;
            assert!(
                close(their.factor, factor) && close(their.offset, scale.offset as f64),
                "{name}"
            );
            let physical = |raw: i64| raw as f64 * factor + scale.offset as f64;
            assert!(
                close(number(their.min), physical(field.minimum())),
                "{name} {:?}",
                their.min
            );
            assert!(
                close(number(their.max), physical(field.maximum)),
                "{name} {:?}",
                their.max
            );
            let values = dbc
                .value_descriptions_for_signal(id, &name)
                .unwrap_or_default();
            let not_available = values
                .iter()
                .find(|value| value.description == NOT_AVAILABLE)
                .map(|value| value.id);
            assert_eq!(not_available, field.not_available(), "{name}");
            let expected = match page {
                Some(page) => MultiplexIndicator::MultiplexedSignal(u64::from(page)),
                None if paged => MultiplexIndicator::Multiplexor,
                None => MultiplexIndicator::Plain,
            };
            assert_eq!(their.multiplexer_indicator, expected, "{name}");
            compared += 1;
        }
    }
    assert_eq!(
        compared,
        dbc.messages
            .iter()
            .map(|message| message.signals.len())
            .sum::<usize>()
    );
}

#[test]
fn signals_fit_do_not_overlap_and_are_described() {
    let dbc = dbc();
    let mut names = std::collections::BTreeSet::new();
    for message in &MESSAGES {
        let id = MessageId::Standard(message.header.id);
        assert!(
            dbc.message_comment(id)
                .is_some_and(|comment| !comment.is_empty())
        );
        let pages: std::collections::BTreeSet<Option<u8>> = signals(message)
            .into_iter()
            .map(|(_, _, _, page)| page)
            .collect();
        for page in pages {
            let mut used = 0u64;
            for (name, field, _, of) in signals(message) {
                if of.is_some() && of != page {
                    continue;
                }
                assert!(
                    u32::from(field.start) + u32::from(field.length) <= 64,
                    "{name}"
                );
                let bits = ((1u64 << field.length) - 1) << field.start;
                assert_eq!(used & bits, 0, "{name} overlaps");
                used |= bits;
            }
        }
        for (name, field, _, _) in signals(message) {
            assert!(
                dbc.signal_comment(id, &name)
                    .is_some_and(|comment| comment.len() > 5),
                "{name} has no comment"
            );
            // The limits, and "not available", are what the bits can hold.
            let (low, high) = if field.signed {
                (
                    -(1i64 << (field.length - 1)),
                    (1i64 << (field.length - 1)) - 1,
                )
            } else {
                (0, (1i64 << field.length) - 1)
            };
            let held = [
                Some(field.minimum()),
                Some(field.maximum),
                field.not_available(),
            ];
            assert!(
                held.into_iter()
                    .flatten()
                    .all(|raw| (low..=high).contains(&raw)),
                "{name}"
            );
            assert!(names.insert(name.clone()), "{name} names two signals");
        }
    }
}

#[test]
fn the_tables_of_values_are_those_of_the_code() {
    let dbc = dbc();
    let table = |message: u16, signal: &str| -> Vec<(i64, String)> {
        let values = dbc
            .value_descriptions_for_signal(MessageId::Standard(message), signal)
            .unwrap();
        values
            .iter()
            .map(|value| (value.id, value.description.clone()))
            .collect()
    };
    let mut codes: Vec<(i64, String)> = Code::ALL
        .into_iter()
        .map(|code| (i64::from(code.number()), format!("{code:?}")))
        .collect();
    codes.push((255, NOT_AVAILABLE.into()));
    assert_eq!(table(0x142, "DiagnosisCode"), codes);
    let severities = [
        Severity::Info,
        Severity::Warning,
        Severity::Error,
        Severity::Critical,
    ]
    .map(|severity| (severity as i64, format!("{severity:?}").to_lowercase()));
    assert_eq!(table(0x142, "DiagnosisSeverity"), severities);
    let causes = [
        (Validity::VALID, "valid"),
        (Validity::STALE, "stale"),
        (Validity::SATURATED, "saturated"),
        (Validity::CALIBRATING, "calibrating"),
        (Validity::OPEN, "open"),
        (Validity::RANGE_CHANGE, "range change"),
        (Validity::IMPLAUSIBLE, "implausible"),
        (Validity::SUPPLY, "supply"),
        (Validity::CHIP_FAULT, "chip fault"),
    ]
    .map(|(cause, name)| (i64::from(cause.bits()), name.to_string()));
    let mut validities = 0;
    for message in &MESSAGES {
        for signal in message
            .signals
            .iter()
            .filter(|signal| signal.name.ends_with("Validity"))
        {
            assert_eq!(
                table(message.header.id, signal.name),
                causes,
                "{}",
                signal.name
            );
            validities += 1;
        }
    }
    assert_eq!(validities, 8);
}

/// Compares a document with what it must be, or writes it.
fn document(name: &str, expected: &str) {
    let path = root().join("docs").join(name);
    if std::env::var_os("UPDATE_DOCS").is_some() {
        std::fs::write(&path, expected).unwrap();
    }
    let found = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(
        found == expected,
        "docs/{name} is not up to date: run UPDATE_DOCS=1 cargo test -p core-logic"
    );
}

#[test]
fn the_document_of_the_frames_is_up_to_date() {
    let dbc = dbc();
    let mut text = String::from(
        "# Frames on CAN\n\n\
         <!-- Made from can/board.dbc by core-logic/tests/can_dbc.rs: UPDATE_DOCS=1 cargo test -p core-logic -->\n\n\
         Classic CAN, 500 kbit/s, 11-bit identifiers, eight bytes, all signals Intel (little endian). **Positive current and\n\
         charge is discharge.** `can/board.dbc` is the definition; encoder and decoder (`core_logic::can`) are compared with it\n\
         number by number, and frame by frame against cantools.\n\n\
         - A number beyond its signal stays at the limit, and the signal's validity says *saturated*.\n\
         - A reading is never replaced by 0. While *stale*, *open* or *chip fault* stands against a reading, its signal carries\n\
         \x20 the *not available* value; under every other cause it carries the number, and the causes beside it. Charge and\n\
         \x20 state of charge are sums and keep their number under every cause but *stale* (never counted).\n\
         - Protected messages: AUTOSAR E2E profile 11, variant C. Byte 0 is the CRC (polynomial 0x1D, start and final XOR 0, over\n\
         \x20 the data ID's low byte, a zero byte and bytes 1 … 7), bits 8 … 11 the counter (0 … 14), bits 12 … 15 the data ID's\n\
         \x20 bits 11 … 8. The data ID is the identifier. Every change of one or two bits and every burst of up to seven is found.\n\
         - What is received is refused, with the reason counted and reported, when length, CRC, data ID or counter is wrong or a\n\
         \x20 signal holds a reserved value. Up to two lost frames are tolerated; the content is missing after 500 ms.\n\
         - After a bus-off: recovery after 50 ms, then 100, 200, 400, 800 ms and every second; from the beginning after ten seconds\n\
         \x20 on the bus. Of each message only the newest frame waits, the lowest identifier goes first.\n\n\
         | ID | message | sender | period | first after | protection |\n|---|---|---|---|---|---|\n",
    );
    for message in &dbc.messages {
        let MessageId::Standard(id) = message.id else {
            panic!("11-bit identifiers only")
        };
        let profile = attribute(&dbc, message.id, "E2EProfile");
        let protection = if profile == "none" {
            "—".to_string()
        } else {
            let data_id: u16 = attribute(&dbc, message.id, "E2EDataId").parse().unwrap();
            format!("{profile}, data ID {data_id:#05x}")
        };
        writeln!(
            text,
            "| {id:#05x} | [{0}](#{1}) | {2} | {3} ms | {4} ms | {protection} |",
            message.name,
            message.name.to_lowercase(),
            message.transmitter.as_deref().unwrap(),
            attribute(&dbc, message.id, "GenMsgCycleTime"),
            attribute(&dbc, message.id, "GenMsgStartDelayTime"),
        )
        .unwrap();
    }
    for message in &dbc.messages {
        let comment = dbc.message_comment(message.id).unwrap();
        write!(text, "\n## {}\n\n{comment}\n\n", message.name).unwrap();
        let code = MESSAGES
            .iter()
            .find(|ours| ours.name == message.name)
            .unwrap();
        if let Some(prefix) = code.prefix_of_codes {
            writeln!(text, "Bit n is the diagnosis with number n ([diagnosis.md](diagnosis.md)), as signal `{prefix}` + its name.").unwrap();
            continue;
        }
        text.push_str("| signal | bits | factor | offset | from | to | unit | meaning |\n|---|---|---|---|---|---|---|---|\n");
        for signal in &message.signals {
            let page = match signal.multiplexer_indicator {
                MultiplexIndicator::MultiplexedSignal(page) => format!(" (page {page})"),
                _ => String::new(),
            };
            let sign = if signal.value_type == ValueType::Signed {
                "signed"
            } else {
                "unsigned"
            };
            let values = dbc
                .value_descriptions_for_signal(message.id, &signal.name)
                .unwrap_or_default();
            let values: Vec<String> = values
                .iter()
                .map(|value| format!("{} {}", value.id, value.description))
                .collect();
            let is_validity = signal.name.ends_with("Validity");
            let values = match (values.is_empty() || is_validity, signal.name.as_str()) {
                (true, _) => String::new(),
                (_, "DiagnosisCode") => " *Raw: as in diagnosis.md; 255 not available.*".into(),
                _ => format!(" *Raw: {}.*", values.join(", ")),
            };
            writeln!(
                text,
                "| `{}`{page} | {} … {} {sign} | {} | {} | {} | {} | {} | {}{values} |",
                signal.name,
                signal.start_bit,
                signal.start_bit + signal.size - 1,
                signal.factor,
                signal.offset,
                signal.min,
                signal.max,
                signal.unit,
                dbc.signal_comment(message.id, &signal.name).unwrap(),
            )
            .unwrap();
        }
    }
    document("can.md", &text);
}

fn causes(validity: Validity) -> String {
    let names = [
        (Validity::STALE, "stale"),
        (Validity::SATURATED, "saturated"),
        (Validity::CALIBRATING, "calibrating"),
        (Validity::OPEN, "open"),
        (Validity::RANGE_CHANGE, "range change"),
        (Validity::IMPLAUSIBLE, "implausible"),
        (Validity::SUPPLY, "supply"),
        (Validity::CHIP_FAULT, "chip fault"),
    ];
    let listed: Vec<&str> = names
        .into_iter()
        .filter(|(cause, _)| validity.contains(*cause))
        .map(|(_, name)| name)
        .collect();
    if listed.is_empty() {
        "—".into()
    } else {
        listed.join(", ")
    }
}

#[test]
fn the_document_of_the_diagnoses_is_up_to_date() {
    let mut text = String::from(
        "# Diagnoses\n\n\
         <!-- Made from core_logic::diagnosis by core-logic/tests/can_dbc.rs: UPDATE_DOCS=1 cargo test -p core-logic -->\n\n\
         One table (`core-logic/src/diagnosis.rs`). A code's number is its bit in `DiagnosisActive` and `DiagnosisLatched` on\n\
         CAN, in the Modbus registers and in the log. A debounce of 0 ms means that the module which finds the condition\n\
         debounces it itself. Latched: reported until cleared by command after the condition has gone. The causes in the last\n\
         three columns stand against the signal while the diagnosis is active.\n\n\
         | no. | code | condition | threshold | set after | cleared after | severity | latched | current | charge | SoC |\n\
         |---|---|---|---|---|---|---|---|---|---|---|\n",
    );
    for code in Code::ALL {
        let (rule, words) = (code.rule(), code.description());
        writeln!(
            text,
            "| {} | {} | {} | {} | {} ms | {} ms | {} | {} | {} | {} | {} |",
            code.number(),
            words.name,
            words.condition,
            words.threshold,
            rule.set_after_ms,
            rule.clear_after_ms,
            format!("{:?}", rule.severity).to_lowercase(),
            if rule.latch == Latch::UntilCleared {
                "yes"
            } else {
                "no"
            },
            causes(rule.effects.current),
            causes(rule.effects.charge),
            causes(rule.effects.soc),
        )
        .unwrap();
    }
    document("diagnosis.md", &text);
}
