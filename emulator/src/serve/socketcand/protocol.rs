//! What stands between `<` and `>`: the text protocol of socketcand, without any socket.
//!
//! Source: doc/protocol.md of linux-can/socketcand. Classic CAN only; of the modes BCM (after `open`; nothing is received
//! in it here, for there are no subscriptions) and RAW.

use crate::can_frame::CanFrame;

/// Longest element, from `<` to `>`. The longest that a client needs has 45 characters.
pub(super) const MAX_ELEMENT: usize = 256;
/// Greatest 11-bit identifier.
const MAX_STANDARD: u32 = 0x7FF;
/// Greatest 29-bit identifier.
const MAX_EXTENDED: u32 = 0x1FFF_FFFF;

/// What a client asks for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Command {
    /// `< open NAME >`
    Open(String),
    /// `< rawmode >`
    RawMode,
    /// `< bcmmode >`
    BcmMode,
    /// `< echo >`
    Echo,
    /// `< send ID LENGTH BYTE … >` or `< sendrtr ID LENGTH >`
    Send(CanFrame),
}

/// Cuts a stream of bytes into elements.
#[derive(Debug, Default)]
pub(super) struct Elements {
    buffer: Vec<u8>,
}

impl Elements {
    /// Bytes as they came.
    pub(super) fn push(&mut self, bytes: &[u8]) {
        self.buffer.extend_from_slice(bytes);
    }

    /// Bytes that are not used up.
    pub(super) fn len(&self) -> usize {
        self.buffer.len()
    }

    /// The next element, or what is wrong with the bytes in its place.
    pub(super) fn next(&mut self) -> Option<Result<Command, &'static str>> {
        let blanks = self
            .buffer
            .iter()
            .take_while(|byte| byte.is_ascii_whitespace())
            .count();
        self.buffer.drain(..blanks);
        if *self.buffer.first()? != b'<' {
            let garbage = self.position(b'<').unwrap_or(self.buffer.len());
            self.buffer.drain(..garbage);
            return Some(Err("no < at the beginning"));
        }
        match self.position(b'>') {
            Some(end) if end < MAX_ELEMENT => {
                let element: Vec<u8> = self.buffer.drain(..=end).collect();
                Some(parse(&element[1..end]))
            }
            None if self.buffer.len() < MAX_ELEMENT => None,
            end => {
                let last = end.unwrap_or(self.buffer.len() - 1);
                self.buffer.drain(..=last);
                Some(Err("too long"))
            }
        }
    }

    fn position(&self, wanted: u8) -> Option<usize> {
        self.buffer.iter().position(|byte| *byte == wanted)
    }
}

/// The command in the text between `<` and `>`.
fn parse(text: &[u8]) -> Result<Command, &'static str> {
    let text = std::str::from_utf8(text)
        .ok()
        .filter(|text| text.is_ascii())
        .ok_or("not ASCII")?;
    let mut words = text.split_ascii_whitespace();
    let name = words.next().ok_or("empty command")?;
    let command = match name {
        "open" => Command::Open(words.next().ok_or("open needs a bus")?.to_owned()),
        "rawmode" => Command::RawMode,
        "bcmmode" => Command::BcmMode,
        "echo" => Command::Echo,
        "send" | "sendrtr" => {
            let mut frame = identifier(words.next().ok_or("send needs an identifier")?)?;
            frame.length = length(words.next().ok_or("send needs a length")?)?;
            frame.remote = name == "sendrtr";
            if !frame.remote {
                let length = usize::from(frame.length);
                for byte in &mut frame.data[..length] {
                    *byte = data(
                        words
                            .next()
                            .ok_or("fewer data bytes than the length says")?,
                    )?;
                }
            }
            Command::Send(frame)
        }
        "controlmode" | "isotpmode" | "add" | "update" | "delete" | "subscribe" | "unsubscribe"
        | "filter" | "muxfilter" | "statistics" | "isotpconf" | "sendpdu" | "fdsend" => {
            return Err("command not supported here");
        }
        _ => return Err("unknown command"),
    };
    match words.next() {
        None => Ok(command),
        Some(_) => Err("too many words"),
    }
}

/// Eight digits are an extended identifier, fewer a standard one.
fn identifier(word: &str) -> Result<CanFrame, &'static str> {
    let id = hexadecimal(word, 8).ok_or("the identifier is not hexadecimal")?;
    let extended = word.len() == 8;
    if id > if extended { MAX_EXTENDED } else { MAX_STANDARD } {
        return Err("the identifier is too large");
    }
    Ok(CanFrame {
        id,
        extended,
        ..CanFrame::default()
    })
}

fn length(word: &str) -> Result<u8, &'static str> {
    word.parse()
        .ok()
        .filter(|length| word.len() == 1 && *length <= 8)
        .ok_or("the length is not 0 to 8")
}

fn data(word: &str) -> Result<u8, &'static str> {
    hexadecimal(word, 2)
        .and_then(|value| u8::try_from(value).ok())
        .ok_or("a data byte is not hexadecimal")
}

