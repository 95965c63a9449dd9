//! How far a command is, for whoever waits at a terminal.

use std::{
    io::{self, IsTerminal, Write},
    time::{Duration, Instant},
};

/// Nothing is shown before this.
const PATIENCE: Duration = Duration::from_secs(1);
/// Time between two changes of the line.
const PACE: Duration = Duration::from_millis(100);

/// A line on a terminal's standard error that says how much is done; elsewhere nothing is written.
#[derive(Debug)]
pub struct Progress {
    what: String,
    terminal: bool,
    start: Instant,
    shown: Option<Instant>,
}

impl Progress {
    /// Begins something that is called `what`, such as "reading log.blf".
    pub fn new(what: impl Into<String>) -> Self {
        Self {
            what: what.into(),
            terminal: io::stderr().is_terminal(),
            start: Instant::now(),
            shown: None,
        }
    }

    /// `share` of it is done, 0 … 1.
    pub fn at(&mut self, share: f64) {
        if !self.terminal || self.start.elapsed() < PATIENCE {
            return;
        }
        if self.shown.is_some_and(|shown| shown.elapsed() < PACE) {
            return;
        }
        self.shown = Some(Instant::now());
        // A terminal that cannot be written to is no reason to stop.
        let percent = 100.0 * share.clamp(0.0, 1.0);
        let _ = write!(io::stderr(), "\r\x1b[K{} {percent:.0} %", self.what);
        let _ = io::stderr().flush();
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        if self.shown.is_some() {
            let _ = write!(io::stderr(), "\r\x1b[K");
        }
    }
}
