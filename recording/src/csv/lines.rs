//! A text as lines, and a line as fields.

use std::borrow::Cow;

/// Lines with their numbers (from 1), without their ends; blank ones are left out.
#[derive(Clone)]
pub(super) struct Lines<'a> {
    rest: Option<&'a str>,
    number: u64,
}

impl<'a> Lines<'a> {
    pub(super) fn new(text: &'a str) -> Self {
        Self {
            rest: Some(text),
            number: 0,
        }
    }

    /// Bytes that are left.
    pub(super) fn remaining(&self) -> usize {
        self.rest.map_or(0, str::len)
    }
}

impl<'a> Iterator for Lines<'a> {
    type Item = (u64, &'a str);

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            let rest = self.rest?;
            let line = match memchr::memchr(b'\n', rest.as_bytes()) {
                Some(end) => {
                    self.rest = Some(&rest[end + 1..]);
                    &rest[..end]
                }
                None => {
                    self.rest = None;
                    rest
                }
            };
            self.number += 1;
            let line = line.strip_suffix('\r').unwrap_or(line);
            if !line.trim_ascii().is_empty() {
                return Some((self.number, line));
            }
        }
    }
}

/// The fields of a line; `None` for one whose quotation mark is not closed.
pub(super) struct Fields<'a> {
    rest: Option<&'a str>,
    separator: u8,
}

impl<'a> Fields<'a> {
    pub(super) fn new(line: &'a str, separator: u8) -> Self {
        Self {
            rest: Some(line),
            separator,
        }
    }

    /// A field in quotation marks, a doubled one inside stands for itself.
    fn quoted(&mut self, after_mark: &'a str) -> Option<Cow<'a, str>> {
        let mut field = String::new();
        let mut rest = after_mark;
        loop {
            let Some(mark) = memchr::memchr(b'"', rest.as_bytes()) else {
                self.rest = None;
                return None;
            };
            field.push_str(&rest[..mark]);
            rest = &rest[mark + 1..];
            if let Some(inside) = rest.strip_prefix('"') {
                field.push('"');
                rest = inside;
            } else if let Some(next) = rest.strip_prefix(char::from(self.separator)) {
                self.rest = Some(next);
                return Some(field.into());
            } else {
                self.rest = None;
                return rest.is_empty().then(|| field.into());
            }
        }
    }
}

impl<'a> Iterator for Fields<'a> {
    type Item = Option<Cow<'a, str>>;

    fn next(&mut self) -> Option<Self::Item> {
        let rest = self.rest?;
        if let Some(after_mark) = rest.strip_prefix('"') {
            return Some(self.quoted(after_mark));
        }
        let field = match memchr::memchr(self.separator, rest.as_bytes()) {
            Some(end) => {
                self.rest = Some(&rest[end + 1..]);
                &rest[..end]
            }
            None => {
                self.rest = None;
                rest
            }
        };
        Some(Some(field.into()))
    }
}
