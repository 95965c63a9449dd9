//! What a chip's data sheet forbids and its bus did all the same.

use std::collections::BTreeMap;

/// How often, and when last.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Occurrences {
    /// How often.
    pub count: u64,
    /// The last time, in s.
    pub last_s: f64,
}

/// Counts by kind.
#[derive(Clone, Debug, PartialEq)]
pub struct Violations<K> {
    by_kind: BTreeMap<K, Occurrences>,
}

impl<K> Default for Violations<K> {
    fn default() -> Self {
        Self {
            by_kind: BTreeMap::new(),
        }
    }
}

impl<K: Copy + Ord> Violations<K> {
    pub(crate) fn record(&mut self, kind: K, at_s: f64) {
        let entry = self.by_kind.entry(kind).or_default();
        entry.count += 1;
        entry.last_s = at_s;
    }

    /// Occurrences of one kind.
    pub fn of(&self, kind: K) -> Occurrences {
        self.by_kind.get(&kind).copied().unwrap_or_default()
    }

    /// How often that kind occurred.
    pub fn count(&self, kind: K) -> u64 {
        self.of(kind).count
    }

    /// All kinds together.
    pub fn total(&self) -> u64 {
        self.by_kind.values().map(|entry| entry.count).sum()
    }

    /// Every kind that occurred.
    pub fn iter(&self) -> impl Iterator<Item = (K, Occurrences)> {
        self.by_kind.iter().map(|(&kind, &entry)| (kind, entry))
    }

    /// Starts anew.
    pub fn clear(&mut self) {
        self.by_kind.clear();
    }
}