/// At most `digits` of them, without the sign that the standard library would take.
fn hexadecimal(word: &str, digits: usize) -> Option<u32> {
    if word.len() > digits || !word.bytes().all(|byte| byte.is_ascii_hexdigit()) {
        return None;
    }
    u32::from_str_radix(word, 16).ok()
}

/// A received frame as clients read it. The two blanks of a frame without data are the protocol's.
pub(super) fn received(at_s: f64, frame: &CanFrame) -> String {
    let id = if frame.extended {
        format!("{:08X}", frame.id & MAX_EXTENDED)
    } else {
        format!("{:03X}", frame.id & MAX_STANDARD)
    };
    let at_s = at_s.max(0.0);
    if frame.remote {
        return format!("< rtr {id} {at_s:.6} {} >", frame.length.min(8));
    }
    let data: String = frame
        .bytes()
        .iter()
        .map(|byte| format!("{byte:02X}"))
        .collect();
    format!("< frame {id} {at_s:.6} {data} >")
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn all(text: &[u8]) -> Vec<Result<Command, &'static str>> {
        let mut elements = Elements::default();
        elements.push(text);
        std::iter::from_fn(|| elements.next()).collect()
    }

    fn one(text: &str) -> Result<Command, &'static str> {
        let mut elements = all(text.as_bytes());
        assert_eq!(elements.len(), 1, "{text}");
        elements.remove(0)
    }

    fn sent(text: &str) -> CanFrame {
        match one(text) {
            Ok(Command::Send(frame)) => frame,
            other => panic!("{text}: {other:?}"),
        }
    }

    #[test]
    fn the_examples_of_the_protocol_s_document() {
        assert_eq!(one("< open can0 >"), Ok(Command::Open("can0".to_owned())));
        assert_eq!(one("< rawmode >"), Ok(Command::RawMode));
        assert_eq!(one("< bcmmode >"), Ok(Command::BcmMode));
        assert_eq!(one("< echo >"), Ok(Command::Echo));
        assert_eq!(sent("< send 123 0 >"), CanFrame::standard(0x123, &[]));
        let extended = sent("< send 1AAAAAAA 2 1 F1 >");
        assert_eq!((extended.id, extended.extended), (0x1AAA_AAAA, true));
        assert_eq!(extended.bytes(), [0x01, 0xF1]);
        let remote = sent("< sendrtr 1AAAAAAA 2 >");
        assert_eq!(
            (remote.remote, remote.length, remote.data),
            (true, 2, [0; 8])
        );
        assert_eq!(
            all(b"< open can0 >< rawmode >\n< echo >").len(),
            3,
            "several in one segment"
        );
        assert_eq!(
            received(
                23.424242,
                &CanFrame::standard(0x123, &[0x11, 0x22, 0x33, 0x44])
            ),
            "< frame 123 23.424242 11223344 >"
        );
        let mut remote = CanFrame::standard(0x123, &[]);
        (remote.remote, remote.length) = (true, 4);
        assert_eq!(received(23.424242, &remote), "< rtr 123 23.424242 4 >");
        // The protocol knows no length code above 8, which stands for eight bytes.
        remote.length = 15;
        assert_eq!(received(23.424242, &remote), "< rtr 123 23.424242 8 >");
        remote.remote = false;
        assert_eq!(
            received(23.424242, &remote),
            "< frame 123 23.424242 0000000000000000 >"
        );
    }

    #[test]
    fn what_python_can_sends() {
        // Single digits for small bytes, and two blanks where there are none.
        assert_eq!(
            sent("< send 7FF 3 0 a ff >"),
            CanFrame::standard(0x7FF, &[0, 10, 255])
        );
        assert_eq!(sent("< send 001 0  >"), CanFrame::standard(1, &[]));
        assert!(sent("< send 00000001 0  >").extended);
        assert_eq!(
            received(0.0, &CanFrame::standard(1, &[])),
            "< frame 001 0.000000  >"
        );
    }

    #[test]
    fn what_is_wrong_is_told() {
        for (text, reason) in [
            ("<>", "empty command"),
            ("< >", "empty command"),
            ("< hello >", "unknown command"),
            ("< RAWMODE >", "unknown command"),
            ("< open >", "open needs a bus"),
            ("< open a b >", "too many words"),
            ("< echo 1 >", "too many words"),
            ("< controlmode >", "command not supported here"),
            ("< subscribe 0 0 123 >", "command not supported here"),
            ("< fdsend 123 0 1 FF >", "command not supported here"),
            ("< send >", "send needs an identifier"),
            ("< send 123 >", "send needs a length"),
            (
                "< send 123 9 1 2 3 4 5 6 7 8 9 >",
                "the length is not 0 to 8",
            ),
            ("< send 123 C >", "the length is not 0 to 8"),
            ("< send 123 +1 0 >", "the length is not 0 to 8"),
            ("< send 123 -1 0 >", "the length is not 0 to 8"),
            ("< send 123 08 0 >", "the length is not 0 to 8"),
            ("< send 123 2 1 >", "fewer data bytes than the length says"),
            ("< send 123 1 1 2 >", "too many words"),
            ("< send 123 1 100 >", "a data byte is not hexadecimal"),
            ("< send 123 1 +1 >", "a data byte is not hexadecimal"),
            ("< send 123 1 0x1 >", "a data byte is not hexadecimal"),
            ("< send 800 0 >", "the identifier is too large"),
            ("< send 1234567 0 >", "the identifier is too large"),
            ("< send 20000000 0 >", "the identifier is too large"),
            ("< send 000000001 0 >", "the identifier is not hexadecimal"),
            ("< send +12 0 >", "the identifier is not hexadecimal"),
            ("< sendrtr 123 1 1 >", "too many words"),
            ("< send 1< echo >", "the identifier is not hexadecimal"),
            ("GET / HTTP/1.1", "no < at the beginning"),
            ("\u{fc}", "no < at the beginning"),
            ("< \u{fc} >", "not ASCII"),
        ] {
            assert_eq!(one(text), Err(reason), "{text}");
        }
    }

    #[test]
    fn garbage_does_not_swallow_the_command_behind_it() {
        assert_eq!(
            all(b"abc < echo > x< echo >"),
            [
                Err("no < at the beginning"),
                Ok(Command::Echo),
                Err("no < at the beginning"),
                Ok(Command::Echo)
            ]
        );
    }

    #[test]
    fn an_element_without_end_is_given_up() {
        let mut elements = Elements::default();
        elements.push(&[b'<'; MAX_ELEMENT - 1]);
        assert_eq!(elements.next(), None);
        elements.push(b"<");
        assert_eq!(elements.next(), Some(Err("too long")));
        assert_eq!((elements.next(), elements.len()), (None, 0));
        // The same when its end came with it.
        let mut long = vec![b'<'; MAX_ELEMENT + 10];
        long.extend(b"> < echo >");
        assert_eq!(all(&long), [Err("too long"), Ok(Command::Echo)]);
        // The longest that is taken.
        let mut padded = b"<".to_vec();
        padded.resize(MAX_ELEMENT - 6, b' ');
        padded.extend(b"echo >");
        assert_eq!(padded.len(), MAX_ELEMENT);
        assert_eq!(all(&padded), [Ok(Command::Echo)]);
    }

    fn any_frame() -> impl Strategy<Value = CanFrame> {
        (any::<u32>(), any::<bool>(), 0u8..=8, any::<[u8; 8]>()).prop_map(
            |(id, extended, length, data)| {
                let mut frame = CanFrame {
                    id: id & if extended { MAX_EXTENDED } else { MAX_STANDARD },
                    extended,
                    length,
                    ..CanFrame::default()
                };
                frame.data[..usize::from(length)].copy_from_slice(&data[..usize::from(length)]);
                frame
            },
        )
    }

    fn piece() -> impl Strategy<Value = Vec<u8>> {
        prop_oneof![
            prop::collection::vec(any::<u8>(), 0..40),
            "[<> a-f0-9]{0,60}".prop_map(String::into_bytes),
            "< (send|sendrtr|open|echo|rawmode|add) [0-9A-Fa-f ]{0,40}>"
                .prop_map(String::into_bytes),
        ]
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(500))]

        #[test]
        fn a_frame_that_is_sent_arrives_as_it_was(frame in any_frame()) {
            let id = if frame.extended { format!("{:08X}", frame.id) } else { format!("{:03X}", frame.id) };
            let data: String = frame.bytes().iter().map(|byte| format!("{byte:x} ")).collect();
            let text = format!("< send {id} {} {data}>", frame.length);
            prop_assert_eq!(sent(&text), frame);
        }

        #[test]
        fn any_bytes_are_judged_without_panic_and_however_they_are_cut(
            pieces in prop::collection::vec(piece(), 0..20),
            cuts in prop::collection::vec(1usize..50, 1..20),
        ) {
            let stream = pieces.concat();
            let mut elements = Elements::default();
            let mut cut_up = Vec::new();
            let mut rest = stream.as_slice();
            for cut in cuts.iter().cycle() {
                if rest.is_empty() {
                    break;
                }
                let (now, later) = rest.split_at((*cut).min(rest.len()));
                elements.push(now);
                cut_up.extend(std::iter::from_fn(|| elements.next()));
                prop_assert!(elements.len() < MAX_ELEMENT);
                rest = later;
            }
            // Errors may come in more pieces when the garbage does; commands are the same.
            let commands = |list: Vec<Result<Command, &str>>| list.into_iter().flatten().collect::<Vec<_>>();
            let whole = all(&stream);
            for command in whole.iter().flatten() {
                if let Command::Send(frame) = command {
                    prop_assert!(frame.length <= 8 && frame.id <= MAX_EXTENDED);
                    prop_assert!(frame.extended || frame.id <= MAX_STANDARD);
                }
            }
            if !stream.split(|byte| *byte == b'>').any(|part| part.len() >= MAX_ELEMENT) {
                prop_assert_eq!(commands(cut_up), commands(whole));
            }
        }
    }
}
