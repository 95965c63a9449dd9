//! Where a recording has no value, or repeats one: marked, never filled.

use std::ops::Range;

use crate::{error::Result, series::Recording};

/// A stretch of time without a value, longer than it should be.
#[derive(Clone, Debug, PartialEq)]
pub struct Gap {
    /// The last row with a value before it.
    pub before: usize,
    /// The first row with a value after it.
    pub after: usize,
    /// Its length, in s.
    pub length_s: f64,
}

impl Recording {
    /// Where rows are further apart than `limit_s`, in s. A new clock is not a gap.
    pub fn gaps(&self, limit_s: f64) -> Vec<Gap> {
        self.gaps_where(limit_s, |_| true)
    }

    /// Where values of one column are further apart than `limit_s`, in s, rows without a value left out.
    pub fn gaps_of(&self, name: &str, limit_s: f64) -> Result<Vec<Gap>> {
        let values = self.need(name)?;
        Ok(self.gaps_where(limit_s, |row| !values[row].is_nan()))
    }

    fn gaps_where(&self, limit_s: f64, counts: impl Fn(usize) -> bool) -> Vec<Gap> {
        let time_s = self.time_s();
        let mut gaps = Vec::new();
        for segment in self.segments() {
            let mut before = None;
            for after in segment.clone().filter(|&row| counts(row)) {
                if let Some(before) = before {
                    let length_s = time_s[after] - time_s[before];
                    if length_s > limit_s {
                        gaps.push(Gap {
                            before,
                            after,
                            length_s,
                        });
                    }
                }
                before = Some(after);
            }
        }
        gaps
    }

    /// Runs of rows in which a column has no value.
    pub fn dropouts(&self, name: &str) -> Result<Vec<Range<usize>>> {
        let values = self.need(name)?;
        Ok(self.runs(1, |_, row| values[row].is_nan()))
    }

    /// Runs of at least two rows in which a column repeats the same value: a sensor that is read more often than it
    /// measures, or one that stands still. A missing value ends a run.
    pub fn held_runs(&self, name: &str) -> Result<Vec<Range<usize>>> {
        let values = self.need(name)?;
        Ok(self.runs(2, |start, row| values[row] == values[start]))
    }

    /// True where a column has a value and the last row that had one (of the same clock) had another: the rows at which
    /// something new was measured, as far as the values tell.
    pub fn fresh(&self, name: &str) -> Result<Vec<bool>> {
        let values = self.need(name)?;
        let mut fresh = vec![false; values.len()];
        for segment in self.segments() {
            let mut last = f64::NAN;
            for row in segment.clone() {
                if !values[row].is_nan() {
                    // The first value is new: it differs from NaN.
                    fresh[row] = values[row] != last;
                    last = values[row];
                }
            }
        }
        Ok(fresh)
    }

    /// Longest runs of at least `least` rows of which each `belongs` to the run's first row; none crosses a clock.
    fn runs(&self, least: usize, belongs: impl Fn(usize, usize) -> bool) -> Vec<Range<usize>> {
        let mut runs = Vec::new();
        for segment in self.segments() {
            let mut start = segment.start;
            while start < segment.end {
                let mut end = start;
                while end < segment.end && belongs(start, end) {
                    end += 1;
                }
                if end - start >= least {
                    runs.push(start..end);
                }
                start = end.max(start + 1);
            }
        }
        runs
    }
}

/// One flag for each of `rows` rows: true inside any of `ranges`.
pub fn mask(rows: usize, ranges: &[Range<usize>]) -> Vec<bool> {
    let mut mask = vec![false; rows];
    for range in ranges {
        let end = range.end.min(rows);
        if let Some(inside) = mask.get_mut(range.start..end) {
            inside.fill(true);
        }
    }
    mask
}
